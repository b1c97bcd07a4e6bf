"""Keeps the libraries' imports quiet and short: what they print, what they import beside."""

import contextlib
import io
import os
import sys
from collections.abc import Iterator

UNUSED = "torch"


@contextlib.contextmanager
def quiet_imports() -> Iterator[None]:
    """Hides MJX's note that its Warp backend is absent, and what XLA says of cached programs.

    XLA reads its log level when it is first imported, so import JAX in here. tensorboardX would
    import PyTorch where it is installed, which takes longer than all the rest: it is hidden too,
    unless it is imported already.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    hidden = UNUSED not in sys.modules
    if hidden:
        sys.modules[UNUSED] = None  # pyright: ignore[reportArgumentType]
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        if hidden:
            del sys.modules[UNUSED]
