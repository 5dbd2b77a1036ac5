"""The spin state and inertia of a satellite from its light curve: the model, random guesses, and the results.

Eight parameters are fitted: attitude (3), body rate (3), two ratios of inertia. The zero point of the magnitudes is
eliminated: its least-squares value is the mean of the errors, which is subtracted. The motion is computed by the scheme
of order 6, whose derivatives in so many starts cost a tenth of the closed form's; its error is measured by comparison
with the closed form.

Other spin states have the same light, or nearly so. A solution (attitude q, body rate Ω, moments J) of Euler's
equations remains one if space is rotated, q → σq, and if body axes are relabeled, (q, Ω, J) → (qγ⁻¹, gΩ, gJgᵀ)
with g one of the 24 rotations that permute the axes up to sign.

| change | light |
|---|---|
| g a symmetry of the facets | always the same: for a box with two panels, g is a rotation by 180° about a body axis |
| any other g | that of other facets: at best a local minimum, with the moments exchanged |
| σ = 180° about the normal of the plane of Sun, body and observer (*mirror*) | the same if that plane does not move |
| σ = 180° about the bisector of Sun and observer (*exchange*) | the same if the bisector does not move |
| σ = both: 180° about the difference of the two directions | the same if this direction does not move |

The mirror requires facets with a center of symmetry, since in the body Sun and observer move to their antipodes; the
exchange requires a law of scattering that is the same with Sun and observer exchanged (Helmholtz's reciprocity).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.typing import ArrayLike

from lieint_jax import schemes
from lieint_jax.app.studies._satellite_sky import (
    Facets,
    Lightcurve,
    Minima,
    Scene,
    axis_rotations,
    closed_form,
    is_symmetry,
    magnitude,
)
from lieint_jax.app.studies._tumbling import mean_periods, model, rotate, rotation_between
from lieint_jax.fitting import Fit, inertia_ratios, inference, principal_inertia
from lieint_jax.fitting.inference import Params, Problem, Unknown
from lieint_jax.groups import so3
from lieint_jax.measure import DoublePeriods, Sine, double_periods, equivalent_pairs, periodogram, sines
from lieint_jax.runs import integrate, over_members
from lieint_jax.systems import RigidBody

SPACE = ("as it is", "mirror", "exchange", "mirror and exchange")
_ALIKE = (20.0, 0.2, 0.2)  # (attitude (°), relative rate, log moments) differ by less in equal solutions


class Solutions(NamedTuple):
    """Spin states at t = 0."""

    q: np.ndarray  # attitudes, (n, 4)
    rate: np.ndarray  # body rates, (n, 3)
    inertia: np.ndarray  # moments over the geometric mean of the three, (n, 3)

    def select(self, which: np.ndarray | int) -> Solutions:
        """The solutions with these indices."""
        return Solutions(*(np.atleast_2d(leaf[which]) for leaf in self))


def solutions(params: dict[str, np.ndarray], begin: np.ndarray) -> Solutions:
    """The solutions of the parameters of n fits, with their reference attitudes `begin`, (n, 4)."""
    q = _attitudes(params["attitude"], begin)
    J = np.concatenate([np.asarray(params["inertia"]), np.ones((len(q), 1))], axis=1)
    return Solutions(np.asarray(q), np.asarray(params["rate"]), J / np.cbrt(J.prod(axis=1, keepdims=True)))


_attitudes = jax.jit(jax.vmap(rotate))


def parameters(found: Solutions) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The parameters of fits and their reference attitudes `begin`, (n, 4): the inverse of `solutions`."""
    inertia = found.inertia[:, :2] / found.inertia[:, 2:]
    return {"attitude": np.zeros_like(found.rate), "inertia": inertia, "rate": found.rate}, found.q


class Change(NamedTuple):
    """A change of solutions that may leave the light unchanged."""

    space: int  # its kind in space, an index of `SPACE`
    # the new names of the body axes, such as "yxz"; "xyz" where the facets have this symmetry. With signs, such as
    # "x−y−z", unless all rotations by 180° about the body axes are symmetries of the facets
    axes: str
    symmetry: int  # the index of the symmetry of the facets that follows the relabeling; 0 for none
    sigma: np.ndarray  # the rotation of space, a quaternion, (4,)
    g: np.ndarray  # the rotation of the body axes, (3, 3)

    @property
    def name(self) -> str:
        """The change in words, without the symmetry of the facets."""
        return SPACE[self.space] if self.axes == "xyz" else f"{SPACE[self.space]}, axes {self.axes}"

    def attitudes(self, q: np.ndarray) -> np.ndarray:
        """Apply the change to attitudes q, (n, 4)."""
        return np.asarray(_relabel(self.sigma, q, self.g))

    def __call__(self, found: Solutions) -> Solutions:
        """Apply the change to solutions."""
        return Solutions(self.attitudes(found.q), found.rate @ self.g.T, found.inertia @ (self.g**2).T)


