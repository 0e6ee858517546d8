"""How long a search may go on."""

import os
from time import process_time
from typing import Any

from numba.core.event import Listener, register


class _Compiling(Listener):
    """Processor time that compiling has taken, s: once a machine, for which no search has to end sooner."""

    def __init__(self) -> None:
        self.seconds, self._begun, self._depth = 0.0, 0.0, 0

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._begun = process_time()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += process_time() - self._begun


_compiling = _Compiling()
register("numba:compile", _compiling)  # type: ignore[no-untyped-call]


class Deadline:
    """Processor time that a search may take; one that finds it spent ends with the best that it has.

    Not time by the clock: a machine that others load gives the same result; nor what compiling takes. A forked process
    counts on from what was spent when it was last asked before the fork.

    Attributes:
        seconds: of processor time of this process, from the construction on; None for no limit.
    """

    def __init__(self, seconds: float | None = None) -> None:
        if seconds is not None and not seconds > 0:
            raise ValueError(f"a search needs time: seconds must be positive; got {seconds:g}")
        self.seconds = seconds
        self._process = os.getpid()
        self._compiled = _compiling.seconds
        self._begun = self._spent = process_time() - self._compiled
        self._end = float("inf") if seconds is None else self._begun + seconds

    @property
    def _now(self) -> float:
        if os.getpid() != self._process:
            return process_time() - (_compiling.seconds - self._compiled) + self._spent
        self._compiled = _compiling.seconds
        self._spent = process_time() - self._compiled
        return self._spent

    @property
    def is_past(self) -> bool:
        """Whether the time is spent."""
        return self._now > self._end


NEVER = Deadline()
