"""How long does one wait for the first ensemble: by every scheme on every kind of system?

For each kind of system and every scheme, the first example that the scheme accepts, float64, one core: CPU seconds of
the first `li.run` of 100 members in a fresh process with nothing cached (the import and the making of the states
are not counted), of the second call, and the engine.

    python benchmarks/first_ensembles.py [--quick] [--out DIR]
"""

from __future__ import annotations

import json
import logging
import time
from typing import Any

from lib import command, report
from lib.pairs import example, in_a_process, pairs

MEMBERS, STEPS = 100, 10


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--one", nargs=3, metavar="NAME", help="system, scheme and step: measured in this process")
    options = command.parsed(parser)
    command.pin()
    if options.one:
        print(json.dumps(waited(*options.one)))
        return
    data = command.under_load(lambda: {"rows": rows(options.quick)})
    report.publish("first_ensembles", render(data), data, options.out)


def rows(quick: bool) -> list[dict[str, Any]]:
    """What each pair takes, in a process of its own; `quick` takes free bodies."""
    found = pairs(("rigid_body",) if quick else ())
    return [{"system": x[0], "step": x[2], **in_a_process(__file__, *x)} for x in found]


def waited(system: str, scheme: str, name: str) -> dict[str, Any]:
    """CPU seconds of the first and the second call of `li.run`, and the engine."""
    import jax
    import numpy as np

    import lieint_jax as li

    step, state, dt = example(system, scheme, name)
    states = jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], MEMBERS, axis=0), state)
    said: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())
    logger = logging.getLogger("lieint_jax")
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)

    def seconds() -> float:
        begin = time.process_time()
        li.run(step, states, dt, STEPS, progress=False, save_every=None)
        return time.process_time() - begin

    first, second = seconds(), seconds()
    return {
        "first": first,
        "second": second,
        "engine": "machine code" if any(x.startswith("machine code") for x in said) else "XLA",
    }


def render(data: dict[str, Any]) -> list[str]:
    """The table and the slowest pair."""
    before, after = data["load"]
    cells = [
        [r["system"], r["step"], f"{r['first']:.2f}", f"{1e3 * r['second']:.1f}", r["engine"]] for r in data["rows"]
    ]
    worst = max(data["rows"], key=lambda r: r["first"])
    return [
        f"First `li.run` of {MEMBERS} members, {STEPS} steps, in a fresh process, nothing cached, one core",
        f"Load of the machine before and after: {before:.2f}, {after:.2f}",
        report.table(["system", "step", "first, CPU s", "second, CPU ms", "by"], cells),
        f"Slowest: {worst['step']} of {worst['system']}, {worst['first']:.2f} s",
    ]


if __name__ == "__main__":
    main()
