"""Policy files: safetensors with float32 weights, and a JSON manifest in the metadata. No JAX."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from mjx_balance.errors import quote
from mjx_balance.files.run_folder import RunFolder, write_atomically
from mjx_balance.policy.manifest import PolicyError, naming, upgrade
from mjx_balance.policy.network import Policy
from mjx_balance.runtime import MOST_BYTES, MOST_HEADER, MOST_MANIFEST, MOST_WEIGHTS


def flat_weights(params: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Flattens a flax network's variables to {name: float32 array}, e.g. `hidden_0/kernel`."""
    weights = {}
    for layer, value in params.get("params", params).items():
        arrays = value.items() if isinstance(value, Mapping) else [("", value)]
        for name, array in arrays:
            key = f"{layer}/{name}" if name else layer
            weights[key] = np.ascontiguousarray(array, np.float32)
    return weights


def save_policy(
    path: str | os.PathLike[str], params: Mapping[str, Any], manifest: dict[str, Any]
) -> Policy:
    """Writes a policy file atomically.

    Args:
      path: file to write.
      params: the flax network's variables, {"params": {layer: {kernel, bias}, name: array}}, or
        arrays by name.
      manifest: from `make_manifest`.

    Raises:
      PolicyError: if weights and manifest do not match.
      OSError: if the file cannot be written.
    """
    weights = flat_weights(params)
    policy = Policy(manifest, weights)
    content = safetensors.numpy.save(weights, metadata={"manifest": json.dumps(manifest)})
    write_atomically(Path(path), content)
    return policy


def convert_policy(
    path: Path, out: Path, action: str | None = None, leg_trim: np.ndarray | None = None
) -> Policy:
    """Writes a policy file of format 4 or 5 in format 5, atomically, with the same weights.

    Args:
      path: file to read.
      out: file to write; may be the same.
      action: `config.task.action` of the new file; None: as before.
      leg_trim: (legs, 3) trim for the new file, rad; None: as before.

    Raises:
      PolicyError: if `path` is not a policy of these formats, or its head allows no such action.
      OSError: if `out` cannot be written; an old file then stays.
    """
    manifest, weights = upgrade_policy(path, action, leg_trim)
    return save_policy(out, weights, manifest)


def upgrade_policy(
    path: Path, action: str | None = None, leg_trim: np.ndarray | None = None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Manifest and weights that `convert_policy` writes; raises the same, except `OSError`."""
    manifest, weights = read_policy(path)
    with naming(path):
        policy = Policy(upgrade(manifest), weights)
        manifest = (policy if action is None else policy.with_action(action)).manifest
    if leg_trim is not None:
        manifest = manifest | {"leg_trim_rad": leg_trim.tolist()}
    return manifest, weights


def shipped_policies() -> dict[str, Path]:
    """Returns the files of the shipped policies by name: `best`, and one for each other robot."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "policies"
    folder = installed if installed.is_dir() else package.parent / "policies"
    files = [*folder.glob("*.safetensors"), *(folder / "robots").glob("*.safetensors")]
    return {path.stem: path for path in sorted(files)}


def find_policy(name: str | os.PathLike[str]) -> Path:
    """Finds a policy file.

    Args:
      name: path of the file or of a run folder, or the name of a shipped policy.

    Raises:
      PolicyError: if there is none.
    """
    try:
        path, shipped = Path(name), shipped_policies()
    except TypeError:
        raise PolicyError(f"policy is {quote(name)}; it must be a path or a name") from None
    try:
        for file in (path, RunFolder(path).policy):
            if file.is_file():
                return file
    except OSError as error:  # a name that is too long
        raise PolicyError(
            f"policy is {quote(str(path))}; it cannot be read: {error.strerror}"
        ) from error
    if str(path) not in shipped:
        raise PolicyError(
            f"no policy file at {path}; `mjx-balance train` writes one, and "
            f"{', '.join(shipped)} are shipped"
        )
    return shipped[str(path)]


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Loads a policy.

    Args:
      path: path of the file or of a run folder, or the name of a shipped policy.

    Returns:
      A callable: observations (obs_size,) or (batch, obs_size) -> action indices () or (batch,).

    Raises:
      PolicyError: if the file is missing, truncated, or not a policy that this release can run.
    """
    path = find_policy(path)
    manifest, weights = read_policy(path)
    with naming(path):
        return Policy(manifest, weights)


def read_policy(path: Path) -> tuple[Any, dict[str, np.ndarray]]:
    """Reads manifest (JSON) and weights by name of a policy file of any version.

    Raises:
      PolicyError: if the file is not safetensors with float32 weights and a JSON manifest.
    """
    try:
        with naming(path):
            _check_size(path)
            with safetensors.safe_open(path, framework="numpy") as file:
                manifest, names = _manifest(file), list(file.keys())
                if len(names) > MOST_WEIGHTS:
                    raise PolicyError(f"it has {len(names)} weights, more than {MOST_WEIGHTS}")
                return manifest, {name: _weight(file, name) for name in names}
    except (safetensors.SafetensorError, OSError, UnicodeDecodeError) as error:
        raise PolicyError(f"{path} is damaged or no safetensors file: {error}") from error


def _check_size(path: Path) -> None:
    """Bounds what safetensors would read: the file, and the header, whose length comes first."""
    with path.open("rb") as file:
        header, size = int.from_bytes(file.read(8), "little"), path.stat().st_size
    if size > MOST_BYTES:
        raise PolicyError(f"it has {size} bytes; no policy has more than {MOST_BYTES}")
    if MOST_HEADER < header <= size:
        raise PolicyError(f"its header has {header} bytes; no policy has more than {MOST_HEADER}")


def _manifest(file: Any) -> Any:
    text = (file.metadata() or {}).get("manifest")
    if text is None:
        raise PolicyError("it carries no manifest, so it is no policy of mjx_balance")
    if len(text) > MOST_MANIFEST:
        raise PolicyError(f"its manifest has {len(text)} characters, more than {MOST_MANIFEST}")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise PolicyError(f"its manifest is no JSON: {error}") from error


def _weight(file: Any, name: str) -> np.ndarray:
    kind = file.get_slice(name).get_dtype()
    if kind != "F32":  # checked before reading: NumPy lacks some dtypes of safetensors
        raise PolicyError(f"weight {quote(name)} is {kind}; it must be F32 (float32)")
    return file.get_tensor(name)
