"""The frozen dataclasses of a config: every number with its unit, bounds and source.

No other module repeats these numbers, except those of our own robot in `robots/`. "paper n"
cites a section of the paper; "chosen" marks a number that the paper does not give.
"""

import dataclasses
import functools
import math
import typing
from typing import Annotated, Any, Literal, Self

from annotated_types import Ge, Gt, Le, Len, Lt, MaxLen

from mjx_balance.errors import InputError, quote, suggest
from mjx_balance.files.validation import STRICT

ACTION_AXES = 2  # roll and pitch, paper Eq. 3
GRAVITY = 9.81  # m/s^2
DEGREE = math.radians(1.0)  # rad
LEAN = GRAVITY * math.sin(DEGREE)  # m/s^2, accelerometer x or y at a tilt of 1 deg

HUGE = 1e300
"""Bound of all numbers; it keeps sums of them finite."""
MOST_COUNT = 2**53  #: bound of whole numbers; up to here a float64 holds each of them
MOST_LAGS = 1_000
Real = Annotated[float, Gt(-HUGE), Lt(HUGE)]
Positive = Annotated[float, Gt(0), Lt(HUGE)]
NonNegative = Annotated[float, Ge(0), Lt(HUGE)]
Share = Annotated[float, Ge(0), Le(1)]
Scale = Annotated[float, Ge(1e-6), Le(1e6)]
Reward = Annotated[float, Ge(-1e6), Le(1e6)]
Count = Annotated[int, Ge(1), Le(MOST_COUNT)]
CountFrom0 = Annotated[int, Ge(0), Le(MOST_COUNT)]
Lags = Annotated[tuple[Annotated[int, Ge(0), Le(10_000)], ...], Len(1, MOST_LAGS)]
CommandLags = Annotated[tuple[Annotated[int, Ge(0), Le(1_000)], ...], MaxLen(MOST_LAGS)]
Times = Annotated[tuple[Annotated[float, Ge(1e-6), Le(10_000)], ...], MaxLen(MOST_LAGS)]


class ConfigError(InputError):
    """Invalid config; the message names the field and a remedy."""


class _Floats:
    """Makes floats of whole numbers given for float fields: arrays take their type from them."""

    def __post_init__(self) -> None:
        for name in _float_fields(type(self)):
            object.__setattr__(self, name, _as_float(getattr(self, name)))


@functools.cache
def _float_fields(kind: type) -> list[str]:
    hints = typing.get_type_hints(kind)
    return [name for name, hint in hints.items() if float in (hint, *typing.get_args(hint))]


def _as_float(value: Any) -> Any:
    """The value, with a float for each int that `check` might accept."""
    if isinstance(value, tuple):
        return tuple(map(_as_float, value))
    return float(value) if type(value) is int and abs(value) < HUGE else value


