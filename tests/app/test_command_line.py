"""The command: the main job on a small ensemble, certificates, and one clear line for whatever is wrong."""

import json
import os
import re
import typing
from pathlib import Path

import jax
import numpy as np
import pytest
import scenario_files
import scenario_runs

import lieint_jax as li
from lieint_jax import _discover, measure, schemes, systems
from lieint_jax.app import scenarios
from lieint_jax.app.command import check_groups, cli
from lieint_jax.app.command import info as info_command
from lieint_jax.app.scenarios import rigid_body
from lieint_jax.runs import store as archives
from lieint_jax.types import State, StepInfo, Trajectory

pytestmark = pytest.mark.usefixtures("fresh_folder")


def book(**changes):
    """Write the scenario of a few short runs, with these lines in place of its own, and return the file's name."""
    short = dict(steps="steps = 100", save_every="save_every = 10", members="members = 4")
    Path("book.toml").write_text(scenario_files.book(**short | changes))
    return "book.toml"


@pytest.fixture(scope="module")
def toutatis(tmp_path_factory):
    """`lieint run toutatis` with few members for its first 24 days: output and results."""
    folder = tmp_path_factory.mktemp("toutatis")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        import contextlib
        import io

        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            assert cli.main(["run", "toutatis", "--members", "4", "--steps", "4800"]) == 0
    return folder, out.getvalue()


@pytest.mark.long
def test_toutatis_reaches_the_radar_epoch_and_meets_the_independent_prediction(toutatis):
    """An integration at rtol 1e-12 by another package gave (115.52, 81.96, 110.69)° and 8.60° from the radar fix."""
    _, out = toutatis
    euler = re.search(r"Euler 3-1-3 .*predicted \(([^)]*)\)", out)[1]
    np.testing.assert_allclose([float(x) for x in euler.split(",")], [115.52, 81.96, 110.69], rtol=0, atol=0.05)
    rate = re.search(r"body rate .*predicted \(([^)]*)\)", out)[1]
    np.testing.assert_allclose([float(x) for x in rate.split(",")], [-38.55, 1.46, -97.14], rtol=0, atol=0.05)
    assert float(re.search(r"observed: ([\d.]+)°;", out)[1]) == pytest.approx(8.60, abs=0.03)
    assert float(re.search(r"own error: ([\d.]+)°", out)[1]) < 0.04