@jax.jit
def _relabel(sigma: Array, q: Array, g: Array) -> Array:
    gamma = so3.inverse(so3.from_matrix(g))
    return jax.vmap(lambda q: so3.multiply(sigma, so3.multiply(q, gamma)))(q)


def changes(facets: Facets, sun: np.ndarray, observer: np.ndarray) -> list[Change]:
    """All changes, of space, of axes and by symmetries of the facets, for directions to Sun and observer, (n, 3).

    The plane of the mirror is the one nearest to all directions; the bisector is that of the mean directions.
    """
    normal = np.linalg.svd(np.concatenate([sun, observer]))[2][2]
    bisector = sun.mean(axis=0) / np.linalg.norm(sun.mean(axis=0)) + observer.mean(axis=0)
    bisector = bisector - (bisector @ normal) * normal  # so that the two rotations commute
    bisector = bisector / np.linalg.norm(bisector)
    every = (np.eye(4)[0], *(np.append(0, v) for v in (normal, bisector, np.cross(normal, bisector))))
    rotations = axis_rotations()
    own = [g for g in rotations if is_symmetry(facets, g)]
    signed = len([g for g in own if np.trace(np.abs(g)) == 3]) < 4
    cosets: list[np.ndarray] = []  # of the symmetries, which act last and leave the light unchanged
    for g in rotations:
        if not any(np.allclose(g, h @ other) for other in cosets for h in own):
            cosets.append(g)
    return [
        Change(space, _axes(g, signed), symmetry, sigma, h @ g)
        for space, sigma in enumerate(every)
        for g in cosets
        for symmetry, h in enumerate(own)
    ]


def _axes(g: np.ndarray, signed: bool) -> str:
    """The new names of the body axes, with or without signs."""
    order = np.abs(g).argmax(axis=0)
    return "".join(("−" if signed and g[k, column] < 0 else "") + "xyz"[k] for column, k in enumerate(order))


def distance(a: Solutions, b: Solutions) -> np.ndarray:
    """The distance of each solution of a from the single solution b, (n,); below 1 they count as the same."""
    cosine = np.abs(a.q @ b.q[0]).clip(0, 1)
    size = np.linalg.norm(b.rate[0])
    each = (
        np.rad2deg(2 * np.arccos(cosine)) / _ALIKE[0],
        np.linalg.norm(a.rate - b.rate[0], axis=1) / size / _ALIKE[1],
        np.abs(np.log(a.inertia / b.inertia[0])).max(axis=1) / _ALIKE[2],
    )
    return np.max(each, axis=0)


def classify(found: Solutions, best: Solutions, every: list[Change]) -> np.ndarray:
    """The index of the change that maps the solution `best` to each of `found`, (n,); −1 if there is none."""
    distances = np.stack([distance(found, change(best)) for change in every])
    return np.where(distances.min(axis=0) < 1, distances.argmin(axis=0), -1)


def light_differences(facets: Facets, q: np.ndarray, sun: np.ndarray, observer: np.ndarray) -> np.ndarray:
    """The change of the light by each kind of change in space, (4,), the largest over the symmetries of the facets.

    It is the root mean square of the differences in magnitude, less their mean, along attitudes q, (n, 4), under
    directions to Sun and observer, (n, 3).
    """
    found = np.zeros(len(SPACE))
    for change in changes(facets, sun, observer):
        if change.name == SPACE[change.space]:
            difference = _magnitudes(facets, change.attitudes(q), sun, observer) - _magnitudes(facets, q, sun, observer)
            found[change.space] = max(found[change.space], float(np.std(difference)))
    return found


_magnitudes = jax.jit(jax.vmap(magnitude, (None, 0, 0, 0)))


BAND, SPECTRUM = (0.01, 0.16), (0.005, 0.35)  # 1/min, the ranges of the pairs of frequencies and of the spectrum
HARMONICS = 6  # largest |j| and |k| of the combinations by which a sine is identified
_SEPARATION = 0.004  # 1/min; pairs of frequencies that are closer are one peak
_SHOWN = 10  # number of sines and pairs in the result


