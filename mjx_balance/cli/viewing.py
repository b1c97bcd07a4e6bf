"""A policy on a board that somebody tilts and kicks, decision by decision. No JAX, no window."""

import math

import numpy as np

from mjx_balance.evaluation.controllers import Controller
from mjx_balance.evaluation.rollout import Trials, suite_trials
from mjx_balance.evaluation.suites import check_seed
from mjx_balance.robots.limits import greatest_incline
from mjx_balance.sim.scene import Scene
from mjx_balance.task import tilt
from mjx_balance.task.pushes import Pushes

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
          suite: whose targets, kicks and circumstances these are; none: the keys'.
          seed: of its first scenario, the next ones taking those that follow, and of the directions
            of kicks.

        Raises:
          SuiteError: if there is no such suite, or the seed is negative.
        """
        check_seed(seed)
        self.scene, self.task, self.controller = scene, scene.config.task, controller
        self.suite, self.seed = suite, seed
        self.most = greatest_incline(self.task, scene.robot)
        self.rng = np.random.default_rng(seed)
        self.falls, self.rounds = 0, 0
        self._start()

    def _start(self) -> None:
        if self.suite is None:
            self.trials = Trials(self.scene, self._keyed(np.zeros((2, 2)), 0), threads=1)
        else:
            long = self.task.episode_length * self.task.ctrl_dt
            seed = self.seed + self.rounds
            self.trials = suite_trials(self.scene, self.suite, 1, long, seed, threads=1)
        self.pushes = self.trials.pushes or Pushes(np.zeros((1, 0, 2)), np.zeros(0, int))
        self.target, self.board = np.zeros(2), np.zeros(2)
        self.kicked, self.number, self.tilt = np.zeros(2), 0, 0.0

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
        if self.suite is None:
            way = np.stack((self.board, self.target))
            self.trials.scenarios = self._keyed(way, self.number)
        kicked, self.kicked = self.kicked, np.zeros(2)  # before another key may come
        self.trials.pushes = Pushes(
            np.concatenate((self.pushes.kicks, kicked[None, None]), axis=1),
            np.append(self.pushes.at, self.number),
        )
        made = self.trials.decide(self.controller, self.number)
        self.number += 1
        now = np.asarray([[self.number * self.task.ctrl_dt]])
        self.board = tilt.board_angle(self.task, self.trials.scenarios, now)[0, 0]
        self.tilt = float(made.motion.tilt[0, -1])
        over = self.suite is not None and self.number >= self.task.episode_length
        if made.down[0] or over:
            self.falls += bool(made.down[0])
            self.rounds += 1
            self._start()
        return made.motion.qpos[0]

    def _keyed(self, way: np.ndarray, number: int) -> tilt.Scenario:
        """A board that turns from `way[0]` to `way[1]` (2, 2), deg, from decision `number` on."""
        phase = self.task.target_period - number * self.task.ctrl_dt
        return tilt.Scenario(way[None], np.asarray([phase]), np.asarray([self.task.board_rate]))

    def caption(self) -> tuple[str, str]:
        """What is shown beside the robot: names and values, a line each."""
        roll, pitch = self.board
        values = f"{self.tilt:.2f} deg\n{roll:+.1f}, {pitch:+.1f} deg\n{self.falls}"
        return "body tilt\nboard\nfalls", values
