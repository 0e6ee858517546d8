"""Work shared with forked processes: all of it done, once, and nothing of a process left behind."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from workbench.gap.effects.catalogue import CATALOGUE
from workbench.gap.effects.effect import Effect
from workbench.gap.prediction import workers as module
from workbench.gap.prediction.workers import BACKGROUND_NICENESS, CAN_FORK, MAX_TURNS, Workers

TWO = Workers(2)
forked = pytest.mark.skipif(not CAN_FORK, reason="processes are forked on Linux only")


@pytest.fixture
def pids(monkeypatch):
    """The processes that are forked."""
    found, fork = [], os.fork

    def recorded():
        found.append(fork())
        return found[-1]

    monkeypatch.setattr(os, "fork", recorded)
    return found


@pytest.fixture
def helpers(pids):
    """The processes that were forked; at the end none runs on, and none but the last is left for the system to keep."""
    yield pids
    assert pids
    assert eventually(lambda: not any(state_of(pid) not in ("Z", "") for pid in pids))
    TWO.map(abs, range(2))
    assert not any(state_of(pid) for pid in pids[:-1])


def state_of(pid):
    """The state of a process as the system has it: Z of one that has ended and was not asked how, empty of none."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return ""


def eventually(happens, seconds=5.0):
    deadline = time.monotonic() + seconds
    while not (happened := happens()) and time.monotonic() < deadline:
        time.sleep(0.01)
    return happened


@pytest.mark.parametrize("number", [1, 2, 3])
def test_what_is_found_comes_in_the_order_of_the_items(number):
    def late(i):
        time.sleep(0.01 if i % 7 == 0 else 0.0)
        return i, i**2

    assert Workers(number).map(late, range(40)) == [(i, i**2) for i in range(40)]
    assert Workers(number).map(late, []) == []


@pytest.mark.parametrize("number", [1, 2])
def test_what_is_computed_in_the_background_is_computed_once_beside_work_that_is_shared(number):
    workers = Workers(number)
    with (
        workers.in_background(os.getpid) as one,
        workers.in_background(lambda: workers.map(lambda i: i**2, range(5))) as other,
    ):
        assert workers.map(lambda i: i + 1, range(5)) == [1, 2, 3, 4, 5]
        assert other() == other() == [0, 1, 4, 9, 16]
        assert (one() == os.getpid()) == (number == 1 or not CAN_FORK)


@forked
def test_work_in_the_background_gives_way_to_others_and_its_failure_is_raised_where_it_is_asked_for(helpers):
    def fails():
        raise ValueError(f"niceness {os.nice(0)}")

    nicest = min(os.nice(0) + BACKGROUND_NICENESS, 19)  # 19 is the most there is
    with TWO.in_background(fails) as asked, pytest.raises(ValueError, match=rf"niceness {nicest}\b"):
        asked()


@forked
def test_work_in_the_background_is_shared_further_and_given_up_with_all_who_share_it(helpers):
    source, sink = os.pipe()

    def stays(i):
        os.write(sink, os.getpid().to_bytes(4, "little"))
        time.sleep(60)

    with TWO.in_background(lambda: TWO.map(stays, range(2))):
        pids = {int.from_bytes(os.read(source, 4), "little") for _ in range(2)}
    assert len(pids) == 2 and os.getpid() not in pids
    deadline = time.perf_counter() + 10
    while any(_runs(pid) for pid in pids) and time.perf_counter() < deadline:
        time.sleep(0.01)
    assert not any(_runs(pid) for pid in pids)


