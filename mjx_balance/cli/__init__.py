"""The command line, `mjx-balance`: one module per command, imported when it runs."""

import errno
import importlib
import importlib.metadata
import io
import os
import sys
from collections.abc import Sequence

from mjx_balance.cli import words
from mjx_balance.cli.words import COMMANDS, HELP, HELP_ALL, complain
from mjx_balance.errors import FAILED, INTERRUPTED, USAGE_ERROR, InputError, quote, suggest
from mjx_balance.quiet import import_mujoco

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  #: no fault of the input


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns 0, 1 for failures, 2 for invalid input, 130 after Ctrl-C."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal may know ASCII alone
        sys.stdout.reconfigure(errors="backslashreplace")
    name, *argv = list(sys.argv[1:] if arguments is None else arguments) or [""]
    if name == "--version":
        print(f"mjx-balance {importlib.metadata.version('mjx_balance')}")
        return 0
    if name not in COMMANDS:
        if name and name not in HELP:
            remedy = suggest("command", name, COMMANDS)
            return complain(f"unknown command {quote(name)}; {remedy}")
        print(words.overview())
        return 0 if name in HELP else USAGE_ERROR
    try:
        return _run(name, argv)
    except InputError as error:
        return complain(str(error))
    except OSError as error:
        message = f"cannot write {error.filename or 'all of it'}: {error.strerror}"
        return complain(message, FAILED if error.errno in NO_ROOM else USAGE_ERROR)
    except KeyboardInterrupt:
        return INTERRUPTED


def _run(name: str, argv: list[str]) -> int:
    """Runs a known command; what is spelt wrong is refused before its module is imported."""
    text = words.command_help(name)
    if text is not None and set(HELP) & set(argv):
        print(text, end="")
        return 0
    words.check_words(name, argv)
    if name in ("train", "sweep") and HELP_ALL not in argv:
        words.first_line(argv)
    if os.environ.get("MUJOCO_GL") and name != "completion":
        import_mujoco()
    module, _, function = COMMANDS[name].function.partition(":")
    command = getattr(importlib.import_module(f"mjx_balance.cli.{module}"), function)
    return command(["--help" if word == HELP_ALL else word for word in argv])
