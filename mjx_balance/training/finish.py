"""The end of a run: a policy per seed, their evaluation, the best one, figures, a summary."""

import dataclasses
import json
import shutil
import time
from typing import Any

import jax
from tensorboardX import SummaryWriter

from mjx_balance import evaluation
from mjx_balance.config import Config
from mjx_balance.display import Display
from mjx_balance.dqn.learner import Learner, TrainState
from mjx_balance.policy import Policy, flat_weights, load_policy, make_manifest, save_policy
from mjx_balance.report import figures, measuring, tables
from mjx_balance.run_folder import RunFolder
from mjx_balance.statistics import over_seeds
from mjx_balance.suites import HEADLINE, SEEDS
from mjx_balance.training.loop import number

VALIDATION_SCENARIOS = 32

Results = dict[str, dict[str, Any]]
"""Suite name -> JSON of `evaluation.summarize`."""


def export(
    config: Config,
    learner: Learner,
    scene_hash: str,
    folder: RunFolder,
    state: TrainState,
    seconds: float,
) -> list[Policy]:
    """Writes one policy per seed; the first also as the run's, until a better one is known."""
    known = state._replace(env_state=None, replay=None)  # pyright: ignore[reportArgumentType]
    policies = []
    for k in range(config.num_seeds):
        mine = jax.tree.map(lambda x: x[k], known) if config.num_seeds > 1 else known  # noqa: B023
        mine = jax.device_get(learner.exported(mine))
        provenance = {
            "env_steps": number(state.env_steps),
            "gradient_steps": number(state.gradient_steps),
            "seconds_learning_since_start_or_resume": round(seconds, 1),
            "device": jax.devices()[0].device_kind,
            "date": time.strftime("%Y-%m-%d"),
        }
        own = dataclasses.replace(config, seed=config.seed + k, num_seeds=1)
        manifest = make_manifest(own, scene_hash, provenance)
        if config.num_seeds > 1:
            folder.seeds.mkdir(exist_ok=True)
            save_policy(folder.seeds / f"seed-{own.seed}.safetensors", mine, manifest)
        if k == 0:
            save_policy(folder.policy, mine, manifest)
        policies.append(Policy(manifest, flat_weights(mine)))
    return policies


def finish(
    config: Config, policies: list[Policy], folder: RunFolder, display: Display, began: float
) -> Results:
    """Evaluates every seed, makes the best one the run's policy, draws and sums up."""
    scenarios, duration = config.eval_scenarios, config.eval_duration
    each = [
        {
            suite: _evaluate(policy, suite, scenarios, duration, SEEDS.final, title, display)
            for suite in HEADLINE
        }
        for policy in policies
        for title in [f", seed {policy.config.seed}" if len(policies) > 1 else ""]
    ]
    best = _choose(policies, each, duration, folder, display) if len(policies) > 1 else 0
    results = each[best]
    with SummaryWriter(str(folder.tensorboard)) as board:
        for suite, result in results.items():
            board.add_scalar(f"eval/{suite}/falls", result["falls"], config.num_env_steps)
            for name, value in result["tilt_deg"].items():
                board.add_scalar(f"eval/{suite}/tilt_{name}", value, config.num_env_steps)
    with display.phase("drawing figures"):
        _draw(folder)
    folder.evaluation.write_text(json.dumps(results, indent=2) + "\n")
    tables.print_summary(display.console, folder.path, results, time.perf_counter() - began)
    return results


def _draw(folder: RunFolder) -> None:
    policy = load_policy(folder.policy)
    lines = [json.loads(text) for text in folder.metrics.read_text().splitlines()]
    shown = measuring.recorded(policy, "paper", measuring.RECORD_SECONDS, SEEDS.record)
    scene = evaluation.policy_scene(policy)
    figures.draw_figures(folder.figures, lines, policy.config.task, scene, {"policy": shown})


def _evaluate(
    policy: Policy,
    suite: str,
    scenarios: int,
    duration: float,
    seed: int,
    whose: str,
    display: Display,
) -> dict[str, Any]:
    doing = "validating" if seed == SEEDS.validation else "evaluating in plain MuJoCo"
    with display.bar(f"{doing}, suite {suite}{whose}") as bar:
        return evaluation.evaluate(policy, suite, scenarios, duration, seed, bar)


def _choose(
    policies: list[Policy],
    each: list[Results],
    duration: float,
    folder: RunFolder,
    display: Display,
) -> int:
    """Validates every seed, makes the best one the run's policy, writes seeds.json."""
    scores, rows = [], []
    for policy, results in zip(policies, each, strict=True):
        whose = f", seed {policy.config.seed}"
        count, seed = VALIDATION_SCENARIOS, SEEDS.validation
        validated = {
            suite: _evaluate(policy, suite, count, duration, seed, whose, display)
            for suite in HEADLINE
        }
        scores.append(_score(validated))
        rows.append({"seed": policy.config.seed, "validation": validated, "evaluation": results})
    best = scores.index(min(scores))
    chosen = folder.seeds / f"seed-{policies[best].config.seed}.safetensors"
    shutil.copyfile(chosen, folder.policy)
    summary = {suite: over_seeds([results[suite] for results in each]) for suite in HEADLINE}
    written = {"best": policies[best].config.seed, "statistics": summary, "seeds": rows}
    folder.seeds_summary.write_text(json.dumps(written, indent=2) + "\n")
    display.say(f"best of the {len(policies)} seeds on the validation set: {written['best']}")
    display.console.print(tables.seeds_table(summary))
    return best


def _score(results: Results) -> tuple[int, float]:
    """Falls and mean tilt over all suites: less is better, falls first."""
    falls = sum(result["falls"] for result in results.values())
    return falls, sum(result["tilt_deg"]["mean"] for result in results.values())
