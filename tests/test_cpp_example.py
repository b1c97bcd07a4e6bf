"""`examples/robot/`: the robot in C++, in MuJoCo and over UDP.

The peers in this file speak the packets by the page's table, not by the example's code.
"""

import dataclasses
import functools
import os
import re
import runpy
import socket
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.headers import compiler

from mjx_balance.evaluation.rollout import Rollout, observing, policy_scene, run_suite, suite_scene
from mjx_balance.policy.c_header import export_header
from mjx_balance.policy.file import find_policy, load_policy
from mjx_balance.runtime import Controller, State

REPO = Path(__file__).parent.parent
EXAMPLE = REPO / "examples/robot"
PAGE = (REPO / "docs/without_python.md").read_text()
BEST = find_policy("best")
write_scene = runpy.run_path(str(EXAMPLE / "scene.py"))["main"]

SAME = 1e-5
"""deg. Samples are float32 in C and float64 in the evaluation; the two differ by some 1e-6."""
OVER_UDP = 2e-5
"""deg. Commands are float32, too."""

HELLO, STATE, COMMAND = 0, 1, 2
JOINTS = 12
HEADER = struct.Struct("<4sBBBBIId")
BODY = {
    HELLO: struct.Struct(""),
    STATE: struct.Struct("<12f3f3f4f12f"),
    COMMAND: struct.Struct("<12f12f12f12f"),
}


def packet(
    kind: int, sequence: int, answers: int, now: float, values: Any = (), flags: int = 0
) -> bytes:
    """A packet, whole and undamaged."""
    header = HEADER.pack(b"MJXB", 1, kind, JOINTS, flags, sequence, answers, now)
    content = header + BODY[kind].pack(*np.ravel(values))
    return content + struct.pack("<I", zlib.crc32(content))


@dataclasses.dataclass(frozen=True)
class Packet:
    """A packet that came."""

    kind: int
    damped: bool
    sequence: int
    answers: int
    time: float
    values: np.ndarray

    @classmethod
    def parse(cls, content: bytes) -> "Packet":
        magic, version, kind, joints, flags, *rest = HEADER.unpack(content[:24])
        assert (magic, version, joints) == (b"MJXB", 1, JOINTS)
        assert struct.unpack("<I", content[-4:])[0] == zlib.crc32(content[:-4])
        sequence, answers, now = rest
        values = np.array(BODY[kind].unpack(content[24:-4]))
        return cls(kind, bool(flags), sequence, answers, now, values)

    @property
    def joints(self) -> np.ndarray:
        """(4, 3) angles of a state, positions of a command, rad."""
        return self.values[:12].reshape(4, 3)

    @property
    def gains(self) -> np.ndarray:
        """(3, 12) stiffness, damping and torque of a command."""
        return self.values[12:].reshape(3, 12)


