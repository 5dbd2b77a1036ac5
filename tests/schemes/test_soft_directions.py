"""Steps of systems with stiffnesses, masses or speeds 1 : 10⁸: where `converged` is True, the soft motion is solved.

Each is compared with the same equations in 40 digits, of bodies on springs of length 0 with the midpoint rule, which
is what an energy–momentum scheme is for a quadratic energy. With 1e8 times as fast bodies next to it, the iteration on
forces left the slow pair with an error of 2e-9, and so did Newton's method on groups, which ended by the residual of
all directions together.
"""

import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax.groups import so3, translations

PLACES = np.array([[0, 0, 0], [1, 0.1, 0], [0, 2, 0], [1, 2.5, 0.3]], float)
SLOW = np.array([[0.1, 0.2, 0], [0, -0.1, 0.3], [0.2, 0, 0], [-0.1, 0.1, 0]])
FAST = SLOW * np.array([1e8, 1e8, 1, 1])[:, None]
PAIRS, SERIES = [(0, 1), (2, 3)], [(0, 1), (1, 2), (2, 3)]
CASES = {  # masses, springs, their stiffnesses, velocities, dt
    "a stiff and a soft pair": ([1, 2, 3, 1], PAIRS, [1e8, 1], SLOW, 5e-5),
    "in series": ([1, 2, 3, 1], SERIES, [1e8, 1, 1e8], SLOW, 5e-5),
    "a fast and a slow pair": ([1, 2, 3, 1], PAIRS, [1e-3, 1], FAST, 0.7),
    "a heavy and a light pair": ([1e8, 1e8, 3, 1], PAIRS, [1e8, 1], SLOW, 0.7),
}


def chained(masses, springs, stiffness, velocities):
    n = len(masses)
    potential = li.potentials.springs(springs, np.zeros((len(springs), 2, 3)), jnp.asarray(stiffness, float))
    bodies = li.systems.rigid_bodies(
        jnp.asarray(masses, float), jnp.tile(jnp.array([1.0, 2.0, 2.5]), (n, 1)), potential
    )
    attitudes, rates = [[1.0, 0, 0, 0]] * n, np.zeros((n, 3))
    return bodies, bodies.state(PLACES[:n], attitudes, velocities=velocities, angular_velocities=rates)


def midpoint(masses, springs, stiffness, velocities, dt):
    """The velocities after a step, (n, 3): (M + ¼Δt²K) Δx = Δt (p − ½Δt K x)."""
    with mpmath.workdps(40):
        n = len(masses)
        K, M, dt = mpmath.zeros(n), mpmath.diag(masses), mpmath.mpf(dt)
        for (i, j), k in zip(springs, stiffness, strict=True):
            for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
                K[a, b] += sign * mpmath.mpf(k)
        x, v = mpmath.matrix(PLACES[:n].tolist()), mpmath.matrix(velocities.tolist())
        move = (M + dt**2 / 4 * K) ** -1 * (dt * (M * v - dt / 2 * K * x))
        return np.array((2 * move / dt - v).tolist(), float)


@functools.partial(jax.jit, static_argnames="scheme")
def stepped(scheme, bodies, state, dt):
    make = {"gauss": li.schemes.gauss}.get(scheme)
    step = make(bodies) if make else li.schemes.bodies_energy_momentum(bodies, solver=scheme)
    return step(state, dt)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("solver", ["fixed_point", "newton"])
def test_bodies_on_stiff_and_soft_springs_move_by_the_midpoint_rule(case, solver):
    masses, springs, stiffness, velocities, dt = CASES[case]
    end, info = stepped(solver, *chained(masses, springs, stiffness, velocities), dt)
    assert info.converged
    found = np.asarray(end.p[:, :3]) / np.array(masses, float)[:, None]
    right = midpoint(masses, springs, stiffness, velocities, dt)
    size = np.maximum(np.abs(velocities), np.abs(right)).max(axis=1)  # of each body
    assert np.all(np.abs(found - right).max(axis=1) <= 2e-15 * size)  # 3e-16


@pytest.mark.long
def test_gauss_solves_a_slow_pair_next_to_a_fast_one():
    """The relative velocity of the slow pair turns by ωΔt: u cos ωΔt − r ω sin ωΔt."""
    masses, dt = [1, 2, 3, 1], 0.4
    bodies, state = chained(masses, PAIRS, [1e-3, 1], FAST)
    end, info = stepped("gauss", bodies, state, dt)
    assert info.converged
    rate = np.sqrt(1 * (1 / 3 + 1))
    right = (FAST[3] - FAST[2]) * np.cos(rate * dt) - (PLACES[3] - PLACES[2]) * rate * np.sin(rate * dt)
    np.testing.assert_allclose(end.p[3, :3] / 1 - end.p[2, :3] / 3, right, rtol=0, atol=2e-15)


