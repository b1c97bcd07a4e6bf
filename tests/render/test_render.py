"""Pictures, videos and windows; what needs OpenGL is skipped where no backend works."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import mujoco.viewer
import numpy as np
import pytest

from mjx_balance.evaluation.rollout import suite_scene
from mjx_balance.render import drawing
from mjx_balance.render.drawing import PICTURE_SIZE, VIDEO_SIZE, RenderError, Window, write
from mjx_balance.sim.scene import Scene


class Grey:
    """Stands for `Painter`, without OpenGL: pictures as bright as the state's first value."""

    def __init__(self, scene: Scene, size: tuple[int, int] = VIDEO_SIZE):
        self.shape = (*size[::-1], 3)

    def draw(self, qpos: np.ndarray) -> np.ndarray:
        return np.full(self.shape, round(qpos[0]), np.uint8)

    def close(self) -> None:
        pass


@pytest.fixture
def grey(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "Painter", Grey)


def test_a_picture_shows_the_board_as_it_stands(scene: Scene) -> None:
    tilted = scene.stance.qpos.copy()
    tilted[scene.board_qpos] = np.radians((5, -5))
    try:
        painter = drawing.Painter(scene, (160, 90))
    except RenderError as error:
        pytest.skip(str(error))
    with contextlib.closing(painter):
        level, other, again = (painter.draw(x) for x in (scene.stance.qpos, tilted, tilted))
    assert level.shape == (90, 160, 3)
    assert level.std() > 20
    assert np.mean(level != other) > 0.02
    np.testing.assert_array_equal(again, other)


def test_a_platform_carries_board_and_robot_through_the_picture(scene: Scene) -> None:
    """Half a metre up, the board and its pedestal are elsewhere before the same floor."""
    scene = suite_scene(scene, "platform")
    raised = scene.stance.qpos.copy()
    raised[scene.platform_qpos] = (0.3, 0.0, 0.5)
    raised[scene.trunk_quat[0] - 3 : scene.trunk_quat[0]] += (0.3, 0.0, 0.5)
    try:
        painter = drawing.Painter(scene, (160, 90))
    except RenderError as error:
        pytest.skip(str(error))
    with contextlib.closing(painter):
        level, other = (painter.draw(x) for x in (scene.stance.qpos, raised))
    assert np.mean(level != other) > 0.1


@pytest.mark.parametrize(
    ("sim_dt", "fps", "stride"), [(0.004, 25, 10), (0.0027, 24.69, 15), (0.1, 10, 1)]
)
@pytest.mark.usefixtures("grey")
def test_a_video_shows_the_states_in_order_at_real_speed(
    scene: Scene, tmp_path: Path, read_video: Any, sim_dt: float, fps: float, stride: int
) -> None:
    """25 times a second, or with every step."""
    scene = dataclasses.replace(scene, task=dataclasses.replace(scene.task, sim_dt=sim_dt))
    qpos = np.linspace(20, 220, 10 * stride)[:, None]
    write(tmp_path / "video.mp4", scene, qpos)
    speed, frames = read_video(tmp_path / "video.mp4")
    assert speed == pytest.approx(fps)
    assert frames.shape[:3] == (10, *VIDEO_SIZE[::-1])
    np.testing.assert_allclose(frames.mean(axis=(1, 2, 3)), qpos[::stride, 0], atol=8)


def test_captions_tell_time_board_and_tilt(scene: Scene) -> None:
    qpos = np.tile(scene.stance.qpos, (500, 1))
    qpos[:, scene.board_qpos] = np.radians((5.04, -2.5))
    half = np.radians(1.25) / 2
    qpos[-1, scene.trunk_quat] = (np.cos(half), 0, np.sin(half), 0)
    texts = drawing.captions(scene, qpos)
    assert len(texts) == 500
    assert texts[24].startswith("0.1 s\tboard +5.0°, -2.5°\tbody tilt 0.0")
    assert texts[-1].split("\t")[::2] == ["2.0 s", "body tilt 1.25°"]


@pytest.mark.usefixtures("grey")
def test_a_video_has_the_caption_of_its_state_above_and_tells_how_far_it_is(
    scene: Scene, tmp_path: Path, read_video: Any
) -> None:
    qpos, shares = np.full((200, 1), 90.0), []
    words = [*["a\tb\tc"] * 100, *["WWWWWWW\tWWWWWWWWW\tWWWWWWWW"] * 100]
    video = tmp_path / "video.mp4"
    how = {"size": (320, 192), "fps": 12.5, "progress": shares.append}
    write(video, scene, qpos, captions=words, **how)
    speed, frames = read_video(video)
    assert speed == pytest.approx(12.5)
    assert frames.shape == (10, 192, 320, 3)
    np.testing.assert_allclose(frames[:, 30:], 90, atol=8, err_msg="the picture stays")
    ground, letters = (frames[:, :18] < 60).mean(axis=(1, 2, 3)), frames[:, :18].max(axis=(1, 2, 3))
    assert (ground > 0.5).all()
    assert (letters > 150).all()
    assert ground[:5].min() > ground[5:].max() + 0.05, "each state has its own words"
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    assert len(shares) == 10


def test_no_backend_gives_one_sentence(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "steam")  # what the user chose is taken, and nothing else
    with pytest.raises(RenderError, match="offscreen rendering with steam failed"):
        write(tmp_path / "never.png", scene, scene.stance.qpos[None])
    assert not (tmp_path / "never.png").exists()


@pytest.mark.usefixtures("grey")
def test_a_file_that_cannot_be_written_is_no_matter_of_opengl(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was there before stays, and nothing beside it."""
    states = np.asarray([[7.0], [9.0]])
    (tmp_path / "old.png").write_text("old")
    write(tmp_path / "new.png", scene, states)
    picture = imageio.imread(tmp_path / "new.png")
    assert picture.shape == (*PICTURE_SIZE[::-1], 3)
    assert (picture == 7).all(), "the first state"

    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    for name in ("old.png", "none.png", "no/such.png"):
        with pytest.raises(RenderError) as error:
            write(tmp_path / name, scene, states)
        reason = "No such file or directory" if "/" in name else "No space left on device"
        assert str(error.value) == f"{tmp_path / name} cannot be written: {reason}"
    assert {x.name for x in tmp_path.iterdir()} == {"old.png", "new.png"}
    assert (tmp_path / "old.png").read_text() == "old"


@pytest.mark.usefixtures("grey")
def test_no_ffmpeg_gives_one_sentence(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(*arguments: object, **options: object) -> None:
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(imageio, "get_writer", missing)
    with pytest.raises(RenderError, match=r"never.mp4 cannot be written: No ffmpeg exe could"):
        write(tmp_path / "never.mp4", scene, np.asarray([[7.0]]))


def test_macos_wants_mjpython(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    reason = "`launch_passive` requires that the Python script be run under `mjpython` on macOS"

    def launch(*arguments: object, **looks: object) -> None:
        raise RuntimeError(reason)

    monkeypatch.setattr(mujoco.viewer, "launch_passive", launch)
    monkeypatch.setattr("mjx_balance.render.drawing._check_display", lambda: None)
    with pytest.raises(RenderError, match=r"no window can be .*; start it by mjpython, as `mjpy"):
        Window(scene)
