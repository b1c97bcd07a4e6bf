"""Evaluation in plain MuJoCo, with hand-made controllers and a random network."""

import copy
import dataclasses
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import psutil
import pytest
from fixtures.fleet import observation_names
from fixtures.policies import random_params, random_policy, rewrite
from scipy.spatial.transform import Rotation

from mjx_balance.cli.common import ControllerArgs
from mjx_balance.config import Config
from mjx_balance.envs.batch import BatchEnv, Episodes, rows
from mjx_balance.evaluation import envelope as envelope_module
from mjx_balance.evaluation.controllers import View
from mjx_balance.evaluation.envelope import Envelope, envelope
from mjx_balance.evaluation.rollout import (
    EvaluationError,
    Rollout,
    evaluate,
    observing,
    policy_scene,
    roll_out,
    run_suite,
    settled_action,
    summarize,
)
from mjx_balance.evaluation.suites import Suite, draw_suite
from mjx_balance.policy.file import PolicyError, load_policy, save_policy
from mjx_balance.policy.manifest import make_manifest
from mjx_balance.robots.catalogue import SHIPPED as SHIPPED_ROBOTS
from mjx_balance.robots.catalogue import find_robot
from mjx_balance.sim.scene import Scene, load_scene
from mjx_balance.task.pushes import Pushes
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.tilt import Scenario

STAND, LEFT_UP = 220, 20 * 21 + 10
TARGETS = np.asarray([[(4.0, -2.0)], [(-3.0, 1.0)]])


def always(action: int):
    return lambda view: np.full(len(view.ids), action)


def draw(config: Config, suite: str, count: int, duration: float, seed: int) -> Scenario:
    robot = find_robot(config.robot)
    return draw_suite(config.task, robot, suite, count, duration, seed).scenario


def level_boards(config: Config, count: int, duration: float) -> Scenario:
    """Boards that stay level."""
    return held_boards(config, np.zeros((count, 2)), duration)


def held_boards(config: Config, targets: Any, duration: float) -> Scenario:
    """Boards that turn to `targets` (n, 2), deg, and stay there."""
    drawn = draw(config, "paper", len(targets), duration, 0)
    return drawn._replace(targets=0 * drawn.targets + np.asarray(targets)[:, None])


def nominal(count: int) -> DomainParams:
    """Parameters that change nothing."""
    zero, friction, gain = np.zeros(count), np.full((count, 4), 0.8), np.ones((count, 4, 3))
    noise, at = np.zeros((count, 6)), np.zeros((count, 3))
    return DomainParams(noise, zero, at, friction, gain, delay=zero, softness=zero)


