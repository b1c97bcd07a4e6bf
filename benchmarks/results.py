"""How well do the shipped policies balance? Policies and baselines on every suite.

Every evaluation is kept in `--out` as soon as it is done, with the digest of the code and the scene
that gave it, so that an interrupted run goes on where it stopped. A result that other code gave
stands if its first scenarios give the same mean tilt again, to a millionth of a degree, as machines
round differently; otherwise it is measured again.

    python benchmarks/results.py policies/seeds/*.safetensors --write docs/results.md
"""

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import common
import numpy as np
from common import DURATION, Row
from rich.console import Console

from mjx_balance.evaluation.controllers import CONTROLLERS, Controller, make_controller
from mjx_balance.evaluation.envelope import Envelope, envelope
from mjx_balance.evaluation.rollout import observing, policy_scene, run_suite, summarize
from mjx_balance.evaluation.statistics import TILTS, over_seeds
from mjx_balance.evaluation.suites import HEADLINE, SEEDS, SUITES
from mjx_balance.files.run_folder import write_json
from mjx_balance.policy.file import load_policy
from mjx_balance.policy.network import Policy
from mjx_balance.report.measuring import ENVELOPE_DURATION, ENVELOPE_SCENARIOS, code_digest
from mjx_balance.report.progress import Display
from mjx_balance.sim.scene import Scene

BOARDS = ("fast", "steep")
SAME_DEG = 1e-6
"""Mean tilts that differ by less are the same: machines round differently, deg."""


def cached(
    out: Path,
    key: str,
    scene: Scene,
    title: str,
    measure: Callable[[Any], Row],
    same: Callable[[Row, Any], bool] = lambda old, bar: False,
) -> Row:
    """Reads the result `key` from `out`, or measures it and writes it there.

    `same` says whether a result of other code holds all the same. Both take a progress bar.
    """
    code = f"{code_digest()}, scene {scene.hash}"
    known = json.loads(out.read_text()) if out.is_file() else {}
    old = known.get(key)
    if old is None or old["code"] != code:
        with Display(Console(stderr=True)).bar(title) as bar:
            row = old if old is not None and same(old, bar) else measure(bar)
        known[key] = row | {"code": code}
        write_json(out, known)
    return known[key]


def suite_result(
    out: Path,
    name: str,
    policy: Policy,
    make: Callable[[], Controller],
    suite: str,
    scenarios: int,
    parts: tuple[int, ...],
) -> Row:
    """Evaluates one controller on one suite; `mean_of_first` has its mean tilt over `parts`."""
    scene, few = policy_scene(policy), min(parts)

    def measure(bar: Any, count: int = scenarios) -> Row:
        rollout = run_suite(scene, make(), suite, count, DURATION, SEEDS.held_out, bar)
        firsts = {str(n): float(rollout.tilt[:n].mean()) for n in parts if n <= count}
        return summarize(rollout, suite, DURATION, SEEDS.held_out) | {"mean_of_first": firsts}

    def same(old: Row, bar: Any) -> bool:
        if few >= scenarios:
            return False
        again, before = measure(bar, few)["mean_of_first"], old["mean_of_first"]
        return abs(again[str(few)] - before[str(few)]) < SAME_DEG

    task = policy.config.task
    key = f"{name}, {task.action}, ramp {task.action_ramp}, {suite}, {scenarios} x {DURATION:g} s"
    key += f", seed {SEEDS.held_out}"
    return cached(out, key, scene, f"{name}, {suite}, {scenarios} scenarios", measure, same)


def fall_free_share(out: Path, policy: Policy) -> float:
    """Share of the feasible envelope in which a policy does not fall; 0: nothing is feasible."""
    scene = policy_scene(policy)

    def measure(bar: Any) -> Row:
        size = ENVELOPE_SCENARIOS, ENVELOPE_DURATION, SEEDS.held_out
        return vars(envelope(scene, observing(policy), *size, bar))

    key = f"envelope of policy {policy.fingerprint}, "
    key += f"{ENVELOPE_SCENARIOS} x {ENVELOPE_DURATION:g} s, seed {SEEDS.held_out}"
    fields = dict(cached(out, key, scene, "envelope", measure))
    del fields["code"]
    return Envelope(**fields).fall_free_share or 0.0


def suite_row(suite: str, networks: list[Row]) -> Row:
    """The networks' own cells of a suite."""
    seeds = over_seeds(networks)
    row = {"suite": suite, "falls": f"{seeds['falls']} of {seeds['scenarios']:,}"}
    for title, name in zip(("mean tilt deg", "p95", "max"), TILTS, strict=True):
        row[title] = "{iqm:.3f} [{low:.3f}, {high:.3f}]".format(**seeds[name])
    return row | {"worst seed": " / ".join(f"{seeds[name]['worst']:.3f}" for name in TILTS)}


def baseline_cell(result: Row, networks: list[Row]) -> str:
    """A baseline's mean tilt, how much more that is than the networks', and its falls."""
    mean, count = result["tilt_deg"]["mean"], str(result["scenarios"])
    more = mean - np.mean([network["mean_of_first"][count] for network in networks])
    fell = f", {result['falls']} fall" if result["falls"] else ""
    return f"{mean:.3f} ({more:+.3f}{fell})"


def main() -> None:
    """Measures what is missing and prints the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--scenarios", type=int, default=2000, help="of suites paper and corner")
    parser.add_argument("--others", type=int, default=500, help="of other suites, and of pd-imu")
    parser.add_argument(
        "--rest", type=int, default=64, help="of suites fast and steep, and of other baselines"
    )
    parser.add_argument("--suites", nargs="+", default=list(SUITES), choices=SUITES)
    parser.add_argument("--out", type=Path, default=common.REPO / "benchmarks" / "results.json")
    args = parser.parse_args()
    policies = [load_policy(path) for path in args.policies]
    first, parts = policies[0], (args.rest, args.others)
    baselines, rows = [name for name in CONTROLLERS if name != "none"], []
    settled: list[float] = []
    for suite in args.suites:
        usual = args.rest if suite in BOARDS else args.others
        count = args.scenarios if suite in HEADLINE else usual
        networks = []
        for policy in policies:
            make = functools.partial(observing, policy)
            name = f"policy {policy.fingerprint}"
            networks.append(suite_result(args.out, name, policy, make, suite, count, parts))
        settled += [x["action_mm_settled"] or 0 for x in networks]  # only ramps have a rest
        rows.append(suite_row(suite, networks))
        for name in baselines:
            make = functools.partial(make_controller, name, policy_scene(first))
            count = usual if name == "pd-imu" else args.rest
            result = suite_result(args.out, name, first, make, suite, count, parts)
            rows[-1][name] = baseline_cell(result, networks)
    share = min(fall_free_share(args.out, policy) for policy in policies)
    note = (
        f"{len(policies)} training seeds (interquartile mean, 95% bootstrap interval), scenarios "
        f"of {DURATION:g} s whose seeds training never sees. Baselines: mean tilt, and how much "
        "more that is than the networks' mean over the same scenarios: `pd-imu` over the first "
        f"{args.others:,} ({args.rest:,} in `fast` and `steep`), the others over the first "
        f"{args.rest:,}. Fall-free share of the feasible envelope: {share:.2f} (worst seed). "
        "Commanded action while the board rests, greatest mean of a suite and seed: "
        f"{max(settled):.3f} mm."
    )
    common.report(args, "results", rows, note)


if __name__ == "__main__":
    main()
