"""Evaluation in plain MuJoCo, with hand-made controllers and a random network."""

import copy
import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import psutil
import pytest
from scipy.spatial.transform import Rotation

from mjx_balance.config import Config
from mjx_balance.envs.batch import BatchEnv, Episodes
from mjx_balance.evaluation import envelope as envelope_module
from mjx_balance.evaluation.controllers import View
from mjx_balance.evaluation.envelope import Envelope, envelope
from mjx_balance.evaluation.rollout import (
    EvaluationError,
    Rollout,
    evaluate,
    observing,
    roll_out,
    run_suite,
)
from mjx_balance.evaluation.suites import SuiteError, draw_suite
from mjx_balance.evaluation.summary import settled_action, summarize
from mjx_balance.policy.file import save_policy
from mjx_balance.policy.manifest import PolicyError, make_manifest
from mjx_balance.sim.scene import Scene
from mjx_balance.task.observation import observation_names
from mjx_balance.task.pushes import Pushes
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.tilt import Scenario

STAND, LEFT_UP = 220, 20 * 21 + 10


def always(action: int):
    return lambda view: np.full(len(view.ids), action)


def draw(config: Config, suite: str, count: int, duration: float, seed: int) -> Scenario:
    return draw_suite(config, suite, count, duration, seed).scenario


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
    save_policy(path, {"params": layers}, make_manifest(config, scene.hash, {}))
    return path


def level_boards(config: Config, count: int, duration: float) -> Scenario:
    """Boards that stay level."""
    scenarios = draw(config, "paper", count, duration, 0)
    return scenarios._replace(targets=0 * scenarios.targets)


def nominal(count: int) -> DomainParams:
    """Circumstances that change nothing."""
    return DomainParams(
        imu_noise=np.zeros((count, 6)),
        payload=np.zeros(count),
        payload_at=np.zeros((count, 3)),
        friction=np.full(count, 0.8),
        gain=np.ones(count),
        delay=np.zeros(count),
    )


