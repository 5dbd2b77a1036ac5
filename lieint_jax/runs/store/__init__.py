"""Read files that others wrote: archives NAME.npz and stores NAME.zarr, checked before they are read, and TOML.

The application reads its files through these names. A file that cannot be read raises `UnreadableError`, a ValueError
whose message is one sentence that names the file.
"""

from lieint_jax.runs._storage.files import open_storage
from lieint_jax.runs._storage.open_archive import open_archive, write_archive, write_trajectory
from lieint_jax.runs._storage.storage import Address, StoreOptions, Url, address
from lieint_jax.runs._storage.untrusted import SUFFIXES, UnreadableError, parse_toml, read_toml, wrap_errors
from lieint_jax.runs.store._description import UnknownNameError
from lieint_jax.runs.store._reading import check_system, load_results, load_store, step_from_store

__all__ = [
    "SUFFIXES",
    "Address",
    "StoreOptions",
    "UnknownNameError",
    "UnreadableError",
    "Url",
    "address",
    "check_system",
    "load_results",
    "load_store",
    "open_archive",
    "open_storage",
    "parse_toml",
    "read_toml",
    "step_from_store",
    "wrap_errors",
    "write_archive",
    "write_trajectory",
]
