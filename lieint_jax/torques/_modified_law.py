"""Laws that change the torque of another law: with a limit, or in a window of time."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax._checks import named, positive
from lieint_jax._numerics.arrays import Calls, PyTree
from lieint_jax.core import Converted, Law, LawSum, Rotation, argument, as_law, pytree
from lieint_jax.torques._arguments import cut
from lieint_jax.torques._damping import Viscous
from lieint_jax.torques._window import mean_in_window, window

__all__ = ["saturated", "windowed"]


def without_state(law: Any) -> Law:
    """One law without an internal state, whose torque may be cut or switched off."""
    law = as_law(law)
    if isinstance(law, LawSum):
        raise ValueError("a sum of laws cannot be cut or switched off: do so to each of its laws, and add the results")
    if law.key is not None:
        raise ValueError(
            f'{type(law).__name__} has the internal state State.extra["{law.key}"], so its torque cannot be cut or '
            "switched off: do so to the law that it samples; give wheels a max_torque"
        )
    return law


class ModifiedLaw(Law):
    """A law without an internal state whose torque is that of another law, changed by its `mean`.

    Its axes, what it reads, its symmetry and its label are those of the other law. A subclass is decorated with
    `li.pytree`, has a field `law` and defines `mean`.
    """

    law: Law

    @property
    def frame(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.law.frame

    @property
    def symmetric(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.law.symmetric

    @property
    def reads(self) -> str | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.law.reads

    @property
    def label(self) -> str:
        return self.law.label


@pytree
class Saturated(ModifiedLaw):
    """A law whose torque has a limit, component by component in the axes of its frame.

    The energy of the law, such as the potential of a controller, is still counted; the work is that of the limited
    torque.

    Args:
        law: a law without an internal state, or a function of (t, q, Ω).
        limit: the largest torque, > 0, a number or one for each axis, (3,).

    Raises:
        ValueError: a limit that is not positive; a law with an internal state, such as wheels, which have a
            `max_torque` of their own.
    """

    law: Converted[Law] = argument(converter=without_state)
    limit: Converted[Array] = argument(converter=named(positive, "limit", (), (3,)))

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """The law's mean torque, each component within ± the limit."""
        return cut(self.law.mean(rotation, inner)[0], self.limit), inner

    def energy(self, t: Array, q: Array, inner: PyTree) -> Array:
        """That of the law."""
        return self.law.energy(t, q, inner)


@pytree
class Windowed(ModifiedLaw):
    """A law that acts in a window of time. Made by `windowed`."""

    law: Law
    begin: Array
    stop: Array

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """The law's mean torque times the part of the step in the window."""
        return mean_in_window(rotation, self.begin, self.stop, self.law.mean(rotation, inner)[0]), inner


def windowed(law: Law, start: ArrayLike, stop: ArrayLike | None = None) -> Windowed:
    """A law that acts from time `start` to time `stop` only, such as a controller that is switched on after a while.

    In a step that the window begins or ends in, its torque is that of the step times the part of the step in the
    window. So steps may end anywhere at order 2, and derivatives with respect to start and stop are right; a
    composition of higher order needs steps that end there. The work is that of the torque; an energy of the law, such
    as the potential of a controller, is not counted. For a digital controller, `sampled(windowed(law, …), period)`,
    which acts from its first sample in the window.

    Args:
        law: a law without an internal state, or a function of (t, q, Ω) in the body.
        start, stop: times, start ≤ stop, on the clock of `State.t`; None is never.

    Raises:
        ValueError: stop < start; a sum of laws, or a law with an internal state, such as wheels.

    Example:
        >>> import lieint_jax as li
        >>> law = li.torques.windowed(li.torques.viscous(0.1), start=5.0)
        >>> body = li.systems.torqued_body([1.0, 2.0, 3.0], law)
        >>> start = body.state(angular_velocity=[0.0, 0.0, 1.0], t=0.0)
        >>> run = li.run(li.schemes.torqued_midpoint(body), start, 0.1, 100, save_every=50)
        >>> [round(float(p), 3) for p in run.state.p[:, 2]]
        [3.0, 3.0, 2.539]
    """
    return Windowed(without_state(law), *window("a window", start, stop))


saturated = Saturated


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    law = Viscous(0.4)
    return {
        "saturated": partial(saturated, law=law, limit=jnp.array([0.1, 0.2, 0.3])),
        "windowed": partial(windowed, law=law, start=0.72, stop=0.77),
    }