def wells(k, c, q):
    """Σ ½kx² + ¼cx⁴ of two coordinates, which do not act on each other."""
    x = q[:2, 2]
    return jnp.sum(k * x**2 / 2 + c * x**4 / 4)


@jax.jit
def on_the_plane(masses, k, c, x, v, dt):
    system = li.systems.group_potential(translations(2), masses, jax.tree_util.Partial(wells, k, c))
    state = system.state(jnp.eye(3).at[:2, 2].set(x), velocity=v)
    return li.schemes.group_energy_momentum(system)(state, dt)


@pytest.mark.parametrize(
    ("masses", "k", "c", "v", "dt"),
    [
        ((1, 1), [1e-3, 0], [0, 1], [1e8, 0.2], 0.7),  # 2e-9 before
        ((1, 1), [1e8, 0], [0, 3], [0.1, 0.2], 0.7),  # 2e-10 before
        ((1, 1), [1e16, 0], [0, 3], [0.1, 0.2], 0.7),  # 4e-6 before
        ((1, 1e8), [1e8, 1], [0, 1e8], [0.1, 0.2], 1e-4),
        ((1e8, 1), [1e8, 1], [0, 1], [0.1, 0.2], 0.7),
    ],
    ids=["fast and slow", "stiff and soft", "very stiff and soft", "light and heavy", "heavy and light"],
)
def test_a_soft_coordinate_of_a_group_is_solved_next_to_a_stiff_or_fast_one(masses, k, c, v, dt):
    """m ΔxΔt⁻¹ = p − ½Δt ∫V′(x + sΔx)ds for each coordinate, with (V(x + Δx) − V(x))/Δx as the integral."""
    x = [1.0, 0.9]
    end, info = on_the_plane(*(jnp.asarray(a, float) for a in (masses, k, c, x, v)), dt)
    assert info.converged
    for i in range(2):
        with mpmath.workdps(40):
            m, stiff, quartic, a, speed, h = map(mpmath.mpf, (masses[i], k[i], c[i], x[i], v[i], dt))

            def impulse(move, a=a, stiff=stiff, quartic=quartic, h=h):
                return h * (2 * a + move) / 4 * (2 * stiff + quartic * (a**2 + (a + move) ** 2))

            guess = float(end.q[i, 2]) - x[i]
            move = mpmath.findroot(lambda U, m=m, h=h, v=speed: m * U + h * (impulse(U) / 2 - m * v), guess, tol=1e-60)
            momentum, moved = float(m * speed - impulse(move)), float(move)
        assert abs(end.q[i, 2] - x[i] - moved) <= 3e-16 * max(1, abs(moved))
        size = max(abs(masses[i] * v[i]), abs(momentum), k[i] * dt * x[i])  # a force rounds by kε|x|
        assert abs(end.p[i] - momentum) <= 4e-16 * size


@pytest.mark.long
@pytest.mark.parametrize("rule", ["average", "symplectic"])
def test_an_elastic_body_stiff_along_one_axis_moves_along_the_others(rule):
    """W = Σ k e²/2 with e = (C − 1)/2 and k_xx = 1e8; its equation is solved in 40 digits, entry by entry."""
    k, E, dt = np.ones((3, 3)), np.array([1.0, 2.0, 3.0]), 0.01
    k[0, 0] = 1e8
    F = np.array([[1, 0.02, 0], [-0.01, 1.1, 0.03], [0, 0.02, 0.95]])
    P = np.array([[0, 0.1, 0.2], [-0.1, 0.3, 0], [0.1, 0.05, -0.2]])
    body = li.systems.pseudo_rigid_body(E, lambda C: jnp.sum(jnp.asarray(k) * ((C - jnp.eye(3)) / 2) ** 2) / 2)
    state = body.state(momentum=P)._replace(q=jnp.asarray(F))
    end, info = jax.jit(li.schemes.additive(body, rule))(state, dt)
    assert info.converged
    with mpmath.workdps(40):
        before, p, inertia, h = mpmath.matrix(F.tolist()), mpmath.matrix(P.tolist()), mpmath.diag(E), mpmath.mpf(dt)

        def equation(*entries):
            U = mpmath.matrix([entries[3 * i : 3 * i + 3] for i in range(3)])
            middle, after = before + U / 2, before + U
            C = (before.T * before + after.T * after) / 2 if rule == "average" else middle.T * middle
            S = mpmath.matrix([[k[i, j] * (C[i, j] - (i == j)) / 2 for j in range(3)] for i in range(3)])
            R = U * inertia + h**2 / 2 * middle * S - h * p
            return [R[i, j] for i in range(3) for j in range(3)]

        guess = [mpmath.mpf(float(x)) for x in (np.asarray(end.q) - F).ravel()]
        U = mpmath.findroot(equation, guess, tol=1e-60, verify=False)
        right = np.array([float(x) for x in U]).reshape(3, 3)
    np.testing.assert_allclose(end.q - F, right, rtol=0, atol=1e-15)  # 1e-16


