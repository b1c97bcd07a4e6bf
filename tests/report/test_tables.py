"""Tables of a terminal: every cell under its heading, in 80 columns."""

import io
import shlex
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from mjx_balance.report import tables

TILTS = (0.0684, 0.0316, 0.2345, 0.6789, 6.0)
FRICTION = {
    "scenarios": 100_000,
    "duration_s": 60.0,
    "falls": 1_280,
    "tilt_deg": dict(zip(("mean", "p50", "p95", "p99", "max"), TILTS, strict=True)),
    "action_mm_mean": 0.2468,
}
CORNER = FRICTION | {"scenarios": 8, "duration_s": 2.5, "falls": 0}


def printed(table: object) -> list[list[str]]:
    """Title, headings and rows as words."""
    out = io.StringIO()
    Console(width=80, file=out).print(table)
    lines = [line for line in out.getvalue().splitlines() if line.strip(" ─")]
    assert "…" not in out.getvalue(), "nothing is cut off"
    return [line.split() for line in lines]


def test_evaluation_table() -> None:
    title, heads, friction, corner = printed(
        tables.evaluation_table({"friction": FRICTION, "corner": CORNER})
    )
    assert " ".join(title) == "plain MuJoCo, tilt in deg over every physics step"
    assert heads == "suite scenarios falls mean p50 p95 p99 max act mm".split()
    assert friction == "friction 100000 x 60 s 1280 0.068 0.032 0.234 0.679 6.000 0.247".split()
    assert corner[:6] == "corner 8 x 2.5 s 0".split()


def test_seeds_table() -> None:
    row: dict[str, Any] = {"seeds": 5, "scenarios": 640, "falls": 1_280}
    for k, name in enumerate(("mean", "p95", "max")):
        row[name] = {"iqm": k + 0.0684, "low": k + 0.0677, "high": k + 1.0687, "worst": 7.0}
    title, heads, friction, corner = printed(
        tables.seeds_table({"friction": row, "corner": row | {"seeds": 3, "falls": 2}})
    )
    assert " ".join(title).startswith("5 seeds: interquartile mean, 95% bootstrap interval")
    assert heads == "suite falls mean p95 max".split()
    cells = "0.068 (0.068-1.069) 1.068 (1.068-2.069) 2.068 (2.068-3.069)".split()
    assert friction == ["friction", "1280", *cells]
    assert corner == ["corner", "2", *cells]


def test_sweep_table() -> None:
    def row(gamma: float, rate: float, falls: int, mean: float) -> dict[str, Any]:
        tilt = {"iqm": mean, "low": mean - 0.01, "high": mean + 0.02, "worst": 7.0}
        statistics = {"seeds": 3, "falls": falls, "mean": tilt}
        values = {"gamma": gamma, "learning_rate": rate}
        return {"values": values, "statistics": {"paper": statistics, "corner": statistics}}

    ranked = [row(0.1, 3e-3, 0, 0.08), row(0.4, 1e-5, 2, 0.2)]
    title, heads, first, second = printed(tables.sweep_table(ranked))
    assert " ".join(title).startswith("sweep, best first: falls, mean tilt in deg")
    assert heads == "gamma learning_rate seeds paper corner".split()
    assert first == "0.1 0.003 3 0 0.080 (0.070-0.100) 0 0.080 (0.070-0.100)".split()
    assert second == "0.4 1e-05 3 2 0.200 (0.190-0.220) 2 0.200 (0.190-0.220)".split()


def test_the_summary_names_every_file_of_the_run() -> None:
    out = io.StringIO()
    run = Path("runs/a[b]")
    tables.print_summary(Console(width=80, file=out), run, {"corner": CORNER}, 61.6, "go2")
    text = out.getvalue()
    assert "\nruns/a[b]/\n" in text
    for name in ("policy.safetensors", "evaluation.json", "figures/", "metrics.jsonl"):
        assert f"\n  {name}  " in text
    assert "\n  checkpoints/  the whole training state\n" in text
    assert "`mjx-balance report 'runs/a[b]'` makes a page of it" in text
    assert "0.068" in text
    assert text.endswith("done in 62 s\n")


def test_the_summary_of_a_run_fits_80_columns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the folder's usual name, below the working folder."""
    monkeypatch.chdir(tmp_path)
    run, out = tmp_path / "runs" / "default-seed0-20260102-030405", io.StringIO()
    tables.print_summary(Console(width=80, file=out), run, {"corner": CORNER}, 61.6, "go2")
    assert "\nruns/default-seed0-20260102-030405/\n" in out.getvalue()
    assert max(map(len, out.getvalue().splitlines())) <= 80


@pytest.mark.parametrize("robot", ["my robot.toml", "menagerie:unitree_h1", "go2"])
def test_the_summarys_commands_name_a_robot_that_is_not_shipped(robot: str) -> None:
    """`evaluate` and `report` refuse the policy without it."""
    out = io.StringIO()
    tables.print_summary(Console(width=80, file=out), Path("runs/a"), {}, 1.0, robot)
    flag = "" if robot == "go2" else f" --robot {shlex.quote(robot)}"
    assert f"`mjx-balance report runs/a{flag}` makes a page of it" in out.getvalue()
    assert f"`mjx-balance evaluate{flag}` runs it\n" in out.getvalue()


@pytest.mark.parametrize("width", [10, 39, 59])
def test_a_narrow_terminal_shows_every_figure(width: int) -> None:
    out = io.StringIO()
    console = Console(width=width, file=out)
    tables.print_table(console, tables.evaluation_table({"friction": FRICTION}))
    assert "friction  100000 x 60 s   1280  0.068  0.032" in " ".join(out.getvalue().split("\n"))
    assert "…" not in out.getvalue()
