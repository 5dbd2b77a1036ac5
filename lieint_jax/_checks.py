"""Checks of concrete arguments: messages name the value, the allowed values and the remedy. Tracers are not checked."""

from __future__ import annotations

import abc
import contextlib
import contextvars
import functools
import math
import operator
import os
import re
import reprlib
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike, DTypeLike

try:
    from jax.extend.core import take_current_trace
except ImportError:  # another JAX
    take_current_trace = None

_T = TypeVar("_T")
Input = Any  # an argument as a user passes it: a number, a list, an array, a tracer, or something invalid


@runtime_checkable
class RotationLike(Protocol):
    """A `scipy.spatial.transform.Rotation`, recognized by its methods."""

    def as_quat(self) -> Any: ...
    def as_matrix(self) -> Any: ...


class MassDistribution(abc.ABC):  # noqa: B024 — a name for the classes that are registered
    """What an inertia is taken from: a shape or a molecule. A system or a law, which has more than that, is not one."""


Attitude = ArrayLike | Sequence[Any] | RotationLike
UNIT_TOLERANCE = 1e-6
_GROUPS, _OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")  # the control groups of Linux
PRINTED = 1e-4  # how far from unit length quaternions of four digits are
_on_host: contextvars.ContextVar[bool] = contextvars.ContextVar("_on_host", default=False)
_LARGEST_COUNT = 2**53  # beyond, counts are not exact as floating-point numbers


def printable(value: object, most: int = 200, keep: str = "") -> str:
    """A value from a file as text for a terminal: at most `most` characters, others than printable ones escaped.

    Control and format characters (ESC, a change of direction, a line separator) and halves of surrogate pairs become
    \\x1b, \\u202e, …, except those in `keep`.
    """
    try:
        text = value if isinstance(value, str) else _Short(most).repr(value)
    except ValueError:  # an integer of more digits than Python writes
        text = "a value of too many digits"
    cut = text if len(text) <= most else f"{text[:most]}…"
    return "".join(c if c.isprintable() or c in keep or unicodedata.category(c) == "Zs" else _escape(c) for c in cut)


def path_text(path: object) -> str:
    """The path of a file as text for a terminal: whoever wrote the file may have named it, too."""
    return printable(str(path), 1000)


def name_of(function: object) -> str:
    """The name of a function, or else of its class."""
    return getattr(function, "__name__", type(function).__name__)


def dtype_of(value: object) -> np.dtype | None:
    """The type of the numbers of an array of any library, of its shape and type, or of a tracer; or else None."""
    return getattr(value, "dtype", None)


def snake_case(name: str) -> str:
    """The name of a class as that of a function: "so3_explicit" for SO3Explicit."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


class _Short(reprlib.Repr):
    """`repr` of the first items of long or nested values."""

    def __init__(self, most: int) -> None:
        super().__init__()
        self.maxstring = self.maxlong = self.maxother = self.maxlist = self.maxtuple = self.maxdict = most


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode()


def concrete(*trees: object) -> bool:
    """True if every leaf is a concrete value, not a tracer."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def outermost() -> bool:
    """True outside of jit, vmap, grad and all other transformations; False in a JAX that does not report it."""
    if take_current_trace is None:
        return False
    with take_current_trace() as trace:
        return type(trace).__name__ == "EvalTrace"


def staged() -> bool:
    """True inside a function that JAX traces as a whole, as in jit: there even operations on constants are recorded."""
    return not outermost() and not concrete(jax.device_put(np.float32(0)))


def stands_alone(*trees: object) -> bool:
    """True if a call with these arguments is not part of another function, such as one under jit, vmap or grad."""
    return concrete(trees) and not staged()


def at_once() -> contextlib.AbstractContextManager[None]:
    """A context in which operations on concrete values are computed immediately, inside jit too.

    Outside of jit they are anyway. There `jax.ensure_compile_time_eval` would be harmful: it compiles each
    constant operation of a jitted function as a separate program.
    """
    return jax.ensure_compile_time_eval() if staged() else contextlib.nullcontext()


