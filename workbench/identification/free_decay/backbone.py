"""One mode whose frequency and damping depend on amplitude: the alternative model of a beat in one sensor.

Its envelope r and phase θ follow a backbone, smooth and one for each amplitude (Nayfeh & Mook 1979, 2.3),

    r' = -σ(r) r,   θ' = ω(r),   -σ + iω = Σ_k λ_k r^p_k,      y = Re A exp(Σ_k λ_k ∫ r^p_k dt),   r(0) = 1

with powers p of 0, 1, 2 (stiffness and damping that rise or fall), 0, ½, 1 (joints that slip) or -1, 0, 1 (friction):
eight parameters with A, as many as two linear modes have, so that the likelier model is preferred.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import least_squares

from workbench.arrays import Floats
from workbench.identification.signal.projection import project
from workbench.records.record import Record


@dataclass(frozen=True)
class BackboneSettings:
    """Constants of the fit of a backbone."""

    steps: int = 150  # of the envelope in time
    faded: float = 7.0  # nepers from which on the backbone stays as it is
    died: float = 60.0  # nepers to which the envelope is followed
    most_tries: int = 40  # evaluations of the fit
    slightly: float = 1e-5  # of the decay rate: step of differences
    largest: float = 1e100  # beyond this a motion diverges
    beyond: float = 10.0  # times the record: what its residual is then taken for


BACKBONE = BackboneSettings()
POWERS = ((0.0, 1.0, 2.0), (0.0, 0.5, 1.0), (0.0, -1.0, 1.0))


def left_by_backbone(
    record: Record, pair: np.ndarray, others: np.ndarray, *, offset: bool, enough: float = 0.0
) -> float:
    """Least sum of squares that one mode on a backbone leaves of a record of one output, in place of two linear ones.

    Args:
        record: free decay.
        pair: (2,) poles of the two, rad/s.
        others: (n_others,) of linear modes beside them, which are held.
        offset: whether the output may also hold a constant.
        enough: what need not be gone below.
    """
    amplitudes = project(record, np.append(pair, others), offset).complex_amplitudes[0, :2]
    least = np.inf
    for powers in POWERS:
        for left in _Backbone(record, np.array(powers), others, offset).fits(pair, amplitudes):
            least = min(least, left)
            if least <= enough:
                return least
    return least


@njit(cache=True, nogil=True)
def _rate(u: float, real: Floats, powers: Floats, faded: float) -> float:
    """u' of u = -ln r."""
    return -float(np.sum(real * np.exp(-min(max(u, -1.0), faded) * powers)))


@njit(cache=True, nogil=True)
def _envelopes(real: Floats, powers: Floats, t: Floats, faded: float, died: float) -> tuple[Floats, Floats]:
    """u = -ln r and u' at the times t, (n_times, n_rows), for each row of Re λ (n_rows, 3)."""
    h, u, rates = t[1], np.zeros((t.size, len(real))), np.zeros((t.size, len(real)))
    for j in range(len(real)):
        row = real[j]
        for k in range(t.size):
            at = u[k, j]
            rates[k, j] = a = _rate(at, row, powers, faded)
            if k + 1 < t.size:
                b = _rate(at + 0.5 * h * a, row, powers, faded)
                c = _rate(at + 0.5 * h * b, row, powers, faded)
                d = _rate(at + h * c, row, powers, faded)
                u[k + 1, j] = min(max(at + h / 6.0 * (a + 2.0 * b + 2.0 * c + d), -1.0), died)
    return u, rates


def backbone_integrals(real: np.ndarray, powers: np.ndarray, time: np.ndarray) -> list[Floats]:
    """∫ r^p_k dt from 0 to each time, (n, 3), for each row of Re λ (n_rows, 3): u = -ln r by Runge and Kutta's rule."""
    t = np.linspace(0.0, time[-1], BACKBONE.steps + 1)
    u, rates = _envelopes(real, powers, t, BACKBONE.faded, BACKBONE.died)
    raised = np.exp(-np.clip(u, -1.0, BACKBONE.faded)[:, :, None] * powers)
    slopes = -powers * raised * np.where(u < BACKBONE.faded, rates, 0.0)[:, :, None]
    return list(CubicHermiteSpline(t, raised, slopes).antiderivative()(time).swapaxes(0, 1))


class _Backbone:
    """The fit of one law of powers; what is linear in the record drops out."""

    def __init__(self, record: Record, powers: np.ndarray, others: np.ndarray, offset: bool) -> None:
        self.time, self.powers = record.sample_time * np.arange(record.n_samples), powers
        exponentials = np.exp(np.outer(self.time, others))
        columns = np.hstack([exponentials.real, exponentials.imag, np.ones((self.time.size, int(offset)))])
        self.beside = np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))[0]
        self.y = self._apart(record.outputs[0])
        self.last: tuple[np.ndarray, tuple[np.ndarray, np.ndarray]] | None = None

    def fits(self, pair: np.ndarray, amplitudes: np.ndarray) -> Iterator[float]:
        """What is left, from what the two look like, z: their own z'/z by |z|; and from the stronger of them."""
        each = amplitudes * np.exp(np.outer(self.time, pair))
        z, slope = each.sum(axis=1), (each * pair).sum(axis=1)
        size = np.abs(z) / max(abs(z[0]), 1e-3 * np.abs(z).max())
        by_power = np.maximum(size, np.exp(-BACKBONE.faded))[:, None] ** self.powers
        alike = np.linalg.lstsq(z[:, None] * by_power, slope, rcond=None)[0]
        left, slopes = (lambda p, k=k: self._once(p)[k] for k in (0, 1))
        for start in (alike, np.array([pair[np.argmax(np.abs(amplitudes))], 0.0, 0.0])):
            at = np.r_[start.real, start.imag]
            yield 2.0 * float(least_squares(left, at, slopes, x_scale="jac", max_nfev=BACKBONE.most_tries).cost)

    def _once(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`_fitted`, kept for the slopes that are asked for where what is left was."""
        if self.last is None or not np.array_equal(self.last[0], unknowns):
            self.last = unknowns.copy(), self._fitted(unknowns)
        return self.last[1]

    def _fitted(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is left (n,) and its slopes by Re λ and Im λ (n, 6), A projected out (Kaufman 1975)."""
        real, turn = unknowns[:3], 1j * unknowns[3:]
        step = BACKBONE.slightly * max(abs(real[0]), 1e-3 / self.time[-1])
        held, *moved = backbone_integrals(np.vstack([real, real + step * np.eye(3)]), self.powers, self.time)
        with np.errstate(over="ignore", invalid="ignore"):
            motion = np.exp(held @ (real + turn))
            by_real = [(np.exp(h @ (r + turn)) - motion) / step for h, r in zip(moved, real + step * np.eye(3))]
        if not (np.abs(by_real) < BACKBONE.largest).all():
            return BACKBONE.beyond * np.abs(self.y), np.zeros((self.y.size, 6))
        q, r = np.linalg.qr(self._apart(np.column_stack([motion.real, motion.imag])))
        seen = q.T @ self.y
        a, b = np.linalg.lstsq(r, seen, rcond=1e-12)[0]
        slopes = np.column_stack([*by_real, 1j * motion[:, None] * held])
        slopes = self._apart(slopes.real * a + slopes.imag * b)
        return self.y - q @ seen, -(slopes - q @ (q.T @ slopes))

    def _apart(self, columns: np.ndarray) -> np.ndarray:
        return np.asarray(columns - self.beside @ (self.beside.T @ columns))
