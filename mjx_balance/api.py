"""Training and evaluation in Python: `mjx_balance.train` and `mjx_balance.evaluate`."""

import dataclasses
import json
import os
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from mjx_balance.config import Config, preset, read_run_config
from mjx_balance.errors import InputError, how_to_install
from mjx_balance.evaluation import rollout
from mjx_balance.evaluation.suites import Suite, find_suite, suite_name
from mjx_balance.policy.file import load_policy
from mjx_balance.policy.network import Policy
from mjx_balance.quiet import quiet_imports
from mjx_balance.report.progress import Display
from mjx_balance.robots.catalogue import use_robot
from mjx_balance.robots.schema import RobotFile
from mjx_balance.sim.engines.table import unused_modules

if TYPE_CHECKING:
    from mjx_balance.dqn import Loss, Network
    from mjx_balance.training.callbacks import Callback, LogFunction
    from mjx_balance.training.own_policy import OwnPolicy


@dataclasses.dataclass(frozen=True, repr=False)
class TrainingResult:
    """The result of a training."""

    policy: "Policy | OwnPolicy"
    """The greedy policy; of several seeds the best on the validation scenarios. With a network of
    your own it is an `OwnPolicy`, which JAX runs."""
    metrics: list[dict[str, Any]]
    """The lines of metrics.jsonl, in their order; `pandas.DataFrame` takes them."""
    evaluation: dict[str, dict[str, Any]]
    """Suite name -> tilt and falls of the policy, JSON of `evaluation.rollout.summarize`."""
    run_dir: Path | None  #: the run folder, if one was asked for

    def __repr__(self) -> str:
        """Policy, and mean tilt and falls in every suite."""
        suites = [
            f"{name}: {x['tilt_deg']['mean']:.3f} deg, {x['falls']} of {x['scenarios']} fall"
            for name, x in self.evaluation.items()
        ]
        return f"TrainingResult({self.policy}; mean tilt in {'; '.join(suites)})"


def train(
    config: Config | str | None = None,
    run_dir: str | os.PathLike[str] | None = None,
    callbacks: "Iterable[Callback | LogFunction]" = (),
    progress: bool = True,
    *,
    resume: str | os.PathLike[str] | None = None,
    network: "Network | None" = None,
    loss: "Loss | None" = None,
) -> TrainingResult:
    """Trains a policy and evaluates it in plain MuJoCo, as `mjx-balance train` does.

    If the process has not used JAX yet, every CPU core becomes a JAX device; otherwise, JAX's
    devices stay as they are. In the main thread, Ctrl-C and SIGTERM save and stop the run; in any
    other thread, signals are left to the app.

    Args:
      config: a config, or a preset's name; None: preset "default", or that of the run to resume.
      run_dir: folder to create for the run, with checkpoints, figures and all else that
        `mjx-balance train` writes; None: no files remain. After an interrupt the folder remains
        in both cases, and the message names it.
      callbacks: functions of a line's metrics, or `Callback` objects.
      progress: whether to show progress on standard output.
      resume: run folder to continue, instead of `run_dir`.
      network: a Q-network of your own (`dqn.Network`); None: ours, as the config says.
      loss: a loss of one transition of your own, with the arguments of `dqn.td_error`; None: ours.

    Raises:
      ConfigError, RunFolderError, CheckpointError: for an argument that cannot be used; one
        sentence says why.
      PolicyError: if no seed learnt finite numbers.
      Interrupted: if the user stopped the run; the message says how to resume it.
    """
    if resume is not None and run_dir is not None:
        raise InputError("resume continues a folder in place; leave run_dir out")
    if config is None:
        config = preset("default") if resume is None else read_run_config(Path(resume))
    elif isinstance(config, str):
        config = preset(config)
    try:
        with quiet_imports("torch", *unused_modules(getattr(config, "engine", "mjx"))):
            from mjx_balance.training import run
            from mjx_balance.training.checkpoints import SaveError
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        raise InputError(
            f"training needs {package}, which is not installed; {how_to_install('train')}"
        ) from error
    folder = Path(run_dir or resume or tempfile.mkdtemp(prefix="mjx_balance-"))
    temporary = run_dir is None and resume is None
    path, stays = folder / "run" if temporary else folder, False
    try:
        finished = run.train(
            config,
            None if resume else path,
            path if resume else None,
            Display() if progress else Display(Console(quiet=True)),
            callbacks=callbacks,
            network=network,
            loss=loss,
            keep=not temporary,
        )
        assert finished is not None  # there is one process
        with finished.folder.metrics.open(encoding="utf-8") as lines:
            metrics = [json.loads(line) for line in lines]
    except (run.Interrupted, SaveError):
        stays = True
        raise
    finally:
        if temporary and not stays:
            shutil.rmtree(folder, ignore_errors=True)
    return TrainingResult(
        finished.policy, metrics, finished.evaluation, None if temporary else path
    )


def evaluate(
    policy: "Policy | OwnPolicy | str | os.PathLike[str]",
    suite: str | Suite = "paper",
    scenarios: int = 256,
    duration: float = 60.0,
    seed: int = 0,
    *,
    robot: str | RobotFile | None = None,
    progress: bool = False,
) -> dict[str, Any]:
    """Evaluates a policy in plain MuJoCo on all cores, as `mjx-balance evaluate` does; no JAX.

    Args:
      policy: a policy, its file, a run folder, or the name of a shipped policy.
      suite: a suite's name, or a `Suite` of your own.
      scenarios: number of scenarios.
      duration: of a scenario, s.
      seed: of the scenarios; the same seed gives the same scenarios.
      robot: of the policy, if it is not a shipped one: a TOML file, menagerie:NAME, or a
        `RobotFile`.
      progress: whether to show progress on standard output.

    Returns:
      JSON values (`evaluation.rollout.summarize`): `tilt_deg` with `mean`, `p95` and `max`, `falls`
      of `scenarios`, and more.

    Raises:
      PolicyError, SuiteError, EvaluationError: for an argument that cannot be used; one sentence
        says why.
    """
    find_suite(suite)
    if isinstance(policy, (str, os.PathLike)):
        policy = load_policy(policy)
    name = use_robot(robot) if isinstance(robot, RobotFile) else robot
    display = Display() if progress else Display(Console(quiet=True))
    with display.bar(f"evaluating, suite {suite_name(suite)}") as bar:
        return rollout.evaluate(policy, suite, scenarios, duration, seed, bar, name)
