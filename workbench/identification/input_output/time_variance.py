"""Modes that change within a record: detection of a linear drift of the frequency, and expansion of larger changes.

A mode whose decay is short against the record has, at each time, the response of its pole at that time: where
λ(t) = λ + δ (t - T/2) / T, z(t) changes by δ (t - T/2) / T ∂z/∂λ to first order. The residual, regressed on this column
beside all columns and tangents of the constant model, gives δ of every mode with its standard error.

A change far above the noise is not small to first order, nor always linear in time, and several linear modes may be
fitted to it. With z' = (λ + α t + κ |z|²) z + l u, the motion is a Volterra series in α and κ, each of whose terms
drives the next,

    δz' = λ δz + t z,    λ δz + |z|² z,    then λ δ²z + t δz,    λ δ²z + |z|² δz,    λ δ²z + 2 Re(z* δz) z,    ...;

the modes are fitted with its terms up to the third order as fixed columns.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from workbench.arrays import Floats, scaled_inverse
from workbench.identification.input_output.changing_response import CHANGE_CHECK, in_place_of
from workbench.identification.input_output.competing_models import COMPETING, in_place_of_clusters, orthonormal_basis
from workbench.identification.input_output.fit_errors import statistic_of, statistic_of_each
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import (
    Fit,
    added_misfit,
    columns,
    normalised_columns,
    only,
    products_of,
    regressors,
    row_weights,
    settled,
)
from workbench.identification.signal.searches import SELECTION, TimeLimit
from workbench.structure.modes import mac
from workbench.structure.printed import mode_text


@dataclass(frozen=True)
class ChangingSettings:
    """Constants of the search for modes that change within a record."""

    standard_errors: float = 5.0  # that a change must exceed
    max_distance: float = 3.0  # half-power bandwidths: two modes closer than this may be one changing mode
    # share of the χ² of the second mode that a change of the first must explain to replace it
    min_explained_share: float = 0.5
    min_change: float = 0.1  # of the half-power bandwidth: a smaller change is negligible
    # of the frequency of a mode, within which weaker modes may model its change or distortion
    frequency_range: float = 0.15
    faint_ratio: float = 0.2  # of its statistic, below which a mode is such a weaker one
    min_singular_value: float = 1e-4  # of columns of unit length: above, they count
    min_time_constants: float = 4.0  # of a mode in the record, above which the first-order formula holds


CHANGING = ChangingSettings()
IS_MEAN = "its parameters are means over the record: identify shorter parts, or each level by itself"


class Change(NamedTuple):
    """Change of each frequency from the beginning of a record to its end, relative, its standard error, and whether it
    is significant and not negligible, (n_modes,) each."""

    frequency: Floats
    deviation: Floats
    sure: np.ndarray


def changes_in_time(data: KnownInputs, fit: Fit) -> Change:
    """The change of every mode over the records, to first order about a fit of constant modes."""
    n, poles = fit.poles.size, fit.poles
    x = regressors(data, poles, fit.participation)
    x = np.hstack([x, *slopes_in_time(data, fit, x)])
    known = slice(0, x.shape[1] - 2 * n)
    normal, right_side = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
    unweighted = products_of(x, np.ones((1, 1)), fit.residual)[0] if data.weights is None else None
    for j, (a, noise, residual) in enumerate(zip(fit.amplitudes, fit.noise, fit.residual.T, strict=True)):
        weight = row_weights(data)[:, j : j + 1]
        products = products_of(x, weight, fit.residual)[0] if unweighted is None else unweighted
        real, imaginary = np.diag(a.real), np.diag(a.imag)
        along = np.vstack([np.zeros((known.stop, 2 * n)), np.block([[real, -imaginary], [-imaginary, -real]])]) / noise
        along[known] = -scaled_inverse(products[known, known]) @ products[known] @ along  # beside all known columns
        normal += along.T @ products @ along
        right_side += along.T @ (x.T @ (weight[:, 0] * residual / noise))
    inverse = scaled_inverse(normal)
    change, deviation = inverse @ right_side, np.sqrt(np.diag(inverse))
    omega, span = np.abs(poles), 2.0 * np.pi / data.resolution
    size, error = np.abs(change[n:]), deviation[n:]
    sure = (size > CHANGING.standard_errors * error) & (size > CHANGING.min_change * np.abs(poles.real))
    sure &= -poles.real * span > CHANGING.min_time_constants
    return Change(change[n:] / omega, error / omega, sure)


def slopes_in_time(data: KnownInputs, fit: Fit, x: Floats) -> tuple[Floats, Floats]:
    """Real and imaginary part of (t - T/2) / T ∂z/∂λ of each mode, (n_rows, n_modes) each, from the `regressors` x."""
    n, q = fit.poles.size, 1 + fit.participation.shape[1]
    real, imaginary = (data.times_time(x[:, part * n * q : (part + 1) * n * q : q]) for part in (0, 1))
    return real, imaginary


def joined(data: KnownInputs, fit: Fit, time_limit: TimeLimit) -> Fit:
    """The fit with one mode in place of two alike, where a change of the one within the record explains the other.

    With one input and one output the competing models were compared already (`beside_changing`).
    """
    if fit.noise.size * data.n_inputs == 1:
        return fit
    for pair in _pairs_alike(fit):
        if time_limit.spent(CHANGE_CHECK):
            break
        weak, strong = sorted(pair, key=lambda r: statistic_of(fit, r))
        one = settled(data, only(data, fit, np.delete(np.arange(fit.poles.size), weak)), time_limit=time_limit)
        change, at = changes_in_time(data, one), strong - (weak < strong)
        statistic = (change.frequency[at] / change.deviation[at]) ** 2
        if change.sure[at] and statistic > CHANGING.min_explained_share * added_misfit(one, fit, one.noise):
            return joined(data, one, time_limit)
    return fit


def beside_changing(
    data: KnownInputs, fit: Fit, limit: float, time_limit: TimeLimit, linear: list[np.ndarray]
) -> tuple[KnownInputs, Fit] | None:
    """The records with the columns of changing modes, and the fit without the modes that modelled their change.

    A large change is fitted by several linear modes. Where the Volterra terms of one mode explain what the weaker modes
    about it explain, these are removed and the terms become fixed columns. None where no mode is so. For `linear` see
    `in_place_of`.
    """
    if fit.noise.size * data.n_inputs == 1:
        return _with_competing_models(data, fit, limit, time_limit, linear)
    strength = statistic_of_each(fit)
    participation = fit.participation[:, : data.n_inputs].T
    alike = mac(fit.amplitudes, fit.amplitudes) * mac(participation, participation) > COMPETING.min_mac
    motions, changing, removed = list[Floats](), list[complex](), np.zeros(fit.poles.size, bool)
    for r in np.argsort(-strength):
        weak = strength < CHANGING.faint_ratio * strength[r]
        close = np.abs(fit.poles.imag - fit.poles.imag[r]) < CHANGING.frequency_range * np.abs(fit.poles.imag[r])
        others = np.flatnonzero(weak & close & alike[r] & ~removed)
        if removed[r] or not others.size or time_limit.spent(CHANGE_CHECK):
            continue
        kept = np.delete(np.arange(fit.poles.size), others)
        one = settled(data, only(data, fit, kept), SELECTION.trial_steps, time_limit)
        at = int(np.searchsorted(kept, r))
        motion = _motion(data, one.poles[at], one.participation[at])
        decrease = added_misfit(one, fit, fit.noise)
        phi = columns(data, one.poles, one.participation)[0]
        if _explained(data, one, phi, motion, fit.noise) > CHANGING.min_explained_share * decrease:
            motions.append(motion)
            changing.append(complex(one.poles[at]))
            removed[others] = True
    if not motions:
        return None
    data = data.with_columns(orthonormal_basis(np.hstack(motions), CHANGING.min_singular_value), tuple(changing))
    return data, only(data, fit, ~removed)


def _with_competing_models(
    data: KnownInputs, fit: Fit, limit: float, time_limit: TimeLimit, linear: list[np.ndarray]
) -> tuple[KnownInputs, Fit] | None:
    """`beside_changing` for one input and one output, where shapes tell nothing: the likelier model is kept."""
    omega = fit.poles.imag
    close = np.abs(np.subtract.outer(omega, omega)) < CHANGING.frequency_range * omega[:, None]
    rows_of = cache(lambda data: regressors(data, fit.poles, fit.participation))

    def alternative_of(data: KnownInputs, cluster: np.ndarray) -> tuple[KnownInputs, complex] | None:
        return in_place_of(data, fit, cluster, rows_of(data), limit, time_limit, linear)

    return in_place_of_clusters(data, fit, close, alternative_of, time_limit)


def _motion(data: KnownInputs, pole: complex, participation: np.ndarray) -> Floats:
    """Orthonormal columns (n_rows, n_columns) of the Volterra terms of a mode, orthogonal to the fixed columns."""
    terms = data.rows_of([_series(z, pole, data.dt) for z in data.modal_coordinate(pole, participation)])
    terms = normalised_columns(terms)
    q = np.linalg.qr(data.fixed)[0]
    return orthonormal_basis(terms - q @ (q.T @ terms), CHANGING.min_singular_value)


def _series(z: np.ndarray, pole: complex, dt: float) -> Floats:
    """Volterra terms of a mode up to the third order, real and imaginary parts, (n_samples, n_columns), from z
    (n_samples,) of the constant mode."""
    mu, time = np.exp(pole * dt), np.linspace(-0.5, 0.5, z.size)
    z = z / max(float(np.abs(z).max()), 1e-300)
    power = np.abs(z) ** 2
    centred = power - power.mean()  # the mean shifts the pole alone

    def driven(force: np.ndarray) -> np.ndarray:
        """x' = λ x + force by the trapezoidal rule, in units of the mode's time constant."""
        forcing = 0.5 * abs(pole.real) * dt * (mu * force[:-1] + force[1:])
        return np.asarray(lfilter([1.0], [1.0, -mu], np.r_[0.0, forcing]))

    def feedback(x: np.ndarray) -> np.ndarray:
        """Response to the change of |z|² by a motion x."""
        return driven(2.0 * np.real(z.conj() * x) * z)

    first = driven(centred * z)
    second = [driven(centred * first), feedback(first), feedback(1j * first)]
    third = [f(x) for x in second for f in (lambda x: driven(centred * x), feedback)]
    by_time = driven(time * z)
    by_time_twice = driven(time * by_time)
    terms = [by_time, by_time_twice, driven(time * by_time_twice), first, *second, *third, driven(time * first),
             driven((power**2 - (power**2).mean()) * z)]  # fmt: skip
    return np.column_stack([part for x in terms for part in (x.real, x.imag)])


def _explained(data: KnownInputs, fit: Fit, phi: Floats, further: Floats, noise: Floats) -> float:
    """Decrease of χ² of a fit with columns Φ by further columns."""
    decrease = 0.0
    for j in range(noise.size):
        weight = row_weights(data)[:, j : j + 1]
        q = np.linalg.qr(weight * np.hstack([phi, further]))[0]
        decrease += float(((q.T @ fit.residual[:, j]) ** 2).sum() / noise[j] ** 2)
    return decrease


def _pairs_alike(fit: Fit) -> list[tuple[int, int]]:
    """Pairs of close modes with similar shapes, the closest first."""
    poles, alike = fit.poles, mac(fit.amplitudes, fit.amplitudes) > COMPETING.min_mac
    distance = np.abs(np.subtract.outer(poles.imag, poles.imag))
    close = distance < CHANGING.max_distance * np.add.outer(np.abs(poles.real), np.abs(poles.real))
    pairs = zip(*np.nonzero(np.triu(alike & close, 1)), strict=True)
    return sorted(((int(r), int(s)) for r, s in pairs), key=lambda pair: distance[pair])


def named_near(fit: Fit, poles: Iterable[complex]) -> dict[int, str]:
    """The modes of a fit nearest to some poles, named by index: mode 2 (4.1 Hz)."""
    nearest = sorted({int(np.argmin(np.abs(fit.poles - pole))) for pole in poles})
    return {r: mode_text(r, abs(fit.poles[r]) / (2.0 * np.pi)) for r in nearest}


def change_remarks(
    data: KnownInputs, fit: Fit, changing: tuple[complex, ...] = (), named: tuple[complex, ...] = ()
) -> tuple[tuple[str, ...], tuple[complex, ...]]:
    """Remarks on the modes that change within a record, linearly with time, or otherwise at poles `changing`, and the
    poles of all modes that a remark names, those `named` already among them."""
    if not fit.poles.size:
        return (), ()
    change = changes_in_time(data, fit)
    names = named_near(fit, fit.poles)
    sure = change.sure & (np.abs(change.frequency) < CHANGING.frequency_range) & ~np.isin(fit.poles, named)
    linear = [f"{names[r]} by about {100 * change.frequency[r]:+.1g} %" for r in np.flatnonzero(sure).tolist()]
    others = [r for r in named_near(fit, changing) if not sure[r] and fit.poles[r] not in named]
    each = (
        ("frequencies change within the record, from its beginning to its end", "; ".join(linear)),
        ("modes change within the record, perhaps with amplitude", ", ".join(names[r] for r in others)),
    )
    remarks = tuple(f"{what}: {which}; {IS_MEAN}" for what, which in each if which)
    return remarks, (*named, *fit.poles[[*np.flatnonzero(sure), *others]].tolist())
