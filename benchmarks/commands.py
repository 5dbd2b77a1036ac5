"""How long does a command run, the first time and again, on two cores?

Every example, and the certificates of each system run in processes of their own, pinned to two
cores: first without any compiled program on disk, then with those of the first time. The table has the peak of memory
and the size of what is written too.

    python benchmarks/commands.py [--quick] [--out DIR] [--only NAME …]

Each row is written as soon as it is measured into `lieint_jax/command/costs.csv`, from which `lieint list` and the
commands report how long they take, except with `--quick`. The rows of a measurement that is not complete are in
`commands-so-far.json` in the folder of the results, and the same call measures only the rest; it removes the file.
`--only "run toutatis" "check pendulum"` measures these and writes no report.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from lib import command, report

COSTS = Path(__file__).parents[1] / "lieint_jax" / "command" / "costs.csv"
HEAD = "command,first_s,again_s,memory_gb,disk_mb"
CORES, BAR = 2, 120.0  # a command of default size should take two minutes at most


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="the commands to measure")
    options = command.parsed(parser)
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:CORES])
    names = options.only or (["run pendulum", "run gyro"] if options.quick else command_names())
    so_far = options.out / "commands-so-far.json"
    rows = json.loads(so_far.read_text()) if so_far.exists() and not options.only else []

    def measure_all() -> dict[str, Any]:
        for name in names:
            if name in [r["name"] for r in rows]:
                continue
            rows.append(measured(name))
            if not options.quick and not rows[-1]["failed"]:
                update_costs(rows[-1:])
            if not options.only:
                so_far.parent.mkdir(parents=True, exist_ok=True)
                so_far.write_text(json.dumps(rows))
        return {"rows": rows}

    data = command.under_load(measure_all)
    if options.only:
        print("\n\n".join(render(data)))
    else:
        report.publish("commands", render(data), data, options.out)
        so_far.unlink()


def command_names() -> list[str]:
    """All commands that need no argument but a name."""
    from lieint_jax import _discover, examples, systems

    return [
        *(f"run {name}" for name in _discover.public_modules(examples)),
        *(f"check {name}" for name in _discover.modules_with("examples", systems)),
        "check",
    ]


def measured(name: str) -> dict[str, Any]:
    """Seconds of the first and of the second run, gigabytes, megabytes written, and whether both succeeded."""
    folder = Path(tempfile.mkdtemp())
    try:
        first, memory, failed = _run(name, folder, "first")
        again, more, failed_again = _run(name, folder, "again")
        disk = sum(f.stat().st_size for f in (folder / "first").rglob("*") if f.is_file()) / 1e6
    finally:
        shutil.rmtree(folder)
    peak = max(memory, more)
    print(f"{name}: {first:.1f} s, {again:.1f} s, {peak:.1f} GB, {disk:.1f} MB", file=sys.stderr, flush=True)
    failed = failed or failed_again
    return {"name": name, "first": first, "again": again, "memory": peak, "disk": disk, "failed": failed}


def _run(name: str, folder: Path, turn: str) -> tuple[float, float, bool]:
    where = folder / turn
    where.mkdir()
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache")}
    call = [sys.executable, "-m", "lieint_jax.command.cli", *name.split()]
    begin = time.perf_counter()
    process = subprocess.Popen(call, cwd=where, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    return time.perf_counter() - begin, usage.ru_maxrss / 2**20, status != 0


def render(data: dict[str, Any]) -> list[str]:
    """The table, and the commands that take longer than they should."""
    before, after = data["load"]
    cells = [
        [f"`lieint {r['name']}`", f"{r['first']:.0f}", f"{r['again']:.0f}", f"{r['memory']:.1f}", f"{r['disk']:.1f}"]
        for r in data["rows"]
    ]
    runs = [r for r in data["rows"] if not r["name"].startswith("check")]
    late = ", ".join(f"`{r['name']}`" for r in runs if r["first"] > BAR) or "none"
    failed = ", ".join(f"`{r['name']}`" for r in data["rows"] if r["failed"]) or "none"
    return [
        f"Seconds of each command on {CORES} cores, load {before:.1f} to {after:.1f}",
        report.table(["", "first time, s", "again, s", "memory, GB", "written, MB"], cells),
        f"Examples that take longer than {BAR:.0f} s: {late}. Failed: {failed}.",
    ]


def update_costs(rows: list[dict[str, Any]]) -> None:
    """Replace the rows of these commands in `COSTS`."""
    old = dict(line.split(",", 1) for line in COSTS.read_text(encoding="utf-8").splitlines()[1:])
    new = {r["name"]: f"{r['first']:.0f},{r['again']:.0f},{r['memory']:.1f},{r['disk']:.1f}" for r in rows}
    known = {name: (old | new)[name] for name in command_names() if name in old | new}
    lines = [HEAD, *(f"{name},{numbers}" for name, numbers in known.items())]
    COSTS.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
