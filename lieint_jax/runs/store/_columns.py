"""The arrays of a store, and its attributes: names, axes, units."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import DTypeLike

from lieint_jax.runs._job.devices import Numbers
from lieint_jax.runs._job.job import Job
from lieint_jax.runs._storage.arrays import ArrayMetadata
from lieint_jax.runs._storage.leaves import Table, store_name
from lieint_jax.runs._storage.storage import StoreOptions
from lieint_jax.types import labeled, leaves_by_name

_RESIDUAL = "largest residual of a step since the entry before"
_MEMBER_TEXTS = {
    "least": "least value of the reduced quantity over all steps",
    "greatest": "greatest value of it",
    "total": "sum of its values, that at the start included",
    "excess": "what rounding has added to this sum",
    "last": "its last value",
    "first": "first time at which the condition was true",
}
_OWN = {
    "constants",
    "description",
    "format",
    "progress",
    "digests",
    "checksum",
    "parts",
    "missing",
}  # more attributes of every store


class Axes:
    """The axes that the arrays of a store share, each a name with its length and chunk length."""

    def __init__(self, job: Job, chunk: int, rows: int) -> None:
        self.times = {"time": (job.num_saves + 1, rows)}  # name: (length, chunk)
        self.members = {"member": (job.members, chunk)}
        self._number = job.dtype

    def column(
        self, axes: Mapping[str, tuple[int, int]], dtype: DTypeLike | None = None, **attributes: str
    ) -> ArrayMetadata:
        """The description of an array of scalars along `axes`."""
        (shape, chunks), kind = zip(*axes.values(), strict=True), np.dtype(self._number if dtype is None else dtype)
        return ArrayMetadata(shape, kind, chunks, tuple(axes), attributes)

    def state(self, axes: Mapping[str, tuple[int, int]], name: str, leaf: Numbers, **attributes: str) -> ArrayMetadata:
        """The description of an array of one leaf of the states along `axes`."""
        dims, _ = labeled.state_axes(store_name(name), leaf.shape[1:])
        sizes = {dim: (n, max(n, 1)) for dim, n in zip(dims, leaf.shape[1:], strict=True)}  # momenta may have none
        return self.column({**axes, **sizes}, **attributes)


def columns_of(job: Job, axes: Axes, options: StoreOptions) -> dict[str, ArrayMetadata]:
    """The arrays that readers see."""
    times, members = axes.times, axes.members
    series = job.reduction is not None
    texts = {"q": "configuration", "p": "momentum", "work": "work done on the body", "t": "time of each member"}
    text = "time since the start" if job.own_times else "time"
    if job.step.own_time:
        text = "fictitious time since the start"
    columns = {"time": axes.column(times, units=options.time_unit, long_name=text)}
    for name, leaf in leaves_by_name(job.initial if job.own_times else job.states).items():
        along, text = members if series else {**times, **members}, texts.get(name, name.removeprefix("extra."))
        columns[store_name(name)] = axes.state(along, name, leaf, long_name=text, units=_unit(name, job, options))
    text = "first step that did not converge; -1: none; -2: not known before the end"
    columns["first_failure"] = axes.column(members, np.int64, long_name=text, units="1")._replace(missing=-2)
    if job.per_member:
        columns |= {name: axes.column(members, long_name=_MEMBER_TEXTS[name]) for name in job.change_names}
    if series:
        return columns | series_columns(job, axes, times)
    text, both = "whether all steps since the entry before did", {**times, **members}
    columns["residual"] = axes.column(both, long_name=_RESIDUAL, units="1")
    return columns | {"converged": axes.column(both, bool, long_name=text)}


def series_columns(job: Job, axes: Axes, along: Mapping[str, tuple[int, int]]) -> dict[str, ArrayMetadata]:
    what = getattr(job.reduction, "__name__", "reduced quantity")
    text = "{} change of {} since the start, over members and steps"
    changes = () if job.per_member else ("least", "greatest", "mean")
    return {
        **{name: axes.column(along, long_name=text.format(name, what)) for name in changes},
        "residual": axes.column(along, long_name=_RESIDUAL, units="1"),
        "unconverged": axes.column(along, np.int64, long_name="members with a step that did not", units="1"),
    }


def constant(name: str, values: np.ndarray, job: Job) -> tuple[ArrayMetadata, np.ndarray]:
    """The description and the values of an array of the step, with the member axis first if it has one."""
    along = ("member",) if job.step_axis is not None else ()
    dims = (*along, *(f"{name}_axis{k}" for k in range(values.ndim - len(along))))
    chunks = tuple(max(n, 1) for n in values.shape)  # of translations, an array of the group is empty
    return ArrayMetadata(values.shape, values.dtype, chunks, dims, {"long_name": f"{name} of the run"}), values


def labels(job: Job) -> dict[str, tuple[ArrayMetadata, np.ndarray]]:
    """The coordinates that name the components of the states, such as x, y, z along the dimension "axis"."""
    found: dict[str, tuple[ArrayMetadata, np.ndarray]] = {}
    for name, leaf in leaves_by_name(job.states).items():
        system = job.step.system
        for dim, labels in labeled.state_axes(store_name(name), leaf.shape[1:], system)[1].items():
            values = np.asarray(labels)
            if values.dtype.kind == "U":
                values = values.astype(np.dtypes.StringDType())
            found[dim] = ArrayMetadata(values.shape, values.dtype, values.shape, (dim,), {}), values
    return found


def _unit(name: str, job: Job, options: StoreOptions) -> str:
    if name == "t":
        return options.time_unit
    rigid = hasattr(job.step.system, "inertia") and job.states.q.shape[1:] == (4,)
    power = {"p": "", "work": "^2"}.get(name)
    return f"unit of inertia / {options.time_unit}{power}" if rigid and power is not None else "1"


def attributes_of(job: Job, options: StoreOptions, described: Table, chunk: int, rows: int) -> Table:
    """The attributes of a store, except those that describe its arrays and its progress.

    Raises:
        ValueError: a name of the user's attributes is reserved.
    """
    own = {
        "leaves": list(leaves_by_name(job.initial)),
        "time_unit": options.time_unit,
        "scheme": job.step.name,
        "system": type(job.step.system).__name__,
        "dt": job.dt,
        "save_every": job.save_every,
        "num_steps": job.num_steps,
        "num_entries": job.num_saves + 1,
        "members": job.members,
        "batch": job.batch,
        "reduce": described["reduce"],
        "per": "member" if job.per_member else None,
        "time_chunk": rows,
        "member_chunk": chunk,
        "run": described,
    }
    reserved = sorted(map(str, options.attributes.keys() & (own.keys() | _OWN)))
    if reserved:
        raise ValueError(f"attributes of a store may not be called {', '.join(reserved)}: these names are reserved")
    return {"title": job.step.name} | own | dict(options.attributes)
