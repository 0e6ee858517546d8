"""The results of many cases as one table: a row per case, a column per quantity."""

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from workbench.study.runs.cases import StudyError
from workbench.study.runs.versions import versions
from workbench.study.runs.whole_file import write_whole

if TYPE_CHECKING:
    import pandas as pd

ENDINGS = (".csv", ".parquet", ".json")


@dataclass(frozen=True, eq=False)
class Result:
    """The result of one case.

    Attributes:
        seed: of the case; None if the function takes no seed.
        values: by name; empty if the case failed.
        error, trace: the exception of the case in one line, and its traceback; None if it succeeded.
        seconds: time of the computation.
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
            KeyError: no such name, or the case failed; the message states the error.
        """
        if name in self.values:
            return self.values[name]
        if name in self.parameters:
            return self.parameters[name]
        if self.error is not None:
            raise KeyError(f"case {dict(self.parameters)} failed: {self.error}")
        raise KeyError(f"no value or parameter {name!r}; there are {', '.join((*self.parameters, *self.values))}")


class Results(tuple[Result, ...]):
    """Results in the order of their cases."""

    @property
    def failed(self) -> tuple[Result, ...]:
        """The results of the cases that failed."""
        return tuple(result for result in self if result.error is not None)

    @property
    def seconds(self) -> float:
        """Total computation time of all cases, s."""
        return sum(result.seconds for result in self)

    def rows(self) -> list[dict[str, Any]]:
        """One dict per case, all with the same keys: parameters, values, seed, error, seconds, versions.

        An entry of a dict has its own column, `outer.inner`; a value that a case does not have is None.

        Raises:
            StudyError: two different values of the same name.
        """
        used = ", ".join(f"{name} {version}" for name, version in versions().items())
        parts = [(_flat(r.parameters), _flat(r.values)) for r in self]
        names = dict.fromkeys(name for part in (0, 1) for pair in parts for name in pair[part])
        rows = []
        for result, (parameters, values) in zip(self, parts):
            both = parameters.keys() & values.keys()
            twice = [n for n in both if json.dumps(_plain(parameters[n])) != json.dumps(_plain(values[n]))]
            if twice:
                raise StudyError(f"{min(twice)!r} is a parameter and a result with different values; rename the result")
            row = {name: values.get(name, parameters.get(name)) for name in names}
            ending = {"error": result.error, "seconds": result.seconds, "versions": used}
            rows.append({**row, "seed": result.seed, **ending})
        return rows

    def write(self, path: str | Path) -> Path:
        """Write the table as .csv, .parquet (with pyarrow) or .json, by its suffix.

        In CSV, lists and arrays are written as JSON, and numbers exactly. In JSON, a number that is not finite is null.

        Raises:
            StudyError: another suffix, or pyarrow is not installed.
        """
        path = Path(path)
        if path.suffix not in ENDINGS:
            raise StudyError(f"{path}: a table is written as {', '.join(ENDINGS)}; got {path.suffix or 'no ending'}")
        path.parent.mkdir(parents=True, exist_ok=True)
        is_json = path.suffix == ".json"
        rows = [{name: _plain(value, finite=is_json) for name, value in row.items()} for row in self.rows()]
        if path.suffix == ".parquet":
            _write_parquet(path, rows)
        elif is_json:
            write_whole(path, json.dumps(rows, indent=1, allow_nan=False) + "\n")
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
            raise StudyError(f"two values have the same column name {min(twice)!r}; rename one")
        flat.update(part)
    return flat


def _plain(value: object, *, finite: bool = False) -> object:
    """The value as lists, dicts, texts and numbers; with `finite` a number that is not finite is None."""
    if isinstance(value, np.ndarray):
        return _plain(value.tolist(), finite=finite)
    if isinstance(value, list):
        return [_plain(item, finite=finite) for item in value]
    if isinstance(value, dict):
        return {name: _plain(item, finite=finite) for name, item in value.items()}
    if finite and isinstance(value, float) and not np.isfinite(value):
        return None
    return str(value) if isinstance(value, complex | Path) else value


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
        raise StudyError(f"a column mixes types that Parquet distinguishes ({error}); write .csv") from error
    parquet.write_table(pa.table(columns), path)
