"""`ensemble.run`: the loop on the host, results in memory, and the report of members that failed."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jax.sharding import Mesh

from lieint_jax import _checks
from lieint_jax.ensemble import _layout, _loop, processes
from lieint_jax.ensemble._job import Job, Output, Summary, first_entry, gathered_rows, reduced
from lieint_jax.ensemble._layout import Layout
from lieint_jax.ensemble._loop import Carry, Reduction, energy
from lieint_jax.ensemble._progress import Bar, Interrupts, Pace
from lieint_jax.ensemble._recording import StoreOptions, into_store
from lieint_jax.integrate import intervals
from lieint_jax.types import State, Step, Trajectory, checked_step, promoted

_NAMED = 5  # the most failed members that a report names


def run(
    step: Step,
    states: State,
    dt: float,
    num_steps: int,
    save_every: int | None = None,
    step_axis: int | None = None,
    reduce: Reduction | Literal["energy"] | None = None,
    mesh: Mesh | None = None,
    store: str | Path | StoreOptions | None = None,
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
        reduce: a quantity, "energy" or a function (step, state) ↦ scalar. No states are kept on the way; instead, for
            each save interval, the least, greatest and mean change of the quantity over all steps and members.
        mesh: devices, a `jax.sharding.Mesh` of the one axis "members"; None takes all.
        store: a folder NAME.zarr, or `StoreOptions`, to which results are written during the run; memory then holds no
            more than a chunk of them.
        progress: show a progress bar on stderr, if that is a terminal.
        resume: continue the run in `store` from its last checkpoint; start it if there is no store.

    Returns:
        A `Trajectory` of numpy arrays, axes (time, member, …), the initial states first; with `store`, of Zarr arrays,
        read from disk when they are indexed. With `reduce`, a `Summary`.

    Raises:
        ValueError: bad counts, states off the group or not finite, members whose first step fails, a store that
            exists, or a store to resume that another run wrote.
        KeyboardInterrupt: interrupted; with `store`, after the chunk has been written.
        processes.LostProcess: another process of this run is gone.

    Warns:
        RuntimeWarning: members that fail to converge later, with the first step where each does.
    """
    interval, num_saves = intervals(num_steps, save_every)
    if step_axis not in (None, 0):
        raise ValueError(f"step_axis must be None (one step for all) or 0 (one per member), got {step_axis!r}")
    if reduce is not None and reduce != "energy" and not callable(reduce):
        raise ValueError(f'reduce must be None, "energy" or a function (step, state) ↦ scalar, got {reduce!r}')
    if resume and store is None:
        raise ValueError("resume goes on with a run in a store; give store=PATH.zarr")
    mesh = _layout.checked_mesh(mesh)
    step, states, dtype = promoted(checked_step(step), states)
    count = _check(step, states)
    reduction = energy if reduce == "energy" else reduce
    h = np.asarray(_checks.step_size(dt), dtype)
    job = Job(step, states, float(dt), h, interval, num_saves, step_axis, reduction)
    with processes.watched(mesh):
        if store is None:
            layout = _layout.layout_of(mesh, count)
            return _integrate(job, layout, _InMemory(job, layout), progress)
        options = store if isinstance(store, StoreOptions) else StoreOptions(store)
        return into_store(job, mesh, options, resume, lambda layout, out: _integrate(job, layout, out, progress))


def _integrate(job: Job, layout: Layout, output: Output, progress: bool) -> Any:
    """Run a job to its end, append its saved rows to `output`, and return the output's result."""
    loop = CompiledLoop(job, layout, output.buffer_rows, progress)
    carry, done = output.restored() or (None, 0)
    if carry is None:
        carry = loop.start
        loop.check_first_step()
        output.begin(carry)
    pace = Pace(layout)
    with Interrupts(output.defers_interrupts) as interrupts, Bar(progress, job.num_steps, job.members, done) as bar:
        while done < job.num_steps:
            saves, every = _next_portion(job, done, pace.steps, output.free_rows)
            clock = time.perf_counter()
            carry, saved = loop.advance(carry, done, saves, every)
            done += saves * every
            if done % job.save_every == 0:
                output.append(saved, saves)
            bar.update(saves * every)
            loop.watch(carry, bar)
            stop = pace.measure(saves * every, time.perf_counter() - clock, interrupts.requested)
            output.checkpoint(carry, done, pace.seconds, stop)
            if stop and output.can_stop():
                raise KeyboardInterrupt(output.interrupt_message(done, job.num_steps))
        if not job.num_steps:
            output.checkpoint(carry, 0, 0.0, stop=False)
        result = output.result(carry)
    _report(_layout.gather(layout, [c.failed for c in carry]))
    return result


