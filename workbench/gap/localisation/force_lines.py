"""Misfit of one force of any law at a point, from the lines of the residual's spectrum.

At a line of frequency ω the residual of a record is

    r = h(x) g + T d + noise        h(x) = Φ_s (Ω² - ω² + iω C)⁻¹ φ(x),  T = Φ_s (z - A)⁻¹ z,  z = e^{iωΔt}

with an arbitrary force g at each line; d, the same for all lines, is the state at the start of the record minus that at
its end (the transient, or leakage). At the right x, the residual after projection onto h and T is noise. A line is
weighted by the force's share of its power, with weights that do not depend on x: a wrong spectrum of the force then
costs precision, but causes no bias.

If modes lie above half the sample rate and accelerations are measured, a force that varies between samples excites
them, and their response is aliased: r = Σ_k h(x, ω + k ω_s) g_k, with arbitrary g_k.

Velocities of a state are scaled by the natural frequencies, so that the columns of T have similar sizes.

Projections on one unknown source: Stoica & Nehorai, IEEE Trans. Acoust. Speech Signal Process. 37 (1989) 720.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from workbench.arrays import Complexes, Floats
from workbench.gap.prediction.unmodelled_force import SampledModel
from workbench.rig.readings import reading_of
from workbench.rig.rig import Rig


@dataclass(frozen=True)
class LinesSettings:
    """Constants of the selection and weighting of lines."""

    nyquist_share: float = 0.9  # of half the sample rate: above, aliasing is not small
    max_lines: int = 8192  # of a record: longer ones are thinned out, which only costs precision
    averaged_lines: int = 75  # in the average of the force spectrum
    noise_deviations: float = 2.0  # standard errors of this average that are subtracted, as noise may cause them
    min_weight: float = 0.02  # a line of a smaller weight is left out
    screened_lines: int = 300  # the strongest ones, that are used to compare many places
    rounds: int = 4  # iterations of the force spectrum, each weighted by the one before


LINES = LinesSettings()
UNDAMPED = 1e-9j  # of the stiffness: hysteretic damping that keeps the receptance of an undamped mode finite


@dataclass(frozen=True, eq=False)
class CoupledReceptances:
    """Receptances of modes that damping couples.

    Attributes:
        compliance: (n_lines, n_sensors, n_modes) of modal forces.
        tail: T, (n_lines, n_sensors, 2 n_modes).
    """

    compliance: Complexes
    tail: Complexes

    def to_force(self, shape: Floats) -> Complexes:
        """Receptances (n_lines, n_sensors) to a force at a point with mode shapes `shape` (n_modes,)."""
        return self.compliance @ shape

    def along(self, directions: Complexes) -> Complexes:
        """T projected on a direction of the sensors (n_lines, n_sensors): (n_lines, 2 n_modes)."""
        return (directions[:, None, :] @ self.tail)[:, 0]

    def products(self, left: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weighted products Tᴴ T and Tᴴ r, with the residual `left` (n_lines, n_sensors) and weights (n_lines,)."""
        tail, left = self.tail.reshape(-1, self.tail.shape[2]), left.ravel()
        weighted = tail * np.repeat(weights, self.tail.shape[1])[:, None]
        return real_product(weighted, tail), real_product(weighted, left)

    def on(self, kept: np.ndarray) -> "CoupledReceptances":
        return CoupledReceptances(self.compliance[kept], self.tail[kept])


@dataclass(frozen=True, eq=False)
class _SensorGroup:
    """Sensors that measure the same time derivative of the motion.

    Attributes:
        here: (n_here,) indices of the sensors.
        shapes: (n_here, n_modes) mode shapes there, in units of the noise.
        rates: (n_lines,) factor (iω)ᵏ of the derivative.
        tail: (n_lines, 2 n_modes) T of the modal coordinates.
    """

    here: np.ndarray
    shapes: np.ndarray
    rates: np.ndarray
    tail: np.ndarray


