"""Outside of `jax.jit` a call means what its functions mean now, whatever they read and however it has changed."""

import sys
import types

import pytest

import lieint_jax as li

# How a function reads a number ----------------------------------------------------------------------------------------

WAYS = {  # of a script that defines f(c, x), which adds a number; and of a change of the number from 1 to 2
    "a global": ("k = 1.0\ndef f(c, x): return c + k, None", "k = 2.0"),
    "a global of a global function": ("k = 1.0\ndef g(): return k\ndef f(c, x): return c + g(), None", "k = 2.0"),
    "a global function": ("def g(): return 1.0\ndef f(c, x): return c + g(), None", "def g(): return 2.0"),
    "a global of an inner function": ("k = 1.0\ndef f(c, x):\n def g(): return k\n return c + g(), None", "k = 2.0"),
    "a global in a comprehension": ("k = 1.0\ndef f(c, x): return c + sum([k for _ in range(1)]), None", "k = 2.0"),
    "a default": ("def g(k=1.0): return k\ndef f(c, x): return c + g(), None", "g.__defaults__ = (2.0,)"),
    "a keyword": ("def g(*, k=1.0): return k\ndef f(c, x): return c + g(), None", "g.__kwdefaults__['k'] = 2.0"),
    "an attribute of a function": ("def f(c, x): return c + f.k, None\nf.k = 1.0", "f.k = 2.0"),
    "a closure": (
        "def make():\n k = [1.0]\n def f(c, x): return c + k[0], None\n return k, f\nk, f = make()",
        "k[0] = 2.0",
    ),
    "a variable of a closure": (
        "def make():\n k = 1.0\n def change():\n  nonlocal k\n  k = 2.0\n def f(c, x): return c + k, None\n"
        " return change, f\nchange, f = make()",
        "change()",
    ),
    "nested containers": (
        "k = {'a': [(0.0, {1.0: [1.0]})]}\ndef f(c, x): return c + k['a'][0][1][1.0][0], None",
        "k['a'][0][1][1.0][0] = 2.0",
    ),
    "a container that holds itself": (
        "k = {'k': 1.0}\nk['self'] = k\ndef f(c, x): return c + k['self']['k'], None",
        "k['k'] = 2.0",
    ),
    "a set": ("k = {1.0}\ndef f(c, x): return c + max(k), None", "k.add(2.0)"),
    "a queue": ("k = collections.deque([1.0])\ndef f(c, x): return c + k[0], None", "k[0] = 2.0"),
    "an attribute": ("class M: pass\nm = M()\nm.k = 1.0\ndef f(c, x): return c + m.k, None", "m.k = 2.0"),
    "an attribute by its name": (
        "class M: pass\nm = M()\nm.k = 1.0\ndef f(c, x): return c + getattr(m, 'k'), None",
        "m.k = 2.0",
    ),
    "a slot": ("class M: __slots__ = 'k',\nm = M()\nm.k = 1.0\ndef f(c, x): return c + m.k, None", "m.k = 2.0"),
    "a frozen dataclass": (
        "@dataclasses.dataclass(frozen=True)\nclass M: k: float\nm = M(1.0)\ndef f(c, x): return c + m.k, None",
        "m = dataclasses.replace(m, k=2.0)",
    ),
    "a named tuple": (
        "M = collections.namedtuple('M', 'k')\nm = M([1.0])\ndef f(c, x): return c + m.k[0], None",
        "m.k[0] = 2.0",
    ),
    "a class": ("class M: k = 1.0\ndef f(c, x): return c + M.k, None", "M.k = 2.0"),
    "a class of an object": ("class M: k = 1.0\nm = M()\ndef f(c, x): return c + m.k, None", "M.k = 2.0"),
    "a base class": ("class A: k = 1.0\nclass M(A): pass\nm = M()\ndef f(c, x): return c + m.k, None", "A.k = 2.0"),
    "a property": (
        "k = 1.0\nclass M:\n @property\n def k(self): return k\nm = M()\ndef f(c, x): return c + m.k, None",
        "k = 2.0",
    ),
    "a static method": (
        "k = 1.0\nclass M:\n @staticmethod\n def g(): return k\ndef f(c, x): return c + M.g(), None",
        "k = 2.0",
    ),
    "a class method": (
        "class M:\n k = 1.0\n @classmethod\n def g(cls): return cls.k\ndef f(c, x): return c + M.g(), None",
        "M.k = 2.0",
    ),
    "a bound method": (
        "class M:\n def step(self, c, x): return c + self.k, None\nm = M()\nm.k = 1.0\nf = m.step",
        "m.k = 2.0",
    ),
    "an object that is called": (
        "class M:\n def __call__(self, c, x): return c + self.k, None\nf = M()\nf.k = 1.0",
        "f.k = 2.0",
    ),
    "a method of a parent": (
        "class A:\n def g(self): return self.k\nclass M(A):\n k = 1.0\n"
        " def step(self, c, x): return c + super().g(), None\nf = M().step",
        "M.k = 2.0",
    ),
    "a partial function": (
        "k = [1.0]\ndef g(k, c, x): return c + k[0], None\nf = functools.partial(g, k)",
        "k[0] = 2.0",
    ),
    "a partial method": (
        "k = [1.0]\nclass M:\n def g(self, k, c, x): return c + k[0], None\n"
        " __call__ = functools.partialmethod(g, k)\nf = M()",
        "k[0] = 2.0",
    ),
    "a decorated function": (
        "k = 1.0\ndef scaled(g):\n @functools.wraps(g)\n def h(c, x): return g(c + (k - 1), x)\n return h\n"
        "@scaled\ndef f(c, x): return c + 1.0, None",
        "k = 2.0",
    ),
    "a function under a decorator": (
        "k = 1.0\ndef same(g):\n @functools.wraps(g)\n def h(*a): return g(*a)\n return h\n"
        "@same\ndef f(c, x): return c + k, None",
        "k = 2.0",
    ),
    "a decorator that claims to be numpy's": (
        "k = 1.0\n@functools.wraps(np.sum)\ndef f(c, x): return c + k, None",
        "k = 2.0",
    ),
    "a class from exec": (
        "exec('class M: k = 1.0', n := {})\nM = n['M']\ndef f(c, x): return c + M.k, None",
        "M.k = 2.0",
    ),
    "an array in place": ("k = np.ones(3)\ndef f(c, x): return c + k[1], None", "k[1] = 2.0"),
    "a large array in place": ("k = np.ones(100_000)\ndef f(c, x): return c + k[77_777], None", "k[77_777] = 2.0"),
    "a view of an array": ("k = np.ones(8)\nv = k[::2]\ndef f(c, x): return c + v[1], None", "k[2] = 2.0"),
    "an array of objects": ("k = np.array([1.0, 'a'], object)\ndef f(c, x): return c + k[0], None", "k[0] = 2.0"),
    "an array of JAX": ("k = jnp.ones(())\ndef f(c, x): return c + k, None", "k = k + 1"),
    "a number of numpy": ("k = np.float64(1.0)\ndef f(c, x): return c + k, None", "k = np.float64(2.0)"),
    "a gradient": ("k = 1.0\ng = jax.grad(lambda y: k * y)\ndef f(c, x): return c + g(1.0), None", "k = 2.0"),
    "a vectorized function": (
        "k = 1.0\ng = jnp.vectorize(lambda y: k * y)\ndef f(c, x): return c + g(1.0), None",
        "k = 2.0",
    ),
    "a vmapped function": (
        "k = 1.0\ng = jax.vmap(lambda y: k * y)\ndef f(c, x): return c + g(jnp.ones(1))[0], None",
        "k = 2.0",
    ),
    "a custom derivative": (
        "k = 1.0\ng = jax.custom_jvp(lambda y: k * y)\ng.defjvp(lambda p, t: (g(*p), t[0]))\n"
        "def f(c, x): return c + g(1.0), None",
        "k = 2.0",
    ),
    "a spline": (
        "from scipy.interpolate import PPoly\ng = PPoly(np.ones((1, 1)), [0.0, 1.0])\n"
        "def f(c, x): return c + g.c[0, 0], None",
        "g.c[0, 0] = 2.0",
    ),
    "a module": ("import gains\ndef f(c, x): return c + gains.k, None", "gains.k = 2.0"),
    "a function of a module": ("import gains\ndef f(c, x): return c + gains.g(), None", "gains.k = 2.0"),
    "a module as an argument": ("import gains\ndef f(c, x): return c + getattr(gains, 'k'), None", "gains.k = 2.0"),
    "a module in an object": (
        "import gains\nclass M: pass\nm = M()\nm.gains = gains\ndef f(c, x): return c + m.gains.k, None",
        "gains.k = 2.0",
    ),
    "a module in a module": ("import gains\ndef f(c, x): return c + gains.inner.k - 1.0, None", "gains.inner.k = 3.0"),
    "an import inside": ("def f(c, x):\n import gains\n return c + gains.k, None", "import gains\ngains.k = 2.0"),
    "an import from inside": ("def f(c, x):\n from gains import k\n return c + k, None", "import gains\ngains.k = 2.0"),
}
UNREADABLE = {  # is traced in each call
    "a name of globals()": ("k = 1.0\ndef f(c, x): return c + globals()['k'], None", "k = 2.0"),
    "eval": ("k = 1.0\ndef f(c, x): return c + eval('k'), None", "k = 2.0"),
    "a generator": (
        "def g():\n while True: yield k\nk, values = 1.0, g()\ndef f(c, x): return c + next(values), None",
        "k = 2.0",
    ),
    "the environment": (
        "os.environ['LIEINT_TEST_K'] = '1'\ndef f(c, x): return c + float(os.environ['LIEINT_TEST_K']), None",
        "os.environ['LIEINT_TEST_K'] = '2'",
    ),
}


