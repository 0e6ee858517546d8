"""`workbench check`: whether a new test of a case agrees with the prediction of its model."""

from pathlib import Path
from typing import Annotated

import typer

from workbench.cli import options
from workbench.cli.predict import predicted, record_of
from workbench.cli.terminal import as_typed, check_target, guarded, print_result, say, short, write_json

LOG = "tests.csv"


@guarded
def check(
    case: options.CasePath,
    record: options.RecordName,
    verdict: options.VerdictPath = None,
    sample_rate_hz: options.SampleRate = None,
    draws: options.Draws = 200,
    seed: options.Seed = 0,
    workers: options.Workers = None,
    log: Annotated[Path | None, typer.Option(help=f"Log of tests; CASE/{LOG} unless given.")] = None,
    json_path: options.JsonPath = None,
    page: options.PagePath = None,
) -> None:
    """Check whether a new record lies inside the bands that the corrected model predicts, and log it.

    Example: workbench check cases/arm friday.csv --verdict verdict.json
    """
    from workbench.cases.case import read_case
    from workbench.robust.check import check_length, check_prediction, log_test, read_log
    from workbench.study.pages.prediction_page import prediction_page

    check_target(json_path, log, page=page)
    log = case / LOG if log is None else log
    read_log(log)  # an invalid log is refused before the computation
    found = read_case(case)
    measured = record_of(found, record, sample_rate_hz)
    check_length(measured)
    fitted = [one.name for one in found.fit if measured.repeats(one)]
    if fitted:
        raise ValueError(f"record {fitted[0]!r} was fitted, so it is no test of the model; give another record")
    prediction = predicted(found, measured, verdict, draws=draws, seed=seed, workers=workers)
    result = check_prediction(prediction, measured)
    print_result(result)
    for note in prediction.notes:
        say(note)
    log_test(log, result)
    tests = {test["record"]: test for test in read_log(log)}  # the last check of each record
    held = sum(test["holds"] == "yes" for test in tests.values())
    say(f"  log        {short(log)}: the model is validated on {held} of {len(tests)} tests")
    write_json(
        json_path,
        {
            "record": result.name,
            "holds": result.holds,
            "sentence": result.sentence,
            "probability": result.probability,
            "coverage": dict(zip(result.sensors, result.coverage)),
            "bands_hz": result.bands_hz,
            "band_coverage": dict(zip(result.sensors, result.band_coverage)),
            "expected_least": result.expected_least,
            "expected_least_in_bands": result.expected_least_in_bands,
        },
    )
    target = page or Path("out") / f"{found.name}-check.html"
    shown = prediction_page(
        prediction, target, name=found.name, folder=case, check=result, measured=measured, made_by=as_typed()
    )
    say(f"  page       {short(shown)}")
