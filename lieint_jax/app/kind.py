"""With what a kind of scenario is declared: `Kind`, the keys of files, quantities, pictures.

A kind is a class, in the package or in a user's own file; a scenario names it by `system = "FILE.py:CLASS"`.

| | |
|---|---|
| `Kind`, `BodyKind`, `TopKind` | the keys of every scenario; of a rigid body, with state and spread; in a potential |
| `Table`, `Spread`, `NumberSpread`, `RateSpread`, `RotationSpread`, `GivenRate`, `Published` | tables of keys |
| `PositiveFloat`, `NonNegative`, `Triple`, `PositiveTriple`, `Direction`, `UnitVector`, `Moments`, … | values of keys |
| `checked` | a key with a check of its own |
| `quantity`, `picture`, `for_last_run` | mark methods: a measured quantity, a picture, a value computed once |
| `Conserved`, `Quantity` | rows of the report |
| `series`, `nominal_state`, `nominal_system` | functions of a run |
| `draw_members`, `draw_errors`, `draw_changes`, `draw_on_sphere`, `draw_paths`, `draw_histogram` | panels of pictures |
"""

from lieint_jax.app.scenarios._body import BodyKind, TopKind
from lieint_jax.app.scenarios._keys import (
    Direction,
    GivenRate,
    Moments,
    NonNegative,
    NumberSpread,
    PositiveFloat,
    PositiveInt,
    PositiveTriple,
    Published,
    RateSpread,
    RotationSpread,
    Spread,
    Table,
    Text,
    Triple,
    UnitVector,
    checked,
)
from lieint_jax.app.scenarios._kind import Kind, for_last_run, picture, quantity, step_of
from lieint_jax.app.scenarios._pictures import (
    draw_changes,
    draw_errors,
    draw_histogram,
    draw_members,
    draw_on_sphere,
    draw_paths,
)
from lieint_jax.app.scenarios._report import Conserved, Quantity
from lieint_jax.app.scenarios._runs import nominal_state, nominal_system, series

__all__ = [
    "BodyKind",
    "Conserved",
    "Direction",
    "GivenRate",
    "Kind",
    "Moments",
    "NonNegative",
    "NumberSpread",
    "PositiveFloat",
    "PositiveInt",
    "PositiveTriple",
    "Published",
    "Quantity",
    "RateSpread",
    "RotationSpread",
    "Spread",
    "Table",
    "Text",
    "TopKind",
    "Triple",
    "UnitVector",
    "checked",
    "draw_changes",
    "draw_errors",
    "draw_histogram",
    "draw_members",
    "draw_on_sphere",
    "draw_paths",
    "for_last_run",
    "nominal_state",
    "nominal_system",
    "picture",
    "quantity",
    "series",
    "step_of",
]
