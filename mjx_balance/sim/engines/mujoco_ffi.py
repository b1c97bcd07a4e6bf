"""MuJoCo's C engine inside a jitted program, on the cores of a CPU.

Float64 and MuJoCo's own solver accuracy within a decision; between decisions the state is
float32, as in MJX. A call of the engine depends on its arguments alone.
"""

import collections
import functools
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_balance.machine import cores
from mjx_balance.sim.domain_randomization import MODEL_PARAMS
from mjx_balance.sim.engines import ffi
from mjx_balance.sim.engines.jax_engine import JaxEngine, PhysicsState
from mjx_balance.sim.engines.mujoco import MujocoEngine
from mjx_balance.sim.engines.table import Options
from mjx_balance.sim.measurement import RECORDED, measure
from mjx_balance.sim.scene import Scene
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.step import Motion


def mujoco_engine(scene: Scene, options: Options) -> JaxEngine:
    """Registers the engine with XLA.

    Every device has threads of its own: as many as this process has cores for each of its own.
    """
    devices = options.num_devices
    threads = max(1, cores() // max(1, devices // jax.process_count())) if devices else cores()
    # A program that was traced in another process finds its engine by this name.
    name = f"mjx_balance.{scene.hash}.{threads}"
    ffi.register(name, _Pool(scene, threads).advance)
    data = mujoco.MjData(scene.model)

    def physics(
        state: PhysicsState, ctrl: jax.Array, params: DomainParams | None
    ) -> tuple[PhysicsState, Motion]:
        varied = [] if params is None else [getattr(params, field) for field in MODEL_PARAMS]
        recorded = {
            field: jax.ShapeDtypeStruct((len(ctrl), *getattr(data, field).shape), jnp.float32)
            for field in RECORDED
        }
        motion = jax.eval_shape(functools.partial(measure, scene), **recorded)
        shapes = [x.shape for x in (*state, *motion)]
        results = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
        call = jax.ffi.ffi_call(name, results, vmap_method="broadcast_all")
        values = call(*(jnp.asarray(x, jnp.float32) for x in (*state, ctrl, *varied)))
        return PhysicsState(*values[: len(state)]), Motion(*values[len(state) :])

    return JaxEngine(scene, physics)


class _Pool:
    """Owns as many C engines of a scene, each of `threads` threads, as are needed at once."""

    def __init__(self, scene: Scene, threads: int):
        self.scene, self.threads = scene, threads
        self._free: dict[tuple[int, bool], list[MujocoEngine]] = collections.defaultdict(list)
        self._lock = threading.Lock()

    def advance(self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
        """The host function: state, ctrl and parameters -> state and motion, of envs (...)."""
        batch = arguments[0].shape[:-1]
        count = int(np.prod(batch))
        flat = [x.reshape(count, *x.shape[len(batch) :]) for x in arguments]
        state, ctrl, params = flat[:3], flat[3], _params(flat[4:])
        with self._borrowed(count, params) as engine:
            engine.set_state(*state)
            motion = engine.roll(np.arange(count), ctrl, params)
            # Here, because the state is memory of the engine, which the next borrower overwrites.
            with np.errstate(over="ignore"):  # beyond float32, a diverged env's value is inf
                for result, value in zip(results, (*engine.state(), *motion), strict=True):
                    result.reshape(value.shape)[...] = value

    @contextmanager
    def _borrowed(self, count: int, params: DomainParams | None) -> Iterator[MujocoEngine]:
        """A free engine of that many envs, whose models differ least from these parameters."""
        everyone = np.arange(count)
        with self._lock:
            free = self._free[count, params is None]
            if params is not None:
                free.sort(key=lambda engine: -int(engine.changed(everyone, params).sum()))
            engine = free.pop() if free else None
        engine = engine or MujocoEngine(self.scene, count, self.threads)
        try:
            yield engine
        finally:
            with self._lock:
                free.append(engine)


def _params(values: Sequence[np.ndarray]) -> DomainParams | None:
    """Parameters from the values of `MODEL_PARAMS`; the others are not the engine's."""
    if not values:
        return None
    count = len(values[0])
    named = dict(zip(MODEL_PARAMS, values, strict=True))
    return DomainParams(imu_noise=np.zeros((count, 6)), delay=np.zeros(count), **named)
