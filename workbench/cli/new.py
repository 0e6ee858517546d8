"""`workbench new`: a commented template of a case or a study."""

import shlex
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from workbench.cli.terminal import guarded, say, short


class What(StrEnum):
    """What there is a template of."""

    CASE = "case"
    STUDY = "study"


@guarded
def new(
    what: Annotated[What, typer.Argument(help="Which template.")],
    name: Annotated[str, typer.Argument(help="Folder of the case, or name of the study.")],
) -> None:
    """Write a commented template: a case folder, or a study in studies/.

    Example: workbench new case arm
    """
    from workbench.study.templates import new_case, new_study

    if not name.strip():
        raise ValueError(f"the name of the {what.value} is empty; give one, as in: workbench new {what.value} arm")
    typed = shlex.quote(name)
    if what is What.CASE:
        path = new_case(Path(name))
        say(f"{short(path)}\n  records go into {short(path.parent / 'records')}/; then: workbench diagnose {typed}")
    else:
        path = new_study(name, Path("studies"))
        say(f"{short(path)}\n  run it: workbench study {typed}")
