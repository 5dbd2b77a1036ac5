"""The catalogue of systems."""

import importlib

from lieint_jax._discover import modules_with
from lieint_jax.systems._shared.properties import SystemProperties
from lieint_jax.types import Catalogue

__all__ = ["SystemProperties", "catalogue"]


def catalogue() -> Catalogue[SystemProperties]:
    """The systems as a table: what each models and conserves, its phase space, names in the literature and source.

    Returns:
        A tuple of `SystemProperties`, which prints as a table; `.markdown()` is one for a page.
    """
    modules = modules_with("examples", importlib.import_module("lieint_jax.systems"))
    return Catalogue(module.PROPERTIES for module in modules.values())
