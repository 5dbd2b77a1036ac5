"""Displacements between two states as the differences of their entries."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from lieint_jax.core import State


class ByEntries:
    """A phase space in which a displacement is the differences of all entries of q and p."""

    def displacement(self, start: State, end: State) -> Array:
        """The differences of all entries, shape (n,)."""
        return jnp.concatenate([(end.q - start.q).ravel(), (end.p - start.p).ravel()])

    def displaced(self, start: State, displacement: Array) -> State:
        """The end of a displacement."""
        n = start.q.size
        q = start.q + displacement[:n].reshape(start.q.shape)
        return start._replace(q=q, p=start.p + displacement[n:].reshape(start.p.shape))
