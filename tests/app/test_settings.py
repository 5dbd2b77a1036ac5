"""`lieint run --set`, `--quiet`, `--verbose`, `--version`: values of any key, checked like a file; what is printed."""

import importlib.metadata
import logging
from pathlib import Path

import pytest
import scenario_files

import lieint_jax as li
from lieint_jax.app import printer, scenarios
from lieint_jax.app.command import cli
from lieint_jax.runs import store as archives

SHORT = dict(steps="steps = 100", save_every="save_every = 10", members="members = 4")


@pytest.fixture(autouse=True)
def book(tmp_path, monkeypatch):
    """A scenario file of a few short runs; afterwards the command prints as by default."""
    monkeypatch.chdir(tmp_path)
    Path("book.toml").write_text(scenario_files.book(**SHORT))
    yield
    printer.choose("normal")


def test_values_are_those_of_a_file_that_has_them():
    """Numbers, lists, texts with and without quotes, keys of tables that the file lacks, and a removed key."""
    changes = dict(
        dt="dt = 0.25",
        quaternion="quaternion = [0.0, 1.0, 0.0, 0.0]",
        title='title = "The same body"',
        scheme='scheme = "gauss"\norder = 8\nsources = {"a.b" = "a book"}',
        angular_velocity_deg="",
    )
    Path("other.toml").write_text(scenario_files.book(**SHORT | changes))
    given = ["dt=0.25", "state.quaternion=[0.0, 1.0, 0.0, 0.0]", "title=The same body", 'scheme = "gauss"', "order=8"]
    given += ['sources."a.b"=a book', "spread.angular_velocity_deg="]
    assert scenarios.load("book.toml", given) == scenarios.load("other.toml")
    assert scenarios.load("book.toml", ["members=7", "dt=3", "dt=0.5"], members=2, steps=None).members == 2


@pytest.mark.long
def test_an_epoch_is_in_the_report_and_in_the_results(lieint):
    date = "2026-03-01T12:00:00 TDB"
    for file in ("a.npz", "a.zarr"):
        more = ["--no-pictures", "--no-certificate", "--out", file]
        assert f"100 steps of 0.1 s = 10 s, t = 0 at {date}" in lieint(
            "run", "book.toml", "--set", 'epoch="2026-03-01T12:00 TDB"', *more
        )
        assert f"t = 0 … 10 s; t = 0 at {date}" in lieint("info", file)
    assert li.open("a.zarr").epoch == li.dates.epoch(date)
    with pytest.raises(ValueError, match=r"book\.toml: epoch: the date .* does not exist"):
        scenarios.load("book.toml", ['epoch="2026-02-30"'])
    assert scenarios.load("apophis").date_of_zero().isoformat() == "2029-04-13T21:45:04+00:00"
    with pytest.raises(ValueError, match="t = 0 is the perigee"):
        scenarios.load("apophis", epoch=date)


def test_a_table_of_a_list_is_named_or_counted():
    name, _, *_ = [body.name for body in scenarios.load("sn263").bodies]
    by_name = scenarios.load("sn263", [f"bodies.{name}.mass_kg=2e12", "bodies.2.mass_kg=1e9"])
    assert [body.mass_kg for body in by_name.bodies][:2] == [2e12, 1e9]
    assert by_name.bodies[2] == scenarios.load("sn263").bodies[2]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("sed=1", r"book\.toml: sed: unknown key; did you mean seed\?; allowed: title"),
        ("stat.quaternion=[1,0,0,0]", r"book\.toml: stat: unknown key; did you mean state\?"),
        ("state.quaternio=[1,0,0,0]", r"state\.quaternio: unknown key; did you mean quaternion\?"),
        ("dt=fast", r"dt: .*number.*\(got 'fast'\)"),
        ("dt.x=1", r"dt: .*number.*\(got \{'x': 1\}\)"),
        ("steps=55", "steps = 55 must be a multiple of save_every = 10"),
        ("scheme=rk4", "scheme: .*so3_midpoint"),
        ("state.quaternion=[1,0", r"--set state\.quaternion: must be a value of TOML, .* got \[1,0: "),
        ("dt=1\nmembers=2", "--set dt: must be a value of TOML"),
        ("dt", "--set dt: give KEY=VALUE, such as dt=0.1"),
        ("save_at=", "--set save_at: there is no such key to remove; the keys are title, time_unit, system"),
        (f"dt={'[' * 10000}", "--set dt: .*"),
        ("dt=1\nmembers=2", "--set dt: .* got several lines: 1\nmembers=2; give each key a --set of its own"),
        ("a.b=", r"--set a\.b: there is no such key to remove; its table has no keys"),
        ("dt.=1", r"--set dt\.=1: give KEY=VALUE"),
        (".dt=1", r"--set \.dt=1: give KEY=VALUE"),
        ("state=3", r"book\.toml: state: must be a table, as below \[state\] \(got 3\)"),
    ],
)
def test_a_bad_value_is_named_as_in_a_file(setting, message):
    with pytest.raises(ValueError, match=message):
        scenarios.load("book.toml", [setting])


def test_the_bodies_of_a_scenario_are_listed():
    with pytest.raises(
        ValueError, match=r"--set bodies\.Eve\.mass_kg: bodies is a list of tables: give a key of Alpha"
    ):
        scenarios.load("sn263", ["bodies.Eve.mass_kg=1.0"])


@pytest.mark.long
def test_a_run_stores_the_scenario_with_these_values_and_quiet_prints_paths_only(capfd):
    assert cli.main(["run", "-q", "book.toml", "--set", "state.angular_velocity_rad=[0.0, 0.0, 1.0]"]) == 0
    out, err = capfd.readouterr()
    assert [Path(line).is_file() for line in out.splitlines()] == [True] * 5
    assert not err
    stored = archives.load_results(Path("book.npz"))[1]["scenario"]
    assert stored["state"]["angular_velocity_rad"] == [0.0, 0.0, 1.0]


@pytest.mark.long
def test_verbose_names_the_engine_its_reason_and_the_times_of_phases(capfd):
    arguments = ["run", "book.toml", "--no-pictures", "--no-certificate"]
    assert cli.main(["-v", *arguments]) == 0
    out, err = capfd.readouterr()
    assert "lieint: machine code, in" in err
    for phase in ("making the scenario", "the run", "the report"):
        assert f"lieint: {phase}: " in err
    with li.engine("xla"):
        assert cli.main([*arguments, "--verbose"]) == 0
    assert "XLA runs" in capfd.readouterr().err
    assert cli.main(arguments) == 0
    assert capfd.readouterr().err == ""
    assert "machine code" not in out


def test_quiet_hides_reports_but_neither_errors_nor_results_that_were_asked_for(capsys, lieint):
    assert lieint("--quiet", "schema").startswith("{")
    assert cli.main(["-q", "run", "nowhere"]) == 2
    printer.show("a report")
    printer.show_written("a.npz", "a.png", about="1 MB")
    logging.getLogger("lieint_jax.runs").warning("slow")
    out, err = capsys.readouterr()
    assert out == "a.npz\na.png\n"
    assert err.startswith("lieint: there is no scenario 'nowhere'")


@pytest.mark.parametrize("arguments", [["--version"], ["run", "--version"], ["list", "--version"]])
def test_the_version_names_the_package_jax_and_python(arguments, capsys):
    with pytest.raises(SystemExit, match="0"):
        cli.main(arguments)
    found = capsys.readouterr().out
    assert found.startswith(f"lieint_jax {li.__version__}, jax {importlib.metadata.version('jax')}, python 3.")
