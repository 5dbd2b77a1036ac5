"""How well conditioned a function is: it is evaluated with rounding errors of a few ulp, of random size, in each step.

Machine code and XLA round differently: one fuses a product with a sum where the other does not, and their elementary
functions differ in the last bits. Where the results of a function scatter when each operation is disturbed by `ULPS`
of its result, such a difference proves nothing; elsewhere it is an error. So no tolerance is guessed.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

ULPS = 16
LENGTH = 509  # the number of disturbances of a draw
LOST = 2.0**24  # of the smallest normal numbers stand for one that XLA has lost: its products with others are not lost
_SUMS = {"add", "sub", "add_any", "reduce_sum", "dot_general", "cumsum", "scatter-add"}
_TERMS = {"reduce_sum", "reduce_prod", "dot_general", "cumsum", "cumprod", "scatter-add", "scatter-mul"}
_NAMES = "sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log1p log2 pow logistic "
_NAMES += "cbrt rsqrt sqrt one_minus_square polynomial integer_pow"
_FUNCTIONS = set(_NAMES.split())
_COARSE = {"log1p": 128, "atanh": 129}  # ulp by which float64 of XLA is off near ±0.414, by jaxlib 0.10.2
_FUSED = {"mul", "dot_general", "reduce_sum", "cumsum"}
_SMALL = {"mul", "div", "square", "integer_pow", "pow", "exp", "exp2", "logistic", "convert_element_type"}
_ROUNDING = _SUMS | _TERMS | _FUNCTIONS | {"mul", "div", "square"}


def perturbed(closed):
    """A jaxpr as a function of a draw (of `draws`), and of its arguments."""

    def function(draw, *arguments):
        return _Evaluation(draw).jaxpr(closed, arguments)

    return function


def draws(count, seed=0):
    """The first two disturb nothing."""
    rng = np.random.default_rng(seed)
    return [*np.zeros((2, LENGTH)), *rng.uniform(-1, 1, (count - 2, LENGTH))]


class _Evaluation:
    def __init__(self, draw):
        self.draw, self.place = draw, 0

    def disturb(self, x, zeros=False, lost=False, scale=ULPS):
        """x with a disturbance of each entry. A zero is of random sign if `zeros`, and not 0 where it is `lost`."""
        if x.dtype not in (np.float32, np.float64) or not x.size:
            return x
        self.place = (self.place + 17) % (LENGTH - x.size)
        noise = lax.slice(self.draw, (self.place,), (self.place + x.size,)).reshape(x.shape).astype(x.dtype)
        found = x * (1 + scale * np.finfo(x.dtype).eps * noise)
        if zeros:
            return jnp.where(found == 0, jnp.where(noise < 0, -jnp.zeros_like(x), 0), found)
        return jnp.where(lost, jnp.sign(noise) * LOST * jnp.finfo(x.dtype).tiny, found)

    def overflow(self, equation, inputs, x):
        """x, but finite in some draws where a product or a sum overflows: it may not do so if it is fused."""
        if x.dtype.kind != "f" or not x.size:
            return x
        sizes = equation.primitive.bind(*map(jnp.abs, inputs), **equation.params)
        over = jnp.isinf(sizes) & (self.draw[self.place] > 0)
        for y in inputs:
            over &= jnp.all(jnp.isfinite(y))
        return jnp.where(over, jnp.nan_to_num(x), x)

    def jaxpr(self, closed, arguments):
        jaxpr = closed.jaxpr if isinstance(closed, ClosedJaxpr) else closed
        consts = closed.consts if isinstance(closed, ClosedJaxpr) else []
        values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *arguments], strict=True))

        def read(x):
            return jnp.asarray(x.val, x.aval.dtype) if isinstance(x, Literal) else values[x]

        for equation in jaxpr.eqns:
            results = self.equation(equation, [read(x) for x in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def equation(self, equation, inputs):
        name, parameters, out = equation.primitive.name, equation.params, equation.outvars
        if name in ("while", "cond", "scan"):
            return getattr(self, name + "_")(parameters, inputs, [x.aval for x in out])
        inner = [x for x in parameters.values() if isinstance(x, ClosedJaxpr | Jaxpr)]
        if len(inner) == 1 and not name.startswith("scatter"):
            return self.jaxpr(inner[0], inputs)
        if name in _TERMS or name in _FUNCTIONS:
            inputs = [self.disturb(x) for x in inputs]
        found = equation.primitive.bind(*inputs, **parameters)
        found = found if equation.primitive.multiple_results else [found]
        if name in _FUSED:
            found = [self.overflow(equation, inputs, found[0])]
        if name in _SMALL:  # XLA takes subnormal results for 0, machine code does not
            lost = (found[0] == 0) & functools.reduce(jnp.logical_and, [jnp.asarray(x) != 0 for x in inputs])
            return [self.disturb(found[0], lost=lost, scale=ULPS * (name in _ROUNDING))]
        scale = 2 * _COARSE.get(name, ULPS / 2) if found[0].dtype == np.float64 else ULPS
        return [self.disturb(x, name in _SUMS, scale=scale) for x in found] if name in _ROUNDING else found

    def while_(self, parameters, inputs, out):
        cond, body = parameters["cond_jaxpr"], parameters["body_jaxpr"]
        a, b = (len(f.in_avals) - len(out) for f in (cond, body))
        of_test, of_body, start = inputs[:a], inputs[a : a + b], inputs[a + b :]
        return lax.while_loop(
            lambda c: self.jaxpr(cond, [*of_test, *c])[0], lambda c: self.jaxpr(body, [*of_body, *c]), start
        )

    def cond_(self, parameters, inputs, out):
        sides = [lambda *x, side=side: self.jaxpr(side, x) for side in parameters["branches"]]
        return lax.switch(inputs[0].astype(np.int32), sides, *inputs[1:])

    def scan_(self, parameters, inputs, out):
        closed, length = parameters["jaxpr"], parameters["length"]
        carried = sum(len(x.shape) == len(y.shape) for x, y in zip(out, closed.out_avals, strict=True))
        fixed = sum(len(x.shape) == len(y.shape) for x, y in zip(inputs, closed.in_avals, strict=True))
        consts, carry, rows = inputs[: fixed - carried], inputs[fixed - carried : fixed], inputs[fixed:]
        order, each = range(length)[:: -1 if parameters["reverse"] else 1], [None] * length
        for k in order:
            found = self.jaxpr(closed, [*consts, *carry, *(x[k] for x in rows)])
            carry, each[k] = found[:carried], found[carried:]
        return [*carry, *map(jnp.stack, zip(*each, strict=True))]


def flushed(arguments, sign):
    """Subnormal numbers, which XLA takes for 0, as small normal ones of this sign, or if it is 0, in their order."""

    def as_normal(x):
        if x.dtype.kind != "f":
            return x
        info = np.finfo(x.dtype)
        with np.errstate(over="ignore", invalid="ignore"):
            normal = x * x.dtype.type(LOST / info.eps) if sign == 0 else x.dtype.type(sign * LOST * info.tiny)
        return np.where((np.abs(x) < info.tiny) & (x != 0), normal, x)

    return jax.tree.map(as_normal, arguments)
