"""Programs kept for a function are made again when the function reads other values than before.

JAX traces a function once, and its program has the numbers of that moment: a global, an attribute or an array that
changes later changes nothing. Where a user has not asked for this by `jax.jit`, the package looks up what a function
reads in each call (`reads`), and this is part of the key under which a program is kept (`Kept`, `remembered`,
`rereading_jit`). What cannot be looked up is traced again. Such a key lives in memory only.
"""

from __future__ import annotations

import collections
import dis
import functools
import hashlib
import importlib.util
import logging
import os
import sys
import threading
import types
import weakref
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar, cast

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive
from jax.tree_util import PyTreeDef

Value = Any  # what a function of a user's may hold, and what is made of it
_log = logging.getLogger(__name__)
_Made = TypeVar("_Made")
_Function = TypeVar("_Function", bound=Callable[..., Value])
_MOST_KEPT = 24  # programs of a function; each has some MiB


class Reads(tuple[Hashable, ...]):
    """The key of what functions read.

    Attributes:
        held: the objects that it names by their ids, which are no other's as long as the key exists.
    """

    held: list[object]


def reads(*values: object) -> Reads | None:
    """The key of what functions read now; None if a part of it cannot be read, which then is traced again.

    A function reads its code, defaults and attributes, the variables that it closes over, the global variables that
    its instructions refer to, and all that these read. An object reads its attributes and its class. Functions and
    classes of Python and of installed packages read nothing but what they close over. Arrays of JAX and classes are
    named by their identity. Arrays of NumPy are named by identity and content: JAX copies the numbers of one only
    when it compiles, so that a kept program may use the array itself later.

    Args:
        values: functions, structures of pytrees with functions among their static fields, or any other objects.
    """
    reader = _Reader()
    try:
        for x in values:
            reader.add(x)
    except Exception as reason:  # an object of a user's may raise anything
        _log.debug("traced again in each call, as something that it reads cannot be read: %s", reason)
        return None
    found = Reads(reader.parts)
    found.held = reader.held
    return found


class Kept:
    """What was made, for the keys used last. Threads may share it.

    Two threads that miss a key at once both make its value, and both get that of the first: a value may need another
    one, so nothing is made under the lock.
    """

    def __init__(self) -> None:
        # Reentrant, since a comparison of keys, or a value that is dropped, may run code that comes back here.
        self._lock = threading.RLock()
        self._made: collections.OrderedDict[Hashable, Value] = collections.OrderedDict()

    def get(self, key: Hashable, make: Callable[[], _Made], most: int) -> _Made:
        """The value of a key, one of the `most` that are kept; it is made for this call alone if the key is None."""
        if key is None:
            return make()
        with self._lock:
            if key in self._made:
                self._made.move_to_end(key)
                return self._made[key]
        made = make()
        with self._lock:
            made = self._made.setdefault(key, made)
            while len(self._made) > most:
                self._made.popitem(last=False)
        return made


def remembered(most: int) -> Callable[[_Function], _Function]:
    """`functools.lru_cache` for a function whose arguments may be functions: made again where these read other values.

    Arguments that cannot be hashed are not remembered.
    """

    def decorate(function: _Function) -> _Function:
        kept = Kept()

        @functools.wraps(function)
        def call(*arguments: Value) -> Value:
            found = reads(*arguments)
            key = None if found is None else (arguments, found)
            try:
                hash(key)
            except TypeError:
                key = None
            return kept.get(key, lambda: function(*arguments), most)

        return cast("_Function", call)

    return decorate


