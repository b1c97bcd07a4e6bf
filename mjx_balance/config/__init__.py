"""Every number of the task and the training, with its unit, its bounds and its source.

The dataclasses are frozen: a config is a value. Nothing else in the package
restates one of these numbers. `check` turns an impossible value or combination into
one sentence (`ConfigError`) before anything is built or written.

Sources: "paper n" is a section of the paper, "chosen" a number the paper does not give.
"""

import dataclasses
import itertools
import json
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

from mjx_balance.errors import InputError
from mjx_balance.robots.catalogue import Robot, RobotError, find_robot

T = TypeVar("T")

ACTION_AXES = 2  # roll and pitch, paper Eq. 3


class ConfigError(InputError):
    """A config that cannot be run; the message names the field and a remedy."""


def bounded(
    default: Any,
    *,
    least: float | None = None,
    above: float | None = None,
    most: float | None = None,
    below: float | None = None,
    empty: bool = False,
) -> Any:
    """A field whose value, or every entry of it, `check` holds within bounds.

    Args:
      default: the field's default.
      least: least value allowed.
      above: what it must be greater than.
      most: greatest value allowed.
      below: what it must be less than.
      empty: whether a tuple may be empty.
    """
    bounds = {"least": least, "above": above, "most": most, "below": below}
    return dataclasses.field(default=default, metadata={"bounds": bounds, "empty": empty})


