"""Laws that change the torque of another law: with a limit, or in a window of time."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete, named, positive
from lieint_jax.torques._arguments import cut
from lieint_jax.types import Converted, Law, LawSum, Rotation, argument, as_law, pytree
from lieint_jax.types.shapes import PyTree

__all__ = ["ModifiedLaw", "Saturated", "Windowed", "saturated", "windowed"]


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
    """A law that acts in steps whose midpoint lies in a window of time. Made by `windowed`."""

    law: Law
    begin: Array
    stop: Array

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """The law's mean torque in the window, else 0."""
        inside = (self.begin <= rotation.t) & (rotation.t < self.stop)
        outside = (rotation.t < self.begin) | (self.stop <= rotation.t)  # neither for NaN
        torque = self.law.mean(rotation, inner)[0]
        return jnp.where(inside, torque, jnp.where(outside, 0, jnp.nan)), inner


def windowed(law: Law, start: ArrayLike, stop: ArrayLike | None = None) -> Windowed:
    """A law that acts from time `start` to time `stop` only, such as a controller that is switched on after a while.

    It acts in the steps whose midpoint lies in the window, so order 2 needs steps that end at start and stop. The work
    is that of its torque; an energy of the law, such as the potential of a controller, is not counted. For a digital
    controller, `sampled(windowed(law, …), period)`.

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
    first = _checks.real_array("start", start, ())
    last = jnp.full_like(first, jnp.inf) if stop is None else _checks.real_array("stop", stop, ())
    if concrete(first, last) and float(last) < float(first):
        raise ValueError(f"a window must not end before it starts, got start = {first} and stop = {last}")
    return Windowed(without_state(law), first, last)


saturated = Saturated
