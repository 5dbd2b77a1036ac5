"""Numbers of a scenario of which every member has a value of its own: what `[spread]` may name, and these values.

The key of a number in `[spread]` is its path in the scenario, such as `inertia` or `orbit.eccentricity`; a table of a
list is named by its `name` or counted from 1. The value is a standard deviation in the unit of the number, one for all
components or one each; with `_percent` behind the key it is relative to the number. Deviations are normal. A value that
the scenario itself could not have is drawn again, so that every member is a system that a file could describe.
"""

from __future__ import annotations

import difflib
import math
import zlib
from collections.abc import Callable, Iterator, Mapping
from fnmatch import fnmatchcase
from functools import partial
from typing import Any, NamedTuple, TypeVar, get_args

import annotated_types
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from lieint_jax.app.scenarios._runs import nominal_of
from lieint_jax.types import State, Step

Path = tuple[str, ...]
T = TypeVar("T", bound=BaseModel)

_SPREAD, _PERCENT = "spread", "_percent"
_STREAM = 2**31 - 1  # of random numbers: not one of those that kinds count by members, of which there are fewer
_TRIES = 16  # draws of a number that must be one that a file could have


class Law(NamedTuple):
    """How a member's value follows from the nominal one: the mark of a key in a model.

    Attributes:
        value: of a nominal value and deviations, (members, …).
        allows: whether values (members, …), of this nominal one, are those of a system.
        of: what deviations are of, in words, where they are not of the number itself.
        by_axis: whether there is one deviation for each of three axes, not for each component.
    """

    value: Callable[[np.ndarray, np.ndarray], np.ndarray]
    allows: Callable[[np.ndarray, np.ndarray], np.ndarray]
    of: str = ""
    by_axis: bool = False


class Number(NamedTuple):
    """A number of a scenario, or a list of them.

    Attributes:
        value: the nominal one.
        law: how members deviate from it.
        limits: of its key: `annotated_types` of every component.
    """

    value: np.ndarray
    law: Law
    limits: tuple[Any, ...]

    def shape(self) -> tuple[int, ...]:
        """That of deviations."""
        return (3,) if self.law.by_axis else self.value.shape

    def allows(self, x: np.ndarray) -> np.ndarray:
        """Whether values (members, …) are within the limits."""
        inside = [_TESTS[type(limit)](x, limit) for limit in self.limits]
        components = tuple(range(1, x.ndim))
        return np.all(np.array([*inside, np.isfinite(x)]), axis=0).all(axis=components) & self.law.allows(self.value, x)


_TESTS: dict[type, Callable[[np.ndarray, Any], np.ndarray]] = {
    annotated_types.Gt: lambda x, limit: x > limit.gt,
    annotated_types.Ge: lambda x, limit: x >= limit.ge,
    annotated_types.Lt: lambda x, limit: x < limit.lt,
    annotated_types.Le: lambda x, limit: x <= limit.le,
}


