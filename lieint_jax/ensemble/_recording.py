"""A run into a store: its arrays, its checkpoints, and the check that a run may be resumed."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import time
from collections.abc import Callable, Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from lieint_jax._version import __version__
from lieint_jax.ensemble import _layout, _store
from lieint_jax.ensemble._description import describe
from lieint_jax.ensemble._job import Job, first_entry, gathered_rows, local_rows, reduced
from lieint_jax.ensemble._layout import Layout
from lieint_jax.ensemble._leaves import named, state_of
from lieint_jax.ensemble._loop import Carry, Range, compiler_options, step_dtype
from lieint_jax.ensemble._reading import opened
from lieint_jax.integrate import Given
from lieint_jax.types import State, StepInfo

_RESIDUAL = "largest residual of a step since the entry before"
_CHUNK_MEMBERS = 8192  # the most members in a chunk on disk
_CHECKPOINT_EVERY = 30.0  # seconds between checkpoints within a long save interval


class StoreOptions(NamedTuple):
    """The place of a store, and attributes to write beside the results.

    Attributes:
        path: a folder, whose name ends in .zarr.
        attributes: values that JSON can hold, such as a title. The key "scenario" describes the run: a resume with
            another scenario is refused.
        time_unit: the unit of dt.
    """

    path: str | Path
    attributes: Mapping[str, Any] = {}
    time_unit: str = "1"


def into_store(
    job: Job, mesh: Mesh, options: StoreOptions, resume: bool, integrate: Callable[[Layout, StoreOutput], Any]
) -> Any:
    """Let `integrate` fill a store, from the start or from its last checkpoint, and return the stored results."""
    path = Path(options.path)
    if path.suffix != ".zarr":
        raise ValueError(f"a store is a folder that ends in .zarr, got {path}")
    leader = jax.process_index() == 0
    layout = _layout.layout_of(mesh, job.members, part=job.part)
    exists = bool(_layout.all_reduce_max(mesh, path.exists())[0])
    described = _description(job, options)
    if exists and not resume:
        raise ValueError(f"{path} exists and is not overwritten; resume continues it, or choose another store")
    if not exists and leader:
        _create(path, job, options, described, _layout.chunk_of(layout, _CHUNK_MEMBERS))
    _layout.barrier(mesh)  # now the store exists for every process
    with _store.opened(path, leader) as writer:
        _check_same(path, writer.attributes, described)
        if leader:
            _store.clean(path)
        layout = _layout.layout_of(mesh, job.members, writer.attributes["member_chunk"], job.part)
        _layout.barrier(mesh)
        _store.check(path)
        if not writer.progress["complete"]:
            integrate(layout, StoreOutput(job, layout, writer))
    return opened(path)


def _create(path: Path, job: Job, options: StoreOptions, described: dict[str, Any], chunk: int) -> None:
    """Make the store of a run."""
    description, numbers = describe(job.step)
    attributes = _attributes(job, options, described, chunk)
    attributes |= {"constants": sorted(numbers), "description": description}
    constants = {name: _constant(name, x, job) for name, x in numbers.items()}
    _store.create(path, _columns(job, chunk, options), _checkpoint_columns(job, chunk), attributes, constants)


class StoreOutput:
    """Results in a store, written chunk by chunk, with a checkpoint after each chunk."""

    defers_interrupts = True

    def __init__(self, job: Job, layout: Layout, writer: _store.Writer) -> None:
        self._job, self._layout, self._writer = job, layout, writer
        self._entries = writer.progress["entries"]  # committed so far
        self._pending: list[tuple[Any, int]] = []
        self._since = 0.0
        self._next: dict[str, Any] | None = None  # the progress of the commit that is being written
        self.buffer_rows = int(writer.attributes["time_chunk"])

    @property
    def _held(self) -> int:
        return sum(number for _, number in self._pending)

    @property
    def free_rows(self) -> int:
        """The number of saves until the current chunk is full."""
        return self.buffer_rows - (self._entries + self._held) % self.buffer_rows

    def restored(self) -> tuple[list[Carry], int, int] | None:
        """The carry, and the numbers of steps and of saves, of the run that the store holds, or None."""
        done = self._writer.progress
        if not done["commits"]:
            return None
        mine = self._layout.local_members
        part = range(max(min(mine.start, self._layout.members - 1), 0), max(mine.stop, mine.start + 1))

        def read(name: str) -> Any:
            return self._writer.read(f"checkpoint/{name}", (done["commits"] % 2, slice(part.start, part.stop)))

        change = Range(*map(read, Range._fields)) if self._job.reduction is not None else None
        info = StepInfo(read("residual"), read("converged"))  # pyright: ignore[reportArgumentType]
        state = state_of({name: read(name) for name in named(self._job.states)})
        carry = Carry(state, info, read("failed"), change)  # pyright: ignore[reportArgumentType]
        return _layout.scatter(self._layout, carry, part.start), done["steps"], done["entries"] - 1

    def begin(self, carry: list[Carry]) -> None:
        """Receive the entry of the start."""
        if self._job.reduction is None:
            self._pending.append(([jax.tree.map(lambda x: np.array(x)[None], (c.info, c.state)) for c in carry], 1))
        else:
            self._pending.append((first_entry(self._job), 1))

    def append(self, saved: Any, number: int) -> None:
        """Receive `number` saved rows."""
        if self._job.reduction is not None:
            saved = reduced(gathered_rows(self._layout, saved, number), self._job)
        else:
            saved = local_rows(saved, number)
        self._pending.append((saved, number))

    def checkpoint(self, carry: list[Carry], done: int, seconds: float, stop: bool) -> None:
        """Commit if a chunk is full; or if no rows are pending and the last commit is old or the run is to stop."""
        self._settle(wait=False)
        self._since += seconds
        last = self._entries + self._held > self._job.num_saves
        whole = self._held and (self._entries + self._held) % self.buffer_rows == 0
        if last or whole or (not self._held and (stop or self._since > _CHECKPOINT_EVERY)):
            self._commit(carry, done, last)

    def _commit(self, carry: list[Carry], done: int, last: bool) -> None:
        self._settle(wait=True)
        pending, first, number = self._pending, self._entries, self._held
        slot = (self._writer.progress["commits"] + 1) % 2
        self._pending, self._entries, self._since = [], first + number, 0.0
        self._writer.write(partial(self._parts, carry, pending, first, slot, last))
        self._next = {
            "commits": 0 if last else self._writer.progress["commits"] + 1,  # reset: it depends on interruptions
            "entries": self._entries,
            "steps": done,
            "complete": last,
        }

    def _settle(self, wait: bool) -> None:
        """Publish the commit in progress if all processes have written it; with `wait`, wait until they have."""
        while self._next is not None:
            missing = _layout.all_reduce_max(self._layout.mesh, not self._writer.written)[0]
            if not missing:
                self._writer.publish(**self._next)
                self._next = None
            elif not wait:
                return
            else:
                time.sleep(0.002)

    def _parts(self, carry: list[Carry], pending: list[tuple[Any, int]], first: int, slot: int, last: bool) -> Any:
        """The parts of a commit, one by one, computed by the background thread."""
        layout, part = self._layout, _store.Part
        mine = layout.local_members.start
        series = self._job.reduction is not None
        if len(layout.local_members):
            host = {name: _layout.local_part(layout, x) for name, x in _named(carry).items()}
            for name, x in host.items():
                yield part(f"checkpoint/{name}", (slot, mine), x[None])
            if last:
                kept = {"first_failure": host["failed"]}
                if series:
                    kept |= {name: host[name] for name in named(self._job.states)} | self._own_times(slice(-1, None), 0)
                for name, x in kept.items():
                    yield part(name, (mine,), x)
        if not pending:
            return
        if series:
            rows: dict[str, np.ndarray] = {
                name: np.concatenate([values[name] for values, _ in pending]) for name in pending[0][0]
            }
        else:
            rows = self._rows(pending) | self._own_times(slice(first, first + sum(number for _, number in pending)))
        if jax.process_index() == 0:
            end = first + len(next(iter(rows.values())))
            yield part("time", (first,), self._job.times[first:end])
        if jax.process_index() == 0 or not series:
            for name, x in rows.items():
                yield part(name, (first,) if series else (first, mine), x)

    def _rows(self, pending: list[tuple[Any, int]]) -> dict[str, np.ndarray]:
        joined: dict[str, list[np.ndarray]] = {}
        for saved, _ in pending:
            blocks = [named(state) | info._asdict() for info, state in saved]
            for name in blocks[0]:
                parts = [block[name] for block in blocks]
                joined.setdefault(name, []).append(_layout.local_part(self._layout, parts, 1))
        return {name: np.concatenate(parts) for name, parts in joined.items()}

    def _own_times(self, entries: slice, *index: int) -> dict[str, np.ndarray]:
        """The array "t" of this process' members, if each member has times of its own."""
        if self._job.t0 is None or self._job.shares_time:
            return {}
        mine = self._layout.local_members
        return {"t": self._job.state_times(entries)[:, mine.start : mine.stop][*index]}

    def can_stop(self) -> bool:
        """True if everything so far is committed."""
        if self._pending:
            return False
        self._settle(wait=True)
        return True

    def interrupt_message(self, done: int, num_steps: int) -> str:
        """The message for a user who interrupted the run."""
        return f"stopped after {done} of {num_steps} steps, all of them in {self._writer.path}; resume to go on"

    def result(self, carry: list[Carry]) -> None:
        """Wait until everything is written."""
        self._settle(wait=True)
        _layout.barrier(self._layout.mesh)


