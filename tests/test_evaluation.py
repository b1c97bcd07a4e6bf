"""Evaluation in plain MuJoCo, with hand-made controllers and a random network."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mjx_balance.task.conditions import Conditions

from mjx_balance.config import Config
from mjx_balance.evaluation import (
    EvaluationError,
    envelope,
    evaluate,
    observing,
    roll_out,
    run_suite,
    summarize,
)
from mjx_balance.policy import PolicyError, make_manifest, save_policy
from mjx_balance.scene import Scene
from mjx_balance.suites import SuiteError, make_scenarios
from mjx_balance.task.tilt import Scenario

STAND, LEFT_UP = 220, 20 * 21 + 10


def always(action: int):
    return lambda view: np.full(len(view.ids), action)


def draw(config: Config, suite: str, count: int, duration: float, seed: int) -> Scenario:
    return make_scenarios(config, suite, count, duration, seed)[0]


@pytest.fixture(scope="session")
def policy_file(config: Config, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained policy of the default network."""
    rng = np.random.default_rng(0)
    layers: dict[str, Any] = {
        name: {"kernel": rng.normal(size=(a, b)) / np.sqrt(a), "bias": np.zeros(b)}
        for name, a, b in (("hidden_0", 34, 64), ("hidden_1", 64, 64), ("head", 64 + 34, 3))
    }
    layers |= {"profile": np.zeros(4), "stretch": np.zeros(2)}
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    save_policy(path, {"params": layers}, make_manifest(config, scene.hash, (21, 21), {}))
    return path


