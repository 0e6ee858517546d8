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
from workbench.identification.free_decay.preparation import (
    Drift,
    without_drift,
    without_polynomial,
    without_spikes,
)
from workbench.identification.free_decay.refinement import in_coloured_noise, refine, unshaped
from workbench.identification.signal.clocks import shape_remarks
from workbench.identification.signal.data_quality import (
    check_data_quality,
    data_faults,
    dropout_remark,
    of_same_sensors,
)
from workbench.identification.signal.modal_estimates import Identified, OfRefined, Refined, clock_remarks
from workbench.identification.signal.overtones import multiple_of
from workbench.identification.signal.projection import forget_transforms, power_of, power_sums, project
from workbench.identification.signal.searches import FALSE_ALARM, SECONDS, SELECTION, Budget, Progress
from workbench.records.record import Record, as_records
from workbench.renamed import Renamed
from workbench.structure.modes import SampledModes
from workbench.structure.printed import mode_text
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class RingDownSettings:
    """Constants of what is said of a ring-down."""

    max_modes: int = 20  # of a stabilisation diagram
    drift_rounds: int = 3  # of modes and drift
    parabola: int = 2  # degree of a drift before any mode is known
    dominant: float = 0.5  # share of the variance that it must leave at most, to be removed
    as_strong: float = 0.5  # energy of the second half over that of the first, either way, of what does not decay
    correlated: float = 0.5  # least correlation of a free decay as strong at its end, after a third of it
    uncorrelated: float = 3.0  # correlation of noise, times the root of its samples, is 1; more is an oscillation
    residual_share: float = 0.1  # share of the energy about the modes that the residual may have
    most_left: float = 0.25  # likewise of all, if it is not white
    about: float = 0.05  # of the frequency of a sure mode, within which so many others
    crowd: int = 2  # of no sure damping are the work of forces
    other_shape: float = 0.1  # of a mode's motion in all records, what its best one shape leaves, to be remarked
    stands_out: float = 5.0  # times the residual beside them that it may stand out by
    band: int = 6  # bins about a mode
    beside: int = 60  # bins beside it


RING_DOWN = RingDownSettings()
SURE = 3.0


@dataclass(frozen=True, eq=False, repr=False)
class RingDown(OfRefined):
    """The modes of free decays.

    Attributes:
        records: as used: each from the start of its free decay on, drift removed.
        refined: their modes.
        remarks: one per mode, empty where there is none.
        noise_modes: candidates rejected as noise.
        noise_statistic: (n_noise,) theirs, below `threshold`.
        threshold: statistic from which on a mode counts.
        by_amplitude: the modes of each segment of the decay.
        proportional: g1 and g2 of the modes without remark; None where they are fewer than two.
        notes: what was done to the records, and what remains unexplained.
    """

    records: tuple[Record, ...]
    refined: Refined
    remarks: tuple[str, ...]
    noise_modes: SampledModes
    noise_statistic: np.ndarray
    threshold: float
    by_amplitude: AmplitudeDependence
    proportional: ProportionalFit | None
    notes: tuple[str, ...]

    noise_evidence, limit = Renamed("noise_statistic"), Renamed("threshold")

    def _remarks(self) -> tuple[str, ...]:
        of_modes = (f"mode {r + 1}: {remark}" for r, remark in enumerate(self.remarks) if remark)
        return (*of_modes, *self.notes, *self.by_amplitude.remarks)


