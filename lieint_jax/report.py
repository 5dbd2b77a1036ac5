"""The report of a run as text: its size, what it conserved, and what was measured next to published values.

run = li.run(step, states, dt, num_steps)  # member 0 is the nominal one
rows = [li.report.Row("rotation period (d)", run.periods().rotation, li.report.Published(5.38, 0.03, "Zhao 2015"))]
print(li.report.text("4179 Toutatis", run, rows, time_unit="d"))
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lieint_jax import schemes
from lieint_jax.core import State, Step, energy_less_work
from lieint_jax.diagnostics import Certificate, certify
from lieint_jax.runs import Run
from lieint_jax.systems import AbstractManyBodies

__all__ = ["Change", "Published", "Row", "certificate", "changes", "new_path", "text"]
__dir__ = __all__.copy

_WIDTH = 34  # smallest width of the column of names
_MAX_MISFIT = 3  # published errors; a larger difference is noted
_ROUNDING = 64  # eps: an energy below this part of the kinetic energy is 0
_CERTIFIED = 10_000  # the largest number of steps of a certificate
_ROUND_OFF = "conserved to round-off"


class Published(NamedTuple):
    """A value from the literature.

    Attributes:
        value: the value, in the unit of its row.
        error: its published standard error; None if there is none.
        source: where it was published.
        remark: printed if the run differs from it, or scatters more than its error.
    """

    value: float
    error: float | None = None
    source: str = ""
    remark: str = ""


class Row(NamedTuple):
    """A measured quantity of every member: a row of the table.

    Attributes:
        name: its name, with its unit.
        values: the values of the members, the nominal one first, (members,) or (); NaN for none.
        published: published values, to which the nominal value is compared.
        closed_form: its exact value for the nominal member; NaN where none is known.
        digits: the format of its numbers; rows of a table with closed forms have ten digits.
        angle: whether it is an angle in degrees: differences of members are then below 180°.
    """

    name: str
    values: Any
    published: Published | Sequence[Published] = ()
    closed_form: Any = None
    digits: str = ".4f"
    angle: bool = False

    @property
    def nominal(self) -> float:
        """The value of the nominal member."""
        return float(np.ravel(self.values)[0])

    @property
    def spread(self) -> float:
        """The standard deviation of the members; NaN if one of them has no value, or there is only one."""
        x = np.ravel(self.values)
        x = (x - x[0] + 180) % 360 - 180 if self.angle else x
        return float(np.std(x, ddof=1)) if len(x) > 1 and np.isfinite(x).all() else np.nan

    @property
    def citations(self) -> Sequence[Published]:
        """The published values as a sequence."""
        return (self.published,) if isinstance(self.published, Published) else self.published


class Change(NamedTuple):
    """A quantity that the exact motion conserves.

    Attributes:
        name: its name, with the quantity to which its change is relative.
        values: its values at all saved times, (times, members, …) or (times, …) of one body.
        size: the size to which its change is relative, which broadcasts with the values.
        promise: how well the scheme conserves it, as it declares.
    """

    name: str
    values: Any
    size: Any = 1.0
    promise: str = ""

    def largest(self) -> float:
        """The largest component of the relative change, over all members and saved times."""
        values = np.asarray(self.values)
        return float((abs(values - values[0]) / self.size).max())


def changes(run: Run) -> list[Change]:
    """The energy of a run, less the work that its states count, and its momenta.

    Energy is relative to its greatest absolute value, or to the greatest kinetic energy where it is 0 to round-off.
    Momentum is relative to its initial length. The linear and the angular momentum of several bodies are two rows,
    relative to the largest momentum p and angular momentum x × p + π of a body. All sizes are of the same member.
    """
    # A composition has the name of its step in parentheses; what stands in brackets, such as a drift, promises nothing.
    scheme = run.step.name.rpartition("(")[2].partition("[")[0]
    declared = next((x.conserves for x in schemes.catalogue() if x.name == scheme), ())
    conditions = {what: condition for what, _, condition in (x.partition(" (") for x in declared)}

    def promise(name: str) -> str:
        if name in conditions:
            return f"{_ROUND_OFF} ({conditions[name]}" if conditions[name] else _ROUND_OFF
        return "bounded, not conserved" if "form" in conditions else ""

    found = []
    if run.system.hamiltonian:
        H, K = map(np.asarray, run.map(_energies))
        greatest, kinetic = abs(H).max(axis=0), abs(K).max(axis=0)
        size = np.where(greatest <= _ROUNDING * np.finfo(H.dtype).eps * kinetic, kinetic, greatest)
        name = "energy" if run.state.work is None else "energy less work"
        found.append(Change(f"{name}, relative", H, np.where(size > 0, size, 1.0), promise(name)))
    Phi = np.asarray(run.map(_momentum))
    if isinstance(run.system, AbstractManyBodies) and Phi.shape[-1] == 6:
        of_bodies = (np.linalg.norm(x, axis=-1).max(axis=(0, -1)) for x in map(np.asarray, run.map(_momenta_of_bodies)))
        for kind, values, size in zip(("linear", "angular"), np.split(Phi, 2, axis=-1), of_bodies, strict=True):
            size = np.where(size > 0, size, 1.0)[..., None]
            found.append(Change(f"{kind} momentum, over the largest of a body", values, size, promise("momentum")))
    elif Phi.shape[-1]:
        size = np.linalg.norm(Phi[0], axis=-1, keepdims=True)
        found.append(Change("momentum, relative", Phi, np.where(size > 0, size, 1.0), promise("momentum")))
    return found


def text(
    title: str,
    run: Run,
    rows: Sequence[Row] = (),
    *,
    changed: Sequence[Change] = (),
    remarks: Sequence[str] = (),
    spread: str = "",
    time_unit: str = "",
    error: int = 0,
) -> str:
    """The report of a run: its size, what it conserved, what was measured, remarks, and whether its steps converged.

    The table has the value of the nominal member, and under "± std" the standard deviation of all members.
    Where a published value has an error, a line marked "!" says that the nominal member differs by more than three
    errors, or that the members scatter by more than one.

    Args:
        title: its first line.
        run: the run.
        rows: the measured quantities.
        changed: the conserved quantities, such as `changes(run)`.
        remarks: further lines, after the table.
        spread: the deviations of the members from the nominal state, in words, such as "attitude 0.3°".
        time_unit: the unit of time, such as "d"; by default that of the store.
        error: of how many members to measure how far they are off, by `run.error`: 1 for the nominal one. A report that
            is followed by a certificate does not need it.
    """
    unit = time_unit or run.facts.time_unit
    lines = [title, f"  {_size(run, '' if unit == '1' else unit)}, {run.step.name}"]
    if spread and (run.members or 1) > 1:
        lines.append(f"  spread about the nominal state, an assumption (1 sigma): {spread}")
    if run.facts.source:
        lines.append(f"  results in {run.facts.source}")
    if error:
        who = (
            "nominal member"
            if min(error, run.members or 1) == 1
            else f"worst of {min(error, run.members or 1)} members"
        )
        lines += textwrap.wrap(f"{who}: {run.error(error).summary}", 116, initial_indent="  ", subsequent_indent="    ")
    width = max([_WIDTH, *(len(x.name) + 2 for x in (*changed, *rows))])
    lines += [*_change_lines(changed, width), *_table(rows, width)]
    for row in rows:
        for misfit in filter(None, (_misfit(row, published) for published in row.citations)):
            lines += textwrap.wrap(f"{row.name}: {misfit}", 116, initial_indent="  ! ", subsequent_indent="    ")
    converged = np.atleast_1d(np.asarray(run.converged))
    lines += [*remarks, f"  {converged.sum()} of {converged.size} members converged at every step"]
    return "\n".join(line.rstrip() for line in lines)


def certificate(run: Run) -> str:
    """How wrong the nominal member of a run is, and what its step conserves along it in its first 10 000 steps.

    Raises:
        ValueError: the run has given times instead of a step size.
    """
    if run.dt is None:
        raise ValueError("a certificate needs the step size of a run; this one has given times")
    one = run if run.members is None else run.member(0)
    state = jax.tree.map(lambda x: x[0], one.state)
    steps = min(run.facts.num_steps, _CERTIFIED)
    found = certify(one.step, state, run.dt, steps)
    if steps < run.facts.num_steps and isinstance(found, Certificate):
        found = found._replace(error=run.error(1))  # until the end of the run
    return f"Certificate of the nominal member, first {steps} of {run.facts.num_steps} steps:\n{found}"


def new_path(name: str | Path, resume: bool = False) -> Path:
    """A path that does not exist: `name`, or the first of NAME-2, NAME-3, … before its suffix, that is free.

    Pictures next to it, NAME-*.png, count as well, so that those of an earlier run are not replaced.

    Args:
        name: the wanted path.
        resume: return the last of these paths that exists, whose run is to be continued; `name` if none does.
    """
    path, last, k = Path(name), Path(name), 1
    while path.exists() or any(path.parent.glob(f"{path.stem}-[a-z]*.png")):
        last, k = path, k + 1
        path = Path(name).with_stem(f"{Path(name).stem}-{k}")
    return last if resume else path


def _energies(step: Step, state: State) -> Any:
    """The energy less the work, and the kinetic energy."""
    energy = step.system.energy
    return energy_less_work(step.system, state), energy(state) - energy(state._replace(p=jnp.zeros_like(state.p)))


def _momentum(step: Step, state: State) -> Any:
    return step.system.momentum(state)


def _momenta_of_bodies(_: Step, state: State) -> tuple[Any, Any]:
    """The linear momenta p of bodies and their angular momenta x × p + π about the origin, (bodies, 3) each."""
    x, p = state.q[:, :3], state.p[:, :3]
    return p, jnp.cross(x, p) + state.p[:, 3:]


def _size(run: Run, unit: str) -> str:
    """The number of members and steps, and the size of steps."""
    dt, steps = run.dt, run.facts.num_steps
    if dt is None:
        return f"{run.members or 1} member(s), {steps} steps between given times"
    sizes = (f"{x:.6g} {unit}".rstrip() for x in (dt, dt * steps))
    return f"{run.members or 1} member(s), {steps} steps of {' = '.join(sizes)}"


def _change_lines(changed: Sequence[Change], width: int) -> list[str]:
    if not changed:
        return []
    promised = "   the scheme promises" if any(x.promise for x in changed) else ""
    head = f"\n  {'largest change, all members and saved times':<{width + 10}}{promised}"
    return [head, *(f"  {x.name:<{width}}{x.largest():>10.1e}   {x.promise}" for x in changed)]


def _table(rows: Sequence[Row], width: int) -> list[str]:
    """The lines of measured quantities next to their closed forms and published values."""
    if not rows:
        return []
    ten_digits = any(x.closed_form is not None for x in rows)
    exact = any(x.closed_form is not None and np.isfinite(x.closed_form) for x in rows)
    column = 17 if ten_digits else 11
    heads = f"{'nominal':>{column}}{'± std':>12}" + (f"{'closed form':>17}{'difference':>12}" if exact else "")
    lines = [f"\n  {'':<{width}}{heads}" + ("   published" if any(x.citations for x in rows) else "")]
    for x in rows:
        digits, fewer = (x.digits, x.digits) if x.closed_form is None else (".10f", ".5f")
        row = f"  {x.name:<{width}}{_number(x.nominal, digits):>{column}}{_number(x.spread, fewer):>12}"
        if exact:
            closed = np.nan if x.closed_form is None else x.closed_form
            row += f"{_number(closed, digits):>17}{_number(x.nominal - closed, '.1e'):>12}"
        first, *others = [_citation(published) for published in x.citations] or [""]
        lines.append(f"{row}   {first}")
        lines += [f"{'':<{len(row)}}   {other}" for other in others]
    return lines


def _number(x: float, digits: str) -> str:
    return format(x, digits) if np.isfinite(x) else "—"


def _citation(published: Published) -> str:
    """A published value with its error and source."""
    error = "" if published.error is None else f" ± {published.error:.10g}"
    return f"{published.value:.10g}{error}" + (f"  ({published.source})" if published.source else "")


def _misfit(row: Row, published: Published) -> str:
    """Why a row does not test a published value; empty if it does."""
    if published.error is None or not np.isfinite(row.nominal):
        return ""
    found, difference = [], row.nominal - published.value
    if abs(difference) > _MAX_MISFIT * published.error:
        sign = ", and in its sign" if row.nominal * published.value < 0 else ""
        by = f"{difference:+.3g}, {abs(difference) / published.error:.2g} times the published error"
        found.append(f"The nominal member differs from the published value by {by}{sign}.")
    if row.spread > published.error:
        low, middle, high = np.percentile(np.ravel(row.values), (16, 50, 84))
        ratio = f"{row.spread / published.error:.2g}"
        size = "as large as" if ratio == "1" else f"{ratio} times"
        found.append(
            f"The members' spread is {size} the published error and follows from their assumed deviations: the median "
            f"is {middle:.4f}, and 68 % of them lie from {low:.4f} to {high:.4f}."
        )
    return " ".join([*found, published.remark] if found else [])
