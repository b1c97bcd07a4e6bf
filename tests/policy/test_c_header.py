"""The exported C header: it compiles everywhere, and does what the runtime in Python does."""

import ctypes
import math
import re
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.headers import (
    STATES,
    STRICT,
    CController,
    build,
    compile_header,
    compiler,
    sample_row,
)
from fixtures.policies import LAYOUTS, random_policy, rewrite, with_head
from fixtures.streams import evaluation_samples
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_balance.cli import main
from mjx_balance.config import Config
from mjx_balance.policy.c_header import c_string, export_header
from mjx_balance.policy.file import shipped_policies
from mjx_balance.runtime import RESPONSES, Controller, Fault, State

SHIPPED = shipped_policies()
AGREE = 1e-6
"""rad. Both compute in double from the same float32 weights; an input or a layer that is rounded to
float32 the other way changes a command of 3 mm by 1e-7 of it."""
TEMPLATE = Path(__file__).parents[2] / "mjx_balance/policy/runtime.h.in"


class Pair:
    """The runtime in Python and in C, side by side."""

    def __init__(self, path: Path, library: Any, gains: bool, calls: int = 1):
        self.now = 100.0
        rate = None if calls == 1 else calls * 250.0
        self.python = Controller(
            path, lambda: self.now, gains=gains, sample_rate=rate, max_temperature=80.0
        )
        self.c = CController(library, 4, gains, calls, 0.0, 80.0)
        self.period, self.agree = self.python.sample_dt / calls, AGREE

    def act(self, name: str) -> None:
        for controller in (self.python, self.c):
            getattr(controller, name)(*(["x"] if name in ("hold", "damp") else []))
        self.compare()

    def step(
        self, joints: Any, gyro: Any, accelerometer: Any, after: float = 1.0, **more: Any
    ) -> None:
        """A sample, in float32, so many periods after the last one."""
        self.now += after * self.period
        sensors = [np.asarray(x, np.float32) for x in (joints, gyro, accelerometer)]
        more = {name: np.asarray(x, np.float32) for name, x in more.items()}
        self.python.step(sensors[0], sensors[1], sensors[2], **more)
        with np.errstate(over="ignore"):
            self.c.step(sensors[0], sensors[1], sensors[2], self.now, **more)
        self.compare()

    def compare(self) -> None:
        """State, fault, decision, targets and gains."""
        python, c = self.python, self.c
        assert (c.state, c.fault) == (python.state, python.fault), python.reason
        assert c.action == python.action
        assert (np.abs(c.targets - python._targets) <= self.agree).all()
        if python.command is not None:
            assert (np.abs(c.command - python.command) <= 1e-8).all()
        if python.model.gains is not None:
            torque = 0.0 if python.torque is None else python.torque
            for own, expected in zip(
                c.gains, (python.stiffness, python.damping, torque), strict=True
            ):
                assert (np.abs(own - expected) <= 1e-9).all()  # pyright: ignore


def compare_evaluation(name: str, library: Any, suite: str, count: int, seconds: float) -> int:
    """Feeds an evaluation's samples to both; returns the number of decisions."""
    now = 0.0
    decisions, python = 0, Controller(SHIPPED[name], lambda: now)
    for samples in evaluation_samples(SHIPPED[name], suite, count, seconds):
        expected, rows = [], []
        python.reset()
        for joints, gyro, accelerometer in samples:
            now += python.sample_dt
            targets = python.step(joints, gyro, accelerometer)
            state = STATES.index(python.state)
            expected.append((state, int(python.fault), python.action, *targets.ravel()))
            rows.append(sample_row(joints, gyro, accelerometer, now))
        outputs = CController(library, 4).run(np.stack(rows))
        expected = np.asarray(expected, float)
        np.testing.assert_array_equal(outputs[:, [0, 1, 4]], expected[:, :3])
        np.testing.assert_allclose(outputs[:, 7:19], expected[:, 3:], rtol=0, atol=AGREE)
        balancing = expected[:, 0] == STATES.index(State.BALANCING)
        decisions += int(balancing[:: python.decision_samples].sum())
    return decisions


