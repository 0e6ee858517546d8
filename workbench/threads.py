"""One BLAS thread where matrices are small: two that wait for each other cost more than they give.

With a second process on the machine, OpenBLAS's threads spin for one another: selecting the number of modes of a record
took 76 s of processor time with two threads and 7 s with one, 154 s and 10 s by the clock.
"""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import scipy.linalg  # noqa: F401  loads the BLAS of scipy, so that it is found beside that of numpy
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")

# Looked for once, and early: while libraries are looked for, another thread that imports one may block both.
_LIBRARIES = ThreadpoolController()


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """The function, run with one thread of linear algebra, and with as many as before once it returns or raises."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _LIBRARIES.limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
