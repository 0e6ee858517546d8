"""Which residual mode a design destabilises on the full plant, and by which path from sensor to actuator.

Without mode r the rest of the loop answers readings y with forces T(s) y. Mode r closes that loop at s = λ + Δ:

    (s - λ) E(s) = b_r(s)ᵀ T(s) c_r(s),   so   Δ = Σ_ji b_rj T_ji c_ir / E(s),

one term for each actuator j and sensor i. E(s) = s - λ', the mode's other pole, λ* where it oscillates. Damping that
couples mode r and the others, of dynamic stiffness Z(s), by the row d and the column e of s C, has it move through
these: b_r - d Z⁻¹ B stands for b_r, c_r - c Z⁻¹ e for c_r, and (s - λ) E(s) = s² + s c_rr + ω_r² - d Z⁻¹ e, λ a pole
of the structure with all its damping. At s = λ this is the perturbation of the eigenvalue to first order; at the pole
of the full loop it is exact. Either spillover at zero, b_r or c_r, leaves the mode where it was (Balas 1978).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eig
from scipy.optimize import linear_sum_assignment

from workbench.arrays import Complexes, Flags, Floats
from workbench.design.estimation.controller import Controller, reading
from workbench.design.laws.law import DesignError, linear
from workbench.design.loop.closed_loop import ClosedLoop, close_with, rounding
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.rig.statespace import input_matrix, lateness
from workbench.structure.domain import Place
from workbench.structure.modes import Modes
from workbench.structure.printed import Printed, counted, place_text

TWIN = 1e-12
DOUBLE = 1e-7  # of their size: nearer, both poles of a mode are one, whose shift has no first order
SUSPECTS = 12  # residual modes, the most shifts, whose absence is tried


@dataclass(frozen=True, eq=False)
class Path:
    """How far one actuator, driven by the sensors at one place, shifts a mode's pole.

    Attributes:
        actuator: name.
        sensor_at: place of the sensors; all the channels read there count together.
        shift: its share of the exact shift, rad/s; the real part is what it adds to the growth.
        first_order: the same from the open-loop pole; nan of a mode whose two poles are one, rigid or of ζ = 1.
    """

    actuator: str
    sensor_at: Place
    shift: complex
    first_order: complex

    @property
    def text(self) -> str:
        """From where to where, in words."""
        return f"{place_text(self.sensor_at)} to {self.actuator}"


@dataclass(frozen=True, eq=False)
class PoleShift:
    """The pole of one residual mode, without control and in the full closed loop.

    Attributes:
        mode: zero-based index.
        pole: open loop, upper half plane, rad/s; the slower one of a mode that does not oscillate.
        closed_pole: of the full closed loop; the least stable one that is the mode's.
        paths: the most destabilising first; their shifts add up to that of the pole.
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
        """The path that shifts the pole most the way that it goes, to the left or to the right."""
        return max(self.paths, key=lambda path: path.shift.real * np.sign(self.shift.real))

    @property
    def first_order(self) -> complex:
        """The shift to first order; far from `shift` where the spillover is not small."""
        return sum(path.first_order for path in self.paths)


@dataclass(frozen=True, eq=False, repr=False)
class Explanation(Printed):
    """A controller on the full plant.

    Attributes:
        loop: of all modes.
        shifts: every residual mode, the least stable first.
        reduced_margin: of the loop of the controlled modes alone, 1/s.
        destabilising: the residual mode that makes the loop unstable: one that grows, else the one without which the
            loop is stable (a residual mode can stay stable itself and make a controlled one grow). None where the loop
            is stable, and where no single mode accounts for it, as when the reduced model fails already.
    """

    loop: ClosedLoop
    shifts: tuple[PoleShift, ...]
    reduced_margin: float
    destabilising: PoleShift | None

    @property
    def limiting(self) -> PoleShift | None:
        """The residual mode that has the rightmost pole; None where a controlled mode or the controller has it."""
        first = self.shifts[0] if self.shifts else None
        return first if first and first.closed_pole.real == self.poles.real.max() else None

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        rate = {"stable": f", margin {self.margin:.3g} 1/s", "unstable": f", growth rate {-self.margin:.3g} 1/s"}
        state = self.loop.stability + rate.get(self.loop.stability, "")
        rows = [
            (
                str(each.mode + 1),
                f"{self.loop.modes.frequencies_hz[each.mode]:.4g}",
                f"{each.pole.real:.4g}",
                f"{each.closed_pole.real:.4g}",
                each.dominant.text,
            )
            for each in self.shifts
        ]
        behind = self.destabilising
        remarks = (
            f"controlled modes alone: margin {self.reduced_margin:.3g} 1/s",
            *((f"mode {behind.mode + 1} makes the loop unstable",) if behind else ()),
        )
        headings = (
            "residual mode",
            "frequency [Hz]",
            "Re λ, open loop [1/s]",
            "Re λ, closed loop [1/s]",
            "dominant path",
        )
        return f"closed loop of {counted(self.loop.modes.n_modes, 'mode')}: {state}", headings, rows, remarks

    @property
    def poles(self) -> np.ndarray:
        """Of the whole closed loop, rad/s."""
        return self.loop.poles

    @property
    def margin(self) -> float:
        """Distance of the rightmost pole from the axis, 1/s; negative where the loop is unstable."""
        return self.loop.margin


