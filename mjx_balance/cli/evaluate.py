"""`mjx-balance evaluate`."""

import dataclasses
from pathlib import Path

import tyro
from rich.console import Console

from mjx_balance.cli.common import ControllerArgs, check_out, complain, suite_of
from mjx_balance.errors import FAILED, PATH, shorten
from mjx_balance.evaluation.controllers import Controller
from mjx_balance.evaluation.rollout import run_suite, suite_scene, summarize
from mjx_balance.evaluation.suites import Suite
from mjx_balance.files.run_folder import write_json
from mjx_balance.report.progress import Display
from mjx_balance.report.tables import evaluation_table, print_table
from mjx_balance.sim.scene import Scene


@dataclasses.dataclass(frozen=True)
class EvaluateArgs(ControllerArgs):
    """Evaluate a policy in plain MuJoCo on all cores. Needs no JAX."""

    suite: str = "paper"
    """Kind of scenarios: paper, corner, noise, payload, friction, gains, soft, latency, push, fast,
    steep, recover, steps, sea, platform, bias, encoder, delay, dropout, load, slip or
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


def evaluate(argv: list[str]) -> int:
    args = tyro.cli(EvaluateArgs, args=argv, prog="mjx-balance evaluate")
    check_out("json", args.json)
    check_out("video", args.video, ".mp4")
    suite = suite_of(args.suite)
    scene, controller = args.load()
    size = (args.scenarios, args.duration, args.seed)
    with Display(Console(stderr=True)).bar(f"evaluating, suite {args.suite}") as bar:
        rollout = run_suite(scene, controller, suite, *size, bar)
    result = summarize(rollout, suite, args.duration, args.seed)
    print_table(Console(), evaluation_table({args.suite: result}))
    print(f"{result['physics_steps_per_second']:,.0f} physics steps per second", flush=True)
    if args.json:
        write_json(args.json, result)
    return _video(scene, controller, suite, args) if args.video else 0


def _video(scene: Scene, controller: Controller, suite: str | Suite, args: EvaluateArgs) -> int:
    from mjx_balance.render import drawing as render

    assert args.video is not None
    rollout = run_suite(scene, controller, suite, 1, args.duration, args.seed, record=True)
    assert rollout.qpos is not None
    try:
        render.write(args.video, suite_scene(scene, suite), rollout.qpos[0])
    except render.RenderError as error:
        return complain(f"no video written: {error}", FAILED)
    print(f"video of the first scenario: {shorten(args.video, PATH)}")
    return 0
