"""The command line, `mjx-balance`: every command, and what it says of input that it cannot use."""

import argparse
import dataclasses
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from mjx_balance.config import Config, check, fitted, preset
from mjx_balance.errors import FAILED, INTERRUPTED, USAGE_ERROR, InputError, how_to_install
from mjx_balance.evaluation import rollout as evaluation
from mjx_balance.evaluation.controllers import Controller, ControllerError, make_controller
from mjx_balance.files.run_folder import read_run_config, write_atomically, write_json
from mjx_balance.policy.file import PolicyError, load_policy
from mjx_balance.quiet import quiet_imports
from mjx_balance.sim.scene import Scene, load_scene

HELP = ("-h", "--help")
COMMANDS = ("train", "sweep", "evaluate", "report", "export", "view", "robot")


@dataclasses.dataclass(frozen=True)
class TrainArgs:
    """Train a policy in MJX, export it and evaluate it in plain MuJoCo."""

    run_dir: Path | None = None
    """Folder to create for the run; none: runs/PRESET-SEED-TIME."""
    resume: Path | None = None
    """Run folder to continue instead."""
    profile: bool = False
    """Trace a call of the training program, and tell what share of it each part takes."""
    distributed: bool = False
    """Be one of several processes, on one machine or many, that Slurm, Open MPI or Kubernetes has
    started; or one that the next three flags place. All get the same other flags."""
    coordinator: str | None = None
    """HOST:PORT at which process 0 listens, where no cluster says so."""
    process_id: int | None = None
    """Number of this process, from 0."""
    num_processes: int | None = None
    """How many there are."""
    config: tyro.conf.OmitArgPrefixes[Config] = dataclasses.field(default_factory=Config)


@dataclasses.dataclass(frozen=True)
class EvaluateArgs:
    """Evaluate an exported policy in plain MuJoCo on all cores. Needs no JAX."""

    policy: Annotated[Path | None, tyro.conf.Positional] = None
    """Policy file, run folder, or the name of a shipped policy."""
    controller: str | None = None
    """Baseline to evaluate instead: none, pd-imu, pd-attitude, rate-oracle or clairvoyant."""
    robot: str | None = None
    """Robot of the baseline; of a policy, where its robot's file is now."""
    suite: str = "paper"
    """Kind of scenarios: paper, corner, noise, payload, friction, gains, latency, push, fast or
    steep."""
    scenarios: int = 256
    """How many of them."""
    duration: float = 60.0
    """Length of each, s."""
    seed: int = 0
    """Seed that draws them."""
    json: Path | None = None
    """File to write the figures to."""
    video: Path | None = None
    """MP4 to write of the first scenario."""


@dataclasses.dataclass(frozen=True)
class ReportArgs:
    """Write one HTML page about runs: tables, curves, envelope, video. Needs no JAX."""

    run_dirs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run folders; the first with a policy is shown beside the baselines."""
    out: Path | None = None
    """File to write; none: report.html in the first folder."""
    scenarios: int = 64
    """Scenarios per suite and controller."""


@dataclasses.dataclass(frozen=True)
class ExportArgs:
    """Write a policy as an ONNX model. Needs the package onnx, and no JAX."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Policy file, run folder, or the name of a shipped policy."""
    out: Path
    """File to write, NAME.onnx."""


@dataclasses.dataclass(frozen=True)
class ViewArgs:
    """Watch a policy in MuJoCo's viewer; tilt the board and kick the robot by keys."""

    policy: Annotated[Path | None, tyro.conf.Positional] = None
    """Policy file, run folder, or the name of a shipped policy."""
    controller: str | None = None
    """Baseline to watch instead: none, pd-imu, pd-attitude, rate-oracle or clairvoyant."""
    robot: str | None = None
    """Robot of the baseline; of a policy, where its robot's file is now."""
    suite: str | None = None
    """Suite whose boards and kicks to show; none: those of the keys."""
    seed: int = 0
    """Seed that draws them."""


