"""Explanation of spillover: the residual mode that a design destabilises, and the path from sensor to actuator.

Let T(s) be the transfer function from readings to forces of the loop without mode r, of open-loop pole λ. With mode r
the loop has a pole s = λ + Δ where

    (s - λ) E(s) = b_r(s)ᵀ T(s) c_r(s),   so   Δ = Σ_ji b_rj T_ji c_ir / E(s),

one term for each actuator j and sensor i. E(s) = s - λ', the mode's other pole, λ* where it oscillates. If damping
couples mode r to the others, of dynamic stiffness Z(s), by the row d and the column e of s C, then b_r - d Z⁻¹ B
replaces b_r, c_r - c Z⁻¹ e replaces c_r, and (s - λ) E(s) = s² + s c_rr + ω_r² - d Z⁻¹ e, with λ a pole of the
structure with all its damping. Evaluated at s = λ, Δ is the first-order perturbation of the eigenvalue; at the pole of
the full loop it is exact. The pole does not move if either control spillover b_r or observation spillover c_r is zero
(Balas 1978).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress, product

import numpy as np
from scipy.linalg import eig
from scipy.optimize import linear_sum_assignment

from workbench.arrays import Complexes, Floats
from workbench.design.estimation.controller import Controller, reading
from workbench.design.laws.law import DesignError, linear
from workbench.design.loop.closed_loop import ClosedLoop, close_with, rounding
from workbench.renamed import Renamed, former_fields
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.rig.statespace import input_matrix, lateness
from workbench.structure.domain import Place
from workbench.structure.modes import Modes
from workbench.structure.printed import Printed, counted, place_text

TWIN = 1e-12  # relative to ω²: dynamic stiffness of a mode at the undamped pole of an equal mode, instead of zero
DOUBLE = 1e-7  # of the pole: two poles of a mode nearer to each other are a double pole, without first-order shift
SUSPECTS = 12  # residual modes, those of the largest shifts, that are left out one by one


@dataclass(frozen=True, eq=False)
class Path:
    """The shift of a mode's pole by one actuator driven by the sensors at one place.

    Attributes:
        actuator: name.
        sensor_at: place of the sensors; all channels there count together.
        shift: its term of the exact shift, rad/s; the real part adds to the growth rate.
        first_order: its term of the first-order shift, rad/s; nan for a double pole (a rigid mode, or ζ = 1).
        sensors: names of the channels at that place.
    """

    actuator: str
    sensor_at: Place
    shift: complex
    first_order: complex
    sensors: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The path in words, from the sensor, by its name or, where several channels are there, its place."""
        unit = "" if isinstance(self.sensor_at, str) else " m"
        start = self.sensors[0] if len(self.sensors) == 1 else f"sensors at {place_text(self.sensor_at)}{unit}"
        return f"{start} → {self.actuator}"


@dataclass(frozen=True, eq=False)
class PoleShift:
    """The pole of one residual mode, without control and in the full closed loop.

    Attributes:
        mode: zero-based index.
        pole: open loop, upper half plane, rad/s; the slower one of a mode that does not oscillate.
        closed_pole: of the full closed loop, rad/s; the less stable one of the mode.
        paths: the most destabilising first; their shifts add up to the shift of the pole.
    """

    mode: int
    pole: complex
    closed_pole: complex
    paths: tuple[Path, ...]

    @property
    def shift(self) -> complex:
        """Shift of the pole, rad/s."""
        return self.closed_pole - self.pole

    @property
    def dominant(self) -> Path:
        """The path of the largest shift in the direction of the pole's own, to the left or to the right."""
        return max(self.paths, key=lambda path: path.shift.real * np.sign(self.shift.real))

    @property
    def first_order(self) -> complex:
        """The shift to first order; far from `shift` where the spillover is not small."""
        return sum(path.first_order for path in self.paths)


@former_fields(reduced_margin="reduced_decay_rate")
@dataclass(frozen=True, eq=False, repr=False)
class Explanation(Printed):
    """The closed loop of a controller on the full plant, with the pole shift of each residual mode.

    Attributes:
        loop: of all modes.
        shifts: of every residual mode, the least stable first.
        reduced_decay_rate: of the slowest pole of the loop of the controlled modes alone, 1/s.
        destabilising: the residual mode that makes the loop unstable: one whose pole is unstable, else the one without
            which the loop is stable (a stable residual mode can destabilise a controlled one). None where no pole is
            unstable, and where no single mode accounts for it, as when the loop of the controlled modes is unstable.
    """

    loop: ClosedLoop
    shifts: tuple[PoleShift, ...]
    reduced_decay_rate: float
    destabilising: PoleShift | None

    @property
    def limiting(self) -> PoleShift | None:
        """The residual mode that has the rightmost pole; None where a controlled mode or the controller has it."""
        first = self.shifts[0] if self.shifts else None
        return first if first and first.closed_pole.real == self.poles.real.max() else None

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        hz = self.loop.modes.frequencies_hz
        rows = [
            (str(s.mode + 1), *(f"{x:.4g}" for x in (hz[s.mode], s.pole.real, s.closed_pole.real)), s.dominant.text)
            for s in self.shifts
        ]
        cause = self.destabilising
        remarks = [f"controlled modes alone: decay rate {self.reduced_decay_rate:.3g} 1/s"]
        remarks += [f"mode {cause.mode + 1} makes the loop unstable"] if cause else []
        of_pole = "Re λ, open loop [1/s]", "Re λ, closed loop [1/s]"
        headings = ("residual mode", "frequency [Hz]", *of_pole, "dominant path")
        line = f"closed loop of {counted(self.loop.modes.n_modes, 'mode')}: {self.loop.stability_text}"
        return line, headings, rows, remarks

    @property
    def poles(self) -> np.ndarray:
        """Poles (n_states,) of the closed loop of all modes, rad/s."""
        return self.loop.poles

    @property
    def decay_rate(self) -> float:
        """Decay rate of the slowest pole of the loop, 1/s; negative where the loop is unstable."""
        return self.loop.decay_rate

    margin = Renamed("decay_rate")


