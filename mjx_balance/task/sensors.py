"""Sensors and commands as they are on a robot: biased, turned, old, lost; encoders that are off.

`sense` turns what an engine measures into the samples that the robot gets; failure and reward go by
the truth. What is random is drawn outside of `task.step`, by `draw_decision`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mjx_balance.config import RandomizationConfig, TaskConfig
from mjx_balance.robots.catalogue import Robot
from mjx_balance.task import Array
from mjx_balance.task.randomization import DomainParams

IMU, COMMAND = 0, 1  #: entries of `SensorErrors.delay`


class SensorErrors(NamedTuple):
    """What is wrong with the sensors and commands of one env, or of a batch of them."""

    bias: Float[Array, "*batch 6"]  #: at the start, rad/s and m/s^2
    scale: Float[Array, "*batch 6"]  #: relative
    mounting: Float[Array, "*batch 3"]  #: turn of the IMU from the trunk, as a vector, rad
    encoders: Float[Array, "*batch legs 3"]  #: what the servos measure, less true angles, rad
    readings: Float[Array, "*batch legs 3"]  #: what the robot reads, less what they measure, rad
    delay: Float[Array, "*batch 2"]  #: least age of samples and of commands, s
    drift: Float[Array, "*batch 6"]  #: standard deviation that the bias gains, per sqrt(s)
    jitter: Float[Array, "*batch 2"]  #: greatest further age in a decision, s
    dropout: Float[Array, "*batch"]  #: share of samples lost


class SensorMemory(NamedTuple):
    """What the sensors of one decision leave to the next."""

    drift: Float[Array, "*batch 6"]  #: of the bias since the start, rad/s and m/s^2
    trail: Float[Array, "*batch sim_steps 6"]  #: samples of the last decision, none old or lost


class Draws(NamedTuple):
    """Random numbers of one decision."""

    noise: Float[Array, "*batch sim_steps 6"]  #: standard normal
    drift: Float[Array, "*batch 6"] | None = None  #: standard normal; None without `SensorErrors`
    lost: Float[Array, "*batch sim_steps"] | None = None  #: in [0, 1)
    jitter: Float[Array, "*batch 2"] | None = None  #: in [0, 1)


def count_draws(robot: Robot) -> int:
    """Uniform random numbers that the errors of one env take."""
    return sum(len(values) for values in _symmetric(RandomizationConfig(), robot).values()) + 3


def draw_errors(
    ranges: RandomizationConfig, robot: Robot, uniform: Float[Array, "*batch draws"]
) -> SensorErrors:
    """Turns `count_draws` random numbers in [0, 1) into errors."""
    xp, parts, done = uniform.__array_namespace__(), {}, 0
    wrong = (uniform[..., -1:] >= ranges.ideal_share).astype(uniform.dtype)

    def every(*values: float) -> Array:
        return np.asarray(values, uniform.dtype) * wrong

    for name, most in _symmetric(ranges, robot).items():
        draws = uniform[..., done : done + len(most)]
        parts[name], done = every(*most) * (2 * draws - 1), done + len(most)
    for name in ("encoders", "readings"):
        parts[name] = xp.reshape(parts[name], (*parts[name].shape[:-1], len(robot.legs), 3))
    delay = every(ranges.sensor_delay, ranges.command_delay) * uniform[..., done : done + 2]
    return SensorErrors(
        **parts,
        delay=delay,
        drift=every(*[ranges.gyro_bias_drift] * 3, *[ranges.accel_bias_drift] * 3),
        jitter=every(ranges.sensor_jitter, ranges.command_jitter),
        dropout=every(ranges.dropout)[..., 0],
    )


def _symmetric(ranges: RandomizationConfig, robot: Robot) -> dict[str, list[float]]:
    """Greatest size of every number of the errors that are as often above 0 as below."""
    return {
        "bias": [ranges.gyro_bias] * 3 + [ranges.accel_bias] * 3,
        "scale": [ranges.imu_scale] * 6,
        "mounting": [ranges.imu_tilt] * 3,
        "encoders": [ranges.encoder_offset] * 3 * len(robot.legs),
        "readings": [ranges.reading_offset] * 3 * len(robot.legs),
    }


def draw_decision(
    task: TaskConfig,
    errors: SensorErrors | None,
    normal: Callable[[tuple[int, ...]], Array],
    uniform: Callable[[tuple[int, ...]], Array],
) -> Draws:
    """Draws one decision's numbers by functions of a shape, of standard normal and uniform ones.

    Noise comes first, and without errors it alone.
    """
    noise = normal((task.sim_steps, 6))
    if errors is None:
        return Draws(noise)
    rest = uniform((task.sim_steps + 2,))
    return Draws(noise, normal((6,)), rest[..., 2:], rest[..., :2])


def start_sensors(
    task: TaskConfig, errors: SensorErrors, still: Float[Array, "*batch 6"]
) -> tuple[SensorMemory, Float[Array, "*batch 6"]]:
    """Memory and sample, without noise, of a robot that stands still; `still` is the true one."""
    xp = still.__array_namespace__()
    sample = _measured(errors, still[..., None, :], errors.bias)
    trail = xp.repeat(sample, task.sim_steps, axis=-2)
    return SensorMemory(0 * sample[..., 0, :], trail), sample[..., 0, :]


def sense(
    task: TaskConfig,
    params: DomainParams,
    errors: SensorErrors | None,
    memory: SensorMemory | None,
    last: Float[Array, "*batch 6"],
    imu: Float[Array, "*batch sim_steps 6"],
    draws: Draws,
) -> tuple[SensorMemory | None, Float[Array, "*batch sim_steps 6"]]:
    """What the robot gets of a decision's IMU samples.

    Args:
      task: of the physics.
      params: size of the noise.
      errors: None: noise alone.
      memory: of the last decision; None without errors.
      last: sample that the robot got last, rad/s and m/s^2.
      imu: true samples.
      draws: of this decision.
    """
    noise = params.imu_noise[..., None, :] * draws.noise
    if errors is None or memory is None:
        return memory, imu + noise
    xp, count = imu.__array_namespace__(), task.sim_steps
    measured = _measured(errors, imu, errors.bias + memory.drift) + noise
    stream = xp.concatenate((memory.trail, measured), axis=-2)
    number = np.arange(count, dtype=np.int32)
    age = late_steps(task, errors, draws, IMU).astype(np.int32)
    samples = _take(stream, count + number - age[..., None])
    new = xp.where(draws.lost < errors.dropout[..., None], 0, number + 1)
    samples = _take(
        xp.concatenate((last[..., None, :], samples), axis=-2), xp.maximum.accumulate(new, axis=-1)
    )
    grown = memory.drift + errors.drift * np.sqrt(task.ctrl_dt).astype(imu.dtype) * draws.drift
    # A diverged env gives no numbers: it has fallen, and is reset.
    trail = xp.where(abs(measured) < np.inf, measured, 0.0)
    return SensorMemory(grown, trail), samples


def late_steps(
    task: TaskConfig, errors: SensorErrors, draws: Draws, which: int
) -> Float[Array, "*batch"]:
    """Physics steps by which samples (`IMU`) or commands (`COMMAND`) come later, whole numbers."""
    delay = (errors.delay + errors.jitter * draws.jitter)[..., which]
    return delay.__array_namespace__().round(delay / task.sim_dt)


def joint_readings(
    errors: SensorErrors, angles: Float[Array, "*batch legs 3"]
) -> Float[Array, "*batch legs 3"]:
    """What the robot reads of true joint angles, rad."""
    return angles + errors.encoders + errors.readings


def servo_targets(
    errors: SensorErrors,
    env_steps: Int[Array, "*batch"],
    joints: Float[Array, "*batch sim_steps legs 3"],
) -> Float[Array, "*batch sim_steps legs 3"]:
    """True joint angles at which the encoders read `joints`, rad.

    The servos go by the encoders. A robot starts where it stands, and gets there within its first
    decision.
    """
    xp, count = joints.__array_namespace__(), joints.shape[-3]
    began = (np.arange(1, count + 1) / count).astype(joints.dtype)
    share = xp.where(env_steps[..., None] == 0, began, 1.0)
    return joints - share[..., None, None] * errors.encoders[..., None, :, :]


def _measured(
    errors: SensorErrors, imu: Float[Array, "*batch samples 6"], bias: Float[Array, "*batch 6"]
) -> Float[Array, "*batch samples 6"]:
    """What the IMU measures, without noise."""
    xp, turn = imu.__array_namespace__(), -errors.mounting[..., None, :]
    angle = xp.sqrt((turn**2).sum(axis=-1, keepdims=True))

    def turned(x: Array) -> Array:  # Rodrigues' formula
        once = xp.cross(turn, x)
        half = xp.sinc(angle / (2 * np.pi))
        return x + xp.sinc(angle / np.pi) * once + half**2 / 2 * xp.cross(turn, once)

    true = xp.concatenate((turned(imu[..., :3]), turned(imu[..., 3:])), axis=-1)
    return true * (1 + errors.scale[..., None, :]) + bias[..., None, :]


def _take(
    samples: Float[Array, "*batch samples 6"], index: Int[Array, "*batch chosen"]
) -> Float[Array, "*batch chosen 6"]:
    xp = samples.__array_namespace__()
    return xp.take_along_axis(samples, index[..., None], axis=-2)
