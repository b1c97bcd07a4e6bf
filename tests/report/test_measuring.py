"""What a report measures, on what, and that it is kept: the simulation is made up."""

import contextlib
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjx_balance.evaluation.envelope import Envelope
from mjx_balance.evaluation.rollout import Rollout
from mjx_balance.policy.file import Policy, load_policy
from mjx_balance.report import measuring
from mjx_balance.report.measuring import load_or_measure
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


@contextlib.contextmanager
def no_bar(title: str) -> Iterator[Any]:
    yield lambda share: None


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
        return Rollout(scene.config.task, tilt, fell_at, np.zeros((scenarios, 1)), None, 1.0)

    def envelope(scene, controller, scenarios, duration, seed, *more):
        asked.append((controller, "envelope", scenarios, duration, seed, False))
        return dataclasses.replace(MAPPED, scenarios=scenarios, duration_s=duration, seed=seed)

    # The controllers, too: their names stand for them.
    monkeypatch.setattr(measuring, "make_controller", lambda name, *_: f"{name} {len(asked)}")
    monkeypatch.setattr(measuring, "run_suite", run_suite)
    monkeypatch.setattr(measuring, "envelope", envelope)
    return asked


def test_everyone_is_measured_on_the_same_scenarios(
    policy: Policy, its_scene: Scene, calls: list[tuple], tmp_path: Path
) -> None:
    found = load_or_measure(policy, its_scene, tmp_path / "report.json", 5, no_bar)
    *suites, mapped = calls
    assert [call[1] for call in suites] == ["paper", "corner"] * 6
    assert {call[2:] for call in suites} == {(5, 60.0, 4_000_000, False)}
    assert mapped[1:] == ("envelope", 2, 30.0, 4_000_000, False)
    assert [call[0] for call in suites[2:]] == [
        f"{name} {2 * k + n}" for k, name in enumerate(NAMES) if k for n in range(2)
    ], "each suite gets a fresh controller: some have a memory"
    obs = np.zeros((1, policy.observation_size), np.float32)
    view = type("View", (), {"obs": obs})
    assert calls[0][0](view) == mapped[0](view) == policy(obs), "the policy itself"
    assert list(found.results) == list(found.shares) == list(NAMES)
    for k, name in enumerate(NAMES):
        for n, suite in enumerate(("paper", "corner")):
            result = found.results[name][suite]
            least = 0.001 * (2 * k + n + 1)
            assert result["tilt_deg"]["mean"] == pytest.approx((2 * least + 9) / 4)
            assert (result["scenarios"], result["falls"]) == (5, 1)


def test_shares_are_those_of_the_physics_steps_in_each_bin(
    policy: Policy, its_scene: Scene, calls: list[tuple], tmp_path: Path
) -> None:
    found = load_or_measure(policy, its_scene, tmp_path / "report.json", 2, no_bar)
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
    policy: Policy,
    its_scene: Scene,
    calls: list[tuple],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = tmp_path / "report.json"
    first = load_or_measure(policy, its_scene, file, 5, no_bar)
    count = len(calls)
    assert load_or_measure(policy, its_scene, file, 5, no_bar) == first
    assert len(calls) == count, "nothing was measured again"
    load_or_measure(policy, its_scene, file, 6, no_bar)
    assert len(calls) == 2 * count, "another number of scenarios"
    monkeypatch.setattr(measuring, "DURATION", 61.0)
    load_or_measure(policy, its_scene, file, 6, no_bar)
    assert len(calls) == 3 * count, "another duration"
    other = Policy(policy.manifest, weights_of(SHIPPED, by=1.001))
    load_or_measure(other, its_scene, file, 6, no_bar)
    assert len(calls) == 4 * count, "another network"
    task = dataclasses.replace(policy.config.task, action_ramp=0.3)
    other.config = dataclasses.replace(policy.config, task=task)
    load_or_measure(other, its_scene, file, 6, no_bar)
    assert len(calls) == 5 * count, "the same network in another task"
    monkeypatch.setattr(measuring, "ENVELOPE_SCENARIOS", 3)
    load_or_measure(other, its_scene, file, 6, no_bar)
    monkeypatch.setattr(measuring, "ENVELOPE_DURATION", 31.0)
    load_or_measure(other, its_scene, file, 6, no_bar)
    assert len(calls) == 7 * count, "another envelope"


