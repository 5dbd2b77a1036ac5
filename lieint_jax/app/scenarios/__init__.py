"""Scenario files (*.toml), shipped or the user's own: from a file to a step, a batch of states and a report.

A scenario is a system, a scheme, a time step and an ensemble of initial states; it may hold published values and
observations to compare with the results. `scenario_names` lists the shipped ones. The keys of all scenarios are in
`_common.py`; each kind of system is one module, named like the file's `system` key, which declares

| name | |
|---|---|
| `Scenario` | a pydantic model of its keys, a subclass of `_common.Common` |
| `build(scenario, indices=None)` | the step, and the initial states of all members or of some; member 0 is nominal |
| `conserved(scenario, system, run)` | what the motion conserves, as a list of `_report.Conserved` |
| `quantities(scenario, system, run)` | what is measured, as a list of `_report.Quantity` |
| `remarks(scenario, step, run)` | further lines of the report |
| `PICTURES` | functions (scenario, step, run) ↦ figure, by the suffix of their file names; see `_pictures.picture` |
| `STEP_AXIS` | 0 where every member has its own system: the leaves of the step have the member axis, and `build` |
| | has no `indices`; None where all share one, also where `[spread]` names numbers |
| `CERTIFIED` | False where `lieint run` prints no certificate: control and friction conserve the energy balance only |

Only the first two and `PICTURES` are required. A kind with another form of report has `report(scenario, step, run)`.
Where `[spread]` names numbers of the scenario (`_spread`), the step has the member axis too: `conserved` and
`quantities` are then called for each member alone; `remarks` and pictures use `for_member` for the nominal one.
"""

from __future__ import annotations

import difflib
import sys
from importlib import resources
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

import jax
import numpy as np
from pydantic import BaseModel, ValidationError

from lieint_jax import _checks, _discover
from lieint_jax.app.printer import readable
from lieint_jax.app.scenarios import _report, _spread
from lieint_jax.app.scenarios._common import Common
from lieint_jax.app.scenarios._runs import select_member
from lieint_jax.runs import store as archives
from lieint_jax.types import State, Step, Trajectory

_OLD_KEYS = {"angular_velocity": "angular_velocity_rad"}  # of results of version 0.1
_MESSAGE = 1000  # characters of a message about a key
_SPREAD = "spread"
_FOR_PYTHON = "; use jax.vmap for batches"  # advice that does not apply to a file


def scenario_names() -> list[str]:
    """The names of the shipped scenarios."""
    files = resources.files(__name__).iterdir()
    return sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))


def kinds() -> dict[str, ModuleType]:
    """The modules of this package, by the `system` key of their scenarios."""
    return _discover.public_modules(sys.modules[__name__])


def kind(scenario: Common) -> ModuleType:
    """The module for a scenario's kind of system."""
    return kinds()[scenario.system]


def build(scenario: Common) -> tuple[Step, State]:
    """The step and the batch of initial states; member 0 is the nominal state."""
    return kind(scenario).build(scenario)


def states_of(scenario: Common, indices: np.ndarray) -> State:
    """The initial states of the members with these indices, for a kind whose members share one step."""
    return kind(scenario).build(scenario, indices)[1]


def shapes_of_states(scenario: Common) -> State:
    """The shapes of the initial states of all members, without computing them."""
    first = jax.eval_shape(lambda: states_of(scenario, np.arange(1)))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((scenario.members, *x.shape[1:])[: x.ndim], x.dtype), first)


def step_axis(scenario: Common) -> int | None:
    """The argument `step_axis` of `ensemble.run`: 0 if the leaves of the step have the member axis, else None."""
    return 0 if _systems_differ_by_spread(scenario) else getattr(kind(scenario), "STEP_AXIS", None)


def _systems_differ_by_spread(scenario: Common) -> bool:
    """Whether members have their own systems only because numbers of the scenario have a spread."""
    return bool(scenario.own_numbers()) and not hasattr(kind(scenario), "STEP_AXIS")


def members_numbers(scenario: Common) -> dict[str, np.ndarray]:
    """The numbers that differ between members, (members, …), by their paths."""
    return {".".join(path): values for path, values in _spread.draw_members(scenario).items()}


def build_first(scenario: Common, members: int) -> Step:
    """The step of the first `members` members of a run, or the one that all members share."""
    return build(scenario.model_copy(update={"members": 1 if step_axis(scenario) is None else members}))[0]


def report(scenario: Common, step: Step, run: Trajectory) -> str:
    """The text that reports a run: what is conserved, what was measured, and the remarks of the kind."""
    module, scenario = kind(scenario), readable(scenario)
    if hasattr(module, "report"):
        return module.report(scenario, step, run)
    conserved = _measured(module, "conserved", scenario, step.system, run)
    quantities = _measured(module, "quantities", scenario, step.system, run)
    return _report.text(scenario, conserved, quantities, _declared(module, "remarks", scenario, step, run))


def _measured(module: ModuleType, name: str, scenario: Common, system: Any, run: Trajectory) -> list[Any]:
    """The declaration of a kind under a name for a run: of one system, or of the members' systems one by one."""
    if not _systems_differ_by_spread(scenario):
        return _declared(module, name, scenario, system, run)
    each = enumerate(_spread.member_scenarios(scenario))
    return _report.join_members(
        [
            _declared(module, name, its, _spread.for_member(scenario, system, m), select_member(run, m))
            for m, its in each
        ]
    )