@pytest.mark.parametrize("name", ["best", "real"])
def test_it_decides_as_the_runtime_in_an_evaluation(name: str, build_shipped: Any) -> None:
    assert compare_evaluation(name, build_shipped(SHIPPED[name]), "corner", 2, 30.0) >= 298


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize(
    "scenarios", [pytest.param(1, marks=pytest.mark.slow), pytest.param(12, marks=pytest.mark.long)]
)
def test_it_decides_as_the_runtime_with_every_policy(
    name: str, scenarios: int, build_shipped: Any
) -> None:
    """At 900 decisions each, or at 10,800."""
    decisions = 0
    for suite in ("corner", "push", "noise"):
        decisions += compare_evaluation(name, build_shipped(SHIPPED[name]), suite, scenarios, 60.0)
    assert decisions >= 890 * scenarios


def actions_of(pair: Pair, decisions: int) -> set[int]:
    """The actions of both while they balance by random joints and samples."""
    rng, actions = np.random.default_rng(1), set()
    for _ in range(decisions * pair.python.decision_samples):
        imu = rng.normal((0, 0, 0, 0, 0, 9.81), (0.02, 0.02, 0.02, 0.2, 0.2, 0.2))
        pair.step(pair.python.targets + rng.normal(0, 0.03, (4, 3)), imu[:3], imu[3:])
        actions.add(pair.python.action)
    assert pair.python.state is State.BALANCING
    return actions


@pytest.mark.parametrize("layout", LAYOUTS)
def test_it_runs_any_layout(layout: str, tmp_path: Path, config: Config) -> None:
    """Random weights, joints and samples; and names that C must not misread."""
    head, changes = LAYOUTS[layout]
    path = tmp_path / "p"
    random_policy(path, with_head(config, head, body_height=0.33, **changes))
    names = ['a"b', "??/\\n", "über%s"]
    rewrite(path, lambda w, m: m["robot"]["legs"][1].update(joints=names))
    library = build(path, tmp_path / "c")
    library.name.restype = library.reason.restype = ctypes.c_char_p
    assert [library.name(1, k).decode() for k in range(3)] == names
    assert Controller(path).joints[1] == names
    pair = Pair(path, library, False)
    assert len(actions_of(pair, 24)) > 4


def test_it_runs_more_means_than_a_byte_counts(tmp_path: Path, config: Config) -> None:
    """266 leaky means and angles, each with a time constant of its own."""
    times = {
        "mean_times": tuple(np.linspace(0.1, 5.0, 65).tolist()),
        "filter_times": (0.5, 2.0, 4.0),
    }
    random_policy(tmp_path / "p", with_head(config, "radial", body_height=0.33, **times))
    pair = Pair(tmp_path / "p", build(tmp_path / "p", tmp_path / "c"), False)
    assert len(pair.python.model.inputs.slow) > 256
    assert len(actions_of(pair, 6)) > 2


FAULTS = ("nan", "wide", "late", "stale", "lean", "fall", "stuck", "away", "tilt", "hot", "strain")
SEGMENTS = st.tuples(
    st.sampled_from(("still", "still", "roll", "push", "shake", *FAULTS)),
    st.integers(1, 110),
    st.integers(0, 2**32 - 1),
)


def play(pair: Pair, kind: str, count: int, seed: int) -> None:
    """Samples of a robot to which something happens."""
    rng = np.random.default_rng(seed)
    first = pair.python.targets
    old = rng.normal((0, 0, 0, 0, 0, 9.81), 0.02)
    for k in range(count):
        joints, after, more = pair.python.targets + rng.normal(0, 0.001, (4, 3)), 1.0, {}
        imu = rng.normal((0, 0, 0, 0, 0, 9.81), (*[0.002] * 3, *[0.02] * 3))
        if kind in ("roll", "push"):
            imu[:2] += 0.05 if kind == "roll" else rng.normal(0, 1.0, 2)
            imu[3:5] += 0.5 if kind == "roll" else rng.normal(0, 5.0, 2)
        elif kind == "shake":
            imu[2] += 0.2 * (k % 20 == 0)
        elif kind == "nan" and k == count - 1:
            imu[rng.integers(6)] = rng.choice((math.nan, math.inf, -math.inf, 1e30))
        elif kind == "wide" and k == count - 1:
            joints[rng.integers(4), rng.integers(3)] = rng.choice((math.nan, 4.0, -9.0))
        elif kind == "late" and k == count - 1:
            after = rng.choice((6.0, -1.0, 1e9, math.nan))
        elif kind == "stale":
            imu = old
        elif kind == "lean":
            imu[3:] = rng.normal((0, 9.81, 0), 0.02)
        elif kind == "fall":
            imu[:2] += rng.choice((0.3, 1.5))
        elif kind == "stuck":
            joints = first
        elif kind == "away":
            joints[seed % 4, seed % 3] += 0.7
        elif kind == "tilt":
            angle = math.radians(rng.uniform(0, 25)) / 2
            more["quaternion"] = [math.cos(angle), 0, math.sin(angle), rng.choice((0, 0, 0, 0.6))]
        elif kind == "hot":
            more["temperatures"] = np.full((4, 3), rng.uniform(70, 85))
        elif kind == "strain":
            more["torques"] = np.full((4, 3), rng.uniform(-30, 30))
        pair.step(joints, imu[:3], imu[3:], after, **more)


