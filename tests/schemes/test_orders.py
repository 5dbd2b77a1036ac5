"""The order of every scheme, in one table: two runs, of n and of 2n steps, next to DOP853 of scipy.

A row is a step of the system s, an example of the grid; the time T; n; and the order. The error is the largest of q, of
p relative to its largest, and of the work. `test_long_runs.py` measures the order of every pair of the grid; these are
the families, compositions and rules that the grid lacks, and each scheme once. Rows after the blank line run in shards.
"""

import functools

import grid
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from repeated import last
from scipy.integrate import solve_ivp

import lieint_jax as li
from lieint_jax import maps
from lieint_jax.types import time_derivative

TABLE = """
preprocessed(s, 4)                                    | rigid_body.asymmetric        | 3.2 | 8   | 4
compose(splitting(s), 4)                              | pseudo_rigid_body.ball       | 0.1 | 16  | 4
magnus(s, 2)                                          | kinematics.coning            | 5   | 20  | 2
magnus(s, 4)                                          | kinematics.coning            | 5   | 20  | 4
magnus(s, 4, commutators=False)                       | kinematics.screw             | 5   | 20  | 4
magnus(s, 6)                                          | kinematics.coning            | 5   | 20  | 6

so3_midpoint(s)                                       | rigid_body.asymmetric        | 10  | 100 | 2
so3_midpoint(s, cayley)                               | gyrostat.satellite           | 4   | 40  | 2
so3_midpoint(s, cayley)                               | driven_gyrostat.spin_up      | 3   | 30  | 2
so3_explicit(s)                                       | rigid_body.full_tensor       | 3.2 | 32  | 2
so3_alpha(s, 0.5)                                     | embedded_body.embedded       | 2   | 40  | 2
so3_alpha(s, 0.3)                                     | embedded_body.embedded       | 2   | 160 | 1
preprocessed(s, 6)                                    | rigid_body.full_tensor       | 3.2 | 8   | 6
preprocessed(s, 8)                                    | rigid_body.full_tensor       | 3.2 | 8   | 8
preprocessed(s, 10)                                   | rigid_body.full_tensor       | 3.2 | 4   | 10
compose(so3_midpoint(s), 4)                           | rigid_body.asymmetric        | 3.2 | 4   | 4
compose(so3_midpoint(s), 6)                           | rigid_body.asymmetric        | 3.2 | 4   | 6
compose(so3_midpoint(s), 8)                           | rigid_body.asymmetric        | 3.2 | 4   | 8
compose(so3_midpoint(s), 10)                          | rigid_body.asymmetric        | 3.2 | 4   | 10
compose(so3_midpoint(s, cayley), 4, "triple_jump")    | rigid_body.asymmetric        | 3.2 | 16  | 4
compose(so3_midpoint(s, cayley), 4, "suzuki")         | rigid_body.asymmetric        | 3.2 | 8   | 4
compose(so3_midpoint(s, cayley), 6, "yoshida_6")      | rigid_body.asymmetric        | 3.2 | 8   | 6
compose(so3_midpoint(s, cayley), 6, "kahan_li_6")     | rigid_body.asymmetric        | 3.2 | 8   | 6
compose(so3_midpoint(s, cayley), 8, "suzuki_umeno_8") | rigid_body.asymmetric        | 3.2 | 8   | 8
compose(so3_midpoint(s, cayley), 8, "kahan_li_8")     | rigid_body.asymmetric        | 3.2 | 8   | 8
compose(so3_midpoint(s, cayley), 10)                  | rigid_body.asymmetric        | 6.4 | 6   | 10
compose(so3_midpoint(s), 6)                           | gyrostat.satellite           | 3.2 | 8   | 6
compose(splitting(s), 4)                              | gyrostat.satellite           | 3.2 | 8   | 4
compose(splitting(s), 6)                              | gyrostat.satellite           | 3.2 | 8   | 6
splitting(s)                                          | heavy_top.asymmetric_top     | 3.2 | 64  | 2
splitting(s, exact(s.free))                           | heavy_top.asymmetric_top     | 3.2 | 64  | 2
compose(splitting(s), 4)                              | heavy_top.asymmetric_top     | 3.2 | 16  | 4
nystrom(s, 4)                                         | heavy_top.asymmetric_top     | 1.6 | 16  | 4
nystrom(s, 6)                                         | heavy_top.asymmetric_top     | 3.2 | 8   | 6
nystrom(s, 4)                                         | gravity_gradient.satellite   | 0.8 | 8   | 4
nystrom(s, 6)                                         | gravity_gradient.satellite   | 2   | 8   | 6
top_energy_momentum(s)                                | heavy_top.kovalevskaya       | 3.2 | 64  | 2
compose(top_energy_momentum(s), 4)                    | heavy_top.asymmetric_top     | 3.2 | 16  | 4
top_energy_momentum(s)                                | gravity_gradient.satellite   | 2   | 20  | 2
compose(top_energy_momentum(s), 4)                    | gravity_gradient.satellite   | 2   | 20  | 4
compose(top_energy_momentum(s), 6)                    | gravity_gradient.flyby       | 2   | 20  | 6
compose(top_energy_momentum(s), 4)                    | driven_top.moving_axis       | 2   | 20  | 4
compose(splitting(s), 6)                              | gravity_gradient.satellite   | 2   | 20  | 6
compose(splitting(s), 4)                              | gravity_gradient.flyby       | 2   | 20  | 4
compose(splitting(s), 4)                              | driven_top.two_wells         | 2   | 20  | 4
compose(splitting(s), 4)                              | group_potential.pulsating    | 2   | 20  | 4
reversible_control(splitting(s), calm)                | heavy_top.asymmetric_top     | 2   | 40  | 2
log_hamiltonian(s)                                    | potential_top.attracted      | 2   | 40  | 2
gauss(s, 2)                                           | heavy_top.asymmetric_top     | 4.8 | 48  | 4
gauss(s, 3)                                           | heavy_top.asymmetric_top     | 4.8 | 24  | 6
gauss(s, 4)                                           | heavy_top.asymmetric_top     | 4.8 | 12  | 8
gauss(s, 5)                                           | heavy_top.asymmetric_top     | 4.8 | 8   | 10
gauss(s, 6)                                           | heavy_top.asymmetric_top     | 4.8 | 5   | 12
extrapolate(s, 4)                                     | rigid_bodies.triple          | 1   | 64  | 4
extrapolate(s, 6)                                     | heavy_top.asymmetric_top     | 4   | 16  | 6
extrapolate(s, 8)                                     | driven_top.moving_axis       | 4   | 8   | 8
extrapolate(s, 10)                                    | gyrostat.full_tensor         | 4   | 3   | 10
extrapolate(s, 12)                                    | rigid_bodies.binary          | 16  | 10  | 12
torqued_midpoint(s)                                   | torqued_body.damper          | 1.2 | 20  | 2
torqued_midpoint(s)                                   | torqued_body.satellite       | 1.2 | 20  | 2
compose(torqued_midpoint(s), 4)                       | damped_body.explorer         | 1.2 | 8   | 4
splitting(s)                                          | rigid_bodies.binary          | 8   | 160 | 2
bodies_energy_momentum(s)                             | rigid_bodies.binary          | 8   | 160 | 2
bodies_energy_momentum(s)                             | rod.free                     | 1   | 100 | 2
compose(bodies_energy_momentum(s), 4)                 | rigid_bodies.rubbing         | 0.8 | 8   | 4
nystrom(s, 4)                                         | rigid_bodies.binary          | 3.2 | 8   | 4
nystrom(s, 6)                                         | rigid_bodies.binary          | 6.4 | 8   | 6
kepler_splitting(s, 2)                                | rigid_bodies.binary          | 3.2 | 8   | 2
kepler_splitting(s, (8, 4))                           | rigid_bodies.binary          | 3.2 | 8   | 4
kepler_splitting(s, (8, 6, 4))                        | rigid_bodies.binary          | 6.4 | 8   | 4
group_midpoint(s)                                     | euler.kirchhoff              | 2   | 40  | 2
group_energy_momentum(s)                              | group_potential.bottom_heavy | 2   | 40  | 2
group_alpha(s, 0.5)                                   | group_potential.henon_heiles | 2   | 40  | 2
group_alpha(s, 0.3)                                   | group_potential.henon_heiles | 2   | 160 | 1
sphere_midpoint(s)                                    | pendulum.quadratic           | 0.8 | 16  | 2
sphere_midpoint(s, True)                              | pendulum.quadratic           | 0.8 | 16  | 2
sphere_chart(s)                                       | pendulum.uniform             | 0.8 | 16  | 2
additive(s, "average")                                | pseudo_rigid_body.ball       | 0.1 | 64  | 2
additive(s, "energy")                                 | pseudo_rigid_body.ball       | 0.1 | 64  | 2
additive(s, "energy_momentum")                        | pseudo_rigid_body.ball       | 0.1 | 64  | 2
additive(s, "symplectic")                             | pseudo_rigid_body.ball       | 0.1 | 64  | 2
additive(s, "symplectic", 0.3)                        | pseudo_rigid_body.ball       | 0.1 | 64  | 1
additive(s, "symplectic", 1.0)                        | pseudo_rigid_body.ball       | 0.1 | 64  | 1
"""
OTHERS = {"exact", "calibrated", "langevin"}  # the first two are the flow; test_langevin.py has the order of the third
QUICK, LONG = (
    [[x.strip() for x in row.split("|")] for row in part.splitlines()] for part in TABLE.strip().split("\n\n")
)
NAMES = vars(li.schemes) | {"cayley": maps.kappa_cayley, "calm": lambda state: 1 / jnp.sqrt(1 + jnp.sum(state.p**2))}


