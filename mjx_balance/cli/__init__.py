"""The command line, `mjx-balance`: one module per command, imported when it runs."""

import errno
import importlib
import io
import sys
from collections.abc import Sequence

from mjx_balance.errors import FAILED, INTERRUPTED, USAGE_ERROR, InputError

COMMANDS = {
    "train": "train:train",
    "sweep": "train:sweep",
    "evaluate": "evaluate:evaluate",
    "report": "report:report",
    "export": "export:export",
    "replay": "replay:replay",
    "view": "view:view",
    "robot": "robot:robot",
}
"""Command -> `module:function` of this package; functions return an exit code."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  #: no fault of the input


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns 0, 1 for failures, 2 for invalid input, 130 after Ctrl-C."""
    from mjx_balance.cli.common import HELP, complain

    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal may know ASCII alone
        sys.stdout.reconfigure(errors="backslashreplace")
    name, *argv = list(sys.argv[1:] if arguments is None else arguments) or [""]
    if name not in COMMANDS:
        print(f"usage: mjx-balance {{{','.join(COMMANDS)}}} ... (--help after one lists its flags)")
        if name and name not in HELP:
            complain(f"unknown command {name!r}; known commands: {', '.join(COMMANDS)}")
        return 0 if name in HELP else USAGE_ERROR
    module, _, function = COMMANDS[name].partition(":")
    command = getattr(importlib.import_module(f"mjx_balance.cli.{module}"), function)
    try:
        return command(argv)
    except InputError as error:
        return complain(str(error))
    except OSError as error:
        message = f"cannot write {error.filename or 'all of it'}: {error.strerror}"
        return complain(message, FAILED if error.errno in NO_ROOM else USAGE_ERROR)
    except KeyboardInterrupt:
        return INTERRUPTED