class ByHand:
    """One world, decision by decision, from the paper's words and MuJoCo's `mj_step` alone.

    Servos are addressed by name; legs of two links of 0.213 m lean acos((h - 22 mm) / 0.426 m);
    feet move in the first 0.1 of a decision; the board walks at its rate. The payload stands on
    the trunk's axis, `up` above its centre.
    """

    LEGS = ("LF", "RF", "LH", "RH")

    def __init__(self, scene: Scene, gain: float, load: float, up: float, late: bool):
        self.model, self.late, self.scene = copy.copy(scene.model), late, scene
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
        self.told, self.stands = [np.full(4, 0.35)], np.full(4, 0.35)
        self.imu, self.board = [scene.stance.imu] * 200, np.zeros(2)
        self.qpos: list[np.ndarray] = []

    def observation(self, config: Config) -> np.ndarray:
        """Interprets the names of its entries."""
        values, task = [], config.task
        mujoco.mj_kinematics(self.model, self.data)
        frame = self.data.body("robot/trunk").xmat.reshape(3, 3)
        for name in observation_names(task, self.scene.robot):
            lag = int(name.split("-")[1]) if "-" in name else 0
            symbol, of = name.split(",")[0].split("_")
            if symbol == "H":
                foot = self.data.site(f"robot/{of}_foot").xpos - self.data.body("robot/trunk").xpos
                values.append((-(frame.T @ foot)[2] + 0.022 - 0.35) / 0.01)
            elif symbol == "C":
                told = ([np.full(4, 0.35)] * 9 + self.told)[-1 - lag]
                values.append((told[self.LEGS.index(of)] - 0.35) / 0.01)
            else:
                channel = "xyz".index(of) + (0 if symbol == "V" else 3)
                last = len(self.imu) - lag
                mean = np.mean([x[channel] for x in self.imu[last - task.imu_mean : last]])
                values.append(mean / (task.gyro_scale if symbol == "V" else task.accel_scale))
        return np.asarray(values)

    def decide(self, action: int, target: np.ndarray, rate: float) -> None:
        """Takes action n_x * 21 + n_y of -3 + 0.3 n mm, and lets 0.2 s pass."""
        a_x, a_y = (-0.003 + 0.0003 * n for n in divmod(action, 21))
        wanted = self.told[-1] + (a_x + a_y, a_y - a_x, a_x - a_y, -a_x - a_y)
        goal = self.told[-1] if self.late else wanted
        self.told.append(wanted)
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
    """Two worlds of 1.2 s: every state, observation, IMU sample, tilt and action.

    The second has weak servos, a load and late actions; `rich` sees commands and means.
    """
    lags = {"command_lags": (0, 2), "imu_mean": 4, "gyro_lags": (0, 20), "accel_lags": (3, 60)}
    task = dataclasses.replace(config.task, **(lags if rich else {}))  # pyright: ignore[reportArgumentType]
    scene = dataclasses.replace(scene, config=dataclasses.replace(config, task=task))
    targets = np.asarray([[(4.0, -2.0)], [(-3.0, 1.0)]])
    scenarios = Scenario(targets, np.zeros(2), np.asarray((3.5, 2.0)))
    conditions = nominal(2)._replace(
        payload=np.asarray((0.0, 3.0)),
        payload_at=np.asarray([(0, 0, 0), (0, 0, 0.1)]),
        gain=np.asarray((1.0, 0.85)),
        delay=np.asarray((0.0, 1.0)),
    )
    worlds = [ByHand(scene, 1.0, 0.0, 0.0, False), ByHand(scene, 0.85, 3.0, 0.1, True)]
    actions = np.random.default_rng(1).integers(0, 441, (6, 2))

    def act(view: View) -> np.ndarray:
        assert view.delayed.tolist() == [False, True]
        for k, world in enumerate(worlds):
            np.testing.assert_allclose(view.obs[k], world.observation(scene.config), atol=1e-6)
            np.testing.assert_allclose(view.imu[k], world.imu[-50:], atol=1e-7)
            np.testing.assert_allclose(view.qpos[k], world.data.qpos, atol=1e-9)
            np.testing.assert_allclose(view.qvel[k], world.data.qvel, atol=1e-8)
            world.decide(actions[view.env_steps, k], targets[k, 0], (3.5, 2.0)[k])
        return actions[view.env_steps]

    rollout = roll_out(scene, act, Episodes(scenarios, conditions), 1.2, record=True)
    assert rollout.qpos is not None
    expected = np.asarray([world.qpos for world in worlds])
    np.testing.assert_allclose(rollout.qpos, expected, atol=1e-9)
    turn = Rotation.from_quat(expected[..., scene.trunk_quat].reshape(-1, 4), scalar_first=True)
    tilt = np.degrees(np.arccos(turn.apply((0, 0, 1))[:, 2])).reshape(2, 300)
    np.testing.assert_allclose(rollout.tilt, tilt, atol=1e-5)
    assert 1 < rollout.tilt.max() < 6
    levels = np.stack(np.divmod(actions.T, 21))
    np.testing.assert_allclose(rollout.action_mm, np.abs(-3 + 0.3 * levels).mean(axis=0), atol=1e-6)


def test_kicks_come_between_a_choice_and_its_decision(config: Config, scene: Scene) -> None:
    """Two worlds of six decisions, kicked before the second and the fifth: every state and sample.

    Whoever chooses has not seen the kick yet.
    """
    targets = np.asarray([[(4.0, -2.0)], [(-3.0, 1.0)]])
    scenarios = Scenario(targets, np.zeros(2), np.full(2, 3.5))
    kicks = np.asarray([[(0.3, -0.1), (0.0, 0.2)], [(-0.2, 0.25), (0.1, 0.1)]])
    worlds = [ByHand(scene, 1.0, 0.0, 0.0, False) for _ in range(2)]
    free = scene.model.jnt_dofadr[scene.model.joint("robot/root").id]
    actions = np.random.default_rng(1).integers(0, 441, (6, 2))

    def act(view: View) -> np.ndarray:
        for k, world in enumerate(worlds):
            np.testing.assert_allclose(view.obs[k], world.observation(config), atol=1e-6)
            np.testing.assert_allclose(view.imu[k], world.imu[-50:], atol=1e-7)
            np.testing.assert_allclose(view.qvel[k], world.data.qvel, atol=1e-8)
            if view.env_steps in (1, 4):
                world.data.qvel[free : free + 2] += kicks[k, (1, 4).index(view.env_steps)]
            world.decide(actions[view.env_steps, k], targets[k, 0], 3.5)
        return actions[view.env_steps]

    pushes = Pushes(kicks, np.asarray([(1, 4), (1, 4)]))
    rollout = roll_out(scene, act, Episodes(scenarios, pushes=pushes), 1.2, record=True)
    assert not rollout.fell.any()
    assert rollout.qpos is not None
    np.testing.assert_allclose(rollout.qpos, [world.qpos for world in worlds], atol=1e-9)


