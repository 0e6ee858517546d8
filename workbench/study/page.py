"""One self-contained page per study or diagnosis: figures inlined, text escaped, no network."""

import base64
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment

from workbench.study.outcome import Outcome
from workbench.study.versions import versions

TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
:root { --ink:#1b1f24; --paper:#ffffff; --soft:#5c6670; --line:#d8dde3; --good:#00795a; --bad:#b03a00; --card:#f6f8fa; }
@media (prefers-color-scheme: dark) { :root { --ink:#e8eaed; --paper:#14171a; --soft:#a3adb8; --line:#353b42;
  --good:#3ecf9b; --bad:#ff9a66; --card:#1c2126; } figure img { filter: invert(0.9) hue-rotate(180deg); } }
@media print { :root { --ink:#000; --paper:#fff; } figure { break-inside: avoid; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 62rem;
  margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; line-height: 1.25; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
.lead { font-size: 1.2rem; background: var(--card); border-left: 4px solid var(--good); padding: .8rem 1rem; }
figure { margin: 1.2rem 0; } figure img { width: 100%; height: auto; } figcaption { color: var(--soft); }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid var(--line); text-align: right; }
th:first-child, td:first-child { text-align: left; } th { cursor: pointer; color: var(--soft); font-weight: 600; }
.good { color: var(--good); } .bad { color: var(--bad); } footer { color: var(--soft); font-size: .85rem;
  margin-top: 3rem; border-top: 1px solid var(--line); padding-top: .6rem; }
details summary { cursor: pointer; color: var(--soft); }
</style></head><body>
<h1>{{ title }}</h1>
{% if lead %}<p class="lead">{{ lead }}</p>{% endif %}
{% if lines %}<ul>{% for line in lines %}<li>{{ line }}</li>{% endfor %}</ul>{% endif %}
{% for figure in figures %}<figure><img alt="{{ figure.caption }}" src="data:image/png;base64,{{ figure.data }}">
<figcaption>{{ figure.caption }}</figcaption></figure>{% endfor %}
{% for table in tables %}<h2>{{ table.title }}</h2><div class="scroll"><table><thead><tr>
{% for head in table.heads %}<th>{{ head }}</th>{% endfor %}</tr></thead><tbody>
{% for row in table.rows %}<tr>{% for cell in row %}<td{% if cell is sameas true %} class="good">holds{% elif cell is
 sameas false %} class="bad">does not hold{% else %}>{{ cell }}{% endif %}</td>{% endfor %}</tr>{% endfor %}
</tbody></table></div>{% endfor %}
<footer>{{ made_by }}. {% for name, version in versions.items() %}{{ name }} {{ version }}{{ ", " if not loop.last }}{%
 endfor %}.</footer>
<script>
document.querySelectorAll("th").forEach(function (head) { head.addEventListener("click", function () {
  var body = head.closest("table").tBodies[0], column = head.cellIndex, up = head.dataset.up !== "1";
  head.dataset.up = up ? "1" : "0";
  Array.from(body.rows).sort(function (a, b) {
    var x = a.cells[column].textContent, y = b.cells[column].textContent, p = parseFloat(x), q = parseFloat(y);
    var order = isNaN(p) || isNaN(q) ? x.localeCompare(y) : p - q; return up ? order : -order;
  }).forEach(function (row) { body.appendChild(row); }); }); });
</script></body></html>
"""


def write_page(
    path: Path,
    *,
    title: str,
    lead: str = "",
    lines: Sequence[str] = (),
    figures: Sequence[tuple[Path | bytes, str]] = (),
    tables: Sequence[tuple[str, Sequence[str], Sequence[Sequence]]] = (),
    made_by: str = "",
) -> Path:
    """Write a page; every text is escaped, every figure inlined.

    Args:
        path: of the HTML file.
        figures: (PNG file or its bytes, caption).
        tables: (title, heads, rows); a cell of True or False reads "holds" or "does not hold".
        made_by: the command that makes the page again.
    """
    environment = Environment(autoescape=True, trim_blocks=True)
    shown = [
        {"data": base64.b64encode(f if isinstance(f, bytes) else Path(f).read_bytes()).decode(), "caption": caption}
        for f, caption in figures
    ]
    html = environment.from_string(TEMPLATE).render(
        title=title,
        lead=lead,
        lines=list(lines),
        figures=shown,
        tables=[
            {"title": t, "heads": heads, "rows": [[_cell(c) for c in r] for r in rows]} for t, heads, rows in tables
        ],
        made_by=made_by,
        versions=versions(),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(html, encoding="utf-8")
    return path


def study_page(outcome: Outcome, folder: Path) -> Path:
    """The page of a study: what it found, its figures, its checks."""
    checks = [
        (c["name"], _cell(c["value"]), ("≥ " if c["at_least"] else "≤ ") + _cell(c["limit"]), c["holds"])
        for c in outcome.checks
    ]
    return write_page(
        folder / f"{outcome.name}.html",
        title=outcome.title or outcome.name,
        lines=outcome.lines,
        figures=[(path, caption) for _, path, caption in outcome.figures],
        tables=[*_rows_of(outcome.tables), *([("Checks", ("what", "value", "limit", ""), checks)] if checks else ())],
        made_by=f"workbench study {outcome.name}",
    )


def _rows_of(tables: dict) -> list[tuple]:
    """Those tables that are rows of named figures; what else a study keeps is in its JSON."""
    found = []
    for name, table in tables.items():
        if isinstance(table, list) and table and all(isinstance(row, dict) for row in table):
            heads = tuple(table[0])
            found.append((name.replace("_", " "), heads, [[row.get(head, "") for head in heads] for row in table]))
    return found


def _cell(value):
    if isinstance(value, list):
        return ", ".join(str(_cell(item)) for item in value)
    if isinstance(value, bool):
        return value
    return f"{value:.6g}" if isinstance(value, float) else str(value)
