"""A motion on a group with a given rate: attitudes from the rates of a gyro, spins in a given field, frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._numerics.arrays import AlgebraVector, Time
from lieint_jax._numerics.lookup import increasing_times, interval
from lieint_jax.core import Converted, Group, State, argument, callable_pytree, pytree, static
from lieint_jax.groups import so3
from lieint_jax.systems._catalogue import SystemProperties
from lieint_jax.systems._equations import AbstractKinematics
from lieint_jax.systems._shared.arguments import check_timed, explained, timed
from lieint_jax.systems._shared.on_group import check_element, group_element

__all__ = ["Kinematics", "kinematics", "sampled_rate"]

Frame = Literal["body", "space"]
Kind = Literal["interpolate", "mean"]


@pytree
class Kinematics(AbstractKinematics):
    """A motion with a given rate: the attitude from a gyro (in the body), a spin in a given field (in space).

    Args:
        group: `groups.so3`, a group of the catalogue, or `groups.matrix(basis)`.
        rate: ω, a smooth function of t with values (d,) in the basis of the algebra, on `groups.so3` the angular
            velocity; or a log of a gyro, `sampled_rate(…)`. A function with parameters is a `jax.tree_util.Partial`. A
            method `mean(t, h)`, its mean from t to t + h, is used by steps of order 2.
        frame: "body" for q̇ = qω̂(t), "space" for q̇ = ω̂(t)q.

    Raises:
        ValueError: the rate is not such a function; another frame.

    Source: Iserles, Munthe-Kaas, Nørsett & Zanna, Acta Numerica 9 (2000) 215.

    Example:
        >>> from lieint_jax import groups
        >>> spin = kinematics(groups.so3, lambda t: jnp.stack([0.0 * t, 0.0 * t, 2.0 * t]))
        >>> spin.vector_field(spin.state(t=1.0)).q.tolist()
        [0.0, 0.0, 0.0, 1.0]
    """

    group: Group = static()
    rate: Converted[Callable[[Array], Array]] = argument(converter=callable_pytree)
    frame: Frame = static(default="body")

    def check_fields(self) -> None:
        """Raise ValueError if the rate is no function of time, or the frame is another."""
        _checks.choice("frame", self.frame, get_args(Frame))
        if not callable(self.rate):
            raise ValueError(f"rate must be a function of t, the time, or systems.sampled_rate(…), got {self.rate!r}")
        _checks.function("rate", self.rate, "t, the time", (self.group.dim,), jnp.zeros(()))

    @explained
    def state(self, q: ArrayLike | None = None, *, t: ArrayLike = 0.0) -> State:
        """The state at a configuration and a time.

        Args:
            q: a group element, shape (n, n), within 1e-6 of the group; for `groups.so3` an attitude as in `rigid_body`,
                a unit quaternion (w, x, y, z) or a scipy `Rotation`. By default the identity.
            t: the time of the state, a scalar; by default 0.

        Raises:
            ValueError: a wrong shape, a NaN, or a q off the group; a time that is not a finite scalar.
        """
        element = group_element(self.group, q, float)
        return timed(State(element, jnp.zeros(0, element.dtype)), t, None)

    def check(self, state: State) -> None:
        """Raise ValueError if a concrete `state` is not one of this system, or has no time."""
        check_element("state.q", self.group, state.q)
        _checks.real_array("state.p", state.p, (0,))
        check_timed(state)


@pytree
class SampledRate:
    """A rate through the entries of a log, `rate(t)`, (d,). Made by `sampled_rate`.

    Between two times it is m + s u + c (u² − 1/12), with u from −½ to ½: its mean is m.
    """

    times: Array  # the ends of the intervals, (n+1,)
    coefficients: Array  # m, s and c of each interval, one after the other, (3dn,), as machine code reads long logs

    def __call__(self, t: Time | float) -> AlgebraVector:
        """The rate at time t, (d,). Outside the log: ValueError if t is concrete, otherwise NaN."""
        return self.mean(t, 0.0)

    def mean(self, t: Time | float, h: Time | float) -> AlgebraVector:
        """The mean from t to t + h, (d,), for steps inside one interval; times outside the log as in a call."""
        k, since, length = interval(self.times, t + h / 2)
        u, w, size = since / length - 0.5, h / length, self.coefficients.size // (len(self.times) - 1)
        mean, slope, bend = lax.dynamic_slice(self.coefficients, (k * size,), (size,)).reshape(3, -1)
        return mean + u * slope + (u * u + (w * w - 1) / 12) * bend


def sampled_rate(times: ArrayLike, rates: ArrayLike, kind: Kind = "interpolate") -> SampledRate:
    """The rate of a log, as a function of time.

    | kind | `times` | `rates` | between the times |
    |---|---|---|---|
    | "interpolate" | (n,), n ≥ 2 | (n, d), the rate at each time | linear |
    | "mean" | (n+1,), n ≥ 3: ends of intervals | (n, d), the mean over each interval | parabolas of these means |

    Rate-integrating gyros measure the second kind: an increment of the angle over the length of its interval. With
    steps of one interval each, `schemes.magnus` of order 2 rotates by exactly these increments, and order 4 adds the
    coning correction (Δθ₋ − Δθ₊) × Δθ/24 from those before and after.

    Args:
        times: increasing.
        rates: in the basis of the algebra, on `groups.so3` angular velocities.
        kind: what the rates are.

    Raises:
        ValueError: times that do not increase, shapes that do not agree, values that are not finite, another kind.

    Source: Savage, J. Guidance Control Dyn. 21 (1998) 19, for coning.

    Example:
        >>> rate = sampled_rate([0.0, 1.0, 2.0], [[0.0], [2.0], [2.0]])
        >>> rate(0.5).tolist()
        [1.0]
    """
    _checks.choice("kind", kind, get_args(Kind))
    t, means = increasing_times(times), kind == "mean"
    x = _checks.real_array("rates", rates)
    least = 3 if means else 2
    if x.ndim != 2 or len(x) != len(t) - means or len(x) < least:
        wanted = "(n, d) for n + 1 times, n ≥ 3" if means else "(n, d) for n times"
        raise ValueError(f"rates of kind {kind!r} must have shape {wanted}, got {x.shape} for {len(t)} times")
    if not means:
        return _of_intervals(t, (x[:-1] + x[1:]) / 2, jnp.diff(x, axis=0), jnp.zeros_like(x[1:]))
    h, n = jnp.diff(t)[:, None], len(x)
    first = np.clip(np.arange(n) - 1, 0, n - 3)  # of the three intervals whose means a parabola has
    nodes = t[first[:, None] + np.arange(4)][..., None]
    second = jnp.diff(x, axis=0) / (t[2:] - t[:-2])[:, None]
    third = (second[first + 1] - second[first]) / (nodes[:, 3] - nodes[:, 0])  # divided differences of the angle
    slopes = second[first] * 2 + third * (3 * (t[:-1] + t[1:])[:, None] - 2 * nodes[:, :3].sum(axis=1))
    return _of_intervals(t, x, h * slopes, 3 * h * h * third)


def _of_intervals(times: Array, *coefficients: Array) -> SampledRate:
    return SampledRate(times, jnp.stack(coefficients, axis=1).ravel())


def _coning(a: Array, t: Array) -> AlgebraVector:
    """The rate of q = (cos ½a, sin ½a cos t, sin ½a sin t, 0), an axis that moves on a cone of half-angle a."""
    return jnp.stack([-jnp.sin(a) * jnp.sin(t), jnp.sin(a) * jnp.cos(t), -2 * jnp.sin(a / 2) ** 2 + 0 * t])


def _rotating_field(w: Array, t: Array) -> AlgebraVector:
    """A field along z and one that rotates about it: w has their strengths and the frequency."""
    return jnp.stack([w[1] * jnp.cos(w[2] * t), w[1] * jnp.sin(w[2] * t), w[0] + 0 * t])


def _screw(v: Array, t: Array) -> AlgebraVector:
    """A rate and a velocity in the body, both of which vary."""
    return v * jnp.cos(t + jnp.arange(6.0, dtype=v.dtype))


kinematics = Kinematics
PROPERTIES = SystemProperties(
    name="kinematics",
    models="a motion on a group with a given rate, such as the `sampled_rate` of a gyro",
    phase_space="G: unit quaternion or matrix (n, n); π (0,)",
    conserves=(),
    momentum="none",
    sizes=(0,),
    aliases=("Poisson's kinematic equation", "reconstruction equation"),
    source="Iserles, Munthe-Kaas, Nørsett & Zanna 2000, Lie-group methods",
)


def examples() -> dict[str, tuple[Kinematics, State, float]]:
    """Coning in the body, a spin in a rotating field, and a screw on SE(3)."""
    from lieint_jax.groups import special_euclidean, special_unitary

    spin, start = special_unitary(2), so3.exp(jnp.array([0.7, 0.5, -0.2]))
    coning = kinematics(so3, jax.tree_util.Partial(_coning, jnp.array(0.6)))
    field = kinematics(spin, jax.tree_util.Partial(_rotating_field, jnp.array([1.0, 0.2, 1.1])), "space")
    screw = kinematics(special_euclidean(3), jax.tree_util.Partial(_screw, jnp.array([0.3, -0.2, 0.5, 1.0, 0.4, -0.6])))
    return {
        "coning": (coning, coning.state(start, t=0.3), 0.1),
        "spin": (field, field.state(), 0.1),
        "screw": (screw, screw.state(t=0.2), 0.1),
    }
