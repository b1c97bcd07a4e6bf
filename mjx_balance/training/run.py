"""A run from its config to its last table."""

import time
from pathlib import Path

import jax

from mjx_balance.config import Config, check
from mjx_balance.display import Display
from mjx_balance.env import BalanceEnv
from mjx_balance.run_folder import RunFolder, check_same_config, create_run_folder, read_run_config
from mjx_balance.training import devices, finish, loop


class Interrupted(Exception):
    """The user stopped the run; everything is saved."""


def train(
    config: Config, run_dir: Path | None, resume: Path | None, display: Display
) -> finish.Results:
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
      CheckpointError: for a folder without a checkpoint to continue from.
      Interrupted: if the user stopped the run, after saving it.
    """
    began = time.perf_counter()
    check(config)
    devices.configure_jax()
    config = devices.size_to_device(config)
    env = BalanceEnv(config)
    learner = devices.make_learner(config, env)
    devices.check_memory(learner)
    folder = _open_folder(config, run_dir, resume)
    _announce(config, folder, display)
    with loop.stop_on_interrupt() as stop:
        state, seconds = loop.learn(config, learner, folder, resume is not None, display, stop)
        policies = finish.export(config, learner, env.scene.hash, folder, state, seconds)
        if stop:
            raise Interrupted(
                f"stopped at {loop.number(state.env_steps):,} decisions; the policy so far is "
                f"{folder.policy}; continue with --resume {folder.path}"
            )
    return finish.finish(config, policies, folder, display, began)


def _open_folder(config: Config, run_dir: Path | None, resume: Path | None) -> RunFolder:
    """The folder of a new run, or of the run to continue.

    Raises:
      RunFolderError: if it cannot be used.
    """
    if resume is None:
        name = f"{config.preset}-seed{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
        return create_run_folder(run_dir or Path("runs") / name, config)
    check_same_config(read_run_config(resume), config, resume)
    return RunFolder(resume)


def _announce(config: Config, folder: RunFolder, display: Display) -> None:
    last = config.seed + config.num_seeds - 1
    seeds = f"seed {last}" if last == config.seed else f"seeds {config.seed} to {last}"
    display.say(
        f"{folder.path}: preset {config.preset}, {seeds}, {config.num_envs} envs on "
        f"{config.num_devices} {jax.devices()[0].device_kind} device(s)"
    )
