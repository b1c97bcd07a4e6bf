"""Run folders of strangers: refused in a sentence, or read; nothing outside them changes."""

import contextlib
import dataclasses
import json
import os
import random
import shutil
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fixtures.hostile import change

from mjx_balance.config import preset, read_run_config, to_dict
from mjx_balance.errors import InputError
from mjx_balance.files.run_folder import (
    RunFolder,
    check_same_provenance,
    create_run_folder,
    keep_metrics_until,
    keep_validated_until,
    locked,
)
from mjx_balance.policy.file import shipped_policies
from mjx_balance.report.figures import CURVES
from mjx_balance.report.reading import read_run
from mjx_balance.training.checkpoints import saved_steps

pytestmark = pytest.mark.slow

TODAY = {"scene_hash": "abc", "engine": "mujoco", "versions": {"jax": "0.9"}}
PATIENCE_S = 2  #: a sentence comes within a second; the machine may be busy


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that lacks its evaluation; no checkpoint is read here, so they hold next to nothing."""
    config = to_dict(dataclasses.replace(preset("smoke"), robot="rex.toml"))
    today = TODAY | {"robot_file": "/gone/rex.toml"}
    folder = create_run_folder(tmp_path_factory.mktemp("whole") / "run", config, today)
    tilts = dict.fromkeys(("mean", "rms", "p50", "p95", "p99", "max"), 0.1)
    result = {"scenarios": 4, "falls": 0, "tilt_deg": tilts, "action_mm_settled": 0.1}
    evaluation = {"paper": result, "corner": result}
    folder.seeds_summary.write_text(json.dumps({"seeds": [{"evaluation": evaluation}] * 2}))
    for k in range(20):
        seeds = {name.removeprefix("train/"): [0.1, 0.2] for name, _, _ in CURVES}
        line = {"env_steps": 100 * (k + 1), "seeds": seeds} | {name: 0.1 for name, _, _ in CURVES}
        with folder.metrics.open("a") as file:
            file.write(json.dumps(line) + "\n")
    for steps in (1_000, 2_000, 3_000):
        (folder.checkpoints / f"{steps}" / "state").mkdir(parents=True)
        (folder.checkpoints / f"{steps}" / "sum").write_text("0")
        policy = folder.validated_policy(0, steps)
        policy.parent.mkdir(parents=True)
        policy.write_bytes(b"policy")
    shutil.copy(shipped_policies()["best"], folder.policy)
    for place in (folder.tensorboard, folder.figures, folder.seeds):
        place.mkdir()
        (place / "one").write_text("1")
    return folder.path


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """Files and folders of the user, in which names are those of a run too."""
    for name in ("diary", "99999/tax", "99999/seed-0.safetensors", "3000/sum", "config.json"):
        file = tmp_path / "outside" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("mine")
    return tmp_path / "outside"


def contents(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_text() for path in files}


def entries(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if not path.is_symlink())


def change_json(folder: Path, rng: random.Random) -> None:
    files = (path for path in entries(folder) if path.is_file())
    file = rng.choice([path for path in files if path.suffix in (".json", ".jsonl")])
    lines = file.read_text().splitlines() if file.suffix == ".jsonl" else [file.read_text()]
    k = rng.randrange(len(lines))
    lines[k] = json.dumps(change(json.loads(lines[k]), rng))
    file.write_text("\n".join(lines))


def change_bytes(folder: Path, rng: random.Random) -> None:
    """Cut, flipped, doubled, longer than anybody reads, or nested too deep."""
    file = rng.choice([path for path in entries(folder) if path.is_file()])
    content = file.read_bytes()
    at = rng.randrange(len(content) + 1)
    kind = rng.randrange(6)
    if kind == 0:
        file.write_bytes(content[:at])
    elif kind == 1:
        file.write_bytes(content[:at] + bytes([rng.randrange(256)]) + content[at + 1 :])
    elif kind == 2:
        file.write_bytes(content + content)
    elif kind == 3:
        os.truncate(file, rng.choice((2**20 + 1, 2**27)))  # zeros
    elif kind == 4:
        file.write_bytes(rng.choice((b"[", b'{"a":')) * 100_000)
    else:
        file.write_bytes(rng.randbytes(1_000))


def change_kind(folder: Path, rng: random.Random) -> None:
    """A link, a pipe, a socket, a folder or a file in the place of another, or in none's."""
    names = [path for path in vars(RunFolder(folder)).values() if path != folder]
    place = rng.choice([*entries(folder), *names])
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    place.parent.mkdir(parents=True, exist_ok=True)
    kind = rng.randrange(7)
    if kind < 3:
        inside = os.path.relpath(rng.choice(entries(folder) or [folder]), place.parent)
        out = os.path.relpath(folder.parent / "outside", place.parent)
        targets = (out, f"{out}/diary", f"{out}/99999", f"{out}/new", inside, place.name, "/proc/1")
        place.symlink_to(rng.choice((*targets, "/dev/zero", "/dev/tty", "x" * 255)))
    elif kind == 3:
        os.mkfifo(place)
    elif kind == 4:
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(place))
    elif kind == 5:
        place.mkdir()
    else:
        place.write_text("text")


def plant(folder: Path, rng: random.Random) -> None:
    """Something that is not ours, with a name as ours have or as none has."""
    names = ("99999", "3000", "3000.part", "4_000", "\u0663", "9" * 250, "\x1b[2J", "\udc80", "-1")
    place = folder / rng.choice(("checkpoints", "validated", "seeds", ".")) / rng.choice(names)
    (place / rng.choice(("", "deep/" * 50))).mkdir(parents=True)
    (place / "tax").write_text("mine")


CHANGES: tuple[Callable[[Path, random.Random], None], ...] = (
    *(change_json, change_json, change_bytes, change_kind, change_kind, plant),
)


def resume(path: Path) -> None:
    """What a resumed run does to its folder before it learns."""
    read_run_config(path)
    check_same_provenance(path, TODAY)
    folder = RunFolder(path)
    with locked(folder):
        saved_steps(folder.checkpoints)
        keep_metrics_until(folder.metrics, 1_500)
        keep_validated_until(folder.validated, 1_500)


@pytest.fixture
def in_time() -> Iterator[Callable[[], None]]:
    """Winds an alarm, for whoever waits at a pipe."""

    def ring(number: int, frame: object) -> None:
        pytest.fail("it takes too long")

    before = signal.signal(signal.SIGALRM, ring)
    yield lambda: signal.setitimer(signal.ITIMER_REAL, PATIENCE_S) and None
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


def test_a_folder_of_a_stranger(
    rounds: Iterator[random.Random], whole: Path, outside: Path, in_time: Callable[[], None]
) -> None:
    path = outside.parent / "run"
    for rng in rounds:
        shutil.copytree(whole, path)
        for _ in range(rng.randint(1, 3)):
            with contextlib.suppress(OSError, ValueError, RecursionError, IndexError):
                rng.choice(CHANGES)(path, rng)  # unless an earlier change is in its way
        mine, planted, sentences = contents(outside), sorted(path.rglob("tax")), []
        for use in (read_run, resume):
            in_time()
            try:
                use(path)
            except InputError as error:
                sentences.append(str(error))
            except OSError as error:  # the command line says what cannot be written
                sentences.append(error.strerror)
        signal.setitimer(signal.ITIMER_REAL, 0)
        for sentence in sentences:
            assert sentence.isprintable()
            assert len(sentence) <= 300 + 2 * len(str(path))
        assert contents(outside) == mine
        assert sorted(path.rglob("tax")) == planted
        shutil.rmtree(path)
