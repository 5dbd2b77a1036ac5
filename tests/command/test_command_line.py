"""The command: the main job on a small ensemble, scripts, certificates, and one clear line for whatever is wrong."""

import os
import re
import subprocess
import sys
import textwrap
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.command import check_groups, cli, run, scripts

pytestmark = pytest.mark.usefixtures("fresh_folder")

SCRIPT = '''
"""A book: it is thrown."""
import jax
import lieint_jax as li

def main(
    members: int = 4,
    steps: int = 100,
    out: str = "book.zarr",
    resume: bool = False,
    inertia: tuple[float, ...] = (1.0, 2.0, 2.5),
) -> None:
    """Throw the book.

    Args:
        members: the number of books.
        steps: the number of steps of 0.1 s.
        out: the store.
        resume: continue the run in `out`.
        inertia: the principal moments, kg m².
    """
    body = li.systems.rigid_body(inertia)
    states = jax.jit(jax.vmap(lambda w: body.state(angular_velocity=w)))(
        jax.numpy.array([0.1, 2.0, 0.1]) * jax.numpy.linspace(1.0, 1.1, members)[:, None]
    )
    run = li.run(li.schemes.so3_midpoint(body), states, 0.1, steps, save_every=10, store=out, resume=resume)
    print(li.report.text("A book", run, changed=li.report.changes(run)))
'''


@pytest.fixture
def book():
    """A script of a few short runs, under a name that no other test has imported."""
    book.count = getattr(book, "count", 0) + 1
    path = Path(f"book_{book.count}.py")
    path.write_text(SCRIPT)
    return path


def script(name, body):
    """Write a script whose `main` has these lines, and return its path."""
    lines = textwrap.indent(textwrap.dedent(body).strip(), "    ")
    Path(f"{name}.py").write_text(f"import lieint_jax as li\n\n\ndef main(members: int = 2) -> None:\n{lines}\n")
    return f"{name}.py"


@pytest.fixture(scope="module")
def toutatis(tmp_path_factory):
    """`lieint run toutatis` with few members for its first 24 days: its folder and its output."""
    import contextlib
    import io

    folder, out = tmp_path_factory.mktemp("toutatis"), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.chdir(folder)
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
def test_toutatis_writes_a_store_and_pictures(toutatis):
    folder, out = toutatis
    run = li.open(folder / "toutatis.zarr")
    assert run.state.q.shape == (31, 4, 4)
    assert abs(run.t[29] - 23.159873) < 1e-9  # the radar epoch is one of the saved times
    assert "exact to round-off a step" in out  # its certificate
    for name in ("toutatis-path.png", "toutatis-invariants.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")


def test_a_script_of_the_users_runs_and_its_store_is_described_and_drawn(lieint, book):
    out = lieint("run", book, "--members", 3, "--steps", 50)
    assert "3 member(s), 50 steps of 0.1 = 5, so3_midpoint[symplectic]" in out
    described = lieint("info", "book.zarr")
    assert "complete: 6 of 6 entries" in described
    assert re.search(r"at 6 of 6 saved times: \S+ in the run's units \(\S+ of the largest energy\)", described)
    again = lieint("plot", "book.zarr")
    assert again.startswith("Rigid body, book.zarr\n  3 member(s), 50 steps of 0.1 = 5, so3_midpoint[symplectic]\n")
    lieint.drew("book-errors.png", "book-motion.png")
    assert "book-errors.png exists and is not overwritten; --force" in lieint.refuse("plot", "book.zarr")


def test_a_store_is_not_overwritten_and_is_resumed_if_asked(lieint, book):
    lieint("run", book, "--steps", 50)
    kept = np.asarray(li.open("book.zarr").state.q)
    error = lieint.refuse("run", book, "--steps", 50)
    assert re.search(rf"book\.zarr exists and is not overwritten; resume .*\({book.name}, line \d+\)", error)
    lieint("run", book, "--steps", 50, "--resume")
    np.testing.assert_array_equal(kept, li.open("book.zarr").state.q)


def test_existing_pictures_are_not_overwritten(lieint):
    for out, picture, name in (("mine.zarr", "mine-path.png", "toutatis"), ("kappa.png", "kappa.png", "kappa")):
        Path(picture).write_text("precious")
        assert f"{picture} exists and is not overwritten" in lieint.refuse("run", name, "--out", out)
        assert Path(picture).read_text() == "precious"
    assert not Path("mine.zarr").exists()


def test_a_run_without_out_has_a_new_name_and_resumes_the_last_one(tmp_path):
    wanted = tmp_path / "run.zarr"
    assert li.report.new_path(wanted) == li.report.new_path(wanted, resume=True) == wanted
    wanted.mkdir()
    assert li.report.new_path(wanted) == tmp_path / "run-2.zarr"
    assert li.report.new_path(wanted, resume=True) == wanted
    (tmp_path / "run-2-path.png").touch()
    assert li.report.new_path(wanted) == tmp_path / "run-3.zarr"


