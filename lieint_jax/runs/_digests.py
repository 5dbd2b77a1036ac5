"""Digests of arrays, of states and of programs, which are the same in every process.

A function is identified by its program: the equations that JAX traces, with their constants. How the function is
written has no part in it, so that a decorator, a closure, a global variable or a file counts by what it changes, and by
nothing else. Names of variables and functions, places in files, and addresses in memory do not enter. The rules of
derivatives do not, either: those that a program uses are equations of it. Where a function has its own rule for many
members, by `jax.custom_batching`, the equations that the rule gives for them count, too.

Another version of JAX may trace the same function into other equations.
"""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import inspect
import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Primitive, jaxpr_as_fun
from jax.typing import ArrayLike

from lieint_jax import native
from lieint_jax._checks import concrete
from lieint_jax.core import State, leaves_by_name

Program = Any  # a `Jaxpr` or a `ClosedJaxpr`
_NOT_COMPARABLE = "cannot be compared: "  # begins the reason that stands in place of a digest
_PACKAGES = ("jax", "jaxlib", __name__.partition(".")[0])  # in which the name of an operation says what it computes
_PYTHON = "they call back into Python: write that function with jax.numpy"
_OUTSIDE = {  # operations whose results are those of other code
    "pure_callback": _PYTHON,
    "io_callback": _PYTHON,
    "ffi_call": "they call a library by jax.ffi",
}
_SHOWN = ("debug_callback", "debug_print")  # they change no value, whatever they print
_OMITTED = {"sharding", "out_sharding"}  # parameters of any operation that change no value
_OMITTED_OF = dict[str, set[str]](  # and those of some
    jit={"name", "ctx_mesh", "in_shardings", "out_shardings", "in_layouts", "out_layouts"},
    custom_jvp_call={"jvp_jaxpr_fun"},
    custom_vjp_call={"fwd_jaxpr_thunk", "bwd", "out_trees"},
    custom_vjp_call_jaxpr={"fwd_jaxpr_thunk", "bwd", "out_trees"},
    custom_vmap_call={"rule", "in_tree", "out_tree"},
    checkpoint={"policy"},
    remat2={"policy"},
)
_OMITTED_OF["pjit"] = _OMITTED_OF["jit"]  # the name in older versions of JAX
_OF_JAX = {  # classes of JAX whose `repr` is complete
    *("AbstractMesh", "AccuracyMode", "FlatTree", "Mesh", "PartitionSpec", "PyTreeDef", "Tolerance"),
}


class NotComparableError(ValueError):
    """A program has no digest that is the same in another process."""


def digest_of_arrays(*leaves: ArrayLike | bytes) -> str:
    """The digest of arrays with their types and shapes, in order: 16 hexadecimal digits."""
    found = hashlib.sha256()
    for leaf in leaves:
        array = np.frombuffer(leaf, np.uint8) if isinstance(leaf, bytes) else np.asarray(leaf)
        found.update(f"{array.dtype}{array.shape}".encode())
        found.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return found.hexdigest()[:16]


def digest_of_states(states: State) -> str:
    """The digest of the arrays of states: q and p first, then each optional array after its name."""
    q, p, *rest = leaves_by_name(states).items()
    return digest_of_arrays(q[1], p[1], *(part for name, x in rest for part in (name.encode(), x)))


class OfMember(NamedTuple):
    """A program of one member, which is run for many.

    Attributes:
        program: the program.
        own: for each of its arguments, whether each member has its own.
    """

    program: ClosedJaxpr
    own: Sequence[bool]

    @property
    def of_members(self) -> ClosedJaxpr:
        """The program of two members, in which rules for many are applied."""
        shapes = [
            jax.ShapeDtypeStruct((2, *x.shape) if own else x.shape, x.dtype)
            for x, own in zip(self.program.in_avals, self.own, strict=True)
        ]
        axes = [0 if own else None for own in self.own]
        return jax.make_jaxpr(jax.vmap(jaxpr_as_fun(self.program), axes, axis_size=2))(*shapes)