def _next_portion(job: Job, done: int, most: int, free_rows: int) -> tuple[int, int]:
    """The save intervals of the next call, and the steps in each: about `most` steps in all."""
    into = done % job.save_every
    if into or most < job.save_every:  # a part of one interval
        return 1, min(most, job.save_every - into)
    left = (job.num_steps - done) // job.save_every
    return min(most // job.save_every, free_rows, left), job.save_every


class CompiledLoop:
    """The compiled loop of a job; its steps and initial carries are on the devices of a layout, block by block."""

    def __init__(self, job: Job, layout: Layout, buffer_rows: int, progress: bool) -> None:
        self._job, self._layout = job, layout
        axis = job.step_axis
        step = (_layout.replicate if axis is None else _layout.scatter)(layout, job.step)
        states = _layout.scatter(layout, job.states)
        begun = self._map(_loop.start(axis, job.reduction), step, states)
        self.start, self._origin = [carry for carry, _ in begun], [origin for _, origin in begun]
        if type(job.step).prepare is not Step.prepare:  # every member has its own constants
            step, axis = self._map(lambda s, z: _loop.prepare(job.step_axis)(s, z, job.dt), step, states), 0
        self._step = step
        self._advance = _loop.advance(axis, job.reduction, buffer_rows)
        self._energies = None
        if _layout.all_reduce_max(layout.mesh, progress and Bar.visible())[0]:
            self._energies = _loop.energies(axis)
            self._H0 = self._map(self._energies, step, states)

    def _map(self, function: Callable[..., Any], *arguments: list[Any]) -> list[Any]:
        return _layout.map_blocks(self._layout, function, *arguments)

    def advance(self, carry: list[Carry], done: int, saves: int, every: int) -> tuple[list[Carry], list[Any]]:
        """The carries after `saves` times `every` more steps, and the saved rows, a list item per block."""
        portion = _loop.Portion(self._job.dt, done, saves, every, not done % self._job.save_every)
        results = self._map(lambda s, c, o: self._advance(s, c, o, portion), self._step, carry, self._origin)
        return [c for c, _ in results], [rows for _, rows in results]

    def check_first_step(self) -> None:
        """Raise ValueError if the first step of a member fails."""
        if self._job.num_steps:
            after, _ = self.advance(self.start, 0, 1, 1)
            _check_first(_layout.gather(self._layout, [c.failed for c in after]), self._job)

    def watch(self, carry: list[Carry], bar: Bar) -> None:
        """Show the energy error and the failures so far on the progress bar, if it is visible."""
        if self._energies is not None:
            H = self._map(self._energies, self._step, [c.state for c in carry])
            bar.show(*_layout.worst_energy_error(self._layout, self._H0, H, [c.failed for c in carry]))


class _InMemory:
    """Results as numpy arrays."""

    defers_interrupts = False

    def __init__(self, job: Job, layout: Layout) -> None:
        self._job, self._layout, self._entries = job, layout, 0
        self.buffer_rows = self.free_rows = job.buffer_rows(job.members)
        self._series: list[dict[str, np.ndarray]] = []
        self._out: Any = None

    def restored(self) -> None:
        return None

    def begin(self, carry: list[Carry]) -> None:
        if self._job.reduction is not None:
            self._series.append(first_entry(self._job))
            return
        first = _layout.gather(self._layout, [(c.info, c.state) for c in carry])
        self._out = jax.tree.map(lambda x: np.empty((self._job.num_saves + 1, *x.shape), x.dtype), first)
        self._put(jax.tree.map(lambda x: x[None], first))

    def append(self, saved: Any, number: int) -> None:
        rows = gathered_rows(self._layout, saved, number)
        if self._job.reduction is None:
            self._put(rows)
        else:
            self._series.append(reduced(rows, self._job))

    def _put(self, rows: Any) -> None:
        number = len(jax.tree.leaves(rows)[0])
        for target, x in zip(jax.tree.leaves(self._out), jax.tree.leaves(rows), strict=True):
            target[self._entries : self._entries + number] = x
        self._entries += number

    def checkpoint(self, carry: list[Carry], done: int, seconds: float, stop: bool) -> None:
        pass

    def can_stop(self) -> bool:
        return True

    def interrupt_message(self, done: int, num_steps: int) -> str:
        return f"stopped after {done} of {num_steps} steps; a run with a store can be resumed"

    def result(self, carry: list[Carry]) -> Any:
        if self._job.reduction is None:
            info, state = self._out
            return Trajectory(self._job.times, state, info)  # pyright: ignore[reportArgumentType]
        series = {name: np.concatenate([part[name] for part in self._series]) for name in self._series[0]}
        state, failed = _layout.gather(self._layout, [(c.state, c.failed) for c in carry])
        return Summary(self._job.times, **series, state=state, failed=failed)


def _check(step: Step, states: State) -> int:
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(states)]
    if any(len(shape) < 2 for shape in shapes) or len({shape[0] for shape in shapes}) != 1 or not shapes[0][0]:
        raise ValueError(f"states need a leading member axis on every leaf, got shapes {shapes}")
    for name, leaf in (("q", states.q), ("p", states.p)):
        bad = np.flatnonzero(~np.isfinite(np.asarray(leaf)).reshape(shapes[0][0], -1).all(axis=1))
        if bad.size:
            raise ValueError(f"states.{name} must be finite; {_some(bad)} not")
    defect = np.abs(np.asarray(jax.vmap(step.system.phase_space.defect)(states)))
    bad = np.flatnonzero(defect > 2 * _checks.UNIT_TOLERANCE)  # |q|² − 1 is twice the error of |q|
    if bad.size:
        raise ValueError(
            f"states.q is off the configuration space by more than {_checks.UNIT_TOLERANCE:g}: {_some(bad)} "
            f"(worst defect {defect.max():.3g}); make states with system.state(...)"
        )
    return shapes[0][0]


def _check_first(failed: np.ndarray, job: Job) -> None:
    bad = np.flatnonzero(failed >= 0)
    if bad.size:
        one = jax.tree.map(lambda leaf: leaf[bad[0]], job.states)
        step = job.step if job.step_axis is None else jax.tree.map(lambda leaf: leaf[bad[0]], job.step)
        raise ValueError(f"the first step fails for {_some(bad)}. Member {bad[0]}: {step.advice(one, job.dt_given)}")


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