def tilts(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """(steps,) tilt of the body in states (steps, nq), deg."""
    turn = Rotation.from_quat(qpos[:, scene.trunk_quat], scalar_first=True)
    return np.degrees(np.arccos(turn.apply((0, 0, 1))[:, 2]))


class ByHand:
    """A scenario, decision by decision, from the paper's words and MuJoCo's `mj_step` alone.

    Servos are addressed by name; legs of two links of 0.213 m lean acos((h - 22 mm) / 0.426 m);
    feet move in the first 0.1 of a decision; the board walks at its rate. The payload stands on
    the trunk's axis, `up` above its centre.
    """

    LEGS = ("LF", "RF", "LH", "RH")

    def __init__(self, scene: Scene, gain: float, load: float, up: float, delayed: bool):
        self.model, self.delayed, self.scene = copy.copy(scene.model), delayed, scene
        for leg in self.LEGS:
            for joint in ("abduction", "hip", "knee"):
                servo = self.model.actuator(f"robot/{leg}_{joint}")
                servo.gainprm[0], servo.biasprm[1] = 400 * gain, -400 * gain
        trunk = self.model.body("robot/trunk")
        mass = 6.92
        trunk.inertia[:2] += mass * load / (mass + load) * up**2
        trunk.mass[0] += load
        trunk.ipos[2] = load * up / (mass + load)
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:], self.data.qvel[:] = scene.stance.qpos, scene.stance.qvel
        self.data.qacc_warmstart[:] = scene.stance.qacc_warmstart
        self.commands, self.stands = [np.full(4, 0.35)], np.full(4, 0.35)
        self.imu, self.board = [scene.stance.imu] * 200, np.zeros(2)
        self.qpos: list[np.ndarray] = []

    def observation(self) -> np.ndarray:
        """Interprets the names of its entries."""
        values, task = [], self.scene.task
        mujoco.mj_kinematics(self.model, self.data)
        frame = self.data.body("robot/trunk").xmat.reshape(3, 3)
        for name in observation_names(task, self.scene.robot):
            lag = int(name.split("-")[1]) if "-" in name else 0
            symbol, of = name.split(",")[0].split("_")
            if symbol == "H":
                foot = self.data.site(f"robot/{of}_foot").xpos - self.data.body("robot/trunk").xpos
                values.append((-(frame.T @ foot)[2] + 0.022 - 0.35) / 0.01)
            elif symbol == "C":
                command = ([np.full(4, 0.35)] * 9 + self.commands)[-1 - lag]
                values.append((command[self.LEGS.index(of)] - 0.35) / 0.01)
            else:
                channel = "xyz".index(of) + (0 if symbol == "V" else 3)
                last = len(self.imu) - lag
                mean = np.mean([x[channel] for x in self.imu[last - task.imu_mean : last]])
                values.append(mean / (task.gyro_scale if symbol == "V" else task.accel_scale))
        return np.asarray(values)

    def decide(self, action: int, target: np.ndarray, rate: float) -> None:
        """Takes action n_x * 21 + n_y of -3 + 0.3 n mm, and lets 0.2 s pass."""
        a_x, a_y = (-0.003 + 0.0003 * n for n in divmod(action, 21))
        command = self.commands[-1] + (a_x + a_y, a_y - a_x, a_x - a_y, -a_x - a_y)
        goal = self.commands[-1] if self.delayed else command
        self.commands.append(command)
        for k in range(1, 51):
            self.board = self.board + np.clip(target - self.board, -rate * 0.004, rate * 0.004)
            heights = self.stands + (goal - self.stands) * min(k / 5, 1)
            for axis in range(2):
                self.data.actuator(f"board/board_{'xy'[axis]}").ctrl = np.radians(self.board[axis])
            for leg, name in enumerate(self.LEGS):
                lean = np.arccos((heights[leg] - 0.022) / 0.426)
                for joint, angle in enumerate((0.0, lean, -2 * lean)):
                    servo = ("abduction", "hip", "knee")[joint]
                    trim = self.scene.stance.leg_trim[leg, joint]
                    self.data.actuator(f"robot/{name}_{servo}").ctrl = angle + trim
            mujoco.mj_step(self.model, self.data)
            self.qpos.append(self.data.qpos.copy())
            sensors = [self.data.sensor(f"robot/{n}").data for n in ("gyro", "accelerometer")]
            self.imu.append(np.concatenate(sensors))
        self.stands = goal


@pytest.mark.parametrize("rich", [False, True], ids=["paper", "rich"])
def test_rollout_is_what_a_loop_of_single_steps_gives(
    config: Config, scene: Scene, rich: bool
) -> None:
    """Two scenarios of 1.2 s: every state, observation, IMU sample, tilt and action.

    The second has weak servos, a load and delayed actions; `rich` sees commands and means.
    """
    lags = {"command_lags": (0, 2), "imu_mean": 4, "gyro_lags": (0, 20), "accel_lags": (3, 60)}
    task = dataclasses.replace(config.task, **(lags if rich else {}))  # pyright: ignore[reportArgumentType]
    scene = dataclasses.replace(scene, task=task)
    targets, scenarios = TARGETS, Scenario(TARGETS, np.zeros(2), np.asarray((3.5, 2.0)))
    conditions = nominal(2)._replace(
        payload=np.asarray((0.0, 3.0)),
        payload_at=np.asarray([(0, 0, 0), (0, 0, 0.1)]),
        gain=np.asarray((1.0, 0.85))[:, None, None] * np.ones((4, 3)),
        delay=np.asarray((0.0, 1.0)),
    )
    singles = [ByHand(scene, 1.0, 0.0, 0.0, False), ByHand(scene, 0.85, 3.0, 0.1, True)]
    actions = np.random.default_rng(1).integers(0, 441, (6, 2))

    def act(view: View) -> np.ndarray:
        assert view.delayed.tolist() == [False, True]
        for k, single in enumerate(singles):
            np.testing.assert_allclose(view.obs[k], single.observation(), atol=1e-6)
            np.testing.assert_allclose(view.imu[k], single.imu[-50:], atol=1e-7)
            np.testing.assert_allclose(view.qpos[k], single.data.qpos, atol=1e-9)
            np.testing.assert_allclose(view.qvel[k], single.data.qvel, atol=1e-8)
            single.decide(actions[view.env_steps, k], targets[k, 0], (3.5, 2.0)[k])
        return actions[view.env_steps]

    rollout = roll_out(scene, act, Episodes(scenarios, conditions), 1.2, record=True)
    expected = np.asarray([single.qpos for single in singles])
    np.testing.assert_allclose(np.asarray(rollout.qpos), expected, atol=1e-9)
    np.testing.assert_allclose(rollout.tilt, [tilts(scene, x) for x in expected], atol=1e-5)
    assert 1 < rollout.tilt.max() < 6
    levels = np.stack(np.divmod(actions.T, 21))
    np.testing.assert_allclose(rollout.action_mm, np.abs(-3 + 0.3 * levels).mean(axis=0), atol=1e-6)


