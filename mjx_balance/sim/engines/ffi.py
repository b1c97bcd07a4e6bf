"""Calls a NumPy function from inside an XLA program on a CPU, without a copy and without locks.

`jax.pure_callback` copies its arguments to a device before it calls; with several host devices
that copy waits for a thread that the program itself occupies. A target of XLA's foreign function
interface is handed the buffers themselves. This is its C interface (xla/ffi/api/c_api.h in
`jax.ffi.include_dir()`), as far as it is needed here.
"""

import ctypes
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

METADATA = 1
"""`XLA_FFI_Extension_Metadata`: the call asks for the version that the handler was made for."""
INTERNAL = 13
"""`XLA_FFI_Error_Code_INTERNAL`."""
FLOAT32 = 11
"""`XLA_FFI_DataType_F32`."""


class _Extension(ctypes.Structure):
    """`XLA_FFI_Metadata_Extension`; only its beginning, if it is another extension."""


class _Version(ctypes.Structure):
    """`XLA_FFI_Api_Version`."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("major", ctypes.c_int),
        ("minor", ctypes.c_int),
    )


class _Metadata(ctypes.Structure):
    """`XLA_FFI_Metadata`, without what follows the version."""

    _fields_ = (("struct_size", ctypes.c_size_t), ("version", _Version))


_Extension._fields_ = (
    ("struct_size", ctypes.c_size_t),
    ("type", ctypes.c_int),
    ("next", ctypes.c_void_p),
    ("metadata", ctypes.POINTER(_Metadata)),
)


class _ErrorArguments(ctypes.Structure):
    """`XLA_FFI_Error_Create_Args`."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    )


class _Api(ctypes.Structure):
    """`XLA_FFI_Api`, as far as the constructor of errors."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        ("make_error", ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArguments))),
    )


class _Buffer(ctypes.Structure):
    """`XLA_FFI_Buffer`."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    )


class _Buffers(ctypes.Structure):
    """`XLA_FFI_Args` and `XLA_FFI_Rets`."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("buffers", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    )


class _Frame(ctypes.Structure):
    """`XLA_FFI_CallFrame`, as far as its results."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(_Extension)),
        ("api", ctypes.POINTER(_Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("arguments", _Buffers),
        ("results", _Buffers),
    )


_HANDLER = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Frame))


class _Target(NamedTuple):
    """A registered function, kept alive for as long as a program may call it."""

    handler: Any
    capsule: Any


_TARGETS: dict[str, _Target] = {}

HostFunction = Callable[[Sequence[np.ndarray], Sequence[np.ndarray]], None]
"""(arguments, results to be written), float32 arrays; they are gone once it returns."""


def register(name: str, function: HostFunction) -> None:
    """Makes a function known to XLA on CPUs.

    A name that is known already keeps its function, because programs may be calling it: a name
    must hold whatever its function depends on.

    It is called by XLA's threads, several at a time where there are several devices. What it
    raises ends the program as an error of JAX.
    """
    if name in _TARGETS:
        return

    def handle(pointer: Any) -> int | None:
        frame = pointer.contents
        if frame.extension and frame.extension.contents.type == METADATA:
            version = frame.extension.contents.metadata.contents.version
            version.major, version.minor = 0, 1
            return None
        try:
            function(_arrays(frame.arguments), _arrays(frame.results))
        except BaseException as error:
            message = f"{type(error).__name__}: {error}".encode()
            size = ctypes.sizeof(_ErrorArguments)
            return frame.api.contents.make_error(_ErrorArguments(size, None, message, INTERNAL))
        return None

    handler = _HANDLER(handle)
    capsule = jax.ffi.pycapsule(ctypes.cast(handler, ctypes.c_void_p).value)
    jax.ffi.register_ffi_target(name, capsule, platform="cpu")
    _TARGETS[name] = _Target(handler, capsule)


def registered() -> list[str]:
    """Names of all functions that programs may call."""
    return list(_TARGETS)


def _arrays(buffers: _Buffers) -> list[np.ndarray]:
    """The float32 buffers of a call as NumPy arrays over the same memory."""
    arrays = []
    for k in range(buffers.size):
        buffer = buffers.buffers[k].contents
        if buffer.dtype != FLOAT32:
            raise TypeError(f"buffer {k} is of XLA's type {buffer.dtype}; it must be float32")
        shape = tuple(buffer.dims[: buffer.rank])
        memory = (ctypes.c_float * int(np.prod(shape))).from_address(buffer.data)
        arrays.append(np.ctypeslib.as_array(memory).reshape(shape))
    return arrays
