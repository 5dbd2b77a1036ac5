"""The command `check`: certificates of the example systems, by every scheme that accepts them."""

from __future__ import annotations

import difflib
import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, NamedTuple

import jax

from lieint_jax import _discover, schemes, systems
from lieint_jax._cache import use_program_cache
from lieint_jax.app.command import check_groups
from lieint_jax.app.printer import show
from lieint_jax.diagnostics import certify
from lieint_jax.runs import count_cores

# Each program runs once, so its compilation dominates: with XLA's older emitters it needs a third of the time
_QUICK: dict[str, str | bool] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": "1",
    "xla_backend_optimization_level": "0",
}


class _Task(NamedTuple):
    """The examples of one module of systems by the steps of one module of schemes: they share compiled programs."""

    system: str  # the name of a module of systems
    scheme: str  # that of a module of schemes
    example: str  # the name of the only example to check; all examples if empty
    wanted: str  # text that the names of the steps must contain
    brief: bool  # check only the first example that the scheme accepts
    num_steps: int  # the length of a run in steps


class _TaskResult(NamedTuple):
    """The names of all steps that accept the examples of a task, and the certificates of the requested ones as text."""

    steps: list[str]
    text: str


def check(system: str, scheme: str, num_steps: int | None, every: bool = False) -> None:
    """Print the certificates of a system's examples by every scheme that accepts them, or those of a matrix group.

    Without a name, each scheme checks the first example of every system that it accepts; with `every`, all examples.
    """
    if system == "groups":
        for line in check_groups.table():
            show(line)
        return
    group = check_groups.find_group(system)
    if group is not None:
        show(check_groups.certificates(group, scheme, num_steps))
        return
    named, example = _find_modules(system)
    brief = not (system or every)
    tasks = [
        _Task(x, y, example, scheme, brief, num_steps or 1000)
        for x in named
        for y in _discover.modules_with("examples", schemes)
    ]
    steps, printed = [], False
    for found in _run_tasks(tasks):
        steps += found.steps
        if found.text:
            show(found.text)
            printed = True
    if not printed:
        whole, names = f"lieint check {system}".strip(), ", ".join(dict.fromkeys(steps))
        raise ValueError(f"no scheme with {scheme!r} in its name accepts this system; {whole} checks all: {names}")
    if brief:
        show("One example of each system was checked. For all examples: lieint check SYSTEM, or lieint check --all")


def _find_modules(system: str) -> tuple[list[str], str]:
    """The modules that hold a system, and the example that it names, if any.

    Raises:
        ValueError: no system has this name; the message lists the existing ones.
    """
    modules = _discover.modules_with("examples", systems)
    if not system:
        return list(modules), ""
    name, _, example = system.partition(".")
    name = {"pseudo_rigid": "pseudo_rigid_body"}.get(name, name)  # as in version 0.2
    if name in modules and (not example or example in _examples(name)):
        return [name], example
    holders = [x for x in modules if system in _examples(x)]
    if holders:
        return holders, system
    known = [f"{x} ({', '.join(_examples(x))})" for x in modules]
    names = [y for x in modules for y in (x, *_examples(x))]
    near = difflib.get_close_matches(system, [*names, *check_groups.catalogue()], 1, 0.5)
    meant = f", did you mean {near[0]}?" if near else ";"
    raise ValueError(
        f"no system {system!r}{meant} the systems, with their examples, are {'; '.join(known)}; the groups are "
        f"{', '.join(check_groups.catalogue())}. Type, for example, lieint check rigid_body"
    )


@cache
def _examples(system: str) -> dict[str, Any]:
    return _discover.modules_with("examples", systems)[system].examples()


def _run_tasks(tasks: list[_Task]) -> Iterator[_TaskResult]:
    """Run the tasks in one process per core, with a progress bar on a terminal; the results in the tasks' order."""
    from tqdm import tqdm

    processes = min(count_cores(), len(tasks))
    if processes == 1:
        yield from map(_certificates, tasks)
        return
    bar = tqdm(total=len(tasks), unit=" schemes", disable=None, leave=False, dynamic_ncols=True)
    with bar, _quick_compilation(), multiprocessing.get_context("spawn").Pool(processes, _start_worker) as pool:
        for found in pool.imap(_certificates, tasks):
            bar.clear()
            yield found
            bar.update()


def _certificates(task: _Task) -> _TaskResult:
    scheme, uses = _discover.modules_with("examples", schemes)[task.scheme], {}
    for name, (body, state, dt) in _examples(task.system).items():
        if task.example in ("", name) and not (task.brief and uses):
            for label, step in scheme.examples(body).items():
                uses.setdefault(label, []).append((name, step, state, dt))
    lines = [
        f"{task.system}.{name}\n{certify(step, step.start(state), dt, task.num_steps)}\n"
        for label, those in uses.items()
        for name, step, state, dt in (those if task.wanted in label else ())
    ]
    if lines:
        jax.clear_caches()  # otherwise memory grows with every scheme
    return _TaskResult(list(uses), "\n".join(lines))


def _start_worker() -> None:
    """Set up a process of the pool as the command line does; the parent process handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    jax.config.update("jax_enable_x64", True)
    use_program_cache()


@contextmanager
def _quick_compilation() -> Iterator[None]:
    """Let processes started in this context compile quickly, by the flags in `_QUICK` that this XLA has."""
    before = os.environ.get("XLA_FLAGS")
    flags = [f"--{name}={str(value).lower()}" for name, value in _QUICK.items() if _xla_has_flag(name, value)]
    os.environ["XLA_FLAGS"] = " ".join([before or "", *flags]).strip()
    try:
        yield
    finally:
        os.environ.pop("XLA_FLAGS")
        if before is not None:
            os.environ["XLA_FLAGS"] = before


def _xla_has_flag(name: str, value: str | bool) -> bool:
    """Whether XLA has a flag: as an option of one program, an unknown flag raises, and does not end the process."""
    try:
        jax.jit(lambda x: x).lower(0.0).compile(compiler_options={name: value})
    except jax.errors.JaxRuntimeError:
        return False
    return True


def check_published() -> None:
    """Run every case, and print its source, the scheme, and the largest difference in each quantity."""
    from lieint_jax.app.published import cases  # files that no other check needs

    for case in cases():
        show(f"{case.code}\n  source     {case.source}\n  scheme     {case.scheme}")
        for found in case.compare():
            digits = f", printed to {found.digits:.0e}" if found.digits else ""
            show(f"  {found.quantity:<42} differs by {found.difference:.1e}{digits}")
        show(f"  limited by {case.limit}\n")
