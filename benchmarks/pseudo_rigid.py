"""How many steps a second, how accurate, how conserving, for pseudo-rigid bodies, against diffrax and C++?

Balls of the paper's Figure 3c (λ = 2000, μ = 6, E = 2·1, angular momentum 6, Δt = 0.005), their first states spread by
one per cent, integrated to t = 1. One core, float64, everything in one process, contestants called in turn.

    python benchmarks/pseudo_rigid.py [--quick] [--out DIR]

diffrax's implicit solver is Kvaerno5 with its adaptive step: with constant steps its Newton iteration fails on this
problem. A "step" of an adaptive solver is a time Δt, however many steps it takes inside; its tolerance is in the table.
One compilation serves all tolerances: the second of these rows shows none.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from lib import command, report

HERE = Path(__file__).parent
DT, LAM, MU, INERTIA, PHI, END = 0.005, 2000.0, 6.0, 2.0, 6.0, 1.0
WATCHED = 16  # bodies whose errors are measured
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC")


class Solver(NamedTuple):
    """A solver that advances many bodies by a time.

    Attributes:
        name: for the tables.
        advance: (F, P, t) ↦ F, P and whether each body converged.
    """

    name: str
    advance: Callable[[np.ndarray, np.ndarray, float], tuple[np.ndarray, np.ndarray, np.ndarray]]


def bodies(count: int) -> tuple[np.ndarray, np.ndarray]:
    """F = 1 + noise of 0.01 and P = π̂F, π = (0, 0, 6) + noise of 0.1; the first body is that of Figure 3c."""
    rng = np.random.default_rng(0)
    spread = (np.arange(count) > 0)[:, None, None]
    F = np.eye(3) + 0.01 * spread * rng.normal(size=(count, 3, 3))
    spin = np.array([0.0, 0.0, PHI]) + 0.1 * spread[:, 0] * rng.normal(size=(count, 3))
    hat = np.zeros((count, 3, 3))
    for (i, j), k, sign in (((2, 1), 0, 1), ((0, 2), 1, 1), ((1, 0), 2, 1)):
        hat[:, i, j], hat[:, j, i] = sign * spin[:, k], -sign * spin[:, k]
    return F, hat @ F


def main() -> None:
    options = command.on_one_core(__doc__)
    import jax

    jax.config.update("jax_enable_x64", True)
    found = measure(100, 1, 1) if options.quick else measure(1000, 2, 3)
    report.publish("pseudo_rigid", [tables(found)], found, options.out)
    draw(found, options.out / "pseudo_rigid.png")


def measure(batch: int, rounds: int, points: int) -> dict[str, Any]:
    """Rates and errors of every solver, then work-precision curves of `points` step sizes or tolerances each."""
    import lieint_jax as li

    body = li.systems.pseudo_rigid_body(np.full(3, INERTIA), li.systems.mooney_rivlin(LAM, MU))
    solvers = [
        ours(body, "symplectic"),
        ours(body, "average"),
        diffrax_solver(body, "Tsit5", None, DT),
        diffrax_solver(body, "Kvaerno5", 1e-6, DT),
        diffrax_solver(body, "Kvaerno5", 1e-9, DT),
    ]
    if shutil.which("g++"):
        solvers.insert(0, cpp())
    exact = reference(body)
    records = race(solvers, bodies(batch), 5 * DT, rounds)
    for solver, record in zip(solvers, records, strict=True):
        record |= quality(body, solver, exact)
    steps = (100, 200, 400, 800)[:points]
    curves = [
        curve(f"{rule}, order {order}", [ours(body, rule, dt=END / n, order=order) for n in steps], exact)
        for rule in ("symplectic", "average")
        for order in (2, 4, 6)
    ]
    tsit5 = [diffrax_solver(body, "Tsit5", None, END / n) for n in (50, 100, 200, 400)[:points]]
    kvaerno5 = [diffrax_solver(body, "Kvaerno5", tol, DT) for tol in (1e-4, 1e-6, 1e-8)[:points]]
    curves += [curve("diffrax Tsit5", tsit5, exact), curve("diffrax Kvaerno5", kvaerno5, exact)]
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    return {"batch": batch, "load": load, "records": records, "curves": curves}


def race(solvers: list[Solver], states: tuple[np.ndarray, np.ndarray], t: float, rounds: int) -> list[dict[str, Any]]:
    """Body-steps a second of each solver, from its best call; they are called in turn, round after round."""
    from lib.contest import Contestant
    from lib.contest import race as timed

    def entry(solver: Solver) -> Contestant:
        def advance(state: tuple[np.ndarray, np.ndarray], _: int) -> Any:
            return solver.advance(state[0], state[1], t)

        return Contestant(solver.name, "float64", 0.0, lambda F, P: (F, P), advance, lambda z: z[:2])

    entries = [entry(s) for s in solvers]
    steps = round(t / DT)
    timings = timed(entries, *states, [steps] * len(entries), rounds)
    converged = [bool(np.all(s.advance(*states, t)[2])) for s in solvers]
    return [
        {"name": s.name, "rate": timing.rate, "compile": timing.compile_seconds, "converged": ok}
        for s, timing, ok in zip(solvers, timings, converged, strict=True)
    ]


def reference(body: Any) -> np.ndarray:
    """F of the first bodies at t = END by collocation of order 16."""
    import jax

    import lieint_jax as li

    F, P = map(jax.numpy.asarray, bodies(WATCHED))
    states = li.State(F, P)
    return np.asarray(jax.jit(jax.vmap(lambda z: li.diagnostics.flow(body, z, END, 200)))(states).q)


def quality(body: Any, solver: Solver, exact: np.ndarray) -> dict[str, float]:
    """At t = END: the error of F, the change of energy and of angular momentum."""
    import jax

    import lieint_jax as li

    start = bodies(WATCHED)
    F, P, _ = solver.advance(*start, END)
    states = [li.State(*map(jax.numpy.asarray, z)) for z in (start, (F, P))]  # pyright: ignore[reportArgumentType]
    H, Phi = ([np.asarray(jax.vmap(f)(z)) for z in states] for f in (body.energy, body.momentum))
    return {
        "error": float(np.abs(F - exact).max()),
        "energy": float(np.abs(H[1] - H[0]).max()),
        "momentum": float(np.abs(Phi[1] - Phi[0]).max()),
    }


def curve(name: str, solvers: list[Solver], exact: np.ndarray) -> dict[str, Any]:
    """Milliseconds for the watched bodies until t = END, and the errors then."""
    from time import perf_counter

    states, cost, errors = bodies(WATCHED), [], []
    for solver in solvers:
        errors.append(float(np.abs(solver.advance(*states, END)[0] - exact).max()))  # compiles, too
        start = perf_counter()
        solver.advance(*states, END)
        cost.append(1e3 * (perf_counter() - start))
    return {"name": name, "milliseconds": cost, "errors": errors}


def ours(body: Any, rule: Any, dt: float = DT, order: int = 2) -> Solver:
    """Our step, composed beyond order 2, by whole calls of `li.run`."""
    import jax

    import lieint_jax as li

    step = li.schemes.additive(body, rule)
    if order > 2:
        step = li.schemes.compose(step, order)

    def advance(F: np.ndarray, P: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        run = li.run(
            step,
            li.State(jax.numpy.asarray(F), jax.numpy.asarray(P)),
            dt,
            round(t / dt),
            progress=False,
            save_every=None,
        )
        return np.asarray(run.state.q[-1]), np.asarray(run.state.p[-1]), np.asarray(run.info.converged[-1])

    return Solver(f"ours, {rule}", advance)


def diffrax_solver(body: Any, name: str, tolerance: float | None, dt: float) -> Solver:
    """diffrax, vmapped: constant steps, or adaptive with rtol = atol."""
    import jax

    import lieint_jax as li

    run = _diffrax_loop(name, tolerance is not None)

    def advance(F: np.ndarray, P: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        ys, good = run(body, li.State(jax.numpy.asarray(F), jax.numpy.asarray(P)), t, dt, tolerance or 0.0)
        return np.asarray(ys.q[:, -1]), np.asarray(ys.p[:, -1]), np.asarray(good)

    return Solver(f"diffrax {name}" + (f", rtol {tolerance:g}" if tolerance else ""), advance)


@cache
def _diffrax_loop(name: str, adaptive: bool) -> Any:
    """(body, states, t, dt, tolerance) ↦ the states at t, and which were successful: compiled once per batch size."""
    import diffrax
    import jax

    solver = getattr(diffrax, name)()

    def run(body: Any, states: Any, t: Any, dt: Any, tolerance: Any) -> Any:
        term = diffrax.ODETerm(lambda t, z, args: body.vector_field(z))
        controller = diffrax.PIDController(tolerance, tolerance) if adaptive else diffrax.ConstantStepSize()

        def solve(z: Any) -> Any:
            made = diffrax.diffeqsolve(
                term, solver, 0.0, t, dt, z, stepsize_controller=controller, max_steps=None, throw=False
            )
            return made.ys, made.result == diffrax.RESULTS.successful

        return jax.vmap(solve)(states)

    return jax.jit(run)


def cpp() -> Solver:
    """The midpoint rule in C++: Newton on nine unknowns with Gaussian elimination, body by body."""
    binary = HERE / "baseline" / "bin" / "pseudo_rigid.so"
    binary.parent.mkdir(exist_ok=True)
    subprocess.run(["g++", *FLAGS, str(HERE / "baseline" / "pseudo_rigid.cpp"), "-o", str(binary)], check=True)
    function = ctypes.CDLL(str(binary)).midpoint
    function.restype = None

    def advance(F: np.ndarray, P: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        F, P, good = np.ascontiguousarray(F).copy(), np.ascontiguousarray(P).copy(), np.ones(len(F), np.uint8)
        pointers = [ctypes.c_void_p(x.ctypes.data) for x in (F, P, good)]
        numbers = [ctypes.c_double(x) for x in (DT, INERTIA, LAM, MU)]
        function(*pointers, ctypes.c_int64(len(F)), ctypes.c_int64(round(t / DT)), *numbers)
        return F, P, good.astype(bool)

    return Solver("C++ midpoint", advance)


def tables(report: dict[str, Any]) -> str:
    rates = {r["name"]: r["rate"] for r in report["records"]}
    implicit = max(rate for name, rate in rates.items() if "Kvaerno5" in name)
    lines = [
        f"Figure 3c, {report['batch']} bodies, one core, steps of Δt = {DT}; errors of {WATCHED} bodies at t = {END}",
        f"Load of the machine: {report['load']:.1f} processes a core; above 1, trust the ratios only.",
        "",
        "| | thousand steps/s | compile s | error of F | energy | momentum | every body converged |",
        "|---|---:|---:|---:|---:|---:|---|",
    ]
    for r in report["records"]:
        cells = [
            f"{r['rate'] / 1e3:.3g}",
            f"{r['compile']:.1f}",
            *(f"{r[k]:.1e}" for k in ("error", "energy", "momentum")),
        ]
        lines.append(f"| {r['name']} | {' | '.join(cells)} | {'yes' if r['converged'] else 'NO'} |")
    ratio = rates["ours, symplectic"] / implicit
    held = ratio >= 3 and all(r["converged"] for r in report["records"] if r["name"].startswith("ours"))
    lines += ["", f"midpoint ÷ diffrax's implicit solver: {ratio:.3g} (bar: ≥ 3, every member converged): "]
    lines[-1] += "held" if held else "MISSED"
    return "\n".join(lines)


def draw(report: dict[str, Any], path: Path) -> None:
    from lieint_jax import plots

    curves = {c["name"]: (np.array(c["milliseconds"]), np.array(c["errors"])) for c in report["curves"]}
    with plots.style():
        fig, axes = plots.figure(size=(5.6, 4.4))
        plots.loglog_lines(axes[0, 0], curves, f"ms for {WATCHED} bodies to t = 1", "error of F at t = 1")
        plots.save(fig, path)


if __name__ == "__main__":
    main()