def digest_of_programs(*programs: ClosedJaxpr | OfMember) -> str:
    """The digest of what functions compute: 16 hexadecimal digits.

    Raises:
        NotComparableError: the results are not determined by the equations, or a part of an equation has no text.
    """
    text, digests = _Text(), []
    for each in programs:
        digests.append(text.digest(each.program if isinstance(each, OfMember) else each))
        if text.has_rules and isinstance(each, OfMember):
            digests.append(text.digest(each.of_members))
    return _hash(digests)[:16]


def digest_or_reason(*programs: ClosedJaxpr | OfMember) -> str:
    """The digest of programs, or why they cannot be compared."""
    try:
        return digest_of_programs(*programs)
    except NotComparableError as reason:
        return f"{_NOT_COMPARABLE}{reason}"


def reason_of(digest: object) -> str:
    """Why a program cannot be compared, from what stands in place of its digest; empty if there is a digest."""
    return digest if isinstance(digest, str) and digest.startswith(_NOT_COMPARABLE) else ""


class _NoTextError(Exception):
    """A parameter has no text that is the same in another process."""


class _Text:
    """The text of programs: a line for each equation. A program within another stands there by its digest.

    Attributes:
        has_rules: whether a function in them has its own rule for many members, which the text of one lacks.
    """

    def __init__(self) -> None:
        self.has_rules = False
        self._digests: dict[int, tuple[Program, str]] = {}  # holds the programs too: a freed id would be reused

    def digest(self, program: Program) -> str:
        """The digest of a program."""
        if id(program) not in self._digests:
            self._digests[id(program)] = program, _hash(self._lines(program))
        return self._digests[id(program)][1]

    def _lines(self, program: Program) -> Iterator[str]:
        jaxpr, names = getattr(program, "jaxpr", program), dict[Any, str]()

        def define(variable: Any) -> str:
            names[variable] = f"x{len(names)}"
            return f"{names[variable]}:{_type(variable.aval)}"

        def read(atom: Any) -> str:
            return f"{_type(atom.aval)}:{_array(atom.val)}" if isinstance(atom, Literal) else names[atom]

        consts = getattr(program, "consts", ())
        for variable, x in zip(jaxpr.constvars, consts or [None] * len(jaxpr.constvars), strict=True):
            yield define(variable) + ("" if x is None else f" = {_array(x)}")
        yield f"of {[define(x) for x in jaxpr.invars]}"
        for equation in jaxpr.eqns:
            operands = [read(x) for x in equation.invars]
            yield f"{[define(x) for x in equation.outvars]} = {self._operation(equation)} {operands}"
        yield f"are {[read(x) for x in jaxpr.outvars]}"

    def _operation(self, equation: JaxprEqn) -> str:
        """What an equation does with its operands."""
        name = equation.primitive.name
        if name in _OUTSIDE:
            raise NotComparableError(_OUTSIDE[name])
        if not _is_known(equation.primitive):
            raise NotComparableError(f"{name} is an operation of another package")
        expanded = native.expanded(equation)
        if expanded is not None:
            return self.digest(expanded)
        if name in _SHOWN:
            return name
        self.has_rules |= name == "custom_vmap_call"
        if name.startswith(("random", "threefry")):
            name += f" {getattr(equation.ctx, 'threefry_partitionable', None)}"
        omitted = _OMITTED | _OMITTED_OF.get(name, set())
        parameters = []
        for key in sorted(equation.params.keys() - omitted):
            try:
                parameters.append(f"{key}={self._value(equation.params[key])}")
            except _NoTextError as what:
                raise NotComparableError(f"the parameter {key} of {name} has no text, {what}") from None
        return f"{name} {parameters}"

    def _value(self, x: Any) -> str:
        """The text of a parameter."""
        of = type(x).__name__
        if isinstance(x, enum.Enum):
            return f"{of}.{x.name}"
        if x is None or x is ... or isinstance(x, bool | int | float | complex | str | bytes):
            return repr(x)
        if isinstance(x, Jaxpr | ClosedJaxpr):
            return self.digest(x)
        if isinstance(x, np.dtype | type):
            return _name_of_dtype(x)
        if isinstance(x, np.ndarray | np.generic | jax.Array) or hasattr(x, "__array__"):
            return _array(x)
        if isinstance(x, tuple | list):
            return f"{of}{[self._value(part) for part in x]}"
        if isinstance(x, set | frozenset):
            return f"{of}{sorted(self._value(part) for part in x)}"
        if isinstance(x, dict):
            return f"{of}{sorted(f'{self._value(key)}: {self._value(part)}' for key, part in x.items())}"
        if isinstance(x, ShapedArray):
            return _type(x)
        if _is_of_jax(x) and dataclasses.is_dataclass(x):
            return f"{of}{[self._value(getattr(x, field.name)) for field in dataclasses.fields(x)]}"
        if _is_of_jax(x) and callable(x) and _is_found_by_name(x):
            return f"{x.__module__}.{x.__qualname__}"
        shown = repr(x)
        if _is_of_jax(x) and _OF_JAX & {cls.__name__ for cls in inspect.getmro(type(x))} and " at 0x" not in shown:
            return shown
        raise _NoTextError(f"{of} of {type(x).__module__}")


