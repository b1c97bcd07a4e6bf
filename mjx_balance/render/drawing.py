"""Renders states offscreen to pictures and videos, and plays them in a window. No JAX.

MuJoCo chooses its OpenGL backend on import, and a broken backend can crash the process. So this
file renders in a child process (`python -m mjx_balance.render.drawing`): first with EGL, then with
OSMesa. A window always uses the display's OpenGL.
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
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjx_balance.config import TaskConfig, from_dict, to_dict
from mjx_balance.errors import MESSAGE, shorten
from mjx_balance.files.run_folder import write_atomically
from mjx_balance.robots.catalogue import in_python, use_robot
from mjx_balance.robots.schema import RobotFile
from mjx_balance.sim.scene import Scene, build_model
from mjx_balance.task.attitude import body_tilt

FPS = 25
VIDEO_SIZE = (960, 544)
PICTURE_SIZE = (1280, 720)
BACKENDS = ("egl", "osmesa")
CAMERA = "main"
CHILD = (sys.executable, "-m", "mjx_balance.render.drawing")


class RenderError(RuntimeError):
    """This machine cannot draw pictures or open a window; the message says why."""


def write(
    path: Path,
    scene: Scene,
    qpos: np.ndarray,
    *,
    captions: Sequence[str] = (),
    size: tuple[int, int] | None = None,
    fps: float = FPS,
    progress: Callable[[float], object] = lambda share: None,
) -> None:
    """Draws the first state to a `.png` file, or all states to a video, atomically.

    Args:
      path: file to write; any suffix but `.png` makes a video, at real speed.
      scene: robot, board and time step.
      qpos: (steps, nq), one state per physics step.
      captions: a tabbed line per state, of `captions`, drawn into the video; none: without.
      size: (width, height); none: `PICTURE_SIZE` or `VIDEO_SIZE`.
      fps: about how many pictures a second a video has.
      progress: called with the share of the video that is drawn.

    Raises:
      RenderError: if no OpenGL backend works here, or the file cannot be written.
    """
    is_picture, stride = path.suffix == ".png", frame_stride(scene.task, fps)
    painter = Painter(scene, size or (PICTURE_SIZE if is_picture else VIDEO_SIZE))
    try:
        import imageio.v2 as imageio

        with contextlib.closing(painter), tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"drawn{path.suffix}"
            if is_picture:
                imageio.imwrite(file, painter.draw(qpos[0]))
            else:
                rate = 1 / (stride * scene.task.sim_dt)
                with imageio.get_writer(file, fps=rate, quality=8) as writer:
                    for step in range(0, len(qpos), stride):
                        picture = painter.draw(qpos[step])
                        writer.append_data(_inscribed(picture, *captions[step : step + 1]))
                        progress(min((step + stride) / len(qpos), 1.0))
            write_atomically(path, file.read_bytes())
    except RenderError:
        raise
    except (OSError, RuntimeError, ValueError, ImportError) as error:  # imageio's own, too
        reason = getattr(error, "strerror", None) or shorten(error, MESSAGE)
        raise RenderError(f"{path} cannot be written: {reason}") from error


def captions(scene: Scene, qpos: np.ndarray) -> list[str]:
    """Time, the board's angles and the body's tilt, for each state (steps, nq) a tabbed line."""
    board = np.degrees(qpos[:, scene.board_qpos])
    tilt = body_tilt(qpos[:, scene.trunk_quat])
    time = scene.task.sim_dt * np.arange(1, len(qpos) + 1)
    return [
        f"{t:.1f} s\tboard {x:+.1f}°, {y:+.1f}°\tbody tilt {b:.2f}°"
        for t, (x, y), b in zip(time, board, tilt, strict=True)
    ]


def _inscribed(picture: np.ndarray, caption: str = "") -> np.ndarray:
    """The picture (height, width, 3), uint8, with a tabbed line on a dark strip at its top."""
    if not caption:
        return picture
    from PIL import Image, ImageDraw, ImageFont  # imageio's

    height = picture.shape[0] // 20
    picture = picture.copy()
    picture[: 2 * height] //= 3
    image, font = Image.fromarray(picture), ImageFont.load_default(height)
    for place, words in zip((0.04, 0.28, 0.7), caption.split("\t"), strict=True):
        at = (place * picture.shape[1], height)
        ImageDraw.Draw(image).text(at, words, "white", font, anchor="lm")
    return np.asarray(image)


class Painter:
    """Draws states one by one in a child process, which runs until `close`."""

    def __init__(self, scene: Scene, size: tuple[int, int] = VIDEO_SIZE):
        """Starts the process, for pictures of the scene; `size` is (width, height).

        Raises:
          RenderError: if no OpenGL backend works here.
        """
        self._size, reason = size, ""
        source = scene.robot_source
        where = {"task": to_dict(scene.task), "robot": source, "file": in_python(source)}
        header = json.dumps(where | {"size": size})
        for backend in _backends():
            self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 closed by _end
            pipe = subprocess.PIPE
            environment = os.environ | {"MUJOCO_GL": backend}
            self._child: Any = subprocess.Popen(
                CHILD, env=environment, stdin=pipe, stdout=pipe, stderr=self._stderr
            )
            if self._ask(header.encode() + b"\n", 1):
                return
            reason = self._end()
        raise _render_error(reason)

    def draw(self, qpos: np.ndarray) -> np.ndarray:
        """Draws a state (nq,); returns an RGB picture (height, width, 3), uint8.

        Raises:
          RenderError: if the child process has died.
        """
        width, height = self._size
        state = np.ascontiguousarray(qpos, float).tobytes()
        picture = self._ask(state, height * width * 3)
        if len(picture) < height * width * 3:
            raise _render_error(self._end())
        return np.frombuffer(picture, np.uint8).reshape(height, width, 3).copy()

    def close(self) -> None:
        """Ends the process."""
        if not self._stderr.closed:
            self._end()

    def _ask(self, request: bytes, size: int) -> bytes:
        """Sends bytes, and reads `size` ones; fewer if the child has died."""
        with contextlib.suppress(BrokenPipeError):
            self._child.stdin.write(request)
            self._child.stdin.flush()
        return self._child.stdout.read(size)

    def _end(self) -> str:
        """Ends the process; returns its stderr."""
        with contextlib.suppress(BrokenPipeError):
            self._child.stdin.close()
        self._child.stdout.close()
        self._child.wait()
        with self._stderr:
            self._stderr.seek(0)
            return self._stderr.read().decode(errors="replace")


class Window:
    """MuJoCo's viewer; plays states at real speed."""

    def __init__(self, scene: Scene, on_key: Callable[[int], None] | None = None):
        """Opens the window; `on_key` is called with the GLFW code of every key that is pressed.

        Raises:
          RenderError: if there is no display, or macOS needs `mjpython`.
        """
        _check_display()
        import mujoco.viewer

        self._stride = frame_stride(scene.task)
        self._pause = self._stride * scene.task.sim_dt
        self._model = build_model(scene.task, scene.robot_source, visual=True)
        self._data = mujoco.MjData(self._model)
        try:
            self._viewer = mujoco.viewer.launch_passive(
                self._model,
                self._data,
                key_callback=on_key,
                show_left_ui=False,
                show_right_ui=False,
            )
        except RuntimeError as error:  # macOS opens windows on the main thread only
            raise RenderError(
                f"no window can be opened here ({error}); start it by mjpython, as `mjpython -m "
                "mjx_balance view best`"
            ) from error
        self._viewer.cam.fixedcamid = self._model.camera(CAMERA).id
        self._viewer.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._next = time.monotonic()

    def play(self, qpos: np.ndarray) -> None:
        """Plays states (steps, nq), one per physics step; returns after the last one."""
        for state in qpos[(len(qpos) - 1) % self._stride :: self._stride]:
            if not self._viewer.is_running():
                return
            with self._viewer.lock():
                self._data.qpos[:] = state
                mujoco.mj_forward(self._model, self._data)
            self._viewer.sync()
            # The caller's work counts toward the pause; a late frame delays all that follow.
            now = time.monotonic()
            self._next = max(now, self._next + self._pause)
            time.sleep(self._next - now)

    def write(self, *texts: tuple[int, str, str]) -> None:
        """Overlays texts: corner (`mujoco.mjtGridPos`), left column, right column."""
        if self.is_open:
            big = mujoco.mjtFontScale.mjFONTSCALE_150
            self._viewer.set_texts([(big, *text) for text in texts])

    @property
    def is_open(self) -> bool:
        """Whether the window is still open."""
        return self._viewer.is_running()

    def close(self) -> None:
        """Closes the window."""
        self._viewer.close()


