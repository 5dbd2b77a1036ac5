"""How a long run is watched and stopped: a bar, a pace, an interrupt that waits for a good moment."""

from __future__ import annotations

import signal
import sys
import threading
from typing import Any, Self

import jax

from lieint_jax.ensemble import _layout
from lieint_jax.ensemble._layout import Layout

_CALL = 0.5  # seconds that one call of the compiled loop is to take


class Bar:
    """A progress bar on stderr: body-steps per second, time left, worst energy error so far, members unconverged."""

    def __init__(self, shown: bool, num_steps: int, count: int, done: int) -> None:
        from tqdm import tqdm  # where it is used: the package imports in a moment

        self._count, self._worst = count, 0.0
        self._bar = tqdm(
            total=num_steps * count,
            initial=done * count,
            unit=" body-steps",
            unit_scale=True,
            disable=not (shown and self.visible()),
            leave=False,
            dynamic_ncols=True,
        )

    @staticmethod
    def visible() -> bool:
        """Whether this process is the first, and has a terminal to draw on."""
        return jax.process_index() == 0 and sys.stderr.isatty()

    def update(self, steps: int) -> None:
        """All members have taken `steps` more steps."""
        self._bar.update(steps * self._count)

    def tell(self, energy: float, unconverged: int) -> None:
        """The energy error now, and how many members have failed so far."""
        self._worst = energy if energy != energy else max(self._worst, energy)
        self._bar.set_postfix_str(f"energy {self._worst:.1e}, unconverged {unconverged}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()


class Pace:
    """How many steps a call of the compiled loop takes, so that it lasts about half a second on every process."""

    def __init__(self, layout: Layout) -> None:
        self._mesh = layout.mesh
        self._call = _CALL + 1e-3 * layout.blocks  # every block is a call, which costs time too
        self.steps, self.seconds = max(1, 100_000 // layout.members), 0.0

    def measure(self, steps: int, seconds: float, interrupted: bool) -> bool:
        """Learn from a call; whether to stop, because a process was interrupted."""
        self.seconds, stop = _layout.all_reduce_max(self._mesh, seconds, interrupted)
        if steps == self.steps or self.seconds > self._call:
            grown = self.steps * min(4.0, self._call / max(self.seconds, 1e-6))
            self.steps = int(min(max(1, grown), 2**30))
        return bool(stop)


class Interrupts:
    """Between `with` and its end, Ctrl-C and SIGTERM only ask; a second one interrupts at once.

    If not `deferred`, or outside the main thread, they do what they always do.
    """

    def __init__(self, deferred: bool) -> None:
        self.asked = False
        self._deferred = deferred and threading.current_thread() is threading.main_thread()
        self._before: dict[int, Any] = {}

    def _ask(self, number: int, _: object) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        print("\nlieint: finishing the chunk; interrupt again to stop at once", file=sys.stderr)

    def __enter__(self) -> Self:
        if self._deferred:
            self._before = {n: signal.signal(n, self._ask) for n in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
