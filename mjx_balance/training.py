"""A run: its folder, the loop, checkpoints, and at the end the policy and its evaluation."""

import contextlib
import dataclasses
import json
import math
import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import psutil
from tensorboardX import SummaryWriter

from mjx_balance import evaluation, figures, report
from mjx_balance.checkpoint import Checkpoints
from mjx_balance.config import Config, ConfigError, check, to_dict
from mjx_balance.display import Display
from mjx_balance.dqn.learner import Learner, TrainState
from mjx_balance.dqn.networks import QNetwork
from mjx_balance.env import BalanceEnv
from mjx_balance.policy import Policy, flat_weights, load_policy, make_manifest, save_policy
from mjx_balance.program_cache import compile_cached, digest, enable_compilation_cache
from mjx_balance.run_folder import RunFolder, check_same_config, create_run_folder, read_run_config
from mjx_balance.statistics import over_seeds

STATE_COPIES = 2
"""A checkpoint is read back beside the state that it replaces."""
PROGRAM_BYTES = 1.3 * 2**30
"""Memory of a run besides its state: libraries, compiler, program (benchmarks/README.md)."""
CPU_ENVS = 256
ACCELERATOR_ENVS = 2048
PER_SEED = ("tilt_deg", "falls_per_minute", "reward", "loss")
"""Metrics that are also logged for every seed, where there are several."""
EVALUATED = ("paper", "corner")
"""Suites of the evaluation after training."""
EVALUATION_SEED = 1_000_000
"""Seed of the final evaluation's scenarios; training draws from other generators."""
VALIDATION_SEED = 3_000_000
"""Seed of the scenarios that choose among several training seeds; never reported."""
VALIDATION_SCENARIOS = 32


class Interrupted(Exception):
    """The user stopped the run; everything is saved."""


def configure_jax() -> None:
    """Makes every CPU core a JAX device and turns the compilation cache on."""
    # Too late if JAX is already in use, as in a notebook: its devices do as they are.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
    enable_compilation_cache()


def size_to_device(config: Config) -> Config:
    """Fills in what the config leaves to the device.

    Raises:
      ConfigError: if the boards cannot be spread over that many devices.
    """
    available = jax.devices()
    on_cpu = available[0].platform == "cpu"
    num_envs, dqn = config.num_envs, config.dqn
    if num_envs is None:
        num_envs = CPU_ENVS if on_cpu else ACCELERATOR_ENVS
        # More boards at once must not mean fewer updates per decision.
        updates = dqn.updates_per_step * num_envs // CPU_ENVS
        dqn = dataclasses.replace(dqn, updates_per_step=updates)
    if config.num_devices is None:
        # As many as share the boards and the batch out evenly.
        num_devices = next(
            n
            for n in range(len(available), 0, -1)
            if num_envs % n == 0 and config.dqn.batch_size % n == 0
        )
    else:
        num_devices = config.num_devices
        if num_devices > len(available):
            raise ConfigError(
                f"num_devices is {num_devices}; this machine has {len(available)} JAX devices"
            )
        for name, value in (("num_envs", num_envs), ("batch_size", config.dqn.batch_size)):
            if value % num_devices:
                raise ConfigError(
                    f"{name} is {value}; it must be a multiple of num_devices, {num_devices}"
                )
    sized = dataclasses.replace(config, num_envs=num_envs, num_devices=num_devices, dqn=dqn)
    return check(sized)


def make_learner(config: Config, env: BalanceEnv) -> Learner:
    """The DQN for a config that `size_to_device` has completed."""
    assert config.num_envs is not None
    assert config.num_devices is not None
    return Learner(
        env,
        QNetwork(config.dqn.hidden_sizes, action_factors(config, env), config.dqn.head == "radial"),
        config.dqn,
        config.num_envs,
        config.num_env_steps,
        jax.devices()[: config.num_devices],
        config.num_seeds,
        env.symmetries if config.dqn.mirror else None,
        env.action_factors,
    )


def check_memory(config: Config, learner: Learner) -> None:
    """Refuses a state that would not fit, before anything is allocated.

    Raises:
      ConfigError: with the estimate.
    """
    shapes = jax.eval_shape(lambda: learner.init(config.seed))
    state = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(shapes))
    needed = STATE_COPIES * state + PROGRAM_BYTES
    device = learner.mesh.devices.ravel()[0]
    if device.platform == "cpu":
        available = psutil.virtual_memory().available
    else:
        needed /= learner.num_devices
        available = (device.memory_stats() or {}).get("bytes_limit", math.inf)
    if needed > available:
        raise ConfigError(
            f"num_seeds is {config.num_seeds}, num_envs {config.num_envs} and replay_capacity "
            f"{config.dqn.replay_capacity}: that takes about {needed / 2**30:.1f} GiB, and "
            f"{available / 2**30:.1f} GiB are free; lower one of them"
        )


def action_factors(config: Config, env: BalanceEnv) -> tuple[int, ...]:
    """Output branches of the network: all actions at once, or roll and pitch apart."""
    return (env.action_size,) if config.dqn.head == "joint" else env.action_factors


