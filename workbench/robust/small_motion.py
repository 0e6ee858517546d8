"""The loop linearised about the motion under test: its poles, and its small-gain margin."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from workbench.design.estimation.controller import reading
from workbench.design.estimation.digital import DigitalController
from workbench.design.export.sampled_loop import closed_by, held, linear_plant
from workbench.design.loop.rig_loop import LoopRun, driven, named
from workbench.rig.actuators import mixing
from workbench.rig.elements import PointElement
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.modes import Modes
from workbench.structure.modification import attach
from workbench.structure.supports import PointDamper, PointSpring

FREQUENCIES = 240  # logarithmic grid for the small-gain margin


def modes_in_motion(rig: Rig, run: LoopRun) -> Modes:
    """The modes with each nonlinear element at a point replaced by its equivalent spring and damper in a run.

    Equivalent linearisation (Caughey, J. Acoust. Soc. Am. 35 (1963) 1706): (k, c) by least squares of f = -k w - c v
    over the run. Either may be negative. Negative springs are left out where they would make the structure unstable.
    """
    points = [e for e in rig.elements if isinstance(e, PointElement)]
    springs, dampers = [], []
    for element, motion in zip(points, np.moveaxis(run.elements, 1, 0), strict=True) if run.bounded else ():
        w, v, f = motion
        if not (np.abs(w).max() > 0 and np.abs(v).max() > 0):
            continue
        stiffness, coefficient = np.linalg.lstsq(-np.column_stack([w, v]), f, rcond=None)[0]
        springs.append(PointSpring(element.at, float(stiffness)))
        dampers.append(PointDamper(element.at, float(coefficient)))
    try:
        return attach(rig.modes, (*springs, *dampers))
    except ValueError:
        return attach(rig.modes, (*(s for s in springs if s.stiffness > 0), *dampers))


@dataclass(frozen=True, eq=False)
class LoopPoles:
    """Poles of a sampled loop, and the closed-loop damping of each mode.

    Attributes:
        poles: (n_states,) in the z plane.
        damping: (n_modes,) ratio of the pole in whose eigenvector the mode participates most; its frequency is the
            alias nearest to the mode's.
    """

    poles: np.ndarray
    damping: np.ndarray

    @property
    def spectral_radius(self) -> float:
        return float(np.abs(self.poles).max())


def loop_poles(rig: Rig, controller: DigitalController, modes: Modes | None = None) -> LoopPoles:
    """Poles of the linearised loop, with exact delays, without dead zones, limits and relays.

    Args:
        rig: gives the actuators and sensors.
        controller: with or without compensation.
        modes: linearised about the motion, see `modes_in_motion`; by default those of the rig.
    """
    modes = modes or rig.modes
    closed, _, _ = _closed(rig, controller, modes)
    poles, vectors = np.linalg.eig(closed)
    n = modes.n_modes
    energy = np.abs(modes.omega[:, None] * vectors[:n]) ** 2 + np.abs(vectors[n : 2 * n]) ** 2
    participation = energy / np.maximum(energy.sum(axis=0), 1e-300) * (np.abs(poles) > 1e-6)
    rates = np.log(np.where(np.abs(poles) > 0, poles, 1e-300)) / controller.sample_time
    own = rates[np.argmax(participation, axis=1)]
    # a pole in the z plane does not distinguish aliases
    sampling, signed = 2.0 * np.pi / controller.sample_time, np.array([own.imag, -own.imag])
    aliases = signed + sampling * np.round((modes.omega - signed) / sampling)
    nearest = np.abs(aliases - modes.omega).argmin(axis=0)
    omega = np.take_along_axis(aliases, nearest[None], axis=0)[0]
    ratio = -own.real / np.maximum(np.hypot(own.real, omega), 1e-300)
    return LoopPoles(poles, np.where(np.abs(omega) < 1e-9 / controller.sample_time, np.sign(-own.real), ratio))


def _closed(rig: Rig, controller: DigitalController, modes: Modes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and C of the closed loop, as of `closed_by`: z ← A z + B e, reading C z + e."""
    actuators = driven(rig, controller.actuators)
    a, b, _ = linear_plant(modes, actuators, ())
    stepped, into = held(a, b, controller.sample_time, np.array([x.delay for x in actuators]))
    return closed_by(stepped, into @ mixing(actuators), _output(rig, controller, modes, len(stepped)), controller)


