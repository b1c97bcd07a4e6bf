"""Offscreen pictures and videos; skipped where no OpenGL backend works."""

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest

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


def test_a_video_plays_at_real_speed(config: Config, scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "video.mp4"
    draw(path, config, np.tile(scene.stance.qpos, (250, 1)))  # one second
    with imageio.get_reader(path) as reader:
        meta = reader.get_meta_data()
    assert meta["size"] == VIDEO_SIZE
    assert meta["duration"] == pytest.approx(1.0, abs=0.05)


def test_no_backend_gives_one_sentence(
    config: Config, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "steam")
    with pytest.raises(RenderError, match="offscreen rendering with steam failed"):
        write(tmp_path / "never.png", config, scene.stance.qpos[None])
    assert not (tmp_path / "never.png").exists()
