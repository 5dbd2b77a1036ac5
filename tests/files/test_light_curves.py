"""Light curves of DAMIT and ALCDEF, and a fit of an ellipsoid to its own curve from a file."""

import json

import data_files
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from lieint_jax import files, measure, shapes

RATE = 2 * np.pi / (5.27 / 24)  # radians a day


@jax.jit
def light(parameters, dates, sun, observer):
    """The light of an ellipsoid of three axes that rotates about the pole of the ecliptic."""
    facets = shapes.ellipsoid_facets(jnp.append(parameters[:2], 1.0), 12)

    def at(date, s, o):
        half = (RATE * date + parameters[2]) / 2
        return measure.brightness(facets, jnp.stack([jnp.cos(half), 0, 0, jnp.sin(half)]), s, o)

    return jax.vmap(at)(dates, sun, observer)


def observations(k):
    """Dates of a night and the vectors to Sun and Earth, which move on straight lines."""
    dates = np.linspace(0.0, 0.2, 25) + 40 * k
    sun = np.array([2.1, 0.4, 0.3]) + np.outer(dates, [-0.01, 0.004, 0.0])
    return dates, sun, sun + np.array([-0.7, 0.7 - 0.3 * k, 0.02])


def damit(curves):
    text = f"{len(curves)}\n"
    for code, rows in curves:
        text += f"{len(rows)} {code}\n" + "".join(" ".join(f"{x:.12e}" for x in row) + "\n" for row in rows)
    return text


def curves(parameters, epoch=2451545.0):
    found = []
    for k in range(3):
        dates, sun, observer = observations(k)
        y = np.asarray(light(np.array(parameters), dates, sun, observer))
        found.append((1, np.column_stack([dates + epoch, y, sun, observer])))
    return found


@pytest.mark.parametrize("form", ["lc.txt", "lc.json"])
def test_an_ellipsoid_is_found_from_its_own_curve_in_a_file(form, tmp_path):
    """Twelve digits of the file are what limits it: observed 2e-8; the JD, to 5e-10 d, is 1e-8 of phase."""
    true, path = [2.2, 1.5, 0.4], tmp_path / form
    written = curves(true)
    if form == "lc.txt":
        path.write_text(damit(written))
    else:
        entries = [
            {
                "LightCurve": {
                    "id": 7,
                    "scale": "1",
                    "points_count": len(rows),
                    "points": damit([(1, rows)]).split("\n", 2)[2],
                }
            }
            for _, rows in written
        ]
        path.write_text(json.dumps(entries))
    found = files.read_light_curves(path)
    assert [len(x.dates) for x in found] == [25, 25, 25]
    assert all(x.calibrated and x.light_time_corrected and not x.magnitudes and x.errors is None for x in found)
    dates, y, sun, observer = (
        np.concatenate([getattr(x, key) for x in found]) for key in ("dates", "intensity", "sun", "observer")
    )
    fit = least_squares(
        lambda x: np.asarray(light(x, dates - 2451545.0, sun, observer)) - y, [2.0, 1.4, 0.3], xtol=1e-14, ftol=1e-14
    )
    np.testing.assert_allclose(fit.x, true, rtol=0, atol=1e-7)


def test_sessions_of_alcdef():
    first, second = files.read_light_curves(data_files.FOLDER / "samples" / "sessions.alcdef")
    np.testing.assert_array_equal(first.dates, [2457000.5, 2457000.51])
    np.testing.assert_array_equal(first.errors, [0.01, 0.02])
    assert first.intensity[1] / first.intensity[0] == pytest.approx(10**0.1, rel=1e-13, abs=0)
    assert (first.scale, first.light_time_corrected, first.calibrated, first.magnitudes) == ("UTC", False, False, True)
    assert first.sun is first.observer is None
    assert first.metadata["FILTER"] == "V"
    assert second.light_time_corrected
    assert second.calibrated
    assert second.errors is None
    assert second.metadata == {"OBJECTNAME": "Eros", "LTCAPP": "POINT"}


def test_one_of_several_curves_is_named(tmp_path):
    path = tmp_path / "lc.txt"
    point = "{} 1.5 1 0 0 0 1 0\n"
    path.write_text("2\n1 0\n" + point.format(2451545.0) + "1 0\n" + point.format(2451546.0))
    assert files.read_light_curve(path, number=1).dates.tolist() == [2451546.0]
    with pytest.raises(ValueError, match="has 2 light curves: give number="):
        files.read_light_curve(path)
    with pytest.raises(ValueError, match=r"number must be from 0 to 1 for .*, got 2"):
        files.read_light_curve(path, number=2)
