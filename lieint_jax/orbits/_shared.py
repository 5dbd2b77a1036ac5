"""Functions of time that all members of an ensemble share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._numerics.arrays import Calls
from lieint_jax._xla import rereading_jit
from lieint_jax.core import pytree, static
from lieint_jax.orbits._kepler import kepler

__all__ = ["shared"]


@dataclass(frozen=True, eq=False)
class _Constant:
    """A pytree whose arrays are constants of the programs that use it, compared by their values."""

    value: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Constant) and self._identity == other._identity

    def __hash__(self) -> int:
        return hash(self._identity)

    @property
    def _identity(self) -> tuple[Any, ...]:
        leaves, structure = jax.tree.flatten(self.value)
        return structure, *((str(x.dtype), x.tobytes()) for x in map(np.asarray, leaves))


@pytree
class SharedFunction:
    """A function of time without leaves. Made by `shared`."""

    function: _Constant = static()

    def __call__(self, t: ArrayLike) -> Any:
        return _call(self.function, _value_at, t)

    @property
    def frame(self) -> str:
        """The axes of a shared orbit, "" if they are not named."""
        return getattr(self.function.value, "frame", "")

    @property
    def center(self) -> str:
        """The body at the origin of a shared orbit, "" if it is not named."""
        return getattr(self.function.value, "center", "")


@pytree
class SharedFrame(SharedFunction):
    """A frame without leaves. Made by `shared`."""

    def angular_velocity(self, t: ArrayLike) -> Array:
        """The angular velocity in the axes of the frame."""
        return _call(self.function, _angular_velocity, t)


@partial(rereading_jit, static_argnums=(0, 1))
def _call(function: _Constant, ask: Callable[[Any, ArrayLike], Any], t: ArrayLike) -> Any:
    return ask(function.value, t)


def _value_at(function: Callable[[ArrayLike], Any], t: ArrayLike) -> Any:
    return function(t)


def _angular_velocity(frame: Any, t: ArrayLike) -> Array:
    return frame.angular_velocity(t)


def shared(function: Any) -> SharedFunction:
    """A function of time that all members of an ensemble share, such as an orbit or a field along it.

    Its numbers are constants: a step of one system per member computes it once for all of them, and traces it once,
    although every iteration of the step calls it. It has no derivatives by its numbers.

    Args:
        function: t ↦ values, a pytree such as `kepler(…)`, `earth_field(…)`, or a frame, `lvlh(…)`.

    Example:
        >>> import lieint_jax as li
        >>> orbit = shared(li.orbits.kepler(1.0, 1.0, 0.1))
        >>> jax.tree.leaves(orbit), orbit(0.0)[0].tolist()
        ([], [0.9, 0.0, 0.0])
    """
    kind = SharedFrame if hasattr(function, "angular_velocity") else SharedFunction
    return kind(_Constant(function))


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    return {"shared": partial(shared, function=kepler(1.3, 1.2, 0.1))}