def train(
    config: Config, run_dir: Path | None, resume: Path | None, display: Display
) -> dict[str, Any]:
    """Runs or continues a training and everything that follows it.

    Args:
      config: what to train; when resuming, what the folder's own config must equal.
      run_dir: folder to create; one named after preset, seed and time if none.
      resume: folder to continue instead.
      display: shows progress.

    Returns:
      The evaluation, suite name -> JSON of `evaluation.summarize`.

    Raises:
      ConfigError: for an impossible config.
      RunFolderError: for a folder that cannot be used.
      Interrupted: if the user stopped the run, after saving it.
    """
    began = time.perf_counter()
    check(config)
    configure_jax()
    sized = size_to_device(config)
    env = BalanceEnv(sized)
    learner = make_learner(sized, env)
    check_memory(sized, learner)
    if resume is None:
        name = f"{config.preset}-seed{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
        folder = create_run_folder(run_dir or Path("runs") / name, sized)
    else:
        folder = RunFolder(resume)
        saved = read_run_config(resume)
        check_same_config(saved, sized, resume)
    with _stop_on_interrupt() as stop:
        state, seconds = _learn(sized, learner, folder, resume is not None, display, stop)
        policies = _export(sized, learner, folder, state, seconds)
        if stop:
            raise Interrupted(
                f"stopped at {_number(state.env_steps):,} decisions; the policy so far is "
                f"{folder.policy}; continue with --resume {folder.path}"
            )
    results = _evaluate(sized, policies, folder, display)
    with display.phase("drawing figures"):
        figures.draw_figures(folder.path, load_policy(folder.policy))
    folder.evaluation.write_text(json.dumps(results, indent=2) + "\n")
    report.print_summary(display.console, folder.path, results, time.perf_counter() - began)
    return results


