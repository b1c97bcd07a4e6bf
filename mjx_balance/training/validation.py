"""Validation during training: how the greedy policy of every seed fares on held-out boards.

A validated policy is kept as a file that carries what came of it. Which one is the best follows
from these files alone. A resumed run first drops those that are newer than its checkpoint, and
validates again at the same decisions: it chooses as an undisturbed one does.
"""

import time
from collections.abc import Iterator
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
from mjx_balance.training.loop import number
from mjx_balance.training.program_cache import LogFn

Results = dict[str, dict[str, Any]]
"""Suite name -> JSON of `rollout.summarize`."""


def score(results: Results) -> tuple[int, float]:
    """Falls and mean tilt over all suites: less is better, falls first."""
    falls = sum(result["falls"] for result in results.values())
    return falls, sum(result["tilt_deg"]["mean"] for result in results.values())


def scalars(results: Results) -> dict[str, float]:
    """Falls and tilt statistics in deg, under the names they are logged by."""
    found = {}
    for suite, result in results.items():
        found[f"eval/{suite}/falls"] = result["falls"]
        for name, value in result["tilt_deg"].items():
            found[f"eval/{suite}/tilt_{name}"] = value
    return found


def exports(
    config: Config, learner: DQN, scene_hash: str, state: TrainState
) -> Iterator[tuple[Params, dict[str, Any]]]:
    """Weights and manifest of every seed's greedy policy.

    Args:
      config: of the run.
      learner: exports the parameters.
      scene_hash: fingerprint of the scene trained in.
      state: of all seeds.
    """
    known = state._replace(env_state=None, replay=None)  # pyright: ignore[reportArgumentType]
    if jax.process_count() > 1:  # the others do not take part: nothing of theirs may be touched
        known = jax.tree.map(np.asarray, known)
    training = {
        "env_steps": number(state.env_steps),
        "gradient_steps": number(state.gradient_steps),
        "device": jax.devices()[0].device_kind,
        "date": time.strftime("%Y-%m-%d"),
    }
    runs = expand_runs(config)
    for k, own in enumerate(runs):
        mine = jax.tree.map(lambda x: x[k], known) if len(runs) > 1 else known  # noqa: B023
        yield jax.device_get(learner.export_params(mine)), make_manifest(own, scene_hash, training)


def validate(
    config: Config, learner: DQN, scene: Scene, folder: RunFolder, state: TrainState
) -> dict[str, np.ndarray]:
    """Validates every seed's greedy policy and keeps it; changes nothing of the state.

    Args:
      config: of the run.
      learner: exports the parameters.
      scene: trained in.
      folder: to keep the policies in.
      state: of all seeds.

    Returns:
      (num_seeds,) of each of the names of `scalars`; NaN for a seed whose weights are no policy.
    """
    rows = [
        _validated(config, scene, folder, weights, manifest)
        for weights, manifest in exports(config, learner, scene.hash, state)
    ]
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: np.asarray([row.get(name, np.nan) for row in rows]) for name in names}


def _validated(
    config: Config, scene: Scene, folder: RunFolder, weights: Params, manifest: dict[str, Any]
) -> dict[str, float]:
    """The `scalars` of one policy; empty if the weights are none."""
    try:
        policy = Policy(manifest, flat_weights(weights))
    except PolicyError:  # the seed has diverged; the end of the run says so
        return {}
    scenarios, duration = config.validation_scenarios, config.validation_duration
    results = {}
    for suite in HEADLINE:
        rollout = run_suite(scene, observing(policy), suite, scenarios, duration, SEEDS.validation)
        results[suite] = summarize(rollout, suite, duration, SEEDS.validation)
    training = manifest["training"]
    training["validation"] = results
    file = folder.validated_policy(policy.config.seed, training["env_steps"])
    file.parent.mkdir(parents=True, exist_ok=True)
    save_policy(file, weights, manifest)
    return scalars(results)


def best_validated(folder: RunFolder, seed: int, log_fn: LogFn) -> Path | None:
    """The policy of a seed that validated best, the earliest of equals; none if there is none.

    Args:
      folder: of the run.
      seed: whose policies.
      log_fn: told of files that are damaged, which do not count.
    """
    found = []
    for file in folder.validated.glob(f"*/seed-{seed}.safetensors"):
        try:
            training = load_policy(file).manifest["training"]
        except PolicyError as error:
            log_fn(f"not chosen from: {error}")
            continue
        found.append((*score(training["validation"]), training["env_steps"], file))
    return min(found)[-1] if found else None
