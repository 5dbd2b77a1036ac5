"""The step of a scheme, and what every call of one checks."""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable
from functools import partial
from typing import Any, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import at_once, concrete, real_array, step_size
from lieint_jax._xla import compiled
from lieint_jax.types._state import State, StepInfo, all_finite
from lieint_jax.types._system import System
from lieint_jax.types.shapes import Flag, PyTree, Time

_T = TypeVar("_T")
_Report = tuple[Any, ...]  # the new state, the StepInfo, and what a method adds


def _in_one_type(method: Callable[..., _T]) -> Callable[..., _T]:
    """A method (step, state, dt, …) whose arguments arrive in one floating-point type."""

    @functools.wraps(method)
    def converted(step: Step, state: State, dt: ArrayLike, *more: ArrayLike) -> _T:
        step, state, dtype = promoted(step, state)
        return method(step, state, jnp.asarray(step_size(dt), dtype), *(jnp.asarray(x, dtype) for x in more))

    return converted


def _on_time(method: Callable[..., _Report]) -> Callable[..., _Report]:
    """A method (step, state, dt, …) whose new state is at t + dt and has all other parts of the state."""

    @functools.wraps(method)
    def timed(step: Step, state: State, dt: Array, *more: Array) -> _Report:
        if step.own_time and state.t is None:
            raise ValueError(f"{step.name} advances the time, which this state lacks: take step.start(state)")
        end, *report = method(step, state, dt, *more)
        for name in ("work", "extra"):
            if getattr(state, name) is not None and getattr(end, name) is None:
                raise ValueError(f"{type(step).__name__} drops state.{name}: return state._replace(q=…, p=…) from it")
        t = end.t if step.own_time or state.t is None else state.t + dt
        return end._replace(t=t), *report

    return timed


def _finite_or_flagged(method: Callable[..., _Report]) -> Callable[..., _Report]:
    """A method (step, state, dt, …) that reports `converged` only of a state that is finite."""

    @functools.wraps(method)
    def flagged(*arguments: PyTree) -> _Report:
        end, info, *tangents = method(*arguments)
        return end, info._replace(converged=info.converged & all_finite(end)), *tangents

    return flagged


class StepError(ValueError):
    """A step does not converge from a concrete state; the message is the step's advice."""


