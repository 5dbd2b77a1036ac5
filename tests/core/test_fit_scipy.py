"""Ten fits compared with `scipy.optimize.least_squares`, from the same guesses: evaluations and answers.

`python tests/core/test_fit_scipy.py` prints the table. An evaluation is one of the residuals with their Jacobian;
scipy's `nfev` counts those of residuals, and is given the same derivatives, bounds and tolerances.
"""

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.optimize import least_squares

import lieint_jax as li
from lieint_jax.groups import so3

INF = np.inf
TOLERANCE = 1e-10
METHODS = {"trf": dict(method="trf"), "trf, scaled": dict(method="trf", x_scale="jac"), "dogbox": dict(method="dogbox")}


class Problem(NamedTuple):
    """A model with synthetic data.

    Attributes:
        model: parameters ↦ observables of one shape, and whether all steps converged.
        truth: the parameters of the data.
        guess: where both fits start.
        sigma: the standard deviation of the noise of each observable.
        bounds: for `li.fit`.
        sides: the same for scipy: (low, high) of the parameters that have both in a box.
    """

    model: Callable[[Any], tuple[Any, Any]]
    truth: dict[str, Any]
    guess: dict[str, Any]
    sigma: float
    bounds: Any = li.fitting.free
    sides: Any = None

    def residuals(self) -> Callable[[Any], tuple[Any, Any]]:
        """Model less data over σ. Attitudes, (n, 4), are compared by the vector of the rotation between them."""
        clean = np.asarray(jax.jit(self.model)(self.truth)[0])
        attitudes = clean.shape[-1] == 4
        noise = self.sigma * np.random.default_rng(1).normal(size=(*clean.shape[:-1], 3) if attitudes else clean.shape)
        data = jax.vmap(so3.multiply)(clean, jax.vmap(so3.exp)(noise)) if attitudes else clean + noise

        def residuals(params):
            seen, converged = self.model(params)
            turn = jax.vmap(lambda a, b: so3.log(so3.multiply(so3.inverse(a), b)))
            off = turn(data, seen) if attitudes else seen - data
            return off / self.sigma, jnp.all(converged)

        return residuals


def _body(params):
    return li.systems.RigidBody(jnp.append(params["ratios"], 1.0))


def attitudes(params):
    """80 attitudes of a free body."""
    body = _body(params)
    run = li.integrate(li.schemes.so3_midpoint(body), body.state(angular_velocity=params["rate"]), 0.5, 80)
    return run.state.q[1:], run.info.converged


def gyro(params):
    """40 readings of a rate gyro with a bias."""
    body = _body(params)
    run = li.integrate(
        li.schemes.so3_midpoint(body), body.state(angular_velocity=params["rate"]), 0.25, 80, save_every=2
    )
    return jax.vmap(body.angular_velocity)(run.state)[1:] + params["bias"], run.info.converged


def top(params):
    """The direction of the third axis of a heavy top at 40 times."""
    body = li.systems.heavy_top(jnp.append(params["transverse"] * jnp.ones(2), 1.0), params["weight"] * jnp.eye(3)[2])
    start = body.state(so3.exp(jnp.array([0.3, 0.0, 0.0])), angular_velocity=[0.0, 0.0, 6.0])
    run = li.integrate(li.schemes.splitting(body), start, 0.05, 200, save_every=5)
    return jax.vmap(lambda q: so3.Ad(q, jnp.eye(3)[2]))(run.state.q)[1:], run.info.converged


def orbit(params):
    """50 positions on 1.6 revolutions of a Kepler orbit."""
    angles = {"node": params["node"], "periapsis": params["periapsis"]}
    path = li.orbits.kepler(1.0, params["a"], params["e"], params["i"], **angles, periapsis_time=params["time"])
    return jax.vmap(lambda t: path(t)[0])(jnp.linspace(0.0, 10.0, 50)), True


