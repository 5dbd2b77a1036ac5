"""The conserved and measured quantities that a kind of scenario declares, and the report that is printed of them."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from lieint_jax.app.scenarios._keys import Published
from lieint_jax.app.scenarios._runs import standard_deviation


class _Citing(Protocol):
    """A scenario: it has the full references of its published values."""

    def source(self, key: str, /) -> str: ...


ROUND_OFF = "conserved to round-off"
CLOSED_FORM = (
    "  closed form: elliptic integrals; the difference is the scheme's error, of its order in dt, or round-off"
)
_MAX_MISFIT = 3  # published errors; a larger difference is noted
_WIDTH = 34  # smallest width of the column of names


def largest_component(x: np.ndarray) -> np.ndarray:
    """The largest absolute component of values (times, members, …)."""
    return abs(x).reshape(*x.shape[:2], -1).max(axis=2)


@dataclass(frozen=True)
class Conserved:
    """A quantity that an exact motion conserves.

    Attributes:
        name: its name in the report, with the quantity to which its change is relative.
        values: its values at all saved times of all members, (times, members, …).
        size: the size to which its change is relative; broadcasts with (times, members).
        promise: the statement of the report on how well the scheme conserves it.
        initial: the value from which it changes; by default that at the first saved time.
        norm: the norm of the change of a vector.
    """

    name: str
    values: np.ndarray
    size: Any = 1.0
    promise: str = ""
    initial: Any = None
    norm: Callable[[np.ndarray], np.ndarray] = largest_component

    def join_members(self, members: Sequence[Conserved]) -> Conserved:
        """The quantity of all members, from those of each, under the name of this one."""
        shape = self.values.shape
        values = np.concatenate([x.values for x in members], axis=1)
        size = np.concatenate([np.broadcast_to(x.size, shape[:2]) for x in members], axis=1)
        return replace(self, values=values, size=size)

    def change(self) -> np.ndarray:
        """The relative change, (times, members)."""
        return self.norm(self.values - (self.values[0] if self.initial is None else self.initial)) / self.size


@dataclass(frozen=True)
class Quantity:
    """A measured quantity of every member.

    Attributes:
        name: its name in the report, with its unit.
        values: its values for the members, the nominal one first, (members,); nan for none.
        digits: the format of its numbers; with a closed form they have ten digits.
        closed_form: its exact value for the nominal member; nan where none is known.
        published: its published values.
        angle: whether it is an angle in degrees: the spread is then that of differences below 180°.
    """

    name: str
    values: np.ndarray
    digits: str = ".4f"
    closed_form: float | None = None
    published: Published | Sequence[Published] | None = None
    angle: bool = False

    def join_members(self, members: Sequence[Quantity]) -> Quantity:
        """The quantity of all members, from those of each, with the closed form and published values of this one."""
        return replace(self, values=np.concatenate([x.values for x in members]))

    @property
    def nominal(self) -> float:
        """Its value for the nominal member."""
        return float(self.values[0])

    @property
    def spread(self) -> float:
        """Its standard deviation over the members; nan if one of them has no value."""
        x = (self.values - self.values[0] + 180) % 360 - 180 if self.angle else self.values
        return float(standard_deviation(x)) if np.isfinite(x).all() else np.nan

    @property
    def citations(self) -> list[Published]:
        """The published values, as a list."""
        if self.published is None:
            return []
        return [self.published] if isinstance(self.published, Published) else list(self.published)


def join_members(members: Sequence[Sequence[Any]]) -> list[Any]:
    """The conserved or measured quantities that all members have, from those of each member."""
    by_name = [{x.name: x for x in found} for found in members]
    common = [name for name in by_name[0] if all(name in found for found in by_name)]
    return [by_name[0][name].join_members([found[name] for found in by_name]) for name in common]


def text(
    scenario: _Citing, conserved: Sequence[Conserved], quantities: Sequence[Quantity], remarks: Sequence[str] = ()
) -> str:
    """The report of a run: what is conserved, what was measured, why it does not test its published values, remarks."""
    width = max([_WIDTH, *(len(x.name) + 2 for x in (*conserved, *quantities))])
    lines = [*change_lines(conserved, width), *table_lines(scenario, quantities, width)]
    for x in quantities:
        for misfit in filter(None, (_misfit(x, published) for published in x.citations)):
            lines += textwrap.wrap(f"{x.name}: {misfit}", 116, initial_indent="  ! ", subsequent_indent="    ")
    return "\n".join(line.rstrip() for line in (*lines, *remarks))


def change_lines(conserved: Sequence[Conserved], width: int = _WIDTH) -> list[str]:
    """The lines of a report with the largest change of each conserved quantity, and what the scheme promises."""
    if not conserved:
        return []
    promised = "   the scheme promises" if any(x.promise for x in conserved) else ""
    lines = [f"\n  {'largest change, all members and saved times':<{width + 10}}{promised}"]
    return lines + [f"  {x.name:<{width}}{float(x.change().max()):>10.1e}   {x.promise}" for x in conserved]


def table_lines(scenario: _Citing, quantities: Sequence[Quantity], width: int = _WIDTH, head: str = "") -> list[str]:
    """The lines of a report with the measured quantities next to their closed forms and published values."""
    if not quantities:
        return []
    ten_digits = any(x.closed_form is not None for x in quantities)
    exact = any(x.closed_form is not None and np.isfinite(x.closed_form) for x in quantities)
    heads = f"{'nominal':>{17 if ten_digits else 11}}{'± ensemble':>12}"
    heads += f"{'closed form':>17}{'difference':>12}" if exact else ""
    lines = [f"\n  {head:<{width}}{heads}" + ("   published" if any(x.citations for x in quantities) else "")]
    for x in quantities:
        row = f"  {x.name:<{width}}" + _columns(x, exact, 17 if ten_digits else 11)
        known, *others = [citation(scenario, published) for published in x.citations] or [""]
        lines.append(f"{row}   {known}")
        lines += [f"{'':<{len(row)}}   {other}" for other in others]
    return lines


def _columns(x: Quantity, exact: bool, width: int) -> str:
    """The numbers of a row of the table: nominal value, spread, and with `exact` closed form and difference."""
    digits, fewer = (x.digits, x.digits) if x.closed_form is None else (".10f", ".5f")
    spread = "—" if len(x.values) == 1 else _number(x.spread, fewer)
    columns = f"{_number(x.nominal, digits):>{width}}{spread:>12}"
    if exact:
        closed = np.nan if x.closed_form is None else x.closed_form
        columns += f"{_number(closed, digits):>17}{_number(x.nominal - closed, '.1e'):>12}"
    return columns


def _number(x: float, digits: str) -> str:
    return format(x, digits) if np.isfinite(x) else "—"


def citation(scenario: _Citing, published: Published) -> str:
    """A published value with its error and source."""
    error = f" ± {published.error:g}" if published.error is not None else ""
    return f"{published.value:g}{error}  ({scenario.source(published.source)})"


def _misfit(x: Quantity, published: Published) -> str:
    """Why a quantity does not test a published value; empty if it does."""
    if published.error is None or not np.isfinite(x.nominal):
        return ""
    found, difference = [], x.nominal - published.value
    if abs(difference) > _MAX_MISFIT * published.error:
        sign = ", and in its sign" if x.nominal * published.value < 0 else ""
        by = f"{difference:+.3g}, {abs(difference) / published.error:.2g} times the published error"
        found.append(f"The nominal member differs from the published value by {by}{sign}.")
    if x.spread > published.error:
        low, middle, high = np.percentile(x.values, (16, 50, 84))
        ratio = f"{x.spread / published.error:.2g}"
        size = "as large as" if ratio == "1" else f"{ratio} times"
        found.append(
            f"The members' spread is {size} the published error and follows from their "
            f"assumed deviations: the median is {middle:.4f}, and 68 % of them lie from {low:.4f} to {high:.4f}."
        )
    return " ".join([*found, published.remark] if found else [])


def paragraphs(notes: list[str]) -> list[str]:
    """Notes as lines of a report, with an empty line before each."""
    wrapped = (textwrap.wrap(note, 118, initial_indent="  ", subsequent_indent="  ") for note in notes)
    return [line for lines in wrapped for line in ("", *lines)]
