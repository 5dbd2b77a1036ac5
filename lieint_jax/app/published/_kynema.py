"""Cases of kynema: the heavy top that the multibody community uses as a benchmark, and a precessing free body."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np

from lieint_jax import schemes, systems
from lieint_jax.app.published._case import Case
from lieint_jax.groups import so3
from lieint_jax.runs import integrate


@partial(
    Case,
    code="kynema, heavy top (Brüls–Cardona)",
    source="kynema/kynema, tests/…/verification/dynamic_heavy_top.cpp @d3b403d; Brüls, Cardona & Arnold 2012, "
    "Mech. Mach. Theory 48, 121",
    scheme="gauss(top, 8), Δt = 0.001 s",
    published={
        "displacement of the center at 2 s, m": (-0.150416985652933, -1.724164450779749, -0.673023460701136),
        "quaternion at 2 s": (0.12294727560056, -0.491079359219981, 0.350430794926147, -0.787986857972906),
    },
    limit="the other code's steps of 2e-6 s at order 2, whose error is 1.2e-6",
)
def multibody_heavy_top() -> dict[str, np.ndarray]:
    """The fast top of Brüls, Cardona & Arnold, as in a test of kynema, whose reference has an error of 1e-6."""
    arm = np.array([0.0, 1.0, 0.0])  # to the center of mass, m
    top = systems.heavy_top([15.234375, 0.46875, 15.234375], 15.0 * 9.81 * arm)
    start = top.state(angular_velocity=[0.0, 150.0, -4.61538])
    end = integrate(schemes.gauss(top, 8), start, 0.001, 2000, save_every=2000)
    q = jax.tree.map(lambda x: x[-1], end.state).q
    return {"displacement of the center at 2 s, m": np.asarray(so3.Ad(q, arm)) - arm, "quaternion at 2 s": q}


@partial(
    Case,
    code="kynema, precession of a free symmetric body",
    source="kynema/kynema, tests/regression_tests/regression/test_precession.cpp @d3b403d",
    scheme="rigid_body(…).solution, the closed form",
    published={
        "quaternion at 5 s": (-0.63053045128590757, 0.60556039120583116, -0.30157681970585326, -0.38049886257377241)
    },
    limit="the other code's start: its generalized-α method begins with zero acceleration, an error of order 1",
)
def kynema_precession() -> dict[str, np.ndarray]:
    """kynema's precessing body; its first step explains the difference (`tests/app/test_published_misfits.py`)."""
    body = systems.rigid_body([1.0, 1.0, 0.5])
    end = body.solution(body.state(angular_velocity=[0.5, 0.5, 1.0]), 5.0)
    q = np.asarray(end.q)
    return {"quaternion at 5 s": q if q[0] < 0 else -q}
