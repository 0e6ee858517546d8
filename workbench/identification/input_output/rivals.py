"""A time- or amplitude-dependent mode as the rival model of several close linear modes, in records and in FRFs.

To first order, its motion beyond that of a linear mode spans a few columns. Where it is likelier than a cluster of
close linear modes, these are removed and the columns stay as fixed columns of the measurement.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from workbench.arrays import Floats
from workbench.identification.input_output.modal_fit import Fit, Measurement, Pair, modal_coordinate, projected
from workbench.identification.input_output.model_order import statistic_of_each
from workbench.identification.signal.searches import Budget


@dataclass(frozen=True)
class RivalSettings:
    """Constants of the comparison of one changing mode with several linear ones."""

    near: float = 6.0  # half-power bandwidths: linear modes closer than this may be one changing mode
    most_clusters: int = 3  # tried per mode: all modes close to it, then without the farthest
    about: float = 12.0  # half-power half-widths beyond the modes, in which the models are compared
    fewest: int = 25  # lines beyond the modes, likewise at least
    slowest: float = 0.05  # of the distance of lines: smallest decay rate
    slightly: float = 1e-5  # of the decay rate: step of finite differences
    most_poles: int = 20  # steps to the linear mode nearest to a changing one
    same_pole: float = 1e-6  # of the decay rate: a smaller step ends them
    collinear: float = 1e-9  # singular value of columns of unit length, below which it is rounding error
    significant: float = 1e-4  # singular value of the columns of a changing mode, above which they count


RIVALS = RivalSettings()
Data = TypeVar("Data", bound=Measurement)


class Motion(Protocol):
    """A changing mode.

    Attributes:
        columns: (n_rows, n_columns) orthonormal columns of its motion beyond that of a linear mode.
        pole: of the nearest linear mode, rad/s.
    """

    @property
    def columns(self) -> Floats: ...

    @property
    def pole(self) -> complex: ...


One = TypeVar("One", bound=Motion)


def in_place_of_clusters(
    data: Data,
    fit: Fit,
    alike: np.ndarray,
    rival_of: Callable[[Data, np.ndarray], One | None],
    beside: Callable[[Data, One], Data],
    budget: Budget,
) -> tuple[Data, Fit] | None:
    """The measurement with the columns of changing modes, and the fit with one mode for each cluster that one replaces.

    Args:
        data: the measurement that `fit` describes.
        fit: of linear modes.
        alike: (n_modes, n_modes) whether two modes may be one, by their shapes.
        rival_of: the changing mode in place of a cluster of modes, the strongest first; None where the linear modes are
            likelier.
        beside: the measurement with the columns of a changing mode.
        budget: of time.

    Returns:
        None where linear modes are likelier everywhere.
    """
    strength = statistic_of_each(fit)
    rates = np.maximum(-fit.poles.real, 0.5 * data.resolution)
    distance = np.abs(np.subtract.outer(fit.poles.imag, fit.poles.imag))
    close = alike & (distance < RIVALS.near * np.add.outer(rates, rates))
    poles, removed = fit.poles.copy(), np.zeros(fit.poles.size, bool)
    for r in np.argsort(-strength):
        others = np.flatnonzero(close[r] & (strength < strength[r]) & ~removed & ~removed[r])
        others = others[np.argsort(distance[r, others])]
        for k in range(others.size, max(others.size - RIVALS.most_clusters, 0), -1):
            if budget.spent("check of modes that change"):
                break
            changing = rival_of(data, np.r_[r, others[:k]])
            if changing is not None:
                data = beside(data, changing)
                removed[others[:k]], poles[r] = True, changing.pole
                break
    return (data, projected(data, poles[~removed], fit.participation[~removed])) if removed.any() else None


def orthonormal_basis(rows: np.ndarray, least: float) -> Floats:
    """Orthonormal basis of the columns of a matrix, of singular values above `least`."""
    u, s, _ = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(u[:, s > least])


def normalised_columns(rows: np.ndarray) -> Floats:
    """Columns scaled to unit length."""
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300))


def columns_beyond_linear(data: Measurement, columns: np.ndarray, pole: complex, l_r: np.ndarray) -> Floats:
    """Orthonormal columns of a motion, (n_rows, n_columns), beyond a linear mode and the fixed columns.

    Orthogonal to the linear mode of the pole, its slope by the pole, and the fixed columns.
    """
    constant = np.column_stack([*modal_coordinate(data.responses(pole), l_r), *data.slopes(pole, l_r)])
    constant = orthonormal_basis(normalised_columns(np.hstack([constant, data.fixed])), RIVALS.collinear)
    columns = normalised_columns(columns)
    return orthonormal_basis(columns - constant @ (constant.T @ columns), RIVALS.significant)


def basis_of_others(weight: np.ndarray, phi: Floats, tangents: Pair, a: np.ndarray) -> Floats:
    """Orthonormal columns of one output spanned by the other modes and, to first order, by changes of their poles.

    Args:
        weight: (n_rows, 1) inverse relative noise.
        phi: (n_rows, n_columns) columns of the other modes.
        tangents: real and imaginary parts, (n_rows, n_tangents) each.
        a: (n_tangents,) amplitude of each tangent's mode at the output.
    """
    real, imaginary = tangents
    columns = [a.real * real - a.imag * imaginary, -a.imag * real - a.real * imaginary]
    return orthonormal_basis(normalised_columns(weight * np.hstack([phi, *columns])), RIVALS.collinear)


def projected_residual(y: Floats, x: Floats) -> Pair:
    """Residual of an output (n_rows,) with the shape of a motion projected out, and its Jacobian (Kaufman 1975).

    Args:
        y: (n_rows,) of the output.
        x: (n_rows, 2 (1 + n_unknowns)) real parts of the motion and of its slopes by the unknowns, then imaginary ones.
    """
    n = x.shape[1] // 2
    q, r = np.linalg.qr(x[:, [0, n]])
    in_motion = q.T @ y
    a, b = np.linalg.lstsq(r, in_motion, rcond=1e-12)[0]
    tangents = a * x[:, 1:n] + b * x[:, n + 1 :]
    return y - q @ in_motion, -(tangents - q @ (q.T @ tangents))


def nearest_pole(data: Measurement, motion: np.ndarray, pole: complex, l_r: np.ndarray) -> complex:
    """Pole of the linear mode, of given participation factors, nearest to a motion (n_rows,) in least squares."""
    rate, best, step, smallest = abs(pole.real), pole, 0j, np.inf
    for _ in range(RIVALS.most_poles):
        trial = best + step
        z = np.column_stack(modal_coordinate(data.responses(trial), l_r))
        size = np.maximum(np.linalg.norm(z, axis=0), 1e-300)
        p, q = np.linalg.lstsq(z / size, motion, rcond=None)[0] / size
        squares = float(((motion - z @ np.array([p, q])) ** 2).sum())
        if squares < smallest:
            best, smallest = complex(trial), squares
            both = np.hstack([z, rate * np.column_stack(data.slopes(trial, l_r))])
            size = np.maximum(np.linalg.norm(both, axis=0), 1e-300)
            p, q, u, v = np.linalg.lstsq(both / size, motion, rcond=None)[0] / size
            step = rate * (u - 1j * v) / (p - 1j * q if abs(p - 1j * q) > 0 else 1e-300)
            step /= max(1.0, abs(step) / rate)
        else:
            step *= 0.25
        step = min(step.real, -0.5 * best.real) + 1j * step.imag  # keeps the pole stable
        if abs(step) < RIVALS.same_pole * rate:
            break
    return best
