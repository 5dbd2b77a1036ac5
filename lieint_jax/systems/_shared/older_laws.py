"""Laws as version 0.2 had them: a class with some of `mean`, `power`, `potential`, `during`, `key`, `inner`."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from lieint_jax.types import Law, Rotation, pytree, static
from lieint_jax.types.shapes import PyTree

MEMBERS = ("frame", "potential", "power", "mean", "during", "key")  # what such a class may offer besides a call


@pytree
class OlderLaw(Law):
    """A pytree that is called with (t, q, velocity), or that has some of `MEMBERS`, as a `Law`.

    | member | |
    |---|---|
    | `potential(q)` | U, counted in the energy; then the torque contains −∂U |
    | `power(t, q, velocity)` | the power of all but −∂U, such as −c\\|ω\\|² |
    | `mean(t, q_n, q_next, h, kappa, velocity)` | the torque of a step, if not that at its half |
    | `during(dt, extra)` | the law as it acts in a step of size dt on a state with this `extra` |
    | `key`, `inner(omega)`, `inner_energy(momentum)` | a momentum in space that the torque is taken from |
    """

    law: Any
    frame: str = static()  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def key(self) -> str | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        return getattr(self.law, "key", None)

    @property
    def internal(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.key is not None

    @property
    def label(self) -> str:
        return type(self.law).__name__.lower()

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        law, velocity = self._during(rotation.dt, inner), rotation.velocity(self.frame)
        match law:
            case object(mean=mean):
                r = rotation
                torque = mean(r.t, r.q_n, r.q_next, r.h, r.kappa, velocity)
            case _:
                torque = law(rotation.t, rotation.q_mid, velocity)
        return torque, None if inner is None else inner - rotation.dt * jnp.asarray(torque)

    def energy(self, t: Array, q: Array, inner: PyTree) -> Array:
        energy = jnp.zeros((), q.dtype) if inner is None else self.law.inner_energy(inner)
        match self.law:
            case object(potential=potential):
                energy = energy + potential(q)
        return energy

    def work(self, rotation: Rotation, torque: Array, inner: PyTree, after: PyTree) -> Array:
        match self._during(rotation.dt, inner):
            case object(power=power):
                return rotation.dt * power(rotation.t, rotation.q_n, rotation.velocity(self.frame))
        return super().work(rotation, torque, inner, after)

    def start(self, now: Rotation) -> Array | None:
        return self.law.inner(now.omega) if self.internal else None

    def momentum(self, q: Array, inner: PyTree) -> Array:
        return inner if self.internal else jnp.zeros_like(q[1:])

    def _during(self, dt: Array, inner: PyTree) -> Any:
        match self.law:
            case object(during=during):
                return during(dt, None if inner is None else {self.key: inner})
        return self.law
