"""What a user says about a store: where it is, and what is written beside the results."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from lieint_jax.runs.store._storage import address


class StoreOptions(NamedTuple):
    """The path of a store, and attributes that are written with the results.

    Attributes:
        path: a folder or a URL, whose name ends in .zarr.
        attributes: values for JSON, such as a title. The key "scenario" describes the run: a run with another scenario
            cannot resume it.
        time_unit: the unit of dt.
    """

    path: str | Path
    attributes: Mapping[str, Any] = {}
    time_unit: str = "1"


def checked_path(place: str | Path) -> Any:
    """The path or URL of a store, checked as far as is possible before it exists."""
    path = address(place)
    if path.suffix != ".zarr":
        raise ValueError(f"a store is a folder that ends in .zarr, got {path}")
    if isinstance(path, Path) and os.path.lexists(path) and not os.path.exists(path):
        raise ValueError(f"{path} is a link to {path.readlink()}, which does not exist; remove it or make that folder")
    return path


def check_json(attributes: Mapping[str, object]) -> None:
    """Raise ValueError if the user's attributes of a store are not values for JSON."""
    for key, value in attributes.items():
        try:
            if not isinstance(key, str):
                raise TypeError(f"names must be strings, got {key!r}")
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"attributes of a store must be values for JSON; {key!r} is not: {error}") from None
