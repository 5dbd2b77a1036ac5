"""The catalogue of schemes."""

import importlib

from lieint_jax._discover import modules_with
from lieint_jax.schemes._shared.properties import SchemeProperties
from lieint_jax.types import Catalogue

__all__ = ["Catalogue", "SchemeProperties", "catalogue"]


def catalogue() -> Catalogue[SchemeProperties]:
    """The schemes as a table: what each integrates and conserves, its order, limit, names in the literature and source.

    Returns:
        A tuple of `SchemeProperties`, which prints as a table; `.markdown()` is one for a page.
    """
    modules = modules_with("examples", importlib.import_module("lieint_jax.schemes"))
    return Catalogue(module.PROPERTIES for module in modules.values())
