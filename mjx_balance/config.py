"""Every number of the task, the robot and the training, with its unit and source.

The dataclasses are frozen: a config is a value. Nothing else in the package
restates one of these numbers. `check` turns an impossible combination into one
sentence (`ConfigError`) before anything is built or written.

Sources: "paper n" is a section of the paper, "Go2" the Unitree Go2's published
dimensions, "chosen" a number the paper does not give.
"""

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

T = TypeVar("T")

ACTION_AXES = 2  # roll and pitch, paper Eq. 3
LEGS = ("LF", "RF", "LH", "RH")
HEADS = ("joint", "factored", "radial")
REWARD_TILTS = ("end", "mean")


class ConfigError(ValueError):
    """A config that cannot be run; the message names the field and a remedy."""


@dataclasses.dataclass(frozen=True)
class RobotConfig:
    """Dimensions of `scenes/quadruped.xml`, compared with the compiled model by a test."""

    legs: tuple[str, ...] = LEGS
    """Leg prefixes in observation order (paper Eq. 2)."""
    hip_x: float = 0.193
    """Fore-aft distance of the hips from the trunk centre, m (Go2)."""
    hip_y: float = 0.0465
    """Lateral distance of the abduction axes from the trunk centre, m (Go2)."""
    abduction_offset: float = 0.0955
    """Lateral distance from the abduction axis to the leg plane, m (Go2)."""
    thigh: float = 0.213
    """Hip to knee, m (Go2)."""
    calf: float = 0.213
    """Knee to foot centre, m (Go2)."""
    foot_radius: float = 0.022
    """m (Go2)."""
    trunk_mass: float = 6.92
    """kg (Go2)."""
    total_mass: float = 15.2
    """kg (Go2)."""
    knee_min: float = -2.72
    """rad (Go2)."""
    knee_max: float = -0.838
    """rad (Go2)."""
    hip_torque: float = 23.7
    """Limit of the abduction and hip servos, N m (Go2)."""
    knee_torque: float = 45.4
    """Limit of the knee servos, N m (Go2)."""
    servo_stiffness: float = 400.0
    """Position gain of the leg servos, N m / rad (chosen)."""
    servo_damping: float = 16.0
    """Damping of the leg joints, N m s / rad (chosen)."""
    foot_friction: float = 0.8
    """Sliding friction of a foot on the board (chosen)."""

    @property
    def half_track(self) -> float:
        """Lateral distance of a foot from the trunk centre, m."""
        return self.hip_y + self.abduction_offset

    @property
    def height_range(self) -> tuple[float, float]:
        """Least and greatest body height above a foot's contact point, m (knee range)."""

        def height(knee: float) -> float:
            squared = self.thigh**2 + self.calf**2 + 2 * self.thigh * self.calf * math.cos(knee)
            return math.sqrt(squared) + self.foot_radius

        return height(self.knee_min), height(self.knee_max)


