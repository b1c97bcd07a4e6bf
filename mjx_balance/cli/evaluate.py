"""`mjx-balance evaluate`."""

import dataclasses
import math
from pathlib import Path

import tyro
from rich.console import Console

from mjx_balance.cli.common import ControllerArgs, check_out, complain, suite_of
from mjx_balance.errors import FAILED, PATH, InputError, shorten
from mjx_balance.evaluation.controllers import Controller
from mjx_balance.evaluation.rollout import run_suite, suite_scene, summarize
from mjx_balance.evaluation.suites import Suite
from mjx_balance.files.run_folder import write_json
from mjx_balance.report.progress import Display, Stage
from mjx_balance.report.tables import evaluation_table, print_table
from mjx_balance.sim.scene import Scene


@dataclasses.dataclass(frozen=True)
class EvaluateArgs(ControllerArgs):
    """Evaluate a policy in plain MuJoCo on all cores. Needs no JAX."""

    suite: str = "paper"
    """Kind of scenarios: paper, corner, noise, payload, friction, gains, soft, latency, push, fast,
    steep, recover, steps, sea, platform, bias, encoder, delay, dropout, shift, slip or
    weak; or module:NAME of your own."""
    scenarios: int = 256
    """Number of scenarios."""
    duration: float = 60.0
    """Length of a scenario, s."""
    seed: int = 0
    """Seed of the scenarios."""
    json: Path | None = None
    """JSON file to write the results to."""
    video: Path | None = None
    """MP4 file to write, a video of the first scenario."""
    video_duration: float = 20.0
    """Length of the video, s; without a GPU a second of it takes some seconds to draw."""


def evaluate(argv: list[str]) -> int:
    args = tyro.cli(EvaluateArgs, args=argv, prog="mjx-balance evaluate")
    check_out("json", args.json)
    check_out("video", args.video, ".mp4")
    if not (math.isfinite(args.video_duration) and args.video_duration > 0):
        raise InputError(
            f"video_duration is {args.video_duration}; it must be a number of seconds above 0"
        )
    suite = suite_of(args.suite)
    scene, controller = args.load()
    size = (args.scenarios, args.duration, args.seed)
    stage = Display(Console(stderr=True)).stages(2 if args.video else 1)
    with stage(f"evaluating, suite {args.suite}") as bar:
        rollout = run_suite(scene, controller, suite, *size, bar)
    result = summarize(rollout, suite, args.duration, args.seed)
    print_table(Console(), evaluation_table({args.suite: result}))
    print(f"{result['physics_steps_per_second']:,.0f} physics steps per second", flush=True)
    if args.json:
        write_json(args.json, result)
    return _video(scene, controller, suite, args, stage) if args.video else 0


def _video(
    scene: Scene, controller: Controller, suite: str | Suite, args: EvaluateArgs, stage: Stage
) -> int:
    from mjx_balance.render import drawing as render

    assert args.video is not None
    duration = min(args.duration, args.video_duration)
    try:
        with stage("drawing the video") as bar:
            rollout = run_suite(scene, controller, suite, 1, duration, args.seed, record=True)
            assert rollout.qpos is not None
            scene, states = suite_scene(scene, suite), rollout.qpos[0]
            captions = render.captions(scene, states)
            render.write(args.video, scene, states, captions=captions, progress=bar)
    except render.RenderError as error:
        return complain(f"no video written: {error}", FAILED)
    print(f"video of the first scenario: {shorten(args.video, PATH)}")
    return 0
