"""Long records in little memory, each read in a process of its own, whose peak the system tells."""

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

READ = """
import resource, sys
from workbench.records.files import read_record
read_record(sys.argv[2])
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
record = read_record(sys.argv[1])
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 / record.outputs.nbytes)
"""
RUN = """
import resource, subprocess, sys
subprocess.run([sys.executable, "-m", "workbench", *sys.argv[1:]], check=True, stdout=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024)
"""


def said(script, *arguments, cwd) -> float:
    command = [sys.executable, "-c", script, *map(str, arguments)]
    here = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    ended = subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=here)
    assert ended.returncode == 0, ended.stderr
    return float(ended.stdout)


def write(path, n):
    """A free decay of two modes in noise, and its instants."""
    time = np.arange(n) / 1000.0
    decays = [np.exp(-time / (n * life)) * np.cos(2.0 * np.pi * f * time) for f, life in ((20.0, 3e-4), (55.0, 2e-4))]
    signals = {"t": time, "a": np.sum(decays, axis=0) + 0.01 * np.random.default_rng(0).standard_normal(n)}
    if path.suffix == ".npz":
        np.savez(path, **signals)
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name, values in signals.items():
                file[name] = values
    else:
        np.savetxt(path, np.column_stack([*signals.values()]), "%.8g", ",", header="t,a", comments="")
    return path


def test_reading_takes_at_most_four_times_the_record(tmp_path):
    """Its instants, which take as much again, included."""
    long, short = write(tmp_path / "long.npz", 1_500_000), write(tmp_path / "short.npz", 3000)
    assert said(READ, long, short, cwd=tmp_path) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("command", ["look", "identify"])
@pytest.mark.parametrize("ending", [".npz", ".h5", ".csv"])
def test_fifteen_million_samples_in_a_gigabyte(tmp_path, command, ending):
    n = 15_000_000 if ending != ".csv" else 3_000_000  # as many numbers of a text as are read in the time allowed
    path = write(tmp_path / f"long{ending}", n)
    assert said(RUN, command, path, cwd=tmp_path) < 2**30
