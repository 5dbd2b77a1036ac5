"""A soft rod in free flight: what does an error of its tip cost next to PyElastica and Exudyn, and 1000 rods, and more?

A straight circular rod (L = 1 m, radius 2.5 cm, E = 1 MPa, 1000 kg/m³) starts with the velocities of a bending motion
and of a rotation across it, and flies for 1 s, 1.4 periods of its lowest vibration. Shear, extension, bending, torsion
and inertia have PyElastica's coefficients (GA·27/28, G = E/3). The models differ where the rod stretches: PyElastica's
section becomes thinner. So each code is compared with itself: "of time", with the same chain of elements at much
smaller steps; "of all", with its own motion extrapolated from 64 and 128 elements (the distance of these two limits is
given). Errors are the largest distance, in m, of one end at ten times. PyElastica measures its energy
(`compute_…_energy`); its angular momentum is Σ m x × v + Qᵀ Jω/e. Exudyn's geometrically exact beam of two nodes has
constant strain on SE(3) (Sonneville, Cardona & Brüls 2014) and our stiffness; H and L are computed from that strain and
its mass matrix at the start, which is right to 5e-5, as its most accurate run shows.

    python benchmarks/rods.py [--quick] [--elements] [--out DIR]

Called in turn in one process on one core; the least of the CPU times counts. Compilation is not part of them, but of
the first calls, once for all step sizes; `nystrom` and PyElastica's functions are compiled before, for the references.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import cache, partial
from importlib import import_module
from itertools import pairwise
from typing import Any

import numpy as np
from lib import command

RADIUS, YOUNG, DENSITY, SPEED, SAMPLES = 0.025, 1e6, 1e3, 2.0, 10
AREA, SECOND = np.pi * RADIUS**2, np.pi * RADIUS**4 / 4
PREPROCESSED = "splitting, preprocessed drift"
LIMITS = {"splitting": 1.74, PREPROCESSED: 1.74, "nystrom, order 4": 3.7}  # Δt·Ω
LIMITS |= {"PositionVerlet": 1.5, "PEFRL": 2.2, "RK44": 1.5}
ELEMENTS, RUN_STEPS = (16, 64, 256, 1024), 20
EXPLICIT = ("splitting", PREPROCESSED, "nystrom, order 4")
FIXED, NEWTON = "bodies_energy_momentum, fixed point", "bodies_energy_momentum, newton"


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--elements", action="store_true", help="print only the time by the number of elements")
    options = command.parsed(parser)
    command.pin()
    from lib import measure, report

    if options.elements:
        print(elements_table(elements((8, 32) if options.quick else ELEMENTS)))
        return
    sizes = (8, 16, (16, 32), 20) if options.quick else (16, 32, (64, 128), 1000)
    result = command.under_load(lambda: {"machine": measure.machine(), **measured(*sizes, 1 if options.quick else 3)})
    report.publish("rods", sections(result), result, options.out)


def measured(coarse: int, fine: int, limit: tuple[int, int], members: int, rounds: int) -> dict[str, Any]:
    """The rows of one rod, the distance of the two limits in space, the rows of many rods, and the gradients."""
    references = {"ours": our_reference, "PyElastica": their_reference, "Exudyn": exudyn_reference}
    ends = {code: (4 * path(limit[1]) - path(limit[0])) / 3 for code, path in references.items()}
    calls: dict[tuple[int, str, int], Callable[[], Any]] = {}
    exact: dict[tuple[int, str], np.ndarray] = {}
    for n in (coarse, fine):
        exact |= {(n, code): path(n) for code, path in references.items()}
        for name, steps in our_steps(n).items():
            for k in steps:
                calls[n, f"ours, {name}", k] = partial(our_path, n, name, k)
        for k in (200, 400, 800):
            calls[n, "Exudyn, TrapezoidalIndex2", k] = partial(exudyn_path, n, "TrapezoidalIndex2", k)
        calls[n, "Exudyn, RK44", steps_of(n, "RK44")] = partial(exudyn_path, n, "RK44", steps_of(n, "RK44"))
    for n in sorted({*(m for k in (1, 2, 3, 4) for m in (coarse * k, coarse * k * 3 // 2) if m <= limit[0])}):
        exact[n, "PyElastica"] = their_reference(n)
        for name in ("PositionVerlet", "PEFRL"):
            calls[n, f"PyElastica, {name}", steps_of(n, name)] = Elastica(n, [YOUNG], name, steps_of(n, name)).path
    first = {}
    for key, call in calls.items():
        start = time.process_time()
        call()
        first[key] = time.process_time() - start
    seconds = command.least_cpu_times(calls, rounds)  # pyright: ignore[reportArgumentType]
    rows = []
    for (n, name, steps), call in calls.items():
        path, code = call(), name.split(",")[0]
        errors = [largest(path["tip"], x) for x in (exact[n, code], ends[code])]
        drifts = [np.abs(path[x] - path[x][0]).max() / np.linalg.norm(path[x][0]) for x in ("energy", "momentum")]
        key = n, name, steps
        rows.append([*key, *map(float, (*errors, *drifts)), first[key], 1e3 * seconds[key]])  # pyright: ignore
    return {
        "rows": rows,
        "limits_apart": {code: largest(x, ends["ours"]) for code, x in ends.items() if code != "ours"},
        "equal_error": equal_error(rows),
        "many": many(coarse, members),
        "gradients": gradients(coarse),
        "elements": elements(ELEMENTS if members == 1000 else (coarse, fine)),
    }


def largest(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b, axis=-1).max())


def equal_error(rows: Sequence[Sequence[Any]]) -> list[list[Any]]:
    """For our rows, PyElastica's least milliseconds for the same error of all, between its rows; nan beyond these."""
    found = []
    for n, name, steps, _, error, *_, ms in rows:
        if name.startswith("ours"):
            best = []
            for stepper in ("PositionVerlet", "PEFRL"):
                curve = sorted((r[4], r[-1]) for r in rows if r[1].endswith(stepper))
                x, y = np.log(np.array(curve)).T
                best.append(float(np.exp(np.interp(np.log(error), x, y, np.nan, np.nan))))
            theirs = float(np.fmin(*best))
            found.append([n, name, steps, error, ms, theirs, theirs / ms])
    return found


