"""The option `--export FILE` of `lieint run`: a run in the formats of others, by the ending of the file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from lieint_jax import files
from lieint_jax.app.scenarios._files import SECONDS
from lieint_jax.app.scenarios._kind import Kind
from lieint_jax.capabilities import AbstractManyBodies, AbstractRotatingBody
from lieint_jax.dates import epoch
from lieint_jax.runs import Run
from lieint_jax.types import System


def check(paths: Iterable[Path], scenario: Kind) -> None:
    """Raise ValueError, before the run, if it cannot be written to these files."""
    for path in paths:
        _check(path, scenario)


def _check(path: Path, scenario: Kind) -> None:
    if path.suffix not in _WRITERS:
        raise ValueError(f"--export writes {', '.join(_WRITERS)}, got {path}")
    if path.exists():
        raise ValueError(f"{path} exists: remove it, or give another --export")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"there is no folder {path.absolute().parent} for {path}")
    if not os.access(path.absolute().parent, os.W_OK):
        raise ValueError(f"the folder of {path} cannot be written to: give another --export")
    if path.suffix not in (".aem", ".oem"):
        return
    if scenario.date_of_zero() is None:
        raise ValueError(f"{path} needs the date of t = 0: give the key epoch, such as --set epoch=2024-03-01T12:00:00")
    if scenario.time_unit not in SECONDS:
        raise ValueError(f"{path} is in seconds: time_unit must be one of {', '.join(SECONDS)}")
    if path.suffix == ".oem" and scenario.unit_km is None:
        raise ValueError(f"{path} is in km, and a scenario of the kind {scenario.system} has no unit of length")


def check_system(paths: Iterable[Path], system: System) -> None:
    """Raise ValueError, before the run, if one of these files has attitudes, and a run of this system has none."""
    for path in paths:
        several = {".csv": (), ".aem": (AbstractManyBodies,)}.get(path.suffix)
        if several is not None and not isinstance(system, (AbstractRotatingBody, *several)):
            name = type(system).__name__
            raise ValueError(f"{path} has attitudes of rigid bodies, and {name} is none: .nc has any run")


def write(path: Path, run: Run, scenario: Kind) -> None:
    """Write a run to a file; .aem and .oem hold the nominal member, of several bodies the second about the first."""
    _WRITERS[path.suffix](path, run, scenario)


def _write_orbit(path: Path, run: Run, scenario: Kind) -> None:
    facts = {"frame": "ICRF", **_facts(scenario), "unit_length": scenario.unit_km or 1.0}
    if (orbit := scenario.given_orbit()) is not None:
        files.write_oem(path, orbit, times=run.t, center="EARTH", **facts)
    else:
        files.write_oem(path, run.member(0), body=_body(run), about=0, center="PRIMARY", **facts)


def _write_dataset(path: Path, run: Run, scenario: Kind) -> None:
    data = run.to_xarray().assign_attrs(title=scenario.title, time_unit=scenario.time_unit)
    start = scenario.date_of_zero()
    dates = {"date": {"dtype": "float64", "units": f"seconds since {epoch(start).iso()}"}}  # which netCDF 3 has too
    data.to_netcdf(path, encoding={} if start is None else dates)


def _facts(scenario: Kind) -> dict[str, Any]:
    name = scenario.title.split(",")[0]
    return {"epoch": scenario.date_of_zero(), "object": name, "unit_time": SECONDS[scenario.time_unit]}


def _body(run: Run) -> int | None:
    """The second of several bodies, which moves about the first; None of one body."""
    several = run.state.q.shape[-1] == 7
    return min(1, run.state.q.shape[-2] - 1) if several else None


_WRITERS: dict[str, Callable[[Path, Run, Kind], None]] = {
    ".aem": lambda path, run, scenario: files.write_aem(path, run.member(0), body=_body(run), **_facts(scenario)),
    ".oem": _write_orbit,
    ".csv": lambda path, run, _: files.write_csv(path, run),
    ".nc": _write_dataset,
}
