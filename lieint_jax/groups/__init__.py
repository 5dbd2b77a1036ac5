"""Lie groups: each has the functions of `types.Group`, in the same order."""

from lieint_jax.groups import catalogue, so3
from lieint_jax.groups.catalogue import (
    affine,
    heisenberg,
    hyperbolic_motions,
    product,
    special_euclidean,
    special_linear,
    special_orthogonal,
    special_unitary,
    symplectic,
    translations,
    upper_triangular,
)
from lieint_jax.groups.matrix import MatrixGroup, matrix

__all__ = [
    "MatrixGroup",
    "affine",
    "catalogue",
    "heisenberg",
    "hyperbolic_motions",
    "matrix",
    "product",
    "so3",
    "special_euclidean",
    "special_linear",
    "special_orthogonal",
    "special_unitary",
    "symplectic",
    "translations",
    "upper_triangular",
]
