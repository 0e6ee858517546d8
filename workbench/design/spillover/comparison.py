"""Several laws on the same structure after the same impulse: cost, effort, spillover and poles side by side."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from workbench.design.estimation.controller import Controller, filtered
from workbench.design.estimation.modal_filter import filter_on
from workbench.design.estimation.observers import luenberger, usual_poles
from workbench.design.laws.coupled import coupled_lqr, coupled_poles
from workbench.design.laws.imsc import imsc, imsc_poles
from workbench.design.laws.law import DesignError, Law, controlled_indices, numbered
from workbench.design.loop.closed_loop import close_loop, peak_force
from workbench.design.spillover.explain import Explanation, explain_spillover
from workbench.design.spillover.spillover import Spillover, check_final_time, effort, finite_spillover, quadratic_cost
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.structure.domain import NamedPoints, Place
from workbench.structure.member import Structure
from workbench.structure.modes import Modes, freeze
from workbench.structure.plate import Membrane, Plate
from workbench.threads import one_blas_thread


@dataclass(frozen=True, eq=False)
class Compared:
    """What one law does and costs.

    Attributes:
        law: it.
        cost: ∫ (Σ q_r'² + ω_r² q_r² + R FᵀF) dt of the controlled modes, over all time.
        effort: ∫ FᵀF dt over all time.
        peak_force: largest |F| of any actuator up to the final time, at any instant, to a millionth.
        work: in every mode up to the final time.
        poles: (n_states,) of the loop through exact modal coordinates, rad/s.
        stability: of that loop, as of a `ClosedLoop`.
    """

    law: Law
    cost: float
    effort: float
    peak_force: float
    work: Spillover
    poles: np.ndarray
    stability: str

    def __post_init__(self) -> None:
        freeze(self, "poles", dtype=complex)

    @property
    def most_excited(self) -> int | None:
        """Zero-based index of the residual mode that takes the most work; None where no mode is residual."""
        residual = self.work.residual
        return residual[int(np.argmax(self.work.residual_work))] if residual else None


def laws_of(
    modes: Modes, controlled: int, actuators: Sequence[Actuator], *, weight: float, damping: float | None = None
) -> tuple[list[Law], list[str]]:
    """The laws to be had, IMSC and coupled LQR, and by poles of a damping ratio where one is given; why others are not.

    Raises:
        DesignError: no law is to be had.
    """
    makers: list[Callable[[], Law]] = [lambda: imsc(modes, controlled, actuators, weight=weight)]
    coupled: list[Callable[[], Law]] = [lambda: coupled_lqr(modes, controlled, actuators, weight=weight)]
    refused: list[str] = []
    if damping is not None and not 0 < damping < 1:
        raise DesignError(f"the damping ratio wanted must lie between 0 and 1; got {damping:g}")
    omega = modes.omega[list(controlled_indices(modes, controlled))]
    rigid = numbered(np.flatnonzero(omega == 0).tolist())
    if damping is not None and rigid:
        refused.append(
            f"no law by poles, for what is rigid (mode {rigid}) has no damping ratio; design by the weight, or give"
            " poles of its own to coupled_poles"
        )
    elif damping is not None:
        poles = omega * (-damping + 1j * np.sqrt(1 - damping**2))
        makers.append(lambda: imsc_poles(modes, controlled, actuators, poles=poles))
        coupled.append(lambda: coupled_poles(modes, controlled, actuators, poles=poles))
    if controlled <= len(actuators):
        return [make() for make in (*makers, *coupled)], refused
    why = f"IMSC needs as many actuators as controlled modes, {controlled}; there are {len(actuators)}: add actuators"
    return [make() for make in coupled], [why, *refused]


@one_blas_thread
def compare(
    modes: Modes, laws: Sequence[Law], state: np.ndarray, *, weight: float, final_time: float
) -> tuple[Compared, ...]:
    """Each law's cost, effort, peak force, work by mode and poles, from the same state (2 n_modes,).

    Args:
        modes: controlled and residual.
        laws: to compare; all control the same modes if the costs are to mean the same.
        state: at t = 0; residual modes at rest make W_r what control alone puts there.
        weight: R of the cost.
        final_time: s, of work and peak force.
    """
    check_final_time(final_time)
    rows = []
    for law in laws:
        loop = close_loop(modes, law)
        rows.append(
            Compared(
                law=law,
                cost=quadratic_cost(modes, law, state, weight),
                effort=effort(modes, law, state),
                peak_force=peak_force(loop, state, final_time),
                work=finite_spillover(loop, state, final_time),
                poles=loop.poles,
                stability=loop.stability,
            )
        )
    return tuple(rows)


def through_sensors(
    modes: Modes, laws: Sequence[Law], places: Sequence[Place], structure: Structure | Plate | Membrane | None
) -> tuple[tuple[Controller | None, Explanation | None, str], ...]:
    """Each law on what sensors of displacement and velocity at the places read: a modal filter, a Luenberger observer.

    Args:
        modes: controlled and residual.
        laws: to try.
        places: of the sensors.
        structure: whose mass the filters need, but at named points; none are tried where it is needed and not known.

    Returns:
        Controller, explanation on the full plant, and where it cannot be, (None, None, why).
    """
    stands = sorted(dict.fromkeys(places))
    tried: list[tuple[Controller | None, Explanation | None, str]] = []
    ways = (True, False) if structure is not None or isinstance(modes.domain, NamedPoints) else (False,)
    for law in laws:
        sensors = [Sensor(f"y{i + 1}", x) for i, x in enumerate(stands)]
        for by_filter in ways:
            try:
                if by_filter:
                    controller = filtered(law, filter_on(structure, modes, law.controlled, stands))
                else:
                    controller = luenberger(modes, law, sensors, poles=usual_poles(modes, law.controlled))
                tried.append((controller, explain_spillover(modes, controller), ""))
            except ValueError as error:
                tried.append((None, None, f"{law.name}: {error}"))
    return tuple(tried)
