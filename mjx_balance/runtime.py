"""Runs a policy on a robot: from IMU and joint angles to joint position targets. NumPy only.

This file needs no other file of the package. Copy it to the robot, beside a policy file::

    controller = Controller("policy.safetensors")  # joints: controller.joints
    ...  # first move the legs to controller.targets, where the robot stands
    while True:  # once per IMU sample, 250 Hz
        targets = controller.step(joint_positions, gyro, accelerometer)

The targets follow from kinematics alone. If the servos sag under the robot's weight, add their trim
to the targets, as the simulation adds `scene.stance.leg_trim`; servos with an integral term need
none.

The controller holds when a reading is impossible, or when the robot no longer balances: the targets
then stay the same until `reset`. The robot must be back at its standing height before `reset`; with
`gains`, below, it must lie. The servos need a watchdog in case the loop stops.

Servos whose gains can be set let the robot stand up from where it lies, and lie down softly after
a fall::

    controller = Controller("policy.safetensors", gains=True)  # PASSIVE
    while True:
        if button:
            controller.stand()
        targets = controller.step(joint_positions, gyro, accelerometer)
        send(targets, controller.stiffness, controller.damping, controller.torque)

The manifest of the policy file describes the network's inputs row by row (`inputs`), so that this
file needs no config.

Python 3.8 or newer.
"""

from __future__ import annotations

import enum
import json
import math
import os
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

FORMAT, FORMAT_VERSION = "mjx_balance.policy", 5
REMEDY = "; `mjx-balance export OLD.safetensors --out NEW.safetensors` converts it"
ACTIONS = ("grid", "continuous")
"""Kinds of commands: rows of `actions.table_m`, or any within their range."""
SENSORS = ("gyro", "accelerometer")
ARGUMENTS = ("joint_positions", *SENSORS)  #: of `step`
LOADS, UNITS = ("torques", "temperatures"), ("N m", "deg C")  #: also arguments of `step`
IMU = 6  #: gyro x, y and z, accelerometer x, y and z
MOST_BYTES = 64 * 2**20  #: greatest size of a policy file
MOST_HEADER = 8 * 2**20  #: greatest size of its header
MOST_MANIFEST = 4 * 2**20  #: greatest size of its manifest, characters
MOST_MESSAGE, MOST_PATH, MOST_NAME = 300, 150, 100  #: greatest lengths of texts, characters
MOST_WEIGHTS, MOST_LEGS, MOST_LAYERS, MOST_FACTORS = 1_000, 16, 64, 8
MOST_SAMPLES = 10_000  #: greatest number of samples per decision
SCALES = (float(np.float32(1e-6)), 1e6)  #: bounds of an input's scale; they keep inputs finite
MOST_TURN = 16.0  #: greatest turn of a joint at angle 0, rad; two and a half turns are 15.7
MOST_WHOLE = 100_000  #: bound of a manifest's numbers
MOMENTARY = ("height",)  #: sensors with one sample per decision and no history
TIMES = (1e-6, 10_000.0)  #: bounds of an input's time constant, s
STANDING_S = 1.0  #: time for which the first sample counts in a leaky mean, s
MOST_READ = 1_000_000  #: greatest number of samples that all inputs together average
GYRO_MOST = 35.0  #: greatest gyro reading, rad/s; the widest usual range is 2,000 deg/s
ACCEL_MOST = 160.0  #: greatest accelerometer reading, m/s^2; a usual range is 16 g
WEIGHT = (0.5 * 9.81, 1.5 * 9.81)  #: norm of the mean acceleration, m/s^2; pushes give 9.2 to 11
LEAN_MOST = 40.0  #: greatest angle of it from z, deg; a fall has 6, but a push can look like 29
AWAY_MOST = 0.5  #: greatest error of a joint at a decision, rad; pushes give 0.03
KNEE_SLACK = 0.1  #: tolerance of a knee's reading beyond its stops, rad
LYING_SLACK = 0.3  #: the same before and after balancing: a robot that lies presses on its stops
STUCK_MOST = 0.1  #: greatest motion of a target while its joint's reading stays the same, rad
RECENT = (10, 50)  #: bounds of the number of IMU samples that are checked for repetitions
LIVELY = 1 / 3  #: least share of different ones; there the mean tilt is a fifth greater
LIVELY_SENSOR = 1 / 5  #: least share of new values of gyro or accelerometer, of a robot that moves
MOVED_LEAST = 0.003  #: motion of a joint that every gyro notices, rad; one still has few values
LATE_SAMPLES = 5  #: greatest gap between calls, and error of a decision's length
MOST_CALLS = 64  #: greatest number of calls per sample of the policy
GAIN_RISE_S = 1.0  #: time in which the stiffness comes up before the robot stands up, s
STAND_SPEED = 1.0  #: greatest speed of a joint's target while it stands up, rad/s
STEEPEST = 15 / 8  #: greatest slope of x^3 (10 - 15 x + 6 x^2), the path's share of the way
LEAST_MOVE_S = 0.5  #: least time of a move, so that a short one is no jerk, s
STILL_RATE = 0.1  #: greatest gyro reading of a robot that stands still, rad/s
TILT_MOST = 20.0  #: greatest tilt by the quaternion, deg; board and body together have 13 at most
NORM_ERROR = 0.1  #: greatest error of a quaternion's norm
TORQUE_SHARE = 0.95  #: greatest mean torque of a decision, as a share of the robot's limit
TRIM_MOST = 1.0  #: greatest trim of a joint, rad; those of the shipped robots are below 0.2
LOG_S, MOST_LOG = 60.0, 60_000  #: length of the log, s, and its greatest number of samples
LOG_VERSION = 1


class PolicyFileError(ValueError):
    """Unusable policy file; the message says why."""


class State(str, enum.Enum):
    """State of a controller."""

    __str__ = str.__str__

    STANDING = "standing"  #: before the first sample; the targets are those of the standing robot
    BALANCING = "balancing"  #: the policy controls the robot
    HOLDING = "holding"  #: targets and gains stay the same until `reset`
    PASSIVE = "passive"  #: no gains; the targets follow the joints until `stand`
    STANDING_UP = "standing_up"  #: the targets move to the standing pose, until the robot is still
    DAMPING = "damping"  #: until `reset` the legs only damp; without stiffness and torque


class Fault(enum.IntEnum):
    """What is wrong; `RESPONSES` gives the state that follows."""

    NONE = 0
    HELD = 1  #: the program called `hold`
    DAMPED = 2  #: the program called `damp`
    READING = 3  #: not a number, a wrong shape, or outside a sensor's range
    CLOCK = 4  #: the clock does not give a finite time
    LATE = 5  #: a sample came too late, or before the last one
    RATE = 6  #: the samples of a decision came at a wrong rate
    STALE = 7  #: the IMU repeats old samples
    STUCK = 8  #: a joint's reading stays the same while its target moves
    NETWORK = 9  #: the network gives values that are not finite
    WEIGHT = 10  #: the mean acceleration is far from 9.81 m/s^2
    LEAN = 11  #: the mean acceleration leans too far
    TUMBLING = 12  #: the mean angular rate is that of a fall
    TILT = 13  #: the quaternion is tilted too far
    AWAY = 14  #: a joint is far from its target
    TORQUE = 15  #: a servo is at its torque limit
    TEMPERATURE = 16  #: a servo is too hot


