"""The end of a run: a policy per seed, their evaluation, the best one, figures, a summary."""

import itertools
import json
import time
from typing import Any, NamedTuple

from mjx_balance.config import Config, ConfigError, sweep_grid
from mjx_balance.dqn import TrainState
from mjx_balance.dqn.dqn import Params
from mjx_balance.errors import MESSAGE, shorten
from mjx_balance.evaluation import rollout as evaluation
from mjx_balance.evaluation.statistics import over_seeds
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.files.run_folder import RunFolder, write_atomically, write_json
from mjx_balance.policy.file import PolicyError, load_policy, save_policy
from mjx_balance.report import tables
from mjx_balance.report.progress import Stage, part
from mjx_balance.training.loop import Run
from mjx_balance.training.tensorboard import Board
from mjx_balance.training.validation import (
    AnyPolicy,
    Results,
    best_validated,
    exports,
    greedy_policy,
    scalars,
    score,
)

CHOICE_SCENARIOS = 32  #: scenarios per suite by which one of several seeds is chosen
DRAWN_BYTES = 2**26  #: of metrics.jsonl; of more, the figures show every second line, third, ...
FINAL = "final"  #: TensorBoard's folder of the evaluation after training


class Finished(NamedTuple):
    """What a run gives."""

    policy: AnyPolicy  #: of several seeds the best on the validation scenarios
    evaluation: Results  #: its own: suite name -> JSON of `rollout.summarize`
    folder: RunFolder


def check_fits(config: Config) -> None:
    """Raises `ConfigError` if an evaluation would not fit into the memory, before training."""
    for kind, scenarios, duration in (
        ("eval", config.eval_scenarios, config.eval_duration),
        ("validation", config.validation_scenarios, config.validation_duration),
    ):
        try:
            evaluation.check_fits(config.task, scenarios, duration)
        except evaluation.EvaluationError as error:
            raise ConfigError(f"{kind}_{error}") from error


def export(run: Run, state: TrainState, seconds: float) -> list[AnyPolicy]:
    """Writes a policy per seed; the first also as the run's, until a better one is known.

    A seed's policy is that of the state or, if `config.export` says so, the one that validated
    best so far. Seeds whose weights are no policy are logged and left out. A policy of the user's
    own network has no file.

    Args:
      run: says which policies.
      state: of all seeds.
      seconds: spent learning.

    Raises:
      PolicyError: if no seed has a policy.
    """
    policies: list[AnyPolicy] = []
    for weights, manifest in exports(run.config, run.learner, run.env.scene, state):
        manifest["training"]["seconds_learning_since_start_or_resume"] = round(seconds, 1)
        try:
            policies.append(_export(run, weights, manifest))
        except PolicyError as error:
            run.display.say(f"seed {manifest['config']['seed']} gives no policy: {error}")
    if not policies:
        raise PolicyError(
            f"the run in {run.folder.path} learnt no policy of finite numbers; lower learning_rate"
        )
    if run.num_seeds > 1:
        _hand_out(run, policies[0])
    return policies


def _export(run: Run, weights: Params, manifest: dict[str, Any]) -> AnyPolicy:
    """Writes the policy of one seed."""
    if not run.exportable:
        return greedy_policy(run, weights, manifest)
    folder, seed, best = run.folder, manifest["config"]["seed"], None
    file = folder.seed_policy(seed) if run.num_seeds > 1 else folder.policy
    if run.config.export == "best":
        best = best_validated(folder, seed, run.display.say)
    file.parent.mkdir(exist_ok=True)
    if best is None:
        return save_policy(file, weights, manifest)
    write_atomically(file, best.read_bytes())
    policy = load_policy(file)
    run.display.say(
        f"seed {seed}: policy after {best.parent.name} decisions, the best by validation"
    )
    return policy


def _hand_out(run: Run, policy: AnyPolicy) -> None:
    """Makes a seed's policy the run's."""
    if run.exportable:
        file = run.folder.seed_policy(policy.config.seed)
        write_atomically(run.folder.policy, file.read_bytes())


