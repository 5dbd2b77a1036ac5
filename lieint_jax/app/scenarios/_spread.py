"""Parameters that vary between members: which ones `[spread]` may name, and the drawn values.

The key of a number in `[spread]` is its path in the scenario, such as `inertia` or `orbit.eccentricity`; a table of a
list is named by its `name` or counted from 1. The value is a standard deviation in the unit of the number, one for all
components or one each; with the suffix `_percent` it is relative to the number. Deviations are normal. Invalid draws
are repeated, so that every member is a valid scenario.
"""

from __future__ import annotations

import difflib
import zlib
from collections.abc import Callable, Iterator, Mapping
from fnmatch import fnmatchcase
from functools import partial
from typing import Annotated, Any, NamedTuple, TypeVar, get_args, get_origin

import annotated_types
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from lieint_jax import _checks
from lieint_jax.app.scenarios._runs import Numbers, nominal_member
from lieint_jax.types import State, Step
from lieint_jax.types.shapes import PyTree

Path = tuple[str, ...]
T = TypeVar("T", bound=BaseModel)

_SPREAD, _PERCENT = "spread", "_percent"
_STREAM = 2**31 - 1  # of random numbers; kinds use the smaller numbers of members for theirs
_LARGEST = float(np.finfo(float).max)
_TRIES = 16  # draws of a number until a file could have it


class DeviationLaw(NamedTuple):
    """How a member's value follows from the nominal one; the annotation of a key in a model."""

    value: Callable[[np.ndarray, np.ndarray], np.ndarray]  # the values (members, …) for a nominal value and deviations
    # whether a system may have these values (members, …), for a nominal value; None: it may have all
    allows: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    basis: str = ""  # the quantities that deviate, in words, unless they are the number itself
    by_axis: bool = False  # whether there is one deviation for each of three axes, not for each component


class Number(NamedTuple):
    """A number of a scenario, or a list of them."""

    value: np.ndarray  # the nominal value
    law: DeviationLaw  # how members deviate from it
    limits: tuple[Any, ...]  # the limits of every component, `annotated_types` of its key

    def shape(self) -> tuple[int, ...]:
        """The shape of the deviations."""
        return (3,) if self.law.by_axis else self.value.shape

    def allows(self, x: np.ndarray) -> np.ndarray:
        """Whether values (members, …) are within the limits."""
        inside = [_TESTS[type(limit)](x, limit) for limit in self.limits]
        good = _holds_for_all(np.all([*inside, np.isfinite(x)], axis=0))
        return good & self.law.allows(self.value, x) if self.law.allows else good


_TESTS: dict[type, Callable[[np.ndarray, Any], np.ndarray]] = {
    annotated_types.Gt: lambda x, limit: x > limit.gt,
    annotated_types.Ge: lambda x, limit: x >= limit.ge,
    annotated_types.Lt: lambda x, limit: x < limit.lt,
    annotated_types.Le: lambda x, limit: x <= limit.le,
}


def _holds_for_all(good: np.ndarray) -> np.ndarray:
    """Whether something holds for all components of each member, (members, …)."""
    return np.all(good.reshape(len(good), -1), axis=1)


def _scale_second_moments(P: Array, factors: Array) -> Array:
    """Multiply second moments of mass (3, 3) by factors along the axes."""
    size = jnp.sqrt(factors)
    return size[:, None] * P * size


def stretch_inertia(inertia: Array, factors: Array) -> Array:
    """The inertia of a body after its second moments of mass along the body axes are multiplied by factors, (3, 3).

    With P = ½ tr(J) 1 − J: any factors > 0 give an inertia that a body can have.
    """
    P = _scale_second_moments(jnp.trace(inertia) / 2 * jnp.eye(3) - inertia, factors)
    return jnp.trace(P) * jnp.eye(3) - P


def _along_axes(function: Callable[..., Any]) -> DeviationLaw:
    """Deviations of the logarithms of the second moments of mass: see the page on covariance.

    `function` is one of a tensor and three factors; a tensor that is given by its principal values stays principal.
    """
    mapped = jax.jit(jax.vmap(function, (None, 0)))

    def value(tensor: np.ndarray, deviation: np.ndarray) -> np.ndarray:
        found = np.asarray(mapped(np.diag(tensor) if tensor.ndim == 1 else tensor, np.exp(deviation)))
        return np.diagonal(found, axis1=1, axis2=2) if tensor.ndim == 1 else found

    def is_positive_definite(_: np.ndarray, x: np.ndarray) -> np.ndarray:
        return (x if x.ndim == 2 else np.linalg.eigvalsh(x)).min(axis=1) > 0

    basis = "of the second moments of mass along the body axes"
    return DeviationLaw(value, is_positive_definite, basis, by_axis=True)