def test_an_error_of_a_script_is_a_traceback_from_its_own_line(capsys):
    for name, line, last in (
        ("zero", "1 / 0", "ZeroDivisionError: division by zero"),
        ("mine", "raise ValueError('of my own')", "ValueError: of my own"),
        ("file", "open('nowhere.csv')", "FileNotFoundError: .*'nowhere.csv'"),
    ):
        path = script(name, line)
        assert cli.main(["run", path]) == 1
        head, first, *_, end = capsys.readouterr().err.strip().splitlines()
        assert head == "Traceback (most recent call last):"
        assert re.search(rf'File ".*{name}\.py", line 5, in main', first)
        assert re.fullmatch(last, end)


def test_what_this_package_refuses_is_one_line_with_the_line_of_the_script(lieint):
    error = lieint.refuse("run", script("flat", "li.systems.rigid_body([1.0, 2.0, -3.0])"))
    assert re.fullmatch(r"lieint: inertia must be positive definite, got .* \(flat\.py, line 5\)\n", error)


def test_a_fault_in_a_law_is_found_at_its_own_line(lieint):
    own = script(
        "faulty",
        """
        def law(t, q, omega):
            return np.asarray(omega) * 2.0

        li.systems.torqued_body([1.0, 2.0, 2.5], law)
        """,
    )
    Path(own).write_text("import numpy as np\n" + Path(own).read_text())
    error = lieint.refuse("run", own)
    assert "torque fails as a function of t" in error
    assert error.endswith("(faulty.py, line 7)\n")


def test_a_file_that_is_no_script_is_refused_in_one_line(lieint, capsys):
    Path("binary.py").write_bytes(b"\x00\x01")
    Path("latin.py").write_bytes(b"x = '\xff'\n")
    Path("no_main.py").write_text("x = 1\n")
    Path("json.py").write_text("def main(): pass\n")
    Path("syntax.py").write_text("def main(:\n")
    for name, message in (
        ("binary.py", "binary.py is no script: "),
        ("no_main.py", "no_main.py has no function `main`, which is what `lieint run` calls: see lieint list"),
        ("json.py", "json.py has the name of a module that is imported already: choose another name"),
        ("nowhere.py", "there is no file nowhere.py; `lieint list` shows the examples"),
        ("toutatos", "there is no example 'toutatos': did you mean toutatis? `lieint list` shows all"),
        ("my.toml", "there is no example 'my.toml': `lieint list` shows all; or give a file NAME.py"),
    ):
        assert message in lieint.refuse("run", name)
    for name in ("syntax.py", "latin.py"):
        assert cli.main(["run", name]) in (1, 2)
        assert "SyntaxError" in (error := capsys.readouterr().err) or "is no script" in error


def test_wrong_options_are_one_line_with_tyros_sentence(lieint, book):
    for arguments, message in (
        (["--members", "x"], "Error parsing --members: invalid literal for int() with base 10: 'x'. See lieint run"),
        (["--memers", "3"], "Unrecognized options: --memers, 3; did you mean --members? See lieint run"),
        (["--members"], "Missing value for argument '--members'. Expected 1 values. See lieint run"),
        (["--members", "0"], "--members must be at least 1, got 0"),
        (["--steps", "-5"], "--steps must be at least 1, got -5"),
        (["--members", str(10**12)], f"--members {10**12} needs at least 200 TB of memory, and this machine has"),
    ):
        error = lieint.refuse("run", book, *arguments)
        assert error.startswith(f"lieint: {message}")
        assert error.count("\n") == 1
    assert "invalid choice 'mars' for argument '--start'" in lieint.refuse("run", "toutatis", "--start", "mars")


def test_bad_commands_end_with_a_message_that_helps(lieint):
    Path("file").write_text("")
    for arguments, message in (
        ([], "give a command; see lieint --help"),
        (["rum"], r"there is no command 'rum': did you mean run\? See lieint --help"),
        (["run"], "give the script: lieint run NAME or FILE.py, and after it its options"),
        (["info", "no.zarr"], r"there is no file no\.zarr; lieint run NAME --out no\.zarr writes one"),
        (["plot", "no.zarr"], r"there is no file no\.zarr; lieint run NAME --out no\.zarr writes one"),
        (["info", "."], r"\. does not exist, or is not the store of a run"),
        (["animate", "."], r"\. does not exist, or is not the store of a run"),
        (["run", "toutatis", "--out", "results.npz"], r"a store is a folder that ends in \.zarr, got results\.npz"),
        (["run", "toutatis", "--out", "file/x.zarr"], "file/x.zarr cannot be created: Not a directory"),
        (["check", "rigid_body", "--published"], "--published has its own cases"),
        (["check", "rigid_body", "--all"], "--all checks every system"),
        (["check", "rigid_body", "--steps", "0"], "--steps is the number of steps, at least 1; got 0"),
        (["files"], r"give a file or several|[Mm]issing"),
        (["info"], r"[Mm]issing"),
    ):
        error = lieint.refuse(*arguments)
        assert re.search(message, error)
        assert error.count("\n") == 1


