"""The files of a run's folder: their names, and whether they make a run. No JAX."""

import dataclasses
import json
from pathlib import Path

from mjx_balance.config import Config, check, flatten, from_dict, to_dict


class RunFolderError(ValueError):
    """A run folder that cannot be used; the message says why and what would do."""


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Where everything of a run lies."""

    path: Path

    @property
    def config(self) -> Path:
        return self.path / "config.json"

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.jsonl"

    @property
    def tensorboard(self) -> Path:
        return self.path / "tensorboard"

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def seeds_summary(self) -> Path:
        """Evaluation, validation and choice among several seeds."""
        return self.path / "seeds.json"

    @property
    def seeds(self) -> Path:
        """Policy and evaluation of every seed, where there are several."""
        return self.path / "seeds"

    @property
    def policy(self) -> Path:
        return self.path / "policy.safetensors"

    @property
    def evaluation(self) -> Path:
        return self.path / "evaluation.json"

    @property
    def figures(self) -> Path:
        return self.path / "figures"

    @property
    def report(self) -> Path:
        """What the report measured, so that it need not be measured again."""
        return self.path / "report.json"


def create_run_folder(path: Path, config: Config) -> RunFolder:
    """Makes a new run folder.

    Raises:
      RunFolderError: if it exists or cannot be written; nothing is touched then.
    """
    if path.exists():
        raise RunFolderError(
            f"run folder {path} exists; choose another with --run-dir, or continue it with "
            f"--resume {path}"
        )
    try:
        path.mkdir(parents=True)
        folder = RunFolder(path)
        folder.config.write_text(json.dumps(to_dict(config), indent=2) + "\n")
    except OSError as error:
        raise RunFolderError(
            f"run folder {path} cannot be written: {error.strerror}; choose another with --run-dir"
        ) from error
    return folder


def read_run_config(path: Path) -> Config:
    """Reads the config of an existing run.

    Raises:
      RunFolderError: if `path` is no run folder, or its run is finished.
    """
    folder = RunFolder(path)
    if not folder.config.is_file():
        raise RunFolderError(f"{path} is no run folder: it has no config.json")
    if folder.evaluation.is_file():
        raise RunFolderError(f"the run in {path} is finished; start a new one with --run-dir")
    try:
        return check(from_dict(Config, json.loads(folder.config.read_text())))
    except (ValueError, TypeError, OSError) as error:
        raise RunFolderError(f"{folder.config} cannot be used: {error}") from error


def check_same_config(saved: Config, wanted: Config, path: Path) -> None:
    """Refuses to resume a run as another one.

    Raises:
      RunFolderError: naming the first field that differs.
    """
    before, after = flatten(to_dict(saved)), flatten(to_dict(wanted))
    for name, value in after.items():
        if before[name] != value:
            raise RunFolderError(
                f"{path} was started with {name} = {before[name]}, not {value}; resume it "
                "without that flag, or start a new run"
            )
