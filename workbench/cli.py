"""The `workbench` command: thin; it prints, shows progress, and turns bad input into one clear line."""

import json
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

BAD_INPUT, FAILURE = 2, 1

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="From the measured response of a flexible structure to a controlled one, and a diagnosis of the gap between"
    " simulation and test.",
)
console = Console(soft_wrap=True, highlight=False)
errors = Console(stderr=True, soft_wrap=True, highlight=False)


def _guarded(command: Callable) -> Callable:
    """Bad input ends in one line and exit code 2, anything unforeseen in one line and exit code 1."""

    @wraps(command)
    def guarded(*args, **kwargs):
        try:
            return command(*args, **kwargs)
        except typer.Exit:
            raise
        except (ValueError, OSError, MemoryError) as error:
            errors.print(f"workbench: {error}", style="red", markup=False)
            raise typer.Exit(BAD_INPUT) from None
        except KeyboardInterrupt:
            errors.print("workbench: interrupted", style="red", markup=False)
            raise typer.Exit(FAILURE) from None
        except Exception as error:
            errors.print(f"workbench: {type(error).__name__}: {error}", style="red", markup=False)
            raise typer.Exit(FAILURE) from None

    return guarded


def _progress() -> Progress:
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        console=errors,
        transient=True,
        disable=not errors.is_terminal,
    )


@app.command()
@_guarded
def study(
    name: Annotated[
        str | None, typer.Argument(help="Name of a study, or path of its script; without it, a list.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="File or folder that the study works on.")] = None,
) -> None:
    """Run a study, or list them.

    Example: workbench study beam_control
    """
    from workbench.study.catalogue import find_study, list_studies, run_study
    from workbench.study.outcome import Outcome

    if name is None:
        table = Table(box=None, show_header=False, pad_edge=False)
        for entry in list_studies():
            table.add_row(entry.name, entry.question + (" [needs --data]" if entry.needs_data else ""))
        console.print(table)
        return
    found = find_study(name)
    with _progress() as progress:

        def track(iterable, what):
            yield from progress.track(iterable, description=what, total=len(iterable))

        outcome = Outcome(
            name=found.name,
            title=found.question,
            figures_folder=found.path.resolve().parent.parent / "figures",
            on_say=lambda text: console.print(f"  {text}", markup=False),
            on_track=track,
        )
        console.print(found.question, style="bold", markup=False)
        result, page = run_study(found, data, outcome, found.path.resolve().parent.parent)
    failed = [check for check in outcome.checks if not check["holds"]]
    console.print(f"  {len(outcome.checks) - len(failed)} of {len(outcome.checks)} checks hold")
    for check in failed:
        console.print(f"  does not hold: {check['name']}: {check['value']} against {check['limit']}", markup=False)
    for _, path, caption in outcome.figures:
        console.print(f"  figure  {_short(path)}  {caption}", markup=False)
    console.print(f"  results {_short(result)}\n  page    {_short(page)}", markup=False)
    if failed:
        raise typer.Exit(FAILURE)


@app.command()
@_guarded
def diagnose(
    case: Annotated[Path, typer.Argument(help="Case folder: case.toml and its records.")],
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the verdict here as JSON.")] = None,
    page: Annotated[Path | None, typer.Option(help="Write the page here; default out/CASE.html.")] = None,
) -> None:
    """Say where a simulation and a test disagree, which effect is missing, and how far the gap then shrinks.

    Example: workbench diagnose cases/arm --json verdict.json
    """
    from workbench.gap.case import read_case
    from workbench.gap.diagnose import diagnose as run
    from workbench.study.verdict_page import verdict_page

    found = read_case(case)
    with _progress() as progress:
        task = progress.add_task("reading", total=1.0)
        verdict = run(
            found.rig,
            found.fit,
            validation=found.validation,
            name=found.name,
            report=lambda text, share: progress.update(task, description=text, completed=share),
        )
    console.print(verdict.sentence, style="bold", markup=False)
    shown = verdict.to_json()
    where = verdict.where
    console.print(
        f"  path       {where.path}; {'depends' if where.amplitude_dependent else 'does not depend'} on level"
    )
    console.print(f"  modes      {', '.join(map(str, where.modes)) or 'none'}")
    after, floor = shown["gap"]["after"], shown["gap"]["floor"]
    for name, before in shown["gap"]["before"].items():
        console.print(f"  {name:<10} gap {before:.4g} → {after[name]:.4g}, floor {floor[name]:.4g}")
    for label, probability in verdict.alternatives[:3]:
        console.print(f"  rival      {label} ({probability:.2g})", markup=False)
    for note in verdict.notes:
        console.print(f"  {note}", markup=False)
    target = verdict_page(verdict, found, page or Path("out") / f"{found.name}.html")
    if json_path is not None:
        json_path.write_text(json.dumps(shown, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        console.print(f"  verdict    {_short(json_path)}", markup=False)
    console.print(f"  page       {_short(target)}", markup=False)


def _short(path: Path) -> str:
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def main() -> None:
    """Entry point of the command."""
    app()


if __name__ == "__main__":
    sys.exit(main())
