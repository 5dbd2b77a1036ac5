"""`lieint run --parts N` on a cluster: tasks of a Dask scheduler, or one array of jobs of SLURM."""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lieint_jax.app import scenarios
from lieint_jax.app.printer import show


def check(options: argparse.Namespace) -> None:
    """Raise ValueError unless the options of a run in parts fit together, and its scenario is right."""
    engines = [f"--{name}" for name in ("dask", "slurm") if vars(options)[name] is not None]
    if options.parts is None:
        raise ValueError(f"{engines[0]} runs a scenario in parts: give their number too, as in --parts 8")
    if len(engines) != 1:
        raise ValueError(
            "--parts needs one of --dask ADDRESS and --slurm OPTIONS; --part K/N is one part in this process"
        )
    if options.part or options.distributed or options.devices:
        raise ValueError("--parts starts every part itself: leave out --part, --distributed and --devices")
    if options.out is None or options.out.suffix != ".zarr":
        raise ValueError("--parts needs --out NAME.zarr, a folder or URL that all workers reach")
    if options.slurm is not None and options.export:
        raise ValueError("--export writes the whole run: open the store of all parts in Python, with li.open")
    scenario = scenarios.load(options.scenario, options.set, members=options.members, steps=options.steps)
    if options.dask is not None and ":" in scenario.system:
        raise ValueError(f"the workers of Dask do not have the file of {scenario.system}: use --slurm, or --part K/N")


@contextmanager
def dask(address: str) -> Iterator[Any]:
    """The executor of a Dask scheduler; it starts a part again at most three times."""
    try:
        from distributed import Client
    except ImportError:
        raise ValueError("--dask needs Dask: pip install distributed, in the version of the cluster") from None
    with Client(address, set_as_default=False) as client:
        yield client.get_executor(retries=3)


def slurm(options: argparse.Namespace) -> None:
    """Write a script with one task for each part, and submit it."""
    words = ["run", options.scenario, "--out", str(options.out), "--part", "auto"]
    for name in ("members", "steps", "save_at"):
        value = vars(options)[name]
        words += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
    words += [f"--set={pair}" for pair in options.set] + ["--any-machine"] * options.any_machine
    script = Path(options.out.name).with_suffix(".sbatch")
    lines = [
        "#!/bin/bash",
        f"#SBATCH --job-name=lieint --array=0-{options.parts - 1} --requeue",
        f"#SBATCH {' '.join(options.slurm.split())}",
        f"exec {shlex.join([sys.executable, '-m', 'lieint_jax.app.command.cli', *words])}",
    ]
    script.write_text("\n".join(lines) + "\n", encoding="utf-8")
    try:
        found = subprocess.run(["sbatch", "--parsable", str(script)], capture_output=True, text=True)
    except FileNotFoundError:
        raise ValueError(
            f"there is no sbatch on this machine: submit {script}, which is written, where SLURM is"
        ) from None
    if found.returncode:
        raise ValueError(f"sbatch refuses {script}: {found.stderr.strip()}")
    show(f"{script} is job {found.stdout.strip()}; lieint info {options.out} names the parts that are missing")
