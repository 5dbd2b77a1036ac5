"""The core types: states, steps, trajectories, groups, phase spaces, systems and their capabilities.

Systems and steps are frozen dataclasses registered as JAX pytrees (`pytree`). Their array fields are leaves, so
derivatives and batches over an inertia tensor go through them; fields marked `static` (functions, options) are part of
the tree's structure, so a step that is built again hits the same jit cache.

A capability is an abstract class below, such as `FreeBody`, that stands for certain equations of motion. A system
declares it by inheritance, and a scheme takes only the systems that declare the capability it integrates.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, Protocol, Self, TypeVar, dataclass_transform, runtime_checkable

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from lieint_jax._checks import at_once, concrete, real_array, step_size
from lieint_jax._xla import compiled
from lieint_jax.types import _labelled
from lieint_jax.types._members import Axis
from lieint_jax.types._record import record

_T = TypeVar("_T")


def static(**options: Any) -> Any:
    """A dataclass field that is part of a pytree's structure, not one of its leaves. Its value must be hashable."""
    return dataclasses.field(metadata={"static": True}, **options)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(dataclasses.field, static))
def pytree(cls: type[_T]) -> type[_T]:
    """Make `cls` a frozen dataclass and a pytree whose leaves are its fields, but for the `static` ones.

    The class is part of the tree's structure. In that of `jax.tree_util.register_dataclass` (jax 0.10) it is not: two
    classes with the same fields compare equal, and jit may then run the program that it compiled for the other one.
    """
    made: Any = dataclasses.dataclass(frozen=True, eq=False)(cls)
    fields = dataclasses.fields(made)
    names = [field.name for field in fields if not field.metadata.get("static")]
    fixed = [field.name for field in fields if field.metadata.get("static")]
    keys = [jax.tree_util.GetAttrKey(name) for name in names]

    def leaves(x: Any) -> tuple[list[Any], tuple[Any, ...]]:
        return [getattr(x, name) for name in names], (made, *[getattr(x, name) for name in fixed])

    def leaves_with_keys(x: Any) -> tuple[list[Any], tuple[Any, ...]]:
        values, structure = leaves(x)
        return list(zip(keys, values, strict=True)), structure

    def rebuilt(structure: tuple[Any, ...], values: Any) -> Any:
        x = object.__new__(made)
        for name, value in (*zip(fixed, structure[1:], strict=True), *zip(names, values, strict=True)):
            object.__setattr__(x, name, value)
        return x

    jax.tree_util.register_pytree_with_keys(made, leaves_with_keys, rebuilt, leaves)
    return made


