"""Checkpoints: what was saved comes back, and what is damaged is found out."""

import dataclasses
import os
import resource
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from mjx_balance.config import preset
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.training.checkpoints import (
    CheckpointError,
    SaveError,
    restore,
    save,
    saved_steps,
)
from mjx_balance.training.sizing import make_learner, size_to_device


class State(NamedTuple):
    weights: dict[str, jax.Array]
    number: jax.Array


def state_of(number: int) -> State:
    return State({"kernel": jnp.full((3, 4), number, jnp.float32)}, jnp.int32(number))


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoints after 5 and 10 decisions; copy before touching."""
    folder = tmp_path_factory.mktemp("two")
    save(folder, 5, state_of(5))
    save(folder, 10, state_of(10))
    return folder


@pytest.fixture
def folder(two: Path, tmp_path: Path) -> Path:
    return shutil.copytree(two, tmp_path / "checkpoints")


def restored(folder: Path, log_fn: Callable[[str], None] = print) -> int:
    """What is in the newest whole checkpoint."""
    state = restore(folder, state_of(0), log_fn)
    assert state is not None
    np.testing.assert_array_equal(state.weights["kernel"], np.full((3, 4), state.number))
    return int(state.number)


def test_the_newest_comes_back_and_the_oldest_goes(folder: Path) -> None:
    save(folder, 10, state_of(11))  # is not written again
    assert restored(folder) == 10
    save(folder, 100, state_of(100))  # 100 comes after 10, though not in the alphabet's order
    assert saved_steps(folder) == [10, 100]
    assert restored(folder) == 100
    assert sorted(path.name for path in folder.iterdir()) == ["10", "100"]


def test_nothing_was_ever_saved(tmp_path: Path) -> None:
    assert restore(tmp_path / "checkpoints", state_of(0), pytest.fail) is None
    (tmp_path / "7.part").mkdir()
    (tmp_path / "notes").mkdir()
    assert restore(tmp_path, state_of(0), pytest.fail) is None


def test_a_killed_save_leaves_the_one_before(folder: Path) -> None:
    shutil.copytree(folder / "10", folder / "20.part")
    (folder / "20.part" / "sum").unlink()
    assert restored(folder) == 10
    save(folder, 20, state_of(20))
    assert restored(folder) == 20
    assert not (folder / "20.part").exists()


def test_a_damaged_checkpoint_gives_way_to_the_one_before(folder: Path) -> None:
    (folder / "10" / "sum").write_text("0")
    lines: list[str] = []
    assert restored(folder, lines.append) == 5
    assert lines == [f"the checkpoint {folder / '10'} is damaged; trying the one before"]
    assert saved_steps(folder) == [5]  # the run will come by 10 again
    save(folder, 10, state_of(12))
    assert restored(folder) == 12


def test_what_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").write_text("no folder")
    with pytest.raises(CheckpointError, match=r"checkpoints/5 cannot be written: .*Not a dir"):
        save(tmp_path / "checkpoints", 5, state_of(5))


def test_a_full_disk_is_a_sentence_and_leaves_the_one_before(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """No file may have more than 2,000 bytes, which the system refuses as it does a full disk."""
    printed: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", printed.append)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_000, before[1]))
    numbers = np.random.default_rng(0).random(100_000, np.float32)  # cannot be compressed
    state = State({f"kernel {k}": jnp.asarray(numbers) for k in range(8)}, jnp.int32(20))
    try:
        with pytest.raises(SaveError) as error:
            save(folder, 20, state)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert str(error.value) == f"the checkpoint {folder / '20'} cannot be written: File too large"
    assert sorted(os.listdir(folder)) == ["10", "5"]
    assert restored(folder) == 10
    assert not caplog.records
    assert not printed


def test_what_is_not_ours_is_neither_read_nor_deleted(folder: Path, tmp_path: Path) -> None:
    """Folders with numbers for names, and one in the place of the next checkpoint."""
    for name in ("3", "4000", "20.part"):
        (folder / name).mkdir()
        (folder / name / "tax").write_text("mine")
    shutil.copytree(folder / "10", tmp_path / "elsewhere")
    (folder / "7000").symlink_to(tmp_path / "elsewhere")
    assert saved_steps(folder) == [5, 10]
    assert restored(folder) == 10
    with pytest.raises(SaveError, match="checkpoints/20 cannot be written: File exists"):
        save(folder, 20, state_of(20))
    save(folder, 30, state_of(30))
    with pytest.raises(SaveError, match="checkpoints/4000 cannot be written: Directory not empty"):
        save(folder, 4_000, state_of(4_000))
    assert saved_steps(folder) == [10, 30]
    for name in ("3", "4000", "20.part"):
        assert (folder / name / "tax").read_text() == "mine"
    assert (tmp_path / "elsewhere" / "sum").is_file()


def test_none_is_whole(folder: Path) -> None:
    for name in ("5", "10"):
        shutil.rmtree(folder / name / "state")
    lines: list[str] = []
    with pytest.raises(
        CheckpointError, match="is whole and of this version; start a new run with --run-dir"
    ):
        restore(folder, state_of(0), lines.append)
    assert len(lines) == 2
    assert saved_steps(folder) == [5, 10]  # nothing is thrown away then


@pytest.mark.parametrize("other", [State({}, jnp.int32(0)), {"a": jnp.zeros(2)}])
def test_another_structure_is_refused(folder: Path, other: object) -> None:
    lines: list[str] = []
    with pytest.raises(CheckpointError, match="is whole and of this version"):
        restore(folder, other, lines.append)
    assert all("holds the state of another version of mjx_balance" in line for line in lines)
    assert len(lines) == 2


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_any_damage_is_found_out(
    data: st.DataObject, two: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A byte changed, a file cut, removed, added or renamed, anywhere."""
    folder = tmp_path_factory.mktemp("damaged")
    shutil.copytree(two, folder, dirs_exist_ok=True)
    files = sorted(path for path in (folder / "10").rglob("*") if path.is_file())
    file = data.draw(st.sampled_from(files))
    content = file.read_bytes()
    kinds = ("flip", "cut", "remove", "add", "rename", "rename in order", "garbage")
    kind = data.draw(st.sampled_from(kinds))
    if kind == "flip" and content:
        at, mask = data.draw(st.integers(0, len(content) - 1)), data.draw(st.integers(1, 255))
        file.write_bytes(content[:at] + bytes([content[at] ^ mask]) + content[at + 1 :])
    elif kind == "cut" and content:
        file.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    elif kind == "garbage" or (kind == "add" and file.name == "sum"):
        file.write_bytes(content + data.draw(st.binary(min_size=1, max_size=20)))
    elif kind == "add":
        file.with_name("more").write_bytes(b"")
    elif kind == "rename":
        file.rename(file.with_name("other"))
    elif kind == "rename in order":  # sorted as before
        file.rename(file.with_name(f"{file.name}~"))
    else:
        file.unlink()
    assert restored(folder) == 5


