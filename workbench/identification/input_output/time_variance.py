"""Modes that change within a record.

A mode that remembers little of the record feels its pole as it is at the time: where λ(t) = λ + δ (t - T/2) / T,
z(t) moves by δ (t - T/2) / T ∂z/∂λ to first order. Regressed on that, beside all that a constant model can follow, what
the model leaves tells δ of every mode, with its standard error.

A change far above the noise is not small to first order, nor always even with time, and other modes stand for it. With
z' = (λ + α t + κ |z|²) z + l u, its motion is the series of Volterra in α and κ, of which each term drives the next,

    δz' = λ δz + t z,    λ δz + |z|² z,    then λ δ²z + t δz,    λ δ²z + |z|² δz,    λ δ²z + 2 Re(z* δz) z,    ...;

the modes are searched beside these columns up to the third order.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from workbench.arrays import Floats, scaled_inverse
from workbench.identification.input_output.changing_response import in_place_of
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import (
    Fit,
    Measurement,
    added_misfit,
    columns,
    only,
    settled,
)
from workbench.identification.input_output.model_order import statistic_of, statistic_of_each
from workbench.identification.input_output.rivals import in_place_of_clusters, independent, of_unit_length
from workbench.identification.signal.searches import SELECTION, Budget
from workbench.structure.modes import mac
from workbench.structure.printed import mode_text


@dataclass(frozen=True)
class ChangingSettings:
    """Constants of the search for modes that change within a record."""

    sure: float = 5.0  # standard errors that a change must have
    near: float = 3.0  # half-power bandwidths apart, of modes that may be one
    alike: float = 0.9  # modal assurance of such modes
    instead: float = 0.5  # of what a second mode explains that a change of the first must explain in its place
    matters: float = 0.1  # of the half-power bandwidth: a smaller change harms no model
    reach: float = 0.15  # of the frequency of a mode, within which another may stand for its change
    faint: float = 0.2  # of its statistic, likewise
    collinear: float = 1e-4  # singular value over which columns of unit length count
    faded: float = 4.0  # time constants of a mode that a record must hold: of fewer, the change is no small one


CHANGING = ChangingSettings()
IS_MEAN = "its figures are means over the record: identify shorter parts, or each level by itself"


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
    real, imaginary = (data.modulated(np.column_stack([s[k] for s in slopes]), data.time) for k in (0, 1))
    basis = np.hstack([phi, t])
    basis = basis / np.maximum(np.linalg.norm(basis, axis=0), 1e-300)
    products, along = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
    each = zip(fit.amplitudes, fit.noise, fit.residual.T, strict=True)
    alike = np.linalg.qr(basis)[0] if data.weights is None else None
    for j, (a, noise, left) in enumerate(each):
        weight = 1.0 if data.weights is None else data.weights[:, j : j + 1]
        q = np.linalg.qr(weight * basis)[0] if alike is None else alike
        moved = weight * np.hstack([a.real * real - a.imag * imaginary, -a.real * imaginary - a.imag * real])
        moved = (moved - q @ (q.T @ moved)) / noise
        products += moved.T @ moved
        along += moved.T @ (left / noise)
    inverse = scaled_inverse(products)
    change, deviation = inverse @ along, np.sqrt(np.diag(inverse))
    omega, span = np.abs(poles), 2.0 * np.pi / data.resolution
    moving, error = np.abs(change[n:]), deviation[n:]
    sure = (moving > CHANGING.sure * error) & (moving > CHANGING.matters * np.abs(poles.real))
    sure &= -poles.real * span > CHANGING.faded
    return Change(change[n:] / omega, error / omega, sure)


def joined(data: KnownInputs, fit: Fit, budget: Budget) -> Fit:
    """The fit with one mode for two that are alike, where a change of the one within the record explains the other.

    Of one input and one output all are alike: there rivals were compared already (`beside_changing`).
    """
    if fit.noise.size * data.n_inputs == 1:
        return fit

    def statistic(one: Fit, at: int) -> float:
        change = changes_in_time(data, one)
        return float((change.frequency[at] / change.deviation[at]) ** 2) if change.sure[at] else -np.inf

    return one_for_two(data, fit, budget, statistic, "check of modes that change within the record")[0]


def one_for_two(
    data: Measurement, fit: Fit, budget: Budget, change: Callable[[Fit, int], float], check: str
) -> tuple[Fit, np.ndarray]:
    """The fit with one mode for two that are alike, where a change of the one explains what the other does.

    Args:
        change: χ² of the change of a mode of a fit, by its index; -inf where it does not count.
        check: what this check is called where the time is up.

    Returns:
        The fit, and which modes of the first are left in it.
    """
    kept = np.arange(fit.poles.size)
    for pair in _pairs_alike(fit):
        if budget.spent(check):
            break
        weak, strong = sorted(pair, key=lambda r: statistic_of(fit, r))
        left = np.delete(kept, weak)
        one = settled(data, only(data, fit, left), budget=budget)
        if change(one, int(np.searchsorted(left, strong))) > CHANGING.instead * added_misfit(one, fit, one.noise):
            fewer, which = one_for_two(data, one, budget, change, check)
            return fewer, left[which]
    return fit, kept


def beside_changing(data: KnownInputs, fit: Fit, limit: float, budget: Budget) -> tuple[KnownInputs, Fit] | None:
    """The records with what changing modes move as further columns, and the fit without the modes that stood for it.

    A change that is not small makes many modes beside one. Where they go, and the one is found to change, its motion
    follows the change with time or amplitude. None where no mode is so.
    """
    if fit.noise.size * data.n_inputs == 1:
        return _beside_rivals(data, fit, limit, budget)
    strength = statistic_of_each(fit)
    participation = fit.participation[:, : data.n_inputs].T
    alike = mac(fit.amplitudes, fit.amplitudes) * mac(participation, participation) > CHANGING.alike
    beside: list[Floats] = []
    changing: list[complex] = []
    out = np.zeros(fit.poles.size, bool)
    for r in np.argsort(-strength):
        weak = strength < CHANGING.faint * strength[r]
        near = np.abs(fit.poles.imag - fit.poles.imag[r]) < CHANGING.reach * np.abs(fit.poles.imag[r])
        others = np.flatnonzero(weak & near & alike[r] & ~out)
        if out[r] or not others.size or budget.spent("check of modes that change within the record"):
            continue
        kept = np.delete(np.arange(fit.poles.size), others)
        one = settled(data, only(data, fit, kept), SELECTION.few_steps, budget)
        at = int(np.searchsorted(kept, r))
        moved = _motion(data, one.poles[at], one.participation[at])
        worth = added_misfit(one, fit, fit.noise)
        phi = columns(data, one.poles, one.participation)[0]
        if _explained(data, one, phi, moved, fit.noise) > CHANGING.instead * worth:
            beside.append(moved)
            changing.append(complex(one.poles[at]))
            out[others] = True
    if not beside:
        return None
    data = data.with_columns(independent(np.hstack(beside), CHANGING.collinear), tuple(changing))
    return data, only(data, fit, ~out)


def _beside_rivals(data: KnownInputs, fit: Fit, limit: float, budget: Budget) -> tuple[KnownInputs, Fit] | None:
    """`beside_changing` of one input and one output, where every two near modes are alike: the likelier model stays."""
    alike = np.ones((fit.poles.size, fit.poles.size), bool)
    return in_place_of_clusters(
        data,
        fit,
        alike,
        lambda data, cluster: in_place_of(data, fit, cluster, limit),
        lambda data, one: data.with_columns(one.moved, (one.pole,)),
        budget,
    )


def _motion(data: KnownInputs, pole: complex, participation: np.ndarray) -> Floats:
    """Orthonormal columns (n_rows, n_columns) that a mode moves along where it changes, beside those there are."""
    moved = data.rows_of([_series(z, pole, data.dt) for z in data.modal_coordinate(pole, participation)])
    moved = of_unit_length(moved)
    q = np.linalg.qr(data.fixed)[0]
    return independent(moved - q @ (q.T @ moved), CHANGING.collinear)


def _series(z: np.ndarray, pole: complex, dt: float) -> Floats:
    """The terms of the series of Volterra to the third order, real and imaginary parts, (n_samples, n_columns).

    Args:
        z: (n_samples,) of the constant mode.
    """
    mu, time = np.exp(pole * dt), np.linspace(-0.5, 0.5, z.size)
    z = z / max(float(np.abs(z).max()), 1e-300)
    power = np.abs(z) ** 2
    about = power - power.mean()  # the mean is the pole's own

    def driven(force: np.ndarray) -> np.ndarray:
        """x' = λ x + force by the trapezoidal rule, in units of the mode's time constant."""
        later = 0.5 * abs(pole.real) * dt * (mu * force[:-1] + force[1:])
        return np.asarray(lfilter([1.0], [1.0, -mu], np.r_[0.0, later]))

    def turned(x: np.ndarray) -> np.ndarray:
        """What the change of |z|² by a motion x drives."""
        return driven(2.0 * np.real(z.conj() * x) * z)

    first = driven(about * z)
    second = [driven(about * first), turned(first), turned(1j * first)]
    third = [f(x) for x in second for f in (lambda x: driven(about * x), turned)]
    by_time = driven(time * z)
    by_time_twice = driven(time * by_time)
    found = [by_time, by_time_twice, driven(time * by_time_twice), first, *second, *third, driven(time * first),
             driven((power**2 - (power**2).mean()) * z)]  # fmt: skip
    return np.column_stack([part for x in found for part in (x.real, x.imag)])


def _explained(data: KnownInputs, fit: Fit, phi: Floats, further: Floats, noise: Floats) -> float:
    """χ² by which further columns lower the misfit of a fit with columns Φ."""
    found = 0.0
    for j in range(noise.size):
        weight = 1.0 if data.weights is None else data.weights[:, j : j + 1]
        q = np.linalg.qr(weight * np.hstack([phi, further]))[0]
        found += float(((q.T @ fit.residual[:, j]) ** 2).sum() / noise[j] ** 2)
    return found


def _pairs_alike(fit: Fit) -> list[tuple[int, int]]:
    """Modes near each other with shapes alike, the nearest first."""
    poles, alike = fit.poles, mac(fit.amplitudes, fit.amplitudes) > CHANGING.alike
    apart = np.abs(np.subtract.outer(poles.imag, poles.imag))
    near = apart < CHANGING.near * np.add.outer(np.abs(poles.real), np.abs(poles.real))
    both = zip(*np.nonzero(np.triu(alike & near, 1)), strict=True)
    return sorted(((int(r), int(s)) for r, s in both), key=lambda pair: apart[pair])


def named_near(fit: Fit, poles: Iterable[complex]) -> dict[int, str]:
    """The modes of a fit nearest to some poles, in their order, by index: mode 2 (4.1 Hz)."""
    nearest = sorted({int(np.argmin(np.abs(fit.poles - pole))) for pole in poles})
    return {r: mode_text(r, abs(fit.poles[r]) / (2.0 * np.pi)) for r in nearest}


def change_remarks(
    data: KnownInputs, fit: Fit, changing: tuple[complex, ...] = (), named: tuple[complex, ...] = ()
) -> tuple[tuple[str, ...], tuple[complex, ...]]:
    """A remark on the modes that change within a record: evenly with time, or, near the poles named, in another way.

    Args:
        changing: poles of modes that were found to change.
        named: those of the fit that there is a remark on already.

    Returns:
        The remarks, and the poles of the modes that there is a remark on.
    """
    if not fit.poles.size:
        return (), ()
    change = changes_in_time(data, fit)
    names = named_near(fit, fit.poles)
    sure = change.sure & (np.abs(change.frequency) < CHANGING.reach) & ~np.isin(fit.poles, named)
    words = [f"{names[r]} by about {100 * change.frequency[r]:+.1g} %" for r in np.flatnonzero(sure).tolist()]
    others = [r for r in named_near(fit, changing) if not sure[r] and fit.poles[r] not in named]
    remarks = []
    if words:
        evenly = f"frequencies change within the record, from its beginning to its end: {'; '.join(words)}; {IS_MEAN}"
        remarks.append(evenly)
    if others:
        which = ", ".join(names[r] for r in others)
        remarks.append(f"modes change within the record, perhaps with amplitude: {which}; {IS_MEAN}")
    return tuple(remarks), (*named, *fit.poles[[*np.flatnonzero(sure), *others]].tolist())
