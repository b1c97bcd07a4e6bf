"""Shortens untrusted text to one line of a message; quotes paths for a shell."""

import os
import shlex
import subprocess
from pathlib import Path

MESSAGE = 300  #: greatest length of another library's error in a message, characters


def shorten(text: object, limit: int = 80) -> str:
    """Returns text in one line of at most `limit` characters, without control characters.

    Args:
      text: any object; its `str` counts.
      limit: greatest length; longer text ends in "...".
    """
    line = " ".join(str(text)[: 4 * limit].split())
    line = "".join(letter if letter.isprintable() else "?" for letter in line)
    cut = len(line) > limit or len(str(text)) > 4 * limit
    return f"{line[: limit - 3]}..." if cut else line


def quote(value: object) -> str:
    """Returns a value's `repr`, shortened."""
    try:
        return shorten(repr(value))
    except ValueError:  # an int with too many digits
        return "a number of thousands of digits"


def shell(path: Path) -> str:
    """Returns a path as a command's argument, quoted where the user's shell needs it."""
    return subprocess.list2cmdline([str(path)]) if os.name == "nt" else shlex.quote(str(path))
