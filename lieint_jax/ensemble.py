"""Many bodies at once: over devices and processes, with results in memory or on disk, and a report of what failed."""

from __future__ import annotations

import hashlib
import os
import re
import time
import warnings
from collections.abc import Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from lieint_jax import checks, members, processes
from lieint_jax import store as storage
from lieint_jax.integrate import promoted, saves
from lieint_jax.members import (
    Carry,
    Layout,
    Range,
    Reduction,
    compiler_options,
    energy,
    first_devices,
    want_devices,
)
from lieint_jax.progress import Bar, Interrupts, Pace
from lieint_jax.types import State, Step, StepInfo, Trajectory

__all__ = ["Place", "Summary", "compiler_options", "energy", "first_devices", "run", "want_devices"]

_NAMED = 5  # how many failed members a report names
_CHUNK_MEMBERS, _CHUNK_BYTES, _MEMORY = 8192, 2**22, 2**28  # of an array on disk; of all members between two commits
_CHUNK_WORK = 2e8  # body-steps between two commits, if they are saved that often
_PATIENCE = 30.0  # seconds after which a run on disk is made continuable in the middle of a save interval


class Summary(NamedTuple):
    """What `reduce` keeps. Time is the axis of all but the last two; entry 0 is the start.

    Attributes:
        t: times, shape (n+1,).
        least, greatest, mean: of the change of the reduced quantity since the start, over all members and over the
            steps since the entry before.
        residual: the largest, over the same.
        unconverged: of how many members a step did not converge, over the same.
        state: the states at the end, (members, …).
        failed: the first step that did not converge of each member, or −1.
    """

    t: np.ndarray
    least: np.ndarray
    greatest: np.ndarray
    mean: np.ndarray
    residual: np.ndarray
    unconverged: np.ndarray
    state: State
    failed: np.ndarray


class Place(NamedTuple):
    """A store, and what is to be written into it beside the results.

    Attributes:
        path: where, a name that ends in .zarr.
        attributes: such as a scenario; as JSON knows them. A resume with others is refused.
        time_unit: of dt.
    """

    path: str | Path
    attributes: Mapping[str, Any] = {}
    time_unit: str = "1"


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
        step: a scheme's step; with `step_axis=0` its leaves carry the member axis too (one inertia a member).
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
    num_steps = checks.count("num_steps", num_steps, 0)
    interval = max(num_steps, 1) if save_every is None else checks.count("save_every", save_every, 1)
    num_saves = saves(num_steps, interval)
    if step_axis not in (None, 0):
        raise ValueError(f"step_axis must be None (one step for all) or 0 (one a member), got {step_axis!r}")
    if reduce is not None and reduce != "energy" and not callable(reduce):
        raise ValueError(f'reduce must be None, "energy" or a function (step, state) ↦ scalar, got {reduce!r}')
    if resume and store is None:
        raise ValueError("resume goes on with a run in a store; give store=PATH.zarr")
    mesh = members.mesh_of(mesh)
    states, dtype = promoted(step, states)
    count = _check(step, states)
    reduction = energy if reduce == "energy" else reduce
    h = np.asarray(checks.step_size(dt), dtype)
    job = _Job(step, states, float(dt), h, interval, num_saves, step_axis, reduction)
    with processes.watched(mesh):
        if store is None:
            layout = members.layout_of(mesh, count)
            return _integrate(job, layout, _Memory(job, layout), progress)
        place = store if isinstance(store, Place) else Place(store)
        return _on_disk(job, mesh, place, progress, resume)


