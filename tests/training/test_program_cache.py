"""The program cache: traced once, keyed by what is traced, and never in the way."""

import dataclasses
import hashlib
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from mjx_balance.config import Config, preset
from mjx_balance.files.sources import code
from mjx_balance.robots import catalogue
from mjx_balance.robots.catalogue import find_robot, robot_file, use_robot
from mjx_balance.training import program_cache, sizing
from mjx_balance.training.program_cache import NOT_TRACED, compile_program, program_key, traced_code

ROOT = sizing.__name__
CONFIG = preset("smoke")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own."""
    monkeypatch.setenv("MJX_BALANCE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


class State(NamedTuple):
    number: jax.Array
    parts: dict[str, jax.Array]


def start() -> State:
    return State(jnp.int32(1), {"a": jnp.arange(3.0), "b": jnp.zeros(2)})


class Counter:
    """A program that counts how often it is traced."""

    def __init__(self) -> None:
        self.traced = 0
        self.program = jax.jit(self._step)

    def _step(self, state: State) -> tuple[State, dict[str, jax.Array]]:
        self.traced += 1
        parts = {"a": 2 * state.parts["a"], "b": state.parts["b"] - 1}
        return State(state.number + 1, parts), {"sum": state.parts["a"].sum()}


def check_run(program: Callable[[Any], tuple[Any, Any]]) -> None:
    """The program does what it did before it was stored."""
    state, output = program(start())
    assert int(state.number) == 2
    np.testing.assert_array_equal(state.parts["a"], (0, 2, 4))
    np.testing.assert_array_equal(state.parts["b"], (-1, -1))
    assert float(output["sum"]) == 3


def test_a_second_start_traces_nothing_but_programs_without_a_key(cache: Path) -> None:
    """As one that calls what another process would not know."""
    for counter in (Counter(), Counter()):
        check_run(compile_program(counter.program, start(), None, pytest.fail))
        assert counter.traced == 1
    assert not (cache / "traced").exists()
    first, second = Counter(), Counter()
    check_run(compile_program(first.program, start(), "key", pytest.fail))
    assert first.traced == 1
    files = list((cache / "traced").iterdir())
    assert [file.name for file in files] == ["key.stablehlo"]
    check_run(compile_program(second.program, start(), "key", pytest.fail))
    assert second.traced == 0
    compile_program(second.program, start(), "other", pytest.fail)
    assert second.traced == 1


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:-1],
        lambda content: content[:100] + b"!" + content[101:],
        lambda content: b"x" * 40,
    ],
)
def test_a_damaged_program_is_logged_and_replaced(
    cache: Path, damage: Callable[[bytes], bytes]
) -> None:
    compile_program(Counter().program, start(), "key", pytest.fail)
    file = cache / "traced" / "key.stablehlo"
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    lines: list[str] = []
    again = Counter()
    check_run(compile_program(again.program, start(), "key", lines.append))
    assert again.traced == 1
    assert lines == [f"the cached program {file} is replaced: it is damaged"]
    compile_program(again.program, start(), "key", pytest.fail)
    assert again.traced == 1


def test_a_run_works_without_a_cache_that_it_cannot_write(cache: Path) -> None:
    cache.write_text("no folder")
    lines: list[str] = []
    check_run(compile_program(Counter().program, start(), "key", lines.append))
    program_cache.enable_compilation_cache(lines.append)
    assert lines == [f"programs are not cached, {cache / 'traced'} cannot be used: Not a directory"]
    assert cache.read_text() == "no folder"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives away")
@pytest.mark.parametrize("planted", ["traced", "traced/key.stablehlo"])
@pytest.mark.parametrize(
    ("give", "reason"),
    [
        (lambda path: os.chown(path, 12_345, -1), "it is another user's"),
        (lambda path: path.chmod(0o777), "other users may write to it; delete it"),
    ],
    ids=["another's", "all's"],
)
def test_a_program_that_another_user_may_have_planted_never_runs(
    cache: Path, planted: str, give: Callable[[Path], None], reason: str
) -> None:
    folder = cache / "traced"
    folder.mkdir(parents=True, mode=0o755)
    evil = jax.jit(lambda leaves: ([leaves[0] + 100, *leaves[1:]], {"sum": leaves[0]}))
    program = bytes(jax.export.export(evil)(jax.tree.leaves(start())).serialize())
    (folder / "key.stablehlo").write_bytes(hashlib.sha256(program).digest() + program)
    give(cache / planted)
    lines, counter = [], Counter()
    check_run(compile_program(counter.program, start(), "key", lines.append))
    assert counter.traced == 1
    before = jax.config.jax_compilation_cache_dir
    program_cache.enable_compilation_cache(lines.append)
    assert lines == [f"programs are not cached, {cache / planted} cannot be used: {reason}"]
    assert jax.config.jax_compilation_cache_dir == before


def test_a_cache_is_for_its_user_alone(cache: Path) -> None:
    """Whatever the umask; an older one, which others could read, is closed."""
    folder = cache / "traced"
    folder.mkdir(parents=True, mode=0o755)
    before = os.umask(0o002)
    try:
        compile_program(Counter().program, start(), "key", pytest.fail)
        again = Counter()
        check_run(compile_program(again.program, start(), "key", pytest.fail))
    finally:
        os.umask(before)
    assert again.traced == 0
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_cache_of_version_0_3_is_in_nobodys_way(cache: Path, xla_settings: None) -> None:
    """Its group could write to it, where the umask is 002: it is neither used nor complained of."""
    for name in ("programs/key.stablehlo", "xla/jit_f-0-cache"):
        file = cache / name
        file.parent.mkdir(parents=True)
        file.write_bytes(b"old")
        file.chmod(0o664)
        file.parent.chmod(0o775)
    program_cache.enable_compilation_cache(pytest.fail)
    for traced in (1, 0):
        counter = Counter()
        check_run(compile_program(counter.program, start(), "key", pytest.fail))
        assert counter.traced == traced
    assert (cache / "programs" / "key.stablehlo").read_bytes() == b"old"


def test_a_file_that_another_run_renames_now_is_no_error(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = program_cache.private_folder("traced")
    monkeypatch.setattr(Path, "iterdir", lambda folder: iter([folder / ".mjx_balance-1.part"]))
    assert program_cache.private_folder("traced") == folder


@pytest.mark.parametrize("content", [b"", b"no flatbuffer", bytes(1000), b"\xff" * 1000])
def test_what_is_no_program_is_a_miss(cache: Path, content: bytes) -> None:
    """Though its digest is right."""
    folder, lines, counter = program_cache.private_folder("traced"), [], Counter()
    (folder / "key.stablehlo").write_bytes(hashlib.sha256(content).digest() + content)
    check_run(compile_program(counter.program, start(), "key", lines.append))
    assert counter.traced == 1
    [line] = lines
    assert "is replaced: " in line


def test_a_user_without_a_home_has_no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container: no HOME, and no line in the list of users."""
    for name in ("MJX_BALANCE_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", mock.Mock(side_effect=RuntimeError("no home")))
    lines: list[str] = []
    program_cache.enable_compilation_cache(lines.append)
    check_run(compile_program(Counter().program, start(), "key", lines.append))
    assert lines == [
        "programs are not cached, the user's home cannot be used: there is none; "
        "set MJX_BALANCE_CACHE"
    ]
    assert sizing._measured_sizes() == {}


