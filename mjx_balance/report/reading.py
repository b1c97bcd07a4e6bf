"""What can be read of a run folder, whole or not."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mjx_balance.config import Config, check, from_dict
from mjx_balance.policy import Policy, load_policy
from mjx_balance.report.figures import CURVES
from mjx_balance.run_folder import RunFolder
from mjx_balance.statistics import over_seeds

FOREIGN = (ValueError, KeyError, TypeError, AttributeError)
"""What reading JSON that a run did not write may raise."""


class ReportError(ValueError):
    """A report that cannot be made; the message says why."""


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
    """The run's own evaluation, suite -> JSON, of each of its seeds."""


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
            run.missing.append(f"{file} is missing")
            return None
        try:
            return parse(file)
        except (*FOREIGN, OSError) as error:
            run.missing.append(f"{file} cannot be used: {_why(error)}")
            return None

    run.config = read(folder.config, lambda f: check(from_dict(Config, json.loads(f.read_text()))))
    run.metrics = read(folder.metrics, lambda f: _read_metrics(f, run.missing)) or []
    run.policy = read(folder.policy, load_policy)
    own = read(folder.evaluation, lambda f: _checked(json.loads(f.read_text())))
    run.results = [own] if own else []
    if folder.seeds_summary.is_file():
        run.results = read(folder.seeds_summary, _read_seeds) or run.results
    if not (run.config or run.metrics or run.policy or run.results):
        raise ReportError(f"{path} is no run folder: {'; '.join(run.missing)}")
    return run


def _why(error: Exception) -> str:
    return f"it has no {error}" if isinstance(error, KeyError) else str(error)


def _read_metrics(file: Path, missing: list[str]) -> list[dict[str, Any]]:
    """The lines up to the first that cannot be used, as a crash leaves one."""
    lines: list[dict[str, Any]] = []
    texts = file.read_text().splitlines()
    if not texts:
        raise ValueError("it holds no line yet")
    for number, text in enumerate(texts, 1):
        try:
            line = json.loads(text)
            for name in ("env_steps", *(name for name, _, _ in CURVES)):
                float(line[name])
            seeds = {name: len(values) for name, values in line.get("seeds", {}).items()}
            if lines and seeds != {name: len(x) for name, x in lines[0].get("seeds", {}).items()}:
                raise ValueError("other seeds than in line 1")
        except FOREIGN as error:
            why = _why(error)
            missing.append(f"{file} is shown up to line {number}, which cannot be used: {why}")
            break
        lines.append(line)
    return lines


def _read_seeds(file: Path) -> list[dict[str, dict[str, Any]]]:
    return [_checked(row["evaluation"]) for row in json.loads(file.read_text())["seeds"]]


def _checked(results: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Returns a run's evaluation if it has what the report takes from it."""
    for result in results.values():
        over_seeds([result])
    return results
