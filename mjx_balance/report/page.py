"""A self-contained HTML page about runs, from the template beside this file."""

import base64
import dataclasses
import itertools
import json
import shlex
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from mjx_balance.config import Config, ConfigError, flatten, preset, to_dict
from mjx_balance.evaluation.rollout import SETTLED_SECONDS, Progress, policy_scene
from mjx_balance.evaluation.statistics import TILTS, over_seeds
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.files.run_folder import RunFolder, write_atomically
from mjx_balance.policy.file import Policy, PolicyError
from mjx_balance.render import drawing as render
from mjx_balance.report import alt_texts, figures, measuring
from mjx_balance.report.measuring import Measurements
from mjx_balance.report.progress import Stage, part
from mjx_balance.report.reading import Run, read_run
from mjx_balance.report.tables import spread
from mjx_balance.sim.scene import Scene

TEMPLATE = "page.html"
VIDEO_SIZE, VIDEO_FPS = (640, 368), 10.0  #: small: software draws three pictures a second
CONSTANTS = {
    "measuring": measuring,
    "report_seed": SEEDS.report,
    "settled_seconds": SETTLED_SECONDS,
    "suites": HEADLINE,
    "tilts": TILTS,
}


@dataclasses.dataclass(frozen=True)
class Picture:
    """A figure in a page."""

    alt: str  #: what is seen
    svg: str  #: base64


def write_report(
    run_dirs: Sequence[Path],
    out: Path,
    scenarios: int,
    stages: Callable[[int], Stage],
    robot: str | None = None,
    with_video: bool = True,
) -> list[str]:
    """Writes one self-contained HTML file; returns what is missing, one sentence each.

    It compares the first run that has a policy with the baselines, on scenarios of the report's
    own seed, and saves these results in the run folder (`report.json`).

    Args:
      run_dirs: run folders, complete or not.
      out: file to write.
      scenarios: per suite and controller.
      stages: number of stages -> what shows them.
      robot: of the policy; none: it must be a shipped one.
      with_video: whether to draw one.

    Raises:
      ReportError: for a folder that is no run folder.
    """
    runs = [read_run(path) for path in run_dirs]
    missing = [sentence for run in runs for sentence in run.missing]
    config = next((run.config for run in runs if run.config is not None), None)
    first = next((run for run in runs if run.policy is not None), None)
    page = {
        "title": f"mjx_balance: {', '.join(run.path.name for run in runs)}",
        "missing": missing,
        "policy": None,
        "video": None,
        "training": training_pictures(runs, config),
        "config": config and config_tables(config),
        "commands": commands(runs, out, scenarios, robot),
        "versions": "",
    }
    if first is not None and first.policy is not None:
        page["versions"] = versions(first.policy)
        try:
            scene = policy_scene(first.policy, robot)
            file = RunFolder(first.path).report
            measured = measuring.load(first.policy, scene, file, scenarios)
            stage = stages((0 if measured else measuring.STAGES) + 1 + with_video)
            if measured is None:
                measured = measuring.measure(first.policy, scene, file, scenarios, stage)
            page |= {
                "policy": first.policy,
                "measurements": measured,
                "seeds": seeds_statistics(first, runs),
            }
            with stage("recording and drawing figures") as bar:
                page["pictures"] = policy_pictures(first.policy, scene, measured, bar)
            if with_video:
                with stage("drawing the video") as bar:
                    page["video"] = video(first.policy, scene, bar)
        except (PolicyError, ConfigError) as error:
            missing.append(f"{first.path}: {error}")
        except render.RenderError as error:
            missing.append(f"no video: {error}")
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
    environment.filters |= {"fmt": format, "spread": spread}
    return environment.get_template(TEMPLATE).render(CONSTANTS | page)


def seeds_statistics(run: Run, runs: Sequence[Run]) -> dict[str, dict[str, Any]]:
    """Suite -> statistics over the seeds of runs like `run`.

    Empty for fewer than two seeds, and for a sweep, whose seeds have other configs.
    """
    if run.config is not None and run.config.sweep:
        return {}

    def recipe(config: Config | None) -> Config | None:
        return config and dataclasses.replace(config, seed=0, num_seeds=1)

    own = recipe(run.config)
    alike = [x for x in runs if x is run or (own is not None and recipe(x.config) == own)]
    each = [result for x in alike for result in x.results]
    if len(each) < 2:
        return {}
    shared = [suite for suite in HEADLINE if all(suite in result for result in each)]
    return {suite: over_seeds([result[suite] for result in each]) for suite in shared}


