"""The HTML report: complete, honest about what is missing, and quiet in a browser."""

import base64
import contextlib
import copy
import dataclasses
import html
import json
import re
import shutil
import subprocess
import types
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest

from mjx_balance.cli import main
from mjx_balance.config import Config, preset, to_dict
from mjx_balance.evaluation.envelope import Envelope
from mjx_balance.policy.file import load_policy, save_policy
from mjx_balance.policy.manifest import make_manifest
from mjx_balance.policy.network import Policy
from mjx_balance.render.drawing import RenderError
from mjx_balance.report import figures, measuring, page, reading
from mjx_balance.report.measuring import NAMES, Measurements
from mjx_balance.report.page import Picture
from mjx_balance.report.reading import Run
from mjx_balance.sim.scene import Scene

ISOLATED = '"network_isolation_key":"file://'
"""How Chromium's network log marks what a page from disk asks for."""
SHORTER = {
    "DURATION": 3.0,
    "ENVELOPE_SCENARIOS": 1,
    "ENVELOPE_DURATION": 1.0,
    "ENVELOPE_GRID": {"inclines": (2.0, 8.0), "rates": (2.5, 5.0)},
    "RECORD_SECONDS": 12.0,
    "VIDEO_SECONDS": 1.0,
}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="module")
def run(
    config: Config,
    scene: Scene,
    tmp_path_factory: pytest.TempPathFactory,
    metrics_line: Any,
    evaluations: Any,
) -> Path:
    """A run folder of two seeds with everything in it; the policy is untrained."""
    folder = tmp_path_factory.mktemp("report") / "run"
    folder.mkdir()
    config = dataclasses.replace(config, num_seeds=2)
    lines = [json.dumps(metrics_line(k, 2)) for k in range(8)]
    (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    rows = [{"evaluation": evaluations(t)} for t in (0.1, 0.2)]
    for name, values in (
        ("config", to_dict(config)),
        ("evaluation", evaluations()),
        ("seeds", {"seeds": rows}),
    ):
        (folder / f"{name}.json").write_text(json.dumps(values))
    layers: dict[str, Any] = {
        name: {"kernel": np.zeros((a, b)), "bias": np.zeros(b)}
        for name, a, b in (("hidden_0", 34, 64), ("hidden_1", 64, 64), ("head", 98, 3))
    }
    layers |= {"profile": np.zeros(4), "stretch": np.zeros(2)}
    manifest = make_manifest(config, scene.hash, {})
    save_policy(folder / "policy.safetensors", {"params": layers}, manifest)
    return folder


@pytest.fixture(scope="module")
def policy(run: Path) -> Policy:
    return load_policy(run / "policy.safetensors")


@pytest.fixture(scope="module")
def written(run: Path) -> Path:
    """The report on that folder, by the command."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in SHORTER.items():
            patch.setattr(measuring, name, value)
        assert main(("report", str(run), "--scenarios", "2")) == 0
    return run / "report.html"


@pytest.mark.slow
def test_everything_is_there_and_nothing_from_elsewhere(run: Path, written: Path) -> None:
    text = written.read_text()
    titles = (
        "Against the baselines|Over the training seeds|12 s on the board: paper|"
        "12 s on the board: corner|Tilt distribution|Envelope|Video|Learning curves|"
        "Reward (Fig. 4 and 5 of the paper)|Config|Reproduce"
    )
    assert re.findall(r"<h2>(.*?)</h2>", text) == titles.split("|"), "nothing is missing"
    assert "mjx-balance train --preset default --seed 0 " in text
    assert " --num-seeds 2" in text
    assert "<td>0.150 (0.100-0.200)</td><td>0.200</td>" in text, "over the two seeds"
    assert text.count("data:image/svg+xml;base64,") == 6
    for alt in re.findall(r'<img alt="(.*?)"', text):
        assert re.search(r"\d", alt), "it says what is seen"
    assert "data:video/mp4;base64," in text
    results = json.loads((run / "report.json").read_text())["results"]
    for row, suites in zip(tables(text)[0][2:], results.values(), strict=True):
        measured = [suites[suite] for suite in ("paper", "corner")]
        assert {result["scenarios"] for result in measured} == {2}
        shown = [f"{r['tilt_deg'][x]:.3f}" for r in measured for x in ("mean", "p95", "max")]
        assert [*row[3:6], *row[7:10]] == shown
    text = re.sub(r'"data:[^"]*"', '""', text)
    assert not re.findall(r"(?:src|href)=\"[^\"]+\"", text)
    assert "http" not in text
    assert "<script" not in text


def elements(tag: str, text: str) -> list[str]:
    """The outermost elements of a kind, with their tags."""
    return re.findall(f"<(?:{tag})[ >].*?</(?:{tag})>", text, re.DOTALL)


def tables(text: str) -> list[list[list[str]]]:
    """The text of every cell of every table of a page: [table][row][cell]."""
    rows = [elements("tr", table) for table in elements("table", text)]
    words = lambda cell: html.unescape(re.sub("<.*?>", "", cell))  # noqa: E731
    return [[[*map(words, elements("td|th", row))] for row in table] for table in rows]


BLANK = {"title": "x", "missing": [], "policy": None, "video": None, "training": {}}
BLANK |= {"config": None, "commands": [], "versions": ""}
PICTURE = Picture("seen", "AAAA")
PICTURES = dict.fromkeys(("paper", "corner", "tilt", "envelope"), PICTURE)


def made_up(policy: Policy) -> Measurements:
    """A measurement in which every number is another one."""
    results: dict[str, Any] = {}
    for k, name in enumerate(NAMES):
        results[name] = {}
        for n, suite in enumerate(("paper", "corner")):
            first = k + n / 2
            tilt = {"mean": first + 0.1, "p95": first + 0.2, "max": first + 0.3}
            results[name][suite] = {
                "scenarios": 40 + n,
                "falls": 10 * k + n,
                "tilt_deg": tilt | {"rms": 9.9, "p50": 9.8, "p99": 9.7},
                "action_mm_settled": None if k == 1 else 0.01 * k + n,
            }
    shares = {
        name: {"paper": [0.5] + [0.0] * 159 + [0.5], "corner": [1.0] + [0.0] * 160}
        for name in results
    }
    falls = [[0.0, 0.0, 1.0], [0.0, 0.5, 1.0], [1.0, 1.0, 1.0]]
    inclines, rates, tilts = [2.0, 3.0, 20.0], [2.5, 3.0, 9.0], [[0.1] * 3] * 3
    envelope = Envelope(inclines, rates, falls, tilts, 4.456, 10.34, 3, 31.0, 0)
    return Measurements(results, shares, envelope)


def shown(policy: Policy, **more: Any) -> str:
    """The page of a policy whose measurements are made up."""
    parts = {"policy": policy, "measurements": made_up(policy), "seeds": {}, "pictures": PICTURES}
    return page.render_page(BLANK | parts | more)


def test_the_table_of_baselines_and_the_tiles(policy: Policy) -> None:
    text = shown(policy)
    (table,) = tables(text)
    assert table[0] == ["", "sees", "suite paper", "suite corner", "moves at restmm"]
    assert table[1] == ["falls", "mean", "p95", "max"] * 2
    names = "policy none pd-imu pd-attitude rate-oracle clairvoyant"
    assert [row[0] for row in table[2:]] == names.split()
    cells = "0 0.100 0.200 0.300 1 0.600 0.700 0.800 0.000".split()
    assert table[2][1:] == ["this network: 34 inputs", *cells]
    cells = "10 1.100 1.200 1.300 11 1.600 1.700 1.800 -".split()
    assert table[3][1:] == ["stands still", *cells]
    assert table[4][1] == "PD on a complementary filter of the same IMU"
    assert table[7][2:] == "50 5.100 5.200 5.300 51 5.600 5.700 5.800 0.050".split()
    assert text.count('class="ours"') == 1
    assert '<tr class="ours"><td><b>policy</b>' in text
    assert re.findall(r"<div><b>(.*?)</b><span>(.*?)</span></div>", text) == [
        ("0.100°", "mean tilt, targets in any direction"),
        ("0.600°", "mean tilt, both axes at 7° at once"),
        ("1", "falls in 80 scenarios of 60 s"),
        ("75%", "of the feasible envelope free of falls"),
    ]
    assert "Plain MuJoCo, 40 held-out scenarios of 60 s per suite and row (seed 4000000; " in text
    captions = html.unescape("|".join(re.findall(r"<img alt.*?</div><p>(.*?)</p>", text)))
    assert "suite paper (targets in any direction): one scenario, beside the PD" in captions
    assert "suite corner (both axes at once, the case the paper's" in captions
    assert "|Suite paper, every physics step of 40 scenarios of 60 s per curve. A curve" in captions
    assert "|Targets on both axes at once, 3 scenarios of 31 s per cell. Right" in captions
    assert "3 mm 5 times a second turn the body at 4.46 deg/s in pitch" in captions
    assert captions.endswith("the legs reach 10.3 deg. Inside, 75% of the cells are free of falls.")


def test_an_envelope_without_a_feasible_cell_has_no_share(policy: Policy) -> None:
    measurements = made_up(policy)
    weak = dataclasses.replace(measurements.envelope, authority=2.4)
    text = shown(policy, measurements=dataclasses.replace(measurements, envelope=weak))
    assert "<b>-</b><span>of the feasible envelope free of falls" in text
    assert "deg. No cell lies inside." in text
    assert "nan%" not in text


def test_what_is_said_of_a_policy_is_said_of_its_own_task(policy: Policy) -> None:
    policy = copy.copy(policy)
    values = {"max_incline": 5.5, "fail_tilt": 8.0, "action_max": 0.0025, "ctrl_dt": 0.4}
    task = dataclasses.replace(policy.config.task, action_levels=11, **values)
    policy.config = dataclasses.replace(policy.config, task=task)
    text = shown(policy)
    assert "<span>mean tilt, both axes at 5.5° at once" in text
    assert "from a fall on it counts as 8°. All take the same 11 x 11 actions at 2.5 Hz" in text
    assert "cannot follow: 2.5 mm 2.5 times a second turn the body" in text
    policy = policy.with_action("continuous")
    text = shown(policy)
    assert "All take any height changes up to 2.5 mm, off the grid, at 2.5 Hz" in text


def test_the_pictures_of_a_policy(
    policy: Policy, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []
    for name in ("rollout_figure", "tilt_figure", "envelope_figure"):
        monkeypatch.setattr(
            figures, name, lambda *given, name=name: drawn.append(given) or name.encode()
        )
    monkeypatch.setattr(figures, "svg", lambda figure: figure)
    monkeypatch.setattr(page.alt_texts, "rollout_alt", lambda suite, rollouts: f"of {suite}")

    def record(*given: Any) -> tuple:
        *of, progress = given
        progress(1.0)
        return tuple(of)

    monkeypatch.setattr(measuring, "record_rollout", record)
    measurements = made_up(policy)
    shares_done: list[float] = []
    pictures = page.policy_pictures(policy, scene, measurements, shares_done.append)
    assert shares_done == pytest.approx([0.2, 0.4, 0.6, 0.8]), "drawing takes the last fifth"
    assert [pictures[suite].alt for suite in ("paper", "corner")] == ["of paper", "of corner"]
    assert {name: base64.b64decode(x.svg).decode() for name, x in pictures.items()} == {
        "paper": "rollout_figure",
        "corner": "rollout_figure",
        "tilt": "tilt_figure",
        "envelope": "envelope_figure",
    }
    for suite, given in zip(("paper", "corner"), drawn, strict=False):
        both = {n: (policy, scene, suite, 100.0, 2_000_000, n) for n in ("policy", "pd-imu")}
        assert given == (scene, both), "both on the same scenario"
    shares, edges = drawn[2]
    assert list(shares) == list(measurements.results)
    np.testing.assert_array_equal(shares["none"], measurements.shares["none"]["paper"])
    np.testing.assert_array_equal(edges, measuring.edges(6.0))
    assert drawn[3] == (measurements.envelope, 6.0)


def test_the_video_is_of_a_scenario_that_was_measured(
    policy: Policy, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple] = []

    def recorded(*given: Any) -> Any:
        asked.append(given)
        return types.SimpleNamespace(qpos=np.arange(6.0).reshape(1, 3, 2))

    def write(file: Path, scene: Scene, qpos: np.ndarray, **how: Any) -> None:
        assert qpos.tolist() == [[0, 1], [2, 3], [4, 5]]
        assert how == {"captions": "words", "progress": print, "size": (640, 368), "fps": 10.0}
        file.write_bytes(b"film")

    monkeypatch.setattr(measuring, "record_rollout", recorded)
    monkeypatch.setattr(page.render, "captions", lambda scene, states: "words")
    monkeypatch.setattr(page.render, "write", write)
    assert base64.b64decode(page.video(policy, scene, print)) == b"film"
    assert asked == [(policy, scene, "corner", 8.0, 4_000_000)]


def stage(title: str) -> Any:
    """A stage that nobody watches."""
    return contextlib.nullcontext(lambda share: None)


@pytest.mark.slow
def test_the_first_run_that_has_a_policy_is_shown(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, metrics_line: Any
) -> None:
    asked: list[tuple] = []

    def measured(policy: Policy, scene: Scene, *given: Any) -> Measurements:
        asked.append(given)
        return made_up(policy)

    def no_video(policy: Policy, scene: Scene, bar: Any) -> str:
        raise RenderError("no screen")

    monkeypatch.setattr(measuring, "measure", measured)
    monkeypatch.setattr(page, "policy_pictures", lambda *given: PICTURES)
    monkeypatch.setattr(page, "video", no_video)
    half = tmp_path / "half"
    half.mkdir()
    config = dataclasses.replace(preset("default"), seed=11, num_seeds=2)
    (half / "config.json").write_text(json.dumps(to_dict(config)))
    (half / "metrics.jsonl").write_text(json.dumps(metrics_line(4, 1)))
    other = tmp_path / "other"
    shutil.copytree(run, other)
    out = tmp_path / "out.html"
    totals: list[int] = []
    missing = page.write_report([half, run, other], out, 7, lambda n: totals.append(n) or stage)
    assert asked == [(run / "report.json", 7, stage)]
    assert totals == [5], "two suites, the envelope, figures, video"
    assert "no video: no screen" in missing
    bare, counted = tmp_path / "bare.html", lambda n: totals.append(n) or stage
    assert page.write_report([run], bare, 7, counted, None, False) == []
    assert totals[1] == 4, "nobody has asked for a video, and none is missing"
    assert f"{half / 'policy.safetensors'} is missing" in missing
    text = out.read_text()
    assert "<title>mjx_balance: half, run, other</title>" in text
    assert "mjx-balance train --preset default --seed 11 --num-seeds 2" in text
    seeds = tables(text)[1]
    assert seeds[1][:3] == ["paper", "4", "4 of 32"], "two runs of two seeds, and one of none"
    assert ["seed", "0", "11"] in tables(text)[2], "the first run's config"


def test_the_seeds_of_alike_runs_are_put_together(
    policy: Policy, config: Config, evaluations: Any
) -> None:
    def run_of(name: str, config: Config | None, *tilts: float) -> Run:
        return Run(Path(name), config=config, results=[evaluations(t, t + 1) for t in tilts])

    first = run_of("a", config, 0.1)
    more = run_of("b", dataclasses.replace(config, seed=7, num_seeds=2), 0.4, 0.2)
    dqn = dataclasses.replace(config.dqn, gamma=0.9)
    other = run_of("c", dataclasses.replace(config, dqn=dqn), 5.0)
    unknown = run_of("d", None, 6.0)
    seeds = page.seeds_statistics(first, [other, first, more, unknown])
    table = tables(shown(policy, seeds=seeds))[1]
    heads = "suite|seeds|falls|mean|worst seed|p95|worst seed|max|worst seed"
    assert table[0] == heads.split("|")
    three = ["0.233 (0.100-0.400)", "0.400"]
    assert table[1] == ["paper", "3", "3 of 24", *three * 3]
    assert table[2] == ["corner", "3", "3 of 24", *["1.233 (1.100-1.400)", "1.400"] * 3]
    assert page.seeds_statistics(first, [first, other]) == {}, "one seed needs no statistics"
    sweep = dataclasses.replace(config, num_seeds=2, sweep=("gamma=0.1,0.4",))
    of_sweep = run_of("f", sweep, 0.1, 0.2, 0.3, 0.4)
    assert page.seeds_statistics(of_sweep, [of_sweep]) == {}, "its seeds have other gammas"
    lost = run_of("e", None, 0.1, 0.3)
    alone = page.seeds_statistics(lost, [first, lost])
    assert alone["paper"]["seeds"] == 2, "without its config a run stands alone"
    more.results[0].pop("corner")
    assert list(page.seeds_statistics(first, [first, more])) == ["paper"], "of every seed"


def test_the_config_table_shows_what_differs_from_the_papers() -> None:
    dqn = dataclasses.replace(preset("paper").dqn, gamma=0.77)
    config = dataclasses.replace(preset("paper"), dqn=dqn, seed=3)
    text = page.render_page(BLANK | {"config": page.config_tables(config)})
    (table,) = tables(text)
    assert table == [
        ["field", "preset paper", "this run"],
        ["seed", "0", "3"],
        ["gamma", "0.1", "0.77"],
    ]
    everything = re.findall(r"<details>.*?<pre>(.*?)</pre>", text, re.DOTALL)[0]
    assert json.loads(html.unescape(everything)) == to_dict(config)


def test_the_commands_make_everything_again(policy: Policy) -> None:
    runs = [
        Run(Path("a"), config=preset("default"), policy=policy),
        Run(Path("b b"), policy=policy),
        Run(Path("c")),
    ]
    assert page.commands(runs, Path("out.html"), 8) == [
        "mjx-balance train --preset default --seed 0",
        "mjx-balance evaluate a/policy.safetensors --suite corner",
        "mjx-balance evaluate 'b b/policy.safetensors' --suite corner",
        "mjx-balance report a 'b b' c --out out.html --scenarios 8",
    ]
    assert page.commands(runs[2:], Path("x"), 5, "my rex.toml") == [
        "mjx-balance report c --out x --scenarios 5 --robot 'my rex.toml'"
    ]
    evaluate = page.commands(runs[1:2], Path("x"), 5, "rex.toml")[0]
    assert evaluate == (
        "mjx-balance evaluate 'b b/policy.safetensors' --suite corner --robot rex.toml"
    )
    best = preset("best")
    dqn = dataclasses.replace(best.dqn, gamma=0.77, mirror=False, hidden_sizes=(8, 9))
    command = page.train_command(dataclasses.replace(best, dqn=dqn, num_envs=64, seed=5))
    assert command == (
        "mjx-balance train --preset best --seed 5 --num-envs 64 --gamma 0.77 --hidden-sizes 8 9 "
        "--no-mirror"
    )


def test_the_reward_is_said_to_be_taken_where_it_is(config: Config) -> None:
    for where, words in (("end", "at the decision&#39;s end."), ("mean", "averaged over it.")):
        task = dataclasses.replace(config.task, reward_tilt=where)
        values = page.config_tables(dataclasses.replace(config, task=task))
        text = page.render_page(BLANK | {"config": values, "training": {"reward": PICTURE}})
        assert f"the tilt is taken {words}</p>" in text


def test_an_incomplete_folder_says_what_is_missing_and_shows_the_rest(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("config.json", "metrics.jsonl"):
        shutil.copy(run / name, tmp_path)
    (tmp_path / "evaluation.json").write_text("{ torn")
    assert main(("report", str(tmp_path))) == 0
    said = capsys.readouterr().err
    text = (tmp_path / "report.html").read_text()
    for sentence in ("policy.safetensors is missing", "evaluation.json cannot be used"):
        assert sentence in said
        assert sentence in text
    assert re.findall(r"<h2>(.*?)</h2>", text) == [
        "Missing",
        "Learning curves",
        "Reward (Fig. 4 and 5 of the paper)",
        "Config",
        "Reproduce",
    ]


@pytest.mark.parametrize(
    ("name", "content"), [("config.json", b'{"a": 1}'), ("holiday.jpg", b"\xff\xd8")]
)
def test_a_foreign_folder_is_refused(
    name: str, content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_bytes(content)
    assert main(("report", str(tmp_path))) == 2
    assert "is no run folder: " in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == [name]


HOSTILE = "\"'><img src=x onerror=alert(1)><script>alert(2)</script>{{ 7 * 7 }}"


def test_nothing_that_the_template_is_given_becomes_html(
    policy: Policy, evaluations: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every text that the page is given, but for the fixed names of controllers."""
    statistics = {"seeds": HOSTILE, "falls": HOSTILE, "scenarios": HOSTILE}
    number = {"iqm": 0.0, "low": 0.0, "high": 0.0, "worst": 0.0}
    statistics |= dict.fromkeys(("mean", "p95", "max"), number)
    text = shown(
        policy,
        title=HOSTILE,
        missing=[HOSTILE],
        seeds={HOSTILE: statistics},
        pictures=dict.fromkeys(PICTURES, Picture(HOSTILE, HOSTILE)),
        video=HOSTILE,
        training=dict.fromkeys(("curves", "reward"), Picture(HOSTILE, HOSTILE)),
        config={"differs": [(HOSTILE,) * 3], "reward_tilt": HOSTILE, "everything": HOSTILE},
        commands=[HOSTILE],
        versions=HOSTILE,
    )
    assert text.count("&lt;script&gt;alert(2)") == 26, "every value is there, as text"
    assert "<script" not in text
    assert "<img src=x" not in text
    assert "49" not in re.sub(r"#\w+", "", text), "nor a template"
    assert "\"'>" not in text, "nor ends an attribute"


def test_a_hostile_run_folder_injects_nothing(
    policy: Policy,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    metrics_line: Any,
    evaluation_result: Any,
) -> None:
    """Text in every field that is read, of every file, and in the folder's own name."""
    folder = tmp_path / "<img src=x onerror=alert(1)>"
    folder.mkdir()
    results = {
        HOSTILE: evaluation_result(HOSTILE, 0.1) | {"note": HOSTILE},
        "paper": evaluation_result("paper", 0.1) | {"falls": HOSTILE},
    }
    for name, values in (
        ("evaluation", results),
        ("seeds", {"seeds": [{"evaluation": results}] * 2}),
        ("config", to_dict(preset("default")) | {HOSTILE: 1}),
    ):
        (folder / f"{name}.json").write_text(json.dumps(values))
    lines = [metrics_line(0, 1), metrics_line(1, 1) | {"train/loss": HOSTILE}]
    (folder / "metrics.jsonl").write_text("\n".join(map(json.dumps, lines)))
    (folder / "policy.safetensors").write_text("not used")
    hostile = copy.copy(policy)
    hostile.manifest = policy.manifest | {"versions": {HOSTILE: HOSTILE, "\ud800": "\ud800"}}
    monkeypatch.setattr(reading, "load_policy", lambda path: hostile)
    monkeypatch.setattr(measuring, "measure", lambda *given: made_up(policy))
    monkeypatch.setattr(page, "policy_pictures", lambda *given: PICTURES)
    monkeypatch.setattr(page, "video", lambda *given: "")
    assert main(("report", str(folder))) == 0
    text = (folder / "report.html").read_text()
    assert "<script" not in text
    assert "<img src=x" not in text
    assert "&lt;img src=x onerror=alert(1)&gt;" in text
    said = capsys.readouterr().err
    for name in ("config.json", "evaluation.json", "seeds.json"):
        assert f"{folder / name} cannot be used" in said
    assert "metrics.jsonl is shown up to line 2" in said


def test_a_policy_that_does_not_say_its_versions_is_shown(policy: Policy) -> None:
    policy = copy.copy(policy)
    policy.manifest = {"versions": {"mujoco": "3.17.0", "jax": None, "numpy": "2"}}
    assert page.versions(policy) == "mujoco 3.17.0, numpy 2"
    for versions in ({}, {"versions": None}, {"versions": ["mujoco"]}):
        policy.manifest = versions
        assert page.versions(policy) == ""


@pytest.fixture(scope="module")
def browser() -> str:
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    return found or pytest.skip("no Chromium on this machine; Debian's package is chromium")


def browse(browser: str, page: str, folder: Path, *more: str) -> tuple[str, set[str], Path]:
    """Opens a page; returns what the browser logs, the addresses it asks for, a picture."""
    shot, log = folder / "page.png", folder / "net.json"
    flags = (
        "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-sync "
        "--disable-background-networking --disable-component-update --hide-scrollbars "
        "--enable-logging=stderr --window-size=1280,2400 --virtual-time-budget=8000"
    ).split()
    files = [f"--user-data-dir={folder / 'profile'}", f"--log-net-log={log}"]
    done = subprocess.run(
        [browser, *flags, *more, *files, f"--screenshot={shot}", page],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    # Chromium also asks its maker for updates and the time; that is not the page's doing.
    lines = [line for line in log.read_text().splitlines() if ISOLATED in line]
    asked = {url for line in lines for url in re.findall(r'"url":"(https?://[^"]*)"', line)}
    return done.stderr, asked, shot


@pytest.mark.slow
@pytest.mark.browser
def test_a_browser_shows_it_without_errors_or_requests(
    browser: str, written: Path, tmp_path: Path
) -> None:
    said, asked, shot = browse(browser, written.as_uri(), tmp_path)
    assert "CONSOLE" not in said, said
    assert not asked
    picture = np.asarray(imageio.imread(shot))
    assert picture.shape[:2] == (2400, 1280)
    assert len(np.unique(picture.reshape(-1, picture.shape[-1]), axis=0)) > 500, "it is not blank"


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.parametrize("dark", [False, True])
def test_a_dark_page_is_dark_with_its_figures(
    browser: str, written: Path, tmp_path: Path, dark: bool
) -> None:
    flags = ("--blink-settings=preferredColorScheme=0",) if dark else ()
    *_, shot = browse(browser, written.as_uri(), tmp_path, *flags)
    brightness = np.asarray(imageio.imread(shot))[..., :3].mean(axis=-1)
    bright = (brightness > 128).mean()
    assert bright < 0.2 if dark else bright > 0.8


@pytest.mark.slow
@pytest.mark.browser
def test_no_page_is_wider_than_a_phone(browser: str, written: Path, tmp_path: Path) -> None:
    """Tables and figures scroll in boxes of their own."""
    frame, wide = tmp_path / "phone.html", "<p style='width: 500px'>wide</p>"
    for text, width in ((written.read_text(), "390"), (wide, "508")):
        frame.write_text(
            "<title></title><style>iframe { border: 0 }</style><iframe width=390 height=800 "
            "onload='document.title = this.contentDocument.documentElement.scrollWidth' "
            f'srcdoc="{html.escape(text)}"></iframe>'
        )
        profile = f"--user-data-dir={tmp_path / 'profile'}"
        flags = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--dump-dom")
        command = [browser, *flags, profile, frame.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        assert re.findall("<title>(.*?)</title>", done.stdout)[0] == width


@pytest.mark.slow
@pytest.mark.browser
def test_the_browser_check_can_fail(browser: str, tmp_path: Path) -> None:
    """A page that asks for a picture and throws is noticed."""
    bad = tmp_path / "bad.html"
    bad.write_text("<img src='http://127.0.0.1:9/x.png'><script>throw Error('boo')</script>")
    said, asked, _ = browse(browser, bad.as_uri(), tmp_path)
    assert "CONSOLE" in said
    assert "http://127.0.0.1:9/x.png" in asked
