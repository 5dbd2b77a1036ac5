"""The members of a run in parts."""

from __future__ import annotations

import math
from typing import NamedTuple


class Split(NamedTuple):
    """The members of a run in parts of whole chunks.

    Attributes:
        members: their number.
        parts: the number of parts.
        chunk: the number of members in a chunk.
    """

    members: int
    parts: int
    chunk: int

    @classmethod
    def into_parts(cls, members: int, count: int, most: int) -> Split:
        """The split into `count` parts, with chunks of at most `most` members.

        Raises:
            ValueError: more parts than members.
        """
        if count > members:
            raise ValueError(f"a run of {members} member(s) has at most {members} part(s), got {count}")
        chunks = count * math.ceil(members / (count * most))
        chunk = math.ceil(members / chunks)
        return cls(members, count, chunk if math.ceil(members / chunk) == chunks else members // chunks)

    def chunks(self, k: int) -> range:
        """The chunks of part k."""
        every = math.ceil(self.members / self.chunk)
        return range(k * every // self.parts, (k + 1) * every // self.parts)

    def part(self, k: int) -> range:
        """The members of part k."""
        chunks = self.chunks(k)
        return range(chunks.start * self.chunk, min(chunks.stop * self.chunk, self.members))
