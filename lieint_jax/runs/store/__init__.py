"""Read stores that others wrote, a folder NAME.zarr, a file NAME.zip or a URL, checked before they are read.

The command reads its files through these names. One that cannot be read raises `UnreadableError`, a ValueError whose
message is one sentence that names the file.
"""

from lieint_jax.runs._storage.files import open_storage
from lieint_jax.runs._storage.storage import Address, StoreOptions, Url, address
from lieint_jax.runs._storage.untrusted import UnreadableError, wrap_errors
from lieint_jax.runs.store._description import UnknownNameError
from lieint_jax.runs.store._reading import check_system, load_store, step_from_store

__all__ = [
    "Address",
    "StoreOptions",
    "UnknownNameError",
    "UnreadableError",
    "Url",
    "address",
    "check_system",
    "load_store",
    "open_storage",
    "step_from_store",
    "wrap_errors",
]
