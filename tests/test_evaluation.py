"""Evaluation in plain MuJoCo, with hand-made controllers and a random network."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mjx_balance.config import Config
from mjx_balance.evaluation import (
    SUITES,
    EvaluationError,
    evaluate,
    make_scenarios,
    roll_out,
    summarize,
)
from mjx_balance.policy import Policy, PolicyError, make_manifest, save_policy
from mjx_balance.scene import Scene

STAND, LEFT_UP = 220, 20 * 21 + 10


def always(action: int):
    return lambda obs: np.full(len(obs), action)


@pytest.fixture(scope="session")
def policy_file(config: Config, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained policy of the default network."""
    rng = np.random.default_rng(0)
    sizes = (34, *config.dqn.hidden_sizes, 42)
    names = [f"hidden_{i}" for i in range(len(config.dqn.hidden_sizes))] + ["head"]
    layers = {
        name: {"kernel": rng.normal(size=(a, b)) / np.sqrt(a), "bias": np.zeros(b)}
        for name, a, b in zip(names, sizes[:-1], sizes[1:], strict=True)
    }
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    save_policy(path, {"params": layers}, make_manifest(config, scene.hash, (21, 21), {}))
    return path


def test_standing_still_on_a_level_board_stays_level(config: Config, scene: Scene) -> None:
    scenarios = make_scenarios(config, "paper", 2, 4.0, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    rollout = roll_out(scene, config, always(STAND), level, 4.0)
    assert not rollout.fell.any()
    assert rollout.tilt.max() < 0.05
    assert np.all(rollout.action_mm == 0)


def test_without_control_the_body_follows_the_board(config: Config, scene: Scene) -> None:
    scenarios = make_scenarios(config, "paper", 1, 4.0, 0)
    held = scenarios._replace(targets=np.tile((3.0, 4.0), (1, scenarios.targets.shape[1], 1)))
    rollout = roll_out(scene, config, always(STAND), held, 4.0)
    assert not rollout.fell.any()
    assert rollout.tilt[0, -1] == pytest.approx(5.0, abs=0.3)


def test_raising_the_left_side_tilts_the_body_and_a_fall_counts_to_the_end(
    config: Config, scene: Scene
) -> None:
    scenarios = make_scenarios(config, "paper", 3, 8.0, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    rollout = roll_out(scene, config, always(LEFT_UP), level, 8.0)
    assert rollout.fell.all()
    # 3 mm over a half-track of 142 mm is 1.2 deg a decision: 6 deg take 5 or 6 decisions.
    assert np.all((rollout.fell_at > 4 * 50) & (rollout.fell_at < 7 * 50))
    for tilt, fell_at in zip(rollout.tilt, rollout.fell_at, strict=True):
        assert np.all(tilt[:fell_at] <= 6)
        assert np.all(tilt[fell_at:] == 6)
    result = summarize(rollout, "paper", 8.0, 0)
    assert result["falls"] == 3
    assert result["fall_rate"] == 1.0
    assert result["tilt_deg"]["max"] == 6.0
    assert result["action_mm_mean"] == pytest.approx(1.5, rel=1e-3)


def test_a_simulation_that_is_no_number_counts_as_a_fall(config: Config, scene: Scene) -> None:
    scenarios = make_scenarios(config, "paper", 3, 1.0, 0)
    targets = 0 * scenarios.targets
    targets[1] = np.nan
    rollout = roll_out(scene, config, always(STAND), scenarios._replace(targets=targets), 1.0)
    np.testing.assert_array_equal(rollout.fell, (False, True, False))
    assert np.isfinite(rollout.tilt).all()


def test_one_thread_gives_what_many_give(config: Config, scene: Scene) -> None:
    scenarios = make_scenarios(config, "corner", 5, 2.0, 0)
    one, two = (roll_out(scene, config, always(STAND), scenarios, 2.0, n).tilt for n in (1, 2))
    np.testing.assert_array_equal(one, two)


def test_scenarios_depend_on_the_seed_and_not_on_their_number(config: Config) -> None:
    few, many = (make_scenarios(config, "paper", n, 60, 3).targets for n in (2, 5))
    np.testing.assert_array_equal(few, many[:2])
    assert not np.array_equal(few, make_scenarios(config, "paper", 2, 60, 4).targets)


def test_suites_are_what_they_say(config: Config) -> None:
    paper = make_scenarios(config, "paper", 400, 60, 0).targets
    size = np.linalg.norm(paper, axis=-1)
    assert size.max() <= 7
    assert np.mean(size) == pytest.approx(3.5, abs=0.15)
    assert np.abs(paper.mean(axis=(0, 1))).max() < 0.2
    corner = make_scenarios(config, "corner", 50, 60, 0).targets
    assert np.all(np.abs(corner) == 7)
    assert len(np.unique(corner.reshape(-1, 2), axis=0)) == 4


def test_unknown_suite_is_refused_with_the_known_ones(config: Config) -> None:
    with pytest.raises(EvaluationError, match="unknown suite 'moon'; known suites: paper, corner"):
        make_scenarios(config, "moon", 1, 1, 0)


@pytest.mark.parametrize(
    ("scenarios", "duration", "named"), [(0, 1.0, "scenarios is 0"), (1, 0.0, "duration is 0")]
)
def test_no_scenarios_and_no_time_are_refused(
    config: Config, scene: Scene, scenarios: int, duration: float, named: str, policy_file: Path
) -> None:
    from mjx_balance import load_policy

    with pytest.raises(EvaluationError, match=named):
        evaluate(load_policy(policy_file), "paper", scenarios, duration, 0)


def test_a_policy_of_another_scene_is_refused(policy_file: Path) -> None:
    from mjx_balance import load_policy

    policy = load_policy(policy_file)
    weights = {}
    for i, (kernel, bias) in enumerate(policy._layers):
        name = f"hidden_{i}" if i < 2 else "head"
        weights |= {f"{name}/kernel": kernel, f"{name}/bias": bias}
    other = Policy(policy.manifest | {"scene_hash": "0" * 16}, weights)
    with pytest.raises(PolicyError, match=r"trained in scene 0{16}, but scenes/ now gives"):
        evaluate(other, "paper", 1, 1.0, 0)


def test_the_command_writes_the_contract_and_imports_no_jax(
    policy_file: Path, tmp_path: Path
) -> None:
    block = (
        "import sys\n"
        "class Block:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('jax', 'jaxlib', 'flax', 'brax', 'optax', 'orbax'):\n"
        "            raise ImportError(name)\n"
        "sys.meta_path.insert(0, Block())\n"
        "from mjx_balance.cli import main\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    out = tmp_path / "out.json"
    flags = "--suite corner --scenarios 3 --duration 2 --seed 5 --json".split()
    command = [sys.executable, "-c", block, "evaluate", str(policy_file), *flags, str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    result = json.loads(out.read_text())
    expected = "suite scenarios duration_s seed falls fall_rate tilt_deg action_mm_mean"
    assert set(result) == {*expected.split(), "physics_steps_per_second"}
    assert set(result["tilt_deg"]) == {"mean", "rms", "p50", "p95", "p99", "max"}
    assert (result["suite"], result["scenarios"], result["seed"]) == ("corner", 3, 5)
    assert result["duration_s"] == 2.0


def test_every_suite_has_scenarios_for_another_incline(config: Config) -> None:
    steep = dataclasses.replace(config, task=dataclasses.replace(config.task, max_incline=2.0))
    for suite in SUITES:
        assert np.abs(make_scenarios(steep, suite, 20, 60, 0).targets).max() <= 2.0
