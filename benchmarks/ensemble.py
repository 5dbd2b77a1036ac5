"""How do ensembles scale: with the number of bodies, over devices, against C++ on as many threads, against the machine?

Free rigid bodies of inertia (1, 2, 3) at dt = 0.05, and an example of each other system, float64, through the loop that
`li.run` compiles. Contestants are timed in turn, round after round, so that a slow spell of the machine affects
all alike; a rate is that of the best call.

    python benchmarks/ensemble.py [--quick] [--out DIR] [--only PART …]

Parts: `sizes` (bodies from 1 to a million), `cpp` (whole calls of `li.run` against C++), `systems` (a thousand of
each), `peers`, `threads` (C++ and ours on one core and on all; strong scaling is the same bodies on more devices, weak
scaling as many bodies on each), `roofline` (the operations that XLA counts in a step, against the core's peak). Each
part runs in a process of its own, pinned to a core before JAX starts; `threads` also runs in a second one without the
pin.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

from lib import command

PARTS = ("sizes", "cpp", "systems", "torques", "peers", "threads", "roofline")


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)  # set in the processes of the parts
    parser.add_argument("--all-cores", action="store_true", help=argparse.SUPPRESS)
    options = command.parsed(parser)
    cores = sorted(os.sched_getaffinity(0))
    if options.part:
        if not options.all_cores:
            command.pin()  # before jax makes its threads
        import jax

        jax.config.update("jax_enable_x64", True)
        print(json.dumps(PART[options.part](options.quick, len(cores))))
        return
    before = options.out / "ensemble.json"  # of which the parts that are not run are kept
    found: dict[str, Any] = json.loads(before.read_text(encoding="utf-8")) if before.exists() else {}
    for part in options.only:
        arguments = [sys.executable, __file__, "--part", part] + ["--quick"] * options.quick
        found[part] = _result(arguments)
        if part == "threads":
            found[part]["rates"] |= _result([*arguments, "--all-cores"])["rates"]
    os.sched_setaffinity(0, cores[-1:])
    from lib import measure, report

    found["machine"] = measure.machine()
    sections = [report.machine(found), f"{len(cores)} core(s)"]
    for part in PARTS:
        sections += TABLE[part](found[part]) if part in found else []
    report.publish("ensemble", sections, found, options.out)


def _result(arguments: list[str]) -> Any:
    return json.loads(subprocess.run(arguments, check=True, stdout=subprocess.PIPE, text=True).stdout)


def best(
    calls: dict[str, Callable[[], Any]], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Seconds of the best of `rounds` calls of each, timed in turn, after a first one that compiles."""
    seconds = dict.fromkeys(calls, float("inf"))
    for k in range(rounds + 1):
        for name, call in calls.items():
            start = clock()
            call()
            if k:
                seconds[name] = min(seconds[name], clock() - start)
    return seconds


def ours(step: Any, states: Any, dt: float, num_steps: int, devices: int = 1) -> Callable[[], Any]:
    """A function that calls the ensemble's compiled loop once, in so many threads."""
    import jax

    from lieint_jax.runs._engine import engine_of
    from lieint_jax.runs._plan import make_plan

    plan = make_plan(step, states, dt, num_steps, save_every=None, threads=devices)
    engine = engine_of(plan)
    given, start = engine.start()

    def call() -> Any:
        return engine.run_intervals(given, start, 0, 0, plan.nodes[1:], rows=1)[0]

    jax.block_until_ready(call())
    return call


def bodies(count: int) -> Any:
    """The free bodies of `measure`, the first thousand of them repeated."""
    import jax.numpy as jnp
    import numpy as np
    from lib import measure

    import lieint_jax as li

    q, p = (np.resize(x, (count, x.shape[1])) for x in measure.bodies(min(count, 1000)))
    return li.State(jnp.asarray(q), jnp.asarray(p))


def free_steps() -> dict[str, Any]:
    from lib import measure

    import lieint_jax as li

    body = measure.body()
    return {"so3_midpoint, symplectic κ": li.schemes.so3_midpoint(body), "so3_explicit": li.schemes.so3_explicit(body)}


