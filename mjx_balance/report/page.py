"""A self-contained HTML page about runs, from the template beside this file."""

import base64
import dataclasses
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np

from mjx_balance.config import Config, ConfigError, TaskConfig, flatten, preset, to_dict
from mjx_balance.evaluation.envelope import Envelope
from mjx_balance.evaluation.rollout import policy_scene
from mjx_balance.evaluation.statistics import TILTS, over_seeds
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.evaluation.summary import SETTLED_SECONDS
from mjx_balance.files.run_folder import RunFolder, write_atomically
from mjx_balance.policy.file import Policy, PolicyError
from mjx_balance.render import drawing as render
from mjx_balance.report import figures, measuring
from mjx_balance.report.measuring import Measurements
from mjx_balance.report.reading import Run, read_run
from mjx_balance.report.tables import spread
from mjx_balance.sim.scene import Scene

TEMPLATE = "page.html"
BASELINE_INPUTS = {
    "none": "stands still",
    "pd-imu": "PD on a complementary filter of the same IMU",
    "pd-attitude": "PD on the true attitude",
    "rate-oracle": "predictive, true attitude and board rate",
    "clairvoyant": "predictive, knows the board's future",
}
"""What each baseline observes."""
KINDS = {
    "paper": "targets in any direction",
    "corner": "both axes at once, the case the paper's controller cannot handle",
}
"""What each headline suite tests."""


class Picture(NamedTuple):
    """A figure on the page."""

    title: str
    png: str
    """PNG file in base64."""
    caption: str


def write_report(
    run_dirs: Sequence[Path],
    out: Path,
    scenarios: int,
    progress: Callable[[str], Any],
) -> list[str]:
    """Writes one self-contained HTML file.

    It compares the first run that has a policy with the baselines, on scenarios of the report's
    own seed, and saves these results in the run folder (`report.json`).

    Args:
      run_dirs: run folders, complete or not.
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
    policy = next((run.policy for run in runs if run.policy is not None), None)
    config = next((run.config for run in runs if run.config is not None), None)
    sections: dict[str, Any] = {"comparison": None, "seeds": None, "pictures": [], "video": None}
    for run in [run for run in runs if run.policy is not None][:1]:
        try:
            sections |= _policy_sections(run, runs, scenarios, progress, missing)
        except (PolicyError, ConfigError) as error:
            missing.append(f"{run.path}: {error}")
    page = {
        "title": f"mjx_balance: {', '.join(run.path.name for run in runs)}",
        "missing": missing,
        **sections,
        "training": training_pictures(runs, config),
        "config": config and config_tables(config),
        "commands": commands(runs, out),
        "versions": policy and versions(policy),
    }
    # A file name may hold surrogates, which UTF-8 cannot encode.
    write_atomically(out, render_page(page).encode("utf-8", "replace"))
    return missing


def render_page(page: dict[str, Any]) -> str:
    """Fills the template; escapes every value."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(TEMPLATE).render(page)


def _policy_sections(
    run: Run,
    runs: Sequence[Run],
    scenarios: int,
    progress: Callable[[str], Any],
    missing: list[str],
) -> dict[str, Any]:
    """The page's sections about a run's policy; appends to `missing` if no video can be drawn.

    Raises:
      PolicyError: if the policy belongs to another scene.
    """
    policy = run.policy
    assert policy is not None
    scene = policy_scene(policy)
    measurements = measuring.load_or_measure(
        policy, scene, RunFolder(run.path).report, scenarios, progress
    )
    sections: dict[str, Any] = {
        "comparison": comparison(policy, measurements),
        "seeds": seeds_table(run, runs),
        "pictures": policy_pictures(policy, scene, measurements),
    }
    try:
        sections["video"] = video(policy)
        sections["video_note"] = (
            f"{measuring.VIDEO_SECONDS:g} s of suite corner in plain MuJoCo, at real speed."
        )
    except render.RenderError as error:
        missing.append(f"no video: {error}")
    return sections


