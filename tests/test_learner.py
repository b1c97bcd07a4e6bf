"""The DQN on environments with known values, on two devices."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from mjx_balance.config import DQNConfig
from mjx_balance.dqn import whitening
from mjx_balance.dqn.learner import Learner, TrainState, dither, epsilon, mirrored
from mjx_balance.dqn.networks import QNetwork, fold_inputs
from mjx_balance.dqn.replay import Transition

CONFIG = DQNConfig(
    gamma=0.5,
    learning_rate=3e-3,
    learning_rate_end=3e-4,
    batch_size=32,
    updates_per_step=2,
    replay_capacity=512,
    min_replay_size=16,
    target_update_period=20,
    epsilon_decay_steps=1_000,
    epsilon_end=0.3,
    hidden_sizes=(16,),
)
ENVS, ITERATIONS = 8, 400


def make(env: probes.Probe, num_seeds: int = 1, **changes) -> Learner:
    config = dataclasses.replace(CONFIG, **changes)
    network = QNetwork(config.hidden_sizes, (2,))
    return Learner(env, network, config, ENVS, ENVS * ITERATIONS, num_seeds=num_seeds)


def trained(learner: Learner, seed: int = 0) -> TrainState:
    state, _ = learner.train_program(ITERATIONS)(learner.init(seed))
    return state


def values(learner: Learner, state: TrainState, obs: float) -> np.ndarray:
    return np.asarray(learner.network.apply(learner.exported(state), jnp.full(1, obs)))


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize(
    ("env", "obs", "expected"),
    [
        (probes.OneStep(), 1.0, (1.0, 1.0)),
        (probes.TwoSteps(), 1.0, (0.5, 0.5)),
        (probes.TwoSteps(), 2.0, (1.0, 1.0)),
        (probes.ChooseRight(), 1.0, (-1.0, 1.0)),
        (probes.TimeOut(), 1.0, (2.0, 2.0)),
        (probes.NoisyState(), 0.5, (-0.5, 0.5)),
    ],
    ids=lambda x: type(x).__name__ if isinstance(x, probes.Probe) else str(x),
)
def test_learns_known_values(
    env: probes.Probe, obs: float, expected: tuple[float, float], double: bool
) -> None:
    learner = make(env, double=double)
    np.testing.assert_allclose(values(learner, trained(learner), obs), expected, atol=0.1)


def test_uses_both_devices() -> None:
    assert make(probes.OneStep()).num_devices == 2


def test_traced_once_for_many_calls() -> None:
    learner = make(probes.TwoSteps())
    program = learner.train_program(3)
    state = learner.init(0)
    for _ in range(5):
        state, _ = program(state)
    assert learner.trace_count == 1
    assert int(state.env_steps) == 5 * 3 * ENVS


def test_equal_seeds_equal_parameters_other_seeds_others() -> None:
    learner = make(probes.NoisyState())
    first, again, other = (
        jax.device_get(trained(learner, seed).params["params"]["head"]["kernel"])
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3


def test_several_seeds_are_as_many_runs() -> None:
    """One program of three seeds learns what three programs learn."""
    state, metrics = make(probes.NoisyState(), num_seeds=3).train_program(60)(
        make(probes.NoisyState(), num_seeds=3).init(5)
    )
    together = jax.device_get(state)
    assert metrics["loss"].shape == (3,)
    for k in range(3):
        single = make(probes.NoisyState())
        alone, alone_metrics = single.train_program(60)(single.init(5 + k))
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a[k], b, atol=1e-4),  # noqa: B023
            together.params,
            jax.device_get(alone.params),
        )
        np.testing.assert_array_equal(together.gradient_steps[k], alone.gradient_steps)
        assert metrics["loss"][k] == pytest.approx(float(alone_metrics["loss"]), rel=1e-3)


def test_mirrored_transitions_are_reflections_of_themselves() -> None:
    count = 400
    obs = jnp.linspace(0.1, 1, count)[:, None]
    batch = Transition(obs, jnp.zeros(count, int), obs[:, 0], jnp.zeros(count), 2 * obs)
    got = mirrored(probes.PositiveState.symmetries, batch, jax.random.PRNGKey(0))
    flipped = np.asarray(got.action) == 1
    assert 0.4 < flipped.mean() < 0.6
    sign = np.where(flipped, -1.0, 1.0)[:, None]
    np.testing.assert_allclose(got.obs, sign * obs, rtol=1e-6)
    np.testing.assert_allclose(got.next_obs, 2 * sign * obs, rtol=1e-6)
    np.testing.assert_array_equal(got.reward, batch.reward)


def test_mirror_teaches_what_was_never_seen() -> None:
    """Only positive observations are shown; the values of negative ones are learnt too."""
    errors = {}
    for mirror in (False, True):
        learner = make(probes.PositiveState(), mirror=mirror)
        got = values(learner, trained(learner), -0.7)
        errors[mirror] = np.abs(got - (0.7, -0.7)).max()
    assert errors[True] < 0.1 < errors[False]


def test_whitened_observations_are_uncorrelated_and_of_equal_size() -> None:
    """Three nearly equal sensors: after whitening, covariance I where there is variance."""
    rng = np.random.default_rng(0)
    common = rng.normal(size=(4_000, 1))
    obs = 5 + common + 0.1 * rng.normal(size=(4_000, 3))
    seen = whitening.init(3)
    for batch in np.split(obs, 40):
        mean = jnp.asarray(batch.mean(axis=0))
        seen = whitening.update(seen, mean, jnp.asarray(np.cov(batch.T, bias=True)))
    white = (obs - np.asarray(seen.mean)) @ np.asarray(whitening.matrix(seen, 1e-6))
    np.testing.assert_allclose(np.cov(white.T), np.eye(3), atol=0.15)
    damped = (obs - obs.mean(axis=0)) @ np.asarray(whitening.matrix(seen, 1.0))
    assert np.linalg.eigvalsh(np.cov(damped.T))[0] < 0.02, "below the floor nothing is blown up"


@pytest.mark.parametrize("radial", [False, True])
def test_exported_parameters_take_raw_observations(radial: bool) -> None:
    rng = np.random.default_rng(0)
    network = QNetwork((8, 6), (3, 4), radial)
    shapes = jax.eval_shape(network.init, jax.random.PRNGKey(0), jnp.zeros(5))
    params = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32), shapes)
    mean = jnp.asarray(rng.normal(size=5), jnp.float32)
    matrix = jnp.asarray(rng.normal(size=(5, 5)), jnp.float32)
    obs = jnp.asarray(rng.normal(size=(20, 5)), jnp.float32)
    expected = network.apply(params, (obs - mean) @ matrix)
    folded = fold_inputs(params, mean, matrix)
    np.testing.assert_allclose(
        np.asarray(network.apply(folded, obs)), np.asarray(expected), rtol=2e-4, atol=2e-4
    )


def test_learns_with_whitening_and_then_keeps_it() -> None:
    learner = make(probes.NoisyState(), whiten_steps=100 * ENVS)
    state = trained(learner)
    assert float(state.inputs.batches) == 100
    for obs in (-0.8, 0.3):
        np.testing.assert_allclose(values(learner, state, obs), (-obs, obs), atol=0.2)


def test_dither_moves_each_digit_by_a_few_levels() -> None:
    keys = jax.random.split(jax.random.PRNGKey(0), 2_000)
    inside = np.asarray(jax.vmap(lambda k: dither(k, jnp.int32(21 * 10 + 4), (21, 21), 2))(keys))
    x, y = np.divmod(inside, 21)
    assert set(x) == {8, 9, 10, 11, 12}
    assert set(y) == {2, 3, 4, 5, 6}
    assert np.abs(np.corrcoef(x, y)[0, 1]) < 0.1
    corner = np.asarray(jax.vmap(lambda k: dither(k, jnp.int32(20), (21, 21), 2))(keys))
    assert set(corner // 21) == {0, 1, 2}
    assert set(corner % 21) == {18, 19, 20}


def test_no_update_before_the_replay_is_warm() -> None:
    learner = make(probes.OneStep(), min_replay_size=5 * ENVS)
    program = learner.train_program(4)
    state, _ = program(learner.init(0))
    assert int(state.gradient_steps) == 0
    state, _ = program(state)
    assert int(state.gradient_steps) == 4 * CONFIG.updates_per_step


def test_learning_begins_even_if_the_replay_is_rounded_below_its_minimum() -> None:
    learner = make(probes.OneStep(), replay_capacity=2 * ENVS + 5, min_replay_size=2 * ENVS + 5)
    state, _ = learner.train_program(4)(learner.init(0))
    assert int(state.gradient_steps) > 0


def test_target_network_is_a_copy_made_every_period() -> None:
    period = 6
    learner = make(probes.NoisyState(), target_update_period=period, min_replay_size=ENVS)
    program = learner.train_program(1)
    state = learner.init(0)
    for _ in range(9):
        state, _ = program(state)
        same = jax.tree.all(
            jax.tree.map(lambda a, b: bool((a == b).all()), state.params, state.target_params)
        )
        assert same == (int(state.gradient_steps) % period == 0)


def test_epsilon_falls_linearly_and_stays() -> None:
    config = dataclasses.replace(
        CONFIG, epsilon_start=1.0, epsilon_end=0.2, epsilon_decay_steps=100
    )
    got = [float(epsilon(config, jnp.int32(n))) for n in (0, 50, 100, 1_000)]
    np.testing.assert_allclose(got, (1.0, 0.6, 0.2, 0.2), rtol=1e-6)


@pytest.mark.parametrize(("name", "changes"), [("batch_size", {"batch_size": 33})])
def test_what_two_devices_cannot_share_is_refused(name: str, changes: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=f"{name} is 33"):
        make(probes.OneStep(), **changes)
