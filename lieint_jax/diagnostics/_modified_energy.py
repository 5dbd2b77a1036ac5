"""The modified Hamiltonian that a splitting conserves: its first terms, by derivatives along the parts.

A step X/2, Y, X/2 of the exact flows of two parts of H = X + Y is, up to terms that are exponentially small, the exact
flow of H + Δt²H₂ + Δt⁴H₄ + …, with Poisson brackets

    H₂ = −{X,{X,Y}}/24 − {Y,{X,Y}}/12
    H₄ = 7{X,X,X,X,Y}/5760 + {Y,X,X,X,Y}/360 + {X,Y,X,X,Y}/480 + {Y,Y,X,X,Y}/120 − {X,Y,Y,X,Y}/360 + {Y,Y,Y,X,Y}/720

where {A,B,…} = {A,{B,…}}. As {A, f} = −L_A f, the derivative of −f along the flow of A, all of them are derivatives
along known vector fields, of one scalar: {V, T} = L_T V, the rate of the potential in free motion, −force·velocity.

Where the potential depends on time, the free motion advances it, and H − W is conserved in place of H.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import vectors
from lieint_jax._xla import compiled
from lieint_jax.core import State, Step, checked_step, clock, energy_less_work, promoted
from lieint_jax.groups import so3
from lieint_jax.schemes import FreeFlight, GyrostatSplitting, SO3Midpoint, Splitting
from lieint_jax.systems import AbstractBodyInTime, AbstractDrivenSystem

_Scalar = Callable[[State], Array]
_Field = Callable[[State], State]
_H2 = {"X": -1 / 24, "Y": -1 / 12}  # by the brackets with {X, Y}, the outermost first
_H4 = {"XXX": 7 / 5760, "YXX": 1 / 360, "XYX": 1 / 480, "YYX": 1 / 120, "XYY": -1 / 360, "YYY": 1 / 720}


def modified_energy(step: Step, state: State, dt: ArrayLike, order: int = 4) -> Array:
    """The modified energy of a symplectic splitting, H − W + Δt²H₂ + Δt⁴H₄: conserved to a higher order in Δt than H.

    Along a run of `splitting` the energy oscillates by O(Δt²), but the modified energy varies by O(Δtᵒʳᵈᵉʳ) only. It
    distinguishes a drift of the energy from an oscillation that is sampled too rarely, and the size of its terms shows
    whether Δt is small. Use jax.vmap for the states of a run.

    Args:
        step: a step of `splitting`, for tops, satellites, gyrostats, several bodies or groups. The drift must be exact
            to `order`, such as `exact(system.free)`; or it is the symplectic `so3_midpoint`, whose error adds a term T₂
            to H₂, with order 4.
        state: a state of its system.
        dt: step size.
        order: 4 includes H₂; 6 also H₄, with third derivatives of the force, which on a Kepler orbit compiles for
            minutes.

    Returns:
        The modified energy, a scalar.

    Raises:
        ValueError: the step is not a splitting, the order is none of these, or the drift is not exact to this order.

    Source: Hairer, Lubich & Wanner, Geometric Numerical Integration, IX.3 and III.4.2; T₂: this package.
    """
    order = _checks.listed("order", order, (4, 6), "; 4 includes H₂, 6 also H₄")
    step, state, dtype = promoted(checked_step(step), state)
    if not isinstance(step, Splitting | GyrostatSplitting):
        raise ValueError(
            f"the modified energy is known for schemes.splitting(…) except of elastic bodies, got {step.name}"
        )
    _check_drift(step.drift, order)
    return _modified_energy(step, state, jnp.asarray(_checks.step_size(dt), dtype), order)


def _check_drift(drift: Step, order: int) -> None:
    """ValueError unless the error of a drift is known to this order."""
    turn: Step = drift.turn if isinstance(drift, FreeFlight) else drift
    midpoint = isinstance(turn, SO3Midpoint) and turn.kappa.symplectic
    if turn.order >= order or (midpoint and order == 4):
        return
    raise ValueError(
        f"the drift {drift.name} must be exact to order {order}, such as schemes.exact(system.free) or "
        f"schemes.preprocessed(system.free, 10){'; for order 4 the symplectic so3_midpoint too' if order == 4 else ''}"
    )


@partial(compiled, static_argnums=3)
def _modified_energy(step: Splitting | GyrostatSplitting, state: State, dt: Array, order: int) -> Array:
    parts = _parts(step)
    z = state._replace(work=None, extra=None)  # on which the parts of H do not depend
    terms = dt**2 * _brackets(parts, _H2)(z)
    if order == 6:
        terms = terms + dt**4 * _brackets(parts, _H4)(z)
    return energy_less_work(step.system, state) + terms + dt**2 * _drift_error(step, z)


class _Parts(NamedTuple):
    """The outer part X and the inner part Y of a step.

    Attributes:
        fields: the vector fields of both, by letter.
        base: {X, Y}.
    """

    fields: dict[str, _Field]
    base: _Scalar


def _parts(step: Splitting | GyrostatSplitting) -> _Parts:
    """Kicks and drifts; for a gyrostat, rotations by the rotor and the motion of the free body."""
    if isinstance(step, GyrostatSplitting):
        return _rotor_parts(step)
    system: Any = step.system
    driven = isinstance(system, AbstractDrivenSystem)

    def drift(z: State) -> State:
        moving = system.free.vector_field(z)
        return z._replace(q=moving.q, p=moving.p, t=None if z.t is None else jnp.ones_like(z.t))

    def force(z: State) -> Array:
        return system.force(z.q, clock(z)) if driven else system.force(z.q)

    def kick(z: State) -> State:
        return z._replace(q=jnp.zeros_like(z.q), p=force(z), t=_zero_time(z))

    def rate(z: State) -> Array:
        """{V, T} = L_T V: the rate of V in free motion, −force·velocity, and ∂V/∂t."""
        velocity = system.phase_space.trivialize(z, drift(z))[: z.p.size]
        power = system.power(z.q, clock(z)) if driven else 0.0
        return power - jnp.sum(force(z).ravel() * velocity)

    if step.kick_first:
        return _Parts({"X": kick, "Y": drift}, rate)
    return _Parts({"X": drift, "Y": kick}, lambda z: -rate(z))


def _rotor_parts(step: GyrostatSplitting) -> _Parts:
    """X = −c·Π with c = J⁻¹h_r, Y the energy of the free body: {X, Y} = −c·(Π × Ω)."""
    system = step.system
    J = vectors.symmetric(system.inertia)
    velocity = J.solve(system.rotor)

    def drift(z: State) -> State:
        moving = system.free.vector_field(z)
        return z._replace(q=moving.q, p=moving.p, t=_zero_time(z))

    def rotate(z: State) -> State:
        return z._replace(q=so3.tangent(z.q, -jnp.stack(velocity)), p=jnp.zeros_like(z.p), t=_zero_time(z))

    def rate(z: State) -> Array:
        Pi = so3.Ad_star(z.q, z.p)
        return -vectors.dot(velocity, vectors.cross(Pi, J.solve(Pi)))

    return _Parts({"X": rotate, "Y": drift}, rate)


def _zero_time(z: State) -> Array | None:
    return None if z.t is None else jnp.zeros_like(z.t)


def _lie_derivative(function: _Scalar, field: _Field) -> _Scalar:
    """The derivative of a function along a vector field."""
    return lambda z: jax.jvp(function, (z,), (field(z),))[1]


def _brackets(parts: _Parts, coefficients: dict[str, float]) -> _Scalar:
    """The sum of nested brackets {a,{b,…{X,Y}}}, by the letters ab…; {a, f} = −L_a f."""
    if "" in coefficients:
        scale = coefficients[""]
        return lambda z: scale * parts.base(z)
    inner = {
        letter: {word[1:]: c for word, c in coefficients.items() if word[0] == letter}
        for letter in {word[0] for word in coefficients}
    }
    slopes = [_lie_derivative(_brackets(parts, inner[letter]), parts.fields[letter]) for letter in sorted(inner)]
    return lambda z: -sum((slope(z) for slope in slopes[1:]), slopes[0](z))


def _drift_error(step: Splitting | GyrostatSplitting, z: State) -> Array:
    """The T₂ of a symplectic `so3_midpoint`, s₁T²/6 − s₂T|Π|²/12 + s₃|Π|⁴/24; a quarter of it for two halves of a step.

    s_i are the elementary symmetric functions of 1/J₁, 1/J₂, 1/J₃. Of several bodies, the sum.
    """
    drift, weight = step.drift, 1.0
    if isinstance(step, Splitting) and not step.kick_first:
        weight = 0.25
    if isinstance(drift, FreeFlight) and isinstance(drift.turn, SO3Midpoint):
        each = jax.vmap(_midpoint_error)(drift.system.inertias, z.q[:, 3:], z.p[:, 3:])
        return weight * jnp.sum(each)
    if isinstance(drift, SO3Midpoint) and not isinstance(drift.system, AbstractBodyInTime):
        return weight * _midpoint_error(drift.system.inertia, z.q, z.p)
    return jnp.zeros_like(z.p.ravel()[0])


def _midpoint_error(inertia: Array, q: Array, p: Array) -> Array:
    J, Pi = vectors.symmetric(inertia), so3.Ad_star(q, p)
    T, square = vectors.dot(Pi, J.solve(Pi)) / 2, vectors.dot(Pi, Pi)
    adjugate = J.adjugate
    det = J.det(adjugate)
    s1, s2, s3 = adjugate.trace / det, J.trace / det, 1 / det
    return s1 / 6 * T * T - s2 / 12 * T * square + s3 / 24 * square * square
