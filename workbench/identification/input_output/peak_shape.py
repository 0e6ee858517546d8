"""Modes of FRFs that one pole does not describe: distorted peaks, and clusters.

The FRF of a mode that drifts while it is measured is the mean of those of its poles λ + δ,

    <1 / (s - λ - δ)> = 1 / (s - λ) + <δ²> / (s - λ)³ + ...,      <δ> = 0,

and a free decay of λ + δ t / T has the same term: t² e^{λt} / 2 has the transform 1 / (s - λ)³. An amplitude-dependent
mode, and one convolved with a window, have it too. No mode of a linear structure has this term, so it is fitted to the
residual, with the shape and the participation factors of each mode. Where several linear modes are fitted to one mode
of a large change, `changing_decay` fits that one in their place.

Points measured one after another are inconsistent: a roving sensor adds its mass elsewhere, a harder impact lowers the
frequency. A linear model fits such a mode by a cluster: three or more modes within each other's half-power bands, with
complex shapes of no common phase. Only one is then reported.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from workbench.arrays import Floats
from workbench.identification.input_output.modal_fit import Fit, changes_of, columns, normalised_columns, row_weights
from workbench.identification.input_output.spectral_lines import Lines


@dataclass(frozen=True)
class PeaksSettings:
    """Constants of the detection of distorted peaks and of clusters."""

    false_alarm_probability: float = 1e-6  # chance that noise alone makes such a peak
    min_scatter: float = 0.2  # of the half-power half-width: a smaller scatter of the pole is negligible
    noise_half_widths: float = 4.0  # half-power ones about a mode in which its noise is measured
    min_cluster_size: int = 3  # modes of a cluster: two modes of one structure may overlap
    min_collinearity: float = 0.95  # modal phase collinearity of overlapping modes of proportional damping
    max_width: float = 3.0  # half-power bands of the strongest mode: broader modes do not extend the cluster


PEAKS = PeaksSettings()


class Peaks(NamedTuple):
    """Deviation of the peak of each mode from that of one pole, (n_modes,) each."""

    uneven: np.ndarray  # whether it is significant and not negligible
    scatter: Floats  # rms of δ, rad/s
    statistic: Floats  # χ² of the term 1 / (s - λ)³, in the noise of the fit


def peaks(lines: Lines, fit: Fit) -> Peaks:
    """The term 1 / (s - λ)³ of every mode, estimated jointly with first-order changes of the fit."""
    n = fit.poles.size
    if not n:
        return Peaks(np.zeros(0, bool), np.zeros(0), np.zeros(0))
    third = [lines.power_of_pole(pole, l_r, 3) for pole, l_r in zip(fit.poles, fit.participation, strict=True)]
    slopes = [lines.slopes(pole, l_r) for pole, l_r in zip(fit.poles, fit.participation, strict=True)]
    real, imaginary = (np.column_stack([s[k] for s in (*third, *slopes)]) for k in (0, 1))
    phi = normalised_columns(columns(lines, fit.poles, fit.participation)[0])
    size = np.maximum(np.hypot(np.linalg.norm(real, axis=0), np.linalg.norm(imaginary, axis=0)), 1e-300)
    rows, residuals = [], []
    for j, (a, noise) in enumerate(zip(fit.amplitudes, fit.noise, strict=True)):
        weight = row_weights(lines)[:, j : j + 1]
        q = np.linalg.qr(weight * phi)[0]
        regressors = weight * changes_of(np.tile(a, 2) / size, (real, imaginary))
        rows.append((regressors - q @ (q.T @ regressors)) / noise)
        residuals.append(fit.residual[:, j] / noise)
    m, y = np.vstack(rows), np.concatenate(residuals)
    u, s, vt = np.linalg.svd(m, full_matrices=False)
    kept = s > 1e-9 * s[0]
    coefficients = vt[kept].T @ ((u[:, kept].T @ y) / s[kept])
    covariance = (vt[kept].T / s[kept] ** 2) @ vt[kept]
    unexplained = lines.unstacked((y - m @ coefficients).reshape(fit.noise.size, -1).T)
    power = 0.5 * (np.abs(unexplained) ** 2).mean(axis=(0, 1))
    uneven, scatter, statistic = np.zeros(n, bool), np.zeros(n), np.zeros(n)
    for r, pole in enumerate(fit.poles):
        pair = np.array([r, 2 * n + r])
        near = np.abs(lines.omega - pole.imag) < PEAKS.noise_half_widths * max(abs(pole.real), lines.resolution)
        noise_ratio = max(1.0, float(power[near].mean())) if near.any() else 1.0
        value = coefficients[pair]
        statistic[r] = value @ np.linalg.pinv(covariance[np.ix_(pair, pair)], hermitian=True) @ value
        scatter[r] = np.sqrt(np.hypot(*value) / size[r])
        significant = statistic[r] > noise_ratio * chi2.isf(PEAKS.false_alarm_probability, 2)
        uneven[r] = significant and scatter[r] > PEAKS.min_scatter * abs(pole.real)
    return Peaks(uneven, scatter, statistic)


def parts_of(poles: np.ndarray, collinearity: np.ndarray, strength: np.ndarray) -> dict[int, list[int]]:
    """The strongest mode of each cluster, with its other members, by index; modes in no cluster are absent."""
    width, overlap = np.abs(poles.real), _overlap(poles)
    remaining, clusters = list(np.argsort(-strength)), dict[int, list[int]]()
    while remaining:
        first = remaining.pop(0)
        cluster, to_extend = [int(first)], [first]
        while to_extend:
            member = to_extend.pop()
            neighbours = [r for r in remaining if overlap[r, member]]
            remaining = [r for r in remaining if r not in neighbours]
            cluster += [int(r) for r in neighbours]
            to_extend += [r for r in neighbours if width[r] < PEAKS.max_width * width[first]]
        if len(cluster) >= PEAKS.min_cluster_size and collinearity[cluster].min() < PEAKS.min_collinearity:
            clusters[cluster[0]] = cluster[1:]
    return clusters


def overlap_remarks(poles: np.ndarray, n_channels: int) -> tuple[str, ...]:
    """A remark on overlapping modes, by rising frequency, that a single pair of input and output cannot distinguish.

    With two and more channels, outputs times inputs, their shapes distinguish them.
    """
    overlapping = np.argwhere(np.triu(_overlap(poles), 1))
    if n_channels > 1 or not overlapping.size:
        return ()
    pairs = ", ".join(f"{r + 1} and {s + 1}" for r, s in overlapping)
    return (
        f"modes {pairs} overlap: one mode that drifts or depends on amplitude looks like that to a single input and"
        " output; compare parts of the record, or measure at another place",
    )


def _overlap(poles: np.ndarray) -> np.ndarray:
    """Whether the half-power bands of two modes overlap, (n_modes, n_modes)."""
    width = np.abs(poles.real)
    return np.asarray(np.abs(np.subtract.outer(poles.imag, poles.imag)) < width[:, None] + width)