def finish(run: Run, policies: list[AnyPolicy], start_time: float) -> Finished:
    """Evaluates all seeds, makes the best the run's policy, writes evaluation.json, draws."""
    config, folder, console = run.config, run.folder, run.display.console
    seeds, suites = len(policies), len(HEADLINE)
    stage = run.display.stages((1 if run.num_seeds == 1 else 2) * seeds * suites + run.keep)
    scenarios = config.eval_scenarios
    each = [_evaluate(run, policy, scenarios, SEEDS.final, stage) for policy in policies]
    best = _choose(run, policies, each, stage) if run.num_seeds > 1 else 0
    if config.sweep:
        ranked = _ranked(config, policies, each)
        write_json(folder.sweep, ranked)
        tables.print_table(console, tables.sweep_table(ranked))
    results, policy = each[best], policies[best]
    if not run.keep:
        tables.print_table(console, tables.evaluation_table(results))
        return Finished(policy, results, folder)
    folder.drawing.touch()
    write_json(folder.evaluation, results)  # before the pictures, which may fail
    try:
        _log(results, policy.manifest["training"]["env_steps"], folder)
        with stage("drawing figures") as bar:
            _draw(folder, policy, config.robot, bar)
    except Exception as error:
        reason = shorten(error, MESSAGE) or type(error).__name__
        run.display.say(f"some figures or curves are missing: {reason}")
    folder.drawing.unlink()
    took = time.perf_counter() - start_time
    tables.print_summary(console, folder.path, results, took, config.robot)
    return Finished(policy, results, folder)


def _draw(folder: RunFolder, policy: AnyPolicy, robot: str, bar: evaluation.Progress) -> None:
    from mjx_balance.report import figures, measuring  # matplotlib: not before learning begins

    stride = 1 + folder.metrics.stat().st_size // DRAWN_BYTES
    with folder.metrics.open(encoding="utf-8") as file:
        lines = [json.loads(line) for line in itertools.islice(file, 0, None, stride)]
    scene, seconds = evaluation.policy_scene(policy, robot), measuring.RECORD_SECONDS
    place = (scene, "paper", seconds, SEEDS.record)
    rollout = measuring.record_rollout(policy, *place, progress=part(bar, 0, 2))
    figures.draw_figures(folder.figures, lines, policy.config.task, scene, {"policy": rollout})


def _evaluate(run: Run, policy: AnyPolicy, scenarios: int, seed: int, stage: Stage) -> Results:
    """Evaluates a policy on every suite, in plain MuJoCo."""
    kind = "validating" if seed == SEEDS.validation else "evaluating"
    of_seed = f", seed {policy.config.seed}" if run.num_seeds > 1 else ""
    results, duration = {}, run.config.eval_duration
    for suite in HEADLINE:
        with stage(f"{kind}, suite {suite}{of_seed}") as bar:
            results[suite] = evaluation.evaluate(
                policy, suite, scenarios, duration, seed, bar, run.config.robot
            )
    return results


def _log(results: Results, env_steps: int, folder: RunFolder) -> None:
    """Gives TensorBoard the evaluation, once even if an earlier call was killed after that."""
    for earlier in (folder.tensorboard / FINAL).glob("events.*"):
        earlier.unlink()
    Board(folder.tensorboard / FINAL).write(env_steps, scalars(results))


def _choose(run: Run, policies: list[AnyPolicy], each: list[Results], stage: Stage) -> int:
    """Validates every seed, makes the best one the run's policy, writes seeds.json."""
    validated = [_evaluate(run, x, CHOICE_SCENARIOS, SEEDS.validation, stage) for x in policies]
    best = min(range(len(policies)), key=lambda k: score(validated[k]))
    _hand_out(run, policies[best])
    seeds = [policy.config.seed for policy in policies]
    summary = {}
    if not run.config.sweep:  # whose seeds have other configs; `_ranked` has their statistics
        summary = {suite: over_seeds([results[suite] for results in each]) for suite in HEADLINE}
    rows = [
        {"seed": seed, "validation": validation, "evaluation": results}
        for seed, validation, results in zip(seeds, validated, each, strict=True)
    ]
    values = {"best": seeds[best], "statistics": summary, "seeds": rows}
    write_json(run.folder.seeds_summary, values)
    run.display.say(f"best of the {len(policies)} seeds on the validation set: {seeds[best]}")
    if summary:
        tables.print_table(run.display.console, tables.seeds_table(summary))
    return best


def _ranked(config: Config, policies: list[AnyPolicy], each: list[Results]) -> list[dict[str, Any]]:
    """The statistics of each combination of swept values, by falls, then by mean tilt."""
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
    suites = row["statistics"].values()
    return sum(x["falls"] for x in suites), sum(x["mean"]["iqm"] for x in suites)
