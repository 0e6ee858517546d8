"""Readers of other people's formats, each run in a process of its own, within limits of time and memory.

A compiled reader can crash, hang or ask for all memory on bytes that no program wrote, and nothing inside the same
process can catch that. The arrays come back as an NPZ without pickles, so nothing that is sent can run here.
"""

import io
import json
import math
import os
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from workbench.records.file_error import RecordFileError, unreadable
from workbench.records.limits import MOST_MEMORY, check_arrays

NAMES = "names"
REFUSED, NO_MEMORY = 3, 4
LEAST_SECONDS = 8.0  # of processor time, so that a busy machine damages no file
PATIENCE = 5.0  # as many times as long by the clock
BYTES_PER_SECOND = 2e6  # of the slowest format, numbers as text
# -P keeps the working folder out of the path: a file there called numpy.py must not run
CHILD = (
    "import sys; sys.path.append(sys.argv[1]); from workbench.records import confined; confined.serve(*sys.argv[2:])"
)
ROOT = str(Path(__file__).resolve().parents[2])


def load_confined(module: str, path: Path) -> dict[str, np.ndarray]:
    """The arrays that `load(path)` of a module finds in a file, by name and in its order.

    Raises:
        RecordFileError: the reader refused the file, crashed on it, took too long, or needed too much memory.
    """
    seconds = LEAST_SECONDS + path.stat().st_size / BYTES_PER_SECOND
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # each reserves address space
    try:
        ended = subprocess.run(
            [sys.executable, "-P", "-c", CHILD, ROOT, module, str(path), str(seconds)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=PATIENCE * seconds,
            env=os.environ | threads,
        )
    except subprocess.TimeoutExpired:
        raise RecordFileError(
            f"{path} is damaged: its reader came to no end within {PATIENCE * seconds:.0f} s"
        ) from None
    if ended.returncode == 0:
        with np.load(io.BytesIO(ended.stdout), allow_pickle=False) as archive:
            return {name: archive[f"array_{i}"] for i, name in enumerate(json.loads(str(archive[NAMES])))}
    if ended.returncode == REFUSED:
        raise RecordFileError(ended.stdout.decode(errors="replace"))
    if ended.returncode == NO_MEMORY:
        raise RecordFileError(f"{path} is damaged or too large: it needs more than {MOST_MEMORY / 2**30:g} GiB to read")
    if ended.returncode < 0:
        name = signal.Signals(-ended.returncode).name
        if name == "SIGXCPU":
            raise RecordFileError(f"{path} is damaged: its reader came to no end within {seconds:.0f} s")
        raise RecordFileError(f"{path} is damaged: its reader crashed on it ({name})")
    said = ended.stderr.decode(errors="replace").strip().splitlines() or ["it says nothing"]
    raise RecordFileError(f"{path} cannot be read: the process that reads it failed: {said[-1]}")


def serve(module: str, name: str, seconds: str) -> None:
    """Read in this process, write the arrays, or why there are none, to its output, and end it."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # some readers print
    _confine(float(seconds))
    path = Path(name)
    try:
        arrays = {key: np.asarray(values) for key, values in import_module(module).load(path).items()}
        arrays = {key: values for key, values in arrays.items() if values.dtype.kind in "fiubcU"}
        check_arrays(path, arrays.values())
        sent: dict[str, Any] = {f"array_{i}": values for i, values in enumerate(arrays.values())}
        np.savez(out, **(sent | {NAMES: np.array(json.dumps([*arrays]))}))
        code = 0
    except MemoryError:
        code = NO_MEMORY
    except Exception as error:  # every reader of another's file has its own ways to fail
        refusal = error if isinstance(error, RecordFileError) else unreadable(path, error)
        out.write(str(refusal).encode(errors="replace"))
        code = REFUSED
    out.close()
    os._exit(code)  # without the clean-up of libraries that a damaged file may have upset


def _confine(seconds: float) -> None:
    try:
        import resource
    except ImportError:  # Windows knows no such limits; the limit by the clock holds there too
        return
    used = math.ceil(time.process_time() + seconds)
    for limit, value in (
        (resource.RLIMIT_AS, MOST_MEMORY),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, used),
    ):
        hard = resource.getrlimit(limit)[1]
        resource.setrlimit(limit, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
