"""Tables for a terminal, and one self-contained HTML page about runs. No JAX."""

import base64
import dataclasses
import hashlib
import html
import io
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from mjx_balance import baselines, figures, render
from mjx_balance.baselines import CONTROLLERS, make_controller
from mjx_balance.config import Config, check, flatten, from_dict, preset, to_dict
from mjx_balance.evaluation import (
    Controller,
    Envelope,
    envelope,
    observing,
    policy_scene,
    run_suite,
    summarize,
)
from mjx_balance.policy import Policy, PolicyError, load_policy
from mjx_balance.scene import Scene
from mjx_balance.statistics import TILTS, over_seeds
from mjx_balance.suites import HEADLINE, SEEDS

DURATION = 60.0
ENVELOPE_SCENARIOS = 2
ENVELOPE_DURATION = 30.0
VIDEO_SECONDS = 12.0
EDGES = np.concatenate(([0.0], np.geomspace(0.01, 6.0, 160), [6.0001]))
"""Bins of the tilt distribution, deg."""
CACHE = "report.json"
FOREIGN = (ValueError, KeyError, TypeError, AttributeError)
"""What reading JSON that a run did not write may raise."""
PARTS = ("config.json", "metrics.jsonl", "policy.safetensors", "evaluation.json")


class ReportError(ValueError):
    """A report that cannot be made; the message says why."""


def evaluation_table(results: dict[str, dict[str, Any]]) -> Table:
    """A table for people, 80 columns: one row per suite."""
    title = "plain MuJoCo, tilt in deg over every physics step"
    table = _suites_table(title)
    shown = ("mean", "p50", "p95", "p99", "max")
    for name in ("scenarios", "falls", *shown, "act mm"):
        table.add_column(name, justify="right", no_wrap=True)
    for suite, result in results.items():
        tilt = result["tilt_deg"]
        table.add_row(
            suite,
            f"{result['scenarios']} x {result['duration_s']:g} s",
            str(result["falls"]),
            *(f"{tilt[name]:.3f}" for name in shown),
            f"{result['action_mm_mean']:.3f}",
        )
    return table


