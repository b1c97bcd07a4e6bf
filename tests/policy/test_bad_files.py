"""Bad policy files: the package and the runtime refuse them, in a sentence that names the file."""

import itertools
import json
import math
import os
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from fixtures.policies import Edit, random_policy, read_manifest, rewrite, spoiled, with_head
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_balance.config import Config
from mjx_balance.policy.file import load_policy
from mjx_balance.policy.manifest import PolicyError
from mjx_balance.runtime import Controller, PolicyFileError


def run_package(path: Path) -> None:
    """Values of all actions."""
    with np.errstate(over="ignore", invalid="ignore"):
        assert load_policy(path).q_values(np.zeros(34)).shape == (441,)


def run_runtime(path: Path) -> None:
    """Finite targets."""
    ticks = itertools.count()
    controller = Controller(path, lambda: 0.004 * next(ticks))
    accel = np.array([0.3, 0.5, 9.8])
    for k in range(3):
        targets = controller.step(controller.targets, np.array([0.05, 0.001 * k, 0]), accel)
        assert np.isfinite(targets).all()


READERS = {"package": (run_package, PolicyError), "runtime": (run_runtime, PolicyFileError)}
by_both = pytest.mark.parametrize("reader", READERS)


def assert_refused(reader: str, path: Path, message: str) -> None:
    run, error = READERS[reader]
    with pytest.raises(error, match=message) as caught:
        run(path)
    sentence = str(caught.value)
    assert str(path) in sentence
    assert sentence.isprintable()
    assert len(sentence) <= 300


def assert_edit_refused(reader: str, content: bytes, path: Path, edit: Edit, message: str) -> None:
    path.write_bytes(content)
    rewrite(path, edit)
    assert_refused(reader, path, message)


def works_or_is_refused(reader: str, path: Path) -> None:
    run, error = READERS[reader]
    sentence = ""
    try:
        run(path)
    except error as refusal:
        sentence = str(refusal)
    assert sentence.isprintable()
    assert len(sentence) <= 300


def content(folder: Path, config: Config) -> bytes:
    """A sound policy file's content."""
    random_policy(folder / "p", config)
    return (folder / "p").read_bytes()


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory, config: Config) -> bytes:
    return content(tmp_path_factory.mktemp("sound"), with_head(config, "factored"))


