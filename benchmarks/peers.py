"""How soon does a robot balance, by which learner?

Every run is a fresh process over MuJoCo's C engine. Its clock runs from its start, imports and
compiling included. Contenders:

  quick, quick-16k, default   ours, `train.py --preset quick` with 8,192 and 16,384 decisions, and
                              `--preset default` with 40,000, from empty caches
  quick-warm                  the same again as `quick`, started once before
  quick-mjx, quick-mjx-warm   engine `mjx`
  rejax-dqn, -pqn, -sac, -ppo   `examples/train_rejax.py`
  brax-sac, -ppo              `examples/train_brax.py`
  sb3-dqn, -ppo               `examples/train_sb3.py`, stable-baselines3

Ours run to their end, the others for `--seconds`. All keep policies on their way, which are
evaluated off the clock, in plain MuJoCo: held-out scenarios, the same for all. Peers keep theirs
in memory, which costs milliseconds; ours validate and write a file.

    pip install -e ".[benchmarks]"
    pip install rejax==0.1.3    # in an environment of its own: gymnax wants an older Gymnasium
    python benchmarks/peers.py --json benchmarks/peers.json --write benchmarks/README.md

Runs that are in the JSON file are not run again, so that an interrupted measurement goes on.
`python docs/figures.py peers` draws the curves.
"""

import argparse
import contextlib
import copy
import functools
import importlib.util
import itertools
import json
import math
import os
import runpy
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import common
from common import REPO, Row

from mjx_balance.evaluation.controllers import Controller
from mjx_balance.evaluation.rollout import observing, policy_scene
from mjx_balance.files.run_folder import RunFolder
from mjx_balance.policy.file import load_policy
from mjx_balance.sim.scene import Scene

SUITES = ("paper", "corner", "push")
BALANCED = {"paper": 0.10, "corner": 0.10}  #: greatest mean tilt of a policy that balances, deg
SPACING = 1.1  #: ratio of the clock's readings at two policies that a peer keeps
COARSE = 4  #: one in so many of them is evaluated, all where the tilt passes `BALANCED`
DURATION = 30.0  #: of an evaluated scenario, s
INTERRUPTED = 130


class Ours(NamedTuple):
    """A run of `train.py`."""

    preset: str
    engine: str = "mujoco"
    decisions: int | None = None  #: None: the preset's
    warm: bool = False  #: whether another run has filled the caches


OURS = {
    "quick": Ours("quick"),
    "quick-16k": Ours("quick", decisions=16_384),
    "default": Ours("default"),
    "quick-warm": Ours("quick", warm=True),
    "quick-mjx": Ours("quick", "mjx"),
    "quick-mjx-warm": Ours("quick", "mjx", warm=True),
}
PEERS = {
    "rejax-dqn": 32_000,
    "rejax-pqn": 48_000,
    "rejax-sac": 42_000,
    "rejax-ppo": 56_000,
    "brax-sac": 1_000_000,
    "brax-ppo": 1_000_000,
    "sb3-dqn": 15_000,
    "sb3-ppo": 45_000,
}
"""Contender -> decisions per minute of its run, about what two cores make: then the schedules of
rejax and stable-baselines3 end when the clock does. brax's know no end, and the clock stops
them."""
PACKAGES = {"rejax": "rejax", "brax": "brax", "sb3": "stable_baselines3"}
USUAL = ["quick", "quick-16k", "default", *PEERS]
"""Contenders unless others are asked for."""
EVERY = 1_024  #: decisions between two policies that ours write


class ContenderError(Exception):
    """A contender that ended without a policy; the message says which and how."""


class OutOfTime(Exception):
    """The clock of a peer has stopped."""


class Point(NamedTuple):
    """A policy on the way."""

    seconds: float  #: since the start of the process
    decisions: int
    controller: Controller


class Clock:
    """Keeps a peer's policies, and stops it by `OutOfTime`."""

    def __init__(self, began: float, seconds: float, decisions: int):
        """Runs from `began`, as `time.time` says, for so many seconds or decisions."""
        self._began, self._seconds, self._due, self.decisions = began, seconds, 0.0, decisions
        self.points: list[Point] = []

    def __call__(self, decisions: int, keep: Callable[[], Controller]) -> None:
        """Keeps a policy if it is time to; `keep` copies it, as the learner will go on.

        Raises:
          OutOfTime: at the end.
        """
        now = time.time() - self._began
        over = now >= self._seconds or decisions >= self.decisions
        if over or now >= self._due:
            self.points.append(Point(now, decisions, keep()))
            self._due = now * SPACING
        if over:
            raise OutOfTime