def test_pushes_come_between_a_choice_and_its_decision(config: Config, scene: Scene) -> None:
    """Pushed before the second and the fifth of six; whoever chooses has not seen it yet."""
    scenarios = Scenario(TARGETS, np.zeros(2), np.full(2, 3.5))
    velocity = np.asarray([[(0.3, -0.1), (0.0, 0.2)], [(-0.2, 0.25), (0.1, 0.1)]])
    singles = [ByHand(scene, 1.0, 0.0, 0.0, False) for _ in range(2)]
    free = scene.model.jnt_dofadr[scene.model.joint("robot/root").id]
    actions = np.random.default_rng(1).integers(0, 441, (6, 2))

    def act(view: View) -> np.ndarray:
        for k, single in enumerate(singles):
            np.testing.assert_allclose(view.obs[k], single.observation(), atol=1e-6)
            np.testing.assert_allclose(view.qvel[k], single.data.qvel, atol=1e-8)
            if view.env_steps in (1, 4):
                single.data.qvel[free : free + 2] += velocity[k, (1, 4).index(view.env_steps)]
            single.decide(actions[view.env_steps, k], TARGETS[k, 0], 3.5)
        return actions[view.env_steps]

    pushes = Pushes(velocity, np.asarray([(1, 4), (1, 4)]))
    rollout = roll_out(scene, act, Episodes(scenarios, pushes=pushes), 1.2, record=True)
    assert not rollout.fell.any()
    np.testing.assert_allclose(np.asarray(rollout.qpos), [x.qpos for x in singles], atol=1e-9)


def test_who_stands_gets_its_own_push_when_others_have_fallen(config: Config, scene: Scene) -> None:
    """Scenario 0 falls within 1.2 s; the push after 2 s moves scenario 1 as it does alone."""
    scenarios = level_boards(config, 2, 3.0)
    pushes = Pushes(np.asarray([[(0.3, 0.0)], [(0.0, -0.25)]]), np.asarray([(10,), (10,)]))
    episodes = Episodes(scenarios, pushes=pushes)
    both = roll_out(scene, lambda view: np.where(view.ids == 0, LEFT_UP, STAND), episodes, 3.0)
    assert both.fell.tolist() == [True, False]
    last = rows(episodes, np.asarray([1]))
    alone = roll_out(scene, always(STAND), last, 3.0)
    np.testing.assert_allclose(both.tilt[1], alone.tilt[0], atol=1e-9)
    assert alone.tilt[0, :500].max() < 0.05 < 0.3 < alone.tilt[0, 500:].max()


def test_tilt_counts_six_from_the_very_step_of_the_fall(config: Config, scene: Scene) -> None:
    """Against the recorded attitudes: the first step beyond 6 deg, of one scenario of three.

    3 mm over a half-track of 142 mm is 1.2 deg a decision: 6 deg take 5 or 6 decisions.
    """
    scenarios = level_boards(config, 3, 3.0)
    actions = np.asarray((STAND, LEFT_UP, STAND))
    rollout = roll_out(scene, lambda view: actions[view.ids], Episodes(scenarios), 3.0, record=True)
    tilted = tilts(scene, rollout.qpos[1])
    first = int(np.flatnonzero(tilted > 6)[0])
    assert 4 * 50 < first < 7 * 50
    assert rollout.fell_at.tolist() == [750, first, 750]
    assert rollout.fell.tolist() == [False, True, False]
    np.testing.assert_allclose(rollout.tilt[1, :first], tilted[:first], atol=1e-5)
    assert (rollout.tilt[1, first:] == 6.0).all()
    assert first % 50, "in the midst of a decision"
    fatal = first // 50
    np.testing.assert_allclose(rollout.action_mm[1, : fatal + 1], 1.5, atol=1e-6)
    assert np.isnan(rollout.action_mm[1, fatal + 1 :]).all()
    assert not np.isnan(rollout.action_mm[[0, 2]]).any()
    still = rollout.qpos[1, 50 * (fatal + 1) - 1 :]
    np.testing.assert_array_equal(still, np.tile(still[0], (len(still), 1)))


