"""The loop of a run around a stub program: what is logged, saved, stopped and resumed."""

import dataclasses
import io
import itertools
import json
import os
import shutil
import signal
import struct
import threading
import time
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from tensorboardX.proto.event_pb2 import Event

from mjx_balance.config import PRESETS, Config, TaskConfig
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.report.progress import Display
from mjx_balance.training import checkpoints, loop
from mjx_balance.training import run as run_module
from mjx_balance.training.loop import LEARNER_METRICS, Interrupts, Plan, learn, make_plan, measured
from mjx_balance.training.program_cache import program_key

PLAN = Plan(
    num_envs=4,
    num_seeds=1,
    iterations=5,
    total=100,
    decision_s=0.2,
    sim_steps=50,
    eval_every=0,
    checkpoint_seconds=1e9,
    metrics=LEARNER_METRICS | dict(BalanceEnv.metrics),
)
RAW = {"fall": 0.02, "tilt_deg": 0.5, "reward": 0.3, "loss": 0.25, "epsilon": 0.1}


class State(NamedTuple):
    env_steps: Any
    gradient_steps: Any
    weights: Any


def start(seeds: int | None = None) -> State:
    if seeds is None:
        return State(jnp.int32(0), jnp.int32(0), jnp.float32(0.0))
    return State(*(jnp.zeros(seeds, kind) for kind in (jnp.int32, jnp.int32, jnp.float32)))


def step(state: Any, raw: dict[str, Any] | None = None) -> Any:
    """One call: 20 decisions, 3 updates, weights that only the right history gives."""
    weights = 2 * state.weights + jnp.float32(1)
    values = {name: jnp.asarray(value) for name, value in (raw or RAW).items()}
    return State(state.env_steps + 20, state.gradient_steps + 3, weights), values


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder(tmp_path)


@pytest.fixture
def display() -> Display:
    return Display(Console(file=io.StringIO(), width=200))


@pytest.fixture
def stop() -> Iterator[Interrupts]:
    with Interrupts(lambda said: None) as interrupts:
        yield interrupts


def never(state: Any) -> dict[str, np.ndarray]:
    pytest.fail("nothing is to be validated here")


def run(
    folder: RunFolder,
    display: Display,
    stop: Interrupts,
    program: Callable[[Any], Any] = step,
    plan: Plan = PLAN,
    validate: loop.Validate = never,
) -> Any:
    """Goes on from the folder's newest checkpoint, as a run does."""
    saved = checkpoints.restore(folder.checkpoints, start(), pytest.fail)
    state: Any = saved or start()
    return learn(plan, program, state, folder, display, stop, validate)[0]


def logged(folder: RunFolder) -> list[dict[str, Any]]:
    return [json.loads(line) for line in folder.metrics.read_text().splitlines()]


def test_a_plan_rounds_the_run_up_to_whole_calls() -> None:
    config = Config(num_envs=64, num_env_steps=1_000, log_every=300, num_seeds=3, eval_every=500)
    plan = make_plan(config, {})
    assert (plan.iterations, plan.per_call, plan.total) == (4, 256, 1024)
    assert (plan.num_envs, plan.num_seeds) == (64, 3)
    assert (plan.decision_s, plan.sim_steps, plan.checkpoint_seconds) == (0.2, 50, 45)
    assert plan.eval_every == 500
    rare = make_plan(Config(num_envs=64, num_env_steps=1_024, log_every=1), {})
    assert (rare.iterations, rare.total) == (1, 1024)  # at least one decision a call
    other = make_plan(Config(num_envs=8, task=TaskConfig(ctrl_dt=0.1, sim_dt=0.002)), {})
    assert (other.decision_s, other.sim_steps) == (0.1, 50)