def policy_pictures(
    policy: Policy, scene: Scene, measurements: Measurements, bar: Progress
) -> dict[str, Picture]:
    """The paper's Fig. 7 by suite, the tilt's distribution and the envelope."""
    fail_tilt, pictures = policy.config.task.fail_tilt, {}
    record, seconds = measuring.record_rollout, measuring.RECORD_SECONDS
    names = ("policy", "pd-imu")
    parts = (part(bar, k, 2 * len(HEADLINE) + 1) for k in itertools.count())
    for suite in HEADLINE:
        rollouts = {
            name: record(policy, scene, suite, seconds, SEEDS.record, name, next(parts))
            for name in names
        }
        figure = figures.rollout_figure(scene, rollouts)
        pictures[suite] = _picture(figure, alt_texts.rollout_alt(suite, rollouts))
    shares = {name: np.asarray(suites["paper"]) for name, suites in measurements.shares.items()}
    edges = measuring.edges(fail_tilt)
    tilt = figures.tilt_figure(shares, edges)
    envelope = figures.envelope_figure(measurements.envelope, fail_tilt)
    return pictures | {
        "tilt": _picture(tilt, alt_texts.tilt_alt(shares, edges)),
        "envelope": _picture(envelope, alt_texts.envelope_alt(measurements.envelope)),
    }


def video(policy: Policy, scene: Scene, bar: Progress) -> str:
    """MP4 of a scenario of suite corner, in base64.

    Raises:
      RenderError: if no OpenGL backend works here.
    """
    seconds, seed = measuring.VIDEO_SECONDS, SEEDS.report
    rollout = measuring.record_rollout(policy, scene, "corner", seconds, seed)
    assert rollout.qpos is not None
    states = rollout.qpos[0]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "video.mp4"
        words = render.captions(scene, states)
        small = {"size": VIDEO_SIZE, "fps": VIDEO_FPS}
        render.write(file, scene, states, captions=words, progress=bar, **small)
        return base64.b64encode(file.read_bytes()).decode()


def training_pictures(runs: Sequence[Run], config: Config | None) -> dict[str, Picture]:
    """`curves` and `reward`, as far as there are metrics and a config."""
    pictures = {}
    curves = [run.metrics for run in runs if run.metrics]
    if curves:
        pictures["curves"] = _picture(figures.learning_curves(curves), alt_texts.curves_alt(curves))
    if config is not None:
        reward = figures.reward_figure(config.task)
        pictures["reward"] = _picture(reward, alt_texts.reward_alt(config.task))
    return pictures


def _picture(figure: figures.Figure, alt: str) -> Picture:
    return Picture(alt, base64.b64encode(figures.svg(figure)).decode())


def config_tables(config: Config) -> dict[str, Any]:
    """The fields that differ from preset `paper`, where the reward is taken, and all as JSON."""
    papers = flatten(to_dict(preset("paper")))
    differs = [
        (name, papers[name], value)
        for name, value in flatten(to_dict(config)).items()
        if value != papers[name]
    ]
    everything = json.dumps(to_dict(config), indent=2)
    return {"differs": differs, "reward_tilt": config.task.reward_tilt, "everything": everything}


def commands(runs: Sequence[Run], out: Path, scenarios: int, robot: str | None = None) -> list[str]:
    """Command lines that reproduce training, evaluation and report; as `write_report`."""
    policies = [RunFolder(run.path).policy for run in runs if run.policy is not None]
    evaluate, report = ["mjx-balance", "evaluate"], ["mjx-balance", "report"]
    size = ["--scenarios", str(scenarios)]
    own = ["--robot", robot] if robot else []
    return [
        *(train_command(run.config) for run in runs if run.config is not None),
        *(shlex.join([*evaluate, str(x), "--suite", "corner", *own]) for x in policies),
        shlex.join([*report, *(str(x.path) for x in runs), "--out", str(out), *size, *own]),
    ]


def train_command(config: Config) -> str:
    """The command that trains with this config."""
    defaults = flatten(to_dict(preset(config.preset)))
    words = ["mjx-balance", "train", "--preset", config.preset, "--seed", str(config.seed)]
    for name, value in flatten(to_dict(config)).items():
        if value == defaults[name] or name == "seed":
            continue
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            words += [f"--{flag}", *map(str, value if isinstance(value, list) else [value])]
    return shlex.join(words)


def versions(policy: Policy) -> str:
    """Library versions of the training; empty if the manifest has none."""
    known = policy.manifest.get("versions")
    items = known.items() if isinstance(known, dict) else ()
    return ", ".join(f"{name} {version}" for name, version in items if version)
