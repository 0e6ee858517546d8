"""A record as a user has it to the modes in it, in one call."""

from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.legendre import legvander

from workbench.identification.ailments import ailments, check_fit
from workbench.identification.amplitude import AmplitudeDependence, amplitude_dependence
from workbench.identification.decay import decay_start
from workbench.identification.drift import HIGHEST_DEGREE, without_drift
from workbench.identification.ibrahim import stacked_delays
from workbench.identification.order import Identified, identify, unshaped
from workbench.identification.refinement import Refined, project, refine
from workbench.identification.remarks import SURE, remarks
from workbench.identification.stabilisation import real_modes, stabilise
from workbench.records.record import Record
from workbench.structure.modes import SampledModes

MOST_MODES = 20
DRIFT_ROUNDS = 3
# Energy of the second half over that of the first, either way; such a record must know its phase after a third of it.
AS_STRONG, REMEMBERED = 0.5, 0.5
# Correlation of noise, times the root of its samples, is 1.
FORGETFUL = 3.0


@dataclass(frozen=True, eq=False)
class RingDown:
    """What a record holds.

    Attributes:
        record: what was read: from the start of the free decay on, without drift.
        refined: its modes.
        remarks: one a mode, empty where nothing speaks against it.
        noise_modes: tried and taken for noise.
        noise_evidence: (n_noise,) theirs, below `limit`.
        limit: evidence from which on a mode counts.
        by_amplitude: its modes stretch by stretch of the decay.
        notes: what was done to the record, and what is left over.
    """

    record: Record = field(repr=False)
    refined: Refined
    remarks: tuple[str, ...]
    noise_modes: SampledModes = field(repr=False)
    noise_evidence: np.ndarray = field(repr=False)
    limit: float
    by_amplitude: AmplitudeDependence
    notes: tuple[str, ...]


def ring_down(record: Record, *, start: float | None = None, n_modes: int | None = None) -> RingDown:
    """The modes of a record that becomes free decay.

    It is cut where free decay begins and no sample is cut off any more, and a drift is taken out. Unless their number
    is given, the modes are those that rise above the noise.

    Args:
        record: of any length before and after the decay.
        start: where the decay is free, s; found unless given.
        n_modes: as many as are to be found.

    Raises:
        ValueError: a sensor ails; too few samples; nothing in the record that decays freely.
    """
    notes: list[str] = []
    if start is None:
        start, notes = _start(record)
    cut = record.between(start)
    check_fit(cut)
    _check_undriven(cut)
    try:
        found, cut, more = _without_drift(cut, n_modes)
    except np.linalg.LinAlgError:
        found, more = _by_stabilisation(cut), ("the order could not be told by likelihood: by stabilisation instead",)
    _check_decays(cut, found.refined)
    return RingDown(
        cut,
        found.refined,
        remarks(found.refined, cut),
        found.noise_modes,
        found.noise_evidence,
        found.limit,
        amplitude_dependence(cut, found.refined),
        (*notes, *more, *_left_over(cut, found.refined)),
    )


def _start(record: Record) -> tuple[float, list[str]]:
    """Where free decay begins and nothing is clipped any more, and what to say of it."""
    start, notes = decay_start(record), []
    if start > record.start_time:
        notes.append(f"free decay from {start:.6g} s on; --start sets another time")
    clipped = [a for a in ailments(record.between(start)) if a.until is not None]
    behind = max((a.until or start for a in clipped), default=start) + record.sample_time
    if clipped and behind - start < 0.5 * (record.time[-1] - start):
        notes.append(f"output {clipped[0].outputs[0]!r} is cut off at an end of its range: read from {behind:.6g} s on")
        start = behind
    return start, notes


def _without_drift(record: Record, n_modes: int | None) -> tuple[Identified, Record, tuple[str, ...]]:
    """Modes and drift in turn, as each hides in the other, until neither changes."""
    size, cleared, poles = np.zeros(record.n_outputs), record, np.zeros(0, complex)
    span = record.n_samples * record.sample_time
    for _ in range(DRIFT_ROUNDS):
        found = _identified(cleared, n_modes)
        before, poles = poles, found.modes.poles
        poles = poles[np.abs(poles) * span > 2.0 * np.pi]
        drift = without_drift(record, poles)
        if not drift.size.any() or (poles.size == before.size and size.any()):
            break
        cleared, size = drift.record, drift.size
    if not size.any():
        return found, record, ()
    largest = int(np.argmax(size / found.refined.noise_std))
    if size[largest] < found.refined.noise_std[largest]:
        return found, cleared, ()
    name = record.output_names[largest]
    return found, cleared, (f"a drift of {size[largest]:.3g} was taken out of output {name!r}",)


