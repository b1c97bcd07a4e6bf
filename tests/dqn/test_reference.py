"""The DQN against a second one in NumPy, parameter by parameter, and its rows against their env.

A device whose ring holds a single row trains on that row alone, whatever it draws: each update
of the parameters can then be computed by hand from the rows.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest
from fixtures import probes

from mjx_balance.config import DQNConfig
from mjx_balance.dqn import DQN, DQNSpec, QNetwork

BETA_1, BETA_2, TINY = 0.9, 0.999, 1e-8
RECENCY = 4.0
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
    "Eq. 1": (1, {}),
    "Double DQN, clipped, whitened": (
        2,
        {"double": True, "max_grad_norm": 0.3, "whiten_steps": 14, "whiten_floor": 0.05},
    ),
}
"""Devices, and fields of the config."""
Layers = dict[str, dict[str, np.ndarray]]


@dataclasses.dataclass
class Reference:
    """Follows a DQN's rows; `params` are what its parameters should be."""

    config: DQNConfig
    params: Layers
    total_steps: int

    def __post_init__(self) -> None:
        size = len(self.params["hidden_0"]["kernel"])
        self.first = self.second = jax.tree.map(np.zeros_like, self.params)
        self.steps = 0
        self.mean, self.covariance, self.batches = np.zeros(size), np.eye(size), 0
        self.copy()

    def observe(self, obs: np.ndarray, env_steps: int) -> None:
        """Adds observations (n, obs_size) to the statistics, before `whiten_steps`."""
        if env_steps >= self.config.whiten_steps:
            return
        weight = RECENCY / (self.batches + RECENCY)
        away = obs.mean(axis=0) - self.mean
        spread = np.atleast_2d(np.cov(obs.T, bias=True)) + (1 - weight) * np.outer(away, away)
        self.covariance = (1 - weight) * self.covariance + weight * spread
        self.mean = self.mean + weight * away
        self.batches += 1

    def copy(self) -> None:
        """The target is a copy of the network as it is now, its whitening included."""
        self.target, self.target_moments = self.params, (self.mean, self.covariance)

    def white(self, obs: np.ndarray, moments: Any = None) -> np.ndarray:
        """Observations as the network takes them."""
        if not self.config.whiten_steps:
            return obs
        mean, covariance = moments or (self.mean, self.covariance)
        values, vectors = np.linalg.eigh(covariance)
        scale = np.diag((values + self.config.whiten_floor) ** -0.5)
        return (obs - mean) @ vectors @ scale @ vectors.T

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Greedy actions (n,) for observations (n, obs_size)."""
        return forward(self.params, self.white(obs))[1].argmax(axis=1)

    def update(self, rows: Any) -> float:
        """One gradient step on rows (n, ...) of which each counts the same; returns the loss."""
        config, count = self.config, len(rows.action)
        each = np.arange(count)
        _, q_t = forward(self.target, self.white(rows.next_obs, self.target_moments))
        selector = forward(self.params, self.white(rows.next_obs))[1] if config.double else q_t
        best = q_t[each, selector.argmax(axis=1)]
        target = rows.reward + config.gamma * np.where(rows.terminated, 0.0, best)
        obs = self.white(rows.obs)
        hidden, q_tm1 = forward(self.params, obs)
        error = q_tm1[each, rows.action] - target
        by_output = np.zeros((count, 2))
        by_output[each, rows.action] = 2 * error / count
        by_hidden = by_output @ self.params["head"]["kernel"].T * (hidden > 0)
        self.descend(
            {
                "hidden_0": {"kernel": obs.T @ by_hidden, "bias": by_hidden.sum(axis=0)},
                "head": {"kernel": hidden.T @ by_output, "bias": by_output.sum(axis=0)},
            }
        )
        if self.steps % config.target_update_period == 0:
            self.copy()
        return float(np.mean(error**2))

    def descend(self, grads: Layers) -> None:
        """Adam (Kingma & Ba 2015, algorithm 1) on the clipped gradient."""
        norm = np.sqrt(sum((g**2).sum() for g in jax.tree.leaves(grads)))
        grads = jax.tree.map(lambda g: min(1.0, self.config.max_grad_norm / norm) * g, grads)
        start = self.config.learning_rate
        end = start * self.config.learning_rate_end_share
        done = min(self.steps / self.total_steps, 1.0)
        rate = end + (start - end) * (1 + np.cos(np.pi * done)) / 2
        self.steps += 1
        bias_1, bias_2 = 1 - BETA_1**self.steps, 1 - BETA_2**self.steps
        tree_map = jax.tree.map
        self.first = tree_map(lambda m, g: BETA_1 * m + (1 - BETA_1) * g, self.first, grads)
        self.second = tree_map(lambda v, g: BETA_2 * v + (1 - BETA_2) * g**2, self.second, grads)
        self.params = tree_map(
            lambda x, m, v: x - rate * (m / bias_1) / (np.sqrt(v / bias_2) + TINY),
            *(self.params, self.first, self.second),
        )


def forward(layers: Layers, obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Hidden units, and action values (n, num_actions)."""
    hidden = np.maximum(obs @ layers["hidden_0"]["kernel"] + layers["hidden_0"]["bias"], 0)
    return hidden, hidden @ layers["head"]["kernel"] + layers["head"]["bias"]


