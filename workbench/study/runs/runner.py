"""Runs of many cases: each is computed once and stored at once, so that an interrupted run can resume."""

import inspect
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from workbench.study.runs.cache import decoded, read_record
from workbench.study.runs.cases import StudyError, checked, key_of, seed_of
from workbench.study.runs.engines import Job, cluster, here, keep, processes
from workbench.study.runs.fingerprint import fingerprint
from workbench.study.runs.results import Result, Results
from workbench.threads import cores

CACHE = Path("out/cache")


def run(
    cases: Iterable[Mapping[str, Any]],
    function: Callable[..., Any],
    *,
    cache: str | Path | None = CACHE,
    workers: int | None = None,
    scheduler: str | None = None,
    seed: int = 0,
    report: Callable[[str, float], None] | None = None,
) -> Results:
    """Results of a function for every case, in the order of the cases: `for result in study.run(cases, function): ...`.

    A result is stored under a digest of the function (with all code and data it uses), the versions of the software,
    the case and its seed, so that a second run computes only cases that are new, changed, failed or unfinished. The
    exception of a case is stored with the results of the others. Equal cases are computed once; simultaneous runs on
    one cache, also in other processes, share results and wait for each other's. The contents of a file count only if a
    case names it as a `Path`.

    Args:
        cases: dicts of plain parameters; `grid` and `samples` make them.
        function: takes a case's parameters by name; returns a dict of numbers, texts, lists and arrays, or one of
            these. A parameter `seed` that the case does not give gets a seed of the case.
        cache: folder of the results; None to store none.
        workers: number of processes; one for each core unless given. With one, cases are computed in this process.
        scheduler: address of a Dask scheduler, such as tcp://10.0.0.5:8786, whose workers compute the cases instead.
        seed: root of the seeds.
        report: called with a text and the share done.

    Raises:
        StudyError: no cases; a case or function that does not have a unique digest; a cluster that does not answer.
    """
    checked_cases = [checked(case, number) for number, case in enumerate(cases, 1)]
    if not checked_cases:
        raise StudyError("there are no cases to run")
    if workers is not None and workers < 1:
        raise StudyError(f"workers must be at least 1; got {workers}")
    seeds = _seeds(checked_cases, function, seed)
    digest = fingerprint(function) if cache is not None else ""
    keys = [key_of(case, digest, s) for case, s in zip(checked_cases, seeds)]
    folder = None if cache is None else Path(cache).resolve() / f"{_name(function)}-{digest[:12]}"
    files = dict.fromkeys(keys) if folder is None else {key: folder / f"{key}.json" for key in keys}
    found = {key: read_record(file) for key, file in files.items() if file is not None}
    records = {key: record for key, record in found.items() if record is not None}
    jobs = {
        key: Job(key, case if s is None else {**case, "seed": s}, None if scheduler else files[key])
        for key, case, s in zip(keys, checked_cases, seeds)
        if key not in records
    }

    def progress(text: str) -> None:
        if report is not None:
            report(text, len(records) / len(files))

    def awaiting(n: int) -> None:
        progress(f"waiting for {n} cases of another run")

    progress(f"{len(records)} of {len(files)} cases")
    unwritten: list[str] = []
    for key, record in _computed(function, list(jobs.values()), workers, scheduler, awaiting):
        records[key] = record
        file = files[key]
        if scheduler and file is not None:
            record["unwritten"] = keep(file, record)
        unwritten += filter(None, [record.get("unwritten")])
        progress(f"{len(records)} of {len(files)} cases")
    if unwritten:
        warnings.warn(
            f"{len(unwritten)} of {len(files)} results could not be written to {folder} and would be computed again:"
            f" {unwritten[0]}",
            stacklevel=2,
        )
    return Results(
        Result(case, case.get("seed", s), decoded(r["result"] or {}), r["error"], r["trace"], r["seconds"])
        for case, s, r in zip(checked_cases, seeds, (records[key] for key in keys))
    )


def _computed(
    function: Callable[..., Any],
    jobs: list[Job],
    workers: int | None,
    scheduler: str | None,
    awaiting: Callable[[int], None],
) -> Iterator[tuple[str, dict[str, Any]]]:
    if not jobs:
        return iter(())
    if scheduler:
        return cluster(function, jobs, scheduler)
    workers = min(workers or cores(), len(jobs))
    return here(function, jobs, awaiting) if workers == 1 else processes(function, jobs, workers, awaiting)


def _seeds(cases: Sequence[Mapping[str, Any]], function: Callable[..., Any], root: int) -> list[int | None]:
    try:
        wants = "seed" in inspect.signature(function).parameters
    except (TypeError, ValueError):
        wants = False
    return [seed_of(case, root) if wants and "seed" not in case else None for case in cases]


def _name(function: Callable[..., Any]) -> str:
    name = getattr(function, "__name__", type(function).__name__)
    return "".join(c if c.isalnum() or c == "_" else "-" for c in name)
