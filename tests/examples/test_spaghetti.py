"""The example flying spaghetti: the impulse of its loads, what is conserved in flight, rods of their own stiffness."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from example_runs import run_example
from kept_values import numbers_after

import lieint_jax as li
from lieint_jax.examples import spaghetti

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def thrown(tmp_path_factory):
    """The report and the run of three rods of four elements."""
    own = {"lieint_jax.examples.spaghetti.load": spaghetti.load}
    options = {"members": 3, "steps": 120, "dt": 0.05, "elements": 4}
    return run_example(spaghetti, tmp_path_factory.mktemp("spaghetti"), own, **options)


def test_a_thrown_rod_has_the_impulse_of_its_loads_and_conserves_its_momenta_in_flight(thrown):
    """Observed 3e-15 of energy and momenta, and the impulse to 1e-14."""
    text, run = thrown
    np.testing.assert_allclose(run.state.q[0, 0, -1, :3], [6, 0, 0], rtol=0, atol=1e-14)
    assert "3 of 3 members converged" in text
    for name in ("energy less work", "P in free flight", "L in free flight"):
        assert float(numbers_after(f"{name}, relative", text)[0]) < 2e-14
    nominal, spread, closed, difference = map(float, numbers_after("|P| at the end; impulse of the loads", text))
    assert (nominal, spread, closed) == (50, 0, 50)  # of every rod: the force has no spread
    assert abs(difference) < 1e-13
    assert float(numbers_after("work of loads and damping", text)[0]) > 500


def test_every_rod_moves_as_the_rod_of_its_own_stiffness_and_moment_alone(thrown):
    """Each on its own, made by hand: observed 2e-14. The ends of the rods differ by 0.5 and 1.7."""
    _, run = thrown
    noise = np.asarray(jax.random.normal(jax.random.key(1988), (3, 2, 3)))
    for m in (1, 2):
        stiffness, moment = np.array([500.0] * 3) * (1 + 0.1 * noise[m, 0]), [0, 200, 100] * (1 + 0.05 * noise[m, 1])
        greatest = jnp.array([20.0, 0.0, 0.0, *moment])
        rod = li.systems.rod(
            10.0,
            4,
            spaghetti.SECTION._replace(bending=stiffness),
            pose=jnp.array(spaghetti.START),
            loads={-1: lambda t, greatest=greatest: greatest * jnp.maximum(0.0, 1 - jnp.abs(t / 2.5 - 1))},
        )
        path = li.integrate(li.schemes.bodies_energy_momentum(rod), rod.state(), 0.05, 120, save_every=120)
        end = np.asarray(path.state.q[-1])
        np.testing.assert_allclose(run.state.q[-1, m], end, rtol=0, atol=2e-13)
        assert abs(run.state.q[-1, m] - run.state.q[-1, 0]).max() > 0.1
