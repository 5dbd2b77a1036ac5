"""Schemes: each returns a `core.Step` for a system. "Conserved" means to round-off, in runs of any length.

Of torqued bodies `torqued_midpoint` conserves the energy less work. `compose` raises the order of any symmetric step of
order 2 to 4 … 10, and `gauss`, `nystrom`, `preprocessed`, `extrapolate`, `kepler_splitting` take an order or a number
of stages. `so3_alpha` and `group_alpha` are the paper's families, for study: their order is 1 where α ≠ ½.

A scheme raises ValueError for a system whose equations it does not integrate. `lieint check SYSTEM` measures what each
conserves. What they declare, with names in the literature and sources by `catalogue()`:
"""

from lieint_jax._discover import publish as _publish
from lieint_jax.schemes._catalogue import catalogue

__all__ = _publish(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
__dir__ = __all__.copy
__doc__ = f"{__doc__}\n{catalogue().markdown()}\n"