def comparison(policy: Policy, measurements: Measurements) -> dict[str, Any]:
    """Headline figures, and a table of the policy and the baselines."""
    task, ours = policy.config.task, measurements.results["policy"]
    count = ours["paper"]["scenarios"]
    falls = sum(ours[suite]["falls"] for suite in HEADLINE)
    tiles = [
        (f"{ours['paper']['tilt_deg']['mean']:.3f}°", "mean tilt, targets in any direction"),
        (
            f"{ours['corner']['tilt_deg']['mean']:.3f}°",
            f"mean tilt, both axes at {task.max_incline:g}° at once",
        ),
        (str(falls), f"falls in {len(HEADLINE) * count} scenarios of {measuring.DURATION:g} s"),
        (
            f"{100 * measurements.envelope.fall_free_share:.0f}%",
            "of the feasible envelope free of falls",
        ),
    ]
    sees = {"policy": f"this network: {policy.observation_size} inputs", **BASELINE_INPUTS}
    rows = [
        (name, sees[name], _baseline_cells(suites)) for name, suites in measurements.results.items()
    ]
    levels = task.action_levels
    note = (
        f"Plain MuJoCo, {count} held-out scenarios of {measuring.DURATION:g} s per suite (seed "
        f"{SEEDS.report}), tilt in degrees over every physics step; from a fall on it counts as "
        f"{task.fail_tilt:g}°. All take the same {levels} x {levels} actions at "
        f"{1 / task.ctrl_dt:g} Hz. The last column is the mean height change commanded per "
        f"decision in the last {SETTLED_SECONDS:g} s of each period. The paper gives no figures; "
        "it reports a high peak of the tilt when the board turns on both axes at once, and that "
        "its controller cannot handle that."
    )
    return {"tiles": tiles, "suites": HEADLINE, "rows": rows, "note": note}


def _baseline_cells(suites: dict[str, dict[str, Any]]) -> list[str]:
    """Falls, mean, p95 and max tilt per suite, then the mean action at rest."""
    cells = []
    for suite in HEADLINE:
        cells.append(str(suites[suite]["falls"]))
        cells += [f"{suites[suite]['tilt_deg'][name]:.3f}" for name in TILTS]
    settled = suites["paper"]["action_mm_settled"]
    return [*cells, "-" if settled is None else f"{settled:.3f}"]


def seeds_table(run: Run, runs: Sequence[Run]) -> dict[str, Any] | None:
    """Statistics over the training seeds of `run` and of those `runs` that differ only in seed."""

    def recipe(any_run: Run) -> Config | None:
        return any_run.config and dataclasses.replace(any_run.config, seed=0, num_seeds=1)

    alike = [x for x in runs if x is run or (x.config and recipe(x) == recipe(run))]
    each = [result for x in alike for result in x.results]
    shared = [suite for suite in HEADLINE if all(suite in result for result in each)]
    if len(each) < 2 or not shared:
        return None
    rows = []
    for suite in shared:
        row = over_seeds([result[suite] for result in each])
        cells = [str(row["seeds"]), f"{row['falls']} of {row['scenarios']}"]
        for name in TILTS:
            cells += [spread(row[name]), f"{row[name]['worst']:.3f}"]
        rows.append((suite, cells))
    return {"names": TILTS, "rows": rows}


def policy_pictures(policy: Policy, scene: Scene, measurements: Measurements) -> list[Picture]:
    """The paper's Fig. 7 for each suite, the distribution of the tilt, and the envelope."""
    task, pictures = policy.config.task, []
    for suite in HEADLINE:
        both = {
            name: measuring.record_rollout(
                policy, suite, measuring.RECORD_SECONDS, SEEDS.record, name
            )
            for name in ("policy", "pd-imu")
        }
        caption = (
            f"The paper's Fig. 7 for suite {suite} ({KINDS[suite]}), beside the PD on the same IMU."
        )
        figure = figures.rollout_figure(scene, both)
        pictures.append(
            _picture(f"{measuring.RECORD_SECONDS:g} s on the board: {suite}", figure, caption)
        )
    shares = {name: np.asarray(suites["paper"]) for name, suites in measurements.shares.items()}
    figure = figures.tilt_figure(shares, measuring.edges(task.fail_tilt))
    caption = "Suite paper, every physics step of every scenario."
    pictures.append(_picture("Tilt distribution", figure, caption))
    figure = figures.envelope_figure(measurements.envelope, task.fail_tilt)
    return [*pictures, _picture("Envelope", figure, envelope_caption(task, measurements.envelope))]


