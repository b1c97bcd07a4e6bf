"""Controllers: what one sees, and classical ones to compare a policy with. No JAX.

The baselines act through the policy's own action set: the grid, or with `task.action`
"continuous" any height change up to its greatest. `pd-imu` sees what the policy sees. The
others cheat, each with more knowledge, and bound what any controller can do with these
actions at this rate.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mjx_balance.config import ACTION_AXES
from mjx_balance.envs.batch import BatchEnv, Episodes
from mjx_balance.errors import InputError, quote, suggest
from mjx_balance.sim.scene import Scene
from mjx_balance.task import tilt
from mjx_balance.task.actions import to_command
from mjx_balance.task.attitude import gravity_angles, roll_pitch

HORIZON = 8  #: decisions that the predictive controllers look ahead
SWEEPS = 25  #: rounds of coordinate descent of the predictive controllers


class View(NamedTuple):
    """What n scenarios of an evaluation show before a decision; a policy looks at `obs` alone."""

    scene: Scene  #: in which the addresses in qpos and qvel hold
    ids: np.ndarray  #: (n,) numbers of these scenarios in the batch, for controllers with a memory
    env_steps: int  #: decisions since the start
    obs: np.ndarray  #: (n, obs_size) the network's input
    imu: np.ndarray  #: (n, sim_steps, 6) IMU samples of the last decision
    qpos: np.ndarray  #: (n, nq) true positions
    qvel: np.ndarray  #: (n, nv) true velocities
    scenario: tilt.Scenario  #: where the boards go
    delayed: np.ndarray  #: (n,) whether actions are taken one decision later


Controller = Callable[[View], np.ndarray]  #: action indices (n,), or a_x and a_y (n, 2), m


class ControllerError(InputError):
    """An unknown controller; the message lists the known ones."""


class Response(NamedTuple):
    """What one action does to the body, measured in the simulator once."""

    gain: np.ndarray  #: (2,) change of roll and pitch per height change a_x, a_y, deg/m, in the end
    course: np.ndarray  #: (2, HORIZON * sim_steps) share of it reached after each physics step


def measure_response(scene: Scene) -> Response:
    """Takes one action on each axis, on the level board, and watches the body."""
    task = scene.task
    change = task.action_max / 2 * np.eye(ACTION_AXES)
    axes, still = np.arange(ACTION_AXES), np.zeros(ACTION_AXES)
    level = tilt.Scenario(np.zeros((ACTION_AXES, 1, 2)), still, still + task.board_rate)
    env, angles = BatchEnv(scene, Episodes(level), threads=1), []
    for number in range(HORIZON):
        env.step(change if number == 0 else 0 * change)
        angles.append(np.stack(roll_pitch(env.path[..., scene.trunk_quat]))[axes, axes])
    course = np.concatenate(angles, axis=-1)
    end = course[:, -1]
    return Response(end / change.diagonal(), course / end[:, None])


def attitude(view: View) -> np.ndarray:
    """(n, 2) true roll and pitch of the body, deg."""
    return np.stack(roll_pitch(view.qpos[:, view.scene.trunk_quat]), axis=-1)


def stand(scene: Scene) -> Controller:
    """Never moves."""
    return lambda view: np.zeros((len(view.ids), ACTION_AXES))


class AttitudePD:
    """Proportional and derivative control on the true attitude and angular rate."""

    def __init__(self, scene: Scene, proportional: float = 1.3, rate: float = 0.12):
        """Takes the gains.

        Args:
          scene: task and addresses.
          proportional: share of the tilt undone by one decision (benchmarks/limits.py).
          rate: time for which the present rate is undone beforehand, s (same).
        """
        self.task = scene.task
        self.proportional, self.rate = proportional, rate
        self.gain = measure_response(scene).gain

    def __call__(self, view: View) -> np.ndarray:
        """Returns commands (n, 2), m."""
        angle, speed = self.state(view)
        change = -(self.proportional * angle + self.rate * speed) / self.gain
        return to_command(self.task, change)

    def state(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Roll and pitch (n, 2), deg, and their rates (n, 2), deg/s."""
        turn = view.scene.trunk_velocity + 3
        return attitude(view), np.degrees(view.qvel[:, turn])


