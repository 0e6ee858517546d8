"""Modes that depend on amplitude, seen in the free decay after an impact.

A driven response holds nothing else to compare such a mode with than more modes near by. Where nothing drives the
structure any more, frequency and damping are found at one amplitude after the other.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from workbench.arrays import Complexes, Floats
from workbench.identification.free_decay.assumptions import AmplitudeDependence, amplitude_dependence
from workbench.identification.free_decay.order import identify_within
from workbench.identification.input_output.time_variance import IS_MEAN
from workbench.identification.signal.modal_estimates import Refined
from workbench.identification.signal.overtones import overtone_remarks
from workbench.identification.signal.searches import Budget
from workbench.records.record import Record


@dataclass(frozen=True)
class AfterImpactsSettings:
    """Constants of the look at free decays."""

    share: float = 0.4  # of the time of an identification: modes known from there are searched in a tenth of it
    least: float = 0.5  # share of a record that the last impact must leave, for the decay to tell of its modes
    matters: float = 0.1  # of the half-power bandwidth: a mode that moves by less within a decay is a linear one
    near: float = 0.1  # of the frequency of a mode, within which one identified from all of the record is the same


AFTER_IMPACTS = AfterImpactsSettings()


@dataclass(frozen=True)
class AfterImpacts:
    """The modes of free decays, some of which depend on amplitude; empty where none does.

    Attributes:
        poles: of all modes, rad/s, means over the decays.
        changing: those that depend on amplitude.
        scatter: rad/s, rms over a decay of the frequency of each of these about its mean.
        figures: frequency and damping of each of these by amplitude, in words.
    """

    poles: tuple[complex, ...] = ()
    changing: tuple[complex, ...] = ()
    scatter: tuple[float, ...] = ()
    figures: tuple[str, ...] = ()

    def among(self, poles: Complexes) -> tuple[complex, ...]:
        """The modes identified that are these which change, of poles (n_modes,)."""
        return tuple(complex(poles[r]) for r in self._nearest(poles))

    def remarks(self, poles: Complexes, size: Floats, deviation: Complexes) -> tuple[str, ...]:
        """On each that changes, numbered as the modes identified, and on these where they are its overtones.

        Args:
            poles, size, deviation: of the modes identified, as `overtone_remarks` takes them.
        """
        of_decay, scatter, words = poles.copy(), np.zeros(poles.size), []
        for r, k in self._nearest(poles).items():
            of_decay[r], scatter[r] = self.changing[k], self.scatter[k]
            words.append(f"mode {r + 1} from {self.figures[k]}")
        if not words:
            return ()
        changes = f"modes change within the record, as it decays: {', and '.join(words)}; {IS_MEAN}"
        return (changes, *overtone_remarks(of_decay, size, scatter, deviation))

    def _nearest(self, poles: Complexes) -> dict[int, int]:
        """The mode identified that each which changes is, by index."""
        found = {}
        for k, pole in enumerate(self.changing):
            r = int(np.argmin(np.abs(poles - pole)))
            if abs(poles[r] - pole) < AFTER_IMPACTS.near * abs(pole):
                found[r] = k
        return found


def after_impacts(records: Sequence[Record], budget: Budget) -> AfterImpacts:
    """The modes that depend on amplitude, where every record ends in free decay; none otherwise.

    Args:
        records: inputs zero between impacts.
        budget: of the identification; a share of it is used.
    """
    decays = [_free_decay(record) for record in records]
    if not all(decays):
        return AfterImpacts()
    free = [decay for decay in decays if decay is not None]
    part = budget.aside(AFTER_IMPACTS.share)
    with suppress(ValueError, np.linalg.LinAlgError):  # nothing decays freely: the inputs alone tell
        refined = identify_within(free, part).without_artefacts(np.pi / free[0].sample_time).refined
        by_amplitude = amplitude_dependence(free, refined, budget=part)
        if not part.unfinished:
            return _that_matter(refined, by_amplitude)
    return AfterImpacts()


def _free_decay(record: Record) -> Record | None:
    """What follows the last sample that drives, if it is most of the record."""
    driven = np.flatnonzero(record.inputs.any(axis=0))
    behind = int(driven[-1]) + 2 if driven.size else record.n_samples  # an input straight between samples ends one on
    if record.n_samples - behind < AFTER_IMPACTS.least * record.n_samples:
        return None
    decay = record.between(record.start_time + behind * record.sample_time)
    return replace(decay, inputs=decay.inputs[:0], input_channels=())


def _that_matter(refined: Refined, by_amplitude: AmplitudeDependence) -> AfterImpacts:
    """Those that move by more than a linear model could overlook."""
    poles, changing, scatter = refined.modes.poles, [], []
    for r in np.flatnonzero(by_amplitude.depends).tolist():
        omega = by_amplitude.omega[np.isfinite(by_amplitude.omega[:, r]), r]
        if np.ptp(omega) > AFTER_IMPACTS.matters * abs(poles[r].real):
            changing.append(r)
            scatter.append(float(omega.std()))
    if not changing:
        return AfterImpacts()
    figures = tuple(by_amplitude.figures(r) for r in changing)
    return AfterImpacts(tuple(poles.tolist()), tuple(poles[changing].tolist()), tuple(scatter), figures)
