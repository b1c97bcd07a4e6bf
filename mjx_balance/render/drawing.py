"""Pictures and videos of a rollout, drawn offscreen, and a window to watch one in. No JAX.

MuJoCo chooses its OpenGL backend when it is imported, and a backend that does not
work can take the process with it. So the drawing is done by this file in a process
of its own, with EGL first and then OSMesa (`python -m mjx_balance.render.drawing`). A window's
OpenGL is the display's, whatever the backend.
"""

import contextlib
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjx_balance.config import Config, from_dict, to_dict
from mjx_balance.files.run_folder import write_atomically
from mjx_balance.sim.scene import build_model

FPS = 25
VIDEO_SIZE = (960, 544)
PICTURE_SIZE = (1280, 720)
BACKENDS = ("egl", "osmesa")
CHILD = (sys.executable, "-m", "mjx_balance.render.drawing")
UNWRITTEN = 3
"""What that process ends with if it could draw, but not write."""


class RenderError(RuntimeError):
    """No picture can be drawn on this machine; the message says why."""


def write(path: Path, config: Config, qpos: np.ndarray, camera: str = "main") -> None:
    """Draws states to a file: `.png` the first of them, anything else all as a video.

    The file is written whole or not at all.

    Args:
      path: file to write; a video plays at real speed.
      config: gives the scene and the time step.
      qpos: (steps, nq), one per physics step, of the scene with or without its looks.
      camera: a camera of scene.xml.

    Raises:
      RenderError: if no OpenGL backend works here, or the file cannot be written.
    """
    stride = frame_stride(config)
    with tempfile.TemporaryDirectory() as folder:
        job, drawn = Path(folder) / "job.npz", Path(folder) / f"drawn{path.suffix}"
        header = {"config": to_dict(config), "camera": camera, "path": str(drawn)}
        header["fps"] = 1 / (stride * config.task.sim_dt)
        np.savez(job, qpos=qpos[::stride], header=json.dumps(header))
        reason = ""
        for environment in _environments():
            command = [*CHILD, str(job)]
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            reason = done.stderr
            if done.returncode == UNWRITTEN:
                raise RenderError(f"{path} cannot be written: {_last_line(reason)}")
            if done.returncode == 0:
                try:
                    return write_atomically(path, drawn.read_bytes())
                except OSError as error:
                    raise RenderError(f"{path} cannot be written: {error.strerror}") from error
    raise _failed(reason)


class Painter:
    """Draws one state after the other, in a process of its own that stays until `close`."""

    def __init__(self, config: Config, camera: str = "main"):
        """Starts the process.

        Args:
          config: gives the scene.
          camera: a camera of scene.xml.

        Raises:
          RenderError: if no OpenGL backend works here.
        """
        header = json.dumps({"config": to_dict(config), "camera": camera})
        reason = ""
        for environment in _environments():
            self._said = tempfile.TemporaryFile()  # noqa: SIM115 closed by _end
            pipe = subprocess.PIPE
            self._child: Any = subprocess.Popen(
                CHILD, env=environment, stdin=pipe, stdout=pipe, stderr=self._said
            )
            with contextlib.suppress(BrokenPipeError):  # it is gone already: nothing is answered
                self._child.stdin.write(header.encode() + b"\n")
                self._child.stdin.flush()
            if self._child.stdout.read(1):
                return
            reason = self._end()
        raise _failed(reason)

    def draw(self, qpos: np.ndarray) -> np.ndarray:
        """A picture (height, width, 3), uint8, of a state (nq,) with or without its looks.

        Raises:
          RenderError: if the process has ended.
        """
        width, height = VIDEO_SIZE
        picture = b""
        with contextlib.suppress(BrokenPipeError):
            self._child.stdin.write(np.ascontiguousarray(qpos, float).tobytes())
            self._child.stdin.flush()
            picture = self._child.stdout.read(height * width * 3)
        if len(picture) < height * width * 3:
            raise _failed(self._end())
        return np.frombuffer(picture, np.uint8).reshape(height, width, 3).copy()

    def close(self) -> None:
        """Ends the process."""
        if not self._said.closed:
            self._end()

    def _end(self) -> str:
        """Ends the process; returns what it said."""
        with contextlib.suppress(BrokenPipeError):
            self._child.stdin.close()
        self._child.stdout.close()
        self._child.wait()
        with self._said:
            self._said.seek(0)
            return self._said.read().decode(errors="replace")


