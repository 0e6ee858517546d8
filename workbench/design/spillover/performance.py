"""Performance of designs after a disturbance: cost, effort, spillover and stability of one, or of several compared."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from workbench.design.estimation.controller import Controller, filtered
from workbench.design.estimation.modal_filter import filter_on
from workbench.design.estimation.observers import luenberger_controller, usual_poles
from workbench.design.laws.coupled import coupled_lqr, coupled_poles
from workbench.design.laws.imsc import imsc, imsc_poles
from workbench.design.laws.law import DesignError, Law, controlled_indices, numbered
from workbench.design.laws.on_off import OnOffLaw
from workbench.design.loop.closed_loop import ClosedLoop, close_loop, peak_force
from workbench.design.spillover.explain import Explanation, explain_spillover
from workbench.design.spillover.spillover import (
    Spillover,
    check_final_time,
    effort,
    finite_spillover,
    on_off_motion,
    quadratic_cost,
    second_moments,
    work_by_mode,
)
from workbench.renamed import Renamed, former_fields
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.rig.statespace import input_matrix
from workbench.structure.domain import NamedPoints, Place
from workbench.structure.member import Structure
from workbench.structure.modes import Modes, freeze
from workbench.structure.plate import Membrane, Plate
from workbench.threads import one_blas_thread


@former_fields(margin="decay_rate")
@dataclass(frozen=True)
class Performance:
    """Performance of a design up to the final time; cost, effort and W_R are infinite where a pole is unstable.

    Attributes:
        cost: ∫ (Σ q_r'² + ω_r² q_r² + R FᵀF) dt, Σ over the controlled modes, by their true coordinates.
        effort: ∫ FᵀF dt.
        spillover: W_R, work in the residual modes.
        decay_rate: of the slowest pole, 1/s; nan for on-off control, which has no poles.
    """

    cost: float
    effort: float
    spillover: float
    decay_rate: float

    spilled = Renamed("spillover")


def performance(loop: ClosedLoop, state: np.ndarray, *, weight: float, final_time: float) -> Performance:
    """The performance of a linear loop, exact: integrals of quadratic forms of the state by one matrix exponential.

    Args:
        loop: from `close_loop` or `close_with`.
        state: (2 n_modes,) at t = 0; an observer starts from zero.
        weight: R of the actuator forces.
        final_time: s.
    """
    check_weight(weight)
    check_final_time(final_time)
    modes, n = loop.modes, loop.modes.n_modes
    rate = loop.decay_rate
    if loop.unstable_poles.size:
        return Performance(np.inf, np.inf, np.inf, rate)
    moments = second_moments(loop.matrix, loop.start(state), final_time)
    own, squares = list(loop.law.controlled), np.diag(moments)
    energy = modes.omega[own] ** 2 @ squares[own] + squares[[n + r for r in own]].sum()
    used = float(np.trace(loop.feedback @ moments @ loop.feedback.T))
    spillover = float(np.delete(work_by_mode(loop, moments), own).sum())
    return Performance(float(energy) + weight * used, used, spillover, rate)


def on_off_performance(
    modes: Modes, law: OnOffLaw, state: np.ndarray, *, weight: float, final_time: float
) -> Performance:
    """The performance of on-off control, from its exact motion, integrated from switching to switching.

    Raises:
        DesignError: an actuator that `respond_on_off` refuses.
    """
    check_weight(weight)
    check_final_time(final_time)
    response, weights = on_off_motion(modes, law, state, final_time)
    used = float((response.forces**2).sum(axis=0) @ weights)
    energy = float(2.0 * response.energy[list(law.controlled)].sum(axis=0) @ weights)
    rest = [r for r in range(modes.n_modes) if r not in law.controlled]
    power = (input_matrix(modes, law.actuators)[rest] @ response.forces) * response.modal[modes.n_modes :][rest]
    return Performance(energy + weight * used, used, float((power @ weights).sum()), np.nan)


def check_weight(weight: float) -> None:
    """Refuse a control weight R that is not positive."""
    if not weight > 0:
        raise DesignError(f"the control weight R must be positive; got {weight:g}")


@dataclass(frozen=True, eq=False)
class LawPerformance:
    """Cost, effort, spillover and stability of one law.

    Attributes:
        law: the law.
        cost: ∫ (Σ q_r'² + ω_r² q_r² + R FᵀF) dt of the controlled modes, over all time.
        effort: ∫ FᵀF dt over all time.
        peak_force: largest |F| of any actuator in continuous time up to the final time, to a millionth.
        work: of the actuators in every mode up to the final time.
        poles: (n_states,) of the loop with exact modal coordinates, rad/s.
        stability: of that loop, see `ClosedLoop.stability`.
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
        residual = self.work.residual_modes
        return residual[int(np.argmax(self.work.residual_work_by_mode))] if residual else None


def laws_of(
    modes: Modes, controlled: int, actuators: Sequence[Actuator], *, weight: float, damping: float | None = None
) -> tuple[list[Law], list[str]]:
    """The laws that can be designed, IMSC and coupled LQR, and why others cannot.

    With a damping ratio, the same two by pole assignment too.
    """
    if damping is not None and not 0 < damping < 1:
        raise DesignError(f"the damping ratio wanted must lie between 0 and 1; got {damping:g}")
    independent, refused, poles = controlled <= len(actuators), [], None
    if not independent:
        refused.append(
            f"IMSC needs as many actuators as controlled modes, {controlled}; there are {len(actuators)}: add actuators"
        )
    if damping is not None:
        omega = modes.omega[list(controlled_indices(modes, controlled))]
        rigid = np.flatnonzero(omega == 0).tolist()
        if rigid:
            refused.append(
                f"no pole assignment: the rigid mode(s) {numbered(rigid)} have no damping ratio; design by the weight,"
                " or give poles for all modes to coupled_poles"
            )
        else:
            poles = omega * (-damping + 1j * np.sqrt(1 - damping**2))
    laws = []
    for by_weight, by_poles in [(imsc, imsc_poles)] * independent + [(coupled_lqr, coupled_poles)]:
        laws.append(by_weight(modes, controlled, actuators, weight=weight))
        if poles is not None:
            laws.append(by_poles(modes, controlled, actuators, poles=poles))
    return laws, refused


@one_blas_thread
def compare(
    modes: Modes, laws: Sequence[Law], state: np.ndarray, *, weight: float, final_time: float
) -> tuple[LawPerformance, ...]:
    """Cost, effort, peak force, work by mode and poles of each law, from the same initial state.

    Args:
        modes: controlled and residual.
        laws: to compare; their costs are comparable if they control the same modes.
        state: (2 n_modes,) at t = 0; with residual modes at rest, W_R is due to control alone.
        weight: R of the cost.
        final_time: s, of work and peak force.
    """
    check_final_time(final_time)
    loops = [close_loop(modes, law) for law in laws]
    return tuple(
        LawPerformance(
            law=law,
            cost=quadratic_cost(modes, law, state, weight),
            effort=effort(modes, law, state),
            peak_force=peak_force(loop, state, final_time),
            work=finite_spillover(loop, state, final_time),
            poles=loop.poles,
            stability=loop.stability,
        )
        for law, loop in zip(laws, loops, strict=True)
    )


def through_sensors(
    modes: Modes, laws: Sequence[Law], places: Sequence[Place], structure: Structure | Plate | Membrane | None
) -> tuple[tuple[Controller | None, Explanation | None, str], ...]:
    """Each law with each estimator that sensors at the places allow: a modal filter and a Luenberger observer.

    Each is (controller, explanation on the full plant, ""), or (None, None, reason) where the design fails.

    Args:
        modes: controlled and residual.
        laws: to try.
        places: of the sensors: displacement for an observer, displacement and velocity for a filter.
        structure: gives the mass for the filters; without it filters are tried at named points alone.
    """
    sensor_places = sorted(set(places))
    sensors = [Sensor(f"y{i + 1}", x) for i, x in enumerate(sensor_places)]
    tried: list[tuple[Controller | None, Explanation | None, str]] = []
    estimators = (True, False) if structure is not None or isinstance(modes.domain, NamedPoints) else (False,)
    for law, by_filter in product(laws, estimators):
        try:
            if by_filter:
                controller = filtered(law, filter_on(structure, modes, law.controlled, sensor_places))
            else:
                controller = luenberger_controller(modes, law, sensors, poles=usual_poles(modes, law.controlled))
            tried.append((controller, explain_spillover(modes, controller), ""))
        except ValueError as error:
            tried.append((None, None, f"{law.name}: {error}"))
    return tuple(tried)
