"""A published case: the numbers of another code, and the same quantities computed by this package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Comparison(NamedTuple):
    """One quantity of a case: the published numbers and ours."""

    quantity: str  # its name, with its time and unit
    theirs: np.ndarray
    ours: np.ndarray
    digits: float  # half a unit of the last printed digit, 0 if they are printed in full

    @property
    def difference(self) -> float:
        """The largest absolute difference between the published numbers and ours."""
        return float(np.abs(self.theirs - self.ours).max())


@dataclass(frozen=True)
class Case:
    """A case that another code has published.

    `@partial(Case, code=…, …)` makes one of the function that computes it.
    """

    compute: Callable[[], Mapping[str, ArrayLike]]  # () ↦ quantity ↦ our numbers
    code: str  # the code and the name of the case there
    source: str  # repository, file and commit, or paper
    scheme: str  # the scheme, with its step size, that computes the numbers here
    published: Mapping[str, ArrayLike]  # quantity ↦ the numbers as published
    limit: str  # the error that limits the agreement
    digits: float = 0.0  # half a unit of the last printed digit, 0 if the numbers are printed in full

    def compare(self) -> list[Comparison]:
        """Compute all quantities, and compare each with the published numbers."""
        ours = self.compute()
        return [
            Comparison(name, np.asarray(value, float), np.asarray(ours[name], float), self.digits)
            for name, value in self.published.items()
        ]
