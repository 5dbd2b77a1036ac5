"""Random functions as machine code, against `jax.jit(jax.vmap(f))`."""

import warnings
from typing import NamedTuple

import jax
import numpy as np
from internals import compiled_once
from kernels import Kernel
from perturbed import draws, flushed, perturbed
from random_functions import arguments, random_function

from lieint_jax.native import UnsupportedError

MEMBERS = 61
DRAWS = 8
COUNTS = (1, 7, 16, 17)  # of members whose bits must not depend on how many there are


class Checked(NamedTuple):
    """The counts of functions, of those without machine code, of entries, and of those that rounding decides."""

    functions: int = 0
    unsupported: int = 0
    entries: int = 0
    undecided: int = 0

    def __add__(self, other):
        return Checked(*map(sum, zip(self, other, strict=True)))


def check(seeds):
    """Raise AssertionError with the seed of the first function whose results differ by more than rounding explains."""
    seeds, given = list(seeds), arguments(np.random.default_rng(seeds[0]), MEMBERS)
    shapes = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in given]
    functions = [random_function(seed) for seed in seeds]
    with warnings.catch_warnings(action="ignore"):  # JAX warns of casts that it makes
        expected = compiled_once(jax.vmap(lambda *x: [f(*x) for f in functions]))(*given)
        return sum((_check(*each, given, shapes) for each in zip(seeds, functions, expected, strict=True)), Checked())


def _check(seed, function, expected, given, shapes):
    try:
        lanes = 8 if seed % 4 else 0  # 0: as many as in a run, which takes LLVM twice as long
        kernel = Kernel(function, ["member"] * len(given), shapes, lanes)
    except UnsupportedError:
        return Checked(1, unsupported=1)
    found, expected = _run(kernel, given, MEMBERS), [np.asarray(x) for x in expected]
    for count in COUNTS:
        some = _run(kernel, [x[:count] for x in given], count)
        alike = [_bits(x) == _bits(y[:count]) for x, y in zip(some, found, strict=True)]
        assert all(alike), f"seed {seed}: {count} members"
    references = [expected]
    if any(differences(x, [y])[0].any() for x, y in zip(found, expected, strict=True)):
        references += _disturbed(function, given, shapes)
    undecided = 0
    for n, x in enumerate(found):
        wrong, unknown = differences(x, [y[n] for y in references])
        where = np.argwhere(wrong)[:1]
        values = [(x[*k], [reference[n][*k] for reference in references]) for k in where]
        assert not wrong.any(), f"seed {seed}, result {n}, entry {where}: {values}"
        undecided += int(unknown.sum())
    return Checked(1, 0, sum(x.size for x in found), undecided)


def _disturbed(function, given, shapes):
    """What XLA computes with all of its optimizations, and with rounding errors of another size."""
    disturbed = perturbed(jax.make_jaxpr(function)(*shapes))
    every = compiled_once(jax.vmap(disturbed, (None, *(0,) * len(given))))
    found = [every(draw, *flushed(given, (1, -1, 0)[k % 3])) for k, draw in enumerate(draws(DRAWS))]
    return [[np.asarray(x) for x in one] for one in (jax.jit(jax.vmap(function))(*given), *found)]


def _bits(x):
    """The bytes of an array; NaN counts as one value."""
    return (np.where(np.isnan(x), np.nan, x).astype(x.dtype) if x.dtype.kind == "f" else x).tobytes()


def _run(kernel, given, members):
    return [x[0] for x in jax.tree.leaves(kernel(given, members, threads=2))]


def differences(found, references):
    """Which entries are not what XLA computes, and which are not decided: draws of rounding errors differ there.

    Among real numbers twice the scatter of the draws is allowed, and the 16 ulp by which each draw is disturbed: both
    sides round each operation to an ulp or two. Integers, booleans, NaN and infinities are equal.
    """
    expected = references[0]
    assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
    with np.errstate(all="ignore"):
        if found.dtype.kind != "f":
            undecided = np.any([x != expected for x in references], 0)
            return (found != expected) & ~undecided, undecided
        info = np.finfo(found.dtype)
        kinds = [np.where(np.isfinite(x), 0, np.where(np.isnan(x), 2, np.sign(x))) for x in (found, *references)]
        undecided = np.any([x != kinds[1] for x in kinds[2:]], 0)
        finite = (kinds[0] == 0) & (kinds[1] == 0) & ~undecided
        scatter = np.max(references, 0) - np.min(references, 0)
        scatter = np.where(scatter < np.inf, scatter, info.max / 8)
        allowed = 2 * scatter + 16 * info.eps * np.abs(expected) + 2**9 * info.tiny
        wrong = (kinds[0] != kinds[1]) & ~undecided | finite & ~(np.abs(found - expected) <= allowed)
        loose = finite & (scatter > 1e-3 * (1 + np.abs(expected)))
        return wrong, undecided | loose
