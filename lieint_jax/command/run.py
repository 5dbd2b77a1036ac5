"""The command `run`: it calls the function `main` of a script."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lieint_jax import _checks
from lieint_jax.command import listing, scripts
from lieint_jax.runs import want_devices

_LEAST = 200  # bytes of a member: the smallest state, its deviation and its result, in float64
USAGE = """usage: lieint run NAME | FILE.py [options]

Run an example that `lieint list` shows, or your own script: any file with a function `main`. Its options are the
arguments of `main`; lieint run NAME --help explains them."""


def run(name: str, options: Sequence[str], read: Callable[..., Any]) -> None:
    """Run an example, or your own script: any file with a function `main`, whose arguments are the options.

    Args:
        name: an example, or a file NAME.py.
        options: the words after its name.
        read: read(function, name, words) ↦ the call of the function with these options; None if help was wanted.
    """
    want_devices(None)  # what XLA computes uses all cores, as machine code does
    with scripts.importable(name):
        script = scripts.find(name)
        call = read(script.main, f"lieint run {name}", options)
        if call is None:
            return
        for argument in ("members", "steps"):  # by their meaning in every example
            if isinstance(number := call.keywords.get(argument), int) and number < 1:
                raise ValueError(f"--{argument} must be at least 1, got {number}")
        if isinstance(out := call.keywords.get("out"), Path) and not call.keywords.get("resume"):
            _refuse_existing(out)
        members = call.keywords.get("members")
        if isinstance(members, int) and members * _LEAST > (memory := _checks.memory_of_machine()):
            need, have = _checks.spoken_size(members * _LEAST), _checks.spoken_size(memory)
            raise ValueError(f"--members {members} needs at least {need} of memory, and this machine has {have}")
        if not options and scripts.is_example(script):
            listing.announce(f"run {Path(script.__file__).stem}")
        scripts.call(script, call)


def _refuse_existing(out: Path) -> None:
    """Raise ValueError if results at `out` would replace that file, or pictures next to it."""
    if out.suffix == ".zarr" and out.exists():
        raise ValueError(f"{out} exists and is not overwritten; --resume continues it, or choose another --out")
    for file in (out, *sorted(out.parent.glob(f"{out.stem}-[a-z]*.png"))) if out.suffix in (".zarr", ".png") else ():
        if file.exists():
            raise ValueError(f"{file} exists and is not overwritten; move it away or choose another --out")
