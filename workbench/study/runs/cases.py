"""The cases of a study: plain parameters by name."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

RESERVED = frozenset({"seconds", "error", "versions"})


class StudyError(ValueError):
    """A study that does not exist, has missing or invalid input, or cannot be run."""


def grid(**axes: Iterable[Any]) -> list[dict[str, Any]]:
    """Every combination of the axes' values, the last axis fastest: `grid(weight=(1, 10), at=np.arange(3))`."""
    values = [list(axis) for axis in axes.values()]
    return [dict(zip(axes, combination)) for combination in product(*values)]


def samples(n: int, /, *, seed: int = 0, **ranges: tuple[float, float]) -> list[dict[str, Any]]:
    """n points of a Latin hypercube between (low, high) of each parameter: `samples(100, at=(0.5, 9.5))`.

    Raises:
        StudyError: no points, no ranges, or a range that does not rise.
    """
    if n < 1 or not ranges:
        raise StudyError(f"samples needs at least one point and one range; got {n} and {len(ranges)}")
    for name, (low, high) in ranges.items():
        if not (np.isfinite([low, high]).all() and low < high):
            raise StudyError(f"the range of {name} must rise between finite ends; got ({low:g}, {high:g})")
    from scipy.stats import qmc  # slow to import, and few studies sample

    unit = qmc.LatinHypercube(len(ranges), rng=np.random.default_rng(seed)).random(n)
    low, high = np.array(list(ranges.values()), float).T
    return [dict(zip(ranges, map(float, point))) for point in low + unit * (high - low)]


def checked(case: Mapping[str, Any], number: int) -> dict[str, Any]:
    """A case as plain Python values, which are the same in every process and on disk.

    Raises:
        StudyError: a reserved name, or a value that is not plain.
    """
    if not isinstance(case, Mapping) or not all(isinstance(name, str) for name in case):
        raise StudyError(f"case {number} must be a dict of parameters by name; got {case!r:.80}")
    taken = RESERVED & case.keys()
    if taken:
        raise StudyError(f"case {number}: a parameter cannot be called {min(taken)!r}, a column of the results table")
    return {name: _plain(value, f"case {number}, parameter {name!r}") for name, value in case.items()}


def _plain(value: Any, where: str) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if value is None or isinstance(value, bool | int | float | str | Path):
        return value
    if isinstance(value, list | tuple):
        return [_plain(item, where) for item in value]
    if isinstance(value, dict) and all(isinstance(name, str) for name in value):
        return {name: _plain(item, where) for name, item in value.items()}
    raise StudyError(
        f"{where} is a {type(value).__name__}; parameters are numbers, texts, paths, lists and dicts of them:"
        " build other things inside the function"
    )


def key_of(case: Mapping[str, Any], fingerprint: str, seed: int | None) -> str:
    """The key of a case's result, a digest of function, versions, parameters and seed.

    A `Path` counts with the contents of the file or folder, so that a changed file is a changed case.
    """
    content = json.dumps([fingerprint, seed, _content(dict(case))], separators=(",", ":"))
    return hashlib.sha256(content.encode()).hexdigest()[:40]


def _content(value: object) -> Any:
    if isinstance(value, dict):
        return [[name, _content(item)] for name, item in sorted(value.items())]
    if isinstance(value, list):
        return [_content(item) for item in value]
    if isinstance(value, Path):
        files = sorted(p for p in value.rglob("*") if p.is_file()) if value.is_dir() else [value]
        return [
            [str(file), hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else None] for file in files
        ]
    # 1, 1.0 and True are equal in Python, but a function may treat them differently
    return [type(value).__name__, value]


def seed_of(case: Mapping[str, Any], root: int) -> int:
    """The seed of a case, independent of the other cases and their order."""
    text = json.dumps([root, _content({n: str(v) if isinstance(v, Path) else v for n, v in case.items()})])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:6])