def frame_stride(task: TaskConfig, fps: float = FPS) -> int:
    """Physics steps per picture, for about `fps` pictures a second."""
    return max(1, round(1 / (fps * task.sim_dt)))


def _check_display() -> None:
    """Opens and closes a hidden window: without a display, MuJoCo's viewer hangs."""
    import glfw

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        window = None
        if glfw.init():
            glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
            window = glfw.create_window(64, 64, "mjx_balance", None, None)
            glfw.default_window_hints()
    if not window:
        reason = str(caught[-1].message) if caught else "unknown reason"
        raise RenderError(f"no window can be opened here ({reason})")
    glfw.destroy_window(window)


def _backends() -> tuple[str, ...]:
    """Backends to try in turn; only the user's choice if there is one; "" is MuJoCo's own."""
    chosen = os.environ.get("MUJOCO_GL")
    return (chosen,) if chosen else BACKENDS if platform.system() == "Linux" else ("",)


def _render_error(stderr: str) -> RenderError:
    reason = (stderr.strip().splitlines() or ["unknown reason"])[-1]
    return RenderError(
        f"offscreen rendering with {' or '.join(_backends())} failed ({reason}); on Debian, "
        "install libegl1 or libosmesa6"
    )


def _serve() -> None:
    """In the child process: draws the states that `Painter` sends, until it closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    pictures = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # keeps prints of libraries out of the pipe
    states = sys.stdin.buffer
    header = json.loads(states.readline())
    if header["file"]:
        use_robot(from_dict(RobotFile, header["file"]), header["robot"])
    model = build_model(from_dict(TaskConfig, header["task"]), header["robot"], visual=True)
    model.vis.quality.offsamples = 4  # with the scene's 8 a CPU draws half as long again
    data = mujoco.MjData(model)
    width, height = header["size"]
    with mujoco.Renderer(model, height, width) as renderer:
        renderer.update_scene(data, CAMERA)
        renderer.render()  # a broken backend may fail only here
        pictures.write(b"+")
        pictures.flush()
        size = data.qpos.nbytes
        while len(state := states.read(size)) == size:
            data.qpos[:] = np.frombuffer(state)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, CAMERA)
            pictures.write(renderer.render().tobytes())
            pictures.flush()


if __name__ == "__main__":
    _serve()
