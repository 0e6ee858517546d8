"""One mode that changes, the rival of several linear ones: what records and transfer functions share of it.

The motion of the one is no linear mode's, but what it moves along beside one is a few fixed columns. Where it is
likelier than a cluster of near linear modes, these go, and the columns stay.
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
    """Constants of the search for one mode that changes in place of several linear ones."""

    near: float = 6.0  # half-power bandwidths apart, of modes that may be one
    most_clusters: int = 3  # about a mode: all that are near it, then without the farthest
    about: float = 12.0  # half-power half-widths beyond the modes, where they are compared
    fewest: int = 25  # lines beyond the modes, likewise
    slowest: float = 0.05  # of the distance of lines: no decay is slower
    slightly: float = 1e-5  # of the decay rate: step of differences
    most_poles: int = 20  # steps towards the constant mode nearest to one that changes
    same_pole: float = 1e-6  # of the rate of decay: a smaller step ends them
    hardly: float = 1e-9  # singular value under which columns of unit length are no more than round-off
    moves: float = 1e-4  # singular value over which what a mode that changes moves along counts


RIVALS = RivalSettings()
Data = TypeVar("Data", bound=Measurement)


class Motion(Protocol):
    """One mode that changes.

    Attributes:
        moved: (n_rows, n_columns) what it moves along, beside a linear mode.
        pole: of that linear mode, rad/s.
    """

    @property
    def moved(self) -> Floats: ...

    @property
    def pole(self) -> complex: ...


One = TypeVar("One", bound=Motion)


def in_place_of_clusters(
    data: Data,
    fit: Fit,
    alike: np.ndarray,
    one_for: Callable[[Data, np.ndarray], One | None],
    beside: Callable[[Data, One], Data],
    budget: Budget,
) -> tuple[Data, Fit] | None:
    """The measurement with what modes that change move as further columns, and the fit with one mode for each of them.

    Args:
        data: what the fit of linear modes is of.
        fit: of linear modes.
        alike: (n_modes, n_modes) which may be one, as far as their shapes tell.
        one_for: the one in place of a cluster of modes, the strongest first; None where these are likelier.
        beside: the measurement with what that one moves.
        budget: of time.

    Returns:
        None where linear modes are likelier everywhere.
    """
    strength = statistic_of_each(fit)
    rates = np.maximum(-fit.poles.real, 0.5 * data.resolution)
    apart = np.abs(np.subtract.outer(fit.poles.imag, fit.poles.imag))
    near = alike & (apart < RIVALS.near * np.add.outer(rates, rates))
    poles, out = fit.poles.copy(), np.zeros(fit.poles.size, bool)
    for r in np.argsort(-strength):
        others = np.flatnonzero(near[r] & (strength < strength[r]) & ~out & ~out[r])
        others = others[np.argsort(apart[r, others])]
        for k in range(others.size, max(others.size - RIVALS.most_clusters, 0), -1):
            if budget.spent("check of modes that change"):
                break
            one = one_for(data, np.r_[r, others[:k]])
            if one is not None:
                data = beside(data, one)
                out[others[:k]], poles[r] = True, one.pole
                break
    return (data, projected(data, poles[~out], fit.participation[~out])) if out.any() else None


def independent(rows: np.ndarray, least: float) -> Floats:
    """Orthonormal columns that span those of a matrix, but for what singular values of at most `least` stand for."""
    u, s, _ = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(u[:, s > least])


def of_unit_length(rows: np.ndarray) -> Floats:
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300))


def beside_constant(data: Measurement, moved: np.ndarray, pole: complex, l_r: np.ndarray) -> Floats:
    """Orthonormal columns that a mode moves along, (n_rows, n_columns), beside a constant one and what is fixed."""
    constant = np.column_stack([*modal_coordinate(data.responses(pole), l_r), *data.slopes(pole, l_r)])
    constant = independent(of_unit_length(np.hstack([constant, data.fixed])), RIVALS.hardly)
    moved = of_unit_length(moved)
    return independent(moved - constant @ (constant.T @ moved), RIVALS.moves)


def taken_by_others(weight: np.ndarray, phi: Floats, tangents: Pair, a: np.ndarray) -> Floats:
    """Orthonormal columns of an output, of modes beside those in question, whose poles may move to first order.

    Args:
        weight: (n_rows, 1) inverse relative noise.
        phi: (n_rows, n_columns) of the modes.
        tangents: real and imaginary parts, (n_rows, n_tangents) each.
        a: (n_tangents,) what the output measures of each.
    """
    real, imaginary = tangents
    moved = [a.real * real - a.imag * imaginary, -a.imag * real - a.real * imaginary]
    return independent(of_unit_length(weight * np.hstack([phi, *moved])), RIVALS.hardly)


def left_by_motion(y: Floats, x: Floats) -> Pair:
    """What a motion leaves of an output, (n_rows,), its shape projected out (Kaufman 1975), and its slopes.

    Args:
        y: (n_rows,) of the output.
        x: (n_rows, 2 (1 + n_unknowns)) real parts of the motion and of its slopes by the unknowns, then imaginary ones.
    """
    n = x.shape[1] // 2
    q, r = np.linalg.qr(x[:, [0, n]])
    seen = q.T @ y
    a, b = np.linalg.lstsq(r, seen, rcond=1e-12)[0]
    moved = a * x[:, 1:n] + b * x[:, n + 1 :]
    return y - q @ seen, -(moved - q @ (q.T @ moved))


def nearest_pole(data: Measurement, motion: np.ndarray, pole: complex, l_r: np.ndarray) -> complex:
    """Of the constant mode of given participation whose rows are nearest to those of a motion, (n_rows,)."""
    rate, best, step, least = abs(pole.real), pole, 0j, np.inf
    for _ in range(RIVALS.most_poles):
        trial = best + step
        z = np.column_stack(modal_coordinate(data.responses(trial), l_r))
        size = np.maximum(np.linalg.norm(z, axis=0), 1e-300)
        p, q = np.linalg.lstsq(z / size, motion, rcond=None)[0] / size
        left = float(((motion - z @ np.array([p, q])) ** 2).sum())
        if left < least:
            best, least = complex(trial), left
            both = np.hstack([z, rate * np.column_stack(data.slopes(trial, l_r))])
            size = np.maximum(np.linalg.norm(both, axis=0), 1e-300)
            p, q, u, v = np.linalg.lstsq(both / size, motion, rcond=None)[0] / size
            step = rate * (u - 1j * v) / (p - 1j * q if abs(p - 1j * q) > 0 else 1e-300)
            step /= max(1.0, abs(step) / rate)
        else:
            step *= 0.25
        step = min(step.real, -0.5 * best.real) + 1j * step.imag  # it stays a decay
        if abs(step) < RIVALS.same_pole * rate:
            break
    return best