HOSTILE = "<img src=x onerror=alert(1)>"


@pytest.mark.slow
@pytest.mark.parametrize(
    "where",
    [
        ("results",),
        ("results", "none"),
        ("results", "none", "corner", "falls"),
        ("results", "policy", "paper", "scenarios"),
        ("results", "policy", "paper", "tilt_deg", "p95"),
        ("results", "policy", "paper", "action_mm_settled"),
        ("shares", "none", "paper"),
        ("shares", "none", "paper", 3),
        ("envelope",),
        ("envelope", "rates", 0),
        ("envelope", "fall_rate", 1),
        ("envelope", "mean_tilt", 1, 0),
        ("envelope", "authority"),
        ("envelope", "reach"),
        ("envelope", "scenarios"),
        ("envelope", "duration_s"),
        ("envelope", "seed"),
    ],
    ids=lambda where: "-".join(map(str, where)),
)
def test_what_was_not_measured_is_refused(
    policy: Policy, its_scene: Scene, calls: list[tuple], tmp_path: Path, where: tuple
) -> None:
    file = tmp_path / "report.json"
    first = load_or_measure(policy, its_scene, file, 5, no_bar)
    saved = json.loads(file.read_text())
    assert measuring.parse_measurements(saved) == first
    inside = saved
    for name in where[:-1]:
        inside = inside[name]
    for bad in (HOSTILE, [], None, [[]], float("nan")):
        if (bad, where[-1]) == (None, "action_mm_settled"):
            continue  # a robot that always fell
        inside[where[-1]] = bad
        with pytest.raises(FOREIGN):
            measuring.parse_measurements(saved)
    del inside[where[-1]]
    if where[-1] != "action_mm_settled":
        with pytest.raises(FOREIGN):
            measuring.parse_measurements(saved)


@pytest.mark.slow
def test_a_damaged_file_is_measured_again(
    policy: Policy, its_scene: Scene, calls: list[tuple], tmp_path: Path
) -> None:
    file = tmp_path / "report.json"
    first = load_or_measure(policy, its_scene, file, 5, no_bar)
    saved = json.loads(file.read_text())
    saved["results"]["policy"]["paper"]["falls"] = HOSTILE
    for bad in (json.dumps(saved), "[" * 100_000, "{", "null"):
        file.write_text(bad)
        calls.clear()
        assert load_or_measure(policy, its_scene, file, 5, no_bar) == first


def test_a_folder_that_cannot_be_written_is_measured_all_the_same(
    policy: Policy, its_scene: Scene, calls: list[tuple], tmp_path: Path
) -> None:
    (tmp_path / "report.json").mkdir()
    found = load_or_measure(policy, its_scene, tmp_path / "report.json", 5, no_bar)
    assert list(found.results) == list(NAMES)


def test_with_other_code_everything_is_measured_again(
    policy: Policy,
    its_scene: Scene,
    calls: list[tuple],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = tmp_path / "report.json"
    load_or_measure(policy, its_scene, file, 5, no_bar)
    monkeypatch.setattr(measuring, "code_digest", lambda: "other")
    load_or_measure(policy, its_scene, file, 5, no_bar)
    assert len(calls) == 2 * 13


def weights_of(path: Path, by: float) -> dict[str, np.ndarray]:
    import safetensors.numpy

    weights = safetensors.numpy.load_file(path)
    return {name: (by * value).astype(np.float32) for name, value in weights.items()}


def test_one_recorded_scenario(policy: Policy, calls: list[tuple]) -> None:
    measuring.record_rollout(policy, "corner", 12.0, 7)
    measuring.record_rollout(policy, "paper", 100.0, 8, "pd-imu")
    assert [call[1:] for call in calls] == [
        ("corner", 1, 12.0, 7, True),
        ("paper", 1, 100.0, 8, True),
    ]
    assert calls[1][0] == "pd-imu 1"
