"""Randomised envs in MJX, and what drives them: one compiled program serves all tests."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_balance.config import Config, RandomizationConfig, check, preset
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.task.observation import observation_names
from mjx_balance.task.randomization import Conditions

ENVS, EPISODE = 32, 50
RANDOM = RandomizationConfig(
    gyro_noise=0.002,
    accel_noise=0.023,
    payload=5.0,
    friction_min=0.4,
    friction_max=1.0,
    gain_spread=0.2,
    latency_share=0.5,
    push_min=0.05,
    push_max=0.1,
    push_period=2.5,
)
KICKED = np.asarray((13, 25, 38))
"""Decisions of an episode that begin with a kick: 2.5, 5 and 7.5 s, in decisions of 0.2 s."""
STAND = 220
"""The action that changes nothing: level 10 of 0 to 20 on both axes."""


class Fleet(NamedTuple):
    """`ENVS` envs of one config."""

    env: BalanceEnv
    reset: Callable[[jax.Array], Any]
    """Keys (ENVS, 2) -> state."""
    step: Callable[[Any, Any], Any]
    """State and actions (ENVS,) -> state: one decision."""
    program: str
    """The step as XLA is given it."""


def fleet_config() -> Config:
    """Episodes of 10 s; the lags reach back over all 50 samples of a decision."""
    default = preset("default")
    task = dataclasses.replace(
        default.task,
        gyro_lags=(0, 7, 20),
        accel_lags=(0, 3, 45),
        imu_mean=5,
        command_lags=(0, 2),
        episode_length=EPISODE,
    )
    return check(dataclasses.replace(default, task=task, randomization=RANDOM))


def make_fleet(engine: Literal["mjx", "mujoco"] = "mjx") -> Fleet:
    """Compiles reset and step."""
    env = BalanceEnv(dataclasses.replace(fleet_config(), engine=engine))
    reset = jax.jit(jax.vmap(env.reset))
    step = jax.jit(jax.vmap(env.step)).lower(reset(keys(0)), jnp.zeros(ENVS, int))
    return Fleet(env, reset, step.compile(), step.as_text())


def keys(seed: int) -> jax.Array:
    """One key per env."""
    return jax.random.split(jax.random.PRNGKey(seed), ENVS)


def nominal(count: int = ENVS) -> Conditions:
    """Circumstances that change nothing."""
    return Conditions(
        imu_noise=np.zeros((count, 6), np.float32),
        payload=np.zeros(count, np.float32),
        payload_at=np.zeros((count, 3), np.float32),
        friction=np.full(count, 0.8, np.float32),
        gain=np.ones(count, np.float32),
        latency=np.zeros(count, np.float32),
    )


def under(state: Any, conditions: Conditions) -> Any:
    """The same envs in other circumstances."""
    return state.replace(info=state.info | {"conditions": jax.tree.map(jnp.asarray, conditions)})


def level(state: Any) -> Any:
    """The same envs on boards that stay level."""
    scenario = state.info["scenario"]
    scenario = scenario._replace(targets=jnp.zeros_like(scenario.targets))
    return state.replace(info=state.info | {"scenario": scenario})


class Feedback:
    """Takes back what the observation's IMU samples say of tilt and rate, and fidgets.

    Both engines' robots are driven by it, each by its own observations: raising the left
    side rolls the body about +x, raising the front pitches it about -y.
    """

    def __init__(self, config: Config, robot: Any, decisions: int, count: int = ENVS):
        names = np.asarray(observation_names(config.task, robot))
        self.entries = [
            np.flatnonzero(np.char.startswith(names, prefix))[0]
            for prefix in ("Acc_y", "V_x", "Acc_x", "V_y")
        ]
        self.fidget = np.random.default_rng(3).integers(-2, 3, (decisions, count, 2))

    def __call__(self, obs: np.ndarray, decision: int) -> np.ndarray:
        """Action indices (n,) for observations (n, obs_size), in deg and deg/s."""
        roll, roll_rate, nose_up, pitch_rate = (np.asarray(obs)[:, k] for k in self.entries)
        back = -np.stack((0.5 * roll + 0.2 * roll_rate, 0.5 * nose_up - 0.2 * pitch_rate), axis=-1)
        millimetres = np.radians(back) * (142.0, 193.0)
        levels = np.rint(millimetres / 0.3).astype(int) + 10 + self.fidget[decision]
        levels = np.clip(levels, 0, 20)
        return levels[:, 0] * 21 + levels[:, 1]


def drive(
    fleet: Fleet, state: Any, act: Callable[[np.ndarray, int], np.ndarray], decisions: int
) -> list[Any]:
    """States on the way, the first included, `action` in the info of all but the first."""
    states = [jax.device_get(state)]
    for number in range(decisions):
        action = act(np.asarray(state.obs), number)
        state = fleet.step(state, jnp.asarray(action))
        seen = jax.device_get(state)
        states.append(seen.replace(info=seen.info | {"action": action}))
    return states


def walked(targets: np.ndarray, phase: float, rate: float, until: float) -> np.ndarray:
    """Where a board has walked to, deg, from level, one period after the other."""
    board, clock = np.zeros(2), until + phase
    for k, goal in enumerate(targets):
        spent = clock - 10 * k if k == len(targets) - 1 else min(clock - 10 * k, 10)
        board = board + np.clip(goal - board, -rate * max(spent, 0), rate * max(spent, 0))
    return board