def _named(carry: list[Carry]) -> dict[str, list[Any]]:
    """The arrays of a carry by name, each as a list of its blocks."""
    found: dict[str, list[Any]] = {}
    for c in carry:
        change = c.change._asdict() if c.change is not None else {}
        for name, x in {**named(c.state), "failed": c.failed, **c.info._asdict(), **change}.items():
            found.setdefault(name, []).append(x)
    return found


class _Axes:
    """The axes that the arrays of a store share, each a name with its length and chunk length."""

    def __init__(self, job: Job, chunk: int) -> None:
        self.times = {"time": (job.num_saves + 1, job.buffer_rows(chunk))}  # name: (length, chunk)
        self.members = {"member": (job.members, chunk)}
        self.slots = {"slot": (2, 1)}
        self._number = job.dtype

    def column(self, axes: Mapping[str, tuple[int, int]], dtype: Any = None, **attributes: str) -> _store.Column:
        """The description of an array of scalars along `axes`."""
        (shape, chunks), kind = zip(*axes.values(), strict=True), np.dtype(self._number if dtype is None else dtype)
        return _store.Column(shape, kind, chunks, tuple(axes), attributes)

    def state(self, axes: Mapping[str, tuple[int, int]], name: str, leaf: Any, **attributes: str) -> _store.Column:
        """The description of an array of one leaf of the states along `axes`."""
        lengths = leaf.shape[1:]
        kinds = {1: ("component",), 2: ("row", "column")}.get(len(lengths), [f"axis{k}" for k in range(len(lengths))])
        own = {f"{name}_{kind}": (n, n) for kind, n in zip(kinds, lengths, strict=True)}
        return self.column({**axes, **own}, **attributes)


