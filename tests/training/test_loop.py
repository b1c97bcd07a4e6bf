"""The loop of a run around a stub program: what is logged, saved, stopped and resumed."""

import dataclasses
import itertools
import json
import os
import shutil
import signal
import struct
import threading
import time
import types
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.config import PRESETS, Config, ConfigError
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.files.run_folder import RunFolder, RunFolderError
from mjx_balance.training import checkpoints, loop
from mjx_balance.training import run as run_module
from mjx_balance.training.callbacks import Callback, Callbacks
from mjx_balance.training.loop import STOPPING, Interrupts, Run, learn, measured
from mjx_balance.training.program_cache import program_key

RAW = {"fall": 0.02, "tilt_deg": 0.5, "reward": 0.3, "loss": 0.25, "epsilon": 0.1}
CONFIG = Config(num_envs=4, num_env_steps=100, log_every=20, eval_every=0, checkpoint_seconds=1e9)
"""Five calls of 20 decisions."""
CALLS = [20, 40, 60, 80, 100]
WEIGHTS = dict(zip(CALLS, (1, 3, 7, 15, 31), strict=True))
"""Decisions -> weights of the stub."""
NOWHERE: Any = None


def run_of(config: Config = CONFIG, **changes: Any) -> Run:
    config = dataclasses.replace(config, **changes)
    spec: Any = types.SimpleNamespace(spec=types.SimpleNamespace(num_envs=config.num_envs))
    env: Any = BalanceEnv
    return Run(config, env, spec, NOWHERE, NOWHERE)


class State(NamedTuple):
    env_steps: Any
    gradient_steps: Any
    weights: Any


def start(seeds: int = 1) -> Any:
    shape = () if seeds == 1 else (seeds,)
    return State(*(jnp.zeros(shape, kind) for kind in (jnp.int32, jnp.int32, jnp.float32)))


def step(state: Any, raw: dict[str, Any] | None = None) -> Any:
    """One call: 20 decisions, 3 updates, weights that only the right history gives."""
    weights = 2 * state.weights + jnp.float32(1)
    values = {name: jnp.asarray(value) for name, value in (raw or RAW).items()}
    return State(state.env_steps + 20, state.gradient_steps + 3, weights), values


def never(state: Any) -> dict[str, np.ndarray]:
    pytest.fail("nothing is to be validated here")


@pytest.fixture
def go(folder: RunFolder, display: Any) -> Callable[..., tuple[State, float]]:
    """Program, validation, changes of the config -> state and seconds of a run.

    It goes on from the folder's newest checkpoint.
    """

    def go(
        program: Any = step,
        validate: loop.Validate = never,
        callbacks: Iterable[Any] = (),
        **changes: Any,
    ) -> tuple[Any, float]:
        listeners = Callbacks(callbacks)
        run = dataclasses.replace(
            run_of(**changes), folder=folder, display=display, callbacks=listeners
        )
        zero = start(run.num_seeds)
        state = checkpoints.restore(folder.checkpoints, zero, pytest.fail) or zero
        with Interrupts(display.say) as stop:
            return learn(run, program, state, stop, validate)

    return go


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time that the loop reads, s; the counter is ten times as fast."""
    now = [0.0]
    time = types.SimpleNamespace(monotonic=lambda: now[0], perf_counter=lambda: 10 * now[0])
    monkeypatch.setattr(loop, "time", time)
    return now


def logged(folder: RunFolder) -> list[dict[str, Any]]:
    return [json.loads(line) for line in folder.metrics.read_text().splitlines()]


def events(folder: RunFolder) -> Iterator[Any]:
    """TensorBoard's events, from the record format: length, sum, event, sum."""
    from tensorboardX.proto.event_pb2 import Event

    for file in sorted(folder.tensorboard.iterdir(), key=lambda file: file.stat().st_mtime_ns):
        content = file.read_bytes()
        while content:
            (length,) = struct.unpack("<Q", content[:8])
            yield Event.FromString(content[12 : 12 + length])
            content = content[16 + length :]


