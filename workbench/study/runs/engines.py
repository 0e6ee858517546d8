"""Computation of cases in this process, in processes of this machine, or on a Dask cluster."""

import functools
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import cloudpickle
from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import TerminatedWorkerError

from workbench.study.runs.cache import encoded, held, read_record, write_record
from workbench.study.runs.cases import RESERVED, StudyError
from workbench.study.runs.fingerprint import is_own
from workbench.study.runs.versions import own_source

if TYPE_CHECKING:
    from distributed import Future

DIED = "its process died: out of memory, killed, or crashed in compiled code"
CONNECT_SECONDS = 10.0
MOST_DEATHS = 2  # of all processes, one after another without a result


@dataclass(frozen=True)
class Job:
    """One case to be computed; the computing process writes the result to `file`, if one is given."""

    key: str
    arguments: Mapping[str, Any]
    file: Path | None = None


def work(function: Callable[..., Any], job: Job, running: Path | None = None) -> dict[str, Any]:
    """Compute one case; an error is stored in the record, not raised."""
    if running is not None:
        (running / job.key).touch()
    start = time.perf_counter()
    record: dict[str, Any] = {"result": None, "error": None, "trace": None, "workbench": own_source()}
    try:
        found = function(**job.arguments)
        found = found if isinstance(found, dict) else {"result": found}
        taken = (RESERVED | {"seed"}) & found.keys()
        if taken:
            raise TypeError(f"a result cannot be called {min(taken)!r}, a column of the results table; rename it")
        record["result"] = encoded(found)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        record["error"] = f"{type(error).__name__}: {error}"
        record["trace"] = traceback.format_exc()
    record["seconds"] = time.perf_counter() - start
    if job.file is not None:
        record["unwritten"] = keep(job.file, record)
    if running is not None:
        (running / job.key).unlink(missing_ok=True)
    return record


def once(function: Callable[..., Any], job: Job, running: Path | None = None, *, wait: bool) -> dict[str, Any] | None:
    """The record of a case, computed unless it exists; if another run computes it, wait, or return None."""
    if job.file is None:
        return work(function, job, running)
    with held(job.file, wait) as ours:
        return read_record(job.file) or work(function, job, running) if ours else None


def keep(file: Path, record: dict[str, Any]) -> str | None:
    """Write a result unless it is an error; the reason if writing fails, else None."""
    if record["error"] is not None:
        return None
    try:
        write_record(file, record)
    except OSError as error:  # on a full disk or in a read-only folder the results of this run are not lost
        return str(error)
    return None


def packed(function: Callable[..., Any]) -> bytes:
    """A function pickled for another process of this run, with the user's own modules that it needs."""
    own = [
        module
        for name, module in list(sys.modules.items())
        if name not in ("__main__", "__mp_main__")
        and getattr(module, "__file__", None)
        and getattr(module, "__name__", None) == name
        and is_own(module.__file__, name)
    ]
    for module in own:
        cloudpickle.register_pickle_by_value(module)
    try:
        return bytes(cloudpickle.dumps(function))
    finally:
        for module in own:
            cloudpickle.unregister_pickle_by_value(module)


@functools.lru_cache(maxsize=4)
def unpacked(function: bytes) -> Callable[..., Any]:
    """The function of `packed`, unpickled once per process."""
    return cast(Callable[..., Any], cloudpickle.loads(function))


