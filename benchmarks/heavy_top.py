"""Heavy tops: how many body-steps a second, what is conserved, and how much time does an accuracy cost?

Heavy plates of inertia (1, 2, 3), each fixed at one of its points, weight (0.9, 0.8, 0): three moments, not integrable.
Random attitudes, body velocities random in the unit ball, dt = 0.05. Ours (the energy-momentum scheme with three κ's,
the splitting, both composed) against C++ of the same schemes, diffrax, MuJoCo and (for accuracy) heyoka, called in turn
in one process pinned to one core (as Linux can).
Ours are whole calls of `li.run`. The reference is `diagnostics.flow`, Gauss collocation of order 16.

    python benchmarks/heavy_top.py [--quick] [--out DIR]
"""

from __future__ import annotations

from lib import command


def main() -> None:
    options = command.on_one_core(__doc__)
    from lib import measure, precision, tops, tops_report

    points = precision.QUICK if options.quick else precision.Sizes(rounds=3)
    result = command.under_load(lambda: tops.everything(measure.QUICK if options.quick else measure.Sizes(), points))
    tops_report.write(result, options.out)


if __name__ == "__main__":
    main()
