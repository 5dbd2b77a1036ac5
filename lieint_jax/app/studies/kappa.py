"""The most nearly symplectic κ of an energy-momentum family, learned as the paper proposes (Section 2).

For a heavy top the schemes of `top_energy_momentum` conserve energy and γ·π for every κ, and the symplectic form for
none (Result 8). So κ(x) = 1 + c₁x + c₂x² is learned: it minimizes the sum of squares of the entries of the defect
Lᵀω(z₁)L − ω(z₀) over an ensemble of states. Inertia and weight are of size 1, so all entries are of one scale. Then the
learned κ is tested on unseen states, at other step sizes, and over long runs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from matplotlib.figure import Figure

from lieint_jax import diagnostics, maps, plots, schemes, systems
from lieint_jax.app.studies.inference import table
from lieint_jax.fitting import Fit, fit
from lieint_jax.runs import integrate
from lieint_jax.types import State
from lieint_jax.types.tangent import value_and_jacobian

DT = 0.1
FORMS = {"c₁x + c₂x²": 2, "c₁x + … + c₄x⁴": 4}
FAST, FASTER = 3.0, 4.5  # largest body rates of the training states, and of the unseen ones
_TERMS = max(FORMS.values())
_GIVEN = {"cayley": np.zeros(2 + _TERMS), "exponential": np.eye(2 + _TERMS)[0], "symplectic": np.eye(2 + _TERMS)[1]}


def polynomial(c: Array, x: Array) -> Array:
    """κ(x) = 1 + c₁x + c₂x² + …"""
    value = jnp.zeros_like(x)
    for k in reversed(range(c.shape[0])):
        value = (value + c[k]) * x
    return 1 + value


def family(weights: Array, x: Array) -> Array:
    """κ(x) = 1 + w₁(κ_exp − 1) + w₂(κ_symplectic − 1) + w₃x + w₄x² + …: one program for given and learned κ's."""
    exponential, symplectic = (k(x) - 1 for k in (maps.kappa_exponential, maps.kappa_symplectic))
    return polynomial(weights[2:], x) + weights[0] * exponential + weights[1] * symplectic


def family_member(weights: Array) -> maps.Kappa:
    """The κ of `family` with these weights, for |Θ̄| < 1."""
    return maps.Kappa(jax.tree_util.Partial(family, weights), name="family", limit=1.0)


def _learned_weights(c: Array) -> Array:
    """The weights of `family` for κ(x) = 1 + c₁x + c₂x² + …"""
    return jnp.concatenate([jnp.zeros(2), c, jnp.zeros(_TERMS - c.shape[0])])


class KappaErrors(NamedTuple):
    """The errors of one κ."""

    training_defect: float  # root mean square defect of a step on the training states, at step size DT
    test_defect: float  # the same on the unseen test states
    defect_by_dt: dict[float, float]  # the same on the training states, by step size
    poisson_error: float  # geometric mean over the long runs of their final Poisson errors
    energy_error: float  # largest energy error of the long runs
    converged_runs: int  # the number of long runs that converged


class LearnedKappas(NamedTuple):
    """The results of the study."""

    coefficients: dict[str, np.ndarray]  # the learned coefficients, by the form of κ
    fit: Fit  # the common fit of both forms
    rows: dict[str, KappaErrors]  # the errors of each κ, by its name
    steps: int  # the number of steps of the long runs
    # the times, and the Poisson errors by the name of κ (geometric mean over the runs)
    series: tuple[np.ndarray, dict[str, np.ndarray]]


def top() -> Any:
    """An asymmetric heavy top, whose motion is not integrable."""
    return systems.heavy_top([1.0, 2.0, 2.5], [0.5, 0.4, 1.0])


def states(count: int, seed: int, size: float = FAST) -> State:
    """Random attitudes, and body rates in the ball of radius `size`."""
    rng = np.random.default_rng(seed)
    q, Omega, radius = rng.normal(size=(count, 4)), rng.normal(size=(count, 3)), rng.random((count, 1))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    Omega *= size * np.cbrt(radius) / np.linalg.norm(Omega, axis=1, keepdims=True)
    return jax.vmap(lambda q, w: top().state(q, angular_velocity=w))(jnp.asarray(q), jnp.asarray(Omega))


