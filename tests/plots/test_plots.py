"""Pictures: one look for all of them, colors that everybody tells apart, labels that do not overlap."""

import ast
import itertools
import subprocess
import sys
from pathlib import Path

import jax
import matplotlib
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import plots
from lieint_jax.examples import gyro
from lieint_jax.plots import _axes, runs

ROOT = Path(li.__file__).parent
FILES = [path for folder in (ROOT, ROOT.parent / "benchmarks") for path in folder.rglob("*.py")]

# sRGB (linear) as seen without one kind of cone: Machado, Oliveira & Fernandes 2009, severity 1
VISION = {
    "usual": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


def linear(color):
    c = np.array(matplotlib.colors.to_rgb(color))
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    """CIE L*a*b* of linear sRGB: equal distances are about equally easy to see."""
    x = XYZ @ np.clip(rgb, 0, 1) / XYZ.sum(axis=1)
    f = np.where(x > 216 / 24389, np.cbrt(x), (24389 / 27 * x + 16) / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("vision", VISION)
def test_colors_differ_for_every_kind_of_color_vision(vision):
    """The nearest two are 16.1 apart (green and sky blue, tritanopia); a just noticeable difference is 2.3."""
    seen = [lab(np.array(VISION[vision]) @ linear(color)) for color in plots.COLORS]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > 15


def test_the_reds_and_greens_of_matplotlib_fail_the_test_of_color_vision():
    """The refutation: its default green and red with deuteranopia (7.3), so that the test above can fail."""
    green, red = (lab(np.array(VISION["deuteranopia"]) @ linear(color)) for color in ("#2ca02c", "#d62728"))
    assert np.linalg.norm(green - red) < 15


def test_eight_curves_have_distinct_colors_and_marks_and_a_ninth_is_refused():
    assert len(set(plots.COLORS)) == len(set(_axes.MARKS)) == len(plots.STYLES) == 8
    _, axes = plots.figure()
    t = np.linspace(0, 1, 50)
    with pytest.raises(ValueError, match="9 curves cannot be distinguished on one panel: at most 8"):
        plots.series(axes[0, 0], t, {str(k): t for k in range(9)}, "y")
    plots.series(axes[0, 0], t, {str(k): t for k in range(8)}, "y")
    places = [tuple(line.get_markevery()) for line in axes[0, 0].get_lines()]
    assert all(len(found) == 8 for found in places)
    assert not set(places[0]) & set(places[4])  # curves that coincide show the marks of both


def calls(nodes, name):
    """Whether one of the nodes is a call of plots.NAME."""
    called = [ast.unparse(node.func) for node in nodes if isinstance(node, ast.Call)]
    return any(function.rpartition("li.")[2] == f"plots.{name}" for function in called)


@pytest.mark.long
def test_every_function_that_makes_a_figure_has_the_style():
    made = 0
    for path in FILES:
        for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(function, ast.FunctionDef) and calls(nodes := [*ast.walk(function)], "figure"):
                inside = [item.context_expr for node in nodes if isinstance(node, ast.With) for item in node.items]
                decorators = [x for node in nodes if isinstance(node, ast.FunctionDef) for x in node.decorator_list]
                assert calls([*decorators, *inside], "style"), (path, function.name)
                made += 1
    assert made > 40


@pytest.mark.long
def test_figures_are_saved_in_one_place_and_never_by_pyplot():
    places = set()
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = node.attr if isinstance(node, ast.Attribute) else getattr(node, "module", None) or ""
            assert "pyplot" not in name, path
            if name in ("savefig", "set_size_inches"):
                places.add(path)
    assert places == {ROOT / "plots" / "_axes.py"}


@pytest.mark.long
def test_the_style_ends_with_the_figure_and_import_changes_nothing(tmp_path):
    code = (
        "import matplotlib; before = dict(matplotlib.rcParams); from lieint_jax import plots;"
        "assert dict(matplotlib.rcParams) == before; print(plots.COLORS[1])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == plots.RED
    before = dict(matplotlib.rcParams)
    with plots.style():
        assert matplotlib.rcParams["axes.grid"]
        fig, _ = plots.figure()
    plots.save(fig, tmp_path / "a.png")
    assert dict(matplotlib.rcParams) == before


@pytest.mark.long
def test_a_picture_is_a_png_and_a_pdf_with_the_same_bytes_every_time(tmp_path):
    def written(name):
        with plots.style():
            fig, axes = plots.figure()
            plots.series(axes[0, 0], np.arange(3.0), {"a": np.arange(3.0)}, "y", "s")
        return plots.save(fig, tmp_path / name)

    (png, pdf), again = written("a.png"), written("b.png")
    assert (png.name, pdf.name) == ("a.png", "a.pdf")
    assert png.read_bytes().startswith(b"\x89PNG")
    assert pdf.read_bytes().startswith(b"%PDF")
    assert [x.read_bytes() for x in (png, pdf)] == [x.read_bytes() for x in again]


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_errors_are_drawn_with_the_line_of_round_off(kind):
    _, axes = plots.figure()
    error = np.array([0, 1e2, -3], kind) * np.finfo(kind).eps
    ax = plots.log_error(axes[0, 0], np.arange(3), {"midpoint": error}, "energy error", size=10.0, of="|H₀|")
    curve, line = ax.get_lines()
    epsilon = 10 * np.finfo(kind).eps
    assert set(line.get_ydata()) == {epsilon}
    assert line.get_label().startswith("round-off, ε|H₀| = ")
    assert line.get_label() in [text.get_text() for text in ax.get_legend().get_texts()]
    np.testing.assert_allclose(curve.get_xdata(), [1, 2], rtol=1e-15)  # a logarithmic axis has no zero
    np.testing.assert_allclose(curve.get_ydata() / epsilon, [10, 0.3], rtol=1e-6)
    errors = {"energy": error, "momentum": np.zeros(3, kind)}
    ax = plots.log_error(plots.figure()[1][0, 0], np.arange(3), errors, "relative change")
    assert [len(curve.get_ydata()) for curve in ax.get_lines()] == [2, 0, 2]  # the last is the line of round-off
    assert ax.get_legend().get_texts()[1].get_text() == "momentum: exactly 0"
    ax = plots.log_error(plots.figure()[1][0, 0], np.arange(3), {"large": np.ones(3, kind)}, "energy error")
    assert len(ax.get_lines()) == 1  # nothing near it, no line


def map_path(path, center=0.0):
    """Longitudes and latitudes in degrees of a path as drawn."""
    _, axes = plots.figure(subplot_kw={"projection": "mollweide"})
    ax = plots.sky_path(plots.sky(axes[0, 0], center), path, "path", center)
    return np.rad2deg(ax.get_lines()[0].get_xydata()).T


def test_a_path_on_the_map_ends_at_its_edge_and_begins_at_the_other_one():
    equator = _axes.unit_vectors(np.deg2rad([150, 170, 190, 210]), np.zeros(4))
    np.testing.assert_allclose(map_path(equator)[0], [150, 170, 180, np.nan, -180, -170, -150], rtol=1e-15)
    np.testing.assert_allclose(map_path(equator[::-1])[0], [-150, -170, -180, np.nan, 180, 170, 150], rtol=1e-15)
    np.testing.assert_allclose(map_path(equator, 180)[0], [-30, -10, 10, 30], rtol=5e-15)
    on_the_edge = map_path(_axes.unit_vectors(np.deg2rad([170, 180, 190]), np.zeros(3)))[0]
    np.testing.assert_allclose(on_the_edge[[0, 1, 2, -2, -1]], [170, 180, 180, -180, -170], rtol=1e-15)


def test_a_path_crosses_the_edge_of_the_map_on_its_great_circle():
    """tan(latitude) of a great circle is a sine of the longitude."""
    angle = np.deg2rad(np.arange(0.0, 360.0, 25.0))
    longitude, latitude = map_path(np.stack([np.sin(angle), 0.6 * np.cos(angle), 0.8 * np.cos(angle)], axis=1))
    drawn = np.isfinite(longitude)
    assert (~drawn).sum() == 1
    np.testing.assert_allclose(
        np.tan(np.deg2rad(latitude[drawn])), 4 / 3 * np.sin(np.deg2rad(longitude[drawn])), rtol=0, atol=1e-12
    )
    assert np.isclose(abs(longitude[drawn]), 180).sum() == 2


def test_labels_of_longitudes_are_on_top_of_curves():
    _, axes = plots.figure(subplot_kw={"projection": "mollweide"})
    ax = plots.sky(axes[0, 0], 180)
    plots.sky_path(ax, np.eye(3), "path", 180)
    assert ax.get_xticklabels()[0].get_text() == "60°"
    assert ax.get_lines()[0].get_zorder() < ax.xaxis.get_zorder()


def test_dots_on_a_map_shrink_with_their_number_unless_their_size_is_given():
    rng = np.random.default_rng(0)
    few, many = (
        plots.sky_points(
            plots.figure(subplot_kw={"projection": "mollweide"})[1][0, 0],
            _axes.unit_vectors(*rng.normal(size=(2, n))),
            f"{n} members",
        ).collections[0]
        for n in (20, 2000)
    )
    assert few.get_sizes()[0] > many.get_sizes()[0] >= 4  # of an area in points²
    assert few.get_alpha() > many.get_alpha() >= 0.3
    _, axes = plots.figure(subplot_kw={"projection": "mollweide"})
    ax = plots.sky_points(
        axes[0, 0], _axes.unit_vectors(*rng.normal(size=(2, 3000))), "members", marker="P", s=45, lw=0
    )
    assert ax.collections[0].get_sizes()[0] == 45
    assert len(ax.collections[0].get_offsets()) == 3000


def alone(step, start):
    """A run of an ensemble of one."""
    return li.run(step, jax.tree.map(lambda x: x[None], start), 0.05, 40, progress=False)


@pytest.mark.long
@pytest.mark.parametrize(("spin", "name"), [([2.0, 0.1, 0.05], "body axis x"), ([0.1, 0.05, -2.0], "body axis −z")])
def test_the_motion_of_a_body_is_drawn_by_the_axis_that_it_spins_about(spin, name):
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    start = body.state(li.groups.so3.exp(np.array([0.3, -1.0, 0.7])), angular_velocity=spin)
    run = alone(li.schemes.so3_explicit(body), start)
    fig = runs.motion(run, "a body")
    assert fig.axes[0].get_title().startswith(f"{name} of the first member")
    [near] = [line for line in fig.axes[0].get_lines() if line.get_label() == "start"]
    axis = np.sign(spin[int(np.argmax(np.abs(spin)))]) * np.eye(3)[int(np.argmax(np.abs(spin)))]
    expected = 1.01 * np.asarray(li.groups.so3.Ad(start.q, axis))
    np.testing.assert_allclose(np.ravel(near.get_data_3d()), expected, rtol=1e-12)


@pytest.mark.long
def test_the_motion_of_a_body_whose_inertia_changes_is_drawn_by_its_axis_z():
    body = li.systems.inertia_in_time(lambda t: jax.numpy.array([1.0, 2.0, 2.5]) + t)
    run = alone(li.schemes.extrapolate(body, 4), body.state(angular_velocity=[0.1, 0.2, 1.0], t=0.0))
    fig = runs.motion(run, "a body")
    assert fig.axes[0].get_title().startswith("body axis z of the first member")


@pytest.mark.long
def test_the_motion_of_a_rod_is_drawn_by_its_shapes():
    """The first of them, in the plane of the longest extent, is that of the start."""
    rod, start, _ = li.systems._rod.examples()["free"]
    fig = runs.motion(alone(li.schemes.splitting(rod), start), "a rod")
    drawn = {label: ax.get_lines() for ax in fig.axes for label in [ax.get_ylabel()]}
    assert [len(lines) for lines in drawn.values()] == [13, 13]
    along = "xyz".index(fig.axes[1].get_xlabel())
    for label, lines in drawn.items():
        expected = np.asarray(start.q)[:, [along, "xyz".index(label)]]
        np.testing.assert_allclose(lines[0].get_xydata(), expected, rtol=0, atol=1e-15)


def test_works_are_drawn_by_law_and_the_least_of_many_together():
    """Nothing is lost: the curves add up to the whole work. Works of one size have a linear axis."""
    t = np.linspace(0, 1, 9)
    works = {f"law_{k}": 10.0**-k * t for k in range(10)}
    ax = plots.works(plots.figure()[1][0, 0], t, works, "J", "s")
    names = [line.get_label() for line in ax.get_lines()]
    assert names == [*(f"law {k}" for k in range(7)), "3 others"]
    np.testing.assert_allclose(sum(line.get_ydata() for line in ax.get_lines()), sum(works.values()), rtol=1e-15)
    assert (ax.get_ylabel(), ax.get_yscale()) == ("work of each law (J)", "symlog")
    even = {"drag": -t, "still": 0 * t, "motor": 2 * t}
    ax = plots.works(plots.figure()[1][0, 0], t, even)
    assert (ax.get_ylabel(), ax.get_yscale()) == ("work of each law", "linear")
    assert [text.get_text() for text in ax.get_legend().get_texts()] == list(even)


@pytest.mark.long
def test_a_run_that_counts_works_has_a_picture_of_them():
    """Each law by its name, and H − ΣW; the energy error is that less the work, also if only works are counted."""
    body = li.systems.torqued_body([1.0, 2.0, 3.0], li.torques.viscous(0.1) + li.torques.pd_trace(0.4, 0.1))
    start = body.state(li.groups.so3.exp(np.array([0.3, -1.0, 0.7])), angular_velocity=[1.0, -2.0, 0.5], works=True)
    run = alone(li.schemes.torqued_midpoint(body), start)
    kinds = runs.pictures_of(run.state)
    assert set(kinds) == {"errors", "motion", "works"}
    left, right = kinds["works"](run, "a body").axes
    drawn = {line.get_label(): line.get_ydata() for line in left.get_lines()}
    assert list(drawn) == ["change of energy", "viscous", "pd trace"]
    np.testing.assert_allclose(drawn["viscous"], run.state.extra["works"][:, 0, 0])
    np.testing.assert_allclose(drawn["change of energy"], drawn["viscous"] + drawn["pd trace"], rtol=0, atol=1e-14)
    assert max(np.max(line.get_ydata()) for line in right.get_lines()) < 1e-14
    errors = runs.errors(run, "a body").axes[0]
    assert errors.get_ylabel() == "error of energy less work, relative"
    assert max(np.max(line.get_ydata()) for line in errors.get_lines()) < 1e-14
    assert set(runs.pictures_of(run.state._replace(extra=None))) == {"errors", "motion"}


def apart(labels):
    """Whether the boxes of neighboring texts do not overlap."""
    boxes = [text.get_window_extent() for text in labels if text.get_text() and text.get_visible()]
    return len(boxes) > 1 and not any(a.overlaps(b) for a, b in itertools.pairwise(boxes))


@pytest.mark.long
def test_labels_of_the_ticks_of_the_example_gyro_do_not_overlap():
    rng = np.random.default_rng(0)
    truth, sigma = np.array([0.6, 0.8]), 5e-4
    estimates = truth + sigma * rng.normal(size=(20, 2))
    t = gyro.EVERY * np.arange(1, gyro.READINGS + 1)
    readings = np.stack([np.sin(t / 9), np.cos(t / 7), np.sin(t / 5)], axis=1)
    fig = gyro.draw(readings, readings, estimates, truth, sigma**2 * np.eye(2))
    with plots.style():
        fig.draw_without_rendering()
    for ax in fig.axes:
        assert apart(ax.get_xticklabels())
        assert apart(ax.get_yticklabels())
    assert [text.get_text() for text in fig.axes[0].get_legend().get_texts()] == ["x", "y", "z", "readings"]
    inside = np.linalg.norm((estimates - truth) / sigma, axis=1) <= np.sqrt(5.991)  # χ² of 95 %
    assert f"{inside.sum()} of 20 inside" in fig.axes[1].get_legend().get_texts()[-1].get_text()


@plots.style()
def map_with_a_legend_and_a_caption():
    fig, axes = plots.figure(2, size=(4.7, 4.2), width_ratios=[2, 1])
    axes[0, 0].remove()
    wide = plots.sky(fig.add_subplot(1, 2, 1, projection="mollweide"))
    wide.plot([0, 1], [0, 0.5], label="a path")
    wide.set_title("(a) the whole sky", loc="left")
    wide.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2, borderpad=0.9)
    axes[0, 1].plot([0, 1], [0, 1])
    axes[0, 1].set(aspect="equal", xlabel="east (°)", ylabel="north (°)")
    _axes.caption(fig, "A caption of so many words that it needs at least two lines below such a figure. " * 2)
    return fig


def places_of_the_files(fig, path, monkeypatch, write):
    """The places of the first panel in the PNG and in the PDF."""
    places, original = [], fig.savefig

    def recorded(*args, **options):
        original(*args, **options)
        places.append(fig.axes[0].get_position().bounds)

    monkeypatch.setattr(fig, "savefig", recorded)
    write(fig, path)
    return places


def write_at_once(fig, path):
    with plots.style():
        fig.savefig(path)
        fig.savefig(path.with_suffix(".pdf"))


@pytest.mark.long
def test_the_png_and_the_pdf_have_the_same_layout(tmp_path, monkeypatch):
    """The refutation: without `plots.save` the panels of the PDF are elsewhere, by 0.01 of the figure."""
    for write, same in ((plots.save, True), (write_at_once, False)):
        fig = map_with_a_legend_and_a_caption()
        png, pdf = places_of_the_files(fig, tmp_path / "picture.png", monkeypatch, write)
        assert (png == pdf) == same
        assert same or np.abs(np.subtract(png, pdf)).max() > 3e-3


def test_five_digits_stand_at_an_axis_without_a_factor_and_do_not_touch():
    with plots.style():
        fig, axes = plots.figure(3)
        angle = np.linspace(0, 7, 100)
        circle = 16000 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        ax = plots.paths(axes[0, 0], {"Beta": circle})
        fig.draw_without_rendering()
        assert ax.xaxis.get_offset_text().get_text() == ""
        shown = [text for text in ax.get_xticklabels() if abs(text.get_position()[0]) <= 16000]
        assert "10000" in "".join(text.get_text() for text in shown)
        boxes = [text.get_window_extent() for text in shown]
        assert all(a.x1 < b.x0 for a, b in itertools.pairwise(boxes))


def test_a_histogram_counts_every_member_and_those_without_a_value():
    """The highest bars are the sums of the parts; `shown` leaves out the tail; no value is an empty panel."""
    x = np.append(np.linspace(0.0, 1.0, 101), np.nan)
    _, axes = plots.figure(3)
    every, tail, empty = axes[0]
    plots.histogram(every, {"early": x[:40], "late": x[40:]}, "fall (s)", {"mean": 0.5})
    early, late = every.containers
    assert sum(bar.get_height() for bar in early) == 40
    assert sum(bar.get_height() for bar in late) == 61
    assert max(bar.get_y() + bar.get_height() for bar in (*early, *late)) < 10
    assert every.get_xlabel() == "fall (s); 1 of 102 have none"
    assert [text.get_text() for text in every.get_legend().get_texts()] == ["early", "late", "mean"]
    plots.histogram(tail, {"": x[:101]}, "fall (s)", shown=0.9)
    assert sum(bar.get_height() for bar in tail.patches) == 91
    assert tail.get_legend() is None
    plots.histogram(empty, {"": x[-1:]}, "fall (s)")
    assert not empty.patches


def test_paths_are_drawn_in_as_many_dimensions_as_the_panel_has():
    path = np.arange(6.0).reshape(2, 3)
    fig, axes = plots.figure(1)
    for ax in (axes[0, 0], fig.add_subplot(projection="3d")):
        plots.space_paths(ax, {"center": path, "tip": path + 1})
        assert [line.get_label() for line in ax.lines] == ["center", "tip"]
        assert len({line.get_color() for line in ax.lines}) == 2
        np.testing.assert_array_equal(
            np.stack(getattr(ax.lines[0], "get_data_3d", ax.lines[0].get_data)()).T[:, 1], path[:, 1]
        )


def test_lines_of_error_against_cost_accept_styles():
    _, axes = plots.figure()
    curves = {"ours": (np.array([1.0, 2.0]), np.array([1e-2, 1e-4])), "theirs": (np.array([1.0, 3.0]), np.ones(2))}
    ax = plots.loglog_lines(axes[0, 0], curves, "cost", "error", {"theirs": {"ls": ":"}})
    ours, theirs = ax.get_lines()
    np.testing.assert_array_equal(ours.get_xydata(), [[1, 1e-2], [2, 1e-4]])
    assert ours.get_marker() != theirs.get_marker()
    assert (ours.get_linestyle(), theirs.get_linestyle()) == ("-", ":")
    assert (ax.get_xscale(), ax.get_ylabel()) == ("log", "error")
