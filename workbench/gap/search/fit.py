"""Fit of a set of effects to the fit records: nonlinear least squares of the simulation error."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, islice
from operator import mul
from typing import Any

import numpy as np

from workbench.arrays import Flags, Floats, Integers
from workbench.gap.effects.effect import COORDINATES, Effect, Parameter, apply_all, key_of
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE, Workers
from workbench.gap.search.settings import FIT
from workbench.rig.rig import Rig
from workbench.rig.simulate import is_stepped

HOPELESS = 1e300


@dataclass(frozen=True, eq=False)
class Fit:
    """A set of effects with fitted numbers.

    Attributes:
        effects: with values and standard deviations.
        cost: what was minimised per measured value: 1 at the noise floor.
        cost_by_channel: (n_records, n_outputs) of the same, without the share of a random disturbance's statistics.
        n_parameters: numbers fitted.
        falling: share of the cost that the last iteration took away; 0 where the fit came to rest.
        covariance: (n, n) of the free coordinates of all parameters, in the order of `parameters_of`; None before
            `with_intervals`.
        stepping: (n_records,) mean square error of the steps of time, in units of the noise, where it was measured.
        normal: (n, n) Jᵀ J of the free coordinates of all parameters, with the precision of what is believed.
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
        """Labels of the effects, without errors of the nominal model, in one string."""
        return " + ".join(effect.label for effect in self.effects if not effect.kind.applied_first)

    @property
    def key(self) -> tuple[str, ...]:
        """What tells this set from another, numbers apart."""
        return key_of(self.effects)


def cost_of(rig: Rig, effects: Sequence[Effect], data: FitData) -> float:
    """Cost per measured value; `HOPELESS` where the rig cannot be (a buckled beam, say)."""
    residual = finite_residual(rig, effects, data)
    return HOPELESS if residual is None else float(residual @ residual) / residual.size


def finite_residual(rig: Rig, effects: Sequence[Effect], data: FitData) -> np.ndarray | None:
    """The residual (n_values,) of a rig with effects, or None where it cannot be or its motion runs away."""
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            residual = data.residual(apply_all(rig, effects))
        except (ValueError, np.linalg.LinAlgError):
            return None
        return residual if residual @ residual < HOPELESS else None


@dataclass(frozen=True, eq=False)
class Move:
    """Numbers that are moved at once, to see what each does to the residual.

    Attributes:
        free: (n_parameters,) all of them.
        to: where they are moved.
        numbers: which of them.
        coarsely: whether the residual is taken by coarser steps of time.
        of_sensors_alone: whether each alters the readings of a sensor of its own, and no other's.
    """

    free: Floats
    to: Floats
    numbers: list[int]
    coarsely: bool
    of_sensors_alone: bool = False


@dataclass(frozen=True, eq=False)
class Attempt:
    """A step that may lower the cost.

    Attributes:
        free: (n_parameters,) where it starts.
        coarsely: whether slopes there are taken by coarser steps of time.
        normal, gradient: Jᵀ J and Jᵀ r there.
        damping: as a share of the diagonal of Jᵀ J.
        worth: the least decrease of the cost, to second order, for which it is tried.
    """

    free: Floats
    coarsely: bool
    normal: Floats
    gradient: Floats
    damping: float
    worth: float


Shared = Callable[[Sequence[Move | Attempt]], list[Any]]


