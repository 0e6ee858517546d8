"""Free decay from raw records to modes, in one call."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft
from scipy.stats import chi2

from workbench.identification.free_decay.assumptions import (
    AmplitudeDependence,
    ProportionalFit,
    amplitude_dependence,
    proportional_fit,
)
from workbench.identification.free_decay.ibrahim import stabilise, stable_modes, stacked_delays
from workbench.identification.free_decay.order import identify_within
from workbench.identification.free_decay.preparation import Drift, without_drift, without_polynomial, without_spikes
from workbench.identification.free_decay.refinement import in_coloured_noise, refine, unshaped
from workbench.identification.signal.clocks import clock_remarks, shape_remarks
from workbench.identification.signal.data_quality import (
    check_data_quality,
    data_faults,
    dropout_remark,
    of_same_sensors,
)
from workbench.identification.signal.harmonics import multiple_of, near_mains
from workbench.identification.signal.modal_estimates import SURE, IdentifiedModes, RefinedEstimates, RefinedModes
from workbench.identification.signal.projection import forget_transforms, power_of, power_sums, project
from workbench.identification.signal.searches import FALSE_ALARM, SECONDS, SELECTION, Progress, TimeLimit
from workbench.records.record import Record, as_records
from workbench.renamed import Renamed
from workbench.structure.modes import SampledModes
from workbench.structure.printed import joined_in_words, mode_text
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class RingDownSettings:
    """Constants of the identification of a ring-down and of its remarks."""

    max_modes: int = 20  # highest model order of the stabilisation diagram
    drift_rounds: int = 3  # alternations between modes and drift
    first_drift_degree: int = 2  # of the drift removed before any mode is known
    max_remaining_share: float = 0.5  # of an output's variance, without a dominant drift
    min_energy_ratio: float = 0.5  # of the two halves of a record that does not decay
    min_correlation_ratio: float = 0.5  # of an undecayed free decay, at lags of a third of the record to short ones
    # correlation times √n_samples above which a signal oscillates; white noise has 1
    min_scaled_correlation: float = 3.0
    max_band_residual: float = 0.1  # share of the energy in the bands of the modes
    max_coloured_residual: float = 0.25  # likewise over all frequencies, where the residual is coloured
    cluster_band: float = 0.05  # relative distance from the frequency of a mode to undamped estimates beside it
    min_cluster_size: int = 2  # number of these from which on ambient forces are suspected
    min_second_shape: float = 0.1  # rms share of a mode's motion in all records outside one common shape
    max_peak_ratio: float = 5.0  # of the residual in the bands of the modes to that beside them
    min_half_width: int = 6  # of the band of a mode, bins
    side_band_bins: int = 60  # on either side of it


RING_DOWN = RingDownSettings()
WITHIN_ERROR = "damping no larger than its error"


@dataclass(frozen=True, eq=False, repr=False)
class RingDown(RefinedEstimates):
    """The modes of free decays.

    Attributes:
        records: as used: each from the start of its free decay on, drift removed.
        refined: their modes.
        remarks: one per mode, empty where there is none.
        noise_modes: candidates rejected as noise.
        noise_statistic: (n_noise,) test statistics of these, below `threshold`.
        threshold: least test statistic of a mode.
        by_amplitude: the modes of each segment of the decay.
        proportional: Rayleigh damping of the modes without remark; None where they are fewer than two.
        notes: how the records were prepared, and where the model does not explain them.
    """

    records: tuple[Record, ...]
    refined: RefinedModes
    remarks: tuple[str, ...]
    noise_modes: SampledModes
    noise_statistic: np.ndarray
    threshold: float
    by_amplitude: AmplitudeDependence
    proportional: ProportionalFit | None
    notes: tuple[str, ...]

    noise_evidence, limit = Renamed("noise_statistic"), Renamed("threshold")

    def _remarks(self) -> tuple[str, ...]:
        return (*by_remark(self.remarks), *self.notes, *self.by_amplitude.remarks)


@one_blas_thread
def ring_down(
    records: Record | Sequence[Record],
    *,
    start: float | None = None,
    n_modes: int | None = None,
    seconds: float | None = SECONDS,
    progress: Progress | None = None,
) -> RingDown:
    """The modes of records that end in a free decay.

    Each record is cut to its free decay after the last clipped sample, and its drift is removed. Unless `n_modes` is
    given, the modes are those that are significant in the noise of all records together.

    Args:
        records: of the same sensors at one rate, of any length before the decay.
        start: time from which every record decays freely, s; detected in each unless given.
        n_modes: number of modes; selected unless given.
        seconds: of processor time, 30 unless given, after which the best so far is returned, with a note; None for no
            limit.
        progress: called with the search under way and the share of the time that is spent.

    Raises:
        ValueError: records that differ in sensors or rate; a faulty channel; too few samples; nothing that decays
            freely.
    """
    time_limit = TimeLimit(seconds, progress)
    records = of_same_sensors(records)
    decays, notes = [], []
    not_compared = "Frequencies by amplitude are not compared there; leave it out, or cut the record"
    for record in records:
        decay, own_notes = _cut_to_decay(record, start)
        decays.append(decay)
        notes += own_notes if len(records) == 1 else [f"{record.name}: {note}" for note in own_notes]
        check_data_quality(decay)
        notes += dropout_remark(decay, not_compared)
        _check_undriven(decay)
    try:
        identified, decays, drift_notes = _identify_with_drift(decays, n_modes, time_limit)
    except np.linalg.LinAlgError:
        identified = _by_stabilisation(decays, time_limit)
        drift_notes = ["model order from the stabilisation diagram, because selection by likelihood failed"]
    identified = identified.without_artefacts(np.pi / decays[0].sample_time, growing=True)
    _check_decays(decays, identified.refined)
    identified = identified.without_artefacts(np.pi / decays[0].sample_time)
    residuals = [project(record, identified.modes.poles, True).residual.T for record in decays]
    coloured = _coloured_residual(decays, residuals)
    unexplained = _large_residual(decays, residuals, identified.refined, bool(coloured))
    mode_remarks = remarks(identified.refined, decays)
    sure = [r for r, remark in enumerate(mode_remarks) if not remark]
    return RingDown(
        tuple(decays),
        identified.refined,
        mode_remarks,
        identified.noise_modes,
        identified.noise_statistic,
        identified.threshold,
        amplitude_dependence(decays, identified.refined, time_limit=time_limit),
        proportional_fit(identified.refined, sure) if len(sure) > 1 else None,
        (
            *notes,
            *drift_notes,
            *_on_given_number(mode_remarks, n_modes),
            *time_limit.remarks,
            *_undecaying(identified.refined, decays),
            *_ambient_excitation(identified.refined, mode_remarks),
            *clock_remarks(identified.refined, sure),
            *_inconsistent_shapes(identified.refined, decays, sure),
            *shape_remarks(identified.refined, decays[0].output_names, sure),
            *unexplained,
            *coloured,
        ),
    )


def _on_given_number(mode_remarks: Sequence[str], n_modes: int | None) -> list[str]:
    """A note where there are fewer modes than were asked for, or the damping of some is not significant."""
    if n_modes is None:
        return []
    found, untested = len(mode_remarks), "only without a number of modes is each tested for significance"
    if found < n_modes:
        return [
            f"{found} of the {n_modes} modes asked for are found, as the other poles of a model of this order cannot be"
            f" modes; {untested}"
        ]
    return [f"{n_modes} modes are given as asked for; {untested}"] if WITHIN_ERROR in mode_remarks else []


def _cut_to_decay(record: Record, start: float | None) -> tuple[Record, list[str]]:
    """The free decay of a record after the last clipped sample, single spikes repaired, and notes."""
    if start is not None:
        record, _, spikes = without_spikes(record.between(start))
        return record, list(spikes)
    record, start, spikes = without_spikes(record)
    notes = list(spikes)
    if start > record.start_time:
        notes.append(f"free decay from {start:.6g} s on; --start sets another time")
        notes += dropout_remark(record, "Only what follows is used; leave the output out to use all", before=start)
    clipped = [a for a in data_faults(record.between(start)) if a.until is not None]
    unclipped = max((a.until or start for a in clipped), default=start) + record.sample_time
    if clipped and unclipped - start < 0.5 * (record.start_time + record.sample_time * (record.n_samples - 1) - start):
        notes.append(f"output {clipped[0].outputs[0]!r} is clipped: used from {unclipped:.6g} s on")
        start = unclipped
    return record.between(start), notes


def _identify_with_drift(
    records: list[Record], n_modes: int | None, time_limit: TimeLimit
) -> tuple[IdentifiedModes, list[Record], list[str]]:
    """The modes, the records without drift, and notes; modes and drift are estimated alternately until both settle."""
    poles = np.zeros(0, complex)
    taken = _dominant_drifts(records)  # one per record once drift is removed
    span = max(record.n_samples * record.sample_time for record in records)
    for _ in range(RING_DOWN.drift_rounds):
        decays = [drift.record for drift in taken] or records
        if n_modes is None:
            identified = identify_within(decays, time_limit)
        else:
            identified = _refine_given(stacked_delays(decays, n_modes=n_modes), decays, time_limit)
        before, poles = poles, identified.modes.poles
        poles = poles[np.abs(poles) * span > 2.0 * np.pi]
        drifts = [without_drift(record, poles) for record in records]
        any_drift = any(drift.size.any() for drift in drifts)
        if not any_drift and taken and not time_limit.unfinished:
            taken = []
            continue
        if not any_drift or time_limit.unfinished:
            break
        # Better modes improve the estimate of an exponential settling.
        settles = any(drift.time_constant is not None for drift in drifts)
        if taken and poles.size == before.size and not (settles and _drift_changed(drifts, taken, identified)):
            break
        taken = drifts
    if not any(drift.size.any() for drift in taken):
        return identified, records, []
    without = [drift.record for drift in taken]
    size_over_noise = np.array([drift.size for drift in taken]) / identified.refined.noise
    if not (size_over_noise >= 1.0).any():
        return identified, without, []
    i, j = np.unravel_index(int(np.argmax(size_over_noise)), size_over_noise.shape)
    name, drift = records[0].output_names[j], taken[int(i)]
    return identified, without, [f"{drift.words} of {drift.size[j]:.3g} was removed from output {name!r}"]


def _dominant_drifts(records: list[Record]) -> list[Drift]:
    """The drift of each record where it is larger than the motion, to which modes would be fitted; else none."""
    # no mode is a parabola
    drifts = [without_drift(record, np.zeros(0, complex), most=RING_DOWN.first_drift_degree) for record in records]
    variances = [(d.record.outputs.var(axis=1), r.outputs.var(axis=1)) for d, r in zip(drifts, records, strict=True)]
    dominant = any((remaining < RING_DOWN.max_remaining_share * total).any() for remaining, total in variances)
    return drifts if dominant and not any(_settles_within_a_period(drift) for drift in drifts) else []


def _drift_changed(drifts: list[Drift], before: list[Drift], identified: IdentifiedModes) -> bool:
    """Whether drifts changed by more than a standard error: χ² of the change above one."""
    each = zip(drifts, before, identified.refined.noise, strict=True)
    changes = ((new.record.outputs - old.record.outputs) / noise[:, None] for new, old, noise in each)
    return sum(float(np.vdot(change, change)) for change in changes) > 1.0


def _settles_within_a_period(drift: Drift) -> bool:
    """Whether a settling is shorter than a period of the other motion: then it is part of heavily damped modes."""
    motion = drift.record.outputs - drift.record.outputs.mean(axis=1, keepdims=True)
    omega = np.linalg.norm(np.diff(motion)) / max(float(np.linalg.norm(motion)), 1e-300) / drift.record.sample_time
    return drift.time_constant is not None and bool(drift.time_constant * omega < 2.0 * np.pi)


def _by_stabilisation(records: list[Record], time_limit: TimeLimit) -> IdentifiedModes:
    highest = max(2, min(RING_DOWN.max_modes, min(record.n_samples for record in records) // 8))
    start = stable_modes(stabilise(records, orders=range(2, highest + 1))).modes
    if start.n_modes == 0:
        name = records[0].name
        raise ValueError(f"record {name!r} holds no mode that is stable over the model order: is it a free decay?")
    return _refine_given(start, records, time_limit)


def _refine_given(start: SampledModes, records: list[Record], time_limit: TimeLimit) -> IdentifiedModes:
    """The modes of `start`, refined, without any test: no mode is rejected."""
    refined, none = in_coloured_noise(refine(records, start, offset=True, time_limit=time_limit), records), np.zeros(0)
    return IdentifiedModes(refined, none, 0.0, unshaped(none.astype(complex), records[0]), none)


def _check_undriven(record: Record) -> None:
    """Refuse a record of random vibration, by a ValueError: it does not decay, and is uncorrelated at long lags.

    A free decay of very low damping stays correlated at any lag. Of records of random vibration that are twenty decay
    times long three in four are detected, of a hundred decay times nine in ten.
    """
    n = record.n_samples
    if n // 3 == n // 2:  # too few for any mode, which the identification refuses
        return
    # Drifts may be strong at both ends, and do not oscillate.
    outputs = without_polynomial(record.outputs)
    outputs /= np.maximum(outputs.std(axis=1, keepdims=True), 1e-300)
    energy = [float(np.vdot(part, part)) for part in np.array_split(outputs, 2, axis=1)]
    # In single precision: in double, the transforms of a long record are four times its size.
    outputs = outputs.astype(np.float32)
    correlation = irfft(_power(outputs, 2 * n), 2 * n)[1:n] / (n - np.arange(1, n)) / len(outputs)
    forget_transforms(n)
    lags = correlation[: n // 20 + 1], correlation[n // 3 : n // 2]
    short, long = (float(np.sqrt((part**2).mean())) for part in lags)
    # White noise has no mode; the selection refuses it.
    oscillates = short > RING_DOWN.min_scaled_correlation / np.sqrt(n)
    lasts = RING_DOWN.min_energy_ratio < energy[1] / max(energy[0], 1e-300) < 1.0 / RING_DOWN.min_energy_ratio
    if oscillates and lasts and long < RING_DOWN.min_correlation_ratio * short:
        raise ValueError(
            f"record {record.name!r} is no free decay: it is as strong at its end as at its beginning, and not"
            f" correlated over its length. {WAY_OUT}"
        )


def _power(rows: np.ndarray, size: int) -> np.ndarray:
    """Power spectrum |·|² of signals (n_rows, n_samples), zero-padded to `size`, summed over the signals."""
    power = power_of(rows[0], size)
    for row in rows[1:]:
        power += power_of(row, size)
    return power


WAY_OUT = (
    "Cut it to where nothing drives it; or, driven all along, give its inputs (--inputs, identify_driven) or say that"
    " they are unknown (--ambient, identify_ambient)"
)


def _check_decays(records: list[Record], refined: RefinedModes) -> None:
    """Refuse, by a ValueError, records whose strongest mode has negative damping."""
    strongest = int(np.argmax(_energy(refined, records)))
    zeta = refined.modes.zeta[strongest]
    if zeta < -SURE * refined.zeta_std[strongest]:
        raise ValueError(
            f"record {records[0].name!r} grows: its strongest mode, {refined.modes.frequencies_hz[strongest]:.4g} Hz,"
            f" has a damping ratio of {zeta:.2g}. It is driven, or unstable; cut it to where it decays"
        )


def _large_residual(
    records: list[Record], residuals: list[np.ndarray], refined: RefinedModes, coloured: bool
) -> tuple[str, ...]:
    """A remark where the residual is large in the bands of the modes: forces excite them throughout.

    Sensor noise is no larger in these bands than beside them.
    """
    for record, residual, noise in zip(records, residuals, refined.noise, strict=True):
        # in single precision, as transforms of a long record are several times its size
        scaled = ((part / noise[:, None]).astype(np.float32) for part in (residual, record.outputs))
        power, motion = (_power(part, record.n_samples)[1:] for part in scaled)
        bin_width = 2.0 * np.pi / (record.n_samples * record.sample_time)
        inside, beside = np.zeros((2, power.size), bool)
        for pole in refined.modes.poles:
            distance = np.abs(np.arange(1, power.size + 1) - pole.imag / bin_width)
            half_width = max(RING_DOWN.min_half_width, abs(pole.real) / bin_width)
            inside |= distance < half_width
            beside |= (distance > 2.0 * half_width) & (distance < RING_DOWN.side_band_bins + half_width)
        beside &= ~inside
        share, total_share = (float(power[k].sum() / motion[k].sum()) for k in (inside, slice(None)))
        level = np.median(power[beside]) if beside.any() else 0.0
        near_modes = share > RING_DOWN.max_band_residual and power[inside].mean() > RING_DOWN.max_peak_ratio * level
        if near_modes or (total_share > RING_DOWN.max_coloured_residual and coloured):
            return (
                f"in record {record.name!r} the residual is {100 * np.sqrt(share):.0f} % of the motion in the bands of"
                f" the modes, {100 * np.sqrt(total_share):.0f} % of all: it is driven, or depends strongly on"
                f" amplitude. {WAY_OUT}",
            )
    return ()


def _energy(refined: RefinedModes, records: list[Record]) -> np.ndarray:
    """Energy of each mode over all records, (n_modes,), outputs in units of their noise."""
    each = zip(records, refined.amplitudes, refined.noise, strict=True)
    squares = ((np.abs(a / noise[:, None]) ** 2).sum(axis=0) * _envelope_energy(r, refined) for r, a, noise in each)
    return np.asarray(sum(squares))


def _envelope_energy(record: Record, refined: RefinedModes) -> np.ndarray:
    """Σ_t e^{-2σt} over a record for each mode, (n_modes,)."""
    return power_sums(np.exp(2.0 * record.sample_time * refined.modes.poles.real), record.n_samples)[0].real


def _inconsistent_shapes(refined: RefinedModes, records: list[Record], only: Sequence[int]) -> tuple[str, ...]:
    """A remark on modes whose shapes differ between records beyond noise: their amplitudes have rank two.

    Two modes of the same pole are fitted as one pole, with a different mixture of their shapes in each record.
    """
    inconsistent = []
    energies = [_envelope_energy(record, refined) for record in records]
    each = zip(refined.amplitudes, refined.noise, energies, strict=True)
    # real and imaginary parts in units of their standard errors
    scaled = np.stack([a / noise[:, None] * np.sqrt(0.5 * energy) for a, noise, energy in each])
    n_records, n_outputs, n_modes = scaled.shape
    threshold = chi2.isf(FALSE_ALARM / n_modes, 2 * (n_records - 1) * (n_outputs - 1))
    for r in only:
        squares = np.linalg.svd(scaled[:, :, r], compute_uv=False) ** 2
        share = np.sqrt(squares[1:].sum() / squares.sum())
        if share > RING_DOWN.min_second_shape and squares[1:].sum() > threshold:
            inconsistent.append(mode_text(r, refined.modes.frequencies_hz[r], f", {100 * share:.0f} %"))
    if not inconsistent:
        return ()
    return (
        f"the shape differs between the records for {', '.join(inconsistent)}: two modes of the same frequency, of"
        " which only the plane of their shapes is determined, not the shape that is given; or sensors that were moved"
        " or whose gain changed",
    )


def _undecaying(refined: RefinedModes, records: list[Record]) -> tuple[str, ...]:
    """A remark where most of the motion does not decay within the record."""
    span = max(record.n_samples * record.sample_time for record in records)
    undecaying = refined.modes.zeta * refined.modes.omega * span < 0.1
    energy = _energy(refined, records)
    share = float(energy[undecaying].sum() / energy.sum())
    if share < 0.5:
        return ()
    return (
        f"{100 * share:.0f} % of the motion does not decay within the record: harmonic excitation? Then leave these"
        " modes out, or cut the record to where it ends",
    )


def _ambient_excitation(refined: RefinedModes, mode_remarks: Sequence[str]) -> tuple[str, ...]:
    """A remark where modes of insignificant damping cluster about a significant one, an effect of ambient forces."""
    f, sure = refined.modes.frequencies_hz, np.array([not remark for remark in mode_remarks])
    undamped = refined.modes.zeta < SURE * refined.zeta_std
    for r in np.flatnonzero(sure):
        cluster = np.flatnonzero(undamped & ~sure & (np.abs(f - f[r]) < RING_DOWN.cluster_band * f[r]))
        if cluster.size >= RING_DOWN.min_cluster_size:
            which = ", ".join(str(k + 1) for k in cluster)
            return (
                f"modes {which} cluster about mode {r + 1} and have no significant damping: forces drive this decay"
                " throughout, and the errors of frequencies and damping are larger than their standard errors."
                f" {WAY_OUT}",
            )
    return ()


def _coloured_residual(records: list[Record], residuals: list[np.ndarray]) -> tuple[str, ...]:
    """A remark where the residual is not white, by its correlation at lag one."""
    energy = sum(float(r.outputs.var(axis=1).sum()) * r.n_samples for r in records)
    squares = sum(float(row @ row) for residual in residuals for row in residual)
    lag_one = sum(float(row[1:] @ row[:-1]) for residual in residuals for row in residual)
    size = sum(residual.size for residual in residuals)
    if squares < 1e-12 * energy or abs(lag_one) < SURE * squares / np.sqrt(size):
        return ()
    share = 100 * np.sqrt(squares / energy)
    return (
        f"the residual, {share:.3g} % of the motion, is not white: standard errors take its spectrum about each mode",
    )


def by_remark(remarks: Sequence[str]) -> list[str]:
    """The remarks of all modes, in one line where several modes have the same."""
    modes: dict[str, list[str]] = {}
    for r, remark in enumerate(remarks):
        modes.setdefault(remark, []).append(str(r + 1))
    modes.pop("", None)
    return [f"mode{'s' * (len(which) > 1)} {joined_in_words(which)}: {remark}" for remark, which in modes.items()]


def remarks(refined: RefinedModes, records: Record | Sequence[Record]) -> tuple[str, ...]:
    """One remark per mode, empty where there is none.

    A period longer than the record: a drift. A damping ratio not three standard errors above zero, which does not decay
    if the motion lasts to the end of the record: mains hum at a multiple of its frequency; three below zero, a growing
    motion. A whole multiple of the frequency of a mode thirty times as strong: perhaps its harmonic distortion (a
    hinged beam has modes at such frequencies too). A damping ratio above 0.3: perhaps a drift.
    """
    modes, texts = refined.modes, []
    size = np.abs(np.stack(refined.amplitudes) / refined.noise[:, :, None]).max(axis=(0, 1))
    records = as_records(records)
    span = max(record.n_samples * record.sample_time for record in records)
    for r in range(modes.n_modes):
        f, zeta, error = modes.frequencies_hz[r], modes.zeta[r], SURE * refined.zeta_std[r]
        base, times = multiple_of(modes.frequencies_hz, size, r)
        if f * span < 1.0:
            texts.append("period longer than the record: a drift?")
        elif zeta < -error:
            texts.append("grows")
        elif base is not None:
            texts.append(f"{times} × mode {base + 1}: its harmonic?")
        elif zeta < error:
            lasts = zeta * modes.omega[r] * span < 1.0
            endless = "does not decay: mains hum?" if near_mains(f) else "does not decay within the record"
            texts.append(endless if lasts else WITHIN_ERROR)
        elif zeta > SELECTION.max_damping:
            texts.append("hardly oscillates: a drift?")
        else:
            texts.append("")
    return tuple(texts)
