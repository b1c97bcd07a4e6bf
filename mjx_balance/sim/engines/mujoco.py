"""MuJoCo's C engine: advances many scenarios by one decision, on all cores. No JAX.

Runs as MuJoCo ships it: float64, default solver accuracy.
"""

import os
from typing import NamedTuple

import numpy as np
from mujoco.batch import Batch

from mjx_balance.sim.domain_randomization import model_fields
from mjx_balance.sim.scene import Scene
from mjx_balance.task.attitude import body_tilt
from mjx_balance.task.randomization import Conditions


def cores() -> int:
    """CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Motion(NamedTuple):
    """What happened in one decision of n scenarios."""

    qpos: np.ndarray
    """(n, sim_steps, nq) after each step."""
    imu: np.ndarray
    """(n, sim_steps, 6) gyro in rad/s and accelerometer in m/s^2, before each step."""
    tilt: np.ndarray
    """(n, sim_steps) body tilt after each step, deg."""
    warned: np.ndarray
    """(n,) whether MuJoCo has warned of a diverging simulation."""


class MujocoEngine:
    """A batch of scenarios of one scene, from the settled stance on; owns their states."""

    def __init__(
        self,
        scene: Scene,
        count: int,
        conditions: Conditions | None = None,
        threads: int | None = None,
    ):
        """Puts `count` robots on their boards.

        Args:
          scene: model and stance.
          count: scenarios.
          conditions: of each of them (count,); nominal if none.
          threads: worker threads; all cores if none.
        """
        self.scene = scene
        self._batch = Batch(scene.model, count, threads or cores())
        if conditions is not None:
            self.vary(np.arange(count), conditions)
        self.start(np.arange(count))

    def start(self, ids: np.ndarray) -> None:
        """Puts scenarios `ids` (n,) back into the settled stance."""
        stance = self.scene.stance
        self._batch.qpos[ids], self._batch.qvel[ids] = stance.qpos, stance.qvel
        self._batch.qacc_warmstart[ids] = stance.qacc_warmstart
        self._batch.warning[ids] = 0

    def vary(self, ids: np.ndarray, conditions: Conditions) -> None:
        """Puts scenarios `ids` (n,) into other circumstances (n,)."""
        for name, values in model_fields(self.scene, conditions).items():
            self._batch.expand(name)[ids] = values
        self._batch.set_const(ids)

    def place(self, qpos: np.ndarray, qvel: np.ndarray, qacc_warmstart: np.ndarray) -> None:
        """Puts all scenarios into states (count, nq), (count, nv), (count, nv), or into one."""
        self._batch.qpos, self._batch.qvel = qpos, qvel
        self._batch.qacc_warmstart = qacc_warmstart
        self._batch.warning[...] = 0

    def whole_state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What `place` takes, of all scenarios."""
        return self._batch.qpos, self._batch.qvel, self._batch.qacc_warmstart

    def state(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (n, nq) and velocities (n, nv) of scenarios `ids` (n,)."""
        return self._batch.qpos[ids], self._batch.qvel[ids]

    def push(self, ids: np.ndarray, kick: np.ndarray) -> None:
        """Adds (n, 2) m/s along x and y to the velocity of the trunks of scenarios `ids` (n,)."""
        self._batch.qvel[ids[:, None], self.scene.trunk_velocity] += kick

    def advance(self, ids: np.ndarray, ctrl: np.ndarray) -> Motion:
        """Moves scenarios `ids` (n,) through servo targets (n, sim_steps, nu), rad."""
        out = self._batch.rollout(ctrl.shape[1], ctrl, record=("qpos", "sensordata"), ids=ids)
        warned = np.any(np.reshape(self._batch.warning[ids], (len(ids), -1)), axis=-1)
        tilt = body_tilt(out["qpos"][..., self.scene.trunk_quat])
        return Motion(out["qpos"], out["sensordata"][..., self.scene.imu], tilt, np.asarray(warned))