def envelope_caption(task: TaskConfig, envelope: Envelope) -> str:
    """Explains the cells and the dashed line of the envelope."""
    return (
        f"Targets on both axes at once, {envelope.scenarios} scenarios of "
        f"{envelope.duration_s:g} s per cell. Right of or above the dashed "
        "line the action set cannot follow: "
        f"{1000 * task.action_max:g} mm {1 / task.ctrl_dt:g} times a second turn the body at "
        f"{envelope.authority:.2f} deg/s in pitch, and the legs reach {envelope.reach:.1f} deg. "
        f"Inside, {100 * envelope.fall_free_share:.0f}% of the cells are free of falls."
    )


def video(policy: Policy) -> str:
    """MP4 of a scenario of suite corner, in base64.

    Raises:
      RenderError: if no OpenGL backend works here.
    """
    rollout = measuring.record_rollout(policy, "corner", measuring.VIDEO_SECONDS, SEEDS.report)
    assert rollout.qpos is not None
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "video.mp4"
        render.write(file, policy.config, rollout.qpos[0])
        return base64.b64encode(file.read_bytes()).decode()


def training_pictures(runs: Sequence[Run], config: Config | None) -> list[Picture]:
    """Learning curves and the reward function."""
    pictures = []
    curves = [run.metrics for run in runs if run.metrics]
    if curves:
        caption = (
            "Training. The line is the median over runs and seeds, the band their extremes; tilt, "
            "falls and reward are those of the exploring policy. Points are validations: the "
            "greedy policy of a seed in held-out scenarios in plain MuJoCo."
        )
        pictures.append(_picture("Learning curves", figures.learning_curves(curves), caption))
    if config is not None:
        end = config.task.reward_tilt == "end"
        where = "at the decision's end" if end else "averaged over it"
        caption = f"The reward of one decision; the tilt is taken {where}."
        figure = figures.reward_figure(config.task)
        pictures.append(_picture("Reward (Fig. 4 and 5 of the paper)", figure, caption))
    return pictures


def _picture(title: str, figure: figures.plt.Figure, caption: str) -> Picture:
    return Picture(title, base64.b64encode(figures.png(figure)).decode(), caption)


def config_tables(config: Config) -> dict[str, Any]:
    """The fields that differ from preset `paper`, and the whole config as JSON."""
    papers = flatten(to_dict(preset("paper")))
    differs = [
        (name, papers[name], value)
        for name, value in flatten(to_dict(config)).items()
        if value != papers[name]
    ]
    return {"differs": differs, "everything": json.dumps(to_dict(config), indent=2)}


def commands(runs: Sequence[Run], out: Path) -> list[str]:
    """Command lines that reproduce training, evaluation and report."""
    lines = [train_command(run.config) for run in runs if run.config is not None]
    for run in runs:
        if run.policy is not None:
            lines.append(f"mjx-balance evaluate {RunFolder(run.path).policy} --suite corner")
    return [*lines, f"mjx-balance report {' '.join(str(run.path) for run in runs)} --out {out}"]


def train_command(config: Config) -> str:
    """The command that trains with this config."""
    defaults = flatten(to_dict(preset(config.preset)))
    words = [f"mjx-balance train --preset {config.preset} --seed {config.seed}"]
    for name, value in flatten(to_dict(config)).items():
        if value == defaults[name] or name == "seed":
            continue
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            values = value if isinstance(value, list) else [value]
            words.append(" ".join([f"--{flag}", *map(str, values)]))
    return " ".join(words)


def versions(policy: Policy) -> str:
    """Library versions of the training; empty if the manifest has none."""
    known = policy.manifest.get("versions")
    items = known.items() if isinstance(known, dict) else ()
    return ", ".join(f"{name} {version}" for name, version in items if version)
