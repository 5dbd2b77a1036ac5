"""The keys and functions that scenarios of every system share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from lieint_jax.integrate import integrate
from lieint_jax.types import State, Step, Trajectory

LONGEST, POINTS = 200_000, 4_000  # the most steps of the nominal member that are drawn, and points of a curve

Triple = Annotated[list[float], Field(min_length=3, max_length=3)]
Quadruple = Annotated[list[float], Field(min_length=4, max_length=4)]
NonNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[int, Field(gt=0, le=10**12)]
Text = Annotated[str, Field(pattern=r"^[^$]*$")]  # without $, which matplotlib reads as mathematics


class Table(BaseModel):
    """A table of keys, strictly validated: no unknown keys, no text for a number, no nan."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class Published(Table):
    """A published number, with its error and source."""

    value: float
    error: Annotated[float, Field(gt=0)] | None = None
    source: str


class Common(Table):
    """The keys of every scenario. A kind of system adds `system: Literal["its name"]`, schemes and parameters."""

    title: Text
    time_unit: Text = "time unit"
    system: str
    dt: float
    steps: Positive
    save_every: Positive = 1
    members: Annotated[int, Field(gt=0, le=10**9)] = 1
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    sources: dict[str, str] = {}

    @model_validator(mode="after")
    def _steps_and_saves(self) -> Self:
        if self.dt == 0:
            raise ValueError("dt must not be 0")
        if self.steps % self.save_every:
            raise ValueError(f"steps = {self.steps} must be a multiple of save_every = {self.save_every}")
        return self

    @model_validator(mode="after")
    def _sources_are_defined(self) -> Self:
        for key in _sources(self.model_dump()):
            if self.sources and key not in self.sources:
                raise ValueError(f"source {key!r} is not one of the keys of [sources]: {', '.join(self.sources)}")
        return self

    def assumption(self) -> str:
        """A line for the report that states the ensemble's assumption; empty if there is none."""
        return ""

    def source(self, key: str) -> str:
        """The source under `key`, or `key` itself."""
        return self.sources.get(key, key)


def _sources(tree: Any) -> list[str]:
    """The values of all keys `source` of a tree of tables."""
    if isinstance(tree, dict):
        own = [value for key, value in tree.items() if key == "source"]
        return own + [name for value in tree.values() for name in _sources(value)]
    return [name for value in tree for name in _sources(value)] if isinstance(tree, list) else []


def member(run: Trajectory, m: int, time: int = 0) -> State:
    """The state of one member of a run at the saved time of index `time`."""
    return State(*(jnp.asarray(x[time, m]) for x in run.state))


def nominal(run: Trajectory, time: int = 0) -> State:
    """The state of member 0 of a run at the saved time of index `time`."""
    return member(run, 0, time)


def series(function: Callable[[State], Any], run: Trajectory) -> np.ndarray:
    """The values of a function of the state, at all saved times of all members: (times, members, …)."""
    return np.asarray(jax.jit(jax.vmap(jax.vmap(function)))(State(*(jnp.asarray(x) for x in run.state))))


def deviation(x: np.ndarray) -> np.ndarray:
    """The standard deviation over the members, the first axis; 0 for a single member."""
    return np.std(x, axis=0, ddof=1) if len(x) > 1 else np.zeros(x.shape[1:])


def thinned(num_steps: int, longest: int = LONGEST) -> tuple[int, int]:
    """The steps of a drawn curve, at most `longest`, and its stride, for at most `POINTS` points."""
    num_steps = min(num_steps, longest)
    every = -(-num_steps // POINTS) or 1
    return max(num_steps // every, 1) * every, every


def follow(step: Step, state: State, dt: float, num_steps: int, longest: int = LONGEST) -> Trajectory:
    """The trajectory from one state, of at most `longest` steps, saved at the points to draw."""
    num_steps, every = thinned(num_steps, longest)
    return _follow(step, state, dt, num_steps, every)


_follow = jax.jit(integrate, static_argnames=("num_steps", "save_every"))
