"""Arguments of `li.run` and `li.integrate` in another order or under another name: the error says how to give them."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import jax
import numpy as np

from lieint_jax import _checks
from lieint_jax.core import State, Step

_F = TypeVar("_F", bound=Callable[..., Any])
_END = "num_steps, such as round(t_end / dt), or times"
_INSTEAD = {  # names of other packages
    **dict.fromkeys(("t_end", "t1", "tmax", "t_max", "tf", "duration", "t_span", "T"), _END),
    **dict.fromkeys(("steps", "n_steps", "nsteps", "n", "length"), "num_steps"),
    **dict.fromkeys(("h", "step_size", "timestep", "dt0"), "dt"),
    **dict.fromkeys(("ts", "t_eval", "saveat"), "save_at"),
    **dict.fromkeys(("y0", "state0", "initial_state", "z0"), "the initial state, as the second argument"),
}


def explained(name: str) -> Callable[[_F], _F]:
    """Make a function of (step, states, dt, num_steps, …) explain arguments that it does not have, or swapped ones."""

    def decorate(function: _F) -> _F:
        known = inspect.signature(function).parameters

        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            for given in kwargs:
                if given not in known:
                    near = difflib.get_close_matches(given, known, 1)
                    way = _INSTEAD.get(given) or (near[0] if near else f"one of {', '.join(known)}")
                    raise TypeError(f"{name} has no argument {given!r}: give {way}")
            if len(args) > 1 and isinstance(args[0], State) and isinstance(args[1], Step):
                raise ValueError(f"the step comes first: {name}(step, state, dt, num_steps)")
            if len(args) > 3 and _checks.integer(args[2]) is not None and isinstance(args[3], float):
                raise ValueError(
                    f"dt comes before num_steps: {name}(step, state, dt, num_steps), got dt = {args[2]} and "
                    f"num_steps = {args[3]}"
                )
            return function(*args, **kwargs)

        return call  # pyright: ignore[reportReturnType]

    return decorate


_LEAST_NDIM = {"inertia": 1, "metric": 1, "inertias": 2, "masses": 1, "mass": 0}  # of the principal values, or numbers


def check_inertias(step: Step, own_step: bool) -> None:
    """Raise ValueError unless the masses and inertias of a system are positive.

    Where a system is made inside of jit or vmap its constructor sees no numbers; those of a run are known.
    """
    system = step.system
    for name, ndim in _LEAST_NDIM.items():
        value = getattr(system, name, None)
        if not isinstance(value, jax.Array | np.ndarray) or not _checks.concrete(value):
            continue
        x = np.asarray(value, float)
        tensors = x.ndim - own_step > ndim  # else principal values
        if tensors and not (x.shape[-2:] == (x.shape[-1],) * 2 and np.allclose(x, np.swapaxes(x, -1, -2), rtol=1e-6)):
            continue  # the values of members, whose axis is refused later
        least = x
        if tensors and np.isfinite(x).all():  # in units of the diagonal, for a metric of rotations and translations
            unit = np.sqrt(np.abs(np.diagonal(x, axis1=-2, axis2=-1)))
            unit = np.where(unit > 0, unit, 1.0)
            least = np.linalg.eigvalsh(x / unit[..., None] / unit[..., None, :])[..., 0]
        bad = ~(least.reshape(len(x) if own_step else 1, -1) > 0).all(axis=1)
        if bad.any():
            who = f" of member {int(bad.argmax())}" if own_step else ""
            what = "positive definite" if "mass" not in name else "positive"
            shown = x[bad.argmax()] if own_step else x
            raise ValueError(f"{name}{who} must be {what}, got {np.array2string(shown, separator=', ')}")
