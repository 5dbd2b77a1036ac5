"""Elastic rods: chains of rigid cross sections, of given length, section and natural shape."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax import _checks, potentials
from lieint_jax._checks import concrete
from lieint_jax._numerics.arrays import PoseMomenta, Positions, PyTree, Rotations, Scalar, Time
from lieint_jax._xla import compiled
from lieint_jax.core import ChainLaw, State, callable_pytree, pytree, static
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._rigid_bodies import DissipativeBodies, RigidBodies, rigid_bodies
from lieint_jax.systems._shared.arguments import explained

__all__ = ["DissipativeRod", "ElasticRod", "Section", "circular_section", "rectangular_section", "rod"]

End = str | ArrayLike | Callable[[Array], Array]
_ENDS = '"free", "clamped", a pose (7,) or a function t ↦ pose (7,)'
_START = (0.0, 0, 0, 1, 0, 0, 0)


class Section(NamedTuple):
    """A cross section of a rod, in its axes 1 and 2; the axis 3 is its normal. Each number may vary along the rod.

    Attributes:
        mass: per unit of length, a scalar or (elements,).
        inertia: per unit of length, ρI₁ and ρI₂ about the axes 1 and 2, (2,) or (elements, 2).
        stretching: the stiffness (GA₁, GA₂, EA) against shear along 1 and 2 and extension, (3,) or (elements, 3).
        bending: the stiffness (EI₁, EI₂, GJ) against bending about 1 and 2 and torsion, (3,) or (elements, 3).
    """

    mass: ArrayLike
    inertia: ArrayLike
    stretching: ArrayLike
    bending: ArrayLike


def circular_section(radius: ArrayLike, young: ArrayLike, density: ArrayLike, *, poisson: ArrayLike = 0.3) -> Section:
    """The section of a solid circular rod.

    Args:
        radius: a scalar, or one for each element.
        young, density, poisson: Young's modulus, the mass per volume and Poisson's ratio of the material.

    Source: the shear coefficient 6(1 + ν)/(7 + 6ν), Cowper 1966, J. Appl. Mech. 33.
    """
    r = _checks.positive("radius", radius, np.shape(radius))
    E, rho, nu = _material(young, density, poisson)
    A, second = jnp.pi * r**2, jnp.pi * r**4 / 4
    shear = E / (2 * (1 + nu))
    return _section(rho, A, (second, second), E, shear, 6 * (1 + nu) / (7 + 6 * nu), 2 * second)


def rectangular_section(
    width: ArrayLike, height: ArrayLike, young: ArrayLike, density: ArrayLike, *, poisson: ArrayLike = 0.3
) -> Section:
    """The section of a solid rectangular rod.

    Args:
        width, height: along the axes 1 and 2, scalars, or one for each element.
        young, density, poisson: as in `circular_section`.

    Source: the shear coefficient 10(1 + ν)/(12 + 11ν), Cowper 1966, J. Appl. Mech. 33; Saint-Venant's torsion.
    """
    a, b = (_checks.positive(name, x, np.shape(x)) for name, x in (("width", width), ("height", height)))
    E, rho, nu = _material(young, density, poisson)
    long, short = jnp.maximum(a, b), jnp.minimum(a, b)
    series = sum(jnp.tanh(n * jnp.pi * long / (2 * short)) / n**5 for n in range(1, 40, 2))
    torsion = long * short**3 / 3 * (1 - 192 * short / (jnp.pi**5 * long) * series)
    shear = E / (2 * (1 + nu))
    return _section(rho, a * b, (a * b**3 / 12, a**3 * b / 12), E, shear, 10 * (1 + nu) / (12 + 11 * nu), torsion)


def _material(young: ArrayLike, density: ArrayLike, poisson: ArrayLike) -> tuple[Array, Array, Array]:
    E, rho = (_checks.positive(name, x) for name, x in (("young", young), ("density", density)))
    nu = _checks.real_array("poisson", poisson, ())
    if concrete(nu) and not -1 < float(nu) <= 0.5:
        raise ValueError(f"poisson must be above -1 and at most 0.5, got {float(nu)}")
    return E, rho, nu


def _section(
    rho: Array, A: Array, second: tuple[Array, Array], E: Array, shear: Array, factor: Array, torsion: Array
) -> Section:
    side, bent = factor * shear * A, [E * x for x in second]
    return Section(
        rho * A,
        jnp.stack([rho * x for x in second], axis=-1),
        jnp.stack([side, side, E * A], axis=-1),
        jnp.stack([*bent, shear * torsion], axis=-1),
    )


class _FromNaturalShape:
    """The state of a rod, by default its natural shape at rest."""

    natural: Array

    @explained
    def state(
        self,
        positions: ArrayLike | None = None,
        attitudes: _checks.Attitude | None = None,
        *,
        velocities: ArrayLike | None = None,
        angular_velocities: ArrayLike | None = None,
        t: ArrayLike | None = None,
        work: ArrayLike | None = None,
    ) -> State:
        """The state of a rod, by default its natural shape at rest.

        Args:
            positions: of the centers of the N sections that move, (N, 3); by default those of the natural shape.
            attitudes: of these sections, as in `rigid_bodies(…).state`; by default those of the natural shape.
            velocities, angular_velocities, t, work: as in `rigid_bodies(…).state`.

        Raises:
            ValueError: a wrong shape, a NaN, an attitude that is not a rotation, two sections at the same position, an
                element that turns too far from its natural shape.
        """
        x = self.natural[:, :3] if positions is None else positions
        q = self.natural[:, 3:] if attitudes is None else attitudes
        more = {"velocities": velocities, "angular_velocities": angular_velocities, "t": t, "work": work}
        return super().state(x, q, **more)  # pyright: ignore[reportAttributeAccessIssue]


@pytree
class ElasticRod(_FromNaturalShape, RigidBodies):
    """A rod without damping and loads, its ends free or clamped. Made by `rod`.

    Attributes:
        natural: the poses of the sections that move in the natural shape, (N, 7); the others are of these sections too.
    """

    natural: Array


@pytree
class DissipativeRod(_FromNaturalShape, DissipativeBodies):
    """A rod with damping, loads or driven ends. Made by `rod`."""

    natural: Array = dataclasses.field(kw_only=True)  # as in `ElasticRod`


@pytree
class KelvinVoigt(ChainLaw):
    """Internal damping of a rod: forces and moments opposite to the rates of its strains."""

    rod: potentials.Rod | potentials.Held  # perhaps with ends held
    strain: Array  # the viscosity of Γ, (elements, 3)
    bend: Array  # that of s, (elements, 3)

    def act(
        self, t: Time | None, x: Positions, R: Rotations, v: Positions, omega: Positions
    ) -> tuple[PoseMomenta, Scalar]:
        """The forces and torques (N, 6), and their power, which is −Σ of viscosity times rate² if no end is driven."""
        spun = jnp.cross(omega[:, :, None], R, axis=1)
        driven = potentials.is_driven(self.rod)
        given, moving = jax.jvp(self.rod.poses, (t,), (1 + 0 * t,)) if driven else ((), ())  # pyright: ignore
        _, (stretched, bent, opened) = jax.jvp(self.rod.invariants, (x, R, *given), (v, spun, *moving))
        stress = self.strain * stretched, self.bend * bent, jnp.zeros_like(opened)
        along_x, along_R = jax.vjp(lambda x, R: self.rod.invariants(x, R, *given), x, R)[1](stress)
        force, torque = -along_x, potentials.torques(R, along_R)
        lost = -jnp.sum(stress[0] * stretched + stress[1] * bent)
        power = jnp.sum(force * v + torque * omega) if driven else lost
        return jnp.concatenate([force, torque], axis=1), power


@pytree
class Loads:
    """Forces and moments on sections, functions of time: the `forces` of bodies."""

    loads: tuple[Callable[[Array], Array], ...]  # t ↦ (force, moment) in space, (6,), each
    bodies: tuple[int, ...] = static()  # the section on which each acts
    more: Callable[..., PyTree] | None = None  # a further function of the signature of `forces`

    def __call__(
        self, t: Time, x: Positions, R: Rotations, v: Positions, omega: Positions
    ) -> tuple[Positions, Positions]:
        here = jnp.arange(len(x))[:, None]
        both = jnp.zeros((len(x), 6), x.dtype)
        for body, load in zip(self.bodies, self.loads, strict=True):
            both = both + jnp.where(here == body, load(t).astype(x.dtype)[None], 0)
        if self.more is None:
            return both[:, :3], both[:, 3:]
        forces, torques = self.more(t, x, R, v, omega)
        return both[:, :3] + forces, both[:, 3:] + torques


def rod(
    length: ArrayLike,
    elements: int,
    section: Section,
    *,
    natural_curvature: ArrayLike = 0.0,
    ends: tuple[End, End] = ("free", "free"),
    pose: ArrayLike | None = None,
    gravity: ArrayLike | None = None,
    damping: ArrayLike = 0.0,
    loads: Mapping[int, Callable[[Array], Array]] | None = None,
    forces: Callable[..., PyTree] | None = None,
    energy: str = "fourth",
) -> ElasticRod | DissipativeRod:
    """A geometrically exact rod that bends, twists, shears and stretches, as a chain of rigid cross sections.

    The sections are bodies as in `rigid_bodies`, their third axes along the rod in the natural shape, with the masses
    and inertias of the halves of their elements. `schemes.bodies_energy_momentum` conserves H, and of a free rod P and
    L, to round-off; `splitting` and `nystrom` conserve the symplectic form. The error of a shape is of second order in
    the length of an element.

    Args:
        length: of the rod in its natural shape, or the lengths of its elements, (elements,).
        elements: their number; there are elements + 1 sections, numbered from 0.
        section: `circular_section(…)`, `rectangular_section(…)` or `Section(…)`.
        natural_curvature: two curvatures and the twist in the axes of the sections, per unit of length, (3,) or
            (elements, 3); 0 for a straight rod.
        ends: of the first and the last section: "free"; "clamped" at its pose in the natural shape, or at a given pose
            (x, y, z, qw, qx, qy, qz), (7,); or driven, a function t ↦ pose (7,) that JAX can trace. The sections that
            are not free are no bodies: N counts the others.
        pose: of the first section in the natural shape, (7,); by default where the first end is held, otherwise the
            origin with the rod along z.
        gravity: the acceleration of gravity, (3,); by default none.
        damping: the retardation time τ of a Kelvin–Voigt material, whose stress is that of the strain plus τ times its
            rate; a scalar, or one for each of two shears, extension, two bendings and torsion, (6,); ≥ 0.
        loads: dead loads {section: t ↦ (force, moment)}, (6,), in space, such as {-1: lambda t: …} at the last one.
        forces: other forces and torques on the sections that move, as in `rigid_bodies`: loads that follow the rod,
            drag.
        energy: "fourth" or "directors", see `potentials.rod`.

    Returns:
        An `ElasticRod`, or a `DissipativeRod` with damping, loads, forces or a driven end, which only
        `schemes.bodies_energy_momentum` integrates; `State.work` counts the work of all of these. `.state()` is the
        natural shape at rest.

    Raises:
        ValueError: shapes disagree, a length or a mass is not positive, a stiffness or a damping is negative, an end is
            of no known kind, a load acts on a section that is not free.

    Source: Simo 1985, Comput. Methods Appl. Mech. Eng. 49; Romero & Armero 2002, Int. J. Numer. Methods Eng. 54.
    """
    n = _checks.count("elements", elements, 1)
    if not isinstance(section, Section):
        raise ValueError(f"section must be circular_section(…), rectangular_section(…) or Section(…), got {section!r}")
    ell = _checks.positive("length", length, (), (n,))
    ell = jnp.full(n, ell / n) if ell.ndim == 0 else ell
    mass, inertia = _along("section.mass", section.mass, n, ()), _along("section.inertia", section.inertia, n, (2,))
    stretching = _along("section.stretching", section.stretching, n, (3,))
    bending = _along("section.bending", section.bending, n, (3,))
    curvature = _checks.real_array("natural_curvature", natural_curvature, (), (3,), (n, 3))
    internal = potentials.rod(ell, stretching, bending, curvature, energy=energy)
    if not isinstance(ends, Sequence) or isinstance(ends, str) or len(ends) != 2:
        raise ValueError(f"ends must be a pair, each {_ENDS}, got {ends!r}")
    first, last = (_end(k, end) for k, end in enumerate(ends))
    whole = _natural_shape(internal, _first_pose(pose, first))
    first, last = (whole[k] if isinstance(end, str) else end for k, end in ((0, first), (-1, last)))
    free = slice(int(first is not None), n + 1 - (last is not None))
    moving = np.arange(n + 1)[free]
    if not len(moving):
        raise ValueError(f"a rod of {n} element(s) with both ends held has no section that moves: use more elements")
    m, J = (x[free] for x in _lumped(ell, mass, inertia))
    potential, held = internal, partial(_held, first=first, last=last)
    if gravity is not None:
        weights = jnp.zeros(n + 1).at[free].set(m)
        potential = internal + potentials.uniform_field(_checks.real_array("gravity", gravity, (3,)), weights)
    law = _damping(held(internal), damping)
    given = None if loads is None and forces is None else _loads(loads or {}, forces, moving, n)
    made: Any = rigid_bodies(m, J, held(potential), law, forces=given)  # pyright: ignore
    kind = ElasticRod if isinstance(made, RigidBodies) else DissipativeRod
    return kind(**vars(made), natural=whole[free])


PROPERTIES = SystemProperties(
    name="rod",
    models="an elastic rod that bends, twists, shears and stretches",
    phase_space="(T*ℝ³ × T*SO(3))ᴺ: poses (N, 7), momenta (N, 6) of its sections",
    conserves=("energy (without damping, loads and driven ends)", "energy less work", "momentum (of a free rod)"),
    momentum="P and L about the origin of a free rod, or the components that gravity leaves; 0 with an end held",
    sizes=(6, 0),
    aliases=("geometrically exact beam", "Cosserat rod", "Simo–Reissner beam"),
    source="Simo 1985, Comput. Methods Appl. Mech. Eng. 49",
)


def _along(name: str, value: ArrayLike, n: int, shape: tuple[int, ...]) -> Array:
    """A number of a section for every element, (n, …)."""
    return jnp.broadcast_to(_checks.real_array(name, value, shape, (n, *shape)), (n, *shape))


def _end(k: int, end: Any) -> Any:
    """None for a free end, "clamped", a pose or a motion."""
    if isinstance(end, str):
        if end not in ("free", "clamped"):
            raise ValueError(f"ends[{k}] must be {_ENDS}, got {end!r}")
        return None if end == "free" else end
    if not callable(end):
        return _pose(f"ends[{k}]", end)
    _checks.function(f"ends[{k}]", end, "the time t", (7,), jnp.zeros(()))
    _pose(f"ends[{k}] at t = 0", jnp.asarray(end(jnp.zeros(()))))
    return end


def _pose(name: str, pose: ArrayLike) -> Array:
    """A pose (7,), with a unit quaternion."""
    x = _checks.real_array(name, pose, (7,))
    return jnp.concatenate([x[:3], _checks.unit_quaternion(name, x[3:], (4,))])


def _first_pose(pose: ArrayLike | None, first: Any) -> Array:
    """That of the first section in the natural shape."""
    if pose is not None:
        return _pose("pose", pose)
    if first is None or isinstance(first, str):
        return jnp.array(_START)
    return jnp.asarray(first(jnp.zeros(())) if callable(first) else first)


@partial(compiled, once=True)
def _natural_shape(internal: potentials.Rod, first: Array) -> Array:
    return internal.natural_shape(first.astype(internal.lengths.dtype))


@partial(compiled, once=True)
def _lumped(ell: Array, mass: Array, inertia: Array) -> tuple[Array, Array]:
    """Masses (n + 1,) and principal moments (n + 1, 3) of the sections: the halves of their elements."""

    def halves(per_length: Array) -> Array:
        half = ell.reshape(-1, *[1] * (per_length.ndim - 1)) * per_length / 2
        none = jnp.zeros_like(half[:1])
        return jnp.concatenate([half, none]) + jnp.concatenate([none, half])

    return halves(mass), halves(jnp.concatenate([inertia, inertia.sum(1, keepdims=True)], axis=1))


def _held(potential: potentials.Potential, first: Any, last: Any) -> Any:
    return potential if first is None and last is None else potentials.held(potential, first, last)


def _damping(internal: Any, damping: ArrayLike) -> KelvinVoigt | None:
    tau = _checks.not_negative("damping", damping, (), (6,))
    if concrete(damping) and not np.any(np.asarray(damping)):  # as given: inside jit tau is traced
        return None
    chain = internal if isinstance(internal, potentials.Rod) else internal.potential
    tau, ell = jnp.broadcast_to(tau, 6), chain.lengths[:, None]
    return KelvinVoigt(internal, tau[None, :3] * ell * chain.stretching, tau[None, 3:] * chain.bending / ell)


def _loads(loads: Any, forces: Any, moving: np.ndarray, n: int) -> Any:
    if not isinstance(loads, Mapping):
        raise ValueError(f"loads must be {{section: t ↦ (force, moment) (6,)}}, got {loads!r}")
    bodies = []
    for section, load in loads.items():
        number = section + n + 1 if section < 0 else section
        if number not in moving:
            raise ValueError(
                f"loads act on sections that move, {moving[0]} to {moving[-1]} of 0 to {n}, got one on {section}"
            )
        _checks.function(f"loads[{section}]", load, "the time", (6,), jax.ShapeDtypeStruct((), jnp.result_type(float)))
        bodies.append(int(number - moving[0]))
    if not bodies:
        return forces
    return Loads(
        tuple(callable_pytree(load) for load in loads.values()),
        tuple(bodies),
        None if forces is None else callable_pytree(forces),
    )


def examples() -> dict[str, tuple[ElasticRod | DissipativeRod, State, float]]:
    """A bent and twisted rod in free flight; a damped cantilever with a load on its tip and a driven foot."""
    soft = Section(1.0, (0.02, 0.03), (20.0, 20.0, 30.0), (0.5, 0.7, 0.6))
    free = rod(1.0, 2, soft, natural_curvature=(0.5, 0.2, 0.8))
    thrown = free.state(
        velocities=[[0.1, 0, 0], [0, -0.2, 0.1], [0.2, 0.1, 0]],
        angular_velocities=[[1, 0.3, 0], [0, 0, 0.5], [0, 1, 0]],
    )
    mast = rod(1.0, 2, soft, ends=(_shaken, "free"), gravity=(0, 0, -1.0), damping=0.01, loads={-1: _pull})
    return {"free": (free, thrown, 0.01), "shaken": (mast, mast.state(), 0.01)}


def _shaken(t: Array) -> Array:
    """A foot that moves and tilts."""
    half = 0.05 * jnp.sin(2 * t)
    zero = jnp.zeros_like(t)
    return jnp.stack([0.1 * jnp.sin(3 * t), zero, zero, jnp.cos(half), zero, jnp.sin(half), zero])


def _pull(t: Array) -> Array:
    zero = jnp.zeros_like(t)
    return jnp.stack([0.1 * jnp.cos(t), zero, zero, zero, 0.3 * jnp.sin(t), zero])