def _any(value: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.ones(len(x), bool)


def _definite(value: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Whether tensors, principal values (members, 3) or (members, 3, 3), are positive definite."""
    return (x if x.ndim == 2 else np.linalg.eigvalsh(x)).min(axis=1) > 0


def _scaled(P: Array, factors: Array) -> Array:
    """Second moments of mass (3, 3) that are larger by factors along the axes."""
    size = jnp.sqrt(factors)
    return size[:, None] * P * size


def stretch_inertia(inertia: Array, factors: Array) -> Array:
    """The inertia of a body whose second moments of mass along the body axes are larger by factors, (3, 3).

    With P = ½ tr(J) 1 − J: any factors > 0 give an inertia that a body can have.
    """
    P = _scaled(jnp.trace(inertia) / 2 * jnp.eye(3) - inertia, factors)
    return jnp.trace(P) * jnp.eye(3) - P


def _by_axis(function: Callable[..., Any], tensor: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """A function of a tensor and many factors, by deviations of their logarithms; principal values stay such."""
    given = np.diag(tensor) if tensor.ndim == 1 else tensor
    found = np.asarray(function(given, np.exp(deviation)))
    return np.diagonal(found, axis1=1, axis2=2) if tensor.ndim == 1 else found


def _unit(value: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    found = value + deviation
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def _same_side(of: float, value: np.ndarray, x: np.ndarray) -> np.ndarray:
    components = tuple(range(1, x.ndim))
    return (np.sign(x - of) == np.sign(value - of)).all(axis=components)


_MOMENTS = "of the second moments of mass along the body axes"  # of their logarithms: see the page on covariance
PLAIN = Law(np.add, _any)
INERTIA = Law(partial(_by_axis, jax.jit(jax.vmap(stretch_inertia, (None, 0)))), _definite, _MOMENTS, by_axis=True)
SECOND_MOMENTS = Law(partial(_by_axis, jax.jit(jax.vmap(_scaled, (None, 0)))), _definite, _MOMENTS, by_axis=True)
DIRECTION = Law(_unit, _any, "of each component, before the length is made 1 again")
NOT_INSIDE_OUT = Law(np.add, lambda _, x: np.linalg.det(x) > 0)


def on_the_side_of(of: float) -> Law:
    """Members' values stay above or below this number, as the nominal one is; one that is equal to it stays equal."""
    return Law(np.add, partial(_same_side, of))


def numbers(table: BaseModel, path: Path = ()) -> dict[Path, Number]:
    """All real numbers of a scenario, by their paths."""
    found: dict[Path, Number] = {}
    for name, field in type(table).model_fields.items():
        value, own = getattr(table, name), (*path, name)
        if name == _SPREAD:
            continue
        if isinstance(value, BaseModel):
            found |= numbers(value, own)
        elif isinstance(value, list) and value and isinstance(value[0], BaseModel):
            for label, row in _labeled(value):
                found |= numbers(row, (*own, label))
        elif (number := _number(value, field)) is not None:
            found[own] = number
    return found


def _labeled(rows: list[Any]) -> list[tuple[str, Any]]:
    return [(getattr(row, "name", str(k)), row) for k, row in enumerate(rows, 1)]


def _number(value: Any, field: FieldInfo) -> Number | None:
    """A value as a number, if it is one; its law and limits are in the annotation of its key."""
    marks = list(_marks(field))
    law = next((mark for mark in marks if isinstance(mark, Law)), None)
    if value is None or (law is None and not _real(value)):
        return None
    limits = tuple(mark for mark in marks if type(mark) in _TESTS)
    return Number(np.asarray(value, float), law or PLAIN, limits)


def _real(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(map(_real, value))
    return isinstance(value, float)


def _marks(annotation: Any) -> Iterator[Any]:
    """Everything that an annotation says besides its type, of the value and of its components."""
    if isinstance(annotation, FieldInfo):
        yield from annotation.metadata
        yield from _marks(annotation.annotation)
    elif hasattr(annotation, "__metadata__"):
        for mark in annotation.__metadata__:
            yield from _marks(mark) if isinstance(mark, FieldInfo) else (mark,)
        yield from _marks(annotation.__origin__)
    else:
        for part in get_args(annotation):
            yield from _marks(part)


class Given(NamedTuple):
    """The spread of a number as a file gives it.

    Attributes:
        number: of which it is.
        sigma: standard deviations, of the shape of the number's deviations.
        words: for the report.
    """

    number: Number
    sigma: np.ndarray
    words: str


def requested_spreads(scenario: BaseModel, fixed: Mapping[str, str]) -> dict[Path, Given]:
    """The spreads of numbers that a scenario gives, by the paths of the numbers; those that are 0 are left out.

    Args:
        scenario: the scenario, whose table `spread` may hold them.
        fixed: patterns of paths of numbers that have no spread, with the reasons.

    Raises:
        ValueError: no such number, or no standard deviation.
    """
    table: Any = getattr(scenario, _SPREAD, None)
    entries = dict(_entries(getattr(table, "model_extra", None) or {}))
    if not entries:
        return {}
    known, declared = numbers(scenario), type(table).model_fields
    own = dict.fromkeys(declared, "[spread] has a key for it, without %")
    reasons = {path: _reason(path, {**own, **fixed}) for path in known}
    found: dict[Path, Given] = {}
    for path, value in entries.items():
        percent = path not in known and path[-1].endswith(_PERCENT)
        key = (*path[:-1], path[-1].removesuffix(_PERCENT)) if percent else path
        if key not in known or reasons[key] is not None:
            raise ValueError(_refusal(path, key, reasons, declared))
        if key in found:
            raise ValueError(f"spread: give {_join(key)} or {_join(key)}{_PERCENT}, not both")
        found[key] = _parse_spread(path, value, known[key], percent)
    return {path: spread for path, spread in found.items() if spread.sigma.any()}


def _entries(table: Mapping[str, Any], path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """The entries of nested tables by their paths."""
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from _entries(value, (*path, name))
        else:
            yield (*path, name), value


def _parse_spread(path: Path, value: Any, number: Number, percent: bool) -> Given:
    key = _join((_SPREAD, *path))
    sigma = _standard_deviations(key, value, number.shape())
    unit, of = (" %" if percent else ""), (f" {number.law.of}" if number.law.of else "")
    shown = ", ".join(f"{x:.3g}" for x in np.ravel(value))
    words = f"{_join(path).removesuffix(_PERCENT)} {shown if np.ndim(value) == 0 else f'({shown})'}{unit}{of}"
    if percent:
        sigma = sigma / 100 * (1.0 if number.law.by_axis else abs(number.value))
    return Given(number, sigma, words)


def _standard_deviations(key: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    numeric = not isinstance(value, bool | str) and all(isinstance(x, int | float) for x in _flat(value))
    if not numeric or not all(math.isfinite(x) and x >= 0 for x in _flat(value)):
        raise ValueError(f"{key}: must be a standard deviation, 0 or above (got {value!r})")
    try:
        sigma = np.asarray(value, float)
    except ValueError:
        sigma = np.zeros((0,))
    if sigma.shape not in ((), shape):
        size = "one number" if not shape else f"one number, or {' × '.join(map(str, shape))} of them"
        raise ValueError(f"{key}: must be {size} (got {value!r})")
    return np.broadcast_to(sigma, shape)


def _flat(value: Any) -> list[Any]:
    return [x for part in value for x in _flat(part)] if isinstance(value, list) else [value]


def _reason(path: Path, fixed: Mapping[str, str]) -> str | None:
    """Why a number has no spread; None if it has."""
    return next((reason for pattern, reason in fixed.items() if fnmatchcase(_join(path), pattern)), None)


def _refusal(path: Path, key: Path, reasons: Mapping[Path, str | None], declared: Mapping[str, Any]) -> str:
    """What to say of an entry that is no number with a spread: why, and what there is."""
    name = _join((_SPREAD, *path))
    can = [*declared, *(_join(other) for other, reason in reasons.items() if reason is None)]
    allowed = f"these can be spread: {', '.join(can)}"
    if key in reasons:
        return f"{name}: {reasons[key]}; {allowed}"
    near = difflib.get_close_matches(_join(key), can, 1)
    meant = f"did you mean {near[0]}? " if near else ""
    return f"{name}: no number of this scenario: {meant}{allowed}"


def _join(path: Path) -> str:
    return ".".join(path)


def drawn(scenario: Any) -> dict[Path, np.ndarray]:
    """The members' own values, (members, …), by the paths of the numbers that have a spread.

    A member's value depends on the seed, its number and the path alone: not on the size of the ensemble or on other
    spreads. That of the first member is the nominal one.

    Raises:
        ValueError: a spread so large that a member has no value which is allowed.
    """
    return {path: _members(scenario, path, spread) for path, spread in scenario.own_numbers().items()}


def _members(scenario: Any, path: Path, spread: Given) -> np.ndarray:
    number, key = spread.number, jax.random.key(scenario.seed)
    name = np.uint32(zlib.crc32(_join(path).encode()))
    found, left = np.repeat(number.value[None], scenario.members, axis=0), np.arange(scenario.members) > 0
    for attempt in range(_TRIES):
        noise = np.asarray(_normal(key, name, attempt, scenario.members, number.shape()), float)
        x = number.law.value(number.value, spread.sigma * noise)
        good = left & number.allows(x)
        found[good] = x[good]
        left &= ~good
        if not left.any():
            return found
    raise ValueError(
        f"spread.{_join(path)}: {left.sum()} of {scenario.members} members found no value that the scenario allows "
        f"within {_TRIES} draws about {number.value.tolist()}: give a smaller one"
    )


@partial(jax.jit, static_argnames=("members", "shape"))
def _normal(key: Array, name: np.uint32, attempt: int, members: int, shape: tuple[int, ...]) -> Array:
    """Standard normal deviates of members, (members, …), by the key of a seed and the name of what is drawn."""
    for number in (_STREAM, name, attempt):
        key = jax.random.fold_in(key, number)
    return jax.vmap(lambda k: jax.random.normal(jax.random.fold_in(key, k), shape))(jnp.arange(members))


def with_numbers(table: T, values: Mapping[Path, Any]) -> T:
    """A scenario with other values, which may be traced, of the numbers at some paths. They are not checked."""
    inner: dict[str, dict[Path, Any]] = {}
    for path, value in values.items():
        inner.setdefault(path[0], {})[path[1:]] = value
    return table.model_copy(update={name: _replaced(getattr(table, name), parts) for name, parts in inner.items()})


def _replaced(value: Any, parts: Mapping[Path, Any]) -> Any:
    if () in parts:
        return parts[()]
    if isinstance(value, BaseModel):
        return with_numbers(value, parts)
    rows = []
    for label, row in _labeled(value):
        own = {path[1:]: x for path, x in parts.items() if path[0] == label}
        rows.append(with_numbers(row, own) if own else row)
    return rows


def build(
    scenario: Any,
    noise: Any,
    step_of: Callable[[Any], Step],
    state_of: Callable[[Any, Any, Any], State],
    *,
    traced: bool = True,
) -> tuple[Step, State]:
    """The step and the members' states; where numbers have a spread, the leaves of the step have the member axis.

    Args:
        scenario: the scenario.
        noise: a member's deviations of the initial state, with the member axis.
        step_of: the step of a scenario, whose numbers may be traced.
        state_of: the initial state of scenario, system and deviations.
        traced: whether `step_of` accepts traced numbers; else the members' steps are made one by one.
    """
    nominal, own = step_of(scenario), drawn(scenario)
    if not own:
        return nominal, _sharing_time(jax.vmap(partial(state_of, scenario, nominal.system))(noise))

    def member(numbers: Mapping[Path, Any], noise: Any) -> tuple[Step, State]:
        its = with_numbers(scenario, numbers)
        step = step_of(its)
        return step, state_of(its, step.system, noise)

    if traced:
        made = jax.jit(jax.vmap(member))(own, noise)
    else:
        each = [member(*_of_member((own, noise), m)) for m in range(scenario.members)]
        made = jax.tree.map(lambda *x: jnp.stack(x), *each)
    step, states = with_first(made, (nominal, state_of(scenario, nominal.system, nominal_of(noise))))
    return step, _sharing_time(states)


def _sharing_time(states: State) -> State:
    """The states of members with one time for all, if they have a time."""
    return states if states.t is None else states._replace(t=states.t[0])


def _of_member(tree: tuple[dict[Path, np.ndarray], Any], m: int) -> tuple[dict[Path, Any], Any]:
    own, noise = tree
    return {path: x[m].tolist() for path, x in own.items()}, jax.tree.map(lambda x: x[m], noise)


def with_first(made: tuple[Step, State], first: tuple[Step, State]) -> tuple[Step, State]:
    """Members of which the first is exactly `first`, as it is without a spread: a compiled program rounds otherwise."""
    leaves, structure = jax.tree.flatten(made)
    known = jax.tree.leaves(first)
    exact = [jnp.asarray(x).at[0].set(x0) for x, x0 in zip(leaves, known, strict=True)]
    return jax.tree.unflatten(structure, exact)


def value_of(scenario: Any, *path: str) -> np.ndarray:
    """The members' values of a number, (members, …), or the one that they share."""
    found = drawn(scenario)
    return found[path] if path in found else numbers(scenario)[path].value


def each_member(scenario: Any) -> Iterator[Any]:
    """The scenarios of the members alone: those of one member, with its numbers and without a spread of numbers."""
    own = drawn(scenario)
    declared = {name: getattr(scenario.spread, name) for name in type(scenario.spread).model_fields}
    plain = scenario.model_copy(update={"members": 1, _SPREAD: type(scenario.spread).model_construct(**declared)})
    for m in range(scenario.members):
        yield with_numbers(plain, {path: x[m].tolist() for path, x in own.items()})


def of_member(scenario: Any, tree: Any, m: int = 0) -> Any:
    """The step or the system of a member: the one that all share, unless their numbers have a spread."""
    return jax.tree.map(lambda leaf: leaf[m], tree) if scenario.own_numbers() else tree
