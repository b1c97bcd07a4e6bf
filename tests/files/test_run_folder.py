"""A run's folder: whole at every moment, refused in one sentence where it cannot be used."""

import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest import mock

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from mjx_balance.config import Config, preset, read_run_config, to_dict
from mjx_balance.config.serialization import check_same_config
from mjx_balance.files import run_folder
from mjx_balance.files.run_folder import (
    RunFolder,
    RunFolderError,
    RunFolderExistsError,
    check_same_provenance,
    create_run_folder,
    keep_metrics_until,
    keep_validated_until,
    locked,
    write_atomically,
)

CONFIG = preset("smoke")
TODAY = {"scene_hash": "abc", "solver_iterations": 4, "versions": {"jax": "0.9", "mujoco": "3.1"}}


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return create_run_folder(tmp_path / "run", to_dict(CONFIG), TODAY)


def test_a_file_is_replaced_only_once_the_new_one_is_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "file.json"
    file.write_text("old")
    seen = []

    def fsync(number: int) -> None:
        seen.append((file.read_text(), next(tmp_path.glob(".*.part")).read_text()))

    monkeypatch.setattr(os, "fsync", fsync)
    write_atomically(file, "new")
    assert seen == [("old", "new")]
    assert file.read_text() == "new"
    assert os.listdir(tmp_path) == ["file.json"]

    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as error:
        write_atomically(file, "newer")
    assert error.value.filename == str(file), "not a name that nobody has given"
    assert file.read_text() == "new"
    assert os.listdir(tmp_path) == ["file.json"]
    monkeypatch.undo()
    write_atomically(file, b"\0\xff")
    assert file.read_bytes() == b"\0\xff"


def test_links_are_followed_and_pipes_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither is replaced: what they stand for is somewhere else."""
    (tmp_path / "there").mkdir()
    file, link, pipe = (tmp_path / name for name in ("there/file", "link", "pipe"))
    link.symlink_to(file)
    for content in ("first", "second"):
        write_atomically(link, content)
        assert link.is_symlink()
        assert file.read_text() == content
    assert os.listdir(tmp_path / "there") == ["file"]
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_atomically(pipe, "through")
    assert os.read(reader, 100) == b"through"
    os.close(reader)
    assert pipe.is_fifo()
    with pytest.raises(OSError, match="directory") as error:
        write_atomically(tmp_path / "there", "x")
    assert error.value.filename == str(tmp_path / "there")
    assert sorted(os.listdir(tmp_path)) == ["link", "pipe", "there"]
    monkeypatch.setattr(Path, "write_bytes", mock.Mock(side_effect=OSError(32, "Broken pipe")))
    with pytest.raises(OSError, match="Broken pipe"):
        write_atomically(pipe, "x")


def test_a_new_folder_has_config_and_provenance_and_nothing_beside_it(folder: RunFolder) -> None:
    assert json.loads(folder.config.read_text()) == to_dict(CONFIG)
    assert json.loads(folder.provenance.read_text()) == TODAY
    assert os.listdir(folder.path.parent) == ["run"]
    assert read_run_config(folder.path) == CONFIG


def test_a_folder_exists_only_once_it_can_be_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if killed between any two writes: the name is not taken yet."""

    class Killed(BaseException):
        pass

    written = []

    def write(path: Path, values: Any) -> None:
        assert not (tmp_path / "run").exists()
        written.append(path.name)
        if path.name == "provenance.json":
            raise Killed

    monkeypatch.setattr(run_folder, "write_json", write)
    with pytest.raises(Killed):
        create_run_folder(tmp_path / "run", to_dict(CONFIG), TODAY)
    assert written == ["config.json", "provenance.json"]
    assert not (tmp_path / "run").exists()
    monkeypatch.undo()
    create_run_folder(tmp_path / "run", to_dict(CONFIG), TODAY)


