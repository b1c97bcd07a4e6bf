"""Functions that several commands use."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mjx_balance.config import check, preset
from mjx_balance.errors import PATH, USAGE_ERROR, InputError, shorten
from mjx_balance.evaluation import rollout
from mjx_balance.evaluation.controllers import Controller, ControllerError, make_controller
from mjx_balance.policy.file import load_policy
from mjx_balance.robots.limits import for_robot
from mjx_balance.sim.scene import Scene, load_scene

HELP = ("-h", "--help")


def complain(message: str, code: int = USAGE_ERROR) -> int:
    """Prints an error message; returns the exit code."""
    print(f"mjx-balance: {shorten(message, PATH)}", file=sys.stderr)
    return code


def check_out(name: str, path: Path | None, suffix: str = "") -> None:
    """Checks before the work begins that the output file of flag `name` can be written.

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


@dataclasses.dataclass(frozen=True)
class ControllerArgs:
    """The flags that say who balances."""

    policy: Annotated[Path | None, tyro.conf.Positional] = None
    """Policy file, run folder, or the name of a shipped policy."""
    controller: str | None = None
    """Baseline instead of a policy: none, pd-imu, pd-attitude, rate-oracle or clairvoyant."""
    robot: str | None = None
    """Robot of the baseline, or of a policy whose robot is not shipped: TOML file or
    menagerie:NAME."""
    action: Literal["grid", "continuous"] | None = None
    """Command height changes of the grid, or any up to its greatest; none: as the policy was
    trained, and any for a baseline."""

    def load(self) -> tuple[Scene, Controller]:
        """Loads the policy or builds the baseline, and its scene.

        Raises:
          InputError: if both or neither are given, or the policy or robot cannot be used.
        """
        if (self.policy is None) == (self.controller is None):
            raise ControllerError("name a policy file or --controller NAME, one of the two")
        if self.policy is not None:
            policy = load_policy(self.policy)
            if self.action is not None:
                policy = policy.with_action(self.action)
            return rollout.policy_scene(policy, robot=self.robot), rollout.observing(policy)
        config = for_robot(preset("default"), self.robot or "quadruped")
        if self.action is not None:
            task = dataclasses.replace(config.task, action=self.action)
            config = dataclasses.replace(config, task=task)
        scene = load_scene(check(config))
        return scene, make_controller(str(self.controller), scene)
