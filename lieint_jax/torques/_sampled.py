"""A digital controller: it looks at the body at equal times, and holds its torque in between."""

from __future__ import annotations

from functools import partial

from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import named, positive
from lieint_jax._numerics.arrays import Calls, PyTree
from lieint_jax.core import Converted, Law, Rotation, argument, pytree, static
from lieint_jax.torques._actuators import control_laws, control_torque
from lieint_jax.torques._damping import Viscous
from lieint_jax.torques._hold import held_in_step, why_not

__all__ = ["Sampled", "sampled"]


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
        ValueError: a law with an internal state; a period that is not positive. Wheels have a period of their own.

    Source: Franklin, Powell & Workman 1998, Digital Control of Dynamic Systems: the zero-order hold.

    Example:
        >>> import lieint_jax as li
        >>> law = li.torques.sampled(li.torques.bdot(0.1, [0.0, 0.0, 1.0]), period=0.1)
        >>> satellite = li.systems.torqued_body([1.0, 2.0, 3.0], law)
        >>> satellite.state(angular_velocity=[1.0, 0.0, 0.5]).extra["sampled"].tolist()
        [-0.1, 0.0, 0.0]
    """

    law: Converted[tuple[Law, ...]] = argument(converter=control_laws)
    period: Converted[Array] = argument(converter=named(positive, "period"))
    key: str = static(default="sampled")  # pyright: ignore[reportIncompatibleVariableOverride]
    symmetric = False

    @property
    def held(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.key

    @property
    def label(self) -> str:
        return self.key

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """The torque held."""
        return inner, inner

    def start(self, now: Rotation) -> Array:
        """The torque of the law at this instant."""
        return control_torque(self.law, now.t, now.q_n, now.Omega)

    def measured(self, now: Rotation, inner: PyTree) -> Array:
        """The same."""
        return self.start(now)

    def sample(self, now: Rotation, dt: Array, inner: PyTree, held: Array) -> tuple[Array, Array]:
        """The torque to hold in a step of dt from now, and whether no step of dt passes over a sample."""
        return held_in_step(self.period, now.t, dt, self.start(now), held)

    def refusal(self, t: Array, dt: ArrayLike) -> str:
        """Which steps the law accepts."""
        return why_not(self.label, self.period, t, dt)


sampled = Sampled


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    return {"sampled": partial(sampled, law=Viscous(0.4), period=0.2, key="sampled")}
