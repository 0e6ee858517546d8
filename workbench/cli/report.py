"""`workbench report`: a page about a study, a case or a result."""

from pathlib import Path
from typing import Annotated

import typer

from workbench.cli.terminal import PagePath, guarded, say, short


@guarded
def report(
    what: Annotated[
        str, typer.Argument(help="JSON file written by this command, a case folder, or a study that has run.")
    ],
    page: PagePath = None,
) -> None:
    """Write one self-contained page about a study, a case or a result: zooming figures, moving shapes, no network.

    Example: workbench report verdict.json
    """
    from workbench.study.page import write_page
    from workbench.study.report import story_about

    name, story = story_about(what)
    say(story.title, bold=True)
    for line in (*filter(None, [story.lead]), *story.lines):
        say(f"  {line}")
    target = write_page(page or Path("out") / f"{name}.html", story)
    say(f"  page  {short(target)}")
    say(f"  data  {short(target.with_suffix('.page.json'))}")