@dataclasses.dataclass(frozen=True)
class TaskConfig(_Floats):
    """The control problem (paper section 3)."""

    __pydantic_config__ = STRICT

    sim_dt: Annotated[float, Gt(0), Le(1)] = 0.004
    """Physics step, s (paper 3.1)."""
    ctrl_dt: Annotated[float, Gt(0), Le(10)] = 0.2
    """One decision, s (paper 3.1: 5 Hz)."""
    body_height: Positive = 0.35
    """Standing height of the trunk above the board, foot radius included, m (paper 3.1)."""
    max_incline: Annotated[float, Gt(0), Lt(45)] = 7.0
    """Greatest board tilt, deg (paper 3.1)."""
    board_rate: Positive = 3.5
    """Board speed on each axis, deg/s (paper 3.1)."""
    square_share: Share = 0.0
    """Share of training targets drawn from a square, uniform in +-max_incline on each axis; the
    others come from the paper's disc (paper: 0)."""
    target_period: Positive = 10.0
    """Time between board targets, s (paper 3.1)."""
    board_motions: Annotated[tuple[Literal["ramps", "steps", "sea"], ...], Len(1, 3)] = ("ramps",)
    """Kinds of board motion in training, drawn equally often: ramps to targets (paper 3.1), jumps,
    or waves of the sea (task/tilt.py)."""
    step_rate: Positive = 20.0
    """Speed of a jump on each axis, deg/s (chosen: the board's servo reaches it within 13 ms, so
    that the board falls away from under the feet with less than 1 g)."""
    sea_angle: NonNegative | None = None
    """Significant height of the board's angle at sea, crest to trough, deg; none: the greatest that
    max_incline and board_rate allow."""
    sea_period: Positive = 10.0
    """Peak period of the sea, s (chosen: a moderate sea)."""
    platform: bool = False
    """Whether the board stands on a platform that surges, sways and heaves with the sea; only then
    the scene has joints for it."""
    sea_height: NonNegative = 1.0
    """Significant height of the platform's heave, crest to trough, m; it surges and sways along the
    heading by as much (chosen: a slight sea). In training, every sea draws its own height,
    uniform from 0 to this."""
    sea_heading: Annotated[float, Ge(-360), Le(360)] | None = None
    """Mean direction in which the waves run, deg from straight ahead to the left; none:
    drawn at random."""
    start_incline: Annotated[float, Ge(0), Lt(90)] = 0.0
    """Greatest tilt of board and body at the start of a training episode, in any direction, deg
    (paper: 0)."""
    fail_tilt: Annotated[float, Gt(0), Lt(90)] = 6.0
    """Body tilt that counts as a fall, deg (paper 3.1)."""
    action_max: Positive = 0.003
    """Greatest height change of one decision on one axis, m (paper Eq. 3)."""
    action_levels: Annotated[int, Ge(3), Le(201)] = 21
    """Height changes per axis (paper Eq. 3: n = 0..20)."""
    action: Literal["grid", "continuous"] = "grid"
    """Height changes that policies and baselines command and training explores: those of the grid
    (paper Eq. 3), or any up to action_max, which need the head "radial"."""
    action_ramp: Annotated[float, Gt(0), Le(1)] = 0.1
    """Share of a decision in which the legs move to their new heights (chosen: the legs are at
    rest before the next decision, and the gyro reads the board's rate; benchmarks/README.md)."""
    gyro_lags: Lags = (0, 1, 2, 3, 4, 5)
    """Ages of the gyro samples in the observation, physics steps (paper Eq. 2)."""
    accel_lags: Lags = (0, 2, 4, 6, 8, 10, 12, 14, 15)
    """Ages of the accelerometer samples in the observation, physics steps (paper Eq. 2)."""
    imu_mean: Annotated[int, Ge(1), Le(10_000)] = 1
    """IMU samples averaged into one input, from its lag backwards (paper Eq. 2: 1)."""
    command_lags: CommandLags = ()
    """Lags, in decisions, of the commanded foot heights in the observation: compared with the
    measured heights they show delayed actions and compliant legs (paper Eq. 2: none)."""
    mean_times: Times = ()
    """Time constants of leaky means of gyro and accelerometer in the observation, s: they show what
    stays constant, such as a bias (paper Eq. 2: none)."""
    filter_times: Times = ()
    """Time constants of complementary filters, s, whose roll and pitch are in the observation
    (paper Eq. 2: none)."""
    height_scale: Scale = 0.01
    """Foot height relative to the standing height that enters the network as 1, m (chosen)."""
    gyro_scale: Scale = DEGREE
    """Angular rate that enters the network as 1, rad/s (chosen: 1 deg/s)."""
    accel_scale: Scale = LEAN
    """Acceleration that enters the network as 1, m/s^2 (chosen: 1 deg of tilt)."""
    reward_tilt: Literal["end", "mean"] = "end"
    """Tilt in the reward: at the end of the decision (paper 3.2: in the new state), or the mean
    over its physics steps."""
    reward_level: Reward = 0.4
    """Reward for a level body (paper Eq. 4)."""
    reward_sharpness: NonNegative = 1.5
    """Decay of reward_level with the body tilt, 1/deg (paper Eq. 4)."""
    reward_toward: Reward = 0.4
    """Greatest reward for moving toward the horizontal (paper Fig. 5; height chosen)."""
    reward_toward_scale: Scale = 1.0
    """Decrease of tilt in one decision that earns all of reward_toward, deg (paper Fig. 5; scale
    chosen)."""
    reward_fail: Reward = -0.5
    """Added on a fall (paper 3.2)."""
    episode_length: Annotated[int, Ge(1), Le(1_000_000)] = 300
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
    def jump_incline(self) -> float:
        """Greatest tilt between jumps, deg.

        A jump is at most two thirds of fail_tilt, because the body tilts with the board before the
        legs can move.
        """
        return min(self.max_incline, self.fail_tilt / 3)

    @property
    def num_actions(self) -> int:
        """Size of the joint action set (paper: 21 x 21)."""
        return self.action_levels**ACTION_AXES


