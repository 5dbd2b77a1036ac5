"""State transition matrices of runs, their sensitivities to parameters, and linear covariance.

    Φ_{n+1} = L_n Φ_n,    S_{n+1} = L_n S_n + ∂(step)/∂p,    P(t) = Φ P₀ Φᵀ + S P_p Sᵀ

L_n is the derivative of step n, by `Step.tangent`. Entries of `State.extra`, such as the momenta of wheels, may depend
on q and p: their tangent vectors are then propagated together with those of q and p.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike

from lieint_jax import _checks, native
from lieint_jax._checks import concrete
from lieint_jax._numerics.arrays import PyTree
from lieint_jax._xla import compiled
from lieint_jax.core import (
    PhaseSpace,
    State,
    Step,
    StepInfo,
    callable_pytree,
    checked_step,
    promoted,
    pytree,
    start_time,
    static,
)
from lieint_jax.core.record import record
from lieint_jax.runs._clock import at_time, intervals, uniform_clock
from lieint_jax.runs._driver import info_since, join_start


@record
class Ellipse(NamedTuple):
    """The set of points within a number of standard deviations, in k coordinates of the phase space.

    Attributes:
        semi_axes: lengths, the largest first, (…, k).
        axes: their directions, unit vectors as columns, (…, k, k).
    """

    semi_axes: Array
    axes: Array


@pytree
class Transition:
    """The derivatives of the states of a run. Made by `transition`.

    With `save_every`, all arrays have a leading axis of saved entries, of which the first is the initial state. Rows
    are the coordinates of tangent vectors at the state of the entry, columns those at the start: on T*SO(3) (δθ, δπ) in
    the axes of space, δq = δθ q.

    Attributes:
        t: the time.
        state: the state.
        info: the report of the steps since the entry before.
        matrix: Φ = ∂x(t)/∂x(0), (2d, 2d). For a symplectic step, Φᵀω(x(t))Φ = ω(x(0)).
        by_parameters: ∂x(t)/∂p, a tree like the parameters, each leaf (2d, *shape of the parameter); None if there are
            none.
    """

    t: Array
    state: State
    info: StepInfo
    matrix: Array
    by_parameters: PyTree

    def covariance(self, initial: npt.ArrayLike, parameter_covariance: npt.ArrayLike | None = None) -> Array:
        """The linear covariance Φ P₀ Φᵀ + S P_p Sᵀ of the state, (…, 2d, 2d).

        Args:
            initial: P₀ of the initial state, (2d, 2d), in the coordinates of the phase space at the start.
            parameter_covariance: P_p of all numbers of the parameters, (k, k), in the order of `jax.tree.leaves`,
                uncorrelated with the initial state.

        Raises:
            ValueError: a matrix has another shape or is not symmetric, or P_p is given without parameters.
        """
        P = _propagate_covariance(self.matrix, _covariance("initial", initial, self.matrix.shape[-1]))
        if parameter_covariance is None:
            return P
        leaves = jax.tree.leaves(self.by_parameters)
        if not leaves:
            raise ValueError("a covariance of parameters needs transition(…, parameters=…)")
        rows = self.matrix.shape[:-1]
        S = jnp.concatenate([jnp.reshape(x, (*rows, -1)) for x in leaves], axis=-1)  # (…, 2d, k)
        return P + _propagate_covariance(S, _covariance("parameter_covariance", parameter_covariance, S.shape[-1]))

    def ellipse(
        self,
        initial: npt.ArrayLike,
        coordinates: Sequence[int] = (0, 1),
        sigmas: float = 1.0,
        *,
        parameter_covariance: npt.ArrayLike | None = None,
    ) -> Ellipse:
        """The error ellipse, or ellipsoid, of some coordinates of `covariance`.

        In two dimensions it contains the fraction 1 − exp(−σ²/2) of a Gaussian: 39 % for 1 standard deviation, 86 % for
        2, 99 % for 3.

        Args:
            initial, parameter_covariance: as in `covariance`.
            coordinates: the coordinates of the phase space, k different numbers from 0 to 2d − 1.
            sigmas: the number of standard deviations.

        Raises:
            ValueError: coordinates are out of range; and the errors of `covariance`.
        """
        dim = self.matrix.shape[-1]
        chosen = [int(i) for i in coordinates]
        if not chosen or len(set(chosen)) != len(chosen) or not all(0 <= i < dim for i in chosen):
            raise ValueError(f"coordinates must be different numbers from 0 to {dim - 1}, got {tuple(coordinates)}")
        P = self.covariance(initial, parameter_covariance)[..., chosen, :][..., chosen]
        squares, axes = jnp.linalg.eigh(P)
        return Ellipse(sigmas * jnp.sqrt(jnp.maximum(squares[..., ::-1], 0)), axes[..., ::-1])


def _propagate_covariance(A: Array, P: Array) -> Array:
    return A @ P @ jnp.swapaxes(A, -1, -2)


def _covariance(name: str, given: npt.ArrayLike, dim: int) -> Array:
    """A symmetric matrix (…, dim, dim)."""
    P = _checks.real_array(name, given)
    if P.shape[-2:] != (dim, dim):
        raise ValueError(f"{name} must be a covariance of {dim} coordinates, ({dim}, {dim}), got shape {P.shape}")
    if concrete(P) and not np.allclose(P, np.swapaxes(P, -1, -2), rtol=1e-6, atol=1e-9 * float(np.abs(P).max())):
        raise ValueError(f"{name} must be symmetric, got\n{np.asarray(P)}")
    return P


def transition(
    step: Step | Callable[[PyTree], Step],
    state: State | Callable[[PyTree], State],
    dt: ArrayLike,
    num_steps: int,
    *,
    parameters: PyTree = None,
    save_every: int | None = None,
) -> Transition:
    """The state transition matrix Φ(t) of a run and its sensitivities to parameters, for linear covariance.

    They are exact derivatives of the discrete flow, that is, of the states that `integrate` returns, for any system and
    any step. For many states use jax.vmap, or `li.over_members`.

    Parameters have one of two forms. They are **names** of numbers of the step, `parameters="inertia"`, or several,
    `["inertia", "potential.weight"]`. A name selects all arrays of the step whose path ends with it. These must be
    equal, such as those of the system and of its drift, and vary together; the initial state is held fixed. Or they are
    **numbers**, any tree of arrays: then `step`, or `state`, or both, are functions of them,

        def step(p):
            return li.schemes.splitting(li.systems.heavy_top(p["inertia"], p["weight"]))

        li.transition(step, state, 0.05, 1000, parameters={"inertia": J, "weight": E})

    If the state is such a function too, ∂x(t)/∂p includes the effect of the parameters on x(0): if the angular velocity
    is given, the initial momentum depends on the inertia.

    Args:
        step: a step, or a function of the parameters.
        state: the initial state of one body, or a function of the parameters.
        dt: step size, either sign.
        num_steps: a multiple of `save_every`.
        parameters: names, or a tree of arrays, as above.
        save_every: steps between saved entries; None returns the last one only, without an axis of entries.

    Returns:
        A `Transition`.

    Raises:
        ValueError: a bad count, a name that is unknown or ambiguous, parameters without a function of them, a step that
            advances the time itself, or a first step that does not converge.

    Source: Montenbruck & Gill 2000, Satellite Orbits, 7.2 (the equations of the continuous flow); that Φ of a
    symplectic scheme is symplectic: Hairer, Lubich & Wanner, Geometric Numerical Integration, VI.2.
    """
    run, values = _run_of(step, state, parameters)
    made, start = run(values)
    made, start, dtype = promoted(checked_step(made), start)
    if made.own_time:
        raise ValueError(f"Φ needs steps of given times, and {made.name} chooses its own: use its base step")
    made.check(start, dt)
    interval, num_saves = intervals(num_steps, save_every)
    h, values = jnp.asarray(_checks.step_size(dt), dtype), jax.tree.map(lambda x: x.astype(dtype), values)
    _checks.time_resolution(start_time(made, start), dt, num_steps)
    found = _entries(run, values, h, num_saves, interval)
    return found if save_every is not None else jax.tree.map(lambda x: x[-1], found)


@pytree
class _Run:
    """parameters ↦ (step, state).

    Attributes:
        step, state: as given, or functions of the parameters.
        named: by the names of parameters, the leaves of the step that they select.
    """

    step: Any
    state: Any
    named: tuple[tuple[str, tuple[int, ...]], ...] = static(default=())

    def __call__(self, values: PyTree) -> tuple[Step, State]:
        step = self.step if isinstance(self.step, Step) else self.step(values)
        state = self.state if isinstance(self.state, State) else self.state(values)
        if self.named:
            leaves, structure = jax.tree.flatten(step)
            for name, places in self.named:
                for place in places:
                    leaves[place] = values[name]
            step = structure.unflatten(leaves)
        return step, state


def _run_of(step: Any, state: Any, parameters: PyTree) -> tuple[_Run, PyTree]:
    """The run as a function of its parameters, and their values."""
    functions = [not isinstance(step, Step) and callable(step), not isinstance(state, State) and callable(state)]
    if any(functions):
        if not jax.tree.leaves(parameters) or _is_names(parameters):
            raise ValueError(f"a function of parameters needs their values, a tree of arrays, got {parameters!r}")
        values = jax.tree.map(lambda x: _checks.real_array("a parameter", x), parameters)
        given: list[Any] = [step, state]
        step, state = (callable_pytree(x) if f else x for x, f in zip(given, functions, strict=True))
        return _Run(step, state), values
    if parameters is None:
        return _Run(step, state), None
    if not _is_names(parameters):
        raise ValueError(
            'parameters must be names of numbers of the step, such as "inertia", or numbers of which step or state '
            f"is a function, transition(lambda p: step, state, …, parameters=p); got {parameters!r} and no function"
        )
    step = checked_step(step)
    names = [parameters] if isinstance(parameters, str) else list(parameters)
    leaves = [(_path(path), leaf) for path, leaf in jax.tree_util.tree_flatten_with_path(step)[0]]
    named = tuple((name, _places(name, step, leaves)) for name in names)
    return _Run(step, state, named), {name: jnp.asarray(leaves[places[0]][1]) for name, places in named}


def _is_names(parameters: PyTree) -> bool:
    several = isinstance(parameters, list | tuple) and len(parameters) > 0
    return isinstance(parameters, str) or (several and all(isinstance(x, str) for x in parameters))


def _path(path: Sequence[Any]) -> tuple[str, ...]:
    """The names along the path to a leaf."""
    return tuple(jax.tree_util.keystr((key,), simple=True) for key in path)


def _places(name: str, step: Step, leaves: list[tuple[tuple[str, ...], Any]]) -> tuple[int, ...]:
    """The numbers of the leaves whose path ends with a dotted name; ValueError unless they are real and equal."""
    end = tuple(name.split("."))
    real = [(i, path, x) for i, (path, x) in enumerate(leaves) if jnp.issubdtype(jnp.result_type(x), jnp.floating)]
    found = [(i, path, x) for i, path, x in real if path[-len(end) :] == end]
    if not found:
        known = ", ".join(dict.fromkeys(".".join(path) for _, path, _ in real))
        raise ValueError(f"{step.name} holds no number named {name!r}; it has {known}")
    values = [x for *_, x in found]
    same = all(jnp.shape(x) == jnp.shape(values[0]) for x in values)
    if not same or (concrete(values) and not all(np.array_equal(x, values[0]) for x in values)):
        paths = ", ".join(".".join(path) for _, path, _ in found)
        raise ValueError(f"{name!r} stands for different numbers: {paths}. Give a longer name, or a function")
    return tuple(i for i, *_ in found)


@partial(compiled, static_argnums=(3, 4))
def _entries(run: _Run, values: PyTree, dt: Array, num_saves: int, save_every: int) -> Transition:
    """All entries, the start first."""
    p, unravel = ravel_pytree(values)

    def make_run(p: Array) -> tuple[Step, State]:
        step, state, _ = promoted(*run(unravel(p)))
        return step, state

    step, start = make_run(p)
    tangents, dim = _Tangents(step.system.phase_space, start), step.system.phase_space.dim
    clock = uniform_clock(step, start, dt)

    def step_once(n: Array, carry: PyTree, _: None) -> tuple[PyTree, PyTree]:
        state, T, so_far = carry
        h = clock.size(n)
        if tangents.dim == dim:
            end, info, moved = step.tangent(state, h, T)
        else:
            end, info, moved = tangents.push_forward(lambda z: step(z, h), state, T)
        if p.size:
            slope = tangents.slope(lambda p: make_run(p)[0](state, h)[0], p)
            moved = moved.at[:, dim:].add(slope)
        end, info = at_time(end, clock.time(n + 1)), info_since(n, save_every, so_far, info)
        return (end, moved, info), ((end, info), moved)

    T = jnp.eye(tangents.dim, dim, dtype=start.p.dtype)
    if p.size:
        T = jnp.concatenate([T, tangents.slope(lambda p: make_run(p)[1], p)], axis=1)
    begin = (start, T, StepInfo.empty(start.p))
    _, (later, Ts) = native.march(step_once, begin, rows=num_saves, every=save_every)
    rows = jnp.concatenate([T[None], Ts])[:, :dim]
    trajectory = join_start(start, later, clock.time(save_every * jnp.arange(num_saves + 1)))
    by_parameters = jax.vmap(jax.vmap(unravel))(rows[:, :, dim:]) if p.size else None
    return Transition(trajectory.t, trajectory.state, trajectory.info, rows[:, :, :dim], by_parameters)


class _Tangents:
    """Coordinates of tangent vectors: those of the phase space, then the real numbers of `State.extra`.

    Attributes:
        dim: how many there are.
    """

    def __init__(self, space: PhaseSpace, like: State) -> None:
        self._space = space
        self.dim = space.dim + self._extra(like).size

    def push_forward(self, function: Callable[[State], PyTree], state: State, T: Array) -> tuple[State, PyTree, Array]:
        """end, aux = function(state), and the derivative of end times T, (dim, k)."""

        def perturbed_end(delta: Array) -> tuple[State, tuple[State, PyTree]]:
            end, aux = function(self._perturbed(state, delta))
            return end, (end, aux)

        _, push, (end, aux) = jax.linearize(perturbed_end, jnp.zeros(self.dim, T.dtype), has_aux=True)
        return end, aux, jax.vmap(lambda delta: self._coordinates(end, push(delta)), -1, -1)(T)

    def slope(self, function: Callable[[Array], State], p: Array) -> Array:
        """The derivative of a state in parameters, (dim, k)."""
        end, push = jax.linearize(function, p)
        return jax.vmap(lambda dp: self._coordinates(end, push(dp)), -1, -1)(jnp.eye(p.size, dtype=p.dtype))

    def _extra(self, state: State) -> Array:
        real = [x.ravel() for x in jax.tree.leaves(state.extra) if jnp.issubdtype(x.dtype, jnp.floating)]
        return jnp.concatenate([jnp.zeros(0, state.p.dtype), *real])

    def _perturbed(self, state: State, delta: Array) -> State:
        moved, n = self._space.perturb(state, delta[: self._space.dim]), self._space.dim
        leaves, structure = jax.tree.flatten(state.extra)
        for i, x in enumerate(leaves):
            if jnp.issubdtype(x.dtype, jnp.floating):
                leaves[i], n = x + delta[n : n + x.size].reshape(x.shape), n + x.size
        return moved._replace(extra=structure.unflatten(leaves))

    def _coordinates(self, state: State, tangent: State) -> Array:
        return jnp.concatenate([self._space.trivialize(state, tangent), self._extra(tangent)])
