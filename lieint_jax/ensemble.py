"""Many bodies at once: over devices and processes, with results in memory or on disk, and a report of what failed."""

from __future__ import annotations

import time
import warnings
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jax.sharding import Mesh

from lieint_jax import archive, checks, loop, members, processes
from lieint_jax.archive import Place
from lieint_jax.integrate import intervals, promoted
from lieint_jax.loop import Carry, Reduction, compiler_options, energy
from lieint_jax.members import Layout, first_devices, want_devices
from lieint_jax.progress import Bar, Interrupts, Pace
from lieint_jax.runs import Job, Sink, Summary, first_entry, reduced, rows
from lieint_jax.types import State, Step, Trajectory

__all__ = ["Place", "Summary", "compiler_options", "energy", "first_devices", "run", "want_devices"]

_NAMED = 5  # how many failed members a report names


def run(
    step: Step,
    states: State,
    dt: float,
    num_steps: int,
    save_every: int | None = None,
    step_axis: int | None = None,
    reduce: Reduction | Literal["energy"] | None = None,
    mesh: Mesh | None = None,
    store: str | Path | Place | None = None,
    progress: bool = True,
    resume: bool = False,
) -> Any:
    """Integrate a batch of initial states with one compiled loop.

    The bits of the results depend neither on the number of devices and processes nor on whether the run was resumed.
    With `jax.distributed`, every process calls this with the same arguments and gets the same results.

    Args:
        step: a scheme's step; with `step_axis=0` its leaves carry the member axis too (one inertia per member).
        states: initial states with a leading member axis.
        dt: step size, the same for all.
        num_steps: a multiple of `save_every`.
        save_every: steps between saved states; None keeps the last only.
        step_axis: None or 0.
        reduce: keep no states on the way but, of each save interval, the least, greatest and mean change of a quantity
            over all its steps and members: "energy" or a function (step, state) ↦ scalar.
        mesh: devices, a `jax.sharding.Mesh` of the one axis "members"; None takes all.
        store: write results there as they come, a folder NAME.zarr; memory then holds no more than a chunk of them.
        progress: show a progress bar on stderr, if that is a terminal.
        resume: go on with the run that is in `store`, from the last chunk that is whole; start it if none is there.

    Returns:
        A `Trajectory` of numpy arrays, axes (time, member, …), the initial states first; with `store`, of Zarr arrays,
        which are read where they are indexed. With `reduce`, a `Summary`.

    Raises:
        ValueError: bad counts, states off the group or not finite, members whose very first step fails, a store that
            exists, or one to resume that another run wrote.
        KeyboardInterrupt: interrupted; with `store`, after the chunk has been written.
        processes.LostProcess: another process of this run is gone.

    Warns:
        RuntimeWarning: members that stopped converging later, with the step where each first did.
    """
    interval, num_saves = intervals(num_steps, save_every)
    if step_axis not in (None, 0):
        raise ValueError(f"step_axis must be None (one step for all) or 0 (one per member), got {step_axis!r}")
    if reduce is not None and reduce != "energy" and not callable(reduce):
        raise ValueError(f'reduce must be None, "energy" or a function (step, state) ↦ scalar, got {reduce!r}')
    if resume and store is None:
        raise ValueError("resume goes on with a run in a store; give store=PATH.zarr")
    mesh = members.mesh_of(mesh)
    states, dtype = promoted(step, states)
    count = _check(step, states)
    reduction = energy if reduce == "energy" else reduce
    h = np.asarray(checks.step_size(dt), dtype)
    job = Job(step, states, float(dt), h, interval, num_saves, step_axis, reduction)
    with processes.watched(mesh):
        if store is None:
            layout = members.layout_of(mesh, count)
            return _integrate(job, layout, _Memory(job, layout), progress)
        place = store if isinstance(store, Place) else Place(store)
        return archive.record(job, mesh, place, resume, lambda layout, sink: _integrate(job, layout, sink, progress))


