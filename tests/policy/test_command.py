"""Commands of a policy, on the grid and off it, from the network to the legs."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.policies import HEADS, random_policy, rewrite, with_head

from mjx_balance.cli import main
from mjx_balance.config import Config, ConfigError, preset
from mjx_balance.envs.batch import Episodes
from mjx_balance.envs.gym import BalanceGymEnv
from mjx_balance.evaluation.controllers import View
from mjx_balance.evaluation.rollout import Rollout, observing, roll_out, run_suite
from mjx_balance.evaluation.suites import draw_suite
from mjx_balance.policy.file import load_policy
from mjx_balance.policy.network import Policy
from mjx_balance.robots.catalogue import find_robot
from mjx_balance.runtime import Controller
from mjx_balance.sim.scene import load_scene
from mjx_balance.task.observation import input_rows

CHANGE = np.asarray((0.00071, -0.00106))
"""A command between the points of the grid, m; its nearest action is (0.6, -1.2) mm."""


def always(change: np.ndarray, config: Config, path: Path) -> Policy:
    """A policy off the grid whose mu stands for this height change, m, whatever it sees."""
    random_policy(path, with_head(config, "radial", action="continuous"))

    def edit(weights: dict[str, np.ndarray], manifest: Any) -> None:
        weights["head/kernel"][:, 1:] = 0
        weights["head/bias"][1:] = change / 0.003

    rewrite(path, edit)
    return load_policy(path)


def test_a_command_is_the_best_point_in_metres(tmp_path: Path, config: Config) -> None:
    """Mu times 3 mm, within +-3 mm; the action is the nearest of the grid's."""
    policy = always(CHANGE, config, tmp_path / "p")
    obs = np.random.default_rng(0).normal(size=(4, 34))
    np.testing.assert_allclose(policy.command(obs), np.tile(CHANGE, (4, 1)), rtol=1e-6)
    np.testing.assert_allclose(policy.command(obs[0]), CHANGE, rtol=1e-6)
    np.testing.assert_allclose(1000 * policy.actions[policy(obs[0])], (0.6, -1.2), atol=1e-5)
    on_grid = policy.with_action("grid")
    np.testing.assert_allclose(1000 * on_grid.command(obs), [(0.6, -1.2)] * 4, atol=1e-5)
    assert (on_grid.manifest["action"], policy.manifest["action"]) == ("grid", "continuous")
    assert on_grid.with_action("continuous").manifest == policy.manifest
    far = always(np.asarray((-0.004, 0.0031)), config, tmp_path / "p")
    np.testing.assert_allclose(1000 * far.command(obs[0]), (-3, 3), rtol=1e-6)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
def test_no_observation_gives_a_command_beyond_the_table(
    tmp_path: Path, config: Config, value: float
) -> None:
    policy = random_policy(tmp_path / "p", with_head(config, "radial", action="continuous"))
    with np.errstate(all="ignore"):
        command, action = policy.command(np.full(34, value)), policy(np.full(34, value))
    assert np.abs(command).max() <= np.float32(0.003)
    np.testing.assert_allclose(command, policy.actions[action], atol=0.00015001)


@pytest.mark.parametrize("head", HEADS)
def test_on_the_grid_every_head_commands_its_action(
    tmp_path: Path, config: Config, head: str
) -> None:
    policy = random_policy(tmp_path / "p", with_head(config, head))
    obs = np.random.default_rng(0).normal(size=(32, 34))
    np.testing.assert_array_equal(policy.command(obs), policy.actions[policy(obs)])
    np.testing.assert_array_equal(policy.command(obs[3]), policy.actions[policy(obs[3])])
    if head != "radial":
        with pytest.raises(ConfigError, match=f"action is 'continuous', but head is '{head}'"):
            policy.with_action("continuous")


def test_export_changes_what_a_policy_commands(
    tmp_path: Path, config: Config, capsys: pytest.CaptureFixture[str]
) -> None:
    """And nothing else; the runtime of the robot follows the new file."""
    old, new = tmp_path / "old.safetensors", str(tmp_path / "new.safetensors")
    policy = random_policy(old, with_head(config, "radial"))
    obs = np.random.default_rng(0).normal(size=(8, 34))
    export = ["export", str(old), "--out", new, "--action"]
    assert main([*export, "continuous"]) == 0
    assert load_policy(new).fingerprint == policy.fingerprint
    off_grid = load_policy(new).command(obs)
    np.testing.assert_array_equal(off_grid, policy.with_action("continuous").command(obs))
    assert (off_grid != policy.command(obs)).any()
    assert Controller(new).manifest["action"] == "continuous"
    assert main([*export, "grid"]) == 0
    np.testing.assert_array_equal(load_policy(new).command(obs), policy.command(obs))
    random_policy(old, with_head(config, "joint"))
    assert main([*export, "continuous"]) == 2
    assert "action is 'continuous', but head is 'joint'" in capsys.readouterr().err
    assert load_policy(new).config.dqn.head == "radial"


