"""Scenario files (*.toml), shipped or the user's own: from a file to a step, a batch of states and a report.

A scenario is a system, a scheme, a time step and an ensemble of initial states; it may hold published values and
observations to compare with the results. `scenario_names` lists the shipped ones. The file's key `system` names its
kind: a module of this package with a class, a subclass of `_kind.Kind`, or a user's own, "FILE.py:CLASS".
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import pkgutil
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
from pydantic import BaseModel, ValidationError

from lieint_jax import _checks
from lieint_jax.app._own_file import import_file
from lieint_jax.app.scenarios import _spread
from lieint_jax.app.scenarios._kind import Kind
from lieint_jax.app.scenarios._settings import set_key
from lieint_jax.runs import store as archives
from lieint_jax.types import State, Step

_MESSAGE = 1000  # characters of a message about a key
_SPREAD = "spread"
_FOR_PYTHON = "; use jax.vmap for batches"  # advice that does not apply to a file


def scenario_names() -> list[str]:
    """The names of the shipped scenarios."""
    files = resources.files(__name__).iterdir()
    return sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))


def kind_names() -> list[str]:
    """The kinds of this package: the values of the key `system`."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__) if not module.name.startswith("_"))


def kind(name: str) -> type[Kind]:
    """The kind of a name. Only its module is imported."""
    return _classes(importlib.import_module(f"{__name__}.{name}"))[-1]


def kinds() -> dict[str, type[Kind]]:
    """All kinds of this package by their names."""
    return {name: kind(name) for name in kind_names()}


def _classes(module: Any) -> list[type[Kind]]:
    """The kinds that a module defines, in its order."""
    found = [x for x in vars(module).values() if inspect.isclass(x) and issubclass(x, Kind)]
    return [x for x in found if x.__module__ == module.__name__]


def states_of(scenario: Kind, indices: np.ndarray) -> State:
    """The initial states of the members with these indices, for a kind whose members share one step."""
    return scenario.build(indices)[1]


def shapes_of_states(scenario: Kind) -> State:
    """The shapes of the initial states of all members, without computing them."""
    first = jax.eval_shape(lambda: states_of(scenario, np.arange(1)))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((scenario.members, *x.shape[1:])[: x.ndim], x.dtype), first)


def members_numbers(scenario: Kind) -> dict[str, np.ndarray]:
    """The numbers that differ between members, (members, …), by their paths."""
    return {".".join(path): values for path, values in _spread.draw_members(scenario).items()}


def build_first(scenario: Kind, members: int) -> Step:
    """The step of the first `members` members of a run, or the one that all members share."""
    return scenario.model_copy(update={"members": members if scenario.has_own_steps() else 1}).build()[0]


def load(name: str, settings: Sequence[str] = (), **changes: Any) -> Any:
    """The scenario shipped under `name`, or the one in the file `name`, with other values of its keys.

    Args:
        name: a shipped scenario or a file.
        settings: texts KEY=VALUE, applied in order: see `_settings.set_key`.
        changes: values of keys, which replace those in `settings`; None for no change.

    Returns:
        A `Kind`, that which its `system` key names.

    Raises:
        ValueError: no such scenario, not TOML, or a key is missing, unknown or out of range: the message names it.
    """
    keys = table(name)
    for text in settings:
        set_key(keys, text)
    return parse(keys | {key: value for key, value in changes.items() if value is not None}, name)


def parse(table: dict[str, Any], name: str, reads_files: bool = True) -> Any:
    """The scenario of a table of keys, and of the files that they name; error messages begin with `name`."""
    if "system" not in table:
        raise ValueError(f"{name}: system: key missing")
    try:
        model = kind(table["system"]) if table["system"] in kind_names() else _own_kind(table["system"], name)
    except ValueError as error:
        raise ValueError(f"{name}: system: {error}") from error
    return validate(model, _with_files(model, table, name) if reads_files else table, name)


