"""Several rigid bodies that act on one another through a potential of their positions and attitudes."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import overload

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks, potentials
from lieint_jax._checks import at_once, concrete, outermost
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Masses, MomentumMap, Poses, Positions, PyTree, Scalar
from lieint_jax._xla import compiled
from lieint_jax.core import ChainLaw, PairLaw, State, callable_pytree, clock, from_fields, pair_forces, pytree
from lieint_jax.groups import so3
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import (
    AbstractDissipativeBodies,
    AbstractFreeBodies,
    AbstractManyBodies,
    AbstractRigidBodies,
    rotations,
)
from lieint_jax.systems._rigid_body import RigidBody
from lieint_jax.systems._shared.arguments import check_counts, explained, timed

__all__ = ["DissipativeBodies", "RigidBodies", "rigid_bodies"]

_ARGUMENTS = "positions (N, 3) and rotations (N, 3, 3)"
_LAW = "(r, v, ω_i, ω_j) ↦ (f, τ_i, τ_j)"
_GIVEN = "the time, positions (N, 3), rotations (N, 3, 3), velocities and angular velocities (N, 3)"
_DIGITS = {"float64": 11, "float32": 4}  # of the least distance, below which a state warns


@pytree
class _Many(AbstractManyBodies):
    """The methods of free and of interacting bodies that create and evaluate states."""

    masses: Array  # (N,)
    inertias: Array  # (N, 3) or (N, 3, 3)
    _clock = None  # the time and the work of a state that is given none

    @explained
    def state(
        self,
        positions: ArrayLike,
        attitudes: _checks.Attitude | None = None,
        *,
        velocities: ArrayLike | None = None,
        angular_velocities: ArrayLike | None = None,
        t: ArrayLike | None = None,
        work: ArrayLike | None = None,
    ) -> State:
        """The state of N bodies.

        Args:
            positions: positions of the centers of mass, (N, 3).
            attitudes: unit quaternions (w, x, y, z), (N, 4), or rotation matrices (N, 3, 3), or N scipy `Rotation`s
                or a list of them, body to space; by default the identity, (1, 0, 0, 0).
            velocities: velocities of the centers of mass, (N, 3); by default 0.
            angular_velocities: Ω of each body in its own axes, radians per unit time, (N, 3); by default 0.
            t: the time; by default 0 for bodies with dissipation or given forces, otherwise None.
            work: the work done on the bodies so far, in which losses are negative; by default 0 for bodies with
                dissipation or given forces, otherwise None.

        Returns:
            q (N, 7): position and quaternion; p (N, 6): linear momentum, and spatial angular momentum about the body's
            own center of mass.

        Raises:
            ValueError: a wrong shape, a NaN, an attitude that is not a rotation, two bodies at the same position.

        Warns:
            RuntimeWarning: the bodies are so far from the origin that rounding leaves few digits of their distances.
        """
        n = self.masses.shape[0]
        x = _checks.real_array("positions", positions, (n, 3))
        v, Omega = (
            np.zeros((n, 3), x.dtype) if given is None else _checks.real_array(name, given, (n, 3))
            for name, given in (("velocities", velocities), ("angular_velocities", angular_velocities))
        )
        state = _make_state(self.masses, self.inertias, x, _attitudes(attitudes, n, x), v, Omega)
        t, work = self._clock if t is None else t, self._clock if work is None else work
        state = state if t is None and work is None else timed(state, 0.0 if t is None else t, work)
        self.check(state)
        return state

    def kinetic_energy(self, state: State) -> Scalar:
        """Σ |p|²/2m + ½ Π·J⁻¹Π."""
        Pi = jax.vmap(so3.Ad_star)(state.q[:, 3:], state.p[:, 3:])
        turning = jnp.sum(Pi * self.angular_velocities(state)) / 2
        return turning + jnp.sum(state.p[:, :3] ** 2 / self.masses[:, None]) / 2

    def momentum(self, state: State) -> MomentumMap:
        """P = Σp and L = Σ(x × p + π) about the origin, (6,)."""
        x, p, spin = state.q[:, :3], state.p[:, :3], state.p[:, 3:]
        return jnp.concatenate([jnp.sum(p, axis=0), jnp.sum(jnp.cross(x, p) + spin, axis=0)])

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system; warn where distances have few digits."""
        n = self.masses.shape[0]
        if self.masses.ndim != 1 or self.inertias.shape not in ((n, 3), (n, 3, 3)):
            raise ValueError(
                f"masses of one system are (N,), its inertias (N, 3) or (N, 3, 3), got {self.masses.shape} and "
                f"{self.inertias.shape}. If each member has its own system, give li.run own_step=True"
            )
        _checks.real_array("state.q", state.q, (n, 7))
        _checks.real_array("state.p", state.p, (n, 6))
        check_counts(state)
        if not concrete(state.q):
            return
        q = np.asarray(state.q)
        _checks.nearly_unit("state.q", np.asarray(q[:, 3:], float), _checks.UNIT_TOLERANCE)
        _check_places(q[:, :3])


