"""Arithmetic of small matrices with structural zeros, against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lieint_jax._numerics import small_linalg as la
from lieint_jax._numerics.vectors import Matrix, Vector


def rows(M):
    return la.unrolled(jnp.array(M))


def flipped(M):
    """A matrix with its last two rows reversed, so that for d > 1 its determinant keeps its sign."""
    if isinstance(M, Matrix):
        return Matrix((*M[:-2], *(-row for row in M[-2:])))
    return M.at[-2:].multiply(-1)


@pytest.mark.long
@pytest.mark.parametrize("d", [1, 2, 3, 4, 6, 7])
def test_elimination_solves_as_numpy_and_finds_the_signs_of_pivots(d):
    """Of a metric less something nearly skew, as Newton's matrices are; whole ones go to the library."""
    rng = np.random.default_rng(d)
    A, B = rng.normal(size=(2, d, d))
    K, b = A @ A.T / d + np.eye(d) + 0.3 * (B - B.T), rng.normal(size=d)
    for made, right in ((rows(K), la.unrolled(jnp.array(b))), (jnp.array(K), jnp.array(b))):
        found = la.factored(made)
        np.testing.assert_allclose(np.stack(found.solve(right)), np.linalg.solve(K, b), rtol=1e-13)
        assert found.positive
        assert not la.factored(flipped(made)).positive
        if d <= 4:
            assert float(la.determinant(made)) == pytest.approx(np.linalg.det(K), rel=1e-13, abs=0)


@pytest.mark.long
def test_materialized_changes_no_number():
    x = Vector([jnp.array(3.0), 0.0, jnp.array(-0.1), 1.0])
    held = la.materialized(x)
    assert [float(a) for a in held] == [float(a) for a in x]
    assert held[1] == 0.0  # what is known stays known
    assert isinstance(held[1], float)
    slopes = jax.jacrev(lambda v: jnp.stack(la.materialized(la.materialized(Vector([v[0] * v[1], v[1]])))))(
        jnp.array([2.0, 5.0])
    )
    np.testing.assert_array_equal(slopes, [[5.0, 2.0], [0.0, 1.0]])
    assert la.materialized(Vector([0.0, 1.0])) == (0.0, 1.0)
    whole = jnp.ones(3)
    assert la.materialized(whole) is whole


def test_columns_of_a_linear_function_have_no_products_with_zeros():
    """So what is not finite in one column stays there."""
    A = np.arange(1.0, 7.0).reshape(2, 3)
    A[0, 1] = np.nan

    def linear(*x):
        return [sum(a * y for a, y in zip(row, x, strict=True)) for row in A]

    np.testing.assert_array_equal(np.transpose(la.columns(linear, 3, jnp.result_type(float))), A)


def test_sums_of_vectors_omit_zeros():
    x, y = Vector([jnp.array(1.0), 0.0]), Vector([jnp.array(2.0), jnp.array(3.0)])
    program = jax.make_jaxpr(lambda a, b: Vector([a, 0.0]) - 2.0 * Vector([b, 0.0]) + Vector([0.0, 1.0]) * a)(1.0, 2.0)
    assert len(program.eqns) == 2  # 2b, and a − 2b: the second entry is a
    assert [float(a) for a in x - 2.0 * y] == [-3.0, -6.0]
    assert [float(a) for a in la.map_entries(jnp.maximum, x, y)] == [2.0, 3.0]
    assert float(x @ y) == 2.0
