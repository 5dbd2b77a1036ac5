"""Random numbers that depend on a key and a count alone, as programs of single numbers.

The j-th 64 bits of step n are those of `jax.random.fold_in(jax.random.fold_in(key, n), j)`: Threefry-2x32 of 20 rounds
(Salmon et al. 2011), for which JAX has one operation. Here it is written out, so that ensembles can compile it as a
part of a program of single numbers. A state carries its key as real numbers below 2¹⁶, which float32 represents
exactly.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA
DIGITS = 4  # of a key, in base 2¹⁶

Key = tuple[Array, Array]  # two words of 32 bits


def digits(key: Array, dtype: Any) -> Array:
    """The key of `jax.random`, two words of 32 bits, as four real numbers below 2¹⁶, (4,)."""
    words = jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key
    parts = [part for word in (words[0], words[1]) for part in (word >> 16, word & 0xFFFF)]
    return jnp.stack(parts).astype(dtype)


def are_digits(x: Array | np.ndarray) -> Array | np.bool_:
    """Whether these are whole numbers from 0 to below 2¹⁶, a bool; x may be a NumPy array."""
    return ((x >= 0) & (x < 2**16) & (x % 1 == 0)).all()


def key_of(digits: Array) -> Key:
    """The key of these digits."""
    a, b, c, d = (word(digits[k]) for k in range(DIGITS))
    return (a << 16) | b, (c << 16) | d


def word(x: Array) -> Array:
    """A whole number below 2³² as a word; it has no derivative."""
    return lax.stop_gradient(x).astype(jnp.uint32)


def fold_in(key: Key, number: Array) -> Key:
    """The key of `jax.random.fold_in`."""
    return threefry(key, (jnp.zeros_like(number), number))


def threefry(key: Key, count: tuple[Array, Array]) -> Key:
    """Threefry-2x32 of 20 rounds."""
    keys = (key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(_PARITY))
    x, y = count[0] + keys[0], count[1] + keys[1]
    for block in range(5):
        for bits in _ROTATIONS[block % 2]:
            x = x + y
            y = ((y << bits) | (y >> (32 - bits))) ^ x
        x = x + keys[(block + 1) % 3]
        y = y + keys[(block + 2) % 3] + jnp.uint32(block + 1)
    return x, y


def uniform(key: Key, draws: Array, dtype: Any) -> Array:
    """Numbers in (0, 1], one of each of these draws; close to 0 they are as dense as floating-point numbers are."""
    x, y = fold_in((jnp.broadcast_to(key[0], draws.shape), jnp.broadcast_to(key[1], draws.shape)), draws)
    return fraction(x, y, dtype)


def fraction(x: Array, y: Array, dtype: Any) -> Array:
    """The number in (0, 1] of two words."""
    return (x.astype(dtype) + 0.5**32 * (y.astype(dtype) + 0.5)) * 0.5**32


def normal(key: Key, first: int, count: int, dtype: Any) -> Array:
    """Independent normal numbers by Box & Muller, (count,), of `draws_of(count)` draws from `first` on.

    They reach 9.5, the largest that 64 bits have.
    """
    pairs = (count + 1) // 2
    u = uniform(key, jnp.arange(first, first + 2 * pairs, dtype=jnp.uint32), dtype)
    size, angle = jnp.sqrt(-2 * jnp.log(u[:pairs])), 2 * math.pi * u[pairs:]
    return jnp.concatenate([size * jnp.cos(angle), size * jnp.sin(angle)])[:count]


def draws_of(count: int) -> int:
    """How many draws so many normal numbers need."""
    return count + count % 2
