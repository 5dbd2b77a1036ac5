"""Capabilities: abstract systems, each with the equations of motion that its subclasses promise to have.

A system declares a capability by inheritance, and a scheme accepts the systems that declare the one it integrates.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._deprecated import renamed_attribute
from lieint_jax.types._group import Group
from lieint_jax.types._state import State
from lieint_jax.types._system import System
from lieint_jax.types._torque import Law, parts
from lieint_jax.types.shapes import DualVector, Inertia, Matrix3, PyTree, Scalar, SquareMatrix, Time, Vector3
from lieint_jax.types.vectors import Symmetric


class AbstractFreeBody(System):
    """A torque-free rigid body on T*SO(3): q̇ = ½ q Ω, π̇ = 0 with JΩ = Π = Λᵀπ (2.12).

    Attributes:
        inertia: J, principal moments (3,) or a symmetric tensor (3, 3).
    """

    inertia: Array


class AbstractGyrostat(System):
    """A rigid body with a rotor whose momentum in the body is constant: q̇ = ½ q Ω, π̇ = 0 with JΩ = Π − h_r, Π = Λᵀπ.

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
        rotor: h_r in the body, (3,).
    """

    inertia: Array
    rotor: Array

    @property
    @abc.abstractmethod
    def free(self) -> AbstractFreeBody:
        """The body of this inertia without a rotor."""


class AbstractDrivenGyrostat(System):
    """A gyrostat whose rotor is driven by a motor of given torque: as `AbstractGyrostat`, with ḣ_r = τ(t).

    h_r is `State.extra["rotor"]`. H − W is conserved, with the work W = −∫Ω·τ dt of the motor.

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
    """

    inertia: Array

    @abc.abstractmethod
    def rotor(self, state: State, /) -> Vector3:
        """h_r in the body, (3,)."""

    @abc.abstractmethod
    def torque(self, t: Time, /) -> Vector3:
        """τ, the torque of the motor on the rotor at time t, in the body, (3,)."""

    @abc.abstractmethod
    def with_rotor(self, rotor: Vector3, /) -> AbstractGyrostat:
        """The gyrostat whose rotor has the constant momentum `rotor`, (3,)."""

    holding = renamed_attribute("holding", "with_rotor")


class AbstractEmbeddedBody(System):
    """A free rigid body whose attitude Λ may leave SO(3), on L(3) × ℝ³: Λ̇ = ΛΩ̂, π̇ = 0 with JΩ = Π = Λ⁻¹π (2.12).

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
    """

    inertia: Array


class AbstractGeodesicFlow(System):
    """Geodesics of a left-invariant metric on T*G, without potential: q̇ = qΩ̂, π̇ = 0 with mΩ = Π = Ad*_q π (5.14).

    Attributes:
        group: the group G.
        metric: m, principal (d,) or full (d, d).
    """

    group: Group
    metric: Array


class AbstractRightGeodesicFlow(System):
    """Geodesics of a right-invariant metric on T*G, without potential: q̇ = ω̂q, π̇ = −ad*_ω π with mω = π.

    q⁻¹ moves by the left-invariant metric m, with body momentum −π and spatial momentum −Π (end of Section 5.1.7).

    Attributes:
        group: the group G.
        metric: m, as in `AbstractGeodesicFlow`.
    """

    group: Group
    metric: Array


class AbstractForcedSystem(System):
    """A system with a kinetic energy and a force that depends on the configuration: the kick of a splitting."""

    @property
    @abc.abstractmethod
    def free(self) -> System:
        """This system without its force."""

    @abc.abstractmethod
    def force(self, q: Array, /) -> Array:
        """π̇ at the configuration q less π̇ of the free system, an array of the shape of π."""


class AbstractFreeBodies(System):
    """N free rigid bodies: ẋ = p/m, q̇ = ½ q Ω, ṗ = 0, π̇ = 0.

    A state is q (N, 7), position and quaternion of each, and p (N, 6), linear and spatial angular momentum.

    Attributes:
        masses: (N,).
        inertias: J, principal moments (N, 3) or tensors (N, 3, 3).
    """

    masses: Array
    inertias: Array

    @abc.abstractmethod
    def single_body(self, inertia: Inertia) -> AbstractFreeBody:
        """A free body of this inertia."""


class AbstractRigidBodies(AbstractForcedSystem):
    """N rigid bodies in a potential: as `AbstractFreeBodies`, with forces and torques.

    Attributes:
        masses, inertias: as in `AbstractFreeBodies`.
        potential: (positions (N, 3), rotations (N, 3, 3)) ↦ V.
    """

    masses: Array
    inertias: Array
    potential: Callable[[Array, Array], Array]


class AbstractDissipativeBodies(System):
    """N rigid bodies in a potential, with dissipative forces between pairs: as `AbstractRigidBodies`, plus these
    forces.

    H − W is conserved, with W the work of the dissipative forces, and so are both momenta if the potential is
    invariant.

    Attributes:
        masses, inertias, potential: as in `AbstractRigidBodies`.
        dissipation: a `PairLaw`, or a function (r, v, ω_i, ω_j) ↦ (f, τ_i, τ_j).
    """

    masses: Array
    inertias: Array
    potential: Callable[[Array, Array], Array]
    dissipation: Callable[..., Any]

    @property
    @abc.abstractmethod
    def conservative(self) -> AbstractRigidBodies:
        """The same bodies without the law."""


class AbstractTop(AbstractForcedSystem):
    """A rigid body in a potential Ṽ(Γ) of an axis, Γ = Λᵀγ: q̇ = ½ q Ω, π̇ = γ × Λ∇Ṽ(Γ) (4.2).

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
        potential: Ṽ; a function of Λ, (3, 3), if there is no axis.
        axis: γ in space, (3,), or None.
    """

    inertia: Array
    potential: Callable[[Array], Array]
    axis: Array | None


class PotentialWithGradient(abc.ABC):
    """A potential Ṽ(Γ) or Ṽ(Γ, t) of tops with its gradient in closed form, which costs far less than autodiff."""

    @abc.abstractmethod
    def __call__(self, Gamma: Vector3, t: Time | None = None) -> Scalar: ...

    @abc.abstractmethod
    def gradient(self, Gamma: Vector3, t: Time | None = None) -> Vector3:
        """∇Ṽ, shape (3,)."""


def gradient(potential: Callable[..., Array], Gamma: Vector3, *t: Array) -> Array:
    """∇Ṽ(Γ) or ∇Ṽ(Γ, t), shape (3,), of any potential of tops."""
    known = isinstance(potential, PotentialWithGradient)
    return potential.gradient(Gamma, *t) if known else autodiff_gradient(potential)(Gamma, *t)


def autodiff_gradient(potential: Callable[..., Array], argnums: int | tuple[int, ...] = 0) -> Callable[..., PyTree]:
    """`jax.grad(potential, argnums)`, but NaN where the potential itself is not finite.

    The derivative of log x is finite for x < 0, where log x is NaN: a step would continue where there is no motion.
    """

    def gradient(*arguments: Array) -> PyTree:
        V, slopes = jax.value_and_grad(potential, argnums)(*arguments)
        defined = jnp.isfinite(V)
        return jax.tree.map(lambda slope: jnp.where(defined, slope, jnp.nan), slopes)

    return gradient


class AbstractMechanicalSystem(AbstractForcedSystem):
    """A left-invariant metric and a potential V(q) on T*G: q̇ = qΩ̂, π̇ = −T*R dV(q) with mΩ = Ad*_q π (5.41).

    Attributes:
        group: the group G.
        metric: m, as in `AbstractGeodesicFlow`.
        potential: V.
    """

    group: Group
    metric: Array
    potential: Callable[[Array], Array]

    @abc.abstractmethod
    def body_force(self, q: SquareMatrix, /) -> DualVector:
        """Ad*_q of `force`: its i-th component is −d/dε V(q exp(εeᵢ))."""


class StoredEnergy(abc.ABC):
    """W(C), an energy, of the right Cauchy–Green tensor C = FᵀF, shape (3, 3).

    Symmetric tensors are tuples of six entries (xx, yy, zz, yz, xz, xy) with operators, see `types.vectors`.
    """

    @abc.abstractmethod
    def __call__(self, C: Matrix3) -> Scalar: ...

    @abc.abstractmethod
    def stress(self, C: Symmetric) -> tuple[Array, ...]:
        """S = 2∇W(C)."""

    @abc.abstractmethod
    def mean_stress(self, C: Symmetric, D: Symmetric) -> tuple[Array, ...]:
        """S̄ with ½ S̄:D = W(C + D) − W(C)."""


class AbstractElasticBody(System):
    """A body that deforms homogeneously, on T*GL⁺(3): Ḟ = PE⁻¹, Ṗ = −2F∇W(FᵀF) (6.3).

    Attributes:
        inertia: E, the second moments of mass, (3,) or (3, 3).
        stored_energy: W.
    """

    inertia: Array
    stored_energy: StoredEnergy


class AbstractViscousBody(System):
    """A viscous body that deforms homogeneously: as `AbstractElasticBody`, with Ṗ = −F(2∇W(C) + νĊ), C = FᵀF.

    H − W is conserved, with the work W = −∫½ν|Ċ|² dt of the viscous stress.

    Attributes:
        inertia, stored_energy: as in `AbstractElasticBody`.
        viscosity: ν ≥ 0, an energy times a time.
    """

    inertia: Array
    stored_energy: StoredEnergy
    viscosity: Array


class AbstractIncompressibleBody(System):
    """A body that deforms homogeneously at constant volume, on T*SL(3): Ḟ = PE⁻¹, Ṗ = −2F∇W(FᵀF) + p F⁻ᵀ, det F = 1.

    The pressure p is such that tr(ḞF⁻¹) = 0. A state is (F, P) as in `AbstractElasticBody`, with tr(PE⁻¹F⁻¹) = 0.

    Attributes:
        inertia: E, as in `AbstractElasticBody`.
        stored_energy: W.
    """

    inertia: Array
    stored_energy: StoredEnergy


class AbstractDrivenSystem(System):
    """A kinetic energy and a potential V(q, t) that depends on time in a given way.

    H − W is conserved, with the work W = ∫∂V/∂t dt.
    """

    @property
    @abc.abstractmethod
    def free(self) -> System:
        """This system without its potential."""

    @abc.abstractmethod
    def force(self, q: Array, t: Time, /) -> Array:
        """π̇ at the configuration q and the time t less π̇ of the free system, an array of the shape of π."""

    @abc.abstractmethod
    def power(self, q: Array, t: Time, /) -> Scalar:
        """∂V/∂t, a scalar."""


class AbstractDrivenTop(AbstractDrivenSystem):
    """A rigid body in a potential Ṽ(Γ, t) of an axis that may move: (4.2) with Γ = Λᵀγ(t).

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
        potential: Ṽ, a function of Γ and t; of Λ, (3, 3), and t, if there is no axis.
        axis: γ, a function of time with values (3,) in space, a constant (3,), or None.
    """

    inertia: Array
    potential: Any
    axis: Any

    @abc.abstractmethod
    def axis_at(self, t: Time, /) -> Vector3:
        """γ(t), shape (3,)."""


class AbstractTorquedBody(System):
    """A rigid body on T*SO(3) with laws of torque: q̇ = ½ q Ω, π̇ = Σ τ_k, with JΩ = Π = Λᵀπ.

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
        torque: a law of torque, or the `Total` of several laws.
    """

    inertia: Array
    torque: Law

    @property
    def laws(self) -> tuple[Law, ...]:
        """The laws one by one, in the order of `State.extra["works"]`."""
        return parts(self.torque)


class AbstractDampedBody(System):
    """A rigid body on T*SO(3) with internal friction: q̇ = ½ q (Ω + α Π × Ω), π̇ = 0 with JΩ = Π = Λᵀπ.

    Attributes:
        inertia: J, as in `AbstractFreeBody`.
        friction: α, an inverse angular momentum.
    """

    inertia: Array
    friction: Array


class AbstractSphereSystem(System):
    """A particle on the unit sphere, on T*S²: q̇ = π × q/m, π̇ = −q × ∇V(q) (1.4).

    Attributes:
        mass: m.
    """

    mass: Array

    @abc.abstractmethod
    def potential(self, q: Vector3, /) -> Scalar:
        """V(q), smooth around the sphere too."""
