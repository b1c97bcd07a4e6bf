"""The HTML report: complete, honest about what is missing, and quiet in a browser."""

import dataclasses
import io
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
from rich.console import Console

from mjx_balance.cli import main
from mjx_balance.config import Config, preset, to_dict
from mjx_balance.policy import make_manifest, save_policy
from mjx_balance.report import figures, measuring, page, reading, tables
from mjx_balance.scene import Scene

ISOLATED = '"network_isolation_key":"file://'
"""How Chromium's network log marks what a page from disk asks for."""
SHORTER = {
    "DURATION": 3.0,
    "ENVELOPE_SCENARIOS": 1,
    "ENVELOPE_DURATION": 1.0,
    "RECORD_SECONDS": 12.0,
    "VIDEO_SECONDS": 1.0,
}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def metrics_line(k: int, seeds: int) -> dict[str, Any]:
    names = "tilt_deg falls_per_minute reward loss epsilon".split()
    line: dict[str, Any] = {"env_steps": 1024 * (k + 1), "gradient_steps": k}
    line |= {f"train/{name}": 1 / (k + 1) for name in names}
    line |= {"perf/env_steps_per_second": 500.0, "perf/physics_steps_per_second": 25_000.0}
    if seeds > 1:
        values = [(n + 1) / (k + 1) for n in range(seeds)]
        line["seeds"] = dict.fromkeys(("tilt_deg", "reward", "loss"), values)
    return line


def evaluation_result(suite: str, tilt: float) -> dict[str, Any]:
    keys = ("mean", "rms", "p50", "p95", "p99", "max")
    return {"suite": suite, "scenarios": 8, "falls": 1, "tilt_deg": dict.fromkeys(keys, tilt)}


