"""The directive `public-names`: the reference of a room's public names, from their docstrings."""

import re
from importlib import import_module
from pathlib import Path

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import workbench

STUB = Path(workbench.__file__).with_suffix(".pyi")
DOCS = Path(__file__).resolve().parents[1]


def public_names() -> dict[str, str]:
    """Dotted path of each public name -> its room: the names of `workbench` first, then those of the rooms' files.

    Of the rooms' files, names that `workbench` once had, and those that a page of the documentation imports.
    """
    core = re.findall(r"^from \.(\w+)\S* import (\w+)", STUB.read_text(encoding="utf-8"), re.M)
    pages = "\n".join(page.read_text(encoding="utf-8") for page in sorted(DOCS.rglob("*.md")))
    imported = re.findall(r"^ *from workbench\.(\S+) import (\w+(?:, \w+)*)", pages, re.M)
    named = {name for _, name in core}
    shown = {f"{module}.{name}" for module, names in imported for name in names.split(", ") if name not in named}
    further = sorted(path for path in shown.union(workbench.RENAMED.values()) if "." in path)
    return {f"workbench.{name}": room for room, name in core} | {
        f"workbench.{path}": path.split(".")[0] for path in further
    }


class PublicNames(SphinxDirective):
    """`.. public-names:: ROOM core` documents the names `wb.NAME` of a room, `... further` those of its files."""

    required_arguments = 2

    def run(self) -> list[nodes.Node]:
        room, part = self.arguments
        lines: list[str] = []
        for path, home in public_names().items():
            module, _, name = path.rpartition(".")
            if home != room or (module == "workbench") != (part == "core"):
                continue
            value = getattr(import_module(module), name)
            if isinstance(value, type):
                lines += [f".. autoclass:: {path}", "   :members:", ""]
            elif callable(value):
                lines += [f".. autofunction:: {path}", ""]
            else:
                lines += [f".. autodata:: {path}", "   :no-value:", ""]
        parent = nodes.section()
        parent.document = self.state.document
        self.state.nested_parse(StringList(lines, source=f"public names of {room}"), self.content_offset, parent)
        return parent.children


def _as_rst(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Escape what reStructuredText would read as markup: docstrings are plain text, with `code` and equations."""
    parts = re.split(r"(`[^`]*`)", "\n".join(lines))
    parts[::2] = [re.sub(r"([\\*|])|(?<=\w)(_)(?!\w)", r"\\\g<0>", part) for part in parts[::2]]
    lines[:] = "".join(parts).split("\n")


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("public-names", PublicNames)
    app.connect("autodoc-process-docstring", _as_rst, priority=400)  # before napoleon, at 500
    return {"parallel_read_safe": True, "parallel_write_safe": True}
