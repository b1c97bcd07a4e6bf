"""A run from its config to its last table."""

import contextlib
import functools
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax

from mjx_balance.config import Config, ConfigError, flatten, to_dict
from mjx_balance.config.serialization import check_same_config, read_run_config
from mjx_balance.dqn import DQN, Loss, Network, TrainState
from mjx_balance.envs.balance import BalanceEnv
from mjx_balance.errors import nearby, shell
from mjx_balance.evaluation.suites import HEADLINE, SEEDS, standing_still
from mjx_balance.files import run_folder
from mjx_balance.files.run_folder import RunFolder, RunFolderError, RunFolderExistsError
from mjx_balance.machine import cores
from mjx_balance.policy.file import PolicyError
from mjx_balance.report.progress import Display
from mjx_balance.sim.engines.table import ENGINES
from mjx_balance.training import checkpoints, finish, profiling, program_cache, sizing
from mjx_balance.training.callbacks import Callback, Callbacks, LogFunction
from mjx_balance.training.loop import Interrupts, Program, Run, learn, number
from mjx_balance.training.processes import Cluster, Interrupted, Processes, joined
from mjx_balance.training.validation import AnyPolicy, validate

STILL_SCENARIOS = 32  #: by which a robot that stands still is judged
SHARED = (ConfigError, RunFolderError, checkpoints.CheckpointError, PolicyError)
"""Errors that all processes of a run raise together."""


def train(
    config: Config,
    run_dir: Path | None,
    resume: Path | None,
    display: Display,
    cluster: Cluster | None = None,
    profile: bool = False,
    *,
    callbacks: Iterable[Callback | LogFunction] = (),
    network: Network | None = None,
    loss: Loss | None = None,
    keep: bool = True,
) -> finish.Finished | None:
    """Runs or continues a training and everything that follows it.

    A new run has the folder `run_dir`, or one named after preset, seed and time; `resume` is the
    folder of a run to continue, with the same config. Of several processes (`cluster`) the first
    one writes, shows and evaluates, and calls the `callbacks`. `profile` traces a call of the
    training program and sums it up. `network` and `loss` replace ours, as in `sizing.make_learner`.
    Without `keep`, no figures are drawn in the folder.

    Returns policy, evaluation and folder; None in the other processes.
    Raises `ConfigError`, `RunFolderError`, `CheckpointError` or `ProcessError` for what cannot be
    used, `PolicyError` if no seed learnt finite numbers, `Interrupted` if the user stopped the run.
    """
    start_time, listeners = time.perf_counter(), Callbacks(callbacks)
    with jax.enable_x64(False), joined(cluster, SHARED) as processes:
        sizing.configure_jax(display.say, _num_cores(config, resume, processes))
        sized, env, learner = processes.run_on_all(
            lambda: _set_up(config, network, loss), ConfigError
        )
        if growth := sizing.describe_growth(config, sized):
            display.say(growth)
        own = {"network": network and type(network).__name__, "loss": loss and _name(loss)}
        today = provenance(env) | own
        flags = flatten(to_dict(sized)) | {"run_dir": str(run_dir), "resume": str(resume)}
        processes.check_same(flags | today)
        path = processes.broadcast(
            lambda: str(_open_folder(sized, today, run_dir, resume, display)), RunFolderError
        )
        if not processes.first:
            listeners = Callbacks()
        folder = RunFolder(Path(path))
        still = _standing_still(sized, env) if processes.first else {}
        run = Run(sized, env, learner, folder, display, processes, listeners, own, keep, still)
        _announce(run)
        with _locked(run), contextlib.closing(listeners):
            processes.run_on_all(lambda: listeners.on_start(sized, folder.path), ConfigError)
            policies = _learn(run, profile)
            processes.leave()  # what follows takes minutes of one process, and no device
            if not processes.first:
                return None
            finished = finish.finish(run, policies, start_time)
            listeners.on_end(finished.evaluation)
            return finished


def _name(function: Loss) -> str:
    return getattr(function, "__name__", type(function).__name__)


def _num_cores(config: Config, resume: Path | None, processes: Processes) -> int:
    """CPU cores to make devices: to resume a run, as many as it has had, which share the cores."""
    had = (config.num_devices or 1) // processes.count if resume else 1
    return max(processes.cores or cores(), had)


def _set_up(
    config: Config, network: Network | None, loss: Loss | None
) -> tuple[Config, BalanceEnv, DQN]:
    """Sizes a run to the devices; envs that nobody asked for are halved until they fit."""
    most = None
    while True:
        sized = sizing.size_to_device(config, most)
        finish.check_fits(sized)
        env = BalanceEnv(sized)
        learner = sizing.make_learner(sized, env, network, loss)
        try:
            sizing.check_memory(learner)
            return sized, env, learner
        except ConfigError:
            if config.num_envs is not None or learner.spec.num_envs <= sizing.CPU_ENVS:
                raise
            most = learner.spec.num_envs // 2


def _standing_still(config: Config, env: BalanceEnv) -> dict[str, float]:
    """Mean tilt, deg, of a robot that stands still in the suites of a validation."""
    task, robot = env.scene.task, env.scene.robot
    size = (STILL_SCENARIOS, config.validation_duration, SEEDS.validation)
    return {suite: standing_still(task, robot, suite, *size) for suite in HEADLINE}


