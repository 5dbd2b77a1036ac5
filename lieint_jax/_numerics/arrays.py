"""The shapes of arrays in signatures: `Quaternion` is an array (4,), `Matrix3` an array (3, 3).

They are the shapes for one body at one instant. Inside `jax.vmap` the arrays have these shapes too. Equal letters are
equal sizes: the arguments `Poses` and `Masses` of one function have the same number of rows, N.

A type checker sees arrays; the package needs no jaxtyping. At run time each name is a
`typing.Annotated[Array, "Float", shape]`, which the tests convert to the type of jaxtyping to check every call.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar

from jax import Array

if TYPE_CHECKING:
    from typing import Annotated as Bool
    from typing import Annotated as Float
else:

    class _Shaped:
        """Stands for `jaxtyping.Float` or `Bool`: an array type and a shape in square brackets."""

        def __class_getitem__(cls, item: tuple[type, str]) -> object:
            array, shape = item
            return Annotated[array, cls.__name__, shape]

    class Float(_Shaped):
        """An array of real numbers."""

    class Bool(_Shaped):
        """An array of truth values."""


_T = TypeVar("_T")
Converted: TypeAlias = Annotated[_T, "converted"]  # a field that the constructor makes a _T from what is given
Calls: TypeAlias = dict[str, partial[Any]]  # the `examples()` of functions, by names
PyTree: TypeAlias = Any  # a tree whose leaves are arrays, such as the parameters of a fit

Scalar: TypeAlias = Float[Array, ""]
Time: TypeAlias = Float[Array, ""]
Flag: TypeAlias = Bool[Array, ""]

Vector3: TypeAlias = Float[Array, "3"]
Quaternion: TypeAlias = Float[Array, "4"]  # w, x, y, z
Matrix3: TypeAlias = Float[Array, "3 3"]
Vector6: TypeAlias = Float[Array, "6"]
Inertia: TypeAlias = Vector3 | Matrix3  # principal moments, or a symmetric tensor

AlgebraVector: TypeAlias = Float[Array, "d"]  # in the basis of the algebra
DualVector: TypeAlias = Float[Array, "d"]  # in the dual basis
AlgebraMatrix: TypeAlias = Float[Array, "d d"]
Unrolled: TypeAlias = PyTree  # a vector or a matrix: lists of scalars, or an array
SquareMatrix: TypeAlias = Float[Array, "n n"]  # an element of a matrix group
GroupElement: TypeAlias = Quaternion | SquareMatrix

PhaseVector: TypeAlias = Float[Array, "dim"]  # in the coordinates of a phase space
PhaseMatrix: TypeAlias = Float[Array, "dim dim"]
TangentVectors: TypeAlias = Float[Array, "dim columns"]
MomentumMap: TypeAlias = Float[Array, "k"]

MatrixSeries: TypeAlias = Float[Array, "times n n"]

Masses: TypeAlias = Float[Array, "N"]
Positions: TypeAlias = Float[Array, "N 3"]
Rotations: TypeAlias = Float[Array, "N 3 3"]
Poses: TypeAlias = Float[Array, "N 7"]  # position and quaternion of each body
PoseMomenta: TypeAlias = Float[Array, "N 6"]  # linear and spatial angular momentum of each body