def _output(rig: Rig, controller: DigitalController, modes: Modes, total: int) -> np.ndarray:
    """C (n_sensors, total) of the readings, modal states first, with sensors' lags and delays at modal frequencies."""
    sensors = [named(rig.sensors, name) for name in controller.sensors]
    delays, lags = np.array([max(s.delay, 0.0) for s in sensors]), np.array([s.time_constant for s in sensors])
    reads = late_output(reading(modes, sensors), modes.omega, delays, lags)
    gains = np.array([s.gain for s in sensors])
    mixed = gains[:, None] * crosstalk(sensors) / gains
    return np.asarray(mixed @ np.pad(reads, ((0, 0), (0, total - reads.shape[1]))))


def lag_response(omega: np.ndarray, delays: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """H (n_sensors, n_modes) of delays and lags (n_sensors,), s, at frequencies (n_modes,), rad/s."""
    return np.asarray(np.exp(-1j * np.outer(delays, omega)) / (1.0 + 1j * np.outer(lags, omega)))


def late_output(reads: np.ndarray, omega: np.ndarray, delays: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """C (n_sensors, 2 n_modes) of y = Re(H (c_q + iω c_v) (q - i q'/ω)), H of `lag_response`, for reads (c_q c_v)."""
    c_q, c_v = np.hsplit(reads, 2)
    h, safe = lag_response(omega, delays, lags), np.where(omega > 0, omega, 1.0)
    return np.hstack([c_q * h.real - c_v * omega * h.imag, c_v * h.real + c_q * h.imag / safe])


def crosstalk(sensors: Sequence[Sensor]) -> np.ndarray:
    """M (n_sensors, n_sensors) of readings = M y, y without cross-talk, of the channels that a controller reads."""
    names = [s.name for s in sensors]
    mixed = np.eye(len(sensors))
    for j, sensor in enumerate(sensors):
        for name, share in sensor.crosstalk:
            if name in names:
                mixed[j, names.index(name)] += share
    return mixed


def small_gain_margin(rig: Rig, controller: DigitalController, modes: Modes | None = None) -> tuple[float, float]:
    """The small-gain margin of a loop, and the frequency (Hz) of its minimum.

    It is the relative error of all readings, of any phase, that cannot destabilise the loop. With y_real = (I + Δ) y,
    Δ = diag(δ_j), and M from the error Δ y to the readings y, the loop is stable for all
    |δ_j| < 1 / max_ω ρ(|M(e^{iωT})|): the Perron root ρ(|M|) bounds the structured singular value of M for a diagonal Δ
    (Safonov, IEE Proc. D 129 (1982) 251). nan for on-off control, 0 for an unstable loop, inf without feedback.
    """
    if controller.relays is not None:
        return np.nan, np.nan
    closed, by_error, reads = _closed(rig, controller, modes or rig.modes)
    poles = np.linalg.eigvals(closed)
    if np.abs(poles).max() >= 1.0:
        return 0.0, np.nan
    if not by_error.any():
        return np.inf, np.nan
    angles, widths = np.angle(poles), -np.log(np.maximum(np.abs(poles), 1e-12))
    near = (angles[:, None] + widths[:, None] * np.linspace(-2.0, 2.0, 9)).ravel()
    grid = np.unique(np.r_[np.geomspace(1e-4, np.pi, FREQUENCIES), near[(near > 1e-4) & (near < np.pi)], np.pi])
    values, vectors = np.linalg.eig(closed)
    left, right = reads @ vectors, np.linalg.solve(vectors, by_error.astype(complex))

    def bound(angle: float) -> float:
        m = np.abs((left / (np.exp(1j * angle) - values)) @ right)
        return float(np.abs(np.linalg.eigvals(m)).max())

    worst = int(np.argmax([bound(angle) for angle in grid]))
    around = grid[max(worst - 1, 0)], grid[min(worst + 1, grid.size - 1)]
    refined = minimize_scalar(lambda angle: -bound(angle), bounds=around, method="bounded", options={"xatol": 1e-9})
    angle = max((float(grid[worst]), float(refined.x)), key=bound)
    return 1.0 / bound(angle), angle / (2.0 * np.pi * controller.sample_time)