def test_who_stands_gets_its_own_kick_when_others_have_fallen(config: Config, scene: Scene) -> None:
    """World 0 falls within 1.2 s; the kick after 2 s moves world 1 as it does alone."""
    scenarios = level_boards(config, 2, 3.0)
    kicks, at = np.asarray([[(0.3, 0.0)], [(0.0, -0.25)]]), np.asarray([(10,), (10,)])
    both = roll_out(
        scene,
        lambda view: np.where(view.ids == 0, LEFT_UP, STAND),
        Episodes(scenarios, pushes=Pushes(kicks, at)),
        3.0,
    )
    assert both.fell.tolist() == [True, False]
    one = Scenario(*(x[1:] for x in scenarios))
    alone = roll_out(scene, always(STAND), Episodes(one, pushes=Pushes(kicks[1:], at[1:])), 3.0)
    np.testing.assert_allclose(both.tilt[1], alone.tilt[0], atol=1e-9)
    assert alone.tilt[0, :500].max() < 0.05 < 0.3 < alone.tilt[0, 500:].max()


def test_suite_push_kicks_every_five_seconds(config: Config, scene: Scene) -> None:
    """What the IMU of robots that stand still reads is that of suite `paper` up to 5 s."""
    flat = dataclasses.replace(config, task=dataclasses.replace(config.task, max_incline=2.0))
    scene = dataclasses.replace(scene, config=flat)
    seen: dict[str, list[np.ndarray]] = {"push": [], "paper": []}
    for suite, samples in seen.items():

        def act(view: View, samples: list[np.ndarray] = samples) -> np.ndarray:
            samples.append(view.imu.copy())
            return np.full(len(view.ids), STAND)

        run_suite(scene, act, suite, 3, 6.0, 1)
    difference = np.abs(np.asarray(seen["push"]) - seen["paper"]).max(axis=(1, 2, 3))
    # What is seen at decision 26 happened in decision 25, from 5.0 s on.
    assert difference[:26].max() < 0.01
    assert difference[26] > 1


def test_tilt_counts_six_from_the_very_step_of_the_fall(config: Config, scene: Scene) -> None:
    """Against the recorded attitudes: the first step beyond 6 deg, of one world of three."""
    scenarios = level_boards(config, 3, 3.0)
    actions = np.asarray((STAND, LEFT_UP, STAND))
    rollout = roll_out(scene, lambda view: actions[view.ids], Episodes(scenarios), 3.0, record=True)
    assert rollout.qpos is not None
    quat = rollout.qpos[1][:, scene.trunk_quat]
    up = Rotation.from_quat(quat, scalar_first=True).apply((0, 0, 1))[:, 2]
    tilted = np.degrees(np.arccos(up))
    first = int(np.flatnonzero(tilted > 6)[0])
    assert rollout.fell_at.tolist() == [750, first, 750]
    assert rollout.fell.tolist() == [False, True, False]
    np.testing.assert_allclose(rollout.tilt[1, :first], tilted[:first], atol=1e-5)
    assert (rollout.tilt[1, first:] == 6.0).all()
    assert first % 50, "in the midst of a decision"
    fatal = first // 50
    np.testing.assert_allclose(rollout.action_mm[1, : fatal + 1], 1.5, atol=1e-6)
    assert np.isnan(rollout.action_mm[1, fatal + 1 :]).all()
    assert not np.isnan(rollout.action_mm[[0, 2]]).any()
    still = rollout.qpos[1, 50 * (fatal + 1) :]
    last = rollout.qpos[1, 50 * (fatal + 1) - 1]
    np.testing.assert_array_equal(still, np.tile(last, (len(still), 1)))


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

    rollout = roll_out(dataclasses.replace(scene, config=strict), once, Episodes(scenarios), 1.0)
    assert calls == [0]
    assert rollout.fell_at[0] == np.flatnonzero(course > limit)[0]
    assert (rollout.tilt[0, rollout.fell_at[0] :] == limit).all()