RESPONSES = {
    # The robot stands as before and only lacks knowledge: on stiff legs it stays upright.
    **dict.fromkeys(
        (Fault.HELD, Fault.READING, Fault.CLOCK, Fault.LATE, Fault.RATE, Fault.STALE), State.HOLDING
    ),
    **dict.fromkeys((Fault.STUCK, Fault.NETWORK), State.HOLDING),
    # It falls or lies, or a servo works against something: stiff legs would do harm.
    **dict.fromkeys((Fault.DAMPED, Fault.WEIGHT, Fault.LEAN, Fault.TUMBLING), State.DAMPING),
    **dict.fromkeys((Fault.TILT, Fault.AWAY, Fault.TORQUE, Fault.TEMPERATURE), State.DAMPING),
}
"""Fault -> state, if the servos obey the gains; if not, every fault leads to HOLDING."""


class _Unsafe(Exception):
    """A fault, and the reason in a sentence."""

    def __init__(self, fault: Fault, reason: str) -> None:
        super().__init__(reason)
        self.fault = fault


class Controller:
    """Runs a policy, sample by sample.

    The first sample fills the history: the robot must have been standing still. The controller
    decides at the first sample and then every `decision_samples` samples; in between the legs
    follow their ramp. Observations and targets equal those of training.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        clock: Callable[[], float] = time.monotonic,
        *,
        gains: bool = False,
        sample_rate: float | None = None,
        max_torque: Any = None,
        max_temperature: float = math.inf,
    ) -> None:
        """Reads a policy file; the state is then STANDING, or with `gains` PASSIVE.

        Args:
          path: of the policy file.
          clock: returns the current time, s; in simulation, pass the simulation's.
          gains: whether the servos obey `stiffness`, `damping` and `torque`. If not, they
            follow the targets alone, and every fault leads to HOLDING.
          sample_rate: rate at which `step` is called, Hz, a whole multiple of the rate in
            training; None: that rate. The IMU's samples are then averaged, so that vibrations above
            half the rate in training do not look like slow motions; of joint readings, the last
            one counts.
          max_torque: greatest mean torque of a joint over a decision, N m, one or (legs, 3); None:
            `TORQUE_SHARE` of the robot's own limits.
          max_temperature: greatest mean temperature of a servo over a decision, deg C.

        Raises:
          PolicyFileError: if the file is missing, damaged, or not a policy that this file can run,
            or with `gains`, if it does not give the robot's gains.
          ValueError: for a sample rate that is no such multiple.
        """
        try:
            content = _content(Path(path))
            self.model = model = Model(content)
            if gains and model.gains is None:
                raise PolicyFileError("it does not say the stiffness and damping of its servos")
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            name = _line(path, MOST_PATH)
            message = _line(f"{name} cannot be used: {_reason(error)}", MOST_MESSAGE)
            raise PolicyFileError(message) from error
        self.manifest = model.manifest
        self.joints = model.joints
        """Names of the abduction, hip and knee joints of every leg, in the order of `step`."""
        self.sample_dt = model.sample_dt
        """Time between two IMU samples, s."""
        self.decision_samples = model.decision_samples
        """IMU samples per decision."""
        self._clock, self._obeyed = clock, gains
        self._per_sample = self._calls_per_sample(sample_rate)
        legs = len(self.joints)
        limits = model.torque_limits if max_torque is None else max_torque
        torques = np.broadcast_to(limits, (legs, 3)).ravel()
        self._most_loads = np.stack((torques, np.full(3 * legs, max_temperature)))
        # Joints at the decisions of the time that is checked for repetitions.
        decisions = -(-model.recent // self.decision_samples)
        self._poses: deque[np.ndarray] = deque(maxlen=decisions)
        # The history up to the last decision, then the samples since.
        self._imu = np.empty((model.history + self.decision_samples, IMU))
        self._commands = np.empty((model.inputs.lookback("command"), legs))
        self._reading = np.zeros_like(model.most)
        size = min(math.ceil(LOG_S / self.sample_dt), MOST_LOG)
        self._log = _Log(size, legs, content)
        self.reset()

    def _calls_per_sample(self, rate: float | None) -> int:
        if rate is None:
            return 1
        calls = rate * self.sample_dt
        if not 1 <= round(calls, 6) <= MOST_CALLS or abs(calls - round(calls)) > 1e-6 * calls:
            raise ValueError(
                f"sample_rate is {rate:g} Hz; it must be a whole multiple of the policy's "
                f"{1 / self.sample_dt:g} Hz, at most {MOST_CALLS} times that"
            )
        return round(calls)

    @property
    def targets(self) -> np.ndarray:
        """(legs, 3) joint targets, rad, as `step` returned last; at first the standing pose."""
        return self._targets.copy()

    @property
    def stiffness(self) -> np.ndarray | None:
        """(legs, 3) position gains of the servos, N m / rad; None if the file does not say them."""
        return None if self.model.gains is None else self._stiff * self.model.gains[0]

    @property
    def damping(self) -> np.ndarray | None:
        """(legs, 3) damping of the servos, N m s / rad; None if the file does not say it."""
        return None if self.model.gains is None else float(self._damped) * self.model.gains[1]

    @property
    def torque(self) -> np.ndarray | None:
        """(legs, 3) feed-forward torque, N m, which bears the standing robot's weight.

        It replaces the trim of the targets. None if the file does not say the trim.
        """
        if self.model.gains is None or self.model.trim is None:
            return None
        return self._loaded * self.model.gains[0] * self.model.trim

    def reset(self) -> None:
        """Starts again in state STANDING, or PASSIVE if the servos obey the gains.

        In state STANDING the robot must stand still at its standing height. PASSIVE has no gains: a
        robot that stands drops. First `damp` it until it lies.
        """
        self.state = State.PASSIVE if self._obeyed else State.STANDING
        self.fault = Fault.NONE  #: why it is HOLDING or DAMPING
        self.reason = ""  #: the same in a sentence
        self.action: int | None = None  #: index of the last action, or of the nearest on the grid
        self.command: np.ndarray | None = None  #: its height changes a_x and a_y, m
        self._commands[:] = self.model.height
        self._path = self.model.legs.joint_angles(self._commands[-1:])
        self._targets = self._path[0]
        self._since = self._seen = self._gaps = self._risen = 0
        self._called = self._decided = math.nan
        self._way: _Way | None = None
        self._follow = False  # the targets are not yet those of a robot that lies
        # Shares of stiffness and feed-forward torque, and whether the servos damp.
        self._stiff = self._loaded = 0.0 if self._obeyed else 1.0
        self._damped = not self._obeyed
        self._begin_sample()
        self._loads, self._load_counts = np.zeros_like(self._most_loads), [0, 0]

    def stand(self) -> None:
        """Stands up from the pose of the next sample, then balances; only PASSIVE or STANDING.

        The stiffness rises in `GAIN_RISE_S`. Then the feet move under the hips, and the legs lift
        the trunk to its standing height. Balancing begins when the robot is still: no gyro
        reading of a decision's samples is above `STILL_RATE`.

        Without `gains`, send no targets before the next sample: they are not those of its pose.
        """
        if self.state in (State.PASSIVE, State.STANDING):
            self.state, self.reason, self._damped = State.STANDING_UP, "", True
            self._follow = not self._obeyed

    def hold(self, reason: str) -> None:
        """Holds targets and gains until `reset`; does nothing if it already holds or damps."""
        self._stop(Fault.HELD, reason)

    def damp(self, reason: str) -> None:
        """Damps the legs without stiffness until `reset`; without `gains`, holds."""
        self._stop(Fault.DAMPED, reason)

    def save_log(self, path: str | os.PathLike[str]) -> None:
        """Writes the last 60 s to a file, as .npz; `mjx-balance replay` reads it.

        It ends with the sample that led to HOLDING, or to DAMPING, if need be after HOLDING; and it
        holds the policy file.

        Raises:
          OSError: if it cannot be written; an old file then stays.
        """
        file = Path(path)
        part = file.with_name(file.name + ".part")
        with part.open("wb") as stream:
            np.savez_compressed(stream, reason=np.asarray(self.reason), **self._log.arrays())
        part.replace(file)

    def step(
        self,
        joint_positions: np.ndarray,
        gyro: np.ndarray,
        accelerometer: np.ndarray,
        *,
        quaternion: np.ndarray | None = None,
        torques: np.ndarray | None = None,
        temperatures: np.ndarray | None = None,
    ) -> np.ndarray:
        """Processes a sample of the sensors; returns the joint targets until the next sample.

        It holds if a reading is not a number in a sensor's range, if a call comes too late, or if
        the sample rate is not that of training. At a decision it also holds if too many of the
        IMU's samples are repeated, if lean, angular rate or weight are not those of a balancing
        robot, or if a joint is far from its target. If the servos obey the gains, some of these
        lead to DAMPING (`RESPONSES`).

        Args:
          joint_positions: (legs, 3) abduction, hip and knee angles, rad, in the order of `joints`.
          gyro: (3,) rad/s; x forward, y left, z up.
          accelerometer: (3,) m/s^2, same axes; about (0, 0, 9.81) at rest.
          quaternion: (4,) orientation of the trunk in the world, w first, if the IMU gives it. It
            shows a fall at once; the accelerometer needs a mean, because pushes shake it.
          torques: (legs, 3) measured torques of the servos, N m.
          temperatures: (legs, 3) of the servos, deg C.

        Returns:
          (legs, 3) joint position targets, rad.

        Raises:
          ValueError: without `gains`, if an array of the first sample has another shape; later ones
            make it hold.
        """
        before = self.state
        sensors = joint_positions, gyro, accelerometer
        self._guard(self._process, sensors, quaternion, torques, temperatures)
        if self._obeyed and before in (State.HOLDING, State.DAMPING):
            # Each alone: a bad reading hides no fall that another one shows.
            self._guard(self._check_tilt, quaternion)
            self._guard(self._watch, accelerometer)
        if self.fault is not Fault.NONE and self.state is not before:
            self._record(start=False)
        return self._targets.copy()

    def _guard(self, check: Callable[..., None], *arguments: Any) -> None:
        """Calls a check; after a fault it holds or damps, or stays PASSIVE."""
        try:
            check(*arguments)
        except _Unsafe as unsafe:
            if self.state is State.PASSIVE:
                self.reason = _line(unsafe, MOST_MESSAGE)
            else:
                self._stop(unsafe.fault, str(unsafe))

    def _process(self, sensors: Any, *others: Any) -> None:
        """Reads a sample, and processes it if the controller neither holds nor damps."""
        self._read_sensors(*sensors)
        if self._follow:
            self._place()
        if self.state is State.PASSIVE:
            self._check_reading()
            self._place()
            self.reason = ""
        elif self.state in (State.HOLDING, State.DAMPING):
            self._called = self._time()
        else:
            self._take(self._time(), *others)

    def _stop(self, fault: Fault, reason: str) -> None:
        """Holds or damps; who holds may still damp."""
        response = RESPONSES[fault] if self._obeyed else State.HOLDING
        if self.state not in (response, State.DAMPING):
            self.state, self.fault, self.reason = response, fault, _line(reason, MOST_MESSAGE)
            if response is State.DAMPING:
                self._stiff, self._loaded, self._damped = 0.0, 0.0, True
            self._begin_sample()

    def _read_sensors(self, *arguments: np.ndarray) -> None:
        """Checks shapes, and copies all readings to `_reading`: joints, gyro, accelerometer."""
        joints, gyro, accel = map(_numeric, ARGUMENTS, arguments)
        if joints.shape != self._targets.shape or gyro.shape != (3,) or accel.shape != (3,):
            shapes = [_line(x.shape, 40) for x in (joints, gyro, accel)]
            sentence = (
                f"joint_positions, gyro and accelerometer have shapes {shapes[0]}, {shapes[1]} "
                f"and {shapes[2]}; they must be {self._targets.shape}, (3,) and (3,)"
            )
            if self.state is State.STANDING or (self.state is State.STANDING_UP and self._follow):
                raise ValueError(sentence)
            raise _Unsafe(Fault.READING, sentence)
        np.concatenate((joints.ravel(), gyro, accel), out=self._reading)

    def _time(self) -> float:
        try:
            now = float(self._clock())
        except Exception as error:  # whatever a clock raises, the legs stay where they are
            raise _Unsafe(Fault.CLOCK, f"the clock gives no time: {error}") from error
        if not math.isfinite(now):
            raise _Unsafe(Fault.CLOCK, f"the clock gives no time: it gives {now} s")
        return now

    def _begin_sample(self) -> None:
        """Forgets the calls since the policy's last sample."""
        self._calls, self._sum = 0, np.zeros(IMU)

    def _take(self, now: float, quaternion: Any, torques: Any, temperatures: Any) -> None:
        """Checks a call's readings; every `_per_sample` calls are a sample of the policy."""
        last, self._called = self._called, now
        self._check_reading()
        self._check_tilt(quaternion)
        first = self._way is None and self.state is not State.BALANCING
        if not first:
            self._check_time(now - last)
        self._add_load(0, torques)
        self._add_load(1, temperatures)
        if self._per_sample > 1:
            self._sum += self._reading[-IMU:]
            self._calls += 1
            if not first and self._calls < self._per_sample:
                return
            self._reading[-IMU:] = self._sum / self._calls
            self._begin_sample()
        balanced = self.state is State.BALANCING
        self._advance(now)
        self._record(self.state is State.BALANCING and not balanced)

    def _advance(self, now: float) -> None:
        """Takes a sample; checks and decides if that is due, and updates the targets."""
        imu = self._reading[-IMU:]
        if self.state is State.STANDING:
            self._fill(imu)
            self._check_posture()
            self._begin(now)
        elif self.state is State.STANDING_UP and self._way is None:
            self._fill(imu)
            self._way = self._plan_way()
            self._targets, self._decided = self._way.at(0)[0], now
            self._there = self._targets.ravel()
            self._check_posture()
        else:
            self._seen += 1
            self._imu[self.model.history + self._since] = imu
            self.model.inputs.means.add(imu)
            self._since += 1
            if self._since == self.decision_samples:
                self._end_decision(now)
        if self.state is State.BALANCING:
            self._targets = self._path[min(self._since, len(self._path) - 1)]
        elif self._way is not None:
            self._targets, stiff, self._loaded = self._way.at(self._risen)
            self._stiff = stiff if self._obeyed else 1.0
            self._risen += 1

    def _fill(self, imu: np.ndarray) -> None:
        """Fills the histories with a sample (6,) of a robot that is still."""
        self._imu[:] = imu
        self.model.inputs.means.start(imu)
        self._poses.clear()
        self._poses.append(self._reading[:-IMU].copy())
        self._there = self._targets.ravel()
        self._seen, self._gaps = 1, 0

    def _begin(self, now: float) -> None:
        """Begins to balance; the histories are filled."""
        self.state = State.BALANCING
        self._decide(now)

    def _end_decision(self, now: float) -> None:
        """Checks the samples since the last decision, and takes the next one."""
        self._check_rate(now)
        self._check_liveness()
        self._check_posture()
        self._check_loads()
        if self.state is State.BALANCING:
            self._decide(now)
            return
        samples = self._imu[self.model.history :]
        done = self._way is not None and self._risen > self._way.samples + self.decision_samples
        if done and (abs(samples[:, :3]) <= STILL_RATE).all():
            self._way = None
            self._reading[-IMU:] = samples.mean(axis=0)
            self._fill(self._reading[-IMU:])
            self._begin(now)
        else:
            self._next_decision(now)

    def _next_decision(self, now: float) -> None:
        self._imu[: self.model.history] = self._imu[-self.model.history :]
        self._since, self._decided = 0, now

    def _plan_way(self) -> _Way:
        """Plans to stand up: the feet come under the hips, then the legs become longer."""
        pose, low = self._pose(), self.model.legs.height_range[0]
        heights = self.model.legs.foot_heights(self._reading[:-IMU].reshape(pose.shape))
        height = min(max(float(heights.min()), low), self.model.height)
        crouch = self.model.legs.joint_angles(np.full(len(pose), height))
        return _Way(pose, crouch, self._path[0], self.sample_dt)

    def _place(self) -> None:
        """Makes the joints' readings the targets, where they are possible."""
        possible = self._possible()[:-IMU]
        self._targets = np.where(possible.reshape(-1, 3), self._pose(), self._targets)
        self._follow = not possible.all()

    def _pose(self) -> np.ndarray:
        """Joint angles (legs, 3), rad, of which a target may be made: within their range."""
        joints = np.clip(self._reading[:-IMU], self.model.least[:-IMU], self.model.most[:-IMU])
        return joints.reshape(-1, 3)

    def _watch(self, accelerometer: Any) -> None:
        """Checks that a robot that is HOLDING has not fallen; skips impossible readings."""
        values = _numeric("accelerometer", accelerometer).astype(float)
        if values.shape != (3,) or not (abs(values) <= ACCEL_MOST).all():
            return
        self._sum[3:] += values
        self._calls += 1
        if self._calls == self.decision_samples * self._per_sample:
            accel = (self._sum[3:] / self._calls).tolist()
            self._begin_sample()
            self._check_lean(accel)

    def _record(self, start: bool) -> None:
        """Logs the sample; `start`: it is the first of a balancing robot."""
        reading, none = self._reading, self.command is None
        self._log.add(
            (
                *(self._called, reading[:-IMU].reshape(-1, 3), reading[-IMU:-3], reading[-3:]),
                *(self._targets, math.nan if none else self.command, -1 if none else self.action),
                *(_CODES[self.state], self.fault),
                *(self.state is State.BALANCING and self._since == 0, start),
            )
        )

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest possible readings now."""
        stands = self.state in (State.STANDING, State.BALANCING)
        more = 0.0 if stands else self.model.lying
        return self.model.least - more, self.model.most + more

    def _possible(self) -> np.ndarray:
        """Whether each reading is a number within its bounds."""
        least, most = self._bounds()
        return (least <= self._reading) & (self._reading <= most)  # NaN is not

    def _check_reading(self) -> None:
        possible = self._possible()
        k = int(possible.argmin())
        if not possible[k]:
            least, most = self._bounds()
            raise _Unsafe(
                Fault.READING,
                f"{self._name(k)} reads {self._reading[k]:.3g}, which is not between "
                f"{least[k]:.3g} and {most[k]:.3g}",
            )

    def _name(self, k: int) -> str:
        """Name of reading `k`."""
        names = [name for leg in self.joints for name in leg]
        names += [f"{sensor} {axis}" for sensor in SENSORS for axis in "xyz"]
        return names[k]

    def _check_time(self, gap: float) -> None:
        most = LATE_SAMPLES * self.sample_dt
        if not 0 <= gap <= most:
            raise _Unsafe(
                Fault.LATE,
                f"a sample came {gap:.3g} s after the one before it; it must come within "
                f"{most:.3g} s",
            )

    def _check_rate(self, now: float) -> None:
        """Checks the sample rate since the last decision."""
        took, most = now - self._decided, LATE_SAMPLES * self.sample_dt
        if abs(took - self.model.decision_dt) > most:
            raise _Unsafe(
                Fault.RATE,
                f"{self.decision_samples} samples took {took:.3g} s; they must take "
                f"{self.model.decision_dt:.3g} s within {most:.3g}, as in training",
            )

    def _check_liveness(self) -> None:
        """Checks that the IMU's samples differ, and that joints move if their targets do."""
        recent = self._imu[-self.model.recent :]
        different = len(set(recent.view(f"V{recent.itemsize * IMU}")[:, 0].tolist()))
        self._check_new("IMU", different, len(recent), LIVELY)
        self._check_latest((recent[1:] != recent[:-1]).any(axis=1))
        joints, targets = self._reading[:-IMU], self._targets.ravel()
        if np.abs(joints - self._poses[0]).max() > MOVED_LEAST:
            since = self._imu[-max(self.model.recent, self.decision_samples) :]
            changed = (since[1:] != since[:-1]).reshape(-1, 2, 3).any(axis=2)
            for name, new in zip(SENSORS, (1 + changed.sum(axis=0)).tolist()):
                self._check_new(name, new, len(since), LIVELY_SENSOR)
        self._there = np.where(joints != self._poses[-1], targets, self._there)
        self._poses.append(joints.copy())
        moved = np.abs(targets - self._there)
        k = int(moved.argmax())
        if moved[k] > STUCK_MOST:
            raise _Unsafe(
                Fault.STUCK,
                f"{self._name(k)} reads {joints[k]:.3g} all the time, while its target moved by "
                f"{moved[k]:.2g} rad",
            )

    def _check_latest(self, new: np.ndarray) -> None:
        """Checks that the newest samples, of which the policy knows most, are no gap in bursts."""
        count = len(new) // 3
        latest, least = int(new[-count:].sum()), int(count * LIVELY)
        gap = latest < least and self.decision_samples >= self.model.recent
        self._gaps = self._gaps + 1 if gap else 0
        if self._gaps == 2:
            raise _Unsafe(
                Fault.STALE,
                f"the IMU repeats itself: at two decisions, one after the other, {latest} of its "
                f"last {count} samples are new; at least {least} must be",
            )

    def _check_new(self, name: str, new: int, count: int, share: float) -> None:
        """Checks that enough of a sensor's last `count` samples are new."""
        least = max(2, round(share * self.model.recent))
        if new < least and self._seen >= count:
            raise _Unsafe(
                Fault.STALE,
                f"the {name} repeats itself: {new} of its last {count} samples are new; at least "
                f"{least} must be",
            )

    def _check_posture(self) -> None:
        """Checks the mean of a decision's IMU samples, and the joints, for a balancing robot."""
        x, y, _, *accel = self._imu[self.model.history :].mean(axis=0).tolist()
        weight, rate = math.hypot(*accel), math.hypot(x, y)
        if not WEIGHT[0] <= weight <= WEIGHT[1]:
            raise _Unsafe(
                Fault.WEIGHT,
                f"the accelerometer gives {weight:.3g} m/s^2 in the mean of a decision; it must be "
                f"{WEIGHT[0]:.3g} to {WEIGHT[1]:.3g}, and 9.81 at rest",
            )
        self._check_lean(accel)
        # Who stands up may tip from its side onto its feet.
        if rate > self.model.rate_most and self.state is not State.STANDING_UP:
            raise _Unsafe(
                Fault.TUMBLING,
                f"the gyro gives {rate:.3g} rad/s about x and y in the mean of a decision, more "
                f"than {self.model.rate_most:.3g}: the robot falls, or these are no rad/s",
            )
        errors = np.abs(self._reading[:-IMU] - self._targets.ravel())
        k = int(errors.argmax())
        if errors[k] > AWAY_MOST:
            raise _Unsafe(
                Fault.AWAY,
                f"{self._name(k)} is {errors[k]:.3g} rad from its target, more than {AWAY_MOST:g}",
            )

    def _check_lean(self, accel: list[float]) -> None:
        """Checks a mean acceleration, m/s^2, for a robot that lies."""
        weight = math.hypot(*accel)
        lean = math.degrees(math.acos(min(max(accel[2] / max(weight, 1e-9), -1.0), 1.0)))
        if lean > LEAN_MOST:
            raise _Unsafe(
                Fault.LEAN,
                f"the accelerometer leans by {lean:.3g} deg in the mean of a decision, more than "
                f"{LEAN_MOST:g}: the robot has fallen, or up is not its z",
            )

    def _check_tilt(self, quaternion: Any) -> None:
        """Checks a quaternion, if given, for a robot that lies."""
        if quaternion is None:
            return
        values = _numeric("quaternion", quaternion)
        norm = math.hypot(*map(float, values)) if values.shape == (4,) else math.nan
        if not abs(norm - 1) <= NORM_ERROR:
            raise _Unsafe(
                Fault.READING, f"quaternion is {_line(values, 80)}, not four numbers of norm 1"
            )
        _, x, y, _ = map(float, values)
        tilt = math.degrees(math.acos(max(1 - 2 * (x * x + y * y) / norm**2, -1.0)))
        if tilt > TILT_MOST:
            raise _Unsafe(
                Fault.TILT,
                f"the quaternion is tilted by {tilt:.3g} deg, more than {TILT_MOST:g}: the robot "
                "has fallen, or up is not its z",
            )

    def _add_load(self, kind: int, values: Any) -> None:
        """Adds torques (kind 0) or temperatures (1) of the servos, if given."""
        if values is None:
            return
        array = _numeric(LOADS[kind], values)
        if array.shape != self._targets.shape:
            raise _Unsafe(
                Fault.READING,
                f"{LOADS[kind]} has shape {_line(array.shape, 40)}; it must be "
                f"{self._targets.shape}",
            )
        finite = np.isfinite(array).ravel()
        k = int(finite.argmin())
        if not finite[k]:
            raise _Unsafe(
                Fault.READING,
                f"{LOADS[kind]} of {self._name(k)} are {array.flat[k]}; they must be finite",
            )
        self._loads[kind] += abs(array.ravel())
        self._load_counts[kind] += 1

    def _check_loads(self) -> None:
        """Checks mean torques and temperatures of a decision's samples."""
        counts = np.maximum(self._load_counts, 1)[:, None]
        means, faults = self._loads / counts, (Fault.TORQUE, Fault.TEMPERATURE)
        self._loads, self._load_counts = np.zeros_like(self._loads), [0, 0]
        for mean, most, name, unit, fault in zip(means, self._most_loads, LOADS, UNITS, faults):
            sane = mean <= most
            k = int(sane.argmin())
            if not sane[k]:
                raise _Unsafe(
                    fault,
                    f"{name} of {self._name(k)} are {mean[k]:.3g} {unit} in the mean of a "
                    f"decision, more than {most[k]:.3g}",
                )

    def _decide(self, now: float) -> None:
        """Chooses an action, and computes its ramp of targets, `_path`."""
        self.action, best = self.model.network.greedy(self._observation())
        command = self.model.table[self.action].copy()
        if self.model.continuous:
            command = self.model.middle + self.model.half * best
        before = self._commands[-1].copy()
        after = self.model.legs.moved(before, command)
        self._commands[:-1] = self._commands[1:]
        self._commands[-1] = after
        self._path = self.model.legs.joint_angles(
            before * (1 - self.model.share) + after * self.model.share
        )
        self.command = command
        self._next_decision(now)

    def _observation(self) -> np.ndarray:
        return self.model.inputs.observe(
            {
                "height": self.model.legs.foot_heights(self._reading[:-IMU].reshape(-1, 3))[None],
                "command": self._commands,
                "gyro": self._imu[:, :3],
                "accelerometer": self._imu[:, 3:],
            }
        )