class _Job(NamedTuple):
    """What is to be integrated. `given` is dt as the caller has it, `dt` an array of the states' dtype."""

    step: Step
    states: State
    given: float
    dt: Any
    interval: int
    num_saves: int
    step_axis: int | None
    reduction: Reduction | None

    @property
    def num_steps(self) -> int:
        return self.interval * self.num_saves

    @property
    def times(self) -> np.ndarray:
        return self.given * self.interval * np.arange(self.num_saves + 1, dtype=self.dt.dtype)

    @property
    def members(self) -> int:
        return self.states.p.shape[0]

    def rows(self, across: int) -> int:
        """How many saves are kept together, for chunks of `across` members."""
        row = max(sum(leaf[0].nbytes for leaf in self.states) + 9, 24)
        enough = min(_CHUNK_BYTES // (across * row), _MEMORY // (self.members * row))
        return int(max(1, min(enough, _CHUNK_WORK // (self.members * self.interval), self.num_saves + 1)))


def _integrate(job: _Job, layout: Layout, sink: _Memory | _Disk, progress: bool) -> Any:
    """Run a job to its end, giving what it saves to `sink`."""
    axis, mesh, on_all = job.step_axis, layout.mesh, partial(members.each, layout)
    step = (members.replicate if axis is None else members.place)(layout, job.step)
    starts = members.place(layout, job.states)
    begun = on_all(members.start(axis, job.reduction), step, starts)
    begin, origin = [carry for carry, _ in begun], [start for _, start in begun]
    if type(job.step).prepare is not Step.prepare:  # constants of its own for every member
        step, axis = on_all(lambda s, z: members.prepare(job.step_axis)(s, z, job.dt), step, starts), 0
    loop = members.advance(axis, job.reduction, sink.rows)
    resumed = sink.resumed()
    if resumed is None:
        if job.num_steps:
            first = on_all(lambda s, c, o: loop(s, c, o, job.dt, 0, 1, 1, True)[0].failed, step, begin, origin)
            _check_first(members.fetch(layout, first), job)
        sink.begin(begin)
    carry, done = resumed or (begin, 0)
    pace = Pace(layout)
    energies = members.energies(axis) if members.agree(mesh, progress and Bar.visible())[0] else None
    H0 = on_all(energies, step, starts) if energies else []
    with Interrupts(sink.patient) as interrupts, Bar(progress, job.num_steps, job.members, done) as bar:
        while done < job.num_steps:
            into = done % job.interval
            if into or pace.steps < job.interval:
                number, every = 1, min(pace.steps, job.interval - into)
            else:
                left = (job.num_steps - done) // job.interval
                number, every = min(pace.steps // job.interval, sink.room, left), job.interval
            clock = time.perf_counter()
            now = (job.dt, done, number, every, not into)
            results = on_all(lambda s, c, o, now=now: loop(s, c, o, *now), step, carry, origin)
            carry, saved = [c for c, _ in results], [rows for _, rows in results]
            done += number * every
            if done % job.interval == 0:
                sink.add(saved, number)
            bar.update(number * every)
            if energies:
                H = on_all(energies, step, [c.state for c in carry])
                bar.tell(*members.worst(layout, H0, H, [c.failed for c in carry]))
            stop = pace.measure(number * every, time.perf_counter() - clock, interrupts.asked)
            sink.offer(carry, done, pace.seconds, stop)
            if stop and sink.stopped(done):
                raise KeyboardInterrupt(sink.farewell(done, job.num_steps))
        result = sink.end(carry)
    _report(members.fetch(layout, [c.failed for c in carry]))
    return result


class _Memory:
    """Results in arrays of numpy."""

    patient, rows = False, 1

    def __init__(self, job: _Job, layout: Layout) -> None:
        self._job, self._layout, self._entries = job, layout, 0
        self.rows = self.room = job.rows(job.members)
        self._series: list[dict[str, np.ndarray]] = []
        self._out: Any = None

    def resumed(self) -> None:
        return None

    def begin(self, carry: list[Carry]) -> None:
        if self._job.reduction is not None:
            self._series.append(_first_entry(self._job))
            return
        first = members.fetch(self._layout, [(c.info, c.state) for c in carry])
        self._out = jax.tree.map(lambda x: np.empty((self._job.num_saves + 1, *x.shape), x.dtype), first)
        self._put(jax.tree.map(lambda x: x[None], first))

    def add(self, saved: Any, number: int) -> None:
        fetched = _rows(self._layout, saved, number)
        if self._job.reduction is None:
            self._put(fetched)
        else:
            self._series.append(_reduced(fetched, self._job))

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


def _rows(layout: Layout, saved: list[Any], number: int) -> Any:
    """What the compiled loop saved, of all members: the first `number` rows."""
    return members.fetch(layout, [jax.tree.map(lambda x: x[:number], piece) for piece in saved], 1)


def _first_entry(job: _Job) -> dict[str, np.ndarray]:
    zero = np.zeros(1, job.dt.dtype)
    return dict.fromkeys(("least", "greatest", "mean", "residual"), zero) | {"unconverged": np.zeros(1, np.int64)}


def _reduced(rows: tuple[StepInfo, Range], job: _Job) -> dict[str, np.ndarray]:
    """Rows (saves, members) to series (saves,); sums in the order of the members, whatever held them."""
    info, change = rows
    return {
        "least": change.least.min(axis=1),
        "greatest": change.greatest.max(axis=1),
        "mean": np.array([np.sum(row) for row in np.asarray(change.total)]) / (job.members * job.interval),
        "residual": info.residual.max(axis=1),
        "unconverged": (~np.asarray(info.converged)).sum(axis=1),
    }  # pyright: ignore[reportReturnType]


def _on_disk(job: _Job, mesh: Mesh, place: Place, progress: bool, resume: bool) -> Any:
    path = Path(place.path)
    if path.suffix != ".zarr":
        raise ValueError(f"a store is a folder that ends in .zarr, got {path}")
    leader = jax.process_index() == 0
    layout = members.layout_of(mesh, job.members)
    there = bool(members.agree(mesh, path.exists())[0])
    described = _description(job, place)
    if there and not resume:
        raise ValueError(f"{path} exists and is not overwritten; resume continues it, or choose another store")
    if not there and leader:
        chunk = members.chunk_of(layout, _CHUNK_MEMBERS)
        storage.create(path, *_columns(job, chunk, place), _attributes(job, place, described, chunk))
    members.agree(mesh, 0.0)  # it is there for all
    with storage.opened(path, leader) as recorder:
        _check_same(path, recorder.attributes["run"], described)
        if leader:
            storage.clean(path)
        layout = members.layout_of(mesh, job.members, recorder.attributes["member_chunk"])
        members.agree(mesh, 0.0)
        if not recorder.progress["complete"]:
            _integrate(job, layout, _Disk(job, layout, recorder), progress)
    return _opened(path)


def _opened(path: Path) -> Any:
    found, _ = storage.load(path)
    if isinstance(found, Trajectory):
        return found
    state = State(found["q"], found["p"])
    series = {name: found[name] for name in ("least", "greatest", "mean", "residual", "unconverged")}
    return Summary(found["time"], **series, state=state, failed=found["first_failure"])


class _Disk:
    """Results in a store, chunk by chunk, with what is needed to go on from each."""

    patient = True

    def __init__(self, job: _Job, layout: Layout, recorder: storage.Recorder) -> None:
        self._job, self._layout, self._recorder = job, layout, recorder
        self._entries = recorder.progress["entries"]  # of commits
        self._pending: list[tuple[Any, int]] = []
        self._since = 0.0
        self._next: dict[str, Any] | None = None  # the progress of the commit that is being written
        self.rows = int(recorder.attributes["time_chunk"])

    @property
    def _held(self) -> int:
        return sum(number for _, number in self._pending)

    @property
    def room(self) -> int:
        """Saves until the chunk is whole."""
        return self.rows - (self._entries + self._held) % self.rows

    def resumed(self) -> tuple[list[Carry], int] | None:
        done = self._recorder.progress
        if not done["commits"]:
            return None
        mine = self._layout.own
        part = range(max(min(mine.start, self._layout.members - 1), 0), max(mine.stop, mine.start + 1))

        def read(name: str) -> Any:
            return self._recorder.read(f"checkpoint/{name}", (done["commits"] % 2, slice(part.start, part.stop)))

        change = Range(*map(read, Range._fields)) if self._job.reduction is not None else None
        info = StepInfo(read("residual"), read("converged"))  # pyright: ignore[reportArgumentType]
        carry = Carry(State(read("q"), read("p")), info, read("failed"), change)  # pyright: ignore[reportArgumentType]
        return members.place(self._layout, carry, part.start), done["steps"]

    def begin(self, carry: list[Carry]) -> None:
        if self._job.reduction is None:
            self._pending.append(([jax.tree.map(lambda x: x[None], (c.info, c.state)) for c in carry], 1))
        else:
            self._pending.append((_first_entry(self._job), 1))

    def add(self, saved: Any, number: int) -> None:
        if self._job.reduction is not None:
            saved = _reduced(_rows(self._layout, saved, number), self._job)
        self._pending.append((saved, number))

    def offer(self, carry: list[Carry], done: int, seconds: float, stop: bool) -> None:
        """Commit if a chunk is whole, or if it has been long and nothing is half a chunk."""
        self._settle(wait=False)
        self._since += seconds
        last = done == self._job.num_steps
        whole = self._held and (self._entries + self._held) % self.rows == 0
        if last or whole or (not self._held and (stop or self._since > _PATIENCE)):
            self._commit(carry, done, last)

    def _commit(self, carry: list[Carry], done: int, last: bool) -> None:
        self._settle(wait=True)
        pieces, first, number = self._pending, self._entries, self._held
        slot = (self._recorder.progress["commits"] + 1) % 2
        self._pending, self._entries, self._since = [], first + number, 0.0
        self._recorder.write(partial(self._parts, carry, pieces, first, slot, last))
        self._next = {
            "commits": 0 if last else self._recorder.progress["commits"] + 1,  # a history that no longer matters
            "entries": self._entries,
            "steps": done,
            "complete": last,
        }

    def _settle(self, wait: bool) -> None:
        """Publish the commit that is being written, if all processes have; with `wait`, once they have."""
        while self._next is not None:
            missing = members.agree(self._layout.mesh, not self._recorder.written)[0]
            if not missing:
                self._recorder.publish(**self._next)
                self._next = None
            elif not wait:
                return
            else:
                time.sleep(0.002)

    def _parts(self, carry: list[Carry], pieces: list[tuple[Any, int]], first: int, slot: int, last: bool) -> Any:
        """The arrays of a commit, made when they are written."""
        layout, part = self._layout, storage.Part
        mine = layout.own.start
        series = self._job.reduction is not None
        if len(layout.own):
            host = {name: members.own(layout, x) for name, x in _named(carry).items()}
            for name, x in host.items():
                yield part(f"checkpoint/{name}", (slot, mine), x[None])
            if last:
                kept = {"first_failure": host["failed"]} | ({name: host[name] for name in "qp"} if series else {})
                for name, x in kept.items():
                    yield part(name, (mine,), x)
        if not pieces:
            return
        if series:
            rows: dict[str, np.ndarray] = {
                name: np.concatenate([values[name] for values, _ in pieces]) for name in pieces[0][0]
            }
        else:
            rows = self._rows(pieces)
        if jax.process_index() == 0:
            end = first + len(next(iter(rows.values())))
            yield part("time", (first,), self._job.times[first:end])
        if jax.process_index() == 0 or not series:
            for name, x in rows.items():
                yield part(name, (first,) if series else (first, mine), x)

    def _rows(self, pieces: list[tuple[Any, int]]) -> dict[str, np.ndarray]:
        joined: dict[str, list[np.ndarray]] = {}
        for saved, number in pieces:
            for name in ("q", "p", *StepInfo._fields):
                parts = [getattr(state if name in "qp" else info, name)[:number] for info, state in saved]
                joined.setdefault(name, []).append(members.own(self._layout, parts, 1))
        return {name: np.concatenate(parts) for name, parts in joined.items()}

    def stopped(self, done: int) -> bool:
        """Whether the run may stop here: everything up to this step is committed."""
        if self._pending:
            return False
        self._settle(wait=True)
        return True

    def farewell(self, done: int, num_steps: int) -> str:
        return f"stopped after {done} of {num_steps} steps, all of them in {self._recorder.path}; resume to go on"

    def end(self, carry: list[Carry]) -> None:
        self._settle(wait=True)
        members.agree(self._layout.mesh, 0.0)


def _named(carry: list[Carry]) -> dict[str, list[Any]]:
    """The pieces of each array of a carry."""
    found: dict[str, list[Any]] = {}
    for c in carry:
        change = c.change._asdict() if c.change is not None else {}
        for name, x in {**c.state._asdict(), "failed": c.failed, **c.info._asdict(), **change}.items():
            found.setdefault(name, []).append(x)
    return found


def _columns(job: _Job, chunk: int, place: Place) -> tuple[dict[str, storage.Column], dict[str, storage.Column]]:
    """The arrays of a store: what readers see, and the checkpoint."""
    time_chunk, count, length = job.rows(chunk), job.members, job.num_saves + 1
    number, integer = np.dtype(job.dt.dtype), np.dtype(np.int64)

    def dims(name: str, leaf: Any) -> tuple[str, ...]:
        axes = leaf.shape[1:]
        return tuple(
            f"{name}_{'component' if len(axes) == 1 else 'row' if k == 0 else 'column'}" for k in range(len(axes))
        )

    def along(
        lead: Mapping[str, tuple[int, int]], name: str, leaf: Any = None, dtype: Any = number, **text: str
    ) -> Any:
        more = () if leaf is None else leaf.shape[1:]
        shape, chunks = (tuple(x[k] for x in lead.values()) for k in (0, 1))
        return storage.Column(
            (*shape, *more), np.dtype(dtype), (*chunks, *more), (*lead, *(dims(name, leaf) if more else ())), text
        )

    times, many, slots = {"time": (length, time_chunk)}, {"member": (count, chunk)}, {"slot": (2, 1)}
    state = dict(zip(State._fields, job.states, strict=True))
    texts = {"q": "configuration", "p": "momentum"}
    both = {} if job.reduction is not None else times
    columns = {"time": along(times, "time", units=place.time_unit, long_name="time")}
    for name, leaf in state.items():
        columns[name] = along(both | many, name, leaf, long_name=texts[name], units=_unit(name, job, place))
    columns["first_failure"] = along(
        many, "", dtype=integer, long_name="first step that did not converge, or -1", units="1"
    )
    residual = "largest residual of a step since the entry before"
    if job.reduction is None:
        columns["residual"] = along(times | many, "", long_name=residual, units="1")
        columns["converged"] = along(
            times | many, "", dtype=bool, long_name="whether all steps since the entry before did"
        )
    else:
        what = getattr(job.reduction, "__name__", "reduced quantity")
        for name in ("least", "greatest", "mean"):
            columns[name] = along(
                times, "", long_name=f"{name} change of {what} since the start, over members and steps"
            )
        columns["residual"] = along(times, "", long_name=residual, units="1")
        columns["unconverged"] = along(
            times, "", dtype=integer, long_name="members with a step that did not", units="1"
        )
    checkpoint = {name: along(slots | many, name, leaf) for name, leaf in state.items()}
    checkpoint |= {"failed": along(slots | many, "", dtype=_failed_dtype()), "residual": along(slots | many, "")}
    checkpoint["converged"] = along(slots | many, "", dtype=bool)
    if job.reduction is not None:
        checkpoint |= {name: along(slots | many, "") for name in Range._fields}
    return columns, checkpoint


def _failed_dtype() -> Any:
    return jax.dtypes.canonicalize_dtype(np.int64)


def _unit(name: str, job: _Job, place: Place) -> str:
    rigid = name == "p" and hasattr(job.step.system, "inertia") and job.states.q.shape[1:] == (4,)
    return f"unit of inertia / {place.time_unit}" if rigid else "1"


def _attributes(job: _Job, place: Place, described: dict[str, Any], chunk: int) -> dict[str, Any]:
    return {
        "title": str(place.attributes.get("title", job.step.name)),
        "scheme": job.step.name,
        "system": type(job.step.system).__name__,
        "dt": job.given,
        "save_every": job.interval,
        "num_steps": job.num_steps,
        "members": job.members,
        "reduce": described["reduce"],
        "time_chunk": job.rows(chunk),
        "member_chunk": chunk,
        "run": described,
        **place.attributes,
    }


def _description(job: _Job, place: Place) -> dict[str, Any]:
    """All that the bits of a run depend on. A run is resumed only where nothing of it differs."""
    from lieint_jax import __version__

    leaves, structure = jax.tree.flatten(job.step)
    flags = [f for f in os.environ.get("XLA_FLAGS", "").split() if "force_host_platform_device_count" not in f]
    return {
        "scheme": job.step.name,
        "system": type(job.step.system).__name__,
        "options of the step": _digest(storage.steady(str(structure)).encode()),
        "numbers of the step": _digest(*leaves),
        "initial states": _digest(*job.states),
        "members": job.members,
        "dt": job.given,
        "num_steps": job.num_steps,
        "save_every": job.interval,
        "step_axis": job.step_axis,
        "reduce": getattr(job.reduction, "__name__", "a function") if job.reduction is not None else None,
        "dtype": str(job.dt.dtype),
        "versions": {"lieint_jax": __version__, "jax": jax.__version__, "jaxlib": version("jaxlib")},
        "compiler_options": compiler_options(),
        "XLA_FLAGS": " ".join(flags),
        "device": _device(),
        **{key: place.attributes[key] for key in ("scenario",) if key in place.attributes},
    }


def _digest(*leaves: Any) -> str:
    digest = hashlib.sha256()
    for leaf in leaves:
        array = np.frombuffer(leaf, np.uint8) if isinstance(leaf, bytes) else np.asarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def _device() -> str:
    """The kind of device; of a CPU, the widest vectors that it has, for its code depends on them."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        return device.device_kind
    try:
        flags = re.search(r"(?m)^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text())
    except OSError:
        flags = None
    found = [isa for isa in ("avx512f", "avx2", "avx") if flags and isa in flags.group(1).split()]
    import platform

    return " ".join([platform.machine(), *found[:1]])


def _check_same(path: Path, stored: dict[str, Any], now: dict[str, Any]) -> None:
    different = storage.differences(stored, now)
    if different:
        raise ValueError(f"{path} holds another run and cannot be resumed with this one: {'; '.join(different)}")


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


def _check_first(failed: np.ndarray, job: _Job) -> None:
    bad = np.flatnonzero(failed >= 0)
    if bad.size:
        one = jax.tree.map(lambda leaf: leaf[bad[0]], job.states)
        its = job.step if job.step_axis is None else jax.tree.map(lambda leaf: leaf[bad[0]], job.step)
        raise ValueError(f"the first step fails for {_some(bad)}. Member {bad[0]}: {its.advice(one, job.given)}")


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