@contextlib.contextmanager
def on_host() -> Iterator[None]:
    """A context in which checked arrays stay NumPy arrays: copying one to a device costs as much as all its checks."""
    token = _on_host.set(True)
    try:
        yield
    finally:
        _on_host.reset(token)


def as_array(value: Input, dtype: DTypeLike | None = None) -> Array:
    """`jnp.asarray`, but without compiling a program for numbers and lists."""
    kind = dtype_of(value) if dtype is None else dtype
    if kind is not None and _on_host.get() and concrete(value):
        kind = jax.dtypes.canonicalize_dtype(kind)
        return np.asarray(value, kind)  # pyright: ignore[reportReturnType]
    if isinstance(value, Array) or not concrete(value) or staged():
        return jnp.asarray(value, dtype)
    if dtype is None and isinstance(value, int | float | complex):
        return jax.device_put(value)  # weakly typed
    host = np.array(value, dtype)  # a copy, for device_put may share the memory
    return jax.device_put(host) if host.dtype.kind in "fiu" else jnp.asarray(value, dtype)


_PLAIN = frozenset({float, int, complex, bool, str, bytes, type(None), np.ndarray, np.float64, np.float32, np.int64})


def plain(name: str, value: _T) -> _T:
    """`value`, if its numbers mean what they say; an array without a set mask as a plain one.

    Conversion to an array would drop a mask, behind which any number may stand, and a unit.

    Raises:
        ValueError: masked entries; an attribute `unit` or `units`, as quantities of astropy, pint and others have.
    """
    kind = type(value)
    if kind in _PLAIN or isinstance(value, Array):
        return value
    if kind is list or kind is tuple:
        if not _PLAIN.issuperset(map(type, value)):  # pyright: ignore[reportArgumentType]
            for item in value:  # pyright: ignore[reportGeneralTypeIssues]
                plain(name, item)
        return value
    if isinstance(value, np.generic) or callable(value):
        return value
    mask = getattr(value, "mask", None)
    if isinstance(mask, np.ndarray | np.generic) and mask.any():
        raise ValueError(
            f"{name} has {int(mask.sum())} masked entries of {mask.size}, behind which any number may stand: leave "
            "them out, or fill them, as x.filled(value) does"
        )
    unit = getattr(value, "unit", None)
    unit = getattr(value, "units", None) if unit is None else unit
    if unit is not None:
        raise ValueError(
            f"{name} must be plain numbers, got {kind.__name__} with the unit {printable(str(unit))!r}: convert it to "
            "the unit that is wanted here, and give its numbers, as x.to_value(…) of astropy, x.m_as(…) of pint and "
            "x.values of xarray are"
        )
    return np.asarray(value) if isinstance(value, np.ma.MaskedArray) else value  # pyright: ignore[reportReturnType]


def all_plain(**given: object) -> None:
    """ValueError if an argument has masked entries or a unit, by its name."""
    for name, value in given.items():
        plain(name, value)


def host_array(name: str, value: Input, dtype: DTypeLike | None = None) -> np.ndarray:
    """`value` as a NumPy array; ValueError for masked entries or a unit."""
    return np.asarray(plain(name, value), dtype)


