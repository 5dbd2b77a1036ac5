"""Fits whose residuals weigh 1 and 10⁸: the soft parameters are right, or the fit is no success and names them."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import lieint_jax as li

LEAST_SQUARES = ["levenberg_marquardt", "gauss_newton", "scipy"]
GUESS = {"stiff": [0.0, 0.0], "cubic": 1.0, "power": 0.5}
pytestmark = pytest.mark.filterwarnings("ignore:the fit did not converge")


def rows(weight, misfit, x, of):
    """Stiff rows in a, b and a little of c, two of which contradict each other by `misfit`; soft ones of c and d."""
    a, b, c, d = x
    bent = a + b + of.sin(a) / 8 - 1
    soft = [c**3 + c - 10 - b, of.exp(d) - 7.5 + a / 8]
    return [weight * bent, weight * (a - b + c / 8 - 2), weight * (bent - misfit), *soft]


def residuals(weight, misfit):
    def of(p):
        return jnp.stack(rows(weight, misfit, [*p["stiff"], p["cubic"], p["power"]], jnp))

    return of


def right(weight, misfit, power=None):
    """Gauss and Newton in 60 digits; with the last parameter held if it is given."""
    with mpmath.workdps(60):
        x = mpmath.matrix([1.3, -0.4, 2, 2 if power is None else power])
        free = 4 if power is None else 3
        for _ in range(200):
            a, _, c, d = x
            r = mpmath.matrix(rows(mpmath.mpf(weight), mpmath.mpf(misfit), x, mpmath))
            bend = weight * (1 + mpmath.cos(a) / 8)
            J = [[bend, weight, 0, 0], [weight, -weight, weight / 8, 0], [bend, weight, 0, 0]]
            J = mpmath.matrix([*J, [0, -1, 3 * c**2 + 1, 0], [0.125, 0, 0, mpmath.exp(d)]])
            step = mpmath.qr_solve(J[:, :free], r)[0]
            x = mpmath.matrix([x[k] - (step[k] if k < free else 0) for k in range(4)])
            if mpmath.norm(step) < 1e-40:
                return [float(number) for number in x]
    raise AssertionError("no minimum")


def numbers(found):
    return [*found.params["stiff"], found.params["cubic"], found.params["power"]]


@pytest.mark.long
@pytest.mark.parametrize("misfit", [0.0, 1e-3])
@pytest.mark.parametrize("weight", [1.0, 1e8])
@pytest.mark.parametrize("optimizer", LEAST_SQUARES)
def test_soft_parameters_of_least_squares_are_those_of_sixty_digits(optimizer, weight, misfit):
    """With a misfit, the loss changes by 1e-10 of itself where the soft residuals vanish, and rounds by 1e-13."""
    found = li.fit(residuals(weight, misfit), GUESS, optimizer, progress=False)
    assert found.success, found.message
    np.testing.assert_allclose(numbers(found), right(weight, misfit), rtol=1e-5 if misfit else 1e-9)  # √tolerance


@pytest.mark.long
@pytest.mark.parametrize("optimizer", LEAST_SQUARES)
def test_what_rounding_hides_is_no_success(optimizer):
    """At 1 : 1e11 the misfit of 1e8 rounds the step by a tenth of the soft parameters."""
    found = li.fit(residuals(1e11, 1e-3), GUESS, optimizer, progress=False)
    assert not found.success
    assert optimizer == "gauss_newton" or "the next step still moves" in found.message  # or its search ends


@pytest.mark.long
@pytest.mark.parametrize("optimizer", LEAST_SQUARES)
def test_bounds_and_many_starts_do_not_hide_soft_parameters(optimizer):
    """The minimum has `power` at its bound 1.5."""
    bounds = {"stiff": li.fitting.free, "cubic": li.fitting.positive, "power": li.fitting.interval(0.0, 1.5)}
    several = optimizer != "scipy"
    guess = jax.tree.map(lambda x: jnp.asarray([x, np.multiply(x, 1.25)]), GUESS, is_leaf=lambda x: x is not GUESS)
    found = li.fit(
        residuals(1e8, 1e-3), guess if several else GUESS, optimizer, bounds=bounds, starts=several, progress=False
    )
    assert found.success, found.message
    assert found.at_bound
    assert float(found.params["power"]) == pytest.approx(1.5, abs=1e-5)
    np.testing.assert_allclose(numbers(found)[:3], right(1e8, 1e-3, 1.5)[:3], rtol=1e-5)
    if several:
        assert found.starts.success.all()
        np.testing.assert_allclose(found.starts.params["cubic"], right(1e8, 1e-3, 1.5)[2], rtol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("optimizer", LEAST_SQUARES)
def test_a_soft_parameter_next_to_a_singular_minimum_is_found(optimizer):
    """At the local minimum of Freudenstein & Roth J is singular, and only the loss tells; y changes 1e-14 of it."""

    def of(p):
        x, y = p["x"], p["y"]
        stiff = [-13 + x[0] + ((5 - x[1]) * x[1] - 2) * x[1], -29 + x[0] + ((x[1] + 1) * x[1] - 14) * x[1]]
        return jnp.stack([1e7 * stiff[0], 1e7 * stiff[1], y**3 - 8])

    found = li.fit(of, {"x": [0.5, -2.0], "y": 1.0}, optimizer, iterations=300, progress=False)
    assert found.success == (optimizer != "gauss_newton")  # which has no way down there
    if found.success:
        np.testing.assert_allclose(found.params["x"], [(53 - 4 * 22**0.5) / 3, (2 - 22**0.5) / 3], rtol=1e-5)
        assert float(found.params["y"]) == pytest.approx(2, rel=2e-5)


@pytest.mark.long
@pytest.mark.parametrize("misfit", [0.0, 1e-3])
@pytest.mark.parametrize("weight", [1.0, 1e6, 1e8])
def test_a_scalar_loss_is_minimized_or_names_what_is_hidden(misfit, weight):
    """At weights of 1e8 the rounding errors of the second derivatives, of 1e16, are those of the soft parameters."""
    of = residuals(weight, misfit)
    found = li.fit(lambda p: jnp.sum(of(p) ** 2), GUESS, "lbfgs", iterations=200, progress=False)
    assert found.success == (weight < 1e8), found.message
    if found.success:
        np.testing.assert_allclose(numbers(found), right(weight, misfit), rtol=1e-5)
    else:
        assert "the next step still moves cubic" in found.message


def test_a_soft_parameter_of_a_scalar_loss_moves_too():
    """The gradient is 1e-10 of the first one where x is right, and y still at its guess."""
    found = li.fit(lambda p: 1e16 * (p["x"] - 1) ** 2 + (p["y"] - 3) ** 2, {"x": 0.0, "y": 1.0}, "lbfgs")
    assert found.success
    np.testing.assert_allclose([found.params["x"], found.params["y"]], [1, 3], rtol=1e-9)


def test_a_soft_parameter_of_residuals_moves_too():
    """Two measurements of x that differ by 1, and weigh 1e8: the loss of y is below its rounding error."""
    found = li.fit(lambda p: jnp.stack([1e8 * p["x"], 1e8 * (p["x"] - 1), p["y"] ** 2 - 9]), {"x": 0.0, "y": 1.0})
    assert found.success
    np.testing.assert_allclose([found.params["x"], found.params["y"]], [0.5, 3], rtol=1e-8)  # 2e-9
