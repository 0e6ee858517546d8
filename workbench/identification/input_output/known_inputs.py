"""Records with known inputs, as a `modal_fit.Measurement`: the response of each pole, and the noise.

Each input u_i excites each pole, z' = λ z + Σ_i l_i u_i. Between samples the inputs follow a zero-order hold, a
first-order hold, or are band-limited below half of the sample rate (`records/band_limited.py`); z is exact at the
samples. With a zero- or first-order hold,

    z_k+1 = e^{λΔt} z_k + c_0 u_k + c_1 u_k+1
    zero-order: c_0 = Δt φ_1, c_1 = 0;    first-order: c_0 = Δt (φ_1 - φ_2), c_1 = Δt φ_2

with φ_1(x) = (e^x - 1)/x, φ_2(x) = (e^x - 1 - x)/x² at x = λΔt. The state at the first sample is one more excitation,
an impulse before it. An input delayed by d whole samples is shifted by d. A further delay by the fraction f of a sample
propagates the response of the sample before by h = (1 - f)Δt,

    z_k(f) = e^{λh} z_k-1 + c_0(h) u_k-1 + c_1(h) (f u_k-1 + (1 - f) u_k),

which is e^{-λfΔt} z_k plus a linear combination of u_k and u_k-1. Modes with u_k and u_k-1 as two further columns are
thus exact for any fraction. A band-limited input is itself interpolated at the fraction. Coloured noise is weighted
line by line of the cosine transform of all columns.
"""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from math import factorial
from threading import local
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.fft import next_fast_len
from scipy.linalg import block_diag
from scipy.signal import lfilter

from workbench.arrays import Complexes, Floats
from workbench.identification.input_output.fit_errors import covariance, scaled_root
from workbench.identification.input_output.lines_of_poles import LinesOfPoles
from workbench.identification.input_output.modal_fit import (
    MANY_ROWS,
    Fit,
    combinations,
    free_parameters,
    modal_coordinate,
    regressors,
    row_weights,
    tangent_weights,
)
from workbench.identification.input_output.noise_spectrum import lines_of, noise_spectrum, samples_of
from workbench.identification.signal.projection import (
    independent,
    local_noise_ratio,
    noise_along,
    noise_near,
    variances,
)
from workbench.identification.signal.searches import SELECTION
from workbench.records.band_limited import later, response_of_pole, spectrum_of
from workbench.records.record import Record
from workbench.threads import at_once

# φ_k(x) = Σ x^i / (i + k)!; its last term is below rounding for |x| < 6. Below Nyquist |Im λΔt| < π.
SERIES_TERMS = 40
SERIES = [np.array([1.0 / factorial(i + k) for i in range(SERIES_TERMS)]) for k in (1, 2)]


