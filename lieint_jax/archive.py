"""A run on disk: what its store looks like, how it is filled while the run goes on, and which run may go on with it."""

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

from lieint_jax import members, store
from lieint_jax.loop import Carry, Range, compiler_options, step_dtype
from lieint_jax.members import Layout
from lieint_jax.runs import Job, Summary, first_entry, first_rows, reduced, rows
from lieint_jax.types import State, StepInfo, Trajectory

_CHUNK_MEMBERS = 8192  # at most, of an array on disk
_PATIENCE = 30.0  # seconds after which a run is made continuable in the middle of a save interval


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


def record(job: Job, mesh: Mesh, place: Place, resume: bool, integrate: Callable[[Layout, Recording], Any]) -> Any:
    """Have `integrate` fill the store at a place, from its start or from where it ends; what is in it then."""
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
        store.create(path, *_columns(job, chunk, place), _attributes(job, place, described, chunk))
    members.meet(mesh)  # it is there for all
    with store.opened(path, leader) as recorder:
        _check_same(path, recorder.attributes["run"], described)
        if leader:
            store.clean(path)
        layout = members.layout_of(mesh, job.members, recorder.attributes["member_chunk"])
        members.meet(mesh)
        if not recorder.progress["complete"]:
            integrate(layout, Recording(job, layout, recorder))
    return _opened(path)


def _opened(path: Path) -> Any:
    found, _ = store.load(path)
    if isinstance(found, Trajectory):
        return found
    state = State(found["q"], found["p"])
    series = {name: found[name] for name in ("least", "greatest", "mean", "residual", "unconverged")}
    return Summary(found["time"], **series, state=state, failed=found["first_failure"])


class Recording:
    """Results in a store, chunk by chunk, with what is needed to go on from each."""

    patient = True

    def __init__(self, job: Job, layout: Layout, recorder: store.Recorder) -> None:
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
        """The carry and the steps taken of the run that is there, or None."""
        done = self._recorder.progress
        if not done["commits"]:
            return None
        mine = self._layout.members_here
        part = range(max(min(mine.start, self._layout.members - 1), 0), max(mine.stop, mine.start + 1))

        def read(name: str) -> Any:
            return self._recorder.read(f"checkpoint/{name}", (done["commits"] % 2, slice(part.start, part.stop)))

        change = Range(*map(read, Range._fields)) if self._job.reduction is not None else None
        info = StepInfo(read("residual"), read("converged"))  # pyright: ignore[reportArgumentType]
        carry = Carry(State(read("q"), read("p")), info, read("failed"), change)  # pyright: ignore[reportArgumentType]
        return members.place(self._layout, carry, part.start), done["steps"]

    def begin(self, carry: list[Carry]) -> None:
        """Take the entry of the start."""
        if self._job.reduction is None:
            self._pending.append(([jax.tree.map(lambda x: np.array(x)[None], (c.info, c.state)) for c in carry], 1))
        else:
            self._pending.append((first_entry(self._job), 1))

    def add(self, saved: Any, number: int) -> None:
        """Take `number` saved rows."""
        if self._job.reduction is not None:
            saved = reduced(rows(self._layout, saved, number), self._job)
        else:
            saved = first_rows(saved, number)
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
        layout, part = self._layout, store.Part
        mine = layout.members_here.start
        series = self._job.reduction is not None
        if len(layout.members_here):
            host = {name: members.own_part(layout, x) for name, x in _named(carry).items()}
            for name, x in host.items():
                yield part(f"checkpoint/{name}", (slot, mine), x[None])
            if last:
                kept = {"first_failure": host["failed"]} | (
                    {name: host[name] for name in State._fields} if series else {}
                )
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
        for saved, _ in pieces:
            for name in (*State._fields, *StepInfo._fields):
                parts = [getattr(state if name in State._fields else info, name) for info, state in saved]
                joined.setdefault(name, []).append(members.own_part(self._layout, parts, 1))
        return {name: np.concatenate(parts) for name, parts in joined.items()}

    def stopped(self, done: int) -> bool:
        """Whether the run may stop here: everything up to this step is committed."""
        if self._pending:
            return False
        self._settle(wait=True)
        return True

    def farewell(self, done: int, num_steps: int) -> str:
        """What to tell whoever interrupted the run."""
        return f"stopped after {done} of {num_steps} steps, all of them in {self._recorder.path}; resume to go on"

    def end(self, carry: list[Carry]) -> None:
        """Wait until everything is written."""
        self._settle(wait=True)
        members.meet(self._layout.mesh)


def _named(carry: list[Carry]) -> dict[str, list[Any]]:
    """The pieces of each array of a carry."""
    found: dict[str, list[Any]] = {}
    for c in carry:
        change = c.change._asdict() if c.change is not None else {}
        for name, x in {**c.state._asdict(), "failed": c.failed, **c.info._asdict(), **change}.items():
            found.setdefault(name, []).append(x)
    return found


def _columns(job: Job, chunk: int, place: Place) -> tuple[dict[str, store.Column], dict[str, store.Column]]:
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
        return store.Column(
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
    checkpoint |= {"failed": along(slots | many, "", dtype=step_dtype()), "residual": along(slots | many, "")}
    checkpoint["converged"] = along(slots | many, "", dtype=bool)
    if job.reduction is not None:
        checkpoint |= {name: along(slots | many, "") for name in Range._fields}
    return columns, checkpoint


def _unit(name: str, job: Job, place: Place) -> str:
    rigid = name == "p" and hasattr(job.step.system, "inertia") and job.states.q.shape[1:] == (4,)
    return f"unit of inertia / {place.time_unit}" if rigid else "1"


def _attributes(job: Job, place: Place, described: dict[str, Any], chunk: int) -> dict[str, Any]:
    return {
        "title": str(place.attributes.get("title", job.step.name)),
        "scheme": job.step.name,
        "system": type(job.step.system).__name__,
        "dt": job.dt_given,
        "save_every": job.save_every,
        "num_steps": job.num_steps,
        "members": job.members,
        "reduce": described["reduce"],
        "time_chunk": job.rows(chunk),
        "member_chunk": chunk,
        "run": described,
        **place.attributes,
    }


def _description(job: Job, place: Place) -> dict[str, Any]:
    """All that the bits of a run depend on. A run is resumed only where nothing of it differs."""
    from lieint_jax import __version__

    leaves, structure = jax.tree.flatten(job.step)
    flags = [f for f in os.environ.get("XLA_FLAGS", "").split() if "force_host_platform_device_count" not in f]
    return {
        "scheme": job.step.name,
        "system": type(job.step.system).__name__,
        "options of the step": _digest(store.steady(str(structure)).encode()),
        "numbers of the step": _digest(*leaves),
        "initial states": _digest(*job.states),
        "members": job.members,
        "dt": job.dt_given,
        "num_steps": job.num_steps,
        "save_every": job.save_every,
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
    return " ".join([platform.machine(), *found[:1]])


def _check_same(path: Path, stored: dict[str, Any], now: dict[str, Any]) -> None:
    different = store.differences(stored, now)
    if different:
        raise ValueError(f"{path} holds another run and cannot be resumed with this one: {'; '.join(different)}")
