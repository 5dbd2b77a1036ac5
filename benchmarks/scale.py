"""A thousand preemptible workers and 10⁹ members on paper, and a simulation of their commits; the memory of a run.

From the measured rate of one core follow core hours, bytes, requests and costs of 10⁹ free bodies × 10⁵ steps. Then
workers start, die and resume in virtual time, against the real commit code with objects in memory and injected latency.
At last the peak memory of processes that run, compared with `li.peak_memory`.

    python benchmarks/scale.py [--quick] [--out DIR]
"""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
from typing import Any

from lib import command

MEMBERS, STEPS, SAVE_EVERY, WORKERS = 10**9, 10**5, 2000, 1000
PRICE_CORE_HOUR, PRICE_GB_MONTH, PRICE_1000_PUTS, PRICE_1000_GETS = (
    0.015,
    0.023,
    0.005,
    0.0004,
)  # $, as of 2026, S3 and Spot
LIFETIMES = (300.0, 900.0, 1800.0, 7200.0)


def main() -> None:
    options = command.on_one_core(__doc__)
    import numpy as np
    from lib import measure, report

    rates = json.loads((command.RESULTS / "ensemble.json").read_text())["sizes"]["so3_midpoint, symplectic κ"]
    plan = on_paper(rates["1000000"])
    runs, workers = [], 50 if options.quick else WORKERS
    for lifetime in LIFETIMES:
        count = workers if lifetime == LIFETIMES[2] else max(workers // 10, 20)
        runs.append(simulate(plan, count, lifetime))
        print({key: x for key, x in runs[-1].items() if not isinstance(x, list)}, flush=True)
    memory = [measured_memory(*case) for case in memory_cases(options.quick)]
    result = {"plan": plan, "simulation": runs, "memory": memory, "machine": measure.machine()}
    sections = [report.machine(result), *paper(plan, report), *simulated(runs, report), *memories(memory, report)]
    slim = [{key: x for key, x in run.items() if not isinstance(x, list)} for run in runs]
    report.publish("scale", sections, result | {"simulation": slim}, options.out)
    draw(next(r for r in runs if r["lifetime"] == LIFETIMES[2]), runs, options.out)
    assert all(r["lost entries"] == r["doubled"] == 0 and r["created"] == 1 for r in runs)
    assert np.isfinite(plan["seconds of a worker"])


def on_paper(rate: float) -> dict[str, Any]:
    """The sizes of the run, by the layout of the package itself: its arrays are views that need no memory."""
    import jax
    import numpy as np
    from lib import measure  # float64

    import lieint_jax as li
    from lieint_jax.runs import _made_states
    from lieint_jax.runs._plan import make_plan

    del measure
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    one = jax.vmap(lambda w: body.state(angular_velocity=w))(np.ones((1, 3)))
    small = make_plan(
        li.schemes.so3_midpoint(body),
        one,
        0.05,
        STEPS,
        save_every=SAVE_EVERY,
        store="s3://bucket/x.zarr",
        part=(0, 1),
    )
    states = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), (MEMBERS, *x.shape[1:])), small.states)
    plan = dataclasses.replace(small, states=states, part=(0, WORKERS))
    split, part = plan.split(), plan.of_part()
    rows, chunks = part.buffer_rows(split.chunk), len(split.chunks(0))
    commits = math.ceil((plan.num_saves + 1) / rows)
    seconds = part.members * STEPS / rate
    data = MEMBERS * (plan.num_saves + 1) * plan.row_bytes
    puts = WORKERS * (commits * (4 * chunks + 1) + chunks)
    hours = MEMBERS * STEPS / rate / 3600
    return {
        "rate of a core": rate,
        "core hours": hours,
        "seconds of a worker": seconds,
        "members of a chunk": split.chunk,
        "entries": plan.num_saves + 1,
        "entries of a chunk": rows,
        "MB of a chunk of q": split.chunk * rows * 32 / 1e6,
        "MB of a chunk of p": split.chunk * rows * 24 / 1e6,
        "bytes": data,
        "bytes of a part's commit": part.members * rows * plan.row_bytes,
        "bytes of a part's state": part.members * plan.row_bytes,
        "commits of a part": commits,
        "puts": puts,
        "objects": WORKERS * (commits * 4 * chunks + chunks + 1),
        "objects with chunks of 8192 members": math.ceil(MEMBERS / 8192) * (4 * commits + 1),
        "checksums in a state, bytes": commits * 4 * chunks * 4,
        "initial states in each process, bytes": (part.members + 2 * _made_states.BLOCK) * 56,
        "$ compute": hours * PRICE_CORE_HOUR,
        "$ puts": puts / 1000 * PRICE_1000_PUTS,
        "$ a month": data / 1e9 * PRICE_GB_MONTH,
        "seconds between saves": seconds / plan.num_saves,
        "MB/s of all workers": data / seconds / 1e6,
    }


