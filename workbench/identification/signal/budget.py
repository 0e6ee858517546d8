"""How long an identification may take, and what it left undone."""

from collections.abc import Callable
from time import thread_time

SECONDS = 30.0
# Share of the time in which modes are searched; the rest is for refinement, standard errors and remarks.
SEARCH = 0.6

# (the search under way, the share of the time that is spent)
Progress = Callable[[str, float], None]


class Budget:
    """Processor time left for an identification; searches that find it spent return the best they have.

    Not time by the clock: a machine that others load gives the same result.

    Attributes:
        seconds: of processor time of this thread allowed, from the construction on.
        progress: called as the searches go on.
        unfinished: the searches that were ended early, each once.
    """

    def __init__(self, seconds: float | None = None, progress: Progress | None = None) -> None:
        if seconds is not None and not seconds > 0:
            raise ValueError(f"identification needs time: seconds must be positive; got {seconds:g}")
        self.seconds, self.progress = seconds, progress
        self.unfinished: list[str] = []
        self._begun = thread_time()
        self._end = self._whole = float("inf") if seconds is None else self._begun + seconds

    def spent(self, search: str) -> bool:
        """Whether the time is up; the search that asks is then noted as unfinished."""
        now = thread_time()
        if self.progress is not None:
            self.progress(search, min((now - self._begun) / (self._whole - self._begun), 1.0))
        if now < self._end:
            return False
        if search not in self.unfinished:
            self.unfinished.append(search)
        return True

    def share(self, share: float) -> "Budget":
        """A share of the time left, in (0, 1]; what it leaves unfinished counts here."""
        part = Budget(None if self.seconds is None else share * max(self._end - thread_time(), 1e-3))
        part.unfinished, part.progress = self.unfinished, self.progress
        part._begun, part._whole = self._begun, self._whole
        return part

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was left undone, in one sentence; empty where all was finished."""
        if not self.unfinished:
            return ()
        what = ", ".join(self.unfinished)
        return (f"stopped after {self.seconds:g} s, unfinished: {what}; allow more time by `seconds`",)
