"""Old names, and old ways to call functions, still work and warn."""

import importlib
import inspect

import jax.numpy as jnp
import pytest

import lieint_jax as li

PACKAGES = (li, li.types, li.systems, li.potentials, importlib.import_module("lieint_jax.studies"))


def old_names():
    for package in PACKAGES:
        for name, new in inspect.getclosurevars(package.__getattr__).nonlocals["names"].items():
            yield pytest.param(package, name, new, id=f"{package.__name__}.{name}")


@pytest.mark.parametrize(("package", "name", "new"), list(old_names()))
def test_an_old_name_is_the_object_of_the_new_name(package, name, new):
    home, _, new = new.rpartition(":")
    with pytest.warns(DeprecationWarning, match=rf"{name} is now .*{new}; the old name will be removed in version"):
        found = getattr(package, name)
    home = importlib.import_module(home or package.__name__)
    assert found is getattr(home, new)


def test_a_name_that_never_was_is_an_attribute_error():
    for package in PACKAGES:
        with pytest.raises(AttributeError, match="has no attribute 'never_was'"):
            _ = package.never_was


def test_an_argument_by_position_has_the_value_of_its_name():
    with pytest.warns(DeprecationWarning, match="kepler: pass node, periapsis by name; by position will not be accept"):
        orbit = li.orbits.kepler(1.0, 1.0, 0.1, 0.2, 0.3, 0.4)
    assert (float(orbit.node), float(orbit.periapsis)) == (0.3, 0.4)


def test_elements_by_position_are_accepted_by_both_functions_of_elements():
    with pytest.warns(DeprecationWarning, match="secular_j2: pass node, periapsis by name; by position"):
        orbit = li.orbits.secular_j2(li.orbits.EARTH_GM, 7e3, 0.01, 0.2, 0.3, 0.4).osculating
    assert (float(orbit.node), float(orbit.periapsis)) == (0.3, 0.4)


def test_too_many_arguments_by_position_are_a_type_error():
    with pytest.raises(TypeError):
        li.orbits.kepler(1.0, 1.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)


def test_an_old_name_of_an_argument_is_accepted():
    [(pendulum, _, _)] = [x for name, x in li.systems._pendulum.examples().items() if name == "uniform"]
    with pytest.warns(DeprecationWarning, match="sphere_midpoint: normalised is now normalized; the old name"):
        step = li.schemes.sphere_midpoint(pendulum, normalised=True)
    assert step.normalized


def test_an_old_attribute_has_the_value_of_the_new_one():
    body = li.systems.torqued_body([1.0, 2.0, 2.5], li.torques.kane_damper(0.2, 0.1))
    with pytest.warns(DeprecationWarning, match="TorquedBody.carried is now initial_extra; the old name"):
        carried = body.carried
    assert carried.keys() == body.initial_extra.keys() == {"damper"}
    assert not jnp.any(carried["damper"])
    [(gyrostat, _, _)] = li.systems._driven_gyrostat.examples().values()
    with pytest.warns(DeprecationWarning, match="DrivenGyrostat.holding is now with_rotor"):
        frozen = gyrostat.holding(jnp.array([0.0, 0.0, 1.0]))
    assert frozen.rotor[2] == 1
    with pytest.warns(DeprecationWarning, match="StepInfo.fresh is now StepInfo.empty"):
        info = li.StepInfo.fresh(jnp.zeros(3))
    assert (float(info.residual), bool(info.converged)) == (0, True)
