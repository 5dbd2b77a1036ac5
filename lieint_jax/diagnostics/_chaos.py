"""Chaos: Lyapunov exponents and MEGNO, from the tangent flow of a step, and Poincaré sections.

    spectrum   W ← L_n … L_1 W, now and then W = QR, W ← Q, growth ← growth + ln R_ii;   λ_i = growth_i / t
    MEGNO      Y_n = (2/n) Σ_k k ln(|δ_k| / |δ_{k−1}|),   its mean (1/n) Σ_k Y_k

L is the derivative of the step itself (`Step.tangent`), so these are the exponents of the discrete flow. The momentum
coordinates of a tangent vector are in units of the largest component of the initial momentum, or at rest in those of a
motion by about a radian: the limits of the exponents do not depend on this, and the results are the same in any units
of the state.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks, native
from lieint_jax._checks import concrete
from lieint_jax._numerics.arrays import PyTree, TangentVectors
from lieint_jax._xla import compiled
from lieint_jax.core import State, Step, StepInfo, checked_step, promoted
from lieint_jax.core.tangent import orthonormalize, units_at_start
from lieint_jax.runs import Event, counted, events, saves, step_at_node, uniform_clock


class Lyapunov(NamedTuple):
    """Finite-time Lyapunov exponents.

    Attributes:
        exponents: the exponents of the whole run, (k,), in 1/time; for dt < 0 those of the backward flow.
        errors: their standard errors, (k,), from the spread of batches of growing length, see `standard_error`; nan for
            a single batch. On average they are 0.7 to 1.2 times the scatter of many initial states if correlations
            decay within a tenth of the run. Where a chaotic motion sticks to islands for longer, they are too small;
            then use the scatter of many initial states. They do not contain the bias of a finite time, about ln(t)/t,
            which is the whole error on a regular motion.
        growth: ln of the growth of each tangent vector in each batch, (batches, k); its sum over the batches is
            exponents × |time|.
        info: the largest residual of the steps, and whether all converged.
    """

    exponents: Array
    errors: Array
    growth: Array
    info: StepInfo


class Megno(NamedTuple):
    """The mean exponential growth factor of nearby orbits.

    Attributes:
        value: Y at the end, a scalar, which oscillates.
        mean: the mean of Y over the run: it tends to 2 on a quasi-periodic motion, to a value from 0 to 2 on a periodic
            one, and grows like λt/2 on a chaotic one.
        info: the largest residual of the steps, and whether all converged.
    """

    value: Array
    mean: Array
    info: StepInfo


def lyapunov(
    step: Step,
    state: State,
    dt: ArrayLike,
    num_steps: int,
    exponents: int | None = None,
    *,
    every: int = 1,
    vectors: npt.ArrayLike | None = None,
    batches: int = 64,
) -> Lyapunov:
    """The Lyapunov exponents of a run, the largest first in the limit, by QR decompositions of its tangent flow.

    The memory is constant. The exponents of a symplectic step come in pairs ±λ in the limit, and their sum is round-off
    at any time. Use jax.vmap for many states, or `li.over_members` to use all cores. A failed step shows in
    `info`.

    Args:
        step: a step; its `tangent` in closed form makes this fast.
        state: the initial state of one body.
        dt: step size.
        num_steps: a multiple of `every`.
        exponents: how many of the largest, 1 to 2d; by default 2d, the spectrum.
        every: steps between two QR decompositions. Errors of rounding grow with the vectors in between.
        vectors: initial tangent vectors (2d, k) in the phase space's coordinates, in place of `exponents`, such as
            those of an invariant subspace. By default fixed vectors of generic directions in units of the state.
        batches: the number of parts of the run whose growth is returned, of equal length up to one QR decomposition.
            The standard errors use windows from one part to a quarter of the run.

    Returns:
        A `Lyapunov`.

    Raises:
        ValueError: a bad count, vectors of another shape, a step that advances the time itself, or a first step that
            does not converge.

    Source: Benettin, Galgani, Giorgilli & Strelcyn 1980, Meccanica 15; for the errors, see `standard_error`.
    """
    step, state, dtype = promoted(_in_time(checked_step(step)), state)
    dim = step.system.phase_space.dim
    if vectors is None:
        count = dim if exponents is None else _checks.count("exponents", exponents, 1)
        frame = jnp.asarray(_generic(dim)[:, :count])
    elif exponents is None:
        frame = _checks.real_array("vectors", vectors)
        count = frame.shape[-1] if frame.ndim == 2 else 0
    else:
        raise ValueError("give exponents or vectors, not both")
    if frame.shape != (dim, count) or not 1 <= count <= dim:
        raise ValueError(
            f"from 1 to {dim} tangent vectors are allowed, an array ({dim}, k), got "
            + (f"exponents = {count}" if vectors is None else f"shape {frame.shape}")
        )
    every, batches = _checks.count("every", every, 1), _checks.count("batches", batches, 1)
    rounds = saves(_checks.count("num_steps", num_steps, 1), every)
    h = jnp.asarray(_checks.step_size(dt), dtype)
    unit = units_at_start(step.system, state)[:, None]
    frame = frame if vectors is None else frame / unit
    if concrete(frame) and np.linalg.matrix_rank(np.asarray(frame)) < frame.shape[1]:
        raise ValueError("the tangent vectors must be linearly independent")
    step.check(state, dt)
    return _lyapunov(step, state, h, unit, jnp.asarray(frame, dtype), rounds, every, min(batches, rounds))


def _in_time(step: Step) -> Step:
    """The step, if its dt is one of time."""
    if step.own_time:
        raise ValueError(f"the dt of {step.name} is a step of a fictitious time, not of time: pass its base step")
    return step


@partial(compiled, static_argnums=(5, 6, 7))
def _lyapunov(
    step: Step, state: State, dt: Array, unit: Array, frame: TangentVectors, rounds: int, every: int, batches: int
) -> Lyapunov:
    def orthonormal_interval(
        n: Array,
        carry: PyTree,
        _: None,
        step: Step,
        clock: PyTree,
        unit: Array,
        inverse: Array,
        before: Array,
        of: Array,
    ) -> tuple[PyTree, Array]:
        """Round `before` + n, in a batch of so many rounds; both loops below are one program of this."""

        def interval(n: Array, carry: PyTree) -> PyTree:
            state, T, info = carry
            state, last, T = step_at_node(step.tangent, clock, state, n, T)
            return state, T, info.merge(last)

        state, frame, info, growth = carry
        state, T, info = counted(interval, (before + n) * every, every, (state, unit * frame, info))
        frame, gain = orthonormalize(T * inverse)
        growth = jnp.where(n % of == 0, 0, growth) + gain
        return (state, frame, info, growth), growth

    consts = step, uniform_clock(step, state, dt), unit, 1 / unit
    carry = (state, orthonormalize(frame)[0], StepInfo.empty(state.p), jnp.zeros_like(frame[0]))
    rest, parts = rounds % batches, []
    lengths = np.repeat([rounds // batches + 1, rounds // batches], [rest, batches - rest])  # rounds of each batch
    for first, end in ((0, rest), (rest, batches)):
        if first < end:
            length, before = int(lengths[first]), int(lengths[:first].sum())
            given = *consts, jnp.asarray(before), jnp.asarray(length)
            carry, part = native.march(orthonormal_interval, carry, None, given, rows=end - first, every=length)
            parts.append(part)
    growth, between = jnp.concatenate(parts), jnp.abs(dt) * every
    errors = standard_error(growth / (between * jnp.asarray(lengths, dt.dtype))[:, None])
    return Lyapunov(growth.sum(axis=0) / (between * rounds), errors, growth, carry[2])


def standard_error(series: Array) -> Array:
    """The standard error of the mean of a correlated series, by overlapping batch means of growing length.

    With V_w the variance of the mean from all windows of w neighbors, w = 1, 2, 4, …, up to a quarter of the series,
    it is the square root of the largest of V_1 and 2V_w − V_{w/2}. Where values are correlated, V_w grows with w to a
    plateau that it approaches like 1/w; the difference removes this bias. As the largest of several estimates, it is on
    average 1.2 times the error of uncorrelated values. It is 0.85 times the error where correlations decay over a tenth
    of the series, and 0.6 times where they decay over a fifth.

    Args:
        series: values at equal intervals along the first axis.

    Returns:
        The standard error, of the shape of one value; nan for a single value.

    Source: Flyvbjerg & Petersen 1989, J. Chem. Phys. 91 (blocks of growing length); Meketon & Schmeiser 1984, Winter
        Simulation Conf. (overlapping batches); Vats & Flegal 2022, Biometrika 109 (the difference).
    """
    n = series.shape[0]
    sums = jnp.cumsum(series - series.mean(axis=0, keepdims=True), axis=0)
    sums = jnp.concatenate([jnp.zeros_like(sums[:1]), sums])

    def variance(w: int) -> Array:
        means = (sums[w:] - sums[:-w]) / w
        return w * (means * means).mean(axis=0) / (n - w) if n > 1 else jnp.full_like(sums[0], jnp.nan)

    variances = [variance(1 << k) for k in range(max(1, n.bit_length() - 2))]
    corrected = [2 * wide - narrow for narrow, wide in pairwise(variances)]
    return jnp.sqrt(jnp.max(jnp.stack([variances[0], *corrected]), axis=0))


def megno(step: Step, state: State, dt: ArrayLike, num_steps: int, *, vector: npt.ArrayLike | None = None) -> Megno:
    """MEGNO of a run, which distinguishes chaotic from regular motion in a shorter run than Lyapunov exponents do.

    The memory is constant. Use jax.vmap for many states, or `li.over_members` to use all cores.

    Args:
        step, state, dt, num_steps: as in `integrate`.
        vector: the initial tangent vector (2d,) in the phase space's coordinates; by default of a
            generic direction in units of the state.

    Returns:
        A `Megno`.

    Raises:
        ValueError: a bad count, a vector of another shape, a step that advances the time itself, or a first step that
            does not converge.

    Source: Cincotta & Simó 2000, Astron. Astrophys. Suppl. 147; Cincotta, Giordano & Simó 2003, Physica D 182.
    """
    step, state, dtype = promoted(_in_time(checked_step(step)), state)
    dim = step.system.phase_space.dim
    h = jnp.asarray(_checks.step_size(dt), dtype)
    unit = units_at_start(step.system, state)
    given = _generic(dim)[:, 0] if vector is None else _checks.real_array("vector", vector, (dim,)) / unit
    num_steps = _checks.count("num_steps", num_steps, 1)
    step.check(state, dt)
    return _megno(step, state, h, unit[:, None], jnp.asarray(given, dtype)[:, None], num_steps)


@partial(compiled, static_argnums=5)
def _megno(step: Step, state: State, dt: Array, unit: Array, vector: TangentVectors, num_steps: int) -> Megno:
    inverse = 1 / unit
    advance_vector = partial(step_at_node, step.tangent, uniform_clock(step, state, dt))

    def step_once(n: Array, carry: PyTree, _: None) -> tuple[PyTree, None]:
        state, W, Y, mean, info = carry
        state, last, T = advance_vector(state, n, unit * W)
        W, gain = orthonormalize(T * inverse)
        k = (n + 1).astype(Y.dtype)
        Y = Y * (n / k) + 2 * gain[0]
        return (state, W, Y, mean + (Y - mean) / k, info.merge(last)), None

    zero = jnp.zeros((), vector.dtype)
    first = orthonormalize(vector)[0]
    begin = (state, first, zero, zero, StepInfo.empty(state.p))
    (_, _, Y, mean, info), _ = native.march(step_once, begin, rows=1, every=num_steps)
    return Megno(Y, mean, info)


def _generic(dim: int) -> np.ndarray:
    """Orthonormal columns (dim, dim) of generic directions, the same in every run."""
    return np.linalg.qr(np.random.default_rng(0).normal(size=(dim, dim)))[0]


def section(
    step: Step,
    states: State,
    dt: ArrayLike,
    condition: Callable[[State], ArrayLike],
    *,
    max_steps: int,
    count: int,
    direction: Literal[-1, 0, 1] = 1,
) -> Event:
    """A Poincaré section of an ensemble: the first `count` states of each member at which `condition` changes its sign.

    Every point comes from a shorter step from the last node before, so it has the invariants of the step.

    Args:
        step, dt: as in `integrate`.
        states: initial states, every leaf with a leading member axis; the time may be shared.
        condition: a smooth function of the state of one member with a scalar value, 0 on the surface.
        max_steps: the largest number of steps to search, > 0.
        count: the number of points per member.
        direction: 1 for crossings from − to +, −1 for those from + to −, 0 for both.

    Returns:
        An `Event` whose leaves have leading axes (members, count). Where `found` is False, the member did not cross so
        often within `max_steps`, or a step failed: ignore these points.

    Raises:
        ValueError: as in `event`.
    """
    if not isinstance(states, State) or jnp.ndim(states.p) < 2:
        raise ValueError("states must be a State whose leaves have a leading member axis; for one body use event")
    shared = states.t is not None and jnp.ndim(states.t) == 0
    axes: PyTree = jax.tree.map(lambda _: 0, states)
    axes = axes._replace(t=None) if shared else axes
    first = jax.tree.map(lambda x, axis: x if axis is None else x[0], states, axes, is_leaf=lambda x: x is None)
    checked_step(step).check(first, dt)  # inside vmap it cannot be
    return jax.vmap(
        lambda z: events(step, z, dt, condition, max_steps=max_steps, count=count, direction=direction), in_axes=(axes,)
    )(states)
