"""Readers of foreign formats, each run in a separate process with limits of time and memory.

A compiled reader can crash, hang or exhaust the memory on malformed bytes, which the same process cannot catch. The
arrays are returned in a file, as an NPZ without pickles, so that no code from the file can run here.
"""

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from workbench.records.limits import DEFAULT, ReadLimits, RecordFileError, check_counts, unreadable

NAMES = "names"
REFUSED, NO_MEMORY = 3, 4
LONGEST_REFUSAL = 10_000  # bytes
ELAPSED_RATIO = 5.0  # limit of elapsed time over that of processor time, for a busy machine
OVERHEAD = 2**29  # bytes of address space of the interpreter and its libraries
# -P keeps the working folder out of the path, so that a file called numpy.py there is not run
CHILD = (
    "import sys; sys.path.append(sys.argv[1]); from workbench.records import confined; confined.serve(*sys.argv[2:])"
)
ROOT = str(Path(__file__).resolve().parents[2])


def load_confined(module: str, path: Path, limits: ReadLimits = DEFAULT) -> dict[str, np.ndarray]:
    """The arrays that `load(path, limits)` of a module reads from a file, by name, in order.

    A reader that refuses the file, crashes on it, takes too long or too much memory is a `RecordFileError`.
    """
    seconds = limits.seconds
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # each reserves address space
    with tempfile.TemporaryFile() as found:
        try:
            ended = subprocess.run(
                [sys.executable, "-P", "-c", CHILD, ROOT, module, str(path), str(limits.memory), str(seconds)],
                stdin=subprocess.DEVNULL,
                stdout=found,
                stderr=subprocess.PIPE,
                timeout=ELAPSED_RATIO * seconds,
                env=os.environ | threads,
            )
        except subprocess.TimeoutExpired:
            raise RecordFileError(
                f"{path} is damaged or too large: reading it did not end within {ELAPSED_RATIO * seconds:.0f} s"
            ) from None
        found.seek(0)
        if ended.returncode == 0:
            with np.load(found, allow_pickle=False) as archive:
                return {name: archive[f"array_{i}"] for i, name in enumerate(json.loads(str(archive[NAMES])))}
        if ended.returncode == REFUSED:
            raise RecordFileError(found.read(LONGEST_REFUSAL).decode(errors="replace"))
    if ended.returncode == NO_MEMORY:
        raise RecordFileError(
            f"{path} is damaged or too large: it needs more than {limits.memory / 2**30:g} GiB to read; cut the record,"
            " take fewer channels, or allow more memory"
        )
    if ended.returncode < 0:
        name = signal.Signals(-ended.returncode).name
        if name == "SIGXCPU":
            raise RecordFileError(
                f"{path} is damaged or too large: reading it did not end within {seconds:.0f} s; cut the record, or"
                " write it as HDF5 or NPZ"
            )
        raise RecordFileError(f"{path} is damaged: its reader crashed on it ({name})")
    said = ended.stderr.decode(errors="replace").strip().splitlines() or ["it says nothing"]
    raise RecordFileError(f"{path} cannot be read: the process that reads it failed: {said[-1]}")


def serve(module: str, name: str, memory: str, seconds: str) -> None:
    """Read in this process, write the arrays, or the reason of a failure, to its output, and exit."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # some readers print
    limits, path = ReadLimits(float(memory), float(seconds)), Path(name)
    _confine(limits)
    try:
        arrays = {key: np.asarray(values) for key, values in import_module(module).load(path, limits).items()}
        arrays = {key: values for key, values in arrays.items() if values.dtype.kind in "fiubcU"}
        check_counts(path, len(arrays), sum(values.size for values in arrays.values()), limits)
        sent: dict[str, Any] = {f"array_{i}": values for i, values in enumerate(arrays.values())}
        np.savez(out, **(sent | {NAMES: np.array(json.dumps([*arrays]))}))
        code = 0
    except MemoryError:
        code = NO_MEMORY
    except Exception as error:  # readers raise exceptions of many kinds
        refusal = error if isinstance(error, RecordFileError) else unreadable(path, error)
        out.write(str(refusal).encode(errors="replace"))
        code = REFUSED
    out.close()
    os._exit(code)  # without the clean-up of libraries, which a damaged file may have corrupted


def _confine(limits: ReadLimits) -> None:
    try:
        import resource
    except ImportError:  # Windows has no such limits; the limit of elapsed time applies there too
        return
    # includes the start of this process and leaves a second for the parent; a short limit applies to the file alone
    used = max(math.floor(limits.seconds) - 1, math.ceil(time.process_time()) + 1)
    memory = int(limits.memory) + OVERHEAD
    for limit, value in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CORE, 0), (resource.RLIMIT_CPU, used)):
        hard = resource.getrlimit(limit)[1]
        resource.setrlimit(limit, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