def rereading_jit(function: _Function, static_argnums: int | Sequence[int] = (), **options: Value) -> _Function:
    """`jax.jit` of a function of this package, traced again where it or functions in its arguments read other values.

    The programs used last are kept: a user's new functions are new structures, and JAX would keep the programs of all.

    Args:
        function, static_argnums, options: as in `jax.jit`.
    """
    static = (static_argnums,) if isinstance(static_argnums, int) else tuple(static_argnums)
    kept = Kept()

    @functools.wraps(function)
    def call(*arguments: Value, **named: Value) -> Value:
        fixed = {k: x for k, x in enumerate(arguments) if k in static}
        given = [x for k, x in enumerate(arguments) if k not in fixed]
        structure = jax.tree.structure((given, named))
        found = reads(function, *fixed.values(), structure)
        key = None if found is None else (tuple(fixed.items()), found)

        def make() -> Value:
            return jax.jit(functools.wraps(function)(_with_fixed(function, fixed)), **options)

        return kept.get(key, make, _MOST_KEPT)(*given, **named)

    return cast("_Function", call)


def shapes_now(function: Callable[..., Value], *arguments: Value) -> Value:
    """`jax.eval_shape` of a function as it is now; JAX would return what it has found for the function before."""
    return jax.eval_shape(lambda *given: function(*given), *arguments)


def _with_fixed(function: Callable[..., Value], fixed: dict[int, object]) -> Callable[..., Value]:
    """A function of its other arguments; it is freed with its `jit`, of which JAX would keep static arguments."""

    def of_others(*given: Value, **named: Value) -> Value:
        rest = iter(given)
        return function(*(fixed[k] if k in fixed else next(rest) for k in range(len(fixed) + len(given))), **named)

    return of_others


# What a function refers to --------------------------------------------------------------------------------------------

_Chains = tuple[tuple[str, ...], ...] | None  # attributes that are read of a variable; None if it is used as a whole
_LOADS = (
    *("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"),
    *("LOAD_DEREF", "LOAD_CLASSDEREF", "LOAD_FROM_DICT_OR_DEREF"),
)
_BETWEEN = ("EXTENDED_ARG", "CACHE", "PUSH_NULL", "NOP")  # instructions between a variable and its attribute
_ANYTHING = ("eval", "exec", "globals", "open", "input", "__import__")  # built-in functions that may read anything
_CHANGING = ("os.environ", "os.getenv", "time.", "random.", "numpy.random.", "importlib.", "sys.modules", "datetime.")


class _Import(NamedTuple):
    """An import inside of a function.

    Attributes:
        module: the name of the module.
        level: the number of dots before it.
        names: what is imported from it, or None for the module itself.
    """

    module: str
    level: int
    names: tuple[str, ...] | None


class _Names(NamedTuple):
    """What the instructions of a function refer to, with those of the functions that it defines.

    Attributes:
        code: the code, which is held: a freed id would be reused.
        is_installed: whether it belongs to Python or to an installed package.
        variables: of the variables that are not its own, what is read of each.
        globals: those of them that it does not close over.
        imports: its imports.
    """

    code: types.CodeType
    is_installed: bool
    variables: dict[str, _Chains]
    globals: tuple[str, ...]
    imports: tuple[_Import, ...]


_MOST_CODES = 4096
_names_of_codes: dict[int, _Names] = {}


def _names_of(code: types.CodeType) -> _Names:
    """What a function refers to. Its instructions are read once."""
    found = _names_of_codes.get(id(code))
    if found is None or found.code is not code:
        found = _read_names(code)
        if len(_names_of_codes) >= _MOST_CODES:
            _names_of_codes.clear()
        _names_of_codes[id(code)] = found
    return found


def _read_names(code: types.CodeType) -> _Names:
    chains: dict[str, set[tuple[str, ...]]] = {}
    imports: list[_Import] = []
    for each in _codes(code):
        instructions = [i for i in dis.get_instructions(each) if i.opname not in _BETWEEN]
        for k, i in enumerate(instructions):
            if i.opname == "IMPORT_NAME":
                level, names = (x.argval for x in instructions[k - 2 : k])
                imports.append(_Import(i.argval, level, names))
            elif i.opname in _LOADS:
                chains.setdefault(i.argval, set()).add(tuple(_attributes(instructions[k + 1 :])))
    variables = {name: None if () in each else tuple(sorted(each)) for name, each in chains.items()}
    closed_over = {name for each in _codes(code) for name in (*each.co_freevars, *each.co_cellvars)}
    outside = tuple(name for name in variables if name not in closed_over)
    return _Names(code, _is_installed_file(code.co_filename), variables, outside, tuple(imports))


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """A function's code, and that of the functions that it defines."""
    yield code
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            yield from _codes(inner)


