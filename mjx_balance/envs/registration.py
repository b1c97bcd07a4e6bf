"""Makes our envs known to Gymnasium as soon as it is imported, and does not import it.

Gymnasium 1.0 and later look for no plugins: a package registers its envs when it is imported.
"""

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

ENV_ID = "mjx_balance/Balance-v0"


def register_when_imported() -> None:
    """Registers now if Gymnasium has been imported, and right after it otherwise."""
    if sys.modules.get("gymnasium") is not None:
        _register()
    else:
        sys.meta_path.insert(0, _AfterGymnasium())


def _register() -> None:
    import gymnasium

    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            ENV_ID,
            entry_point="mjx_balance.envs.gym:BalanceGymEnv",
            vector_entry_point="mjx_balance.envs.gym:BalanceVecEnv",
        )


class _AfterGymnasium(MetaPathFinder):
    """Finds Gymnasium as the other finders do, and registers once it has been loaded."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Part of Python's import system; asked for every module."""
        if fullname != "gymnasium":
            return None
        others = [finder for finder in sys.meta_path if finder is not self]
        found = (finder.find_spec(fullname, path, target) for finder in others)
        spec = next((spec for spec in found if spec is not None), None)
        if spec is None or spec.loader is None:
            return spec
        load = spec.loader.exec_module

        def load_and_register(module: ModuleType) -> None:
            load(module)
            _register()

        spec.loader.exec_module = load_and_register
        return spec
