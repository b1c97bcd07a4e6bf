"""Exit codes of the commands, errors in the user's input, and text from outside made safe to show.

Safe text is one short line without control characters. `runtime.py`, one file for a robot, has a
copy of `shorten`.
"""

import difflib
import os
import shlex
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar

FAILED = 1
USAGE_ERROR = 2
INTERRUPTED = 130

MESSAGE = 300  #: greatest length of an error message, characters
PATH = 4096  #: of a path that a command prints for the user to copy


def printable(text: str) -> str:
    """Returns text with "?" for control characters, which a terminal would obey, and the like."""
    return "".join(x if x.isprintable() else "?" for x in text)


def shorten(text: object, limit: int = 80, tail: int = 0) -> str:
    """Returns text in one line of at most `limit` characters, without control characters.

    Args:
      text: any object; its `str` counts.
      limit: greatest length; "..." replaces the middle of longer text.
      tail: number of characters at the end to keep then.
    """
    whole = str(text)
    if len(whole) > 8 * limit:
        whole = f"{whole[: 4 * limit]} ... {whole[-4 * limit :]}"
    line = printable(" ".join(whole.split()))
    if len(line) <= limit:
        return line
    return f"{line[: limit - tail - 3]}...{line[len(line) - tail :]}"


def quote(value: object) -> str:
    """Returns a value's `repr`, shortened."""
    try:
        return shorten(repr(value))
    except ValueError:  # an int with too many digits
        return "a number of thousands of digits"


def suggest(kind: str, name: object, known: Iterable[str]) -> str:
    """Returns what the user may have meant by an unknown name, or else all known ones."""
    names = list(known)
    close = difflib.get_close_matches(str(name), names, n=1)
    return f"did you mean {close[0]}?" if close else f"known {kind}s: {', '.join(names)}"


def shell(path: Path) -> str:
    """Returns a path as a command's argument, quoted where the user's shell needs it."""
    name = printable(str(path))
    return subprocess.list2cmdline([name]) if os.name == "nt" else shlex.quote(name)


def nearby(path: Path) -> Path:
    """Returns a path below the working folder relative to it, any other unchanged."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def how_to_install(extra: str) -> str:
    """Returns the sentence that tells how to install an extra; the package is on no index."""
    return (
        f"the extra {extra} brings it: `pip install -e '.[{extra}]'` in a checkout, or "
        f"`pip install 'WHEEL[{extra}]'`"
    )


class InputError(ValueError):
    """Invalid input; the message is one sentence with the value, the reason and a remedy.

    Values and names in it may come from strangers, so that it is shortened and printable.
    """

    limit: ClassVar[int] = MESSAGE  #: greatest length of the message, characters

    def __init__(self, message: object = ""):
        super().__init__(shorten(message, self.limit, tail=self.limit // 3))
