"""How many kernels does a step of an ensemble take on a GPU? Counted in programs compiled for an H100 without one.

A count, not a measurement. XLA compiles the loop of `ensemble.run` for 10⁶ members in float64: the plain loop (`vmap`),
and the program of numbers on arrays of the members, with 1 and 4 steps an iteration. Of each: the kernels and copies of
an iteration that do something for every member, and those of counters and tests, which all members share; the bytes
that a step reads and writes for a body; the most registers and spilled bytes of a thread. A loop inside a step that
goes around as often as its data want counts once, with a "+".

    python benchmarks/gpu_kernels.py [--quick] [--only NAME …] [--out DIR]

It needs JAX's plugin for CUDA, of the version of jaxlib, and NVIDIA's compiler, but no GPU and no driver:

    python -m venv gpu && gpu/bin/pip install jax==V nvidia-cuda-nvcc-cu12
    gpu/bin/pip install --no-deps jax-cuda12-plugin==V jax-cuda12-pjrt==V
    PYTHONPATH=$PWD gpu/bin/python benchmarks/gpu_kernels.py
"""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from lib import command, report

MEMBERS = 10**6
H100 = """
gpu_device_info {
  threads_per_block_limit: 1024 threads_per_warp: 32 threads_per_core_limit: 2048 core_count: 132 fpus_per_core: 128
  shared_memory_per_block: 49152 shared_memory_per_core: 233472 shared_memory_per_block_optin: 232448
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  registers_per_core_limit: 65536 registers_per_block_limit: 65536
  memory_bandwidth: 3352320000000 l2_cache_size: 52428800 device_memory_size: 84942979072 clock_rate_ghz: 1.98
  cuda_compute_capability { major: 9 }
  driver_version: "12.8.0" runtime_version: "12.8.0" compile_time_toolkit_version: "12.8.0"
}
platform_name: "CUDA"
dnn_version_info { major: 9 }
device_description_str: "NVIDIA H100 80GB HBM3"
"""
_LONGEST = 4000  # operations; longer programs take minutes to compile
_FREE = {"parameter", "constant", "get-tuple-element", "tuple", "bitcast", "while", "conditional", "after-all"}


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--only", nargs="+", metavar="NAME")
    options = command.parsed(parser)
    toolkit = _toolkit()
    if toolkit is None or importlib.util.find_spec("jax_plugins.xla_cuda12") is None:
        print("nothing is counted: jax-cuda12-plugin, jax-cuda12-pjrt and nvidia-cuda-nvcc-cu12 are not all installed")
        return
    with tempfile.TemporaryDirectory() as dump:
        flags = f"--xla_gpu_cuda_data_dir={toolkit} --xla_gpu_autotune_level=0 --xla_dump_to={dump}"
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flags}"
        os.environ["PATH"] = f"{toolkit}/bin:{os.environ['PATH']}"
        rows = list(counts(options.quick, options.only, Path(dump)))
    head = [
        "",
        "loop",
        "operations, width, carried",
        "kernels",
        "of counters",
        "bytes a body and step",
        "registers",
        "spilled",
        "compile s",
    ]
    title = f"A count, not a measurement: programs compiled for an H100 without one, {MEMBERS:.0e} members, float64"
    table = report.table(head, [[str(x) for x in row] for row in rows])
    report.publish("gpu_kernels", [title, table], {"head": head, "rows": rows}, options.out)


def _toolkit() -> Path | None:
    """The folder of NVIDIA's compiler, as the package index has it."""
    found = importlib.util.find_spec("nvidia")
    folders = [Path(x) / "cuda_nvcc" for x in (found.submodule_search_locations or [])] if found else []
    return next((x for x in folders if (x / "bin" / "ptxas").is_file()), None)


def counts(quick: bool, only: list[str] | None, dump: Path) -> Iterator[list[Any]]:
    """A row for each step and each kind of loop."""
    import jax

    from lieint_jax.native import flat_step
    from lieint_jax.runs._engine import Engine

    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)
    for name, (step, state, dt) in problems(quick).items():
        if only and not any(part in name for part in only):
            continue
        job = _job(step, state, dt)
        engine = Engine(job, "xla", 1)
        yield [name, "plain", "", *_counted(engine, job, "xla", 1, dump)]
        for together in (1, 4):
            flat = flat_step(engine.intervals(together).loop(*_arguments(job)))
            if isinstance(flat, str):
                yield [name, f"none: {flat}", *[""] * 7]
                break
            if together > 1 and flat.length > _LONGEST:
                continue
            size = f"{flat.length}, {flat.width}, {flat.carried}"
            yield [name, f"flat, {together} an iteration", size, *_counted(engine, job, "flat", together, dump)]