def _hash(lines: Iterable[str]) -> str:
    found = hashlib.sha256()
    for line in lines:
        found.update(f"{line}\n".encode())
    return found.hexdigest()


def _type(aval: Any) -> str:
    """The type of a value: its dtype and shape."""
    weak = "~" if getattr(aval, "weak_type", False) else ""
    kind = "" if isinstance(aval, ShapedArray) else type(aval).__name__
    return f"{weak}{kind}{_text_of(getattr(aval, 'dtype', ''))}{list(getattr(aval, 'shape', ()))}"


_text_of = cache(str)  # of a dtype, for which NumPy needs microseconds


def _array(x: Any) -> str:
    """The text of a constant."""
    if not concrete(x):
        raise NotComparableError("they depend on a value that JAX is tracing")
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        return f"{x.dtype}{_array(jax.random.key_data(x))}"
    values = np.asarray(x)
    if values.dtype.hasobject:
        raise NotComparableError(f"they have a constant without a text, {type(x).__name__}")
    return f"{values.dtype}{values.shape}{_text_of_bytes(values.tobytes())}"


def _text_of_bytes(data: bytes) -> str:
    return data.hex() if len(data) <= 32 else hashlib.sha256(data).hexdigest()


def _name_of_dtype(x: Any) -> str:
    try:
        dtype = np.dtype(x)
    except TypeError:
        dtype = np.dtype(object)
    if dtype.hasobject:
        raise _NoTextError(str(x))
    return dtype.name


def _is_of_jax(x: Any) -> bool:
    """Whether JAX defines a function, or the class of another object."""
    module = getattr(x if callable(x) and hasattr(x, "__qualname__") else type(x), "__module__", None) or ""
    return module.partition(".")[0] in _PACKAGES


def _is_found_by_name(x: Any) -> bool:
    """Whether a function is the one of its name in its module, and no closure."""
    return getattr(sys.modules.get(x.__module__), getattr(x, "__qualname__", ""), None) is x


def _is_known(primitive: Primitive) -> bool:
    """Whether JAX or this package defines an operation, so that its name stands for what it computes."""
    if id(primitive) not in _known_primitives():
        _known_primitives.cache_clear()  # a module has been imported since
    return id(primitive) in _known_primitives()


@cache
def _known_primitives() -> set[int]:
    """The ids of the operations that modules of JAX and of this package define; modules hold them for ever."""
    modules = [module for name, module in list(sys.modules.items()) if name.partition(".")[0] in _PACKAGES]
    return {id(x) for module in modules for x in list(vars(module).values()) if isinstance(x, Primitive)}
