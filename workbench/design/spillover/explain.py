"""Which residual mode a design destabilises on the full plant, and by which path from sensor to actuator.

Without mode r the rest of the loop answers readings y with forces T(s) y. Mode r closes that loop at s = λ + Δ:

    (s - λ)(s - λ') = b_rᵀ T(s) c_r(s),   so   Δ = Σ_ji b_rj T_ji(s) c_ir(s) / (s - λ'),

one term for each actuator j and sensor i; λ' is the mode's other pole, λ* where it oscillates. At s = λ this is the
perturbation of the eigenvalue to first order; at the pole of the full loop it is exact. Either spillover at zero, b_r
or c_r, leaves the mode where it was (Balas 1978).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eig
from scipy.optimize import linear_sum_assignment

from workbench.arrays import Complexes
from workbench.design.estimation.controller import Controller, reading
from workbench.design.laws.law import DesignError, linear
from workbench.design.loop.closed_loop import ClosedLoop, close_with
from workbench.rig.statespace import input_matrix
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
                f"{place_text(each.paths[0].sensor_at)} to {each.paths[0].actuator}",
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
    shifts = [_OneMode(rest, r).shifted(pole) for r, pole in zip(residual, _poles_of(loop, residual), strict=True)]
    shifts.sort(key=lambda m: -m.closed_pole.real)
    alone = close_with(modes.select(controller.law.controlled), controller)
    return Explanation(loop, tuple(shifts), alone.margin, _behind(modes, controller, loop, shifts, alone.stable))


def _poles_of(loop: ClosedLoop, residual: Sequence[int]) -> list[complex]:
    """The pole of each residual mode in the loop, upper half plane: of the two that are its own, the less stable.

    Modes share out the poles by |w_k,r' v_k,r|, left and right eigenvectors: how much a stiffer mode r moves pole k.
    """
    if not residual:
        return []
    n = loop.modes.n_modes
    poles, left, right = eig(loop.matrix, left=True, right=True)
    share = np.abs(left[n : 2 * n] * right[:n])
    share /= np.maximum(share.sum(axis=0), np.finfo(float).tiny)
    _, own = linear_sum_assignment(share[np.repeat(residual, 2)], maximize=True)
    found = []
    for pair in poles[own].reshape(-1, 2):
        pole = max(pair, key=lambda p: float(p.real))
        pole = loop.poles[np.abs(loop.poles - pole).argmin()]
        found.append(complex(pole.real, abs(pole.imag)))
    return found


def _behind(
    modes: Modes, controller: Controller, loop: ClosedLoop, shifts: list[PoleShift], stable_alone: bool
) -> PoleShift | None:
    """The residual mode that destabilises a loop: one that grows, else one without which the loop is stable."""
    if loop.stable or not shifts:
        return None
    if stable_alone and shifts[0].closed_pole.real > 0:
        return shifts[0]

    def margin_without(one: PoleShift) -> float:
        return close_with(modes.select([r for r in range(modes.n_modes) if r != one.mode]), controller).margin

    suspects = sorted(shifts, key=lambda m: -abs(m.shift))[:SUSPECTS]
    margins = [margin_without(one) for one in suspects]
    best = int(np.argmax(margins))
    return suspects[best] if margins[best] > 0 else None


class _Rest:
    """A loop from which one mode at a time is taken out: T = (I - C G)⁻¹ C, C the controller and G all other modes."""

    def __init__(self, modes: Modes, controller: Controller) -> None:
        self.modes, self.controller, self._apart = modes, controller, modes.proportional
        self.slowest = modes.omega[modes.omega > 0].min() if modes.omega.any() else 1.0
        self.pushed = input_matrix(modes, controller.law.actuators)
        self.seen = reading(modes, controller.sensors)

    def forces(self, r: int, s: complex) -> np.ndarray:
        """T(s) (n_actuators, n_channels) without mode r."""
        n, c = self.modes.n_modes, self.controller
        others = np.arange(n) != r
        seen = self.seen[:, :n][:, others] + s * self.seen[:, n:][:, others]
        pushed = self.pushed[others]
        if self._apart:
            stiff = s**2 + s * np.diag(self.modes.damping)[others] + self.modes.omega[others] ** 2
            # an undamped twin of the mode answers without bound at their pole: a hair beside it
            hair = TWIN * max(abs(s), self.slowest) ** 2
            plant = (seen / np.where(stiff == 0, hair, stiff)) @ pushed
        else:
            stiff = np.diag(s**2 + self.modes.omega[others] ** 2) + s * self.modes.damping[np.ix_(others, others)]
            plant = seen @ np.linalg.solve(stiff, pushed)
        own = c.direct + c.commands @ np.linalg.solve(s * np.eye(len(c.state)) - c.state, c.reads)
        # least squares: where the rest has this pole too, as of several rigid modes that one sensor reads, no one
        # solution is the mode's share of it
        return np.asarray(np.linalg.lstsq(np.eye(len(own)) - own @ plant, own, rcond=None)[0])


class _OneMode:
    """One residual mode in the loop of all the rest."""

    def __init__(self, rest: _Rest, r: int) -> None:
        modes = rest.modes
        self._rest, self._r = rest, r
        self._pushed, self._seen = rest.pushed[r], rest.seen[:, [r, modes.n_modes + r]]
        c, omega = modes.damping[r, r], modes.omega[r]
        self.pole = complex(-0.5 * c + np.sqrt(complex(0.25 * c**2 - omega**2)))
        self._other = -c - self.pole

    def _terms(self, s: complex) -> Complexes:
        """Shares (n_actuators, n_channels) of the movement that s would be."""
        forces, read = self._rest.forces(self._r, s), self._seen @ np.array([1.0, s])
        terms: Complexes = self._pushed[:, None] * forces * read
        # of a double pole one may stay, that of a rigid mode whose velocity alone is read say: nothing moves it
        stays = abs(s - self._other) <= DOUBLE * self._rest.slowest
        return 0.0 * terms if stays else terms / (s - self._other)

    def shifted(self, closed: complex) -> PoleShift:
        return PoleShift(self._r, self.pole, closed, self._paths(closed))

    def _paths(self, closed: complex) -> tuple[Path, ...]:
        exact = self._terms(closed)
        double = abs(self.pole - self._other) <= DOUBLE * abs(self.pole)
        first = np.full_like(exact, complex(np.nan, np.nan)) if double else self._terms(self.pole)
        sensors = self._rest.controller.sensors
        found = []
        for j, actuator in enumerate(self._rest.controller.law.actuators):
            for place in self._rest.controller.places:
                here = [sensor.at == place for sensor in sensors]
                found.append(Path(actuator.name, place, complex(exact[j, here].sum()), complex(first[j, here].sum())))
        return tuple(sorted(found, key=lambda path: -path.shift.real))
