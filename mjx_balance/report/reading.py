"""What can be read of a run folder, whole or not, damaged or foreign.

Every value that the report uses is checked here, and nothing else of a file is kept.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from reprlib import repr as short
from typing import Any

from mjx_balance.config import Config, read_config
from mjx_balance.errors import InputError
from mjx_balance.evaluation.statistics import TILTS
from mjx_balance.files.run_folder import RunFolder, parse_json, read_json
from mjx_balance.policy.file import Policy, load_policy
from mjx_balance.report.figures import CURVES, HELD_OUT

METRICS_BYTES = 8 * 2**20
"""So much of metrics.jsonl is read."""
LINE_BYTES = 2**18
"""Longest line of it."""
MOST_SEEDS = 1000
GREATEST = 1e15
"""No number of a run is greater; up to here doubles hold whole numbers."""
SENTENCE = 300
"""Longest reason that is shown, characters."""
FOREIGN = (
    *(ValueError, TypeError, KeyError, AttributeError),
    *(OverflowError, RecursionError, MemoryError, OSError),
)
"""What reading a file that a run did not write may raise."""


class ReportError(InputError):
    """A report that cannot be made, or a file that cannot be used; the message says why."""


@dataclasses.dataclass
class Run:
    """What could be read of a run folder."""

    path: Path
    missing: list[str] = dataclasses.field(default_factory=list)
    """One sentence per part that is missing or unusable."""
    config: Config | None = None
    metrics: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    policy: Policy | None = None
    results: list[dict[str, dict[str, Any]]] = dataclasses.field(default_factory=list)
    """The run's own evaluation, suite -> `suite_result`, of each of its seeds."""


def read_run(path: Path) -> Run:
    """Reads what there is.

    Raises:
      ReportError: if there is no folder, or nothing of a run in it.
    """
    folder = RunFolder(path)
    parts = (folder.config, folder.metrics, folder.policy, folder.evaluation)
    if not path.is_dir():
        raise ReportError(f"{path} is no folder; `mjx-balance train` makes one for each run")
    if not any(file.is_file() for file in parts):
        raise ReportError(
            f"{path} is no run folder: it has none of {', '.join(file.name for file in parts)}; "
            "`mjx-balance train` makes one"
        )
    run = Run(path)

    def read(file: Path, parse: Callable[[Path], Any]) -> Any:
        if not file.is_file():
            run.missing.append(f"{file} is {'no file' if file.exists() else 'missing'}")
            return None
        try:
            return parse(file)
        except FOREIGN as error:
            run.missing.append(f"{file} cannot be used: {why(error)}")
            return None

    run.config = read(folder.config, read_config)
    run.metrics = read(folder.metrics, lambda f: _read_metrics(f, run.missing)) or []
    run.policy = read(folder.policy, load_policy)
    own = read(folder.evaluation, lambda f: suite_results(read_json(f)))
    run.results = [own] if own else []
    if folder.seeds_summary.exists():
        run.results = read(folder.seeds_summary, _read_seeds) or run.results
    if not (run.config or run.metrics or run.policy or run.results):
        raise ReportError(f"{path} is no run folder: {'; '.join(run.missing)}")
    return run


def why(error: BaseException) -> str:
    """The reason that an error gives: one short line, with nothing that moves a cursor."""
    reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
    cut = len(reason) > SENTENCE
    reason = " ".join(reason[:SENTENCE].split()) or type(error).__name__
    reason = "".join(letter if letter.isprintable() else "?" for letter in reason)
    return f"{reason} ..." if cut else reason


def section(value: Any, name: str = "it") -> dict[str, Any]:
    """Returns a JSON object; raises `ReportError` for anything else."""
    if not isinstance(value, dict):
        raise ReportError(f"{name} is {short(value)}; it must be a JSON object")
    return value


def series(value: Any, name: str) -> list[Any]:
    """Returns a list; raises `ReportError` for anything else."""
    if not isinstance(value, list):
        raise ReportError(f"{name} is {short(value)}; it must be a list")
    return value


