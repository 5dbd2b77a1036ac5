"""The study of a satellite: light against hand-made cases, symmetric solutions, periods, minima, the fit."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.app.studies import _satellite_fit as fits
from lieint_jax.app.studies import _satellite_sky as sky
from lieint_jax.app.studies import satellite
from lieint_jax.app.studies._tumbling import mean_periods, model
from lieint_jax.groups import so3

ONE = jnp.array([1.0, 0.0, 0.0, 0.0])
PLATE = {"normal": [0.0, 0.0, 2.0], "area_m2": np.pi, "diffuse": 0.5, "specular": 0.25, "exponent": 3.0}
SCENE = sky.scene()


def unit(*v):
    return np.array(v) / np.linalg.norm(v)


def directions(seed, count=40):
    """Attitudes, and directions to Sun and observer at phase angles below 90°."""
    rng = np.random.default_rng(seed)
    q, sun, observer = (rng.normal(size=(count, k)) for k in (4, 3, 3))
    q, sun = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (q, sun))
    observer = sun + 0.9 * observer / np.linalg.norm(observer, axis=1, keepdims=True)
    return q, sun, observer / np.linalg.norm(observer, axis=1, keepdims=True)


def test_a_plate_has_lambert_s_light_and_a_lobe_in_the_mirror_direction():
    """cos² 60° (0.5 + 0.25), the lobe at its top; 0.5 + 0.25 face on; nearly nothing from behind."""
    body = sky.facets([PLATE])
    left, right, top = unit(-np.sqrt(3), 0, 1), unit(np.sqrt(3), 0, 1), np.array([0.0, 0.0, 1.0])
    light = jax.jit(lambda s, o: sky.brightness(body, ONE, s, o))
    edge = sky.SUN_RADIUS**2  # what the ramp adds, relative, is of this size
    assert float(light(left, right)) == pytest.approx(0.75 / 4, rel=4 * edge)
    assert float(light(top, top)) == pytest.approx(0.75, rel=2 * edge)
    assert 0 < float(light(-top, right)) < edge


@pytest.mark.long
def test_the_light_of_the_satellite_is_the_sum_over_its_facets():
    """Beside a loop in NumPy with max(0, x); the ramp differs from it by ε/2 of a facet at an edge, here by 1e-3."""
    f = SCENE.facets
    q, sun, observer = directions(1)
    ours = jax.vmap(sky.brightness, (None, 0, 0, 0))(f, q, sun, observer)
    for light, attitude, s, o in zip(ours, q, sun, observer, strict=True):
        R = np.asarray(so3.to_matrix(jnp.asarray(attitude)))
        theirs = 0.0
        for n, area, diffuse, specular, exponent in zip(*(np.asarray(x) for x in jax.tree.leaves(f)), strict=True):
            lit, seen, mirrored = (max(0.0, float(R @ n @ v)) for v in (s, o, unit(*(s + o))))
            theirs += area / np.pi * lit * seen * (diffuse + specular * mirrored**exponent)
        assert float(light) == pytest.approx(theirs, abs=3e-3 * float(jnp.max(ours)))


@pytest.mark.long
def test_derivatives_of_the_light_are_those_of_differences():
    q, sun, observer = (x[0] for x in directions(2))

    def light(turn, sun):
        return sky.magnitude(SCENE.facets, so3.multiply(so3.exp(turn), jnp.asarray(q)), sun, jnp.asarray(observer))

    both = jax.jit(jax.value_and_grad(light, (0, 1)))
    zero, h = jnp.zeros(3), 1e-6
    _, (of_turn, of_sun) = both(zero, jnp.asarray(sun))
    for k, axis in enumerate(jnp.eye(3)):
        for found, change in ((of_turn[k], (h * axis, 0 * axis)), (of_sun[k], (0 * axis, h * axis))):
            more, less = (both(zero + s * change[0], sun + s * change[1])[0] for s in (1, -1))
            assert float(found) == pytest.approx(float(more - less) / (2 * h), abs=2e-8)  # seen: 1e-9


@pytest.mark.long
def test_derivatives_of_the_fit_by_the_gradient_are_those_of_the_light():
    """By the attitude alone, and by all at once."""
    q, sun, observer = (jnp.asarray(x[0]) for x in directions(8))
    at = q, (SCENE.facets, sun, observer)

    @partial(jax.jit, static_argnums=0)
    def derivatives(light):
        alone = jax.jvp(lambda q: light(q, at[1]), at[:1], (jnp.ones(4),))[1]
        return alone, jax.jvp(light, at, at)[1]

    ours, plain = map(derivatives, (fits._light, fits._magnitude))
    np.testing.assert_allclose(ours, plain, rtol=1e-13)  # seen: 1e-15


def test_the_symmetries_of_the_facets_are_found():
    half_turns = [g for g in sky.axis_rotations() if sky.is_symmetry(SCENE.facets, g)]
    np.testing.assert_array_equal(half_turns, [np.diag(d) for d in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])])
    assert sky.is_symmetry(SCENE.facets, -np.eye(3))
    rows = [PLATE | {"normal": list(n)} for n in (*np.eye(3), *-np.eye(3))]
    assert sum(sky.is_symmetry(sky.facets(rows), g) for g in sky.axis_rotations()) == 24  # a cube
    rows[0] |= {"diffuse": 0.6}
    painted = sky.facets(rows)
    assert sum(sky.is_symmetry(painted, g) for g in sky.axis_rotations()) == 4  # about the painted side
    assert not sky.is_symmetry(painted, -np.eye(3))


@pytest.mark.long
def test_symmetric_solutions_have_the_same_light_to_round_off():
    """Under directions that are held; under moving ones mirror and exchange alter it, half turns of the body never."""
    q, sun, observer = directions(3)
    held = np.repeat(sun[:1], len(q), axis=0), np.repeat(observer[:1], len(q), axis=0)
    assert fits.light_differences(SCENE.facets, q, *held).max() < 2e-14  # seen: 3e-15
    moving = fits.light_differences(SCENE.facets, q, sun, observer)
    assert moving[0] < 2e-14
    assert moving[1:].min() > 0.1


@pytest.mark.long
def test_every_change_of_a_motion_is_a_motion():
    """Turned in space, relabeled in the body: still a solution of Euler's equations, with the moments relabeled."""
    _, sun, observer = directions(4, 1)
    begin = fits.true_solution(SCENE)
    later = jax.jit(lambda J, q, rate: _later(J, q, rate, 7.0))
    end = np.asarray(later(*(jnp.asarray(x[0]) for x in (begin.inertia, begin.q, begin.rate))))
    every = fits.changes(SCENE.facets, sun, observer)
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


