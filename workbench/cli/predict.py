"""`workbench predict`: what the next test of a case will show, with bands."""

from pathlib import Path
from typing import Annotated

import typer

from workbench.cli.possible import CasePath, VerdictPath, Workers, predicted, record_of
from workbench.cli.terminal import JsonPath, PagePath, guarded, progress_bar, reporter, say, short, write_json

RecordName = Annotated[
    str, typer.Argument(metavar="RECORD", help="File with a column for each input, or a record of the case by name.")
]
Rate = Annotated[float | None, typer.Option(help="Sampling rate, where the file has no time axis.")]
Draws = Annotated[int, typer.Option(min=1, help="Samples of the uncertain model from which the bands are computed.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the samples and of the noise.")]


@guarded
def predict(
    case: CasePath,
    record: RecordName,
    verdict: VerdictPath = None,
    sample_rate_hz: Rate = None,
    draws: Draws = 200,
    seed: Seed = 0,
    workers: Workers = None,
    json_path: JsonPath = None,
    page: PagePath = None,
) -> None:
    """Predict the readings of a test to come, with bands that hold 95 % of them over time and by frequency.

    Example: workbench predict cases/arm planned.csv --verdict verdict.json
    """
    from workbench.cases.case import read_case
    from workbench.study.pages.prediction_page import prediction_page
    from workbench.study.runs.whole_file import check_target

    check_target(json_path)
    found = read_case(case)
    planned = record_of(found, record, sample_rate_hz)
    with progress_bar() as progress:
        report = reporter(progress, "reading")
        prediction = predicted(found, planned, verdict, draws=draws, seed=seed, workers=workers, report=report)
    head, *rest = str(prediction).splitlines()
    say(head, bold=True)
    for line in rest:
        say(line)
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
    say(f"  page       {short(prediction_page(prediction, target, name=found.name, folder=case))}")