def _attributes(instructions: Iterable[dis.Instruction]) -> Iterator[str]:
    """The attributes that instructions read one after the other, as in `a.b.c`."""
    for i in instructions:
        if i.opname not in ("LOAD_ATTR", "LOAD_METHOD"):
            return
        yield i.argval


_OWN = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep
_PYTHON = os.path.dirname(os.path.abspath(os.__file__)) + os.sep
_PACKAGES = ("site-packages", "dist-packages")


def _is_installed_file(path: str) -> bool:
    """True if a file belongs to this package, to Python, or to an installed package."""
    return path.startswith((_OWN, _PYTHON, "<frozen ")) or any(name in path.split(os.sep) for name in _PACKAGES)


_installed_modules: dict[str, bool] = {}


def _is_installed(module: object) -> bool:
    """True if the module of this name belongs to this package, to Python, or to an installed package."""
    top = str(module).partition(".")[0]
    found = _installed_modules.get(top)
    if found is None:
        path = getattr(sys.modules.get(top), "__file__", None)
        found = top in sys.stdlib_module_names or _is_installed_file(path or "")
        if top in sys.modules:
            _installed_modules[top] = found
    return found


_HEAP_TYPE = 1 << 9  # the flag of classes that are not part of a library in C, as that of None is
_installed: dict[int, object] = {}  # classes and other objects that modules of installed packages have by their names


def _is_installed_object(x: Value) -> bool:
    """True if an installed package has this object by its name: a class made by `exec` may state any module."""
    if _installed.get(id(x)) is x or (isinstance(x, type) and not x.__flags__ & _HEAP_TYPE):
        return True
    module, name = getattr(x, "__module__", None), getattr(x, "__qualname__", None)
    if not (isinstance(module, str) and isinstance(name, str) and _is_installed(module)):
        return False
    found: object = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    if found is x:
        _installed[id(x)] = x
    return found is x


@functools.lru_cache(4096)
def _changes(module: str, chains: _Chains) -> bool:
    """True if what a function reads of an installed module changes with time, by itself or by others."""
    return any(".".join((module, *chain, "")).startswith(_CHANGING) for chain in chains or ((),))


# What it reads now ----------------------------------------------------------------------------------------------------

_PLAIN = frozenset({type(None), bool, int, str, bytes, float, complex, type(Ellipsis), range})
_TEXTS_AND_NUMBERS = int, float, complex, str, bytes
_MISSING = object()
_MOST_PARTS = 200_000  # of a key: to read more takes longer than to trace a function again
_SHORT = 2048  # bytes of content that are part of a key as they are
_SKIPPED = {
    *("__module__", "__qualname__", "__doc__", "__dict__", "__weakref__", "__slots__", "__hash__", "_abc_impl"),
    *("__annotations__", "__annotate__", "__annotate_func__", "__annotations_cache__", "__match_args__"),
    *("__dataclass_fields__", "__dataclass_params__", "__parameters__", "__orig_bases__", "__type_params__"),
    *("__abstractmethods__", "__firstlineno__", "__static_attributes__"),
}  # attributes of a class that Python makes
_fixed_structures: set[object] = set()


class _UnreadableError(Exception):
    """A function reads something that cannot be looked up."""


