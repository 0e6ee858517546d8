"""The cosine transform of the response of a pole to held inputs, in closed form.

A sequence x_k = m x_k-1 + c_0 u_k-1 + c_1 u_k of n samples has the transform X(e) = Σ_k x_k e^k, e = exp(-iω),

    X (1 - m e) = (c_0 e + c_1) U + (x_0 - c_1 u_0) - e^n (m x_n-1 + c_0 u_n-1),

whatever acts before its first sample. At the lines ω = π j / n of the cosine transform e^n = (-1)^j, and the transform
of a real sequence is the real part of e^½ X. So each line of a response takes one division, where a recursion over all
samples and a transform take ten times as long. The real and imaginary parts of a response are sequences of their own,
half the sum and the difference of those of m and of its conjugate.
"""

import numpy as np
from numba import njit

from workbench.arrays import Complexes, Floats

Sources = tuple[tuple[complex, complex], tuple[complex, complex]]
# of the distance of lines: a pole closer than this to a line makes both sides above lose their digits
MIN_DISTANCE = 1e-4
FORGOTTEN_NEPERS = 40.0  # by which a free motion has decayed below rounding


class LinesOfPoles:
    """The lines of the response of any pole to the inputs of one record, and to its initial state.

    Args:
        inputs: (n_inputs, n_samples) of the record from its first sample, zero before.
        first: the sample at which the transformed part begins.
        at_rest: whether there is no initial state.
    """

    def __init__(self, inputs: Floats, first: int, dt: float, at_rest: bool) -> None:
        self.inputs, self.first, self.dt, self.at_rest = np.ascontiguousarray(inputs), first, dt, at_rest
        self.size = inputs.shape[1] - first
        angles = np.pi / self.size * np.arange(self.size)
        half = np.sqrt(2.0 / self.size) * np.exp(-0.5j * angles)
        half[0] = np.sqrt(1.0 / self.size)
        spectra = half * np.fft.rfft(inputs[:, first:], 2 * self.size)[:, : self.size]
        if not at_rest:
            spectra = np.vstack([spectra, np.zeros(self.size)])
        self.turn, self.half = _parts(np.exp(-1j * angles)), _parts(half)
        self.spectra = np.array([_parts(each) for each in spectra])

    def on_line(self, pole: complex) -> bool:
        """Whether a pole is so near to one of the lines that its response has no accurate closed form."""
        spacing = np.pi / self.size
        line = np.round(pole.imag * self.dt / spacing) * spacing
        return bool(abs(1.0 - np.exp(pole * self.dt - 1j * line)) < MIN_DISTANCE * spacing)

    def tangents(
        self, pole: complex, held: Sources, rows: np.ndarray, participation: Complexes, real: Floats, imaginary: Floats
    ) -> None:
        """Write the response to each input, and to the initial state, into these rows of (n_rows, n_lines).

        Row 0 becomes the derivative by the pole of their sum with participation factors. Responses alone take as long.
        `held` are (c_0, c_1), and their derivatives by the pole.
        """
        m, n = np.exp(pole * self.dt), self.inputs.shape[1]
        factors = np.array([m, *held[0], self.dt * m, *held[1]], complex)
        # what acts before is forgotten to rounding by the last sample
        reach = int(min(FORGOTTEN_NEPERS / max(-pole.real * self.dt, FORGOTTEN_NEPERS / n), n))
        ends = _ends(self.inputs, self.first, n - reach, factors)
        if not self.at_rest:
            before, after = m**self.first, -(m**n)
            ends = np.vstack([ends, [before, after, self.first * self.dt * before, n * self.dt * after]])
        real[0] = imaginary[0] = 0.0
        _lines(self.turn, self.half, self.spectra, factors, ends, participation, rows, real, imaginary)


def _parts(values: Complexes) -> Floats:
    """Real and imaginary parts, (2, n)."""
    return np.array([values.real, values.imag])