def test_every_call_is_logged_and_the_end_is_saved(
    folder: RunFolder, display: Display, stop: Interrupts
) -> None:
    def program(state: Any) -> Any:
        """Whoever watches the file sees every line at once."""
        assert len(logged(folder)) == int(state.env_steps) // 20
        return step(state)

    zero: Any = start()
    state, seconds = learn(PLAN, program, zero, folder, display, stop, never)
    assert float(state.weights) == 31  # ((((0*2+1)*2+1)*2+1)*2+1)*2+1
    assert [line["env_steps"] for line in logged(folder)] == [20, 40, 60, 80, 100]
    assert [line["gradient_steps"] for line in logged(folder)] == [3, 6, 9, 12, 15]
    assert checkpoints.saved_steps(folder.checkpoints) == [100]
    assert 0 < seconds < 10
    assert "100/100 decisions" in display.console.file.getvalue()  # pyright: ignore
    drawn = {
        value.tag: value.simple_value
        for event in events(folder)
        for value in event.summary.value
        if event.step == 100
    }
    last = {name: value for name, value in logged(folder)[-1].items() if "/" in name}
    assert len(last) == 7
    assert "seeds" not in logged(folder)[-1], "there is one"
    assert drawn == pytest.approx(last, rel=1e-6)


def test_checkpoints_are_at_most_a_minute_old() -> None:
    assert all(config.checkpoint_seconds <= 50 for config in PRESETS.values())


def test_names_and_units_of_what_is_logged() -> None:
    metrics, _ = measured({k: np.asarray(v, np.float32) for k, v in RAW.items()}, 0.5, PLAN)
    assert metrics == pytest.approx(
        {
            # 0.02 falls per decision of 0.2 s are 0.1 per second.
            "train/falls_per_minute": 6.0,
            "train/tilt_deg": 0.5,
            "train/reward": 0.3,
            "train/loss": 0.25,
            "train/epsilon": 0.1,
            # 20 decisions of 50 physics steps in half a second.
            "perf/env_steps_per_second": 40.0,
            "perf/physics_steps_per_second": 2000.0,
        },
        rel=1e-6,
    )


def test_several_seeds_are_averaged_and_listed() -> None:
    raw = {k: np.asarray([v, 3 * v], np.float32) for k, v in RAW.items()}
    metrics, seeds = measured(raw, 0.5, PLAN._replace(num_seeds=2))
    assert metrics["train/tilt_deg"] == pytest.approx(1.0)
    assert metrics["perf/env_steps_per_second"] == pytest.approx(80)
    assert set(seeds) == {"tilt_deg", "falls_per_minute", "reward", "loss"}
    assert seeds["falls_per_minute"] == pytest.approx([6.0, 18.0], rel=1e-6)


def test_what_was_not_measured_is_left_out() -> None:
    """Before the first update there is no loss; one seed may have none, and be said so."""
    metrics, _ = measured({**RAW, "loss": np.float32(np.nan)}, 0.5, PLAN)  # pyright: ignore
    assert "train/loss" not in metrics
    assert "train/tilt_deg" in metrics
    raw = {k: np.asarray([v, 3 * v]) for k, v in RAW.items()}
    raw["loss"] = np.asarray([np.nan, 4.0])
    raw["reward"] = np.asarray([np.nan, np.inf])
    metrics, seeds = measured(raw, 0.5, PLAN._replace(num_seeds=2))
    assert metrics["train/loss"] == 4
    assert seeds["loss"] == [None, 4.0]
    assert "train/reward" not in metrics
    assert "reward" not in seeds
    json.dumps([metrics, seeds], allow_nan=False)


def test_diverged_envs_are_counted(folder: RunFolder, display: Display, stop: Interrupts) -> None:
    """A share of 0.1 of 20 decisions is 2 envs; the watcher is told, once there are any."""
    run(folder, display, stop, lambda state: step(state, RAW | {"diverged": 0.1}))
    assert logged(folder)[0]["train/diverged"] == pytest.approx(2)
    said = display.console.file.getvalue()  # pyright: ignore
    assert "diverged envs 2" in said
    metrics, _ = measured({**RAW, "diverged": np.float32(0)}, 0.5, PLAN)  # pyright: ignore
    assert metrics["train/diverged"] == 0


