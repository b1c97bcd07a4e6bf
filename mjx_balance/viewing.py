"""A policy on a board that somebody tilts and kicks, decision by decision. No JAX, no window."""

import math

import numpy as np

from mjx_balance.config import greatest_incline
from mjx_balance.controllers import Controller, View
from mjx_balance.engines.mujoco import MujocoEngine
from mjx_balance.scene import Scene
from mjx_balance.suites import make_pushes, make_scenarios
from mjx_balance.task import decision, tilt
from mjx_balance.task.actions import action_table
from mjx_balance.task.pushes import kick

STEP = 1.0
"""By which a key turns where the board is to go, deg."""
KICK = 0.4
"""Of our own robot, m/s; another's goes with its size."""
RIGHT, LEFT, DOWN, UP, KICK_KEY, LEVEL = 262, 263, 264, 265, 257, 268
"""GLFW's codes of the arrow keys, Enter and Home."""
HELP = "arrows: tilt the board\nHome: level\nEnter: kick"


class Session:
    """One robot, one board; who falls is put back up."""

    def __init__(
        self, scene: Scene, controller: Controller, suite: str | None = None, seed: int = 0
    ):
        """Puts the robot on the level board.

        Args:
          scene: model, stance and task.
          controller: acts.
          suite: whose targets and kicks the board follows; none: the keys'.
          seed: of that scenario, and of the directions of kicks.

        Raises:
          SuiteError: if there is no such suite.
        """
        self.scene, self.task, self.controller = scene, scene.config.task, controller
        self.engine = MujocoEngine(scene, 1, threads=1)
        self.table = action_table(self.task)
        self.most = greatest_incline(self.task, scene.robot)
        self.rng = np.random.default_rng(seed)
        self.followed = None
        if suite is not None:
            long = self.task.episode_length * self.task.ctrl_dt
            drawn, _ = make_scenarios(scene.config, suite, 1, long, seed)
            self.followed = drawn, make_pushes(scene.config, suite, 1, long, seed)
        self.falls = 0
        self._start()

    def _start(self) -> None:
        still = self.scene.stance.imu[None]
        self.engine.start(np.arange(1))
        self.memory = decision.start(self.task, self.scene.robot, still)
        self.samples = np.tile(still[:, None], (1, self.task.sim_steps, 1))
        self.target, self.board = np.zeros(2), np.zeros(2)
        self.kicked, self.number, self.tilt = np.zeros(2), 0, 0.0
        angles = self.engine.state(np.arange(1))[0][:, self.scene.leg_qpos]
        self.obs = decision.observation(self.task, self.scene.robot, self.memory, angles)

    def press(self, key: int) -> None:
        """Takes a key, by GLFW's code: the camera looks along the robot from behind its right."""
        moves = {RIGHT: (1, 0), LEFT: (-1, 0), UP: (0, -1), DOWN: (0, 1)}
        if key in moves:
            wanted = self.target + STEP * np.asarray(moves[key])
            self.target = np.clip(wanted, -self.most, self.most)
        elif key == LEVEL:
            self.target = np.zeros(2)
        elif key == KICK_KEY:
            angle = self.rng.uniform(0, 2 * math.pi)
            speed = KICK * self.scene.robot.size_scale
            self.kicked = speed * np.asarray((math.cos(angle), math.sin(angle)))

    def decide(self) -> np.ndarray:
        """One decision; returns the states (sim_steps, nq) that it passes through."""
        task, robot, one = self.task, self.scene.robot, np.arange(1)
        scenario, now = self._scenario()
        qpos, qvel = self.engine.state(one)
        late = np.zeros(1, bool)
        view = View(one, self.number, self.obs, self.samples, qpos, qvel, scenario, late)
        change = self.table[self.controller(view)]
        memory, targets = decision.controls(task, robot, self.memory, change, None, scenario, now)
        self.engine.push(one, self.kicked[None])
        motion = self.engine.advance(one, self.scene.ctrl(targets))
        angles = motion.qpos[:, -1][:, self.scene.leg_qpos]
        self.memory, outcome = decision.outcome(
            task, robot, memory, motion.imu, motion.tilt, angles
        )
        self.board = np.degrees(targets.board[0, -1])
        self.samples, self.obs, self.kicked = motion.imu, outcome.obs, np.zeros(2)
        self.number, self.tilt = self.number + 1, float(outcome.tilt[0, -1])
        if outcome.fell[0] or motion.warned[0] or self._over():
            self.falls += bool(outcome.fell[0] or motion.warned[0])
            self._start()
        return motion.qpos[0]

    def _over(self) -> bool:
        return self.followed is not None and self.number >= self.task.episode_length

    def _scenario(self) -> tuple[tilt.Scenario, np.ndarray]:
        """Where the board goes in this decision, and when that is, in decisions."""
        if self.followed is not None:
            drawn, pushes = self.followed
            self.kicked = self.kicked + kick(pushes, self.number)[0]
            return drawn, np.asarray([float(self.number)])
        # Two targets, the first reached a moment ago: from here on to where it is to go.
        targets = np.stack((self.board, self.target))[None]
        phase = np.asarray([self.task.target_period])
        rate = np.asarray([self.task.board_rate])
        return tilt.Scenario(targets, phase, rate), np.zeros(1)

    def caption(self) -> tuple[str, str]:
        """What is shown beside the robot: names and values, a line each."""
        roll, pitch = self.board
        values = f"{self.tilt:.2f} deg\n{roll:+.1f}, {pitch:+.1f} deg\n{self.falls}"
        return "body tilt\nboard\nfalls", values
