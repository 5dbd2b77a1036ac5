"""How much time does an accuracy cost, with our schemes and with what one would use instead?

Six problems, 1000 members each, in one process pinned to one core (as Linux can):

- free bodies of inertia (1, 2, 3), random attitudes, body velocities random in the unit ball, to t = 10 and t = 1000;
- chaotic heavy tops to t = 100: J = (1, 2, 2.5), weight (0.5, 0.4, 1), |Ω| = 1.2 in random directions, attitudes exp ξ
  with normal ξ of 0.3 rad (where they are random, upside down as well, median errors are some 50 times smaller);
- the satellites of `driven.py` over three orbits, and the binary asteroids of `bodies.py` over two;
- asteroids that tumble past the Earth on Apophis' hyperbola.

Each scheme at several numbers of steps, each adaptive peer at several tolerances; everything that XLA compiles is
compiled as `li.run` does, for full-width vectors. Ours are whole calls of `li.run`, but for t = 10. heyoka
is in all problems. Errors are the median and the largest over all members (MuJoCo and scipy: 16). The reference is the
closed form of the free body, heyoka in 80-bit arithmetic for tops, `diagnostics.flow` for the others; its distance from
a second reference is stated. A quick run takes one contestant of each family.

    python benchmarks/work_precision.py [--quick] [--only PROBLEM …] [--out DIR]
"""

from __future__ import annotations

from lib import command


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--only", nargs="+", default=[], metavar="PROBLEM", help="functions of lib/problems.py")
    options = command.parsed(parser)
    command.pin()
    from lib import precision, precision_report, problems

    sizes = precision.QUICK if options.quick else precision.Sizes()
    result = command.under_load(lambda: problems.everything(sizes, options.only))
    precision_report.write(result, options.out)


if __name__ == "__main__":
    main()
