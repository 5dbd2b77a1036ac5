"""Native elementary functions: errors in units of the last place, IEEE's special values, bits independent of lanes."""

import math
import warnings

import mpmath
import numpy as np
import pytest

pytest.importorskip("llvmlite")

from native_calls import DOUBLE, FLOAT, INPUTS, NativeLoops

from lieint_jax.native.functions import FUNCTIONS, coefficients

NAMES = [name for name in FUNCTIONS if name != "sincos"]

# In ulp; after each, the largest error among 100 000 to 600 000 points. A subnormal result is rounded twice.
BOUNDS = {
    "sin": 0.80,  # 0.772
    "cos": 0.77,  # 0.743
    "tan": 0.90,  # 0.784
    "asin": 0.80,  # 0.718
    "acos": 0.80,  # 0.757
    "atan": 0.77,  # 0.738
    "atan2": 0.79,  # 0.733, subnormal
    "sinh": 0.60,  # 0.569
    "cosh": 0.54,  # 0.525
    "tanh": 0.57,  # 0.555
    "asinh": 0.501,  # 0.50000
    "acosh": 0.501,  # 0.50002
    "atanh": 0.501,  # 0.50000
    "exp": 0.79,  # 0.723, subnormal; 0.659 else
    "exp2": 0.79,  # 0.735, subnormal
    "expm1": 0.66,  # 0.632
    "log": 0.64,  # 0.610
    "log1p": 0.501,  # 0.50000
    "cbrt": 0.501,  # 0.50000
    "pow": 0.79,  # 0.748
    "logistic": 0.79,  # 0.723, subnormal
}

EXACT = {
    "exp2": lambda x: mpmath.power(2, x),
    "pow": mpmath.power,
    "cbrt": lambda x: mpmath.sign(x) * mpmath.cbrt(abs(x)),
    "logistic": lambda x: 1 / (1 + mpmath.exp(-x)),
}
NUMPY = {f"a{name}": getattr(np, f"arc{name}") for name in ("sin", "cos", "tan", "tan2", "sinh", "cosh", "tanh")}
NUMPY["pow"] = np.power
NUMPY["logistic"] = lambda x: np.where(x < -690, np.exp(x), 1 / (1 + np.exp(-x)))
DOMAINS = {
    "log": (0, np.inf),
    "log1p": (-1, np.inf),
    "acosh": (1, np.inf),
    "pow": (0, np.inf),
    **dict.fromkeys(("asin", "acos", "atanh"), (-1, 1)),
}
LANES = (0, 4, 8, 16)


@pytest.fixture(scope="module")
def native():
    doubles = [(name, lanes, DOUBLE) for name in FUNCTIONS for lanes in LANES]
    return NativeLoops(doubles + [(name, 8, FLOAT) for name in NAMES])


def signed(rng, magnitudes):
    return magnitudes * rng.choice([-1.0, 1.0], len(magnitudes))


def near_quarter_turns(exponents):
    """The doubles m 2^e, m < 2⁵³, whose angle is the nearest to a multiple of π/2, by continued fractions."""
    found = []
    with mpmath.workprec(2400):
        for e in map(int, exponents):
            rest = mpmath.mpf(2) ** e / (mpmath.pi / 2)
            before, m = 1, 0
            while True:
                whole = int(mpmath.floor(rest))
                before, m, last = m, whole * m + before, m
                if m >= 2**53:
                    break
                rest = 1 / (rest - whole)
            found.append(math.ldexp(last, e))
    return np.array(found)