def provenance(env: BalanceEnv) -> dict[str, Any]:
    """What decides a run besides its config; a resumed run compares it with its own."""
    robot = to_dict(env.scene.robot)
    del robot["name"]  # of a file, which may be renamed
    return {
        "scene_hash": env.scene.hash,
        "engine": env.backend,
        **{f"robot_{name}": value for name, value in robot.items()},
        "versions": program_cache.versions(),
    }


def _open_folder(
    config: Config,
    today: dict[str, Any],
    run_dir: Path | None,
    resume: Path | None,
    display: Display,
) -> Path:
    """Creates the folder of a new run, or checks that of the run to continue."""
    if resume is not None:
        check_same_config(read_run_config(resume), config, resume)
        if warning := run_folder.check_same_provenance(resume, today):
            display.say(warning)
        return resume
    name = f"{config.preset}-seed{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    if config.robot.endswith(".toml"):  # for a resume from another folder
        today = today | {"robot_file": str(Path(config.robot).absolute())}
    path, count = run_dir or Path("runs") / name, 1
    while True:
        try:
            return run_folder.create_run_folder(path, to_dict(config), today).path.absolute()
        except RunFolderExistsError:
            if run_dir is not None:
                raise
            count += 1  # another run has begun in this second
            path = path.with_name(f"{name}-{count}")


def _announce(run: Run) -> None:
    """Logs what runs where; raises `RunFolderError` if a process cannot see the folder."""
    config, path = run.config, run.folder.path
    run.processes.advise(f"; continue with --resume {shell(path)}")
    visible = run.processes.gather(run.folder.config.is_file())
    if not all(visible):
        raise RunFolderError(
            f"process {visible.index(False)} does not see {path}; choose a folder that all "
            "machines share with --run-dir"
        )
    last = config.seed + run.num_seeds - 1
    seeds = f"seed {last}" if last == config.seed else f"seeds {config.seed} to {last}"
    run.display.say(
        f"{nearby(path)}: preset {config.preset}, {seeds}, {config.num_envs} envs on "
        f"{config.num_devices} {jax.devices()[0].device_kind} device(s)"
    )


@contextlib.contextmanager
def _locked(run: Run) -> Iterator[None]:
    """The lock of a run's folder, held by the first process; an interrupt becomes a sentence."""
    with contextlib.ExitStack() as stack:
        run.processes.broadcast(
            lambda: stack.enter_context(run_folder.locked(run.folder)), RunFolderError
        )
        try:
            yield
        except KeyboardInterrupt as error:  # the folder is whole anyway
            raise Interrupted(
                "stopped at once; continue from the last checkpoint with --resume "
                f"{shell(run.folder.path)}"
            ) from error


def _learn(run: Run, profile: bool) -> list[AnyPolicy]:
    """Learns to the last decision and exports; the first process alone gets the policies."""
    processes, folder = run.processes, run.folder
    with Interrupts(run.display.say) as stop:
        state, program = prepare(run, stop, profile)
        state, seconds = learn(run, program, state, stop, functools.partial(validate, run))
        if isinstance(program, profiling.Profiled) and not program.begun:
            run.display.say(profiling.TOO_SHORT)

        def export() -> list[AnyPolicy]:
            with stop.saving(folder.path):
                return finish.export(run, state, seconds) if processes.first else []
            return []  # a full disk

        policies = processes.run_on_all(export, PolicyError)
        resume = f"continue with --resume {shell(folder.path)}"
        exported = run.exportable and folder.policy.is_file()
        so_far = f"the policy so far is {folder.policy}; {resume}" if exported else resume
        if failure := next(filter(None, processes.gather(stop.failure)), None):
            raise checkpoints.SaveError(f"{failure}; {so_far}")
        if processes.any(stop.interrupted):
            raise Interrupted(f"stopped at {number(state.env_steps):,} decisions; {so_far}")
    return policies


def prepare(run: Run, stop: Interrupts, profile: bool = False) -> tuple[TrainState, Program]:
    """The state of the newest checkpoint or of a new run, and the compiled program."""
    program: Any = run.learner.train_program(run.iterations)
    say, processes = run.display.say, run.processes
    compiling = run.display.phase("compiling (up to a minute the first time, seconds from then on)")
    with compiling, program_cache.mending_xla_cache(say):
        state = stop.run(run.learner.init, run.config.seed)
        saved = checkpoints.restore(run.folder.checkpoints, state, say, processes)
        if saved is not None:
            state = saved
            say(f"resuming at {number(state.env_steps):,} decisions")
        if number(state.env_steps) < run.total:
            key = None
            if profile:  # caches keep no names to profile by
                jax.config.update("jax_enable_compilation_cache", False)
            elif ENGINES[run.config.engine].cacheable and not any(run.own.values()):
                key = program_cache.program_key(run.config, run.iterations, sizing.__name__)
            program = stop.run(program_cache.compile_program, program, state, key, say)
    processes.gather(None)  # whoever compiles longest is awaited here, where nothing times out
    if profile and processes.first:
        program = profiling.Profiled(program, run.folder.profile, say)
    return state, program