def real_array(
    name: str, value: Input, *shapes: Sequence[int], finite: bool = True, like: Array | None = None
) -> Array:
    """`value` as a floating-point array of one of `shapes` (any if none is given), finite where it is concrete.

    Python numbers, which have no dtype, get that of `like`. Without it a single one is weakly typed, an integer too.
    """
    value = plain(name, value)
    try:
        if isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        array = as_array(value, None if like is None or dtype_of(value) is not None else like.dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be an array of real numbers, got {value!r}") from error
    floating = jnp.issubdtype(array.dtype, jnp.floating)
    if not (floating or jnp.issubdtype(array.dtype, jnp.integer)):
        raise ValueError(f"{name} must hold real numbers, got dtype {array.dtype}")
    if floating and array.dtype.itemsize < 4:
        raise ValueError(f"{name} must be float32 or float64, got {array.dtype}, which has too few digits for a step")
    if shapes and array.shape not in [tuple(shape) for shape in shapes]:
        allowed = " or ".join(str(tuple(shape)) for shape in shapes)
        raise ValueError(f"{name} must have shape {allowed}, got {array.shape}; use jax.vmap for batches")
    if finite and concrete(array) and not np.all(np.isfinite(array)):
        raise ValueError(f"{name} must be finite, got {np.asarray(array)}")
    if floating:
        return array
    real = jnp.result_type(float)
    return as_array(np.asarray(array), real) if concrete(array) else array.astype(real)


def positive(name: str, value: Input, *shapes: Sequence[int]) -> Array:
    """`value` as a real number, or as an array of one of `shapes`, positive where it is concrete."""
    number = real_array(name, value, *(shapes or ((),)))
    if concrete(number) and not np.min(np.asarray(number)) > 0:
        raise ValueError(f"{name} must be positive, got {np.asarray(number)}")
    return number


def not_negative(name: str, value: Input, *shapes: Sequence[int]) -> Array:
    """`value` as a real number, or as an array of one of `shapes`, not negative where it is concrete."""
    number = real_array(name, value, *(shapes or ((),)))
    if concrete(number) and np.min(np.asarray(number)) < 0:
        raise ValueError(f"{name} must not be negative, got {np.asarray(number)}")
    return number


def tolerance(name: str, value: Input) -> float:
    """A bound of an error, as a Python float, which programs may be kept by."""
    try:
        number = float(plain(name, value))
    except TypeError as error:  # no number, or a tracer
        raise ValueError(f"{name} must be a concrete number, got {value!r}") from error
    if not 0 <= number < math.inf:
        raise ValueError(f"{name} must be a finite number of at least 0, got {value}")
    return number


def named(check: Callable[..., Any], name: str, *more: Any, optional: bool = False) -> Callable[..., Any]:
    """A check of one value, such as `positive` or `count`, as the converter of a field; it may leave None.

    `more` is what else the check takes: the allowed shapes, or the least count.
    """
    return lambda value, **like: None if optional and value is None else check(name, value, *more, **like)


def optional(value: _T | None) -> _T:
    """The converter of a field that may be given as None, which a method `check_fields` replaces: it does nothing."""
    return cast("_T", value)


def for_each(check: Callable[..., Array], name: str, value: Input, count: int) -> Array:
    """Numbers of `count` things, (count,), from as many or from one, by a check such as `positive`."""
    return jnp.broadcast_to(check(name, value, (), (count,)), (count,))


def step_size(dt: Input) -> Input:
    """`dt`, checked to be a real scalar; a Python integer as a float."""
    dt = plain("dt", dt)
    if isinstance(dt, int) and not isinstance(dt, bool):
        try:
            dt = float(dt)
        except OverflowError:
            raise ValueError("dt must be below 1.8e308, got a larger integer") from None
    kind = jnp.result_type(dt) if isinstance(dt, int | float | np.generic | np.ndarray | Array) else None
    if kind is None or not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
        raise ValueError(f"dt must be a real number, got {dt!r}")
    if jnp.ndim(dt):
        raise ValueError(f"dt must be a scalar, got shape {jnp.shape(dt)}; use jax.vmap for a batch of step sizes")
    return dt


def time_resolution(t: Input, dt: Input, num_steps: int) -> None:
    """Warn if neighboring floating-point numbers at a concrete time t of a run differ by more than 1e-6·dt."""
    if t is None or not concrete(t, dt):
        return
    t = np.asarray(t)
    latest = np.max(np.maximum(np.abs(t), np.abs(t + t.dtype.type(num_steps) * t.dtype.type(dt))))
    if np.spacing(latest) > 1e-6 * abs(float(dt)) > 0:
        warnings.warn(
            f"the time {latest:.6g} of a state is held to {np.spacing(latest):.2g} in {t.dtype}, and the step is "
            f"dt = {float(dt):.6g}: count time from a nearer epoch" + ("" if t.itemsize > 4 else ", or use float64"),
            RuntimeWarning,
            stacklevel=3,
        )


def function(name: str, given: Callable[..., object], of: str, shape: tuple[int, ...], *arguments: object) -> None:
    """Raise ValueError unless `given(*arguments)` is a real floating-point array of this shape.

    Args:
        name: the name of the function, for the message.
        given: the function.
        of: the names of its arguments, for the message.
        shape: the expected shape of its value.
        arguments: arrays, or their shapes and types: nothing is computed.
    """
    wanted = f"an array of real numbers of shape {shape}" if shape else "a real scalar"
    try:
        value = jax.eval_shape(lambda *x: given(*x), *arguments)  # JAX would return what it has found before
    except Exception as error:  # a user's function may raise anything
        reason = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise ValueError(
            f"{name} must be a function of {of}, which JAX can trace, with {wanted} as its value; it fails: {reason}"
        ) from error
    dtype = dtype_of(value)
    if dtype is None or value.shape != shape or not jnp.issubdtype(dtype, jnp.floating):
        got = repr(value) if dtype is None else f"shape {value.shape} and dtype {dtype}"
        raise ValueError(f"{name} must be a function of {of} with {wanted} as its value, got {got}")


def orbit(given: Callable[..., Any]) -> Callable[..., Any]:
    """`given`, if it is a function t ↦ (position, velocity)."""
    function("orbit", lambda t: given(t)[0], "the time t, with (position, velocity)", (3,), jnp.zeros(()))
    return given


_ROTATING = re.compile(
    r"(ITR[FS]|DTRF|IGS|IGB|TIR[FS]|GTOD|TDR|GRC|EFG|ECE?F|PEF|WGS|PZ|MOON_MEIAUE|MOON_ME|MOON_PA)(?![A-Z])"  # fixed in
    r"|FIXED|IAU_|(EARTH|BODY|MOON|CENTER)[ _-]?FIXED"  # the Earth or another body
    r"|(RSW|RTN|RIC|QSW|UVW|TNW|NTW|VNC|LVLH|VVLH)(?![A-Z])"  # that move along an orbit
)


def rotates(frame: object) -> bool:
    """Whether axes of this name rotate: those of the Earth, of another body, or that move along an orbit.

    Source: Registry of celestial body and orbit-relative reference frames, SANA, sanaregistry.org; CCSDS 502.0-B-3,
    annex B.
    """
    name = frame.strip().upper() if isinstance(frame, str) else ""
    return bool(_ROTATING.match(name)) and "INERTIAL" not in name


def inertial(given: Callable[..., Any]) -> Callable[..., Any]:
    """`given`, if it is no orbit whose axes are known to rotate, such as that of a file in ITRF."""
    if rotates(frame := getattr(given, "frame", "")):
        raise ValueError(
            f"orbit must be in inertial axes, got {printable(frame)}, which rotate: transform its positions and "
            "velocities, for example by astropy to GCRS or TEME"
        )
    return given


def closed_form(owner: object, name: str, found: Callable[[], Array], by_autodiff: Callable[[], Array]) -> None:
    """Raise ValueError if a derivative that a user's class has in closed form is not that of its values.

    Args:
        owner: an instance; those of this package, which tests compare, and of tracers are not compared.
        name: of its method.
        found, by_autodiff: the derivative at the same point, by the method and by autodiff; they make their arrays
            themselves, so that inside jit these are values.
    """
    if type(owner).__module__.startswith(f"{__package__}.") or not concrete(owner):
        return
    with at_once():
        ours, theirs = np.asarray(found()), np.asarray(by_autodiff())
    apart, size = np.max(np.abs(ours - theirs)), np.max(np.abs([ours, theirs]))
    if np.isfinite(size) and apart > math.sqrt(jnp.finfo(theirs.dtype).eps) * size:
        raise ValueError(
            f"{type(owner).__name__}.{name} must be the derivative of its values: it is {ours} where autodiff finds "
            f"{theirs}"
        )


def choice(name: str, value: Input, allowed: Iterable[str]) -> str:
    """`value`, if it is one of these words."""
    words = list(allowed)
    if not isinstance(value, str) or value not in words:
        raise ValueError(f"{name} must be {' or '.join(map(repr, words))}, got {printable(repr(value))}")
    return value


def integer(value: Input) -> int | None:
    """A concrete integer of Python, NumPy or JAX, also a scalar array, as a Python int; else None, as for a bool."""
    if isinstance(value, bool) or not jnp.issubdtype(dtype_of(value) or np.int64, np.integer):
        return None
    try:
        return operator.index(value)
    except TypeError:  # no integer, several of them, or a tracer
        return None


def count(name: str, value: Input, least: int) -> int:
    """An integer ≥ `least`, as a Python int; at most 2⁵³, or 2³¹ − 1 where jax_enable_x64 is off."""
    given, value = value, integer(value)
    if value is None or value < least:
        raise ValueError(f"{name} must be an integer ≥ {least}, got {given!r}")
    most = min(_LARGEST_COUNT, jnp.iinfo(jax.dtypes.canonicalize_dtype(np.int64)).max)
    if value > most:
        more = "" if most == _LARGEST_COUNT else " without jax_enable_x64"
        raise ValueError(f"{name} must be at most {most:.16g}{more}, got {value:.6g}: split it into several runs")
    return value


def listed(name: str, value: Input, allowed: Iterable[int], advice: str = "") -> int:
    """An integer that is one of those allowed, as a Python int."""
    numbers, found = list(allowed), integer(plain(name, value))
    if found not in numbers:
        *most, last = map(str, numbers)
        raise ValueError(f"{name} must be {', '.join(most)} or {last}, got {value!r}{advice}")
    return cast("int", found)


def nearest_multiples(value: int, of: int) -> str:
    """The nearest positive multiples of `of` to `value`, as text: "120 or 144"."""
    below = value - value % of
    return f"{below} or {below + of}" if below > 0 else f"{of}"


@functools.cache
def memory_of_machine() -> float:
    """The bytes of memory available to this process: those of the machine, or of its container; inf if unknown."""
    try:
        bytes_ = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):  # a system without sysconf, or without these names
        return math.inf
    for limit in limits_of_groups("memory", "memory.max", "memory.limit_in_bytes"):
        bytes_ = min(bytes_, *limit)
    return bytes_


