"""Config and robot together: adapts a config to a robot, and checks it against the robot."""

import dataclasses
import math

from mjx_balance.config import Config, ConfigError, RandomizationConfig, TaskConfig
from mjx_balance.robots.catalogue import find_robot, use_robot
from mjx_balance.robots.robot import Body, Robot
from mjx_balance.robots.schema import RobotFile


def for_robot(config: Config, robot: str | RobotFile) -> Config:
    """Adapts a config of our own robot to another robot.

    Standing height and greatest height change become the robot's (`robots.measure`). Payloads scale
    with its mass; offsets and the scale of foot heights with its size; pushes with the speed at
    which it tips over. Angles, board rate and fall limit stay. A `RobotFile` made in Python becomes
    known by its name, in this process (`catalogue.use_robot`).

    Raises:
      ConfigError: if there is no such robot.
    """
    if isinstance(robot, RobotFile):
        robot = use_robot(robot)
    own = find_robot(robot)
    task = dataclasses.replace(
        config.task,
        body_height=own.body_height,
        action_max=own.action_max,
        height_scale=config.task.height_scale * own.size_scale,
    )
    ranges = scale_ranges(config.randomization, own)
    return dataclasses.replace(config, robot=robot, task=task, randomization=ranges)


def scale_ranges(ranges: RandomizationConfig, robot: Robot) -> RandomizationConfig:
    """Scales payloads with the robot's mass, their offsets with its size, pushes as it tips."""
    scales = dict.fromkeys(("payload", "event_payload"), robot.mass_scale)
    scales |= dict.fromkeys(("payload_offset", "payload_height"), robot.size_scale)
    scales |= dict.fromkeys(("push_min", "push_max"), robot.push_scale)
    scaled = {name: getattr(ranges, name) * scale for name, scale in scales.items()}
    return dataclasses.replace(ranges, **scaled)


def greatest_incline(task: TaskConfig, robot: Robot) -> float:
    """Greatest board angle, on both axes at once, that the legs can compensate, deg."""
    lowest, highest = robot.height_range
    room = min(highest - task.body_height, task.body_height - lowest)
    return math.degrees(math.atan(room / (robot.half_length + robot.half_track)))


def authority(task: TaskConfig, robot: Robot) -> float:
    """Greatest board rate that the actions can follow on both axes, by the robot's lever, deg/s."""
    return math.degrees(task.action_max / task.ctrl_dt / robot.lever)


def delay_steps(task: TaskConfig, robot: Robot) -> int:
    """Physics steps until the robot's servos obey a command."""
    return round(robot.command_delay / task.sim_dt)


def check_delays(task: TaskConfig, ranges: RandomizationConfig, robot: Robot) -> None:
    """Checks that the delays of samples and commands end within their decision.

    Raises:
      ConfigError: names the greatest delay, its jitter and a bound.
    """
    legs = (task.sim_steps - task.ramp_steps) * task.sim_dt - robot.command_delay
    for kind, most, end in (
        ("sensor", task.ctrl_dt, "a sample may be a decision old, ctrl_dt"),
        ("command", legs, "the legs must arrive before the next decision"),
    ):
        delay, jitter = getattr(ranges, f"{kind}_delay"), getattr(ranges, f"{kind}_jitter")
        if delay + jitter > most + 1e-9:
            raise ConfigError(
                f"{kind}_delay is {delay} s and {kind}_jitter {jitter} s, together "
                f"{delay + jitter:g}; {end}: together they must be at most {max(most, 0):g}"
            )


def check_body(body: Body) -> None:
    """Checks a body read from a policy file.

    Raises:
      ConfigError: names the leg and its field.
    """
    for leg in body.legs:
        low, high = leg.knee
        if any(abs(sign) != 1 for sign in leg.signs):
            raise ConfigError(f"signs of leg {leg.name} is {leg.signs}; each must be 1 or -1")
        if not (low <= high and low * high > 0):
            raise ConfigError(
                f"knee of leg {leg.name} is {leg.knee}; it must be the least and greatest turn to "
                "one side, both above 0 or both below"
            )
    if len({(leg.left, leg.front) for leg in body.legs}) < len(body.legs) or not body.lever > 0:
        raise ConfigError("legs of the robot stand at one place; each corner must have one")


def check_robot(config: Config, robot: Robot) -> Config:
    """Returns `config` if the robot can do what it demands; `config.check` comes before.

    Raises:
      ConfigError: names the field, its value and the robot.
    """
    task, ranges = config.task, config.randomization
    lowest, highest = robot.height_range
    limit = greatest_incline(task, robot)
    if limit <= 0:
        raise ConfigError(
            f"body_height is {task.body_height} m; the legs of robot {robot.name} reach from "
            f"{lowest:.3f} to {highest:.3f} m"
        )
    if task.max_incline > limit:
        raise ConfigError(
            f"max_incline is {task.max_incline} deg; on both axes at once the legs of robot "
            f"{robot.name}, from body_height {task.body_height} m, reach at most {limit:.1f} deg"
        )
    rest = task.sim_steps - task.ramp_steps
    if delay_steps(task, robot) > rest:
        raise ConfigError(
            f"command_delay of robot {robot.name} is {robot.command_delay} s; for the legs to "
            f"arrive before the next decision it must be at most {rest * task.sim_dt:g}: ctrl_dt, "
            f"{task.ctrl_dt} s, less action_ramp's share of it"
        )
    check_delays(task, ranges, robot)
    check_friction(ranges, robot)
    return config


def check_friction(ranges: RandomizationConfig, robot: Robot) -> None:
    """Raises `ConfigError` if the one end of the friction's range that is given passes the other.

    The other is the robot's own friction.
    """
    own = robot.foot_friction
    if ranges.friction_min is None and (ranges.friction_max or own) < own:
        raise ConfigError(
            f"friction_max is {ranges.friction_max}; it must not be less than the friction of "
            f"robot {robot.name}, {own}, unless friction_min is given"
        )
    if ranges.friction_max is None and (ranges.friction_min or own) > own:
        raise ConfigError(
            f"friction_min is {ranges.friction_min}; it must not exceed the friction of robot "
            f"{robot.name}, {own}, unless friction_max is given"
        )
