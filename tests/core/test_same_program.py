"""Which functions compute the same: equal digests for one program, however it is written, different ones for two."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import laws_alike
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.runs._digests import NotComparableError, OfMember, digest_of_programs


def digest(law):
    """That of a law, traced anew."""
    return digest_of_programs(jax.make_jaxpr(lambda *x: law(*x))(*laws_alike.POINT))


def test_two_hundred_pairs_of_different_laws_have_different_digests_and_the_same_law_made_twice_has_one():
    pairs, alike, unlike = 0, [], []
    for name, make, first, others in laws_alike.families():
        mine = digest(make(first))
        if digest(make(first)) != mine:
            unlike.append((name, first))
        for other in others:
            pairs += 1
            if digest(make(other)) == mine:
                alike.append((name, first, other))
    assert not alike
    assert not unlike
    assert pairs >= 200


def test_how_a_law_is_written_makes_no_difference():
    assert len({digest(make(0.3)) for make in laws_alike.PLAIN.values()}) == 1
    renamed = jax.jit(lambda a, b, c: -0.3 * c)
    assert digest(renamed) == digest(laws_alike.OTHERWISE["jit"](0.3))


HERE = """
import jax
jax.config.update("jax_enable_x64", True)
import test_same_program
print(test_same_program.digests())
"""


def digests():
    """Those of one law of each family, and of a step."""
    body = li.systems.torqued_body([1.0, 2.0, 3.0], laws_alike.drag)
    state = body.state(angular_velocity=[0.2, 0.0, 1.0])
    step = jax.make_jaxpr(lambda step, z: step(z, 0.1))(li.schemes.torqued_midpoint(body), state)
    return " ".join([*(digest(make(first)) for _, make, first, _ in laws_alike.families()), digest_of_programs(step)])


def test_another_process_has_the_same_digests():
    """Each process has its own hashes, so that its sets have another order."""
    folders = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = os.environ | {"PYTHONPATH": folders, "PYTHONHASHSEED": "271828"}
    there = subprocess.run([sys.executable, "-c", HERE], env=environment, check=True, capture_output=True, text=True)
    assert there.stdout.strip() == digests()


def called_back(t, q, w):
    return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((3,), w.dtype), w, vmap_method="expand_dims")


def called_in_order(t, q, w):
    return jax.experimental.io_callback(np.sin, jax.ShapeDtypeStruct((3,), w.dtype), w)


def called_outside(t, q, w):
    return jax.ffi.ffi_call("a_library", jax.ShapeDtypeStruct((3,), w.dtype))(w)


foreign_p = jax.extend.core.Primitive("sin")  # the name of one of JAX
foreign_p.def_abstract_eval(lambda x: x)


@pytest.mark.parametrize(
    ("law", "sentence"),
    [
        (called_back, "call back into Python"),
        (called_in_order, "call back into Python"),
        (lambda t, q, w: jax.lax.cond(t < 1, called_back, lambda t, q, w: w, t, q, w), "call back into Python"),
        (lambda t, q, w: li.scan(lambda c, _: (called_back(t, q, c), None), w, length=2)[0], "call back into Python"),
        (called_outside, "call a library by jax.ffi"),
        (lambda t, q, w: jax.lax.sin_p.bind(w, accuracy=len), "the parameter accuracy of sin has no text, builtin"),
        (lambda t, q, w: foreign_p.bind(w), "sin is an operation of another package"),
    ],
)
def test_what_equations_do_not_determine_has_no_digest(law, sentence):
    with pytest.raises(NotComparableError, match=sentence):
        digest(law)
    with pytest.raises(NotComparableError, match="depend on a value that JAX is tracing"):
        jax.jit(lambda x: digest(lambda t, q, w: x * w))(1.0)


def with_rule(k, factor):
    """A law that is another one, by a factor, where it is computed for many members at once."""

    @jax.custom_batching.custom_vmap
    def g(w, c):
        return k * c * w

    @g.def_vmap
    def rule(size, batched, w, c):
        assert batched == [True, False]
        return factor * k * c * w, True

    return lambda t, q, w: g(w, 2.0)


def test_a_rule_for_many_members_counts_where_there_are_many():
    def of(law, *own):
        return digest_of_programs(OfMember(jax.make_jaxpr(law)(*laws_alike.POINT), own))

    one, many = (False, False, False), (False, True, True)
    assert of(with_rule(0.3, 1.0), *many) == of(with_rule(0.3, 1.0), *many)
    assert len({of(with_rule(k, factor), *many) for k in (0.3, 0.4) for factor in (1.0, 2.0)}) == 4
    assert digest(with_rule(0.3, 1.0)) == digest(with_rule(0.3, 2.0)) != digest(with_rule(0.4, 1.0))
    assert of(lambda t, q, w: -w, *one) == of(lambda t, q, w: -w, *many) == digest(lambda t, q, w: -w)


def test_what_a_law_prints_makes_no_difference():
    def printed(words):
        return lambda t, q, w: (jax.debug.print(words, x=w), jax.debug.callback(print, w), -w)[-1]

    assert digest(printed("torque {x}")) == digest(printed("{x} N m"))


def test_random_numbers_of_another_generator_are_other_ones():
    law = laws_alike.OF_AN_INTEGER["key"](1)
    with jax.threefry_partitionable(not jax.config.jax_threefry_partitionable):
        other = digest(law)
    assert other != digest(law)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64, jnp.int32, bool])
def test_a_constant_counts_by_its_values_and_its_type(dtype):
    def of(x):
        return digest_of_programs(jax.make_jaxpr(lambda y: jnp.asarray(x) * y)(1.0))

    values = np.zeros(100, dtype)
    changed = values.copy()
    changed[77] = 1
    assert len({of(values), of(changed), of(values[:99]), of(values.astype(np.int8))}) == 4
    assert of(values) == of(values.copy()) == of(jnp.asarray(values))
