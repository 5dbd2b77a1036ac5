"""The keys of which scenarios are made: numbers with their limits, tables, and standard deviations of members."""

from __future__ import annotations

import datetime
import inspect
from collections.abc import Callable, Mapping
from types import FunctionType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from lieint_jax import _checks, dates

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


def _date_text(value: Any) -> Any:
    """A date with its scale; TOML has dates without quotes."""
    if isinstance(value, datetime.date) and not isinstance(value, datetime.datetime):
        value = value.isoformat()
    return dates.text_of(value) if isinstance(value, str | datetime.datetime) else value


def _unit_quaternion(value: list[float]) -> list[float]:
    """The quaternion, normalized if it has few digits."""
    return _checks.nearly_unit("quaternion", np.array(value)).tolist()


PositiveFloat = Annotated[float, Field(gt=0)]
Triple = Annotated[list[float], Field(min_length=3, max_length=3)]
Pair = Annotated[list[PositiveFloat], Field(min_length=2, max_length=2)]
PositiveTriple = Annotated[list[PositiveFloat], Field(min_length=3, max_length=3)]
Direction = Annotated[Triple, checked(_check_not_zero)]
UnitVector = Annotated[Triple, checked(_check_unit)]
Moments = Annotated[Triple, checked(_checks.inertia)]
Quaternion = Annotated[list[float], Field(min_length=4, max_length=4), AfterValidator(_unit_quaternion)]
NonNegative = Annotated[float, Field(ge=0)]
PositiveInt = Annotated[int, Field(gt=0, le=10**12)]
Date = Annotated[str, BeforeValidator(_date_text)]
Order = Annotated[Literal[2, 4, 6, 8], Field(description="The order of accuracy; above 2 by composition.")]
Source = Annotated[str, Field(description="A key of the table sources.")]
Text = Annotated[str, Field(pattern=r"^[^$]*$")]  # without $, which matplotlib reads as mathematics


class Table(BaseModel):
    """A table of keys, strictly validated: no unknown keys, no text for a number, no nan.

    The text below a key is its description in the JSON schema, with its unit. The unit of an angle is in its key. The
    methods `_check_NAME` raise ValueError for keys that do not fit together; those of general tables are called first.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True)
    files: ClassVar[Mapping[str, type[Table]]] = {}
    """Keys that may be {file = "…"} instead, with the keys of that table: see `_files`."""

    @model_validator(mode="after")
    def _run_checks(self) -> Self:
        for check in methods(type(self), "_check_"):
            check(self)
        return self

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> Any:
        made = handler(core_schema)
        keys = handler.resolve_ref_schema(made).get("properties", {})
        for key, model in cls.files.items():
            table = handler(model.__pydantic_core_schema__)
            keys[key] = {"anyOf": [keys[key], table]} if key in keys else table
        return made


def methods(table: type[Table], prefix: str = "") -> list[FunctionType]:
    """The methods of a table and of those that it extends, with a prefix, in the order of their definition."""
    names = dict.fromkeys(name for base in reversed(table.__mro__) if issubclass(base, Table) for name in vars(base))
    found = (inspect.getattr_static(table, name) for name in names if name.startswith(prefix))
    return [f for f in found if isinstance(f, FunctionType)]


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

    def _check_rate(self) -> None:
        if self.rate() is None:
            raise ValueError("give exactly one of angular_velocity_rad and angular_velocity_deg")


class Stated(NamedTuple):
    """How the report names a standard deviation; the annotation of a key of `[spread]`."""

    name: str  # the quantity
    unit: str = ""  # its unit, unless the key's name ends in it


_UNITS = {"_rad": "rad", "_deg": "°", "_mm_s": "mm/s", "_m_s": "m/s", "_m": "m", "_percent": "%"}
_RATE = "angular_velocity"


class Spread(Table):
    """Standard deviations of the members about the nominal one."""

    def stated(self, time_unit: str, of: str = "") -> dict[str, tuple[float, str]]:
        """Those of the state, with their units, by the names of quantities, each after `of`."""
        found: dict[str, tuple[float, str]] = {}
        values = dict(self)
        for key, field in type(self).model_fields.items():
            suffix = next((end for end in _UNITS if key.endswith(end)), "")
            unit = _UNITS.get(suffix, "") + (f"/{time_unit}" if key.startswith(_RATE) else "")
            plain = Stated(key.removesuffix(suffix).replace("_", " "), unit)
            name, unit = next((mark for mark in field.metadata if isinstance(mark, Stated)), plain)
            if values[key] or f"{of}{name}" not in found:
                found[f"{of}{name}"] = values[key], unit
        return found


class NumberSpread(Spread):
    """Standard deviations of numbers of the scenario, by their paths."""

    model_config = ConfigDict(extra="allow")


class AttitudeSpread(Spread):
    """A standard deviation of an attitude."""

    attitude_deg: NonNegative = 0.0
    """Standard deviation of a rotation about each axis of space, in degrees."""


class RateSpread(Spread):
    """A standard deviation of angular velocity, given by one of two keys."""

    angular_velocity_rad: NonNegative = 0.0
    """In radians per time_unit, each component."""
    angular_velocity_deg: NonNegative = 0.0
    """In degrees per time_unit, each component."""

    def _check_rate_keys(self) -> None:
        if self.angular_velocity_rad and self.angular_velocity_deg:
            raise ValueError("give angular_velocity_rad or angular_velocity_deg, not both")

    def rate(self) -> float:
        """Radians per time_unit."""
        return self.angular_velocity_rad + float(np.deg2rad(self.angular_velocity_deg))


class RotationSpread(RateSpread, AttitudeSpread, NumberSpread):
    """Standard deviations of the members about the nominal state, and of numbers of the scenario by their paths."""
