"""The answers of the scripts gyro, material and sensitivity are right."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kept_values import numbers_after
from test_examples import run

from lieint_jax.examples import gyro


def printed(name, folder, *arguments):
    done = run(name, folder, "--no-pictures", *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def floats_after(words, text):
    """The numbers of the line that begins with these words."""
    return [float(x) for x in numbers_after(words, text)]


@pytest.mark.long
def test_the_errors_of_the_gyro_include_the_truth_as_often_as_expected(tmp_path):
    """100 trials. Measured: 93 to 98 within 2σ, 93 inside the joint ellipsoid; 95 are to be expected."""
    text = printed("gyro", tmp_path)
    assert "100 of 100 fits succeeded" in text
    truths = [x for key in sorted(gyro.TRUTH) for x in gyro.TRUTH[key]]
    for name, true in zip(gyro.NAMES, truths, strict=True):
        [line] = [line for line in text.splitlines() if line.startswith(f"  {name} ")]
        truth, mean, scatter, reported, within = map(float, line.removeprefix(f"  {name}").rstrip("%").split())
        assert truth == true
        assert abs(mean - truth) < 4 * scatter / 10
        assert scatter == pytest.approx(reported, rel=0.2)
        assert 90 <= within <= 100
    assert 88 <= floats_after("truth inside the joint 95 % ellipsoid:", text)[0] <= 100


@pytest.mark.long
def test_the_model_of_the_gyro_agrees_with_the_closed_form():
    truth = {name: jnp.array(value) for name, value in gyro.TRUTH.items()}
    model, converged = jax.jit(gyro.readings)(truth)
    assert np.all(converged)
    np.testing.assert_allclose(model, gyro.exact_readings(truth), rtol=0, atol=gyro.NOISE / 20)


@pytest.mark.long
def test_exponents_agree_with_the_vector_field_and_with_two_neighbors(tmp_path):
    text = printed("sensitivity", tmp_path, "--steps", "4000")
    assert floats_after("largest difference", text)[0] < 1e-8
    exponents = floats_after("to t = 200, splitting:", text)
    assert abs(floats_after("their sum", text)[0]) < 1e-12  # a symplectic step conserves volume
    assert exponents[0] == pytest.approx(floats_after("largest by two neighbors", text)[0], rel=1e-3)
    limit, error = floats_after("largest, over the second half", text)
    assert abs(limit - 0.0855) < 3 * error  # 0.0835 to 0.0877 by scipy's DOP853 over t = 3000 and 4000
    assert error < 0.08  # 100 units of time are few


@pytest.mark.long
def test_constants_of_the_material_are_found_within_their_errors(tmp_path):
    text = printed("material", tmp_path)
    assert floats_after("the gradient in reverse mode, by undoing steps, is", text)[0] < 1e-6
    for name in "λμ":
        truth, estimate, error = floats_after(name, text)
        assert abs(estimate - truth) < 3 * error
        assert error < 0.02 * truth
