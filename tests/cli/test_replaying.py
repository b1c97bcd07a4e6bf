"""`mjx-balance replay`: a controller's log through a policy; a log of a stranger is refused."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjx_balance import runtime
from mjx_balance.cli import main
from mjx_balance.cli.replay import SHAPES, read_log, run_log
from mjx_balance.errors import InputError
from mjx_balance.runtime import Controller, Fault, State

BEST = Path(__file__).parents[2] / "policies/best.safetensors"
SAMPLES = 230


class Recorded:
    """A controller that stood up and then balanced, and what it was given and gave."""

    def __init__(self, folder: Path, samples: int = SAMPLES):
        self.now, self.given, self.targets, self.actions = 0.0, [], [], []
        self.controller = Controller(BEST, lambda: self.now, gains=True)
        self.path, self.rng = folder / "log.npz", np.random.default_rng(1)
        self.go_on(samples)

    def go_on(self, samples: int) -> None:
        """Stands up, and balances until there are so many samples."""
        controller, joints = self.controller, self.controller.targets
        controller.stand()
        while len(self.given) < samples:
            imu = self.rng.normal((0.02, 0, 0, 0.3, 0, 9.8), (*[0.002] * 3, *[0.02] * 3))
            self.now += 0.004
            joints = controller.step(joints, imu[:3], imu[3:])
            if controller.state is State.BALANCING:
                self.given.append(imu)
                self.targets.append(joints)
                self.actions.append(controller.action)

    def save(self) -> Path:
        self.controller.save_log(self.path)
        return self.path


@pytest.fixture
def recorded(tmp_path: Path) -> Recorded:
    """230 samples, of which the first, the 51st and so on decide."""
    return Recorded(tmp_path)


def test_a_log_holds_what_the_controller_was_given_and_gave(recorded: Recorded) -> None:
    """Read by NumPy alone, without pickle; its first balancing sample is the mean of the last."""
    recorded.controller.hold("the button")
    with np.load(recorded.save(), allow_pickle=False) as log:
        balancing = log["state"] == list(State).index(State.BALANCING)
        assert balancing.sum() == SAMPLES
        np.testing.assert_array_equal(log["targets"][balancing], recorded.targets)
        imu = np.concatenate((log["gyro"], log["accelerometer"]), axis=1)[balancing]
        np.testing.assert_array_equal(imu[1:], recorded.given[1:])
        np.testing.assert_array_equal(log["action"][balancing], recorded.actions)
        assert np.flatnonzero(log["decision"][balancing]).tolist() == [0, 50, 100, 150, 200]
        assert np.flatnonzero(log["start"][balancing]).tolist() == [0]
        np.testing.assert_allclose(np.diff(log["time"]), 0.004, atol=1e-12)
        assert log["policy"].tobytes() == BEST.read_bytes()
        assert str(log["reason"]) == "the button"
    assert [file.name for file in recorded.path.parent.iterdir()] == ["log.npz"]


def test_a_log_ends_with_the_sample_of_the_fault(recorded: Recorded) -> None:
    """However long it goes on."""
    controller = recorded.controller
    for _ in range(9):
        controller.step(controller.targets, np.asarray([0, np.nan, 0]), np.zeros(3))
    log = read_log(recorded.save())
    assert np.isnan(log["gyro"][-1, 1])
    assert np.flatnonzero(log["fault"] == Fault.READING).tolist() == [len(log["time"]) - 1]
    assert str(log["reason"]).startswith("gyro y reads nan")


def test_a_log_ends_with_the_fall_of_a_robot_that_holds(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One sample more: its time, sensors, state and fault fit the reason."""
    controller = recorded.controller
    joints, accel = controller.targets, np.asarray([0, 9.81, 0])
    controller.step(joints, np.asarray([0, np.nan, 0]), np.asarray([0, 0, 9.81]))
    for _ in range(99):
        recorded.now += 0.004
        controller.step(joints, np.zeros(3), accel)
    log = read_log(recorded.save())
    assert log["fault"][-3:].tolist() == [Fault.NONE, Fault.READING, Fault.LEAN]
    codes = [list(State).index(state) for state in (State.HOLDING, State.DAMPING)]
    assert log["state"][-2:].tolist() == codes
    np.testing.assert_array_equal(log["accelerometer"][-1], accel)
    assert log["time"][-1] - log["time"][-2] == pytest.approx(50 * 0.004), "a decision's samples"
    assert str(log["reason"]).startswith("the accelerometer leans")
    assert main(["replay", str(recorded.path), "--out", str(tmp_path / "r.png")]) == 0
    assert "it ended damping, fault LEAN: the accelerometer leans" in capsys.readouterr().out


def test_the_oldest_samples_make_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a log of 0.4 s, 100 samples are left: the last ones, in order."""
    monkeypatch.setattr(runtime, "LOG_S", 0.4)
    recorded = Recorded(tmp_path)
    log = read_log(recorded.save())
    np.testing.assert_array_equal(log["targets"], recorded.targets[-100:])
    assert log["time"][-1] == recorded.now
    assert len(Controller(BEST)._log._rows) == 100
    monkeypatch.undo()
    assert len(Controller(BEST)._log._rows) == 60 * 250


def test_a_replay_decides_as_the_robot_did(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "r.png"
    assert main(["replay", str(recorded.save()), "--out", str(picture)]) == 0
    said = capsys.readouterr().out
    assert "5 decisions; of 5 replayed, 5 equal the log's" in said
    assert "height changes differ by at most 0.000" in said
    assert picture.read_bytes().startswith(b"\x89PNG")
    log = read_log(recorded.path)
    replayed = run_log(BEST, log)
    balancing = replayed.action >= 0
    np.testing.assert_allclose(replayed.targets[balancing], recorded.targets, rtol=0, atol=1e-12)
    assert balancing.sum() == SAMPLES
    assert not replayed.reasons


def test_a_replay_goes_from_start_to_start(recorded: Recorded) -> None:
    """After a fault and a reset, the robot stands up again: that is none of the policy's."""
    recorded.controller.step(np.zeros((4, 3)), np.zeros(3), np.zeros(3))
    recorded.controller.reset()
    recorded.go_on(2 * SAMPLES)
    replayed = run_log(BEST, read_log(recorded.save()))
    targets = replayed.targets[replayed.action >= 0]
    np.testing.assert_allclose(targets, recorded.targets, rtol=0, atol=1e-12)
    assert not replayed.reasons


