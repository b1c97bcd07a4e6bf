"""The learner against a second one, parameter by parameter, and its rows against their env."""

import dataclasses
from typing import Any

import jax
import numpy as np
import probes
import pytest
from reference import Reference, exact

from mjx_balance.config import DQNConfig
from mjx_balance.dqn.learner import Learner
from mjx_balance.dqn.networks import QNetwork

ITERATIONS, UPDATES = 12, 3
CONFIG = DQNConfig(
    gamma=0.9,
    learning_rate=3e-2,
    learning_rate_end_share=0.1,
    replay_ratio=UPDATES,
    target_update_period=7,
    epsilon_start=1.0,
    epsilon_end=0.0,
    epsilon_decay_steps=20,
    hidden_sizes=(5,),
)
CASES = {
    "Eq. 1": {},
    "Double DQN": {"double": True},
    "clipped": {"max_grad_norm": 0.3},
    "never synchronised": {"target_update_period": 10_000},
    "whitened": {"whiten_steps": 14, "whiten_floor": 0.05},
}


@pytest.mark.parametrize(("case", "devices"), [*((case, 2) for case in CASES), ("Double DQN", 1)])
def test_parameters_are_those_of_a_second_implementation(case: str, devices: int) -> None:
    """Three iterations beyond the schedule's end, from one row per device."""
    config = dataclasses.replace(
        CONFIG, batch_size=devices, replay_capacity=devices, min_replay_size=devices, **CASES[case]
    )
    learner = Learner(
        probes.Turn(),
        QNetwork(config.hidden_sizes, (2,)),
        config,
        devices,
        ITERATIONS * devices - devices // 2,  # the last iteration counts whole
        jax.devices()[:devices],
    )
    program = learner.train_program(1)
    state = learner.init(5)
    reference = Reference(config, exact(state.params), ITERATIONS * UPDATES)
    for k in range(ITERATIONS + 3):
        obs = np.array(state.env_state.obs, float)
        reference.observe(obs, k * devices)
        state, metrics = program(state)
        rows = jax.device_get(state.replay.data)
        if k * devices >= 20:  # nothing is random any more
            np.testing.assert_array_equal(rows.action, reference.choose(obs))
        losses = [reference.learn(rows) for _ in range(UPDATES)]
        assert metrics["loss"] == pytest.approx(np.mean(losses), rel=2e-3, abs=1e-6), k
        share = min(k * devices / 20, 1)
        assert metrics["epsilon"] == pytest.approx(1 - share, abs=1e-5)
        assert metrics["reward"] == pytest.approx(rows.reward.mean(), rel=1e-5)
        assert int(state.gradient_steps) == reference.steps
        agree(state.params, reference.params)
        assert devices == 1 or np.ptp(rows.obs, axis=0).max() > 0.01, "two devices, two rows"


def agree(params: Any, expected: Any) -> None:
    for layer, value in expected.items():
        for name, x in value.items():
            np.testing.assert_allclose(
                params["params"][layer][name], x, rtol=2e-3, atol=2e-4, err_msg=f"{layer}/{name}"
            )


ENVS = 8


@pytest.fixture(scope="module")
def walked() -> list[tuple[Any, Any, Any]]:
    """State before, state after and metrics of 12 single iterations of Walk, no learning."""
    config = dataclasses.replace(
        CONFIG,
        batch_size=2,
        replay_ratio=UPDATES * 2 / ENVS,
        replay_capacity=3 * ENVS,
        epsilon_decay_steps=10_000,
    )
    learner = Learner(probes.Walk(), QNetwork((5,), (2,)), config, ENVS, 96)
    program = learner.train_program(1)
    state = learner.init(0)
    seen = []
    for _ in range(12):
        before = jax.device_get(state)
        state, metrics = program(state)
        seen.append((before, jax.device_get(state), jax.device_get(metrics)))
    return seen


def newest(before: Any, after: Any) -> Any:
    """The rows (ENVS, ...) that an iteration stored, in the order of the envs."""

    def pick(ring: np.ndarray) -> np.ndarray:
        return np.concatenate(
            [part[before.replay.position :][: ENVS // 2] for part in np.split(ring, 2)]
        )

    return jax.tree.map(pick, after.replay.data)


def test_rows_are_what_the_envs_did(walked: list[tuple[Any, Any, Any]]) -> None:
    """Every row belongs to its env; next_obs is the one before the reset."""
    for before, after, metrics in walked:
        rows = newest(before, after)
        np.testing.assert_array_equal(rows.obs, before.env_state.obs)
        walk, steps = rows.obs.T
        np.testing.assert_array_equal(rows.next_obs, np.stack((walk, steps + 1), axis=1))
        np.testing.assert_allclose(rows.reward, 10 * walk + steps + rows.action / 2, rtol=1e-6)
        np.testing.assert_array_equal(rows.terminated, (steps == 2) & (rows.action == 1))
        assert metrics["steps"] == pytest.approx((steps + 1).mean())
        assert int(after.env_steps) == int(before.env_steps) + ENVS


def test_an_ended_env_starts_anew_and_no_other_does(walked: list[tuple[Any, Any, Any]]) -> None:
    started = set(walked[0][0].env_state.obs[:, 0].tolist())
    assert len(started) == ENVS, "every env of both devices begins with its own key"
    ends = 0
    for before, after, _ in walked:
        rows, obs = newest(before, after), after.env_state.obs
        over = rows.next_obs[:, 1] == 3
        np.testing.assert_array_equal(obs[~over], rows.next_obs[~over])
        np.testing.assert_array_equal(obs[over, 1], 0)
        new = obs[over, 0].tolist()
        assert not started & set(new), "a fresh walk is none that was walked before"
        assert len(set(new)) == len(new)
        started |= set(new)
        ends += over.sum()
    assert ends == 4 * ENVS


def test_both_kinds_of_end_occur(walked: list[tuple[Any, Any, Any]]) -> None:
    rows = jax.tree.map(lambda *x: np.concatenate(x), *(newest(b, a) for b, a, _ in walked))
    assert 0.2 < rows.terminated[rows.obs[:, 1] == 2].mean() < 0.8


def test_replay_is_shared_out_over_the_devices(walked: list[tuple[Any, Any, Any]]) -> None:
    _, after, _ = walked[-1]
    assert len(after.replay.data.action) == 3 * ENVS
    assert int(after.replay.size) == 3 * ENVS // 2
