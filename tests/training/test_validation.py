"""Validation during training: what is measured and kept, the best of it, and learning untouched."""

import dataclasses
import io
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State
from rich.console import Console

from mjx_balance import load_policy
from mjx_balance.config import preset
from mjx_balance.dqn import DQN, DQNSpec, QNetwork
from mjx_balance.evaluation import rollout as evaluation
from mjx_balance.evaluation.suites import SEEDS
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.policy.file import save_policy
from mjx_balance.policy.manifest import make_manifest
from mjx_balance.sim.scene import Scene
from mjx_balance.training import finish, loop
from mjx_balance.training.loop import Interrupts
from mjx_balance.training.validation import best_validated, scalars, score, validate

CONFIG = preset("smoke")
SEED = CONFIG.seed
SHORT = dataclasses.replace(CONFIG, validation_scenarios=2, validation_duration=3.0)


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder(tmp_path)


def result(falls: int, mean: float) -> dict[str, Any]:
    names = ("mean", "rms", "p50", "p95", "p99", "max")
    return {"falls": falls, "tilt_deg": {name: mean + k for k, name in enumerate(names)}}


def test_fewer_falls_are_better_whatever_the_tilt_and_then_less_tilt_over_all_suites() -> None:
    best_first = [
        {"paper": result(0, 0.2), "corner": result(0, 0.1)},
        {"paper": result(0, 0.1), "corner": result(0, 0.3)},
        {"paper": result(0, 0.0), "corner": result(1, 0.0)},
        {"paper": result(2, 0.0), "corner": result(0, 0.0)},
    ]
    assert sorted((best_first[k] for k in (3, 1, 0, 2)), key=score) == best_first
    assert score(best_first[1]) == (0, pytest.approx(0.4))


def test_what_is_logged_has_a_name_for_each_suite_and_statistic() -> None:
    found = scalars({"paper": result(3, 0.5), "corner": result(1, 10.0)})
    assert found == {
        "eval/paper/falls": 3,
        "eval/paper/tilt_mean": 0.5,
        "eval/paper/tilt_rms": 1.5,
        "eval/paper/tilt_p50": 2.5,
        "eval/paper/tilt_p95": 3.5,
        "eval/paper/tilt_p99": 4.5,
        "eval/paper/tilt_max": 5.5,
        "eval/corner/falls": 1,
        "eval/corner/tilt_mean": 10,
        "eval/corner/tilt_rms": 11,
        "eval/corner/tilt_p50": 12,
        "eval/corner/tilt_p95": 13,
        "eval/corner/tilt_p99": 14,
        "eval/corner/tilt_max": 15,
    }


def test_every_seed_is_validated_as_its_exported_policy_is_evaluated(
    scene: Scene, folder: RunFolder, stub_learner: Any
) -> None:
    """And the policy that is kept carries what came of it; a seed that diverged has none."""
    config = dataclasses.replace(SHORT, num_seeds=3)
    state = stub_learner.state_of(1.0, np.nan, -3.0, env_steps=128)
    found = validate(config, stub_learner, scene, folder, state)
    assert {name.split("/")[1] for name in found} == {"paper", "corner"}
    assert all(np.isnan(values).tolist() == [False, True, False] for values in found.values())
    means = found["eval/corner/tilt_mean"]
    assert means[0] != means[2]
    names = {str(file.relative_to(folder.path)) for file in folder.validated.rglob("*.*")}
    assert names == {f"validated/128/seed-{seed}.safetensors" for seed in (SEED, SEED + 2)}
    for k in (0, 2):
        policy = load_policy(folder.validated_policy(SEED + k, 128))
        training = policy.manifest["training"]
        assert (training["env_steps"], training["gradient_steps"]) == (128, 384)
        assert (policy.config.seed, policy.config.num_seeds) == (SEED + k, 1)
        wanted = {
            suite: evaluation.evaluate(policy, suite, 2, 3.0, SEEDS.validation)
            for suite in ("paper", "corner")
        }
        assert {name: values[k] for name, values in found.items()} == scalars(wanted)
        carried = training["validation"]
        for results in (wanted, carried):
            for each in results.values():
                del each["physics_steps_per_second"]
        assert carried == wanted


@pytest.fixture
def keep(folder: RunFolder, stub_learner: Any) -> Callable[..., None]:
    """Keeps a policy that validated so; its weights are multiples of the decisions."""

    def keep(env_steps: int, falls: int, mean: float, seed: int = SEED) -> None:
        results = {"paper": result(falls, mean), "corner": result(0, mean)}
        own = dataclasses.replace(CONFIG, seed=seed)
        manifest = make_manifest(own, "hash", {"env_steps": env_steps, "validation": results})
        file = folder.validated_policy(seed, env_steps)
        file.parent.mkdir(parents=True, exist_ok=True)
        params = stub_learner.state_of(float(env_steps)).params
        save_policy(file, jax.device_get(params), manifest)

    return keep


