"""Mode pairing: which measured modes are those of a model, and which are not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from workbench.identification.signal.modal_estimates import check_finite, check_placed
from workbench.structure.modes import Modes, SampledModes, mac
from workbench.structure.printed import Printed, counted

ITSELF = 1e-3  # weight of a shape by itself beside the subspace of repeated modes: it decides where these agree alike


@dataclass(frozen=True, eq=False, repr=False)
class ModePairing(Printed):
    """Measured modes paired one to one with those of a model.

    Attributes:
        matched: (n_matched,) indices of the measured modes that are the model's, by increasing mode of the model.
        model: (n_matched,) indices of the model's modes they are.
        mac: (n_matched,) agreement of the shapes.
        scaled_hz: (n_matched,) the model's frequencies, scaled to the first match, Hz.
        others: (n_others,) indices of the measured modes that are not the model's.
    """

    matched: np.ndarray
    model: np.ndarray
    mac: np.ndarray
    scaled_hz: np.ndarray
    others: np.ndarray

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        each = zip(self.matched, self.model, self.mac, self.scaled_hz)
        rows = [(str(r + 1), str(s + 1), f"{m:.4f}", f"{hz:.5g}") for r, s, m, hz in each]
        lost = ", ".join(str(r + 1) for r in self.others)
        remarks = (f"measured, and none of the model's: {lost}",) if lost else ()
        headings = ("measured mode", "mode of the model", "MAC", "its frequency, scaled [Hz]")
        return f"{counted(len(rows), 'mode')} paired", headings, rows, remarks


def repeated_modes(omega: np.ndarray, repeated: float = 1e-3) -> np.ndarray:
    """Which modes are repeated: (n_modes,) the same number for those whose frequencies follow within `repeated`.

    Args:
        omega: (n_modes,) frequencies, not decreasing.
        repeated: largest relative step of frequency from one mode to the next.
    """
    return np.cumsum(np.r_[False, np.diff(omega) > repeated * np.maximum(omega[1:], 1e-300)])


def subspace_mac(first: np.ndarray, second: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Modal assurance criterion in which repeated modes of the second set count as the subspace that they span.

    MAC_rs = |P_s φ_r|² / |φ_r|², P_s the projection on the span of all ψ_t with |ω_t / ω_s - 1| chained below
    a thousandth: any basis of repeated modes agrees alike. Where ω_s stands alone it is the plain criterion.

    Args:
        first: (n_points, n_first) shapes, real or complex.
        second: (n_points, n_second).
        omega: (n_second,) frequencies of the second set, not decreasing.

    Returns:
        (n_first, n_second), between 0 and 1.
    """
    return _cluster_mac(first, second, repeated_modes(omega))


def _cluster_mac(first: np.ndarray, second: np.ndarray, cluster: np.ndarray) -> np.ndarray:
    agreement = mac(first, second)
    for each in np.unique(cluster):
        members = np.flatnonzero(cluster == each)
        if members.size > 1:
            basis = np.linalg.qr(second[:, members])[0]
            share = (np.abs(basis.conj().T @ first) ** 2).sum(axis=0) / (np.abs(first) ** 2).sum(axis=0)
            agreement[:, members] = share[:, None]
    return agreement


def assigned(
    first: np.ndarray, second: np.ndarray, cluster: np.ndarray, *, least: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which shape of the second set each of the first is: rows, columns, and the agreement by `subspace_mac`.

    Of repeated modes, which agree alike as a subspace, each goes to the one that is most like it by itself.

    Args:
        first, second: as `subspace_mac` takes them.
        cluster: (n_second,) number of the cluster that each of the second belongs to.
        least: agreement below it counts as none.
    """
    agreement = _cluster_mac(first, second, cluster)
    alike = np.where(agreement >= least, agreement + ITSELF * mac(first, second), 0.0)
    return *linear_sum_assignment(-alike), agreement


def pair_modes(measured: SampledModes, model: Modes, *, shape: float = 0.9, frequency: float = 0.1) -> ModePairing:
    """Match measured modes with a model of unknown scale of frequency, each at most once, by shape, then frequency.

    A measured mode is the model's if its shape agrees with that of a mode that no other measured mode agrees with
    better, and if the frequencies keep the model's ratios. Repeated modes of the model are matched as the subspace
    that they span.

    Args:
        measured: shapes at placed sensors, their places those of the model's domain.
        model: computed modes of the structure it should be; its frequencies count by their ratios only.
        shape: least MAC of a match.
        frequency: largest relative difference from the median ratio.

    Raises:
        ValueError: a sensor without a place, or at one that the model does not have, a shape that is not finite.
    """
    check_placed(measured)
    check_finite(measured.shapes)
    own, cluster = model.phi(measured.positions), repeated_modes(model.omega)
    rows, columns, agreement = assigned(measured.shapes, own, cluster, least=shape)
    good = agreement[rows, columns] >= shape
    rows, columns = rows[good], columns[good]
    ratio = measured.omega[rows] / model.omega[columns]
    if ratio.size:
        near = np.abs(ratio / np.median(ratio) - 1.0) <= frequency
        rows, columns = rows[near], columns[near]
    order = np.argsort(columns)
    rows, columns = rows[order], columns[order]
    scale = measured.frequencies_hz[rows[0]] / model.frequencies_hz[columns[0]] if rows.size else 1.0
    others = np.setdiff1d(np.arange(measured.n_modes), rows)
    return ModePairing(rows, columns, agreement[rows, columns], scale * model.frequencies_hz[columns], others)