def _declared(module: ModuleType, name: str, *arguments: Any) -> list[Any]:
    """The value of a kind's declaration under a name; empty if there is none."""
    return getattr(module, name)(*arguments) if hasattr(module, name) else []


def load(name: str, **changes: Any) -> Any:
    """The scenario shipped under `name`, or the one in the file `name`, with `changes` to its keys.

    Returns:
        A `Scenario` of the module that its `system` key names.

    Raises:
        ValueError: no such scenario, not TOML, or a key is missing, unknown or out of range: the message names it.
    """
    return parse(table(name) | {key: value for key, value in changes.items() if value is not None}, name)


def parse(table: dict[str, Any], name: str) -> Any:
    """The scenario of a table of keys; error messages begin with `name`."""
    if "system" not in table:
        raise ValueError(f"{name}: system: key missing")
    if not isinstance(table["system"], str) or table["system"] not in kinds():
        allowed = " or ".join(map(repr, kinds()))
        raise ValueError(f"{name}: system: must be {allowed} (got {_quoted(table['system'])})")
    return validate(kinds()[table["system"]].Scenario, table, name)


def validate(model: Any, table: dict[str, Any], name: str) -> Any:
    """A table of keys as a pydantic model; a ValueError that begins with `name` names the first wrong key."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        raise ValueError(f"{name}: {_explain(error, model, table)}") from error


def from_results(table: dict[str, Any], name: str) -> Any:
    """The scenario in a file of results; keys of version 0.1, which have no units, are renamed."""

    def renamed(tree: Any) -> Any:
        if isinstance(tree, list):
            return [renamed(value) for value in tree]
        if isinstance(tree, dict):
            return {_OLD_KEYS.get(key, key): renamed(value) for key, value in tree.items()}
        return tree

    return parse(renamed(table), name)


def schema() -> dict[str, Any]:
    """The JSON schema of a scenario file: one of the kinds of system, distinguished by the key `system`."""
    from pydantic.json_schema import models_json_schema

    found, definitions = models_json_schema([(module.Scenario, "validation") for module in kinds().values()])
    return {"oneOf": list(found.values()), **definitions}


def table(name: str) -> dict[str, Any]:
    """The keys of the scenario shipped under `name`, or in the file `name`, unchecked; ValueError if there is none."""
    path = Path(name)
    if name in scenario_names():
        return archives.read_toml(resources.files(__name__).joinpath(f"{name}.toml"), name)
    if not path.is_file():
        if path.suffix or len(path.parts) > 1:
            raise ValueError(f"there is no file {name}; `lieint list` shows the scenarios that need no file")
        near = difflib.get_close_matches(name, scenario_names(), 1)
        meant = f"did you mean {near[0]}? " if near else ""
        raise ValueError(f"there is no scenario {name!r}: {meant}`lieint list` shows all; or give a .toml file")
    return archives.read_toml(path, name)


def _keys(model: Any, path: list[str]) -> list[str]:
    """The keys of the table at `path` in a model; none if there are several kinds of such tables."""
    for part in path:
        annotation = model.model_fields[part].annotation if part in getattr(model, "model_fields", {}) else None
        inner = [x for x in (annotation, *get_args(annotation)) if isinstance(x, type) and issubclass(x, BaseModel)]
        if len(inner) != 1:
            return []
        model = inner[0]
    return list(model.model_fields)


def _nearest(key: str, allowed: list[str]) -> list[str]:
    """The allowed key that is most like `key`, or two that are equally like it; none if none is like it."""
    near = difflib.get_close_matches(key, allowed, 2)
    likeness = [difflib.SequenceMatcher(None, key, candidate).ratio() for candidate in near]
    return [candidate for candidate, x in zip(near, likeness, strict=True) if x == likeness[0]]


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
    problem, *others = error.errors()
    key = "".join(f"{_checks.printable(part)}." for part in problem["loc"] if part != "[key]").removesuffix(".")
    without_value = problem["type"] in ("missing", "extra_forbidden") or not problem["loc"]
    given = "" if without_value else f" (got {_quoted(problem['input'])})"
    message = {"extra_forbidden": "unknown key", "missing": "key missing"}.get(
        problem["type"], _checks.printable(problem["msg"], _MESSAGE)
    )
    if problem["type"] == "extra_forbidden":
        allowed = _keys(model, [part for part in problem["loc"][:-1] if isinstance(part, str)])
        near = " or ".join(_nearest(str(problem["loc"][-1]), allowed))
        message += f"; did you mean {near}?" if near else ""
        message += f"; allowed: {', '.join(allowed)}" if allowed else ""
    if problem["type"] == "float_type" and _SPREAD in problem["loc"][:-1] and isinstance(problem["input"], list):
        given += "".join(f"; in [spread], {name} accepts a list" for name in _component_keys(problem["loc"], table))
    more = f"; and {len(others)} more" if others else ""
    return f"{key}{': ' if key else ''}{message.removeprefix('Value error, ')}{given}{more}".replace(_FOR_PYTHON, "")
