"""The keys that scenarios of every system share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from lieint_jax import _checks, schemes
from lieint_jax._numerics import random_bits
from lieint_jax.app.scenarios import _spread
from lieint_jax.types import Step

HOUR, DAY = 3600.0, 86400.0  # seconds
TINY = float(np.finfo(float).tiny)  # in place of a divisor that is 0


def checked(check: Callable[[Any], object]) -> AfterValidator:
    """The validator of a key: `check` raises ValueError for a bad value, and what it returns is not used."""

    def validate(value: Any) -> Any:
        check(value)
        return value

    return AfterValidator(validate)


def _check_not_zero(value: list[float]) -> None:
    if not any(value):
        raise ValueError("must not be zero")


def _check_unit(value: list[float]) -> None:
    if abs(np.linalg.norm(value) - 1) > _checks.UNIT_TOLERANCE:
        raise ValueError("must be a unit vector; divide it by its norm")


PositiveFloat = Annotated[float, Field(gt=0)]
Triple = Annotated[list[float], Field(min_length=3, max_length=3)]
PositiveTriple = Annotated[list[PositiveFloat], Field(min_length=3, max_length=3)]
Direction = Annotated[Triple, checked(_check_not_zero)]
UnitVector = Annotated[Triple, checked(_check_unit)]
Moments = Annotated[Triple, checked(_checks.inertia)]
Quadruple = Annotated[list[float], Field(min_length=4, max_length=4)]
NonNegative = Annotated[float, Field(ge=0)]
PositiveInt = Annotated[int, Field(gt=0, le=10**12)]
Text = Annotated[str, Field(pattern=r"^[^$]*$")]  # without $, which matplotlib reads as mathematics


class Table(BaseModel):
    """A table of keys, strictly validated: no unknown keys, no text for a number, no nan.

    The text below a key is its description in the JSON schema, with its unit. The unit of an angle is in its key.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True)


class Published(Table):
    """A published number, with its error and source."""

    value: float
    """Periods are in time_unit, quantities whose names end in _deg in degrees."""
    error: PositiveFloat | None = None
    """Standard deviation, in the unit of the value."""
    source: str
    """A key of the table sources, or the source itself if there is no such table."""
    remark: Text = ""
    """Why the scenario's own value differs, for the report."""


class Common(Table):
    """The keys of every scenario. A kind of system adds `system: Literal["its name"]`, schemes and parameters."""

    title: Text
    """Shown in reports and pictures."""
    about: Text = ""
    """The question that the scenario answers, one line for `lieint list`."""
    time_unit: Text = "time unit"
    """The name of the unit of time. Choose any units of length and mass; all numbers must be in them."""
    system: str
    """The kind of system."""
    dt: float
    """Step size, in time_unit, of either sign."""
    steps: PositiveInt
    """The number of steps, a multiple of save_every."""
    save_every: PositiveInt = 1
    """Steps between saved states."""
    save_at: list[float] | None = None
    """Times of saved states, in the order of the run, instead of save_every; a shorter step ends at each."""
    members: Annotated[int, Field(gt=0, le=10**9)] = 1
    """The number of members of the ensemble; the first is the nominal state."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """The seed of the members' random deviations."""
    sources: dict[str, str] = {}
    """Full references, by the short names in `source` keys."""

    fixed: ClassVar[dict[str, str]] = {
        "dt": "all members have the same steps",
        "save_at": "all members are saved at the same times",
        "published.*": "it is a published value",
    }
    """Patterns of the paths of numbers that have no spread, with the reasons."""
    no_spread: ClassVar[str] = ""
    """Why a kind of system has no table spread, where it has none."""

    @model_validator(mode="before")
    @classmethod
    def _check_spread_table(cls, keys: Any) -> Any:
        if isinstance(keys, dict) and "spread" in keys and "spread" not in cls.model_fields:
            raise ValueError(f"spread: {cls.no_spread}")
        return keys

    @model_validator(mode="after")
    def _check_steps(self) -> Self:
        if self.dt == 0:
            raise ValueError("dt must not be 0")
        if self.steps % self.save_every:
            near = _checks.nearest_multiples(self.steps, self.save_every)
            raise ValueError(f"steps = {self.steps} must be a multiple of save_every = {self.save_every}: give {near}")
        return self

    @model_validator(mode="after")
    def _check_sources(self) -> Self:
        for key in _sources(self.model_dump()):
            if self.sources and key not in self.sources:
                raise ValueError(f"source {key!r} is not one of the keys of [sources]: {', '.join(self.sources)}")
        return self

    @model_validator(mode="after")
    def _check_number_spreads(self) -> Self:
        self.own_numbers()
        return self

    def own_numbers(self) -> dict[_spread.Path, _spread.GivenSpread]:
        """The spreads of the numbers that differ between members, by the paths of the numbers."""
        return _spread.requested_spreads(self, self.fixed)

    def spreads(self) -> dict[str, tuple[float, str]]:
        """The standard deviations of the initial states with their units, by quantity, as a kind declares them."""
        return {}

    def assumption(self) -> str:
        """The line of the report with the assumed spread of the ensemble; empty if there is none."""
        spreads = self.spreads()
        given = [
            f"{name} {x:.3g}{'' if unit[:1] == '°' else ' '}{unit}".rstrip() for name, (x, unit) in spreads.items() if x
        ]
        given += [spread.words for spread in self.own_numbers().values()]
        line = f"spread about the nominal state, an assumption (1 sigma, each component): {', '.join(given) or 'none'}"
        return line if spreads or given else ""

    def clock(self) -> dict[str, Any]:
        """The arguments of `ensemble.run` for the times of the steps."""
        return {"dt": self.dt, "num_steps": self.steps}

    def describe_steps(self) -> str:
        """The number and size of the steps, as text."""
        span = self.dt * self.steps
        return f"{self.steps} steps of {self.dt:.6g} {self.time_unit} = {span:.6g} {self.time_unit}"

    def source(self, key: str) -> str:
        """The full reference for `key`, or `key` itself."""
        return self.sources.get(key, key)


