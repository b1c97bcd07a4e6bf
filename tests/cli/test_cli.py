"""Bad input: one sentence, exit code 2, nothing touched."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from fixtures.policies import rewrite
from rich.console import Console

from mjx_balance.cli import evaluate, main
from mjx_balance.cli.common import ControllerArgs
from mjx_balance.config import ConfigError, preset, to_dict
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.errors import FAILED
from mjx_balance.evaluation.controllers import View, make_controller
from mjx_balance.evaluation.rollout import observing, run_suite, summarize
from mjx_balance.files.run_folder import RunFolderError, create_run_folder, locked, write_json
from mjx_balance.policy.file import PolicyError, load_policy
from mjx_balance.render.drawing import VIDEO_SIZE, RenderError
from mjx_balance.report.progress import Display
from mjx_balance.report.tables import print_summary
from mjx_balance.robots.catalogue import SHIPPED as SHIPPED_ROBOTS
from mjx_balance.robots.catalogue import find_robot
from mjx_balance.robots.limits import for_robot
from mjx_balance.sim.scene import load_scene, scene_dir
from mjx_balance.training import run
from mjx_balance.training.checkpoints import CheckpointError, SaveError

REPO = Path(__file__).parents[2]
SHIPPED = REPO / "policies" / "best.safetensors"


@pytest.fixture(autouse=True)
def _in_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def refuse(capsys: pytest.CaptureFixture[str], *arguments: str, wanted: int = 2) -> str:
    """Runs a command that must end with an error; returns what it says, in one line."""
    try:
        code = main(arguments)
    except SystemExit as stopped:  # tyro's own refusals
        code = stopped.code
    assert code == wanted
    said = capsys.readouterr()
    return " ".join((said.err + said.out).split())


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        ("--preset huge", "unknown preset 'huge'; known presets: paper, default, best"),
        ("--warp-speed 9", "unknown flag --warp-speed; `mjx-balance train --help-all` lists"),
        ("--num_env 64", "unknown flag --num-env; did you mean --num-envs?"),
        ("--preset quik", "unknown preset 'quik'; did you mean quick?"),
        ("--robot go3", "robot is 'go3'; did you mean go2?"),
        ("--gamma much", "--gamma"),
        ("--gamma 1.5", "gamma is 1.5"),
        ("--target-period 3", "target_period is 3.0 s"),
        ("--max-incline 12", "max_incline is 12.0 deg"),
        ("--num-seeds 100000 --num-envs 64", "100000 runs with num_envs 64 and replay_capacity"),
        ("--replay-capacity 4000000000", "replay_capacity 4000000000 take about"),
        ("--reward-tilt sideways", "--reward-tilt"),
        ("--preset paper --num-envs 63 --num-devices 2", "num_envs is 63"),
        ("--robot rex", "robot is 'rex'; known robots: aliengo, b2"),
        ("--robot rex.toml", "no robot file at rex.toml"),
        ("--num-envs 64 --num-devices 8", "num_devices is 8"),
        ("--eval-scenarios 100000000", "eval_scenarios is 100000000 and duration 60 s: that"),
        ("--preset smoke --run-dir text", "run folder text exists"),
        ("--preset smoke --run-dir text/run", "run folder text/run cannot be written"),
        ("--resume nowhere", "nowhere is no run folder"),
    ],
)
def test_impossible_training_is_refused(
    capsys: pytest.CaptureFixture[str], flags: str, named: str, tmp_path: Path
) -> None:
    (tmp_path / "text").write_text("precious")
    assert named in refuse(capsys, "train", *flags.split())
    assert [(x.name, x.read_text()) for x in tmp_path.iterdir()] == [("text", "precious")]


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (ConfigError("seed is x"), 2, "mjx-balance: seed is x"),
        (RunFolderError("it is finished"), 2, "mjx-balance: it is finished"),
        (CheckpointError("none is whole"), 2, "mjx-balance: none is whole"),
        (PolicyError("no finite numbers"), 1, "mjx-balance: no finite numbers"),
        (SaveError("no room"), 1, "mjx-balance: no room"),
        (OSError(28, "No room", "runs/a"), 1, "mjx-balance: cannot write runs/a: No room"),
        (run.Interrupted("go on with --resume x"), 130, "go on with --resume x"),
        (KeyboardInterrupt(), 130, ""),
    ],
    ids=lambda value: type(value).__name__,
)
def test_no_training_ends_in_a_traceback(
    error: BaseException,
    code: int,
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(run, "train", mock.Mock(side_effect=error))
    assert main(["train", "--preset", "smoke"]) == code
    shown = capsys.readouterr()
    first = "preset smoke: importing JAX and MuJoCo ..."
    assert " ".join((shown.out + shown.err).split()) == f"{first} {said}".strip()


def test_flags_start_from_the_preset_or_from_the_resumed_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given: list[Any] = []
    monkeypatch.setattr(run, "train", lambda *arguments, **_: given.append(arguments))
    assert main(["train", "--preset", "smoke", "--gamma", "0.7", "--run-dir", "a"]) == 0
    config, run_dir, resume, display, *others = given[0]
    assert (display.console.quiet, others) == (False, [None, False])
    assert (config.preset, config.num_envs, config.dqn.gamma) == ("smoke", 64, 0.7)
    assert (run_dir, resume) == (Path("a"), None)
    assert main(["train"]) == 0
    assert given[1][0] == preset("default")
    saved = dataclasses.replace(preset("best"), seed=9, num_env_steps=77)
    create_run_folder(tmp_path / "run", to_dict(saved), {})
    assert main(["train", "--resume", "run"]) == 0
    assert given[2][:3] == (saved, None, Path("run"))


def test_a_process_among_several_is_quiet_but_for_the_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[Any] = []
    monkeypatch.setattr(run, "train", lambda *arguments, **_: given.append(arguments[3:]))
    where = "--coordinator localhost:7 --num-processes 3 --process-id"
    for index in (0, 2):
        assert main(["train", "--profile", *where.split(), str(index)]) == 0
    (first, *one), (other, *two) = given
    assert one == [("localhost:7", 3, 0, None), True]
    assert two == [("localhost:7", 3, 2, None), True]
    assert (first.console.quiet, other.console.quiet) == (False, True)


def test_a_report_is_of_what_was_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """8 scenarios into the first folder, or what the flags say; what is missing is said."""
    asked: list[Any] = []
    monkeypatch.setattr(
        "mjx_balance.report.page.write_report",
        lambda *given: asked.append((*given[:3], given[5])) or ["no video"],
    )
    assert main(["report", "a", "b"]) == 0
    assert main("report a --out page.html --scenarios 5 --no-video".split()) == 0
    a, b = Path("a"), Path("b")
    first, second = ((a, b), a / "report.html", 8, True), ((a,), Path("page.html"), 5, False)
    assert asked == [first, second]
    said = capsys.readouterr()
    assert said.out.split() == ["a/report.html", "page.html"]
    assert said.err == 2 * "mjx-balance: no video\n"


SMOKE = dataclasses.replace(preset("smoke"), num_devices=1)


def test_what_cannot_be_resumed_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder = create_run_folder(tmp_path / "run", to_dict(SMOKE), {"versions": {}})
    for flags, named in (
        ("--gamma 0.9", "run was started with gamma = 0.1, not 0.9"),
        ("--preset paper", "run was started with preset = smoke, not paper"),
        ("--run-dir b", "--resume continues a folder in place"),
        ("", f"started with scene_hash None, but it is {load_scene(SMOKE).hash} today"),
    ):
        assert named in refuse(capsys, "train", "--resume", "run", *flags.split())
    assert sorted(os.listdir(folder.path)) == ["config.json", "provenance.json"]
    write_json(folder.provenance, run.provenance(BalanceEnv(SMOKE)))
    with locked(folder):
        said = refuse(capsys, "train", "--resume", "run")
    assert "another process works on the run in run;" in said
    folder.evaluation.write_text("{}")
    assert "is finished" in refuse(capsys, "train", "--resume", "run")


def test_a_run_goes_on_with_its_robot_alone(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, bodies: Any
) -> None:
    """A command delay is in no scene."""
    file, model = tmp_path / "rex.toml", Path("scenes:quadruped.xml")
    file.write_text(bodies.file_text(model, command_delay=0.01))
    config = for_robot(SMOKE, str(file))
    today = run.provenance(BalanceEnv(config))
    create_run_folder(tmp_path / "run", to_dict(config), today)
    file.write_text(bodies.file_text(model, command_delay=0.02))
    said = refuse(capsys, "train", "--resume", "run")
    assert "was started with robot_command_delay 0.01, but it is 0.02 today" in said


@pytest.mark.parametrize(
    ("command", "named"),
    [
        ("fly", "unknown command 'fly'; known commands: train, sweep, evaluate, report"),
        ("sweep", "say what to try, as gamma=0.1,0.4, or @FILE with such entries, before"),
        ("sweep --seed 1", "say what to try, as gamma=0.1,0.4"),
        ("sweep @nowhere", "the values in nowhere cannot be read"),
        ("sweep @text", "sweep is 'this'; it must name one of learning_rate"),
        ("sweep gamma=0.1 tau=1 --preset smoke", "sweep is 'tau=1'; it must name"),
        ("evaluate none.safetensors", "no policy file at none.safetensors"),
        ("evaluate .", "no policy file at .; "),
        ("evaluate text", "text is damaged or no safetensors file"),
        ("evaluate", "name a policy file or --controller NAME"),
        ("evaluate text --controller none", "name a policy file or --controller NAME"),
        ("evaluate --controller lqr", "unknown controller 'lqr'; known controllers: none"),
        ("evaluate --controller none --suite moon", "unknown suite 'moon'; known suites: paper"),
        ("evaluate best --suite cornr", "unknown suite 'cornr'; did you mean corner?"),
        ("evaluate --controller=pd-imo", "unknown controller 'pd-imo'; did you mean pd-imu?"),
        ("sweep gamma=0.1,0.2 --preset quik", "unknown preset 'quik'; did you mean quick?"),
        ("evaluate text --json no/such/out.json", "cannot write no/such/out.json"),
        ("evaluate --controller none --json .", "cannot write .: it is a folder"),
        ("evaluate --controller none --video text", "video is text; its name must"),
        ("evaluate --controller none --video v.mp4 --video-duration 0", "video_duration is 0"),
        ("evaluate --controller none --seed -1", "seed is -1"),
        ("evaluate --controller none --scenarios 0", "scenarios is 0"),
        ("evaluate --controller none --duration 1e12", "duration 1e+12 s: that takes about"),
        ("evaluate best --action both", "invalid choice 'both'"),
        ("evaluate --controller pd-imu --robot rex", "robot is 'rex'"),
        ("report", "name at least one run folder"),
        ("report .", ". is no run folder: it has none of config.json"),
        ("report nowhere", "nowhere is no folder"),
        ("report . --out no/such.html", "cannot write no/such.html: its folder does"),
        ("robot", "Expected one of {check, new}"),
        ("robot buy", "unknown command 'robot buy'; known commands: check, new"),
        ("robot chekc", "unknown command 'robot chekc'; did you mean check?"),
        ("evalute best", "unknown command 'evalute'; did you mean evaluate?"),
        ("completion cmd", "unknown shell 'cmd'; known shells: bash, zsh, fish"),
        ("robot check none.toml", "no robot file at none.toml"),
        ("robot check none.toml --picture no/such.png", "cannot write no/such.png: its folder"),
        ("robot check none.toml --picture rex.jpg", "is rex.jpg; its name must end in .png"),
        ("robot new none.xml", "there is no file none.xml"),
        ("robot new menagerie:rex", "menagerie:rex cannot be had"),
        ("robot new text", "text cannot be read"),
        ("robot new scenes:quadruped.xml --out text", "text exists already"),
        ("robot new scenes:quadruped.xml --out gone/rex.toml", "cannot write gone/rex.toml"),
        ("view", "name a policy file or --controller NAME"),
        ("view nobody", "no policy file at nobody; `mjx-balance train` writes one, and best"),
        ("view best --suite moon", "unknown suite 'moon'"),
        ("view best --seed -1", "seed is -1; it must not be negative"),
        ("view best", "); `mjx-balance view --browser` and `evaluate --video` need no display"),
    ],
)
def test_impossible_commands_are_refused(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    named: str,
    tmp_path: Path,
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "text").write_text("this is no policy")
    assert named in refuse(capsys, *command.split())
    assert [(x.name, x.read_text()) for x in tmp_path.iterdir()] == [("text", "this is no policy")]


@pytest.mark.parametrize("who", ["controller", pytest.param("policy", marks=pytest.mark.slow)])
def test_evaluate_writes_figures_and_a_video(
    who: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, read_video: Any
) -> None:
    """0.2 s of a baseline and of a policy, to the end of the command."""
    names = ("--controller", "pd-imu") if who == "controller" else (str(SHIPPED),)
    flags = "--suite corner --scenarios 2 --duration 0.2 --seed 5 --json out.json --video v.mp4"
    code = main(("evaluate", *names, *flags.split()))
    said = capsys.readouterr()
    result = json.loads((tmp_path / "out.json").read_text())
    scene = load_scene(preset("default" if who == "controller" else "best"))
    ours = observing(load_policy(SHIPPED)) if who == "policy" else make_controller("pd-imu", scene)
    rollout = run_suite(scene, ours, "corner", 2, 0.2, 5)
    expected = summarize(rollout, "corner", 0.2, 5)
    speeds = [found.pop("physics_steps_per_second") for found in (result, expected)]
    assert result == expected
    assert result["duration_s"] == 0.2
    assert "corner  2 x 0.2 s      0" in said.out
    assert f"{speeds[0]:,.0f} physics steps per second" in said.out
    if code == 1 and "no video written" in said.err:
        pytest.skip(said.err)
    assert code == 0
    assert "video of the first scenario: v.mp4" in said.out
    fps, frames = read_video(tmp_path / "v.mp4")
    assert (fps, len(frames), frames.shape[1:3]) == (25, 5, VIDEO_SIZE[::-1])
    assert np.abs(frames[-1] - frames[0]).mean() > 0.1, "the board moves"


def test_an_evaluation_is_of_what_was_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """256 scenarios of 60 s of suite paper, or what the flags say; the video has the same seed."""
    asked: list[Any] = []

    def run_suite(scene: Any, controller: Any, *given: Any, record: bool = False) -> Any:
        asked.append((*given[:4], record))
        return simulate(scene, controller, given[0], 1, 0.2, 0, record=record)

    simulate = evaluate.run_suite
    monkeypatch.setattr(evaluate, "run_suite", run_suite)
    drawn: list[Any] = []
    write = lambda *given, captions, progress: drawn.append(len(captions))  # noqa: E731
    monkeypatch.setattr("mjx_balance.render.drawing.write", write)
    assert main(["evaluate", "--controller", "none"]) == 0
    flags = "--suite push --scenarios 3 --duration 5 --seed 7 --video v.mp4"
    assert main(["evaluate", "--controller", "none", *flags.split()]) == 0
    assert asked == [
        ("paper", 256, 60.0, 0, False),
        ("push", 3, 5.0, 7, False),
        ("push", 1, 5.0, 7, True),
    ]
    assert drawn == [50], "a caption for each of 0.2 s of states"
    assert main(["evaluate", "--controller", "none", "--video", "v.mp4"]) == 0
    assert asked[-1] == ("paper", 1, 20.0, 0, True), "no more than the video shows"
    stages = re.findall(r"^(\d/\d \S+) .*\.\.\.$", capsys.readouterr().err, re.MULTILINE)
    with_video = ["1/2 evaluating,", "2/2 drawing"]
    assert stages == ["1/1 evaluating,", *with_video, *with_video]


@pytest.mark.parametrize("who", [{"policy": Path("best")}, {"controller": "pd-imu"}], ids=str)
def test_policies_and_baselines_command_what_they_are_asked_to(who: dict[str, Any]) -> None:
    """In 1 s of suite corner: whole multiples of 0.3 mm, or anything between them."""
    remainders = {}
    for action in (None, "grid", "continuous"):
        scene, controller = ControllerArgs(**who, action=action).load()
        seen: list[np.ndarray] = []

        def watch(view: View) -> np.ndarray:
            seen.append(controller(view))  # noqa: B023
            return seen[-1]  # noqa: B023

        run_suite(scene, watch, "corner", 2, 1.0, 5)
        levels = 1000 * np.asarray(seen) / 0.3
        assert np.abs(levels).max() < 10.001
        remainders[action] = np.abs(levels - np.rint(levels)).max()
    assert remainders["grid"] < 1e-4 < 0.3 < remainders["continuous"] == remainders[None]


def test_a_baseline_stands_on_the_robot_asked_for_as_high_as_it_should() -> None:
    for name in (None, "b2"):
        scene, _ = ControllerArgs(controller="none", robot=name).load()
        robot = find_robot(name or "quadruped")
        assert (scene.robot, scene.task.body_height) == (robot, robot.body_height)


@pytest.mark.parametrize("flag", ["-h", "--help"])
@pytest.mark.parametrize("command", [(), ("robot",), ("robot", "check"), ("sweep",), ("view",)])
def test_help_is_no_error(
    command: tuple[str, ...], flag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = main((*command, flag))
    except SystemExit as stopped:  # tyro's own
        code = stopped.code
    said = capsys.readouterr()
    assert (code, said.err) == (0, "")
    assert said.out.startswith("usage: mjx-balance ")


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk without room."""
    error = OSError(28, "No space left on device")
    monkeypatch.setattr(os, "fsync", mock.Mock(side_effect=error))


