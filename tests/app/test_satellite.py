"""The study of a satellite: symmetric solutions, periods, minima, the fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lights import directions

import lieint_jax as li
from lieint_jax.app.studies import _satellite_fit as fits
from lieint_jax.app.studies import _satellite_sky as sky
from lieint_jax.app.studies import satellite
from lieint_jax.fitting.tumbling import mean_periods, model

PLATE = {"normal": [0.0, 0.0, 2.0], "area_m2": np.pi, "diffuse": 0.5, "specular": 0.25, "exponent": 3.0}
SCENE = sky.scene()


@pytest.mark.long
def test_every_change_of_a_motion_is_a_motion():
    """Turned in space, relabeled in the body: still a solution of Euler's equations, with the moments relabeled."""
    _, sun, observer = directions(4, 1)
    begin = fits.true_solution(SCENE)
    later = jax.jit(lambda J, q, rate: _later(J, q, rate, 7.0))
    end = np.asarray(later(*(jnp.asarray(x[0]) for x in (begin.inertia, begin.q, begin.rate))))
    every = li.measure.light_changes(SCENE.facets, sun, observer)
    assert len(every) == 4 * 24
    for change in every[::5]:
        image = change(begin)
        found = np.asarray(later(*(jnp.asarray(x[0]) for x in (image.inertia, image.q, image.rate))))
        assert abs(change.attitudes(end[None])[0] @ found) == pytest.approx(1, abs=1e-14)


def _later(J, q, rate, t):
    body = li.systems.RigidBody(J)
    state = body.state(q, angular_velocity=jnp.deg2rad(rate))
    step = li.schemes.preprocessed(body, 6)
    return li.integrate(step, state, t / 20, 20).state.q[-1]


def test_images_are_named_from_the_night_whichever_solution_was_best_before_the_shadow():
    """There the mirror solution's χ² may be the lower one: its image in the mirror is the true motion."""
    _, sun, observer = directions(5, 1)
    every = li.measure.light_changes(SCENE.facets, sun, observer)
    truth = fits.true_solution(SCENE)
    mirror = next(change for change in every if change.name == "mirror")
    names = [every[k].name for k in li.measure.classify_light(satellite._images(mirror(truth), every), truth, every)]
    own = [change.name for change in every if change.symmetry == 0]
    assert sorted(names) == sorted(own)
    assert names[own.index("as it is")] == "mirror"
    assert names[own.index("mirror")] == "as it is"


BAD = [
    (lambda: sky.facets([]), "at least one facet"),
    (lambda: sky.facets([PLATE | {"color": 1}]), "facet 0: color: unknown key; allowed: name, normal, area_m2"),
    (lambda: sky.facets([{k: v for k, v in PLATE.items() if k != "diffuse"}]), "diffuse: key missing"),
    (lambda: sky.facets([PLATE | {"name": "lid", "normal": [0, 0, 0]}]), "facet 'lid': normal: must not be zero"),
    (lambda: sky.facets([PLATE | {"normal": [1.0, 2.0]}]), "normal: .*at least 3 items"),
    (lambda: sky.facets([PLATE | {"area_m2": -1.0}]), "area_m2: .*greater than or equal to 0"),
    (lambda: sky.facets([PLATE | {"area_m2": np.inf}]), "area_m2: .*finite number"),
    (lambda: sky.facets([PLATE | {"specular": "much"}]), "specular: .*valid number"),
    (lambda: sky.facets([PLATE | {"exponent": 0.5}]), "exponent: .*greater than or equal to 1"),
]


@pytest.mark.parametrize(("make", "words"), BAD)
def test_bad_facets_are_refused_with_a_sentence(make, words):
    with pytest.raises(ValueError, match=words):
        make()