@pytest.fixture
def xla_settings() -> Iterator[None]:
    """For a test that turns XLA's cache on: it is off again after it."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    compilation_cache.reset_cache()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture
def xla_cache(cache: Path, xla_settings: None) -> Path:
    """XLA's own cache, turned on as a run does."""
    program_cache.enable_compilation_cache(pytest.fail)
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 0.5
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return cache / "compiled"


def test_what_xla_finds_damaged_is_logged_and_removed(xla_cache: Path) -> None:
    def start() -> list[str]:
        lines: list[str] = []
        with program_cache.mending_xla_cache(lines.append):
            assert jax.jit(lambda x: 2 * x + 1)(3) == 7
        return lines

    def entries() -> list[Path]:
        return sorted(xla_cache.glob("jit__lambda*-cache"))

    assert start() == []
    [whole] = entries()
    assert start() == []
    whole.write_bytes(whole.read_bytes()[:50])
    other = xla_cache / "jit_other-1-cache"
    other.write_text("not looked at")
    assert start() == [f"compiled again: the entry of jit__lambda in {xla_cache} was damaged"]
    assert entries() == []
    assert other.exists()
    assert start() == []
    assert entries() == [whole]


def test_other_warnings_are_passed_on() -> None:
    passed_on = pytest.warns(UserWarning, match="mind the gap")
    with passed_on, program_cache.mending_xla_cache(pytest.fail):
        warnings.warn("mind the gap", stacklevel=1)


@pytest.fixture
def same_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """Code counts as the same, which is faster than to read it."""
    monkeypatch.setattr(program_cache, "code", lambda *of: {})


def key(config: Config = CONFIG, iterations: int = 16) -> str:
    return program_key(config, iterations, ROOT)


@pytest.mark.usefixtures("same_code")
def test_the_key_depends_on_every_number_that_is_traced() -> None:
    assert key() == key()
    others = {"seed": 5, "preset": "best", "log_every": 7, "checkpoint_seconds": 1.0}
    others |= {"eval_scenarios": 3, "eval_duration": 1.0, "eval_every": 0, "export": "best"}
    others |= {"validation_scenarios": 3, "validation_duration": 1.0}
    assert set(others) == set(NOT_TRACED)
    assert key(dataclasses.replace(CONFIG, **others)) == key()
    keys, count = {key(), key(iterations=17)}, 2
    for name in ("", "task", "randomization", "dqn"):
        section = getattr(CONFIG, name) if name else CONFIG
        for field in dataclasses.fields(section):
            value = getattr(section, field.name)
            if field.name in NOT_TRACED or dataclasses.is_dataclass(value):
                continue
            other = {"robot": "go1", "engine": "mujoco"}.get(field.name, f"{value} and more")
            changed = dataclasses.replace(section, **{field.name: other})
            keys.add(key(dataclasses.replace(CONFIG, **{name: changed}) if name else changed))
            count += 1
    assert len(keys) == count > 60


