"""Old names and calls of 0.3 still work and warn; those of 0.2 are gone, but for `normalised`."""

import jax.numpy as jnp
import pytest

import lieint_jax as li
from lieint_jax.orbits import secular_j2


def test_a_capability_is_found_in_types_with_a_warning():
    with pytest.warns(DeprecationWarning, match=r"li.types.AbstractTop is now li.capabilities.AbstractTop; .* 0\.5 on"):
        assert li.types.AbstractTop is li.capabilities.AbstractTop


@pytest.mark.parametrize(
    "name", ["studies", "plots", "types.Top", "types.Abstract", "systems.SpinUp", "potentials.Sum"]
)
def test_a_name_of_0_2_or_none_at_all_is_an_attribute_error(name):
    *package, name = name.split(".")
    with pytest.raises(AttributeError, match=f"has no attribute '{name}'"):
        getattr(getattr(li, *package) if package else li, name)


def test_an_argument_by_position_has_the_value_of_its_name():
    with pytest.warns(DeprecationWarning, match="secular_j2: pass node, periapsis by name; by position"):
        orbit = secular_j2(li.orbits.EARTH_GM, 7e3, 0.01, 0.2, 0.3, 0.4).osculating
    assert (float(orbit.node), float(orbit.periapsis)) == (0.3, 0.4)


def test_both_spellings_of_normalized_are_accepted():
    [(pendulum, _, _)] = [x for name, x in li.systems._pendulum.examples().items() if name == "uniform"]
    assert li.schemes.sphere_midpoint(pendulum, normalised=True).normalized
    assert not li.schemes.sphere_midpoint(pendulum).normalized


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
