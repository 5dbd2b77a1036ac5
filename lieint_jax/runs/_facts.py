"""What is known of a run beside its numbers, what it is in a few lines of text, and the functions of its states."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from lieint_jax import dates
from lieint_jax._checks import concrete
from lieint_jax._version import __version__
from lieint_jax._xla import remembered, rereading_jit
from lieint_jax.core import State, Step, Trajectory, leaves_by_name
from lieint_jax.runs._plan import Plan, list_members
from lieint_jax.runs._storage.leaves import Table
from lieint_jax.runs._summary import MemberSummary

_version = cache(version)  # which reads a file
_SHOWN = ("lieint_jax", "jax")  # packages whose versions are listed
_SECONDS = {"1": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "day": 86400.0}  # of units of time


class Facts(NamedTuple):
    """What is known of a run beside its numbers.

    Attributes:
        batch: whether it has a member axis.
        own_step: whether each member has a step of its own; then the step's leaves have the member axis, too.
        dt: the step size; None if times were given.
        num_steps: the number of steps that were asked for.
        save_every: the number of steps between saves; None if output times were given.
        engine: what computed it, "native" (machine code), "kernel" (of a GPU) or "xla"; "" if that is not known.
        versions: the versions of packages that computed it, by name.
        complete: whether it has reached its last step.
        source: the path or URL of the store from which its arrays are read; "" if they are in memory.
        epoch: the date of t = 0, as text; "" if it was not given.
        time_unit: the unit of t in the store; "1" if it was not given.
    """

    batch: bool
    own_step: bool
    dt: float | None
    num_steps: int
    save_every: int | None
    engine: str
    versions: tuple[tuple[str, str], ...]
    complete: bool = True
    source: str = ""
    epoch: str = ""
    time_unit: str = "1"

    @classmethod
    def of_plan(cls, plan: Plan, engine: str) -> Facts:
        """Those of a run in memory that this engine has computed."""
        return cls(
            batch=plan.batch,
            own_step=plan.own_step,
            dt=plan.dt,
            num_steps=plan.planned_steps,
            save_every=plan.save_every,
            engine=engine,
            versions=tuple(package_versions().items()),
            epoch=plan.epoch,
        )

    @classmethod
    def of_store(cls, path: str, attributes: Table) -> Facts:
        """Those of the run in the store at `path`, from its attributes."""
        described = attributes["run"]
        return cls(
            batch=attributes["batch"],
            own_step=described["own_step"],
            dt=attributes["dt"],
            num_steps=described["num_steps"],
            save_every=attributes["save_every"],
            engine=described["engine"],
            versions=tuple(described["versions"].items()),
            complete=attributes["progress"]["complete"],
            source=path,
            epoch=described["epoch"] or "",
            time_unit=attributes["time_unit"],
        )


def dates_of(facts: Facts, start: dates.Epoch, saved: Trajectory) -> np.ndarray:
    """The dates of the saves, (times,), or (times, members) of members that have their own times."""
    unit = _SECONDS.get(facts.time_unit)
    if unit is None:
        raise ValueError(f"dates need the time in seconds, minutes, hours or days, got {facts.time_unit!r}")
    t, own = np.asarray(saved.t), saved.state.t
    shared = own is None or bool(np.all(own == t.reshape(-1, *[1] * (np.ndim(own) - 1))))
    return start.datetimes(unit * (t if shared else np.asarray(own)))


def package_versions() -> dict[str, str]:
    """The versions of the packages that compute a run, by name."""
    own = {"lieint_jax": __version__, "jax": jax.__version__, "jaxlib": _version("jaxlib")}
    return own | {"numpy": np.__version__}


def lines(run: Any) -> dict[str, str]:
    """What a run is, by words for a table."""
    facts = run.facts
    shown = {"step": f"{run.step.name} of {type(run.system).__name__}{' (one for each member)' * run.own_step}"}
    if not concrete(run.failed, run.t) or np.ndim(run.t) != 1:
        return shown | {"values": "traced"}
    if run.members is not None:
        shown["members"] = f"{run.members}"
    sizes = "given times; " if facts.dt is None else f"{facts.num_steps} steps of {facts.dt:g}; "
    shown["times"] = f"{float(run.t[0]):.6g} … {float(run.t[-1]):.6g}, {sizes if facts.engine else ''}{_saves(run)}"
    if facts.epoch:
        shown["epoch"] = f"{facts.epoch} at t = 0"
    state = run.state if run.summary is None else run.summary.state
    leading = (1 if run.summary is None else 0) + facts.batch
    shapes = {name: np.shape(x)[leading:] for name, x in leaves_by_name(state).items()}
    shown["states"] = ", ".join(f"{name} {shape}" if shape else name for name, shape in shapes.items())
    failed = np.atleast_1d(np.asarray(run.failed))
    bad = np.flatnonzero(failed >= 0)
    shown["converged"] = "all"
    if bad.size:
        first = bad[failed[bad].argmin()]
        shown["converged"] = f"not {list_members(bad)}; first member {first} at step {failed[first]}"
    versions = ", ".join(f"{name} {version}" for name, version in facts.versions if name in _SHOWN)
    if facts.engine:
        shown["computed"] = f"by {facts.engine}, {versions}{'' if facts.complete else '; not complete'}"
    if facts.source:
        shown["store"] = facts.source
    return shown


def _saves(run: Any) -> str:
    if isinstance(run.summary, MemberSummary):
        return "the quantity of each member over all steps"
    if not run.facts.engine:
        return f"{len(run.t)} saves"
    every = run.facts.save_every
    how = "at given times" if every is None else "one per step" if every == 1 else f"one per {every} steps"
    what = "saves" if run.summary is None else "entries of changes over all members"
    return f"{len(run.t)} {what}, {how}"


@remembered(16)
def compile_map(structure: Any, batch: bool, own_step: bool) -> Callable[..., Any]:
    """A function of step and state of this structure, compiled for all states of a run."""

    def map_states(numbers: list[Array], step: Step, states: State) -> Any:
        function: Any = jax.tree.unflatten(structure, numbers)
        if batch:
            function = jax.vmap(function, (0 if own_step else None, 0))
        return jax.vmap(function, (None, 0))(step, states)

    return rereading_jit(map_states)


def momentum(step: Step, state: State) -> Array:
    """The momentum map of a step's system."""
    return step.system.momentum(state)


def defect(step: Step, state: State) -> Array:
    """How far a state is off the phase space of a step's system."""
    return step.system.phase_space.defect(state)


def periods(step: Any, state: State) -> Any:
    """The periods of a tumbling body."""
    body = step.system
    if not hasattr(body, "periods"):
        raise ValueError(f"the system of the run must have periods, as bodies on T*SO(3) do; got {body!r}")
    return body.periods(state)


def from_start(series: Array) -> Array:
    """The changes of a series since its first entry."""
    return series - series[:1]


def plain(function: Any) -> Any:
    """A function as it was given, without the pytree that has no leaves."""
    partial = isinstance(function, jax.tree_util.Partial) and not (function.args or function.keywords)
    return function.func if partial else function
