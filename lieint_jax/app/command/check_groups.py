"""Measured conservation by the midpoint scheme on each matrix group: `lieint check GROUP`, `lieint check groups`.

Every map conserves energy and spatial momentum on every group (Results 9 and 10); the symplectic form is conserved only
where (5.31) holds (Result 11). `lieint check groups` prints, over four random metrics each, the largest relative energy
error (1000 steps of 0.1 where Ad_q is bounded; else 100 of 0.05, over max(1, ‖Ad_q‖²)), and the largest defect of the
form in one step of |Δt Ω| = 0.05, in the basis of the group. The page "What is conserved, measured" has the table.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import _discover, groups, maps
from lieint_jax.diagnostics import certify, energy_error, symplectic_defect
from lieint_jax.groups import MatrixGroup
from lieint_jax.maps import Map
from lieint_jax.runs import integrate
from lieint_jax.schemes import group_midpoint
from lieint_jax.systems import Euler
from lieint_jax.types import State

MAPS: dict[str, Map] = {"exponential": maps.exponential, "cayley": maps.cayley, "arcsine": maps.arcsine}
_QUICK = {"xla_llvm_disable_expensive_passes": True}  # for programs that run once


def catalogue() -> dict[str, MatrixGroup]:
    """The groups of the catalogue and the examples of `groups.matrix`, by name."""
    return groups.catalogue.examples() | _discover.modules_with("examples", groups)["matrix"].examples()


def find_group(name: str) -> MatrixGroup | None:
    """The catalogue's group of this name in any spelling ("SE(3)", "se3", "Heis 5"); None if there is none."""
    found = {_normalize_name(key): group for key, group in catalogue().items()}
    return found.get(_normalize_name(name))


