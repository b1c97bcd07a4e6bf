"""`mjx-balance robot check` and `mjx-balance robot new`."""

import os
from pathlib import Path

import tyro
from tyro.conf import Positional

from mjx_balance.cli.common import check_out, complain, robot_of
from mjx_balance.errors import FAILED, PATH, shell, shorten
from mjx_balance.files.run_folder import write_atomically


def robot(argv: list[str]) -> int:
    """Runs `robot check` or `robot new`; returns the exit code."""
    commands = {"check": check, "new": new}
    return tyro.extras.subcommand_cli_from_dict(commands, args=argv, prog="mjx-balance robot")


def check(robot: Positional[str], picture: Path | None = None) -> int:
    """Build a robot, tilt it on the board, and print the results.

    Args:
      robot: TOML file, shipped robot's name, menagerie:NAME, or module:NAME of your own.
      picture: PNG file to draw; none: NAME-check.png in this folder, which is overwritten.
    """
    from mjx_balance.cli import inspection
    from mjx_balance.render import drawing as render

    check_out("picture", picture, ".png")
    scene, tilt_test = inspection.inspect(robot_of(robot))
    print("\n".join(inspection.describe(scene, tilt_test)))
    problems = inspection.problems(scene, tilt_test)
    for sentence in problems:
        complain(sentence)
    picture = picture or Path(f"{scene.robot.name.replace(':', '_')}-check.png")
    try:
        render.write(picture, scene, tilt_test.qpos[None])
    except render.RenderError as error:
        return complain(f"no picture drawn: {error}", FAILED)
    print(f"picture: {shorten(picture, PATH)}")
    return FAILED if problems else 0


def new(model: Positional[str], out: Path | None = None, strip: tuple[str, ...] = ()) -> int:
    """Draft a robot's TOML file from its model, and print what you have to complete.

    Args:
      model: MJCF or URDF file, PACKAGE:PATH of one in a Python package, or menagerie:NAME.
      out: File to write; none: the terminal.
      strip: Bodies to leave out, and joints to fix.
    """
    from mjx_balance.robots.build import build
    from mjx_balance.robots.draft import sketch
    from mjx_balance.robots.model import model_path
    from mjx_balance.robots.schema import RobotError, parse_robot_file

    path = model_path(model, Path())
    if out is not None:
        if out.exists():
            return complain(f"{out} exists already")
        check_out("out", out)
        if path == Path(model):
            model = _beside(path, out.parent)
    text, problems = sketch(model, path, strip)
    try:
        if not problems:
            build(parse_robot_file(text, out or Path("draft.toml")))
    except RobotError as error:
        problems = [str(error)]
        text = f"# To mend: {error}.\n{text}"
    if out is None:
        print(text, end="")
    else:
        write_atomically(out, text)
        print(f"{shorten(out, PATH)}: see `mjx-balance robot check {shell(out)}`")
    for problem in problems:
        complain(problem)
    return FAILED if problems else 0


def _beside(path: Path, folder: Path) -> str:
    """A model's path for a robot file in `folder`, with slashes, as Windows takes them too."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive
        return path.absolute().as_posix()