@one_blas_thread
def ring_down(
    records: Record | Sequence[Record],
    *,
    start: float | None = None,
    n_modes: int | None = None,
    seconds: float | None = SECONDS,
    progress: Progress | None = None,
) -> RingDown:
    """The modes of records that become free decay.

    Each is cut where free decay begins and no sample is clipped any more, and a drift is removed. Unless their number
    is given, the modes are those that rise above the noise of all records together.

    Args:
        records: of the same sensors at one rate, of any length before the decay.
        start: where the decay is free, s, in every record; found in each unless given.
        n_modes: number of modes; selected unless given.
        seconds: of processor time, 30 unless given, after which the best so far is returned, with a note; None for no
            limit.
        progress: called with the search under way and the share of the time that is spent.

    Raises:
        ValueError: records that differ in sensors or rate; a faulty channel; too few samples; nothing that decays
            freely.
    """
    budget = Budget(seconds, progress)
    records = of_same_sensors(records)
    cut, notes = [], []
    for record in records:
        decay, notes_here = _decay(record, start)
        cut.append(decay)
        notes += notes_here if len(records) == 1 else [f"{record.name}: {note}" for note in notes_here]
        check_data_quality(decay)
        notes += dropout_remark(
            decay, "Frequencies by amplitude are not compared there; leave it out, or cut the record"
        )
        _check_undriven(cut[-1])
    try:
        found, cut, more = _without_drift(cut, n_modes, budget)
    except np.linalg.LinAlgError:
        found = _by_stabilisation(cut, budget)
        more = ["model order by the stabilisation diagram, for selection by likelihood failed"]
    found = found.without_artefacts(np.pi / cut[0].sample_time, growing=True)
    _check_decays(cut, found.refined)
    found = found.without_artefacts(np.pi / cut[0].sample_time)
    left = [project(record, found.modes.poles, True).residual.T for record in cut]
    coloured = _coloured_residual(cut, left)
    doubtful = _unexplained(cut, left, found.refined, bool(coloured))
    doubts = remarks(found.refined, cut)
    sure = [r for r, doubt in enumerate(doubts) if not doubt]
    return RingDown(
        tuple(cut),
        found.refined,
        doubts,
        found.noise_modes,
        found.noise_statistic,
        found.threshold,
        amplitude_dependence(cut, found.refined, budget=budget),
        proportional_fit(found.refined, sure) if len(sure) > 1 else None,
        (
            *notes,
            *more,
            *budget.remarks,
            *_goes_on(found.refined, cut),
            *_shaken(found.refined, doubts),
            *clock_remarks(found.refined, sure),
            *_of_other_shapes(found.refined, cut, sure),
            *shape_remarks(found.refined, cut[0].output_names, sure),
            *doubtful,
            *coloured,
        ),
    )


def _decay(record: Record, start: float | None) -> tuple[Record, list[str]]:
    """From where free decay begins and nothing is clipped any more, less lone samples that are wrong, with remarks."""
    if start is not None:
        record, _, spikes = without_spikes(record.between(start))
        return record, list(spikes)
    record, start, spikes = without_spikes(record)
    notes = list(spikes)
    if start > record.start_time:
        notes.append(f"free decay from {start:.6g} s on; --start sets another time")
        notes += dropout_remark(record, "Only what follows is used; leave the output out to use all", before=start)
    clipped = [a for a in data_faults(record.between(start)) if a.until is not None]
    behind = max((a.until or start for a in clipped), default=start) + record.sample_time
    if clipped and behind - start < 0.5 * (record.start_time + record.sample_time * (record.n_samples - 1) - start):
        notes.append(f"output {clipped[0].outputs[0]!r} is clipped: used from {behind:.6g} s on")
        start = behind
    return record.between(start), notes


def _without_drift(
    records: list[Record], n_modes: int | None, budget: Budget
) -> tuple[Identified, list[Record], list[str]]:
    """Modes and drifts in turn, as each disturbs the other, until neither changes."""
    poles = np.zeros(0, complex)
    taken: list[Drift] = []  # one a record, where they are less their drifts
    # A drift larger than the modes would be searched for modes first; a parabola is none.
    drifts = [without_drift(record, poles, most=RING_DOWN.parabola) for record in records]
    variances = [(d.record.outputs.var(axis=1), r.outputs.var(axis=1)) for d, r in zip(drifts, records, strict=True)]
    dominant = any((left < RING_DOWN.dominant * whole).any() for left, whole in variances)
    if dominant and not any(_is_swing(drift) for drift in drifts):
        taken = drifts
    span = max(record.n_samples * record.sample_time for record in records)
    for _ in range(RING_DOWN.drift_rounds):
        found = _identified([drift.record for drift in taken] or records, n_modes, budget)
        before, poles = poles, found.modes.poles
        poles = poles[np.abs(poles) * span > 2.0 * np.pi]
        drifts = [without_drift(record, poles) for record in records]
        drifting = any(drift.size.any() for drift in drifts)
        if not drifting and taken and not budget.unfinished:
            taken = []
            continue
        if not drifting or budget.unfinished:
            break
        # What settles is found better beside better modes.
        settles = any(drift.time_constant is not None for drift in drifts)
        if taken and poles.size == before.size and not (settles and _moved(drifts, taken, found)):
            break
        taken = drifts
    if not any(drift.size.any() for drift in taken):
        return found, records, []
    cleared = [drift.record for drift in taken]
    in_noise = np.array([drift.size for drift in taken]) / found.refined.noise
    if not (in_noise >= 1.0).any():
        return found, cleared, []
    i, j = np.unravel_index(int(np.argmax(in_noise)), in_noise.shape)
    name, drift = records[0].output_names[j], taken[int(i)]
    return found, cleared, [f"{drift.words} of {drift.size[j]:.3g} was removed from output {name!r}"]


