"""Rewrites policy files of format 4 as format 5; weights stay bit for bit.

Format 4 described the observation by names and scales; a runtime had to derive the layout from
the config.
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
    """Writes a policy file of format 4 or 5 as one of format 5, whole or not at all.

    Args:
      path: of the file to read.
      out: of the file to write; may be the same.

    Raises:
      PolicyError: if it is no such policy.
      OSError: if it cannot be written; what was there before is then still there.
    """
    manifest, weights = read_policy(path)
    try:
        return write_policy(out, weights, upgrade(manifest))
    except PolicyError as error:
        raise PolicyError(f"{path} cannot be used: {error}") from error


def upgrade(manifest: Any) -> Any:
    """The manifest in format 5, if it is one of format 4; anything else unchanged."""
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
