"""`mjx-balance report`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from mjx_balance.cli.common import check_out, complain, robot_of
from mjx_balance.errors import PATH, shorten
from mjx_balance.report.progress import Display


@dataclasses.dataclass(frozen=True)
class ReportArgs:
    """Write one HTML page about runs: tables, curves, envelope, video. Needs no JAX."""

    run_dirs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run folders; the report compares the first policy among them with the baselines."""
    out: Path | None = None
    """File to write; none: report.html in the first folder."""
    scenarios: int = 8
    """Scenarios per suite and controller; 64 give figures to quote, in some minutes."""
    video: bool = True
    """Draw a video; without a GPU, this takes longest."""
    robot: str | None = None
    """Robot of the policy, if it is not a shipped one: TOML file, menagerie:NAME, or module:NAME of
    your own."""


def report(argv: list[str]) -> int:
    args = tyro.cli(ReportArgs, args=argv, prog="mjx-balance report")
    from mjx_balance.report.page import write_report

    if not args.run_dirs:
        return complain("name at least one run folder")
    check_out("out", args.out)
    out = args.out or args.run_dirs[0] / "report.html"
    robot = args.robot and robot_of(args.robot)
    display = Display(Console(stderr=True))
    missing = write_report(args.run_dirs, out, args.scenarios, display.stages, robot, args.video)
    for sentence in missing:
        complain(sentence)
    print(shorten(out, PATH))
    return 0
