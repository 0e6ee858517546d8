"""Work shared with forked processes: they have all that this one has, and only what they find is sent back."""

import os
import pickle
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from ctypes import CDLL
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from mmap import mmap
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, ClassVar, NoReturn, TypeVar

import numpy as np

from workbench.arrays import Floats
from workbench.gap.effects.effect import Kind
from workbench.threads import cores

MOST = 8  # processes: to fork one takes a hundredth of a second, every time
FORKS = sys.platform == "linux"  # elsewhere libraries of the system do not survive one, or there is none
PR_SET_PDEATHSIG = 1  # <linux/prctl.h>
LEFT_OVER = 5  # niceness of what is computed in the background: less urgent, but asked for in the end
TURN = 4  # bytes of a number in the pipe that turns are taken from
NO_MORE = 2**32 - 1  # in the place of a turn: nothing is left of these items
MOST_TURNS = 8192  # what a pipe holds at once, with room to spare

SPARE = 2  # arrays given back that are kept
LARGER = 4  # times the room that is asked for, that it may be taken from

_spare: dict[bool, list[Floats]] = {True: [], False: []}  # room given back: shared with forked processes, or not

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
        if self.number < 1 or self.number != int(self.number):
            raise ValueError(f"workers is a number of processes, this one included: 1 or more; got {self.number}")

    @classmethod
    def at_hand(cls) -> "Workers":
        """One a core, as long as they pay for being forked."""
        return cls(min(cores(), MOST))

    def map(self, function: Callable[[Item], Found], items: Iterable[Item]) -> list[Found]:
        """`function(item)` of each, in their order; each process takes the next item when it is done with one.

        A forked process changes nothing in this one: what a function finds, it returns, or writes into
        an `array`.

        Raises:
            ChildProcessError: a process was killed, for want of memory for instance.
        """
        at_hand = list(items)

        def of(i: int) -> Found:
            return function(at_hand[i])

        with self.standing(of) as share:
            return share(range(len(at_hand)))

    @contextmanager
    def standing(self, function: Callable[[Item], Found]) -> Iterator[Callable[[Sequence[Item]], list[Found]]]:
        """Processes that stand by: what is given to the block is `map` of the function, again and again.

        They are forked when it is first called, and once: what changes here afterwards they only learn from the items.
        To fork takes a hundredth of a second, and as long again for the memory that is written to after it.
        """
        if self._are_alone:
            yield lambda items: [function(item) for item in items]
        elif not FORKS:
            with ThreadPoolExecutor(self.number) as pool:
                yield lambda items: list(pool.map(function, items))
        else:
            crew = _Crew(function, self.number)
            try:
                yield crew.share
            finally:
                crew.end()

    def array(self, *shape: int) -> Floats:
        """Room that forked processes write into for this one to read; what stands in it at first is left over."""
        size, shared = int(np.prod(shape)), FORKS and not self._are_alone
        spare = _spare[shared]
        i = next((i for i, room in enumerate(spare) if size <= room.size <= LARGER * size), None)
        if i is not None:
            room = spare.pop(i)
        elif shared:
            room = np.frombuffer(mmap(-1, max(8 * size, 8)), float, size)
        else:
            room = np.empty(size)
        return room[:size].reshape(shape)

    def give_back(self, array: Floats) -> None:
        """Keep room for the next `array`: the system takes a microsecond to clear every kilobyte anew."""
        if isinstance(array.base, np.ndarray):
            spare = _spare[FORKS and not self._are_alone]
            spare[:] = [array.base, *spare[: SPARE - 1]]

    @property
    def at_once(self) -> int:
        """How many processes there are here: helpers have none of their own."""
        return 1 if self._are_alone else self.number

    @property
    def _are_alone(self) -> bool:
        return _Helper.is_this_process or self.number < 2

    @contextmanager
    def in_background(self, function: Callable[[], Found]) -> Iterator[Callable[[], Found]]:
        """Have `function()` computed in the time that the others leave; what is given to the block, called, has it.

        Its work may be shared further. Where no process is forked it is computed when it is asked for. What
        nobody has asked for by the end of the block is given up; no helper and no room is left after it.
        """
        helper = None if self._are_alone or not FORKS else _Helper(lambda _: function(), background=True)
        try:
            if helper is not None:
                helper.ask(None)
            yield cache(function if helper is None else helper.found)
        finally:
            if helper is not None:
                helper.end()
            _leave_nothing()


def _leave_nothing() -> None:
    """Helpers that were ended are gone, and the system has the room that was given back."""
    for pid in _Helper.ending:
        with suppress(ChildProcessError):
            os.waitpid(pid, 0)
    _Helper.ending = []
    for spare in _spare.values():
        spare.clear()


ALONE = Workers(1)


