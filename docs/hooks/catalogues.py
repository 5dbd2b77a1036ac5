"""Tables of what the package declares, where a page has a mark.

`<!-- li.schemes.catalogue() -->`, that of the systems likewise, and `<!-- lieint_jax._numerics.arrays -->`.
"""

from typing import Annotated, get_args, get_origin

import lieint_jax as li
from lieint_jax._numerics import arrays as shapes

TABLES = {"schemes": li.schemes.catalogue, "systems": li.systems.catalogue}


def on_page_markdown(markdown, **_):
    """Put each table where its mark is."""
    for name, catalogue in TABLES.items():
        mark = f"<!-- li.{name}.catalogue() -->"
        if mark in markdown:
            markdown = markdown.replace(mark, f"{catalogue().markdown()}\n\n{_literature(catalogue())}")
    return markdown.replace("<!-- lieint_jax._numerics.arrays -->", _shapes())


def _literature(catalogue):
    """The names in the literature, and the sources."""
    rows = [f"| `{entry.name}` | {'; '.join(entry.aliases)} | {entry.source} |" for entry in catalogue]
    return "\n".join(["| | names in the literature | source |", "|---|---|---|", *rows])


def _shapes():
    rows = [f"| `{name}` | {shape} |" for name, value in vars(shapes).items() if (shape := _shape(value))]
    return "\n".join(["| name | shape |", "|---|---|", *rows])


def _shape(value):
    """The shape of an annotation, or of each part of a union; empty of anything else."""
    if get_origin(value) is Annotated:
        sizes = value.__metadata__[-1].split()
        return f"`({', '.join(sizes)}{',' if len(sizes) == 1 else ''})`"
    return " or ".join(filter(None, map(_shape, get_args(value))))
