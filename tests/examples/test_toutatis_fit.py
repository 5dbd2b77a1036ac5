"""The scripts of the spin fit of Toutatis and of its flyby print the values that were kept of them."""

import numpy as np
import pytest
from kept_values import KEPT, numbers_after
from scipy.spatial.transform import Rotation

from lieint_jax.examples import toutatis_fit, toutatis_flyby


def numbers(words, text):
    """The numbers of the first line that begins with these words, and those that were kept of it."""
    found, kept = numbers_after(words, text), KEPT["toutatis_fit"]["lines"][words].split()
    return [[float(x) for x in values] for values in (found, kept)]


@pytest.mark.quick
def test_the_fixes_are_those_of_the_table_in_the_convention_of_scipy():
    dates, t, epoch, q, rate = toutatis_fit.fixes()
    assert (len(dates), q.shape, rate.shape) == (20, (20, 4), (19, 3))
    assert t[8] == 0
    assert t[0] - epoch == pytest.approx(23.159873, abs=1e-6)  # of the published radar attitude
    first = Rotation.from_euler("ZXZ", [122.2, 86.5, 107.0], degrees=True)
    np.testing.assert_allclose(np.abs(first.as_quat(scalar_first=True) @ q[0]), 1, rtol=0, atol=1e-6)


@pytest.mark.long
def test_the_fit_prints_the_values_that_were_kept(capsys, tmp_path):
    toutatis_fit.main(sets=20, members=200, out=tmp_path / "fit.png")
    text = capsys.readouterr().out
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    for name in toutatis_fit.QUANTITIES:  # fitted, ± 1σ; the published states with their differences in σ
        (value, sigma, _, *states), kept = numbers(name, text)
        np.testing.assert_allclose([value, sigma, *states[::2]], [*kept[:2], *kept[2::2]], rtol=0, atol=1.1e-3)
        np.testing.assert_allclose(states[1::2], kept[3::2], rtol=0, atol=0.11)
    assert "100 % of 37 random starts end there" in text
    for words in (
        "loss 686.578",
        "attitudes 3.02 ± 0.47°, rates 4.01 ± 0.62 °/d",
        "4.44°, 9.80 °/d",
        "Zhao and Takahashi: 63 (0 of 20",
        "9 (8 of 20",
        "180.2 ± 0.3      -0.3 σ",
        "7.9° rms in single fixes of 1992",
        "0.614 ± 0.034",
        "116 days",
        "enlarged by 1.000 (noise: 1.044)",
        "± 0.24 and ± 0.22 °/d",
    ):
        assert words in text, words
    later = text.partition("torque-free prediction")[2]
    for name, digit in (("fitted", 0.1), ("members, 5 to 95 %", 1.0), ("members farther off", 1.0)):  # (°); %
        found, kept = numbers(name, later)
        assert found == pytest.approx(kept, abs=1.01 * digit)
    for date in ("1992-12-02 21:40", "1992-12-07 17:20", "1992-12-18 07:09"):  # residuals of attitude and rate
        found, kept = numbers(date, text)
        assert found == pytest.approx([kept[0], kept[4]], abs=0.011)
    assert [line[2:12] for line in text.splitlines() if line[2:6] == "1992" and "*" in line] == [
        "1992-12-04",
        "1992-12-07",
        "1992-12-14",
    ]


@pytest.mark.long
def test_the_flyby_prints_the_values_that_were_kept(capsys, tmp_path):
    toutatis_flyby.main(members=200, out=tmp_path / "run.zarr", pictures=False)
    text = capsys.readouterr().out
    for words in (
        "0.01036 au, 10.76 km/s at infinity",
        "momentum: changes by 0.12 % rms, rotates by 0.11° at most",
        "precession rate: 0.028 °/d rms, 0.07 at most; rotation rate: 0.0002 rms",
        "adds up to 43° rms, 111°",
    ):
        assert words in text
