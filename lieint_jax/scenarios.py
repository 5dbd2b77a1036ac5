"""Scenario files (*.toml), shipped or the user's own, and their meaning: from a file to a batch of states and a report.

A scenario is a system, a scheme, a time step and an ensemble of initial states; it may hold published values and
observations to set beside the results. `scenario_names` lists the shipped ones.
"""

from __future__ import annotations

import tomllib
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from lieint_jax import checks, diagnostics, maps, schemes, systems
from lieint_jax.groups import so3
from lieint_jax.systems import RigidBody
from lieint_jax.types import State, Step, Trajectory

Triple = Annotated[list[float], Field(min_length=3, max_length=3)]
Quadruple = Annotated[list[float], Field(min_length=4, max_length=4)]
NonNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[int, Field(gt=0, le=10**12)]
Text = Annotated[str, Field(pattern=r"^[^$]*$")]  # no mathematics: it goes into pictures


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class InitialState(_Table):
    """The nominal state: an attitude (quaternion or Euler 3-1-3 angles) and a body angular velocity."""

    quaternion: Quadruple | None = None
    euler_313_deg: Triple | None = None
    angular_velocity: Triple | None = None
    angular_velocity_deg: Triple | None = None

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        if self.quaternion is not None and self.euler_313_deg is not None:
            raise ValueError("give quaternion or euler_313_deg, not both")
        if (self.angular_velocity is None) == (self.angular_velocity_deg is None):
            raise ValueError("give exactly one of angular_velocity (radians) and angular_velocity_deg")
        if self.quaternion is not None:
            checks.unit_quaternion("quaternion", self.quaternion)
        return self

    def attitude(self) -> Any:
        if self.euler_313_deg is not None:
            return so3.from_euler_313(jnp.deg2rad(jnp.asarray(self.euler_313_deg)))
        return jnp.asarray(self.quaternion or [1.0, 0.0, 0.0, 0.0])

    def rate(self) -> Any:
        if self.angular_velocity_deg is not None:
            return jnp.deg2rad(jnp.asarray(self.angular_velocity_deg))
        return jnp.asarray(self.angular_velocity)


class Spread(_Table):
    """Standard deviations, a component, of the members about the nominal state."""

    attitude_deg: NonNegative = 0.0
    angular_velocity_deg: NonNegative = 0.0


class Published(_Table):
    value: float
    error: float | None = None
    source: str


class Observation(InitialState):
    label: Text
    t: float
    source: str


class Scenario(_Table):
    """The keys of a scenario file."""

    title: Text
    time_unit: Text = "time unit"
    system: Literal["rigid_body"]
    inertia: list[Any]
    scheme: Literal["so3_midpoint"] = "so3_midpoint"
    kappa: Literal["symplectic", "cayley", "exponential"] = "symplectic"
    dt: float
    steps: Positive
    save_every: Positive = 1
    members: Annotated[int, Field(gt=0, le=10**9)] = 1
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    state: InitialState
    spread: Spread = Spread()
    published: dict[
        Literal["precession_period", "rotation_period", "momentum_longitude_deg", "momentum_latitude_deg"], Published
    ] = {}
    observation: list[Observation] = []
    sources: dict[str, str] = {}

    @field_validator("inertia")
    @classmethod
    def _a_body(cls, value: list[Any]) -> list[Any]:
        checks.inertia(value)
        return value

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.dt == 0:
            raise ValueError("dt must not be 0")
        if self.steps % self.save_every:
            raise ValueError(f"steps = {self.steps} must be a multiple of save_every = {self.save_every}")
        interval = self.dt * self.save_every
        for seen in self.observation:
            if abs(seen.t / interval - round(seen.t / interval)) > 1e-6:
                raise ValueError(f"observation.t = {seen.t} must be a multiple of dt·save_every = {interval:.9g}")
        return self


def scenario_names() -> list[str]:
    """The scenarios in the package."""
    files = resources.files("lieint_jax.data").iterdir()
    return sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))