@dataclasses.dataclass(frozen=True)
class TaskConfig:
    """The control problem (paper section 3)."""

    sim_dt: float = bounded(0.004, above=0, most=1)
    """Physics step, s (paper 3.1)."""
    ctrl_dt: float = bounded(0.2, above=0, most=10)
    """One decision, s (paper 3.1: 5 Hz)."""
    body_height: float = bounded(0.35, above=0)
    """Standing height of the trunk above the board, foot radius included, m (paper 3.1)."""
    max_incline: float = bounded(7.0, above=0, below=45)
    """Greatest board tilt, deg (paper 3.1)."""
    board_rate: float = bounded(3.5, above=0)
    """Board speed on each axis, deg/s (paper 3.1)."""
    square_share: float = bounded(0.0, least=0, most=1)
    """Share of training targets drawn from the whole square of both axes, each uniform in
    +-max_incline, instead of the paper's disc (paper: none)."""
    target_period: float = bounded(10.0, above=0)
    """Time between board targets, s (paper 3.1)."""
    fail_tilt: float = bounded(6.0, above=0, below=90)
    """Body tilt that counts as a fall, deg (paper 3.1)."""
    action_max: float = bounded(0.003, above=0)
    """Greatest height change of one decision on one axis, m (paper Eq. 3)."""
    action_levels: int = bounded(21, least=3, most=201)
    """Height changes per axis (paper Eq. 3: n = 0..20)."""
    action_ramp: float = bounded(0.1, above=0, most=1)
    """Share of a decision in which the legs reach their new heights (chosen: the gyro then
    reads the board's own rate before the next decision; benchmarks/README.md)."""
    gyro_lags: tuple[int, ...] = bounded((0, 1, 2, 3, 4, 5), least=0, most=10_000)
    """Gyro samples in the observation, physics steps back (paper Eq. 2)."""
    accel_lags: tuple[int, ...] = bounded((0, 2, 4, 6, 8, 10, 12, 14, 15), least=0, most=10_000)
    """Accelerometer samples in the observation, physics steps back (paper Eq. 2)."""
    imu_mean: int = bounded(1, least=1, most=10_000)
    """IMU samples whose mean is one input, back from its lag (paper Eq. 2: 1)."""
    command_lags: tuple[int, ...] = bounded((), least=0, most=1_000, empty=True)
    """Decisions back whose commanded foot heights enter the network too: beside the measured
    ones they show late actions and legs that give way (paper Eq. 2: none)."""
    height_scale: float = bounded(0.01, least=1e-6)
    """Foot height, less the standing height, that enters the network as 1, m (chosen)."""
    gyro_scale: float = bounded(math.radians(1.0), least=1e-6)
    """Angular rate that enters the network as 1, rad/s (chosen: 1 deg/s)."""
    accel_scale: float = bounded(9.81 * math.sin(math.radians(1.0)), least=1e-6)
    """Acceleration that enters the network as 1, m/s^2 (chosen: 1 deg of tilt)."""
    reward_tilt: Literal["end", "mean"] = "end"
    """Tilt that is rewarded: at the decision's end (paper 3.2: in the new state), or the mean
    over its physics steps."""
    reward_level: float = bounded(0.4, least=-1e6, most=1e6)
    """Reward for a level body (paper Eq. 4)."""
    reward_sharpness: float = bounded(1.5, least=0)
    """Decay of that reward with the body tilt, 1/deg (paper Eq. 4)."""
    reward_toward: float = bounded(0.4, least=-1e6, most=1e6)
    """Greatest reward for moving toward the horizontal (paper Fig. 5; height chosen)."""
    reward_toward_scale: float = bounded(1.0, least=1e-6)
    """Change of tilt that earns it, deg (paper Fig. 5; scale chosen)."""
    reward_fail: float = bounded(-0.5, least=-1e6, most=1e6)
    """Added on a fall (paper 3.2)."""
    episode_length: int = bounded(300, least=1, most=1_000_000)
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

    gyro_noise: float = bounded(0.0, least=0)
    """Standard deviation of every gyro sample, rad/s."""
    accel_noise: float = bounded(0.0, least=0)
    """Standard deviation of every accelerometer sample, m/s^2."""
    payload: float = bounded(0.0, least=0)
    """Greatest mass carried on the trunk, kg."""
    payload_offset: float = bounded(0.05, least=0)
    """Greatest distance of the payload from the trunk's centre on either axis, m (chosen)."""
    payload_height: float = 0.08
    """Height of the payload above the trunk's centre, m (chosen)."""
    friction_min: float | None = bounded(None, above=0)
    """Least sliding friction of the feet; none: foot_friction."""
    friction_max: float | None = bounded(None, above=0)
    """Greatest sliding friction of the feet; none: foot_friction."""
    gain_spread: float = bounded(0.0, least=0, below=1)
    """Servo gains differ by up to this share."""
    latency_share: float = bounded(0.0, least=0, most=1)
    """Share of the envs that take every action one decision late."""
    push_min: float = bounded(0.0, least=0)
    """Least speed that a kick gives the trunk, m/s."""
    push_max: float = bounded(0.0, least=0)
    """Greatest speed that a kick gives the trunk, m/s; 0: no kicks."""
    push_period: float = bounded(5.0, above=0)
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

    gamma: float = bounded(0.1, least=0, most=1)
    """Discount (paper 3.2)."""
    learning_rate: float = bounded(1e-5, above=0)
    """Adam step size (paper 3.2)."""
    learning_rate_end_share: float = bounded(1.0, least=0)
    """Share of it that is left at the end of a cosine decay over the run (paper: constant)."""
    batch_size: int = bounded(32, least=1)
    """Transitions per gradient step (chosen)."""
    replay_ratio: float = bounded(32.0, above=0)
    """Transitions replayed per new one: batch_size times gradient steps over env steps (a DQN
    makes one gradient step per decision)."""
    replay_capacity: int = bounded(131_072, least=1)
    """Transitions kept, rounded down to whole batches of num_envs (chosen)."""
    min_replay_size: int = bounded(4_096, least=1)
    """Transitions stored before learning begins (chosen)."""
    target_update_period: int = bounded(1_000, least=1)
    """Gradient steps between copies into the target network (chosen)."""
    epsilon_start: float = bounded(1.0, least=0, most=1)
    """Share of random actions at first (chosen)."""
    epsilon_end: float = bounded(0.05, least=0, most=1)
    """Share of random actions after the decay (chosen)."""
    epsilon_decay_steps: int = bounded(50_000, least=1)
    """Env steps over which epsilon falls linearly (chosen)."""
    exploration_noise: int = bounded(0, least=0)
    """Levels by which every training action is moved at random on each axis (chosen: none)."""
    hidden_sizes: tuple[int, ...] = bounded((256, 256), least=1, most=65_536)
    """Widths of the Q-network's hidden layers (chosen)."""
    head: Literal["joint", "factored", "radial"] = "joint"
    """How the network makes action values (dqn/networks.py): one output per action, one per
    level and axis, added up, or a best action and a profile around it."""
    whiten_steps: int = bounded(0, least=0)
    """Env steps in which the inputs' covariance is gathered, to whiten them by; 0: inputs are
    taken as they are (paper)."""
    whiten_floor: float = bounded(1e-3, above=0)
    """Variance added to every direction, so that none is blown up beyond measure (chosen)."""
    mirror: bool = False
    """Learn from reflections of the transitions too (task/symmetry.py; paper: none)."""
    double: bool = False
    """Double DQN (van Hasselt et al. 2015) instead of Eq. 1's max over the target network."""
    huber_delta: float | None = bounded(None, above=0)
    """TD error from which on the loss grows linearly (Mnih et al. 2015); none: it is squared
    throughout (chosen)."""
    max_grad_norm: float = bounded(10.0, above=0)
    """Global-norm gradient clipping (chosen)."""

    def updates_per_step(self, num_envs: int) -> int:
        """Gradient steps after each decision of all envs: replay_ratio * num_envs / batch_size."""
        return round(self.replay_ratio * num_envs / self.batch_size)