@dataclasses.dataclass(frozen=True)
class TaskConfig:
    """The control problem (paper section 3)."""

    sim_dt: float = 0.004
    """Physics step, s (paper 3.1)."""
    ctrl_dt: float = 0.2
    """One decision, s (paper 3.1: 5 Hz)."""
    body_height: float = 0.35
    """Standing height of the trunk above the board, foot radius included, m (paper 3.1)."""
    max_incline: float = 7.0
    """Greatest board tilt, deg (paper 3.1)."""
    board_rate: float = 3.5
    """Board speed on each axis, deg/s (paper 3.1)."""
    square_share: float = 0.0
    """Share of training targets drawn from the whole square of both axes, each uniform in
    +-max_incline, instead of the paper's disc (paper: none)."""
    target_period: float = 10.0
    """Time between board targets, s (paper 3.1)."""
    fail_tilt: float = 6.0
    """Body tilt that counts as a fall, deg (paper 3.1)."""
    action_max: float = 0.003
    """Greatest height change of one decision on one axis, m (paper Eq. 3)."""
    action_levels: int = 21
    """Height changes per axis (paper Eq. 3: n = 0..20)."""
    action_ramp: float = 0.1
    """Share of a decision in which the legs reach their new heights (chosen: the gyro then
    reads the board's own rate before the next decision; benchmarks/README.md)."""
    gyro_lags: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    """Gyro samples in the observation, physics steps back (paper Eq. 2)."""
    accel_lags: tuple[int, ...] = (0, 2, 4, 6, 8, 10, 12, 14, 15)
    """Accelerometer samples in the observation, physics steps back (paper Eq. 2)."""
    imu_mean: int = 1
    """IMU samples whose mean is one input, back from its lag (paper Eq. 2: 1)."""
    command_lags: tuple[int, ...] = ()
    """Decisions back whose commanded foot heights enter the network too: beside the measured
    ones they show late actions and legs that give way (paper Eq. 2: none)."""
    height_scale: float = 0.01
    """Foot height, less the standing height, that enters the network as 1, m (chosen)."""
    gyro_scale: float = math.radians(1.0)
    """Angular rate that enters the network as 1, rad/s (chosen: 1 deg/s)."""
    accel_scale: float = 9.81 * math.sin(math.radians(1.0))
    """Acceleration that enters the network as 1, m/s^2 (chosen: 1 deg of tilt)."""
    reward_tilt: Literal["end", "mean"] = "end"
    """Tilt that is rewarded: at the decision's end (paper 3.2: in the new state), or the mean
    over its physics steps."""
    reward_level: float = 0.4
    """Reward for a level body (paper Eq. 4)."""
    reward_sharpness: float = 1.5
    """Decay of that reward with the body tilt, 1/deg (paper Eq. 4)."""
    reward_toward: float = 0.4
    """Greatest reward for moving toward the horizontal (paper Fig. 5; height chosen)."""
    reward_toward_scale: float = 1.0
    """Change of tilt that earns it, deg (paper Fig. 5; scale chosen)."""
    reward_fail: float = -0.5
    """Added on a fall (paper 3.2)."""
    episode_length: int = 300
    """Decisions until an episode is truncated (chosen: 60 s)."""

    @property
    def sim_steps(self) -> int:
        """Physics steps per decision."""
        return round(self.ctrl_dt / self.sim_dt)

    @property
    def ramp_steps(self) -> int:
        """Physics steps in which the legs reach their new heights, at least one."""
        return max(1, round(self.action_ramp * self.sim_steps))

    @property
    def history(self) -> int:
        """IMU samples that the observation looks back on, the newest included."""
        return max(*self.gyro_lags, *self.accel_lags) + self.imu_mean

    @property
    def command_history(self) -> int:
        """Commands that the observation looks back on, at least the newest."""
        return max(self.command_lags, default=0) + 1

    @property
    def num_actions(self) -> int:
        """Size of the joint action set (paper: 21 x 21)."""
        return self.action_levels**ACTION_AXES


@dataclasses.dataclass(frozen=True)
class RandomConfig:
    """What differs from world to world; off by default, as in the paper.

    Used twice: as domain randomisation in training, and to define the evaluation suites.
    """

    gyro_noise: float = 0.0
    """Standard deviation of every gyro sample, rad/s."""
    accel_noise: float = 0.0
    """Standard deviation of every accelerometer sample, m/s^2."""
    payload: float = 0.0
    """Greatest mass carried on the trunk, kg."""
    payload_offset: float = 0.05
    """Greatest distance of the payload from the trunk's centre on either axis, m (chosen)."""
    payload_height: float = 0.08
    """Height of the payload above the trunk's centre, m (chosen)."""
    friction_min: float | None = None
    """Least sliding friction of the feet; none: foot_friction."""
    friction_max: float | None = None
    """Greatest sliding friction of the feet; none: foot_friction."""
    gain_spread: float = 0.0
    """Servo gains differ by up to this share."""
    latency_share: float = 0.0
    """Share of the worlds that take every action one decision late."""
    rate_max: float | None = None
    """Board speeds are uniform from board_rate to this, deg/s; none: board_rate."""
    incline_max: float | None = None
    """Inclines are uniform from max_incline to this, deg; none: max_incline."""