def _columns(job: Job, chunk: int, options: StoreOptions) -> dict[str, _store.Column]:
    """The arrays that readers see."""
    axes = _Axes(job, chunk)
    times, members = axes.times, axes.members
    series = job.reduction is not None
    texts = {"q": "configuration", "p": "momentum", "work": "work done on the body", "t": "time of each member"}
    text = "time" if job.t0 is None or job.shares_time else "time since the start"
    if job.step.own_time:
        text = "fictitious time since the start"
    columns = {"time": axes.column(times, units=options.time_unit, long_name=text)}
    for name, leaf in named(job.states if job.shares_time else job.initial).items():
        along, text = members if series else {**times, **members}, texts.get(name, name.removeprefix("extra."))
        columns[name] = axes.state(along, name, leaf, long_name=text, units=_unit(name, job, options))
    columns["first_failure"] = axes.column(
        members, np.int64, long_name="first step that did not converge, or -1", units="1"
    )
    return columns | (_series_columns(job, axes) if series else _report_columns(axes))


def _report_columns(axes: _Axes) -> dict[str, _store.Column]:
    both = {**axes.times, **axes.members}
    return {
        "residual": axes.column(both, long_name=_RESIDUAL, units="1"),
        "converged": axes.column(both, bool, long_name="whether all steps since the entry before did"),
    }


def _series_columns(job: Job, axes: _Axes) -> dict[str, _store.Column]:
    what = getattr(job.reduction, "__name__", "reduced quantity")
    text = "{} change of {} since the start, over members and steps"
    return {
        **{name: axes.column(axes.times, long_name=text.format(name, what)) for name in ("least", "greatest", "mean")},
        "residual": axes.column(axes.times, long_name=_RESIDUAL, units="1"),
        "unconverged": axes.column(axes.times, np.int64, long_name="members with a step that did not", units="1"),
    }


def _constant(name: str, values: np.ndarray, job: Job) -> tuple[_store.Column, np.ndarray]:
    """The description and the values of an array of numbers of the step, with the member axis first if it has one."""
    along = ("member",) if job.step_axis is not None else ()
    dims = (*along, *(f"{name}_axis{k}" for k in range(values.ndim - len(along))))
    return _store.Column(values.shape, values.dtype, values.shape, dims, {"long_name": f"{name} of the run"}), values