@pytest.mark.parametrize(("devices", "changes"), CASES.values(), ids=CASES)
def test_parameters_are_those_of_a_second_implementation(
    devices: int, changes: dict[str, Any]
) -> None:
    """Three iterations beyond the schedule's end, from one row per device."""
    sizes = dict.fromkeys(("batch_size", "replay_capacity", "min_replay_size"), devices)
    config = dataclasses.replace(CONFIG, **sizes, **changes)
    total = ITERATIONS * devices - devices // 2  # the last iteration counts whole
    spec = DQNSpec(config, devices, total, devices=jax.devices()[:devices])
    dqn = DQN(probes.Turn(), QNetwork(config.hidden_sizes, (2,)), spec)
    program, state = dqn.train_program(1), dqn.init(5)
    params = jax.tree.map(lambda x: np.asarray(x, np.float64), state.params["params"])
    reference = Reference(config, params, ITERATIONS * UPDATES)
    for k in range(ITERATIONS + 3):
        obs = np.array(state.env_state.obs, float)
        reference.observe(obs, k * devices)
        state, metrics = program(state)
        rows = jax.device_get(state.replay.data)
        if k * devices >= 20:  # nothing is random any more
            np.testing.assert_array_equal(rows.action, reference.act(obs))
        losses = [reference.update(rows) for _ in range(UPDATES)]
        assert metrics["loss"] == pytest.approx(np.mean(losses), rel=2e-3, abs=1e-6), k
        assert metrics["epsilon"] == pytest.approx(1 - min(k * devices / 20, 1), abs=1e-5)
        assert metrics["reward"] == pytest.approx(rows.reward.mean(), rel=1e-5)
        assert int(state.gradient_steps) == reference.steps
        for layer, expected in reference.params.items():
            for name, x in expected.items():
                got = state.params["params"][layer][name]
                np.testing.assert_allclose(got, x, rtol=2e-3, atol=2e-4, err_msg=f"{layer} {name}")
        assert devices == 1 or np.ptp(rows.obs, axis=0).max() > 0.01, "two devices, two rows"


ENVS = 8
Walked = list[tuple[Any, Any, Any]]


@pytest.fixture(scope="module")
def walked() -> Walked:
    """State before, state after and metrics of 12 single iterations of Walk, no learning."""
    config = dataclasses.replace(
        CONFIG,
        batch_size=2,
        replay_ratio=UPDATES * 2 / ENVS,
        replay_capacity=3 * ENVS,
        epsilon_decay_steps=10_000,
    )
    dqn = DQN(probes.Walk(), QNetwork((5,), (2,)), DQNSpec(config, ENVS, 96))
    iterations = []
    with pytest.MonkeyPatch.context() as patch:  # no updates to compile
        patch.setattr(DQN, "learn", lambda self, state, *_: (state, {}))
        program, state = dqn.train_program(1), dqn.init(0)
        for _ in range(12):
            before = jax.device_get(state)
            state, metrics = program(state)
            iterations.append((before, jax.device_get(state), jax.device_get(metrics)))
    return iterations


def newest(before: Any, after: Any) -> Any:
    """The rows (ENVS, ...) that an iteration stored, in the order of the envs."""

    def pick(ring: np.ndarray) -> np.ndarray:
        parts = np.split(ring, 2)
        return np.concatenate([x[before.replay.position :][: ENVS // 2] for x in parts])

    return jax.tree.map(pick, after.replay.data)


def test_rows_are_what_the_envs_did(walked: Walked) -> None:
    """Every row belongs to its env; next_obs is the one before the reset."""
    ends, actions = [], []
    for before, after, metrics in walked:
        rows = newest(before, after)
        np.testing.assert_array_equal(rows.obs, before.env_state.obs)
        walk, steps = rows.obs.T
        np.testing.assert_array_equal(rows.next_obs, np.stack((walk, steps + 1), axis=1))
        np.testing.assert_allclose(rows.reward, 10 * walk + steps + rows.action / 2, rtol=1e-6)
        np.testing.assert_array_equal(rows.terminated, (steps == 2) & (rows.action == 1))
        ends += rows.terminated[steps == 2].tolist()
        actions.append(rows.action)
        assert metrics["steps"] == pytest.approx((steps + 1).mean())
        assert int(after.env_steps) == int(before.env_steps) + ENVS
    assert 0.2 < np.mean(ends) < 0.8, "terminations and time-outs"
    assert len(np.unique(actions, axis=1).T) == ENVS, "every env of both devices draws its own"
    last = walked[-1][1].replay
    assert len(last.data.action) == 3 * ENVS
    assert int(last.size) == 3 * ENVS // 2, "each device counts its own"


def test_an_ended_env_starts_anew_and_no_other_does(walked: Walked) -> None:
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