def _moved(drifts: list[Drift], before: list[Drift], found: Identified) -> bool:
    """Whether drifts are others than before by more than a standard error: by a χ² of one."""
    each = zip(drifts, before, found.refined.noise, strict=True)
    changes = ((now.record.outputs - then.record.outputs) / noise[:, None] for now, then, noise in each)
    return sum(float(np.vdot(change, change)) for change in changes) > 1.0


def _is_swing(drift: Drift) -> bool:
    """Whether what settles is over within a period of the motion left: the first swing of heavily damped modes."""
    left = drift.record.outputs - drift.record.outputs.mean(axis=1, keepdims=True)
    omega = np.linalg.norm(np.diff(left)) / max(float(np.linalg.norm(left)), 1e-300) / drift.record.sample_time
    return drift.time_constant is not None and bool(drift.time_constant * omega < 2.0 * np.pi)


def _identified(records: list[Record], n_modes: int | None, budget: Budget) -> Identified:
    if n_modes is None:
        return identify_within(records, budget)
    if n_modes < 1:
        raise ValueError(f"at least one mode must be asked for; got {n_modes}")
    return _as_identified(stacked_delays(records, n_modes=n_modes), records, budget)


def _by_stabilisation(records: list[Record], budget: Budget) -> Identified:
    highest = max(2, min(RING_DOWN.max_modes, min(record.n_samples for record in records) // 8))
    start = stable_modes(stabilise(records, orders=range(2, highest + 1))).modes
    if start.n_modes == 0:
        name = records[0].name
        raise ValueError(f"record {name!r} holds no mode that is stable over the model order: is it a free decay?")
    return _as_identified(start, records, budget)


def _as_identified(start: SampledModes, records: list[Record], budget: Budget) -> Identified:
    """Modes of given number: no test, none rejected."""
    refined, none = in_coloured_noise(refine(records, start, offset=True, budget=budget), records), np.zeros(0)
    return Identified(refined, none, 0.0, unshaped(none.astype(complex), records[0]), none)


def _check_undriven(record: Record) -> None:
    """Refuse a record that is as strong at its end as at its beginning and not correlated over its length.

    A free decay that hardly decays stays correlated at any lag; random vibration does not. Of
    records of twenty decay times three in four are detected, of a hundred nine in ten.
    """
    # Drifts may be strong at both ends, and do not oscillate.
    n = record.n_samples
    about = without_polynomial(record.outputs)
    about /= np.maximum(about.std(axis=1, keepdims=True), 1e-300)
    energy = [float(np.vdot(part, part)) for part in np.array_split(about, 2, axis=1)]
    # In single precision: in double, the transforms of a long record are four times its size.
    about = about.astype(np.float32)
    correlation = irfft(_power(about, 2 * n), 2 * n)[1:n] / (n - np.arange(1, n)) / len(about)
    forget_transforms(n)
    stretches = correlation[: n // 20 + 1], correlation[n // 3 : n // 2]
    soon, late = (float(np.sqrt((part**2).mean())) for part in stretches)
    # Noise is uncorrelated, and holds no mode; other checks say so.
    oscillates = soon > RING_DOWN.uncorrelated / np.sqrt(n)
    if (
        oscillates
        and RING_DOWN.as_strong < energy[1] / max(energy[0], 1e-300) < 1.0 / RING_DOWN.as_strong
        and late < RING_DOWN.correlated * soon
    ):
        raise ValueError(
            f"record {record.name!r} is no free decay: it is as strong at its end as at its beginning, and not"
            f" correlated over its length. {WAY_OUT}"
        )


def _power(rows: np.ndarray, size: int) -> np.ndarray:
    """|·|² of the transforms of rows, padded to a length, summed over them."""
    power = power_of(rows[0], size)
    for row in rows[1:]:
        power += power_of(row, size)
    return power


WAY_OUT = (
    "Cut it to where nothing drives it; or, driven all along, give its inputs (--inputs, identify_driven) or say that"
    " they are unknown (--ambient, identify_ambient)"
)


def _check_decays(records: list[Record], refined: Refined) -> None:
    """Refuse records whose strongest mode grows."""
    strongest = int(np.argmax(_energy(refined, records)))
    zeta = refined.modes.zeta[strongest]
    if zeta < -SURE * refined.zeta_std[strongest]:
        raise ValueError(
            f"record {records[0].name!r} grows: its strongest mode, {refined.modes.frequencies_hz[strongest]:.4g} Hz,"
            f" has a damping ratio of {zeta:.2g}. It is driven, or unstable; cut it to where it decays"
        )


def _unexplained(records: list[Record], left: list[np.ndarray], refined: Refined, coloured: bool) -> tuple[str, ...]:
    """A remark where the residual is large about the modes: forces excite them throughout.

    Noise of sensors is no larger there than beside.
    """
    for record, residual, noise in zip(records, left, refined.noise, strict=True):
        # in single precision, as transforms of a long record are several times its size
        scaled = ((part / noise[:, None]).astype(np.float32) for part in (residual, record.outputs))
        power, motion = (_power(part, record.n_samples)[1:] for part in scaled)
        bin_width = 2.0 * np.pi / (record.n_samples * record.sample_time)
        inside, beside = np.zeros((2, power.size), bool)
        for pole in refined.modes.poles:
            away = np.abs(np.arange(1, power.size + 1) - pole.imag / bin_width)
            narrow = max(RING_DOWN.band, abs(pole.real) / bin_width)
            inside |= away < narrow
            beside |= (away > 2.0 * narrow) & (away < RING_DOWN.beside + narrow)
        beside &= ~inside
        share, whole = (float(power[k].sum() / motion[k].sum()) for k in (inside, slice(None)))
        level = np.median(power[beside]) if beside.any() else 0.0
        about = share > RING_DOWN.residual_share and power[inside].mean() > RING_DOWN.stands_out * level
        if about or (whole > RING_DOWN.most_left and coloured):
            return (
                f"in record {record.name!r} the residual is {100 * np.sqrt(share):.0f} % of the motion about the"
                f" modes, {100 * np.sqrt(whole):.0f} % of all: it is driven, or depends strongly on amplitude."
                f" {WAY_OUT}",
            )
    return ()


def _energy(refined: Refined, records: list[Record]) -> np.ndarray:
    """Of each mode in all records, (n_modes,), each output in units of its noise."""
    found = np.zeros(refined.modes.n_modes)
    for record, amplitudes, noise in zip(records, refined.amplitudes, refined.noise, strict=True):
        lasts = power_sums(np.exp(2.0 * record.sample_time * refined.modes.poles.real), record.n_samples)[0].real
        found += (np.abs(amplitudes / noise[:, None]) ** 2).sum(axis=0) * lasts
    return found


def _of_other_shapes(refined: Refined, records: list[Record], only: Sequence[int]) -> tuple[str, ...]:
    """A remark on modes of which records have shapes that are not one, beyond noise: their amplitudes are of rank two.

    A mode of several records is one pole; two of the same pole are any mixture of two shapes in each.
    """
    rates, found = refined.modes.poles.real, []
    lasts = [power_sums(np.exp(2.0 * r.sample_time * rates), r.n_samples)[0].real for r in records]
    each = zip(refined.amplitudes, refined.noise, lasts, strict=True)
    # real and imaginary parts in units of their standard errors
    seen = np.stack([a / noise[:, None] * np.sqrt(0.5 * last) for a, noise, last in each])
    n_records, n_outputs, n_modes = seen.shape
    limit = chi2.isf(FALSE_ALARM / n_modes, 2 * (n_records - 1) * (n_outputs - 1))
    for r in only:
        squares = np.linalg.svd(seen[:, :, r], compute_uv=False) ** 2
        share = np.sqrt(squares[1:].sum() / squares.sum())
        if share > RING_DOWN.other_shape and squares[1:].sum() > limit:
            found.append(mode_text(r, refined.modes.frequencies_hz[r], f", {100 * share:.0f} %"))
    if not found:
        return ()
    return (
        f"the records have no one shape of {', '.join(found)}: two modes of one frequency, of which only the plane of"
        " their shapes is determined, not the shape that is given; or sensors that were moved or gained otherwise",
    )


def _goes_on(refined: Refined, records: list[Record]) -> tuple[str, ...]:
    """A remark where most of the motion does not decay."""
    span = max(record.n_samples * record.sample_time for record in records)
    lasting = refined.modes.zeta * refined.modes.omega * span < 0.1
    energy = _energy(refined, records)
    share = float(energy[lasting].sum() / energy.sum())
    if share < 0.5:
        return ()
    return (
        f"{100 * share:.0f} % of the motion does not decay within the record: harmonic excitation? Then leave these"
        " modes out, or cut the record to where it ends",
    )


def _shaken(refined: Refined, doubts: Sequence[str]) -> tuple[str, ...]:
    """A remark where modes of no sure damping crowd about a sure one, as ambient forces make them."""
    f, sure = refined.modes.frequencies_hz, np.array([not doubt for doubt in doubts])
    undamped = refined.modes.zeta < SURE * refined.zeta_std
    for r in np.flatnonzero(sure):
        about = np.flatnonzero(undamped & ~sure & (np.abs(f - f[r]) < RING_DOWN.about * f[r]))
        if about.size >= RING_DOWN.crowd:
            which = ", ".join(str(k + 1) for k in about)
            return (
                f"modes {which} crowd about mode {r + 1} and have no sure damping: forces drive this decay throughout,"
                f" and frequencies and damping are less sure than they are said to be. {WAY_OUT}",
            )
    return ()


def _coloured_residual(records: list[Record], left: list[np.ndarray]) -> tuple[str, ...]:
    """A remark where the residual is not white."""
    about = sum(float(r.outputs.var(axis=1).sum()) * r.n_samples for r in records)
    squares = sum(float(row @ row) for residual in left for row in residual)
    following = sum(float(row[1:] @ row[:-1]) for residual in left for row in residual)
    size = sum(residual.size for residual in left)
    if squares < 1e-12 * about or abs(following) < SURE * squares / np.sqrt(size):
        return ()
    share = 100 * np.sqrt(squares / about)
    return (
        f"the residual, {share:.3g} % of the motion, is not white: standard errors by its spectrum about each mode",
    )


def remarks(refined: Refined, records: Record | Sequence[Record]) -> tuple[str, ...]:
    """One remark a mode, empty where there is none.

    Slower than the record is long: a drift. A damping ratio not three standard errors above zero: a hum, if it goes on
    to the end, or, three below zero, a growth. A whole multiple of the frequency of a mode thirty times as strong:
    perhaps only the distortion of that one (a mode may stand there too: those of a hinged beam do). Damped more than
    0.3: it hardly rings, and may stand for a drift.
    """
    modes, found = refined.modes, []
    size = np.abs(np.stack(refined.amplitudes) / refined.noise[:, :, None]).max(axis=(0, 1))
    records = as_records(records)
    span = max(record.n_samples * record.sample_time for record in records)
    for r in range(modes.n_modes):
        f, zeta, doubt = modes.frequencies_hz[r], modes.zeta[r], SURE * refined.zeta_std[r]
        base, times = multiple_of(modes.frequencies_hz, size, r)
        if f * span < 1.0:
            found.append("period longer than the record: a drift?")
        elif zeta < -doubt:
            found.append("grows")
        elif base is not None:
            found.append(f"{times} × mode {base + 1}: its harmonic?")
        elif zeta < doubt:
            goes_on = zeta * modes.omega[r] * span < 1.0
            found.append("does not decay: mains hum?" if goes_on else "damping no larger than its error")
        elif zeta > SELECTION.most_damped:
            found.append("hardly rings: a drift?")
        else:
            found.append("")
    return tuple(found)
