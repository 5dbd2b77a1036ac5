"""The files that a store begins with: its attributes, the metadata of its arrays, and those that a run only reads."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
from numpy.typing import DTypeLike

from lieint_jax.core import leaves_by_name
from lieint_jax.runs import labeled
from lieint_jax.runs._devices import Numbers
from lieint_jax.runs._dyadic_sum import blocks
from lieint_jax.runs._plan import Plan
from lieint_jax.runs._split import Split
from lieint_jax.runs._storage.arrays import ArrayMetadata, chunk_file, digest_of, tail
from lieint_jax.runs._storage.leaves import Table, step_array, store_name
from lieint_jax.runs._storage.storage import ROOT, StoreOptions
from lieint_jax.runs.store._description import describe
from lieint_jax.runs.store._root import FORMAT, START, encode_root, nodes_of

_RESIDUAL = "largest residual of a step since the entry before"
_MEMBER_TEXTS = {
    "least": "least value of the reduced quantity over all steps",
    "greatest": "greatest value of it",
    "total": "sum of its values, that at the start included",
    "excess": "what rounding has added to this sum",
    "last": "its last value",
    "first": "first time at which the condition was true",
}
_MORE = {"format", "constants", "description", "progress", "digests", "checksum", "parts", "missing", "machines"}
_TIME_CHUNK = 2**17  # entries of the array of times in one file


def first_files(plan: Plan, options: StoreOptions, described: Table, split: Split, in_parts: bool) -> dict[str, bytes]:
    """The files of a store before anything is computed: the root, its arrays' metadata, and the constant arrays.

    The same run has the same files in every process, so that all of them may write them.

    Args:
        plan: the run, of all members.
        options: the store.
        described: the description of the run, by which it is identified.
        split: the parts of the run.
        in_parts: whether other processes may write at the same time.

    Raises:
        ValueError: a name of the user's attributes is reserved.
    """
    members = max(map(split.part, range(split.parts)), key=len)
    rows = plan.select(slice(members.start, members.stop)).buffer_rows(split.chunk)
    description, numbers = describe(plan.step)
    attributes = _attributes(plan, options, described, split.chunk, rows) | {"progress": START}
    attributes |= {"format": FORMAT, "constants": sorted(numbers), "description": description}
    axes = Axes(plan, split.chunk, rows)
    metas = arrays_of_run(plan, axes, options)
    if in_parts:
        attributes["parts"] = split.parts
        if plan.reduction is not None:
            most = max(len(blocks(part.start, part.stop)) for part in map(split.part, range(split.parts)))
            series = {"part": (split.parts, 1), **axes.times}
            metas |= series_arrays(plan, axes, series)
            if not plan.per_member and split.parts > 1:
                sums = {**series, "block": (most, most)}
                metas["sums"] = axes.array(sums, long_name="sums over blocks of members")
    constants = {step_array(name): constant(name, x, plan) for name, x in numbers.items()} | labels(plan)
    constants["time"] = metas["time"]._replace(chunks=(min(len(plan.times), _TIME_CHUNK),)), plan.times
    metas = dict(sorted({**metas, **{name: meta for name, (meta, _) in constants.items()}}.items()))
    files = {f"{name}/{ROOT}": json.dumps(node, indent=2).encode() for name, node in nodes_of(metas).items()}
    digests = {}
    for name, (meta, values) in constants.items():
        chunks = {chunk_file(name, key): meta.encode(x) for key, x in meta.blocks(values, (0,) * values.ndim)}
        digests[name], files = digest_of(map(tail, chunks.values())), files | chunks
    attributes["digests"] = {"arrays": digests}
    root = {"attributes": attributes, "zarr_format": 3, "node_type": "group"}
    return {ROOT: encode_root(root, metas)} | files


class Axes:
    """The axes that the arrays of a store share, each a name with its length and chunk length."""

    def __init__(self, plan: Plan, chunk: int, rows: int) -> None:
        self.times = {"time": (plan.num_saves + 1, rows)}  # name: (length, chunk)
        self.members = {"member": (plan.members, chunk)}
        self._number = plan.dtype

    def array(
        self, axes: Mapping[str, tuple[int, int]], dtype: DTypeLike | None = None, **attributes: str
    ) -> ArrayMetadata:
        """The description of an array of scalars along `axes`."""
        (shape, chunks), kind = zip(*axes.values(), strict=True), np.dtype(self._number if dtype is None else dtype)
        return ArrayMetadata(shape, kind, chunks, tuple(axes), attributes)

    def state(self, axes: Mapping[str, tuple[int, int]], name: str, leaf: Numbers, **attributes: str) -> ArrayMetadata:
        """The description of an array of one leaf of the states along `axes`."""
        dims, _ = labeled.state_axes(store_name(name), leaf.shape[1:])
        sizes = {dim: (n, max(n, 1)) for dim, n in zip(dims, leaf.shape[1:], strict=True)}  # momenta may have none
        return self.array({**axes, **sizes}, **attributes)


def arrays_of_run(plan: Plan, axes: Axes, options: StoreOptions) -> dict[str, ArrayMetadata]:
    """The arrays that readers see."""
    times, members = axes.times, axes.members
    series = plan.reduction is not None
    texts = {"q": "configuration", "p": "momentum", "work": "work done on the body", "t": "time of each member"}
    text = "time since the start" if plan.own_times else "time"
    if plan.step.own_time:
        text = "fictitious time since the start"
    found = {"time": axes.array(times, units=options.time_unit, long_name=text)}
    states = plan.states._replace(t=None) if plan.shared_time else plan.states  # of which `time` is the time
    for name, leaf in leaves_by_name(states).items():
        along, text = members if series else {**times, **members}, texts.get(name, name.removeprefix("extra."))
        found[store_name(name)] = axes.state(along, name, leaf, long_name=text, units=_unit(name, plan, options))
    text = "first step that did not converge; -1: none; -2: not known before the end"
    found["first_failure"] = axes.array(members, np.int64, long_name=text, units="1")._replace(missing=-2)
    if plan.per_member:
        found |= {name: axes.array(members, long_name=_MEMBER_TEXTS[name]) for name in plan.change_names}
    if series:
        return found | series_arrays(plan, axes, times)
    text, both = "whether all steps since the entry before did", {**times, **members}
    found["residual"] = axes.array(both, long_name=_RESIDUAL, units="1")
    return found | {"converged": axes.array(both, bool, long_name=text)}


def series_arrays(plan: Plan, axes: Axes, along: Mapping[str, tuple[int, int]]) -> dict[str, ArrayMetadata]:
    what = getattr(plan.reduction, "__name__", "reduced quantity")
    text = "{} change of {} since the start, over members and steps"
    changes = () if plan.per_member else ("least", "greatest", "mean")
    return {
        **{name: axes.array(along, long_name=text.format(name, what)) for name in changes},
        "residual": axes.array(along, long_name=_RESIDUAL, units="1"),
        "unconverged": axes.array(along, np.int64, long_name="members with a step that did not", units="1"),
    }


def constant(name: str, values: np.ndarray, plan: Plan) -> tuple[ArrayMetadata, np.ndarray]:
    """The description and the values of an array of the step, with the member axis first if it has one."""
    along = ("member",) if plan.own_step else ()
    dims = (*along, *(f"{name}_axis{k}" for k in range(values.ndim - len(along))))
    chunks = tuple(max(n, 1) for n in values.shape)  # of translations, an array of the group is empty
    return ArrayMetadata(values.shape, values.dtype, chunks, dims, {"long_name": f"{name} of the run"}), values


def labels(plan: Plan) -> dict[str, tuple[ArrayMetadata, np.ndarray]]:
    """The coordinates that name the components of the states, such as x, y, z along the dimension "axis"."""
    found: dict[str, tuple[ArrayMetadata, np.ndarray]] = {}
    for name, leaf in leaves_by_name(plan.states).items():
        system = plan.step.system
        for dim, labels in labeled.state_axes(store_name(name), leaf.shape[1:], system)[1].items():
            values = np.asarray(labels)
            if values.dtype.kind == "U":
                values = values.astype(np.dtypes.StringDType())
            found[dim] = ArrayMetadata(values.shape, values.dtype, values.shape, (dim,), {}), values
    return found


def _unit(name: str, plan: Plan, options: StoreOptions) -> str:
    if name == "t":
        return options.time_unit
    rigid = hasattr(plan.step.system, "inertia") and plan.states.q.shape[1:] == (4,)
    power = {"p": "", "work": "^2"}.get(name)
    return f"unit of inertia / {options.time_unit}{power}" if rigid and power is not None else "1"


def _attributes(plan: Plan, options: StoreOptions, described: Table, chunk: int, rows: int) -> Table:
    """The attributes of a store that describe its run."""
    own = {
        "leaves": list(leaves_by_name(plan.states)),
        "time_unit": options.time_unit,
        "scheme": plan.step.name,
        "system": type(plan.step.system).__name__,
        "dt": plan.dt,
        "save_every": plan.save_every,
        "num_steps": plan.num_steps,
        "num_entries": plan.num_saves + 1,
        "members": plan.members,
        "batch": plan.batch,
        "reduce": described["reduce"],
        "per": "member" if plan.per_member else None,
        "time_chunk": rows,
        "member_chunk": chunk,
        "run": described,
    }
    if reserved := sorted(map(str, options.attributes.keys() & (own.keys() | _MORE))):
        raise ValueError(f"attributes of a store may not be called {', '.join(reserved)}: these names are reserved")
    return {"title": plan.step.name} | own | dict(options.attributes)
