"""The report of the study of Toutatis, in six parts."""

from __future__ import annotations

import numpy as np

from lieint_jax.app.studies import _flyby
from lieint_jax.app.studies._pulls import ELLIPSOID, chance_errors, shares
from lieint_jax.app.studies._radar import FITTED, STATES, dates, later_fixes
from lieint_jax.app.studies._toutatis_result import SpinFit
from lieint_jax.fitting import DEGREES_OF_FREEDOM, student_t_noise_error

NAMES = (
    "precession period (d)",
    "rotation period (d)",
    "momentum, longitude (°)",
    "momentum, latitude (°)",
    "inertia ratio Jx/Jz",
    "inertia ratio Jy/Jz",
    "Euler angle α (°)",
    "Euler angle β (°)",
    "Euler angle γ (°)",
    "body rate x (°/d)",
    "body rate y (°/d)",
    "body rate z (°/d)",
)
HUDSON_OSTRO = (7.35, 5.41)  # precession and rotation period, d; Hudson & Ostro 1995, Science 270:84
_CHANGE = 0.08  # °/d, the largest change of the spin by the flyby of 2004: Busch et al. 2012, AGU, P31A-1873
_TO_2008 = 1516.0  # days from that flyby, 2004-09-29, to the fix of 2008-11-23


def text(found: SpinFit) -> str:
    """The report of the study, as text."""
    parts = (_head, _residual_table, _comparison, _prediction, _torque, _coverage)
    return "\n".join(line for part in parts for line in part(found))


def _head(found: SpinFit) -> list[str]:
    noise, error = np.asarray(found.estimate.noise), student_t_noise_error(FITTED, 3) * found.factors[1]
    assert found.fit.starts is not None
    normal = np.asarray(found.normal.noise)
    sigma = np.sqrt(np.diagonal(found.estimate.derived_covariance))
    values = zip(np.asarray(found.normal.derived), np.asarray(found.estimate.derived), sigma, strict=True)
    moved = max(abs(_difference(a, b, k)) / s for k, (a, b, s) in enumerate(values))
    random = len(found.fit.starts.loss) - 3
    return [
        f"{found.scenario.title}: spin state, inertia ratios and noise from the {FITTED} radar fixes of 1992",
        f"  fixes: {found.scenario.source('takahashi')}, without errors: attitudes have one weight, and so have rates",
        f"  {found.fit.outcome}; {100 * found.share_at_minimum:.0f} % of {random} random starts end there",
        f"  noise, fitted: attitudes {noise[0]:.2f} ± {noise[0] * error:.2f}°, rates {noise[1]:.2f} ± "
        f"{noise[1] * error:.2f} °/d (scales of Student's t, {DEGREES_OF_FREEDOM:g} degrees of freedom)",
        f"  with normal errors instead: {normal[0]:.2f}°, {normal[1]:.2f} °/d, and the values below change by up to "
        f"{moved:.1f} σ",
    ]


def _residual_table(found: SpinFit) -> list[str]:
    size = {name: np.linalg.norm(e, axis=-1) for name, e in found.residuals.items()}
    lines = [
        "\n  |calculated − observed|       attitude (°)                        body rate (°/d)",
        f"  {'':<18}{'fitted':>8}{'weight':>8}{'Zhao':>7}{'Takahashi':>11}{'fitted':>12}{'weight':>8}{'Zhao':>7}"
        f"{'Takahashi':>11}",
    ]
    for k, date in enumerate(dates()[:FITTED]):
        row = f"  {date:<18}"
        for kind in range(2):
            ours, zhao, takahashi = (size[name][kind, k] for name in ("fitted", *STATES))
            mark = "*" if found.outlier[kind, k] else " "
            row += f"{ours:>{12 if kind else 8}.2f}{mark}{found.weights[kind, k]:>7.2f}{zhao:>7.1f}{takahashi:>11.1f}"
        lines.append(row)
    rms = [np.sqrt((s**2).mean(axis=1)) for s in size.values()]
    row = f"  {'rms':<18}" + "".join(
        f"{rms[0][k]:>{12 if k else 8}.2f}{'':>8}{rms[1][k]:>7.2f}{rms[2][k]:>11.2f}" for k in range(2)
    )
    return [
        *lines,
        row,
        "  * an outlier: with normal errors of the fitted noise, 1 of 100 such tables has a residual as large",
    ]