def problems(quick: bool) -> dict[str, Any]:
    """(step, state, dt) by name."""
    import jax.numpy as jnp

    import lieint_jax as li

    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    top = li.systems.heavy_top([1.0, 1.0, 0.5], [0.0, 0.0, 1.0])
    spin, tilt = jnp.array([0.3, 0.2, 1.0]), jnp.array([0.9, 0.4, 0.1, 0.0])
    tilt = tilt / jnp.linalg.norm(tilt)
    of_top = top.state(tilt, angular_velocity=spin)
    found = {
        "so3_midpoint": (li.schemes.so3_midpoint(body), body.state(angular_velocity=spin), 0.05),
        "splitting of a top": (li.schemes.splitting(top), of_top, 0.05),
        "nystrom 6 of a top": (li.schemes.nystrom(top, 6), of_top, 0.05),
    }
    if not quick:
        found |= {
            "preprocessed 10": (li.schemes.preprocessed(body, 10), body.state(angular_velocity=spin), 0.05),
            "exact": (li.schemes.exact(body), body.state(angular_velocity=spin), 0.05),
            "extrapolate of a top": (li.schemes.extrapolate(top), of_top, 0.05),
            "gauss of a top": (li.schemes.gauss(top), of_top, 0.05),
        }
    return found


def _job(step: Any, state: Any, dt: float) -> Any:
    """The job of a run whose members all begin in one state."""
    import jax
    import jax.numpy as jnp

    from lieint_jax.runs import _make_job
    from lieint_jax.runs._job import Job
    from lieint_jax.types import checked_step, promoted

    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (2, *jnp.shape(x))), step.start(state))
    step, states, dtype = promoted(checked_step(step), states)
    states, t0 = _make_job._split_time(step, states)
    clock, planned_steps = _make_job._make_clock(step, states, t0, dtype, dt, 100, None)
    return Job(
        step,
        states,
        t0,
        dt,
        clock,
        planned_steps,
        *_make_job._entries_by_count(clock, planned_steps, None, dtype),
        None,
        None,
    )


def _arguments(job: Any, sharding: Any = None) -> tuple[Any, ...]:
    """The shapes of the arguments of a loop over one save interval of all members."""
    import jax
    import numpy as np

    from lieint_jax.runs import _loop

    def shape(x: Any, *lead: int) -> Any:
        return jax.ShapeDtypeStruct((*lead, *np.shape(x)), jax.numpy.result_type(x), sharding=sharding)

    def of_members(tree: Any) -> Any:
        return jax.tree.map(lambda x: shape(x[0], MEMBERS), tree)

    def shared(tree: Any, *lead: int) -> Any:
        return jax.tree.map(lambda x: shape(x, *lead), tree)

    zero = np.zeros((), _loop.step_dtype())
    return (
        of_members(_loop.start(job.states, None)),
        shared(_loop.Given(job.step, None, job.t0, job.clock, None)),
        shared(_loop.Span(zero, zero, None, np.bool_(True)), 1),
        shared(np.zeros((), np.int32)),
    )


def _counted(engine: Any, job: Any, name: str, together: int, dump: Path) -> list[Any]:
    """Kernels and bytes of a step, the most registers and spilled bytes, and seconds of compilation."""
    from jax.experimental import topologies
    from jax.sharding import SingleDeviceSharding

    from lieint_jax.ensemble import compiler_options
    from lieint_jax.native import computed_by

    topology = topologies.get_topology_desc(platform="cuda", target_config=H100, topology="1 x 1 x 1")
    arguments = _arguments(job, SingleDeviceSharding(topology.devices[0]))
    before = set(dump.iterdir())
    start = time.perf_counter()
    with computed_by(name, 1):
        lowered = engine.intervals(together).traced(*arguments).lower(lowering_platforms=("cuda",))
    text = lowered.compile(compiler_options("gpu")).as_text()
    seconds = time.perf_counter() - start
    assert text is not None  # a compiled program has one
    program = Program(text)
    body, condition = program.loop_over_steps()
    unknown = "+" if program.data_dependent(body) else ""
    large, all_ = (program.kernels(body, least) + program.kernels(condition, least) for least in (MEMBERS, 0))
    traffic = program.bytes_of(body) / MEMBERS
    used = _registers([x for x in dump.iterdir() if x.suffix == ".ptx" and x not in before])
    names = {x.replace(".", "_").replace("-", "_") for x in program.names(body)}
    found = [used[x] for x in names if x in used] or [(0, 0)]
    numbers = [round(traffic / together), max(r for r, _ in found), max(n for _, n in found), round(seconds, 1)]
    return [f"{large}{unknown}", f"{all_ - large}{unknown}", *numbers]


