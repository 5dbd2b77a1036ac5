"""Additive schemes for pseudo-rigid bodies: symplectic, or conserving energy; all conserve momentum (Section 6.2).

With F_{n+α} = F_n + αU and U = F_{n+1} − F_n, one step is

    U E = Δt P_{n+β},  P_{n+β} = P_n + β(P_{n+1} − P_n),  β = 1 − α                 (6.5), (6.6), (6.9)
    P_{n+1} = P_n − Δt F_{n+α} S                                                    (6.5), (6.9)

with a symmetric S: then rot[PFᵀ] is conserved (Result 15). S is a function of C_n and the change D of C alone:

    symplectic        S = 2∇W(C_n + D),  D = F_{n+α}ᵀF_{n+α} − C_n                  (6.17)
    average           S = S̄(C_n, D) with ½S̄:D = W(C_n + D) − W(C_n),  D = C_{n+1} − C_n, α = ½
    energy            S = 2∇W(C_n + γD), γ from ½S:D = ΔW                           (6.11), (6.13)
    energy_momentum   S = ∇W(C_n + γD) + ∇W(C_n + (1−γ)D), γ from ½S:D = ΔW         (6.14), its γ corrected
    incompressible    S = S̄(C_n, D) − p S̄₃(C_n, D), p from det C_{n+1} = 1; S̄₃ is S̄ of W = ½ det C, so that
                      S̄₃:D = Δdet C = 0 and the pressure p does no work

A viscous body has the stress S̄(C_n, D) + νD/Δt by the rule "average": a step dissipates ½νD:D/Δt, which is counted as
negative work.

Eliminating P_{n+1} leaves nine equations for U, and one for γ if the rule has a γ; with c = βΔt²,

    R(U) = U E + c F_{n+α} S − Δt P_n = 0.

Newton's step needs six (or seven): dR = dU N + c F_{n+α} dS with the symmetric N = E + αcS, and dS depends on dU
through dD alone. No nearby numbers are subtracted: D follows from U, and ΔW is ½S̄:D.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from lieint_jax._checks import concrete, count, fraction, named
from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics.vectors import Matrix, Symmetric, Vector, dot, matrix, max_abs, mean_cofactor, symmetric
from lieint_jax.core import Converted, State, Step, StepInfo, StoredEnergy, argument, pytree, static
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._shared.equation import ImplicitEquation
from lieint_jax.systems._equations import AbstractElasticBody, AbstractIncompressibleBody, AbstractViscousBody

__all__ = ["additive"]

Rule = Literal["symplectic", "energy", "energy_momentum", "average", "incompressible"]
_SHRINK = 0.1  # det G may fall to this part of itself in one Newton correction
_FRACTIONS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)  # of a Newton correction that are tried

PROPERTIES = SchemeProperties(
    name="additive",
    systems="elastic bodies",
    conserves=("momentum", "energy (rule average or energy)", "form (rule symplectic)", "volume (incompressible)"),
    limit="half a radian of the fastest vibration",
    aliases=("energy–momentum rules of pseudo-rigid bodies",),
    source="Lewis & Simo 1994, Results 15 and 16, (6.15) to (6.17)",
    accepts=(AbstractElasticBody, AbstractViscousBody, AbstractIncompressibleBody),
)


@pytree
class Additive(Step):
    """The energy–momentum and symplectic schemes of Section 6.2 for a pseudo-rigid body, which differ in the stress S.

    | rule | energy | momentum rot[PFᵀ] | symplectic form | order |
    |---|---|---|---|---|
    | `"average"` (this package) | exact | exact | O(Δt³) per step | 2 |
    | `"symplectic"` (6.17) | bounded | exact | exact, for every α | 2 for α = ½, else 1 |
    | `"energy"` (6.11), (6.13) | exact | exact | O(Δt³) per step | 2 |
    | `"energy_momentum"` (6.14), γ corrected | exact | exact | O(Δt³) per step | 2 |
    | `"incompressible"` (this package), det F = 1 exact too | exact | exact | O(Δt³) per step | 2 |

    "Exact" is to round-off at a converged step. With α = ½ all are time-symmetric.

    A viscous body has the rule "average" only: energy less work is exact, where the work (`State.work`) is minus the
    energy lost, and no step gains energy.

    "average" uses a stress with ½S:ΔC = ΔW that needs no γ: by invariants for the built-in materials, otherwise by 8
    Gauss nodes of ∇W along C. The two energy rules of the paper solve for γ as well, whose equation may have several
    roots; they are slower, and can fail where the others do not.

    "incompressible" is "average" with a pressure, a multiplier for det F_{n+1} = 1, after Gonzalez 1999. The velocities
    V = PE⁻¹ satisfy the constraint in the middle of a step; at its ends tr(VF⁻¹) is O(Δt²), of alternating sign.

    Args:
        system: `systems.pseudo_rigid_body(...)`; `systems.incompressible_body(...)` for the rule "incompressible".
        rule: as above.
        alpha: α in [0, 1], where the force acts; ½ for all rules except "symplectic". There ½ is the implicit midpoint
            rule; 0 and 1 are the two explicit symplectic Euler schemes. With α ≠ ½ small vibrations of the frequency ω
            are stable for Δtω < 2/|1 − 2α| only, those of α = ½ for every Δt.
        iterations: the most Newton corrections per step. Fewer suffice as a rule: 3 to 4 at the steps of the paper's
            Figure 3, up to a dozen at those of Figure 4.

    A Newton correction that would nearly invert F (det F ≤ 0) is shortened, to as little as a sixteenth. `converged`
    requires the residual at round-off; det F > 0 at both F_{n+α} and F_{n+1}, since W(C) does not depend on the sign of
    det F; and for the rules with γ, ½S:ΔC = ΔW. `residual` is relative to the terms of the equation.

    Raises:
        ValueError: not a pseudo-rigid body, an unknown rule, α out of range or not ½ for an energy rule, a bad count.

    Source: Lewis & Simo 1994, Results 15 and 16; "average": this package, after Gonzalez 2000, Comput. Methods Appl.
    Mech. Engrg. 190, and McLachlan, Quispel & Robidoux 1999.
    """

    system: Converted[AbstractElasticBody | AbstractViscousBody | AbstractIncompressibleBody] = argument(
        converter=PROPERTIES.check
    )
    rule: Rule = static(default="average")
    alpha: Converted[Array] = argument(converter=named(fraction, "alpha"), default=0.5)
    iterations: Converted[int] = static(converter=named(count, "iterations", 1), default=25)
    order: float = static(init=False)
    symmetric: bool = static(init=False)
    loops = True

    def check_fields(self) -> dict[str, float]:
        system, rule = self.system, self.rule
        if rule not in get_args(Rule):
            raise ValueError(f"rule must be one of {', '.join(get_args(Rule))}, got {rule!r}")
        if isinstance(system, AbstractIncompressibleBody) != (rule == "incompressible"):
            kept = "incompressible_body with the rule 'incompressible', pseudo_rigid_body with the others"
            raise ValueError(f"additive integrates {kept}, got {type(system).__name__} with {rule!r}")
        if isinstance(system, AbstractViscousBody) and rule != "average":
            raise ValueError(f"a viscous body has the rule 'average', whose loss is exact, got {rule!r}")
        middle = not concrete(self.alpha) or float(self.alpha) == 0.5
        if not middle and rule != "symplectic":
            raise ValueError(f"the rule {rule!r} conserves energy for alpha = 1/2 only, got {self.alpha}")
        return {"order": 2 if middle else 1, "symmetric": middle}

    @property
    def name(self) -> str:
        return f"additive[{self.rule}]"

    @property
    def velocity_weight(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """β = 1 − α (6.9)."""
        return 1 - self.alpha

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        dt = jnp.asarray(dt)
        equation = _Equation.from_state(self, state, dt)
        W, size = equation.W, equation.size
        x, info = equation.solve(
            equation.guess(), self.iterations, done=equation.is_converged, length=_displacement, first=size
        )
        middle, end, D, S = equation.evaluate(x)
        moved = state._replace(q=end.array, p=(equation.P - dt * (middle @ S)).array)
        if isinstance(W, _Viscous) and state.work is not None:
            moved = moved._replace(work=state.work - W.rate * D.inner(D) / 2)
        return moved, info

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name} does not converge within {self.iterations} iterations at dt = {dt}: use a smaller dt, more "
            "iterations, or the rule 'average', which has no second equation to solve"
        )


@PROPERTIES.by_name
def examples(system: AbstractElasticBody | AbstractViscousBody | AbstractIncompressibleBody) -> list[Step]:
    """The two rules without an equation for γ, for pseudo-rigid bodies; the one for incompressible bodies.

    The other two compile too slowly for the examples, which `lieint check` and every test of schemes run;
    `diagnostics.certify(additive(body, "energy"), …)` certifies them.
    """
    if isinstance(system, AbstractIncompressibleBody):
        return [additive(system, "incompressible")]
    if isinstance(system, AbstractViscousBody):
        return [additive(system)]
    return [additive(system, "average"), additive(system, "symplectic")]


# The rules: S(C, D) or S(C, D, γ) -------------------------------------------------------------------------------------


def _average(W: StoredEnergy, C: Symmetric, D: Symmetric) -> Symmetric:
    return Symmetric(W.mean_stress(C, D))


def _energy(W: StoredEnergy, C: Symmetric, D: Symmetric, gamma: Array) -> Symmetric:
    return Symmetric(W.stress(C + gamma * D))


class _Rule(NamedTuple):
    """A choice of S. If it has a γ, `gammas` is 1, `guess` the limit of γ for D → 0, and γ lies in [0, end].

    If it is `constrained`, γ is any number, a pressure, whose equation is det(C + D) = 1.
    """

    stress: Callable[..., Symmetric]
    gammas: int = 0
    guess: float = 0.0
    end: float = 0.0
    constrained: bool = False


_RULES: dict[str, _Rule] = {
    "symplectic": _Rule(lambda W, C, D: Symmetric(W.stress(C + D))),
    "average": _Rule(_average),
    "energy": _Rule(_energy, 1, 0.5, 1.0),
    "energy_momentum": _Rule(
        lambda W, C, D, gamma: (_energy(W, C, D, gamma) + _energy(W, C, D, 1 - gamma)) / 2, 1, 0.5 - 12**-0.5, 0.5
    ),
    "incompressible": _Rule(
        lambda W, C, D, pressure: _average(W, C, D) - pressure * mean_cofactor(C, D), 1, end=math.inf, constrained=True
    ),
}


def _energy_defect(W: StoredEnergy, C: Symmetric, D: Symmetric, S: Symmetric) -> Array:
    """S:D − 2ΔW."""
    return (S - W.mean_stress(C, D)).inner(D)


def _regular(D: Symmetric, C: Symmetric, stiffness: Array, off: Array) -> Array:
    """A term below the rounding of `_energy_defect` that sets γ to its limit where any γ is a root, as for D = 0."""
    eps = jnp.finfo(off.dtype).eps
    return eps * stiffness * off * (D.inner(D) + eps * eps * C.inner(C))


@pytree
class _Viscous(StoredEnergy):
    """A stored energy whose mean stress is that of a viscous body in one step: S̄ + νD/Δt."""

    elastic: StoredEnergy
    rate: Array  # ν/Δt

    def __call__(self, C: Array) -> Array:
        return self.elastic(C)

    def stress(self, C: Symmetric) -> Symmetric:
        return Symmetric(self.elastic.stress(C))

    def mean_stress(self, C: Symmetric, D: Symmetric) -> Symmetric:
        return Symmetric(self.elastic.mean_stress(C, D)) + self.rate * D


# The equation, and Newton's step for it -------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Equation(ImplicitEquation[Array]):
    """R(x) = 0 of one step, for x = (U, γ): nine entries of U, row by row, and γ if the rule has one."""

    rule: _Rule
    W: StoredEnergy
    alpha: Array
    E: Symmetric  # the inertia, in full
    F: Matrix  # F_n
    P: Matrix  # P_n
    C: Symmetric  # F_nᵀF_n
    dt: Array
    c: Array  # βΔt²
    a: Array | float  # F_n + aU, the argument of W, must stay in GL⁺(3)
    stiffness: Array  # the change of S by a relative error of C, over that error
    size: Array  # of F_n

    @classmethod
    def from_state(cls, step: Additive, state: State, dt: Array) -> _Equation:
        """The equation of a step from a state."""
        rule, W = _RULES[step.rule], step.system.stored_energy
        alpha = step.alpha.astype(state.p.dtype)
        E, F, P = symmetric(step.system.inertia).full, matrix(state.q), matrix(state.p)
        C, c, a = F.gram(), (1 - alpha) * dt * dt, alpha if step.rule == "symplectic" else 1
        stiffness = lax.stop_gradient(max_abs(jax.jvp(W.stress, (C,), (C,))[1]))  # the size of ∂S/∂C·C
        if isinstance(step.system, AbstractViscousBody):
            W = _Viscous(W, step.system.viscosity / jnp.where(dt == 0, 1, dt))
            stiffness = stiffness + jnp.abs(W.rate) * max_abs(C)
        return cls(rule, W, alpha, E, F, P, C, dt, c, a, stiffness, jnp.max(jnp.abs(state.q)))

    def guess(self) -> Array:
        """U = 0, and the γ of D → 0."""
        dtype = self.size.dtype
        return jnp.concatenate([jnp.zeros(9, dtype), jnp.full(self.rule.gammas, self.rule.guess, dtype)])

    def evaluate(self, x: Array) -> tuple[Matrix, Matrix, Symmetric, Symmetric]:
        """F_{n+α}, F_{n+1}, D and S."""
        U = _matrix(x)
        D = self.change(U)
        return self.F + self.alpha * U, self.F + U, D, self.rule.stress(self.W, self.C, D, *x[9:])

    def change(self, U: Matrix) -> Symmetric:
        """D = FᵀV + VᵀF + VᵀV with V = aU."""
        V = self.a * U
        return (self.F.T @ V).plus_transpose() + V.gram()

    def law(self, D: Symmetric, gamma: tuple[Array, ...]) -> tuple[Symmetric, tuple[Array, ...]]:
        """S, and for rules with a γ the residual of its equation: S:D − 2ΔW, or det(C + D) − 1 up to a constant."""
        rule, W, C = self.rule, self.W, self.C
        S = rule.stress(W, C, D, *gamma)
        if rule.constrained:
            return S, (mean_cofactor(C, D).inner(D),)
        return S, tuple(_energy_defect(W, C, D, S) + _regular(D, C, self.stiffness, g - rule.guess) for g in gamma)

    def residual(self, x: Array) -> Array:
        """U E + c F_{n+α} S − Δt P_n, and the equation for γ if there is one."""
        U = _matrix(x)
        S, gamma_residual = self.law(self.change(U), tuple(x[9:]))
        if self.rule.constrained:  # by `law`, with C for F, it has |F|³ times the rounding error
            det = (self.F + self.a * U).det()
            gamma_residual = ((det - 1) * (det + 1),)
        R = U @ self.E + self.c * ((self.F + self.alpha * U) @ S) - self.dt * self.P
        return jnp.stack([*_entries(R), *gamma_residual])

    def correction(self, x: Array, R: Array) -> Array:
        """Newton's step, shortened where it would lead out of GL⁺(3); γ stays in its interval, fixed if D = 0."""
        rule, c, a = self.rule, self.c, self.a
        U, gamma = _matrix(x), tuple(x[9:])
        D = self.change(U)
        (S, _), tangent = jax.linearize(self.law, D, gamma)
        N = self.E + self.alpha * c * S
        G, middle = self.F + a * U, self.F + self.alpha * U
        columns = la.columns(lambda *y: tangent(Symmetric(y[:6]), y[6:]), 6 + len(gamma), x.dtype)
        determined = D.inner(D) > 0  # at the guess, D = 0, any γ serves, and rounding must not choose one
        free = (-jnp.inf, jnp.inf)
        limits = [free if rule.constrained else (determined * (g - rule.end), determined * g) for g in gamma]
        dU, d_gamma = _newton_step(N, G, middle, a, c, columns, R, limits)
        t = _fraction(G, dU, a)
        return jnp.concatenate([t * jnp.stack(_entries(dU)), *(g[None] for g in d_gamma)])

    def report(self, x: Array, R: Array, steady: Array) -> StepInfo:
        rule, (middle, end, D, S) = self.rule, self.evaluate(x)
        stiff = max_abs(S) + self.stiffness
        scale = self.size * (max_abs(self.E) + self.c * stiff) + jnp.abs(self.dt) * max_abs(*self.P)
        residual, tolerance = jnp.max(jnp.abs(R[:9])) / scale, 32 * jnp.finfo(R.dtype).eps
        converged = (residual <= tolerance) & steady & (middle.det() > 0) & (end.det() > 0)
        if rule.constrained:
            size = max_abs(*end)
            converged &= jnp.abs(R[9]) <= tolerance * jnp.maximum(size * size * size, 1)
        elif rule.gammas:
            converged &= jnp.abs(_energy_defect(self.W, self.C, D, S)) <= tolerance * stiff * max_abs(D)
        return lax.stop_gradient(StepInfo(residual, converged))

    def is_converged(self, x: Array, step: Array) -> Array:
        """Whether the next correction, quadratically smaller, would be round-off."""
        small_step = jnp.sqrt(jnp.finfo(step.dtype).eps) / 10
        ends = jnp.max(jnp.abs(step[:9])) <= small_step * self.size
        if self.rule.constrained:  # linear in the pressure, which is as good as U
            return ends
        return ends & jnp.all(jnp.abs(step[9:]) <= 100 * small_step)


