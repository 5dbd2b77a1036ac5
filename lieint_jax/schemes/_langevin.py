"""Langevin dynamics of rigid bodies: the canonical measure by exact flows, with an exact account of the heat.

    B: π ← π + ½Δt τ(Λ)     A: the exact free motion for ½Δt     O: Π_i ← e^{−γ_iΔt}Π_i + √(kT J_i(1 − e^{−2γ_iΔt})) ξ_i

in the order B A O A B, and likewise for centers and linear momenta with m in place of J. O is the exact flow of
friction and noise, and leaves exp(−½Π·J⁻¹Π/kT) invariant; so does A, which conserves T and the volume. Without a
potential the sampling is exact for any Δt; with a potential its bias is O(Δt²). The heat Q grows by the change of the
kinetic energy in O, so that H − Q changes in A and B only, by the error of the splitting without noise.

The Metropolized scheme is O(½Δt), then B A B, accepted with the probability min(1, exp(−ΔH/kT)) and otherwise replaced
by π ← −π, then O(½Δt). As B A B conserves the volume and is its own inverse up to the sign of π, the scheme samples the
canonical measure without a bias for any Δt.
"""

from __future__ import annotations

from dataclasses import field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._checks import concrete
from lieint_jax._numerics import random_bits
from lieint_jax.core import Converted, State, Step, StepInfo, System, argument, pytree, static
from lieint_jax.schemes._catalogue import SchemeProperties
from lieint_jax.schemes._exact import exact
from lieint_jax.schemes._shared.stages import compose_stages
from lieint_jax.schemes._shared.thermalized import thermalized
from lieint_jax.schemes._splitting import Splitting, kick
from lieint_jax.systems._equations import (
    AbstractForcedSystem,
    AbstractFreeBodies,
    AbstractFreeBody,
    AbstractRigidBodies,
    AbstractTop,
)

__all__ = ["Langevin", "langevin"]

_KEY, _COUNT, _HEAT, _REJECTIONS = "key", "step", "heat", "rejections"
_MOST = 2**32  # steps with noise of their own

PROPERTIES = SchemeProperties(
    name="langevin",
    systems="free bodies, tops, several bodies, in a heat bath",
    conserves=("canonical measure (free bodies, or metropolis)",),
    symmetric=False,
    limit="that of the potential's frequencies, Δtω < 2",
    aliases=("BAOAB", "Langevin thermostat", "GHMC"),
    source="Leimkuhler & Matthews 2013; Davidchack, Handel & Tretyakov 2009; Bou-Rabee & Owhadi 2010",
    accepts=(AbstractFreeBody, AbstractTop, AbstractFreeBodies, AbstractRigidBodies),
)


