"""Massively parallel DQN training of a quadruped that balances on a tilting board.

`BalanceEnv` needs JAX and is imported on first use, so that `load_policy` works
where JAX is not installed. Where Gymnasium is, `mjx_balance/Balance-v0` is registered.
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