@pytest.fixture(scope="module")
def radial(tmp_path_factory: pytest.TempPathFactory, config: Config) -> bytes:
    return content(tmp_path_factory.mktemp("radial"), with_head(config, "radial"))


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file to spoil again and again."""
    return tmp_path_factory.mktemp("scratch") / "p.safetensors"


@by_both
@pytest.mark.parametrize("name", ["nowhere", ".", "pipe"])
def test_what_is_no_regular_file_is_refused(reader: str, name: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    reason = "No such" if name == "nowhere" else "no regular"
    message = {"package": "no policy file at", "runtime": f"used: it cannot be read: .*{reason}"}
    assert_refused(reader, tmp_path / name, message[reader])


@pytest.mark.parametrize("path", ["/dev/zero", "/dev/stdin"])
def test_a_device_is_no_policy(path: str) -> None:
    with pytest.raises(PolicyFileError, match="it is no regular file"):
        Controller(path)
    with pytest.raises(PolicyError, match="no policy file at /dev"):
        load_policy(path)


@pytest.mark.skipif(not Path("/proc/self/pagemap").exists(), reason="Linux only")
def test_a_file_without_end_is_not_read_to_its_end() -> None:
    """Linux says that this one is regular and has no bytes; reading goes on for 256 GiB."""
    start = time.process_time()
    with pytest.raises(PolicyFileError, match=r"67108865 bytes|cannot be read"):
        Controller("/proc/self/pagemap")
    with pytest.raises(PolicyError, match=r"cannot be used|damaged"):
        load_policy("/proc/self/pagemap")
    assert time.process_time() - start < 3


@pytest.mark.parametrize(
    "path", [None, 5, b"policy", [], "a\0b", "\x1b[2J" + 5_000 * "a"], ids=repr
)
def test_what_is_no_path_is_refused(path: Any) -> None:
    for read, error in ((Controller, PolicyFileError), (load_policy, PolicyError)):
        with pytest.raises(error) as caught:
            read(path)
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) <= 300


def test_a_long_path_leaves_room_for_the_reason(tmp_path: Path) -> None:
    folder = tmp_path.joinpath(*(40 * "x" for _ in range(8)))
    folder.mkdir(parents=True)
    (folder / "p").write_bytes(b"")
    for read, error in ((Controller, PolicyFileError), (load_policy, PolicyError)):
        with pytest.raises(error, match=r"damaged or no safetensors file: .*$") as caught:
            read(folder / "p")
        assert len(str(caught.value)) <= 300


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda sound: b"",
    "cut in its first number": lambda sound: sound[:4],
    "cut in its header": lambda sound: sound[:100],
    "cut at its end": lambda sound: sound[:-1],
    "too long": lambda sound: sound + b"\0\0\0\0",
    "text": lambda sound: b"The quick brown fox jumps over the lazy dog.\n" * 20,
    "header of a list": lambda sound: sound[:8] + b"[" + sound[9:],
}


@by_both
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_file_is_refused(reader: str, damage: str, sound: bytes, scratch: Path) -> None:
    scratch.write_bytes(DAMAGES[damage](sound))
    assert_refused(reader, scratch, "damaged or no safetensors file")


@by_both
def test_a_file_beyond_every_policy_is_not_even_read(reader: str, tmp_path: Path) -> None:
    with (tmp_path / "p").open("wb") as file:
        file.truncate(2**33)  # 8 GiB on paper, next to nothing on the disk
    assert_refused(reader, tmp_path / "p", "8589934592 bytes")


def packed(header: dict[str, Any], body: bytes) -> bytes:
    """A safetensors file, past every check."""
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + body


@by_both
@pytest.mark.parametrize("reads", ["all of it", "backward", "beyond its end"])
def test_weights_that_lie_over_each_other_are_refused_before_they_are_copied(
    reader: str, reads: str, scratch: Path
) -> None:
    """Three hundred times 50 MiB would be 15 GiB."""
    size = 50 * 2**20
    place = {"all of it": [0, size], "backward": [8, 0], "beyond its end": [0, 40 * size]}[reads]
    entry = {"dtype": "F32", "shape": [size // 4], "data_offsets": place}
    header = {"__metadata__": {"manifest": "{}"}, **{f"w{k}": entry for k in range(300)}}
    scratch.write_bytes(packed(header, bytes(size)))
    start = time.process_time()
    assert_refused(reader, scratch, "damaged or no safetensors file")
    assert time.process_time() - start < 1


@by_both
def test_a_weight_of_negative_length_makes_no_room_for_others(reader: str, scratch: Path) -> None:
    """Lengths whose sum is the file's: seven weights of all 50 MiB, the last from its end back."""
    size, weights = 50 * 2**20, 7
    entry = {"dtype": "F32", "shape": [size // 4], "data_offsets": [0, size]}
    header: dict[str, Any] = {f"w{k}": entry for k in range(weights)}
    header["last"] = {**entry, "data_offsets": [(weights - 1) * size, 0]}
    scratch.write_bytes(packed({"__metadata__": {"manifest": "{}"}, **header}, bytes(size)))
    tracemalloc.start()
    try:
        assert_refused(reader, scratch, "damaged or no safetensors file")
        assert tracemalloc.get_traced_memory()[1] < 3 * size, "the file alone is read twice at most"
    finally:
        tracemalloc.stop()


@by_both
@pytest.mark.parametrize("entries", [0, 200_000])
def test_a_huge_header_is_refused_at_once(reader: str, entries: int, scratch: Path) -> None:
    """Of one long text, or of many weights without numbers."""
    entry = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
    header = {f"w{k}": entry for k in range(entries)}
    manifest = {"manifest": json.dumps(0 if entries else [[]] * 3_000_000)}
    scratch.write_bytes(packed({"__metadata__": manifest, **header}, b""))
    start = time.process_time()
    assert_refused(reader, scratch, "its header has [0-9]+ bytes")
    assert time.process_time() - start < 1


@by_both
def test_a_huge_manifest_is_refused_before_it_is_parsed(
    reader: str, sound: bytes, scratch: Path
) -> None:
    """Of 1.7 million lists; its header is not yet too large. Found by fuzzing."""
    text = json.dumps([[]] * 1_700_000, separators=(",", ":"))
    metadata = {"manifest": text}
    safetensors.numpy.save_file(safetensors.numpy.load(sound), scratch, metadata=metadata)
    assert_refused(reader, scratch, "its manifest has 5100001 characters")


@by_both
def test_many_weights_beside_a_large_one_take_no_time(reader: str, scratch: Path) -> None:
    """Each is read once; a copy of 50 MiB for each takes half a minute."""
    weights = {f"w{k}": np.zeros(0, np.float32) for k in range(1_000)}
    weights["large"] = np.zeros(13_000_000, np.float32)
    safetensors.numpy.save_file(weights, scratch, metadata={"manifest": "{}"})
    start = time.process_time()
    assert_refused(reader, scratch, "it has 1001 weights, more than 1000")
    assert time.process_time() - start < 5


TEXTS = {
    "lists": "[" * 100_000,
    "objects": '{"a":' * 50_000,
    "digits": "9" * 5_000,
    "nan": "NaN",
    "cut": '{"config": ' + "[" * 9_000,
    "question mark": "?",
    "no object": "[]",
    "none": None,
}


@by_both
@pytest.mark.parametrize("text", TEXTS)
def test_a_manifest_that_is_none_is_refused(
    reader: str, text: str, sound: bytes, scratch: Path
) -> None:
    metadata = {"manifest": TEXTS[text]} if TEXTS[text] else None
    safetensors.numpy.save_file(safetensors.numpy.load(sound), scratch, metadata=metadata)
    assert_refused(reader, scratch, "manifest is|carries no manifest")


@by_both
def test_a_type_that_numpy_does_not_know_is_refused(
    reader: str, sound: bytes, scratch: Path
) -> None:
    """BF16 and F8 exist in safetensors alone; written here by hand."""
    scratch.write_bytes(sound)
    header: dict[str, Any] = {"__metadata__": {"manifest": json.dumps(read_manifest(scratch))}}
    body = b""
    for name, value in safetensors.numpy.load(sound).items():
        kind, size = ("BF16", 2) if name == "head/bias" else ("F32", 4)
        end = len(body) + size * value.size
        header[name] = {"dtype": kind, "shape": value.shape, "data_offsets": (len(body), end)}
        body += value.tobytes()[: size * value.size]
    text = json.dumps(header).encode()
    scratch.write_bytes(len(text).to_bytes(8, "little") + text + body)
    assert_refused(reader, scratch, r"weight '?head/bias'? is BF16; it must be F32")


def leg(**changes: Any) -> Edit:
    """Changes a leg of the manifest's robot."""
    return lambda w, m: m["robot"]["legs"][1].update(changes)


def weight(name: str, value: Any) -> Edit:
    """Puts another weight in place."""
    return lambda w, m: w.update({name: value})


def part(name: str, **changes: Any) -> Edit:
    """Changes a part of the manifest."""
    return lambda w, m: m[name].update(changes)


def row(k: int, **changes: Any) -> Edit:
    """Changes an input: 3 is a foot's height, 9 a gyro axis."""
    return lambda w, m: m["inputs"][k].update(changes)


ESCAPE = "\x1b[2J\x1b]0;pwn\x07"
CONVERTED = "`mjx-balance export OLD.safetensors --out NEW.safetensors` converts"
LACKS_ROBOT = "its robot cannot be used: Robot is None; it must map its fields to values"
UNFIT: list[tuple[Any, ...]] = [
    (
        weight("head/bias", np.zeros(7, np.float32)),
        r"weight head/bias is float32 of shape \(7,\); it must be float32 of shape \(42,\)",
        r"weight head/bias is missing or not of shape \(42,\)",
    ),
    (weight("hidden_0/kernel", np.zeros((33, 24), np.float32)), *2 * [r"of shape \(34, 24\)"]),
    (lambda w, m: w["hidden_1/kernel"].fill(np.nan), *2 * ["weight hidden_1/kernel .* not finite"]),
    (lambda w, m: w["head/bias"].fill(np.inf), *2 * ["weight head/bias .* not finite"]),
    (lambda w, m: w["head/kernel"][0, 7:8].fill(np.nan), *2 * ["head/kernel .* not finite"]),
    (lambda w, m: w.pop("head/kernel"), *2 * ["weight head/kernel is missing"]),
    (weight("spare", np.zeros(3, np.float32)), *2 * ["'spare' is none of this network's"]),
    (weight("head/bias", np.full(42, 1e300)), *2 * ["head/bias.* is F64; it must be F32"]),
    (weight("head/bias", np.zeros(42, np.int32)), *2 * ["head/bias.* is I32"]),
    (
        lambda w, m: m.update(version=99),
        "version is 99; this release reads 5$",
        "is mjx_balance.policy version 99; this file runs mjx_balance.policy version 5$",
    ),
    (lambda w, m: m.update(version=4), f"reads 5; {CONVERTED}", f"version 5; {CONVERTED}"),
    (lambda w, m: m.update(format=ESCAPE), "format is '.x1b", r"it is \?\[2J\?\]0;pwn\? version 5"),
    (lambda w, m: m.update(version=10**400), "version is 1000+", r"version 1000+\.\.\.0+; this"),
    (lambda w, m: m.update(format="onnx"), "format is 'onnx'", "it is onnx version 5"),
    (lambda w, m: m.clear(), "format is None", "carries no manifest"),
    (lambda w, m: m.pop("robot"), LACKS_ROBOT, "its manifest lacks 'robot'"),
    (part("robot", legs="four"), "its robot cannot be used: legs is 'four'", "wrong type"),
    (lambda w, m: m["robot"]["legs"].pop(), "legs is .* length of at least 4", "index is 3; "),
    (
        lambda w, m: m["robot"]["legs"][1].pop("zeros"),
        "zeros of leg .. is missing",
        "its manifest lacks 'zeros'",
    ),
    (leg(thigh="long"), "thigh of leg .. is 'long'; it must be a finite number", "wrong type"),
    (leg(calf=math.nan), "calf of leg .. is nan; it must be a finite number", "its calf is not"),
    (leg(signs=[1, 1]), "signs of leg .. is .*; it must have more entries", "wrong type"),
    (leg(joints=["a", "b"]), "joints of leg .. is .*; it must have", "other than three joints"),
    (leg(joints=["a", "b", 3]), "each entry must be a text", "a joint is called 3; a name has"),
    (leg(joints=["a", "b", [ESCAPE]]), "each entry must be a text", r"is called \['.x1b\[2J"),
    (leg(zeros=[0, 500, 0]), "zeros of leg .. is .*; .* at most 16", "zeros beyond 16 rad"),
    (leg(knee=[-50, 50]), "knee of leg .. is .*; .* at least -3.14", "knees do not bend to one"),
    (leg(knee=[-1, 1]), "knee of leg .. is .* to one side", "knees do not bend to one side"),
    (leg(knee=[-1, -2]), "knee of leg .. is .* the least and gr", "knees do not bend to one side"),
    (leg(calf=-0.2), "calf of leg .. is -0.2; it must be greater than 0", "lengths that are not"),
    (leg(thigh=0), "thigh of leg .. is 0; it must be greater than 0", "lengths that are not"),
    (leg(signs=[1, 0, 1]), "signs of leg .. is .*; each must be 1 or -1", r"signs not \+-1"),
    (
        lambda w, m: m["robot"].update(legs=500 * m["robot"]["legs"]),
        "its robot has more than 262144 characters",
        "number of legs is 2000; it must be a whole number from 1 to 16",
    ),
    (lambda w, m: m.update(body_height_m=0.6), "its body_height_m is not", "is 0.6; it must be"),
    (lambda w, m: m.update(fail_tilt_deg=math.nan), "its fail_tilt_deg is not", "is nan; it must"),
    (lambda w, m: m.update(action="continuous"), "its action is not", "network is not radial$"),
    (lambda w, m: m.update(action="both"), "its action is not", "'both'; this file runs grid and"),
    (lambda w, m: m.update(action=None), "its action is not", "is None; this file runs grid and c"),
    (part("timing", sample_s=0), "its timing is not", "sample_s is 0; it must be from"),
    (part("timing", sample_s="0.1"), "its timing is not", "wrong type"),
    (part("timing", decision_samples=2.5), "its timing is not", "samples is 2.5; it must be a wh"),
    (part("timing", decision_samples=10_001), "its timing is not", "from 1 to 10000"),
    (part("timing", ramp_samples=51), "its timing is not", "ramp_samples is 51; .* from 1 to 50"),
    (row(3, sensor="sonar"), "its inputs is not", "'sonar'; this file knows height, command, gyro"),
    (row(3, index=4), "its inputs is not", "index is 4; .* from 0 to 3"),
    (row(3, lag=1), "its inputs is not", "lag is 1; .* from 0 to 0"),
    (row(3, window=2), "its inputs is not", "more samples than there are"),
    (row(9, index=3), "its inputs is not", "index is 3; .* from 0 to 2"),
    (row(9, lag=-1), "its inputs is not", "lag is -1; it must be a whole number"),
    (row(9, window=10**9), "its inputs is not", "window is 1000000000; it must be"),
    (
        lambda w, m: [row.update(window=90_000) for row in m["inputs"][4:]],
        "its inputs is not",
        "more samples than there are",
    ),
    (row(9, scale=0.0), "its inputs is not", "its scale is 0.0; it must be from 1e-06 to"),
    (row(9, scale=1e-300), "its inputs is not", "its scale is 1e-300; it must be from 1e-06 to"),
    (row(9, sensor=ESCAPE), "its inputs is not", r"the sensor '.x1b\[2J"),
    (row(9, sensor=100_000 * "x"), "its inputs is not", "the sensor 'xxx.*xxx'; this"),
    (row(9, lag=10**400), "its inputs is not", r"lag is 1000+\.\.\.0+; it must be"),
    (row(3, time_constant=1.0), "its inputs is not", "a mean of the sensor 'height'; this file kn"),
    (row(9, time_constant=0.0), "its inputs is not", "time_constant is 0.0; it must be from 1e-06"),
    (row(9, time_constant="1"), "its inputs is not", "a part of its manifest has the wrong type"),
    (row(9, sensor="angle"), "its inputs is not", "the sensor 'angle'; this file knows height"),
    (row(9, sensor="angle", time_constant=1.0, index=2), "its inputs is", "index is 2; .* 0 to 1"),
    (row(9, offset=math.inf), "its inputs is not", r"its offset is not \(34,\) sane"),
    (lambda w, m: m["inputs"].pop(), "its inputs is not", "hidden_0/kernel is missing or not of"),
    (lambda w, m: m["actions"]["table_m"].pop(), "its actions is not", "action table is not what"),
    (part("actions", table_m=[[0, 0], [0]]), "its actions is not", "wrong type"),
    (part("network", factors=[21, 20]), "its network is not", "head/kernel is missing or not of"),
    (part("network", factors=[1] * 100_000), "its network is not", "number of factors is 100000"),
    (part("network", hidden_sizes=[1] * 100_000), "its network is not", "hidden_sizes is 100000"),
    (part("network", factors=["many", "more"]), "its network is not", "factors is 'many'; it must"),
    (part("network", radial=True), "its network is not", r"profile is missing or not of .* \(4,\)"),
]
"""How to spoil a sound file, what the package says, what the runtime says."""


@by_both
@pytest.mark.parametrize("case", range(len(UNFIT)))
def test_unfit_content_is_refused(reader: str, case: int, sound: bytes, scratch: Path) -> None:
    edit, *messages = UNFIT[case]
    message = messages[list(READERS).index(reader)]
    assert_edit_refused(reader, sound, scratch, edit, message)


@by_both
@pytest.mark.parametrize("name", ["profile", "stretch", "head/kernel"])
def test_unfit_weights_of_a_radial_head_are_refused(
    reader: str, name: str, radial: bytes, scratch: Path
) -> None:
    message = f"weight {name} holds values that are not finite"
    edit: Edit = lambda w, m: w[name].reshape(-1)[-1:].fill(np.nan)  # noqa: E731
    assert_edit_refused(reader, radial, scratch, edit, message)


def task(**changes: Any) -> Edit:
    """Changes the task in the config."""
    return lambda w, m: m["config"]["task"].update(changes)


def dqn(**changes: Any) -> Edit:
    """Changes the learner in the config."""
    return lambda w, m: m["config"]["dqn"].update(changes)


SWEEP = [f"{name}={','.join(200 * ['0.5'])}" for name in ("gamma", "learning_rate", "huber_delta")]
FIELDS = dict.fromkeys(map(str, range(100_000)), 0)
BY_ONE: list[tuple[str, Edit, str]] = [
    ("package", lambda w, m: m.pop("scene_hash"), "scene_hash is None; it must be a text"),
    ("package", lambda w, m: m.pop("versions"), "versions is None; it must map names to values"),
    ("package", lambda w, m: m["config"]["task"].update(action_levels=100_001), "levels is 100001"),
    ("package", lambda w, m: m["config"]["task"].update(ctrl_dt=0.0), r"ctrl_dt is 0\.0"),
    ("package", task(action="both"), "action is 'both'; it must be one of grid, continuous"),
    ("package", task(action="continuous"), "action is 'continuous', but head is 'factored'"),
    ("package", part("config", wings=2), "its config cannot be used: unknown field 'wings'"),
    ("package", part("robot", wings=2), "its robot cannot be used: unknown field 'wings' in"),
    ("package", leg(left=1), "left of leg .. is 1; it must be true or false"),
    ("package", leg(name="RM"), "its inputs is not what its own config gives"),
    ("package", lambda w, m: m["inputs"].reverse(), "its inputs is not what"),
    ("package", part("timing", ramp_samples=50), "its timing is not what"),
    ("runtime", leg(joints=["a", "b", ESCAPE]), r"is called '.x1b\[2J.*; a name has 1 to 100"),
    ("runtime", leg(joints=["a", "b", 101 * "c"]), "is called 'cccc"),
    ("runtime", leg(joints=["a", "b", ""]), "is called ''; a name has 1"),
    ("package", part("robot", foot_friction=ESCAPE), r"foot_friction is '.x1b\[2J"),
    ("package", leg(left=False, front=False), "each corner must have one"),
    ("package", lambda w, m: [x.update(left=True) for x in m["robot"]["legs"]], "each corner must"),
    ("package", lambda w, m: [x.update(x=0.0, y=0.0) for x in m["robot"]["legs"]], "at one place"),
    ("package", task(sim_dt=1e-320), r"ctrl_dt is 0\.2 s; it must be a whole multiple"),
    ("package", task(gyro_lags=[0] * 20_000), "gyro_lags is .*; .* length of at most 1000"),
    ("package", task(command_lags=[0] * 1_001), "command_lags is .* length of at most 1000"),
    ("package", task(gyro_lags=[0] * 900, imu_mean=10_000), "averages 18,180,000 samples"),
    ("package", task(imu_mean=5_000 * "x"), "imu_mean is 'xxx"),
    ("package", task(height_scale=1e300), "height_scale is 1e[+]300; it must be at most 1000000"),
    ("package", part("config", num_envs=10**400), "num_envs is 1000+"),
    ("package", part("config", **FIELDS), "its config has more than 262144 characters"),
    ("package", part("robot", legs=[{}] * 400_000), "its robot has more than 262144 char"),
    ("package", part("training", x=[[]] * 400_000), "its training has more than 262144 char"),
    ("package", part("config", sweep=SWEEP), "its values make more than 100,000 combinations"),
    ("package", dqn(hidden_sizes=[1] * 65), "hidden_sizes is .*; .* length of at most 64"),
]
"""What contradicts a config, and legs that cannot be."""


@pytest.mark.parametrize(("reader", "edit", "message"), BY_ONE)
def test_what_only_one_of_them_can_know_is_refused(
    reader: str, edit: Edit, message: str, sound: bytes, scratch: Path
) -> None:
    assert_edit_refused(reader, sound, scratch, edit, message)


@by_both
@settings(max_examples=150, deadline=None)
@given(position=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255), cut=st.booleans())
def test_a_flipped_byte_is_refused_or_works(
    reader: str, radial: bytes, scratch: Path, position: float, bits: int, cut: bool
) -> None:
    """In the header, or in the first weights."""
    k = int(position * (int.from_bytes(radial[:8], "little") + 2_000))
    rest = b"" if cut else radial[k + 1 :]
    scratch.write_bytes(radial[:k] + bytes([radial[k] ^ bits]) + rest)
    works_or_is_refused(reader, scratch)


@by_both
@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_any_value_in_any_place_of_a_manifest_is_refused_or_works(
    reader: str, sound: bytes, scratch: Path, data: st.DataObject
) -> None:
    scratch.write_bytes(sound)
    rewrite(scratch, lambda w, m: data.draw(spoiled(m)))
    works_or_is_refused(reader, scratch)
