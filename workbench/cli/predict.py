"""`workbench predict`: the readings of the next test of a case, with prediction bands."""

from pathlib import Path

from workbench.cli import options
from workbench.cli.terminal import as_typed, check_target, guarded, print_result, reporting, say, short, write_json
from workbench.cli.uncertain import predicted, record_of


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
    """Predict the readings of a test to come, with bands that hold 95 % of them over time and by frequency.

    Example: workbench predict cases/arm planned.csv --verdict verdict.json
    """
    from workbench.cases.case import read_case
    from workbench.study.pages.prediction_page import prediction_page

    check_target(json_path)
    found = read_case(case)
    planned = record_of(found, record, sample_rate_hz)
    with reporting("reading") as report:
        prediction = predicted(found, planned, verdict, draws=draws, seed=seed, workers=workers, report=report)
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
