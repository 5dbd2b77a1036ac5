"""The metadata of a store as one model, by which whatever is read back is checked, for anybody may have written it.

This module imports pydantic, so import it inside the functions that read a store.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    Strict,
    ValidationError,
    field_validator,
    model_validator,
)

from lieint_jax import _checks
from lieint_jax.dates import epoch
from lieint_jax.runs._storage.arrays import GROUP, ArrayMetadata
from lieint_jax.runs._storage.leaves import STEP, step_array, store_name
from lieint_jax.runs._storage.untrusted import NAME

_MAX_LENGTH, _MAX_PARTS = 10**15, 10**6
_REALS, _COUNTS, _FLAGS = ("float32", "float64"), ("int32", "int64"), ("bool",)


def _check_name(name: str) -> str:
    if not NAME.fullmatch(name):
        raise ValueError(f"{name!r} is not the name of an array")
    return name


def _check_path(path: str) -> str:
    """The path of an array, in the root or in the group of the step."""
    _check_name(path.removeprefix(step_array("")))
    return path


def _check_date(text: str) -> str:
    epoch(text)
    return text


Natural = Annotated[int, Field(ge=0, le=_MAX_LENGTH)]
Count = Annotated[int, Field(gt=0, le=_MAX_LENGTH)]
Name = Annotated[str, AfterValidator(_check_name)]
ArrayPath = Annotated[str, AfterValidator(_check_path)]


class _Model(BaseModel):
    """Types are not converted, and more keys than those of the model are allowed: users add their own."""

    model_config = ConfigDict(strict=True, frozen=True, extra="ignore")

    @classmethod
    def of(cls, table: object) -> Self:
        """The model of a table; a ValueError of one sentence says which key is not as it should be."""
        try:
            return cls.model_validate(table)
        except ValidationError as error:
            first = error.errors(include_url=False, include_context=False)[0]
            where, reason = ".".join(map(str, first["loc"])), first["msg"].removeprefix("Value error, ")
            raise ValueError(_checks.printable(f"{where}: {reason}" if where else reason, 300)) from None


class Progress(_Model):
    """How far a run, or a part of it, has come."""

    commits: Natural
    entries: Natural
    steps: Natural
    complete: bool


class Machine(_Model):
    """What has computed a run."""

    device: str
    engine: str
    versions: dict[str, str]


class Description(Machine):
    """What the bits of a run depend on, as far as readers use it; `_identity` compares all of it."""

    own_step: bool
    epoch: Annotated[str, AfterValidator(_check_date)] | None
    compiler_options: dict[str, Any]
    num_steps: Natural


class Digests(_Model):
    """The digests of the arrays that the run does not change."""

    arrays: dict[ArrayPath, str]


class Attributes(_Model):
    """The attributes of the root."""

    progress: Progress
    run: Description
    digests: Digests
    description: dict[str, Any]
    scheme: str
    system: str
    time_unit: str
    leaves: list[Name]
    constants: list[Name]
    members: Count
    batch: bool
    num_steps: Natural
    num_entries: Count
    member_chunk: Count
    time_chunk: Count
    parts: Count | None = None
    save_every: Count | None
    dt: Annotated[float, Field(gt=-1e300, lt=1e300)] | None
    reduce: str | None
    per: Literal["member"] | None

    @model_validator(mode="after")
    def _has_few_parts(self) -> Self:
        if self.parts is not None and self.parts > min(self.members, _MAX_PARTS):
            raise ValueError(f"it has {self.parts} parts of {self.members} members")
        return self


class _Shown(_Model):
    metadata: dict[ArrayPath, Annotated[Any, PlainValidator(ArrayMetadata.from_json)]]

    @field_validator("metadata", mode="before")
    @classmethod
    def _arrays_of(cls, nodes: Any) -> Any:
        """The arrays among the nodes; the only other node is the group of the step."""
        if not isinstance(nodes, dict) or nodes.get(STEP) != GROUP:
            raise ValueError(f"it has no group {STEP}")
        return {path: node for path, node in nodes.items() if path != STEP}


class Metadata(_Model):
    """The metadata of the root: its attributes, and the arrays with the lengths that other readers of Zarr see."""

    attributes: Attributes
    consolidated_metadata: _Shown

    @property
    def arrays(self) -> dict[str, ArrayMetadata]:
        """The metadata of the arrays by name."""
        return self.consolidated_metadata.metadata

    @model_validator(mode="after")
    def _has_arrays_that_fit(self) -> Self:
        found = self.attributes
        entries = found.progress.entries if found.parts is None else found.num_entries
        lengths = {"time": entries, "member": found.members, "part": found.parts}
        for name, array in self.arrays.items():
            for dim, n in zip(array.dims, array.shape, strict=True):
                if n != lengths.get(dim, n):
                    raise ValueError(f"{name} has {n} values along {dim}, not {lengths[dim]}")
        of_members = ("time", "member") if found.reduce is None else ("member",)
        series = of_members if found.reduce is None else ("time",) if found.parts is None else ("part", "time")
        self._expect("time", _REALS, ("time",))
        self._expect("first_failure", _COUNTS, ("member",))
        self._expect("residual", _REALS, series)
        self._expect(*(("unconverged", _COUNTS) if found.reduce is not None else ("converged", _FLAGS)), series)
        for leaf in map(store_name, found.leaves):
            if leaf != "t" or leaf in self.arrays:  # a time that all members share has no array of its own
                self._expect(leaf, _REALS, of_members, more=1 if leaf in ("q", "p") else 0)
        if missing := {*map(step_array, found.constants), *found.digests.arrays} - set(self.arrays):
            raise ValueError(f"it has no array {min(missing)}")
        return self

    def _expect(self, name: str, dtypes: tuple[str, ...], dims: tuple[str, ...], more: int | None = None) -> None:
        """Raise ValueError unless there is an array of one of these dtypes along these axes.

        With `more` it has so many further ones at least.
        """
        if name not in self.arrays:
            raise ValueError(f"it has no array {name}")
        array, least = self.arrays[name], len(dims) + (more or 0)
        if array.dtype.name not in dtypes:
            raise ValueError(f"{name} is of {array.dtype.name}, not {' or '.join(dtypes)}")
        if array.dims[: len(dims)] != dims or len(array.dims) < least or (more is None and len(array.dims) > least):
            raise ValueError(f"{name} is along {', '.join(array.dims)}, not {', '.join(dims)}{', …' if more else ''}")

    def check_chunks(self, files: int) -> None:
        """Raise ValueError if an array has more chunks than a store with so many files can have."""
        for name, array in self.arrays.items():
            if array.num_chunks > files:
                raise ValueError(f"{name} of shape {array.shape} has more chunks than there are files")


class StateHeader(_Model):
    """The header of the state of a part."""

    run: str
    part: list[Natural]
    progress: Progress
    machines: list[Machine]
    initial: str = Field(alias="initial states")
    arrays: dict[str, Annotated[tuple[str, list[Natural]], Strict(False)]]
