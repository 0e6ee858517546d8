"""`workbench study`: run a study, or list them."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from workbench.cli.terminal import FAILURE, complain, console, errors, guarded, progress_bar, say, short, with_notes

if TYPE_CHECKING:
    from workbench.study.catalogue import StudyFile


@guarded
def study(
    name: Annotated[
        str | None, typer.Argument(help="Name of a study, or path of its script; without it, a list.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="File or folder that the study works on.")] = None,
    every: Annotated[
        bool,
        typer.Option("--all", help="Run every study in studies/ here, or every built-in one, that makes its own data."),
    ] = False,
    scheduler: Annotated[str | None, typer.Option(help="Dask scheduler that runs the cases: tcp://HOST:PORT.")] = None,
) -> None:
    """Run a study, or list them.

    Example: workbench study beam_control
    """
    from workbench.study.catalogue import find_study, list_studies

    if every and (name is not None or data is not None):
        raise ValueError(
            "--all runs every study that makes its own data; leave it out to run one by its name or with --data"
        )
    if name is None and not every:
        entries = list_studies()
        width = max((len(entry.name) for entry in entries), default=0)
        for entry in entries:
            needs = f" (needs --data: {entry.needs_data})" if entry.needs_data else ""
            about = f"cannot be run: {entry.fault}" if entry.fault else f"{entry.question}{needs}"
            say(f"{entry.name:<{width}}  {about}")
        return
    if name is None:
        chosen = [entry for entry in list_studies(here_first=True) if entry.defined and not entry.needs_data]
    else:
        chosen = [find_study(name)]
    succeeded = []
    for entry in chosen:
        try:
            succeeded.append(_run(entry, data, scheduler))
        except Exception as error:  # a failed study does not stop the others
            if len(chosen) == 1:
                raise
            complain(f"{entry.name}: {type(error).__name__}: {with_notes(error)}")
            succeeded.append(False)
    if not all(succeeded):
        raise typer.Exit(FAILURE)


def _run(found: "StudyFile", data: Path | None, scheduler: str | None) -> bool:
    """Run a study; returns whether every case ran and every check holds."""
    from workbench.study.catalogue import output_root, run_study
    from workbench.study.runs.outcome import Outcome

    if found.fault:
        complain(found.fault)
        return False

    root = output_root(found)
    with progress_bar() as progress:
        cases = progress.add_task("cases", total=1.0, visible=False)

        def track(items: Iterable[Any], what: str) -> Iterator[Any]:
            yield from progress.track(items, description=what)

        outcome = Outcome(
            name=found.name,
            title=found.question,
            figures_folder=root / "figures",
            # on a terminal a line goes to stderr, which the progress bar shares
            on_say=lambda text: (errors if console.is_terminal else console).print(f"  {text}"),
            on_track=track,
            on_report=lambda text, share: progress.update(cases, description=text, completed=share, visible=True),
            cache=root / "out" / "cache",
            scheduler=scheduler,
        )
        say(found.question, bold=True)
        result, page = run_study(found, data, outcome, root)
    failed = [check for check in outcome.checks if not check["holds"]]
    say(f"  {len(outcome.checks) - len(failed)} of {len(outcome.checks)} checks hold")
    for check in failed:
        say(f"  does not hold: {check['name']}: {check['value']} against {check['limit']}")
    broken = {name: results.failed for name, results in outcome.runs.items() if results.failed}
    for name, results in broken.items():
        say(f"  {len(results)} of {len(outcome.runs[name])} {name} failed; the first:")
        say(f"    {dict(results[0].parameters)}: {results[0].error}")
    for name in outcome.runs:
        say(f"  table   {short(root / 'out' / f'{found.name}-{name}.csv')}")
    for _, path, caption in outcome.figures:
        say(f"  figure  {short(path)}  {caption}")
    say(f"  results {short(result)}\n  page    {short(page)}")
    return not failed and not broken
