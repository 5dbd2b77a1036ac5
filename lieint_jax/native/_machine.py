"""Machine code of LLVM modules, in this process and on disk."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import re
import sys
import threading
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import llvmlite
import llvmlite.binding as llvm

from lieint_jax.native._primitives.abstract_walk import UnsupportedError
from lieint_jax.native._traced import Leaf

_FEW = 26  # two vectors per number are used if the innermost loop has at most this many live numbers
_VERY_FEW = 4  # the most of them for which four vectors are faster than two: they wait less for each other's results
_ONE = 1  # of one number eight are
_LEVEL = 1  # of LLVM's optimizations: 2 makes no code faster, and takes three times as long for long programs
_lock = threading.Lock()


def lanes(leaves: Sequence[Leaf], pressure: int = _FEW + 1) -> int:
    """Members in a vector of a program that reads these arrays, with so many numbers in an innermost loop."""
    features = llvm.get_host_cpu_features()
    register = 64 if features.get("avx512f") else 32 if features.get("avx2") else 16  # bytes
    widths = [leaf.dtype.itemsize for leaf in leaves if leaf.dtype.kind == "f"]
    vectors = next((n for n, most in ((8, _ONE), (4, _VERY_FEW), (2, _FEW)) if pressure <= most), 1)
    return register // max(widths, default=8) * vectors


TARGET = "lieint_march"  # what XLA calls for all kernels
_VERSIONS = [(0, 3), (0, 4), (0, 5)]  # of XLA's foreign function interface with the structures of `_handler.ll`
_OF_INTERFACE = {  # functions in its table
    "count_threads": "ThreadPool_NumThreads",
    "schedule": "ThreadPool_Schedule",
    "set_state": "State_Set",
    "get_state": "State_Get",
    "create_error": "Error_Create",
}


class Kernel:
    """Machine code that XLA calls by a name, as long as this object or a program of XLA with such a call exists."""

    def __init__(self, name: str):
        self.name = name


_kernels: weakref.WeakValueDictionary[str, Kernel] = weakref.WeakValueDictionary()
_engines: dict[str, Any] = {}  # the code of kernels, by their names
_places: dict[str, int] = {}  # what the handler knows of a kernel; 100 bytes that are never freed


def kernel(texts: Sequence[str], inputs: int, outputs: int, lanes: int) -> Kernel:
    """The function `run` of modules that are compiled together, which reads and writes so many arrays."""
    key = _key([*texts, f"; {inputs} {outputs} {lanes}"])
    name = f"lieint_{key[:32]}"
    with _lock:
        registry = _registry()
        _free_unused(registry)
        if name not in _engines:
            engine = _engine(key, [x for x in texts if x], ["run"])
            if name not in _places:
                _places[name] = registry.create(name.encode(), inputs, outputs, lanes)
            registry.open(_places[name], engine.get_function_address("run"))
            _engines[name] = engine
        return _kernels.setdefault(name, Kernel(name))


def _free_unused(registry: _Registry) -> None:
    """Free the code that neither Python nor a program of XLA holds."""
    for name in list(_engines):
        if name not in _kernels and registry.close(_places[name]):
            _engines.pop(name).close()


class _Registry(NamedTuple):
    """The functions of `_handler.ll` by which kernels come and go, and its code, which is never freed."""

    create: Callable[..., int]
    open: Callable[..., None]
    close: Callable[..., bool]
    engine: Any


@functools.cache
def _registry() -> _Registry:
    """The handler, which XLA knows from now on."""
    functions = {
        "create": (ctypes.c_void_p, ctypes.c_char_p, *[ctypes.c_int64] * 3),
        "open": (None, ctypes.c_void_p, ctypes.c_void_p),
        "close": (ctypes.c_bool, ctypes.c_void_p),
    }
    stages, text = ["instantiate", "execute"], _handler()
    engine = _engine(_key([text]), [text], [*functions, *stages, "forget"])
    here = engine.get_function_address
    found = {x: ctypes.CFUNCTYPE(*types)(here(x)) for x, types in functions.items()}
    number, deleter = (jax.ffi.pycapsule(engine.get_global_value_address(x)) for x in ("type", "type.information"))
    jax.ffi.register_ffi_type(TARGET, {"type_id": number, "type_info": deleter}, platform="cpu")
    jax.ffi.register_ffi_target(TARGET, {x: jax.ffi.pycapsule(here(x)) for x in stages}, platform="cpu")
    return _Registry(**found, engine=engine)


def _handler() -> str:
    """The module of `_handler.ll`, what XLA calls, for the foreign function interface of this jaxlib."""
    if sys.platform == "win32":
        raise UnsupportedError("machine code inside jit, on Windows")
    interface = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text(encoding="utf-8")
    major, minor = (int(re.findall(rf"#define XLA_FFI_API_{x} (\d+)", interface)[0]) for x in ("MAJOR", "MINOR"))
    if (major, minor) not in _VERSIONS:
        raise UnsupportedError(f"version {major}.{minor} of XLA's foreign function interface")
    table = re.findall(r"_XLA_FFI_API_STRUCT_FIELD\(XLA_FFI_(\w+)\);", interface)
    lines = [f"@{name} = internal constant i32 {x}" for name, x in (("major", major), ("minor", minor))]
    lines += [f"@{name} = internal constant i64 {table.index(x)}" for name, x in _OF_INTERFACE.items()]
    return "\n".join([*lines, Path(__file__).with_name("_handler.ll").read_text(encoding="utf-8")])


def _key(texts: Sequence[str]) -> str:
    """A hash of modules and of the machine that runs them."""
    here = [llvmlite.__version__, _target().triple, llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()]
    return hashlib.sha256("\n".join([*here, "\n;\n".join(texts)]).encode()).hexdigest()


def _engine(key: str, texts: list[str], names: Sequence[str]) -> Any:
    """The code of modules with functions of these names."""
    backing = llvm.parse_assembly("")
    engine = llvm.create_mcjit_compiler(backing, _new_target())
    engine.add_object_file(llvm.ObjectFileRef.from_data(_object_code(key, texts, names)))
    engine.finalize_object()
    return engine


def _new_target() -> Any:
    """The machine that runs this process, as a new object: an engine disposes of the one that it owns."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),  # the operating system may disable some of the model's
        opt=_LEVEL,
        reloc="default",
        codemodel="jitdefault",
        jit=True,
    )


