"""Two bodies that attract each other: the exact Kepler motion of their centers, and kicks by all other forces.

    H = [T − G m₁m₂/r] + V₂,   V₂ = V + G m₁m₂/r

The drift is the exact flow of the bracket: d = x₂ − x₁ moves on a conic, the center of mass on a straight line, and the
bodies rotate freely. The remainder V₂ is smaller by a factor ε where the bodies are small compared with their distance.
Then the errors of the methods (8, 4) and (8, 6, 4) are O(εΔt⁸ + ε²Δt⁴) and O(εΔt⁸ + ε²Δt⁶ + ε³Δt⁴).
"""

from __future__ import annotations

from typing import cast

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.vectors import dot, vector
from lieint_jax.core import State, Step, StepInfo, pytree, static
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._exact import FreeFlight, exact
from lieint_jax.schemes._nystrom import Stages, mirror
from lieint_jax.schemes._shared.kepler_flow import kepler_flow
from lieint_jax.schemes._shared.stages import compose_stages
from lieint_jax.systems._equations import AbstractFreeBodies, AbstractRigidBodies

__all__ = ["kepler_splitting"]

Order = int | tuple[int, ...]
METHODS: dict[Order, Stages] = {
    2: Stages((0.5, 0.5), (1.0,)),
    (8, 4): Stages(
        mirror([0.07534696026989288842, 0.51791685468825678230, -0.09326381495814967072]),
        mirror([0.19022593937367661925, 0.84652407044352625706], -1.07350001963440575260),
    ),
    (8, 6, 4): Stages(
        mirror([0.0711334264982231177779, 0.241153427956640098737, 0.521411761772814789212, -0.333698616227678005727]),
        mirror([0.183083687472197221962, 0.310782859898574869508, -0.0265646185119588006972], 0.0653961422823734184560),
    ),
}


@pytree
class KeplerSplitting(Step):
    """The step made by `kepler_splitting`."""

    system: AbstractRigidBodies
    G: Array
    drift: FreeFlight
    method: Order = static()  # a key of `METHODS`
    order: float = static()
    symmetric: bool = static(default=True)
    loops = True

    @property
    def name(self) -> str:
        turns = "" if self.drift.commuting else f", {self.drift.turn.name}"
        return f"kepler_splitting[{self.method}{turns}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        method = METHODS[self.method]
        drifts, kicks = (jnp.asarray(x, state.p.dtype) * dt for x in (method.drifts, (0.0, *method.kicks)))

        def kick_and_drift(state: State, a: Array, b: Array) -> tuple[State, StepInfo]:
            return self._drift(state._replace(p=state.p + b * self._force(state.q)), a)

        # A first kick of 0, so that the long program of a drift is compiled once.
        return compose_stages(kick_and_drift, state, (drifts, kicks))

    def _force(self, q: Array) -> Array:
        """The forces and torques of V₂, (2, 6): those of V without Kepler's attraction."""
        m, d = self.system.masses, vector(q[1, :3] - q[0, :3])
        r2 = dot(d, d)
        kepler = self.G * m[0] * m[1] / (r2 * jnp.sqrt(r2)) * d
        on_first = jnp.stack([*kepler, *[jnp.zeros_like(r2)] * 3])
        return self.system.force(q) - jnp.stack([on_first, -on_first])

    def _drift(self, state: State, dt: Array) -> tuple[State, StepInfo]:
        """The flow of the Kepler problem and of the free rotations, by increments of positions and momenta."""
        m = self.system.masses
        M = m[0] + m[1]
        turned, info = self.drift.substep(state, dt)
        p = state.p[:, :3]
        d, v = state.q[1, :3] - state.q[0, :3], p[1] / m[1] - p[0] / m[0]
        moved, faster, solved = kepler_flow(d, v, self.G * M, dt)
        center = dt * ((p[0] + p[1]) / M)
        x = state.q[:, :3] + jnp.stack([center - (m[1] / M) * moved, center + (m[0] / M) * moved])
        push = (m[0] * m[1] / M) * faster
        q = jnp.concatenate([x, turned.q[:, 3:]], axis=1)
        p = jnp.concatenate([p + jnp.stack([-push, push]), state.p[:, 3:]], axis=1)
        return state._replace(q=q, p=p), info.merge(solved)

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self.name} does not converge at dt = {dt}: a sub-step is too long a part of the orbit, or the bodies "
            "meet. Use a smaller dt"
        )