def _comparison(found: SpinFit) -> list[str]:
    value = np.asarray(found.estimate.derived)
    sigma = np.sqrt(np.diagonal(found.estimate.derived_covariance))
    lines = [f"\n  {'':<26}{'fitted':>9}{'± 1σ':>9}{'Zhao':>12}{'Takahashi':>18}"]
    for k, name in enumerate(NAMES):
        row = f"  {name:<26}{value[k]:>9.3f}{sigma[k]:>9.3f}  "
        for state in STATES:
            other = float(found.published[state][k])
            row += f"{other:>10.3f}{_difference(other, value[k], k) / sigma[k]:>+5.1f} σ "
        lines.append(row.rstrip())
    distances, synthetic = found.mahalanobis_squared.values(), found.coverage.mahalanobis_squared
    beyond = " and ".join(
        f"{d:.0f} ({(synthetic > d).sum()} of {len(synthetic)} synthetic sets are farther off)" for d in distances
    )
    lines += [
        "  (angles and rates at 1992-11-09 17:49:47 UTC; right, values of the published states, with the inertia of",
        f"  {found.scenario.source('takahashi')}, and their difference from ours)",
        "  all eight parameters together, at the middle fix: squared distances by the covariance, 8 expected, of Zhao",
        f"  and Takahashi: {beyond}",
        "\n  published values:",
    ]
    for k, p in enumerate(found.scenario.published.values()):
        lines.append(
            _published_comparison(k, value[k], sigma[k], p.value, p.error or 0.0, found.scenario.source(p.source))
        )
    for k, period in enumerate(HUDSON_OSTRO):
        lines.append(_published_comparison(k, value[k], sigma[k], period, 0.0, "Hudson & Ostro 1995, Science 270:84"))
    return lines


def _published_comparison(k: int, ours: float, sigma: float, value: float, error: float, source: str) -> str:
    """A line with a published value, its difference from ours in units of the combined error, and its source."""
    given = f"{value:g}" + (f" ± {error:g}" if error else "")
    return f"    {NAMES[k]:<26}{given:<16}{_difference(value, ours, k) / np.hypot(sigma, error):>+5.1f} σ   {source}"


def _difference(a: float, b: float, k: int) -> float:
    """a − b; for angles in degrees, wrapped to ±180°."""
    return (a - b + 180) % 360 - 180 if "°)" in NAMES[k] else a - b


def _prediction(found: SpinFit) -> list[str]:
    p = found.prediction
    lines = ["\n  torque-free prediction of later fixes, by radar and, in 2012, by Chang'e-2: angle from the fix (°)"]
    lines += [f"  {'':<26}" + "".join(f"{date:>14}" for date in later_fixes().date)]
    lines += [f"    {name:<24}" + "".join(f"{angle:>14.1f}" for angle in off) for name, off in p.fix_angles.items()]
    ranges = (f"{a:.0f} to {b:.0f}" for a, b in np.percentile(p.member_fix_angles, (5, 95), axis=0).T)
    pole = p.pole[:FITTED][~found.outlier[1]]
    late = ", ".join(f"{x:.3f}" for x in p.energy[-3:])
    single, early = np.sqrt((pole**2).mean()), p.energy[1 : 1 + FITTED][~found.outlier[0]]
    verdict = "No miss is outside the spread" if p.farther_share.min() > 0.05 else "Some misses are outside the spread"
    first, second = (np.interp(angle, p.rms, p.t) for angle in (30, 90))
    return [
        *lines,
        f"    {'members, 5 to 95 %':<24}" + "".join(f"{x:>14}" for x in ranges),
        f"    {'members farther off':<24}" + "".join(f"{100 * share:>12.0f} %" for share in p.farther_share),
        f"  {verdict} of the fit's own uncertainty: the members spread by 30° rms after {first:.0f} days,",
        f"  by 90° after {second:.0f}, by {p.rms[-1]:.0f}° at the end (random attitudes: 132°).",
        f"  The direction of the momentum differs from the fitted one by {single:.1f}° rms in single fixes of 1992, by",
        f"  {p.pole[-2]:.1f}° and {p.pole[-1]:.1f}° in those of 2004 and 2008; 2H Jz/|π|² is {p.energy[0]:.3f} fitted,",
        f"  {early.mean():.3f} ± {early.std():.3f} for single attitudes of 1992, {late} for the later ones.",
    ]


