"""Offscreen pictures and videos; skipped where no OpenGL backend works."""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import mujoco.viewer
import numpy as np
import pytest

from mjx_balance.config import Config
from mjx_balance.render.drawing import (
    PICTURE_SIZE,
    VIDEO_SIZE,
    RenderError,
    Window,
    frame_stride,
    write,
)
from mjx_balance.sim.scene import Scene


def draw(path: Path, config: Config, qpos: np.ndarray) -> None:
    try:
        write(path, config, qpos)
    except RenderError as error:
        pytest.skip(str(error))


def test_a_picture_shows_a_tilted_board(config: Config, scene: Scene, tmp_path: Path) -> None:
    tilted = scene.stance.qpos.copy()
    tilted[scene.board_qpos] = np.radians((5, -5))
    for name, qpos in (("level", scene.stance.qpos), ("tilted", tilted)):
        draw(tmp_path / f"{name}.png", config, qpos[None])
    level, tilted = (imageio.imread(tmp_path / f"{n}.png") for n in ("level", "tilted"))
    assert level.shape == (PICTURE_SIZE[1], PICTURE_SIZE[0], 3)
    assert level.std() > 20
    assert np.mean(level != tilted) > 0.02


@pytest.mark.parametrize(("sim_dt", "stride"), [(0.004, 10), (0.0027, 15), (0.003, 13), (0.1, 1)])
def test_pictures_come_25_times_a_second_or_with_every_step(
    config: Config, sim_dt: float, stride: int
) -> None:
    task = dataclasses.replace(config.task, sim_dt=sim_dt)
    assert frame_stride(dataclasses.replace(config, task=task)) == stride


@pytest.mark.slow
def test_a_video_shows_the_states_in_order_at_real_speed(
    config: Config, scene: Scene, tmp_path: Path, read_video: Any
) -> None:
    tilted = scene.stance.qpos.copy()
    tilted[scene.board_qpos] = np.radians((5, -5))
    level = np.tile(scene.stance.qpos, (60, 1))
    draw(tmp_path / "video.mp4", config, np.concatenate((level, np.tile(tilted, (40, 1)))))
    fps, frames = read_video(tmp_path / "video.mp4")
    assert (fps, len(frames)) == (25, 10), "0.4 s"
    assert frames.shape[1:3] == VIDEO_SIZE[::-1]
    steps = [np.abs(a - b).mean() for a, b in itertools.pairwise(frames)]
    assert np.argmax(steps) == 5, "the board turns after 60 of 100 steps"
    assert steps[5] > 10 * max(x for k, x in enumerate(steps) if k != 5)


@pytest.mark.slow
def test_a_video_of_a_slower_simulation_plays_at_real_speed(
    config: Config, scene: Scene, tmp_path: Path, read_video: Any
) -> None:
    task = dataclasses.replace(config.task, sim_dt=0.1)
    draw(tmp_path / "video.mp4", dataclasses.replace(config, task=task), scene.stance.qpos[None])
    fps, frames = read_video(tmp_path / "video.mp4")
    assert (fps, len(frames)) == (10, 1)


def test_no_backend_gives_one_sentence(
    config: Config, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "steam")  # what the user chose is taken, and nothing else
    with pytest.raises(RenderError, match="offscreen rendering with steam failed"):
        write(tmp_path / "never.png", config, scene.stance.qpos[None])
    assert not (tmp_path / "never.png").exists()


@pytest.mark.slow
def test_a_file_that_cannot_be_written_is_no_matter_of_opengl(
    config: Config, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was there before stays, and nothing beside it."""
    (tmp_path / "old.png").write_text("old")
    draw(tmp_path / "new.png", config, scene.stance.qpos[None])

    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    for name in ("old.png", "none.png", "no/such.png"):
        with pytest.raises(RenderError) as error:
            write(tmp_path / name, config, scene.stance.qpos[None])
        reason = "No such file or directory" if "/" in name else "No space left on device"
        assert str(error.value) == f"{tmp_path / name} cannot be written: {reason}"
    assert {x.name for x in tmp_path.iterdir()} == {"old.png", "new.png"}
    assert (tmp_path / "old.png").read_text() == "old"


def test_macos_wants_mjpython(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    reason = "`launch_passive` requires that the Python script be run under `mjpython` on macOS"

    def launch(*arguments: object, **looks: object) -> None:
        raise RuntimeError(reason)

    monkeypatch.setattr(mujoco.viewer, "launch_passive", launch)
    monkeypatch.setattr("mjx_balance.render.drawing._check_display", lambda: None)
    with pytest.raises(RenderError, match=r"no window can be .*; start it by mjpython, as `mjpy"):
        Window(config)
