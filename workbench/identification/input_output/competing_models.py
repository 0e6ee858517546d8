"""A time- or amplitude-dependent mode against several close linear modes, in records and in FRFs.

To first order, its motion beyond that of a linear mode spans a few columns. Where it is likelier than a cluster of
close linear modes, these are removed and the columns stay as fixed columns of the measurement.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import TypeVar

import numpy as np

from workbench.arrays import Floats
from workbench.identification.input_output.fit_errors import statistic_of_each
from workbench.identification.input_output.modal_fit import (
    MANY_ROWS,
    Fit,
    Measurement,
    changes_of,
    combinations,
    modal_coordinate,
    normalised_columns,
    orthonormal,
    projected,
)
from workbench.identification.signal.searches import TimeLimit
from workbench.threads import at_once


@dataclass(frozen=True)
class CompetingModelSettings:
    """Constants of the comparison of one changing mode with several linear ones."""

    max_distance: float = 6.0  # half-power bandwidths: linear modes closer than this may be one changing mode
    max_clusters: int = 3  # tried per mode: all modes close to it, then without the farthest
    band_margin: float = 12.0  # half-power half-widths beyond the modes, in which the models are compared
    min_margin_lines: int = 25  # lines beyond the modes, likewise at least
    min_rate: float = 0.05  # of the distance of lines: smallest decay rate
    min_mac: float = 0.9  # MAC of such modes
    max_pole_steps: int = 20  # steps to the linear mode nearest to a changing one
    step_tolerance: float = 1e-6  # of the decay rate: a smaller step ends them
    min_singular_value: float = 1e-9  # of columns of unit length: below, it is rounding error
    # of the largest singular value: the products of columns give those above it to four digits
    min_singular_ratio: float = 1e-6
    min_change_value: float = 1e-4  # singular value of the columns of a changing mode: smaller ones do not count


COMPETING = CompetingModelSettings()
Data = TypeVar("Data", bound=Measurement)


def in_place_of_clusters(
    data: Data,
    fit: Fit,
    alike: np.ndarray,
    alternative_of: Callable[[Data, np.ndarray], tuple[Data, complex] | None],
    time_limit: TimeLimit,
) -> tuple[Data, Fit] | None:
    """The measurement with the columns of changing modes, and the fit with one mode for each cluster that one replaces.

    None where linear modes are likelier everywhere.

    Args:
        alike: (n_modes, n_modes) whether two modes may be one, by their shapes.
        alternative_of: the measurement with the columns of a changing mode in place of a cluster of modes, the
            strongest first, and the pole of the nearest linear mode, rad/s; None where the linear modes are likelier.
    """
    strength = statistic_of_each(fit)
    rates = np.maximum(-fit.poles.real, 0.5 * data.resolution)
    distance = np.abs(np.subtract.outer(fit.poles.imag, fit.poles.imag))
    close = alike & (distance < COMPETING.max_distance * np.add.outer(rates, rates))
    poles, removed, order = fit.poles.copy(), np.zeros(fit.poles.size, bool), np.argsort(-strength)

    def clusters(first: int) -> Iterator[tuple[int, np.ndarray]]:
        """Clusters to try, with the rank of the strongest mode of each, from a rank on."""
        for rank, r in enumerate(order[first:], first):
            others = np.flatnonzero(close[r] & (strength < strength[r]) & ~removed & ~removed[r])
            others = others[np.argsort(distance[r, others])]
            for k in range(others.size, max(others.size - COMPETING.max_clusters, 0), -1):
                yield rank, np.r_[r, others[:k]]

    tries = clusters(0)
    while (two := list(islice(tries, 2))) and not time_limit.spent("check of modes that change"):
        alternatives = at_once(partial(alternative_of, data), [cluster for _, cluster in two])
        for (rank, cluster), alternative in zip(two, alternatives, strict=True):
            if alternative is not None:
                data, poles[cluster[0]] = alternative
                removed[cluster[1:]] = True
                tries = clusters(rank + 1)
                break
    return (data, projected(data, poles[~removed], fit.participation[~removed])) if removed.any() else None


def orthonormal_basis(rows: np.ndarray, least: float) -> Floats:
    """Orthonormal basis of the columns of a matrix, of singular values above `least`.

    Of many rows by their products, in which singular values far below the largest are lost: these again by what is left
    without the others. Reflections take five times as long.
    """
    if len(rows) < MANY_ROWS:
        q, r = orthonormal(rows)
        u, s, _ = np.linalg.svd(r)
        return np.asarray(q @ u[:, s > least])
    basis = np.empty((len(rows), 0))
    while rows.shape[1]:
        squares, directions = np.linalg.eigh(rows.T @ rows)
        clear = squares > max(least**2, COMPETING.min_singular_ratio**2 * squares[-1])
        if not clear.any():
            break
        basis = np.hstack([basis, orthonormal(rows @ (directions[:, clear] / np.sqrt(squares[clear])))[0]])
        rows = rows @ directions[:, ~clear]
        rows -= basis @ (basis.T @ rows)
    return basis


def beyond_linear(data: Measurement, motions: np.ndarray, pole: complex, l_r: np.ndarray) -> tuple[Floats, complex]:
    """Orthonormal columns of a motion beyond the nearest linear mode, (n_rows, n_columns), and the pole of that mode.

    Orthogonal to that mode, its slope by the pole, and the fixed columns. Motions (n_rows, n_motions) are those of a
    changing mode, and its changes with the unknowns. The search begins at `pole`.
    """
    pole = _nearest_pole(data, motions[:, 0], pole, l_r)
    linear = np.column_stack([*modal_coordinate(data.responses(pole), l_r), *data.slopes(pole, l_r)])
    linear = orthonormal_basis(normalised_columns(np.hstack([linear, data.fixed])), COMPETING.min_singular_value)
    motions = normalised_columns(motions)
    return orthonormal_basis(motions - linear @ (linear.T @ motions), COMPETING.min_change_value), pole


def bases_with_changes(
    rows: Floats, fit: Fit, modes: np.ndarray, weights: Sequence[Floats], poles_only: bool = True
) -> list[Floats]:
    """Orthonormal columns of some modes, the fixed columns and first-order changes of the modes, one matrix per output.

    From those rows that count of the `regressors` of the fit, and the inverse relative noise (n_rows, 1) of each
    output. Only poles may change, or participation factors too.
    """
    n, of_mode = fit.poles.size, fit.participation.shape[1] + 1
    chosen = (of_mode * modes[:, None] + np.arange(of_mode)).ravel()
    real, imaginary, fixed = rows[:, chosen], rows[:, n * of_mode + chosen], rows[:, 2 * n * of_mode :]
    phi = np.hstack([real, imaginary, fixed]) @ combinations(fit.participation[modes], fixed.shape[1])
    step = of_mode if poles_only else 1
    bases = []
    for weight, a in zip(weights, np.repeat(fit.amplitudes[:, modes], of_mode // step, axis=1), strict=True):
        each = weight * np.hstack([phi, changes_of(a, (real[:, ::step], imaginary[:, ::step]))])
        bases.append(orthonormal_basis(normalised_columns(each), COMPETING.min_singular_value))
    return bases


def _nearest_pole(data: Measurement, motion: np.ndarray, pole: complex, l_r: np.ndarray) -> complex:
    """Pole of the linear mode, of given participation factors, nearest to a motion (n_rows,) in least squares."""
    rate, best, step, smallest = abs(pole.real), pole, 0j, np.inf
    for _ in range(COMPETING.max_pole_steps):
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
        if abs(step) < COMPETING.step_tolerance * rate:
            break
    return best
