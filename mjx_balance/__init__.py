"""Massively parallel DQN training of a quadruped that balances on a tilting board.

`load_policy` works without JAX, because `BalanceEnv` is imported on first use. With Gymnasium
installed, this import registers `mjx_balance/Balance-v0`.
"""

import contextlib
import os
from typing import TYPE_CHECKING

from mjx_balance.quiet import import_mujoco, quiet_imports

if os.environ.get("MUJOCO_GL"):
    import_mujoco()

from mjx_balance.policy.file import load_policy

if TYPE_CHECKING:
    from mjx_balance.envs.balance import BalanceEnv

__all__ = ["BalanceEnv", "load_policy"]

# A process that has not imported this package, such as a worker of a vector env, asks for
# `mjx_balance:mjx_balance/Balance-v0`: Gymnasium imports what stands before the colon. A Gymnasium
# that is missing or broken is no reason not to evaluate a policy.
with contextlib.suppress(Exception):
    import gymnasium

    if "mjx_balance/Balance-v0" not in gymnasium.registry:
        gymnasium.register(
            "mjx_balance/Balance-v0",
            entry_point="mjx_balance.envs.gym:BalanceGymEnv",
            vector_entry_point="mjx_balance.envs.gym:BalanceVecEnv",
        )


def __getattr__(name: str) -> object:
    if name == "BalanceEnv":
        with quiet_imports("torch"):
            from mjx_balance.envs.balance import BalanceEnv

        return BalanceEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