def test_the_standing_are_shown_their_own_world_when_others_have_fallen(
    config: Config, scene: Scene
) -> None:
    """World 2 of three sees, and does, what it sees and does alone; world 1 falls."""
    drawn = draw(config, "corner", 3, 4.0, 1)
    conditions = nominal(3)._replace(
        payload=np.asarray((0.0, 0.0, 2.0)), delay=np.asarray((0.0, 0.0, 1.0))
    )
    drawn = drawn._replace(targets=0.3 * drawn.targets)
    moves = np.random.default_rng(0).choice((STAND - 21, STAND - 1, STAND + 1, STAND + 21), 20)
    seen: dict[int, list[tuple[Any, ...]]] = {1: [], 3: []}

    def run(first: int) -> Rollout:
        count = 3 - first

        def act(view: View) -> np.ndarray:
            own = view.ids + first
            (row,) = np.flatnonzero(own == 2)
            seen[count].append((view.obs[row], view.imu[row], view.qpos[row], view.qvel[row]))
            assert (view.scenario.targets[row] == drawn.targets[2]).all()
            assert view.delayed[row]
            return np.choose(own, (STAND, LEFT_UP, moves[view.env_steps]))

        return roll_out(
            scene,
            act,
            Episodes(
                Scenario(*(x[first:] for x in drawn)),
                DomainParams(*(x[first:] for x in conditions)),
            ),
            4.0,
        )

    together, alone = run(0), run(2)
    assert together.fell.tolist() == [False, True, False]
    np.testing.assert_allclose(together.tilt[2], alone.tilt[0], atol=1e-9)
    for whole, single in zip(seen[3], seen[1], strict=True):
        for ours, own in zip(whole, single, strict=True):
            np.testing.assert_allclose(ours, own, atol=1e-7)


def made_up(config: Config, **values: Any) -> Rollout:
    """A rollout of two scenarios of 100 steps with tilts 0.00, 0.01, ..., 1.99, shuffled."""
    tilt = np.random.default_rng(0).permutation(200).reshape(2, 100) / 100
    rollout = Rollout(
        task=config.task,
        tilt=tilt,
        fell_at=np.asarray((100, 30)),
        action_mm=np.asarray([(0.3, 0.9), (0.6, np.nan)]),
        qpos=None,
        seconds=0.5,
    )
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
    assert tilt == {
        "mean": pytest.approx(0.995),
        "rms": pytest.approx(np.sqrt(199 * 399 / 6) / 100),
        "p50": pytest.approx(0.995),
        "p95": pytest.approx(1.8905),
        "p99": pytest.approx(1.9701),
        "max": pytest.approx(1.99),
    }
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


def grid(falls: list[list[float]]) -> Envelope:
    """Inclines 2, 6 and 20 deg by 3, 4 and 5 deg/s, of which 6 and 4 can still be met."""
    return Envelope(
        inclines=[2.0, 6.0, 20.0],
        rates=[3.0, 4.0, 5.0],
        fall_rate=falls,
        mean_tilt=falls,
        authority=4.0,
        reach=6.0,
        scenarios=1,
        duration_s=1.0,
        seed=0,
    )


def test_share_of_the_feasible_cells_without_a_fall() -> None:
    """Four cells can be met, bounds included; one of them has a rare fall."""
    assert grid([[0, 0, 1], [0, 0.01, 1], [1, 1, 1]]).fall_free_share == 0.75
    assert grid([[0, 0, 0], [1, 0.5, 0], [0, 0, 0]]).fall_free_share == 0.5
    assert grid([[0, 0, 1], [0, 0, 1], [1, 1, 1]]).fall_free_share == 1.0


