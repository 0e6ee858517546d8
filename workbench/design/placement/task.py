"""What is asked of a placement: modes, disturbance and weight, all that does not depend on the places.

With IMSC the modal forces do not depend on the places, so W_R = ½ Σ_r E|φ_r(x)ᵀ B(x)⁻¹ f̂_r|² with the modal forces'
transforms f̂_r = f̂(iω_r) known once and for all, in the mean over the disturbances that may come.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from workbench.arrays import Floats, symmetric_root
from workbench.design.laws.imsc import imsc, riccati_gains
from workbench.design.laws.law import DesignError, Law, weighed_states
from workbench.design.laws.moments import settled_moments
from workbench.design.loop.peak import largest
from workbench.design.placement.places import as_places, coordinates, least_distances
from workbench.renamed import former_arguments
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.structure.domain import (
    Between,
    Domain,
    Interval,
    NamedPoints,
    Patch,
    Rectangle,
    centred_at,
    listed,
    reach,
)
from workbench.structure.modes import Modes, freeze, frozen, modal_state_matrix
from workbench.structure.printed import Printed, place_text

SINGULAR_SHARE = 1e-14
SHOWN_INSTANTS = 240
SETTLED = 1e-3
NOTHING = 1e-7
MOST_FORCES = 10_000_000
APART = 1e-6  # of the size of a patch: what overlaps less than this touches
SPREAD = "their length, on a plate their diagonal, as least spacing keeps them apart"


@dataclass(frozen=True, eq=False, repr=False)
class Placement(Printed):
    """A control law with its actuators placed, and what it costs.

    Attributes:
        positions: of the actuators: along an interval (n_actuators,) m, increasing, the middles of those that act
            between two places; over a rectangle (n_actuators, 2) m, the middles of patches; names of points
            (n_actuators,).
        law: with the actuators there; None where B is singular.
        residual_work: W_R.
        by_mode: (n_residual,) W_r.
        effort: ∫ FᵀF dt.
        peak_force: largest force of any actuator at any time, to a millionth.
        condition: of B, in the Frobenius norm ‖B‖‖B⁻¹‖, which bounds the spectral one.
        status: why the search stopped.
        local_optima: distinct local optima met from all starts, (positions, W_R), best first.
        spacing: least distance between two actuators, m; 0 where positions of named points are not known.
        overlapping: whether two patches lie over each other: keep their middles farther apart by `Limits.spacing`.
    """

    positions: np.ndarray
    law: Law | None
    residual_work: float
    by_mode: np.ndarray
    effort: float
    peak_force: float
    condition: float
    status: str
    local_optima: tuple[tuple[np.ndarray, float], ...] = ()
    spacing: float = np.inf
    overlapping: bool = False

    def __post_init__(self) -> None:
        freeze(self, "positions", dtype=None)
        freeze(self, "by_mode")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        count = len(self.positions)
        names = [f"F{i + 1}" for i in range(count)]
        if self.law is not None:
            names = [actuator.name for actuator in self.law.actuators]
        n_controlled = count if self.law is None else self.law.n_controlled
        line = f"{count} actuator{'s' * (count > 1)} placed: W_R = {self.residual_work:.4g}, effort {self.effort:.4g}"
        rows = [(name, place_text(x)) for name, x in zip(names, listed(self.positions), strict=True)]
        most = int(np.argmax(self.by_mode))
        remarks = (
            f"largest W_r = {self.by_mode[most]:.4g}, in mode {n_controlled + most + 1}; peak force"
            f" {self.peak_force:.4g}; condition of B {self.condition:.3g}",
            *((f"search: {self.status}",) if self.status else ()),
            *((f"patches overlap; {SPREAD}",) if self.overlapping else ()),
        )
        named = self.positions.dtype == object
        return line, ("actuator", "at" if named else "x [m]" if self.positions.ndim == 1 else "x, y [m]"), rows, remarks


@dataclass(frozen=True, eq=False, repr=False)
class PlacementTask(Printed):
    """The task; n modes controlled by as many actuators.

    Attributes:
        modes: controlled first, then residual.
        n_controlled: n.
        roots: (n_residual, n, n_columns) real T_r with T_r T_rᵀ = E Re f̂ f̂ᴴ at the residual frequency.
        force_gramian: (n, n) E ∫ f fᵀ dt.
        forces: (n, n_instants) modal forces at instants of every disturbance, for their peak.
        poles: (n_poles,) of the controlled modes, rad/s: two of each, of a rigid one that of its velocity.
        amplitudes: (n_places, n, n_poles) of the modal forces after an impulse at each place, f = Re Σ_k a_k e^{λ_k t}.
        span: s, over which their peak is sought.
        envelope: (n,) C_j of ω√E|f̂_j(iω)|² <= C_j above the last frequency; inf where there is no such bound.
        weight: R of IMSC, (n,).
        actuator: what is to be placed; its own place and name do not matter.
    """

    modes: Modes
    n_controlled: int
    roots: np.ndarray
    force_gramian: np.ndarray
    forces: np.ndarray
    poles: np.ndarray
    amplitudes: np.ndarray
    span: float
    envelope: np.ndarray
    weight: np.ndarray
    actuator: Actuator

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        modes = self.modes
        line = f"{self.n_controlled} of {modes.n_modes} modes controlled by as many actuators, on {modes.domain}"
        return line, (), (), ()

    def shapes(self, positions: Any, derivative: int = 0) -> np.ndarray:
        """Participation (..., n_modes) of an actuator at places: (...) m, (..., 2) m or (...) names.

        Along an interval, its derivatives with the place too.
        """
        domain, actuator = self.modes.domain, self.actuator
        if isinstance(domain, Interval):
            positions = np.asarray(positions, float)
            found = participation_along(self.modes, actuator, positions.ravel(), derivative)
            return found.reshape(*positions.shape, self.modes.n_modes)
        places = as_places(domain, positions)
        shape = places.shape[:-1] if isinstance(domain, Rectangle) else places.shape
        flat = places.reshape(-1, *places.shape[len(shape) :])
        if isinstance(actuator.at, Patch):
            patches = np.hstack([flat, np.broadcast_to(actuator.at[2:], flat.shape)])
            found = actuator.gain * self.modes.edge_slopes(patches, direction=actuator.direction)
        else:
            order = int(actuator.kind == "moment")
            found = actuator.gain * self.modes.phi(list(flat), order, direction=actuator.direction)
        return found.reshape(*shape, self.modes.n_modes)

    @property
    def reach(self) -> tuple[float, float]:
        """Where the middle of an actuator can stand at most along an interval, (from, to) m."""
        half = 0.5 * extent(self.actuator)
        return half, self.modes.length - half

    def law(self, positions: Any) -> Law:
        """The IMSC law with actuators at the places, one each.

        Raises:
            DesignError: places from which the modes cannot be controlled one by one.
        """
        places = listed(as_places(self.modes.domain, positions))
        actuators = [
            replace(self.actuator, name=f"F{i + 1}", at=centred_at(self.actuator.at, place))
            for i, place in enumerate(places)
        ]
        return imsc(self.modes, self.n_controlled, actuators, weight=self.weight)

    def placed(self, positions: Any, status: str, optima: Sequence[tuple[np.ndarray, float]] = ()) -> Placement:
        """A `Placement` of given positions; infinite work where B is singular.

        Raises:
            DesignError: more places than controlled modes, or fewer.
        """
        domain = self.modes.domain
        positions = as_places(domain, positions)
        if len(positions) != self.n_controlled:
            raise DesignError(
                f"{self.n_controlled} controlled modes take as many actuators; got {len(positions)} places"
            )
        if isinstance(domain, Interval):
            positions = np.sort(positions)
        shapes = self.shapes(positions)
        costs = batch_costs(self, shapes[None])
        peak, law = np.inf, None
        if np.isfinite(costs.work[0]):
            forces = np.linalg.inv(shapes[:, : self.n_controlled].T) @ self.amplitudes
            peak = largest(self.poles, forces.reshape(-1, self.poles.size), self.span)
            with suppress(ValueError):  # B of a condition that no law could be built on
                law = self.law(positions)
        return Placement(
            positions=positions,
            law=law,
            residual_work=float(costs.work[0]),
            by_mode=costs.by_mode[0],
            effort=float(costs.effort[0]),
            peak_force=peak,
            condition=float(costs.condition[0]),
            status=status,
            local_optima=tuple(optima),
            spacing=float(least_distances(coordinates(domain, positions)[None])[0]),
            overlapping=overlap(domain, self.actuator, positions),
        )

    def tail_bound(self, positions: ArrayLike, *, growth: float) -> float:
        """A bound on the work in all modes beyond those at hand, for frequencies that grow as ω_r >= ω_N (r/N)^growth.

        With ω|f̂_j| <= C_j beyond ω_N, W_tail <= ½ (Σ_ij |B⁻¹|_ij C_j)² Σ_{r>N} max b_r² / ω_r². A force takes part in a
        mode by its shape, whose maximum does not grow; a moment by the slope, which grows with the number of waves as
        ω^(1/growth), s = 1: max b_r <= S ω_r^(s/growth), S from the modes at hand, twice that of what acts between two
        places. Then Σ_{r>N} (N/r)^{2 (growth - s)} <= N / (2 (growth - s) - 1). Growth is 2 for a beam in bending, 1
        for a bar.

        Raises:
            DesignError: frequencies that grow too slowly for the sum to have a bound, a finite time, or modes that are
                not along an interval.
        """
        domain, moment = self.modes.domain, int(self.actuator.kind == "moment")
        if not isinstance(domain, Interval):
            raise DesignError(f"the bound on the tail is along an interval; these modes are of {domain}")
        power = 2 * (growth - moment)
        if not power > 1:
            raise DesignError(
                "the frequencies must grow faster than the root of their number, and for moments faster than its power"
                f" 3/2; got growth {growth:g}"
            )
        if not np.isfinite(self.envelope).all():
            raise DesignError("the bound on the tail is for t_f to infinity and frequencies above the closed loop's")
        n, modes = self.n_controlled, self.modes
        inverse = np.abs(np.linalg.inv(self.shapes(positions)[:, :n].T))
        elastic = modes.select(np.flatnonzero(modes.omega > 0).tolist())
        shapes = elastic.phi(np.linspace(0.0, domain.length, 20 * modes.n_modes), moment)
        ends = abs(self.actuator.gain) * (2 if extent(self.actuator) else 1)
        steepest = (
            ends * np.abs(shapes / elastic.omega ** (moment / growth)).max() * modes.omega[-1] ** (moment / growth)
        )
        series = modes.n_modes / (power - 1) / modes.omega[-1] ** 2
        return float(0.5 * (steepest * (inverse @ self.envelope).sum()) ** 2 * series)


@former_arguments(chances="probabilities")
def placement_task(
    modes: Modes,
    n_controlled: int,
    *,
    impulse_at: Any,
    weight: ArrayLike,
    impulse: float = 1.0,
    probabilities: ArrayLike | None = None,
    final_time: float = np.inf,
    actuator: Actuator | None = None,
) -> PlacementTask:
    """The task for an impulse (N s) at a place, or at any of several, IMSC with control weight R (5.43).

    Effort and peak force are those of the law that a placement has, its modes' own damping included; W_R is the work on
    residual modes as if these had none.

    White-noise forces of intensity s at those places, given in place of probabilities, are impulses of √s N s at every
    instant: W_R and effort are then powers.

    Args:
        impulse_at: a place of the domain, or several: x or (n_places,) m, (x, y) or (n_places, 2) m, names.
        weight: R, scalar or one a controlled mode.
        impulse: N s.
        probabilities: (n_places,) of each place; even unless given.
        final_time: t_f; work is counted up to it.
        actuator: what is to be placed, a point force unless given; a `piezo_patch` or a moment, with its gain.

    Raises:
        DesignError: no residual mode, damping that couples the modes, an impulse that moves nothing, probabilities that
            are none, a time that is not positive, or an actuator with a delay or a lag.
    """
    if not 1 <= n_controlled < modes.n_modes:
        raise DesignError(f"{n_controlled} of {modes.n_modes} modes controlled leaves no residual mode to spill into")
    check_uncoupled(modes)
    if not final_time > 0:
        raise DesignError(f"the final time must be positive; got {final_time}")
    if not np.isfinite(impulse) or impulse == 0:
        raise DesignError(f"the impulse must be finite and not 0, N s; got {impulse}")
    places = listed(as_places(modes.domain, impulse_at))
    if modes.are_held(places).all():
        raise DesignError(f"an impulse at {impulse_at} moves no mode: a support holds that place; give another")
    shares = np.full(len(places), 1.0 / len(places)) if probabilities is None else np.asarray(probabilities, float)
    if shares.shape != (len(places),) or not (shares >= 0).all() or not shares.sum() > 0:
        raise DesignError(f"{len(places)} places need as many probabilities, none negative; got {shares}")
    if actuator is not None and isinstance(actuator.at, Between) and not isinstance(modes.domain, Interval):
        raise DesignError(
            f"actuator {actuator.name} acts between two places; such are placed along an interval only: place forces or"
            " moments, or compare pairs of points one by one"
        )
    if actuator is not None and (actuator.delay or actuator.time_constant):
        late = "delay" if actuator.delay else "time_constant"
        raise DesignError(
            f"actuator {actuator.name} has {late} = {getattr(actuator, late):g}, and the best places are known for"
            " forces that follow at once: place it without, and see by close_loop or export what the law does with it"
        )
    n = n_controlled
    omega = modes.omega[:n]
    g1, g2 = riccati_gains(omega, weight, np.diag(modes.damping)[:n])
    rate = g2 + np.diag(modes.damping)[:n]  # of the closed loop: s² + rate s + ω² + g1
    rates = impulse * modes.phi(places)[:, :n] * np.sqrt(shares)[:, None]
    s = 1j * modes.omega[n:, None]
    states, rigid = weighed_states(omega), omega == 0
    unit = -np.where(rigid, g2 / (s + rate), (g1 + g2 * s) / np.where(rigid, 1.0, s**2 + rate * s + omega**2 + g1))
    a = modal_state_matrix(omega**2 + g1, rate)[np.ix_(states, states)]
    gains = np.hstack([np.diag(g1), np.diag(g2)])[:, states]
    slowest = -np.linalg.eigvals(a).real.max()
    if np.isfinite(final_time):
        # what is left of the loop at t_f answers no more
        end = expm(a * final_time)
        left = np.array([-gains @ np.linalg.solve(si * np.eye(len(a)) - a, end[:, -n:]) for si in s[:, 0]])
        unit = unit[:, :, None] * np.eye(n) - left * np.exp(-s * final_time)[:, :, None]
    else:
        unit = unit[:, :, None] * np.eye(n)
    transforms = unit @ rates.T
    roots = np.array([symmetric_root((t @ t.conj().T).real) for t in transforms])
    # one impulse has a root of two columns; columns without weight only cost time
    weights = np.abs(roots).max(axis=(0, 1))
    roots = roots[:, :, weights > NOTHING * weights.max()]
    share = (omega**2 + g1) / modes.omega[-1] ** 2
    envelope = np.full(n, np.inf)
    if np.isinf(final_time) and (share < 1).all():
        envelope = np.linalg.norm(rates, axis=0) * np.sqrt(g2**2 + (g1 / modes.omega[-1]) ** 2) / (1 - share)
    span = min(final_time, -np.log(SETTLED) / slowest)
    # the rate jumps at the impulse and the forces with it: instants lie close at first
    instants = span * np.linspace(0.0, 1.0, SHOWN_INSTANTS) ** 2
    starts = np.vstack([np.zeros((len(a) - n, len(places))), (rates / np.sqrt(np.maximum(shares, 1e-300))[:, None]).T])
    values, vectors = np.linalg.eig(a)
    held = np.linalg.solve(vectors, starts[:, shares > 0].astype(complex))
    motion = np.einsum("ik,kt,kp->ipt", vectors, np.exp(np.outer(values, instants)), held).real
    forces = -(gains @ motion.reshape(len(a), -1))
    gramian = _force_gramian(a, gains, rates, final_time)
    amplitudes = -(gains @ vectors) * held.T[:, None, :]
    amplitudes.flags.writeable = values.flags.writeable = False
    return PlacementTask(
        modes=modes,
        n_controlled=n,
        roots=frozen(roots),
        force_gramian=frozen(gramian),
        forces=frozen(forces),
        poles=values,
        amplitudes=amplitudes,
        span=final_time,
        envelope=frozen(envelope),
        weight=frozen(np.broadcast_to(np.asarray(weight, float), n)),
        actuator=Actuator("F", modes.domain.grid(2)[0]) if actuator is None else actuator,
    )


def check_uncoupled(modes: Modes) -> None:
    """Refuse damping that couples the modes: what is placed by would leave its work out.

    Raises:
        DesignError: such damping.
    """
    if not modes.proportional:
        raise DesignError(
            "damping couples the modes, and places are compared mode by mode; neglect its coupling terms by"
            " replace(modes, damping=np.diag(np.diag(modes.damping))), and check the design by finite_spillover"
        )


def patch_of(rig: Rig) -> Actuator | None:
    """The piezo patch that the actuators of a rig are, all of one size; None where they are point forces.

    Raises:
        DesignError: actuators that differ in more than their place.
    """
    own, domain = [a for a in rig.actuators if not a.direct], rig.modes.domain
    patch = next((a for a in own if a.kind == "moment"), None)
    if patch is None or isinstance(domain, NamedPoints):
        return None
    half = reach(domain, patch.at)[0]
    for other in own:
        alike = (other.kind, other.direction) == (patch.kind, patch.direction)
        if not (alike and np.allclose(reach(domain, other.at)[0], half)):
            raise DesignError(
                f"actuators of one kind are placed, and {other.name} is no patch like {patch.name}: give them one size"
                " and axis, or describe point forces"
            )
    return patch


def overlap(domain: Domain, actuator: Actuator, positions: np.ndarray) -> bool:
    """Whether two of the actuators with their middles at positions (n_actuators, ...) lie over each other."""
    if isinstance(domain, NamedPoints):
        return False
    size, at = 2.0 * reach(domain, actuator.at)[0], positions.reshape(len(positions), -1)
    near = (np.abs(at[:, None] - at) < size * (1.0 - APART)).all(axis=2)
    return bool(np.triu(near, 1).any())


def extent(actuator: Actuator) -> float:
    """Length of an actuator along an interval, m: from the first to the second of two places, else 0."""
    return float(actuator.at.first - actuator.at.second) if isinstance(actuator.at, Between) else 0.0  # type: ignore


def participation_along(modes: Modes, actuator: Actuator, x: Floats, derivative: int = 0) -> Floats:
    """Modal forces (n_places, n_modes) per unit command of an actuator at x (n_places,), m; derivatives with x."""
    half, order = 0.5 * extent(actuator), derivative + (actuator.kind == "moment")
    if half == 0:
        return actuator.gain * modes.phi(x, order)
    return actuator.gain * (modes.phi(x + half, order) - modes.phi(x - half, order))


def _force_gramian(a: Floats, gains: Floats, rates: Floats, final_time: float) -> Floats:
    n = rates.shape[1]
    start = np.vstack([np.zeros((len(a) - n, rates.shape[0])), rates.T])
    gramian = settled_moments(a, start)
    if np.isfinite(final_time):
        end = expm(a * final_time)
        gramian = gramian - end @ gramian @ end.T
    return gains @ gramian @ gains.T


@dataclass(frozen=True, eq=False)
class Costs:
    """What many placements cost: each (n_placements,), inf where B is singular; by_mode (n_placements, n_residual).

    The peak force is that at the task's instants: never more than the true one, and a little less.
    """

    work: np.ndarray
    by_mode: np.ndarray
    effort: np.ndarray
    peak_force: np.ndarray
    condition: np.ndarray


def batch_costs(task: PlacementTask, shapes: np.ndarray) -> Costs:
    """All that is asked of many placements at once, from `shapes` (n_placements, n_actuators, n_modes)."""
    inverse, singular = _inverses(task, shapes)
    n = task.n_controlled
    spread = shapes[:, :, n:].transpose(0, 2, 1) @ inverse
    by_mode = 0.5 * (np.einsum("prk,rkj->prj", spread, task.roots, optimize=True) ** 2).sum(axis=2)
    effort = np.einsum("pik,kl,pil->p", inverse, task.force_gramian, inverse, optimize=True)
    few = max(1, MOST_FORCES // task.forces.size)
    peak = np.concatenate(
        [np.abs(inverse[i : i + few] @ task.forces).max(axis=(1, 2)) for i in range(0, len(inverse), few)]
    )
    condition = np.linalg.norm(inverse, axis=(1, 2)) * np.linalg.norm(shapes[:, :, :n], axis=(1, 2))
    by_mode[singular] = np.inf
    return Costs(
        np.where(singular, np.inf, by_mode.sum(axis=1)),
        by_mode,
        *(np.where(singular, np.inf, x) for x in (effort, peak, condition)),
    )


def batch_work(task: PlacementTask, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """W_R and effort of many placements at once.

    Args:
        shapes: (n_placements, n_actuators, n_modes) of the modes at the actuators.

    Returns:
        W_R (n_placements,) and effort (n_placements,); inf where B is singular.
    """
    inverse, singular = _inverses(task, shapes)
    n, columns = task.n_controlled, task.roots.shape[2]
    # Σ_r |T_rᵀ B⁻ᵀ φ_r|² as one product over actuators: P_r = B⁻¹ T_r for all r together
    pushes = inverse @ task.roots.transpose(1, 0, 2).reshape(n, -1)
    pushes = pushes.reshape(len(shapes), n, -1, columns)
    work = 0.5 * (np.einsum("pir,pirk->prk", shapes[:, :, n:], pushes) ** 2).sum(axis=(1, 2))
    effort = np.einsum("pik,kl,pil->p", inverse, task.force_gramian, inverse, optimize=True)
    return np.where(singular, np.inf, work), np.where(singular, np.inf, effort)


def _inverses(task: PlacementTask, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """B⁻¹ of each placement, and where B is singular."""
    b = shapes[:, :, : task.n_controlled].transpose(0, 2, 1)
    # Hadamard: |det B| against the product of its row lengths, so that mass and units do not matter
    singular = np.abs(np.linalg.det(b)) <= SINGULAR_SHARE * np.linalg.norm(b, axis=2).prod(axis=1)
    return np.linalg.inv(np.where(singular[:, None, None], np.eye(task.n_controlled), b)), singular
