"""The end of a run: a policy per seed that has one, the best of them, and files written whole."""

import dataclasses
import json
import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

from mjx_balance import load_policy
from mjx_balance.config import ConfigError, preset
from mjx_balance.evaluation.suites import SEEDS
from mjx_balance.files.run_folder import RunFolder, RunFolderError, unfinished_run
from mjx_balance.policy.file import Policy, PolicyError
from mjx_balance.report import figures, measuring
from mjx_balance.training import finish
from mjx_balance.training.validation import AnyPolicy

CONFIG = preset("smoke")
SEED = CONFIG.seed


@pytest.fixture
def export(make_run: Any, stub_learner: Any) -> Callable[..., list[AnyPolicy]]:
    """Scales of the stub's parameters -> policies."""

    def export(*scales: float) -> list[AnyPolicy]:
        run = make_run(dataclasses.replace(CONFIG, num_seeds=len(scales)))
        return finish.export(run, stub_learner.state_of(*scales), 1.26)

    return export


def test_one_seed_gives_one_policy(
    folder: RunFolder, display: Any, stub_learner: Any, export: Any
) -> None:
    [policy] = export(2.0)
    assert display.lines == []
    saved = load_policy(folder.policy)
    assert saved.fingerprint == policy.fingerprint
    assert stub_learner.scale_of(saved) == pytest.approx(2)
    assert saved.scene_hash == "hash"
    training = saved.manifest["training"]
    assert (training["env_steps"], training["gradient_steps"]) == (64, 192)
    assert training["seconds_learning_since_start_or_resume"] == 1.3
    assert not folder.seeds.exists()


def test_every_seed_gives_a_policy_of_its_own_and_a_diverged_one_none(
    folder: RunFolder, display: Any, stub_learner: Any, export: Any
) -> None:
    policies = export(np.nan, 2.0, np.inf, 4.0)
    assert [policy.config.seed for policy in policies] == [SEED + 1, SEED + 3]
    for k, policy in zip((1, 3), policies, strict=True):
        saved = load_policy(folder.seed_policy(SEED + k))
        assert saved.fingerprint == policy.fingerprint
        assert stub_learner.scale_of(saved) == pytest.approx(k + 1)
        assert (saved.config.seed, saved.config.num_seeds) == (SEED + k, 1)
    assert load_policy(folder.policy).fingerprint == policies[0].fingerprint
    for k, line in zip((0, 2), display.lines, strict=True):
        assert line.startswith(f"seed {SEED + k} gives no policy: weight ")
        assert "not finite numbers" in line


@pytest.mark.parametrize("scales", [(np.nan,), (np.nan, np.nan)])
def test_no_policy_at_all_is_an_error(
    folder: RunFolder, scales: tuple[float, ...], export: Any
) -> None:
    with pytest.raises(PolicyError, match="learnt no policy of finite numbers; lower learning"):
        export(*scales)
    assert not folder.policy.exists()


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("eval_scenarios", 100_000_000, "eval_scenarios is 100000000 and duration 20 s: that"),
        ("eval_duration", 1e12, "GiB are free"),
        ("validation_scenarios", 100_000_000, "validation_scenarios is 100000000 and duration 10"),
        ("validation_duration", 1e12, "validation_scenarios is 2 and duration 1e"),
    ],
)
def test_an_evaluation_beyond_the_memory_is_refused_by_its_field(
    field: str, value: float, sentence: str
) -> None:
    finish.check_fits(CONFIG)
    with pytest.raises(ConfigError, match=sentence):
        finish.check_fits(dataclasses.replace(CONFIG, **{field: value}))


def result(suite: str, falls: int, mean: float, seed: int) -> dict[str, Any]:
    tilts = {"mean": mean, "rms": mean, "p50": mean, "p95": mean, "p99": mean, "max": mean}
    values = {"suite": suite, "scenarios": 4, "falls": falls, "seed": seed, "tilt_deg": tilts}
    return values | {"action_mm_mean": 1.0, "action_mm_settled": 0.0, "duration_s": 5.0}


