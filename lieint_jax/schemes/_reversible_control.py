"""Variable steps that are reversible: an integrating controller of the step density ρ = 1/σ (Hairer & Söderlind).

    ρ½ = ρ_n + ½εG(y_n),    y_{n+1} = Φ_{ε/ρ½}(y_n),    ρ_{n+1} = ρ½ + ½εG(y_{n+1}),    G = −d ln σ/dt

σ(y) is the desired step size, ε = dt a step of the fictitious time, and d/dt the derivative along the vector field.
Since ρ̇ = ρG/ρ in the time with dt = dε/ρ, ρσ is constant up to O(ε²), and 1 at the start.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import at_once, concrete
from lieint_jax.core import State, Step, StepInfo, System, callable_pytree, promoted, pytree, static, time_derivative
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._splitting import examples as base_examples
from lieint_jax.systems._equations import AbstractForcedSystem

__all__ = ["reversible_control"]

_KEY = "rho"

PROPERTIES = SchemeProperties(
    name="reversible_control",
    systems="any symmetric step",
    conserves=("what the step conserves, but not the form",),
    limit="that of the step",
    aliases=("reversible integrating controller",),
    source="Hairer & Söderlind 2005",
)


@pytree
class ReversibleControl(Step):
    """A time-symmetric scheme with a variable step size that is a function of the state: Δt ≈ dt·σ(state).

    The step conserves every invariant that the base step conserves at any step size, such as the energy and γ·π of
    `top_energy_momentum`. The symplectic form is not conserved (`log_hamiltonian` conserves it). Because of the time
    symmetry the energy of a splitting does not drift on regular motions; on chaotic ones this is not guaranteed.

    The step advances `state.t`, and carries the step density ρ ≈ 1/σ in `state.extra["rho"]`: `step.start(state)`
    provides both. `dt` is a step of a fictitious time s with dt/ds = σ, in the unit of time over that of σ.

    The states as functions of `state.t` are of second order; the step is time-symmetric; `compose` raises the order. A
    step costs two evaluations of σ and its derivative in addition to the base step.

    Args:
        step: a symmetric step, such as `top_energy_momentum(...)` or `splitting(...)`.
        sigma: the desired step size over dt, a smooth positive function of the state with a scalar value. It should be
            invariant under reversal of the motion; parameters to be differentiated go into a `jax.tree_util.Partial`.

    Raises:
        ValueError: the step is not symmetric or advances the time itself, or sigma is not a scalar function. At the
            start of a run: sigma is not positive, or the state lacks ρ. Inside jit, a step where σ or ρ is not positive
            reports `converged=False`.

    Source: Hairer & Söderlind 2005, SIAM J. Sci. Comput. 26.

    Example:
        >>> from lieint_jax import systems, schemes
        >>> top = systems.heavy_top([1.0, 1.0, 0.5], [0.0, 0.0, 5.0])
        >>> slow_where_high = lambda state: 1 / (1 + top.kinetic_energy(state))
        >>> step = schemes.reversible_control(schemes.top_energy_momentum(top), slow_where_high)
        >>> state = step.start(top.state(angular_velocity=[0.1, 0.0, 1.0]))
        >>> float(step(state, 0.1)[0].t) < 0.1
        True
    """

    step: Step
    sigma: Callable[[State], ArrayLike]
    order: float = static(default=2, init=False)
    symmetric: bool = static(default=True, init=False)
    own_time = True

    def check_fields(self) -> dict[str, object]:
        if not isinstance(self.step, Step) or not self.step.symmetric or self.step.own_time:
            given = self.step.name if isinstance(self.step, Step) else self.step
            needed = "a symmetric step whose dt is a step of time"
            raise ValueError(f"reversible_control needs {needed}, got {given!r}; apply compose to its result")
        if not callable(self.sigma):
            raise ValueError(f"sigma must be a function of the state with a scalar value, got {self.sigma!r}")
        return {"sigma": callable_pytree(self.sigma)}

    @property
    def system(self) -> System:
        return self.step.system

    @property
    def name(self) -> str:
        return f"reversible_control({self.step.name})"

    def start(self, state: State) -> State:
        """`state` with ρ = 1/σ, and at t = 0 if it has no time; ValueError if σ is concrete and not positive."""
        step, state, dtype = promoted(self, self.step.start(state))
        step.system.check(state)
        if state.t is None:
            state = state._replace(t=jnp.zeros((), dtype))
        with at_once():  # concrete inside jit too
            sigma = step._sigma(state)
        if concrete(sigma) and not 0 < float(sigma) < float("inf"):
            raise ValueError(f"sigma must be positive and finite, the step size over dt, got {float(sigma):g}")
        return state._replace(extra={**(state.extra or {}), _KEY: 1 / sigma})

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        if _KEY not in (state.extra or {}):
            raise ValueError(f'the state needs its step density, state.extra["{_KEY}"]: use step.start(state)')
        half, before = self._kick_density(state, dt)
        rho = (half.extra or {})[_KEY]
        end, info = self.step.substep(half, dt / jnp.where(rho > 0, rho, 1))
        end, after = self._kick_density(end, dt)
        return end, info._replace(converged=info.converged & before & after)

    def advice(self, state: State, dt: ArrayLike) -> str:
        half, _ = self._kick_density(state, dt)
        sigma, rho = float(self._sigma(state)), float((half.extra or {})[_KEY])
        if not (0 < sigma < float("inf") and 0 < rho < float("inf")):
            return (
                f"{self.name} needs sigma > 0 and a density rho > 0: got sigma = {sigma:g}, and rho = {rho:g} half a "
                f"step later. If sigma is positive, dt = {dt} is too large"
            )
        return f"{self.name} uses a step of {dt / rho:.3g}; {self.step.advice(state, dt / rho)}"

    def _kick_density(self, state: State, dt: ArrayLike) -> tuple[State, Array]:
        """The state with ρ + ½εG(y), and whether σ and the new ρ are positive."""
        extra = dict(state.extra or {})
        sigma, slope = jax.jvp(self._sigma, (state,), (time_derivative(self.system, state),))
        positive = (sigma > 0) & jnp.isfinite(sigma)
        rho = extra[_KEY] - 0.5 * dt * slope / jnp.where(positive, sigma, 1)
        return state._replace(extra=extra | {_KEY: rho}), positive & (rho > 0) & jnp.isfinite(rho)

    def _sigma(self, state: State) -> Array:
        sigma = jnp.asarray(self.sigma(state))
        if sigma.shape != () or not jnp.issubdtype(sigma.dtype, jnp.floating):
            raise ValueError(f"sigma must have a real scalar value, got shape {sigma.shape} and dtype {sigma.dtype}")
        return sigma.astype(state.p.dtype)


def examples(system: System) -> dict[str, Step]:
    """Splittings of systems with a potential, with steps that are short where the momentum is large."""
    made = [
        reversible_control(step, _calm)
        for step in base_examples(system).values()
        if isinstance(system, AbstractForcedSystem)
    ]
    return {step.name: step for step in made}


def _calm(state: State) -> Array:
    return 1 / jnp.sqrt(1 + jnp.sum(state.p**2))


reversible_control = ReversibleControl