@dataclass(eq=False, repr=False)
class KnownInputs:
    """The `modal_fit.Measurement` of records with known inputs; `dataclasses.replace` gives changed ones.

    Rows are the samples, one record after another, or the lines of each record: with `line_std` these over their noise,
    and of long records with held inputs without it, since lines of their responses take less time (`lines_of_poles`).
    """

    records: Sequence[Record]  # with the same inputs and outputs at one rate
    _: KW_ONLY
    at_rest: bool  # as in `identify_driven`, with the next two; `hold` is its `input_hold`
    hold: str
    feedthrough: bool
    delays: np.ndarray = field(default_factory=lambda: np.zeros(1))  # (n_inputs,) samples
    # unknown fractions of a sample beyond `delays`: each input has the columns u_k and u_k-1
    any_fraction: bool = False
    drift: int = 0  # degree of the polynomials of time that each output of each record holds
    line_std: Sequence[np.ndarray] | None = None  # relative noise of lines, (n_rows, n_outputs) a record, of unit rms
    beside: Floats | None = None  # (n_samples, n_columns) of all records, further fixed columns
    changing: tuple[complex, ...] = ()  # poles of the time- or amplitude-dependent modes whose columns `beside` holds
    distorted: tuple[complex, ...] = ()  # poles of nonlinear modes; no further mode is searched near these
    free: tuple[complex, ...] = ()  # poles of the free decay within the records, to start from where some are distorted
    measured: Sequence[Record] | None = None  # the records as measured, where the noise of their inputs was whitened
    clock: float = 0.0  # ε of the clock of the outputs (`output_clock`), by which they were resampled

    def __post_init__(self) -> None:
        records = self.records
        self.dt, self.places, self.n_inputs = records[0].sample_time, records[0].positions, records[0].n_inputs
        self.n_excitations = self.n_inputs + (0 if self.at_rest else len(records))
        self.delays = np.zeros(self.n_inputs) + self.delays
        self.whole = np.floor(self.delays).astype(int)
        self.fraction = self.delays - self.whole
        # Inputs before the record are unknown unless it begins at rest: the samples that need these are left out.
        self.first = 0 if self.at_rest else int(self.whole.max()) + bool(self.any_fraction or self.fraction.any())
        self.driving, self.spectra = [record.inputs for record in records], [np.zeros((0, 0), complex)] * len(records)
        if self.hold == "band-limited":
            if self.fraction.any():
                self.driving = [later(u, self.fraction) for u in self.driving]
                self.fraction = np.zeros_like(self.delays)
            self.spectra = [spectrum_of(u) for u in self.driving]
        self.lengths = [record.n_samples - self.first for record in records]
        ends = np.cumsum([0, *self.lengths])
        self.rows = [slice(a, b) for a, b in zip(ends, ends[1:])]

        # a delayed first-order hold has a corner at the first sample of the input, which no closed form has
        held = not self.fraction.any() and (self.hold == "zero" or (self.hold == "first" and not self.whole.any()))
        coloured = self.line_std is not None and any(np.ptp(size, axis=0).any() for size in self.line_std)
        self.rows_are_lines = coloured or (held and sum(self.lengths) >= MANY_ROWS)
        driving = self.driving if held and self.rows_are_lines else []
        self.of_poles = [LinesOfPoles(self._shifted(u), self.first, self.dt, self.at_rest) for u in driving]
        self.weights = None if self.line_std is None else 1.0 / np.vstack(self.line_std)
        self.values = self._rows(np.vstack(self._measured()))
        if self.weights is not None:
            self.values = self.values * self.weights

        fixed = [block_diag(*(legvander(np.linspace(-1.0, 1.0, length), self.drift) for length in self.lengths))]
        direct = np.vstack([self.direct(k).T[self.first :] for k in range(len(records))])
        # A constant input is collinear with the offset of each output.
        self.has_direct = (self.feedthrough or self.any_fraction) and bool(np.ptp(direct, axis=0).all())
        if self.has_direct:
            fixed = [direct, *fixed]
        if self.beside is not None:
            starts = np.cumsum([0, *(record.n_samples for record in records)])
            fixed.append(np.vstack([self.beside[a + self.first : b] for a, b in zip(starts, starts[1:])]))
        self.fixed = self._rows(np.hstack(fixed))

        longest = max(self.lengths)
        span = longest * self.dt
        self.resolution = 2.0 * np.pi / span
        self.highest = self.nyquist = np.pi / self.dt
        self.size = next_fast_len(2 * longest)
        fastest = max(0.1 * np.pi / self.dt, 2.0 / span)
        self.rates = np.geomspace(0.5 / span, fastest, max(int(np.log(fastest * span)) + 2, 3))
        self.cells = self.rates.size * longest
        self._last = local()
        self._kept: dict[float, list[Floats]] = {}

    def with_columns(self, rows: Floats, changing: tuple[complex, ...]) -> "KnownInputs":
        """The same records with the fixed columns of changing modes, (n_rows, n_columns), rows as in `values`."""
        before = np.zeros((self.first, rows.shape[1]))
        samples = np.vstack([piece for part in self.rows for piece in (before, self.samples(rows[part]))])
        beside = samples if self.beside is None else np.hstack([self.beside, samples])
        return replace(self, beside=beside, changing=(*self.changing, *changing))

    def with_distorted(self, poles: tuple[complex, ...]) -> "KnownInputs":
        """The same records with further poles near which no mode is searched."""
        new = tuple(pole for pole in poles if pole not in self.distorted)
        return replace(self, distorted=(*self.distorted, *new)) if new else self

    def delayed_by(self, delays: np.ndarray, any_fraction: bool = False) -> "KnownInputs":
        """The same records with inputs of these delays, samples; the noise is interpolated at the lines that remain."""
        delayed = replace(self, delays=delays, any_fraction=any_fraction, line_std=None)
        if self.line_std is None:
            return delayed
        each = zip(self.line_std, delayed.lengths, strict=True)
        return replace(delayed, line_std=[_resampled(std, n) for std, n in each])

    def apart(self, fit: Fit) -> "KnownInputs | None":
        """Combinations of outputs with independent residuals of unit variance, lines of equal weight.

        Poles and participation factors stay valid. None where the outputs' residuals are not significantly correlated.
        """
        mixed = independent(self.records, [left.T for left in self.left(fit)])
        return None if mixed is None else replace(self, records=mixed[0], line_std=None)

    def left(self, fit: Fit) -> list[np.ndarray]:
        """The residual of each record at its samples, (n_samples, n_outputs), in the unit of each output."""
        return self.as_samples(fit.residual if self.weights is None else fit.residual / self.weights)

    def as_samples(self, rows: Floats) -> list[Floats]:
        """Rows of all records as the samples of each, (n_samples, k)."""
        return [self.samples(rows[part]) for part in self.rows]

    def noise(self, fit: Fit) -> np.ndarray:
        """Standard deviation of the residual of each output in each record, (n_records, n_outputs)."""
        levels = 1.0 if self.line_std is None else [np.sqrt((size**2).mean(axis=0)) for size in self.line_std]
        return np.asarray(np.sqrt(variances(*self._squares(fit))) * levels)

    def noise_spectrum(self, fit: Fit) -> list[np.ndarray] | None:
        """Relative noise of the lines of each record, as `noise_spectrum` estimates it from the residual."""
        leverage = self.leverage(fit)
        by_record = [leverage[rows] for rows in self.rows]
        return noise_spectrum(self.left(fit), self._measured(), by_record, fit.poles.size, self._free(fit))

    def leverage(self, fit: Fit) -> np.ndarray:
        """Leverage of each line, the share of its noise that the fit absorbs, (n_rows, n_outputs)."""
        x = regressors(self, fit.poles, fit.participation)
        if not self.rows_are_lines:
            x = np.vstack([lines_of(x[rows]) for rows in self.rows])
        combined, free, leverages = combinations(fit.participation, self.fixed.shape[1]), free_parameters(fit), []
        bound = scaled_root(covariance(fit) if free.size else np.zeros((0, 0)))
        weights = row_weights(self)
        for part, outputs in fit.outputs():
            changes = -combined @ part.tilt
            changes[: len(part.gram)] += np.eye(len(part.gram))  # tangents less their projections
            linear = combined @ scaled_root(part.spread)
            for j, nonlinear in enumerate(tangent_weights(fit, part)[:, free].transpose(2, 0, 1), outputs.start):
                each = np.hstack([linear, changes @ nonlinear @ bound / fit.noise[j]])
                leverages.append(weights[:, j] ** 2 * ((x @ each) ** 2).sum(axis=1))
        return np.array(leverages).T

    def cost(self, fit: Fit) -> float:
        """Twice the negative log-likelihood of modes and noise, up to a constant."""
        log_sizes = 0.0 if self.weights is None else -2.0 * float(np.log(self.weights).sum())
        return log_sizes + len(fit.residual) * float(np.log((fit.residual**2).sum(axis=0)).sum())

    def noise_ratios(self, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """κ, noise power over its mean: near each mode, (n_outputs, n_modes), and along each fixed column, (n_fixed,
        n_outputs). Records are weighted by the energy of the mode or column in each."""
        std = np.sqrt(variances(*self._squares(fit)))
        each = zip(fit.poles, fit.participation)
        coordinates = [modal_coordinate(self.responses(pole), l_r) for pole, l_r in each]
        near, along, energy, power = [], [], [], []
        for k, rows in enumerate(self.rows):
            residual = self.samples(fit.residual[rows] / std[k])
            near.append(noise_near(fit.poles, residual, np.ones(residual.shape[1]), self.dt))
            weights = row_weights(self, rows)
            weighted = [self.samples(weight[:, None] * self.fixed[rows]) for weight in weights.T]
            ratios = [noise_along(column, row, fit.poles.size) for column, row in zip(weighted, residual.T[:, :, None])]
            along.append(np.hstack(ratios))
            squares = np.broadcast_to(weights**2, residual.shape).T
            energy.append(np.column_stack([squares @ (x[rows] ** 2 + y[rows] ** 2) for x, y in coordinates]))
            power.append((squares @ self.fixed[rows] ** 2).T)
        return np.average(near, axis=0, weights=energy), np.average(along, axis=0, weights=np.array(power) + 1e-300)

    def _squares(self, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """Sums of squares of the residual, (n_records, n_outputs), and their degrees of freedom."""
        squares = np.array([(fit.residual[rows] ** 2).sum(axis=0) for rows in self.rows])
        return np.maximum(squares, 1e-28 * squares.max() + 1e-300), self._free(fit)

    def _free(self, fit: Fit) -> np.ndarray:
        n_rows = np.array(self.lengths)
        n_parameters = fit.coefficients.shape[0] + free_parameters(fit).size / self.values.shape[1]
        return np.asarray(np.maximum(n_rows * (1.0 - n_parameters / n_rows.sum()), 1.0))

    def _measured(self) -> list[np.ndarray]:
        return [record.outputs.T[self.first :] for record in self.records]

    def direct(self, record: int) -> np.ndarray:
        """The columns of the direct term of a record, (n_columns, n_samples): inputs at their delays."""
        u = self.driving[record]
        before = np.hstack([np.zeros((len(u), 1)), u[:, :-1]])
        if self.any_fraction:
            return np.vstack([self._shifted(u), self._shifted(before)])
        f = self.fraction[:, None]
        late = (1.0 - f) * u + f * before if self.hold == "first" else before
        late[:, 0] = 0.0
        return self._shifted(np.where(f > 0.0, late, u))

    def _shifted(self, of_inputs: np.ndarray) -> np.ndarray:
        """Rows (n_inputs, n_samples) delayed by the whole samples of each input, zero before."""
        if not self.whole.any():
            return of_inputs
        n = of_inputs.shape[1]
        return np.array([np.r_[np.zeros(d), row[: n - d]] for row, d in zip(of_inputs, self.whole, strict=True)])

    def _rows(self, samples: np.ndarray) -> np.ndarray:
        """Columns of samples of all records as rows of the fit."""
        return self.rows_of([samples[rows] for rows in self.rows]) if self.rows_are_lines else samples

    def samples(self, rows: np.ndarray) -> np.ndarray:
        """Rows of the fit of one record as samples."""
        return samples_of(rows) if self.rows_are_lines else rows

    def times_time(self, rows: Floats) -> Floats:
        """Columns (n_rows, k) times the time within each record, -1/2 at its first sample and 1/2 at its last."""
        return self.rows_of([x * np.linspace(-0.5, 0.5, len(x))[:, None] for x in self.as_samples(rows)])

    def modal_coordinate(self, pole: complex, l_r: np.ndarray) -> list[np.ndarray]:
        """Modal coordinate z of a pole at the samples of each record, (n_samples,) complex each."""
        z = np.column_stack(modal_coordinate(self.responses(pole), l_r))
        return [self.samples(z[part]) @ np.array([1.0, 1j]) for part in self.rows]

    def rows_of(self, samples: Sequence[np.ndarray]) -> Floats:
        """Columns (n_samples, k) of each record as rows of the fit, (n_rows, k)."""
        return np.vstack([lines_of(each) if self.rows_are_lines else each for each in samples])

    def _lines_of(self, pole: complex) -> "list[LinesOfPoles] | None":
        """The closed form of each record; None where the pole or the records have none."""
        return None if any(each.on_line(pole) for each in self.of_poles) else self.of_poles or None

    def _acting(self, record: int) -> np.ndarray:
        """Indices of the excitations that act in a record: its inputs, and its initial state."""
        return np.append(np.arange(self.n_inputs), [] if self.at_rest else self.n_inputs + record).astype(int)

    def responses(self, pole: complex) -> tuple[np.ndarray, np.ndarray]:
        if self._lines_of(pole) is not None:
            real, imaginary = self._tangents(pole, np.zeros(self.n_excitations, complex))
            return real[:, 1:], imaginary[:, 1:]
        x = np.zeros((self.values.shape[0], self.n_excitations), complex, order="F")
        for k, (record, rows, (driven, _, decay)) in enumerate(zip(self.records, self.rows, self._of_pole(pole))):
            z = self._late_driven(record.inputs, pole, driven)
            x[rows, : self.n_inputs] = self._shifted(z).T[self.first :]
            if not self.at_rest:
                x[rows, self.n_inputs + k] = decay[self.first :]
        return self._rows(x.real), self._rows(x.imag)

    def tangents(self, pole: complex, participation: np.ndarray, real: np.ndarray, imaginary: np.ndarray) -> None:
        of_poles = self._lines_of(pole)
        if of_poles is None:
            real[:, 0], imaginary[:, 0] = self.slopes(pole, participation)
            real[:, 1:], imaginary[:, 1:] = self.responses(pole)
            return
        if not self.at_rest and len(of_poles) > 1:  # the initial state of a record does not act in the others
            real[:, 1:] = imaginary[:, 1:] = 0.0
        held = sources(pole, self.dt, self.hold)
        for k, (rows, of_record) in enumerate(zip(self.rows, of_poles, strict=True)):
            acting = self._acting(k)
            of_record.tangents(pole, held, 1 + acting, participation[acting], real.T[:, rows], imaginary.T[:, rows])

    def _tangents(self, pole: complex, participation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        real, imaginary = (np.empty((len(self.values), 1 + self.n_excitations), order="F") for _ in range(2))
        self.tangents(pole, participation, real, imaginary)
        return real, imaginary

    def slopes(self, pole: complex, participation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self._lines_of(pole) is not None:
            real, imaginary = self._tangents(pole, participation)
            return real[:, 0], imaginary[:, 0]
        slopes = np.zeros(self.values.shape[0], complex)
        mu, l_r = np.exp(pole * self.dt), participation[: self.n_inputs]
        of_records = zip(self.records, self.rows, self._of_pole(pole))
        for k, (record, rows, (z, forcing_slope, decay)) in enumerate(of_records):
            u = record.inputs
            if self.fraction.any():
                forcing = self.dt * mu * z[:, :-1] + forcing_slope[:, 1:]
                slope = lfilter([1.0], [1.0, -mu], np.hstack([np.zeros((len(u), 1)), forcing]), axis=1)
                all_samples = l_r @ self._shifted(self._late_driven(u, pole, z, slope))
            else:
                forcing = self.dt * mu * (l_r @ self._shifted(z))[:-1] + (l_r @ self._shifted(forcing_slope))[1:]
                all_samples = lfilter([1.0], [1.0, -mu], np.r_[0.0, forcing])
            slopes[rows] = all_samples[self.first :]
            if not self.at_rest:
                time = self.dt * np.arange(self.first, u.shape[1])
                slopes[rows] += participation[self.n_inputs + k] * time * decay[self.first :]
        return self._rows(slopes.real[:, None])[:, 0], self._rows(slopes.imag[:, None])[:, 0]

    def _of_pole(self, pole: complex) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """For each record: z of each input from rest, derivative of its forcing, c_0 u_k + c_1 u_k+1, by λ,
        (n_inputs, n_samples) each, and decay of a unit initial state. Cached for the last pole of each thread."""
        if getattr(self._last, "pole", None) != pole:
            self._last.pole = pole
            self._last.each = [
                (*self._driven(u, spectrum, pole), powers(pole * self.dt, u.shape[1]))
                for u, spectrum in zip(self.driving, self.spectra, strict=True)
            ]
        return list(self._last.each)

    def _driven(self, inputs: Floats, spectrum: Complexes, pole: complex) -> tuple[np.ndarray, np.ndarray]:
        """z of each input from rest, and the derivative of its forcing by λ, (n_inputs, n_samples) each."""
        if self.hold == "band-limited":
            z, slope = response_of_pole(spectrum, pole * self.dt, inputs.shape[1])
            from_sources = np.zeros_like(z)
            from_sources[:, 1:] = slope[:, 1:] - np.exp(pole * self.dt) * (slope[:, :-1] + z[:, :-1])
            return self.dt * z, self.dt**2 * from_sources
        (now, following), (now_slope, following_slope) = sources(pole, self.dt, self.hold)
        u = inputs.astype(complex)
        initial = -following * u[:, :1]
        z = lfilter([following, now], [1.0, -np.exp(pole * self.dt)], u, axis=1, zi=initial)[0]
        forcing_slope = following_slope * u
        forcing_slope[:, 1:] += now_slope * inputs[:, :-1]
        forcing_slope[:, 0] = 0.0  # no input acts before the first sample
        return z, forcing_slope

    def _late_driven(
        self, inputs: np.ndarray, pole: complex, z: np.ndarray, slope: np.ndarray | None = None
    ) -> np.ndarray:
        """z of each input, delayed by its fraction of a sample; its derivative by λ instead where `slope` is given.

        From z and slope, its derivative by λ, without that delay, (n_inputs, n_samples).
        """
        delayed = (z if slope is None else slope).copy()
        for i in np.flatnonzero(self.fraction):
            f = self.fraction[i]
            h = (1.0 - f) * self.dt
            coefficients, coefficient_slopes = sources(pole, h, self.hold)
            c_0, c_1 = coefficients if slope is None else coefficient_slopes
            u, factor = inputs[i], np.exp(pole * h)
            propagated_z = factor * (z[i] if slope is None else h * z[i] + slope[i])
            delayed[i, 0] = 0.0
            delayed[i, 1:] = propagated_z[:-1] + c_0 * u[:-1] + c_1 * (f * u[:-1] + (1.0 - f) * u[1:])
        return delayed

    def candidates(self, residual: np.ndarray) -> np.ndarray:
        """Poles whose response to the inputs correlates most with the residual, (n_candidates,).

        Σ_k y_k x_k(λ) = Σ_τ R_yu(τ) e^{λ τ}: one transform of the cross-correlations, weighted by a decay, compares all
        frequencies at that rate of decay. The initial state is an impulse before the first sample.
        """
        size, omega = self.size, 2.0 * np.pi * np.fft.rfftfreq(self.size, self.dt)
        lags = np.arange(size // 2)
        cross_correlations = []
        for record, rows in zip(self.records, self.rows):
            y = np.fft.rfft(self.samples(row_weights(self, rows) * residual[rows]).T, size)
            cross_correlations += [
                np.fft.irfft(y * np.fft.rfft(u, size).conj(), size)[:, : size // 2] for u in self._exciting(record)
            ]

        autocorrelations = [] if self._kept else self._autocorrelations()

        def of_rate(rate: float) -> tuple[Complexes, Floats]:
            """Poles of this rate of decay, and their scores."""
            decay, score = np.exp(-rate * self.dt * lags), np.zeros(omega.size)
            # The correlation is normalised by the power of the pole's response to the input.
            powers = self._kept[rate] if rate in self._kept else self._powers(rate, decay, autocorrelations)
            for r, power in zip(cross_correlations, powers, strict=True):
                score += (np.abs(np.fft.rfft(r * decay, size)) ** 2 / power).sum(axis=0)
            score[omega <= max(0.5 * self.resolution, rate / SELECTION.max_damping)] = 0.0
            peaks = 1 + np.flatnonzero((score[1:-1] > score[:-2]) & (score[1:-1] >= score[2:]))
            best = peaks[np.argsort(score[peaks])[-SELECTION.peaks_per_rate :]]
            return np.asarray(-rate + 1j * omega[best]), score[best]

        poles, strength = zip(*at_once(of_rate, self.rates, long=len(residual) >= MANY_ROWS), strict=True)
        order = np.argsort(np.concatenate(strength))[::-1]
        return np.asarray(np.concatenate(poles)[order[: 3 * SELECTION.peaks_per_rate]])

    def _exciting(self, record: Record) -> list[Floats]:
        """The excitations of a record that are not zero, (n_samples,) each."""
        delayed = self._shifted(record.inputs)[:, self.first :]
        excitations = [*delayed] if self.at_rest else [*delayed, np.eye(1, delayed.shape[1])[0]]
        return list(filter(np.any, excitations))

    def _powers(self, rate: float, decay: Floats, autocorrelations: list[Floats]) -> list[Floats]:
        """Power of the response of a pole of a rate of decay at each line, to each excitation, weighted as each output,
        (n_outputs, n_lines), or (1, n_lines) where all have equal weight; then kept for the next search."""
        powers = []
        for autocorrelation in autocorrelations:
            power = 2.0 * np.fft.rfft(autocorrelation * decay, self.size).real - autocorrelation[:, :1]
            floor = 1e-12 * autocorrelation[:, :1]
            powers.append(np.maximum(power / (1.0 - np.exp(-2.0 * rate * self.dt)), floor))
        if all(len(power) == 1 for power in powers):
            self._kept[rate] = powers
        return powers

    def _autocorrelations(self) -> list[Floats]:
        """Autocorrelation of each excitation of each record, weighted as each output, (n_outputs or 1, n_lags)."""
        size, omega, found = self.size, 2.0 * np.pi * np.fft.rfftfreq(self.size, self.dt), []
        for record, rows in zip(self.records, self.rows):
            weights = np.ones((1, 1)) if self.weights is None else self.weights[rows]
            lines = np.pi / self.dt * np.arange(len(weights)) / len(weights)
            line_weights = np.array([np.interp(omega, lines, weight**2) for weight in weights.T])
            for u in self._exciting(record):
                power = line_weights * np.abs(np.fft.rfft(u, size)) ** 2
                found.append(np.fft.irfft(power, size)[:, : size // 2])
        return found

    def noise_ratio(self, residual: np.ndarray, pole: complex) -> float:
        longest = self.rows[int(np.argmax(self.lengths))]
        power = (np.abs(np.fft.rfft(self.samples(residual[longest]), axis=0)[1:]) ** 2).mean(axis=1)
        nearest = round(pole.imag / self.resolution) - 1
        return local_noise_ratio(power, nearest, SELECTION.noise_bins)


def powers(exponent: complex, n: int) -> np.ndarray:
    """e^(k exponent) for k = 0 ... n - 1, as products of two tables of √n exponentials."""
    n_fine = int(np.ceil(np.sqrt(n)))
    fine, coarse = np.exp(exponent * np.arange(n_fine)), np.exp(exponent * n_fine * np.arange(-(-n // n_fine)))
    return np.asarray(np.multiply.outer(coarse, fine).ravel()[:n])


def _resampled(line_std: np.ndarray, n_rows: int) -> np.ndarray:
    """Relative noise of lines interpolated at those of a record of another length, (n_rows, n_outputs)."""
    if len(line_std) == n_rows:
        return line_std
    new_lines, lines = np.linspace(0.0, 1.0, n_rows), np.linspace(0.0, 1.0, len(line_std))
    return np.column_stack([np.interp(new_lines, lines, column) for column in line_std.T])


def sources(pole: complex, dt: float, hold: str) -> tuple[tuple[complex, complex], tuple[complex, complex]]:
    """(c_0, c_1) of a zero- or first-order hold, and their derivatives by λ."""
    x = pole * dt
    powers = x ** np.arange(SERIES_TERMS)
    sums: list[Any] = [(s @ powers, s[1:] * np.arange(1, SERIES_TERMS) @ powers[:-1]) for s in SERIES]
    (phi1, phi1_slope), (phi2, phi2_slope) = sums
    if hold == "zero":
        return (dt * phi1, 0.0), (dt**2 * phi1_slope, 0.0)
    return (dt * (phi1 - phi2), dt * phi2), (dt**2 * (phi1_slope - phi2_slope), dt**2 * phi2_slope)
