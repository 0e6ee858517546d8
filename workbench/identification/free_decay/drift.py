"""Removal of slow drift from a free decay, its modes unchanged."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.stats import chi2

from workbench.identification.signal.order_selection import FALSE_ALARM
from workbench.records.record import Record
from workbench.structure.modes import frozen

HIGHEST_DEGREE = 8


@dataclass(frozen=True, eq=False)
class Drift:
    """Drift slower than any mode.

    Attributes:
        record: without it; constants stay.
        size: (n_outputs,) from its lowest to its highest, in the unit of each output; 0 where there is none.
    """

    record: Record = field(repr=False)
    size: np.ndarray


def without_drift(record: Record, poles: np.ndarray, *, most: int = HIGHEST_DEGREE) -> Drift:
    """A record less a polynomial in time, fitted beside its modes: y_j = Re Σ a_jr e^{λ_r t} + Σ_k p_jk P_k(t).

    The degree is the least, of those that oscillate no faster than the slowest mode, by Schwarz's criterion; and
    nothing is taken where noise alone would show as much in one record of a thousand.

    Args:
        record: free decay.
        poles: (n_modes,) of its modes, rad/s; may be empty.
        most: highest degree.
    """
    n, m = record.n_samples, record.n_outputs
    span = n * record.sample_time
    highest = int(min(most, np.abs(poles).min(initial=np.inf) * span / (2.0 * np.pi), (n - 4) // 4))
    nothing = Drift(record, frozen(np.zeros(m)))
    if highest < 1:
        return nothing
    decay = np.exp(np.outer(record.sample_time * np.arange(n), poles))
    exponentials = np.hstack([decay.real, decay.imag])
    slow = legvander(np.linspace(-1.0, 1.0, n), highest)
    q, r = np.linalg.qr(np.hstack([slow[:, :1], exponentials, slow[:, 1:]]))
    # Columns of q beyond constant and modes add one degree after the other.
    along = q.T @ record.outputs.T
    fixed = 1 + exponentials.shape[1]
    power = (record.outputs**2).sum(axis=1)
    left = power - np.vstack([(along[:fixed] ** 2).sum(axis=0), along[fixed:] ** 2]).cumsum(axis=0)
    left = np.maximum(left, 1e-26 * power + 1e-300)
    ratio = n * np.log(left[0] / left).sum(axis=1)
    degree = int(np.argmax(ratio - np.log(n * m) * m * np.arange(highest + 1)))
    if degree == 0 or ratio[degree] < chi2.isf(FALSE_ALARM / highest, m * degree):
        return nothing
    kept = fixed + degree
    weights = np.linalg.solve(r[:kept, :kept], along[:kept])[fixed:]
    drift = (slow[:, 1 : degree + 1] @ weights).T
    return Drift(replace(record, outputs=record.outputs - drift), frozen(np.ptp(drift, axis=1)))
