"""Pictures of a flyby: maps over both phases, distributions of the members, sensitivities."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.patheffects import withStroke

from lieint_jax.app import plots
from lieint_jax.app.scenarios._body import longitude_latitude
from lieint_jax.app.scenarios._flyby_keys import FlybyKeys
from lieint_jax.app.scenarios._flyby_motion import Outcome
from lieint_jax.app.scenarios._flyby_study import change_of_spin, study, unknowns
from lieint_jax.app.scenarios._kind import picture
from lieint_jax.runs import Run

_LONGEST = 500.0  # h of P_ψ, which is infinite between the modes: the last color shows all larger values
_MARGIN = 10.0  # ° from the edge of a map, where the axis would cross a label of a contour


@picture(2, 2)
def draw_map(scenario: FlybyKeys, axes: np.ndarray, run: Run) -> None:
    """Plot periods, effective spin rate and rotation of the pole after the passage, over both phases at the perigee."""
    found = study(scenario, run)
    x, after = change_of_spin(found.mapped.before, found.mapped.after), found.mapped.after
    shape = (scenario.map.precession_phases, scenario.map.rotation_phases)
    P_phi, P_psi = found.mapped.before.precession[0], found.mapped.before.rotation[0]
    contours, shown = (18, 20, 24, 28, 32, 36, 40), np.clip(after.rotation, None, _LONGEST)
    panels = (
        ("effective spin rate $2H/|L|$ over that before", x.rate, "PuOr_r", (0.5, 0.75, 1, 1.25, 1.5, 2), True),
        (f"precession period $P_\\phi$ (h); before {P_phi:.2f}", after.precession, "viridis", contours, False),
        (f"rotation period $P_\\psi$ (h); before {P_psi:.0f}", shown, "cividis", (), False),
        ("rotation of the pole (°)", x.pole_angle, "magma", (5, 10, 15, 20, 25, 30), False),
    )
    for ax, (title, values, colors, levels, is_ratio) in zip(axes, panels, strict=True):
        maps = values.reshape(shape), after.long_axis.reshape(shape)
        _draw_phases(ax, *maps, scenario.spin.same_passage_deg, colors, levels, is_ratio)
        ax.set_title(title)
    for ax in axes[2:]:
        ax.set_xlabel("precession phase $\\phi$ at the perigee (°)")
    for ax in axes[::2]:
        ax.set_ylabel("rotation phase $\\psi$ at the perigee (°)")
    axes[0].figure.suptitle(f"{scenario.title}: nominal body, every phase; hatched: a long-axis mode after the passage")


def _draw_phases(ax: Any, values: Any, long_axis: Any, same_deg: int, colors: str, levels: Any, is_ratio: bool) -> None:
    """Plot a map over φ and ψ, both to 360°: its second half is the first, with ψ + 180° and φ + `same_deg`."""
    n, m = values.shape

    def full_circle(x: np.ndarray) -> np.ndarray:
        full = np.concatenate([x, np.roll(x, n * same_deg // 360, axis=0)], axis=1)
        return np.pad(full, ((0, 1), (0, 1)), mode="wrap").T

    phi, psi = np.linspace(0, 360, n + 1), np.linspace(0, 360, 2 * m + 1)
    options: dict[str, Any] = {"cmap": colors, "shading": "gouraud", "rasterized": True}
    if is_ratio:
        most = max(abs(np.log(values)).max(), np.log(1.2))
        options["norm"] = LogNorm(np.exp(-most), np.exp(most))
    image = ax.pcolormesh(phi, psi, full_circle(values), **options)
    bar = ax.figure.colorbar(image, ax=ax, extend="max" if values.max() == _LONGEST else "neither")
    shown = [level for level in levels if values.min() < level < values.max()]
    if is_ratio:
        bar.set_ticks(shown, labels=[f"{level:g}" for level in shown])
        bar.ax.minorticks_off()
    if shown:
        lines = ax.contour(phi, psi, full_circle(values), shown, colors=plots.INK, linewidths=0.6)
        outline = [withStroke(linewidth=2, foreground="white")]
        for text in ax.clabel(lines, fontsize="x-small", fmt="%g"):
            text.set_path_effects(outline)
            text.set_visible(all(_MARGIN < x < 360 - _MARGIN for x in text.get_position()))
    if long_axis.any():
        mode = full_circle(long_axis.astype(float))
        hatched = ax.contourf(phi, psi, mode, [0.5, 1.5], hatches=["///"], colors="none")
        hatched.set(edgecolor="white", linewidth=0)
        ax.contour(phi, psi, mode, [0.5], colors="white", linewidths=1.4)
    ax.set_xticks(range(0, 361, 90))
    ax.set_yticks(range(0, 361, 90))


@picture(3, 2)
def draw_after(scenario: FlybyKeys, axes: np.ndarray, run: Run) -> None:
    """Plot the members after the passage: distributions of periods, spin rate and rotation of the pole, and poles."""
    found = study(scenario, run)
    x, after, before = change_of_spin(found.before, found.after), found.after, found.before
    panels = (
        ("precession period $P_\\phi$ (h)", after.precession, before.precession[0]),
        ("rotation period $P_\\psi$ (h)", after.rotation, before.rotation[0]),
        ("$|L|$ over that before", x.momentum, 1.0),
        ("effective spin rate $2H/|L|$ over that before", x.rate, 1.0),
        ("rotation of the pole (°)", x.pole_angle, None),
    )
    for ax, (label, values, initial) in zip(axes, panels, strict=False):
        top = np.quantile(values, 0.99)
        bins = np.linspace(values.min(), top + 0.02 * np.ptp(values[values <= top]), 50)
        parts = [values[~after.long_axis], values[after.long_axis]]
        ax.hist(parts, bins, stacked=True, color=[plots.BLUE, plots.RED], label=["short-axis mode", "long-axis mode"])
        if initial is not None:
            ax.axvline(initial, color=plots.INK, ls="--", lw=1.0, label="before (nominal)")
        ax.set(xlabel=label, ylabel="members")
    axes[0].legend()
    fig = axes[0].figure
    axes[5].remove()
    _draw_poles(fig.add_subplot(2, 3, 6, projection="polar"), before, after)
    count = f"{len(after.rate):,}".replace(",", "\u202f")
    rest = "the highest 1 % of each histogram not shown"
    fig.suptitle(f"{scenario.title}: {count} members, uniform phases; {rest}")


def _draw_poles(ax: Any, before: Outcome, after: Outcome) -> None:
    """Plot the poles on the sky about the nearer pole of the ecliptic."""
    side = np.sign(before.pole[0, 2]) or 1.0
    for outcome, color, label in ((before, plots.GREEN, "before"), (after, plots.WINE, "after")):
        longitude, latitude = np.asarray(longitude_latitude(outcome.pole)).T
        ax.scatter(np.deg2rad(longitude), 90 - side * latitude, s=1.0, lw=0, color=color, alpha=0.35, rasterized=True)
        ax.plot([], [], "o", ms=4, color=color, label=label)
    far = 90 - side * np.asarray(longitude_latitude(np.concatenate([before.pole, after.pole])))[:, 1]
    ax.set_rlim(0, 10 * np.ceil(np.quantile(far, 0.999) / 10))
    ax.set_rlabel_position(22.5)
    ax.tick_params(labelsize="x-small")
    pole = "north" if side > 0 else "south"
    ax.set_xlabel(f"direction of $L$: longitude, and ° from the {pole} pole of the ecliptic", labelpad=8)
    ax.legend(loc="upper left", bbox_to_anchor=(-0.3, 1.1))


@picture(2)
def draw_sensitivity(scenario: FlybyKeys, axes: np.ndarray, run: Run) -> None:
    """Plot the change of the periods by one standard deviation of each unknown, to first order, over the phases."""
    found = study(scenario, run)
    names = {
        "phi": "$\\phi$, uniform",
        "psi": "$\\psi$, uniform",
        "least": "moment $I_1/I_3$",
        "middle": "moment $I_2/I_3$",
        "precession": "$P_\\phi$ before",
        "rotation": "$P_\\psi$ before",
        "longitude": "pole's longitude",
        "latitude": "pole's latitude",
    }
    sizes = {name: sigma for name, (_, _, sigma) in unknowns(scenario).items() if sigma > 0}
    look: dict[str, Any] = {"orientation": "horizontal", "whis": (5, 95), "showfliers": False}
    look |= {"medianprops": {"color": plots.RED}, "tick_labels": [names[name] for name in names if name in sizes]}
    for k, (ax, period) in enumerate(zip(axes, ("$P_\\phi$", "$P_\\psi$"), strict=True)):
        changes = [abs(found.slopes[name][:, k]) * sizes[name] for name in names if name in sizes]
        ax.boxplot([x[x > 0] for x in changes], **look)  # a logarithmic axis has no zero
        ax.invert_yaxis()
        ax.set(xscale="log", xlabel=f"change of {period} after the passage (h)")
    axes[1].set_yticklabels([])
    axes[0].figure.suptitle(
        f"{scenario.title}: effect of one standard deviation of each unknown\n"
        "to first order, over all phases: median, quartiles, 5 % and 95 %"
    )
