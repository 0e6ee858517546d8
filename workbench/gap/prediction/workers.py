"""Work shared with forked processes: they have all that this one has, and only what they find is sent back."""

import os
import pickle
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from ctypes import CDLL
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from mmap import mmap
from typing import Any, NoReturn, TypeVar

import joblib
import numpy as np

from workbench.gap.effects.effect import Kind

MOST = 8  # processes: to fork one takes a hundredth of a second, every time
FORKS = sys.platform == "linux"  # elsewhere libraries of the system do not survive one, or there is none
PR_SET_PDEATHSIG = 1  # <linux/prctl.h>
LEFT_OVER = 5  # niceness of what is computed in the background: less urgent, but asked for in the end
TURN = 4  # bytes of a number in the pipe that turns are taken from
MOST_TURNS = 8192  # what a pipe holds at once, with room to spare

Item = TypeVar("Item")
Found = TypeVar("Found")


@dataclass(frozen=True)
class Workers:
    """So many processes, this one included.

    Threads would wait for one another: what a search does between its compiled loops holds the interpreter. Forked
    processes share the rig, the records and what is compiled without a copy.
    """

    number: int = 1

    def __post_init__(self) -> None:
        if self.number < 1:
            raise ValueError(f"workers is a number of processes, this one included: 1 or more; got {self.number}")

    @classmethod
    def at_hand(cls) -> "Workers":
        """One a core, as long as they pay for being forked."""
        return cls(min(joblib.cpu_count(), MOST))

    def map(self, function: Callable[[Item], Found], items: Iterable[Item]) -> list[Found]:
        """`function(item)` of each, in their order; each process takes the next item when it is done with one.

        A forked process changes nothing in this one: what a function finds, it returns, or writes into a
        `shared_array`.

        Raises:
            ChildProcessError: a process was killed, for want of memory for instance.
        """
        items = list(items)
        number = 1 if _Helper.is_this_process else min(self.number, len(items))
        if number < 2:
            return [function(item) for item in items]
        if not FORKS:
            with ThreadPoolExecutor(number) as pool:
                return list(pool.map(function, items))
        turns = _turns(len(items))
        helpers: list[_Helper] = []
        try:
            helpers += (_Helper(lambda: _taken(function, items, turns)) for _ in range(number - 1))
            found = _taken(function, items, turns)
            for helper in helpers:
                found.update(helper.found())
        finally:
            os.close(turns)
            for helper in helpers:
                helper.end()
        return [found[i] for i in range(len(items))]

    @contextmanager
    def in_background(self, function: Callable[[], Found]) -> Iterator[Callable[[], Found]]:
        """Have `function()` computed in the time that the others leave; what is given to the block, called, has it.

        Its work may be shared further. Where no process is forked it is computed when it is asked for. What
        nobody has asked for by the end of the block is given up.
        """
        if _Helper.is_this_process or self.number < 2 or not FORKS:
            yield cache(function)
            return
        helper = _Helper(function, background=True)
        try:
            yield cache(helper.found)
        finally:
            helper.end()


ALONE = Workers(1)


def shared_array(*shape: int) -> np.ndarray:
    """Zeros that forked processes write into for this one to read."""
    n_bytes = 8 * int(np.prod(shape))
    return np.frombuffer(mmap(-1, max(n_bytes, 8)), float, n_bytes // 8).reshape(shape)


def _turns(n: int) -> int:
    """The end of a pipe that holds the first index of every turn, to be read by whoever is free."""
    source, sink = os.pipe()
    for start in range(0, n, _per_turn(n)):
        os.write(sink, start.to_bytes(TURN, "little"))
    os.close(sink)
    return source


def _per_turn(n: int) -> int:
    return -(-n // MOST_TURNS)


def _taken(function: Callable[[Any], Any], items: list[Any], turns: int) -> dict[int, Any]:
    """What this process found, by the index of the item."""
    found = {}
    while turn := os.read(turns, TURN):
        start = int.from_bytes(turn, "little")
        for i in range(start, min(start + _per_turn(len(items)), len(items))):
            found[i] = function(items[i])
    return found


class _Helper:
    """A forked process that sends back what it found; without helpers of its own, unless in the background."""

    is_this_process = False

    def __init__(self, work: Callable[[], Any], background: bool = False) -> None:
        self._source, sink = os.pipe()
        with warnings.catch_warnings():
            # no lock of another thread is ever asked for by a helper: it computes, writes to its pipe and ends
            warnings.filterwarnings("ignore", message=".*multi-threaded.*", category=DeprecationWarning)
            self._pid = os.fork()
        if self._pid == 0:
            _help(work, sink, background)
        os.close(sink)

    def found(self) -> Any:
        """What it found; what it failed by is raised here."""
        with open(self._source, "rb", closefd=False) as sent:
            answer = sent.read()
        try:
            found = _Receiver(BytesIO(answer)).load()
        except (EOFError, pickle.UnpicklingError):
            text = "a process of the diagnosis was killed; is there memory for so many? Try one worker alone"
            raise ChildProcessError(text) from None
        if isinstance(found, BaseException):
            raise found
        return found

    def end(self) -> None:
        """Nothing is left of it, whatever it was at."""
        os.close(self._source)
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(self._pid, signal.SIGKILL)
            os.waitpid(self._pid, 0)


def _help(work: Callable[[], Any], sink: int, background: bool) -> NoReturn:
    """The life of a helper; it ends here, without what a process does at its end for those that it was forked from."""
    try:
        _Helper.is_this_process = not background
        os.nice(LEFT_OVER if background else 0)
        CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # it outlives nobody whom it works for
        try:
            answer = _sent(work())
        except Exception as error:
            error.add_note("".join(traceback.format_tb(error.__traceback__)))
            answer = _sent(error)
        with open(sink, "wb") as out:
            out.write(answer)
    finally:
        os._exit(0)


def _sent(found: Any) -> bytes:
    out = BytesIO()
    _Sender(out, pickle.HIGHEST_PROTOCOL).dump(found)
    return out.getvalue()


class _Sender(pickle.Pickler):
    """Kinds of effects are sent as the one that is here: they hold functions, and a search asks which one it is."""

    def persistent_id(self, thing: Any) -> int | None:
        return id(thing) if isinstance(thing, Kind) else None


class _Receiver(pickle.Unpickler):
    def persistent_load(self, key: int) -> Kind:
        return Kind.known[key]
