"""The command `check`: certificates of every example of every system, by every scheme that takes it."""

from __future__ import annotations

import difflib
import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import jax

from lieint_jax import _discover, schemes, systems
from lieint_jax.command import by_group
from lieint_jax.command.compilation import keep_programs
from lieint_jax.diagnostics import certify

# Each program runs once, so what counts is how soon it is compiled: XLA's older emitters take a third of the time
_QUICK: dict[str, str | bool] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": "1",
    "xla_backend_optimization_level": "0",
}


class _Task(NamedTuple):
    """One scheme for the examples of a module of systems: they share the compiled programs."""

    system: str
    examples: tuple[str, ...]
    scheme: str
    step: str
    num_steps: int


def check(system: str, scheme: str, num_steps: int | None) -> None:
    """Print the certificates of every example of every system with every scheme that takes it, or those of a group."""
    if system == "groups":
        for line in by_group.table():
            print(line, flush=True)
        return
    group = by_group.named(system)
    if group is not None:
        print(by_group.certificates(group, scheme, num_steps))
        return
    tasks = _tasks(system, scheme, num_steps or 1000)
    if not tasks:
        raise ValueError(_nothing(system, scheme))
    for text in _measured(tasks):
        print(text, flush=True)


def _nothing(system: str, scheme: str) -> str:
    """The message where there is nothing to check."""
    steps = dict.fromkeys(task.step for task in _tasks(system, "", 1))
    if steps:
        whole = f"lieint check {system}".strip()
        return f"no scheme with {scheme!r} in its name takes this system; {whole} checks all: {', '.join(steps)}"
    known = [f"{name} ({', '.join(module.examples())})" for name, module in _discover.modules(systems).items()]
    names = [x for name, module in _discover.modules(systems).items() for x in (name, *module.examples())]
    near = difflib.get_close_matches(system, [*names, *by_group.catalogue()], 1, 0.5)
    meant = f", did you mean {near[0]}?" if near else ";"
    return (
        f"no system {system!r}{meant} there are {'; '.join(known)}; and the groups {', '.join(by_group.catalogue())}. "
        "Type, for example, lieint check rigid_body"
    )


def _tasks(system: str, scheme: str, num_steps: int) -> list[_Task]:
    tasks: dict[tuple[str, str, str], list[str]] = {}
    modules = _discover.modules(systems)
    named = system.partition(".")[0]
    for system_name, module in ({named: modules[named]} if named in modules else modules).items():
        for example, (body, *_) in module.examples().items():
            if system not in ("", system_name, example, f"{system_name}.{example}"):
                continue
            for scheme_name, scheme_module in _discover.modules(schemes).items():
                for step in scheme_module.examples(body):
                    if scheme in step:
                        tasks.setdefault((system_name, scheme_name, step), []).append(example)
    return [_Task(name, tuple(found), which, step, num_steps) for (name, which, step), found in tasks.items()]


def _measured(tasks: list[_Task]) -> Iterator[str]:
    """The certificates, in the order of the tasks; a process a core, and a progress bar on a terminal."""
    from tqdm import tqdm

    processes = min(os.cpu_count() or 1, len(tasks))
    if processes == 1:
        yield from map(_certificates, tasks)
        return
    bar = tqdm(total=len(tasks), unit=" schemes", disable=None, leave=False, dynamic_ncols=True)
    with bar, _flags(), multiprocessing.get_context("spawn").Pool(processes, _start) as pool:
        for text in pool.imap(_certificates, tasks):
            bar.clear()
            yield text
            bar.update()


def _certificates(task: _Task) -> str:
    module = _discover.modules(systems)[task.system]
    scheme, lines = _discover.modules(schemes)[task.scheme], []
    for name, (body, state, dt) in module.examples().items():
        if name in task.examples:
            step = scheme.examples(body)[task.step]
            lines.append(f"{task.system}.{name}\n{certify(step, step.start(state), dt, task.num_steps)}\n")
    jax.clear_caches()  # or memory grows with every scheme
    return "\n".join(lines)


def _start() -> None:
    """Begin a process of the pool as the command line begins; Ctrl-C is for the process that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    jax.config.update("jax_enable_x64", True)
    keep_programs()


@contextmanager
def _flags() -> Iterator[None]:
    """Processes started in this context compile quickly, by the flags that this XLA has."""
    before = os.environ.get("XLA_FLAGS")
    flags = [f"--{name}={str(value).lower()}" for name, value in _QUICK.items() if _known(name, value)]
    os.environ["XLA_FLAGS"] = " ".join([before or "", *flags]).strip()
    try:
        yield
    finally:
        os.environ.pop("XLA_FLAGS")
        if before is not None:
            os.environ["XLA_FLAGS"] = before


def _known(name: str, value: str | bool) -> bool:
    """Whether XLA has a flag; as an option of one program, an unknown one is an error and does not end the process."""
    try:
        jax.jit(lambda x: x).lower(0.0).compile(compiler_options={name: value})
    except jax.errors.JaxRuntimeError:
        return False
    return True
