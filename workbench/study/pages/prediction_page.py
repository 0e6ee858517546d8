"""The page of a prediction, and of its check by a test."""

from pathlib import Path

from workbench.draw.robust import MOST_SENSORS, plot_prediction
from workbench.records.record import Record
from workbench.robust.check import PredictionCheck
from workbench.robust.prediction import Prediction
from workbench.robust.verification import LEVEL
from workbench.study.pages.page import PageContent, block, write_page
from workbench.study.pages.verdict_page import case_inputs


def prediction_page(
    prediction: Prediction,
    path: Path,
    *,
    name: str,
    folder: Path,
    check: PredictionCheck | None = None,
    measured: Record | None = None,
    made_by: str,
) -> Path:
    """Write the page of a case, with the check of the prediction and the measured record if the test was made."""
    draws = prediction.expected.shape[0]
    caption = f"{100 * LEVEL:g} % prediction bands of the readings of each sensor, from {draws} draws."
    if len(prediction.channels) > MOST_SENSORS:
        caption += f" The first {MOST_SENSORS} of {len(prediction.channels)} sensors are drawn."
    shown = prediction if check is None else check
    lead, heads, rows, notes = shown._printed()
    page_content = PageContent(
        title=f"{'Prediction' if check is None else 'Check'} of {prediction.name}, {name}",
        lead=lead,
        standing="" if check is None else "good" if check.holds else "bad",
        lines=list(dict.fromkeys([*notes, *prediction.notes])),
        blocks=[block(plot_prediction(prediction, measured), caption)],
        tables=[("By sensor" if check is None else "Readings inside the bands", heads, rows)],
        inputs=case_inputs(folder),
        made_by=made_by,
    )
    return write_page(path, page_content)
