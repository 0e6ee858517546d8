"""Output, progress bar and exit codes of the commands."""

import csv
import json
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

FAILURE, BAD_INPUT = 1, 2
OPTIONS = {  # by argument, or by its words in a message, a regular expression
    "sample_rate_hz": "--sample-rate-hz",
    "n_modes": "--modes",
    "band_hz": "--band-hz",
    r"input_hold(?= is zero \(held\))": "--input-hold",  # not the key of a case file
    "(?<=raise )the limit of effort": "--effort-ratio",
    "the limit of peak force": "--peak-force",
    "the limit of the condition number": "--condition",
    "(?<=lower )the spacing": "--spacing",
    "the control weight R": "--weight",
    "the relative error of the models": "--errors",
    "the damping ratio wanted": "--damping",
}
PAGES, FIGURES = (".html", ".htm"), (".png", ".svg", ".pdf", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".eps", ".ps")
WIDE = 150  # width of a table written to a file or a pipe

# without markup: rich would take the unit in "acceleration [m/s^2]" for a style and drop it
console = Console(soft_wrap=True, highlight=False, markup=False)
if not console.is_terminal:
    console.width = WIDE
errors = Console(stderr=True, soft_wrap=True, highlight=False, markup=False)


def guarded(command: Callable[..., None]) -> Callable[..., None]:
    """The command with exit codes: 2 for bad input, 1 for any other error, each with one line on stderr."""
    parameters = signature(command).parameters

    @wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            with warnings.catch_warnings():
                warnings.showwarning = _show_warning
                command(*args, **kwargs)
        except typer.Exit:
            raise
        except (ValueError, OSError, MemoryError) as error:
            complain(with_notes(error), parameters)
            raise typer.Exit(BAD_INPUT) from None
        except KeyboardInterrupt:
            complain("interrupted")
            raise typer.Exit(FAILURE) from None
        except Exception as error:
            complain(f"{type(error).__name__}: {with_notes(error)}", parameters)
            raise typer.Exit(FAILURE) from None

    return run


def with_notes(error: BaseException) -> str:
    """The message of an error, and in brackets its notes, such as a line of the user's own script."""
    notes = getattr(error, "__notes__", ())
    return f"{error} ({'; '.join(notes)})" if notes else str(error)


def complain(fault: str, parameters: Collection[str] = ()) -> None:
    """Print an error in one line, with the names of arguments replaced by those of the command's options."""
    for argument, option in OPTIONS.items():
        if option.removeprefix("--").replace("-", "_") in parameters:
            fault = re.sub(rf"\b{argument}\b", option, fault)
    errors.print(f"workbench: {_one_line(fault)}", style="red")


def by_options(text: str) -> str:
    """The text with arguments in backquotes, such as `seconds`, and with values, such as name='x', as options."""
    return re.sub(
        r"`(\w+)`|\b(\w+)='([\w-]+)'",
        lambda named: "--" + (named[1] or named[2]).replace("_", "-") + (f" {named[3]}" if named[3] else ""),
        text,
    )


def say(text: str, *, bold: bool = False) -> None:
    """Print a line without markup."""
    console.print(text, style="bold" if bold else None)


def _one_line(text: str) -> str:
    """The text in one line, with control characters escaped, as those of a file name could control the terminal."""
    return "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in " ".join(text.split()))


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    """Print a warning in one line, except arithmetic warnings, which are for developers."""
    if not issubclass(category, RuntimeWarning):
        errors.print(f"workbench: warning: {_one_line(str(message))}", style="yellow")


def progress_bar() -> Progress:
    """A progress bar on stderr, shown only on a terminal."""
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        console=errors,
        transient=True,
        disable=not errors.is_terminal,
    )


@contextmanager
def reporting(first: str) -> Iterator[Callable[[str, float], None]]:
    """A context with a function `report(what, share)` that advances a progress bar, never backwards."""
    furthest = 0.0
    with progress_bar() as progress:
        task = progress.add_task(first, total=1.0)

        def report(what: str, share: float) -> None:
            nonlocal furthest
            furthest = max(furthest, share)
            progress.update(task, description=what, completed=furthest)

        yield report


def sub_progress(report: Callable[[str, float], None], start: float, end: float) -> Callable[[str, float], None]:
    """A report from 0 to 1 that moves the progress bar from one share to another."""
    return lambda what, share: report(what, start + (end - start) * share)


def print_result(result: object) -> None:
    """Print a result, its first line bold."""
    head, *rest = str(result).splitlines()
    say(head, bold=True)
    for line in rest:
        say(line)


def show_table(headings: Sequence[str], rows: Iterable[Sequence[str]], *, right: Collection[str] = ()) -> None:
    """Print a table; with right-aligned columns, no cell is wrapped."""
    table = Table(box=None, pad_edge=False)
    for heading in headings:
        table.add_column(heading, justify="right" if heading in right else "left", no_wrap=bool(right))
    for row in rows:
        table.add_row(*row)
    console.print(table)


def check_target(*paths: Path | None, page: Path | None = None, figure: Path | None = None) -> None:
    """Refuse paths that cannot be written, or a suffix of another format, before the computation.

    The folder of a page is made if there is none; of a figure the suffix alone is checked.
    """
    if page is not None and not page.is_dir() and page.suffix.lower() not in PAGES:
        raise ValueError(f"--page writes HTML; name a file such as {page.stem}.html; got {page.name}")
    if figure is not None and not figure.is_dir() and figure.suffix.lower() not in FIGURES:
        wanted = f"{', '.join(FIGURES[:-1])} or {FIGURES[-1]}"
        raise ValueError(f"--figure writes {wanted}; name a file such as {figure.stem}.png; got {figure.name}")
    for path in filter(None, (*paths, page)):
        if path.is_dir():
            raise ValueError(f"{path} is a folder; name a file in it")
    for path in filter(None, paths):
        if not path.parent.is_dir():
            raise ValueError(f"{path}: there is no folder {path.parent}; make it first")
    for folder in page.parents if page else ():
        if folder.is_file():
            raise ValueError(f"{page}: {folder} is a file, not a folder; name another place")


def write_json(path: Path | None, content: Mapping[str, Any]) -> None:
    """Write results as JSON, if a path is given, and print the path."""
    from workbench.study.runs.outcome import plain
    from workbench.study.runs.whole_file import write_whole

    if path is not None:
        write_whole(path, json.dumps(plain(content), indent=1, allow_nan=False) + "\n")
        say(f"  written to {short(path)}")


def short(path: Path) -> str:
    """The path relative to the current folder if inside it."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def as_typed() -> str:
    """The present command line, for the foot of a page."""
    return shlex.join(["workbench", *sys.argv[1:]])


def names_in(text: str) -> tuple[str, ...]:
    """The names of a text, separated by commas; a name that holds one stands in double quotes, as in CSV."""
    fields = next(csv.reader([text], skipinitialspace=True), [])
    return tuple(name.strip() for name in fields if name.strip())
