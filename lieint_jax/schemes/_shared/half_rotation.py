"""Half the rotation of an energy-momentum step, h = ½Θ of (2.24), (3.3), by the scalar or the vector form of (3.4)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._numerics import newton
from lieint_jax.capabilities import AbstractFreeBody, AbstractGyrostat
from lieint_jax.groups import so3
from lieint_jax.maps import Kappa
from lieint_jax.schemes._shared.rounding import attitude_error_limit
from lieint_jax.schemes._shared.scalar_form import solve_scalar
from lieint_jax.schemes._shared.vector_form import solve_vector
from lieint_jax.types import State, StepInfo
from lieint_jax.types.shapes import Vector3
from lieint_jax.types.vectors import Symmetric, VectorLike, max_abs, unit_trace

ITERATIONS = {"scalar": 3, "vector": 4}  # Newton corrections per step, by the form of the equation


def half_rotation(
    J: Symmetric, a: Vector3, kappa: Kappa, iterations: int, b: Vector3 | None = None
) -> tuple[VectorLike, StepInfo]:
    """h = ½Θ of a step, shape (3,), from J and a as in `scaled` and b as in `bias`, and its report."""
    if kappa.solve_by == "scalar" and b is None:
        h, residual, good = solve_scalar(J, a, iterations)
    else:
        h, residual, good = solve_vector(kappa, J, a, iterations, b)
        good &= jnp.finfo(a.dtype).eps * _size(a, b) * J.inverse_trace <= attitude_error_limit(a.dtype)
    return h, newton.report(max_abs(residual), good & J.well_conditioned, _size(a, b))


def scaled(system: AbstractFreeBody | AbstractGyrostat, state: State, dt: ArrayLike) -> tuple[Symmetric, Vector3]:
    """J and a = ½Δt Π_n, both over tr J: then |a| is an angle, and no power of a large inertia overflows."""
    J, r = unit_trace(system.inertia)
    return J, (0.5 * r * dt) * so3.Ad_star(state.q, state.p)


def bias(system: AbstractFreeBody | AbstractGyrostat, dt: ArrayLike) -> Vector3 | None:
    """b = ½Δt h_r over tr J; None for a free body."""
    return (0.5 * unit_trace(system.inertia)[1] * dt) * system.rotor if isinstance(system, AbstractGyrostat) else None


def _size(a: Vector3, b: Vector3 | None) -> Array:
    """The size of the terms of the vector form."""
    return max_abs(a) if b is None else max_abs(a, b)
