"""Forces on the surface of a body: the pressure of sunlight on plates, the drag of a thin atmosphere."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete, for_each, named, not_negative, positive, real_array
from lieint_jax._numerics.arrays import Calls, PyTree
from lieint_jax._numerics.vectors import Vector, cross, dot, vector
from lieint_jax.core import Converted, Law, Rotation, argument, callable_pytree, pytree
from lieint_jax.torques._arguments import VectorOfTime, direction_at, direction_of_time, evaluate, example_of_time
from lieint_jax.torques._body_axes import middle_axes

__all__ = ["Aerodynamic", "aerodynamic", "box_plates", "solar_plate", "solar_plates"]


@pytree
class SolarPlate(Law):
    """The pressure of sunlight on a flat plate, both sides of which reflect alike: T = r × F with

        F = −f|cos ϑ| [(1 − ρ_s)s + 2(ρ_s cos ϑ ± ρ_d/3)n],    cos ϑ = n·s,

    where ± is the sign of cos ϑ, as for a sail or a panel without a shadow. The work in a step is ΔtΩ̄·T̄.

    Args:
        force: f, pressure × area, such as 4.56e-6 N/m² × A at 1 au.
        normal: n in the body, (3,), a unit vector.
        arm: r, from the body's center of mass to the plate's center of pressure, in the body, (3,).
        sun: s in space, (3,), the unit vector to the Sun, or a function of time whose value points to it.
        specular, diffuse: ρ_s and ρ_d ≥ 0, the parts of the light that are reflected so, ρ_s + ρ_d ≤ 1.

    Raises:
        ValueError: a vector of another shape, a normal or a Sun that is not of unit length, parts out of range.

    Source: McInnes 1999, Solar Sailing, chapter 2 (the optical model of a plate, without thermal emission).
    """

    force: Converted[Array] = argument(converter=named(not_negative, "force"))
    normal: Converted[Array] = argument(converter=named(_checks.unit_vector, "normal"))
    arm: Converted[Array] = argument(converter=named(real_array, "arm", (3,)))
    sun: Converted[VectorOfTime] = argument(converter=named(direction_of_time, "sun"))
    specular: Converted[Array] = argument(converter=named(not_negative, "specular"), default=0.0, kw_only=True)
    diffuse: Converted[Array] = argument(converter=named(not_negative, "diffuse"), default=0.0, kw_only=True)

    def check_fields(self) -> None:
        """Raise ValueError if more light is reflected than arrives."""
        _check_parts(self.specular, self.diffuse)

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """r × F(Λᵀs)."""
        s = middle_axes(rotation, direction_at(self.sun, rotation.t))
        cosine = dot(self.normal, s)
        lit = self.force * jnp.abs(cosine)  # either side may face the Sun
        outward = 2 * (self.specular * cosine + jnp.sign(cosine) * self.diffuse / 3)
        push = -lit * (1 - self.specular) * s - lit * outward * self.normal
        return jnp.stack(cross(self.arm, push)), inner


class Plates(Law):
    """A law of the forces on one-sided flat plates on the surface of a body.

    Attributes:
        normals: outward unit vectors in the body, (m, 3).
        arms: from the body's center of mass to the centers of the plates, (m, 3).
    """

    normals: Array
    arms: Array

    def torque(self, forces: Vector) -> Array:
        """Σ r_j × F_j of the forces on the plates, given by their components (m,)."""
        return jnp.stack([jnp.sum(x) for x in cross(vector(self.arms.T), forces)])

    def _plate_sizes(self, name: str, sizes: Array) -> Array:
        """The sizes of the plates, (m,); ValueError if one is negative, or shapes do not agree."""
        if self.arms.ndim != 2 or self.arms.shape[1] != 3 or not len(self.arms):
            raise ValueError(f"arms must have shape (m, 3), one for each plate, got {self.arms.shape}")
        _checks.unit_vector("normals", self.normals, self.arms.shape)
        return for_each(not_negative, name, sizes, len(self.arms))


def _light(light: Callable[..., Array] | None) -> Callable[..., Array] | None:
    if light is None:
        return None
    _checks.function("light", light, "the time t", (), jnp.zeros(()))
    return callable_pytree(light)


@pytree
class SolarPlates(Plates):
    """The pressure of sunlight on the outer surface of a satellite, as one-sided flat plates: T = Σ r_j × F_j with

        F_j = −f_j cos ϑ [(1 − ρ_s)s + 2(ρ_s cos ϑ + ρ_d/3)n_j],    cos ϑ = max(n_j·s, 0).

    A panel is two plates with opposite normals. Plates do not shade one another; the Earth's shadow is `light`.

    Args:
        force: f_j ≥ 0, pressure × area, such as 4.56e-6 N/m² × A_j at 1 au, a number or (m,).
        normals: n_j, outward, in the body, unit vectors (m, 3).
        arms: r_j, from the body's center of mass to the centers of the plates, in the body, (m, 3).
        sun: s in space, (3,), the unit vector to the Sun, or a function of time whose value points to it
            (`orbits.sun_direction`).
        light: t ↦ the part of the sunlight that arrives, from 0 to 1, such as `orbits.eclipse(orbit, sun)`; or None.
        specular, diffuse: ρ_s and ρ_d ≥ 0, the parts of the light reflected so, ρ_s + ρ_d ≤ 1, numbers or (m,).

    Raises:
        ValueError: shapes that do not agree, normals or a Sun that are not of unit length, parts out of range, a light
            that is no such function.

    Source: McInnes 1999, Solar Sailing, chapter 2; Montenbruck & Gill 2000, Satellite Orbits, 3.4.
    """

    force: Converted[Array] = argument(converter=named(real_array, "force"))
    normals: Converted[Array] = argument(converter=named(real_array, "normals"))
    arms: Converted[Array] = argument(converter=named(real_array, "arms"))
    sun: Converted[VectorOfTime] = argument(converter=named(direction_of_time, "sun"))
    _: dataclasses.KW_ONLY
    light: Converted[Callable[..., Array] | None] = argument(converter=_light, default=None)
    specular: Converted[Array] = argument(converter=named(real_array, "specular"), default=0.0)
    diffuse: Converted[Array] = argument(converter=named(real_array, "diffuse"), default=0.0)

    def check_fields(self) -> dict[str, Array]:
        """A force for each plate; ValueError if shapes disagree or more light is reflected than arrives."""
        force = self._plate_sizes("force", self.force)
        for name, part in (("specular", self.specular), ("diffuse", self.diffuse)):
            not_negative(name, part, (), force.shape)
        _check_parts(self.specular, self.diffuse)
        return {"force": force}

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """Σ r_j × F_j(Λᵀs) at the middle of the step."""
        s, n = vector(middle_axes(rotation, direction_at(self.sun, rotation.t))), vector(self.normals.T)
        cosine = jnp.maximum(dot(n, s), 0)
        lit = self.force * cosine
        if self.light is not None:
            lit = lit * evaluate(self.light, rotation.t)
        absorbed, outward = lit * (1 - self.specular), 2 * lit * (self.specular * cosine + self.diffuse / 3)
        return self.torque(-absorbed * s - outward * n), inner


def _air(air: Any) -> Any:
    _checks.function("air", lambda t: air(t)[0], "the time t, with (density, velocity)", (), jnp.zeros(()))
    _checks.function("air", lambda t: air(t)[1], "the time t, with (density, velocity)", (3,), jnp.zeros(()))
    return callable_pytree(air)


@pytree
class Aerodynamic(Plates):
    """The drag of a thin atmosphere on the outer surface of a satellite, as one-sided flat plates: T = Σ r_j × F_j with

        F_j = −½ρ C_j A_j max(n_j·w_j, 0) w_j,    w_j = Λᵀv + Ω × r_j

    for the velocity v relative to the air. A panel is two plates with opposite normals. In air at rest, v = 0, the
    torque dissipates energy in every step. The work in a step is ΔtΩ̄·T̄.

    Args:
        air: t ↦ (density, velocity of the body's center relative to the air in space, (3,)), such as
            `orbits.atmosphere(orbit, …)`. The units of length of this velocity and of the arms must be one: m for N m.
        areas: A_j ≥ 0, a number or (m,).
        normals: n_j, outward, in the body, unit vectors (m, 3).
        arms: r_j, from the body's center of mass to the centers of the plates, in the body, (m, 3).
        drag: C_j ≥ 0, the drag coefficients, a number or (m,); 2 to 2.5 in a low orbit.

    Raises:
        ValueError: an air that is no such function, shapes that do not agree, normals not of unit length, negative
            areas or coefficients.

    Source: Wertz 1978, Spacecraft Attitude Determination and Control, 17.2.3, with one drag coefficient per plate.
    """

    air: Converted[Callable[[Array], tuple[Array, Array]]] = argument(converter=_air)
    areas: Converted[Array] = argument(converter=named(real_array, "areas"))
    normals: Converted[Array] = argument(converter=named(real_array, "normals"))
    arms: Converted[Array] = argument(converter=named(real_array, "arms"))
    drag: Converted[Array] = argument(converter=named(real_array, "drag"), default=2.2, kw_only=True)

    def check_fields(self) -> dict[str, Array]:
        """An area for each plate; ValueError if shapes disagree."""
        areas = self._plate_sizes("areas", self.areas)
        not_negative("drag", self.drag, (), areas.shape)
        return {"areas": areas}

    def mean(self, rotation: Rotation, inner: PyTree) -> tuple[Array, PyTree]:
        """Σ r_j × F_j at the middle of the step; each plate moves through the air by Ω̄ × r_j too."""
        density, velocity = evaluate(self.air, rotation.t)
        w = vector(middle_axes(rotation, velocity)) + cross(vector(rotation.Omega), vector(self.arms.T))
        met = jnp.maximum(dot(vector(self.normals.T), w), 0) * self.areas
        return self.torque(-density / 2 * self.drag * met * w), inner


def box_plates(sizes: ArrayLike, center: ArrayLike = (0.0, 0.0, 0.0)) -> tuple[Array, Array, Array]:
    """The six faces of a box, for `aerodynamic` and `solar_plates`: areas (6,), normals (6, 3) and arms (6, 3).

    Args:
        sizes: the lengths of the edges along the body axes, > 0, (3,).
        center: the middle of the box, from the body's center of mass, (3,).

    Raises:
        ValueError: sizes that are not positive, no vectors.
    """
    a = positive("sizes", sizes, (3,))
    c = real_array("center", center, (3,), like=a)
    normals = jnp.concatenate([jnp.eye(3, dtype=a.dtype), -jnp.eye(3, dtype=a.dtype)])
    areas = jnp.stack([a[1] * a[2], a[2] * a[0], a[0] * a[1]])
    return jnp.concatenate([areas, areas]), normals, c + normals * a / 2


def _check_parts(specular: Array, diffuse: Array) -> None:
    if concrete(specular, diffuse) and np.max(np.asarray(specular) + np.asarray(diffuse)) > 1:
        raise ValueError(f"specular + diffuse must be at most 1, got {np.asarray(specular)} + {np.asarray(diffuse)}")


solar_plate, solar_plates, aerodynamic = SolarPlate, SolarPlates, Aerodynamic


def _wind(numbers: Array, t: Array) -> tuple[Array, Array]:
    """A density and a velocity of air, for the examples."""
    return numbers[0] * (2 + jnp.cos(t)), numbers[1:]


def examples() -> Calls:
    """Calls of these functions with all their numbers."""
    sizes, center = jnp.array([1.0, 0.5, 0.4]), jnp.array([0.05, -0.1, 0.08])
    areas, normals, arms = box_plates(sizes, center)
    sun, faces = example_of_time(0.3, -0.5, 0.7), {"normals": normals, "arms": arms}
    air = Partial(_wind, jnp.array([0.3, 7.1, -0.4, 0.2]))
    plate = {"normal": jnp.array([0.6, 0.8, 0.0]), "arm": jnp.array([0.3, -0.5, 0.7])}
    more = {"specular": 0.3, "diffuse": 0.2}
    return {
        "box_plates": partial(box_plates, sizes=sizes, center=center),
        "aerodynamic": partial(aerodynamic, air=air, areas=areas, **faces, drag=2.2),
        "solar_plate": partial(solar_plate, force=0.4, **plate, sun=example_of_time(0.6, 0.8, 0.1), **more),
        "solar_plates": partial(solar_plates, force=areas, **faces, sun=sun, light=Partial(jnp.multiply, 0.4), **more),
    }