def test_who_fell_is_out_even_if_it_rights_itself(config: Config, scene: Scene) -> None:
    """One step overshoots by a little: a limit between its peak and its end ends the scenario."""
    scenarios = level_boards(config, 1, 1.0)
    course = roll_out(scene, always(LEFT_UP), Episodes(scenarios), 0.2).tilt[0]
    limit = float(course.max() + course[-1]) / 2
    assert course[-1] < limit < course.max()
    strict = dataclasses.replace(config, task=dataclasses.replace(config.task, fail_tilt=limit))
    calls = []

    def once(view: View) -> np.ndarray:
        calls.append(view.env_steps)
        return np.full(1, LEFT_UP if view.env_steps == 0 else STAND)

    rollout = roll_out(dataclasses.replace(scene, task=strict.task), once, Episodes(scenarios), 1.0)
    assert calls == [0]
    assert rollout.fell_at[0] == np.flatnonzero(course > limit)[0]
    assert (rollout.tilt[0, rollout.fell_at[0] :] == limit).all()


def test_the_standing_are_shown_their_own_scenario_when_others_have_fallen(
    config: Config, scene: Scene
) -> None:
    """Scenario 2 of three sees, and does, what it sees and does alone; scenario 1 falls."""
    drawn = draw(config, "corner", 3, 4.0, 1)
    drawn = drawn._replace(targets=0.3 * drawn.targets)
    params = nominal(3)._replace(
        payload=np.asarray((0.0, 0.0, 2.0)), delay=np.asarray((0.0, 0.0, 1.0))
    )
    moves = np.random.default_rng(0).choice((STAND - 21, STAND - 1, STAND + 1, STAND + 21), 20)
    seen: dict[int, list[tuple[Any, ...]]] = {0: [], 2: []}

    def run(first: int) -> Rollout:
        def act(view: View) -> np.ndarray:
            own = view.ids + first
            (row,) = np.flatnonzero(own == 2)
            seen[first].append((view.obs[row], view.imu[row], view.qpos[row], view.qvel[row]))
            assert (view.scenario.targets[row] == drawn.targets[2]).all()
            assert view.delayed[row]
            return np.choose(own, (STAND, LEFT_UP, moves[view.env_steps]))

        return roll_out(scene, act, rows(Episodes(drawn, params), np.arange(first, 3)), 4.0)

    together, alone = run(0), run(2)
    assert together.fell.tolist() == [False, True, False]
    np.testing.assert_allclose(together.tilt[2], alone.tilt[0], atol=1e-9)
    for whole, single in zip(seen[0], seen[2], strict=True):
        for ours, own in zip(whole, single, strict=True):
            np.testing.assert_allclose(ours, own, atol=1e-7)


def made_up(config: Config, **values: Any) -> Rollout:
    """A rollout of two scenarios of 100 steps with tilts 0.00, 0.01, ..., 1.99, shuffled."""
    tilt = np.random.default_rng(0).permutation(200).reshape(2, 100) / 100
    actions = np.asarray([(0.3, 0.9), (0.6, np.nan)])
    rollout = Rollout(config.task, tilt, np.asarray((100, 30)), actions, None, seconds=0.5)
    return dataclasses.replace(rollout, **values)


def test_summary_by_hand(config: Config) -> None:
    """Mean and rms of 0..199; percentiles q lie at 1.99 q; 130 steps in 0.5 s; one fall of two."""
    got = summarize(made_up(config), "corner", 12, 7)
    tilt = got.pop("tilt_deg")
    assert got == {
        "suite": "corner",
        "scenarios": 2,
        "duration_s": 12.0,
        "seed": 7,
        "falls": 1,
        "fall_rate": 0.5,
        "action_mm_mean": pytest.approx(0.6),
        "action_mm_settled": None,
        "physics_steps_per_second": pytest.approx(260.0),
    }
    percentiles = {"p50": 0.995, "p95": 1.8905, "p99": 1.9701, "max": 1.99}
    rms = np.sqrt(199 * 399 / 6) / 100
    assert tilt == pytest.approx({"mean": 0.995, "rms": rms} | percentiles)
    assert json.loads(json.dumps(summarize(made_up(config), "corner", 12, 7)))["falls"] == 1


