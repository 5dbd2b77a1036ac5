"""Laws of torque for `systems.torqued_body`: dampers, attitude control, thrusters, the pressure of sunlight.

A law is a function (t, q, ω) ↦ torque, (3,), of time, attitude quaternion and angular velocity, the torque and ω both
in the axes that its `frame` names. Any function is one; `types.AbstractTorquedBody` lists what else a law
may offer. Those here are short, to be read, copied and changed:

| law | torque | energy lost or gained, each step of `schemes.torqued_midpoint` exactly |
|---|---|---|
| `viscous` | −DΩ in the body | −Δt Ω̄·DΩ̄ |
| `pd_trace` | U = ½k tr(1 − Λ_dᵀΛ), and −cω | H with U: −Δt c\\|ω̄\\|² |
| `pd_quaternion` | U = 2k(1 − e₀), which unwinds, and −cΩ | the same |
| `bdot` | −k(\\|b\\|²ω − b(b·ω)) in a field b(t) | −Δt k\\|b × ω̄\\|² |
| `kane_damper` | −c(ω − ω_d), ω_d of a sphere inside | H with the sphere's: −Δt c\\|ω̄ − ω̄_d\\|² |
| `thruster` | constant T in the body, in a time window | ΔtΩ̄·T times the part of the step in the window |
| `solar_plate` | r × F(s) of a flat plate, s the direction of the Sun | Δt Ω̄·T̄ |
| `internal_friction` | none: it turns the body by α Π × Ω more (`systems.damped_body`) | −κΔtα\\|Π̄ × Ω̄\\|² |

A bar on Ω or ω is the step's own angular velocity, J⁻¹ of the mean body momentum; on T, the torque at half of the step.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._numerics import vec3
from lieint_jax._numerics.vec3 import add, cross, dot, scale
from lieint_jax.groups import so3
from lieint_jax.types import callable_pytree, pytree


@pytree
class Viscous:
    """T = −DΩ in the body. Made by `viscous`."""

    damping: Array
    frame = "body"

    def __call__(self, t: Array, q: Array, omega: Array) -> Array:
        """−DΩ."""
        D = self.damping if self.damping.ndim else jnp.broadcast_to(self.damping, (3,))
        return -jnp.stack(vec3.apply(vec3.symmetric(D), omega))


def viscous(damping: ArrayLike) -> Viscous:
    """Linear drag of the surroundings, T = −DΩ: energy falls by Δt Ω̄·DΩ̄ in a step, and never rises.

    Args:
        damping: D, torque × time: a number, principal values (3,), or a symmetric tensor (3, 3); not negative.

    Raises:
        ValueError: a negative D, or none of these shapes.
    """
    return Viscous(_damping(damping, (), (3,), (3, 3)))


@pytree
class PDTrace:
    """Proportional-derivative control by U = ½k tr(1 − Λ_dᵀΛ), in space. Made by `pd_trace`."""

    gain: Array
    damping: Array
    target: Array
    frame = "space"

    def _error(self, q: Array) -> Array:
        """The quaternion of ΛΛ_dᵀ."""
        return so3.multiply(q, so3.inverse(self.target))

    def __call__(self, t: Array, q: Array, omega: Array) -> Array:
        """−½k vex(ΛΛ_dᵀ) − cω."""
        e = self._error(q)
        return -2 * self.gain * e[0] * e[1:] - self.damping * omega

    def mean(self, t: Array, q_n: Array, q_next: Array, h: Array, kappa: Array, omega: Array) -> Array:
        """−½κk vex(Λ̄Λ_dᵀ) − cω̄, Λ̄ the mean of Λ_n and Λ_{n+1}: ω̄·mean = −ΔU/Δt − c|ω̄|²."""
        a, b = self._error(q_n), self._error(q_next)
        return -kappa * self.gain * (a[0] * a[1:] + b[0] * b[1:]) - self.damping * omega

    def potential(self, q: Array) -> Array:
        """U = ½k tr(1 − Λ_dᵀΛ) = k(1 − cos φ) of the error's angle φ."""
        e = self._error(q)
        return 2 * self.gain * dot(e[1:], e[1:])

    def power(self, t: Array, q: Array, omega: Array) -> Array:
        """−c|ω|², the power of all but −∂U."""
        return -self.damping * dot(omega, omega)


