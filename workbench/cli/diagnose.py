"""`workbench diagnose`: where simulation and test disagree, and why."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from workbench.cli import options
from workbench.cli.terminal import (
    as_typed,
    by_options,
    check_target,
    guarded,
    names_in,
    print_result,
    reporting,
    say,
    short,
)
from workbench.cli.uncertain import write_verdict


@guarded
def diagnose(
    case: Annotated[Path | None, typer.Argument(help="Case folder: case.toml and its records.")] = None,
    nominal: Annotated[
        Path | None, typer.Option(help="In place of a case: a record at low level, whose linear model is the nominal.")
    ] = None,
    records: Annotated[list[Path] | None, typer.Option(help="With --nominal: a record to diagnose; repeat.")] = None,
    validation: Annotated[
        list[Path] | None, typer.Option(help="With --nominal: a record that is not fitted, to validate on; repeat.")
    ] = None,
    inputs: Annotated[str, typer.Option(metavar="NAME,NAME", help="With --nominal: channels that are inputs.")] = "",
    input_hold: options.InputHold = None,
    quantity: Annotated[
        str, typer.Option(help="With --nominal: displacement, velocity or acceleration, of outputs without one.")
    ] = "",
    driving_point: Annotated[
        str,
        typer.Option(metavar="INPUT,OUTPUT", help="With --nominal: an input and the output at its place, for scale."),
    ] = "",
    json_path: options.JsonPath = None,
    page: options.PagePath = None,
    uncertain_nominal: Annotated[
        bool,
        typer.Option("--uncertain-nominal", help="Re-estimate the nominal frequencies and damping with every effect."),
    ] = False,
    correct: Annotated[
        bool, typer.Option("--correct", help="Correct detected faults of wiring and units, and go on.")
    ] = False,
    uncorrected: Annotated[
        bool,
        typer.Option("--uncorrected", help="Go on in spite of faults of wiring and units, without correcting them."),
    ] = False,
    transient: Annotated[
        float, typer.Option(help="Time at the start of each record that is left out, where it starts in motion, s.")
    ] = 0.0,
    workers: options.Workers = None,
    seconds: Annotated[float, typer.Option(help="Processor time of the search, s; twice as long on one core.")] = 120.0,
) -> None:
    """Locate the gap between a simulation and a test, name the missing effect, and measure how far the gap closes.

    Example: workbench diagnose cases/arm --json verdict.json

    Example: workbench diagnose --nominal low.csv --records high.csv --inputs F --quantity acceleration
    """
    from workbench.cases.case import read_case
    from workbench.gap.diagnose_case import diagnose_case
    from workbench.gap.setup.corrections import without_faults
    from workbench.gap.setup.faults import setup_faults
    from workbench.gap.setup.record_checks import check_alive
    from workbench.gap.setup.records import check_disjoint
    from workbench.study.measured_case import measured_case
    from workbench.study.pages.verdict_page import verdict_page

    check_target(json_path, page=page)
    if (case is None) == (nominal is None):
        raise ValueError("give a case folder, or --nominal and --records; not both")
    if case is not None and input_hold is not None:
        raise ValueError("--input-hold is for --nominal; for a case set input_hold in case.toml")
    if nominal is not None:
        if not records:
            raise ValueError("--nominal needs at least one record to diagnose: give --records")
        found = measured_case(
            nominal,
            records,
            validation or (),
            inputs=names_in(inputs),
            input_hold=input_hold,
            quantity=quantity,
            driving_point=names_in(driving_point),
        )
    elif case is not None:
        found = read_case(case)
    check_alive(found.rig, found.fit, found.validation, transient=transient)
    check_disjoint(found.fit, found.validation)
    faults = setup_faults(found.rig, found.fit, found.validation, transient=transient)
    for fault in faults:
        say(f"  {'corrected' if correct and fault.certain else 'set-up'}     {fault.sentence}")
    if any(fault.certain for fault in faults) and not (correct or uncorrected):
        raise ValueError("diagnose again with --correct to correct these faults, or with --uncorrected to ignore them")
    if correct:
        rig, fit = without_faults(faults, found.rig, found.fit)
        found = replace(found, rig=rig, fit=fit, validation=without_faults(faults, found.rig, found.validation)[1])
    corrected = [f"Corrected before the diagnosis: {fault.sentence}" for fault in faults if correct and fault.certain]
    with reporting("reading") as report:
        verdict = diagnose_case(
            found,
            uncertain_nominal=uncertain_nominal,
            transient=transient,
            workers=workers,
            seconds=seconds,
            progress=report,
        )
    print_result(by_options(str(verdict)))
    verdict = replace(verdict, notes=(*corrected, *verdict.notes))
    if json_path is not None:
        write_verdict(verdict, json_path)
        say(f"  verdict    {short(json_path)}")
    verdict = replace(verdict, notes=tuple(map(by_options, verdict.notes)))
    target = verdict_page(verdict, found, page or Path("out") / f"{found.name}.html", folder=case, made_by=as_typed())
    say(f"  page       {short(target)}")
