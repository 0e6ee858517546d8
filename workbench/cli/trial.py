"""`workbench trial`: blind trials of the diagnosis on the user's own rig."""

from pathlib import Path
from typing import Annotated

import typer

from workbench.cli import options
from workbench.cli.terminal import check_target, guarded, reporting, say, short, write_json


@guarded
def trial(
    case: Annotated[Path, typer.Argument(help="Case folder: its rig, sensors, levels and noise are used.")],
    cases: Annotated[int, typer.Option(help="Number of blind cases to make, diagnose and score.")] = 30,
    seed: Annotated[int, typer.Option(help="Seed of the random cases.")] = 0,
    json_path: options.JsonPath = None,
    picture: Annotated[
        Path, typer.Option("--figure", help="File of the figure: each true effect, and how often it is named.")
    ] = Path("out/trial.png"),
) -> None:
    """Score the diagnosis on blind cases of your own rig: made, diagnosed, and only then compared with the truth.

    Example: workbench trial cases/arm --cases 40
    """
    from workbench.cases.case import read_case
    from workbench.draw.trials import plot_confusion
    from workbench.trials.hold import hold_trials

    check_target(json_path, figure=picture)
    if cases < 1:
        raise ValueError(f"--cases must be at least 1; got {cases}")
    found = read_case(case)
    with reporting("making cases") as report:
        held = hold_trials(cases, seed, like=found, report=report)
    for family, (right, of) in held.statistics.shares.items():
        say(f"  {family:<8} {right} of {of} named correctly")
    say(f"  places   {held.statistics.misplaced} of {held.statistics.placed} more than 2 % of the length off")
    for name, one in held.scores.items():
        if not one["kinds"]:
            say(f"  {name}: true {one['hidden']}, diagnosed {one['diagnosed']}")
    picture.parent.mkdir(parents=True, exist_ok=True)
    plot_confusion(held.statistics).savefig(picture)
    write_json(json_path, {"labels": held.labels, "verdicts": held.verdicts, "scores": held.scores})
    say(f"  figure   {short(picture)}")
