"""Any matrix Lie group, from a basis of its algebra (Section 5.1).

An element q is an (n, n) array, an algebra element the vector ξ (d,) of its coordinates in the basis, ξ̂ = Σ ξᵢEᵢ; a
dual element μ (d,) has the coordinates ⟨μ, Eᵢ⟩. Everything else follows from the matrices: Ad_q ξ = (q ξ̂ q⁻¹)^∨ (5.3),
[ξ, η]^ = ξ̂η̂ − η̂ξ̂, and the starred maps are transposes.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax._checks import host_array
from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics.arrays import AlgebraVector, DualVector, Flag, MomentumMap, PyTree, Scalar, SquareMatrix
from lieint_jax._numerics.vectors import Matrix, Vector
from lieint_jax._xla import materialized
from lieint_jax.groups import _casimirs, bases, closed_forms

_UNROLLED_DIM, _UNROLLED_SIZE = 6, 5  # the largest groups that are unrolled by default, see `_numerics.small_linalg`
_POWERS = 5  # the most powers of X in a closed form
_DEGREE = 24  # exp by a Taylor polynomial of degree 23, at round-off for norms up to 2
_EXPONENTIAL = [1 / math.factorial(n) for n in range(_DEGREE + 4)]
_SLOPE = [(-1) ** n / math.factorial(n + 1) for n in range(33)]  # of exp; ad_ξ may have twice the eigenvalues of ξ̂
_SQUARINGS = 6  # with scaling, for norms up to 2·2⁶
_CORRECTIONS = 4  # iterations of log
_NODES, _WEIGHTS = ((np.polynomial.legendre.leggauss(8)[k] + 1 - k) / 2 for k in (0, 1))  # in [0, 1]


class MatrixGroup:
    """The matrix group whose algebra is spanned by a basis; `groups.catalogue` has many.

    Immutable and hashable: two groups with the same basis are equal, so building one again hits the same jit cache.

    Args:
        basis: E, d matrices, shape (d, n, n), linearly independent, their brackets in their span. Complex matrices are
            replaced by their real form [[Re, −Im], [Im, Re]] of twice the size.
        name: for reports.
        unrolled: whether arithmetic is unrolled into scalars, several times faster over a batch and slower to compile.
            By default it is for dimensions up to 6 and sizes up to 5.

    Attributes:
        structure: c of [Eᵢ, Eⱼ] = Σ c_ijk E_k, shape (d, d, d).
        identity: the unit matrix, shape (n, n).

    Raises:
        ValueError: a wrong shape, NaN or inf, dependent matrices, or a bracket that leaves the span; the message names
            the matrices.

    Example:
        >>> group = matrix([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 1.0], [0.0, 0.0]]])  # x ↦ ax + b
        >>> group.ad([1.0, 0.0], [0.0, 1.0]).tolist()
        [0.0, 1.0]
    """

    def __init__(self, basis: ArrayLike, name: str = "matrix group", unrolled: bool | None = None) -> None:
        self.basis, self.name = bases.freeze(_checked(basis)), name
        small = self.dim <= _UNROLLED_DIM and self.size <= _UNROLLED_SIZE
        self.unrolled = small if unrolled is None else unrolled
        self._dual, self.structure = (bases.freeze(x) for x in bases.dual_and_structure(self.basis))
        self.identity = bases.freeze(np.eye(self.basis.shape[1]))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, MatrixGroup) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __repr__(self) -> str:
        return f"{self.name}, dimension {self.dim}"

    @property
    def dim(self) -> int:
        """Dimension d of the algebra."""
        return self.basis.shape[0]

    @property
    def size(self) -> int:
        """Size n of the matrices."""
        return self.basis.shape[1]

    @cached_property
    def has_bounded_adjoint(self) -> bool:
        """Whether Ad_q stays bounded along every motion, as on compact, abelian and nilpotent groups.

        Elsewhere Ad_q may grow, and the error of Π = Ad*_q π grows like ε‖Ad_q‖².
        """
        structure = self._normalized[1]
        ad = np.tensordot(np.random.default_rng(0).normal(size=(8, self.dim)), structure.transpose(0, 2, 1), 1)
        ad /= max(np.linalg.norm(ad, 2, axis=(1, 2)).max(), 1e-300)
        nilpotent = np.abs(np.linalg.matrix_power(ad, self.dim)).max() <= 1e-12
        killing = np.einsum("iab,jba->ij", structure, structure)
        return bool(nilpotent or np.linalg.eigvalsh(killing).max() < -1e-9)

    @cached_property
    def corank(self) -> int:
        """The number of independent Casimirs: the codimension of generic coadjoint orbits, the index of the algebra."""
        return _casimirs.corank(self._normalized[1])

    @cached_property
    def _key(self) -> tuple[tuple[int, ...], bytes, bool]:
        return self.basis.shape, self.basis.tobytes(), self.unrolled

    # Coordinates

    def hat(self, xi: AlgebraVector) -> SquareMatrix:
        """ξ̂ = Σ ξᵢEᵢ, shape (n, n)."""
        return la.as_array(self._hat(self._vector(xi)), xi)

    def vee(self, M: SquareMatrix) -> AlgebraVector:
        """The inverse of `hat`; for any M, its orthogonal projection to the algebra (in the Frobenius product)."""
        return la.as_array(self._vee(self._matrix(M)), M)

    # The group

    def multiply(self, a: SquareMatrix, b: SquareMatrix) -> SquareMatrix:
        """The product ab."""
        return la.as_array(self._element(a) @ self._element(b), jnp.asarray(a))

    def inverse(self, a: SquareMatrix) -> SquareMatrix:
        """a⁻¹: S⁻¹aᵀS if the group preserves a bilinear form S, else by cofactors (n ≤ 5) or elimination."""
        return la.as_array(self._inverse(self._element(a)), jnp.asarray(a))

    def exp(self, xi: AlgebraVector) -> SquareMatrix:
        """exp ξ̂: to round-off for sizes up to 128, NaN beyond.

        The size is |λ| if ξ̂ has the eigenvalues 0 and ±λ only, as on SE(3), so that a translation may be long;
        otherwise the norm, the largest row or column sum of |ξ̂|. A Taylor polynomial of degree 23 for sizes up to 2,
        scaling and squaring beyond. The cost is fixed.
        """
        X = self.hat(xi)
        if self._closed is None:
            size = jnp.minimum(jnp.abs(X).sum(0).max(), jnp.abs(X).sum(1).max())
        else:
            size = jnp.sqrt(jax.lax.stop_gradient(jnp.abs(self._closed.square(self._vector(xi)))))
        halvings = jnp.ceil(jnp.log2(jnp.maximum(jax.lax.stop_gradient(size) / 2, 1)))
        E = _sum_and_difference(*_taylor(X * 2.0**-halvings))[0]
        E = jax.lax.fori_loop(0, _SQUARINGS, lambda k, E: jnp.where(k < halvings, E @ E, E), E)
        return jnp.where(halvings <= _SQUARINGS, E, jnp.nan)

    def exp_near(self, xi: AlgebraVector) -> SquareMatrix:
        """exp ξ̂ without scaling, for the steps of schemes: to round-off where `near` holds."""
        return la.as_array(la.materialized(self.exp_both(self._vector(xi))[0]), xi)

    def exp_increment(self, q: SquareMatrix, xi: AlgebraVector, left: bool = False) -> SquareMatrix:
        """q exp ξ̂, or exp ξ̂ q, where `near` holds; errors of q against a form that the group preserves are removed.

        With D = q⁻¹q − 1, by the bilinear form, it is q(exp ξ̂ − ½D), so rounding does not add up in long runs.
        """
        q_, E = self._element(q), self.exp_both(self._vector(xi))[0]
        if self._form is not None:
            inverse = self._inverse(q_)
            E = E - 0.5 * ((q_ @ inverse if left else inverse @ q_) - la.identity(q_))
        return la.as_array(E @ q_ if left else q_ @ E, jnp.asarray(q))

    def exp_along(self, q: SquareMatrix, xi: AlgebraVector, s: Array) -> Array:
        """q exp(sξ̂) for a number s, or at each of several, (k,), where `near` holds: for the steps of schemes.

        With a closed form it is Σ c_m(s²x) sᵐ qXᵐ, whose products are the same for all s.
        """
        closed = self._closed
        if closed is None or not self.unrolled:
            return la.at_each(lambda s: self.multiply(q, self.exp_near(s * xi)), s)
        x = closed.square(self._vector(xi)) * s * s
        c = [s**m * closed_forms.evaluated(series, x) for m, series in enumerate(closed.series(_EXPONENTIAL))]
        powers, X = [q], self.hat(xi)
        while len(powers) < len(c):
            powers += materialized([_product(powers[-1], X)])
        axes = tuple(range(jnp.ndim(s)))
        terms = zip(materialized(c), powers, strict=True)
        return functools.reduce(jnp.add, (w[..., None, None] * jnp.expand_dims(power, axes) for w, power in terms))

    def near(self, xi: AlgebraVector) -> Flag:
        """True if ξ̂ is small enough for `exp_near`; translations may be large.

        With a closed form, the eigenvalue of ξ̂ must lie within ±2; else ‖ξ̂¹⁶‖ ≤ 2¹⁶ max(1, ‖ξ̂‖).
        """
        if self._closed is not None:
            return jnp.abs(self._closed.square(self._vector(xi))) <= 4
        X = power = self._hat(self._vector(xi))
        for _ in range(4):
            power = power @ power
        size, last = (jnp.max(jnp.abs(jnp.stack(la.flatten(la.as_array(M, xi))))) for M in (X, power))
        return last <= 2.0**16 * jnp.maximum(1, size)

    def log(self, q: SquareMatrix) -> AlgebraVector:
        """ξ with exp ξ̂ = q, for q near the identity: to round-off for rotations by up to 3 radians, and for real
        eigenvalues of ξ̂ up to ±5, where rounding errors of q count as much as its condition number.

        Beyond, it is NaN or, where ξ̂ has several eigenvalues, another logarithm. The corrections are Newton's, so after
        a last one below √ε (1 + |ξ̂|²) only rounding errors remain.
        """

        def improve(_: int, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            xi, _found = carry
            rest = 2 * self.vee(_artanh(self.exp(-xi) @ q))
            last, size = (_square(self.hat(jax.lax.stop_gradient(x))) for x in (rest, xi))
            change = jnp.linalg.solve(self.exp_slope(xi), rest)
            return xi + change, last <= jnp.finfo(q.dtype).eps * (1 + size) ** 2

        guess = self.vee(_rough_log(q)), jnp.zeros((), bool)
        xi, found = jax.lax.fori_loop(0, _CORRECTIONS, improve, guess)
        return xi * jnp.where(found, 1, jnp.nan)  # whose derivative is NaN too

    def cayley(self, xi: AlgebraVector) -> SquareMatrix:
        """(1 − ½ξ̂)⁻¹(1 + ½ξ̂), which is in the group only if `cayley_lands`."""
        return la.as_array(la.materialized(self.cayley_both(self._vector(xi))[0]), xi)

    @cached_property
    def cayley_lands(self) -> bool:
        """True if the Cayley map lands in this group, that is, if X³ is in the algebra for every X of the algebra."""
        rng = np.random.default_rng(0)
        X = np.tensordot(rng.normal(size=(2 * self.dim**2 + 8, self.dim)), self._unit_basis, 1)
        return bool(self._outside(X @ X @ X) <= bases.TOLERANCE * np.abs(X).max() ** 3)

    def defect(self, q: SquareMatrix) -> Scalar:
        """The distance of q from the group: the largest violation of the equations that all elements satisfy.

        The equations are: q lies in the linear span of the group; q preserves the bilinear forms on vectors and on
        covectors that the group preserves; det q = 1, if the basis is traceless.
        """
        outside, forms, coforms, traceless = self._constraints
        found = [jnp.tensordot(jnp.asarray(outside, q.dtype), q - self.identity, 2)]
        found += [q.T @ S @ q - S for S in forms] + [q @ S @ q.T - S for S in coforms]
        found += [jnp.linalg.det(q) - 1] if traceless else []
        return jnp.max(jnp.abs(jnp.concatenate([jnp.ravel(x) for x in found] + [jnp.zeros(1, q.dtype)])))

    # Adjoint actions

    def Ad(self, q: SquareMatrix, xi: AlgebraVector) -> AlgebraVector:
        """Ad_q ξ = (q ξ̂ q⁻¹)^∨ (5.3): from body to space."""
        q_, X = self._element(q), self._hat(self._vector(xi))
        return la.as_array(self._vee(q_ @ X @ self._inverse(q_)), jnp.asarray(q))

    def Ad_star(self, q: SquareMatrix, mu: DualVector) -> DualVector:
        """Ad*_q μ, the transpose of Ad: maps spatial momentum π to body momentum Π."""
        q_ = self._element(q)
        return la.as_array(self.coadjoint(q_, self._inverse(q_), self._vector(mu)), jnp.asarray(mu))

    def ad(self, xi: AlgebraVector, eta: AlgebraVector) -> AlgebraVector:
        """[ξ, η]."""
        return la.as_array(self.ad_matrix(self._vector(xi)) @ self._vector(eta), jnp.asarray(xi))

    def ad_star(self, xi: AlgebraVector, mu: DualVector) -> DualVector:
        """The transpose of ad: ⟨ad*_ξ μ, η⟩ = ⟨μ, [ξ, η]⟩ (5.4)."""
        return la.as_array(self.ad_matrix(self._vector(xi)).T @ self._vector(mu), jnp.asarray(mu))

    def ad_matrix(self, xi: la.Vector) -> la.Matrix:
        """The matrix of η ↦ [ξ, η], (d, d)."""
        return la.linear(self._ad, xi)

    def ad_star_matrix(self, mu: la.Vector) -> la.Matrix:
        """The matrix ad*(μ) of ξ ↦ ad*_ξ μ, (d, d): skew."""
        return la.linear(self._ad_star, mu)

    def casimirs(self, mu: DualVector) -> MomentumMap:
        """Functions of μ that every Ad*_q leaves invariant, (k,): independent polynomials, the lowest degrees first.

        These groups have `corank` of them: Π·P and |P|² on SE(3), |Π|² on SO(3), the Pfaffian and |Π|² on SO(4),
        degrees 2 and 3 on SU(3) and SL(3), degrees 2 and 4 on Sp(4), SO(5) and SE(4). Only polynomials of degree up to
        4 are found, and of each degree only if it has at most 1000 monomials: up to d = 10 in degree 4, d = 17 in
        degree 3. So one is missing on SU(4), whose degrees are 2, 3, 4, and on T(3) and Bianchi IV and V, where it is
        no polynomial. A basis far from orthogonal may lose them to rounding, too. The first call on a group computes
        them, in 0.1 s for d = 8 and 0.5 to 1 s for d = 10 (several seconds if most structure constants are not 0).
        """
        values = [
            jnp.sum(jnp.asarray(coefficients, mu.dtype) * math.prod(mu[indices] for indices in monomials.T), axis=1)
            for monomials, coefficients in self._casimirs
        ]
        return jnp.concatenate([mu[:0], *values])

    def rounding(self, q: SquareMatrix, mu: DualVector) -> DualVector:
        """The sums of |terms| of `Ad_star(q, mu)`, (d,); times eps they bound its rounding error."""
        a, b, c = (_absolute(x) for x in (self._element(q), self._inverse(self._element(q)), self._vector(mu)))
        return la.as_array(self.coadjoint(a, b, c, np.abs), jnp.asarray(mu))

    def drift(self, q: SquareMatrix) -> Scalar:
        """A cheap distance of q from the group, for every step; `defect` is complete.

        It is |q⁻¹q − 1|, with q⁻¹ by the bilinear form that the group preserves; or |det q − 1|, if the basis is
        traceless; else 0.
        """
        q_ = self._element(q)
        if self._form is not None:
            off = self._inverse(q_) @ q_ - la.identity(q_)
            return jnp.max(jnp.abs(la.as_array(off, jnp.asarray(q))))
        return jnp.abs(la.determinant(q_) - 1) if self._traceless else jnp.zeros((), jnp.asarray(q).dtype)

    # Velocities

    def spatial_velocity(self, q: SquareMatrix, q_dot: SquareMatrix) -> AlgebraVector:
        """θ with q̇ = θ̂q."""
        return self.vee(q_dot @ self.inverse(q))

    def body_velocity(self, q: SquareMatrix, q_dot: SquareMatrix) -> AlgebraVector:
        """Θ with q̇ = qΘ̂."""
        return self.vee(self.inverse(q) @ q_dot)

    def tangent(self, q: SquareMatrix, Omega: AlgebraVector) -> SquareMatrix:
        """q̇ = qΩ̂ for the body velocity Ω: the inverse of `body_velocity`."""
        return la.as_array(self._element(q) @ self._hat(self._vector(Omega)), jnp.asarray(q))

    def spatial_tangent(self, q: SquareMatrix, theta: AlgebraVector) -> SquareMatrix:
        """q̇ = θ̂q for the spatial velocity θ: the inverse of `spatial_velocity`."""
        return la.as_array(self._hat(self._vector(theta)) @ self._element(q), jnp.asarray(q))

    # For the steps of schemes, on unrolled vectors for small groups: maps with their inverses, and coadjoint actions

    def exp_both(self, xi: la.Vector) -> tuple[la.Matrix, la.Matrix]:
        """exp ξ̂ and exp(−ξ̂), where `near` holds: by the closed form if there is one."""
        X = self._hat(xi)
        if self._closed is None:
            return _sum_and_difference(*_taylor(X))
        x = la.materialized([self._closed.square(xi)])[0]
        series = self._closed.series(_EXPONENTIAL)
        return self._series_and_inverse(X, la.materialized([closed_forms.evaluated(c, x) for c in series]))

    def cayley_both(self, xi: la.Vector) -> tuple[la.Matrix, la.Matrix]:
        """cay ξ and cay(−ξ): by the closed form if there is one."""
        X, closed = self._hat(xi), self._closed
        if closed is None or closed.pairs > 1:
            one = la.identity(X)
            plus, minus = (la.inverse(one + s * X) for s in (0.5, -0.5))
            return 2.0 * minus - one, 2.0 * plus - one
        coefficients: list[la.Scalar] = [1.0, *(2.0 ** (1 - m) for m in range(1, closed.powers))]
        if closed.pairs:  # 2 Σ (X/2)ⁿ, from the last two powers on a geometric series in x/4
            r = 1 / (1 - closed.square(xi) / 4)
            coefficients[-2:] = [c * r if m else 2 * r - 1 for m, c in [*enumerate(coefficients)][-2:]]
        return self._series_and_inverse(X, coefficients)

    def _series_and_inverse(self, X: la.Matrix, c: list[la.Scalar]) -> tuple[la.Matrix, la.Matrix]:
        """Σ c_m Xᵐ and Σ c_m (−X)ᵐ."""
        powers = [la.identity(X), X]
        while len(powers) < len(c):
            powers.append(la.materialized(powers[-1] @ X))
        pairs = list(zip(c, powers, strict=False))
        return _sum_and_difference(la.combination(*pairs[::2]), la.combination(*pairs[1::2]))

    def exp_coadjoint(self, xi: la.Vector, mu: la.Vector) -> la.Vector:
        """Ad*_exp(ξ) μ = exp(ad*_ξ) μ, where `near` holds: by the closed form of ad, if there is one."""
        closed = self._closed_ad
        if closed is None or not self.unrolled:
            return self.coadjoint(*self.exp_both(xi), mu)
        x = la.materialized([closed.square(xi)])[0]
        *lower, top = la.materialized([closed_forms.evaluated(c, x) for c in closed.series(_EXPONENTIAL)])
        value = top * mu
        for k in reversed(range(len(lower))):
            value = lower[k] * mu + self.ad_star_matrix(value) @ xi
            if k % 2 == 0 and k > 0:  # each call adds a kernel, none makes them too long
                value = la.materialized(value)
        return value

    def coadjoint(
        self, q: la.Matrix, inverse: la.Matrix, mu: la.Vector, of: Callable[[np.ndarray], np.ndarray] = np.asarray
    ) -> la.Vector:
        """Ad*_q μ: ⟨μ, (q Eᵢ q⁻¹)^∨⟩ = tr[(qᵀ D q⁻ᵀ)ᵀ Eᵢ] for the matrix D with ⟨μ, ξ⟩ = tr[Dᵀξ̂]."""
        D = la.linear(of(self._dual.transpose(1, 2, 0)), mu)
        return la.linear(of(self.basis.reshape(self.dim, -1)), la.flatten(q.T @ D @ inverse.T))

    # Derivatives of maps, H of (5.28)

    def exp_slope(self, xi: la.Vector, terms: int = 24) -> la.Matrix:
        """H of exp, Σ (−ad_ξ)ᵏ/(k+1)!, as a matrix (d, d), cut after `terms` terms."""
        A = self.ad_matrix(xi)
        H = one = la.identity(A)
        for k in range(terms, 1, -1):
            H = one - 1.0 / k * (A @ H)
        return H

    def closed_slope(self, xi: la.Vector) -> la.Matrix | None:
        """H of exp where `near` holds, by the closed form of ad; None if there is none."""
        closed = self._closed_ad
        if closed is None:
            return None
        A, x = self.ad_matrix(xi), closed.square(xi)
        c = [closed_forms.evaluated(c, x) for c in closed.series(_SLOPE)]
        return self._series_and_inverse(A, c)[0] if len(c) > 1 else c[0] * la.identity(A)  # one if A is always zero

    def cayley_slope(self, xi: la.Vector) -> la.Matrix:
        """H of cay, Hη = ((1 + ½ξ̂)⁻¹ η̂ (1 − ½ξ̂)⁻¹)^∨, as a matrix (d, d). Note (1 ∓ ½ξ̂)⁻¹ = ½(1 + cay(±ξ))."""
        minus, plus = (la.materialized(0.5 * la.identity(q) + 0.5 * q) for q in self.cayley_both(xi))
        if isinstance(plus, Array):
            return jnp.stack([self._vee(plus @ e @ minus) for e in self.basis], axis=1)
        return Matrix(self._vee(plus @ Matrix(e) @ minus) for e in self.basis.tolist()).T

    # Building blocks of these, on unrolled vectors for small groups and on arrays for large ones

    @cached_property
    def _closed(self) -> closed_forms.ClosedForm | None:
        found = closed_forms.find(self._unit_basis, _POWERS)
        return None if found is None else found.rescaled(bases.units(self.basis))

    @cached_property
    def _unit_basis(self) -> np.ndarray:
        """The basis in units in which its matrices are of size 1 to 2: what holds for the span is judged by it."""
        return self.basis / bases.units(self.basis)[:, None, None]

    @cached_property
    def _normalized(self) -> tuple[np.ndarray, np.ndarray]:
        """|Eᵢ|, and the structure constants of the basis Eᵢ/|Eᵢ|."""
        size = np.linalg.norm(self.basis, axis=(1, 2))
        return size, self.structure * size / np.outer(size, size)[:, :, None]

    @property
    def _casimirs(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return _known_casimirs(self)

    @cached_property
    def _closed_ad(self) -> closed_forms.ClosedForm | None:
        units = bases.units(self.basis)
        of_units = self.structure / np.outer(units, units)[:, :, None] * units
        found = closed_forms.find(of_units.transpose(0, 2, 1), _POWERS)
        return None if found is None else found.rescaled(units)

    @cached_property
    def _ad(self) -> np.ndarray:
        return bases.freeze(self.structure.transpose(2, 1, 0))

    @cached_property
    def _ad_star(self) -> np.ndarray:
        return bases.freeze(self.structure.transpose(1, 0, 2))

    @cached_property
    def _free(self) -> np.ndarray:
        """The entries of q that can differ from those of 1: where some product of basis matrices is not zero."""
        pattern = reach = np.any(self.basis != 0, axis=0)
        for _ in range(self.size):
            reach = reach | (reach.astype(int) @ pattern.astype(int) > 0)
        return reach

    @cached_property
    def _form(self) -> tuple[np.ndarray, np.ndarray] | None:
        """S and S⁻¹ of an invertible bilinear form with EᵀS + SE = 0 for every E, or None if none is known."""
        E = self._unit_basis
        forms = bases.invariant_forms(E)
        candidates = [self.identity, *(forms if len(forms) == 1 else [])]
        for S in candidates:
            S = S / np.abs(S).max()
            error = np.abs(E.transpose(0, 2, 1) @ S + S @ E).max()
            if error < bases.TOLERANCE and np.linalg.cond(S) < 1e3:
                return bases.round_entries(S), bases.round_entries(np.linalg.inv(S))
        return None

    @cached_property
    def _constraints(self) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray], bool]:
        """The complement of the span of all q − 1, invariant forms on vectors and on covectors, whether det q = 1."""
        E = self._unit_basis
        span = bases.algebra(E)
        complement = bases.null(span.reshape(len(span), -1)).reshape(-1, *E.shape[1:])
        forms = bases.invariant_forms(E), bases.invariant_forms(E.transpose(0, 2, 1))
        return complement, *forms, self._traceless

    @cached_property
    def _traceless(self) -> bool:
        return bool(np.abs(np.trace(self._unit_basis, axis1=1, axis2=2)).max() < bases.TOLERANCE)

    def _outside(self, M: np.ndarray) -> float:
        """The largest distance of the matrices M from the algebra."""
        inside = np.tensordot(np.tensordot(M, self._dual, ((-2, -1), (1, 2))), self.basis, 1)
        return float(np.abs(M - inside).max())

    def _vector(self, x: PyTree) -> la.Vector:
        if isinstance(x, Vector):
            return x
        x = jnp.asarray(x)
        return la.unrolled(x) if self.unrolled else x

    def _matrix(self, M: PyTree) -> la.Matrix:
        return la.unrolled(jnp.asarray(M)) if self.unrolled else jnp.asarray(M)

    def _element(self, q: PyTree) -> la.Matrix:
        """A group element, unrolled for small groups; entries that are 0 or 1 on the whole group are Python numbers."""
        if not self.unrolled:
            return jnp.asarray(q)
        return Matrix(
            (entry if free else float(i == j) for j, (entry, free) in enumerate(zip(*rows, strict=True)))
            for i, rows in enumerate(zip(la.unrolled(jnp.asarray(q)), self._free, strict=True))
        )

    def _hat(self, xi: la.Vector) -> la.Matrix:
        return la.linear(self.basis.transpose(1, 2, 0), xi)

    def _vee(self, M: la.Matrix) -> la.Vector:
        return la.linear(self._dual.reshape(self.dim, -1), la.flatten(M))

    def _inverse(self, q: la.Matrix) -> la.Matrix:
        if self._form is None:
            return la.inverse(q)
        S, S_inverse = self._form
        if (self.identity == S).all():
            return q.T
        if self.unrolled:
            S, S_inverse = Matrix(S.tolist()), Matrix(S_inverse.tolist())
        return S_inverse @ q.T @ S


def _checked(basis: ArrayLike) -> np.ndarray:
    """Real matrices (d, n, n)."""
    E = host_array("basis", basis)
    if E.ndim != 3 or E.shape[1] != E.shape[2] or not E.size:
        raise ValueError(f"basis must be d square matrices, shape (d, n, n), got shape {E.shape}")
    if not np.issubdtype(E.dtype, np.number):
        raise ValueError(f"basis must hold numbers, got dtype {E.dtype}")
    if not np.isfinite(E).all():
        raise ValueError("basis must be finite")
    if np.iscomplexobj(E):
        re, im = np.real(E), np.imag(E)
        E = np.concatenate([np.concatenate([re, -im], 2), np.concatenate([im, re], 2)], 1)
    return E


matrix = MatrixGroup


def examples() -> dict[str, MatrixGroup]:
    """Groups not in the catalogue: Bianchi's types IV and V, dilations and translations of the plane."""
    scale = np.diag([1.0, 1.0, 0.0])
    shear = scale + np.outer(np.eye(3)[0], np.eye(3)[1])
    x, y = (np.outer(np.eye(3)[i], np.eye(3)[2]) for i in (0, 1))
    return {name: matrix([A, x, y], name) for name, A in {"Bianchi V": scale, "Bianchi IV": shear}.items()}


