"""The text of a report: what its rows and published values print."""

import numpy as np

import lieint_jax as li


def test_published_values_are_printed_with_all_their_digits():
    body = li.systems.rigid_body((1.0, 2.0, 3.0))
    state = body.state(np.array([1.0, 0.0, 0.0, 0.0]), angular_velocity=np.array([0.1, 0.2, 0.3]))
    run = li.run(li.schemes.so3_midpoint(body, li.maps.kappa_cayley), state, 0.1, 2, progress=False)
    published = li.report.Published(6.387222, 0.0000012, "somebody 2015"), li.report.Published(19596.0, 0.2)
    text = li.report.text("A body", run, [li.report.Row("period (d)", 6.387222, published)])
    assert "6.387222 ± 1.2e-06  (somebody 2015)" in text
    assert "19596 ± 0.2" in text
