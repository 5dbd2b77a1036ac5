"""The initial states of a run as a function of member numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from lieint_jax import _checks
from lieint_jax.core import State
from lieint_jax.runs._digests import digest_of_arrays, digest_of_programs, digest_of_states

MakeStates = Callable[[np.ndarray], State]  # of the members of these numbers
BLOCK = 2**16  # members whose states are made in one call


class MadeStates:
    """The initial states of a run as a function.

    Attributes:
        function: member numbers (m,) ↦ states, with the leading axis (m,) on every leaf but scalars t and work.
        members: the number of members of the run.
    """

    def __init__(self, function: MakeStates, members: int) -> None:
        self.function, self.members = function, members
        self._last: tuple[int, State] | None = None  # the block that was made last, and where it begins

    def make(self, members: range) -> State:
        """The initial states of consecutive members, as host arrays.

        The function is called for whole blocks of the run, whichever of their members are needed: the last bits of
        compiled code may depend on the length of an array and on the place in it. So a member is the same in every
        part.

        Raises:
            ValueError: the function returns no states, those of another number of members, or of changing shapes; all
                together exceed this machine's memory.
        """
        found, first = None, members.start // BLOCK * BLOCK
        for start in range(first, members.stop, BLOCK):
            if self._last is None or self._last[0] != start:
                numbers = np.arange(start, min(start + BLOCK, self.members))
                self._last = start, _checked(self.function(numbers), len(numbers))
            made = self._last[1]
            if found is None:
                _check_size(made, len(members))
                found = jax.tree.map(lambda x: np.empty((len(members), *x.shape[1:]), x.dtype) if x.ndim else x, made)
            _fill(found, made, members, start)
        assert found is not None
        return found

    def digest(self) -> str:
        """The digest of the function: of its program, or, if JAX cannot trace it, of the states of all members."""
        numbers = jax.ShapeDtypeStruct((min(BLOCK, self.members),), jax.dtypes.canonicalize_dtype(np.int64))
        try:
            program, states = jax.make_jaxpr(self.function, return_shape=True)(numbers)
            parts = [digest_of_programs(program), str(jax.tree.structure(states))]
        except Exception:  # whatever a function that expects numbers raises
            blocks = (range(k, min(k + BLOCK, self.members)) for k in range(0, self.members, BLOCK))
            parts = [digest_of_states(self.make(block)) for block in blocks]
        return digest_of_arrays(*(x.encode() for x in parts))


def made_states(states: State | MakeStates, members: int | None) -> MadeStates | None:
    """The function of the initial states and its number of members, checked; None if `states` are arrays."""
    if not callable(states):
        if members is not None:
            raise ValueError("members is the number of members where states is a function; arrays have their own")
        return None
    if members is None:
        raise ValueError("states is a function of member numbers: give their number, members=N")
    return MadeStates(states, _checks.count("members", members, 1))


def _checked(states: object, number: int) -> State:
    """The result of a call of the function, as host arrays."""
    if not isinstance(states, State):
        raise ValueError(
            f"states must return a State for an array of member numbers, such as jax.vmap(…) makes, got "
            f"{type(states).__name__}"
        )
    found: Any = jax.tree.map(np.asarray, states)
    leaves = [x for name, x in found._asdict().items() if not (name in ("t", "work") and np.ndim(x) == 0)]
    lengths = {x.shape[:1] for x in jax.tree.leaves(leaves)}
    if lengths != {(number,)}:
        given = ", ".join(str(x.shape) for x in jax.tree.leaves(leaves))
        raise ValueError(f"states must return the states of {number} member(s) for as many numbers, got shapes {given}")
    return found


def _check_size(made: State, members: int) -> None:
    """Raise ValueError, before they are made, if the states of so many members exceed this machine's memory."""
    size, memory = members * sum(x[:1].nbytes for x in jax.tree.leaves(made) if x.ndim), _checks.memory_of_machine()
    if size > memory:
        raise ValueError(
            f"the initial states of {members} members would hold {_checks.spoken_size(size)} in memory, and this "
            f"machine has {_checks.spoken_size(memory)}; use fewer members, or more parts: part=(k, n)"
        )


def _fill(found: State, made: State, members: range, start: int) -> None:
    """Copy those of the states of a block, which begins at the member `start`, that belong to `members`."""
    structures = {jax.tree.structure(x) for x in (found, made)}
    shapes = [[(x.shape[1:], x.ndim, x.dtype) for x in jax.tree.leaves(states)] for states in (found, made)]
    if len(structures) > 1 or shapes[0] != shapes[1]:
        raise ValueError(f"states must return arrays of the same shapes for all members, which changes at {start}")
    for target, x in zip(jax.tree.leaves(found), jax.tree.leaves(made), strict=True):
        if not x.ndim:
            if target != x:
                raise ValueError(f"states must return one scalar t and work for all members, got {target} and {x}")
            continue
        own = x[max(members.start - start, 0) : members.stop - start]
        begin = max(start - members.start, 0)
        target[begin : begin + len(own)] = own
