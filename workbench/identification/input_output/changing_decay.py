"""One mode that changes, the rival of several linear ones in a peak of transfer functions.

A transfer function is the transform of a free decay. That of a mode that changes with time, with its amplitude, or
between averages, is

    h(t) = Re a e^{λt} m(t),     log m = Σ_k c_k t^k,     or  ∫ Σ_k λ_k r^p_k dt - λ t  on a backbone (`backbone`),
                                 or  m = e^{ct + dt³} sinh(wt) / wt: the mean over poles evenly from λ - w to λ + w.

m is smooth, so its cubic spline through some times stands for it; that is linear in its values, and transforms exactly.
Linear modes have m = Σ_k a_k e^{(λ_k - λ)t}: two have as many numbers as each law, so that the likelier is preferred.
All are compared in lines about the peak, beside a parabola for what the modes elsewhere leave there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline

from workbench.arrays import Floats
from workbench.identification.free_decay.backbone import POWERS, backbone_integrals
from workbench.identification.input_output.modal_fit import Fit, columns
from workbench.identification.input_output.rivals import (
    RIVALS,
    beside_constant,
    in_place_of_clusters,
    left_by_motion,
    nearest_pole,
    taken_by_others,
)
from workbench.identification.input_output.spectral_lines import Lines
from workbench.identification.signal.searches import Budget, Once
from workbench.structure.modes import mac


@dataclass(frozen=True)
class ChangingDecaySettings:
    """Constants of the search for one mode that changes in place of several."""

    alike: float = 0.9  # modal assurance of such modes
    smooth: int = 2  # degree of what modes elsewhere leave there
    knots: int = 100  # of the spline in time
    ends: float = 8.0  # time constants, at which a decay ends
    most_tries: int = 25  # evaluations of a fit
    largest: float = 1e6  # times its first value: beyond this a motion diverges


DECAY = ChangingDecaySettings()


@dataclass(frozen=True, eq=False)
class Motion:
    """One mode that changes.

    Attributes:
        moved: (n_rows, n_columns) what it moves along, beside a linear mode.
        pole: of that linear mode, rad/s.
        scatter: rms of its frequency about its mean over the decay, rad/s.
    """

    moved: Floats
    pole: complex
    scatter: float


def beside_changing(lines: Lines, fit: Fit, limit: float, budget: Budget) -> tuple[Lines, Fit] | None:
    """The lines with what modes that change move as further columns, and the fit with one mode for each of them.

    Args:
        lines: transfer functions.
        fit: of linear modes.
        limit: χ² that a linear mode must be worth.
        budget: of time.

    Returns:
        None where linear modes describe every peak better.
    """
    shapes, participation = fit.amplitudes / fit.noise[:, None], fit.participation.T
    alike = mac(shapes, shapes) * mac(participation, participation) > DECAY.alike
    within = (fit.poles.imag > lines.omega[0]) & (fit.poles.imag < lines.omega[-1])
    return in_place_of_clusters(
        lines,
        fit,
        alike & within & within[:, None],
        lambda lines, cluster: _in_place_of(lines, fit, cluster, limit),
        lambda lines, one: lines.with_columns(one.moved, (one.pole, one.scatter)),
        budget,
    )


def _in_place_of(lines: Lines, fit: Fit, cluster: np.ndarray, limit: float) -> Motion | None:
    """One mode that changes in place of some of a fit, the strongest first; None where these are likelier."""
    shape, poles = fit.amplitudes[:, cluster[0]] / fit.noise**2, fit.poles[cluster]
    strength = shape.conj() @ fit.amplitudes[:, cluster]
    rates = np.maximum(-poles.real, RIVALS.slowest * lines.resolution)
    mean = complex(np.average(-rates + 1j * poles.imag, weights=np.abs(strength) ** 2 / rates))
    beyond = max(RIVALS.about * -mean.real, RIVALS.fewest * lines.resolution)
    about = (lines.omega > poles.imag.min() - beyond) & (lines.omega < poles.imag.max() + beyond)
    peak = _Peak(lines.only(about, DECAY.smooth), fit, cluster, mean)
    linear = peak.fitted(_linear, [np.r_[poles - mean, strength[1:] / strength[0] * -mean.real] / -mean.real])
    if linear is None:
        return None
    together = (strength * np.exp(np.outer(peak.decays.time, poles - mean))).sum(axis=1)
    laws = (law for numbers, law in LAWS if numbers <= 2 * cluster.size - 1)
    for law in laws:
        one = peak.fitted(law, peak.starts(law, together))
        # As in a free decay, two are two where that is likelier by more than one mode would be by chance.
        if one is not None and one.likelihood >= linear.likelihood - limit * (cluster.size - 1):
            return _motion(lines, peak.decays, one.motions)
    return None


def _motion(lines: Lines, decays: "_Decays", motions: np.ndarray) -> Motion:
    """Of m, and of how it moves with each unknown, (n_knots, 1 + n_unknowns)."""
    l_r, time, m = decays.participation, decays.time, motions[:, 0]
    power = np.abs(m) ** 2 * np.exp(2.0 * decays.pole.real * time)
    frequency = np.gradient(np.unwrap(np.angle(m)), time)
    mean = float(np.average(frequency, weights=power))
    scatter = float(np.sqrt(np.average((frequency - mean) ** 2, weights=power)))
    moved = np.hstack(_Decays(lines, decays.pole, l_r).rows(motions))
    pole = nearest_pole(lines, moved[:, 0], decays.pole, l_r)
    return Motion(beside_constant(lines, moved, pole, l_r), pole, scatter)


class _Decays:
    """Transforms of decays e^{λt} m(t) of one λ."""

    def __init__(self, lines: Lines, pole: complex, participation: np.ndarray) -> None:
        self.lines, self.pole, self.rate, self.participation = lines, pole, -pole.real, participation
        end, record = DECAY.ends / self.rate, 2.0 * np.pi / lines.resolution
        counts = lines.omega / lines.resolution
        # The transform of a whole record has lines at which a mode that rings on has its pole all the same.
        if np.abs(counts - np.round(counts)).max() < 1e-3:
            end = min(end, record)
        self.time = np.linspace(0.0, end, DECAY.knots)
        spline = CubicSpline(self.time, np.eye(DECAY.knots))
        third = 6.0 * spline.c[0]
        jumps = np.vstack([-third[:1], third[:-1] - third[1:], third[-1:]])
        a, b = (each - 1j * lines.omega[:, None] for each in (pole, pole.conjugate()))
        turned = np.exp(a * self.time)

        def ended(exponent: np.ndarray, at: float) -> np.ndarray:
            """∫ of the spline by parts, at one end; its third derivative is constant between knots."""
            return np.asarray(sum((-1) ** k * spline(at, k)[None] / exponent ** (k + 1) for k in range(3)))

        self.above = turned[:, -1:] * ended(a, end) - ended(a, 0.0) - (turned / a**4) @ jumps
        self.below = -ended(b, 0.0)

    def rows(self, motions: np.ndarray) -> tuple[Floats, Floats]:
        """Rows (n_rows, k) of the real and of the imaginary part of a factor of m, (n_knots, k)."""
        above, below, l_r = self.above @ motions, self.below @ motions.conj(), self.participation
        pairs = [
            self.lines.stacked_pair(np.outer(l_r, u), np.outer(l_r.conj(), v))
            for u, v in zip(above.T, below.T, strict=True)
        ]
        return np.column_stack([p[0] for p in pairs]), np.column_stack([p[1] for p in pairs])


# m at the knots, of complex numbers in units of the rate of decay.
Law = Callable[[_Decays, np.ndarray], np.ndarray]


def _linear(decays: _Decays, numbers: np.ndarray) -> np.ndarray:
    """Of linear modes: their poles, then their amplitudes over that of the first."""
    n = (numbers.size + 1) // 2
    return np.asarray(np.exp(decays.rate * np.outer(decays.time, numbers[:n])) @ np.r_[1.0, numbers[n:]])


def _by_time(decays: _Decays, numbers: np.ndarray) -> np.ndarray:
    return np.asarray(np.exp((decays.rate * decays.time)[:, None] ** np.arange(1, numbers.size + 1) @ numbers))


def _spread(decays: _Decays, numbers: np.ndarray) -> np.ndarray:
    t = decays.rate * decays.time
    wt = np.sqrt(numbers[1] + 0j) * t
    small = np.abs(wt) < 1e-4
    mean = np.where(small, 1.0 + wt**2 / 6.0, np.sinh(wt) / np.where(small, 1.0, wt))
    return np.asarray(np.exp(numbers[0] * t + numbers[2] * t**3) * mean)


def _on_backbone(powers: tuple[float, ...], decays: _Decays, numbers: np.ndarray) -> np.ndarray:
    rates = decays.rate * numbers
    rates[0] += decays.pole
    (held,) = backbone_integrals(rates.real[None], np.array(powers), decays.time)
    return np.asarray(np.exp(held @ rates - decays.pole * decays.time))


# How many numbers each has, that of the pole among them.
LAWS: tuple[tuple[int, Law], ...] = (
    (3, _by_time),
    *((3, partial(_on_backbone, powers)) for powers in POWERS),
    (3, _spread),
    (4, _by_time),
    *((4, partial(_on_backbone, powers)) for powers in ((0.0, 0.5, 1.0, 2.0), (0.0, -1.0, 1.0, 2.0))),
)


@dataclass(frozen=True, eq=False)
class _Fitted:
    likelihood: float  # twice its logarithm, up to a constant
    motions: np.ndarray  # m, and how it moves with each unknown, (n_knots, 1 + n_unknowns)


class _Peak:
    """The fit of a law about a peak; what is linear in the transfer functions drops out.

    The poles of the modes beside those in question may move, to first order.
    """

    def __init__(self, lines: Lines, fit: Fit, cluster: np.ndarray, pole: complex) -> None:
        self.decays = _Decays(lines, pole, fit.participation[cluster[0]])
        others = np.setdiff1d(np.arange(fit.poles.size), cluster)
        phi, tangents = columns(lines, fit.poles[others], fit.participation[others])
        each, half = fit.participation.shape[1] + 1, tangents.shape[1] // 2
        real, imaginary = tangents[:, :half:each], tangents[:, half::each]
        self.noise, self.values, self.bases = fit.noise, [], []
        self.weights = np.ones((1, self.noise.size)) if lines.weights is None else lines.weights
        for j, a in enumerate(fit.amplitudes[:, others]):
            basis = taken_by_others(self.weights[:, j : j + 1], phi, (real, imaginary), a)
            y = lines.values[:, j]
            self.bases.append(basis)
            self.values.append((y - basis @ (basis.T @ y)) / self.noise[j])

    def fitted(self, law: Law, starts: list[np.ndarray]) -> _Fitted | None:
        once, best, squares = Once(lambda x: self._left(self._motions(law, x))), None, np.inf
        for start in starts:
            at = np.r_[start.real, start.imag]
            if not once(at)[1].any():
                continue
            at = once.least(at, DECAY.most_tries)
            left = float((once(at)[0] ** 2).sum())
            if left < squares:
                best, squares = at, left
        if best is None:
            return None
        left_over = once(best)[0].reshape(self.noise.size, -1)
        floor = 1e-24 * (np.array(self.values) ** 2).sum(axis=1) + 1e-300
        logs = np.log((left_over**2).sum(axis=1) + floor).sum()
        return _Fitted(-left_over.shape[1] * float(logs), self._motions(law, best))

    def starts(self, law: Law, wanted: np.ndarray) -> list[np.ndarray]:
        """From what the linear modes look like together, m (n_knots,), and from a mode that does not change."""
        size = next(numbers for numbers, each in LAWS if each is law)
        decays, none = self.decays, np.zeros(size, complex)
        base = np.log(law(decays, none))
        steps = [np.log(law(decays, none + step)) - base for turn in (0.1, 0.1j) for step in turn * np.eye(size)]
        logs = np.log(np.abs(wanted) + 1e-300) + 1j * np.unwrap(np.angle(wanted))
        weight = np.exp(-decays.rate * decays.time) * np.abs(wanted)
        x, y = weight[:, None] * np.column_stack(steps), weight * (logs - logs[0] - base)
        found = 0.1 * np.linalg.lstsq(np.vstack([x.real, x.imag]), np.r_[y.real, y.imag], rcond=1e-6)[0]
        return [found[:size] + 1j * found[size:], none]

    def _motions(self, law: Law, unknowns: Floats) -> np.ndarray:
        def motion(x: Floats) -> np.ndarray:
            return law(self.decays, x[: x.size // 2] + 1j * x[x.size // 2 :])

        with np.errstate(over="ignore", invalid="ignore"):
            m = motion(unknowns)
            steps = RIVALS.slightly * np.eye(unknowns.size)
            return np.column_stack([m, *((motion(unknowns + step) - m) / RIVALS.slightly for step in steps)])

    def _left(self, motions: np.ndarray) -> tuple[Floats, Floats]:
        """What is left (n,) and its slopes (n, n_unknowns), the shape projected out (Kaufman 1975)."""
        if not (np.abs(motions) < DECAY.largest).all():
            beyond = 10.0 * np.abs(np.concatenate(self.values))
            return beyond, np.zeros((beyond.size, motions.shape[1] - 1))
        both, found = np.hstack(self.decays.rows(motions)), []
        each = zip(self.values, self.bases, self.weights.T[:, :, None], self.noise, strict=True)
        for y, basis, weight, noise in each:
            x = weight * both
            found.append(left_by_motion(y, (x - basis @ (basis.T @ x)) / noise))
        return np.concatenate([left for left, _ in found]), np.vstack([slopes for _, slopes in found])
