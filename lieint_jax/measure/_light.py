"""The light that a convex body of facets reflects."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics import vectors
from lieint_jax._numerics.arrays import Scalar, Vector3
from lieint_jax._xla import rereading_jit
from lieint_jax.core import callable_pytree
from lieint_jax.groups import so3
from lieint_jax.measure._states import Directions, directions, map_run, rotate, rotation
from lieint_jax.runs import Run
from lieint_jax.shapes import Facets, GlossyFacets

__all__ = ["brightness", "glossy_brightness", "lambert", "light_curve"]

SUN_RADIUS = 0.00465  # rad, from the Earth
ScatteringLaw = Callable[[Array, Array], Array]  # (μ0, μ) ↦ reflectance
_Scene = tuple[GlossyFacets, Array, Array]  # facets, directions to Sun and observer


def lambert(mu0: Array, mu: Array) -> Array:
    """Lambert's law with albedo 1, μ0: diffuse reflection, equally bright from all sides."""
    _checks.all_plain(mu0=mu0, mu=mu)
    return mu0


def brightness(
    facets: Facets, q: ArrayLike, sun: ArrayLike, observer: ArrayLike, *, law: ScatteringLaw = lambert
) -> Scalar:
    """The light that a convex body sends to an observer, integrated over its disk: Σ law(μ0, μ) μ A/π.

    The sum is over the facets that are lit and seen, those with cosines μ0 > 0 of the angle between normal and Sun and
    μ > 0 between normal and observer. The result times the incident flux over the square of the observer's distance is
    the observed flux; −2.5 log₁₀ of it is a magnitude. A white Lambert sphere of radius R sends (2/3)R² at opposition.

    A pure function, for jit, vmap and grad. Its derivatives are exact for the facets; those of a law that does not
    vanish for μ0 → 0 lack the edges between light and shadow.

    Args:
        facets: of the body, in body axes.
        q: its attitude, body to space: a unit quaternion (4,), or a matrix (3, 3), or (4, 4) as of SE(3).
        sun, observer: directions in space, from the body, (3,), of any length but 0.
        law: (μ0, μ) ↦ the reflectance, any function of arrays (facets,): 1 is a white body that is equally bright where
            lit; `lambda mu0, mu: mu0 / (mu0 + mu)` is proportional to Lommel–Seeliger's law.

    Raises:
        ValueError: `facets` are no facets, but a shape for instance.

    Source: Kaasalainen & Torppa 2001, Icarus 153, 24, (2).
    """
    _checks.all_plain(q=q, sun=sun, observer=observer)
    check_facets(facets)
    q = jnp.asarray(q)
    s, o = (_to_body(q, jnp.asarray(v, q.dtype)) for v in (sun, observer))
    mu0, mu = (rotate(facets.normals, _unit(v)) for v in (s, o))
    dark = (mu0 <= 0) | (mu <= 0)  # a NaN is not dark, so that it is not lost
    mu0, mu = (jnp.where(dark, 1.0, x) for x in (mu0, mu))  # harmless to any law and its derivatives
    return jnp.sum(jnp.where(dark, 0.0, law(mu0, mu) * mu * facets.areas)) / jnp.pi


def check_facets(facets: object, kind: type[Facets] = Facets) -> None:
    """Raise ValueError if `facets` are not of a kind that has normals, areas and, if glossy, a surface."""
    if not isinstance(facets, kind):
        way = "shapes.facets(vertices, faces), shapes.ellipsoid_facets(…) or shapes.box_facets(…)"
        if kind is GlossyFacets:
            way = "shapes.GlossyFacets(normals, areas, diffuse, specular, exponent)"
        raise ValueError(f"facets must be {way}, got {_checks.printable(repr(facets))}")


def _unit(v: Vector3) -> Vector3:
    """v/|v|, also where |v|² is out of range."""
    exponent = jnp.frexp(jax.lax.stop_gradient(jnp.max(jnp.abs(v))))[1]
    v = jnp.ldexp(v, -exponent)
    return v / vectors.norm(v)


def _to_body(q: Array, v: Array) -> Vector3:
    return so3.Ad_star(q, v) if q.shape == (4,) else rotate(q[:3, :3].T, v)


