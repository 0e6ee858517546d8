"""`workbench predict`: the readings of the next test of a case, with prediction bands."""

from pathlib import Path
from typing import TYPE_CHECKING

from workbench.cli import options
from workbench.cli.terminal import (
    as_typed,
    check_target,
    guarded,
    print_result,
    reporting,
    say,
    short,
    sub_progress,
    write_json,
)
from workbench.cli.uncertain import uncertain_rig
from workbench.records.record import Record

if TYPE_CHECKING:
    from workbench.cases.case import Case
    from workbench.robust.prediction import Prediction


@guarded
def predict(
    case: options.CasePath,
    record: options.RecordName,
    verdict: options.VerdictPath = None,
    sample_rate_hz: options.SampleRate = None,
    draws: options.Draws = 200,
    seed: options.Seed = 0,
    workers: options.Workers = None,
    json_path: options.JsonPath = None,
    page: options.PagePath = None,
) -> None:
    """Predict the readings of a test to come, with bands that contain 95 % of them over time and by frequency.

    Example: workbench predict cases/arm planned.csv --verdict verdict.json
    """
    from workbench.cases.case import read_case
    from workbench.study.pages.prediction_page import prediction_page

    check_target(json_path, page=page)
    found = read_case(case)
    planned = record_of(found, record, sample_rate_hz)
    prediction = predicted(found, planned, verdict, draws=draws, seed=seed, workers=workers)
    print_result(prediction)
    write_json(
        json_path,
        {
            "record": prediction.name,
            "sensors": [channel.name for channel in prediction.channels],
            **{name: getattr(prediction, name) for name in ("time", "lower", "median", "upper", "frequencies_hz")},
            **{f"spectrum_{name}": getattr(prediction, f"spectrum_{name}") for name in ("lower", "median", "upper")},
            "notes": prediction.notes,
        },
    )
    target = page or Path("out") / f"{found.name}-prediction.html"
    say(f"  page       {short(prediction_page(prediction, target, name=found.name, folder=case, made_by=as_typed()))}")


def predicted(
    case: "Case", record: Record, verdict: Path | None, *, draws: int, seed: int, workers: int | None
) -> "Prediction":
    """The prediction of a record by the corrected rig, with bands from its uncertainty."""
    from workbench.robust.prediction import check_draws
    from workbench.robust.prediction import predict as predict_record

    check_draws(draws)  # before the diagnosis
    with reporting("reading") as report:
        uncertain, noise = uncertain_rig(case, verdict, workers=workers, report=sub_progress(report, 0.0, 0.7))
        progress = sub_progress(report, 0.7, 1.0)
        return predict_record(
            uncertain, record, noise_std=noise, draws=draws, seed=seed, units=case.units, progress=progress
        )


def record_of(case: "Case", name: str, sample_rate_hz: float | None) -> Record:
    """A record of the case by name, or a file with columns named as the case's inputs and outputs, in its units."""
    from workbench.cases.case import check_units
    from workbench.records.files import read_record

    own = {record.name: record for record in (*case.fit, *case.validation)}
    if name in own:
        return own[name]
    if not Path(name).is_file():
        raise ValueError(f"{name!r} is neither a file nor a record of the case, which are {', '.join(own)}")
    read = read_record(name, sample_rate_hz=sample_rate_hz, units=case.units)
    known = [channel for _, channel, _ in case.fit[0].signals()]
    check_units(Path(name), known, {channel.name: channel.unit for _, channel, _ in read.signals()})
    return read.with_inputs([actuator.name for actuator in case.rig.actuators])
