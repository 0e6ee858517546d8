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

    def compiled_anew(_=None):
        begun = process_time()
        njit(lambda x: x + 1.0)(1.0)
        return process_time() - begun

    compiled_anew()  # the compiler itself is loaded
    seconds = 0.5 * compiled_anew()
    deadline = Deadline(seconds)
    assert compiled_anew() > seconds and not deadline.is_past
    assert Workers(2).map(lambda _: (compiled_anew() > seconds, deadline.is_past), range(2)) == [(True, False)] * 2
    busy(1.1 * seconds)
    assert deadline.is_past


def test_no_time_at_all_is_refused():
    with pytest.raises(ValueError, match="seconds must be positive; got 0"):
        Deadline(0.0)
