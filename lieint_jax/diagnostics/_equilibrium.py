"""Relative equilibria: motions along a symmetry of the system, found as critical points of the amended energy.

    K(x) = H(x) − ω·π − ξ·Φ(x),    dK = 0

Φ is the momentum map of the system's symmetries and ξ the rates of the motion along them: ẋ = Σ ξ_a x_a with the
generator x_a of Φ_a. Where the system is driven by a field that rotates in space with the angular velocity ω, such as
that along a circular orbit, K is its energy in the axes that rotate with the field.

A body that is symmetric about an axis a of its own, in inertia and field, may spin about it at a rate of its own: Π·a
is conserved, and joins Φ.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._xla import compiled
from lieint_jax.core import State, System, promoted
from lieint_jax.core.tangent import units, units_at_start
from lieint_jax.diagnostics._critical_point import Correction, Problem, Spins, in_double, is_attitude, rounded
from lieint_jax.groups import so3
from lieint_jax.systems import AbstractDrivenTop, AbstractRigidBodies


class Equilibrium(NamedTuple):
    """A relative equilibrium. Made by `equilibrium`.

    Attributes:
        state: the state.
        rates: ξ, (k,), the rate of the motion along each symmetry, in the order of `system.momentum`: for a free body
            its angular velocity in space, for a top the rate about its axis, for several bodies their common velocity
            and angular velocity, then the rate of each spinning body about its own axis, less the common one. (0,) for
            a system without known symmetries.
        frame: ω, (3,), the angular velocity of the axes in space in which the field is constant; 0 if it is at rest.
        residual: how far the equilibrium may be from the state, as Newton's step and its rounding errors tell, in the
            units of `moved`. It grows with the ratio of stiffnesses, as rounding hides soft directions; above 1e-3 no
            equilibrium is found.
        moved: the largest change of a coordinate from the guess, in radians, or in units of the largest momentum, at
            rest of one that swings by a radian; for systems with a unit of length, in that unit.
        change: the change of every coordinate of the phase space, (2d,): of N bodies, `change.reshape(2, N, 6)` has the
            shift of each position and the rotation in radians, then the changes of both momenta.
        spins: the bodies that spin at rates of their own, and their axes.
    """

    state: State
    rates: Array
    frame: Array
    residual: Array
    moved: Array
    change: Array
    spins: Spins | None = None


def equilibrium(
    system: System,
    guess: State,
    *,
    free: Sequence[int] | None = None,
    frame: ArrayLike | None = None,
    spinning: Sequence[int] = (),
) -> Equilibrium:
    """A relative equilibrium near a guess: a steady spin, a satellite at rest in its orbit frame, a synchronous binary.

    It is computed by Newton's method for dK = 0, in the state and the rates ξ together. Relative equilibria come in
    families, such as spins of any rate: of all corrections that Newton's equation allows, the shortest in the units of
    the state is used. So a guess that is an equilibrium does not change, and a guess near one changes little; `moved`
    is by how much. `free` selects the coordinates that may change.

    At a relative equilibrium all bodies rotate at one rate, that of the common motion: a binary is synchronous on both
    sides. From a guess in which one body rotates faster the positions change too, until that rate is the common one,
    unless that body is among the `spinning`.

    Args:
        system: a Hamiltonian system, with its known symmetries in `momentum`. It may be driven by an axis that rotates
            uniformly, as in `systems.gravity_gradient` on a circular orbit.
        guess: a state. In a driven system its time, which is not varied, determines the axis.
        free: the coordinates of the phase space that may change, numbers from 0 to 2d − 1; by default all. On T*SO(3)
            they are δθ and δπ in space; for N bodies, 6 for each body's δx and δθ, then 6 for each one's δp and δπ.
        frame: the angular velocity in space, (3,), of the axes in which a driven body's field is constant; by default
            that of the system's `axis`, or 0.
        spinning: numbers of bodies of `systems.rigid_bodies` that may rotate at rates of their own, such as `(0,)` for
            the fast primary of a synchronous secondary. Each must be symmetric about its axis of spin: its other two
            moments are equal, and the potential does not change as it rotates about that axis.

    Returns:
        An `Equilibrium`; `normal_modes` gives its modes and its stability.

    Raises:
        ValueError: no equilibrium is found near the guess, the system is not Hamiltonian or its field is not constant
            in rotating axes, coordinates are out of range, or a spinning body is not symmetric.

    Example:
        >>> import lieint_jax as li
        >>> satellite = li.systems.gravity_gradient([1.0, 2.0, 2.5], li.orbits.kepler(1.0, 1.0, 0.0))
        >>> guess = satellite.state(angular_velocity=[0.1, 0.0, 0.9], t=0.0)
        >>> found = li.equilibrium(satellite, guess)
        >>> round(float(satellite.angular_velocity(found.state)[2]), 6)
        1.0

    Source: Marsden, Lectures on Mechanics (1992), 4.1 (the augmented Hamiltonian).
    """
    system, state, dtype = promoted(system, guess)
    if not concrete(system, state, frame):
        raise ValueError("equilibrium computes with concrete numbers: call it outside of jit, vmap and grad")
    with jax.enable_x64(True):
        found = _equilibrium(in_double(system), in_double(state), free, frame, spinning, float(np.finfo(dtype).eps))
    found = rounded(found, dtype)
    return found._replace(residual=jnp.maximum(found.residual, jnp.finfo(dtype).eps))


def _equilibrium(
    system: System,
    start: State,
    free: Sequence[int] | None,
    frame: ArrayLike | None,
    spinning: Sequence[int],
    eps: float,
) -> Equilibrium:
    system.check(start)
    omega, dim = frame_of(system, start, frame, eps), system.phase_space.dim
    chosen = np.arange(dim) if free is None else np.asarray(free, int)
    if chosen.ndim != 1 or not chosen.size or chosen.min() < 0 or chosen.max() >= dim:
        raise ValueError(f"free must be coordinates of the phase space, from 0 to {dim - 1}, got {free!r}")
    spins = _symmetric_spins(system, start, spinning, 1e3 * eps) if np.ndim(spinning) == 0 or len(spinning) else None
    problem = Problem(system, omega, spins, chosen)
    state, last = problem.solved(start)
    if not last.is_rounding:
        raise ValueError(_not_found(system, last))
    change, rates = system.phase_space.displacement(start, state), problem.derivatives(state).rates()
    residual, moved = jnp.asarray(last.distance), jnp.max(jnp.abs(change) / last.unit)
    return Equilibrium(state, jnp.asarray(rates), omega, residual, moved, change, spins)


def _not_found(system: System, last: Correction) -> str:
    several = isinstance(system, AbstractRigidBodies)
    return (
        f"no relative equilibrium was found near this state: Newton's step from the last one is {last.size:.2g} in "
        f"units of the state, its rounding error {float(last.rounding.max()):.2g}, and the force that no step removes "
        f"{last.force:.2g} rounding errors. Give a closer guess, or free more coordinates"
        + (". All bodies rotate at one rate there, but those that you list as spinning" if several else "")
    )


def _symmetric_spins(system: System, state: State, bodies: Sequence[int], tolerance: float) -> Spins:
    """The axes about which these bodies are symmetric; ValueError if one is not."""
    if not isinstance(system, AbstractRigidBodies):
        raise ValueError(f"spinning is for bodies of systems.rigid_bodies, got {type(system).__name__}")
    numbers, n = np.asarray(bodies), len(system.masses)
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu" or numbers.min() < 0 or numbers.max() >= n:
        raise ValueError(f"spinning must be numbers of bodies, from 0 to {n - 1}, got {bodies!r}")
    Omega = np.asarray(system.angular_velocities(state))
    spins = Spins(jnp.asarray(numbers), jnp.stack([_axis(system.inertias[i], Omega[i], tolerance, i) for i in numbers]))
    turning = np.asarray(_torques_about(system, state, spins))
    for i, relative in zip(numbers, turning, strict=True):
        if not relative <= tolerance:
            raise ValueError(
                f"body {i} cannot spin at a rate of its own in a relative equilibrium: the potential exerts a torque "
                "about its axis of symmetry, so its field is not symmetric. Leave it out of spinning"
            )
    return spins


def _axis(inertia: Array, Omega: np.ndarray, tolerance: float, body: int) -> Array:
    """The axis of symmetry of an inertia; of a spherical one the axis of the spin."""
    J = np.asarray(inertia, float)
    moments, axes = np.linalg.eigh(np.diag(J) if J.ndim == 1 else J)
    equal = np.diff(moments) <= tolerance * moments[2]
    if not equal.any():
        raise ValueError(
            f"body {body} cannot spin at a rate of its own in a relative equilibrium: its principal moments {moments} "
            "differ. Give it two equal ones, about the axes across its spin, or leave it out of spinning"
        )
    axis = axes[:, 2 if equal[0] else 0]
    if equal.all():
        axis = Omega / np.linalg.norm(Omega) if Omega.any() else np.array([0.0, 0.0, 1.0])
    return jnp.asarray(axis, inertia.dtype)


@partial(compiled, once=True)
def _torques_about(system: AbstractRigidBodies, state: State, spins: Spins) -> Array:
    """The greatest torques about the axes at attitudes near the given ones, relative to |x||f| and |τ| of all."""
    space = system.phase_space
    offsets = 0.3 * jnp.asarray(np.sin(np.outer([1.0, 2.3, 3.1], 1.7 + np.arange(space.dim))), state.q.dtype)

    def torque(offset: Array) -> Array:
        q = space.perturb(state, offset * jnp.concatenate(units(space, state))).q
        force = system.force(q)
        about = jax.vmap(so3.Ad_star)(q[spins.bodies, 3:], force[spins.bodies, 3:])
        levers = q[:, :3] - jnp.mean(q[:, :3], axis=0)
        size = jnp.max(jnp.abs(levers)) * jnp.max(jnp.abs(force[:, :3])) + jnp.max(jnp.abs(force[:, 3:]))
        return jnp.abs(jnp.sum(about * spins.axes, axis=1)) / jnp.where(size > 0, size, 1)

    return jnp.max(jax.vmap(torque)(offsets), axis=0)


def frame_of(system: System, state: State, given: ArrayLike | None, eps: float) -> Array:
    """ω; ValueError unless the motion in axes that rotate with ω has a time-independent Hamiltonian.

    `eps` is that of the numbers in which the system was given.
    """
    dtype = state.p.dtype
    if given is not None:
        omega = _checks.real_array("frame", given, (3,)).astype(dtype)
        if not is_attitude(system) and np.any(np.asarray(omega)):
            raise ValueError("frame is for the attitude of a body, a system on T*SO(3)")
    elif isinstance(system, AbstractDrivenTop) and callable(system.axis):
        omega = _axis_rate(system, state)
    else:
        omega = jnp.zeros(3, dtype)
    varying, mismatch = (float(x) for x in _defects(system, state, omega, units_at_start(system, state)))
    tolerance = eps**0.5
    if not varying <= tolerance:
        raise ValueError(
            f"in axes that rotate with {np.asarray(omega)} the energy depends on time, by {varying:.2g} of its "
            "gradient: a relative equilibrium needs a field at rest or one that rotates uniformly, such as that along "
            "a circular orbit. Give its angular velocity as frame=…"
        )
    if not mismatch <= tolerance:
        raise ValueError(
            f"the motion of a {type(system).__name__} is not that of its energy and phase space alone: they differ by "
            f"{mismatch:.2g} of the motion. It dissipates, or is driven by a force that the energy does not contain"
        )
    return omega


@partial(compiled, once=True)
def _axis_rate(system: Any, state: State) -> Array:
    """γ̇ × γ̈ / |γ̇|² at the time of the state: ω of an axis that rotates uniformly."""
    velocity = jax.jacfwd(system.axis_at)
    first, second = velocity(state.t), jax.jacfwd(velocity)(state.t)
    square = jnp.sum(first * first)
    return jnp.where(square > 0, jnp.cross(first, second) / jnp.where(square > 0, square, 1), 0)


@partial(compiled, once=True)
def _defects(system: System, state: State, omega: Array, unit: Array) -> tuple[Array, Array]:
    """The change of H with time in the rotating axes, and the difference of ẋ from the Hamiltonian field, relative.

    They are measured over a revolution, at states near the given one, where neither vanishes by symmetry.
    """
    space = system.phase_space
    offsets = 0.05 * jnp.asarray(np.sin(np.outer([1.0, 2.3, 3.1], 1.7 + np.arange(space.dim))), unit.dtype)

    def energy(z: State, s: Array) -> Array:
        turn = so3.exp(s * omega)
        if is_attitude(system):
            z = z._replace(q=so3.multiply(turn, z.q), p=so3.Ad(turn, z.p))
        return system.energy(z if z.t is None else z._replace(t=z.t + s))

    def defects(offset: Array, part: Array) -> tuple[Array, Array]:
        z = space.perturb(state, unit * offset)
        rate = jnp.sqrt(omega @ omega)
        s = part / jnp.where(rate > 0, rate, 1)
        slope = jax.jacfwd(energy, 1)(z, s)
        gradient = jax.grad(lambda delta: system.energy(space.perturb(z, delta)))(jnp.zeros_like(unit))
        field = -jnp.linalg.solve(unit[:, None] * space.omega(z) * unit, unit * gradient)
        moving = system.vector_field(z)
        actual = space.trivialize(z, State(moving.q, moving.p)) / unit
        size = jnp.max(jnp.abs(gradient * unit))
        scale = jnp.maximum(jnp.max(jnp.abs(field)), jnp.max(jnp.abs(actual)))
        frequency = jnp.maximum(jnp.where(rate > 0, rate, 0), scale)
        return (
            jnp.abs(slope) / jnp.where(size > 0, size * frequency, 1),
            jnp.max(jnp.abs(field - actual)) / jnp.where(scale > 0, scale, 1),
        )

    varying, mismatch = jax.vmap(defects)(offsets, jnp.array([0.3, 1.9, 4.1], unit.dtype))
    return jnp.max(varying), jnp.max(mismatch)