def explain_spillover(modes: Modes, controller: Controller) -> Explanation:
    """The poles of the full closed loop, and what shifts that of each residual mode, by path.

    Args:
        modes: of the fuller plant; those that the law does not control are residual.
        controller: from `filtered`, `luenberger` or `kalman`.

    Raises:
        DesignError: a law alone, which reads no sensor and so shifts no residual mode, or one that has no gain.
    """
    if not isinstance(controller, Controller):
        raise DesignError(
            f"{linear(controller).name} alone reads exact modal coordinates, so it shifts no residual mode; put it on"
            " an observer (luenberger, kalman) or through a modal filter, and give the controller"
        )
    loop = close_with(modes, controller)
    rest = _Rest(modes, controller)
    residual = [r for r in range(modes.n_modes) if r not in controller.law.controlled]
    free = _free_poles(modes)
    closed = [_as_of(loop, pole) for pole in _poles_of(loop.matrix, modes.n_modes, residual)]
    shifts = [_OneMode(rest, r, free[r]).shifted(pole) for r, pole in zip(residual, closed, strict=True)]
    shifts.sort(key=lambda m: -m.closed_pole.real)
    alone = close_with(modes.select(controller.law.controlled), controller)
    return Explanation(loop, tuple(shifts), alone.margin, _behind(modes, controller, loop, shifts, alone.stable))


def _free_poles(modes: Modes) -> list[complex]:
    """The pole of each mode without control, upper half plane; the slower one of a mode that does not oscillate."""
    if modes.proportional:
        c = np.diag(modes.damping)
        return [complex(pole) for pole in -0.5 * c + np.sqrt(0.25 * c**2 - modes.omega**2 + 0j)]
    return _poles_of(modes.state_matrix, modes.n_modes, range(modes.n_modes))


def _poles_of(matrix: Floats, n: int, wanted: Sequence[int]) -> list[complex]:
    """The pole of each mode wanted, of n, upper half plane: of the two that are its own, the less stable.

    Modes share out the poles by |w_k,r' v_k,r|, left and right eigenvectors: how much a stiffer mode r moves pole k.
    """
    if not len(wanted):
        return []
    poles, left, right = eig(matrix, left=True, right=True)
    share = np.abs(left[n : 2 * n] * right[:n])
    share /= np.maximum(share.sum(axis=0), np.finfo(float).tiny)
    _, own = linear_sum_assignment(share[np.repeat(wanted, 2)], maximize=True)
    found = (max(pair, key=lambda p: float(p.real)) for pair in poles[own].reshape(-1, 2))
    return [complex(pole.real, abs(pole.imag)) for pole in found]


def _as_of(loop: ClosedLoop, pole: complex) -> complex:
    """The same pole to the last digit as the loop has it."""
    found = loop.poles[np.abs(loop.poles - pole).argmin()]
    return complex(found.real, abs(found.imag))


def _behind(
    modes: Modes, controller: Controller, loop: ClosedLoop, shifts: list[PoleShift], stable_alone: bool
) -> PoleShift | None:
    """The residual mode that destabilises a loop: one that grows, else one without which the loop is stable."""
    if loop.stable or not shifts:
        return None
    if stable_alone and shifts[0].closed_pole.real > rounding(loop.poles):
        return shifts[0]

    def without(one: PoleShift) -> ClosedLoop:
        return close_with(modes.select([r for r in range(modes.n_modes) if r != one.mode]), controller)

    suspects = sorted(shifts, key=lambda m: -abs(m.shift))[:SUSPECTS]
    loops = [without(one) for one in suspects]
    best = int(np.argmax([each.margin for each in loops]))
    return suspects[best] if loops[best].stable else None


