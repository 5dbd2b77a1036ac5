"""ACM Algorithm 903 of Celledoni & Zanna: the free body in closed form, and a top by a splitting with exact drifts."""

from __future__ import annotations

import warnings

import jax
import numpy as np

from lieint_jax import schemes, systems
from lieint_jax.app.published._case import Case
from lieint_jax.groups import so3
from lieint_jax.runs import integrate


def algorithm_903_free() -> Case:
    """The motion in closed form with matrices (example 0) and with quaternions (example 2)."""

    def compute() -> dict[str, np.ndarray]:
        body = systems.rigid_body([1.0, 1.648785782711929, 1.9720127096641928])
        Pi = [-0.709894965287627, -0.685144717153487, 0.163174308075589]
        rotated = [  # the first attitude of example 0
            [-0.139359936806125, -0.726901415681411, -0.672453076350874],
            [-0.414251479478192, -0.574008408466476, 0.706335655874678],
            [-0.899430108326112, 0.376999574124619, -0.221126211350745],
        ]
        first, second = (
            body.solution(body.state(attitude, body_momentum=Pi), 0.1) for attitude in (rotated, [1.0, 0.0, 0.0, 0.0])
        )
        return {
            "body momentum at 0.1": np.asarray(body.body_momentum(second)),
            "attitude matrix at 0.1, example 0": np.asarray(body.rotation_matrix(first)),
            "quaternion at 0.1, example 2": np.asarray(second.q),
        }

    return Case.of("algorithm_903_free", "rigid_body(…).solution, the closed form", compute)


def algorithm_903_top() -> Case:
    """A top whose moments of inertia break the triangle inequality, as no body's do."""

    def compute() -> dict[str, np.ndarray]:
        pull = np.array([9.558630354723854e-05, 0.00048777318247201465, -0.0008677214881719239])  # in space
        size = float(np.linalg.norm(pull))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*triangle inequality")
            top = systems.heavy_top([1.0, 1.0126869887825154, 3.3062374224730378], [0, 0, size], axis=pull / size)
        start = top.state(body_momentum=[-0.34790957088547336, -0.19822914599675923, -0.9163318919276364])
        run = integrate(schemes.nystrom(top, 6, drift=schemes.exact(top.free)), start, 0.5, 51)
        found = {}
        for t, k in ((10.5, 21), (25.5, 51)):
            state = jax.tree.map(lambda x, k=k: x[k], run.state)
            found[f"body momentum at {t}"] = np.asarray(so3.Ad_star(state.q, state.p))
            found[f"attitude matrix at {t}"] = np.asarray(so3.to_matrix(state.q))
        return found

    return Case.of("algorithm_903_top", "nystrom(top, 6, drift=exact(top.free)), the same scheme, Δt = 0.5", compute)
