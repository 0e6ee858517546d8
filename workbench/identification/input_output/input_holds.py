"""Test of the course of the inputs between samples, by the likelihood of the records with each hold.

The same modes are fitted with the same noise spectrum and as many parameters for each hold. With a direct term, zero-
and first-order hold give the same outputs with other residues, so these two cannot be distinguished. The error of the
residues by a false hold does not depend on the noise: a band-limited input taken for a first-order hold gives each
residue 1/sinc²(f Δt) times its true size.
"""

from dataclasses import replace

import numpy as np

from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import Fit, projected, settled
from workbench.identification.input_output.model_order import ORDER
from workbench.identification.signal.searches import SELECTION, TimeLimit
from workbench.records.record import HOLDS

WORDS = {
    "zero": "held between samples",
    "first": "straight between samples",
    "band-limited": "band-limited, as behind an anti-alias filter",
}


def hold_remarks(data: KnownInputs, fit: Fit, threshold: float, time_limit: TimeLimit) -> tuple[str, ...]:
    """A remark where another course of the inputs between samples is significantly likelier.

    Args:
        data: as identified.
        fit: of its modes.
        threshold: threshold of twice the log-likelihood ratio.
        time_limit: of time.
    """
    costs: dict[str, float] = {}
    for hold in HOLDS:
        if hold == data.hold or (data.has_direct and "band-limited" not in (hold, data.hold)):
            continue
        # the delay may be an artefact of the false hold
        whole = np.floor(data.delays)
        for delays in np.unique([data.delays, whole, np.maximum(whole - 1.0, 0.0)], axis=0):
            if time_limit.spent("check of how inputs run between samples"):
                return ()
            other = replace(data, hold=hold).delayed_by(delays)
            try:
                start = projected(other, fit.poles, fit.participation)
                refitted = settled(other, start, SELECTION.few_steps, time_limit, ORDER.decided)
            except np.linalg.LinAlgError:
                continue
            # a fractional delay has a row fewer
            cost = other.cost(refitted) * len(fit.residual) / len(refitted.residual)
            costs[hold] = min(cost, costs.get(hold, np.inf))
    best = min(costs, key=lambda hold: costs[hold], default=data.hold)
    if best == data.hold or costs[best] > data.cost(fit) - threshold:
        return ()
    return (
        f"the records show inputs {WORDS[best]}, not {WORDS[data.hold]} as input_hold={data.hold!r} says:"
        f" residues and modal masses are wrong, the more the higher the mode; give input_hold={best!r}",
    )
