"""Massively parallel DQN training of a quadruped that balances on a tilting board.

`load_policy` works without JAX, because `BalanceEnv` is imported on first use. With Gymnasium
installed, this import registers `mjx_balance/Balance-v0`.
"""

from typing import TYPE_CHECKING

from mjx_balance.envs.registration import register
from mjx_balance.policy.file import load_policy
from mjx_balance.quiet import quiet_imports

if TYPE_CHECKING:
    from mjx_balance.envs.balance import BalanceEnv

__all__ = ["BalanceEnv", "load_policy"]

register()


def __getattr__(name: str) -> object:
    if name == "BalanceEnv":
        with quiet_imports("torch"):
            from mjx_balance.envs.balance import BalanceEnv

        return BalanceEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
