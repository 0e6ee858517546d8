"""Results on disk, one JSON file per case: whole or not there, and never a pickle."""

import base64
import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from workbench.study.runs.whole_file import write_whole

try:
    import fcntl
except ImportError:  # Windows has none: runs at once on one folder may there compute a case twice
    fcntl = None  # type: ignore[assignment]

ARRAY, COMPLEX = "__array__", "__complex__"
KINDS = "biufc"  # of arrays: booleans, integers, floats, complex numbers


def encoded(value: object, where: str = "the result") -> Any:
    """A result as JSON holds it, arrays bit for bit.

    Raises:
        TypeError: naming what is neither number, text, list, dict nor array.
    """
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, np.generic):
        return encoded(value.item(), where)
    if isinstance(value, float):
        return float(value)
    if isinstance(value, complex):
        return {COMPLEX: [value.real, value.imag]}
    if isinstance(value, np.ndarray) and value.dtype.kind in KINDS:
        little = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
        text = base64.b64encode(little.tobytes()).decode()
        return {ARRAY: text, "dtype": little.dtype.str, "shape": list(value.shape)}
    if isinstance(value, list | tuple):
        return [encoded(item, where) for item in value]
    if isinstance(value, dict) and all(isinstance(name, str) for name in value):
        return {name: encoded(item, f"{where}[{name!r}]") for name, item in value.items()}
    raise TypeError(f"{where} is a {type(value).__name__}; return numbers, texts, arrays, lists and dicts of them")


def decoded(value: Any) -> Any:
    """What `encoded` was given; tuples come back as lists."""
    if isinstance(value, list):
        return [decoded(item) for item in value]
    if not isinstance(value, dict):
        return value
    if COMPLEX in value:
        return complex(*value[COMPLEX])
    if ARRAY in value:
        flat = np.frombuffer(base64.b64decode(value[ARRAY]), np.dtype(value["dtype"]))
        return flat.reshape(value["shape"]).copy()
    return {name: decoded(item) for name, item in value.items()}


def write_record(path: Path, record: dict[str, Any]) -> None:
    """Put a record in its place at once: a reader, or a run that resumes, sees all of it or nothing."""
    text = json.dumps(record, separators=(",", ":"))
    write_whole(path, json.dumps({"sha256": _sum(text), "record": text}))


def read_record(path: Path) -> dict[str, Any] | None:
    """A record; None where there is none, or where the disk has lost part of it."""
    try:
        outer = json.loads(path.read_text(encoding="utf-8"))
        whole = outer["sha256"] == _sum(outer["record"])
        record: dict[str, Any] | None = json.loads(outer["record"]) if whole else None
        return record
    except (OSError, ValueError, KeyError, TypeError):
        return None


@contextmanager
def held(path: Path, wait: bool) -> Iterator[bool]:
    """Keep other processes from a record while it is made: whether it is held, at once or, with `wait`, in the end.

    A lock of the system on a file beside the record. It goes when its process ends, however it ends, and child
    processes do not inherit it. Whoever gets it must look first whether the record is there by now. Where no file can
    be made, nothing can be kept either, and nothing is held back.
    """
    beside = path.with_suffix(".lock")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(beside, "ab")
    except OSError:
        yield True
        return
    with file:
        try:
            if fcntl is not None:
                fcntl.lockf(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            yield False
            return
        except OSError:  # a file system without locks
            pass
        try:
            yield True
        finally:
            with suppress(OSError):
                beside.unlink()


def _sum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
