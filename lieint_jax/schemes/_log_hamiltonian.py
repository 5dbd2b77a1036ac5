"""The logarithmic Hamiltonian: symplectic steps that adapt to the potential.

The flow of ln(K + B) − ln(−V) with B = −E has the orbits of H = K + V of energy E, in a fictitious time s with
dt/ds = 1/(K + B) = 1/(−V). K is constant during the drift and V during the kick. So with h = Δs a step of order 2 is
explicit:

    (q, π, t) ← the free motion for (h/2)/(K + B),    π ← π + h F(q)/(−V(q)),    the free motion for (h/2)/(K + B)

where K is that of the momentum at each drift.
"""

from __future__ import annotations

from dataclasses import field

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import at_once, concrete, real_array
from lieint_jax.core import State, Step, StepInfo, promoted, pytree, static
from lieint_jax.schemes._catalogue import SchemeProperties, hint
from lieint_jax.schemes._exact import exact
from lieint_jax.schemes._shared.half_rotation import attitude_error_limit
from lieint_jax.schemes._shared.stages import compose_stages
from lieint_jax.systems._equations import AbstractDrivenSystem, AbstractForcedSystem, AbstractFreeBody

__all__ = ["LogHamiltonian", "log_hamiltonian"]

_KEY = "energy"
_OFF = 0.1  # the largest |ln((K + B)/(−V))| in a step; it is O(h²) for a state of energy E
_STARTS = 1e-3  # the same at the start of a run

PROPERTIES = SchemeProperties(
    name="log_hamiltonian",
    systems="tops with V < 0",
    conserves=("momentum", "form (of the extended phase space)"),
    limit="a step of fictitious time",
    aliases=("logarithmic Hamiltonian", "Mikkola–Tanikawa", "Preto–Tremaine"),
    source="Mikkola & Tanikawa 1999; Preto & Tremaine 1999",
    accepts=(AbstractForcedSystem,),
)


