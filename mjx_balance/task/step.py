"""The one composition of a decision, from action to outcome; every env and evaluation calls it.

`step` is `pre_step` (action -> servo targets), an engine (targets -> motion) and `post_step`
(motion -> observation, reward, failure). Training calls it in JAX for one env, vmapped; evaluation
and Gymnasium's envs in NumPy for many envs at once. Random numbers are drawn outside, because
JAX and NumPy draw differently.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_balance.config import TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.robots.limits import delay_steps
from mjx_balance.task import Array, kinematics, tilt
from mjx_balance.task.actions import apply_action
from mjx_balance.task.events import Event, params_now
from mjx_balance.task.means import Means, start_means, update_means
from mjx_balance.task.observation import (
    Signals,
    extend_history,
    input_rows,
    lookback,
    mean_rows,
    observe,
)
from mjx_balance.task.pushes import Pushes, push_velocity
from mjx_balance.task.randomization import DomainParams
from mjx_balance.task.reward import RewardInputs, failed, reward_terms
from mjx_balance.task.sensors import (
    COMMAND,
    Draws,
    SensorErrors,
    SensorMemory,
    joint_readings,
    late_steps,
    sense,
    servo_targets,
    start_sensors,
)

DIVERGED = 1e4  #: magnitude, in rad, rad/s, m/s^2 or deg, from which a value counts as diverged


class Memory(NamedTuple):
    """What one decision passes to the next, besides the state of the physics."""

    heights: Float[Array, "*batch legs"]  #: foot heights that the legs moved to last, m
    commanded: Float[Array, "*batch decisions legs"]
    """Foot heights that the latest actions commanded, the newest last, m; delayed actions stand
    here before the legs move."""
    imu: Float[Array, "*batch samples 6"]  #: latest IMU samples, the newest last, rad/s and m/s^2
    tilt: Float[Array, "*batch"]  #: body tilt of the last reward, deg
    means: Means | None = None  #: None: no row of the observation has a time constant
    sensors: SensorMemory | None = None  #: None: without `EnvState.errors`


class Targets(NamedTuple):
    """Servo targets at every physics step of a decision."""

    board: Float[Array, "*batch sim_steps axes"]
    """Board angles about X and Y, rad; with a platform, also surge, sway and heave, m."""
    joints: Float[Array, "*batch sim_steps legs 3"]  #: abduction, hip and knee angles, rad


class Motion(NamedTuple):
    """What an engine measures at every physics step of a decision; NaN where it has diverged."""

    imu: Float[Array, "*batch sim_steps 6"]  #: rad/s and m/s^2, before each step
    tilt: Float[Array, "*batch sim_steps"]  #: body tilt after each step, deg
    joint_angles: Float[Array, "*batch sim_steps legs 3"]  #: after each step, rad


@runtime_checkable
class Engine(Protocol):
    """Moves the physics by one decision. `physics` is the engine's own: a state, or env ids."""

    def push(self, physics: Any, velocity: Float[Array, "*batch 2"]) -> Any:
        """Adds to the trunk's velocity along the world's x and y, m/s."""
        ...

    def advance(
        self, physics: Any, targets: Targets, params: DomainParams | None
    ) -> tuple[Any, Motion]:
        """Moves the physics by `sim_steps` steps; `params` None is the nominal model."""
        ...


class EnvState(NamedTuple):
    """State of one env, or of a batch of them."""

    physics: Any  #: the engine's own
    memory: Memory
    scenario: tilt.Scenario  #: where the board goes
    env_steps: Int[Array, "*batch"]  #: decisions since the episode's start
    params: DomainParams | None  #: None: the nominal model, no sensor noise, no action delay
    pushes: Pushes | None
    errors: SensorErrors | None = None  #: None: sensors and commands are right, but for `params`
    event: Event | None = None  #: None: `params` stay


