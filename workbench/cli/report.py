"""`workbench report`: a page about a study, a case or a result."""

from pathlib import Path
from typing import Annotated

import typer

from workbench.cli import options
from workbench.cli.terminal import check_target, guarded, say, short


@guarded
def report(
    what: Annotated[
        str, typer.Argument(help="JSON file written by this command, a case folder, or a study that has run.")
    ],
    page: options.PagePath = None,
) -> None:
    """Write one self-contained page about a study, a case or a result: figures to zoom, animated shapes, no network.

    Example: workbench report verdict.json
    """
    from workbench.study.pages.page import write_page
    from workbench.study.report import page_content_about

    check_target(page=page)
    name, page_content = page_content_about(what)
    say(page_content.title, bold=True)
    for line in (*filter(None, [page_content.lead]), *page_content.lines):
        say(f"  {line}")
    target = write_page(page or Path("out") / f"{name}.html", page_content)
    say(f"  page  {short(target)}")
    say(f"  data  {short(target.with_suffix('.page.json'))}")
