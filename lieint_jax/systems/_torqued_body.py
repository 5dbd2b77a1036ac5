"""A rigid body with a torque: any law of time, attitude and angular velocity."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks, torques
from lieint_jax._checks import concrete
from lieint_jax._numerics import vec3
from lieint_jax._xla import compiled
from lieint_jax.groups import so3
from lieint_jax.systems._shared.body import TimedBody
from lieint_jax.types import AbstractTorquedBody, State, callable_pytree, clock, pytree, static

_MORE = ("frame", "potential", "power", "mean", "during", "key")  # what a law may offer besides being called


@pytree
class TorquedBody(TimedBody, AbstractTorquedBody):
    """H = ½ Π·J⁻¹Π + U: Λ̇ = ΛΩ̂, π̇ = τ(t, q, ω) in space, or π̇ = ΛT(t, q, Ω) in the body. Made by `torqued_body`.

    Attributes:
        inertia: J in the body frame, principal moments (3,) or a symmetric tensor (3, 3).
        torque: τ or T, a law as in `types.AbstractTorquedBody`.
        frame: "body" or "space", the axes of the torque and of the angular velocity it is given.
    """

    inertia: Array
    torque: Callable[..., Array]
    frame: str = static()

    @property
    def carried(self) -> dict[str, Array] | None:
        """The momentum at rest that the torque is taken from, by its key; None if there is none."""
        key = getattr(self.torque, "key", None)
        return None if key is None else {key: jnp.zeros(3, self.inertia.dtype)}

    def state(self, *arguments: Any, **options: Any) -> State:
        state = super().state(*arguments, **options)
        if self.carried is None:
            return state
        turning: Any = self.torque
        omega = so3.Ad(state.q, self.angular_velocity(state))
        return state._replace(extra={turning.key: turning.inner(omega).astype(state.p.dtype)})

    state.__doc__ = f"""{TimedBody.state.__doc__}
        A momentum that the torque is taken from, as a damper's, is that of a damper which turns with the body.
        """

    def torque_at(self, state: State) -> Array:
        """The torque, (3,), in the axes of `frame`."""
        return self._law(state)(clock(state), state.q, self._velocity(state)).astype(state.p.dtype)

    def power(self, state: State) -> Array:
        """The power of the torque but for that of its potential, a scalar: the rate of `State.work`."""
        law: Any = self._law(state)
        t, q, omega = clock(state), state.q, self._velocity(state)
        if hasattr(law, "power"):
            return law.power(t, q, omega)
        power = vec3.dot(omega, law(t, q, omega))
        if not hasattr(law, "potential"):
            return power
        q_dot = so3.tangent(q, self.angular_velocity(state))
        return power + jax.jvp(law.potential, (q,), (q_dot,))[1]

    def energy(self, state: State) -> Array:
        """½ Π·J⁻¹Π, with the torque's potential if it has one, and the energy of a momentum it is taken from."""
        law: Any = self.torque
        energy = self.kinetic_energy(state)
        if hasattr(law, "potential"):
            energy = energy + law.potential(state.q)
        if self.carried is not None:
            energy = energy + law.inner_energy(self._carried(state))
        return energy

    def momentum(self, state: State) -> Array:
        """π with the momentum that the torque is taken from, (3,), as of a damper; (0,) for a torque from outside."""
        return state.p[:0] if self.carried is None else state.p + self._carried(state)

    def vector_field(self, state: State) -> State:
        """(q̇, π̇) = (½ q Ω, τ), the power as the rate of the work, and −τ as that of a momentum it is taken from."""
        torque = self.torque_at(state)
        torque = so3.Ad(state.q, torque) if self.frame == "body" else torque
        extra = jax.tree.map(jnp.zeros_like, state.extra)
        if self.carried is not None:
            extra = {**(extra or {}), self._key: -torque}
        q_dot = so3.tangent(state.q, self.angular_velocity(state))
        return State(q_dot, torque, work=self.power(state), extra=extra)

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system, or has no time."""
        super().check(state)
        clock(state)
        if self.carried is not None:
            _checks.real_array(f'state.extra["{self._key}"]', self._carried(state), (3,))
        if concrete(self, state) and not np.all(np.isfinite(torque := _torque_at(self, state))):
            raise ValueError(
                f"the torque must be finite, got {np.asarray(torque)} at t = {float(clock(state)):g}, "
                f"q = {np.asarray(state.q)}, ω = {np.asarray(self._velocity(state))} in the {self.frame}: fix the law"
            )

    @property
    def _key(self) -> str:
        law: Any = self.torque
        return law.key

    def _carried(self, state: State) -> Array:
        self._law(state)  # which says what to do where the momentum is missing
        assert state.extra is not None
        return state.extra[self._key]

    def _law(self, state: State) -> Callable[..., Array]:
        return self.law(jnp.zeros((), state.p.dtype), state.extra)

    def _velocity(self, state: State) -> Array:
        Omega = self.angular_velocity(state)
        return so3.Ad(state.q, Omega) if self.frame == "space" else Omega


@compiled
def _torque_at(body: TorquedBody, state: State) -> Array:
    return body.torque_at(state)


def torqued_body(inertia: ArrayLike, torque: Any, frame: Literal["body", "space"] | None = None) -> TorquedBody:
    """A rigid body with a torque; `schemes.torqued_midpoint` integrates it with an exact balance of power.

    Args:
        inertia: principal moments (3,) or a symmetric tensor in body axes (3, 3).
        torque: torque(t, q, ω) ↦ (3,) of time, attitude quaternion and angular velocity, a JAX function, in the axes
            that `frame` says, as ω is. Parameters to be differentiated or batched go into a `jax.tree_util.Partial` or
            a class of one's own decorated with `li.pytree`, which may also have a potential and more, see
            `types.AbstractTorquedBody`. `lieint_jax.torques` has laws.
        frame: "body" or "space"; by default the torque's own `frame` if it has one, else "body".

    Raises:
        ValueError: bad inertia, a torque that is no function with a value (3,), a frame that is not the torque's own.

    Example:
        >>> import lieint_jax as li
        >>> body = torqued_body([1.0, 2.0, 3.0], li.torques.viscous(0.1))
        >>> state = body.state(angular_velocity=[0.2, 0.0, 1.0], work=0.0)
        >>> run = li.integrate(li.schemes.torqued_midpoint(body), state, 0.1, 100)
        >>> bool(abs(li.diagnostics.energy_error(body, run)).max() < 1e-5)  # of H − work
        True
    """
    inertia = _checks.inertia(inertia)
    if not (callable(torque) or hasattr(torque, "during")):
        raise ValueError(f"torque must be a function of (t, q, omega) with a value of shape (3,), got {torque!r}")
    if jax.tree_util.all_leaves([torque]) and (more := [name for name in _MORE if hasattr(torque, name)]):
        raise ValueError(
            f"a torque with {' and '.join(more)} must be a pytree: decorate {type(torque).__name__} with @li.pytree"
        )
    own = getattr(torque, "frame", None)
    frame = frame or own or "body"
    if frame not in ("body", "space") or own not in (None, frame):
        allowed = f'"{own}", the axes of {type(torque).__name__}' if own in ("body", "space") else '"body" or "space"'
        raise ValueError(f"frame must be {allowed}, got {frame!r}")
    made = TorquedBody(inertia, callable_pytree(torque), frame)
    _check_torque(made)
    return made


def _check_torque(body: TorquedBody) -> None:
    """Raise ValueError if the torque has no real value of shape (3,)."""
    number, q, vector = (jax.ShapeDtypeStruct(shape, body.inertia.dtype) for shape in ((), (4,), (3,)))

    def value(t: Array, q: Array, omega: Array) -> list[Array]:
        law: Any = body.law(jnp.zeros_like(t), body.carried)
        means = [law.mean(t, q, q, omega, jnp.ones_like(t), omega)] if hasattr(law, "mean") else []
        return [law(t, q, omega), *means]

    try:
        found = list(jax.eval_shape(value, number, q, vector))
        wrong = [x for x in found if getattr(x, "shape", None) != (3,) or not _is_real(x)]
    except (TypeError, IndexError, ValueError, AttributeError) as error:
        raise ValueError(f"torque fails as a function of t (), q (4,) and omega (3,): {error}") from error
    if wrong:
        given = f"shape {wrong[0].shape} and dtype {wrong[0].dtype}" if hasattr(wrong[0], "shape") else f"{wrong[0]!r}"
        raise ValueError(f"torque must return an array of real numbers of shape (3,), got {given}")


def _is_real(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jnp.floating) or jnp.issubdtype(x.dtype, jnp.integer)


def _turning_field(t: Array) -> Array:
    """The field of a dipole along a polar orbit, in the dipole's unit: (3 sin 2u, 0, 3 cos 2u + 1)/2 with u = t/10."""
    return jnp.stack([1.5 * jnp.sin(t / 5), jnp.zeros_like(t), 1.5 * jnp.cos(t / 5) + 0.5])


def examples() -> dict[str, tuple[TorquedBody, State, float]]:
    """Magnetic detumbling on a polar orbit, a slew by a controller, and a body with a damper inside."""
    J, start, Omega = [1.0, 2.0, 2.5], so3.exp(jnp.array([0.9, -1.2, 0.5])), jnp.array([0.3, -0.4, 0.8])
    made = {
        "detumbling": torqued_body(J, torques.bdot(0.05, _turning_field)),
        "slew": torqued_body(J, torques.pd_quaternion(0.5, 0.8)),
        "damper": torqued_body(J, torques.kane_damper(0.2, 0.1)),
    }
    return {name: (body, body.state(start, angular_velocity=Omega, work=0.0), 0.05) for name, body in made.items()}