@dataclasses.dataclass(frozen=True)
class DQNConfig:
    """The learner (paper sections 2 and 3.2); it knows nothing of the robot."""

    gamma: float = 0.1
    """Discount (paper 3.2)."""
    learning_rate: float = 1e-5
    """Adam step size (paper 3.2)."""
    learning_rate_end: float = 1e-5
    """Adam step size at the end of a cosine decay over the run (paper: constant)."""
    batch_size: int = 512
    """Transitions per gradient step (chosen)."""
    updates_per_step: int = 4
    """Gradient steps after each decision of all envs (chosen)."""
    replay_capacity: int = 131_072
    """Transitions kept, rounded down to whole batches of num_envs (chosen)."""
    min_replay_size: int = 4_096
    """Transitions stored before learning begins (chosen)."""
    target_update_period: int = 200
    """Gradient steps between copies into the target network (chosen)."""
    epsilon_start: float = 1.0
    """Share of random actions at first (chosen)."""
    epsilon_end: float = 0.05
    """Share of random actions after the decay (chosen)."""
    epsilon_decay_steps: int = 50_000
    """Env steps over which epsilon falls linearly (chosen)."""
    dither: int = 0
    """Levels by which every training action is moved at random on each axis (chosen: none)."""
    hidden_sizes: tuple[int, ...] = (256, 256)
    """Widths of the Q-network's hidden layers (chosen)."""
    head: Literal["joint", "factored", "radial"] = "joint"
    """How the network makes action values (dqn/networks.py): one output per action, one per
    level and axis, added up, or a best action and a profile around it."""
    whiten_steps: int = 0
    """Env steps in which the inputs' covariance is gathered, to whiten them by; 0: inputs are
    taken as they are (paper)."""
    whiten_floor: float = 1e-3
    """Variance added to every direction, so that none is blown up beyond measure (chosen)."""
    mirror: bool = False
    """Learn from reflections of the transitions too (task/symmetry.py; paper: none)."""
    double: bool = False
    """Double DQN (van Hasselt et al. 2015) instead of Eq. 1's max over the target network."""
    max_grad_norm: float = 10.0
    """Global-norm gradient clipping (chosen)."""


@dataclasses.dataclass(frozen=True)
class Config:
    """A whole run."""

    preset: str = "default"
    """Where the other values start from."""
    seed: int = 0
    """Seed of everything random."""
    num_envs: int | None = None
    """Boards simulated at once; none: sized to the device."""
    num_seeds: int = 1
    """Runs trained at once in one program, with seeds `seed`, `seed + 1`, ..."""
    num_env_steps: int = 200_000
    """Decisions of a run, over all boards (paper 4: about 200k)."""
    num_devices: int | None = None
    """JAX devices to spread the boards over; none: one per CPU core, or all accelerators."""
    log_every: int = 2_048
    """Env steps between two lines of metrics."""
    checkpoint_seconds: float = 45.0
    """Time between two checkpoints, s."""
    eval_scenarios: int = 128
    """Scenarios per suite of the evaluation after training."""
    eval_duration: float = 60.0
    """Length of each of them, s."""
    task: TaskConfig = dataclasses.field(default_factory=TaskConfig)
    robot: RobotConfig = dataclasses.field(default_factory=RobotConfig)
    random: RandomConfig = dataclasses.field(default_factory=RandomConfig)
    dqn: DQNConfig = dataclasses.field(default_factory=DQNConfig)


_LAST_600_MS = tuple(range(0, 150, 5))
_TASK = TaskConfig(square_share=0.5, reward_tilt="mean", reward_toward=1.0, reward_toward_scale=2.5)
_DQN = DQNConfig(
    learning_rate=3e-3,
    learning_rate_end=1e-5,
    batch_size=512,
    updates_per_step=32,
    min_replay_size=2_048,
    epsilon_decay_steps=10_000,
    dither=2,
    hidden_sizes=(64, 64),
    head="radial",
    mirror=True,
    whiten_steps=50_000,
)

