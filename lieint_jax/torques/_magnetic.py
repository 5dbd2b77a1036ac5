"""Magnetic laws: detumbling by torquers, eddy currents, and hysteresis rods."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import named, not_negative, positive
from lieint_jax._numerics.arrays import Calls, PyTree
from lieint_jax._numerics.vectors import Vector, cross, dot, norm
from lieint_jax.core import Converted, Law, Rotation, argument, pytree, static
from lieint_jax.groups import so3
from lieint_jax.torques._arguments import (
    VectorOfTime,
    cut,
    dissipative_tensor,
    example_of_time,
    tensor_of,
    value_at,
    vector_of_time,
)
from lieint_jax.torques._body_axes import end_axes, mean_axes, middle_axes, start_axes

__all__ = ["LimitedBDot", "bdot", "eddy_current", "hysteresis"]

_ROUNDINGS = 16  # tolerance, in ulps of |b| + |w|, for a rod at the edge of its hysteresis band


@pytree
class BDot(Law):
    """τ = −k(|b|²ω − b(b·ω)) in space. Made by `bdot`."""

    gain: Array
    field: VectorOfTime
    frame = "space"
    label = "bdot"  # pyright: ignore[reportAssignmentType, reportIncompatibleMethodOverride]

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """k b × (b × ω̄)."""
        b = value_at(self.field, rotation.t)
        return self.gain * jnp.stack(cross(b, cross(b, rotation.omega))), inner


@pytree
class LimitedBDot(Law):
    """T = m × B with the moment k Ω × B of the torquers, each component cut at a limit. Made by `bdot`."""

    gain: Array
    field: VectorOfTime
    max_dipole: Array
    label = "bdot"  # pyright: ignore[reportAssignmentType, reportIncompatibleMethodOverride]

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """m × B, in the field at the middle of the step and the attitude half-way."""
        B = middle_axes(rotation, value_at(self.field, rotation.t))
        m = cut(self.gain * jnp.stack(cross(rotation.Omega, B)), self.max_dipole)
        return jnp.stack(cross(m, B)), inner


def bdot(gain: ArrayLike, field: Any, max_dipole: ArrayLike | None = None) -> BDot | LimitedBDot:
    """Magnetic detumbling: the moment m = −kḃ ≈ k ω × b of the torquers in the field b gives τ = m × b.

    Its work in a step is never positive: −Δt k|b × ω̄|², or with a limit −Δt Σ mᵢ(Ω̄ × B)ᵢ, component by component.
    The rotation about b itself is not damped: b must change its direction.

    Args:
        gain: k ≥ 0, torque × time / field².
        field: b in space, (3,), or a function of time with such values, such as the field along an orbit.
        max_dipole: the largest moment of a torquer, > 0, a number or one for each body axis, (3,); None for no limit.

    Raises:
        ValueError: a negative gain, a field that is no vector and no function, a limit that is not positive.

    Source: Stickler & Alfriend 1976, J. Spacecr. Rockets 13.
    """
    k, b = not_negative("gain", gain), vector_of_time("field", field)
    return BDot(k, b) if max_dipole is None else LimitedBDot(k, b, positive("max_dipole", max_dipole, (), (3,)))


@pytree
class EddyCurrent(Law):
    """Eddy currents in a conducting body that rotates in a magnetic field: T = M(Ω × B) × B in the body, B = Λᵀb.

    They take the rotation across the field away; that about the field is left: π·b is constant in a constant field, to
    round-off. The work in a step is −Δt (Ω̄ × B̄)·M(Ω̄ × B̄), never positive, whatever Δt is. For a number k,
    T = −k(|b|²ω − b(b·ω)).

    Args:
        tensor: M, the magnetic tensor, torque × time / field²: a number, principal values (3,), or a symmetric tensor
            (3, 3); not negative. A sphere of conductivity σ and radius R has 2πσR⁵/15, its thin shell of thickness d
            has 2πσR⁴d/3, in SI units.
        field: b in space, (3,), or a function of time with such values, such as `orbits.earth_field(orbit, date)`.
        rate: ḃ in space, a function of time such as `jax.jacfwd(field)`, to count the currents by the field's own
            change too: the torque is then M(Ω × B − Λᵀḃ) × B, which may do work on the body, and brings it to rotate
            with the field. None neglects them, as for a body that rotates much faster than the field.

    Raises:
        ValueError: a negative M, or none of these shapes; a field or a rate that is no vector and no function.

    Source: Praly et al. 2012, Acta Astronaut. 76; Gómez & Walker 2015, Acta Astronaut. 114; the mean of a step: this
    package.

    Example:
        >>> import lieint_jax as li
        >>> debris = li.systems.torqued_body([1.0, 2.0, 3.0], li.torques.eddy_current(0.1, [0.0, 0.0, 2.0]))
        >>> state = debris.state(angular_velocity=[1.0, 0.0, 1.0], work=0.0)
        >>> round(float(debris.power(state)), 3)
        -0.4
    """

    tensor: Converted[Array] = argument(converter=named(dissipative_tensor, "tensor"))
    field: Converted[VectorOfTime] = argument(converter=named(vector_of_time, "field"))
    rate: Converted[VectorOfTime | None] = argument(
        converter=named(vector_of_time, "rate", optional=True), default=None
    )

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """M(Ω̄ × B̄) × B̄ with B̄ = Λ̄ᵀb at the middle time, for which b·Λ̄T̄ = 0."""
        _, moment, B = self._induced(rotation)
        return jnp.stack(cross(moment, B)), inner

    def work(self, rotation: Rotation, torque: Array, inner: PyTree, after: PyTree) -> Array:
        """−Δt (Ω̄ × B̄)·m, with the moment m that the currents have."""
        across, moment, _ = self._induced(rotation)
        power = dot(across, moment)
        if self.rate is None:
            power = jnp.maximum(power, 0)  # of a tensor without an inverse it may be rounded to less
        return -rotation.dt * power

    def _induced(self, rotation: Rotation) -> tuple[Vector, Vector, Array]:
        """Ω̄ × B̄, the moment of the currents, and B̄."""
        B = mean_axes(rotation, value_at(self.field, rotation.t))
        across = cross(rotation.Omega, B)
        seen = across if self.rate is None else across - mean_axes(rotation, value_at(self.rate, rotation.t))
        return across, tensor_of(self.tensor) @ seen, B


@pytree
class Hysteresis(Law):
    """A magnetic hysteresis rod, which damps the rotation of a satellite in the Earth's field.

    It is a play operator of half-width ρ followed by the curve M = M_s tanh(w/a): at a reversal of the field the moment
    is constant until the field has changed by 2ρ. In a constant field the energy never increases; over a closed loop
    the loss is the area of the loop. `State.extra[key]` is the rod's internal field w: with the field x = e·Λᵀb along
    the rod, |x − w| ≤ ρ and w′ = clip(w, x′ − ρ, x′ + ρ), and the moment is F(w) = Φ′(w).

    Args:
        axis: e, the direction of the rod in the body, a unit vector (3,).
        saturation: M_s > 0, the greatest moment, torque / field.
        slope: a > 0, a field: M ≈ M_s w/a for small w.
        coercivity: ρ ≥ 0, a field.
        field: b in space, (3,), or a function of time with such values.
        key: the name of the internal field w in `State.extra`; several rods need several names.

    Raises:
        ValueError: an axis that is not of unit length, numbers out of range, a field that is no vector and no function.

    Source: the play operator: Visintin 1994, Differential Models of Hysteresis; its mean moment in a step: this
    package.
    """

    axis: Converted[Array] = argument(converter=named(_checks.unit_vector, "axis"))
    saturation: Converted[Array] = argument(converter=named(positive, "saturation"))
    slope: Converted[Array] = argument(converter=named(positive, "slope"))
    coercivity: Converted[Array] = argument(converter=named(not_negative, "coercivity"))
    field: Converted[VectorOfTime] = argument(converter=named(vector_of_time, "field"), kw_only=True)
    key: str = static(default="rod", kw_only=True)  # pyright: ignore[reportIncompatibleVariableOverride]
    symmetric = False

    @property
    def label(self) -> str:
        return "hysteresis" if self.key == "rod" else self.key

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """κ M̄ e × Λ̄ᵀb_m, with M̄ the mean moment on the straight line from x_n to x_{n+1}."""
        before = dot(self.axis, start_axes(rotation, value_at(self.field, rotation.start)))
        after = dot(self.axis, end_axes(rotation, value_at(self.field, rotation.end)))
        w = jnp.clip(inner, after - self.coercivity, after + self.coercivity)
        B = mean_axes(rotation, value_at(self.field, rotation.t))
        moment = self._mean_moment(inner, w, after - before)
        return rotation.kappa * moment * jnp.stack(cross(self.axis, B)), w

    def energy(self, t: Array, q: Array, inner: PyTree) -> Array:
        """wF − Φ − Fx: the stored energy of the rod and its energy in the field."""
        F = self._moment(inner)
        return F * (inner - self._axial_field(t, q)) - self._stored_energy(inner)

    def inner_rate(self, now: Rotation, inner: Array) -> Array:
        """ẇ = ẋ where x is at the edge of w ± ρ and moves outward, else 0."""
        moving = (jnp.ones_like(now.start), so3.tangent(now.q_n, now.Omega))
        x, speed = jax.jvp(self._axial_field, (now.start, now.q_n), moving)
        b = value_at(self.field, now.start)
        rounding = _ROUNDINGS * jnp.finfo(x.dtype).eps * (norm(b) + jnp.abs(inner))
        edge = self.coercivity - rounding
        pushed = (x - inner >= edge) & (speed > 0) | (inner - x >= edge) & (speed < 0)
        return jnp.where(pushed, speed, jnp.where(jnp.isnan(x - inner + edge + speed), jnp.nan, 0))

    def start(self, now: Rotation) -> Array:
        """The w nearest to 0 with |x − w| ≤ ρ: a rod that came into the field without magnetization."""
        x = self._axial_field(now.t, now.q_n)
        return jnp.clip(jnp.zeros((), x.dtype), x - self.coercivity, x + self.coercivity)

    def _axial_field(self, t: Array, q: Array) -> Array:
        """x = e·Λᵀb(t)."""
        return dot(self.axis, so3.Ad_star(q, value_at(self.field, t)))

    def _moment(self, w: Array) -> Array:
        """F(w) = M_s tanh(w/a)."""
        return self.saturation * jnp.tanh(w / self.slope)

    def _stored_energy(self, w: Array) -> Array:
        """Φ(w) = M_s a log cosh(w/a), without overflow."""
        x = jnp.abs(w) / self.slope
        return self.saturation * self.slope * (x + jnp.log1p(jnp.exp(-2 * x)) - jnp.log(2.0))

    def _mean_moment(self, w: Array, end: Array, change: Array) -> Array:
        """M̄ = F(w) + (F̄ − F(w))(w′ − w)/ΔX, F̄ the mean of F between w and w′ by its integral."""
        dw = end - w
        small = jnp.abs(dw) < 1e-3 * self.slope
        mean = (self._stored_energy(end) - self._stored_energy(w)) / jnp.where(small, 1, dw)
        nodes = w + dw * jnp.asarray([0.5 - 0.3872983346207417, 0.5, 0.5 + 0.3872983346207417], w.dtype)
        gauss = jnp.dot(jnp.asarray([5 / 18, 8 / 18, 5 / 18], w.dtype), self._moment(nodes))
        start, moves = self._moment(w), change != 0
        part = dw / jnp.where(moves, change, 1)
        return start + jnp.where(moves, (jnp.where(small, gauss, mean) - start) * part, 0)


eddy_current, hysteresis = EddyCurrent, Hysteresis


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    field, rate = example_of_time(), example_of_time(0.3, -0.5, 0.7)
    rod = {"axis": jnp.array([0.6, 0.8, 0.0]), "saturation": 0.3, "slope": 0.2, "coercivity": 0.1}
    return {
        "bdot": partial(bdot, gain=0.4, field=field, max_dipole=None),
        "bdot with a limit": partial(bdot, gain=0.4, field=field, max_dipole=jnp.array([0.1, 0.2, 0.3])),
        "eddy_current": partial(eddy_current, tensor=jnp.array([1.3, 1.7, 2.2]), field=field, rate=rate),
        "eddy_current in a slow field": partial(eddy_current, tensor=0.4, field=field, rate=None),
        "hysteresis": partial(hysteresis, **rod, field=field, key="rod"),
    }