_target = functools.cache(_new_target)  # one that no engine owns


def _object_code(key: str, texts: list[str], names: Sequence[str]) -> bytes:
    """The code of modules, from a file next to JAX's cache, if there is one and it is whole."""
    path = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if not path or "://" in path:
        return _compile(texts, names)
    file = Path(path) / "native" / key
    with contextlib.suppress(OSError):
        content = file.read_bytes()
        digest, code = content[:32], content[32:]
        if hashlib.sha256(key.encode() + code).digest() == digest:
            return code
    code = _compile(texts, names)
    with contextlib.suppress(OSError):  # the cache is optional
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_name(f".{key}.{os.getpid()}")
        temporary.write_bytes(hashlib.sha256(key.encode() + code).digest() + code)
        os.replace(temporary, file)
    return code


def _compile(texts: list[str], names: Sequence[str]) -> bytes:
    module, *others = map(llvm.parse_assembly, texts)
    for other in others:
        module.link_in(other)
    for function in module.functions:
        if function.name not in names and not function.is_declaration:
            function.linkage = llvm.Linkage.internal
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=_LEVEL)
    options.loop_vectorization = options.slp_vectorization = False
    options.loop_unrolling = False
    builder = llvm.create_pass_builder(_target(), options)
    manager = builder.getModulePassManager()
    manager.run(module, builder)
    return _target().emit_object(module)
