"""Outside of `jax.jit` a call means what its functions mean now, whatever they read and however it has changed."""

import concurrent.futures
import gc
import inspect
import itertools
import sys
import threading
import types
import weakref

import jax
import jax.numpy as jnp
import numpy as np
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


# Every public function that accepts one -------------------------------------------------------------------------------

K, ARRAY, HELD = 1.0, np.ones(3), types.SimpleNamespace(k=1.0)


def number():
    """A number that depends on a global, an array and an attribute."""
    return float(K * ARRAY[1] * HELD.k)


def change_global():
    globals()["K"] = 1.25


def change_array():
    ARRAY[1] = 1.5


def change_attribute():
    HELD.k = 0.75


@pytest.fixture
def changes():
    """Changes of the number, one after the other."""
    yield change_global, change_array, change_attribute
    globals()["K"], ARRAY[1], HELD.k = 1.0, 1.0, 1.0


J = [1.0, 2.0, 3.0]
MOTION = {"attitude": [0.8, 0.6, 0, 0], "angular_velocity": [0.3, 0.2, 1.0]}
DT = 0.05
NUMBERS = itertools.count()  # of stores


def driven(k):
    """A body with a torque of k(), and a state of it."""
    body = li.systems.torqued_body(J, lambda t, q, omega: -0.1 * k() * jnp.array([1.0, 0, 0]) * omega)
    return li.schemes.torqued_midpoint(body), body.state(**MOTION)


def top(k):
    """A top in a potential of k(), and a state of it."""
    body = li.systems.potential_top(J, lambda direction: k() * (direction[2] + direction[0] ** 2))
    return li.schemes.splitting(body), body.state(**MOTION)


def free(_):
    body = li.systems.rigid_body(J)
    return li.schemes.so3_midpoint(body), body.state(**MOTION)


def two(state):
    return jax.tree.map(lambda x: jnp.stack([x, x]), state)


def of(make, call):
    """k ↦ a function without arguments, which calls with the step and the state that `make` has made."""

    def case(k):
        step, state = make(k)
        return lambda: call(step, state)

    return case


def of_condition(call):
    """As `of`, with a condition of k()."""

    def case(k):
        (step, state), condition = free(k), lambda z: z.q[3] - 0.3 * k()
        return lambda: call(step, state, condition)

    return case


def reduced(**options):
    def case(k):
        (step, state), value, flag = free(k), lambda s, z: k() * z.q[3], lambda s, z: z.q[3] > 0.4 * k()
        more = options | ({"first": flag} if options else {})
        return lambda: li.run(step, two(state), DT, 8, save_every=None, reduce=value, **more).summary

    return case


def made_states(k):
    step, state = free(k)
    states = lambda m: jax.vmap(lambda _: state._replace(p=k() * state.p))(jnp.asarray(m))  # noqa: E731
    return lambda: li.run(step, states, DT, 2, members=2).state.p


def fitted(**options):
    def case(k):
        t = jnp.linspace(0.0, 1.0, 5)
        residuals = lambda p: p["a"] * t + p["b"] - k() * (2 * t + 1)  # noqa: E731
        loss = residuals if options.get("optimizer") != "lbfgs" else lambda p: jnp.sum(residuals(p) ** 2)
        start = {"a": jnp.zeros(()), "b": jnp.zeros(())}
        if options.get("starts"):
            start = jax.tree.map(lambda x: jnp.stack([x, x + 1]), start)
        return lambda: li.fit(loss, start, progress=False, **options).params

    return case


def mapped(k):
    (step, state), value = free(k), lambda s, z: k() * z.q
    run = li.run(step, state, DT, 2)
    return lambda: run.map(value)


def scanned(k):
    f = lambda c, x: (c + k(), k() * c)  # noqa: E731
    return lambda: li.scan(f, 0.0, length=3)


def slope_of_scan(k):
    f = lambda c, x: (k() * jnp.sin(c), None)  # noqa: E731
    return lambda: jax.grad(lambda c: li.scan(f, c, length=3)[0])(0.5)


def stored(k):
    step, state = driven(k)
    return lambda folder: li.run(step, state, DT, 2, store=folder / f"{next(NUMBERS)}.zarr").state.p


def submitted(k):
    step, state = driven(k)

    def call(folder):
        with concurrent.futures.ThreadPoolExecutor(1) as executor:
            given = {"parts": 1, "executor": executor, "progress": False}
            return li.submit(step, two(state), DT, 2, store=folder / f"{next(NUMBERS)}.zarr", **given).state.p

    return call