def test_the_best_validated_policy_of_a_seed_is_found(folder: RunFolder, keep: Any) -> None:
    assert best_validated(folder, SEED, pytest.fail) is None
    keep(900, 1, 0.1)
    assert best_validated(folder, SEED, pytest.fail) == folder.validated_policy(SEED, 900)
    keep(1_000, 0, 0.3)
    keep(2_000, 0, 0.2)
    keep(10_000, 0, 0.2)  # as good, later
    keep(20_000, 0, 0.25)
    keep(30_000, 0, 0.1, SEED + 1)
    assert best_validated(folder, SEED, pytest.fail) == folder.validated_policy(SEED, 2_000)
    assert best_validated(folder, SEED + 1, pytest.fail) == folder.validated_policy(
        SEED + 1, 30_000
    )
    damaged = folder.validated_policy(SEED, 2_000)
    damaged.write_bytes(damaged.read_bytes()[:-1])
    said: list[str] = []
    assert best_validated(folder, SEED, said.append) == folder.validated_policy(SEED, 10_000)
    assert len(said) == 1
    assert said[0].startswith(f"not chosen from: {damaged} is damaged")


@pytest.fixture
def exported(folder: RunFolder, stub_learner: Any) -> Callable[..., tuple[list[float], list[str]]]:
    """First weights of the policies handed out, as multiples of the stub's; and what was said."""

    def exported(export: Any, *scales: float) -> tuple[list[float], list[str]]:
        config = dataclasses.replace(CONFIG, num_seeds=len(scales), export=export)
        state, said = stub_learner.state_of(*scales), []
        policies = finish.export(config, stub_learner, "hash", folder, state, 1.0, said.append)
        first = stub_learner.first_weight
        return [float(p.layers[0][0].ravel()[0] / first) for p in policies], said

    return exported


def test_the_run_hands_out_its_last_policy_or_its_best(
    folder: RunFolder, keep: Any, exported: Any
) -> None:
    keep(1_000, 0, 0.1)
    keep(2_000, 0, 0.2)
    assert exported("last", 7.0) == ([pytest.approx(7)], [])
    assert load_policy(folder.policy).manifest["training"]["env_steps"] == 64
    said = [f"seed {SEED}: of 1000 decisions, the best by validation"]
    assert exported("best", 7.0) == ([pytest.approx(1_000)], said)
    best = folder.validated_policy(SEED, 1_000)
    assert folder.policy.read_bytes() == best.read_bytes()


def test_each_of_several_seeds_hands_out_its_own_best(
    folder: RunFolder, keep: Any, exported: Any
) -> None:
    """The second has validated nothing yet, the third has diverged since."""
    keep(1_000, 0, 0.1)
    keep(2_000, 0, 0.2, SEED + 2)
    found, said = exported("best", 5.0, 6.0, np.nan)
    assert found == pytest.approx([1_000, 6, 2_000])
    assert len(said) == 2
    for k, env_steps in enumerate((1_000, 64, 2_000)):
        policy = load_policy(folder.seed_policy(SEED + k))
        assert policy.manifest["training"]["env_steps"] == env_steps
        assert policy.config.seed == SEED + k
    assert folder.policy.read_bytes() == folder.seed_policy(SEED).read_bytes()


class Blind(Env):
    """Random observations of a robot's size; 441 actions, of which the first half pays."""

    action_size, backend = 441, "probe"  # pyright: ignore

    def __init__(self, observation_size: int):
        self.size = observation_size

    @property
    def observation_size(self) -> int:
        return self.size

    def reset(self, rng: jax.Array) -> State:
        zero = jnp.float32(0.0)
        obs = jax.random.normal(rng, (self.size,))
        return State(None, obs, zero, zero, {}, {"truncation": zero})

    def step(self, state: State, action: jax.Array) -> State:
        reward = jnp.float32(action < 220)
        return state.replace(obs=-jnp.asarray(state.obs), reward=reward, done=jnp.float32(1.0))


def test_learning_is_the_same_bit_for_bit_with_and_without_validation(
    scene: Scene, tmp_path: Path, stub_learner: Any
) -> None:
    """Two seeds on two devices: weights, optimiser, replay, random keys, everything."""
    dqn = dataclasses.replace(CONFIG.dqn, batch_size=32, replay_ratio=8, min_replay_size=32)
    dqn = dataclasses.replace(dqn, mirror=False, whiten_steps=64, hidden_sizes=(8,))
    config = dataclasses.replace(SHORT, num_seeds=2, num_envs=16, num_env_steps=192, log_every=64)
    config = dataclasses.replace(config, dqn=dqn)
    network = QNetwork((8,), (21, 21), radial=True)
    spec = DQNSpec(dqn, 16, 192, num_seeds=2, action_factors=(21, 21))
    learner = DQN(Blind(stub_learner.obs_size), network, spec)
    program: Any = learner.train_program(4)
    calls: list[int] = []

    def trained(eval_every: int) -> Any:
        folder = RunFolder(tmp_path / f"{eval_every}")
        folder.path.mkdir()

        def counted(state: Any) -> Any:
            calls.append(eval_every)
            return validate(config, learner, scene, folder, state)

        plan = loop.make_plan(dataclasses.replace(config, eval_every=eval_every), {})
        display = finish.Display(Console(file=io.StringIO()))
        with Interrupts(pytest.fail) as stop:
            state, _ = loop.learn(plan, program, learner.init(3), folder, display, stop, counted)
        return jax.device_get(state)

    global_numbers = str(np.random.get_state()), random.getstate()
    with_, without = trained(64), trained(0)
    assert (str(np.random.get_state()), random.getstate()) == global_numbers
    assert calls == [64] * 3
    assert with_.gradient_steps.tolist() == without.gradient_steps.tolist() != [0, 0]
    assert program._cache_size() == 1
    first, second = (jax.tree.leaves_with_path(state) for state in (with_, without))
    assert len(first) == len(second) > 20
    for (path, a), (_, b) in zip(first, second, strict=True):
        assert a.tobytes() == b.tobytes(), path
