"""An orbit given by a table, such as an ephemeris."""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete, plain
from lieint_jax._numerics.arrays import Calls
from lieint_jax._numerics.lookup import increasing_times, interval
from lieint_jax.core import pytree

__all__ = ["Table", "VectorTable", "table", "vector_table"]

# disagreements that are a warning and an error; of 6 entries a revolution it is below 1e-3
_MODEST, _FACTOR = 0.02, 0.7


@pytree
class Table:
    """An orbit through the entries of a table: `orbit(t)` is the position and the velocity. Made by `table`.

    Attributes:
        times: the times of the entries, increasing, (n,).
        entries: position and velocity at each of these times, one after the other, (6n,): machine code reads long
            tables this way.
    """

    times: Array
    entries: Array

    @property
    def positions(self) -> Array:
        """The positions, (n, 3)."""
        return self.entries.reshape(-1, 6)[:, :3]

    @property
    def velocities(self) -> Array:
        """The velocities, (n, 3)."""
        return self.entries.reshape(-1, 6)[:, 3:]

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Position (3,) and velocity (3,) at time t. Outside the table: ValueError if t is concrete, otherwise NaN."""
        k, since, h = interval(self.times, t)
        ra, va, rb, vb = lax.dynamic_slice(self.entries, (6 * k,), (12,)).reshape(4, 3)
        s = since / h
        step, ends = rb - ra, h * (va + vb) - 2 * (rb - ra)  # r = ra + h va s + (step − h va − ends) s² + ends s³
        bend = step - h * va - ends
        return ra + s * (h * va + s * (bend + s * ends)), va + s * (2 * bend + 3 * s * ends) / h

    def check_velocities(self, name: str = "", refuse: bool = True) -> None:
        """Warn of velocities that are not those of the positions; ValueError if they disagree by a factor.

        Between two entries the positions move by Δ, the trapezoidal rule of the velocities gives D. Of all pairs the
        median of (|Δ − D| − E)/max(|Δ|, |D|) must be at most 0.02. E is twice the error of this rule, from second
        differences of the velocities, and 1e-6 of the distance from the center for round-off.

        Args:
            name: what messages begin with.
            refuse: whether a factor is an error, too, and not a warning.

        Raises:
            ValueError: a disagreement above 0.7.
        """
        t, r, v = (np.asarray(x, float) for x in (self.times, self.positions, self.velocities))
        h, moved, swept = np.diff(t), np.diff(r, axis=0), np.diff(t)[:, None] * (v[1:] + v[:-1]) / 2
        slopes = np.diff(v, axis=0) / h[:, None]
        if len(t) > 3:
            curved = np.linalg.norm(np.diff(slopes, axis=0), axis=1) * 2 / (h[1:] + h[:-1])
            curved = np.maximum(np.append(curved[:1], curved), np.append(curved, curved[-1:]))
        else:  # too few for second differences: within a sixth of a revolution v'' is less than 3 |Δv|/h²
            curved = 3 * np.linalg.norm(slopes, axis=1) / h
        lengths, given = np.linalg.norm(moved, axis=1), np.linalg.norm(swept, axis=1)
        excess = np.linalg.norm(moved - swept, axis=1) - h**3 * curved / 6 - 1e-6 * np.linalg.norm(r[1:], axis=1)
        parts = np.maximum(excess, 0) / np.maximum(np.maximum(lengths, given), np.finfo(float).tiny)
        found, k = float(np.median(parts)), int(np.argsort(parts)[len(parts) // 2])
        if found <= _MODEST:
            return
        move = f"from t = {t[k]:g} to {t[k + 1]:g} the positions move by {lengths[k]:.3g}, the velocities give "
        sentence = (
            f"{name}positions and velocities disagree: {move}{given[k]:.3g} at {_angle(moved[k], swept[k]):.0f}° to "
            "that; they must have the same unit of length, the unit of time of the times and the same axes, which do "
            "not rotate, and at least six entries a revolution"
        )
        if refuse and found > _FACTOR:
            raise ValueError(sentence)
        warnings.warn(sentence, stacklevel=3)


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    """The angle between two vectors, in degrees."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def table(times: Any, positions: Any, velocities: Any) -> Table:
    """An orbit through given positions with given velocities: a cubic between two entries, C¹ (Hermite).

    Its error is h⁴/384 times the fourth derivative of the position, and the velocity is exactly the derivative of the
    position. Inside jit a time outside the table gives NaN, and the step reports `converged=False`.

    Args:
        times: of the entries, increasing, (n,), n ≥ 2.
        positions, velocities: at these times, (n, 3).

    Raises:
        ValueError: times that do not increase, shapes that do not agree, values that are not finite, or positions and
            velocities that disagree by a factor, such as km with m/s. A modest disagreement, such as that of positions
            of a rotating frame near the Earth with velocities of an inertial one, is a warning.
    """
    found = _entries(times, positions, velocities)
    if concrete(found):
        found.check_velocities()
    return found


