"""Satellites under gravity's gradient: what does a driven top cost beside one at rest, and an accuracy beside peers?

Bodies of inertia (1, 2, 3) on an orbit with e = 0.1 and mean motion 1, from its periapsis on; random attitudes, body
velocities random in the unit ball. Rates at dt = 0.05, ours through `li.run`: the splitting of a heavy top, and
of the satellite at a time that all members share, with the work counted, and with a time for each member. Then the time
for an attitude error after three orbits, ours by `integrate`, vmapped and jitted. Against diffrax (vmapped, and as one
solve of the whole batch, which shares its time too), astrojax and heyoka. Everything is called in turn in one process
pinned to one core (as Linux can); what XLA compiles is compiled for full-width vectors. The reference is
`diagnostics.flow`, and another scipy's DOP853 at 1e-13.

    python benchmarks/driven.py [--quick] [--out DIR]
"""

from __future__ import annotations

from lib import command


def main() -> None:
    options = command.on_one_core(__doc__)
    from lib import measure, satellites, satellites_report

    sizes, stride = (measure.QUICK, 4) if options.quick else (measure.Sizes(seconds=0.3, rounds=9), 1)
    satellites_report.write(command.under_load(lambda: satellites.everything(sizes, stride)), options.out)


if __name__ == "__main__":
    main()
