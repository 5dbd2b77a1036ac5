"""Mass, center, tensor of inertia and higher moments of bodies.

The moments of a tetrahedron with one vertex at the origin are polynomials in the three others, exact to every order:

    ∫ r⊗…⊗r dV = 6V n!/(n+3)! h_n(r₁, r₂, r₃),

with h_n the complete homogeneous symmetric polynomial of degree n.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._xla import compiled
from lieint_jax.core import pytree, static
from lieint_jax.core.text import short_text

__all__ = ["Shape", "body", "box", "closed_surface", "cylinder", "ellipsoid", "mesh", "sites", "trace_free"]

ORDER = 4  # the highest moments of a shape


@pytree
class Shape(_checks.MassDistribution):
    """A distribution of mass, by its moments. Made by `ellipsoid`, `box`, `cylinder`, `sites`, `mesh`, `obj`, `body`.

    Attributes:
        mass: the mass, a scalar.
        center: the center of mass, in the axes of the shape, (3,).
        second, third, fourth: ∫ r⊗…⊗r dm about the center, (3, 3), (3, 3, 3) and (3, 3, 3, 3); the last two are None
            where they are not known, as in `body`.
        diagonal: whether the axes of the shape are known to be principal axes.
        radius: of a sphere about the center that encloses the body, a scalar; None if unknown.
        triangles: the corners of the faces of a mesh, in the axes of the shape, counterclockwise as seen from outside,
            (F, 3, 3); None for other shapes, and for sums.
    """

    mass: Array
    center: Array
    second: Array
    third: Array | None
    fourth: Array | None
    diagonal: bool = static(default=False)
    radius: Array | None = None
    triangles: Array | None = None

    def __repr__(self) -> str:
        known = concrete(self.second) and np.ndim(self.second) == 2
        moments = {"inertia": self.inertia} if known else {"second": self.second}
        shown = {
            "mass": self.mass,
            "center": self.center,
            **moments,
            "radius": self.radius,
            "triangles": self.triangles,
        }
        return f"Shape({', '.join(f'{name}={short_text(x)}' for name, x in shown.items() if x is not None)})"

    @property
    def inertia(self) -> Array:
        """The tensor of inertia about the center, ∫ (|r|² − r⊗r) dm: principal moments (3,), or (3, 3)."""
        squares = jnp.diagonal(self.second)
        if self.diagonal:
            return jnp.sum(squares) - squares
        return jnp.sum(squares) * jnp.eye(3, dtype=self.second.dtype) - self.second

    def moments(self, order: int) -> Array:
        """The moments ∫ r⊗…⊗r dm about the center, a symmetric tensor with `order` axes of length 3.

        Args:
            order: 0 (the mass) to 4; the moments of order 1 are 0.

        Raises:
            ValueError: `order` is not one of these, or the moments of this order are not known.
        """
        order = _checks.listed("order", order, range(ORDER + 1))
        known = self._about_center()
        if order >= len(known):
            raise ValueError(
                f"the moments of order {order} are not known of a body that is given by mass, center and inertia, but "
                "only those to order 2"
            )
        return known[order]

    def principal_axes(self) -> tuple[Array, Array]:
        """The principal moments of inertia, ascending, (3,), and the rotation to the shape's axes, (3, 3).

        The columns of the rotation are the principal axes; J = R diag(moments) Rᵀ. Derivatives exist where the moments
        are distinct.
        """
        inertia = jnp.diag(self.inertia) if self.diagonal else self.inertia
        moments, axes = jnp.linalg.eigh(inertia)
        return moments, axes.at[:, 2].multiply(jnp.linalg.det(axes))

    def aligned(self) -> Shape:
        """The same body with its center at the origin and its principal axes along x, y and z, moments ascending."""
        _, axes = self.principal_axes()
        turned = self._rotate(axes.T)
        second = jnp.diag(jnp.diagonal(turned.second))
        return replace(turned.moved(-turned.center), center=jnp.zeros_like(self.center), second=second, diagonal=True)

    def moved(self, by: ArrayLike = (0.0, 0.0, 0.0), rotation: ArrayLike | None = None) -> Shape:
        """The same body rotated about the origin, then translated.

        Args:
            by: the translation, (3,).
            rotation: a rotation matrix, (3, 3); by default the identity.
        """
        by = _checks.real_array("by", by, (3,), like=self.second)
        if rotation is None:
            triangles = None if self.triangles is None else self.triangles + by[None, None]
            return replace(self, center=self.center + by, triangles=triangles)
        return self._rotate(_checks.rotation_matrix("rotation", rotation)).moved(by)

    def _rotate(self, R: Array) -> Shape:
        second = jnp.einsum("ai,bj,ij->ab", R, R, self.second)
        center = jnp.sum(R * self.center[None], axis=1)
        if self.third is None or self.fourth is None:
            return Shape(self.mass, center, second, None, None, radius=self.radius)
        third = jnp.einsum("ai,bj,ck,ijk->abc", R, R, R, self.third)
        fourth = jnp.einsum("ai,bj,ck,dl,ijkl->abcd", R, R, R, R, self.fourth)
        corners = self.triangles
        triangles = None if corners is None else jnp.sum(R[None, None] * corners[:, :, None], axis=3)
        return Shape(self.mass, center, second, third, fourth, radius=self.radius, triangles=triangles)

    def __add__(self, other: Shape) -> Shape:
        """Both bodies joined into one; a body of negative mass is a cavity."""
        if not isinstance(other, Shape):
            return NotImplemented
        mass = self.mass + other.mass
        center = (self.mass * self.center + other.mass * other.center) / mass
        parts = [_shift_moments(part._about_center(), part.center - center) for part in (self, other)]
        second, *higher = [a + b for a, b in zip(*parts, strict=False)][2:]  # as far as both are known
        third, fourth = higher or (None, None)
        radius = None
        if self.radius is not None and other.radius is not None:
            radius = jnp.maximum(_norm(self.center - center) + self.radius, _norm(other.center - center) + other.radius)
        return Shape(mass, center, second, third, fourth, radius=radius)

    def _about_center(self) -> tuple[Array, ...]:
        """The moments of orders 0, 1, … that are known."""
        known = self.mass, jnp.zeros_like(self.center), self.second
        return known if self.third is None or self.fourth is None else (*known, self.third, self.fourth)


def ellipsoid(semi_axes: ArrayLike, *, mass: ArrayLike | None = None, density: ArrayLike | None = None) -> Shape:
    """A homogeneous ellipsoid about the origin; a sphere if its semi-axes are equal.

    Args:
        semi_axes: along x, y and z, (3,), > 0.
        mass, density: exactly one of them, a scalar.

    Example:
        >>> ellipsoid([3.0, 2.0, 1.0], mass=5.0).inertia.tolist()
        [5.0, 10.0, 13.0]
    """
    a = _checks.positive("semi_axes", semi_axes, (3,))
    return _solid(4 / 3 * math.pi * jnp.prod(a), a * a / 5, (a * a, _ELLIPSOID), jnp.max(a), mass, density)


def box(edges: ArrayLike, *, mass: ArrayLike | None = None, density: ArrayLike | None = None) -> Shape:
    """A homogeneous box about the origin.

    Args:
        edges: the full lengths along x, y and z, (3,), > 0.
        mass, density: exactly one of them, a scalar.

    Example:
        >>> box([3.0, 2.0, 1.0], mass=12.0).inertia.tolist()
        [5.0, 10.0, 13.0]
    """
    a = _checks.positive("edges", edges, (3,))
    return _solid(jnp.prod(a), a * a / 12, (a * a, _BOX), _norm(a) / 2, mass, density)


def cylinder(
    radius: ArrayLike, height: ArrayLike, *, mass: ArrayLike | None = None, density: ArrayLike | None = None
) -> Shape:
    """A homogeneous circular cylinder about the origin, its axis along z.

    Args:
        radius: > 0, a scalar.
        height: the full length, > 0, a scalar.
        mass, density: exactly one of them, a scalar.

    Example:
        >>> cylinder(2.0, 3.0, mass=4.0).inertia.tolist()
        [7.0, 7.0, 8.0]
    """
    R, H = _checks.real_array("radius", radius, ()), _checks.real_array("height", height, ())
    a = _checks.positive("radius and height", jnp.stack([R, R, H]), (3,))
    squares = a * a * jnp.array([1 / 4, 1 / 4, 1 / 12], a.dtype)
    radius = jnp.sqrt(R * R + H * H / 4)
    return _solid(math.pi * R * R * H, squares, (a * a, _CYLINDER), radius, mass, density)


def sites(masses: ArrayLike, points: ArrayLike) -> Shape:
    """A body of point masses.

    Args:
        masses: (n,), their sum > 0.
        points: (n, 3).

    Raises:
        ValueError: the shapes disagree, or the total mass is not positive.

    Example:
        >>> dumbbell = sites([1.0, 1.0], [[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
        >>> dumbbell.center.tolist(), dumbbell.inertia.diagonal().tolist()
        ([2.0, 0.0, 0.0], [0.0, 2.0, 2.0])
    """
    m = _checks.real_array("masses", masses)
    if m.ndim != 1 or not m.size:
        raise ValueError(f"masses must have shape (n,), got {m.shape}")
    at = _checks.real_array("points", points, (m.size, 3))
    mass = _checks.positive("the total mass", jnp.sum(m))
    center = jnp.sum(m[:, None] * at, axis=0) / mass
    r = at - center
    pairs = (r[:, :, None] * r[:, None, :]).reshape(-1, 9)
    return Shape(
        mass,
        center,
        jnp.sum(m[:, None] * pairs, axis=0).reshape(3, 3),
        _sums(m[:, None] * pairs, r).reshape(3, 3, 3),
        _sums(m[:, None] * pairs, pairs).reshape(3, 3, 3, 3),
        radius=jnp.max(_norm(r)),
    )


def body(*, mass: ArrayLike, inertia: ArrayLike, center: ArrayLike = (0.0, 0.0, 0.0)) -> Shape:
    """A body of given mass, center and inertia, such as a data sheet or a CAD program states them.

    Its moments of orders 3 and 4 are not known: `potentials.mutual_gravity` takes it to order 2. Sums and rotations
    follow from the theorem of parallel axes.

    Args:
        mass: > 0, a scalar.
        inertia: about the center, in the axes of the shape: principal moments (3,), or a symmetric tensor (3, 3). With
            products of inertia P_xy = ∫ x y dm, its off-diagonal elements are −P_xy.
        center: the center of mass, (3,).

    Raises:
        ValueError: the mass or the inertia is not positive, or the tensor is not symmetric. A warning says that the
            moments break the triangle inequality: no body has them.

    Example: two of them, joined.

        >>> half = body(mass=2.0, inertia=[1.0, 2.0, 3.0], center=[1.0, 0.0, 0.0])
        >>> (half + half.moved([-2.0, 0.0, 0.0])).inertia.diagonal().tolist()
        [2.0, 8.0, 10.0]
    """
    m, J = _checks.positive("mass", mass), _checks.inertia(inertia)
    squares = jnp.sum(J) / 2 - J if J.ndim == 1 else jnp.trace(J) / 2 * jnp.eye(3, dtype=J.dtype) - J
    second = jnp.diag(squares) if J.ndim == 1 else squares
    return Shape(m, _checks.real_array("center", center, (3,), like=J), second, None, None, J.ndim == 1)


def mesh(vertices: ArrayLike, faces: Any, *, mass: ArrayLike | None = None, density: ArrayLike | None = None) -> Shape:
    """A homogeneous polyhedron, bounded by triangles.

    The moments are exact up to rounding. They are differentiable with respect to the vertices.

    Args:
        vertices: (V, 3).
        faces: the indices of the three vertices of each triangle, counted from 0, (F, 3); seen from outside, all
            counterclockwise or all clockwise. The surface may have several parts, also inside others: cavities, whose
            outside is the hollow. What parts that cross have in common counts twice: this is not checked.
        mass, density: exactly one of them, a scalar.

    Raises:
        ValueError: the surface is not closed or encloses no volume, triangles or parts of the surface differ in
            orientation, or the shapes disagree.

    Source: the moments of a simplex, in the docstring of this module; Dobrovolskis 1996, Icarus 124, for the second.

    Example:
        >>> corner = mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], _TETRAHEDRON, density=6.0)
        >>> float(corner.mass), corner.center.tolist()
        (1.0, [0.25, 0.25, 0.25])
    """
    at, triangles = closed_surface(vertices, faces)
    if concrete(at):
        most, largest = largest_coordinate(at.dtype), float(np.abs(np.asarray(at)).max(initial=0))
        if largest > most:
            raise ValueError(
                f"coordinates must be at most {most:.2g}, beyond which moments of inertia overflow, got {largest:.3g}: "
                "choose a larger unit of length"
            )
        _check_parts(np.asarray(at, float)[triangles], triangles)
    reference = jnp.mean(at, axis=0)  # near the center: the moments about a distant point would cancel
    corners = (at - reference[None])[triangles]
    volume, *moments = _of_tetrahedra(corners)
    if concrete(volume):
        size = float(jnp.max(jnp.abs(corners)))
        if not abs(float(volume)) > 64 * float(jnp.finfo(volume.dtype).eps) * size**3:
            raise ValueError(f"the mesh must enclose a volume, got {float(volume):.3g}, of vertices within {size:.3g}³")
    total, scale = _mass(jnp.abs(volume), mass, density)
    scale = scale * jnp.sign(volume)
    to_center = scale * moments[0] / total
    _, _, second, third, fourth = _shift_moments((total, *(scale * M for M in moments)), -to_center)
    triangles = jnp.where(volume < 0, at[triangles[:, ::-1]], at[triangles]) + 0 * volume  # NaN where it is NaN
    center = reference + to_center
    radius = jnp.max(_norm(triangles - center[None, None]))
    return Shape(total, center, second, third, fourth, radius=radius, triangles=triangles)


def largest_coordinate(dtype: Any) -> float:
    """The largest coordinate whose fifth power, as in a moment of inertia, does not overflow, with a margin."""
    return float(jnp.finfo(dtype).max) ** 0.2 / 16


_SAMPLES = 16  # faces of a part of a surface whose centers decide whether it lies inside another
_TETRAHEDRON = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
# ⟨x_i² x_j²⟩ over the squares of the lengths i and j
_ELLIPSOID = (np.ones((3, 3)) + 2 * np.eye(3)) / 35
_BOX = np.full((3, 3), 1 / 144) + np.eye(3) * (1 / 80 - 1 / 144)
_CYLINDER = np.array([[1 / 8, 1 / 24, 1 / 48], [1 / 24, 1 / 8, 1 / 48], [1 / 48, 1 / 48, 1 / 80]])


def _mass(volume: Array, mass: ArrayLike | None, density: ArrayLike | None) -> tuple[Array, Array]:
    """The mass and the density, of which one is given."""
    _check_volume(volume)
    name, value = _checks.one_of(mass=mass, density=density)
    number = _checks.real_array(name, value, (), like=volume)
    if concrete(number) and float(number) == 0:
        raise ValueError(f"{name} must not be 0; a cavity has a negative one")
    return (number, number / volume) if name == "mass" else (number * volume, number)


def _check_volume(volume: Array | np.floating) -> None:
    """ValueError if a volume is not one that numbers of its type hold, such as the cube of 1e200."""
    kind = jnp.finfo(volume.dtype)
    if concrete(volume) and not float(kind.tiny) <= float(volume) <= float(kind.max):
        raise ValueError(
            f"the volume of a shape must be from {float(kind.tiny):.2g} to {float(kind.max):.2g} in {kind.dtype}, got "
            f"{float(volume):.3g}: use a unit of length that is nearer to the size of the body"
        )


def _norm(x: Array) -> Array:
    """The lengths of vectors in the last axis."""
    return jnp.sqrt(jnp.sum(x * x, axis=-1))


def _solid(
    volume: Array,
    squares: Array,
    fourths: tuple[Array, np.ndarray],
    radius: Array,
    mass: ArrayLike | None,
    density: ArrayLike | None,
) -> Shape:
    """A body that is symmetric about three planes, from ⟨x_i²⟩ and ⟨x_i² x_j²⟩."""
    total, _ = _mass(volume, mass, density)
    lengths, table = fourths
    one = jnp.eye(3, dtype=lengths.dtype)
    # of the three ways to pair four axes, all three hold where the four are equal
    mean = jnp.asarray(table * (1 - np.eye(3) * 2 / 3), lengths.dtype) * lengths[:, None] * lengths[None]
    fourth = 3 * _symmetrize(mean[:, None, :, None] * one[:, :, None, None] * one[None, None])
    zero = jnp.zeros((3, 3, 3), lengths.dtype)
    return Shape(total, zero[0, 0], jnp.diag(total * squares), zero, total * fourth, True, radius)


@partial(compiled, once=True)
def _shift_moments(moments: tuple[Array, ...], by: Array) -> tuple[Array, ...]:
    """The moments of orders 0, 1, … of a body translated by d: ∫ (r + d)⊗…⊗(r + d) dm."""
    powers = [jnp.ones((), by.dtype)]
    for _ in moments[1:]:
        powers.append(_place_axes(powers[-1], by, tuple(range(powers[-1].ndim))))
    return tuple(
        sum(
            (
                _place_axes(moments[k], powers[n - k], axes)
                for k in range(n + 1)
                for axes in itertools.combinations(range(n), k)
            ),
            jnp.zeros((3,) * n, by.dtype),
        )
        for n in range(len(moments))
    )


def _place_axes(a: Array, b: Array, axes: tuple[int, ...]) -> Array:
    """The product of two tensors, with the axes of the first at these places and those of the second at the others."""
    others = [k for k in range(a.ndim + b.ndim) if k not in axes]
    outer = jnp.expand_dims(a, tuple(range(a.ndim, a.ndim + b.ndim))) * jnp.expand_dims(b, tuple(range(a.ndim)))
    return jnp.moveaxis(outer, range(outer.ndim), (*axes, *others))


def _symmetrize(T: Array) -> Array:
    """The mean of a tensor over all orders of its axes."""
    orders = list(itertools.permutations(range(T.ndim)))
    return sum((jnp.transpose(T, order) for order in orders), jnp.zeros_like(T)) / len(orders)


@partial(compiled, once=True)
def _of_tetrahedra(corners: Array) -> tuple[Array, ...]:
    """The moments of orders 0 to 4 of tetrahedra from the origin to triangles (F, 3, 3), together, per density.

    With the power sums p_k = Σ r_i⊗…⊗r_i, h₂ = (p₁² + p₂)/2, h₃ = (p₁³ + 3p₁p₂ + 2p₃)/6 and
    h₄ = (p₁⁴ + 6p₁²p₂ + 3p₂² + 8p₁p₃ + 6p₄)/24, their products symmetrized.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    V = jnp.sum(a * jnp.cross(b, c), axis=1) / 6
    p1 = a + b + c
    squares = (corners[:, :, :, None] * corners[:, :, None, :]).reshape(-1, 3, 9)
    p2, q = jnp.sum(squares, axis=1), (p1[:, :, None] * p1[:, None, :]).reshape(-1, 9)
    p3 = jnp.sum(corners[:, :, :, None] * squares[:, :, None, :], axis=1).reshape(-1, 27)
    p1V, flat = V[:, None] * p1, squares.reshape(-1, 9)
    third = _sums(p1V, q + 3 * p2) + 2 * jnp.sum(V[:, None] * p3, axis=0).reshape(3, 9)
    fourth = _sums(V[:, None] * q, q + 6 * p2) + 3 * _sums(V[:, None] * p2, p2) + 8 * _sums(p1V, p3).reshape(9, 9)
    fourth = fourth + 6 * _sums(jnp.repeat(V, 3)[:, None] * flat, flat)
    second = jnp.sum(V[:, None] * (q + p2), axis=0).reshape(3, 3)
    return (
        jnp.sum(V),
        jnp.sum(p1V, axis=0) / 4,
        second / 20,
        _symmetrize(third.reshape(3, 3, 3)) / 120,
        _symmetrize(fourth.reshape(3, 3, 3, 3)) / 840,
    )


@partial(compiled, once=True)
def trace_free(M: Array) -> Array:
    """The trace-free part of a symmetric tensor of order 2, 3 or 4, which alone acts by gravity outside the body."""
    one, trace = jnp.eye(3, dtype=M.dtype), jnp.trace(M)
    if M.ndim < 4:
        return M - M.ndim * (M.ndim - 1) / (2 * (2 * M.ndim - 1)) * _symmetrize(_place_axes(one, trace, (0, 1)))
    double = jnp.trace(trace) * _place_axes(one, one, (0, 1))
    return M - _symmetrize(6 / 7 * _place_axes(one, trace, (0, 1)) - 3 / 35 * double)


def _sums(a: Array, b: Array) -> Array:
    """Σ a⊗b over rows, in full precision on GPUs too."""
    return jnp.matmul(a.T, b, precision="highest")


def closed_surface(vertices: ArrayLike, faces: Any) -> tuple[Array, np.ndarray]:
    """The vertices (V, 3) of the faces (F, 3) of a closed surface of triangles, checked as in `mesh`, and the faces."""
    at = _checks.real_array("vertices", vertices)
    if at.ndim != 2 or at.shape[1] != 3:
        raise ValueError(f"vertices must have shape (V, 3), got {at.shape}")
    triangles = _triangles(faces, len(at))
    used, indices = np.unique(triangles, return_inverse=True)
    return (at, triangles) if len(used) == len(at) else (at[used], indices.reshape(-1, 3))


def _triangles(faces: Any, count: int) -> np.ndarray:
    """The faces (F, 3), checked: in range, closed, and of one orientation."""
    F = np.asarray(faces)
    if F.ndim != 2 or F.shape[1] != 3 or F.dtype.kind not in "iu" or not len(F):
        raise ValueError(f"faces must be indices of three vertices each, (F, 3), got shape {F.shape} of {F.dtype}")
    if F.min() < 0 or F.max() >= count:
        raise ValueError(f"faces must be indices from 0 to {count - 1}, got {F.min()} to {F.max()}")
    edges = np.concatenate([F[:, [0, 1]], F[:, [1, 2]], F[:, [2, 0]]]).astype(np.int64)
    if (edges[:, 0] == edges[:, 1]).any():
        face = int(np.flatnonzero(edges[:, 0] == edges[:, 1])[0]) % len(F)
        raise ValueError(f"a face must have three distinct vertices, face {face} has {F[face].tolist()}")
    keys, opposite = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    names, uses = np.unique(keys, return_counts=True)
    if (uses > 1).any():
        i, j = divmod(int(names[uses > 1][0]), count)
        raise ValueError(
            f"all faces must be oriented alike, but two of them run from vertex {i} to vertex {j}: reverse one of them"
        )
    alone = ~np.isin(keys, opposite)
    if alone.any():
        i, j = edges[alone][0]
        raise ValueError(
            f"the surface must be closed, but {alone.sum()} edges belong to one face only, such as that of vertices "
            f"{i} and {j}: close the holes, or merge vertices that are written twice"
        )
    return F


def _check_parts(corners: np.ndarray, F: np.ndarray) -> None:
    """ValueError unless a part of the surface encloses matter inside an even number of others, a hollow inside an odd.

    The part of the largest volume, which lies in no other, encloses matter: its sign is that of matter.
    """
    part = _parts(F)
    first, sizes = np.unique(part, return_index=True, return_counts=True)[1:]
    if len(first) == 1:
        return
    low, high = (np.array([f(corners[part == k], axis=(0, 1)) for k in range(len(first))]) for f in (np.min, np.max))
    about = corners - ((low + high) / 2)[part, None]
    volumes = np.bincount(part, np.einsum("fi,fi->f", about[:, 0], np.cross(about[:, 1], about[:, 2])) / 6)
    largest = int(np.argmax(np.abs(volumes)))
    thick = np.abs(volumes) > 64 * np.finfo(float).eps * np.max(high - low, axis=1) ** 3
    for k in np.flatnonzero(thick):
        within = np.all((low <= low[k]) & (high[k] <= high), axis=1)
        centers = corners[part == k].mean(axis=1)
        some = centers[:: -(-len(centers) // _SAMPLES)]
        around = [j for j in np.flatnonzero(within) if j != k and _inside(some, corners[part == j])]
        if (volumes[k] * volumes[largest] > 0) == (len(around) % 2 == 0):
            continue
        where = f"{sizes[k]} faces around {centers.mean(axis=0)}, signed volume {volumes[k]:.3g}"
        name, other = f"the part with face {first[k]} ({where})", f"the part with face {first[largest]}"
        raise ValueError(
            f"{name} lies inside another part and is oriented like it, so that its volume would count twice: reverse "
            "its faces if it is a cavity, otherwise leave it out"
            if around
            else f"{name} is oriented unlike {other} and lies in no other part, as a cavity would: reverse its faces"
        )


def _parts(F: np.ndarray) -> np.ndarray:
    """The number of the part of a closed surface, connected by edges, to which each face belongs, (F,)."""
    edges = np.sort(np.concatenate([F[:, [0, 1]], F[:, [1, 2]], F[:, [2, 0]]]), axis=1)
    faces = np.tile(np.arange(len(F)), 3)[np.lexsort(edges.T)].reshape(-1, 2)  # the two faces of each edge
    label = np.arange(len(F))
    while (differ := label[faces[:, 0]] != label[faces[:, 1]]).any():
        ends = np.sort(label[faces[differ]], axis=1)
        np.minimum.at(label, ends[:, 1], ends[:, 0])
        while not np.array_equal(label, shorter := label[label]):
            label = shorter
    return np.unique(label, return_inverse=True)[1].reshape(-1)


def _inside(points: np.ndarray, corners: np.ndarray) -> bool:
    """Whether all points lie inside a closed surface, by their winding numbers (Van Oosterom & Strackee 1983)."""
    a, b, c = np.moveaxis(corners[None] - points[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
    dots = [np.einsum("...i,...i->...", x, y) * z for x, y, z in ((a, b, lc), (b, c, la), (c, a, lb))]
    volume = np.einsum("...i,...i->...", a, np.cross(b, c))
    turns = np.arctan2(volume, la * lb * lc + sum(dots)).sum(axis=1) / (2 * math.pi)
    return bool(np.all(np.abs(turns) > 0.5))
