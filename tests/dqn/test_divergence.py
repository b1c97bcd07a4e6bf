"""NaN and infinity, from wherever they come, stop neither the training nor what it learns."""

import collections
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env
from fixtures import probes

from mjx_balance.dqn import DQN
from mjx_balance.dqn.dqn import step
from mjx_balance.dqn.mesh import AXIS

ITERATIONS = 500


@pytest.fixture(scope="module")
def make(make_dqn: Callable[..., DQN]) -> Callable[..., DQN]:
    return functools.partial(make_dqn, iterations=ITERATIONS, whiten_steps=1_600)


def assert_finite(tree: Any) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(jax.device_get(tree)):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


def learnt(state: Any) -> Any:
    """All that must stay finite, and is kept from step to step."""
    return state.params, state.target_params, state.opt_state, state.statistics, state.replay


def assert_learnt(dqn: DQN, state: Any) -> None:
    """Actions of a step are worth -x and x, whatever happens to other steps."""
    assert_finite(learnt(state))
    raw = dqn.export_params(state)
    for x in (-0.7, 0.6):
        q_values = dqn.network.apply(raw, jnp.asarray((x, 1.0)))
        np.testing.assert_allclose(np.asarray(q_values), (-x, x), atol=0.15)


@pytest.mark.slow
def test_training_ends_in_good_values(make: Callable[..., DQN]) -> None:
    faults = {"obs": math.nan, "reward": math.inf, "done": math.nan, "reset": -math.inf}
    dqn = make(probes.Faulty(faults, 0.03))
    state, metrics = dqn.train_program(ITERATIONS)(dqn.init(0))
    assert_learnt(dqn, state)
    assert metrics["diverged"] == pytest.approx(1 - 0.97**4, abs=0.02)
    assert metrics["skipped_updates"] == 0
    assert metrics["mine"] == 1
    assert abs(float(metrics["reward"])) < 1


@pytest.mark.slow
def test_numbers_too_great_to_be_squared_spoil_neither_statistics_nor_parameters(
    make: Callable[..., DQN],
) -> None:
    """Observations and rewards of 1e30: the batches and updates that meet them are skipped."""
    dqn = make(probes.Faulty({"reset": 1e30}, 0.01))
    state, metrics = dqn.train_program(ITERATIONS)(dqn.init(0))
    assert_learnt(dqn, state)
    assert metrics["diverged"] == 0
    assert 50 < float(state.statistics.batches) < 195, "of 200 batches, those without such a number"
    skipped = float(metrics["skipped_updates"])
    assert 0.1 < skipped < 0.5
    asked = 2 * (ITERATIONS - 1)  # the first iteration has too few rows
    assert int(state.gradient_steps) == asked - round(skipped * 2 * ITERATIONS)


Stepped = collections.namedtuple("Stepped", "env_state transition valid metrics")


def stepped(env: Env, obs: list[list[float]], action: list[int]) -> Stepped:
    """What `step` makes of envs at these observations, on each of two devices alike."""
    state = jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(0), len(obs)))
    state = state.replace(obs=jnp.asarray(obs))

    def one(key: jax.Array) -> Any:
        return step(env, state, jnp.asarray(action, jnp.int32), key)

    keys = jnp.stack([jax.random.PRNGKey(1)] * 2)
    return Stepped(*jax.device_get(jax.jit(jax.vmap(one, axis_name=AXIS))(keys)))


def test_a_diverged_env_is_reset_and_its_row_is_another_envs() -> None:
    env = probes.Faulty({"reward": math.nan}, 1.0)
    got = stepped(env, [[0.1, 1.0], [0.2, 0.0], [0.3, 1.0], [0.4, 0.0]], [0, 1, 1, 0])
    assert got.valid.all()
    np.testing.assert_allclose(got.transition.obs[0, :, 0], (0.2, 0.2, 0.2, 0.4))
    np.testing.assert_array_equal(got.transition.action[0], (1, 1, 1, 0))
    np.testing.assert_allclose(got.transition.reward[0], (0.2, 0.2, 0.2, -0.4))
    assert got.metrics["diverged"].value()[0] == 0.5
    assert got.metrics["reward"].value()[0] == pytest.approx(-0.1)
    assert got.metrics["mine"].number[0] == 4, "two of each device"


def test_where_no_row_is_finite_none_is_stored() -> None:
    env = probes.Faulty({"obs": math.inf}, 1.0)
    got = stepped(env, [[0.1, 1.0], [0.2, 1.0]], [0, 1])
    assert not got.valid.any()
    assert got.metrics["diverged"].value()[0] == 1
    assert got.metrics["reward"].number[0] == 0


def test_envs_that_all_diverge_leave_the_replay_as_it_is(make: Callable[..., DQN]) -> None:
    dqn = make(probes.Faulty({"obs": math.inf}, 1.0))
    before = dqn.init(0)
    after, metrics = dqn.train_program(3)(before)
    assert metrics["diverged"] == 1
    assert after.replay.size.sum() == 0
    assert_finite(learnt(after))


def test_an_env_may_report_its_own_divergence_and_need_not_end_then() -> None:
    """One of five reports it, two have a reward that is not finite; none says that it is done."""

    class Honest(probes.Faulty):
        def reset(self, rng: jax.Array) -> Any:
            state = super().reset(rng)
            return state.replace(metrics=state.metrics | {"diverged": jnp.float32(0.0)})

        def step(self, state: Any, action: jax.Array) -> Any:
            after = super().step(state, action)
            own = (action == 1).astype(jnp.float32)
            return after.replace(done=0 * own, metrics=after.metrics | {"diverged": own})

    obs = [[0.1, 1.0], [0.1, 1.0], [0.1, 0.0], [0.1, 0.0], [0.1, 0.0]]
    got = stepped(Honest({"reward": math.nan}, 1.0), obs, [0, 1, 0, 0, 1])
    assert got.metrics["diverged"].value()[0] == pytest.approx(3 / 5)
    after = got.env_state.obs[0]
    np.testing.assert_array_equal(after[2:], 0)  # where their step led
    assert (after[:2, 0] != 0).all(), "reset"
    np.testing.assert_array_equal(after[:2, 1], 1)
