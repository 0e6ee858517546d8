"""The loop of small motion about that under test: its poles, and the error of the readings that it bears for sure."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from workbench.design.estimation.digital import DigitalController
from workbench.design.export.sampled_loop import closed_by, held, linear_plant
from workbench.design.loop.rig_loop import LoopRun, named
from workbench.rig.elements import PointElement
from workbench.rig.rig import Rig
from workbench.rig.sensors import MEASURED
from workbench.rig.statespace import output_matrix
from workbench.structure.modes import Modes
from workbench.structure.modification import attach
from workbench.structure.supports import PointDamper, PointSpring

FREQUENCIES = 240


def modes_in_motion(rig: Rig, run: LoopRun) -> Modes:
    """The modes with each element at a point as the spring and damper that do the same in the motion of a run.

    (k, c) by least squares of f = -k w - c v over the run: equivalent linearisation (Caughey, J. Acoust. Soc. Am. 35
    (1963) 1706). Either may be negative: a spring that softens, a damper that feeds the motion. Springs that soften are
    left out where the structure would have no frequency with them.
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
    """Poles of a sampled loop, and the damping that each mode has in it.

    Attributes:
        poles: (n_states,) in the z plane.
        damping: (n_modes,) ratio of the pole in which a mode moves most, above half the rate at the alias next to it.
    """

    poles: np.ndarray
    damping: np.ndarray

    @property
    def spectral_radius(self) -> float:
        return float(np.abs(self.poles).max())


def loop_poles(rig: Rig, controller: DigitalController, modes: Modes | None = None) -> LoopPoles:
    """Poles of the loop of small motion: delays exact, dead zones and limits left out, on-off control switched off.

    Args:
        rig: whose actuators and sensors close the loop.
        controller: with or without compensation.
        modes: of the motion, where elements stand at points; those of the rig unless given.
    """
    modes = modes or rig.modes
    closed, _, _ = _closed(rig, controller, modes)
    poles, vectors = np.linalg.eig(closed)
    n = modes.n_modes
    moved = np.abs(modes.omega[:, None] * vectors[:n]) ** 2 + np.abs(vectors[n : 2 * n]) ** 2
    share = moved / np.maximum(moved.sum(axis=0), 1e-300) * (np.abs(poles) > 1e-6)
    rates = np.log(np.where(np.abs(poles) > 0, poles, 1e-300)) / controller.sample_time
    own = rates[np.argmax(share, axis=1)]
    # a pole in the z plane is that of every alias
    around = 2.0 * np.pi / controller.sample_time
    aliases = np.array([way * own.imag + around * np.round((modes.omega - way * own.imag) / around) for way in (1, -1)])
    nearest = np.abs(aliases - modes.omega).argmin(axis=0)
    omega = np.take_along_axis(aliases, nearest[None], axis=0)[0]
    ratio = -own.real / np.maximum(np.hypot(own.real, omega), 1e-300)
    return LoopPoles(poles, np.where(np.abs(omega) < 1e-9 / controller.sample_time, np.sign(-own.real), ratio))


def _closed(rig: Rig, controller: DigitalController, modes: Modes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The loop z ← A z, what errors of the readings add to it, and the readings: A, B, C."""
    actuators = [named(rig.actuators, name) for name in controller.actuators]
    a, b, _ = linear_plant(modes, actuators, ())
    stepped, into = held(a, b, controller.sample_time, np.array([x.delay for x in actuators]))
    return closed_by(stepped, into, _reads(rig, controller, modes, len(stepped)), controller)


def _reads(rig: Rig, controller: DigitalController, modes: Modes, total: int) -> np.ndarray:
    """C (n_sensors, total) of the readings: modes first, sensors late or slow as they are at each mode's frequency."""
    sensors = [named(rig.sensors, name) for name in controller.sensors]
    n = modes.n_modes
    reads = np.zeros((len(sensors), total))
    shapes = output_matrix(modes, sensors)
    for i, sensor in enumerate(sensors):
        order = MEASURED[sensor.quantity][1]
        # a late or slow sensor by what it makes of each mode at its frequency
        h = np.exp(-1j * modes.omega * max(sensor.delay, 0.0)) / (1.0 + 1j * modes.omega * sensor.time_constant)
        safe = np.where(modes.omega > 0, modes.omega, 1.0)
        if order == 0:
            reads[i, :n], reads[i, n : 2 * n] = shapes[i] * h.real, shapes[i] * h.imag / safe
        else:
            reads[i, :n], reads[i, n : 2 * n] = -shapes[i] * modes.omega * h.imag, shapes[i] * h.real
    names = [s.name for s in sensors]
    mixed = np.eye(len(sensors))
    for i, sensor in enumerate(sensors):
        for name, share in sensor.crosstalk:
            if name in names:
                mixed[i, names.index(name)] += share * sensor.gain / sensors[names.index(name)].gain
    return np.asarray(mixed @ reads)


def small_gain_margin(rig: Rig, controller: DigitalController, modes: Modes | None = None) -> tuple[float, float]:
    """The relative error of all readings that a loop bears whatever its phase, and the frequency where it is least, Hz.

    With y_real = (I + Δ) y, Δ = diag(δ_j), and M from what Δ adds to the readings, the loop is stable for all
    |δ_j| < 1 / max_ω ρ(|M(e^{iωT})|): ρ(|M|), the Perron root, bounds the structured singular value of M for a
    diagonal Δ (Safonov, IEE Proc. D 129 (1982) 251).
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
