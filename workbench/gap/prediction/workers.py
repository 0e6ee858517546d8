"""Parallel work in forked processes, which share all data of this one and send back only their results."""

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

MAX_PROCESSES = 8  # each fork takes a hundredth of a second
CAN_FORK = sys.platform == "linux"  # elsewhere system libraries do not survive a fork, or there is none
PR_SET_PDEATHSIG = 1  # <linux/prctl.h>
BACKGROUND_NICENESS = 5
TURN_BYTES = 4  # of a number in the pipe that hands out the items
END_OF_TURNS = 2**32 - 1  # number that marks the end of the items
MAX_TURNS = 8192  # numbers in the pipe at once: it holds more

SPARE_ARRAYS = 2  # given back, that are kept
MAX_SIZE_RATIO = 4  # of the size of a kept array to that asked for

_spare: dict[bool, list[Floats]] = {True: [], False: []}  # arrays given back: shared with forked processes, or not

Item = TypeVar("Item")
Found = TypeVar("Found")


@dataclass(frozen=True)
class Workers:
    """A number of processes, this one included, that work in parallel.

    Threads would wait for the interpreter lock between compiled loops. Forked processes share the rig, the records and
    compiled code without a copy.
    """

    number: int = 1

    def __post_init__(self) -> None:
        if self.number < 1 or self.number != int(self.number):
            raise ValueError(f"workers is a number of processes, this one included: 1 or more; got {self.number}")

    @classmethod
    def at_hand(cls) -> "Workers":
        """One process a core, `MAX_PROCESSES` at most."""
        return cls(min(cores(), MAX_PROCESSES))

    def map(self, function: Callable[[Item], Found], items: Iterable[Item]) -> list[Found]:
        """`function(item)` of each item, in their order; a process that is free takes the next item.

        A forked process changes nothing in this one: a function returns its result, or writes it into an `array`.

        Raises:
            ChildProcessError: a process was killed, for lack of memory for instance.
        """
        at_hand = list(items)

        def of(i: int) -> Found:
            return function(at_hand[i])

        with self.pool(of) as share:
            return share(range(len(at_hand)))

    @contextmanager
    def pool(self, function: Callable[[Item], Found]) -> Iterator[Callable[[Sequence[Item]], list[Found]]]:
        """A pool of processes; yields `map` of the function, to be called repeatedly.

        The processes are forked at the first call and see later changes only through the items. A fork takes a
        hundredth of a second, and as long again for the memory that is written to after it.
        """
        if self._is_single:
            yield lambda items: [function(item) for item in items]
        elif not CAN_FORK:
            with ThreadPoolExecutor(self.number) as threads:
                yield lambda items: list(threads.map(function, items))
        else:
            processes = _Pool(function, self.number)
            try:
                yield processes.share
            finally:
                processes.end()

    def array(self, *shape: int) -> Floats:
        """An uninitialised array that forked processes write into for this one to read."""
        size, shared = int(np.prod(shape)), CAN_FORK and not self._is_single
        spare = _spare[shared]
        i = next((i for i, room in enumerate(spare) if size <= room.size <= MAX_SIZE_RATIO * size), None)
        if i is not None:
            room = spare.pop(i)
        elif shared:
            room = np.frombuffer(mmap(-1, max(8 * size, 8)), float, size)
        else:
            room = np.empty(size)
        return room[:size].reshape(shape)

    def give_back(self, array: Floats) -> None:
        """Keep the memory for the next `array`: the system takes a microsecond to clear each kilobyte of new memory."""
        if isinstance(array.base, np.ndarray):
            spare = _spare[CAN_FORK and not self._is_single]
            spare[:] = [array.base, *spare[: SPARE_ARRAYS - 1]]

    @property
    def at_once(self) -> int:
        """Number of processes available here: 1 in a forked process."""
        return 1 if self._is_single else self.number

    @property
    def _is_single(self) -> bool:
        return _Child.is_this_process or self.number < 2

    @contextmanager
    def in_background(self, function: Callable[[], Found]) -> Iterator[Callable[[], Found]]:
        """Compute `function()` in the background, at low priority; yields a function that returns the result.

        The background process may have processes of its own. Without forks, the result is computed when asked for. A
        result not asked for by the end of the block is discarded. The block ends all processes and frees their memory.
        """
        child = None if self._is_single or not CAN_FORK else _Child(lambda _: function(), background=True)
        try:
            if child is not None:
                child.ask(None)
            yield cache(function if child is None else child.found)
        finally:
            if child is not None:
                child.end()
            for pid in _Child.ending:
                with suppress(ChildProcessError):
                    os.waitpid(pid, 0)
            _Child.ending = []
            for spare in _spare.values():
                spare.clear()


