"""Figures 1 and 2: the numbers of the paper's plots, and that the files are pictures."""

import numpy as np
import pytest

from lieint_jax import figures

# largest |σ| read off an independent integration with the corrected formulas; 100 times smaller at a tenth of the step
LARGEST = {("A", 0): 5.88e-3, ("A", 1): 3.92e-3, ("S", 0): 6.24e-3, ("S", 1): 4.17e-3}


@pytest.mark.parametrize(("body", "kappa"), LARGEST)
def test_figure_1_largest_poisson_errors(body, kappa):
    run = figures.free_body_run(body, kappa, 0.05)
    assert len(run.poisson) == 1001
    assert run.poisson.max() == pytest.approx(LARGEST[body, kappa], abs=0.005e-3)
    assert np.ptp(run.energy) < 8e-15  # floor 1.8e-15, of energies of size 1.5


@pytest.mark.parametrize("body", ["A", "S"])
def test_figure_1_the_symplectic_kappa_is_at_round_off(body):
    assert figures.free_body_run(body, 2, 0.05).poisson.max() < 1e-14  # floor 2.4e-15


@pytest.mark.slow
@pytest.mark.parametrize(("body", "kappa"), LARGEST)
def test_figure_2_a_tenth_of_the_step_is_a_hundredth_of_the_error(body, kappa):
    run = figures.free_body_run(body, kappa, 0.005)
    assert run.poisson.max() == pytest.approx(LARGEST[body, kappa] / 100, rel=0.003)


def test_figures_are_written_with_their_tables(tmp_path):
    table = figures.FIGURES[1](tmp_path)
    assert "0.00588" in table
    assert "0.00417" in table
    assert (tmp_path / "figure-1.png").read_bytes().startswith(b"\x89PNG")