def rate_errors(found: SpinFit) -> np.ndarray:
    """Standard errors of the mean rates of precession and rotation, 360°/period, in °/d, (2,)."""
    value, error = found.periods.T
    return 360 * error / value**2


def _torque(found: SpinFit) -> list[str]:
    f, own = found.flyby, rate_errors(found)
    rms, most = np.sqrt((f.rates**2).mean(axis=0)), np.abs(f.rates[:, 0]).max()
    usual, worst = _TO_2008 * rms[0], _TO_2008 * most
    change = 100 * np.sqrt((f.momentum**2).mean())
    return [
        "\n  the Earth's torque in the flyby of 2004-09-29, in order of magnitude, over all phases and directions:",
        f"    a hyperbola of least distance {f.distance / _flyby.AU:.5f} au, {f.speed:.2f} km/s at infinity",
        "    (elements quoted from JPL's Small-Body Database, not checked there; the Earth on a circle)",
        f"    momentum: changes by {change:.2f} % rms, rotates by {f.pole.max():.2f}° at most",
        f"    precession rate: {rms[0]:.3f} °/d rms, {most:.2f} at most; rotation rate: {rms[1]:.4f} rms",
        f"    published: {_CHANGE} °/d at most   (Busch et al. 2012, AGU Fall Meeting, P31A-1873)",
        f"  By the fix of 2008 this change of rate adds up to {usual:.0f}° rms, {worst:.0f}° at most, even from",
        "  a state known exactly.",
        f"  The fit of 1992 determines the two rates to ± {own[0]:.2f} and ± {own[1]:.2f} °/d.",
    ]


def _coverage(found: SpinFit) -> list[str]:
    c = found.coverage
    one, two, rms = shares(c.pulls)
    labels = (*(f"attitude {a}" for a in "xyz"), "Jx/Jz", "Jy/Jz", *(f"rate {a}" for a in "xyz"))
    labels = (*labels, "log noise, attitudes", "log noise, rates", *NAMES[:4])
    sets, margin = len(c.pulls), chance_errors(len(c.pulls))
    lines = [
        f"\n  errors: those of the observed information, enlarged by {found.factors[0]:.3f} (noise levels: "
        f"{found.factors[1]:.3f}), which is",
        f"  the ratio of scatter to error in {sets} synthetic sets of the fitted model; a test by {sets} other sets "
        f"({int(c.success.sum())} fits succeeded):",
        f"  {'':<26}{'within 1σ':>10}{'within 2σ':>10}{'rms/σ':>11}",
    ]
    lines += [f"  {label:<26}{one[k]:>9.0f}%{two[k]:>9.0f}%{rms[k]:>11.2f}" for k, label in enumerate(labels)]
    inside = 100 * (c.mahalanobis_squared <= ELLIPSOID).mean()
    return [
        *lines,
        f"  {'mean of the parameters':<26}{one[:8].mean():>9.1f}%{two[:8].mean():>9.1f}%{c.scatter[0]:>11.2f}",
        f"  {'expected of each':<26}{68.3:>9}%{95.4:>9}%{1:>11}   ± {margin[0]:.1f} %, {margin[1]:.1f} % by chance",
        f"  truth inside the joint 95 % ellipsoid: {inside:.0f} % of the sets",
    ]