def _deviate_direction(value: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    found = value + deviation
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


ADDITIVE = DeviationLaw(np.add)
INERTIA, SECOND_MOMENTS = _along_axes(stretch_inertia), _along_axes(_scale_second_moments)
DIRECTION = DeviationLaw(_deviate_direction, basis="of each component, before normalization")
POSITIVE_DETERMINANT = DeviationLaw(np.add, lambda _, x: np.linalg.det(x) > 0)


def same_side_of(limit: float) -> DeviationLaw:
    """Values of members stay on the side of the limit on which the nominal value is, above, below or equal."""
    return DeviationLaw(np.add, lambda value, x: _holds_for_all(np.sign(x - limit) == np.sign(value - limit)))


def numbers(table: BaseModel, path: Path = ()) -> dict[Path, Number]:
    """All real numbers of a scenario, by their paths."""
    found: dict[Path, Number] = {}
    fields = type(table).model_fields
    for name, value in table:
        place = (*path, name)
        if name == _SPREAD:
            continue
        if isinstance(value, BaseModel):
            found |= numbers(value, place)
        elif isinstance(value, list) and value and isinstance(value[0], BaseModel):
            for label, row in _labeled_rows(value):
                found |= numbers(row, (*place, label))
        elif (number := _as_number(value, fields[name])) is not None:
            found[place] = number
    return found


def _labeled_rows(rows: list[Any]) -> list[tuple[str, Any]]:
    return [(dict(row).get("name", str(k)), row) for k, row in enumerate(rows, 1)]


def _as_number(value: object, field: FieldInfo) -> Number | None:
    """The value of a key as a number, if it is one, with law and limits from the key's annotation."""
    marks = list(_annotations(field))
    law = next((mark for mark in marks if isinstance(mark, DeviationLaw)), None)
    if value is None or (law is None and not _is_real(value)):
        return None
    limits = tuple(mark for mark in marks if type(mark) in _TESTS)
    return Number(np.asarray(value, float), law or ADDITIVE, limits)


def _is_real(value: object) -> bool:
    if isinstance(value, list):
        return bool(value) and all(map(_is_real, value))
    return isinstance(value, float)


def _annotations(annotation: Any) -> Iterator[Any]:
    """The metadata of an annotation, for the value and for its components."""
    if isinstance(annotation, FieldInfo):
        yield from annotation.metadata
        yield from _annotations(annotation.annotation)
    elif get_origin(annotation) is Annotated:
        for mark in annotation.__metadata__:
            yield from _annotations(mark) if isinstance(mark, FieldInfo) else (mark,)
        yield from _annotations(annotation.__origin__)
    else:
        for part in get_args(annotation):
            yield from _annotations(part)


class GivenSpread(NamedTuple):
    """The spread of a number in a file."""

    number: Number  # the number
    sigma: np.ndarray  # the standard deviations, in the shape of the number's deviations
    words: str  # the spread as text for the report


def requested_spreads(scenario: Any, fixed: Mapping[str, str]) -> dict[Path, GivenSpread]:
    """The spreads of numbers that a scenario gives, by the paths of the numbers, without those that are 0.

    `fixed` are patterns of paths of numbers that have no spread, with the reasons. ValueError: no such number, or no
    standard deviation.
    """
    table: Any = dict(scenario).get(_SPREAD)
    entries = dict(_entries(table.model_extra or {})) if isinstance(table, BaseModel) else {}
    if not entries:
        return {}
    known, declared = numbers(scenario), type(table).model_fields
    own = dict.fromkeys(declared, "[spread] has a key for it, without %")
    patterns = {**own, **fixed}
    reasons = {
        path: next((why for pattern, why in patterns.items() if fnmatchcase(".".join(path), pattern)), None)
        for path in known
    }
    found: dict[Path, GivenSpread] = {}
    for path, value in entries.items():
        percent = path not in known and path[-1].endswith(_PERCENT)
        key = (*path[:-1], path[-1].removesuffix(_PERCENT)) if percent else path
        if key not in known or reasons[key] is not None:
            raise ValueError(_refusal(path, key, reasons, declared))
        if key in found:
            raise ValueError(f"spread: give {'.'.join(key)} or {'.'.join(key)}{_PERCENT}, not both")
        found[key] = _parse_spread(path, value, known[key], percent)
    return {path: spread for path, spread in found.items() if spread.sigma.any()}


def _entries(table: Mapping[str, Any], path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """The entries of nested tables by their paths."""
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from _entries(value, (*path, name))
        else:
            yield (*path, name), value


def _parse_spread(path: Path, value: ArrayLike, number: Number, percent: bool) -> GivenSpread:
    key = ".".join((_SPREAD, *path))
    sigma = _standard_deviations(key, value, number.shape())
    unit, basis = (" %" if percent else ""), (f" {number.law.basis}" if number.law.basis else "")
    shown = ", ".join(f"{x:.3g}" for x in np.ravel(value))
    words = f"{'.'.join(path).removesuffix(_PERCENT)} {shown if np.ndim(value) == 0 else f'({shown})'}{unit}{basis}"
    if percent:
        sigma = sigma / 100 * (1.0 if number.law.by_axis else abs(number.value))
    return GivenSpread(number, sigma, words)


def _standard_deviations(key: str, value: object, shape: tuple[int, ...]) -> np.ndarray:
    numeric = not isinstance(value, bool | str) and all(isinstance(x, int | float) for x in _flatten(value))
    if not numeric or not all(0 <= x <= _LARGEST for x in _flatten(value)):
        raise ValueError(f"{key}: must be a standard deviation, 0 or above (got {_checks.printable(value)})")
    try:
        sigma = np.asarray(value, float)
    except ValueError:
        sigma = np.zeros((0,))
    if sigma.shape not in ((), shape):
        size = "one number" if not shape else f"one number, or {' × '.join(map(str, shape))} of them"
        raise ValueError(f"{key}: must be {size} (got {_checks.printable(value)})")
    return np.broadcast_to(sigma, shape)


def _flatten(value: object) -> list[Any]:
    return [x for part in value for x in _flatten(part)] if isinstance(value, list) else [value]


def _refusal(path: Path, key: Path, reasons: Mapping[Path, str | None], declared: Mapping[str, Any]) -> str:
    """The message for an entry that must not have a spread: the reason, and the allowed entries."""
    name = ".".join((_SPREAD, *path))
    possible = [*declared, *(".".join(other) for other, reason in reasons.items() if reason is None)]
    allowed = f"these can be spread: {', '.join(possible)}"
    if key in reasons:
        return f"{name}: {reasons[key]}; {allowed}"
    near = difflib.get_close_matches(".".join(key), possible, 1)
    meant = f"did you mean {near[0]}? " if near else ""
    return f"{name}: no number of this scenario: {meant}{allowed}"


def draw_members(scenario: Any) -> dict[Path, np.ndarray]:
    """The members' own values, (members, …), by the paths of the numbers that have a spread.

    A member's value depends on the seed, its number and the path alone: not on the size of the ensemble or on other
    spreads. That of the first member is the nominal one.

    Raises:
        ValueError: a spread is so large that a member found no allowed value.
    """
    return {path: _draw_number(scenario, path, spread) for path, spread in scenario.own_numbers().items()}


def _draw_number(scenario: Any, path: Path, spread: GivenSpread) -> np.ndarray:
    number, key = spread.number, jax.random.key(scenario.seed)
    name = np.uint32(zlib.crc32(".".join(path).encode()))
    found, remaining = np.repeat(number.value[None], scenario.members, axis=0), np.arange(scenario.members) > 0
    for attempt in range(_TRIES):
        noise = np.asarray(_normal(key, name, attempt, scenario.members, number.shape()), float)
        x = number.law.value(number.value, spread.sigma * noise)
        accepted = remaining & number.allows(x)
        found[accepted] = x[accepted]
        remaining &= ~accepted
        if not remaining.any():
            return found
    raise ValueError(
        f"spread.{'.'.join(path)}: {remaining.sum()} of {scenario.members} members found no value that the scenario "
        f"allows within {_TRIES} draws about {number.value.tolist()}: give a smaller one"
    )


@partial(jax.jit, static_argnames=("members", "shape"))
def _normal(key: Array, name: np.uint32, attempt: int, members: int, shape: tuple[int, ...]) -> Array:
    """Standard normal deviates of the members, (members, …), for the key of a seed and the hash of a number's path."""
    for number in (_STREAM, name, attempt):
        key = jax.random.fold_in(key, number)
    return jax.vmap(lambda k: jax.random.normal(jax.random.fold_in(key, k), shape))(jnp.arange(members))


def with_numbers(table: T, values: Mapping[Path, Numbers]) -> T:
    """A scenario with other values of the numbers at some paths. They may be traced, and are not checked."""
    inner: dict[str, dict[Path, Numbers]] = {}
    for path, value in values.items():
        inner.setdefault(path[0], {})[path[1:]] = value
    return table.model_copy(update={name: _with_parts(dict(table)[name], parts) for name, parts in inner.items()})


def _with_parts(value: Any, parts: Mapping[Path, Numbers]) -> Any:
    if () in parts:
        return parts[()]
    if isinstance(value, BaseModel):
        return with_numbers(value, parts)
    rows = []
    for label, row in _labeled_rows(value):
        inner = {path[1:]: x for path, x in parts.items() if path[0] == label}
        rows.append(with_numbers(row, inner) if inner else row)
    return rows


def build(scenario: Any, noise: PyTree) -> tuple[Step, State]:
    """The step and the members' states, for deviates with the member axis.

    Where numbers have a spread, or each member has its own step, the leaves of the step have the member axis too.
    """
    own = draw_members(scenario)

    def member(numbers: Mapping[Path, Numbers], noise: PyTree) -> tuple[Step, State]:
        return with_numbers(scenario, numbers).member(noise)

    if scenario.own_step:
        step, states = jax.jit(jax.vmap(member))(own, noise)
        return step, _with_shared_time(states)
    nominal = scenario.make_step()
    if not own:
        return nominal, _with_shared_time(jax.vmap(partial(scenario.start, nominal.system))(noise))
    if scenario.traced:
        try:
            members = jax.jit(jax.vmap(member))(own, noise)
        except jax.errors.JAXTypeError as error:
            raise ValueError(
                f"numbers that [spread] names are traced in {type(scenario).__name__}: use jax.numpy for numpy in its "
                "make_system and start, or set traced = False to make the members one by one"
            ) from error
    else:
        count = range(scenario.members)
        each = [member(_numbers_of(own, m), jax.tree.map(lambda x, m=m: x[m], noise)) for m in count]
        if len({jax.tree.structure(one) for one in each}) > 1:
            raise ValueError(_closed_over(scenario))
        members = jax.tree.map(lambda *x: jnp.stack(x), *each)
    leaves, structure = jax.tree.flatten(members)
    # without a spread, since a compiled program rounds differently
    first, structure_of_first = jax.tree.flatten((nominal, scenario.start(nominal.system, nominal_member(noise))))
    if structure != structure_of_first:
        _check_functions(scenario, *members)
    exact = [jnp.asarray(x).at[0].set(x0) for x, x0 in zip(leaves, first, strict=True)]
    step, states = jax.tree.unflatten(structure, exact)
    return step, _with_shared_time(states)


def _check_functions(scenario: Any, step: Step, states: State) -> None:
    """Raise ValueError if a function of the members' systems uses a traced number by itself, so that it cannot run."""
    try:
        jax.eval_shape(jax.vmap(lambda step, state: step(state, scenario.dt)), step, states)
    except jax.errors.UnexpectedTracerError as error:
        raise ValueError(_closed_over(scenario)) from error


def _closed_over(scenario: Any) -> str:
    return (
        f"a function that make_system or start of {type(scenario).__name__} defines must not itself use numbers that "
        "[spread] names: define it outside of the class, and pass them by jax.tree_util.Partial(function, number)"
    )


def _with_shared_time(states: State) -> State:
    """The states of members with one shared time, if they have a time."""
    return states if states.t is None else states._replace(t=states.t[0])


def _numbers_of(own: dict[Path, np.ndarray], m: int) -> dict[Path, Numbers]:
    """The numbers of member m."""
    return {path: x[m].tolist() for path, x in own.items()}


def member_values(scenario: Any, *path: str) -> np.ndarray:
    """The members' values of a number, (members, …), or the value that they share."""
    found = draw_members(scenario)
    return found[path] if path in found else numbers(scenario)[path].value


def member_scenarios(scenario: Any) -> Iterator[Any]:
    """The scenario of each member alone, with its numbers and without a spread of numbers."""
    own = draw_members(scenario)
    declared = scenario.spread.model_dump(include=set(type(scenario.spread).model_fields))
    plain = scenario.model_copy(update={"members": 1, _SPREAD: type(scenario.spread).model_construct(**declared)})
    for m in range(scenario.members):
        yield with_numbers(plain, _numbers_of(own, m))