def test_a_fall_at_the_last_step_is_a_fall(config: Config) -> None:
    assert made_up(config, fell_at=np.asarray((99, 100))).fell.tolist() == [True, False]
    assert made_up(config, fell_at=np.asarray((0, 100))).fell.tolist() == [True, False]


@pytest.mark.parametrize(
    ("period", "settled"),
    [
        # Decisions at 0.2 s: the last 3 s of 10 begin at 7.0 s, and at 10.0 s the board turns.
        (10.0, {*range(35, 50), *range(85, 100)}),
        # A period of 2 s is settled all along, but for the decision at its turn.
        (2.0, {k for k in range(100) if k % 10}),
    ],
)
def test_settled_decisions_one_by_one(config: Config, period: float, settled: set[int]) -> None:
    """A single 1 among zeros tells which decisions are averaged, and by how many."""
    config = dataclasses.replace(
        config, task=dataclasses.replace(config.task, target_period=period)
    )
    found = set()
    for k in range(100):
        actions = np.zeros((2, 100))
        actions[1, k] = 1.0
        got = settled_action(made_up(config, action_mm=actions))
        if got:
            found.add(k)
            assert got == pytest.approx(0.5 / len(settled))
    assert found == settled


def test_settled_action_leaves_out_the_fallen(config: Config) -> None:
    actions = np.full((2, 50), 0.4)
    actions[1, 40:] = np.nan
    actions[0, 45:] = 1.0
    got = settled_action(made_up(config, action_mm=actions))
    assert got == pytest.approx((15 * 0.4 + 5 * 1.0) / 20)
    assert settled_action(made_up(config, action_mm=actions[:, :35])) is None
    actions[:, 30:] = np.nan
    assert settled_action(made_up(config, action_mm=actions)) is None


@pytest.mark.parametrize("suite", ["steps", "sea", "platform", Suite(motion="ramps")])
def test_no_action_is_settled_where_the_board_may_turn_at_any_time(
    config: Config, suite: str | Suite
) -> None:
    """Training's motions begin at a random part of the period; those of suites at its start."""
    rollout = made_up(config, action_mm=np.full((2, 50), 0.4))
    assert summarize(rollout, suite, 10, 7)["action_mm_settled"] is None
    for ramps in ("corner", Suite(fast=True)):
        assert summarize(rollout, ramps, 10, 7)["action_mm_settled"] == pytest.approx(0.4)


def grid(falls: list[list[float]]) -> Envelope:
    """Inclines 2, 6 and 20 deg by 3, 4 and 5 deg/s, of which 6 and 4 can still be met."""
    return Envelope([2.0, 6.0, 20.0], [3.0, 4.0, 5.0], falls, falls, 4.0, 6.0, 1, 1.0, 0)


def test_share_of_the_feasible_cells_without_a_fall() -> None:
    """Four cells can be met, bounds included; one of them has a rare fall."""
    assert grid([[0, 0, 1], [0, 0.01, 1], [1, 1, 1]]).fall_free_share == 0.75
    assert grid([[0, 0, 0], [1, 0.5, 0], [0, 0, 0]]).fall_free_share == 0.5
    assert grid([[0, 0, 1], [0, 0, 1], [1, 1, 1]]).fall_free_share == 1.0
    weak = dataclasses.replace(grid([[0, 0, 0]] * 3), authority=2.9)
    assert weak.fall_free_share is None


