"""Measures policies and baselines on every suite and writes the README's tables.

Every evaluation is kept in `--out` as soon as it is done, with the digest of the code and
the scene that gave it, so that an interrupted run goes on where it stopped. A result that
other code gave stands if its first scenarios give the same mean tilt again, to a millionth
of a degree, as machines round differently; otherwise it is measured again. `--write` puts
the tables between the markers of a Markdown file.

    python benchmarks/results.py policies/seeds/*.safetensors --write README.md
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from markers import publish, table
from rich.console import Console

from mjx_balance import load_policy
from mjx_balance.evaluation.controllers import CONTROLLERS, make_controller
from mjx_balance.evaluation.rollout import (
    Controller,
    Envelope,
    envelope,
    observing,
    policy_scene,
    run_suite,
    summarize,
)
from mjx_balance.evaluation.statistics import TILTS, over_seeds
from mjx_balance.evaluation.suites import HEADLINE, SEEDS, SUITES
from mjx_balance.policy.file import Policy
from mjx_balance.report.digest import code_digest
from mjx_balance.report.measuring import ENVELOPE_DURATION, ENVELOPE_SCENARIOS
from mjx_balance.report.progress import Display

DURATION = 60.0
BOARDS = ("fast", "steep")
SAME_DEG = 1e-6
"""Mean tilts that differ by less are the same: machines round differently, deg."""


def measured(
    out: Path,
    key: str,
    stamp: str,
    title: str,
    measure: Callable[[Any], dict[str, Any]],
    same: Callable[[dict[str, Any], Any], bool] = lambda kept, bar: False,
) -> dict[str, Any]:
    """Reads a result from `out`, or measures it and keeps it there.

    Args:
      out: JSON file.
      key: of the result: who, and on what.
      stamp: of the code and scene that would measure it now.
      title: of the progress bar.
      measure: takes a progress bar.
      same: whether a result with another stamp holds all the same; takes it and a bar.
    """
    known = json.loads(out.read_text()) if out.is_file() else {}
    kept = known.get(key)
    if kept is not None and kept.get("code") == stamp:
        return kept
    with Display(Console(stderr=True)).bar(title) as bar:
        found = kept if kept is not None and same(kept, bar) else measure(bar)
    known[key] = found | {"code": stamp}
    part = out.with_suffix(".part")
    part.write_text(json.dumps(known, indent=1) + "\n")
    part.replace(out)
    return known[key]


def suite_result(
    out: Path,
    name: str,
    policy: Policy,
    make: Callable[[], Controller],
    suite: str,
    scenarios: int,
    parts: tuple[int, ...],
) -> dict[str, Any]:
    """Evaluates one controller on one suite; `mean_of_first` has its mean tilt over `parts`."""
    scene, config = policy_scene(policy), policy.config

    def measure(bar: Any, count: int = scenarios) -> dict[str, Any]:
        rollout = run_suite(scene, make(), suite, count, DURATION, SEEDS.held_out, bar)
        firsts = {str(n): float(rollout.tilt[:n].mean()) for n in parts if n <= count}
        return summarize(rollout, suite, DURATION, SEEDS.held_out) | {"mean_of_first": firsts}

    def same(kept: dict[str, Any], bar: Any) -> bool:
        few = min(parts)
        if few >= scenarios:
            return False
        again, before = measure(bar, few)["mean_of_first"], kept["mean_of_first"]
        return abs(again[str(few)] - before[str(few)]) < SAME_DEG

    key = f"{name}, ramp {config.task.action_ramp}, {suite}, {scenarios} x {DURATION:g} s, seed "
    key += str(SEEDS.held_out)
    stamp = f"{code_digest()}, scene {scene.hash}"
    return measured(out, key, stamp, f"{name}, {suite}, {scenarios} scenarios", measure, same)


def suite_table(
    networks: dict[str, list[dict[str, Any]]], baselines: dict[str, dict[str, dict[str, Any]]]
) -> list[str]:
    """One row per suite: the networks over their seeds, the baselines' mean tilt and falls."""
    names = [name for name in CONTROLLERS if name != "none"]
    rows = []
    for suite, results in networks.items():
        row = over_seeds(results)
        cells = [f"`{suite}`", f"{row['falls']} of {row['scenarios']:,}"]
        cells += [f"{row[x]['iqm']:.3f} [{row[x]['low']:.3f}, {row[x]['high']:.3f}]" for x in TILTS]
        cells.append(" / ".join(f"{row[x]['worst']:.3f}" for x in TILTS))
        for name in names:
            result = baselines[name][suite]
            mean, same = result["tilt_deg"]["mean"], str(result["scenarios"])
            more = mean - np.mean([r["mean_of_first"][same] for r in results])
            fell = f", {result['falls']} fall" if result["falls"] else ""
            cells.append(f"{mean:.3f} ({more:+.3f}{fell})")
        rows.append(cells)
    columns = ["suite", "falls", "mean tilt deg", "p95", "max", "worst seed"]
    return table(columns + [f"`{name}`" for name in names], rows)


