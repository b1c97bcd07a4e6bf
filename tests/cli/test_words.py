"""Words of the command line: help, spelling, completion, and `module:NAME`."""

import dataclasses
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mjx_balance.cli import main, words
from mjx_balance.cli.train import TrainArgs
from mjx_balance.config import Config
from mjx_balance.errors import InputError
from mjx_balance.evaluation.controllers import CONTROLLERS
from mjx_balance.evaluation.suites import SUITES
from mjx_balance.robots.catalogue import find_robot
from mjx_balance.sim.engines.table import ENGINES

HEAVY = {"jax", "mujoco", "numpy", "gymnasium", "tyro", "rich", "pydantic", "scipy"}
"""Packages that take long to import."""


def test_names_are_those_of_the_tables() -> None:
    assert tuple(SUITES) == words.SUITES
    assert tuple(CONTROLLERS) == words.CONTROLLERS
    assert tuple(ENGINES) == words.ENGINES


def test_every_flag_of_train_is_known() -> None:
    own = {field.name for field in dataclasses.fields(TrainArgs)} - {"config"}
    assert own == {field.name for field in dataclasses.fields(words.RunArgs)}
    flags = words.train_flags()
    assert {"--run-dir", "--num-envs", "--gamma", "--reward-toward", "--push-max"} <= {*flags}
    assert len(set(flags)) == len(flags) > 100


def test_help_begins_with_ten_flags_that_exist() -> None:
    shown = re.findall(r"^  (--[a-z-]+)", words.command_help("train") or "", re.MULTILINE)
    assert len(shown) == 10
    assert set(shown) <= set(words.train_flags())
    assert "--help-all" in words.TRAIN_HELP


def test_help_fits_into_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    for argv in (["--help"], ["train", "--help"], ["sweep", "-h"], ["completion", "--help"]):
        assert main(argv) == 0
        said = capsys.readouterr().out
        assert said.startswith("usage: mjx-balance")
        assert max(map(len, said.splitlines())) <= 80
        assert said == "".join(f"{line.rstrip()}\n" for line in said.splitlines())
        for name in words.COMMANDS if argv == ["--help"] else ():
            assert f"\n  {name} " in said
            assert f"mjx-balance {name} {words.COMMANDS[name].example}\n" in said


