"""MJX-Warp: MuJoCo Warp's kernels inside a jitted program, for NVIDIA GPUs (slow on a CPU).

Contacts are found by atomic counters: their order, and so the rounding of a step, differs from
run to run. A training over this engine is not repeated bit for bit by its seed.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import mujoco
import warp
from jax.custom_batching import custom_vmap
from mujoco import mjx

from mjx_balance.sim.domain_randomization import randomized_fields
from mjx_balance.sim.engines.jax_engine import JaxEngine, PhysicsState
from mjx_balance.sim.engines.mjx import physics_step, training_model
from mjx_balance.sim.engines.table import Options
from mjx_balance.sim.scene import Scene
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.step import Motion

T = TypeVar("T")

UNCONVERGED = 1 << 9 | 1 << 10  #: bits of `Data.overflow` for the solver's iterations


class WarpOverflowError(RuntimeError):
    """A buffer of Warp was too small: contacts or their rows would have been dropped."""


def contact_room(model: mujoco.MjModel) -> tuple[int, int]:
    """The most contacts, touching or not, and constraint rows of one env, as MJX counts them."""
    static = mjx.make_data(model)._impl
    return len(static.contact.dist), int(static.nefc)


def over_all_envs(function: Callable[..., T]) -> Callable[..., T]:
    """Runs a function of a batch once for all envs, however they are vmapped.

    Warp's buffers are shared by all envs of a call, so that it must know how many there are.
    The leaves of the function's arguments share a leading axis of envs. `jax.vmap` of the result,
    once or several times, is one call with more envs.
    """

    @custom_vmap
    def batched(*arguments: Any) -> T:
        return function(*arguments)

    @batched.def_vmap
    def rule(size: int, in_batched: Any, *arguments: Any) -> tuple[T, Any]:
        def merged(x: jax.Array, is_batched: bool) -> jax.Array:
            whole = x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
            return whole.reshape(-1, *whole.shape[2:])

        results = batched(*jax.tree.map(merged, arguments, tuple(in_batched)))
        split = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), results)
        return split, jax.tree.map(lambda _: True, results)

    return batched


def warp_engine(scene: Scene, options: Options) -> JaxEngine:
    """Solves in buffers for every contact that the scene can have."""
    warp.config.log_level = warp.LOG_WARNING  # a line per kernel otherwise
    plain = training_model(scene, options)
    # Warp knows no automatic reset that could be disabled.
    plain.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    contacts, rows = contact_room(plain)

    @functools.cache
    def on_device(envs: int) -> tuple[mjx.Model, mjx.Data]:
        with jax.ensure_compile_time_eval():  # constants, though this runs inside a trace
            own = jax.local_devices()[0]  # not another process's
            model = mjx.put_model(plain, own, impl="warp")
            printed = model.opt._impl.warn_overflow & ~UNCONVERGED
            option = model.opt.replace(_impl=model.opt._impl.replace(warn_overflow=printed))
            model = model.replace(opt=option)
            most = contacts * envs
            return model, mjx.make_data(plain, own, impl="warp", naconmax=most, njmax=rows)

    def batched_physics(
        state: PhysicsState, ctrl: jax.Array, params: DomainParams | None
    ) -> tuple[PhysicsState, Motion]:
        """One decision of a batch: every argument has a leading axis of envs."""
        model, blank = on_device(len(ctrl))
        randomized = jax.vmap(functools.partial(randomized_fields, scene))
        fields = {} if params is None else randomized(params)

        def one_env(
            state: PhysicsState, ctrl: jax.Array, fields: dict[str, jax.Array]
        ) -> tuple[PhysicsState, tuple[Motion, jax.Array]]:
            state, motion, data = physics_step(scene, model.replace(**fields), blank, state, ctrl)
            return state, (motion, data._impl.overflow)

        body = lambda state, ctrl: jax.vmap(one_env)(state, ctrl, fields)  # noqa: E731
        state, (motion, overflow) = jax.lax.scan(body, state, jnp.swapaxes(ctrl, 0, 1))
        overflowed = jnp.bitwise_and(overflow, ~UNCONVERGED).any()
        jax.lax.cond(overflowed, lambda: jax.debug.callback(refuse), lambda: None)
        return state, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), motion)

    def refuse() -> None:
        raise WarpOverflowError(
            f"a buffer of engine warp overflowed: the scene has room for {contacts} contacts and "
            f"{rows} constraint rows per env"
        )

    over_all = over_all_envs(batched_physics)

    def physics(
        state: PhysicsState, ctrl: jax.Array, params: DomainParams | None
    ) -> tuple[PhysicsState, Motion]:
        arguments = jax.tree.map(lambda x: jnp.asarray(x)[None], (state, ctrl, params))
        return jax.tree.map(lambda x: x[0], over_all(*arguments))

    return JaxEngine(scene, physics)