PRESETS: Mapping[str, Config] = {
    "paper": Config(preset="paper"),
    "default": Config(preset="default", task=_TASK, dqn=_DQN),
    # All IMU samples of the last three decisions, as means over 20 ms, and these decisions'
    # commands, under noise of a data sheet, payloads and late actions: what `default` reads off
    # tiny differences, this one has to average. The greater gamma is for the late actions.
    "best": Config(
        preset="best",
        num_env_steps=140_000,
        task=dataclasses.replace(
            _TASK,
            gyro_lags=_LAST_600_MS,
            accel_lags=_LAST_600_MS,
            imu_mean=5,
            command_lags=(0, 1, 2),
        ),
        random=RandomConfig(gyro_noise=0.002, accel_noise=0.023, payload=5.0, latency_share=0.15),
        dqn=dataclasses.replace(_DQN, gamma=0.4, whiten_floor=0.02),
    ),
    "smoke": Config(
        preset="smoke",
        num_envs=64,
        num_env_steps=8_192,
        log_every=1_024,
        eval_scenarios=16,
        eval_duration=20.0,
        task=_TASK,
        dqn=dataclasses.replace(
            _DQN,
            batch_size=256,
            updates_per_step=8,
            min_replay_size=512,
            replay_capacity=8_192,
            epsilon_decay_steps=4_096,
            whiten_steps=2_048,
        ),
    ),
}
"""Named starting points of the command line."""


def preset(name: str) -> Config:
    """Returns the preset called `name`; raises `ConfigError` with the known names."""
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}; known presets: {', '.join(PRESETS)}")
    return PRESETS[name]


def greatest_incline(task: TaskConfig, robot: RobotConfig) -> float:
    """Board angle on both axes at once that the legs' stroke can follow, deg."""
    lowest, highest = robot.height_range
    room = min(highest - task.body_height, task.body_height - lowest)
    return math.degrees(math.atan(room / (robot.hip_x + robot.half_track)))


def check(config: Config) -> Config:
    """Returns `config` if it can be run; raises `ConfigError` with one sentence if not."""
    task, robot, random, dqn = config.task, config.robot, config.random, config.dqn
    for section in (config, task, robot, random, dqn):
        for field in dataclasses.fields(section):
            value = getattr(section, field.name)
            if value is None:
                continue
            if isinstance(value, float) and not math.isfinite(value):
                raise ConfigError(f"{field.name} is {value}; it must be a finite number")
            if type(field.default) is int and type(value) is not int:
                raise ConfigError(f"{field.name} is {value!r}; it must be a whole number")
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if field.name in _POSITIVE | _NOT_NEGATIVE | _UNIT and not number:
                raise ConfigError(f"{field.name} is {value!r}; it must be a number")
            if field.name in _NOT_NEGATIVE and value < 0:
                raise ConfigError(f"{field.name} is {value}; it must not be negative")
            if field.name in _POSITIVE and value <= 0:
                raise ConfigError(f"{field.name} is {value}; it must be greater than 0")
            if field.name in _UNIT and not 0 <= value <= 1:
                raise ConfigError(f"{field.name} is {value}; it must lie between 0 and 1")
    if config.preset not in PRESETS:
        preset(config.preset)
    if config.seed + config.num_seeds > 2**31:
        raise ConfigError(f"seed is {config.seed}; the last of all seeds must be less than 2**31")
    if sorted(robot.legs) != sorted(LEGS):
        raise ConfigError(f"legs is {robot.legs}; it must name each of {', '.join(LEGS)} once")
    if task.reward_tilt not in REWARD_TILTS:
        raise ConfigError(
            f"reward_tilt is {task.reward_tilt!r}; it must be one of {', '.join(REWARD_TILTS)}"
        )
    if dqn.head not in HEADS:
        raise ConfigError(f"head is {dqn.head!r}; it must be one of {', '.join(HEADS)}")
    steps = task.ctrl_dt / task.sim_dt
    if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
        raise ConfigError(
            f"ctrl_dt is {task.ctrl_dt} s; it must be a whole multiple of sim_dt, {task.sim_dt} s"
        )
    if not task.action_ramp > 0:
        raise ConfigError(f"action_ramp is {task.action_ramp}; it must be greater than 0")
    if task.action_levels < 3 or task.action_levels % 2 == 0:
        raise ConfigError(
            f"action_levels is {task.action_levels}; it must be odd and at least 3, "
            "so that standing still is an action"
        )
    for name in ("gyro_lags", "accel_lags"):
        lags = getattr(task, name)
        if not lags or min(lags) < 0:
            raise ConfigError(f"{name} is {lags}; it must hold at least one lag, none negative")
    if min(task.command_lags, default=0) < 0:
        raise ConfigError(f"command_lags is {task.command_lags}; none may be negative")
    steepest = task.max_incline if random.incline_max is None else random.incline_max
    ramp = 2 * steepest / task.board_rate
    if ramp > task.target_period:
        raise ConfigError(
            f"target_period is {task.target_period} s, but a board ramp may last twice the "
            f"greatest incline over board_rate, {ramp:g} s; the period must not be shorter"
        )
    for name, least, most in (
        ("friction", random.friction_min, random.friction_max),
        ("rate", task.board_rate, random.rate_max),
        ("incline", task.max_incline, random.incline_max),
    ):
        if least is not None and most is not None and most < least:
            raise ConfigError(
                f"{name}_max is {most}; it must not be less than the least {name}, {least}"
            )
    if not 0 < task.fail_tilt < 90:
        raise ConfigError(f"fail_tilt is {task.fail_tilt}; it must lie between 0 and 90 deg")
    if task.max_incline >= 45:
        raise ConfigError(f"max_incline is {task.max_incline}; it must be less than 45 deg")
    lowest, highest = robot.height_range
    limit = greatest_incline(task, robot)
    if limit <= 0:
        raise ConfigError(
            f"body_height is {task.body_height} m; the legs reach from {lowest:.3f} to "
            f"{highest:.3f} m"
        )
    if steepest > limit:
        name = "max_incline" if random.incline_max is None else "incline_max"
        raise ConfigError(
            f"{name} is {steepest} deg; on both axes at once the legs, from body_height "
            f"{task.body_height} m, reach at most {limit:.1f} deg"
        )
    if not dqn.hidden_sizes or min(dqn.hidden_sizes) < 1:
        raise ConfigError(f"hidden_sizes is {dqn.hidden_sizes}; it must hold positive widths")
    if config.num_envs is not None and dqn.replay_capacity < config.num_envs:
        raise ConfigError(
            f"replay_capacity is {dqn.replay_capacity}; it must hold at least one decision of "
            f"all num_envs = {config.num_envs} envs"
        )
    if dqn.min_replay_size > dqn.replay_capacity:
        raise ConfigError(
            f"min_replay_size is {dqn.min_replay_size}; it must not exceed replay_capacity, "
            f"{dqn.replay_capacity}"
        )
    return config


