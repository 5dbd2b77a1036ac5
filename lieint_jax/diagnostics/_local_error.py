"""The local error of a step on a group, estimated from its two ends."""

from __future__ import annotations

import jax
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._numerics.arrays import Scalar
from lieint_jax.core import State, Step, clock, promoted, time_derivative
from lieint_jax.phase_spaces import ConfigurationGroup, CotangentGroup, CotangentUnimodular


def local_error(step: Step, state: State, dt: ArrayLike) -> Scalar:
    """An estimate of the error of q in one step: e in the algebra, (d,), with q₁ = q(t + Δt) exp(e); radians on SO(3).

    With the body velocities Ω and their rates at both ends of the step, e = log(q₀⁻¹q₁) − φ₄ where

        φ₄ = ½Δt(Ω₀ + Ω₁) + (Δt²/12)(Ω̇₀ − Ω̇₁) + (Δt²/12)[Ω₀, Ω₁]

    is the displacement to O(Δt⁵) (Magnus). The estimate is right to O(Δt⁴) for steps of order 2; for higher orders it
    is the error of φ₄. For a step that advances the time itself, Δt is the change of `state.t`. Use jax.vmap for many
    states.

    The estimate helps to choose dt. The package has no loop that adapts dt to it: such a loop loses the symplectic form
    and time symmetry, and gains little. With `top_energy_momentum`, which conserves energy and γ·π at any step size, a
    PI controller has 0.68 to 1.35 times the error of as many equal steps on three heavy tops, and 53 to 57 % of the
    lanes of a vmapped loop are idle. For motions with rapid phases, `log_hamiltonian` gains nearly as much
    (`benchmarks/RESULTS.md`).

    Args:
        step, state, dt: as in a call of the step.

    Returns:
        e, (d,).

    Raises:
        ValueError: a system that is not on a group, and the errors of `Step.check`.
    """
    space = step.system.phase_space
    if not isinstance(space, CotangentGroup | CotangentUnimodular | ConfigurationGroup):
        raise ValueError(f"local_error is of steps on groups, got {step.name} for a {type(step.system).__name__}")
    group = space.group
    step, state, _ = promoted(step, state)
    step.check(state, dt)
    end, _ = step(state, dt)
    h = clock(end) - clock(state) if step.own_time else dt

    def velocity(z: State) -> Array:
        return group.body_velocity(z.q, time_derivative(step.system, z).q)

    (Omega0, rate0), (Omega1, rate1) = (
        jax.jvp(velocity, (z,), (time_derivative(step.system, z),)) for z in (state, end)
    )
    phi = h / 2 * (Omega0 + Omega1) + h * h / 12 * (rate0 - rate1 + group.ad(Omega0, Omega1))
    return group.log(group.multiply(group.inverse(state.q), end.q)) - phi