@pytest.fixture(scope="module")
def run(config: Config, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of two seeds with everything in it; the policy is untrained."""
    folder = tmp_path_factory.mktemp("report") / "run"
    folder.mkdir()
    config = dataclasses.replace(config, num_seeds=2)
    (folder / "config.json").write_text(json.dumps(to_dict(config)))
    lines = [json.dumps(metrics_line(k, 2)) for k in range(8)]
    (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    results = {suite: evaluation_result(suite, 0.1) for suite in ("paper", "corner")}
    (folder / "evaluation.json").write_text(json.dumps(results))
    rows = [
        {"evaluation": {suite: evaluation_result(suite, t) for suite in ("paper", "corner")}}
        for t in (0.1, 0.2)
    ]
    (folder / "seeds.json").write_text(json.dumps({"seeds": rows}))
    layers: dict[str, Any] = {
        name: {"kernel": np.zeros((a, b)), "bias": np.zeros(b)}
        for name, a, b in (("hidden_0", 34, 64), ("hidden_1", 64, 64), ("head", 98, 3))
    }
    layers |= {"profile": np.zeros(4), "stretch": np.zeros(2)}
    manifest = make_manifest(config, scene.hash, {})
    save_policy(folder / "policy.safetensors", {"params": layers}, manifest)
    return folder


@pytest.fixture(scope="module")
def written(run: Path) -> Path:
    """The report on that folder, by the command."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in SHORTER.items():
            patch.setattr(measuring, name, value)
        assert main(("report", str(run), "--scenarios", "2")) == 0
    return run / "report.html"


def test_everything_is_there(written: Path) -> None:
    text = written.read_text()
    titles = re.findall(r"<h2>(.*?)</h2>", text)
    expected = (
        "Against the baselines|Over the training seeds|12 s on the board: paper|"
        "12 s on the board: corner|Tilt distribution|Envelope|Video|Learning curves|"
        "Reward (Fig. 4 and 5 of the paper)|Config|Reproduce"
    )
    assert titles == expected.split("|"), "nothing is missing"
    for name in ("none", "pd-imu", "pd-attitude", "rate-oracle", "clairvoyant"):
        assert f"<b>{name}</b>" in text
    assert "mjx-balance train --preset default --seed 0 " in text
    assert " --num-seeds 2" in text
    assert "<td>0.150 (0.100-0.200)</td><td>0.200</td>" in text, "over the two seeds"
    assert text.count("data:image/png;base64,") == 6
    assert "data:video/mp4;base64," in text


def test_the_page_needs_nothing_from_elsewhere(written: Path) -> None:
    text = re.sub(r'"data:[^"]*"', '""', written.read_text())
    assert not re.findall(r"(?:src|href)=\"[^\"]+\"", text)
    assert "http" not in text
    assert "<script" not in text


def test_measurements_are_kept_and_read_back(
    run: Path, written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = json.loads((run / "report.json").read_text())
    for suites in data["results"].values():
        assert {r["scenarios"] for r in suites.values()} == {2}
    for suites in data["shares"].values():
        for share in suites.values():
            assert sum(share) == pytest.approx(1.0)
    shutil.copy(run / "policy.safetensors", tmp_path)
    data["results"]["pd-imu"]["corner"]["tilt_deg"]["p95"] = 0.424
    (tmp_path / "report.json").write_text(json.dumps(data))
    for name, value in SHORTER.items():
        monkeypatch.setattr(measuring, name, value)
    assert main(("report", str(tmp_path), "--scenarios", "2")) == 0
    assert "<td>0.424</td>" in (tmp_path / "report.html").read_text()


def test_an_incomplete_folder_says_what_is_missing_and_shows_the_rest(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    half = tmp_path / "half"
    half.mkdir()
    shutil.copy(run / "config.json", half)
    shutil.copy(run / "metrics.jsonl", half)
    (half / "evaluation.json").write_text("{ torn")
    assert main(("report", str(half))) == 0
    said = capsys.readouterr().err
    assert "policy.safetensors is missing" in said
    assert "evaluation.json cannot be used" in said
    text = (half / "report.html").read_text()
    assert "policy.safetensors is missing" in text
    assert "<h2>Learning curves</h2>" in text
    assert "<h2>Config</h2>" in text


GOOD_LINE = json.dumps(metrics_line(0, 1))


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("config.json", "[]", "config.json cannot be used: Config is []; it must map"),
        ("config.json", '{"task": []}', "config.json cannot be used: TaskConfig is []"),
        ("config.json", '{"dqn": {"gamma": "x"}}', "gamma is 'x'; it must be a number"),
        ("metrics.jsonl", f'{GOOD_LINE}\n{{"env_st', "metrics.jsonl is shown up to line 2"),
        ("metrics.jsonl", f'{GOOD_LINE}\n{{"env_steps": 9}}', "it has no 'train/tilt_deg'"),
        ("metrics.jsonl", f"{GOOD_LINE}\n5", "metrics.jsonl is shown up to line 2"),
        ("seeds.json", '{"best": 1}', "seeds.json cannot be used: it has no 'seeds'"),
        ("seeds.json", "[1]", "seeds.json cannot be used"),
        ("evaluation.json", '{"paper": {"falls": 0}}', "evaluation.json cannot be used: it has no"),
        ("evaluation.json", '{"paper": 1}', "evaluation.json cannot be used"),
    ],
)
def test_contents_that_are_not_a_runs_are_named_and_the_rest_is_read(
    tmp_path: Path, name: str, content: str, said: str
) -> None:
    (tmp_path / "metrics.jsonl").write_text(f"{GOOD_LINE}\n")
    (tmp_path / name).write_text(content)
    run = reading.read_run(tmp_path)
    assert said in "\n".join(run.missing)
    assert run.metrics == [metrics_line(0, 1)]


def test_metrics_without_a_line_are_said(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "metrics.jsonl").write_text("")
    said = "\n".join(reading.read_run(tmp_path).missing)
    assert "metrics.jsonl cannot be used: it holds no line yet" in said


def test_a_folder_with_somebody_elses_config_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "config.json").write_text('{"a": 1}')
    assert main(("report", str(tmp_path))) == 2
    assert "is no run folder: " in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["config.json"]


