"""The core types: states, steps, trajectories, groups, phase spaces.

Systems and steps are frozen dataclasses registered as JAX pytrees (`pytree`). Their array fields are leaves, so
derivatives and batches over an inertia tensor go through them; fields marked `static` (functions, options) are part of
the tree's structure, so a step that is built again hits the same jit cache.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, Self, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import concrete

_T = TypeVar("_T")


def static(**options: Any) -> Any:
    """A dataclass field that is part of a pytree's structure, not one of its leaves. Its value must be hashable."""
    return dataclasses.field(metadata={"static": True}, **options)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(dataclasses.field, static))
def pytree(cls: type[_T]) -> type[_T]:
    """Make `cls` a frozen dataclass and a pytree whose leaves are its fields, but for the `static` ones."""
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True, eq=False)(cls))


def callable_pytree(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that can be a field of a pytree: itself if it is one (it may have leaves), else without leaves."""
    return jax.tree_util.Partial(function) if jax.tree_util.all_leaves([function]) else function


class State(NamedTuple):
    """A point of phase space.

    Attributes:
        q: configuration. SO(3): unit quaternion (w, x, y, z), (4,). Matrix groups: (n, n). GL⁺(3): F, (3, 3). S²: unit
            vector, (3,).
        p: momentum. SO(3): spatial angular momentum π, (3,). Matrix groups: π in the dual basis, (d,). GL⁺(3): P,
            (3, 3). S²: π = m q × q̇, (3,).
    """

    q: Array
    p: Array


class StepInfo(NamedTuple):
    """What a step says of its own solve.

    Attributes:
        residual: norm of the implicit equation's residual, in the scheme's own dimensionless form.
        converged: the residual is round-off (within a multiple of eps·scale that each scheme states, 32 for those that
            solve an equation at each step) and the root lies on the scheme's branch. False wherever a result is not to
            be trusted; a NaN never comes without it.
    """

    residual: Array
    converged: Array

    def merge(self, other: StepInfo) -> StepInfo:
        """The report of both: the larger residual, and whether both converged."""
        return StepInfo(jnp.maximum(self.residual, other.residual), self.converged & other.converged)

    @classmethod
    def fresh(cls, like: Array) -> StepInfo:
        """The report of no step yet, a scalar of the dtype of `like`."""
        return cls(jnp.zeros((), like.dtype), jnp.ones((), bool))


class Trajectory(NamedTuple):
    """States at the saved times; every leaf has a leading time axis and entry 0 is the initial state.

    Attributes:
        t: times, shape (n+1,).
        state: the states.
        info: over the steps since the entry before: the largest residual, and whether all converged.
    """

    t: Array
    state: State
    info: StepInfo


class Group(Protocol):
    """The questions that every group answers (a module such as `groups.so3`, or an object).

    Algebra elements are coordinate vectors of shape (dim,), their duals likewise; `Ad_star(q, ·)` and `ad_star(ξ, ·)`
    are the transposes of `Ad(q, ·)` and `ad(ξ, ·)`.

    A group may also have these, which schemes and systems use where they are there (see `groups.matrix.MatrixGroup`):

    | | |
    |---|---|
    | `exp_near`, `near`, `exp_slope`, `exp_coadjoint` | exp of a step, where it is exact, its H (5.28), its Ad* |
    | `cayley_slope`, `cayley_both`, `coadjoint` | H of cay; cay(±ξ), and Ad* of an element and its inverse |
    | `cayley_lands` | whether the Cayley map lands in the group; without it, it does |
    | `ad_star_matrix` | the matrix of ξ ↦ ad*_ξ μ |
    | `unrolled` | whether vectors are lists of entries in a step, see `dense`; without it, they are |
    | `rounding`, `drift` | what rounding costs `Ad_star`, and how far q has left the group |
    | `casimirs` | functions of μ that no Ad* changes |
    """

    @property
    def dim(self) -> int: ...
    @property
    def identity(self) -> Any: ...
    def multiply(self, a: Array, b: Array, /) -> Array: ...
    def inverse(self, a: Array, /) -> Array: ...
    def exp(self, xi: Array, /) -> Array: ...
    def log(self, q: Array, /) -> Array: ...
    def cayley(self, xi: Array, /) -> Array: ...
    def Ad(self, q: Array, xi: Array, /) -> Array: ...
    def Ad_star(self, q: Array, mu: Array, /) -> Array: ...
    def ad(self, xi: Array, eta: Array, /) -> Array: ...
    def ad_star(self, xi: Array, mu: Array, /) -> Array: ...
    def spatial_velocity(self, q: Array, q_dot: Array, /) -> Array: ...
    def body_velocity(self, q: Array, q_dot: Array, /) -> Array: ...
    def tangent(self, q: Array, Omega: Array, /) -> Array: ...
    def spatial_tangent(self, q: Array, theta: Array, /) -> Array: ...
    def defect(self, q: Array, /) -> Array: ...


class PhaseSpace(Protocol):
    """A manifold with a symplectic form, in coordinates of its tangent spaces that the diagnostics work in."""

    @property
    def dim(self) -> int: ...
    def perturb(self, state: State, delta: Array, /) -> State: ...
    def trivialise(self, state: State, tangent: State, /) -> Array: ...
    def omega(self, state: State, /) -> Array: ...
    def defect(self, state: State, /) -> Array: ...


class System(Protocol):
    """A Hamiltonian system: what every scheme and every diagnostic may ask of it."""

    @property
    def phase_space(self) -> PhaseSpace: ...
    def energy(self, state: State, /) -> Array: ...
    def momentum(self, state: State, /) -> Array: ...
    def vector_field(self, state: State, /) -> State: ...
    def check(self, state: State, /) -> None: ...


class Step(abc.ABC):
    """One step of a scheme for a system: `step(state, dt) -> (state, info)`, a pure function and a pytree.

    Attributes:
        order: order of accuracy; infinite for the exact flow.
        symmetric: whether step(·, −dt) undoes step(·, dt).
    """

    system: Any
    order: float
    symmetric: bool

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """What reports call this step."""

    @abc.abstractmethod
    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]: ...

    @property
    def commuting(self) -> bool:
        """Whether steps of different sizes commute: then compositions need fewer stages (`schemes.compose`)."""
        return False

    def prepare(self, state: State, dt: ArrayLike) -> Self:
        """Solve once what is constant along the trajectory of `state`; here nothing."""
        return self

    def advice(self, state: State, dt: ArrayLike) -> str:
        """What to tell somebody whose step failed from `state`: what was given, what is allowed, what to do."""
        return f"the step did not converge at dt = {dt}: take a smaller dt"

    def check(self, state: State, dt: ArrayLike) -> None:
        """Raise ValueError if a concrete `state` or `dt` is out of range at this step; tracers pass."""
        if not concrete(self, state, dt):
            return
        with jax.ensure_compile_time_eval():  # constants are concrete inside jit too
            self.system.check(state)
            converged = self(state, dt)[1].converged
            if concrete(converged) and not converged:  # older JAX traces custom_root even here
                raise ValueError(self.advice(state, dt))
