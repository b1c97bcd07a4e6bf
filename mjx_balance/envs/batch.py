"""`BatchEnv`: many envs in plain MuJoCo and NumPy, the counterpart of `BalanceEnv`. No JAX."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int

from mjx_balance.config import RandomizationConfig, TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.sim.engines.mujoco import MujocoEngine
from mjx_balance.sim.scene import Scene
from mjx_balance.task import events
from mjx_balance.task.pushes import Pushes, draw_velocity, push_decisions
from mjx_balance.task.randomization import DomainParams, draw_params, param_draws
from mjx_balance.task.sensors import (
    SensorErrors,
    count_draws,
    draw_decision,
    draw_errors,
    joint_readings,
)
from mjx_balance.task.step import EnvState, Outcome, initial_memory, observation, step
from mjx_balance.task.tilt import Scenario, draw_scenario, numpy_uniform

T = TypeVar("T")


class Episodes(NamedTuple):
    """Scenarios and random numbers of n episodes; n is the leading axis of all arrays."""

    scenario: Scenario  #: where the boards go
    params: DomainParams | None = None  #: None: nominal
    pushes: Pushes | None = None  #: None: no pushes
    rngs: Sequence[np.random.Generator] = ()  #: of each episode, for its sensors
    errors: SensorErrors | None = None  #: None: sensors are right, but for noise
    event: events.Event | None = None  #: None: nothing changes in the middle of an episode


def draw_episodes(
    task: TaskConfig,
    ranges: RandomizationConfig,
    robot: Robot,
    rngs: Sequence[np.random.Generator],
) -> Episodes:
    """Draws episodes of training, each from its own generator, as `BalanceEnv` draws its own.

    Args:
      task: of the scenarios.
      ranges: of domain parameters and pushes.
      robot: the nominal friction.
      rngs: of each episode; the noise of its sensors comes from it, too.
    """
    due = push_decisions(task, ranges, task.episode_length * task.ctrl_dt)
    params, pushes, errors = None, None, None
    scenarios = [draw_scenario(task, numpy_uniform(rng)) for rng in rngs]
    if ranges.varies:
        count = param_draws(ranges)
        params = draw_params(ranges, robot, np.stack([rng.uniform(size=count) for rng in rngs]))
    if len(due):
        uniform = np.stack([rng.uniform(size=(len(due), 2)) for rng in rngs])
        pushes = Pushes(draw_velocity(ranges, uniform), np.tile(due, (len(rngs), 1)))
    if ranges.sensors_err:
        count = count_draws(robot)
        errors = draw_errors(ranges, robot, np.stack([rng.uniform(size=count) for rng in rngs]))
    event = events.sample_event(
        *(ranges, robot, params, task.episode_length),
        lambda count: np.stack([rng.uniform(size=count) for rng in rngs]),
    )
    return Episodes(stacked(scenarios), params, pushes, rngs, errors, event)


class BatchEnv:
    """n envs of one scene. `step` resets none of them."""

    def __init__(self, scene: Scene, episodes: Episodes, threads: int | None = None):
        """Starts all envs, robots settled on their boards, with worker threads; None: all cores."""
        self.scene, self.task = scene, scene.task
        self.num_envs = len(episodes.scenario.phase)
        self._engine = MujocoEngine(scene, self.num_envs, threads)
        self.state = self._initial(np.arange(self.num_envs), episodes)
        self._rngs = list(episodes.rngs)
        self.initial_obs = self._observe_start(self.state)
        """(n, obs_size) at the start of the episodes."""

    def reset(self, ids: Int[np.ndarray, " k"], episodes: Episodes) -> None:
        """Restarts envs `ids`; fields that are None must be None in the first episodes, too."""
        start = self._initial(ids, episodes)
        _set_rows(self.state, ids, start)
        self.initial_obs[ids] = self._observe_start(start)
        for k, rng in zip(ids, episodes.rngs, strict=True):
            self._rngs[k] = rng

    def _initial(self, ids: np.ndarray, episodes: Episodes) -> EnvState:
        """The state in which envs `ids` start; puts the engine there."""
        start, count = self.scene.start(episodes.scenario.start), len(ids)
        still, tilt = np.broadcast_to(start.imu, (count, 6)), np.broadcast_to(start.tilt, count)
        self._engine.reset(ids, start.qpos)
        memory = initial_memory(self.task, self.scene.robot, still, tilt, episodes.errors)
        env_steps = np.zeros(len(ids), int)
        scenario, params, pushes, _, errors, event = episodes
        state = EnvState(ids, memory, scenario, env_steps, params, pushes, errors, event)
        return _tree_map(np.array, state)  # a copy, which may be written to

    def _observe_start(self, state: EnvState) -> np.ndarray:
        angles = self.scene.stance.qpos[self.scene.leg_qpos]
        angles = np.tile(angles, (len(state.env_steps), 1, 1))
        if state.errors is not None:
            angles = joint_readings(state.errors, angles)
        return observation(self.task, self.scene.robot, state.memory, angles)

    def step(
        self, change: Float[np.ndarray, "k 2"], ids: Int[np.ndarray, " k"] | None = None
    ) -> Outcome:
        """Takes one decision, in envs `ids` or all; `change` is a_x and a_y of the actions, m."""
        before = self.state if ids is None else rows(self.state, ids)
        envs: np.ndarray = before.physics
        draws, params = None, before.params
        if params is not None and (params.imu_noise.any() or before.errors is not None):
            rngs = [self._rngs[k] for k in envs]
            draws = draw_decision(
                self.task,
                before.errors,
                lambda shape: np.stack([rng.normal(size=shape) for rng in rngs]),
                lambda shape: np.stack([rng.uniform(size=shape) for rng in rngs]),
            )
        after, outcome = step(self.task, self.scene.robot, self._engine, before, change, draws)
        _set_rows(self.state.memory, envs, after.memory)
        self.state.env_steps[envs] = after.env_steps
        return outcome

    @property
    def path(self) -> Float[np.ndarray, "k sim_steps nq"]:
        """States after each physics step of the last decision, of its envs."""
        return self._engine.recorded["qpos"]

    @property
    def qpos(self) -> Float[np.ndarray, "n nq"]:
        """Positions now."""
        return self._engine.state()[0]

    @property
    def qvel(self) -> Float[np.ndarray, "n nv"]:
        """Velocities now."""
        return self._engine.state()[1]


def stacked(trees: Sequence[T]) -> T:
    """One nested tuple of arrays from several alike, along a new first axis."""
    return _tree_map(lambda *leaves: np.stack(leaves), *trees)


def rows(tree: Any, ids: np.ndarray) -> Any:
    """Rows `ids` of all arrays of nested tuples."""
    return _tree_map(lambda x: x[ids], tree)


def _set_rows(tree: Any, ids: np.ndarray, values: Any) -> None:
    """Writes rows `ids` of all arrays of nested tuples."""
    _tree_map(lambda part, value: part.__setitem__(ids, value), tree, values)


def _tree_map(function: Callable[..., Any], tree: Any, *rest: Any) -> Any:
    """`jax.tree.map` of nested tuples, without JAX."""
    if tree is None:
        return None
    if isinstance(tree, tuple):
        parts = zip(tree, *rest, strict=True)
        return type(tree)(*(_tree_map(function, *part) for part in parts))
    return function(tree, *rest)