_POSITIVE = frozenset(
    "sim_dt ctrl_dt body_height max_incline board_rate target_period action_max height_scale "
    "gyro_scale accel_scale reward_toward_scale episode_length learning_rate batch_size "
    "updates_per_step replay_capacity min_replay_size target_update_period epsilon_decay_steps "
    "max_grad_norm whiten_floor imu_mean num_envs num_seeds num_env_steps num_devices log_every "
    "checkpoint_seconds eval_scenarios eval_duration friction_min friction_max foot_friction "
    "servo_stiffness hip_x hip_y thigh calf foot_radius".split()
)
_NOT_NEGATIVE = frozenset(
    "seed learning_rate_end reward_sharpness gyro_noise accel_noise payload payload_offset "
    "dither whiten_steps".split()
)
_UNIT = frozenset(
    "gain_spread latency_share action_ramp square_share gamma epsilon_start epsilon_end".split()
)


def to_dict(config: Any) -> dict[str, Any]:
    """Returns a config section as plain JSON values."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def flatten(values: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of `to_dict`'s values without their sections; no two have one name."""
    flat = {}
    for name, value in values.items():
        flat |= flatten(value) if isinstance(value, dict) else {name: value}
    return flat


def from_dict(kind: type[T], values: Mapping[str, Any]) -> T:
    """Rebuilds the config section `kind` from `to_dict`'s values.

    Raises:
      ConfigError: for a field that `kind` does not have, or what is no section at all.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{kind.__name__} is {values!r}; it must map its fields to values")
    fields = {f.name: f for f in dataclasses.fields(kind)}  # pyright: ignore[reportArgumentType]
    unknown = sorted(set(values) - set(fields))
    if unknown:
        raise ConfigError(f"unknown field {unknown[0]!r} in {kind.__name__}")
    built = {}
    for name, value in values.items():
        section = _SECTIONS.get(name)
        if section is not None:
            value = from_dict(section, value)
        elif isinstance(value, list):
            value = tuple(value)
        built[name] = value
    return kind(**built)


_SECTIONS = {"task": TaskConfig, "robot": RobotConfig, "random": RandomConfig, "dqn": DQNConfig}
