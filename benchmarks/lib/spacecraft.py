"""A spacecraft on a circular orbit with five laws of torque, by our schemes and by Basilisk: accuracy and CPU time.

Gravity gradient, three wheels with constant motor torques, a magnetic moment in a field that is constant in space, drag
at a center of pressure and a constant torque in the body; SI units. Each has an exact counterpart here. Basilisk
integrates the orbit too; ours is given it as a function of time, which is shared by a batch and computed once a step.
"""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

MU, RADIUS = 3.986004415e14, 7.0e6
SPEED = math.sqrt(MU / RADIUS)
SATELLITE = {
    "mass": 50.0,
    "inertia": [1.0, 2.0, 2.5],  # with the wheels at rest in it
    "mu": MU,
    "position": [RADIUS, 0.0, 0.0],
    "velocity": [0.0, 0.6 * SPEED, 0.8 * SPEED],
    "angular_velocity": [0.03, -0.04, 0.06],
    "wheel": 1e-3,  # the axial inertia of each
    "speeds": [100.0, -200.0, 50.0],
    "motors": [1e-4, -5e-5, 2e-4],
    "dipole": [0.3, -0.2, 0.5],
    "field": [2e-5, -1e-5, 3e-5],
    "density": 1e-12,
    "area": 1.0,
    "drag": 2.2,
    "center_of_pressure": [0.1, -0.05, 0.02],
    "torque": [1e-5, 2e-5, -1e-5],
}
DT, STEPS, LONGER = 0.1, 3000, 20  # five minutes; single bodies are timed over LONGER times as many steps
MIDPOINT, ORDER_4, BASILISK = "ours, order 2", "ours, order 4", "Basilisk, RK4"
ONE = ", one body"


def satellites() -> list[Any]:
    """Ours, then those that lack one of its five laws."""
    import jax.numpy as jnp

    import lieint_jax as li

    x = SATELLITE
    locked, axes, rate = jnp.array(x["inertia"]), jnp.eye(3), SPEED / RADIUS
    outward, forward = jnp.array(x["position"]), jnp.array(x["velocity"])

    def orbit(t: Any) -> Any:
        c, s = jnp.cos(rate * t), jnp.sin(rate * t)
        return c * outward + s / rate * forward, c * forward - s * rate * outward

    def push(t: Any) -> Any:
        return -0.5 * x["density"] * x["area"] * x["drag"] * SPEED * orbit(t)[1]

    motors = jnp.array(x["motors"])
    laws = [
        li.torques.gravity_gradient(orbit, locked, MU),
        li.torques.dipole(x["dipole"], x["field"]),
        li.torques.dipole(x["center_of_pressure"], push),  # r × F(t) has the form m × b(t)
        li.torques.thruster(x["torque"], -1.0, 1e9),
        li.torques.wheels(axes, x["wheel"], lambda t, q, Omega, h: motors, speeds=x["speeds"]),
    ]
    lacking = [laws, *(laws[:i] + laws[i + 1 :] for i in range(len(laws)))]
    inertia = li.torques.body_inertia(locked, axes, x["wheel"])
    return [li.systems.torqued_body(inertia, li.torques.total(chosen)) for chosen in lacking]


def start(body: Any) -> Any:
    """The initial state."""
    return body.state([1.0, 0.0, 0.0, 0.0], angular_velocity=SATELLITE["angular_velocity"], work=0.0)


