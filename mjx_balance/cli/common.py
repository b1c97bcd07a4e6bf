"""Functions that several commands use."""

import contextlib
import dataclasses
import importlib
import os
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mjx_balance.cli.words import HELP as HELP
from mjx_balance.cli.words import complain as complain
from mjx_balance.config import check, preset
from mjx_balance.errors import MESSAGE, InputError, quote, shorten, suggest
from mjx_balance.evaluation import rollout
from mjx_balance.evaluation.controllers import Controller, ControllerError, make_controller
from mjx_balance.evaluation.suites import Suite
from mjx_balance.policy.file import load_policy
from mjx_balance.robots.catalogue import MENAGERIE, use_robot
from mjx_balance.robots.limits import for_robot
from mjx_balance.robots.schema import RobotFile, read_robot_file
from mjx_balance.sim.scene import Scene, load_scene


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


def find_named(flag: str, text: str) -> Any:
    """Imports what `module:NAME` names, from the current folder or an installed package.

    Call it only with words of the command line, never with a name from a policy or a run folder.

    Raises:
      InputError: if there is no such module or name, or the module fails.
    """
    module, _, name = text.partition(":")
    sys.path.insert(0, os.getcwd())
    try:
        owner = importlib.import_module(module)
    except Exception as error:  # whatever the user's code raises
        reason = shorten(error, MESSAGE // 2) or type(error).__name__
        raise InputError(
            f"{flag} is {quote(text)}, but module {quote(module)} cannot be imported: {reason}"
        ) from error
    finally:
        with contextlib.suppress(ValueError):
            sys.path.remove(os.getcwd())
    if not hasattr(owner, name):
        known = [x for x in vars(owner) if not x.startswith("_")]
        remedy = suggest("name", name, known)
        raise InputError(f"{flag} is {quote(text)}, but {module} has no {quote(name)}; {remedy}")
    return getattr(owner, name)


def suite_of(text: str) -> str | Suite:
    """The suite that flag `suite` names: its name, or the `Suite` at `module:NAME`."""
    if ":" not in text:
        return text
    suite = find_named("suite", text)
    if not isinstance(suite, Suite):
        raise InputError(f"suite is {quote(text)}, which is {quote(suite)}; it must be a Suite")
    return dataclasses.replace(suite, name=text)


def robot_of(text: str) -> str:
    """The robot that flag `robot` names; one at `module:NAME` becomes known by these words.

    It is a `RobotFile`, or the path of a TOML file.
    """
    if ":" not in text or text.startswith(MENAGERIE) or text.endswith(".toml"):
        return text
    robot = find_named("robot", text)
    if isinstance(robot, (str, Path)):
        robot = read_robot_file(Path(robot))
    if not isinstance(robot, RobotFile):
        raise InputError(
            f"robot is {quote(text)}, which is {quote(robot)}; it must be a RobotFile, or the path "
            "of a TOML file"
        )
    return use_robot(robot, text)


@dataclasses.dataclass(frozen=True)
class ControllerArgs:
    """The flags that choose a policy or a baseline."""

    policy: Annotated[Path | None, tyro.conf.Positional] = None
    """Policy file, run folder, or the name of a shipped policy."""
    controller: str | None = None
    """Baseline instead of a policy: none, pd-imu, pd-attitude, rate-oracle or clairvoyant."""
    robot: str | None = None
    """Robot of the baseline, or of a policy whose robot is not shipped: TOML file, menagerie:NAME,
    or module:NAME of your own."""
    action: Literal["grid", "continuous"] | None = None
    """Height changes to command: those of the grid, or any up to the greatest of them; none: as the
    policy was trained, and any for a baseline."""

    def load(self) -> tuple[Scene, Controller]:
        """Loads the policy or builds the baseline, and its scene.

        Raises:
          InputError: if both or neither are given, or the policy or robot cannot be used.
        """
        if (self.policy is None) == (self.controller is None):
            raise ControllerError("name a policy file or --controller NAME, one of the two")
        robot = self.robot and robot_of(self.robot)
        if self.policy is not None:
            policy = load_policy(self.policy)
            if self.action is not None:
                policy = policy.with_action(self.action)
            return rollout.policy_scene(policy, robot=robot), rollout.observing(policy)
        config = for_robot(preset("default"), robot or "quadruped")
        if self.action is not None:
            task = dataclasses.replace(config.task, action=self.action)
            config = dataclasses.replace(config, task=task)
        scene = load_scene(check(config))
        return scene, make_controller(str(self.controller), scene)
