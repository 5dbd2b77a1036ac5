"""The step of a scheme, and the checks of every call of it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, Self, TypeVar, final

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import at_once, concrete, dtype_of, name_of, outermost, real_array, snake_case, step_size
from lieint_jax._numerics.arrays import Flag, PhaseVector, PyTree, TangentVectors, Time
from lieint_jax._xla import compiled, differ, materialized_arrays, with_materialized_derivatives
from lieint_jax.core._group import PhaseSpace, SpaceWithTangents
from lieint_jax.core._state import State, StepInfo, all_finite
from lieint_jax.core._system import System

__all__ = ["Step", "StepError", "checked_step", "converges", "promoted", "push_forward", "start_time"]

_T = TypeVar("_T")
_Aux = TypeVar("_Aux")
_SMALLER = 6  # step sizes, each a quarter of the one before, until advice to use a smaller one is given up
_HOOKS = {"__call__": "advance", "prepare": "with_constants", "tangent": "advance_tangents"}  # by final method


class StepError(ValueError):
    """Raised where a step does not converge from a concrete state; the message is the step's advice."""


class Step:
    """One step of a scheme for a system: `step(state, dt) -> (state, info)`, a pure function and a pytree.

    A scheme defines `advance(state, dt)`, and may define `with_constants(state, dt)` and `advance_tangents(state, dt,
    T)`. These receive the state, dt and the step's own numbers in one floating-point type, the widest among state and
    step. They return `state._replace(q=…, p=…)`, so that all other fields of the state are unchanged. The time of the
    new state, if any, is set to t + dt here, unless the step has its `own_time`.

    Attributes:
        order: order of accuracy; infinite for the exact flow.
        symmetric: whether step(·, −dt) is the inverse of step(·, dt).
        own_time: whether the step itself advances `state.t`, which it then requires; dt is a step of a fictitious time.
        reuses: whether the end of a step computes what the next one begins with, so that a run computes it once.
        approximate: whether fewer iterations are set than convergence requires: a run reports the residual and
            continues.
        loops: whether a step iterates until it is done. Outside of jit JAX would compile such a loop again at each
            call, which makes its functions; so there `advance` is one program.
        commuting: whether steps of different sizes commute, so that compositions need fewer stages (`schemes.compose`).
        velocity_weight: α of the momentum at n+α from which the step computes Θ, for `diagnostics.conditions`.
    """

    system: Any
    order: float
    symmetric: bool
    own_time: bool = False
    reuses: bool = False
    approximate: bool = False
    loops: bool = False
    commuting: bool = False
    velocity_weight: ArrayLike = 0.5
    loop_in_shards: ClassVar[Callable[..., Any]] = staticmethod(jax.lax.scan)  # `runs` puts its own loop here

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        for method, hook in _HOOKS.items():
            if method in vars(cls):
                raise TypeError(f"{cls.__name__} overrides {method}, which is final: define {hook} in its place")

    @property
    def name(self) -> str:
        """The name of this step in reports; by default that of its class, such as "so3_explicit"."""
        return snake_case(type(self).__name__)

    @final
    def __call__(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        """One step: the state at t + dt, and a report, which is `converged` only if that state is finite."""
        if differ((self, state, dt)):  # as a loop of one step, which JAX need not trace with the types of shards
            found = self.loop_in_shards(lambda given, _: (given, self(*given)), (state, dt), length=1)[1]
            return jax.tree.map(lambda x: x[0], found)
        end, info = self.substep(state, dt)
        return end, _finite_or_flagged(info, end)

    @final
    def substep(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        """A call within a larger step, without the check that the new state is finite: the larger step has it."""
        step, state, dt = _in_one_type(self, state, dt)
        _check_time(step, state)
        end, info = (_advanced if self.loops and outermost() else _advance)(step, state, dt)
        return _completed(step, state, dt, end), info

    @final
    def continued(self, state: State, dt: ArrayLike, known: PyTree) -> tuple[State, StepInfo, PyTree]:
        """A call in a loop of steps, of which the first is given `known_at(state)`, and each other what the last found.

        Between two steps the state may change in its time only.
        """
        if not self.reuses:
            return *self(state, dt), None
        step, state, dt = _in_one_type(self, state, dt)
        _check_time(step, state)
        end, info, known = step.advance_reusing(state, dt, known)
        end = _completed(step, state, dt, end)
        return end, _finite_or_flagged(info, end), known

    @final
    def known_at(self, state: State) -> PyTree:
        """What is `reusable` at a state; None of a step that reuses nothing."""
        return self.reusable(state) if self.reuses else None

    def reusable(self, state: State) -> PyTree:
        """What a step that `reuses` computes first, and the step that ends at `state` computes last."""
        raise NotImplementedError(f"{type(self).__name__} reuses nothing")

    def advance_reusing(self, state: State, dt: ArrayLike, known: PyTree) -> tuple[State, StepInfo, PyTree]:
        """`advance` with what is `reusable` at the state `known`, and that at the end; of a step that `reuses`."""
        raise NotImplementedError(f"{type(self).__name__} reuses nothing")

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        """What a scheme defines: `state` with the new q and p, and the report. Callers use `__call__` or `substep`."""
        raise NotImplementedError(f"{type(self).__name__} must define advance(state, dt) -> (State, StepInfo)")

    @final
    def prepare(self, state: State, dt: ArrayLike) -> Self:
        """The step with the constants of the trajectory of `state` computed in advance; by default the step itself."""
        if not self.prepares:
            return self
        step, state, dt = _in_one_type(self, state, dt)
        return step.with_constants(state, dt)

    def with_constants(self, state: State, dt: ArrayLike) -> Self:
        """What `prepare` returns, for a scheme with constants of a trajectory or of a step size."""
        return self

    @final
    def tangent(self, state: State, dt: ArrayLike, T: ArrayLike) -> tuple[State, StepInfo, Array]:
        """The step, and the images of tangent vectors under its derivative L: (new state, report, LT).

        Time, work and extra are held fixed. L is a forward-mode derivative, unless the scheme has it in closed form.

        Args:
            state, dt: as in a call of the step.
            T: tangent vectors at the state, columns of an array (2d, k), in the phase space's coordinates: (δθ, δπ)
                on T*G, with δq = δθ q.
        """
        step, state, dt, T = _in_one_type(self, state, dt, T)
        _check_time(step, state)
        end, info, LT = step.advance_tangents(state, dt, T)
        if type(step).advance_tangents is Step.advance_tangents:
            return end, info, LT  # the derivative of a call, which has done the rest
        end = _on_time(step, state, dt, end)
        q, p, LT = materialized_arrays((end.q, end.p, LT))  # XLA computes them once, not in each use
        end = end._replace(q=q, p=p)
        return end, _finite_or_flagged(info, end), LT

    def advance_tangents(self, state: State, dt: ArrayLike, T: Array) -> tuple[State, StepInfo, Array]:
        """`advance`, and LT, for a scheme with L in closed form; by default by forward mode through the step."""
        return push_forward(self.system.phase_space, lambda z: self(z, dt), state, T)

    @property
    def prepares(self) -> bool:
        """Whether `prepare` computes anything; its result is valid for one step size."""
        return type(self).with_constants is not Step.with_constants

    @property
    def deterministic(self) -> Step | None:
        """For a step with noise, the same step without noise and friction; None for all others."""
        return None

    def start(self, state: State) -> State:
        """`state` with the entries of `extra` that this step needs, as at the start of a run; by default none."""
        return state

    def advice(self, state: State, dt: ArrayLike) -> str:
        """The message for a step that failed from `state`: what was given, what is allowed, what to do."""
        return f"the step did not converge at dt = {dt}: use a smaller dt"

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
                raise StepError(self.failure(state, dt))

    def failure(self, state: State, dt: ArrayLike) -> str:
        """Why a step from a concrete state does not converge, and the cure.

        It is a function without a finite value there, or `advice`; if that is a smaller dt and none converges, a
        function without a finite derivative.
        """
        values, derivatives = _undefined_at(self.system, state)
        if values:
            return values
        advice = self.advice(state, dt)
        smaller = [dt * 4.0**-k for k in range(1, _SMALLER)]
        if "smaller dt" not in advice or not np.isfinite(dt) or any(bool(converges(self, state, h)) for h in smaller):
            return ". ".join(filter(None, [advice, self.system.domain]))
        return derivatives or (
            f"{self.name} does not converge at dt = {dt}, nor at a smaller dt down to {smaller[-1]:.1g}: a potential, "
            f"force or torque is not smooth at this state, or it computes in fewer digits than {state.p.dtype}, the "
            "type of the state. Start from another state, or correct the function"
        )


def _in_one_type(step: _T, state: State, dt: ArrayLike, *T: ArrayLike) -> tuple[_T, State, Array, *tuple[Array, ...]]:
    """The arguments of a method of a step, the step first, with all real numbers in one floating-point type."""
    step, state, dtype = promoted(step, state)
    return step, state, jnp.asarray(step_size(dt), dtype), *(jnp.asarray(x, dtype) for x in T)


def _check_time(step: Step, state: State) -> None:
    """Raise ValueError if a step that advances the time itself is called without one."""
    if step.own_time and state.t is None:
        raise ValueError(f"{step.name} advances the time, which this state lacks: use step.start(state)")


def _completed(step: Step, state: State, dt: Array, end: State) -> State:
    """The state that `advance` has returned, at its time."""
    end = _on_time(step, state, dt, end)
    q, p = with_materialized_derivatives((end.q, end.p))  # XLA computes tangents once, not again for each number
    return end._replace(q=q, p=p)


def _on_time(step: Step, state: State, dt: Array, end: State) -> State:
    """The state after a step, at t + dt; raises ValueError if it lacks parts that the state before has."""
    for name, before, after in (("work", state.work, end.work), ("extra", state.extra, end.extra)):
        if before is not None and after is None:
            raise ValueError(f"{type(step).__name__} drops state.{name}: return state._replace(q=…, p=…) from it")
    return end._replace(t=end.t if step.own_time or state.t is None else state.t + dt)


def _finite_or_flagged(info: StepInfo, end: State) -> StepInfo:
    """The report of a step, `converged` only if the state after it is finite."""
    return info._replace(converged=info.converged & all_finite(end))


def _undefined_at(system: System, state: State) -> tuple[str, str]:
    """Which function of a system has no finite value at a concrete state, and which no finite derivative; or empty."""
    values = derivatives = ""
    for name, part in {**system.terms(), f"the vector field of {type(system).__name__}": system}.items():
        rate, slopes = _rate_and_slopes(part, state)
        wrong = [of for of, x in (("q", rate.q), ("p", rate.p)) if not bool(all_finite(x))]
        if wrong:
            values = values or (
                f"the equations of motion of {type(system).__name__} have no finite value at this state: by {name} the "
                f"time derivative of {' and '.join(wrong)} is not finite. A potential, force or torque is singular or "
                "undefined there, or a number is too large: start from another state, or correct the function"
            )
        wrong = [by for by, slope in zip(("q", "p"), slopes, strict=True) if not bool(all_finite(slope))]
        if wrong:
            derivatives = derivatives or (
                f"{name} has no finite derivative by {' and '.join(wrong)} at this state, and Newton's method needs "
                "it; no smaller dt helps. The derivative of √(ω·ω) at ω = 0 is such a case, also within jnp.where: "
                "choose the argument of the root by jnp.where first, or start from another state"
            )
    return values, derivatives


@partial(compiled, once=True)
def _rate_and_slopes(system: System, state: State) -> tuple[State, tuple[PyTree, PyTree]]:
    """The vector field, and its derivatives by q and p."""

    def rate(q: Array, p: Array) -> State:
        return system.vector_field(state._replace(q=q, p=p))

    slopes = jax.jacfwd(lambda *z: (rate(*z).q, rate(*z).p), argnums=(0, 1))(state.q, state.p)
    return rate(state.q, state.p), ([x[0] for x in slopes], [x[1] for x in slopes])


def push_forward(
    space: PhaseSpace, function: Callable[[State], tuple[State, _Aux]], state: State, T: TangentVectors
) -> tuple[State, _Aux, TangentVectors]:
    """end, aux = function(state), and the images LT of tangent vectors, columns of T, under the derivative of end.

    Time, work and extra are held fixed.
    """

    def push(delta: Array) -> tuple[Array, State, _Aux]:
        start = state.q, state.p
        along = jax.tree.map(lambda x, slope: slope.astype(x.dtype), start, _tangent_vector(space, state, delta))
        end, tangent, aux = jax.jvp(lambda q, p: function(state._replace(q=q, p=p)), start, along, has_aux=True)
        return space.trivialize(end, tangent), end, aux

    LT, *values = jax.vmap(push, -1, -1)(T)
    end, aux = jax.tree.map(lambda x: x[..., 0], values)  # the same for all vectors, and so computed once
    return end, aux, LT


def _tangent_vector(space: PhaseSpace, state: State, delta: PhaseVector) -> tuple[Array, Array]:
    """(δq, δp), the inverse of `trivialize`; a space may have it as `tangent`, faster than the derivative here."""
    if isinstance(space, SpaceWithTangents):
        return space.tangent(state, delta)
    tangent = jax.jvp(lambda x: space.perturb(state, x), (jnp.zeros_like(delta),), (delta,))[1]
    return tangent.q, tangent.p


def checked_step(step: object) -> Step:
    """`step`; raises ValueError if it is not a step, with a message on how to define one."""
    if isinstance(step, Step):
        return step
    raise ValueError(
        f"step must be a Step, such as schemes.so3_midpoint(system) returns, got {step!r}. A custom step is a class "
        "that inherits li.Step, decorated with @li.pytree, with the fields system, order and symmetric (li.static() "
        "for fields that are not arrays), a property name, and advance(state, dt) -> (State, StepInfo)"
    )


def promoted(step: _T, state: State) -> tuple[_T, State, np.dtype]:
    """`step` and `state` with all their real numbers in one floating-point type, the widest among them, and that type.

    Without jax_enable_x64 it is float32 also where they were made with it.

    Raises:
        ValueError: `state` is not a State of real arrays, or a type is narrower than float32.
    """
    if not isinstance(state, State):
        raise ValueError(f"state must be a State(q, p), such as system.state(...) makes, got {type(state).__name__}")
    if state.work is not None and state.t is None:
        raise ValueError("a state that counts work needs a time as well: state._replace(t=0.0)")
    if state.extra is not None and not isinstance(state.extra, dict):
        raise ValueError(f"state.extra must be a dict of arrays or None, got {type(state.extra).__name__}")
    given = {name: x for name, x in state._asdict().items() if name != "extra" and x is not None}
    found: dict[str, PyTree] = {name: real_array(f"state.{name}", x, finite=False) for name, x in given.items()}
    if state.extra is not None:
        named = state.extra.items()
        found["extra"] = {name: real_array(f'state.extra["{name}"]', x, finite=False) for name, x in named}
    leaves = jax.tree.leaves(step)
    if functions := [name_of(x) for x in leaves if callable(x)]:
        raise ValueError(f"a step must hold a function as a pytree: give jax.tree_util.Partial({functions[0]})")
    numbers = [real_array("a number of the step", x, finite=False) for x in leaves if _is_real(x)]
    dtype = jax.dtypes.canonicalize_dtype(jnp.result_type(*jax.tree.leaves(found), *numbers))
    if any(x.dtype != dtype for x in numbers):
        step = jax.tree.map(lambda x: jnp.asarray(x, dtype) if _is_real(x) else x, step)
    return step, State(**jax.tree.map(lambda x: x if x.dtype == dtype else x.astype(dtype), found)), dtype


def start_time(step: Step, state: State) -> Time | None:
    """t₀ of the times t₀ + nΔt of a run; None if the state has no time, or the step advances the time itself."""
    return None if step.own_time else state.t


def _is_real(leaf: ArrayLike) -> bool:
    return jnp.issubdtype(type(leaf) if (dtype := dtype_of(leaf)) is None else dtype, jnp.floating)


def _advance(step: Step, state: State, dt: Array) -> tuple[State, StepInfo]:
    return step.advance(state, dt)


_advanced = compiled(_advance)


@partial(compiled, once=True)
def converges(step: Step, state: State, dt: ArrayLike) -> Flag:
    """Whether a step converges. Compiled, so that a step of the same structure is checked without tracing it again."""
    return step(state, dt)[1].converged
