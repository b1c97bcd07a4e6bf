"""Where a call of the training program spends its time, by the names of its parts.

XLA's traces of a CPU name operations without their scopes (jaxlib 0.9.2); the compiled program's
text has both, on every platform.
"""

import dataclasses
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax

from mjx_balance.errors import shorten
from mjx_balance.files.run_folder import write_json
from mjx_balance.training.program_cache import CompiledProgram

MEANING = {
    "physics": "the engine's steps",
    "env": "what the task makes of them: board, observation, reward, new episodes",
    "acting": "the network's choices, and noise",
    "replay": "storing transitions, drawing batches",
    "updates": "losses, gradients, optimiser",
    "exchange": "sums over devices, and waiting for each other there",
    "other": "the rest of the device's program",
    "host": "the device waits for its next operation",
}
SCOPES = ("physics", "env", "acting", "replay", "updates")  #: `jax.named_scope`s
EXCHANGES = ("psum", "pmin", "pmax", "all_gather")  #: what devices wait for each other in
SKIPPED = 3  #: calls before the one that is traced: until then there are no updates yet
TOO_SHORT = (
    f"--profile traces call {SKIPPED + 1} of the training program, and the run ended before it; "
    "raise num_env_steps, or lower log_every"
)


class Event(NamedTuple):
    """An operation of a device's program, on one thread or stream."""

    op: str
    start: float
    duration: float  #: ns

    @property
    def end(self) -> float:
        return self.start + self.duration


@dataclasses.dataclass
class Profiled:
    """A program, one of whose calls is traced."""

    program: CompiledProgram  #: compiled without a cache, which keeps no names
    folder: Path  #: for the trace and its `shares.json`
    log_fn: Callable[[str], None]
    calls: int = 0

    @property
    def begun(self) -> bool:
        """Whether a call has been traced."""
        return self.calls > SKIPPED

    def __call__(self, state: Any) -> tuple[Any, Any]:
        self.calls += 1
        if self.calls != SKIPPED + 1:
            return self.program(state)
        results = None
        try:
            with jax.profiler.trace(str(self.folder)):
                results = jax.block_until_ready(self.program(state))
            self._sum_up()
        except Exception as error:  # the trace ends no run that learns
            if results is None:
                raise
            self.log_fn(f"the trace in {self.folder} cannot be summarised: {shorten(error)}")
        return results

    def _sum_up(self) -> None:
        """Writes and logs the shares of the traced call."""
        spent = shares(self.folder, scopes(self.program.compiled.as_text() or ""))
        write_json(self.folder / "shares.json", spent)
        self.log_fn(f"a call of the training program, traced in {self.folder}:")
        for name, share in spent.items():
            self.log_fn(f"  {name:<9}{share:6.1%}  {MEANING[name]}")


def scopes(program: str) -> dict[str, str]:
    """Operation of a compiled program, as XLA writes it -> "exchange", "other" or its scope."""
    belongs = {}
    for name, path in re.findall(r'%?([\w.\-]+) = .*metadata=\{.*?op_name="([^"]*)"', program):
        parts = re.findall(r"\w+", path)
        belongs[name] = next((part for part in reversed(parts) if part in SCOPES), "other")
        if parts and parts[-1] in EXCHANGES:
            belongs[name] = "exchange"
    return belongs


def shares(folder: Path, belongs: Mapping[str, str]) -> dict[str, float]:
    """Shares of a traced call's time on its first device, the largest first; their sum is 1.

    Args:
      folder: with the trace.
      belongs: from `scopes`.
    """
    timelines = list(_timelines(folder))
    events = [event for timeline in timelines for event in timeline]
    if not events:
        return {}
    spent: defaultdict[str, float] = defaultdict(float)
    for timeline in timelines:
        for event, time in _own_times(timeline):
            spent[belongs.get(event.op, "other")] += time
    span = max(event.end for event in events) - min(event.start for event in events)
    spent["host"] = max(0.0, span - sum(spent.values()))
    total = sum(spent.values())
    return {name: spent[name] / total for name in sorted(spent, key=lambda name: -spent[name])}


def _timelines(folder: Path) -> Iterator[list[Event]]:
    """The operations of the first device, thread by thread or stream by stream."""
    file = max(folder.rglob("*.xplane.pb"), key=lambda path: path.stat().st_mtime)
    for plane in jax.profiler.ProfileData.from_file(str(file)).planes:
        if plane.name.startswith("/device:") and not plane.name.endswith(":0"):
            continue
        for line in plane.lines:
            events = []
            for event in line.events:
                stats = dict(event.stats)
                if "hlo_op" in stats and str(stats.get("device_ordinal", 0)) == "0":
                    events.append(Event(str(stats["hlo_op"]), event.start_ns, event.duration_ns))
            yield events


def _own_times(events: list[Event]) -> Iterator[tuple[Event, float]]:
    """Durations to sum per event: its own, less those of events that run within it."""
    within: list[Event] = []
    for event in sorted(events, key=lambda event: (event.start, -event.duration)):
        while within and event.start >= within[-1].end:
            within.pop()
        yield event, event.duration
        if within:
            yield within[-1], -event.duration
        within.append(event)