class Outcome(NamedTuple):
    """The result of a decision."""

    obs: Float[Array, "*batch obs_size"]  #: the network's next input
    rewards: dict[str, Float[Array, "*batch"]]  #: by name (`reward_terms`); their sum is the reward
    imu: Float[Array, "*batch sim_steps 6"]  #: IMU samples that the robot got, rad/s and m/s^2
    tilt: Float[Array, "*batch sim_steps"]  #: body tilt after each step, deg
    terminated: Bool[Array, "*batch"]  #: the body fell, or the simulation diverged
    diverged: Bool[Array, "*batch"]  #: whether the simulation gave values that no robot can reach

    @property
    def reward(self) -> Float[Array, "*batch"]:
        """Sum of the terms."""
        return sum(self.rewards.values())


def step(
    task: TaskConfig,
    robot: Robot,
    engine: Engine,
    state: EnvState,
    change: Float[Array, "*batch 2"],
    draws: Draws | None,
) -> tuple[EnvState, Outcome]:
    """Takes one decision, in one env or in a batch; returns the state after it, and the outcome.

    `change` is a_x and a_y of the action, m; `draws` are the decision's random numbers, None if
    nothing is wrong with the sensors.
    """
    memory, targets = pre_step(task, robot, state, change, draws)
    physics, params, errors = state.physics, state.params, state.errors
    if errors is not None:
        joints = servo_targets(errors, state.env_steps, targets.joints)
        targets = targets._replace(joints=joints)
    if state.event is not None and params is not None:
        params = params_now(state.event, params, state.env_steps)
    if state.pushes is not None:
        physics = engine.push(physics, push_velocity(state.pushes, state.env_steps))
    physics, motion = engine.advance(physics, targets, params)
    if errors is not None:
        angles = joint_readings(errors, motion.joint_angles[..., -1, :, :])
        motion = motion._replace(joint_angles=angles[..., None, :, :])
    if draws is not None and params is not None:
        last = memory.imu[..., -1, :]
        sensors, imu = sense(task, params, errors, memory.sensors, last, motion.imu, draws)
        memory, motion = memory._replace(sensors=sensors), motion._replace(imu=imu)
    memory, outcome = post_step(task, robot, memory, motion)
    state = state._replace(physics=physics, memory=memory, env_steps=state.env_steps + 1)
    return state, outcome


def initial_memory(
    task: TaskConfig,
    robot: Robot,
    still: Float[Array, "*batch 6"],
    tilt: Float[Array, "*batch"] | None = None,
    errors: SensorErrors | None = None,
) -> Memory:
    """The memory of a robot that has been standing for a while.

    Args:
      task: the observation.
      robot: the same.
      still: true IMU samples, rad/s and m/s^2.
      tilt: of the body, deg; None: level.
      errors: of the sensors; None: no errors.
    """
    xp, rows, sensors = still.__array_namespace__(), input_rows(task, robot), None
    if errors is not None:
        sensors, still = start_sensors(task, errors, still)
    heights = xp.full((*still.shape[:-1], len(robot.legs)), task.body_height, still.dtype)
    means = mean_rows(rows)
    return Memory(
        heights=heights,
        commanded=xp.repeat(heights[..., None, :], lookback(rows, "commands"), axis=-2),
        imu=xp.repeat(still[..., None, :], lookback(rows, "imu"), axis=-2),
        tilt=xp.zeros_like(still[..., 0]) if tilt is None else tilt,
        means=start_means(means, task.sim_dt, still) if means else None,
        sensors=sensors,
    )


