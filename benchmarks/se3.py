"""Bodies in a fluid, SE(3): is the midpoint scheme twice as fast as Runge–Kutta, step for step, and what does it keep?

Kirchhoff's ellipsoid of semi-axes 3, 2, 1 with its center of mass off its center, so that rotation and translation are
coupled. Random motions q, body velocities random in the unit ball of ℝ⁶, dt = 0.05. Ours (`schemes.group_midpoint` with
two maps) against diffrax's Tsit5 on the same right-hand side, q' = qΩ̂ with Ω = m⁻¹Ad*_q π, called in turn in one
process pinned to one core (as Linux can). The reference is `diagnostics.flow`, Gauss collocation of order 16.
Ours are whole calls of `li.run`; "wide vectors" are XLA's vectors of 512 bits, `runs.compiler_options()`.

    python benchmarks/se3.py [--quick] [--out DIR]
"""

from __future__ import annotations

from lib import command


def main() -> None:
    options = command.on_one_core(__doc__)
    from lib import fluid, fluid_report, measure

    result = command.under_load(lambda: fluid.everything(measure.QUICK if options.quick else measure.Sizes()))
    fluid_report.write(result, options.out)


if __name__ == "__main__":
    main()
