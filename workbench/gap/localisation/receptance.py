"""What sensors read at the lines of a record's spectrum: of forces on the modes, and of how it starts and ends.

At a line of frequency ω that is Φ_s (Ω² - ω² + iω C)⁻¹ of modal forces, and T = Φ_s (z - A)⁻¹ z, z = e^{iωΔt}, of the
state at the start less that at the end; all in units of the noise. Velocities of a state are in units of the modes'
own, so that no column of T is far larger than another.
"""

from dataclasses import dataclass, replace

import numpy as np

from workbench.arrays import Complexes, Floats
from workbench.gap.prediction.unmodelled_force import SampledModel
from workbench.rig.rig import Rig
from workbench.rig.simulate import reading_of

UNDAMPED = 1e-9j  # of the stiffness: what keeps a mode without damping finite on a line of its own


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
        """Readings (n_lines, n_sensors) of a unit force where the modes have that shape (n_modes,)."""
        return self.compliance @ shape

    def along(self, directions: Complexes) -> Complexes:
        """T seen along a direction (n_lines, n_sensors) of the sensors: (n_lines, 2 n_modes)."""
        return (directions[:, None, :] @ self.tail)[:, 0]

    def products(self, left: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of T with itself and with what is left (n_lines, n_sensors), by weights of the lines."""
        tail, left = self.tail.reshape(-1, self.tail.shape[2]), left.ravel()
        weighted = tail * np.repeat(weights, self.tail.shape[1])[:, None]
        return real_product(weighted, tail), real_product(weighted, left)

    def on(self, kept: np.ndarray) -> "CoupledReceptances":
        """On some of the lines."""
        return CoupledReceptances(self.compliance[kept], self.tail[kept])


@dataclass(frozen=True, eq=False)
class _Alike:
    """Sensors that read the same derivative of the motion in time: which, their shapes, and what each mode shows them.

    Attributes:
        here: (n_here,) sensors.
        shapes: (n_here, n_modes) in units of the noise.
        rates: (n_lines,) of that derivative.
        tail: (n_lines, 2 n_modes) of the mode itself.
    """

    here: np.ndarray
    shapes: np.ndarray
    rates: np.ndarray
    tail: np.ndarray


@dataclass(frozen=True, eq=False)
class UncoupledReceptances:
    """Receptances of modes that damping does not couple: a sensor reads its shape there, times the mode's own.

    Attributes:
        compliance: (n_lines, n_modes) of the modes themselves.
        sensors: by what they read.
    """

    compliance: np.ndarray
    sensors: tuple[_Alike, ...]

    def to_force(self, shape: Floats) -> Complexes:
        """See `CoupledReceptances`."""
        moved = self.compliance * shape
        readings = np.empty((len(moved), sum(alike.here.size for alike in self.sensors)), complex)
        for alike in self.sensors:
            readings[:, alike.here] = (moved @ alike.shapes.T) * alike.rates[:, None]
        return readings

    def along(self, directions: Complexes) -> Complexes:
        """See `CoupledReceptances`."""
        seen: list[Complexes] = [
            np.tile(directions[:, alike.here] @ alike.shapes, 2) * alike.tail for alike in self.sensors
        ]
        return sum(seen[1:], start=seen[0])

    def products(self, left: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `CoupledReceptances`."""
        size = 2 * self.compliance.shape[1]
        own, along = np.zeros((size, size)), np.zeros(size)
        for alike in self.sensors:
            weighted = weights[:, None] * alike.tail
            own += np.tile(alike.shapes.T @ alike.shapes, (2, 2)) * real_product(weighted, alike.tail)
            seen = np.tile(left[:, alike.here] @ alike.shapes, 2)
            along += 2.0 * np.sum((weighted.conj() * seen).real, axis=0)
        return own, along

    def on(self, kept: np.ndarray) -> "UncoupledReceptances":
        """See `CoupledReceptances`."""
        sensors = (replace(alike, rates=alike.rates[kept], tail=alike.tail[kept]) for alike in self.sensors)
        return UncoupledReceptances(self.compliance[kept], tuple(sensors))


Receptances = UncoupledReceptances | CoupledReceptances


def real_product(one: Complexes, other: Complexes) -> Floats:
    """Sums over lines, those of negative frequency too: 2 Re(one* other)."""
    product: Floats = 2.0 * (one.real.T @ other.real + one.imag.T @ other.imag)
    return product


def receptances_of(rig: Rig, model: SampledModel, omega: Floats, n_samples: int, sample_time: float) -> Receptances:
    """The receptances of a rig at lines of frequency omega (n_lines,), rad/s, of a record of so many samples.

    Args:
        model: the rig's sampled form, with the variance of each sensor's noise.
    """
    z = (1.0 + abs(UNDAMPED)) * np.exp(1j * omega * sample_time)
    turn = _uncoupled if rig.modes.proportional else _coupled
    return turn(rig, model, np.asarray(1j * omega, complex), z, np.sqrt(model.noise_variance), 1.0 / np.sqrt(n_samples))


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
    tail = z[:, None, None] * np.swapaxes(np.linalg.solve(transposed, outputs), 1, 2) * _velocities(rig)
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
    # displacement and velocity of each mode by the displacement and the velocity that it starts with
    common = share * z / ((z - qq) * (z - vv) - qv * vq)
    displacement = np.hstack([common * (z - vv), common * qv]) * _velocities(rig)
    velocity = np.hstack([common * vq, common * (z - qq)]) * _velocities(rig)
    motions = displacement, velocity, -np.tile(stiffness, 2) * displacement - np.tile(damping, 2) * velocity
    rows, orders = reading_of(rig)
    sensors = []
    for order in set(orders.tolist()):
        here = np.flatnonzero(orders == order)
        sensors.append(_Alike(here, rows[here] / noise[here, None], rate[:, 0] ** order, motions[order]))
    return UncoupledReceptances(compliance, tuple(sensors))


def _velocities(rig: Rig) -> Floats:
    """Units (2 n_modes,) of a state."""
    omega = rig.modes.omega
    return np.concatenate([np.ones(omega.size), np.maximum(omega, 0.1 * omega[-1])])