def run(quick: bool = False, progress: bool = True) -> LearnedKappas:
    """Learn on 200 states, and test on 500 others; `quick` uses a tenth of each."""
    few = 10 if quick else 1
    training, unseen, long = states(200 // few, 1), states(500 // few, 2, FASTER), states(16 // (4 if quick else 1), 3)
    steps = 200  # 20 time units: on longer runs of a chaotic motion the Poisson error measures the chaos instead

    def residuals(c: Array, used: Array) -> tuple[Array, Array]:
        matrices, converged = defects(jax.tree_util.Partial(polynomial, used * c), training, DT)
        return matrices / DT**3, converged

    used = np.array([[k < terms for k in range(_TERMS)] for terms in FORMS.values()], float)
    both = fit(residuals, 0 * used, starts=True, data=used, tolerance=1e-6, progress=progress)
    assert both.starts is not None
    coefficients = {name: np.asarray(c[:n]) for (name, n), c in zip(FORMS.items(), both.starts.params, strict=True)}
    kappas = _GIVEN | {name: _learned_weights(jnp.asarray(c)) for name, c in coefficients.items()}
    rows, series = {}, {}
    for name, weights in kappas.items():
        kappa = jnp.asarray(weights)
        sizes = {h: float(_rms(kappa, training, h)) for h in (DT / 2, DT, 2 * DT)}
        growth, energy, converged = _long_run_errors(kappa, long, steps)
        series[name] = growth
        on_unseen = float(_rms(kappa, unseen, DT))
        rows[name] = KappaErrors(sizes[DT], on_unseen, sizes, float(growth[-1]), energy, converged)
    t = DT * np.linspace(0, steps, len(next(iter(series.values()))))
    return LearnedKappas(coefficients, both, rows, steps, (t, series))


def defects(kappa: Callable[[Array], Array], states: State, dt: ArrayLike) -> tuple[Array, Array]:
    """The defect matrices Lᵀω(z₁)L − ω(z₀) of all states, (members, 6, 6), and whether all steps converged."""
    step = schemes.top_energy_momentum(top(), kappa)
    space = step.system.phase_space

    def defect(state: State) -> tuple[Array, Array]:
        end, info, L = value_and_jacobian(space, lambda z: step(z, dt), state)
        return L.T @ space.omega(end) @ L - space.omega(state), info.converged

    matrices, converged = jax.vmap(defect)(states)
    return matrices, jnp.all(converged)


@jax.jit
def _rms(weights: Array, states: State, dt: ArrayLike) -> Array:
    matrices, converged = defects(family_member(weights), states, dt)
    return jnp.sqrt(jnp.where(converged, jnp.mean(jnp.sum(matrices**2, axis=(1, 2))), jnp.nan))


def _long_run_errors(weights: Array, states: State, steps: int) -> tuple[np.ndarray, float, int]:
    """max|P_n − ω⁻¹| at 50 times, geometric mean over the runs; the largest energy error; how many runs converged."""
    errors, energy, converged = _integrate_long_runs(weights, states, steps)
    growth = np.exp(np.log(np.asarray(errors)[:, steps // 50 :: steps // 50]).mean(axis=0))
    return np.concatenate([[0.0], growth]), float(jnp.max(energy)), int(jnp.sum(converged))


@partial(jax.jit, static_argnums=2)
@partial(jax.vmap, in_axes=(None, 0, None))
def _integrate_long_runs(weights: Array, state: State, steps: int) -> tuple[Array, Array, Array]:
    step = schemes.top_energy_momentum(top(), family_member(weights))
    path = integrate(step, state, DT, steps, save_every=steps // 50)
    whole = diagnostics.poisson_error(step, state, DT, steps)
    energy = jnp.max(jnp.abs(diagnostics.energy_error(step.system, path)))
    return jnp.max(jnp.abs(whole), axis=(1, 2)), energy, jnp.all(path.info.converged)


def text(found: LearnedKappas) -> str:
    """The report of the study, as text."""

    def number(x: float) -> str:
        return f"{x:.3e}" if np.isfinite(x) else "fails"

    rows: list[tuple[str, ...]] = [("κ", "learned on", "unseen", "Δt/2", "2Δt", "Poisson error", "energy")]
    for name, row in found.rows.items():
        defects = row.training_defect, row.test_defect, row.defect_by_dt[DT / 2], row.defect_by_dt[2 * DT]
        rows.append((name, *map(number, (*defects, row.poisson_error)), f"{row.energy_error:.1e}"))
    lines = [
        f"κ learned for a heavy top, J = (1, 2, 2.5), E = (0.5, 0.4, 1), Δt = {DT}",
        "rms over states of |Lᵀω(z₁)L − ω(z₀)| after a step; Poisson error and energy at the end of long runs",
        *(f"  {name}: c = ({', '.join(f'{x:.5f}' for x in c)})" for name, c in found.coefficients.items()),
        "",
        *table(rows),
    ]
    compared = {"training_defect": "the training states", "test_defect": "unseen, faster states"}
    for column, data in (compared | {"poisson_error": "long runs"}).items():
        learned, given = (np.nanmin([found.rows[k]._asdict()[column] for k in names]) for names in (FORMS, _GIVEN))
        lines.append(f"  {data + ':':<24}the best learned κ has {learned / given:.2f} of the best given κ's error")
    return "\n".join(
        [*lines, f"  ({found.steps} steps.) No κ removes the defect (Result 8); of a given κ it is O(Δt³) as Δt → 0"]
    )


@plots.style()
def draw(found: LearnedKappas) -> Figure:
    """Plot every κ on its training range (shaded) and test range, and the Poisson error along the long runs."""
    fig, axes = plots.figure(2)
    x = np.linspace(0, (FASTER * DT) ** 2, 200)
    kappas = _GIVEN | {name: _learned_weights(jnp.asarray(c)) for name, c in found.coefficients.items()}
    values = jax.vmap(family, (None, 0))
    curves = {name: np.asarray(values(jnp.asarray(w), jnp.asarray(x))) for name, w in kappas.items()}
    plots.series(axes[0, 0], x, curves, "κ").set_xlabel("|ΔtΩ|², nearly |Θ̄|²")
    axes[0, 0].axvspan(0, (FAST * DT) ** 2, color=plots.GRAY, alpha=0.3, lw=0, label="training range")
    axes[0, 0].legend()
    t, series = found.series
    plots.log_error(axes[0, 1], t[1:], {k: y[1:] for k, y in series.items()}, "Poisson error")
    return fig
