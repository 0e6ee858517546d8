"""Breakdown of the gap between simulation and test: by path, record, mode, band, time, sensor and level."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from workbench.arrays import Flags, Floats
from workbench.gap.effects.effect import Effect
from workbench.gap.localisation.force_location import ForceLocation
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.prediction.residuals import scale_of
from workbench.identification.signal.distortion import distortion_of, period_of
from workbench.records.record import Record
from workbench.rig.linear import first_order_hold_response, held_response, modal_motion, modal_poles
from workbench.rig.rig import Rig, participation_of


@dataclass(frozen=True)
class BreakdownSettings:
    """Constants of the breakdown of the gap."""

    min_mode_share: float = 0.05  # of the gap: modes with more are named
    one_sensor_share: float = 0.97  # of the gap: with more in one sensor, that sensor alone disagrees
    octaves: int = 8  # below half the sample rate
    noise_margin: float = 0.1  # of the noise: a gap above it by less does not count
    # of the frequencies of resonators about a mode to its own. The response of lightly damped modes is longer than any
    # segment of a record, so that coherence by averaged spectra would miss most of it; a change of a mode's frequency,
    # damping or gain lies nearly in the span of resonators close to the mode
    tuning_ratios: tuple[float, ...] = (0.85, 0.93, 0.97, 0.99, 1.0, 1.01, 1.03, 1.07, 1.15)
    max_modes: int = 6  # that have resonators
    rigid_band_ratio: float = 0.5  # of the frequency of the first elastic mode: the end of the band of rigid modes
    last_band_ratio: float = 1.15  # of the frequency of the last mode: the end of its band
    level_ratio: float = 2.0  # of levels or gaps: smaller ones say nothing of a dependence on amplitude
    min_linear_share: float = 0.9  # of the gap's power: if a linear model explains more, the gap is linear
    unexcited_share: float = 1e-3  # of the largest line of the inputs: lines below it are not excited
    min_distortion_ratio: float = 10.0  # power of the gap on lines not excited over that of noise: more is distortion
    hum_lines: int = 3  # strongest of these lines in each octave that do not count, as they may be mains hum
    periods: int = 3  # last periods of a record that are used; the first of them only for the drift


BREAKDOWN = BreakdownSettings()
RIDGES = np.logspace(-9, -1, 9)  # ridge parameters, of the largest eigenvalue, for cross-validation


@dataclass(frozen=True, eq=False)
class GapBreakdown:
    """Breakdown of the gap of the nominal model.

    Shares are of the squared residual above the noise, each sensor scaled by its own standard deviation, over the
    records whose gap is clearly above the noise, or over all records if there are none.

    Attributes:
        path: "actuator", "structure", "sensor", "environment", or "none".
        modes: one-based numbers of the modes with at least a twentieth of the gap around their frequencies; rigid
            modes share one band, so all or none of them.
        amplitude_dependent: whether the gap changes with level; None if the records do not show it.
        mode_shares: (n_modes,) share of the gap in the band around each natural frequency; rigid modes have equal parts
            of the band below half the first elastic frequency.
        share_above: of the gap, above the band of the last mode.
        band_edges_hz: (n_bands + 1,) octaves down from half the highest sample rate, the lowest open to zero.
        band_shares: (n_bands,) share of the gap in each.
        sensor_shares: (n_outputs,).
        time_shares: (n_records, 8) of each record's gap, by eighths of its length.
        record_gaps: (n_records,) gap as the case format defines it.
        record_floors: (n_records,) the same of the noise alone.
        input_levels: (n_records,) root mean square of the inputs.
        linear_share: of the gap's power that one linear model of the inputs explains.
        distortions: (n_records, 2) power of the gap on odd and on even lines that periodic inputs do not excite, over
            that of noise and transients; zero if inputs are not periodic.
        place: of an unmodelled force of any law: `at` and `at_std`, m; and whether it is one force.
    """

    path: str
    modes: tuple[int, ...]
    amplitude_dependent: bool | None
    mode_shares: np.ndarray
    share_above: float
    band_edges_hz: np.ndarray
    band_shares: np.ndarray
    sensor_shares: np.ndarray
    time_shares: np.ndarray
    record_names: tuple[str, ...]
    record_gaps: np.ndarray
    record_floors: np.ndarray
    input_levels: np.ndarray
    linear_share: float
    distortions: np.ndarray
    place: ForceLocation

    @property
    def is_distorted(self) -> bool:
        """Whether periodic inputs show a nonlinearity, before any law is assumed."""
        return bool(self.distortions.max() > BREAKDOWN.min_distortion_ratio)

    @property
    def at(self) -> Any:
        return self.place.at

    @property
    def at_std(self) -> float:
        return self.place.at_std

    @property
    def beyond_noise(self) -> float:
        """The largest gap of a record that is clearly above its noise, the noise subtracted, over the signal."""
        clear = _is_clear(self.record_gaps, self.record_floors)
        power = np.where(clear, self.record_gaps**2 - self.record_floors**2, 0.0)
        return float(np.sqrt(power.max()))


def _is_clear(gaps: Floats, floors: Floats) -> Flags:
    """Whether the gap of each record (n_records,) is clearly above its noise."""
    return np.asarray(gaps > (1.0 + BREAKDOWN.noise_margin) * floors)


def break_down(reconstruction: ForceReconstruction, effects: Sequence[Effect], place: ForceLocation) -> GapBreakdown:
    """Break down the gap of the nominal rig on the fit records; `effects` that explain it, if known, give the path."""
    rig, data = reconstruction.rig, reconstruction.data
    scales = [scale_of(record.outputs) for record in data.counted]
    scaled = [r / scale for r, scale in zip(reconstruction.residuals, scales, strict=True)]
    floors = np.array([(data.noise / scale[:, 0]) ** 2 for scale in scales])
    excess = np.array([(s**2).mean(axis=1) for s in scaled]) - floors
    gaps = np.array([np.sqrt((s**2).mean()) for s in scaled])
    noise = np.sqrt(floors.mean(axis=1))
    clear = _is_clear(gaps, noise)
    with_gap = np.flatnonzero(clear if clear.any() else ~clear)  # noise alone, scaled by itself, would count as a gap
    by_sensor = np.maximum(excess[with_gap], 0.0).sum(axis=0)
    seen = [(scaled[i], data.counted[i].sample_time, float(floors[i].sum())) for i in with_gap]
    frequencies = rig.modes.frequencies_hz
    mode_shares, above = _by_mode(frequencies, seen)
    in_band = np.where(frequencies > 0, mode_shares, mode_shares[frequencies == 0].sum())
    fastest = min(record.sample_time for record in data.counted)
    octaves = np.r_[0.0, 0.5 / fastest * 2.0 ** np.arange(1 - BREAKDOWN.octaves, 1)]
    levels = np.array([np.sqrt(np.mean(record.inputs**2)) for record in data.counted])
    both = list(zip(data.counted, reconstruction.residuals, strict=True))
    share = linear_share(rig, [both[i] for i in with_gap], mode_shares)
    distortions = np.array([_distortion(rig, record, residual) for record, residual in both])
    return GapBreakdown(
        path=_path(reconstruction, excess, floors.mean(axis=1), by_sensor, effects),
        modes=tuple(int(r) + 1 for r in np.flatnonzero(in_band > BREAKDOWN.min_mode_share)),
        amplitude_dependent=_amplitude_dependent(effects, gaps, noise, levels, share, distortions),
        mode_shares=mode_shares,
        share_above=above,
        band_edges_hz=octaves,
        band_shares=_shares_between(octaves, seen),
        sensor_shares=by_sensor / max(by_sensor.sum(), 1e-300),
        time_shares=np.array([_shares_of_eighths(s) for s in scaled]),
        record_names=tuple(record.name for record in data.counted),
        record_gaps=gaps,
        record_floors=noise,
        input_levels=levels,
        linear_share=share,
        distortions=distortions,
        place=place,
    )


def _by_mode(frequencies: Floats, seen: Sequence[tuple[Floats, float, float]]) -> tuple[Floats, float]:
    """Share of the residuals' power in the band of each mode (n_modes,), and above that of the last.

    Rigid modes share one band in equal parts; `seen`: as of `_shares_between`.
    """
    elastic = frequencies[frequencies > 0]
    first = BREAKDOWN.rigid_band_ratio * elastic[:1] * (elastic.size < frequencies.size)  # zero: an empty band
    # geometric means, as the width of a peak is proportional to its frequency; `setup.comparison`, which compares whole
    # signals, takes arithmetic means
    edges = np.r_[0.0, first, np.sqrt(elastic[1:] * elastic[:-1]), BREAKDOWN.last_band_ratio * elastic[-1:], np.inf]
    rigid, *others = _shares_between(edges, seen)
    above = others.pop() if others else 0.0  # with only rigid modes, there is one band
    n_rigid = frequencies.size - len(others)
    return np.r_[np.full(n_rigid, rigid / max(n_rigid, 1)), others], float(above)


def _shares_between(edges: np.ndarray, seen: Sequence[tuple[Floats, float, float]]) -> np.ndarray:
    """Share of the residuals' power above the noise between each edge (n_bands + 1,), Hz, and the next.

    seen: a record's scaled residual (n_outputs, n_samples), its sample time, and the power of its noise.
    """
    power = np.zeros(edges.size - 1)
    for s, sample_time, floor in seen:
        spectrum = (np.abs(np.fft.rfft(s, axis=1)) ** 2).sum(axis=0) / s.shape[1]
        grid = np.fft.rfftfreq(s.shape[1], sample_time)
        band = np.clip(np.searchsorted(edges, grid, side="right") - 1, 0, power.size - 1)
        power += np.bincount(band, spectrum - floor, power.size)
    power = np.maximum(power, 0.0)
    return power / max(float(power.sum()), 1e-300)


def _shares_of_eighths(scaled: Floats) -> Floats:
    """Share of the power in each eighth of a record (8,)."""
    power = np.array([(piece**2).sum() for piece in np.array_split(scaled, 8, axis=1)])
    return np.asarray(power / max(float(power.sum()), 1e-300))


def _path(
    reconstruction: ForceReconstruction, excess: Floats, floors: Floats, power: Floats, effects: Sequence[Effect]
) -> str:
    """Path of the first effect, or a guess from the sensors and inputs that show the gap.

    excess: (n_records, n_outputs) scaled power above the noise; floors: (n_records,) that of the noise, the mean over
    sensors; power: (n_outputs,) above the noise in all records.
    """
    if effects:
        return effects[0].kind.path
    left = np.concatenate([(r / reconstruction.data.noise[:, None]).ravel() for r in reconstruction.residuals])
    if power.sum() <= 0 or reconstruction.data.by_channel(left).mean() < 1.03:
        return "none"
    if of_one_sensor(power):
        return "sensor"
    direct = {a.name for a in reconstruction.rig.actuators if a.direct}
    for record, row, floor in zip(reconstruction.data.counted, excess, floors, strict=True):
        active = {n for n, values in zip(record.input_names, record.inputs, strict=True) if np.any(values)}
        if active and active <= direct:
            return "structure" if row.mean() > 0.1 * floor else "actuator"
    return "structure"


def of_one_sensor(excess: np.ndarray) -> bool:
    """Whether one sensor alone disagrees, given the power above the noise of each (n_outputs,)."""
    return bool(excess.max() > BREAKDOWN.one_sensor_share * excess.sum())


def _amplitude_dependent(
    effects: Sequence[Effect], gaps: Floats, floors: Floats, levels: Floats, linear: float, distortions: Floats
) -> bool | None:
    """Whether the gap changes with level; None if that is not established."""
    if effects:
        return any(effect.kind.nonlinear for effect in effects)
    above = np.sqrt(np.maximum(gaps**2 - floors**2, 0.0))
    sizes = above + floors
    grows = sizes.max() > BREAKDOWN.level_ratio * sizes.min() and above.max() > BREAKDOWN.level_ratio * floors.max()
    if grows or distortions.max() > BREAKDOWN.min_distortion_ratio:
        return True
    is_linear = linear > BREAKDOWN.min_linear_share and levels.max() > BREAKDOWN.level_ratio * levels.min()
    return False if is_linear else None


def _distortion(rig: Rig, record: Record, residual: Floats) -> Floats:
    """Power of the gap on odd and on even lines that periodic inputs do not excite, over that of noise and transients.

    A transient that decays by exp(-a) a period appears on all lines; its mean over two periods is 1 / tanh(a / 2) times
    half their difference. A drift of a sensor is subtracted first.
    """
    period = period_of(record.inputs)
    if period is None or record.n_samples < BREAKDOWN.periods * period:
        return np.zeros(2)
    last = slice(record.n_samples - BREAKDOWN.periods * period, None)
    means = residual[:, last].reshape(residual.shape[0], BREAKDOWN.periods, period).mean(axis=2)
    drift = (means[:, -1] - means[:, -2])[:, None] / period * np.arange(BREAKDOWN.periods * period)
    try:
        found = distortion_of(replace(record, inputs=record.inputs[:, last], outputs=residual[:, last] - drift))
    except ValueError:  # these few periods do not repeat well enough
        return np.zeros(2)
    free = found.input_amplitudes < BREAKDOWN.unexcited_share * found.input_amplitudes.max()
    octave = np.floor(np.log2(np.arange(1, free.size + 1)))  # noise of other bands may be far louder
    decay = float((rig.modes.zeta * rig.modes.omega).min()) * period * record.sample_time
    settled = np.tanh(0.5 * decay) ** 2
    most = np.zeros(2)
    for i, lines in enumerate((found.odd & free, found.even & free)):
        for each in range(int(octave[-1]) + 1):
            chosen = lines & (octave == each)
            if chosen.sum() > BREAKDOWN.hum_lines:
                power = np.sort(found.amplitudes[:, chosen] ** 2, axis=1)[:, : -BREAKDOWN.hum_lines].sum(axis=1)
                noise = np.maximum((found.noise[:, chosen] ** 2).sum(axis=1), 1e-300)
                most[i] = max(most[i], settled * float((power / noise).max()))
    return most


def linear_share(rig: Rig, seen: Sequence[tuple[Record, Floats]], shares: Floats) -> float:
    """Share of the residuals' power that one linear model of the inputs explains in all records (cross-validated).

    Ridge regression on resonators is trained on all records but one and validated on that one, each in turn: without
    validation, resonators would fit any narrow-band residual, which has few degrees of freedom. A single record is
    halved.

    shares: (n_modes,) of the gap around each mode; only the modes with the largest shares are used.
    """
    chosen = [int(r) for r in np.argsort(-shares)[: BREAKDOWN.max_modes] if shares[r] > 0]
    sizes = np.sqrt(np.mean([record.outputs.var(axis=1) for record, _ in seen], axis=0))[:, None]
    sizes = np.where(sizes > 0, sizes, 1.0)
    pieces = []
    for record, residual in seen:
        # regressors and residual are divided by the level, so that every record has equal weight in the same model
        level = np.sqrt(np.mean((record.outputs / sizes) ** 2)) or 1.0
        pieces.append((_regressors(rig, chosen, record) / level, residual / sizes / level))
    if len(pieces) == 1:
        half = pieces[0][0].shape[1] // 2
        pieces = [(x[:, part], y[:, part]) for x, y in pieces for part in (slice(half), slice(half, None))]
    scale = np.sqrt(sum((x**2).sum(axis=1) for x, _ in pieces))
    pieces = [(x[scale > 0] / scale[scale > 0, None], y) for x, y in pieces]
    normal, right = [x @ x.T for x, _ in pieces], [x @ y.T for x, y in pieces]
    left = np.zeros(RIDGES.size)
    for (x, y), own_normal, own_right in zip(pieces, normal, right, strict=True):
        strengths, axes = np.linalg.eigh(sum(normal) - own_normal)
        if not (strengths > 0).any():  # no other record has inputs to train on
            left += float((y**2).sum())
            continue
        target, shown = axes.T @ (sum(right) - own_right), axes.T @ x
        for i, ridge in enumerate(RIDGES * strengths[-1]):
            weights = target / (np.maximum(strengths, 0.0) + ridge)[:, None]
            left[i] += min(float(((y - weights.T @ shown) ** 2).sum()), float((y**2).sum()))
    whole = sum(float((y**2).sum()) for _, y in pieces)
    return float(np.clip(1.0 - left.min() / whole, 0.0, 1.0)) if whole > 0 else 0.0


def _regressors(rig: Rig, chosen: Sequence[int], record: Record) -> np.ndarray:
    """Regressors (n_regressors, n_samples) of a linear model of the gap.

    The response of each mode to each input alone, for changed participation factors; and of resonators of neighbouring
    frequencies to the modal force, for a changed frequency or damping.
    """
    if not chosen:
        return record.inputs
    slowest = 2.0 * np.pi / (record.n_samples * record.sample_time)
    alone, acting = np.eye(len(rig.actuators)), participation_of(rig)
    omega = np.maximum(rig.modes.omega[chosen], slowest)[:, None] * np.r_[np.ones(len(alone)), BREAKDOWN.tuning_ratios]
    damping = np.maximum(np.diag(rig.modes.damping)[chosen, None], 1e-3 * omega)
    driven = np.array([row for r in chosen for row in (*alone, *[acting[r]] * len(BREAKDOWN.tuning_ratios))])
    resonators = modal_poles(omega.ravel(), np.diag(damping.ravel()))
    response_to = held_response if record.input_hold == "zero" else first_order_hold_response
    response, _ = response_to(resonators, record.inputs, driven, record.sample_time)
    return np.concatenate([record.inputs, *modal_motion(resonators, response)])