def equilibrium(k):
    body = li.systems.potential_top(J, lambda d: k() * d[2] + d[0] + 0.5 * d[0] ** 2)
    guess = body.state([0.7, 0.1, 0.7, 0.1], angular_velocity=[0, 0, 0])
    return lambda: li.equilibrium(body, guess).state.q


def modes(k):
    body = li.systems.potential_top(J, lambda d: k() * (d[2] + 0.1 * d[0] ** 2))
    state = body.state([0, 1.0, 0, 0], angular_velocity=[0, 0, 0])
    return lambda: li.normal_modes(body, state).frequencies


def covariance(k):
    t = jnp.linspace(0.0, 1.0, 5)
    residuals = lambda p: k() * (p * t - 1)  # noqa: E731
    return lambda: li.fitting.covariance(residuals, jnp.ones(1))


def member_by_member(k):
    of_one = li.fitting.member_by_member(lambda p, d: k() * p * d)
    return lambda: of_one(jnp.ones(()), jnp.arange(3.0))


def group_conservation(k):
    tau = li.maps.scaled_cayley(lambda x: 1 + 0.1 * k() * x)
    return lambda: li.diagnostics.group_conservation(li.groups.special_orthogonal(3), tau, 1).energy


def over_members(k):
    function = li.over_members(lambda x: k() * x)
    return lambda: function(jnp.arange(3.0))


def explained(k):
    def step(c, _):
        for _ in range(int(8 * k())):
            c = jnp.sin(c)
        return c, None

    return lambda: str([loop.operations for loop in li.explain(lambda x: li.scan(step, x, length=3)[0], 1.0)])


def by_xla(call):
    with li.engine("xla"):
        return call()


D = li.diagnostics
UNDO = li.ReversibleAdjoint()
CASES = {
    "run": of(driven, lambda step, state: li.run(step, state, DT, 2).state.p),
    "run of many": of(driven, lambda step, state: li.run(step, two(state), DT, 2).state.p),
    "run by XLA": of(driven, lambda step, state: by_xla(lambda: li.run(step, state, DT, 2).state.p)),
    "run at times": of(driven, lambda step, state: li.run(step, state, DT, 2, save_at=[0.07]).state.p),
    "run of a potential": of(top, lambda step, state: li.run(step, state, DT, 2, reduce="energy").summary.greatest),
    "run, reduce": reduced(),
    "run, first": reduced(per="member"),
    "run, states": made_states,
    "run, store": stored,
    "submit": submitted,
    "over_members": over_members,
    "Run.map": mapped,
    "Run.extend": of(driven, lambda step, state: li.run(step, state, DT, 2).extend(2).state.p),
    "Run.energy_error": of(top, lambda step, state: li.run(step, state, DT, 2).energy_error()),
    "integrate": of(driven, lambda step, state: li.integrate(step, state, DT, 2).state.p),
    "integrate at times": of(driven, lambda step, state: li.integrate(step, state, DT, 2, save_at=[0.07]).state.p),
    "integrate by times": of(driven, lambda step, state: li.integrate(step, state, times=[0, 0.1, 0.3]).state.p),
    "integrate in vmap": of(
        driven, lambda step, state: jax.vmap(lambda z: li.integrate(step, z, DT, 2).state.p)(two(state))
    ),
    "integrate in jit": of(driven, lambda step, state: jax.jit(lambda z: li.integrate(step, z, DT, 2).state.p)(state)),
    "gradient of integrate": of(
        driven, lambda step, state: jax.grad(lambda h: li.integrate(step, state, h, 3).state.p[-1, 0])(DT)
    ),
    "undone, at times": of(
        driven, lambda step, state: li.integrate(step, state, DT, save_at=[0.07, 0.1], adjoint=UNDO).state.p
    ),
    "undone": of(top, lambda step, state: li.integrate(step, state, DT, 2, save_every=2, adjoint=UNDO).state.p),
    "gradient by undoing": of(
        top, lambda step, state: jax.grad(lambda h: li.integrate(step, state, h, 4, 4, adjoint=UNDO).state.p[-1, 0])(DT)
    ),
    "transition": of(driven, lambda step, state: li.transition(step, state, DT, 2)),
    "event": of_condition(lambda step, state, g: li.event(step, state, DT, g, 60).t),
    "section": of_condition(lambda step, state, g: D.section(step, two(state), DT, g, max_steps=60, count=1).t),
    "section of many": of_condition(lambda step, state, g: D.section(step, two(state), DT, g, max_steps=60, count=9).t),
    "scan": scanned,
    "gradient of scan": slope_of_scan,
    "explain": explained,
    "fit": fitted(),
    "fit, lbfgs": fitted(optimizer="lbfgs"),
    "fit, scipy": fitted(optimizer="scipy"),
    "fit, starts": fitted(starts=True),
    "covariance": covariance,
    "member_by_member": member_by_member,
    "equilibrium": equilibrium,
    "normal_modes": modes,
    "certify": of(top, lambda step, state: str(D.certify(step, state, DT, 20))),
    "conditions": of(top, lambda step, state: str(D.conditions(step, state, DT))),
    "Run.of": of(top, lambda step, state: li.Run.of(step, li.integrate(step, state, DT, 2)).energy_error()),
    "exponent_of_neighbors": of(driven, lambda step, state: D.exponent_of_neighbors(step, state, DT, 20)),
    "exponents_of_flow": of(driven, lambda step, state: D.exponents_of_flow(step.system, state, 0.1, 2)),
    "flow": of(driven, lambda step, state: D.flow(step.system, state, 0.1, 4).p),
    "linearization": of(driven, lambda step, state: D.linearization(step, state, DT)),
    "local_error": of(driven, lambda step, state: D.local_error(step, state, DT)),
    "lyapunov": of(driven, lambda step, state: D.lyapunov(step, state, DT, 10).exponents),
    "megno": of(driven, lambda step, state: D.megno(step, state, DT, 10).mean),
    "modified_energy": of(top, lambda step, state: D.modified_energy(step, state, DT)),
    "order": of(driven, lambda step, state: D.order(step, state, 0.2)),
    "symplectic_defect": of(driven, lambda step, state: D.symplectic_defect(step, state, DT)),
    "group_conservation": group_conservation,
}


