"""Modes from what went in and what came out, whatever the excitation.

Each input u_i drives each pole, z' = λ z + Σ_i l_i u_i, and each output sees y = Re Σ_r a_r z_r + D u. Between samples
the input is held, or runs straight from one to the next, so that z is known exactly at the samples:

    z_k+1 = e^{λΔt} z_k + c_0 u_k + c_1 u_k+1
    held: c_0 = Δt φ_1, c_1 = 0;    straight: c_0 = Δt (φ_1 - φ_2), c_1 = Δt φ_2

with φ_1(x) = (e^x - 1)/x, φ_2(x) = (e^x - 1 - x)/x² at x = λΔt. The state at the first sample is one more drive, a blow
before it. All of it is then fitted at once as `modal_fit` says: output error, most likely where the noise is the
sensors' and white.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import factorial

import control
import numpy as np
from scipy.fft import next_fast_len
from scipy.signal import lfilter

from workbench.identification.coloured import heard_along, noise_near
from workbench.identification.fit_errors import errors, fixed_std, pole_covariance
from workbench.identification.ibrahim import check_alike, normalised_shapes
from workbench.identification.identified import FALSE_ALARM, MOST_DAMPED
from workbench.identification.modal_count import Told, tell
from workbench.identification.modal_fit import Fit, free_parameters
from workbench.identification.noise_levels import differ, variances
from workbench.identification.standard_errors import StandardErrors
from workbench.identification.synthesis import time_derivatives
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes, frozen

# φ_k(x) = Σ x^i / (i + k)!, which ends below rounding for |x| < 6: a pole turns less than π a sample.
TERMS = 40
SERIES = [np.array([1.0 / factorial(i + k) for i in range(TERMS)]) for k in (1, 2)]
BESIDE = 50
PEAKS_A_RATE = 12
# Where one record is noisier than another, what hid in its noise shows once it counts less.
REWEIGHTED = 2


@dataclass(frozen=True, eq=False)
class Driven(StandardErrors):
    """Modes with what drives them: H(s) = D + Σ_r [c_r l_r^T / (s - λ_r) + conjugate].

    Attributes:
        modes: shapes of displacement, largest entry 1.
        covariance: (2 n_modes, 2 n_modes) of (ω, ζ); in white noise the Cramér-Rao bound at the estimate.
        shape_std: (n_outputs, n_modes) standard error of the real part of each shape.
        participation: (n_modes, n_inputs) complex l_r, for c_r the shape as the outputs measure it, ψ_r λ_r^k with
            k = 0, 1, 2 for displacement, velocity, acceleration.
        participation_std: (n_modes, n_inputs) its standard error, root mean square of real and imaginary part.
        feedthrough: (n_outputs, n_inputs) D: what an acceleration feels at once, and the modes above those found.
        feedthrough_std: (n_outputs, n_inputs).
        initial: one (n_modes,) complex a record: z_r at its first sample, where y = Re Σ 2 c_r z_r; zero if at rest.
        noise: (n_records, n_outputs) standard deviation of what the modes leave, in the unit of each output.
        evidence: (n_modes,) χ² of each mode in the noise.
        limit: what a mode fitted to noise alone exceeds with the chance of a false alarm.
        converged: whether the search ended because the step was small.
        output_channels, input_channels: of the records.
    """

    modes: SampledModes
    covariance: np.ndarray
    shape_std: np.ndarray = field(repr=False)
    participation: np.ndarray = field(repr=False)
    participation_std: np.ndarray = field(repr=False)
    feedthrough: np.ndarray = field(repr=False)
    feedthrough_std: np.ndarray = field(repr=False)
    initial: tuple[np.ndarray, ...] = field(repr=False)
    noise: np.ndarray
    evidence: np.ndarray
    limit: float
    converged: bool
    output_channels: tuple[Channel, ...] = field(repr=False)
    input_channels: tuple[Channel, ...] = field(repr=False)

    @property
    def noise_std(self) -> np.ndarray:
        """Of each output (n_outputs,), root mean square over the records."""
        return np.sqrt((self.noise**2).mean(axis=0))

    @property
    def residues(self) -> np.ndarray:
        """c_r l_r^T, (n_modes, n_outputs, n_inputs) complex."""
        return np.einsum("jr,ri->rji", self._measured_shapes, self.participation)

    @property
    def _measured_shapes(self) -> np.ndarray:
        return self.modes.shapes * self.modes.poles ** time_derivatives(self.output_channels)[:, None]

    @property
    def state_space(self) -> control.StateSpace:
        """The model from inputs to outputs in real modal form, two states a mode, with the names of the record.

        z = re + i im of each mode: A has blocks [[Re λ, -Im λ], [Im λ, Re λ]], and y = Re Σ 2 c z + D u.
        """
        n, poles = self.modes.n_modes, self.modes.poles
        a = np.zeros((2 * n, 2 * n))
        even, odd = 2 * np.arange(n), 2 * np.arange(n) + 1
        a[even, even] = a[odd, odd] = poles.real
        a[even, odd], a[odd, even] = -poles.imag, poles.imag
        b = np.stack([self.participation.real, self.participation.imag], axis=1).reshape(2 * n, -1)
        c = 2.0 * self._measured_shapes
        c = np.stack([c.real, -c.imag], axis=2).reshape(c.shape[0], 2 * n)
        return control.ss(
            a,
            b,
            c,
            self.feedthrough,
            inputs=[channel.name for channel in self.input_channels],
            outputs=[channel.name for channel in self.output_channels],
            states=[f"{part}{r + 1}" for r in range(n) for part in ("re", "im")],
            name="identified",
        )

    def initial_state(self, record: int = 0) -> np.ndarray:
        """States of `state_space` at the first sample of a record, (2 n_modes,)."""
        z = self.initial[record]
        return np.stack([z.real, z.imag], axis=1).ravel()


def identify_driven(
    records: Record | Sequence[Record],
    *,
    at_rest: bool = False,
    straight: bool = False,
    feedthrough: bool = True,
    most_modes: int = 40,
    false_alarm: float = FALSE_ALARM,
) -> Driven:
    """The modes that inputs and outputs show, as many as there are, with shapes, participation and standard errors.

    Any excitation serves that moves the modes: noise, multisine, PRBS, a blow. Each mode enters if it raises the
    likelihood by more than noise would in one record of a thousand.

    Args:
        records: with the same inputs and outputs at one rate; each output may hold a constant, another in each record.
        at_rest: that nothing moves at the first sample; otherwise each record has an initial state of its own.
        straight: whether inputs run straight from sample to sample, as measured signals through a filter nearly do;
            otherwise they are held over each sample interval, as a converter gives them.
        feedthrough: whether outputs may also feel inputs at once: accelerations do, and the modes beyond the sample
            rate look so to every sensor.
        most_modes: where to stop at the latest.
        false_alarm: chance that noise alone is taken for a mode.

    Returns:
        `Driven`. Its standard errors hold in noise of any smooth spectrum.

    Raises:
        ValueError: no inputs, inputs that never move or move alike; records that differ; too few samples; no mode.
    """
    records = [records] if isinstance(records, Record) else list(records)
    check_alike(records)
    _check_inputs(records)
    drive = _Inputs(records, at_rest, straight, feedthrough)
    rows, columns = drive.fixed.shape
    if rows < columns + 4 * (drive.n_drives + 2):
        raise ValueError(
            f"record {records[0].name!r}: {rows} samples are too few for {records[0].n_inputs} inputs; measure longer"
        )
    how = {"most_modes": min(most_modes, (rows - columns) // 6), "false_alarm": false_alarm}
    told = tell(drive, **how)
    for _ in range(REWEIGHTED):
        if not drive.reweighted(told.fit):
            break
        told = tell(drive, **how)
    if told.fit.poles.size == 0:
        raise ValueError(
            f"record {records[0].name!r}: no mode between inputs {', '.join(records[0].input_names)} and outputs"
            f" {', '.join(records[0].output_names)} rises above the noise; excite harder or longer, or look whether"
            " inputs and outputs belong together"
        )
    return _report(records, drive, told)


def _check_inputs(records: Sequence[Record]) -> None:
    first = records[0]
    if first.n_inputs == 0:
        raise ValueError(f"record {first.name!r} has no inputs; of a free decay `identify` finds the modes")
    for record in records[1:]:
        if record.input_names != first.input_names:
            raise ValueError(
                f"records identified together must have the same inputs; {first.name!r} has"
                f" {', '.join(first.input_names)} and {record.name!r} has {', '.join(record.input_names)}"
            )
    inputs = np.hstack([record.inputs for record in records])
    size = np.linalg.norm(inputs, axis=1)
    if (size == 0).any():
        name = first.input_names[int(np.argmin(size))]
        raise ValueError(f"record {first.name!r}: input {name!r} is zero throughout; leave it out, or excite there")
    alike = (inputs / size[:, None]) @ (inputs / size[:, None]).T - np.eye(len(size))
    i, k = np.unravel_index(int(np.argmax(np.abs(alike))), alike.shape)
    if abs(alike[i, k]) > 1.0 - 1e-9:
        raise ValueError(
            f"inputs {first.input_names[i]!r} and {first.input_names[k]!r} are the same signal but for its size, so"
            " what each does cannot be told; excite them one after the other, or by signals of their own"
        )


class _Inputs:
    """Records driven by their inputs, as a `modal_fit.Drive`: rows are the samples, one record after another."""

    weights: np.ndarray | None = None

    def __init__(self, records: Sequence[Record], at_rest: bool, straight: bool, feedthrough: bool) -> None:
        self.records, self.at_rest, self.straight = records, at_rest, straight
        self.dt = records[0].sample_time
        lengths = [record.n_samples for record in records]
        ends = np.cumsum([0, *lengths])
        self.rows = [slice(a, b) for a, b in zip(ends, ends[1:])]
        self.values = np.vstack([record.outputs.T for record in records])
        constant = np.zeros((ends[-1], len(records)))
        for k, rows in enumerate(self.rows):
            constant[rows, k] = 1.0
        direct = np.vstack([record.inputs.T for record in records])
        self.n_inputs = direct.shape[1]
        self.n_drives = self.n_inputs + (0 if at_rest else len(records))
        self.feedthrough = feedthrough and not _flat(direct)
        self.fixed = np.hstack([direct, constant]) if self.feedthrough else constant
        self.resolution = 2.0 * np.pi / (max(lengths) * self.dt)
        self.highest = np.pi / self.dt
        self.size = next_fast_len(2 * max(lengths))
        span = max(lengths) * self.dt
        fastest = max(0.1 * np.pi / self.dt, 2.0 / span)
        self.rates = np.geomspace(0.5 / span, fastest, max(int(np.log(fastest * span)) + 2, 3))
        self.cells = self.rates.size * max(lengths)

    def noise(self, fit: Fit) -> np.ndarray:
        """Standard deviation of what is left of each output in each record, (n_records, n_outputs)."""
        weights = 1.0 if self.weights is None else np.array([self.weights[rows.start] for rows in self.rows])
        return np.sqrt(variances(*self._left(fit))) / weights

    def reweighted(self, fit: Fit) -> bool:
        """Count each record by its noise; whether that changed anything."""
        squares, free = self._left(fit)
        if not differ(squares, free).any():
            return False
        raw = self.values if self.weights is None else self.values / self.weights
        weights = np.repeat(1.0 / self.noise(fit), [rows.stop - rows.start for rows in self.rows], axis=0)
        self.weights = weights / np.sqrt((weights**2).mean(axis=0))
        self.values = self.weights * raw
        return True

    def heard(self, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """Noise over its mean that each mode, (n_outputs, n_modes), and each fixed column, (n_fixed, n_outputs), hears:
        of each record as much as the mode swings in it."""
        std = np.sqrt(variances(*self._left(fit)))
        swings = np.column_stack([self._swing(pole, load) for pole, load in zip(fit.poles, fit.loads)])
        near, beside, energy, power = [], [], [], []
        for k, rows in enumerate(self.rows):
            weights = np.ones(std.shape[1]) if self.weights is None else self.weights[rows.start]
            left = fit.residual[rows] / std[k]
            near.append(noise_near(fit.poles, left, self.dt))
            beside.append(heard_along(self.fixed[rows], left, fit.poles.size))
            energy.append(np.outer(weights**2, (np.abs(swings[rows]) ** 2).sum(axis=0)))
            power.append(np.outer((self.fixed[rows] ** 2).sum(axis=0), weights**2))
        return np.average(near, axis=0, weights=energy), np.average(beside, axis=0, weights=np.array(power) + 1e-300)

    def _swing(self, pole: complex, load: np.ndarray) -> np.ndarray:
        real, imaginary = self.answers(pole)
        return (real + 1j * imaginary) @ load

    def _left(self, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """Squares of what is left, records counted as they are, and their degrees of freedom."""
        length = np.array([rows.stop - rows.start for rows in self.rows])
        squares = np.array([(fit.residual[rows] ** 2).sum(axis=0) for rows in self.rows])
        lost = fit.coefficients.shape[0] + free_parameters(fit).size / self.values.shape[1]
        floor = 1e-28 * squares.max() + 1e-300
        return np.maximum(squares, floor), np.maximum(length * (1.0 - lost / length.sum()), 1.0)

    def answers(self, pole: complex) -> tuple[np.ndarray, np.ndarray]:
        x = np.zeros((self.values.shape[0], self.n_drives), complex)
        for k, (record, rows) in enumerate(zip(self.records, self.rows)):
            x[rows, : self.n_inputs] = self._driven(record, pole)[0].T
            if not self.at_rest:
                x[rows, self.n_inputs + k] = np.exp(pole * self.dt * np.arange(record.n_samples))
        return x.real, x.imag

    def slopes(self, pole: complex, loads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = np.zeros(self.values.shape[0], complex)
        mu = np.exp(pole * self.dt)
        for k, (record, rows) in enumerate(zip(self.records, self.rows)):
            x, by_coefficients = self._driven(record, pole)
            load = loads[: self.n_inputs]
            later = self.dt * mu * (load @ x)[:-1] + (load @ by_coefficients)[1:]
            found[rows] = lfilter([1.0], [1.0, -mu], np.r_[0.0, later])
            if not self.at_rest:
                time = self.dt * np.arange(record.n_samples)
                found[rows] += loads[self.n_inputs + k] * time * np.exp(pole * time)
        return found.real, found.imag

    def _driven(self, record: Record, pole: complex) -> tuple[np.ndarray, np.ndarray]:
        """z of each input from rest, and what its sources change with λ, (n_inputs, n_samples) each."""
        (now, after), (now_slope, after_slope) = _sources(pole, self.dt, self.straight)
        u = record.inputs.astype(complex)
        rest = -after * u[:, :1]
        x = lfilter([after, now], [1.0, -np.exp(pole * self.dt)], u, axis=1, zi=rest)[0]
        before = np.hstack([np.zeros((u.shape[0], 1)), u[:, :-1]])
        return x, now_slope * before + after_slope * u

    def candidates(self, residual: np.ndarray) -> np.ndarray:
        """Poles whose answer to the inputs agrees best with the residual.

        Σ_k y_k x_k(λ) = Σ_τ R_yu(τ) e^{λ τ}, so that one transform of the correlations, weighted by a decay, compares
        all frequencies at that rate of decay; the initial state is a blow before the first sample.
        """
        size, omega = self.size, 2.0 * np.pi * np.fft.rfftfreq(self.size, self.dt)
        lags = np.arange(size // 2)
        crossed, own = [], []
        for record, rows in zip(self.records, self.rows):
            y = np.fft.rfft(residual[rows].T, size)
            drives = [*record.inputs] if self.at_rest else [*record.inputs, np.eye(1, record.n_samples)[0]]
            for u in filter(np.any, drives):
                spectrum = np.fft.rfft(u, size)
                crossed.append(np.fft.irfft(y * spectrum.conj(), size)[:, : size // 2])
                own.append(np.fft.irfft(np.abs(spectrum) ** 2, size)[: size // 2])
        found, strength = [], []
        for rate in self.rates:
            decay = np.exp(-rate * self.dt * lags)
            lowest = omega > max(0.5 * self.resolution, rate / MOST_DAMPED)
            score = np.zeros(omega.size)
            # The answer's own power: the spectrum of the input seen through the pole.
            for r, power in zip(crossed, own):
                agreed = (np.abs(np.fft.rfft(r * decay, size)) ** 2).sum(axis=0)
                whole = 2.0 * np.fft.rfft(power * decay, size).real - power[0]
                score += agreed / np.maximum(whole / (1.0 - np.exp(-2.0 * rate * self.dt)), 1e-12 * power[0])
            score[~lowest] = 0.0
            peaks = 1 + np.flatnonzero((score[1:-1] > score[:-2]) & (score[1:-1] >= score[2:]))
            best = peaks[np.argsort(score[peaks])[-PEAKS_A_RATE:]]
            found.append(-rate + 1j * omega[best])
            strength.append(score[best])
        order = np.argsort(np.concatenate(strength))[::-1]
        return np.concatenate(found)[order[: 3 * PEAKS_A_RATE]]

    def colour(self, residual: np.ndarray, pole: complex) -> float:
        longest = max(self.rows, key=lambda rows: rows.stop - rows.start)
        power = (np.abs(np.fft.rfft(residual[longest], axis=0)[1:]) ** 2).mean(axis=1)
        at = round(pole.imag / self.resolution) - 1
        beside = power[max(at - BESIDE, 0) : at + BESIDE + 1]
        return max(1.0, float(np.median(beside) / power.mean())) if beside.size else 1.0


def _flat(inputs: np.ndarray) -> bool:
    """Whether an input is a constant, which the offset of each output holds already."""
    return bool((np.ptp(inputs, axis=0) == 0).any())


def _sources(pole: complex, dt: float, straight: bool):
    """c_0, c_1 and their derivatives by λ."""
    x = pole * dt
    powers = x ** np.arange(TERMS)
    (phi1, phi1_slope), (phi2, phi2_slope) = ((s @ powers, s[1:] * np.arange(1, TERMS) @ powers[:-1]) for s in SERIES)
    if not straight:
        return (dt * phi1, 0.0), (dt**2 * phi1_slope, 0.0)
    return (dt * (phi1 - phi2), dt * phi2), (dt**2 * (phi1_slope - phi2_slope), dt**2 * phi2_slope)


def _report(records: Sequence[Record], drive: _Inputs, told: Told) -> Driven:
    fit: Fit = told.fit
    channels, n_inputs = records[0].output_channels, records[0].n_inputs
    derivative = time_derivatives(channels)[:, None]
    n = fit.poles.size
    seen = fit.amplitudes / fit.poles**derivative
    shapes = normalised_shapes(seen)
    largest = np.abs(seen).argmax(axis=0)
    each = np.arange(n)
    # y = Re Σ a z and H = Σ a l / 2 (s - λ) + conjugate: what the shape loses by its normalisation the loads take up.
    scale = 0.5 * seen[largest, each] / shapes[largest, each]
    loads = fit.loads * scale[:, None]

    def figures(poles, loads, amplitudes):
        seen = amplitudes / poles**derivative
        relative = seen / seen[largest, each]
        driven = (loads * (0.5 * seen[largest, each] / shapes[largest, each])[:, None])[:, :n_inputs]
        return np.concatenate([relative.real.ravel(), driven.real.ravel(), driven.imag.ravel()])

    heard, beside = drive.heard(fit)
    std = np.sqrt(np.diag(errors(fit, figures, heard)))
    m = len(channels)
    shape_std = std[: m * n].reshape(m, n)
    shape_std[largest, each] = 0.0
    real, imaginary = std[m * n :].reshape(2, n, n_inputs)
    direct = np.zeros((m, n_inputs))
    direct_std = np.zeros((m, n_inputs))
    if drive.feedthrough:
        direct = fit.coefficients[2 * n : 2 * n + n_inputs].T
        direct_std = fixed_std(fit, heard, beside)[:n_inputs].T
    return Driven(
        modes=SampledModes(np.abs(fit.poles), -fit.poles.real / np.abs(fit.poles), shapes, records[0].positions),
        covariance=frozen(pole_covariance(fit, heard)),
        shape_std=frozen(shape_std),
        participation=frozen(loads[:, :n_inputs], complex),
        participation_std=frozen(np.sqrt(0.5 * (real**2 + imaginary**2))),
        feedthrough=frozen(direct),
        feedthrough_std=frozen(direct_std),
        initial=tuple(
            frozen(np.zeros(n) if drive.at_rest else loads[:, n_inputs + k], complex) for k in range(len(records))
        ),
        noise=frozen(drive.noise(fit)),
        evidence=frozen(told.evidence),
        limit=told.limit,
        converged=fit.converged,
        output_channels=channels,
        input_channels=records[0].input_channels,
    )