VALIDATION = {SEED: (0, 0.5), SEED + 1: (0, 0.4), SEED + 2: (1, 0.1), SEED + 3: (0, 0.6)}
"""Seed -> falls and mean tilt per suite: seed 1 is best, as a fall outweighs any tilt."""


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What `finish` asked of evaluation and report, in order."""
    asked: list[Any] = []

    def evaluate(
        policy: Policy, suite: str, scenarios: int, duration: float, seed: int, bar: Any, robot: str
    ) -> dict[str, Any]:
        assert robot == CONFIG.robot
        asked.append((policy.config.seed, suite, scenarios, duration, seed))
        bar(1.0)
        falls, mean = VALIDATION[policy.config.seed]
        if seed == SEEDS.final:  # the other way round: it must not decide
            falls, mean = 7, 1 - mean
        return result(suite, falls, mean, seed)

    def draw(folder: RunFolder, policy: Policy, robot: str, bar: Any) -> None:
        assert robot == CONFIG.robot
        assert load_policy(folder.policy).fingerprint == policy.fingerprint
        assert folder.evaluation.exists()
        asked.append(("figures", load_policy(folder.policy).config.seed))

    monkeypatch.setattr(finish.evaluation, "evaluate", evaluate)
    monkeypatch.setattr(finish, "_draw", draw)
    monkeypatch.setattr(finish.tables, "print_summary", lambda *given: asked.append("summary"))
    return asked


@pytest.fixture
def finished(make_run: Any, export: Any, calls: list[Any]) -> Callable[..., dict[str, Any]]:
    """Scales of the stub's parameters -> what the end of such a run returns."""

    def finished(*scales: float, sweep: tuple[str, ...] = ()) -> dict[str, Any]:
        policies = export(*scales)
        num_seeds = len(scales) // 2 if sweep else len(scales)
        config = dataclasses.replace(CONFIG, num_seeds=num_seeds, sweep=sweep)
        config = dataclasses.replace(config, eval_scenarios=4, eval_duration=5.0)
        return finish.finish(make_run(config), policies, 0.0).evaluation

    return finished


def test_one_seed_is_evaluated_on_both_suites(
    folder: RunFolder, calls: list[Any], finished: Any
) -> None:
    results = finished(1.0)
    asked = [(SEED, suite, 4, 5.0, SEEDS.final) for suite in ("paper", "corner")]
    assert calls == [*asked, ("figures", SEED), "summary"]
    assert json.loads(folder.evaluation.read_text()) == results
    assert results["corner"]["tilt_deg"]["mean"] == 0.5
    assert not folder.seeds_summary.exists()


def test_the_best_seed_is_chosen_by_the_validation_alone(
    folder: RunFolder, calls: list[Any], finished: Any
) -> None:
    results = finished(1.0, 2.0, 3.0, 4.0)
    assert load_policy(folder.policy).config.seed == SEED + 1
    assert ("figures", SEED + 1) in calls
    seeds = json.loads(folder.seeds_summary.read_text())
    assert seeds["best"] == SEED + 1
    assert [row["seed"] for row in seeds["seeds"]] == [SEED, SEED + 1, SEED + 2, SEED + 3]
    assert seeds["seeds"][1]["evaluation"] == results
    assert json.loads(folder.evaluation.read_text()) == results
    assert results["paper"]["tilt_deg"]["mean"] == pytest.approx(0.6)
    validated = seeds["seeds"][2]["validation"]["paper"]
    assert (validated["falls"], validated["seed"]) == (1, SEEDS.validation)
    assert seeds["statistics"]["corner"]["seeds"] == 4
    assert seeds["statistics"]["corner"]["falls"] == 28
    asked = {call[2:] for call in calls if len(call) == 5}
    choice = (finish.CHOICE_SCENARIOS, 5.0, SEEDS.validation)
    assert asked == {(4, 5.0, SEEDS.final), choice}
    assert SEEDS.final != SEEDS.validation


def test_a_diverged_seed_is_never_chosen(folder: RunFolder, finished: Any) -> None:
    finished(1.0, np.nan, 3.0)
    seeds = json.loads(folder.seeds_summary.read_text())
    assert [row["seed"] for row in seeds["seeds"]] == [SEED, SEED + 2]
    assert seeds["best"] == load_policy(folder.policy).config.seed == SEED
    folder.evaluation.unlink()
    finished(1.0, np.nan)  # the only one left needs no rival
    assert json.loads(folder.seeds_summary.read_text())["best"] == SEED


