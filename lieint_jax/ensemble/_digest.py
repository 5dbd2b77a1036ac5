"""Digests of values, functions included: equal values have equal digests in every process, other values have others.

A function of the user is its bytecode with its constants, its defaults, what it has captured, and the global variables
that it refers to. A function or class of an installed package is its name. Neither memory addresses nor the places of
files and lines nor the order of a set enter.
"""

from __future__ import annotations

import builtins
import dis
import functools
import hashlib
import inspect
import platform
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax._checks import concrete

_PACKAGE = __name__.partition(".")[0]
_PLAIN = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis), range)
_WRAPPERS = (type(jax.jit(lambda: None)), type(functools.lru_cache(lambda: None)))
_TREE = type(jax.tree.structure(0))


class NotDigestible(ValueError):  # noqa: N818
    """A value has no digest that is the same in another process."""


def digest(*values: Any) -> str:
    """The digest of these values, 16 hexadecimal digits.

    Raises:
        NotDigestible: one of them, or what it refers to, cannot be read: the message names it.
    """
    return _Digest().join("values", values).hex()[:16]


def python_of(*values: Any) -> str | None:
    """The Python whose bytecode the digest of these values depends on, such as "CPython 3.12"; None if on none."""
    reader = _Digest()
    reader.join("values", values)
    return (
        f"{platform.python_implementation()} {sys.version_info[0]}.{sys.version_info[1]}"
        if reader.has_bytecode
        else None
    )


class _Digest:
    """The digests of the values met so far, each a hash of its kind and of its parts' digests.

    Attributes:
        has_bytecode: whether the bytecode of a function was among them.
    """

    def __init__(self) -> None:
        self.has_bytecode = False
        self._digests: dict[int, tuple[Any, bytes]] = {}  # with the values, whose ids would else be used again
        self._in_progress: dict[int, int] = {}  # those whose parts are being read: a function may refer to itself
        self._trail: list[str] = []

    def join(self, kind: str, parts: Iterable[Any]) -> bytes:
        """The digest of values in order."""
        return _hash(kind, *(self.add(part) for part in parts))

    def add(self, x: Any) -> bytes:
        """The digest of a value."""
        if type(x) in _PLAIN:
            return _hash(type(x).__name__, repr(x))
        if isinstance(x, jax.Array | np.ndarray | np.generic):
            return self._array(x)
        if id(x) in self._digests:
            return self._digests[id(x)][1]
        if id(x) in self._in_progress:
            return _hash("again", str(self._in_progress[id(x)]))
        self._in_progress[id(x)] = len(self._in_progress)
        try:
            found = self._read(x)
        except RecursionError:
            raise self._error("nested too deep") from None
        finally:
            del self._in_progress[id(x)]
        self._digests[id(x)] = x, found
        return found

    def _read(self, x: Any) -> bytes:
        if isinstance(x, ModuleType):
            return _hash("module", x.__name__)
        name = _installed_name(x)
        if name:
            return _hash("name", name)
        if isinstance(x, CodeType):
            return self._code(x)
        if isinstance(x, FunctionType):
            return self._function(x)
        if isinstance(x, MethodType):
            return self.join("method", (x.__func__, x.__self__))
        if isinstance(x, _WRAPPERS):
            return self.join("wrapper", (inspect.unwrap(x),))
        if isinstance(x, type):
            return self._class(x)
        if isinstance(x, _TREE):
            return self._tree(x)
        if isinstance(x, set | frozenset):
            return _hash("set", *sorted(self.add(part) for part in x))
        if type(x) in (tuple, list):
            return self.join(type(x).__name__, x)
        if type(x) is dict:
            return self._dict(x)
        if not jax.tree_util.all_leaves([x]):
            leaves, structure = jax.tree.flatten(x)
            return self.join("tree", (structure, *leaves))
        return self._object(x)

    def _dict(self, x: Mapping[Any, Any]) -> bytes:
        items = sorted((self.add(key), self.add(value)) for key, value in x.items())
        return _hash("dict", *(part for item in items for part in item))

    def _array(self, x: Any) -> bytes:
        if not concrete(x):
            raise self._error("a value that JAX is tracing")
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return self.join("key", (str(x.dtype), jax.random.key_data(x)))
        values = np.asarray(x)
        if values.dtype.hasobject:
            return self.join("objects", (values.shape, values.tolist()))
        return _hash(f"{values.dtype}{values.shape}", np.ascontiguousarray(values).tobytes())

    def _tree(self, x: Any) -> bytes:
        """The structure of a pytree: what makes its nodes, functions and options among them."""
        node = x.node_data()
        if node is None:
            return _hash("leaf")
        return self.join("node", (*node, *x.children()))

    def _function(self, f: FunctionType) -> bytes:
        self._trail.append(f"{f.__module__}.{f.__qualname__}")
        attributes = _attributes(f.__code__)
        parts = [self.add(f.__code__), self.add(f.__defaults__), self.add(f.__kwdefaults__)]
        for name, cell in zip(f.__code__.co_freevars, f.__closure__ or (), strict=True):
            parts.append(self._variable(name, lambda cell=cell: cell.cell_contents, attributes))
        own = {name: value for name, value in vars(f).items() if not name.startswith("__")}
        parts.append(self.add(own))
        if not _is_installed(f.__module__):
            for name in sorted(_globals_of(f.__code__)):
                parts.append(_hash(name) + self._variable(name, lambda name=name: _global(f, name), attributes))
        self._trail.pop()
        return _hash("function", *parts)

    def _variable(self, name: str, value: Callable[[], Any], attributes: set[str]) -> bytes:
        """The digest of a variable of a function that reads these attributes of its variables."""
        try:
            x = value()
        except (ValueError, KeyError):  # an empty cell, or a name that is not there
            return _hash("missing")
        self._trail.append(name)
        if isinstance(x, ModuleType) and not _is_installed(x.__name__):
            used = sorted(attributes & vars(x).keys())
            parts = [self._variable(a, lambda a=a: vars(x)[a], attributes - {a}) for a in used]
            found = _hash("module", *used, *parts)
        else:
            found = self.add(x)
        self._trail.pop()
        return found

    def _code(self, code: CodeType) -> bytes:
        self.has_bytecode = True
        counts = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags)
        names = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
        return self.join("code", (code.co_code, code.co_exceptiontable, *counts, *names, *code.co_consts))

    def _class(self, cls: type) -> bytes:
        """A class of the user: its bases, its methods and the values of its attributes."""
        parts = [_hash(cls.__qualname__), *(self.add(base) for base in cls.__bases__)]
        for name, value in sorted(vars(cls).items()):
            value = _plain_method(value)
            if isinstance(value, FunctionType):
                own = value.__code__.co_filename != "<string>"  # as that of the methods that `dataclass` writes
            else:
                own = not (name.startswith(("__", "_abc_")) or inspect.isdatadescriptor(value))
            if own:
                parts.append(_hash(name) + self.add(value))
        return _hash("class", *parts)

    def _object(self, x: Any) -> bytes:
        """Any other object: what `copy` or `pickle` would make it from."""
        try:
            made = x.__reduce_ex__(4)
        except Exception:
            raise self._error(f"{type(x).__module__}.{type(x).__qualname__} objects") from None
        if isinstance(made, str):
            return _hash("global", made)
        maker, arguments, state, items, pairs = (*made, None, None, None)[:5]
        return self.join("object", (maker, arguments, state, list(items or ()), list(pairs or ())))

    def _error(self, what: str) -> NotDigestible:
        where = " → ".join(self._trail)
        return NotDigestible(f"{where}: {what}" if where else what)


