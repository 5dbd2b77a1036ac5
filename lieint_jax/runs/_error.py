"""The error of a run, from runs with half and a quarter of its step from the same states."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lieint_jax.core import State
from lieint_jax.core.record import record

_UNITS = {"attitude": "rad", "position": "in the unit of length", "q": "", "p": "of the largest momentum"}
_TURNED = 2.0  # rad: an error of a phase that has exceeded it may be larger by full turns


@record
class RunError(NamedTuple):
    """How far a run is from the exact motion, by Richardson's estimate: its difference from a finer run ÷ (1 − 2⁻ᵖ).

    Attributes:
        t: the times of the saves, (times,).
        members: the numbers of the members that were integrated again, (m,); None for one body.
        attitude: the angle between attitudes, rad, (times, [m,] [bodies,]); None without attitudes.
        position: the distance of positions, in their unit, (times, [m,] bodies); None without positions.
        q: the norm of the difference of other configurations, (times, [m]); None with attitudes.
        p: the norm of the difference of momenta over the largest norm of a momentum, (times, [m]).
        reliable: whether the largest difference until then decreased with the step as the order says, and is below
            2 rad, (times, [m]). Where it did not, the motion is chaotic, a torque jumps, or the step is too large, and
            the error is at least of the size that is shown.
        order: the order p of the step.
    """

    t: np.ndarray
    members: np.ndarray | None
    attitude: np.ndarray | None
    position: np.ndarray | None
    q: np.ndarray | None
    p: np.ndarray
    reliable: np.ndarray
    order: float

    @property
    def summary(self) -> str:
        """The largest error of the run in one line, which states from when on it may be larger."""
        found = {name: x for name in ("attitude", "position", "q") if (x := self._largest(name)) is not None}
        sizes = [f"{name} up to {_digits(x)}" for name, x in (found or {"momentum": self.p.max(initial=0)}).items()]
        if "attitude" in found:
            sizes[0] += f" rad ({_digits(np.rad2deg(found['attitude']))}°)"
        sizes[-1] += " off" if found else " of its largest off"
        last = self._last_reliable
        if last is None:
            return f"{', '.join(sizes)} until t = {self.t[-1]:.6g}, by a run with dt/2"
        return (
            f"{', '.join(sizes)} or more: from t = {self.t[last]:.6g} on a smaller dt does not reduce it as order "
            f"{self.order:g} says (chaos, dt too large, or a torque that jumps)"
        )

    def __repr__(self) -> str:
        who = "" if self.members is None else f", the worst of {len(self.members)} members"
        lines = [f"error at t = {self.t[-1]:.6g}, by half and a quarter of the step{who}"]
        for name, unit in _UNITS.items():
            value = getattr(self, name)
            if value is not None:
                lines.append(f"  {name:<10}{value[-1].max():>10.2g} {unit}".rstrip())
        last = self._last_reliable
        if last is not None:
            lines.append(
                f"  reliable until t = {self.t[last]:.6g}: later a smaller step does not reduce the difference as "
                f"order {self.order:g} says, so the motion is chaotic, a torque jumps, or the step is too large"
            )
        return "\n".join(lines)

    def _largest(self, name: str) -> float | None:
        """The largest of the errors of that name; None if there are none."""
        value = getattr(self, name)
        return None if value is None or not value.size else float(value.max())

    @property
    def _last_reliable(self) -> int | None:
        """The number of the last save until which all members are reliable; None if all saves are."""
        good = self.reliable.reshape(len(self.t), -1).all(axis=1)
        return None if good.all() else max(int(good.argmin()) - 1, 0)


def estimate(
    t: np.ndarray,
    members: np.ndarray | None,
    order: float,
    coarse: State,
    half: State,
    quarter: State,
    steps: int | None = None,
) -> RunError:
    """The error of the coarsest of three runs of the same saves.

    Args:
        t, members: as in `RunError`.
        order: of the step.
        coarse, half, quarter: the states of the runs with dt, dt/2 and dt/4, (times, [m,] …).
        steps: the number of steps of the coarse run; by default that of the saves.
    """
    axes = 1 if members is None else 2
    first, second = _differences(coarse, half, axes), _differences(half, quarter, axes)
    factor = 1 - 2.0**-order
    size = np.linalg.norm(np.reshape(coarse.p, (*np.shape(coarse.p)[:axes], -1)), axis=-1).max(initial=0)
    first["p"], second["p"] = (x["p"] / (size or 1.0) for x in (first, second))
    floor = _rounding(np.asarray(coarse.p).dtype, len(t) if steps is None else steps)
    sizes = {
        "position": abs(np.asarray(coarse.q)[..., :3]).max(initial=0),
        "q": abs(np.asarray(coarse.q)).max(initial=0),
    }
    reliable = np.ones(np.shape(coarse.p)[:axes], bool)
    for name, difference in first.items():
        # The largest until then: an error that oscillates is 0 from time to time, at other moments in each run.
        a, b = (np.maximum.accumulate(x, axis=0) for x in (difference, second[name]))
        ok = (a >= 2.0 ** (min(order, 60.0) - 1) * b) | (a < floor * sizes.get(name, 1.0))
        ok &= (a < _TURNED) if name == "attitude" else True
        reliable &= ok.reshape(*reliable.shape, -1).all(axis=-1)
    values = {name: x / factor for name, x in first.items()}
    if "attitude" in values:
        values["attitude"] = np.minimum(values["attitude"], np.pi)
    attitude, position, q = (values.get(name) for name in ("attitude", "position", "q"))
    return RunError(t, members, attitude, position, q, values["p"], reliable, order)


def _digits(x: float) -> str:
    """A number with two significant digits, in full where it is not far from 1."""
    return f"{float(f'{x:.2g}'):g}"


def _rounding(dtype: np.dtype, steps: int) -> float:
    """Relative differences below it may be of rounding, whose errors of phase grow as steps^1.5."""
    eps = float(np.finfo(dtype).eps)
    return max(eps ** (4 / 7), 10 * eps * steps**1.5)  # 1e-9 in float64


def _differences(a: State, b: State, axes: int) -> dict[str, np.ndarray]:
    """The distances between states by the names of `RunError`."""
    (qa, pa), (qb, pb) = ((np.asarray(x.q), np.asarray(x.p)) for x in (a, b))

    def norm(x: np.ndarray) -> np.ndarray:
        return np.linalg.norm(x.reshape(*x.shape[:axes], -1), axis=-1)

    found = {"p": norm(pa - pb)}
    if qa.shape[axes:] == (4,) or qa.shape[axes + 1 :] == (7,):
        chord = np.minimum(*(np.linalg.norm(qa[..., -4:] - sign * qb[..., -4:], axis=-1) for sign in (1, -1)))
        found["attitude"] = 4 * np.arcsin(np.minimum(chord / 2, 1.0))
        if qa.shape[-1] == 7:
            found["position"] = np.linalg.norm(qa[..., :3] - qb[..., :3], axis=-1)
    else:
        found["q"] = norm(qa - qb)
    return found