@pytest.mark.parametrize(
    ("every", "steps"),
    [(2.5, [60, 100]), (2.0, [80, 100]), (1e-9, [80, 100]), (1e9, [100])],
)
def test_checkpoints_come_by_the_clock(
    every: float,
    steps: list[int],
    folder: RunFolder,
    display: Display,
    stop: Interrupts,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every call takes a second: saved after each 2.5 s means after the third, the sixth, ..."""
    now = [0.0]
    clock = types.SimpleNamespace(monotonic=lambda: now[0], perf_counter=lambda: 10 * now[0])
    monkeypatch.setattr(loop, "time", clock)
    saved: list[int] = []
    save = checkpoints.save

    def remember(directory: Path, done: int, *state: Any) -> None:
        saved.append(done)
        save(directory, done, *state)

    monkeypatch.setattr(checkpoints, "save", remember)

    def second(state: Any) -> Any:
        now[0] += 1
        return step(state)

    zero: Any = start()
    plan = PLAN._replace(checkpoint_seconds=every)
    learnt = learn(plan, second, zero, folder, display, stop, never)
    assert learnt[1] == pytest.approx(50)
    assert logged(folder)[3]["perf/env_steps_per_second"] == pytest.approx(2)
    assert checkpoints.saved_steps(folder.checkpoints) == steps
    if every == 2.0:
        assert saved == [40, 80, 100]


class Killed(BaseException):
    pass


def killed_after(calls: int) -> Callable[[Any], Any]:
    count = itertools.count()

    def program(state: Any) -> Any:
        if next(count) == calls:
            raise Killed
        return step(state)

    return program


@pytest.mark.parametrize("calls", [0, 1, 3])
@pytest.mark.parametrize("every", [1e9, 1e-9])
def test_a_killed_run_goes_on_to_the_same_end(
    calls: int, every: float, folder: RunFolder, display: Display, stop: Interrupts
) -> None:
    """Before the first checkpoint (every 1e9 s) and after one (after every call)."""
    plan = PLAN._replace(checkpoint_seconds=every)
    with pytest.raises(Killed):
        run(folder, display, stop, killed_after(calls), plan)
    assert len(logged(folder)) == calls
    with folder.metrics.open("a") as log:
        log.write('{"env_st')  # torn
    seen: list[int] = []

    def watched(state: Any) -> Any:
        seen.append(int(state.env_steps))
        return step(state)

    state = run(folder, display, stop, watched, plan)
    assert float(state.weights) == 31
    assert seen[0] == (20 * calls if every < 1 else 0)
    assert [line["env_steps"] for line in logged(folder)] == [20, 40, 60, 80, 100]
    assert_curves_run_once(folder)


def events(folder: RunFolder) -> Iterator[Event]:
    """What TensorBoard reads, from the record format: length, sum, event, sum."""
    for file in sorted(folder.tensorboard.iterdir(), key=lambda file: file.stat().st_mtime_ns):
        content = file.read_bytes()
        while content:
            (length,) = struct.unpack("<Q", content[:8])
            yield Event.FromString(content[12 : 12 + length])
            content = content[16 + length :]


def assert_curves_run_once(folder: RunFolder) -> None:
    """A restarted session drops what was logged from its first step on (TensorBoard's rule)."""
    curve: list[int] = []
    for event in events(folder):
        if event.HasField("session_log"):
            curve = [step for step in curve if step < event.step]
        if any(value.tag == "train/tilt_deg" for value in event.summary.value):
            curve.append(event.step)
    assert curve == [20, 40, 60, 80, 100]


def test_a_complete_run_is_only_passed_through(
    folder: RunFolder, display: Display, stop: Interrupts
) -> None:
    run(folder, display, stop)
    before = folder.metrics.read_text()
    assert float(run(folder, display, stop, killed_after(0)).weights) == 31
    assert folder.metrics.read_text() == before


def test_an_interrupt_stops_after_the_call_and_saves(folder: RunFolder, display: Display) -> None:
    def program(state: Any) -> Any:
        if int(state.env_steps) == 20:
            os.kill(os.getpid(), signal.SIGINT)
        return step(state)

    with Interrupts(display.say) as stop:
        state = run(folder, display, stop, program)
        assert stop
    assert int(state.env_steps) == 40
    assert checkpoints.saved_steps(folder.checkpoints) == [40]
    assert float(run(folder, display, Interrupts(display.say)).weights) == 31


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_is_answered_while_the_call_goes_on(number: int) -> None:
    said: list[str] = []
    answered = threading.Event()

    def say(line: str) -> None:
        said.append(line)
        answered.set()

    def call(argument: int) -> int:
        os.kill(os.getpid(), number)
        assert answered.wait(10)
        time.sleep(2.5 * loop.ANSWER_S)  # and not said again
        return argument + 1

    def handler(number: int, frame: object) -> None:
        pytest.fail("not this one")

    before = signal.signal(number, handler)
    with Interrupts(say) as stop:
        assert not stop
        assert stop.run(call, 1) == 2
        assert stop
    assert signal.signal(number, before) is handler
    assert len(said) == 1
    assert said[0].startswith("stopping after this call and saving; interrupt again to quit")


def test_a_second_interrupt_does_not_wait_for_the_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does the end of the process, where Python would wait for the program or abort."""
    left: list[Any] = []
    monkeypatch.setattr(loop.atexit, "register", lambda *call: left.append(call))
    monkeypatch.setattr(os, "_exit", lambda code: left.append(code))
    goes_on = threading.Event()

    def call() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.3)
        os.kill(os.getpid(), signal.SIGINT)
        goes_on.wait(20)

    began = time.monotonic()
    with Interrupts(lambda said: None) as stop, pytest.raises(KeyboardInterrupt):
        stop.run(call)
    assert time.monotonic() - began < 5
    [(leave, future)] = left
    leave(future)
    assert left[1:] == [130]
    goes_on.set()
    future.result(5)
    leave(future)
    assert len(left) == 2  # nothing runs any more: an ordinary end


@pytest.mark.parametrize("error", [ValueError("no"), TimeoutError("late"), Killed()])
def test_what_a_call_raises_is_raised(error: BaseException, stop: Interrupts) -> None:
    def call() -> None:
        raise error

    with pytest.raises(type(error)) as raised:
        stop.run(call)
    assert raised.value is error


def test_seeds_count_their_decisions_together(
    folder: RunFolder, display: Display, stop: Interrupts
) -> None:
    raw = {k: [v, v] for k, v in RAW.items()}
    plan = PLAN._replace(num_seeds=2)
    two: Any = start(2)
    state: Any
    state, _ = learn(plan, lambda state: step(state, raw), two, folder, display, stop, never)
    np.testing.assert_array_equal(jax.device_get(state.weights), (31, 31))
    lines = logged(folder)
    assert [line["env_steps"] for line in lines] == [20, 40, 60, 80, 100]
    assert lines[0]["seeds"]["loss"] == [0.25, 0.25]


def validating(folder: RunFolder, die: str = "", at: int = 0) -> loop.Validate:
    """Validates the stub's weights: keeps them in a file, and finds a tilt of 1 / weights.

    Args:
      folder: of the run.
      die: where it dies, "before" or "after" the file is written.
      at: after so many decisions.
    """

    def validate(state: Any) -> dict[str, np.ndarray]:
        done = int(state.env_steps)
        if (die, at) == ("before", done):
            raise Killed
        file = folder.validated_policy(0, done)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{state.weights}")
        if (die, at) == ("after", done):
            raise Killed
        return {"eval/paper/tilt_mean": 1 / np.atleast_1d(state.weights)}

    return validate


def kept(folder: RunFolder) -> dict[int, str]:
    """What was kept of the validations, by decisions."""
    return {int(file.parent.name): file.read_text() for file in folder.validated.glob("*/*")}


def held_out(folder: RunFolder) -> dict[int, float]:
    return {
        line["env_steps"]: line["eval/paper/tilt_mean"]
        for line in logged(folder)
        if "eval/paper/tilt_mean" in line
    }


@pytest.mark.parametrize(
    ("every", "steps"),
    [(0, []), (1, [20, 40, 60, 80, 100]), (50, [60, 100]), (45, [60, 100]), (70, [80, 100])],
)
def test_validations_come_by_the_decisions_and_at_the_end(
    every: int, steps: list[int], folder: RunFolder, display: Display, stop: Interrupts
) -> None:
    """A call is 20 decisions: after the first that reaches 50 there are 60. The end is one more."""
    plan = PLAN._replace(eval_every=every)
    state = run(folder, display, stop, plan=plan, validate=validating(folder))
    assert float(state.weights) == 31
    assert [line["env_steps"] for line in logged(folder)] == [20, 40, 60, 80, 100]
    weights = {20: 1, 40: 3, 60: 7, 80: 15, 100: 31}
    assert held_out(folder) == {n: pytest.approx(1 / weights[n]) for n in steps}
    drawn = {
        event.step: value.simple_value
        for event in events(folder)
        for value in event.summary.value
        if value.tag == "eval/paper/tilt_mean"
    }
    assert drawn == pytest.approx(held_out(folder), rel=1e-6)


def test_validations_take_no_time_from_the_decisions(
    folder: RunFolder, display: Display, stop: Interrupts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A call takes 2 s and a validation half a second: 10 decisions/s, and shares of the time."""
    now = [0.0]
    clock = types.SimpleNamespace(monotonic=lambda: now[0], perf_counter=lambda: now[0])
    monkeypatch.setattr(loop, "time", clock)

    def program(state: Any) -> Any:
        now[0] += 2
        return step(state)

    def validate(state: Any) -> dict[str, np.ndarray]:
        now[0] += 0.5
        return {"eval/paper/falls": np.asarray([3.0])}

    zero: Any = start()
    plan = PLAN._replace(eval_every=40)
    assert learn(plan, program, zero, folder, display, stop, validate)[1] == pytest.approx(10)
    lines = logged(folder)
    assert [line["perf/env_steps_per_second"] for line in lines] == pytest.approx([10] * 5)
    shares = {x["env_steps"]: x.get("perf/validation_share") for x in lines}
    assert shares.pop(20) is shares.pop(60) is None
    # 0.5 of 4.5 s, 1 of 9 s, 1.5 of 11.5 s
    assert shares == pytest.approx({40: 1 / 9, 80: 1 / 9, 100: 3 / 23})
    assert lines[1]["eval/paper/falls"] == 3


def test_validations_of_several_seeds_are_averaged_and_listed(
    folder: RunFolder, display: Display, stop: Interrupts
) -> None:
    """A seed that has diverged has no value; the others have."""
    raw = {k: [v, v, v] for k, v in RAW.items()}
    plan = PLAN._replace(num_seeds=3, eval_every=100)
    three: Any = start(3)
    found = {"eval/corner/falls": np.asarray([4, np.nan, 1]), "eval/x": np.full(3, np.nan)}
    learn(plan, lambda s: step(s, raw), three, folder, display, stop, lambda state: found)
    lines = logged(folder)
    assert lines[-1]["eval/corner/falls"] == 2.5
    assert lines[-1]["seeds"]["eval/corner/falls"] == [4, None, 1]
    assert "eval/x" not in lines[-1]
    assert "eval/x" not in lines[-1]["seeds"]
    assert "eval/corner/falls" not in lines[0]["seeds"]
    assert lines[-1]["seeds"]["loss"] == [0.25, 0.25, 0.25]


@pytest.mark.parametrize("every", [1e9, 1e-9])
@pytest.mark.parametrize(
    ("calls", "die", "at"),
    [(9, "before", 60), (9, "after", 60), (3, "", 0), (4, "", 0), (9, "after", 100)],
)
def test_a_run_killed_about_a_validation_validates_as_an_undisturbed_one(
    calls: int,
    die: str,
    at: int,
    every: float,
    folder: RunFolder,
    display: Display,
    stop: Interrupts,
) -> None:
    """In it, before or after it keeps its policy, or in a later call, with and without checkpoint.

    What it kept of a history that is lost is gone, whatever the decisions it belonged to.
    """
    plan = PLAN._replace(checkpoint_seconds=every, eval_every=30)
    with pytest.raises(Killed):
        run(folder, display, stop, killed_after(calls), plan, validating(folder, die, at))
    stray = folder.validated_policy(0, 110)
    stray.parent.mkdir(parents=True, exist_ok=True)
    stray.write_text("of another history")
    seen: list[dict[int, str]] = []

    def watched(state: Any) -> Any:
        seen.append(kept(folder))
        return step(state)

    state = run(folder, display, stop, watched, plan, validating(folder))
    assert float(state.weights) == 31
    assert kept(folder) == {40: "3.0", 60: "7.0", 100: "31.0"}
    assert held_out(folder) == pytest.approx({40: 1 / 3, 60: 1 / 7, 100: 1 / 31})
    assert [line["env_steps"] for line in logged(folder)] == [20, 40, 60, 80, 100]
    saved = (min(calls, at // 20 - 1 if at else 9) * 20) if every < 1 else 0
    assert sorted(seen[0]) == [n for n in (40, 60, 100) if n <= saved]


def test_an_interrupt_during_a_validation_is_answered_and_the_line_is_whole(
    folder: RunFolder,
) -> None:
    answered = threading.Event()
    display = Display(Console(file=io.StringIO(), width=200))
    said: list[str] = []

    def say(line: str) -> None:
        said.append(line)
        answered.set()

    def validate(state: Any) -> Mapping[str, np.ndarray]:
        if int(state.env_steps) == 40:
            os.kill(os.getpid(), signal.SIGINT)
            assert answered.wait(10)
        return validating(folder)(state)

    plan = PLAN._replace(eval_every=40)
    with Interrupts(say) as stop:
        run(folder, display, stop, step, plan, validate)
    assert len(said) == 1
    assert said[0].startswith("stopping after this call and saving")
    assert held_out(folder) == {40: pytest.approx(1 / 3)}
    assert checkpoints.saved_steps(folder.checkpoints) == [40]
    run(folder, display, Interrupts(say), step, plan, validating(folder))
    assert list(held_out(folder)) == [40, 80, 100]


def test_a_second_interrupt_does_not_wait_for_the_validation(
    folder: RunFolder, display: Display, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it would have said is not logged, nor is its call saved: both come again."""
    monkeypatch.setattr(loop.atexit, "register", lambda *call: None)
    goes_on = threading.Event()

    def validate(state: Any) -> dict[str, np.ndarray]:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.3)
        os.kill(os.getpid(), signal.SIGINT)
        goes_on.wait(20)
        return {}

    plan = PLAN._replace(eval_every=40)
    with Interrupts(lambda said: None) as stop, pytest.raises(KeyboardInterrupt):
        run(folder, display, stop, step, plan, validate)
    goes_on.set()
    assert [line["env_steps"] for line in logged(folder)] == [20]
    assert checkpoints.saved_steps(folder.checkpoints) == []


class Learner:
    """Of runs of 64 envs, 16 decisions a call; its state says where it began."""

    def __init__(self) -> None:
        self.seeds: list[int] = []

    def init(self, seed: int) -> State:
        self.seeds.append(seed)
        return start()

    def train_program(self, iterations: int) -> Callable[[Any], Any]:
        assert iterations == 16

        def program(state: State) -> Any:
            after, raw = step(state)
            return after._replace(env_steps=state.env_steps + 64 * iterations), raw

        return program


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Keys of the programs that were compiled."""
    keys: list[str] = []

    def compile_program(program: Any, state: Any, key: str, say: Any) -> Any:
        keys.append(key)
        return program

    monkeypatch.setattr(run_module.program_cache, "compile_program", compile_program)
    return keys


def test_a_run_begins_at_its_newest_checkpoint(
    folder: RunFolder, display: Display, stop: Interrupts, compiled: list[str]
) -> None:
    sized = dataclasses.replace(PRESETS["smoke"], num_env_steps=4_096, num_devices=1, seed=5)
    learner: Any = Learner()
    env: Any = None

    def go_on() -> Any:
        plan = make_plan(sized, BalanceEnv.metrics)
        setup = run_module.Setup(sized, env, learner)
        state, program = run_module.prepare(setup, plan, folder, display, stop)
        return learn(plan, program, state, folder, display, stop, lambda state: {})[0]

    third = State(jnp.int32(3_072), jnp.int32(9), jnp.float32(100))
    checkpoints.save(folder.checkpoints, 1_024, start())
    checkpoints.save(folder.checkpoints, 3_072, third)
    assert float(go_on().weights) == 201  # one call from the newest, 2 * 100 + 1
    assert learner.seeds == [5]
    assert compiled == [program_key(sized, 16, "mjx_balance.training.sizing")]
    assert "resuming at 3,072 decisions" in display.console.file.getvalue()  # pyright: ignore
    assert float(go_on().weights) == 201
    assert len(compiled) == 1, "a complete run needs no program"
    shutil.rmtree(folder.checkpoints)
    assert float(go_on().weights) == 15  # four calls from nothing
