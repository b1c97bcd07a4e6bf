"""`mjx-balance replay`: a log of `mjx_balance/runtime.py`, sample by sample through a policy."""

import dataclasses
import io
import tempfile
import zipfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from mjx_balance.cli.common import check_out
from mjx_balance.errors import MESSAGE, PATH, InputError, shorten
from mjx_balance.files.run_folder import write_atomically
from mjx_balance.policy.file import find_policy
from mjx_balance.report.figures import BLUE, GREY, ORANGE, Figure, png, styled
from mjx_balance.runtime import (
    LOG_VERSION,
    MOST_BYTES,
    MOST_LEGS,
    MOST_LOG,
    Controller,
    Fault,
    PolicyFileError,
    State,
)

Log = dict[str, np.ndarray]
"""Arrays of a log by name."""
STATES = tuple(State)
SHAPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "time": ("f8", ()),
    "joint_positions": ("f8", (-1, 3)),
    "gyro": ("f8", (3,)),
    "accelerometer": ("f8", (3,)),
    "targets": ("f8", (-1, 3)),
    "command": ("f8", (2,)),
    "action": ("i4", ()),
    "state": ("u1", ()),
    "fault": ("u1", ()),
    "decision": ("b1", ()),
    "start": ("b1", ()),
}
"""Type and shape of a sample's arrays; -1 is the number of legs."""
OTHERS = {"version": "i8", "policy": "u1", "reason": "U"}
MOST_HEADER = 1_000  #: greatest size of an array's header, bytes
MOST_FILE = 2 * MOST_BYTES  #: greatest size of a log, bytes
MOST_ARRAY = MOST_BYTES  #: greatest size of one of its arrays, bytes


@dataclasses.dataclass(frozen=True)
class ReplayArgs:
    """Run a robot's log through a policy, and draw sensors, decisions and targets."""

    log: Annotated[Path, tyro.conf.Positional]
    """File that `Controller.save_log` wrote."""
    policy: Path | None = None
    """Policy file, run folder, or the name of a shipped policy; none: the one in the log."""
    out: Path = Path("replay.png")
    """Picture to write."""


@dataclasses.dataclass(frozen=True)
class Replay:
    """What a policy does on the samples of a log; NaN where it was not balancing."""

    command: np.ndarray  #: (samples, 2) its last height changes, m
    targets: np.ndarray  #: (samples, legs, 3) rad
    action: np.ndarray  #: (samples,) index of its last action; -1 for none
    reasons: list[tuple[float, str]]  #: time, s, and reason whenever it would hold


def replay(argv: list[str]) -> int:
    args = tyro.cli(ReplayArgs, args=argv, prog="mjx-balance replay")
    check_out("out", args.out, ".png")
    log = read_log(args.log)
    if not len(log["time"]):
        raise InputError(f"{args.log} has no samples")
    if args.policy is not None:
        replayed = run_log(find_policy(args.policy), log)
    else:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "policy of the log"
            path.write_bytes(log["policy"].tobytes())
            replayed = run_log(path, log)
    write_atomically(args.out, png(replay_figure(log, replayed)))
    for line in describe(log, replayed):
        print(line)
    print(f"picture: {shorten(args.out, PATH)}")
    return 0