def limits_of_groups(controller: str, unified: str, *files: str) -> Iterator[list[float]]:
    """The numbers that limit this process in its control groups of Linux and in all groups around them.

    Args:
        controller: the kind of limit, as in "cpu".
        unified: the file with the numbers in version 2.
        files: the files in version 1, one for each number.
    """
    try:
        groups = [line.split(":", 2) for line in _OWN_GROUPS.read_text(encoding="utf-8").splitlines()]
    except OSError:  # another system
        return
    for _, controllers, place in groups:
        if controllers and controller not in controllers.split(","):
            continue
        top, names = (_GROUPS / controller, files) if controllers else (_GROUPS, (unified,))
        own = top / place.lstrip("/")
        for folder in (own, *(x for x in own.parents if x.is_relative_to(top))):
            try:
                yield [float(x) for name in names for x in (folder / name).read_text(encoding="utf-8").split()]
            except (OSError, ValueError):  # no such file, as where a container sees the path outside of it; or "max"
                continue


def entry_size(state: object, members: int = 1) -> int:
    """The bytes of one saved entry: the arrays of `state`, and a residual and a flag for each member."""
    leaves = jax.tree.leaves(state)
    return sum(x.size * x.dtype.itemsize for x in leaves) + members * (leaves[0].dtype.itemsize + 1)


