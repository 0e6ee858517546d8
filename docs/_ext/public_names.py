"""The directive `public-names`: the reference of a subpackage's public names, from their docstrings."""

import inspect
import re
from importlib import import_module
from pathlib import Path

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective

import workbench

STUB = Path(workbench.__file__).with_suffix(".pyi")
DOCS = Path(__file__).resolve().parents[1]


def public_names() -> dict[str, str]:
    """Dotted path of each public name -> its subpackage, the names of `workbench` itself first.

    The others are those that `workbench` once had, and those that a page of the documentation imports.
    """
    core = [(module.split(".")[0], name) for name, module in homes().items()]
    pages = "\n".join(page.read_text(encoding="utf-8") for page in sorted(DOCS.rglob("*.md")))
    imported = re.findall(r"^ *from workbench\.(\S+) import (\w+(?:, \w+)*)", pages, re.M)
    named = {name for _, name in core}
    shown = {f"{module}.{name}" for module, names in imported for name in names.split(", ") if name not in named}
    further = sorted(path for path in shown.union(workbench.RENAMED.values()) if "." in path)
    return {f"workbench.{name}": subpackage for subpackage, name in core} | {
        f"workbench.{path}": path.split(".")[0] for path in further
    }


def homes() -> dict[str, str]:
    """Module, relative to `workbench`, that defines each of its names."""
    imports = re.findall(r"^from \.(\S+) import (\w+)", STUB.read_text(encoding="utf-8"), re.M)
    return {name: module for module, name in imports}


def docstring_of(path: str) -> str:
    """The docstring of a public name; of a constant, the one below its assignment."""
    module, _, name = path.rpartition(".")
    value = getattr(import_module(module), name)
    if callable(value):
        return inspect.getdoc(value) or ""
    home = f"workbench.{homes()[name]}" if module == "workbench" else module
    return "\n".join(ModuleAnalyzer.for_module(home).find_attr_docs()[("", name)]).strip()


class PublicNames(SphinxDirective):
    """`.. public-names:: NAME core` documents the names `wb.X` of a subpackage, `... further` those of its modules.

    A table of the names with the first paragraph of each comes first.
    """

    required_arguments = 2

    def run(self) -> list[nodes.Node]:
        subpackage, part = self.arguments
        paths = [
            path
            for path, home in public_names().items()
            if home == subpackage and (path.count(".") == 1) == (part == "core")
        ]
        lines = [".. list-table::", "   :widths: 35 65", ""] if paths else []
        for path in paths:
            shown = path.removeprefix("workbench.") if part == "further" else f"wb.{path.rpartition('.')[2]}"
            lines += [f"   * - :py:obj:`{shown} <{path}>`", f"     - {escaped(first_paragraph(docstring_of(path)))}"]
        lines.append("")
        for path in paths:
            module, _, name = path.rpartition(".")
            value = getattr(import_module(module), name)
            if isinstance(value, type):
                lines += [f".. autoclass:: {path}", "   :members:", ""]
            elif callable(value):
                lines += [f".. autofunction:: {path}", ""]
            else:
                lines += [f".. py:data:: {path}", "", f"   {escaped(docstring_of(path))}", ""]
        parent = nodes.section()
        parent.document = self.state.document
        self.state.nested_parse(StringList(lines, source=f"public names of {subpackage}"), self.content_offset, parent)
        return parent.children


def first_paragraph(text: str) -> str:
    """The first paragraph of a docstring, on one line."""
    return " ".join(text.split("\n\n")[0].split())


def escaped(text: str) -> str:
    """A docstring with what reStructuredText would read as markup escaped; it is plain text, `code` and equations."""
    parts = re.split(r"(`[^`]*`)", text)
    parts[::2] = [re.sub(r"([\\*|])|(?<=\w)(_)(?!\w)", r"\\\g<0>", part) for part in parts[::2]]
    return "".join(parts)


def _as_rst(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    lines[:] = escaped("\n".join(lines)).split("\n")


def _plain_defaults(
    app: Sphinx, what: str, name: str, obj: object, options: object, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """A signature without the addresses of functions that are defaults."""
    return signature and re.sub(r"<function [^>]*<lambda>>|<factory>", "...", signature), returns


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("public-names", PublicNames)
    app.connect("autodoc-process-docstring", _as_rst, priority=400)  # before napoleon, at 500
    app.connect("autodoc-process-signature", _plain_defaults)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
