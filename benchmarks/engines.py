"""Which step should an engine with contacts and fluids use for the rotation of a free body?

One box in two cases: MuJoCo's own test FreeBodyConservation (half lengths 0.1, 0.2, 0.3, density 1000, ω = (1, 2, 3),
Δt = 0.01, 500 steps, no force), and the same box in a viscous fluid whose torque is −(viscosity π d³)ω, MuJoCo's
inertia-box model with d the mean length of the box. The integrators are MuJoCo's own and the steps of
baseline/engine.c. The exact motion is that of scipy's DOP853 at 1e-13. Then the free box for 500 s, and the times of
MuJoCo's steps.

    python benchmarks/engines.py [--quick] [--out DIR]     (mujoco, scipy and a C compiler)
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from lib import command
from lib.report import publish, table

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "lib"))

LENGTHS = 2 * np.array([0.1, 0.2, 0.3])
MASS = 1000 * LENGTHS.prod()
J = MASS / 12 * ((LENGTHS**2).sum() - LENGTHS**2)
OMEGA, DT, STEPS = np.array([1.0, 2.0, 3.0]), 0.01, 500
INTEGRATORS = ("Euler", "implicitfast", "discrete", "RK4")
LONG = (500, 5000, 20_000, 50_000)  # steps of the free box
TIMED, ROUNDS = 10_000, 7  # steps; Euler's fails after 11 633
VISCOSITIES = (0.0, 0.3, 3.0, 300.0)  # the last damps by a rate of about 1/Δt
_MODEL = """
<mujoco>
  <option timestep="{dt}" integrator="{integrator}" gravity="0 0 0" viscosity="{viscosity}" density="0"/>
  <worldbody>
    <body><freejoint/><geom type="box" size="0.1 0.2 0.3" density="1000" contype="0" conaffinity="0"/></body>
  </worldbody>
</mujoco>
"""


def drag(viscosity: float) -> float:
    """The torque is minus this times ω: π η d³, d the mean of the box's lengths."""
    return float(np.pi * viscosity * LENGTHS.mean() ** 3)