def paper(plan: dict[str, Any], report: Any) -> list[str]:
    """The sections of the plan."""
    rows = [[key, f"{x:.4g}" if isinstance(x, float) else f"{x:,}"] for key, x in plan.items()]
    return [
        f"On paper: {MEMBERS:.0e} bodies × {STEPS:.0e} steps, saved every {SAVE_EVERY}, {WORKERS} workers of one core",
        report.table(["", "value"], rows),
        "The rate is that of 10⁶ members in ensemble.md, on a core of a Xeon. The prices are assumptions: $ 0.015 for "
        "a core hour, 0.005 for 1000 PUTs, 0.023 for a GB and month. What saturates first is the bandwidth of the "
        "workers, not the number of requests.",
        "The metadata do not grow with the number of chunks: Zarr computes their names. The initial states are a "
        "function of member numbers, of which a part makes its own and at most two blocks of 65 536 more; as an array "
        "of all members they would have 56 GB in each process. Chunks of 8192 members would be objects of about 1 MB, "
        "and many more of them; so chunks in object storage have more members.",
    ]


def simulate(plan: dict[str, Any], count: int, lifetime: float) -> dict[str, Any]:
    """The numbers of a simulation of `count` workers."""
    import numpy as np
    from lib import workers

    model = workers.Model(
        count,
        plan["entries"],
        plan["entries of a chunk"],
        plan["seconds between saves"],
        plan["bytes of a part's commit"],
        plan["bytes of a part's state"],
        lifetime,
    )
    simulation = workers.Simulation(model, f"{count}-{lifetime}")
    outcomes = simulation.run()
    found = workers.verify(simulation)
    ideal = model.seconds * (model.entries - 1)
    requests = np.concatenate([o.requests for o in outcomes])
    peak = np.bincount(requests.astype(int)).max()
    busy = sum(end - begin for o in outcomes for begin, end in o.busy)
    return {
        "workers": count,
        "lifetime": lifetime,
        "created": simulation.created,
        "lost entries": found["lost"],
        "doubled": found["doubled"],
        "deaths": sum(o.deaths for o in outcomes),
        "computed again": sum(o.lost for o in outcomes) / busy,
        "most computed again by one": max(o.lost for o in outcomes),
        "waited for commits": sum(o.waited for o in outcomes) / busy,
        "longest request": max(o.longest for o in outcomes),
        "requests": len(requests),
        "repeated": int(sum(o.repeated for o in outcomes)),
        "requests in the busiest second": int(peak),
        "median end": float(np.median([o.end for o in outcomes])),
        "last end": max(o.end for o in outcomes),
        "without deaths": ideal,
        "throughput": ideal * count / sum(o.end for o in outcomes),
        "busy intervals": [x for o in outcomes for x in o.busy],
        "commit times": [x for o in outcomes for x in o.commits],
        "request times": requests.tolist(),
    }


def simulated(runs: list[dict[str, Any]], report: Any) -> list[str]:
    """The sections of the simulations."""
    head = ["mean life, s", "workers", "deaths", "computed again", "waited", "longest request, s", "requests"]
    head += ["repeated", "busiest second", "median end, s", "last end, s", "lost", "doubled"]
    rows = []
    for r in runs:
        percent = [f"{100 * r['computed again']:.1f} %", f"{100 * r['waited for commits']:.2f} %"]
        ends = [f"{r[key]:.0f}" for key in ("median end", "last end")]
        counts = [str(r[key]) for key in ("requests", "repeated", "requests in the busiest second")]
        doubt = [str(r[key]) for key in ("lost entries", "doubled")]
        cells = [f"{r['lifetime']:.0f}", str(r["workers"]), str(r["deaths"]), *percent, f"{r['longest request']:.2f}"]
        rows.append([*cells, *counts, *ends, *doubt])
    return [
        f"Simulated: without deaths a worker computes {runs[0]['without deaths']:.0f} s. Lives and the waits for a "
        "successor (mean 60 s) are exponential, a start costs 20 s, a request 30 ms (median) and its bytes at "
        "100 MB/s. Of the requests 1 % fail. "
        "Entries are compared with those of a run without deaths; a death in a PUT leaves it "
        "done or not, by chance.",
        report.table(head, rows),
        "A simulated part has one chunk of each array to a commit, and the one on paper four: the busiest second has "
        "four times as many PUTs. S3 accepts 3500 a second of one prefix before it throttles.",
    ]


