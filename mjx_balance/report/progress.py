"""Progress of a run: a live panel in a terminal, plain lines elsewhere."""

import dataclasses
import itertools
import math
import os
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import Any, TextIO, cast

from rich import progress as bars
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.markup import escape
from rich.panel import Panel
from rich.table import Column, Table

from mjx_balance.errors import printable
from mjx_balance.evaluation.suites import HEADLINE

Stage = Callable[[str], AbstractContextManager[Callable[[float], None]]]
"""Title of a stage -> context manager; it gives a function that takes the share done, 0 to 1."""

PLAIN_INTERVAL = 5.0  #: seconds between two plain lines
EXPLORING = "train/tilt_deg"
METRICS = {
    "perf/env_steps_per_second": ("decisions/s", "{:,.0f}"),
    EXPLORING: ("tilt exploring", "{:.3f} deg"),
    "train/falls_per_minute": ("falls per robot-minute", "{:.3f}"),
    "train/reward": ("reward", "{:.3f}"),
    "train/loss": ("loss", "{:.5f}"),
    "train/epsilon": ("epsilon", "{:.3f}"),
}
WARNINGS = {
    "train/diverged": ("diverged envs", "{:,.0f}"),
    "train/skipped_updates": ("skipped updates", "{:.1%}"),
}
"""Displayed only if greater than 0."""
COURSE = 24  #: characters of the course of the tilt, from the first decision to the last
BLOCKS, ASCII_BLOCKS = "▁▂▃▄▅▆▇█", "_.,-~=+#"
NOTE = "exploring: with random actions; held out: without them, on other boards"
MARGIN = 4  #: columns that live lines leave free: the terminal's ^C would break a full line


def part(bar: Callable[[float], None], number: int, count: int) -> Callable[[float], None]:
    """Progress of part `number`, from 0, of `count` equal ones of a stage."""
    return lambda share: bar((number + share) / count)


@dataclasses.dataclass
class _Narrow:
    """What is drawn in all columns but the last `MARGIN`."""

    inside: RenderableType

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        width = max(options.max_width - MARGIN, MARGIN)
        yield from console.render(self.inside, options.update(width=width))


class _Line(bars.Progress):
    """A line that leaves `MARGIN` columns free, without even spaces there."""

    def get_renderable(self) -> RenderableType:
        """Returns the line, narrower than the console."""
        return _Narrow(super().get_renderable())


