"""Reads of a run folder, incomplete, damaged or foreign, what the report uses, and checks it."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Le, MaxLen, MinLen
from pydantic import WrapValidator

from mjx_balance.config import Config, read_config
from mjx_balance.errors import MESSAGE, InputError, quote, shorten
from mjx_balance.files.run_folder import RunFolder, check_contained, parse_json, read_json
from mjx_balance.files.validation import STRICT, parse
from mjx_balance.policy.file import Policy, load_policy
from mjx_balance.report.figures import CURVES, HELD_OUT

METRICS_BYTES = 8 * 2**20  #: bytes of metrics.jsonl that are read; the rest is ignored
LINE_BYTES = 2**18  #: greatest length of a line of metrics.jsonl
MOST_SEEDS = 1000
GREATEST = 1e15  #: bound of every number of a run; doubles represent all integers up to here
FOREIGN = (
    *(ValueError, TypeError, KeyError, AttributeError),
    *(OverflowError, RecursionError, MemoryError, OSError),
)
"""Errors that reading a foreign file may raise."""


class ReportError(InputError):
    """A report that cannot be written, or a file that cannot be used; the message says why."""


@dataclasses.dataclass
class Run:
    """The readable parts of a run folder."""

    path: Path
    missing: list[str] = dataclasses.field(default_factory=list)  #: a sentence per missing part
    config: Config | None = None
    metrics: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    policy: Policy | None = None
    results: list[dict[str, dict[str, Any]]] = dataclasses.field(default_factory=list)
    """For each training seed its evaluation after training; see `suite_results`."""


def read_run(path: Path) -> Run:
    """Reads all usable parts of a run folder.

    Raises:
      ReportError: if the folder does not exist or holds no part of a run.
      RunFolderError: as `check_contained`.
    """
    folder, run = RunFolder(path), Run(path)
    parts = (folder.config, folder.metrics, folder.policy, folder.evaluation)
    if not path.is_dir():
        raise ReportError(f"{path} is no folder; `mjx-balance train` makes one for each run")
    if not any(file.is_file() for file in parts):
        raise ReportError(
            f"{path} is no run folder: it has none of {', '.join(file.name for file in parts)}; "
            "`mjx-balance train` makes one"
        )
    check_contained(path)

    def read(file: Path, parse: Callable[[Path], Any]) -> Any:
        if not file.is_file():
            run.missing.append(f"{file} is {'no file' if file.exists() else 'missing'}")
            return None
        try:
            return parse(file)
        except FOREIGN as error:
            run.missing.append(f"{file} cannot be used: {error_text(error)}")
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


def error_text(error: BaseException) -> str:
    """An error's message in one short line."""
    reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
    return shorten(reason, MESSAGE) or type(error).__name__


def _or_gap(value: Any, check: Callable[[Any], float]) -> float:
    """NaN for a value that is not finite, as after a divergence."""
    gap = isinstance(value, float) and not math.isfinite(value)
    return math.nan if gap else check(value)


LENIENT = STRICT | {"extra": "ignore"}
Finite = Annotated[float, Ge(-GREATEST), Le(GREATEST)]
Count = Annotated[int, Ge(0), Le(GREATEST)]
Metric = Annotated[Finite, WrapValidator(_or_gap)]
SeedMetric = Annotated[Metric, WrapValidator(lambda x, check: math.nan if x is None else check(x))]


@dataclasses.dataclass(frozen=True)
class Tilt:
    """Statistics of the body tilt over all physics steps, deg."""

    __pydantic_config__ = LENIENT

    mean: Finite
    p95: Finite
    max: Finite


@dataclasses.dataclass(frozen=True)
class SuiteResult:
    """The fields of `rollout.summarize` that a report uses."""

    __pydantic_config__ = LENIENT

    scenarios: Count
    falls: Count
    tilt_deg: Tilt
    action_mm_settled: Finite | None = None


@dataclasses.dataclass(frozen=True)
class _Seed:
    __pydantic_config__ = LENIENT

    evaluation: dict[str, SuiteResult]


@dataclasses.dataclass(frozen=True)
class _Seeds:
    __pydantic_config__ = LENIENT

    seeds: Annotated[list[_Seed], MaxLen(MOST_SEEDS)]


@dataclasses.dataclass(frozen=True)
class _Line:
    env_steps: Count
    metrics: dict[str, Metric]
    seeds: dict[str, Annotated[list[SeedMetric], MinLen(1)]]


def suite_results(value: Any) -> dict[str, dict[str, Any]]:
    """Checks an evaluation, suite -> JSON of `rollout.summarize`.

    Returns:
      Suite -> the fields of `SuiteResult`.

    Raises:
      ReportError: for a value that no evaluation returns.
    """
    results = parse(dict[str, SuiteResult], value, ReportError, name="it")
    return {suite: _as_dict(result) for suite, result in results.items()}


def _as_dict(result: SuiteResult) -> dict[str, Any]:
    if result.falls > result.scenarios:
        raise ReportError(
            f"falls is {result.falls}; it must not exceed scenarios, {result.scenarios}"
        )
    return dataclasses.asdict(result)


def _read_seeds(file: Path) -> list[dict[str, dict[str, Any]]]:
    rows = parse(_Seeds, read_json(file), ReportError, name="it").seeds
    return [{suite: _as_dict(x) for suite, x in row.evaluation.items()} for row in rows]


def _read_metrics(file: Path, missing: list[str]) -> list[dict[str, Any]]:
    """The lines before the first unusable one, such as a crash leaves."""
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
                    f"{error_text(error)}"
                )
                return lines
    if not lines:
        raise ReportError("it holds no line yet")
    return lines


def _metrics_line(text: bytes, before: list[dict[str, Any]]) -> dict[str, Any]:
    """The values of a line that learning curves use; `before` holds the earlier lines."""
    if len(text) > LINE_BYTES:
        raise ReportError(f"it is longer than {LINE_BYTES:,} bytes")
    values = parse_json(text)
    seeds = values.get("seeds", {}) if isinstance(values, dict) else None
    if not isinstance(seeds, dict):
        raise ReportError(f"it is {quote(values)}; it must map metrics to values")
    values.setdefault("train/loss", math.nan)  # missing before the first update
    curves = [name for name, _, _ in CURVES]
    names = (*curves, *(name for name in HELD_OUT if name in values))
    of_seeds = (*(name.removeprefix("train/") for name in curves), *HELD_OUT)
    parts = {
        "env_steps": values.get("env_steps"),
        "metrics": {name: values.get(name) for name in names},
        "seeds": {name: seeds[name] for name in of_seeds if name in seeds},
    }
    line = parse(_Line, parts, ReportError)
    if before and line.env_steps <= before[-1]["env_steps"]:
        raise ReportError(f"env_steps is {line.env_steps}; it must be more than in the line before")
    result = {"env_steps": line.env_steps, **line.metrics}
    if seeds:
        result["seeds"] = line.seeds
    if before and _counts(result) != _counts(before[0]):
        raise ReportError("other seeds than in line 1")
    return result


def _counts(line: dict[str, Any]) -> set[int]:
    """Number of seeds; more than one if metrics differ. Not every metric is in every line."""
    return {len(values) for values in line.get("seeds", {}).values()}
