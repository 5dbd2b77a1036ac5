"""An orbit given by a table, such as an ephemeris."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.lookup import increasing_times, interval
from lieint_jax.types import pytree


@pytree
class Table:
    """An orbit through the entries of a table: `orbit(t)` is the position and the velocity. Made by `table`.

    Attributes:
        times: the times of the entries, increasing, (n,).
        positions, velocities: positions and velocities at these times, (n, 3).
    """

    times: Array
    positions: Array
    velocities: Array

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Position (3,) and velocity (3,) at time t. Outside the table: ValueError if t is concrete, otherwise NaN."""
        k, since, h = interval(self.times, t)
        (ra, rb), (va, vb) = ((x[k], x[k + 1]) for x in (self.positions, self.velocities))
        s = since / h
        step, ends = rb - ra, h * (va + vb) - 2 * (rb - ra)  # r = ra + h va s + (step − h va − ends) s² + ends s³
        bend = step - h * va - ends
        return ra + s * (h * va + s * (bend + s * ends)), va + s * (2 * bend + 3 * s * ends) / h


def table(times: Any, positions: Any, velocities: Any) -> Table:
    """An orbit through given positions with given velocities: a cubic between two entries, C¹ (Hermite).

    Its error is h⁴/384 times the fourth derivative of the position, and the velocity is exactly the derivative of the
    position. Inside jit a time outside the table gives NaN, and the step reports `converged=False`.

    Args:
        times: of the entries, increasing, (n,), n ≥ 2.
        positions, velocities: at these times, (n, 3).

    Raises:
        ValueError: times that do not increase, shapes that do not agree, values that are not finite.
    """
    t = increasing_times(times)
    shape = (len(t), 3)
    return Table(
        t, _checks.real_array("positions", positions, shape), _checks.real_array("velocities", velocities, shape)
    )


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
    found = table(times, values, jnp.zeros_like(jnp.asarray(values)))
    if len(found.times) < 3:
        raise ValueError(f"times must have at least 3 entries, got {len(found.times)}")
    return VectorTable(Table(found.times, found.positions, _slopes(found.times, found.positions)))


def _slopes(t: Array, x: Array) -> Array:
    """The derivatives at the entries, of the parabolas through three of them."""
    h = jnp.diff(t)[:, None]
    rate = jnp.diff(x, axis=0) / h
    before, after = h[:-1], h[1:]
    inner = (after * rate[:-1] + before * rate[1:]) / (before + after)
    first, last = 2 * rate[0] - inner[0], 2 * rate[-1] - inner[-1]
    return jnp.concatenate([first[None], inner, last[None]])
