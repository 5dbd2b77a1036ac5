"""The attitude of a tumbling rocket stage: how far off is each scheme after 3000 s, and what does a step cost?

A stage with the inertia (1000, 14000, 14500) kg m² tumbles at 3.5°/s at 700 km, under gravity's gradient and the torque
of eddy currents in a dipole field, with initial rates within a hundredth of one another. The error is the median and
the largest angle over the bodies from `extrapolate(body, 12)` at 1 s. CPU time of one core per body and step by
`li.run`, the contestants in turn in one process, the least of the rounds; the first call is what it needs more.

    python benchmarks/attitude.py [--quick] [--out DIR]
"""

from __future__ import annotations

import time
from typing import Any

from lib import command

SPAN, ROUNDS, ORBIT = 3000.0, 5, 7078.137  # s, and km from the center of the Earth
CASES = [("torqued_midpoint", 4.0), ("torqued_midpoint", 1.0), ("extrapolate 12", 4.0), ("extrapolate 12", 2.0)]


def stages(bodies: int) -> tuple[dict[str, Any], Any]:
    """The steps by name, and the initial states."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    import lieint_jax as li

    inertia = jnp.array([1000.0, 14000.0, 14500.0])
    orbit = li.orbits.kepler(li.orbits.EARTH_GM, ORBIT, 0.001, 1.7)
    field = li.orbits.earth_field(orbit, li.orbits.julian_date(2026, 1, 1))

    def eddy_currents(t: Any, q: Any, omega: Any) -> Any:
        b = field(t)
        return 1e6 * jnp.cross(jnp.cross(omega, b), b)  # N m, of b in tesla: the shell of a stage

    eddy_currents.frame = "space"  # pyright: ignore[reportFunctionMemberAccess]
    body = li.systems.torqued_body(inertia, li.torques.gravity_gradient(orbit, inertia) + eddy_currents)
    spread = 1 + 0.01 * np.random.default_rng(1).normal(size=(bodies, 3))
    rates = np.radians(3.5) * np.array([0.15, 0.1, 1.0]) * spread
    states = jax.vmap(lambda w: body.state(angular_velocity=w, t=0.0))(jnp.asarray(rates))
    return {
        "torqued_midpoint": li.schemes.torqued_midpoint(body),
        "extrapolate 12": li.schemes.extrapolate(body, 12),
    }, states._replace(t=0.0)


def measured(bodies: int, rounds: int) -> list[dict[str, Any]]:
    """A row for each case."""
    import jax
    import numpy as np

    import lieint_jax as li
    from lieint_jax.groups import so3

    steps, states = stages(bodies)

    def run(name: str, dt: float) -> tuple[Any, float]:
        start = time.process_time()
        found = li.run(steps[name], states, dt, round(SPAN / dt), save_every=None, progress=False)
        return found, time.process_time() - start

    first = {case: run(*case) for case in CASES}
    least = {case: min(run(*case)[1] for _ in range(rounds)) for case in CASES}
    exact = run("extrapolate 12", 1.0)[0].state.q[-1]
    rows = []
    for (name, dt), (found, seconds) in first.items():
        off = np.asarray(jax.vmap(so3.angle)(found.state.q[-1], exact))
        spent = least[name, dt]
        rows.append(
            {
                "name": name,
                "dt": dt,
                "median": float(np.median(off)),
                "largest": float(off.max()),
                "ns": spent / (bodies * SPAN / dt) * 1e9,
                "first": max(0.0, seconds - spent),
                "converged": bool(np.all(found.info.converged)),
            }
        )
    return rows


def main() -> None:
    options = command.on_one_core(__doc__)
    from lib import measure, report  # float64

    bodies, rounds = (16, 1) if options.quick else (1000, ROUNDS)
    result = command.under_load(
        lambda: {"machine": measure.machine(), "bodies": bodies, "rows": measured(bodies, rounds)}
    )
    columns = ["scheme", "Δt, s", "median error, rad", "largest", "ns a step", "first call, CPU s", "all converged"]
    formats = {"name": "s", "dt": "g", "median": ".1e", "largest": ".1e", "ns": ".0f", "first": ".1f"}
    cells = [
        [*(format(row[key], how) for key, how in formats.items()), "yes" if row["converged"] else "no"]
        for row in result["rows"]
    ]
    sections = [report.machine(result), f"{bodies} stages after {SPAN:g} s", report.table(columns, cells)]
    report.publish("attitude", sections, result, options.out)


if __name__ == "__main__":
    main()