class NumberSpread(Table):
    """Standard deviations of numbers of the scenario, by their paths."""

    model_config = ConfigDict(extra="allow")


def array(values: Any) -> Any:
    """Numbers of a scenario as an array, of NumPy or, where they are traced, of JAX."""
    return np.asarray(values) if _checks.concrete(values) else jnp.asarray(values)


def radians(degrees: Any) -> Any:
    """Angles of a scenario in radians, as an array of NumPy or, where they are traced, of JAX."""
    return (np if _checks.concrete(degrees) else jnp).deg2rad(array(degrees))


class Rate(Table):
    """An angular velocity, given by one of two keys; its frame is stated where it is used."""

    angular_velocity_rad: Triple | None = None
    """In radians per time_unit."""
    angular_velocity_deg: Triple | None = None
    """In degrees per time_unit."""

    def rate(self) -> Any:
        """Radians per time_unit; None if neither key is given, ValueError if both are."""
        if self.angular_velocity_deg is None:
            return self.angular_velocity_rad
        if self.angular_velocity_rad is not None:
            raise ValueError("give angular_velocity_rad or angular_velocity_deg, not both")
        found = radians(self.angular_velocity_deg)
        return found.tolist() if isinstance(found, np.ndarray) else found


class GivenRate(Rate):
    """An angular velocity, given by exactly one of two keys."""

    @model_validator(mode="after")
    def _check_rate(self) -> Self:
        if self.rate() is None:
            raise ValueError("give exactly one of angular_velocity_rad and angular_velocity_deg")
        return self


class RateSpread(Table):
    """A standard deviation of angular velocity, given by one of two keys."""

    angular_velocity_rad: NonNegative = 0.0
    """In radians per time_unit, each component."""
    angular_velocity_deg: NonNegative = 0.0
    """In degrees per time_unit, each component."""

    @model_validator(mode="after")
    def _check_rate_keys(self) -> Self:
        if self.angular_velocity_rad and self.angular_velocity_deg:
            raise ValueError("give angular_velocity_rad or angular_velocity_deg, not both")
        return self

    def rate(self) -> float:
        """Radians per time_unit."""
        return self.angular_velocity_rad + float(np.deg2rad(self.angular_velocity_deg))

    def with_unit(self, time_unit: str) -> tuple[float, str]:
        """The standard deviation as the file gives it, with its unit."""
        if self.angular_velocity_deg:
            return self.angular_velocity_deg, f"°/{time_unit}"
        return self.angular_velocity_rad, f"rad/{time_unit}"


class AttitudeSpread(RateSpread):
    """Standard deviations of an attitude and an angular velocity."""

    attitude_deg: NonNegative = 0.0
    """Standard deviation of a rotation about each axis of space, in degrees."""


def _sources(tree: Any) -> list[str]:
    """The values of all keys `source` of a tree of tables."""
    if isinstance(tree, dict):
        here = [value for key, value in tree.items() if key == "source"]
        return here + [name for value in tree.values() for name in _sources(value)]
    return [name for value in tree for name in _sources(value)] if isinstance(tree, list) else []


def member_indices(scenario: Common, indices: np.ndarray | None) -> np.ndarray:
    """The indices of the members that `build` returns; None selects all."""
    return np.arange(scenario.members) if indices is None else indices


def deviates(scenario: Common, indices: np.ndarray | None = None) -> Array:
    """Standard normal deviates of two vectors of each member, (m, 2, 3); those of the nominal member are 0."""
    indices, key = member_indices(scenario, indices), jax.random.key(scenario.seed)
    normal = random_bits.normal_rows(key, (2, scenario.members, 3), indices, axis=1)
    return jnp.swapaxes(jnp.where((indices == 0)[:, None], 0.0, normal), 0, 1)


def check_order(scheme: str, order: Any, allowed: Sequence[Any]) -> None:
    """Raise ValueError if a scheme does not have the given order; an exact scheme has none."""
    if order is not None and order not in allowed:
        known = " or ".join(map(str, allowed)) or "none, since it is exact"
        raise ValueError(f"order of {scheme} is {known}, got {order}")


def compose_to_order(step: Step, order: int | None) -> Step:
    """A symmetric step of order 2 at a higher order, by composition."""
    return step if order in (None, 2) else schemes.compose(step, order)
