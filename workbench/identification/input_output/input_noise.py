"""Noise of the measured inputs, which does not act on the structure: errors in variables, to first order.

Inputs measured as u + v leave the residual y - G (u + v) = e - G v: noise with a peak at each mode, common to all
outputs. In the lines of its cosine transform, output j has the power c_j / |A_j|² + Σ_i σ_i² |G_ji|² (Whittle 1953), G
the frequency response of the modes, A_j the filter of autoregressive noise of the sensor; c, A and σ² are estimated by
maximum likelihood. There is noise of inputs if residuals are more likely so than as coloured noise of the outputs
alone, whose peaks at modes each cost coefficients of A_j. A structure that changes leaves more at some modes than at
others, so one σ_i must fit all modes; and no σ_i exceeds the minimum of the input's own spectrum.

Modes are searched in outputs without the part of the noise that the inputs add, y - (1 - C^½ S^-½) (y - G (u + v)) with
C = diag(c / |A|²) and S = C + G diag(σ²) G^H at each line. They are then fitted to the outputs as measured, by least
squares, with the exact first-order covariance of these in the noise e - G v.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import next_fast_len
from scipy.ndimage import uniform_filter1d
from scipy.stats import chi2

from workbench.arrays import Complexes, Flags, Floats
from workbench.identification.input_output.fit_errors import covariance
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import (
    Fit,
    columns,
    free_parameters,
    projected,
    row_weights,
    tangent_weights,
)
from workbench.identification.input_output.model_order import SelectionOptions, sure_modes
from workbench.identification.input_output.noise_spectrum import autoregression, lines_of, samples_of
from workbench.identification.signal.projection import PROJECTION
from workbench.identification.signal.searches import FALSE_ALARM
from workbench.records.record import Record


@dataclass(frozen=True)
class InputNoiseSettings:
    """Constants of the estimation of the noise of the inputs."""

    colour_tolerance: float = 0.02  # relative change of the outputs' noise at any line, below which its estimation ends
    max_iterations: int = 60  # of the iteration for the levels, at most
    level_tolerance: float = 1e-3  # relative change of the level of each input, below which the iteration ends
    band_lines: int = 64  # lines over which the spectrum of an input is averaged for its minimum
    max_noise_ratio: float = 1.5  # times that minimum: upper bound of the noise; such an average scatters by a sixth
    half_bandwidths: float = 2.0  # to either side of a mode: its lines
    min_margin_lines: int = 6  # to either side, at least
    residual_probability: float = 1e-4  # that noise of the estimated level leaves as much at a mode as is observed
    # of the estimated level: least residual at a mode, of which the fit absorbs a part
    min_residual_ratio: float = 0.05


INPUT_NOISE = InputNoiseSettings()


@dataclass(frozen=True)
class InputNoise:
    """White noise of each input, and autoregressive noise of each output's sensor."""

    inputs: Floats  # (n_inputs,) standard deviation
    innovations: Floats  # (n_outputs,) standard deviation of the white noise that drives that of the sensor
    filters: tuple[Floats, ...]  # of each output, the prediction error filter [1, -a_1, ...] of that noise

    def sensors_at(self, phase: Floats) -> Floats:
        """Standard deviation of the sensors' noise at the phases ωΔt (n,): (n_outputs, n)."""
        return self.innovations[:, None] / [np.abs(np.polyval(a[::-1], np.exp(-1j * phase))) for a in self.filters]


def input_noise(data: KnownInputs, fit: Fit) -> InputNoise | None:
    """The noise of the inputs, estimated from the residual of the modes that are sure, in lines of equal weight; None
    where the inputs may be exact."""
    if fit.poles.size < 2 or not _noise_bound(data.records).any():  # a single mode does not distinguish input noise
        return None
    lines, gain = _residual_spectra(data, fit)
    noise = _likeliest_noise(data, lines, gain, _noise_bound(data.records))
    power, frequencies = lines**2, _frequencies(data)
    sensor_part, input_part = noise.sensors_at(frequencies * data.dt) ** 2, np.tensordot(noise.inputs**2, gain, 1)
    total = sensor_part + input_part
    coefficients = sum(a.size - 1 for a in noise.filters)
    cost = float((np.log(total) + power / total - 1.0).sum()) + coefficients * np.log(frequencies.size)
    cost_coloured = sum(autoregression(_by_record(data, output))[1] for output in lines)
    if cost_coloured - cost < len(lines) * chi2.isf(FALSE_ALARM, data.n_inputs):
        return None
    n_modes = 0
    for pole in fit.poles:
        width = max(INPUT_NOISE.half_bandwidths * abs(pole.real), INPUT_NOISE.min_margin_lines * 0.5 * data.resolution)
        near_mode = np.abs(frequencies - pole.imag) < width
        if (input_part[:, near_mode].mean(axis=1) > sensor_part[:, near_mode].mean(axis=1)).any():
            upper = chi2.isf(INPUT_NOISE.residual_probability, near_mode.sum()) / near_mode.sum()
            if not INPUT_NOISE.min_residual_ratio < (power[:, near_mode] / total[:, near_mode]).mean() < upper:
                return None
            n_modes += 1
    return noise if n_modes > 1 else None


