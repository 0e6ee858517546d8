"""A time- or amplitude-dependent mode against several close linear modes in a peak of FRFs.

An FRF is the transform of a free decay. The decay of a mode that changes with time, with its amplitude, or between
averages, is

    h(t) = Re a e^{λt} m(t),     log m = Σ_k c_k t^k,     or  ∫ Σ_k λ_k r^p_k dt - λ t  on a backbone (`backbone`),
                                 or  m = e^{ct + dt³} sinh(wt) / wt: the mean over poles evenly from λ - w to λ + w.

m is smooth, so it is represented by a cubic spline, which is linear in its values at the knots and has an exact
transform. Linear modes have m = Σ_k a_k e^{(λ_k - λ)t}. Two linear modes have as many parameters as each law, so the
model of the higher likelihood is preferred. All are compared in the lines about the peak, with a parabola for the
residual of the other modes there.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline

from workbench.arrays import Floats
from workbench.identification.free_decay.backbone import BACKBONE, POWERS, backbone_integrals
from workbench.identification.input_output.competing_models import (
    COMPETING,
    bases_with_changes,
    beyond_linear,
    in_place_of_clusters,
)
from workbench.identification.input_output.modal_fit import Fit, regressors, row_weights
from workbench.identification.input_output.spectral_lines import Lines, rows_of_pair
from workbench.identification.signal.searches import CachedResidual, TimeLimit, diverged, projected_residual
from workbench.structure.modes import mac


@dataclass(frozen=True)
class ChangingDecaySettings:
    """Constants of the search for one changing mode in place of several linear ones."""

    polynomial_degree: int = 2  # for the residual of the other modes
    knots: int = 100  # of the spline in time
    duration: float = 8.0  # of a decay, in time constants
    max_evaluations: int = 25  # evaluations of a fit
    max_motion: float = 1e6  # |m| above which the motion is taken to diverge


DECAY = ChangingDecaySettings()


def beside_changing(lines: Lines, fit: Fit, limit: float, time_limit: TimeLimit) -> tuple[Lines, Fit] | None:
    """The lines with the columns of changing modes, and the fit with one mode for each of these; None where linear
    modes, of χ² threshold `limit`, are likelier at every peak."""
    shapes, participation = fit.amplitudes / fit.noise[:, None], fit.participation.T
    alike = mac(shapes, shapes) * mac(participation, participation) > COMPETING.min_mac
    within = (fit.poles.imag > lines.omega[0]) & (fit.poles.imag < lines.omega[-1])
    alternative_of = partial(_alternative_of, fit=fit, limit=limit)
    return in_place_of_clusters(lines, fit, alike & within & within[:, None], alternative_of, time_limit)


def _alternative_of(lines: Lines, cluster: np.ndarray, fit: Fit, limit: float) -> tuple[Lines, complex] | None:
    """`in_place_of_clusters`, for one cluster: the lines beside the changing mode, and its pole."""
    weighted_shape, poles = fit.amplitudes[:, cluster[0]] / fit.noise**2, fit.poles[cluster]
    strength = weighted_shape.conj() @ fit.amplitudes[:, cluster]
    rates = np.maximum(-poles.real, COMPETING.min_rate * lines.resolution)
    mean = complex(np.average(-rates + 1j * poles.imag, weights=np.abs(strength) ** 2 / rates))
    margin = max(COMPETING.band_margin * -mean.real, COMPETING.min_margin_lines * lines.resolution)
    near_peak = (lines.omega > poles.imag.min() - margin) & (lines.omega < poles.imag.max() + margin)
    peak = _Peak(lines.only(near_peak, DECAY.polynomial_degree), fit, cluster, mean)
    linear = peak.fitted(_linear, [np.r_[poles - mean, strength[1:] / strength[0] * -mean.real] / -mean.real])
    if linear is None:
        return None
    linear_decay = (strength * np.exp(np.outer(peak.decays.time, poles - mean))).sum(axis=1)
    for n_coefficients, law in LAWS:
        if n_coefficients > 2 * cluster.size - 1:
            break
        changing = peak.fitted(law, peak.starts(law, n_coefficients, linear_decay))
        # As in a free decay, two modes must be likelier than one by the threshold of a further mode.
        if changing is not None and changing[0] >= linear[0] - limit * (cluster.size - 1):
            return _beside(lines, peak.decays, changing[1])
    return None


def _beside(lines: Lines, decays: "_Decays", motions: np.ndarray) -> tuple[Lines, complex]:
    """The lines with the columns of the changing mode, and its pole, from m, and its changes with the unknowns,
    (n_knots, 1 + n_unknowns)."""
    l_r, time, m = decays.participation, decays.time, motions[:, 0]
    power = np.abs(m) ** 2 * np.exp(2.0 * decays.pole.real * time)
    frequency = np.gradient(np.unwrap(np.angle(m)), time)
    mean = float(np.average(frequency, weights=power))
    scatter = float(np.sqrt(np.average((frequency - mean) ** 2, weights=power)))
    motion_rows = np.hstack(_Decays(lines, decays.pole, l_r).rows(motions))
    further, pole = beyond_linear(lines, motion_rows, decays.pole, l_r)
    return lines.with_columns(further, (pole, scatter)), pole


class _Decays:
    """Transforms of decays e^{λt} m(t) of one λ, at the lines."""

    def __init__(self, lines: Lines, pole: complex, participation: np.ndarray) -> None:
        self.lines, self.pole, self.rate, self.participation = lines, pole, -pole.real, participation
        end, record = DECAY.duration / self.rate, 2.0 * np.pi / lines.resolution
        counts = lines.omega / lines.resolution
        # At multiples of 1/T the transform of a linear mode's decay, cut off at T, still has the form of its pole.
        if np.abs(counts - np.round(counts)).max() < 1e-3:
            end = min(end, record)
        self.time = np.linspace(0.0, end, DECAY.knots)
        spline = CubicSpline(self.time, np.eye(DECAY.knots))
        third = 6.0 * spline.c[0]
        jumps = np.vstack([-third[:1], third[:-1] - third[1:], third[-1:]])
        a, b = (each - 1j * lines.omega[:, None] for each in (pole, pole.conjugate()))
        exp_a = np.exp(a * self.time)

        def boundary_terms(exponent: np.ndarray, at: float) -> np.ndarray:
            """Boundary terms of the integral by parts, at one end; the third derivative is constant between knots."""
            return np.asarray(sum((-1) ** k * spline(at, k)[None] / exponent ** (k + 1) for k in range(3)))

        self.above = exp_a[:, -1:] * boundary_terms(a, end) - boundary_terms(a, 0.0) - (exp_a / a**4) @ jumps
        self.below = -boundary_terms(b, 0.0)

    def rows(self, motions: np.ndarray) -> tuple[Floats, Floats]:
        """Rows (n_rows, k) of the real and of the imaginary part of the factor a, for m (n_knots, k)."""
        above, below, l_r = self.above @ motions, self.below @ motions.conj(), self.participation
        return rows_of_pair(l_r[:, None] * above.T[:, None], l_r.conj()[:, None] * below.T[:, None])


# m at the knots, (n_knots,), from complex coefficients in units of the decay rate.
Law = Callable[[_Decays, np.ndarray], np.ndarray]


def _linear(decays: _Decays, coefficients: np.ndarray) -> np.ndarray:
    """m of linear modes: their poles less λ, then their amplitudes relative to the first."""
    n = (coefficients.size + 1) // 2
    return np.asarray(np.exp(decays.rate * np.outer(decays.time, coefficients[:n])) @ np.r_[1.0, coefficients[n:]])


def _by_time(decays: _Decays, coefficients: np.ndarray) -> np.ndarray:
    """m = exp(Σ_k c_k t^k)."""
    powers = (decays.rate * decays.time)[:, None] ** np.arange(1, coefficients.size + 1)
    return np.asarray(np.exp(powers @ coefficients))


def _spread(decays: _Decays, coefficients: np.ndarray) -> np.ndarray:
    """m of the mean over evenly spread poles, from coefficients c, w², d."""
    t = decays.rate * decays.time
    wt = np.sqrt(coefficients[1] + 0j) * t
    small = np.abs(wt) < 1e-4
    mean = np.where(small, 1.0 + wt**2 / 6.0, np.sinh(wt) / np.where(small, 1.0, wt))
    return np.asarray(np.exp(coefficients[0] * t + coefficients[2] * t**3) * mean)


def _on_backbone(powers: tuple[float, ...], decays: _Decays, coefficients: np.ndarray) -> np.ndarray:
    """m of a mode on a backbone, whose pole is Σ_k λ_k r^p_k at amplitude r."""
    rates = decays.rate * coefficients
    rates[0] += decays.pole
    (integrals,) = backbone_integrals(rates.real[None], np.array(powers), decays.time)
    return np.asarray(np.exp(integrals @ rates - decays.pole * decays.time))


# (number of complex coefficients, that of the pole among them; law).
LAWS: tuple[tuple[int, Law], ...] = (
    (3, _by_time),
    *((3, partial(_on_backbone, powers)) for powers in POWERS),
    (3, _spread),
    (4, _by_time),
    *((4, partial(_on_backbone, powers)) for powers in ((0.0, 0.5, 1.0, 2.0), (0.0, -1.0, 1.0, 2.0))),
)


class _Peak:
    """The fit of laws about a peak by variable projection of amplitudes and polynomials.

    The poles of the other modes may change to first order.
    """

    def __init__(self, lines: Lines, fit: Fit, cluster: np.ndarray, pole: complex) -> None:
        self.decays = _Decays(lines, pole, fit.participation[cluster[0]])
        self.noise = fit.noise
        self.weights = row_weights(lines).T[:, :, None]
        others = np.setdiff1d(np.arange(fit.poles.size), cluster)
        rows = regressors(lines, fit.poles, fit.participation)
        self.bases = bases_with_changes(rows, fit, others, list(self.weights))
        self.values = self._beyond_others(lines.values.T)

    def fitted(self, law: Law, starts: list[np.ndarray]) -> tuple[float, np.ndarray] | None:
        """Twice the log-likelihood of a law, up to a constant; m and its change with each unknown, (n_knots, k)."""
        once, best, smallest = CachedResidual(lambda x: self._residual(self._motions(law, x))), None, np.inf
        for start in starts:
            unknowns = np.r_[start.real, start.imag]
            if not once(unknowns)[1].any():
                continue
            unknowns = once.least(unknowns, DECAY.max_evaluations)
            squares = float((once(unknowns)[0] ** 2).sum())
            if squares < smallest:
                best, smallest = unknowns, squares
        if best is None:
            return None
        residual = once(best)[0].reshape(self.noise.size, -1)
        floor = 1e-24 * (np.array(self.values) ** 2).sum(axis=1) + 1e-300
        logs = np.log((residual**2).sum(axis=1) + floor).sum()
        return -residual.shape[1] * float(logs), self._motions(law, best)

    def starts(self, law: Law, size: int, decay: np.ndarray) -> list[np.ndarray]:
        """Two starts of a law of so many coefficients: a fit to m (n_knots,) of the linear modes, and no change."""
        decays, constant = self.decays, np.zeros(size, complex)
        base = np.log(law(decays, constant))
        steps = [np.log(law(decays, constant + step)) - base for turn in (0.1, 0.1j) for step in turn * np.eye(size)]
        logs = np.log(np.abs(decay) + 1e-300) + 1j * np.unwrap(np.angle(decay))
        weight = np.exp(-decays.rate * decays.time) * np.abs(decay)
        x, y = weight[:, None] * np.column_stack(steps), weight * (logs - logs[0] - base)
        coefficients = 0.1 * np.linalg.lstsq(np.vstack([x.real, x.imag]), np.r_[y.real, y.imag], rcond=1e-6)[0]
        return [coefficients[:size] + 1j * coefficients[size:], constant]

    def _motions(self, law: Law, unknowns: Floats) -> np.ndarray:
        def motion(x: Floats) -> np.ndarray:
            return law(self.decays, x[: x.size // 2] + 1j * x[x.size // 2 :])

        with np.errstate(over="ignore", invalid="ignore"):
            m = motion(unknowns)
            steps = BACKBONE.difference_step * np.eye(unknowns.size)
            return np.column_stack([m, *((motion(unknowns + step) - m) / BACKBONE.difference_step for step in steps)])

    def _residual(self, motions: np.ndarray) -> tuple[Floats, Floats]:
        """Residual (n,) and its Jacobian (n, n_unknowns)."""
        if not (np.abs(motions) < DECAY.max_motion).all():
            return diverged(np.concatenate(self.values), motions.shape[1] - 1)
        rows, n = np.hstack(self.decays.rows(motions)), motions.shape[1]

        def of_output(y: Floats, x: Floats) -> tuple[Floats, Floats]:
            return projected_residual(y, x[:, [0, n]], lambda c: c[0] * x[:, 1:n] + c[1] * x[:, n + 1 :])

        beyond = self._beyond_others([weight * rows for weight in self.weights])
        residuals, jacobians = zip(*map(of_output, self.values, beyond), strict=True)
        return np.concatenate(residuals), np.vstack(jacobians)

    def _beyond_others(self, outputs: Iterable[Floats]) -> list[Floats]:
        """What the other modes do not explain of each output, (n_rows,) or (n_rows, k), in units of its noise."""
        each = zip(outputs, self.bases, self.noise, strict=True)
        return [(x - basis @ (basis.T @ x)) / noise for x, basis, noise in each]
