"""How long a search may go on."""

import os
from time import process_time


class Deadline:
    """Processor time that a search may take; one that finds it spent ends with the best that it has.

    Not time by the clock: a machine that others load gives the same result. A forked process counts on from what was
    spent when it was last asked before the fork.

    Attributes:
        seconds: of processor time of this process, from the construction on; None for no limit.
    """

    def __init__(self, seconds: float | None = None) -> None:
        if seconds is not None and not seconds > 0:
            raise ValueError(f"a search needs time: seconds must be positive; got {seconds:g}")
        self.seconds = seconds
        self._process = os.getpid()
        self._begun = self._spent = process_time()
        self._end = float("inf") if seconds is None else self._begun + seconds

    @property
    def _now(self) -> float:
        now = process_time()
        if os.getpid() != self._process:
            return now + self._spent
        self._spent = now
        return now

    @property
    def is_past(self) -> bool:
        """Whether the time is spent."""
        return self._now > self._end


NEVER = Deadline()