class _Way:
    """Way of the targets from a pose (legs, 3) over a crouch to another one, rad.

    It stays at the first pose while the stiffness comes up. The share of the way to the next pose
    is x^3 (10 - 15 x + 6 x^2) at the share x of its time: without speed and acceleration at both
    ends.
    """

    def __init__(self, pose: np.ndarray, crouch: np.ndarray, end: np.ndarray, dt: float) -> None:
        self._pose, self._fold, self._lift = pose, crouch - pose, end - crouch
        self._counts = [max(1, round(GAIN_RISE_S / dt))]
        for change in (self._fold, self._lift):
            seconds = max(STEEPEST * float(abs(change).max()) / STAND_SPEED, LEAST_MOVE_S)
            self._counts.append(max(1, math.ceil(seconds / dt)))
        self.samples = sum(self._counts)  #: until it ends

    def at(self, k: int) -> tuple[np.ndarray, float, float]:
        """Targets (legs, 3), rad, and the shares of stiffness and torque after `k` samples."""
        shares = []
        for count in self._counts:
            shares.append(min(max(k, 0) / count, 1.0))
            k -= count
        fold, lift = (x**3 * (10 - 15 * x + 6 * x * x) for x in shares[1:])
        return self._pose + fold * self._fold + lift * self._lift, shares[0], lift


