"""Results on disk, one JSON file per case, written atomically and without pickle."""

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
except ImportError:  # on Windows simultaneous runs in one folder may compute a case twice
    fcntl = None  # type: ignore[assignment]

ARRAY, COMPLEX = "__array__", "__complex__"
KINDS = "biufc"  # of arrays: booleans, integers, floats, complex numbers


def encoded(value: object, where: str = "the result") -> Any:
    """A result as JSON values, with exact arrays.

    Raises:
        TypeError: a value is neither number, text, list, dict nor array.
    """
    if isinstance(value, np.generic):
        return encoded(value.item(), where)
    if value is None or isinstance(value, bool | int | float | str):
        return value
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
    """The value given to `encoded`; tuples become lists."""
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
    """Write a record atomically, with a checksum."""
    text = json.dumps(record, separators=(",", ":"))
    write_whole(path, json.dumps({"sha256": _sum(text), "record": text}))


def read_record(path: Path) -> dict[str, Any] | None:
    """The record of a file; None if the file does not exist or is damaged."""
    try:
        outer = json.loads(path.read_text(encoding="utf-8"))
        record: dict[str, Any] = json.loads(outer["record"])
        return record if outer["sha256"] == _sum(outer["record"]) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


@contextmanager
def held(path: Path, wait: bool) -> Iterator[bool]:
    """Lock a record while it is computed; yields whether this process has the lock, which `wait` waits for.

    A system lock on a file beside the record, released when the process ends in any way, and not inherited by child
    processes. The process that gets the lock must first check whether the record exists by now. If the lock file
    cannot be made, no record can be written either, and the lock is granted.
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