def load(name: str, **changes: Any) -> Scenario:
    """The scenario shipped under `name`, or the one in the file `name`, with `changes` to its keys.

    Raises:
        ValueError: no such scenario, not TOML, or a key that is missing, unknown or out of range: the message names it.
    """
    path = Path(name)
    if name in scenario_names():
        text = resources.files("lieint_jax.data").joinpath(f"{name}.toml").read_text(encoding="utf-8")
    elif path.is_file():
        try:
            text = path.read_bytes().decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise ValueError(f"{name} is not UTF-8 text: {error}") from error
    else:
        raise ValueError(f"no scenario {name!r}: give a .toml file or one of {', '.join(scenario_names())}")
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{name} is not valid TOML: {error}") from error
    try:
        return Scenario.model_validate(table | {key: value for key, value in changes.items() if value is not None})
    except ValidationError as error:
        problem, *others = error.errors()
        key = "".join(f"{part}." for part in problem["loc"] if part != "[key]").removesuffix(".")
        given = (
            ""
            if problem["type"] in ("missing", "extra_forbidden") or not problem["loc"]
            else f" (got {problem['input']!r})"
        )
        message = {"extra_forbidden": "unknown key", "missing": "key missing"}.get(problem["type"], problem["msg"])
        more = f"; and {len(others)} more" if others else ""
        where = f"{name}: {key}: " if key else f"{name}: "
        raise ValueError(f"{where}{message.removeprefix('Value error, ')}{given}{more}") from error


def build(scenario: Scenario) -> tuple[Step, State]:
    """The step and the batch of initial states; member 0 is the nominal state."""
    body = systems.rigid_body(scenario.inertia)
    step = schemes.so3_midpoint(body, getattr(maps, f"kappa_{scenario.kappa}"))
    kick, jolt = jax.random.normal(jax.random.key(scenario.seed), (2, scenario.members, 3))
    kick, jolt = (x.at[0].set(0.0) for x in (kick, jolt))
    kick = jnp.deg2rad(scenario.spread.attitude_deg) * kick
    jolt = jnp.deg2rad(scenario.spread.angular_velocity_deg) * jolt
    q, Omega = scenario.state.attitude(), scenario.state.rate()

    def member(kick: jax.Array, jolt: jax.Array) -> State:
        return body.state(so3.multiply(so3.exp(kick), q), angular_velocity=Omega + jolt)

    return step, jax.vmap(member)(kick, jolt)


class Row(NamedTuple):
    """One quantity of the report: the nominal value, the ensemble's standard deviation, the published value."""

    name: str
    nominal: float
    spread: float
    published: Published | None


def quantities(scenario: Scenario, body: RigidBody, run: Trajectory) -> list[Row]:
    """Mean periods of the tumbling and the direction of angular momentum, member by member."""
    p = np.asarray(run.state.p)[0]
    unit = p / np.linalg.norm(p, axis=1, keepdims=True)
    longitude = np.rad2deg(np.arctan2(unit[:, 1], unit[:, 0])) % 360
    latitude = np.rad2deg(np.arcsin(unit[:, 2]))
    precession, rotation = mean_periods(body, run)
    unit = scenario.time_unit
    table = {
        "precession_period": (f"precession period ({unit})", precession),
        "rotation_period": (f"rotation period ({unit})", rotation),
        "momentum_longitude_deg": ("angular momentum longitude (°)", longitude),
        "momentum_latitude_deg": ("angular momentum latitude (°)", latitude),
    }
    return [
        Row(name, float(x[0]), _spread(x, key.endswith("_deg")), scenario.published.get(key))  # pyright: ignore[reportArgumentType]
        for key, (name, x) in table.items()
    ]


def _spread(x: np.ndarray, angle: bool) -> float:
    """The standard deviation of the members; of angles in degrees, about the nominal one and round the circle."""
    deviation = (x - x[0] + 180) % 360 - 180 if angle else x
    return float(np.std(deviation, ddof=1)) if len(x) > 1 else 0.0


