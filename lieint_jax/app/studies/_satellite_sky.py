"""The scene of the study of a satellite: facets, motion, directions to Sun and observer, exposures, minima of light."""

from __future__ import annotations

from importlib import resources
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from pydantic import Field

from lieint_jax import schemes
from lieint_jax.app import scenarios
from lieint_jax.app.scenarios._body import direction
from lieint_jax.app.scenarios._keys import Direction, NonNegative, Table
from lieint_jax.groups import so3
from lieint_jax.measure import glossy_brightness
from lieint_jax.runs import Event, events
from lieint_jax.runs import store as archives
from lieint_jax.shapes import GlossyFacets
from lieint_jax.systems import RigidBody, rigid_body
from lieint_jax.types import State


class Facet(Table):
    """A row of a table of facets."""

    name: str = ""
    normal: Direction
    """Outward, in body axes, of any length."""
    area_m2: NonNegative
    diffuse: NonNegative
    """Lambert's albedo."""
    specular: NonNegative
    """The height of the lobe, on the scale of `diffuse`."""
    exponent: Annotated[float, Field(ge=1)]
    """The exponent of the lobe's cosine."""


def facets(rows: list[dict[str, Any]]) -> GlossyFacets:
    """A table of facets from rows with the keys of `Facet`; ValueError for none, or for a wrong row."""
    if not rows:
        raise ValueError("a body of facets needs at least one facet")
    found = [scenarios.validate(Facet, row, f"facet {row.get('name', k)!r}") for k, row in enumerate(rows)]
    normal = np.array([facet.normal for facet in found])
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    columns = zip(*((x.area_m2, x.diffuse, x.specular, x.exponent) for x in found), strict=True)
    return GlossyFacets(jnp.asarray(normal), *map(jnp.array, columns))


def magnitude(body: GlossyFacets, q: Array, sun: Array, observer: Array) -> Array:
    """−2.5 log₁₀ of the light; finite for a closed body at a phase angle below 90°: some facet is lit and seen."""
    return -2.5 * jnp.log10(glossy_brightness(body, q, sun, observer))


_DAY = 1440.0  # minutes
_PIECE = 256  # number of times per call of the closed form: pieces of equal size share one compiled program
_STEP = 0.1  # min: short enough for at most one minimum or maximum of the light in a step
_OFFSET = 0.02  # min, before and after a minimum, where the light must be brighter


class Scene(NamedTuple):
    """The contents of `satellite.toml`."""

    title: str  # the title of the scene
    facets: GlossyFacets  # the facets of the satellite
    body: RigidBody  # the satellite as a rigid body, with moments over the third one
    state: State  # the true state at t = 0; rates in rad/min
    sky: dict[str, float]  # the directions to Sun and observer, as in the file
    exposures: dict[str, Any]  # the times and the noise of the exposures, as in the file


class Lightcurve(NamedTuple):
    """Exposures of the satellite."""

    t: np.ndarray  # minutes since the first planned exposure, increasing, (n,)
    magnitude: np.ndarray  # magnitudes with noise and an unknown zero point, (n,)
    sun: np.ndarray  # unit vectors to the Sun, (n, 3)
    observer: np.ndarray  # unit vectors to the observer, (n, 3)
    noise: float  # the standard deviation of each magnitude

    def truncate(self, end: float) -> Lightcurve:
        """Select the exposures before the time `end`."""
        t, magnitude, sun, observer = (leaf[self.t < end] for leaf in self[:4])
        return Lightcurve(t, magnitude, sun, observer, self.noise)


class Minima(NamedTuple):
    """The minima of the light in an observing session."""

    t: np.ndarray  # their times (min), (minima,)
    magnitude: np.ndarray  # the magnitudes at these times, (minima,)
    slope: np.ndarray  # the time derivatives of the magnitude at these times: 0 but for rounding (1/min), (minima,)
    rise: np.ndarray  # the smaller of the differences in magnitude to 0.02 min before and after, (minima,)


def scene() -> Scene:
    """Load the scene that the package ships."""
    name = "satellite.toml"
    table = archives.read_toml(resources.files(__package__ or "").joinpath(name), name)
    inertia, motion = np.array(table["body"]["inertia_kg_m2"]), table["motion"]
    body = rigid_body(inertia / inertia[2])
    rate = jnp.deg2rad(jnp.array(motion["angular_velocity_deg_min"]))
    state = body.state(motion["attitude_quaternion"], angular_velocity=rate)
    return Scene(table["title"], facets(table["facets"]), body, state, table["sky"], table["exposures"])


