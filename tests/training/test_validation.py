"""Validation during training: what is measured and kept, the best of it, and learning untouched."""

import dataclasses
import functools
import random
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from brax.envs.base import Env, State

from mjx_balance import load_policy
from mjx_balance.config import preset
from mjx_balance.dqn import DQN, DQNSpec, QNetwork
from mjx_balance.evaluation import rollout as evaluation
from mjx_balance.evaluation.suites import SEEDS
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.policy.file import save_policy
from mjx_balance.policy.manifest import make_manifest
from mjx_balance.sim.scene import Scene
from mjx_balance.training import finish
from mjx_balance.training.loop import Interrupts, learn
from mjx_balance.training.validation import best_validated, scalars, score, validate

CONFIG = preset("smoke")
SEED = CONFIG.seed
SHORT = dataclasses.replace(CONFIG, validation_scenarios=2, validation_duration=3.0)
NAMES = ("mean", "rms", "p50", "p95", "p99", "max")


def result(falls: int, mean: float) -> dict[str, Any]:
    return {"falls": falls, "tilt_deg": {name: mean + k for k, name in enumerate(NAMES)}}


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
        "eval/corner/falls": 1,
        **{f"eval/paper/tilt_{name}": k + 0.5 for k, name in enumerate(NAMES)},
        **{f"eval/corner/tilt_{name}": k + 10 for k, name in enumerate(NAMES)},
    }


