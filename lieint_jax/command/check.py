"""The command `check`: certificates of the example systems, by every scheme that accepts them."""

from __future__ import annotations

import difflib
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import product
from typing import Any

import jax
import tyro

from lieint_jax import _discover, schemes, systems
from lieint_jax._cache import use_program_cache
from lieint_jax.command import check_groups, listing
from lieint_jax.command.printer import show
from lieint_jax.diagnostics import certify
from lieint_jax.runs import count_cores

_Modules = tuple[str, str]  # the names of a module of systems, and of one of schemes
_Certificates = tuple[list[str], str]  # the names of all steps that accept these systems; text on the wanted ones


def check(
    system: tyro.conf.Positional[str] = "",
    scheme: str = "",
    steps: int | None = None,
    all: bool = False,  # noqa: A002  the name of the option
    published: bool = False,
) -> None:
    """Measure what each scheme conserves, system by system.

    Without a name, each scheme checks the first example of every system that it accepts; with --all, all examples.

    Args:
        system: a module of systems (such as rigid_body), an example or a group; "groups" makes a table of all groups.
        scheme: check only schemes whose name contains this text.
        steps: the length of a run; by default 1000, and 100 where Ad_q grows.
        all: check every example of every system: many minutes.
        published: recompute published numbers of other codes instead.
    """
    if published:
        if system or scheme or steps or all:
            raise ValueError("--published has its own cases: type lieint check --published without other arguments")
        check_published()
        return
    if all and system:
        raise ValueError(f"--all checks every system: type lieint check --all, or lieint check {system}")
    if steps is not None and steps < 1:
        raise ValueError(f"--steps is the number of steps, at least 1; got {steps}")
    if not scheme and steps is None and not all:
        listing.announce(f"check {system}".strip())
    if system == "groups":
        for line in check_groups.table():
            show(line)
        return
    group = check_groups.find_group(system)
    if group is not None:
        show(check_groups.certificates(group, scheme, steps))
        return
    named, example = _find_modules(system)
    brief = not (system or all)
    work = partial(_certificates, example=example, wanted=scheme, brief=brief, num_steps=steps or 1000)
    known, printed = [], False
    for names, text in _in_processes(work, [*product(named, _discover.modules_with("examples", schemes))]):
        known += names
        if text:
            show(text)
            printed = True
    if not printed:
        whole, names = f"lieint check {system}".strip(), ", ".join(dict.fromkeys(known))
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


def _in_processes(work: Callable[[_Modules], _Certificates], tasks: list[_Modules]) -> Iterator[_Certificates]:
    """Do the work on the tasks in one process per core, with a progress bar on a terminal; the results in order."""
    from tqdm import tqdm

    processes = min(count_cores(), len(tasks))
    if processes == 1:
        yield from map(work, tasks)
        return
    bar = tqdm(total=len(tasks), unit=" schemes", disable=None, leave=False, dynamic_ncols=True)
    with bar, multiprocessing.get_context("spawn").Pool(processes, _start_worker) as pool:
        for found in pool.imap(work, tasks):
            bar.clear()
            yield found
            bar.update()


def _certificates(modules: _Modules, *, example: str, wanted: str, brief: bool, num_steps: int) -> _Certificates:
    """The examples of a module of systems, or the one that is named, by the steps of a module of schemes.

    They share compiled programs. `brief` is to check only the first example that the scheme accepts, `wanted` is text
    that the names of the steps must contain, `num_steps` the length of a run.
    """
    system, scheme, uses = modules[0], _discover.modules_with("examples", schemes)[modules[1]], {}
    for name, (body, state, dt) in _examples(system).items():
        if example in ("", name) and not (brief and uses):
            for label, step in scheme.examples(body).items():
                uses.setdefault(label, []).append((name, step, state, dt))
    lines = [
        f"{system}.{name}\n{certify(step, step.start(state), dt, num_steps)}\n"
        for label, those in uses.items()
        for name, step, state, dt in (those if wanted in label else ())
    ]
    if lines:
        jax.clear_caches()  # otherwise memory grows with every scheme
    return list(uses), "\n".join(lines)


def _start_worker() -> None:
    """Set up a process of the pool as the command line does; the parent process handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    jax.config.update("jax_enable_x64", True)
    use_program_cache()


def check_published() -> None:
    """Run every case, and print its source, the scheme, and the largest difference in each quantity."""
    from lieint_jax.command.published import cases  # files that no other check needs

    for case in cases():
        show(f"{case.code}\n  source     {case.source}\n  scheme     {case.scheme}")
        for found in case.compare():
            digits = f", printed to {found.digits:.0e}" if found.digits else ""
            show(f"  {found.quantity:<42} differs by {found.difference:.1e}{digits}")
        show(f"  limited by {case.limit}\n")