def run_rejax(name: str, seed: int, clock: Clock) -> Scene:
    """Runs rejax's "dqn", "pqn", "sac" or "ppo"; returns the scene to evaluate in."""
    import jax

    example = runpy.run_path(str(REPO / "examples" / "train_rejax.py"))
    env = example["make_env"](name, "mujoco")
    learner = example["make"](name, env, clock.decisions)
    greedy = example["greedy"](learner)

    def keep(state: Any) -> Controller:
        small = jax.device_get(example["policy_state"](state))
        return example["controller"](env, lambda obs: greedy(small, obs))

    with contextlib.suppress(OutOfTime):
        log_fn = lambda decisions, state: clock(decisions, lambda: keep(state))  # noqa: E731
        example["train"](learner, seed, log_fn)
    return env.scene


def run_brax(name: str, seed: int, clock: Clock) -> Scene:
    """Runs brax's "ppo" or "sac"; returns the scene to evaluate in."""
    import jax
    from brax.training import acting

    example = runpy.run_path(str(REPO / "examples" / "train_brax.py"))
    env, key = example["make_env"]("mujoco"), jax.random.PRNGKey(0)

    class Keeper:
        """In place of brax's evaluator, which takes seconds; SAC shows its policy to no other."""

        def __init__(self, eval_env: Any, eval_policy_fn: Any, **unused: Any):
            self.act = jax.jit(lambda params, obs: eval_policy_fn(params)(obs, key))

        def run_evaluation(self, params: Any, training_metrics: Any) -> dict[str, Any]:
            return {"keep": functools.partial(self.keep, params)}

        def keep(self, params: Any) -> Controller:
            copied = jax.device_get(params)
            return example["controller"](env, lambda obs, _: self.act(copied, obs))

    def progress_fn(decisions: int, metrics: dict[str, Any]) -> None:
        if decisions:
            clock(decisions, metrics["keep"])

    acting.Evaluator = Keeper  # pyright: ignore[reportAttributeAccessIssue]
    epochs = clock.decisions // example["EPOCH"]
    more = {"num_evals": 1 + epochs, "deterministic_eval": True, "progress_fn": progress_fn}
    if name == "ppo":
        more["run_evals"] = True  # by `Keeper`
    with contextlib.suppress(OutOfTime):
        example["train"](name, env, clock.decisions, seed, **more)
    return env.scene


def run_sb3(name: str, seed: int, clock: Clock) -> Scene:
    """Runs stable-baselines3's "dqn" or "ppo"; returns the scene to evaluate in."""
    from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]

    example = runpy.run_path(str(REPO / "examples" / "train_sb3.py"))
    model = example["make"](name, clock.decisions, seed)
    own = model.get_env().envs

    def keep() -> Controller:
        policy = copy.deepcopy(model.policy)
        scale = own.config.task.action_max if name == "ppo" else 1
        return lambda view: scale * policy.predict(view.obs, deterministic=True)[0]

    class Ticks(BaseCallback):
        def _on_step(self) -> bool:
            clock(self.num_timesteps, keep)
            return True

    with contextlib.suppress(OutOfTime):
        model.learn(clock.decisions, callback=Ticks())
    return own.scene


LIBRARIES = {"rejax": run_rejax, "brax": run_brax, "sb3": run_sb3}


def peer(args: argparse.Namespace) -> None:
    """Runs a peer in this process, evaluates what it has kept, and writes the points."""
    library, name = args.peer.split("-")
    decisions = round(PEERS[args.peer] * args.seconds / 60)
    clock = Clock(args.began, args.seconds, decisions)
    with contextlib.redirect_stdout(sys.stderr):
        scene = LIBRARIES[library](name, args.seed, clock)
        rows = evaluated(scene, clock.points, args.scenarios, args.coarse)
    args.json.write_text(json.dumps(rows))


