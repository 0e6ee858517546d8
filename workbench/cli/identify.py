"""`workbench identify`: the modes of measured records."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from workbench.cli import options
from workbench.cli.terminal import (
    as_typed,
    by_options,
    check_target,
    guarded,
    names_in,
    reporting,
    say,
    short,
    show_table,
    write_json,
)


@guarded
def identify(
    records: Annotated[
        list[Path], typer.Argument(help="Files of the same sensors: .csv, .txt, .npz, .mat, .h5, .uff, .tdms, .wav.")
    ],
    modes: Annotated[int | None, typer.Option(help="Number of modes; estimated unless given.")] = None,
    sample_rate_hz: options.SampleRate = None,
    start: Annotated[
        float | None, typer.Option(help="Time at which the free decay begins, s; detected unless given.")
    ] = None,
    inputs: Annotated[
        str,
        typer.Option(
            metavar="NAME,NAME",
            help='Measured inputs: identify from inputs and outputs; "A, B" where a name holds a comma.',
        ),
    ] = "",
    input_hold: options.InputHold = None,
    ambient: Annotated[
        bool, typer.Option("--ambient", help="Output-only: unknown broadband forces act throughout.")
    ] = False,
    outputs: Annotated[
        str,
        typer.Option(metavar="NAME,NAME", help='Outputs to use; all unless given; "A, B" where a name holds a comma.'),
    ] = "",
    band_hz: Annotated[
        tuple[float, float] | None, typer.Option(metavar="LOW HIGH", help="Frequency band of FRFs to fit.")
    ] = None,
    seconds: Annotated[float, typer.Option(help="Processor time of the search, s.")] = 30.0,
    memory: options.Memory = 1.0,
    page: Annotated[
        Path | None,
        typer.Option("--page", help="HTML file to write: shapes, MAC, stabilisation diagram, frequency response."),
    ] = None,
    json_path: options.JsonPath = None,
) -> None:
    """Identify modes from free decays, driven or ambient records, or FRFs, with standard errors.

    Example: workbench identify ringdown.csv --outputs a,b --json modes.json
    """
    from workbench.identification.signal.modal_estimates import HEADINGS
    from workbench.records.files import named_by_file, read_measured
    from workbench.records.limits import ReadLimits
    from workbench.study.pages.identification_report import identification_report

    check_target(json_path, page=page)
    limits = ReadLimits.of_gib(memory)
    with reporting("reading") as report:
        channels: Any = {"inputs": names_in(inputs), "outputs": names_in(outputs), "input_hold": input_hold}
        read = [
            named_by_file(read_measured(path, sample_rate_hz=sample_rate_hz, limits=limits, **channels), path)
            for path in records
        ]
        if input_hold is not None and not any(getattr(measured, "n_inputs", 0) for measured in read):
            raise ValueError("--input-hold is for records with inputs: name them by --inputs, or leave it out")
        found = identification_report(
            read, start=start, n_modes=modes, ambient=ambient, band_hz=band_hz, seconds=seconds, progress=report
        )
    as_read = dict.fromkeys(remark for measured in read for remark in getattr(measured, "remarks", ()))
    lines = (*found.lines, *(f"as read: {remark}" for remark in as_read))
    found = replace(found, lines=tuple(map(by_options, lines)))
    say(found.heading, bold=True)
    show_table(HEADINGS, found.rows, right=[heading for heading in HEADINGS if "[" in heading])
    for line in found.lines:
        say(f"  {line}")
    if page is not None:
        from workbench.study.pages.page import write_page
        from workbench.study.report import identification_page

        shown = identification_page(found, read, made_by=as_typed())
        say(f"  page {short(write_page(page, shown))}")
    write_json(json_path, {**found.content, "heading": found.heading, "lines": found.lines})