class _Log:
    """The last samples, in a ring."""

    def __init__(self, size: int, legs: int, policy: bytes) -> None:
        joints, real = ("f8", (legs, 3)), ("f8", (3,))
        kinds = [("time", "f8"), ("joint_positions", *joints), ("gyro", *real)]
        kinds += [("accelerometer", *real), ("targets", *joints), ("command", "f8", (2,))]
        kinds += [("action", "i4"), ("state", "u1"), ("fault", "u1")]
        kinds += [("decision", "?"), ("start", "?")]
        self._rows, self._count = np.empty(size, kinds), 0
        self._kinds, self._policy = kinds, policy

    def add(self, row: tuple[Any, ...]) -> None:
        """Adds a sample: values in the order of the kinds."""
        self._rows[self._count % len(self._rows)] = row
        self._count += 1

    def arrays(self) -> dict[str, Any]:
        """All samples by name, the oldest first, with what explains them."""
        rows = np.roll(self._rows, -self._count) if self._count > len(self._rows) else self._rows
        rows = rows[: self._count]
        return {
            "version": np.asarray(LOG_VERSION),
            "policy": np.frombuffer(self._policy, np.uint8),
            **{name: rows[name] for name, *_ in self._kinds},
        }


_CODES = {state: code for code, state in enumerate(State)}  # in the log