def everything(basilisk: str | None, bodies: int, rounds: int) -> dict[str, Any]:
    """Errors of the attitude after STEPS steps and seconds of CPU time per body and step; {} with no Basilisk."""
    if basilisk is None:
        return {}
    import jax
    import jax.numpy as jnp
    import numpy as np
    from lib import measure

    import lieint_jax as li

    body, *lacking = satellites()
    step, state = li.schemes.torqued_midpoint(body), start(body)
    schemes = {MIDPOINT: step, ORDER_4: li.schemes.compose(step, 4)}

    def run(step: li.Step, bodies: int, steps: int) -> Callable[[], Any]:
        states = jax.tree.map(lambda x: jnp.broadcast_to(x, (bodies, *x.shape)), state)
        return lambda: li.run(step, states, DT, steps, save_every=steps, progress=False).state.q[-1]

    def end(body: Any, dt: float = DT) -> Any:
        steps = round(STEPS * DT / dt)
        step = li.schemes.compose(li.schemes.torqued_midpoint(body), 6)
        return np.asarray(li.integrate(step, start(body), dt, steps, save_every=steps).state.q[-1:])

    reference = end(body)
    theirs, finer = by_basilisk(basilisk, DT, rounds), by_basilisk(basilisk, DT / 2, 0)
    ends = {name: np.asarray(run(scheme, 1, STEPS)()) for name, scheme in schemes.items()}
    ends[BASILISK] = np.array([theirs["q"]])
    seconds = {BASILISK: [x / (LONGER * STEPS) for x in theirs["seconds"]]}
    for name, scheme in schemes.items():
        seconds[name] = timed(run(scheme, bodies, STEPS // 10), rounds, bodies * (STEPS // 10))
        seconds[name + ONE] = timed(run(scheme, 1, LONGER * STEPS), rounds, LONGER * STEPS)
    return {
        "version": theirs["version"],
        "effectors": theirs["effectors"],
        "bodies": bodies,
        "doubt": measure.attitude_error(end(body, 2 * DT), reference),
        "error": {name: measure.attitude_error(q, reference) for name, q in ends.items()},
        "half": measure.attitude_error(np.array([finer["q"]]), reference),
        "lacking": [measure.attitude_error(end(x), reference) for x in lacking],
        "best": {name: min(x) for name, x in seconds.items()},
        "median": {name: statistics.median(x) for name, x in seconds.items()},
    }


def by_basilisk(python: str, dt: float, rounds: int) -> dict[str, Any]:
    """What `lib/basilisk.py` prints: first a run over the time of STEPS steps of DT, then `rounds` runs to be timed."""
    steps = round(STEPS * DT / dt)
    task = {"satellite": SATELLITE, "dt": dt, "steps": steps, "longer": LONGER * STEPS, "runs": rounds}
    program = str(Path(__file__).with_name("basilisk.py"))
    made = subprocess.run([python, "-I", program], input=json.dumps(task), capture_output=True, text=True, check=False)
    if made.returncode:
        raise SystemExit(f"--basilisk {python}: this interpreter cannot run Basilisk (pip install bsk):\n{made.stderr}")
    return json.loads(made.stdout.splitlines()[-1])


def timed(call: Callable[[], Any], rounds: int, size: int) -> list[float]:
    """Seconds of CPU time over `size` of each round, after a call that compiles."""
    call()
    seconds = []
    for _ in range(rounds):
        begin = time.process_time()
        call()
        seconds.append((time.process_time() - begin) / size)
    return seconds


def sections(result: dict[str, Any]) -> list[str]:
    """The report."""
    from lib import report

    if not result:
        return ["Not measured: give --basilisk PYTHON, an interpreter of an environment with `pip install bsk`."]
    best, median, error = result["best"], result["median"], result["error"]
    rows = [
        [
            name if name.endswith(ONE) or name == BASILISK else f"{name}, {result['bodies']} bodies",
            f"{1e9 * x:.0f}",
            f"{1e9 * median[name]:.0f}",
            f"{best[BASILISK] / x:.3g}",
            f"{error[name.removesuffix(ONE)]:.1e}",
        ]
        for name, x in best.items()
    ]
    return [
        f"Basilisk {result['version']} with {', '.join(result['effectors'])}; ours with the same torques: "
        "`gravity_gradient`, `wheels`, two of `dipole` (the second is the drag's r × F(t)) and `thruster`, in "
        "`torqued_midpoint` and in its composition of order 4, work counted. Basilisk integrates the orbit too and has "
        "one spacecraft a simulation; ours is given the orbit as a function of time, which a batch shares.",
        f"Equal steps of {DT:g} s, one core: nanoseconds of CPU time per body and step, and the error of the attitude "
        f"(radians) after {STEPS * DT:g} s, from our order 6 (with twice the step {result['doubt']:.1e} from itself)",
        report.table(["", "best", "median", "Basilisk's time ÷ it", "error"], rows),
        f"With half the step Basilisk's attitude has an error of {result['half']:.1e}; without any one of the five "
        f"torques ours would differ by {min(result['lacking']):.1e} or more.",
    ]
