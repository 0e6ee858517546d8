"""Amplitude-dependent modes, identified from the free decay after an impact.

A driven response can only compare such a mode with several close linear modes. In free decay, frequency and damping are
identified at each amplitude.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from workbench.arrays import Complexes, Floats
from workbench.identification.free_decay.assumptions import AmplitudeDependence, amplitude_dependence
from workbench.identification.free_decay.order import identify_within
from workbench.identification.input_output.time_variance import IS_MEAN
from workbench.identification.signal.harmonics import overtone_remarks
from workbench.identification.signal.modal_estimates import RefinedModes
from workbench.identification.signal.searches import TimeLimit
from workbench.records.record import Record


@dataclass(frozen=True)
class AfterImpactsSettings:
    """Constants of the identification from free decays."""

    # of the time of an identification; a search that starts from these modes takes a tenth of it
    time_share: float = 0.4
    min_decay_share: float = 0.5  # of a record that must follow the last impact
    # of the half-power bandwidth: a mode whose frequency varies less over a decay is linear
    min_frequency_change: float = 0.1
    # of the frequency of a mode, within which one identified from the whole record is the same
    frequency_tolerance: float = 0.1


AFTER_IMPACTS = AfterImpactsSettings()


@dataclass(frozen=True)
class AfterImpacts:
    """The modes of free decays, some of which depend on amplitude; empty where none does."""

    poles: tuple[complex, ...] = ()  # of all modes, rad/s, means over the decays
    changing: tuple[complex, ...] = ()  # of the amplitude-dependent modes
    scatter: tuple[float, ...] = ()  # rad/s, rms of the frequency of each of these about its mean over a decay
    figures: tuple[str, ...] = ()  # frequency and damping of each of these by amplitude, in words

    def among(self, poles: Complexes) -> tuple[complex, ...]:
        """The poles of the identified modes (n_modes,) that are amplitude-dependent ones."""
        return tuple(complex(poles[r]) for r in self._nearest(poles))

    def remarks(self, poles: Complexes, size: Floats, deviation: Complexes) -> tuple[str, ...]:
        """Remarks on the amplitude-dependent modes, numbered as identified, and on modes that are their overtones; the
        arguments are those of `overtone_remarks`."""
        means, scatter, words = poles.copy(), np.zeros(poles.size), []
        for r, k in self._nearest(poles).items():
            means[r], scatter[r] = self.changing[k], self.scatter[k]
            words.append(f"mode {r + 1} from {self.figures[k]}")
        if not words:
            return ()
        changes = f"modes change within the record, as it decays: {', and '.join(words)}; {IS_MEAN}"
        return (changes, *overtone_remarks(means, size, scatter, deviation))

    def _nearest(self, poles: Complexes) -> dict[int, int]:
        """Index of each identified mode that is amplitude-dependent, with its index in `changing`."""
        matches = {}
        for k, pole in enumerate(self.changing):
            r = int(np.argmin(np.abs(poles - pole)))
            if abs(poles[r] - pole) < AFTER_IMPACTS.frequency_tolerance * abs(pole):
                matches[r] = k
        return matches


def after_impacts(records: Sequence[Record], time_limit: TimeLimit) -> AfterImpacts:
    """The amplitude-dependent modes, where every record, its inputs zero between impacts, ends in free decay."""
    decays = [decay for record in records if (decay := _free_decay(record))]
    if len(decays) < len(records):
        return AfterImpacts()
    share = time_limit.aside(AFTER_IMPACTS.time_share)
    with suppress(ValueError, np.linalg.LinAlgError):  # no mode in free decay: the driven response alone is used
        refined = identify_within(decays, share).without_artefacts(np.pi / decays[0].sample_time).refined
        by_amplitude = amplitude_dependence(decays, refined, time_limit=share)
        if not share.unfinished:
            return _significant(refined, by_amplitude)
    return AfterImpacts()


def _free_decay(record: Record) -> Record | None:
    """The free decay after the last nonzero input, if it is most of the record."""
    driven = np.flatnonzero(record.inputs.any(axis=0))
    first = int(driven[-1]) + 2 if driven.size else record.n_samples  # a first-order hold ends a sample later
    if record.n_samples - first < AFTER_IMPACTS.min_decay_share * record.n_samples:
        return None
    decay = record.between(record.start_time + first * record.sample_time)
    return replace(decay, inputs=decay.inputs[:0], input_channels=())


def _significant(refined: RefinedModes, by_amplitude: AmplitudeDependence) -> AfterImpacts:
    """The amplitude-dependent modes whose frequency varies by a significant part of the bandwidth."""
    poles, depends = refined.modes.poles, np.flatnonzero(by_amplitude.depends).tolist()
    omega = {r: by_amplitude.omega[np.isfinite(by_amplitude.omega[:, r]), r] for r in depends}
    changing = [r for r in depends if np.ptp(omega[r]) > AFTER_IMPACTS.min_frequency_change * abs(poles[r].real)]
    if not changing:
        return AfterImpacts()
    scatter = tuple(float(omega[r].std()) for r in changing)
    figures = tuple(by_amplitude.as_text(r) for r in changing)
    return AfterImpacts(tuple(poles.tolist()), tuple(poles[changing].tolist()), scatter, figures)