@pytest.mark.long
def test_toutatis_writes_results_and_pictures(toutatis):
    folder, _ = toutatis
    run, metadata = archives.load_results(folder / "toutatis.npz")
    assert run.state.q.shape == (31, 4, 4)
    assert metadata["scenario"]["members"] == 4
    assert abs(run.t[29] - 23.159873) < 1e-9  # the radar epoch is one of the saved times
    for name in ("toutatis-path.png", "toutatis-invariants.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
@pytest.mark.parametrize("members", [2])
def test_the_periods_of_toutatis_over_800_days_are_those_of_its_state(members):
    """7.3998 d and 5.3804 d by an independent integration; the published ones are 7.40 and 5.38, ± 0.03."""
    scenario = scenarios.load("toutatis", members=members)
    run = scenario_runs.run(scenario)
    assert run.t[-1] >= 800
    precession, rotation, _ = measure.periods(run)
    assert precession[0] == pytest.approx(7.3998, abs=2e-4)
    assert rotation[0] == pytest.approx(5.3804, abs=2e-4)
    rows = {row.name: row for row in scenario.quantities(run)}
    assert rows["angular momentum longitude (°)"].nominal == pytest.approx(180.46, abs=0.01)
    assert rows["angular momentum latitude (°)"].nominal == pytest.approx(-54.70, abs=0.01)


@pytest.mark.long
def test_measured_periods_of_symmetric_bodies_are_the_closed_form():
    """A symmetric top, long and flat, and turned axes: precession |π|/J₁, rotation in the body Ω₃(J₁−J₃)/J₁."""
    import jax.numpy as jnp

    from lieint_jax.groups import so3

    turn = so3.to_matrix(so3.exp(jnp.array([0.4, -0.2, 0.7])))
    for J in (np.array([2.0, 2.0, 1.0]), np.array([1.0, 1.0, 1.7])):
        Omega, angle = np.array([0.3, 0.1, 0.9]), np.linalg.norm(J * [0.3, 0.1, 0.9])
        for body, rate in (
            (li.systems.rigid_body(J), Omega),
            (li.systems.rigid_body(turn @ np.diag(J) @ turn.T), turn @ Omega),
        ):
            state = body.state(angular_velocity=rate)
            states = jax.tree.map(lambda x: jnp.stack([x, x]), state)
            run = li.run(li.schemes.so3_midpoint(body), states, 0.01, 20_000, save_every=100, progress=False)
            precession, rotation, _ = measure.periods(run)
            np.testing.assert_allclose(precession, 2 * np.pi / (angle / J[0]), rtol=1e-3)
            np.testing.assert_allclose(rotation, 2 * np.pi / abs(0.9 * (J[2] - J[0]) / J[0]), rtol=1e-3)


@pytest.mark.long
def test_a_custom_scenario_file_runs(lieint, monkeypatch):
    out = lieint("run", book())
    assert "4 member(s), 100 steps of 0.1" in out
    run, _ = archives.load_results(scenarios.Path("book.npz"))
    assert run.state.q.shape == (11, 4, 4)
    monkeypatch.setattr(info_command, "draw", lambda *_: [])  # the second run's, for time
    assert cli.main(["run", book(), "--steps", "50", "--no-certificate"]) == 0  # a second run loses nothing
    assert archives.load_results(scenarios.Path("book.npz"))[0].state.q.shape == (11, 4, 4)
    assert archives.load_results(scenarios.Path("book-2.npz"))[0].state.q.shape == (6, 4, 4)


@pytest.mark.long
def test_a_run_can_omit_the_certificate_and_the_pictures(lieint):
    out = lieint("run", book(), "--no-certificate", "--no-pictures")
    assert "ertif" not in out
    assert "drawing" not in out
    assert "± ensemble" in out
    assert "4 of 4 members converged at every step" in out
    assert os.listdir() == ["book.toml", "book.npz"] or os.listdir() == ["book.npz", "book.toml"]
    out = lieint("info", "book.npz")
    assert "t = 0 … 10 s" in out
    assert re.search(r"at 11 of 11 saved times: \S+ in the run's units \(\S+ of the largest energy\)", out)


@pytest.mark.long
def test_rigid_body_scenarios_accept_every_scheme_of_a_free_body():
    body = systems.rigid_body([1.0, 2.0, 3.0])
    takes = {name for name, module in _discover.modules_with("examples", schemes).items() if module.examples(body)}
    kinds = rigid_body.FreeBody.model_fields["scheme"].annotation
    assert set(typing.get_args(kinds)) == takes - {"compose"}  # which is the key `order`
    for scheme, order, step in (("gauss", "", 16), ("gauss", "order = 8", 8), ("extrapolate", "", 12)):
        built = scenarios.load(book(scheme=f'scheme = "{scheme}"\n{order}')).build()[0]
        assert (built.name.partition("[")[0], built.order) == (scheme, step)


@pytest.mark.long
def test_the_same_seed_is_the_same_ensemble():
    a, b, c = (scenarios.load(book(seed=f"seed = {s}")).build()[1] for s in (1, 1, 2))
    np.testing.assert_array_equal(a.p, b.p)
    assert np.abs(np.asarray(a.p) - np.asarray(c.p)).max() > 1e-3
    nominal = scenarios.load(book(), members=1).build()[1]
    np.testing.assert_array_equal(a.p[0], nominal.p[0])  # member 0 is the nominal state


BAD = [  # beside those of test_bad_keys.py
    (dict(scheme="scheme = exact # closed form"), r'not valid TOML: .*; text must be in quotes: scheme = "exact"$'),
    (dict(title="title = "), "not valid TOML"),
    (dict(dt="dt = 0"), "dt must not be 0"),
    (dict(dt="dt = 3.0"), "first step fails for 4 member"),
]


@pytest.mark.long
@pytest.mark.parametrize(("changes", "message"), BAD, ids=[m[:30] for _, m in BAD])
def test_a_file_that_cannot_be_run_is_refused_in_one_line(changes, message, lieint):
    err = lieint.refuse("run", book(**changes))
    assert err.count("\n") == 1
    assert re.search(message, err)
    assert not list(scenarios.Path().glob("*.npz"))


def test_the_key_that_a_message_names_for_a_list_of_standard_deviations_accepts_it():
    found = scenarios.load(book(angular_velocity_deg="state.angular_velocity_rad = [1.0, 2.0, 3.0]"))
    assert list(found.own_numbers()) == [("state", "angular_velocity_rad")]
    several = Path(scenarios.__file__).parent.joinpath("sn263.toml").read_text(encoding="utf-8")
    text = several.replace("{mass_percent = 0.24}", "{position_m = [1.0, 1.0, 1.0]}")
    Path("several.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"in \[spread\], bodies\.[\w ]+\.position_m accepts a list"):
        scenarios.load("several.toml")


@pytest.mark.long
def test_a_warning_is_shown_once(capsys):
    """The triangle inequality is checked where the file is read and where the system is made."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert cli.main(["run", book(inertia="inertia = [1.0, 2.0, 4.0]"), "--no-certificate", "--no-pictures"]) == 0
    assert capsys.readouterr().err.count("triangle inequality") == 1


def test_the_printed_schema_has_every_kind_of_scenario(lieint):
    schema = json.loads(lieint("schema"))
    assert len(schema["oneOf"]) == len(scenarios.kinds())
    systems = [
        schema["$defs"][kind["$ref"].split("/")[-1]]["properties"]["system"]["const"] for kind in schema["oneOf"]
    ]
    assert set(systems) == set(scenarios.kinds())


def test_a_file_that_holds_no_result_is_refused_in_one_line(lieint):
    scenarios.Path("x.npz").write_bytes(b"no archive")
    np.savez("y.npz", a=np.zeros(3))
    np.savez("z.npz", p=np.array([None]))
    for name, metadata in (("e.npz", {}), ("t.npz", {"title": "mine"})):
        info = StepInfo(np.zeros((2, 3)), np.ones((2, 3), bool))
        archives.write_trajectory(
            Path(name), Trajectory(np.arange(2.0), State(np.ones((2, 3, 4)), np.ones((2, 3, 3))), info), metadata
        )
    for name in ("x.npz", "y.npz", "z.npz", "e.npz", "t.npz"):
        error = lieint.refuse("info", name)
        assert f"{name} is no file of results that lieint wrote" in error
        assert "pickle" not in error  # numpy's advice to allow them would run whatever the file says


def test_info_describes_a_file_without_a_scenario(lieint):
    info = StepInfo(np.zeros((2, 3)), np.ones((2, 3), bool))
    states = State(np.ones((2, 3, 4)), np.ones((2, 3, 3)))
    archives.write_trajectory(
        scenarios.Path("mine.npz"), Trajectory(np.array([0.0, 0.5]), states, info), {"lieint_jax": "0.1"}
    )
    out = lieint("info", "mine.npz")
    for text in ("mine.npz", "3 member(s), 2 entries; lieint_jax 0.1", "t = 0 … 0.5"):
        assert text in out


@pytest.mark.long
def test_check_groups_prints_a_table(lieint, monkeypatch):
    group = check_groups.catalogue()["Aff(1)"]
    monkeypatch.setattr(check_groups, "catalogue", lambda: {group.name: group})
    head, _, row = lieint("check", "groups").strip().splitlines()
    assert head == "| group | energy | form, exponential | cayley | arcsine |"
    assert re.fullmatch(r"\| Aff\(1\) \| \S+ \| \S+ \| (—|\S+) \| \S+ \|", row)


def test_an_observation_before_the_start_of_the_run_is_refused_with_the_sign_of_dt():
    with pytest.raises(ValueError, match=r"observation\.t = 23.159873 .*other side of t = 0.*dt = -0.005: give dt > 0"):
        scenarios.load("toutatis", dt=-0.005)


@pytest.mark.long
def test_check_reports_where_there_is_nothing_to_check(lieint):
    for arguments, message in (
        (["check", "rocket"], "no system 'rocket'.*lieint check rigid_body"),
        (["check", "rigid"], r"no system 'rigid', did you mean rigid_body\?"),
        (["check", "rigid_body", "--scheme", "rk4"], "no scheme with 'rk4'.*exact, extrapolate"),
    ):
        assert re.search(message, lieint.refuse(*arguments))


def test_bad_commands_end_with_a_message_that_helps(lieint):
    Path("file").write_text("")
    for arguments, message in (
        (["run", "nowhere"], "there is no scenario 'nowhere': `lieint list` shows all; or give a .toml file"),
        (["run", "toutatos"], r"there is no scenario 'toutatos': did you mean toutatis\? `lieint list`"),
        (["run", "nofile.toml"], "there is no file nofile.toml; `lieint list` shows the scenarios"),
        (
            ["run", "toutatis", "--save-at", "no.txt"],
            "there is no file no.txt: give a text file with one number per line",
        ),
        (["info", "no.npz"], r"there is no file no\.npz; lieint run NAME --out no\.npz writes one"),
        (["plot", "no.zarr"], r"there is no file no\.zarr; lieint run NAME --out no\.zarr writes one"),
        (["info", "."], r"\. is a folder without results; pass a file NAME\.npz or a store NAME\.zarr"),
        (["run", "toutatis", "--members", "0"], "members: .*greater than 0"),
        (["run", "toutatis", "--out", "results.csv"], r"\.npz or \.zarr, got results\.csv"),
        (["run", "toutatis", "--out", "no/where.npz"], "folder no does not exist"),
        (["run", "toutatis", "--out", "file/x.npz"], "file is a file, not a folder; choose another --out"),
        (["animate", "."], r"\. is a folder without results; pass a file NAME\.npz or a store NAME\.zarr"),
        (["run", "toutatis", "--out", "x.npz", "--resume"], "only a run written as .zarr can be resumed"),
        (["run", "toutatis", "--processes", "2"], "require --distributed"),
        (["run", "toutatis", "--devices", "99"], "99 devices were requested"),
        (["run", "toutatis", "--distributed", "--processes", "2"], "pass all of coordinator"),
        (["check", "rigid_body", "--published"], "--published has its own cases"),
        (["study", "pluto"], "study 'pluto' is not one of gyro, kappa"),
        (["figure", "9"], "figure 9 is not one of those recomputed; lieint figure 1 2 3 4 5"),
    ):
        assert re.search(message, lieint.refuse(*arguments))


def test_an_error_is_not_printed_on_stdout_where_stderr_is_closed(capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr", None)
    assert cli.main(["run", "nowhere"]) == 2
    assert capsys.readouterr().out == ""


def test_a_mistyped_command_points_to_its_help(capsys):
    for arguments, message in (([], "; see lieint --help"), (["run", "--steps", "x"], "; see lieint run --help")):
        with pytest.raises(SystemExit, match=r"^2$"):
            cli.main(arguments)
        assert message in capsys.readouterr().err


def test_an_existing_file_is_not_overwritten(lieint):
    scenarios.Path("mine.npz").write_text("precious")
    assert "exists and is not overwritten" in lieint.refuse("run", book(), "--out", "mine.npz")
    assert scenarios.Path("mine.npz").read_text() == "precious"


def test_existing_pictures_are_not_overwritten(lieint):
    scenarios.Path("mine-path.png").write_text("precious")
    assert "mine-path.png exists" in lieint.refuse("run", book(), "--out", "mine.npz")
    assert not scenarios.Path("mine.npz").exists()


def test_a_file_in_the_place_of_a_folder_is_refused(lieint):
    scenarios.Path("file").write_text("")
    assert lieint.refuse("figure", "1", "--out", "file").startswith("lieint: ")


def test_a_scenario_file_that_is_not_text_is_refused(lieint):
    scenarios.Path("bad.toml").write_bytes(b"\xff\xfe\x00")
    assert "bad.toml is not UTF-8" in lieint.refuse("run", "bad.toml")
    with open(book(), "rb") as file:
        scenarios.Path("bom.toml").write_bytes(b"\xef\xbb\xbf" + file.read())
    assert scenarios.load("bom.toml").members == 4


@pytest.mark.long
def test_check_prints_certificates(lieint):
    out = lieint("check", "rigid_body.asymmetric", "--scheme", "symplectic", "--steps", "100")
    assert out.count("so3_midpoint[symplectic] · RigidBody") == 1
    assert "exact to round-off" in out
    assert "every step converged" in out


@pytest.mark.long
def test_check_accepts_a_group(lieint):
    """However its name is written."""
    out = lieint("check", "se 2", "--scheme", "arcsine", "--steps", "20")
    assert "SE(2), dimension 3: Ad_q may grow" in out
    assert "Casimirs known: 1 of 1 (of degree 2); a symplectic map known: yes" in out
    assert re.search(r"symplectic form +\S+ +exact to round-off", out)
    assert "conserved bit for bit" in out


@pytest.mark.long
def test_groups_are_found_by_any_spelling_of_their_names():
    assert check_groups.find_group("heis 5").dim == 5
    assert check_groups.find_group("SO(3)xAff(1)").dim == 5
    assert check_groups.find_group("so3") == check_groups.catalogue()["SO(3)"]
    assert check_groups.find_group("E8") is None
    with pytest.raises(ValueError, match="no scheme 'rk4' on SL\\(3\\), where group_midpoint has the maps exponential"):
        check_groups.certificates(check_groups.find_group("sl3"), "rk4")
    assert {name for name, group in check_groups.catalogue().items() if group.has_bounded_adjoint} == {
        *("SO(3)", "SO(4)", "SU(2)", "Heis(3)", "Heis(5)", "R^3")
    }


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["--help"])
    assert stop.value.code == 0
    out = capsys.readouterr().out
    for word in ("run", "check", "figure", "toutatis", "my.toml"):
        assert word in out


@pytest.mark.long
def test_the_command_turns_float64_on():
    jax.config.update("jax_enable_x64", False)
    try:
        cli.main(["check", "nothing"])
        assert jax.config.jax_enable_x64
    finally:
        jax.config.update("jax_enable_x64", True)


@pytest.mark.long
def test_check_in_several_processes_prints_in_order(capfd):
    """Every scheme of both pendulums, each once; XLA's flags are those of before."""
    before = os.environ.get("XLA_FLAGS")
    assert cli.main(["check", "pendulum", "--steps", "20"]) == 0
    out = capfd.readouterr().out
    heads = re.findall(r"^(pendulum\.\w+)\n(\S+) ", out, re.M)
    names = ("sphere_chart", "sphere_midpoint[plain]", "sphere_midpoint[normalized]")
    assert heads == [(f"pendulum.{bob}", name) for name in names for bob in ("uniform", "quadratic")]
    assert os.environ.get("XLA_FLAGS") == before
