"""Digest of the code that decides a result, so that a kept one is known to be out of date."""

import hashlib
from pathlib import Path

import mujoco

from mjx_balance.evaluation import rollout as evaluation
from mjx_balance.files.sources import PACKAGE, code


def code_digest(package: Path = PACKAGE) -> str:
    """Digest of the evaluation, which imports the controllers, and whatever else it imports.

    MuJoCo's version counts, too; comments and docstrings decide nothing.

    Args:
      package: folder of mjx_balance.

    Returns:
      16 hexadecimal digits.
    """
    found = code(evaluation.__name__, package)
    parts = [mujoco.__version__, *(f"{name}:{text}" for name, text in sorted(found.items()))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