def test_the_names_are_those_of_the_contract(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    names = {
        "config": "config.json",
        "metrics": "metrics.jsonl",
        "policy": "policy.safetensors",
        "evaluation": "evaluation.json",
        "report": "report.json",
        "seeds_summary": "seeds.json",
        "provenance": "provenance.json",
        **{name: name for name in ("tensorboard", "checkpoints", "figures", "validated", "seeds")},
    }
    assert {name: getattr(folder, name) for name in names} == {
        name: tmp_path / file for name, file in names.items()
    }
    assert folder.seed_policy(3) == tmp_path / "seeds" / "seed-3.safetensors"


def test_of_two_that_create_one_folder_at_once_the_second_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It looks for the folder before the first one has created it."""
    create_run_folder(tmp_path / "run", to_dict(CONFIG), TODAY)
    monkeypatch.setattr(Path, "exists", lambda path: False)
    with pytest.raises(RunFolderExistsError, match=r"run folder .*run exists; choose another"):
        create_run_folder(tmp_path / "run", {}, {})
    monkeypatch.undo()
    assert read_run_config(tmp_path / "run") == CONFIG
    assert os.listdir(tmp_path) == ["run"]


def test_an_existing_folder_and_an_unwritable_one_are_refused(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    with pytest.raises(RunFolderError, match=r"run folder .*mine exists; choose another"):
        create_run_folder(tmp_path / "mine", to_dict(CONFIG), TODAY)
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError, match="file/run cannot be written: Not a directory"):
        create_run_folder(tmp_path / "file" / "run", to_dict(CONFIG), TODAY)
    assert sorted(os.listdir(tmp_path)) == ["file", "mine"]


def test_the_folder_that_one_is_in_exists(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such paths end in no name: `.` and `/`, and the empty one of a shell variable not set."""
    monkeypatch.chdir(tmp_path)
    for path in (Path(), Path("/"), Path("..")):
        with pytest.raises(RunFolderExistsError, match=r"run folder \S+ exists; choose another"):
            create_run_folder(path, to_dict(CONFIG), TODAY)
    assert not list(tmp_path.iterdir())


def test_the_command_that_continues_a_run_is_whole_however_long_its_path(tmp_path: Path) -> None:
    deep = tmp_path.joinpath(*["d" * 150] * 5, "my run")
    deep.mkdir(parents=True)
    with pytest.raises(RunFolderExistsError) as error:
        create_run_folder(deep, to_dict(CONFIG), TODAY)
    assert str(error.value).endswith(f"continue it with --resume '{deep}'")


def test_a_parent_that_is_a_link_to_nothing_is_no_run(tmp_path: Path) -> None:
    """Another name in it would be no better, so that `train` must not try the next one."""
    (tmp_path / "runs").symlink_to(tmp_path / "gone")
    (tmp_path / "circle").symlink_to("circle")
    for place, reason in (
        ("runs/a", "runs is a link to what does not exist"),
        ("runs/b/a", "runs is a link to what does not exist"),
        ("circle/a", "Too many levels of symbolic links"),
    ):
        with pytest.raises(RunFolderError, match=f"{place} cannot be.*{reason}") as error:
            create_run_folder(tmp_path / place, to_dict(CONFIG), TODAY)
        assert type(error.value) is RunFolderError
    assert sorted(os.listdir(tmp_path)) == ["circle", "runs"]


def test_one_process_at_a_time_works_on_a_run(folder: RunFolder) -> None:
    """The lock of a killed process and of one that is done is free."""
    hold = (
        "import sys, time, pathlib\n"
        "from mjx_balance.files.run_folder import RunFolder, locked\n"
        "with locked(RunFolder(pathlib.Path(sys.argv[1]))):\n"
        "    print('held', flush=True)\n"
        "    time.sleep(60)\n"
    )
    command = [sys.executable, "-c", hold, str(folder.path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        taken = pytest.raises(RunFolderError, match="another process works on the run in")
        with taken, locked(folder):
            pass
        process.send_signal(signal.SIGKILL)
        process.wait()
        for _ in range(2):
            with locked(folder):
                pass


def test_a_finished_run_and_no_run_are_told_apart(folder: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"is no run folder: it has no config\.json"):
        read_run_config(tmp_path)
    folder.evaluation.write_text("{}")
    folder.drawing.touch()
    assert read_run_config(folder.path) == CONFIG, "the figures are not drawn"
    folder.drawing.unlink()
    with pytest.raises(RunFolderError, match="is finished; start a new one"):
        read_run_config(folder.path)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("scene_hash", "xyz", "was started with scene_hash abc, but it is xyz"),
        ("solver_iterations", 8, "with solver_iterations 4, but it is 8 today"),
        ("engine", "mjx", "with engine None, but it is mjx today"),
    ],
)
def test_another_scene_or_solver_is_refused(
    folder: RunFolder, name: str, value: Any, message: str
) -> None:
    assert check_same_provenance(folder.path, TODAY) is None
    with pytest.raises(RunFolderError, match=message):
        check_same_provenance(folder.path, {**TODAY, name: value})
    folder.provenance.unlink()
    with pytest.raises(RunFolderError, match=r"provenance.json cannot be used: No such file"):
        check_same_provenance(folder.path, TODAY)


def test_other_versions_give_a_warning(folder: RunFolder) -> None:
    versions = {"jax": "1", "mujoco": "3.1"}
    warning = check_same_provenance(folder.path, {**TODAY, "versions": versions})
    assert warning is not None
    assert "was started with jax 0.9 (now 1); it goes on" in warning
    assert "mujoco" not in warning


def test_a_robot_file_is_where_the_run_began_or_else_where_the_config_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "work").mkdir()
    here, there = tmp_path / "rex.toml", tmp_path / "work" / "rex.toml"
    there.touch()
    config = dataclasses.replace(CONFIG, robot="rex.toml")
    today = TODAY | {"robot_file": str(there)}
    path = create_run_folder(tmp_path / "run", to_dict(config), today).path
    monkeypatch.chdir(tmp_path)
    assert read_run_config(path).robot == str(there)
    monkeypatch.chdir(there.parent)
    assert read_run_config(path).robot == "rex.toml", "as the config of the policy names it"
    monkeypatch.chdir(tmp_path)
    here.touch()  # of the same name, but another robot
    assert read_run_config(path).robot == str(there)
    there.unlink()
    assert read_run_config(path).robot == "rex.toml", "the run has moved with its robot"
    here.unlink()
    for place in (0, 3, None, "x" * 100_000, "a\0b", ["rex.toml"], -1):
        RunFolder(path).provenance.write_text(json.dumps(today | {"robot_file": place}))
        assert read_run_config(path).robot == "rex.toml"
    for unusable in (today, TODAY, []):
        RunFolder(path).provenance.write_text(json.dumps(unusable))
        assert read_run_config(path).robot == "rex.toml", "which is an error with a name"
    RunFolder(path).provenance.write_text("{")
    assert read_run_config(path) == config