def callable_pytree(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that can be a field of a pytree: itself if it is one (it may have leaves), else without leaves."""
    return jax.tree_util.Partial(function) if jax.tree_util.all_leaves([function]) else function


@record
class State(NamedTuple):
    """A point of phase space.

    Attributes:
        q: configuration. SO(3): unit quaternion (w, x, y, z), (4,); embedded in L(3): Λ, (3, 3). Matrix groups: (n, n).
            GL⁺(3): F, (3, 3). S²: unit vector, (3,).
        p: momentum. SO(3): spatial angular momentum π, (3,). Matrix groups: π in the dual basis, (d,). GL⁺(3): P,
            (3, 3). S²: π = m q × q̇, (3,).
        t: time, a scalar, of a system that is driven; else it may be None.
        work: what moving potentials and torques have done since the start, a scalar, or None if nobody counts it. The
            energy less the work is conserved.
        extra: arrays by name that a system or a scheme carries along, such as the momentum of a rotor, or None.

    What is None is no leaf of the pytree. Diagnostics that perturb a state leave t, work and extra as they are.
    """

    q: Array
    p: Array
    t: Array | None = None
    work: Array | None = None
    extra: dict[str, Array] | None = None

    def __repr__(self) -> str:
        return _labelled.fields(self)


@record
class StepInfo(NamedTuple):
    """The report of a step on the equation that it solved.

    Attributes:
        residual: norm of the implicit equation's residual, in the scheme's own dimensionless form.
        converged: the residual is round-off (within a multiple of eps·scale that each scheme states, 32 for those that
            solve an equation at each step) and the root lies on the scheme's branch. False wherever a result is not to
            be trusted; a NaN never comes without it.
    """

    residual: Array
    converged: Array

    def __repr__(self) -> str:
        return _labelled.fields(self)

    def merge(self, other: StepInfo) -> StepInfo:
        """The report of both: the larger residual, and whether both converged."""
        return StepInfo(jnp.maximum(self.residual, other.residual), self.converged & other.converged)

    @classmethod
    def fresh(cls, like: Array) -> StepInfo:
        """The report of no step yet, a scalar of the dtype of `like`."""
        return cls(jnp.zeros((), like.dtype), jnp.ones((), bool))


@record
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

    def __repr__(self) -> str:
        return _labelled.trajectory(self)

    def to_xarray(self, system: Any = None, units: Mapping[str, str] | None = None, system_axis: Axis = "auto") -> Any:
        """The trajectory as an `xarray.Dataset`, with the dimensions `time`, and `member` for a batch.

        Its variables are q, p, the other leaves that the states have (those of `extra` as extra_NAME), residual and
        converged. Quaternions have the dimension `quaternion` with labels w, x, y, z, vectors `axis` with x, y, z;
        several bodies have `body`, and `pose` (x, y, z, qw, qx, qy, qz) or `momenta` (px, py, pz, pix, piy, piz).

        Args:
            system: that of the run; adds energy and momentum_map, and angular_velocity (in body axes) where the system
                has one.
            units: by name of a variable or of the coordinate time, such as {"time": "d"}: the package knows none.
            system_axis: of a batch, None if all members have one system, 0 if each has its own, on the leading axis of
                the leaves (`step_axis=0` of `ensemble.run`); "auto" finds it by the shapes where they tell.

        Raises:
            ValueError: units of what is not there; shapes that contradict `system_axis`, or do not tell; a run whose
                axes are (member, time).
            ImportError: xarray is not installed.
        """
        return _labelled.dataset(self, system, units or {}, system_axis)

    def rotations(self) -> Any:
        """The attitudes, body to space, as `scipy.spatial.transform.Rotation` of shape (n+1, …).

        `.as_euler("ZXZ", degrees=True)` gives Euler angles of any sequence: capitals turn about the axes of the body,
        one after the other, small letters about those of space. Of a batch, scipy before 1.17 takes one member:
        `jax.tree.map(lambda x: x[:, k], (run.state, run.info))`.

        Raises:
            ValueError: q holds no quaternions.
        """
        return _labelled.rotations(self)


class Group(Protocol):
    """The questions that every group answers (a module such as `groups.so3`, or an object).

    Algebra elements are coordinate vectors of shape (dim,), their duals likewise; `Ad_star(q, ·)` and `ad_star(ξ, ·)`
    are the transposes of `Ad(q, ·)` and `ad(ξ, ·)`.

    `casimirs(μ)` are functions of μ that no Ad* changes, shape (k,); (0,) if none is known. A group may also be an
    `AnalyticGroup`.
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
    def casimirs(self, mu: Array, /) -> Array: ...
    def defect(self, q: Array, /) -> Array: ...


@runtime_checkable
class AnalyticGroup(Group, Protocol):
    """A group that knows the derivatives and the rounding errors of its maps, see `groups.matrix.MatrixGroup`.

    Steps on it are faster than on a plain `Group`, whose maps are differentiated by autodiff, and say when Ad_q has
    grown so large that no digits of Π = Ad*_q π are left. Vectors and matrices are those of `_numerics.unrolled`: lists
    of scalars if `unrolled`, else arrays. A group has all of these members or counts as a plain one.

    | member | |
    |---|---|
    | `unrolled` | whether vectors are lists of scalars in a step |
    | `exp_near(ξ)`, `near(ξ)` | exp ξ where it is exact, for steps; whether it is exact at ξ |
    | `exp_slope(ξ, terms)`, `exp_coadjoint(ξ, μ)` | H of exp (5.28), by so many terms of its series; Ad*_exp(ξ) μ |
    | `exp_along(q, ξ, s)` | q exp(sξ) for a number s, or at each of several |
    | `cayley_lands` | whether the Cayley map lands in the group |
    | `cayley_both(ξ)`, `cayley_slope(ξ)` | cay ξ and cay(−ξ); H of cay |
    | `coadjoint(q, q⁻¹, μ)` | Ad*_q μ, the inverse being known |
    | `ad_star_matrix(μ)` | the matrix of ξ ↦ ad*_ξ μ |
    | `rounding(q, μ)`, `drift(q)` | a bound of the rounding error of Ad*_q μ over eps; how far q has left the group |
    """

    @property
    def unrolled(self) -> bool: ...
    def exp_near(self, xi: Array, /) -> Array: ...
    def near(self, xi: Array, /) -> Array: ...
    def exp_slope(self, xi: Any, terms: int = ..., /) -> Any: ...
    def exp_coadjoint(self, xi: Any, mu: Any, /) -> Any: ...
    def exp_along(self, q: Array, xi: Array, s: Array, /) -> Array: ...
    @property
    def cayley_lands(self) -> bool: ...
    def cayley_both(self, xi: Any, /) -> Any: ...
    def cayley_slope(self, xi: Any, /) -> Any: ...
    def coadjoint(self, q: Any, inverse: Any, mu: Any, /) -> Any: ...
    def ad_star_matrix(self, mu: Any, /) -> Any: ...
    def rounding(self, q: Array, mu: Array, /) -> Array: ...
    def drift(self, q: Array, /) -> Array: ...


class PhaseSpace(Protocol):
    """A manifold with a symplectic form, in coordinates of its tangent spaces that the diagnostics work in.

    `origin` is some state of it, at rest, from which `perturb` leads to others. `displacement(a, b)` is smooth
    coordinates of b, in which a is 0, and `displaced(a, ·)` is its inverse. A space of coordinates with different units
    has `units(state)`, the sizes (dim/2,) of those of δq and of those of δp; by default 1 and the largest of p.
    """

    @property
    def dim(self) -> int: ...
    @property
    def origin(self) -> State: ...
    def perturb(self, state: State, delta: Array, /) -> State: ...
    def displacement(self, start: State, end: State, /) -> Array: ...
    def displaced(self, start: State, displacement: Array, /) -> State: ...
    def trivialise(self, state: State, tangent: State, /) -> Array: ...
    def omega(self, state: State, /) -> Array: ...
    def defect(self, state: State, /) -> Array: ...


class System(abc.ABC):
    """A Hamiltonian system: what every scheme and every diagnostic may ask of it."""

    @property
    @abc.abstractmethod
    def phase_space(self) -> PhaseSpace:
        """Its phase space, which has the symplectic form."""

    @abc.abstractmethod
    def energy(self, state: State, /) -> Array:
        """H, a scalar."""

    @abc.abstractmethod
    def momentum(self, state: State, /) -> Array:
        """The momentum map of the symmetries that are known, (k,); (0,) if there are none."""

    @abc.abstractmethod
    def vector_field(self, state: State, /) -> State:
        """The time derivative of a state."""

    @abc.abstractmethod
    def check(self, state: State, /) -> None:
        """Raise ValueError if a concrete `state` is not one of this system."""

    @property
    def carried(self) -> dict[str, Array] | None:
        """What the states of this system carry in `extra`, at rest; None if nothing."""
        return None


class FreeBody(System):
    """A rigid body on T*SO(3) that no torque moves: q̇ = ½ q Ω, π̇ = 0 with JΩ = Π = Λᵀπ (2.12).

    Attributes:
        inertia: J, principal moments (3,) or a symmetric tensor (3, 3).
    """

    inertia: Array


class Gyrostat(System):
    """A rigid body with a rotor whose momentum in the body is constant: q̇ = ½ q Ω, π̇ = 0 with JΩ = Π − h_r, Π = Λᵀπ.

    Attributes:
        inertia: J, as in `FreeBody`.
        rotor: h_r in the body, (3,).
    """

    inertia: Array
    rotor: Array

    @property
    @abc.abstractmethod
    def free(self) -> FreeBody:
        """The body of this inertia without a rotor."""


class DrivenGyrostat(System):
    """A gyrostat whose rotor a motor drives, in a given way: as `Gyrostat`, with ḣ_r = τ(t).

    h_r is `State.extra["rotor"]`. Energy less work is conserved, where the work is −∫Ω·τ dt.

    Attributes:
        inertia: J, as in `FreeBody`.
    """

    inertia: Array

    @abc.abstractmethod
    def rotor(self, state: State, /) -> Array:
        """h_r in the body, (3,)."""

    @abc.abstractmethod
    def torque(self, t: Array, /) -> Array:
        """τ, by which the motor turns the rotor at time t, in the body, (3,)."""

    @abc.abstractmethod
    def holding(self, rotor: Array, /) -> Gyrostat:
        """The gyrostat whose rotor keeps the momentum `rotor`."""


class EmbeddedBody(System):
    """A free rigid body whose attitude Λ may leave SO(3), on L(3) × ℝ³: Λ̇ = ΛΩ̂, π̇ = 0 with JΩ = Π = Λ⁻¹π (2.12).

    Attributes:
        inertia: J, as in `FreeBody`.
    """

    inertia: Array


class GeodesicFlow(System):
    """The motion on T*G by a left-invariant metric alone: q̇ = qΩ̂, π̇ = 0 with mΩ = Π = Ad*_q π (5.14).

    Attributes:
        group: the group G.
        metric: m, principal (d,) or full (d, d).
    """

    group: Group
    metric: Array


class RightGeodesicFlow(System):
    """The motion on T*G by a right-invariant metric alone: q̇ = ω̂q, π̇ = −ad*_ω π with mω = π (end of Section 5.1.7).

    The inverse of q moves by the left-invariant metric m, with body momentum −π and spatial momentum −Π.

    Attributes:
        group: the group G.
        metric: m, as in `GeodesicFlow`.
    """

    group: Group
    metric: Array


class Forced(System):
    """A system with a kinetic energy and a force that depends on the configuration: the kick of a splitting."""

    @property
    @abc.abstractmethod
    def free(self) -> System:
        """This system without its force."""

    @abc.abstractmethod
    def force(self, q: Array, /) -> Array:
        """By how much π̇ at the configuration q differs from π̇ of the free system; of the shape of π."""


class FreeBodies(System):
    """N rigid bodies on which nothing acts: ẋ = p/m, q̇ = ½ q Ω, ṗ = 0, π̇ = 0.

    A state is q (N, 7), position and quaternion of each, and p (N, 6), linear and spatial angular momentum.

    Attributes:
        masses: (N,).
        inertias: J, principal moments (N, 3) or tensors (N, 3, 3).
    """

    masses: Array
    inertias: Array

    @abc.abstractmethod
    def one(self, inertia: Array) -> FreeBody:
        """A free body of this inertia."""


class Bodies(Forced):
    """N rigid bodies in a potential: as `FreeBodies`, with forces and torques.

    Attributes:
        masses, inertias: as in `FreeBodies`.
        potential: (positions (N, 3), rotations (N, 3, 3)) ↦ V.
    """

    masses: Array
    inertias: Array
    potential: Callable[[Array, Array], Array]


class Top(Forced):
    """A rigid body in a potential Ṽ(Γ) of an axis, Γ = Λᵀγ: q̇ = ½ q Ω, π̇ = γ × Λ∇Ṽ(Γ) (4.2).

    Attributes:
        inertia: J, as in `FreeBody`.
        potential: Ṽ; a function of Λ, (3, 3), if there is no axis.
        axis: γ in space, (3,), or None.
    """

    inertia: Array
    potential: Callable[[Array], Array]
    axis: Array | None


class SteepPotential(abc.ABC):
    """A potential Ṽ(Γ) or Ṽ(Γ, t) that knows its gradient, for tops, where autodiff takes many more operations."""

    @abc.abstractmethod
    def __call__(self, Gamma: Array, t: Array | None = None) -> Array: ...

    @abc.abstractmethod
    def gradient(self, Gamma: Array, t: Array | None = None) -> Array:
        """∇Ṽ, shape (3,)."""


def gradient(potential: Callable[..., Array], Gamma: Array, *t: Array) -> Array:
    """∇Ṽ(Γ) or ∇Ṽ(Γ, t), shape (3,), of any potential of tops."""
    known = isinstance(potential, SteepPotential)
    return potential.gradient(Gamma, *t) if known else autodiff_gradient(potential)(Gamma, *t)


def autodiff_gradient(potential: Callable[..., Array], argnums: int | tuple[int, ...] = 0) -> Callable[..., Any]:
    """`jax.grad(potential, argnums)`, but NaN where the potential itself is not finite.

    The derivative of log x exists for x < 0, where log x does not: a step would go on where there is no motion.
    """

    def gradient(*arguments: Any) -> Any:
        V, slopes = jax.value_and_grad(potential, argnums)(*arguments)
        defined = jnp.isfinite(V)
        return jax.tree.map(lambda slope: jnp.where(defined, slope, jnp.nan), slopes)

    return gradient


class MechanicalSystem(Forced):
    """A left-invariant metric and a potential V(q) on T*G: q̇ = qΩ̂, π̇ = −T*R dV(q) with mΩ = Ad*_q π (5.41).

    Attributes:
        group: the group G.
        metric: m, as in `GeodesicFlow`.
        potential: V.
    """

    group: Group
    metric: Array
    potential: Callable[[Array], Array]

    @abc.abstractmethod
    def body_force(self, q: Array, /) -> Array:
        """Ad*_q of `force`: its i-th component is −d/dε V(q exp(εeᵢ))."""


class StoredEnergy(abc.ABC):
    """W(C), an energy, of the right Cauchy–Green tensor C = FᵀF, shape (3, 3).

    Symmetric tensors are tuples of six entries (xx, yy, zz, yz, xz, xy), see `_numerics.three`.
    """

    @abc.abstractmethod
    def __call__(self, C: Array) -> Array: ...

    @abc.abstractmethod
    def stress(self, C: tuple[Array, ...]) -> tuple[Array, ...]:
        """S = 2∇W(C)."""

    @abc.abstractmethod
    def mean_stress(self, C: tuple[Array, ...], D: tuple[Array, ...]) -> tuple[Array, ...]:
        """S̄ with ½ S̄:D = W(C + D) − W(C)."""


class ElasticBody(System):
    """A body that deforms homogeneously, on T*GL⁺(3): Ḟ = PE⁻¹, Ṗ = −2F∇W(FᵀF) (6.3).

    Attributes:
        inertia: E, the second moments of mass, (3,) or (3, 3).
        stored_energy: W.
    """

    inertia: Array
    stored_energy: StoredEnergy


class IncompressibleBody(System):
    """A body that deforms homogeneously at constant volume, on T*SL(3): Ḟ = PE⁻¹, Ṗ = −2F∇W(FᵀF) + p F⁻ᵀ, det F = 1.

    The pressure p is such that tr(ḞF⁻¹) = 0. A state is (F, P) as in `ElasticBody`, with tr(PE⁻¹F⁻¹) = 0.

    Attributes:
        inertia: E, as in `ElasticBody`.
        stored_energy: W.
    """

    inertia: Array
    stored_energy: StoredEnergy


class Driven(System):
    """A kinetic energy and a potential V(q, t) that is a given function of time.

    Energy less work is conserved, where the work is ∫∂V/∂t dt.
    """

    @property
    @abc.abstractmethod
    def free(self) -> System:
        """This system without its potential."""

    @abc.abstractmethod
    def force(self, q: Array, t: Array, /) -> Array:
        """By how much π̇ at the configuration q and the time t differs from π̇ of the free system."""

    @abc.abstractmethod
    def power(self, q: Array, t: Array, /) -> Array:
        """∂V/∂t, a scalar."""


class DrivenTop(Driven):
    """A rigid body in a potential Ṽ(Γ, t) of an axis that may move: (4.2) with Γ = Λᵀγ(t).

    Attributes:
        inertia: J, as in `FreeBody`.
        potential: Ṽ, a function of Γ and t; of Λ, (3, 3), and t, if there is no axis.
        axis: γ, a function of time with values (3,) in space, a constant (3,), or None.
    """

    inertia: Array
    potential: Any
    axis: Any

    @abc.abstractmethod
    def axis_at(self, t: Array, /) -> Array:
        """γ(t), shape (3,)."""


class TorquedBody(System):
    """A rigid body on T*SO(3) with a torque: q̇ = ½ q Ω, π̇ = τ if it is given in space, π̇ = Λτ if in the body.

    A torque is a function (t, q, ω) ↦ τ, (3,), of time, the unit quaternion of the attitude, and the angular velocity
    in the axes of the torque. A pytree may offer more:

    | member | |
    |---|---|
    | `frame` | the axes of the torque, "body" or "space" |
    | `potential(q)` | U, counted in the energy; then τ contains the torque −∂U |
    | `power(t, q, omega)` | the power of all but −∂U, such as −c\\|ω\\|² |
    | `mean(t, q_n, q_next, h, kappa, omega)` | the torque of a step, if not τ at its half; h = ½Θ, κ, ω̄ of the step |
    | `during(dt, extra)` | the torque as it acts in a step of size dt (0: at one time) on a state with this `extra` |
    | `key`, `inner(omega)`, `inner_energy(momentum)` | a momentum in space, `extra[key]`, that the torque comes from |

    With `key`, d/dt extra[key] = −τ in space. `inner(ω)` is its value where all turns with ω; its `inner_energy` is
    counted in the energy. Such a law needs no `__call__`: `during(0, extra)` is the torque at one time.

    Attributes:
        inertia: J, as in `FreeBody`.
        torque: τ.
        frame: the axes of τ and ω.
    """

    inertia: Array
    torque: Callable[..., Array]
    frame: str

    def law(self, dt: ArrayLike, extra: dict[str, Array] | None) -> Callable[..., Array]:
        """The torque as it acts in a step of size dt."""
        during = getattr(self.torque, "during", None)
        return self.torque if during is None else during(dt, extra)


class DampedBody(System):
    """A rigid body on T*SO(3) with internal friction: q̇ = ½ q (Ω + α Π × Ω), π̇ = 0 with JΩ = Π = Λᵀπ.

    Attributes:
        inertia: J, as in `FreeBody`.
        friction: α, an inverse angular momentum.
    """

    inertia: Array
    friction: Array


class OnSphere(System):
    """A particle on the unit sphere, on T*S²: q̇ = π × q/m, π̇ = −q × ∇V(q) (1.4).

    Attributes:
        mass: m.
    """

    mass: Array

    @abc.abstractmethod
    def potential(self, q: Array, /) -> Array:
        """V(q), smooth around the sphere too."""


def _in_one_type(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method (step, state, dt, …) whose arguments arrive in one floating-point type."""

    @functools.wraps(method)
    def converted(step: Any, state: State, dt: ArrayLike, *more: ArrayLike) -> Any:
        step, state, dtype = promoted(step, state)
        return method(step, state, jnp.asarray(step_size(dt), dtype), *(jnp.asarray(x, dtype) for x in more))

    return converted


def _on_time(method: Callable[..., tuple[Any, ...]]) -> Callable[..., tuple[Any, ...]]:
    """A method (step, state, dt, …) whose new state is at t + dt and has all other parts of the state."""

    @functools.wraps(method)
    def timed(step: Any, state: State, dt: Array, *more: Array) -> tuple[Any, ...]:
        if step.own_time and state.t is None:
            raise ValueError(f"{step.name} advances the time, which this state lacks: take step.start(state)")
        end, *report = method(step, state, dt, *more)
        for name in ("work", "extra"):
            if getattr(state, name) is not None and getattr(end, name) is None:
                raise ValueError(f"{type(step).__name__} drops state.{name}: return state._replace(q=…, p=…) from it")
        t = end.t if step.own_time or state.t is None else state.t + dt
        return end._replace(t=t), *report

    return timed


def _finite_or_flagged(method: Callable[..., tuple[Any, ...]]) -> Callable[..., tuple[Any, ...]]:
    """A method (step, state, dt, …) that reports `converged` only of a state that is finite."""

    @functools.wraps(method)
    def flagged(*arguments: Any) -> tuple[Any, ...]:
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

    def __init_subclass__(cls, **options: Any) -> None:
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
    def own_time(self) -> bool:
        """Whether the step itself advances `state.t`, which must be there; then dt is a step of a fictitious time."""
        return False

    @property
    def approximate(self) -> bool:
        """Whether fewer iterations were asked for than convergence takes: a run reports the residual, and goes on."""
        return False

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

        def moved(delta: Array) -> tuple[State, tuple[State, StepInfo]]:
            end, info = self(space.perturb(state, delta), dt)
            return end, (end, info)

        _, push, (end, info) = jax.linearize(moved, jnp.zeros(space.dim, state.p.dtype), has_aux=True)
        return end, info, jax.vmap(lambda delta: space.trivialise(end, push(delta)), -1, -1)(jnp.asarray(T))

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


def checked_step(step: Any) -> Step:
    """`step`; ValueError if it is none, which says how to make one."""
    if isinstance(step, Step):
        return step
    raise ValueError(
        f"step must be a Step, such as schemes.so3_midpoint(system) makes, got {step!r}. To make one of your own: a "
        "class that inherits li.Step, decorated with @li.pytree, with the fields system, order and symmetric "
        "(li.static() for what is no array), a property name, and __call__(state, dt) -> (State, StepInfo)"
    )


def promoted(step: _T, state: State) -> tuple[_T, State, Any]:
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
    found: dict[str, Any] = {name: real_array(f"state.{name}", x, finite=False) for name, x in given.items()}
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
    return step, State(**jax.tree.map(lambda leaf: leaf.astype(dtype), found)), dtype


def start_time(step: Step, state: State) -> Array | None:
    """The t₀ from which the times t₀ + nΔt of a run follow; None where there is none, or the step has its own time."""
    return None if step.own_time else state.t


def on_clock(state: State, t0: Array | None, n: ArrayLike, dt: ArrayLike) -> State:
    """`state` at the time t₀ + nΔt, if there is a t₀: the rounding errors of a sum of n steps would add up."""
    return state if t0 is None else state._replace(t=t0 + n * dt)


def time_derivative(system: System, state: State) -> State:
    """The time derivative of all that a state holds: t is time itself, and what the system does not move rests."""
    moving, rest = system.vector_field(state), jax.tree.map(jnp.zeros_like, state)
    moved = {name: x for name, x in moving._asdict().items() if x is not None and getattr(state, name) is not None}
    return rest._replace(**moved | ({} if state.t is None else {"t": jnp.ones_like(state.t)}))


def all_finite(tree: Any) -> Array:
    """Whether all arrays of a tree are finite, a scalar."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(tree)]))


def energy_less_work(system: System, state: State) -> Array:
    """H − W, a scalar, which is conserved: W is `state.work`, 0 if it is not counted."""
    energy = system.energy(state)
    return energy if state.work is None else energy - state.work


def clock(state: State) -> Array:
    """The time of a state; ValueError if it has none."""
    if state.t is None:
        raise ValueError(
            "the system is driven, so its state needs the time: make it with system.state(..., t=0.0), or give it one "
            "with state._replace(t=0.0)"
        )
    return state.t


def _is_real(leaf: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(leaf), jnp.floating)


@partial(compiled, once=True)
def converges(step: Step, state: State, dt: ArrayLike) -> Array:
    """Whether a step converges. Compiled, so that a step of the same structure is checked without tracing it again."""
    return step(state, dt)[1].converged
