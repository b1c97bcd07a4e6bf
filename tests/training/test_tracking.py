"""What a tracker is sent, offline: a module with the calls of wandb and Trackio stands for both."""

import os
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from mjx_balance.config import ConfigError, preset, to_dict
from mjx_balance.training.callbacks import Callbacks
from mjx_balance.training.tracking import Tracker

LINE = {"env_steps": 1024, "gradient_steps": 7, "train/tilt_deg": 0.5}
TILTS = {"mean": 0.1, "p95": 0.3}
EVALUATION = {"paper": {"falls": 2, "tilt_deg": TILTS}}


class Module(types.ModuleType):
    """Remembers its calls; those in `broken` fail."""

    def __init__(self, name: str):
        super().__init__(name)
        self.calls: list[tuple[str, Any]] = []
        self.broken: set[str] = set()
        for call in ("init", "log", "finish"):
            setattr(self, call, self._recorder(call))

    def _recorder(self, call: str) -> Any:
        def record(*given: Any, **named: Any) -> None:
            self.calls.append((call, (*given, named)))
            if call in self.broken:
                raise RuntimeError(f"no {call} today")

        return record


@pytest.fixture(params=["wandb", "trackio"])
def module(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Module:
    stub = Module(request.param)
    monkeypatch.setitem(sys.modules, request.param, stub)
    return stub


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / "config.json").write_text("{}")
    return tmp_path / "first"


def follow(module: Module, folder: Path, lines: list[dict[str, float]] | None = None) -> list[str]:
    """A run with its tracker; returns what is said."""
    said: list[str] = []
    callbacks = Callbacks([Tracker(module.__name__, said.append)])
    callbacks.on_start(preset("quick"), folder)
    for line in lines or [LINE]:
        assert not callbacks.on_log(line), "a tracker never stops a run"
    callbacks.on_end(EVALUATION)
    callbacks.close()
    return said


def test_a_run_is_sent_from_its_config_to_its_evaluation(module: Module, folder: Path) -> None:
    assert follow(module, folder, [LINE, LINE | {"env_steps": 2048, "eval/paper/falls": 1.0}]) == []
    (_, (start,)), *logs, last = module.calls
    name = start.pop("name")
    assert name.startswith("first-")
    expected = {"project": "mjx_balance", "config": to_dict(preset("quick")), "resume": "allow"}
    if module.__name__ == "wandb":
        expected |= {"id": name, "dir": str(folder)}
    assert start == expected
    values = {"gradient_steps": 7, "train/tilt_deg": 0.5}
    final = {"final/paper/falls": 2, "final/paper/tilt_mean": 0.1, "final/paper/tilt_p95": 0.3}
    assert logs == [
        ("log", (values, {"step": 1024})),
        ("log", (values | {"eval/paper/falls": 1.0}, {"step": 2048})),
        ("log", (final, {"step": 2048})),
    ]
    assert last == ("finish", ({},))


def test_a_resumed_run_goes_on_and_another_of_the_same_name_does_not(
    module: Module, folder: Path, tmp_path: Path
) -> None:
    other = tmp_path / "elsewhere" / "first"
    other.mkdir(parents=True)
    (other / "config.json").write_text("{}")
    for path in (folder, folder, other):
        follow(module, path)
    os.utime(folder / "config.json", ns=(1, 1))  # begun anew at the same place
    follow(module, folder)
    first, again, *others = (given[-1]["name"] for call, given in module.calls if call == "init")
    assert first == again
    assert len({first, *others}) == 3


@pytest.mark.parametrize("broken", ["log", "finish"])
def test_a_tracker_that_fails_does_not_end_the_run(
    module: Module, folder: Path, broken: str
) -> None:
    module.broken = {broken}
    said = follow(module, folder, [LINE, LINE])
    name = module.__name__
    assert said == [f"{name} failed, and the run goes on without it: no {broken} today"]
    assert [call for call, _ in module.calls].count(broken) == 1, "it is not asked again"


def test_a_tracker_that_does_not_start_is_refused_and_not_ended(
    module: Module, folder: Path
) -> None:
    module.broken = {"init"}
    tracker = Tracker(module.__name__, print)
    with pytest.raises(ConfigError, match=f"track is {module.__name__}, which does not start: no"):
        tracker.on_start(preset("quick"), folder)
    tracker.close()
    assert [call for call, _ in module.calls] == ["init"]


@pytest.mark.parametrize("name", ["wandb", "trackio"])
def test_one_that_is_not_installed_is_named_with_its_extra(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=f"track is {name}, .* the extra {name} brings it"):
        Tracker(name, print)
