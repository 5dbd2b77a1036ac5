"""Several rigid bodies: what does an accuracy cost beside peers, and how does a step grow with their number?

Didymos and Dimorphos under gravity to second order (`potentials.maccullagh`), and 999 systems that differ from them by
up to 2 %, over two orbits, a primary's day a fifth of one. The error is that of x₂ − x₁, relative, against
`diagnostics.flow`; a second reference is scipy's DOP853 at 1e-13. Ours through `li.run`, one system in a compiled
loop; diffrax on our right-hand side, vmapped; heyoka and scipy on the relative motion, 20 numbers in place of our 26,
with body momenta, heyoka eight systems at once. Then 64 waters beside jax_md (`pip install jax_md`; left out without
it), and a step's time and memory against N and B. Everything is called in turn in one process pinned to one core (as
Linux can), compiled for full-width vectors.

    python benchmarks/bodies.py [--quick] [--out DIR]
"""

from __future__ import annotations

from typing import Any

from lib import command


def main() -> None:
    options = command.on_one_core(__doc__)
    from lib import binaries, bodies_report, measure, waters

    quick = options.quick
    many_bodies = (2, 8, 32) if quick else (2, 4, 8, 16, 32, 64, 128, 256, 500, 1000)
    many_systems = (1, 100) if quick else (1, 10, 100, 1000, 10_000, 100_000)

    def work() -> dict[str, Any]:
        notes: list[str] = []
        return {
            "machine": measure.machine(),
            "accuracy": binaries.accuracy(1 if quick else 2, 4 if quick else 1, notes),
            "waters": waters.everything(20 if quick else 1000, 1 if quick else 3, notes),
            "bodies": binaries.growth_with_bodies(many_bodies, 0.02 if quick else 0.3),
            "systems": binaries.growth_with_systems(many_systems, 0.02 if quick else 0.3),
            "notes": notes,
        }

    bodies_report.write(command.under_load(work), options.out)


if __name__ == "__main__":
    main()