@dataclass(frozen=True, eq=False)
class UncoupledReceptances:
    """Receptances of modes that damping does not couple: products of mode shapes and modal receptances.

    Its methods are those of `CoupledReceptances`.

    Attributes:
        compliance: (n_lines, n_modes) modal receptances.
        sensors: grouped by the derivative that they measure.
    """

    compliance: np.ndarray
    sensors: tuple[_SensorGroup, ...]

    def to_force(self, shape: Floats) -> Complexes:
        moved = self.compliance * shape
        readings = np.empty((len(moved), sum(group.here.size for group in self.sensors)), complex)
        for group in self.sensors:
            readings[:, group.here] = (moved @ group.shapes.T) * group.rates[:, None]
        return readings

    def along(self, directions: Complexes) -> Complexes:
        seen: list[Complexes] = [
            np.tile(directions[:, group.here] @ group.shapes, 2) * group.tail for group in self.sensors
        ]
        return sum(seen[1:], start=seen[0])

    def products(self, left: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        size = 2 * self.compliance.shape[1]
        own, along = np.zeros((size, size)), np.zeros(size)
        for group in self.sensors:
            weighted = weights[:, None] * group.tail
            own += np.tile(group.shapes.T @ group.shapes, (2, 2)) * real_product(weighted, group.tail)
            seen = np.tile(left[:, group.here] @ group.shapes, 2)
            along += 2.0 * np.sum((weighted.conj() * seen).real, axis=0)
        return own, along

    def on(self, kept: np.ndarray) -> "UncoupledReceptances":
        sensors = (replace(group, rates=group.rates[kept], tail=group.tail[kept]) for group in self.sensors)
        return UncoupledReceptances(self.compliance[kept], tuple(sensors))


Receptances = UncoupledReceptances | CoupledReceptances


def real_product(one: Complexes, other: Complexes) -> Floats:
    """Sum over lines of positive and negative frequency: 2 Re(oneᴴ other)."""
    return np.asarray(2.0 * (one.real.T @ other.real + one.imag.T @ other.imag))


def receptances_of(rig: Rig, model: SampledModel, omega: Floats, n_samples: int, sample_time: float) -> Receptances:
    """The receptances of a rig, and of its sampled form, at spectral lines (n_lines,), rad/s, of a record."""
    z, rate = (1.0 + abs(UNDAMPED)) * np.exp(1j * omega * sample_time), np.asarray(1j * omega, complex)
    of_modes = _uncoupled if rig.modes.proportional else _coupled
    return of_modes(rig, model, rate, z, np.sqrt(model.noise_variance), 1.0 / np.sqrt(n_samples))


def _coupled(
    rig: Rig, model: SampledModel, rate: Complexes, z: Complexes, noise: Floats, share: float
) -> CoupledReceptances:
    modes = rig.modes
    dynamic = rate[:, None, None] * modes.damping
    each = np.arange(modes.n_modes)
    dynamic[:, each, each] += (1.0 + UNDAMPED) * modes.omega**2 + rate[:, None] ** 2
    rows, orders = reading_of(rig)
    compliance = rate[:, None, None] ** orders[:, None] * (rows @ np.linalg.inv(dynamic))
    transposed = z[:, None, None] * np.eye(model.transition.shape[0]) - model.transition.T
    outputs = np.broadcast_to(model.output.T, (z.size, *model.output.T.shape))
    tail = z[:, None, None] * np.swapaxes(np.linalg.solve(transposed, outputs), 1, 2) * _state_units(rig)
    return CoupledReceptances(compliance / noise[:, None], share * tail / noise[:, None])


def _uncoupled(
    rig: Rig, model: SampledModel, rate: Complexes, z: Complexes, noise: Floats, share: float
) -> UncoupledReceptances:
    modes = rig.modes
    n, rate, z = modes.n_modes, rate[:, None], z[:, None]
    damping, stiffness = np.diag(modes.damping), modes.omega**2
    compliance = 1.0 / ((1.0 + UNDAMPED) * stiffness + rate * damping + rate**2)
    (qq, qv), (vq, vv) = (
        [np.diag(model.transition[rows, columns]) for columns in (slice(n), slice(n, None))]
        for rows in (slice(n), slice(n, None))
    )
    # transform of the free response (displacement and velocity) of each mode to its initial state
    common = share * z / ((z - qq) * (z - vv) - qv * vq)
    displacement = np.hstack([common * (z - vv), common * qv]) * _state_units(rig)
    velocity = np.hstack([common * vq, common * (z - qq)]) * _state_units(rig)
    motions = displacement, velocity, -np.tile(stiffness, 2) * displacement - np.tile(damping, 2) * velocity
    rows, orders = reading_of(rig)
    sensors = []
    for order in set(orders.tolist()):
        here = np.flatnonzero(orders == order)
        sensors.append(_SensorGroup(here, rows[here] / noise[here, None], rate[:, 0] ** order, motions[order]))
    return UncoupledReceptances(compliance, tuple(sensors))


def _state_units(rig: Rig) -> Floats:
    """Units (2 n_modes,) of a modal state: 1 for displacements, natural frequencies for velocities."""
    omega = rig.modes.omega
    return np.concatenate([np.ones(omega.size), np.maximum(omega, 0.1 * omega[-1])])


@dataclass(frozen=True, eq=False)
class Lines:
    """A record's residual at the lines of its spectrum, in units of the noise, with the rig's receptances.

    Attributes:
        receptances: of the rig, to forces and to the states at the ends.
        left: (n_lines, n_sensors) the residual; its noise has unit variance.
        weights: (n_lines,).
        folded: receptances to forces whose frequencies are aliased onto the lines, one for each alias.
    """

    receptances: Receptances
    left: np.ndarray
    weights: np.ndarray
    folded: tuple[Receptances, ...]

    @cached_property
    def _products(self) -> tuple[np.ndarray, np.ndarray]:
        """Weighted Tᴴ T and Tᴴ r."""
        return self.receptances.products(self.left, self.weights)

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of the residual given a force of any law and the states at the ends."""
        n_lines, n_sensors = self.left.shape
        return int(max(2 * n_lines * (n_sensors - 1 - len(self.folded)) - self._products[1].size, 0))

    @cached_property
    def power(self) -> float:
        """Sum of squares of the residual."""
        return float(2.0 * self.weights @ np.sum(np.abs(self.left) ** 2, axis=1))

    def weighted(self, weights: np.ndarray) -> "Lines":
        """The lines with other weights (n_lines,), without those of negligible weight."""
        kept = weights > LINES.min_weight
        return self._on(kept, weights[kept])

    def strongest(self, most: int) -> "Lines":
        strong = np.argsort(-self.weights * np.sum(np.abs(self.left) ** 2, axis=1))[:most]
        return self._on(strong, self.weights[strong])

    def _on(self, kept: np.ndarray, weights: np.ndarray) -> "Lines":
        folded = tuple(each.on(kept) for each in self.folded)
        return Lines(self.receptances.on(kept), self.left[kept], weights, folded)

    def misfit(self, shape: np.ndarray) -> float:
        """Weighted residual sum of squares given a force at a point with mode shapes `shape` (n_modes,)."""
        root = np.sqrt(self.weights)
        seen = [self._along(direction) for direction in self._directions(shape)]
        u, a = np.concatenate([u * root[:, None] for u, _ in seen]), np.concatenate([a * root for _, a in seen])
        end, along = self._transient(u, a)
        return self.power - 2.0 * float(np.sum(np.abs(a) ** 2)) - float(along @ end)

    def force_share(self, shape: np.ndarray) -> np.ndarray:
        """Share (n_lines,) of each line's power along the receptance that is due to a force there: its weight."""
        h = self.receptances.to_force(shape)
        power: Floats = np.maximum(np.sum(np.abs(h) ** 2, axis=1), 1e-300)
        u, a = self._along(h / np.sqrt(power)[:, None])
        share, precision = np.ones_like(power), np.ones_like(power)
        for _ in range(LINES.rounds):
            root = np.sqrt(share)
            end, _ = self._transient(u * root[:, None], a * root)
            read = (np.abs(a - u @ end) ** 2 - 1.0) / power
            chance = LINES.noise_deviations * np.sqrt(_moving_sum((precision / power) ** 2))
            spectrum = np.maximum(_moving_sum(precision * read) - chance, 0.0) / _moving_sum(precision)
            share = spectrum * power / (1.0 + spectrum * power)
            # bounded by rounding, for a force far above the noise
            precision = (power * np.maximum(1.0 - share, np.finfo(float).eps)) ** 2
        return share

    def _transient(self, u: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least-squares state d of the transient given a force, and the right-hand side of its normal equations.

        u, a: T and the residual, projected on the directions of the force.
        """
        own, along = self._products
        along = along - real_product(u, a)
        return np.linalg.lstsq(own - real_product(u, u), along, rcond=1e-12)[0], along

    def _directions(self, shape: np.ndarray) -> list[np.ndarray]:
        """Orthonormal directions (n_lines, n_sensors) that span the response to a force of any law."""
        h = np.stack([each.to_force(shape) for each in (self.receptances, *self.folded)], axis=2)
        h = h / np.sqrt(np.maximum(np.sum(np.abs(h) ** 2, axis=1, keepdims=True), 1e-300))
        return [h[:, :, 0]] if not self.folded else list(np.moveaxis(np.linalg.qr(h)[0], 2, 0))

    def _along(self, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """T and the residual projected on a direction."""
        along = direction.conj()
        return self.receptances.along(along), np.sum(along * self.left, axis=1)


def screened(lines: Lines, shapes: np.ndarray) -> np.ndarray:
    """Approximate misfits (n_places,) of a force at places of mode shapes `shapes` (n_places, n_modes).

    The transient and weak lines are left out.
    """
    left, lines = np.full(len(shapes), lines.power), lines.strongest(LINES.screened_lines)
    to_force = [
        np.moveaxis(np.array([each.to_force(mode) for mode in np.eye(shapes.shape[1])]), 0, 2)
        for each in (lines.receptances, *lines.folded)
    ]
    for *through, r, weight in zip(*to_force, lines.left, lines.weights, strict=True):
        directions: list[Complexes] = []
        for h in through:
            seen = h @ shapes.T
            for _ in range(2 if directions else 0):  # Gram-Schmidt twice, against rounding
                for other in directions:
                    seen = seen - other * np.sum(other.conj() * seen, axis=0)
            seen = seen / np.sqrt(np.maximum(np.sum(np.abs(seen) ** 2, axis=0), 1e-300))
            left -= 2.0 * weight * np.abs(r.conj() @ seen) ** 2
            directions.append(seen)
    return left


def _moving_sum(values: np.ndarray) -> np.ndarray:
    """Moving sum over `LINES.averaged_lines` lines, (n_lines,)."""
    width = min(LINES.averaged_lines, values.size)
    return np.convolve(np.pad(values, (width // 2, width - 1 - width // 2), mode="edge"), np.ones(width), mode="valid")


def lines_of(rig: Rig, model: SampledModel, residuals: Sequence[np.ndarray], sample_time: float) -> list[Lines]:
    """The spectral lines of every record's residual (n_sensors, n_samples), in the sensors' units."""
    noise = np.sqrt(model.noise_variance)
    made: dict[int, tuple[np.ndarray, list[Receptances]]] = {}
    lines = []
    for residual in residuals:
        n = residual.shape[1]
        if n not in made:
            top = max(int(0.5 * LINES.nyquist_share * n), 2)
            taken = np.arange(1, top, 1 + top // LINES.max_lines)
            rates = 2.0 * np.pi / sample_time * np.array([0, *_folds(rig, sample_time)])
            omega = 2.0 * np.pi * taken / (n * sample_time)
            made[n] = taken, [receptances_of(rig, model, omega + rate, n, sample_time) for rate in rates]
        taken, (receptances, *folded) = made[n]
        left = np.fft.rfft(residual, axis=1)[:, taken].T / noise
        lines.append(Lines(receptances, left / np.sqrt(n), np.ones(taken.size), tuple(folded)))
    return lines


def _folds(rig: Rig, sample_time: float) -> list[int]:
    """Multiples of the sample rate by which aliased forces differ in frequency from the lines: -1, 1, -2, ...

    As many as the modes reach, and as the number of sensors can separate. None unless modes reach beyond the sample
    rate and accelerations are measured: displacements and velocities hardly respond to such frequencies.
    """
    _, orders = reading_of(rig)
    top = int(rig.modes.omega[-1] * sample_time / np.pi)
    folds = min(top, (len(orders) - 1) // 2) if top > 1 and (orders == 2).any() else 0
    return [(-1) ** k * ((k + 1) // 2) for k in range(1, folds + 1)]