class _Reader:
    """The parts of a key.

    Attributes:
        parts: the parts; each value is a kind, and what tells it from others of the kind.
        held: the objects that they name by their ids.
    """

    def __init__(self) -> None:
        self.parts: list[Hashable] = []
        self.held: list[object] = []
        self._is_fixed = True  # False if something was read that may change
        self._read: list[object] = []  # the objects, of which some are made for this: a freed id would be reused
        self._seen: dict[Hashable, int] = {}  # their ids, and the order in which they were read

    def add(self, x: Value) -> None:
        """Read a value."""
        kind = type(x)
        if kind in _PLAIN:
            self.parts += (kind, repr(x) if kind is float or kind is complex else x)
        elif id(x) in self._seen:
            self.parts += ("again", self._seen[id(x)])
        else:
            self._seen[id(x)] = len(self._seen)
            self._read.append(x)
            if len(self.parts) > _MOST_PARTS:
                raise _UnreadableError(f"more than {_MOST_PARTS} values")
            (_READERS.get(kind) or _reader_of(kind))(self, x)

    def identity(self, x: object) -> None:
        """What does not change: which one it is."""
        self.held.append(x)
        self.parts += ("is", id(x))

    def value(self, x: Hashable) -> None:
        """What does not change, and may be compared."""
        self.parts += ("equals", x)

    def refuse(self, x: object) -> None:
        """What has no fixed content: a value that JAX is tracing."""
        raise _UnreadableError(f"a {type(x).__name__}")

    # Functions

    def function(self, f: types.FunctionType) -> None:
        names, closure = _names_of(f.__code__), f.__closure__ or ()
        if names.is_installed and not closure:
            return self.identity(f)
        self._is_fixed = False
        self.parts.append("function")
        self.identity(names.code)
        for name, cell in zip(f.__code__.co_freevars, closure, strict=True):
            try:
                x = cell.cell_contents
            except ValueError:  # not assigned yet
                x = _MISSING
            self._variable(x, None if names.is_installed else names.variables.get(name, ()))
        if names.is_installed:
            return None
        for own in (f.__defaults__, f.__kwdefaults__, f.__dict__):
            self.add(own or None)
        known = f.__globals__
        for name in names.globals:
            x = known.get(name, _MISSING)
            if x is _MISSING and name in _ANYTHING:
                raise _UnreadableError(f"{f.__qualname__} calls {name}")
            self._variable(x, names.variables[name])
        for each in names.imports:
            self._imported(each, known)
        return None

    def _variable(self, x: object, chains: _Chains) -> None:
        """Read a variable: of a module only the attributes that a function reads."""
        if x is _MISSING:
            self.parts.append("missing")
        elif isinstance(x, types.ModuleType):
            self.module(x, chains)
        else:
            self.add(x)

    def module(self, x: types.ModuleType, chains: _Chains = None) -> None:
        """Some attributes of a module, or all of them."""
        self.identity(x)
        if _is_installed(x.__name__):
            if _changes(x.__name__, chains):
                raise _UnreadableError(f"{x.__name__} changes with time")
            return
        self._is_fixed = False
        known = vars(x)
        if chains is None:
            if ("whole", id(x)) in self._seen:
                return
            self._seen["whole", id(x)] = len(self._seen)
            chains = tuple((name,) for name in known if not name.startswith("__"))
            self.parts.append(chains)
        for first, *rest in chains:
            found = known.get(first, _MISSING)
            if found is _MISSING and "__getattr__" in known:
                raise _UnreadableError(f"{x.__name__}.{first}")
            self._variable(found, (tuple(rest),) if rest else None)

    def _imported(self, found: _Import, known: Mapping[str, Value]) -> None:
        """Read what a function imports; a module that is not there yet may be anything."""
        name = importlib.util.resolve_name("." * found.level + found.module, known.get("__package__"))
        if found.names is None:
            modules: dict[str, _Chains] = {name: None, name.partition(".")[0]: None}
        else:
            modules = {name: tuple((x,) for x in found.names)}
        for each, chains in modules.items():
            module = sys.modules.get(each)
            if module is None:
                raise _UnreadableError(f"{each} is not imported yet")
            self.module(module, chains)

    def method(self, x: types.MethodType) -> None:
        self.parts.append("method")
        self.add(x.__func__)
        self.add(x.__self__)

    def builtin(self, x: Value) -> None:
        """A function in C: one of a module, or a method of an object."""
        if x.__self__ is None or isinstance(x.__self__, types.ModuleType | type):
            return self.identity(x)
        self.parts += ("method", x.__name__)
        return self.add(x.__self__)

    def wrapper(self, x: Value) -> None:
        """A function that `jax.jit` or `functools.lru_cache` has made of another."""
        self.identity(x)
        if not _is_installed_object(x):
            self.add(x.__wrapped__)

    def made_of_function(self, x: Value) -> None:
        """A class method, a static method, or a cached property."""
        self._is_fixed = False
        self.parts.append(type(x))
        self.add(x.func if isinstance(x, functools.cached_property) else x.__func__)

    def property(self, x: property) -> None:
        self._is_fixed = False
        self.parts.append("property")
        for each in (x.fget, x.fset, x.fdel):
            self.add(each)

    # Classes and objects

    def type(self, x: type) -> None:
        self.identity(x)
        if _is_installed_object(x):
            return
        self._is_fixed = False
        self.add(type(x))
        for base in x.__bases__:
            self.add(base)
        for name, value in vars(x).items():
            if name not in _SKIPPED:
                self.parts.append(name)
                self.add(value)

    def other(self, x: Value) -> None:
        """Any other object: its class, its attributes, and what else a copy of it would be made from."""
        self._is_fixed = False
        kind = type(x)
        self.parts.append("object")
        self.add(kind)
        slots, has_recipe = _layout(kind)
        base = next((base for base in _CONTENTS if isinstance(x, base)), None)
        if base is not None:
            _CONTENTS[base](self, x)
        elif has_recipe:
            recipe = x.__reduce_ex__(4)
            if isinstance(recipe, str):  # the name of a global object
                return self.identity(x)
            self.add([list(part) if isinstance(part, Iterator) else part for part in recipe])
            if _is_installed_object(kind):
                return None
        return self._attributes_of(x, slots)

    def _attributes_of(self, x: Value, slots: Sequence[str] = ()) -> None:
        for name, value in getattr(x, "__dict__", {}).items():
            self.parts.append(name)
            self.add(value)
        for name in slots:
            self._variable(getattr(x, name, _MISSING), None)

    def text_or_number(self, x: Value) -> None:
        """An object of a class that inherits one of Python's types of numbers and texts."""
        base: Value = next(base for base in _TEXTS_AND_NUMBERS if isinstance(x, base))
        self.parts.append(base.__repr__(x))

    # Arrays and containers

    def array(self, x: np.ndarray) -> None:
        self._is_fixed = False
        self.identity(x)
        self.parts += (x.dtype, x.shape)
        if x.dtype.hasobject:
            self.add(x.tolist())
        elif x.nbytes <= _SHORT:
            self.parts.append(x.tobytes())
        else:
            content = np.ascontiguousarray(x).reshape(-1).view(np.uint8)
            self.parts.append(hashlib.blake2b(content.data, digest_size=16).digest())
        if type(x) is not np.ndarray:
            self.add(type(x))
            self._attributes_of(x)

    def reference(self, x: weakref.ref[Value]) -> None:
        self._is_fixed = False
        self.parts.append("reference")
        self.add(x())

    def number(self, x: np.generic) -> None:
        self.parts += (type(x), x.tobytes())

    def sequence(self, x: Value) -> None:
        """A tuple, a list or a set."""
        self._is_fixed &= type(x) in (tuple, frozenset)
        self.parts += (type(x), len(x))
        if _PLAIN.issuperset(map(type, x)):
            self.parts.append(_shortened(repr(list(x))))
        else:
            for part in x:
                self.add(part)

    def mapping(self, x: dict[Value, Value]) -> None:
        self._is_fixed = False
        self.sequence(list(x.keys()))
        self.sequence(list(x.values()))

    def structure(self, x: Value) -> None:
        """The structure of a pytree: the classes of its nodes, and what these hold besides leaves."""
        self.parts.append(x)
        if x in _fixed_structures:
            return
        inner, nodes = _Reader(), [x]  # its own reader, so that what is read first in it is not "again" elsewhere
        while nodes:
            node = nodes.pop()
            if data := node.node_data():
                inner.add(data[0])
                inner.add(tuple(data[1]) if data[0] is dict else data[1])  # the list of its keys is one for this call
            nodes += node.children()
        if inner._is_fixed:
            if len(_fixed_structures) >= _MOST_CODES:
                _fixed_structures.clear()
            _fixed_structures.add(x)
        else:
            self._is_fixed = False
            self.parts += inner.parts
            self.held += inner.held
            self._read += inner._read


