"""Which corrections of channels are believed: those that bring most bands nearer to the model, and more than any other.

A missing effect bends some bands of modes, either way, and a fault moves all of them alike.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.gap.setup.by_band import asked, unlike
from workbench.gap.setup.compared import FELT, MOST_CHANNELS, Compared
from workbench.gap.setup.corrections import exchanged, relabelled
from workbench.gap.setup.words import FACTORS

TAKES = 0.4  # of unlikeness, in the mean of the bands where a mend is felt: of a factor 1.8 or more, of a sign 2
UNRELATED = 0.9  # of unlikeness that must not remain in that mean: signals with nothing in common leave 1 at least
SHARE_GONE = 0.5  # of it that must go there: what a missing effect bends stays
MOSTLY = 0.8  # share of those bands that must come closer
AHEAD = 0.25  # of unlikeness, by which it must be better than any other where they differ: of 2π and 9.81 it is 0.44
TELLING = 0.1  # share of the bands where a mend is felt in which it must differ from any other
QUANTITIES = ("displacement", "velocity", "acceleration")


@dataclass(frozen=True, eq=False)
class Mend:
    """A fault of a channel, of two that are exchanged or of all outputs alike, as if it were corrected.

    Attributes:
        kind: "outputs" or "inputs" for a factor, "quantity", "exchanged outputs" or "exchanged inputs".
        value: the factor, the quantities said and meant, or the names of the two channels.
        at: the channels, by index.
        left: (n_records, n_outputs, n_modes) how unlike measured and predicted signals then are.
    """

    kind: str
    value: Any
    at: tuple[int, ...]
    left: Floats


def _mends(gap: Compared) -> Iterator[Mend]:
    """Every fault of one channel or of all outputs alike, of channels with a wide gap."""
    rig, spectra = gap.rig, gap.spectra
    n, wide = len(rig.sensors), [int(j) for j in np.flatnonzero(gap.wide)]
    for factor in FACTORS:
        left = unlike(gap.seen, spectra, factor)
        yield Mend("outputs", factor, tuple(range(n)), left)
        for j in wide if n > 1 else ():
            yield Mend("outputs", factor, (j,), gap.with_rows((j,), left[:, [j]]))
    for i, j in combinations(wide, 2):
        left = unlike(gap.seen.rows((i, j)), spectra.rows((j, i)))
        names = rig.sensors[i].name, rig.sensors[j].name
        yield Mend("exchanged outputs", names, (i, j), gap.with_rows((i, j), left))
    for quantity in QUANTITIES:
        here = [j for j in wide if rig.sensors[j].quantity in set(QUANTITIES) - {quantity}]
        if here:
            meant = relabelled(rig, [rig.sensors[j].name for j in here], quantity)
            left = unlike(gap.seen, gap.read(gap.predict(meant, gap.records)))
            for j in here:
                yield Mend("quantity", (rig.sensors[j].quantity, quantity), (j,), gap.with_rows((j,), left[:, [j]]))
    for p, alone in enumerate(gap.by_input):
        own = gap.read(alone)
        for factor in (*FACTORS, 0.0) if any(np.any(of) for of in own.of) else ():
            of = [every + (factor - 1.0) * part for every, part in zip(spectra.of, own.of, strict=True)]
            yield Mend("inputs", factor, (p,), unlike(gap.seen, spectra.like(of)))
    m = len(rig.actuators)
    for p, q in combinations(range(m), 2):
        if m <= MOST_CHANNELS or q == p + 1:
            names = rig.actuators[p].name, rig.actuators[q].name
            crossed = gap.read(gap.predict(*exchanged("inputs", *names, rig, gap.records)))
            yield Mend("exchanged inputs", names, (p, q), unlike(gap.seen, crossed))


def believed(gap: Compared) -> list[Mend]:
    """The mends that take most of what is unlike away where they are felt, and more than any rival, the best first.

    A rival is felt in half of the same bands or more: a fault elsewhere may be there too. An input that does nothing
    is one, where an effect has made another of it than the model says.
    """
    compared = asked(gap.seen)
    now = gap.unlike[compared]
    better = [mend for mend in _mends(gap) if mend.left[compared].sum() < now.sum()]
    better.sort(key=lambda mend: float(mend.left[compared].sum()))
    left = np.array([mend.left[compared] for mend in better]).reshape(-1, now.size)
    felt = np.abs(left - now) > FELT
    found = []
    for i, mend in enumerate(better):
        at = felt[i]
        if not at.any():
            continue
        gone = (now - left[i])[at]
        enough = max(TAKES, SHARE_GONE * now[at].mean(), now[at].mean() - UNRELATED)
        if gone.mean() < enough or (gone > 0).mean() < MOSTLY:
            continue
        rivals = felt[:, at].mean(axis=1) >= 0.5
        rivals[i] = False
        differs = np.abs(left[rivals] - left[i]) > FELT
        ahead = np.where(differs, left[rivals] - left[i], 0.0).sum(axis=1)
        if (ahead > AHEAD * np.maximum(differs.sum(axis=1), TELLING * at.sum())).all():
            found.append(mend)
    return found