def kepler_splitting(
    system: AbstractRigidBodies, order: Order = (8, 6, 4), G: ArrayLike | None = None, drift: FreeFlight | None = None
) -> KeplerSplitting:
    """Wisdom–Holman splittings about the exact Kepler motion of two bodies: binary asteroids, planets with moons.

    | conserved | to |
    |---|---|
    | the symplectic form | round-off |
    | P and L, if the potential is invariant | round-off |
    | energy | O(εΔt⁸ + …), bounded, no drift |

    Args:
        system: `systems.rigid_bodies(...)` of two bodies; their orbit may be an ellipse or a hyperbola.
        order: 2 (one kick per step), (8, 4) (five) or (8, 6, 4) (seven). The formal order of the latter two is 4.
        G: the constant of gravity; by default that of the potential.
        drift: the step of the free rotations: `exact(system.free)`, the default, or `preprocessed(system.free, 10)`,
            which halves the time of a step, but is as accurate only where no body rotates by more than |ΔtΩ| = ½.

    Raises:
        ValueError: there are not two bodies, the order is none of these, neither the arguments nor the potential have a
            G, or the drift is none of these.

    Source: Wisdom & Holman 1991, Astron. J. 102; McLachlan 1995, BIT 35 (8, 4); Blanes, Casas, Farrés, Laskar, Makazaga
    & Murua 2013, Appl. Numer. Math. 68 (8, 6, 4); increments as in Rein & Tamayo 2015, Mon. Not. R. Astron. Soc. 452.
    """
    order = _checks.plain("order", order)
    method = tuple(order) if isinstance(order, list | tuple) else order
    if method not in METHODS:
        raise ValueError(f"order must be {', '.join(map(str, METHODS))}, got {order!r}")
    PROPERTIES.check(system)
    if system.masses.shape != (2,):
        raise ValueError(f"kepler_splitting is for two bodies, got {system.masses.shape[0]}; use nystrom or splitting")
    given = _gravity_of(system) if G is None else G
    if given is None:
        raise ValueError("the potential has no G: give kepler_splitting(system, order, G=…)")
    if drift is None:
        drift = exact(cast("AbstractFreeBodies", system.free))
    elif not isinstance(drift, FreeFlight):
        raise ValueError(f"drift must be exact(system.free) or preprocessed(system.free, 10), got {drift!r}")
    else:
        PROPERTIES.check_drift(system.free, drift)
    formal = 2 if method == 2 else 4
    return KeplerSplitting(system, _checks.real_array("G", given, (), like=system.masses), drift, method, formal)


def _gravity_of(system: AbstractRigidBodies) -> ArrayLike | None:
    """The constant of gravity of the potential, if it has one."""
    return getattr(system.potential, "G", None)


PROPERTIES = SchemeProperties(
    name="kepler_splitting",
    systems="two bodies",
    conserves=("momentum", "form"),
    limit="that of the drift",
    aliases=("Wisdom–Holman", "WHFast"),
    source="Wisdom & Holman 1991; Laskar & Robutel 2001",
    accepts=(AbstractRigidBodies,),
)


@PROPERTIES.by_name
def examples(system: AbstractRigidBodies) -> list[Step]:
    """The three methods, for two bodies under gravity."""
    if system.masses.shape != (2,) or _gravity_of(system) is None:
        return []
    return [kepler_splitting(system, method) for method in METHODS]
