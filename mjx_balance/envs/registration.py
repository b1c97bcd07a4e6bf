"""Registers our envs with Gymnasium, if it is installed.

Gymnasium finds an env once the package that registers it has been imported. A process that has
not imported ours, such as a worker of a vector env, asks for `mjx_balance:mjx_balance/Balance-v0`:
Gymnasium imports what stands before the colon.
"""

import contextlib

ENV_ID = "mjx_balance/Balance-v0"


def register() -> None:
    """Registers the envs; their module is imported by the first `gymnasium.make`."""
    # A Gymnasium that is missing or broken is no reason not to evaluate a policy.
    with contextlib.suppress(Exception):
        import gymnasium

        if ENV_ID not in gymnasium.registry:
            gymnasium.register(
                ENV_ID,
                entry_point="mjx_balance.envs.gym:BalanceGymEnv",
                vector_entry_point="mjx_balance.envs.gym:BalanceVecEnv",
            )