@dataclasses.dataclass(frozen=True)
class RandomizationConfig(_Floats):
    """Ranges of the domain randomisation, in training and in suites; off by default (paper)."""

    __pydantic_config__ = STRICT

    gyro_noise: NonNegative = 0.0
    """Standard deviation of the noise on every gyro sample, rad/s."""
    accel_noise: NonNegative = 0.0
    """Standard deviation of the noise on every accelerometer sample, m/s^2."""
    gyro_bias: NonNegative = 0.0
    """Greatest bias of the gyro on every axis, rad/s."""
    gyro_bias_drift: NonNegative = 0.0
    """Random walk of the gyro's bias, rad/s per square root of a second."""
    accel_bias: NonNegative = 0.0
    """Greatest bias of the accelerometer on every axis, m/s^2."""
    accel_bias_drift: NonNegative = 0.0
    """Random walk of the accelerometer's bias, m/s^2 per square root of a second."""
    imu_scale: Annotated[float, Ge(0), Lt(1)] = 0.0
    """Greatest relative error of the IMU's scale on every axis of gyro and accelerometer."""
    imu_tilt: Annotated[float, Ge(0), Le(0.5)] = 0.0
    """Greatest error of the IMU's mounting angle about every axis, rad."""
    encoder_offset: NonNegative = 0.0
    """Greatest offset of every joint encoder, rad; the servos use the encoders, too."""
    reading_offset: NonNegative = 0.0
    """Greatest offset of every joint's reading from its encoder, rad; the servos do not see it."""
    sensor_delay: NonNegative = 0.0
    """Greatest delay of the IMU's samples, s; constant in an episode."""
    sensor_jitter: NonNegative = 0.0
    """Greatest additional delay of the IMU's samples, s; drawn anew in every decision."""
    command_delay: NonNegative = 0.0
    """Greatest delay of commands to the legs, s, in addition to that of the robot's file; constant
    in an episode."""
    command_jitter: NonNegative = 0.0
    """Greatest additional delay of commands, s; drawn anew in every decision."""
    dropout: Annotated[float, Ge(0), Lt(1)] = 0.0
    """Share of the IMU's samples that are lost; the previous one is repeated."""
    ideal_share: Share = 0.0
    """Share of the envs in which all errors above but noise are zero."""
    payload: NonNegative = 0.0
    """Greatest mass carried on the trunk, kg."""
    payload_offset: NonNegative = 0.05
    """Greatest distance of the payload from the trunk's centre on either axis, m (chosen)."""
    payload_height: Real = 0.08
    """Height of the payload above the trunk's centre, m (chosen)."""
    friction_min: Positive | None = None
    """Least sliding friction of the feet; none: the robot's foot_friction."""
    friction_max: Positive | None = None
    """Greatest sliding friction of the feet; none: the robot's foot_friction."""
    gain_spread: Annotated[float, Ge(0), Lt(1)] = 0.0
    """Greatest relative deviation of the servo gains."""
    soft_share: Share = 0.0
    """Share of the envs with softer servos than the robot's: at softest those of `quadruped_soft`,
    scaled to the robot."""
    event_payload: NonNegative = 0.0
    """Greatest mass on the trunk from the middle of an episode on, kg; 0: the load stays."""
    event_grip: Annotated[float, Gt(0), Le(1)] = 1.0
    """Least share of its friction that one foot keeps from the middle of an episode on."""
    event_strength: Annotated[float, Gt(0), Le(1)] = 1.0
    """Least share of its stiffness that one leg servo keeps from then on."""
    latency_share: Share = 0.0
    """Share of the envs with an action delay of one decision."""
    push_min: NonNegative = 0.0
    """Least speed that a push adds to the trunk, m/s."""
    push_max: NonNegative = 0.0
    """Greatest speed that a push adds to the trunk, m/s; 0: no pushes."""
    push_period: Positive = 5.0
    """Time between pushes, s (chosen)."""

    @property
    def happens(self) -> bool:
        """Whether something changes in the middle of an episode, besides pushes."""
        return self.event_payload > 0 or min(self.event_grip, self.event_strength) < 1

    @property
    def varies(self) -> bool:
        """Whether envs differ; the payload's offset and height matter only with a payload."""
        shares = self.gain_spread, self.soft_share, self.latency_share
        sizes = self.gyro_noise, self.accel_noise, self.payload, self.push_max
        frictions = self.friction_min is not None, self.friction_max is not None
        return any((*shares, *sizes, *frictions, self.sensors_err, self.happens))

    @property
    def sensors_err(self) -> bool:
        """Whether sensors or commands have errors other than noise and the delay of a decision."""
        biases = self.gyro_bias, self.gyro_bias_drift, self.accel_bias, self.accel_bias_drift
        offsets = self.imu_tilt, self.encoder_offset, self.reading_offset
        delays = self.sensor_delay, self.sensor_jitter, self.command_delay, self.command_jitter
        return any((*biases, *offsets, *delays, self.imu_scale, self.dropout))


