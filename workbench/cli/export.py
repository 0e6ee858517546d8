"""`workbench export`: a controller of a case as a step function in C or Python, or as a MAT file."""

from pathlib import Path
from typing import Annotated

import typer

from workbench.cli import options
from workbench.cli.design_options import check_rate, count_of, damping_by, law_from, observed, read_rig_and_units
from workbench.cli.terminal import check_target, guarded, print_result, say, short


@guarded
def export(
    rig: options.RigPath,
    rate_hz: Annotated[float, typer.Option(help="Sampling rate of the controller, Hz.")],
    to: Annotated[
        Path,
        typer.Option(
            metavar="FILE", help="File to write: NAME.c (with NAME.h), NAME.py or NAME.mat; NAME of letters, digits, _."
        ),
    ],
    law: options.LinearLawName = "imsc",
    control: options.Control = None,
    weight: options.LawWeight = None,
    damping: options.Damping = None,
    estimator: Annotated[
        str, typer.Option(metavar="|".join(options.ESTIMATORS), help="Observer or modal filter that the law acts on.")
    ] = options.ESTIMATORS[0],
    disturbance: options.Disturbance = 1.0,
    computing_delay_ms: Annotated[
        float,
        typer.Option(help="Computation delay from a reading to its command, ms, in addition to the actuators' delays."),
    ] = 0.0,
) -> None:
    """Write a controller as a step function in C or Python, or as a MAT file, at the rate of its computer.

    The loop of all modes is checked with sampling and delay in it; a rate that is too slow is refused.

    Example: workbench export case.toml --controlled-modes 2 --damping 0.05 --rate-hz 500 --to controller.c
    """
    from workbench.design.export.export import export as export_controller
    from workbench.rig.sensors import MEASURED

    check_target(to)
    check_rate(rate_hz)
    found, units = read_rig_and_units(rig)
    chosen = law_from(found, law, count_of(found, control), weight, damping)
    unread = [s.name for s in found.sensors if MEASURED[s.quantity][1] > 1]
    observer = observed(found, chosen, estimator, disturbance=disturbance, sample_time=1.0 / rate_hz)
    delay = 1e-3 * computing_delay_ms
    design = export_controller(found.modes, observer, to, sample_rate_hz=rate_hz, computing_delay=delay, units=units)
    print_result(design)
    say(f"  {damping_by(found.modes, chosen)}")
    if unread:
        say(f"  not used (accelerations): {', '.join(unread)}")
    say(f"  written to {short(to)}" + (f" and {short(to.with_suffix('.h'))}" if to.suffix == ".c" else ""))