def _hash(kind: str, *parts: bytes | str) -> bytes:
    found = hashlib.sha256()
    for part in (kind, *parts):
        data = part.encode() if isinstance(part, str) else part
        found.update(len(data).to_bytes(8, "little") + data)
    return found.digest()


def _plain_method(value: Any) -> Any:
    """The function of a method or property; any other value as it is."""
    if isinstance(value, property):
        return value.fget
    if isinstance(value, functools.cached_property):
        return value.func
    return inspect.unwrap(getattr(value, "__func__", value))


def _instructions(code: CodeType) -> Iterable[dis.Instruction]:
    """The instructions of a function and of those that it makes."""
    yield from dis.get_instructions(code)
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _instructions(inner)


def _globals_of(code: CodeType) -> set[str]:
    """The names of the global variables that a function refers to."""
    return {str(i.argval) for i in _instructions(code) if i.opname in ("LOAD_GLOBAL", "LOAD_NAME")}


def _global(f: FunctionType, name: str) -> Any:
    return f.__globals__[name] if name in f.__globals__ else vars(builtins)[name]


def _attributes(code: CodeType) -> set[str]:
    """The names of the attributes that a function reads, of whatever object."""
    return {str(i.argval) for i in _instructions(code) if i.opname in ("LOAD_ATTR", "LOAD_METHOD")}


def _installed_name(x: Any) -> str | None:
    """The full name of a function or class that an installed package has under this name."""
    module, name = getattr(x, "__module__", None), getattr(x, "__qualname__", None)
    if not (isinstance(module, str) and isinstance(name, str) and _is_installed(module)):
        return None
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return f"{module}.{name}" if found is x else None


@functools.cache
def _is_installed(module: str) -> bool:
    """Whether a module is of this package, of Python, or of one that was installed: its name tells what it does."""
    top = module.partition(".")[0]
    if top == _PACKAGE or top in sys.stdlib_module_names:
        return True
    parts = Path(getattr(sys.modules.get(top), "__file__", None) or "").parts
    return "site-packages" in parts or "dist-packages" in parts