class Search(NamedTuple):
    """The search for the periods of a light curve."""

    frequencies: np.ndarray  # the frequencies of the spectrum, 1/min, (k,)
    power: np.ndarray  # the share of the variance that each frequency explains alone, (k,)
    peaks: list[Sine]  # the strongest sines, one after the other
    pairs: DoublePeriods  # the best pairs of frequencies, best first
    lines: np.ndarray  # pairs of frequencies that generate the same combinations as the best pair, (c, 2)

    @property
    def candidates(self) -> np.ndarray:
        """Candidates for the frequencies of (precession, rotation), 1/min, (c, 2): half a rotation has equal light."""
        return self.lines / np.array([1.0, 2.0])


def search(t: np.ndarray, y: np.ndarray) -> Search:
    """The spectrum of magnitudes y at times t (min), its peaks, and pairs of frequencies."""
    spectrum = periodogram(t, y, frequencies=np.arange(*SPECTRUM, 1 / (6 * (t[-1] - t[0]))))
    pairs = double_periods(t, y, *BAND, separation=_SEPARATION, count=_SHOWN)
    found = sines(t, y, spectrum.frequency, _SHOWN)
    return Search(spectrum.frequency, spectrum.power, found, pairs, equivalent_pairs(pairs.pairs[0], *BAND))


UNKNOWNS = {
    "attitude": Unknown(("attitude x (°)", "attitude y (°)", "attitude z (°)"), (0.0, 0.0, 0.0)),
    "inertia": Unknown(("inertia ratio Jx/Jz", "inertia ratio Jy/Jz"), (0.9, 1.1), inertia_ratios),
    "rate": Unknown(("body rate x (°/min)", "body rate y (°/min)", "body rate z (°/min)"), (0.0, 0.0, 0.0)),
}
QUANTITIES = ("precession period (min)", "rotation period (min)")
Guesses = dict[str, np.ndarray]  # parameters of many fits
STEP = 0.75  # min
_FINE = 4000
_AT_ONCE = 10_000  # guesses that are evaluated together
_POOL, _NEAR = 50_000, 500  # number of random bodies, and of those used for a candidate
_SCATTER = 0.8  # standard deviation of the logarithms of second moments


def magnitudes(params: Params, begin: ArrayLike, facets: Facets, curve: Lightcurve) -> tuple[Array, Array]:
    """The model's magnitudes, (n,), and whether all steps converged; `params` and `begin` as in `_tumbling.model`."""
    body, state = model(params, jnp.asarray(begin))
    steps = int(np.ceil(curve.t[-1] / STEP))
    path = integrate(schemes.preprocessed(body, 6), state, STEP, steps, save_at=jnp.asarray(curve.t))
    scene = facets, jnp.asarray(curve.sun), jnp.asarray(curve.observer)
    return jax.vmap(_light, (0, (None, 0, 0)))(path.state.q[1:], scene), jnp.all(path.info.converged)


def _magnitude(q: Array, scene: tuple[Facets, Array, Array]) -> Array:
    facets, sun, observer = scene
    return magnitude(facets, q, sun, observer)


_light = jax.custom_jvp(_magnitude)


@partial(_light.defjvp, symbolic_zeros=True)
def _light_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    """The derivative, by the gradient in the attitude: eight directions then cost little more than the light itself."""
    (q, scene), (dq, *changes) = primals, jax.tree.leaves(tangents, is_leaf=_is_zero)
    light, gradient = jax.value_and_grad(_magnitude)(q, scene)
    along = jnp.zeros(()) if _is_zero(dq) else jnp.vdot(gradient, dq)
    if all(map(_is_zero, changes)):
        return light, along
    full = [jnp.zeros(x.shape, x.dtype) if _is_zero(x) else x for x in changes]
    change = jax.tree.unflatten(jax.tree.structure(scene), full)
    return light, along + jax.jvp(lambda scene: _magnitude(q, scene), (scene,), (change,))[1]


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)


def problem(facets: Facets, curve: Lightcurve) -> Problem:
    """The fit to magnitudes at the exposures of a curve; the data of a fit are its reference attitude and these."""

    def errors(params: Params, data: tuple[Array, Array]) -> tuple[Array, Array]:
        light, converged = magnitudes(params, data[0], facets, curve)
        error = (light - data[1]) / curve.noise
        return error - jnp.mean(error), converged

    def derived(params: Params, data: tuple[Array, Array]) -> Array:
        return mean_periods(*model(params, data[0]))

    return Problem(UNKNOWNS, errors, None, derived=derived, quantities=QUANTITIES)