class Model:
    """What a policy file says: the robot, the network's inputs and weights, and limits."""

    def __init__(self, content: bytes) -> None:
        """Reads a file's content.

        Raises:
          PolicyFileError, KeyError, TypeError, ValueError, OverflowError, AttributeError: if it is
            damaged, or not a policy that this file can run.
        """
        self.manifest, weights = _read(content)
        manifest = self.manifest
        self.legs = legs = _Legs(manifest["robot"])
        self.joints: list[list[str]] = [_names(leg["joints"]) for leg in manifest["robot"]["legs"]]
        timing = manifest["timing"]
        self.sample_dt = _number("sample_s", timing["sample_s"], 1e-4, 1)
        self.decision_samples = _whole(
            "decision_samples", timing["decision_samples"], 1, MOST_SAMPLES
        )
        self.decision_dt = self.decision_samples * self.sample_dt  #: s
        # The rate from a fall on one side to a fall on the other within a decision.
        fall = math.radians(_number("fail_tilt_deg", manifest["fail_tilt_deg"], 0, 90))
        self.rate_most = 2 * fall / self.decision_dt  #: rad/s
        ramp = _whole("ramp_samples", timing["ramp_samples"], 1, self.decision_samples)
        self.share = (np.arange(1, ramp + 1) / ramp)[
            :, None
        ]  #: of a command, at the ramp's samples
        self.height = _number("body_height_m", manifest["body_height_m"], *legs.height_range)
        action = manifest.get("action", "grid")  # the first files do not say
        if action not in ACTIONS:
            raise PolicyFileError(
                f"its action is {_quote(action)}; this file runs {' and '.join(ACTIONS)}"
            )
        self.table = _numbers("table_m", manifest["actions"]["table_m"], (None, 2))

        self.inputs = inputs = _Inputs(manifest["inputs"], len(self.joints), self.sample_dt)
        self.recent = min(max(self.decision_samples, RECENT[0]), RECENT[1])
        """Newest IMU samples, which are checked for repetitions."""
        self.history = max(inputs.lookback("gyro", "accelerometer"), self.recent)
        """IMU samples before those of a decision that are kept."""
        self.network = _Network(manifest["network"], inputs.size, weights)
        if len(self.table) != math.prod(self.network.factors):
            raise PolicyFileError("its action table is not what its network chooses from")
        self.continuous = action == "continuous"
        if self.continuous and not (self.network.radial and len(self.network.factors) == 2):
            raise PolicyFileError("its action is 'continuous', but its network is not radial")
        low, high = self.table.min(axis=0), self.table.max(axis=0)
        self.middle, self.half = np.float32((low + high) / 2), np.float32((high - low) / 2)

        low, high = legs.limits()
        most = np.repeat((GYRO_MOST, ACCEL_MOST), 3)
        self.least, self.most = np.append(low, -most), np.append(high, most)
        self.lying = np.zeros_like(self.most)
        """How far readings may be beyond `least` and `most` while the robot does not balance."""
        self.lying[2:-IMU:3] = LYING_SLACK - KNEE_SLACK
        self._read_servos()

    def _read_servos(self) -> None:
        """Reads gains, trim and torque limits; files may lack them."""
        robot, shape = self.manifest["robot"], (len(self.joints), 3)
        self.gains: np.ndarray | None = None
        """(2, legs, 3) stiffness, N m / rad, and damping, N m s / rad."""
        self.trim: np.ndarray | None = None
        """(legs, 3) rad that the targets lack to bear the robot."""
        gains = [robot.get(name) for name in ("servo_stiffness", "servo_damping")]
        if None not in gains:
            gains = [np.broadcast_to(np.asarray(gain, float), shape) for gain in gains]
            self.gains = _numbers("servo_stiffness and servo_damping", gains, (2, *shape))
            if not (self.gains >= 0).all():
                raise PolicyFileError("its servos have gains below 0")
        if self.manifest.get("leg_trim_rad") is not None:
            self.trim = _numbers("leg_trim_rad", self.manifest["leg_trim_rad"], shape)
            if not (abs(self.trim) <= TRIM_MOST).all():
                raise PolicyFileError(f"its leg_trim_rad goes beyond {TRIM_MOST:g} rad")
        torques = [robot.get(name) or math.inf for name in ("hip_torque", "knee_torque")]
        most = TORQUE_SHARE * np.asarray([torques[0], torques[0], torques[1]], float)
        self.torque_limits = np.broadcast_to(most, shape)  #: (legs, 3) N m