@pytest.mark.parametrize("slow", [0.3, 1e-3])
def test_a_slender_body_spins_slowly_about_its_long_axis(slow):
    """J = (1, 1e8, 1e8 + ½), Π = (slow, 2e7, 5e7) by Cayley's κ: Jy + y × Jy = ½ΔtΠ in 40 digits.

    Rounding errors of y × Jy, over J₁, rotate it by 1e-10 about that axis, where 1e-6 is the limit of a step.
    """
    J, Pi, dt = [1.0, 1e8, 1e8 + 0.5], [slow, 2e7, 5e7], 0.3
    body = li.systems.rigid_body(J)
    end, info = jax.jit(li.schemes.so3_midpoint(body, li.maps.kappa_cayley))(body.state(body_momentum=Pi), dt)
    assert info.converged
    with mpmath.workdps(40):

        def equation(x, y, z):
            a, b, c = J[0] * x, J[1] * y, J[2] * z
            turned = a + y * c - z * b, b + z * a - x * c, c + x * b - y * a
            return [t - mpmath.mpf(dt) / 2 * P for t, P in zip(turned, Pi, strict=True)]

        root = mpmath.findroot(equation, [dt / 2 * P / m for P, m in zip(Pi, J, strict=True)], tol=1e-60, verify=False)
        right = [float(4 * m * y / mpmath.mpf(dt) - P) for m, y, P in zip(J, root, Pi, strict=True)]
    wrong = np.abs(so3.Ad_star(end.q, end.p) - np.array(right))
    assert wrong[0] <= 1e-8  # 1e-9; Π rounds by 6e-9
    assert wrong.max() <= 1e-9 * 5e7  # 6e-11