@pytree
class LogHamiltonian(Step):
    """The logarithmic Hamiltonian: symplectic steps that are short where the potential is deep, Δt ≈ dt/(−V).

    `dt` is a step of the fictitious time s, in units of energy × time. The step advances `state.t`, which is required:
    `step.start(state)` provides it. For V = −μ/r, Δt is proportional to r.

    | conserved | to |
    |---|---|
    | the symplectic form | round-off |
    | γ·π, if the potential has an axis γ | round-off |
    | energy | O(dt²), bounded, no drift |

    The states as functions of `state.t` are of second order; the step is time-symmetric; `compose` raises the order.

    A constant may be subtracted from a potential to make it negative; it determines how much the steps vary. A state
    whose energy differs from E by δ moves as if the potential were 1 + δ/(−V) times as strong. `start` raises an error
    for a concrete state with δ above 1e-3 of −V, and a step with δ above 0.1 of −V reports `converged=False`. So does
    one where K is so much larger than −V that rounding K + B changes the rotation of the step by more than 1e-6 (in
    float32 3e-4) of itself.

    Args:
        system: a rigid body in a potential, `systems.heavy_top(...)` or `systems.potential_top(...)`, with V < 0
            wherever the body goes. The drift is its exact free motion: with an approximate drift, whose error depends
            on K, the form would not be conserved.
        energy: E, that of the initial state; by default `start` writes that of each state to `state.extra["energy"]`.

    Raises:
        ValueError: the system is none of these, or driven, so that its energy is not constant; the energy is not a
            finite scalar. At the start of a run: a state with −V ≤ 0 or K − E ≤ 0, or of another energy. Inside jit
            such a step reports `converged=False`.

    Source: Mikkola & Tanikawa 1999, Mon. Not. R. Astron. Soc. 310; Preto & Tremaine 1999, Astron. J. 118.
    """

    system: AbstractForcedSystem
    energy: ArrayLike | None = None
    drift: Step = field(init=False)
    order: float = static(default=2, init=False)
    symmetric: bool = static(default=True, init=False)
    own_time = True

    def check_fields(self) -> dict[str, object]:
        system, energy = self.system, self.energy
        if isinstance(system, AbstractDrivenSystem):
            raise ValueError(
                f"log_hamiltonian needs a constant energy, got {type(system).__name__}, whose potential depends on "
                "time; use splitting, with steps given by li.run(times=…)"
            )
        if not (isinstance(system, AbstractForcedSystem) and isinstance(system.free, AbstractFreeBody)):
            raise ValueError(
                "log_hamiltonian integrates rigid bodies in a potential (systems.heavy_top, systems.potential_top), "
                f"whose free motion is known exactly, got {type(system).__name__}{hint(system)}"
            )
        free = system.free
        PROPERTIES.check(system)
        if energy is not None:
            energy = real_array("energy", energy, (), like=free.inertia)
        return {"energy": energy, "drift": exact(free)}

    @property
    def name(self) -> str:
        return f"log_hamiltonian[{self.drift.name}]"

    def start(self, state: State) -> State:
        """`state`, at t = 0 if it has no time, and with its energy in `extra` if the step has none.

        Raises ValueError if E is not its energy.
        """
        step, state, dtype = promoted(self, state)
        step.system.check(state)
        if state.t is None:
            state = state._replace(t=jnp.zeros((), dtype))
        if step.energy is None:
            state = state._replace(extra={**(state.extra or {}), _KEY: step.system.energy(state)})
        if concrete(step, state):
            with at_once():
                depth, speed = -step._potential(state), step._speed(state)
                if not (min(depth, speed) > 0 and abs(speed / depth - 1) <= _STARTS):
                    raise ValueError(step._energies(state))
        return state

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        def stage(carry: tuple[State, Array], kick: Array) -> tuple[tuple[State, Array], StepInfo]:
            """Half a drift, and the kick times 1 or 0."""
            state, off = carry
            state, speed, info = self._drift(state, 0.5 * dt)
            depth, known = _positive(-self._potential(state))
            off = off + jnp.log(speed) / 2 - kick * jnp.log(depth)
            info = info._replace(converged=info.converged & (known | (kick == 0)))
            state = state._replace(p=state.p + kick * dt / depth * self.system.force(state.q))
            return (state, off), info

        zero = jnp.zeros_like(state.p[0])
        (state, off), info = compose_stages(stage, (state, zero), (jnp.array([1.0, 0.0], zero.dtype),))
        return state, info._replace(converged=info.converged & (jnp.abs(off) <= _OFF))

    def _drift(self, state: State, half: ArrayLike) -> tuple[State, Array, StepInfo]:
        """The state after the free motion for half/(K + B), K + B, and the report."""
        speed, known = _positive(self._speed(state))
        end, info = self.drift.substep(state, half / speed)
        kept = jnp.finfo(speed.dtype).eps * (speed + self._energy(state)) <= attitude_error_limit(speed.dtype) * speed
        return end, speed, info._replace(converged=info.converged & known & kept)

    def advice(self, state: State, dt: ArrayLike) -> str:
        return (
            f"{self._energies(state)}. If they agree, dt = {dt} is too large: a step of the fictitious time is about "
            "−V times that of the physical one"
        )

    def _speed(self, state: State) -> Array:
        """K + B, which is ds/dt."""
        return self.system.free.energy(state) - self._energy(state)

    def _energy(self, state: State) -> Array:
        """E."""
        if self.energy is not None:
            return jnp.asarray(self.energy)
        if _KEY not in (state.extra or {}):
            raise ValueError(f'the state needs its energy, state.extra["{_KEY}"]: use step.start(state)')
        return state.extra[_KEY]  # pyright: ignore[reportOptionalSubscript]

    def _potential(self, state: State) -> Array:
        """V."""
        return self.system.energy(state._replace(p=jnp.zeros_like(state.p)))

    def _energies(self, state: State) -> str:
        H, V = (float(x) for x in (self.system.energy(state), self._potential(state)))
        return (
            f"{self.name} needs states of its energy, with −V > 0 and K − energy > 0: got energy = "
            f"{float(self._energy(state)):.9g}, a state with H = {H:.9g} and V = {V:.9g}"
        )


def _positive(x: Array) -> tuple[Array, Array]:
    """x, or 1 where it is not positive; and whether it is."""
    return jnp.where(x > 0, x, 1), x > 0


@PROPERTIES.by_name
def examples(system: AbstractForcedSystem) -> list[Step]:
    """The scheme for rigid bodies in a potential that is negative at the origin of their phase space."""
    origin = system.phase_space.origin
    deep = isinstance(system.free, AbstractFreeBody) and system.energy(origin._replace(p=jnp.zeros_like(origin.p))) < 0
    return [log_hamiltonian(system)] if deep else []


log_hamiltonian = LogHamiltonian