def _with_files(model: Any, table: dict[str, Any], name: str, place: str = "") -> dict[str, Any]:
    """The keys of a table in which those that are {file = "…"} are replaced by what the files give."""
    found = {}
    for key, value in table.items():
        inner = _model_of(model, key)
        if isinstance(value, dict) and "file" in value and key in model.files:
            where = f"{name}: {place}{key}"
            chosen = validate(model.files[key], value, where)
            try:
                read = chosen.read(_place_of(chosen.file, name), {k: v for k, v in table.items() if k != key})
            except (ValueError, ImportError) as error:
                raise ValueError(f"{where}: {error}") from error
            if twice := set(read) & set(table) - {key, "epoch"}:
                raise ValueError(f"{where} gives {min(twice)}: leave out one of both")
            found |= read
        elif isinstance(value, dict) and inner is not None:
            found[key] = _with_files(inner, value, name, f"{place}{key}.")
        elif isinstance(value, list) and inner is not None and all(isinstance(row, dict) for row in value):
            found[key] = [_with_files(inner, row, name, f"{place}{key}.{k}.") for k, row in enumerate(value, 1)]
        else:
            found[key] = value
    return found


def _place_of(file: str, name: str) -> Path:
    """The file that a scenario names, next to it or here."""
    places = Path(name).parent / file, Path(file)
    if (path := next((place for place in places if place.is_file()), None)) is None:
        raise ValueError(f"there is no file {_quoted(file)}, neither here nor next to {name}")
    return path


def validate(model: Any, table: dict[str, Any], name: str) -> Any:
    """A table of keys as a pydantic model; a ValueError that begins with `name` names the first wrong key."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        raise ValueError(f"{name}: {_explain(error, model, table)}") from error


def _own_kind(system: Any, name: str) -> type[Kind]:
    """The kind of a class in a user's file, FILE.py:CLASS, which is imported."""
    file, _, chosen = system.partition(":") if isinstance(system, str) else ("", "", "")
    if not file.endswith(".py"):
        allowed = " or ".join(map(repr, kind_names()))
        raise ValueError(f"must be {allowed}, or 'FILE.py:CLASS' (got {_quoted(system)})")
    path = _place_of(file, name)
    found = {kind.__name__: kind for kind in _classes(import_file(path, f"lieint_kind_{path.stem}"))}
    if chosen not in found:
        there = ", ".join(found) or "none: a kind is a subclass of lieint_jax.app.kind.Kind"
        raise ValueError(f"{path} has no kind {_quoted(chosen)}; it has {there}")
    made = found[chosen]
    if made.build is Kind.build:
        own = {"make_system": (made.make_system, made.make_step), "start": (made.start,)}
        base = (Kind.make_system, Kind.make_step, Kind.start)
        if lacking := [method for method, ways in own.items() if all(way in base for way in ways)]:
            raise ValueError(f"{chosen} of {path} must define {' and '.join(lacking)}, as a kind does")
    return made


def from_results(table: dict[str, Any], name: str, own_kind: str = "") -> Any:
    """The scenario of the keys in a file of results.

    `own_kind` is its kind, FILE.py:CLASS, if it is a user's: a file of results must not choose what is imported.
    """
    if own_kind or table.get("system") in kind_names():
        return parse(table | ({"system": own_kind} if own_kind else {}), name, reads_files=False)
    raise ValueError(
        f"{name}: the run is of the kind {_quoted(table.get('system'))}, and a file of results does not choose what is "
        "imported: give --kind FILE.py:CLASS if it is yours"
    )


def schema() -> dict[str, Any]:
    """The JSON schema of a scenario file: one of the kinds of system, distinguished by the key `system`."""
    from pydantic.json_schema import models_json_schema

    found, definitions = models_json_schema([(kind, "validation") for kind in kinds().values()])
    for name, reference in zip(kinds(), found.values(), strict=True):
        keys = definitions["$defs"][reference["$ref"].rpartition("/")[2]]["properties"]
        keys["system"] |= {"const": name}
    return {"oneOf": list(found.values()), **definitions}


def table(name: str) -> dict[str, Any]:
    """The keys of the scenario shipped under `name`, or in the file `name`, unchecked; ValueError if there is none."""
    path = Path(name)
    if name in scenario_names():
        return archives.read_toml(_place_of_shipped(name), name)
    if not path.is_file():
        if path.suffix or len(path.parts) > 1:
            raise ValueError(f"there is no file {name}; `lieint list` shows the scenarios that need no file")
        raise ValueError(f"{_unknown_scenario(name)}; or give a .toml file")
    return archives.read_toml(path, name)