def _checkpoint_columns(job: Job, chunk: int) -> dict[str, _store.Column]:
    """The arrays of the checkpoint: those of a carry, in two slots that are written in turn."""
    axes = _Axes(job, chunk)
    along = {**axes.slots, **axes.members}
    return {
        **{name: axes.state(along, name, leaf) for name, leaf in named(job.states).items()},
        "failed": axes.column(along, step_dtype()),
        "residual": axes.column(along),
        "converged": axes.column(along, bool),
        **({name: axes.column(along) for name in Range._fields} if job.reduction is not None else {}),
    }


def _unit(name: str, job: Job, options: StoreOptions) -> str:
    if name == "t":
        return options.time_unit
    rigid = hasattr(job.step.system, "inertia") and job.states.q.shape[1:] == (4,)
    power = {"p": "", "work": "^2"}.get(name)
    return f"unit of inertia / {options.time_unit}{power}" if rigid and power is not None else "1"


def _attributes(job: Job, options: StoreOptions, described: dict[str, Any], chunk: int) -> dict[str, Any]:
    return {
        "format": _store.FORMAT,
        "leaves": list(named(job.initial)),
        "time_unit": options.time_unit,
        "title": str(options.attributes.get("title", job.step.name)),
        "scheme": job.step.name,
        "system": type(job.step.system).__name__,
        "dt": job.dt,
        "save_every": job.save_every,
        "num_steps": job.num_steps,
        "num_entries": job.num_saves + 1,
        "members": job.members,
        "reduce": described["reduce"],
        "time_chunk": job.buffer_rows(chunk),
        "member_chunk": chunk,
        "run": described,
        **options.attributes,
    }


def _description(job: Job, options: StoreOptions) -> dict[str, Any]:
    """Everything that the bits of a run depend on. A run is resumed only if all of it is equal."""
    leaves, structure = jax.tree.flatten(job.step)
    flags = [f for f in os.environ.get("XLA_FLAGS", "").split() if "force_host_platform_device_count" not in f]
    return {
        "scheme": job.step.name,
        "system": type(job.step.system).__name__,
        "options of the step": _digest(_store.without_addresses(str(structure)).encode()),
        "numbers of the step": _digest(*leaves),
        "initial states": _digest(*_with_names(job.initial)),
        "members": job.members,
        "dt": job.dt,
        "num_steps": job.planned,
        "save_every": job.save_every,
        "times": _digest(job.clock.times) if isinstance(job.clock, Given) else None,
        "save_at": None if job.rests is None else _digest(job.times),
        "step_axis": job.step_axis,
        "reduce": getattr(job.reduction, "__name__", "a function") if job.reduction is not None else None,
        "dtype": str(job.dtype),
        "versions": {"lieint_jax": __version__, "jax": jax.__version__, "jaxlib": version("jaxlib")},
        "compiler_options": compiler_options(),
        "XLA_FLAGS": " ".join(flags),
        "device": _device(),
        **{key: options.attributes[key] for key in ("scenario",) if key in options.attributes},
    }


def _with_names(states: State) -> list[Any]:
    """The arrays of states, q and p first; each of the others, which states need not have, after its name."""
    q, p, *rest = named(states).items()
    return [q[1], p[1], *(part for name, x in rest for part in (name.encode(), x))]


def _digest(*leaves: Any) -> str:
    digest = hashlib.sha256()
    for leaf in leaves:
        array = np.frombuffer(leaf, np.uint8) if isinstance(leaf, bytes) else np.asarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def _device() -> str:
    """The kind of device; for a CPU with its widest vector instructions, on which the compiled code depends."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        return device.device_kind
    try:
        flags = re.search(r"(?m)^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text())
    except OSError:
        flags = None
    found = [isa for isa in ("avx512f", "avx2", "avx") if flags and isa in flags.group(1).split()]
    return " ".join([platform.machine(), *found[:1]])


def _check_same(path: Path, stored: dict[str, Any], now: dict[str, Any]) -> None:
    if stored.get("format", 1) < _store.FORMAT:
        raise ValueError(
            f"{path} was written by an older version of lieint_jax, whose runs this one does not continue bit for bit: "
            "`lieint info` and `lieint plot` read what is there; run again into another store"
        )
    different = _store.differences(stored["run"], now)
    if different:
        raise ValueError(f"{path} holds another run and cannot be resumed with this one: {'; '.join(different)}")