@pytest.fixture(scope="session")
def trimmed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """The shipped policy with a trim, and its library."""
    folder = tmp_path_factory.mktemp("trimmed")
    path = folder / "p.safetensors"
    assert main(["export", "best", "--trim", "--out", str(path)]) == 0
    return path, build(path, folder / "c")


@settings(max_examples=20, deadline=None)
@given(
    gains=st.booleans(),
    calls=st.sampled_from((1, 1, 2, 4)),
    stands=st.booleans(),
    segments=st.lists(SEGMENTS, min_size=1, max_size=6),
)
def test_it_does_what_the_runtime_does_whatever_happens(
    trimmed: tuple[Path, Any],
    gains: bool,
    calls: int,
    stands: bool,
    segments: list[tuple[str, int, int]],
) -> None:
    """State and fault at every sample, targets and gains; also over a reset in the middle."""
    pair = Pair(*trimmed, gains, calls)
    if calls > 1:
        pair.agree = 1e-5  # the mean of several samples is rounded to float32
    if stands:
        if gains:
            play(pair, "still", 1, 0)
        pair.act("stand")
        low, high = pair.python.model.legs.limits()
        beyond = np.tile((0.0, 0.0, 0.25), 4)
        shares = np.random.default_rng(len(segments)).random(12)
        pose = low - beyond + shares * (high - low + 2 * beyond)
        pair.step(pose.reshape(4, 3), [0, 0, 0], [0, 0, 9.81])
        play(pair, "still", 260 if len(segments) % 2 else 900 * calls, 1)
    for segment in segments:
        if pair.python.state in (State.HOLDING, State.DAMPING) and segment[2] % 3 == 0:
            pair.act("reset")
            pair.act("stand")
        play(pair, *segment)


@pytest.mark.parametrize("fault", [x for x in Fault if x is not Fault.NONE])
def test_every_fault_has_its_code_state_and_sentence(
    fault: Fault, build_shipped: Any, trimmed: tuple[Path, Any], tmp_path: Path
) -> None:
    """Each is reached in both, with gains; its sentence is another one than the others'."""
    path, library = trimmed
    if fault is Fault.NETWORK:
        path = tmp_path / "p"
        path.write_bytes(SHIPPED["best"].read_bytes())
        rewrite(path, lambda w, m: w["hidden_0/kernel"].fill(3e38))
        library = build(path, tmp_path / "c")
    pair = Pair(path, library, True)
    play(pair, "still", 1, 0)
    pair.act("stand")
    play(pair, "still", 1300 if fault is not Fault.NETWORK else 760, 1)
    if fault is Fault.NETWORK:
        play(pair, "still", 600, 2)
    elif fault in (Fault.HELD, Fault.DAMPED):
        pair.act("hold" if fault is Fault.HELD else "damp")
    elif fault is Fault.CLOCK:
        pair.step(pair.python.targets, [0, 0, 0], [0, 0, 9.81], math.inf)
    elif fault is Fault.RATE:
        for k in range(150):
            pair.step(pair.python.targets, [0, 0, 1e-4 * k], [0, 0, 9.81], 1.2)
    elif fault is Fault.WEIGHT:
        for k in range(150):
            pair.step(pair.python.targets, [0, 0, 1e-4 * k], [0, 0, 1.0])
    elif fault is Fault.STUCK:
        first = pair.python.targets
        for k in range(2000):
            imu = [0.05, 0.02, 1e-4 * (k % 50)], [1.0, 0.5, 9.8 + 1e-4 * (k % 50)]
            joints = pair.python.targets
            joints[0, 1:] = first[0, 1:]
            pair.step(joints, *imu)
    else:
        kind = {
            *((Fault.READING, "nan"), (Fault.LATE, "late"), (Fault.STALE, "stale")),
            *((Fault.LEAN, "lean"), (Fault.TILT, "tilt"), (Fault.AWAY, "away")),
            *((Fault.TEMPERATURE, "hot"), (Fault.TORQUE, "still"), (Fault.TUMBLING, "fall")),
        }
        play(pair, dict(kind)[fault], 150, 3)
    if fault in (Fault.TORQUE, Fault.TEMPERATURE, Fault.TUMBLING):
        more: dict[str, Any] = {"torques": np.full((4, 3), -44)} if fault is Fault.TORQUE else {}
        more |= {"temperatures": np.full((4, 3), 81)} if fault is Fault.TEMPERATURE else {}
        gyro = 1.5 if fault is Fault.TUMBLING else 0.0
        for k in range(100):
            pair.step(pair.python.targets, [gyro, 0, 1e-4 * k], [0, 0, 9.81], **more)
    assert pair.c.fault is fault
    assert pair.c.state is RESPONSES[fault]
    library.reason.restype = ctypes.c_char_p
    sentences = [library.reason(int(x)).decode() for x in Fault]
    assert len(set(sentences)) == len(Fault)
    assert all(0 < len(x) < 100 for x in sentences[1:])