def _integrate(job: Job, layout: Layout, sink: Sink, progress: bool) -> Any:
    """Run a job to its end, giving what it saves to `sink`."""
    axis, mesh, on_all = job.step_axis, layout.mesh, partial(members.on_each, layout)
    step = (members.replicate if axis is None else members.place)(layout, job.step)
    starts = members.place(layout, job.states)
    begun = on_all(loop.start(axis, job.reduction), step, starts)
    begin, origin = [carry for carry, _ in begun], [start for _, start in begun]
    if type(job.step).prepare is not Step.prepare:  # constants of its own for every member
        step, axis = on_all(lambda s, z: loop.prepare(job.step_axis)(s, z, job.dt), step, starts), 0
    advance = loop.advance(axis, job.reduction, sink.rows)
    resumed = sink.resumed()
    if resumed is None:
        if job.num_steps:
            first = on_all(lambda s, c, o: advance(s, c, o, job.dt, 0, 1, 1, True)[0].failed, step, begin, origin)
            _check_first(members.fetch(layout, first), job)
        sink.begin(begin)
    carry, done = resumed or (begin, 0)
    pace = Pace(layout)
    energies = loop.energies(axis) if members.agree(mesh, progress and Bar.visible())[0] else None
    H0 = on_all(energies, step, starts) if energies else []
    with Interrupts(sink.patient) as interrupts, Bar(progress, job.num_steps, job.members, done) as bar:
        while done < job.num_steps:
            into = done % job.save_every
            if into or pace.steps < job.save_every:
                number, every = 1, min(pace.steps, job.save_every - into)
            else:
                left = (job.num_steps - done) // job.save_every
                number, every = min(pace.steps // job.save_every, sink.room, left), job.save_every
            clock = time.perf_counter()
            now = (job.dt, done, number, every, not into)
            results = on_all(lambda s, c, o, now=now: advance(s, c, o, *now), step, carry, origin)
            carry, saved = [c for c, _ in results], [rows for _, rows in results]
            done += number * every
            if done % job.save_every == 0:
                sink.add(saved, number)
            bar.update(number * every)
            if energies:
                H = on_all(energies, step, [c.state for c in carry])
                bar.tell(*members.worst(layout, H0, H, [c.failed for c in carry]))
            stop = pace.measure(number * every, time.perf_counter() - clock, interrupts.asked)
            sink.offer(carry, done, pace.seconds, stop)
            if stop and sink.stopped(done):
                raise KeyboardInterrupt(sink.farewell(done, job.num_steps))
        if not job.num_steps:
            sink.offer(carry, 0, 0.0, stop=False)
        result = sink.end(carry)
    _report(members.fetch(layout, [c.failed for c in carry]))
    return result


class _Memory:
    """Results in arrays of numpy."""

    patient = False

    def __init__(self, job: Job, layout: Layout) -> None:
        self._job, self._layout, self._entries = job, layout, 0
        self.rows = self.room = job.rows(job.members)
        self._series: list[dict[str, np.ndarray]] = []
        self._out: Any = None

    def resumed(self) -> None:
        return None

    def begin(self, carry: list[Carry]) -> None:
        if self._job.reduction is not None:
            self._series.append(first_entry(self._job))
            return
        first = members.fetch(self._layout, [(c.info, c.state) for c in carry])
        self._out = jax.tree.map(lambda x: np.empty((self._job.num_saves + 1, *x.shape), x.dtype), first)
        self._put(jax.tree.map(lambda x: x[None], first))

    def add(self, saved: Any, number: int) -> None:
        fetched = rows(self._layout, saved, number)
        if self._job.reduction is None:
            self._put(fetched)
        else:
            self._series.append(reduced(fetched, self._job))

    def _put(self, rows: Any) -> None:
        number = len(jax.tree.leaves(rows)[0])
        for target, x in zip(jax.tree.leaves(self._out), jax.tree.leaves(rows), strict=True):
            target[self._entries : self._entries + number] = x
        self._entries += number

    def offer(self, carry: list[Carry], done: int, seconds: float, stop: bool) -> None:
        pass

    def stopped(self, done: int) -> bool:
        return True

    def farewell(self, done: int, num_steps: int) -> str:
        return f"stopped after {done} of {num_steps} steps; a run with a store can be resumed"

    def end(self, carry: list[Carry]) -> Any:
        if self._job.reduction is None:
            info, state = self._out
            return Trajectory(self._job.times, state, info)  # pyright: ignore[reportArgumentType]
        series = {name: np.concatenate([part[name] for part in self._series]) for name in self._series[0]}
        state, failed = members.fetch(self._layout, [(c.state, c.failed) for c in carry])
        return Summary(self._job.times, **series, state=state, failed=failed)


def _check(step: Step, states: State) -> int:
    shapes = [np.shape(leaf) for leaf in states]
    if any(len(shape) < 2 for shape in shapes) or len({shape[0] for shape in shapes}) != 1 or not shapes[0][0]:
        raise ValueError(f"states need a leading member axis on every leaf, got shapes {shapes}")
    for leaf, name in zip(states, State._fields, strict=True):
        bad = np.flatnonzero(~np.isfinite(np.asarray(leaf)).reshape(shapes[0][0], -1).all(axis=1))
        if bad.size:
            raise ValueError(f"states.{name} must be finite; {_some(bad)} not")
    defect = np.abs(np.asarray(jax.vmap(step.system.phase_space.defect)(states)))
    bad = np.flatnonzero(defect > 2 * checks.UNIT_TOLERANCE)  # |q|² − 1 is twice the error of |q|
    if bad.size:
        raise ValueError(
            f"states.q is off the configuration space by more than {checks.UNIT_TOLERANCE:g}: {_some(bad)} "
            f"(worst defect {defect.max():.3g}); make states with system.state(...)"
        )
    return shapes[0][0]


def _check_first(failed: np.ndarray, job: Job) -> None:
    bad = np.flatnonzero(failed >= 0)
    if bad.size:
        one = jax.tree.map(lambda leaf: leaf[bad[0]], job.states)
        its = job.step if job.step_axis is None else jax.tree.map(lambda leaf: leaf[bad[0]], job.step)
        raise ValueError(f"the first step fails for {_some(bad)}. Member {bad[0]}: {its.advice(one, job.dt_given)}")


def _report(failed: np.ndarray) -> None:
    bad = np.flatnonzero(failed >= 0)
    if bad.size:
        bad = bad[np.argsort(failed[bad], kind="stable")]
        named = ", ".join(f"member {m} at step {failed[m]}" for m in bad[:_NAMED])
        more = f" and {bad.size - _NAMED} more" if bad.size > _NAMED else ""
        warnings.warn(
            f"{bad.size} of {failed.size} members did not converge at every step: {named}{more}; "
            "their results from there on are not to be trusted (take a smaller dt)",
            RuntimeWarning,
            stacklevel=4,
        )


def _some(which: np.ndarray) -> str:
    more = ", …" if which.size > _NAMED else ""
    return f"{which.size} member(s): {', '.join(map(str, which[:_NAMED]))}{more}"