def _normalize_name(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def with_array_arithmetic(group: MatrixGroup) -> MatrixGroup:
    """The same group with arithmetic on whole arrays in place of unrolled loops: quick to compile, but slow to run."""
    return MatrixGroup(group.basis, group.name, unrolled=False)


def has_bounded_adjoint(group: MatrixGroup) -> bool:
    """Whether Ad_q stays bounded along every motion: it does on compact, abelian and nilpotent groups.

    Elsewhere Ad_q may grow, and the error of Π = Ad*_q π grows like ε‖Ad_q‖².
    """
    ad = np.tensordot(np.random.default_rng(0).normal(size=(8, group.dim)), group.structure.transpose(0, 2, 1), 1)
    ad /= max(np.linalg.norm(ad, 2, axis=(1, 2)).max(), 1e-300)
    nilpotent = np.abs(np.linalg.matrix_power(ad, group.dim)).max() <= 1e-12
    killing = np.einsum("iab,jba->ij", group.structure, group.structure)
    return bool(nilpotent or np.linalg.eigvalsh(killing).max() < -1e-9)


def defined_maps(group: MatrixGroup) -> dict[str, Map]:
    """The maps τ that are defined on a group, by name."""
    found = {"exponential": MAPS["exponential"]}
    if group.cayley_lands:
        found["cayley"] = MAPS["cayley"]
    try:
        maps.arcsine_forms(group)
    except ValueError:
        return found
    return found | {"arcsine": MAPS["arcsine"]}


def example(group: MatrixGroup, seed: int = 0) -> tuple[Euler, State]:
    """A random metric, not diagonal, and a random state with |Ω| = 1."""
    rng, d = np.random.default_rng(seed), group.dim
    A, v, xi = rng.normal(size=(d, d)), rng.normal(size=d), rng.normal(size=d) / 3
    system = Euler(jnp.asarray(A @ A.T / d + np.eye(d)), group)
    with jax.ensure_compile_time_eval():
        q = group.exp(jnp.asarray(xi))
    return system, system.state(q, velocity=v / np.linalg.norm(v))


class Conservation(NamedTuple):
    """Errors of the conserved quantities on one group with one map, the largest over several random metrics."""

    # largest |H − H₀|/H₀: over 1000 steps of 0.1 where Ad_q is bounded; else over 100 steps of 0.05, divided by
    # max(1, ‖Ad_q‖²)
    energy: float
    momentum: float  # largest change of π; 0 if it is conserved bit for bit
    form: float  # largest symplectic defect of a step of 0.05
    converged: bool  # whether every step of these runs converged


def measure(group: MatrixGroup, tau: Map, metrics: int = 4) -> Conservation:
    """Measure conservation by `group_midpoint` on a group with the map τ, over `metrics` random metrics."""
    group = with_array_arithmetic(group)
    dt, steps = (0.1, 1000) if has_bounded_adjoint(group) else (0.05, 100)
    systems, states = zip(*(example(group, seed) for seed in range(metrics)), strict=True)
    stacked = [jax.tree.map(lambda *x: jnp.stack(x), *trees) for trees in (systems, states)]
    energy, growth, momentum, form, converged = jax.vmap(partial(_measure_metric, tau, dt, steps))(*stacked)
    scale = 1.0 if has_bounded_adjoint(group) else np.maximum(1, np.asarray(growth) ** 2)
    energy, momentum, form = (float(np.max(x)) for x in (energy / scale, momentum, form))
    return Conservation(energy, momentum, form, bool(np.all(converged)))


@partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=_QUICK)
def _measure_metric(tau: Map, dt: float, steps: int, system: Euler, state: State) -> tuple[Array, ...]:
    """Energy error, largest ‖Ad_q‖, change of momentum, symplectic defect and convergence, with one metric."""
    step = group_midpoint(system, tau)
    run = integrate(step, state, dt, steps, save_every=steps // 10)
    identity = jnp.eye(system.group.dim)
    Ad_q = jax.vmap(lambda q: jax.vmap(system.group.Ad, (None, 1), 1)(q, identity))(run.state.q)
    return (
        jnp.max(jnp.abs(energy_error(system, run))) / system.energy(state),
        jnp.max(jnp.linalg.norm(Ad_q, axis=(1, 2))),
        jnp.max(jnp.abs(run.state.p - state.p)),
        symplectic_defect(step, state, 0.05),
        jnp.all(run.info.converged),
    )


def table(metrics: int = 4) -> Iterator[str]:
    """The lines of the table of all groups; the energy error is the largest over the maps."""
    yield "| group | energy | form, exponential | cayley | arcsine |"
    yield "|---|---|---|---|---|"
    for name, group in catalogue().items():
        found = {key: measure(group, tau, metrics) for key, tau in defined_maps(group).items()}
        flag = "" if all(result.converged for result in found.values()) else " NOT ALL CONVERGED"
        worst = max(result.energy for result in found.values())
        forms = [f"{found[key].form:.1e}" if key in found else "—" for key in MAPS]
        yield f"| {name} | {worst:.1e}{flag} | {' | '.join(forms)} |"


def certificates(group: MatrixGroup, scheme: str = "", num_steps: int | None = None) -> str:
    """The certificates of a random metric on a group, one for each map, as text.

    Raises:
        ValueError: no map matches `scheme`; the message lists the maps of this group.
    """
    system, state = example(with_array_arithmetic(group))
    steps = num_steps or (1000 if has_bounded_adjoint(group) else 100)
    wanted = [tau for name, tau in defined_maps(group).items() if scheme in f"group_midpoint[{name}]"]
    if not wanted:
        names = ", ".join(defined_maps(group))
        raise ValueError(f"no scheme {scheme!r} on {group.name}, where group_midpoint has the maps {names}")
    lines = [_describe(group, system)]
    lines += [str(certify(group_midpoint(system, tau), state, 0.05, steps)) for tau in wanted]
    return "\n\n".join(lines)


def _describe(group: MatrixGroup, system: Any) -> str:
    degrees = [str(monomials.shape[1]) for monomials, rows in group._casimirs for _ in rows]
    known = f"{len(degrees)} of {group.corank}" + f" (of degree {', '.join(degrees)})" * bool(degrees)
    symplectic = "arcsine" in defined_maps(group) and maps.is_symplectic(maps.arcsine, group, system.metric)
    form, growth = "yes" if symplectic else "no", "Ad_q stays bounded"
    if not has_bounded_adjoint(group):
        growth = "Ad_q may grow, and digits of Π are lost like ε‖Ad_q‖²"
    return f"{group}: {growth}; Casimirs known: {known}; a symplectic map known: {form}\nA random metric, |Ω| = 1"