def directions(sky: dict[str, float], t: Array) -> tuple[Array, Array]:
    """Unit vectors from the satellite to Sun and observer at time t (min), (3,) each, of constant declination."""

    def direction_to(name: str) -> Array:
        right_ascension = jnp.deg2rad(sky[f"{name}_right_ascension_deg"] + sky[f"{name}_rate_deg_day"] * t / _DAY)
        return direction(right_ascension, jnp.deg2rad(sky[f"{name}_declination_deg"] + 0 * t))

    return direction_to("sun"), direction_to("observer")


def exposure_times(plan: dict[str, Any]) -> np.ndarray:
    """Irregular, increasing times of exposures (min): a cadence with random shifts, and gaps by clouds."""
    key = jax.random.key(plan["seed"])
    t = np.concatenate([np.arange(begin, end, plan["cadence_min"]) for begin, end in plan["sessions_min"]])
    shifts, clouds = (np.asarray(jax.random.uniform(k, (len(t),))) for k in jax.random.split(key))
    t = t + plan["jitter_min"] * (2 * shifts - 1)
    thickness = np.convolve(clouds, np.ones(7) / 7, "same")  # smooth, so that exposures are lost in runs
    clear = thickness <= np.quantile(thickness, 1 - plan["lost_share"])
    return np.sort(t[clear]) - t[clear].min()


def closed_form(scene: Scene, t: ArrayLike) -> tuple[Array, Array]:
    """Attitudes, (n, 4), and magnitudes without noise, (n,), of the scene's body at times (n,), n > 0."""
    t = jnp.asarray(t)
    padded = jnp.append(t, jnp.full(-len(t) % _PIECE, t[-1])).reshape(-1, _PIECE)
    pieces = [_closed_form(scene.facets, scene.sky, scene.body, scene.state, piece) for piece in padded]
    q, light = (jnp.concatenate(leaves)[: len(t)] for leaves in zip(*pieces, strict=True))
    return q, light


@jax.jit
def _closed_form(
    facets: GlossyFacets, sky: dict[str, float], body: RigidBody, state: State, t: Array
) -> tuple[Array, Array]:
    def attitude_and_light(t: Array) -> tuple[Array, Array]:
        q = body.solution(state, t).q
        return q, magnitude(facets, q, *directions(sky, t))

    return jax.vmap(attitude_and_light)(t)


def observe(scene: Scene, sets: int = 1) -> tuple[Lightcurve, np.ndarray]:
    """The light curve, and the magnitudes of the same exposures in several sets with independent noise, (sets, n)."""
    t = exposure_times(scene.exposures)
    sun, observer = (np.asarray(v) for v in jax.jit(directions)(scene.sky, t))
    key, noise = jax.random.key(scene.exposures["seed"] + 1), scene.exposures["noise_mag"]
    observed = np.asarray(closed_form(scene, t)[1]) + noise * np.asarray(jax.random.normal(key, (1 + sets, len(t))))
    return Lightcurve(t, observed[0], sun, observer, noise), observed[1:]


def slope(body: RigidBody, facets: GlossyFacets, sky: dict[str, float], state: State) -> Array:
    """The time derivative of the magnitude along the motion."""
    t = jnp.asarray(state.t)
    moving = so3.tangent(state.q, body.angular_velocity(state)), jnp.ones_like(t)
    return jax.jvp(lambda q, t: magnitude(facets, q, *directions(sky, t)), (state.q, t), moving)[1]


def minima(
    body: RigidBody, state: State, facets: GlossyFacets, sky: dict[str, float], until: float, count: int
) -> Event:
    """The first `count` minima of the light before the time `until`, as events; differentiable in body and state."""
    step, begin = schemes.preprocessed(body, 6), state._replace(t=jnp.zeros(()))
    rise = lambda state: slope(body, facets, sky, state)  # noqa: E731
    return events(step, begin, _STEP, rise, max_steps=int(until / _STEP), count=count, direction=-1)


def scene_minima(scene: Scene, until: float, count: int) -> Minima:
    """The first `count` minima of the light of a scene, with the slopes and magnitudes that verify them.

    The times and slopes are computed by the scheme, the magnitudes by the closed form.
    """

    @jax.jit
    def find_minima(body: RigidBody, state: State) -> tuple[Event, Array]:
        found = minima(body, state, scene.facets, scene.sky, until, count)
        return found, jax.vmap(lambda state: slope(body, scene.facets, scene.sky, state))(found.state)

    found, slopes = find_minima(scene.body, scene.state)
    t, slopes = (np.asarray(x)[np.asarray(found.found)] for x in (found.t, slopes))
    times = np.concatenate([t - _OFFSET, t, t + _OFFSET])
    before, there, after = np.asarray(closed_form(scene, times)[1]).reshape(3, -1)
    return Minima(t, there, slopes, there - np.maximum(before, after))