class _Rest:
    """A loop from which one mode at a time is taken out: T = (I - C G)⁻¹ C, C the controller and G all other modes."""

    def __init__(self, modes: Modes, controller: Controller) -> None:
        self.modes, self.controller, self._apart = modes, controller, modes.proportional
        self.slowest = modes.omega[modes.omega > 0].min() if modes.omega.any() else 1.0
        self.pushed = input_matrix(modes, controller.law.actuators)
        self.seen = reading(modes, controller.sensors)

    def forces(self, r: int, s: complex) -> np.ndarray:
        """T(s) (n_actuators, n_channels) without mode r."""
        c, others = self.controller, np.arange(self.modes.n_modes) != r
        plant = self.read(s)[:, others] @ self.moved(others, s, self.pushed[others])
        own = c.direct + c.commands @ np.linalg.solve(s * np.eye(len(c.state)) - c.state, c.reads)
        own = self._late(c.law.actuators, s)[:, None] * own * self._late(c.sensors, s)
        # least squares: where the rest has this pole too, as of several rigid modes that one sensor reads, no one
        # solution is the mode's share of it
        return np.asarray(np.linalg.lstsq(np.eye(len(own)) - own @ plant, own, rcond=None)[0])

    def read(self, s: complex) -> Complexes:
        """(n_channels, n_modes): what the sensors read of each mode, before their own lags and delays."""
        n = self.modes.n_modes
        return np.asarray(self.seen[:, :n] + s * self.seen[:, n:])

    def moved(self, others: Flags, s: complex, forces: np.ndarray) -> Complexes:
        """Z(s)⁻¹ forces: how modal forces (n_others, n) on some modes move these."""
        diagonal = s**2 + s * np.diag(self.modes.damping)[others] + self.modes.omega[others] ** 2
        # an undamped twin of the mode answers without bound at their pole: a hair beside it
        diagonal = np.where(diagonal == 0, TWIN * max(abs(s), self.slowest) ** 2, diagonal)
        if self._apart:
            return np.asarray(forces / diagonal[:, None])
        stiff = s * self.modes.damping[np.ix_(others, others)]
        np.fill_diagonal(stiff, diagonal)
        return np.asarray(np.linalg.solve(stiff, forces))

    def _late(self, parts: Sequence[Actuator | Sensor], s: complex) -> Complexes:
        """What lag and delay of each part make of a signal at s, (n_parts,)."""
        found = np.ones(len(parts), complex)
        for j, part in enumerate(parts):
            for _, (a, b, c) in lateness(part, self.modes):
                found[j] *= c @ np.linalg.solve(s * np.eye(len(b)) - a, b)
        return found


class _OneMode:
    """One residual mode in the loop of all the rest."""

    def __init__(self, rest: _Rest, r: int, pole: complex) -> None:
        self._rest, self._r, self.pole = rest, r, pole
        damping, self._others = rest.modes.damping, np.arange(rest.modes.n_modes) != r
        coupled = not rest.modes.proportional
        self._by, self._on = coupled * damping[r, self._others], coupled * damping[self._others, r]

    def _slope(self, s: complex) -> complex:
        """E(s), without the difference of what is nearly equal: Z(s)⁻¹ - Z(λ)⁻¹ by the resolvent identity."""
        rest, others, own = self._rest, self._others, s + self.pole
        alone = complex(own + rest.modes.damping[self._r, self._r])
        if rest.modes.proportional:
            return alone
        answer = rest.moved(others, self.pole, self._on[:, None])
        between = own * answer + rest.modes.damping[np.ix_(others, others)] @ answer
        inner = rest.moved(others, s, own * self._on[:, None] - self.pole**2 * between)
        return alone - complex(self._by @ inner[:, 0])

    def _terms(self, s: complex) -> Complexes:
        """Shares (n_actuators, n_channels) of the movement that s would be."""
        rest, others = self._rest, self._others
        read, slope = rest.read(s), self._slope(s)
        pushed = rest.pushed[self._r] - s * self._by @ rest.moved(others, s, rest.pushed[others])
        seen = read[:, self._r] - s * read[:, others] @ rest.moved(others, s, self._on[:, None])[:, 0]
        terms: Complexes = pushed[:, None] * rest.forces(self._r, s) * seen
        # of a double pole one may stay, that of a rigid mode whose velocity alone is read say: nothing moves it
        return 0.0 * terms if abs(slope) <= DOUBLE * rest.slowest else terms / slope

    def shifted(self, closed: complex) -> PoleShift:
        return PoleShift(self._r, self.pole, closed, self._paths(closed))

    def _paths(self, closed: complex) -> tuple[Path, ...]:
        exact = self._terms(closed)
        double = abs(self._slope(self.pole)) <= DOUBLE * abs(self.pole)
        first = np.full_like(exact, complex(np.nan, np.nan)) if double else self._terms(self.pole)
        sensors = self._rest.controller.sensors
        found = []
        for j, actuator in enumerate(self._rest.controller.law.actuators):
            for place in self._rest.controller.places:
                here = [sensor.at == place for sensor in sensors]
                found.append(Path(actuator.name, place, complex(exact[j, here].sum()), complex(first[j, here].sum())))
        return tuple(sorted(found, key=lambda path: -path.shift.real))
