"""The robot looks the same in a mirror: what that makes of observations and actions."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task.observation import input_rows


class Symmetries(NamedTuple):
    """The group of reflections, the identity first."""

    obs_index: Int32[np.ndarray, "reflections obs_size"]  #: entry that takes each place
    obs_sign: Float32[np.ndarray, "reflections obs_size"]  #: its sign there
    action: Int32[np.ndarray, "reflections actions"] | Float32[np.ndarray, "reflections 2"]
    """Index that each action becomes, or signs of the two numbers of a continuous action."""


def symmetries(task: TaskConfig, robot: Robot, continuous: bool = False) -> Symmetries:
    """The left-right mirror of the observation's rows and the actions; a_x changes its sign.

    Front-hind is no symmetry of the robot: all its knees bend backward.
    """
    rows = input_rows(task, robot)
    place = {row.name: k for k, row in enumerate(rows)}
    mirrored = [place[row.mirror.row] for row in rows]
    signs = [row.mirror.sign for row in rows]
    actions = np.arange(task.num_actions).reshape(task.action_levels, task.action_levels)
    index = np.asarray((actions.ravel(), actions[::-1].ravel()), np.int32)
    return Symmetries(
        np.asarray((range(len(rows)), mirrored), np.int32),
        np.asarray(([1] * len(rows), signs), np.float32),
        np.asarray(((1, 1), (-1, 1)), np.float32) if continuous else index,
    )