def _runs(pid: int) -> bool:
    """Whether a process is there, and not only as one that nobody asked how it ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@forked
def test_nobody_waits_for_work_in_the_background_that_is_not_asked_for(helpers):
    begun = time.perf_counter()
    with pytest.raises(KeyboardInterrupt), TWO.in_background(lambda: time.sleep(60)):
        raise KeyboardInterrupt
    assert time.perf_counter() - begun < 30


@pytest.mark.parametrize("n", [MAX_TURNS - 1, MAX_TURNS, 2 * MAX_TURNS + 1])
def test_more_items_than_a_pipe_holds_are_all_done_once(n):
    assert TWO.map(lambda i: i, range(n)) == list(range(n))


@forked
def test_every_process_works_and_whoever_is_free_takes_the_next_item(helpers):
    def slow_at_first(i):
        time.sleep(0.4 if i == 0 else 0.02)
        return os.getpid()

    at = TWO.map(slow_at_first, range(10))
    assert set(at) == {os.getpid(), *helpers} and at.count(at[0]) < 5


@forked
def test_a_failure_is_raised_here_and_says_where_it_was(helpers):
    here = os.getpid()

    def fails(i):
        time.sleep(0.05)
        if os.getpid() != here:
            raise ValueError(f"no rig {i}")
        return i

    with pytest.raises(ValueError, match="no rig") as caught:
        TWO.map(fails, range(4))
    assert "in fails" in caught.value.__notes__[0]


@forked
def test_a_process_that_is_killed_is_missed(helpers):
    here = os.getpid()

    def killed(i):
        time.sleep(0.05)
        if os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        return i

    with pytest.raises(ChildProcessError, match="try workers=1"):
        TWO.map(killed, range(4))


@forked
def test_nobody_waits_for_the_others_after_a_failure(helpers):
    here = os.getpid()

    def interrupted(i):
        if os.getpid() == here:
            raise KeyboardInterrupt
        time.sleep(60)

    begun = time.perf_counter()
    with pytest.raises(KeyboardInterrupt):
        TWO.map(interrupted, range(2))
    assert time.perf_counter() - begun < 30


@forked
def test_a_helper_has_no_helpers(helpers):
    def shared_further(i):
        time.sleep(0.05)
        return os.getpid(), set(TWO.map(lambda _: os.getpid(), range(3)))

    for pid, beside in TWO.map(shared_further, range(2)):
        assert pid in helpers and beside == {pid} if pid != os.getpid() else beside <= {pid, *helpers}


def test_a_kind_of_effect_comes_back_as_itself():
    effects = [Effect(kind, None, {"at": float(i)}) for i, kind in enumerate(CATALOGUE)]
    found = TWO.map(lambda effect: (time.sleep(0.005), effect)[1], effects)
    assert all(one.kind is other.kind and one.values == other.values for one, other in zip(effects, found, strict=True))


def test_what_processes_write_into_a_shared_array_is_read_here():
    rows = TWO.array(20, 3)

    def write(i):
        time.sleep(0.005)
        rows[i] = i

    TWO.map(write, range(20))
    assert np.array_equal(rows, np.outer(np.arange(20), np.ones(3)))
    assert TWO.array(0, 3).shape == (0, 3)


@pytest.mark.parametrize("workers", [Workers(1), TWO])
def test_room_that_is_given_back_is_taken_again_and_only_once(workers):
    one, other = workers.array(20, 3), workers.array(20, 3)
    workers.give_back(one)
    again, fresh = workers.array(30), workers.array(20, 3)
    assert np.shares_memory(one, again)
    assert not any(np.shares_memory(again, array) for array in (other, fresh))


@forked
def test_room_given_back_in_one_process_is_never_shared_with_others():
    TWO.give_back(TWO.array(20, 3))  # what helpers take for themselves must not be this

    def own(i):
        mine = Workers(1).array(20, 3)
        mine[:] = i
        time.sleep(0.02)
        return float(mine.min()), float(mine.max())

    assert TWO.map(own, range(8)) == [(i, i) for i in range(8)]


@forked
def test_processes_that_stand_by_are_forked_once_and_as_many_as_there_is_work_for(helpers):
    offset = 0

    def late(i):
        time.sleep(0.02)
        return os.getpid(), i + offset

    with Workers(3).pool(late) as share:
        assert share([]) == [] and share([1]) == [(os.getpid(), 1)] and not helpers
        assert [i for _, i in share(range(2))] == [0, 1] and len(helpers) == 1
        offset = 10  # which only this process knows of
        for _ in range(3):
            found = share(range(8))
            assert {pid for pid, _ in found} == {os.getpid(), *helpers} and len(helpers) == 2
            assert all(i == n + (10 if pid in (os.getpid(), helpers[1]) else 0) for n, (pid, i) in enumerate(found))


@pytest.mark.parametrize("number", [1, 2])
def test_a_failure_of_processes_that_stand_by_is_raised_whoever_fails(number, monkeypatch):
    def fails(i):
        time.sleep(0.01)
        if i == 7:
            raise ValueError("no rig 7")
        return i

    for forks in (CAN_FORK, False):
        monkeypatch.setattr(module, "CAN_FORK", forks)
        with Workers(number).pool(fails) as share:
            assert share(range(5)) == list(range(5))
            with pytest.raises(ValueError, match="no rig 7"):
                share(range(9))


def test_where_nothing_is_forked_threads_do_it(monkeypatch):
    monkeypatch.setattr(module, "CAN_FORK", False)
    assert TWO.map(lambda i: (os.getpid(), i), range(5)) == [(os.getpid(), i) for i in range(5)]


def test_a_process_is_one_at_least():
    assert 1 <= Workers.at_hand().number <= module.MAX_PROCESSES
    with pytest.raises(ValueError, match="1 or more; got 0"):
        Workers(0)


@dataclass
class Found:
    """What a search may find: a record of numbers and arrays."""

    cost: float
    residual: np.ndarray


def test_arrays_come_back_bit_by_bit():
    found = TWO.map(lambda seed: Found(1.0 / seed, np.random.default_rng(seed).normal(size=20_000)), range(1, 6))
    for seed, one in enumerate(found, 1):
        assert one.cost == 1.0 / seed
        assert np.array_equal(one.residual, np.random.default_rng(seed).normal(size=20_000))


@forked
def test_nothing_is_left_after_work_in_the_background(pids):
    with TWO.in_background(os.getpid) as found:
        TWO.give_back(TWO.array(100))
        assert TWO.map(abs, range(4)) == [0, 1, 2, 3]
        assert found() in pids
    assert len(pids) == 2 and not any(state_of(pid) for pid in pids)
    assert not any(module._spare.values())
