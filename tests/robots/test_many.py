"""One network for many robots: `examples/many_robots.py`."""

import dataclasses
import runpy
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from mjx_balance.config import preset
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.robots.limits import for_robot

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "many_robots.py"
ROBOTS = ("go1", "quadruped")


@pytest.fixture(scope="module")
def fleet() -> Any:
    base = dataclasses.replace(preset("smoke"), engine="mujoco")
    return runpy.run_path(str(EXAMPLE))["Fleet"]([for_robot(base, x) for x in ROBOTS])


@pytest.mark.slow
def test_each_robot_has_its_share_of_the_boards(fleet: Any) -> None:
    """Of 6 boards, 3 do what a `BalanceEnv` of Go1 does, the others what ours does."""
    keys = jax.random.split(jax.random.PRNGKey(3), 6)
    actions = np.asarray([0, 440, 220, 0, 440, 220])

    def both(env: BalanceEnv, keys: Any, actions: Any) -> Any:
        state = jax.vmap(env.reset)(keys)
        return state.obs, jax.vmap(env.step)(state, actions)

    together = jax.jit(lambda k, a: both(fleet, k, a))(keys, actions)
    for number, env in enumerate(fleet.members):
        mine = slice(3 * number, 3 * number + 3)
        alone = jax.jit(lambda k, a: both(env, k, a))(keys[mine], actions[mine])  # noqa: B023
        own = jax.tree.map(lambda x: x[mine], together)  # noqa: B023
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), own, alone
        )
    tilts = together[1].metrics["tilt_deg"]
    assert abs(tilts[0] - tilts[3]) > 1e-3, "they are other robots"


def test_boards_that_cannot_be_shared_out_are_refused(fleet: Any) -> None:
    with pytest.raises(ValueError, match="5 boards cannot be shared out among 2 robots"):
        jax.vmap(fleet.reset)(jax.random.split(jax.random.PRNGKey(0), 5))