ALONE = Workers(1)


class _Pool:
    """This process and its children, each of which takes the next item when it is free."""

    def __init__(self, function: Callable[[Any], Any], number: int) -> None:
        self._function, self._number = function, number
        self._children: list[_Child] = []
        self._turns, self._sink = os.pipe()  # holds the first index of each group of items not yet taken

    def share(self, items: Sequence[Any]) -> list[Any]:
        while len(self._children) < min(self._number, len(items)) - 1:
            self._children.append(_Child(self._compute_turns))
        if len(items) < 2:
            return [self._function(item) for item in items]
        for start in range(0, len(items), _per_turn(items)):
            self._put(start)
        for child in self._children:
            child.ask(items)
        for _ in range(len(self._children) + 1):
            self._put(END_OF_TURNS)
        found = self._compute_turns(items)
        for child in self._children:
            found.update(child.found())
        return [found[i] for i in range(len(items))]

    def end(self) -> None:
        os.close(self._turns)
        os.close(self._sink)
        for child in self._children:
            child.end()

    def _put(self, turn: int) -> None:
        os.write(self._sink, turn.to_bytes(TURN_BYTES, "little"))

    def _compute_turns(self, items: Sequence[Any]) -> dict[int, Any]:
        """The results of this process, by index of the item."""
        found, per_turn = {}, _per_turn(items)
        while (start := int.from_bytes(os.read(self._turns, TURN_BYTES), "little")) != END_OF_TURNS:
            for i in range(start, min(start + per_turn, len(items))):
                found[i] = self._function(items[i])
        return found


def _per_turn(items: Sequence[Any]) -> int:
    """Number of items that are taken at once."""
    return -(-len(items) // MAX_TURNS)


class _Child:
    """A forked process that computes what it is asked; it has no children of its own, unless in the background."""

    is_this_process = False
    ending: ClassVar[list[int]] = []  # ids of killed processes, whose memory takes a hundredth of a second to free

    def __init__(self, work: Callable[[Any], Any], background: bool = False) -> None:
        self._here, there = Pipe()
        with warnings.catch_warnings():
            # a child takes no lock of another thread: it computes, writes to its pipe and ends
            warnings.filterwarnings("ignore", message=".*multi-threaded.*", category=DeprecationWarning)
            self._pid = os.fork()
        if self._pid == 0:
            _serve(work, there, background)
        there.close()

    def ask(self, asked: Any) -> None:
        with suppress(BrokenPipeError):  # a killed process is noticed when its result is read
            self._here.send_bytes(_sent(asked))

    def found(self) -> Any:
        """The result; an exception of the process is raised here."""
        try:
            found = _received(self._here.recv_bytes())
        except (EOFError, ConnectionResetError):
            text = "a process of the diagnosis was killed, perhaps for lack of memory; try workers=1"
            raise ChildProcessError(text) from None
        if isinstance(found, BaseException):
            raise found
        return found

    def end(self) -> None:
        """Kill the process, whatever it is computing."""
        self._here.close()
        with suppress(ProcessLookupError):
            os.kill(self._pid, signal.SIGKILL)
        _Child.ending = [pid for pid in (*_Child.ending, self._pid) if not _is_gone(pid)]


def _is_gone(pid: int) -> bool:
    """Whether a killed process has ended; does not wait."""
    try:
        return os.waitpid(pid, os.WNOHANG)[0] == pid
    except ChildProcessError:  # not a child of this process
        return True


def _serve(work: Callable[[Any], Any], there: Connection, background: bool) -> NoReturn:
    """The loop of a child; it exits here, without the exit handlers that it inherited."""
    try:
        _Child.is_this_process = not background
        _spare[True].clear()  # shared memory belongs to the parent
        os.nice(BACKGROUND_NICENESS if background else 0)
        CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # the child dies with its parent
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
    """Sends a kind of effect by identity: it holds functions, and a search compares kinds by identity."""

    def persistent_id(self, thing: Any) -> int | None:
        return id(thing) if isinstance(thing, Kind) else None


class _Receiver(pickle.Unpickler):
    """Inverse of `_Sender`."""

    def persistent_load(self, key: int) -> Kind:
        return Kind.known[key]
