"""How much time does an accuracy cost, with our schemes and with what one would use instead?

Free rigid bodies of inertia (1, 2, 3), random attitudes, body velocities random in the unit ball, to t = 10 and to
t = 1000; each scheme at several step sizes, each adaptive peer at several tolerances. Everything runs in one process
pinned to one core (as Linux can), and everything that XLA compiles, ours and diffrax's, is compiled as `ensemble.run`
does, for full-width vectors. The reference is `RigidBody.solution`; 40-digit Taylor series of the 16 bodies watched are
within 1e-14 rad of it at t = 10 and within 7e-13 at t = 1000.

    python benchmarks/work_precision.py [--quick] [--out DIR]
"""

from __future__ import annotations

from lib import command


def main() -> None:
    options = command.on_one_core(__doc__)
    from lib import precision, precision_report

    result = command.under_load(lambda: precision.everything(precision.QUICK if options.quick else precision.Sizes()))
    precision_report.write(result, options.out)


if __name__ == "__main__":
    main()
