"""What every scenario has, whatever its system."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from lieint_jax.integrate import integrate
from lieint_jax.types import State, Step, Trajectory

LONGEST, POINTS = 200_000, 4_000  # steps of the nominal member that are drawn, and points of a curve

Triple = Annotated[list[float], Field(min_length=3, max_length=3)]
Quadruple = Annotated[list[float], Field(min_length=4, max_length=4)]
NonNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[int, Field(gt=0, le=10**12)]
Text = Annotated[str, Field(pattern=r"^[^$]*$")]  # no mathematics: it goes into pictures


class Table(BaseModel):
    """Keys as they are: none unknown, no text for a number, no nan."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class Published(Table):
    """A number from elsewhere, to set beside ours."""

    value: float
    error: float | None = None
    source: str


class Common(Table):
    """The keys of every scenario. A kind adds `system: Literal["its name"]`, its schemes and its numbers."""

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

    def assumption(self) -> str:
        """What the ensemble assumes, a line for the report; empty if nothing."""
        return ""

    def source(self, key: str) -> str:
        """The source under `key`, or `key` itself."""
        return self.sources.get(key, key)


def member(run: Trajectory, m: int, time: int = 0) -> State:
    """One member of a run, at a saved time."""
    return State(*(jnp.asarray(x[time, m]) for x in run.state))


def nominal(run: Trajectory, time: int = 0) -> State:
    """Member 0 of a run, at a saved time."""
    return member(run, 0, time)


def series(function: Callable[[State], Any], run: Trajectory) -> np.ndarray:
    """A function of the state at all saved times, of all members: (times, members, …)."""
    return np.asarray(jax.jit(jax.vmap(jax.vmap(function)))(State(*(jnp.asarray(x) for x in run.state))))


def deviation(x: np.ndarray) -> np.ndarray:
    """The standard deviation of the members, which are the first axis; 0 of one alone."""
    return np.std(x, axis=0, ddof=1) if len(x) > 1 else np.zeros(x.shape[1:])


def thinned(num_steps: int, longest: int = LONGEST) -> tuple[int, int]:
    """(steps, stride) of a drawn curve: at most `longest` steps, at most `POINTS` points."""
    num_steps = min(num_steps, longest)
    every = -(-num_steps // POINTS) or 1
    return max(num_steps // every, 1) * every, every


def follow(step: Step, state: State, dt: float, num_steps: int, longest: int = LONGEST) -> Trajectory:
    """One member's trajectory, at most `longest` steps, saved at the points that are drawn."""
    num_steps, every = thinned(num_steps, longest)
    return _follow(step, state, dt, num_steps, every)


_follow = jax.jit(integrate, static_argnames=("num_steps", "save_every"))
