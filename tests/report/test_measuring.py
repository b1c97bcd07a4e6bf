"""What a report measures, on what, and that it is kept: the simulation is made up."""

import contextlib
import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from mjx_balance.evaluation.envelope import Envelope
from mjx_balance.evaluation.rollout import Rollout
from mjx_balance.policy.file import Policy, load_policy
from mjx_balance.report import measuring
from mjx_balance.report.measuring import Measurements, code, code_digest
from mjx_balance.report.reading import FOREIGN
from mjx_balance.sim.scene import Scene, load_scene

SHIPPED = Path(__file__).parents[2] / "policies" / "best.safetensors"
NAMES = ("policy", "none", "pd-imu", "pd-attitude", "rate-oracle", "clairvoyant")
MAPPED = Envelope([2.0, 3.0], [2.5], [[0.0], [0.5]], [[0.1], [3.0]], 4.0, 10.0, 2, 30.0, 7)


@pytest.fixture(scope="module")
def policy() -> Policy:
    return load_policy(SHIPPED)


@pytest.fixture(scope="module")
def its_scene(policy: Policy) -> Scene:
    return load_scene(policy.config)


@pytest.fixture
def measure(
    policy: Policy, its_scene: Scene, calls: list[tuple], tmp_path: Path
) -> Callable[..., Measurements]:
    """Measures, or reads what `report.json` in the test's folder holds."""

    def stage(title: str) -> Any:
        return contextlib.nullcontext(lambda share: None)

    def run(scenarios: int, policy: Policy = policy) -> Measurements:
        file = tmp_path / "report.json"
        return measuring.load(policy, its_scene, file, scenarios) or measuring.measure(
            policy, its_scene, file, scenarios, stage
        )

    return run


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple]:
    """Replaces the simulation; gets what it was asked for.

    In call k, half of the tilts are 0.001 * (k + 1) deg, a quarter 3 and a quarter 6.
    """
    asked: list[tuple] = []

    def run_suite(scene, controller, suite, scenarios, duration, seed, *more, **named):
        tilt = np.tile([0.001 * (len(asked) + 1)] * 2 + [3.0, 6.0], (scenarios, 1))
        asked.append((controller, suite, scenarios, duration, seed, named.get("record", False)))
        fell_at = np.arange(scenarios) + 3  # the first falls in the last step
        return Rollout(scene.task, tilt, fell_at, np.zeros((scenarios, 1)), None, 1.0)

    def envelope(scene, controller, scenarios, duration, seed, *more, inclines, rates):
        assert (len(inclines), len(rates)) == (6, 6)
        asked.append((controller, "envelope", scenarios, duration, seed, False))
        return dataclasses.replace(MAPPED, scenarios=scenarios, duration_s=duration, seed=seed)

    # The controllers, too: their names stand for them.
    monkeypatch.setattr(measuring, "make_controller", lambda name, *_: f"{name} {len(asked)}")
    monkeypatch.setattr(measuring, "run_suite", run_suite)
    monkeypatch.setattr(measuring, "envelope", envelope)
    return asked


def test_everyone_is_measured_on_the_same_scenarios(
    policy: Policy, calls: list[tuple], measure: Any
) -> None:
    found = measure(5)
    *suites, mapped = calls
    assert [call[1] for call in suites] == ["paper"] * 6 + ["corner"] * 6
    assert {call[2:] for call in suites} == {(5, 60.0, 4_000_000, False)}
    assert mapped[1:] == ("envelope", 2, 30.0, 4_000_000, False)
    assert [call[0] for call in suites if isinstance(call[0], str)] == [
        f"{name} {6 * n + k}" for n in range(2) for k, name in enumerate(NAMES) if k
    ], "each suite gets a fresh controller: some have a memory"
    obs = np.zeros((1, policy.observation_size), np.float32)
    view = type("View", (), {"obs": obs})
    for controller in (calls[0][0], mapped[0]):
        np.testing.assert_array_equal(controller(view), policy.command(obs))
    assert list(found.results) == list(found.shares) == list(NAMES)
    for k, name in enumerate(NAMES):
        for n, suite in enumerate(("paper", "corner")):
            result = found.results[name][suite]
            least = 0.001 * (6 * n + k + 1)
            assert result["tilt_deg"]["mean"] == pytest.approx((2 * least + 9) / 4)
            assert (result["scenarios"], result["falls"]) == (5, 1)


def test_shares_are_those_of_the_physics_steps_in_each_bin(measure: Any) -> None:
    found = measure(2)
    edges = measuring.edges(6.0)
    assert (edges[0], edges[1], edges[-2]) == (0, 0.01, pytest.approx(6))
    share = found.shares["policy"]["paper"]
    assert len(share) == len(edges) - 1
    assert share[0] == 0.5
    assert share[-1] == 0.25, "a fall's 6 deg are counted"
    holds_3 = int(np.searchsorted(edges, 3.0, side="right")) - 1
    assert share[holds_3] == 0.25
    assert sum(share) == 1
    edges = measuring.edges(10.0)
    assert edges[-2] == pytest.approx(10)
    assert np.histogram([9.9, 10.0], edges)[0][-2:].tolist() == [1, 1], "up to where it fails"


