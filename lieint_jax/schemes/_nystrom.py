"""Runge–Kutta–Nyström splittings: kicks and exact free flights, tuned to a kinetic energy that is quadratic in momenta.

    kick b₁, drift a₁, kick b₂, … kick b₁        (order 4, six stages)
    drift a₁, kick b₁, drift a₂, … drift a₁      (order 6, fourteen stages)

With H = T + V and T quadratic in the momenta the bracket {V, {V, {V, T}}} vanishes, which leaves fewer order
conditions: errors are a hundredth of those of compositions with as many kicks. The bracket vanishes on T*SO(3) as well,
since {V, {V, T}} depends on q only, and where V depends on time, which the drifts advance. The drift must be exact, or
of a higher order: a drift of order 2 would make the scheme of order 2.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import listed, named, optional
from lieint_jax.core import Converted, State, Step, StepInfo, argument, pytree, static
from lieint_jax.schemes._catalogue import SchemeProperties, hint
from lieint_jax.schemes._exact import exact
from lieint_jax.schemes._preprocessed import preprocessed
from lieint_jax.schemes._shared.stages import compose_stages
from lieint_jax.schemes._splitting import kick
from lieint_jax.systems._equations import (
    AbstractDrivenSystem,
    AbstractForcedSystem,
    AbstractFreeBodies,
    AbstractFreeBody,
)

__all__ = ["nystrom"]


class Stages(NamedTuple):
    """The stages of a splitting: alternating drifts a and kicks b; the kind with one more is first and last."""

    drifts: tuple[float, ...]
    kicks: tuple[float, ...]


def mirror(half: list[float], middle: float | None = None) -> tuple[float, ...]:
    """`half`, the `middle` if there is one, and `half` backwards."""
    return (*half, *([] if middle is None else [middle]), *half[::-1])


def _method_4() -> Stages:
    a, b = [0.245298957184271, 0.604872665711080], [0.0829844064174052, 0.396309801498368, -0.0390563049223486]
    return Stages(mirror([*a, 0.5 - sum(a)]), mirror(b, 1 - 2 * sum(b)))


def _method_6() -> Stages:
    a = [0.0378593198406116, 0.102635633102435, -0.0258678882665587, 0.314241403071447]
    a += [-0.130144459517415, 0.106417700369543, -0.00879424312851058]
    b = [0.09171915262446165, 0.183983170005006, -0.05653436583288827, 0.004914688774712854]
    b += [0.143761127168358, 0.328567693746804]
    return Stages(mirror(a, 1 - 2 * sum(a)), mirror([*b, 0.5 - sum(b)]))


METHODS = {4: _method_4(), 6: _method_6()}  # SRKN6b and SRKN14a

PROPERTIES = SchemeProperties(
    name="nystrom",
    systems="tops, satellites, several bodies",
    conserves=("momentum", "form"),
    order=4,
    limit="that of the drift",
    aliases=("Runge–Kutta–Nyström splitting of Blanes & Moan",),
    source="Blanes & Moan 2002",
    accepts=(AbstractForcedSystem, AbstractDrivenSystem),
)


@pytree
class Nystrom(Step):
    """Runge–Kutta–Nyström splittings of Blanes & Moan, symmetric and of high accuracy, for bodies in a potential.

    | conserved | to |
    |---|---|
    | the symplectic form | round-off; for one body to the accuracy of its drift, see below |
    | P and L, or γ·π, if the potential conserves them | round-off |
    | energy; for a driven system, energy less work | O(Δtᵒʳᵈᵉʳ), bounded, no drift |

    A step has seven kicks for order 4, fourteen for order 6. On tops order 6 runs in less than half of the time of
    compositions at equal error (`benchmarks/work_precision.py`).

    Args:
        system: `systems.rigid_bodies(...)`, or a rigid body in a potential: `systems.heavy_top(...)`,
            `systems.potential_top(...)`, `systems.driven_top(...)`, `systems.gravity_gradient(...)`.
        order: 4 or 6.
        drift: a symmetric step of `system.free` of at least this order. The default for one body is
            `preprocessed(system.free, 10)`: order 6 then conserves the form to 1e-14 at |ΔtΩ| = 0.6 and to 1e-10 at
            1.2; order 4, whose drifts are longer, to 1e-11 at 0.5. The default for several bodies is
            `exact(system.free)`, which conserves it to round-off at any step and costs five times as much.

    Raises:
        ValueError: the system or the order is none of these, or the drift is not symmetric or of too low an order.

    Source: Blanes & Moan 2002, J. Comput. Appl. Math. 142, Table 3: SRKN6b and SRKN14a.
    """

    system: AbstractForcedSystem | AbstractDrivenSystem
    order: Converted[int] = static(
        converter=named(listed, "order", METHODS, "; compose(splitting(system), order) has others")
    )
    drift: Converted[Step] = argument(converter=optional, default=None)
    symmetric: bool = static(default=True, init=False)

    def check_fields(self) -> dict[str, Step]:
        system, order = self.system, self.order
        free = system.free if isinstance(system, AbstractForcedSystem | AbstractDrivenSystem) else None
        if not isinstance(free, AbstractFreeBody | AbstractFreeBodies):
            raise ValueError(
                "nystrom integrates rigid bodies in a potential (systems.rigid_bodies, systems.heavy_top, "
                "systems.potential_top, systems.driven_top, systems.gravity_gradient), got "
                f"{type(system).__name__}{hint(system)}"
            )
        PROPERTIES.check(system)
        default = preprocessed(free, 10) if isinstance(free, AbstractFreeBody) else exact(free)
        drift = default if self.drift is None else self.drift
        PROPERTIES.check_drift(free, drift)
        if drift.order < order:
            raise ValueError(f"drift must be of order {order} or more, such as exact(system.free), got {drift.name}")
        return {"drift": drift}

    @property
    def name(self) -> str:
        return f"nystrom[{self.order:g}]"

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        drifts, kicks = (jnp.asarray(x, state.p.dtype) * dt for x in METHODS[self.order])
        kick_last = len(kicks) > len(drifts)

        def kick_and_drift(state: State, a: Array, b: Array) -> tuple[State, StepInfo]:
            return self.drift.substep(kick(self.system, state, b), a)

        # A first kick of 0, if it is not there, so that the long program of a drift is compiled once.
        first = kicks[:-1] if kick_last else jnp.concatenate([jnp.zeros_like(kicks[:1]), kicks])
        state, info = compose_stages(kick_and_drift, state, (drifts, first))
        if kick_last:
            return kick(self.system, state, kicks[-1]), info
        # The potential has not been evaluated since the last drift
        return state, info._replace(converged=info.converged & jnp.isfinite(self.system.energy(state)))

    def advice(self, state: State, dt: ArrayLike) -> str:
        longest = max(METHODS[self.order].drifts, key=abs)
        return f"{self.name} has sub-steps up to {longest:.3g} dt; {self.drift.advice(state, longest * dt)}"


@PROPERTIES.by_name
def examples(system: AbstractForcedSystem | AbstractDrivenSystem) -> list[Step]:
    """Both orders, for several bodies; those for one body would make the grid of tests too large."""
    return [nystrom(system, order) for order in METHODS] if isinstance(system.free, AbstractFreeBodies) else []


nystrom = Nystrom
