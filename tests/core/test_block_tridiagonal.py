"""Linear equations of chains: the matrix of a function, and its factors, compared with dense ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lieint_jax._numerics import block_tridiagonal


def chain(n, k=6, seed=0):
    """A dense matrix of a chain whose symmetric part is positive definite, (n, k, n, k)."""
    far = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))[:, None, :, None] > 1
    random = np.random.default_rng(seed).normal(size=(n, k, n, k))
    return np.where(far, 0, 0.3 * random) + 4 * np.eye(n * k).reshape(n, k, n, k)


def blocks_of(dense):
    n, k = dense.shape[:2]
    return block_tridiagonal.BlockTridiagonal.of(lambda v: jnp.tensordot(dense, v, 2), n, k, float)


@pytest.mark.parametrize("n", [1, 2, 7])
def test_a_chain_is_solved_like_its_dense_matrix(n):
    """Observed 1e-16 of 0.5."""
    dense, b = chain(n), np.cos(np.arange(6.0 * n)).reshape(n, 6)

    @jax.jit
    def solve(b):
        K = block_tridiagonal.factored(blocks_of(dense))
        return K.solve(b), K.positive

    expected = np.linalg.solve(dense.reshape(6 * n, 6 * n), b.ravel()).reshape(n, 6)
    found, positive = solve(b)
    np.testing.assert_allclose(found, expected, rtol=0, atol=6e-16)
    assert positive


@pytest.mark.parametrize("link", [0, 1, 4])
def test_a_negative_pivot_is_reported(link):
    K = blocks_of(chain(5))
    K = K._replace(diagonal=K.diagonal.at[link, 2, 2].set(-4.0))
    assert not block_tridiagonal.factored(K).positive