class _Output:
    """Standard output, whose loss ends no run: of a terminal or pipe that is closed, say."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> None:
        self._try(self._stream.write, text)

    def flush(self) -> None:
        self._try(self._stream.flush)

    def _try(self, call: Callable[..., object], *text: str) -> None:
        try:
            call(*text)
        except OSError:  # this text, and all that follows, goes nowhere
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), self._stream.fileno())


class Display:
    """Progress of one run on a console."""

    def __init__(self, console: Console | None = None):
        """Writes to `console`; to standard output if None."""
        # In a notebook, rich would make an HTML block of every line.
        stream = cast(TextIO, _Output(sys.stdout))
        self.console = console or Console(file=stream, force_jupyter=False)
        self._spinner = "line" if self.console.options.ascii_only else "dots"
        self._metrics: Mapping[str, float] = {}

    def say(self, message: str) -> None:
        """Prints one line; a terminal gets as many as it needs, without a broken word."""
        text = printable(message)
        if self.console.is_terminal:  # which breaks words; paths and commands stay whole
            width = max(self.console.width, 20)
            text = textwrap.fill(text, width, break_long_words=False, break_on_hyphens=False)
        self.console.print(text, highlight=False, soft_wrap=True, markup=False)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Shows a phase of unknown length, then the time it took."""
        began = time.perf_counter()
        if self.console.is_terminal:
            with self.console.status(escape(name), spinner=self._spinner):
                yield
        else:
            self.say(f"{name} ...")
            yield
        self.say(f"{name}: {time.perf_counter() - began:.1f} s")

    def stages(self, total: int) -> Stage:
        """Returns a function that shows the next of `total` numbered stages, as `bar` does."""
        number = itertools.count(1)
        return lambda title: self.bar(f"{next(number)}/{total} {title}")

    @contextmanager
    def bar(self, name: str) -> Iterator[Callable[[float], None]]:
        """Shows the share done and the time left, then the time it took.

        Call the bar with the share that is done, 0 to 1.
        """
        began = time.perf_counter()
        if self.console.is_terminal:
            with self._transient() as progress:
                task = progress.add_task(escape(name), total=1.0)
                yield lambda share: progress.update(task, completed=share)
        else:
            self.say(f"{name} ...")
            yield self._plain_bar(name, began)
        self.say(f"{name}: {time.perf_counter() - began:.1f} s")

    def _transient(self) -> bars.Progress:
        """A line that vanishes at its end: a title, which is cut if it must be, and a bar."""
        column = Column(no_wrap=True, overflow="crop", max_width=48)
        title = bars.TextColumn("{task.description}", table_column=column)
        spinner, bar = bars.SpinnerColumn(self._spinner), bars.BarColumn(bar_width=None)
        columns = (spinner, title, bar, bars.TimeRemainingColumn(), "left")
        return _Line(*columns, console=self.console, transient=True, expand=True)

    def _plain_bar(self, name: str, began: float) -> Callable[[float], None]:
        """Says at intervals how far it is."""
        last = began

        def update(share: float) -> None:
            nonlocal last
            now = time.perf_counter()
            if share > 0 and now - last >= PLAIN_INTERVAL:
                last = now
                left = (now - began) * (1 - share) / share
                self.say(f"{name}: {share:.0%}, {left:.0f} s left")

        return update

    @contextmanager
    def training(
        self, done: int, total: int, still: Mapping[str, float] | None = None
    ) -> Iterator[None]:
        """Shows the progress of training; call `update` inside.

        Args:
          done: decisions before this training begins.
          total: decisions at its end.
          still: suite -> mean tilt of a robot that stands still, deg, to compare with.
        """
        self._still, self._course = still or {}, [math.nan] * COURSE
        self._drawn = math.ceil(COURSE * min(done / total, 1.0))
        self._total, self._done_at_start = total, done
        self._start = self._last = time.perf_counter()
        self._progress = bars.Progress(
            bars.SpinnerColumn(self._spinner),
            "training",
            bars.BarColumn(bar_width=None),
            bars.MofNCompleteColumn(),
            "decisions",
            bars.TimeRemainingColumn(elapsed_when_finished=False),
            "left",
        )
        self._task = self._progress.add_task("training", total=total, completed=done)
        if not self.console.is_terminal:
            yield
            return
        with Live(get_renderable=self._panel, console=self.console, refresh_per_second=8):
            yield

    def update(self, done: int, metrics: Mapping[str, float]) -> None:
        """Shows new metrics; keeps those of the last validation until the next.

        Args:
          done: decisions so far.
          metrics: by their logged names.
        """
        held_out = {k: v for k, v in self._metrics.items() if k.startswith("eval/")}
        self._metrics = {**held_out, **metrics}
        self._progress.update(self._task, completed=min(done, self._total))
        if EXPLORING in metrics:
            place = math.ceil(COURSE * min(done / self._total, 1.0))
            first = min(self._drawn, place - 1)
            self._course[first:place] = [metrics[EXPLORING]] * (place - first)
            self._drawn = place
        now = time.perf_counter()
        due = now - self._last >= PLAIN_INTERVAL or done >= self._total
        if due and not self.console.is_terminal:
            self._last = now
            rate = (done - self._done_at_start) / max(now - self._start, 1e-9)
            left = max(self._total - done, 0) / max(rate, 1e-9)
            line = f"{done:>9,}/{self._total:,} decisions  {self._line()}  left {left:.0f} s"
            self.say(line)

    def _line(self) -> str:
        numbers = [
            f"{label} {text.format(self._metrics[name])}"
            for name, (label, text) in METRICS.items()
            if name in self._metrics
        ]
        held_out = [f"held out, {suite} {value}" for suite, value in self._validation()]
        return "  ".join([*numbers, *held_out, *self._warnings()])

    def _panel(self) -> Panel:
        numbers, tilt = Table.grid(padding=(0, 2)), Table.grid(padding=(0, 2))
        cells = {}
        for name, (label, text) in METRICS.items():
            value = text.format(self._metrics[name]) if name in self._metrics else "-"
            cells[name] = f"[dim]{label}[/dim]", f"[bold]{value}[/bold]"
        label, value = cells.pop(EXPLORING)
        tilt.add_row(label, f"{value}  {self._drawn_course()}")
        pairs = list(itertools.chain.from_iterable(cells.values()))
        numbers.add_row(*pairs[:4])
        numbers.add_row(*pairs[4:])
        held_out = "  ".join(f"{suite} [bold]{x}[/bold]" for suite, x in self._validation())
        tilt.add_row("[dim]tilt held out[/dim]", held_out or "-")
        still = "  ".join(f"{suite} {value:.2f} deg" for suite, value in self._still.items())
        if still:
            tilt.add_row("[dim]standing still[/dim]", still)
        below = [f"[bold red]{warning}[/bold red]" for warning in self._warnings()]
        inside = Group(self._progress, numbers, tilt, f"[dim]{NOTE}[/dim]", *below)
        width = max(self.console.width - MARGIN, MARGIN)
        return Panel(inside, title="mjx_balance", border_style="cyan", width=width)

    def _drawn_course(self) -> str:
        """The tilt exploring so far, on a log scale from its least to its greatest."""
        known = [math.log(x) for x in self._course if x > 0]  # NaN is not
        if len(known) < 2:
            return ""
        low, high = min(known), max(known)
        blocks = ASCII_BLOCKS if self.console.options.ascii_only else BLOCKS
        step = (len(blocks) - 1) / max(high - low, 1e-9)
        drawn = [blocks[round((math.log(x) - low) * step)] if x > 0 else " " for x in self._course]
        return f"[cyan]{''.join(drawn).rstrip()}[/cyan]"

    def _validation(self) -> list[tuple[str, str]]:
        """Name and value of each suite that has been validated."""
        cells = []
        for suite in HEADLINE:
            tilt = self._metrics.get(f"eval/{suite}/tilt_mean")
            falls = self._metrics.get(f"eval/{suite}/falls")
            if tilt is not None and falls is not None:
                cells.append((suite, f"{tilt:.3f} deg, falls {falls:g}"))
        return cells

    def _warnings(self) -> list[str]:
        return [
            f"{label} {text.format(self._metrics[name])}"
            for name, (label, text) in WARNINGS.items()
            if self._metrics.get(name, 0) > 0
        ]
