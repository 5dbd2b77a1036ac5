"""The scene of the study of a satellite: its facets, its motion, the directions to Sun and observer, the exposures."""

from __future__ import annotations

from importlib import resources
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from lieint_jax.app.scenarios._body import direction
from lieint_jax.app.studies._facets import Facets, facets, magnitude
from lieint_jax.runs import store as archives
from lieint_jax.systems import RigidBody, rigid_body
from lieint_jax.types import State

_DAY = 1440.0  # minutes
_PIECE = 256  # number of times per call of the closed form: pieces of equal size share one compiled program


class Scene(NamedTuple):
    """The contents of `satellite.toml`.

    Attributes:
        title: the title of the scene.
        facets: the facets of the satellite.
        body: the satellite as a rigid body, with moments over the third one.
        state: the true state at t = 0; rates in rad/min.
        sky: the directions to Sun and observer, as in the file.
        exposures: the times and the noise of the exposures, as in the file.
    """

    title: str
    facets: Facets
    body: RigidBody
    state: State
    sky: dict[str, float]
    exposures: dict[str, Any]


class Lightcurve(NamedTuple):
    """Exposures of the satellite.

    Attributes:
        t: minutes since the first planned exposure, increasing, (n,).
        magnitude: magnitudes with noise and an unknown zero point, (n,).
        sun: unit vectors to the Sun, (n, 3).
        observer: unit vectors to the observer, (n, 3).
        noise: the standard deviation of each magnitude.
    """

    t: np.ndarray
    magnitude: np.ndarray
    sun: np.ndarray
    observer: np.ndarray
    noise: float

    def truncate(self, end: float) -> Lightcurve:
        """Select the exposures before the time `end`."""
        before = self.t < end
        t, magnitude, sun, observer = (leaf[before] for leaf in self[:4])
        return Lightcurve(t, magnitude, sun, observer, self.noise)


def scene() -> Scene:
    """Load the scene that the package ships."""
    name = "satellite.toml"
    table = archives.read_toml(resources.files(__package__ or "").joinpath(name), name)
    inertia = np.array(table["body"]["inertia_kg_m2"])
    body = rigid_body(inertia / inertia[2])
    motion = table["motion"]
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


def true_magnitudes(scene: Scene, t: ArrayLike) -> Array:
    """The magnitudes of the true motion, in closed form, without noise, at times (n,)."""
    return closed_form(scene, t)[1]


def closed_form(scene: Scene, t: ArrayLike) -> tuple[Array, Array]:
    """Attitudes, (n, 4), and magnitudes without noise, (n,), of the scene's body at times (n,), n > 0."""
    t = jnp.asarray(t)
    padded = jnp.append(t, jnp.full(-len(t) % _PIECE, t[-1])).reshape(-1, _PIECE)
    pieces = [_closed_form(scene.facets, scene.sky, scene.body, scene.state, piece) for piece in padded]
    q, light = (jnp.concatenate(leaves)[: len(t)] for leaves in zip(*pieces, strict=True))
    return q, light


@jax.jit
def _closed_form(facets: Facets, sky: dict[str, float], body: RigidBody, state: State, t: Array) -> tuple[Array, Array]:
    def attitude_and_light(t: Array) -> tuple[Array, Array]:
        q = body.solution(state, t).q
        return q, magnitude(facets, q, *directions(sky, t))

    return jax.vmap(attitude_and_light)(t)


def observe(scene: Scene, sets: int = 1) -> tuple[Lightcurve, np.ndarray]:
    """The light curve, and the magnitudes of the same exposures in several sets with independent noise, (sets, n)."""
    t = exposure_times(scene.exposures)
    sun, observer = (np.asarray(v) for v in jax.jit(directions)(scene.sky, t))
    key, noise = jax.random.key(scene.exposures["seed"] + 1), scene.exposures["noise_mag"]
    clean = np.asarray(true_magnitudes(scene, t))
    observed = clean + noise * np.asarray(jax.random.normal(key, (1 + sets, len(t))))
    return Lightcurve(t, observed[0], sun, observer, noise), observed[1:]
