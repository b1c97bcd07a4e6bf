"""A run from its config to its last table."""

import contextlib
import functools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax

from mjx_balance.config import (
    Config,
    ConfigError,
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
)
from mjx_balance.policy.file import Policy, PolicyError
from mjx_balance.report.progress import Display
from mjx_balance.sim.engines.table import ENGINES
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
from mjx_balance.training.cluster import Cluster
from mjx_balance.training.processes import ALONE, Processes, joined
from mjx_balance.training.program_cache import LogFn


class Interrupted(Exception):
    """The user stopped the run; the message says what is saved and how to go on."""


ORDERLY = (ConfigError, RunFolderError, CheckpointError, PolicyError, Interrupted)
"""How all processes of a run end together, besides its end."""


class Setup(NamedTuple):
    """What a run is made of; it fits the devices and their memory."""

    config: Config
    env: BalanceEnv
    learner: DQN


def train(
    config: Config,
    run_dir: Path | None,
    resume: Path | None,
    display: Display,
    cluster: Cluster | None = None,
    profile: bool = False,
) -> finish.Results | None:
    """Runs or continues a training and everything that follows it.

    Args:
      config: what to train; when resuming, what the folder's own config must equal.
      run_dir: folder to create; one named after preset, seed and time if None.
      resume: folder to continue instead.
      display: shows progress.
      cluster: place of this process among several; the first one writes, shows and evaluates.
      profile: whether to trace a call of the training program and sum it up.

    Returns:
      The evaluation, suite name -> JSON of `rollout.summarize`; None where another process
      makes it.

    Raises:
      ConfigError: for an impossible config, or an evaluation that would not fit into the memory.
      RunFolderError: for a folder that cannot be used.
      CheckpointError: for a folder whose checkpoints are damaged.
      PolicyError: if no seed learnt a policy of finite numbers.
      ProcessError: if the processes do not come together or do not fit together.
      Interrupted: if the user stopped the run.
    """
    start_time = time.perf_counter()
    with joined(cluster, ORDERLY) as processes:
        sizing.configure_jax(display.say, processes.cores)
        setup = processes.run_on_all(lambda: _set_up(config), ConfigError)
        for line in sizing.describe_growth(config, setup.config):
            display.say(line)
        folder = _open_folder(setup, run_dir, resume, display.say, processes)
        with _locked(folder, processes):
            policies = _learn(setup, folder, display, processes, profile)
            processes.leave()  # what follows takes minutes of one process, and no device
            if not processes.first:
                return None
            return finish.finish(setup.config, policies, folder, display, start_time)


def _set_up(config: Config) -> Setup:
    """Sizes a run to the devices; envs that nobody asked for are halved until they fit."""
    most = None
    while True:
        sized = sizing.size_to_device(config, most)
        finish.check_fits(sized)
        env = BalanceEnv(sized)
        learner = sizing.make_learner(sized, env)
        try:
            sizing.check_memory(learner)
            return Setup(sized, env, learner)
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
    setup: Setup,
    run_dir: Path | None,
    resume: Path | None,
    log_fn: LogFn,
    processes: Processes,
) -> RunFolder:
    """The folder of a new run, or of the run to continue; logs what will run where.

    Raises:
      RunFolderError: if it cannot be used, or another process cannot see it.
      ProcessError: if other processes were started with something else.
    """
    config, today = setup.config, provenance(setup.env)
    flags = flatten(to_dict(config)) | {"run_dir": str(run_dir), "resume": str(resume)}
    processes.check_same(flags | today)

    def create() -> str:
        name = f"{config.preset}-seed{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
        folder = create_run_folder(run_dir or Path("runs") / name, to_dict(config), today)
        return str(folder.path.absolute())

    def reopen() -> str:
        assert resume is not None
        check_same_config(read_run_config(resume), config, resume)
        if warning := check_same_provenance(resume, today):
            log_fn(warning)
        return str(resume)

    path = processes.broadcast(create if resume is None else reopen, RunFolderError)
    folder = RunFolder(Path(path))
    processes.advise(f"; continue with --resume {folder.path}")
    visible = processes.gather(folder.config.is_file())
    if not all(visible):
        raise RunFolderError(
            f"process {visible.index(False)} does not see {folder.path}; choose a folder that all "
            "machines share with --run-dir"
        )
    last = config.seed + len(expand_runs(config)) - 1
    seeds = f"seed {last}" if last == config.seed else f"seeds {config.seed} to {last}"
    log_fn(
        f"{folder.path}: preset {config.preset}, {seeds}, {config.num_envs} envs on "
        f"{config.num_devices} {jax.devices()[0].device_kind} device(s)"
    )
    return folder