class _Inputs:
    """The network's inputs: (mean of `window` samples from `lag` on - offset) / scale.

    Inputs with a time constant are means over all samples since the start (`_Means`).
    """

    def __init__(self, rows: list[dict[str, Any]], legs: int, sample_dt: float) -> None:
        channels = {"height": legs, "command": legs, "gyro": 3, "accelerometer": 3}
        self.channels = legs
        self._ages = dict.fromkeys(channels, 1)
        groups: dict[tuple[str, int], list[tuple[int, int, int]]] = {}
        slow = [k for k, row in enumerate(rows) if row.get("time_constant") is not None]
        self.slow, self.means = slow, _Means([rows[k] for k in slow], sample_dt)
        for k, row in enumerate(rows):
            if k in slow:
                continue
            sensor = row["sensor"]
            if sensor not in channels:
                raise PolicyFileError(
                    f"its inputs have the sensor {_quote(sensor)}; this file knows "
                    f"{', '.join(channels)}"
                )
            index = _whole("index", row["index"], 0, channels[sensor] - 1)
            most = 0 if sensor in MOMENTARY else MOST_WHOLE
            lag, window = _whole("lag", row["lag"], 0, most), _whole("window", row["window"], 1)
            self._ages[sensor] = max(self._ages[sensor], lag + window)
            groups.setdefault((sensor, window), []).append((k, index, lag))
        samples = sum(window * len(group) for (_, window), group in groups.items())
        if samples > MOST_READ or any(self._ages[sensor] > 1 for sensor in MOMENTARY):
            raise PolicyFileError("its inputs are means of more samples than there are")
        self.size = len(rows)
        self.offset = _numbers("offset", [row["offset"] for row in rows], (self.size,))
        self.scale = np.asarray([_number("scale", row["scale"], *SCALES) for row in rows])
        self.groups = []
        for (sensor, window), group in groups.items():
            places, index, lags = np.asarray(group, int).T
            self.groups.append((sensor, places, -1 - np.arange(window)[:, None] - lags, index))

    def lookback(self, *sensors: str) -> int:
        """Number of samples of these sensors that the inputs need, the newest included."""
        return max(self._ages[sensor] for sensor in sensors)

    def observe(self, samples: dict[str, np.ndarray]) -> np.ndarray:
        """Inputs (size,) from {sensor: samples (n, channels), the newest last}."""
        values = np.empty(self.size)
        values[self.slow] = self.means.values()
        for sensor, places, steps, index in self.groups:
            values[places] = samples[sensor][steps, index].mean(axis=0)
        return (values - self.offset) / self.scale


