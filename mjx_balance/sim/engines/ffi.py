"""Calls a NumPy function from inside an XLA program on a CPU, without a copy and without locks.

`jax.pure_callback` copies its arguments to a device before it calls; with several host devices
that copy waits for a thread that the program itself occupies. A target of XLA's foreign function
interface is handed the buffers themselves. This is its C interface (xla/ffi/api/c_api.h in
`jax.ffi.include_dir()`), as far as it is needed here.
"""

import ctypes
from collections.abc import Callable, Sequence
from ctypes import POINTER, c_char_p, c_int, c_int64, c_size_t, c_void_p
from typing import Any

import jax
import numpy as np

METADATA = 1  #: `XLA_FFI_Extension_Metadata`: the call asks for the handler's version
INTERNAL = 13  #: `XLA_FFI_Error_Code_INTERNAL`
FLOAT32 = 11  #: `XLA_FFI_DataType_F32`


def _struct(name: str, **fields: Any) -> Any:
    """A C structure of XLA; all of them begin with their size."""
    every = [("struct_size", c_size_t), *fields.items()]
    return type(name, (ctypes.Structure,), {"_fields_": every})


_Version = _struct("XLA_FFI_Api_Version", extension=c_void_p, major=c_int, minor=c_int)
# Without what follows the version.
_Metadata = _struct("XLA_FFI_Metadata", version=_Version)
# Only its beginning, if it is another extension.
_Extension = _struct(
    "XLA_FFI_Metadata_Extension", type=c_int, next=c_void_p, metadata=POINTER(_Metadata)
)
_ErrorArguments = _struct(
    "XLA_FFI_Error_Create_Args", extension=c_void_p, message=c_char_p, code=c_int
)
# As far as the constructor of errors.
_Api = _struct(
    "XLA_FFI_Api",
    extension=c_void_p,
    version=_Version,
    internal=c_void_p,
    make_error=ctypes.CFUNCTYPE(c_void_p, POINTER(_ErrorArguments)),
)
_Buffer = _struct(
    "XLA_FFI_Buffer",
    extension=c_void_p,
    dtype=c_int,
    data=c_void_p,
    rank=c_int64,
    dims=POINTER(c_int64),
)
# Has the shape of `XLA_FFI_Rets`, too.
_Buffers = _struct(
    "XLA_FFI_Args",
    extension=c_void_p,
    size=c_int64,
    types=c_void_p,
    buffers=POINTER(POINTER(_Buffer)),
)
# As far as its results.
_Frame = _struct(
    "XLA_FFI_CallFrame",
    extension=POINTER(_Extension),
    api=POINTER(_Api),
    context=c_void_p,
    stage=c_int,
    arguments=_Buffers,
    results=_Buffers,
)
_HANDLER = ctypes.CFUNCTYPE(c_void_p, POINTER(_Frame))

_TARGETS: dict[str, tuple[Any, Any]] = {}  #: handlers and capsules, kept alive

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
    capsule = jax.ffi.pycapsule(ctypes.cast(handler, c_void_p).value)
    jax.ffi.register_ffi_target(name, capsule, platform="cpu")
    _TARGETS[name] = handler, capsule


def registered() -> list[str]:
    """Names of all functions that programs may call."""
    return list(_TARGETS)


def _arrays(buffers: Any) -> list[np.ndarray]:
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