def fits_memory(entries: int, size: int, advice: str, copies: int = 1) -> None:
    """Raise ValueError, before anything is allocated, if a result exceeds this machine's memory.

    Args:
        entries: the number of entries of the result.
        size: the bytes of an entry.
        advice: the remedy, for the message.
        copies: how many copies of the result exist while it is computed.
    """
    memory = memory_of_machine()
    if copies * entries * size > memory:
        twice = f", {copies} times while it is made" if copies > 1 else ""
        raise ValueError(
            f"the result would hold {spoken_size(entries * size)} in memory{twice}: {entries} entries of "
            f"{spoken_size(size)}, and this machine has {spoken_size(memory)}; {advice}"
        )


def spoken_size(size: float) -> str:
    """A number of bytes, to print."""
    for unit in ("bytes", "kB", "MB", "GB", "TB"):
        if size < 1000 or unit == "TB":
            return f"{size:.3g} {unit}"
        size /= 1000
    raise AssertionError


def fraction(name: str, value: Input) -> Array:
    """A number in [0, 1], as an array scalar."""
    array = real_array(name, value, ())
    if concrete(array) and not 0 <= float(array) <= 1:
        raise ValueError(f"{name} must be in [0, 1], got {float(array):g}")
    return array


def one_of(**given: Input) -> tuple[str, Input]:
    """The name and value of the only argument that is not None; raises ValueError unless there is exactly one."""
    named = {name: value for name, value in given.items() if value is not None}
    if len(named) != 1:
        raise ValueError(f"give exactly one of {', '.join(given)}; got {' and '.join(named) or 'none'}")
    return named.popitem()


