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

from mjx_balance.sim.domain_randomization import model_fields
from mjx_balance.sim.engines.engine import Engine, Motion, PhysicsState
from mjx_balance.sim.engines.mjx import trained_model
from mjx_balance.sim.scene import Scene
from mjx_balance.task.attitude import body_tilt
from mjx_balance.task.randomization import Conditions

T = TypeVar("T")

UNCONVERGED = 1 << 9 | 1 << 10
"""Bits of `Data.overflow` that are no overflow: the limits on the solver's iterations."""


class WarpOverflowError(RuntimeError):
    """A buffer of Warp was too small: contacts or their rows would have been dropped."""


def contact_room(model: mujoco.MjModel) -> tuple[int, int]:
    """The most contacts that one env can have, and the most constraint rows.

    MJX's own count, which is static: all contacts of all pairs, touching or not.
    """
    static = mjx.make_data(model)._impl
    return len(static.contact.dist), int(static.nefc)


def over_all_envs(function: Callable[..., T]) -> Callable[..., T]:
    """Runs a function of a batch once for all envs, however they are vmapped.

    Warp's buffers are shared by all envs of a call, so that it must know how many there are.

    Args:
      function: of pytrees whose leaves have a leading axis of envs, which they share.

    Returns:
      The same function; `jax.vmap` of it, once or several times, is one call with more envs.
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


def warp_engine(scene: Scene) -> Engine:
    """Solves as the scene's config says, in buffers for every contact that the scene can have."""
    warp.config.log_level = warp.LOG_WARNING  # a line per kernel otherwise
    plain = trained_model(scene)
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

    def physics(
        state: PhysicsState, ctrl: jax.Array, conditions: Conditions | None
    ) -> tuple[PhysicsState, Motion]:
        """One decision of a batch: every argument has a leading axis of envs."""
        model, blank = on_device(len(ctrl))
        varied = jax.vmap(functools.partial(model_fields, scene))
        fields = {} if conditions is None else varied(conditions)

        def of_one(
            state: PhysicsState, ctrl: jax.Array, fields: dict[str, jax.Array]
        ) -> tuple[PhysicsState, tuple[Motion, jax.Array]]:
            data = mjx.step(model.replace(**fields), blank.replace(**state._asdict(), ctrl=ctrl))
            moved = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
            tilt = body_tilt(data.qpos[scene.trunk_quat])
            return moved, (Motion(data.sensordata[scene.imu], tilt), data._impl.overflow)

        step = lambda state, ctrl: jax.vmap(of_one)(state, ctrl, fields)  # noqa: E731
        state, (motion, overflow) = jax.lax.scan(step, state, jnp.swapaxes(ctrl, 0, 1))
        overflowed = jnp.bitwise_and(overflow, ~UNCONVERGED).any()
        jax.lax.cond(overflowed, lambda: jax.debug.callback(refuse), lambda: None)
        return state, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), motion)

    def refuse() -> None:
        raise WarpOverflowError(
            f"a buffer of engine warp overflowed: the scene has room for {contacts} contacts and "
            f"{rows} constraint rows per env"
        )

    batched = over_all_envs(physics)

    def advance(
        state: PhysicsState, ctrl: jax.Array, conditions: Conditions | None
    ) -> tuple[PhysicsState, Motion]:
        arguments = jax.tree.map(lambda x: jnp.asarray(x)[None], (state, ctrl, conditions))
        return jax.tree.map(lambda x: x[0], batched(*arguments))

    return advance
