"""`mjx-balance view`, and the session that it shows. No JAX."""

import contextlib
import dataclasses
import math

import mujoco
import numpy as np
import tyro

from mjx_balance.cli.browser import view_in_browser
from mjx_balance.cli.common import ControllerArgs, complain, suite_of
from mjx_balance.envs.batch import BatchEnv, Episodes
from mjx_balance.evaluation.controllers import Controller
from mjx_balance.evaluation.rollout import look, suite_scene
from mjx_balance.evaluation.suites import Suite, check_seed, draw_suite
from mjx_balance.robots.limits import greatest_incline
from mjx_balance.sim.scene import Scene
from mjx_balance.task import tilt
from mjx_balance.task.actions import action_table
from mjx_balance.task.pushes import Pushes

STEP = 1.0
"""Change of the board's target by one key press, deg."""
PUSH_SPEED = 0.4
"""Speed that a push gives our own robot, m/s; scaled by `push_scale` for others."""
RIGHT, LEFT, DOWN, UP, PUSH_KEY, LEVEL = 262, 263, 264, 265, 257, 268
"""GLFW codes of the arrow keys, Enter and Home."""
KEYS = "arrows: tilt the board\nHome: level\nEnter: push"


@dataclasses.dataclass(frozen=True)
class ViewArgs(ControllerArgs):
    """Watch a policy in MuJoCo's viewer; keys tilt the board and push the robot."""

    suite: str | None = None
    """Suite that moves the board and pushes the robot, or, not in a browser, module:NAME of your
    own; none: keys do."""
    seed: int = 0
    """Seed of the suite's scenarios, and of the direction of pushes by key."""
    browser: bool = False
    """Serve a page for a browser instead, at 127.0.0.1; this needs no display."""
    port: int = 0
    """Port of the page; 0: a free one."""


def view(argv: list[str]) -> int:
    args = tyro.cli(ViewArgs, args=argv, prog="mjx-balance view")
    if args.browser:
        return view_in_browser(args, args.suite, args.seed, args.port)
    from mjx_balance.render import drawing as render

    scene, controller = args.load()
    suite = args.suite and suite_of(args.suite)
    session = Session(scene, controller, suite, args.seed)
    try:
        window = render.Window(session.scene, session.press)
    except render.RenderError as error:
        return complain(
            f"{error}; `mjx-balance view --browser` and `evaluate --video` need no display"
        )
    above, below = mujoco.mjtGridPos.mjGRID_TOPLEFT, mujoco.mjtGridPos.mjGRID_BOTTOMLEFT
    keys = "Enter: push" if args.suite else KEYS
    with contextlib.closing(window):
        while window.is_open:
            window.write((above, *session.caption()), (below, keys, ""))
            window.play(session.step())
    return 0


class Session:
    """A robot on a board that keys or a suite tilt, decision by decision; restarts after a fall."""

    def __init__(
        self, scene: Scene, controller: Controller, suite: str | Suite | None = None, seed: int = 0
    ):
        """Stands the robot on the level board, which keys move if there is no suite.

        `seed` draws pushes by key and the first scenario of the suite; each later one adds 1.

        Raises:
          SuiteError: if the suite does not exist, or the seed is negative.
        """
        check_seed(seed)
        self.scene = scene = scene if suite is None else suite_scene(scene, suite)
        self.task, self.controller = scene.task, controller
        self.suite, self.seed = suite, seed
        self.max_incline = greatest_incline(self.task, scene.robot)
        self.rng = np.random.default_rng(seed)
        self.table = action_table(self.task)
        self.falls, self.rounds = 0, 0
        self._start()

    def _start(self) -> None:
        if self.suite is None:
            episodes = Episodes(self._keyed(np.zeros((2, 2)), 0))
        else:
            duration = self.task.episode_length * self.task.ctrl_dt
            seed = self.seed + self.rounds
            episodes = draw_suite(self.scene.task, self.scene.robot, self.suite, 1, duration, seed)
        self.suite_pushes = episodes.pushes or Pushes(np.zeros((1, 0, 2)), np.zeros((1, 0), int))
        self.env = BatchEnv(self.scene, episodes, threads=1)
        self.obs = self.env.initial_obs
        self.imu = np.repeat(self.env.state.memory.imu[:, -1:], self.task.sim_steps, axis=1)
        self.target, self.board = np.zeros(2), np.zeros(2)
        self.push, self.number, self.tilt = np.zeros(2), 0, 0.0

    def press(self, key: int) -> None:
        """Handles a key press, a GLFW code; the camera looks from behind the robot's right."""
        moves = {RIGHT: (1, 0), LEFT: (-1, 0), UP: (0, -1), DOWN: (0, 1)}
        if key in moves:
            target = self.target + STEP * np.asarray(moves[key])
            self.target = np.clip(target, -self.max_incline, self.max_incline)
        elif key == LEVEL:
            self.target = np.zeros(2)
        elif key == PUSH_KEY:
            angle = self.rng.uniform(0, 2 * math.pi)
            speed = PUSH_SPEED * self.scene.robot.push_scale
            self.push = speed * np.asarray((math.cos(angle), math.sin(angle)))

    def step(self) -> np.ndarray:
        """Runs one decision; returns its states (sim_steps, nq)."""
        env, now = self.env, self.number
        push, self.push = self.push, np.zeros(2)  # keys arrive from another thread
        velocity = np.append(self.suite_pushes.velocity, push[None, None], axis=1)
        due = np.append(self.suite_pushes.due, [[now]], axis=1)
        env.state = env.state._replace(pushes=Pushes(velocity, due))
        if self.suite is None:
            keyed = self._keyed(np.stack((self.board, self.target)), now)
            env.state = env.state._replace(scenario=keyed)
        action = self.controller(look(env, np.arange(1), now, self.obs, self.imu))
        outcome = env.step(action if action.ndim == 2 else self.table[action])
        self.obs, self.imu, self.number = outcome.obs, outcome.imu, now + 1
        time = np.asarray([[self.number * self.task.ctrl_dt]])
        self.board = tilt.board_angle(self.task, env.state.scenario, time)[0, 0]
        self.tilt = float(outcome.tilt[0, -1])
        over = self.suite is not None and self.number >= self.task.episode_length
        if outcome.terminated[0] or over:
            self.falls += bool(outcome.terminated[0])
            self.rounds += 1
            self._start()
        return env.path[0]

    def _keyed(self, way: np.ndarray, number: int) -> tilt.Scenario:
        """A board that turns from `way[0]` to `way[1]`, (2, 2) deg, from decision `number` on."""
        phase = self.task.target_period - number * self.task.ctrl_dt
        return tilt.Scenario(way[None], np.asarray([phase]), np.asarray([self.task.board_rate]))

    def caption(self) -> tuple[str, str]:
        """Names and values to show beside the robot, one per line."""
        roll, pitch = self.board
        values = f"{self.tilt:.2f} deg\n{roll:+.1f}, {pitch:+.1f} deg\n{self.falls}"
        return "body tilt\nboard\nfalls", values