def light(params):
    """60 magnitudes of a rotating body: a mean and two harmonics of its period."""
    phase = 2 * jnp.pi * np.linspace(0.0, 20.0, 60) / params["period"]
    waves = [jnp.ones(60), jnp.cos(phase), jnp.sin(phase), jnp.cos(2 * phase), jnp.sin(2 * phase)]
    return params["amplitudes"] @ jnp.stack(waves), True


def friction(params):
    """40 readings of a rate gyro on a body with internal friction."""
    body = li.systems.damped_body(jnp.append(params["ratios"], 1.0), params["friction"])
    run = li.integrate(
        li.schemes.torqued_midpoint(body), body.state(angular_velocity=[0.8, 0.2, 0.4]), 0.2, 120, save_every=3
    )
    return jax.vmap(body.angular_velocity)(run.state)[1:], run.info.converged


def rotor(params):
    """40 readings of a rate gyro on a gyrostat whose rotor momentum is unknown."""
    body = li.systems.gyrostat(jnp.array([1.0, 2.0, 2.5]), params["rotor"])
    run = li.integrate(
        li.schemes.so3_midpoint(body), body.state(angular_velocity=params["rate"]), 0.2, 80, save_every=2
    )
    return jax.vmap(body.angular_velocity)(run.state)[1:], run.info.converged


def pendulum(params):
    """40 directions of a spherical pendulum in a field of unknown strength."""
    body = li.systems.pendulum(1.0, params["gravity"])
    start = body.state([0.0, 0.6, -0.8], velocity=params["speed"] * jnp.eye(3)[0])
    run = li.integrate(li.schemes.sphere_midpoint(body), start, 0.05, 120, save_every=3)
    return run.state.q[1:], run.info.converged


RATE = np.array([0.5, 0.3, 0.4])
FAST = np.array([0.8, 0.2, 0.4])
TRUTH = {"ratios": np.array([0.45, 0.82]), "rate": FAST}
GUESS = {"ratios": np.array([0.6, 0.9]), "rate": np.array([0.77, 0.21, 0.39])}
DEGREE = np.deg2rad(1)
TRIANGLE = {"ratios": li.fitting.inertia_ratios, "rate": li.fitting.free}
PROBLEMS = {
    "attitudes, ratios in a box": Problem(
        attitudes, TRUTH, GUESS, DEGREE, TRIANGLE | {"ratios": li.fitting.interval(0.1, 1.0)}, {"ratios": (0.1, 1)}
    ),
    "attitudes, ratios of a body": Problem(
        attitudes, TRUTH | {"rate": RATE}, GUESS | {"rate": 1.03 * RATE}, DEGREE, TRIANGLE
    ),
    "attitudes, truth outside": Problem(
        attitudes,
        TRUTH | {"rate": RATE},
        GUESS | {"rate": 1.03 * RATE},
        DEGREE,
        TRIANGLE | {"ratios": li.fitting.interval(0.46, 1.0)},
        {"ratios": (0.46, 1)},
    ),
    "gyro, biases and ratios": Problem(
        gyro,
        TRUTH | {"bias": np.array([0.02, -0.01, 0.015]), "rate": RATE},
        {"bias": np.zeros(3), "ratios": np.array([0.5, 0.8]), "rate": RATE},
        0.002,
        TRIANGLE | {"bias": li.fitting.free},
    ),
    "heavy top": Problem(
        top,
        {"transverse": 3.0, "weight": 2.0},
        {"transverse": 2.9, "weight": 1.7},
        0.01,
        li.fitting.positive,
        {"transverse": (0, INF), "weight": (0, INF)},
    ),
    "orbit": Problem(
        orbit,
        {"a": 1.1, "e": 0.6, "i": 0.7, "node": 0.5, "periapsis": 1.0, "time": 0.3},
        {"a": 1.0, "e": 0.3, "i": 0.5, "node": 0.3, "periapsis": 0.8, "time": 0.0},
        0.01,
        dict.fromkeys(("i", "node", "periapsis", "time"), li.fitting.free)
        | {"a": li.fitting.positive, "e": li.fitting.interval(0.0, 1.0)},
        {"a": (0, INF), "e": (0, 1)},
    ),
    "period": Problem(
        light,
        {"amplitudes": np.array([10.0, 0.3, -0.2, 0.5, 0.1]), "period": 3.7},
        {"amplitudes": np.array([9.0, 0.1, 0.0, 0.3, 0.0]), "period": 3.6},
        0.05,
        {"amplitudes": li.fitting.free, "period": li.fitting.interval(3.0, 4.5)},
        {"period": (3.0, 4.5)},
    ),
    "friction": Problem(
        friction,
        {"friction": 0.3, "ratios": np.array([0.5, 0.8])},
        {"friction": 0.05, "ratios": np.array([0.6, 0.75])},
        0.01,
        {"friction": li.fitting.positive, "ratios": li.fitting.inertia_ratios},
        {"friction": (0, INF)},
    ),
    "rotor": Problem(
        rotor,
        {"rate": RATE, "rotor": np.array([0.3, -0.2, 0.5])},
        {"rate": RATE, "rotor": np.array([0.1, 0.1, 0.3])},
        0.01,
    ),
    "pendulum": Problem(pendulum, {"gravity": 9.81, "speed": 1.0}, {"gravity": 8.0, "speed": 0.5}, 0.01),
}