def fit_magnitudes(
    guesses: Guesses, begin: np.ndarray, observed: np.ndarray, facets: Facets, curve: Lightcurve, progress: bool = True
) -> Fit:
    """Run many fits at once, to the observed magnitudes, (fits, n), at the exposures of the curve.

    Each leaf of `guesses`, and `begin`, has a leading axis (fits).
    """
    options = {"progress": progress, "tolerance": 1e-6, "iterations": 50}
    return inference.fit_starts(problem(facets, curve), guesses, (begin, observed), **options)


def random_guesses(frequencies: np.ndarray, count: int, key: Array) -> tuple[Guesses, np.ndarray, np.ndarray]:
    """Random guesses whose mean precession and rotation frequencies are near given candidates.

    The inertia is that of random second moments; the directions of the body momentum and the attitudes are uniform.
    From a pool of such bodies, each candidate uses those with the nearest ratio of the two frequencies, and scales
    their rates to its frequencies, (candidates, 2) in 1/min. All candidates have the same number of guesses.

    Returns:
        The guesses and their attitudes `begin`, (count, 4), for `fit_magnitudes`; the candidate of each, (count,).
    """
    keys = jax.random.split(key, 4)
    J, Pi, of_pool = (np.asarray(x) for x in _pool(keys[:2]))
    ratio, wanted = of_pool[:, 1] / of_pool[:, 0], frequencies[:, 1] / frequencies[:, 0]
    near = np.argsort(np.abs(np.log(ratio[:, None] / wanted)), axis=0)[:_NEAR]
    which = np.arange(count) % len(frequencies)
    chosen = near[np.asarray(jax.random.randint(keys[2], (count,), 0, _NEAR)), which]
    speed = (frequencies[which] / of_pool[chosen]).mean(axis=1)
    rate = np.rad2deg(speed[:, None] * Pi[chosen] / J[chosen])
    begin = jax.jit(lambda key: jax.vmap(so3.normalize)(jax.random.normal(key, (count, 4))))(keys[3])
    return {"attitude": np.zeros((count, 3)), "inertia": J[chosen, :2], "rate": rate}, np.asarray(begin), which


@jax.jit
def _pool(keys: Array) -> tuple[Array, Array, Array]:
    """Random bodies: moments over the third, body momenta, and mean frequencies of precession and rotation."""
    J = jax.vmap(principal_inertia.inside)(_SCATTER * jax.random.normal(keys[0], (_POOL, 3)))
    J = J / J[:, 2:]
    Pi = jax.random.normal(keys[1], (_POOL, 3))

    def frequencies(J: Array, Pi: Array) -> Array:
        body = RigidBody(J)
        return 1 / mean_periods(body, body.state(body_momentum=Pi))

    return J, Pi, jax.vmap(frequencies)(J, Pi)


