"""The scene's fingerprint covers the solver: what transfers under one may fall under another."""

import copy

import mujoco
import pytest

from mjx_balance.scene import Scene, scene_hash


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("iterations", 1),
        ("ls_iterations", 1),
        ("solver", mujoco.mjtSolver.mjSOL_CG),
        ("tolerance", 1e-3),
        ("ls_tolerance", 0.5),
        ("noslip_iterations", 3),
        ("enableflags", int(mujoco.mjtEnableBit.mjENBL_OVERRIDE)),
        ("density", 1.2),
    ],
)
def test_every_solver_setting_is_in_the_fingerprint(scene: Scene, name: str, value: float) -> None:
    other = copy.copy(scene.model)
    assert getattr(other.opt, name) != value
    setattr(other.opt, name, value)
    assert scene_hash(other) != scene.hash


def test_a_foot_on_another_body_is_another_scene(scene: Scene) -> None:
    other = copy.copy(scene.model)
    other.geom_bodyid[other.pair_geom2[0]] -= 1
    assert scene_hash(other) != scene.hash
