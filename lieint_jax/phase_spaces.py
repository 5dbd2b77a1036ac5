"""Phase spaces: perturbed states, coordinates of tangent vectors, and the symplectic form."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import DualVector, Matrix3, PhaseMatrix, PhaseVector, Scalar, Vector3
from lieint_jax._xla import materialized
from lieint_jax.core import Group, State, pytree, static
from lieint_jax.groups import MatrixGroup, so3

__all__ = [
    "ConfigurationGroup", "CotangentGroup", "CotangentMatrices", "CotangentMotions", "CotangentSphere",
    "CotangentUnimodular", "EmbeddedRotations", "SphericalChart", "frame",
]  # fmt: skip


class _ByPerturbation:
    """A phase space in which a displacement is the δ of `perturb`."""

    def displaced(self, start: State, displacement: Array) -> State:
        """The end of a displacement."""
        return self.perturb(start, displacement)  # pyright: ignore[reportAttributeAccessIssue]


class _ByEntries:
    """A phase space in which a displacement is the differences of all entries of q and p."""

    def displacement(self, start: State, end: State) -> Array:
        """The differences of all entries, shape (n,)."""
        return jnp.concatenate([(end.q - start.q).ravel(), (end.p - start.p).ravel()])

    def displaced(self, start: State, displacement: Array) -> State:
        """The end of a displacement."""
        n = start.q.size
        q = start.q + displacement[:n].reshape(start.q.shape)
        return start._replace(q=q, p=start.p + displacement[n:].reshape(start.p.shape))


@pytree
class CotangentGroup(_ByPerturbation):
    """T*G in the spatial (right) trivialization: a state is (q, π), a tangent vector (δθ, δπ) ∈ 𝔤 × 𝔤*.

    δq = δθ q, so on SO(3) δΛ = δθ̂Λ as in (2.8); δπ is the plain variation of the spatial momentum.
    """

    group: Group = static()

    @property
    def dim(self) -> int:
        """Dimension of the phase space, 2 dim G."""
        return 2 * self.group.dim

    @property
    def origin(self) -> State:
        """The identity, at rest."""
        return State(jnp.asarray(self.group.identity, float), jnp.zeros(self.group.dim))

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """The state displaced by δ = (δθ, δπ), shape (2d,): (exp(δθ) q, π + δπ)."""
        d = self.group.dim
        q = self.group.multiply(self.group.exp(delta[:d]), state.q)
        q = jnp.stack(materialized(q.ravel())).reshape(q.shape)  # a step from here would compute it again and again
        return state._replace(q=q, p=state.p + delta[d:])

    def tangent(self, state: State, delta: PhaseVector) -> tuple[Array, Array]:
        """(δq, δπ) in the coordinates of `State`, δq = δθ q."""
        d = self.group.dim
        return self.group.spatial_tangent(state.q, delta[:d]), delta[d:]

    def displacement(self, start: State, end: State) -> PhaseVector:
        """The δ, shape (2d,), with perturb(start, δ) = end, of the least δθ."""
        turn = self.group.log(self.group.multiply(end.q, self.group.inverse(start.q)))
        return jnp.concatenate([turn, end.p - start.p])

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """(δθ, δπ), shape (2d,), of a tangent vector given in the coordinates of `State`."""
        return jnp.concatenate([self.group.spatial_velocity(state.q, tangent.q), tangent.p])

    def omega(self, state: State) -> PhaseMatrix:
        """The symplectic form as a matrix [[α, 1], [−1, 0]], shape (2d, 2d), αξ = ad*_ξ π: (2.9), (5.9)."""
        d = self.group.dim
        one, zero = jnp.eye(d, dtype=state.p.dtype), jnp.zeros((d, d), state.p.dtype)
        alpha = jax.vmap(self.group.ad_star, in_axes=(1, None), out_axes=1)(one, state.p)
        return jnp.block([[alpha, one], [-one, zero]])

    def defect(self, state: State) -> Scalar:
        """The distance of q from the group: |q|² − 1 for unit quaternions."""
        return self.group.defect(state.q)


@pytree
class ConfigurationGroup(_ByPerturbation):
    """A Lie group G itself, without momenta: a state is q, with p of shape (0,), a tangent vector δθ with δq = δθ q.

    It has no symplectic form.
    """

    group: Group = static()

    @property
    def dim(self) -> int:
        """Dimension of the group."""
        return self.group.dim

    @property
    def origin(self) -> State:
        """The identity."""
        return State(jnp.asarray(self.group.identity, float), jnp.zeros(0))

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """The state displaced by δθ, shape (d,): exp(δθ) q."""
        return state._replace(q=self.group.multiply(self.group.exp(delta), state.q))

    def tangent(self, state: State, delta: PhaseVector) -> tuple[Array, Array]:
        """δq = δθ q, and no δp."""
        return self.group.spatial_tangent(state.q, delta), jnp.zeros_like(state.p)

    def displacement(self, start: State, end: State) -> PhaseVector:
        """The least δθ, shape (d,), with perturb(start, δθ) = end."""
        return self.group.log(self.group.multiply(end.q, self.group.inverse(start.q)))

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """δθ, shape (d,), of a tangent vector δq."""
        return self.group.spatial_velocity(state.q, tangent.q)

    def omega(self, state: State) -> PhaseMatrix:
        """Raises ValueError: there is no form."""
        raise ValueError("a motion with given rates has neither momenta nor a symplectic form")

    def defect(self, state: State) -> Scalar:
        """The distance of q from the group: |q|² − 1 for unit quaternions."""
        return self.group.defect(state.q)


@pytree
class EmbeddedRotations(_ByEntries):
    """L(3) × ℝ³ around T*SO(3): a state is (Λ, π), Λ of shape (3, 3); a tangent vector is (δθ, δπ) as on T*SO(3).

    L(3) × ℝ³ has no symplectic form. So tangent vectors are projected to those of T*SO(3), and the form is (2.9). What
    the diagnostics report of the form is valid at states with Λ on SO(3). `defect` measures how far Λ has left SO(3).
    """

    @property
    def dim(self) -> int:
        """Dimension of T*SO(3), 6."""
        return 6

    @property
    def origin(self) -> State:
        """Λ = 1, at rest."""
        return State(jnp.eye(3), jnp.zeros(3))

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """The state displaced by δ = (δθ, δπ), shape (6,): (exp(δθ̂) Λ, π + δπ)."""
        turn = so3.exp(delta[:3])
        turned = jax.vmap(lambda column: so3.Ad(turn, column), 1, 1)(state.q)
        return state._replace(q=turned, p=state.p + delta[3:])

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """(δθ, δπ), shape (6,), of a tangent vector (δΛ, δπ): δθ = rot[δΛ Λ⁻¹], without the other components of δΛ."""
        transposed = vectors.matrix(state.q).T
        velocity = vectors.Matrix(transposed.solve(row) for row in tangent.q)  # δΛ Λ⁻¹
        return jnp.concatenate([so3.vee(velocity.array), tangent.p])

    def omega(self, state: State) -> PhaseMatrix:
        """[[π̂, 1], [−1, 0]], shape (6, 6) (2.9)."""
        return CotangentGroup(so3).omega(state)

    def defect(self, state: State) -> Scalar:
        """max|ΛᵀΛ − 1|."""
        C = vectors.matrix(state.q).gram()
        return jnp.max(jnp.abs(jnp.stack(C) - jnp.array([1, 1, 1, 0, 0, 0], state.q.dtype)))


@pytree
class CotangentMatrices(_ByEntries):
    """T*GL⁺(3) = GL⁺(3) × L(3), canonical: a state is (F, P), a tangent vector (δF, δP), row by row (6.1)."""

    @property
    def dim(self) -> int:
        """Dimension of the phase space, 18."""
        return 18

    @property
    def origin(self) -> State:
        """F = 1, at rest."""
        return State(jnp.eye(3), jnp.zeros((3, 3)))

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """(F + δF, P + δP) for δ = (δF, δP), shape (18,)."""
        return state._replace(q=state.q + delta[:9].reshape(3, 3), p=state.p + delta[9:].reshape(3, 3))

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """(δF, δP), shape (18,)."""
        return jnp.concatenate([tangent.q.ravel(), tangent.p.ravel()])

    def omega(self, state: State) -> PhaseMatrix:
        """[[0, 1], [−1, 0]], shape (18, 18): ω(δ₁, δ₂) = ⟨δP₂, δF₁⟩ − ⟨δP₁, δF₂⟩ (6.1)."""
        one = jnp.eye(9, dtype=state.p.dtype)
        return jnp.block([[0 * one, one], [-one, 0 * one]])

    def defect(self, state: State) -> Scalar:
        """0 where det F > 0, 1 where F has left GL⁺(3) (an open set, from which no distance is defined)."""
        return jnp.where(vectors.matrix(state.q).det() > 0, 0, 1).astype(state.q.dtype)


@pytree
class CotangentUnimodular(_ByPerturbation):
    """T*SL(3) as pairs (F, P) with det F = 1 and tr(PE⁻¹F⁻¹) = 0, the velocities PE⁻¹ being those of constant volume.

    Its coordinates are those of `CotangentGroup(SL(3))`: δF = δθ̂F, and δπ of π_i = ⟨P, e_i F⟩ for a basis e_i of
    sl(3).

    Attributes:
        inertia: E, (3,) or (3, 3).
        group: SL(3), of dimension 8, as a `groups.matrix.MatrixGroup`.
    """

    inertia: Array
    group: MatrixGroup = static()

    @property
    def dim(self) -> int:
        """Dimension of the phase space, 16."""
        return 16

    @property
    def origin(self) -> State:
        """F = 1, at rest."""
        return State(jnp.eye(3), jnp.zeros((3, 3)))

    def spatial_momentum(self, state: State) -> DualVector:
        """π_i = ⟨P, e_i F⟩, shape (8,)."""
        return jnp.tensordot(self._basis(state), state.p @ state.q.T, 2)

    def tangential(self, q: Matrix3, pi: DualVector) -> Matrix3:
        """The P = ωFE, (3, 3), with ω in sl(3) and spatial momentum π at F."""
        E = jnp.diag(self.inertia) if self.inertia.ndim == 1 else self.inertia
        e = jnp.asarray(self.group.basis, q.dtype)
        carried = jnp.einsum("iab,bc->iac", e, q @ E @ q.T)
        M = jnp.einsum("iab,jab->ij", carried, e)
        return jnp.tensordot(jnp.linalg.solve(M, pi), e, 1) @ q @ E

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """The state displaced by δ = (δθ, δπ), shape (16,): (exp(δθ̂)F, P); the normal part of P is unchanged."""
        pi, q = self.spatial_momentum(state), self.group.multiply(self.group.exp(delta[:8]), state.q)
        rest = state.p - self.tangential(state.q, pi)
        return state._replace(q=q, p=self.tangential(q, pi + delta[8:]) + rest)

    def displacement(self, start: State, end: State) -> PhaseVector:
        """The δ, shape (16,), with perturb(start, δ) = end, of the least δθ."""
        turn = self.group.log(self.group.multiply(end.q, self.group.inverse(start.q)))
        return jnp.concatenate([turn, self.spatial_momentum(end) - self.spatial_momentum(start)])

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """(δθ, δπ), shape (16,), of a tangent vector (δF, δP)."""
        change = jnp.tensordot(self._basis(state), tangent.p @ state.q.T + state.p @ tangent.q.T, 2)
        return jnp.concatenate([self.group.spatial_velocity(state.q, tangent.q), change])

    def omega(self, state: State) -> PhaseMatrix:
        """The symplectic form of T*SL(3) as a matrix, shape (16, 16) (5.9)."""
        return CotangentGroup(self.group).omega(State(state.q, self.spatial_momentum(state)))

    def defect(self, state: State) -> Scalar:
        """det F − 1."""
        return vectors.matrix(state.q).det() - 1

    def _basis(self, state: State) -> Array:
        return jnp.asarray(self.group.basis, state.q.dtype)


@pytree
class CotangentMotions(_ByPerturbation):
    """(T*ℝ³ × T*SO(3))ᴺ, the phase space of N rigid bodies: q (N, 7), position and quaternion, and p (N, 6).

    Tangent vectors are (δx, δθ) of every body, then (δp, δπ) of every body, with δq = δθ q as on T*SO(3).

    Attributes:
        count: N.
    """

    count: int = static()

    @property
    def dim(self) -> int:
        """Dimension of the phase space, 12 N."""
        return 12 * self.count

    @property
    def origin(self) -> State:
        """All bodies at rest in the attitude 1, on a helix, at distances of at least 1 from each other."""
        n = jnp.arange(float(self.count))
        places = jnp.stack([1.3 * n, jnp.sin(n), jnp.cos(n)], axis=1)
        turns = jnp.tile(jnp.array([1.0, 0, 0, 0]), (self.count, 1))
        return State(jnp.concatenate([places, turns], axis=1), jnp.zeros((self.count, 6)))

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """The state displaced by δ, shape (12N,): x + δx, exp(δθ) q, p + δp, π + δπ."""
        along_q, along_p = delta.reshape(2, self.count, 6)
        turned = jax.vmap(so3.multiply)(jax.vmap(so3.exp)(along_q[:, 3:]), state.q[:, 3:])
        return state._replace(q=_join_bodies(state.q[:, :3] + along_q[:, :3], turned), p=state.p + along_p)

    def tangent(self, state: State, delta: PhaseVector) -> tuple[Array, Array]:
        """(δq, δp) in the coordinates of `State`, δq = δθ q for the quaternions."""
        along_q, along_p = delta.reshape(2, self.count, 6)
        turned = jax.vmap(so3.spatial_tangent)(state.q[:, 3:], along_q[:, 3:])
        return _join_bodies(along_q[:, :3], turned), along_p

    def displacement(self, start: State, end: State) -> Array:
        """The δ, shape (12N,), with perturb(start, δ) = end, of the least δθ."""
        turn = jax.vmap(lambda a, b: so3.log(so3.multiply(b, so3.inverse(a))))(start.q[:, 3:], end.q[:, 3:])
        along_q = _join_bodies(end.q[:, :3] - start.q[:, :3], turn)
        return jnp.concatenate([along_q.ravel(), (end.p - start.p).ravel()])

    def units(self, state: State) -> tuple[Array, Array]:
        """The units in which differences are measured, from a state: of δx and δθ, and of δp and δπ, (6N,) each."""
        x, p, spin = state.q[:, :3], state.p[:, :3], state.p[:, 3:]
        length, momentum = (_or_one(jnp.max(jnp.abs(y))) for y in (x - jnp.mean(x, axis=0), p))
        spins = jnp.max(jnp.abs(spin), axis=1, keepdims=True)
        spins = jnp.where(spins > 0, spins, _or_one(jnp.max(spins)))
        lengths, along = (jnp.broadcast_to(y, x.shape) for y in (length, momentum))
        turns = jnp.broadcast_to(spins, x.shape)
        return _join_bodies(lengths, jnp.ones_like(x)).ravel(), _join_bodies(along, turns).ravel()

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """(δx, δθ, …, δp, δπ, …), shape (12N,), of a tangent vector given in the coordinates of `State`."""
        turning = jax.vmap(so3.spatial_velocity)(state.q[:, 3:], tangent.q[:, 3:])
        return jnp.concatenate([_join_bodies(tangent.q[:, :3], turning).ravel(), tangent.p.ravel()])

    def omega(self, state: State) -> PhaseMatrix:
        """[[α, 1], [−1, 0]], shape (12N, 12N), α being π̂ of each body on its δθ (2.9)."""
        one = jnp.eye(6 * self.count, dtype=state.p.dtype)
        spins = jnp.zeros((self.count, 6, 6), state.p.dtype).at[:, 3:, 3:].set(jax.vmap(so3.hat)(state.p[:, 3:]))
        alpha = jnp.zeros((self.count, 6, self.count, 6), state.p.dtype)
        n = jnp.arange(self.count)
        alpha = alpha.at[n, :, n, :].set(spins).reshape(one.shape)
        return jnp.block([[alpha, one], [-one, 0 * one]])

    def defect(self, state: State) -> Scalar:
        """The largest ||q|² − 1| of the quaternions."""
        return jnp.max(jnp.abs(jax.vmap(so3.defect)(state.q[:, 3:])))


def _join_bodies(linear: Array, angular: Array) -> Array:
    return jnp.concatenate([linear, angular], axis=1)


def _or_one(x: Array) -> Array:
    return jnp.where(x > 0, x, 1)


@pytree
class CotangentSphere(_ByEntries):
    """T*S²: a state is (q, π) with |q| = 1 and q·π = 0 (1.3), π = m q × q̇; a tangent vector has four coordinates.

    The coordinates refer to an orthonormal, right-handed frame e₁, e₂, q: δq = a₁e₁ + a₂e₂ and
    δπ = b₁e₁ + b₂e₂ − (π·δq) q, so that q·δπ + π·δq = 0.
    """

    @property
    def dim(self) -> int:
        """Dimension of the phase space, 4."""
        return 4

    @property
    def origin(self) -> State:
        """q = e₃, at rest."""
        return State(jnp.array([0.0, 0.0, 1.0]), jnp.zeros(3))

    def perturb(self, state: State, delta: PhaseVector) -> State:
        """The state displaced by δ = (a, b), shape (4,), on T*S²: q and π + δπ rotated by exp(θ̂), θ = q × δq."""
        e1, e2 = frame(state.q)
        turn = so3.exp(delta[0] * e2 - delta[1] * e1)
        return state._replace(q=so3.Ad(turn, state.q), p=so3.Ad(turn, state.p + delta[2] * e1 + delta[3] * e2))

    def displaced(self, start: State, displacement: Array) -> State:
        """The end of a displacement, projected on T*S²."""
        end = super().displaced(start, displacement)
        q = end.q / vectors.norm(end.q)
        return end._replace(q=q, p=end.p - vectors.dot(q, end.p) * q)

    def trivialize(self, state: State, tangent: State) -> PhaseVector:
        """(a, b), shape (4,), of a tangent vector given in the coordinates of `State`."""
        e1, e2 = frame(state.q)
        return jnp.stack([vectors.dot(e, v) for v in (tangent.q, tangent.p) for e in (e1, e2)])

    def omega(self, state: State) -> PhaseMatrix:
        """ω(δ₁, δ₂) = q·(δq₁ × δπ₂ + δπ₁ × δq₂), shape (4, 4): the inverse of 𝒥 (1.4), the same in every frame."""
        turn = jnp.array([[0, 1], [-1, 0]], state.p.dtype)
        return jnp.block([[0 * turn, turn], [turn, 0 * turn]])

    def defect(self, state: State) -> Scalar:
        """The larger of ||q|² − 1| and |q·π| over the largest component of π."""
        size = vectors.max_abs(state.p)
        tilt = jnp.abs(vectors.dot(state.q, state.p)) / jnp.where(size > 0, size, 1)
        return jnp.maximum(jnp.abs(vectors.dot(state.q, state.q) - 1), tilt)


@pytree
class SphericalChart:
    """Spherical coordinates z = (θ, φ, p_θ, p_φ) of T*S² about an axis γ: a Darboux chart, singular on the axis.

    With e₁, e₂, γ orthonormal, q = cos θ γ + sin θ (cos φ e₁ + sin φ e₂) and π = p_θ q × ∂q/∂θ + p_φ q × ∂q/∂φ / sin²θ,
    so that p_φ = γ·π. The form of T*S² is dθ∧dp_θ + dφ∧dp_φ: on (δθ, δφ, δp_θ, δp_φ) the constant matrix of (1.2).

    Attributes:
        axis: γ, a unit vector, shape (3,).
    """

    axis: Array

    def state(self, z: PhaseVector) -> State:
        """The state of coordinates z, shape (4,)."""
        theta, phi, p_theta, p_phi = z
        q, down, along = self._frame(theta, phi)
        return State(q, p_theta * along - p_phi / jnp.sin(theta) * down)

    def coordinates(self, state: State) -> PhaseVector:
        """The coordinates of a state, shape (4,): θ in [0, π], φ in (−π, π]. On the axis φ is 0."""
        e1, e2 = frame(self.axis)
        x, y, h = (vectors.dot(e, state.q) for e in (e1, e2, self.axis))
        polar = x * x + y * y == 0
        x = jnp.where(polar, 1, x)  # harmless before the square root and the angle
        theta = jnp.arctan2(jnp.where(polar, 0, jnp.sqrt(x * x + y * y)), h)
        phi = jnp.arctan2(y, x)
        along = self._frame(theta, phi)[2]
        return jnp.stack([theta, phi, vectors.dot(state.p, along), vectors.dot(state.p, self.axis)])

    def _frame(self, theta: Scalar, phi: Scalar) -> tuple[Array, Array, Array]:
        """q, ∂q/∂θ, and the unit vector q × ∂q/∂θ along ∂q/∂φ."""
        e1, e2 = frame(self.axis)
        out, along = jnp.cos(phi) * e1 + jnp.sin(phi) * e2, jnp.cos(phi) * e2 - jnp.sin(phi) * e1
        c, s = jnp.cos(theta), jnp.sin(theta)
        return c * self.axis + s * out, c * out - s * self.axis, along


def frame(q: Vector3) -> tuple[Vector3, Vector3]:
    """Unit vectors e₁, e₂ with e₁ × e₂ = q, for a unit vector q (Duff et al. 2017, J. Comput. Graph. Tech. 6)."""
    x, y, z = q
    sign = jnp.where(z < 0, -1, 1).astype(q.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    return jnp.stack([1 + sign * x * x * a, sign * b, -sign * x]), jnp.stack([b, sign + y * y * a, -y])