def test_standing_still_on_a_level_board_stays_level(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "paper", 2, 4.0, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    rollout = roll_out(scene, config, always(STAND), level, 4.0)
    assert not rollout.fell.any()
    assert rollout.tilt.max() < 0.05
    assert np.all(rollout.action_mm == 0)


def test_without_control_the_body_follows_the_board(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "paper", 1, 4.0, 0)
    held = scenarios._replace(targets=np.tile((3.0, 4.0), (1, scenarios.targets.shape[1], 1)))
    rollout = roll_out(scene, config, always(STAND), held, 4.0)
    assert not rollout.fell.any()
    assert rollout.tilt[0, -1] == pytest.approx(5.0, abs=0.3)


def test_raising_the_left_side_tilts_the_body_and_a_fall_counts_to_the_end(
    config: Config, scene: Scene
) -> None:
    scenarios = draw(config, "paper", 3, 8.0, 0)
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
    scenarios = draw(config, "paper", 3, 1.0, 0)
    targets = 0 * scenarios.targets
    targets[1] = np.nan
    rollout = roll_out(scene, config, always(STAND), scenarios._replace(targets=targets), 1.0)
    np.testing.assert_array_equal(rollout.fell, (False, True, False))
    assert np.isfinite(rollout.tilt).all()


def test_one_thread_gives_what_many_give(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "corner", 5, 2.0, 0)
    one, two = (roll_out(scene, config, always(STAND), scenarios, 2.0, n).tilt for n in (1, 2))
    np.testing.assert_array_equal(one, two)


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

    other = load_policy(policy_file)
    other.scene_hash = "0" * 16
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
    assert set(result) == {*expected.split(), "action_mm_settled", "physics_steps_per_second"}
    assert set(result["tilt_deg"]) == {"mean", "rms", "p50", "p95", "p99", "max"}
    assert (result["suite"], result["scenarios"], result["seed"]) == ("corner", 3, 5)
    assert result["duration_s"] == 2.0


def nominal(count: int) -> Conditions:
    return Conditions(
        imu_noise=np.zeros((count, 6)),
        payload=np.zeros(count),
        payload_at=np.zeros((count, 3)),
        friction=np.full(count, 0.8),
        gain=np.ones(count),
        latency=np.zeros(count),
    )


def test_nominal_conditions_change_nothing(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "corner", 3, 2.0, 0)
    plain = roll_out(scene, config, always(LEFT_UP), scenarios, 2.0)
    same = roll_out(scene, config, always(LEFT_UP), scenarios, 2.0, conditions=nominal(3))
    np.testing.assert_allclose(plain.tilt, same.tilt, atol=1e-6)


def test_a_payload_off_the_centre_bends_the_legs_under_it(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "paper", 2, 2.0, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    loaded = nominal(2)._replace(
        payload=np.asarray((0.0, 5.0)), payload_at=np.asarray(((0.0, 0, 0), (0.1, 0, 0.1)))
    )
    rollout = roll_out(scene, config, always(STAND), level, 2.0, conditions=loaded, record=True)
    assert rollout.qpos is not None
    height = rollout.qpos[:, -1, scene.trunk_quat[0] - 1]
    assert rollout.tilt[0, -1] < 0.05 < rollout.tilt[1, -1]
    assert height[1] < height[0]


def test_weak_servos_sag(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "paper", 2, 2.0, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    weak = nominal(2)._replace(gain=np.asarray((1.0, 0.8)))
    rollout = roll_out(scene, config, always(STAND), level, 2.0, conditions=weak, record=True)
    assert rollout.qpos is not None
    height = rollout.qpos[:, -1, scene.trunk_quat[0] - 1]
    assert height[1] < height[0] - 5e-4


def test_feet_slide_where_friction_is_low(config: Config, scene: Scene) -> None:
    """7 degrees hold with friction 0.4 and not with 0.05: the robot slides downhill."""
    held = draw(config, "paper", 2, 4.0, 0)
    held = held._replace(targets=np.tile((0.0, 4.5), (2, held.targets.shape[1], 1)))
    icy = nominal(2)._replace(friction=np.asarray((0.4, 0.05)))
    rollout = roll_out(scene, config, always(STAND), held, 4.0, conditions=icy, record=True)
    assert rollout.qpos is not None
    x = np.abs(rollout.qpos[:, -1, scene.trunk_quat[0] - 3])
    assert x[0] < 0.05 < x[1]


def test_late_actions_arrive_one_decision_late(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "paper", 2, 0.6, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    late = nominal(2)._replace(latency=np.asarray((0.0, 1.0)))
    rollout = roll_out(scene, config, always(LEFT_UP), level, 0.6, conditions=late)
    prompt, delayed = rollout.tilt
    assert prompt[45] > 1.0 > 0.05 > delayed[45]
    np.testing.assert_allclose(delayed[50:], prompt[:100], atol=0.03)


def test_imu_noise_has_the_size_asked_for_and_is_seen_by_the_controller(
    config: Config, scene: Scene
) -> None:
    scenarios = draw(config, "paper", 40, 1.0, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    noisy = nominal(40)._replace(imu_noise=np.tile((0.002,) * 3 + (0.023,) * 3, (40, 1)))
    seen = []

    def watch(view) -> np.ndarray:
        seen.append(view)
        return np.full(len(view.ids), STAND)

    roll_out(scene, config, watch, level, 1.0, conditions=noisy)
    imu = seen[-1].imu
    assert imu.shape == (40, 50, 6)
    np.testing.assert_allclose(imu[..., :3].std(), 0.002, rtol=0.05)
    np.testing.assert_allclose((imu - imu.mean(axis=(0, 1)))[..., 3:].std(), 0.023, rtol=0.05)
    newest = imu[:, -1, 3] / config.task.accel_scale
    np.testing.assert_allclose(seen[-1].obs[:, 16], newest, rtol=1e-6)


def test_settled_action_is_that_of_the_last_three_seconds(config: Config, scene: Scene) -> None:
    """Moves in the first 7 s of a period only: nothing while the board has long been at rest."""
    scenarios = draw(config, "paper", 1, 20.0, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    moves = {k: LEFT_UP if k % 2 else 440 - LEFT_UP for k in range(100) if k % 50 < 34}
    mover = roll_out(
        scene, config, lambda view: np.full(1, moves.get(view.decision, STAND)), level, 20.0
    )
    assert summarize(mover, "paper", 20.0, 0)["action_mm_settled"] == 0.0
    late = {50 * n + k: 21 * 10 + (11 if k % 2 else 9) for n in range(2) for k in range(35, 50)}
    fidget = roll_out(
        scene, config, lambda view: np.full(1, late.get(view.decision, STAND)), level, 20.0
    )
    assert summarize(fidget, "paper", 20.0, 0)["action_mm_settled"] == pytest.approx(0.15, rel=1e-3)


def test_envelope_of_standing_still(config: Config, scene: Scene) -> None:
    """Who never moves falls where 6 deg are passed: from 4.25 deg on both axes at once."""
    found = envelope(scene, config, always(STAND), 1, 12.0, 0)
    falls = np.asarray(found.fall_rate)
    assert falls.shape == (len(found.inclines), len(found.rates))
    assert not falls[np.asarray(found.inclines) < 4.1].any()
    assert falls[np.asarray(found.inclines) > 4.9].all()
    assert 4.4 < found.authority < 4.5
    assert 10 < found.reach < 11
    feasible = np.asarray(found.inclines) <= found.reach
    share = np.mean(np.asarray(found.inclines)[feasible] < 4.5)
    assert found.fall_free_share == pytest.approx(share)


def test_a_policy_is_a_controller(config: Config, scene: Scene, policy_file: Path) -> None:
    from mjx_balance import load_policy

    policy = load_policy(policy_file)
    rollout = run_suite(scene, config, observing(policy), "paper", 2, 1.0, 3)
    result = evaluate(policy, "paper", 2, 1.0, 3)
    assert result["tilt_deg"]["mean"] == rollout.tilt.mean()


def test_unknown_suite_is_refused(policy_file: Path) -> None:
    from mjx_balance import load_policy

    with pytest.raises(SuiteError, match="unknown suite 'moon'; known suites: paper, corner, noi"):
        evaluate(load_policy(policy_file), "moon", 1, 1.0, 0)
