"""The frozen dataclasses of a config: every number with its unit, its bounds and its source.

Nothing else in the package restates one of these numbers. Sources: "paper n" is a section of the
paper, "chosen" a number that the paper does not give.
"""

import dataclasses
import math
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen

from mjx_balance.errors import InputError
from mjx_balance.files.validation import STRICT

ACTION_AXES = 2  # roll and pitch, paper Eq. 3
DEGREE = math.radians(1.0)  # rad
LEAN = 9.81 * math.sin(DEGREE)  # m/s^2, what a tilt of 1 deg adds to the accelerometer's x or y

HUGE = 1e300
"""No number is as large, so that sums and products of two stay finite."""
Real = Annotated[float, Gt(-HUGE), Lt(HUGE)]
Positive = Annotated[float, Gt(0), Lt(HUGE)]
NonNegative = Annotated[float, Ge(0), Lt(HUGE)]
Share = Annotated[float, Ge(0), Le(1)]
Scale = Annotated[float, Ge(1e-6), Lt(HUGE)]
Reward = Annotated[float, Ge(-1e6), Le(1e6)]
Count = Annotated[int, Ge(1)]
CountFrom0 = Annotated[int, Ge(0)]
Lags = Annotated[tuple[Annotated[int, Ge(0), Le(10_000)], ...], MinLen(1)]


class ConfigError(InputError):
    """A config that cannot be run; the message names the field and a remedy."""


@dataclasses.dataclass(frozen=True)
class TaskConfig:
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
    """Share of training targets drawn from the whole square of both axes, each uniform in
    +-max_incline, instead of the paper's disc (paper: none)."""
    target_period: Positive = 10.0
    """Time between board targets, s (paper 3.1)."""
    fail_tilt: Annotated[float, Gt(0), Lt(90)] = 6.0
    """Body tilt that counts as a fall, deg (paper 3.1)."""
    action_max: Positive = 0.003
    """Greatest height change of one decision on one axis, m (paper Eq. 3)."""
    action_levels: Annotated[int, Ge(3), Le(201)] = 21
    """Height changes per axis (paper Eq. 3: n = 0..20)."""
    action_ramp: Annotated[float, Gt(0), Le(1)] = 0.1
    """Share of a decision in which the legs reach their new heights (chosen: the gyro then
    reads the board's own rate before the next decision; benchmarks/README.md)."""
    gyro_lags: Lags = (0, 1, 2, 3, 4, 5)
    """Gyro samples in the observation, physics steps back (paper Eq. 2)."""
    accel_lags: Lags = (0, 2, 4, 6, 8, 10, 12, 14, 15)
    """Accelerometer samples in the observation, physics steps back (paper Eq. 2)."""
    imu_mean: Annotated[int, Ge(1), Le(10_000)] = 1
    """IMU samples whose mean is one input, back from its lag (paper Eq. 2: 1)."""
    command_lags: tuple[Annotated[int, Ge(0), Le(1_000)], ...] = ()
    """Decisions back whose commanded foot heights enter the network too: beside the measured
    ones they show late actions and legs that give way (paper Eq. 2: none)."""
    height_scale: Scale = 0.01
    """Foot height, less the standing height, that enters the network as 1, m (chosen)."""
    gyro_scale: Scale = DEGREE
    """Angular rate that enters the network as 1, rad/s (chosen: 1 deg/s)."""
    accel_scale: Scale = LEAN
    """Acceleration that enters the network as 1, m/s^2 (chosen: 1 deg of tilt)."""
    reward_tilt: Literal["end", "mean"] = "end"
    """Tilt that is rewarded: at the decision's end (paper 3.2: in the new state), or the mean
    over its physics steps."""
    reward_level: Reward = 0.4
    """Reward for a level body (paper Eq. 4)."""
    reward_sharpness: NonNegative = 1.5
    """Decay of that reward with the body tilt, 1/deg (paper Eq. 4)."""
    reward_toward: Reward = 0.4
    """Greatest reward for moving toward the horizontal (paper Fig. 5; height chosen)."""
    reward_toward_scale: Scale = 1.0
    """Change of tilt that earns it, deg (paper Fig. 5; scale chosen)."""
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
    def num_actions(self) -> int:
        """Size of the joint action set (paper: 21 x 21)."""
        return self.action_levels**ACTION_AXES


