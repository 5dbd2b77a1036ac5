"""Pictures in one style: of arrays on axes of matplotlib, and of whole runs.

A function that makes a figure is decorated with `style()`, and `save` writes it as PNG and PDF:

    @li.plots.style()
    def draw(run):
        fig, [[ax]] = li.plots.figure()
        li.plots.log_error(ax, run.t, {"midpoint": run.energy_error()}, "energy error", "s")
        return fig

    li.plots.save(draw(run), "error.png")

A function with an argument `ax` draws on these axes and returns them. The style sheet for matplotlib is
"lieint_jax.plots.lieint".
"""

from lieint_jax.plots._axes import (
    BLUE,
    COLORS,
    GRAY,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    STYLES,
    WINE,
    cube,
    delay_plot,
    figure,
    files,
    legend_below,
    letter_panels,
    log_error,
    loglog_lines,
    paths,
    round_off,
    save,
    series,
    sky,
    sky_path,
    sky_points,
    sphere_path,
    style,
    works,
)
from lieint_jax.plots._panels import balance, chain, histogram, member_series, on_sphere, space_paths
from lieint_jax.plots.film import animate
from lieint_jax.plots.runs import errors, motion, overview

__all__ = [
    "BLUE",
    "COLORS",
    "GRAY",
    "GREEN",
    "INK",
    "ORANGE",
    "PURPLE",
    "RED",
    "SKY",
    "STYLES",
    "WINE",
    "animate",
    "balance",
    "chain",
    "cube",
    "delay_plot",
    "errors",
    "figure",
    "files",
    "histogram",
    "legend_below",
    "letter_panels",
    "log_error",
    "loglog_lines",
    "member_series",
    "motion",
    "on_sphere",
    "overview",
    "paths",
    "round_off",
    "save",
    "series",
    "sky",
    "sky_path",
    "sky_points",
    "space_paths",
    "sphere_path",
    "style",
    "works",
]
__dir__ = __all__.copy