class _Means:
    """Leaky means of gyro and accelerometer, and the angles of complementary filters.

    Weighted means of all samples, whose weights fall by 1/e in a time constant tau. An angle is the
    mean of gravity's angle + tau * gyro: it integrates the gyro and leans toward gravity's angle.
    """

    def __init__(self, rows: list[dict[str, Any]], sample_dt: float) -> None:
        kinds = {"gyro": (0, 3), "accelerometer": (3, 3), "angle": (IMU, 2)}
        times, places = [], []
        for row in rows:
            sensor = row["sensor"]
            if sensor not in kinds:
                raise PolicyFileError(
                    f"its inputs have a mean of the sensor {_quote(sensor)}; this file knows means "
                    f"of {', '.join(kinds)}"
                )
            first, count = kinds[sensor]
            places.append(first + _whole("index", row["index"], 0, count - 1))
            times.append(_number("time_constant", row["time_constant"], *TIMES))
        self.places, tau = np.asarray(places, int), np.asarray(times)
        self.angle = angle = self.places >= IMU
        self.turns, self.times = self.places[angle] - IMU, tau[angle]
        self.leak = sample_dt / (tau + sample_dt)
        start = 1 - (1 - self.leak) ** round(STANDING_S / sample_dt)
        self.first = np.where(angle, 1.0, start)  #: weight of the first sample

    def start(self, imu: np.ndarray) -> None:
        """Takes the first sample (6,), of a robot that has been standing still."""
        self._weight = self.first.copy()
        self._sum = self._weight * self._samples(imu)

    def add(self, imu: np.ndarray) -> None:
        """Takes another sample (6,)."""
        if len(self.leak):
            self._sum += self.leak * (self._samples(imu) - self._sum)
            self._weight += self.leak * (1 - self._weight)

    def values(self) -> np.ndarray:
        """The means now, in the order of the rows."""
        return self._sum / self._weight

    def _samples(self, imu: np.ndarray) -> np.ndarray:
        x, y, z = imu[3:]
        gravity = math.atan2(y, z), math.atan2(-x, math.hypot(y, z))
        samples = np.append(imu, gravity)[self.places]
        samples[self.angle] += self.times * imu[self.turns]
        return samples


class _Legs:
    """Leg kinematics: foot heights to joint angles and back (Leg in robots/robot.py)."""

    def __init__(self, robot: dict[str, Any]) -> None:
        count = _whole("number of legs", len(robot["legs"]), 1, MOST_LEGS)

        def each(name: str, *shape: int) -> np.ndarray:
            return _numbers(name, [leg[name] for leg in robot["legs"]], (count, *shape))

        radius = _numbers("foot_radius", robot["foot_radius"], ())
        self.thigh, self.calf, self.drop = each("thigh"), each("calf"), each("drop")
        self.offset, axis_height = each("offset"), each("axis_height")
        self.signs, self.zeros, self.knee = each("signs", 3), each("zeros", 3), each("knee", 2)
        if not ((self.thigh > 0) & (self.calf > 0)).all() or not (abs(self.signs) == 1).all():
            raise PolicyFileError("its legs have lengths that are not above 0, or signs not +-1")
        if not (abs(self.zeros) <= MOST_TURN).all():
            raise PolicyFileError(f"its legs have zeros beyond {MOST_TURN:g} rad")
        low, high = self.knee.T
        self.bends = np.sign(low + high)
        one_side = (low * high >= 0) & (low <= high) & (self.bends != 0)
        if not (one_side & (abs(self.knee) <= math.pi).all(axis=-1)).all():
            raise PolicyFileError("its knees do not bend to one side, by at most half a turn")
        # Body height = `_rise` + distance from hip to foot, if the hip's axis is level.
        self.rise = radius + self.drop - axis_height
        self.lift = radius - axis_height
        self.sides = np.where((each("left") != 0, each("front") != 0), 1.0, -1.0)
        squared = self.thigh**2 + self.calf**2
        squared = squared[:, None] + 2 * (self.thigh * self.calf)[:, None] * np.cos(self.knee)
        reach = np.sqrt(np.maximum(squared, 0)) + self.rise[:, None]  # rounded: -1e-17
        self.height_range = float(reach.min(axis=-1).max()), float(reach.max(axis=-1).min())
        """Least and greatest body height that all legs reach, m."""

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest possible reading of all joints, (3 legs,) each, rad."""
        turns = np.broadcast_to((-math.pi, math.pi), (*self.signs.shape, 2)).copy()
        turns[:, 2] = self.knee + np.asarray((-KNEE_SLACK, KNEE_SLACK))
        ends = self.signs[..., None] * (turns - self.zeros[..., None])
        return ends.min(axis=-1).ravel(), ends.max(axis=-1).ravel()

    def moved(self, heights: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Foot heights (legs,) after an action (2,): left legs +a_x, front legs +a_y, m."""
        moved = heights + change[0] * self.sides[0] + change[1] * self.sides[1]
        return np.clip(moved, *self.height_range)

    def joint_angles(self, heights: np.ndarray) -> np.ndarray:
        """(..., legs, 3) abduction, hip and knee angles, rad, for foot heights (..., legs), m."""
        a, b = self.thigh, self.calf
        cosine = ((heights - self.rise) ** 2 - a**2 - b**2) / (2 * a * b)
        knee = self.bends * np.arccos(np.clip(cosine, -1.0, 1.0))
        thigh = -np.arctan2(b * np.sin(knee), a + b * np.cos(knee))
        turned = np.stack((np.zeros_like(thigh), thigh, knee), axis=-1)
        return self.signs * (turned - self.zeros)

    def foot_heights(self, angles: np.ndarray) -> np.ndarray:
        """(legs,) m below the trunk's origin, foot radius included, for joint angles (legs, 3)."""
        abduction, thigh, knee = (self.signs * angles + self.zeros).T
        length = self.thigh * np.cos(thigh) + self.calf * np.cos(thigh + knee)
        down = (length + self.drop) * np.cos(abduction) - self.offset * np.sin(abduction)
        return down + self.lift