@dataclasses.dataclass(frozen=True)
class RandomizationConfig:
    """What differs from env to env; off by default, as in the paper.

    Used twice: as domain randomisation in training, and to define the evaluation suites.
    """

    __pydantic_config__ = STRICT

    gyro_noise: NonNegative = 0.0
    """Standard deviation of every gyro sample, rad/s."""
    accel_noise: NonNegative = 0.0
    """Standard deviation of every accelerometer sample, m/s^2."""
    payload: NonNegative = 0.0
    """Greatest mass carried on the trunk, kg."""
    payload_offset: NonNegative = 0.05
    """Greatest distance of the payload from the trunk's centre on either axis, m (chosen)."""
    payload_height: Real = 0.08
    """Height of the payload above the trunk's centre, m (chosen)."""
    friction_min: Positive | None = None
    """Least sliding friction of the feet; none: foot_friction."""
    friction_max: Positive | None = None
    """Greatest sliding friction of the feet; none: foot_friction."""
    gain_spread: Annotated[float, Ge(0), Lt(1)] = 0.0
    """Servo gains differ by up to this share."""
    latency_share: Share = 0.0
    """Share of the envs that take every action one decision late."""
    push_min: NonNegative = 0.0
    """Least speed that a kick gives the trunk, m/s."""
    push_max: NonNegative = 0.0
    """Greatest speed that a kick gives the trunk, m/s; 0: no kicks."""
    push_period: Positive = 5.0
    """Time between kicks, s (chosen)."""

    @property
    def varies(self) -> bool:
        """Whether envs differ at all: where no payload is, its place makes no difference."""
        shares = self.gain_spread, self.latency_share
        sizes = self.gyro_noise, self.accel_noise, self.payload, self.push_max
        return any((*shares, *sizes)) or (self.friction_min, self.friction_max) != (None, None)


@dataclasses.dataclass(frozen=True)
class DQNConfig:
    """The learner (paper sections 2 and 3.2); it knows nothing of the robot."""

    __pydantic_config__ = STRICT

    gamma: Share = 0.1
    """Discount (paper 3.2)."""
    learning_rate: Positive = 1e-5
    """Adam step size (paper 3.2)."""
    learning_rate_end_share: NonNegative = 1.0
    """Share of it that is left at the end of a cosine decay over the run (paper: constant)."""
    batch_size: Count = 32
    """Transitions per gradient step (chosen)."""
    replay_ratio: Positive = 32.0
    """Transitions replayed per new one: batch_size times gradient steps over env steps (a DQN
    makes one gradient step per decision)."""
    replay_capacity: Count = 131_072
    """Transitions kept, rounded down to whole batches of num_envs (chosen)."""
    min_replay_size: Count = 4_096
    """Transitions stored before learning begins (chosen)."""
    target_update_period: Count = 1_000
    """Gradient steps between copies into the target network (chosen)."""
    epsilon_start: Share = 1.0
    """Share of random actions at first (chosen)."""
    epsilon_end: Share = 0.05
    """Share of random actions after the decay (chosen)."""
    epsilon_decay_steps: Count = 50_000
    """Env steps over which epsilon falls linearly (chosen)."""
    exploration_noise: CountFrom0 = 0
    """Levels by which every training action is moved at random on each axis (chosen: none)."""
    hidden_sizes: Annotated[tuple[Annotated[int, Ge(1), Le(65_536)], ...], MinLen(1)] = (256, 256)
    """Widths of the Q-network's hidden layers (chosen)."""
    head: Literal["joint", "factored", "radial"] = "joint"
    """How the network makes action values (dqn/networks.py): one output per action, one per
    level and axis, added up, or a best action and a profile around it."""
    whiten_steps: CountFrom0 = 0
    """Env steps in which the inputs' covariance is gathered, to whiten them by; 0: inputs are
    taken as they are (paper)."""
    whiten_floor: Positive = 1e-3
    """Variance added to every direction, so that none is blown up beyond measure (chosen)."""
    mirror: bool = False
    """Learn from reflections of the transitions too (task/symmetry.py; paper: none)."""
    double: bool = False
    """Double DQN (van Hasselt et al. 2015) instead of Eq. 1's max over the target network."""
    huber_delta: Positive | None = None
    """TD error from which on the loss grows linearly (Mnih et al. 2015); none: it is squared
    throughout (chosen)."""
    max_grad_norm: Positive = 10.0
    """Global-norm gradient clipping (chosen)."""

    def updates_per_step(self, num_envs: int) -> int:
        """Gradient steps after each decision of all envs: replay_ratio * num_envs / batch_size."""
        return round(self.replay_ratio * num_envs / self.batch_size)


