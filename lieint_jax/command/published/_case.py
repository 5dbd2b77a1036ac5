"""A published case: the numbers of another code, and the same quantities computed by this package."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import date
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

Compute = Callable[[], Mapping[str, ArrayLike]]


@cache
def numbers() -> dict[str, dict[str, Any]]:
    """The published numbers by case, from `numbers.json`, which is their only place.

    An entry has its code, its source (repository, file and commit), the date on which the numbers were read from it,
    the limit of the agreement, digits (half a unit of the last printed digit, left out where all are printed), and its
    numbers by quantity, digit by digit as published. Where one is changed after it was read, it has a list of changes:
    date, quantity, was, reason.
    """
    entries = json.loads(Path(__file__).with_name("numbers.json").read_text(encoding="utf-8"))
    return {name: entry | {"read": date.fromisoformat(entry["read"])} for name, entry in entries.items()}


class Comparison(NamedTuple):
    """One quantity of a case: the published numbers and ours.

    Attributes:
        quantity: the name of the quantity, with its time and unit.
        theirs, ours: the published numbers and those of this package.
        digits: half a unit of the last printed digit, 0 if they are printed in full.
    """

    quantity: str
    theirs: np.ndarray
    ours: np.ndarray
    digits: float

    @property
    def difference(self) -> float:
        """The largest absolute difference between the published numbers and ours."""
        return float(np.abs(self.theirs - self.ours).max())


@dataclass(frozen=True)
class Case:
    """A case that another code has published.

    Attributes:
        code: the code and the name of the case there.
        source: repository, file and commit, or paper.
        scheme: the scheme, with its step size, that computes the numbers here.
        published: quantity ↦ the numbers as published.
        limit: the error that limits the agreement.
        compute: function of no argument that returns quantity ↦ our numbers.
        digits: half a unit of the last printed digit, 0 if the numbers are printed in full.
    """

    code: str
    source: str
    scheme: str
    published: Mapping[str, ArrayLike]
    limit: str
    compute: Compute
    digits: float = 0.0

    def compare(self) -> list[Comparison]:
        """Compute all quantities, and compare each with the published numbers."""
        ours = self.compute()
        return [
            Comparison(name, np.asarray(value, float), np.asarray(ours[name], float), self.digits)
            for name, value in self.published.items()
        ]


CASES: dict[str, Case] = {}


def case(name: str, scheme: str) -> Callable[[Compute], Compute]:
    """Declare that a function computes, by this scheme, the case of this name in `numbers.json`."""

    def declare(compute: Compute) -> Compute:
        given = numbers()[name]
        digits = given.get("digits", 0.0)
        CASES[name] = Case(given["code"], given["source"], scheme, given["numbers"], given["limit"], compute, digits)
        return compute

    return declare