def sizes(quick: bool, _: int) -> Any:
    """Rates of free bodies by their number."""
    counts = (1, 10, 100, 1000, 10_000) if quick else (1, 10, 100, 1000, 10_000, 100_000, 1_000_000)
    work, rounds = (1e6, 2) if quick else (1.5e7, 4)
    rates: dict[str, dict[int, float]] = {name: {} for name in free_steps()}
    for group in (counts[:3], counts[3:]):
        calls, done = {}, {}
        for count in group:
            n = int(max(10, min(work / max(count, 64), 100_000)))
            for name, step in free_steps().items():
                calls[f"{name}|{count}"], done[f"{name}|{count}"] = ours(step, bodies(count), 0.05, n), n * count
        for key, seconds in best(calls, rounds).items():
            name, count = key.split("|")
            rates[name][int(count)] = done[key] / seconds
    return rates


def whole_runs(quick: bool, _: int) -> Any:
    """Rates of whole calls of `li.run`, and of C++ that keeps the same reports, for 1000 bodies.

    "C++" is a loop over steps of a loop over bodies, which g++ vectorizes; "C++ in blocks" one over blocks of bodies,
    each of which makes all steps, as machine code of `li.run` does.
    """
    from lib import cpp, measure, tops

    import lieint_jax as li

    J, dt, n, states = measure.INERTIA, measure.DT, 2000 if quick else 50_000, bodies(1000)
    midpoint, explicit = free_steps().items()
    entries = [
        (*midpoint, {"C++": cpp.symplectic("newton", J, dt), "C++ in blocks": cpp.in_blocks("midpoint", J, dt)}, 0.95),
        (*explicit, {"C++": cpp.symplectic("scalar", J, dt), "C++ in blocks": cpp.in_blocks("explicit", J, dt)}, 0.9),
        (
            "splitting of a heavy top",
            li.schemes.splitting(tops.top()),
            {"C++": cpp.top("splitting", J, tops.WEIGHT, dt)},
            0.75,
        ),
    ]
    calls: dict[str, Callable[[], Any]] = {}
    for name, step, rivals, _bar in entries:
        calls[f"{name}|ours"] = lambda step=step: li.run(step, states, dt, n, save_every=None, progress=False)
        for kind, rival in rivals.items():
            loaded = rival.load(*measure.bodies(1000))
            calls[f"{name}|{kind}"] = lambda rival=rival, loaded=loaded: rival.advance(loaded, n)
    seconds = best(calls, 3 if quick else 6, time.process_time)  # of this process, which others may interrupt
    return [
        {"name": name, "bar": bar} | {kind: 1000 * n / seconds[f"{name}|{kind}"] for kind in ("ours", *rivals)}
        for name, _, rivals, bar in entries
    ]


