"""A search ends when its processor time is spent, in forked processes too."""

from time import process_time

import pytest
from numba import njit

from workbench.deadline import NEVER, Deadline
from workbench.gap.prediction.workers import Workers


def busy(seconds):
    end = process_time() + seconds
    while process_time() < end:
        pass


def test_it_is_past_when_that_much_processor_time_is_spent():
    deadline = Deadline(0.2)
    busy(0.1)
    assert not deadline.is_past
    busy(0.15)
    assert deadline.is_past
    assert not NEVER.is_past


def test_a_forked_process_counts_on_from_the_fork():
    """Its own clock begins anew."""
    deadline = Deadline(0.2)
    busy(0.15)
    assert not deadline.is_past

    def later(_):
        busy(0.1)
        return deadline.is_past

    assert Workers(2).map(later, range(2)) == [True, True]


def test_what_compiling_takes_is_not_counted():
    """In a forked process, too, whose clock begins anew."""
    seconds = 0.3  # ten times what a fork takes

    def compiled_anew(_=None):
        begun = process_time()
        while process_time() - begun <= seconds:
            njit(lambda x: x + 1.0)(1.0)
        return deadline.is_past

    njit(lambda x: x + 1.0)(1.0)  # the compiler itself is loaded
    deadline = Deadline(seconds)
    assert not compiled_anew()
    assert Workers(2).map(compiled_anew, range(2)) == [False, False]
    busy(1.1 * seconds)
    assert deadline.is_past


def test_no_time_at_all_is_refused():
    with pytest.raises(ValueError, match="seconds must be positive; got 0"):
        Deadline(0.0)
