"""Motions on which loops are measured: of bodies, tops, satellites, and of two bodies."""

from __future__ import annotations

from typing import Any


def cases() -> list[tuple[str, Any, Any, bool]]:
    """Name, step, a state, and whether its tangents have a closed form."""
    import jax.numpy as jnp
    from lib import binaries

    import lieint_jax as li
    from lieint_jax.systems._euler import kirchhoff

    J, W = [1.0, 2.0, 2.5], jnp.array([0.2, 0.1, 1.0])
    body, top = li.systems.rigid_body(J), li.systems.heavy_top(J, [0.5, 0.4, 1.0])
    fluid, pair = kirchhoff((3.0, 2.0, 1.0), center_of_mass=(0.0, 0.0, -0.2)), binaries.binary()
    laws = [
        li.torques.viscous(0.01),
        lambda t, q, w: 0.01 * jnp.cos(t) * jnp.array([0, 1.0, 0.5]),
        lambda t, q, w: 0.02 * jnp.array([w[1], -w[0], 0.0]),
    ]
    satellite = li.systems.torqued_body(J, li.torques.total(laws))
    q, p = binaries.start(1)
    two = li.State(jnp.asarray(q[0]), jnp.asarray(p[0]))
    return [
        ("free body, so3_midpoint", li.schemes.so3_midpoint(body), body.state(angular_velocity=W), True),
        ("heavy top, splitting", li.schemes.splitting(top), top.state(angular_velocity=W), True),
        ("heavy top, compose 4", li.schemes.compose(li.schemes.splitting(top), 4), top.state(angular_velocity=W), True),
        ("heavy top, nystrom 6", li.schemes.nystrom(top, 6), top.state(angular_velocity=W), False),
        (
            "satellite, three laws",
            li.schemes.torqued_midpoint(satellite),
            satellite.state(angular_velocity=W, t=0, work=0),
            False,
        ),
        (
            "body in a fluid, SE(3)",
            li.schemes.group_midpoint(fluid),
            fluid.state(velocity=[0.2, 0.1, 0.5, 0.3, 0.1, 0.2]),
            True,
        ),
        ("two bodies, splitting", li.schemes.splitting(pair), two, False),
    ]