def explain_spillover(modes: Modes, controller: Controller) -> Explanation:
    """The poles of the full closed loop, and the shift of each residual mode's pole, by path.

    Args:
        modes: of the full plant; those that the law does not control are residual.
        controller: from `filtered`, `luenberger_controller` or `kalman_controller`.

    Raises:
        DesignError: a law alone, which reads no sensor and so shifts no residual mode, or one that has no gain.
    """
    if not isinstance(controller, Controller):
        raise DesignError(
            f"{linear(controller).name} alone reads exact modal coordinates, so it shifts no residual mode; put it on"
            " an observer (luenberger_controller, kalman_controller) or through a modal filter, and give the controller"
        )
    loop = close_with(modes, controller)
    residual = [r for r in range(modes.n_modes) if r not in controller.law.controlled]
    open_loop = _open_loop_poles(modes)
    closed = [_nearest_pole(loop, pole) for pole in _poles_of(loop.matrix, modes.n_modes, residual)]
    matrices = input_matrix(modes, controller.law.actuators), reading(modes, controller.sensors)
    shifts = [
        _ResidualMode(modes, controller, *matrices, r, open_loop[r]).shifted(pole)
        for r, pole in zip(residual, closed, strict=True)
    ]
    shifts.sort(key=lambda m: -m.closed_pole.real)
    reduced = close_with(modes.select(controller.law.controlled), controller)
    cause = _destabilising(modes, controller, loop, shifts, not reduced.unstable_poles.size)
    return Explanation(loop, tuple(shifts), reduced.decay_rate, cause)


def _open_loop_poles(modes: Modes) -> list[complex]:
    """The open-loop pole of each mode, upper half plane; the slower one of a mode that does not oscillate."""
    if modes.proportional:
        c = np.diag(modes.damping)
        return [complex(pole) for pole in -0.5 * c + np.sqrt(0.25 * c**2 - modes.omega**2 + 0j)]
    return _poles_of(modes.state_matrix, modes.n_modes, range(modes.n_modes))


def _poles_of(matrix: Floats, n: int, wanted: Sequence[int]) -> list[complex]:
    """The pole of each wanted mode (zero-based, of n) in the upper half plane: the less stable of its two.

    Each mode is assigned two poles by the participation factors |w_k,r' v_k,r| of left and right eigenvectors: the
    sensitivity of pole k to the stiffness of mode r.
    """
    if not len(wanted):
        return []
    poles, left, right = eig(matrix, left=True, right=True)
    participation = np.abs(left[n : 2 * n] * right[:n])
    participation /= np.maximum(participation.sum(axis=0), np.finfo(float).tiny)
    _, own = linear_sum_assignment(participation[np.repeat(wanted, 2)], maximize=True)
    less_stable = (max(pair, key=lambda p: float(p.real)) for pair in poles[own].reshape(-1, 2))
    return [complex(pole.real, abs(pole.imag)) for pole in less_stable]


def _nearest_pole(loop: ClosedLoop, pole: complex) -> complex:
    """The nearest of `loop.poles`, so that two computations of one pole agree to the last digit."""
    nearest = loop.poles[np.abs(loop.poles - pole).argmin()]
    return complex(nearest.real, abs(nearest.imag))


def _destabilising(
    modes: Modes, controller: Controller, loop: ClosedLoop, shifts: list[PoleShift], reduced_stable: bool
) -> PoleShift | None:
    """The residual mode that destabilises a loop: an unstable one, else one without which the loop is stable."""
    if not loop.unstable_poles.size or not shifts:
        return None
    if reduced_stable and shifts[0].closed_pole.real > rounding(loop.poles):
        return shifts[0]

    def without(one: PoleShift) -> ClosedLoop:
        return close_with(modes.select([r for r in range(modes.n_modes) if r != one.mode]), controller)

    suspects = sorted(shifts, key=lambda m: -abs(m.shift))[:SUSPECTS]
    loops = [without(one) for one in suspects]
    best = int(np.argmax([each.decay_rate for each in loops]))
    return suspects[best] if not loops[best].unstable_poles.size else None


