"""Every snippet of README.md and docs/ is run; the pages say what there is, and all of it.

Python is executed, page by page, in a folder that looks like the repository. Commands go through
the real command line: what takes long is made short (evaluations) or left out once its flags are
parsed and its config is checked (trainings, reports, pictures). A kind of snippet that nobody
knows how to run is a failure.
"""

import argparse
import dataclasses
import http.server
import importlib
import inspect
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import time
import tomllib
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import jax
import mujoco_menagerie
import pytest
import yaml
from brax.training.agents.ppo import train as ppo
from fixtures.headers import compiler

from mjx_balance import cli, config, load_policy, runtime
from mjx_balance.cli import browser
from mjx_balance.cli import evaluate as evaluate_command
from mjx_balance.cli import train as train_command
from mjx_balance.envs import balance as env
from mjx_balance.envs import brax as brax_training
from mjx_balance.evaluation import rollout as evaluation
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.render import drawing as render
from mjx_balance.report import page as report_page
from mjx_balance.robots.catalogue import find_robot, shipped
from mjx_balance.robots.schema import LegFile, RobotFile, parse_robot_file
from mjx_balance.sim.engines.table import make_engine
from mjx_balance.training import processes, run, tracking
from mjx_balance.training.callbacks import Callbacks
from mjx_balance.training.finish import Finished
from mjx_balance.training.sizing import make_learner

REPO = Path(__file__).resolve().parent.parent
DOCS = REPO / "docs"
PAGES = [REPO / "README.md", *sorted(DOCS.rglob("*.md"))]
PROJECT = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]
BY_SPHINX = ("{include}", "{toctree}", "{eval-rst}")
"""Directives, which `make docs` carries out."""
ELSEWHERE = ("source .venv/bin/activate",)
"""Lines of a shell that say where the others run."""


class Snippet(NamedTuple):
    """A fenced code block, or a command between two backticks."""

    line: int
    """Of its first line of text."""
    kind: str
    """What follows the fence."""
    text: str


def snippets(text: str) -> list[Snippet]:
    """The fenced code blocks of a page, indented ones too, and the commands in its sentences."""
    found, prose = [], []
    fence, kind, start, lines = "", "", 0, []
    for number, line in enumerate(text.splitlines(), 1):
        match = re.match(r"\s*(`{3,}|~{3,})\s*(.*?)\s*$", line)
        if fence:
            if match and match[1].startswith(fence) and not match[2]:
                indent = min((len(x) - len(x.lstrip()) for x in lines if x.strip()), default=0)
                found.append(Snippet(start, kind, "\n".join(x[indent:] for x in lines) + "\n"))
                fence, lines = "", []
            else:
                lines.append(line)
        elif match:
            fence, kind, start = match[1], match[2], number + 1
        prose.append("" if fence or match else line)
    assert not fence, f"the block that begins at line {start} does not end"
    whole = "\n".join(prose)
    for match in re.finditer(r"`((?:mjx-balance|make|python)\s[^`]+)`", whole):
        line = whole.count("\n", 0, match.start()) + 1
        found.append(Snippet(line, "sh", " ".join(match[1].split()) + "\n"))
    return sorted(found)


class Parsed(Exception):
    """A script's arguments are good; what it does with them is not for here."""


def at_hand(argument: str, ours: str) -> str:
    """`ours` instead of a robot whose model may not be here, but which there must be."""
    if argument.startswith("menagerie:"):
        assert argument.partition(":")[2] in mujoco_menagerie.names(), argument
        return ours
    return ours if argument in shipped() else argument


def words(line: str) -> list[str]:
    """A command's words, without comments; a variable that the cluster sets is 0."""
    return shlex.split(re.sub(r"\$\{?[A-Z_]+\}?", "0", line), comments=True)


