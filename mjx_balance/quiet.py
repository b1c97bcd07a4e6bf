"""Keeps the libraries' imports quiet and short: what they print, what they import beside."""

import contextlib
import io
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def quiet_imports(*unused: str) -> Iterator[None]:
    """Hides MJX's note that its Warp backend is absent, and what XLA says of cached programs.

    XLA reads its log level when it is first imported, so import JAX in here.

    Args:
      unused: packages that the imported libraries would do without, and that take longer than all
        the rest: PyTorch (tensorboardX looks for it), Warp (MJX). They seem not to be installed,
        unless they are imported already.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    hidden = [name for name in unused if name not in sys.modules]
    for name in hidden:
        sys.modules[name] = None  # pyright: ignore[reportArgumentType]
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        for name in hidden:
            del sys.modules[name]