def glossy_brightness(facets: GlossyFacets, q: Array, sun: Array, observer: Array) -> Array:
    """The light of facets with a lobe toward an observer, with all derivatives: Σ A/π r(μ0) r(μ)[d + s r(n·h)^p].

    Here h = (s + o)/|s + o|, with s and o the directions to Sun and observer, which may be exchanged. The ramp
    r(x) = (x + √(x² + ε²))/2 replaces max(0, x), whose derivative jumps where a facet is seen edge-on. Its width ε is
    the angular radius of the Sun, which smears that edge about as much. A facet that faces away counts with a cosine of
    ε²/4|x|, about 1e-5. Facets do not shade each other.

    Args:
        facets: of the body, in body axes.
        q: its attitude, a unit quaternion, (4,).
        sun, observer: unit vectors in space, from the body, (3,); not opposite to each other.

    Returns:
        The light relative to a white Lambert facet of area π lit and seen face-on. Forward derivatives by the attitude
        are those of a gradient: eight directions cost little more than the light itself.

    Raises:
        ValueError: `facets` are no `GlossyFacets`.

    Source of the lobe: Blinn 1977, Proc. SIGGRAPH, 192.
    """
    _checks.all_plain(q=q, sun=sun, observer=observer)
    check_facets(facets, GlossyFacets)
    return _glossy(q, (facets, sun, observer))


@jax.custom_jvp
def _glossy(q: Array, scene: _Scene) -> Array:
    facets, sun, observer = scene
    s, o = so3.Ad_star(q, sun), so3.Ad_star(q, observer)
    between = s + o
    h = between / jnp.sqrt(jnp.sum(between * between))
    lit, seen, mirrored = (_ramp(jnp.sum(facets.normals * v, axis=1)) for v in (s, o, h))
    return jnp.sum(facets.areas / jnp.pi * lit * seen * (facets.diffuse + facets.specular * mirrored**facets.exponent))


@partial(_glossy.defjvp, symbolic_zeros=True)
def _glossy_jvp(primals: tuple[Array, _Scene], tangents: Any) -> tuple[Array, Array]:
    (q, scene), (dq, *changes) = primals, jax.tree.leaves(tangents, is_leaf=_is_zero)
    light, gradient = jax.value_and_grad(_glossy.fun)(q, scene)
    along = jnp.zeros_like(light) if _is_zero(dq) else jnp.vdot(gradient, dq)
    if all(map(_is_zero, changes)):
        return light, along
    full = [jnp.zeros(x.shape, x.dtype) if _is_zero(x) else x for x in changes]
    change = jax.tree.unflatten(jax.tree.structure(scene), full)
    return light, along + jax.jvp(lambda scene: _glossy.fun(q, scene), (scene,), (change,))[1]


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)


def _ramp(x: Array) -> Array:
    """A smooth max(0, x), positive everywhere, without cancellation for x < 0."""
    root = jnp.sqrt(x * x + SUN_RADIUS**2)
    return jnp.where(x > 0, (x + root) / 2, SUN_RADIUS**2 / (2 * (root - jnp.minimum(x, 0))))


def light_curve(
    run: Run, facets: Facets, sun: Directions, observer: Directions, *, law: ScatteringLaw = lambert
) -> Array:
    """The light curve of a rotating convex body: `brightness` at each saved time.

    Args:
        run: of a rigid body, or on SO(3) or SE(3).
        facets: of the body, in the axes in which the system has its inertia; the same for all members.
        sun, observer: directions in space, from the body, of any length: (3,), or one for each saved time, (times, 3),
            or functions of time. With light time, give the direction at the time of reflection.
        law: as in `brightness`; a function of a module compiles once.

    Returns:
        (times,) or (times, members), in the square of the unit of length of the facets.

    Raises:
        ValueError: the run is not of one body with an attitude; a wrong shape; `facets` are no facets.
    """
    check_facets(facets)
    R = map_run(run, rotation)
    if R.ndim != 3 + (run.members is not None):
        raise ValueError("light_curve is that of one body, not of several: call brightness for each of them")
    s, o = (directions(name, given, run) for name, given in (("sun", sun), ("observer", observer)))
    return _curve(callable_pytree(law), facets, R, s, o)


@rereading_jit
def _curve(law: ScatteringLaw, facets: Facets, R: Array, sun: Array, observer: Array) -> Array:
    """One time after the other: all facets of all times and members may exceed the memory."""

    def at_time(given: tuple[Array, Array, Array]) -> Array:
        R, s, o = given
        light = partial(brightness, facets, law=law)
        members = [0 if v.ndim == 2 else None for v in (s, o)]  # those that have times of their own
        return light(R, s, o) if R.ndim == 2 else jax.vmap(light, (0, *members))(R, s, o)

    return jax.lax.map(at_time, (R, sun, observer))