def evaluated(
    scene: Scene, points: Sequence[Point], scenarios: int, coarse: int = COARSE
) -> list[Row]:
    """The points with their evaluations, as JSON.

    One in `coarse` of them and the last; before the first that balances, those in between, too.
    """
    rows: dict[int, Row] = {}

    def add(ids: Iterable[int]) -> None:
        for k in ids:
            seconds, decisions, controller = points[k]
            tilts = {x: tilt(scene, controller, x, scenarios) for x in SUITES}
            rows[k] = {"seconds": seconds, "decisions": decisions, **tilts}
            common.log(f"{seconds:7.1f} s {decisions:9,} {tilts}")

    last = len(points) - 1
    add(sorted(range(last, -1, -coarse)))
    known = sorted(rows)
    for before, after in itertools.pairwise(known):
        if balances(rows[after]) and not balances(rows[before]):
            add(range(before + 1, after))
            break
    return [rows[k] for k in sorted(rows)]


def tilt(scene: Scene, controller: Controller, suite: str, scenarios: int) -> Row:
    """Mean tilt, deg, and falls over held-out scenarios."""
    result = common.evaluated(scene, controller, suite, scenarios, DURATION)
    return {"mean": result["tilt_deg"]["mean"], "falls": result["falls"]}


def balances(point: Row) -> bool:
    """Whether a policy is as level as `BALANCED`."""
    return all(point[suite]["mean"] <= most for suite, most in BALANCED.items())


def run_peer(
    name: str, seed: int, args: argparse.Namespace, work: Path, coarse: int = COARSE
) -> list[Row]:
    """The points of a peer in a process of its own; one in `coarse` of its policies is evaluated.

    Raises:
      ContenderError: if it fails.
    """
    file = work / f"{name}-{seed}.json"
    flags = {"seed": seed, "seconds": args.seconds, "scenarios": args.scenarios, "json": file}
    flags["coarse"] = coarse
    command = [sys.executable, __file__, "--peer", name]
    command += [word for flag, value in flags.items() for word in (f"--{flag}", str(value))]
    run([*command, "--began", str(time.time())])
    return json.loads(file.read_text())


def run_ours(name: str, seed: int, args: argparse.Namespace, work: Path) -> list[Row]:
    """The points of `train.py`: validated policies and the exported one.

    Raises:
      ContenderError: if it fails.
    """
    ours, cache = OURS[name], work / f"cache-{name}-{seed}"
    folder, began = RunFolder(work), 0.0
    for number in range(2 if ours.warm else 1):
        folder = RunFolder(work / f"{name}-{seed}-{number}")
        flags = f"--preset {ours.preset} --engine {ours.engine} --seed {seed}"
        flags += f" --eval-every {EVERY} --validation-scenarios 1 --validation-duration 1"
        flags += " --eval-scenarios 1 --eval-duration 1"  # off the clock: ours come below
        if ours.decisions:
            flags += f" --num-env-steps {ours.decisions}"
        command = [sys.executable, str(REPO / "train.py"), *flags.split(), "--run-dir"]
        began = time.time()
        run([*command, str(folder.path)], MJX_BALANCE_CACHE=str(cache))
    files = [*folder.validated.glob("*/*.safetensors"), folder.policy]
    files.sort(key=lambda file: file.stat().st_mtime)
    policies = [load_policy(file) for file in files]
    points = [
        Point(
            file.stat().st_mtime - began,
            policy.manifest["training"]["env_steps"],
            observing(policy),
        )
        for file, policy in zip(files, policies, strict=True)
    ]
    return evaluated(policy_scene(policies[-1]), points, args.scenarios)


def run(command: list[str], **environ: str) -> None:
    """Runs a process to its end, its output as progress.

    Raises:
      ContenderError: if it fails.
    """
    code = subprocess.run(command, env=os.environ | environ, stdout=sys.stderr).returncode
    if code:
        raise ContenderError(f"{' '.join(command)} failed, exit code {code}")


def seconds_to_balance(points: Sequence[Row]) -> float | None:
    """The clock at the first policy that balances."""
    return next((x["seconds"] for x in points if balances(x)), None)


def median_seconds(runs: Sequence[Sequence[Row]]) -> float | None:
    """The median of `seconds_to_balance`; a run that does not balance takes longest."""
    seconds = statistics.median(seconds_to_balance(x) or math.inf for x in runs)
    return seconds if math.isfinite(seconds) else None