def test_a_run_goes_on_with_the_same_config_but_for_the_place_of_its_robot() -> None:
    run = Path("run")
    here, there = (dataclasses.replace(CONFIG, robot=x) for x in ("rex.toml", "/there/rex.toml"))
    check_same_config(here, there, run)
    for other in (dataclasses.replace(there, seed=5), dataclasses.replace(there, robot="go1")):
        with pytest.raises(RunFolderError, match=r"run was started with (seed = 0|robot = rex)"):
            check_same_config(here, other, run)


def test_metrics_are_kept_up_to_the_checkpoint(tmp_path: Path) -> None:
    log = tmp_path / "metrics.jsonl"
    keep_metrics_until(log, 5)
    assert not log.exists()
    lines = [f'{{"env_steps": {n}}}' for n in (1024, 2048, 3072)]
    broken = ["[" * 100_000, "3", '{"env_steps": "x"}', '{"env_st', "\udcff"]
    text = "\n".join([*broken[:2], *lines, *broken[2:]])
    log.write_bytes(text.encode(errors="surrogateescape"))
    keep_metrics_until(log, 2048)
    assert log.read_text() == '{"env_steps": 1024}\n{"env_steps": 2048}\n'


def test_validated_policies_of_a_lost_history_are_dropped(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    keep_validated_until(folder.validated, 5)  # none yet
    assert folder.validated_policy(3, 900) == tmp_path / "validated" / "900" / "seed-3.safetensors"
    for env_steps in (900, 2_048, 2_049, 10_000):
        file = folder.validated_policy(0, env_steps)
        file.parent.mkdir(parents=True)
        file.write_text("a policy")
    for name in ("notes", "3000", "4000"):
        (folder.validated / name).mkdir()
    (folder.validated / "4000" / "tax").write_text("not ours")
    (folder.validated / "10000" / ".mjx_balance-1.part").write_text("torn")
    keep_validated_until(folder.validated, 2_048)
    names = {path.name for path in folder.validated.iterdir()}
    assert names == {"900", "2048", "notes", "4000"}
    assert (folder.validated / "4000" / "tax").is_file()
    assert folder.validated_policy(0, 2_048).is_file()


OUTSIDE = [
    *("config", "provenance", "lock", "metrics", "policy", "report", "page", "sweep"),
    *("tensorboard", "checkpoints", "validated", "seeds", "figures", "profile"),
]


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_link_out_of_the_folder_is_refused_and_nothing_is_changed(
    folder: RunFolder, tmp_path: Path, name: str
) -> None:
    """Whether it leads to a file, to a folder or to nothing yet."""
    target = tmp_path / "mine"
    place = getattr(folder, name)
    for make in (lambda: target.write_text("diary"), target.mkdir, lambda: None):
        make()
        place.unlink(missing_ok=True)
        place.symlink_to(Path("..") / "mine")
        with pytest.raises(RunFolderError, match=f"{place.name} is a link that leads out of the"):
            read_run_config(folder.path)
        if target.is_file():
            assert target.read_text() == "diary"
            target.unlink()
        elif target.is_dir():
            target.rmdir()
    assert not target.exists()


@pytest.mark.parametrize(
    ("place", "target"),
    [
        ("checkpoints/3000/state/d/0", "/etc/hostname"),
        ("validated/9", "../../mine"),
        ("seeds/seed-0.safetensors", "../../mine/policy"),
        ("tensorboard/final", "../.."),
        ("tensorboard/final", "../../run-2"),  # its name begins as the folder's
    ],
)
def test_a_link_out_is_found_at_any_depth(folder: RunFolder, place: str, target: str) -> None:
    link = folder.path / place
    link.parent.mkdir(parents=True)
    link.symlink_to(target)
    with pytest.raises(RunFolderError, match=f"{place} is a link that leads out"):
        read_run_config(folder.path)


def test_links_within_the_folder_and_to_it_are_followed(folder: RunFolder, tmp_path: Path) -> None:
    """Also where they lead in circles; what is not ours is not looked at."""
    (folder.path / "elsewhere").mkdir()
    (folder.path / "elsewhere" / "again").symlink_to("../elsewhere")
    folder.validated.symlink_to("elsewhere")
    (folder.path / "notes").symlink_to("/etc")
    (tmp_path / "latest").symlink_to("run")
    assert read_run_config(tmp_path / "latest") == CONFIG
    (folder.path / "elsewhere" / "out").symlink_to("/etc")
    with pytest.raises(RunFolderError, match="validated/out is a link that leads out"):
        read_run_config(folder.path)


@pytest.mark.parametrize("call", ["lstat", "scandir"])
def test_what_a_run_renames_while_it_is_looked_at_is_no_error(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    """A checkpoint has its name once it is whole: `report` on a run that goes on may see it go."""
    part, whole = folder.checkpoints / ".mjx_balance-1.part", folder.checkpoints / "1024"
    part.mkdir(parents=True)
    (part / "state").touch()
    original = getattr(os, call)

    def look(path: str) -> Any:
        if str(path) == str(part) and part.exists():
            part.rename(whole)
        return original(path)

    monkeypatch.setattr(os, call, look)
    assert read_run_config(folder.path) == CONFIG
    assert whole.exists()
    monkeypatch.undo()
    (whole / "link").symlink_to("nothing")
    with pytest.raises(RunFolderError, match=r"1024/link cannot be read: No such file"):
        read_run_config(folder.path)


def test_pipes_and_sockets_are_refused_at_once(folder: RunFolder) -> None:
    for name in ("provenance", "metrics", "lock", "evaluation", "policy", "tensorboard"):
        place = getattr(folder, name)
        content = place.read_bytes() if place.exists() else None
        place.unlink(missing_ok=True)
        os.mkfifo(place)
        with pytest.raises(RunFolderError, match=f"{place.name} is neither a file nor a folder"):
            read_run_config(folder.path)
        place.unlink()
        if content is not None:
            place.write_bytes(content)
    folder.metrics.symlink_to("pipe")
    os.mkfifo(folder.path / "pipe")
    with pytest.raises(RunFolderError, match=r"metrics\.jsonl is neither a file nor a folder"):
        read_run_config(folder.path)
    folder.metrics.unlink()
    folder.figures.symlink_to("figures")
    with pytest.raises(RunFolderError, match="figures cannot be read: Too many levels of"):
        read_run_config(folder.path)


def test_a_place_that_cannot_be_looked_at_is_a_sentence(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder.path)  # and back to where the other tests are, at the end
    deep = folder.checkpoints
    for _ in range(40):
        deep.mkdir()
        os.chdir(deep)
        deep = Path("d" * 200)
    os.chdir("/")
    with pytest.raises(RunFolderError, match="cannot be read: File name too long") as error:
        read_run_config(folder.path)
    assert len(str(error.value)) <= 300


def test_two_that_write_one_file_do_not_meet(tmp_path: Path) -> None:
    """Every write succeeds, and a reader sees one of both contents at any time."""
    file = tmp_path / "file"
    file.write_text("a" * 10_000)

    def write(letter: str) -> None:
        for _ in range(40):
            write_atomically(file, letter * 10_000)

    with ThreadPoolExecutor(2) as pool:
        writers = [pool.submit(write, letter) for letter in "ab"]
        while not all(writer.done() for writer in writers):
            assert file.read_text() in ("a" * 10_000, "b" * 10_000)
        for writer in writers:
            writer.result()
    assert os.listdir(tmp_path) == ["file"]


def test_no_link_that_waits_is_written_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even if it has the name that the new file would have."""
    monkeypatch.setattr(run_folder.secrets, "token_hex", lambda size: "1")
    (tmp_path / "diary").write_text("mine")
    (tmp_path / ".mjx_balance-1.part").symlink_to("diary")
    with pytest.raises(FileExistsError):
        write_atomically(tmp_path / "file", "theirs")
    assert (tmp_path / "diary").read_text() == "mine"


def test_long_metrics_take_little_memory(tmp_path: Path) -> None:
    """64 MiB, most of it a line without end."""
    log = tmp_path / "metrics.jsonl"
    with log.open("w") as file:
        for k in range(6_000):
            file.write(json.dumps({"env_steps": k, "x": "y" * 500}) + "\n")
        file.truncate(2**26)
    tracemalloc.start()
    keep_metrics_until(log, 4_999)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**24
    lines = log.read_text().splitlines()
    assert (len(lines), json.loads(lines[-1])["env_steps"]) == (5_000, 4_999)


WHOLE = json.dumps(to_dict(CONFIG)).encode()


@st.composite
def damaged_files(draw: st.DrawFn) -> bytes:
    """A config file that is cut off, flipped somewhere, or something else."""
    kind = draw(st.sampled_from(("cut", "flip", "bytes", "deep", "huge")))
    if kind == "cut":
        return WHOLE[: draw(st.integers(0, len(WHOLE)))]
    if kind == "flip":
        at, mask = draw(st.integers(0, len(WHOLE) - 1)), draw(st.integers(1, 255))
        return WHOLE[:at] + bytes([WHOLE[at] ^ mask]) + WHOLE[at + 1 :]
    if kind == "deep":
        return draw(st.sampled_from((b"[", b'{"task":'))) * draw(st.integers(1, 100_000))
    if kind == "huge":
        return b'{"seed": ' + b"9" * draw(st.integers(1, 10_000)) + b"}"
    return draw(st.binary(max_size=200))


@settings(deadline=None, max_examples=150)
@given(damaged_files())
def test_a_damaged_file_gives_a_sentence(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    folder = RunFolder(tmp_path_factory.getbasetemp())
    folder.config.write_bytes(content)
    folder.provenance.write_bytes(content)
    with pytest.raises(RunFolderError, match=r"provenance.json cannot be used: "):
        check_same_provenance(folder.path, TODAY)
    message = "fine"
    try:
        assert isinstance(read_run_config(folder.path), Config)
    except RunFolderError as error:
        message = str(error)
    assert message.isprintable()
    assert len(message) < 500 + len(str(folder.path))


def test_a_config_of_many_megabytes_is_not_read(folder: RunFolder) -> None:
    with folder.config.open("r+b") as file:
        file.truncate(2**31)
    with pytest.raises(RunFolderError, match=r"2048\.0 MiB long; at most 1 MiB are read"):
        read_run_config(folder.path)