def number(value: Any, name: str) -> float:
    """Returns a finite number; raises `ReportError` for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ReportError(f"{name} is {short(value)}; it must be a number")
    if not abs(value) <= GREATEST:
        raise ReportError(f"{name} is {short(value)}; it must be finite and at most {GREATEST:g}")
    return float(value)


def count(value: Any, name: str) -> int:
    """Returns a whole number; raises `ReportError` for anything else."""
    if type(value) is not int or not 0 <= value <= GREATEST:
        raise ReportError(f"{name} is {short(value)}; it must be a whole number of at least 0")
    return value


def suite_results(value: Any) -> dict[str, dict[str, Any]]:
    """Checks an evaluation: suite -> JSON of `evaluation.summarize`."""
    return {suite: suite_result(result, suite) for suite, result in section(value).items()}


def suite_result(value: Any, suite: str) -> dict[str, Any]:
    """Takes from the JSON of `evaluation.summarize` what a report shows.

    Returns:
      scenarios, falls, tilt_deg {mean, p95, max}, and action_mm_settled or none.

    Raises:
      ReportError: for values that no evaluation gives.
      KeyError: for a value that is missing.
    """
    result = section(value, suite)
    scenarios, falls = (count(result[name], name) for name in ("scenarios", "falls"))
    if falls > scenarios:
        raise ReportError(f"falls is {falls}; it must not exceed scenarios, {scenarios}")
    tilt = section(result["tilt_deg"], "tilt_deg")
    settled = result.get("action_mm_settled")
    return {
        "scenarios": scenarios,
        "falls": falls,
        "tilt_deg": {name: number(tilt[name], name) for name in TILTS},
        "action_mm_settled": None if settled is None else number(settled, "action_mm_settled"),
    }


def _read_seeds(file: Path) -> list[dict[str, dict[str, Any]]]:
    rows = series(section(read_json(file))["seeds"], "seeds")
    if len(rows) > MOST_SEEDS:
        raise ReportError(f"it holds {len(rows)} seeds; at most {MOST_SEEDS} are read")
    return [suite_results(section(row, "a seed")["evaluation"]) for row in rows]


def _read_metrics(file: Path, missing: list[str]) -> list[dict[str, Any]]:
    """The lines up to the first that cannot be used, as a crash leaves one."""
    lines: list[dict[str, Any]] = []
    with file.open("rb") as opened:
        while text := opened.readline(LINE_BYTES + 1):
            if opened.tell() > METRICS_BYTES:
                missing.append(
                    f"{file} is {file.stat().st_size / 2**20:.1f} MiB long; its first "
                    f"{METRICS_BYTES / 2**20:.0f} MiB are shown"
                )
                return lines
            try:
                lines.append(_metrics_line(text, lines))
            except FOREIGN as error:
                missing.append(
                    f"{file} is shown up to line {len(lines) + 1}, which cannot be used: "
                    f"{why(error)}"
                )
                return lines
    if not lines:
        raise ReportError("it holds no line yet")
    return lines


def _metrics_line(text: bytes, before: list[dict[str, Any]]) -> dict[str, Any]:
    """What the learning curves need of a line that follows those `before` it."""
    if len(text) > LINE_BYTES:
        raise ReportError(f"it is longer than {LINE_BYTES:,} bytes")
    found = section(parse_json(text))
    line: dict[str, Any] = {"env_steps": count(found["env_steps"], "env_steps")}
    if before and line["env_steps"] <= before[-1]["env_steps"]:
        raise ReportError(
            f"env_steps is {line['env_steps']}; it must be more than in the line before"
        )
    found.setdefault("train/loss", math.nan)  # before the first update there is none
    line |= {name: _logged(found[name], name) for name, _, _ in CURVES}
    line |= {name: _logged(found[name], name) for name in HELD_OUT if name in found}
    seeds = section(found.get("seeds", {}), "seeds")
    if seeds:
        short = [name.removeprefix("train/") for name, _, _ in CURVES]
        line["seeds"] = {
            name: [_logged(math.nan if x is None else x, name) for x in series(seeds[name], name)]
            for name in (*short, *HELD_OUT)
            if name in seeds
        }
    if 0 in _counts(line).values():
        raise ReportError("it holds no seed")
    if before and _counts(line) != _counts(before[0]):
        raise ReportError("other seeds than in line 1")
    return line


def _counts(line: dict[str, Any]) -> dict[str, int]:
    """Number of seeds that a line has of each metric that every line has."""
    seeds = line.get("seeds", {})
    return {name: len(values) for name, values in seeds.items() if name not in HELD_OUT}


def _logged(value: Any, name: str) -> float:
    """A metric; where there was none, or a training diverged, there is a gap."""
    if isinstance(value, float) and not math.isfinite(value):
        return math.nan
    return number(value, name)