def _identified(record: Record, n_modes: int | None) -> Identified:
    if n_modes is None:
        return identify(record)
    if n_modes < 1:
        raise ValueError(f"at least one mode must be asked for; got {n_modes}")
    return _as_identified(refine(record, stacked_delays(record, n_modes=n_modes), offset=True), record)


def _by_stabilisation(record: Record) -> Identified:
    highest = max(2, min(MOST_MODES, record.n_samples // 8))
    start = real_modes(stabilise(record, orders=range(2, highest + 1))).modes
    if start.n_modes == 0:
        raise ValueError(f"record {record.name!r} holds no mode that stays from order to order: is it a free decay?")
    return _as_identified(refine(record, start, offset=True), record)


def _as_identified(refined: Refined, record: Record) -> Identified:
    """Modes that were asked for: no evidence, none refused."""
    none = np.zeros(0)
    return Identified(refined, none, 0.0, unshaped(none.astype(complex), record), none)


def _check_undriven(record: Record) -> None:
    """Refuse a record that is as strong at its end as at its beginning and has forgotten its phase meanwhile.

    A free decay that hardly decays repeats itself after any time; what random forces drive forgets. Of
    records of twenty decay times three in four are told, of a hundred nine in ten.
    """
    # Drifts may be strong at both ends, and swing not at all.
    n = record.n_samples
    slow = np.linalg.qr(legvander(np.linspace(-1.0, 1.0, n), HIGHEST_DEGREE))[0]
    about = record.outputs - (record.outputs @ slow) @ slow.T
    about = about / np.maximum(about.std(axis=1, keepdims=True), 1e-300)
    energy = [float((part**2).sum()) for part in np.array_split(about, 2, axis=1)]
    power = (np.abs(np.fft.rfft(about, 2 * n, axis=1)) ** 2).sum(axis=0)
    correlation = np.fft.irfft(power)[1:n] / (n - np.arange(1, n)) / len(about)
    soon, late = (
        float(np.sqrt((part**2).mean())) for part in (correlation[: n // 20 + 1], correlation[n // 3 : n // 2])
    )
    # Noise forgets at once, and holds no mode; that is said elsewhere.
    swings = soon > FORGETFUL / np.sqrt(n)
    if swings and AS_STRONG < energy[1] / max(energy[0], 1e-300) < 1.0 / AS_STRONG and late < REMEMBERED * soon:
        raise ValueError(
            f"record {record.name!r} is no free decay: it is as strong at its end as at its beginning, and has"
            " forgotten its phase. Cut it to where nothing drives it; or, if unknown forces drive it all along, take"
            " ambient_decays"
        )


def _check_decays(record: Record, refined: Refined) -> None:
    """Refuse a record whose strongest mode grows."""
    strongest = int(np.argmax((np.abs(refined.amplitudes[0] / refined.noise_std[:, None]) ** 2).sum(axis=0)))
    zeta = refined.modes.zeta[strongest]
    if zeta < -SURE * refined.zeta_std[strongest]:
        raise ValueError(
            f"record {record.name!r} grows: its strongest mode, {refined.modes.frequencies_hz[strongest]:.4g} Hz, has a"
            f" damping ratio of {zeta:.2g}. It is driven, or unstable; cut it to where it decays"
        )


def _left_over(record: Record, refined: Refined) -> tuple[str, ...]:
    """What to say of what the modes leave, where it is not noise."""
    residual = project(record, refined.modes.poles, True).residual.T
    about = record.outputs - record.outputs.mean(axis=1, keepdims=True)
    share = float((residual**2).sum() / (about**2).sum())
    coloured = float((residual[:, 1:] * residual[:, :-1]).sum() / np.maximum((residual**2).sum(), 1e-300))
    if share < 1e-12 or abs(coloured) < SURE / np.sqrt(residual.size):
        return ()
    return (f"what the modes leave, {100 * np.sqrt(share):.2g} % of the motion, is not white: trust errors less",)