@pytree
class FreeBodies(_Many, AbstractFreeBodies):
    """N free rigid bodies: `RigidBodies.free`."""

    def energy(self, state: State) -> Scalar:
        """The kinetic energy."""
        return self.kinetic_energy(state)

    def single_body(self, inertia: Array) -> RigidBody:
        """A free body of this inertia."""
        return from_fields(RigidBody, inertia=inertia)


@pytree
class RigidBodies(_Many, AbstractRigidBodies):
    """H = Σ |p|²/2m + ½ Π·J⁻¹Π + V(x, Λ). Made by `rigid_bodies`."""

    potential: Callable[[Array, Array], Array]

    @property
    def free(self) -> FreeBodies:
        """The same bodies without the potential."""
        return FreeBodies(self.masses, self.inertias)

    @property
    def domain(self) -> str:
        return potentials.domain(self.potential)

    def potential_energy(self, q: Poses) -> Scalar:
        """V(x, Λ)."""
        return self.potential(q[:, :3], rotations(q))

    def momentum(self, state: State) -> MomentumMap:
        """P = Σp and L = Σ(x × p + π) about the origin, (6,), projected to what an external field conserves of them."""
        both, kept = super().momentum(state), potentials.symmetry(self.potential)
        return both if kept is None else jnp.sum(kept * both, axis=1)

    def energy(self, state: State) -> Scalar:
        """The kinetic energy and V."""
        return self.kinetic_energy(state) + self.potential_energy(state.q)

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system; warn where distances have few digits."""
        super().check(state)
        if concrete(state.q, self.potential):
            energy = _potential_energy if outermost() else RigidBodies.potential_energy  # jit keeps all programs
            with at_once():
                V = energy(self, jnp.asarray(state.q))
            if concrete(V) and not np.isfinite(np.asarray(V)):
                sentence = f"the potential must be finite at the start, got {float(V)}"
                raise ValueError(". ".join(filter(None, [sentence, self.domain])))


@pytree
class DissipativeBodies(_Many, AbstractDissipativeBodies):
    """Bodies in a mutual potential with dissipative forces between pairs or given forces. Made by `rigid_bodies`."""

    potential: Callable[[Array, Array], Array]
    dissipation: Callable[..., PyTree] | ChainLaw | None
    forces: Callable[..., PyTree] | None = None
    _clock = 0.0

    @property
    def conservative(self) -> RigidBodies:
        """The same bodies without dissipation and given forces."""
        return RigidBodies(self.masses, self.inertias, self.potential)

    @property
    def domain(self) -> str:
        return self.conservative.domain

    def potential_energy(self, q: Array) -> Array:
        """V(x, Λ)."""
        return self.conservative.potential_energy(q)

    def momentum(self, state: State) -> Array:
        """P and L, (6,), as in `RigidBodies`; (0,) with given forces, whose impulses change both."""
        return self.conservative.momentum(state) if self.forces is None else state.p[0, :0]

    def energy(self, state: State) -> Array:
        """The kinetic energy plus V; energy less `state.work` is conserved, and dissipation alone decreases it."""
        return self.at(state.t).energy(state)

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system; warn where distances have few digits."""
        if self.forces is not None or potentials.is_driven(self.potential):
            clock(state)
        self.at(state.t).check(state)


@partial(compiled, once=True)
def _potential_energy(system: RigidBodies, q: Poses) -> Scalar:
    return system.potential_energy(q)


@partial(compiled, once=True)
def _make_state(
    masses: Masses, inertias: Array, x: Positions, turns: Array, v: Array | np.ndarray, Omega: Array | np.ndarray
) -> State:
    """The state of positions, attitudes (quaternions or rotation matrices) and velocities."""
    turns = jax.vmap(so3.normalize if turns.ndim == 2 else so3.from_matrix)(turns)
    Pi = jax.vmap(lambda J, w: jnp.stack(vectors.symmetric(J) @ w))(inertias, Omega)
    p = jnp.concatenate([masses[:, None] * v, jax.vmap(so3.Ad)(turns, Pi)], axis=1)
    q = jnp.concatenate([x, turns], axis=1)
    dtype = jnp.result_type(q, p)
    return State(q.astype(dtype), p.astype(dtype))


