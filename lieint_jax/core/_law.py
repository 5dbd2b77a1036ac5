"""Laws of torque, and the rotation of one step from which a law computes its torque."""

from __future__ import annotations

import abc
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import name_of, snake_case
from lieint_jax._numerics.arrays import PyTree
from lieint_jax.core._pytree import callable_pytree, pytree, static

__all__ = ["Function", "Law", "LawSum", "Rotation", "as_law", "instant", "labels", "laws_of", "parts", "total"]


class Rotation(NamedTuple):
    """The rotation of a body in one step, the argument of a law of torque. With dt = 0 it is one instant.

    Attributes:
        start: the time t_n, ().
        dt: Δt, ().
        q_n, q_mid, q_next: the attitudes at the start, half-way and at the end, unit quaternions (4,).
        h: ½Θ in the body, (3,), with Λ_{n+1} = Λ_n cay Θ.
        kappa: κ of the step, ().
        Omega: Ω̄, the mean angular velocity in the body, (3,).
        omega: ω̄ = Λ_nΩ̄ = Λ_{n+1}Ω̄, the same in space, (3,).
    """

    start: Array
    dt: Array
    q_n: Array
    q_mid: Array
    q_next: Array
    h: Array
    kappa: Array
    Omega: Array
    omega: Array

    @classmethod
    def at_instant(cls, t: Array, q: Array, Omega: Array, omega: Array) -> Rotation:
        """One instant of a body, as a step of no length."""
        zero = jnp.zeros((), q.dtype)
        return cls(t, zero, q, q, q, jnp.zeros_like(Omega), zero + 1, Omega, omega)

    @property
    def t(self) -> Array:
        """The time in the middle of the step, t_n + ½Δt."""
        return self.start + self.dt / 2

    @property
    def end(self) -> Array:
        """The time t_{n+1}, rounded as the time of the state."""
        return self.start + self.dt

    def velocity(self, frame: str) -> Array:
        """The mean angular velocity in the axes of the body or of space, (3,)."""
        return self.Omega if frame == "body" else self.omega


class Law(abc.ABC):
    """A law of torque. Laws can be added, `a + b`, also to plain functions of (t, q, Ω).

    A subclass is decorated with `li.pytree` and defines `mean`. A law with an internal state, such as the momentum of a
    wheel, has a `key`, under which `State.extra` holds that state, and defines `start`; also `inner_rate` if that state
    has edges, such as a limit.

    The step accumulates the work of each law: W = Δt Ω̄·T̄ + E_{n+1} − E_n, with E its `energy`. So H − ΣW is conserved
    to round-off, where H is the kinetic energy of the body plus the energies of all laws.

    Attributes:
        frame: the axes of the torque that `mean` returns, "body" or "space".
        key: the name of the internal state in `State.extra`, or None.
        reads: the key of another law whose internal state, averaged over the step, is passed to `mean`; or None.
        symmetric: whether a step of −Δt is the inverse of one of Δt.
        internal: whether the law exchanges momentum with its internal state only, so that the total is conserved.
        implicit: whether the internal state after a step is an unknown of the step's equation, since its rate depends
            on it. Then a step calls `implicit_mean`.
        held: the name in `State.extra` of what a digital controller holds between samples, or None; it may be its key.
            Then a step calls `sample` at its start, and uses the law that `holding` returns.
    """

    frame: str = "body"
    key: str | None = None
    reads: str | None = None
    symmetric: bool = True
    internal: bool = False
    implicit: bool = False
    held: str | None = None

    @property
    def label(self) -> str:
        """The name of the law where its work is listed, such as "gravity_gradient"."""
        return snake_case(type(self).__name__)

    @abc.abstractmethod
    def mean(self, rotation: Rotation, inner: Array | None) -> tuple[Array, Array | None]:
        """The mean torque of a step in the axes of `frame`, (3,), and the internal state after it."""

    def implicit_mean(self, rotation: Rotation, inner: Array, after: Array) -> tuple[Array, Array]:
        """The same as `mean`, given the internal state after the step, which it returns at the solution."""
        raise NotImplementedError

    def energy(self, t: Array, q: Array, inner: Array | None) -> Array:
        """The potential at an attitude, or the energy of the internal state, (); by default 0."""
        return jnp.zeros((), q.dtype)

    def work(self, rotation: Rotation, torque: Array, inner: Array | None, after: Array | None) -> Array:
        """The work W of a step, (), by its definition; a law may override it by a closed form."""
        gained = self.energy(rotation.end, rotation.q_next, after) - self.energy(rotation.start, rotation.q_n, inner)
        return rotation.dt * jnp.dot(rotation.velocity(self.frame), torque) + gained

    def start(self, now: Rotation) -> Array | None:
        """The internal state at the start of a run, for the body at that instant; None if the law has none."""
        return None

    def measured(self, now: Rotation, inner: PyTree) -> Array:
        """What the law holds from a sample at this instant on."""
        raise NotImplementedError

    def holding(self, held: Array) -> Law:
        """The law while it holds this."""
        return self

    def sample(self, now: Rotation, dt: Array, inner: PyTree, held: Array) -> tuple[Array, Array]:
        """What to hold in a step of dt from now, and whether the law takes such a step, a flag."""
        raise NotImplementedError

    def refusal(self, t: Array, dt: ArrayLike) -> str:
        """Why the law does not take a step of dt from t, and what is allowed, for a law that `samples`."""
        raise NotImplementedError

    def inner_rate(self, now: Rotation, inner: Array) -> Array | None:
        """The rate of the internal state at one instant; by default None: the derivative of what `mean` returns.

        At a limit the internal state is not differentiable: override this to return the one-sided rate.
        """
        return None

    def momentum(self, q: Array, inner: Array | None) -> Array:
        """The angular momentum of the internal state in space, (3,)."""
        return jnp.zeros_like(q[1:])

    def __call__(self, t: Array, q: Array, velocity: Array) -> Array:
        """The torque at one instant, (3,), if the law has no internal state; velocity in the axes of `frame`."""
        if (key := self.key or self.reads) is not None:
            raise ValueError(f'{type(self).__name__} depends on an internal state, State.extra["{key}"]')
        return self.mean(Rotation.at_instant(t, q, velocity, velocity), None)[0]

    def __add__(self, other: Any) -> LawSum:
        return total((self, other))

    def __radd__(self, other: Any) -> LawSum:
        return total((other, self))


