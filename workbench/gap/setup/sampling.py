"""Faults of sampling rates and triggers, and of the units of the modes.

They are accepted if their correction closes nearly all of the gap: no missing effect changes a sampling rate, or a
damping ratio a hundredfold.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import minimize_scalar

from workbench.gap.prediction.residuals import lead_of
from workbench.gap.setup.comparison import MAX_RESIDUAL_SHARE, MIN_CLOSED_SHARE, Comparison, compared_bands
from workbench.gap.setup.corrections import (
    RATES,
    TURN,
    Correction,
    SetupFault,
    agreeing,
    modes_times,
    outputs_earlier,
    rate_times,
    subject,
)
from workbench.records.band_limited import angles
from workbench.structure.damping import ModalDamping

MAX_DAMPING_RATIO = 0.05  # damping ratio above which per cent may have been meant
MAX_DELAY = 20  # samples: largest delay that is tried, either way
# sample times by which the delays of two records must differ; one of all records is an effect
MIN_DELAY_DIFFERENCE = 1.0
MIN_DELAY = 0.25  # samples, beside the record of least delay, from which a record is corrected
WHOLE_TOLERANCE = 0.1  # samples: a delay as near to a whole number is that number, since a trigger counts samples
MIN_MODES = 2  # that show the delay: in one mode, a shifted resonance delays too
# cosine of the levels of the inputs, each over its largest, from which the same inputs drive two records
MIN_LEVEL_COSINE = 0.95
MIN_NOISE_RATIO = 4.0  # times the noise power: a smaller residual of an output shows no delay


def sampling_rates(gap: Comparison) -> list[SetupFault]:
    rig, records = gap.rig, gap.records
    wrong: dict[float, list[int]] = {}
    for i, (record, own) in enumerate(zip(records, gap.by_record, strict=True)):
        if not own.wide.any():
            continue
        corrected = {factor: replace(record, sample_time=record.sample_time / factor) for factor in RATES}
        shares = {
            factor: own.closes(rig, [other])
            for factor, other in corrected.items()
            if 2 * lead_of(other, gap.transient) < other.n_samples  # otherwise few samples would be left to compare
        }
        best = max(shares, key=lambda factor: shares[factor], default=None)
        if best is not None and shares[best] >= MIN_CLOSED_SHARE:
            wrong.setdefault(best, []).append(i)
    faults = []
    for factor, at in wrong.items():
        names = [records[i].name for i in at]
        times = ", ".join(dict.fromkeys(f"{records[i].sample_time / factor:.6g}" for i in at))
        what = agreeing(f"{subject('record', names)} are sampled at {RATES[factor]} the stated rate", names)
        sentence = f"{what}: state sample_time = {times} s."
        correction = partial(rate_times, factor)
        whole = gap.closes(*correction(rig, records)) if len(at) == len(records) else np.nan
        faults.append(SetupFault("sample rate", sentence, whole, correction, records=tuple(names)))
    return faults


def modal_units(gap: Comparison) -> list[SetupFault]:
    """The fault of the units of the modes that closes most: damping in per cent, frequencies in rad/s or in Hz."""
    rig, records = gap.rig, gap.records
    candidates: list[tuple[str, str, Correction]] = []
    zeta = float(rig.modes.zeta.max(initial=0.0))
    if zeta > MAX_DAMPING_RATIO and (rig.structure is None or isinstance(rig.structure.damping, ModalDamping)):
        sentence = (
            f"The damping looks like per cent where a ratio is meant: divide it by 100 (the largest would be"
            f" {zeta / 100:.4g}, not {zeta:.4g})."
        )
        candidates.append(("damping", sentence, partial(modes_times, 1.0, 0.01)))
    if rig.structure is None:
        for factor, words in ((TURN, "Hz where rad/s is"), (1.0 / TURN, "rad/s where Hz is")):
            sentence = f"The natural frequencies look like {words} meant: multiply them by {factor:.6g}."
            candidates.append(("frequency", sentence, partial(modes_times, factor, 1.0)))
    faults = [SetupFault(kind, what, gap.closes(*by(rig, records)), by) for kind, what, by in candidates]
    return sorted((fault for fault in faults if fault.closes >= MIN_CLOSED_SHARE), key=lambda fault: -fault.closes)[:1]


def late_records(gaps: Sequence[Comparison]) -> list[SetupFault]:
    """Faults of records that are late or early relative to others that the same inputs drive, where the delays differ.

    A delay is one of all outputs, by which they agree best with the prediction; each of these records must show its
    own. Where the inputs differ, so may the delays of their actuators. gaps: each of one record.
    """
    driven = [gap for gap in gaps if np.any(gap.records[0].inputs)]
    if not driven:
        return []
    rms = np.array([np.sqrt((gap.records[0].inputs ** 2).mean(axis=1)) for gap in driven])
    shares = rms / np.maximum(rms.max(axis=0), 1e-300)
    shares /= np.linalg.norm(shares, axis=1, keepdims=True)
    left, faults = list(range(len(driven))), []
    while left:
        alike = [i for i in left if shares[i] @ shares[left[0]] > MIN_LEVEL_COSINE]
        faults += _late_among([driven[i] for i in alike])
        left = [i for i in left if i not in alike]
    return faults


def _late_among(gaps: Sequence[Comparison]) -> list[SetupFault]:
    """The faults of `late_records` of single records that the same inputs drive."""
    delays = [delay for delay in map(_delay_of, gaps) if delay is not None] if len(gaps) > 1 else []
    if not delays or len(delays) < len(gaps):
        return []
    sample_times = np.array([gap.records[0].sample_time for gap in gaps])
    times = np.array(delays) * sample_times
    if np.ptp(times) <= MIN_DELAY_DIFFERENCE * sample_times.max():
        return []
    closed = [_closed(gap, delay) for gap, delay in zip(gaps, delays, strict=True)]
    if min(closed) < MIN_CLOSED_SHARE:
        return []
    least = int(np.argmin(np.abs(times)))
    faults = []
    for gap, beside, closes in zip(gaps, (times - times[least]) / sample_times, closed, strict=True):
        (record,), late = gap.records, float(beside)
        late = float(np.round(late)) if abs(late - np.round(late)) < WHOLE_TOLERANCE else late
        if abs(late) > MIN_DELAY:
            how, remedy = ("late", "earlier") if late > 0 else ("early", "later")
            by = f"{abs(late):.3g} sample{'s' * (abs(late) != 1.0)}"
            sentence = (
                f"The outputs of record {record.name} are {by} {how} relative to those of record"
                f" {gaps[least].record_names[0]} (trigger offset): shift them all {by} {remedy}."
            )
            correction = partial(outputs_earlier, late)
            faults.append(SetupFault("late record", sentence, closes, correction, records=(record.name,)))
    return faults


def _delay_of(gap: Comparison) -> float | None:
    """Delay of all outputs of one record by which they correlate best with the prediction, samples.

    None where the correlation is largest at an end of the range, or too few modes show it.
    """
    if np.count_nonzero(compared_bands(gap.measured_spectra).any(axis=(0, 1))) < MIN_MODES:
        return None
    (measured,), (predicted,) = gap.measured_spectra.lines, gap.simulated_spectra.lines
    cross = np.sum(measured * predicted.conj() / gap.scale[:, None], axis=0)
    if not np.isfinite(cross).all():
        return None
    n = gap.n_samples
    at = angles(n)[: cross.size]
    reach = max(min(MAX_DELAY, n // 2 - 1), 0)
    tried = np.arange(-reach, reach + 1)
    whole = int(tried[np.argmax(np.fft.irfft(cross, n)[tried])])
    if whole in (tried[0], tried[-1]):
        return None

    def loss(delay: float) -> float:
        return -float((cross * np.exp(1j * at * delay)).real.sum())

    return float(minimize_scalar(loss, bounds=(whole - 1.0, whole + 1.0), method="bounded").x)


def _closed(gap: Comparison, delay: float) -> float:
    """Share of the gap of a record that its delay closes, the median over outputs; 1 without a delay and a gap."""
    if abs(delay) <= MIN_DELAY:
        return float(np.median(gap.before) < MAX_RESIDUAL_SHARE)
    clear = gap.before > MIN_NOISE_RATIO * gap.noise
    after = gap.corrected(partial(outputs_earlier, delay)).before
    return float(np.median(gap.closed(after)[clear])) if clear.any() else 0.0