@pytest.mark.long
@pytest.mark.parametrize("normals", [[0, 2], [1, 2, 3]])
def test_relabeled_bodies_have_the_light_that_their_turns_leave(normals):
    """Facets without the satellite's symmetries: all turns of one change have one light, and no two changes a name."""
    sides = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]]
    body = sky.facets([PLATE | {"normal": sides[k], "diffuse": 0.1 + 0.2 * (k >= 2)} for k in normals])
    cube = sky.facets([PLATE | {"normal": list(n), "diffuse": 0.7} for n in (*np.eye(3), *-np.eye(3))])
    body = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), body, cube)
    q, sun, observer = directions(9)
    every = fits.changes(body, sun[:1], observer[:1])
    lights = {}
    for change in every[:24]:
        lights.setdefault(change.name, []).append(
            fits._magnitudes(body, jnp.asarray(change.attitudes(q)), sun, observer)
        )
    turns = sum(sky.is_symmetry(body, g) for g in sky.axis_rotations())
    assert len(lights) == 24 // turns
    for same in lights.values():
        assert len(same) == turns
        assert max(float(jnp.abs(light - same[0]).max()) for light in same) < 1e-13  # seen: 4e-15
    first = [same[0] for same in lights.values()]
    assert min(float(jnp.abs(a - b).max()) for a, b in itertools.combinations(first, 2)) > 1e-3


def test_ends_of_fits_are_classified_by_their_symmetry():
    _, sun, observer = directions(5, 1)
    every = fits.changes(SCENE.facets, sun, observer)
    best = fits.true_solution(SCENE)
    images = [every[k](best) for k in (0, 17, 50, 95)]
    found = fits.Solutions(*map(np.concatenate, zip(*images, strict=True)))
    assert fits.classify(found, best, every).tolist() == [0, 17, 50, 95]
    off = found._replace(rate=-found.rate)
    assert fits.classify(off, best, every)[0] == -1


def test_images_are_named_from_the_night_whichever_solution_was_best_before_the_shadow():
    """There the mirror solution's χ² may be the lower one: its image in the mirror is the true motion."""
    _, sun, observer = directions(5, 1)
    every = fits.changes(SCENE.facets, sun, observer)
    truth = fits.true_solution(SCENE)
    mirror = next(change for change in every if change.name == "mirror")
    names = [every[k].name for k in fits.classify(satellite._images(mirror(truth), every), truth, every)]
    own = [change.name for change in every if change.symmetry == 0]
    assert sorted(names) == sorted(own)
    assert names[own.index("as it is")] == "mirror"
    assert names[own.index("mirror")] == "as it is"


BAD = [
    (lambda: sky.facets([]), "at least one facet"),
    (
        lambda: sky.facets([PLATE | {"color": 1}]),
        "facet 0: color: unknown key; allowed: name, normal, area_m2",
    ),
    (lambda: sky.facets([{k: v for k, v in PLATE.items() if k != "diffuse"}]), "diffuse: key missing"),
    (
        lambda: sky.facets([PLATE | {"name": "lid", "normal": [0, 0, 0]}]),
        "facet 'lid': normal: must not be zero",
    ),
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
    assert np.abs(m.slope).max() < 1e-13  # mag/min; seen: 1e-15
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
