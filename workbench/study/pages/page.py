"""Self-contained HTML pages of studies and diagnoses: interactive figures and motion, escaped text, no network."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment
from markupsafe import Markup

from workbench.draw.interactive import drawable
from workbench.study.runs.cases import StudyError
from workbench.study.runs.outcome import Outcome, Shown
from workbench.study.runs.versions import versions
from workbench.study.runs.whole_file import write_whole

ASSETS = Path(__file__).parents[1] / "assets"
SCRIPTS = ("figure.js", "motion.js", "table.js")
FORMAT = "workbench page 1"
MOST_ROWS = 2000
STANDINGS = ("", "good", "part", "bad")

Table = tuple[str, Sequence[str], Sequence[Sequence[object]]]  # title, heads, rows


@dataclass(frozen=True)
class PageContent:
    """The content of a page, as plain values from which the page can be made again.

    Attributes:
        title, lead, lines: the question, the result in a sentence, and further results.
        blocks: figures ("figure"), motion ("motion") or pictures ("picture", PNG in base64), each with a "caption".
        tables: (title, heads, rows); a cell of True or False reads "holds" or "does not hold".
        inputs: the data that the page was made from, text by name.
        made_by: the command that makes the page again.
        standing: of the lead: one of `STANDINGS`, "" for neither good nor bad.
        versions: of the software.
    """

    title: str
    lead: str = ""
    lines: Sequence[str] = ()
    blocks: Sequence[Mapping[str, Any]] = ()
    tables: Sequence[Table] = ()
    inputs: Mapping[str, str] = field(default_factory=dict)
    made_by: str = ""
    standing: str = ""
    versions: Mapping[str, str] = field(default_factory=versions)

    def to_json(self) -> dict[str, Any]:
        """The content as JSON, with the entry "format"."""
        return {"format": FORMAT, **asdict(self)}


def page_content_of(content: dict[str, Any]) -> PageContent:
    """The content from the JSON of `PageContent.to_json`.

    Raises:
        StudyError: another format, or damaged content.
    """
    shape = {"title": str, "lead": str, "lines": list, "blocks": list, "tables": list, "inputs": dict, "made_by": str}
    shape["versions"] = dict
    bad = [name for name, kind in shape.items() if not isinstance(content.get(name), kind)]
    bad += ["tables"] * (not bad and not all(_is_table(table) for table in content["tables"]))
    bad += ["blocks"] * (not bad and not all(isinstance(block, dict) for block in content["blocks"]))
    if content.get("format") != FORMAT or bad:
        raise StudyError(f"this is not a {FORMAT!r}: its {bad[0] if bad else 'format'} is missing or damaged")
    standing = content.get("standing", "")  # pages of earlier versions have none
    return PageContent(**{name: content[name] for name in shape}, standing=standing if standing in STANDINGS else "")


def _is_table(table: object) -> bool:
    return (
        isinstance(table, list) and len(table) == 3 and isinstance(table[1], list) and isinstance(table[2], list)
        and all(isinstance(row, list) for row in table[2])
    )  # fmt: skip


def block(shown: Shown, caption: str) -> dict[str, Any]:
    """The block of a figure, or of the motion that `draw.motion` describes, with its caption."""
    return {**({"motion": dict(shown)} if isinstance(shown, Mapping) else drawable(shown)), "caption": caption}


def write_page(path: Path, page_content: PageContent) -> Path:
    """Write content as an HTML page with escaped text, and as JSON beside the page (.page.json)."""
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((ASSETS / "page.html").read_text(encoding="utf-8"))
    moving = [{key: one[key] for key in ("figure", "motion") if key in one} for one in page_content.blocks]
    tables = [
        {"title": title, "heads": heads, "rows": [[_cell(cell) for cell in row] for row in rows[:MOST_ROWS]]}
        for title, heads, rows in page_content.tables
    ]
    html = template.render(
        {**vars(page_content), "tables": tables},
        css=asset("page.css"),
        scripts=Markup("\n").join(map(asset, SCRIPTS)),
        data=in_script(moving),
    )
    write_whole(path.with_suffix(".page.json"), json.dumps(page_content.to_json(), separators=(",", ":")) + "\n")
    return write_whole(path, html)


def asset(name: str) -> Markup:
    """The text of one of the files that pages are made of."""
    return Markup((ASSETS / name).read_text(encoding="utf-8"))


def in_script(content: object) -> Markup:
    """JSON for a script element, escaped so that it cannot end the element."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return Markup(text)


def study_page(outcome: Outcome, folder: Path, *, inputs: Mapping[str, str], made_by: str) -> Path:
    """Write the page of a study: results, figures, checks, and tables of its runs."""
    runs = [(name, *_table_of(found.rows())) for name, found in outcome.runs.items()]
    page_content = PageContent(
        title=outcome.title or outcome.name,
        lines=tuple(outcome.lines),
        blocks=[block(shown, caption) for shown, caption in outcome.shown],
        tables=[*tables_of(outcome.tables), *checks_of(outcome.checks), *runs],
        inputs=inputs,
        made_by=made_by,
    )
    return write_page(folder / f"{outcome.name}.html", page_content)


def checks_of(checks: Sequence[Mapping[str, Any]]) -> list[Table]:
    """The table of a study's checks; none without any."""
    rows = [
        [c["name"], c["value"], f"{'≥' if c.get('at_least') else '≤'} {_cell(c['limit'])}", bool(c["holds"])]
        for c in checks
    ]
    return [("Checks", ("quantity", "value", "limit", ""), rows)] if rows else []


def tables_of(content: Mapping[str, Any]) -> list[Table]:
    """The tables that are lists of rows of named numbers; other content is in the JSON only."""
    return [
        (name.replace("_", " "), *_table_of(table))
        for name, table in content.items()
        if isinstance(table, list) and table and all(isinstance(row, dict) for row in table)
    ]


def _table_of(rows: Sequence[Mapping[str, Any]]) -> tuple[tuple[str, ...], list[list[str | bool]]]:
    heads = tuple(dict.fromkeys(head for row in rows for head in row if head != "versions"))
    shown = [[row.get(head) for head in heads] for row in rows]
    return heads, [["" if v is None else _cell(v) for v in row] for row in shown]


def to_its_error(value: object, error: object) -> tuple[str | bool, str | bool]:
    """A value and its standard error as text, both to the second digit of the error; "" if there is no error."""
    if not isinstance(value, int | float) or not isinstance(error, int | float) or not error > 0:
        return _cell(value), "" if error is None else _cell(error)
    digits = 1 - math.floor(math.log10(error))
    if 0 <= digits <= 6 and abs(value) < 1e6:
        return f"{value:.{digits}f}", f"{error:.{digits}f}"
    return f"{value:.{max(1, 2 + math.floor(math.log10(max(abs(value), error) / error)))}g}", f"{error:.2g}"


def short(number: float | None) -> float | str:
    """The number to four significant digits, enough for a comparison; "" for None."""
    return "" if number is None else float(f"{float(number):.4g}")


def _cell(value: object) -> str | bool:
    if isinstance(value, bool):
        return value
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return ", ".join(str(_cell(item)) for item in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)
