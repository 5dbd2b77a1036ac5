"""How far does rounding move the energy of a free body, and what does it cost to do better?

16 bodies of inertia (1, 2, 3), random attitudes, body velocities random in the unit ball, dt = 0.05, the symplectic κ.
All variants are the same scheme; they differ in how the state is stored and updated. |H − H₀|/H₀ of the worst body is
measured at every step; the slope is that of a line through the mean signed error of the bodies at ten times.

    python benchmarks/round_off.py [--quick] [--steps N] [--only NAME …] [--out DIR]

Rates are of 1024 bodies, timed in turn in one process on one core.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from lib import command


def main() -> None:
    parser = command.parser(__doc__)
    parser.add_argument("--steps", type=int, metavar="N", help="10 million; if quick, 100 thousand")
    parser.add_argument("--only", nargs="*", metavar="NAME")
    parser.add_argument("--name", default="round_off", help="of the files written")
    options = command.parsed(parser)
    steps = options.steps or (100_000 if options.quick else 10_000_000)
    command.pin()  # before jax makes its threads
    from lib import measure, report

    names = options.only or list(variants())
    drifts = {name: drift(name, steps) for name in names}
    speeds = rates(names)
    first = speeds[names[0]]
    rows = [
        [name, f"{worst:.2g}", f"{slope:.1e}", f"{speeds[name] / 1e6:.3g}", f"{speeds[name] / first:.2f}"]
        for name, (worst, slope) in drifts.items()
    ]
    head = ["", "worst of 16", "slope, a step", "million body-steps/s", "÷ the first"]
    result = {"machine": measure.machine(), "steps": steps, "drifts": drifts, "rates": speeds}
    title = f"Largest |H − H₀|/H₀ over {steps:.0e} steps, dt = {measure.DT}"
    report.publish(options.name, [report.machine(result), title, report.table(head, rows)], result, options.out)


def variants() -> dict[str, Callable[[Any, Any], Any]]:
    """The functions (carry, constants) ↦ the carry after a step, by name. A carry is (q, low bits of q, π)."""
    import jax.numpy as jnp
    from lib import measure

    import lieint_jax as li
    from lieint_jax._numerics import vectors
    from lieint_jax.core import State
    from lieint_jax.groups import so3
    from lieint_jax.schemes._shared.half_rotation import half_cayley, scalar_root, scaled

    body, dt = measure.body(), measure.DT
    newton = li.schemes.so3_midpoint(body)

    def half(q: Any, p: Any, m: Any = None) -> Any:
        J, a = scaled(body, State(q, p), dt)
        return J, a, half_cayley(J, a, scalar_root(J, a, 3) if m is None else m)

    def by_newton(carry: Any, _: Any) -> Any:
        q, low, p = carry
        return newton(State(q, p), dt)[0].q, low, p

    def product(carry: Any, _: Any) -> Any:
        q, low, p = carry
        return so3.normalize(so3.multiply(q, so3.cayley(2 * half(q, p)[2]))), low, p

    def explicit(carry: Any, m: Any) -> Any:
        q, low, p = carry
        return so3.cayley_increment(q, half(q, p, m[0])[2]), low, p

    def compensated(carry: Any, m: Any) -> Any:
        q, low, p = carry
        d = low + delta(q, half(q, p, m[0])[2])
        new = q + d
        return new, d - (new - q), p

    def delta(q: Any, h: Any) -> Any:
        """`cayley_increment` less q."""
        w, v = q[0], (q[1], q[2], q[3])
        y = vectors.dot(h, h)
        s = jnp.sqrt(1 + y)
        r = 1 / (s * (1 + s))
        c = r * (1 + s)
        d = c * so3.defect(q) / 2
        k, c = -y * r - d, c - d
        ch = (c * h[0], c * h[1], c * h[2])
        x = vectors.cross(v, ch)
        return jnp.stack([w * k - vectors.dot(v, ch), *(w * ch[i] + k * v[i] + x[i] for i in range(3))])

    def with_energy_increment(carry: Any, m: Any) -> Any:
        """The step of `so3_explicit`, see `half_cayley`."""
        q, low, p = carry
        return so3.cayley_increment(q, half_cayley(*scaled(body, State(q, p), dt), *m)), low, p

    return {
        "Newton, increment": by_newton,
        "Newton, product, normalized": product,
        "explicit, increment": explicit,
        "explicit, increment, compensated": compensated,
        "explicit, increment, energy held": with_energy_increment,
    }


def _loop(name: str, watch: bool) -> Callable[..., Any]:
    """The compiled function (carry, m, H₀, steps) ↦ the carry and the largest |H − H₀|/H₀ of each body so far."""
    import jax
    import jax.numpy as jnp
    from jax import lax
    from lib import measure

    from lieint_jax.core import State
    from lieint_jax.runs import compiler_options

    step, body = variants()[name], measure.body()

    @partial(jax.jit, compiler_options=compiler_options())
    def run(carry: Any, m: Any, H0: Any, steps: Any) -> Any:
        def advance(_: Any, loop: Any) -> Any:
            carry, worst = loop
            carry = jax.vmap(step)(carry, m)
            if watch:
                H = jax.vmap(lambda q, p: body.energy(State(q, p)))(carry[0], carry[2])
                worst = jnp.maximum(worst, jnp.abs(H - H0) / H0)
            return carry, worst

        return lax.fori_loop(0, steps, advance, (carry, jnp.zeros_like(H0)))

    return run


def _begin(count: int) -> tuple[Any, Any, Any]:
    import jax
    import jax.numpy as jnp
    from lib import measure

    import lieint_jax as li

    q, p = (jnp.asarray(x) for x in measure.bodies(count))
    body = measure.body()

    def constants(q: Any, p: Any) -> Any:
        step = li.schemes.so3_explicit(body).prepare(li.State(q, p), measure.DT)
        return step.m, step.gain

    m = jax.jit(jax.vmap(constants))(q, p)
    H0 = jax.jit(jax.vmap(lambda q, p: body.energy(li.State(q, p))))(q, p)
    return (q, jnp.zeros_like(q), p), m, H0


def drift(name: str, steps: int, bodies: int = 16) -> tuple[float, float]:
    """The worst error at any step, and the slope of the mean signed error per step."""
    import jax
    import numpy as np
    from lib import measure

    import lieint_jax as li

    carry, m, H0 = _begin(bodies)
    run, energy = _loop(name, True), jax.jit(jax.vmap(lambda q, p: measure.body().energy(li.State(q, p))))
    worst, means = 0.0, [0.0]
    for _ in range(10):
        carry, found = run(carry, m, H0, steps // 10)
        worst = max(worst, float(found.max()))
        means.append(float(np.mean((energy(carry[0], carry[2]) - H0) / H0)))
    t = np.arange(11) * (steps // 10)
    return worst, float(t @ np.array(means) / (t @ t))


def rates(names: list[str], bodies: int = 1024, rounds: int = 7) -> dict[str, float]:
    """Body-steps a second, from the best of `rounds` calls, timed in turn."""
    import jax

    carry, m, H0 = _begin(bodies)
    loops = {name: _loop(name, False) for name in names}
    best = dict.fromkeys(names, 0.0)
    for k in range(rounds + 1):
        for name, run in loops.items():
            start = time.perf_counter()
            jax.block_until_ready(run(carry, m, H0, 5000))
            if k:
                best[name] = max(best[name], bodies * 5000 / (time.perf_counter() - start))
    return best


if __name__ == "__main__":
    main()