def inertia(value: Input, stacklevel: int = 3) -> Array:
    """A positive definite inertia: principal moments (3,) or a symmetric tensor (3, 3).

    Moments that violate the triangle inequality (Jᵢ ≤ Jⱼ + Jₖ) belong to no distribution of mass. They cause a warning,
    not an error, since such pseudo-inertias are in use.
    """
    if callable(value):
        raise ValueError(f"inertia must be an array, got {value!r}; a function of time: systems.inertia_in_time")
    array = positive_definite("inertia", value)
    if not concrete(array):
        return array
    moments = _moments(array)
    if moments[2] > (1 + UNIT_TOLERANCE) * (moments[0] + moments[1]):
        warnings.warn(
            f"principal moments {moments} break the triangle inequality: no rigid body has them", stacklevel=stacklevel
        )
    return array


def of_one_system(name: str, value: Input, d: int = 3) -> None:
    """Raise ValueError if a tensor, principal (d,) or symmetric (d, d), is a stack of those of many systems instead."""
    shape = np.shape(value)
    skewed = shape == (d, d) and concrete(value) and not _symmetric(np.asarray(value))
    if skewed or shape not in ((d,), (d, d)):
        raise ValueError(
            f"{name} of one system is ({d},) or symmetric, ({d}, {d}), got shape {shape}"
            f"{', not symmetric' if skewed else ''}. For members with systems of their own, give li.run "
            "own_step=True, or use jax.vmap; for one of them, "
            "jax.tree.map(lambda x: x[k], system)"
        )


def of_shape(name: str, value: Input, attribute: str = "inertia") -> Input:
    """This attribute of a shape; any other value as it is, but a ValueError for a system: its forces would be lost."""
    has = hasattr(value, attribute)
    if has and isinstance(value, MassDistribution):
        return getattr(value, attribute)
    if has or isinstance(value, MassDistribution):
        raise ValueError(
            f"{name} must be an array or a Shape, got {type(value).__name__}, whose potential, rotor and torques would "
            f"be lost: give its attribute {attribute}, and what acts on the body as laws of torque. A top with "
            "friction is torqued_body(top.inertia, torques.viscous(…) + torques.potential(V, axis))"
        )
    return value


