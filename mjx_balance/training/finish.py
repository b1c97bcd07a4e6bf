"""The end of a run: a policy per seed, their evaluation, the best one, figures, a summary."""

import json
import shutil
import time
from typing import Any

from tensorboardX import SummaryWriter

from mjx_balance.config import Config, ConfigError, expand_runs, sweep_grid
from mjx_balance.dqn import DQN, TrainState
from mjx_balance.evaluation import rollout as evaluation
from mjx_balance.evaluation.statistics import over_seeds
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.files.run_folder import RunFolder, write_atomically, write_json
from mjx_balance.policy.file import Policy, PolicyError, load_policy, save_policy
from mjx_balance.report import tables
from mjx_balance.report.progress import Display
from mjx_balance.training.program_cache import LogFn
from mjx_balance.training.validation import Results, best_validated, exports, scalars, score

CHOICE_SCENARIOS = 32
"""Scenarios per suite by which one of several seeds is chosen."""
FINAL = "final"
"""TensorBoard's name for the evaluation after training, which has the validations' tags."""


def check_fits(config: Config) -> None:
    """Refuses an evaluation that the memory would not take, before hours of training.

    Raises:
      ConfigError: with the estimate.
    """
    for kind, scenarios, duration in (
        ("eval", config.eval_scenarios, config.eval_duration),
        ("validation", config.validation_scenarios, config.validation_duration),
    ):
        try:
            evaluation.check_fits(config.task, scenarios, duration)
        except evaluation.EvaluationError as error:
            raise ConfigError(f"{kind}_{error}") from error


def export(
    config: Config,
    learner: DQN,
    scene_hash: str,
    folder: RunFolder,
    state: TrainState,
    seconds: float,
    log_fn: LogFn,
) -> list[Policy]:
    """Writes a policy per seed; the first also as the run's, until a better one is known.

    A seed's policy is that of the state or, if `config.export` says so, the one that validated
    best so far.

    Args:
      config: of the run.
      learner: exports the parameters.
      scene_hash: fingerprint of the scene trained in.
      folder: to write into.
      state: of all seeds.
      seconds: spent learning.
      log_fn: told of every seed whose weights are no policy; the others are not held up by it.

    Raises:
      PolicyError: if no seed has a policy.
    """
    policies, files = [], []
    several = len(expand_runs(config)) > 1
    for weights, manifest in exports(config, learner, scene_hash, state):
        manifest["training"]["seconds_learning_since_start_or_resume"] = round(seconds, 1)
        seed = manifest["config"]["seed"]
        file = folder.seed_policy(seed) if several else folder.policy
        best = best_validated(folder, seed, log_fn) if config.export == "best" else None
        file.parent.mkdir(exist_ok=True)
        try:
            if best is None:
                policies.append(save_policy(file, weights, manifest))
            else:
                write_atomically(file, best.read_bytes())
                policies.append(load_policy(file))
                log_fn(f"seed {seed}: of {best.parent.name} decisions, the best by validation")
            files.append(file)
        except PolicyError as error:
            log_fn(f"seed {seed} gives no policy: {error}")
    if not policies:
        raise PolicyError(
            f"the run in {folder.path} learnt no policy of finite numbers; lower learning_rate"
        )
    if several:
        write_atomically(folder.policy, files[0].read_bytes())
    return policies


def finish(
    config: Config, policies: list[Policy], folder: RunFolder, display: Display, began: float
) -> Results:
    """Evaluates every seed, makes the best one the run's policy, draws and sums up.

    What says that the run is finished, `evaluation.json`, is written last.
    """
    several = len(expand_runs(config)) > 1
    scenarios, duration = config.eval_scenarios, config.eval_duration
    each = [
        _evaluate(policy, scenarios, duration, SEEDS.final, several, display) for policy in policies
    ]
    best = _choose(policies, each, duration, folder, display) if several else 0
    if config.sweep:
        ranked = _ranked(config, policies, each)
        write_json(folder.sweep, ranked)
        display.console.print(tables.sweep_table(ranked))
    results = each[best]
    _log(results, policies[best].manifest["training"]["env_steps"], folder)
    with display.phase("drawing figures"):
        _draw(folder)
    write_json(folder.evaluation, results)
    tables.print_summary(display.console, folder.path, results, time.perf_counter() - began)
    return results


def _draw(folder: RunFolder) -> None:
    from mjx_balance.report import figures, measuring  # matplotlib: not before learning begins

    policy = load_policy(folder.policy)
    lines = [json.loads(text) for text in folder.metrics.read_text().splitlines()]
    rollout = measuring.record_rollout(policy, "paper", measuring.RECORD_SECONDS, SEEDS.record)
    scene = evaluation.policy_scene(policy)
    figures.draw_figures(folder.figures, lines, policy.config.task, scene, {"policy": rollout})


def _evaluate(
    policy: Policy, scenarios: int, duration: float, seed: int, several: bool, display: Display
) -> Results:
    """Evaluates a policy on every suite."""
    doing = "validating" if seed == SEEDS.validation else "evaluating in plain MuJoCo"
    whose = f", seed {policy.config.seed}" if several else ""
    results = {}
    for suite in HEADLINE:
        with display.bar(f"{doing}, suite {suite}{whose}") as bar:
            results[suite] = evaluation.evaluate(policy, suite, scenarios, duration, seed, bar)
    return results


def _log(results: Results, env_steps: int, folder: RunFolder) -> None:
    """Gives TensorBoard the evaluation, once even if an earlier call was killed after that."""
    shutil.rmtree(folder.tensorboard / FINAL, ignore_errors=True)
    with SummaryWriter(str(folder.tensorboard / FINAL)) as board:
        for name, value in scalars(results).items():
            board.add_scalar(name, value, env_steps)


def _choose(
    policies: list[Policy],
    each: list[Results],
    duration: float,
    folder: RunFolder,
    display: Display,
) -> int:
    """Validates every seed, makes the best one the run's policy, writes seeds.json."""
    validated = [
        _evaluate(policy, CHOICE_SCENARIOS, duration, SEEDS.validation, True, display)
        for policy in policies
    ]
    best = min(range(len(policies)), key=lambda k: score(validated[k]))
    seeds = [policy.config.seed for policy in policies]
    write_atomically(folder.policy, folder.seed_policy(seeds[best]).read_bytes())
    summary = {suite: over_seeds([results[suite] for results in each]) for suite in HEADLINE}
    rows = [
        {"seed": seed, "validation": validation, "evaluation": results}
        for seed, validation, results in zip(seeds, validated, each, strict=True)
    ]
    write_json(folder.seeds_summary, {"best": seeds[best], "statistics": summary, "seeds": rows})
    display.say(f"best of the {len(policies)} seeds on the validation set: {seeds[best]}")
    display.console.print(tables.seeds_table(summary))
    return best


def _ranked(config: Config, policies: list[Policy], each: list[Results]) -> list[dict[str, Any]]:
    """What each combination of swept values has come to, the best first.

    Fewer falls are better, then less mean tilt, added up over the suites.
    """
    rows = []
    for number, values in enumerate(sweep_grid(config)):
        mine = [
            results
            for policy, results in zip(policies, each, strict=True)
            if (policy.config.seed - config.seed) // config.num_seeds == number
        ]
        if mine:
            statistics = {suite: over_seeds([x[suite] for x in mine]) for suite in HEADLINE}
            rows.append({"values": values, "statistics": statistics})
    return sorted(rows, key=_rank)


def _rank(row: dict[str, Any]) -> tuple[int, float]:
    found = row["statistics"].values()
    return sum(x["falls"] for x in found), sum(x["mean"]["iqm"] for x in found)
