"""Stiffnesses 10⁸ times as large as others do not hide these: soft directions are solved, or said not to be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_bvp

import lieint_jax as li


def sag(load):
    """That of the tip of an inextensible cantilever, over its length: θ″ = −g(1 − s) cos θ with g = ρgL³/EI."""

    def slope(s, y):
        return np.stack([y[1], -load * (1 - s) * np.cos(y[0])])

    def ends(first, last):
        return np.array([first[0], last[1]])

    s = np.linspace(0, 1, 101)
    solved = solve_bvp(slope, ends, s, np.zeros((2, s.size)), tol=1e-9)
    return np.trapezoid(np.sin(solved.sol(s)[0]), s)


def cantilever(stiffness, load, elements=8):
    section = li.systems.Section(1.0, (1e-3, 1e-3), 3 * (stiffness,), 3 * (1.0,))
    return li.systems.rod(1.0, elements, section, ends=("clamped", "free"), gravity=(load, 0, 0))


@pytest.mark.long
@pytest.mark.parametrize("load", [1e-3, 0.1, 1.0, 10.0])
@pytest.mark.parametrize("stiffness", [1e4, 1e8])
def test_a_cantilever_sags_by_its_weight(stiffness, load):
    """At EA L²/EI = 1e8 and a weight of 10 EI/L² the way from the straight rod is long. The error is of 8 elements."""
    rod = cantilever(stiffness, load)
    found = li.equilibrium(rod, rod.state())
    assert float(found.state.q[-1, 0]) == pytest.approx(sag(load), rel=0.01)
    assert float(found.residual) < 1e-6


@pytest.mark.long
def test_a_strip_of_metal_sags_under_weak_gravity():
    """1 m of aluminum, 2 mm thick: qL⁴/8EI, though its weight is 1e-13 of the stiffness against extension."""
    strip = li.systems.rectangular_section(0.02, 0.002, young=70e9, density=2700.0)
    rod = li.systems.rod(1.0, 6, strip, ends=("clamped", "free"), gravity=(0, 1e-3, 0))
    right = 2700 * 4e-5 * 1e-3 / (8 * 70e9 * 0.02 * 0.002**3 / 12)
    assert float(li.equilibrium(rod, rod.state()).state.q[-1, 1]) == pytest.approx(right, rel=0.01)


@pytest.mark.long
def test_in_float32_a_stiff_rod_is_solved_too():
    with jax.enable_x64(False):
        rod = cantilever(1e6, 0.1, elements=3)
        found = li.equilibrium(rod, rod.state())
        assert found.state.q.dtype == jnp.float32
        assert float(found.state.q[-1, 0]) == pytest.approx(sag(0.1), rel=0.06)  # 3 elements


@pytest.mark.long
def test_a_hanging_rod_that_is_not_at_rest_has_no_modes_yet():
    """Its weight extends it by 6 mm, a |dK| of 1e-6 of the second derivatives; modes there are 50 times too slow."""
    section = li.systems.circular_section(0.001, young=2e6, density=1100.0)
    rod = li.systems.rod(1.0, 12, section, ends=("clamped", "free"), pose=[0, 0, 0, 0, 1, 0, 0], gravity=(0, 0, -9.81))
    with pytest.raises(ValueError, match=r"the next one is 0\.00[56]\d* away"):
        li.normal_modes(rod, rod.state())
