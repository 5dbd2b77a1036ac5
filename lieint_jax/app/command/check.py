"""The command `check`: certificates of the examples of systems, by every scheme that takes them."""

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
from lieint_jax.app.command import check_groups
from lieint_jax.app.command.compilation import keep_programs
from lieint_jax.diagnostics import certify
from lieint_jax.ensemble import count_cores

# Each program runs once, so what counts is how soon it is compiled: XLA's older emitters take a third of the time
_QUICK: dict[str, str | bool] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": "1",
    "xla_backend_optimization_level": "0",
}


class _Task(NamedTuple):
    """The examples of a module of systems by the steps of a module of schemes: they share the compiled programs.

    Attributes:
        system, scheme: names of the modules.
        example: the only example; all if empty.
        wanted: what the names of the steps must contain.
        brief: of the examples, only the first that the scheme takes.
        num_steps: length of a run.
    """

    system: str
    scheme: str
    example: str
    wanted: str
    brief: bool
    num_steps: int


class _Found(NamedTuple):
    """The names of all the steps that take the examples of a task, and the certificates of those wanted, as text."""

    steps: list[str]
    text: str


def check(system: str, scheme: str, num_steps: int | None, every: bool = False) -> None:
    """Print the certificates of the examples of a system with every scheme that takes them, or those of a group.

    Without a name, of each system the first example that the scheme takes, or with `every` all.
    """
    if system == "groups":
        for line in check_groups.table():
            print(line, flush=True)
        return
    group = check_groups.find_group(system)
    if group is not None:
        print(check_groups.certificates(group, scheme, num_steps))
        return
    named, example = _place(system)
    brief = not (system or every)
    tasks = [
        _Task(x, y, example, scheme, brief, num_steps or 1000)
        for x in named
        for y in _discover.modules_with_examples(schemes)
    ]
    steps, printed = [], False
    for found in _measured(tasks):
        steps += found.steps
        if found.text:
            print(found.text, flush=True)
            printed = True
    if not printed:
        whole, names = f"lieint check {system}".strip(), ", ".join(dict.fromkeys(steps))
        raise ValueError(f"no scheme with {scheme!r} in its name takes this system; {whole} checks all: {names}")
    if brief:
        print("One example of each system. All of a system: lieint check SYSTEM. All of all: lieint check --all")


def _place(system: str) -> tuple[list[str], str]:
    """The modules that hold a system, and the example if it is one; ValueError, which says what there is."""
    modules = _discover.modules_with_examples(systems)
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
        f"no system {system!r}{meant} there are {'; '.join(known)}; and the groups "
        f"{', '.join(check_groups.catalogue())}. Type, for example, lieint check rigid_body"
    )


@cache
def _examples(system: str) -> dict[str, Any]:
    return _discover.modules_with_examples(systems)[system].examples()


def _measured(tasks: list[_Task]) -> Iterator[_Found]:
    """The certificates, in the order of the tasks; a process a core, and a progress bar on a terminal."""
    from tqdm import tqdm

    processes = min(count_cores(), len(tasks))
    if processes == 1:
        yield from map(_certificates, tasks)
        return
    bar = tqdm(total=len(tasks), unit=" schemes", disable=None, leave=False, dynamic_ncols=True)
    with bar, _flags(), multiprocessing.get_context("spawn").Pool(processes, _start) as pool:
        for found in pool.imap(_certificates, tasks):
            bar.clear()
            yield found
            bar.update()


def _certificates(task: _Task) -> _Found:
    scheme, uses = _discover.modules_with_examples(schemes)[task.scheme], {}
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
        jax.clear_caches()  # or memory grows with every scheme
    return _Found(list(uses), "\n".join(lines))


def _start() -> None:
    """Begin a process of the pool as the command line begins; Ctrl-C is for the process that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    jax.config.update("jax_enable_x64", True)
    keep_programs()


@contextmanager
def _flags() -> Iterator[None]:
    """Processes started in this context compile quickly, by the flags that this XLA has."""
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
    """Whether XLA has a flag; as an option of one program, an unknown one is an error and does not end the process."""
    try:
        jax.jit(lambda x: x).lower(0.0).compile(compiler_options={name: value})
    except jax.errors.JaxRuntimeError:
        return False
    return True
