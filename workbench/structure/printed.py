"""Printing of results: a summary line and a short table, as text and in a notebook."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import fields
from functools import wraps
from html import escape
from math import isfinite
from typing import Any, ParamSpec, Protocol, TypeVar
from warnings import warn

import numpy as np
from numpy.typing import ArrayLike

from workbench.structure.domain import Patch, listed


class Remarked(Protocol):
    """A result with remarks."""

    @property
    def remarks(self) -> tuple[str, ...]: ...


P = ParamSpec("P")
R = TypeVar("R", bound=Remarked)


class Printed:
    """A result that prints as a summary line and a table."""

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        """The summary line (empty for a table alone), headings, rows, and remarks below the table."""
        raise NotImplementedError

    def __str__(self) -> str:
        line, headings, rows, remarks = self._printed()
        table = [headings, *rows] if rows or not line else []
        widths = [max(len(row[k]) for row in table) for k in range(len(headings))] if table else []
        lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths)).rstrip() for row in table]
        return "\n".join([*([line] if line else []), *lines, *remarks])

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self._printed()[0]}>"

    def _repr_html_(self) -> str:
        line, headings, rows, remarks = self._printed()
        head = "".join(f"<th>{escape(cell)}</th>" for cell in headings)
        body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        below = "".join(f"<p>{escape(remark)}</p>" for remark in remarks)
        table = f"<table><tr>{head}</tr>{body}</table>" if rows or not line else ""
        return f"{f'<p>{escape(line)}</p>' if line else ''}{table}{below}"


class Constructed:
    """A dataclass that prints as a call of its constructor, with the arguments that differ from their defaults."""

    def __repr__(self) -> str:
        given = []
        for each in fields(self):  # type: ignore[arg-type]
            value = getattr(self, each.name)
            if value != each.default and each.name not in self._derived():
                given.append(f"{each.name}={argument_text(value)}")
        return f"{type(self).__name__}({', '.join(given)})"

    def _derived(self) -> Collection[str]:
        """Names of fields that follow from others and are left out."""
        return ()


def argument_text(value: object) -> str:
    """The `repr` of an argument, with six digits of each float."""
    if isinstance(value, tuple):
        return f"({', '.join(map(argument_text, value))}{',' * (len(value) == 1)})"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def rounded(value: float) -> float | None:
    """Six digits of a number, as JSON holds it: what is not finite is null."""
    return float(f"{value:.6g}") if isfinite(value) else None


def all_rounded(values: ArrayLike | Mapping[str, float]) -> Any:
    """Every number `rounded`: of an array in lists, of a mapping by name."""
    if isinstance(values, Mapping):
        return {name: rounded(value) for name, value in values.items()}
    return _each_rounded(np.asarray(values, float).tolist())


def _each_rounded(values: Any) -> Any:
    return [_each_rounded(value) for value in values] if isinstance(values, list) else rounded(values)


def warns_of_remarks(function: Callable[P, R]) -> Callable[P, R]:
    """The function with a warning for each remark of its result.

    It must be the outermost decorator, so that warnings refer to the caller's line.
    """

    @wraps(function)
    def warned(*args: P.args, **kwargs: P.kwargs) -> R:
        result = function(*args, **kwargs)
        for remark in result.remarks:
            warn(remark, stacklevel=2)
        return result

    return warned


def counted(number: int, word: str) -> str:
    """A number with its noun: "1 mode", "2 modes"."""
    return f"{number} {word}{'s' * (number != 1)}"


def joined_in_words(parts: Sequence[str]) -> str:
    """Texts joined as "a, b and c"; empty where there are none."""
    return " and ".join(part for part in (", ".join(parts[:-1]), *parts[-1:]) if part)


def command_headings(unit: str) -> tuple[str, str]:
    """Headings of the effort ∫ uᵀu dt and of the largest |u|, of commands in N, N m or N m/m; empty for others."""
    if not unit:
        return "effort", "peak command"
    return (
        f"effort [{'N² s' if unit == 'N' else f'({unit})² s'}]",
        f"peak {'force' if unit == 'N' else 'moment'} [{unit}]",
    )


def in_unit(value: float, heading: str) -> str:
    """A value to four digits with the unit of its heading: "effort [N² s]" and 12.0912 give "12.09 N² s"."""
    _, bracket, unit = heading.partition(" [")
    return f"{value:.4g} {unit[:-1]}" if bracket else f"{value:.4g}"


def place_text(place: object) -> str:
    """Text of a place: x or x, y in m, a name, two of these, or a patch of a plate; empty where unknown."""
    if isinstance(place, Patch):
        return f"{place.x:.4g}, {place.y:.4g} ({place.width:.4g} by {place.height:.4g})"
    if isinstance(place, tuple):
        return ", ".join(place_text(part) for part in place)
    return "" if place is None else f"{place:.4g}" if isinstance(place, int | float) else str(place)


def places_text(places: np.ndarray) -> str:
    """Texts of an array of places (n_places,) or (n_places, 2): by commas, or by semicolons between pairs."""
    return ("; " if places.ndim == 2 else ", ").join(map(place_text, listed(places)))


def mode_text(r: int, hz: float, more: str = "") -> str:
    """Text of a zero-based mode: "mode 2 (4.1 Hz)"."""
    return f"mode {r + 1} ({hz:.4g} Hz{more})"