def mean_periods(body: RigidBody, run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Mean periods, one a member, of the tumbling of a free body about the principal axis that it tumbles about.

    That axis is the one of least inertia if |Π|² < 2H J₂, else the one of greatest (Poinsot). The first period is that
    of the axis' precession about the angular momentum, the second that of Π about the axis in the body.

    Returns:
        Arrays (members,); nan where states are saved too far apart to follow the angles (more than 2.5 rad at |Π|/J₁).
    """
    J = np.asarray(body.inertia)
    moments, axes = np.linalg.eigh(np.diag(J) if J.ndim == 1 else J)  # ascending; columns are axes in the body
    axes[:, 2] *= np.linalg.det(axes)  # right-handed
    matrix = jax.jit(jax.vmap(so3.to_matrix))
    precession, rotation = [], []
    for m in range(run.state.p.shape[1]):
        R, pi = np.asarray(matrix(run.state.q[:, m])), np.asarray(run.state.p[0, m])
        Pi = R.transpose(0, 2, 1) @ pi @ axes
        square = (Pi[0] ** 2).sum()
        long = square < (Pi[0] ** 2 / moments).sum() * moments[1]
        e = R @ axes[:, 0 if long else 2]
        Pi = Pi[:, [1, 2, 0]] if long else Pi
        across = np.linalg.svd(pi[None])[2][1:]
        across[1] *= np.sign(np.linalg.det([*across, pi]))
        rate = np.sqrt(square) / moments[0]
        too_coarse = rate * abs(run.t[1] - run.t[0]) > 2.5
        phi, psi = (np.unwrap(np.arctan2(y, x)) for x, y in (across @ e.T, Pi[:, :2].T))
        for periods, angle in ((precession, phi), (rotation, psi)):
            turn = abs(angle[-1] - angle[0])
            periods.append(np.nan if too_coarse or turn == 0 else 2 * np.pi * abs(run.t[-1] - run.t[0]) / turn)
    return np.array(precession), np.array(rotation)


def save_index(scenario: Scenario, seen: Observation) -> int:
    """Which saved state an observation falls on."""
    return round(seen.t / (scenario.dt * scenario.save_every))


class Sighting(NamedTuple):
    """An observation beside the prediction for it; angles in degrees."""

    observation: Observation
    euler_313_deg: np.ndarray
    angular_velocity_deg: np.ndarray
    apart_deg: float
    spread_deg: float
    integrator_error_deg: float


def sightings(scenario: Scenario, body: RigidBody, run: Trajectory) -> list[Sighting]:
    """What the nominal member predicts for each observation within the run.

    `spread_deg` is the root mean square angle of the members about the nominal one; `integrator_error_deg` the angle
    between the nominal one and the solution of the equations of motion to round-off.
    """
    found = []
    for seen in scenario.observation:
        k = save_index(scenario, seen)
        if not 0 <= k < len(run.t):
            continue
        now = State(jnp.asarray(run.state.q[k, 0]), jnp.asarray(run.state.p[k, 0]))
        start = State(jnp.asarray(run.state.q[0, 0]), jnp.asarray(run.state.p[0, 0]))
        Omega = jnp.linalg.norm(body.angular_velocity(start))
        true = diagnostics.flow(body, start, seen.t, 2 * int(abs(seen.t * Omega)) + 2)
        apart = jax.vmap(so3.angle, in_axes=(0, None))(jnp.asarray(run.state.q[k]), now.q)
        found.append(
            Sighting(
                seen,
                np.rad2deg(np.asarray(so3.to_euler_313(now.q))) % 360,
                np.rad2deg(np.asarray(body.angular_velocity(now))),
                float(jnp.rad2deg(so3.angle(now.q, seen.attitude()))),
                float(jnp.rad2deg(jnp.sqrt(jnp.mean(apart**2)))),
                float(jnp.rad2deg(so3.angle(now.q, true.q))),
            )
        )
    return found