@pytest.mark.slow
def test_what_was_measured_is_kept(
    policy: Policy, calls: list[tuple], measure: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until anything changes that decides a result; a measurement is 13 calls."""
    first = measure(5)
    assert measure(5) == first
    assert len(calls) == 13, "nothing was measured again"
    measure(6)
    assert len(calls) == 2 * 13, "another number of scenarios"
    changes = {"DURATION": 61.0, "ENVELOPE_SCENARIOS": 3, "ENVELOPE_DURATION": 31.0}
    for k, (name, value) in enumerate(changes.items(), 3):
        monkeypatch.setattr(measuring, name, value)
        measure(6)
        assert len(calls) == k * 13, name
    monkeypatch.setitem(measuring.ENVELOPE_GRID, "rates", (2.0, 2.5, 3.0, 3.5, 4.0, 5.0))
    measure(6)
    assert len(calls) == 6 * 13, "another map"
    weights = safetensors.numpy.load_file(SHIPPED)
    scaled = {name: (1.001 * value).astype(np.float32) for name, value in weights.items()}
    other = Policy(policy.manifest, scaled)
    measure(6, other)
    assert len(calls) == 7 * 13, "another network"
    task = dataclasses.replace(policy.config.task, action_ramp=0.3)
    other.config = dataclasses.replace(policy.config, task=task)
    measure(6, other)
    assert len(calls) == 8 * 13, "the same network in another task"
    monkeypatch.setattr(measuring, "code_digest", lambda: "other")
    measure(6, other)
    assert len(calls) == 9 * 13, "other code"
    monkeypatch.setattr(Scene, "hash", "of another board")
    measure(6, other)
    assert len(calls) == 10 * 13, "another scene"


HOSTILE = "<img src=x onerror=alert(1)>"


@pytest.mark.slow
@pytest.mark.parametrize(
    "where",
    [
        "results",
        "results none",
        "results none corner falls",
        "results policy paper scenarios",
        "results policy paper tilt_deg p95",
        "results policy paper action_mm_settled",
        "shares none paper",
        "shares none paper 3",
        "envelope",
        "envelope rates 0",
        "envelope fall_rate 1",
        "envelope mean_tilt 1 0",
        *(f"envelope {name}" for name in "authority reach scenarios duration_s seed".split()),
    ],
)
def test_what_was_not_measured_is_refused(tmp_path: Path, measure: Any, where: str) -> None:
    first = measure(5)
    saved = json.loads((tmp_path / "report.json").read_text())
    assert measuring.parse_measurements(saved) == first
    *path, last = (int(name) if name.isdigit() else name for name in where.split())
    inside = functools.reduce(lambda part, name: part[name], path, saved)
    optional = last == "action_mm_settled"  # of a robot that always fell
    for bad in (HOSTILE, [], [[]], float("nan"), *([] if optional else [None])):
        inside[last] = bad
        with pytest.raises(FOREIGN):
            measuring.parse_measurements(saved)
    del inside[last]
    if not optional:
        with pytest.raises(FOREIGN):
            measuring.parse_measurements(saved)


@pytest.mark.slow
def test_a_damaged_file_is_measured_again(calls: list[tuple], tmp_path: Path, measure: Any) -> None:
    first, file = measure(5), tmp_path / "report.json"
    saved = json.loads(file.read_text())
    saved["results"]["policy"]["paper"]["falls"] = HOSTILE
    for bad in (json.dumps(saved), "[" * 100_000, "{", "null"):
        file.write_text(bad)
        calls.clear()
        assert measure(5) == first


def test_a_folder_that_cannot_be_written_is_measured_all_the_same(
    tmp_path: Path, measure: Any
) -> None:
    (tmp_path / "report.json").mkdir()
    assert list(measure(5).results) == list(NAMES)


def test_one_recorded_scenario(policy: Policy, scene: Scene, calls: list[tuple]) -> None:
    measuring.record_rollout(policy, scene, "corner", 12.0, 7)
    measuring.record_rollout(policy, scene, "paper", 100.0, 8, "pd-imu")
    assert [call[1:] for call in calls] == [
        ("corner", 1, 12.0, 7, True),
        ("paper", 1, 100.0, 8, True),
    ]
    assert calls[1][0] == "pd-imu 1"


def test_the_code_that_decides_a_result_is_in_its_digest(monkeypatch: pytest.MonkeyPatch) -> None:
    before, sources = code_digest(), code("mjx_balance.evaluation.envelope")
    names = "evaluation.rollout evaluation.controllers evaluation.suites sim.scene task task.tilt"
    inside = {f"mjx_balance.{name}" for name in (*names.split(), "config", "sim.engines.mujoco")}
    assert inside <= set(sources)
    names = "sim.engines.mjx report.page report.figures dqn.replay envs.balance cli"
    assert not {f"mjx_balance.{name}" for name in names.split()} & set(sources)
    for name in inside:
        changed = sources | {name: f"{sources[name]}\nadded = 1"}
        monkeypatch.setattr(measuring, "code", lambda *_, changed=changed: changed)
        assert code_digest() != before
    monkeypatch.setattr(measuring, "code", lambda *_: sources)
    assert code_digest() == before
    monkeypatch.setattr(measuring.mujoco, "__version__", "0")
    assert code_digest() != before
