"""Distances between many bodies, and how often each of them occurs."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import host_array, plain
from lieint_jax.core import State, Step
from lieint_jax.groups import so3
from lieint_jax.measure._states import count_bodies, series_of
from lieint_jax.runs import Run

__all__ = ["PairDensity", "distances", "pair_density"]

_EVEN = 1e-6  # largest difference of the widths of two bins, over their mean


def distances(run: Run, point: ArrayLike = (0.0, 0.0, 0.0)) -> np.ndarray:
    """The distances of all pairs i < j of bodies.

    Args:
        run: of N bodies.
        point: in the axes of each body, from its center of mass, (3,): distances are those of these points, such as the
            oxygen atoms of molecules of water.

    Returns:
        (times, pairs) or (times, members, pairs), in the order (0, 1), (0, 2), …, (1, 2), …

    Raises:
        ValueError: the run is not of several bodies.
    """
    count_bodies(run)
    return series_of(run, _distances_at, _checks.real_array("point", point, (3,)))


def _distances_at(point: Array, step: Step, state: State) -> Array:
    x = state.q[:, :3] + jax.vmap(so3.Ad, (0, None))(state.q[:, 3:], point.astype(state.q.dtype))
    i, j = np.triu_indices(len(x), 1)
    return jnp.sqrt(jnp.sum((x[i] - x[j]) ** 2, axis=1))


class PairDensity(NamedTuple):
    """How many pairs have a distance r, per volume of a shell of this radius.

    Attributes:
        r: the middles of the bins, (bins,).
        density: pairs over 4πr² Δr, (bins,): the mean over times and members.
        peak: the distance of the greatest density, by a parabola through three bins.
        height: the density of the bin of the peak.
    """

    r: np.ndarray
    density: np.ndarray
    peak: float
    height: float


def pair_density(r: ArrayLike, edges: ArrayLike, peak_below: float = np.inf) -> PairDensity:
    """The histogram of distances over the volume of their shells: the radial distribution of a droplet, unnormalized.

    Args:
        r: distances, (times, pairs) or (times, members, pairs), as `distances` returns them; states with a NaN, such as
            those of a failed member, are left out.
        edges: of the bins, evenly spaced and > 0, (bins + 1,), at least three bins; other distances are left out.
        peak_below: the peak is the greatest density at distances below this.

    Returns:
        A `PairDensity`; its peak is at a bin's middle where the density has no maximum there. NaN without any states.

    Raises:
        ValueError: fewer than three bins, bins of different widths, or none whose middle is below `peak_below`.

    Source: Allen & Tildesley 2017, Computer Simulation of Liquids, 8.2.
    """
    r, edges, peak_below = host_array("r", r), host_array("edges", edges, float), plain("peak_below", peak_below)
    if edges.ndim != 1 or len(edges) < 4 or not edges[0] > 0:
        raise ValueError(f"edges must be positive, (bins + 1,), of at least three bins, got {edges}")
    widths = np.diff(edges)
    if not np.ptp(widths) <= _EVEN * widths.mean():
        raise ValueError(f"edges must be evenly spaced, got bins from {widths.min():.6g} to {widths.max():.6g} wide")
    if not (edges[0] + edges[1]) / 2 < peak_below:
        raise ValueError(
            f"peak_below must be above the middle of the first bin, {edges[:2].mean():.6g}, got {peak_below}"
        )
    r = r[~np.isnan(r).any(axis=-1)]
    counts, middles, width = np.histogram(r, edges)[0], (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    if not len(r):
        return PairDensity(middles, np.full(len(counts), np.nan), np.nan, np.nan)
    density = counts / middles**2 / (4 * np.pi * width * len(r))
    k = int(np.clip(np.argmax(density[middles < peak_below]), 1, len(density) - 2))
    left, top, right = density[k - 1 : k + 2]
    curvature = left - 2 * top + right
    shift = 0.5 * (left - right) / curvature if curvature < 0 else 0.0
    return PairDensity(middles, density, float(middles[k] + shift * width), float(top))