@dataclasses.dataclass(frozen=True)
class RobotCheckArgs:
    """Build a robot, tilt it, and say what was found."""

    robot: Annotated[str, tyro.conf.Positional]
    """TOML file, shipped robot's name, or menagerie:NAME."""
    picture: Path | None = None
    """PNG to draw it to; none: NAME-check.png in this folder, whatever is there."""


@dataclasses.dataclass(frozen=True)
class RobotNewArgs:
    """Draft a robot's TOML file from its model."""

    model: Annotated[str, tyro.conf.Positional]
    """MJCF or URDF file, PACKAGE:PATH of one in a Python package, or menagerie:NAME."""
    out: Path | None = None
    """File to write; none: the terminal."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns its exit code, 2 for input that cannot be used."""
    argv = list(sys.argv[1:] if arguments is None else arguments)
    if not argv or argv[0] not in COMMANDS:
        wants_help = bool(argv) and argv[0] in HELP
        print(f"usage: mjx-balance {{{','.join(COMMANDS)}}} ... (--help after one lists its flags)")
        if argv and not wants_help:
            _complain(f"unknown command {argv[0]!r}; known commands: {', '.join(COMMANDS)}")
        return 0 if wants_help else USAGE_ERROR
    commands = {
        "train": _train,
        "sweep": _sweep,
        "evaluate": _evaluate,
        "report": _report,
        "export": _export,
        "view": _view,
        "robot": _robot,
    }
    try:
        return commands[argv[0]](argv[1:])
    except InputError as error:
        return _complain(str(error))
    except OSError as error:
        return _complain(f"cannot write {error.filename or 'all of it'}: {error.strerror}")
    except KeyboardInterrupt:
        return INTERRUPTED


def _sweep(argv: list[str]) -> int:
    """`mjx-balance sweep gamma=0.1,0.4 @FILE ... [flags of train]`: a train with `--sweep`."""
    count = next((k for k, text in enumerate(argv) if text.startswith("-")), len(argv))
    entries = []
    for text in argv[:count]:
        if not text.startswith("@"):
            entries.append(text)
            continue
        try:
            entries += Path(text[1:]).read_text().split()
        except (OSError, UnicodeDecodeError) as error:
            return _complain(f"the values in {text[1:]} cannot be read: {error}")
    if not entries and not {"--resume", *HELP} & set(argv):
        return _complain(
            "say what to try, as gamma=0.1,0.4, or @FILE with such entries, before train's flags"
        )
    return _train([*argv[count:], *(["--sweep", *entries] if entries else [])])


def _train(argv: list[str]) -> int:
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--preset", default="default")
    early.add_argument("--robot", default="quadruped")
    early.add_argument("--resume", type=Path)
    known, _ = early.parse_known_args(argv)
    if known.resume is None:
        default = TrainArgs(config=fitted(preset(known.preset), known.robot))
    else:
        default = TrainArgs(config=read_run_config(known.resume))
    parsed = tyro.cli(TrainArgs, args=argv, prog="mjx-balance train", default=default)
    if parsed.resume and parsed.run_dir:
        return _complain("--resume continues a folder in place; leave --run-dir out")

    engine = parsed.config.engine
    try:
        with quiet_imports("torch", *(["warp"] if engine != "warp" else [])):
            from jax.errors import JaxRuntimeError

            from mjx_balance.training import processes, run, sizing
    except ModuleNotFoundError as error:
        return _complain(
            f"training needs {(error.name or '').partition('.')[0]}, which is not installed; "
            + how_to_install("train")
        )
    from mjx_balance.report.progress import Display

    display = Display()
    try:
        place = None
        where = (parsed.coordinator, parsed.process_id, parsed.num_processes)
        if parsed.distributed or where != (None, None, None):
            place = processes.find_place(*where)
            if place.index:
                display = Display(Console(quiet=True))
        run.train(parsed.config, parsed.run_dir, parsed.resume, display, place, parsed.profile)
    except (processes.ProcessLostError, PolicyError) as error:
        _complain(str(error))
        return FAILED
    except JaxRuntimeError as error:
        said = sizing.explained(error)
        if said is None:
            raise
        _complain(said)
        return FAILED
    except OSError as error:  # a full disk: what is saved stays, and can be resumed
        _complain(f"cannot write {error.filename or 'the run'}: {error.strerror}")
        return FAILED
    except run.Interrupted as stopped:
        display.say(str(stopped))
        return INTERRUPTED
    return 0


