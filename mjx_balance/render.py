"""Pictures and videos of a rollout, drawn offscreen. No JAX.

MuJoCo chooses its OpenGL backend when it is imported, and a backend that does not
work can take the process with it. So the drawing is done by this file in a process
of its own, with EGL first and then OSMesa (`python -m mjx_balance.render`).
"""

import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np

from mjx_balance.config import Config, from_dict, to_dict
from mjx_balance.scene import build_model

FPS = 25
VIDEO_SIZE = (960, 544)
PICTURE_SIZE = (1280, 720)
BACKENDS = ("egl", "osmesa")


class RenderError(RuntimeError):
    """No picture can be drawn on this machine; the message says why."""


def write(path: Path, config: Config, qpos: np.ndarray, camera: str = "main") -> None:
    """Draws states to a file: `.png` the first of them, anything else all as a video.

    Args:
      path: file to write; a video plays at real speed.
      config: gives the scene and the time step.
      qpos: (steps, nq), one per physics step, of the scene with or without its looks.
      camera: a camera of scene.xml.

    Raises:
      RenderError: if no OpenGL backend works here, or the file cannot be written.
    """
    stride = max(1, round(1 / (FPS * config.task.sim_dt)))
    chosen = os.environ.get("MUJOCO_GL")
    backends = (chosen,) if chosen else BACKENDS if platform.system() == "Linux" else ("",)
    with tempfile.TemporaryDirectory() as folder:
        job = Path(folder) / "job.npz"
        header = {"config": to_dict(config), "camera": camera, "path": str(path.absolute())}
        header["fps"] = 1 / (stride * config.task.sim_dt)
        np.savez(job, qpos=qpos[::stride], header=json.dumps(header))
        reason = ""
        for backend in backends:
            environment = os.environ | ({"MUJOCO_GL": backend} if backend else {})
            command = [sys.executable, "-m", "mjx_balance.render", str(job)]
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            if done.returncode == 0:
                return
            reason = (done.stderr.strip().splitlines() or ["unknown reason"])[-1]
    raise RenderError(
        f"offscreen rendering with {' or '.join(backends)} failed ({reason}); on Debian, "
        "install libegl1 or libosmesa6"
    )


def _draw(job: Path) -> None:
    """The child process: draws what `write` saved."""
    import imageio.v2 as imageio

    with np.load(job) as saved:
        qpos, header = saved["qpos"], json.loads(str(saved["header"]))
    path = Path(header["path"])
    picture = path.suffix == ".png"
    width, height = PICTURE_SIZE if picture else VIDEO_SIZE
    model = build_model(from_dict(Config, header["config"]), visual=True)
    data = mujoco.MjData(model)
    with mujoco.Renderer(model, height, width) as renderer:

        def draw(state: np.ndarray) -> np.ndarray:
            data.qpos[:] = state
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, header["camera"])
            return renderer.render()

        if picture:
            imageio.imwrite(path, draw(qpos[0]))
            return
        with imageio.get_writer(path, fps=header["fps"], quality=8) as writer:
            for state in qpos:
                writer.append_data(draw(state))


if __name__ == "__main__":
    _draw(Path(sys.argv[1]))
