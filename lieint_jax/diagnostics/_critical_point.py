"""Newton's method for critical points of K(x) = H(x) − ω·π − ξ·Φ(x), and what rounding errors leave unknown of them.

Stiffnesses differ: a rod resists extension 10⁸ times as much as bending. The size of dK then says nothing about soft
directions, in which a force below the rounding errors of the stiff ones moves the state far. So a state is judged by
Newton's step from it, the displacement to the critical point, and by the rounding errors of that step. These follow
from those of dK and d²K, which are measured: both are computed again at states a few ulp away.

A direction is neutral if its stiffness is a rounding error, as along the symmetries. The step has no part along it.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax._xla import compiled
from lieint_jax.core import State, System
from lieint_jax.core.tangent import units_at_start
from lieint_jax.groups import so3
from lieint_jax.phase_spaces import CotangentGroup

_Tree = TypeVar("_Tree")
_ITERATIONS, _HALVINGS, _STAGES = 60, 12, 100
_LONGEST = 0.5  # of a step, in units of the state
_WINDOW = 3  # steps: of a stiff system each second one only removes the stress that the one before has caused
_WEIGHT = 0.1  # a change of the rates in the length of a step; Newton's method fails sooner with more than 0.3
_RANK = 1e-9  # singular values of dΦ below this part of the largest one count as 0
_BALANCINGS = 8  # sweeps that give the rows and columns of a matrix the size 1
_SAMPLES = 2  # states at which rounding errors are measured
_SAFETY = 32  # rounding errors: more than that is none
_KNOWN = 1e-3  # units of the state: a larger rounding error leaves it unknown


class Spins(NamedTuple):
    """Symmetric bodies that spin at rates of their own.

    Attributes:
        bodies: their numbers, (k,).
        axes: their axes of symmetry in the bodies, (k, 3).
    """

    bodies: Array
    axes: Array

    def momentum(self, state: State) -> Array:
        """Π·a of each, (k,)."""
        return jnp.sum(jax.vmap(so3.Ad_star)(state.q[self.bodies, 3:], state.p[self.bodies, 3:]) * self.axes, axis=1)


class Derivatives(NamedTuple):
    """Gradients and Hessians of the terms of K at a state, in the coordinates of the phase space.

    Attributes:
        energy, energy2: those of H − ω·π, (2d,) and (2d, 2d).
        momentum, momentum2: those of Φ, (k, 2d) and (k, 2d, 2d).
        omega: the symplectic form, (2d, 2d).
        unit: the units of the coordinates, (2d,).
    """

    energy: np.ndarray
    energy2: np.ndarray
    momentum: np.ndarray
    momentum2: np.ndarray
    omega: np.ndarray
    unit: np.ndarray

    def rates(self) -> np.ndarray:
        """The ξ, (k,), with which |dK| is least."""
        directions, sizes = self.directions()
        return np.linalg.lstsq(directions.T, self.unit * self.energy, rcond=_RANK)[0] / sizes if sizes.size else sizes

    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """dΦ in units of the state, (k, 2d), each over its length, and the lengths: no unit mixes P with L."""
        along = self.momentum * self.unit
        sizes = np.linalg.norm(along, axis=1)
        sizes[sizes == 0] = 1
        return along / sizes[:, None], sizes

    def gradient(self, rates: np.ndarray) -> np.ndarray:
        """dK in units of the state, (2d,)."""
        return self.unit * (self.energy - rates @ self.momentum)

    def hessian(self, rates: np.ndarray) -> np.ndarray:
        """d²K in units of the state, (2d, 2d)."""
        S = self.energy2 - np.tensordot(rates, self.momentum2, 1)
        return self.unit[:, None] * S * self.unit


class Pull(NamedTuple):
    """A force that does not depend on the state, the term f·δ of the energy at the displacement δ from an origin."""

    origin: State
    force: Array


def derivatives(
    system: System, state: State, frame: Array, spins: Spins | None, pull: Pull | None = None
) -> Derivatives:
    """The derivatives at a concrete state, as host arrays; `pull`: a force that is subtracted from dK."""
    found = *_derivatives(system, state, frame, spins, pull), units_at_start(system, state)
    return Derivatives(*(np.asarray(x, float) for x in found))


@partial(compiled, once=True)
def _derivatives(
    system: System, state: State, frame: Array, spins: Spins | None, pull: Pull | None
) -> tuple[Array, ...]:
    space = system.phase_space

    def energy(delta: Array) -> Array:
        moved = space.perturb(state, delta)
        H = system.energy(moved)
        if pull is not None:
            H = H - pull.force @ space.displacement(pull.origin, moved)
        return H - frame @ moved.p if is_attitude(system) else H

    def momentum(delta: Array) -> Array:
        moved = space.perturb(state, delta)
        known = system.momentum(moved)
        return known if spins is None else jnp.concatenate([known, spins.momentum(moved)])

    zero = jnp.zeros(space.dim, state.p.dtype)
    k = jax.eval_shape(momentum, zero).size
    first, second = jax.grad(energy), jax.jacfwd(jax.grad(energy))
    if not k:
        along, along2 = jnp.zeros((0, space.dim)), jnp.zeros((0, space.dim, space.dim))
    else:
        along, along2 = jax.jacfwd(momentum)(zero), jax.jacfwd(jax.jacfwd(momentum))(zero)
    return first(zero), second(zero), along, along2, space.omega(state)


class Correction(NamedTuple):
    """Newton's step from a state to the critical point of K.

    Attributes:
        step: in units of the state, (2d,), 0 for coordinates that are held.
        rounding: the errors of its components by rounding of dK, (2d,).
        force: the part of dK that no step removes, over its rounding error: below `_SAFETY` it is none.
        unit: the units of the state, (2d,).
    """

    step: np.ndarray
    rounding: np.ndarray
    force: float
    unit: np.ndarray

    @property
    def size(self) -> float:
        """The largest component of the step."""
        return float(np.abs(self.step).max())

    @property
    def is_rounding(self) -> bool:
        """Whether the state is a critical point, up to rounding errors, and these leave the state known."""
        error = float(self.rounding.max())
        return self.size <= _SAFETY * error and self.force <= _SAFETY and error <= _KNOWN

    @property
    def distance(self) -> float:
        """How far the critical point may be, in units of the state."""
        return max(self.size, float(self.rounding.max()))


def in_double(given: _Tree) -> _Tree:
    """A pytree with float64 in place of float32: its rounding errors would hide directions 10⁶ times as soft."""
    return jax.tree.map(lambda x: jnp.asarray(x, float) if getattr(x, "dtype", None) == np.float32 else x, given)


def rounded(found: _Tree, dtype: np.dtype) -> _Tree:
    """A pytree with its real numbers in a given type, outside of `jax.enable_x64`."""

    def leaf(x: object) -> object:
        if not isinstance(x, Array):
            return x
        values = np.asarray(x)
        return jnp.asarray(values.astype(dtype) if values.dtype.kind == "f" else values)

    return jax.tree.map(leaf, found)


class Problem(NamedTuple):
    """dK = 0 for a system, with the coordinates that may change.

    Attributes:
        system, frame, spins: as in `derivatives`.
        free: the numbers of the coordinates that may change.
    """

    system: System
    frame: Array
    spins: Spins | None
    free: np.ndarray

    def derivatives(self, state: State, pull: Pull | None = None) -> Derivatives:
        return derivatives(self.system, state, self.frame, self.spins, pull)

    def correction(self, state: State, pull: Pull | None = None) -> Correction:
        """Newton's step: of all that its equation allows, with a change of ξ, the shortest in units of the state."""
        found = self.derivatives(state, pull)
        rates, eps = found.rates(), float(np.finfo(state.p.dtype).eps)
        g, (directions, _) = found.gradient(rates), found.directions()
        S = found.hessian(rates)
        g_error, S_error, directions_error = self._rounding(state, pull, found, rates, eps)
        M, size = self._matrix(S, directions)
        error = np.concatenate([S_error[:, self.free], _WEIGHT * (size or 1) * directions_error.T], axis=1)
        inverse = _pseudo_inverse(M, error, eps)
        rest = np.eye(len(g)) - M @ inverse
        unsure = np.sqrt(rest**2 @ g_error**2) + eps * (np.abs(M) @ np.abs(inverse @ g) + size)
        step, rounding = np.zeros((2, len(g)))
        n = self.free.size
        step[self.free] = -inverse[:n] @ g
        rounding[self.free] = np.sqrt(inverse[:n] ** 2 @ g_error**2)
        force = float(np.max(np.abs(rest @ g) / np.where(unsure > 0, unsure, 1)))
        return Correction(step, np.maximum(rounding, eps), force, found.unit)

    def _matrix(self, S: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, float]:
        """The matrix of Newton's equation by the free coordinates and by weighted rates, and the size of d²K."""
        size = float(np.linalg.norm(S[:, self.free], axis=0).max())
        return np.concatenate([S[:, self.free], _WEIGHT * (size or 1) * directions.T], axis=1), size

    def _rounding(
        self, state: State, pull: Pull | None, found: Derivatives, rates: np.ndarray, eps: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The rounding errors of dK and d²K, in units of the state, and those of the directions of dΦ."""
        g, S, (directions, sizes) = found.gradient(rates), found.hessian(rates), found.directions()
        g_error = eps * found.unit * (np.abs(found.energy) + np.abs(rates) @ np.abs(found.momentum))
        S_error, directions_error = np.zeros_like(S), eps * np.abs(directions)
        for delta in eps * np.random.default_rng(0).uniform(-3, 3, (_SAMPLES, len(g))):
            near = self.derivatives(self._moved(state, delta, found.unit), pull)
            near = near._replace(unit=found.unit)
            g_error = np.maximum(g_error, np.abs(near.gradient(rates) - g - S @ delta))
            S_error = np.maximum(S_error, np.abs(near.hessian(rates) - S))
            turned = np.abs(near.momentum * found.unit / sizes[:, None] - directions)
            directions_error = np.maximum(directions_error, turned)
        return g_error, S_error, directions_error

    def solved(self, guess: State) -> tuple[State, Correction]:
        """The critical point near a guess, and the correction there: by Newton's method, or else along a path.

        On the path the guess is held by a force −dK that decreases to 0: a rod is loaded little by little.
        """
        for search in (self._decrease, self.newton):
            end = search(guess)
            last = self.correction(end)
            if last.is_rounding:
                return end, last
        begin = self.derivatives(guess)
        force = (begin.energy - begin.rates() @ begin.momentum).astype(guess.p.dtype)
        state, part, more = guess, 0.0, 0.25
        for _ in range(_STAGES):
            more = min(more, 1 - part)
            held = Pull(guess, jnp.asarray((1 - part - more) * force)) if part + more < 1 else None
            tried = self.newton(state, held)
            there = self.correction(tried, held)
            if there.is_rounding and held is None:
                return tried, there
            if there.is_rounding:
                state, part, more = tried, part + more, 2 * more
            else:
                more /= 4
        return end, last

    def _decrease(self, state: State) -> State:
        """The last state of steps that decrease |dK|: quick and safe where no stiffness is much below the others."""
        found = self.derivatives(state)
        rates = found.rates()
        g, eps = found.gradient(rates), float(np.finfo(state.p.dtype).eps)
        for _ in range(_ITERATIONS):
            M, size = self._matrix(found.hessian(rates), found.directions()[0])
            step, least = np.zeros(len(g)), np.abs(g).max()
            step[self.free] = -np.linalg.lstsq(M, g, rcond=_RANK)[0][: self.free.size]
            part = min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-300))
            for _ in range(_HALVINGS):
                moved = self._moved(state, part * step, found.unit)
                after = self.derivatives(moved)
                rates = after.rates()
                g = after.gradient(rates)
                if np.abs(g).max() < least:
                    break
                part /= 2
            else:
                break
            state, found = moved, after
            if size == 0 or np.abs(g).max() <= eps * size:
                break
        return state

    def _moved(self, state: State, delta: np.ndarray, unit: np.ndarray) -> State:
        return _perturb(self.system, state, jnp.asarray(delta * unit, state.p.dtype))

    def newton(self, state: State, pull: Pull | None = None) -> State:
        """The last state of Newton's steps, whose size may increase, but not above those of the last few."""
        here = self.correction(state, pull)
        sizes = [here.size]
        for _ in range(_ITERATIONS):
            part = min(1.0, _LONGEST / max(here.size, 1e-300))
            for _ in range(_HALVINGS):
                moved = self._moved(state, part * here.step, here.unit)
                there = self.correction(moved, pull)
                if there.is_rounding or there.size <= max(sizes[-_WINDOW:]):
                    break
                part /= 2
            else:
                break
            if here.is_rounding and not there.size <= here.size / 2:
                break
            state, here = moved, there
            sizes.append(here.size)
        return state


def _pseudo_inverse(M: np.ndarray, error: np.ndarray, eps: float) -> np.ndarray:
    """The pseudoinverse of a matrix known up to errors, computed where rows and columns have the size 1."""
    M = np.where(np.abs(M) <= _SAFETY * error, 0, M)
    rows, columns = _balance(np.abs(M))
    balanced = rows[:, None] * M * columns
    U, s, Vt = np.linalg.svd(balanced, full_matrices=False)
    squares = (rows[:, None] * error * columns) ** 2
    unsure = np.sqrt(np.sum((U.T**2 @ squares) * Vt**2, axis=1))
    firm = s > np.maximum(_SAFETY * unsure, max(M.shape) * eps * s.max(initial=0))
    Q = np.linalg.qr(Vt[firm].T / columns[:, None])[0]  # an orthonormal basis of the steps that are the shortest
    return Q @ (Q.T @ (columns[:, None] * ((Vt[firm].T / s[firm]) @ (U[:, firm].T * rows))))


def _balance(sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factors of the rows and columns with which the largest number of each is about 1 (Ruiz 2001)."""
    rows, columns = np.ones(len(sizes)), np.ones(sizes.shape[1])
    for _ in range(_BALANCINGS):
        for axis, factors in ((1, rows), (0, columns)):
            largest = np.max(rows[:, None] * sizes * columns, axis=axis)
            factors /= np.sqrt(np.where(largest > 0, largest, 1))
    return rows, columns


@partial(compiled, once=True)
def _perturb(system: System, state: State, delta: Array) -> State:
    return system.phase_space.perturb(state, delta)


def is_attitude(system: System) -> bool:
    """Whether the system is one body's attitude, on T*SO(3)."""
    space = system.phase_space
    return isinstance(space, CotangentGroup) and space.group is so3
