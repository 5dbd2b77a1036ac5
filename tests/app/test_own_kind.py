"""A user's own kind of scenario: that of the page runs by the command, and results do not choose what is imported."""

import re
from pathlib import Path

import numpy as np
import pytest
from documents import blocks

from lieint_jax import plots
from lieint_jax.app import kind, scenarios

PAGE = (Path(__file__).parents[2] / "docs" / "pages" / "howto" / "kind.md").read_text(encoding="utf-8")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the files of the page, with fewer members."""
    monkeypatch.chdir(tmp_path)
    [(_, top), (_, spun)] = blocks(PAGE, "python")
    Path("top.py").write_text(top, encoding="utf-8")
    Path("spun.py").write_text(spun, encoding="utf-8")
    for name, (_, table) in zip(("top", "spun"), blocks(PAGE, "toml"), strict=True):
        small = table.replace("members = 20", "members = 3").replace("members = 10", "members = 3")
        Path(f"{name}.toml").write_text(small, encoding="utf-8")
    return tmp_path


@pytest.mark.long
def test_the_kind_of_the_page_runs_by_the_command(folder, lieint):
    """A fast top sleeps, a slow one falls; both report what the scheme promises."""
    out = lieint("run", "top.toml", "--no-certificate")
    assert re.search(r"momentum, relative +\S+   conserved to round-off", out)
    assert re.search(r"energy, relative +\S+   bounded, not conserved", out)
    assert "a top sleeps if it spins faster than 4 rad/s" in out
    assert "3 of 3 members converged" in out
    lieint.drew("top-tilt.png")
    with np.load("top.npz") as stored:
        assert stored["q"].shape == (101, 3, 4)
    assert "does not choose what is imported: give --kind FILE.py:CLASS" in lieint.refuse("plot", "top.npz", "--force")
    assert "a top sleeps if it spins faster" in lieint("plot", "top.npz", "--force", "--kind", "top.py:SleepingTop")


def test_a_store_of_an_own_kind_opens_without_it(folder, lieint):
    """Its system is in the store, and nothing is imported; a sentence names the kind, also where its file has moved."""
    options = ["--no-certificate", "--set", "steps=40", "--out", "top.zarr"]
    lieint("run", "top.toml", *options)
    assert "largest change of energy" in lieint("info", "top.zarr")
    Path("top.py").write_text("raise AssertionError", encoding="utf-8")
    for gone in (False, True):
        if gone:
            Path("top.py").unlink()
        out = lieint("plot", "top.zarr", "--force")
        assert "--kind top.py:SleepingTop draws and reports as its own kind does" in out
        assert ("(top.py:SleepingTop is not here: give the place of its file)" in out) is gone
        assert "written: top-errors.png, top-errors.pdf, top-motion.png" in out


@pytest.mark.long
def test_results_of_an_own_kind_with_functions_are_read_with_it(folder, lieint):
    """A run at given times is reported without the option, since its kind has just run; the others need it."""
    with_a_potential("Partial(height, self.mass_kg)")
    kind, few = ["--kind", "spun.py:SpunTop"], ["--no-certificate", "--set", "members=2", "--set", "steps=40"]
    out = lieint("run", "spun.toml", *few, "--set", "save_at=[0.001, 0.004]")
    assert "at 3 of 3 saved times" in out
    lieint.drew("spun-motion.png")
    assert "energies are not computed: spun.npz: the run is of the kind" in lieint("info", "spun.npz")
    assert "largest change of energy" in lieint("run", "spun.toml", *few, "--out", "spun.zarr")
    assert "functions of the kind spun.py:SpunTop, and a store" in lieint("info", "spun.zarr")
    assert "give --kind FILE.py:CLASS if it is yours" in lieint.refuse("animate", "spun.zarr")
    for path in ("spun.npz", "spun.zarr"):
        assert "largest change of energy" in lieint("info", path, *kind)
        assert "2 frames" in lieint("animate", path, *kind, "--force", "--seconds", "0.1")
    assert "at 3 of 3 saved times" in lieint("plot", "spun.npz", *kind, "--force")


def test_a_slow_top_falls_and_a_fast_one_sleeps(folder):
    """At 0.975 and 1.5 of the spin that it needs: 2√(J₁ weight)/J₃ = 4 rad/s."""
    greatest = {}
    for spin in (3.9, 6.0):
        state = {"quaternion": [1.0, 0, 0, 0], "angular_velocity_rad": [0.0, 0.0, spin]}
        scenario = scenarios.load("top.toml", state=state, steps=1000)
        step, states = scenario.build()
        run = kind_run(step, states, scenario)
        greatest[spin] = scenario.quantities(run)[0].values[1:].max()
    assert greatest[6.0] < 1.5
    assert greatest[3.9] > 5


@pytest.mark.long
def test_a_kind_with_keys_and_a_state_of_its_own_runs(folder, lieint):
    """A fast top: its precession is near m g r / (J₃ Ω), and each member has its own mass and tilt."""
    out = lieint("run", "spun.toml", "--no-certificate", "--no-pictures")
    rate = re.search(r"precession rate \(rad/s\) +(\S+) +(\S+)   3.27 ± 0.1", out)
    assert float(rate[1]) == pytest.approx(3.27, rel=0.05)  # of first order in 1/spin²
    assert float(rate[2]) > 0
    assert "mass_kg 2 %" in out
    assert "tilt_deg 1" in out


def write(old, new, name="top.py"):
    """The kind of the page with a change."""
    text = Path(name).read_text(encoding="utf-8")
    assert old in text
    Path(name).write_text(text.replace(old, new), encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("top.py", "def draw_tilt", "def tilted", "a picture is a method draw_NAME, .* got tilted"),
        ("top.py", "def make_system", "def system_of", r"SleepingTop of top\.py must define make_system"),
        ("spun.py", "def start", "def begin", r"SpunTop of spun\.py must define start"),
    ],
)
def test_a_class_that_is_no_kind_is_refused_when_it_is_read(folder, name, old, new, message):
    write(old, new, name)
    with pytest.raises(ValueError, match=message):
        scenarios.load(name.replace(".py", ".toml"))


def test_the_checks_of_a_kind_and_of_those_it_extends_are_called(folder):
    check = "    def _check_tilt(self):\n        if self.tilt_deg > 90:\n            raise ValueError('too far')\n\n"
    write("    def make_system(self)", f"{check}    def make_system(self)", "spun.py")
    for keys, message in ((["tilt_deg=91.0"], "spun.toml: too far"), (["tilt_deg=91.0", "dt=0.0"], "dt must not be 0")):
        with pytest.raises(ValueError, match=message):
            scenarios.load("spun.toml", keys)
    assert scenarios.load("spun.toml", ["tilt_deg=89.0"]).tilt_deg == 89


def test_a_published_value_of_no_quantity_is_refused(folder):
    table = scenarios.table("spun.toml")
    table["published"]["precession"] = table["published"].pop("precession_rate")
    with pytest.raises(ValueError, match=r"published\.precession: no quantity has this key; precession_rate has"):
        scenarios.parse(table, "spun.toml")


def test_a_quantity_of_another_shape_is_refused(folder):
    write("max(axis=0)", "max(axis=1)")
    scenario = scenarios.load("top.toml", steps=40)
    run = kind_run(*scenario.build(), scenario)
    with pytest.raises(
        ValueError, match=r"greatest_tilt, greatest tilt \(°\), must return values \(3,\), one for each"
    ):
        scenario.quantities(run)


def test_numpy_in_a_kind_whose_numbers_have_a_spread_is_explained(folder):
    write("jnp.deg2rad(self.tilt_deg)", "np.deg2rad(self.tilt_deg)", "spun.py")
    write("import jax.numpy as jnp", "import jax.numpy as jnp\nimport numpy as np", "spun.py")
    with pytest.raises(ValueError, match=r"traced in SpunTop: use jax\.numpy .* or set traced = False"):
        scenarios.load("spun.toml").build()
    write("    mass_kg: PositiveFloat", "    traced = False\n    mass_kg: PositiveFloat", "spun.py")
    step, states = scenarios.load("spun.toml").build()
    assert states.q.shape == (3, 4)
    assert step.system.inertia.shape == (3, 3)


def with_a_potential(potential):
    """The kind SpunTop with a system whose potential is a function."""
    text = Path("spun.py").read_text(encoding="utf-8")
    first, last = text.index("return systems."), text.index("    def start")
    text = f"{text[:first]}return systems.potential_top(J, {potential})\n\n{text[last:]}"
    height = "from jax.tree_util import Partial\n\ndef height(mass, Gamma):\n    return 0.3 * mass * Gamma[2]\n\n"
    Path("spun.py").write_text(text if height in text else height + text, encoding="utf-8")


@pytest.mark.parametrize("traced", [True, False])
def test_a_function_that_uses_a_number_with_a_spread_is_explained(folder, traced):
    """Otherwise the run fails within JAX, where nothing names the kind; a function of other numbers may use them."""
    if not traced:
        write("    mass_kg: PositiveFloat", "    traced = False\n    mass_kg: PositiveFloat", "spun.py")
    with_a_potential("lambda Gamma: 0.3 * self.mass_kg * Gamma[2]")
    with pytest.raises(ValueError, match=r"SpunTop defines must not itself use numbers .*Partial\(function, number\)"):
        scenarios.load("spun.toml").build()
    with_a_potential("Partial(height, self.mass_kg)")
    step, _ = scenarios.load("spun.toml").build()
    assert step.system.potential.args[0].shape == (3,)
    if traced:
        with_a_potential("lambda Gamma: 0.3 * self.radius_m * Gamma[2]")
        assert scenarios.load("spun.toml").build()[1].q.shape == (3, 4)


def kind_run(step, states, scenario):
    import lieint_jax as li

    return li.run(step, states, scenario.dt, scenario.steps, save_every=scenario.save_every, progress=False)


@pytest.mark.parametrize(
    ("system", "message"),
    [
        ("top.py:Top", r"system: top\.py has no kind 'Top'; it has SleepingTop"),
        ("tip.py:Top", r"system: there is no file 'tip\.py', neither here nor next to top\.toml"),
        ("top.py", r"system: top\.py has no kind ''; it has SleepingTop"),
        ("tops", r"system: must be 'binary' or .*, or 'FILE\.py:CLASS' \(got 'tops'\)"),
        ("bad.py:Top", r"system: bad\.py, line 1: ZeroDivisionError"),
        ("empty.py:Top", "it has none: a kind is a subclass of lieint_jax.app.kind.Kind"),
    ],
)
def test_a_kind_that_cannot_be_found_is_named(folder, system, message):
    Path("bad.py").write_text("1 / 0", encoding="utf-8")
    Path("empty.py").write_text("", encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        scenarios.load("top.toml", system=system)


def test_keys_of_an_own_kind_are_checked_like_those_of_others(folder):
    with pytest.raises(ValueError, match=r"weight: .*greater than 0"):
        scenarios.load("top.toml", weight=-1.0)
    with pytest.raises(ValueError, match="weights: unknown key; did you mean weight"):
        scenarios.parse(scenarios.table("top.toml") | {"weights": 1.0}, "top.toml")


@pytest.mark.long
def test_only_the_kind_that_runs_is_imported():
    import subprocess
    import sys

    code = "import sys; from lieint_jax.app import scenarios as s; s.load('toutatis'); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.rpartition(".")[2] for name in done.stdout.split() if "app.scenarios." in name}
    assert {name for name in loaded if not name.startswith("_")} == {"rigid_body"}


def test_a_spread_is_named_by_its_keys():
    class Swing(kind.RateSpread):
        tilt_rad: kind.NonNegative = 0.0
        arm_m: kind.NonNegative = 0.0
        speed_mm_s: kind.NonNegative = 0.0
        share: kind.NonNegative = 0.0

    found = Swing(angular_velocity_deg=2.0, tilt_rad=0.1, speed_mm_s=3.0).stated("s", "the arm's ")
    assert found == {
        "the arm's angular velocity": (2.0, "°/s"),
        "the arm's tilt": (0.1, "rad"),
        "the arm's arm": (0.0, "m"),
        "the arm's speed": (3.0, "mm/s"),
        "the arm's share": (0.0, ""),
    }
    assert Swing(angular_velocity_rad=2.0).stated("h")["angular velocity"] == (2.0, "rad/h")


def test_the_face_has_what_it_lists():
    assert all(hasattr(kind, name) for name in kind.__all__)
    assert sorted(kind.__all__) == kind.__all__


def test_a_histogram_counts_every_member_and_those_without_a_value():
    """The highest bars are the sums of the parts; `shown` leaves out the tail; no value is an empty panel."""
    x = np.append(np.linspace(0.0, 1.0, 101), np.nan)
    _, axes = plots.figure(3)
    every, tail, empty = axes[0]
    kind.draw_histogram(every, {"early": x[:40], "late": x[40:]}, "fall (s)", {"mean": 0.5})
    early, late = every.containers
    assert sum(bar.get_height() for bar in early) == 40
    assert sum(bar.get_height() for bar in late) == 61
    assert max(bar.get_y() + bar.get_height() for bar in (*early, *late)) < 10
    assert every.get_xlabel() == "fall (s); 1 of 102 have none"
    assert [text.get_text() for text in every.get_legend().get_texts()] == ["early", "late", "mean"]
    kind.draw_histogram(tail, {"": x[:101]}, "fall (s)", shown=0.9)
    assert sum(bar.get_height() for bar in tail.patches) == 91
    assert tail.get_legend() is None
    kind.draw_histogram(empty, {"": x[-1:]}, "fall (s)")
    assert not empty.patches


def test_paths_are_drawn_in_as_many_dimensions_as_the_panel_has():
    path = np.arange(6.0).reshape(2, 3)
    fig, axes = plots.figure(1)
    for ax in (axes[0, 0], fig.add_subplot(projection="3d")):
        kind.draw_paths(ax, {"center": path, "tip": path + 1})
        assert [line.get_label() for line in ax.lines] == ["center", "tip"]
        assert len({line.get_color() for line in ax.lines}) == 2
        np.testing.assert_array_equal(
            np.stack(getattr(ax.lines[0], "get_data_3d", ax.lines[0].get_data)()).T[:, 1], path[:, 1]
        )


def test_a_store_of_an_own_scheme_is_described_by_its_system(tmp_path, lieint):
    """Its class is not imported, and its step cannot be rebuilt; energies need the system only."""
    import lieint_jax as li

    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    found = li.schemes.so3_explicit(body)
    Own = li.pytree(type("Own", (type(found),), {"__module__": __name__, "__annotations__": {}}))
    state = body.state(angular_velocity=[0.1, 0.2, 1.0])
    li.run(Own(**vars(found)), state, 0.1, 8, progress=False, store=tmp_path / "own.zarr")
    assert "largest change of energy" in lieint("info", tmp_path / "own.zarr")
    with pytest.raises(ValueError, match=r"test_own_kind\.Own"):
        li.open(tmp_path / "own.zarr")