class _Crew:
    """This process and the helpers that take turns with it; each takes the next item when it is done with one."""

    def __init__(self, function: Callable[[Any], Any], number: int) -> None:
        self._function, self._number = function, number
        self._helpers: list[_Helper] = []
        self._turns, self._sink = os.pipe()  # it holds the first index of every turn, for whoever is free

    def share(self, items: Sequence[Any]) -> list[Any]:
        while len(self._helpers) < min(self._number, len(items)) - 1:
            self._helpers.append(_Helper(self._taken))
        if len(items) < 2:
            return [self._function(item) for item in items]
        for start in range(0, len(items), _per_turn(items)):
            self._put(start)
        for helper in self._helpers:
            helper.ask(items)
        for _ in range(len(self._helpers) + 1):
            self._put(NO_MORE)
        found = self._taken(items)
        for helper in self._helpers:
            found.update(helper.found())
        return [found[i] for i in range(len(items))]

    def end(self) -> None:
        os.close(self._turns)
        os.close(self._sink)
        for helper in self._helpers:
            helper.end()

    def _put(self, turn: int) -> None:
        os.write(self._sink, turn.to_bytes(TURN, "little"))

    def _taken(self, items: Sequence[Any]) -> dict[int, Any]:
        """What this process found, by the index of the item."""
        found, per_turn = {}, _per_turn(items)
        while (start := int.from_bytes(os.read(self._turns, TURN), "little")) != NO_MORE:
            for i in range(start, min(start + per_turn, len(items))):
                found[i] = self._function(items[i])
        return found


def _per_turn(items: Sequence[Any]) -> int:
    return -(-len(items) // MOST_TURNS)


class _Helper:
    """A forked process that answers what it is asked; without helpers of its own, unless in the background."""

    is_this_process = False
    ending: ClassVar[list[int]] = []  # helpers that were ended: it takes a hundredth of a second to clear one's memory

    def __init__(self, work: Callable[[Any], Any], background: bool = False) -> None:
        self._here, there = Pipe()
        with warnings.catch_warnings():
            # no lock of another thread is ever asked for by a helper: it computes, writes to its pipe and ends
            warnings.filterwarnings("ignore", message=".*multi-threaded.*", category=DeprecationWarning)
            self._pid = os.fork()
        if self._pid == 0:
            _help(work, there, background)
        there.close()

    def ask(self, asked: Any) -> None:
        with suppress(BrokenPipeError):  # of one that was killed: it is missed when its answer is
            self._here.send_bytes(_sent(asked))

    def found(self) -> Any:
        """Its answer; what it failed by is raised here."""
        try:
            found = _received(self._here.recv_bytes())
        except (EOFError, ConnectionResetError):
            text = "a process of the diagnosis was killed; is there memory for so many? Try one worker alone"
            raise ChildProcessError(text) from None
        if isinstance(found, BaseException):
            raise found
        return found

    def end(self) -> None:
        """Nothing is left of it, whatever it was at."""
        self._here.close()
        with suppress(ProcessLookupError):
            os.kill(self._pid, signal.SIGKILL)
        _Helper.ending = [pid for pid in (*_Helper.ending, self._pid) if not _is_gone(pid)]


def _is_gone(pid: int) -> bool:
    """Whether nothing is left of an ended helper; not waited for."""
    try:
        return os.waitpid(pid, os.WNOHANG)[0] == pid
    except ChildProcessError:  # none of this process's
        return True


def _help(work: Callable[[Any], Any], there: Connection, background: bool) -> NoReturn:
    """The life of a helper; it ends here, without what a process does at its end for those that it was forked from."""
    try:
        _Helper.is_this_process = not background
        _spare[True].clear()  # it is there for one process to give to others
        os.nice(LEFT_OVER if background else 0)
        CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # it outlives nobody whom it works for
        while True:
            asked = _received(there.recv_bytes())
            try:
                answer = _sent(work(asked))
            except Exception as error:
                error.add_note("".join(traceback.format_tb(error.__traceback__)))
                answer = _sent(error)
            there.send_bytes(answer)
    finally:
        os._exit(0)


def _sent(found: Any) -> bytes:
    out = BytesIO()
    _Sender(out, pickle.HIGHEST_PROTOCOL).dump(found)
    return out.getvalue()


def _received(sent: bytes) -> Any:
    return _Receiver(BytesIO(sent)).load()


class _Sender(pickle.Pickler):
    """Kinds of effects are sent as the one that is here: they hold functions, and a search asks which one it is."""

    def persistent_id(self, thing: Any) -> int | None:
        return id(thing) if isinstance(thing, Kind) else None


class _Receiver(pickle.Unpickler):
    def persistent_load(self, key: int) -> Kind:
        return Kind.known[key]