class Step(abc.ABC):
    """One step of a scheme for a system: `step(state, dt) -> (state, info)`, a pure function and a pytree.

    `__call__`, `prepare` and `tangent` of any subclass see the state, dt and the step's own numbers in one
    floating-point type, the widest among state and step. The time of the new state, where there is one, is set here, to
    t + dt, unless the step has its `own_time`. A scheme returns `state._replace(q=…, p=…)`, which keeps whatever else
    the state carries.

    Attributes:
        order: order of accuracy; infinite for the exact flow.
        symmetric: whether step(·, −dt) undoes step(·, dt).
    """

    system: Any
    order: float
    symmetric: bool

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "__call__" in vars(cls):
            cls.substep = _in_one_type(_on_time(cls.__call__))
            cls.__call__ = _finite_or_flagged(cls.substep)
        if "prepare" in vars(cls):
            cls.prepare = _in_one_type(cls.prepare)
        if "tangent" in vars(cls):
            cls.tangent = _finite_or_flagged(_in_one_type(_on_time(cls.tangent)))

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """The name of this step in reports."""

    @abc.abstractmethod
    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]: ...

    def substep(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        """A call as a part of a larger step, which itself is flagged where its end is not finite: see `__call__`."""
        raise NotImplementedError  # set for every subclass, from its `__call__`

    @property
    def velocity_weight(self) -> ArrayLike:
        """α of the momentum at n+α whose velocity the step takes for Θ, for `diagnostics.conditions`; ½ of most."""
        return 0.5

    @property
    def commuting(self) -> bool:
        """Whether steps of different sizes commute: then compositions need fewer stages (`schemes.compose`)."""
        return False

    @property
    def prepares(self) -> bool:
        """Whether `prepare` computes anything, which then holds for one step size."""
        return type(self).prepare is not Step.prepare

    @property
    def own_time(self) -> bool:
        """Whether the step itself advances `state.t`, which must be there; then dt is a step of a fictitious time."""
        return False

    @property
    def approximate(self) -> bool:
        """Whether fewer iterations were asked for than convergence takes: a run reports the residual, and goes on."""
        return False

    @property
    def deterministic(self) -> Step | None:
        """Of a step with noise, the step that is left without it and friction; None of all others."""
        return None

    def start(self, state: State) -> State:
        """`state` with what else the states of this step carry, as it is at the start of a run; here nothing."""
        return state

    def prepare(self, state: State, dt: ArrayLike) -> Self:
        """Solve once what is constant along the trajectory of `state`; here nothing."""
        return self

    @_in_one_type
    def tangent(self, state: State, dt: ArrayLike, T: ArrayLike) -> tuple[State, StepInfo, Array]:
        """The step, and the tangent vectors that its derivative L carries along: (new state, report, LT).

        Time, work and extra are held fixed. By forward derivatives, unless the scheme has a closed form.

        Args:
            state, dt: as of a call of the step.
            T: tangent vectors at the state, columns of an array (2d, k), in the phase space's coordinates: (δθ, δπ)
                on T*G, with δq = δθ q.
        """
        space = self.system.phase_space

        def perturbed_step(delta: Array) -> tuple[State, tuple[State, StepInfo]]:
            end, info = self(space.perturb(state, delta), dt)
            return end, (end, info)

        _, push, (end, info) = jax.linearize(perturbed_step, jnp.zeros(space.dim, state.p.dtype), has_aux=True)
        return end, info, jax.vmap(lambda delta: space.trivialize(end, push(delta)), -1, -1)(jnp.asarray(T))

    def advice(self, state: State, dt: ArrayLike) -> str:
        """The message for a step that failed from `state`: what was given, what is allowed, what to do."""
        return f"the step did not converge at dt = {dt}: take a smaller dt"

    def check(self, state: State, dt: ArrayLike) -> None:
        """Raise ValueError if a concrete `state` or `dt` is out of range at this step; tracers pass."""
        if not concrete(self, state, dt):
            return
        dt = step_size(dt)
        with at_once():  # constants are concrete inside jit too
            self.system.check(state)
            if self.approximate:
                return
            converged = converges(self, state, dt)
            if concrete(converged) and not converged:  # a function of the step may close over a tracer
                _check_motion_defined(self.system, state)
                raise StepError(self.advice(state, dt))


def _check_motion_defined(system: System, state: State) -> None:
    """ValueError if the vector field of a system is not finite at a concrete state."""
    rate = jax.jit(type(system).vector_field)(system, state)
    wrong = [name for name in ("q", "p") if not bool(all_finite(getattr(rate, name)))]
    if wrong:
        raise ValueError(
            f"the equations of motion of {type(system).__name__} have no finite value at this state: the time "
            f"derivative of {' and '.join(wrong)} is not finite. A potential, force or torque is singular or undefined "
            "there, or a number is too large: begin elsewhere, or correct the function"
        )


def checked_step(step: object) -> Step:
    """`step`; ValueError if it is none, which says how to make one."""
    if isinstance(step, Step):
        return step
    raise ValueError(
        f"step must be a Step, such as schemes.so3_midpoint(system) makes, got {step!r}. To make one of your own: a "
        "class that inherits li.Step, decorated with @li.pytree, with the fields system, order and symmetric "
        "(li.static() for what is no array), a property name, and __call__(state, dt) -> (State, StepInfo)"
    )


def promoted(step: _T, state: State) -> tuple[_T, State, np.dtype]:
    """`step` and `state` with all their real numbers in one floating-point type, the widest among them, and that type.

    Raises:
        ValueError: `state` is no State of real arrays, or a type is narrower than float32.
    """
    if not isinstance(state, State):
        raise ValueError(f"state must be a State(q, p), such as system.state(...) makes, got {type(state).__name__}")
    if state.work is not None and state.t is None:
        raise ValueError("a state with work needs the time that the work began at: state._replace(t=0.0)")
    if state.extra is not None and not isinstance(state.extra, dict):
        raise ValueError(f"state.extra must be a dict of arrays or None, got {type(state.extra).__name__}")
    given = {name: x for name, x in state._asdict().items() if name != "extra" and x is not None}
    found: dict[str, PyTree] = {name: real_array(f"state.{name}", x, finite=False) for name, x in given.items()}
    if state.extra is not None:
        named = state.extra.items()
        found["extra"] = {name: real_array(f'state.extra["{name}"]', x, finite=False) for name, x in named}
    leaves = jax.tree.leaves(step)
    if functions := [getattr(x, "__name__", "function") for x in leaves if callable(x)]:
        raise ValueError(f"a step must hold a function as a pytree: give jax.tree_util.Partial({functions[0]})")
    numbers = [real_array("a number of the step", x, finite=False) for x in leaves if _is_real(x)]
    dtype = jnp.result_type(*jax.tree.leaves(found), *numbers)
    if any(x.dtype != dtype for x in numbers):
        step = jax.tree.map(lambda x: jnp.asarray(x, dtype) if _is_real(x) else x, step)
    return step, State(**jax.tree.map(lambda x: x if x.dtype == dtype else x.astype(dtype), found)), dtype


def start_time(step: Step, state: State) -> Time | None:
    """The t₀ from which the times t₀ + nΔt of a run follow; None where there is none, or the step has its own time."""
    return None if step.own_time else state.t


def _is_real(leaf: ArrayLike) -> bool:
    return jnp.issubdtype(jnp.result_type(leaf), jnp.floating)


@partial(compiled, once=True)
def converges(step: Step, state: State, dt: ArrayLike) -> Flag:
    """Whether a step converges. Compiled, so that a step of the same structure is checked without tracing it again."""
    return step(state, dt)[1].converged