@contextlib.contextmanager
def _locked(folder: RunFolder, processes: Processes) -> Iterator[None]:
    """The lock of a run's folder, held by the first process; an interrupt becomes a sentence."""
    with contextlib.ExitStack() as stack:
        processes.broadcast(lambda: stack.enter_context(locked(folder)), RunFolderError)
        try:
            yield
        except KeyboardInterrupt as error:  # the folder is whole anyway
            raise Interrupted(
                f"stopped at once; continue from the last checkpoint with --resume {folder.path}"
            ) from error


def _learn(
    setup: Setup, folder: RunFolder, display: Display, processes: Processes, profile: bool
) -> list[Policy]:
    """Learns to the last decision and exports; the first process alone gets the policies.

    Raises:
      PolicyError: if no seed has a policy.
      Interrupted: if the user stopped the run; the policies so far are exported.
    """
    plan = loop.make_plan(setup.config, BalanceEnv.metrics)
    validate = functools.partial(
        validation.validate, setup.config, setup.learner, setup.env.scene, folder
    )
    with loop.Interrupts(display.say) as stop:
        state, program = prepare(setup, plan, folder, display, stop, processes, profile)
        state, seconds = loop.learn(
            plan, program, state, folder, display, stop, validate, processes
        )
        if isinstance(program, profiling.Profiled) and not program.begun:
            display.say(profiling.TOO_SHORT)

        def export() -> list[Policy]:
            known = (setup.config, setup.learner, setup.env.scene.hash, folder)
            return finish.export(*known, state, seconds, display.say) if processes.first else []

        policies = processes.run_on_all(export, PolicyError)
        if processes.any(bool(stop)):
            raise Interrupted(
                f"stopped at {loop.number(state.env_steps):,} decisions; the policy so far is "
                f"{folder.policy}; continue with --resume {folder.path}"
            )
    return policies


def prepare(
    setup: Setup,
    plan: loop.Plan,
    folder: RunFolder,
    display: Display,
    stop: loop.Interrupts,
    processes: Processes = ALONE,
    profile: bool = False,
) -> tuple[TrainState, loop.Program]:
    """The state of the newest checkpoint, or a new run's, and the compiled program.

    Args:
      setup: of the run.
      plan: of the run.
      folder: of the run.
      display: shows what is done.
      stop: answers interrupts meanwhile.
      processes: that compile the same program.
      profile: whether to trace a call of it.
    """
    program: Any = setup.learner.train_program(plan.iterations)
    compiling = display.phase("compiling (up to a minute the first time, seconds from then on)")
    with compiling, program_cache.mending_xla_cache(display.say):
        state = stop.run(setup.learner.init, setup.config.seed)
        saved = checkpoints.restore(folder.checkpoints, state, display.say, processes)
        if saved is not None:
            state = saved
            display.say(f"resuming at {loop.number(state.env_steps):,} decisions")
        if loop.number(state.env_steps) < plan.total:
            key = None
            if profile:  # caches keep no names to profile by
                jax.config.update("jax_enable_compilation_cache", False)
            elif ENGINES[setup.config.engine].cacheable:
                key = program_cache.program_key(setup.config, plan.iterations, sizing.__name__)
            program = stop.run(program_cache.compile_program, program, state, key, display.say)
    processes.gather(None)  # whoever compiles longest is awaited here, where nothing times out
    if profile and processes.first:
        program = profiling.Profiled(program, folder.profile, display.say)
    return state, program
