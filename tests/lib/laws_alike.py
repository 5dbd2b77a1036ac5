"""Laws (t, q, w) ↦ torque that differ in one number or in one operation, however they are written."""

import collections
import contextvars
import dataclasses
import enum
import fractions
import functools
import importlib
import json
import operator
import os
import sys
import tempfile
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import lieint_jax as li

NUMBERS = {1.0: (2.0, -1.0, 1.0 + 2.0**-52), 0.0: (-0.0,)}  # each with others
POINT = (0.5, np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.3, -0.2, 0.7]))


def scaled(k):
    def decorated(f):
        @functools.wraps(f)
        def g(*arguments):
            return k * f(*arguments)

        return g

    return decorated


def drag(t, q, w):
    return -w


def own_class(**members):
    return type("Law", (), members)()


def executed(text, name="law"):
    exec(text, names := {"__name__": "__main__"})
    return names[name]


def from_module(k, name, inside):
    """A law that imports a user's module, which was edited since; the name may be that of a module of Python."""
    folder = tempfile.mkdtemp()
    Path(folder, f"{name}.py").write_text(f"gain = {k!r}\n")
    found, before = [], sys.modules.pop(name, None)
    sys.path.insert(0, folder)
    importlib.invalidate_caches()

    def read():
        module = importlib.import_module(name)
        found.append(module)
        return module.gain

    def law(t, q, w):
        if inside:
            sys.modules.pop(name, None)
            sys.path.insert(0, folder)
            importlib.invalidate_caches()
        try:
            return -read() * w
        finally:
            if inside:
                sys.path.remove(folder)
                sys.modules.pop(name, None)

    module = importlib.import_module(name)
    sys.path.remove(folder)
    del sys.modules[name]
    if before is not None:
        sys.modules[name] = before
    return law if inside else lambda t, q, w: -module.gain * w


def of_global(k):
    return executed(f"k = {k!r}\ndef law(t, q, w): return -k * w")


def of_default(k):
    def law(t, q, w, gain=k):
        return -gain * w

    return law


def of_keyword(k):
    def law(t, q, w, *, gain=k):
        return -gain * w

    return law


def of_file(k):
    path = Path(tempfile.mkdtemp(), "gains.json")
    path.write_text(json.dumps({"gain": k}))
    return lambda t, q, w: -json.loads(path.read_text())["gain"] * w


def of_environment(k):
    def law(t, q, w):
        os.environ["LIEINT_TEST_GAIN"] = repr(k)
        return -float(os.environ.pop("LIEINT_TEST_GAIN")) * w

    return law


def of_context(k):
    variable = contextvars.ContextVar("gain", default=k)
    return lambda t, q, w: -variable.get() * w


def of_dispatch(k):
    @functools.singledispatch
    def gain(x):
        return 0.0

    gain.register(float, lambda x: k)
    return lambda t, q, w: -gain(1.0) * w


def of_descriptor(k):
    class Gain:
        def __get__(self, *_):
            return k

    return own_class(gain=Gain(), __call__=lambda self, t, q, w: -self.gain * w)


def of_metaclass(k):
    meta = type("Meta", (type,), {"gain": k})
    return meta("Law", (), {"__call__": lambda self, t, q, w: -type(self).gain * w})()


def of_inheritance(k):
    base = type("Base", (), {"gain": k})
    return type("Law", (base,), {"__call__": lambda self, t, q, w: -self.gain * w})()


def of_slots(k):
    class Law:
        __slots__ = ("gain",)

        def __call__(self, t, q, w):
            return -self.gain * w

    law = Law()
    law.gain = k
    return law


def of_getattr(k):
    return own_class(__getattr__=lambda self, name: k, __call__=lambda self, t, q, w: -self.anything * w)


def of_dataclass(k):
    @dataclasses.dataclass(frozen=True)
    class Law:
        gain: float

        def __call__(self, t, q, w):
            return -self.gain * w

    return Law(k)


def of_enum(k):
    gains = enum.Enum("Gains", {"DRAG": ("of drag", k)})
    return lambda t, q, w: -gains.DRAG.value[1] * w


