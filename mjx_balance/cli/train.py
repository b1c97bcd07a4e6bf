"""`mjx-balance train` and `mjx-balance sweep`."""

import atexit
import dataclasses
import gc
import os
from pathlib import Path

import tyro
from rich.console import Console

from mjx_balance.cli.common import HELP, complain, robot_of
from mjx_balance.cli.words import RunArgs
from mjx_balance.config import Config, preset, read_run_config
from mjx_balance.errors import FAILED, INTERRUPTED, MESSAGE, how_to_install, shorten
from mjx_balance.policy.file import PolicyError
from mjx_balance.quiet import quiet_imports
from mjx_balance.robots.limits import for_robot
from mjx_balance.sim.engines.table import unused_modules


@dataclasses.dataclass(frozen=True)
class TrainArgs(RunArgs):
    """Train a policy, export it, and evaluate it in plain MuJoCo."""

    config: tyro.conf.OmitArgPrefixes[Config] = dataclasses.field(default_factory=Config)


@dataclasses.dataclass(frozen=True)
class StartingPoint:
    """The flags that set the defaults of all others."""

    preset: str = "default"
    robot: str = "quadruped"
    resume: Path | None = None


def sweep(argv: list[str]) -> int:
    """Runs `mjx-balance sweep gamma=0.1,0.4 @FILE ... [flags]`, which is `train --sweep`."""
    count = next((k for k, text in enumerate(argv) if text.startswith("-")), len(argv))
    entries = []
    for text in argv[:count]:
        try:
            file = Path(text[1:])
            entries += file.read_text("utf-8-sig").split() if text.startswith("@") else [text]
        except (OSError, UnicodeDecodeError) as error:
            return complain(f"the values in {text[1:]} cannot be read: {error}")
    if not entries and not {"--resume", *HELP} & set(argv):
        return complain(
            "say what to try, as gamma=0.1,0.4, or @FILE with such entries, before train's flags"
        )
    return train([*argv[count:], *(["--sweep", *entries] if entries else [])])


def train(argv: list[str]) -> int:
    """Runs `mjx-balance train`; returns the exit code."""
    args = _parse(argv)
    if args.resume and args.run_dir:
        return complain("--resume continues a folder in place; leave --run-dir out")
    robot = args.config.robot
    if args.resume and robot.endswith(".toml") and not os.path.isfile(robot):
        return complain(
            f"the robot file {shorten(robot)} is gone; say where it is now with --robot FILE"
        )
    try:
        with quiet_imports("torch", *unused_modules(args.config.engine)):
            import mjx_balance.training.run  # noqa: F401
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        return complain(
            f"training needs {package}, which is not installed; {how_to_install('train')}"
        )
    except ValueError as error:  # JAX's own, for what it reads from variables
        return complain(f"JAX cannot be imported: {shorten(error, MESSAGE)}")
    # JAX is a million objects. Looking through them for garbage takes a second when compiling, and
    # another one at the exit.
    gc.freeze()
    atexit.register(gc.freeze)
    return _train(args)


def _parse(argv: list[str]) -> TrainArgs:
    """Parses the flags; defaults are those of preset and robot, or of the run to resume."""
    start, _ = tyro.cli(StartingPoint, args=argv, return_unknown_args=True, add_help=False)
    robot = robot_of(start.robot)
    if start.resume is None:
        default = TrainArgs(config=for_robot(preset(start.preset), robot))
    else:
        default = TrainArgs(config=read_run_config(start.resume))
    return tyro.cli(TrainArgs, args=argv, prog="mjx-balance train", default=default)


def _train(args: TrainArgs) -> int:
    from jax.errors import JaxRuntimeError

    from mjx_balance.report.progress import Display
    from mjx_balance.training import run, sizing
    from mjx_balance.training.checkpoints import SaveError
    from mjx_balance.training.processes import find_cluster
    from mjx_balance.training.tracking import Tracker

    display = Display()
    try:
        cluster = None
        where = (args.coordinator, args.process_id, args.num_processes)
        if args.distributed or where != (None, None, None):
            cluster = find_cluster(*where)
            if cluster.process_id:
                display = Display(Console(quiet=True))
        trackers = [Tracker(args.track, display.say)] if args.track else []
        folders = (args.run_dir, args.resume)
        run.train(args.config, *folders, display, cluster, args.profile, callbacks=trackers)
    except (PolicyError, SaveError) as error:
        return complain(str(error), FAILED)
    except JaxRuntimeError as error:
        explanation = sizing.explained(error)
        if explanation is None:
            raise
        return complain(explanation, FAILED)
    except OSError as error:  # a full disk: --resume can go on from what is saved
        return complain(f"cannot write {error.filename or 'the run'}: {error.strerror}", FAILED)
    except run.Interrupted as stopped:
        display.say(str(stopped))
        return INTERRUPTED
    return 0