def hat(v):
    return mpmath.matrix([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def turned(q):
    """The rotation matrix of a quaternion that rounding has left a little off unit length."""
    w, v = q[0], hat(q[1:])
    return mpmath.eye(3) + 2 / sum(x * x for x in q) * (w * v + v * v)


def dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def invariants(x, R, lengths):
    """Γ, s and o of the elements of a rod that is straight in its natural shape, as in `potentials.rod`."""
    found = []
    for e, length in enumerate(lengths):
        a, b = ([list(S[:, k]) for k in range(3)] for S in (R[e], R[e + 1]))
        apart = [(after - before) / length for before, after in zip(x[e], x[e + 1], strict=True)]
        found += [dot([(p + q) / 2 for p, q in zip(a[k], b[k], strict=True)], apart) for k in range(3)]
        found += [(dot(a[k], b[j]) - dot(a[j], b[k])) / 2 for j, k in ((1, 2), (2, 0), (0, 1))]
        found += [sum((p - q) ** 2 for p, q in zip(a[k], b[k], strict=True)) / 2 for k in range(3)]
    return found


def rod_step(rod, state, dt):
    """F of the step, a function of (Δx, y) of all sections in turn, and the momenta at its end."""
    numbers = lambda a: [[mpmath.mpf(float(x)) for x in row] for row in np.asarray(a)]  # noqa: E731
    m, lengths = numbers([rod.masses])[0], numbers([rod.potential.lengths])[0]
    J, C, B = map(numbers, (rod.inertias, rod.potential.stretching, rod.potential.bending))
    x, R, p = numbers(state.q[:, :3]), [turned(q) for q in numbers(state.q[:, 3:])], numbers(state.p)
    n, h = len(m), mpmath.mpf(dt)

    def forces(U):
        y = [U[6 * i + 3 : 6 * i + 6] for i in range(n)]
        x1 = [[a + d for a, d in zip(x[i], U[6 * i : 6 * i + 3], strict=True)] for i in range(n)]
        R1 = [R[i] + 2 / (1 + dot(y[i], y[i])) * (R[i] * (hat(y[i]) + hat(y[i]) ** 2)) for i in range(n)]
        mean = [(a + b) / 2 for a, b in zip(invariants(x, R, lengths), invariants(x1, R1, lengths), strict=True)]
        D = []
        for e, length in enumerate(lengths):
            strain, s = mean[9 * e : 9 * e + 3], mean[9 * e + 3 : 9 * e + 6]
            D += [length * c * (g - g0) for c, g, g0 in zip(C[e], strain, (0, 0, 1), strict=True)]
            D += [-c * t / 3 / length for c, t in zip(B[e], s, strict=True)]
            D += [mpmath.mpf(4) / 3 * (sum(B[e]) / 2 - c) / length for c in B[e]]
        middle = [[(a + b) / 2 for a, b in zip(*ends, strict=True)] for ends in zip(x, x1, strict=True)]
        between, found = [(a + b) / 2 for a, b in zip(R, R1, strict=True)], []
        for i in range(n):  # derivatives of quadratic functions, by central differences
            for k in range(6):
                e, values = [int(j == k % 3) for j in range(3)], []
                for sign in (1, -1):
                    at, S = [list(row) for row in middle], list(between)
                    if k < 3:
                        at[i][k] += sign
                    else:
                        S[i] = S[i] + sign * hat(e) * S[i]
                    values.append(dot(D, invariants(at, S, lengths)))
                found.append((values[1] - values[0]) / 2)
        return found

    def residual(*U):
        F, found = forces(U), []
        for i in range(n):
            y, f, t = U[6 * i + 3 : 6 * i + 6], F[6 * i : 6 * i + 3], F[6 * i + 3 : 6 * i + 6]
            found += [m[i] * d - h * (a + h / 2 * b) for d, a, b in zip(U[6 * i :], p[i][:3], f, strict=False)]
            a, T = h / 2 * (R[i].T * mpmath.matrix(p[i][3:])), h**2 / 4 * (R[i].T * mpmath.matrix(t))
            Jy = mpmath.matrix([j * c for j, c in zip(J[i], y, strict=True)])
            found += list(Jy + hat(y) * Jy - a - T + hat(y) * T)
        return found

    return residual, lambda U: [a + h * b for a, b in zip([x for row in p for x in row], forces(U), strict=True)]


SOFT = dict(mass=1.0, inertia=(0.02, 0.03), stretching=(1.0, 1.0, 1.0), bending=(1.0, 1.0, 1.0))
RODS = {  # what differs from the soft one, and dt
    "masses": (dict(mass=np.array([1.0, 1e8])), 0.05),
    "inertias": (dict(inertia=np.array([[0.02, 0.03], [2e6, 3e6]])), 0.05),
    "extension": (dict(stretching=(1e8, 1e8, 1e8)), 1e-5),
    "bending about an axis": (dict(bending=(1e8, 1.0, 1.0)), 1e-5),
    "elements": (dict(stretching=np.array([[1e8] * 3, [1.0] * 3]), bending=np.array([[1e8] * 3, [1.0] * 3])), 1e-5),
}


@pytest.mark.long
@pytest.mark.parametrize("case", RODS)
def test_newton_s_method_solves_stiff_and_soft_parts_of_a_rod(case):
    other, dt = RODS[case]
    rod = li.systems.rod(2.0, 2, li.systems.Section(**SOFT | other))
    spins, velocities = [[1, 0.3, 0], [0, 0, 0.5], [0, 1, 0]], [[0.1, 0, 0], [0, -0.2, 0.1], [0.2, 0.1, 0]]
    x = np.asarray(rod.natural[:, :3]) + 1e-3 * np.sin(np.arange(9.0).reshape(3, 3))
    state = rod.state(x, velocities=velocities, angular_velocities=spins)
    end, info = jax.jit(li.schemes.bodies_energy_momentum(rod, solver="newton"))(state, dt)
    assert info.converged
    with mpmath.workdps(40):
        residual, momenta = rod_step(rod, state, dt)
        turns = jax.vmap(lambda a, b: so3.multiply(so3.inverse(a), b))(state.q[:, 3:], end.q[:, 3:])
        found = np.concatenate([end.q[:, :3] - state.q[:, :3], turns[:, 1:] / turns[:, :1]], axis=1)
        root = mpmath.findroot(residual, found.ravel().tolist(), tol=1e-50, verify=False, maxsteps=4)
        right, p = (np.array([float(a) for a in v]).reshape(3, 6) for v in (root, momenta(list(root))))
    np.testing.assert_allclose(found, right, rtol=0, atol=5e-16)
    of_elements = np.maximum(rod.potential.stretching, rod.potential.bending).max(axis=1)
    stiffest = np.maximum(np.append(of_elements, 0), np.append(0, of_elements))  # at each section
    size = np.maximum(np.abs(p), np.abs(np.asarray(state.p))).max(axis=1) + dt * stiffest  # a force rounds by kε|x|
    assert np.all(np.abs(end.p - p).max(axis=1) <= 1e-15 * size)
