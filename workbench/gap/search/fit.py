"""Nonlinear least-squares fit of a set of effects to the simulation error of the fit records."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, islice
from operator import mul
from typing import Any, Literal

import numpy as np

from workbench.arrays import Flags, Floats, Integers
from workbench.gap.effects.effect import COORDINATES, Effect, Parameter, apply_all, key_of
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE, Workers
from workbench.gap.search.settings import FIT
from workbench.rig.rig import Rig
from workbench.rig.simulate import is_stepped

DIVERGED = 1e300


@dataclass(frozen=True, eq=False)
class Fit:
    """A set of effects with fitted parameters.

    Attributes:
        effects: with values and standard deviations.
        cost: sum of squares per measured value; 1 at the noise floor.
        cost_by_channel: (n_records, n_outputs) the same by channel, without the statistics of a random disturbance.
        n_parameters: number of fitted parameters.
        falling: relative decrease of the cost in the last iteration; 0 if the fit has converged.
        covariance: (n, n) of the free coordinates of all parameters, in the order of `parameters_of`; None before
            `with_intervals`.
        stepping: (n_records,) mean square error of time integration, in units of the noise, if it was measured.
        normal: (n, n) Jᵀ J of the free coordinates of all parameters, with the precision of the priors.
    """

    effects: tuple[Effect, ...]
    cost: float
    cost_by_channel: np.ndarray
    n_parameters: int
    falling: float = 0.0
    covariance: np.ndarray | None = None
    stepping: np.ndarray | float = 0.0
    normal: np.ndarray | None = None

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(effect.label for effect in self.effects)

    @property
    def named(self) -> str:
        """Labels of the effects, without nominal errors, in one string."""
        return " + ".join(effect.label for effect in self.effects if not effect.kind.applied_first)

    @property
    def key(self) -> tuple[str, ...]:
        """Identity of the set of effects, whatever its parameters."""
        return key_of(self.effects)


def cost_of(rig: Rig, effects: Sequence[Effect], data: FitData) -> float:
    """Cost per measured value; `DIVERGED` if the rig is physically impossible (a buckled beam, say)."""
    residual = finite_residual(rig, effects, data)
    return DIVERGED if residual is None else float(residual @ residual) / residual.size


def finite_residual(rig: Rig, effects: Sequence[Effect], data: FitData) -> np.ndarray | None:
    """The residual (n_values,) of a rig with effects; None if the rig is impossible or its simulation diverges."""
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            residual = data.residual(apply_all(rig, effects))
        except (ValueError, np.linalg.LinAlgError):
            return None
        return residual if residual @ residual < DIVERGED else None


@dataclass(frozen=True, eq=False)
class Move:
    """A finite-difference perturbation of one or more parameters.

    Attributes:
        free: (n_parameters,) free coordinates of all parameters.
        to: (n_parameters,) the perturbed coordinates.
        indices: of the perturbed parameters.
        coarsely: whether the residual is simulated with coarse substeps.
        of_sensors_alone: whether each of them alters only the readings of a different sensor.
    """

    free: Floats
    to: Floats
    indices: list[int]
    coarsely: bool
    of_sensors_alone: bool = False


@dataclass(frozen=True, eq=False)
class Attempt:
    """A Levenberg-Marquardt step to be tried.

    Attributes:
        free: (n_parameters,) start point.
        coarsely: whether the sensitivities there are simulated with coarse substeps.
        normal, gradient: Jᵀ J and Jᵀ r there.
        damping: as a share of the diagonal of Jᵀ J.
        least_decrease: least predicted decrease of the cost for which the step is tried.
    """

    free: Floats
    coarsely: bool
    normal: Floats
    gradient: Floats
    damping: float
    least_decrease: float


Shared = Callable[[Sequence[Move | Attempt]], list[Any]]


@dataclass(eq=False)
class Chord:
    """Sensitivities to parameters with priors that several fits of the same records share (chord method).

    The residual is nearly linear in small errors, so they need not be updated.

    Attributes:
        columns: (n_values, n_with_prior), in units of the noise; None until a fit has computed them.
    """

    columns: Floats | None = None


class _Problem:
    """The residual as a function of the free coordinates of all parameters of all effects."""

    def __init__(
        self,
        rig: Rig,
        effects: Sequence[Effect],
        data: FitData,
        held: Sequence[Effect] = (),
        workers: Workers = ALONE,
        chord: Chord | None = None,
    ):
        self.workers, self.chord = workers, chord
        self.rig, self.data, self.effects, self.held = rig, data, tuple(effects), tuple(held)
        self.coarse = data.stepped(min(FIT.sensitivity_substeps, data.substeps))
        self.parameters = parameters_of(rig, self.effects)
        self.start = np.array([p.to_free(self.effects[i].values[p.name]) for i, p in self.parameters])
        each = zip(self.parameters, self.start, strict=True)
        self.steps, self.longest = np.array([_steps(p, z) for (_, p), z in each]).reshape(-1, 2).T
        self.scale, self.least, self.most = (
            np.array([getattr(p, name) for _, p in self.parameters]) for name in ("scale", "low", "high")
        )
        self.low = np.array([p.to_free(p.low) for _, p in self.parameters])
        self.high = np.array([p.to_free(p.high) for _, p in self.parameters])
        # a normal prior adds one residual: the value over its prior standard deviation
        self.with_prior = [j for j, (_, p) in enumerate(self.parameters) if p.prior_std is not None]
        self.prior_std = np.array([self.parameters[j][1].prior_std for j in self.with_prior])
        # whether the sensitivities to parameters with priors are kept
        self.has_known_slopes = chord is not None and chord.columns is not None
        # one row of sensitivities a parameter, then the residual at the base point
        self._columns = np.zeros((len(self.parameters) + 1, 0))
        self._normal: Floats | None = None

    @cached_property
    def is_coarsened(self) -> bool:
        """Whether sensitivities are simulated with coarser substeps than residuals."""
        return self.data.substeps > FIT.sensitivity_substeps and is_stepped(
            apply_all(self.rig, (*self.effects, *self.held))
        )

    def at(self, free: np.ndarray) -> tuple[Effect, ...]:
        values = [dict(effect.values) for effect in self.effects]
        # linear parameters all at once, as `from_free` has it: there are dozens of nominal errors
        indices = np.minimum(np.maximum(free * self.scale, self.least), self.most).tolist()
        for (i, parameter), z, number in zip(self.parameters, free, indices, strict=True):
            values[i][parameter.name] = parameter.from_free(z) if parameter.logarithmic else number
        return tuple(replace(e, values=v) for e, v in zip(self.effects, values, strict=True))

    def residual(self, free: np.ndarray, *, coarsely: bool = False) -> np.ndarray | None:
        data = self.coarse if coarsely else self.data
        residual = finite_residual(self.rig, (*self.at(free), *self.held), data)
        if residual is None or not self.with_prior:
            return residual
        return np.concatenate([residual, free[self.with_prior] / self.prior_std])

    def slope_base(self, free: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, bool]:
        """Base residual of the finite differences, and whether it has coarse substeps, as for a nonlinear rig.

        Sensitivities need less accuracy than residuals.
        """
        on_coarse = self.residual(free, coarsely=True) if self.is_coarsened else None
        return (residual, False) if on_coarse is None else (on_coarse, True)

    def _perturbed(self, free: np.ndarray, indices: list[int]) -> np.ndarray:
        """The free coordinates with some perturbed by a small step inside their bounds."""
        moved, step = free.copy(), self.steps[indices]
        there = free[indices] + step
        is_inside = (self.low[indices] <= there) & (there <= self.high[indices])
        moved[indices] = np.where(is_inside, there, free[indices] - step)
        return moved

    def _groups_of_sensors(self, indices: Sequence[int]) -> list[list[int]]:
        """Groups of parameters of different sensors, whose sensitivities one simulation gives.

        Empty if values of the residual mix the readings of several sensors.
        """
        both = (e for e in (*self.effects, *self.held) if e.kind.path == "sensor" and isinstance(e.target, tuple))
        if self.data.mixes_sensors or any(both) or any(sensor.crosstalk for sensor in self.rig.sensors):
            return []
        by_sensor: dict[str, list[int]] = {}
        for j in indices:
            by_sensor.setdefault(self.parameters[j][1].sensor, []).append(j)
        own = [each for name, each in by_sensor.items() if name]
        return [[each[k] for each in own if k < len(each)] for k in range(max(map(len, own), default=0))]

    def _rows_altered(self, j: int) -> Integers:
        """Indices of the values that a parameter of one sensor alters."""
        with_prior = [self.data.n_values + self.with_prior.index(j)] if j in self.with_prior else []
        return np.append(self._read_by[self.parameters[j][1].sensor], with_prior).astype(int)

    @cached_property
    def _read_by(self) -> dict[str, Integers]:
        """Indices of the values that are readings of each sensor, by name."""
        return {s.name: np.flatnonzero(self.data.sources == i) for i, s in enumerate(self.rig.sensors)}

    def slope(self, move: Move) -> bool:
        """Write the sensitivities to the perturbed parameters; False if the rig is impossible there."""
        perturbed = self.residual(move.to, coarsely=move.coarsely)
        if perturbed is None:
            return False
        for j in move.indices:
            rows = self._rows_altered(j) if move.of_sensors_alone else slice(None)
            self._columns[j, rows] = (perturbed[rows] - self._columns[-1, rows]) / (move.to[j] - move.free[j])
        return True

    def attempt(self, attempt: Attempt) -> tuple[Floats, Floats | None] | None:
        """End point of a step and the residual there; None if the predicted decrease is too small."""
        free, normal = attempt.free, attempt.normal
        diagonal = np.maximum(np.diag(normal), 1e-12 * max(np.diag(normal).max(), 1e-300))
        damped = normal + attempt.damping * np.diag(diagonal)
        straight, moving = self._damped_step(free, attempt.gradient, damped)
        if -(2.0 * attempt.gradient + normal @ straight) @ straight < attempt.least_decrease:
            return None
        curved = straight + self._geodesic_acceleration(attempt, damped, straight, moving)
        to = free + self._bounded_step(free, curved)
        return to, self.residual(to)

    def _damped_step(self, free: Floats, gradient: Floats, damped: Floats) -> tuple[Floats, Flags]:
        """The damped step, and which parameters it moves: those at a bound that they would pass stay fixed."""
        moving: Flags = np.ones(free.size, bool)
        step = np.zeros(free.size)
        for _ in range(free.size):
            among = np.ix_(moving, moving)
            step[moving] = -np.linalg.solve(damped[among], gradient[moving])
            leaving = moving & (((free <= self.low) & (step < 0)) | ((free >= self.high) & (step > 0)))
            if not leaving.any():
                break
            moving &= ~leaving
            step[leaving] = 0.0
        return step, moving

    def _bounded_step(self, free: Floats, step: Floats) -> Floats:
        """The step, limited in length and to the bounds."""
        ended: Floats = np.clip(free + np.clip(step, -self.longest, self.longest), self.low, self.high)
        return ended - free

    def _geodesic_acceleration(self, attempt: Attempt, damped: Floats, step: Floats, moving: Flags) -> Floats:
        """Geodesic acceleration: second-order correction of a step along a curved valley; zero if it is not small.

        Transtrum & Sethna (2012), arXiv:1201.5885. Along such a valley, the place and the strength of an effect
        compensate each other.
        """
        acceleration = np.zeros_like(step)
        if moving.sum() < 2:
            return acceleration
        perturbed = self.residual(attempt.free + FIT.curvature_step * step, coarsely=attempt.coarsely)
        if perturbed is None:
            return acceleration
        # J' times the second derivative along the step
        columns, residual = self._columns[:-1], self._columns[-1]
        curvature = (
            2.0 / FIT.curvature_step * (columns @ (perturbed - residual) / FIT.curvature_step - attempt.normal @ step)
        )
        acceleration[moving] = -0.5 * np.linalg.solve(damped[np.ix_(moving, moving)], curvature[moving])
        with np.errstate(over="ignore"):
            small = 2.0 * np.linalg.norm(acceleration) < FIT.max_curvature * np.linalg.norm(step)
        return acceleration if small else np.zeros_like(step)

    def run(self, job: Move | Attempt) -> Any:
        """The result of one job of an iteration."""
        return self.slope(job) if isinstance(job, Move) else self.attempt(job)

    def jacobian(self, free: Floats, residual: Floats, coarsely: bool, share: Shared) -> Floats:
        """Jacobian (n_values, n_parameters) by differences from the residual of `slope_base`.

        The next call overwrites it.
        """
        if self._columns.shape[1] != residual.size:  # before the processes that write into it are forked
            self._columns = self.workers.array(len(self.parameters) + 1, residual.size)
            if self.chord is not None and self.chord.columns is not None:
                self._columns[self.with_prior, : self.data.n_values] = self.chord.columns.T / np.sqrt(
                    self.data.temperature
                )
                self._columns[self.with_prior, self.data.n_values :] = 0.0
        jacobian = self._columns[:-1].T
        fresh = [j for j in range(len(self.parameters)) if not self.has_known_slopes or j not in self.with_prior]
        groups = self._groups_of_sensors(fresh)
        self._columns[[j for group in groups for j in group]], self._columns[-1] = 0.0, residual
        alone = [j for j in fresh if all(j not in group for group in groups)]
        moves = [Move(free, self._perturbed(free, group), group, coarsely, of_sensors_alone=True) for group in groups]
        moves += (Move(free, self._perturbed(free, [j]), [j], coarsely) for j in alone)
        # where the perturbed rig is impossible: each parameter alone, then to its other side
        failed = [move for move, can_be in zip(moves, share(moves), strict=True) if not can_be]
        self._columns[[j for move in failed for j in move.indices]] = 0.0
        single = [j for move in failed if len(move.indices) > 1 for j in move.indices]
        moves = [Move(free, self._perturbed(free, [j]), [j], coarsely) for j in single]
        failed = [move for move in failed if len(move.indices) == 1]
        failed += (move for move, can_be in zip(moves, share(moves), strict=True) if not can_be)
        share([Move(free, 2.0 * free - move.to, move.indices, coarsely) for move in failed])
        if self.has_known_slopes:
            jacobian[residual.size - len(self.with_prior) :, self.with_prior] = np.diag(1.0 / self.prior_std)
        self.has_known_slopes = self.has_known_slopes or self.chord is not None
        return jacobian

    def store_chord(self) -> None:
        """Store the sensitivities to parameters with priors in the chord, if it has none yet."""
        chord = self.chord
        if chord is not None and chord.columns is None and self.has_known_slopes:
            columns = self._columns[self.with_prior, : self.data.n_values].T
            with np.errstate(invalid="ignore"):  # the temperature is infinite where the simulation diverges
                chord.columns = np.sqrt(self.data.temperature) * columns

    def close(self) -> None:
        """Release the memory of the sensitivities."""
        self.workers.give_back(self._columns)
        self._columns = self._columns[:, :0]

    def normal(self, jacobian: np.ndarray) -> np.ndarray:
        """Jᵀ J; the block of kept sensitivities is computed once."""
        if not self.has_known_slopes or self._normal is None:
            self._normal = jacobian.T @ jacobian
            return self._normal
        fresh = np.setdiff1d(np.arange(jacobian.shape[1]), self.with_prior)
        product = self._normal.copy()
        product[:, fresh] = jacobian.T @ jacobian[:, fresh]
        product[fresh] = product[:, fresh].T
        return product


def _steps(parameter: Parameter, free: float) -> tuple[float, float]:
    """Finite-difference step and longest step of an iteration, of a free coordinate.

    The longest step is a factor e, a tenth of the length, or the coordinate's own size.
    """
    if parameter.logarithmic or parameter.name in COORDINATES:
        return 1e-4, 1.0 if parameter.logarithmic else 10.0
    return FIT.nominal_error_step if parameter.prior_std else 1e-3 * abs(free) + 1e-9, 3.0 * abs(free) + 10.0


def parameters_of(rig: Rig, effects: Sequence[Effect]) -> list[tuple[int, Parameter]]:
    """The parameters of effects in the order in which they are fitted, each with the index of its effect."""
    return [(i, parameter) for i, effect in enumerate(effects) for parameter in effect.parameters(rig)]


def deviations_by_effect(
    effects: Sequence[Effect], parameters: Sequence[tuple[int, Parameter]], free: Floats
) -> list[dict[str, float]]:
    """Standard deviations of the parameters of each effect, by name, from those of the free coordinates.

    Args:
        parameters: of `parameters_of`.
        free: (n_parameters,) standard deviations.
    """
    found: list[dict[str, float]] = [{} for _ in effects]
    for (i, parameter), deviation in zip(parameters, free, strict=True):
        value = effects[i].values[parameter.name]
        found[i][parameter.name] = float(abs(parameter.slope(value)) * deviation)
    return found


def slopes(
    rig: Rig,
    effects: Sequence[Effect],
    data: FitData,
    held: Sequence[Effect] = (),
    workers: Workers = ALONE,
    *,
    differences: Literal["forward", "central", "wide"] = "forward",
) -> tuple[np.ndarray, np.ndarray]:
    """The residual (n_values,) and its derivatives (n_values, n_parameters) by the free coordinates of effects.

    Args:
        differences: forward, as in a fit; central, with shorter steps, so that what parameters could do for each other
            cancels to second order; or central with long steps, which average out numerical errors of the modes.

    Raises:
        ValueError: the rig cannot be simulated with these effects.
    """
    problem = _Problem(rig, effects, data, held, workers)
    if differences == "central":
        problem.steps *= FIT.std_step
    if differences == "wide":
        problem.steps *= [
            FIT.wide_place_step
            if p.name in COORDINATES
            else FIT.wide_step * (1e-2 / FIT.nominal_error_step if p.prior_std else 1.0)
            for _, p in problem.parameters
        ]
    residual = problem.residual(problem.start)
    if residual is None:
        raise ValueError("the rig cannot be simulated with these effects")
    with workers.pool(problem.run) as share:
        slope_base = problem.slope_base(problem.start, residual)
        jacobian = problem.jacobian(problem.start, *slope_base, share)
        if differences != "forward":
            jacobian, problem.steps = jacobian.copy(), -problem.steps
            jacobian = 0.5 * (jacobian + problem.jacobian(problem.start, *slope_base, share))
    return residual[: data.n_values], jacobian[: data.n_values]


def sensitivity(rig: Rig, effects: Sequence[Effect], data: FitData, workers: Workers = ALONE) -> np.ndarray:
    """Sensitivities (n_values, n_parameters) to parameters with priors, each times its prior standard deviation."""
    along: np.ndarray = slopes(rig, effects, data, workers=workers)[1]
    scaled: np.ndarray = along * np.array([parameter.prior_std for _, parameter in parameters_of(rig, effects)], float)
    return scaled


def fit(
    rig: Rig,
    effects: Sequence[Effect],
    data: FitData,
    *,
    held: Sequence[Effect] = (),
    iterations: int = 25,
    tolerance: float = 1e-5,
    workers: Workers = ALONE,
    chord: Chord | None = None,
    damping: float = FIT.damping,
) -> Fit:
    """Levenberg-Marquardt fit of all parameters of the effects, from the values they carry.

    Args:
        rig: nominal.
        effects: with start values.
        data: fit records.
        held: further effects that stay fixed.
        iterations: at most.
        tolerance: relative decrease of the cost at which to stop.
        workers: processes that share the sensitivities, where they are many.
        chord: sensitivities to parameters with priors that are kept, or filled in at the first iteration; None to
            update them in every iteration.
        damping: of the first step, as a share of the diagonal of Jᵀ J.
    """
    problem = _Problem(rig, effects, data, held, workers, chord)
    residual = problem.residual(problem.start)
    if residual is None:
        shape = (len(data.records), data.noise.size)
        return Fit(tuple(effects), DIVERGED, np.full(shape, DIVERGED), problem.start.size)
    with workers.pool(problem.run) as share:
        found = _minimised(problem, share, residual, iterations, tolerance, damping)
    problem.store_chord()
    problem.close()
    return found


def _minimised(
    problem: _Problem, share: Shared, residual: Floats, iterations: int, tolerance: float, damping: float
) -> Fit:
    """The fit by Levenberg-Marquardt iterations from the start point, where the residual is given."""
    free = problem.start.copy()
    cost = float(residual @ residual)
    falling = 0.0
    normal = np.zeros((free.size, free.size))
    for _ in range(iterations if free.size else 0):
        if problem.data.deadline.is_past:
            falling = 0.0
            break
        base, coarsely = problem.slope_base(free, residual)
        jacobian = problem.jacobian(free, base, coarsely, share)
        normal, gradient = problem.normal(jacobian), jacobian.T @ residual
        dampings = accumulate([damping, *[FIT.damping_factor] * (FIT.max_attempts - 1)], mul)
        least_decrease = FIT.least_predicted_decrease * tolerance * cost
        attempts = (Attempt(free, coarsely, normal, gradient, each, least_decrease) for each in dampings)
        found = _first_descent(cost, attempts, share, problem.workers.at_once)
        if found is None:
            falling = 0.0
            break
        (free, residual), damping = found
        falling = 1.0 - float(residual @ residual) / cost
        cost, damping = float(residual @ residual), max(damping / 8.0, 1e-9)
        if falling < tolerance:
            falling = 0.0
            break
    return _result(problem, free, residual, normal, falling)


def _first_descent(
    cost: float, attempts: Iterator[Attempt], share: Shared, at_once: int
) -> tuple[tuple[Floats, Floats], float] | None:
    """End point and residual of the first step that lowers the cost, and its damping; None if none does.

    As many steps are tried at once as there are processes, since about half of them fail.
    """
    while some := list(islice(attempts, at_once)):
        for attempt, ended in zip(some, share(some), strict=True):
            if ended is None:
                return None
            if ended[1] is not None and ended[1] @ ended[1] < cost:
                return ended, attempt.damping
    return None


def _result(problem: _Problem, free: np.ndarray, residual: np.ndarray, normal: np.ndarray, falling: float) -> Fit:
    residual = residual[: problem.data.n_values]
    cost = float(residual @ residual) / residual.size
    deviations = np.zeros(free.size)
    if free.size and np.trace(normal) > 0:
        scaled = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = np.linalg.pinv(normal / np.outer(scaled, scaled), rcond=1e-12)
        deviations = np.sqrt(np.maximum(np.diag(inverse), 0.0)) / scaled * np.sqrt(max(cost, 1.0))
    effects = problem.at(free)
    each = deviations_by_effect(effects, problem.parameters, deviations)
    return Fit(
        effects=tuple(replace(e, std=d) for e, d in zip(effects, each, strict=True)),
        normal=normal,
        cost=cost,
        cost_by_channel=problem.data.by_channel(residual),
        n_parameters=free.size,
        falling=falling,
    )