class Program:
    """XLA's text of a compiled program, as lists of instructions by the names of computations."""

    def __init__(self, text: str):
        self.computations: dict[str, list[tuple[str, str, str]]] = {}
        self.shapes: dict[str, str] = {}
        lines: list[tuple[str, str, str]] = []
        for line in text.splitlines():
            head = re.match(r"(?:ENTRY )?%?([\w.\-]+) \(.*\{$", line)
            if head:
                lines = self.computations[head[1]] = []
                self.entry = head[1] if line.startswith("ENTRY") else getattr(self, "entry", "")
            found = re.match(r"\s+(?:ROOT )?%?([\w.\-]+) = (.*?) ([\w\-]+)\((.*)$", line)
            if found:
                lines.append((found[1], found[3], found[4]))
                self.shapes[found[1]] = found[2]

    def loop_over_steps(self) -> tuple[str, str]:
        """The body and the condition of the first loop that is inside the loop over save intervals."""
        outer, _ = self.whiles(self.entry)[0]
        return self.whiles(outer)[0]

    def whiles(self, name: str) -> list[tuple[str, str]]:
        """The bodies and the conditions of the loops of a computation."""
        rest = [rest for _, op, rest in self.computations[name] if op == "while"]
        return [(_called(x, "body"), _called(x, "condition")) for x in rest]

    def kernels(self, name: str, least: int) -> int:
        """The kernels and copies of a computation that read or write arrays of `least` bytes."""
        own = sum(size >= least for _, size in self._sizes(name))
        return own + self._over_inner(name, lambda x: self.kernels(x, least))

    def bytes_of(self, name: str) -> int:
        """The bytes that its kernels and copies read and write."""
        return sum(size for _, size in self._sizes(name)) + self._over_inner(name, self.bytes_of)

    def _sizes(self, name: str) -> Iterator[tuple[str, int]]:
        """The names of a computation's own kernels and copies, and the bytes that each reads and writes."""
        for result, op, rest in self.computations[name]:
            if op not in _FREE:
                operands = re.findall(r"%([\w.\-]+)", rest.split("), ")[0])
                yield result, sum(_bytes(self.shapes.get(x, "")) for x in (result, *operands))

    def _over_inner(self, name: str, measure: Callable[[str], int]) -> int:
        total = 0
        for _, op, rest in self.computations[name]:
            if op == "while":
                total += _count(rest) * sum(measure(_called(rest, key)) for key in ("body", "condition"))
            elif op == "conditional":
                total += max(measure(x) for x in _branches(rest))
        return total

    def data_dependent(self, name: str) -> bool:
        """Whether it has a loop that goes around as often as its data want."""
        loops = [rest for _, op, rest in self.computations[name] if op == "while"]
        return any("known_trip_count" not in x or self.data_dependent(_called(x, "body")) for x in loops)

    def names(self, name: str) -> set[str]:
        """The names of its kernels."""
        found = {x for x, _ in self._sizes(name)}
        for _, op, rest in self.computations[name]:
            inner = [_called(rest, "body"), _called(rest, "condition")] if op == "while" else []
            for x in [*inner, *(_branches(rest) if op == "conditional" else [])]:
                found |= self.names(x)
        return found


def _called(rest: str, key: str) -> str:
    found = re.search(rf"{key}=%?([\w.\-]+)", rest)
    assert found, rest
    return found[1]


def _branches(rest: str) -> list[str]:
    listed = re.search(r"branch_computations=\{(.*?)\}", rest)
    if listed:
        return [x.strip().lstrip("%") for x in listed[1].split(",")]
    return [_called(rest, "true_computation"), _called(rest, "false_computation")]


def _count(rest: str) -> int:
    """How often a loop goes around; 1 if that is not known."""
    found = re.search(r'known_trip_count":\{"n":"(\d+)"', rest)
    return int(found[1]) if found else 1


def _bytes(shape: str) -> int:
    """The bytes of a shape in XLA's words, of a tuple all of them."""
    sizes = {"pred": 1, "s8": 1, "u8": 1}
    total = 0
    for kind, axes in re.findall(r"(pred|[a-z]+\d+)\[([\d,]*)\]", shape):
        entries = 1
        for n in filter(None, axes.split(",")):
            entries *= int(n)
        total += entries * sizes.get(kind, int(re.sub(r"\D", "", kind) or 8) // 8)
    return total


def _registers(files: list[Path]) -> dict[str, tuple[int, int]]:
    """Registers, and bytes spilled, of a thread of each kernel, by NVIDIA's assembler."""
    found: dict[str, tuple[int, int]] = {}
    for file in files:
        target = re.search(r"\.target (\w+)", file.read_text())
        assert target
        run = subprocess.run(
            ["ptxas", "-v", f"-arch={target[1]}", str(file), "-o", os.devnull],
            capture_output=True,
            text=True,
            check=True,
        )
        blocks = re.split(r"Compiling entry function '", run.stderr)[1:]
        for block in blocks:
            spills, used = re.search(r"(\d+) bytes spill stores", block), re.search(r"Used (\d+) registers", block)
            assert spills
            assert used
            found[block.split("'")[0]] = int(used[1]), int(spills[1])
    return found


if __name__ == "__main__":
    main()