class Window:
    """MuJoCo's viewer, in which states are played at real speed. A closed one stays closed."""

    def __init__(self, config: Config, on_key: Callable[[int], None] | None = None):
        """Opens the window.

        Args:
          config: gives the scene.
          on_key: told of every key that is pressed, by GLFW's code.

        Raises:
          RenderError: if there is no display to open it on, or macOS wants another Python.
        """
        _check_display()
        import mujoco.viewer

        self._stride = frame_stride(config)
        self._pause = self._stride * config.task.sim_dt
        self._model = build_model(config, visual=True)
        self._data = mujoco.MjData(self._model)
        try:
            self._viewer = mujoco.viewer.launch_passive(
                self._model,
                self._data,
                key_callback=on_key,
                show_left_ui=False,
                show_right_ui=False,
            )
        except RuntimeError as error:  # on macOS windows belong to the main thread
            raise RenderError(
                f"no window can be opened here ({error}); start it by mjpython, as `mjpython -m "
                "mjx_balance view best`"
            ) from error
        self._viewer.cam.fixedcamid = self._model.camera("main").id
        self._viewer.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._next = time.monotonic()

    def play(self, qpos: np.ndarray) -> None:
        """Shows states (steps, nq), one per physics step; returns when they are over."""
        for state in qpos[(len(qpos) - 1) % self._stride :: self._stride]:
            if not self._viewer.is_running():
                return
            with self._viewer.lock():
                self._data.qpos[:] = state
                mujoco.mj_forward(self._model, self._data)
            self._viewer.sync()
            # What came between two calls is part of the pause, and time lost is not made up for.
            now = time.monotonic()
            self._next = max(now, self._next + self._pause)
            time.sleep(self._next - now)

    def write(self, *texts: tuple[int, str, str]) -> None:
        """Lays texts over the picture: corner (`mujoco.mjtGridPos`), left and right column."""
        if self.is_open:
            big = mujoco.mjtFontScale.mjFONTSCALE_150
            self._viewer.set_texts([(big, *text) for text in texts])

    @property
    def is_open(self) -> bool:
        """Whether nobody has closed it."""
        return self._viewer.is_running()

    def close(self) -> None:
        """Closes the window."""
        self._viewer.close()


def frame_stride(config: Config) -> int:
    """Physics steps from one picture to the next, at about `FPS`."""
    return max(1, round(1 / (FPS * config.task.sim_dt)))


def _check_display() -> None:
    """Tries a window: MuJoCo's viewer opens its own in a thread, and hangs where it cannot."""
    import glfw

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        window = None
        if glfw.init():
            glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
            window = glfw.create_window(64, 64, "mjx_balance", None, None)
            glfw.default_window_hints()
    if not window:
        reason = str(said[-1].message) if said else "unknown reason"
        raise RenderError(f"no window can be opened here ({reason})")
    glfw.destroy_window(window)


def _backends() -> tuple[str, ...]:
    """What to draw with, the first that works: what the user chose, and nothing else."""
    chosen = os.environ.get("MUJOCO_GL")
    return (chosen,) if chosen else BACKENDS if platform.system() == "Linux" else ("",)


def _environments() -> Iterator[dict[str, str]]:
    """The variables of the child process for each of them."""
    for backend in _backends():
        yield os.environ | ({"MUJOCO_GL": backend} if backend else {})


def _failed(said: str) -> RenderError:
    """What the last backend's process said, in a sentence."""
    return RenderError(
        f"offscreen rendering with {' or '.join(_backends())} failed ({_last_line(said)}); on "
        "Debian, install libegl1 or libosmesa6"
    )


def _last_line(said: str) -> str:
    return (said.strip().splitlines() or ["unknown reason"])[-1]


@contextlib.contextmanager
def _drawing(
    header: dict[str, Any], size: tuple[int, int]
) -> Iterator[Callable[[np.ndarray], np.ndarray]]:
    """A function from states (nq,) to pictures (height, width, 3), in the child process."""
    width, height = size
    model = build_model(from_dict(Config, header["config"]), visual=True)
    data = mujoco.MjData(model)
    with mujoco.Renderer(model, height, width) as renderer:

        def draw(state: np.ndarray) -> np.ndarray:
            data.qpos[:] = state
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, header["camera"])
            return renderer.render()

        yield draw


def _serve() -> None:
    """The child process: draws what `Painter` asks for, until nothing more can come."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who watches
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # so that no library's word is a picture
    questions = sys.stdin.buffer
    header = json.loads(questions.readline())
    with _drawing(header, VIDEO_SIZE) as draw:
        answers.write(b"+")
        answers.flush()
        size = 8 * build_model(from_dict(Config, header["config"])).nq
        while len(state := questions.read(size)) == size:
            answers.write(draw(np.frombuffer(state)).tobytes())
            answers.flush()


def _draw(job: Path) -> None:
    """The child process: draws what `write` saved."""
    import imageio.v2 as imageio

    with np.load(job) as saved:
        qpos, header = saved["qpos"], json.loads(str(saved["header"]))
    path = Path(header["path"])
    picture = path.suffix == ".png"
    with _drawing(header, PICTURE_SIZE if picture else VIDEO_SIZE) as draw:
        try:
            if picture:
                imageio.imwrite(path, draw(qpos[0]))
                return
            with imageio.get_writer(path, fps=header["fps"], quality=8) as writer:
                for state in qpos:
                    writer.append_data(draw(state))
        except OSError as error:  # of the disk: OpenGL's are others
            print(error.strerror or error, file=sys.stderr)
            sys.exit(UNWRITTEN)


if __name__ == "__main__":
    if sys.argv[1:]:
        _draw(Path(sys.argv[1]))
    else:
        _serve()