def test_an_interrupt_is_one_line_that_says_how_to_continue(capsys, monkeypatch):
    def interrupted():
        raise KeyboardInterrupt("stopped after 3 of 9 steps, all of them in x.zarr")

    def main(resume: bool = False):
        interrupted()

    monkeypatch.setattr(scripts.example("heavy_top"), "main", main)
    assert cli.main(["run", "heavy_top"]) == 130
    said = "lieint: stopped after 3 of 9 steps, all of them in x.zarr: the same command with --resume\n"
    assert capsys.readouterr().err == said
    monkeypatch.setattr(run, "run", lambda *_: interrupted())
    assert cli.main(["run", "heavy_top"]) == 130


def test_a_law_of_the_users_in_a_store_is_drawn_by_a_call_that_is_named(lieint):
    own = script(
        "drag",
        """
        body = li.systems.torqued_body([1.0, 2.0, 2.5], lambda t, q, omega: -0.01 * omega)
        states = body.state(angular_velocity=[0.1, 0.2, 0.3])
        li.run(li.schemes.torqued_midpoint(body), states, 0.1, 20, save_every=10, store="drag.zarr")
        """,
    )
    lieint("run", own)
    assert "energies are not computed: " in lieint("info", "drag.zarr")
    for command, call in (("plot", 'li.plots.overview(run, "drag.zarr")'), ("animate", "li.plots.animate(run, ")):
        error = lieint.refuse(command, "drag.zarr")
        assert "to li.open" in error
        assert call in error


def test_a_script_imports_the_files_beside_it(lieint):
    Path("sub").mkdir()
    Path("sub", "my_numbers.py").write_text("three = 3\n")
    Path("sub", "beside.py").write_text("from my_numbers import three\n\n\ndef main() -> None:\n    print(three)\n")
    assert lieint("run", "sub/beside.py") == "3\n"


def test_the_help_of_a_script_is_made_of_its_signature_and_docstring(lieint, book):
    shown = lieint("run", book, "--help")
    for text in ("--members INT", "the number of books.", "(default: 4)", "--resume", "the principal moments, kg m²."):
        assert text in shown
    assert "usage: lieint run NAME | FILE.py" in lieint("run", "--help")


def test_help_names_every_command(lieint):
    shown = lieint("--help")
    for name in cli.COMMANDS:
        assert f"\n  {name} " in shown
    assert "lieint run mine.py --members 100" in shown
    assert re.match(r"lieint_jax \S+, jax \S+, python 3", lieint("--version"))


def test_a_warning_is_shown_once(capsys, book):
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert cli.main(["run", str(book), "--inertia", "1.0", "2.0", "4.0", "--steps", "10"]) == 0
    assert capsys.readouterr().err.count("triangle inequality") == 1


def test_an_error_is_not_printed_on_stdout_where_stderr_is_closed(capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr", None)
    assert cli.main(["run", "nowhere"]) == 2
    assert capsys.readouterr().out == ""


def test_an_example_is_also_a_module_that_python_runs():
    command = [sys.executable, "-m", "lieint_jax.examples.heavy_top", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert "--members INT" in done.stdout


@pytest.mark.long
def test_the_command_turns_float64_on():
    jax.config.update("jax_enable_x64", False)
    try:
        cli.main(["check", "nothing"])
        assert jax.config.jax_enable_x64
    finally:
        jax.config.update("jax_enable_x64", True)


@pytest.mark.long
def test_check_groups_prints_a_table(lieint, monkeypatch):
    group = check_groups.catalogue()["Aff(1)"]
    monkeypatch.setattr(check_groups, "catalogue", lambda: {group.name: group})
    head, _, row = lieint("check", "groups").strip().splitlines()
    assert head == "| group | energy | form, exponential | cayley | arcsine |"
    assert re.fullmatch(r"\| Aff\(1\) \| \S+ \| \S+ \| (—|\S+) \| \S+ \|", row)


@pytest.mark.long
def test_check_reports_where_there_is_nothing_to_check(lieint):
    for arguments, message in (
        (["check", "rocket"], "no system 'rocket'.*lieint check rigid_body"),
        (["check", "rigid"], r"no system 'rigid', did you mean rigid_body\?"),
        (["check", "rigid_body", "--scheme", "rk4"], "no scheme with 'rk4'.*exact, extrapolate"),
    ):
        assert re.search(message, lieint.refuse(*arguments))


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


@pytest.mark.long
def test_check_in_several_processes_prints_in_order(capfd):
    """Every scheme of both pendulums, each once; XLA's flags are those of before."""
    before = os.environ.get("XLA_FLAGS")
    assert cli.main(["check", "pendulum", "--steps", "20"]) == 0
    out = capfd.readouterr().out
    heads = re.findall(r"^(pendulum\.\w+)\n(\S+) ", out, re.M)
    names = ("sphere_midpoint[plain]", "sphere_midpoint[normalized]")
    assert heads == [(f"pendulum.{bob}", name) for name in names for bob in ("uniform", "quadratic")]
    assert os.environ.get("XLA_FLAGS") == before
