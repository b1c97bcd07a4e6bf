"""A run from its config to its last table."""

import contextlib
import functools
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax

from mjx_balance.config import (
    Config,
    ConfigError,
    check,
    check_same_config,
    expand_runs,
    flatten,
    read_run_config,
    to_dict,
)
from mjx_balance.dqn import DQN, TrainState
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.files.run_folder import (
    RunFolder,
    RunFolderError,
    check_same_provenance,
    create_run_folder,
    locked,
    write_json,
)
from mjx_balance.policy.file import Policy, PolicyError
from mjx_balance.report.progress import Display
from mjx_balance.training import (
    checkpoints,
    finish,
    loop,
    profiling,
    program_cache,
    sizing,
    validation,
)
from mjx_balance.training.checkpoints import CheckpointError
from mjx_balance.training.processes import ALONE, Place, Processes, joined
from mjx_balance.training.program_cache import Say


class Interrupted(Exception):
    """The user stopped the run; the message says what is saved and how to go on."""


ORDERLY = (ConfigError, RunFolderError, CheckpointError, PolicyError, Interrupted)
"""How all processes of a run end together, besides its end."""


def train(
    config: Config,
    run_dir: Path | None,
    resume: Path | None,
    display: Display,
    place: Place | None = None,
    profile: bool = False,
) -> finish.Results | None:
    """Runs or continues a training and everything that follows it.

    Args:
      config: what to train; when resuming, what the folder's own config must equal.
      run_dir: folder to create; one named after preset, seed and time if none.
      resume: folder to continue instead.
      display: shows progress.
      place: of this process among several; the first one of them writes, shows and evaluates.
      profile: whether to trace a call of the training program and sum it up.

    Returns:
      The evaluation, suite name -> JSON of `evaluation.summarize`; none where another process
      makes it.

    Raises:
      ConfigError: for an impossible config.
      EvaluationError: for an evaluation that would not fit into the memory.
      RunFolderError: for a folder that cannot be used.
      CheckpointError: for a folder whose checkpoints are damaged.
      PolicyError: if no seed learnt a policy of finite numbers.
      ProcessError: if the processes do not come together or do not fit together.
      ProcessLostError: if another process has ended before its time.
      Interrupted: if the user stopped the run.
    """
    began = time.perf_counter()
    with joined(place, ORDERLY) as processes:
        sizing.configure_jax(display.say)
        wanted = config
        config, env, learner = processes.everywhere(lambda: _make(wanted), ConfigError)
        for line in sizing.grown(wanted, config):
            display.say(line)
        folder = _open_folder(config, provenance(env), run_dir, resume, display.say, processes)
        with _locked(folder, processes), _resumable(folder):
            with loop.Interrupts(display.say) as stop:
                validate = functools.partial(
                    validation.validate, config, learner, env.scene, folder
                )
                state, seconds = _learn(
                    config, learner, folder, display, stop, validate, processes, profile
                )
                policies: list[Policy] = []

                def export() -> None:
                    policies.extend(
                        finish.export(
                            config, learner, env.scene.hash, folder, state, seconds, display.say
                        )
                    )

                processes.from_first(export, PolicyError)
                if processes.any(bool(stop)):
                    raise Interrupted(
                        f"stopped at {loop.number(state.env_steps):,} decisions; the policy so far "
                        f"is {folder.policy}; continue with --resume {folder.path}"
                    )
            processes.part()  # what follows takes minutes of one process, and no device
            if not processes.first:
                return None
            return finish.finish(config, policies, folder, display, began)


def _make(config: Config) -> tuple[Config, BalanceEnv, DQN]:
    """The config, sized to the devices, its env and its learner, which fit into the memory."""
    most = None
    while True:
        sized = sizing.size_to_device(check(config), most)
        finish.check_fits(sized)
        env = BalanceEnv(sized)
        learner = sizing.make_learner(sized, env)
        try:
            sizing.check_memory(learner)
            return sized, env, learner
        except ConfigError:
            if config.num_envs is not None or learner.spec.num_envs <= sizing.CPU_ENVS:
                raise
            most = learner.spec.num_envs // 2


def provenance(env: BalanceEnv) -> dict[str, Any]:
    """What decides a run besides its config; a resumed run compares it with its own."""
    return {
        "scene_hash": env.scene.hash,
        "engine": env.backend,
        "versions": program_cache.versions(),
    }