@pytest.mark.parametrize("sensor", ["joints", "gyro", "quaternion", "accelerometer"])
def test_a_bad_reading_hides_no_fall_in_either(sensor: str, build_shipped: Any) -> None:
    """It holds, for good without a number from a sensor; then the robot lies on its side."""
    pair = Pair(SHIPPED["best"], build_shipped(SHIPPED["best"]), True)
    pair.act("hold")
    sample: dict[str, Any] = {
        "joints": pair.python.targets,
        "gyro": [0, 0, 0],
        "accelerometer": [0, 0, 9.81],
        "quaternion": [1, 0, 0, 0],
    }
    side: dict[str, Any] = {"accelerometer": [0, 9.81, 0], "quaternion": [0.7071, 0.7071, 0, 0]}
    broken: dict[str, Any] = {sensor: np.full(np.shape(sample[sensor]), math.nan)}
    for k in range(200):
        pair.step(**(sample | (side if k > 70 else {}) | broken))
        assert (pair.c.state is State.DAMPING) == (k >= (99 if sensor == "quaternion" else 71))
    assert pair.c.fault is (Fault.LEAN if sensor == "quaternion" else Fault.TILT)


@pytest.mark.parametrize("kind", ["tilt", "gyro", "joint", "hold"])
def test_a_fault_at_the_first_sample_moves_no_leg_in_either(kind: str, build_shipped: Any) -> None:
    """Position servos, and a robot that lies; a joint without a reading waits for one."""
    pair = Pair(SHIPPED["best"], build_shipped(SHIPPED["best"]), False)
    standing, nan = pair.python.targets, math.nan
    lying = (standing + np.tile([0.0, 0.3, -0.4], (4, 1))).astype(np.float32)
    first, gyro = lying.copy(), [0.0, nan if kind == "gyro" else 0.0, 0.0]
    quaternion = [0.7071, 0.7071, 0, 0] if kind == "tilt" else [1, 0, 0, 0]
    if kind == "joint":
        first[1, 2] = nan
    pair.act("stand")
    if kind == "hold":
        pair.act("hold")
    pair.step(first, gyro, [0, 0, 9.81], quaternion=quaternion)
    assert pair.c.state is State.HOLDING
    expected = np.where(np.isnan(first), standing, lying)
    np.testing.assert_allclose(pair.c.targets, expected, rtol=0, atol=1e-6)
    pair.step(lying, [0, 0, 0], [0, 0, 9.81])
    pair.step(standing, [0, 0, 0], [0, 0, 9.81])
    np.testing.assert_allclose(pair.c.targets, lying, rtol=0, atol=1e-6)


