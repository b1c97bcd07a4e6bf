"""Digest of the code that decides a result: a saved result of other code is out of date."""

import hashlib
from pathlib import Path

import mujoco

from mjx_balance.evaluation import envelope
from mjx_balance.files.sources import PACKAGE, code


def code_digest(package: Path = PACKAGE) -> str:
    """Digest of MuJoCo's version and of the evaluation's code, with all that it imports.

    Comments and docstrings do not count.

    Args:
      package: folder of mjx_balance.

    Returns:
      16 hexadecimal digits.
    """
    sources = code(envelope.__name__, package)
    parts = [mujoco.__version__, *(f"{name}:{text}" for name, text in sorted(sources.items()))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
