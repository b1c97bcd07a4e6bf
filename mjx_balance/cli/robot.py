"""`mjx-balance robot check` and `mjx-balance robot new`."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated

import tyro

from mjx_balance.cli.common import HELP, check_out, complain
from mjx_balance.errors import FAILED
from mjx_balance.files.run_folder import write_atomically


@dataclasses.dataclass(frozen=True)
class RobotCheckArgs:
    """Build a robot, tilt it on the board, and print the results."""

    robot: Annotated[str, tyro.conf.Positional]
    """TOML file, shipped robot's name, or menagerie:NAME."""
    picture: Path | None = None
    """PNG file to draw; none: NAME-check.png in this folder, which is overwritten."""


@dataclasses.dataclass(frozen=True)
class RobotNewArgs:
    """Draft a robot's TOML file from its model."""

    model: Annotated[str, tyro.conf.Positional]
    """MJCF or URDF file, PACKAGE:PATH of one in a Python package, or menagerie:NAME."""
    out: Path | None = None
    """File to write; none: the terminal."""


def robot(argv: list[str]) -> int:
    """Runs `robot check` or `robot new`; returns the exit code."""
    commands = {"check": _check, "new": _new}
    if argv and argv[0] in HELP:
        print("usage: mjx-balance robot {check,new} ... (--help after one lists its flags)")
        return 0
    if not argv or argv[0] not in commands:
        return complain("say robot check FILE.toml, or robot new MODEL.xml")
    return commands[argv[0]](argv[1:])


def _check(argv: list[str]) -> int:
    args = tyro.cli(RobotCheckArgs, args=argv, prog="mjx-balance robot check")
    from mjx_balance.cli import inspection
    from mjx_balance.render import drawing as render

    check_out("picture", args.picture, ".png")
    scene, tilt_test = inspection.inspect(args.robot)
    print("\n".join(inspection.describe(scene, tilt_test)))
    problems = inspection.problems(scene, tilt_test)
    for sentence in problems:
        complain(sentence)
    picture = args.picture or Path(f"{scene.robot.name.replace(':', '_')}-check.png")
    try:
        render.write(picture, scene.config, tilt_test.qpos[None])
    except render.RenderError as error:
        return complain(f"no picture drawn: {error}", FAILED)
    print(f"picture: {picture}")
    return FAILED if problems else 0


def _new(argv: list[str]) -> int:
    args = tyro.cli(RobotNewArgs, args=argv, prog="mjx-balance robot new")
    from mjx_balance.robots.build import model_path
    from mjx_balance.robots.draft import draft

    path = model_path(args.model, Path())
    model = args.model
    if args.out is not None:
        if args.out.exists():
            return complain(f"{args.out} exists already")
        check_out("out", args.out)
        if path == Path(model):
            model = os.path.relpath(path, args.out.parent)
    text = draft(model, path)
    if args.out is None:
        print(text, end="")
    else:
        write_atomically(args.out, text)
        print(f"{args.out}: see `mjx-balance robot check {args.out}`")
    return 0
