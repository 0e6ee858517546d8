"""Noise of the logged inputs, which the structure never felt: errors in variables, to first order.

Inputs logged as u + v leave y - G (u + v) = e - G v of the outputs: noise with a peak at each mode, which all outputs
share. Of the lines of its cosine transform, output j has the power c_j + Σ_i σ_i² |G_ji|² (Whittle 1953), G the
response of the modes; c and σ² are found from it. A structure that changes leaves more at some modes than at others,
so that one σ_i has to suit them all; and no σ_i is more than the input's own spectrum where it is least.

Modes are searched in outputs whose noise is made white, y - (1 - C^½ S^-½) (y - G (u + v)) with C = diag(c) and
S = C + G diag(σ²) G^H at each line. They are then fitted to the outputs as measured, by least squares, with the exact
first-order covariance of these in the noise e - G v.
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
from workbench.identification.input_output.modal_fit import Fit, columns, free_parameters, projected, tangent_weights
from workbench.identification.input_output.model_order import sure_modes
from workbench.identification.input_output.noise_spectrum import lines_of, samples_of
from workbench.identification.signal.projection import PROJECTION
from workbench.identification.signal.searches import FALSE_ALARM, Budget
from workbench.records.record import Record


@dataclass(frozen=True)
class InputNoiseSettings:
    """Constants of the search for noise of the inputs."""

    steps: int = 60  # to the levels, at most
    settled: float = 1e-3  # relative change of the level of each input, below which they are found
    band: int = 64  # lines over which the spectrum of an input is averaged for its least part
    least: float = 1.5  # times that part, which noise has at most: such a mean scatters by a sixth
    about: float = 2.0  # half bandwidths to either side of a mode, in which its lines count
    lines: int = 6  # to either side, at least
    chance: float = 1e-4  # that noise of one level leaves so much more at a mode
    faintest: float = 0.05  # of that level, what is left at a mode at least: the fit took more of it than it counts


INPUT_NOISE = InputNoiseSettings()


@dataclass(frozen=True)
class InputNoise:
    """Standard deviations of white noise: of each input, (n_inputs,), and of each output's own, (n_outputs,)."""

    inputs: Floats
    outputs: Floats


def input_noise(data: KnownInputs, fit: Fit) -> InputNoise | None:
    """The noise of the inputs by what modes leave; None where inputs may be exact.

    Args:
        data: lines of equal weight.
        fit: of the modes that are sure.
    """
    if fit.poles.size < 2 or not _quietest(data.records).any():  # one mode tells noise of an input from no other thing
        return None
    power, gain = _spectra_left(data, fit)
    noise = _levels(power, gain, _quietest(data.records))
    own, through = noise.outputs[:, None] ** 2, np.tensordot(noise.inputs**2, gain, 1)
    flat, whole = power.mean(axis=1, keepdims=True), own + through
    gained = float((np.log(flat / whole) + power / flat - power / whole).sum())
    if gained < len(own) * chi2.isf(FALSE_ALARM, data.n_inputs):
        return None
    seen, each = 0, [np.linspace(0.0, data.highest, rows.stop - rows.start, endpoint=False) for rows in data.rows]
    frequencies = np.concatenate(each)
    for pole in fit.poles:
        width = max(INPUT_NOISE.about * abs(pole.real), INPUT_NOISE.lines * 0.5 * data.resolution)
        about = np.abs(frequencies - pole.imag) < width
        if (through[:, about].mean(axis=1) > own[:, 0]).any():
            most = chi2.isf(INPUT_NOISE.chance, about.sum()) / about.sum()
            if not INPUT_NOISE.faintest < (power[:, about] / whole[:, about]).mean() < most:
                return None
            seen += 1
    return noise if seen > 1 else None


def noise_levels(data: KnownInputs, fit: Fit, records: Sequence[Record]) -> InputNoise:
    """Those that make what modes leave of samples of equal weight most likely, inputs being logged as in `records`."""
    return _levels(*_spectra_left(data, fit), _quietest(records))


def _spectra_left(data: KnownInputs, fit: Fit) -> tuple[Floats, Floats]:
    """Of all records: power of what a fit leaves (n_outputs, n_lines), and |G|² (n_inputs, n_outputs, n_lines)."""
    responses, taken = _impulse_responses(data, fit), np.clip(data.leverage(fit), 0.0, PROJECTION.most_taken)
    powers, gains = [], []
    for rows, left in zip(data.rows, data.left(fit), strict=True):
        powers.append(lines_of(left) ** 2 / (1.0 - taken[rows]))
        gains.append(np.abs(np.fft.rfft(responses, 2 * len(left))[..., : len(left)]) ** 2)
    return np.vstack(powers).T, np.concatenate(gains, axis=2)