def here(
    function: Callable[..., Any], jobs: list[Job], awaiting: Callable[[int], None]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Records computed in this process, those under way in another run last; `awaiting` gets the number of these."""
    for wait in (False, True):
        if wait and jobs:
            awaiting(len(jobs))
        elsewhere = []
        for job in jobs:
            record = once(function, job, wait=wait)
            if record is None:
                elsewhere.append(job)
            else:
                yield job.key, record
        jobs = elsewhere


def processes(
    function: Callable[..., Any], jobs: list[Job], workers: int, awaiting: Callable[[int], None]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Records computed in processes of this machine, in order of completion.

    If a process dies, the pool ends all others. The cases that were running are then computed again, each alone; one
    whose process dies again is recorded as an error. Cases under way in another run come last; `awaiting` gets their
    number.

    Raises:
        StudyError: the processes die before they begin a case.
    """
    waiting, sent = {job.key: job for job in jobs}, packed(function)
    elsewhere: set[str] = set()
    deaths = 0
    with tempfile.TemporaryDirectory(prefix="workbench-") as folder:
        running = Path(folder)
        while waiting:
            before = len(waiting), len(elsewhere)
            ours = [job for job in waiting.values() if job.key not in elsewhere]
            if not ours:
                awaiting(len(waiting))
            try:
                for key, record in _parallel(sent, ours or waiting.values(), workers, running, wait=not ours):
                    if record is None:
                        elsewhere.add(key)
                    else:
                        del waiting[key]
                        yield key, record
            except TerminatedWorkerError:
                written = {key: read_record(job.file) for key, job in waiting.items() if job.file is not None}
                for key, record in written.items():  # before the process could return it
                    if record is not None:
                        del waiting[key]
                        yield key, record
                suspects = [waiting.pop(path.name) for path in running.iterdir() if path.name in waiting]
                for path in list(running.iterdir()):
                    path.unlink()
                for job in suspects:
                    yield job.key, _alone(sent, job, running)
                deaths = deaths + 1 if (len(waiting), len(elsewhere)) == before else 0
                if deaths == MOST_DEATHS:
                    raise StudyError(
                        f"the processes of this run died {deaths} times before they began a case: the function's data"
                        " cannot be sent to them; run it with workers=1"
                    ) from None


def _parallel(
    function: bytes, jobs: Iterable[Job], workers: int, running: Path, *, wait: bool
) -> Iterator[tuple[str, dict[str, Any] | None]]:
    # joblib replaces a process that holds 300 MB more than at first, and warns; ours hold bounded caches
    warnings.filterwarnings("ignore", message="A worker stopped while some jobs", category=UserWarning)
    with parallel_config(backend="loky", inner_max_num_threads=1):
        pool = Parallel(n_jobs=workers, batch_size=1, return_as="generator_unordered")
        yield from pool(delayed(_keyed)(function, job, running, wait) for job in list(jobs))


def _keyed(function: bytes, job: Job, running: Path, wait: bool) -> tuple[str, dict[str, Any] | None]:
    return job.key, once(unpacked(function), job, running, wait=wait)


def _alone(function: bytes, job: Job, running: Path) -> dict[str, Any]:
    start = time.perf_counter()
    try:
        # two processes, of which one idles: with one, joblib would compute the case in this process
        [(_, record)] = _parallel(function, [job], 2, running, wait=True)
    except TerminatedWorkerError:
        record = None
    return record or {"result": None, "error": f"died: {DIED}", "trace": None, "seconds": time.perf_counter() - start}


def cluster(function: Callable[..., Any], jobs: list[Job], address: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Records computed on the workers of a Dask scheduler, in order of completion.

    Dask repeats a case whose worker is lost, up to the scheduler's `allowed-failures`.

    Raises:
        StudyError: Dask is not installed, no scheduler answers, it has no worker, or a worker runs another workbench.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise StudyError("a cluster needs Dask, which is not installed: pip install -e '.[cluster]'") from None
    try:
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise StudyError(
            f"no Dask scheduler answers at {address} ({error}); start one with `dask scheduler` and its workers with"
            " `dask worker ADDRESS`"
        ) from error
    with client:
        if not client.scheduler_info()["workers"]:
            raise StudyError(f"the Dask scheduler at {address} has no worker; start one with `dask worker {address}`")
        keys = [f"workbench-{job.key}" for job in jobs]
        futures = client.map(_on_worker, jobs, function=packed(function), key=keys, pure=False)
        key_of = dict(zip(keys, (job.key for job in jobs)))
        for future in as_completed(futures, loop=client.loop):
            yield key_of[future.key], _gathered(future)
            future.release()


def _on_worker(job: Job, function: bytes) -> dict[str, Any]:
    return work(unpacked(function), job)


def _gathered(future: "Future[dict[str, Any]]") -> dict[str, Any]:
    try:
        record: dict[str, Any] = future.result()
    except Exception as error:
        return {"result": None, "error": f"{type(error).__name__}: {error}", "trace": None, "seconds": 0.0}
    if record["workbench"] != own_source():
        raise StudyError(
            f"a worker of the cluster runs another modal-workbench ({record['workbench']}, here {own_source()}), so its"
            " results could differ: install the same there"
        )
    return record