def test_another_policy_decides_otherwise(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It says so, and how the log ended."""
    recorded.controller.step(np.zeros((4, 3)), np.zeros(3), np.zeros(3))
    log, out = str(recorded.save()), str(tmp_path / "r.png")
    assert main(["replay", log, "--policy", "real", "--out", out]) == 0
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert "differ by at most 0.000 mm" not in first
    assert second.startswith("it ended holding, fault READING: ")
    assert main(["replay", log, "--policy", "nobody", "--out", out]) == 2
    assert "no policy file at nobody" in capsys.readouterr().err


def test_a_log_that_begins_in_the_middle_begins_at_a_decision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtime, "LOG_S", 0.6)
    log = read_log(Recorded(tmp_path).save())
    replayed = run_log(BEST, log)
    # The last 150 of 230 samples: the first decision is the 101st, 20 samples later.
    assert int((replayed.action >= 0).argmax()) == 20
    assert (replayed.action[20:] >= 0).all()


def save(path: Path, arrays: dict[str, Any]) -> None:
    np.savez(path, **arrays)


def changed(path: Path, **arrays: Any) -> None:
    """Replaces arrays of a log; None removes one."""
    with np.load(path) as log:
        kept = {name: log[name] for name in log.files} | arrays
    save(path, {name: value for name, value in kept.items() if value is not None})


def raw(path: Path, name: str, content: bytes) -> None:
    """Puts bytes in place of an array's file."""
    with zipfile.ZipFile(path) as archive:
        kept = {item: archive.read(item) for item in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for item, old in kept.items():
            archive.writestr(item, content if item == f"{name}.npy" else old)


def garbage(path: Path, kind: int) -> None:
    """Compresses an array another way, and makes what is compressed unreadable."""
    with zipfile.ZipFile(path) as archive:
        kept = {item: archive.read(item) for item in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for item, old in kept.items():
            archive.writestr(item, old, kind if item == "time.npy" else zipfile.ZIP_STORED)
        info = archive.getinfo("time.npy")
    # A local header has 30 bytes and the name; LZMA's properties take 9 more.
    start = info.header_offset + 30 + len("time.npy") + 9
    content = bytearray(path.read_bytes())
    content[start : start + 16] = bytes(16 * [255])
    path.write_bytes(content)


def header(text: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


HUGE = header("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }\n")
PICKLE = io.BytesIO()
np.save(PICKLE, np.asarray([{}]), allow_pickle=True)
HOSTILE: dict[str, Any] = {
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("log"),
    "half": lambda path: path.write_bytes(path.read_bytes()[:999]),
    "flipped": lambda path: path.write_bytes(path.read_bytes().replace(b"\x00", b"\x01")),
    "no time": lambda path: changed(path, time=None),
    "no policy": lambda path: changed(path, policy=None),
    "version": lambda path: changed(path, version=np.asarray(2)),
    "shape": lambda path: changed(path, gyro=np.zeros((3, 3))),
    "kind": lambda path: changed(path, gyro=np.full((3, 3), "x")),
    "complex": lambda path: changed(path, time=np.zeros(3, complex)),
    "state": lambda path: changed(path, state=np.full(SAMPLES, 99, np.uint8)),
    "object": lambda path: raw(path, "time", PICKLE.getvalue()),
    "huge": lambda path: raw(path, "time", HUGE),
    "code": lambda path: raw(path, "time", header("__import__('os').abort()\n")),
    "open bracket": lambda path: raw(path, "time", header("{'descr': '<f8', 'shape': (")),
    "no type": lambda path: raw(
        path, "time", header("{'descr': (), 'fortran_order': False, 'shape': (1,), }\n")
    ),
    "list as a key": lambda path: raw(path, "time", header("{[]: 1}\n")),
    "deep": lambda path: raw(path, "time", header(400 * "(")),
    "lzma": lambda path: garbage(path, zipfile.ZIP_LZMA),
    "bz2": lambda path: garbage(path, zipfile.ZIP_BZIP2),
    "no array": lambda path: raw(path, "time", b"\x93NUMPY"),
    "another policy": lambda path: changed(path, policy=np.zeros(9, np.uint8)),
    "no samples": lambda path: changed(
        path,
        **{
            name: np.zeros((0, *(4 if n < 0 else n for n in shape)), kind)
            for name, (kind, shape) in SHAPES.items()
        },
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_damaged_log_is_refused_in_a_sentence(
    name: str, recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    HOSTILE[name](recorded.save())
    out = tmp_path / "r.png"
    assert main(["replay", str(recorded.path), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    assert len(error) < 450
    assert "None" not in error
    assert not out.exists()


def test_what_cannot_be_read_or_written_is_said_first(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(tmp_path / "none.npz")]) == 2
    assert "none.npz cannot be read: No such file" in capsys.readouterr().err
    assert main(["replay", str(recorded.save()), "--out", "r.jpg"]) == 2
    assert "out is r.jpg; its name must end in .png" in capsys.readouterr().err
    with pytest.raises(InputError, match="cannot be read"):
        read_log(tmp_path)