def _quietest(records: Sequence[Record]) -> Floats:
    """Standard deviation of white noise that each input may hold at most, by its least loud lines, (n_inputs,)."""
    least = np.full(records[0].n_inputs, np.inf)
    for record in records:
        power = lines_of(record.inputs.T - record.inputs.mean(axis=1)) ** 2
        n = max(len(power) // INPUT_NOISE.band, 1)
        bands = [band.mean(axis=0) for band in np.array_split(power, n)]
        least = np.minimum(least, np.min(bands, axis=0))
    return np.sqrt(INPUT_NOISE.least * least)


def _levels(power: Floats, gain: Floats, highest: Floats) -> InputNoise:
    """Of power (n_outputs, n_lines) and |G|² (n_inputs, n_outputs, n_lines), each input's at most `highest`.

    By multiplicative steps on the likelihood, under which variances stay positive (Févotte, Bertin & Durrieu, Neural
    Computation 21 (2009) 793).
    """
    own = 0.5 * power.mean(axis=1)
    of_inputs = 0.5 * power.mean() / np.maximum(gain.mean(axis=(1, 2)), 1e-300) / len(gain)
    floor = PROJECTION.rounding**2 * own + 1e-300
    for _ in range(INPUT_NOISE.steps):
        whole = own[:, None] + np.tensordot(of_inputs, gain, 1)
        inverse = 1.0 / whole
        excess = power * inverse**2
        step = np.tensordot(gain, excess) / np.maximum(np.tensordot(gain, inverse), 1e-300)
        own = np.maximum(own * excess.sum(axis=1) / inverse.sum(axis=1), floor)
        of_inputs = of_inputs * step
        if np.abs(step - 1.0).max() < INPUT_NOISE.settled:
            break
    return InputNoise(np.minimum(np.sqrt(of_inputs), highest), np.sqrt(own))


def with_white_noise(
    data: KnownInputs, fit: Fit, noise: InputNoise, false_alarm: float, budget: Budget
) -> tuple[KnownInputs, Fit]:
    """The records with inputs as likely as they are, the noise that these leave in the outputs made white, and modes.

    Args:
        data, fit: as `input_noise` had them.
    """
    data = data.with_inputs([_likeliest(record, noise) for record in data.records])
    gain = _spectra_left(data, projected(data, fit.poles, fit.participation))[1]
    std = np.sqrt(noise.outputs[:, None] ** 2 + np.tensordot(noise.inputs**2, gain, 1)).T
    weighted = data.weighted_by([std[rows] / np.sqrt((std**2).mean(axis=0)) for rows in data.rows])
    # noise about a strong mode, which lines of equal weight take for another, is known for what it is now
    fit = sure_modes(weighted, projected(weighted, fit.poles, fit.participation), false_alarm, budget)
    return _whitened(weighted, fit, noise), fit


def _likeliest(record: Record, noise: InputNoise) -> Record:
    """The record with the inputs expected by what was read: beyond the excitation, where noise alone is read, none.

    A fraction 1 - σ²/S of each line, S the power read about it (regression calibration; Carroll et al., Measurement
    Error in Nonlinear Models, 2nd ed., chapter 4).
    """
    level = record.inputs.mean(axis=1)
    lines = lines_of(record.inputs.T - level)
    read = uniform_filter1d(lines**2, INPUT_NOISE.band, axis=0, mode="nearest")
    kept = np.maximum(1.0 - noise.inputs**2 / np.maximum(read, 1e-300), 0.0)
    return replace(record, inputs=(samples_of(kept * lines) + level).T)


def _whitened(data: KnownInputs, fit: Fit, noise: InputNoise) -> KnownInputs:
    responses, records = _impulse_responses(data, fit), []
    for record, left in zip(data.records, data.left(fit), strict=True):
        size = next_fast_len(len(left) + responses.shape[2], real=True)
        over = _spectra(responses, size) * noise.inputs / noise.outputs[:, None]
        u, s, _ = np.linalg.svd(over, full_matrices=False)
        lines = np.fft.rfft(left / noise.outputs, size, axis=0)
        along = np.einsum("fji,fj->fi", u.conj(), lines) * (1.0 - 1.0 / np.sqrt(1.0 + s**2))
        excess = np.fft.irfft(np.einsum("fji,fi->jf", u, along), size)[:, : len(left)] * noise.outputs[:, None]
        outputs = record.outputs.copy()
        outputs[:, data.first :] -= excess
        records.append(replace(record, outputs=outputs))
    return data.with_white_noise(records)


def spread_by_inputs(data: KnownInputs, fit: Fit, std: Floats, acts: Sequence[Flags]) -> Floats:
    """Covariance of what white noise of the inputs does to a fit.

    Args:
        std: (n_inputs,) of that noise.
        acts: of each record (n_inputs, n_samples), where an input has it.

    Returns:
        (n, n) of the free unknowns, then of the coefficients of each output, one output after the other.
    """
    phi, tangents = columns(data, fit.poles, fit.participation)
    free, bound, responses = free_parameters(fit), covariance(fit), _impulse_responses(data, fit)
    weights = np.ones((1, fit.noise.size)) if data.weights is None else data.weights
    found: Floats = np.zeros((free.size + fit.coefficients.size,) * 2)
    for rows, where in zip(data.rows, acts, strict=True):
        n = rows.stop - rows.start
        size = next_fast_len(n + responses.shape[2], real=True)
        spectra = _spectra(responses, size).conj()
        for i in np.flatnonzero(std):
            unknowns, along, drifts = np.zeros((n, free.size)), [], []
            for part, outputs in fit.outputs():
                moved, rest = tangent_weights(fit, part)[:, free], tangents[rows] - phi[rows] @ part.tilt
                for k, j in enumerate(range(outputs.start, outputs.stop)):
                    square = weights[rows, j, None] ** 2 if len(weights) > 1 else 1.0
                    heard = data.samples(square * np.hstack([rest, phi[rows]]))
                    heard = np.fft.irfft(spectra[:, j, i, None] * np.fft.rfft(heard, size, axis=0), size, axis=0)[:n]
                    unknowns += heard[:, : rest.shape[1]] @ moved[:, :, k] / fit.noise[j] ** 2
                    along.append(heard[:, rest.shape[1] :] @ part.spread)
                    drifts.append(part.tilt @ moved[:, :, k])
            unknowns = unknowns @ bound
            each = [z - unknowns @ drift.T for z, drift in zip(along, drifts, strict=True)]
            error = std[i] * np.hstack([unknowns, *each])[where[i, data.first :]]
            found += error.T @ error
    return found


def blow_noise(logged: Sequence[Record], windowed: Sequence[Record]) -> Floats:
    """Standard deviation of what force windows removed from each input, (n_inputs,): blows hold as much of it."""
    squares, counts = np.zeros((2, logged[0].n_inputs))
    for before, after in zip(logged, windowed, strict=True):
        changed = (before.inputs != after.inputs).any(axis=1)[:, None]
        removed = changed & (after.inputs == 0.0)
        level = np.median(before.inputs, axis=1, keepdims=True)
        squares += np.where(removed, (before.inputs - level) ** 2, 0.0).sum(axis=1)
        counts += removed.sum(axis=1)
    return np.sqrt(squares / np.maximum(counts, 1.0))


def noise_remarks(records: Sequence[Record], noise: InputNoise) -> tuple[str, ...]:
    """A remark on inputs that read noise."""
    rms = np.sqrt(np.hstack([record.inputs**2 for record in records]).mean(axis=1))
    which = [
        f"input {name} {std:.2g} rms ({100 * std / size:.2g} % of it)"
        for name, std, size in zip(records[0].input_names, noise.inputs, rms, strict=True)
        if std > 0
    ]
    if not which:
        return ()
    return (f"inputs read noise that the structure does not feel: {', '.join(which)}; standard errors allow for it",)


def _impulse_responses(data: KnownInputs, fit: Fit) -> Floats:
    """Of the outputs to an impulse at the first sample of each input, (n_inputs, n_outputs, n_samples)."""
    longest = max(data.records, key=lambda record: record.n_samples)
    n, m = longest.n_samples, data.n_inputs
    records = []
    for i in range(m):
        inputs = np.zeros((m, n))
        inputs[i, 1] = 1.0  # what comes first moves nothing: before it is rest
        records.append(replace(longest, inputs=inputs, outputs=np.zeros((longest.n_outputs, n))))
    impulses = data.from_rest(records)
    phi = columns(impulses, fit.poles, fit.participation[:, :m])[0]
    k = 2 * fit.poles.size + (phi.shape[1] - 2 * fit.poles.size - m if data.feedthrough else 0)
    return np.asarray((phi[:, :k] @ fit.coefficients[:k]).reshape(m, n, -1)[:, 1:].transpose(0, 2, 1))


def _spectra(responses: Floats, size: int) -> Complexes:
    """G at each line, (n_lines, n_outputs, n_inputs)."""
    return np.asarray(np.fft.rfft(responses, size).transpose(2, 1, 0))