def losses(guesses: Guesses, begin: np.ndarray, facets: Facets, curve: Lightcurve, progress: bool = True) -> np.ndarray:
    """Half the sum of squares of the errors of each guess, in units of the noise, (guesses,)."""
    from tqdm import tqdm  # imported here, so that the package imports quickly

    def loss(params: Params, begin: Array) -> Array:
        light, _ = magnitudes(params, begin, facets, curve)
        return len(curve.t) * jnp.var(light - curve.magnitude) / (2 * curve.noise**2)

    piece_losses, pieces = over_members(loss), np.array_split(np.arange(len(begin)), -(-len(begin) // _AT_ONCE))
    found = []
    with tqdm(total=len(begin), unit=" guesses", disable=None if progress else True, leave=False) as bar:
        for piece in pieces:
            part = {name: leaf[piece] for name, leaf in guesses.items()}
            found.append(np.asarray(piece_losses(part, begin[piece])))
            bar.update(len(piece))
    return np.concatenate(found)


class Estimate(NamedTuple):
    """The best solution and the truth: attitude (rotation vector in space, °), inertia ratios, rate (°/min)."""

    value: np.ndarray  # the estimate, (8,)
    truth: np.ndarray  # the truth, or its image under a symmetry of the facets, whichever is nearest, (8,)
    sigma: np.ndarray  # standard errors of the estimate, (8,)
    facet_symmetry: np.ndarray  # that symmetry, a rotation of the body axes, (3, 3)
    periods: np.ndarray  # mean precession and rotation period of the estimate (min), (2,)
    periods_sigma: np.ndarray  # their standard errors, (2,)
    errors: np.ndarray  # (estimate − truth)/σ of the synthetic sets, (sets, 8)
    light: np.ndarray  # the magnitudes of the fit, with the zero point of the light curve, (n,)
    fine_t: np.ndarray  # many times, (m,)
    fine_light: np.ndarray  # the same magnitudes at these times, by the closed form, (m,)
    # the largest difference between the fit's magnitudes and those of the closed form, over the noise
    integration: float


class Ends(NamedTuple):
    """The solutions at which fits have ended."""

    loss: np.ndarray  # half the sum of squares of the errors in units of the noise, (n,)
    # the change that maps the night's best solution to each, an index of `SatelliteFit.changes`; −1 for none, (n,)
    change: np.ndarray
    success: np.ndarray  # whether each fit succeeded, (n,)


class SatelliteFit(NamedTuple):
    """The results of the study."""

    title: str  # the title of the scene
    facets: int  # the number of facets of the satellite
    rate: float  # the true angular velocity at the start (°/s)
    curve: Lightcurve  # the light curve
    session: float  # the end of the first session (min)
    periods: np.ndarray  # true mean precession and rotation period (min), (2,)
    minima: Minima  # the minima of the true light in the first session
    search: Search  # the search for periods
    guesses: int  # the number of random bodies that were compared with the first session
    changes: list[Change]  # every change of a solution that may leave the light unchanged
    first: Ends  # the ends of all starts on the first session
    candidate: np.ndarray  # the index of the candidate pair of periods of each start, (starts,)
    night: Ends  # the ends on the whole night of the fits that begin at the best ends of the first session
    # the ends on the whole night of the fits that begin at the images of the best end of the first session, one for
    # each kind of change
    images: Ends
    # the change that maps the night's best end to the start of each of these fits, an index of `changes`; −1 for none
    named: np.ndarray
    fit: Fit  # the fits to the whole night
    estimate: Estimate  # the best solution, compared with the truth
    # the effect of the changes in space on the light of the truth (mag, rms), (3, 4): under the directions of the
    # middle of the first session, those of the session, and those of the night
    light_changes: np.ndarray
    seconds: np.ndarray  # the time of the guesses, of the fits to the first session, and of those to the night, (3,)
    devices: int  # the number of devices over which the fits were split


def true_solution(made: Scene) -> Solutions:
    """The true spin state, as one solution."""
    rate, J = np.rad2deg(made.body.angular_velocity(made.state)), np.asarray(made.body.inertia)
    return Solutions(np.asarray(made.state.q)[None], rate[None], (J / np.cbrt(J.prod()))[None])


def estimate(
    made: Scene, curve: Lightcurve, night: Fit, begin: np.ndarray, chosen: int, several: int, every: list[Change]
) -> Estimate:
    """Compare the fit number `chosen` with the truth; the fits from number `several` on are those of synthetic sets."""
    starts, asked = night.starts, problem(made.facets, curve)
    assert starts is not None
    params = jax.tree.map(np.asarray, starts.params)  # off the devices over which the fits were split
    data = begin, np.tile(curve.magnitude, (len(begin), 1))
    every_set = range(several, len(begin))
    own = jax.tree.map(lambda x: x[0], inference.estimates(asked, night, data, which=[chosen]))
    truth, best = true_solution(made), solutions(params, begin).select(chosen)
    true = inference.Estimate.exact(_parameter_vector(truth, truth.q[0]), mean_periods(made.body, made.state))
    tested = inference.estimates(asked, night, data, which=every_set)
    pulls = inference.compare(asked, true, tested, starts.success[several:]).pulls
    symmetry = min((c for c in every if c.name == SPACE[0]), key=lambda c: float(distance(c(truth), best)[0]))
    best_params = {name: jnp.asarray(leaf[chosen]) for name, leaf in params.items()}
    body, state = model(best_params, jnp.asarray(begin[chosen]))
    light = np.asarray(jax.jit(lambda p: magnitudes(p, begin[chosen], made.facets, curve)[0])(best_params))
    fine = np.linspace(0, curve.t[-1], _FINE)
    exact = np.asarray(closed_form(made._replace(body=body, state=state), np.append(curve.t, fine))[1])
    zero = np.mean(curve.magnitude - light)
    image, (of_x, of_periods) = _parameter_vector(symmetry(truth), begin[chosen]), np.split(own.sigmas, [8])
    seen, fine_light = np.split(exact, [len(curve.t)])
    integration = float(np.abs(light - seen).max() / curve.noise)
    compared = own.x, image, of_x, symmetry.g, own.derived, of_periods, pulls[:, :8]
    return Estimate(*compared, light + zero, fine, fine_light + zero, integration)


def _parameter_vector(solution: Solutions, begin: np.ndarray) -> np.ndarray:
    """The parameters of the fit, (8,), of a single solution."""
    rotation = rotation_between(jnp.asarray(solution.q[0]), jnp.asarray(begin))
    return np.concatenate([rotation, solution.inertia[0, :2] / solution.inertia[0, 2], solution.rate[0]])