def exact(viscosity: float) -> tuple[np.ndarray, np.ndarray, float]:
    """q, body momentum and the work of the fluid at the end."""
    from scipy.integrate import solve_ivp

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        w, v, Pi = y[0], y[1:4], y[4:7]
        Omega = Pi / J
        torque = -drag(viscosity) * Omega
        q_dot = np.concatenate([[-v @ Omega], w * Omega + np.cross(v, Omega)]) / 2
        return np.concatenate([q_dot, np.cross(Pi, Omega) + torque, [Omega @ torque]])

    start = np.concatenate([[1.0, 0, 0, 0], J * OMEGA, [0.0]])
    y = solve_ivp(rate, (0, DT * STEPS), start, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    return y[:4], y[4:7], float(y[7])


class Box:
    """MuJoCo's box."""

    def __init__(self, integrator: str, viscosity: float = 0.0):
        self.mujoco: Any = importlib.import_module("mujoco")
        xml = _MODEL.format(dt=DT, integrator=integrator, viscosity=viscosity)
        self.model = self.mujoco.MjModel.from_xml_string(xml)
        self.data = self.mujoco.MjData(self.model)
        assert np.allclose(self.model.body_inertia[1], J)  # the frame of the inertia is that of the body
        self.start()

    def start(self) -> None:
        """Back to the initial state."""
        self.mujoco.mj_resetData(self.model, self.data)
        self.data.qvel[3:] = OMEGA

    def steps(self, count: int) -> tuple[np.ndarray, np.ndarray, bool]:
        """q and ω in the body after so many more steps, and whether MuJoCo has not warned and reset the box."""
        self.mujoco.mj_step(self.model, self.data, count)
        good = not any(warning.number for warning in self.data.warning)
        return self.data.qpos[3:].copy(), self.data.qvel[3:].copy(), good

    def microseconds(self) -> float:
        """The processor's time of a step: the least of several rounds."""
        found = []
        for _ in range(ROUNDS):
            self.start()
            begin = time.process_time()
            self.steps(TIMED)
            found.append((time.process_time() - begin) / TIMED)
        return 1e6 * min(found)


def long_run(name: str, states: Iterator[tuple[int, np.ndarray, np.ndarray, bool]]) -> list[list[Any]]:
    """Rows of energy and momentum, relative to those at the start, until the integrator fails."""
    rows, L = [], J * OMEGA
    for n, q, Omega, good in states:
        found = in_body(_conjugate(q), J * Omega)
        energy = J @ Omega**2 / (J @ OMEGA**2)
        length, error = np.linalg.norm(found) / np.linalg.norm(L), np.linalg.norm(found - L) / np.linalg.norm(L)
        rows.append(
            [f"{n * DT:g}", name, *([f"{energy:.7g}", f"{length:.7g}", f"{error:.1e}"] if good else ["failed"] * 3)]
        )
    return rows


def mujoco_states(integrator: str) -> Iterator[tuple[int, np.ndarray, np.ndarray, bool]]:
    """The free box after each of `LONG` steps."""
    box, last, failed = Box(integrator), 0, False
    for n in LONG:
        q, Omega, good = box.steps(n - last)
        failed, last = failed or not good, n
        yield n, q, Omega, not failed


def c_states() -> Iterator[tuple[int, np.ndarray, np.ndarray, bool]]:
    """The same by `torqued_midpoint`."""
    for n in LONG:
        yield n, *by_c(0.0, n)[:2], True


def by_c(viscosity: float, steps: int = STEPS) -> tuple[np.ndarray, np.ndarray, float]:
    """q, ω in the body and the work at the end, by `torqued_midpoint`."""
    engine_code: Any = importlib.import_module("engine_code")

    start = _State(np.array([1.0, 0, 0, 0]), J * OMEGA)
    c = drag(viscosity)
    q, pi, work, solved = engine_code.torqued(J, lambda t, q, Omega: -c * Omega, start, DT, steps)
    assert solved
    return q, in_body(q, pi) / J, work


class _State:
    def __init__(self, q: np.ndarray, p: np.ndarray):
        self.q, self.p = q, p


def in_body(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Λᵀv."""
    t = 2 * np.cross(q[1:], v)
    return v - q[0] * t + np.cross(q[1:], t)


def row(name: str, viscosity: float, q: np.ndarray, Omega: np.ndarray, done: float | None = None) -> dict[str, Any]:
    """Errors of an integrator's end: the attitude, energy and momentum against the exact ones, and energy less work."""
    q_exact, Pi, work = exact(viscosity)
    start = J @ OMEGA**2 / 2
    energy = J @ Omega**2 / 2
    sine = q[0] * q_exact[1:] - q_exact[0] * q[1:] - np.cross(q[1:], q_exact[1:])
    angle = 2 * np.arcsin(min(1.0, float(np.linalg.norm(sine))))
    momentum = np.linalg.norm(in_body(_conjugate(q), J * Omega) - in_body(_conjugate(q_exact), Pi))
    return {
        "integrator": name,
        "viscosity": viscosity,
        "energy": float(energy / start),
        "exact energy": float((start + work) / start),
        "attitude": float(angle),
        "momentum": float(momentum / np.linalg.norm(J * OMEGA)),
        "balance": None if done is None else float((energy - done - start) / start),
    }


def _conjugate(q: np.ndarray) -> np.ndarray:
    return q * np.array([1.0, -1, -1, -1])


def flops() -> dict[str, float]:
    """Arithmetic operations of a step, counted by running baseline/engine.c with numbers that count."""
    source = Path(__file__).parent / "baseline"
    with tempfile.TemporaryDirectory() as folder:
        binary = Path(folder) / "count"
        subprocess.run(["g++", "-O1", f"-I{source}", str(source / "count.cpp"), "-o", str(binary)], check=True)
        out = subprocess.run([str(binary)], check=True, capture_output=True, text=True).stdout
    return {name: float(value) for name, value in (line.split() for line in out.splitlines())}


def main() -> None:
    options = command.on_one_core(__doc__)
    rows = []
    for viscosity in VISCOSITIES:
        for integrator in INTEGRATORS:
            rows.append(row(f"MuJoCo {integrator}", viscosity, *Box(integrator, viscosity).steps(STEPS)[:2]))
        rows.append(row("torqued_midpoint, C", viscosity, *by_c(viscosity)))
    import mujoco

    head = [
        "viscosity",
        "integrator",
        "energy at the end ÷ start",
        "exact",
        "attitude error, rad",
        "momentum error",
        "energy less work",
    ]
    body = [
        [
            f"{r['viscosity']:g}",
            r["integrator"],
            f"{r['energy']:.7g}",
            f"{r['exact energy']:.7g}",
            f"{r['attitude']:.1e}",
            f"{r['momentum']:.1e}",
            "nan" if r["balance"] is None else f"{r['balance']:.0e}",
        ]
        for r in rows
    ]
    long = [x for name in INTEGRATORS for x in long_run(f"MuJoCo {name}", mujoco_states(name))]
    long += long_run("torqued_midpoint, C", c_states())
    times = {f"MuJoCo {name}": Box(name).microseconds() for name in INTEGRATORS}
    load = os.getloadavg()[0]
    counts = flops()
    sections = [
        f"MuJoCo {mujoco.__version__}; Δt = {DT}, {STEPS} steps; momentum error relative to the initial momentum",
        table(head, body),
        "The free box in a long run: energy and |momentum| ÷ their start, and the momentum error. Failed: MuJoCo "
        "warned of a bad acceleration, and reset the box",
        table(["t", "integrator", "energy", "momentum", "momentum error"], long),
        f"Processor time of a step of the free box, the least of {ROUNDS} rounds; load of the machine: {load:.1f}",
        table(["integrator", "µs"], [[name, f"{value:.2g}"] for name, value in times.items()]),
        "Arithmetic operations of a step (+, −, ×, ÷, √, one each; without the torque)",
        table(["step", "operations"], [[name, f"{value:.0f}"] for name, value in counts.items()]),
    ]
    publish(
        "engines",
        sections,
        {"rows": rows, "long": long, "microseconds": times, "load": load, "operations": counts},
        options.out,
    )


if __name__ == "__main__":
    main()
