"""Whether inputs run otherwise between samples than they are taken to: how likely the records are with each way.

The same modes are fitted with the noise as it was found, and as many unknowns each way. Beside a direct term inputs
held and straight give the same outputs, of other residues: these two are not told apart. What a false hold makes of the
residues does not depend on the noise: a band-limited input taken as straight lines gives each residue 1/sinc²(f Δt) of
its true size.
"""

import numpy as np

from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import Fit, projected, settled
from workbench.identification.input_output.model_order import ORDER
from workbench.identification.signal.searches import SELECTION, Budget
from workbench.records.record import HOLDS

WORDS = {
    "zero": "held between samples",
    "first": "straight between samples",
    "band-limited": "band-limited, as behind an anti-alias filter",
}


def hold_remarks(data: KnownInputs, fit: Fit, worth: float, budget: Budget) -> tuple[str, ...]:
    """A remark where inputs that run otherwise between samples make the records more likely.

    Args:
        data: as identified.
        fit: of its modes.
        worth: by how much twice the logarithm of the likelihood must rise.
        budget: of time.
    """
    costs: dict[str, float] = {}
    for hold in HOLDS:
        if hold == data.hold or (data.feedthrough and "band-limited" not in (hold, data.hold)):
            continue
        # a false hold may have made the delay
        whole = np.floor(data.delays)
        for delays in np.unique([data.delays, whole, np.maximum(whole - 1.0, 0.0)], axis=0):
            if budget.spent("check of how inputs run between samples"):
                return ()
            other = data.with_hold(hold, delays)
            try:
                start = projected(other, fit.poles, fit.participation)
                found = settled(other, start, SELECTION.few_steps, budget, ORDER.decided)
            except np.linalg.LinAlgError:
                continue
            cost = other.cost(found) * len(fit.residual) / len(found.residual)  # a fraction has a row fewer
            costs[hold] = min(cost, costs.get(hold, np.inf))
    best = min(costs, key=lambda hold: costs[hold], default=data.hold)
    if best == data.hold or costs[best] > data.cost(fit) - worth:
        return ()
    return (
        f"by the records, inputs are {WORDS[best]}, and not {WORDS[data.hold]} as input_hold={data.hold!r} says:"
        f" residues and modal masses are wrong, the more the higher the mode; give input_hold={best!r}",
    )