@pytree
class Function(Law):
    """A law that is a function (t, q, velocity) ↦ torque in the axes of `frame`, evaluated half-way."""

    function: Any
    frame: str = static(default="body")  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def label(self) -> str:
        function = self.function
        while isinstance(function, functools.partial):  # such as a `jax.tree_util.Partial`
            function = function.func
        name = name_of(function)
        return "function" if name == "<lambda>" else name

    def mean(self, rotation: Rotation, inner: Array | None) -> tuple[Array, Array | None]:
        return self.function(rotation.t, rotation.q_mid, rotation.velocity(self.frame)), inner


@pytree
class LawSum(Law):
    """A sum of laws, made by `torques.total` or `+`; its internal states are those of the laws, by their keys."""

    laws: tuple[Law, ...]

    @property
    def symmetric(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return all(law.symmetric for law in self.laws)

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        raise NotImplementedError("a sum of laws has torques in several axes: call each of its `laws`")


def total(laws: Any) -> LawSum:
    """The sum of laws of torque: all of them act on the body, and the work of each is counted.

    Args:
        laws: laws of `lieint_jax.torques`, other `Law`s, or plain functions (t, q, Ω) ↦ torque in the body.

    Raises:
        ValueError: two laws have the same key, or an argument is not a law.
    """
    flat = tuple(part for law in laws for part in parts(law))
    keys = [key for law in flat for key in {law.key, law.held} if key is not None]
    if twice := sorted({key for key in keys if keys.count(key) > 1}):
        raise ValueError(
            f'two laws have the same key "{twice[0]}" for their internal states: give one of them another key=…'
        )
    return LawSum(flat)


def laws_of(system: Any) -> tuple[Law, ...]:
    """The laws of torque of a system, none if it is not one of a torqued body."""
    return system.laws


def labels(system: Any) -> list[str]:
    """The labels of the laws of a system, numbered where several are equal; an empty list if it has no laws."""
    names = [law.label for law in laws_of(system)]
    counted = [names[: k + 1].count(name) for k, name in enumerate(names)]
    return [name if count == 1 else f"{name}_{count}" for name, count in zip(names, counted, strict=True)]


def parts(law: Any) -> tuple[Law, ...]:
    """The terms of a sum of laws; a single law or function is its only term."""
    if isinstance(law, LawSum):
        return law.laws
    return (as_law(law),)


def as_law(law: Any, frame: str = "body") -> Law:
    """A law, or a function of (t, q, velocity), as a `Law`."""
    if isinstance(law, Law):
        return law
    if not callable(law):
        raise ValueError(
            "torque must be a function of (t, q, omega) with a value of shape (3,), a law, or a sum of laws, such as "
            f"a + b or torques.total([a, b]), got {law!r}"
        )
    more = [name for name in ("potential", "power", "mean", "during", "energy") if hasattr(law, name)]
    if more:  # which a function would drop
        raise ValueError(
            f"a function (t, q, omega) has no {' and no '.join(more)}, as {type(law).__name__} has: a law with more "
            "than a value inherits li.torques.Law, with `mean` and `energy`; a potential alone is li.torques.potential"
        )
    return Function(callable_pytree(law), getattr(law, "frame", frame))


def instant(
    law: Law, t: Array, q: Array, Omega: Array, *, omega: Array, inner: PyTree, q_half: Any
) -> tuple[Array, PyTree]:
    """The torque of a law at one instant, in the axes of its frame, and the rate of its internal state.

    Args:
        q_half: h ↦ q cay 2h, of the group.
    """

    def mean_over(s: Array) -> tuple[Array, PyTree]:
        h = s / 2 * Omega
        rotation = Rotation(t, s, q, q_half(h / 2), q_half(h), h, jnp.ones_like(t), Omega, omega)
        return law.mean(rotation, inner)

    now = Rotation.at_instant(t, q, Omega, omega)
    if law.key is None:
        return law.mean(now, inner)[0], None
    rate = law.inner_rate(now, inner)
    if rate is not None:
        return law.mean(now, inner)[0], rate
    zero = jnp.zeros((), q.dtype)
    (torque, _), (_, rate) = jax.jvp(mean_over, (zero,), (zero + 1,))
    return torque, rate
