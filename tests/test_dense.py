"""Arithmetic of small matrices with structural zeros, against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lieint_jax import dense


def rows(M):
    return dense.as_list(jnp.array(M))


@pytest.mark.parametrize("d", [1, 2, 3, 4, 6, 7])
def test_elimination_and_determinant(d):
    """Of a metric less something nearly skew, as Newton's matrices are; whole ones go to the library."""
    rng = np.random.default_rng(d)
    A, B = rng.normal(size=(2, d, d))
    K, b = A @ A.T / d + np.eye(d) + 0.3 * (B - B.T), rng.normal(size=d)
    for made, right in ((rows(K), dense.as_list(jnp.array(b))), (jnp.array(K), jnp.array(b))):
        found = dense.factored(made)
        np.testing.assert_allclose(np.stack(found.solve(right)), np.linalg.solve(K, b), rtol=1e-13)
        assert float(found.determinant) == pytest.approx(np.linalg.det(K), rel=1e-13)
        if d <= 4:
            assert float(dense.determinant(made)) == pytest.approx(np.linalg.det(K), rel=1e-13)


def test_settled_changes_nothing_but_when_it_is_worked_out():
    x = [jnp.array(3.0), 0.0, jnp.array(-0.1), 1.0]
    held = dense.settled(x)
    assert [float(a) for a in held] == [float(a) for a in x]
    assert held[1] == 0.0  # what is known stays known
    assert isinstance(held[1], float)
    slopes = jax.jacrev(lambda v: jnp.stack(dense.settled(dense.settled([v[0] * v[1], v[1]]))))(jnp.array([2.0, 5.0]))
    np.testing.assert_array_equal(slopes, [[5.0, 2.0], [0.0, 1.0]])
    assert dense.settled([0.0, 1.0]) == [0.0, 1.0]
    whole = jnp.ones(3)
    assert dense.settled(whole) is whole


def test_sums_of_vectors():
    x, y = [jnp.array(1.0), 0.0], [jnp.array(2.0), jnp.array(3.0)]
    assert [float(a) for a in dense.plus(x, (-2.0, y))] == [-3.0, -6.0]
    np.testing.assert_array_equal(dense.plus((2.0, jnp.ones(2)), jnp.ones(2)), [3, 3])
    assert [float(a) for a in dense.scaled(2.0, y)] == [4.0, 6.0]
    assert [float(a) for a in dense.each(jnp.maximum, x, y)] == [2.0, 3.0]
