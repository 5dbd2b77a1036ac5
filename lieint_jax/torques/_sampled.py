"""A digital controller: it looks at the body at equal times, and holds its torque in between."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import named, positive
from lieint_jax.torques._actuators import control_laws, control_torque
from lieint_jax.types import Law, Rotation, argument, pytree, static
from lieint_jax.types.shapes import PyTree

__all__ = ["Sampled", "sampled"]

_NEAR = 1 / 16  # of a step: how far from a sample, by the rounding of the time, a step may begin
_EQUAL = 1e-5  # relative: how far from a multiple of dt, by rounding, the period may be


@pytree
class Sampled(Law):
    """A digital controller: a law sampled at t = 0, period, 2 period, …, whose torque is held in the body in between.

    Each sample evaluates the law at the state of that moment, at the start of a step. `State.extra[key]` is the torque
    held, (3,); before the first sample it is the one at the initial state. The work is that of the torque held. There
    is no way back, for samples of the past are not known.

    Args:
        law: a law without an internal state, a sum of such laws, or a function (t, q, Ω) ↦ (3,) in the body.
        period: between two samples, > 0. A step that could pass over a sample is refused, and reports
            `converged=False`: Δt > 0 divides the period, and runs begin at a multiple of Δt.
        key: the name of the torque held in `State.extra`; several controllers need several names.

    Raises:
        ValueError: a law with an internal state, such as wheels; a period that is not positive.

    Source: Franklin, Powell & Workman 1998, Digital Control of Dynamic Systems: the zero-order hold.

    Example:
        >>> import lieint_jax as li
        >>> law = li.torques.sampled(li.torques.bdot(0.1, [0.0, 0.0, 1.0]), period=0.1)
        >>> satellite = li.systems.torqued_body([1.0, 2.0, 3.0], law)
        >>> satellite.state(angular_velocity=[1.0, 0.0, 0.5]).extra["sampled"].tolist()
        [-0.1, 0.0, 0.0]
    """

    law: tuple[Law, ...] = argument(converter=control_laws)
    period: Array = argument(converter=named(positive, "period"))
    key: str = static(default="sampled")  # pyright: ignore[reportIncompatibleVariableOverride]
    symmetric = False
    samples = True

    @property
    def label(self) -> str:
        return self.key

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """The torque held."""
        return inner, inner

    def start(self, now: Rotation) -> Array:
        """The torque of the law at this instant."""
        return control_torque(self.law, now.t, now.q_n, now.Omega)

    def sample(self, now: Rotation, dt: Array, inner: Array) -> tuple[Array, Array]:
        """The torque to hold in a step of dt from now, and whether no step of dt passes over a sample."""
        at_sample = jnp.abs(now.t - jnp.round(now.t / self.period) * self.period) <= _NEAR * jnp.abs(dt)
        moves = dt != 0
        number, passed = (x / jnp.where(moves, dt, 1) for x in (self.period, now.t))
        divides = jnp.abs(number - jnp.round(number)) <= _EQUAL * number
        fits = (dt > 0) & divides & (jnp.abs(passed - jnp.round(passed)) <= _NEAR)
        return jnp.where(at_sample, self.start(now), inner), fits | ~moves

    def refusal(self, t: Array, dt: ArrayLike) -> str:
        """Which steps the law accepts."""
        return (
            f"{self.label} samples at multiples of {float(self.period):g}, and no step may go back or pass over a "
            f"sample: give a dt > 0 that divides {float(self.period):g} and a start at a multiple of dt, got dt = {dt} "
            f"at t = {t}"
        )


sampled = Sampled
