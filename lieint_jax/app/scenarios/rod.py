"""An elastic rod with loads that end: energy less work, its momenta in free flight, and its shape in time."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from pydantic import Field

from lieint_jax import systems
from lieint_jax.app.scenarios import _keys as keys
from lieint_jax.app.scenarios._kind import Kind, picture
from lieint_jax.app.scenarios._pictures import draw_balance, draw_chain
from lieint_jax.app.scenarios._report import ROUND_OFF, Conserved, Quantity
from lieint_jax.app.scenarios._runs import energy, length, positive, series
from lieint_jax.runs import Run
from lieint_jax.systems import DissipativeRod, ElasticRod
from lieint_jax.types import State, energy_less_work

_End = Literal["free", "clamped"]


class Section(keys.Table):
    """A cross section, in its axes 1 and 2; the axis 3 is along the rod."""

    mass: keys.PositiveFloat
    """Per unit of length."""
    inertia: keys.Pair
    """About the axes 1 and 2, per unit of length."""
    stretching: keys.PositiveTriple
    """The stiffness GA₁, GA₂ against shear and EA against extension."""
    bending: keys.PositiveTriple
    """The stiffness EI₁, EI₂ against bending and GJ against torsion."""


class Load(keys.Table):
    """A force and a moment on a section, in space, times a function of time."""

    section: int
    """The section on which they act: 0 is the first, -1 the last."""
    force: keys.Triple = [0.0, 0.0, 0.0]
    """In mass × length / time_unit²."""
    moment: keys.Triple = [0.0, 0.0, 0.0]
    """In mass × length² / time_unit²."""
    times: Annotated[list[keys.NonNegative], Field(min_length=2)]
    """Increasing times, in time_unit, between which the factor is linear; there is no load outside them."""
    factors: list[float]
    """The factor of force and moment at each of the times."""

    def _check_times(self) -> None:
        if len(self.factors) != len(self.times) or not np.all(np.diff(self.times) > 0):
            raise ValueError("times must increase, and factors must have as many numbers")

    def impulse(self) -> np.ndarray:
        """That of the force, (3,)."""
        t, size = np.array(self.times), np.array(self.factors)
        return np.sum(np.diff(t) * (size[1:] + size[:-1])) / 2 * np.array(self.force)


def _act(times: Array, factors: Array, load: Array, t: Array) -> Array:
    """Force and moment of a load at a time, (6,)."""
    return jnp.interp(t, times, factors, left=0, right=0) * load


class Rod(Kind):
    """The keys of a scenario of this kind."""

    length: keys.PositiveFloat
    """The length of the rod in its natural shape."""
    elements: Annotated[int, Field(gt=0, le=1000)]
    """The number of elements, between elements + 1 sections."""
    section: Section
    natural_curvature: keys.Triple = [0.0, 0.0, 0.0]
    """Two curvatures and the twist of the natural shape, in rad per unit of length."""
    position: keys.Triple = [0.0, 0.0, 0.0]
    """The position of the first section in the natural shape, in which the rod starts at rest."""
    quaternion: keys.Quaternion = [1.0, 0.0, 0.0, 0.0]
    """The attitude (w, x, y, z) of the first section there; with [1, 0, 0, 0] the rod is along z."""
    ends: Annotated[list[_End], Field(min_length=2, max_length=2)] = ["free", "free"]
    """The first and the last end: "free", or "clamped" in the natural shape."""
    gravity: keys.Triple | None = None
    """The acceleration of gravity, in length / time_unit²; by default none."""
    damping: keys.PositiveFloat | None = None
    """The retardation time of a Kelvin–Voigt material, in time_unit; by default none."""
    loads: list[Load] = []
    """Forces and moments on sections, at most one load for each."""
    scheme: Literal["bodies_energy_momentum"] = "bodies_energy_momentum"
    order: keys.Order = 2
    spread: keys.NumberSpread = keys.NumberSpread()
    certified = False
    fixed: ClassVar[dict[str, str]] = Kind.fixed | {
        "quaternion": "all members start with the same attitude",
        "loads.*.times": "all members are loaded at the same times",
        "loads.*.factors": "give force and moment a spread instead",
    }

    def _check_loads(self) -> None:
        at = [load.section % (self.elements + 1) for load in self.loads]
        if len(set(at)) < len(at):
            raise ValueError("loads: two act on the same section: give one load for each section")

    def make_system(self) -> ElasticRod | DissipativeRod:
        """Its loads are pytrees, so that members may have loads of their own."""
        loads = {
            load.section: Partial(
                _act, jnp.array(load.times), jnp.array(load.factors), jnp.array([*load.force, *load.moment])
            )
            for load in self.loads
        }
        section = {name: keys.array(value) for name, value in self.section}
        first, last = self.ends
        return systems.rod(
            self.length,
            self.elements,
            systems.Section(**section),
            natural_curvature=keys.array(self.natural_curvature),
            ends=(first, last),
            pose=keys.array([*self.position, *self.quaternion]),
            gravity=None if self.gravity is None else keys.array(self.gravity),
            damping=0.0 if self.damping is None else self.damping,
            loads=loads or None,
        )

    def start(self, system: ElasticRod | DissipativeRod, noise: Any) -> State:
        return system.state()

    def in_flight(self, run: Run) -> np.ndarray:
        """Whether the rod is free at each saved time: no end held, no gravity, all loads over, (times,)."""
        over = max((load.times[-1] for load in self.loads), default=-np.inf)
        return (np.asarray(run.t) >= over) & (self.ends == ["free", "free"] and self.gravity is None)

    def conserved(self, run: Run) -> list[Conserved]:
        """Energy less work, and P and L in free flight."""
        H, balance = series(energy, run), series(energy_less_work, run)
        name = "energy" if run.state.work is None else "energy less work"
        found = [Conserved(f"{name}, relative", balance, positive(abs(H).max(axis=0)), ROUND_OFF)]
        flying = self.in_flight(run)
        if flying.any():
            momentum = series(_momentum, run)[flying]
            for symbol, x in (("P", momentum[..., :3]), ("L", momentum[..., 3:])):
                found.append(Conserved(f"{symbol} in free flight, relative", x, positive(length(x[0])), ROUND_OFF))
        return found

    def quantities(self, run: Run) -> list[Quantity]:
        """The work, the momenta at the end, with the impulse of the loads as the closed form of P, and the bend."""
        q = np.asarray(run.state.q)[..., 3:]
        turns = 2 * np.arccos(np.clip(abs(np.sum(q[:, :, 1:] * q[:, :, :-1], axis=-1)), 0, 1))
        found = [Quantity("largest turn of an element (°)", np.rad2deg(turns).max(axis=(0, 2)))]
        if run.state.work is not None:
            found.append(Quantity("work of loads and damping", np.asarray(run.state.work)[-1]))
        if self.in_flight(run)[-1]:
            momentum = series(_momentum, run)[-1]
            impulse = float(length(sum((load.impulse() for load in self.loads), np.zeros(3))))
            found.append(Quantity("|P| at the end; impulse of the loads", length(momentum[:, :3]), closed_form=impulse))
            found.append(Quantity("|L| at the end", length(momentum[:, 3:])))
        return found

    @picture(rows=2, size=(8.0, 2.2), sharex=True)
    def draw_shape(self, axes: np.ndarray, run: Run) -> None:
        """Plot the line of centers of the nominal member at several times, in two of the planes of the space axes."""
        draw_chain(axes, np.asarray(run.t), np.asarray(run.member(0).state.q)[..., :3], "the nominal rod")

    @picture(2)
    def draw_energy(self, axes: np.ndarray, run: Run) -> None:
        """Plot the change of energy and the work in time, and the change of energy less work."""
        H, work = series(energy, run), run.state.work
        works = np.zeros_like(H) if work is None else np.asarray(work)
        draw_balance(axes, np.asarray(run.t), H, works[..., None], ["work"], time_unit=self.time_unit)


def _momentum(system: ElasticRod | DissipativeRod, state: State) -> Array:
    """P and L, (6,), of a rod with loads too."""
    return (system.conservative if isinstance(system, DissipativeRod) else system).momentum(state)
