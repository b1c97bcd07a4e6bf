"""Robots on boards in plain MuJoCo, each in an episode of training of its own. No JAX.

What `BalanceEnv` does for one board in a program, for n of them at once in NumPy.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_balance.config import Config, check
from mjx_balance.sim.engines.mujoco import Motion, MujocoEngine
from mjx_balance.sim.scene import Scene, load_scene
from mjx_balance.task import decision, tilt
from mjx_balance.task.pushes import Pushes, draw_kicks, kick, kicked_decisions
from mjx_balance.task.randomization import DRAWS, Conditions, draw_conditions


class Step(NamedTuple):
    """One decision of n boards."""

    obs: np.ndarray
    """(n, obs_size) float32."""
    reward: np.ndarray
    """(n,)"""
    tilt: np.ndarray
    """(n,) body tilt, mean over the decision, deg."""
    fell: np.ndarray
    """(n,) bool, whether the robot fell or its simulation diverged."""
    timed_out: np.ndarray
    """(n,) bool, whether a standing robot's time is up."""
    qpos: np.ndarray
    """(n, sim_steps, nq) after each physics step."""


class Taken(NamedTuple):
    """What came of a decision of n boards."""

    memory: decision.Memory
    motion: Motion
    samples: np.ndarray
    """(n, sim_steps, 6) of the IMU, noise included."""
    outcome: decision.Outcome
    """Whose simulation MuJoCo has warned of, has fallen."""


def take(
    engine: MujocoEngine,
    ids: np.ndarray,
    memory: decision.Memory,
    change: np.ndarray,
    late: np.ndarray | None,
    scenario: tilt.Scenario,
    now: np.ndarray,
    kicks: np.ndarray | None = None,
    noise: np.ndarray | None = None,
) -> Taken:
    """Takes one decision: `BalanceEnv.step` without its rewards and its clock.

    Args:
      engine: holds the boards.
      ids: (n,) of them.
      memory: from the last decision (n, ...).
      change: (n, 2) a_x and a_y of the actions, m.
      late: (n,) whether actions are taken one decision late; none: nowhere.
      scenario: where the boards go (n, ...).
      now: (n,) decisions since the start.
      kicks: (n, 2) m/s added to the trunks' velocities; none: no kick.
      noise: (n, sim_steps, 6) added to the IMU's samples; none: no noise.
    """
    scene = engine.scene
    task, robot = scene.config.task, scene.robot
    memory, targets = decision.controls(task, robot, memory, change, late, scenario, now)
    if kicks is not None:
        engine.push(ids, kicks)
    motion = engine.advance(ids, scene.ctrl(targets))
    samples = motion.imu if noise is None else motion.imu + noise
    # NaN, so that whoever diverged is seen to.
    tilts = np.where(motion.warned[:, None], np.nan, motion.tilt)
    angles = motion.qpos[:, -1, scene.leg_qpos]
    memory, outcome = decision.outcome(task, robot, memory, samples, tilts, angles)
    return Taken(memory, motion, samples, outcome)


