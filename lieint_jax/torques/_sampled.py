"""A digital controller: it looks at the body at equal times, and holds its torque in between."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax._checks import named, positive
from lieint_jax.torques._actuators import control_laws, control_torque
from lieint_jax.types import Law, Rotation, argument, pytree, static
from lieint_jax.types.shapes import PyTree

__all__ = ["Sampled", "sampled"]

_NEAR = 1 / 16  # of a step: how far from a sample, by the rounding of the time, a step may begin or end


@pytree
class Sampled(Law):
    """A digital controller: a law sampled at t = 0, period, 2 period, …, whose torque is held in the body in between.

    Each sample evaluates the law at the state of that moment, at the start of a step. `State.extra[key]` is the torque
    held, (3,); before the first sample it is the one at the initial state. The work is that of the torque held. The
    samples of the past are not known, so a step of Δt < 0 reports `converged=False`.

    Args:
        law: a law without an internal state, a sum of such laws, or a function (t, q, Ω) ↦ (3,) in the body.
        period: between two samples, > 0. Steps must not pass over a sample, so Δt divides the period and the first
            step begins at a multiple of Δt: others are refused, and report `converged=False`.
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
        """The torque to hold in a step of dt from now, and whether the step passes over no sample and dt ≥ 0."""
        near = _NEAR * jnp.abs(dt)
        last = jnp.floor((now.t + near) / self.period)
        following = jnp.ceil((now.t + dt - near) / self.period)
        at_sample = jnp.abs(now.t - last * self.period) <= near
        return jnp.where(at_sample, self.start(now), inner), (following - last <= 1) & (dt >= 0)

    def refusal(self, t: float, dt: float) -> str:
        """Why the law does not take a step."""
        period, allowed = float(self.period), "give a dt > 0 that divides the period, and start at a multiple of dt"
        if dt < 0:
            return f"a sampled law does not know its samples of the past, and got dt = {dt:g}: {allowed}"
        number, start = (x / dt if dt else 0.0 for x in (period, t))
        if dt and abs(number - round(number)) > 1e-5 * number:
            return f"dt = {dt:g} does not divide the period {period:g} of {self.key}: {allowed}"
        if abs(start - round(start)) > _NEAR:
            return f"t = {t:g} is no multiple of dt = {dt:g}, so a step would pass over a sample of {self.key}: {allowed}"
        return ""


sampled = Sampled