def test_a_state_comes_back_to_its_devices(tmp_path: Path) -> None:
    """One that is spread over two devices, counters and keys and all kinds of numbers in it."""
    mesh = Mesh(np.asarray(jax.devices()), ("devices",))
    assert mesh.size == 2
    spread = NamedSharding(mesh, PartitionSpec("devices"))
    same = NamedSharding(mesh, PartitionSpec())
    state = {
        "rows": jax.device_put(np.arange(12.0, dtype=np.float32).reshape(6, 2), spread),
        "key": jax.device_put(jax.random.PRNGKey(3), same),
        "flags": jax.device_put(np.asarray([True, False]), spread),
        "none": (),
        "special": jax.device_put(np.asarray([np.nan, np.inf, -0.0], np.float32), same),
    }
    save(tmp_path, 1, state)
    saved = restore(tmp_path, jax.tree.map(jnp.zeros_like, state), pytest.fail)
    assert saved is not None
    assert jax.tree.structure(saved) == jax.tree.structure(state)
    for name in ("rows", "key", "flags", "special"):
        assert saved[name].dtype == state[name].dtype
        assert saved[name].sharding == state[name].sharding
        assert np.asarray(saved[name]).tobytes() == np.asarray(state[name]).tobytes()


@pytest.mark.slow
def test_a_checkpoint_takes_seconds(tmp_path: Path) -> None:
    """The whole state of the preset `default`, its replay included, saved and read back."""
    config = size_to_device(dataclasses.replace(preset("default"), engine="mujoco"))
    state = jax.block_until_ready(make_learner(config, BalanceEnv(config)).init(0))
    began = time.monotonic()
    save(tmp_path, 1, state)
    saved = time.monotonic()
    jax.block_until_ready(restore(tmp_path, state, pytest.fail))
    assert saved - began < 10
    assert time.monotonic() - saved < 10
