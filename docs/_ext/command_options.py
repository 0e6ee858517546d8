"""The directive `command-options`: what a command does, its arguments and options, from the command itself."""

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from typer.main import get_command

from workbench.cli.app import app as workbench_app

COMMANDS = get_command(workbench_app).commands  # type: ignore[attr-defined]


class CommandOptions(SphinxDirective):
    """`.. command-options:: NAME` documents one command of `workbench`."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        command = COMMANDS[self.arguments[0]]
        lines = []
        for paragraph in (command.help or "").split("\n\n"):
            text = " ".join(paragraph.split())
            lines += [f"``{text.removeprefix('Example: ')}``" if text.startswith("Example: ") else text, ""]
        lines += [".. list-table::", "   :widths: 30 70", ""]
        for parameter in command.params:
            if parameter.name == "help":
                continue
            flags = " ".join(parameter.opts) if parameter.opts[0].startswith("-") else (parameter.name or "").upper()
            text = (getattr(parameter, "help", "") or "").replace("\\[", "[").replace("*", r"\*")
            lines += [f"   * - ``{flags}``", f"     - {text}"]
        parent = nodes.section()
        parent.document = self.state.document
        self.state.nested_parse(StringList([*lines, ""], source="command"), self.content_offset, parent)
        return parent.children


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("command-options", CommandOptions)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