def _who_acts(
    policy: Path | None, baseline: str | None, robot: str | None
) -> tuple[Scene, Controller]:
    """A policy or a baseline, and its scene."""
    if (policy is None) == (baseline is None):
        raise ControllerError("name a policy file or --controller NAME, one of the two")
    if policy is not None:
        loaded = load_policy(policy)
        return evaluation.policy_scene(loaded, robot=robot), evaluation.observing(loaded)
    assert baseline is not None
    scene = load_scene(check(fitted(preset("default"), robot or "quadruped")))
    return scene, make_controller(baseline, scene)


def _evaluate(argv: list[str]) -> int:
    args = tyro.cli(EvaluateArgs, args=argv, prog="mjx-balance evaluate")
    from mjx_balance.report.progress import Display
    from mjx_balance.report.tables import evaluation_table

    display = Display(Console(stderr=True))
    _check_out("json", args.json)
    _check_out("video", args.video, ".mp4")
    scene, controller = _who_acts(args.policy, args.controller, args.robot)
    with display.bar(f"evaluating, suite {args.suite}") as bar:
        rollout = evaluation.run_suite(
            scene,
            controller,
            args.suite,
            args.scenarios,
            args.duration,
            args.seed,
            bar,
        )
    result = evaluation.summarize(rollout, args.suite, args.duration, args.seed)
    Console().print(evaluation_table({args.suite: result}))
    speed = result["physics_steps_per_second"]
    print(f"{speed:,.0f} physics steps per second", flush=True)
    if args.json:
        write_json(args.json, result)
    if args.video:
        return _video(scene, controller, args)
    return 0


def _video(scene, controller, args: EvaluateArgs) -> int:
    from mjx_balance.render import drawing as render

    assert args.video is not None
    rollout = evaluation.run_suite(
        scene, controller, args.suite, 1, args.duration, args.seed, record=True
    )
    assert rollout.qpos is not None
    try:
        render.write(args.video, scene.config, rollout.qpos[0])
    except render.RenderError as error:
        print(f"mjx-balance: no video written: {error}", file=sys.stderr)
        return FAILED
    print(f"video of the first scenario: {args.video}")
    return 0


def _report(argv: list[str]) -> int:
    args = tyro.cli(ReportArgs, args=argv, prog="mjx-balance report")
    from mjx_balance.report.page import write_report
    from mjx_balance.report.progress import Display

    if not args.run_dirs:
        return _complain("name at least one run folder")
    _check_out("out", args.out)
    out = args.out or args.run_dirs[0] / "report.html"
    display = Display(Console(stderr=True))
    missing = write_report(args.run_dirs, out, args.scenarios, display.bar)
    for sentence in missing:
        print(f"mjx-balance: {sentence}", file=sys.stderr)
    print(out)
    return 0


def _export(argv: list[str]) -> int:
    args = tyro.cli(ExportArgs, args=argv, prog="mjx-balance export")
    if args.out.suffix != ".onnx":
        return _complain(f"out is {args.out}; its name must end in .onnx")
    try:
        from mjx_balance.policy.onnx import OPSET, export_onnx
    except ImportError as error:
        return _complain(f"export needs the package onnx ({error}); {how_to_install('onnx')}")
    policy = load_policy(args.policy)
    size = export_onnx(policy, args.out)
    print(f"{args.out}: {size / 1000:,.1f} kB, opset {OPSET}")
    print(
        f"observation (N, {policy.observation_size}) float32 -> "
        f"q_values (N, {len(policy.actions)}) float32, action (N,) int64"
    )
    return 0


