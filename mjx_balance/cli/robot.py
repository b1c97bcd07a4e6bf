"""`mjx-balance robot check` and `mjx-balance robot new`."""

import os
from pathlib import Path

import tyro
from tyro.conf import Positional

from mjx_balance.cli.common import check_out, complain
from mjx_balance.errors import FAILED
from mjx_balance.files.run_folder import write_atomically


def robot(argv: list[str]) -> int:
    """Runs `robot check` or `robot new`; returns the exit code."""
    commands = {"check": check, "new": new}
    return tyro.extras.subcommand_cli_from_dict(commands, args=argv, prog="mjx-balance robot")


def check(robot: Positional[str], picture: Path | None = None) -> int:
    """Build a robot, tilt it on the board, and print the results.

    Args:
      robot: TOML file, shipped robot's name, or menagerie:NAME.
      picture: PNG file to draw; none: NAME-check.png in this folder, which is overwritten.
    """
    from mjx_balance.cli import inspection
    from mjx_balance.render import drawing as render

    check_out("picture", picture, ".png")
    scene, tilt_test = inspection.inspect(robot)
    print("\n".join(inspection.describe(scene, tilt_test)))
    problems = inspection.problems(scene, tilt_test)
    for sentence in problems:
        complain(sentence)
    picture = picture or Path(f"{scene.robot.name.replace(':', '_')}-check.png")
    try:
        render.write(picture, scene, tilt_test.qpos[None])
    except render.RenderError as error:
        return complain(f"no picture drawn: {error}", FAILED)
    print(f"picture: {picture}")
    return FAILED if problems else 0


def new(model: Positional[str], out: Path | None = None) -> int:
    """Draft a robot's TOML file from its model.

    Args:
      model: MJCF or URDF file, PACKAGE:PATH of one in a Python package, or menagerie:NAME.
      out: File to write; none: the terminal.
    """
    from mjx_balance.robots.build import model_path
    from mjx_balance.robots.draft import draft

    path = model_path(model, Path())
    if out is None:
        print(draft(model, path), end="")
        return 0
    if out.exists():
        return complain(f"{out} exists already")
    check_out("out", out)
    if path == Path(model):
        model = os.path.relpath(path, out.parent)
    write_atomically(out, draft(model, path))
    print(f"{out}: see `mjx-balance robot check {out}`")
    return 0