def main() -> None:
    """Measures what is missing and prints the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--scenarios", type=int, default=2000, help="of suites paper and corner")
    parser.add_argument(
        "--others", type=int, default=500, help="of the suites with other circumstances, and pd-imu"
    )
    parser.add_argument(
        "--rest", type=int, default=64, help="of suites fast and steep, and the other baselines"
    )
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results.json"))
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    policies = [load_policy(path) for path in args.policies]
    first = policies[0]
    scene = policy_scene(first)
    parts = (args.rest, args.others)
    networks: dict[str, list[dict[str, Any]]] = {}
    baselines: dict[str, dict[str, dict[str, Any]]] = {name: {} for name in CONTROLLERS}
    for suite in SUITES:
        usual = args.rest if suite in BOARDS else args.others
        count = args.scenarios if suite in HEADLINE else usual
        networks[suite] = [
            suite_result(
                args.out,
                f"policy {policy.fingerprint}",
                policy,
                lambda policy=policy: observing(policy),
                suite,
                count,
                parts,
            )
            for policy in policies
        ]
        for name in CONTROLLERS:
            baselines[name][suite] = suite_result(
                args.out,
                name,
                first,
                lambda name=name: make_controller(name, scene),
                suite,
                usual if name == "pd-imu" else args.rest,
                parts,
            )
    shares = []
    for policy in policies:

        def measure(bar: Any, policy: Policy = policy) -> dict[str, Any]:
            found = envelope(
                scene,
                observing(policy),
                ENVELOPE_SCENARIOS,
                ENVELOPE_DURATION,
                SEEDS.held_out,
                bar,
            )
            return vars(found)

        key = f"envelope of policy {policy.fingerprint}, "
        key += f"{ENVELOPE_SCENARIOS} x {ENVELOPE_DURATION:g} s, seed {SEEDS.held_out}"
        stamp = f"{code_digest()}, scene {scene.hash}"
        kept = measured(args.out, key, stamp, "envelope", measure)
        fields = {name: value for name, value in kept.items() if name != "code"}
        shares.append(Envelope(**fields).fall_free_share)
    settled = max(r["action_mm_settled"] for results in networks.values() for r in results)
    note = (
        f"{len(policies)} training seeds (interquartile mean, 95% bootstrap interval), scenarios "
        f"of {DURATION:g} s whose seeds training never sees. Baselines: mean tilt, and how much "
        "more that is than the networks' mean over the same scenarios: `pd-imu` over the first "
        f"{args.others:,} ({args.rest:,} in `fast` and `steep`), the others over the first "
        f"{args.rest:,}. Fall-free share of the feasible envelope: {min(shares):.2f} (worst seed). "
        "Commanded action while the board rests, greatest mean of a suite and seed: "
        f"{settled:.3f} mm."
    )
    publish("results", [*suite_table(networks, baselines), "", note], args.write)


if __name__ == "__main__":
    main()
