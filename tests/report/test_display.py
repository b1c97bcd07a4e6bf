"""What a watcher of a run sees, number by number."""

import io
import os
import pty
import re
import subprocess
import sys
import types
from typing import Any

import pytest
from rich.console import Console

from mjx_balance.report import progress as module
from mjx_balance.report.progress import Display

METRICS = {
    "perf/env_steps_per_second": 1234.5,
    "train/tilt_deg": 0.25,
    "train/falls_per_minute": 0.5,
    "train/reward": 0.3,
    "train/loss": 0.01,
    "train/epsilon": 0.05,
    "train/not_shown": 77.7,
}
CELLS = (
    "decisions/s 1,234",
    "tilt exploring 0.250 deg",
    "falls per robot-minute 0.500",
    "reward 0.300",
    "loss 0.01000",
    "epsilon 0.050",
)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> types.SimpleNamespace:
    """A clock that the test winds."""
    clock = types.SimpleNamespace(now=100.0, perf_counter=lambda: clock.now)
    monkeypatch.setattr(module, "time", clock)
    return clock


def screen(terminal: bool) -> tuple[Display, io.StringIO]:
    out = io.StringIO()
    return Display(Console(file=out, force_terminal=terminal, no_color=False, width=110)), out


def plain(text: str) -> list[str]:
    """Lines without colours and cursor movements, spaces merged."""
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text).replace("\r", "\n")
    return [" ".join(line.split()) for line in text.splitlines()]


def test_plain_output_is_one_line_per_interval(clock: Any) -> None:
    display, out = screen(terminal=False)
    with display.training(200, 1_200):
        clock.now += 4.9
        display.update(300, METRICS)  # too soon
        clock.now += 5.1
        display.update(600, METRICS)
        clock.now += 4.9
        display.update(700, METRICS)  # too soon after the last
        clock.now += 0.1
        display.update(750, METRICS)
        clock.now += 0.1
        display.update(1_280, METRICS)  # the last one is always shown
    numbers = "  ".join(CELLS)
    assert out.getvalue().splitlines() == [
        # 400 decisions in 10 s by this call; 600 are left
        f"      600/1,200 decisions  {numbers}  left 15 s",
        # 550 in 15 s; 450 are left
        f"      750/1,200 decisions  {numbers}  left 12 s",
        f"    1,280/1,200 decisions  {numbers}  left 0 s",
    ]


def test_plain_output_leaves_out_what_is_not_known_and_adds_warnings(clock: Any) -> None:
    display, out = screen(terminal=False)
    with display.training(0, 10):
        clock.now += 5.0
        display.update(10, {"train/reward": -0.5, "train/skipped_updates": 0.25})
    line = out.getvalue().split("decisions")[1].strip()
    assert line == "reward -0.500  skipped updates 25.0%  left 0 s"


VALIDATED = {
    "eval/paper/tilt_mean": 0.0844,
    "eval/paper/falls": 0.0,
    "eval/corner/tilt_mean": 1.25,
    "eval/corner/falls": 2.5,
}
HELD_OUT = ("held out, paper 0.084 deg, falls 0", "held out, corner 1.250 deg, falls 2.5")


def test_a_validation_is_shown_until_the_next_one(clock: Any) -> None:
    """Behind the other numbers, and not before there is one; nothing else is shown for longer."""
    display, out = screen(terminal=False)
    with display.training(0, 400):
        for done, metrics in (
            (100, {"train/loss": 1.0}),
            (200, {"train/reward": 1.0} | VALIDATED),
            (300, {"train/epsilon": 0.5}),
            (400, {"train/epsilon": 0.5} | VALIDATED | {"eval/paper/falls": 1.0}),
        ):
            clock.now += 10
            display.update(done, metrics)
    shown = [line.split("decisions  ")[1] for line in out.getvalue().splitlines()]
    numbers = "  ".join(HELD_OUT)
    assert shown == [
        "loss 1.00000  left 30 s",
        f"reward 1.000  {numbers}  left 20 s",
        f"epsilon 0.500  {numbers}  left 10 s",
        f"epsilon 0.500  {numbers.replace('falls 0', 'falls 1')}  left 0 s",
    ]


def test_a_phase_says_what_is_done_and_how_long_it_took(clock: Any) -> None:
    display, out = screen(terminal=False)
    with display.phase("compiling"):
        clock.now += 2.46
    assert out.getvalue().splitlines() == ["compiling ...", "compiling: 2.5 s"]
    display, out = screen(terminal=True)
    with display.phase("compiling"):
        clock.now += 61.0
    assert plain(out.getvalue())[-1] == "compiling: 61.0 s"


def last_panel(text: str) -> list[str]:
    """The lines of the panel that was drawn last, with its title."""
    lines = [line.strip("│ ") for line in plain(text)]
    return lines[max(k for k, line in enumerate(lines) if "mjx_balance" in line) :]


def test_a_terminal_shows_every_number_under_its_name() -> None:
    display, out = screen(terminal=True)
    with display.training(200, 1_000, {"paper": 3.323, "corner": 5.819}):
        display.update(600, METRICS | VALIDATED)
        display.update(800, METRICS | {"train/diverged": 2.0})
    panel = last_panel(out.getvalue())
    assert panel[1].startswith(("⠋ training", "⠙ training"))
    assert "800/1000 decisions" in panel[1]
    speed, tilt, *others = CELLS
    assert panel[2:4] == [" ".join((speed, others[0])), " ".join(others[1:])]
    assert panel[4].startswith(tilt)
    assert panel[5:] == [
        "tilt held out paper 0.084 deg, falls 0 corner 1.250 deg, falls 2.5",
        "standing still paper 3.32 deg corner 5.82 deg",
        "exploring: with random actions; held out: without them, on other boards",
        "diverged envs 2",
        "╰" + "─" * 104 + "╯",
    ]


