"""Two runs at once on one cache: nothing lost, nothing twice; a run that is killed holds nobody up."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter

import pytest

from workbench import study
from workbench.study.runs.cache import held

SCRIPT = """
import os, sys, time
from workbench import study

def function(at, pause, log):
    with open(log, "a") as file:
        file.write(f"{at} {os.getppid()} {os.getpid()}\\n")
    time.sleep(pause)
    return {"third": at / 3}

if __name__ == "__main__":
    folder, n, pause, workers = sys.argv[1:]
    def told(text, share):
        with open(folder + "/told", "a") as file:
            file.write(text + "\\n")

    found = study.run(study.grid(at=range(int(n)), pause=[float(pause)], log=[folder + "/log"]), function,
        cache=folder + "/cache", workers=int(workers), report=told)
    print([row["third"] for row in found])
"""


def started(tmp_path, n, pause, workers):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    command = [sys.executable, *map(str, (script, tmp_path, n, pause, workers))]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)


@pytest.mark.parametrize(("n", "pause", "workers"), [(9, 0.2, 1), pytest.param(13, 0.2, 2, marks=pytest.mark.slow)])
def test_runs_at_once_share_their_cases(tmp_path, n, pause, workers):
    runs = [started(tmp_path, n, pause, workers) for _ in range(2)]
    assert [run.communicate()[0].strip() for run in runs] == [str([at / 3 for at in range(n)])] * 2
    lines = [line.split() for line in (tmp_path / "log").read_text().splitlines()]
    assert Counter(int(at) for at, *_ in lines) == Counter(range(n)), "each case once"
    assert not list((tmp_path / "cache").rglob("*.lock"))
    assert "waiting for " in (tmp_path / "told").read_text()


def test_a_run_that_is_killed_holds_nobody_up(tmp_path):
    first = started(tmp_path, 1, 60.0, 1)
    while not (tmp_path / "log").exists():
        time.sleep(0.01)
    second = started(tmp_path, 1, 60.0, 1)
    time.sleep(1.0)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    until = time.monotonic() + 30.0
    while len((tmp_path / "log").read_text().splitlines()) < 2 and time.monotonic() < until:
        time.sleep(0.01)
    os.killpg(second.pid, signal.SIGKILL)
    second.wait()
    assert len((tmp_path / "log").read_text().splitlines()) == 2, "the second run takes the case over"


def test_a_lock_is_not_inherited_and_is_gone_with_its_process(tmp_path):
    """A holder that forks and is killed leaves a child alive, which holds nothing."""
    path, ready = tmp_path / "a.json", tmp_path / "ready"
    code = (
        "import os, sys, time; from pathlib import Path; from workbench.study.runs.cache import held\n"
        "with held(Path(sys.argv[1]), True):\n"
        "    if os.fork() == 0: time.sleep(5)\n"
        "    else: Path(sys.argv[2]).touch(); time.sleep(60)\n"
    )
    holder = subprocess.Popen([sys.executable, "-c", code, path, ready], start_new_session=True)
    while not ready.exists():
        time.sleep(0.01)
    with held(path, wait=False) as ours:
        assert not ours
    holder.kill()
    holder.wait()
    with held(path, wait=False) as ours:
        assert ours
    os.killpg(holder.pid, signal.SIGKILL)


def third(at):
    return {"third": at / 3}


def test_a_folder_that_takes_no_lock_is_no_obstacle(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    with held(blocked / "a.json", wait=True) as ours:
        assert ours
    with pytest.warns(UserWarning, match="could not be written to"):
        assert study.run([{"at": 1}], third, cache=blocked, workers=1)[0]["third"] == 1 / 3