@dataclasses.dataclass(frozen=True)
class DQNConfig(_Floats):
    """The learner (paper sections 2 and 3.2)."""

    __pydantic_config__ = STRICT

    gamma: Share = 0.1
    """Discount (paper 3.2)."""
    learning_rate: Positive = 1e-5
    """Adam step size (paper 3.2)."""
    learning_rate_end_share: NonNegative = 1.0
    """Share of learning_rate to which a cosine decay leads (paper: 1). The decay is as long as if
    the run learned from its first decision; it ends above that share by what `min_replay_size`
    leaves out."""
    batch_size: Count = 32
    """Transitions per gradient step (chosen)."""
    replay_ratio: Positive = 32.0
    """Transitions replayed per new one: batch_size * gradient steps / env steps. One gradient
    step per env step, as in a DQN with one env, is a ratio of batch_size."""
    replay_capacity: Count = 131_072
    """Transitions in the buffer, rounded down to a multiple of num_envs (chosen)."""
    min_replay_size: Count = 4_096
    """Transitions stored before learning begins (chosen)."""
    target_update_period: Count = 1_000
    """Gradient steps between copies into the target network (chosen)."""
    epsilon_start: Share = 1.0
    """Share of random actions at the start (chosen)."""
    epsilon_end: Share = 0.05
    """Share of random actions after the decay (chosen)."""
    epsilon_decay_steps: Count = 50_000
    """Env steps over which epsilon falls linearly (chosen)."""
    exploration_noise: CountFrom0 = 0
    """Greatest number of levels by which a training action moves at random on each axis; off the
    grid the move is Gaussian, with the same standard deviation (chosen: 0)."""
    hidden_sizes: Annotated[tuple[Annotated[int, Ge(1), Le(65_536)], ...], Len(1, 64)] = (256, 256)
    """Widths of the Q-network's hidden layers (chosen)."""
    head: Literal["joint", "factored", "radial"] = "joint"
    """How the network computes action values (dqn/networks.py): one output per action; the sum
    of one output per level and axis; or a best action and a radial profile around it."""
    zero_at_rest: bool = False
    """Make "no height change" the radial head's best action for an observation of zeros, that of a
    level robot at rest (chosen: no)."""
    whiten_steps: CountFrom0 = 0
    """Env steps over which the covariance of the inputs is estimated, for whitening; 0: no
    whitening (paper)."""
    whiten_floor: Positive = 1e-3
    """Variance added in every direction; it bounds the gain of the whitening (chosen)."""
    mirror: bool = False
    """Replace sampled transitions by random reflections (task/symmetry.py; paper: no)."""
    double: bool = False
    """Double DQN (van Hasselt et al. 2015) instead of Eq. 1's max over the target network."""
    huber_delta: Positive | None = None
    """Absolute TD error above which the loss grows linearly (Mnih et al. 2015); none: squared
    loss everywhere (chosen)."""
    max_grad_norm: Positive = 10.0
    """Global-norm gradient clipping (chosen)."""

    def updates_per_step(self, num_envs: int) -> int:
        """Gradient steps after each decision of all envs: replay_ratio * num_envs / batch_size."""
        return round(self.replay_ratio * num_envs / self.batch_size)