def example(name):
    module, _, name = name.partition(".")
    return grid.examples_of(module)[name]


@functools.cache
def exact(name, T):
    """The state of an example after T."""
    system, state, _ = example(name)
    y, unravel = ravel_pytree(state)
    rate = jax.jit(lambda y: ravel_pytree(time_derivative(system, unravel(y)))[0])
    path = solve_ivp(lambda t, y: np.asarray(rate(y)), (0, T), y, "DOP853", rtol=3e-14, atol=1e-15)
    return jax.device_get(unravel(path.y[:, -1]))


def cases():
    for row in QUICK + LONG:
        yield pytest.param(*row, id=f"{row[0]} {row[1]}", marks=[pytest.mark.long] * (row in LONG))


@pytest.mark.parametrize(("step", "name", "T", "n", "order"), list(cases()))
def test_a_step_has_its_order(step, name, T, n, order):
    system, state, _ = example(name)
    step, T, order, errors = eval(step, NAMES, {"s": system}), float(T), int(order), []
    start = step.start(state)
    for count in (int(n), 2 * int(n)):
        path = li.integrate(step, start, T / count, count, save_every=count)
        assert path.info.converged.all()
        end = jax.device_get(last(path))
        true = exact(name, float(end.t - start.t) if step.own_time else T)
        pairs = (end.q, true.q, 1.0), (end.p, true.p, np.abs(true.p).max(initial=1e-300)), (end.work, true.work, 1.0)
        errors.append(max(np.abs(a - b).max(initial=0) / size for a, b, size in pairs if a is not None))
    assert step.order == order
    assert errors[1] > 1e-12  # above the floor of 1e-13
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15 if order < 8 else 0.5)


def test_every_scheme_has_a_row():
    rows = {step.partition("(")[0] for step, *_ in QUICK + LONG}
    assert rows | OTHERS == {entry.name for entry in li.schemes.catalogue()}
    assert not rows & OTHERS
