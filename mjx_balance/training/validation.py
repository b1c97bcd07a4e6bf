"""Validation during training: the greedy policy of every seed on held-out scenarios."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_balance.config import Config, expand_runs
from mjx_balance.dqn import DQN, TrainState
from mjx_balance.dqn.dqn import Params
from mjx_balance.evaluation.rollout import observing, run_suite, summarize
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.policy.file import flat_weights, load_policy, save_policy
from mjx_balance.policy.manifest import PolicyError, make_manifest
from mjx_balance.policy.network import Policy
from mjx_balance.sim.scene import Scene
from mjx_balance.training.loop import Run, number
from mjx_balance.training.own_policy import OwnPolicy

AnyPolicy = Policy | OwnPolicy  #: of our network, or of the user's own
Results = dict[str, dict[str, Any]]  #: suite name -> JSON of `rollout.summarize`


def score(results: Results) -> tuple[int, float]:
    """Falls and mean tilt over all suites: less is better, falls first."""
    falls = sum(result["falls"] for result in results.values())
    return falls, sum(result["tilt_deg"]["mean"] for result in results.values())


def scalars(results: Results) -> dict[str, float]:
    """Falls and tilt statistics in deg, under their logged names."""
    values = {}
    for suite, result in results.items():
        values[f"eval/{suite}/falls"] = result["falls"]
        values |= {f"eval/{suite}/tilt_{k}": value for k, value in result["tilt_deg"].items()}
    return values


def exports(
    config: Config, learner: DQN, scene: Scene, state: TrainState
) -> Iterator[tuple[Params, dict[str, Any]]]:
    """Weights and manifest of every seed's greedy policy, trained in this scene."""
    small = state._replace(env_state=None, replay=None)  # pyright: ignore[reportArgumentType]
    if jax.process_count() > 1:  # the others do not take part: nothing of theirs may be touched
        small = jax.tree.map(np.asarray, small)
    training = {
        "env_steps": number(state.env_steps),
        "gradient_steps": number(state.gradient_steps),
        "device": jax.devices()[0].device_kind,
        "date": time.strftime("%Y-%m-%d"),
    }
    runs = expand_runs(config)
    for k, own in enumerate(runs):
        mine = jax.tree.map(lambda x: x[k], small) if len(runs) > 1 else small  # noqa: B023
        manifest = make_manifest(own, scene.hash, training, scene.stance.leg_trim)
        yield jax.device_get(learner.export_params(mine)), manifest


def greedy_policy(run: Run, weights: Params, manifest: dict[str, Any]) -> AnyPolicy:
    """A seed's greedy policy; raises `PolicyError` for weights that are none."""
    if run.exportable:
        return Policy(manifest, flat_weights(weights))
    return OwnPolicy(run.learner, weights, manifest)


def validate(run: Run, state: TrainState) -> dict[str, np.ndarray]:
    """Validates and saves every seed's greedy policy; changes nothing of the state.

    Returns:
      (num_seeds,) of each of the names of `scalars`; NaN for a seed whose weights are no policy.
    """
    rows = [
        _validate(run, weights, manifest)
        for weights, manifest in exports(run.config, run.learner, run.env.scene, state)
    ]
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: np.asarray([row.get(name, np.nan) for row in rows]) for name in names}


def _validate(run: Run, weights: Params, manifest: dict[str, Any]) -> dict[str, float]:
    """The `scalars` of one policy; empty if the weights are none."""
    try:
        policy = greedy_policy(run, weights, manifest)
    except PolicyError:  # the seed has diverged; the end of the run says so
        return {}
    count, duration = run.config.validation_scenarios, run.config.validation_duration
    results, act = {}, observing(policy)
    for suite in HEADLINE:
        rollout = run_suite(run.env.scene, act, suite, count, duration, SEEDS.validation)
        results[suite] = summarize(rollout, suite, duration, SEEDS.validation)
    if not run.exportable:
        return scalars(results)
    training = manifest["training"]
    training["validation"] = results
    file = run.folder.validated_policy(policy.config.seed, training["env_steps"])
    file.parent.mkdir(parents=True, exist_ok=True)
    save_policy(file, weights, manifest)
    return scalars(results)


def best_validated(folder: RunFolder, seed: int, log_fn: Callable[[str], None]) -> Path | None:
    """The policy of a seed that validated best, the earliest of equals; damaged ones are logged."""
    scores = []
    for file in folder.validated.glob(f"*/seed-{seed}.safetensors"):
        try:
            training = load_policy(file).manifest["training"]
            scores.append((*score(training["validation"]), training["env_steps"], file))
        except PolicyError as error:
            log_fn(f"validated policy left out: {error}")
    return min(scores)[-1] if scores else None