@dataclasses.dataclass(frozen=True)
class Config(_Floats):
    """All settings of a run; in Python, a bare `Config()` has the paper's values."""

    __pydantic_config__ = STRICT

    preset: str = "paper"
    """Preset that gives the defaults of all other fields."""
    seed: CountFrom0 = 0
    """Random seed."""
    num_envs: Count | None = None
    """Envs simulated at once; none: sized to the device."""
    num_seeds: Count = 1
    """Runs trained at once in one program, with seeds `seed`, `seed + 1`, ..."""
    sweep: tuple[str, ...] = ()
    """Values of the learner's numbers to try, e.g. `learning_rate=0.001,0.003`: one program trains
    every combination with `num_seeds` seeds."""
    num_env_steps: Count = 200_000
    """Decisions of a run, over all envs (paper 4: about 200k)."""
    num_devices: Count | None = None
    """JAX devices to spread the envs over; none: one per CPU core, or all accelerators."""
    log_every: Count = 1_024
    """Env steps between two lines of metrics."""
    checkpoint_seconds: Positive = 45.0
    """Time between two checkpoints, s."""
    eval_every: CountFrom0 = 20_000
    """Env steps between two validations of the greedy policy during training, rounded to whole
    multiples of `log_every`; the end of the run is validated too. 0: never."""
    validation_scenarios: Count = 4
    """Scenarios per suite of a validation (chosen: they take less than 5% of a run)."""
    validation_duration: Positive = 20.0
    """Length of a validation scenario, s."""
    export: Literal["last", "best"] = "last"
    """Which policy the run exports: the last one, or the one that validated best."""
    eval_scenarios: Count = 128
    """Scenarios per suite of the evaluation after training."""
    eval_duration: Positive = 60.0
    """Length of such a scenario, s."""
    engine: Literal["mjx", "mujoco", "warp"] = "mjx"
    """Physics engine of the training: MJX, on any device; MuJoCo's C engine, on CPUs; or MJX-Warp,
    on NVIDIA GPUs, whose results are not reproducible bit for bit."""
    robot: str = "quadruped"
    """The robot: the name of a shipped one, the path of a TOML file, or menagerie:NAME."""
    solver_iterations: Annotated[int, Ge(1), Le(1_000)] = 4
    """Greatest number of Newton iterations per physics step of engines `mjx` and `warp`; `mujoco`
    iterates to convergence. With fewer, the solver does not converge when a random policy lifts a
    foot; with 1, robots jump (benchmarks/README.md)."""
    line_search_iterations: Annotated[int, Ge(1), Le(1_000)] = 6
    """Line-search iterations per Newton iteration."""
    task: TaskConfig = dataclasses.field(default_factory=TaskConfig)
    randomization: RandomizationConfig = dataclasses.field(default_factory=RandomizationConfig)
    dqn: DQNConfig = dataclasses.field(default_factory=DQNConfig)

    def replace(self, **fields: Any) -> Self:
        """Returns this config with other values, as `dataclasses.replace`.

        A field of a section needs no section: `config.replace(reward_toward=0.5, gamma=0.2)`. A
        list becomes a tuple. `check` finds values that are out of bounds, before anything runs.

        Raises:
          ConfigError: for an unknown field, or a section of another type.
        """
        values = {name: tuple(x) if isinstance(x, list) else x for name, x in fields.items()}
        known: list[str] = []
        changes: dict[str, Any] = {}
        for name, section in (("", self), *((name, getattr(self, name)) for name in SECTIONS)):
            kind = type(section)
            section: Any = values.get(name, section)
            if not isinstance(section, kind):
                raise ConfigError(f"{name} is {quote(section)}; it must be a {kind.__name__}")
            names = [field.name for field in dataclasses.fields(section)]
            known += names
            own = {field: values[field] for field in names if field in values}
            if name and own:
                changes[name] = dataclasses.replace(section, **own)
            else:
                changes |= own
        for name in set(values) - set(known):
            raise ConfigError(f"unknown field {quote(name)}; {suggest('field', name, known)}")
        return dataclasses.replace(self, **changes)


SECTIONS = ("task", "randomization", "dqn")  #: fields of `Config` that have fields of their own
