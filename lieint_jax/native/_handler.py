"""What XLA calls: `_handler.ll`, for the foreign function interface of this jaxlib."""

from __future__ import annotations

import functools
import re
import sys
from pathlib import Path

import jax

from lieint_jax.native._primitives.abstract_walk import UnsupportedError

_VERSIONS = [(0, 3), (0, 4), (0, 5)]  # of the interface, whose structures are those of `_handler.ll`


@functools.cache
def _interface() -> dict[str, int]:
    """The version of the interface, and the positions of some functions in its table."""
    if sys.platform == "win32":
        raise UnsupportedError("machine code inside jit, on Windows")
    text = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text()
    major, minor = (int(re.findall(rf"#define XLA_FFI_API_{part} (\d+)", text)[0]) for part in ("MAJOR", "MINOR"))
    if (major, minor) not in _VERSIONS:
        raise UnsupportedError(f"version {major}.{minor} of XLA's foreign function interface")
    table = re.findall(r"_XLA_FFI_API_STRUCT_FIELD\(XLA_FFI_(\w+)\);", text)
    places = {
        "count_threads": "ThreadPool_NumThreads",
        "schedule": "ThreadPool_Schedule",
        "set_state": "State_Set",
        "get_state": "State_Get",
        "create_error": "Error_Create",
    }
    return {"major": major, "minor": minor} | {name: table.index(x) for name, x in places.items()}


def handler() -> str:
    """The text of a module with the stages of the handler, and the functions by which kernels come and go."""
    constants = _interface()
    bits = {name: 32 if name in ("major", "minor") else 64 for name in constants}  # as the interface has them
    lines = [f"@{name} = internal constant i{bits[name]} {x}" for name, x in constants.items()]
    return "\n".join([*lines, Path(__file__).with_suffix(".ll").read_text()])