@functools.lru_cache(maxsize=64)
def _known_casimirs(group: MatrixGroup) -> list[tuple[np.ndarray, np.ndarray]]:
    size, structure = group._normalized
    return _casimirs.independent(structure, size)


def _product(A: Array, B: Array) -> Array:
    """AB, (n, n), by one sum of arrays, of which XLA makes one kernel."""
    n = len(A)
    pairs = zip(jax.lax.split(A, [1] * n, 1), jax.lax.split(B, [1] * n, 0), strict=True)
    return functools.reduce(jnp.add, (a * b for a, b in pairs))


def _taylor(X: la.Matrix) -> tuple[la.Matrix, la.Matrix]:
    """The even and the odd part of Σ Xᵏ/k!, in blocks of powers of X² (Paterson & Stockmeyer 1973)."""
    Y = la.materialized(X @ X)
    powers = [la.identity(X), Y, la.materialized(Y @ Y)]
    cube = la.materialized(powers[2] @ Y)
    even, odd = (_in_blocks(_EXPONENTIAL[parity:_DEGREE:2], powers, cube) for parity in (0, 1))
    return even, la.materialized(X @ odd)


def _in_blocks(weights: Sequence[float], powers: Sequence[la.Matrix], next_power: la.Matrix) -> la.Matrix:
    """Σ wₖYᵏ in blocks (Paterson & Stockmeyer): `powers` are 1, Y, …, `next_power` is the one after them."""
    blocks = [weights[k : k + len(powers)] for k in range(0, len(weights), len(powers))]
    value = la.combination(*zip(blocks[-1], powers, strict=True))
    for block in blocks[-2::-1]:
        value = la.combination(*zip(block, powers, strict=True), (1.0, la.materialized(value @ next_power)))
    return la.materialized(value)


