"""Cores at hand, pieces of work on them, and one BLAS thread: two that wait for each other cost more than they give.

With a second process on the machine, OpenBLAS's threads spin for one another: selecting the number of modes of a record
took 76 s of processor time with two threads and 7 s with one, 154 s and 10 s by the clock.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import wraps
from threading import Lock, local
from typing import ParamSpec, TypeVar

import scipy.linalg  # noqa: F401  loads the BLAS of scipy, so that it is found beside that of numpy
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")
Item = TypeVar("Item")

_WITHIN = local()  # in a thread of `at_once`

# Looked for once, and early: while libraries are looked for, another thread that imports one may block both.
_LIBRARIES = ThreadpoolController()


def cores() -> int:
    """Cores that this process may use: fewer than the machine has in a container, a job of a cluster or by affinity.

    `LOKY_MAX_CPU_COUNT` in the environment makes them fewer still.
    """
    from joblib import cpu_count

    return int(cpu_count())


def at_once(function: Callable[[Item], R], items: Iterable[Item], *, long: bool = True) -> list[R]:
    """`function(item)` of each item, in their order, on all cores, where the function releases Python's lock.

    One after the other outside `one_blas_thread`, within such a function, and unless each is `long`: well over the
    0.1 ms that it takes to start a thread on it.
    """
    at_hand = list(items)
    pool = None if not long or len(at_hand) < 2 or is_piece() else _LIMIT.pool()
    return [function(item) for item in at_hand] if pool is None else list(pool.map(function, at_hand))


def is_piece() -> bool:
    """Whether this thread runs a function of `at_once`."""
    return getattr(_WITHIN, "any", False)


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """The function, run with one thread of linear algebra, and with as many as before once it returns or raises."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _LIMIT.held():
            return function(*args, **kwargs)

    return limited


class _Limit:
    """One thread as long as any function asks for it, and the threads of `at_once`, which end with it.

    Only the first asks OpenBLAS: in a process that was forked, and in the one that it was forked from, that starts its
    threads anew, and each spins for 30 ms before it sleeps.
    """

    def __init__(self) -> None:
        self._lock, self._holders = Lock(), 0
        self._end: Callable[[], None] = lambda: None
        self._pool: ThreadPoolExecutor | None = None
        if hasattr(os, "register_at_fork"):  # a lock that another thread holds would never open in the forked process
            release = self._lock.release
            os.register_at_fork(before=self._lock.acquire, after_in_parent=release, after_in_child=self._after_fork)

    def _after_fork(self) -> None:
        self._pool = None  # its threads are those of the other process
        self._lock.release()

    def pool(self) -> ThreadPoolExecutor | None:
        """As many threads as cores, while any function holds the limit; None for a single core."""
        with self._lock:
            if self._pool is None and self._holders and cores() > 1:
                self._pool = ThreadPoolExecutor(cores(), initializer=setattr, initargs=(_WITHIN, "any", True))
            return self._pool

    @contextmanager
    def held(self) -> Iterator[None]:
        with self._lock:
            if self._holders == 0:
                self._end = _LIBRARIES.limit(limits=1, user_api="blas").restore_original_limits
            self._holders += 1
        try:
            yield
        finally:
            with self._lock:
                self._holders -= 1
                if self._holders == 0:
                    self._end()
                    if self._pool is not None:
                        self._pool.shutdown(wait=False)
                        self._pool = None


_LIMIT = _Limit()