def noise_levels(data: KnownInputs, fit: Fit, records: Sequence[Record]) -> InputNoise:
    """Maximum likelihood noise of a fit to samples of equal weight, inputs as measured in `records`."""
    return _likeliest_noise(data, *_residual_spectra(data, fit), _noise_bound(records))


def _residual_spectra(data: KnownInputs, fit: Fit) -> tuple[Floats, Floats]:
    """Of all records, lines of the residual (n_outputs, n_lines), and |G|² (n_inputs, n_outputs, n_lines)."""
    responses, leverage = _impulse_responses(data, fit), np.clip(data.leverage(fit), 0.0, PROJECTION.max_leverage)
    lines, gains = [], []
    for rows, residual in zip(data.rows, data.left(fit), strict=True):
        lines.append(lines_of(residual) / np.sqrt(1.0 - leverage[rows]))
        gains.append(np.abs(np.fft.rfft(responses, 2 * len(residual))[..., : len(residual)]) ** 2)
    return np.vstack(lines).T, np.concatenate(gains, axis=2)


def _noise_bound(records: Sequence[Record]) -> Floats:
    """Upper bound of the standard deviation of white noise in each input, (n_inputs,): its spectrum's minimum."""
    lowest = np.full(records[0].n_inputs, np.inf)
    for record in records:
        power = lines_of(record.inputs.T - record.inputs.mean(axis=1)) ** 2
        n = max(len(power) // INPUT_NOISE.band_lines, 1)
        bands = [band.mean(axis=0) for band in np.array_split(power, n)]
        lowest = np.minimum(lowest, np.min(bands, axis=0))
    return np.sqrt(INPUT_NOISE.max_noise_ratio * lowest)


def _frequencies(data: KnownInputs) -> Floats:
    """rad/s of the lines of all records, (n_lines,)."""
    return np.concatenate([np.linspace(0.0, data.highest, n, endpoint=False) for n in data.lengths])


def _by_record(data: KnownInputs, lines: Floats) -> list[Floats]:
    """The samples of each record from lines of all records, (n_lines,)."""
    return [samples_of(lines[rows]) for rows in data.rows]


def _likeliest_noise(data: KnownInputs, lines: Floats, gain: Floats, highest: Floats) -> InputNoise:
    """Maximum likelihood noise from lines (n_outputs, n_lines) and |G|² (n_inputs, n_outputs, n_lines).

    The sensors' noise has the spectrum c/|A|² and the share c/|A|² / S of the power S that is expected: lines times the
    root of that share are its own, of which A is estimated, and c and σ² beside A in turn.
    """
    phase, colour = _frequencies(data) * data.dt, np.ones(lines.shape)
    filters = tuple(np.ones(1) for _ in lines)
    for most in range(1, PROJECTION.max_ar_order + 1):
        # a low order first: of a high one the filter takes the peaks that the inputs explain, and leaves them slowly
        noise = InputNoise(*_likeliest_levels((lines / colour) ** 2, gain / colour**2, highest), filters)
        sensor_part = noise.sensors_at(phase) ** 2
        own = lines * np.sqrt(sensor_part / (sensor_part + np.tensordot(noise.inputs**2, gain, 1)))
        filters = tuple(autoregression(_by_record(data, output), most)[0] for output in own)
        before, colour = colour, replace(noise, innovations=np.ones(len(lines)), filters=filters).sensors_at(phase)
        if np.allclose(colour, before, rtol=INPUT_NOISE.colour_tolerance):
            break
    return noise


def _likeliest_levels(power: Floats, gain: Floats, highest: Floats) -> tuple[Floats, Floats]:
    """Maximum likelihood levels, (n_inputs,) and (n_outputs,), where the sensors' noise is white.

    From power (n_outputs, n_lines) and |G|² (n_inputs, n_outputs, n_lines). Those of the inputs are at most `highest`.
    By multiplicative steps, which keep variances positive (Févotte, Bertin & Durrieu, Neural Computation 21 (2009)
    793).
    """
    of_outputs = 0.5 * power.mean(axis=1)
    of_inputs = 0.5 * power.mean() / np.maximum(gain.mean(axis=(1, 2)), 1e-300) / len(gain)
    floor = PROJECTION.noise_free_ratio**2 * of_outputs + 1e-300
    for _ in range(INPUT_NOISE.max_iterations):
        total = of_outputs[:, None] + np.tensordot(of_inputs, gain, 1)
        inverse = 1.0 / total
        weighted_power = power * inverse**2
        step = np.tensordot(gain, weighted_power) / np.maximum(np.tensordot(gain, inverse), 1e-300)
        of_outputs = np.maximum(of_outputs * weighted_power.sum(axis=1) / inverse.sum(axis=1), floor)
        of_inputs = of_inputs * step
        if np.abs(step - 1.0).max() < INPUT_NOISE.level_tolerance:
            break
    return np.minimum(np.sqrt(of_inputs), highest), np.sqrt(of_outputs)


def with_white_noise(
    data: KnownInputs, fit: Fit, noise: InputNoise, options: SelectionOptions
) -> tuple[KnownInputs, Fit]:
    """The records with the expected inputs and outputs without the noise that these leave, and the modes."""
    data = replace(data, records=[_expected_inputs(record, noise) for record in data.records], line_std=None)
    gain = _residual_spectra(data, projected(data, fit.poles, fit.participation))[1]
    std = np.sqrt(noise.sensors_at(_frequencies(data) * data.dt) ** 2 + np.tensordot(noise.inputs**2, gain, 1)).T
    weighted = replace(data, line_std=[std[rows] / np.sqrt((std**2).mean(axis=0)) for rows in data.rows])
    # lines of equal weight may take the noise peak at a strong mode for a further mode; the weighted lines do not
    fit = sure_modes(weighted, projected(weighted, fit.poles, fit.participation), options)
    return _whitened(weighted, fit, noise), fit


def _expected_inputs(record: Record, noise: InputNoise) -> Record:
    """The record with the conditional expectation of its inputs given their measured values.

    A fraction 1 - σ²/S of each line is kept, S the measured power about it (regression calibration; Carroll et al.,
    Measurement Error in Nonlinear Models, 2nd ed., chapter 4): none beyond the band of the excitation.
    """
    level = record.inputs.mean(axis=1)
    lines = lines_of(record.inputs.T - level)
    measured_power = uniform_filter1d(lines**2, INPUT_NOISE.band_lines, axis=0, mode="nearest")
    kept = np.maximum(1.0 - noise.inputs**2 / np.maximum(measured_power, 1e-300), 0.0)
    return replace(record, inputs=(samples_of(kept * lines) + level).T)


def _whitened(data: KnownInputs, fit: Fit, noise: InputNoise) -> KnownInputs:
    """The records with outputs whose noise e - G v has the spectrum of e."""
    responses, records = _impulse_responses(data, fit), []
    for record, residual in zip(data.records, data.left(fit), strict=True):
        size = next_fast_len(len(residual) + responses.shape[2], real=True)
        sensors = noise.sensors_at(np.linspace(0.0, np.pi, size // 2 + 1)).T
        noise_gain = _spectra(responses, size) * noise.inputs / sensors[:, :, None]
        u, s, _ = np.linalg.svd(noise_gain, full_matrices=False)
        lines = np.fft.rfft(residual, size, axis=0) / sensors
        shared = np.einsum("fji,fj->fi", u.conj(), lines) * (1.0 - 1.0 / np.sqrt(1.0 + s**2))
        excess = np.fft.irfft(sensors.T * np.einsum("fji,fi->jf", u, shared), size)[:, : len(residual)]
        outputs = record.outputs.copy()
        outputs[:, data.first :] -= excess
        records.append(replace(record, outputs=outputs))
    return replace(data, records=records, measured=data.records, line_std=None)


def spread_by_inputs(data: KnownInputs, fit: Fit, std: Floats, acts: Sequence[Flags]) -> Floats:
    """Covariance of a fit due to white noise of the inputs: of the free unknowns, then of the coefficients of each
    output, one output after the other.

    Args:
        std: (n_inputs,) of that noise.
        acts: of each record (n_inputs, n_samples), the samples whose input is noisy.
    """
    phi, tangents = columns(data, fit.poles, fit.participation)
    free, bound, responses = free_parameters(fit), covariance(fit), _impulse_responses(data, fit)
    weights = row_weights(data)
    total: Floats = np.zeros((free.size + fit.coefficients.size,) * 2)
    for rows, n, noisy in zip(data.rows, data.lengths, acts, strict=True):
        size = next_fast_len(n + responses.shape[2], real=True)
        spectra = _spectra(responses, size).conj()
        for i in np.flatnonzero(std):
            unknowns, along, effects = np.zeros((n, free.size)), [], []
            for part, outputs in fit.outputs():
                jacobian, rest = (tangent_weights(fit, part)[:, free], tangents[rows] - phi[rows] @ part.tilt)
                for k, j in enumerate(range(outputs.start, outputs.stop)):
                    square = weights[rows, j, None] ** 2 if len(weights) > 1 else 1.0
                    terms = data.samples(square * np.hstack([rest, phi[rows]]))
                    terms = np.fft.irfft(spectra[:, j, i, None] * np.fft.rfft(terms, size, axis=0), size, axis=0)[:n]
                    unknowns += terms[:, : rest.shape[1]] @ jacobian[:, :, k] / fit.noise[j] ** 2
                    along.append(terms[:, rest.shape[1] :] @ part.spread)
                    effects.append(part.tilt @ jacobian[:, :, k])
            unknowns = unknowns @ bound
            each = [z - unknowns @ drift.T for z, drift in zip(along, effects, strict=True)]
            error = std[i] * np.hstack([unknowns, *each])[noisy[i, data.first :]]
            total += error.T @ error
    return total


def noise_outside_impacts(logged: Sequence[Record], windowed: Sequence[Record]) -> Floats:
    """Standard deviation of the noise that force windows removed from each input, (n_inputs,): impacts hold it too."""
    squares, counts = np.zeros((2, logged[0].n_inputs))
    for before, after in zip(logged, windowed, strict=True):
        windowed_inputs = (before.inputs != after.inputs).any(axis=1)[:, None]
        removed = windowed_inputs & (after.inputs == 0.0)
        offset = np.median(before.inputs, axis=1, keepdims=True)
        squares += np.where(removed, (before.inputs - offset) ** 2, 0.0).sum(axis=1)
        counts += removed.sum(axis=1)
    return np.sqrt(squares / np.maximum(counts, 1.0))


def noise_remarks(records: Sequence[Record], noise: InputNoise) -> tuple[str, ...]:
    """A remark on the noise of the inputs."""
    rms = np.sqrt(np.hstack([record.inputs**2 for record in records]).mean(axis=1))
    which = [
        f"input {name} {std:.2g} rms ({100 * std / size:.2g} % of it)"
        for name, std, size in zip(records[0].input_names, noise.inputs, rms, strict=True)
        if std > 0
    ]
    if not which:
        return ()
    return (f"inputs contain measurement noise: {', '.join(which)}; standard errors allow for it",)


def _impulse_responses(data: KnownInputs, fit: Fit) -> Floats:
    """Responses of the outputs to a unit sample at the start of each input, (n_inputs, n_outputs, n_samples)."""
    longest = max(data.records, key=lambda record: record.n_samples)
    n, m = longest.n_samples, data.n_inputs
    records = []
    for i in range(m):
        inputs = np.zeros((m, n))
        inputs[i, 1] = 1.0  # the first sample of a record from rest has no effect
        records.append(replace(longest, inputs=inputs, outputs=np.zeros((longest.n_outputs, n))))
    impulses = replace(data, records=records, line_std=None, at_rest=True, drift=0, beside=None, changing=())
    phi = columns(impulses, fit.poles, fit.participation[:, :m])[0]
    k = 2 * fit.poles.size + (phi.shape[1] - 2 * fit.poles.size - m if data.has_direct else 0)
    return np.array([each[1:].T for each in impulses.as_samples(phi[:, :k] @ fit.coefficients[:k])])


def _spectra(responses: Floats, size: int) -> Complexes:
    """The frequency response G at each line, (n_lines, n_outputs, n_inputs)."""
    return np.asarray(np.fft.rfft(responses, size).transpose(2, 1, 0))
