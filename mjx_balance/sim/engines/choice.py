"""Which engine a training has."""

import importlib.util

from mjx_balance.config import ConfigError
from mjx_balance.sim.engines.engine import Engine
from mjx_balance.sim.scene import Scene


def make_engine(scene: Scene) -> Engine:
    """The engine that the scene's config names; only that one is imported.

    Cheap: a run whose program is cached never asks for the physics of its own process.

    Raises:
      ConfigError: if the engine is not installed.
    """
    if scene.config.engine == "mujoco":
        from mjx_balance.sim.engines.compiled import mujoco_engine

        return mujoco_engine(scene)
    if scene.config.engine == "warp":
        if importlib.util.find_spec("warp") is None:
            raise ConfigError(
                "engine is warp, and warp-lang is not installed; install the extra `warp` (make "
                "train EXTRAS=warp), or choose engine mjx"
            )
        from mjx_balance.sim.engines.warp import warp_engine

        return warp_engine(scene)
    from mjx_balance.sim.engines.mjx import mjx_engine

    return mjx_engine(scene)