def draw(run: dict[str, Any], runs: list[dict[str, Any]], out: Any) -> None:
    """The picture: workers that compute, committed work, requests a second, work computed again by mean life."""
    import numpy as np

    from lieint_jax import plots

    with plots.style():
        fig, [axes] = plots.figure(3, size=(3.8, 3.2))
        t = np.linspace(0, run["last end"], 400)
        begins, ends = (np.sort([x[i] for x in run["busy intervals"]]) for i in (0, 1))
        computing = np.searchsorted(begins, t) - np.searchsorted(ends, t)
        commits = np.sort(run["commit times"])
        left = axes[0]
        left.plot(t, computing / run["workers"], label="workers that compute")
        left.plot(t, np.searchsorted(commits, t) / len(commits), label="work committed")
        left.set(xlabel="time (s)", ylabel="fraction", ylim=(-0.05, 1.3))
        left.legend(loc="upper right")
        axes[1].plot(np.bincount(np.array(run["request times"]).astype(int)), lw=0.5)
        axes[1].set(xlabel="time (s)", ylabel="requests a second")
        axes[2].plot([r["lifetime"] for r in runs], [r["computed again"] for r in runs], "o-", label="computed again")
        axes[2].plot(
            [r["lifetime"] for r in runs],
            [r["waited for commits"] for r in runs],
            "s-",
            label="waited for others' commits",
        )
        axes[2].set(xlabel="mean life (min)", ylabel="fraction of the computing time", xscale="log")
        axes[2].set_xticks(LIFETIMES, [f"{life / 60:.0f}" for life in LIFETIMES])
        axes[2].minorticks_off()
        axes[2].legend()
        titles = (f"{run['workers']} workers", "their requests to the store", "work lost to ends of workers")
        plots.letter_panels(axes, titles)
        plots.save(fig, out / "scale.png")


RUN = """
import resource, sys
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import lieint_jax as li
members, saves, kind, folder = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], sys.argv[4]
body = li.systems.rigid_body([1.0, 2.0, 3.0])
step = li.schemes.so3_explicit(body)
few = jax.vmap(lambda w: body.state(angular_velocity=w))(jax.random.normal(jax.random.key(0), (64, 3)))
options = {"memory": {}, "reduce": {"reduce": "energy"}, "store": {"store": folder + "/run.zarr"}}
options |= {"part": {"store": folder + "/parts.zarr", "part": (0, 4)}}
options |= {"made": options["part"] | {"members": members}}
def made(numbers):
    return jax.tree.map(lambda x: np.asarray(x)[numbers % 64], few)
def go(states, saves):
    return li.run(step, states, dt=0.05, num_steps=2 * saves, save_every=2, progress=False, **options[kind])
li.run(step, few, dt=0.05, num_steps=4, save_every=2, progress=False, reduce=options[kind].get("reduce"))
states = jax.tree.map(lambda x: jnp.tile(x, (members // 64, 1)), few) if kind != "made" else None
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
result = go(made if kind == "made" else states, saves)
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
chosen = options[kind]
given = li.peak_memory(
    made if kind == "made" else states, saves + 1, store=chosen.get("store"), part=chosen.get("part"),
    reduce=kind == "reduce", save_every=2, members=chosen.get("members"),
)
print((after - before) * 1024, given)
"""


def memory_cases(quick: bool) -> list[tuple[int, int, str]]:
    """Members, saves and kinds of runs."""
    members = 64_000 if quick else 320_000
    cases = [
        ("memory", 20),
        ("store", 20),
        ("store", 100),
        ("part", 20),
        ("part", 100),
        ("made", 100),
        ("reduce", 20),
        ("reduce", 100),
    ]
    return [(members, saves, kind) for kind, saves in cases]


def measured_memory(members: int, saves: int, kind: str) -> dict[str, Any]:
    """The growth of a process' peak memory by a run, and `li.peak_memory`."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        arguments = [sys.executable, "-c", RUN, str(members), str(saves), kind, folder]
        found = subprocess.run(arguments, check=True, capture_output=True, text=True).stdout.split()
    print(kind, members, saves, found, flush=True)
    return {"members": members, "saves": saves, "kind": kind, "measured": int(found[0]), "given": int(found[1])}


def memories(rows: list[dict[str, Any]], report: Any) -> list[str]:
    """The section of the memory."""
    cells = [
        [r["kind"], f"{r['members']:,}", str(r["saves"]), f"{r['measured'] / 1e6:.0f}", f"{r['given'] / 1e6:.0f}"]
        for r in rows
    ]
    return [
        "Peak memory of a run above that of the process before it, MB, and what `li.peak_memory` gives before",
        report.table(["results", "members", "saves", "measured", "given"], cells),
        "`part` is part 0 of 4 of the members, and `made` the same with the states as a function, so that the process "
        "has only those of its own members. A run into a store holds two buffers of rows, one that is filled and one "
        "that is written, and joins and encodes eight chunks at once. The numbers of copies that `peak_memory` counts "
        "were chosen so that its values lie above these peaks, so the table is a fit and no prediction: a run of "
        "another system was not compared.",
    ]


if __name__ == "__main__":
    main()