def _displacement(x: Array) -> Array:
    """The size of U in x = (U, γ)."""
    return jnp.max(jnp.abs(lax.stop_gradient(x[:9])))


def _newton_step(
    N: Symmetric,
    G: Matrix,
    middle: Matrix,
    a: Array | float,
    c: Array,
    columns: Sequence[tuple[Symmetric, tuple[Array, ...]]],
    R: Array,
    limits: Sequence[tuple[ArrayLike, ArrayLike]],
) -> tuple[Matrix, list[Array]]:
    """dU and dγ of dU N + (cF_{n+α}) dS = R, dS = 𝕋dD + S′dγ, dD = a(GᵀdU + dUᵀG), G = F_n + aU.

    With dU = (R − cF_{n+α}dS)N⁻¹ put into dD, six equations for dD are left:
    dD + a sym(Gᵀ cF_{n+α} dS N⁻¹) = a sym(Gᵀ R N⁻¹), sym A = A + Aᵀ. The equation for γ, if any, is eliminated last.
    """
    adjugate = N.adjugate
    N_inverse = 1 / N.det(adjugate) * adjugate
    A = a * c * (G.T @ middle)
    free = _matrix(R) @ N_inverse
    right = (a * (G.T @ free)).plus_transpose()
    images = [(A @ S @ N_inverse).plus_transpose() for S, _ in columns]
    K = la.factored(Matrix((images[p][q] + (1 if p == q else 0) for p in range(6)) for q in range(6)))
    dD, *by_gamma = (K.solve(Vector(b)) for b in (right, *images[6:]))
    step, d_gamma = dD, []
    for k, (per_gamma, (least, most)) in enumerate(zip(by_gamma, limits, strict=True)):
        row = [gamma_residual[k] for _, gamma_residual in columns]
        slope = row[6 + k] - sum(m * x for m, x in zip(row, per_gamma, strict=False))
        left = R[9 + k] - sum(m * x for m, x in zip(row, dD, strict=False))
        d_gamma.append(jnp.clip(left / jnp.where(slope == 0, 1, slope), least, most))  # no pressure acts for Δt = 0
        step = [x - y * d_gamma[k] for x, y in zip(dD, per_gamma, strict=True)]
    c_dS: Any = c * sum(d * S for d, (S, _) in zip([*step, *d_gamma], columns, strict=True))
    return free - middle @ c_dS @ N_inverse, d_gamma


def _fraction(G: Matrix, dG: Matrix, a: Array | float) -> Array:
    """The largest of the fractions t with det(G − ta dG) > det(G)/10, a cubic in ta; the least if none has it."""
    cof, cof_d = G.cofactors, dG.cofactors
    d0, d3 = dot(G[0], cof[0]), dot(dG[0], cof_d[0])
    d1 = sum(dot(cof[i], dG[i]) for i in range(3))
    d2 = sum(dot(cof_d[i], G[i]) for i in range(3))
    fraction = jnp.full_like(d0, _FRACTIONS[0])
    for t in _FRACTIONS[1:]:
        x = -a * t
        fraction = jnp.where(d0 + x * (d1 + x * (d2 + x * d3)) > _SHRINK * d0, t, fraction)
    return fraction


def _matrix(u: Array) -> Matrix:
    return Matrix((u[3 * i + j] for j in range(3)) for i in range(3))


def _entries(A: Matrix) -> list[Array]:
    return [x for row in A for x in row]


additive = Additive