class Comparison(NamedTuple):
    """Our fit, the best of scipy's, the evaluations of each of its methods, and the largest difference in σ."""

    ours: li.fitting.Fit
    theirs: Any
    evaluations: dict[str, int]
    difference: float


def compared(name):
    problem = PROBLEMS[name]
    residuals = problem.residuals()
    ours = li.fit(residuals, problem.guess, bounds=problem.bounds, standardized=True, progress=False)
    x, unravel = ravel_pytree(problem.guess)

    def residuals_twice(x):
        r = ravel_pytree(residuals(unravel(x))[0])[0]
        return r, r

    both = jax.jit(jax.jacfwd(residuals_twice, has_aux=True))
    sides = problem.sides or {}
    bounds = [
        ravel_pytree({k: sides.get(k, (-INF, INF))[end] + 0 * np.asarray(v) for k, v in problem.guess.items()})[0]
        for end in range(2)
    ]
    found = {
        key: least_squares(
            lambda x: np.asarray(both(x)[1]), x, lambda x: np.asarray(both(x)[0]), bounds, max_nfev=200,
            ftol=TOLERANCE, xtol=TOLERANCE, gtol=TOLERANCE, **options,
        )
        for key, options in METHODS.items()
    }  # fmt: skip
    theirs = min(found.values(), key=lambda result: result.cost)
    sigma = np.sqrt(np.diagonal(np.linalg.pinv(theirs.jac.T @ theirs.jac)))
    difference = np.max(np.abs(ravel_pytree(ours.params)[0] - theirs.x) / sigma)
    return Comparison(ours, theirs, {key: result.nfev for key, result in found.items()}, float(difference))


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:the error of the steps moves")  # both minimize one sum, by the same coarse steps
@pytest.mark.parametrize("name", PROBLEMS)
def test_no_more_evaluations_than_scipy_and_the_same_answer(name):
    ours, theirs, evaluations, difference = compared(name)
    assert ours.success, ours.message
    assert ours.iterations + 1 <= min(evaluations.values())
    assert ours.loss <= theirs.cost * (1 + 1e-9)
    assert difference < 1e-4  # 2e-5 at most
    assert ours.at_bound == (name == "attitudes, truth outside")


def table(names):
    print(
        f"{'':<28}{'lieint':>8}"
        + "".join(f"{name:>13}" for name in METHODS)
        + f"{'loss':>14}{'scipy':>14}{'diff./σ':>10}"
    )
    for name in names:
        ours, theirs, evaluations, difference = compared(name)
        print(
            f"{name:<28}{ours.iterations + 1:>8}" + "".join(f"{n:>13}" for n in evaluations.values())
            + f"{ours.loss:>14.6f}{theirs.cost:>14.6f}{difference:>10.1e}"
            + ("" if ours.success else f"  {ours.message}"),
            flush=True,
        )  # fmt: skip


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    table(sys.argv[1:] or PROBLEMS)