@dataclasses.dataclass(frozen=True)
class Config:
    """A whole run.

    A bare one has the paper's values; `preset` returns the others by name, and `fitted` makes one
    for another robot.
    """

    preset: str = "paper"
    """Where the other values start from."""
    seed: int = bounded(0, least=0)
    """Seed of everything random."""
    num_envs: int | None = bounded(None, least=1)
    """Envs simulated at once; none: sized to the device."""
    num_seeds: int = bounded(1, least=1)
    """Runs trained at once in one program, with seeds `seed`, `seed + 1`, ..."""
    sweep: tuple[str, ...] = ()
    """Numbers of the learner to try, as `learning_rate=0.001,0.003`: every combination is trained
    with `num_seeds` seeds, all in one program."""
    num_env_steps: int = bounded(200_000, least=1)
    """Decisions of a run, over all envs (paper 4: about 200k)."""
    num_devices: int | None = bounded(None, least=1)
    """JAX devices to spread the envs over; none: one per CPU core, or all accelerators."""
    log_every: int = bounded(1_024, least=1)
    """Env steps between two lines of metrics."""
    checkpoint_seconds: float = bounded(45.0, above=0)
    """Time between two checkpoints, s."""
    eval_every: int = bounded(20_000, least=0)
    """Env steps between two validations of the greedy policy during training, in whole calls of
    `log_every`; the end of the run is validated too. 0: never."""
    validation_scenarios: int = bounded(4, least=1)
    """Scenarios per suite of each of them (chosen: they take less than 5% of a run)."""
    validation_duration: float = bounded(20.0, above=0)
    """Length of each of these scenarios, s."""
    export: Literal["last", "best"] = "last"
    """Which policy the run hands out: that of its end, or the one that validated best."""
    eval_scenarios: int = bounded(128, least=1)
    """Scenarios per suite of the evaluation after training."""
    eval_duration: float = bounded(60.0, above=0)
    """Length of each of them, s."""
    engine: Literal["mjx", "mujoco", "warp"] = "mjx"
    """Physics of the training: MJX, on any device; MuJoCo's C engine, on CPUs; or MJX-Warp, on
    NVIDIA GPUs, whose steps do not repeat bit for bit."""
    robot: str = "quadruped"
    """The robot: a shipped one's name, a TOML file that describes yours, or menagerie:NAME."""
    solver_iterations: int = bounded(4, least=1, most=1_000)
    """Newton iterations of a physics step of engines `mjx` and `warp`; `mujoco` goes on until it
    has converged. A batch waits for its slowest env, but fewer do not converge when a random policy
    lifts a foot: with one, robots jump (benchmarks/README.md)."""
    line_search_iterations: int = bounded(6, least=1, most=1_000)
    """Line-search iterations of each of them."""
    task: TaskConfig = dataclasses.field(default_factory=TaskConfig)
    randomization: RandomizationConfig = dataclasses.field(default_factory=RandomizationConfig)
    dqn: DQNConfig = dataclasses.field(default_factory=DQNConfig)


_LAST_600_MS = tuple(range(0, 150, 5))
_TASK = TaskConfig(square_share=0.5, reward_tilt="mean", reward_toward=1.0, reward_toward_scale=2.5)
_DQN = DQNConfig(
    learning_rate=1e-2,
    learning_rate_end_share=1 / 300,
    batch_size=256,
    replay_ratio=32,
    min_replay_size=1_024,
    target_update_period=200,
    epsilon_decay_steps=5_000,
    exploration_noise=2,
    hidden_sizes=(64, 64),
    head="radial",
    mirror=True,
    whiten_steps=50_000,
)

