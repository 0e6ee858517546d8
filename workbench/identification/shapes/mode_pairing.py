"""Mode pairing: the one-to-one match of measured modes and those of a model."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import orth
from scipy.optimize import linear_sum_assignment

from workbench.identification.signal.modal_estimates import check_finite, check_placed
from workbench.structure.modes import Modes, SampledModes, mac
from workbench.structure.printed import Printed, counted

PLAIN_WEIGHT = 1e-3  # of the plain MAC beside that of the subspace: it decides among repeated modes
HIDDEN = 1e-9  # of the largest shape: one below it is zero at all sensors, and what rounding leaves of it is no shape


@dataclass(frozen=True, eq=False, repr=False)
class ModePairing(Printed):
    """Measured modes paired one to one with those of a model.

    Attributes:
        matched: (n_matched,) indices of the paired measured modes, by increasing mode of the model.
        model: (n_matched,) indices of the model's modes paired with them.
        mac: (n_matched,) MAC of each pair.
        scaled_hz: (n_matched,) the model's frequencies, scaled to the first pair of elastic modes, Hz.
        others: (n_others,) indices of the measured modes without a pair.
    """

    matched: np.ndarray
    model: np.ndarray
    mac: np.ndarray
    scaled_hz: np.ndarray
    others: np.ndarray

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        each = zip(self.matched, self.model, self.mac, self.scaled_hz)
        rows = [(str(r + 1), str(s + 1), f"{m:.4f}", f"{hz:.5g}") for r, s, m, hz in each]
        unpaired = ", ".join(str(r + 1) for r in self.others)
        remarks = (f"measured modes without a mode of the model: {unpaired}",) if unpaired else ()
        headings = ("measured mode", "mode of the model", "MAC", "frequency of the model, scaled [Hz]")
        return f"{counted(len(rows), 'mode')} paired", headings, rows, remarks


def repeated_modes(omega: np.ndarray, repeated: float = 1e-3) -> np.ndarray:
    """Cluster number of each mode, (n_modes,), equal for repeated modes.

    Their frequencies `omega`, which must not decrease, step by at most a share `repeated` from one to the next.
    """
    return np.cumsum(np.r_[False, np.diff(omega) > repeated * np.maximum(omega[1:], 1e-300)])


def subspace_mac(first: np.ndarray, second: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Modal assurance criterion in which repeated modes of the second set count as the subspace that they span.

    MAC_rs = |P_s φ_r|² / |φ_r|², P_s the projection on the span of all ψ_t in the cluster of ω_s, whose consecutive
    frequencies differ by less than a thousandth: it does not depend on the basis of repeated modes. For a single mode
    it is the plain criterion.

    Args:
        first: (n_points, n_first) shapes, real or complex.
        second: (n_points, n_second).
        omega: (n_second,) frequencies of the second set, not decreasing.

    Returns:
        (n_first, n_second), between 0 and 1; 0 for a shape ψ_s that is zero at all points.
    """
    return _cluster_mac(first, _without_rounding(second), repeated_modes(omega))


def _without_rounding(shapes: np.ndarray) -> np.ndarray:
    """Shapes (n_points, n_modes) with zeros for those of which rounding alone is left: all points are their nodes."""
    size = np.abs(shapes).max(axis=0)
    return np.where(size > HIDDEN * size.max(), shapes, 0.0)


def _cluster_mac(first: np.ndarray, second: np.ndarray, cluster: np.ndarray) -> np.ndarray:
    values = mac(first, second)
    for number in np.unique(cluster):
        members = np.flatnonzero(cluster == number)
        if members.size > 1:
            basis = orth(second[:, members], rcond=HIDDEN)
            share = (np.abs(basis.conj().T @ first) ** 2).sum(axis=0) / (np.abs(first) ** 2).sum(axis=0)
            values[:, members] = share[:, None]
    return values


def assigned(
    first: np.ndarray, second: np.ndarray, cluster: np.ndarray, *, least: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Optimal assignment of two sets of shapes: rows, columns, and the `subspace_mac`, (n_first, n_second).

    Among repeated modes, of equal subspace MAC and cluster number (n_second,), the plain MAC decides. A pair of a MAC
    below `least` is none.
    """
    second = _without_rounding(second)
    agreement = _cluster_mac(first, second, cluster)
    score = np.where(agreement >= least, agreement + PLAIN_WEIGHT * mac(first, second), 0.0)
    return *linear_sum_assignment(-score), agreement


def pair_modes(measured: SampledModes, model: Modes, *, shape: float = 0.9, frequency: float = 0.1) -> ModePairing:
    """Pairs of measured modes and those of a model of unknown frequency scale, by shape, then by frequency.

    The shapes are assigned one to one; a pair needs the least MAC, and a frequency ratio near the median of all pairs.
    Repeated modes of the model are matched as the subspace that they span. Its rigid modes, of 0 Hz, are matched by
    shape with modes measured below the others.

    Args:
        measured: shapes at placed sensors, their places those of the model's domain.
        model: computed modes; only the ratios of its frequencies are used.
        shape: least MAC of a pair.
        frequency: largest relative difference from the median ratio.

    Raises:
        ValueError: a sensor without a place, or at one that the model does not have, a shape that is not finite.
    """
    check_placed(measured)
    check_finite(measured.shapes)
    model_shapes, cluster = model.phi(measured.positions), repeated_modes(model.omega)
    rows, columns, agreement = assigned(measured.shapes, model_shapes, cluster, least=shape)
    paired = np.flatnonzero(agreement[rows, columns] >= shape)
    order = paired[np.argsort(columns[paired])]
    rows, columns = rows[order], columns[order]
    elastic, consistent, scale = model.omega[columns] > 0.0, np.zeros(rows.size, bool), 1.0
    if elastic.any():
        ratio = measured.omega[rows[elastic]] / model.omega[columns[elastic]]
        consistent[elastic] = np.abs(ratio / np.median(ratio) - 1.0) <= frequency
    if consistent.any():
        first = np.argmax(consistent)
        scale = measured.frequencies_hz[rows[first]] / model.frequencies_hz[columns[first]]
        # the suspension of a free structure gives its rigid modes a frequency
        consistent |= ~elastic & (measured.omega[rows] < measured.omega[rows[consistent]].min())
    rows, columns = rows[consistent], columns[consistent]
    others = np.setdiff1d(np.arange(measured.n_modes), rows)
    return ModePairing(rows, columns, agreement[rows, columns], scale * model.frequencies_hz[columns], others)
