"""What a store costs: the time to make one, and a run into it compared with the same run in memory.

4000 free bodies by the paper's midpoint rule, on all cores: 201 entries of 20 000 steps, and of 200 steps, where every
step is saved. Packing (copying, compression, checksums), writing and waiting for the disk are done by a thread while
the loop goes on, and the loop waits for it only where it is a whole row of chunks ahead.

    python benchmarks/store.py [--quick] [--out DIR] [--folder DIR]

The two runs of a row in turn, in one process; the least of the times counts, and the parts are those of that run. The
first store of a process, which imports what is needed, is listed alone.
"""

from __future__ import annotations

import functools
import itertools
import math
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

from lib import command

MEMBERS, SAVES = 4000, 200


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--folder", type=Path, metavar="DIR", help="where the stores are; a folder for temporary files")
    options = command.parsed(parser)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        result = command.under_load(lambda: measured(Path(folder), 3 if options.quick else 9))
    from lib import report

    load = f"load before and after: {result['load'][0]:.1f}, {result['load'][1]:.1f}"
    head = ["steps", "memory, s", "store, s", "store ÷ memory", *(f"{name}, s" for name in PARTS)]
    rows = [
        [steps, *(f"{row[key]:.3f}" for key in ("memory", "store", "ratio", *PARTS))]
        for steps, row in result["rows"].items()
    ]
    first, later = result["making"]
    making = (
        f"To make a store of {MEMBERS} members and {SAVES + 1} entries takes {1e3 * later:.0f} ms, of which the disk "
        f"{1e3 * result['sync of making']:.0f} ms; the first one of a process {1e3 * first:.0f} ms, by imports."
    )
    report.publish("store", [report.machine(result), load, making, report.table(head, rows)], result, options.out)


PARTS = ("loop", "waiting", "pack", "write", "sync")


class Clocks:
    """The seconds within some functions of the package, in whichever thread: the loop's, and those of a commit."""

    def __init__(self) -> None:
        from lieint_jax.runs._engine import Engine
        from lieint_jax.runs._storage.arrays import ArrayMetadata
        from lieint_jax.runs._storage.disk import Disk
        from lieint_jax.runs.store._store_output import StoreOutput
        from lieint_jax.runs.store._writer import Writer

        self.seconds: dict[str, float] = dict.fromkeys(PARTS, 0.0)
        self.made = self.sync_of_making = math.nan  # when the output began, and the seconds of `sync` until then
        timed: dict[str, tuple[Any, Any]] = {"loop": (Engine, Engine.run_intervals), "waiting": (Writer, Writer.wait)}
        timed |= {"pack": (ArrayMetadata, ArrayMetadata.encode), "write": (Disk, Disk.stage)}
        timed |= {"sync": (Disk, Disk.settle)}
        self.patches = [
            mock.patch.object(kind, method.__name__, self._timed(name, method))
            for name, (kind, method) in timed.items()
        ]
        self.patches.append(mock.patch.object(StoreOutput, "__init__", self._noting(StoreOutput.__init__)))

    def _timed(self, name: str, function: Any) -> Any:
        @functools.wraps(function)
        def call(*arguments: Any, **options: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                self.seconds[name] += time.perf_counter() - start

        return call

    def _noting(self, function: Any) -> Any:
        @functools.wraps(function)
        def init(*arguments: Any) -> None:
            self.made, self.sync_of_making = time.perf_counter(), self.seconds["sync"]
            function(*arguments)

        return init

    def __enter__(self) -> Clocks:
        for patch in self.patches:
            patch.start()
        return self

    def __exit__(self, *_: object) -> None:
        for patch in self.patches:
            patch.stop()


def measured(folder: Path, rounds: int) -> dict[str, Any]:
    import jax
    import numpy as np
    from lib import measure  # float64

    import lieint_jax as li

    body, rng = li.systems.rigid_body([1.0, 2.0, 3.0]), np.random.default_rng(0)
    states = jax.vmap(lambda w: body.state(angular_velocity=w))(rng.normal(size=(MEMBERS, 3)))
    step, names = li.schemes.so3_midpoint(body), itertools.count()

    def seconds(steps: int, store: Path | None) -> float:
        start = time.perf_counter()
        li.run(step, states, 0.05, steps, save_every=steps // SAVES, store=store, progress=False)
        return time.perf_counter() - start

    making, syncs, rows = [], [], {}
    for steps in (SAVES, 100 * SAVES):
        seconds(steps, None)
        memory, store, parts = [], [], []
        for _ in range(rounds):
            memory.append(seconds(steps, None))
            with Clocks() as clocks:
                start = time.perf_counter()
                store.append(seconds(steps, folder / f"{next(names)}.zarr"))
            making.append(clocks.made - start)
            syncs.append(clocks.sync_of_making)
            parts.append(clocks.seconds)
        best = int(np.argmin(store[1:])) + 1  # the first one imports
        rows[str(steps)] = {"memory": min(memory), "store": store[best], "ratio": store[best] / min(memory)} | parts[
            best
        ]
    later = int(np.argmin(making[1:])) + 1
    found = {"making": [making[0], making[later]], "sync of making": syncs[later], "rows": rows}
    return found | {"machine": measure.machine()}


if __name__ == "__main__":
    main()
