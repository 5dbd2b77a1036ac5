"""The energy–momentum scheme for several rigid bodies: energy, linear and angular momentum, all three to round-off.

    x_{n+1} = x_n + Δt p̄/m,   p_{n+1} = p_n + Δt f̄,   Λ_{n+1} = Λ_n cay Θ̄,   π_{n+1} = π_n + Δt τ̄

with Θ̄ = Δt J⁻¹ ½(Π_n + Π_{n+1}): each body moves by the scheme κ = 1 (Cayley) of the paper's family. The potential is
a function Ṽ of invariants I of the relative positions and attitudes that are quadratic in (x, Λ). With a discrete
gradient D of Ṽ, D·ΔI = ΔV, the forces are the derivatives of w(x, Λ) = D·I(x, Λ) at x̄ and Λ̄ = ½(Λ_n + Λ_{n+1}),

    f̄ = −∂w/∂x,   τ̄ = −∂w(x̄, (1 + δ̂)Λ̄)/∂δ at δ = 0

As I is quadratic, their work is −ΔV; as w is invariant, their sums Σf̄ and Σ(x̄ × f̄ + τ̄) vanish. Any other κ violates
the balance of angular momentum: κ_i τ̄_i in place of τ̄_i conserves energy, but ΔL = Δt Σ(κ_i − 1)τ̄_i.

A law of dissipation f(r, v, ω_i, ω_j) is evaluated at r̄, v̄ = Δr/Δt and ω̄ = θ̄/Δt, θ̄ = Λ_nΘ̄, and adds to f̄ and τ̄.
Forces and torques do work along (Δx, θ̄), so the energy decreases by Δt times the dissipated power at these means,
which is never negative. The forces balance at x̄, so P and L are still conserved. Given forces are evaluated at the same
means, at the time t̄ and at the attitudes half-way. Their work raises or lowers H, and their impulses are ΔP = Δt Σf̄ and
ΔL = Δt Σ(x̄ × f̄ + τ̄), exactly. A potential in which some poses are given functions of time has their mean in place of
x̄ and Λ̄, and the derivative of w by these poses times their change is the work that enters there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._checks import at_once, choice, concrete, count, named
from lieint_jax._numerics.vectors import cross, matrix, symmetric, unit_trace, vector
from lieint_jax._xla import compiled
from lieint_jax.core import Converted, State, Step, StepInfo, argument, pytree, static
from lieint_jax.groups import so3
from lieint_jax.potentials import Potential, SumPotential, given_poses, invariant_form, is_chain, torques
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.equation import ChainEquation, FixedPointEquation
from lieint_jax.systems._equations import AbstractDissipativeBodies, AbstractRigidBodies

__all__ = ["bodies_energy_momentum"]


class _Ends(NamedTuple):
    """The unknowns of a step: the displacements Δx of the centers, (N, 3), and y = ½Θ̄ of the rotations, (N, 3)."""

    move: Array
    turn: Array


PROPERTIES = SchemeProperties(
    name="bodies_energy_momentum",
    systems="several bodies, with dissipation or given forces too",
    conserves=("energy", "energy less work", "momentum"),
    limit="|ΔtΩ| of 2 to 4 for the Cayley κ",
    aliases=("energy–momentum method",),
    source="Lewis & Simo 1994, Results 1 to 3, for several bodies: this package",
    accepts=(AbstractRigidBodies, AbstractDissipativeBodies),
)


@pytree
class BodiesEnergyMomentum(Step):
    """The energy–momentum scheme for N rigid bodies in a potential of their relative positions and attitudes.

    | conserved | to |
    |---|---|
    | energy | round-off, for potentials of `lieint_jax.potentials`; for others up to the rounding of their values |
    | with dissipation, energy less work (`State.work`), with work ≤ 0 in each step | round-off |
    | with given forces, energy less work of either sign; P and L less their impulses | round-off |
    | P and L, if the potential is invariant | round-off |
    | the symplectic form | no: defect O(Δt³) per step |

    The scheme is of second order and time-symmetric. Its relative phase error is (Δt Ω)²/12, large for fast spins: use
    it for exact conservation, and `splitting`, `nystrom` or `kepler_splitting` for accuracy.

    | solver | a step is solved by | converges |
    |---|---|---|
    | "fixed_point" | iterations on the forces, with a Newton correction of each body's rotation | for Δt Ω < 1 |
    | "newton" | Newton's method, with the matrix of all bodies, or a block-tridiagonal one of a chain | if stiff too |

    Here Ω is the highest frequency of the potential. The cost of both is proportional to the length of a chain such as
    a rod; N bodies that are no chain have a matrix of (6N)² numbers, whose cost is O(N³). With "newton" dt must resolve
    the bending of a rod, not its extension: a step that jumps to another solution, or in which a rod buckles, reports
    `converged=False`. Rounding of the energy grows with Δt Ω.

    Args:
        system: `systems.rigid_bodies(...)`. A plain function as its potential is evaluated at the positions and
            attitudes relative to the first body; it must be smooth also for matrices near rotations.
        iterations: the most iterations of a step in float64, and for fewer digits in proportion: a near-collision that
            needs more reports `converged=False`. The default requires each iteration to halve the error on average. A
            larger number accepts slower convergence, which may end at another solution of the equations than the one
            that begins at Δt = 0.
        solver: "fixed_point" or "newton"; None selects "newton" if the potential is that of a chain
            (`Potential.chain`). The matrix of a chain contains forces between neighbors; dissipation and given forces
            between other bodies must be weak, or steps report `converged=False`.

    Raises:
        ValueError: the system is not of bodies in a potential, the potential is not invariant under rigid motions of
            all bodies together, iterations is not a positive int, or solver is unknown.

    Source: this package; the discrete gradient's place in it, Gonzalez 1996, J. Nonlinear Sci. 6; chords with a test of
    contraction, Deuflhard 2011, Newton Methods for Nonlinear Problems, 2.1.
    """

    system: AbstractRigidBodies | AbstractDissipativeBodies = argument(converter=PROPERTIES.check)
    iterations: Converted[int] = static(converter=named(count, "iterations", 1), default=50)
    solver: str | None = static(default=None)
    order: float = static(default=2, init=False)
    symmetric: bool = static(default=True, init=False)
    loops = True

    def check_fields(self) -> dict[str, str]:
        _check_invariants(self.system)
        default = "newton" if is_chain(self.system.potential) else "fixed_point"
        solver = default if self.solver is None else self.solver
        return {"solver": choice("solver", solver, ("fixed_point", "newton"))}

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        equation = _Equation(self.system, state, jnp.asarray(dt, state.p.dtype))
        double, given = jnp.finfo(jnp.float64).eps, jnp.finfo(state.p.dtype).eps
        most = math.ceil(self.iterations * math.log(given) / math.log(double))  # for the same contraction per iteration
        if self.solver == "newton":
            ends, info = _Chain(equation).ends(most)
        else:
            ends, info = equation.solve(equation.guess(), most, 2, most)
        force, work = equation.force_and_work(ends)
        good = jnp.all(jnp.isfinite(force)) & jnp.all(
            jax.vmap(lambda J: symmetric(J).well_conditioned)(self.system.inertias)
        )
        work = None if state.work is None else state.work + work
        end = state._replace(q=equation.configuration(ends), p=state.p + equation.dt * force, work=work)
        return end, info._replace(converged=info.converged & good)

    def advice(self, state: State, dt: ArrayLike) -> str:
        given = f"{self.name} does not converge at dt = {dt}: bodies turn, or pass one another, too fast for steps of "
        if self.solver == "newton":
            return f"{given}this size, or a rod bends too much in a step or buckles in it. Use a smaller dt"
        return (
            f"{given}this size, or lose their energy too fast. Use a smaller dt, or more iterations than "
            f'{self.iterations}, or solver="newton" if they are stiff'
        )


def _check_invariants(system: AbstractRigidBodies | AbstractDissipativeBodies) -> None:
    """Raise ValueError if a potential is not one of relative poses, and has no invariants by which it is defined."""
    potential = system.potential
    for term in potential.terms if isinstance(potential, SumPotential) else (potential,):
        if type(term).__call__ is Potential.__call__ or not concrete(term):
            continue
        space, dtype = system.phase_space, system.masses.dtype
        deltas = [0.3 * np.sin(phase + 1.7 * np.arange(space.dim)) for phase in (0.3, 2.0)]
        with at_once():
            pairs = np.array([_two_values(term, space, jnp.asarray(delta, dtype)) for delta in deltas])
        size, apart = np.abs(pairs).max(), np.abs(pairs[:, 0] - pairs[:, 1]).max()
        if np.isfinite(size) and apart > math.sqrt(float(jnp.finfo(pairs.dtype).eps)) * size:
            raise ValueError(
                "bodies_energy_momentum integrates bodies in a potential of relative positions and attitudes, or one "
                f"with invariants of its own; {term!r} changes when all bodies move together (by {apart / size:.2g})"
            )


@partial(compiled, once=True)
def _two_values(potential: Callable[[Array, Array], Array], space: Any, delta: Array) -> tuple[Array, Array]:
    """V at poses displaced from the origin of the phase space, and at those relative to the first."""
    x, R = _parts(space.perturb(space.origin, delta).q.astype(delta.dtype))
    form = invariant_form(potential)
    return potential(x, R), form.value(form.invariants(x, R))


@dataclass(frozen=True)
class _Equation(FixedPointEquation[_Ends]):
    """The equations of one step."""

    system: AbstractRigidBodies | AbstractDissipativeBodies
    state: State
    dt: Array

    def configuration(self, ends: _Ends) -> Array:
        """q_{n+1}."""
        x, q = self.state.q[:, :3], self.state.q[:, 3:]
        return jnp.concatenate([x + ends.move, jax.vmap(so3.cayley_increment)(q, ends.turn)], axis=1)

    def force_and_work(self, ends: _Ends) -> tuple[Array, Array]:
        """f̄ and τ̄ of each body, (N, 6), and the work of dissipation, given forces and given poses."""
        force, work = self.mutual(ends)
        if isinstance(self.system, AbstractDissipativeBodies):
            applied, power = self.applied(self.system, ends)
            force, work = force + applied, work + self.dt * power
        return force, work

    def mutual(self, ends: _Ends) -> tuple[Array, Array]:
        """The part of f̄ and τ̄ of the potential, (N, 6), and the work of the poses that move in it as given.

        As I is quadratic, ΔI is its derivative at the mean along the change, whose rounding errors are proportional to
        the step. Those of I at x + Δx, proportional to |x|, would be added up by Newton's method in the energy.
        """
        form = invariant_form(self.system.potential)
        given, then = (given_poses(self.system.potential, self.state, late) for late in (0, self.dt))
        start, driven = (*_parts(self.state.q), *given), [b - a for a, b in zip(given, then, strict=True)]
        change = (ends.move, jax.vmap(_cayley_difference)(start[1], ends.turn), *driven)
        mean = tuple(a + d / 2 for a, d in zip(start, change, strict=True))
        I0, delta = form.invariants(*start), jax.jvp(form.invariants, mean, change)[1]
        D = form.discrete_gradient(I0, jax.tree.map(jnp.add, I0, delta))
        along_x, along_R, *along = jax.vjp(form.invariants, *mean)[1](D)
        work = [jnp.sum(a * moved) for a, moved in zip(along, driven, strict=True)]
        return jnp.concatenate([-along_x, torques(mean[1], along_R)], axis=1), sum(work, jnp.zeros_like(self.dt))

    def applied(self, system: AbstractDissipativeBodies, ends: _Ends) -> tuple[Array, Array]:
        """The part of f̄ and τ̄ of dissipation and given forces, (N, 6), and their power."""
        rate, q = 1 / jnp.where(self.dt == 0, 1, self.dt), self.state.q
        between = jax.vmap(so3.normalize)(q[:, 3:] + self.configuration(ends)[:, 3:])
        middle = jnp.concatenate([q[:, :3] + ends.move / 2, between], axis=1)
        t = None if self.state.t is None else self.state.t + self.dt / 2
        omega = jax.vmap(so3.Ad)(q[:, 3:], 2 * rate * ends.turn)
        return system.applied_force(t, middle, rate * ends.move, omega)

    def residual(self, ends: _Ends) -> _Ends:
        return self.linearized(ends)[0]

    def improve(self, ends: _Ends) -> tuple[_Ends, Array]:
        F, K = self.linearized(ends)
        step = _correction(K, F)
        improved, moved = _Ends(ends.move - step.move, ends.turn - step.turn), jnp.max(jnp.abs(step.move), axis=1)
        along = jnp.maximum(jnp.max(jnp.abs(ends.move), axis=1), moved)
        place = jnp.maximum(jnp.max(jnp.abs(self.state.q[:, :3]), axis=1), along)  # of each body, which rounds so
        size = jnp.minimum(place, jnp.max(along))  # fast bodies do not hide slow ones
        moved = jnp.max(moved / jnp.where(size > 0, size, 1))  # of rotations it is in rad
        return improved, jnp.maximum(moved, jnp.max(jnp.abs(step.turn)))

    def inverses(self) -> tuple[Callable[[_Ends], _Ends], Callable[[_Ends], _Ends]]:
        K = lax.stop_gradient(self.linearized(self.guess())[1])  # near that of the ends, which are not known here
        return partial(_correction, K), partial(_correction, jnp.swapaxes(K, 1, 2))

    def linearized(self, ends: _Ends) -> tuple[_Ends, Array]:
        """The residual, and the derivative of its rotational part by y without that of the forces, (N, 3, 3)."""
        (force, _), (q, p) = self.force_and_work(ends), self.state[:2]
        move = self.dt / self.system.masses[:, None] * (p[:, :3] + self.dt / 2 * force[:, :3])
        F, K = jax.vmap(self._rotation_equation)(self.system.inertias, q[:, 3:], p[:, 3:], force[:, 3:], ends.turn)
        return _Ends(ends.move - move, F), K

    def _rotation_equation(self, J: Array, q: Array, spin: Array, tau: Array, y: Array) -> tuple[Array, Array]:
        """Jy + y × Jy − a − (T − y × T) with a = ½ΔtΠ, T = ¼Δt²Λᵀτ̄, all over tr J; and its derivative by y."""
        S, r = unit_trace(J)
        c = 0.5 * r * self.dt  # one factor for a and T: two would be rounded apart, and energy drift by 0.04 ulp a step
        Jy, T = S @ y, vector(so3.Ad_star(q, c * (self.dt / 2 * tau)))
        a = vector(so3.Ad_star(q, c * spin))
        F = Jy + cross(y, Jy) - (a + (T - cross(y, T)))
        columns = [S @ e + (cross(y, S @ e) + cross(e, Jy + T)) for e in jnp.eye(3, dtype=y.dtype)]
        return jnp.stack(F), jnp.stack([jnp.stack(column) for column in columns], axis=1)

    def guess(self) -> _Ends:
        """The ends of the free motion, to first order."""

        def half_rotation(J: Array, q: Array, spin: Array) -> Array:
            return self.dt / 2 * jnp.stack(symmetric(J).solve(so3.Ad_star(q, spin)))

        (q, p), bodies = self.state[:2], self.system
        return _Ends(
            self.dt / bodies.masses[:, None] * p[:, :3], jax.vmap(half_rotation)(bodies.inertias, q[:, 3:], p[:, 3:])
        )


@dataclass(frozen=True)
class _Chain(ChainEquation):
    """The equations of one step for Newton's method, of the unknowns (Δx, y) of each body, (N, 6).

    Bodies that are no chain are one link, (1, 6N).
    """

    equation: _Equation

    @property
    def is_exact(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        system = self.equation.system
        return isinstance(system, AbstractRigidBodies) or system.masses.shape[0] <= 2 or not is_chain(system.potential)

    def ends(self, most: int) -> tuple[_Ends, StepInfo]:
        """The ends of the step, and the report.

        Positions x are rounded to eps |x|, so rotations of neighbors at a distance r are known to eps |x|/r.
        """
        guess, x = jnp.concatenate(self.equation.guess(), axis=1), self.equation.state.q[:, :3]
        unit = jnp.maximum(jnp.max(jnp.abs(x)) / self._distance, 1)
        first = jnp.maximum(lax.stop_gradient(self.length(guess)), 0.5)
        links = guess if is_chain(self.equation.system.potential) or len(guess) <= 2 else guess.reshape(1, -1)
        ends, info = self.solve(links, first, unit, most)
        return _ends(ends), info

    def residual(self, x: Array) -> Array:
        return jnp.concatenate(self.equation.residual(_ends(x)), axis=1).reshape(x.shape)

    def length(self, step: Array) -> Array:
        """The largest rotation in rad, or displacement over the distance of neighbors."""
        moved, turned = (jnp.max(jnp.abs(part)) for part in _ends(step))
        return jnp.maximum(moved / self._distance, turned)

    @property
    def _distance(self) -> Array:
        """That of neighbors in the mean."""
        apart = jnp.diff(self.equation.state.q[:, :3], axis=0)
        return lax.stop_gradient(jnp.sqrt(jnp.mean(jnp.sum(apart * apart, axis=1))))


def _ends(unknowns: Array) -> _Ends:
    """The unknowns of all links, by body."""
    bodies = unknowns.reshape(-1, 6)
    return _Ends(bodies[:, :3], bodies[:, 3:])


def _correction(K: Array, F: _Ends) -> _Ends:
    """The Newton correction of F, with its derivative but without that of the forces."""
    return _Ends(F.move, jax.vmap(lambda K, f: jnp.stack(matrix(K).solve(f)))(K, F.turn))


def _cayley_difference(R: Array, y: Array) -> Array:
    """R cay(2y) − R = 2/(1 + |y|²) R(ŷ + ŷ²), (3, 3)."""
    once = [cross(row, y) for row in matrix(R)]
    return 2 / (1 + jnp.sum(y * y)) * jnp.stack([jnp.stack(row + cross(row, y)) for row in once])


def _parts(q: Array) -> tuple[Array, Array]:
    """Positions and rotations of configurations (N, 7)."""
    return q[:, :3], jax.vmap(so3.to_matrix)(q[:, 3:])


@PROPERTIES.by_name
def examples(system: AbstractRigidBodies | AbstractDissipativeBodies) -> list[Step]:
    """The scheme, for bodies in a potential, with dissipation and given forces or without."""
    return [bodies_energy_momentum(system)]


bodies_energy_momentum = BodiesEnergyMomentum