@dataclasses.dataclass(frozen=True)
class Config:
    """A whole run.

    A bare one has the paper's values; `preset` returns the others by name, and
    `robots.limits.for_robot` makes one for another robot.
    """

    __pydantic_config__ = STRICT

    preset: str = "paper"
    """Where the other values start from."""
    seed: CountFrom0 = 0
    """Seed of everything random."""
    num_envs: Count | None = None
    """Envs simulated at once; none: sized to the device."""
    num_seeds: Count = 1
    """Runs trained at once in one program, with seeds `seed`, `seed + 1`, ..."""
    sweep: tuple[str, ...] = ()
    """Numbers of the learner to try, as `learning_rate=0.001,0.003`: every combination is trained
    with `num_seeds` seeds, all in one program."""
    num_env_steps: Count = 200_000
    """Decisions of a run, over all envs (paper 4: about 200k)."""
    num_devices: Count | None = None
    """JAX devices to spread the envs over; none: one per CPU core, or all accelerators."""
    log_every: Count = 1_024
    """Env steps between two lines of metrics."""
    checkpoint_seconds: Positive = 45.0
    """Time between two checkpoints, s."""
    eval_every: CountFrom0 = 20_000
    """Env steps between two validations of the greedy policy during training, in whole calls of
    `log_every`; the end of the run is validated too. 0: never."""
    validation_scenarios: Count = 4
    """Scenarios per suite of each of them (chosen: they take less than 5% of a run)."""
    validation_duration: Positive = 20.0
    """Length of each of these scenarios, s."""
    export: Literal["last", "best"] = "last"
    """Which policy the run hands out: that of its end, or the one that validated best."""
    eval_scenarios: Count = 128
    """Scenarios per suite of the evaluation after training."""
    eval_duration: Positive = 60.0
    """Length of each of them, s."""
    engine: Literal["mjx", "mujoco", "warp"] = "mjx"
    """Physics of the training: MJX, on any device; MuJoCo's C engine, on CPUs; or MJX-Warp, on
    NVIDIA GPUs, whose steps do not repeat bit for bit."""
    robot: str = "quadruped"
    """The robot: a shipped one's name, a TOML file that describes yours, or menagerie:NAME."""
    solver_iterations: Annotated[int, Ge(1), Le(1_000)] = 4
    """Newton iterations of a physics step of engines `mjx` and `warp`; `mujoco` goes on until it
    has converged. A batch waits for its slowest env, but fewer do not converge when a random policy
    lifts a foot: with one, robots jump (benchmarks/README.md)."""
    line_search_iterations: Annotated[int, Ge(1), Le(1_000)] = 6
    """Line-search iterations of each of them."""
    task: TaskConfig = dataclasses.field(default_factory=TaskConfig)
    randomization: RandomizationConfig = dataclasses.field(default_factory=RandomizationConfig)
    dqn: DQNConfig = dataclasses.field(default_factory=DQNConfig)