def systems(quick: bool, _: int) -> Any:
    """Rates of a thousand bodies of one example of each system, for a few schemes each."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    import lieint_jax as li

    found = {}
    chosen = [
        ("rigid_body", "asymmetric", ("so3_midpoint", "so3_explicit", "preprocessed", "calibrated", "exact")),
        ("heavy_top", "asymmetric_top", ("splitting", "top_energy_momentum")),
        ("potential_top", "brun", ("splitting", "top_energy_momentum")),
        ("pendulum", "uniform", ("sphere_midpoint",)),
        ("pseudo_rigid_body", "ball", ("additive",)),
        ("euler", "kirchhoff", ("group_midpoint",)),
        ("group_potential", "bottom_heavy", ("group_energy_momentum",)),
    ]
    for module, example, makers in chosen[:4] if quick else chosen:
        system, state, dt = _example(module, example)
        noise = np.random.default_rng(0).normal(size=(1000, *state.p.shape))
        p = state.p * (1 + 0.01 * jnp.asarray(noise))
        if module == "pendulum":
            p = p - jnp.sum(p * state.q, axis=1, keepdims=True) * state.q
        states = li.State(jnp.broadcast_to(state.q, (1000, *state.q.shape)), p)
        for maker in makers:
            name, step = next(iter(_schemes(maker, system).items()))
            found[f"{module}.{example}, {name}"] = rate(step, states, dt, quick)
            jax.clear_caches()
    return found


def rate(step: Any, states: Any, dt: float, quick: bool) -> float:
    """Body-steps a second of a thousand bodies."""
    seconds = best({"": ours(step, states, dt, 20)}, 2)[""]
    n = int(max(20, min(20 * (0.05 if quick else 0.3) / seconds, 1e5)))
    return 1000 * n / best({"": ours(step, states, dt, n)}, 3)[""]


def torques(quick: bool, _: int) -> Any:
    """Rates of a thousand bodies under one law of torque each, by `torqued_midpoint`, work counted."""
    from functools import partial

    import jax.numpy as jnp
    import numpy as np
    from lib import measure

    import lieint_jax as li
    from lieint_jax.groups import so3

    field, n = jnp.array([0.3, 0.1, 1.0]), 500 if quick else 5000
    laws = {
        "of the time": lambda t, q, omega: 0.1 * jnp.stack([jnp.cos(t), jnp.sin(t), t / (1 + t * t)]),
        "viscous": li.torques.viscous(0.01),
        "of the attitude": lambda t, q, omega: 0.1 * jnp.cross(field, so3.Ad_star(q, field)),
        "of time, attitude and velocity": lambda t, q, omega: (
            0.1 * jnp.cos(t) * jnp.cross(field, so3.Ad_star(q, field)) - 0.01 * omega
        ),
    }
    bodies = {name: li.systems.torqued_body(measure.INERTIA, law) for name, law in laws.items()}
    bodies |= {name: _example("torqued_body", name)[0] for name in ("detumbling", "slew", "damper")}
    q, p = measure.bodies(1000)
    found = {}
    for name, body in bodies.items():
        more = body.state(angular_velocity=[0.0, 0.0, 1.0], work=0.0)
        extra = {key: np.repeat(np.asarray(x)[None], 1000, axis=0) for key, x in (more.extra or {}).items()} or None
        states = more._replace(q=q, p=p, extra=extra)
        step = li.schemes.torqued_midpoint(body)
        seconds = best({"": partial(li.run, step, states, measure.DT, n, save_every=None, progress=False)}, 3)[""]
        found[name] = 1000 * n / seconds
    return found


def _example(module: str, example: str) -> Any:
    import importlib

    return importlib.import_module(f"lieint_jax.systems._{module}").examples()[example]


def _schemes(module: str, system: Any) -> Any:
    import importlib

    return importlib.import_module(f"lieint_jax.schemes._{module}").examples(system)


def against(quick: bool, _: int) -> Any:
    """Rates of free bodies by their number, beside those of other packages."""
    from functools import partial

    from lib import measure, peers

    J, dt, notes = measure.INERTIA, measure.DT, []
    step = free_steps()["so3_midpoint, symplectic κ"]
    makers: list[tuple[str, Callable[[], Any]]] = [
        ("ours", partial(measure.ours, "ours, symplectic κ", step, dt, pace=9e7)),
        ("diffrax", partial(peers.tsit5, J, dt, wide=True)),
        ("diffrax", partial(peers.dopri8, J, dt, wide=True)),
        ("MuJoCo", partial(peers.mujoco_rk4, J, dt)),
    ]
    entries = list(measure.those_here(makers, notes))
    spent = measure.QUICK if quick else measure.Sizes(seconds=0.3)
    counts = (1, 1000) if quick else (1, 1000, 100_000)
    return {"notes": notes, "rates": [r for count in counts for r in measure.rates(entries, count, spent)]}


def threads(quick: bool, cores: int) -> Any:
    """Rates of ours and of C++ on all cores of this process; C++ runs blocks on threads, without Python's lock."""
    from concurrent.futures import ThreadPoolExecutor

    import jax

    here = len(os.sched_getaffinity(0))
    jax.config.update("jax_num_cpu_devices", here)
    import numpy as np
    from lib import cpp, measure

    count, n = (2000, 500) if quick else (20_000, 2000)
    kinds = {"one": count} if here == 1 else {"strong": count, "weak": here * count}

    def by_cpp(form: Any, total: int) -> Callable[[], Any]:
        contestant = cpp.symplectic(form, measure.INERTIA, 0.05)
        q, p = (np.array_split(np.asarray(x), total // 1000) for x in bodies(total)[:2])
        blocks = [contestant.load(a, b) for a, b in zip(q, p, strict=True)]
        pool = ThreadPoolExecutor(here)
        return lambda: list(pool.map(lambda block: contestant.advance(block, n), blocks))

    calls: dict[str, Callable[[], Any]] = {}
    for kind, total in kinds.items():
        for name, step in free_steps().items():
            calls[f"{name}|{kind}"] = ours(step, bodies(total), 0.05, n, here)
        for form in ("newton", "scalar"):
            calls[f"C++ {form} form|{kind}"] = by_cpp(form, total)
    seconds = best(calls, 3 if quick else 5)
    return {
        "devices": cores,
        "bodies": count,
        "rates": {key: kinds[key.split("|")[1]] * n / s for key, s in seconds.items()},
    }


def roofline(quick: bool, _: int) -> Any:
    """XLA's count of operations per body-step, and the core's peak rate, measured by a product of matrices."""
    import jax
    import numpy as np

    from lieint_jax.runs import compiler_options

    states, found = bodies(1024), {}
    for name, step in free_steps().items():
        prepared = jax.vmap(lambda z, step=step: step.prepare(z, 0.05))(states)
        axis = 0 if name == "so3_explicit" else None
        one = jax.jit(jax.vmap(lambda s, z: s(z, 0.05), in_axes=(axis, 0)), compiler_options=compiler_options())
        counted: Any = one.lower(prepared if axis == 0 else step, states).compile().cost_analysis()
        n = 500 if quick else 8000
        call = ours(step, states, 0.05, n)
        found[name] = {
            "flops": counted["flops"] / 1024,
            "bytes": counted["bytes accessed"] / 1024,
            "rate": 1024 * n / best({"": call}, 5)[""],
        }

    A = np.random.default_rng(0).random((768, 768))
    seconds = best({"": lambda: A @ A}, 10)[""]
    return {"steps": found, "peak": 2 * 768**3 / seconds}


def sizes_table(rates: Any) -> list[str]:
    from lib import report

    counts = list(next(iter(rates.values())))
    rows = [[name, *(f"{r[c] / 1e6:.3g}" for c in counts)] for name, r in rates.items()]
    bars = []
    if "100000" in counts:
        for name, r in rates.items():
            ratio = r["100000"] / r["1000"]
            bars.append(
                [
                    f"{name}: a body of 10⁵ against one of 1000",
                    f"{ratio:.2f}",
                    "≥ 0.87",
                    report.verdict(ratio, ratio >= 1 / 1.15),
                ]
            )
    title = "Millions of body-steps a second by number of free bodies, one core"
    table = report.table(["", *map(str, counts)], rows)
    return [title, table, *([report.table(["", "measured", "bar", ""], bars)] if bars else [])]


def whole_runs_table(found: Any) -> list[str]:
    from lib import report

    rows = []
    for r in found:
        ratio = r["ours"] / r["C++"]
        blocks = r.get("C++ in blocks", float("nan"))
        rates = (f"{x / 1e6:.3g}" for x in (r["ours"], r["C++"], blocks))
        ratios = (f"{x:.2f}" for x in (r["ours"] / blocks, ratio))
        rows.append([r["name"], *rates, *ratios, f"≥ {r['bar']:g}", report.verdict(ratio, ratio >= r["bar"])])
    title = (
        "Millions of body-steps a second of whole calls of `li.run`, 1000 bodies × 50 000 steps, one core; C++ "
        "as a loop over steps of a loop over bodies, and over blocks of 16 bodies, each of which makes all steps"
    )
    head = ["", "ours", "C++", "C++ in blocks", "ours ÷ C++ in blocks", "ours ÷ C++", "bar", ""]
    return [title, report.table(head, rows)]


def torques_table(rates: Any) -> list[str]:
    from lib import report

    first = next(iter(rates.values()))
    rows = [[name, f"{r / 1e6:.3g}", f"{1e9 / r:.3g}", f"{first / r:.2f}"] for name, r in rates.items()]
    said = "Torques: millions of body-steps a second by `torqued_midpoint`, work counted, 1000 bodies, one core"
    return [said, report.table(["torque", "rate", "ns", "÷ of the time"], rows)]


def systems_table(rates: Any) -> list[str]:
    from lib import report

    rows = [[name, f"{rate / 1e6:.3g}"] for name, rate in rates.items()]
    return ["Millions of body-steps a second, 1000 bodies, one core", report.table(["", "rate"], rows)]


def peers_table(found: Any) -> list[str]:
    from lib import report

    counts, rates = sorted({r["bodies"] for r in found["rates"]}), found["rates"]
    names = dict.fromkeys(r["name"] for r in rates)
    rows = [[name, *(f"{report.rate(rates, name, bodies=c) / 1e6:.3g}" for c in counts)] for name in names]
    title = "Millions of body-steps a second by number of free bodies, one core, all compiled at full vector width"
    return [title, report.table(["", *map(str, counts)], rows), *found["notes"]]


def threads_table(found: Any) -> list[str]:
    from lib import report

    rates, devices, rows, bars = found["rates"], found["devices"], [], []
    for name in dict.fromkeys(key.split("|")[0] for key in rates):
        one, strong, weak = (rates[f"{name}|{kind}"] for kind in ("one", "strong", "weak"))
        rows.append(
            [name, *(f"{x / 1e6:.3g}" for x in (one, strong, weak)), f"{strong / one:.2f}", f"{weak / one:.2f}"]
        )
        if not name.startswith("C++") and devices > 1:
            ratio = max(strong, weak) / one
            bars.append(
                [
                    f"{name}: {devices} devices against one",
                    f"{ratio:.2f}",
                    f"≥ {0.85 * devices:g}",
                    report.verdict(ratio, ratio >= 0.85 * devices),
                ]
            )
    title = (
        f"Millions of body-steps a second: {found['bodies']} free bodies on one core; on {devices} cores, one device "
        "each (strong); as many on each of them (weak); C++ in blocks of 1000 too, a thread a core"
    )
    head = ["", "one", "strong", "weak", "strong ÷ one", "weak ÷ one"]
    return [title, report.table(head, rows), report.table(["", "measured", "bar", ""], bars)]


def roofline_table(found: Any) -> list[str]:
    from lib import report

    rows = []
    for name, r in found["steps"].items():
        reached = r["flops"] * r["rate"]
        rows.append(
            [
                name,
                f"{r['flops']:.0f}",
                f"{r['bytes']:.0f}",
                f"{reached / 1e9:.3g}",
                f"{100 * reached / found['peak']:.0f} %",
            ]
        )
    title = (
        "Operations and bytes per body-step as XLA counts them in the compiled step, and the share of the peak that "
        f"the loop reaches; peak: {found['peak'] / 1e9:.3g} billion operations a second, by a BLAS product of matrices"
    )
    return [title, report.table(["", "operations", "bytes", "billion operations/s", "of the peak"], rows)]


PART = {
    "sizes": sizes,
    "cpp": whole_runs,
    "systems": systems,
    "torques": torques,
    "peers": against,
    "threads": threads,
    "roofline": roofline,
}
TABLE = {
    "sizes": sizes_table,
    "cpp": whole_runs_table,
    "systems": systems_table,
    "torques": torques_table,
    "peers": peers_table,
    "threads": threads_table,
    "roofline": roofline_table,
}


if __name__ == "__main__":
    main()
