"""Imports of libraries: silent, without optional packages, whatever MUJOCO_GL says."""

import contextlib
import io
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def quiet_imports(*unused: str) -> Iterator[None]:
    """Hides MJX's note on its missing Warp backend, and XLA's log messages on cached programs.

    Import JAX inside this context: XLA reads its log level at import.

    Args:
      unused: optional packages to hide from the imported libraries, because they are slow to
        import: PyTorch (for tensorboardX), Warp (for MJX). Packages that are already imported stay
        visible.
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


@contextlib.contextmanager
def matplotlib_imports() -> Iterator[None]:
    """Import Matplotlib in here: it fails if MPLBACKEND, as of a notebook, is not installed."""
    backend = None if "matplotlib" in sys.modules else os.environ.pop("MPLBACKEND", None)
    yield
    if backend is not None:
        os.environ["MPLBACKEND"] = backend
        with contextlib.suppress(ValueError):
            sys.modules["matplotlib"].rcParams["backend"] = backend


def import_mujoco() -> None:
    """Imports MuJoCo, also where MUJOCO_GL names a way to draw that this machine does not have.

    MuJoCo then fails while it is imported, though most of what we do draws nothing. Drawing itself
    still obeys the variable, in a process of its own, and reports the failure.
    """
    try:
        import mujoco
    except (AttributeError, RuntimeError):  # from PyOpenGL; from MuJoCo, for an unknown name
        chosen = os.environ.pop("MUJOCO_GL", "")
        try:
            import mujoco
        finally:
            os.environ["MUJOCO_GL"] = chosen
        # Its compiled modules cannot be loaded twice: the first attempt has left them here.
        for name, module in list(sys.modules.items()):
            parent, _, own = name.rpartition(".")
            if parent == "mujoco":
                setattr(mujoco, own, module)