def _sum_and_difference(even: la.Matrix, odd: la.Matrix) -> tuple[la.Matrix, la.Matrix]:
    return even + odd, even - odd


def _square(X: SquareMatrix) -> Scalar:
    """max_i Σ_j |X_ij X_ji|, about |X|² of a rotation: the same in any units of the basis, and 0 for translations."""
    return jnp.max(jnp.sum(jnp.abs(X * X.T), axis=1))


def _rough_log(q: SquareMatrix) -> Array:
    """log q = ∫₀¹ (q − 1)(1 + s(q − 1))⁻¹ ds by Gauss's rule: of a rotation by 2 radians to 2e-4, by 3 to half.

    Source: Dieci, Morini & Papini 1996, SIAM J. Matrix Anal. Appl. 17.
    """
    one = jnp.eye(len(q), dtype=q.dtype)

    def add(value: Array, node: tuple[Array, Array]) -> tuple[Array, None]:
        s, weight = node
        return value + weight * jnp.linalg.solve(one + s * (q - one), q - one), None

    rule = jnp.asarray(_NODES, q.dtype), jnp.asarray(_WEIGHTS, q.dtype)
    return jax.lax.scan(add, jnp.zeros_like(q), rule)[0]


def _artanh(q: SquareMatrix) -> Array:
    """artanh z = z + z³/3 + … for z = (q − 1)(q + 1)⁻¹, half the logarithm."""
    one = jnp.eye(len(q), dtype=q.dtype)
    z = jnp.linalg.solve((q + one).T, (q - one).T).T
    square, value = z @ z, one / 25
    for k in range(23, 0, -2):
        value = one / k + square @ value
    return z @ value


def _absolute(x: PyTree) -> PyTree:
    return jax.tree.map(abs, x)