def test_figures_are_of_the_metrics_and_of_a_scenario_of_their_own(
    folder: RunFolder, export: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """100 s of suite paper, drawn by a seed that nothing else uses."""
    [policy] = export(1.0)
    folder.metrics.write_text('{"env_steps": 1}\n{"env_steps": 2}\n')
    drawn: list[Any] = []

    def record(policy: Policy, *given: Any, progress: Any) -> tuple:
        progress(1.0)
        return policy.fingerprint, *given

    monkeypatch.setattr(measuring, "record_rollout", record)
    monkeypatch.setattr(figures, "draw_figures", lambda *given: drawn.append(given))
    monkeypatch.setattr(finish.evaluation, "policy_scene", lambda policy, robot: robot)
    shares: list[float] = []
    finish._draw(folder, policy, "rex.toml", shares.append)
    assert shares == [0.5], "drawing takes the rest"
    rollouts = {"policy": (policy.fingerprint, "rex.toml", "paper", 100.0, 2_000_000)}
    lines = [{"env_steps": 1}, {"env_steps": 2}]
    assert drawn == [(folder.figures, lines, CONFIG.task, "rex.toml", rollouts)]


def test_a_run_killed_while_it_finishes_finishes_again(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, finished: Any
) -> None:
    """It counts as finished only once all is written, and TensorBoard has it once."""
    with monkeypatch.context() as patch:
        patch.setattr(finish, "_draw", mock.Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            finished(1.0)
    folder.config.write_text("{}")
    unfinished_run(folder.path)
    # TensorBoard's names count seconds: two runs within one would hide a file that is left.
    for number, file in enumerate(list((folder.tensorboard / "final").iterdir())):
        file.rename(file.with_name(f"events.out.tfevents.{number}.earlier"))
    finished(1.0)
    tags: list[str] = []
    for file in (folder.tensorboard / "final").iterdir():
        content = file.read_bytes()
        while content:
            length = int.from_bytes(content[:8], "little")
            event = Event.FromString(content[12 : 12 + length])
            tags += [value.tag for value in event.summary.value]
            assert not event.summary.value or event.step == 64
            assert abs(event.wall_time - time.time()) < 3_600
            content = content[16 + length :]
    names = ["falls", *(f"tilt_{name}" for name in ("mean", "rms", "p50", "p95", "p99", "max"))]
    assert sorted(tags) == sorted(f"eval/{s}/{n}" for s in ("paper", "corner") for n in names)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), ValueError("a backend")])
def test_a_picture_that_fails_is_a_sentence_and_the_results_are_there(
    error: Exception,
    folder: RunFolder,
    display: Any,
    calls: list[Any],
    monkeypatch: pytest.MonkeyPatch,
    finished: Any,
) -> None:
    monkeypatch.setattr(finish, "_draw", mock.Mock(side_effect=error))
    results = finished(1.0)
    assert json.loads(folder.evaluation.read_text()) == results
    assert display.lines[-1] == f"some figures or curves are missing: {error}"
    assert calls[-1] == "summary"
    folder.config.write_text("{}")
    with pytest.raises(RunFolderError, match="is finished"):
        unfinished_run(folder.path)


def test_curves_that_cannot_be_written_lose_no_result(
    folder: RunFolder, display: Any, finished: Any
) -> None:
    folder.tensorboard.write_text("no folder")
    results = finished(1.0)
    assert json.loads(folder.evaluation.read_text()) == results
    assert "some figures or curves are missing: " in display.lines[-1]


def test_a_sweep_is_ranked_by_falls_and_tilt_of_its_seeds(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, finished: Any
) -> None:
    """Four runs: two values of gamma with two seeds each."""
    monkeypatch.setitem(VALIDATION, SEED, (0, 0.9))
    finished(1.0, 2.0, 3.0, 4.0, sweep=("gamma=0.1,0.4",))
    best, worst = json.loads(folder.sweep.read_text())
    assert [x["values"] for x in (best, worst)] == [{"gamma": 0.1}, {"gamma": 0.4}]
    # All fall equally often in the evaluation; 1 - 0.9 and 1 - 0.4, and 1 - 0.1 and 1 - 0.6.
    assert best["statistics"]["paper"]["mean"]["iqm"] == pytest.approx(0.35)
    assert worst["statistics"]["corner"]["mean"]["iqm"] == pytest.approx(0.65)
    assert best["statistics"]["corner"]["seeds"] == 2
    assert best["statistics"]["corner"]["falls"] == 14
    summary = json.loads(folder.seeds_summary.read_text())
    assert (summary["statistics"], len(summary["seeds"])) == ({}, 4), "no mean over both gammas"


def test_falls_rank_before_tilt() -> None:
    def row(falls: tuple[int, int], tilt: float) -> Any:
        suites = zip(("paper", "corner"), falls, strict=True)
        return {"statistics": {s: {"falls": n, "mean": {"iqm": tilt}} for s, n in suites}}

    rows = [row((0, 3), 0.1), row((1, 1), 0.5), row((2, 0), 0.4)]
    assert sorted(rows, key=finish._rank) == [rows[2], rows[1], rows[0]]
