"""Which residual mode a design destabilises on the full plant, and by which path from sensor to actuator.

Without mode r the rest of the loop answers readings y with forces T(s) y. Mode r closes that loop at s = λ + Δ:

    (s - λ)(s - λ*) = b_rᵀ T(s) c_r(s),   so   Δ = Σ_ji b_rj T_ji(s) c_ir(s) / (s - λ*),

one term for each actuator j and sensor i. At s = λ this is the perturbation of the eigenvalue to first order; at the
pole of the full loop it is exact. Either spillover at zero, b_r or c_r, leaves the mode where it was (Balas 1978).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from workbench.arrays import Complexes
from workbench.design.estimation.controller import Controller, reading
from workbench.design.loop.closed_loop import ClosedLoop, close_with
from workbench.rig.statespace import input_matrix
from workbench.structure.domain import Place
from workbench.structure.modes import Modes
from workbench.structure.printed import Printed, counted, place_text

SECANT_STEPS = 40
TWIN = 1e-12
SUSPECTS = 12  # residual modes, the most shifts, whose absence is tried


@dataclass(frozen=True, eq=False)
class Path:
    """How far one actuator, driven by the sensors at one place, shifts a mode's pole.

    Attributes:
        actuator: name.
        sensor_at: place of the sensors; all the channels read there count together.
        shift: its share of the exact shift, rad/s; the real part is what it adds to the growth.
        first_order: the same from the open-loop pole.
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
        pole: open loop, upper half plane, rad/s.
        closed_pole: of the full closed loop.
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

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        grows = f"unstable, growth rate {-self.margin:.3g} 1/s"
        state = f"stable, margin {self.margin:.3g} 1/s" if self.loop.stable else grows
        rows = [
            (
                str(each.mode + 1),
                f"{abs(each.pole) / (2 * np.pi):.4g}",
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
    """
    loop = close_with(modes, controller)
    residual = [r for r in range(modes.n_modes) if r not in controller.law.controlled]
    poles = loop.poles
    upper = poles[poles.imag > 0]
    shifts = []
    if residual:
        rest = _Rest(modes, controller)
        at = [_OneMode(rest, r) for r in residual]
        far = np.abs(np.array([mode.closed_pole() for mode in at])[:, None] - upper[None, :])
        for i, k in zip(*linear_sum_assignment(far), strict=True):
            closed = complex(upper[k])
            shifts.append(PoleShift(residual[i], at[i].pole, closed, at[i].paths(closed)))
    shifts.sort(key=lambda m: -m.closed_pole.real)
    alone = close_with(modes.select(controller.law.controlled), controller)
    return Explanation(loop, tuple(shifts), alone.margin, _behind(modes, controller, loop, shifts))


def _behind(modes: Modes, controller: Controller, loop: ClosedLoop, shifts: list[PoleShift]) -> PoleShift | None:
    """The residual mode that destabilises a loop: one that grows, else one without which the loop is stable."""
    if loop.stable or not shifts:
        return None
    if shifts[0].closed_pole.real > 0:
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
            plant = (seen / np.where(stiff == 0, TWIN * abs(s) ** 2, stiff)) @ pushed
        else:
            stiff = np.diag(s**2 + self.modes.omega[others] ** 2) + s * self.modes.damping[np.ix_(others, others)]
            plant = seen @ np.linalg.solve(stiff, pushed)
        own = c.direct + c.commands @ np.linalg.solve(s * np.eye(len(c.state)) - c.state, c.reads)
        return np.linalg.solve(np.eye(len(own)) - own @ plant, own)


class _OneMode:
    """One residual mode in the loop of all the rest."""

    def __init__(self, rest: _Rest, r: int) -> None:
        modes = rest.modes
        self._rest, self._r = rest, r
        self._pushed, self._seen = rest.pushed[r], rest.seen[:, [r, modes.n_modes + r]]
        c, omega = modes.damping[r, r], modes.omega[r]
        self.pole = complex(-0.5 * c + 1j * np.sqrt(max(omega**2 - 0.25 * c**2, 0.0)))

    def _terms(self, s: complex) -> Complexes:
        """Shares (n_actuators, n_channels) of the movement that s would be."""
        forces, read = self._rest.forces(self._r, s), self._seen @ np.array([1.0, s])
        terms: Complexes = self._pushed[:, None] * forces * read / (s - self.pole.conjugate())
        return terms

    def closed_pole(self) -> complex:
        """Where the mode goes: s = λ + Δ(s) by the secant method, else to first order."""
        first = complex(self.pole + self._terms(self.pole).sum())
        near, s = self.pole, first
        miss = near - first
        for _ in range(SECANT_STEPS):
            now = complex(s - self.pole - self._terms(s).sum())
            if abs(now) < 1e-12 * abs(s) or now == miss:
                break
            near, s, miss = s, s - now * (s - near) / (now - miss), now
        return s if abs(s - self.pole) < 0.5 * abs(self.pole) else first

    def paths(self, closed: complex) -> tuple[Path, ...]:
        exact, first = self._terms(closed), self._terms(self.pole)
        sensors = self._rest.controller.sensors
        found = []
        for j, actuator in enumerate(self._rest.controller.law.actuators):
            for place in self._rest.controller.places:
                here = [sensor.at == place for sensor in sensors]
                found.append(Path(actuator.name, place, complex(exact[j, here].sum()), complex(first[j, here].sum())))
        return tuple(sorted(found, key=lambda path: -path.shift.real))
