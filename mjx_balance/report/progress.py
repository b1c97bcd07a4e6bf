"""Progress of a run: a live panel in a terminal, plain lines elsewhere."""

import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TextIO, cast

from rich import progress as bars
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.panel import Panel
from rich.table import Table

from mjx_balance.errors import printable
from mjx_balance.evaluation.suites import HEADLINE

PLAIN_INTERVAL = 5.0  #: seconds between two plain lines
METRICS = {
    "perf/env_steps_per_second": ("decisions/s", "{:,.0f}"),
    "train/tilt_deg": ("mean tilt", "{:.3f} deg"),
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
        self.console = console or Console(file=cast(TextIO, _Output(sys.stdout)))
        self._spinner = "line" if self.console.options.ascii_only else "dots"
        self._metrics: Mapping[str, float] = {}

    def say(self, message: str) -> None:
        """Prints one line."""
        text = printable(message)
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

    @contextmanager
    def bar(self, name: str) -> Iterator[Callable[[float], None]]:
        """Shows a phase; call the bar with the share that is done, 0 to 1."""
        if not self.console.is_terminal:
            self.say(f"{name} ...")
            yield lambda share: None
            return
        spinner = bars.SpinnerColumn(self._spinner)
        columns = (spinner, escape(name), bars.BarColumn(), bars.TimeRemainingColumn())
        with bars.Progress(*columns, console=self.console, transient=True) as progress:
            task = progress.add_task(name, total=1.0)
            yield lambda share: progress.update(task, completed=share)

    @contextmanager
    def training(self, done: int, total: int) -> Iterator[None]:
        """Shows the progress of training; call `update` inside.

        Args:
          done: decisions before this training begins.
          total: decisions at its end.
        """
        self._total, self._done_at_start = total, done
        self._start = self._last = time.perf_counter()
        self._progress = bars.Progress(
            bars.SpinnerColumn(self._spinner),
            "training",
            bars.BarColumn(bar_width=None),
            bars.MofNCompleteColumn(),
            "decisions",
            bars.TimeElapsedColumn(),
            "left",
            bars.TimeRemainingColumn(elapsed_when_finished=False),
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
        return "  ".join([*numbers, *map(" ".join, self._validation()), *self._warnings()])

    def _panel(self) -> Panel:
        cells = []
        for name, (label, text) in METRICS.items():
            value = text.format(self._metrics[name]) if name in self._metrics else "-"
            cells += [f"[dim]{label}[/dim]", f"[bold]{value}[/bold]"]
        grid = Table.grid(padding=(0, 3))
        grid.add_row(*cells[:6])
        grid.add_row(*cells[6:])
        validation = [f"[dim]{x}[/dim]   [bold]{y}[/bold]" for x, y in self._validation()]
        below = ["   ".join(validation)] if validation else []
        below += [f"[bold red]{warning}[/bold red]" for warning in self._warnings()]
        return Panel(Group(self._progress, grid, *below), title="mjx_balance", border_style="cyan")

    def _validation(self) -> list[tuple[str, str]]:
        """Label and value of each suite that has been validated."""
        cells = []
        for suite in HEADLINE:
            tilt = self._metrics.get(f"eval/{suite}/tilt_mean")
            falls = self._metrics.get(f"eval/{suite}/falls")
            if tilt is not None and falls is not None:
                cells.append((f"held out, {suite}", f"{tilt:.3f} deg, falls {falls:g}"))
        return cells

    def _warnings(self) -> list[str]:
        return [
            f"{label} {text.format(self._metrics[name])}"
            for name, (label, text) in WARNINGS.items()
            if self._metrics.get(name, 0) > 0
        ]
