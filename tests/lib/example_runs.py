"""An example as a test runs it: what it prints, and its run, opened from its store."""

import contextlib
import inspect
import io

import lieint_jax as li


def run_example(example, folder, own=None, **options):
    """The printed report of an example without pictures and certificate, and its run; `own` is that of `li.open`."""
    quiet = {x: False for x in ("pictures", "certificate") if x in inspect.signature(example.main).parameters}
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        example.main(out=folder / "run.zarr", **quiet, **options)
    return printed.getvalue(), li.open(folder / "run.zarr", own)
