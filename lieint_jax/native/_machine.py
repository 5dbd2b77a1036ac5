"""Machine code of LLVM modules, in this process and on disk."""

from __future__ import annotations

import functools
import hashlib
import os
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm

from lieint_jax.native._traced import Leaf

_FEW = 26  # two vectors per number are used if the innermost loop has at most this many live numbers
_VERY_FEW = 4  # the most of them for which four vectors are faster than two: they wait less for each other's results
_lock = threading.Lock()


@functools.cache
def target() -> Any:
    """The machine that runs this process."""
    return _new_target()


@functools.cache
def register_bytes() -> int:
    """The bytes of a vector register."""
    features = llvm.get_host_cpu_features()
    return 64 if features.get("avx512f") else 32 if features.get("avx2") else 16


def lanes(leaves: Sequence[Leaf], pressure: int = _FEW + 1) -> int:
    """Members in a vector of a program that reads these arrays, with so many numbers in an innermost loop."""
    widths = [leaf.dtype.itemsize for leaf in leaves if leaf.dtype.kind == "f"]
    vectors = 4 if pressure <= _VERY_FEW else 2 if pressure <= _FEW else 1
    return register_bytes() // max(widths, default=8) * vectors


_handlers: dict[str, Any] = {}  # by their names; XLA holds their addresses, and nothing shows when it is done with one


def compile_handler(*texts: str) -> str:
    """The name by which XLA calls the function `handler` of modules that are compiled together; it is never freed."""
    import jax

    key = _key(texts)
    name = f"lieint_{key[:32]}"
    with _lock:
        if name not in _handlers:
            engine = _engine(key, [x for x in texts if x])
            capsule = jax.ffi.pycapsule(engine.get_function_address("handler"))
            jax.ffi.register_ffi_target(name, capsule, platform="cpu")
            _handlers[name] = engine
        return name


def _key(texts: Sequence[str]) -> str:
    """A hash of modules and of the machine that runs them."""
    here = [llvmlite.__version__, target().triple, llvm.get_host_cpu_name(), _features()]
    return hashlib.sha256("\n".join([*here, "\n;\n".join(texts)]).encode()).hexdigest()


def _engine(key: str, texts: list[str]) -> Any:
    backing = llvm.parse_assembly("")
    engine = llvm.create_mcjit_compiler(backing, _new_target())
    code = _read_cache(key)
    if code is None:
        code = _compile(texts)
        _write_cache(key, code)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


def _features() -> str:
    """The features of this CPU; the operating system may disable some that its model has."""
    return llvm.get_host_cpu_features().flatten()


def _new_target() -> Any:
    """The machine that runs this process, as a new object: an engine disposes of the one that it owns."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=_features(), opt=2, reloc="default", codemodel="jitdefault", jit=True
    )


def _compile(texts: list[str]) -> bytes:
    module, *others = map(llvm.parse_assembly, texts)
    for other in others:
        module.link_in(other)
    for function in module.functions:
        if function.name not in ("run", "handler") and not function.is_declaration:
            function.linkage = llvm.Linkage.internal
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.loop_vectorization = options.slp_vectorization = False
    options.loop_unrolling = False
    builder = llvm.create_pass_builder(target(), options)
    manager = builder.getModulePassManager()
    manager.run(module, builder)
    return target().emit_object(module)


def _folder() -> Path | None:
    """The folder of cached machine code, next to JAX's cache, if there is one."""
    import jax

    path = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    return Path(path) / "native" if path and "://" not in path else None


def _read_cache(key: str) -> bytes | None:
    folder = _folder()
    if folder is None:
        return None
    try:
        content = (folder / key).read_bytes()
    except OSError:
        return None
    digest, code = content[:32], content[32:]
    return code if hashlib.sha256(key.encode() + code).digest() == digest else None


def _write_cache(key: str, code: bytes) -> None:
    folder = _folder()
    if folder is None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        temporary = folder / f".{key}.{os.getpid()}"
        temporary.write_bytes(hashlib.sha256(key.encode() + code).digest() + code)
        os.replace(temporary, folder / key)
    except OSError:  # the cache is optional
        return