def test_cells_of_the_envelope_are_inclines_by_speeds(
    config: Config, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A made-up world where a board falls beyond 8 deg or 5 deg/s, tilted by both."""
    asked = []

    def roll(scene: Scene, controller: Any, episodes: Episodes, *_: Any, **__: Any):
        drawn = episodes.scenario
        asked.append((scene.config, drawn))
        incline, rate = np.abs(drawn.targets[:, 0, 0]), drawn.rate
        fell = (incline > 8) | (rate > 5)
        # One of the two scenarios of a cell in the corner stands.
        fell[np.flatnonzero((incline == 12) & (rate == 6))[1]] = False
        tilt = np.tile((incline + rate / 100)[:, None], (1, 4))
        return Rollout(config.task, tilt, np.where(fell, 1, 4), np.zeros((len(fell), 1)), None, 1.0)

    monkeypatch.setattr(envelope_module, "roll_out", roll)
    found = envelope(scene, always(STAND), 2, 12.0, 3)
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
    assert used.task.target_period == 10.0
    assert (np.abs(drawn.targets) == np.abs(drawn.targets[:, :1, :1])).all(), "both axes at once"
    assert len(np.unique(np.sign(drawn.targets).reshape(-1, 2), axis=0)) == 4
    hasty = dataclasses.replace(config, task=dataclasses.replace(config.task, target_period=5.0))
    envelope(dataclasses.replace(scene, config=hasty), always(STAND), 2, 12.0, 3)
    assert asked[1][0].task.target_period == pytest.approx(9.6)
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


@pytest.mark.parametrize("duration", [0.0, -1.0, float("nan"), float("inf")])
def test_a_duration_that_is_no_time_is_refused(scene: Scene, duration: float) -> None:
    with pytest.raises(EvaluationError, match="duration is"):
        run_suite(scene, always(STAND), "paper", 1, duration, 0)


def watch_imu(scene: Scene, suite: str, count: int, seed: int) -> np.ndarray:
    """(decisions, 50, 6) samples of world 0, whose last neighbour falls at once if there is one."""
    seen = []

    def act(view: View) -> np.ndarray:
        seen.append(view.imu[0])
        return np.where(view.ids == 2, LEFT_UP, STAND)

    run_suite(scene, act, suite, count, 2.0, seed)
    return np.asarray(seen)


def test_suites_bring_their_circumstances(scene: Scene) -> None:
    """Noise differs from seed to seed, and the first decision sees none yet."""
    quiet, noisy, again = (watch_imu(scene, name, 1, 0) for name in ("paper", "noise", "noise"))
    np.testing.assert_array_equal(quiet[0], noisy[0])
    np.testing.assert_array_equal(noisy, again)
    jitter = (noisy - quiet)[1:]
    np.testing.assert_allclose(jitter.std(axis=(0, 1)), [0.002] * 3 + [0.023] * 3, rtol=0.2)
    still, shaken = (watch_imu(scene, name, 1, 1)[1:4] for name in ("paper", "noise"))
    assert abs(np.corrcoef((shaken - still).ravel(), jitter[:3].ravel())[0, 1]) < 0.2
    for suite, late in (("latency", True), ("paper", False), ("payload", False)):
        told = []

        def act(view: View, told: list[bool] = told) -> np.ndarray:
            told += view.delayed.tolist()
            return np.full(len(view.ids), STAND)

        run_suite(scene, act, suite, 3, 0.2, 0)
        assert told == [late] * 3


def test_noise_of_a_world_does_not_depend_on_its_neighbours(scene: Scene) -> None:
    """Scenario k is the same however many there are and whoever falls: its noise too."""
    alone = watch_imu(scene, "noise", 1, 0)
    np.testing.assert_allclose(watch_imu(scene, "noise", 3, 0), alone, atol=1e-9)


def test_noise_of_a_world_does_not_depend_on_who_fell_before_it(scene: Scene) -> None:
    """World 0 falls within 1.2 s or stands; world 1 sees the same samples for 2 s."""
    seen: dict[int, list[np.ndarray]] = {LEFT_UP: [], STAND: []}
    for action, samples in seen.items():

        def act(view: View, action: int = action, samples: Any = samples) -> np.ndarray:
            samples.append(view.imu[view.ids == 1][0])
            return np.where(view.ids == 0, action, STAND)

        fell = run_suite(scene, act, "noise", 2, 2.0, 0).fell
        np.testing.assert_array_equal(fell, (action == LEFT_UP, False))
    np.testing.assert_array_equal(seen[LEFT_UP], seen[STAND])


def test_standing_still_on_a_level_board_stays_level(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "paper", 2, 4.0, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    rollout = roll_out(scene, always(STAND), Episodes(level), 4.0)
    assert not rollout.fell.any()
    assert rollout.tilt.max() < 0.05
    assert np.all(rollout.action_mm == 0)


def test_without_control_the_body_follows_the_board(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "paper", 1, 4.0, 0)
    held = scenarios._replace(targets=np.tile((3.0, 4.0), (1, scenarios.targets.shape[1], 1)))
    rollout = roll_out(scene, always(STAND), Episodes(held), 4.0)
    assert not rollout.fell.any()
    assert rollout.tilt[0, -1] == pytest.approx(5.0, abs=0.3)


def test_raising_the_left_side_tilts_the_body_and_a_fall_counts_to_the_end(
    config: Config, scene: Scene
) -> None:
    scenarios = draw(config, "paper", 3, 8.0, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    rollout = roll_out(scene, always(LEFT_UP), Episodes(level), 8.0)
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
    rollout = roll_out(scene, always(STAND), Episodes(scenarios._replace(targets=targets)), 1.0)
    np.testing.assert_array_equal(rollout.fell, (False, True, False))
    assert np.isfinite(rollout.tilt).all()


def test_one_thread_gives_what_many_give(config: Config, scene: Scene) -> None:
    episodes = Episodes(draw(config, "corner", 5, 2.0, 0))
    one, two = (BatchEnv(scene, episodes, threads) for threads in (1, 2))
    for _ in range(5):
        one.step(np.full((5, 2), 0.001))
        two.step(np.full((5, 2), 0.001))
        np.testing.assert_array_equal(one.path, two.path)


@pytest.mark.parametrize(
    ("scenarios", "duration", "named"), [(0, 1.0, "scenarios is 0"), (1, 0.0, "duration is 0")]
)
def test_no_scenarios_and_no_time_are_refused(
    scene: Scene, scenarios: int, duration: float, named: str, policy_file: Path
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


def test_nominal_conditions_change_nothing(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "corner", 3, 2.0, 0)
    plain = roll_out(scene, always(LEFT_UP), Episodes(scenarios), 2.0)
    same = roll_out(scene, always(LEFT_UP), Episodes(scenarios, nominal(3)), 2.0)
    np.testing.assert_allclose(plain.tilt, same.tilt, atol=1e-6)


def test_a_payload_off_the_centre_bends_the_legs_under_it(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "paper", 2, 2.0, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    loaded = nominal(2)._replace(
        payload=np.asarray((0.0, 5.0)), payload_at=np.asarray(((0.0, 0, 0), (0.1, 0, 0.1)))
    )
    rollout = roll_out(scene, always(STAND), Episodes(level, loaded), 2.0, record=True)
    assert rollout.qpos is not None
    height = rollout.qpos[:, -1, scene.trunk_quat[0] - 1]
    assert rollout.tilt[0, -1] < 0.05 < rollout.tilt[1, -1]
    assert height[1] < height[0]


def test_weak_servos_sag(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "paper", 2, 2.0, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    weak = nominal(2)._replace(gain=np.asarray((1.0, 0.8)))
    rollout = roll_out(scene, always(STAND), Episodes(level, weak), 2.0, record=True)
    assert rollout.qpos is not None
    height = rollout.qpos[:, -1, scene.trunk_quat[0] - 1]
    assert height[1] < height[0] - 5e-4


def test_feet_slide_where_friction_is_low(config: Config, scene: Scene) -> None:
    """7 degrees hold with friction 0.4 and not with 0.05: the robot slides downhill."""
    held = draw(config, "paper", 2, 4.0, 0)
    held = held._replace(targets=np.tile((0.0, 4.5), (2, held.targets.shape[1], 1)))
    icy = nominal(2)._replace(friction=np.asarray((0.4, 0.05)))
    rollout = roll_out(scene, always(STAND), Episodes(held, icy), 4.0, record=True)
    assert rollout.qpos is not None
    x = np.abs(rollout.qpos[:, -1, scene.trunk_quat[0] - 3])
    assert x[0] < 0.05 < x[1]


def test_late_actions_arrive_one_decision_late(config: Config, scene: Scene) -> None:
    scenarios = draw(config, "paper", 2, 0.6, 0)
    level = scenarios._replace(targets=0 * scenarios.targets)
    late = nominal(2)._replace(delay=np.asarray((0.0, 1.0)))
    rollout = roll_out(scene, always(LEFT_UP), Episodes(level, late), 0.6)
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

    rngs = [np.random.default_rng((0, k, 1)) for k in range(40)]
    roll_out(scene, watch, Episodes(level, noisy, rngs=rngs), 1.0)
    imu = seen[-1].imu
    assert imu.shape == (40, 50, 6)
    np.testing.assert_allclose(imu[..., :3].std(), 0.002, rtol=0.05)
    np.testing.assert_allclose((imu - imu.mean(axis=(0, 1)))[..., 3:].std(), 0.023, rtol=0.05)
    newest = imu[:, -1, 3] / config.task.accel_scale
    np.testing.assert_allclose(seen[-1].obs[:, 16], newest, rtol=1e-6)


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


def test_a_policy_is_a_controller(scene: Scene, policy_file: Path) -> None:
    from mjx_balance import load_policy

    policy = load_policy(policy_file)
    rollout = run_suite(scene, observing(policy), "paper", 2, 1.0, 3)
    result = evaluate(policy, "paper", 2, 1.0, 3)
    assert result["tilt_deg"]["mean"] == rollout.tilt.mean()


def test_unknown_suite_is_refused(policy_file: Path) -> None:
    from mjx_balance import load_policy

    with pytest.raises(SuiteError, match="unknown suite 'moon'; known suites: paper, corner, noi"):
        evaluate(load_policy(policy_file), "moon", 1, 1.0, 0)
