"""Modes of transfer functions that one pole does not describe: uneven peaks, and clusters.

The transfer function of a mode that drifts while it is measured is the mean of those of its poles λ + δ,

    <1 / (s - λ - δ)> = 1 / (s - λ) + <δ²> / (s - λ)³ + ...,      <δ> = 0,

and a free decay of λ + δ t / T has the same term: t² e^{λt} / 2 has the transform 1 / (s - λ)³. A mode that depends on
its amplitude, and one blurred by a window, have it too. No mode of a linear structure has it, so it is fitted to what
the modes leave, with the shape and the participation of each mode. Where several linear modes stand for one that
changes far, `changing_decay` fits that one in their place.

Points measured one after another are inconsistent: a roving sensor loads the structure elsewhere, a harder hit rings
lower. A linear model fits such a mode only by a cluster: three and more modes within each other's half-power bands,
with complex shapes of no common phase. Only one is then reported.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from workbench.arrays import Floats
from workbench.identification.input_output.modal_fit import Fit, columns
from workbench.identification.input_output.spectral_lines import Lines


@dataclass(frozen=True)
class PeaksSettings:
    """Constants of the search for peaks that are not those of one pole, and for clusters."""

    false_alarm: float = 1e-6  # chance that noise alone makes such a peak
    matters: float = 0.2  # of the half-power half-width: a smaller scatter of the pole harms no model
    beside: float = 4.0  # half-power half-widths about a mode in which its noise is measured
    fewest: int = 3  # modes of a cluster: two modes of one structure may overlap
    in_phase: float = 0.95  # phase collinearity of shapes that overlap where damping is proportional
    narrow: float = 3.0  # half-power bands of the strongest: broader ones do not extend the cluster


PEAKS = PeaksSettings()


class Peaks(NamedTuple):
    """How far the peak of each mode is from that of one pole.

    Attributes:
        uneven: (n_modes,) where it is so by more than chance, and enough to matter.
        scatter: (n_modes,) rms of δ, rad/s.
        statistic: (n_modes,) χ² of the further term, in the noise of the fit.
    """

    uneven: np.ndarray
    scatter: Floats
    statistic: Floats


def peaks(lines: Lines, fit: Fit) -> Peaks:
    """The further term of every mode, beside all that the modes can follow."""
    n = fit.poles.size
    if not n:
        return Peaks(np.zeros(0, bool), np.zeros(0), np.zeros(0))
    third = [_third(lines, pole, l_r) for pole, l_r in zip(fit.poles, fit.participation, strict=True)]
    slopes = [lines.slopes(pole, l_r) for pole, l_r in zip(fit.poles, fit.participation, strict=True)]
    real, imaginary = (np.column_stack([s[k] for s in (*third, *slopes)]) for k in (0, 1))
    phi = columns(lines, fit.poles, fit.participation)[0]
    phi = phi / np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    size = np.maximum(np.hypot(np.linalg.norm(real, axis=0), np.linalg.norm(imaginary, axis=0)), 1e-300)
    rows, left = [], []
    for j, (a, noise) in enumerate(zip(fit.amplitudes, fit.noise, strict=True)):
        weight = 1.0 if lines.weights is None else lines.weights[:, j : j + 1]
        q = np.linalg.qr(weight * phi)[0]
        both = np.tile(a, 2) / size
        moved = weight * np.hstack(
            [both.real * real - both.imag * imaginary, -both.imag * real - both.real * imaginary]
        )
        rows.append((moved - q @ (q.T @ moved)) / noise)
        left.append(fit.residual[:, j] / noise)
    m, y = np.vstack(rows), np.concatenate(left)
    u, s, vt = np.linalg.svd(m, full_matrices=False)
    kept = s > 1e-9 * s[0]
    found = vt[kept].T @ ((u[:, kept].T @ y) / s[kept])
    covariance = (vt[kept].T / s[kept] ** 2) @ vt[kept]
    rest = lines.unstacked((y - m @ found).reshape(fit.noise.size, -1).T)
    power = 0.5 * (np.abs(rest) ** 2).mean(axis=(0, 1))
    uneven, scatter, statistic = np.zeros(n, bool), np.zeros(n), np.zeros(n)
    for r, pole in enumerate(fit.poles):
        both = np.array([r, 2 * n + r])
        beside = np.abs(lines.omega - pole.imag) < max(PEAKS.beside * abs(pole.real), PEAKS.beside * lines.resolution)
        noise_ratio = max(1.0, float(power[beside].mean())) if beside.any() else 1.0
        value = found[both]
        statistic[r] = value @ np.linalg.pinv(covariance[np.ix_(both, both)], hermitian=True) @ value
        scatter[r] = np.sqrt(np.hypot(*value) / size[r])
        sure = statistic[r] > noise_ratio * chi2.isf(PEAKS.false_alarm, 2)
        uneven[r] = sure and scatter[r] > PEAKS.matters * abs(pole.real)
    return Peaks(uneven, scatter, statistic)


def _third(lines: Lines, pole: complex, participation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """l / (s - λ)³ as rows, for the real and the imaginary part of its factor."""
    s = 1j * lines.omega
    above = participation[:, None] / (s - pole) ** 3
    below = participation.conj()[:, None] / (s - pole.conjugate()) ** 3
    return lines.stacked_pair(above, below)


def parts_of(poles: np.ndarray, collinearity: np.ndarray, strength: np.ndarray) -> dict[int, list[int]]:
    """The representative of each cluster, with its other members; modes in no cluster are absent.

    Args:
        poles: (n_modes,) rad/s.
        collinearity: (n_modes,) modal phase collinearity, 1 where all points move in phase.
        strength: (n_modes,) the strongest of a cluster represents it.
    """
    width = np.abs(poles.real)
    near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < width[:, None] + width
    left, clusters = list(np.argsort(-strength)), dict[int, list[int]]()
    while left:
        first = left.pop(0)
        cluster, leads = [int(first)], [first]
        while leads:
            lead = leads.pop()
            met = [r for r in left if near[r, lead]]
            left = [r for r in left if r not in met]
            cluster += [int(r) for r in met]
            leads += [r for r in met if width[r] < PEAKS.narrow * width[first]]
        if len(cluster) >= PEAKS.fewest and collinearity[cluster].min() < PEAKS.in_phase:
            clusters[cluster[0]] = cluster[1:]
    return clusters


def overlap_remarks(poles: np.ndarray, n_channels: int) -> tuple[str, ...]:
    """A remark on modes within each other's half-power bands that one pair of input and output cannot distinguish.

    Args:
        poles: (n_modes,) rad/s, by rising frequency.
        n_channels: outputs times inputs; two and more distinguish modes by their shapes.
    """
    width = np.abs(poles.real)
    near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < width[:, None] + width
    first, second = np.nonzero(np.triu(near, 1))
    if n_channels > 1 or not first.size:
        return ()
    pairs = ", ".join(f"{r + 1} and {s + 1}" for r, s in zip(first, second, strict=True))
    return (
        f"modes {pairs} overlap: one mode that drifts or depends on amplitude looks like that to a single input and"
        " output; compare parts of the record, or measure at another place",
    )