def patched(k):
    law = own_class(__call__=lambda self, t, q, w: self.torque(w))
    law.torque = lambda w: -k * w
    return law


def with_jvp(k):
    law = jax.custom_jvp(lambda t, q, w: -k * w)
    law.defjvp(lambda x, d: (-k * x[2], -k * d[2]))
    return law


def with_vjp(k):
    law = jax.custom_vjp(lambda t, q, w: -k * w)
    law.defvjp(lambda t, q, w: (-k * w, None), lambda _, d: (0.0, 0 * POINT[1], -k * d))
    return law


def of_root(k):
    return lambda t, q, w: lax.custom_root(
        lambda x: x + k * w, w, lambda f, x: x - f(x), lambda g, y: y / g(jnp.ones_like(y))
    )


def of_solve(k):
    def law(t, q, w):
        return lax.custom_linear_solve(lambda x: k * x, w, lambda _, b: b / k, symmetric=True)

    return law


PLAIN = {  # all of them are −k w, written in other ways: one program
    "closure": lambda k: lambda t, q, w: -k * w,
    "default": of_default,
    "keyword": of_keyword,
    "global": of_global,
    "class attribute": lambda k: own_class(gain=k, __call__=lambda self, t, q, w: -self.gain * w),
    "instance attribute": lambda k: functools.partial(lambda self, t, q, w: -self.k * w, types.SimpleNamespace(k=k)),
    "property": lambda k: own_class(gain=property(lambda _: k), __call__=lambda self, t, q, w: -self.gain * w),
    "static method": lambda k: own_class(f=staticmethod(lambda w: -k * w), __call__=lambda self, t, q, w: self.f(w)),
    "class method": lambda k: own_class(f=classmethod(lambda _, w: -k * w), __call__=lambda self, t, q, w: self.f(w)),
    "partial": lambda k: functools.partial(lambda a, t, q, w: -a * w, k),
    "partial method": lambda k: own_class(__call__=functools.partialmethod(lambda self, a, t, q, w: -a * w, k)),
    "executed function": lambda k: executed(f"def law(t, q, w): return -({k!r}) * w"),
    "executed class": lambda k: executed(f"class law:\n def __call__(self, t, q, w): return -({k!r}) * w")(),
    "evaluated": lambda k: eval(f"lambda t, q, w: -({k!r}) * w"),
    "import inside": lambda k: from_module(k, "gains", inside=True),
    "module": lambda k: from_module(k, "gains", inside=False),
    "module named code": lambda k: from_module(k, "code", inside=False),
    "file": of_file,
    "environment": of_environment,
    "context variable": of_context,
    "dispatch": of_dispatch,
    "descriptor": of_descriptor,
    "metaclass": of_metaclass,
    "inheritance": of_inheritance,
    "slots": of_slots,
    "getattr": of_getattr,
    "dataclass": of_dataclass,
    "enum": of_enum,
    "patched method": patched,
    "named tuple": lambda k: lambda t, q, w: -collections.namedtuple("Gains", "a")(k).a * w,
    "table": lambda k: lambda t, q, w: -{"a": 7.0, "b": k}["b"] * w,
    "attribute of a function": lambda k: (lambda f: (setattr(f, "gain", k), lambda t, q, w: -f.gain * w)[1])(drag),
    "kept value": lambda k: lambda t, q, w: -functools.cache(lambda: k)() * w,
    "generator": lambda k: lambda t, q, w: -next(x for x in (k, 7.0)) * w,
    "operator": lambda k: lambda t, q, w: operator.mul(operator.neg(k), w),
    "float of numpy": lambda k: lambda t, q, w: -float(np.float64(k)) * w,
}
OTHERWISE = {
    "decorated method": lambda k: own_class(__call__=scaled(k)(lambda self, t, q, w: -w)),
    "decorated": lambda k: scaled(k)(drag),
    "jit of decorated": lambda k: jax.jit(scaled(k)(drag)),
    "jit": lambda k: jax.jit(lambda t, q, w: -k * w),
    "jax partial": lambda k: jax.tree_util.Partial(lambda a, t, q, w: -a * w, jnp.asarray(k)),
    "array of numpy": lambda k: (lambda gains: lambda t, q, w: -gains * w)(np.array([1.0, k, 3.0])),
    "array of jax": lambda k: (lambda gains: lambda t, q, w: -gains * w)(jnp.array([1.0, k, 3.0])),
    "long array": lambda k: (lambda table: lambda t, q, w: table[:3] * w)(jnp.arange(50.0).at[40].set(k)),
    "read by index": lambda k: (lambda table: lambda t, q, w: table[w.astype(int)] * w)(jnp.array([1.0, k])),
    "vmap": lambda k: lambda t, q, w: jax.vmap(lambda x: -k * x)(w),
    "scan": lambda k: lambda t, q, w: lax.scan(lambda c, _: (c * k, None), w, length=3)[0],
    "own scan": lambda k: lambda t, q, w: li.scan(lambda c, _: (c * k, None), w, length=3)[0],
    "while": lambda k: lambda t, q, w: lax.while_loop(lambda x: x[0] < k, lambda x: x + 1, w),
    "body of while": lambda k: lambda t, q, w: lax.while_loop(lambda x: x[0] < 1, lambda x: x * k, w),
    "cond": lambda k: lambda t, q, w: lax.cond(t < 1, lambda x: k * x, lambda x: -x, w),
    "switch": lambda k: lambda t, q, w: lax.switch(1, [jnp.sin, lambda x: k * x], w),
    "where": lambda k: lambda t, q, w: jnp.where(w > k, w, -w),
    "branch not reached": lambda k: lambda t, q, w: jnp.where(t > 1e9, k * w, -w),
    "loop": lambda k: lambda t, q, w: lax.fori_loop(0, 4, lambda i, x: x + k * i, w),
    "map": lambda k: lambda t, q, w: lax.map(lambda x: k * x, w),
    "checkpoint": lambda k: jax.checkpoint(lambda t, q, w: -k * w),
    "own derivative": with_jvp,
    "own derivative in reverse": with_vjp,
    "root": of_root,
    "solve": of_solve,
    "gradient": lambda k: lambda t, q, w: jax.grad(lambda x: k * (x**3).sum())(w),
    "derivative": lambda k: lambda t, q, w: jax.jvp(lambda x: k * jnp.sin(x), (w,), (w,))[1],
}
OF_AN_INTEGER = {
    "fraction": lambda n: lambda t, q, w: -float(fractions.Fraction(n, 7)) * w,
    "power": lambda n: lambda t, q, w: w**n,
    "unrolled": lambda n: lambda t, q, w: functools.reduce(lambda x, _: jnp.sin(x), range(n), w),
    "length": lambda n: lambda t, q, w: lax.scan(lambda c, _: (c * 2, None), w, length=n)[0],
    "entry": lambda n: lambda t, q, w: w[n % 3] * w,
    "key": lambda n: lambda t, q, w: jax.random.normal(jax.random.key(n), (3,)) * w,
    "older key": lambda n: lambda t, q, w: jax.random.normal(jax.random.PRNGKey(n), (3,)) * w,
    "shift": lambda n: lambda t, q, w: jnp.roll(jnp.tile(w, 4), n)[:3],
}
A, B = np.arange(9.0).reshape(3, 3), np.arange(9.0).reshape(3, 3) ** 2
OPERATIONS = {  # pairs
    "plus or minus": (lambda t, q, w: w + q[0], lambda t, q, w: w - q[0]),
    "times or over": (lambda t, q, w: w * q[0], lambda t, q, w: w / q[0]),
    "order of a difference": (lambda t, q, w: w - t, lambda t, q, w: t - w),
    "order of a sum": (lambda t, q, w: (w + t) + q[0], lambda t, q, w: w + (t + q[0])),
    "order of operands": (lambda t, q, w: w + t, lambda t, q, w: t + w),
    "sine or cosine": (lambda t, q, w: jnp.sin(w), lambda t, q, w: jnp.cos(w)),
    "which argument": (lambda t, q, w: w * q[0], lambda t, q, w: w * q[1]),
    "less or not greater": (lambda t, q, w: jnp.where(w < t, w, 0), lambda t, q, w: jnp.where(w <= t, w, 0)),
    "branches": (lambda t, q, w: jnp.where(w < t, w, -w), lambda t, q, w: jnp.where(w < t, -w, w)),
    "branches of cond": (
        lambda t, q, w: lax.cond(t < 1, jnp.sin, jnp.cos, w),
        lambda t, q, w: lax.cond(t < 1, jnp.cos, jnp.sin, w),
    ),
    "transposed": (lambda t, q, w: A @ w, lambda t, q, w: A.T @ w),
    "from the left": (lambda t, q, w: A @ w, lambda t, q, w: w @ A),
    "which matrix": (lambda t, q, w: A @ w, lambda t, q, w: B @ w),
    "order of matrices": (lambda t, q, w: A @ (B @ w), lambda t, q, w: B @ (A @ w)),
    "axis": (lambda t, q, w: jnp.sum(A * w, 0), lambda t, q, w: jnp.sum(A * w, 1)),
    "sum or product": (lambda t, q, w: w.sum() * w, lambda t, q, w: w.prod() * w),
    "direction of a sum": (lambda t, q, w: lax.cumsum(w), lambda t, q, w: lax.cumsum(w, reverse=True)),
    "direction of a scan": tuple(
        lambda t, q, w, r=r: lax.scan(lambda c, x: (c - x, c), 0.0 * t, w, reverse=r)[1] for r in (False, True)
    ),
    "direction of an own scan": tuple(
        lambda t, q, w, r=r: li.scan(lambda c, x: (c - x, c), 0.0 * t, w, reverse=r)[1] for r in (False, True)
    ),
    "float32": (lambda t, q, w: w, lambda t, q, w: w.astype(jnp.float32).astype(w.dtype)),
    "type of a constant": tuple((lambda c: lambda t, q, w: w * c)(np.ones(3, d)) for d in (np.float32, np.float64)),
    "shape of a constant": tuple((lambda c: lambda t, q, w: w * c)(np.ones(n)) for n in (1, 3)),
    "sorted": (lambda t, q, w: jnp.sort(w), lambda t, q, w: -jnp.sort(-w)),
    "cross": (lambda t, q, w: jnp.cross(w, q[:3]), lambda t, q, w: jnp.cross(q[:3], w)),
    "mode of an index": tuple(lambda t, q, w, m=m: w * q.at[w[0].astype(int)].get(mode=m) for m in ("clip", "fill")),
    "set or add": (lambda t, q, w: w.at[0].set(t), lambda t, q, w: w.at[0].add(t)),
    "precision": tuple(lambda t, q, w, p=p: jnp.dot(A, w, precision=p) for p in ("default", "highest")),
    "rounding": (lambda t, q, w: jnp.round(w), lambda t, q, w: lax.round(w, lax.RoundingMethod.AWAY_FROM_ZERO)),
    "floor or ceil": (lambda t, q, w: jnp.floor(w), lambda t, q, w: jnp.ceil(w)),
    "distribution": tuple(
        lambda t, q, w, f=f: w * f(jax.random.key(0), (3,)) for f in (jax.random.normal, jax.random.uniform)
    ),
    "kind of key": tuple(
        lambda t, q, w, i=i: w * jax.random.normal(jax.random.key(0, impl=i), (3,)) for i in ("threefry2x32", "rbg")
    ),
}


def families():
    """Names and makers of laws, the first number of each, and others."""
    for name, make in (PLAIN | OTHERWISE).items():
        for first, others in NUMBERS.items():
            yield name, make, first, others
    for name, make in OF_AN_INTEGER.items():
        yield name, make, 1, (2, 3)
    for name, pair in OPERATIONS.items():
        yield name, pair.__getitem__, 0, (1,)
