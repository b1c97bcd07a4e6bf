"""The DQN on environments with known values, on two devices."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from mjx_balance.checkpoint import CheckpointError, Checkpoints
from mjx_balance.config import DQNConfig
from mjx_balance.dqn.learner import Learner, TrainState, epsilon
from mjx_balance.dqn.networks import QNetwork

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


def make(env: probes.Probe, **changes) -> Learner:
    config = dataclasses.replace(CONFIG, **changes)
    return Learner(env, QNetwork(config.hidden_sizes, (2,)), config, ENVS, ENVS * ITERATIONS)


def trained(learner: Learner, seed: int = 0) -> TrainState:
    state, _ = learner.train_program(ITERATIONS)(learner.init(seed))
    return state


def values(learner: Learner, state: TrainState, obs: float) -> np.ndarray:
    return np.asarray(learner._q_values(state.params, jnp.full(1, obs)))


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


def test_a_restored_run_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    learner = make(probes.NoisyState())
    program = learner.train_program(10)
    state, _ = program(learner.init(0))
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    checkpoints.save(int(state.env_steps), state)
    uninterrupted, _ = program(state)
    resumed, _ = program(Checkpoints(tmp_path / "checkpoints").restore(learner.init(7)))
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(jax.device_get(a), jax.device_get(b)),
        resumed,
        uninterrupted,
    )


def test_nothing_to_restore_is_said(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no checkpoint"):
        Checkpoints(tmp_path / "checkpoints").restore({})


@pytest.mark.parametrize(("name", "changes"), [("batch_size", {"batch_size": 33})])
def test_what_two_devices_cannot_share_is_refused(name: str, changes: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=f"{name} is 33"):
        make(probes.OneStep(), **changes)
