"""The paper's conditions of conservation as residuals of a step: (3.5), (4.5)–(4.22), (5.25)–(5.31), Results 13, 14.

Only the end z_{n+1} of a step and its linearization L are used, no formula of the scheme. Momenta Π and
rotations τ = q_n⁻¹q_{n+1} are those of the two states, Ω_{n+½} = m⁻¹½(Π_n + Π_{n+1}), 𝓕 = (π_{n+1} − π_n)/Δt. With

    Θ = Δt m⁻¹ Π_{n+α},    Π_{n+α} = (1−α)Π_n + αΠ_{n+1}

(α = ½ except for a step that defines its `velocity_weight`), δΘ follows from L, and so do the matrices of

    Ad⁻¹_{q_{n+1}}(δq_{n+1} − δq_n) = H δΘ,    (δπ_{n+1} − δπ_n)/Δt = F_n δq_n + G_n δΘ    (6.24), (5.50)

from the columns of δπ_n and δq_n. H is computed from δπ_n; that it is valid for δq_n as well is the condition "5.43",
that the step is of the paper's class. Without a potential every step that commutes with left translations is of this
class, including the exact flow: there is a τ(Θ) for each.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics.arrays import PyTree
from lieint_jax.capabilities import (
    AbstractElasticBody,
    AbstractEmbeddedBody,
    AbstractForcedSystem,
    AbstractFreeBody,
    AbstractGeodesicFlow,
    AbstractMechanicalSystem,
    AbstractTop,
)
from lieint_jax.core import State, Step, pytree, static
from lieint_jax.core.tangent import size, swinging, value_and_jacobian
from lieint_jax.groups import so3

EQUATIONS = {
    "2.18": ("momentum", "π_{n+1} = π_n"),
    "2.22": ("group", "T Tᵀ = 1"),
    "2.27": ("energy", "⟨Π_{n+1} − Π_n, Ω_{n+½}⟩ = 0"),
    "4.3": ("momentum", "the momentum of the symmetry is conserved (Result 6)"),
    "5.44": ("momentum", "the momentum of the symmetry is conserved"),
    "6.7": ("momentum", "rot[𝓕 F_{n+1−β}ᵀ] = 0"),
    "5.25": ("energy", "⟨mΩ, (2(1 + Ad_τ)⁻¹ − 1)Ω⟩ = 0, Ω = Ω_{n+½}"),
    "5.26": ("(energy)", "Ad_τ Ω_{n+½} = Ω_{n+½}: sufficient for (5.25)"),
    "4.5": ("(energy)", "γ·(Λ_nΘ̄ × e) = V_{n+1} − V_n, if (5.26) holds"),
    "5.49": ("(energy)", "Δt⟨𝓕, Ad_{q_n} Ω_{n+½}⟩ = V_n − V_{n+1}, if (5.26) holds"),
    "6.22": ("energy", "⟨Π_{n+1} − Π_n, Ω_{n+½}⟩ = V_n − V_{n+1}"),
    "6.10": ("energy", "⟨P_{n+1} − P_n, V_{n+½}⟩ = W_n − W_{n+1}"),
    "5.43": ("class", "the step is of the class, with one H for all variations"),
    "6.5": ("class", "F_{n+1} − F_n = Δt P_{n+β} E⁻¹"),
    "3.5": ("form", "(4/Δt) skew[(T + 1)H⁻ᵀJ] = Π̂_n − Π̂_{n+1}"),
    "5.31": ("form", "(4/Δt) skew[mH⁻¹(1 + Ad_τ⁻¹)] = ad*(Π_{n+1} − Π_n)"),
    "4.13": ("(form)", "Π_{n+1} − Π_n = −(κ/Δt) Θ̄ × JΘ̄, that is γ × e = 0"),
    "4.21": ("form", "G H⁻¹(T + 1)ᵀ = F Λ_n"),
    "4.22": ("form", "γ × e + 2 rot F = 0"),
    "14.1": ("form", "2 skew[H⁻¹(Ψ*_{n+1} + Ad_τ⁻¹Ψ*_n)] = Ψ_{n+1}ad*Π_{n+1}Ψ*_{n+1} − Ψ_n ad*Π_n Ψ*_n"),
    "14.2": ("form", "G H⁻¹(Ψ*_{n+1} + Ad_τ⁻¹Ψ*_n) = F Ad_{q_n} Ψ*_n"),
    "14.3": ("form", "ad*𝓕 = −2 skew F"),
    "14.1″": ("form", "skew[Ψ_{n+1} + Ψ_n] = 0"),
    "14.2″": ("form", "∂𝓕/∂F_n Ψ*_n = ∂𝓕/∂F_{n+1} Ψ*_{n+1}"),
    "14.3″": ("form", "skew[∂𝓕/∂F_n + ∂𝓕/∂F_{n+1}] = 0"),
}
_SLACK = 64  # residuals up to so many times their rounding error are zero


@pytree
class Conditions:
    """Residuals of the paper's conditions for one step, by equation number; `print` shows them as a table.

    Attributes:
        residuals: equation ↦ residual, a scalar: the largest entry over the unit of the equation (see `conditions`).
        rounding: equation ↦ the rounding error of the residual, in the same unit.
        scheme: the name of the step.
    """

    residuals: dict[str, Array]
    rounding: dict[str, Array]
    scheme: str = static()

    def __getitem__(self, equation: str) -> Array:
        return self.residuals[equation]

    def holds(self, equation: str) -> Array:
        """Whether a condition holds to round-off."""
        return self.residuals[equation] <= _SLACK * self.rounding[equation]

    def keeps(self, structure: str) -> Array:
        """Whether all conditions of "momentum", "energy", "form", "group" or "class" hold to round-off.

        Conditions of the form are decisive for steps of the class only. Conditions in parentheses in the printed table
        are ignored.
        """
        found = [self.holds(equation) for equation in self.residuals if EQUATIONS[equation][0] == structure]
        if not found:
            raise ValueError(f"no condition here is one of {structure!r}: got {', '.join(self.residuals)}")
        return jnp.all(jnp.stack(found))

    def __str__(self) -> str:
        rows = [
            f"  {name:<7}{EQUATIONS[name][0]:<9} {float(self[name]):>8.1e}  {'holds' if self.holds(name) else '—':<6} "
            f"{EQUATIONS[name][1]}"
            for name in EQUATIONS
            if name in self.residuals
        ]
        return "\n".join([self.scheme, *rows])


def conditions(step: Step, state: State, dt: Any) -> Conditions:
    """The paper's conditions that apply to a step's system, as residuals at one state.

    | system | momentum | energy | symplectic form |
    |---|---|---|---|
    | free body | (2.18) | (5.25), (5.26) | (3.5), (5.31) |
    | free body embedded in L(3) | (2.18), and (2.22) for the group | (2.27) | |
    | geodesic flow | (2.18) | (5.25), (5.26) | (5.31); Result 14.1 for `group_alpha` |
    | top | (4.3) | (6.22), (4.5) | (3.5), (4.13), (4.21), (4.22) |
    | metric and potential on a group | (5.44) | (6.22), (5.49) | Result 14, 1 to 3 |
    | pseudo-rigid body | (6.7) | (6.10) | Result 14, 1″ to 3″ |

    All are in their corrected form (`lieint_jax/corrections.md`). A residual is zero to round-off if the step conserves
    the structure. The conditions of the form are necessary and sufficient together, and only for a step of the class
    ("5.43", "6.5"), which `splitting` is not. Three conditions are not decisive: (5.26) is only sufficient; (4.5) and
    (5.49) are conditions of energy only where (5.26) holds; (4.13) follows from (3.5) for scaled Cayley maps.

    Units: momenta, (3.5), (5.31), (4.13) and 14.1 are divided by the largest component of π, or at rest by that of a
    body that swings by a radian (14.1 is also multiplied by (4/Δt²) m…m, which makes it (5.31) for α = ½); energies by
    the kinetic energy and the change of V; 14.2, 14.3, (4.21), (4.22) and similar ones by their largest terms; (5.26)
    by the largest component of Ω. On groups other than SO(3) components are those in a basis of equal m_ii whose
    largest structure constant is 1, such as angles and lengths over √(J/M) on SE(3).

    Args:
        step: a one-step scheme, as in the paper: z_{n+1} depends on z_n only.
        state: the state z_n.
        dt: Δt.

    Returns:
        A `Conditions`.

    Raises:
        ValueError: a system for which the paper states no such condition, a step that advances the time itself, and the
            errors of `Step.check`.

    Source: Lewis & Simo 1994, Results 3 to 16.
    """
    if step.own_time:
        raise ValueError(
            f"conditions are those of a step of given Δt, and {step.name} chooses its own: give its base step"
        )
    step.check(state, dt)
    system = step.system
    end, _, L = value_and_jacobian(system.phase_space, lambda z: step(z, dt), state)
    if isinstance(system, AbstractEmbeddedBody):
        found = _embedded(system, state, end)
    elif isinstance(system, AbstractElasticBody):
        found = _elastic(step, state, end, L, dt)
    elif isinstance(system, AbstractFreeBody | AbstractGeodesicFlow | AbstractTop | AbstractMechanicalSystem):
        found = _on_group(step, state, end, L, dt)
    else:
        raise ValueError(
            "conditions are those of the paper for left-invariant systems on groups and for pseudo-rigid bodies, got "
            f"{type(system).__name__}; use symplectic_defect, run.energy_error() and run.momentum_error()"
        )
    eps = jnp.finfo(state.p.dtype).eps
    return Conditions({k: x for k, (x, _) in found.items()}, {k: eps * y for k, (_, y) in found.items()}, step.name)


_Found = dict[str, tuple[Array, Array]]  # equation ↦ residual, and the largest of its terms in the same unit


def _embedded(system: PyTree, state: State, end: State) -> _Found:
    """(2.18), (2.22), (2.27)."""
    Pi0, Pi1 = system.body_momentum(state), system.body_momentum(end)
    mean = (system.angular_velocity(state) + system.angular_velocity(end)) / 2
    T = jnp.linalg.solve(state.q, end.q)
    unit, H = size(state.p), _nonzero(system.energy(state))
    stretch = _largest(T) * _largest(jnp.linalg.inv(state.q)) * _largest(state.q)
    return {
        "2.18": (_largest(end.p - state.p) / unit, jnp.ones_like(unit)),
        "2.22": (_largest(T @ T.T - jnp.eye(3)), stretch),
        "2.27": (jnp.abs((Pi1 - Pi0) @ mean) / H, stretch),
    }


def _on_group(step: Step, state: State, end: State, L: Array, dt: Any) -> _Found:
    """The conditions of Sections 3 to 5."""
    system, group = step.system, step.system.phase_space.group
    m = system.metric if isinstance(system, AbstractGeodesicFlow | AbstractMechanicalSystem) else system.inertia
    m = jnp.diag(m) if jnp.ndim(m) == 1 else m
    d, w = group.dim, jnp.asarray(step.velocity_weight, L.dtype)
    one, solve = jnp.eye(d, dtype=L.dtype), jnp.linalg.solve

    units = _units_of_basis(group, m)

    def matrix(act: Callable[[Array, Array], Array], element: Array) -> Array:
        return jax.vmap(act, (None, 1), 1)(element, one) * units / units[:, None]

    def ad_star(mu: Array) -> Array:
        return jax.vmap(group.ad_star, (1, None), 1)(one, mu / units) * units * units[:, None]

    typical = units * swinging(system, state).p
    of_p = size(typical)  # a unit: rounding errors are estimated by the largest entries of L
    L, p0, p1 = _in_units(L, units, of_p / units), units * state.p / of_p, units * end.p / of_p
    m = units[:, None] * m * units / of_p
    inverse = group.inverse(state.q)
    Ad0, Ad1 = matrix(group.Ad, state.q), matrix(group.Ad, end.q)
    turn = group.multiply(inverse, end.q)
    forth, back = matrix(group.Ad, turn), matrix(group.Ad, group.inverse(turn))
    Pi0, Pi1 = Ad0.T @ p0, Ad1.T @ p1
    Omega = solve(m, (Pi0 + Pi1) / 2)
    unit = size(Ad0.T @ typical / of_p)
    kinetic = Pi0 @ solve(m, Pi0) / 2

    d_Pi0 = Ad0.T @ jnp.hstack([ad_star(p0), one])
    d_Pi1 = Ad1.T @ jnp.hstack([ad_star(p1), one]) @ L
    d_Theta = dt * solve(m, (1 - w) * d_Pi0 + w * d_Pi1)
    moved = solve(Ad1, L[:d] - jnp.hstack([one, 0 * one]))
    by_pi = jnp.linalg.inv(d_Theta[:, d:])
    H = moved[:, d:] @ by_pi
    scale = _largest(L)  # of the entries of L, of which differences are taken
    found: _Found = {
        "5.43": (
            _largest(moved[:, :d] - H @ d_Theta[:, :d]) / _largest(moved),
            scale * (1 + _largest(by_pi) * _largest(d_Theta)) / _largest(moved),
        ),
        "5.26": (_largest(forth @ Omega - Omega) / _nonzero(_largest(Omega)), _largest(forth)),
    }
    midpoint = type(step).velocity_weight is Step.velocity_weight
    Psi0, Psi1 = dt * (1 - w) * jnp.linalg.inv(m), dt * w * jnp.linalg.inv(m)
    M = solve(H, Psi1.T + back @ Psi0.T)
    S1 = M - M.T - Psi1 @ ad_star(Pi1) @ Psi1.T + Psi0 @ ad_star(Pi0) @ Psi0.T
    lost = _largest(m @ jnp.linalg.inv(H)) * _largest(one + back) * scale / (jnp.abs(dt) * unit)
    first = (4 / dt**2 * _largest(m @ S1 @ m) / unit, 4 * lost)
    spatial = group is so3

    if midpoint:
        X = 2 / dt * m @ solve(H, one + back)
        found["5.31"] = (_largest(X - X.T - ad_star(Pi1 - Pi0)) / unit, 4 * lost)
    if spatial and midpoint:
        T = forth
        X = 2 / dt * (T + one) @ solve(H.T, m)
        found["3.5"] = (_largest(X - X.T - so3.hat(Pi0) + so3.hat(Pi1)) / unit, 4 * lost)

    ones = jnp.ones_like(unit)
    if not isinstance(system, AbstractForcedSystem):
        half = 2 * solve(one + forth, Omega) - Omega
        found["2.18"] = (_largest(p1 - p0), ones)
        found["5.25"] = (jnp.abs(Omega @ m @ half) / _nonzero(kinetic), jnp.linalg.cond(one + forth) * _largest(forth))
        if not midpoint:
            found["14.1"] = first
        return found

    force = (p1 - p0) / dt
    V0, V1 = ((system.energy(z) - system.free.energy(z)) / of_p for z in (state, end))
    energy = _nonzero(kinetic + jnp.abs(V1 - V0))
    terms = (jnp.abs(V0) + jnp.abs(V1) + kinetic) / energy * _largest(forth)
    pushed_ = (L[d:] - jnp.hstack([0 * one, one])) / dt
    G = pushed_[:, d:] @ by_pi
    F = pushed_[:, :d] - G @ d_Theta[:, :d]
    second, third = G @ M - F @ Ad0 @ Psi0.T, ad_star(force) + F - F.T
    blur = scale / jnp.abs(dt) * (1 + _largest(by_pi) * _largest(d_Theta))  # of F, in which that of G enters
    second_unit = _nonzero(jnp.maximum(_largest(G @ M), _largest(F @ Ad0 @ Psi0.T)))
    second_terms = blur * _largest(Ad0) * _largest(Psi0 + Psi1) / second_unit
    third_unit = _nonzero(jnp.maximum(_largest(ad_star(force)), _largest(F)))
    work = (dt * force @ (Ad0 @ Omega) + V1 - V0, (Pi1 - Pi0) @ Omega + V1 - V0)
    found["6.22"] = (jnp.abs(work[1]) / energy, terms)
    momentum = jnp.max(jnp.abs(system.momentum(end) - system.momentum(state)), initial=0) / of_p
    if spatial and isinstance(system, AbstractTop):
        found["4.3"], found["4.5"] = (momentum, ones), (jnp.abs(work[0]) / energy, terms)
        theta = 2 * turn[1:] / turn[0]  # Θ of T = cay Θ
        gyroscopic = jnp.cross(theta, m @ Omega)
        found["4.13"] = (_largest(Pi1 - Pi0 + gyroscopic) / unit, 4 * ones)
        found["4.21"] = (_largest(second) / second_unit, second_terms)
        found["4.22"] = (_largest(third) / third_unit, blur / third_unit)
        return found
    found["5.44"], found["5.49"] = (momentum, _largest(Ad1) * ones), (jnp.abs(work[0]) / energy, terms)
    found["14.1"] = first
    found["14.2"] = (_largest(second) / second_unit, second_terms)
    found["14.3"] = (_largest(third) / third_unit, blur / third_unit)
    return found


def _elastic(step: Step, state: State, end: State, L: Array, dt: Any) -> _Found:
    """The conditions of Section 6, whose group is abelian: H = 1."""
    system, b = step.system, jnp.asarray(step.velocity_weight, L.dtype)
    E = jnp.diag(system.inertia) if jnp.ndim(system.inertia) == 1 else system.inertia
    of_p = size(swinging(system, state).p)  # a unit: rounding errors are estimated by the largest entries of L
    L = _in_units(L, jnp.ones(9, L.dtype), of_p)
    E, p0, p1 = E / of_p, state.p / of_p, end.p / of_p
    E_inverse = jnp.linalg.inv(E)
    one, scale = jnp.eye(9, dtype=L.dtype), _largest(L)
    U, dP = end.q - state.q, p1 - p0
    mean = (1 - b) * p0 + b * p1
    Psi = dt * jnp.kron(jnp.eye(3, dtype=L.dtype), E_inverse)
    Psi0, Psi1 = (1 - b) * Psi, b * Psi
    by_P = jnp.linalg.inv(L[:9, 9:])
    after = (L[9:, 9:] - one) / dt @ by_P  # ∂𝓕/∂F_{n+1}
    before = L[9:, :9] / dt - after @ L[:9, :9]  # ∂𝓕/∂F_n
    unit = _nonzero(_largest(p0) + _largest(dP))
    stiff = _nonzero(jnp.maximum(_largest(before), _largest(after)))
    blur = scale / jnp.abs(dt) * (1 + _largest(by_P) * scale) / stiff
    torque = dP @ ((1 - b) * end.q + b * state.q).T
    W0, W1 = (system.stored_energy(z.q.T @ z.q) / of_p for z in (state, end))
    kinetic = jnp.sum(mean @ E_inverse * mean) / 2
    energy = _nonzero(kinetic + jnp.abs(W1 - W0))
    V = (p0 + p1) / 2 @ E_inverse
    total = Psi0 + Psi1
    return {
        "6.5": (
            _largest(U - dt * mean @ E_inverse) / _nonzero(_largest(U)),
            (_largest(end.q) + _largest(U)) / _nonzero(_largest(U)),
        ),
        "6.7": (_largest(torque - torque.T) / unit, _largest(end.q) + 0 * unit),
        "6.10": (
            jnp.abs(jnp.sum(dP * V) + W1 - W0) / energy,
            (jnp.abs(W0) + jnp.abs(W1) + kinetic) / energy,
        ),
        "14.1″": (_largest(total - total.T) / _largest(total), jnp.ones_like(unit)),
        "14.2″": (_largest(before @ Psi0.T - after @ Psi1.T) / (stiff * _largest(Psi)), blur),
        "14.3″": (_largest(before + after - (before + after).T) / stiff, blur),
    }


def _units_of_basis(group: Any, m: Array) -> Array:
    """The units of coordinates in the algebra, (d,): angles on SO(3), elsewhere in proportion to 1/√m_ii.

    They are such that the largest structure constant is 1, so that lengths and angles are compared in the body's own
    unit of length, √(J/M) on SE(3).
    """
    if group is so3:
        return jnp.ones_like(m[0])
    units = 1 / jnp.sqrt(jnp.diagonal(m))
    constants = jnp.asarray(group.structure, m.dtype) * units[:, None, None] * units[None, :, None] / units
    largest = _largest(constants)
    return units / jnp.where(largest == 0, units[0], largest)


def _in_units(L: Array, configuration: Array, momentum: Array) -> Array:
    """The linearization L, (2d, 2d), with δθ in the units `configuration`, (d,), and momenta in these, (d,) or ()."""
    units = jnp.concatenate([configuration, jnp.broadcast_to(momentum, configuration.shape)])
    return L * units / units[:, None]


def _largest(x: Array) -> Array:
    return jnp.max(jnp.abs(x))


def _nonzero(x: Array) -> Array:
    return jnp.where(x == 0, 1, x)