def test_all_flags_are_listed_on_request(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:  # tyro's own
        main(["train", "--help-all"])
    assert stopped.value.code == 0
    said = capsys.readouterr().out
    assert not [flag for flag in words.train_flags() if flag not in said]
    assert "importing" not in said


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    import mjx_balance

    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"mjx-balance {mjx_balance.__version__}\n"


def environment() -> dict[str, str]:
    """Of a process that imports what this one does."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def imported_before(flags: str, sign: str) -> tuple[set[str], str]:
    """Packages that a command has imported when it prints a line with `sign`, and that line."""
    command = [sys.executable, "-m", "mjx_balance", *flags.split()]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment() | {"PYTHONPROFILEIMPORTTIME": "1"},
    ) as process:
        packages: set[str] = set()
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("import time:"):
                packages.add(line.rpartition("|")[2].strip().partition(".")[0])
            elif sign in line:
                process.kill()
                return packages, line
    raise AssertionError(f"no line with {sign!r}")


@pytest.mark.parametrize(
    ("flags", "sign"),
    [
        ("train --preset smoke", "preset smoke: importing JAX and MuJoCo ..."),
        ("sweep gamma=0.1,0.2 --resume runs/x", "resuming runs/x: importing JAX and MuJoCo ..."),
        ("train --sede 3", "unknown flag --sede; did you mean --seed?"),
        ("evaluate best --suite cornr", "did you mean corner?"),
    ],
)
def test_the_first_line_waits_for_no_library(flags: str, sign: str) -> None:
    packages, line = imported_before(flags, sign)
    assert sign in line
    assert "mjx_balance" in packages
    assert packages & HEAVY == set()


def test_processes_among_several_are_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    words.first_line(["--process-id", "1"])
    words.first_line(["--distributed", "--preset", "smoke"])
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    "argv",
    [
        "--no-profile --mirror --no-mirror --reward-fail -0.5 --num_envs 64 --gamma=0.3",
        "--robot my.toml",
        "--robot menagerie:unitree_go1",
        "--robot mine:DOG --preset=quick",
        "--board-motions ramps sea --help-all",
    ],
)
def test_right_words_pass(argv: str) -> None:
    words.check_words("train", argv.split())


def test_the_last_of_several_values_counts() -> None:
    argv = ["--preset", "x", "--preset=quick", "--robot"]
    assert words.value_of(argv, "--preset") == "quick"
    assert words.value_of(argv, "--robot", "none") == "none"
    words.check_words("train", argv)
    with pytest.raises(InputError, match="unknown preset 'x'"):
        words.check_words("train", argv[:2])


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("ev", ["evaluate"]),
        ("train --preset qu", ["quick"]),
        ("train --num-s", ["--num-seeds"]),
        ("evaluate best --suite co", ["corner"]),
        ("evaluate --controller pd", ["pd-imu", "pd-attitude"]),
        ("robot ", ["check", "new"]),
        ("train --robot go", ["go1", "go2"]),
        ("report ru", []),
    ],
)
def test_words_are_completed(
    line: str, expected: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["completion", "bash", *line.split(" ")]) == 0
    assert capsys.readouterr().out.split() == expected


def test_bash_completes() -> None:
    """The script itself, in a shell that has our command."""
    if shutil.which("bash") is None:
        pytest.skip("no bash")
    command = f'mjx-balance() {{ {sys.executable} -m mjx_balance "$@"; }}'
    typed = "COMP_WORDS=(mjx-balance evaluate --suite st); COMP_CWORD=3"
    ask = f'{typed}; _mjx_balance; echo "${{COMPREPLY[*]}}"'
    done = subprocess.run(
        ["bash", "-c", f"{command}\n{words.SCRIPTS['bash']}\n{ask}"],
        capture_output=True,
        text=True,
        env=environment(),
    )
    assert (done.stdout, done.stderr) == ("steep steps\n", "")


OWN = """
import dataclasses
from pathlib import Path
from mjx_balance import RandomizationConfig, Suite
from mjx_balance.robots.catalogue import robot_file

ICE = Suite(RandomizationConfig(friction_min=0.1, friction_max=0.2))
SOFT = dataclasses.replace(robot_file("quadruped"), name="soft", servo_stiffness=300.0)
DOG = Path("dog.toml")
HERE = Path(__file__).parent / "here.toml"
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with modules of the user's, in which the command runs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    for name in ("own", "faulty"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "faulty.py").write_text("DOG = 1 / 0\n")
    text = (Path(words.__file__).parents[1] / "robots" / "quadruped.toml").read_text()
    (tmp_path / "here.toml").write_text(text)
    return tmp_path


SHORT = "--scenarios 1 --duration 0.2".split()


@pytest.mark.usefixtures("own")
def test_a_suite_of_ones_own_is_evaluated(capsys: pytest.CaptureFixture[str]) -> None:
    before = list(sys.path)
    flags = ["--suite", "own:ICE", "--json", "out.json", *SHORT]
    assert main(["evaluate", "--controller", "none", *flags]) == 0
    assert "own:ICE  1 x 0.2 s" in capsys.readouterr().out
    assert '"suite": "own:ICE"' in Path("out.json").read_text()
    assert sys.path == before


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize("robot", ["own:SOFT", "own:HERE"])
def test_a_robot_of_ones_own_stands(robot: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--controller", "none", "--robot", robot, *SHORT]) == 0
    assert "1 x 0.2 s" in capsys.readouterr().out
    stiffness = np.max(find_robot(robot).servo_stiffness)
    assert stiffness == (300 if robot == "own:SOFT" else 400)


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("evaluate best --suite nowhere:ICE", "module 'nowhere' cannot be imported: No module na"),
        ("evaluate best --suite own:ICY", "own has no 'ICY'; did you mean ICE?"),
        ("evaluate best --suite own:SOFT", "suite is 'own:SOFT', which is RobotFile(name='soft',"),
        ("evaluate --controller none --robot own:ICE", "it must be a RobotFile, or the path of"),
        ("evaluate --controller none --robot own:DOG", "no robot file at dog.toml"),
        ("train --robot faulty:DOG", "module 'faulty' cannot be imported: division by zero"),
    ],
)
def test_what_is_not_there_is_refused(
    command: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command.split()) == 2
    assert sentence in capsys.readouterr().err


def test_no_config_imports_a_module(own: Path) -> None:
    """A run folder or a policy may come from a stranger."""
    with pytest.raises(InputError, match="robot is 'faulty:DOG', which is made in Python"):
        find_robot(Config(robot="faulty:DOG").robot)
    assert "faulty" not in sys.modules