def drawn(folder: RunFolder, tag: str) -> dict[int, float]:
    """A curve of TensorBoard; a restarted session drops its steps from the first of its own on."""
    curve: dict[int, float] = {}
    for event in events(folder):
        if event.HasField("session_log"):
            curve = {step: value for step, value in curve.items() if step < event.step}
        for value in event.summary.value:
            if value.tag == tag:
                assert event.step not in curve
                curve[event.step] = value.simple_value
    return curve


def test_a_run_is_rounded_up_to_whole_calls() -> None:
    run = run_of(Config(num_envs=64, num_env_steps=1_000, log_every=300, num_seeds=3))
    assert (run.iterations, run.per_call, run.total, run.num_seeds) == (4, 256, 1024, 3)
    rare = run_of(Config(num_envs=64, num_env_steps=1_024, log_every=1))
    assert (rare.iterations, rare.total) == (1, 1024)  # at least one decision a call


def test_every_call_is_logged_and_the_end_is_saved(
    folder: RunFolder, display: Any, go: Any
) -> None:
    def program(state: Any) -> Any:
        """Whoever watches the file sees every line at once."""
        assert len(logged(folder)) == int(state.env_steps) // 20
        assert list(drawn(folder, "train/loss")) == CALLS[: len(logged(folder))]
        return step(state, RAW | {"diverged": 0.1})

    state, seconds = go(program)
    assert float(state.weights) == 31  # ((((0*2+1)*2+1)*2+1)*2+1)*2+1
    assert [line["env_steps"] for line in logged(folder)] == CALLS
    assert [line["gradient_steps"] for line in logged(folder)] == [3, 6, 9, 12, 15]
    assert checkpoints.saved_steps(folder.checkpoints) == [100]
    assert 0 < seconds < 10
    assert any("100/100 decisions" in line for line in display.lines)
    assert any("diverged envs 2" in line for line in display.lines)
    last = {name: value for name, value in logged(folder)[-1].items() if "/" in name}
    assert len(last) == 8
    assert "seeds" not in logged(folder)[-1], "there is one"
    for name, value in last.items():
        assert drawn(folder, name)[100] == pytest.approx(value, rel=1e-6)


def test_a_run_says_which_seeds_it_trains(folder: RunFolder, display: Any) -> None:
    folder.config.write_text("{}")
    for count, seeds in ((1, "seed 5"), (3, "seeds 5 to 7")):
        run = dataclasses.replace(run_of(seed=5, num_seeds=count), folder=folder, display=display)
        run_module._announce(run)
        assert f"{folder.path}: preset paper, {seeds}, 4 envs on" in display.lines[-1]
    folder.config.unlink()
    with pytest.raises(RunFolderError, match=r"process 0 does not see .*; choose a folder that"):
        run_module._announce(run)


def test_runs_that_begin_in_one_second_get_folders_of_their_own(
    tmp_path: Path, display: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "strftime", lambda pattern: "20300101-000000")
    config, today = dataclasses.replace(PRESETS["smoke"], seed=4), {"versions": {}}
    names = [run_module._open_folder(config, today, None, None, display).name for _ in range(3)]
    first = "smoke-seed4-20300101-000000"
    assert names == [first, f"{first}-2", f"{first}-3"]
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == names
    with pytest.raises(RunFolderError, match="exists; choose another with --run-dir"):
        run_module._open_folder(config, today, Path("runs") / first, None, display)


def test_checkpoints_are_at_most_a_minute_old() -> None:
    assert all(config.checkpoint_seconds <= 50 for config in PRESETS.values())


def test_names_and_units_of_what_is_logged() -> None:
    raw = {k: np.asarray(v, np.float32) for k, v in {**RAW, "diverged": 0.1}.items()}
    wanted = {
        # 0.02 falls per decision of 0.2 s are 0.1 per second.
        "train/falls_per_minute": 6.0,
        "train/tilt_deg": 0.5,
        "train/reward": 0.3,
        "train/loss": 0.25,
        "train/epsilon": 0.1,
        # A share of 0.1 of 20 decisions.
        "train/diverged": 2.0,
        # 20 decisions of 50 physics steps in half a second.
        "perf/env_steps_per_second": 40.0,
        "perf/physics_steps_per_second": 2000.0,
    }
    assert measured(run_of(), raw, 0.5)[0] == pytest.approx(wanted, rel=1e-6)
    task = dataclasses.replace(CONFIG.task, ctrl_dt=0.1)
    wanted |= {"train/falls_per_minute": 12.0, "perf/physics_steps_per_second": 1000.0}
    assert measured(run_of(task=task), raw, 0.5)[0] == pytest.approx(wanted, rel=1e-6)