def same(x, y):
    return x == y if isinstance(x, str) else np.array_equal(x, y, equal_nan=True)


QUICK = ("run", "run, reduce", "integrate", "scan", "fit", "Run.map")


@pytest.mark.parametrize("name", [x if x in QUICK else pytest.param(x, marks=pytest.mark.long) for x in CASES])
def test_a_call_means_what_its_functions_mean_now(changes, tmp_path, name):
    """It returns what functions return that nothing has seen before, and that have the present number."""

    def numbers(call):
        found = call(tmp_path) if inspect.signature(call).parameters else call()
        return [x if isinstance(x, str) else np.asarray(x) for x in jax.tree.leaves(found)]

    call = CASES[name](number)
    seen = [numbers(call)]
    for change in changes[: 1 if name in QUICK else None]:
        change()
        present = number()
        now, fresh = numbers(call), numbers(CASES[name](lambda k=present: k))
        assert all(map(same, now, fresh))
        assert not all(map(same, now, seen[-1]))
        seen.append(now)


ACCEPTING = {"step", "system", "condition", "loss", "residuals", "function", "f", "tau"}  # names of arguments
OTHERS = {
    "interpolate": "reads states",
    "jit": "as `jax.jit`",
    "poisson_error": "rounding",
    "reversibility": "rounding",
    "round_trip_error": "rounding",
    "step_cost": "a time",
}


def test_every_public_function_that_accepts_functions_is_a_case():
    rooms = li, li.diagnostics, li.fitting
    found = {
        name
        for room in rooms
        for name in room.__all__
        if inspect.isfunction(function := getattr(room, name))
        and ACCEPTING & set(inspect.signature(function).parameters)
    }
    assert found - set(OTHERS) <= set(CASES)


# What is kept ---------------------------------------------------------------------------------------------------------


def test_what_a_function_read_before_is_freed():
    """A function that reads another large array in each call keeps those of few calls in memory."""
    held = types.SimpleNamespace(k=None)

    class Numbers(np.ndarray):
        """Arrays to which references can be made."""

    references = []
    for _ in range(40):
        held.k = np.ones(1000).view(Numbers)
        references.append(weakref.ref(held.k))
        assert li.scan(lambda c, _: (c + held.k[3], None), 0.0, length=1)[0] == 1
    jax.clear_caches()
    gc.collect()
    assert sum(x() is not None for x in references) <= 16


def test_threads_get_the_numbers_of_their_own_functions():
    errors = []

    def work(k):
        held = types.SimpleNamespace(k=0.0)
        f = lambda c, _: (c + held.k, None)  # noqa: E731
        for n in range(5):
            held.k = 10.0 * k + n
            if li.scan(f, 0.0, length=2)[0] != 2 * held.k:
                errors.append((k, n))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
