"""How fast is an ensemble on a GPU: as one kernel, as XLA's loop over steps, and on the CPU beside it?

`jax.jit(jax.vmap(li.integrate))` with the result left on the device, for free bodies, tops, and steps of other kinds;
then gradients, and `li.run`, which brings its result to the host. Energy is compared with that at the start, in
the precision of the run. Without a GPU, `--quick` lets Pallas interpret the kernels, to see the script at work.

    python benchmarks/gpu_kernels.py [--quick] [--only NAME …] [--out DIR]
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from lib import command, report

import lieint_jax as li
from lieint_jax.native import computed_by

MEMBERS = (10**4, 10**5, 10**6, 10**7)
ENGINES = {"kernel": ("gpu", "kernel"), "XLA": ("gpu", "xla"), "CPU": ("cpu", "native")}
_MOST_STEPS = 5e8  # of all members, in a call
_HEAD = ["", "dtype", "members", "steps", *(f"{x}, 10⁶ steps/s" for x in ENGINES), "÷ XLA", "÷ CPU", "first s"]
_QUALITY = ["energy", "apart from CPU"]


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--only", nargs="+", metavar="NAME")
    options = command.parsed(parser)
    has_gpu = jax.default_backend() == "gpu"
    if not has_gpu and not options.quick:
        print("nothing is measured: JAX finds no GPU")
        return
    device = jax.devices()[0].device_kind if has_gpu else "no GPU: Pallas interprets the kernels on the CPU"
    rows = []
    for x64 in (True, False):
        jax.config.update("jax_enable_x64", x64)
        for row in measured(options.quick, options.only, has_gpu):
            rows.append(row)
            print(row, flush=True)
    title = f"{device}; {os.cpu_count()} CPU cores; jax {jax.__version__}"
    table = report.table([*_HEAD, *_QUALITY], [_shown(row) for row in rows])
    report.publish("gpu_kernels", [title, table], {"machine": title, "rows": rows}, options.out)


def problems() -> dict[str, Callable[[], tuple[li.core.Step, Any]]]:
    """A step and a state by name."""
    spin, tilt = [0.3, 0.2, 1.0], np.array([0.9, 0.4, 0.1, 0.0])

    def body(make: Callable[..., li.core.Step], *more: int) -> tuple[li.core.Step, Any]:
        system = li.systems.rigid_body([1.0, 2.0, 3.0])
        return make(system, *more), system.state(angular_velocity=spin)

    def top(make: Callable[..., li.core.Step], *more: int) -> tuple[li.core.Step, Any]:
        system = li.systems.heavy_top([1.0, 1.0, 0.5], [0.0, 0.0, 1.0])
        return make(system, *more), system.state(tilt / np.linalg.norm(tilt), angular_velocity=spin)

    return {
        "free body": lambda: body(li.schemes.so3_midpoint),
        "top": lambda: top(li.schemes.splitting),
        "free body, preprocessed 10": lambda: body(li.schemes.preprocessed, 10),
        "free body, exact": lambda: body(li.schemes.exact),
        "top, energy_momentum": lambda: top(li.schemes.top_energy_momentum),
        "top, nystrom 6": lambda: top(li.schemes.nystrom, 6),
        "top, extrapolate": lambda: top(li.schemes.extrapolate),
        "top, gauss": lambda: top(li.schemes.gauss),
    }


def measured(quick: bool, only: list[str] | None, has_gpu: bool) -> Iterator[dict[str, Any]]:
    """A row for each problem and size: steps of all members a second, by engine."""
    for name, problem in problems().items():
        if only and name not in only:
            continue
        sizes = MEMBERS if name in ("free body", "top") else MEMBERS[1:2]
        for members in (64,) if quick else sizes:
            steps = 4 if quick else int(min(1000, _MOST_STEPS / members))
            yield _row(name, _runs(*problem(), members, steps), members, steps, has_gpu)
    if not only:
        for members in (64,) if quick else MEMBERS[1:3]:
            steps = 4 if quick else 100
            yield _row(
                "gradient, free body", _gradients(*problems()["free body"](), members, steps), members, steps, has_gpu
            )
            yield _whole_run(*problems()["free body"](), members, steps, has_gpu)


def _states(step: li.core.Step, state: Any, members: int) -> Any:
    """States whose momenta differ by a tenth."""
    states = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), (members, *np.shape(x))).copy(), step.start(state))
    return states._replace(p=states.p * np.linspace(0.95, 1.05, members, dtype=states.p.dtype)[:, None])


def _runs(step: Any, state: Any, members: int, steps: int) -> tuple[Callable[[Any], Any], Any, Callable[..., float]]:
    def run(states: Any) -> Any:
        found = jax.vmap(lambda x: li.integrate(step, x, 0.05, steps, save_every=steps))(states)
        return jax.tree.map(lambda x: x[:, -1], found.state), found.info.converged.all()

    def energy_error(states: Any, found: Any) -> float:
        before, after = (jax.jit(jax.vmap(step.system.energy))(x) for x in (states, found[0]))
        return float(jnp.max(jnp.abs(after / before - 1))) if bool(found[1]) else np.nan

    return run, _states(step, state, members), energy_error


def _gradients(step: Any, state: Any, members: int, steps: int) -> tuple[Callable[[Any], Any], Any, None]:
    def loss(dt: Any, state: Any) -> Any:
        end = li.integrate(step, state, dt, steps, save_every=steps).state
        return jnp.sum(end.q[-1] ** 3)

    return jax.vmap(jax.grad(loss), (None, 0)), _states(step, state, members), None


def _row(name: str, problem: tuple[Any, Any, Any], members: int, steps: int, has_gpu: bool) -> dict[str, Any]:
    function, states, error = problem
    row: dict[str, Any] = {"name": name, "dtype": str(states.p.dtype), "members": members, "steps": steps}
    ends = {}
    for engine, (platform, code) in ENGINES.items():
        device = jax.devices(platform if has_gpu else "cpu")[0]
        given = jax.device_put(states, device)
        arguments = (jnp.asarray(0.05, states.p.dtype), given) if error is None else (given,)
        with computed_by(code, os.cpu_count() or 1), jax.default_device(device):
            compiled = jax.jit(function)
            first, _ = _seconds(compiled, arguments)
            seconds, found = min((_seconds(compiled, arguments) for _ in range(3)), key=lambda x: x[0])
            row |= {engine: members * steps / seconds, f"first {engine}": first}
            if engine == "kernel" and error is not None:
                row["energy"] = error(given, found)
        ends[engine] = np.asarray(jax.tree.leaves(found)[0])
    scale = np.abs(ends["CPU"]).max()
    return row | {"apart": float(np.abs(ends["kernel"] - ends["CPU"]).max() / scale)}


def _whole_run(step: Any, state: Any, members: int, steps: int, has_gpu: bool) -> dict[str, Any]:
    """`li.run`, from the host to the host."""
    states = _states(step, state, members)

    def run() -> Any:
        return li.run(step, states, 0.05, steps, save_every=steps, progress=False).state.p

    first, _ = _seconds(run, ())
    seconds = min(_seconds(run, ())[0] for _ in range(3))
    row = {"name": "free body, li.run", "dtype": str(states.p.dtype), "members": members, "steps": steps}
    return row | {"kernel" if has_gpu else "CPU": members * steps / seconds, "first kernel": first}


def _seconds(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[float, Any]:
    start = time.perf_counter()
    found = jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start, found


def _shown(row: dict[str, Any]) -> list[str]:
    rates = [row.get(x, np.nan) for x in ENGINES]
    ratios = [rates[0] / x for x in rates[1:]]
    numbers = [*(f"{x / 1e6:.3g}" for x in rates), *(f"{x:.3g}" for x in ratios), f"{row['first kernel']:.1f}"]
    quality = [f"{row[x]:.1e}" if x in row else "" for x in ("energy", "apart")]
    return [row["name"], row["dtype"], f"{row['members']:.0e}", str(row["steps"]), *numbers, *quality]


if __name__ == "__main__":
    main()
