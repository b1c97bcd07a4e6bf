"""Simulations that a report needs: policy and baselines on the same scenarios."""

import contextlib
import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
from annotated_types import Len

from mjx_balance.config import to_dict
from mjx_balance.evaluation.controllers import CONTROLLERS, Controller, make_controller
from mjx_balance.evaluation.envelope import Envelope, envelope
from mjx_balance.evaluation.rollout import (
    GreedyPolicy,
    Progress,
    Rollout,
    observing,
    run_suite,
    summarize,
)
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.files.run_folder import read_json, write_atomically
from mjx_balance.files.sources import code
from mjx_balance.files.validation import parse
from mjx_balance.policy.file import Policy
from mjx_balance.report.progress import Stage, part
from mjx_balance.report.reading import FOREIGN, Finite, ReportError, suite_results
from mjx_balance.sim.scene import Scene

DURATION = 60.0
ENVELOPE_SCENARIOS = 2
ENVELOPE_DURATION = 30.0
ENVELOPE_GRID = {
    "inclines": (2.0, 4.0, 6.0, 8.0, 10.0, 12.0),
    "rates": (2.5, 3.0, 3.5, 4.0, 4.5, 5.0),
}
RECORD_SECONDS = 100.0  #: as long as the paper's Fig. 7
VIDEO_SECONDS = 8.0
BINS = 161  #: of the tilt distribution
NAMES = ("policy", *CONTROLLERS)  #: of all that is measured
STAGES = len(HEADLINE) + 1  #: of a measurement
_Shares = dict[str, dict[str, Annotated[list[Finite], Len(BINS, BINS)]]]


@dataclasses.dataclass(frozen=True)
class Measurements:
    """Results of a policy and of the baselines on the same scenarios."""

    results: dict[str, dict[str, dict[str, Any]]]  #: controller -> suite -> `SuiteResult`
    shares: dict[str, dict[str, list[float]]]  #: controller -> suite -> share per bin of tilt
    envelope: Envelope  #: of the policy


def code_digest() -> str:
    """Digest of MuJoCo's version and of the evaluation's code: other code gives other results."""
    sources = code(Envelope.__module__)
    parts = [mujoco.__version__, *(f"{name}:{text}" for name, text in sorted(sources.items()))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def edges(fail_tilt: float) -> np.ndarray:
    """(BINS + 1,) bounds of the tilt bins, deg. The last bin holds the steps after a fall."""
    return np.concatenate(([0.0], np.geomspace(0.01, fail_tilt, BINS - 1), [fail_tilt + 1e-4]))


def load(policy: Policy, scene: Scene, file: Path, scenarios: int) -> Measurements | None:
    """Reads an earlier result of the same measurement; None if the file holds none.

    Args:
      policy: has the name `policy` in the results.
      scene: the policy's.
      file: JSON file of `measure`; one that is damaged or outdated counts as none.
      scenarios: per suite and controller.
    """
    with contextlib.suppress(*FOREIGN):  # an unusable file is replaced
        saved = read_json(file)
        if saved["key"] == _key(policy, scene, scenarios):
            return parse_measurements(saved)
    return None


def measure(policy: Policy, scene: Scene, file: Path, scenarios: int, stage: Stage) -> Measurements:
    """Measures policy and baselines, in `STAGES` stages, and stores the result for `load`."""
    result = _measure(policy, scene, scenarios, stage)
    saved = {"key": _key(policy, scene, scenarios), **dataclasses.asdict(result)}
    with contextlib.suppress(OSError):  # a read-only folder stores nothing
        write_atomically(file, json.dumps(saved) + "\n")
    return result


def _key(policy: Policy, scene: Scene, scenarios: int) -> list[Any]:
    """All that decides a result, as JSON values."""
    key = [policy.fingerprint, to_dict(policy.config), scene.hash, code_digest(), scenarios]
    key += [DURATION, SEEDS.report, ENVELOPE_SCENARIOS, ENVELOPE_DURATION]
    return [*key, *map(list, ENVELOPE_GRID.values())]


def parse_measurements(saved: dict[str, Any]) -> Measurements:
    """Checks a stored result, JSON of `Measurements`, value by value.

    Raises:
      ReportError: for an invalid value.
      KeyError: for a missing one.
    """
    results, shares = saved["results"], parse(_Shares, saved["shares"], ReportError)
    cells = parse(Envelope, saved["envelope"], ReportError)
    for grid in (cells.fall_rate, cells.mean_tilt):
        if np.shape(grid) != (len(cells.inclines), len(cells.rates)):
            raise ReportError("a grid has another shape than its inclines and rates")
    if not all(np.isfinite(values).all() for values in dataclasses.astuple(cells)):
        raise ReportError("the envelope holds values that are not finite")
    return Measurements(
        {name: suite_results({x: results[name][x] for x in HEADLINE}) for name in NAMES},
        {name: {x: shares[name][x] for x in HEADLINE} for name in NAMES},
        cells,
    )


def _measure(policy: Policy, scene: Scene, scenarios: int, stage: Stage) -> Measurements:
    summaries: dict[str, dict[str, Any]] = {name: {} for name in NAMES}
    shares: dict[str, dict[str, list[float]]] = {name: {} for name in NAMES}
    size, seed = (scenarios, DURATION), SEEDS.report
    for suite in HEADLINE:
        with stage(f"policy and baselines, suite {suite}") as bar:
            for k, name in enumerate(NAMES):
                controller = _controller(name, policy, scene)
                rollout = run_suite(scene, controller, suite, *size, seed, part(bar, k, len(NAMES)))
                summaries[name][suite] = summarize(rollout, suite, DURATION, seed)
                counts, _ = np.histogram(rollout.tilt, edges(policy.config.task.fail_tilt))
                shares[name][suite] = (counts / counts.sum()).tolist()
    results = {name: suite_results(summary) for name, summary in summaries.items()}
    size = (ENVELOPE_SCENARIOS, ENVELOPE_DURATION)
    with stage("envelope") as bar:
        cells = envelope(scene, observing(policy), *size, seed, bar, **ENVELOPE_GRID)
    return Measurements(results, shares, cells)


def record_rollout(
    policy: GreedyPolicy,
    scene: Scene,
    suite: str,
    duration: float,
    seed: int,
    controller: str = "policy",
    progress: Progress = lambda share: None,
) -> Rollout:
    """Runs one scenario of `duration` s and records every state, for a figure or a video.

    The controller is `policy`, or the name of a baseline to run in its place.
    """
    acting = _controller(controller, policy, scene)
    return run_suite(scene, acting, suite, 1, duration, seed, progress, record=True)


def _controller(name: str, policy: GreedyPolicy, scene: Scene) -> Controller:
    return observing(policy) if name == "policy" else make_controller(name, scene)
