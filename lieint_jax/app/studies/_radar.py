"""The radar fixes of 4179 Toutatis, and the errors of a torque-free spin state against them."""

from __future__ import annotations

from importlib import resources
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax.app import scenarios
from lieint_jax.app.studies._tumbling import model, rotation_between
from lieint_jax.fitting import member_by_member
from lieint_jax.groups import so3

FITTED, MIDDLE = 17, 8  # number of fixes of 1992; index of the middle one, the epoch of the parameters
STATES = {"Zhao et al. 2015": "toutatis", "Takahashi et al. 2013": "toutatis_takahashi"}  # published, as scenarios
_EPOCH = np.datetime64("1992-11-09T17:49:47")


class RadarEpochs(NamedTuple):
    """All published radar fixes of Toutatis: 17 of 1992, one of 2004 and one of 2008.

    Attributes:
        t: days since 1992-11-09 17:49:47 UTC, the epoch of the published states, (19,).
        q: attitudes as unit quaternions, (19, 4).
        euler_313_deg: the same as Euler 3-1-3 angles, as published (°), (19, 3).
        angular_velocity_deg: body rates (°/d), (19, 3).
    """

    t: np.ndarray
    q: np.ndarray
    euler_313_deg: np.ndarray
    angular_velocity_deg: np.ndarray


def radar_epochs() -> RadarEpochs:
    """The radar fixes. Source: Takahashi, Busch & Scheeres 2013, AJ 146:95, where no errors are given."""
    rows = _rows()
    days = [np.datetime64(row[0]) - _EPOCH for row in rows]
    numbers = np.array([row[1:] for row in rows], float)
    q = jax.vmap(so3.from_euler_313)(jnp.deg2rad(numbers[:, :3]))
    return RadarEpochs(np.array(days) / np.timedelta64(1, "D"), np.asarray(q), numbers[:, :3], numbers[:, 3:])


class LaterFixes(NamedTuple):
    """Attitudes long after 1992: by radar in 2004 and 2008, and by the camera of Chang'e-2 in 2012.

    Attributes:
        date: dates, UTC, (3,).
        t: days since 1992-11-09 17:49:47 UTC, (3,).
        q: attitudes, (3, 4).
    """

    date: tuple[str, ...]
    t: np.ndarray
    q: np.ndarray


def later_fixes() -> LaterFixes:
    """The two later radar fixes and that of Chang'e-2: −20.1°, 27.6°, 42.2°, each ± 1° (Zhao et al. 2015).

    The angles of Chang'e-2 are read in the convention of the radar fixes. The inverse rotation is excluded: with the
    direction of the momentum, 2H/|π|² would be 1.5 times as large as in the published states.
    """
    fixes = radar_epochs()
    t = (np.datetime64("2012-12-13T08:30") - _EPOCH) / np.timedelta64(1, "D")
    q = so3.from_euler_313(jnp.deg2rad(jnp.array([-20.1, 27.6, 42.2])))
    date = tuple(day[:10] for day in (*dates()[FITTED:], "2012-12-13"))
    return LaterFixes(date, np.append(fixes.t[FITTED:], t), np.vstack([fixes.q[FITTED:], q]))


def dates() -> list[str]:
    """The dates of the fixes, UTC, to the minute."""
    return [row[0].replace("T", " ") for row in _rows()]


def _rows() -> list[list[str]]:
    text = resources.files(scenarios).joinpath("toutatis_radar.csv").read_text(encoding="utf-8")
    return [line.split(",") for line in text.splitlines() if line[0].isdigit()]


@jax.jit
def path(params: dict[str, Array], data: dict[str, Array]) -> Array:
    """Attitudes and body rates (°/d), (n, 7), at data["t"], (n,); data["begin"] as in `model`."""
    body, state = model(params, data["begin"])

    def spin_at(t: Array) -> Array:
        later = body.solution(state, t)
        return jnp.concatenate([later.q, jnp.rad2deg(body.angular_velocity(later))])

    return jax.lax.map(spin_at, data["t"])


path_of_fits = member_by_member(path)


def errors(found: Array, data: dict[str, Array]) -> Array:
    """Calculated less observed: rotation vectors in space (°) and body rates (°/d), (2, n, 3).

    Args:
        found: calculated attitudes and body rates, (n, 7).
        data: observed attitudes data["q"], (n, 4), and body rates data["rate"], (n, 3).
    """
    return jnp.stack([jax.vmap(rotation_between)(found[:, :4], data["q"]), found[:, 4:] - data["rate"]])