@njit(cache=True, nogil=True)
def _ends(inputs, first, begin, factors):  # type: ignore[no-untyped-def]
    """x_0 - c_1 u_0 and -(m x_n-1 + c_0 u_n-1) of each input, and their derivatives, (n_inputs, 4).

    The motion at the last sample is that from `begin` on.
    """
    m, c_0, c_1, m_slope, c_0_slope, c_1_slope = factors
    ends = np.zeros((inputs.shape[0], 4), np.complex128)
    for i in range(inputs.shape[0]):
        u = inputs[i]
        for start, end in ((0, first), (begin, u.size - 1)):
            x = slope = 0j
            for k in range(start + 1, end + 1):
                slope = m_slope * x + m * slope + c_0_slope * u[k - 1] + c_1_slope * u[k]
                x = m * x + c_0 * u[k - 1] + c_1 * u[k]
            if end == first:
                ends[i, 0], ends[i, 2] = x - c_1 * u[first], slope - c_1_slope * u[first]
        ends[i, 1] = -m * x - c_0 * u[-1]
        ends[i, 3] = -m_slope * x - m * slope - c_0_slope * u[-1]
    return ends


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _lines(turn, half, spectra, factors, ends, participation, rows, real, imaginary):  # type: ignore[no-untyped-def]
    """Write the lines of the responses to rows of `real` and `imaginary`; add those of their derivative to row 0.

    x belongs to m, y to its conjugate. Real arithmetic without a check for zero is done on several lines at a time.
    """
    m, c_0, c_1, m_slope, c_0_slope, c_1_slope = factors
    for i in range(ends.shape[0]):
        before, after, before_slope, after_slope = ends[i]
        a = participation[i]
        into_real, into_imaginary, slope_real, slope_imaginary = (
            real[rows[i]],
            imaginary[rows[i]],
            real[0],
            imaginary[0],
        )
        for k in range(turn.shape[1]):
            er, ei, ur, ui = turn[0, k], turn[1, k], spectra[i, 0, k], spectra[i, 1, k]
            hr, hi, sign = half[0, k], half[1, k], 1.0 - 2.0 * (k & 1)
            gr, gi = sign * hr, sign * hi
            vr, vi = er * ur - ei * ui, er * ui + ei * ur  # the input a sample later
            # 1 / (1 - m e) for both
            xr, xi = 1.0 - m.real * er + m.imag * ei, -m.real * ei - m.imag * er
            yr, yi = 1.0 - m.real * er - m.imag * ei, -m.real * ei + m.imag * er
            x_size, y_size = 1.0 / (xr * xr + xi * xi), 1.0 / (yr * yr + yi * yi)
            xr, xi, yr, yi = xr * x_size, -xi * x_size, yr * y_size, -yi * y_size
            # numerators: sums of real series with complex coefficients, p + i q for m and p - i q for its conjugate
            pr = c_0.real * vr + c_1.real * ur + before.real * hr + after.real * gr
            pi = c_0.real * vi + c_1.real * ui + before.real * hi + after.real * gi
            qr = c_0.imag * vr + c_1.imag * ur + before.imag * hr + after.imag * gr
            qi = c_0.imag * vi + c_1.imag * ui + before.imag * hi + after.imag * gi
            sr, si, tr, ti = pr - qi, pi + qr, pr + qi, pi - qr
            x_r, x_i = sr * xr - si * xi, sr * xi + si * xr
            y_r, y_i = tr * yr - ti * yi, tr * yi + ti * yr
            into_real[k] = 0.5 * (x_r + y_r)
            into_imaginary[k] = 0.5 * (x_i - y_i)
            pr = c_0_slope.real * vr + c_1_slope.real * ur + before_slope.real * hr + after_slope.real * gr
            pi = c_0_slope.real * vi + c_1_slope.real * ui + before_slope.real * hi + after_slope.real * gi
            qr = c_0_slope.imag * vr + c_1_slope.imag * ur + before_slope.imag * hr + after_slope.imag * gr
            qi = c_0_slope.imag * vi + c_1_slope.imag * ui + before_slope.imag * hi + after_slope.imag * gi
            lr, li = m_slope.real * er - m_slope.imag * ei, m_slope.real * ei + m_slope.imag * er
            kr, ki = m_slope.real * er + m_slope.imag * ei, m_slope.real * ei - m_slope.imag * er
            sr, si = pr - qi + lr * x_r - li * x_i, pi + qr + lr * x_i + li * x_r
            tr, ti = pr + qi + kr * y_r - ki * y_i, pi - qr + kr * y_i + ki * y_r
            x_r, x_i = sr * xr - si * xi, sr * xi + si * xr
            y_r, y_i = tr * yr - ti * yi, tr * yi + ti * yr
            x_r, x_i = a.real * x_r - a.imag * x_i, a.real * x_i + a.imag * x_r
            y_r, y_i = a.real * y_r + a.imag * y_i, a.real * y_i - a.imag * y_r
            slope_real[k] += 0.5 * (x_r + y_r)
            slope_imaginary[k] += 0.5 * (x_i - y_i)
