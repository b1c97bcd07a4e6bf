"""MuJoCo's C engine inside a jitted program, on the cores of a CPU.

Float64 and MuJoCo's own solver accuracy within a decision; between decisions the state is
float32, as in MJX. A call of the engine depends on its arguments alone.
"""

import collections
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np

from mjx_balance.sim.engines import ffi
from mjx_balance.sim.engines.engine import Engine, Motion, PhysicsState
from mjx_balance.sim.engines.mujoco import MujocoEngine, cores
from mjx_balance.sim.scene import Scene
from mjx_balance.task.randomization import Conditions

VARIED = ("payload", "payload_at", "friction", "gain")
"""Circumstances that change the model; the others are not the engine's."""


def mujoco_engine(scene: Scene) -> Engine:
    """Registers the engine with XLA.

    Every device has threads of its own: as many as this process has cores for each of its own.
    """
    devices = scene.config.num_devices
    threads = max(1, cores() // max(1, devices // jax.process_count())) if devices else cores()
    # The name stands for all that a call's results depend on: a program that was traced in another
    # process finds its engine by it.
    name = f"mjx_balance.{scene.hash}"
    engines = _Engines(scene, threads)
    ffi.register(name, engines.advance)

    def advance(
        state: PhysicsState, ctrl: jax.Array, conditions: Conditions | None
    ) -> tuple[PhysicsState, Motion]:
        varied = [] if conditions is None else [getattr(conditions, field) for field in VARIED]
        steps = len(ctrl)
        shapes = (*(x.shape for x in state), (steps, 6), (steps,))
        results = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
        call = jax.ffi.ffi_call(name, results, vmap_method="broadcast_all")
        arguments = [jnp.asarray(x, jnp.float32) for x in (*state, ctrl, *varied)]
        *moved, imu, tilt = call(*arguments)
        return PhysicsState(*moved), Motion(imu, tilt)

    return advance


class _Engines:
    """Owns as many C engines of a scene as are needed at once."""

    def __init__(self, scene: Scene, threads: int):
        """Each of them gets `threads` threads."""
        self.scene, self.threads = scene, threads
        self._free: dict[tuple[int, bool], list[_Varied]] = collections.defaultdict(list)
        self._lock = threading.Lock()

    def advance(self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
        """The host function: state, ctrl and circumstances -> state and motion.

        All arrays have the same leading axes (...), those of the envs.
        """
        batch = arguments[0].shape[:-1]
        count = int(np.prod(batch))
        *state, ctrl = (x.reshape(count, *x.shape[len(batch) :]) for x in arguments[:4])
        varied = [x.reshape(count, -1) for x in arguments[4:]]
        conditions = np.concatenate(varied, axis=1) if varied else None
        with self._borrowed(count, conditions) as engine:
            moved = engine.advance(state, ctrl, conditions)
        for result, value in zip(results, moved, strict=True):
            result.reshape(value.shape)[...] = value

    @contextmanager
    def _borrowed(self, count: int, conditions: np.ndarray | None) -> "Iterator[_Varied]":
        """An engine of that many envs that nobody else uses.

        The one that knows most of these circumstances already: that of the same device.
        """
        with self._lock:
            free = self._free[count, conditions is None]
            free.sort(key=lambda engine: -len(engine.changed(conditions)))
            engine = free.pop() if free else None
        engine = engine or _Varied(self.scene, count, self.threads)
        try:
            yield engine
        finally:
            with self._lock:
                free.append(engine)


class _Varied:
    """A C engine that remembers its envs' circumstances: from decision to decision few change."""

    def __init__(self, scene: Scene, count: int, threads: int):
        """Of `count` envs whose circumstances are not known yet."""
        self.engine = MujocoEngine(scene, count, threads=threads)
        self.conditions = np.full((count, 6), np.nan, np.float32)

    def changed(self, conditions: np.ndarray | None) -> np.ndarray:
        """Numbers of the envs whose circumstances (count, 6) are not those known."""
        if conditions is None:
            return np.arange(0)
        return np.flatnonzero((self.conditions != conditions).any(axis=1))

    def advance(
        self, state: Sequence[np.ndarray], ctrl: np.ndarray, conditions: np.ndarray | None
    ) -> tuple[np.ndarray, ...]:
        """State, ctrl (count, sim_steps, nu) -> state, IMU samples and tilt (count, ...)."""
        ids = self.changed(conditions)
        if conditions is not None and len(ids):
            new = conditions[ids]
            self.engine.vary(
                ids,
                Conditions(
                    imu_noise=np.zeros((len(ids), 6)),
                    payload=new[:, 0],
                    payload_at=new[:, 1:4],
                    friction=new[:, 4],
                    gain=new[:, 5],
                    latency=np.zeros(len(ids)),
                ),
            )
            self.conditions[ids] = new
        everyone = np.arange(len(self.conditions))
        self.engine.place(*state)
        motion = self.engine.advance(everyone, ctrl)
        # NaN, so that whoever diverged is seen to.
        tilt = np.where(motion.warned[:, None], np.nan, motion.tilt)
        return *self.engine.whole_state(), motion.imu, tilt
