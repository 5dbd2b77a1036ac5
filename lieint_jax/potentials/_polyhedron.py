"""Gravity of a homogeneous polyhedron, in closed form outside, on and inside its surface.

With r from the point to a vertex, n the normal of a face, n_e those of its edges in its plane, h = n·r, p = n_e·r, the
distances a and b of the ends of an edge of length e, and the solid angle ω of the face,

    φ = −½Gρ Σ_f h I,   −∇φ = −Gρ Σ_f n I,   ∇∇φ = −Gρ Σ_f n ⊗ (Σ_e n_e L − n ω),
    I = ∫ dS/r = Σ_e p L − h ω,   L = ln((a + b + e)/(a + b − e)),
    tan ½ω = r₁·(r₂ × r₃)/(r₁r₂r₃ + r₁(r₂·r₃) + r₂(r₃·r₁) + r₃(r₁·r₂))

These are the sums of Werner and Scheeres with their dyads of edges taken apart into those of both faces, so that a face
is one row of a table, from which a loop reads. Each derivative of φ is a sum of the same kind: the parts of the
derivative that come from L and ω vanish in the first two of them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero
from jax.typing import ArrayLike

from lieint_jax import _checks, shapes
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Calls, PoseMomenta, Positions, Rotations, Scalar
from lieint_jax._xla import compiled
from lieint_jax.core import pytree
from lieint_jax.potentials._potential import Potential, relative
from lieint_jax.shapes import Shape, trace_free

__all__ = ["PolyhedronGravity", "polyhedron"]

_COLUMNS = 25  # of a face: its vertices, its normal, twice its area, the lengths of its edges and their normals
_BLOCK = 4  # faces that are evaluated together on a CPU
_ALIKE = 1e-4  # the relative difference of two masses that are taken for the same
_SIX = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # the positions of the entries of a symmetric tensor


@pytree
class Polyhedron(Potential):
    """The gravity of a homogeneous polyhedron. Made by `polyhedron`.

    Its methods act on points in the axes of the mesh, from the origin of the mesh. In `systems.rigid_bodies` the
    polyhedron is body 0, at its center of mass and with these axes, and attracts all others.
    """

    G: Array
    density: Array
    mass: Array  # density times volume
    center: Array  # the center of mass, (3,)
    table: Array  # the numbers of all faces, in blocks

    def value(self, x: Array) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The potential φ of a unit mass at points (…, 3), (…): −G·mass/r far away."""
        return -self.G * self.density * self._derivatives(0, x)[..., 0]

    def force(self, x: Array) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The force on a unit mass, −∂φ/∂x, at points (…, 3), (…, 3)."""
        return self.G * self.density * self._derivatives(1, x)

    def hessian(self, x: Array) -> Array:
        """The tensor of the gradient of gravity, ∂²φ/∂x², at points (…, 3), (…, 3, 3)."""
        return -self.G * self.density * self._derivatives(2, x)[..., _SIX]

    def laplacian(self, x: Array) -> Array:
        """∇²φ at points (…, 3), (…): 4πG·density inside the polyhedron and 0 outside, which tells them apart."""
        return jnp.trace(self.hessian(x), axis1=-2, axis2=-1)

    def with_bodies(self, masses: Array, inertias: Array) -> PolyhedronGravity:
        """This polyhedron as body 0, and the other bodies, by their masses (N,) and inertias (N, 3) or (N, 3, 3)."""
        if len(masses) < 2:
            raise ValueError("a polyhedron attracts other bodies: give masses of two bodies or more, its own first")
        if _checks.concrete(masses, self.mass):
            own, given = float(self.mass), float(masses[0])
            if abs(given - own) > _ALIKE * abs(own):
                raise ValueError(
                    f"body 0 is the polyhedron: its mass must be density times volume, {own:.9g}, got {given:.9g}. Use "
                    "the attribute mass of the polyhedron, or another density"
                )
        if _checks.concrete(inertias) and _isotropic(np.asarray(inertias)[1:]):
            return PolyhedronGravity(self, masses[1:], None)
        J = jax.vmap(jnp.diag)(inertias[1:]) if inertias.ndim == 2 else inertias[1:]
        return PolyhedronGravity(self, masses[1:], jax.vmap(trace_free)(-J))

    def __call__(self, x: Positions, R: Rotations) -> Scalar:
        raise TypeError("the masses that a polyhedron attracts are known in systems.rigid_bodies: evaluate V there")

    def _derivatives(self, order: int, x: Array) -> Array:
        points = _checks.real_array("x", x, like=self.table)
        if points.ndim == 0 or points.shape[-1] != 3:
            raise ValueError(f"x must be points (…, 3), got shape {points.shape}")
        found = _at_points(order, self.table, points.reshape(-1, 3))
        return found.reshape(*points.shape[:-1], -1)


@pytree
class PolyhedronGravity(Potential):
    """V = Σ m_j φ(Γ_j) + ½ tr(C_j M_j C_jᵀ ∇∇φ(Γ_j)) of a polyhedron, body 0, and the others; made by `rigid_bodies`.

    Γ_j = Λ₀ᵀ(x_j − x₀), C_j = Λ₀ᵀΛ_j, and M_j is the trace-free part of the second moments.
    """

    polyhedron: Polyhedron
    masses: Array  # of the others, (n,)
    second: Array | None  # M of the others, (n, 3, 3), or None if they are all points or spheres

    @property
    def count(self) -> int:
        return 1 + self.masses.shape[0]

    def invariants(self, x: Positions, R: Rotations) -> Array:
        """Γ of all others, (3n,), and C if one of them has a shape, (12n,)."""
        found = relative(x, R)
        return found[: 3 * len(self.masses)] if self.second is None else found

    def value(self, invariants: Array) -> Scalar:
        """V of the invariants."""
        points, tensors = self._split(invariants)
        V = jnp.sum(self.masses * self.polyhedron.value(points))
        return V if tensors is None else V + jnp.sum(tensors * self.polyhedron.hessian(points)) / 2

    def force(self, x: Positions, R: Rotations) -> PoseMomenta:
        """The forces −∂V/∂x and the torques −∂V(exp(δ̂)R)/∂δ, (N, 6)."""
        points, tensors = self._split(self.invariants(x, R))
        force, torque = self.masses[:, None] * self.polyhedron.force(points), jnp.zeros_like(points)
        if tensors is not None:
            T, slope = jax.vmap(lambda y: (self.polyhedron.hessian(y), jax.jacfwd(self.polyhedron.hessian)(y)))(points)
            force = force - jnp.sum(tensors[..., None] * slope, axis=(1, 2)) / 2
            W = jnp.sum(tensors[:, :, :, None] * T[:, None], axis=2)
            torque = jnp.stack([W[:, 2, 1] - W[:, 1, 2], W[:, 0, 2] - W[:, 2, 0], W[:, 1, 0] - W[:, 0, 1]], axis=1)
        f, tau = (jnp.sum(R[:1] * y[:, None, :], axis=2) for y in (force, torque))
        back = -jnp.sum(jnp.concatenate([f, jnp.cross(x[1:] - x[:1], f) + tau], axis=1), axis=0, keepdims=True)
        return jnp.concatenate([back, jnp.concatenate([f, tau], axis=1)])

    def _split(self, invariants: Array) -> tuple[Array, Array | None]:
        """The points from the origin of the mesh, (n, 3), and CMCᵀ, (n, 3, 3)."""
        n = len(self.masses)
        points = invariants[: 3 * n].reshape(n, 3) + self.polyhedron.center[None]
        if self.second is None:
            return points, None
        C = invariants[3 * n :].reshape(n, 3, 3)
        CM = jnp.sum(C[:, :, :, None] * self.second[:, None], axis=2)
        return points, jnp.sum(CM[:, :, None] * C[:, None], axis=3)


def polyhedron(G: ArrayLike, mesh: Shape | tuple[ArrayLike, Any], density: ArrayLike | None = None) -> Polyhedron:
    """The gravity of a homogeneous polyhedron of triangles at any point, outside or inside, in closed form.

    It is exact near a body of any shape, where series of moments such as `mutual_gravity` diverge. Far away its terms
    cancel: the relative error is a few eps (r/R)², with R the size of the body. On edges and vertices φ and the force
    are finite and right, and second derivatives, which diverge there, finite. Facets without area, such as those that
    fill a gap, contribute nothing; derivatives by vertices lose digits as facets become narrow.

    In `systems.rigid_bodies` the polyhedron is body 0, with the axes of the mesh, and attracts all others: points, or
    small bodies, whose shape counts to second order by their inertias. The others do not attract one another; add
    `point_masses` for this. P and L are conserved; `bodies_energy_momentum` conserves the energy too.

    Args:
        G: the constant of gravity.
        mesh: vertices (V, 3) and faces (F, 3) as in `shapes.mesh`, or a shape of `shapes.mesh` or `shapes.obj`.
        density: by default that of the shape.

    Returns:
        The potential, for `systems.rigid_bodies`, with methods `value`, `force`, `hessian` and `laplacian` of points in
        the axes of the mesh, and the attributes `mass` and `center`.

    Raises:
        ValueError: the shape has no mesh, no density is given with vertices and faces, or the errors of `shapes.mesh`.

    Source: Werner & Scheeres 1996, Celest. Mech. Dyn. Astron. 65.

    Example: a cube of edge 2 attracts a point on the middle of a face.

        >>> from lieint_jax import shapes
        >>> corners = [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        >>> quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        >>> cube = polyhedron(1.0, (corners, [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]), density=1.0)
        >>> float(cube.mass), round(float(cube.force([1.0, 0.0, 0.0])[0]), 3)
        (8.0, -5.194)
    """
    if density is None and not isinstance(mesh, Shape):
        raise ValueError("density must be given with vertices and faces, or give a shape of shapes.mesh")
    shape = mesh if isinstance(mesh, Shape) else shapes.mesh(*mesh, density=1.0)
    if shape.triangles is None:
        raise ValueError("mesh must be vertices and faces, or a shape of shapes.mesh or shapes.obj; this one has none")
    a, b, c = jnp.moveaxis(shape.triangles - shape.center[None, None], 1, 0)
    volume = jnp.sum(a * jnp.cross(b, c)) / 6
    rho = shape.mass / volume if density is None else _checks.real_array("density", density, (), like=volume)
    G = _checks.real_array("G", G, (), like=volume)
    return Polyhedron(G, rho, rho * volume, shape.center, _table(shape.triangles))


def _isotropic(J: np.ndarray) -> bool:
    """Whether all of these tensors of inertia, (n, 3) or (n, 3, 3), are multiples of the identity."""
    J = J if J.ndim == 3 else J[:, None] * np.eye(3)
    return np.allclose(J, np.trace(J, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3), 4 * np.finfo(J.dtype).eps, 0)


def _table(corners: Array) -> Array:
    """The numbers of all faces, (blocks · _COLUMNS · _BLOCK,): those of a block are _COLUMNS rows of its faces.

    Rows of zeros, which contribute nothing, complete the last block.
    """
    t = jnp.roll(corners, -1, axis=1) - corners
    e = jnp.sqrt(jnp.sum(t * t, axis=2))
    order = (jnp.argmax(e, axis=1)[:, None] + jnp.arange(3)) % 3
    size = jnp.max(e, axis=1, keepdims=True)
    unit = t / jnp.where(size > 0, size, 1)[:, :, None]
    longest, a, b = jnp.moveaxis(jnp.take_along_axis(unit, order[:, :, None], axis=1), 1, 0)
    normal = jnp.cross(a, b)
    # of a facet without area it is rounding, and the formula needs one that is normal to the edges
    normal = normal - longest * jnp.sum(longest * normal, axis=1, keepdims=True)
    sine = jnp.sqrt(jnp.sum(normal**2, axis=1, keepdims=True))
    normal, twice = normal / jnp.where(sine > 0, sine, 1), sine * size**2
    sides = jnp.cross(t, normal[:, None]) / jnp.where(e > 0, e, 1)[:, :, None]
    rows = jnp.concatenate([corners.reshape(-1, 9), normal, twice, e, sides.reshape(-1, 9)], axis=1)
    rows = jnp.pad(rows, ((0, -len(rows) % _BLOCK), (0, 0)))
    return jnp.moveaxis(rows.reshape(-1, _BLOCK, _COLUMNS), 1, 2).ravel()


def _over_faces(order: int, table: Array, x: Array) -> Array:
    """As `_sum_of_faces`. On a CPU a loop over blocks, in which machine code reads the table from memory."""
    size = _COLUMNS * _BLOCK

    def in_blocks(table: Array, x: Array) -> Array:
        def add(total: Array, k: Array) -> tuple[Array, None]:
            block = lax.dynamic_slice(table, (k * size,), (size,))
            return total + _sum_of_faces(order, block.reshape(_COLUMNS, _BLOCK), x), None

        start = jnp.zeros((1, 3, 6)[order] if order < 3 else 6 * 3 ** (order - 2), jnp.result_type(table, x))
        return lax.scan(add, start, jnp.arange(table.size // size))[0]

    def all_at_once(table: Array, x: Array) -> Array:
        columns = jnp.moveaxis(table.reshape(-1, _COLUMNS, _BLOCK), 1, 0)
        return _sum_of_faces(order, columns.reshape(_COLUMNS, -1), x)

    return lax.platform_dependent(table, x, cpu=in_blocks, default=all_at_once)


_derivative = jax.custom_jvp(_over_faces, nondiff_argnums=(0,))


@partial(_derivative.defjvp, symbolic_zeros=True)
def _next_derivative(order: int, primals: tuple[Array, Array], tangents: tuple[Any, Any]) -> tuple[Array, Array]:
    """By the point, the next derivative; by the table, the derivative of the formula."""
    (table, x), (by_table, by_x) = primals, tangents
    found = _derivative(order, table, x)
    change = jnp.zeros_like(found)
    if not isinstance(by_x, SymbolicZero):
        slope = _derivative(order + 1, table, x)
        change = change + jnp.sum((slope[_SIX] if order == 1 else slope.reshape(-1, 3)) * by_x[None], axis=1)
    if not isinstance(by_table, SymbolicZero):
        change = change + jax.jvp(lambda y: _over_faces(order, y, x), (table,), (by_table,))[1]
    return found, change


@partial(compiled, static_argnums=0)
def _at_points(order: int, table: Array, points: Array) -> Array:
    return jax.vmap(partial(_derivative, order, table))(points)


def _sum_of_faces(order: int, columns: Array, x: Array) -> Array:
    """The derivatives of ∫ dV/r of one order by the position of the point, from the numbers (_COLUMNS, F) of faces.

    Of order 0 it is one, of order 1 three, of order 2 six (xx, xy, xz, yy, yz, zz), of each further order three times
    as many.
    """
    if order > 2:
        return jax.jacfwd(partial(_sum_of_faces, order - 1, columns))(x).ravel()
    *corners, n = (vectors.vector(columns[k : k + 3]) for k in (0, 3, 6, 9))
    twice_area, lengths = columns[12], columns[13:16]
    sides = [vectors.vector(columns[k : k + 3]) for k in (16, 19, 22)]
    at, tiny = vectors.vector(x), jnp.finfo(x.dtype).tiny
    r = [corner - at for corner in corners]
    a, b, c = (jnp.sqrt(jnp.maximum(vectors.dot(y, y), tiny)) for y in r)
    h, (ab, bc, ca) = vectors.dot(n, r[0]), (vectors.dot(r[k], r[k - 2]) for k in range(3))
    heights = [vectors.dot(side, y) for side, y in zip(sides, r, strict=True)]
    edges = zip(((a, b, ab), (b, c, bc), (c, a, ca)), heights, lengths, strict=True)
    L = [_logarithm(u, v, uv, h * h + p * p, e) for (u, v, uv), p, e in edges]
    volume, turn = h * twice_area, a * b * c + c * ab + a * bc + b * ca
    omega = 2 * jnp.arctan2(volume, jnp.where((volume == 0) & (turn == 0), 1, turn))
    if order < 2:
        over_face = sum(p * log for p, log in zip(heights, L, strict=True)) - h * omega
        return jnp.stack([jnp.sum(y * over_face) for y in ([h / 2] if order == 0 else -n)])
    flux = [sum(side[i] * log for side, log in zip(sides, L, strict=True)) - n[i] * omega for i in range(3)]
    return jnp.stack([jnp.sum(n[i] * flux[j]) for i in range(3) for j in range(i, 3)])


def _logarithm(a: Array, b: Array, ab: Array, square: Array, e: Array) -> Array:
    """L of an edge, from the distances of its ends, their product r_a·r_b, the squared distance of its line, and e.

    a + b − e is 2(ab + r_a·r_b)/(a + b + e), where the sum is e² square/(ab − r_a·r_b) for r_a·r_b < 0, so that nothing
    cancels near an edge. On an edge, where L multiplies 0, the least sum leaves it finite.
    """
    precision, between = jnp.finfo(a.dtype), ab < 0
    total = jnp.where(between, e * square * (e / jnp.where(between, a * b - ab, 1)), a * b + ab)
    return jnp.log1p(e * (a + b + e) / jnp.maximum(total, (precision.eps * e) ** 2 + precision.tiny))


_TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    corners = jnp.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    return {"polyhedron": partial(polyhedron, G=1.3, mesh=(corners, _TETRAHEDRON), density=1.5)}
