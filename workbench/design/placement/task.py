"""The task of a placement: modes, disturbance and weight, all that does not depend on the places.

With IMSC the modal forces do not depend on the places, so W_R = ½ Σ_r E|φ_r(x)ᵀ B(x)⁻¹ f̂_r|², where the transforms of
the modal forces f̂_r = f̂(iω_r) are computed once. E is the mean over the possible disturbances.
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
from workbench.design.loop.peak import largest
from workbench.design.placement.places import as_places, coordinates, least_distances
from workbench.design.spillover.spillover import settled_moments
from workbench.renamed import former_arguments, former_fields
from workbench.rig.actuators import Actuator, command_unit
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
from workbench.structure.printed import Printed, command_headings, counted, in_unit, place_text

SINGULAR_SHARE = 1e-14  # of the product of B's row lengths: |det B| below which B counts as singular
SHOWN_INSTANTS = 240  # at which modal forces are sampled
SETTLED = 1e-3  # of its start: the slowest decay at the last of these instants
NEGLIGIBLE = 1e-7  # of the largest entry: columns of a root with smaller entries are left out
MOST_FORCES = 10_000_000  # computed at once, to bound the memory
APART = 1e-6  # of the size of a patch: patches that overlap by less only touch
SPREAD = "a spacing of their length, on a plate of their diagonal, prevents this"


@former_fields(by_mode="residual_work_by_mode")
@dataclass(frozen=True, eq=False, repr=False)
class Placement(Printed):
    """A control law with its actuators placed, and its costs.

    Attributes:
        positions: of the actuators, for patches of their middles: along an interval (n_actuators,) m, increasing; over
            a rectangle (n_actuators, 2) m; at named points (n_actuators,) names.
        law: with the actuators there; None where B is singular.
        residual_work: W_R.
        residual_work_by_mode: (n_residual,) W_r.
        effort: ∫ FᵀF dt.
        peak_force: largest force of any actuator in continuous time, to a millionth.
        condition: of B in the Frobenius norm, ‖B‖‖B⁻¹‖, an upper bound of the spectral condition number.
        status: why the search stopped.
        local_optima: distinct local optima of all starts, (positions, W_R), best first.
        spacing: least distance between two actuators, m; 0 where positions of named points are not known.
        overlapping: whether two patches overlap; `Limits.spacing` prevents it.
    """

    positions: np.ndarray
    law: Law | None
    residual_work: float
    residual_work_by_mode: np.ndarray
    effort: float
    peak_force: float
    condition: float
    status: str
    local_optima: tuple[tuple[np.ndarray, float], ...] = ()
    spacing: float = np.inf
    overlapping: bool = False

    def __post_init__(self) -> None:
        freeze(self, "positions", dtype=None)
        freeze(self, "residual_work_by_mode")

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        count = n_controlled = len(self.positions)
        names, unit = [f"F{i + 1}" for i in range(count)], ""
        if self.law is not None:
            names, unit = [actuator.name for actuator in self.law.actuators], command_unit(self.law.actuators)
            n_controlled = self.law.n_controlled
        effort, peak = command_headings(unit)
        line = f"{counted(count, 'actuator')} placed: W_R = {self.residual_work:.4g} J"
        line += f", effort {in_unit(self.effort, effort)}"
        rows = [(name, place_text(x)) for name, x in zip(names, listed(self.positions), strict=True)]
        most = int(np.argmax(self.residual_work_by_mode))
        remarks = (
            f"largest W_r = {self.residual_work_by_mode[most]:.4g} J, in mode {n_controlled + most + 1};"
            f" {peak.partition(' [')[0]} {in_unit(self.peak_force, peak)}; condition number of B {self.condition:.3g}",
            *((f"{'search' if self.local_optima else 'places'}: {self.status}",) if self.status else ()),
            *((f"patches overlap; {SPREAD}",) if self.overlapping else ()),
        )
        named = self.positions.dtype == object
        return line, ("actuator", "at" if named else "x [m]" if self.positions.ndim == 1 else "x, y [m]"), rows, remarks


@dataclass(frozen=True, eq=False, repr=False)
class PlacementTask(Printed):
    """The task of placing n actuators that control n modes by IMSC.

    Attributes:
        modes: controlled first, then residual.
        n_controlled: n.
        roots: (n_residual, n, n_columns) real T_r with T_r T_rᵀ = E Re f̂ f̂ᴴ at the residual frequency.
        force_gramian: (n, n) E ∫ f fᵀ dt.
        forces: (n, n_instants) sampled modal forces of every disturbance, for their peak.
        poles: (n_poles,) of the controlled modes, rad/s: two per mode, one per rigid mode (that of its velocity).
        amplitudes: (n_places, n, n_poles) of the modal forces after an impulse at each place, f = Re Σ_k a_k e^{λ_k t}.
        span: s, over which the peak is computed.
        envelope: (n,) C_j of ω√E|f̂_j(iω)|² <= C_j above the last frequency; inf where there is no such bound.
        weight: R of IMSC, (n,).
        actuator: to be placed; its own place and name do not matter.
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

        Along an interval also its derivative with respect to the place, of order `derivative`.
        """
        domain, actuator = self.modes.domain, self.actuator
        if isinstance(domain, Interval):
            return participation_along(self.modes, actuator, np.asarray(positions, float), derivative)
        places = as_places(domain, positions)
        shape = places.shape[:-1] if isinstance(domain, Rectangle) else places.shape
        flat = places.reshape(-1, *places.shape[len(shape) :])
        if isinstance(actuator.at, Patch):
            patches = np.hstack([flat, np.broadcast_to(actuator.at[2:], flat.shape)])
            values = actuator.gain * self.modes.edge_slopes(patches, direction=actuator.direction)
        else:
            order = int(actuator.quantity == "moment")
            values = actuator.gain * self.modes.phi(list(flat), order, direction=actuator.direction)
        return values.reshape(*shape, self.modes.n_modes)

    @property
    def reach(self) -> tuple[float, float]:
        """Range of the middle of an actuator along an interval, (from, to) m."""
        return reach_along(self.modes, self.actuator)

    def law(self, positions: Any) -> Law:
        """The IMSC law with one actuator at each of the places."""
        places = listed(as_places(self.modes.domain, positions))
        actuators = [
            replace(self.actuator, name=f"F{i + 1}", at=centred_at(self.actuator.at, place))
            for i, place in enumerate(places)
        ]
        return imsc(self.modes, self.n_controlled, actuators, weight=self.weight)

    def placed(self, positions: Any, status: str, optima: Sequence[tuple[np.ndarray, float]] = ()) -> Placement:
        """The `Placement` of given positions, as many as controlled modes; infinite work where B is singular."""
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
            with suppress(ValueError):  # B too ill-conditioned for a law
                law = self.law(positions)
        return Placement(
            positions=positions,
            law=law,
            residual_work=float(costs.work[0]),
            residual_work_by_mode=costs.by_mode[0],
            effort=float(costs.effort[0]),
            peak_force=peak,
            condition=float(costs.condition[0]),
            status=status,
            local_optima=tuple(optima),
            spacing=float(least_distances(coordinates(domain, positions)[None])[0]),
            overlapping=overlap(domain, self.actuator, positions),
        )

    def tail_bound(self, positions: ArrayLike, *, growth: float) -> float:
        """An upper bound of the work in all modes above the N of the task, if ω_r >= ω_N (r/N)^growth.

        With ω|f̂_j| <= C_j above ω_N, W_tail <= ½ (Σ_ij |B⁻¹|_ij C_j)² Σ_{r>N} max b_r² / ω_r². The participation of a
        force is the shape, whose maximum does not grow (s = 0); that of a moment is the slope, which grows with the
        number of waves as ω^(1/growth) (s = 1). So max b_r <= S ω_r^(s/growth), with S from the N modes, twice for
        actuators between two places. Then Σ_{r>N} (N/r)^{2 (growth - s)} <= N / (2 (growth - s) - 1). Growth is 2 for a
        beam in bending, 1 for a bar.

        Raises:
            DesignError: frequencies that grow too slowly for a bounded sum, a finite time, or modes that are not along
                an interval.
        """
        domain, moment = self.modes.domain, int(self.actuator.quantity == "moment")
        if not isinstance(domain, Interval):
            raise DesignError(f"the bound of higher modes is for an interval; these modes are of {domain}")
        power = 2 * (growth - moment)
        if not power > 1:
            raise DesignError(
                "the growth of the frequencies with the mode number must exceed 1/2, and 3/2 for moments; got"
                f" {growth:g}"
            )
        if not np.isfinite(self.envelope).all():
            raise DesignError(
                "the bound of higher modes is for t_f to infinity and frequencies above the closed loop's"
            )
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
    """The task of placement for an impulse (N s) at a place, or at any of several, under IMSC of weight R (5.43).

    Effort and peak force include the damping of the controlled modes; W_R is that of undamped residual modes.

    For white-noise forces at these places, give their intensities instead of probabilities: a force of intensity s acts
    as an impulse of √s N s at every instant, and W_R and effort are powers.

    Args:
        modes: controlled first, then residual.
        n_controlled: number of controlled modes, and of actuators.
        impulse_at: a place of the domain, or several: x or (n_places,) m, (x, y) or (n_places, 2) m, names.
        weight: R, scalar or one per controlled mode.
        impulse: N s.
        probabilities: (n_places,) of each place; equal by default.
        final_time: t_f up to which work counts, s.
        actuator: to be placed, by default a point force; a `piezo_patch` or a moment, with its gain.

    Raises:
        DesignError: no residual mode, damping that couples the modes, an impulse at a held place, negative
            probabilities, a time that is not positive, or an actuator with a delay or a lag.
    """
    check_residual(modes, n_controlled)
    check_uncoupled(modes)
    if not final_time > 0:
        raise DesignError(f"the final time must be positive; got {final_time}")
    if not np.isfinite(impulse) or impulse == 0:
        raise DesignError(f"the impulse must be finite and not 0, N s; got {impulse}")
    places = listed(as_places(modes.domain, impulse_at))
    if modes.are_held(places).all():
        raise DesignError(f"an impulse at {impulse_at} excites no mode: a support holds that place; give another")
    shares = np.full(len(places), 1.0 / len(places)) if probabilities is None else np.asarray(probabilities, float)
    if shares.shape != (len(places),) or not (shares >= 0).all() or not shares.sum() > 0:
        raise DesignError(f"{len(places)} places need as many probabilities, none negative; got {shares}")
    if actuator is not None and isinstance(actuator.at, Between) and not isinstance(modes.domain, Interval):
        raise DesignError(
            f"actuator {actuator.name} acts between two places; such actuators are placed along an interval only: place"
            " forces or moments, or compare pairs of points one by one"
        )
    if actuator is not None and (actuator.delay or actuator.time_constant):
        lag = "delay" if actuator.delay else "time_constant"
        raise DesignError(
            f"actuator {actuator.name} has {lag} = {getattr(actuator, lag):g}, and placement is for forces without lag:"
            " place it without, and check the law with it by close_loop or export"
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
    unit = unit[:, :, None] * np.eye(n)
    if np.isfinite(final_time):
        # subtract the transform of the forces after t_f
        end = expm(a * final_time)
        after = np.array([-gains @ np.linalg.solve(si * np.eye(len(a)) - a, end[:, -n:]) for si in s[:, 0]])
        unit = unit - after * np.exp(-s * final_time)[:, :, None]
    transforms = unit @ rates.T
    roots = np.array([symmetric_root((t @ t.conj().T).real) for t in transforms])
    # the root for one impulse has rank two; negligible columns are left out to save time
    weights = np.abs(roots).max(axis=(0, 1))
    roots = roots[:, :, weights > NEGLIGIBLE * weights.max()]
    ratio = (omega**2 + g1) / modes.omega[-1] ** 2
    envelope = np.full(n, np.inf)
    if np.isinf(final_time) and (ratio < 1).all():
        envelope = np.linalg.norm(rates, axis=0) * np.sqrt(g2**2 + (g1 / modes.omega[-1]) ** 2) / (1 - ratio)
    span = min(final_time, -np.log(SETTLED) / slowest)
    # instants are denser at the start, where the forces jump with the rates
    instants = span * np.linspace(0.0, 1.0, SHOWN_INSTANTS) ** 2
    starts = np.vstack([np.zeros((len(a) - n, len(places))), (rates / np.sqrt(np.maximum(shares, 1e-300))[:, None]).T])
    values, vectors = np.linalg.eig(a)
    coefficients = np.linalg.solve(vectors, starts[:, shares > 0].astype(complex))
    motion = np.einsum("ik,kt,kp->ipt", vectors, np.exp(np.outer(values, instants)), coefficients).real
    forces = -(gains @ motion.reshape(len(a), -1))
    moments = settled_moments(a, np.vstack([np.zeros((len(a) - n, len(places))), rates.T]))
    if np.isfinite(final_time):
        moments = moments - end @ moments @ end.T
    amplitudes = -(gains @ vectors) * coefficients.T[:, None, :]
    amplitudes.flags.writeable = values.flags.writeable = False
    return PlacementTask(
        modes=modes,
        n_controlled=n,
        roots=frozen(roots),
        force_gramian=frozen(gains @ moments @ gains.T),
        forces=frozen(forces),
        poles=values,
        amplitudes=amplitudes,
        span=final_time,
        envelope=frozen(envelope),
        weight=frozen(np.broadcast_to(np.asarray(weight, float), n)),
        actuator=Actuator("F", modes.domain.grid(2)[0]) if actuator is None else actuator,
    )


def check_residual(modes: Modes, n_controlled: int) -> None:
    """Refuse to control no mode, or all: without residual modes there is no spillover work."""
    if not 1 <= n_controlled < modes.n_modes:
        raise DesignError(
            f"{n_controlled} of {modes.n_modes} modes controlled leave no residual mode, so there is no spillover"
        )


def check_uncoupled(modes: Modes) -> None:
    """Refuse damping that couples the modes: the spillover work of a placement would not include its effect."""
    if not modes.proportional:
        raise DesignError(
            "damping couples the modes, and placement sums the work of uncoupled modes; neglect the coupling terms by"
            " replace(modes, damping=np.diag(np.diag(modes.damping))), and check the design by finite_spillover"
        )


def patch_of(rig: Rig) -> Actuator | None:
    """One of the piezo patches of a rig, whose actuators are checked to be alike; None where they are point forces."""
    own, domain = [a for a in rig.actuators if not a.direct], rig.modes.domain
    patch = next((a for a in own if a.quantity == "moment"), None)
    if patch is None or isinstance(domain, NamedPoints):
        return None
    half = reach(domain, patch.at)[0]
    for other in own:
        alike = (other.quantity, other.direction) == (patch.quantity, patch.direction)
        if not (alike and np.allclose(reach(domain, other.at)[0], half)):
            raise DesignError(
                f"placement is of identical actuators, and {other.name} is not a patch like {patch.name}: give all the"
                " same size and axis, or describe point forces"
            )
    return patch


def overlap(domain: Domain, actuator: Actuator, positions: np.ndarray) -> bool:
    """Whether two of the actuators, with their middles at positions (n_actuators, ...), overlap."""
    if isinstance(domain, NamedPoints):
        return False
    size, at = 2.0 * reach(domain, actuator.at)[0], positions.reshape(len(positions), -1)
    near = (np.abs(at[:, None] - at) < size * (1.0 - APART)).all(axis=2)
    return bool(np.triu(near, 1).any())


def extent(actuator: Actuator) -> float:
    """Length of an actuator between two places along an interval, m; 0 of others."""
    return float(actuator.at.first - actuator.at.second) if isinstance(actuator.at, Between) else 0.0  # type: ignore


def reach_along(modes: Modes, actuator: Actuator) -> tuple[float, float]:
    """Range of the middle of an actuator along an interval, (from, to) m."""
    low, high = reach(modes.domain, actuator.at)  # type: ignore[arg-type]
    return low.item(), high.item()


def participation_along(modes: Modes, actuator: Actuator, x: Floats, derivative: int = 0) -> Floats:
    """Participation (..., n_modes) of an actuator with its middle at x (...), m, or its derivative in x."""
    half, order = 0.5 * extent(actuator), derivative + (actuator.quantity == "moment")
    at = x.ravel()
    values = modes.phi(at, order) if half == 0 else modes.phi(at + half, order) - modes.phi(at - half, order)
    return actuator.gain * values.reshape(*x.shape, modes.n_modes)


@dataclass(frozen=True, eq=False)
class Costs:
    """Costs of many placements, (n_placements,) each, inf where B is singular; by_mode (n_placements, n_residual).

    The peak force is that at the task's instants, slightly below the true one.
    """

    work: np.ndarray
    by_mode: np.ndarray
    effort: np.ndarray
    peak_force: np.ndarray
    condition: np.ndarray


def batch_costs(task: PlacementTask, shapes: np.ndarray) -> Costs:
    """The costs of many placements at once, from the participations `shapes` (n_placements, n_actuators, n_modes)."""
    inverse, singular = _inverses(task, shapes)
    n = task.n_controlled
    residual = shapes[:, :, n:].transpose(0, 2, 1) @ inverse
    by_mode = 0.5 * (np.einsum("prk,rkj->prj", residual, task.roots, optimize=True) ** 2).sum(axis=2)
    effort = np.einsum("pik,kl,pil->p", inverse, task.force_gramian, inverse, optimize=True)
    batch = max(1, MOST_FORCES // task.forces.size)
    peak = np.concatenate(
        [np.abs(inverse[i : i + batch] @ task.forces).max(axis=(1, 2)) for i in range(0, len(inverse), batch)]
    )
    condition = np.linalg.norm(inverse, axis=(1, 2)) * np.linalg.norm(shapes[:, :, :n], axis=(1, 2))
    by_mode[singular] = np.inf
    effort, peak, condition = (np.where(singular, np.inf, x) for x in (effort, peak, condition))
    return Costs(by_mode.sum(axis=1), by_mode, effort, peak, condition)


def batch_work(task: PlacementTask, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """W_R and effort (n_placements,) alone, as of `batch_costs`, in less time."""
    inverse, singular = _inverses(task, shapes)
    n, columns = task.n_controlled, task.roots.shape[2]
    # Σ_r |T_rᵀ B⁻ᵀ φ_r|² as one product over actuators: P_r = B⁻¹ T_r for all r together
    forces = (inverse @ task.roots.transpose(1, 0, 2).reshape(n, -1)).reshape(len(shapes), n, -1, columns)
    work = 0.5 * (np.einsum("pir,pirk->prk", shapes[:, :, n:], forces) ** 2).sum(axis=(1, 2))
    effort = np.einsum("pik,kl,pil->p", inverse, task.force_gramian, inverse, optimize=True)
    return np.where(singular, np.inf, work), np.where(singular, np.inf, effort)


def _inverses(task: PlacementTask, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """B⁻¹ (n_placements, n, n) of each placement, and where B is singular (n_placements,)."""
    b = shapes[:, :, : task.n_controlled].transpose(0, 2, 1)
    # |det B| over the product of its row lengths (Hadamard's inequality) does not depend on mass and units
    singular = np.abs(np.linalg.det(b)) <= SINGULAR_SHARE * np.linalg.norm(b, axis=2).prod(axis=1)
    return np.linalg.inv(np.where(singular[:, None, None], np.eye(task.n_controlled), b)), singular
