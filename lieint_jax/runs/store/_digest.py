"""Digests of values, functions included: equal values have equal digests in every process, different values do not.

The digest of a user's function covers its bytecode, constants, defaults, captured variables, and the global variables
that it refers to. A function or class of an installed package is identified by its name. Memory addresses, file paths,
line numbers and the order of a set do not enter.
"""

from __future__ import annotations

import builtins
import dis
import functools
import hashlib
import inspect
import platform
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import PyTreeDef

from lieint_jax._checks import concrete

_PACKAGE = __name__.partition(".")[0]
_PLAIN = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis), range)
_WRAPPERS = (type(jax.jit(lambda: None)), type(functools.lru_cache(lambda: None)))


class NotDigestible(ValueError):  # noqa: N818
    """A value has no digest that is the same in another process."""


def digest(*values: object) -> str:
    """The digest of these values, 16 hexadecimal digits.

    Raises:
        NotDigestible: a value, or something that it refers to, cannot be digested; the message names it.
    """
    return _Digest().join("values", values).hex()[:16]


def python_of(*values: object) -> str | None:
    """The Python version whose bytecode enters the digest of these values, such as "CPython 3.12", or None."""
    reader = _Digest()
    try:
        reader.join("values", values)
    except NotDigestible:
        return None
    return (
        f"{platform.python_implementation()} {sys.version_info[0]}.{sys.version_info[1]}"
        if reader.has_bytecode
        else None
    )


class _Digest:
    """The digests of the values visited so far. Each is a hash of the value's kind and of the digests of its parts.

    Attributes:
        has_bytecode: True if the bytecode of a function was among them.
    """

    def __init__(self) -> None:
        self.has_bytecode = False
        self._digests: dict[int, tuple[object, bytes]] = {}  # holds the values too: a freed id would be reused
        self._in_progress: dict[int, int] = {}  # values whose parts are being digested: a function may refer to itself
        self._trail: list[str] = []

    def join(self, kind: str, parts: Iterable[object]) -> bytes:
        """The digest of values in order."""
        return _hash(kind, *(self.add(part) for part in parts))

    def add(self, x: object) -> bytes:
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
            found = self._digest_of_parts(x)
        except RecursionError:
            raise self._error("nested too deeply") from None
        finally:
            del self._in_progress[id(x)]
        self._digests[id(x)] = x, found
        return found

    def _digest_of_parts(self, x: object) -> bytes:
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
        if isinstance(x, PyTreeDef):
            return self._tree(x)
        if isinstance(x, set | frozenset):
            return _hash("set", *sorted(self.add(part) for part in x))
        if isinstance(x, tuple | list) and type(x) in (tuple, list):
            return self.join(type(x).__name__, x)
        if isinstance(x, dict) and type(x) is dict:
            items = sorted((self.add(key), self.add(value)) for key, value in x.items())
            return _hash("dict", *(part for item in items for part in item))
        if not jax.tree_util.all_leaves([x]):
            leaves, structure = jax.tree.flatten(x)
            return self.join("tree", (structure, *leaves))
        return self._object(x)

    def _array(self, x: jax.Array | np.ndarray | np.generic) -> bytes:
        if not concrete(x):
            raise self._error("a value that JAX is tracing")
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return self.join("key", (str(x.dtype), jax.random.key_data(jnp.asarray(x))))
        values = np.asarray(x)
        if values.dtype.hasobject:
            return self.join("objects", (values.shape, values.tolist()))
        return _hash(f"{values.dtype}{values.shape}", np.ascontiguousarray(values).tobytes())

    def _tree(self, x: Any) -> bytes:
        """The digest of a pytree's structure: the types of its nodes, and their functions and options."""
        node = x.node_data()
        if node is None:
            return _hash("leaf")
        return self.join("node", (*node, *x.children()))

    def _function(self, f: FunctionType) -> bytes:
        self._trail.append(f"{f.__module__}.{f.__qualname__}")
        attributes = _names(f.__code__, "LOAD_ATTR", "LOAD_METHOD")  # of any object
        parts = [self.add(f.__code__), self.add(f.__defaults__), self.add(f.__kwdefaults__)]
        for name, cell in zip(f.__code__.co_freevars, f.__closure__ or (), strict=True):
            parts.append(self._variable(name, lambda cell=cell: cell.cell_contents, attributes))
        own = {name: value for name, value in vars(f).items() if not name.startswith("__")}
        parts.append(self.add(own))
        if not _is_installed(f.__module__):
            known = vars(builtins) | f.__globals__
            for name in sorted(_names(f.__code__, "LOAD_GLOBAL", "LOAD_NAME")):
                parts.append(_hash(name) + self._variable(name, lambda name=name: known[name], attributes))
        self._trail.pop()
        return _hash("function", *parts)

    def _variable(self, name: str, value: Callable[[], object], attributes: set[str]) -> bytes:
        """The digest of a variable of a function; of a module, only of the `attributes` that the function reads."""
        try:
            x = value()
        except (ValueError, KeyError):  # an empty cell, or an undefined name
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
        """The digest of a user's class: its bases, its methods and the values of its attributes."""
        parts = [_hash(cls.__qualname__), *(self.add(base) for base in cls.__bases__)]
        for name, value in sorted(vars(cls).items()):
            value = _plain_method(value)
            if isinstance(value, FunctionType):
                own = value.__code__.co_filename != "<string>"  # where `dataclass` generates methods
            else:
                own = not (name.startswith(("__", "_abc_")) or inspect.isdatadescriptor(value))
            if own:
                parts.append(_hash(name) + self.add(value))
        return _hash("class", *parts)

    def _object(self, x: object) -> bytes:
        """The digest of any other object: that of the parts from which `copy` and `pickle` would rebuild it."""
        try:
            recipe = x.__reduce_ex__(4)
        except Exception:
            raise self._error(f"{type(x).__module__}.{type(x).__qualname__} objects") from None
        if isinstance(recipe, str):
            return _hash("global", recipe)
        maker, arguments, state, items, pairs = (*recipe, None, None, None)[:5]
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


def _plain_method(value: object) -> object:
    """The function of a method or property; any other value unchanged."""
    if isinstance(value, property):
        return value.fget
    if isinstance(value, functools.cached_property):
        return value.func
    if isinstance(value, MethodType | classmethod | staticmethod):
        value = value.__func__
    return inspect.unwrap(value) if callable(value) else value


def _instructions(code: CodeType) -> Iterable[dis.Instruction]:
    """The instructions of a function and of the functions that it defines."""
    yield from dis.get_instructions(code)
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _instructions(inner)


def _names(code: CodeType, *operations: str) -> set[str]:
    """The names that operations of a function, or of one that it defines, refer to."""
    return {str(i.argval) for i in _instructions(code) if i.opname in operations}


def _installed_name(x: object) -> str | None:
    """The full name of a function or class of an installed package, if the package has it under this name."""
    module, name = getattr(x, "__module__", None), getattr(x, "__qualname__", None)
    if not (isinstance(module, str) and isinstance(name, str) and _is_installed(module)):
        return None
    found: object = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return f"{module}.{name}" if found is x else None


@functools.cache
def _is_installed(module: str) -> bool:
    """True if a module belongs to this package, to Python, or to an installed package: its name identifies its code."""
    top = module.partition(".")[0]
    if top == _PACKAGE or top in sys.stdlib_module_names:
        return True
    parts = Path(getattr(sys.modules.get(top), "__file__", None) or "").parts
    return "site-packages" in parts or "dist-packages" in parts
