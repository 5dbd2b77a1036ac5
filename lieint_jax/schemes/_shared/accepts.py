"""The systems that a scheme integrates: those that declare a capability and have its equations of motion.

A subclass may inherit a capability but change the motion, by an additional force or a rotor. So the factory of a step
compares the system's own vector field with the one that the scheme integrates.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Generic, NamedTuple, TypeGuard, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import at_once, concrete
from lieint_jax._xla import compiled
from lieint_jax.groups import MatrixGroup
from lieint_jax.types import (
    AbstractDampedBody,
    AbstractDissipativeBodies,
    AbstractDrivenGyrostat,
    AbstractGyrostat,
    AbstractIncompressibleBody,
    AbstractTorquedBody,
    AbstractViscousBody,
    State,
    System,
)

_System = TypeVar("_System", bound=System)
_Data = TypeVar("_Data")
_PACKAGE = __name__.partition(".")[0]
_ELSEWHERE = {  # what takes the systems that few schemes take
    AbstractGyrostat: ("so3_midpoint", "splitting"),
    AbstractDrivenGyrostat: ("so3_midpoint",),
    AbstractTorquedBody: ("torqued_midpoint",),
    AbstractDampedBody: ("torqued_midpoint",),
    AbstractDissipativeBodies: ("bodies_energy_momentum",),
    AbstractViscousBody: ("additive",),
    AbstractIncompressibleBody: ("additive",),
}


class AcceptedSystems(NamedTuple, Generic[_System]):
    """The systems that a scheme integrates.

    Attributes:
        capability: the class in `types` that such a system inherits.
        noun: the name of these systems in error messages.
        vector_field: (system, state) ↦ the time derivative of the state, from the capability's attributes alone.
    """

    capability: type[_System]
    noun: str
    vector_field: Callable[[_System, State], State]

    def declared(self, system: object) -> TypeGuard[_System]:
        """Whether a system declares the capability."""
        return isinstance(system, self.capability)

    def check(self, scheme: str, system: object, more: str = "") -> None:
        """Raise ValueError if a system does not declare the capability, or its vector field is another.

        `more` is appended to the message.
        """
        if not self.declared(system):
            raise ValueError(
                f"{scheme} integrates {self.noun}, got {type(system).__name__}{hint(scheme, system) or more}"
            )
        check_motion(scheme, self.noun, self.vector_field, system, system)


def hint(scheme: str, system: object) -> str:
    """The end of a message that `scheme` does not accept a system: the schemes that do, if they are few."""
    fitting = next((names for kind, names in _ELSEWHERE.items() if isinstance(system, kind)), ())
    return f"; use {' or '.join(fitting)}" if fitting and scheme not in fitting else ""


def check_motion(
    scheme: str, noun: str, vector_field: Callable[[_Data, State], State], data: _Data, system: System
) -> None:
    """Raise ValueError if the vector field of a system differs from `vector_field(data, ·)` at two test states.

    Tracers, and a vector field that is not finite at these states, are accepted: they cannot be compared.
    """
    difference = vector_field_mismatch(vector_field, data, system)
    if difference:
        raise ValueError(
            f"{scheme} integrates {noun}; {type(system).__name__}.vector_field differs from their equations of motion "
            f"(relative difference {difference:.2g}). Use another scheme or fix vector_field"
        )


def vector_field_mismatch(vector_field: Callable[[_Data, State], State], data: _Data, system: System) -> float:
    """The relative difference of the vector field of a system from `vector_field(data, ·)`; 0 if within rounding.

    It is also 0 for tracers and for a vector field that is not finite where they are compared, and for systems of this
    package, whose vector fields the tests compare (see `_is_tested`).
    """
    if (data is system and _is_tested(system)) or not concrete(data, system):
        return 0.0
    with at_once():
        found = [_difference(vector_field, data, system, phase) for phase in (0.3, 2.0)]
    difference, tolerance = (max(map(float, x)) for x in zip(*found, strict=True))
    return difference if difference > tolerance else 0.0


def _is_tested(part: object) -> bool:
    """Whether a system, or a part of it, is a class of this package without functions or subclasses of users."""
    if part is None or isinstance(part, Array | np.ndarray | bool | int | float | str | MatrixGroup | ModuleType):
        return True
    fields = dataclasses.fields(part) if dataclasses.is_dataclass(part) else None
    own = type(part).__module__.startswith(f"{_PACKAGE}.")
    return own and fields is not None and all(_is_tested(getattr(part, field.name)) for field in fields)


@partial(compiled, static_argnums=0, once=True)
def _difference(
    vector_field: Callable[[_Data, State], State], data: _Data, system: System, phase: ArrayLike
) -> tuple[Array, Array]:
    """The relative difference of two vector fields at a state and a time, and the tolerance for it."""
    space = system.phase_space
    numbers = [x for x in jax.tree.leaves((data, system)) if jnp.issubdtype(jnp.result_type(x), jnp.floating)]
    dtype = jnp.result_type(*numbers, *([] if numbers else [float]))
    delta = 0.3 * jnp.sin(phase + 1.7 * jnp.arange(space.dim, dtype=dtype))
    state = space.perturb(jax.tree.map(lambda x: x.astype(dtype), space.origin), delta)
    extra = jax.tree.map(
        lambda x: x + jnp.cos(phase + 1.3 * jnp.arange(x.size, dtype=dtype)).reshape(x.shape), system.initial_extra
    )
    state = state._replace(t=jnp.asarray(phase, dtype), extra=extra)
    own, scheme = system.vector_field(state), vector_field(data, state)
    pairs = zip(*(jax.tree.leaves((rate.q, rate.p, rate.extra)) for rate in (own, scheme)), strict=True)
    return jnp.max(jnp.stack([_relative(*pair) for pair in pairs])), jnp.sqrt(jnp.finfo(dtype).eps)


def _relative(a: Array, b: Array) -> Array:
    size, apart = jnp.maximum(jnp.max(jnp.abs(a)), jnp.max(jnp.abs(b))), jnp.max(jnp.abs(a - b))
    known = jnp.isfinite(size) & (apart > 0)
    return jnp.where(known, apart / jnp.where(known, size, 1), 0)
