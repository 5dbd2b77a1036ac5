"""The progress bar of a long run, the length of its calls, and interrupts that wait until a run can be resumed."""

from __future__ import annotations

import signal
import sys
import threading
import warnings
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

import jax

from lieint_jax.runs import _layout
from lieint_jax.runs._layout import Layout

_CALL = 0.5  # target duration of a call of the compiled loop, s


class Bar:
    """A progress bar: body-steps per second, time left, worst energy error so far, unconverged members.

    It is on stderr, if that is a terminal, or below the cell of a notebook, where a run takes more than a second.
    """

    def __init__(self, shown: bool, num_steps: int, count: int, done: int, unit: str = " body-steps") -> None:
        self._count, self._worst = count, 0.0
        self._bar = None
        if shown and self.is_visible():
            self._delayed = _in_notebook()
            self._bar = _tqdm()(
                total=num_steps * count,
                initial=done * count,
                unit=unit,
                unit_scale=True,
                leave=False,
                dynamic_ncols=True,
                delay=1 if self._delayed else 0,
            )

    @staticmethod
    def is_visible() -> bool:
        """True if this is the first process and somebody sees its bar."""
        return jax.process_index() == 0 and (sys.stderr.isatty() or _in_notebook())

    def update(self, steps: int) -> None:
        """Advance the bar by `steps` steps of all members."""
        if self._bar is not None:
            self._bar.update(steps * self._count)

    def show(self, energy: float | None, unconverged: int) -> None:
        """Show the worst energy error so far, `energy` being the latest, and the number of members that failed."""
        shown = f"unconverged {unconverged}"
        if energy is not None:
            self._worst = energy if energy != energy else max(self._worst, energy)
            shown = f"energy {self._worst:.1e}, {shown}"
        if self._bar is not None:
            self._bar.set_postfix_str(shown, refresh=not self._delayed)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()


def _in_notebook() -> bool:
    """True in the kernel of Jupyter."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return type(shell).__name__ == "ZMQInteractiveShell"


def _tqdm() -> Any:
    """The kind of bar that fits: widgets in a notebook that has ipywidgets, else text."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "IProgress not found")
        from tqdm.auto import tqdm  # imported here, for a fast import of the package
    return tqdm


class CallLength:
    """The number of steps per call of the compiled loop, adapted so that a call takes about half a second."""

    def __init__(self, layout: Layout) -> None:
        self._mesh = layout.mesh
        self.steps, self.seconds = max(1, 100_000 // layout.members), 0.0

    def measure(self, steps: int, seconds: float, interrupted: bool) -> bool:
        """Adapt the number of steps to the duration of a call; return True if a process was interrupted."""
        self.seconds, stop = _layout.all_reduce_max(self._mesh, seconds, interrupted)
        if steps == self.steps or self.seconds > _CALL:
            grown = self.steps * min(4.0, _CALL / max(self.seconds, 1e-6))
            self.steps = int(min(max(1, grown), 2**30))
        return bool(stop)


class Interrupts:
    """Inside `with`, a first Ctrl-C or SIGTERM only sets `requested`; a second one interrupts at once.

    If not `deferred`, or outside the main thread, the handlers of the signals do not change.
    """

    def __init__(self, deferred: bool) -> None:
        self.requested = False
        self._deferred = deferred and threading.current_thread() is threading.main_thread()
        self._handlers: dict[int, Callable[[int, FrameType | None], object] | int | None] = {}

    def _request(self, number: int, _: object) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        print("\nlieint: finishing the chunk; interrupt again to stop at once", file=sys.stderr)

    def __enter__(self) -> Self:
        if self._deferred:
            self._handlers = {n: signal.signal(n, self._request) for n in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
