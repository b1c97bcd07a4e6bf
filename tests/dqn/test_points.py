"""Training off the grid: actions are points, from exploration to the TD error."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import State
from fixtures import probes

from mjx_balance.config import DQNConfig, preset
from mjx_balance.dqn import DQN, DQNSpec, QNetwork
from mjx_balance.dqn.dqn import td_error
from mjx_balance.dqn.replay import Transition, reflect
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.policy.heads import Radial, RadialPoints
from mjx_balance.training.sizing import make_learner

FACTORS = (21, 11)
KEYS = jax.random.split(jax.random.PRNGKey(0), 20_000)


def head(mu: Any, value: float = 2.0) -> RadialPoints:
    """A head off the grid; the second axis counts twice."""
    out = np.asarray((value, *mu), np.float32)
    profile, stretch = np.zeros(4, np.float32), np.log(np.asarray((1, 2), np.float32))
    return Radial(out, profile, stretch, FACTORS).off_grid()


def test_points_of_the_grid_have_the_grids_values() -> None:
    off, index = head((0.13, -0.4)), np.arange(21 * 11)
    grid = Radial(off.out, off.profile, off.stretch, FACTORS)
    x, y = np.divmod(index, 11)
    points = np.stack((x / 10 - 1, y / 5 - 1), axis=-1).astype(np.float32)
    values = RadialPoints(off.out[None], off.profile, off.stretch, FACTORS).q_value(points)
    np.testing.assert_allclose(values, grid.q_value(index), atol=1e-6)


@pytest.mark.parametrize("mu", [(0.13, -0.47), (1.7, 0.2), (-3.0, 1.2)])
def test_no_point_of_the_square_is_better_than_the_best(mu: tuple[float, float]) -> None:
    """It is mu itself, or the nearest point of the square."""
    off = head(mu)
    best = off.argmax()
    np.testing.assert_allclose(best, np.clip(mu, -1, 1), rtol=1e-6)
    others = np.random.default_rng(0).uniform(-1, 1, (10_000, 2)).astype(np.float32)
    many = RadialPoints(off.out[None], off.profile, off.stretch, FACTORS)
    assert off.q_value(best) > many.q_value(others).max()


class Aims:
    """A network whose best point is (0.3, -0.98), whatever it sees."""

    head = None  #: there is one, which `apply` calls

    def apply(self, params: Any, obs: jax.Array, method: str) -> Radial:
        out = jnp.asarray((0.0, 0.3, -0.98))
        return Radial(out, jnp.zeros(4), jnp.zeros(2), FACTORS)


def actions(epsilon: float, levels: int) -> np.ndarray:
    """Actions (20,000, 2) of the DQN in training, one per key."""
    stub: Any = Aims()
    config = DQNConfig(exploration_noise=levels, head="radial")
    spec = DQNSpec(config, 2, 2, action_factors=FACTORS, continuous=True)
    act = jax.vmap(DQN(stub, stub, spec).act, (None, None, 0, None))
    return np.asarray(act(None, jnp.zeros(1), KEYS, jnp.float32(epsilon)))


def test_without_exploration_the_best_point_is_taken() -> None:
    np.testing.assert_allclose(actions(0.0, 0), np.tile((0.3, -0.98), (20_000, 1)), rtol=1e-6)


def test_noise_is_gaussian_in_levels_of_its_axis() -> None:
    """As wide as moves of -2 to 2 levels, sqrt(2) of them, 0.1 and 0.2; clipped to the square."""
    x, y = actions(0.0, 2).T
    assert x.mean() == pytest.approx(0.3, abs=0.005)
    assert x.std() == pytest.approx(0.1 * 2**0.5, rel=0.03)
    assert (abs(x - 0.3) < 0.1 * 2**0.5).mean() == pytest.approx(0.6827, abs=0.015)
    assert y.min() == -1
    assert (y == -1).mean() == pytest.approx(0.472, abs=0.015)  # beyond 0.02, 0.07 deviations
    above = y[y > -0.98] + 0.98
    assert (above**2).mean() == pytest.approx(0.08, rel=0.05)
    assert np.corrcoef(x, y)[0, 1] == pytest.approx(0, abs=0.03)


def test_epsilon_is_the_share_of_uniform_points() -> None:
    drawn = actions(0.25, 0)
    random = (np.abs(drawn - (0.3, -0.98)) > 1e-6).any(axis=-1)
    assert random.mean() == pytest.approx(0.25, abs=0.015)
    for axis in drawn[random].T:
        counts, _ = np.histogram(axis, 4, (-1, 1))
        np.testing.assert_allclose(counts / random.sum(), 0.25, atol=0.03)


def test_the_selected_point_has_no_gradient() -> None:
    """In Double Q-learning the online network selects; only its value at t - 1 is trained."""

    def error(mu: jax.Array) -> jax.Array:
        out = jnp.concatenate((jnp.zeros(1), mu))
        selector = RadialPoints(out, jnp.zeros(4), jnp.zeros(2), FACTORS)
        q_t = RadialPoints(jnp.asarray((1.0, 0.5, 0.5)), jnp.zeros(4), jnp.zeros(2), FACTORS)
        point, zero = jnp.asarray((0.1, 0.2)), jnp.float32(0)
        return td_error(q_t, point, zero, jnp.float32(0.9), q_t, selector)

    np.testing.assert_array_equal(jax.grad(error)(jnp.asarray((-0.2, 0.3))), 0)
    assert error(jnp.asarray((0.5, 0.5))) > error(jnp.asarray((-0.2, 0.3)))


def test_a_mirrored_point_changes_the_sign_of_roll() -> None:
    env = BalanceEnv(dataclasses.replace(preset("default"), engine="mujoco"), "continuous")
    rng = np.random.default_rng(0)
    obs, points = (jnp.asarray(rng.normal(size=(200, n)), jnp.float32) for n in (34, 2))
    zeros = jnp.zeros(200)
    batch = Transition(obs, points, zeros, zeros, obs)
    got = reflect(batch, env.symmetries, jax.random.PRNGKey(0))
    flipped = np.asarray(got.obs[:, 0] != obs[:, 0])
    assert 0.3 < flipped.mean() < 0.7
    sign = np.where(flipped[:, None], (-1, 1), (1, 1))
    np.testing.assert_array_equal(got.action, points * sign)


def test_the_configs_action_is_that_of_env_and_learner() -> None:
    config = dataclasses.replace(preset("smoke"), engine="mujoco", num_devices=1)
    task = dataclasses.replace(config.task, action="continuous")
    for own, continuous in ((config, False), (dataclasses.replace(config, task=task), True)):
        env = BalanceEnv(own)
        learner = make_learner(own, env)
        assert env.continuous == learner.spec.continuous == continuous
        state = jax.eval_shape(lambda: learner.init(0))  # noqa: B023
        shape, dtype = ((8_192, 2), np.float32) if continuous else ((8_192,), np.int32)
        assert (state.replay.data.action.shape, state.replay.data.action.dtype) == (shape, dtype)
    with pytest.raises(ValueError, match="continuous is True; it needs the head 'radial'"):
        DQNSpec(DQNConfig(head="joint"), 2, 2, action_factors=FACTORS, continuous=True)


class Target(probes.NoisyState):
    """Earns less with the distance of two numbers from (obs / 2, -0.43), between the levels."""

    action_size = 2  # pyright: ignore

    def step(self, state: State, action: jax.Array) -> State:
        best = jnp.stack((jnp.asarray(state.obs)[0] / 2, -0.43))
        return self._next(state, 0.0, -jnp.linalg.norm(action - best), terminated=1.0)


@pytest.mark.slow
def test_learns_a_target_between_the_levels(make_dqn: Callable[..., DQN]) -> None:
    """On a grid of 5 levels, whose nearest points are 0.07 and 0.25 away."""
    dqn = make_dqn(
        Target(),
        head="radial",
        action_factors=(5, 5),
        continuous=True,
        exploration_noise=1,
        learning_rate=1e-2,
        hidden_sizes=(32,),
    )
    dqn = dataclasses.replace(dqn, network=QNetwork((32,), (5, 5), radial=True))
    state = dqn.train_program(600)(dqn.init(0))[0]
    for obs in (-0.8, 0.1, 0.7):
        got = dqn.head(dqn.export_params(state), jnp.full(1, obs)).argmax()
        np.testing.assert_allclose(got, (obs / 2, -0.43), atol=0.05)
