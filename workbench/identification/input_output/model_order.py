"""Which modes a measurement holds, whatever drives them, decided by likelihood."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from workbench.identification.free_decay.identified import FALSE_ALARM, MOST_DAMPED, SAME_SHAPE
from workbench.identification.input_output.modal_fit import Drive, Fit, projected, search, settled
from workbench.structure.modes import mac

MOST_REFUSALS = 3
MOST_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Told:
    """Modes told from noise.

    Attributes:
        fit: of them all.
        evidence: (n_modes,) χ² of each.
        limit: what noise alone exceeds by false alarm.
        full: whether more might be there, the most modes being taken.
    """

    fit: Fit
    evidence: np.ndarray
    limit: float
    full: bool


def tell(drive: Drive, *, most_modes: int, false_alarm: float = FALSE_ALARM) -> Told:
    """The modes whose likelihood ratio is more than noise would give, taken in one by one and each tried again."""
    outputs, drives = drive.values.shape[1], drive.answers((-0.1 + 0.5j) * drive.highest)[0].shape[1]
    limit = float(chi2.isf(false_alarm / drive.cells, 2 * (outputs + drives)))
    fit = projected(drive, np.zeros(0, complex), np.zeros((0, drives), complex))
    full = False
    for _ in range(MOST_ROUNDS):
        grown = _grown(drive, fit, limit, most_modes)
        kept = _pruned(drive, settled(drive, grown), limit)
        ended = kept.poles.size <= fit.poles.size or kept.poles.size == grown.poles.size
        fit, full = kept, grown.poles.size >= most_modes
        if ended:
            break
    order = np.argsort(np.abs(fit.poles))
    evidence = np.array([evidence_of(fit, r) for r in order])
    fit = replace(projected(drive, fit.poles[order], fit.loads[order]), converged=fit.converged, steps=fit.steps)
    return Told(fit, evidence, limit, full)


def _grown(drive: Drive, fit: Fit, limit: float, most_modes: int) -> Fit:
    refused: list[complex] = []
    while fit.poles.size < most_modes and len(refused) < MOST_REFUSALS:
        tries = [pole for pole in _to_try(drive, fit) if not _near(drive, pole, refused)]
        bases, left = bases_of(drive, fit), fit.residual / fit.noise
        scored = [(*_added(drive, bases, left, pole), pole) for pole in tries]
        if not scored:
            break
        strength, load, pole = max(scored, key=lambda item: item[0])
        colour = drive.colour(fit.residual / fit.noise, pole)
        if strength < 0.5 * limit * colour:
            break
        try:
            trial = search(drive, np.append(fit.poles, pole), np.vstack([fit.loads, load]), fit.noise, 20)
            gain = ratio(drive, fit, trial)
        except np.linalg.LinAlgError:
            gain = 0.0
        if gain < limit * colour or no_modes(drive, trial).any():
            refused.append(pole)
        else:
            fit, refused = trial, []
    return fit


def _to_try(drive: Drive, fit: Fit) -> np.ndarray:
    """What stands out of the residual, and what may hide beside the modes there already."""
    width = np.maximum(np.abs(fit.poles.real), 0.5 * drive.resolution)
    beside = [fit.poles + 1j * k * width for k in (-4.0, -2.0, -1.0, 1.0, 2.0, 4.0)]
    tries = np.concatenate([drive.candidates(fit.residual / fit.noise), *beside])
    return tries[(tries.imag > 0) & (tries.imag < drive.highest) & (-tries.real < MOST_DAMPED * np.abs(tries))]


def _near(drive: Drive, pole: complex, others: Sequence[complex]) -> bool:
    return any(abs(pole.imag - o.imag) < max(drive.resolution, 0.5 * abs(o.real)) for o in others)


def _added(drive: Drive, bases: list[np.ndarray], left: np.ndarray, pole: complex) -> tuple[float, np.ndarray]:
    """χ² by which one more pole lowers the misfit, each output answering each drive as it likes; the loads it wants.

    Of its answer only what stands off the basis of the columns there already is new.
    """
    real, imaginary = drive.answers(pole)
    columns, size, strength, wanted = np.hstack([real, imaginary]), real.shape[1], 0.0, []
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    together = [left] if drive.weights is None else np.hsplit(left, left.shape[1])
    for weights, basis, rest in zip(weights_of(drive), bases, together, strict=True):
        weighted = weights * columns / scale
        apart = weighted - basis @ (basis.T @ weighted)
        u, s, vt = np.linalg.svd(apart, full_matrices=False)
        good = s > 1e-4 * max(s[0], 1e-3)
        seen = u.T[good] @ rest
        wanted.append((vt.T[:, good] / s[good]) @ seen / scale[:, None])
        strength += float((seen**2).sum())
    c = np.hstack(wanted)
    heard = np.hypot(scale[:size], scale[size:])
    load = np.linalg.svd((c[:size] - 1j * c[size:]) * heard[:, None])[0][:, 0] / heard
    return strength, load


def bases_of(drive: Drive, fit: Fit) -> list[np.ndarray]:
    """What `basis_of` says, as the outputs weigh it: one for each, or one for all of equal weights."""
    return [basis_of(drive, fit, weights) for weights in weights_of(drive)]


def weights_of(drive: Drive) -> list[np.ndarray]:
    """Of each output (n_rows, 1), in units of their mean; of all together where they are the same in all rows."""
    if drive.weights is None:
        return [np.ones((1, 1))]
    return list((drive.weights / np.sqrt((drive.weights**2).mean(axis=0))).T[:, :, None])


def basis_of(drive: Drive, fit: Fit, weights: np.ndarray | float = 1.0) -> np.ndarray:
    """Orthonormal columns (n_rows, n_columns) that span the swings of a fit and what is fixed beside them, weighted."""
    swings = []
    for pole, load in zip(fit.poles, fit.loads):
        real, imaginary = drive.answers(pole)
        swings += [real @ load.real - imaginary @ load.imag, real @ load.imag + imaginary @ load.real]
    phi = weights * (np.column_stack([*swings, drive.fixed]) if swings else drive.fixed)
    return np.linalg.qr(phi / np.maximum(np.linalg.norm(phi, axis=0), 1e-300))[0]


def ratio(drive: Drive, before: Fit, after: Fit) -> float:
    """Twice the log likelihood ratio, the noise of each output unknown."""
    n = drive.values.shape[0]
    first, second = ((fit.residual**2).sum(axis=0) for fit in (before, after))
    floor = 1e-24 * (drive.values**2).sum(axis=0) + 1e-300
    return float(n * np.log((first + floor) / (second + floor)).sum())


def no_modes(drive: Drive, fit: Fit) -> np.ndarray:
    """Which are damped beyond what rings, or split another mode that has their shape and their band."""
    poles = fit.poles
    shapes = fit.amplitudes / fit.noise[:, None]
    strength = np.array([evidence_of(fit, r) for r in range(poles.size)])
    band = np.abs(poles.real)[:, None] + np.abs(poles.real) + drive.resolution
    near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < band
    alike = mac(shapes, shapes) * mac(fit.loads.T, fit.loads.T)
    one = shapes.shape[0] * fit.loads.shape[1] == 1
    split = near & (alike > SAME_SHAPE) & (strength[:, None] < strength) & (not one)
    return split.any(axis=1) | (-poles.real > MOST_DAMPED * np.abs(poles))


def evidence_of(fit: Fit, r: int) -> float:
    """χ² of a mode's shape in the noise, poles and loads held."""
    both, noise, found = [r, fit.poles.size + r], fit.noise, 0.0
    first = 0
    for part in fit.parts:
        c = part.coefficients[both] / noise[first : first + part.residual.shape[1]]
        first += c.shape[1]
        found += float((c * np.linalg.solve(part.spread[np.ix_(both, both)], c)).sum())
    return found


def _pruned(drive: Drive, fit: Fit, limit: float) -> Fit:
    """Without the modes that the likelihood does not miss."""
    while fit.poles.size:
        trials = []
        damped = no_modes(drive, fit)
        for r, pole in enumerate(fit.poles):
            near = np.abs(np.delete(fit.poles, r) - pole).min(initial=np.inf) < 2.0 * abs(pole.real)
            need = limit * drive.colour(fit.residual / fit.noise, pole)
            if damped[r] or near or evidence_of(fit, r) < 4.0 * need:
                rest = np.delete(np.arange(fit.poles.size), r)
                without = settled(drive, projected(drive, fit.poles[rest], fit.loads[rest]), 12)
                gain = ratio(drive, without, fit)
                if damped[r] or gain < need:
                    trials.append((gain, without))
        if not trials:
            return fit
        fit = min(trials, key=lambda item: item[0])[1]
    return fit