def shipped_file(name: str) -> str:
    """The text of the file of a shipped scenario; ValueError if there is none of this name."""
    if name not in scenario_names():
        raise ValueError(_unknown_scenario(name))
    return _place_of_shipped(name).read_text(encoding="utf-8")


def _place_of_shipped(name: str) -> Any:
    return resources.files(__name__).joinpath(f"{name}.toml")


def _unknown_scenario(name: str) -> str:
    near = difflib.get_close_matches(name, scenario_names(), 1)
    meant = f"did you mean {near[0]}? " if near else ""
    return f"there is no scenario {name!r}: {meant}`lieint list` shows all"


def _model_of(model: Any, key: str) -> Any:
    """The model of the table, or of the tables of a list, at a key of a model; None if there is none or are several."""
    annotation = model.model_fields[key].annotation if model is not None and key in model.model_fields else None
    inner = [x for x in (annotation, *get_args(annotation)) if isinstance(x, type) and issubclass(x, BaseModel)]
    return inner[0] if len(inner) == 1 else None


def _unknown_key(model: Any, place: tuple[int | str, ...]) -> str:
    """The message for a key that a model lacks: the key that is most like it, or two, and the allowed ones.

    None are named if there are several kinds of tables at its place.
    """
    *tables, key = map(str, (part for part in place if isinstance(part, str)))
    for part in tables:
        model = _model_of(model, part)
    if model is None:
        return "unknown key"
    allowed = list(dict.fromkeys([*model.model_fields, *model.files]))
    near = difflib.get_close_matches(key, allowed, 2)
    likeness = [difflib.SequenceMatcher(None, key, candidate).ratio() for candidate in near]
    meant = " or ".join(candidate for candidate, x in zip(near, likeness, strict=True) if x == likeness[0])
    return f"unknown key; {f'did you mean {meant}?; ' if meant else ''}allowed: {', '.join(allowed)}"


def _quoted(value: object) -> str:
    """A value of a file in a message: a text in quotes."""
    return _checks.printable(repr(value) if isinstance(value, str) else value)


def _component_keys(place: tuple[int | str, ...], table: dict[str, Any]) -> list[str]:
    """The numbers of a scenario, by their paths, whose components have the spread that the key at `place` gives."""
    owner, path = table, ""
    for part in place[: place.index(_SPREAD)]:
        owner = owner[part]  # pyright: ignore[reportArgumentType]
        path += f"{owner.get('name', int(part) + 1) if isinstance(part, int) else part}."
    tables = {"": owner, **{f"{name}.": x for name, x in owner.items() if isinstance(x, dict) and name != _SPREAD}}
    quantity = str(place[-1]).rpartition("_")[0]
    return [f"{path}{at}{key}" for at, x in tables.items() for key in x if key.rpartition("_")[0] == quantity]


def _explain(error: ValidationError, model: Any, table: dict[str, Any]) -> str:
    """The first problem of a validation in one line that names the key; for an unknown key, with the allowed ones."""
    problem, *others = sorted(error.errors(), key=lambda x: x["type"] != "extra_forbidden")  # a misspelled key first
    missing = [x for x in others if x["type"] == problem["type"] == "missing"]
    paths = ((_checks.printable(part) for part in x["loc"] if part != "[key]") for x in (problem, *missing))
    key = ", ".join(map(".".join, paths))
    without_value = problem["type"] in ("missing", "extra_forbidden") or not problem["loc"]
    given = "" if without_value else f" (got {_quoted(problem['input'])})"
    message = _checks.printable(problem["msg"], _MESSAGE)
    if problem["type"] == "extra_forbidden":
        message = _unknown_key(model, problem["loc"])
    elif problem["type"] == "missing":
        message = "keys missing" if missing else "key missing"
    elif problem["type"] in ("model_type", "model_attributes_type", "dict_type"):
        message = f"must be a table, as below [{key}]"
    if problem["type"] == "float_type" and _SPREAD in problem["loc"][:-1] and isinstance(problem["input"], list):
        given += "".join(f"; in [spread], {name} accepts a list" for name in _component_keys(problem["loc"], table))
    more = f"; and {len(others) - len(missing)} more" if len(others) > len(missing) else ""
    return f"{key}{': ' if key else ''}{message.removeprefix('Value error, ')}{given}{more}".replace(_FOR_PYTHON, "")
