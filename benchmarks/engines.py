"""Which step should an engine with contacts and fluids use for the rotation of a free body?

One box in two cases: MuJoCo's own test FreeBodyConservation (half lengths 0.1, 0.2, 0.3, density 1000, ω = (1, 2, 3),
Δt = 0.01, 500 steps, no force), and the same box in a viscous fluid whose torque is −(viscosity π d³)ω, MuJoCo's
inertia-box model with d the mean length of the box. The integrators are MuJoCo's own and the steps of
baseline/engine.c. The exact motion is that of scipy's DOP853 at 1e-13.

    python benchmarks/engines.py [--quick] [--out DIR]     (mujoco, scipy and a C compiler)
"""

from __future__ import annotations

import importlib
import subprocess
import sys
import tempfile
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


def by_mujoco(integrator: str, viscosity: float) -> tuple[np.ndarray, np.ndarray]:
    """q and ω in the body at the end."""
    mujoco: Any = importlib.import_module("mujoco")
    model = mujoco.MjModel.from_xml_string(_MODEL.format(dt=DT, integrator=integrator, viscosity=viscosity))
    data = mujoco.MjData(model)
    assert np.allclose(model.body_inertia[1], J)  # the frame of the inertia is that of the body
    data.qvel[3:] = OMEGA
    for _ in range(STEPS):
        mujoco.mj_step(model, data)
    return data.qpos[3:].copy(), data.qvel[3:].copy()


def by_c(viscosity: float) -> tuple[np.ndarray, np.ndarray, float]:
    """q, ω in the body and the work at the end, by `torqued_midpoint`."""
    engine_code: Any = importlib.import_module("engine_code")

    start = _State(np.array([1.0, 0, 0, 0]), J * OMEGA)
    c = drag(viscosity)
    q, pi, work, solved = engine_code.torqued(J, lambda t, q, Omega: -c * Omega, start, DT, STEPS)
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
        for integrator in ("Euler", "implicitfast", "RK4"):
            rows.append(row(f"MuJoCo {integrator}", viscosity, *by_mujoco(integrator, viscosity)))
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
    counts = flops()
    sections = [
        f"MuJoCo {mujoco.__version__}; Δt = {DT}, {STEPS} steps; momentum error relative to the initial momentum",
        table(head, body),
        "Arithmetic operations of a step (+, −, ×, ÷, √, one each; without the torque)",
        table(["step", "operations"], [[name, f"{value:.0f}"] for name, value in counts.items()]),
    ]
    publish("engines", sections, {"rows": rows, "operations": counts}, options.out)


if __name__ == "__main__":
    main()