@pytest.mark.parametrize("width", [80, 100])
def test_live_lines_fit_and_leave_room_for_the_terminals_echo(width: int, clock: Any) -> None:
    """A full line would break when Ctrl-C is echoed, and shift all that is drawn after it."""
    out = io.StringIO()
    display = Display(Console(file=out, force_terminal=True, width=width))
    with display.training(0, 20_000_000, {"paper": 3.32, "corner": 5.82}):
        display.update(10_000_000, METRICS | VALIDATED | {"eval/corner/falls": 12.25})
    with display.stages(12)("evaluating, suite corner, seed 1234567, which is long") as bar:
        bar(0.5)
    lines = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", out.getvalue()).replace("\r", "\n").splitlines()
    assert max(map(len, lines)) <= width - 4
    inside = [line.strip("│ ") for line in lines if line.startswith("│")]
    starts = "decisions/s|reward|tilt exploring|tilt held out|standing still|exploring:".split("|")
    assert "training" in inside[-7]
    assert all(map(str.startswith, inside[-6:], starts)), "no row takes two lines"


def test_the_course_of_the_tilt_is_drawn_on_a_log_scale(clock: Any) -> None:
    display, out = screen(terminal=True)
    with display.training(0, 1_200):  # 24 places: 50 decisions each
        display.update(600, {"train/tilt_deg": 4.0})
        display.update(650, {"train/tilt_deg": 1.0})
        display.update(900, {"train/tilt_deg": 0.25})
    line = next(x for x in last_panel(out.getvalue()) if x.startswith("tilt exploring"))
    # 4 to 0.25 is 8 blocks; 1 is their middle, 3.5 rounded to even.
    assert line == "tilt exploring 0.250 deg " + "█" * 12 + "▅" + "▁" * 5


def test_stages_are_numbered_and_tell_the_time_left(clock: Any) -> None:
    display, out = screen(terminal=False)
    stage = display.stages(2)
    with stage("evaluating") as bar:
        bar(0.0)
        clock.now += 4.9
        bar(0.1)  # too soon
        clock.now += 1.1
        bar(0.25)  # 6 s for a quarter
        bar(0.3)
    with stage("drawing"):
        clock.now += 1.0
    assert out.getvalue().splitlines() == [
        "1/2 evaluating ...",
        "1/2 evaluating: 25%, 18 s left",
        "1/2 evaluating: 6.0 s",
        "2/2 drawing ...",
        "2/2 drawing: 1.0 s",
    ]


def test_a_terminal_shows_a_dash_before_the_first_numbers_and_no_more_than_all() -> None:
    display, out = screen(terminal=True)
    with display.training(200, 1_000):
        pass
    panel = last_panel(out.getvalue())
    assert "200/1000 decisions" in panel[1]
    assert panel[2] == "decisions/s - falls per robot-minute -"
    assert panel[4:6] == ["tilt exploring -", "tilt held out -"]
    assert "standing still" not in "".join(panel)
    display, out = screen(terminal=True)
    with display.training(0, 1_000):
        display.update(1_024, METRICS)
    assert "1000/1000 decisions" in last_panel(out.getvalue())[1]


def test_a_bar_moves_to_the_share_that_is_done() -> None:
    display, out = screen(terminal=False)
    with display.bar("evaluating") as bar:
        bar(0.5)
    assert out.getvalue().startswith("evaluating ...\nevaluating: ")
    display, out = screen(terminal=True)
    with display.bar("evaluating [bold]") as bar:
        bar(0.25)
    lines = [line for line in plain(out.getvalue()) if "evaluating [bold] " in line]
    done, left = re.findall("(━+)[╺╸](━+)", lines[-1])[0]
    assert len(done) / (len(done) + len(left)) == pytest.approx(0.25, abs=0.03)
    assert plain(out.getvalue())[-1].startswith("evaluating [bold]: ")


def test_messages_are_printed_as_they_are() -> None:
    """Neither wrapped nor taken for markup; a terminal gets whole words, and paths to copy."""
    message = "stopped; continue with --resume /[bold]" + "x" * 120 + " or do not"
    display, out = screen(terminal=False)
    display.say(message)
    assert out.getvalue() == f"{message}\n"
    display, out = screen(terminal=True)
    display.say(message)
    assert out.getvalue().splitlines() == [message[:31], message[32:-10], "or do not"]


@pytest.mark.parametrize("kind", ["pipe", "terminal", "full disk"])
def test_a_run_outlives_the_reader_of_its_lines(kind: str) -> None:
    """A pager that is left, a connection that breaks: the process goes on, and its code is its."""
    speak = (
        "import sys\n"
        "from mjx_balance.report.progress import Display\n"
        "display = Display()\n"
        "display.say('heard')\n"
        "sys.stdin.readline()\n"
        "for _ in range(100):\n"
        "    display.say('unheard ' * 1_000)\n"
        "with display.phase('saving'), display.bar('evaluating') as bar:\n"
        "    bar(0.5)\n"
        "sys.exit(7)\n"
    )
    if kind == "full disk":
        reader, writer = os.open(os.devnull, os.O_RDONLY), os.open("/dev/full", os.O_WRONLY)
    else:
        reader, writer = pty.openpty() if kind == "terminal" else os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-c", speak],
        stdin=subprocess.PIPE,
        stdout=writer,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    os.close(writer)
    assert os.read(reader, 5) in (b"heard", b"")
    os.close(reader)
    assert process.communicate(b"go on\n", timeout=60) == (None, b"")
    assert process.returncode == 7


def test_a_notebook_gets_plain_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On its standard output, not as an HTML block each."""
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    Display().say("learning")
    assert capsys.readouterr().out == "learning\n"