def _attitudes(attitudes: _checks.Attitude | None, n: int, like: Array) -> Array:
    """Quaternions (n, 4) or rotation matrices (n, 3, 3), checked; the identity if there are none."""
    if attitudes is None:
        return _checks.as_array(np.tile([1.0, 0, 0, 0], (n, 1)), like.dtype)
    given = _checks.real_array("attitudes", _checks.quaternions(attitudes), (n, 4), (n, 3, 3))
    if given.ndim == 2:
        return _checks.unit_quaternion("attitudes", given, (n, 4))
    return _checks.rotation_matrix("attitudes", given, leading=True)


def _check_places(x: np.ndarray) -> None:
    """ValueError if two of the positions (N, 3) coincide; a warning if their distances have few digits."""
    if len(x) < 2:
        return
    nearest = np.inf
    for i in range(len(x) - 1):
        distances = np.linalg.norm(x[i + 1 :] - x[i], axis=1)
        if not distances.all():
            other = i + 1 + int(np.argmin(distances))
            raise ValueError(f"bodies {i} and {other} are at the same position, {x[i]}: move one of them")
        nearest = min(nearest, float(distances.min()))
    digits = np.log10(nearest / np.spacing(np.abs(x).max()))
    if digits < _DIGITS[str(x.dtype)]:
        warnings.warn(
            f"two bodies are {nearest:.3g} apart and {np.abs(x).max():.3g} from the origin: their distance has "
            f"{max(digits, 0):.1f} digits in {x.dtype}; give positions relative to the barycenter",
            RuntimeWarning,
            stacklevel=4,
        )


_V = Callable[[Array, Array], Array]
_Law = Callable[..., PyTree]


@overload
def rigid_bodies(
    masses: ArrayLike, inertias: ArrayLike, potential: _V, dissipation: None = None, *, forces: None = None
) -> RigidBodies: ...
@overload
def rigid_bodies(
    masses: ArrayLike, inertias: ArrayLike, potential: _V, dissipation: _Law, *, forces: _Law | None = None
) -> DissipativeBodies: ...
@overload
def rigid_bodies(
    masses: ArrayLike, inertias: ArrayLike, potential: _V, dissipation: None = None, *, forces: _Law
) -> DissipativeBodies: ...
def rigid_bodies(
    masses: ArrayLike,
    inertias: ArrayLike,
    potential: Callable[[Array, Array], Array],
    dissipation: Callable[..., PyTree] | None = None,
    *,
    forces: Callable[..., PyTree] | None = None,
) -> RigidBodies | DissipativeBodies:
    """N ≥ 1 rigid bodies in a potential V(x, Λ) of their positions and attitudes.

    A potential of relative positions and attitudes conserves the linear momentum P and the angular momentum L about
    the origin; `momentum` returns (P, L). With an external field, `momentum` returns the components that remain
    conserved, and 0 for the others. Give positions relative to the barycenter: far from the origin, differences of
    positions lose digits.

    Args:
        masses: (N,), > 0, or N shapes of `lieint_jax.shapes`.
        inertias: about the centers of mass: principal moments (N, 3), or tensors in body axes (N, 3, 3), positive
            definite; or N shapes.
        potential: (positions (N, 3), rotations body to space (N, 3, 3)) ↦ a scalar, from `lieint_jax.potentials`, or
            any function that JAX can differentiate.
        dissipation: a dissipative law between pairs of bodies, such as `tides.constant_lag(…)`, or a function
            (r, v, ω_i, ω_j) ↦ (f, τ_i, τ_j) of the position and velocity of the second body relative to the first and
            of their angular velocities, all in space, to the force on the second body and the torques on both (see
            `tides.PairLaw`). Only `schemes.bodies_energy_momentum` integrates it; `State.work` counts the losses.
        forces: given forces and torques that may supply energy, such as thrust, YORP and BYORP: a function
            (t, x, Λ, v, ω) ↦ (forces, torques) of the time, positions (N, 3), rotations body to space (N, 3, 3),
            velocities (N, 3) and angular velocities (N, 3), to forces (N, 3) and torques about each center (N, 3), all
            in space. A force f in the axes of body i is `rotations[i] @ f`. Only `schemes.bodies_energy_momentum`
            integrates them; `State.work` counts their work, of either sign, and `momentum` is empty, as they change it.

    Raises:
        ValueError: a mass is not positive, an inertia is not positive definite, or shapes disagree; the potential, the
            law or `forces` is not callable, or is for another number of bodies; the law changes the angular momentum,
            or adds energy.

    Source: Maciejewski 1995, Celest. Mech. Dyn. Astron. 63.
    """
    m = _checks.real_array("masses", _checks.of_shapes("mass", masses))
    if m.ndim != 1 or not m.size:
        raise ValueError(f"masses must have shape (N,), got {m.shape}")
    m = _checks.positive("masses", m, m.shape)
    J = _checks.real_array("inertias", _checks.of_shapes("inertia", inertias))
    if J.shape not in ((m.size, 3), (m.size, 3, 3)):
        raise ValueError(
            f"inertias must have shape ({m.size}, 3) or ({m.size}, 3, 3), as many as masses; got {J.shape}"
        )
    if concrete(J):
        for i in range(m.size):
            _checks.inertia(np.asarray(J)[i])
    if not callable(potential):
        raise ValueError(f"potential must be a function of {_ARGUMENTS}, got {potential!r}")
    n = potentials.count(potential)
    if n not in (None, m.size):
        raise ValueError(f"the potential is for {n} bodies, but there are {m.size} masses")
    if isinstance(potential, potentials.Potential):
        potential = potential.with_bodies(m, J)
    made = RigidBodies(m, J, callable_pytree(potential))
    still = RigidBodies(m, J, potentials.at_time(made.potential, jnp.zeros((), m.dtype)))
    _checks.function("potential", still.potential_energy, _ARGUMENTS, (), jax.ShapeDtypeStruct((m.size, 7), m.dtype))
    if dissipation is None and forces is None and not potentials.is_driven(potential):
        return made
    law = dissipation if dissipation is None or isinstance(dissipation, ChainLaw) else _pair_law(dissipation, m)
    given = None if forces is None else _checked_forces(forces, m)
    return DissipativeBodies(m, J, made.potential, law, given)