@pytree
class Langevin(Step):
    """Langevin dynamics (BAOAB, or Metropolized): bodies in a heat bath, with an exact account of the heat.

    | | |
    |---|---|
    | canonical measure | exact for free bodies; in a potential with a bias O(Δt²), none with `metropolis` |
    | heat Q, `State.extra["heat"]` | exact: H − Q changes by the error of the noiseless splitting, O(Δt³) per step |
    | the same random numbers | in runs that are resumed, split, sharded, or compiled to machine code |

    States carry a key: `state = step.start(state, key=jax.random.key(0))`. For ensembles with a leading member axis the
    same call gives each member its own key. `diagnostics.certify` reports what can be certified.

    Args:
        system: `systems.rigid_body`, `heavy_top`, `potential_top`; `rigid_bodies` without dissipation, or its `.free`.
        temperature: kT, in units of energy, > 0.
        friction: rates γ ≥ 0. A number; or (3,), the rates about the principal axes of bodies with principal moments,
            which for several bodies are also those of the motion of the centers along these axes; or, for several
            bodies, (6,), the rates of the centers, then those of the rotations. Friction about axis 1 alone does not
            sample the canonical measure of a free body: it conserves (1/J₂ − 1/J₁)Π₂² + (1/J₃ − 1/J₁)Π₃².
        metropolis: whether to accept or reject each step by its change of energy; `State.extra["rejections"]` counts
            rejected steps.

    Raises:
        ValueError: the system is none of these, the temperature is not positive, a friction is negative, or several
            rates are given for a full tensor of inertia.

    Example:
        >>> import lieint_jax as li
        >>> body = li.systems.rigid_body([1.0, 1.7, 2.2])
        >>> step = langevin(body, temperature=1.0, friction=0.5)
        >>> state = step.start(body.state(angular_velocity=[0.1, 0.2, 0.3]), key=7)
        >>> end = li.integrate(step, state, 0.1, 10, save_every=10).state
        >>> gained = jax.vmap(body.energy)(end)[-1] - body.energy(state)
        >>> bool(abs(gained - end.extra["heat"][-1]) < 1e-5)
        True

    Source: Leimkuhler & Matthews 2013, Appl. Math. Res. Express; for rigid bodies Davidchack, Handel & Tretyakov 2009,
    J. Chem. Phys. 130; Metropolized: Bou-Rabee & Owhadi 2010, SIAM J. Numer. Anal. 48.
    """

    system: Any = argument(converter=PROPERTIES.check)
    drift: Step = field(init=False)  # the exact step of the free motion
    temperature: ArrayLike
    friction: npt.ArrayLike
    metropolis: Converted[bool] = static(converter=bool, default=False)
    order: float = static(default=2, init=False)
    symmetric: bool = static(default=False, init=False)

    def check_fields(self) -> dict[str, object]:
        free: Any = self.system.free if isinstance(self.system, AbstractForcedSystem) else self.system
        kT = _checks.real_array("temperature", self.temperature, ())
        if concrete(kT) and not float(kT) > 0:
            raise ValueError(f"temperature must be positive, kT in units of energy, got {float(kT):g}")
        many = isinstance(free, AbstractFreeBodies)
        rates = _checks.real_array("friction", self.friction, (), (3,), *([(6,)] if many else []))
        if concrete(rates) and not np.all(np.asarray(rates) >= 0):
            raise ValueError(f"friction must be ≥ 0, a rate, got {np.asarray(rates)}")
        J = free.inertias if many else free.inertia
        if rates.ndim and J.ndim > (2 if many else 1):
            raise ValueError("several rates of friction are about principal axes: give principal moments, or one rate")
        return {"drift": exact(free), "temperature": kT, "friction": rates}

    @property
    def name(self) -> str:
        return "langevin[metropolis]" if self.metropolis else "langevin"

    @property
    def deterministic(self) -> Step:
        return Splitting(self.system, self.drift) if isinstance(self.system, AbstractForcedSystem) else self.drift

    @property
    def free(self) -> Langevin:
        """The same thermostat for the bodies without their potential."""
        return Langevin(self.drift.system, self.temperature, self.friction, self.metropolis)

    def start(self, state: State, key: Any = None, first: int = 0) -> State:
        """`state` with a key, the number of steps so far, and the heat so far: `State.extra["key", "step", "heat"]`.

        A state that has a key uses it again unless another is given. Random numbers depend only on the key and the
        number of the step, so a run that is resumed, split into parts, sharded, or computed by another number of
        processes has the same bits.

        Args:
            state: the state of one body or system; or the states of an ensemble, with a leading member axis on all
                leaves except t.
            key: a key from `jax.random.key(seed)`, or a seed, an integer; by default the seed 0. Members of an ensemble
                have the keys `fold_in(key, member)`.
            first: the number of the first of these members, if they are a part of a larger ensemble.

        Raises:
            ValueError: `key` is neither a key of `jax.random` nor a seed.
        """
        extra, dtype = state.extra or {}, state.p.dtype
        if key is None and _KEY in extra:
            return state
        made = _checked_key(0 if key is None else key)
        axes = state.p.shape[: state.p.ndim - self.system.phase_space.origin.p.ndim]
        if axes:
            members = jnp.arange(first, first + axes[0])
            digits = jax.vmap(lambda i: random_bits.digits(jax.random.fold_in(made, i), dtype))(members)
        else:
            digits = random_bits.digits(made, dtype)
        counts = (_COUNT, _HEAT, _REJECTIONS) if self.metropolis else (_COUNT, _HEAT)
        return state._replace(extra={**extra, _KEY: digits, **{name: jnp.zeros(axes, dtype) for name in counts}})

    def advance(self, state: State, dt: ArrayLike) -> tuple[State, StepInfo]:
        n = self._extra_entry(state, _COUNT)
        key = random_bits.fold_in(random_bits.key_of(self._extra_entry(state, _KEY)), random_bits.word(n))
        state, info = (self._metropolis if self.metropolis else self._baoab)(state, jnp.asarray(dt), key)
        counted = (n >= 0) & (n + 1 > n) & (n < _MOST) & random_bits.are_digits(self._extra_entry(state, _KEY))
        counted &= jnp.asarray(dt) >= 0
        end = self._add_to_extra(state, **{_COUNT: 1})
        return end, info._replace(converged=info.converged & counted)

    def _baoab(self, state: State, dt: Array, key: random_bits.Key) -> tuple[State, StepInfo]:
        noise = random_bits.normal(key, 0, state.p.size, state.p.dtype)

        def stage(state: State, first: Array) -> tuple[State, StepInfo]:
            """A, then O if this is the first A; as a loop over both A, so that their long program is compiled once."""
            state, info = self.drift.substep(state, 0.5 * dt)
            thermal = self._thermalize(state, dt, noise)
            return jax.tree.map(lambda x, y: jnp.where(first, x, y), thermal, state), info

        state, info = compose_stages(stage, self._kick(state, 0.5 * dt), (jnp.array([True, False]),))
        return self._kick(state, 0.5 * dt), info

    def _metropolis(self, state: State, dt: Array, key: random_bits.Key) -> tuple[State, StepInfo]:
        many, dtype = state.p.size, state.p.dtype
        used = random_bits.draws_of(many)
        start = self._thermalize(state, 0.5 * dt, random_bits.normal(key, 0, many, dtype))
        moved, info = self.deterministic.substep(start, dt)
        rise = self.system.energy(moved) - self.system.energy(start)
        u = random_bits.uniform(key, jnp.arange(2 * used, 2 * used + 1, dtype=jnp.uint32), dtype)[0]
        accepted = self.temperature * jnp.log(u) <= -rise  # a step that ends in NaN is not
        end = start._replace(q=jnp.where(accepted, moved.q, start.q), p=jnp.where(accepted, moved.p, -start.p))
        end = self._add_to_extra(end, **{_REJECTIONS: 1 - accepted.astype(dtype)})
        return self._thermalize(end, 0.5 * dt, random_bits.normal(key, used, many, dtype)), info

    def _kick(self, state: State, dt: Array) -> State:
        return kick(self.system, state, dt) if isinstance(self.system, AbstractForcedSystem) else state

    def _thermalize(self, state: State, dt: Array, noise: Array) -> State:
        """O: the state after friction and noise for a time, with the heat that they add."""
        bodies: Any = self.drift.system
        if state.p.ndim == 1:
            friction, kT = map(jnp.asarray, (self.friction, self.temperature))
            p, gained = thermalized(state.q, bodies.inertia, state.p, noise, friction, dt, kT)
        else:
            p, gained = self._thermalize_bodies(bodies, state, noise.reshape(-1, 6), dt)
        return self._add_to_extra(state._replace(p=p), **{_HEAT: gained})

    def _thermalize_bodies(self, bodies: Any, state: State, noise: Array, dt: Array) -> tuple[Array, Array]:
        """The momenta of several bodies after friction and noise, and the kinetic energy gained."""
        masses = bodies.masses[:, None] * jnp.ones_like(state.p[:, :3])
        friction, kT = map(jnp.asarray, (self.friction, self.temperature))
        rates = (friction[:3], friction[3:]) if friction.shape == (6,) else (friction,) * 2
        over_bodies = jax.vmap(thermalized, (0, 0, 0, 0, None, None, None))
        (moved, first), (turned, second) = (
            over_bodies(state.q[:, 3:], J, state.p[:, own], noise[:, own], rate, dt, kT)
            for J, own, rate in zip((masses, bodies.inertias), (slice(3), slice(3, 6)), rates, strict=True)
        )
        return jnp.concatenate([moved, turned], axis=1), jnp.sum(first) + jnp.sum(second)

    def _extra_entry(self, state: State, name: str) -> Array:
        extra = state.extra or {}
        if name not in extra or (self.metropolis and _REJECTIONS not in extra):
            raise ValueError(
                f"{self.name} needs a key and counts in state.extra: use step.start(state, key=jax.random.key(0))"
            )
        shape, found = (random_bits.DIGITS,) if name == _KEY else (), jnp.shape(extra[name])
        if found != shape:
            raise ValueError(f'state.extra["{name}"] must have shape {shape}, got {found}; use jax.vmap for batches')
        return extra[name]

    def _add_to_extra(self, state: State, **more: Any) -> State:
        """The state with these increments of entries of `extra`."""
        extra = dict(state.extra or {})
        return state._replace(extra=extra | {name: extra[name] + x for name, x in more.items()})

    def check(self, state: State, dt: ArrayLike) -> None:
        """Raise ValueError if a concrete `state` or `dt` is out of range, or the state's key or counts are none."""
        for name in (_KEY, _COUNT, _HEAT, *([_REJECTIONS] if self.metropolis else [])):
            _checks.real_array(f'state.extra["{name}"]', self._extra_entry(state, name))
        key = self._extra_entry(state, _KEY)
        if concrete(key) and not bool(random_bits.are_digits(np.asarray(key))):
            raise ValueError(f'state.extra["{_KEY}"] must be a key, as step.start(state, key=…) makes it, got {key}')
        super().check(state, dt)

    def advice(self, state: State, dt: ArrayLike) -> str:
        if float(dt) < 0:  # pyright: ignore[reportArgumentType]
            return f"{self.name} has no step back, got dt = {dt}: friction and noise have no inverse. Use dt > 0"
        return f"{self.name}: {self.deterministic.advice(state, dt)}"


def _checked_key(key: Any) -> Array:
    """A key of `jax.random`, from a key or from a seed; ValueError if it is neither."""
    seed = _checks.integer(key)
    if seed is not None:
        return jax.random.key(seed)
    typed = isinstance(key, Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    words: Any = jax.random.key_data(key) if typed else key
    if not isinstance(words, Array | np.ndarray) or words.shape != (2,) or words.dtype != jnp.uint32:
        raise ValueError(
            f"key must be jax.random.key(seed), of two words (threefry2x32), or a seed, got {key!r}. "
            "step.start(states, key=…) gives each member of an ensemble its own key"
        )
    return jax.random.wrap_key_data(jnp.asarray(words), impl="threefry2x32")


@PROPERTIES.by_name
def examples(system: System) -> list[Step]:
    """The thermostat of tops and several bodies."""
    return [langevin(system, 0.1, 0.5)] if isinstance(system, AbstractTop | AbstractRigidBodies) else []


langevin = Langevin
