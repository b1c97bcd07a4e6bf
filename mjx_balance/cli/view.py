"""`mjx-balance view`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from mjx_balance.cli.common import complain, load_controller


@dataclasses.dataclass(frozen=True)
class ViewArgs:
    """Watch a policy in MuJoCo's viewer; keys tilt the board and push the robot."""

    policy: Annotated[Path | None, tyro.conf.Positional] = None
    """Policy file, run folder, or the name of a shipped policy."""
    controller: str | None = None
    """Baseline to watch instead: none, pd-imu, pd-attitude, rate-oracle or clairvoyant."""
    robot: str | None = None
    """Robot of the baseline, or the new path of the policy's robot file."""
    suite: str | None = None
    """Suite that moves the board and pushes the robot; none: keys do."""
    seed: int = 0
    """Seed of the suite's scenarios, and of the direction of pushes by key."""


def view(argv: list[str]) -> int:
    args = tyro.cli(ViewArgs, args=argv, prog="mjx-balance view")
    import mujoco

    from mjx_balance.cli import viewing
    from mjx_balance.render import drawing as render

    scene, controller = load_controller(args.policy, args.controller, args.robot)
    session = viewing.Session(scene, controller, args.suite, args.seed)
    try:
        window = render.Window(scene.config, session.press)
    except render.RenderError as error:
        return complain(f"{error}; `mjx-balance evaluate --video` needs no display")
    corners = mujoco.mjtGridPos
    keys = "Enter: push" if args.suite else viewing.HELP
    try:
        while window.is_open:
            window.write(
                (corners.mjGRID_TOPLEFT, *session.caption()),
                (corners.mjGRID_BOTTOMLEFT, keys, ""),
            )
            window.play(session.step())
    finally:
        window.close()
    return 0