@pytest.fixture
def script(monkeypatch):
    """A namespace like that of a notebook, with a module of the user's that it may import."""
    for name, code in {"gains": "k = 1.0\ndef g(): return k", "gains.inner": "k = 2.0"}.items():
        module = types.ModuleType(name)
        exec(code, vars(module))
        monkeypatch.setitem(sys.modules, name, module)
    sys.modules["gains"].inner = sys.modules["gains.inner"]
    monkeypatch.setenv("LIEINT_TEST_K", "1")
    made = types.ModuleType("script")
    exec(
        "import collections, dataclasses, functools, logging, os, sys\nimport jax, jax.numpy as jnp, numpy as np",
        vars(made),
    )
    monkeypatch.setitem(sys.modules, "script", made)
    return vars(made)


LOGGED = "\nlog = logging.getLogger('traced')\ndef step(c, x):\n log.warning('traced')\n return f(c, x)"


@pytest.mark.parametrize("way", [*WAYS, *UNREADABLE])
def test_what_a_function_reads_is_read_again(script, caplog, way):
    code, change = (WAYS | UNREADABLE)[way]
    exec(code + LOGGED, script)
    call = lambda: float(li.scan(script["step"], 0.0, length=1)[0])  # noqa: E731
    assert [call(), call()] == [1.0, 1.0]
    assert len(caplog.records) == (2 if way in UNREADABLE else 1)
    exec(change, script)
    assert [call(), call()] == [2.0, 2.0]
    assert len(caplog.records) == (4 if way in UNREADABLE else 2)
