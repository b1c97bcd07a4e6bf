"""Tables for a terminal of 80 columns."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from mjx_balance.errors import PATH, nearby, shell, shorten
from mjx_balance.evaluation.statistics import TILTS
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.robots.catalogue import shipped

STATISTICS = ("mean", "p50", "p95", "p99", "max")  #: tilt statistics in the table of an evaluation


def evaluation_table(results: dict[str, dict[str, Any]]) -> Table:
    """One row per suite.

    Args:
      results: suite -> JSON of `rollout.summarize`.
    """
    names = ("scenarios", "falls", *STATISTICS, "act mm")
    table = _table("plain MuJoCo, tilt in deg over every physics step", names, suites=True)
    for suite, result in results.items():
        table.add_row(
            suite,
            f"{result['scenarios']} x {result['duration_s']:g} s",
            str(result["falls"]),
            *(f"{result['tilt_deg'][name]:.3f}" for name in STATISTICS),
            f"{result['action_mm_mean']:.3f}",
        )
    return table


def sweep_table(ranked: list[dict[str, Any]]) -> Table:
    """One row per combination of swept values.

    Args:
      ranked: combinations, best first, each with `values`, name -> value, and `statistics`,
        suite -> `statistics.over_seeds`.
    """
    title = "sweep, best first: falls, mean tilt in deg (95% interval over seeds)"
    table = _table(title, [*ranked[0]["values"], "seeds", *ranked[0]["statistics"]])
    for row in ranked:
        statistics = list(row["statistics"].values())
        table.add_row(
            *(f"{value:g}" for value in row["values"].values()),
            str(statistics[0]["seeds"]),
            *(f"{x['falls']}  {spread(x['mean'])}" for x in statistics),
        )
    return table


def seeds_table(summary: dict[str, dict[str, Any]]) -> Table:
    """One row per suite: interquartile means over the training seeds.

    Args:
      summary: suite -> `statistics.over_seeds`.
    """
    seeds = max(row["seeds"] for row in summary.values())
    title = f"{seeds} seeds: interquartile mean, 95% bootstrap interval, tilt in deg"
    table = _table(title, ("falls", *TILTS), suites=True)
    for suite, row in summary.items():
        table.add_row(suite, str(row["falls"]), *(spread(row[name]) for name in TILTS))
    return table


def spread(value: dict[str, float]) -> str:
    """An interquartile mean and its interval, e.g. `0.081 (0.079-0.084)`."""
    return f"{value['iqm']:.3f} ({value['low']:.3f}-{value['high']:.3f})"


def print_table(console: Console, table: Table) -> None:
    """Prints a table in full: a terminal that is too narrow breaks its lines."""
    options = console.options.update(max_width=10**4)
    table.width = console.measure(table, options=options).maximum
    console.print(table, crop=False)


def print_summary(
    console: Console,
    run_dir: Path,
    results: dict[str, dict[str, Any]],
    seconds: float,
    robot: str,
) -> None:
    """Prints a run's results, JSON of `summarize` by suite, its files and the seconds it took.

    The commands that it prints name the run's `robot` if it is not shipped.
    """
    folder = RunFolder(run_dir)
    flag = "" if robot in shipped() else f" --robot {shell(Path(robot))}"
    print_table(console, evaluation_table(results))
    folder_name = shorten(nearby(run_dir), PATH)
    # One name a line, so that nothing wraps at 80 columns.
    console.print(f"{escape(folder_name)}/", highlight=False, soft_wrap=True)
    for path, what in (
        (folder.policy, f"the policy; `mjx-balance evaluate{escape(flag)}` runs it"),
        (folder.evaluation, "the table above"),
        (folder.figures, "learning curves, rewards, 100 s on the board"),
        (folder.metrics, f"every logged number; {folder.tensorboard.name}/ has them too"),
        (folder.checkpoints, "the whole training state"),
    ):
        name = f"{path.name}/" if path.suffix == "" else path.name
        console.print(f"  {name}  [dim]{what}[/dim]", highlight=False, soft_wrap=True)
    console.print(
        f"`mjx-balance report {shell(nearby(run_dir))}{flag}` makes a page of it",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    console.print(f"done in {seconds:.0f} s", highlight=False)


def _table(title: str, names: Iterable[str], suites: bool = False) -> Table:
    """A table of numbers; `suites`: its first column names the suite of a row."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.pad_edge = False
    if suites:
        table.add_column("suite", style="bold", no_wrap=True)
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    return table