class _Network:
    """The Q-network; it computes the best action only."""

    def __init__(self, network: Any, inputs: int, weights: dict[str, np.ndarray]) -> None:
        self.factors = _wholes("factors", network["factors"], MOST_FACTORS)
        self.radial = network["radial"] is True
        hidden = _wholes("hidden_sizes", network["hidden_sizes"], MOST_LAYERS)
        rows, columns = [inputs, *hidden], [*hidden, sum(self.factors)]
        names = [f"hidden_{k}" for k in range(len(hidden))] + ["head"]
        shapes: dict[str, tuple[int, ...]] = {}
        if self.radial:
            rows[-1] += inputs
            columns[-1] = 1 + len(self.factors)
            shapes = {"profile": (4,), "stretch": (len(self.factors),)}
        for name, n, m in zip(names, rows, columns):
            shapes.update({f"{name}/kernel": (n, m), f"{name}/bias": (m,)})
        extra = sorted(set(weights) - set(shapes))
        if extra:
            raise PolicyFileError(f"weight {_quote(extra[0])} is none of this network's")
        for name, shape in shapes.items():
            if name not in weights or weights[name].shape != shape:
                raise PolicyFileError(f"weight {name} is missing or not of shape {shape}")
            if not np.isfinite(weights[name]).all():
                raise PolicyFileError(f"weight {name} holds values that are not finite numbers")
        # Sums in float64: they are then the same in any order, also in a header in C.
        self.layers = [
            (weights[f"{name}/kernel"].astype(float), weights[f"{name}/bias"].astype(float))
            for name in names
        ]

    def greedy(self, observation: np.ndarray) -> tuple[int, np.ndarray]:
        """Index of the best action, and a radial head's best point in the range of its levels.

        The point has a number from -1 to 1 per factor. Raises `_Unsafe` if an output is not finite.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            obs = x = observation.astype(np.float32)
            for kernel, bias in self.layers[:-1]:
                x = np.maximum((x @ kernel + bias).astype(np.float32), 0.0)
            kernel, bias = self.layers[-1]
            x = np.concatenate((x, obs)) if self.radial else x
            out = (x @ kernel + bias).astype(np.float32)
        if not np.isfinite(out).all():
            raise _Unsafe(Fault.NETWORK, "the network gives values that are not finite numbers")
        index = 0
        for k, levels in enumerate(self.factors):
            index = index * levels + (self._nearest(out, k) if self.radial else self._best(out, k))
        return index, np.clip(out[1 : 1 + len(self.factors)], -1, 1)

    def _nearest(self, out: np.ndarray, axis: int) -> int:
        """The level nearest to the best point of a radial head, whose outputs are V and mu."""
        last = np.float32(self.factors[axis] - 1)
        return int(np.rint((min(max(out[1 + axis], -1), 1) + 1) * last / 2))

    def _best(self, out: np.ndarray, axis: int) -> int:
        """The level of the greatest value."""
        start = sum(self.factors[:axis])
        return int(np.argmax(out[start : start + self.factors[axis]]))


def _read(content: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Reads manifest and weights of a safetensors file: size of the header, header, numbers."""
    try:
        size = int.from_bytes(content[:8], "little")
        if size > len(content) - 8:
            raise ValueError("it ends within its header")
        if size > MOST_HEADER:
            raise PolicyFileError(f"its header has {size} bytes, more than {MOST_HEADER}")
        header, numbers = json.loads(content[8 : 8 + size]), memoryview(content)[8 + size :]
        text = header.pop("__metadata__", {}).get("manifest")
        if isinstance(text, str) and len(text) > MOST_MANIFEST:
            raise PolicyFileError(f"its manifest has {len(text)} characters, too many")
        if len(header) > MOST_WEIGHTS:
            raise PolicyFileError(f"it has {len(header)} weights, more than {MOST_WEIGHTS}")
        places = {name: entry["data_offsets"] for name, entry in header.items()}
        for name, (begin, end) in places.items():  # before anything is copied
            if not 0 <= begin <= end <= len(numbers):
                raise ValueError(f"weight {_quote(name)} lies outside the file")
        if sum(end - begin for begin, end in places.values()) != len(numbers):
            raise ValueError("its length is not that of its weights")
        weights = {name: _array(name, entry, numbers) for name, entry in header.items()}
    except PolicyFileError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise PolicyFileError(f"it is damaged or no safetensors file: {error}") from error
    try:
        manifest = json.loads(text)
        kind, version = manifest["format"], manifest["version"]
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise PolicyFileError("it carries no manifest of a policy of mjx_balance") from error
    if (kind, version) != (FORMAT, FORMAT_VERSION):
        remedy = REMEDY if (kind, version) == (FORMAT, FORMAT_VERSION - 1) else ""
        raise PolicyFileError(
            f"it is {_line(kind, 40)} version {_line(version, 40)}; this file runs {FORMAT} "
            f"version {FORMAT_VERSION}{remedy}"
        )
    return manifest, weights


def _content(path: Path) -> bytes:
    """Reads a regular file of at most `MOST_BYTES`."""
    try:
        if path.exists() and not path.is_file():
            raise PolicyFileError("it cannot be read: it is no regular file")
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)  # Linux has regular files of size 0 without end
            size = max(len(content), os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise PolicyFileError(f"it cannot be read: {error.strerror}") from error
    if size > MOST_BYTES:
        raise PolicyFileError(f"it has {size} bytes, and no policy so many")
    return content


def _array(name: str, entry: dict[str, Any], numbers: memoryview) -> np.ndarray:
    if entry["dtype"] != "F32":
        kind = _line(entry["dtype"], 40)
        raise PolicyFileError(f"weight {_quote(name)} is {kind}; it must be F32 (float32)")
    begin, end = entry["data_offsets"]
    return np.frombuffer(numbers[begin:end], "<f4").astype(np.float32).reshape(entry["shape"])


def _reason(error: Exception) -> str:
    """What is wrong with a file, in a sentence."""
    if isinstance(error, PolicyFileError):
        return str(error)
    if isinstance(error, KeyError):
        return f"its manifest lacks {error}"
    return f"a part of its manifest has the wrong type: {error}"


def _numeric(name: str, values: Any) -> np.ndarray:
    """A sensor's reading as an array; `_Unsafe` for what a broken driver may give instead."""
    try:
        array = np.asarray(values)
        if array.dtype.kind in "fiub":  # NumPy would take None for NaN, and read text
            return array
    except Exception:
        pass
    raise _Unsafe(
        Fault.READING, f"{name} is a value of type {type(values).__name__}; it must be numbers"
    )


def _number(name: str, value: Any, least: float, most: float) -> float:
    if not least <= value <= most:
        raise PolicyFileError(
            f"its {name} is {_quote(value)}; it must be from {least:g} to {most:g}"
        )
    return float(value)


def _whole(name: str, value: Any, least: int, most: int = MOST_WHOLE) -> int:
    if type(value) is not int or not least <= value <= most:
        raise PolicyFileError(
            f"its {name} is {_quote(value)}; it must be a whole number from {least} to {most}"
        )
    return value


def _wholes(name: str, values: Any, most: int) -> list[int]:
    """Checks and returns at most so many whole numbers above 0."""
    _whole(f"number of {name}", len(values), 0, most)
    return [_whole(name, value, 1) for value in values]


def _numbers(name: str, values: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """Checks and returns bounded numbers; None in `shape` is any length."""
    array = np.asarray(values, float)
    fits = array.ndim == len(shape) and all(n in (m, None) for m, n in zip(array.shape, shape))
    if not fits or not (abs(array) < MOST_WHOLE).all():
        raise PolicyFileError(f"its {name} is not {shape} sane numbers")
    return array


def _names(names: Any) -> list[str]:
    """Checks and returns the names of a leg's three joints."""
    if len(names) != 3:
        raise PolicyFileError("its legs have other than three joints")
    for name in names:
        if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= MOST_NAME:
            raise PolicyFileError(
                f"a joint is called {_quote(name)}; a name has 1 to {MOST_NAME} printable "
                "characters"
            )
    return list(names)


def _quote(value: Any) -> str:
    return _line(repr(value), 40)


def _line(text: Any, most: int) -> str:
    """Text from outside in one line without control characters; a longer one loses its middle."""
    line = "".join(x if x.isprintable() else "?" for x in " ".join(str(text).split()))
    rest = most // 3
    return line if len(line) <= most else f"{line[: most - rest - 3]}...{line[-rest:]}"