@pytest.mark.usefixtures("full_disk")
def test_a_full_disk_does_not_lose_the_table(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "out.json").write_text("older")
    flags = "--controller none --scenarios 1 --duration 0.2 --json out.json"
    assert main(("evaluate", *flags.split())) == 1
    said = capsys.readouterr()
    assert "1 x 0.2 s" in said.out
    assert said.err.endswith("mjx-balance: cannot write out.json: No space left on device\n")
    assert [(x.name, x.read_text()) for x in tmp_path.iterdir()] == [("out.json", "older")]


@pytest.mark.usefixtures("full_disk")
def test_a_full_disk_leaves_no_half_robot(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    said = refuse(capsys, "robot", "new", "scenes:quadruped.xml", "--out", "rex.toml", wanted=1)
    assert "cannot write rex.toml: No space left on device" in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("full_disk")
def test_a_full_disk_leaves_the_old_onnx_file(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("onnx")
    Path("p.onnx").write_text("old")
    said = refuse(capsys, "export", str(SHIPPED), "--out", "p.onnx", wanted=1)
    assert "cannot write p.onnx: No space left on device" in said
    assert [(x.name, x.read_text()) for x in tmp_path.iterdir()] == [("p.onnx", "old")]


def test_a_draft_is_written_though_its_model_has_to_be_mended(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Without a free joint, without a leg, with coupled joints; `--strip` mends what it can."""
    ours = (scene_dir() / "quadruped.xml").read_text()
    coupled = '<equality><joint joint1="LF_knee" joint2="LF_hip"/></equality></mujoco>'
    inertial = '<inertial pos="0 0 0" mass="0.01" diaginertia="1e-5 1e-5 1e-5"/>'
    toe = f'<body name="toe">{inertial}<joint name="toe" axis="0 1 0"/></body>'
    models = {
        "fixed": (('<freejoint name="root"/>', ""), "has no free joint", 4),
        "toed": (('<geom name="LF_foot"', f'{toe}<geom name="LF_foot"'), "3 chains of three", 3),
        "coupled": (("</mujoco>", coupled), "constraint of 'LF_knee' and 'LF_hip' couples", 4),
    }
    for name, (edit, problem, legs) in models.items():
        Path(f"{name}.xml").write_text(ours.replace(*edit, 1))
        assert main(["robot", "new", f"{name}.xml", "--out", f"{name}.toml"]) == FAILED
        text = Path(f"{name}.toml").read_text()
        assert (problem in text, problem in capsys.readouterr().err) == (True, True)
        assert "# To mend: " in text
        assert text.count("\njoints = ") == legs
    assert main(["robot", "new", "toed.xml", "--strip", "toe", "--out", "rex.toml"]) == 0
    assert 'strip = ["toe"]' in Path("rex.toml").read_text()


@pytest.mark.slow
def test_a_robots_draft_can_be_checked(capsys: pytest.CaptureFixture[str]) -> None:
    """With too weak a knee it stands on the level board, and is drawn on the tilted one."""
    shutil.copy(scene_dir() / "quadruped.xml", "model.xml")
    assert main(["robot", "new", "model.xml", "--out", "rex.toml"]) == 0
    assert "mjx-balance robot check rex.toml" in capsys.readouterr().out
    text = Path("rex.toml").read_text()
    assert 'model = "model.xml"' in text
    assert main(["robot", "check", "rex.toml", "--picture", "rex.png"]) == 0
    said = capsys.readouterr().out
    assert "rex: 15.20 kg" in said
    assert said.endswith("picture: rex.png\n")
    assert Path("rex.png").stat().st_size > 50_000
    assert main(["robot", "new", "model.xml"]) == 0
    assert capsys.readouterr().out == text
    Path("rex.toml").write_text(text.replace("trunk =", "knee_torque = 5.6\ntrunk =", 1))
    assert main(["robot", "check", "rex.toml"]) == 1
    said = capsys.readouterr()
    assert "mjx-balance: robot rex has no torque left at 7 deg" in said.err
    assert "_knee' takes 100% of its limit" in said.err
    assert said.out.endswith("picture: rex-check.png\n")


def test_a_check_without_a_picture_says_why(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "mjx_balance.render.drawing.write", mock.Mock(side_effect=RenderError("no OpenGL"))
    )
    assert main(["robot", "check", "quadruped"]) == FAILED
    said = capsys.readouterr()
    assert said.err == "mjx-balance: no picture drawn: no OpenGL\n"
    assert "picture:" not in said.out


def test_the_module_runs_as_the_command_does() -> None:
    command = [sys.executable, "-m", "mjx_balance", "fly"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "unknown command 'fly'" in done.stderr


def test_a_policy_stands_on_its_own_robot_alone(capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever it is called here."""
    said = refuse(capsys, "evaluate", str(SHIPPED), "--robot", "go1")
    assert "trained for robot 'quadruped' (15.2 kg), and go1 is another one (12.7 kg" in said
    flags = ["--scenarios", "1", "--duration", "1"]
    assert main(["evaluate", str(SHIPPED), "--robot", "quadruped", *flags]) == 0


ESCAPES = "\x1b[2J\x1b]0;title\x07\x9b31m\u202e"


def assert_safe(said: str) -> None:
    """A terminal obeys nothing in it, and no line floods it."""
    assert all(line.isprintable() for line in said.splitlines())
    assert "\r" not in said
    assert max(map(len, said.splitlines())) < 400


def test_names_in_a_model_reach_the_terminal_as_text(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """TOML can write any character, XML some."""
    model = (REPO / "scenes" / "quadruped.xml").read_text().replace("LF_knee", "LF\x9b31m\u202e")
    Path("model.xml").write_text(model.replace("RF_hip", "hip" + 5_000 * "x"))
    lines = (SHIPPED_ROBOTS / "quadruped.toml").read_text()
    lines = lines.replace("scenes:quadruped.xml", "model.xml").replace(
        "LF_knee", r"LF\u009b31m\u202e"
    )
    lines = lines.replace("RF_hip", "hip" + 5_000 * "x")
    Path("rex.toml").write_text(lines.replace("legs.LF", r'legs."\u001b[2J\u0007LF"'))
    main(["robot", "check", "rex.toml", "--picture", "rex.png"])
    said = capsys.readouterr()
    assert "?[2J?LF  front left" in said.out
    assert_safe(said.out + said.err)
    assert main(["robot", "new", "model.xml"]) == 0
    drafted = capsys.readouterr().out
    assert all(line.isprintable() for line in drafted.splitlines())
    names = [name for leg in tomllib.loads(drafted)["legs"].values() for name in leg["joints"]]
    assert "LF\x9b31m\u202e" in names, "and TOML gives them back"


@pytest.mark.parametrize(
    ("place", "field"),
    [("", "scene_hash"), ("robot", "trunk"), ("config", "robot"), ("config", "preset")],
)
@pytest.mark.parametrize("text", [ESCAPES, 100_000 * "x"])
def test_text_in_a_policy_reaches_the_terminal_as_text(
    place: str, field: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(SHIPPED, "p.safetensors")
    rewrite(Path("p.safetensors"), lambda w, m: (m[place] if place else m).update({field: text}))
    said = refuse(capsys, "evaluate", "p.safetensors", "--scenarios", "1", "--duration", "1")
    assert_safe(said)


def test_a_folders_name_reaches_the_terminal_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path(f"runs{ESCAPES}")
    folder.mkdir()
    for command in ("evaluate", "report", "view"):
        assert main([command, str(folder)]) == 2
    assert main(["report", str(folder), "--out", str(folder / "none" / "page.html")]) == 2
    print_summary(Console(), folder, {}, 1.0, "quadruped")
    Display(Console()).say(f"{folder}: preset default")
    said = capsys.readouterr()
    assert_safe(said.out + said.err)
    assert said.out.count("runs?[2J") == 3


class StubWindow:
    """Shows three decisions and is closed, having pressed a key in each."""

    def __init__(self, config: Any, on_key: Any):
        self.shown, self.said, self.on_key = [], [], on_key
        self.closed = False

    @property
    def is_open(self) -> bool:
        return len(self.shown) < 3

    def write(self, *texts: Any) -> None:
        self.said.append(texts)

    def play(self, states: np.ndarray) -> None:
        self.shown.append(states)
        self.on_key(262)

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def window(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], StubWindow]:
    """Flags of `view` -> the window that it opened."""

    def view(flags: str) -> StubWindow:
        windows: list[StubWindow] = []
        opened = lambda *given: windows.append(StubWindow(*given)) or windows[-1]  # noqa: E731
        monkeypatch.setattr("mjx_balance.render.drawing.Window", opened)
        assert main(["view", *flags.split()]) == 0
        assert [x.closed for x in windows] == [True]
        return windows[0]

    return view


def test_view_shows_a_policy_by_name(window: Callable[[str], StubWindow]) -> None:
    best = window("best")
    assert [x.shape for x in best.shown] == [(50, 21)] * 3
    assert "falls" in best.said[0][0][1]
    assert "arrows: tilt the board" in best.said[0][1][1]


def test_view_shows_the_scenario_of_a_suite_and_seed(window: Callable[[str], StubWindow]) -> None:
    corner = window("--controller none --suite corner --seed 3")
    scene = load_scene(preset("default"))
    rollout = run_suite(scene, make_controller("none", scene), "corner", 1, 0.6, 3, record=True)
    np.testing.assert_allclose(np.concatenate(corner.shown), rollout.qpos[0], atol=1e-9)
    assert {texts[1][1] for texts in corner.said} == {"Enter: push"}


def test_a_robot_file_finds_its_model_with_slashes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On Windows too, even from another drive, which no relative path leads to."""
    shutil.copy(scene_dir() / "quadruped.xml", tmp_path / "dog.xml")
    (tmp_path / "my robots").mkdir()

    def windows(path: Path, folder: Path) -> str:
        raise ValueError("path is on mount 'C:', start on mount 'D:'")

    for relpath, model in ((os.path.relpath, "../dog.xml"), (windows, f"{tmp_path}/dog.xml")):
        monkeypatch.setattr(os.path, "relpath", relpath)
        out = tmp_path / "my robots" / f"{len(model)}.toml"
        assert main(["robot", "new", "dog.xml", "--out", str(out)]) == 0
        assert f'model = "{model}"' in out.read_text("utf-8")
        assert f"robot check '{out}'`" in capsys.readouterr().out
