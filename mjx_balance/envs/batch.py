"""`BatchEnv`: many envs in plain MuJoCo, in NumPy. Evaluation, Gymnasium and the viewer run on it.

No JAX. `BalanceEnv` takes the same decisions for one env inside a jitted program.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_balance.config import Config
from mjx_balance.robots.catalogue import Robot
from mjx_balance.sim.engines.mujoco import MujocoEngine
from mjx_balance.sim.scene import Scene
from mjx_balance.task import tilt
from mjx_balance.task.pushes import Pushes, draw_velocity, push_decisions
from mjx_balance.task.randomization import DRAWS, DomainParams, draw_params
from mjx_balance.task.step import EnvState, Outcome, initial_memory, observation, step


class Episodes(NamedTuple):
    """What n episodes consist of, besides a robot and its actions."""

    scenario: tilt.Scenario
    """Where the boards go, (n, ...) per field."""
    params: DomainParams | None = None
    """(n, ...) per field; None: nominal."""
    pushes: Pushes | None = None
    """(n, ...) per field; None: no pushes."""
    rngs: Sequence[np.random.Generator] = ()
    """Of each episode, for its sensor noise; needed where `params` has some."""


def draw_episodes(config: Config, robot: Robot, rngs: Sequence[np.random.Generator]) -> Episodes:
    """Draws episodes of training, each from its own generator, as `BalanceEnv` draws its own.

    Args:
      config: task and randomisation.
      robot: the nominal friction.
      rngs: of each episode; its sensor noise comes from it, too.
    """
    task, ranges = config.task, config.randomization
    due = push_decisions(task, ranges, task.episode_length * task.ctrl_dt)
    params, pushes = None, None

    def scenario(rng: np.random.Generator) -> tilt.Scenario:
        return tilt.draw_scenario(
            task, lambda shape, low, high: np.asarray(rng.uniform(low, high, shape))
        )

    scenarios = [scenario(rng) for rng in rngs]
    if ranges.varies:
        params = draw_params(ranges, robot, np.stack([rng.uniform(size=DRAWS) for rng in rngs]))
    if len(due):
        uniform = np.stack([rng.uniform(size=(len(due), 2)) for rng in rngs])
        pushes = Pushes(draw_velocity(ranges, uniform), np.tile(due, (len(rngs), 1)))
    return Episodes(
        tilt.Scenario(*map(np.stack, zip(*scenarios, strict=True))), params, pushes, rngs
    )


class BatchEnv:
    """n envs of one scene. `step` resets none of them."""

    def __init__(self, scene: Scene, episodes: Episodes, threads: int | None = None):
        """Starts all envs: robots settled on level boards.

        Args:
          scene: model, stance and task.
          episodes: of each env.
          threads: worker threads; None: all cores.
        """
        self.scene, self.task = scene, scene.config.task
        self.num_envs = len(episodes.scenario.phase)
        self._engine = MujocoEngine(scene, self.num_envs, threads)
        self.state = self._initial(np.arange(self.num_envs), episodes)
        self._rngs = list(episodes.rngs)
        angles = np.tile(scene.stance.qpos[scene.leg_qpos], (self.num_envs, 1, 1))
        self.initial_obs = observation(self.task, scene.robot, self.state.memory, angles)
        """(n, obs_size) of robots that have just been reset."""

    def reset(self, ids: np.ndarray, episodes: Episodes) -> None:
        """Starts envs `ids` (n,) anew with episodes (n,) that have what the first ones had."""
        _set_rows(self.state, ids, self._initial(ids, episodes))
        self._engine.reset(ids)
        for k, rng in zip(ids, episodes.rngs, strict=True):
            self._rngs[k] = rng

    def _initial(self, ids: np.ndarray, episodes: Episodes) -> EnvState:
        still = np.tile(self.scene.stance.imu, (len(ids), 1))
        state = EnvState(
            physics=ids,
            memory=initial_memory(self.task, self.scene.robot, still),
            scenario=episodes.scenario,
            env_steps=np.zeros(len(ids), int),
            params=episodes.params,
            pushes=episodes.pushes,
        )
        return _mapped(np.array, state)  # a copy, which may be written to

    def step(self, change: np.ndarray, ids: np.ndarray | None = None) -> Outcome:
        """Takes one decision.

        Args:
          change: (n, 2) a_x and a_y of the actions, m.
          ids: (n,) envs that take it; None: all.

        Returns:
          The outcome (n, ...).
        """
        ids = np.arange(self.num_envs) if ids is None else ids
        before = rows(self.state, ids)
        noise, params = None, before.params
        if params is not None and params.imu_noise.any():
            shape = (self.task.sim_steps, params.imu_noise.shape[-1])
            noise = np.stack([self._rngs[k].normal(size=shape) for k in ids])
        after, outcome = step(self.task, self.scene.robot, self._engine, before, change, noise)
        _set_rows(self.state.memory, ids, after.memory)
        self.state.env_steps[ids] = after.env_steps
        return outcome

    @property
    def path(self) -> np.ndarray:
        """(n, sim_steps, nq) after each physics step of the last decision, of its envs."""
        return self._engine.recorded["qpos"]

    @property
    def qpos(self) -> np.ndarray:
        """(num_envs, nq) now."""
        return self._engine.state()[0]

    @property
    def qvel(self) -> np.ndarray:
        """(num_envs, nv) now."""
        return self._engine.state()[1]


def rows(tree: Any, ids: np.ndarray) -> Any:
    """Rows `ids` of all arrays of nested tuples."""
    return _mapped(lambda x: x[ids], tree)


def _mapped(function: Callable[[np.ndarray], np.ndarray], tree: Any) -> Any:
    """`jax.tree.map` of nested tuples, without JAX."""
    if tree is None:
        return None
    if isinstance(tree, tuple):
        return type(tree)(*(_mapped(function, part) for part in tree))
    return function(tree)


def _set_rows(batch: Any, ids: np.ndarray, values: Any) -> None:
    """Writes rows `ids` of all arrays of nested tuples."""
    if isinstance(batch, tuple):
        for part, part_values in zip(batch, values, strict=True):
            _set_rows(part, ids, part_values)
    elif batch is not None:
        batch[ids] = values
