"""Checks on several Pythons and on the lowest versions promised: `nox`, or one session, such as `nox -s tests-3.13`.

The interpreters must be there; a missing one is skipped. Environments are made by uv, which comes with the `dev` extra.
"""

from pathlib import Path

import nox

nox.options.default_venv_backend = "uv"
nox.options.error_on_missing_interpreters = False
nox.options.sessions = ["tests", "lowest", "lint", "docs", "build"]
PYTHONS = ["3.11", "3.12", "3.13", "3.14"]
NIGHTLY = "https://us-python.pkg.dev/ml-oss-artifacts-published/jax/simple/"  # of JAX


@nox.session(python=PYTHONS)
def tests(session):
    """README's tests, with the newest versions of everything."""
    session.install("-e", ".[test]")
    session.run("pytest", *session.posargs)


@nox.session(python="3.11")
def lowest(session):
    """README's tests, with the lowest versions that pyproject.toml promises."""
    session.install("-e", ".[test]", "--resolution", "lowest-direct")
    session.run("pytest", *session.posargs)


@nox.session(python="3.13")
def prerelease(session):
    """README's tests with JAX's nightly release. A warning of a deprecation fails here before it becomes an error."""
    session.install("-e", ".[test]")
    session.install("--upgrade", "--prerelease=allow", "--index", NIGHTLY, "jax", "jaxlib")
    session.run("pytest", *session.posargs)


@nox.session(python="3.13")
def audit(session):
    """Known vulnerabilities of what `pip install .` installs."""
    session.install(".", "pip-audit")
    session.run("pip-audit")


@nox.session(python="3.11")
def lint(session):
    """Lint, format and types."""
    session.install("-e", ".[dev]")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("pyright", "--pythonpath", f"{session.virtualenv.bin}/python")


@nox.session(python="3.11")
def docs(session):
    """The documentation site, strictly: every internal link leads somewhere. It is left in docs/build."""
    session.install("-e", ".[docs]")
    session.run("mkdocs", "build", "--strict", "-f", "docs/mkdocs.yml")


@nox.session(python="3.11")
def coverage(session):
    """Which lines README's tests run."""
    session.install("-e", ".[dev]")
    session.run("pytest", "--cov=lieint_jax", "--cov-report=term-missing:skip-covered", *session.posargs)


@nox.session(python="3.11")
def mutate(session):
    """Whether README's tests notice the changes that tests/mutations.toml lists; `nox -s mutate -- --shard 1/4`."""
    session.install("-e", ".[test]")
    session.run("python", "tests/mutate.py", *session.posargs)


@nox.session(python="3.11")
def build(session):
    """The sdist and the wheel, installed and tried away from the sources; tests and site from the unpacked sdist."""
    folder = session.create_tmp()
    session.run("uv", "build", "--out-dir", folder, external=True)
    python = f"{session.virtualenv.bin}/python"
    with session.chdir(folder):
        for kind in ("*.tar.gz", "*.whl"):
            [archive] = map(str, Path().glob(kind))
            session.run("uv", "pip", "install", "--python", python, "--reinstall-package", "lieint_jax", archive)
            session.run("lieint", "check", "rigid_body", "--scheme", "exact", "--steps", "100")
            session.run("lieint", "run", "toutatis", "--members", "3", "--steps", "1600", "--out", f"{archive}.zarr")
        session.run("tar", "xzf", str(next(Path().glob("*.tar.gz"))), "--strip-components=1", external=True)
        session.install(".[test,docs]")
        session.run("pytest", "-n", "0", "tests/pages/test_readme.py", "tests/pages/test_release.py")
        session.run("mkdocs", "build", "--strict", "-f", "docs/mkdocs.yml")
