"""Lie groups: each answers the questions of `types.Group` in the same order."""

from lieint_jax.groups import so3

__all__ = ["so3"]