@pytest.mark.usefixtures("same_code")
def test_another_model_of_a_robot_changes_the_key(tmp_path: Path, bodies: Any) -> None:
    """Its file and its name are the same."""
    spec = bodies.our_spec()
    keys = set()
    for mass in (6.92, 7.0):
        spec.body("trunk").mass = mass
        spec.compile()
        (tmp_path / "model.xml").write_text(spec.to_xml())
        (tmp_path / "rex.toml").write_text(bodies.file_text(Path("model.xml")))
        keys.add(key(dataclasses.replace(CONFIG, robot=str(tmp_path / "rex.toml"))))
    assert len(keys) == 2


@pytest.mark.usefixtures("same_code")
def test_every_number_of_a_robots_file_changes_the_key(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Delay and friction are in no model of the body, but in the program."""
    monkeypatch.setattr(catalogue, "_IN_PYTHON", {})
    numbers = ("foot_friction", "command_delay", "hip_torque", "knee_torque", "servo_stiffness")
    numbers += ("servo_damping", "servo_armature", "servo_friction", "body_height", "action_max")
    file = dataclasses.replace(robot_file("quadruped"), name="twin")
    robot = find_robot("quadruped")
    others = [{name: 0.9 * getattr(robot, name) + 1e-3} for name in numbers]
    keys = set()
    for change in ({}, *others):
        name = use_robot(dataclasses.replace(file, **change))
        keys.add(key(dataclasses.replace(CONFIG, robot=name)))
    assert len(keys) == 1 + len(numbers)


@pytest.mark.usefixtures("same_code")
@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("jax_default_matmul_precision", "float32"),
        ("jax_enable_x64", True),
        ("jax_default_prng_impl", "rbg"),
        ("jax_threefry_partitionable", False),
    ],
)
def test_settings_of_jax_change_the_key(flag: str, value: object) -> None:
    before, was = key(), getattr(jax.config, flag)
    jax.config.update(flag, value)
    try:
        assert key() != before
    finally:
        jax.config.update(flag, was)
    assert key() == before


@pytest.mark.usefixtures("same_code")
def test_a_library_and_a_device_change_the_key(monkeypatch: pytest.MonkeyPatch) -> None:
    before = key()
    for name in ("jax", "jaxlib", "mujoco", "mujoco-mjx", "mjx_balance"):
        with monkeypatch.context() as patch:
            changed = program_cache.versions() | {name: "99"}
            patch.setattr(program_cache, "versions", lambda changed=changed: changed)
            assert key() != before
    for module, name, other in (
        (jax, "devices", jax.local_devices()[:1]),
        (program_cache, "cores", 99),  # threads of the engine
    ):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, lambda other=other: other)
            assert key() != before, name
    assert key() == before


def test_the_code_that_is_traced_is_found_and_no_other() -> None:
    found = {name.removeprefix("mjx_balance.") for name, _ in traced_code(CONFIG, ROOT)}
    traced = "envs.balance sim.engines.mjx sim.scene config task.reward task.step"
    traced += " training.sizing dqn.dqn dqn.networks dqn.normalization dqn.mesh dqn.replay"
    assert set(traced.split()) <= found
    other = dict(traced_code(dataclasses.replace(CONFIG, engine="mujoco"), ROOT))
    assert "mjx_balance.sim.engines.mujoco_ffi" in other
    others = "cli evaluation render report report.progress training.finish training.loop"
    assert not found & set(others.split())
    assert not [name for name in found if name.startswith("report")]


def test_an_edit_of_what_is_traced_changes_the_key_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "copy"
    (package / "inner").mkdir(parents=True)
    files = {
        "root.py": "from mjx_balance.inner.deep import f\nimport mjx_balance.direct, os",
        "direct.py": "x = 1",
        "inner/__init__.py": "",
        "inner/deep.py": "def f():\n    from mjx_balance import lazy\n",
        "lazy.py": "from mjx_balance import root",
        "report.py": "from mjx_balance import root",
    }
    for name, text in files.items():
        (package / name).write_text(text)
    (tmp_path / "scenes").mkdir()
    scene = tmp_path / "scenes" / "robot.xml"
    scene.write_text("<mujoco/>")
    found = code("mjx_balance.root", package=package)
    names = sorted(name.removeprefix("mjx_balance.") for name in found)
    assert names == ["direct", "inner", "inner.deep", "lazy", "root"]
    monkeypatch.setattr(program_cache, "code", lambda *of: code(*of, package=package))
    monkeypatch.setattr(program_cache, "scene_dir", lambda: tmp_path / "scenes")

    def today() -> str:
        return program_key(CONFIG, 1, "mjx_balance.root")

    before = today()
    (package / "report.py").write_text("changed = 1")
    (package / "lazy.py").write_text("from mjx_balance import root  # a comment")
    assert today() == before
    for file in (package / "lazy.py", scene):
        file.write_text(f"{file.read_text()}\ny = 2")
        assert today() != before
        before = today()