def steps_of(n: int, name: str) -> int:
    """Steps near the limit of stability, a multiple of the samples."""
    c = (YOUNG / DENSITY) ** 0.5
    shear = (9 / 28) ** 0.5 * c * np.hypot(2 * n, 2 / RADIUS)
    return SAMPLES * int(np.ceil(max(2 * n * c, shear) / LIMITS[name] / SAMPLES))


def our_steps(n: int) -> dict[str, tuple[int, ...]]:
    explicit: dict[str, tuple[int, ...]] = {name: (steps_of(n, name),) for name in EXPLICIT}
    return explicit | {FIXED: (3 * steps_of(n, "splitting"),), NEWTON: (200, 400, 800)}


def velocities(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of positions and sections at s, (n, 3) each, the axes of the sections being those of space."""
    wave = 2 * np.pi
    v = np.stack([SPEED * np.cos(wave * s), SPEED * (s - 0.5), 0 * s], axis=1)
    return v, np.stack([0 * s - SPEED, -wave * SPEED * np.sin(wave * s), 0 * s], axis=1)


def our_rod(n: int, young: Any) -> Any:
    import jax.numpy as jnp

    import lieint_jax as li

    shear, bend = 27 / 28 * young / 3 * AREA, young * SECOND
    stretching, bending = jnp.stack([shear, shear, young * AREA]), jnp.stack([bend, bend, young / 3 * 2 * SECOND])
    inertia = (DENSITY * SECOND, DENSITY * SECOND)
    return li.systems.rod(1.0, n, li.systems.Section(DENSITY * AREA, inertia, stretching, bending))


def our_step(n: int, name: str, young: Any = YOUNG) -> Any:
    import lieint_jax as li

    rod = our_rod(n, young)
    if name in (FIXED, NEWTON):
        return li.schemes.bodies_energy_momentum(rod, solver="newton" if name == NEWTON else "fixed_point")
    drift = li.schemes.preprocessed(rod.free, 10) if name == PREPROCESSED else None
    return li.schemes.nystrom(rod, 4) if name == "nystrom, order 4" else li.schemes.splitting(rod, drift)


@cache
def our_start(n: int) -> Any:
    v, w = velocities(np.linspace(0, 1, n + 1))
    return our_rod(n, YOUNG).state(velocities=v, angular_velocities=w)


@cache
def our_parts(n: int, name: str, steps: int) -> Callable[[Any, Any], Any]:
    """`steps` steps, compiled once for all dt: ↦ the state, whether all converged."""
    import jax

    import lieint_jax as li

    def advance(step: Any, z: Any, dt: Any) -> Any:
        run = li.integrate(step, z, dt, steps, save_every=steps)
        return jax.tree.map(lambda x: x[-1], run.state), run.info.converged.all()

    return partial(jax.jit(advance), our_step(n, name))


def our_path(n: int, name: str, steps: int, finer: int = 1) -> dict[str, np.ndarray]:
    part = our_parts(n, name, min(our_steps(n)[name]) // SAMPLES)
    times = finer * steps // min(our_steps(n)[name])
    z, states, converged = our_start(n), [our_start(n)], []
    for k in range(SAMPLES * times):
        z, fine = part(z, 1 / (steps * finer))
        converged.append(fine)
        if (k + 1) % times == 0:
            states.append(z)
    return _observed(n, states) | {"converged": np.array(converged)}


def _observed(n: int, states: Sequence[Any]) -> dict[str, np.ndarray]:
    import jax

    stacked = jax.tree.map(lambda *x: np.stack(x), *states)
    energy, momentum = _watch(n)(stacked)
    return {"tip": stacked.q[1:, -1, :3], "energy": np.asarray(energy), "momentum": np.asarray(momentum)[:, 3:]}


@cache
def _watch(n: int) -> Callable[[Any], Any]:
    import jax

    rod = our_rod(n, YOUNG)
    return jax.jit(jax.vmap(lambda z: (rod.energy(z), rod.momentum(z))))


@cache
def our_reference(n: int) -> np.ndarray:
    return our_path(n, "nystrom, order 4", steps_of(n, "nystrom, order 4"), finer=3)["tip"]


class Elastica:
    """Rods of PyElastica in one simulator, whose block steps all of them; `path` starts again with every call."""

    def __init__(self, n: int, youngs: Any, stepper: str, steps: int) -> None:
        import elastica.timestepper.symplectic_steppers as steppers
        from elastica.modules.base_system import BaseSystemCollection
        from elastica.rod.cosserat_rod import CosseratRod

        self.steps, self.stepper = steps, getattr(steppers, stepper)()
        self.simulator = BaseSystemCollection()
        axis, normal, self.rods = np.array([0.0, 0, 1]), np.array([1.0, 0, 0]), []
        for young in youngs:
            rod = CosseratRod.straight_rod(n, np.zeros(3), axis, normal, 1.0, RADIUS, DENSITY, youngs_modulus=young)
            rod.velocity_collection[:] = velocities(np.linspace(0, 1, n + 1))[0].T
            rod.omega_collection[:] = velocities((np.arange(n) + 0.5) / n)[1].T
            self.simulator.append(rod)
            self.rods.append(rod)
        self.simulator.finalize()
        names = ("position_collection", "velocity_collection", "omega_collection", "director_collection")
        arrays = [getattr(block, name) for block in self.simulator.final_systems() for name in names]
        self.start = [(x, x.copy()) for x in arrays]

    def run(self, observe: Callable[[], None] = lambda: None) -> None:
        """Fly for 1 s from the start, calling `observe` at each of the samples."""
        for array, start in self.start:
            array[:] = start
        t, every = 0.0, self.steps // SAMPLES
        for k in range(self.steps):
            t = self.stepper.step(self.simulator, t, 1 / self.steps)
            if (k + 1) % every == 0:
                observe()

    def path(self) -> dict[str, np.ndarray]:
        """Tip (SAMPLES, 3), energy and angular momentum of the first rod, the latter from the start on."""
        tips, energies, momenta, rod = [], [], [], self.rods[0]

        def observe() -> None:
            for block in self.simulator.final_systems():
                block.compute_internal_forces_and_torques(np.float64(0))  # the strains at this time
            tips.append(rod.position_collection[:, -1].copy())
            parts = ("translational", "rotational", "bending", "shear")
            energies.append(sum(getattr(rod, f"compute_{part}_energy")() for part in parts))
            orbital = np.cross(rod.position_collection.T, rod.velocity_collection.T) * rod.mass[:, None]
            J, Q = rod.mass_second_moment_of_inertia, rod.director_collection
            spin = np.einsum("jik,jlk,lk->ki", Q, J, rod.omega_collection / rod.dilatation)
            momenta.append(orbital.sum(0) + spin.sum(0))

        for array, start in self.start:
            array[:] = start
        observe()
        self.run(observe)
        return {"tip": np.array(tips[1:]), "energy": np.array(energies), "momentum": np.array(momenta)}


@cache
def their_reference(n: int) -> np.ndarray:
    return Elastica(n, [YOUNG], "PEFRL", 16 * steps_of(n, "PEFRL")).path()["tip"]


def exudyn_path(n: int, solver: str, steps: int) -> dict[str, np.ndarray]:
    """The tip of Exudyn's rod, its energy and angular momentum, the latter two from the start on."""
    from scipy.spatial.transform import Rotation

    names = ("exudyn", "exudyn.itemInterface", "exudyn.solver")
    modules: list[Any] = [import_module(name) for name in names]  # their stubs lack what C++ defines
    exudyn, items, solvers = modules
    bodies, section = exudyn.SystemContainer().AddSystem(), exudyn.BeamSection()  # along its first axis, our third
    shear, bend = 27 / 28 * YOUNG / 3 * AREA, YOUNG * SECOND
    stiffness = np.array([YOUNG * AREA, shear, shear, YOUNG / 3 * 2 * SECOND, bend, bend])
    section.massPerLength, section.inertia = DENSITY * AREA, DENSITY * np.diag([2 * SECOND, SECOND, SECOND])
    section.stiffnessMatrix = np.diag(stiffness)
    s = np.linspace(0, 1, n + 1)
    starts = np.concatenate([np.roll(x, 1, axis=1) for x in velocities(s)], axis=1)
    nodes = [
        bodies.AddNode(items.NodeRigidBodyRotVecLG(referenceCoordinates=[at, 0, 0, 0, 0, 0], initialVelocities=u))
        for at, u in zip(s, starts, strict=True)
    ]
    for pair in pairwise(nodes):
        bodies.AddObject(items.ObjectBeamGeometricallyExact(nodeNumbers=list(pair), length=1 / n, sectionData=section))
    kinds = [
        getattr(exudyn.OutputVariableType, x) for x in ("Position", "RotationMatrix", "Velocity", "AngularVelocity")
    ]
    sensors = [
        [bodies.AddSensor(items.SensorNode(nodeNumber=k, storeInternal=True, outputVariableType=x)) for k in nodes]
        for x in kinds
    ]
    bodies.Assemble()
    settings = exudyn.SimulationSettings()
    settings.timeIntegration.numberOfSteps, settings.timeIntegration.endTime = steps, 1.0
    settings.timeIntegration.newton.useModifiedNewton = True
    settings.timeIntegration.verboseMode = 0
    settings.solution.file.write, settings.solution.sensors.writePeriod = False, 1 / SAMPLES
    M = solvers.ComputeLinearizedSystem(bodies)[0]
    if not bodies.SolveDynamic(settings, solverType=getattr(exudyn.DynamicSolverType, solver)):
        raise RuntimeError(f"Exudyn's {solver} failed with {steps} steps")
    x, R, v, w = (np.stack([bodies.GetSensorStoredData(sensor)[:, 1:] for sensor in row], axis=1) for row in sensors)
    R = R.reshape(*x.shape, 3)
    u = np.concatenate([v, np.einsum("tnji,tnj->tni", R, w)], axis=2).reshape(len(x), -1)
    p = (u @ M).reshape(len(x), -1, 6)
    turn = Rotation.from_matrix(np.swapaxes(R[:, :-1], 2, 3).reshape(-1, 3, 3) @ R[:, 1:].reshape(-1, 3, 3)).as_rotvec()
    apart = np.einsum("tnji,tnj->tni", R[:, :-1], np.diff(x, axis=1)).reshape(-1, 3)
    angle = np.maximum(np.linalg.norm(turn, axis=1, keepdims=True), 1e-6)
    twice = np.cross(turn, np.cross(turn, apart))
    apart += (1 / angle**2 - 1 / (2 * angle * np.tan(angle / 2))) * twice - np.cross(turn, apart) / 2  # log on SE(3)
    strain = np.concatenate([apart * n - [1, 0, 0], turn * n], axis=1).reshape(len(x), n, 6)
    energy = np.sum(u * p.reshape(u.shape), axis=1) / 2 + np.sum(stiffness * strain**2, axis=(1, 2)) / (2 * n)
    momentum = (np.cross(x, p[:, :, :3]) + np.einsum("tnij,tnj->tni", R, p[:, :, 3:])).sum(axis=1)
    return {"tip": np.roll(x[1:, -1], -1, axis=1), "energy": energy, "momentum": momentum}


@cache
def exudyn_reference(n: int) -> np.ndarray:
    return exudyn_path(n, "RK44", 4 * steps_of(n, "RK44"))["tip"]


def many(n: int, members: int) -> list[list[Any]]:
    """Seconds for rods of different stiffness: ours by `li.run`; PyElastica's in one block, and one after another."""
    import jax
    import jax.numpy as jnp

    import lieint_jax as li

    youngs = YOUNG * np.linspace(0.9, 1.1, members)
    calls: dict[str, Callable[[], Any]] = {}
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *x.shape)), our_start(n))
    for name in EXPLICIT:
        steps, count = jax.vmap(partial(our_step, n, name))(youngs), steps_of(n, name)
        options: dict[str, Any] = {"save_every": None, "own_step": True, "progress": False}
        calls[f"ours, {n} elements, {name}, {count} steps"] = partial(
            li.run, steps, states, 1 / count, count, **options
        )
    for m in (n, n * 3 // 2):
        count = steps_of(m, "PositionVerlet")
        label = f"PyElastica, {m} elements, PositionVerlet, {count} steps"
        calls[f"{label}, in one block"] = Elastica(m, youngs, "PositionVerlet", count).run
        calls[f"{label}, one after another"] = Elastica(m, youngs[:1], "PositionVerlet", count).run
    seconds = command.least_cpu_times(calls, 1)
    return [[name, x * (members if name.endswith("another") else 1)] for name, x in seconds.items()]


def gradients(n: int) -> dict[str, float]:
    """The derivative of the mean distance of the tip from the middle by ln E: three ways."""
    import jax
    import jax.numpy as jnp

    import lieint_jax as li

    steps, name = steps_of(n, "nystrom, order 4"), "nystrom, order 4"

    def mean(log: Any) -> Any:
        run = li.integrate(our_step(n, name, YOUNG * jnp.exp(log)), our_start(n), 1 / steps, steps, save_every=1)
        return jnp.mean(jnp.linalg.norm(run.state.q[:, -1, :3] - run.state.q[:, n // 2, :3], axis=-1))

    value = jax.jit(mean)
    found = {"forward": jax.jit(jax.jacfwd(mean)), "reverse": jax.jit(jax.grad(mean))}
    seconds = command.least_cpu_times({"run": partial(value, 0.0)} | {k: partial(f, 0.0) for k, f in found.items()}, 1)
    h = 1e-4  # the phase of the fastest vibration changes by 0.1 rad
    first, second, third = ((value(k * h) - value(-k * h)) / (2 * k * h) for k in (1, 2, 3))
    differences = float(1.5 * first - 0.6 * second + 0.1 * third)  # of sixth order in h
    return {k: float(f(0.0)) for k, f in found.items()} | {
        "differences": differences,
        **{f"{k}, time ÷ run": seconds[k] / seconds["run"] for k in found},
    }


def elements(sizes: Sequence[int], rounds: int = 5) -> list[list[Any]]:
    """Microseconds per element and step, by scheme and number of elements: the longest rod's RUN_STEPS steps, and of
    shorter rods as many more, so that a call's own microseconds weigh equally. Δt times the highest frequency is the
    same for all, and with it Newton's iterations.
    """
    import jax

    import lieint_jax as li

    calls: dict[tuple[str, int, int], Callable[[], Any]] = {}
    for n in sizes:
        steps = RUN_STEPS * max(sizes) // n
        for name, dt in (("splitting", 1 / steps_of(n, "splitting")), (NEWTON, 1 / (50 * n))):
            run = jax.jit(lambda step, z, dt, k=steps: li.integrate(step, z, dt, k, save_every=k))
            calls[name, n, steps] = partial(run, our_step(n, name), our_start(n), dt)
            assert bool(calls[name, n, steps]().info.converged.all()), (name, n)
    seconds = command.least_cpu_times(calls, rounds)  # pyright: ignore[reportArgumentType]
    return [[*key, 1e6 * x / (key[1] * key[2])] for key, x in seconds.items()]  # pyright: ignore


def elements_table(rows: Sequence[Sequence[Any]]) -> str:
    from lib import report

    head = ["", "elements", "steps", "µs per element and step"]
    return report.table(head, [[*map(str, r[:3]), f"{r[3]:.2g}"] for r in rows])


def sections(result: dict[str, Any]) -> list[str]:
    from lib import report

    one = [[r[1], str(r[0]), str(r[2]), *(f"{x:.2g}" for x in r[3:])] for r in result["rows"]]
    equal = [[r[1], str(r[0]), str(r[2]), *(f"{x:.2g}" for x in r[3:])] for r in result["equal_error"]]
    ours = min(x for name, x in result["many"] if name.startswith("ours"))
    head = ["", "elements", "steps", "tip: error of time, m", "of all, m", "drift of H", "of L", "first call, s", "ms"]
    g = result["gradients"]
    return [
        report.machine(result),
        f"load before and after: {result['load'][0]:.1f}, {result['load'][1]:.1f}",
        "One rod, 1 s. Drifts are the largest at ten times, relative to the start.",
        report.table(head, one),
        "The limits in space are up to "
        + " and ".join(f"{x:.2g} m ({code})" for code, x in result["limits_apart"].items())
        + " from ours: the models differ.",
        "PyElastica's time for the same error of all, interpolated between its rows (blank: beyond these)",
        report.table(["", "elements", "steps", "of all, m", "ms", "PyElastica, ms", "÷ ours"], equal),
        "Many rods of different stiffness, on one core (one after another: one rod, times their number)",
        report.table(["", "s", "÷ ours"], [[name, f"{x:.3g}", f"{x / ours:.2g}"] for name, x in result["many"]]),
        "Time by the number of elements of one rod",
        elements_table(result["elements"]),
        "The derivative of the tip's mean distance from the middle by ln E (`nystrom`, order 4), less that by "
        "differences of sixth order, relative. PyElastica has none.",
        report.table(
            ["", "error", "time ÷ run"],
            [
                [k, f"{abs(g[k] / g['differences'] - 1):.1e}", f"{g[f'{k}, time ÷ run']:.2g}"]
                for k in ("forward", "reverse")
            ],
        ),
    ]


if __name__ == "__main__":
    main()