def _shortened(text: str) -> Hashable:
    return text if len(text) <= _SHORT else hashlib.blake2b(text.encode(), digest_size=16).digest()


_layouts: weakref.WeakKeyDictionary[type, tuple[tuple[str, ...], bool]] = weakref.WeakKeyDictionary()


def _layout(kind: type) -> tuple[tuple[str, ...], bool]:
    """The slots of a class; and whether its objects are copied by a recipe, or hold more than attributes (in C)."""
    found = _layouts.get(kind)
    if found is None:
        all_slots = [vars(base).get("__slots__", ()) for base in kind.__mro__]
        slots = [x for each in all_slots for x in ((each,) if isinstance(each, str) else each)]
        slots = [x for x in slots if x not in ("__dict__", "__weakref__")]
        pointers = len(slots) + (kind.__dictoffset__ > 0) + (kind.__weakrefoffset__ > 0)
        holds_more = kind.__itemsize__ > 0 or kind.__basicsize__ > object.__basicsize__ + pointers * _POINTER
        plain = kind.__reduce_ex__ is object.__reduce_ex__ and kind.__reduce__ is object.__reduce__
        found = _layouts[kind] = tuple(slots), holds_more or not plain
    return found


_POINTER = 8  # bytes

_CONTENTS: dict[Value, Callable[[_Reader, Value], None]] = {
    dict: _Reader.mapping,
    **dict.fromkeys((tuple, list, set, frozenset), _Reader.sequence),
    **dict.fromkeys(_TEXTS_AND_NUMBERS, _Reader.text_or_number),
}
_READERS: dict[type, Callable[[_Reader, Value], None]] = {
    types.FunctionType: _Reader.function,
    types.MethodType: _Reader.method,
    types.ModuleType: _Reader.module,
    types.BuiltinFunctionType: _Reader.builtin,
    types.MethodWrapperType: _Reader.builtin,
    property: _Reader.property,
    PyTreeDef: _Reader.structure,
    np.ndarray: _Reader.array,
    weakref.ReferenceType: _Reader.reference,
    dict: _Reader.mapping,
    **dict.fromkeys((tuple, list, set, frozenset), _Reader.sequence),
    **dict.fromkeys((classmethod, staticmethod, functools.cached_property), _Reader.made_of_function),
    **dict.fromkeys((type(jax.jit(len)), type(functools.lru_cache(len))), _Reader.wrapper),
    **dict.fromkeys(
        (
            types.CodeType,
            types.WrapperDescriptorType,
            types.MethodDescriptorType,
            types.ClassMethodDescriptorType,
            types.GetSetDescriptorType,
            types.MemberDescriptorType,
            np.ufunc,
        ),
        _Reader.identity,
    ),
}
_KINDS: tuple[tuple[Value, Callable[[_Reader, Value], None]], ...] = (
    (Tracer, _Reader.refuse),
    (np.ndarray, _Reader.array),
    (np.generic, _Reader.number),
    (type, _Reader.type),
    (types.ModuleType, _Reader.module),
    ((jax.Array, Primitive, Jaxpr, ClosedJaxpr), _Reader.identity),
    ((np.dtype, jax.Device, jax.sharding.Mesh, jax.sharding.Sharding, jax.sharding.PartitionSpec), _Reader.value),
)


def _reader_of(kind: type) -> Callable[[_Reader, Value], None]:
    """The method that reads objects of a class."""
    found = next((reader for base, reader in _KINDS if issubclass(kind, base)), _Reader.other)
    if _is_installed_object(kind):
        _READERS[kind] = found
    return found
