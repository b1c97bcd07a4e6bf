"""Which engine a training has."""

from mjx_balance.engines.engine import Engine
from mjx_balance.scene import Scene


def make_engine(scene: Scene) -> Engine:
    """The engine that the scene's config names; only that one is imported.

    Cheap: a run whose program is cached never asks for the physics of its own process.
    """
    if scene.config.engine == "mujoco":
        from mjx_balance.engines.compiled import mujoco_engine

        return mujoco_engine(scene)
    from mjx_balance.engines.mjx import mjx_engine

    return mjx_engine(scene)
