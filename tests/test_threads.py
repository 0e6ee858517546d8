"""The library keeps linear algebra to one thread while it works, and gives back what it found."""

import os
import sys
import time
from threading import Barrier

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import workbench as wb
from workbench.gap.prediction.workers import Workers
from workbench.threads import at_once, is_piece, one_blas_thread


def threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.fixture
def two():
    with threadpool_limits(2, user_api="blas"):
        if threads() != {2}:
            pytest.skip("this BLAS has no threads to limit")
        yield


def test_one_inside_and_as_before_outside(two):
    assert one_blas_thread(threads)() == {1}
    assert threads() == {2}


def test_an_error_gives_them_back_too(two):
    with pytest.raises(ZeroDivisionError):
        one_blas_thread(lambda: 1 / 0)()
    assert threads() == {2}


def test_one_inside_another(two):
    outer = one_blas_thread(lambda: (one_blas_thread(threads)(), threads()))
    assert outer() == ({1}, {1})
    assert threads() == {2}


def test_a_structure_is_solved_by_one(two, monkeypatch):
    from workbench.structure import member

    seen = []
    monkeypatch.setattr(member, "eigh", lambda *a, _eigh=member.eigh, **k: seen.append(threads()) or _eigh(*a, **k))
    beam = wb.Beam(length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
    np.testing.assert_allclose(beam.modes(3).omega, (np.pi * np.arange(1, 4)) ** 2, rtol=1e-9)
    assert seen and all(each == {1} for each in seen)


def test_pieces_run_at_once_where_linear_algebra_has_one_thread(monkeypatch):
    """Each piece waits for the other; pieces of a piece, short ones and those outside run one after the other."""
    monkeypatch.setattr("workbench.threads.cores", lambda: 2)
    both = Barrier(2, timeout=10.0)

    def piece(i: int) -> list[int]:
        assert is_piece()
        both.wait()
        return at_once(lambda k: 10 * i + k, range(3))

    assert one_blas_thread(at_once)(piece, range(2)) == [[0, 1, 2], [10, 11, 12]]
    alone = [(0, False), (1, False)]
    assert at_once(lambda i: (i, is_piece()), range(2)) == alone
    assert one_blas_thread(at_once)(lambda i: (i, is_piece()), range(2), long=False) == alone


def test_an_error_of_a_piece_is_raised(monkeypatch):
    monkeypatch.setattr("workbench.threads.cores", lambda: 2)
    with pytest.raises(ZeroDivisionError):
        one_blas_thread(at_once)(lambda i: 1 // i, [1, 0, 2])


@pytest.mark.skipif(sys.platform != "linux", reason="a diagnosis forks on Linux alone, where /proc counts threads")
def test_a_forked_process_starts_no_threads_that_nobody_asks_for(two):
    beam = wb.Beam(length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
    beam.modes(3)

    def solved(_: int) -> tuple[int, int]:
        time.sleep(0.02)  # so that both processes take some
        beam.modes(3)
        return os.getpid(), len(os.listdir("/proc/self/task"))

    found = dict(one_blas_thread(Workers(2).map)(solved, range(8)))
    found.pop(os.getpid(), None)
    assert list(found.values()) == [1]
