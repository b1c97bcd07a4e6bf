"""Functions that several commands use."""

import sys
from pathlib import Path

from mjx_balance.config import check, preset
from mjx_balance.errors import USAGE_ERROR, InputError
from mjx_balance.evaluation import rollout
from mjx_balance.evaluation.controllers import Controller, ControllerError, make_controller
from mjx_balance.policy.file import load_policy
from mjx_balance.robots.limits import for_robot
from mjx_balance.sim.scene import Scene, load_scene

HELP = ("-h", "--help")


def complain(message: str, code: int = USAGE_ERROR) -> int:
    """Prints an error message; returns the exit code."""
    print(f"mjx-balance: {message}", file=sys.stderr)
    return code


def check_out(name: str, path: Path | None, suffix: str = "") -> None:
    """Checks before the work begins that an output file can be written.

    Args:
      name: of the flag.
      path: of the file; None passes.
      suffix: of the file's name; empty if any will do.

    Raises:
      InputError: if the suffix differs, the path is a folder, or its folder does not exist.
    """
    if path is None:
        return
    if suffix and path.suffix != suffix:
        raise InputError(f"{name} is {path}; its name must end in {suffix}")
    if path.is_dir():
        raise InputError(f"cannot write {path}: it is a folder")
    if not path.absolute().parent.is_dir():
        raise InputError(f"cannot write {path}: its folder does not exist")


def load_controller(
    policy: Path | None, baseline: str | None, robot: str | None
) -> tuple[Scene, Controller]:
    """Loads a policy or builds a baseline.

    Args:
      policy: file, run folder or name of a shipped policy.
      baseline: name of a controller; exactly one of policy and baseline is not None.
      robot: the baseline's robot, or the path of the policy's robot file on this machine.

    Returns:
      Scene and controller.

    Raises:
      ControllerError: if both or neither of policy and baseline are None.
      PolicyError: if the policy cannot be used.
      ConfigError: if the robot does not exist.
    """
    if (policy is None) == (baseline is None):
        raise ControllerError("name a policy file or --controller NAME, one of the two")
    if policy is not None:
        loaded = load_policy(policy)
        return rollout.policy_scene(loaded, robot=robot), rollout.observing(loaded)
    assert baseline is not None
    scene = load_scene(check(for_robot(preset("default"), robot or "quadruped")))
    return scene, make_controller(baseline, scene)