def test_a_file_that_does_not_say_is_of_the_grid(tmp_path: Path, config: Config) -> None:
    random_policy(tmp_path / "p", with_head(config, "radial"))

    def edit(weights: Any, manifest: Any) -> None:
        del manifest["action"], manifest["config"]["task"]["action"]

    rewrite(tmp_path / "p", edit)
    policy = load_policy(tmp_path / "p")
    assert policy.config.task.action == "grid"
    controller = Controller(tmp_path / "p", lambda: 0.0)
    controller.step(controller.targets, np.zeros(3), np.asarray((0.3, 0.5, 9.8)))
    np.testing.assert_array_equal(controller.command, policy.actions[controller.action])
    assert "action" not in policy.manifest


@pytest.mark.parametrize("suite", ["paper", "latency"])
def test_legs_commands_and_inputs_follow_a_command_off_the_grid(tmp_path: Path, suite: str) -> None:
    """0.8 s of the same command: left up, front down, with a delay a decision later."""
    policy = always(CHANGE, preset("best"), tmp_path / "p")
    scene, act, seen = load_scene(policy.config), observing(policy), []
    robot = find_robot("quadruped")
    sides = np.asarray([(1 if leg.left else -1, 1 if leg.front else -1) for leg in robot.legs])

    def watch(view: View) -> np.ndarray:
        seen.append(view.obs[0])
        return act(view)

    rollout = run_suite(scene, watch, suite, 1, 0.8, 3)
    np.testing.assert_allclose(rollout.action_mm, (0.71 + 1.06) / 2, rtol=1e-6)
    names = [row.name for row in input_rows(policy.config.task, robot)]
    for number, obs in enumerate(seen):
        for lag in (0, 1, 2):
            got = [obs[names.index(f"C_{leg.name},d-{lag}")] for leg in robot.legs]
            expected = max(number - lag, 0) * (sides @ CHANGE) / 0.01
            np.testing.assert_allclose(got, expected, atol=1e-5)
        got = [obs[names.index(f"H_{leg.name}")] for leg in robot.legs]
        done = max(number - (suite == "latency"), 0)
        np.testing.assert_allclose(got, done * (sides @ CHANGE) / 0.01, atol=0.05)


def test_mirrored_boards_get_mirrored_commands(tmp_path: Path) -> None:
    """Of a policy that reads roll and pitch rates alone, with a mirror-symmetric law."""
    policy = always(np.zeros(2), preset("best"), tmp_path / "p")
    rows = input_rows(policy.config.task, policy.robot)
    names, kernel = [row.name for row in rows], policy.layers[-1][0]
    kernel[16 + names.index("V_x,t-0"), 1] = -0.7
    kernel[16 + names.index("V_y,t-0"), 2] = 0.9
    scene = load_scene(policy.config)

    def run(sign: int) -> tuple[np.ndarray, Rollout]:
        seen, act = [], observing(policy)
        drawn = draw_suite(scene.task, scene.robot, "corner", 2, 2.0, 0).scenario
        drawn = drawn._replace(targets=drawn.targets * (sign, 1))

        def watch(view: View) -> np.ndarray:
            seen.append(act(view))
            return seen[-1]

        rollout = roll_out(scene, watch, Episodes(drawn), 2.0)
        return np.asarray(seen), rollout

    (seen, one), (mirrored, other) = run(1), run(-1)
    assert np.abs(seen).max() > 5e-4
    np.testing.assert_allclose(mirrored, seen * (-1, 1), atol=1e-9)
    np.testing.assert_allclose(other.tilt, one.tilt, atol=1e-7)


def test_gymnasium_takes_the_commands_as_shares(tmp_path: Path) -> None:
    """The env of a policy's config has the policy's kind of action, and does what evaluation does.

    The first second of an episode of a policy that reads the roll rate.
    """
    policy = always(CHANGE, preset("default"), tmp_path / "p")
    policy.layers[-1][0][16 + 4, 1] = -0.5
    env = BalanceGymEnv(config=policy.config)
    assert env.action_space.shape == (2,)
    obs, _ = env.reset(seed=3)
    assert env.batch is not None
    scenario, tilts = env.batch.state.scenario, []
    for _ in range(5):
        obs, _, _, _, info = env.step(policy.command(obs) / policy.config.task.action_max)
        tilts.append(info["tilt_deg"])
    rollout = roll_out(env.scene, observing(policy), Episodes(scenario), 1.0)
    np.testing.assert_allclose(tilts, rollout.tilt.reshape(5, 50).mean(axis=-1), atol=1e-6)
    assert BalanceGymEnv(config=policy.with_action("grid").config).action_space.n == 441
    assert BalanceGymEnv(config=policy.config, action="discrete").action_space.n == 441
