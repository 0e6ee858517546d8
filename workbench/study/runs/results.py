"""The results of many cases as one table: a row per case, a column per quantity."""

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from workbench.study.runs.cases import StudyError
from workbench.study.runs.versions import versions
from workbench.study.runs.whole_file import write_whole

if TYPE_CHECKING:
    import pandas as pd

ENDINGS = (".csv", ".parquet", ".json")


@dataclass(frozen=True, eq=False)
class Result:
    """One case and what came of it.

    Attributes:
        parameters: of the case.
        seed: it was computed with; None where the function takes none.
        values: by name; empty where the case failed.
        error: what it raised, in a line; None where it did not.
        trace: of the error, for the developer.
        seconds: it took.
    """

    parameters: Mapping[str, Any]
    seed: int | None
    values: Mapping[str, Any]
    error: str | None
    trace: str | None
    seconds: float

    def __getitem__(self, name: str) -> Any:
        """A value or a parameter by name.

        Raises:
            KeyError: no such name, or the case failed, and how.
        """
        if name in self.values:
            return self.values[name]
        if name in self.parameters:
            return self.parameters[name]
        if self.error is not None:
            raise KeyError(f"case {dict(self.parameters)} failed: {self.error}")
        raise KeyError(f"no value or parameter {name!r}; there are {', '.join((*self.parameters, *self.values))}")


@dataclass(frozen=True, eq=False)
class Results(Sequence[Result]):
    """Results in the order of their cases."""

    every: tuple[Result, ...]

    def __len__(self) -> int:
        return len(self.every)

    @overload
    def __getitem__(self, index: int) -> Result: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Result, ...]: ...
    def __getitem__(self, index: int | slice) -> Result | tuple[Result, ...]:
        return self.every[index]

    def __iter__(self) -> Iterator[Result]:
        return iter(self.every)

    @property
    def failed(self) -> tuple[Result, ...]:
        """Those that raised an error."""
        return tuple(result for result in self.every if result.error is not None)

    @property
    def seconds(self) -> float:
        """Work of all cases together, s."""
        return sum(result.seconds for result in self.every)

    def rows(self) -> list[dict[str, Any]]:
        """A dict a case, all with the same names: parameters, values, seed, error, seconds, versions.

        What a dict holds has a column of its own, `outer.inner`; a value that no case of this row has is None.

        Raises:
            StudyError: two values of one name.
        """
        used = ", ".join(f"{name} {version}" for name, version in versions().items())
        parts = [(_flat(r.parameters), _flat(r.values)) for r in self.every]
        names = dict.fromkeys(name for part in (0, 1) for pair in parts for name in pair[part])
        rows = []
        for result, (parameters, values) in zip(self.every, parts):
            both = parameters.keys() & values.keys()
            twice = [n for n in both if json.dumps(_plain(parameters[n])) != json.dumps(_plain(values[n]))]
            if twice:
                raise StudyError(f"{min(twice)!r} is a parameter and a result of another value; rename the result")
            row = {name: values.get(name, parameters.get(name)) for name in names}
            ending = {"error": result.error, "seconds": result.seconds, "versions": used}
            rows.append({**row, "seed": result.seed, **ending})
        return rows

    def write(self, path: str | Path) -> Path:
        """Write the table: .csv, .parquet (with pyarrow) or .json, by its ending.

        In CSV, lists and arrays are written as JSON, and numbers so that they read back bit for bit. In JSON, which has
        no other, a number that is not finite is null.

        Raises:
            StudyError: another ending, or pyarrow is not installed.
        """
        path = Path(path)
        if path.suffix not in ENDINGS:
            raise StudyError(f"{path}: a table is written as {', '.join(ENDINGS)}; got {path.suffix or 'no ending'}")
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = [{name: _plain(value) for name, value in row.items()} for row in self.rows()]
        if path.suffix == ".parquet":
            _write_parquet(path, rows)
        elif path.suffix == ".json":
            write_whole(path, json.dumps(_finite(rows), indent=1, allow_nan=False) + "\n")
        else:
            write_whole(path, _csv(rows))
        return path

    def frame(self) -> "pd.DataFrame":
        """The table as a pandas frame.

        Raises:
            StudyError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise StudyError("a frame needs pandas: pip install -e '.[table]'") from None
        return pd.DataFrame(self.rows())


def _flat(values: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    flat: dict[str, object] = {}
    for name, value in values.items():
        part = _flat(value, f"{before}{name}.") if isinstance(value, Mapping) else {before + name: value}
        twice = part.keys() & flat.keys()
        if twice:
            raise StudyError(f"two values would stand in one column, {min(twice)!r}; rename one")
        flat.update(part)
    return flat


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, complex):
        return str(value)
    return str(value) if isinstance(value, Path) else value


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _csv(rows: list[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows({n: json.dumps(v) if isinstance(v, list | dict) else v for n, v in r.items()} for r in rows)
    return text.getvalue()


def _write_parquet(path: Path, rows: list[dict[str, Any]]) -> None:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise StudyError("Parquet needs pyarrow: pip install -e '.[table]', or write .csv") from None
    try:
        columns = {name: pa.array([row[name] for row in rows]) for name in rows[0]}
    except (pa.ArrowInvalid, pa.ArrowTypeError) as error:
        raise StudyError(f"a column mixes kinds that Parquet keeps apart ({error}); write .csv") from error
    parquet.write_table(pa.table(columns), path)
