"""`workbench export`: a controller of a case as a step function in C or Python, or as a MAT file."""

from pathlib import Path
from typing import Annotated

import typer

from workbench.cli.rig_file import RigPath, Weight
from workbench.cli.terminal import guarded, say, short

LAWS, ESTIMATORS = ("imsc", "coupled"), ("luenberger", "kalman")


@guarded
def export(
    rig: RigPath,
    rate_hz: Annotated[float, typer.Option(help="Sampling rate at which the controller is to run.")],
    to: Annotated[Path, typer.Option(metavar="FILE", help="File to write: NAME.c (with NAME.h), NAME.py or NAME.mat.")],
    control: Annotated[
        int | None, typer.Option(help="Number of controlled modes, lowest first; as many as actuators unless given.")
    ] = None,
    weight: Weight = 1.0,
    law: Annotated[str, typer.Option(metavar="|".join(LAWS), help="Control law.")] = LAWS[0],
    estimator: Annotated[
        str, typer.Option(metavar="|".join(ESTIMATORS), help="Observer that the law acts on.")
    ] = ESTIMATORS[0],
    disturbance: Annotated[
        float,
        typer.Option(help="For the Kalman filter: intensity of white modal forces; noise is as the outputs state it."),
    ] = 1.0,
    computing_delay_ms: Annotated[
        float, typer.Option(help="From a reading to the first effect of its command, beside the actuators' delays.")
    ] = 0.0,
) -> None:
    """Write a controller as a step function in C or Python, or as a MAT file, at the rate of its computer.

    The loop of all modes is checked with sampling and delay in it; a rate that is too slow is refused.

    Example: workbench export case.toml --control 2 --rate-hz 500 --computing-delay-ms 0.5 --to controller.c
    """
    from workbench.cases.case import read_rig
    from workbench.design.estimation.observers import kalman, luenberger
    from workbench.design.export.export import export as hand_over
    from workbench.design.laws.coupled import coupled_lqr
    from workbench.design.laws.imsc import imsc
    from workbench.design.spillover.comparison import OBSERVER_POLES
    from workbench.rig.sensors import MEASURED
    from workbench.study.whole_file import check_target

    for option, value, known in (("--law", law, LAWS), ("--estimator", estimator, ESTIMATORS)):
        if value not in known:
            raise ValueError(f"{option} is one of {', '.join(known)}; got {value!r}")
    check_target(to)
    found = read_rig(rig / "case.toml" if rig.is_dir() else rig)
    modes, actuators = found.modes, [a for a in found.actuators if not a.direct]
    count = len(actuators) if control is None else control
    sensors = [s for s in found.sensors if MEASURED[s.quantity][1] < 2]
    unread = [s.name for s in found.sensors if s not in sensors]
    if not sensors:
        raise ValueError(f"{rig}: every output is an acceleration; an observer needs motion or rates, so add a sensor")
    made = (imsc if law == "imsc" else coupled_lqr)(modes, count, actuators, weight=weight)
    if estimator == "luenberger":
        observer = luenberger(modes, made, sensors, poles=OBSERVER_POLES * modes.omega[:count])
    else:
        # a noise of variance σ² held over each sample has the intensity σ² T
        noise = [s.noise_std**2 / rate_hz if rate_hz > 0 else 0.0 for s in sensors]
        observer = kalman(modes, made, sensors, disturbance=disturbance, noise=noise)
    design = hand_over(modes, observer, to, sample_rate_hz=rate_hz, computing_delay=1e-3 * computing_delay_ms)
    head, *rest = str(design).splitlines()
    say(head, bold=True)
    for line in rest:
        say(line)
    if unread:
        say(f"  not read, as accelerations: {', '.join(unread)}")
    say(f"  written to {short(to)}" + (f" and {short(to.with_suffix('.h'))}" if to.suffix == ".c" else ""))
