"""The coefficients of `schemes._shared.clock_coefficients`, derived by exact rational arithmetic.

A body of inertia J turns from Π in a time h by the rotation with the Rodrigues vector g (the tangent of half the angle,
along the axis), in a step of the symplectic scheme of the inertia J̃ by that with v:

    ġ = ½(Ω + g × Ω + (g·Ω)g),  Π̇ = Π × Ω,  Ω = J⁻¹Π;        v = ½h J̃⁻¹(Π − v × Π + (v·Π)v),  1/J̃_j = s/J_j + d

Both are power series in h with rational coefficients if J and Π are rational. At each odd power three components give
the two next coefficients of s and d, and one equation that must hold. Those of enough J and Π give the polynomials.
"""

import random
from fractions import Fraction

LENGTH = 10  # powers of h, from 0; a shorter series is one of which the rest is not known yet


def times(a, b):
    return [sum(a[i] * b[k - i] for i in range(k + 1)) for k in range(min(len(a), len(b)))]


def plus(*series):
    return [sum(x) for x in zip(*series, strict=False)]


def scaled(k, a):
    return [k * x for x in a]


def cross(a, b):
    pairs = [((i + 1) % 3, (i + 2) % 3) for i in range(3)]
    return [plus(times(a[j], b[k]), scaled(-1, times(a[k], b[j]))) for j, k in pairs]


def dot(a, b):
    return plus(*(times(x, y) for x, y in zip(a, b, strict=True)))


def constant(x):
    return [x] + [Fraction(0)] * (LENGTH - 1)


def integral(a, start):
    return [start] + [x / (k + 1) for k, x in enumerate(a)]


def exact_turn(J, P):
    Pi, g = [[p] for p in P], [[Fraction(0)]] * 3
    for _ in range(LENGTH - 1):
        Omega = [scaled(1 / j, x) for j, x in zip(J, Pi, strict=True)]
        along, across, rate = dot(g, Omega), cross(g, Omega), cross(Pi, Omega)
        g_rate = [scaled(Fraction(1, 2), plus(Omega[i], across[i], times(g[i], along))) for i in range(3)]
        Pi, g = [integral(rate[i], P[i]) for i in range(3)], [integral(x, Fraction(0)) for x in g_rate]
    return g


def discrete_turn(J, P, s, d, length):
    Pi, v = [constant(p) for p in P], [[Fraction(0)]] * 3
    for _ in range(length - 1):
        along, across = dot(v, Pi), cross(v, Pi)
        bracket = [plus(Pi[i], scaled(-1, across[i]), times(v[i], along)) for i in range(3)]
        inverse = [plus(scaled(1 / j, s), d) for j in J]
        v = [[Fraction(0), *scaled(Fraction(1, 2), times(inverse[i], bracket[i]))] for i in range(3)]
    return v


def clock(J, P, terms):
    """The coefficients of h², h⁴, … of s and d."""
    g, s, d = exact_turn(J, P), constant(Fraction(1)), constant(Fraction(0))
    for m in range(1, terms + 1):
        v = discrete_turn(J, P, s, d, 2 * m + 2)
        y = [2 * (g[i][2 * m + 1] - v[i][2 * m + 1]) / P[i] for i in range(3)]
        s[2 * m] = (y[0] - y[1]) / (1 / J[0] - 1 / J[1])
        d[2 * m] = y[0] - s[2 * m] / J[0]
        assert s[2 * m] / J[2] + d[2 * m] == y[2]
    return s[2::2], d[2::2]


def samples(count, terms):
    """For random J and Π: C, H, the three symmetric functions of J, and the coefficients of s and d."""
    rng, found = random.Random(1), []
    while len(found) < count:
        J = [Fraction(j) for j in rng.sample(range(1, 10), 3)]
        P = [Fraction(rng.choice((-4, -3, -2, -1, 1, 2, 3, 4))) for _ in range(3)]
        C, H = sum(p * p for p in P) / 2, sum(p * p / j for p, j in zip(P, J, strict=True)) / 2
        symmetric = sum(J), J[0] * J[1] + J[1] * J[2] + J[2] * J[0], J[0] * J[1] * J[2]
        found.append((C, H, symmetric, clock(J, P, terms)))
    return found


def series(kind, m, cases):
    """The term Δt²ᵐ of s (kind 0) or d (kind 1) as {(a, b): {(i, j): coefficient}}, the trace of J being 1."""
    unknowns = [
        (m - b, b, k, i, j)
        for b in range(m + 1)
        for i in range(3 * m)
        for j in range(3 * m)
        if (k := m + b - kind - 2 * i - 3 * j) >= 0
    ]
    rows = [
        [C**a * H**b * e1**k * e2**i * e3**j / e3**m for a, b, k, i, j in unknowns] + [found[kind][m - 1]]
        for C, H, (e1, e2, e3), found in cases
    ]
    solved: dict = {}
    for (a, b, _, i, j), x in zip(unknowns, solution(rows), strict=True):
        if x:
            solved.setdefault((a, b), {})[i, j] = x
    return solved


def solution(rows):
    """Of an overdetermined linear system, each row with its right-hand side; all equations must hold."""
    width = len(rows[0]) - 1
    for column in range(width):
        pivot = next(i for i in range(column, len(rows)) if rows[i][column])
        rows[column], rows[pivot] = rows[pivot], rows[column]
        rows[column] = [x / rows[column][column] for x in rows[column]]
        for i, row in enumerate(rows):
            if i != column and row[column]:
                rows[i] = [x - row[column] * y for x, y in zip(row, rows[column], strict=True)]
    assert not any(any(row) for row in rows[width:])
    return [row[width] for row in rows[:width]]