PRESETS: Mapping[str, Config] = {
    # 64 envs: about what two cores step at the rate at which they learn.
    "paper": Config(preset="paper", num_envs=64),
    "default": Config(preset="default", num_env_steps=40_000, task=_TASK, dqn=_DQN),
    # All IMU samples of the last three decisions, as means over 20 ms, and these decisions'
    # commands, under noise of a data sheet, payloads, late actions and kicks: what `default` reads
    # off tiny differences, this one has to average. The greater gamma is for the late actions.
    "best": Config(
        preset="best",
        num_env_steps=200_000,
        log_every=2_048,
        task=dataclasses.replace(
            _TASK,
            gyro_lags=_LAST_600_MS,
            accel_lags=_LAST_600_MS,
            imu_mean=5,
            command_lags=(0, 1, 2),
        ),
        randomization=RandomizationConfig(
            gyro_noise=0.002,
            accel_noise=0.023,
            payload=5.0,
            latency_share=0.15,
            push_max=0.4,
            push_period=2.5,
        ),
        # `default`'s smaller batches at a higher rate cost an eighth of `corner`'s mean tilt here.
        # Nobody can foresee a kick or a late action: squared, their TD errors drown all others.
        dqn=dataclasses.replace(
            _DQN,
            gamma=0.4,
            learning_rate=3e-3,
            batch_size=512,
            replay_ratio=64,
            min_replay_size=2_048,
            epsilon_decay_steps=10_000,
            whiten_floor=0.02,
            huber_delta=0.03,
        ),
    ),
    # Few decisions, each replayed often: a policy that balances within seconds.
    "quick": Config(
        preset="quick",
        num_env_steps=8_192,
        eval_every=0,
        task=_TASK,
        dqn=dataclasses.replace(_DQN, replay_ratio=128, epsilon_decay_steps=3_000),
    ),
    "smoke": Config(
        preset="smoke",
        num_envs=64,
        num_env_steps=8_192,
        log_every=1_024,
        eval_every=4_096,
        validation_scenarios=2,
        validation_duration=10.0,
        eval_scenarios=16,
        eval_duration=20.0,
        task=_TASK,
        dqn=dataclasses.replace(
            _DQN,
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


def fitted(config: Config, robot: str) -> Config:
    """`config`, of our own robot, for another: what depends on mass and size goes along.

    Standing height and greatest height change are the robot's own (`robots.measuring`). Angles, the
    board's rate and the fall limit stay the paper's. To replace `robot` alone leaves it with the
    height, the height changes and the loads of another.

    Raises:
      ConfigError: if there is no such robot.
    """
    try:
        found = find_robot(robot)
    except RobotError as error:
        raise ConfigError(str(error)) from error
    task = dataclasses.replace(
        config.task,
        body_height=found.body_height,
        action_max=found.action_max,
        height_scale=config.task.height_scale * found.size_scale,
    )
    ranges = scaled_to(config.randomization, found)
    return dataclasses.replace(config, robot=robot, task=task, randomization=ranges)


def scaled_to(ranges: RandomizationConfig, robot: Robot) -> RandomizationConfig:
    """Loads by the robot's mass, their places and the kicks' speeds by its size."""
    return dataclasses.replace(
        ranges,
        payload=ranges.payload * robot.mass_scale,
        payload_offset=ranges.payload_offset * robot.size_scale,
        payload_height=ranges.payload_height * robot.size_scale,
        push_min=ranges.push_min * robot.size_scale,
        push_max=ranges.push_max * robot.size_scale,
    )


def greatest_incline(task: TaskConfig, robot: Robot) -> float:
    """Board angle on both axes at once that the legs' stroke can follow, deg."""
    lowest, highest = robot.height_range
    room = min(highest - task.body_height, task.body_height - lowest)
    return math.degrees(math.atan(room / (robot.half_length + robot.half_track)))


SWEEPABLE = (
    *("learning_rate", "learning_rate_end_share", "gamma", "huber_delta", "max_grad_norm"),
    *("epsilon_start", "epsilon_end", "epsilon_decay_steps"),
)
"""Fields of `DQNConfig` that only enter into sums and products."""


def combinations(config: Config) -> list[dict[str, float]]:
    """What a sweep tries, the last of its fields varying fastest; one empty one if there is none.

    Raises:
      ConfigError: naming the entry that is none.
    """
    fields: dict[str, list[float]] = {}
    for entry in config.sweep:
        name, _, listed = entry.partition("=")
        if name not in SWEEPABLE or name in fields:
            raise ConfigError(
                f"sweep is {shown(entry)}; it must name one of {', '.join(SWEEPABLE)}, each at "
                "most once, and its values, as gamma=0.1,0.4"
            )
        try:
            fields[name] = [float(value) for value in listed.split(",")]
        except ValueError as error:
            raise ConfigError(
                f"sweep is {shown(entry)}; after {name}= it must list numbers, as 0.1,0.4"
            ) from error
    tried = itertools.product(*fields.values())
    return [dict(zip(fields, values, strict=True)) for values in tried]


def members(config: Config) -> list[Config]:
    """The runs that are trained in one program, each as a config of its own.

    Their seeds follow each other, so that no two have one name.
    """
    found = []
    for values in combinations(config):
        whole = {
            k: int(v) if k == "epsilon_decay_steps" and v.is_integer() else v
            for k, v in values.items()
        }
        dqn = dataclasses.replace(config.dqn, **whole)
        for _ in range(config.num_seeds):
            seed = config.seed + len(found)
            own = dataclasses.replace(config, seed=seed, num_seeds=1, sweep=(), dqn=dqn)
            found.append(own)
    return found


def check(config: Config, robot: Robot | None = None) -> Config:
    """Returns `config` if it can be run; raises `ConfigError` with one sentence if not.

    Args:
      config: what is asked for.
      robot: what `config.robot` names, if that is known already.
    """
    if not isinstance(config, Config):
        raise ConfigError(
            f"config is {shown(config)}; it must be a Config, as `preset` and `fitted` return"
        )
    for section in (config, config.task, config.randomization, config.dqn):
        _check_fields(section)
    if config.preset not in PRESETS:
        preset(config.preset)
    if config.sweep:
        runs = members(config)
        for own in runs:
            _check_fields(own.dqn)
        if len(runs) == 1:
            raise ConfigError(
                f"sweep is {shown(config.sweep)}, which is one run; give it more values, or set "
                "num_seeds to 2 or more"
            )
    if config.seed + len(combinations(config)) * config.num_seeds > 2**31:
        raise ConfigError(f"seed is {config.seed}; the last of all seeds must be less than 2**31")
    try:
        robot = robot or find_robot(config.robot)
    except RobotError as error:
        raise ConfigError(str(error)) from error
    _check_timing(config.task)
    _check_reach(config.task, robot)
    _check_learning(config)
    if config.export == "best" and not config.eval_every:
        raise ConfigError(
            "export is 'best', but eval_every is 0, so that nothing is validated to choose from; "
            "eval_every must be at least 1, or export last"
        )
    least, most = config.randomization.friction_min, config.randomization.friction_max
    if (most or robot.foot_friction) < (least or robot.foot_friction):
        raise ConfigError(
            f"friction_max is {most or robot.foot_friction}; it must not be less than the least "
            f"friction, {least or robot.foot_friction}"
        )
    push_min, push_max = config.randomization.push_min, config.randomization.push_max
    if push_max < push_min:
        raise ConfigError(f"push_max is {push_max}; it must not be less than push_min, {push_min}")
    period, ctrl_dt = config.randomization.push_period, config.task.ctrl_dt
    if push_max and period < ctrl_dt:
        raise ConfigError(
            f"push_period is {period} s; it must not be shorter than ctrl_dt, {ctrl_dt} s"
        )
    return config


def _check_fields(section: Any) -> None:
    """Compares every field with its type and its bounds."""
    hints = typing.get_type_hints(type(section))
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        wanted = _mismatch(value, hints[field.name])
        if wanted:
            raise ConfigError(f"{field.name} is {shown(value)}; it must be {wanted}")
        bounds = field.metadata.get("bounds")
        if bounds is None or value is None:
            continue
        entries = value if isinstance(value, tuple) else (value,)
        if not entries and not field.metadata["empty"]:
            raise ConfigError(f"{field.name} is (); it must hold at least one number")
        for entry in entries:
            broken = _broken_bound(entry, **bounds)
            if broken:
                raise ConfigError(f"{field.name} is {shown(value)}; it must be {broken}")


def _mismatch(value: Any, hint: Any) -> str | None:
    """What a value of the type `hint` must be, if `value` is not of it."""
    options = typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return None if isinstance(value, hint) else "a section"  # pyright: ignore
    if typing.get_origin(hint) is types.UnionType:  # only `X | None` occurs
        return None if value is None else _mismatch(value, options[0])
    if typing.get_origin(hint) is Literal:
        return None if value in options else f"one of {', '.join(options)}"
    if typing.get_origin(hint) is tuple:
        good = isinstance(value, tuple) and not any(_mismatch(x, options[0]) for x in value)
        return None if good else "whole numbers" if options[0] is int else "texts"
    if hint is float:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        # A float that is none, or an int beyond every float, is no number to compute with.
        return None if number and abs(value) < 1e300 else "a finite number"
    names = {int: "a whole number", bool: "true or false", str: "a name"}
    return None if type(value) is hint else names[hint]


def _broken_bound(
    value: float, least: float | None, above: float | None, most: float | None, below: float | None
) -> str | None:
    """The bound that `value` breaks, in words."""
    if least is not None and value < least:
        return f"at least {least}"
    if above is not None and value <= above:
        return f"greater than {above}"
    if most is not None and value > most:
        return f"at most {most}"
    if below is not None and value >= below:
        return f"less than {below}"
    return None


def shown(value: Any) -> str:
    """A value in a message, cut short: an endless one would hide the sentence."""
    try:
        text = repr(value)
    except ValueError:  # an int of too many digits
        text = "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:77]}..."


def _check_timing(task: TaskConfig) -> None:
    steps = task.ctrl_dt / task.sim_dt
    if not 1 <= round(steps) <= 10_000 or abs(steps - round(steps)) > 1e-6:
        raise ConfigError(
            f"ctrl_dt is {task.ctrl_dt} s; it must be a whole multiple of sim_dt, {task.sim_dt} s, "
            "at most 10000 times as long"
        )
    if task.action_levels % 2 == 0:
        raise ConfigError(
            f"action_levels is {task.action_levels}; it must be odd, so that standing still is an "
            "action"
        )
    ramp = 2 * task.max_incline / task.board_rate
    if ramp > task.target_period:
        raise ConfigError(
            f"target_period is {task.target_period} s, but a board ramp may last twice the "
            f"greatest incline over board_rate, {ramp:g} s; the period must not be shorter"
        )


def _check_reach(task: TaskConfig, robot: Robot) -> None:
    lowest, highest = robot.height_range
    limit = greatest_incline(task, robot)
    if limit <= 0:
        raise ConfigError(
            f"body_height is {task.body_height} m; the legs reach from {lowest:.3f} to "
            f"{highest:.3f} m"
        )
    if task.max_incline > limit:
        raise ConfigError(
            f"max_incline is {task.max_incline} deg; on both axes at once the legs, from "
            f"body_height {task.body_height} m, reach at most {limit:.1f} deg"
        )


def _check_learning(config: Config) -> None:
    dqn, num_envs = config.dqn, config.num_envs
    if num_envs is not None and dqn.replay_capacity < num_envs:
        raise ConfigError(
            f"replay_capacity is {dqn.replay_capacity}; it must hold at least one decision of "
            f"all num_envs = {num_envs} envs"
        )
    if dqn.min_replay_size > dqn.replay_capacity:
        raise ConfigError(
            f"min_replay_size is {dqn.min_replay_size}; it must not exceed replay_capacity, "
            f"{dqn.replay_capacity}"
        )
    if num_envs is not None:
        updates = dqn.replay_ratio * num_envs / dqn.batch_size
        if round(updates) < 1 or abs(updates - round(updates)) > 1e-6:
            raise ConfigError(
                f"replay_ratio is {dqn.replay_ratio:g}: with num_envs {num_envs} and batch_size "
                f"{dqn.batch_size} that makes {updates:g} gradient steps after each decision of "
                "all envs; it must be a whole number of them"
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
        raise ConfigError(f"{kind.__name__} is {shown(values)}; it must map its fields to values")
    fields = {f.name: f for f in dataclasses.fields(kind)}  # pyright: ignore[reportArgumentType]
    unknown = sorted(map(str, set(values) - set(fields)))
    if unknown:
        raise ConfigError(f"unknown field {shown(unknown[0])} in {kind.__name__}")
    built = {}
    for name, value in values.items():
        section = _SECTIONS.get(name)
        if section is not None:
            value = from_dict(section, value)
        elif isinstance(value, list):
            value = tuple(value)
        built[name] = value
    return kind(**built)


_SECTIONS = {"task": TaskConfig, "randomization": RandomizationConfig, "dqn": DQNConfig}