PROPERTIES = SystemProperties(
    name="rigid_bodies",
    models="several rigid bodies in a potential of positions and attitudes",
    phase_space="(T*ℝ³ × T*SO(3))ᴺ: poses (N, 7), momenta (N, 6)",
    conserves=("energy (without dissipation and given forces)", "energy less work", "momentum (without given forces)"),
    momentum="P and L about the origin, or the components that an outer field leaves; none with given forces",
    sizes=(6, 5, 4, 3, 2, 1, 0),
    aliases=("full two-body problem", "rigid molecules"),
    source="Maciejewski 1995, Celest. Mech. 63",
)


def _pair_law(dissipation: Callable[..., PyTree], masses: Array) -> Callable[..., PyTree]:
    """The law; ValueError unless it is one for these bodies, conserves angular momentum and does not add energy."""
    n = masses.size
    if not callable(dissipation):
        raise ValueError(
            f"dissipation must be a law of pairs, such as tides.constant_lag(…), or a function {_LAW}, got "
            f"{dissipation!r}"
        )
    if n < 2:
        raise ValueError(f"dissipation needs two bodies or more, but there is {n} mass")
    if isinstance(dissipation, PairLaw) and dissipation.count not in (None, n):
        raise ValueError(f"the law of dissipation is for {dissipation.count} bodies, but there are {n} masses")
    space = [jax.ShapeDtypeStruct((n, 3), masses.dtype)] * 3
    _checks.function("dissipation", lambda *moving: pair_forces(dissipation, *moving)[0], _LAW, (n, 6), *space)
    law = callable_pytree(dissipation)
    if not concrete(law, masses):
        return law
    P, L, gain, size = np.asarray(_violations(law, masses))
    if not np.isfinite(size):  # a law that is singular where it is looked at cannot be judged
        return law
    if max(P, L) > size:
        raise ValueError(
            "dissipation must conserve the angular momentum, r × f + τ_i + τ_j = 0: the force on the second body and "
            f"the torques on both, {_LAW}; at a test state the sum is off by more than rounding"
        )
    if gain > size:
        raise ValueError(
            f"dissipation must not add energy, f·v + τ_i·ω_i + τ_j·ω_j ≤ 0, {_LAW}; at a test state it does. Check "
            "its sign, or give forces that supply energy as forces=…"
        )
    return law


