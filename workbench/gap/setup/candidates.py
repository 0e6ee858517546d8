"""Candidate faults of channels, and which of them are accepted.

A missing effect changes some bands, up or down; a fault of a channel changes all of its bands alike. So a fault is
accepted if its correction lowers the misfit of most bands, and by more than any other correction.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.gap.setup.by_band import band_misfit, compared_bands
from workbench.gap.setup.comparison import AFFECTED, MOST_CHANNELS, Comparison
from workbench.gap.setup.corrections import exchanged, relabelled
from workbench.gap.setup.sentences import FACTORS

# decrease of the mean misfit over affected bands: a factor of 1.8 or more has it, and a wrong sign has 2
LEAST_DECREASE = 0.4
UNCORRELATED = 0.9  # largest mean misfit that may remain there: uncorrelated signals have at least 1
LEAST_SHARE = 0.5  # of the mean misfit there, which must go: the changes by a missing effect stay
LEAST_BANDS = 0.8  # share of these bands in which the misfit must decrease
MARGIN = 0.25  # mean misfit by which it must be better than any rival, where they differ: 2π and 9.81 differ by 0.44
LEAST_DIFFERING = 0.1  # share of the affected bands in which it must differ from any rival
QUANTITIES = ("displacement", "velocity", "acceleration")


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate fault of one channel, of two exchanged ones or of all outputs, and the misfit once it is corrected.

    Attributes:
        kind: "outputs" or "inputs" for a factor, "quantity", "exchanged outputs" or "exchanged inputs".
        value: the factor, the stated and the true quantity, or the names of the two channels.
        at: indices of the channels.
        misfit: (n_records, n_outputs, n_modes) after the correction.
    """

    kind: str
    value: Any
    at: tuple[int, ...]
    misfit: Floats


def _candidates(gap: Comparison) -> Iterator[Candidate]:
    """Every candidate fault of one input, one output with a wide gap, two exchanged ones, and all outputs alike."""
    rig, measured, predicted = gap.rig, gap.measured_spectra, gap.predicted_spectra
    n, wide = len(rig.sensors), [int(j) for j in np.flatnonzero(gap.wide)]
    for factor in FACTORS:
        misfit = band_misfit(measured, predicted, factor)
        yield Candidate("outputs", factor, tuple(range(n)), misfit)
        for j in wide if n > 1 else ():
            yield Candidate("outputs", factor, (j,), gap.misfit_with((j,), misfit[:, [j]]))
    for i, j in combinations(wide, 2):
        misfit = band_misfit(measured.select((i, j)), predicted.select((j, i)))
        names = rig.sensors[i].name, rig.sensors[j].name
        yield Candidate("exchanged outputs", names, (i, j), gap.misfit_with((i, j), misfit))
    for quantity in QUANTITIES:
        others = [j for j in wide if rig.sensors[j].quantity in set(QUANTITIES) - {quantity}]
        if others:
            with_quantity = relabelled(rig, [rig.sensors[j].name for j in others], quantity)
            misfit = band_misfit(measured, gap.spectra_of(gap.predict(with_quantity, gap.records)))
            for j in others:
                stated_and_true = (rig.sensors[j].quantity, quantity)
                yield Candidate("quantity", stated_and_true, (j,), gap.misfit_with((j,), misfit[:, [j]]))
    for p, alone in enumerate(gap.by_input):
        own = gap.spectra_of(alone)
        for factor in (*FACTORS, 0.0) if any(np.any(lines) for lines in own.lines) else ():
            lines = [every + (factor - 1.0) * part for every, part in zip(predicted.lines, own.lines, strict=True)]
            yield Candidate("inputs", factor, (p,), band_misfit(measured, predicted.with_lines(lines)))
    m = len(rig.actuators)
    for p, q in combinations(range(m), 2):
        if m <= MOST_CHANNELS or q == p + 1:
            names = rig.actuators[p].name, rig.actuators[q].name
            crossed = gap.spectra_of(gap.predict(*exchanged("inputs", *names, rig, gap.records)))
            yield Candidate("exchanged inputs", names, (p, q), band_misfit(measured, crossed))


def accepted(gap: Comparison) -> list[Candidate]:
    """The candidates whose correction removes most of the misfit where it acts, and more than any rival, best first.

    A rival affects at least half of the same bands: a fault elsewhere may be present too. An input without any effect
    is among the rivals, since an unmodelled effect may have changed its response altogether.
    """
    compared = compared_bands(gap.measured_spectra)
    before = gap.misfit[compared]
    better = [candidate for candidate in _candidates(gap) if candidate.misfit[compared].sum() < before.sum()]
    better.sort(key=lambda candidate: float(candidate.misfit[compared].sum()))
    after = np.array([candidate.misfit[compared] for candidate in better]).reshape(-1, before.size)
    affected = np.abs(after - before) > AFFECTED
    chosen = []
    for i, candidate in enumerate(better):
        at = affected[i]
        if not at.any():
            continue
        decrease = (before - after[i])[at]
        least = max(LEAST_DECREASE, LEAST_SHARE * before[at].mean(), before[at].mean() - UNCORRELATED)
        if decrease.mean() < least or (decrease > 0).mean() < LEAST_BANDS:
            continue
        rivals = affected[:, at].mean(axis=1) >= 0.5
        rivals[i] = False
        differs = np.abs(after[rivals] - after[i]) > AFFECTED
        margin = np.where(differs, after[rivals] - after[i], 0.0).sum(axis=1)
        if (margin > MARGIN * np.maximum(differs.sum(axis=1), LEAST_DIFFERING * at.sum())).all():
            chosen.append(candidate)
    return chosen