def _entries(times: Any, positions: Any, velocities: Any) -> Table:
    """The table of checked entries, whose velocities may be anything."""
    t = increasing_times(times)
    return Table(t, _flat(_vectors("positions", positions, t), _vectors("velocities", velocities, t)))


def _flat(positions: Array, velocities: Array) -> Array:
    return jnp.concatenate([positions, velocities], axis=1).ravel()


def _vectors(name: str, given: Any, t: Array) -> Array:
    """Vectors at the times t, (n, 3), finite where they are concrete."""
    found = _checks.real_array(name, given, (len(t), 3), finite=False)
    if concrete(found) and not np.isfinite(np.asarray(found)).all():
        k, i = np.argwhere(~np.isfinite(np.asarray(found)))[0]
        raise ValueError(f"{name} must be finite, got {float(found[k, i])} in entry {k}, component {i}")
    return found


@pytree
class VectorTable:
    """A vector that depends on time, through the entries of a table: `vector(t)`, (3,). Made by `vector_table`."""

    entries: Table

    def __call__(self, t: ArrayLike) -> Array:
        """The vector at time t, (3,). Outside the table: ValueError if t is concrete, otherwise NaN."""
        return self.entries(t)[0]


def vector_table(times: Any, values: Any) -> VectorTable:
    """A C¹ vector function of time from a table, such as a magnetic field that another package computed.

    Between two entries it is the cubic whose derivatives at the entries are those of parabolas through three entries.

    Args:
        times: of the entries, increasing, (n,), n ≥ 3.
        values: at these times, (n, 3).

    Raises:
        ValueError: times that do not increase, shapes that do not agree, values that are not finite.

    Example:
        >>> field = vector_table([0.0, 1.0, 3.0], [[0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [9.0, 1.0, 0.0]])
        >>> field(2.0).tolist()
        [4.0, 1.0, 0.0]
    """
    found = _entries(times, values, jnp.zeros_like(jnp.asarray(plain("values", values))))
    if len(found.times) < 3:
        raise ValueError(f"times must have at least 3 entries, got {len(found.times)}")
    return VectorTable(Table(found.times, _flat(found.positions, _slopes(found.times, found.positions))))


def _slopes(t: Array, x: Array) -> Array:
    """The derivatives at the entries, of the parabolas through three of them."""
    h = jnp.diff(t)[:, None]
    rate = jnp.diff(x, axis=0) / h
    before, after = h[:-1], h[1:]
    inner = (after * rate[:-1] + before * rate[1:]) / (before + after)
    first, last = 2 * rate[0] - inner[0], 2 * rate[-1] - inner[-1]
    return jnp.concatenate([first[None], inner, last[None]])


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    times = jnp.linspace(-0.6, 1.2, 5)
    c, s = jnp.cos(times), jnp.sin(times)
    rows, rates = jnp.stack([c, s, 0.1 * times], 1), jnp.stack([-s, c, 0.1 + 0 * times], 1)
    return {
        "table": partial(table, times=times, positions=rows, velocities=rates),
        "vector_table": partial(vector_table, times=times, values=rows),
    }