def of_shapes(attribute: str, value: Input) -> Input:
    """This attribute of each of several shapes, stacked; any other value as it is. Moments (3,) may become (3, 3)."""
    if not isinstance(value, list | tuple) or not value:
        return value
    each = [of_shape(f"the {attribute} of body {k}", x, attribute) for k, x in enumerate(value)]
    if not all(isinstance(x, MassDistribution) for x in value):  # numbers
        return value
    if len({np.ndim(x) for x in each}) > 1:
        each = [jnp.diag(x) if np.ndim(x) == 1 else x for x in each]
    return jnp.stack([jnp.asarray(x) for x in each])


def positive_definite(name: str, value: Input, d: int = 3, *, mixed_units: bool = False) -> Array:
    """A positive definite tensor: principal values (d,) or a symmetric tensor (d, d); the inertia of a shape too.

    With `mixed_units`, as a metric of rotations and translations has, Jᵢⱼ/√(JᵢᵢJⱼⱼ) is judged.
    """
    array = real_array(name, of_shape(name, value), (d,), (d, d))
    if not concrete(array):
        return array
    J = np.asarray(array, float)
    if J.ndim == 2 and not _symmetric(J):
        raise ValueError(f"{name} must be symmetric, got\n{J}\nUse (A + A.T) / 2 if the difference is noise")
    if mixed_units and J.ndim == 2 and np.all(np.diag(J) > 0):
        size = np.sqrt(np.diag(J))
        J = J / size / size[:, None]
    moments = _moments(J)
    rounding = 4 * float(jnp.finfo(array.dtype).eps) * moments[-1] if J.ndim == 2 else 0.0
    if moments[0] <= rounding:
        straight = "; a straight molecule takes a small axial_moment, as in files.Atoms.shape" if d == 3 else ""
        raise ValueError(
            f"{name} must be positive definite, got principal values {moments}"
            f"{straight if abs(moments[0]) <= rounding else ''}"
        )
    return array


def _symmetric(J: np.ndarray) -> bool:
    return np.allclose(J, J.T, rtol=1e-6, atol=1e-6 * np.abs(J).max())


def _moments(array: Array | np.ndarray) -> np.ndarray:
    J = np.asarray(array, float)
    return np.sort(J if J.ndim == 1 else np.linalg.eigvalsh(J))


def quaternions(attitude: Input) -> Input:
    """The quaternions (w, x, y, z) of a scipy `Rotation`, (4,) or (N, 4), or of a list of them; else what was given."""
    if isinstance(attitude, list | tuple):
        given = any(isinstance(x, RotationLike) for x in attitude)
        return [quaternions(one) for one in attitude] if given else attitude
    return np.roll(np.asarray(attitude.as_quat()), 1, axis=-1) if isinstance(attitude, RotationLike) else attitude


def unit_vector(name: str, value: Input, *shapes: Sequence[int], like: Array | None = None) -> Array:
    """A vector of unit length to 1e-6, (3,), or an array of such vectors of one of `shapes`. It is not normalized."""
    vector = real_array(name, value, *(shapes or ((3,),)), like=like)
    if concrete(vector):
        with np.errstate(over="ignore"):
            lengths = np.linalg.norm(np.asarray(vector, float), axis=-1)
        if np.max(np.abs(lengths - 1)) > UNIT_TOLERANCE:
            what, each = ("a unit vector", "it by its") if vector.ndim == 1 else ("unit vectors", "each by its")
            raise ValueError(
                f"{name} must be {what}, got {np.asarray(vector)} of length {lengths}; divide {each} length"
            )
    return vector