def _checked_forces(forces: Callable[..., PyTree], masses: Array) -> Callable[..., PyTree]:
    """The function; ValueError unless it returns two arrays, the forces and the torques on all bodies."""
    n = masses.size
    given = [jax.ShapeDtypeStruct(shape, masses.dtype) for shape in ((), (n, 3), (n, 3, 3), (n, 3), (n, 3))]
    for part, kind in enumerate(("forces", "torques")):

        def of_kind(*arguments: Array, part: int = part) -> Array:
            pushes, turns = forces(*arguments)
            return jnp.asarray((pushes, turns)[part])

        _checks.function(f"the {kind} that forces returns", of_kind, _GIVEN, (n, 3), *given)
    return callable_pytree(forces)


@partial(compiled, once=True)
def _violations(law: Callable[..., PyTree], masses: Array) -> Array:
    """The defects of linear and angular momentum under the law, the energy it adds, and the tolerance for all."""
    numbers = jnp.arange(9 * masses.size, dtype=masses.dtype)
    x, v, omega = jnp.sin(1.7 * numbers + 0.3 * numbers**2).reshape(3, -1, 3)
    force, lost = pair_forces(law, x, v, omega)
    f, tau = force[:, :3], force[:, 3:]
    turned = jnp.abs(jnp.sum(jnp.cross(x, f) + tau, axis=0)).max()
    given = jnp.sum(f * v + tau * omega)
    size = jnp.sqrt(jnp.finfo(x.dtype).eps) * jnp.abs(force).sum()
    return jnp.stack([jnp.abs(jnp.sum(f, axis=0)).max(), turned, jnp.maximum(given, -lost), size])


def examples() -> dict[str, tuple[RigidBodies | DissipativeBodies, State, float]]:
    """A binary asteroid, alone, with friction between its bodies, with given forces; three bodies."""
    masses, inertias = jnp.array([1.0, 0.5]), jnp.array([[0.10, 0.11, 0.12], [0.030, 0.034, 0.040]])
    binary = rigid_bodies(masses, inertias, potentials.maccullagh(1.0, masses, inertias))
    at = jnp.array([[-1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    moving = jnp.array([[0.0, -0.24, -0.01], [0.0, 0.48, 0.02]])
    spins = jnp.array([[0.1, 0.0, 1.2], [0.0, 0.02, 0.24]])
    triple = rigid_bodies([1.0, 0.5, 0.2], jnp.array([[0.1, 0.2, 0.25]] * 3), _spread)
    corners = jnp.array([[1.0, 0, 0], [-1.0, 0.5, 0], [0, -1.2, 0.3]])
    past = jnp.array([[-0.19, -0.1, 0.14], [0.3, 0.2, -0.4], [0.2, 0, 0.3]])
    rubbing = rigid_bodies(masses, inertias, binary.potential, _friction)
    pushed = rigid_bodies(masses, inertias, binary.potential, forces=_push)
    return {
        "binary": (binary, binary.state(at, velocities=moving, angular_velocities=spins), 0.05),
        "pushed": (pushed, pushed.state(at, velocities=moving, angular_velocities=spins), 0.05),
        "rubbing": (rubbing, rubbing.state(at, velocities=moving, angular_velocities=spins), 0.05),
        "triple": (triple, triple.state(corners, velocities=past, angular_velocities=0.3 * corners), 0.05),
    }


def _friction(r: Array, v: Array, omega_i: Array, omega_j: Array) -> tuple[Array, Array, Array]:
    """A force opposite to the relative motion, and torques opposite to the rotation of each body."""
    u = v - jnp.cross(omega_i + omega_j, r) / 2
    f = -0.02 * u
    tau = -jnp.cross(r, f) / 2
    more = 0.01 * (omega_j - omega_i)
    return f, tau + more, tau - more


def _push(t: Array, x: Array, R: Array, v: Array, omega: Array) -> tuple[Array, Array]:
    """A thrust fixed in the second body, and a torque along the axis of the first that comes and goes."""
    forces = jnp.stack([jnp.zeros(3, x.dtype), 0.02 * R[1, :, 1]])
    return forces, jnp.stack([0.01 * jnp.cos(t) * R[0, :, 2], -0.001 * omega[1]])


def _spread(x: Array, R: Array) -> Array:
    """The squared area of the triangle of three bodies, coupled to their attitudes."""
    a, b = x[1] - x[0], x[2] - x[0]
    c = jnp.cross(a, b)
    tilt = jnp.einsum("i,nij->nj", c, R)
    return 0.5 * jnp.sum(a * a) + 0.3 * jnp.sum(b * b) + 0.1 * jnp.sum(c * c) + 0.05 * jnp.sum(tilt[:, 2] ** 2)
