"""Massively parallel DQN training of a quadruped that balances on a tilting board.

All names but `__version__` are imported on first use: `load_policy` and `evaluate` work without
JAX, and this import takes milliseconds. With Gymnasium installed, it registers
`mjx_balance/Balance-v0`.
"""

import contextlib
import importlib
import os
import sys
from typing import TYPE_CHECKING

from mjx_balance.quiet import import_mujoco, quiet_imports

if TYPE_CHECKING:
    from mjx_balance.api import TrainingResult, evaluate, train
    from mjx_balance.config import Config, RandomizationConfig, preset
    from mjx_balance.envs.balance import BalanceEnv
    from mjx_balance.evaluation.suites import Suite
    from mjx_balance.policy.file import load_policy
    from mjx_balance.policy.network import Policy
    from mjx_balance.robots.limits import for_robot
    from mjx_balance.training.callbacks import Callback

    __version__: str

__all__ = [
    "BalanceEnv",
    "Callback",
    "Config",
    "Policy",
    "RandomizationConfig",
    "Suite",
    "TrainingResult",
    "__version__",
    "evaluate",
    "for_robot",
    "load_policy",
    "preset",
    "train",
]
_MODULES = {
    "BalanceEnv": "envs.balance",
    "Callback": "training.callbacks",
    "Config": "config",
    "Policy": "policy.network",
    "RandomizationConfig": "config",
    "Suite": "evaluation.suites",
    "TrainingResult": "api",
    "evaluate": "api",
    "for_robot": "robots.limits",
    "load_policy": "policy.file",
    "preset": "config",
    "train": "api",
}
"""Public name -> module of this package."""


def _is_command_line() -> bool:
    """Whether this process is our own command, which shows its first line sooner without these."""
    started = getattr(sys, "orig_argv", [])[1:]
    script = started[0] if started else ""
    ours = os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(__file__))), "train.py")
    return (
        os.path.basename(script) in ("mjx-balance", "mjx-balance-script.py")
        or started[:2] == ["-m", "mjx_balance"]
        or os.path.abspath(script) == ours
    )


if not _is_command_line():
    if os.environ.get("MUJOCO_GL"):
        import_mujoco()
    # A process that has not imported this package, such as a worker of a vector env, asks for
    # `mjx_balance:mjx_balance/Balance-v0`: Gymnasium imports what stands before the colon. A
    # Gymnasium that is missing or broken is no reason not to evaluate a policy.
    with contextlib.suppress(Exception):
        import gymnasium

        if "mjx_balance/Balance-v0" not in gymnasium.registry:
            gymnasium.register(
                "mjx_balance/Balance-v0",
                entry_point="mjx_balance.envs.gym:BalanceGymEnv",
                vector_entry_point="mjx_balance.envs.gym:BalanceVecEnv",
            )


def __getattr__(name: str) -> object:
    if name == "__version__":
        from mjx_balance.policy.manifest import installed_version

        return installed_version("mjx_balance") or "unknown"
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with quiet_imports("torch"):
        return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
