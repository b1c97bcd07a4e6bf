"""MuJoCo's C engine as it ships: many envs, on all cores, in float64. No JAX."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from mujoco.batch import Batch

from mjx_balance.machine import cores
from mjx_balance.sim.domain_randomization import MODEL_PARAMS, randomized_fields
from mjx_balance.sim.measurement import RECORDED, measure
from mjx_balance.sim.scene import Scene
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.step import Motion, Targets

Ids = Int[np.ndarray, " n"]  #: envs of a batch


class MujocoEngine:
    """`task.step.Engine` over a batch of envs, whose states it owns; `physics` are their ids."""

    def __init__(self, scene: Scene, count: int, threads: int | None = None):
        """Puts `count` robots into the settled stance; `threads` None: all cores."""
        self.scene = scene
        self.recorded: dict[str, np.ndarray] = {}  #: (n, sim_steps, ...) of the last decision
        self._size = count, threads or cores()
        self._batch = Batch(scene.model, *self._size)
        # Payload and its place, friction of every foot, gain of every servo, softness.
        self._params = np.full((count, 5 + 4 * len(scene.leg_ctrl)), np.nan)
        self.reset(np.arange(count))

    def __getstate__(self) -> dict[str, Any]:
        """What a copy or another process needs to go on: `Batch` itself cannot be pickled."""
        batch = *map(np.copy, self.state()), self._batch.warning.copy()
        # Models are randomised again by the next decision.
        return vars(self) | {"_batch": batch, "_params": np.full_like(self._params, np.nan)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        *physics, warning = state["_batch"]
        vars(self).update(state)
        self._batch = Batch(self.scene.model, *self._size)
        self.set_state(*physics)
        self._batch.warning[...] = warning

    def reset(self, ids: Ids, qpos: Float[np.ndarray, "*n nq"] | None = None) -> None:
        """Puts envs to rest in the settled stance, or elsewhere."""
        stance = self.scene.stance
        self._batch.qpos[ids] = stance.qpos if qpos is None else qpos
        self._batch.qvel[ids] = stance.qvel
        self._batch.qacc_warmstart[ids] = stance.qacc_warmstart
        self._batch.warning[ids] = 0

    def set_state(self, qpos: np.ndarray, qvel: np.ndarray, qacc_warmstart: np.ndarray) -> None:
        """Puts all envs into states (count, nq), (count, nv), (count, nv)."""
        self._batch.qpos, self._batch.qvel = qpos, qvel
        self._batch.qacc_warmstart = qacc_warmstart
        self._batch.warning[...] = 0

    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What `set_state` takes, of all envs."""
        return self._batch.qpos, self._batch.qvel, self._batch.qacc_warmstart

    def push(self, physics: Ids, velocity: Float[np.ndarray, "n 2"]) -> Ids:
        """Adds m/s along the world's x and y to the trunks' velocity."""
        self._batch.qvel[physics[:, None], self.scene.trunk_velocity] += velocity
        return physics

    def advance(
        self, physics: Ids, targets: Targets, params: DomainParams | None
    ) -> tuple[Ids, Motion]:
        """Moves envs by one decision. An env that has had `params` always needs some."""
        return physics, self.roll(physics, self.scene.ctrl(targets, params), params)

    def roll(
        self, ids: Ids, ctrl: Float[np.ndarray, "n sim_steps nu"], params: DomainParams | None
    ) -> Motion:
        """`advance` for servo targets in the model's order, rad."""
        if params is not None:
            self._randomize(ids, params)
        out = self._batch.rollout(ctrl.shape[1], ctrl, record=RECORDED, ids=ids)
        self.recorded = {name: out[name] for name in RECORDED}
        warned = np.any(np.reshape(self._batch.warning[ids], (len(ids), -1)), axis=-1)
        motion = measure(self.scene, **self.recorded)
        if warned.any():
            for values in motion:
                values[warned] = np.nan
        return motion

    def changed(self, ids: Ids, params: DomainParams) -> Bool[np.ndarray, " n"]:
        """Whether the model of envs has other parameters than `params`."""
        return (self._params[ids] != _columns(params)).any(axis=1)

    def _randomize(self, ids: Ids, params: DomainParams) -> None:
        """Gives envs their parameters; from decision to decision few change."""
        changed = self.changed(ids, params)
        if not changed.any():
            return
        ids, params = ids[changed], DomainParams(*(x[changed] for x in params))
        for name, values in randomized_fields(self.scene, params).items():
            self._batch.expand(name)[ids] = values
        self._batch.set_const(ids)
        self._params[ids] = _columns(params)


def _columns(params: DomainParams) -> Float[np.ndarray, "n values"]:
    """Those that change the model."""
    count = len(params.payload)
    values = [np.reshape(getattr(params, name), (count, -1)) for name in MODEL_PARAMS]
    return np.concatenate(values, axis=1)