def test_several_seeds_are_averaged_and_listed() -> None:
    """Before the first update there is no loss; one seed may have none, and be listed so."""
    raw = {k: np.asarray([v, 3 * v]) for k, v in RAW.items()}
    raw |= {"loss": np.asarray([np.nan, 4.0]), "reward": np.asarray([np.nan, np.inf])}
    metrics, seeds = measured(run_of(num_seeds=2), raw, 0.5)
    assert metrics["train/tilt_deg"] == pytest.approx(1.0)
    assert metrics["perf/env_steps_per_second"] == pytest.approx(80)
    assert metrics["train/loss"] == 4
    assert "train/reward" not in metrics
    assert seeds.pop("falls_per_minute") == pytest.approx([6.0, 18.0])
    assert seeds == {"tilt_deg": [0.5, 1.5], "loss": [None, 4.0]}


@pytest.mark.parametrize(
    ("every", "steps"), [(2.5, [60, 100]), (2.0, [40, 80, 100]), (1e-9, CALLS), (1e9, [100])]
)
def test_checkpoints_come_by_the_clock(
    every: float,
    steps: list[int],
    folder: RunFolder,
    go: Any,
    clock: list[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every call takes a second: saved after each 2.5 s means after the third, the sixth, ..."""
    saved, save = [], checkpoints.save

    def remember(directory: Any, done: int, *state: Any) -> None:
        saved.append(done)
        save(directory, done, *state)

    monkeypatch.setattr(checkpoints, "save", remember)

    def second(state: Any) -> Any:
        clock[0] += 1
        return step(state)

    assert go(second, checkpoint_seconds=every)[1] == pytest.approx(50)
    assert logged(folder)[3]["perf/env_steps_per_second"] == pytest.approx(2)
    assert list(dict.fromkeys(saved)) == steps
    assert checkpoints.saved_steps(folder.checkpoints) == steps[-2:]


class Killed(BaseException):
    pass


def killed_after(calls: int) -> Callable[[Any], Any]:
    count = itertools.count()

    def program(state: Any) -> Any:
        if next(count) == calls:
            raise Killed
        return step(state)

    return program


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_is_answered_while_the_call_goes_on(number: int, display: Any) -> None:
    def call(argument: int) -> int:
        os.kill(os.getpid(), number)
        wait_for_answer(display)
        time.sleep(2.5 * loop.ANSWER_S)  # and not answered again
        return argument + 1

    def handler(number: int, frame: object) -> None:
        pytest.fail("not this one")

    before = signal.signal(number, handler)
    with Interrupts(display.say) as stop:
        assert not stop
        assert stop.run(call, 1) == 2
        assert stop
    assert signal.signal(number, before) is handler
    assert display.lines == [STOPPING]
    assert STOPPING.startswith("stopping after this call and saving; interrupt again to quit")


@pytest.mark.parametrize(
    "numbers",
    [
        (signal.SIGTERM, signal.SIGTERM),  # to the process and to its group
        (signal.SIGHUP, signal.SIGTERM, signal.SIGTERM),
        (signal.SIGINT, signal.SIGHUP),
    ],
)
def test_signals_at_once_are_one_interrupt(
    numbers: tuple[int, ...], folder: RunFolder, display: Any, go: Any
) -> None:
    def program(state: Any) -> Any:
        for number in numbers:
            os.kill(os.getpid(), number)
        wait_for_answer(display)
        return step(state)

    assert int(go(program)[0].env_steps) == 20
    assert display.lines == [STOPPING]
    assert checkpoints.saved_steps(folder.checkpoints) == [20]


def test_a_hangup_that_the_user_ignores_stays_ignored(display: Any) -> None:
    """As under `nohup`."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupts(display.say) as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert stop.run(lambda: 3) == 3
            assert not stop
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_thread_of_an_app_can_train() -> None:
    """Signals are the main thread's; work goes on, and errors come through."""
    outcomes: list[Any] = []

    def work() -> None:
        try:
            with Interrupts(pytest.fail) as stop:
                outcomes.append(stop.run(lambda: 7))
                outcomes.append(bool(stop))
                stop.run(lambda: 1 / 0)
        except Exception as error:
            outcomes.append(type(error))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert outcomes == [7, False, ZeroDivisionError]


def wait_for_answer(display: Any) -> None:
    until = time.monotonic() + 10
    while STOPPING not in display.lines:
        assert time.monotonic() < until
        time.sleep(0.01)


@pytest.mark.parametrize("error", [ValueError("no"), TimeoutError("late"), Killed()])
def test_what_a_call_raises_is_raised(error: BaseException) -> None:
    def call() -> None:
        raise error

    with Interrupts(pytest.fail) as stop, pytest.raises(type(error)) as raised:
        stop.run(call)
    assert raised.value is error


def validating(folder: RunFolder, die: str = "", at: int = 0) -> loop.Validate:
    """Validates the stub's weights: writes them into a file, and returns a tilt of 1 / weights.

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


def validated(folder: RunFolder) -> dict[int, str]:
    """Weights of the validated policies, by decisions."""
    return {int(file.parent.name): file.read_text() for file in folder.validated.glob("*/*")}


def held_out(folder: RunFolder) -> dict[int, float]:
    name = "eval/paper/tilt_mean"
    return {line["env_steps"]: line[name] for line in logged(folder) if name in line}


@pytest.mark.parametrize(
    ("every", "steps"), [(0, []), (1, CALLS), (50, [60, 100]), (45, [60, 100]), (70, [80, 100])]
)
def test_validations_come_by_the_decisions_and_at_the_end(
    every: int, steps: list[int], folder: RunFolder, go: Any
) -> None:
    """A call is 20 decisions: after the first that reaches 50 there are 60. The end is one more."""
    state, _ = go(validate=validating(folder), eval_every=every)
    assert float(state.weights) == 31
    assert [line["env_steps"] for line in logged(folder)] == CALLS
    assert held_out(folder) == {n: pytest.approx(1 / WEIGHTS[n]) for n in steps}
    assert drawn(folder, "eval/paper/tilt_mean") == pytest.approx(held_out(folder), rel=1e-6)


def test_validations_take_no_time_from_the_decisions(
    folder: RunFolder, go: Any, clock: list[float]
) -> None:
    """A call takes 2 s and a validation half a second: 10 decisions/s, and shares of the time."""

    def program(state: Any) -> Any:
        clock[0] += 0.2
        return step(state)

    def validate(state: Any) -> dict[str, np.ndarray]:
        clock[0] += 0.05
        return {"eval/paper/falls": np.asarray([3.0])}

    assert go(program, validate, eval_every=40)[1] == pytest.approx(10)
    lines = logged(folder)
    assert [line["perf/env_steps_per_second"] for line in lines] == pytest.approx([10] * 5)
    shares = {x["env_steps"]: x.get("perf/validation_share") for x in lines}
    assert shares.pop(20) is shares.pop(60) is None
    # 0.5 of 4.5 s, 1 of 9 s, 1.5 of 11.5 s
    assert shares == pytest.approx({40: 1 / 9, 80: 1 / 9, 100: 3 / 23})
    assert lines[1]["eval/paper/falls"] == 3


def test_several_seeds_count_their_decisions_and_validate_together(
    folder: RunFolder, go: Any
) -> None:
    """A seed that has diverged has no value; the others have."""
    raw = {k: [v, v, v] for k, v in RAW.items()}
    values = {"eval/corner/falls": np.asarray([4, np.nan, 1]), "eval/x": np.full(3, np.nan)}
    state, _ = go(lambda s: step(s, raw), lambda state: values, num_seeds=3, eval_every=100)
    assert state.weights.tolist() == [31, 31, 31]
    first, *_, last = logged(folder)
    assert (first["env_steps"], last["env_steps"]) == (20, 100)
    assert "eval/corner/falls" not in first["seeds"]
    assert last["eval/corner/falls"] == 2.5
    assert last["seeds"]["eval/corner/falls"] == [4, None, 1]
    assert last["seeds"]["loss"] == [0.25, 0.25, 0.25]
    assert "eval/x" not in {*last, *last["seeds"]}


@pytest.mark.parametrize("every", [1e9, 1e-9])
@pytest.mark.parametrize(
    ("calls", "die", "at"),
    [
        *((calls, "", 0) for calls in (0, 1, 3, 4)),
        *((9, die, at) for die, at in (("before", 60), ("after", 60), ("after", 100))),
    ],
)
def test_a_killed_run_goes_on_to_the_same_end(
    calls: int, die: str, at: int, every: float, folder: RunFolder, go: Any
) -> None:
    """In a call, before or after a validated policy is written, with and without a checkpoint.

    Lines and policies of a history that is lost are gone, whatever the decisions they belong to.
    """
    changes = {"checkpoint_seconds": every, "eval_every": 30}
    with pytest.raises(Killed):
        go(killed_after(calls), validating(folder, die, at), **changes)
    done = min(calls, at // 20 - 1 if at else 9)
    assert len(logged(folder)) == done
    with folder.metrics.open("a") as log:
        log.write('{"env_st')  # torn
    stray = folder.validated_policy(0, 110)
    stray.parent.mkdir(parents=True, exist_ok=True)
    stray.write_text("of another history")
    seen: list[dict[int, str]] = []

    def watched(state: Any) -> Any:
        if not seen:
            assert int(state.env_steps) == (20 * done if every < 1 else 0)
        seen.append(validated(folder))
        return step(state)

    assert float(go(watched, validating(folder), **changes)[0].weights) == 31
    assert validated(folder) == {40: "3.0", 60: "7.0", 100: "31.0"}
    assert held_out(folder) == pytest.approx({40: 1 / 3, 60: 1 / 7, 100: 1 / 31})
    assert [line["env_steps"] for line in logged(folder)] == CALLS
    assert list(drawn(folder, "train/tilt_deg")) == CALLS
    assert sorted(seen[0]) == [n for n in (40, 60, 100) if n <= 20 * done and every < 1]
    before = folder.metrics.read_text()
    assert float(go(killed_after(0), **changes)[0].weights) == 31, "a complete run is left alone"
    assert folder.metrics.read_text() == before


def test_an_interrupt_stops_after_the_call_and_its_validation_and_saves(
    folder: RunFolder, display: Any, go: Any
) -> None:
    def validate(state: Any) -> Any:
        if int(state.env_steps) == 40:
            os.kill(os.getpid(), signal.SIGINT)
            wait_for_answer(display)
        return validating(folder)(state)

    state, _ = go(validate=validate, eval_every=40)
    assert int(state.env_steps) == 40
    assert display.lines == [STOPPING]
    assert held_out(folder) == {40: pytest.approx(1 / 3)}
    assert checkpoints.saved_steps(folder.checkpoints) == [40]
    assert float(go(validate=validating(folder), eval_every=40)[0].weights) == 31
    assert list(held_out(folder)) == [40, 80, 100]


@pytest.mark.parametrize("full", ["metrics", "tensorboard", "validated", "checkpoints", "policy"])
def test_a_full_disk_stops_the_run_and_loses_nothing_that_is_learnt(
    full: str, folder: RunFolder, display: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the third call, or at the end; the policy is exported if it can be."""
    error, exported = OSError(28, "No space left on device", "the file"), []

    def program(state: Any) -> Any:
        if int(state.env_steps) == 40 and full == "metrics":
            folder.metrics.unlink()
            folder.metrics.symlink_to("/dev/full")
        if int(state.env_steps) == 40 and full == "tensorboard":
            monkeypatch.setattr(loop.Board, "write", mock.Mock(side_effect=error))
        if int(state.env_steps) == 40 and full == "checkpoints":
            shutil.rmtree(folder.checkpoints)
            folder.checkpoints.write_text("no folder")
        return step(state)

    def validate(run: Run, state: Any) -> dict[str, np.ndarray]:
        if int(state.env_steps) == 60 and full == "validated":
            raise error
        return {}

    def export(run: Run, state: Any, seconds: float) -> list[str]:
        exported.append(float(state.weights))
        if full == "policy":
            raise error
        folder.policy.touch()
        return ["the policy"]

    changes = {"eval_every": 20, "checkpoint_seconds": 1e-9 if full == "checkpoints" else 1e9}
    run = dataclasses.replace(run_of(**changes), folder=folder, display=display)
    monkeypatch.setattr(run_module, "prepare", lambda *given: (start(), program))
    monkeypatch.setattr(run_module, "validate", validate)
    monkeypatch.setattr(run_module.finish, "export", export)
    with pytest.raises(checkpoints.SaveError) as raised:
        run_module._learn(run, False)
    assert exported == [31.0 if full == "policy" else 7.0]
    reason = {
        "metrics": f"cannot write {folder.path}: No space left on device",
        "checkpoints": f"the checkpoint {folder.checkpoints / '60'} cannot be written: Not a dir",
    }.get(full, "cannot write the file: No space left on device")
    assert str(raised.value).startswith(reason)
    so_far = f"; the policy so far is {folder.policy}" if full != "policy" else "on device"
    assert str(raised.value).endswith(f"{so_far}; continue with --resume {folder.path}")
    assert STOPPING not in display.lines, "nobody has interrupted"
    if full != "checkpoints":
        last = 100 if full == "policy" else 60
        assert checkpoints.saved_steps(folder.checkpoints) == [last]


def test_a_second_interrupt_does_not_wait_for_the_call(
    folder: RunFolder, go: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor does the end of the process, where Python would wait for the program or abort.

    The call in which it comes is neither logged nor saved: it comes again.
    """
    left: list[Any] = []
    monkeypatch.setattr(loop.atexit, "register", lambda *call: left.append(call))
    monkeypatch.setattr(os, "_exit", lambda code: left.append(code))
    goes_on = threading.Event()

    def validate(state: Any) -> dict[str, np.ndarray]:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(loop.AGAIN_S + 0.1)
        os.kill(os.getpid(), signal.SIGINT)
        goes_on.wait(20)
        return {}

    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        go(validate=validate, eval_every=40)
    assert time.monotonic() - began < 5
    assert [line["env_steps"] for line in logged(folder)] == [20]
    assert checkpoints.saved_steps(folder.checkpoints) == []
    left = [call for call in left if call[0] is loop._leave]  # TensorBoard's writers also register
    [(leave, future)] = left
    leave(future)
    assert left[1:] == [130]
    goes_on.set()
    future.result(5)
    leave(future)
    assert len(left) == 2  # nothing runs any more: an ordinary end


def test_a_run_begins_at_its_newest_checkpoint(
    folder: RunFolder, display: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 64 envs, 16 decisions a call."""
    keys: list[str] = []
    seeds: list[int] = []

    def compile_program(program: Any, state: Any, key: str, say: Any) -> Any:
        keys.append(key)
        return program

    def train_program(iterations: int) -> Any:
        def program(state: State) -> Any:
            after, raw = step(state)
            return after._replace(env_steps=state.env_steps + 64 * iterations), raw

        return program

    def init(seed: int) -> State:
        seeds.append(seed)
        return start()

    monkeypatch.setattr(run_module.program_cache, "compile_program", compile_program)
    spec = types.SimpleNamespace(num_envs=64)
    learner: Any = types.SimpleNamespace(spec=spec, init=init, train_program=train_program)
    config = dataclasses.replace(PRESETS["smoke"], num_env_steps=4_096, num_devices=1, seed=5)
    env: Any = BalanceEnv
    run = Run(config, env, learner, folder, display)

    def go_on() -> float:
        with Interrupts(display.say) as stop:
            state, program = run_module.prepare(run, stop)
            return float(learn(run, program, state, stop, lambda state: {})[0].weights)

    checkpoints.save(folder.checkpoints, 1_024, start())
    third = State(jnp.int32(3_072), jnp.int32(9), jnp.float32(100))
    checkpoints.save(folder.checkpoints, 3_072, third)
    assert go_on() == 201  # one call from the newest, 2 * 100 + 1
    assert seeds == [5]
    assert keys == [program_key(config, 16, "mjx_balance.training.sizing")]
    assert "resuming at 3,072 decisions" in display.lines
    assert go_on() == 201
    assert len(keys) == 1, "a complete run needs no program"
    shutil.rmtree(folder.checkpoints)
    assert go_on() == 15  # four calls from nothing


class Listener(Callback):
    """Notes what it hears; stops at a number of decisions."""

    def __init__(self, stop_log: int = 0, stop_validation: int = 0):
        self.heard: list[tuple[str, float]] = []
        self.stop_log, self.stop_validation = stop_log, stop_validation

    def on_log(self, metrics: Any) -> bool:
        self.heard.append(("log", metrics["env_steps"]))
        return metrics["env_steps"] == self.stop_log

    def on_validation(self, metrics: Any) -> bool:
        assert metrics["eval/paper/falls"] == 0
        self.heard.append(("validation", metrics["env_steps"]))
        return metrics["env_steps"] == self.stop_validation


def test_callbacks_hear_of_every_line_and_validation(go: Any, folder: RunFolder) -> None:
    lines: list[Any] = []
    listener = Listener()
    validate = lambda state: {"eval/paper/falls": np.zeros(1)}  # noqa: E731
    go(validate=validate, eval_every=40, callbacks=[listener, lambda x: lines.append(dict(x))])
    logs = [("log", n) for n in CALLS]
    validations = [("validation", n) for n in (40, 80, 100)]
    assert listener.heard == sorted(logs + validations, key=lambda x: (x[1], x[0] == "log"))
    assert lines == logged(folder)


@pytest.mark.parametrize("kind", ["stop_log", "stop_validation"])
def test_a_callback_ends_a_run_after_its_call(
    kind: str, go: Any, folder: RunFolder, display: Any
) -> None:
    """Every other callback hears of that call too, and the state is saved."""
    first, second = Listener(**{kind: 40}), Listener()
    validate = lambda state: {"eval/paper/falls": np.zeros(1)}  # noqa: E731
    state, _ = go(validate=validate, eval_every=40, callbacks=[first, second])
    assert int(state.env_steps) == 40
    assert first.heard == second.heard == [("log", 20), ("validation", 40), ("log", 40)]
    assert checkpoints.saved_steps(folder.checkpoints) == [40]
    assert STOPPING not in display.lines


def test_a_run_that_a_callback_ends_is_evaluated(
    folder: RunFolder, display: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It counts as finished, unlike one that the user interrupts."""
    listeners = Callbacks([lambda metrics: True])
    run = dataclasses.replace(run_of(), folder=folder, display=display, callbacks=listeners)
    monkeypatch.setattr(run_module, "prepare", lambda *given: (start(), step))
    monkeypatch.setattr(run_module.finish, "export", lambda *given: ["the policy"])
    assert run_module._learn(run, False) == ["the policy"]
    assert [line["env_steps"] for line in logged(folder)] == [20]


def test_what_a_callback_raises_ends_the_run_at_once(go: Any, folder: RunFolder) -> None:
    def prune(metrics: Any) -> None:
        if metrics["env_steps"] == 40:
            raise LookupError("pruned")

    with pytest.raises(LookupError, match="pruned"):
        go(callbacks=[prune])
    assert [line["env_steps"] for line in logged(folder)] == [20, 40]


def test_all_callbacks_are_closed_though_one_fails() -> None:
    closed: list[int] = []

    class Closing(Callback):
        def __init__(self, number: int):
            self.number = number

        def close(self) -> None:
            closed.append(self.number)
            if self.number == 1:
                raise OSError("no network")

    with pytest.raises(OSError, match="no network"):
        Callbacks([Closing(0), Closing(1), Closing(2)]).close()
    assert closed == [0, 1, 2]
    with pytest.raises(ConfigError, match="callbacks has 3; each must be a Callback, or a func"):
        Callbacks([3])  # pyright: ignore[reportArgumentType]
    with pytest.raises(ConfigError, match="it must be a list of them"):
        Callbacks(Listener())  # pyright: ignore[reportArgumentType]
