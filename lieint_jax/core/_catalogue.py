"""Catalogues: what schemes and systems declare of themselves, as a tuple of entries that prints as a table."""

from __future__ import annotations

from typing import Protocol, TypeVar

__all__ = ["Catalogue"]


class Entry(Protocol):
    """The declared properties of one scheme or system."""

    @property
    def columns(self) -> tuple[str, ...]:
        """The titles of its columns in a table."""
        ...

    def cells(self) -> tuple[str, ...]:
        """Its row in a table."""
        ...


_Entry = TypeVar("_Entry", bound=Entry)


class Catalogue(tuple[_Entry, ...]):
    """The declared properties of all schemes, or of all systems; `repr` and `markdown` are tables of them."""

    __slots__ = ()

    def __repr__(self) -> str:
        rows = self._rows()
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ("  ".join(x.ljust(n) for x, n in zip(row, widths, strict=True)).rstrip() for row in rows)
        return "\n".join(lines)

    def markdown(self, columns: int | None = None) -> str:
        """A table for a page, of all columns or the first ones; the first column is code."""
        title, *rows = [tuple(cell.replace("|", "\\|") for cell in row[:columns]) for row in self._rows()]
        body = [(f"`{name}`", *cells) for name, *cells in rows]
        return "\n".join(f"| {' | '.join(row)} |" for row in (title, ("---",) * len(title), *body))

    def _rows(self) -> list[tuple[str, ...]]:
        return [self[0].columns, *(entry.cells() for entry in self)]
