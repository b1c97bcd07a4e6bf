"""Converts policy files of format 4 to format 5; the weights stay the same bits.

Format 4 has only names and scales of the observation; format 5 has the rows as `inputs`.
"""

from pathlib import Path
from typing import Any

from mjx_balance.policy.file import read_policy, write_policy
from mjx_balance.policy.manifest import (
    CONVERTIBLE,
    FORMAT,
    FORMAT_VERSION,
    PolicyError,
    config_and_robot,
    describe,
)
from mjx_balance.policy.network import Policy


def convert_policy(path: Path, out: Path) -> Policy:
    """Converts a policy file of format 4 or 5 to format 5; writes atomically.

    Args:
      path: file to read.
      out: file to write; may be the same.

    Returns:
      The policy.

    Raises:
      PolicyError: if `path` is not a policy of these formats.
      OSError: if `out` cannot be written; an old file then stays.
    """
    manifest, weights = read_policy(path)
    try:
        return write_policy(out, weights, upgrade(manifest))
    except PolicyError as error:
        raise PolicyError(f"{path} cannot be used: {error}") from error


def upgrade(manifest: Any) -> Any:
    """Returns a manifest of format 4 in format 5, and anything else unchanged."""
    if not isinstance(manifest, dict):
        return manifest
    if (manifest.get("format"), manifest.get("version")) != (FORMAT, CONVERTIBLE):
        return manifest
    parts = ("format", "config", "scene_hash", "versions", "training")
    config, robot = config_and_robot(manifest)
    return {
        **{name: manifest[name] for name in parts},
        **describe(config, robot),
        "version": FORMAT_VERSION,
    }