def test_cells_of_the_envelope_are_inclines_by_speeds(
    config: Config, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A made-up simulation in which a robot falls beyond 8 deg or 5 deg/s, tilted by both."""
    asked, shares = [], []

    def roll(scene: Scene, controller: Any, episodes: Episodes, duration: float, progress: Any):
        progress(duration)
        drawn = episodes.scenario
        asked.append((scene.task, drawn))
        incline, rate = np.abs(drawn.targets[:, 0, 0]), drawn.rate
        fell = (incline > 8) | (rate > 5)
        # One of the two scenarios of a cell in the corner stands.
        fell[np.flatnonzero((incline == 12) & (rate == 6))[1]] = False
        tilt = np.tile((incline + rate / 100)[:, None], (1, 4))
        return Rollout(config.task, tilt, np.where(fell, 1, 4), np.zeros((len(fell), 1)), None, 1.0)

    monkeypatch.setattr(envelope_module, "roll_out", roll)
    found = envelope(scene, always(STAND), 2, 12.0, 3, shares.append)
    assert shares == [12.0]
    assert found.inclines == list(range(2, 13))
    assert found.rates == [2.5 + 0.25 * k for k in range(15)]
    falls, tilt = np.asarray(found.fall_rate), np.asarray(found.mean_tilt)
    expected = [[float(i > 8 or r > 5) for r in found.rates] for i in found.inclines]
    expected[-1][-1] = 0.5
    np.testing.assert_array_equal(falls, expected)
    np.testing.assert_allclose(tilt, np.add.outer(found.inclines, np.divide(found.rates, 100)))
    assert (found.scenarios, found.duration_s, found.seed) == (2, 12.0, 3)
    assert found.authority == pytest.approx(4.453, abs=1e-3)
    assert found.reach == pytest.approx(10.35, abs=0.02)
    (used, drawn) = asked[0]
    # The slowest board needs 24 deg / 2.5 deg/s = 9.6 s, less than the 10 s of the task.
    assert used.target_period == 10.0
    assert (np.abs(drawn.targets) == np.abs(drawn.targets[:, :1, :1])).all(), "both axes at once"
    assert len(np.unique(np.sign(drawn.targets).reshape(-1, 2), axis=0)) == 4
    hasty = dataclasses.replace(config, task=dataclasses.replace(config.task, target_period=5.0))
    envelope(dataclasses.replace(scene, task=hasty.task), always(STAND), 2, 12.0, 3)
    assert asked[1][0].target_period == pytest.approx(9.6)
    with pytest.raises(EvaluationError, match="scenarios is 0"):
        envelope(scene, always(STAND), 0, 12.0, 3)


@pytest.mark.parametrize(("duration", "decisions"), [(0.6, 3), (3 * 0.2, 3), (0.5, 3), (0.01, 1)])
def test_duration_is_rounded_up_to_whole_decisions(
    config: Config, scene: Scene, duration: float, decisions: int
) -> None:
    done = []
    rollout = roll_out(
        scene, always(STAND), Episodes(level_boards(config, 1, 2.0)), duration, progress=done.append
    )
    assert rollout.tilt.shape == (1, 50 * decisions)
    assert rollout.action_mm.shape == (1, decisions)
    assert rollout.seconds > 0
    assert rollout.qpos is None
    assert done == pytest.approx([(k + 1) / decisions for k in range(decisions)])


def test_what_does_not_fit_into_memory_is_refused_before_it_begins(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """2 scenarios of 1 s are 500 steps: 12 kB of tilts, 96 kB with every position."""

    def free(available: int) -> None:
        memory = SimpleNamespace(available=available)
        monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)

    free(20_000)
    run_suite(scene, always(STAND), "paper", 2, 1.0, 0)
    with pytest.raises(EvaluationError, match=r"scenarios is 2 and duration 1 s: .* lower one"):
        run_suite(scene, always(STAND), "paper", 2, 1.0, 0, record=True)
    free(10_000)
    with pytest.raises(EvaluationError, match="scenarios is 2 and duration 1 s"):
        run_suite(scene, always(STAND), "paper", 2, 1.0, 0)


def test_no_scenarios_and_no_time_are_refused(scene: Scene) -> None:
    for count, duration in ((0, 1.0), (1, 0.0), (1, -1.0), (1, np.nan), (1, np.inf)):
        with pytest.raises(EvaluationError, match="duration is" if count else "scenarios is 0"):
            run_suite(scene, always(STAND), "paper", count, duration, 0)


def watch(scene: Scene, suite: str, count: int, seed: int, first: int = STAND) -> list[View]:
    """What 2 s of a suite show; scenario 0 takes the action `first` throughout."""
    views = []

    def act(view: View) -> np.ndarray:
        views.append(view)
        return np.where(view.ids == 0, first, STAND)

    run_suite(scene, act, suite, count, 2.0, seed)
    return views


def test_suites_bring_their_noise_and_delay(config: Config, scene: Scene) -> None:
    """Noise differs from seed to seed, and the first decision sees none yet."""
    views = [watch(scene, name, 1, 0) for name in ("paper", "noise", "noise")]
    quiet, noisy, again = (np.asarray([view.imu[0] for view in x]) for x in views)
    np.testing.assert_array_equal(quiet[0], noisy[0])
    np.testing.assert_array_equal(noisy, again)
    jitter = (noisy - quiet)[1:]
    np.testing.assert_allclose(jitter.std(axis=(0, 1)), [0.002] * 3 + [0.023] * 3, rtol=0.2)
    newest = noisy[:, -1, 3] / config.task.accel_scale
    np.testing.assert_allclose([view.obs[0, 16] for view in views[1]], newest, rtol=1e-6)
    still, shaken = (
        np.asarray([view.imu[0] for view in watch(scene, x, 1, 1)[1:4]]) for x in ("paper", "noise")
    )
    assert abs(np.corrcoef((shaken - still).ravel(), jitter[:3].ravel())[0, 1]) < 0.2
    for suite, delayed in (("latency", True), ("paper", False), ("payload", False)):
        assert watch(scene, suite, 3, 0)[0].delayed.tolist() == [delayed] * 3


def test_noise_of_a_scenario_does_not_depend_on_the_others(scene: Scene) -> None:
    """However many there are, and though scenario 0 falls within 1.2 s."""
    fallen, standing = watch(scene, "noise", 2, 0, LEFT_UP), watch(scene, "noise", 3, 0)
    assert fallen[-1].ids.tolist() == [1]
    for one, other in zip(fallen, standing, strict=True):
        np.testing.assert_array_equal(one.imu[one.ids == 1], other.imu[other.ids == 1])


def test_without_control_the_body_follows_the_board(config: Config, scene: Scene) -> None:
    scenarios = held_boards(config, [(0.0, 0.0), (3.0, 4.0)], 4.0)
    rollout = roll_out(scene, always(STAND), Episodes(scenarios), 4.0)
    assert not rollout.fell.any()
    assert rollout.tilt[0].max() < 0.05
    assert rollout.tilt[1, -1] == pytest.approx(5.0, abs=0.3)
    assert np.all(rollout.action_mm == 0)


def test_a_simulation_that_is_no_number_counts_as_a_fall(config: Config, scene: Scene) -> None:
    scenarios = held_boards(config, [(0.0, 0.0), (np.nan, 0.0), (0.0, 0.0)], 1.0)
    rollout = roll_out(scene, always(STAND), Episodes(scenarios), 1.0)
    np.testing.assert_array_equal(rollout.fell, (False, True, False))
    assert np.isfinite(rollout.tilt).all()


def test_one_thread_gives_what_many_give(config: Config, scene: Scene) -> None:
    episodes = Episodes(draw(config, "corner", 5, 2.0, 0))
    one, two = (BatchEnv(scene, episodes, threads) for threads in (1, 2))
    for _ in range(5):
        one.step(np.full((5, 2), 0.001))
        two.step(np.full((5, 2), 0.001))
        np.testing.assert_array_equal(one.path, two.path)


def test_a_policy_of_another_scene_is_refused() -> None:
    other = load_policy("best")
    other.scene_hash = "0" * 16
    with pytest.raises(PolicyError, match=r"trained in scene 0{16}, but scenes/ now gives"):
        evaluate(other, "paper", 1, 1.0, 0)


def test_a_policy_whose_robot_is_gone_is_refused() -> None:
    with pytest.raises(PolicyError, match="the policy's robot is 'quadruped', but robot is 'rex'"):
        policy_scene(load_policy("best"), "rex")


STRANGERS = ("rex.toml", "{here}/rex.toml", "menagerie:unitree_go1", "/dev/stdin.toml", "rex", "")


@pytest.mark.parametrize("name", STRANGERS)
def test_what_a_policy_names_is_not_opened(
    name: str, tmp_path: Path, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a scene, an evaluation, a picture; its robot's file would import a module that counts."""
    (tmp_path / "counted.py").write_text("open('imported', 'w')")
    text = (SHIPPED_ROBOTS / "quadruped.toml").read_text()
    model = 'model = "scenes:quadruped.xml"'
    (tmp_path / "rex.toml").write_text(text.replace(model, 'model = "counted.x:y.xml"'))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    modules = ("counted", "mujoco_menagerie")
    for module in modules:
        monkeypatch.delitem(sys.modules, module, raising=False)
    random_policy(tmp_path / "p", config)
    name = name.format(here=tmp_path)
    rewrite(tmp_path / "p", lambda w, m: m["config"].update(robot=name))
    policy = load_policy("p")
    sentence = "; a policy opens no file but its own: name the robot's file with --robot"
    for attempt in (
        lambda: policy_scene(policy),
        lambda: evaluate(policy, "paper", 1, 1.0, 0),
        lambda: ControllerArgs(policy=tmp_path / "p").load(),
    ):
        with pytest.raises(PolicyError, match=f"robot is {re.escape(repr(name)[:60])}.*{sentence}"):
            attempt()
    assert not (tmp_path / "imported").exists()
    assert not set(modules) & set(sys.modules)


def test_the_robot_of_a_policy_is_the_one_that_the_user_names(
    tmp_path: Path, config: Config, scene: Scene
) -> None:
    """Whatever the policy calls it, and from wherever its file is."""
    save_policy(tmp_path / "p", random_params(config), make_manifest(config, scene.hash, {}))
    rewrite(tmp_path / "p", lambda w, m: m["config"].update(robot="gone/quadruped.toml"))
    shutil.copy(SHIPPED_ROBOTS / "quadruped.toml", tmp_path)
    mine = str(tmp_path / "quadruped.toml")
    here, _ = ControllerArgs(policy=tmp_path / "p", robot=mine).load()
    assert here.hash == scene.hash
    result = evaluate(load_policy(tmp_path / "p"), "paper", 1, 1.0, 0, robot=mine)
    assert result["scenarios"] == 1


def test_the_command_writes_the_contract_and_imports_no_jax(tmp_path: Path) -> None:
    names = ("jax", "jaxlib", "flax", "brax", "optax", "orbax")
    block = (
        f"import sys; sys.modules.update(dict.fromkeys({names!r}))\n"
        "from mjx_balance.cli import main\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    out = tmp_path / "out.json"
    flags = "best --suite corner --scenarios 3 --duration 2 --seed 5 --json".split()
    command = [sys.executable, "-c", block, "evaluate", *flags, str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    result = json.loads(out.read_text())
    expected = "suite scenarios duration_s seed falls fall_rate tilt_deg action_mm_mean"
    assert set(result) == {*expected.split(), "action_mm_settled", "physics_steps_per_second"}
    assert set(result["tilt_deg"]) == {"mean", "rms", "p50", "p95", "p99", "max"}
    assert (result["suite"], result["scenarios"], result["seed"]) == ("corner", 3, 5)
    assert result["duration_s"] == 2.0


def test_a_payload_off_the_centre_bends_the_legs_under_it(config: Config, scene: Scene) -> None:
    loaded = nominal(2)._replace(
        payload=np.asarray((0.0, 5.0)), payload_at=np.asarray(((0.0, 0, 0), (0.1, 0, 0.1)))
    )
    episodes = Episodes(level_boards(config, 2, 2.0), loaded)
    rollout = roll_out(scene, always(STAND), episodes, 2.0, record=True)
    height = rollout.qpos[:, -1, scene.trunk_quat[0] - 1]
    assert rollout.tilt[0, -1] < 0.05 < rollout.tilt[1, -1]
    assert height[1] < height[0]


def test_feet_slide_where_friction_is_low(config: Config, scene: Scene) -> None:
    """4.5 degrees hold with friction 0.4 and not with 0.05: the robot slides downhill."""
    icy = nominal(2)._replace(friction=np.asarray(((0.4,) * 4, (0.05,) * 4)))
    episodes = Episodes(held_boards(config, [(0.0, 4.5)] * 2, 4.0), icy)
    rollout = roll_out(scene, always(STAND), episodes, 4.0, record=True)
    x = np.abs(rollout.qpos[:, -1, scene.trunk_quat[0] - 3])
    assert x[0] < 0.05 < x[1]


@pytest.mark.slow
def test_envelope_of_standing_still(scene: Scene) -> None:
    """Who never moves falls where 6 deg are passed: from 4.25 deg on both axes at once."""
    found = envelope(scene, always(STAND), 1, 12.0, 0)
    falls = np.asarray(found.fall_rate)
    assert falls.shape == (len(found.inclines), len(found.rates))
    assert not falls[np.asarray(found.inclines) < 4.1].any()
    assert falls[np.asarray(found.inclines) > 4.9].all()
    assert 4.4 < found.authority < 4.5
    assert 10 < found.reach < 11
    feasible = np.asarray(found.inclines) <= found.reach
    share = np.mean(np.asarray(found.inclines)[feasible] < 4.5)
    assert found.fall_free_share == pytest.approx(share)


def test_a_policy_is_evaluated_in_its_scene() -> None:
    policy = load_policy("best")
    rollout = run_suite(load_scene(policy.config), observing(policy), "paper", 2, 1.0, 3)
    shares: list[float] = []
    result = evaluate(policy, "paper", 2, 1.0, 3, shares.append)
    assert result["tilt_deg"]["mean"] == rollout.tilt.mean()
    assert shares == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