def run_command(argv: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Runs a command as far as it is cheap; returns what it says.

    Raises:
      AssertionError: if it would not do.
    """
    program, *rest = argv
    capsys.readouterr()
    if program in ("exec", "srun"):
        return run_command(rest, capsys)
    if program == "make":
        return run_make(rest, capsys)
    if program == "pip":
        return check_install(rest)
    if program == "python" and rest[0] == "train.py":
        program, rest = "mjx-balance", ["train", *rest[1:]]
    if program.startswith("examples/robot/build/"):
        check_program(program, rest)
    elif program == "python":
        run_script(rest)
    elif program == "mjx-balance":
        try:
            code = cli.main(stand_ins(rest))
        except SystemExit as stopped:  # tyro's own
            code = stopped.code
        said = capsys.readouterr()
        assert code in (0, None), said.err + said.out
        return said.out
    else:
        raise AssertionError(f"nobody knows how to try {program!r}")
    return capsys.readouterr().out


def stand_ins(rest: list[str]) -> list[str]:
    """A command's words, with our robot for one whose model may not be here."""
    ours = "scenes:quadruped.xml" if rest[:2] == ["robot", "new"] else "quadruped"
    return [at_hand(x, ours) for x in rest]


def run_make(rest: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What `make` would run, and that in turn."""
    assert [x for x in rest if "=" not in x], "make without a target"
    folder = REPO / rest[rest.index("-C") + 1] if "-C" in rest else REPO
    makefile = (folder / "Makefile").read_text()
    for name, value in (x.split("=", 1) for x in rest if "=" in x):
        assert f"$({name})" in makefile or f"$(if $({name})" in makefile, f"no variable {name}"
        extras = value.split(",") if name == "EXTRAS" else []
        assert set(extras) <= set(PROJECT["optional-dependencies"]), value
    # Not what a `make test ARGS=...` around this test hands on.
    outer = "MAKEFLAGS MFLAGS MAKELEVEL MAKEOVERRIDES ARGS EXTRAS PYTHON VENV".split()
    own = {name: value for name, value in os.environ.items() if name not in outer}
    command = ["make", "--dry-run", "--no-print-directory", "--directory", str(REPO), *rest]
    if folder != REPO:  # where all may be built already
        command.append("--always-make")
    made = subprocess.run(command, capture_output=True, text=True, env=own)
    assert made.returncode == 0, made.stderr
    assert "Nothing to be done" not in made.stdout, made.stdout
    for line in made.stdout.splitlines():
        if " train.py" in line:
            run_command(["python", "train.py", *words(line.partition(" train.py")[2])], capsys)
    return ""


def check_install(rest: list[str]) -> str:
    """Extras of ours that `pip install` names exist."""
    assert rest[0] == "install"
    assert not [x for x in rest if x.startswith("mjx-balance")], "our package is on no index"
    for ours in (x for x in rest if x.startswith(".[")):
        extras = ours.partition("[")[2].rstrip("]").split(",")
        assert set(extras) <= set(PROJECT["optional-dependencies"]), ours
    return ""


def check_program(program: str, rest: list[str]) -> None:
    """A program in C++ that tests/test_cpp_example.py builds and runs: its usage has the flags."""
    name = Path(program).name
    usage = (REPO / f"examples/robot/{name}.cpp").read_text().partition("USAGE[]")[2]
    usage = usage.partition(";")[0]
    for word in rest:
        assert not word.startswith("-") or re.search(rf"\[{word}\b", usage), f"{name} has no {word}"


def run_script(rest: list[str]) -> None:
    """A script of ours: up to its arguments if it parses them, else all of it."""
    script = REPO / rest[0]
    assert script.is_file(), f"no script {rest[0]}"
    parse = argparse.ArgumentParser.parse_args

    def parsed(parser: argparse.ArgumentParser, *arguments: Any) -> None:
        parse(parser, *arguments)
        raise Parsed

    elsewhere = {
        name: mock.MagicMock()
        for name in re.findall(r"^(?:from|import) ([\w.]+)", script.read_text(), re.MULTILINE)
        if name.split(".")[0] in ("torch", "stable_baselines3", "flashbax")
    }
    elsewhere |= {name.split(".")[0]: mock.MagicMock() for name in elsewhere}
    with (
        mock.patch.object(argparse.ArgumentParser, "parse_args", parsed),
        mock.patch.object(sys, "argv", rest),
        mock.patch.object(sys, "path", [str(script.parent), *sys.path]),
        mock.patch.dict(sys.modules, elsewhere),
    ):
        code: Any = None
        try:
            runpy.run_path(str(script), run_name="__main__")
        except Parsed:
            pass
        except SystemExit as stopped:
            code = stopped.code
    assert not code, f"{rest[0]}: exit code {code}"


def run_shell(text: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Runs a block's commands; returns what they say."""
    said = ""
    for line in text.replace("\\\n", " ").splitlines():
        argv = words(line)
        if argv and " ".join(argv) not in ELSEWHERE:
            said += run_command(argv, capsys)
    return said


def strings(value: Any) -> Iterator[str]:
    """All texts in a YAML document."""
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from strings(inner)
    elif isinstance(value, str):
        yield value


def run_yaml(text: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Runs the commands in a YAML document."""
    commands = [x for x in strings(yaml.safe_load(text)) if "mjx-balance" in x]
    assert commands
    return "".join(run_shell(command, capsys) for command in commands)


def check_toml(text: str) -> None:
    """A robot's file, or at least TOML."""
    if "legs" in tomllib.loads(text):
        parse_robot_file(text, Path("my_robot.toml"))


MY_SUITES = "from mjx_balance import Suite\nICE = Suite()\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder of a page's snippets: the repository's, a robot's model, a run."""
    for name in ("policies", "examples", "mjx_balance"):
        (tmp_path / name).symlink_to(REPO / name)
    shutil.copy(REPO / "scenes" / "quadruped.xml", tmp_path / "my_robot.xml")
    (tmp_path / "runs" / "NAME").mkdir(parents=True)
    best = REPO / "policies" / "best.safetensors"
    shutil.copy(best, tmp_path / "runs" / "NAME" / "policy.safetensors")
    (tmp_path / "my_suites.py").write_text(MY_SUITES)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def train_at_once(wanted: Any, run_dir: Any = None, *_: Any, **own: Any) -> Any:
    """Checks config, network and loss, tells the callbacks of a line; gives a shipped policy."""
    config.check(wanted)
    if own.get("network") or own.get("loss"):
        on_c = env.BalanceEnv(dataclasses.replace(wanted, engine="mujoco"))
        sized = dataclasses.replace(wanted, num_envs=8, num_devices=1, num_seeds=1)
        dqn = dataclasses.replace(sized.dqn, batch_size=8)
        sized = dataclasses.replace(sized, dqn=dqn)
        learner = make_learner(sized, on_c, own.get("network"), own.get("loss"))
        jax.eval_shape(learner.train_program(1), jax.eval_shape(lambda: learner.init(0)))
    line = {"env_steps": 1, "train/reward": 0.5, "eval/corner/tilt_mean": 0.1}
    listeners = Callbacks(own.get("callbacks", ()))
    listeners.on_validation(line)
    listeners.on_log(line)
    folder = RunFolder(Path(run_dir or "run"))
    folder.path.mkdir(parents=True, exist_ok=True)
    folder.metrics.write_text('{"env_steps": 1}\n')
    result = {"tilt_deg": {"mean": 0.1}, "falls": 0, "scenarios": 1}
    return Finished(load_policy("best"), {"paper": result, "corner": result}, folder)


class StubTrial:
    """A trial of Optuna's, which is not installed here; the first is to be pruned."""

    def __init__(self, number: int):
        self.number = number
        self.reports: list[tuple[float, int]] = []

    def suggest_float(self, name: str, low: float, high: float) -> float:
        return (low + high) / 2

    def report(self, value: float, step: int) -> None:
        self.reports.append((value, step))

    def should_prune(self) -> bool:
        return self.number == 0


def stub_optuna() -> types.SimpleNamespace:
    """What the page uses of Optuna."""

    class TrialPruned(Exception):
        pass

    def optimize(objective: Callable[[Any], float], n_trials: int) -> None:
        pruned, done = (StubTrial(k) for k in range(2))
        with pytest.raises(TrialPruned):
            objective(pruned)
        assert objective(done) == 0.1
        assert pruned.reports == done.reports == [(0.1, 1)]

    study = types.SimpleNamespace(optimize=optimize)
    return types.SimpleNamespace(TrialPruned=TrialPruned, create_study=lambda: study)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes commands and snippets quick, behind flags and config."""
    simulate, in_scene = evaluation.run_suite, evaluation.policy_scene

    def few(scene: Any, controller: Any, suite: str, *sizes: Any, **more: Any) -> Any:
        scenarios, duration, *others = sizes
        count, seconds = min(scenarios, 2), min(duration, 1.0)
        return simulate(scene, controller, suite, count, seconds, *others, **more)

    def scene_of(policy: Any, robot: str | None = None) -> Any:
        find_robot(robot or "quadruped")  # which the shipped policy was not trained for
        return in_scene(policy)

    def train_ppo(*arguments: Any, **keywords: Any) -> Any:
        given = trainer.bind(*arguments, **keywords).arguments
        assert given["wrap_env_fn"] is brax_training.wrap
        given["wrap_env_fn"](given["environment"], given["episode_length"])
        return None, None, {}

    trainer = inspect.signature(ppo.train)
    first = types.SimpleNamespace(process_id=0)
    shut = types.SimpleNamespace(is_open=False, close=lambda: None)
    over_c = {"engine": "mujoco"}
    # Time passes only where somebody sleeps: this machine is busy, a robot's is not.
    now = [0.0]
    monotonic = lambda: now[0]  # noqa: E731
    for owner, name, value in (
        (evaluate_command, "run_suite", few),
        (evaluation, "run_suite", few),
        (evaluation, "policy_scene", scene_of),
        (render, "write", lambda path, *_, **how: path.write_bytes(b"")),
        (render, "Window", mock.MagicMock(return_value=shut)),
        (browser, "page_folder", lambda: REPO / "demo" / "src"),
        (browser, "write_data", lambda *_: None),
        (http.server.ThreadingHTTPServer, "serve_forever", lambda server: None),
        (run, "train", train_at_once),
        (ppo, "train", train_ppo),
        (train_command, "read_run_config", lambda path: config.preset("default")),
        (processes, "find_cluster", lambda *_: first),
        (tracking, "Tracker", lambda *_: lambda metrics: None),
        (report_page, "write_report", lambda *_: []),
        # MJX compiles for half a minute; the env is the same over MuJoCo's C engine.
        # Compiled at once instead of operation by operation, which takes five times as long.
        (env.BalanceEnv, "reset", jax.jit(env.BalanceEnv.reset, static_argnums=0)),
        (env.BalanceEnv, "step", jax.jit(env.BalanceEnv.step, static_argnums=0)),
        (env, "make_engine", lambda x, scene: make_engine(dataclasses.replace(x, **over_c), scene)),
        (time, "monotonic", monotonic),
        (time, "sleep", lambda seconds: now.append(now.pop() + seconds)),
        (runtime.Controller.__init__, "__defaults__", (monotonic,)),
    ):
        monkeypatch.setattr(owner, name, value)
    monkeypatch.setitem(sys.modules, "optuna", stub_optuna())


def name_of(page: Path) -> str:
    return str(page.relative_to(REPO))


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(x, marks=pytest.mark.slow if x.parent == DOCS else (), id=name_of(x))
        for x in PAGES
    ],
)
@pytest.mark.usefixtures("folder", "short")
def test_snippets_run(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    namespace: dict[str, Any] = {"__name__": "snippet"}
    said = ""
    for snippet in snippets(page.read_text()):
        where = f"{name_of(page)}:{snippet.line}"
        kind = snippet.kind.split()[0] if snippet.kind else ""
        try:
            if kind == "python":  # its lines count as the page's in a traceback
                code = compile("\n" * (snippet.line - 1) + snippet.text, where, "exec")
                exec(code, namespace)
            elif kind == "sh":
                said = run_shell(snippet.text, capsys)
            elif kind == "yaml":
                run_yaml(snippet.text, capsys)
            elif kind == "toml":
                check_toml(snippet.text)
            elif kind == "c":  # beside the header that the command before it writes
                command = [compiler("gcc"), "-std=c99", "-fsyntax-only", "-w", "-xc", "-I.", "-"]
                subprocess.run(command, input=snippet.text, text=True, check=True)
            elif kind == "cpp":
                command = [
                    compiler("g++"),
                    "-std=c++17",
                    "-fsyntax-only",
                    "-xc++",
                    "-Iexamples/robot",
                ]
                subprocess.run([*command, "-"], input=snippet.text, text=True, check=True)
            elif kind == "diff":  # of a worked example: it applies to today's code
                check = ("git", "apply", "--check", "-C1", "-")
                subprocess.run(check, input=snippet.text, text=True, check=True, cwd=REPO)
            elif kind == "text":  # what the commands before it say
                assert snippet.text.strip() == said.strip()
            else:
                assert kind in BY_SPHINX, f"nobody knows how to try a block of {snippet.kind!r}"
        except Exception as error:
            raise AssertionError(f"{where}: {error!r}") from error


@pytest.mark.parametrize("page", ["README.md", "docs/start.md"])
def test_a_page_says_where_its_commands_are_before_it_uses_one(page: str) -> None:
    """After `make train` they are in `.venv`, and on no path."""
    text = (REPO / page).read_text()
    before, activated, _ = text.partition(ELSEWHERE[0])
    assert activated
    assert "mjx-balance " not in before
    assert "pip install" not in before


def test_every_command_is_shown() -> None:
    shown = "".join(page.read_text() for page in PAGES)
    missing = [x for x in cli.COMMANDS if f"mjx-balance {x} " not in shown]
    assert not missing, f"README.md and docs/ show no `mjx-balance {missing[0]}`"


def test_how_often_a_transition_is_drawn() -> None:
    """By every preset that the page does not name apart, and by those that it does."""
    said = re.search(
        r"is drawn some (\d+) times \(" + ", ".join([r"`(\w+)`: (\d+)"] * 3) + r"\)",
        (DOCS / "how_it_works.md").read_text(),
    )
    assert said
    usual, *others = said.groups()
    told = dict.fromkeys(config.PRESETS, int(usual))
    told |= dict(zip(others[::2], map(int, others[1::2]), strict=True))
    assert {name: own.dqn.replay_ratio for name, own in config.PRESETS.items()} == told


def test_the_configs_that_pages_name_exist() -> None:
    pages = [*PAGES, REPO / "CHANGELOG.md", REPO / "ARCHITECTURE.md"]
    named = set(re.findall(r"`(\w*Config)\b", "".join(page.read_text() for page in pages)))
    assert "RandomizationConfig" in named
    assert not [name for name in named if not hasattr(config, name)]


def test_every_key_of_a_robots_file_is_explained() -> None:
    page = (DOCS / "robots.md").read_text()
    keys = {f.name for kind in (RobotFile, LegFile) for f in dataclasses.fields(kind)}
    rows = "".join(line.split("|")[1] for line in page.splitlines() if line.startswith("|"))
    explained = set(re.findall(r"`(\w+)`", rows))
    assert keys - {"name", "folder"} <= explained
    assert set(shipped()) <= explained


API = DOCS / "api"
DOCUMENTED = sorted(
    set(re.findall(r"automodule:: (\S+)", "".join(x.read_text() for x in API.glob("*.md"))))
)
WANTED = (
    *("policy.file", "runtime", "config.schema", "robots.schema", "evaluation.rollout", "dqn.dqn"),
    *("envs.balance", "envs.brax", "envs.gym", "sim.engines.table", "api", "training.callbacks"),
)
"""Modules that the API pages must have."""


def test_the_public_modules_are_documented() -> None:
    assert {f"mjx_balance.{name}" for name in WANTED} <= set(DOCUMENTED)
    contents = (API / "index.md").read_text()
    for page in API.glob("*.md"):
        assert page.stem == "index" or f"\n{page.stem}\n" in contents
        for name in re.findall(r"auto(?:function|class):: (\S+)", page.read_text()):
            module, _, member = name.rpartition(".")
            assert hasattr(importlib.import_module(module), member), name


@pytest.mark.parametrize("name", DOCUMENTED)
def test_what_is_public_has_a_docstring(name: str) -> None:
    """Sphinx leaves out what has none, and says nothing."""
    module = importlib.import_module(name)

    def own(owner: Any, inside: str) -> Iterator[tuple[str, Any]]:
        for key, value in vars(owner).items():
            if key.startswith("_") or getattr(value, "__module__", name) != name:
                continue
            if inspect.isroutine(value) or inspect.isclass(value) or isinstance(value, property):
                yield f"{inside}{key}", value
                if inspect.isclass(value):
                    yield from own(value, f"{inside}{key}.")

    def explained(value: Any) -> bool:
        if not inspect.isclass(value):
            return bool(inspect.getdoc(value))
        # Its own: not its base's, nor what a dataclass makes of its fields.
        return bool(value.__doc__) and not value.__doc__.startswith(f"{value.__name__}(")

    bare = [key for key, value in own(module, "") if not explained(value)]
    assert not bare, f"{name} has no docstring of {', '.join(bare)}"


BROKEN: list[tuple[str, str]] = [
    ("sh", "mjx-balance train --no-such-flag 3"),
    ("sh", "mjx-balance evaluate policies/best.safetensors --suit corner"),
    ("sh", "mjx-balance dance"),
    ("sh", "make trian"),
    ("sh", 'make train ARGS="--preset huge"'),
    ("sh", "make train EXTRAS=gpu"),
    ("sh", "make train FLAGS=--help"),
    ("sh", "mjx-balance robot check menagerie:rex"),
    ("sh", "python examples/train_sb3.py --algorithm sac"),
    ("sh", "python examples/missing.py"),
    ("sh", 'pip install -e ".[everything]"'),
    ("sh", 'pip install "mjx-balance[robots]"'),
    ("sh", "srun mjx-balance train --distribute"),
    ("sh", "curl somewhere"),
    ("sh", "examples/robot/build/balance sim --quick"),
    ("sh", "make -C examples/robot ROBOT=go2"),
    ("yaml", "args: [mjx-balance train --process-idx 0]"),
    ("toml", '[legs]\nFL = "FL_hip"'),
]


@pytest.mark.parametrize(("kind", "text"), BROKEN)
@pytest.mark.usefixtures("folder", "short")
def test_broken_snippets_fail(kind: str, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    tries: dict[str, Callable[[], Any]] = {
        "sh": lambda: run_shell(text, capsys),
        "yaml": lambda: run_yaml(text, capsys),
        "toml": lambda: check_toml(text),
    }
    with pytest.raises((AssertionError, ValueError)):
        tries[kind]()


def test_snippets_are_found() -> None:
    text = "a\n```python\nx = 1\n```\nSay `mjx-balance\nrobot check x`.\n\n  ```sh\n  c\n  ```\n"
    assert snippets(text) == [
        Snippet(3, "python", "x = 1\n"),
        Snippet(5, "sh", "mjx-balance robot check x\n"),
        Snippet(9, "sh", "c\n"),
    ]
    with pytest.raises(AssertionError, match="line 2 does not end"):
        snippets("```sh\nmake train\n")
    assert sum(len(snippets(page.read_text())) for page in PAGES) > 40


@pytest.mark.parametrize(
    ("sign", "most"),
    [
        ("mjx_balance.train(", 3),
        (".replace(reward_toward", 1),
        ("ICE = Suite(", 10),
        ("nn.Module", 20),
    ],
)
def test_python_takes_few_lines(sign: str, most: int) -> None:
    """Training, a reward, a suite, a network: the first block of each, without blank lines."""
    blocks = [x.text for x in snippets((DOCS / "python.md").read_text()) if x.kind == "python"]
    lines = next(block for block in blocks if sign in block).splitlines()
    if most == 1:
        assert lines[0].endswith(".replace(reward_toward=0.5)")
    else:
        assert len([line for line in lines if line.strip()]) <= most
