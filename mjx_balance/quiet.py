"""Silences what the libraries print on import, which no user can act on."""

import contextlib
import io
import os
from collections.abc import Iterator


@contextlib.contextmanager
def quiet_imports() -> Iterator[None]:
    """Hides MJX's note that its Warp backend is absent, and what XLA says of cached programs.

    XLA reads its log level when it is first imported, so import JAX in here.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield
