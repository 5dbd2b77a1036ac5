"""Creation and checks of states with a time and tracked work."""

from __future__ import annotations

from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax.types import State, clock


def timed(state: State, t: ArrayLike, work: ArrayLike | None) -> State:
    """A state at the time t, with the work done so far; ValueError if one of them is not a finite scalar."""
    if t is None:
        raise ValueError("t must be a number, the time of the state: the system depends on it; leave it out for t = 0")
    given = {"t": t} if work is None else {"t": t, "work": work}
    found = {name: _checks.real_array(name, x, (), like=state.p).astype(state.p.dtype) for name, x in given.items()}
    return state._replace(**found)


def check_timed(state: State) -> None:
    """ValueError if a state has no time, or a concrete time or work is not a finite scalar."""
    clock(state)
    check_counts(state)


def check_counts(state: State) -> None:
    """ValueError if a state's concrete time or work is not a finite scalar."""
    for name, value in (("state.t", state.t), ("state.work", state.work)):
        if value is not None:
            _checks.real_array(name, value, ())
