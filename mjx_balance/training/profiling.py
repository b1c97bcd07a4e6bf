"""Where a call of the training program spends its time, by the names of its parts.

XLA's traces of a CPU name an operation without the scope that it comes from (jaxlib 0.9.2): their
stats are `hlo_op`, `hlo_module` and numbers. The compiled program's text has both, for every
platform.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax

from mjx_balance.files.run_folder import write_json
from mjx_balance.training.program_cache import CompiledProgram, LogFn

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
SCOPES = ("physics", "env", "acting", "replay", "updates")
"""`jax.named_scope`s of env and learner; the innermost of them counts."""
EXCHANGES = ("psum", "pmin", "pmax", "all_gather")
"""What devices wait for each other in."""
OTHER, EXCHANGE, HOST = "other", "exchange", "host"
SKIPPED = 3
"""Calls before the one that is looked at: until then there are no updates yet."""
TOO_SHORT = (
    f"--profile traces call {SKIPPED + 1} of the training program, and the run ended before it; "
    "raise num_env_steps, or lower log_every"
)


class Event(NamedTuple):
    """An operation of a device's program, on one thread or stream."""

    op: str
    start: float
    duration: float
    """ns"""


class Profiled:
    """A program, one of whose calls is traced."""

    def __init__(
        self,
        program: CompiledProgram,
        folder: Path,
        log_fn: LogFn,
    ):
        """Calls `program`.

        Args:
          program: compiled without a cache, which would not keep the names of its parts.
          folder: to write the trace and its `shares.json` into.
          log_fn: takes the shares of the time.
        """
        self._program, self._folder, self._log_fn = program, folder, log_fn
        self._calls = 0

    @property
    def begun(self) -> bool:
        """Whether a call has been traced."""
        return self._calls > SKIPPED

    def __call__(self, state: Any) -> tuple[Any, Any]:
        self._calls += 1
        if self._calls != SKIPPED + 1:
            return self._program(state)
        with jax.profiler.trace(str(self._folder)):
            results = jax.block_until_ready(self._program(state))
        self._log(shares(self._folder, scopes(self._program.as_text())))
        return results

    def _log(self, shares: dict[str, float]) -> None:
        write_json(self._folder / "shares.json", shares)
        self._log_fn(f"a call of the training program, traced in {self._folder}:")
        for name, share in shares.items():
            self._log_fn(f"  {name:<9}{share:6.1%}  {MEANING[name]}")


def scopes(program: str) -> dict[str, str]:
    """What the operations of a compiled program belong to.

    Args:
      program: as XLA writes it.

    Returns:
      Name of an operation -> one of `SCOPES`, "exchange" or "other".
    """
    found = {}
    for name, path in re.findall(r'%?([\w.\-]+) = .*metadata=\{.*?op_name="([^"]*)"', program):
        parts = re.findall(r"\w+", path)
        inner = [part for part in parts if part in SCOPES]
        found[name] = inner[-1] if inner else OTHER
        if parts and parts[-1] in EXCHANGES:
            found[name] = EXCHANGE
    return found


def shares(folder: Path, belongs: dict[str, str]) -> dict[str, float]:
    """The shares of a traced call's time, which add up to 1; of its first device.

    Args:
      folder: with the trace.
      belongs: from `scopes`.

    Returns:
      Share by name, the largest first; "host" is the time in which the device does nothing.
    """
    spent: dict[str, float] = {}
    first, last, busy = float("inf"), 0.0, 0.0
    for events in _timelines(folder):
        for event, own in _own_times(events):
            name = belongs.get(event.op, OTHER)
            spent[name] = spent.get(name, 0.0) + own
            busy += own
            first, last = min(first, event.start), max(last, event.start + event.duration)
    if not spent:
        return {}
    spent[HOST] = max(0.0, last - first - busy)
    total = sum(spent.values())
    return {name: spent[name] / total for name in sorted(spent, key=lambda name: -spent[name])}


def _timelines(folder: Path) -> Iterator[list[Event]]:
    """The operations of the first device, thread by thread or stream by stream."""
    file = max(folder.rglob("*.xplane.pb"), key=lambda path: path.stat().st_mtime)
    for plane in jax.profiler.ProfileData.from_file(str(file)).planes:
        if plane.name.startswith("/device:") and not plane.name.endswith(":0"):
            continue
        for line in plane.lines:
            found = []
            for event in line.events:
                stats = dict(event.stats)
                if "hlo_op" in stats and str(stats.get("device_ordinal", 0)) == "0":
                    found.append(Event(str(stats["hlo_op"]), event.start_ns, event.duration_ns))
            if found:
                yield found


def _own_times(events: list[Event]) -> Iterator[tuple[Event, float]]:
    """Each event of a thread with its time, without what others within it take."""
    open_ones: list[tuple[Event, list[float]]] = []
    for event in sorted(events, key=lambda event: (event.start, -event.duration)):
        while open_ones and event.start >= open_ones[-1][0].start + open_ones[-1][0].duration:
            done, inner = open_ones.pop()
            yield done, done.duration - sum(inner)
        if open_ones:
            open_ones[-1][1].append(event.duration)
        open_ones.append((event, []))
    while open_ones:
        done, inner = open_ones.pop()
        yield done, done.duration - sum(inner)