def _suites_table(title: str) -> Table:
    """One row per suite, its name in the first column; narrow."""
    table = Table(
        title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    table.add_column("suite", style="bold", no_wrap=True)
    return table


def seeds_table(summary: dict[str, dict[str, Any]]) -> Table:
    """A table for people, 80 columns: one row per suite, interquartile means over the seeds."""
    seeds = max(row["seeds"] for row in summary.values())
    title = f"{seeds} seeds: interquartile mean, 95% bootstrap interval, tilt in deg"
    table = _suites_table(title)
    for name in ("falls", *TILTS):
        table.add_column(name, justify="right", no_wrap=True)
    for suite, row in summary.items():
        table.add_row(suite, str(row["falls"]), *(spread(row[name]) for name in TILTS))
    return table


def spread(value: dict[str, float]) -> str:
    """An interquartile mean and its interval, e.g. `0.081 (0.079-0.084)`."""
    return f"{value['iqm']:.3f} ({value['low']:.3f}-{value['high']:.3f})"


def print_summary(
    console: Console, run_dir: Path, results: dict[str, dict[str, Any]], seconds: float
) -> None:
    """Says how the run went and where everything is."""
    console.print(evaluation_table(results))
    for name, what in (
        ("policy.safetensors", "the policy; `mjx-balance evaluate` runs it"),
        ("evaluation.json", "the table above"),
        ("figures/", "learning curves, rewards, 100 s on the board"),
        ("metrics.jsonl", "every logged number; tensorboard/ has them too"),
        ("checkpoints/", "the whole training state"),
    ):
        console.print(f"{run_dir / name}  [dim]{what}[/dim]", highlight=False, soft_wrap=True)
    console.print(f"`mjx-balance report {run_dir}` makes a page of it", highlight=False)
    console.print(f"done in {seconds:.0f} s", highlight=False)


@dataclasses.dataclass
class Run:
    """What could be read of a run folder."""

    path: Path
    missing: list[str] = dataclasses.field(default_factory=list)
    """One sentence per part that is missing or unusable."""
    config: Config | None = None
    metrics: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    policy: Policy | None = None
    results: list[dict[str, dict[str, Any]]] = dataclasses.field(default_factory=list)
    """The run's own evaluation, suite -> JSON, of each of its seeds."""


def read_run(path: Path) -> Run:
    """Reads what there is.

    Raises:
      ReportError: if there is no folder, or nothing of a run in it.
    """
    if not path.is_dir():
        raise ReportError(f"{path} is no folder; `mjx-balance train` makes one for each run")
    if not any((path / name).is_file() for name in PARTS):
        raise ReportError(
            f"{path} is no run folder: it has none of {', '.join(PARTS)}; "
            "`mjx-balance train` makes one"
        )
    run = Run(path)

    def read(name: str, parse: Callable[[Path], Any]) -> Any:
        file = path / name
        if not file.is_file():
            run.missing.append(f"{file} is missing")
            return None
        try:
            return parse(file)
        except (*FOREIGN, OSError) as error:
            run.missing.append(f"{file} cannot be used: {_why(error)}")
            return None

    run.config = read("config.json", lambda f: check(from_dict(Config, json.loads(f.read_text()))))
    run.metrics = read("metrics.jsonl", lambda f: _read_metrics(f, run.missing)) or []
    run.policy = read("policy.safetensors", load_policy)
    own = read("evaluation.json", lambda f: _checked(json.loads(f.read_text())))
    run.results = [own] if own else []
    if (path / "seeds.json").is_file():
        run.results = read("seeds.json", _read_seeds) or run.results
    if not (run.config or run.metrics or run.policy or run.results):
        raise ReportError(f"{path} is no run folder: {'; '.join(run.missing)}")
    return run


def _why(error: Exception) -> str:
    return f"it has no {error}" if isinstance(error, KeyError) else str(error)


def _read_metrics(file: Path, missing: list[str]) -> list[dict[str, Any]]:
    """The lines up to the first that cannot be used, as a crash leaves one."""
    lines: list[dict[str, Any]] = []
    texts = file.read_text().splitlines()
    if not texts:
        raise ValueError("it holds no line yet")
    for number, text in enumerate(texts, 1):
        try:
            line = json.loads(text)
            for name in ("env_steps", *(name for name, _, _ in figures.CURVES)):
                float(line[name])
            seeds = {name: len(values) for name, values in line.get("seeds", {}).items()}
            if lines and seeds != {name: len(x) for name, x in lines[0].get("seeds", {}).items()}:
                raise ValueError("other seeds than in line 1")
        except FOREIGN as error:
            why = _why(error)
            missing.append(f"{file} is shown up to line {number}, which cannot be used: {why}")
            break
        lines.append(line)
    return lines


def _read_seeds(file: Path) -> list[dict[str, dict[str, Any]]]:
    return [_checked(row["evaluation"]) for row in json.loads(file.read_text())["seeds"]]


def _checked(results: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Returns a run's evaluation if it has what the report takes from it."""
    for result in results.values():
        over_seeds([result])
    return results


def write_report(
    run_dirs: Sequence[Path],
    out: Path,
    scenarios: int,
    progress: Callable[[str], Any],
) -> list[str]:
    """Writes one HTML file that needs nothing else.

    The first run that has a policy is shown beside the baselines, on scenarios of the
    report's own; what that takes is kept in its folder (`report.json`).

    Args:
      run_dirs: run folders, whole or not.
      out: file to write.
      scenarios: per suite and controller.
      progress: title -> context manager that gives a callable taking the share done.

    Returns:
      What is missing, one sentence each.

    Raises:
      ReportError: for a folder that is no run folder.
    """
    runs = [read_run(path) for path in run_dirs]
    missing = [sentence for run in runs for sentence in run.missing]
    parts = []
    shown = next((run for run in runs if run.policy is not None), None)
    if shown is not None and shown.policy is not None:
        try:
            scene = policy_scene(shown.policy)
            data = _measure(shown, scene, scenarios, progress)
            parts += _summary(shown.policy, data) + _seeds(shown, runs)
            parts += _pictures(shown.policy, scene, data, missing)
        except PolicyError as error:
            missing.append(f"{shown.path}: {error}")
    curves = [run.metrics for run in runs if run.metrics]
    if curves:
        caption = (
            "Training. The line is the median over runs and seeds, the band their extremes; tilt, "
            "falls and reward are those of the exploring policy."
        )
        parts.append(_figure("Learning curves", figures.learning_curves(curves), caption))
    config = next((run.config for run in runs if run.config is not None), None)
    if config is not None:
        reward = figures.reward_figure(config.task)
        parts.append(_figure("Reward (Fig. 4 and 5 of the paper)", reward, _reward_caption(config)))
        parts.append(_config(config))
    parts.append(_reproduce(runs, out))
    notes = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in missing)
    if notes:
        parts.insert(0, f'<section class="missing"><h2>Missing</h2><ul>{notes}</ul></section>')
    names = ", ".join(run.path.name for run in runs)
    page = PAGE.format(title=html.escape(f"mjx_balance: {names}"), body="\n".join(parts))
    out.write_text(page)
    return missing


def baselines_digest() -> str:
    """Digest of the baselines' source: with it, what was measured of them holds."""
    return hashlib.sha256(Path(baselines.__file__).read_bytes()).hexdigest()[:8]


def _measure(
    run: Run, scene: Scene, scenarios: int, progress: Callable[[str], Any]
) -> dict[str, Any]:
    """Policy and baselines on the same scenarios; read back if it was done before."""
    assert run.policy is not None
    config, file = run.policy.config, run.path / CACHE
    key = [run.policy.fingerprint, scene.hash, baselines_digest()]
    key += [scenarios, DURATION, SEEDS.report, ENVELOPE_SCENARIOS, ENVELOPE_DURATION]
    try:
        saved = json.loads(file.read_text())
        if saved["key"] == key:
            return saved
    except (*FOREIGN, OSError):
        pass
    data: dict[str, Any] = {"key": key, "results": {}, "histogram": {}}
    for name in ("policy", *CONTROLLERS):
        data["results"][name], data["histogram"][name] = {}, {}
        for suite in HEADLINE:
            controller = (
                observing(run.policy) if name == "policy" else make_controller(name, scene, config)
            )
            with progress(f"{name}, suite {suite}") as bar:
                rollout = run_suite(
                    scene, config, controller, suite, scenarios, DURATION, SEEDS.report, bar
                )
            data["results"][name][suite] = summarize(rollout, suite, DURATION, SEEDS.report)
            counts, _ = np.histogram(rollout.tilt, EDGES)
            data["histogram"][name][suite] = (counts / counts.sum()).tolist()
    with progress("envelope") as bar:
        mapped = envelope(
            scene,
            config,
            observing(run.policy),
            ENVELOPE_SCENARIOS,
            ENVELOPE_DURATION,
            SEEDS.report,
            bar,
        )
    data["envelope"] = dataclasses.asdict(mapped)
    file.write_text(json.dumps(data) + "\n")
    return data


def _summary(policy: Policy, data: dict[str, Any]) -> list[str]:
    """Headline figures and the table against the baselines."""
    results = data["results"]
    mapped = Envelope(**data["envelope"])
    ours = results["policy"]
    tiles = [
        (f"{ours['paper']['tilt_deg']['mean']:.3f}°", "mean tilt, targets in any direction"),
        (f"{ours['corner']['tilt_deg']['mean']:.3f}°", "mean tilt, both axes at 7° at once"),
        (
            str(ours["paper"]["falls"] + ours["corner"]["falls"]),
            f"falls in {2 * ours['paper']['scenarios']} scenarios of {DURATION:g} s",
        ),
        (f"{100 * mapped.fall_free_share:.0f}%", "of the feasible envelope free of falls"),
    ]
    shown = "".join(f"<div><b>{value}</b><span>{what}</span></div>" for value, what in tiles)
    described = {
        "policy": f"this network: {policy.observation_size} inputs",
        "none": "stands still",
        "pd-imu": "PD on a complementary filter of the same IMU",
        "pd-attitude": "PD on the true attitude",
        "rate-oracle": "predictive, true attitude and board rate",
        "clairvoyant": "predictive, knows the board's future",
    }
    rows = []
    for name, suites in results.items():
        cells = [f"<td><b>{name}</b></td><td>{described[name]}</td>"]
        for suite in HEADLINE:
            result, tilt = suites[suite], suites[suite]["tilt_deg"]
            cells.append(f"<td>{result['falls']}</td>")
            cells += [f"<td>{tilt[key]:.3f}</td>" for key in ("mean", "p95", "max")]
        settled = suites["paper"]["action_mm_settled"]
        cells.append("<td>-</td>" if settled is None else f"<td>{settled:.3f}</td>")
        mark = ' class="ours"' if name == "policy" else ""
        rows.append(f"<tr{mark}>{''.join(cells)}</tr>")
    count = ours["paper"]["scenarios"]
    return [
        f'<div class="tiles">{shown}</div>',
        "<section><h2>Against the baselines</h2><table><thead><tr><th rowspan=2></th>"
        "<th rowspan=2>sees</th><th colspan=4>suite <i>paper</i></th><th colspan=4>suite <i>"
        "corner</i></th><th rowspan=2>moves at rest<br>mm</th></tr><tr>"
        + "<th>falls</th><th>mean</th><th>p95</th><th>max</th>"
        * 2
        + f"</tr></thead><tbody>{''.join(rows)}</tbody></table><p>Plain MuJoCo, {count} held-out "
        f"scenarios of {DURATION:g} s per suite (seed {SEEDS.report}), tilt in degrees over every "
        "physics step; from a fall on it counts as 6°. All take the same 21 x 21 actions at 5 Hz. "
        "The last column is the mean height change commanded per decision in the last 3 s of each period. "
        "The paper gives no figures; it reports a high peak of the tilt when the board turns on "
        "both axes at once, and that its controller cannot handle that.</p></section>",
    ]


def _seeds(shown: Run, runs: list[Run]) -> list[str]:
    """The table over the training seeds of `shown` and of the runs that differ in seed alone."""

    def recipe(run: Run) -> Config | None:
        return run.config and dataclasses.replace(run.config, seed=0, num_seeds=1)

    alike = [run for run in runs if run is shown or (run.config and recipe(run) == recipe(shown))]
    each = [result for run in alike for result in run.results]
    shared = [suite for suite in HEADLINE if all(suite in result for result in each)]
    if len(each) < 2 or not shared:
        return []
    statistics = {suite: over_seeds([result[suite] for result in each]) for suite in shared}
    rows = "".join(
        f"<tr><td><b>{suite}</b></td><td>{row['seeds']}</td><td>{row['falls']} of "
        f"{row['scenarios']}</td>"
        + "".join(
            f"<td>{spread(row[name])}</td><td>{row[name]['worst']:.3f}</td>" for name in TILTS
        )
        + "</tr>"
        for suite, row in statistics.items()
    )
    heads = "".join(f"<th>{name}</th><th>worst seed</th>" for name in TILTS)
    return [
        "<section><h2>Over the training seeds</h2><table><thead><tr><th>suite</th><th>seeds</th>"
        f"<th>falls</th>{heads}</tr></thead><tbody>{rows}</tbody></table><p>Interquartile mean "
        "over the seeds and its 95% bootstrap interval, tilt in degrees, each run's own evaluation."
        "</p></section>"
    ]


def _pictures(policy: Policy, scene: Scene, data: dict[str, Any], missing: list[str]) -> list[str]:
    config = policy.config
    both: dict[str, Controller] = {
        "policy": observing(policy),
        "pd-imu": make_controller("pd-imu", scene, config),
    }
    parts = []
    for suite, what in (
        ("paper", "targets in any direction"),
        ("corner", "both axes at once, the case the paper's controller cannot handle"),
    ):
        figure = figures.rollout_figure(scene, config, both, suite)
        caption = f"The paper's Fig. 7 for suite {suite} ({what}), beside the PD on the same IMU."
        parts.append(_figure(f"100 s on the board: {suite}", figure, caption))
    shares = {name: np.asarray(h["paper"]) for name, h in data["histogram"].items()}
    parts.append(
        _figure(
            "Tilt distribution",
            figures.tilt_figure(shares, EDGES),
            "Suite paper, every physics step of every scenario.",
        )
    )
    mapped = Envelope(**data["envelope"])
    caption = (
        f"Targets on both axes at once, {mapped.scenarios} scenarios of {mapped.duration_s:g} s "
        f"per cell. Right of or above the dashed line the action set cannot follow: 3 mm five "
        f"times a second turn the body at {mapped.authority:.2f} deg/s in pitch, and the legs "
        f"reach {mapped.reach:.1f} deg. Inside, {100 * mapped.fall_free_share:.0f}% of the cells "
        "are free of falls."
    )
    parts.append(
        _figure("Envelope", figures.envelope_figure(mapped, config.task.fail_tilt), caption)
    )
    rollout = run_suite(
        scene, config, observing(policy), "corner", 1, VIDEO_SECONDS, SEEDS.report, record=True
    )
    assert rollout.qpos is not None
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "video.mp4"
        try:
            render.write(video, config, rollout.qpos[0])
        except render.RenderError as error:
            missing.append(f"no video: {error}")
        else:
            encoded = base64.b64encode(video.read_bytes()).decode()
            parts.append(
                '<section><h2>Video</h2><video controls muted loop preload="auto" '
                f'src="data:video/mp4;base64,{encoded}"></video><p>{VIDEO_SECONDS:g} s of suite '
                "corner in plain MuJoCo, at real speed.</p></section>"
            )
    return parts


def _figure(title: str, figure: plt.Figure, caption: str) -> str:
    """A figure as part of the page."""
    buffer = io.BytesIO()
    figure.savefig(buffer, bbox_inches="tight")
    plt.close(figure)
    encoded = base64.b64encode(buffer.getvalue()).decode()
    return (
        f'<section><h2>{html.escape(title)}</h2><img alt="{html.escape(title)}" '
        f'src="data:image/png;base64,{encoded}"><p>{html.escape(caption)}</p></section>'
    )


def _reward_caption(config: Config) -> str:
    where = "at the decision's end" if config.task.reward_tilt == "end" else "averaged over it"
    return f"The reward of one decision; the tilt is taken {where}."


def _config(config: Config) -> str:
    """What differs from the paper's preset, and everything."""
    ours, papers = (flatten(to_dict(c)) for c in (config, preset("paper")))
    rows = "".join(
        f"<tr><td><code>{name}</code></td><td>{html.escape(str(papers[name]))}</td>"
        f"<td>{html.escape(str(value))}</td></tr>"
        for name, value in ours.items()
        if value != papers[name]
    )
    everything = html.escape(json.dumps(to_dict(config), indent=2))
    return (
        "<section><h2>Config</h2><table><thead><tr><th>field</th><th>preset <i>paper</i></th>"
        f"<th>this run</th></tr></thead><tbody>{rows}</tbody></table><details><summary>every field"
        f"</summary><pre>{everything}</pre></details></section>"
    )


def _reproduce(runs: list[Run], out: Path) -> str:
    lines = [_train_command(run.config) for run in runs if run.config is not None]
    for run in runs:
        if run.policy is not None:
            lines.append(f"mjx-balance evaluate {run.path / 'policy.safetensors'} --suite corner")
    lines.append(f"mjx-balance report {' '.join(str(run.path) for run in runs)} --out {out}")
    policy = next((run.policy for run in runs if run.policy is not None), None)
    versions = ""
    if policy is not None:
        listed = ", ".join(f"{k} {v}" for k, v in policy.manifest["versions"].items() if v)
        versions = f"<p>Versions of the training: {html.escape(listed)}.</p>"
    commands = html.escape("\n".join(lines))
    return f"<section><h2>Reproduce</h2><pre>{commands}</pre>{versions}</section>"


def _train_command(config: Config) -> str:
    """The command that trains with this config."""
    theirs = flatten(to_dict(preset(config.preset)))
    words = [f"mjx-balance train --preset {config.preset} --seed {config.seed}"]
    for name, value in flatten(to_dict(config)).items():
        if value == theirs[name] or name == "seed":
            continue
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            some = value if isinstance(value, list) else [value]
            words.append(" ".join([f"--{flag}", *map(str, some)]))
    return " ".join(words)


PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>
:root {{ color-scheme: light; }}
body {{ margin: 0 auto; padding: 2.5rem 1.5rem 4rem; max-width: 68rem; background: #fff;
  color: #1c2430; font: 16px/1.55 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }}
h1 {{ font-size: 1.7rem; margin: 0 0 1.2rem; }}
h2 {{ font-size: 1.15rem; margin: 0 0 .7rem; }}
section {{ margin: 2.6rem 0 0; overflow-x: auto; }}
p {{ color: #4b5768; font-size: .92rem; max-width: 58rem; }}
img, video {{ max-width: 100%; height: auto; display: block; }}
video {{ width: 48rem; border-radius: 6px; }}
table {{ border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }}
th, td {{ padding: .32rem .7rem; text-align: right; border-bottom: 1px solid #e3e8ef; }}
th {{ font-weight: 600; color: #4b5768; }}
td:first-child, td:nth-child(2), tr:first-child th:nth-child(-n+2) {{ text-align: left; }}
td:first-child {{ white-space: nowrap; }}
tr.ours td {{ background: #eaf2fb; }}
.tiles {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(13rem, 1fr)); gap: 1rem; }}
.tiles div {{ background: #f4f7fa; border-radius: 8px; padding: 1rem 1.2rem; }}
.tiles b {{ display: block; font-size: 1.75rem; color: #2166ac; }}
.tiles span {{ font-size: .88rem; color: #4b5768; }}
.missing {{ background: #fff6e5; border-radius: 8px; padding: 1rem 1.2rem; }}
pre {{ background: #f4f7fa; border-radius: 6px; padding: .9rem 1.1rem; overflow-x: auto;
  font-size: .85rem; }}
summary {{ cursor: pointer; margin-top: .8rem; }}
</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""