def _learn(
    config: Config,
    learner: Learner,
    folder: RunFolder,
    resume: bool,
    display: Display,
    stop: list[int],
) -> tuple[TrainState, float]:
    """Trains until the last decision, or until the user stops; saves either way.

    Returns:
      The last state, and the seconds spent learning by this call.
    """
    last = config.seed + config.num_seeds - 1
    seeds = f"seed {last}" if last == config.seed else f"seeds {config.seed} to {last}"
    display.say(
        f"{folder.path}: preset {config.preset}, {seeds}, {config.num_envs} boards on "
        f"{config.num_devices} {jax.devices()[0].device_kind} device(s)"
    )
    checkpoints = Checkpoints(folder.checkpoints)
    assert config.num_envs is not None
    per_call = max(1, config.log_every // config.num_envs) * config.num_envs
    with display.phase("compiling (about a minute the first time, seconds from then on)"):
        state = learner.init(config.seed)
        key = digest(to_dict(config), per_call)
        program = compile_cached(learner.train_program(per_call // config.num_envs), state, key)
    if resume:
        state = checkpoints.restore(state)
        display.say(f"resuming at {_number(state.env_steps):,} decisions")
    _drop_metrics_after(folder.metrics, _number(state.env_steps))

    total = -(-config.num_env_steps // per_call) * per_call
    done = saved_at = _number(state.env_steps)
    seconds = 0.0
    with (
        folder.metrics.open("a") as log,
        SummaryWriter(str(folder.tensorboard)) as board,
        display.training(done, total),
    ):
        while done < total and not stop:
            began = time.perf_counter()
            state, raw = program(state)
            done = _number(state.env_steps)
            elapsed = time.perf_counter() - began
            seconds += elapsed
            raw = jax.device_get(raw)
            raw["falls_per_minute"] = raw.pop("fall") * 60 / config.task.ctrl_dt
            known = {name: np.ravel(x)[np.isfinite(np.ravel(x))] for name, x in raw.items()}
            mean = {name: float(x.mean()) for name, x in known.items() if x.size}
            metrics = _named(config, mean, config.num_seeds * per_call / elapsed)
            line: dict[str, Any] = {
                "env_steps": done,
                "gradient_steps": _number(state.gradient_steps),
                **metrics,
            }
            if config.num_seeds > 1:
                line["seeds"] = {
                    name: [x if math.isfinite(x) else None for x in raw[name].tolist()]
                    for name in PER_SEED
                }
            log.write(json.dumps(line) + "\n")
            log.flush()
            for name, value in metrics.items():
                board.add_scalar(name, value, done)
            display.update(done, metrics)
            if done // config.checkpoint_every > saved_at // config.checkpoint_every:
                checkpoints.save(done, state)
                saved_at = done
    checkpoints.save(done, state)
    checkpoints.close()
    return state, seconds


def _number(count: jax.Array) -> int:
    """A counter of the state, the same for every seed."""
    return int(np.ravel(count)[0])


def _named(config: Config, raw: dict[str, float], rate: float) -> dict[str, float]:
    """Metrics under the names they are logged by."""
    metrics = {f"train/{name}": value for name, value in raw.items()}
    metrics["perf/env_steps_per_second"] = rate
    metrics["perf/physics_steps_per_second"] = rate * config.task.sim_steps
    return metrics


def _export(
    config: Config, learner: Learner, folder: RunFolder, state: TrainState, seconds: float
) -> list[Policy]:
    """Writes one policy per seed; the first also as the run's, until a better one is known."""
    known = state._replace(env_state=None, replay=None)  # pyright: ignore[reportArgumentType]
    env = learner.env
    assert isinstance(env, BalanceEnv)
    policies = []
    for k in range(config.num_seeds):
        mine = jax.tree.map(lambda x: x[k], known) if config.num_seeds > 1 else known  # noqa: B023
        mine = jax.device_get(learner.exported(mine))
        provenance = {
            "env_steps": _number(state.env_steps),
            "gradient_steps": _number(state.gradient_steps),
            "seconds_learning_since_start_or_resume": round(seconds, 1),
            "device": jax.devices()[0].device_kind,
            "date": time.strftime("%Y-%m-%d"),
        }
        own = dataclasses.replace(config, seed=config.seed + k, num_seeds=1)
        manifest = make_manifest(own, env.scene.hash, action_factors(config, env), provenance)
        if config.num_seeds > 1:
            folder.seeds.mkdir(exist_ok=True)
            save_policy(folder.seeds / f"seed-{own.seed}.safetensors", mine, manifest)
        if k == 0:
            save_policy(folder.policy, mine, manifest)
        policies.append(Policy(manifest, flat_weights(mine)))
    return policies


def _evaluate(
    config: Config, policies: list[Policy], folder: RunFolder, display: Display
) -> dict[str, dict[str, Any]]:
    """Evaluates every seed; the run's policy becomes the one that validates best."""
    each = []
    for policy in policies:
        results = {}
        for suite in EVALUATED:
            title = f"evaluating in plain MuJoCo, suite {suite}"
            if len(policies) > 1:
                title += f", seed {policy.config.seed}"
            with display.bar(title) as bar:
                results[suite] = evaluation.evaluate(
                    policy, suite, config.eval_scenarios, config.eval_duration, EVALUATION_SEED, bar
                )
        each.append(results)
    best = _choose(config, policies, each, folder, display) if len(policies) > 1 else 0
    with SummaryWriter(str(folder.tensorboard)) as board:
        for suite, result in each[best].items():
            board.add_scalar(f"eval/{suite}/falls", result["falls"], config.num_env_steps)
            for name, value in result["tilt_deg"].items():
                board.add_scalar(f"eval/{suite}/tilt_{name}", value, config.num_env_steps)
    return each[best]


def _choose(
    config: Config,
    policies: list[Policy],
    each: list[dict[str, dict[str, Any]]],
    folder: RunFolder,
    display: Display,
) -> int:
    """Validates every seed, makes the best one the run's policy, writes seeds.json."""
    scores, rows = [], []
    for policy, results in zip(policies, each, strict=True):
        validated = []
        for suite in EVALUATED:
            with display.bar(f"validating seed {policy.config.seed}, suite {suite}") as bar:
                validated.append(
                    evaluation.evaluate(
                        policy,
                        suite,
                        VALIDATION_SCENARIOS,
                        config.eval_duration,
                        VALIDATION_SEED,
                        bar,
                    )
                )
        scores.append(
            (sum(r["falls"] for r in validated), sum(r["tilt_deg"]["mean"] for r in validated))
        )
        rows.append(
            {
                "seed": policy.config.seed,
                "validation": dict(zip(EVALUATED, validated, strict=True)),
                "evaluation": results,
            }
        )
    best = scores.index(min(scores))
    chosen = folder.seeds / f"seed-{policies[best].config.seed}.safetensors"
    shutil.copyfile(chosen, folder.policy)
    summary = {suite: over_seeds([results[suite] for results in each]) for suite in EVALUATED}
    written = {"best": policies[best].config.seed, "statistics": summary, "seeds": rows}
    folder.seeds_summary.write_text(json.dumps(written, indent=2) + "\n")
    display.say(f"best of the {len(policies)} seeds on the validation set: {written['best']}")
    display.console.print(report.seeds_table(summary))
    return best


@contextlib.contextmanager
def _stop_on_interrupt() -> Iterator[list[int]]:
    """Collects interrupt signals, so that the loop can stop between two calls.

    A second one interrupts at once.
    """
    received: list[int] = []

    def handler(number: int, frame: object) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)

    previous = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        previous[number] = signal.signal(number, handler)
    try:
        yield received
    finally:
        for number, old in previous.items():
            signal.signal(number, old)


def _drop_metrics_after(path: Path, env_steps: int) -> None:
    """Removes lines that a resumed run will write again, and what a crash left half-written."""
    if not path.is_file():
        return
    kept = []
    for text in path.read_text().splitlines():
        with contextlib.suppress(ValueError, KeyError, TypeError):
            if json.loads(text)["env_steps"] <= env_steps:
                kept.append(f"{text}\n")
    path.write_text("".join(kept))