@pytest.mark.parametrize("load", ["torques", "temperatures"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_load_that_is_no_number_holds_in_both(
    load: str, value: float, build_shipped: Any
) -> None:
    """At once, and at its joint; a fault of the servo itself would damp."""
    pair = Pair(SHIPPED["best"], build_shipped(SHIPPED["best"]), True)
    values: dict[str, Any] = {load: np.where(np.arange(12).reshape(4, 3) == 7, value, 0.0)}
    pair.act("stand")
    play(pair, "still", 20, 0)
    pair.step(pair.python.targets, [0, 0, 0], [0, 0, 9.81], **values)
    assert (pair.c.state, pair.c.fault) == (State.HOLDING, Fault.READING)
    assert pair.c._values[2] == 7
    np.testing.assert_equal(pair.c._values[3], value)


@pytest.mark.parametrize("now", [math.nan, -math.inf])
def test_a_first_sample_without_a_time_holds_in_both(now: float, build_shipped: Any) -> None:
    pair = Pair(SHIPPED["best"], build_shipped(SHIPPED["best"]), False)
    pair.now = now
    pair.step(pair.python.targets, [0, 0, 0], [0, 0, 9.81])
    assert (pair.c.state, pair.c.fault) == (State.HOLDING, Fault.CLOCK)


def test_samples_in_bursts_hold_at_the_second_decision(trimmed: tuple[Path, Any]) -> None:
    """The last 20 of each decision's 50 samples are the same; a decision between them is whole."""
    for gaps, holds in (((1, 1), True), ((1, 0, 1), False)):
        pair = Pair(*trimmed, False)
        play(pair, "still", 101, 0)
        for gap in gaps:
            for k in range(50):
                value = 1e-3 * min(k, 29) if gap else 1e-3 * k
                sample = [0.05, value, 0.0], [0.3, 0.5, 9.8 - value]
                pair.step(pair.python.targets, *sample)
        assert (pair.c.fault is Fault.STALE) == holds


def test_the_header_has_the_runtimes_codes() -> None:
    """State and Fault as MJXB_ names with the same numbers."""
    codes = dict(re.findall(r"^    MJXB_(\w+) = (\d+)", TEMPLATE.read_text(), re.M))
    expected = {state.name: str(k) for k, state in enumerate(State)}
    expected |= {fault.name: str(int(fault)) for fault in Fault}
    assert codes == expected


@pytest.mark.parametrize(
    ("name", "flags"),
    [
        ("gcc", ("-std=c99", "-O2", "-fPIC", "-shared", *STRICT)),
        ("clang", ("-std=c99", "-O2", "-fPIC", "-shared", *STRICT)),
        ("g++", ("-std=c++17", "-O2", "-fPIC", "-shared", "-x", "c++", *STRICT)),
        ("clang++", ("-std=c++17", "-O2", "-fPIC", "-shared", "-x", "c++", *STRICT)),
    ],
)
def test_it_compiles_without_a_warning(name: str, flags: tuple[str, ...], tmp_path: Path) -> None:
    assert main(["export", "real", "--out", str(tmp_path / "real.h")]) == 0
    compile_header(tmp_path / "real.h", tmp_path / "out", name, *flags)


@pytest.mark.parametrize("name", ["gcc", "clang", "g++"])
@pytest.mark.parametrize("flag", ["-Ofast", "-ffast-math", "-ffinite-math-only"])
def test_it_refuses_flags_that_remove_its_checks(name: str, flag: str, tmp_path: Path) -> None:
    """There a NaN is in every range."""
    export_header(SHIPPED["best"], tmp_path / "policy.h", "0" * 16)
    command = [compiler(name), flag, "-fsyntax-only", str(tmp_path / "policy.h")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode != 0
    assert "without -ffast-math" in done.stderr


ALONE = '#include "policy.h"\nmjxb_controller controller;\n' + "".join(
    f"{kind} {name}({argument}); {kind} {name}({argument}) {{ {body}; }}\n"
    for kind, name, argument, body in (
        ("mjxb_state", "step", "const mjxb_sample *s", "return mjxb_step(&controller, s)"),
        ("bool", "start", "const mjxb_options *o", "return mjxb_init(&controller, o)"),
        ("void", "stand", "void", "mjxb_stand(&controller)"),
    )
)


def test_it_fits_into_a_microcontroller(tmp_path: Path, record_property: Any) -> None:
    """Cortex-M7: flash and RAM of the shipped policy, without the C library."""
    assert main(["export", "best", "--trim", "--out", str(tmp_path / "policy.h")]) == 0
    (tmp_path / "main.c").write_text(ALONE)
    flags = ["-mcpu=cortex-m7", "-std=c99", "-Os", *STRICT, "-c", "main.c", "-o", "main.o"]
    subprocess.run([compiler("arm-none-eabi-gcc"), *flags], check=True, cwd=tmp_path)
    size = [compiler("arm-none-eabi-size"), "main.o"]
    output = subprocess.run(size, check=True, cwd=tmp_path, capture_output=True, text=True).stdout
    text, data, bss = map(int, output.splitlines()[1].split()[:3])
    print(f"flash {text + data} B, RAM {data + bss} B")
    record_property("flash", text + data)
    assert text + data <= 64 * 1024
    assert data + bss <= 8 * 1024


def test_the_sanitizers_find_nothing(trimmed: tuple[Path, Any], tmp_path: Path) -> None:
    """A stream of random and hostile samples, acts in between; the outputs are the library's."""
    path, library = trimmed
    header, program = tmp_path / "policy.h", tmp_path / "program"
    export_header(path, header, "0" * 16)
    flags = ("-std=c99", "-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    compile_header(header, program, "gcc", *flags, "-DMAIN", *STRICT)
    rng, rows = np.random.default_rng(0), []
    wild = np.asarray((0.0, -0.0, 1e-40, 4.0, 1e30, -1e30, math.inf, -math.inf, math.nan))
    standing = Controller(path).targets
    for k in range(20_000):
        imu = rng.normal((0, 0, 0, 0, 0, 9.81), 0.02)
        quaternion = [1, 0, 0, 0] if k % 5 == 0 else None
        row = sample_row(standing, imu[:3], imu[3:], 0.004 * k, quaternion)
        if rng.random() < 0.01:
            row[1 + rng.integers(len(row) - 1)] = rng.choice(wild)
        if rng.random() < 0.003:
            row[0] = -1 - rng.integers(4)
        elif k % 1500 < 2:
            row[0] = -1.0 - k % 1500
        rows.append(row)
    stream = np.stack(rows)
    done = subprocess.run([program], input=stream.tobytes(), capture_output=True)
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    outputs = np.frombuffer(done.stdout).reshape(len(rows), -1)
    c, acts = CController(library, 4, True, 1, 0.0, 80.0), ("reset", "stand", "hold", "damp")
    for row, output in zip(rows, outputs, strict=True):
        if row[0] < 0:
            getattr(c, acts[int(-row[0]) - 1])()
        else:
            data = (ctypes.c_void_p(x.ctypes.data) for x in (row, c._values))
            library.take(c._pointer, *data)
        np.testing.assert_allclose(c._values, output, rtol=1e-5, atol=1e-6)
    assert len({int(x) for x in outputs[:, 0]}) >= 4


def test_options_that_cannot_be_are_refused(trimmed: tuple[Path, Any], tmp_path: Path) -> None:
    _, library = trimmed
    for calls in (0, 65, -1):
        with pytest.raises(ValueError, match="refuses"):
            CController(library, 4, False, calls)
    path = tmp_path / "p"
    path.write_bytes(SHIPPED["best"].read_bytes())
    rewrite(path, lambda w, m: m["robot"].pop("servo_damping"))
    without = build(path, tmp_path / "c")
    assert CController(without, 4, False).state is State.STANDING
    with pytest.raises(ValueError, match="refuses"):
        CController(without, 4, True)


@pytest.mark.parametrize("out", ["policy.c", "policy", "policy.hpp", "policy.H"])
def test_another_suffix_is_refused(out: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "best", "--out", out]) == 2
    expected = f"out is {out}; its name must end in .onnx, .h or .safetensors\n"
    assert capsys.readouterr().err == f"mjx-balance: {expected}"


def test_text_becomes_a_literal_that_c_reads_as_it_is() -> None:
    """Octal has three digits, so that no digit after it counts."""
    assert c_string('a"\\?1') == r'"a\042\134\0771"'
    assert c_string("é1") == r'"\303\2511"'


def test_numbers_survive_their_text(tmp_path: Path, config: Config) -> None:
    """Every weight, read back from the header, is the policy's bit for bit."""
    policy = random_policy(tmp_path / "p", with_head(config, "radial"))
    export_header(tmp_path / "p", tmp_path / "p.h", "0" * 16)
    text = (tmp_path / "p.h").read_text()
    body = re.search(r"mjxb_weights\[\] = \{(.*?)\};", text, re.S)
    assert body is not None
    numbers = np.asarray([x.rstrip("f") for x in re.findall(r"[^\s,]+", body[1])], np.float32)
    expected = np.concatenate([x.ravel() for layer in policy.layers for x in layer])
    np.testing.assert_array_equal(numbers, expected)
