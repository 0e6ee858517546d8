"""`workbench look`: what a measured file holds."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from workbench.cli import options
from workbench.cli.terminal import as_typed, by_options, check_target, guarded, names_in, say, short, show_table


@guarded
def look(
    file: Annotated[Path, typer.Argument(help="Measured file: .csv, .txt, .npz, .mat, .h5, .uff, ...")],
    sample_rate_hz: options.SampleRate = None,
    inputs: Annotated[
        str, typer.Option(metavar="NAME,NAME", help='Channels that are inputs; "A, B" where a name holds a comma.')
    ] = "",
    memory: options.Memory = 1.0,
    page: options.PagePath = None,
) -> None:
    """Show what a measured file holds: channels, rate, length, levels, spectrum, faults, and the command to go on with.

    Example: workbench look ringdown.csv
    """
    from workbench.records.files import named_by_file, read_measured
    from workbench.records.limits import ReadLimits
    from workbench.study.pages.look import HEADINGS, file_report
    from workbench.study.pages.page import write_page

    check_target(page=page)
    measured = read_measured(
        file, sample_rate_hz=sample_rate_hz, inputs=names_in(inputs), limits=ReadLimits.of_gib(memory)
    )
    seen = file_report(named_by_file(measured, file), file)
    shown = replace(seen.page_content, made_by=as_typed())
    say(seen.heading, bold=True)
    show_table(HEADINGS, seen.rows, right=HEADINGS[2:])
    for remark in seen.remarks:
        say(f"  {by_options(remark)}")
    say(f"  page     {short(write_page(page or Path('out') / f'{file.stem}.html', shown))}")
    command = seen.command + (f" --sample-rate-hz {sample_rate_hz:g}" if sample_rate_hz else "")
    say(f"  go on    {command}")