def summary(name: str, rows: Sequence[Row], best: float | None) -> Row:
    """A row of the table from a contender's runs; `best` is the time of the fastest of ours."""
    runs = [row["points"] for row in rows]
    middle, count = median_seconds(runs), sum(seconds_to_balance(x) is not None for x in runs)
    rates = [
        (b["decisions"] - a["decisions"]) / (b["seconds"] - a["seconds"])
        for a, b in ((points[0], points[-1]) for points in runs if len(points) > 1)
    ]
    ends = [points[-1] for points in runs]
    reached = f" ({count} of {len(runs)})" if 0 < count < len(runs) else ""
    return {
        "contender": name,
        "seeds": len(runs),
        "decisions/s": f"{statistics.median(rates):,.0f}" if rates else "-",
        "s to 0.10 deg": (f"{middle:.0f}" if middle else "not reached") + reached,
        "this / ours": f"{middle / best:.1f}" if middle and best else "-",
        "end, s": f"{statistics.median(x['seconds'] for x in ends):.0f}",
        **{
            suite: {
                "mean": statistics.median(x[suite]["mean"] for x in ends),
                "falls": sum(x[suite]["falls"] for x in ends),
            }
            for suite in SUITES
        },
    }


def table_lines(rows: Sequence[Row], scenarios: int) -> list[str]:
    """The table, and what a reader has to know of it."""
    runs = {name: [x for x in rows if x["contender"] == name] for name in (*OURS, *PEERS)}
    runs = {name: own for name, own in runs.items() if own}
    cold = [name for name in runs if name in OURS and not OURS[name].warm]
    times = [median_seconds([x["points"] for x in runs[name]]) for name in cold]
    best = min((x for x in times if x is not None), default=None)
    cells = [summary(name, own, best) for name, own in runs.items()]
    note = (
        f"Seconds from the start of the process to the first policy of at most 0.10 deg mean tilt "
        f"in both `paper` and `corner`; tilt at the end, deg; medians over the seeds. {scenarios} "
        f"held-out scenarios of {DURATION:g} s per suite; {common.machine()}."
    )
    return [*common.table(cells), "", note]


def main() -> int:
    """Runs the contenders and prints the table; returns the exit code."""
    parser = common.arguments(__doc__)
    parser.add_argument("--contenders", nargs="*", default=USUAL, choices=(*OURS, *PEERS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--seconds", type=float, default=150.0, help="of a peer's run")
    parser.add_argument("--scenarios", type=int, default=16, help="of each suite")
    parser.add_argument("--peer", choices=PEERS, help=argparse.SUPPRESS)  # in its own process
    parser.add_argument("--seed", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--coarse", type=int, default=COARSE, help=argparse.SUPPRESS)
    parser.add_argument("--began", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.peer:
        peer(args)
        return 0
    for name in set(args.contenders) - set(OURS):
        package = PACKAGES[name.split("-")[0]]
        if importlib.util.find_spec(package) is None:
            return complain(
                f"contender {name} needs {package}, which is not installed (see the docstring); "
                "choose others with --contenders quick default"
            )
    if args.json and not args.json.absolute().parent.is_dir():
        return complain(f"cannot write {args.json}: its folder does not exist")
    known = args.json and args.json.is_file()
    saved = json.loads(args.json.read_text()) if known else {}
    rows, size = saved.get("rows", []), {x: getattr(args, x) for x in ("scenarios", "seconds")}
    for flag, value in size.items():
        if rows and saved.get(flag) != value:
            return complain(
                f"{args.json} was measured with --{flag} {saved.get(flag)}, not {value}; go on "
                "with that, or name another file"
            )
    code = 0
    with tempfile.TemporaryDirectory() as work:
        try:
            for seed, name in itertools.product(args.seeds, args.contenders):
                if any((x["contender"], x["seed"]) == (name, seed) for x in rows):
                    continue
                common.log(f"{name}, seed {seed}:")
                points = (run_ours if name in OURS else run_peer)(name, seed, args, Path(work))
                rows.append({"contender": name, "seed": seed, "points": points})
                common.save(args.json, rows, **size)
        except (ContenderError, OSError) as error:
            code = complain(str(error))
        except KeyboardInterrupt:
            code = INTERRUPTED
    if rows:  # an unfinished table is shown, and kept out of the page
        common.publish("peers", table_lines(rows, args.scenarios), None if code else args.write)
    return code


def complain(message: str) -> int:
    """Says what is wrong in a sentence; returns the exit code."""
    common.log(f"peers: {message}")
    return 2


if __name__ == "__main__":
    sys.exit(main())