class Boards:
    """Owns n episodes: physics, memories, scenarios and circumstances.

    Whose episode is over is not started again by `decide`.
    """

    def __init__(self, config: Config, count: int, threads: int | None = None):
        """Builds the scene.

        Args:
          config: task and randomisation.
          count: boards.
          threads: worker threads; all cores if none.

        Raises:
          ConfigError: if the config cannot be run.
        """
        self.config, self.count = check(config), count
        self.scene: Scene = load_scene(config)
        self._engine = MujocoEngine(self.scene, count, threads=threads)
        task, robot, stance = config.task, self.scene.robot, self.scene.stance
        self._all = np.arange(count)
        self._blank = decision.start(task, robot, stance.imu[None])
        angles = stance.qpos[None, self.scene.leg_qpos]
        obs = decision.observation(task, robot, self._blank, angles)
        self._first_obs = obs.astype(np.float32)
        self._memory = decision.Memory(*(np.repeat(x, count, axis=0) for x in self._blank))
        self._decisions = np.zeros(count, int)
        duration = task.episode_length * task.ctrl_dt
        targets = tilt.num_targets(task, duration)
        still = np.zeros((count, targets, 2)), np.zeros(count), np.zeros(count)
        self.scenario = tilt.Scenario(*still)
        self._rngs: list[np.random.Generator | None] = [None] * count
        ranges = config.randomization
        self._randomised = ranges.varies
        self.conditions: Conditions = draw_conditions(ranges, robot, np.zeros((count, DRAWS)))
        self._noisy = ranges.gyro_noise > 0 or ranges.accel_noise > 0
        at = kicked_decisions(task, ranges, duration)
        self.pushes = Pushes(np.zeros((count, len(at), 2)), at)

    def start(self, ids: np.ndarray, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        """Starts fresh episodes, settled on a level board.

        Args:
          ids: (n,) boards.
          rngs: of each of them, what its episode is drawn from, sensor noise included.

        Returns:
          Observations (n, obs_size), float32.
        """
        ranges = self.config.randomization
        drawn = [self._scenario(rng) for rng in rngs]
        _put(self.scenario, ids, tilt.Scenario(*map(np.stack, zip(*drawn, strict=True))))
        if self._randomised:
            uniform = np.stack([rng.uniform(size=DRAWS) for rng in rngs])
            conditions = draw_conditions(ranges, self.scene.robot, uniform)
            _put(self.conditions, ids, conditions)
            self._engine.vary(ids, conditions)
        if len(self.pushes.at):
            shape = self.pushes.kicks.shape[1:]
            uniform = np.stack([rng.uniform(size=shape) for rng in rngs])
            self.pushes.kicks[ids] = draw_kicks(ranges, uniform)
        _put(self._memory, ids, self._blank)
        self._decisions[ids] = 0
        self._engine.start(ids)
        for k, rng in zip(ids, rngs, strict=True):
            self._rngs[k] = rng
        return np.repeat(self._first_obs, len(ids), axis=0)

    def decide(self, change: np.ndarray) -> Step:
        """Takes one decision on every board.

        Args:
          change: (n, 2) a_x and a_y of the actions, m.
        """
        task, kicks, noise = self.config.task, None, None
        late = self.conditions.latency > 0 if self._randomised else None
        if len(self.pushes.at):
            kicks = kick(self.pushes, self._decisions[:, None])
        if self._noisy:
            drawn = [rng.normal(size=(task.sim_steps, 6)) for rng in self._rngs if rng is not None]
            noise = self.conditions.imu_noise[:, None] * np.stack(drawn)
        self._memory, motion, _, outcome = take(
            self._engine,
            self._all,
            self._memory,
            change,
            late,
            self.scenario,
            self._decisions,
            kicks,
            noise,
        )
        self._decisions += 1
        return Step(
            obs=outcome.obs.astype(np.float32),
            reward=sum(outcome.rewards.values(), np.zeros(self.count)),
            tilt=outcome.tilt.mean(axis=-1),
            fell=outcome.fell,
            timed_out=~outcome.fell & (self._decisions >= task.episode_length),
            qpos=motion.qpos,
        )

    @property
    def qpos(self) -> np.ndarray:
        """(n, nq) now."""
        return self._engine.state(self._all)[0]

    def _scenario(self, rng: np.random.Generator) -> tilt.Scenario:
        """One scenario of training, drawn as `BalanceEnv` draws its own."""
        count = self.scenario.targets.shape[1]
        return tilt.draw_scenario(
            self.config.task,
            disc=rng.uniform(size=(2, count)),
            square=rng.uniform(-1, 1, (count, 2)),
            which=rng.uniform(size=(count, 1)),
            phase=np.asarray(rng.uniform()),
        )


def _put(batch: tuple[np.ndarray, ...], ids: np.ndarray, rows: tuple[np.ndarray, ...]) -> None:
    """Writes rows `ids` of all arrays of a batch."""
    for array, values in zip(batch, rows, strict=True):
        array[ids] = values