@pytest.mark.long
def test_minima_of_the_light_are_minima_and_their_times_have_derivatives():
    rate = jnp.rad2deg(SCENE.body.angular_velocity(SCENE.state))
    params = {"attitude": jnp.zeros(3), "inertia": SCENE.body.inertia[:2], "rate": rate}

    def minima_of(params):
        body, state = model(params, SCENE.state.q)
        return sky.minima(body, state, SCENE.facets, SCENE.sky, 40.0, 20)

    m = sky.scene_minima(SCENE, 40.0, 20)
    t = np.linspace(0, 40, 40001)
    light = np.asarray(sky.closed_form(SCENE, t)[1])
    inside = light[1:-1]
    there = t[1:-1][(inside > light[:-2]) & (inside > light[2:])]
    np.testing.assert_allclose(m.t, there, rtol=0, atol=2e-3)  # all of them, and no other: the grid's step is 1e-3
    assert np.abs(m.slope).max() < 1e-14  # mag/min; seen: 1e-15
    assert m.rise.min() > 0
    derivative = jax.jit(jax.jacfwd(lambda p: minima_of(p).t))(params)["rate"]
    h, axis = 1e-5, jnp.array([0.0, 1.0, 0.0])
    more, less = (jax.jit(minima_of)(params | {"rate": rate + s * h * axis}).t for s in (1, -1))
    count = len(m.t)
    np.testing.assert_allclose(derivative[:count, 1], ((more - less) / (2 * h))[:count], rtol=0, atol=1e-6)


@pytest.mark.long
def test_the_period_search_finds_the_true_combinations():
    """All strong sines are combinations, as good as all with an even k; one candidate pair is the true one."""
    curve, _ = sky.observe(SCENE)
    true = 1 / np.asarray(mean_periods(SCENE.body, SCENE.state))
    found, width = fits.search(curve.t, curve.magnitude), 1 / curve.t[-1]
    named = [li.measure.combination(p.frequency, true, fits.HARMONICS, width) for p in found.peaks[:9]]
    assert max(abs(off) for *_, off in named) < width
    assert all(k % 2 == 0 for _, k, _ in named)
    assert np.abs(found.candidates - true).max(axis=1).min() < width / 2


@pytest.mark.long
def test_a_fit_from_near_the_truth_recovers_it():
    """Without noise to what the scheme of order 6 leaves; with noise within four standard errors."""
    curve, seen = sky.observe(SCENE, 1)
    first = curve.truncate(145.0)
    clean = np.asarray(sky.closed_form(SCENE, first.t)[1])
    truth = fits.true_solution(SCENE)
    guess, begin = fits.parameters(truth)
    guess = guess | {"attitude": guess["attitude"] + 5.0, "rate": guess["rate"] * 1.005}
    several = jax.tree.map(lambda x: np.repeat(x, 2, axis=0), (guess, begin))
    fit = fits.fit_magnitudes(*several, np.stack([clean, seen[0][: len(first.t)]]), SCENE.facets, first, False)
    assert fit.starts is not None
    assert fit.starts.success.all()
    rate, inertia = np.asarray(fit.starts.params["rate"]), np.asarray(fit.starts.params["inertia"])
    true = np.rad2deg(SCENE.body.angular_velocity(SCENE.state))
    np.testing.assert_allclose(rate[0], true, rtol=0, atol=0.01)
    sigma = np.sqrt(np.diagonal(fit.starts.covariance[1]))[3:]
    off = np.concatenate([inertia[1] - np.asarray(SCENE.body.inertia)[:2], rate[1] - true])
    assert (np.abs(off) < 4 * sigma).all()


@pytest.mark.long
def test_a_small_study_counts_and_names_its_ends():
    found = satellite.run(quick=True, progress=False)
    assert len(found.first.loss) == 200
    names = [found.changes[k].name for k in found.images.change if k >= 0]
    assert "mirror" in names
    free = len(found.curve.t) - 9
    assert 0.6 * free < 2 * found.night.loss.min() < 1.4 * free
    off = (found.estimate.value - found.estimate.truth) / found.estimate.sigma
    assert np.abs(off).max() < 4
    assert found.light_changes[0].max() < 1e-13
    assert found.estimate.integration < 0.1
    report = satellite.text(found)
    for words in ("mirror", "axes yxz", "Kaasalainen", "Pravec", "Binz", "elsewhere", "synthetic sets"):
        assert words in report
    assert len(satellite.draw(found).axes) == 6
