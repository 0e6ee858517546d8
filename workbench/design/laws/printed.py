"""How a result of design is printed: a line that sums it up, and a short table, as text and in a notebook."""

from collections.abc import Sequence
from html import escape


class Printed:
    """A result with a line, headings, rows and remarks of its own."""

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        """The line that sums it up, headings, rows, and remarks below the table."""
        raise NotImplementedError

    def __str__(self) -> str:
        line, headings, rows, remarks = self._printed()
        table = [headings, *rows]
        widths = [max(len(row[k]) for row in table) for k in range(len(headings))]
        lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths)).rstrip() for row in table]
        return "\n".join([line, *lines, *remarks])

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self._printed()[0]}>"

    def _repr_html_(self) -> str:
        line, headings, rows, remarks = self._printed()
        head = "".join(f"<th>{escape(cell)}</th>" for cell in headings)
        body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        below = "".join(f"<p>{escape(remark)}</p>" for remark in remarks)
        return f"<p>{escape(line)}</p><table><tr>{head}</tr>{body}</table>{below}"


def numbered(indices: Sequence[int]) -> str:
    """Zero-based modes as they are counted: 1 to 4, or 1, 2, 5."""
    if len(indices) > 2 and list(indices) == list(range(indices[0], indices[-1] + 1)):
        return f"{indices[0] + 1} to {indices[-1] + 1}"
    return ", ".join(str(r + 1) for r in indices)


def place_text(place: object) -> str:
    """A place of an actuator or sensor: x in m, (x, y), a name, or two of these."""
    if isinstance(place, float):
        return f"{place:.4g}"
    if isinstance(place, tuple):
        return ", ".join(place_text(part) for part in place)
    return str(place)
