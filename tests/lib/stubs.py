"""What `__init__.pyi` says of a package whose names are discovered: type checkers and editors do not import.

`python tests/lib/stubs.py` writes these files.
"""

from pathlib import Path

import lieint_jax as li
from lieint_jax import _discover

ROOMS = (li.schemes, li.systems, li.torques, li.potentials, li.orbits, li.core)
_HEAD = "# Written by tests/lib/stubs.py: each module has its public names in __all__.\n\n"


def path(room):
    """The file."""
    return Path(room.__file__).with_suffix(".pyi")


def stub(room):
    """Its text."""
    names = [module.__name__ for module in _discover.modules_with("__all__", room).values()]
    return _HEAD + "".join(f"from {name} import *\n" for name in names)


if __name__ == "__main__":
    for room in ROOMS:
        path(room).write_text(stub(room), encoding="utf-8")
