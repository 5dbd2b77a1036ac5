"""The constants s and d of `preprocessed`, which correct the time of the discrete free body, as series in Δt.

With J of trace 1, e₂ the sum of products of two moments, e₃ = det J, C = ½Δt²|Π|² and H = Δt²·energy,

    s = 1 + Σ s_ab CᵃHᵇ/e₃ᵃ⁺ᵇ,    d = Σ d_ab CᵃHᵇ/e₃ᵃ⁺ᵇ

where s_ab and d_ab are polynomials of e₂ and e₃. `tests/lib/clock_series.py` derives them by exact rational arithmetic:
the discrete and the exact rotation of a step are expanded in Δt; of the three equations for each pair of constants, one
serves as a check. To Δt⁴ they are those of the literature, and their closed form is `_free_body.clock`.

Source: McLachlan & Zanna 2005, Found. Comput. Math. 5; Hairer & Vilmart 2006, J. Phys. A 39, for any order. The
coefficients here were derived independently.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from jax import Array, lax

from lieint_jax._numerics.arrays import Scalar

_Powers = tuple[int, int]
_Polynomials = Mapping[_Powers, Mapping[_Powers, float]]
_Series = Sequence[_Polynomials]

_LAST, _ALL = 0.02, 0.45  # the largest changes of J/J̃ by the last term, and by all, where the series hold

# (a, b), of C and H: {(i, j), of e₂ and e₃: coefficient}
_S: _Series = (
    {  # Δt²
        (1, 0): {(0, 0): 1 / 6},
        (0, 1): {(1, 0): -1 / 3},
    },
    {  # Δt⁴
        (2, 0): {(0, 0): 1 / 30, (1, 0): -1 / 10},
        (1, 1): {(0, 1): 2 / 15, (1, 0): -1 / 30},
        (0, 2): {(0, 1): -1 / 60, (2, 0): 1 / 30},
    },
    {  # Δt⁶
        (3, 0): {(0, 0): 17 / 2520, (0, 1): 5 / 126, (1, 0): -11 / 420},
        (2, 1): {(0, 1): -1 / 84, (1, 0): -1 / 70, (2, 0): 11 / 210},
        (1, 2): {(0, 1): 41 / 2520, (1, 1): -53 / 630, (2, 0): 1 / 420},
        (0, 3): {(0, 2): 1 / 35, (1, 1): 1 / 630, (3, 0): -1 / 630},
    },
    {  # Δt⁸
        (4, 0): {(0, 0): 31 / 22680, (0, 1): 97 / 15120, (1, 0): -19 / 2520, (2, 0): 1 / 120},
        (3, 1): {(0, 1): 47 / 7560, (1, 0): -11 / 3240, (1, 1): -47 / 945, (2, 0): 17 / 1260},
        (2, 2): {(0, 1): 1 / 2520, (0, 2): 53 / 1260, (1, 1): 1 / 252, (2, 0): 13 / 3780, (3, 0): -17 / 1260},
        (1, 3): {(0, 2): -23 / 1260, (1, 1): -11 / 1890, (2, 1): 23 / 945, (3, 0): -1 / 11340},
        (0, 4): {(0, 2): 17 / 5040, (1, 2): -3 / 280, (2, 1): -1 / 15120, (4, 0): 1 / 22680},
    },
)
_D: _Series = (
    {  # Δt²
        (1, 0): {(0, 0): -1 / 3},
        (0, 1): {(0, 0): 1 / 6},
    },
    {  # Δt⁴
        (2, 0): {(0, 0): -1 / 60},
        (1, 1): {(0, 0): -1 / 60, (1, 0): 2 / 15},
        (0, 2): {(0, 1): -1 / 10, (1, 0): -1 / 60},
    },
    {  # Δt⁶
        (3, 0): {(0, 0): -19 / 2520, (1, 0): 1 / 35},
        (2, 1): {(0, 0): 1 / 1260, (0, 1): -22 / 315, (1, 0): -1 / 1260},
        (1, 2): {(0, 1): 11 / 252, (1, 0): 13 / 2520, (2, 0): -8 / 315},
        (0, 3): {(0, 1): -13 / 1260, (1, 1): 1 / 42, (2, 0): 1 / 1260},
    },
    {  # Δt⁸
        (4, 0): {(0, 0): -61 / 45360, (0, 1): -61 / 4536, (1, 0): 3 / 560},
        (3, 1): {(0, 0): -1 / 45360, (0, 1): 19 / 1260, (1, 0): 37 / 7560, (2, 0): -2 / 105},
        (2, 2): {(0, 1): -19 / 1080, (1, 0): -1 / 1512, (1, 1): 89 / 1890, (2, 0): 19 / 7560},
        (1, 3): {(0, 1): 97 / 22680, (0, 2): -1 / 35, (1, 1): -23 / 1890, (2, 0): -1 / 1512, (3, 0): 8 / 2835},
        (0, 4): {(0, 2): 17 / 1680, (1, 1): -1 / 7560, (2, 1): -1 / 360, (3, 0): -1 / 45360},
    },
)


_FromOne = list[Any]  # 1.0, x, x², …


def constants(e2: Scalar, e3: Scalar, C: Scalar, H: Scalar, terms: int) -> tuple[Array, Array, Array]:
    """s and d over the trace of J with the terms to Δt²·ᵗᵉʳᵐˢ, 1 to 4, and whether the series are accurate; see above.

    The series are accepted where their last term changes 1/J̃ by 2 % at most, and all terms together by 45 %; for a
    single term, from which the size of the next cannot be estimated, the next term is evaluated instead. Of 800,000
    random accepted steps, |ΔtΩ| from 0.05 to 5, with moments up to 1 : 10⁶, none had an attitude error above 0.07 rad,
    in any order. For a ball that rotates by 90° per step, the end of the branch, all terms together are 63 %.
    """
    powers = [_powers(x) for x in (C / e3, H / e3, e2, e3)]
    checked = max(terms, 2)
    s, d = ([_term(polynomials, *powers) for polynomials in series[:checked]] for series in (_S, _D))
    total: tuple[Any, Any] = sum(s[:terms]), sum(d[:terms])
    holds = (_square(e2, s[-1], d[-1]) <= _LAST**2) & (_square(e2, *total) <= _ALL**2)
    return 1 + total[0], total[1], lax.stop_gradient(holds)


def _square(e2: Scalar, s: Array, d: Array) -> Array:
    """|s + dJ|², of the matrix by which s and d change J/J̃, for J of trace 1."""
    return 3 * s * s + 2 * s * d + (1 - 2 * e2) * d * d


def _powers(x: Array) -> _FromOne:
    """1, x, …, x⁴."""
    powers: _FromOne = [1.0, x]
    for _ in range(3):
        powers.append(powers[-1] * x)
    return powers


def _term(polynomials: _Polynomials, c: _FromOne, h: _FromOne, e2: _FromOne, e3: _FromOne) -> Any:
    return sum(
        c[a] * h[b] * sum(number * e2[i] * e3[j] for (i, j), number in polynomial.items())
        for (a, b), polynomial in polynomials.items()
    )
