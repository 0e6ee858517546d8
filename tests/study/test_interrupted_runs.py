"""Runs that are killed: nothing lost, nothing twice, and the table of an undisturbed run bit for bit."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from workbench import study
from workbench.study.runs.cases import StudyError
from workbench.study.runs.versions import PACKAGE, own_source

SCRIPT = """
import os, sys, time
from pathlib import Path
import numpy as np
from workbench import study

def function(at, pause, seed):
    time.sleep(pause)
    with open(os.environ["LOG"], "a") as file:
        file.write(f"{at}\\n")
    a = np.random.default_rng(seed).normal(size=(20, 20))
    return {"det": np.linalg.det(a), "values": np.sort(np.linalg.eigvals(a).real), "third": at / 3}

if __name__ == "__main__":
    cache, table, n, pause = sys.argv[1:]
    cases = study.grid(at=range(int(n)), pause=[float(pause)])
    print("ready", flush=True)
    found = study.run(cases, function, cache=cache, workers=2)
    rows = [{k: v for k, v in row.items() if k not in ("seconds",)} for row in found.rows()]
    np.set_printoptions(floatmode="unique")
    Path(table).write_text("\\n".join(map(repr, rows)))
"""


def start(tmp_path, name, n, pause):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    command = [sys.executable, *map(str, (script, tmp_path / name, tmp_path / f"{name}.txt", n, pause))]
    around = {**os.environ, "LOG": str(tmp_path / f"{name}.log"), "PYTHONPATH": str(tmp_path / "frozen")}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True, env=around)
    assert process.stdout.readline() == "ready\n"
    return process


def kept(folder) -> list[Path]:
    return list(folder.rglob("*.json")) if folder.is_dir() else []


@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, 10])
def test_a_run_killed_at_random_moments_ends_in_the_same_table(tmp_path, kills):
    n, pause, moments = 10 + 25 * kills, 0.04, random.Random(kills)
    # an edit while this runs would rightly make it another workbench
    shutil.copytree(PACKAGE, tmp_path / "frozen/workbench", ignore=shutil.ignore_patterns("__pycache__"))
    assert start(tmp_path, "calm", n, pause).wait() == 0
    for kill in range(kills):
        process = start(tmp_path, "killed", n, pause)
        until = len(kept(tmp_path / "killed")) + 1 + moments.randrange(n // kills // 2)
        while len(kept(tmp_path / "killed")) < until:
            assert process.poll() is None, f"it ended before kill {kill}"
            time.sleep(0.002)
        time.sleep(moments.uniform(0.0, pause))
        os.killpg(process.pid, signal.SIGKILL)  # the run and its workers, in the middle of what they do
        process.wait()
    assert 0 < len(kept(tmp_path / "killed")) < n
    assert start(tmp_path, "killed", n, pause).wait() == 0
    assert (tmp_path / "killed.txt").read_bytes() == (tmp_path / "calm.txt").read_bytes()
    called = Counter((tmp_path / "killed.log").read_text().split())
    assert len(called) == n and sum(called.values()) <= n + 2 * kills, "only what was running is worked again"


class Cluster:
    """A Dask scheduler and two workers, each its own process on the loopback interface."""

    def __init__(self, folder):
        self.address_file = folder / "scheduler.json"
        self.processes = [self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")]
        workers = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1")
        self.workers = [self._start("worker", *workers) for _ in range(2)]
        self.processes += self.workers

    def _start(self, what, *options):
        command = [sys.executable, "-m", "dask", what, "--scheduler-file", str(self.address_file), *options]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def address(self) -> str:
        distributed = pytest.importorskip("distributed")
        with distributed.Client(scheduler_file=str(self.address_file), timeout=30, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=30)
            return client.scheduler.address

    def stop(self):
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def dask_cluster(tmp_path):
    pytest.importorskip("distributed", reason="a cluster needs the extra `cluster`")
    own_source.cache_clear()  # the workers read the source now
    cluster = Cluster(tmp_path)
    yield cluster
    cluster.stop()


def slow_case(at, log, seed):
    time.sleep(0.02)
    with open(log, "a") as file:
        file.write(f"{at} {os.getpid()}\n")
    if at == 3:
        raise ValueError("three")
    return {"at_third": at / 3, "seed_half": seed / 2}


@pytest.mark.slow
def test_a_cluster_loses_a_worker_and_no_case(tmp_path, dask_cluster):
    address, log, n = dask_cluster.address(), tmp_path / "log", 60
    cases = study.grid(at=range(n), log=[str(log)])

    def kill_one(text, share):
        if share > 0.3 and dask_cluster.workers[0].poll() is None:
            dask_cluster.workers[0].send_signal(signal.SIGKILL)
            dask_cluster.workers[0].wait()

    found = study.run(cases, slow_case, cache=tmp_path / "c", scheduler=address, report=kill_one)
    assert dask_cluster.workers[0].poll() == -signal.SIGKILL
    assert {r.error for r in found} <= {None, "ValueError: three"}
    assert [r["at_third"] for r in found if r.error is None] == [at / 3 for at in range(n) if at != 3]
    assert [r.error for r in found.failed] == ["ValueError: three"]
    lines = [line.split() for line in log.read_text().splitlines()]
    assert {int(at) for at, _ in lines} == set(range(n))
    by_worker = Counter(pid for _, pid in lines)
    assert len(by_worker) == 2 and min(by_worker.values()) > 5, "both workers worked"
    assert len(kept(tmp_path / "c")) == n - 1
    # what a cluster has done is done: this process finds it, and works the failed one only
    before = len(lines)
    here = study.run(cases, slow_case, cache=tmp_path / "c", workers=1)
    assert len(log.read_text().splitlines()) == before + 1
    strip = lambda rows: [{k: v for k, v in row.items() if k != "seconds"} for row in rows]  # noqa: E731
    assert strip(here.rows()) == strip(found.rows())


def test_a_worker_with_another_workbench_is_refused():
    from workbench.study.runs.engines import _gathered

    class Finished:
        def result(self):
            return {"result": {"W_R": 1.0}, "error": None, "trace": None, "seconds": 0.1, "workbench": "another"}

    with pytest.raises(StudyError, match=r"a worker of the cluster runs another modal-workbench \(another, here"):
        _gathered(Finished())


def test_a_scheduler_that_is_not_there_is_said_to_be_so(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("workbench.study.runs.engines.CONNECT_SECONDS", 0.5)
    with pytest.raises(StudyError, match=r"no Dask scheduler answers at tcp://127.0.0.1:1 "):
        study.run([{"at": 1, "log": "x"}], slow_case, cache=None, scheduler="tcp://127.0.0.1:1")