def test_runs_that_log_at_other_intervals_share_one_axis() -> None:
    often = [metrics_line(k, 1) for k in range(8)]
    figure = figures.learning_curves([often, often[1::2]])
    line = figure.axes[0].get_lines()[0]
    np.testing.assert_allclose(np.asarray(line.get_xdata()), 1.024 * np.arange(1, 9))
    both = np.asarray(line.get_ydata())[1::2]
    np.testing.assert_allclose(both, [m["train/tilt_deg"] for m in often[1::2]])


def test_the_command_gives_every_field_that_the_preset_does_not() -> None:
    best = preset("best")
    dqn = dataclasses.replace(best.dqn, gamma=0.77, mirror=False, hidden_sizes=(8, 9))
    command = page.train_command(dataclasses.replace(best, dqn=dqn, num_envs=64))
    assert command == (
        "mjx-balance train --preset best --seed 0 --num-envs 64 --gamma 0.77 --hidden-sizes 8 9 "
        "--no-mirror"
    )


def test_tables_fit_an_80_column_terminal() -> None:
    spread = {"iqm": 0.0684, "low": 0.0677, "high": 1.0687}
    row = {"seeds": 5, "falls": 1280, "mean": spread, "p95": spread, "max": spread}
    out = io.StringIO()
    console = Console(width=80, file=out)
    console.print(tables.seeds_table({"friction": row}))
    result = evaluation_result("friction", 0.1) | {"scenarios": 100_000, "duration_s": 60.0}
    console.print(tables.evaluation_table({"friction": result | {"action_mm_mean": 0.2}}))
    text = out.getvalue()
    assert text.count("0.068 (0.068-1.069)") == 3
    assert "100000 x 60 s" in text
    assert "…" not in text


def test_a_foreign_folder_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "holiday.jpg").write_bytes(b"\xff\xd8")
    assert main(("report", str(tmp_path))) == 2
    assert "is no run folder" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["holiday.jpg"]


def browse(browser: str, page: str, folder: Path) -> tuple[str, set[str], Path]:
    """Opens a page; returns what the browser logs, the addresses it asks for, a picture."""
    shot, log = folder / "page.png", folder / "net.json"
    flags = (
        "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-sync "
        "--disable-background-networking --disable-component-update --hide-scrollbars "
        "--enable-logging=stderr --window-size=1280,2400 --virtual-time-budget=8000"
    ).split()
    files = [f"--user-data-dir={folder / 'profile'}", f"--log-net-log={log}"]
    done = subprocess.run(
        [browser, *flags, *files, f"--screenshot={shot}", page],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    # Chromium also asks its maker for updates and the time; that is not the page's doing.
    lines = [line for line in log.read_text().splitlines() if ISOLATED in line]
    asked = {url for line in lines for url in re.findall(r'"url":"(https?://[^"]*)"', line)}
    return done.stderr, asked, shot


@pytest.mark.browser
def test_a_browser_shows_it_without_errors_or_requests(written: Path, tmp_path: Path) -> None:
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip("no Chromium on this machine; Debian's package is chromium")
    said, asked, shot = browse(browser, written.as_uri(), tmp_path)
    assert "CONSOLE" not in said, said
    assert not asked
    picture = np.asarray(imageio.imread(shot))
    assert picture.shape[:2] == (2400, 1280)
    assert len(np.unique(picture.reshape(-1, picture.shape[-1]), axis=0)) > 500, "it is not blank"


@pytest.mark.browser
def test_the_browser_check_can_fail(tmp_path: Path) -> None:
    """A page that asks for a picture and throws is noticed."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip("no Chromium on this machine; Debian's package is chromium")
    bad = tmp_path / "bad.html"
    bad.write_text("<img src='http://127.0.0.1:9/x.png'><script>throw Error('boo')</script>")
    said, asked, _ = browse(browser, bad.as_uri(), tmp_path)
    assert "CONSOLE" in said
    assert "http://127.0.0.1:9/x.png" in asked
