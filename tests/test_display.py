"""What a watcher of a run sees."""

import io

from rich.console import Console

from mjx_balance.display import Display

METRICS = {
    "perf/env_steps_per_second": 1234.5,
    "train/tilt_deg": 0.25,
    "train/falls_per_minute": 0.5,
    "train/reward": 0.3,
    "train/loss": 0.01,
    "train/epsilon": 0.05,
}


def shown(terminal: bool) -> str:
    out = io.StringIO()
    display = Display(Console(file=out, force_terminal=terminal, width=110))
    with display.phase("compiling"):
        pass
    with display.training(0, 1000):
        display.update(1000, METRICS)
    return out.getvalue()


def test_plain_output_is_one_line_per_update() -> None:
    lines = shown(terminal=False).splitlines()
    assert lines[0] == "compiling ..."
    assert lines[1].startswith("compiling: 0.0 s")
    assert len(lines) == 3
    for part in ("1,000/1,000 decisions", "decisions/s 1,234", "mean tilt 0.250 deg", "left 0 s"):
        assert part in lines[2]


def test_a_terminal_shows_every_number() -> None:
    said = shown(terminal=True)
    for part in ("1,234", "0.250 deg", "0.500", "0.300", "0.01000", "0.050", "1000/1000"):
        assert part in said