class ImuPD(AttitudePD):
    """The same control on the attitude that a complementary filter reads off the IMU.

    The filter integrates the gyro and leans toward the accelerometer's tilt with a time
    constant (Mahony et al. 2008, https://hal.science/hal-00488376, section III, with
    fixed gain and no bias): angle += dt * gyro, then
    angle += dt / (tau + dt) * (tilt_accel - angle).
    """

    def __init__(
        self,
        scene: Scene,
        proportional: float = 1.2,
        rate: float = 0.14,
        tau: float = 4.0,
        samples: int = 1,
    ):
        """Takes the gains; `tau` in s, and the gyro samples averaged for the rate."""
        super().__init__(scene, proportional, rate)
        self.tau, self.samples = tau, samples
        self.angle = np.zeros((0, ACTION_AXES))

    def state(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Filters the last decision's samples; see `AttitudePD.state`."""
        gyro, by_gravity = view.imu[..., :2], gravity_angles(view.imu[..., 3:])
        if view.env_steps == 0:
            self.angle = np.zeros((view.ids.max() + 1, ACTION_AXES))
            self.angle[view.ids] = by_gravity[:, 0]
        dt = self.task.sim_dt
        leak = dt / (self.tau + dt)
        weight = (1 - leak) ** np.arange(view.imu.shape[1])[::-1, None]
        steps = dt * (1 - leak) * gyro + leak * by_gravity
        old = self.angle[view.ids] * (1 - leak) ** view.imu.shape[1]
        self.angle[view.ids] = old + (weight * steps).sum(axis=1)
        rate = gyro[:, -self.samples :].mean(axis=1)
        return np.degrees(self.angle[view.ids]), np.degrees(rate)


class Predictive:
    """Model predictive control on true attitude, response, latency and a forecast of the board.

    Minimises the squared tilt over all physics steps of the next `HORIZON` decisions.
    """

    def __init__(self, scene: Scene, forecast: Callable[..., np.ndarray]):
        """Prepares the quadratic programme.

        Args:
          scene: task and addresses.
          forecast: (task, scenario, now (n,), ahead (m,)) -> (n, m, 2) change of the
            board's angles, deg.
        """
        self.task, self.forecast = scene.task, forecast
        response, steps = measure_response(scene), self.task.sim_steps
        self.gain = response.gain
        # effect[axis, j, t]: deg at step t per deg of action j
        self.effect = np.zeros((ACTION_AXES, HORIZON, HORIZON * steps))
        for j in range(HORIZON):
            self.effect[:, j, j * steps :] = response.course[:, : (HORIZON - j) * steps]
        self.gram = np.einsum("xjt,xkt->xjk", self.effect, self.effect)
        tail = np.ones_like(response.course)
        tail[:, :-steps] = response.course[:, steps:]
        self.unfinished = tail - response.course[:, steps - 1 : steps]
        self.chosen = np.zeros((2, 0, ACTION_AXES))

    def __call__(self, view: View) -> np.ndarray:
        """Returns commands (n, 2), m."""
        task, n = self.task, len(view.ids)
        if view.env_steps == 0:
            self.chosen = np.zeros((2, view.ids.max() + 1, ACTION_AXES))
        older, newer = self.chosen[:, view.ids]
        delayed = view.delayed[:, None]
        ahead = task.sim_dt * np.arange(1, HORIZON * task.sim_steps + 1)
        now = np.full(n, view.env_steps * task.ctrl_dt)
        x, y = np.moveaxis(self.forecast(task, view.scenario, now, ahead), -1, 0)
        w, i, j, k = view.qpos[:, view.scene.trunk_quat].T
        yaw = np.arctan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))[:, None]
        cos, sin = np.cos(yaw), np.sin(yaw)
        board = np.stack((cos * x + sin * y, cos * y - sin * x), axis=-1)  # in the body's frame
        free = attitude(view)[:, None] + board
        free = free + np.where(delayed, older, newer)[:, None] * self.unfinished.T
        linear = np.einsum("xjt,ntx->nxj", self.effect, free)
        limit = np.abs(self.gain) * task.action_max
        plan = np.zeros((n, ACTION_AXES, HORIZON))
        plan[..., 0] = np.where(delayed, newer, 0)
        for _ in range(SWEEPS):
            for j in range(HORIZON):
                slope = linear[..., j] + np.einsum("nxk,xk->nx", plan, self.gram[:, j])
                moved = plan[..., j] - slope / self.gram[:, j, j]
                fixed = delayed & (j == 0)
                plan[..., j] = np.where(fixed, plan[..., j], np.clip(moved, -limit, limit))
        choice = np.where(delayed, plan[..., 1], plan[..., 0])
        self.chosen[:, view.ids] = newer, choice
        return to_command(task, choice / self.gain)


def at_this_rate(task, scenario: tilt.Scenario, now: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Forecast of a controller that knows the board's true rate, and no more."""
    before = np.maximum(now[:, None] + np.asarray((-task.sim_dt, 0.0)), 0)
    angle = tilt.board_angle(task, scenario, before)
    rate = (angle[:, 1] - angle[:, 0]) / task.sim_dt
    return rate[:, None] * ahead[:, None]


def as_it_will_be(task, scenario: tilt.Scenario, now: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Forecast of a controller that knows where the board will go."""
    angle = tilt.board_angle(task, scenario, now[:, None] + np.append(0.0, ahead))
    return angle[:, 1:] - angle[:, :1]


CONTROLLERS: dict[str, Callable[[Scene], Controller]] = {
    "none": stand,
    "pd-imu": ImuPD,
    "pd-attitude": AttitudePD,
    "rate-oracle": lambda scene: Predictive(scene, at_this_rate),
    "clairvoyant": lambda scene: Predictive(scene, as_it_will_be),
}
"""By the names of `mjx-balance evaluate --controller`."""


def make_controller(name: str, scene: Scene) -> Controller:
    """Builds the controller called `name`; raises `ControllerError` with the known names."""
    if name not in CONTROLLERS:
        raise ControllerError(
            f"unknown controller {quote(name)}; {suggest('controller', name, CONTROLLERS)}"
        )
    return CONTROLLERS[name](scene)
