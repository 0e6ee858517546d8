"""The outcome of a study: lines, tables, checks and figures, collected while it runs, written as JSON and a page."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain, count
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from matplotlib.figure import Figure

from workbench.draw.style import plain_ticks
from workbench.study.runs.cases import StudyError
from workbench.study.runs.results import Results
from workbench.study.runs.runner import CACHE, run
from workbench.study.runs.whole_file import write_whole

DIGITS = 10
OWN = ("checks", "found")  # entries of the JSON besides the tables: checks and lines

T = TypeVar("T")
Shown = Figure | Mapping[str, Any]  # on a page: a figure, or the motion that `draw.motion` describes


@dataclass
class Outcome:
    """The results of a study; a study adds to them while it runs.

    Attributes:
        title: the question of the study.
        on_say, on_track, on_report: called with each line, each iterable to show progress for, and the progress of a
            run.
        cache: folder of the results of cases.
        scheduler: address of a Dask scheduler that computes the cases of every run; None for local processes.
    """

    name: str
    title: str = ""
    figures_folder: Path = Path("figures")
    on_say: Callable[[str], None] | None = None
    on_track: Callable[[Iterable[Any], str], Iterator[Any]] | None = None
    on_report: Callable[[str, float], None] | None = None
    cache: Path = CACHE
    scheduler: str | None = None
    lines: list[str] = field(default_factory=list)
    tables: dict[str, Any] = field(default_factory=dict)
    checks: list[dict[str, Any]] = field(default_factory=list)
    figures: list[tuple[str, Path, str]] = field(default_factory=list)
    shown: list[tuple[Shown, str]] = field(default_factory=list)
    runs: dict[str, Results] = field(default_factory=dict)

    def say(self, text: str) -> None:
        """Add a line to the results."""
        self.lines.append(text)
        if self.on_say is not None:
            self.on_say(text)

    def table(self, name: str, values: object) -> None:
        """Add a table of numbers, texts, lists and dicts.

        Raises:
            StudyError: a reserved name, or values that JSON cannot represent.
        """
        if name in OWN:
            raise StudyError(f"a table cannot be called {name!r}, an entry of the results; rename the table")
        values = plain(values)
        try:
            json.dumps(values)
        except TypeError as error:
            raise StudyError(
                f"table {name!r}: {error}; give numbers, texts, lists and dicts, a complex number by its parts"
            ) from None
        self.tables[name] = values

    def check(self, name: str, value: float, limit: float, at_least: bool = False) -> None:
        """Add a check: `value` must be at most `limit`, or at least `limit` with `at_least`."""
        holds = bool(value >= limit if at_least else value <= limit)
        found = {"name": name, "value": plain(value), "limit": plain(limit), "holds": holds, "at_least": at_least}
        self.checks.append(found)

    def figure(self, name: str, figure: Figure, caption: str) -> None:
        """Save a figure as figures/STUDY-name.png, and show it on the page."""
        self.figures_folder.mkdir(parents=True, exist_ok=True)
        path = self.figures_folder / f"{self.name}-{name}.png"
        plain_ticks(figure).savefig(path, metadata={"Software": None})
        self.figures.append((name, path, caption))
        self.shown.append((figure, caption))

    def motion(self, motion: Mapping[str, Any], caption: str) -> None:
        """Show motion on the page, as `draw.motion` describes it."""
        self.shown.append((motion, caption))

    def track(self, iterable: Iterable[T], what: str) -> Iterator[T]:
        """An iterator over the iterable that shows its progress."""
        return iter(iterable) if self.on_track is None else self.on_track(iterable, what)

    def run(
        self, cases: Iterable[Mapping[str, Any]], function: Callable[..., Any], name: str = "cases", **options: Any
    ) -> Results:
        """Run the function for every case by `study.run`, and add the table under `name`, numbered if taken."""
        options = {"cache": self.cache, "scheduler": self.scheduler, "report": self.on_report, **options}
        found = run(cases, function, **options)
        names = chain([name], (f"{name}-{i}" for i in count(2)))
        self.runs[next(each for each in names if each not in self.runs)] = found
        return found

    @property
    def holds(self) -> bool:
        return all(check["holds"] for check in self.checks)

    def to_json(self) -> dict[str, Any]:
        """The tables by name, the checks and the lines."""
        return {**self.tables, "checks": self.checks, "found": self.lines}

    def write(self, folder: Path) -> Path:
        """Write folder/NAME.json."""
        text = json.dumps(self.to_json(), indent=1, allow_nan=False) + "\n"
        return write_whole(folder / f"{self.name}.json", text)

    def write_runs(self, folder: Path) -> list[Path]:
        """Write the table of each run as folder/STUDY-name.csv."""
        return [found.write(folder / f"{self.name}-{name}.csv") for name, found in self.runs.items()]


def plain(value: object) -> Any:
    """The value for JSON, the same from run to run: numbers to ten digits, arrays as lists, keys as text."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None
    return value
