"""Random JAX functions of arrays of several types and shapes, and arguments of members that are hard for them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

REALS, WHOLES = (np.float64, np.float32), (np.int64, np.int32)
TYPES = (*REALS, *WHOLES, np.bool_)
SHAPES = ((), (3,), (4,), (2, 3), (3, 3))
ARGUMENTS = (
    (np.float64, (3,)),
    (np.float64, (2, 3)),
    (np.float32, (4,)),
    (np.float32, (3, 3)),
    (np.int32, (3,)),
    (np.int64, ()),
    (np.bool_, (2, 3)),
    (np.bool_, ()),
)
_HARD = (0.0, -0.0, np.inf, -np.inf, np.nan, 1.0, -1.0, 0.5, 2.0, -3.0, 1e10, -1e10)
_ENDS = {np.float64: (1e150, -1e-150, 5e-324, -1e-310), np.float32: (1e18, -1e-18, 1e-45, -1e-40)}


def arguments(rng, members):
    """Two thirds of the members are ordinary, the others have infinities, NaN, zeros of either sign, subnormals."""

    def array(dtype, shape):
        shape, hard = (members, *shape), rng.random(members) < 1 / 3
        if dtype == np.bool_:
            return rng.random(shape) < 0.5
        if dtype in WHOLES:
            ends = np.array([np.iinfo(dtype).min, np.iinfo(dtype).max, 0, -1, 31, 64])
            x, special = rng.integers(-6, 7, shape), rng.choice(ends, shape)
        else:
            x, special = rng.normal(size=shape) * rng.choice([1, 5]), rng.choice([*_HARD, *_ENDS[dtype]], shape)
        chosen = hard.reshape(-1, *[1] * (len(shape) - 1)) & (rng.random(shape) < 0.3)
        return np.where(chosen, special, x).astype(dtype)

    return [array(*argument) for argument in ARGUMENTS]


class Maker:
    """Adds random operations to a pool of arrays. What it chooses depends on types and shapes only."""

    def __init__(self, rng, pool, depth=0):
        self.rng, self.pool, self.depth = rng, list(pool), depth

    def choose(self, items):
        return items[self.rng.integers(len(items))]

    def any(self, kinds="fib", least=0):
        """An array of the pool, the latest more often; made from another if there is none."""
        found = [x for x in self.pool if x.dtype.kind in kinds and x.ndim >= least]
        if not found:
            x = jnp.resize(self.choose(self.pool), (2, 3)) if least else self.choose(self.pool)
            return x.astype({"f": np.float64, "i": np.int32, "b": bool}[kinds[0]])
        return found[max(self.rng.integers(len(found)), self.rng.integers(len(found)))]

    def like(self, x, dtype=None):
        """An array of the type and shape of x."""
        dtype = x.dtype if dtype is None else np.dtype(dtype)
        found = [y for y in self.pool if y.dtype == dtype and y.shape == x.shape]
        if found and self.rng.random() < 0.8:
            return self.choose(found)
        y = self.any({"f": "f", "i": "i", "b": "b"}[dtype.kind])
        return jnp.resize(y, x.shape).astype(dtype)

    def axis(self, x):
        return int(self.rng.integers(x.ndim))

    def count(self, most):
        """A small whole number that members compute."""
        return jnp.clip(self.any("i").ravel()[0], 0, most)

    def add(self, kinds):
        made = getattr(self, self.choose(kinds))()
        for x in made if isinstance(made, list | tuple) else [made]:
            if x.size <= 16:
                self.pool.append(x)

    # one operation each

    def unary(self):
        x = self.any("f")
        names = "neg abs sign floor ceil round sqrt rsqrt cbrt square reciprocal exp exp2 expm1 log log1p logistic "
        names += "sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh"
        return getattr(lax, self.choose(names.split()))(x)

    def unary_jnp(self):
        x = self.any("f")
        return self.choose(
            [
                jnp.isnan,
                jnp.isinf,
                jnp.isfinite,
                jnp.log2,
                jnp.nan_to_num,
                jnp.sinc,
                jax.nn.softplus,
                jnp.rint,
                jnp.trunc,
                lambda x: lax.integer_pow(x, int(self.rng.integers(-3, 6))),
                lambda x: lax.reduce_precision(x, *((11, 52) if x.dtype == np.float64 else (8, 23))),
                lambda x: 0 * x + 1,
                lambda x: jnp.where(x > 0, jnp.sqrt(x), 0.0),
            ]
        )(x)

    def binary(self):
        x = self.any("f")
        y = self.like(x)
        names = "add sub mul div max min atan2 rem add sub mul"
        return getattr(lax, self.choose(names.split()))(x, y)

    def binary_jnp(self):
        x = self.any("fi")
        y = self.like(x)
        if x.dtype.kind == "i":
            y = y ^ 1  # XLA takes x // x for 1, even if x = 0
            return self.choose([jnp.floor_divide, jnp.mod, jnp.maximum, jnp.subtract, jnp.minimum])(x, y)
        powers = [lambda x, y: jnp.abs(x) ** jnp.tanh(y), lambda x, y: x ** (2 + 0 * self.like(y, np.int32))]
        return self.choose([jnp.hypot, jnp.mod, jnp.logaddexp, jnp.floor_divide, jnp.heaviside, *powers])(x, y)

    def compare(self):
        x = self.any()
        return getattr(lax, self.choose(["eq", "ne", "lt", "le", "gt", "ge"]))(x, self.like(x))

    def whole(self):
        x = self.any("i")
        y = self.like(x) ^ 1  # see `binary_jnp`
        names = "add sub mul div rem max min bitwise_and bitwise_or bitwise_xor shift_left shift_right_logical "
        names += "shift_right_arithmetic"
        return getattr(lax, self.choose(names.split()))(x, y)

    def whole_unary(self):
        x = self.any("i")
        least, most = x.dtype.type(-2), x.dtype.type(3)
        cut = [lambda x: x**3, lambda x: lax.clamp(least, x, most)]
        return self.choose([lax.neg, lax.abs, lax.sign, lax.bitwise_not, *cut])(x)

    def truth(self):
        x = self.any("b")
        y = self.like(x)
        return self.choose([lax.bitwise_and, lax.bitwise_or, lax.bitwise_xor, lax.max, lax.min, lambda x, y: ~x])(x, y)

    def convert(self):
        return self.any().astype(self.choose(TYPES))

    def select(self):
        x = self.any()
        y, test = self.like(x), self.like(x, bool)
        if self.rng.random() < 0.3:
            return lax.select_n(self.like(x, np.int32), x, y, self.like(x))
        if x.dtype.kind == "f" and self.rng.random() < 0.3:
            return lax.clamp(y, x, self.like(x))
        return jnp.where(test, x, y)

    def reduce(self):
        x = self.any(least=1)
        names = "sum prod max min argmax argmin all any"
        names += " mean var" if x.dtype.kind == "f" else ""
        x = x if x.dtype.kind != "f" or x.size < 9 else x / (1 + jnp.abs(x))
        return getattr(jnp, self.choose(names.split()))(x, axis=self.choose([None, self.axis(x)]))

    def cumulate(self):
        x = self.any("fi", least=1)
        f = getattr(lax, self.choose(["cumsum", "cumprod", "cummax", "cummin"]))
        return f(x, axis=self.axis(x), reverse=bool(self.rng.integers(2)))

    def product(self):
        x = self.any(least=1)
        y = self.like(x)
        if x.ndim != 2:
            return self.choose([jnp.dot, jnp.outer])(x.ravel(), y.ravel())
        rule = self.choose(["ij,kj->ik", "ij,ij->i", "ij,ik->jk", "ij,ij->", "ij,ij->j"])
        return jnp.einsum(rule, x, y)

    def move(self):
        x = self.any(least=1)
        k = int(self.rng.integers(-2, 3))
        moves = [
            lambda x: x.T,
            lambda x: x.ravel(self.choose(["C", "F"])),
            lambda x: jnp.flip(x, self.axis(x)),
            lambda x: jnp.roll(x, k, self.axis(x)),
            lambda x: x[..., ::2],
            lambda x: x[None, ..., 1:],
            lambda x: jnp.concatenate([x, self.like(x)], self.axis(x)),
            lambda x: jnp.stack([x, self.like(x)], self.axis(x)),
            lambda x: lax.pad(x, x.ravel()[0], [(k, 1 - k, 0)] + [(0, 0, 1)] * (x.ndim - 1)),
            lambda x: jnp.tile(x, 2),
            lambda x: jnp.split(x, [1], self.axis(x))[1],
            lambda x: jnp.broadcast_to(x[0], (2, *x[0].shape)),
            lambda x: jnp.squeeze(x[:1], 0),
        ]
        return self.choose(moves)(x)

    def gather(self):
        x, k, mode = self.any(least=1), self.any("i"), self.choose(["clip", "fill", None])
        return self.choose(
            [
                lambda: x.at[k].get(mode=mode),
                lambda: x[..., k],
                lambda: jnp.take(x, k, axis=self.axis(x), mode="fill"),
                lambda: lax.dynamic_index_in_dim(x, k.ravel()[0], self.axis(x)),
                lambda: lax.dynamic_slice_in_dim(x, k.ravel()[0], 2, self.axis(x)),
                lambda: jnp.take_along_axis(x, jnp.resize(k, x.shape) % x.shape[0], 0),
            ]
        )()

    def scatter(self):
        x, k, mode = self.any(least=1), self.any("i").ravel()[:1], self.choose(["clip", "drop", None])
        row = self.like(x[0])
        kinds = ["set", "max", "min", *(["add", "multiply"] if x.dtype.kind != "b" else [])]
        return self.choose(
            [
                lambda: getattr(x.at[k], self.choose(kinds))(row[None], mode=mode),
                lambda: getattr(x.at[..., k[0]], self.choose(kinds))(x.ravel()[0], mode=mode),
                lambda: x.at[k].apply(lambda y: jnp.where(y > 0, y, y * 2) if x.dtype.kind != "b" else ~y, mode=mode),
                lambda: lax.dynamic_update_slice_in_dim(x, row[None], k[0], 0),
            ]
        )()

    def branch(self):
        x, k = self.any("f"), self.any("i").ravel()[0]
        y = self.like(x)
        sides = [lambda x, y: x + y, lambda x, y: jnp.sin(x) * y, lambda x, y: jnp.where(x > y, x, -y)]
        if self.rng.random() < 0.5:
            return lax.switch(k, sides, x, y)
        return lax.cond(self.any("b").ravel()[0], *sides[:2], x, y)

    def loop(self):
        x = self.any("f")
        y, n = self.like(x), self.count(4)
        kind = self.rng.integers(4)
        if kind == 0:
            return lax.fori_loop(0, n, lambda k, z: 0.5 * z + y * k, x)
        if kind == 1:
            return lax.while_loop(
                lambda c: (c[1] < 6) & jnp.any(jnp.abs(c[0]) > 0.5), lambda c: (0.5 * c[0], c[1] + 1), (x, n)
            )
        rows = jnp.stack([x, y, x + y]) if kind == 2 else jnp.stack([x, y] * 3)
        stage = (lambda c, row: (0.5 * c + jnp.sin(row), c)) if kind == 2 else (lambda c, row: (0.7 * c - row, None))
        return [z for z in lax.scan(stage, y, rows, reverse=bool(self.rng.integers(2))) if z is not None]

    def call(self):
        x = self.any("f")
        inner = functools.partial(random_scalar, int(self.rng.integers(2**31)))
        return self.choose([jax.jit, jax.checkpoint])(inner)(x)

    def mapped(self):
        x = self.any("f", least=1)
        inner = functools.partial(random_scalar, int(self.rng.integers(2**31)))
        return jax.vmap(inner)(x)

    def derivative(self):
        x = self.any("f")
        inner = functools.partial(random_scalar, int(self.rng.integers(2**31)))
        short = x.ravel()[:2]
        return self.choose(
            [
                lambda: jax.grad(inner)(x),
                lambda: jax.jvp(inner, (x,), (self.like(x),))[1],
                lambda: jax.hessian(inner)(short),
                lambda: jax.jacfwd(jax.grad(inner))(short),
                lambda: jax.value_and_grad(inner)(x),
                lambda: jax.vjp(inner, x)[1](jnp.ones((), x.dtype))[0],
            ]
        )()


_HELPERS = {"choose", "any", "like", "axis", "count", "add"}
ALL = ["unary", "unary", "binary", "gather", "scatter", "product"]
ALL += [name for name in vars(Maker) if not name.startswith("_") and name not in _HELPERS]


def random_scalar(seed, x):
    """A random smooth function of an array, with a value (): for derivatives and inner calls."""
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=8)
    z = x * weights[0] + jnp.roll(x, 1) * weights[1] if x.ndim else x * weights[0]
    for _ in range(rng.integers(1, 4)):
        z = [
            lambda z: jnp.sin(z) + weights[2] * z,
            lambda z: z * jnp.exp(-z * z),
            lambda z: jnp.log1p(z * z) * weights[3],
            lambda z: jnp.sqrt(1 + z * z) - jnp.cumsum(z.ravel())[-1] * 0.1,
            lambda z: jnp.where(z > weights[4], z * z, jnp.cos(z)),
            lambda z: z / (1.5 + jnp.cos(z)) + z.ravel()[0],
            lambda z: z.at[..., 0].multiply(weights[5]) if z.ndim else z,
            lambda z: jnp.tanh(z) * jnp.max(z) + jnp.arctan(z),
            lambda z: lax.fori_loop(0, 3, lambda _, y: jnp.sin(y) + 0.3 * z, z),
            lambda z: jnp.concatenate([z.ravel()[1:], z.ravel()]) @ jnp.arange(2.0 * z.size - 1).astype(z.dtype) + z,
        ][rng.integers(10)](z).astype(x.dtype)
    return jnp.sum(z * z) if rng.random() < 0.5 else jnp.mean(z)


def random_function(seed, most=7):
    """A function of arrays as `ARGUMENTS` lists them, with a few results."""

    def function(*arrays):
        rng = np.random.default_rng(seed)
        maker = Maker(rng, map(jnp.asarray, arrays))
        for _ in range(rng.integers(3, most)):
            maker.add(ALL)
        return maker.pool[-4:]

    function.__name__ = f"random_function_{seed}"
    return function