def pd_trace(gain: ArrayLike, damping: ArrayLike, target: ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> PDTrace:
    """Control to an attitude Λ_d by the potential U = ½k tr(1 − Λ_dᵀΛ) and damping c: τ = −½k vex(ΛΛ_dᵀ) − cω.

    H = T + U falls by Δt c|ω̄|² in a step. A function of Λ alone: q and −q give the same torque, so the body takes the
    short way. The torque k sin φ vanishes at an error of φ = 180° too, where the body is at an unstable rest.

    Args:
        gain: k, a torque, > 0: small errors swing with √(k/J).
        damping: c ≥ 0, torque × time.
        target: Λ_d, a unit quaternion.

    Raises:
        ValueError: a negative gain or damping, a target that is no unit quaternion.

    Source: Koditschek 1989, Contemp. Math. 97; the mean torque of a step: this package.
    """
    return PDTrace(*_control(gain, damping, target))


@pytree
class PDQuaternion:
    """Proportional-derivative control by U = 2k(1 − e₀), in the body. Made by `pd_quaternion`."""

    gain: Array
    damping: Array
    target: Array
    frame = "body"

    def _error(self, q: Array) -> Array:
        """e, the quaternion of Λ_dᵀΛ."""
        return so3.multiply(so3.inverse(self.target), q)

    def __call__(self, t: Array, q: Array, omega: Array) -> Array:
        """−k(e₁, e₂, e₃) − cΩ."""
        return -self.gain * self._error(q)[1:] - self.damping * omega

    def mean(self, t: Array, q_n: Array, q_next: Array, h: Array, kappa: Array, omega: Array) -> Array:
        """−κk(e_n + e_{n+1})/(1 + √(1+|h|²)) − cΩ̄, of the vector parts: Ω̄·mean = −ΔU/Δt − c|Ω̄|²."""
        e = self._error(q_n)[1:] + self._error(q_next)[1:]
        return -kappa * self.gain / (1 + jnp.sqrt(1 + dot(h, h))) * e - self.damping * omega

    def potential(self, q: Array) -> Array:
        """U = 2k(1 − e₀) = 4k sin²(φ/4), φ the error's angle from 0 to 360°."""
        return 2 * self.gain * (1 - self._error(q)[0])

    def power(self, t: Array, q: Array, omega: Array) -> Array:
        """−c|ω|², the power of all but −∂U."""
        return -self.damping * dot(omega, omega)


def pd_quaternion(gain: ArrayLike, damping: ArrayLike, target: ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> PDQuaternion:
    """Control to an attitude by the potential U = 2k(1 − e₀), e = q_d⁻¹q, and damping c: T = −k(e₁, e₂, e₃) − cΩ.

    H = T + U falls by Δt c|Ω̄|² in a step. The torque k sin ½φ is largest at an error of φ = 180°, but q and −q, the
    same attitude, have different torques: **it unwinds**, that is, from e₀ < 0 the body turns by more than 180° to come
    to e₀ = 1. Give the state a q with e₀ ≥ 0 to take the short way.

    Args:
        gain: k, a torque, > 0: small errors swing with √(k/2J).
        damping: c ≥ 0, torque × time.
        target: q_d, a unit quaternion; −q_d is the other way round.

    Raises:
        ValueError: a negative gain or damping, a target that is no unit quaternion.

    Source: Wie & Barba 1985, J. Guid. Control Dyn. 8; unwinding: Bhat & Bernstein 2000, Syst. Control Lett. 39; the
    mean torque of a step: this package.
    """
    return PDQuaternion(*_control(gain, damping, target))


@pytree
class BDot:
    """τ = −k(|b|²ω − b(b·ω)) in space. Made by `bdot`."""

    gain: Array
    field: Any
    frame = "space"

    def __call__(self, t: Array, q: Array, omega: Array) -> Array:
        """k b × (b × ω)."""
        b = _at(self.field, t)
        return self.gain * jnp.stack(cross(b, cross(b, omega)))


def bdot(gain: ArrayLike, field: Any) -> BDot:
    """Magnetic detumbling: the moment m = −kḃ ≈ k ω × b of the coils in the field b gives τ = m × b = k b × (b × ω).

    Energy falls by Δt k|b × ω̄|² in a step. The turn about b itself is not damped: b must change its direction.

    Args:
        gain: k ≥ 0, torque × time / field².
        field: b in space, (3,), or a function of time with such values, such as the field along an orbit.

    Raises:
        ValueError: a negative gain, a field that is no vector and no function.

    Source: Stickler & Alfriend 1976, J. Spacecr. Rockets 13.
    """
    return BDot(_not_negative("gain", gain), _vector_of_time("field", field))


@pytree
class KaneDamper:
    """A sphere in a viscous fluid inside the body, whose momentum is `State.extra["damper"]`. Made by `kane_damper`."""

    inertia: Array
    damping: Array
    frame, key = "space", "damper"

    def during(self, dt: ArrayLike, extra: dict[str, Array] | None) -> DamperTorque:
        """The torque of one step, the sphere moving too."""
        if extra is None or self.key not in extra:
            raise ValueError(
                f'a body with a damper carries its momentum in State.extra["{self.key}"], (3,): make the state with '
                f'system.state(...), or give it one with state._replace(extra={{"{self.key}": …}})'
            )
        return DamperTorque(self.inertia, self.damping, extra[self.key], jnp.asarray(dt))

    def inner(self, omega: Array) -> Array:
        """The sphere's momentum where it turns with the body, (3,)."""
        return self.inertia * omega

    def inner_energy(self, momentum: Array) -> Array:
        """½|π_d|²/I_d."""
        return dot(momentum, momentum) / (2 * self.inertia)


@pytree
class DamperTorque:
    """τ̄ = −c(ω̄ − ω̄_d), the sphere being at π_d at the beginning of a step of size dt, and ω̄_d at its mean."""

    inertia: Array
    damping: Array
    momentum: Array
    dt: Array
    frame = "space"

    def __call__(self, t: Array, q: Array, omega: Array) -> Array:
        """−c(ω̄ − π_d/I_d)/(1 + ½cΔt/I_d), which is −c(ω̄ − ω̄_d)."""
        slip = omega - self.momentum / self.inertia
        return -self.damping / (1 + self.damping * self.dt / (2 * self.inertia)) * slip

    def power(self, t: Array, q: Array, omega: Array) -> Array:
        """τ̄·(ω̄ − ω̄_d) with I_d ω̄_d = π_d − ½Δtτ̄."""
        torque = self(t, q, omega)
        return dot(torque, omega - (self.momentum - self.dt / 2 * torque) / self.inertia)


def kane_damper(inertia: ArrayLike, damping: ArrayLike) -> KaneDamper:
    """Kane's damper: a sphere at the center that a viscous fluid couples to the body, τ = −c(ω − ω_d).

    The momentum of both, π + π_d, is conserved exactly, and the energy of both falls by Δt c|ω̄ − ω̄_d|² in a step,
    until they turn together about the body's axis of largest inertia. J is the body's without the sphere.

    Args:
        inertia: I_d > 0, the sphere's moment of inertia.
        damping: c ≥ 0, torque × time.

    Raises:
        ValueError: I_d ≤ 0, c < 0.

    Source: Kane, Likins & Levinson 1983, Spacecraft Dynamics; the implicit mean of a step: this package.
    """
    moment = _checks.real_array("inertia", inertia, ())
    if concrete(moment) and not float(moment) > 0:
        raise ValueError(f"inertia must be positive, the moment of inertia of the damper's sphere, got {moment}")
    return KaneDamper(moment, _not_negative("damping", damping))


@pytree
class Thruster:
    """A constant torque in the body from `start` to `stop`. Made by `thruster`."""

    torque: Array
    start: Array
    stop: Array
    frame = "body"

    def during(self, dt: ArrayLike, extra: dict[str, Array] | None) -> Pulse:
        """The mean torque over one step."""
        return Pulse(self.torque, self.start, self.stop, jnp.abs(jnp.asarray(dt)))

    def __call__(self, t: Array, q: Array, omega: Array) -> Array:
        """T while it fires, else 0."""
        return self.during(0.0, None)(t, q, omega)


@pytree
class Pulse:
    """The torque of a thruster times the part of a step of length `duration` about t in which it fires."""

    torque: Array
    start: Array
    stop: Array
    duration: Array
    frame = "body"

    def __call__(self, t: Array, q: Array, omega: Array) -> Array:
        """T times the part of the step in which it fires."""
        begin, end = t - self.duration / 2, t + self.duration / 2
        overlap = jnp.minimum(end, self.stop) - jnp.maximum(begin, self.start)
        fires = (self.start <= t) & (t < self.stop)
        long = self.duration > 0
        part = jnp.clip(overlap / jnp.where(long, self.duration, 1), 0, 1)
        return jnp.where(long, part, fires) * self.torque


def thruster(torque: ArrayLike, start: ArrayLike, stop: ArrayLike) -> Thruster:
    """A pulse: the torque T, constant in the body, from time `start` to time `stop`.

    A step that the pulse begins or ends in has the torque of its part of the step: ∫T dt = T·(stop − start) whatever
    the steps are, and the derivatives with respect to start and stop are right. Order 2 needs steps that end there.

    Args:
        torque: T in the body, (3,).
        start, stop: times, start ≤ stop, on the clock of `State.t`.

    Raises:
        ValueError: stop < start, a torque that is no vector.
    """
    first, last = _checks.real_array("start", start, ()), _checks.real_array("stop", stop, ())
    if concrete(first, last) and float(last) < float(first):
        raise ValueError(f"a pulse must not stop before it starts, got start = {first} and stop = {last}")
    return Thruster(_checks.real_array("torque", torque, (3,)), first, last)


@pytree
class SolarPlate:
    """The torque of sunlight on a flat plate, in the body. Made by `solar_plate`."""

    force: Array
    normal: Array
    arm: Array
    sun: Any
    specular: Array
    diffuse: Array
    frame = "body"

    def __call__(self, t: Array, q: Array, omega: Array) -> Array:
        """r × F(Λᵀs)."""
        s = so3.Ad_star(q, _at(self.sun, t))
        cosine = dot(self.normal, s)
        lit = self.force * jnp.abs(cosine)  # either side may face the Sun
        along = 2 * (self.specular * cosine + jnp.sign(cosine) * self.diffuse / 3)
        push = add(scale(-lit * (1 - self.specular), s), scale(-lit * along, self.normal))
        return jnp.stack(cross(self.arm, push))


def solar_plate(
    force: ArrayLike,
    normal: ArrayLike,
    arm: ArrayLike,
    sun: Any,
    specular: ArrayLike = 0.0,
    diffuse: ArrayLike = 0.0,
) -> SolarPlate:
    """The pressure of sunlight on a flat plate, both sides of which reflect alike: T = r × F with

        F = −f|cos ϑ| [(1 − ρ_s)s + 2(ρ_s cos ϑ ± ρ_d/3)n],    cos ϑ = n·s,

    ± the sign of cos ϑ, as of a sail or a panel without a shadow. Energy changes by ΔtΩ̄·T̄ in a step.

    Args:
        force: f, pressure × area, such as 4.56e-6 N/m² × A at 1 au.
        normal: n in the body, (3,), a unit vector.
        arm: r, from the body's center of mass to the plate's center of pressure, in the body, (3,).
        sun: s in space, (3,), the unit vector to the Sun, or a function of time with such values.
        specular, diffuse: ρ_s and ρ_d ≥ 0, the parts of the light that are reflected so, ρ_s + ρ_d ≤ 1.

    Raises:
        ValueError: a vector of another shape, a normal or a Sun that is not of unit length, parts out of range.

    Source: McInnes 1999, Solar Sailing, chapter 2 (the optical model of a plate, without thermal emission).
    """
    parts = [_not_negative(name, x) for name, x in (("specular", specular), ("diffuse", diffuse))]
    if concrete(*parts) and float(parts[0]) + float(parts[1]) > 1:
        raise ValueError(f"specular + diffuse must be at most 1, got {parts[0]} + {parts[1]}")
    return SolarPlate(
        _not_negative("force", force),
        _unit("normal", normal),
        _checks.real_array("arm", arm, (3,)),
        _vector_of_time("sun", sun) if callable(sun) else _unit("sun", sun),
        *parts,
    )


def internal_friction(friction: ArrayLike, Pi: vec3.Vector, Omega: vec3.Vector) -> vec3.Vector:
    """α Π × Ω, the angular velocity that internal friction adds to Ω (`systems.damped_body`), in components.

    Π̇ = Π × (Ω + αΠ × Ω), the double bracket: |Π| and π stay, and Ḣ = −α|Π × Ω|², until the body turns about its axis
    of largest inertia with H = |π|²/2J₃.

    Source: Bloch, Krishnaprasad, Marsden & Ratiu 1996, Commun. Math. Phys. 175.
    """
    return scale(friction, cross(Pi, Omega))


def _at(vector: Any, t: Array) -> Any:
    """A vector that may be a function of time."""
    return vector(t) if callable(vector) else vector


def _vector_of_time(name: str, value: Any) -> Any:
    return callable_pytree(value) if callable(value) else _checks.real_array(name, value, (3,))


def _not_negative(name: str, value: ArrayLike) -> Array:
    number = _checks.real_array(name, value, ())
    if concrete(number) and float(number) < 0:
        raise ValueError(f"{name} must not be negative, got {float(number):g}")
    return number


def _damping(damping: ArrayLike, *shapes: tuple[int, ...]) -> Array:
    D = _checks.real_array("damping", damping, *shapes)
    if concrete(D):
        values = np.asarray(D, float)
        if values.ndim == 2:
            if not np.allclose(values, values.T, rtol=1e-6, atol=1e-6 * np.abs(values).max()):
                raise ValueError(f"damping must be symmetric, got\n{values}\nGive (D + D.T) / 2")
            values = np.linalg.eigvalsh(values)
        if values.min() < -1e-12 * np.abs(values).max():
            raise ValueError(f"damping must not be negative, got principal values {values}")
    return D


def _control(gain: ArrayLike, damping: ArrayLike, target: ArrayLike) -> tuple[Array, Array, Array]:
    target = so3.normalize(_checks.unit_quaternion("target", target))
    return _not_negative("gain", gain), _not_negative("damping", damping), target


def _unit(name: str, value: ArrayLike) -> Array:
    vector = _checks.real_array(name, value, (3,))
    if concrete(vector) and abs(np.linalg.norm(np.asarray(vector, float)) - 1) > _checks.UNIT_TOLERANCE:
        raise ValueError(f"{name} must be a unit vector, got {np.asarray(vector)}; divide it by its length")
    return vector