def read_log(path: Path) -> Log:
    """Reads a log.

    Raises:
      InputError: if the file is missing, damaged, too large, or no log of this version.
    """
    try:
        if path.is_file() and path.stat().st_size > MOST_FILE:
            raise ValueError(f"it is larger than {MOST_FILE} bytes")
        with zipfile.ZipFile(path) as archive:
            log = {name: _read_array(archive, name) for name in (*OTHERS, *SHAPES)}
        _check(log)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, SyntaxError, RuntimeError, zipfile.BadZipFile) as error:
        text = shorten(str(error), MESSAGE // 2)
        raise InputError(f"{path} is damaged or no log of a controller: {text}") from error
    except Exception as error:  # damage makes zipfile, its decompressors and NumPy raise anything
        raise InputError(f"{path} is damaged or no log of a controller") from error
    return log


def _read_array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Reads an array of the archive; takes no memory on the word of its header."""
    with archive.open(f"{name}.npy") as file:
        content = file.read(MOST_ARRAY + 1)
    if len(content) > MOST_ARRAY:
        raise ValueError(f"{name} is larger than {MOST_ARRAY} bytes")
    stream = io.BytesIO(content)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError(f"{name} has another format than in a log")
    shape, by_column, dtype = np.lib.format.read_array_header_1_0(stream, MOST_HEADER)
    kind = OTHERS.get(name) or SHAPES[name][0]
    if (kind != dtype.kind and dtype.newbyteorder("=") != np.dtype(kind)) or by_column:
        raise ValueError(f"{name} holds {dtype} and not {kind}")
    return np.frombuffer(content[stream.tell() :], dtype).reshape(shape)


def _check(log: Log) -> None:
    """Checks that the arrays are the samples of one robot."""
    if log["version"].shape or log["version"] != LOG_VERSION:
        raise ValueError(f"its version is not {LOG_VERSION}")
    if log["policy"].ndim != 1 or log["reason"].shape:
        raise ValueError("policy or reason has another shape")
    joints = log["joint_positions"].shape
    if len(joints) != 3 or not joints[0] <= MOST_LOG or not 1 <= joints[1] <= MOST_LEGS:
        raise ValueError("joint_positions has another shape")
    for name, (_, shape) in SHAPES.items():
        expected = (joints[0], *(joints[1] if n < 0 else n for n in shape))
        if log[name].shape != expected:
            raise ValueError(f"{name} has another shape")
    if (log["state"] >= len(STATES)).any() or (log["fault"] >= len(Fault)).any():
        raise ValueError("it has unknown states or faults")


def run_log(path: Path, log: Log) -> Replay:
    """Runs a policy on the samples of a log, from each start of balancing on.

    If the log begins in the middle, the policy begins at its first decision as if the robot had
    been standing still, and its first decisions differ from the log's.

    Raises:
      InputError: if the policy cannot be used, or is that of a robot with other legs.
    """
    now = 0.0
    try:
        controller = Controller(path, lambda: now)
    except PolicyFileError as error:
        raise InputError(str(error)) from error
    samples, legs = log["joint_positions"].shape[:2]
    if legs != len(controller.joints):
        raise InputError(f"the log's robot has {legs} legs, the policy's {len(controller.joints)}")
    replayed = Replay(
        np.full((samples, 2), np.nan),
        np.full((samples, legs, 3), np.nan),
        np.full(samples, -1),
        [],
    )
    balancing = log["state"] == STATES.index(State.BALANCING)
    runs = False
    for k in range(samples):
        if log["start"][k] or (balancing[k] and log["decision"][k] and not runs):
            controller.reset()
            runs = True
        runs = runs and bool(balancing[k])
        if not runs:
            continue
        now, held = float(log["time"][k]), controller.state is State.HOLDING
        sensors = (log[name][k] for name in ("joint_positions", "gyro", "accelerometer"))
        replayed.targets[k] = controller.step(*sensors)
        if controller.state is State.BALANCING:
            assert controller.action is not None
            replayed.command[k], replayed.action[k] = controller.command, controller.action
        elif not held:
            replayed.reasons.append((now, controller.reason))
    return replayed


def describe(log: Log, replayed: Replay) -> list[str]:
    """Describes a replay, line by line."""
    both = log["decision"] & (replayed.action >= 0)
    equal = int((log["action"] == replayed.action)[both].sum())
    apart = np.abs(log["command"] - replayed.command)[both]
    time = _clock(log)
    lines = [
        f"{time[-1] - time[0]:.1f} s, {int(log['decision'].sum())} decisions; of {int(both.sum())} "
        f"replayed, {equal} equal the log's, and height changes differ by at most "
        f"{1000 * apart.max(initial=0.0):.3f} mm"
    ]
    fault = Fault(int(log["fault"][-1]))
    if fault is not Fault.NONE:
        state = STATES[int(log["state"][-1])]
        reason = shorten(str(log["reason"]), MESSAGE)
        lines.append(f"it ended {state}, fault {fault.name}: {reason}")
    lines += [f"the policy would hold at {at:.2f} s: {reason}" for at, reason in replayed.reasons]
    return lines


def _clock(log: Log) -> np.ndarray:
    """(samples,) times, s; only finite ones, in order."""
    time = np.where(np.isfinite(log["time"]), log["time"], 0.0)
    return np.clip(time, -1e12, 1e12)


@styled
def replay_figure(log: Log, replayed: Replay) -> Figure:
    """Sensors, decisions and targets over time; a fault is a vertical line."""
    figure = Figure(figsize=(12, 9), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    time = _clock(log)
    time = time - time[0]

    def curves(axis: Any, values: np.ndarray, names: tuple[str, ...], style: str = "-") -> None:
        for column, name, colour in zip(values.T, names, (BLUE, ORANGE, GREY), strict=False):
            finite = np.where(np.abs(column) < 1e6, column, np.nan)
            axis.plot(time, finite, style, color=colour, lw=1.0, label=name)
        axis.legend(loc="upper right", ncols=4)

    curves(axes[0], log["gyro"], ("x", "y", "z"))
    axes[0].set_ylabel("gyro [rad/s]")
    curves(axes[1], log["accelerometer"][:, :2], ("x", "y"))
    axes[1].set_ylabel("accelerometer [m/s²]")
    curves(axes[2], 1000 * log["command"], ("a_x", "a_y"))
    curves(axes[2], 1000 * replayed.command, ("a_x, replayed", "a_y, replayed"), ":")
    axes[2].set_ylabel("decision [mm]")
    knees = np.stack([log["joint_positions"], log["targets"], replayed.targets])[:, :, 0, 2]
    curves(axes[3], knees.T, ("reading", "target", "target, replayed"))
    axes[3].set_ylabel("first leg's knee [rad]")
    axes[3].set_xlabel("time [s]; vertical: a fault")
    for axis in axes:
        for at in time[log["fault"] > 0]:
            axis.axvline(at, color="black", lw=0.8, ls=":")
    return figure
