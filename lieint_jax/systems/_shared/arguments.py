"""Arguments of `.state`: wrong calls, explained by the names of its arguments; times and tracked work, checked."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast

from numpy.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax.core import State, clock

_F = TypeVar("_F", bound=Callable[..., Any])


def explained(method: _F) -> _F:
    """A method whose wrong calls raise a TypeError that names the arguments it accepts."""
    signature = inspect.signature(method)

    @functools.wraps(method)
    def call(*arguments: Any, **options: Any) -> Any:
        try:
            return method(*arguments, **options)
        except TypeError:
            try:
                signature.bind(*arguments, **options)
            except TypeError as wrong:
                name, parameters = method.__name__, list(signature.parameters.values())[1:]
                named = [x.name for x in parameters if x.kind is x.KEYWORD_ONLY]
                first = ", ".join(x.name for x in parameters if x.kind is not x.KEYWORD_ONLY)
                raise TypeError(
                    f"{name}: {wrong}; {first} may come first without a name, and {', '.join(named)} need theirs: "
                    f"{name}({first}, {named[0]}=...)"
                ) from None
            raise

    return cast("_F", call)


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
