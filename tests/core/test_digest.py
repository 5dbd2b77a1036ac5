"""Digests of functions and other values: the same in every process and at every place of a file, others for others."""

import fractions
import functools
import os
import py_compile
import subprocess
import sys
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.runs.store._digest import NotDigestible, digest, python_of

SOURCE = """
import dataclasses, functools, jax, jax.numpy as jnp

k = 0.3
TABLE = {"a": jnp.arange(3.0), "b": frozenset({"x", "y", "z"})}

def helper(x):
    return k * x

def law(gain):
    return lambda t, q, w: -gain * w

def plain(t, q, w, factor=2.0, *, offset=1.0):
    return helper(w) * factor if t in {1, "a", "b", 2.5} else TABLE["a"] + offset

def again(n):
    return n * again(n - 1) if n else 1

class Base:
    scale = 2.0

    def scaled(self, w):
        return self.scale * w

class Law(Base):
    def __init__(self, gain):
        self.gain = gain

    def __call__(self, t, q, w):
        return -self.gain * self.scaled(helper(w))

@dataclasses.dataclass(frozen=True)
class Field:
    gain: float

    def __call__(self, t):
        return self.gain * t

rooted = jax.custom_jvp(helper)
rooted.defjvp(lambda p, d: (helper(*p), k * d[0]))

def values():
    laws = law(0.1), Law(0.1), Law(0.1).__call__, Field(0.1)
    partials = functools.partial(plain, 1.0), jax.tree_util.Partial(plain)
    wrappers = jax.jit(plain), functools.cache(plain)
    return *laws, *partials, plain, again, Law, rooted, *wrappers, {"b": 2, "a": {"p", "q"}}
"""


def module(text=SOURCE):
    """The source as a module of the user."""
    made = ModuleType("mine")
    made.__file__ = "mine.py"
    sys.modules["mine"] = made
    exec(compile(text, "mine.py", "exec"), vars(made))
    return made


ELSEWHERE = """
import sys
sys.path.insert(0, sys.argv[1])
import mine
from lieint_jax.runs.store._digest import digest
print(*map(digest, mine.values()))
"""


@pytest.mark.long
def test_another_process_another_folder_and_other_lines_have_the_same_digests(tmp_path):
    """Each process has its own hashes, so sets have another order there; and it reads a module compiled before."""
    (tmp_path / "mine.py").write_text("# a comment\n\n\n" + SOURCE)
    py_compile.compile(str(tmp_path / "mine.py"))
    environment = os.environ | {"JAX_ENABLE_X64": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", ELSEWHERE, str(tmp_path)]
    there = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.split()
    here = [digest(value) for value in module().values()]
    assert len(set(here)) >= len(here) - 2  # a bound method of a law, or a wrapper of plain, may be like another
    assert there == here


@pytest.mark.parametrize(
    ("old", "new", "others"),
    [
        ("law(0.1)", "law(0.7)", {0}),
        ("-gain * w", "gain * w", {0}),
        ("k = 0.3", "k = 0.4", {1, 2, 4, 5, 6, 8, 9, 10, 11}),
        ("arange(3.0)", "arange(4.0)", {4, 5, 6, 10, 11}),
        ("factor=2.0", "factor=3.0", {4, 5, 6, 10, 11}),
        ("offset=1.0", "offset=3.0", {4, 5, 6, 10, 11}),
        ("scale = 2.0", "scale = 2.5", {1, 2, 8}),
        ("Field(0.1)", "Field(0.2)", {3}),
        ("self.gain * t", "self.gain + t", {3}),
        ("k * d[0]", "k + d[0]", {9}),
        ('{"p", "q"}', '{"p", "r"}', {12}),
    ],
)
def test_what_a_function_depends_on_changes_its_digest_and_nothing_else_does(old, new, others):
    assert old in SOURCE
    before, after = ([digest(x) for x in module(text).values()] for text in (SOURCE, SOURCE.replace(old, new)))
    assert {n for n, (a, b) in enumerate(zip(before, after, strict=True)) if a != b} == others


def test_a_module_of_the_user_counts_by_what_a_function_reads_of_it():
    mine = module()
    function = lambda x: mine.k * x  # noqa: E731
    before = digest(function)
    mine.unread = 3.0
    assert digest(function) == before
    mine.k = 0.5
    assert digest(function) != before


def test_values_that_look_alike_have_digests_of_their_own():
    values = [1, 1.0, True, "1", b"1", None, 0.0, -0.0, (1, 2), [1, 2], {1, 2}, np.float32(1), np.ones(1), np.ones(2)]
    values += [jnp.ones((1, 1)), fractions.Fraction(1, 3), fractions.Fraction(1, 4), jax.random.key(1), np.sin, jnp.sin]
    values += [{"a": 1}, {"a": 2}, ((1,), 2), (1, (2,)), np.random.default_rng(1), np.random.default_rng(2), len, np]
    assert len({digest(x) for x in values}) == len(values)


def test_the_python_counts_where_bytecode_does():
    assert python_of(li.torques.bdot, np.sin, 3.0) is None
    assert python_of([lambda t: t]) == f"CPython {sys.version_info[0]}.{sys.version_info[1]}"


def test_what_has_no_digest_is_named():
    file = (line for line in "a")

    def read(t):
        return functools.partial(next, file)() * t

    with pytest.raises(NotDigestible, match=r"no_digest_is_named.<locals>.read → file: builtins.generator objects"):
        digest(read)
    with pytest.raises(NotDigestible, match="a value that JAX is tracing"):
        jax.jit(lambda x: digest(x))(1.0)
