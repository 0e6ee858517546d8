"""Modes whose frequency changes within a record, evenly with time.

A mode that remembers little of the record feels its pole as it is at the time: where λ(t) = λ + δ (t - T/2) / T,
z(t) moves by δ (t - T/2) / T ∂z/∂λ to first order. Regressed on that, beside all that a constant model can follow, what
the model leaves tells δ of every mode, with its standard error.
"""

from typing import NamedTuple

import numpy as np

from workbench.arrays import Floats
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import Fit, columns, projected, settled
from workbench.identification.input_output.model_order import evidence_of
from workbench.identification.signal.least_squares import Budget

SURE = 5.0  # standard errors that a change must have
NEAR, ALIKE = 3.0, 0.9  # half-power bandwidths apart, and modal assurance, of modes that may be one
INSTEAD = 0.5  # of what a second mode explains that a change of the first must explain in its place
MATTERS = 0.1  # of the half-power bandwidth: a smaller change harms no model
FADED = 4.0  # time constants of a mode that a record must hold: of fewer, the change is no small one


class Change(NamedTuple):
    """What each frequency changes by from the beginning of a record to its end, relative, and its standard error.

    Attributes:
        frequency, deviation: (n_modes,).
        sure: (n_modes,) where it is more than chance, and enough to matter.
    """

    frequency: Floats
    deviation: Floats
    sure: np.ndarray


def changes_in_time(data: KnownInputs, fit: Fit) -> Change:
    """The change of every mode over the records, to first order about a fit of constant modes."""
    n, poles = fit.poles.size, fit.poles
    phi, t = columns(data, poles, fit.participation)
    slopes = [data.slopes(pole, l_r) for pole, l_r in zip(poles, fit.participation, strict=True)]
    real, imaginary = (data.tilted(np.column_stack([s[k] for s in slopes])) for k in (0, 1))
    basis = np.hstack([phi, t])
    basis = basis / np.maximum(np.linalg.norm(basis, axis=0), 1e-300)
    products, along = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
    each = zip(fit.amplitudes, fit.noise, fit.residual.T, strict=True)
    q = np.linalg.qr(basis)[0]
    for j, (a, noise, left) in enumerate(each):
        weight = 1.0 if data.weights is None else data.weights[:, j : j + 1]
        if data.weights is not None:
            q = np.linalg.qr(weight * basis)[0]
        moved = weight * np.hstack([a.real * real - a.imag * imaginary, -a.real * imaginary - a.imag * real])
        moved = (moved - q @ (q.T @ moved)) / noise
        products += moved.T @ moved
        along += moved.T @ (left / noise)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(products), 1e-300))
    inverse = np.linalg.pinv(products * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)
    change, deviation = inverse @ along, np.sqrt(np.diag(inverse))
    omega, span = np.abs(poles), 2.0 * np.pi / data.resolution
    moving, error = np.abs(change[n:]), deviation[n:]
    sure = (moving > SURE * error) & (moving > MATTERS * np.abs(poles.real)) & (-poles.real * span > FADED)
    return Change(change[n:] / omega, error / omega, sure)


def joined(data: KnownInputs, fit: Fit, budget: Budget) -> Fit:
    """The fit with one mode for two that are alike, where a change of the one within the record explains the other."""
    for r, s in _pairs(fit):
        if budget.spent("check of modes that change within the record"):
            break
        evidence = [evidence_of(fit, r), evidence_of(fit, s)]
        strong, weak = (r, s) if evidence[0] > evidence[1] else (s, r)
        kept = np.delete(np.arange(fit.poles.size), weak)
        one = settled(data, projected(data, fit.poles[kept], fit.participation[kept]), budget=budget)
        change, at = changes_in_time(data, one), int(np.searchsorted(kept, strong))
        worth = float((((one.residual**2).sum(axis=0) - (fit.residual**2).sum(axis=0)) / one.noise**2).sum())
        if change.sure[at] and (change.frequency[at] / change.deviation[at]) ** 2 > INSTEAD * worth:
            return joined(data, one, budget)
    return fit


def _pairs(fit: Fit) -> list[tuple[int, int]]:
    """Modes near each other with shapes alike, the nearest first."""
    poles, shapes = fit.poles, fit.amplitudes
    size = np.maximum(np.linalg.norm(shapes, axis=0), 1e-300)
    alike = np.abs((shapes / size).conj().T @ (shapes / size)) ** 2 > ALIKE
    apart = np.abs(np.subtract.outer(poles.imag, poles.imag))
    near = apart < NEAR * np.add.outer(np.abs(poles.real), np.abs(poles.real))
    both = zip(*np.nonzero(np.triu(alike & near, 1)), strict=True)
    return sorted(((int(r), int(s)) for r, s in both), key=lambda pair: apart[pair])


def change_remarks(data: KnownInputs, fit: Fit) -> tuple[str, ...]:
    """A remark on the modes that change within a record."""
    if not fit.poles.size:
        return ()
    change = changes_in_time(data, fit)
    words = [
        f"mode {r + 1} ({np.abs(fit.poles[r]) / (2.0 * np.pi):.4g} Hz) by about {100 * change.frequency[r]:+.1g} %"
        for r in np.flatnonzero(change.sure)
    ]
    if not words:
        return ()
    return (
        f"frequencies change within the record, from its beginning to its end: {'; '.join(words)}; such a mode is the"
        " mean of what it was: identify parts of the record, or levels one by one",
    )