def _open_folder(
    config: Config,
    today: Mapping[str, Any],
    run_dir: Path | None,
    resume: Path | None,
    say: Say,
    processes: Processes,
) -> RunFolder:
    """The folder of a new run, or of the run to continue; says what will run where.

    Raises:
      RunFolderError: if it cannot be used, or another process cannot see it.
      ProcessError: if other processes were started with something else.
    """
    flags = flatten(to_dict(config)) | {"run_dir": str(run_dir), "resume": str(resume)}
    processes.check_same(flags | dict(today))

    def open_it() -> str:
        if resume is None:
            name = f"{config.preset}-seed{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
            made = create_run_folder(run_dir or Path("runs") / name, to_dict(config), today)
            return str(made.path.absolute())
        check_same_config(read_run_config(resume), config, resume)
        warning = check_same_provenance(resume, today)
        if warning is not None:
            say(warning)
        return str(resume)

    folder = RunFolder(Path(processes.from_first(open_it, RunFolderError)))
    processes.folder = folder.path
    seen = processes.gather(folder.config.is_file())
    if not all(seen):
        raise RunFolderError(
            f"process {seen.index(False)} does not see {folder.path}; choose a folder that all "
            "machines share with --run-dir"
        )
    last = config.seed + len(expand_runs(config)) - 1
    seeds = f"seed {last}" if last == config.seed else f"seeds {config.seed} to {last}"
    say(
        f"{folder.path}: preset {config.preset}, {seeds}, {config.num_envs} envs on "
        f"{config.num_devices} {jax.devices()[0].device_kind} device(s)"
    )
    return folder


def _learn(
    config: Config,
    learner: DQN,
    folder: RunFolder,
    display: Display,
    stop: loop.Interrupts,
    validate: loop.Validate,
    processes: Processes = ALONE,
    profile: bool = False,
) -> tuple[TrainState, float]:
    """Goes on from the newest checkpoint, if there is one, to the last decision.

    Returns:
      The last state, and the seconds spent learning by this call.
    """
    plan = loop.make_plan(config, BalanceEnv.metrics)
    program = learner.train_program(plan.iterations)
    compiling = display.phase("compiling (up to a minute the first time, seconds from then on)")
    with compiling, program_cache.mending_xla_cache(display.say):
        state = stop.run(learner.init, config.seed)
        saved = checkpoints.restore(folder.checkpoints, state, display.say, processes)
        if saved is not None:
            state = saved
            display.say(f"resuming at {loop.number(state.env_steps):,} decisions")
        if loop.number(state.env_steps) < plan.total:
            # Warp's kernels live in this process; a cache keeps no names to profile by.
            key = None
            if config.engine != "warp" and not profile:
                key = program_cache.program_key(config, plan.iterations, sizing.__name__)
            if profile:
                jax.config.update("jax_enable_compilation_cache", False)
            program = stop.run(program_cache.compile_program, program, state, key, display.say)
            if profile and processes.first:
                shown = functools.partial(_shown, display, folder)
                program = profiling.Profiled(program, folder.profile, shown)
    processes.gather(None)  # whoever compiles longest is awaited here, where nothing times out
    learnt = loop.learn(plan, program, state, folder, display, stop, validate, processes)
    if profile and not (isinstance(program, profiling.Profiled) and program.begun):
        display.say(profiling.TOO_SHORT)
    return learnt


def _shown(display: Display, folder: RunFolder, shares: Mapping[str, float]) -> None:
    """Shows and keeps what a profile says."""
    write_json(folder.profile / "shares.json", shares)
    display.say(f"a call of the training program, traced in {folder.profile}:")
    for name, share in shares.items():
        display.say(f"  {name:<9}{share:6.1%}  {profiling.MEANING[name]}")


@contextlib.contextmanager
def _locked(folder: RunFolder, processes: Processes) -> Iterator[None]:
    """The lock of a run's folder, held by the first of its processes."""
    with contextlib.ExitStack() as stack:
        processes.from_first(lambda: stack.enter_context(locked(folder)), RunFolderError)
        yield


@contextlib.contextmanager
def _resumable(folder: RunFolder) -> Iterator[None]:
    """Turns an interrupt that nobody awaited into a sentence: the folder is whole anyway."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise Interrupted(
            f"stopped at once; continue from the last checkpoint with --resume {folder.path}"
        ) from error