@dataclass(eq=False)
class Chord:
    """Slopes along believed values that fits of the same records keep: small errors move a residual all but linearly.

    Attributes:
        columns: (n_values, n_believed), in units of the noise; None until a fit has taken them.
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
        self.coarse = data.stepped(min(FIT.slope_substeps, data.substeps))
        self.parameters = parameters_of(rig, self.effects)
        self.start = np.array([p.to_free(self.effects[i].values[p.name]) for i, p in self.parameters])
        floor = [
            FIT.short if p.prior_std else 1e-2 if p.logarithmic or p.name in COORDINATES else 1e-3 * abs(z) + 1e-9
            for (_, p), z in zip(self.parameters, self.start, strict=True)
        ]
        self.steps = np.array(floor)
        self.scale, self.least, self.most = (
            np.array([getattr(p, name) for _, p in self.parameters]) for name in ("scale", "low", "high")
        )
        self.low = np.array([p.to_free(p.low) for _, p in self.parameters])
        self.high = np.array([p.to_free(p.high) for _, p in self.parameters])
        # a believed value is one more measurement: of itself, by its own standard deviation
        self.believed = [j for j, (_, p) in enumerate(self.parameters) if p.prior_std is not None]
        self.prior_std = np.array([self.parameters[j][1].prior_std for j in self.believed])
        # whether the slopes along believed values stay as they are
        self.is_known = chord is not None and chord.columns is not None
        # a row a number, of what it does to each value, and one of the residual beside which it does
        self._columns = np.zeros((len(self.parameters) + 1, 0))
        self._normal: Floats | None = None

    @cached_property
    def is_coarsened(self) -> bool:
        """Whether slopes are taken by coarser steps of time than residuals."""
        return self.data.substeps > FIT.slope_substeps and is_stepped(apply_all(self.rig, (*self.effects, *self.held)))

    def at(self, free: np.ndarray) -> tuple[Effect, ...]:
        values = [dict(effect.values) for effect in self.effects]
        # what is no logarithm at once, as `from_free` has it: errors are dozens
        numbers = np.minimum(np.maximum(free * self.scale, self.least), self.most).tolist()
        for (i, parameter), z, number in zip(self.parameters, free, numbers, strict=True):
            values[i][parameter.name] = parameter.from_free(z) if parameter.logarithmic else number
        return tuple(replace(e, values=v) for e, v in zip(self.effects, values, strict=True))

    def residual(self, free: np.ndarray, *, coarsely: bool = False) -> np.ndarray | None:
        data = self.coarse if coarsely else self.data
        residual = finite_residual(self.rig, (*self.at(free), *self.held), data)
        if residual is None or not self.believed:
            return residual
        return np.concatenate([residual, free[self.believed] / self.prior_std])

    def near(self, free: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, bool]:
        """The residual that slopes start from, and whether it is by coarser steps of time, as it is for a stepped rig.

        Slopes need not be as exact as residuals.
        """
        on_coarse = self.residual(free, coarsely=True) if self.is_coarsened else None
        return (residual, False) if on_coarse is None else (on_coarse, True)

    def _moved(self, free: np.ndarray, numbers: Sequence[int]) -> np.ndarray:
        """The free coordinates with some a small step away, inside their bounds."""
        moved = free.copy()
        for j in numbers:
            parameter = self.parameters[j][1]
            step = 0.01 * self.steps[j] if parameter.logarithmic or parameter.name in COORDINATES else self.steps[j]
            moved[j] = free[j] - step if self.high[j] < free[j] + step else free[j] + step
        return moved

    def _of_sensors_alone(self, numbers: Sequence[int]) -> list[list[int]]:
        """Groups of numbers of different sensors, which one move tells apart; none where values mix their readings."""
        both = (e for e in (*self.effects, *self.held) if e.kind.path == "sensor" and isinstance(e.target, tuple))
        if self.data.mixes_sensors or any(both) or any(sensor.crosstalk for sensor in self.rig.sensors):
            return []
        by_sensor: dict[str, list[int]] = {}
        for j in numbers:
            by_sensor.setdefault(self.parameters[j][1].sensor, []).append(j)
        own = [each for name, each in by_sensor.items() if name]
        return [[each[k] for each in own if k < len(each)] for k in range(max(map(len, own), default=0))]

    def _altered(self, j: int) -> Integers:
        """The values that a number of one sensor alters."""
        believed = [self.data.n_values + self.believed.index(j)] if j in self.believed else []
        return np.append(self._read_by[self.parameters[j][1].sensor], believed).astype(int)

    @cached_property
    def _read_by(self) -> dict[str, Integers]:
        """By name of sensor, the values that are its readings."""
        return {s.name: np.flatnonzero(self.data.sources == i) for i, s in enumerate(self.rig.sensors)}

    def slope(self, move: Move) -> bool:
        """Write the columns of what a move tells, from the residual beside; False where the rig cannot be there."""
        beside = self.residual(move.to, coarsely=move.coarsely)
        if beside is None:
            return False
        for j in move.numbers:
            rows = self._altered(j) if move.of_sensors_alone else slice(None)
            self._columns[j, rows] = (beside[rows] - self._columns[-1, rows]) / (move.to[j] - move.free[j])
        return True

    def attempt(self, attempt: Attempt) -> tuple[Floats, Floats | None] | None:
        """Where a step leads, and the residual there if the rig can be; None where it promises too little."""
        free, normal = attempt.free, attempt.normal
        diagonal = np.maximum(np.diag(normal), 1e-12 * max(np.diag(normal).max(), 1e-300))
        damped = normal + attempt.damping * np.diag(diagonal)
        straight, moving = _straight(self, free, attempt.gradient, damped)
        if -(2.0 * attempt.gradient + normal @ straight) @ straight < attempt.worth:
            return None
        to = free + _bounded(self, free, straight + self._bend(attempt, damped, straight, moving))
        return to, self.residual(to)

    def _bend(self, attempt: Attempt, damped: Floats, step: Floats, moving: Flags) -> Floats:
        """What a step turns by in a valley that bends: geodesic acceleration, none where it is no small correction.

        Transtrum & Sethna (2012), arXiv:1201.5885. A place and a strength make up for one another along such a valley.
        """
        turn = np.zeros_like(step)
        if moving.sum() < 2:
            return turn
        beside = self.residual(attempt.free + FIT.bent * step, coarsely=attempt.coarsely)
        if beside is None:
            return turn
        # J' times the second derivative along the step
        columns, residual = self._columns[:-1], self._columns[-1]
        curvature = 2.0 / FIT.bent * (columns @ (beside - residual) / FIT.bent - attempt.normal @ step)
        turn[moving] = -0.5 * np.linalg.solve(damped[np.ix_(moving, moving)], curvature[moving])
        with np.errstate(over="ignore"):
            small = 2.0 * np.linalg.norm(turn) < FIT.most_bent * np.linalg.norm(step)
        return turn if small else np.zeros_like(step)

    def done(self, job: Move | Attempt) -> Any:
        """A share of the work of an iteration."""
        return self.slope(job) if isinstance(job, Move) else self.attempt(job)

    def jacobian(self, free: Floats, residual: Floats, coarsely: bool, share: Shared) -> Floats:
        """Differences from the residual that `near` gives; the next call overwrites them."""
        if self._columns.shape[1] != residual.size:  # before helpers are forked, which write into them
            self._columns = self.workers.array(len(self.parameters) + 1, residual.size)
            if self.chord is not None and self.chord.columns is not None:
                self._columns[self.believed, : self.data.n_values] = self.chord.columns.T / np.sqrt(self.data.heat)
                self._columns[self.believed, self.data.n_values :] = 0.0
        jacobian = self._columns[:-1].T
        fresh = [j for j in range(len(self.parameters)) if not self.is_known or j not in self.believed]
        groups = self._of_sensors_alone(fresh)
        self._columns[[j for group in groups for j in group]], self._columns[-1] = 0.0, residual
        alone = [j for j in fresh if all(j not in group for group in groups)]
        moves = [Move(free, self._moved(free, group), group, coarsely, of_sensors_alone=True) for group in groups]
        moves += (Move(free, self._moved(free, [j]), [j], coarsely) for j in alone)
        # where the rig cannot be: each number alone, and then to its other side
        failed = [move for move, can_be in zip(moves, share(moves), strict=True) if not can_be]
        self._columns[[j for move in failed for j in move.numbers]] = 0.0
        single = [j for move in failed if len(move.numbers) > 1 for j in move.numbers]
        moves = [Move(free, self._moved(free, [j]), [j], coarsely) for j in single]
        failed = [move for move in failed if len(move.numbers) == 1]
        failed += (move for move, can_be in zip(moves, share(moves), strict=True) if not can_be)
        share([Move(free, 2.0 * free - move.to, move.numbers, coarsely) for move in failed])
        if self.is_known:
            jacobian[residual.size - len(self.believed) :, self.believed] = np.diag(1.0 / self.prior_std)
        self.is_known = self.is_known or self.chord is not None
        return jacobian

    def keep(self) -> None:
        """Hand on the slopes along believed values, where they are to be kept and are not yet."""
        chord = self.chord
        if chord is not None and chord.columns is None and self.is_known:
            chord.columns = np.sqrt(self.data.heat) * self._columns[self.believed, : self.data.n_values].T

    def end(self) -> None:
        """No slope is asked for any more."""
        self.workers.give_back(self._columns)
        self._columns = self._columns[:, :0]

    def normal(self, jacobian: np.ndarray) -> np.ndarray:
        """Jᵀ J; the part of sensitivities that are known is multiplied once."""
        if not self.is_known or self._normal is None:
            self._normal = jacobian.T @ jacobian
            return self._normal
        fresh = np.setdiff1d(np.arange(jacobian.shape[1]), self.believed)
        product = self._normal.copy()
        product[:, fresh] = jacobian.T @ jacobian[:, fresh]
        product[fresh] = product[:, fresh].T
        return product


def parameters_of(rig: Rig, effects: Sequence[Effect]) -> list[tuple[int, Parameter]]:
    """The parameters of effects in the order in which they are fitted, each with the index of its effect."""
    return [(i, parameter) for i, effect in enumerate(effects) for parameter in effect.parameters(rig)]


def slopes(
    rig: Rig,
    effects: Sequence[Effect],
    data: FitData,
    held: Sequence[Effect] = (),
    workers: Workers = ALONE,
    *,
    wide: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """The residual (n_values,), and its derivative by each parameter of effects, in its free coordinate.

    Args:
        wide: by longer steps, both ways, over which errors of modes that are solved anew do not show.

    Raises:
        ValueError: the rig cannot be simulated with these effects.
    """
    problem = _Problem(rig, effects, data, held, workers)
    if wide:
        problem.steps *= [
            FIT.wider_place if p.name in COORDINATES else FIT.wider * (1e-2 / FIT.short if p.prior_std else 1.0)
            for _, p in problem.parameters
        ]
    residual = problem.residual(problem.start)
    if residual is None:
        raise ValueError("the rig cannot be simulated with these effects")
    with workers.standing(problem.done) as share:
        near = problem.near(problem.start, residual)
        jacobian = problem.jacobian(problem.start, *near, share)
        if wide:
            jacobian, problem.steps = jacobian.copy(), -problem.steps
            jacobian = 0.5 * (jacobian + problem.jacobian(problem.start, *near, share))
    return residual[: data.n_values], jacobian[: data.n_values]


def sensitivity(rig: Rig, effects: Sequence[Effect], data: FitData, workers: Workers = ALONE) -> np.ndarray:
    """The slopes along the numbers of believed effects, each in units of its belief."""
    along: np.ndarray = slopes(rig, effects, data, workers=workers)[1]
    scaled: np.ndarray = along * _Problem(rig, effects, data).prior_std
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
    """Levenberg-Marquardt over all parameters of the effects, from the values they carry.

    Args:
        rig: nominal.
        effects: with start values.
        data: fit records.
        held: effects that are there too, and stay as they are.
        iterations: at most.
        tolerance: relative decrease of the cost at which to stop.
        workers: processes that share the sensitivities, where they are many.
        chord: slopes along parameters with priors that are kept, those of the first iteration where none are yet;
            None to take them anew.
        damping: of the first step, as a share of the diagonal of Jᵀ J.
    """
    problem = _Problem(rig, effects, data, held, workers, chord)
    residual = problem.residual(problem.start)
    if residual is None:
        shape = (len(data.records), data.noise.size)
        return Fit(tuple(effects), HOPELESS, np.full(shape, HOPELESS), problem.start.size)
    with workers.standing(problem.done) as share:
        found = _descended(problem, share, residual, iterations, tolerance, damping)
    problem.keep()
    problem.end()
    return found


def _descended(
    problem: _Problem, share: Shared, residual: Floats, iterations: int, tolerance: float, damping: float
) -> Fit:
    """The fit from where the problem starts, with this residual."""
    free = problem.start.copy()
    cost = float(residual @ residual)
    falling = 0.0
    normal = np.zeros((free.size, free.size))
    for _ in range(iterations if free.size else 0):
        if problem.data.deadline.is_past:
            falling = 0.0
            break
        nearly, coarsely = problem.near(free, residual)
        jacobian = problem.jacobian(free, nearly, coarsely, share)
        normal, gradient = problem.normal(jacobian), jacobian.T @ residual
        dampings = accumulate([damping, *[FIT.less_far] * (FIT.attempts - 1)], mul)
        worth = FIT.promised * tolerance * cost
        attempts = (Attempt(free, coarsely, normal, gradient, each, worth) for each in dampings)
        found = _first_below(cost, attempts, share, problem.workers.at_once)
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


def _first_below(
    cost: float, attempts: Iterator[Attempt], share: Shared, at_once: int
) -> tuple[tuple[Floats, Floats], float] | None:
    """Where the first step leads that lowers the cost, with the residual there, and its damping.

    As many are tried at once as there are processes: every other one fails, and the next would wait for it.
    """
    while some := list(islice(attempts, at_once)):
        for attempt, ended in zip(some, share(some), strict=True):
            if ended is None:
                return None
            if ended[1] is not None and ended[1] @ ended[1] < cost:
                return ended, attempt.damping
    return None


def _straight(problem: _Problem, free: Floats, gradient: Floats, damped: Floats) -> tuple[Floats, Flags]:
    """The damped step, and which numbers it moves: one at a bound that it would pass stays, the others do without."""
    moving: Flags = np.ones(free.size, bool)
    step = np.zeros(free.size)
    for _ in range(free.size):
        among = np.ix_(moving, moving)
        step[moving] = -np.linalg.solve(damped[among], gradient[moving])
        leaving = moving & (((free <= problem.low) & (step < 0)) | ((free >= problem.high) & (step > 0)))
        if not leaving.any():
            break
        moving &= ~leaving
        step[leaving] = 0.0
    return step, moving


def _bounded(problem: _Problem, free: Floats, step: Floats) -> Floats:
    """The step, no longer than is sensible, and inside the bounds."""
    reach = _reach(problem)
    step = np.clip(step, -reach, reach)
    ended: Floats = np.clip(free + step, problem.low, problem.high)
    return ended - free


def _reach(problem: _Problem) -> np.ndarray:
    """Longest step of each free coordinate: a factor e, a tenth of the length, or its own size."""
    return np.array(
        [
            1.0 if p.logarithmic else 10.0 if p.name in COORDINATES else 3.0 * abs(z) + 10.0
            for (_, p), z in zip(problem.parameters, problem.start, strict=True)
        ]
    )


def _result(problem: _Problem, free: np.ndarray, residual: np.ndarray, normal: np.ndarray, falling: float) -> Fit:
    residual = residual[: problem.data.n_values]
    cost = float(residual @ residual) / residual.size
    deviations = np.zeros(free.size)
    if free.size and np.trace(normal) > 0:
        scaled = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = np.linalg.pinv(normal / np.outer(scaled, scaled), rcond=1e-12)
        deviations = np.sqrt(np.maximum(np.diag(inverse), 0.0)) / scaled * np.sqrt(max(cost, 1.0))
    effects = problem.at(free)
    spread: list[dict[str, float]] = [{} for _ in effects]
    for (i, parameter), deviation in zip(problem.parameters, deviations, strict=True):
        value = effects[i].values[parameter.name]
        spread[i][parameter.name] = float(abs(parameter.slope(value)) * deviation)
    return Fit(
        effects=tuple(replace(e, deviations=s) for e, s in zip(effects, spread, strict=True)),
        normal=normal,
        cost=cost,
        cost_by_channel=problem.data.by_channel(residual),
        n_parameters=free.size,
        falling=falling,
    )
