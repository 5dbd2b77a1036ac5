"""Lie groups. Each has the functions of `core.Group`, in the same order.

`so3` is the rotation group as unit quaternions. All others are matrix groups, with coordinates in a basis of the
algebra: `special_orthogonal(n)`, `special_unitary(n)`, `special_euclidean(n)`, `special_linear(n)`, `symplectic(n)`,
`affine(n)`, `heisenberg(n)`, `hyperbolic_motions()`, `translations(n)`, `upper_triangular(n)`, the `product` of two,
and custom groups: `matrix(basis)`, which checks that the basis closes under the bracket.
"""

from lieint_jax.groups import catalogue, so3
from lieint_jax.groups._matrix import MatrixGroup, matrix
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
__dir__ = __all__.copy