def unit_quaternion(name: str, value: Input, *shapes: Sequence[int], leading: bool = False) -> Array:
    """A unit quaternion (w, x, y, z), an array of them of one of `shapes`, or a scipy `Rotation`.

    It is not normalized if it is of unit length to 1e-6. Up to 1e-4, as printed ones are, it is, with a RuntimeWarning.
    With `leading`, any axes may stand before the last one.
    """
    value = quaternions(value)
    q = with_leading(name, value, (4,)) if leading else real_array(name, value, *(shapes or ((4,),)))
    if not concrete(q):
        return q
    host = np.asarray(q, float)
    unit = nearly_unit(name, host)
    return q if unit is host else as_array(unit, q.dtype)


def nearly_unit(name: str, q: np.ndarray, most: float = PRINTED) -> np.ndarray:
    """Quaternions (…, 4) within `most` of unit length; normalized, with a RuntimeWarning, if beyond 1e-6."""
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(q, axis=-1)
    if not norms.size or np.max(np.abs(norms - 1)) <= UNIT_TOLERANCE:
        return q
    worst = np.unravel_index(np.argmax(np.abs(norms - 1)), norms.shape)
    which, norm = name + "".join(f"[{k}]" for k in worst), norms[worst]
    if not abs(norm - 1) <= most:
        raise ValueError(
            f"{which} must be a unit quaternion (w, x, y, z), the scalar part first: its norm is {norm:.9g}, "
            f"allowed is 1 ± {most:g}; divide it by its norm if it is meant as a direction"
        )
    warnings.warn(
        f"{which} has the norm {norm:.9g}, as quaternions printed with few digits have: normalized",
        RuntimeWarning,
        stacklevel=4,
    )
    return q / norms[..., None]


def rotation_matrix(name: str, value: Input, leading: bool = False) -> Array:
    """A proper rotation matrix, orthogonal to 1e-6; with `leading`, an array of them; or a scipy `Rotation`.

    What is none is NaN inside jit, where nothing is raised.
    """
    value = value.as_matrix() if isinstance(value, RotationLike) else value
    R = with_leading(name, value, (3, 3)) if leading else real_array(name, value, (3, 3))
    if concrete(R):
        M = np.asarray(R, float)
        with np.errstate(over="ignore", invalid="ignore"):  # of huge entries
            defect = float(np.max(np.abs(np.swapaxes(M, -1, -2) @ M - np.eye(3)), initial=0))
        if not defect <= UNIT_TOLERANCE:
            raise ValueError(
                f"{name} must be orthogonal: max|RᵀR − 1| is {defect:.3g}, allowed is {UNIT_TOLERANCE:g}; "
                "project it with a polar or QR decomposition first"
            )
        if np.any(np.linalg.det(M) < 0):
            raise ValueError(f"{name} must be a rotation, got a reflection (determinant −1)")
        return R
    M, most = jax.lax.stop_gradient(R), max(UNIT_TOLERANCE, 16 * float(jnp.finfo(R.dtype).eps))
    size = jnp.max(jnp.abs(M), axis=(-1, -2), keepdims=True)
    M = jnp.where(size <= 2, M, 0)  # others would overflow
    defect = jnp.max(jnp.abs(jnp.swapaxes(M, -1, -2) @ M - jnp.eye(3)), axis=(-1, -2), keepdims=True)
    proper = jnp.sum(jnp.cross(M[..., 0, :], M[..., 1, :]) * M[..., 2, :], axis=-1)[..., None, None] > 0
    return jnp.where((defect <= most) & proper, R, jnp.nan)


def with_leading(name: str, value: Input, shape: tuple[int, ...]) -> Array:
    """`value` as a real array of any leading axes and these last ones."""
    array = real_array(name, value)
    if array.shape[max(array.ndim - len(shape), 0) :] != shape:
        wanted = f"(…, {', '.join(map(str, shape))})"
        raise ValueError(f"{name} must have shape {wanted}, got {array.shape}")
    return array
