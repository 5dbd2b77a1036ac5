"""The error of a run, from runs with half and a quarter of its step from the same states."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lieint_jax.types import State
from lieint_jax.types.record import record

_FLOOR = 1e-9  # differences below it may be of rounding, and say no more about the order


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
        reliable: whether the difference decreased with the step as the order says, (times, [m]). Where it did not, the
            motion is chaotic or the step too large, and the error is at least of the size that is shown.
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

    def __repr__(self) -> str:
        who = "" if self.members is None else f", the worst of {len(self.members)} members"
        lines = [f"error at t = {self.t[-1]:.6g}, by half and a quarter of the step{who}"]
        units = {"attitude": "rad", "position": "in the unit of length", "q": "", "p": "of the largest momentum"}
        for name, unit in units.items():
            value = getattr(self, name)
            if value is not None:
                lines.append(f"  {name:<10}{value[-1].max():>10.2g} {unit}".rstrip())
        good = self.reliable.reshape(len(self.t), -1).all(axis=1)
        if not good.all():
            last = self.t[max(int(good.argmin()) - 1, 0)]
            lines.append(
                f"  reliable until t = {last:.6g}: later a smaller step does not reduce the difference as order "
                f"{self.order:g} says, so the motion is chaotic or the step too large"
            )
        return "\n".join(lines)


def estimate(
    t: np.ndarray, members: np.ndarray | None, order: float, coarse: State, half: State, quarter: State
) -> RunError:
    """The error of the coarsest of three runs of the same saves.

    Args:
        t, members: as in `RunError`.
        order: of the step.
        coarse, half, quarter: the states of the runs with dt, dt/2 and dt/4, (times, [m,] …).
    """
    axes = 1 if members is None else 2
    first, second = _differences(coarse, half, axes), _differences(half, quarter, axes)
    factor = 1 - 2.0**-order
    size = np.linalg.norm(np.reshape(coarse.p, (*np.shape(coarse.p)[:axes], -1)), axis=-1).max()
    first["p"], second["p"] = (x["p"] / (size or 1.0) for x in (first, second))
    reliable = np.ones(np.shape(coarse.p)[:axes], bool)
    for name, difference in first.items():
        ok = (difference >= 2.0 ** (order - 1) * second[name]) | (difference < _FLOOR)
        reliable &= ok.reshape(*reliable.shape, -1).all(axis=-1)
    values = {name: x / factor for name, x in first.items()}
    attitude, position, q = (values.get(name) for name in ("attitude", "position", "q"))
    return RunError(t, members, attitude, position, q, values["p"], reliable, order)


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
