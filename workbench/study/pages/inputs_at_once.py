"""The frequency responses of records of several inputs on a page, or why none can be shown."""

from collections.abc import Sequence
from typing import Any

from workbench.draw.signals import MOST_INPUTS, plot_frf_of_inputs
from workbench.identification.signal.frequency_responses import FrfEstimate, frequency_responses, loudest
from workbench.records.frequency_responses import FrequencyResponses
from workbench.records.record import Record
from workbench.structure.printed import counted, joined_in_words
from workbench.study.pages.page import block

MOST_OUTPUTS = 4  # with a panel each


def responses_to_inputs(
    records: Sequence[Record], fitted: FrequencyResponses | None = None
) -> tuple[list[dict[str, Any]], str]:
    """The block of the frequency responses of records to several inputs; else none, and a sentence that says why.

    Those of the identified modes, `fitted`, are drawn over the measured ones.
    """
    names = loudest(records[0], MOST_OUTPUTS)
    try:
        found = frequency_responses([record.select_outputs(names) for record in records])
    except ValueError as why:
        return [], f"No frequency responses are shown: {why}."
    if fitted is not None:
        fitted = fitted.select_outputs(names)
    return [block(plot_frf_of_inputs(found, fitted), _caption(found, records, fitted))], ""


def _caption(found: FrfEstimate, records: Sequence[Record], fitted: FrequencyResponses | None) -> str:
    inputs, n_outputs = found.frf.references, records[0].n_outputs
    over = f" of {len(records)} records" if len(records) > 1 else ""
    words = [
        f"Frequency responses to {counted(len(inputs), 'input')} at once, H = S_yu S_uu⁻¹, by spectra averaged over"
        f" {counted(found.averages, 'segment')}{over}, whose windows blunt sharp peaks",
        ", and those of the identified modes (dashed)." if fitted is not None else ".",
        " Below, the multiple coherence: the share of each output's power that is linear in the inputs.",
    ]
    if n_outputs > len(found.frf.output_names):
        words.append(f" Shown are {MOST_OUTPUTS} of {n_outputs} outputs, those of highest level first.")
    if len(inputs) > MOST_INPUTS:
        words.append(f" Not drawn: the responses to {joined_in_words(inputs[MOST_INPUTS:])}.")
    if found.silent:
        words.append(f" Constant, and left out: {joined_in_words(found.silent)}.")
    return "".join(words)