def pre_step(
    task: TaskConfig,
    robot: Robot,
    state: EnvState,
    change: Float[Array, "*batch 2"],
    draws: Draws | None = None,
) -> tuple[Memory, Targets]:
    """Turns an action, a_x and a_y in m, into servo targets and the memory with the new command.

    Targets of step i are for time (i + 1) * sim_dt of the decision. An action delay
    delays the targets by one decision, a command delay by its time within the decision.
    `state.physics` does not matter.
    """
    memory, xp = state.memory, state.memory.heights.__array_namespace__()
    last = memory.commanded[..., -1, :]
    command = heights = apply_action(robot, last, change)
    if state.params is not None:
        heights = xp.where(state.params.delay[..., None] > 0, last, command)
    sim_step = np.arange(1, task.sim_steps + 1).astype(heights.dtype)
    time = task.ctrl_dt * state.env_steps[..., None] + task.sim_dt * sim_step
    board = tilt.board_angle(task, state.scenario, time) * (np.pi / 180)
    if task.platform:
        position = tilt.platform_position(task, state.scenario, time)
        board = xp.concatenate((board, position), axis=-1)
    delay = np.asarray(delay_steps(task, robot), float)
    arrival = int(delay) + task.ramp_steps
    if state.errors is not None and draws is not None:
        delay = delay + late_steps(task, state.errors, draws, COMMAND)
        arrival = task.sim_steps
    path = kinematics.ramp(task, memory.heights, heights, delay)
    moving = kinematics.joint_angles(robot, path[..., :arrival, :])
    resting = xp.repeat(moving[..., -1:, :, :], task.sim_steps - arrival, axis=-3)
    commanded = extend_history(memory.commanded, command[..., None, :])
    memory = memory._replace(heights=heights, commanded=commanded)
    return memory, Targets(board, xp.concatenate((moving, resting), axis=-3))


def post_step(
    task: TaskConfig, robot: Robot, memory: Memory, motion: Motion
) -> tuple[Memory, Outcome]:
    """Turns the motion of a decision into observation, reward and failure.

    An env whose simulation diverged counts as fallen: its tilt is `fail_tilt` throughout the
    decision, the IMU keeps its last sample, and the legs count as at their targets.

    `memory` is that of `pre_step`; `motion` has what the sensors give. Returns the memory for the
    next decision, and the outcome.
    """
    samples, tilts, angles = motion.imu, motion.tilt, motion.joint_angles[..., -1, :, :]
    xp = samples.__array_namespace__()
    diverged = _diverged(samples, 2) | _diverged(tilts, 1) | _diverged(angles, 2)
    at_targets = kinematics.joint_angles(robot, memory.heights)
    samples = xp.where(diverged[..., None, None], memory.imu[..., -1:, :], samples)
    tilts = xp.where(diverged[..., None], task.fail_tilt, tilts)
    angles = xp.where(diverged[..., None, None], at_targets, angles)
    terminated = diverged | failed(task, tilts).any(axis=-1)
    after = tilts.mean(axis=-1) if task.reward_tilt == "mean" else tilts[..., -1]
    inputs = RewardInputs(memory.tilt, after, terminated.astype(after.dtype))
    rewards = reward_terms(task, inputs)
    means = memory.means
    if means is not None:
        means = update_means(mean_rows(input_rows(task, robot)), task.sim_dt, means, samples)
    imu = extend_history(memory.imu, samples)
    memory = memory._replace(imu=imu, tilt=after, means=means)
    obs = observation(task, robot, memory, angles)
    return memory, Outcome(obs, rewards, samples, tilts, terminated, diverged)


def _diverged(values: Float[Array, "..."], axes: int) -> Bool[Array, "..."]:
    """Whether any value over the last `axes` axes is NaN or `DIVERGED` or more."""
    bad = ~(abs(values) < DIVERGED)
    return bad.reshape(*values.shape[:-axes], -1).any(axis=-1)


def observation(
    task: TaskConfig, robot: Robot, memory: Memory, angles: Float[Array, "*batch legs 3"]
) -> Float[Array, "*batch obs_size"]:
    """The network's input, for measured joint angles, rad."""
    heights = kinematics.foot_heights(robot, angles)
    means = memory.means
    if means is not None:
        means = means[..., :1, :] / means[..., 1:, :]
    signals = Signals(heights[..., None, :], memory.commanded, memory.imu, means)
    return observe(input_rows(task, robot), signals)