def points(name, count, rng):
    """Arguments: all magnitudes, the usual ranges, and the neighborhoods of zeros, poles and limits."""
    wide = signed(rng, np.exp2(rng.uniform(-1074, 1024, count)))
    middle = signed(rng, np.exp2(rng.uniform(-30, 30, count)))
    usual = rng.uniform(-10, 10, count)
    near_one = 1 - np.exp2(rng.uniform(-53, 0, count))
    steps = signed(rng, np.exp2(rng.uniform(-52, -1, count)))
    if name == "atan2":
        y, x = (np.concatenate([rng.permutation(part) for part in (wide, middle, usual)]) for _ in range(2))
        return np.append(y, usual), np.append(x, 2 * usual * near_one)
    if name == "pow":
        x = np.concatenate([abs(wide), 1 + steps, abs(usual), abs(middle)])
        limits = 1024 / np.log2(x[: 2 * count])  # overflow; 1.05 times as far on the other side, underflow
        return x, np.concatenate([limits * rng.uniform(-1.06, 1.01, 2 * count), usual, np.round(usual) / 2])
    if name in ("sin", "cos", "tan"):
        turns = np.round(rng.uniform(0, 1.2e7, count)) * (np.pi / 2)
        more = [turns, near_quarter_turns(rng.integers(-52, 971, count // 50))]
    elif name in ("asin", "acos", "atanh"):
        more = [near_one, -near_one, rng.uniform(-1, 1, count)]
    elif name in ("log", "log1p", "acosh"):
        more = [1 + steps, -near_one, rng.uniform(-1, 2, count), 1 + np.exp2(rng.uniform(-52, 8, count))]
    else:
        more = [rng.uniform(-1080, 1030, count), rng.uniform(-1, 1, count), np.exp2(rng.uniform(-20, 6, count))]
    x = np.concatenate([wide, middle, usual, *more])
    least, greatest = DOMAINS.get(name, (-np.inf, np.inf))
    return (x[(x > least) & (x < greatest)],)


def ulps(results, name, arguments, digits=53, least=-1074):
    """|result − exact| in units of the last place of the exact value; inf where one alone overflows."""
    exact = EXACT.get(name) or getattr(mpmath, name)
    errors = np.empty(len(results))
    with mpmath.workdps(60):
        greatest = (2 - mpmath.mpf(2) ** -digits) * mpmath.mpf(2) ** (1023 if digits == 53 else 127)
        for i, (result, *numbers) in enumerate(zip(results.tolist(), *(a.tolist() for a in arguments), strict=True)):
            value = exact(*map(mpmath.mpf, numbers))
            if abs(value) >= greatest or math.isinf(result):
                errors[i] = 0 if abs(value) >= greatest and result == math.copysign(math.inf, value) else math.inf
            else:
                unit = max(mpmath.frexp(value)[1] - digits, least) if value else least
                errors[i] = mpmath.ldexp(abs(result - value), -unit)
    return errors


def largest(native, name, count, seed):
    arguments = points(name, count, np.random.default_rng(seed))
    errors = ulps(native(name, *arguments), name, arguments)
    worst = np.argmax(errors)
    return errors[worst], [float(a[worst]) for a in arguments]


@pytest.mark.parametrize("name", NAMES)
def test_error_is_below_one_ulp(native, name):
    error, where = largest(native, name, 400, 1)
    assert error <= BOUNDS[name], where


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_error_is_below_one_ulp_at_many_points(native, name):
    error, where = largest(native, name, 20_000, 2)
    assert error <= BOUNDS[name], where


@pytest.mark.parametrize("name", NAMES)
def test_float32_is_correctly_rounded_but_for_near_ties(native, name):
    rng = np.random.default_rng(3)
    with np.errstate(all="ignore"):
        arguments = tuple(a.astype(np.float32).astype(float) for a in points(name, 40, rng))
    least, greatest = DOMAINS.get(name, (-np.inf, np.inf))
    inside = np.all([np.isfinite(a) & (a != 0) for a in arguments], axis=0)
    inside &= (arguments[0] > least) & (arguments[0] < greatest)
    arguments = tuple(a[inside] for a in arguments)
    results = native(name, *arguments, element=FLOAT).astype(float)
    assert ulps(results, name, arguments, digits=24, least=-149).max() <= 0.51


SPECIAL = [0, 5e-324, 1e-310, 2.0**-1022, 1e-300, 0.5, 1 - 2.0**-53, 1, 1 + 2.0**-52]
SPECIAL += [2, 2.5, 3, 22, 45, 52, 55, 690, 700]
SPECIAL += [709.8, 710, 745.2, 746, 800, 1023.9, 1024, 1074, 1074.9, 1075, 1076, 7e15, 2.0**52 + 1, 2.0**53 + 1, 1e16]
SPECIAL = np.array([*SPECIAL, 1e300, 1e308, 2.0**1023 * (2 - 2.0**-52), math.inf])


@pytest.mark.parametrize("name", NAMES)
def test_special_values_are_ieee(native, name):
    """NaN, infinities, signed zeros, subnormals and domain errors as in NumPy; other values to two ulp."""
    x = np.concatenate([SPECIAL, -SPECIAL, [math.nan]])
    arguments = (x,) if INPUTS[name] == 1 else tuple(grid.ravel() for grid in np.meshgrid(x, x))
    with np.errstate(all="ignore"):
        expected = (NUMPY.get(name) or getattr(np, name))(*arguments)
        close = abs(native(name, *arguments) - expected) <= 2 * np.spacing(abs(expected))
    results = native(name, *arguments)
    same = (np.isnan(results) & np.isnan(expected)) | ((results == expected) | close) & (
        np.signbit(results) == np.signbit(expected)
    )
    assert same.all(), [(*(a[i] for a in arguments), results[i], expected[i]) for i in np.flatnonzero(~same)]


def bits(results):
    """NaN counts as one value."""
    return np.where(np.isnan(results), math.nan, results).view(np.int64)


def test_bits_do_not_depend_on_lanes_or_optimization(native):
    plain = NativeLoops([(name, 8, DOUBLE) for name in NAMES], optimization=0)
    for name in NAMES:
        arguments = points(name, 500, np.random.default_rng(4))
        results = bits(native(name, *arguments))
        assert np.array_equal(results, bits(plain(name, *arguments))), name
        for lanes in LANES:
            assert np.array_equal(results, bits(native(name, *arguments, lanes=lanes))), (name, lanes)


def test_sincos_has_the_bits_of_sin_and_cos(native):
    (x,) = points("sin", 500, np.random.default_rng(5))
    for lanes in LANES:
        for result, name in zip(native("sincos", x, lanes=lanes), ("sin", "cos"), strict=True):
            assert np.array_equal(bits(result), bits(native(name, x, lanes=lanes)))


def test_sin_cos_and_tan_are_accurate_next_to_all_multiples_of_a_quarter_rotation(native):
    """At every exponent the double nearest to a multiple of π/2, where reductions lose the most."""
    x = near_quarter_turns(range(-60, 971, 5))
    for name in ("sin", "cos", "tan"):
        assert ulps(native(name, x), name, (x,)).max() <= BOUNDS[name]


def test_coefficients_are_chebyshev_fits():
    square_root, tiny = mpmath.sqrt, mpmath.mpf(2) ** -100

    def arctanh(z):
        return 2 * mpmath.atanh(square_root(z)) / square_root(z)

    with mpmath.workprec(600):
        log2, tangent = mpmath.log(2) / 2, (3 - 2 * square_root(2)) ** 2
        fits = {
            "SIN": (lambda z: (mpmath.sin(square_root(z)) / square_root(z) - 1) / z, 0, (mpmath.pi / 4) ** 2),
            "COS": (lambda z: (mpmath.cos(square_root(z)) - 1 + z / 2) / z**2, 0, (mpmath.pi / 4) ** 2),
            "EXP": (lambda r: (mpmath.expm1(r) - r) / r**2, -log2, log2),
            "EXP_CUBIC": (lambda r: (mpmath.expm1(r) - r - r**2 / 2) / r**3, -log2, log2),
            "LOG": (lambda z: (arctanh(z) - 2) / z, 0, tangent),
            "LOG_FIFTH": (lambda z: ((arctanh(z) - 2) / z - mpmath.mpf(2) / 3) / z, 0, tangent),
            "ATAN": (lambda z: (mpmath.atan(square_root(z)) / square_root(z) - 1) / z, 0, mpmath.mpf(1) / 4),
            "CBRT": (mpmath.cbrt, 1, 8),
        }
        for name, (function, start, end) in fits.items():
            found = getattr(coefficients, name)
            with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
                ends = [start + tiny, end + tiny]  # so that no node is 0
                fitted = mpmath.chebyfit(function, ends, len(found))
            assert found == tuple(float(c) for c in fitted[::-1]), name