def _view(argv: list[str]) -> int:
    args = tyro.cli(ViewArgs, args=argv, prog="mjx-balance view")
    import mujoco

    from mjx_balance.cli import viewing
    from mjx_balance.render import drawing as render

    scene, controller = _who_acts(args.policy, args.controller, args.robot)
    session = viewing.Session(scene, controller, args.suite, args.seed)
    try:
        window = render.Window(scene.config, session.press)
    except render.RenderError as error:
        return _complain(f"{error}; `mjx-balance evaluate --video` needs no display")
    corners = mujoco.mjtGridPos
    keys = "Enter: kick" if args.suite else viewing.HELP
    try:
        while window.is_open:
            window.write(
                (corners.mjGRID_TOPLEFT, *session.caption()),
                (corners.mjGRID_BOTTOMLEFT, keys, ""),
            )
            window.play(session.decide())
    finally:
        window.close()
    return 0


def _robot(argv: list[str]) -> int:
    """`mjx-balance robot check ROBOT` and `mjx-balance robot new MODEL`."""
    commands = {"check": _robot_check, "new": _robot_new}
    if argv and argv[0] in HELP:
        print("usage: mjx-balance robot {check,new} ... (--help after one lists its flags)")
        return 0
    if not argv or argv[0] not in commands:
        return _complain("say robot check FILE.toml, or robot new MODEL.xml")
    return commands[argv[0]](argv[1:])


def _robot_check(argv: list[str]) -> int:
    args = tyro.cli(RobotCheckArgs, args=argv, prog="mjx-balance robot check")
    from mjx_balance.cli import inspection
    from mjx_balance.render import drawing as render

    _check_out("picture", args.picture, ".png")
    scene, tilted = inspection.find_out(args.robot)
    print("\n".join(inspection.described(scene, tilted)))
    short = inspection.shortcomings(scene, tilted)
    for sentence in short:
        print(f"mjx-balance: {sentence}", file=sys.stderr)
    picture = args.picture or Path(f"{scene.robot.name.replace(':', '_')}-check.png")
    try:
        render.write(picture, scene.config, tilted.qpos[None])
    except render.RenderError as error:
        print(f"mjx-balance: no picture drawn: {error}", file=sys.stderr)
        return FAILED
    print(f"picture: {picture}")
    return FAILED if short else 0


def _robot_new(argv: list[str]) -> int:
    args = tyro.cli(RobotNewArgs, args=argv, prog="mjx-balance robot new")
    from mjx_balance.robots.build import model_path
    from mjx_balance.robots.draft import draft

    path = model_path(args.model, Path())
    model = args.model
    if args.out is not None:
        if args.out.exists():
            return _complain(f"{args.out} exists already")
        _check_out("out", args.out)
        if path == Path(model):
            model = os.path.relpath(path, args.out.parent)
    text = draft(model, path)
    if args.out is None:
        print(text, end="")
    else:
        write_atomically(args.out, text)
        print(f"{args.out}: see `mjx-balance robot check {args.out}`")
    return 0


def _check_out(name: str, path: Path | None, suffix: str = "") -> None:
    """Refuses a file that cannot be written, before what goes into it has taken its time.

    Raises:
      InputError: if its name ends in something else, or its folder does not exist.
    """
    if path is None:
        return
    if suffix and path.suffix != suffix:
        raise InputError(f"{name} is {path}; its name must end in {suffix}")
    if path.is_dir():
        raise InputError(f"cannot write {path}: it is a folder")
    if not path.absolute().parent.is_dir():
        raise InputError(f"cannot write {path}: its folder does not exist")


def _complain(message: str) -> int:
    print(f"mjx-balance: {message}", file=sys.stderr)
    return USAGE_ERROR


if __name__ == "__main__":
    sys.exit(main())