PLAIN = "-O0"
CHECKED = "-O1 -g -fsanitize=address,undefined -fno-sanitize-recover=all"


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(PLAIN, id="plain"),
        pytest.param(CHECKED, id="checked", marks=pytest.mark.slow),
    ],
)
def built(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of both programs; -Werror, because the example is to be copied."""
    compiler("g++")
    compiler("make")
    folder = tmp_path_factory.mktemp("robot")
    export_header(BEST, folder / "policy.h", "0" * 16)
    flags = f"CXXFLAGS={request.param} -Wconversion -Werror"
    make("all", f"BUILD={folder}", flags, "CXX=g++")
    return folder


def make(*arguments: str) -> None:
    """Runs the example's Makefile."""
    command = ["make", "-s", "-j2", "-C", str(EXAMPLE), f"PYTHON={sys.executable}", *arguments]
    subprocess.run(command, check=True, env=os.environ | {"MAKEFLAGS": ""})


def scene_file(folder: Path, *arguments: str, policy: str = "best") -> Path:
    """What `scene.py` writes."""
    out = folder / "scene.bin"
    write_scene([policy, "--out", str(out), *arguments])
    return out


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenarios of 6 s."""
    size = ("--scenarios", "2", "--duration", "6", "--seed", "5")
    return scene_file(tmp_path_factory.mktemp("scene"), *size)


def evaluation(policy: str, suite: str, scenarios: int, seconds: float, seed: int) -> Rollout:
    """The same in Python."""
    loaded = load_policy(find_policy(policy))
    scene = policy_scene(loaded)
    return run_suite(scene, observing(loaded), suite, scenarios, seconds, seed)


def start(*command: object) -> subprocess.Popen[str]:
    """Starts a program; ASan must not look for leaks inside of MuJoCo's library."""
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([*map(str, command)], **pipes)


def end(program: subprocess.Popen[str], seconds: float = 60.0) -> tuple[int, str, str]:
    """Exit code and what a program says until it ends."""
    try:
        out, err = program.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        program.kill()
        raise AssertionError(program.communicate()) from None
    return program.returncode, out, err


def run(*command: object) -> tuple[int, str, str]:
    return end(start(*command), 500.0)


def tilts(said: str) -> tuple[float, float]:
    """Mean and greatest tilt that a program says, deg."""
    match = re.search(r"tilt in deg: mean ([\d.]+), greatest ([\d.]+)\n", said)
    assert match, said
    return float(match[1]), float(match[2])


def test_it_balances_as_the_evaluation_does(built: Path, scene: Path) -> None:
    code, said, errors = run(built / "balance", "sim", "--fast", "--scene", scene)
    assert (code, errors) == (0, "")
    expected = evaluation("best", "corner", 2, 6.0, 5).tilt
    assert said.endswith("\n0 of 2 fell; tilt in deg: mean " + said.rpartition("mean ")[2])
    assert tilts(said) == pytest.approx((expected.mean(), expected.max()), abs=SAME)


@pytest.fixture(scope="module")
def optimized(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Policy -> the folder of both programs as the page builds them, once."""
    compiler("make")
    compiler("g++")

    @functools.cache
    def build(policy: str) -> Path:
        folder = tmp_path_factory.mktemp(policy)
        make("all", f"BUILD={folder}", f"POLICY={policy}")
        return folder

    return build


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "suite", "scenarios", "seconds"),
    [
        *(("best", "corner", 16, 60.0), ("real", "corner", 4, 60.0)),
        *(("go2", "corner", 2, 6.0), ("spot", "corner", 2, 6.0)),
        *(("best", x, 2, 30.0) for x in ("paper", "fast", "steep", "recover", "steps", "sea")),
        ("real", "platform", 2, 30.0),
    ],
)
def test_every_suite_that_only_moves_boards(
    policy: str,
    suite: str,
    scenarios: int,
    seconds: float,
    tmp_path: Path,
    optimized: Callable[[str], Path],
) -> None:
    """Spot obeys commands late; `recover` starts tilted; a platform has five axes."""
    size = ("--suite", suite, "--scenarios", str(scenarios), "--duration", str(seconds))
    file = scene_file(tmp_path, *size, "--seed", "7000000", policy=policy)
    code, said, errors = run(optimized(policy) / "balance", "sim", "--fast", "--scene", file)
    assert (code, errors) == (0, "")
    expected = evaluation(policy, suite, scenarios, seconds, 7000000)
    assert not expected.fell.any()
    # Servos with dry friction amplify the last bits, over 20 s to whole peaks of Spot's tilt; the
    # runtime in Python is as far away.
    agree = SAME if policy in ("best", "real") else 1e-3
    close = expected.tilt.mean(), expected.tilt.max()
    assert tilts(said) == pytest.approx(close, abs=agree)


def records(file: Path) -> dict[str, bytes]:
    """Name -> content of what `scene.py` has written."""
    content, found = file.read_bytes(), {}
    while content:
        head, _, content = content.partition(b"\n")
        name, size = head.decode().split()
        found[name], content = content[: int(size)], content[int(size) :]
    return found


def changed(file: Path, out: Path, **values: Any) -> Path:
    """The same scene with other records."""
    new = records(file) | {k: np.asarray(x, "<f8").tobytes() for k, x in values.items()}
    out.write_bytes(b"".join(f"{k} {len(x)}\n".encode() + x for k, x in new.items()))
    return out


def test_after_a_fall_the_tilt_counts_as_that_of_a_fall(
    built: Path, scene: Path, tmp_path: Path
) -> None:
    """Here the limit is 0.5 deg, which the first second exceeds."""
    file = changed(scene, tmp_path / "s", fail_tilt=0.5)
    code, said, errors = run(built / "balance", "sim", "--fast", "--scene", file)
    assert (code, errors) == (1, "")
    tilt = evaluation("best", "corner", 2, 6.0, 5).tilt
    fallen = np.maximum.accumulate(tilt > 0.5, axis=1)
    assert fallen[:, -1].all()
    expected = np.where(fallen, 0.5, tilt)
    assert "\n2 of 2 fell" in said
    assert tilts(said) == pytest.approx((expected.mean(), 0.5), abs=SAME)


def serve(built: Path, scene: Path, *flags: str) -> tuple[subprocess.Popen[str], int]:
    """A fake robot, and its port."""
    program = start(built / "fake_robot", 0, "--scene", scene, *flags)
    assert program.stdout is not None
    said = program.stdout.readline()
    assert said.startswith("listening at port "), (said, end(program))
    return program, int(said.split()[-1])


def test_over_udp_it_balances_as_in_the_simulation(built: Path, scene: Path) -> None:
    """Both programs, in lockstep; the second scenario."""
    robot, port = serve(built, scene, "--scenario", "1", "--lockstep")
    code, said, errors = run(
        *(built / "balance", "udp", "127.0.0.1", port, "--lockstep", "--seconds", 6)
    )
    assert (code, errors) == (0, "")
    assert said == "0.000 s: BALANCING\npackets: 1500 taken, 0 old, 0 garbage\n"
    code, said, errors = end(robot)
    assert (code, errors) == (0, "")
    assert "packets: 1500 taken, 0 old, 0 garbage, 0 of others\nupright after 5.996 s" in said
    expected = evaluation("best", "corner", 2, 6.0, 5).tilt[1]
    assert tilts(said) == pytest.approx((expected.mean(), expected.max()), abs=OVER_UDP)


class Robot:
    """A robot to which `balance` connects; it stands still, with noise."""

    def __init__(self, built: Path, *flags: str):
        self.controller = Controller(BEST, lambda: self.now)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(20.0)
        port = self.socket.getsockname()[1]
        self.program = start(built / "balance", "udp", "127.0.0.1", port, *flags)
        content, self.peer = self.socket.recvfrom(2048)
        assert Packet.parse(content).kind == HELLO
        self.now, self.sequence, self.rng = 50.0, 0, np.random.default_rng(0)
        self.last = 0

    def state(self, after: float = 1.0, **other: Any) -> bytes:
        """The next sample, so many periods after the last one; `other` are readings or flags."""
        self.now, self.sequence = self.now + 0.004 * after, self.sequence + 1
        self.sequence %= 2**32
        noise = self.rng.normal(0, (*[0.002] * 3, *[0.02] * 3)).astype(np.float32)
        flags = other.pop("flags", 0)
        readings: dict[str, Any] = {
            "joints": self.controller.targets.astype(np.float32),
            "gyro": noise[:3],
            "accelerometer": noise[3:] + np.asarray([0, 0, 9.81], np.float32),
            "quaternion": [1, 0, 0, 0],
            "torques": np.zeros(JOINTS),
        } | other
        self.readings = readings
        values = np.concatenate([np.ravel(x) for x in readings.values()])
        return packet(STATE, self.sequence, self.last, self.now, values, flags)

    def send(self, *contents: bytes) -> None:
        for content in contents:
            self.socket.sendto(content, self.peer)

    def receive(self) -> Packet:
        """The next command; hellos from before the first state do not count."""
        while True:
            answer = Packet.parse(self.socket.recv(2048))
            if answer.kind != HELLO:
                self.last = answer.sequence
                return answer

    def step(self, **other: Any) -> Packet:
        """Sends a sample; returns the command that answers it."""
        self.send(self.state(**other))
        answer = self.receive()
        assert (answer.kind, answer.answers) == (COMMAND, self.sequence)
        readings = self.readings
        expected = self.controller.step(
            readings["joints"], readings["gyro"], readings["accelerometer"]
        )
        np.testing.assert_allclose(answer.joints, expected, rtol=0, atol=1e-6)
        return answer

    def end(self) -> tuple[int, str]:
        """Exit code and what the program says, once the robot is silent."""
        code, said, errors = end(self.program)
        assert errors == ""
        return code, said


@pytest.fixture
def connect(built: Path) -> Iterator[Callable[..., Robot]]:
    """Flags -> a robot to which `balance` is connected."""
    robots: list[Robot] = []

    def make(*flags: str) -> Robot:
        robots.append(Robot(built, *flags))
        return robots[-1]

    yield make
    for robot in robots:
        robot.program.kill()
        robot.program.communicate()
        robot.socket.close()


def test_a_command_answers_each_state_as_the_runtime_would(
    connect: Callable[..., Robot],
) -> None:
    """Also at decisions, and with the gains of standing."""
    robot = connect("--lockstep", "--seconds", "0.6")
    answers = [robot.step() for _ in range(150)]
    assert [x.sequence for x in answers] == list(
        range(answers[0].sequence, answers[0].sequence + 150)
    )
    expected = Controller(BEST, gains=True)
    assert (answers[0].gains[0] == expected.model.gains[0].ravel()).all()
    assert (answers[0].gains[1] == expected.model.gains[1].ravel()).all()
    np.testing.assert_allclose(
        answers[0].gains[2], (expected.model.gains[0] * expected.model.trim).ravel(), rtol=1e-6
    )
    assert robot.end() == (
        0,
        "50.004 s: BALANCING\npackets: 150 taken, 0 old, 0 garbage\n",
    )


def test_what_is_doubled_old_or_garbage_is_dropped(connect: Callable[..., Robot]) -> None:
    """It gets no answer, and the decisions are as without it."""
    robot = connect("--lockstep", "--seconds", "0.44")
    first = robot.state()
    robot.send(first)
    robot.controller.step(*list(robot.readings.values())[:3])
    robot.receive()
    for k in range(100):
        before = robot.step()
        good = packet(STATE, robot.sequence + 1, 0, robot.now, np.zeros(34))
        robot.send(
            first,
            packet(STATE, robot.sequence, 0, robot.now, np.zeros(34)),
            good[: k + 1],
            good + b"\0",
            good[:k] + bytes([good[k] ^ 1]) + good[k + 1 :],
            packet(COMMAND, robot.sequence + 1, 0, robot.now, np.zeros(48)),
        )
        robot.last = before.sequence
    for _ in range(9):
        robot.step()
    assert robot.end() == (0, "50.004 s: BALANCING\npackets: 110 taken, 200 old, 400 garbage\n")


def test_three_lost_samples_do_not_matter_and_five_hold(connect: Callable[..., Robot]) -> None:
    """Of 4 ms each: the controller holds after 20 ms."""
    robot = connect("--lockstep", "--seconds", "0.032")
    for _ in range(5):
        robot.step()
    robot.sequence += 3
    robot.step(after=4)
    assert robot.controller.state is State.BALANCING
    robot.sequence += 5
    held = robot.step(after=6)
    assert robot.controller.state is State.HOLDING
    assert (robot.step().joints == held.joints).all()
    code, said = robot.end()
    assert code == 1
    reason = "HOLDING, a sample came too late after the one before it, or before it (s): 0.024\n"
    assert said.splitlines(keepends=True)[1:2] == [f"50.060 s: {reason}"]


def test_lost_samples_that_add_up_hold_at_the_decision(connect: Callable[..., Robot]) -> None:
    """Every fifth is lost: 50 samples take a quarter longer than in training."""
    robot = connect("--lockstep", "--seconds", "0.204")
    for k in range(51):
        robot.sequence += k % 4 == 0
        robot.step(after=1 + (k % 4 == 0))
    assert robot.controller.state is State.HOLDING
    code, said = robot.end()
    assert code == 1
    assert "HOLDING, the samples of a decision took another time than in training (s)" in said


def test_what_comes_late_holds(connect: Callable[..., Robot]) -> None:
    """Without lockstep the time of arrival counts, whatever the robot's clock says."""
    robot = connect("--seconds", "0.028")
    for _ in range(5):
        robot.send(robot.state())
        robot.receive()
    time.sleep(0.1)
    robot.send(robot.state())
    held = robot.receive()
    robot.send(robot.state())
    assert (robot.receive().joints == held.joints).all()
    code, said = robot.end()
    assert code == 1
    assert "HOLDING, a sample came too late" in said


def test_it_ends_when_the_robot_is_silent(connect: Callable[..., Robot]) -> None:
    """After 2 s."""
    robot = connect()
    robot.send(robot.state())
    robot.receive()
    began = time.monotonic()
    code, said, errors = end(robot.program)
    assert time.monotonic() - began > 1.8
    assert (code, errors) == (1, "balance: the robot is silent\n")
    assert said.endswith(" s: BALANCING\npackets: 1 taken, 0 old, 0 garbage\n")


def test_impossible_readings_hold(connect: Callable[..., Robot]) -> None:
    """Numbers that a damaged sensor gives, in a packet that is whole."""
    robot = connect("--lockstep", "--seconds", "0.008")
    robot.step()
    robot.step(gyro=[np.nan, 0, 0])
    assert robot.controller.state is State.HOLDING
    code, said = robot.end()
    assert code == 1
    assert "HOLDING, a reading is no number in its sensor's range: nan\n" in said


def test_a_tilted_quaternion_holds(connect: Callable[..., Robot]) -> None:
    """By 25 deg, whatever the accelerometer says."""
    robot = connect("--lockstep", "--seconds", "0.008")
    robot.step()
    robot.send(robot.state(quaternion=[np.cos(0.218), 0, np.sin(0.218), 0]))
    robot.receive()
    code, said = robot.end()
    assert code == 1
    assert "HOLDING, the quaternion is tilted" in said


def test_overloaded_servos_hold(connect: Callable[..., Robot]) -> None:
    """The knees at 44 N m of 45.4, in the mean of a decision."""
    robot = connect("--lockstep", "--seconds", "0.204")
    for _ in range(51):
        robot.send(robot.state(torques=[0, 0, -44] * 4))
        robot.receive()
    code, said = robot.end()
    assert code == 1
    assert "HOLDING, a servo is at its torque limit (N m): 44\n" in said


def test_it_says_hello_until_the_robot_answers_and_numbers_begin_again(
    connect: Callable[..., Robot],
) -> None:
    """After 2^32 - 1 comes 0, which is not old."""
    robot = connect("--lockstep", "--seconds", "0.024")
    hellos = [Packet.parse(robot.socket.recv(2048)) for _ in range(2)]
    assert [(x.kind, x.sequence, x.answers) for x in hellos] == [(HELLO, 2, 0), (HELLO, 3, 0)]
    assert hellos[1].time - hellos[0].time > 0.09
    robot.sequence = 2**32 - 4
    for _ in range(6):
        robot.step()
    assert robot.sequence == 2
    assert robot.end() == (0, "50.004 s: BALANCING\npackets: 6 taken, 0 old, 0 garbage\n")


def test_it_damps_when_the_robot_has_damped_itself(connect: Callable[..., Robot]) -> None:
    """The robot's watchdog lets it sink: the stiffness does not come back."""
    robot = connect("--lockstep", "--stand-up", "--seconds", "0.02")
    for flags in (0, 0, 0, 1, 0):
        robot.send(robot.state(flags=flags))
        answer = robot.receive()
    assert not answer.gains[0].any()
    assert answer.gains[1].all()
    code, said = robot.end()
    assert code == 1
    states = ["STANDING_UP", "DAMPING, the program damped it: 0"]
    assert re.findall(r"\d s: (.*)\n", said) == states


class Driver:
    """A controller that connects to `fake_robot`."""

    def __init__(self, port: int):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        self.socket.settimeout(20.0)
        self.sequence, self.last = 0, 0
        expected = Controller(BEST, gains=True)
        assert expected.model.gains is not None
        torque = expected.model.gains[0] * expected.model.trim
        self.standing = np.concatenate((expected.targets, *expected.model.gains, torque))

    def hello(self) -> Packet:
        """Says hello; returns the first state."""
        self.sequence += 1
        self.socket.send(packet(HELLO, self.sequence, 0, 0.0))
        return self.receive()

    def receive(self) -> Packet:
        state = Packet.parse(self.socket.recv(2048))
        assert state.kind == STATE
        self.last = state.sequence
        return state

    def command(self, values: Any = None, answers: int | None = None) -> bytes:
        """The next command; without values, to stand."""
        self.sequence += 1
        answers = self.last if answers is None else answers
        return packet(
            COMMAND, self.sequence, answers, 0.0, self.standing if values is None else values
        )

    def step(self, *before: bytes, values: Any = None) -> Packet:
        """Sends a command, after other packets; returns the next state."""
        for content in (*before, self.command(values)):
            self.socket.send(content)
        return self.receive()


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """50 samples."""
    return scene_file(tmp_path_factory.mktemp("short"), "--duration", "0.2")


@pytest.fixture
def drive(
    built: Path, scene: Path, short: Path
) -> Iterator[Callable[..., tuple[Driver, subprocess.Popen[str]]]]:
    """Flags -> a driver of a fake robot, and the robot's program."""
    opened: list[tuple[Driver, subprocess.Popen[str]]] = []

    def begin(*flags: str) -> tuple[Driver, subprocess.Popen[str]]:
        file = short if "--lockstep" in flags else scene
        program, port = serve(built, file, *flags)
        opened.append((Driver(port), program))
        return opened[-1]

    yield begin
    for driver, program in opened:
        program.kill()
        program.communicate()
        driver.socket.close()


Drive = Callable[..., tuple[Driver, "subprocess.Popen[str]"]]


def test_the_fake_robot_drops_what_is_doubled_old_or_garbage(drive: Drive) -> None:
    """It stands as without; a stranger does not move it."""
    driver, program = drive("--lockstep")
    state = driver.hello()
    assert (state.sequence, state.time, state.damped) == (1, 0.0, False)
    assert np.abs(state.values[18:22] - [1, 0, 0, 0]).max() < 1e-2
    limp, first = np.zeros(48), driver.command()
    stranger = Driver(driver.socket.getpeername()[1])
    driver.socket.send(first)
    driver.receive()
    for k in range(48):
        bad = [
            np.where(np.arange(48) == k % 48, x, driver.standing.ravel()) for x in (np.nan, 1e39)
        ]
        negative = np.where(np.arange(48) == 12 + k % 24, -1.0, driver.standing.ravel())
        stranger.socket.send(packet(HELLO, 1, 0, 0.0))
        stranger.socket.send(packet(COMMAND, 1000 + k, driver.last, 0.0, limp))
        good = packet(COMMAND, driver.sequence + 100, driver.last, 0.0, limp)
        with np.errstate(over="ignore"):
            bad = [
                packet(COMMAND, driver.sequence + 100, driver.last, 0.0, np.float32(x))
                for x in (*bad, negative)
            ]
        state = driver.step(
            first, good[: -k - 1], good + b"\0", *bad, packet(STATE, 10**6, 0, 0.0, np.zeros(34))
        )
    assert abs(state.joints - driver.standing.reshape(4, 4, 3)[0]).max() < 0.02
    assert state.time == pytest.approx(0.196)
    driver.socket.send(driver.command())
    code, said, errors = end(program)
    stranger.socket.close()
    assert (code, errors) == (0, "")
    assert said.startswith("packets: 50 taken, 48 old, 288 garbage, 96 of others\nupright")


def test_the_watchdog_damps_and_stays(drive: Drive) -> None:
    """50 ms after the last command, in real time; later commands do not make it stiff again."""
    driver, _ = drive()
    state = driver.hello()
    began = time.monotonic()
    while not state.damped:
        state = driver.receive()
        assert time.monotonic() - began < 20.0
    assert state.sequence in (14, 15)
    for _ in range(5):
        state = driver.step()
    assert state.damped
    assert np.abs(state.values[22:34]).max() < 5.0, "servos only damp"


@pytest.mark.parametrize("answers", ["none", "old", "future"])
def test_a_command_to_an_old_state_is_none(answers: str, drive: Drive) -> None:
    """A connection that is 50 ms late is as bad as none."""
    driver, _ = drive()
    state = driver.hello()
    while not state.damped:
        late = {"none": 0, "old": max(state.sequence - 13, 0), "future": state.sequence + 500}
        driver.socket.send(driver.command(answers=late[answers]))
        state = driver.receive()
        assert state.sequence < 100


@pytest.mark.parametrize("side", ["balance", "fake_robot"])
def test_random_datagrams_do_no_harm(
    side: str, connect: Callable[..., Robot], drive: Drive
) -> None:
    """Of every size, or packets with a wrong bit, or with wrong numbers and a good CRC."""
    rng = np.random.default_rng(3)
    if side == "balance":
        robot = connect("--lockstep")
        send, kinds, program = robot.send, (STATE, HELLO), robot.program
        robot.step()
        ask = robot.step
    else:
        driver, program = drive("--lockstep")
        send, kinds = driver.socket.send, (COMMAND, HELLO)
        driver.hello()
        ask = driver.step
    for k in range(1200):
        kind = kinds[k % 2]
        whole = bytearray(packet(kind, 10**9 + k, 0, 0.0, rng.normal(size=BODY[kind].size // 4)))
        whole[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        if k % 8 < 2:
            whole[4:-4] = rng.bytes(len(whole) - 8)
            whole[-4:] = struct.pack("<I", zlib.crc32(whole[:-4]))
        send(bytes(whole) if k % 4 < 2 else rng.bytes(int(rng.integers(1400))))
        if k % 40 == 39:
            ask()  # nothing is lost in a queue
        assert program.poll() is None


MISTAKES: list[tuple[list[str], str]] = [
    (["balance"], "usage: balance sim "),
    (["balance", "udp", "127.0.0.1"], "usage: balance sim "),
    (["balance", "udp", "127.0.0.1", "9", "--seconds", "x"], "usage: balance sim "),
    (["balance", "sim", "--quick"], "usage: balance sim "),
    (["balance", "sim", "--scene", "nowhere"], "balance: nowhere is no scene of this version of"),
    (["balance", "sim", "--scene", "cut"], "balance: cut is no scene of this version of MuJoCo ("),
    (["balance", "sim", "--scene", "renamed"], "balance: the scene has no leg_dofs"),
    (["balance", "udp", "127.0.0.1", "9"], "balance: no robot answers at 127.0.0.1:9\n"),
    (["balance", "udp", "no.where.invalid", "9"], "balance: no.where.invalid:9 is no address: "),
    (["fake_robot"], "usage: fake_robot PORT "),
    (["fake_robot", "70000"], "usage: fake_robot PORT "),
    (
        ["fake_robot", "--scene", "scene.bin", "0", "--scenario", "9"],
        "fake_robot: the scene has no qpos 9",
    ),
    (["fake_robot", "used", "--scene", "scene.bin"], "cannot be used: "),
]


@pytest.mark.parametrize(("command", "sentence"), MISTAKES)
def test_mistakes_get_a_sentence(
    command: list[str], sentence: str, built: Path, scene: Path, tmp_path: Path
) -> None:
    content = scene.read_bytes()
    (tmp_path / "scene.bin").write_bytes(content)
    (tmp_path / "cut").write_bytes(content[: len(content) // 2])
    (tmp_path / "renamed").write_bytes(content.replace(b"leg_dofs", b"leg_dogs"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as used:
        used.bind(("127.0.0.1", 0))
        port = str(used.getsockname()[1])
        arguments = [port if x == "used" else x for x in command[1:]]
        done = subprocess.run(
            [built / command[0], *arguments], capture_output=True, text=True, cwd=tmp_path
        )
    assert (done.returncode, done.stdout) == (2, "")
    assert sentence in done.stderr


def test_a_policy_of_another_robot_is_refused(built: Path, scene: Path, tmp_path: Path) -> None:
    """Whose first joint is another one."""
    ids = np.frombuffer(records(scene)["leg_servos"], "<f8")
    file = changed(scene, tmp_path / "s", leg_servos=np.roll(ids, 3))
    code, _, errors = run(built / "balance", "sim", "--fast", "--scene", file)
    assert code == 2
    assert (
        errors
        == "balance: joint 0 of the scene is RH_abduction, but the policy's is LF_abduction\n"
    )


def test_suites_that_change_the_robot_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for suite in ("noise", "push", "soft", "weak", "payload"):
        with pytest.raises(SystemExit):
            scene_file(tmp_path, "--suite", suite)
        assert f"suite is {suite}; the simulation in C++ knows boards" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        scene_file(tmp_path, "--suite", "recover", "--lying")
    assert "a robot can lie only on a board that starts level" in capsys.readouterr().err
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit):
        scene_file(tmp_path / "file", "--duration", "0.2")
    assert "scene.bin cannot be written: " in capsys.readouterr().err


def test_the_gains_of_the_policy_are_those_of_the_scene() -> None:
    """The simulated servos get them from the policy, not from the model."""
    policy = load_policy(BEST)
    scene = suite_scene(policy_scene(policy), "corner")
    controller = Controller(BEST)
    model, servos = scene.model, scene.leg_ctrl
    assert (controller.stiffness == model.actuator_gainprm[servos, 0]).all()
    assert (controller.damping == model.dof_damping[scene.leg_qpos - 1]).all()
    assert controller.model.trim is not None
    np.testing.assert_allclose(controller.model.trim, scene.stance.leg_trim, rtol=0, atol=1e-7)


SDK = r"""
#include <array>
#include <cstdio>
#include "page.hpp"

template <typename T> class Field {  // as the SDK's messages: x() is the field
public:
    T &operator()() { return value_; }
private:
    T value_ = {};
};
struct Motor { Field<unsigned char> mode; Field<float> q, dq, kp, kd, tau, tau_est; };
struct Imu {
    Field<std::array<float, 4>> quaternion;
    Field<std::array<float, 3>> gyroscope, accelerometer;
};
struct Message { Field<std::array<Motor, 20>> motor_state, motor_cmd; Field<Imu> imu_state; };

int main()
{
    Message state, command;
    for (int k = 0; k < 20; ++k) {
        state.motor_state()[k].q() = static_cast<float>(k);
        state.motor_state()[k].tau_est() = static_cast<float>(100 + k);
    }
    state.imu_state().quaternion() = {1, 2, 3, 4};
    state.imu_state().gyroscope() = {5, 6, 7};
    state.imu_state().accelerometer() = {8, 9, 10};
    Sensors sensors = {};
    from_sdk(state, sensors);
    Targets targets = {};
    for (int k = 0; k < JOINTS; ++k) {
        targets.position[k] = sensors.joints[k];
        targets.stiffness[k] = 60;
        targets.damping[k] = 5;
        targets.torque[k] = sensors.torques[k];
        std::printf("%g ", sensors.joints[k]);
    }
    to_sdk(targets, command);
    bool same = sensors.quaternion[3] == 4 && sensors.gyro[2] == 7 && sensors.accelerometer[0] == 8;
    for (int k = 0; k < JOINTS; ++k) {
        Motor &motor = command.motor_cmd()[k];
        same = same && motor.mode() == 1 && motor.q() == static_cast<float>(k) && motor.dq() == 0 &&
               motor.kp() == 60 && motor.kd() == 5 && motor.tau() == static_cast<float>(100 + k);
    }
    return same ? 0 : 1;
}
"""
"""Messages with the fields that unitree_sdk2 gives them."""


@pytest.mark.slow
def test_the_pages_joint_order_is_the_sdks(tmp_path: Path) -> None:
    """Its code, compiled: motor k is joint k of FR, FL, RR, RL, both ways."""
    (code,) = re.findall(r"^```cpp\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    (tmp_path / "page.hpp").write_text(code)
    (tmp_path / "main.cpp").write_text(SDK)
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{EXAMPLE}"]
    program = tmp_path / "main"
    subprocess.run(
        [compiler("g++"), *flags, str(tmp_path / "main.cpp"), "-o", str(program)], check=True
    )
    status, said, _ = run(program)
    assert status == 0
    legs, parts = ("FR", "FL", "RR", "RL"), ("hip", "thigh", "calf")
    motors = [f"{leg}_{part}_joint" for leg in legs for part in parts]
    ours = [joint for leg in Controller(find_policy("go2")).joints for joint in leg]
    assert [motors[int(k)] for k in said.split()] == ours


@pytest.mark.slow
def test_a_robot_that_lies_stands_up(built: Path, tmp_path: Path) -> None:
    """In the simulation, and over UDP; then the board tilts."""
    file = scene_file(tmp_path, "--lying", "--duration", "10")
    code, said, errors = run(built / "balance", "sim", "--fast", "--stand-up", "--scene", file)
    assert (code, errors) == (0, "")
    assert re.findall(r"\d s: (\w+)", said) == ["STANDING_UP", "BALANCING"]
    alone = tilts(said)
    assert 0.05 < alone[0] < 0.2
    assert 0.5 < alone[1] < 2.0
    robot, port = serve(built, file, "--lockstep")
    flags = ("--lockstep", "--stand-up", "--seconds", 20)
    code, said, errors = run(built / "balance", "udp", "127.0.0.1", port, *flags)
    assert (code, errors) == (0, "")
    assert re.findall(r"\d s: (\w+)", said) == ["STANDING_UP", "BALANCING"]
    code, said, errors = end(robot)
    assert (code, errors) == (0, "")
    assert tilts(said) == pytest.approx(alone, abs=0.01)


SIZES = {"u8": "B", "u32": "I", "f64": "d", "f32": "f"}


def test_the_page_has_the_packets() -> None:
    """Its tables, read as formats, are those of this file; their offsets add up."""
    for title, expected, begin in (
        ("Header", HEADER.format, 0),
        ("State", BODY[STATE].format, 24),
        ("Command", BODY[COMMAND].format, 24),
    ):
        section = PAGE.partition(f"**{title}**")[2].partition("\n\n| ")[2].partition("\n\n")[0]
        rows = [[x.strip() for x in line.split("|")[1:3]] for line in section.splitlines()[2:]]
        code = "<"
        for offset, kind in rows:
            assert int(offset) == begin + struct.calcsize(code)
            count, _, name = kind.rpartition(" ")
            code += f"{count}{SIZES.get(name, 's')}"
        assert code == expected, title
    sizes = re.findall(r"(\d+) bytes", PAGE)
    for kind in (HELLO, STATE, COMMAND):
        assert str(28 + BODY[kind].size) in sizes
