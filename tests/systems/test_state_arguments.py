"""`.state` of every system: wrong calls name the arguments, and where a time is left out it is 0."""

import importlib
import inspect
import pkgutil

import numpy as np
import pytest

import lieint_jax as li

ONE = np.array([1.0, 0.0, 0.0, 0.0])


def satellite():
    return li.systems.gravity_gradient([1.0, 2.0, 2.5], li.orbits.kepler(1.0, 1.0, 0.1))


def body():
    return li.systems.rigid_body([1.0, 2.0, 3.0])


def test_every_state_explains_the_names_of_its_arguments():
    """No system is made: a wrong call fails before the method begins."""
    names = [x.name for x in pkgutil.iter_modules(li.systems.__path__, "lieint_jax.systems.")]
    of_modules = [x for name in names for x in vars(importlib.import_module(name)).values()]
    found = {x for x in of_modules if isinstance(x, type) and "state" in vars(x)}
    kinds = {x: [p.kind for p in inspect.signature(x.state).parameters.values()] for x in found}
    found = {x for x in found if inspect.Parameter.VAR_POSITIONAL not in kinds[x]}  # others hand their arguments on
    assert len(found) >= 10
    for system in found:
        with pytest.raises(TypeError, match=r"too many positional arguments; .* may come first without a name, and"):
            system.state(None, 1, 2, 3, 4, 5)
        with pytest.raises(TypeError, match=r"need theirs: state\("):
            system.state(None, omega=3)


def test_errors_of_an_attitude_show_the_order_of_its_numbers():
    with pytest.raises(ValueError, match=r"quaternion \(w, x, y, z\), shape \(4,\), or a .* shape \(2,\)"):
        body().state([1.0, 0.0])
    with pytest.raises(ValueError, match=r"\(w, x, y, z\), the scalar part first: its norm is 2"):
        body().state(2 * ONE, angular_velocity=ONE[:3])
    assert "scipy" in type(body()).state.__doc__


def test_a_driven_state_begins_at_0_and_other_times_are_refused_with_advice():
    system = satellite()
    state = system.state(angular_velocity=[0.1, 0.2, 1.0])
    assert float(state.t) == 0
    system.check(state)
    with pytest.raises(ValueError, match=r"time of the state, 0.0, got -10.0; .* system\.state\(\.\.\., t=-10.0\)"):
        li.integrate(li.schemes.splitting(system), state, times=[-10.0, -9.9])
    with pytest.raises(ValueError, match="t must be a number, the time of the state: the system depends on it"):
        system.state(angular_velocity=[0.1, 0.2, 1.0], t=None)
