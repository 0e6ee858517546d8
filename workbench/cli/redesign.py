"""`workbench redesign`: the controller for the real structure."""

from pathlib import Path
from typing import Annotated

import typer

from workbench.cli import options
from workbench.cli.design_options import check_rate, count_of, damping_by, impulse_place, law_from, observed
from workbench.cli.terminal import (
    as_typed,
    check_target,
    guarded,
    reporting,
    say,
    short,
    show_table,
    sub_progress,
    write_json,
)
from workbench.cli.uncertain import uncertain_rig


@guarded
def redesign(
    case: options.CasePath,
    verdict: options.VerdictPath = None,
    law: options.LawName = "imsc",
    control: options.Control = None,
    weight: options.LawWeight = None,
    damping: options.Damping = None,
    estimator: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(options.ESTIMATORS),
            help="Estimator in use; a Kalman filter tuned to the law unless given.",
        ),
    ] = None,
    disturbance: options.Disturbance = 1.0,
    rate_hz: Annotated[
        float | None, typer.Option("--rate-hz", help="Rate of the controller; that of the records unless given.")
    ] = None,
    impulse_at: options.ImpulseAt = None,
    criterion: Annotated[
        str | None,
        typer.Option(
            "--criterion",
            "--aim",
            metavar="cost|settling",
            help="Criterion of the comparison: the cost of the LQR, or settling time and effort; by the law's kind"
            " unless given.",
        ),
    ] = None,
    max_cost_increase: Annotated[
        float, typer.Option(help="Share by which a new controller that settles sooner may cost more than the present.")
    ] = 0.01,
    max_work_increase: Annotated[
        float, typer.Option(help="Share by which that controller may do more work; unlimited unless given.")
    ] = float("inf"),
    draws: Annotated[
        int,
        typer.Option(min=1, max=10_000, help="Draws of the uncertain model on which both controllers are verified."),
    ] = 200,
    seed: options.Seed = 0,
    workers: options.Workers = None,
    to: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The controller to use: NAME.c (with NAME.h), NAME.py or NAME.mat."),
    ] = None,
    json_path: options.JsonPath = None,
    page: options.PagePath = None,
) -> None:
    """Redesign the controller on the model that a diagnosis corrected, and verify both over its uncertainty.

    The options of `workbench export` say which controller is in use; it is designed for the nominal model.

    Example: workbench redesign cases/arm --verdict verdict.json --controlled-modes 2 --damping 0.05 --to controller.c
    """
    import numpy as np

    from workbench.cases.case import read_case
    from workbench.design.export.export import check_name
    from workbench.design.laws.law import controlled_indices
    from workbench.robust.impulse import impulse_test
    from workbench.robust.on_rig import Design
    from workbench.robust.redesign import CRITERIA
    from workbench.robust.redesign import redesign as run
    from workbench.robust.steps import LOSS
    from workbench.study.pages.redesign_page import redesign_page

    check_target(json_path, to, page=page)
    if to is not None:
        check_name(to)
    if criterion not in (None, *CRITERIA):
        raise ValueError(f"--criterion is {' or '.join(CRITERIA)}; got {criterion!r}")
    check_rate(rate_hz)
    found = read_case(case)
    rig, records = found.rig, (*found.fit, *found.validation)
    count = count_of(rig, control)
    controlled = controlled_indices(rig.modes, count)
    impulse_point = None if impulse_at is None else impulse_place(rig, impulse_at)
    sample_time = records[0].sample_time if rate_hz is None else 1.0 / rate_hz
    level = np.max([np.abs(record.outputs).max(axis=1) for record in records], axis=0)
    test = impulse_test(rig, controlled, sample_time, impulse_point, level=level, seed=seed)
    own = law_from(rig, law, count, weight, damping, impulse_at=test.impulse_at, impulse=test.impulse)
    in_use: Design = own
    if estimator is not None:
        in_use = observed(rig, own, estimator, disturbance=disturbance, sample_time=sample_time)
    with reporting("reading") as report:
        uncertain, _ = uncertain_rig(found, verdict, workers=workers, report=sub_progress(report, 0.0, 0.7))
        result = run(
            uncertain,
            in_use,
            test=test,
            draws=draws,
            seed=seed,
            criterion=criterion,
            max_cost_increase=max_cost_increase,
            max_work_increase=max_work_increase,
            units=found.units,
            progress=sub_progress(report, 0.7, 1.0),
        )
    say(f"{result.advice} {result.guarantee}".rstrip(), bold=True)
    say(result.comparison)
    say(f"  in use: {damping_by(rig.modes, own)}")
    if test.impulse_at is not None:
        size, where = f"{test.impulse:.3g} {found.units.named('N s')}", rig.modes.domain.text(test.impulse_at, 4)
        say(f"  test: an impulse of {size} at {where}, which moves the structure as far as the records did")
    steps = [(step.name, step.what, step.lost, step.in_new_controller) for step in result.steps]
    show_table(("step", "change", "performance loss", "in the new controller"), steps)
    say(f"  {LOSS}")
    if result.relocation is not None:
        say(f"  {result.relocation.sentence}")
    for note in result.notes:
        say(f"  {note}")
    write_json(json_path, result.to_json())
    if to is not None:
        names = " and ".join(short(path) for path in result.export(to))
        say(f"  controller {names}: {'the redesigned one' if result.improves else 'the present one, which is kept'}")
    target = page or Path("out") / f"{found.name}-redesign.html"
    shown = (found.validation or found.fit)[0]
    target = redesign_page(result, target, name=found.name, record=shown, folder=case, made_by=as_typed())
    say(f"  page       {short(target)}")