class _ResidualMode:
    """Residual mode r (zero-based), of open-loop pole λ, in the loop of the others, T = (I - C G)⁻¹ C of controller C.

    Args:
        inputs: (n_modes, n_actuators) modal forces per command.
        outputs: (n_channels, 2 n_modes) from the state to the readings.
    """

    def __init__(
        self, modes: Modes, controller: Controller, inputs: Floats, outputs: Floats, r: int, pole: complex
    ) -> None:
        self._modes, self._controller, self._inputs, self._outputs = modes, controller, inputs, outputs
        self._r, self._pole, self._others = r, pole, np.arange(modes.n_modes) != r
        coupled = not modes.proportional
        self._row, self._column = coupled * modes.damping[r, self._others], coupled * modes.damping[self._others, r]
        self._slowest = modes.omega[modes.omega > 0].min() if modes.omega.any() else 1.0

    def shifted(self, closed: complex) -> PoleShift:
        """The shift of the pole to that of the closed loop, by path."""
        exact = self._terms(closed)
        double = abs(self._slope(self._pole)) <= DOUBLE * abs(self._pole)
        first = np.full_like(exact, complex(np.nan, np.nan)) if double else self._terms(self._pole)
        paths, sensors = [], self._controller.sensors
        for (j, actuator), place in product(enumerate(self._controller.law.actuators), self._controller.places):
            here = [sensor.at == place for sensor in sensors]
            shift, first_order = complex(exact[j, here].sum()), complex(first[j, here].sum())
            paths.append(Path(actuator.name, place, shift, first_order, tuple(s.name for s in compress(sensors, here))))
        return PoleShift(self._r, self._pole, closed, tuple(sorted(paths, key=lambda path: -path.shift.real)))

    def _terms(self, s: complex) -> Complexes:
        """Terms (n_actuators, n_channels) of the shift Δ, evaluated at s."""
        r, others, n = self._r, self._others, self._modes.n_modes
        output = self._outputs[:, :n] + s * self._outputs[:, n:]  # readings per displacement, without lags and delays
        response = self._displacements(s, self._inputs[others])
        slope = self._slope(s)
        b = self._inputs[r] - s * self._row @ response
        c = output[:, r] - s * output[:, others] @ self._displacements(s, self._column[:, None])[:, 0]
        terms: Complexes = b[:, None] * self._forces(s, output[:, others] @ response) * c
        # one of a double pole may not move, as that of a rigid mode whose velocity alone is read
        return 0.0 * terms if abs(slope) <= DOUBLE * self._slowest else terms / slope

    def _forces(self, s: complex, plant: Complexes) -> Complexes:
        """T(s) (n_actuators, n_channels), with the plant G(s) of the other modes."""
        c = self._controller
        own = c.D + c.C @ np.linalg.solve(s * np.eye(len(c.A)) - c.A, c.B)
        own = self._lags(c.law.actuators, s)[:, None] * own * self._lags(c.sensors, s)
        # least squares, because the matrix is singular where the loop without mode r has the pole s too, as with
        # several rigid modes that one sensor reads
        return np.asarray(np.linalg.lstsq(np.eye(len(own)) - own @ plant, own, rcond=None)[0])

    def _slope(self, s: complex) -> complex:
        """E(s), without cancellation: Z(s)⁻¹ - Z(λ)⁻¹ by the resolvent identity."""
        damping, others, own = self._modes.damping, self._others, s + self._pole
        uncoupled = complex(own + damping[self._r, self._r])
        if self._modes.proportional:
            return uncoupled
        response = self._displacements(self._pole, self._column[:, None])
        between = own * response + damping[np.ix_(others, others)] @ response
        inner = self._displacements(s, own * self._column[:, None] - self._pole**2 * between)
        return uncoupled - complex(self._row @ inner[:, 0])

    def _displacements(self, s: complex, forces: np.ndarray) -> Complexes:
        """Z(s)⁻¹ F: modal displacements (n_others, n) of the other modes under modal forces F (n_others, n) on them."""
        modes, others = self._modes, self._others
        diagonal = s**2 + s * np.diag(modes.damping)[others] + modes.omega[others] ** 2
        # an undamped mode equal to mode r has an infinite response at their pole: a small stiffness bounds it
        diagonal = np.where(diagonal == 0, TWIN * max(abs(s), self._slowest) ** 2, diagonal)
        if modes.proportional:
            return np.asarray(forces / diagonal[:, None])
        stiffness = s * modes.damping[np.ix_(others, others)]
        np.fill_diagonal(stiffness, diagonal)
        return np.asarray(np.linalg.solve(stiffness, forces))

    def _lags(self, parts: Sequence[Actuator | Sensor], s: complex) -> Complexes:
        """Transfer functions (n_parts,) of the lag and delay of each actuator or sensor at s."""
        transfer = np.ones(len(parts), complex)
        for j, part in enumerate(parts):
            for _, (a, b, c) in lateness(part, self._modes):
                transfer[j] *= c @ np.linalg.solve(s * np.eye(len(b)) - a, b)
        return transfer