def test_every_seed_is_validated_as_its_exported_policy_is_evaluated(
    scene: Scene,
    folder: RunFolder,
    stub_learner: Any,
    make_run: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And the file of the policy holds its result; a seed that diverged has none.

    Learning does not notice: neither the state nor a global random generator changes.
    """
    run = make_run(dataclasses.replace(SHORT, num_seeds=3), scene)
    state = stub_learner.state_of(1.0, np.nan, -3.0, env_steps=128)
    before = jax.tree.map(np.array, state), random.getstate(), str(np.random.get_state())
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # its checks draw names
    found = validate(run, state)
    jax.tree.map(np.testing.assert_array_equal, state, before[0])
    assert (random.getstate(), str(np.random.get_state())) == before[1:]
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
        for suite, saved in training["validation"].items():
            expected = evaluation.evaluate(policy, suite, 2, 3.0, SEEDS.validation)
            values = scalars({suite: expected})
            assert {name: found[name][k] for name in values} == values
            assert saved | {"physics_steps_per_second": 0} == (
                expected | {"physics_steps_per_second": 0}
            )


@pytest.fixture
def add(folder: RunFolder, stub_learner: Any) -> Callable[..., None]:
    """Writes a validated policy; its weights are multiples of the decisions."""

    def add(env_steps: int, falls: int, mean: float, seed: int = SEED) -> None:
        results = {"paper": result(falls, mean), "corner": result(0, mean)}
        own = dataclasses.replace(CONFIG, seed=seed)
        manifest = make_manifest(own, "hash", {"env_steps": env_steps, "validation": results})
        file = folder.validated_policy(seed, env_steps)
        file.parent.mkdir(parents=True, exist_ok=True)
        params = stub_learner.state_of(float(env_steps)).params
        save_policy(file, jax.device_get(params), manifest)

    return add


def test_the_best_validated_policy_of_a_seed_is_found(folder: RunFolder, add: Any) -> None:
    def best(seed: int = SEED) -> int | None:
        lines.clear()
        file = best_validated(folder, seed, lines.append)
        return int(file.parent.name) if file else None

    lines: list[str] = []
    assert best() is None
    add(900, 1, 0.1)
    assert best() == 900
    add(1_000, 0, 0.3)
    add(2_000, 0, 0.2)
    add(10_000, 0, 0.2)  # as good, later
    add(20_000, 0, 0.25)
    add(30_000, 0, 0.1, SEED + 1)
    assert (best(), best(SEED + 1)) == (2_000, 30_000)
    assert lines == []
    damaged = folder.validated_policy(SEED, 2_000)
    damaged.write_bytes(damaged.read_bytes()[:-1])
    assert best() == 10_000
    [line] = lines
    assert line.startswith(f"validated policy left out: {damaged} is damaged")


@pytest.fixture
def exported(make_run: Any, stub_learner: Any) -> Callable[..., list[float]]:
    """Weights of the exported policies as multiples of the stub's."""

    def exported(export: Any, *scales: float) -> list[float]:
        run = make_run(dataclasses.replace(CONFIG, num_seeds=len(scales), export=export))
        policies = finish.export(run, stub_learner.state_of(*scales), 1.0)
        return [stub_learner.scale_of(policy) for policy in policies]

    return exported


def test_the_run_exports_its_last_policy_or_its_best(
    folder: RunFolder, display: Any, add: Any, exported: Any
) -> None:
    add(1_000, 0, 0.1)
    add(2_000, 0, 0.2)
    assert exported("last", 7.0) == [pytest.approx(7)]
    assert display.lines == []
    assert load_policy(folder.policy).manifest["training"]["env_steps"] == 64
    assert exported("best", 7.0) == [pytest.approx(1_000)]
    assert display.lines == [f"seed {SEED}: policy after 1000 decisions, the best by validation"]
    best = folder.validated_policy(SEED, 1_000)
    assert folder.policy.read_bytes() == best.read_bytes()


def test_each_of_several_seeds_exports_its_own_best(
    folder: RunFolder, add: Any, exported: Any, display: Any
) -> None:
    """The second has validated nothing yet, the third has diverged since."""
    add(1_000, 0, 0.1)
    add(2_000, 0, 0.2, SEED + 2)
    assert exported("best", 5.0, 6.0, np.nan) == pytest.approx([1_000, 6, 2_000])
    assert len(display.lines) == 2
    for k, env_steps in enumerate((1_000, 64, 2_000)):
        policy = load_policy(folder.seed_policy(SEED + k))
        assert policy.manifest["training"]["env_steps"] == env_steps
        assert policy.config.seed == SEED + k
    assert folder.policy.read_bytes() == folder.seed_policy(SEED).read_bytes()


class Blind(Env):
    """Random observations of a robot's size; 441 actions, of which the first half pays."""

    action_size, backend, observation_size = 441, "probe", 0  # pyright: ignore

    def __init__(self, size: int):
        self.size = size

    def reset(self, rng: jax.Array) -> State:
        zero = jnp.float32(0.0)
        return State(None, jax.random.normal(rng, (self.size,)), zero, zero, {}, {})

    def step(self, state: State, action: jax.Array) -> State:
        reward = jnp.float32(action < 220)
        return state.replace(obs=-jnp.asarray(state.obs), reward=reward, done=jnp.float32(1.0))


@pytest.mark.slow
def test_learning_is_the_same_bit_for_bit_with_and_without_validation(
    scene: Scene, make_run: Any, stub_learner: Any
) -> None:
    """Two seeds on two devices: weights, optimiser, replay, random keys, everything."""
    dqn = dataclasses.replace(
        CONFIG.dqn,
        batch_size=32,
        replay_ratio=8,
        min_replay_size=32,
        mirror=False,
        whiten_steps=64,
        hidden_sizes=(8,),
    )
    config = dataclasses.replace(
        SHORT, num_seeds=2, num_envs=16, num_env_steps=192, log_every=64, dqn=dqn
    )
    network = QNetwork((8,), (21, 21), radial=True)
    spec = DQNSpec(dqn, 16, 192, num_seeds=2, action_factors=(21, 21))
    learner = DQN(Blind(stub_learner.obs_size), network, spec)
    program: Any = learner.train_program(4)

    def trained(eval_every: int) -> Any:
        run = make_run(dataclasses.replace(config, eval_every=eval_every), scene)
        run = dataclasses.replace(run, learner=learner)
        with Interrupts(pytest.fail) as stop:
            validated = functools.partial(validate, run)
            state, _ = learn(run, program, learner.init(3), stop, validated)
        policies = len(list(run.folder.validated.glob("*/*")))
        return jax.device_get(state), policies

    (with_, policies), (without, none) = trained(64), trained(0)
    assert (policies, none) == (3 * 2, 0)
    assert with_.gradient_steps.tolist() == without.gradient_steps.tolist() != [0, 0]
    assert program._cache_size() == 1
    first, second = (jax.tree.leaves_with_path(state) for state in (with_, without))
    assert len(first) == len(second) > 20
    for (path, a), (_, b) in zip(first, second, strict=True):
        assert a.tobytes() == b.tobytes(), path
