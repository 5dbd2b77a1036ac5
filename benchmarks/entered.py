"""How many files and functions of the package a call enters: what a reader must open to follow it.

    python benchmarks/entered.py

Each call is made in a process of its own, the first time and again. Counted by `sys.setprofile`; bodies of classes, of
modules that the first call imports, are no functions. Those in parentheses are of the compiler, `native`, in whose
place other packages have XLA's, in C++. `python benchmarks/entered.py "CALL"` lists the functions of the first call by
file, such as those of "li.run(step, many, 0.05, 40, progress=False)".
"""

import subprocess
import sys
from pathlib import Path

SETUP = """
import contextlib, inspect, io, os, sys, tempfile, threading
from pathlib import Path
import jax
import lieint_jax as li
jax.config.update("jax_enable_x64", True)
body = li.systems.rigid_body([1.0, 2.0, 3.0])
step = li.schemes.so3_midpoint(body)
one = body.state(angular_velocity=[0.2, 0.0, 1.0])
many = jax.tree.map(lambda x: jax.numpy.stack([x] * 4), one)
folder = tempfile.TemporaryDirectory()
root, entered, names = str(Path(li.__file__).parent), set(), iter("ab")
def watch(frame, event, _):
    code = frame.f_code
    function = code.co_flags & inspect.CO_OPTIMIZED and not code.co_name.startswith("<")
    if event == "call" and function and code.co_filename.startswith(root):
        entered.add((code.co_filename, code.co_qualname))
def count(call):
    entered.clear()
    threading.setprofile(watch)
    sys.setprofile(watch)
    call()
    sys.setprofile(None)
    threading.setprofile(None)
    own = sum(file.startswith(os.path.join(root, "native")) for file, _ in entered)
    print(len({file for file, _ in entered}), len(entered), own)
def command(*arguments):
    from lieint_jax.command import cli
    os.chdir(folder.name)
    with contextlib.redirect_stdout(io.StringIO()):
        cli.main(arguments)
"""
CALLS = {
    "`integrate`": "li.integrate(step, one, 0.05, 40)",
    "`run` in memory": "li.run(step, many, 0.05, 40, progress=False)",
    "`run` into a store": "li.run(step, many, 0.05, 40, progress=False, store=f'{folder.name}/{next(names)}.zarr')",
    "`lieint run toutatis`": "command('run', 'toutatis', '--members', '3', '--steps', '4800')",
}


def output(*lines: str) -> list[str]:
    """What these lines print in a process of their own."""
    code = "\n".join([SETUP, *lines])
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.splitlines()


def counts(call: str) -> list[list[int]]:
    """The numbers of files, of functions, and of these of the compiler that a call enters, first and again."""
    return [list(map(int, line.split())) for line in output(*[f"count(lambda: {call})"] * 2)]


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(
            *output(f"count(lambda: {sys.argv[1]})", "for f, n in sorted(entered): print(f[len(root) + 1:], n)"),
            sep="\n",
        )
        raise SystemExit
    print(f"Of {len(list((Path(__file__).parents[1] / 'lieint_jax').rglob('*.py')))} files:\n")
    print("| call | files, first | functions, first | files, again | functions, again |\n|---|---|---|---|---|")
    for name, call in CALLS.items():
        (a, b, n), (c, d, m) = counts(call)
        print(f"| {name} | {a} | {b} ({n}) | {c} | {d} ({m}) |")
