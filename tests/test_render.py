"""Offscreen pictures and videos; skipped where no OpenGL backend works."""

import dataclasses
import itertools
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import videos

from mjx_balance.config import Config
from mjx_balance.render import PICTURE_SIZE, VIDEO_SIZE, RenderError, write
from mjx_balance.scene import Scene


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


def test_a_video_shows_the_states_in_order_at_real_speed(
    config: Config, scene: Scene, tmp_path: Path
) -> None:
    tilted = scene.stance.qpos.copy()
    tilted[scene.board_qpos] = np.radians((5, -5))
    level = np.tile(scene.stance.qpos, (60, 1))
    draw(tmp_path / "video.mp4", config, np.concatenate((level, np.tile(tilted, (40, 1)))))
    fps, frames = videos.read(tmp_path / "video.mp4")
    assert (fps, len(frames)) == (25, 10), "0.4 s"
    assert frames.shape[1:3] == VIDEO_SIZE[::-1]
    steps = [np.abs(a - b).mean() for a, b in itertools.pairwise(frames)]
    assert np.argmax(steps) == 5, "the board turns after 60 of 100 steps"
    assert steps[5] > 10 * max(x for k, x in enumerate(steps) if k != 5)


def test_a_video_of_a_slower_simulation_plays_at_real_speed(
    config: Config, scene: Scene, tmp_path: Path
) -> None:
    task = dataclasses.replace(config.task, sim_dt=0.1)
    draw(tmp_path / "video.mp4", dataclasses.replace(config, task=task), scene.stance.qpos[None])
    fps, frames = videos.read(tmp_path / "video.mp4")
    assert (fps, len(frames)) == (10, 1)


def test_no_backend_gives_one_sentence(
    config: Config, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "steam")  # what the user chose is taken, and nothing else
    with pytest.raises(RenderError, match="offscreen rendering with steam failed"):
        write(tmp_path / "never.png", config, scene.stance.qpos[None])
    assert not (tmp_path / "never.png").exists()
