"""Levenberg-Marquardt least squares, stepwise selection of modes, and the time limit of both.

Nonlinear least squares (Levenberg-Marquardt): a problem is a sum of squares with the linear parameters eliminated
(variable projection, Golub & Pereyra 1973), or a likelihood (Fisher scoring). Each gives a matrix N and a right-hand
side g at the current parameters. The damped step s (Marquardt 1963) does not depend on the units of the parameters:

    (D N D + μ I) D⁻¹ s = D g,     D = diag(N)^-½

Model order (stepwise selection). Forward: the strongest candidate enters, all modes are fitted again, and it stays if
twice the log-likelihood ratio exceeds what noise would give in one record of a thousand. Backward: each mode that is
weak, close to another or spurious is left out in turn, and removed if the likelihood ratio without it is not
significant. Both alternate until the modes no longer change.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import least_squares

from workbench.arrays import Floats
from workbench.deadline import Deadline
from workbench.structure.modes import mac
from workbench.threads import is_piece

State = TypeVar("State")
SECONDS = 30.0  # processor time limit
WHOLE = 0.995  # share of the time from which on a search counts as ended by the limit as a whole
FURTHER = "search for further modes"
STOPPED = "stopped after"  # first words of the remark on an exceeded time limit
FALSE_ALARM = 1e-3  # probability that a record of noise alone yields a mode


@dataclass(frozen=True)
class FitSettings:
    """Constants of every fit of modes."""

    max_steps: int = 60
    # predicted decrease of χ² per value; the step then moves the estimate by under a thousandth of its standard error
    cost_tolerance: float = 1e-6
    round_off: float = 1e-26  # of a sum of squares, relative to that of the measurement
    max_growth: float = 20.0  # nepers over a record; poles that grow faster are inadmissible
    max_decay: float = 1.0  # nepers per sample; poles that decay faster are inadmissible
    # of a participation factor to the one normalised to 1; diverging factors are no mode's, and overflow
    max_participation_ratio: float = 1e20


@dataclass(frozen=True)
class SelectionSettings:
    """Constants of every selection of modes."""

    search_share: float = 0.5  # of the time, for the selection of modes; the rest is for refinement and errors
    forward_share: float = 0.6  # of the time left, for one forward search; the rest is to test the new modes
    max_damping: float = 0.3  # ratio above which a pole is no mode
    max_growth: float = 0.5  # nepers over a record above which a pole grows: it may be coloured noise
    min_split_mac: float = 0.95  # from which on two overlapping poles are one mode, split
    max_rounds: int = 4  # in coloured noise, or with amplitude dependence, modes might enter and leave for ever
    trial_steps: int = 12  # of a fit that only decides whether a mode enters or leaves
    trial_tolerance: float = 0.1  # decrease of χ², expected of a further step per value, below which such a fit ends
    weak_ratio: float = 4.0  # to the threshold, below which a mode may be noise and is tested again
    close_bandwidths: float = 2.0  # to the next mode, likewise
    noise_bins: int = 50  # on either side of a pole, from which the noise about it is estimated
    peaks_per_rate: int = 12  # candidates per decay rate, in records with known inputs


FIT = FitSettings()
SELECTION = SelectionSettings()
# Probability (1 - MAC)^(n_signals - 1) that random shapes of three signals agree so far; shapes of fewer signals must
# have a higher MAC to be as improbable.
BY_CHANCE = (1.0 - SELECTION.min_split_mac) ** 2

# (the search under way, the share of the time that is spent)
Progress = Callable[[str, float], None]


class TimeLimit(Deadline):
    """A limit of processor time for an identification, and the searches that it ended early.

    `unfinished` holds the name of each search that was ended early, and the share of the whole time that had passed.
    """

    def __init__(self, seconds: float | None = None, progress: Progress | None = None) -> None:
        super().__init__(seconds)
        self.progress, self._whole = progress, self._end
        self.unfinished: dict[str, float] = {}

    def spent(self, search: str) -> bool:
        """Whether the time is up; then `search` is recorded as unfinished."""
        if self.progress is not None and not is_piece():  # a caller need not expect another thread
            self.progress(search, min((self._now - self._begun) / (self._whole - self._begun), 1.0))
        if not self.is_past:
            return False
        self.unfinished.setdefault(search, (self._end - self._begun) / (self._whole - self._begun))
        return True

    def share(self, share: float) -> "TimeLimit":
        """A limit of a share of the time left, in (0, 1]; both record unfinished searches together."""
        part = TimeLimit(None if self.seconds is None else share * max(self._end - self._now, 1e-3), self.progress)
        part.unfinished, part._begun, part._whole = self.unfinished, self._begun, self._whole
        return part

    def aside(self, share: float) -> "TimeLimit":
        """A limit of a share of the time left for a preliminary search; its unfinished searches are not recorded."""
        return TimeLimit(self.share(share).seconds)

    def apart(self, share: float) -> "TimeLimit":
        """A limit of a share of the time left for one of several tasks; `counted` records its unfinished searches."""
        part = self.share(share)
        part.unfinished = {}
        return part

    def counted(self, part: "TimeLimit") -> None:
        """Record the unfinished searches of a limit from `apart`."""
        for search, share in part.unfinished.items():
            self.unfinished.setdefault(search, share)

    @property
    def remarks(self) -> tuple[str, ...]:
        """A remark that lists the unfinished searches; empty where all were finished."""
        if not self.unfinished:
            return ()
        each = (
            f"{what} (ended at {100.0 * share:.0f} % of it)" if share < WHOLE else what
            for what, share in self.unfinished.items()
        )
        return (
            f"{STOPPED} {self._now - self._begun:.2g} s of the {self.seconds:g} s allowed, unfinished:"
            f" {', '.join(each)}; allow more time by `seconds`",
        )


@dataclass(frozen=True)
class DampingSettings:
    """How the damping μ, relative to the diagonal of N, is adapted from step to step.

    The minimum does not depend on these numbers, only the number of steps does; they follow Marquardt.
    """

    initial: float = 1e-3
    raising_factor: float = 8.0  # after a step that raised the cost
    lowering_factor: float = 0.1  # after a step that lowered it
    minimum: float = 1e-12
    maximum: float = 1e8  # above it no step is tried: s has shrunk to a gradient step of 1e-8 standard errors
    stop_above: float = 1e6  # the search ends after a step
    indefinite_minimum: float = 1e-9  # where N is not positive definite


DAMPING = DampingSettings()


def check_count(name: str, number: int | None) -> None:
    """Refuse a number of modes below one, by a ValueError that names it."""
    if number is not None and number < 1:
        raise ValueError(f"{name} is a number of modes, 1 or more; got {number}")


class LeastSquares(Protocol[State]):
    """A problem for `minimise`; its state holds the parameters and what was computed from them."""

    def cost(self, state: State) -> float:
        """The function that is minimised; infinite where the state is not admissible."""

    def normal_equations(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """N (n_unknowns, n_unknowns), half the Hessian or near it, and g (n_unknowns,), half the negative gradient."""

    def moved(self, state: State, step: np.ndarray) -> tuple[State | None, np.ndarray]:
        """The state after a step, None where it is not admissible, and the part of the step that was taken."""

    def negligible(self, decrease: float, cost: float) -> bool:
        """Whether a step of this predicted decrease of the cost may be the last."""


@dataclass(frozen=True, eq=False)
class Minimum(Generic[State]):
    """The state of least cost, its cost, whether the last step was negligible, and the number of steps."""

    state: State
    cost: float
    converged: bool
    steps: int


def minimise(
    problem: LeastSquares[State],
    start: State,
    *,
    most_steps: int,
    round_off: float = 0.0,
    time_limit: TimeLimit | None = None,
    is_vain: Callable[[State], bool] = lambda state: False,
) -> Minimum[State]:
    """The local minimum of a problem next to `start`, an admissible state.

    Args:
        round_off: of the cost; a step that raises it by no more is accepted.
        is_vain: whether a state ends the search, since what follows from it is of no use.
    """
    state, cost, damping, small = start, problem.cost(start), DAMPING.initial, False
    for taken in range(1, most_steps + 1):
        normal, right = problem.normal_equations(state)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        scaled, identity = normal * np.outer(scale, scale), np.eye(right.size)
        while True:
            try:
                step = scale * cho_solve(cho_factor(scaled + damping * identity), scale * right)
            except np.linalg.LinAlgError:
                damping = max(DAMPING.raising_factor * damping, DAMPING.indefinite_minimum)
                continue
            trial, step = problem.moved(state, step)
            small = problem.negligible(float(step @ right), cost)
            new_cost = np.inf if trial is None else problem.cost(trial)
            accepted = trial is not None and new_cost <= cost + round_off
            if accepted or small or damping > DAMPING.maximum:
                break
            damping *= DAMPING.raising_factor
        if accepted and trial is not None:
            state, cost = trial, new_cost
        damping = max(DAMPING.lowering_factor * damping, DAMPING.minimum)
        if small or damping > DAMPING.stop_above:
            return Minimum(state, cost, small, taken)
        if is_vain(state) or (time_limit is not None and time_limit.spent("refinement")):
            return Minimum(state, cost, False, taken)
    return Minimum(state, cost, False, most_steps)


class CachedResidual:
    """A function for the residual (n,) and its Jacobian (n, n_unknowns) that keeps its last value.

    SciPy's least squares asks for both at the same unknowns in turn; here they are computed together.
    """

    def __init__(self, fitted: Callable[[Floats], tuple[Floats, Floats]]) -> None:
        self.fitted, self.at, self.value = fitted, np.zeros(0), (np.zeros(0), np.zeros(0))

    def __call__(self, unknowns: Floats) -> tuple[Floats, Floats]:
        if not np.array_equal(self.at, unknowns):
            self.at, self.value = unknowns.copy(), self.fitted(unknowns)
        return self.value

    def least(self, start: Floats, most_tries: int, **options: Any) -> Floats:
        """The least squares unknowns, by at most so many evaluations; options of `scipy.optimize.least_squares`."""
        residual, jacobian = (lambda x: self(x)[0]), (lambda x: self(x)[1])
        return np.asarray(least_squares(residual, start, jacobian, x_scale="jac", max_nfev=most_tries, **options).x)


def projected_residual(
    values: Floats, columns: Floats, tangents_of: Callable[[Floats], Floats]
) -> tuple[Floats, Floats]:
    """Residual of values (n,) with columns (n, k) projected out, and its Jacobian (n, n_unknowns) (Kaufman 1975).

    `tangents_of` gives the changes of the columns with the unknowns, times given coefficients (k,) of the columns.
    """
    q, r = np.linalg.qr(columns)
    along = q.T @ values
    tangents = tangents_of(np.linalg.lstsq(r, along, rcond=1e-12)[0])
    return np.asarray(values - q @ along), np.asarray(q @ (q.T @ tangents) - tangents)


def diverged(values: Floats, n_unknowns: int) -> tuple[Floats, Floats]:
    """In place of `projected_residual` where a motion diverges: a large residual that no unknown changes."""
    return 10.0 * np.abs(values), np.zeros((values.size, n_unknowns))


Model = TypeVar("Model")
Candidate = TypeVar("Candidate")


class Selection(Protocol[Model, Candidate]):
    """A measurement for `OrderSelection`; a model is a fitted set of modes, a candidate a mode that may enter it."""

    def n_modes(self, model: Model) -> int: ...

    def strongest(self, model: Model, rejected: list[tuple[complex, float]]) -> Candidate | None:
        """The candidate most likely to be a further mode; None where the residual of the model is noise."""

    def pole_of(self, candidate: Candidate) -> complex: ...

    def extended(self, model: Model, candidate: Candidate) -> Model:
        """The model with one more mode, all fitted again; LinAlgError where they cannot be distinguished."""

    def gain(self, smaller: Model, larger: Model) -> float:
        """Twice the log-likelihood ratio of two models."""

    def threshold(self, model: Model, pole: complex) -> float:
        """The gain by a mode at this pole that noise exceeds with the probability of a false alarm."""

    def splits(self, model: Model, trial: Model) -> bool:
        """Whether the mode that a trial adds splits a mode of the model in two, or is spurious."""

    def settled(self, model: Model) -> Model:
        """The model fitted to convergence."""

    def suspects(self, model: Model) -> Iterable[tuple[complex, Model, bool]]:
        """Modes to test: the pole of each, the model without it, and whether it is certainly spurious."""


@dataclass
class OrderSelection(Generic[Model, Candidate]):
    """Stepwise selection of modes, forward and backward."""

    problem: Selection[Model, Candidate]  # see `Selection`
    max_modes: float  # largest number of modes
    most_weak: float  # number of consecutive candidates below the threshold at which the forward search ends
    most_splits: int | None  # number of candidates that split a mode at which it ends; None to count these as weak
    forgets: bool  # whether a rejected candidate may be tried again once another mode has entered
    time_limit: TimeLimit = field(default_factory=TimeLimit)  # of processor time
    alone: bool = False  # whether the whole time is for this selection
    rejected: list[tuple[complex, float]] = field(default_factory=list)  # poles tried and rejected, with their gain
    full: bool = False  # whether the selection stopped at `max_modes`
    cut_short: bool = False  # whether the time limit ended the last forward search

    def select(self, model: Model) -> Model:
        """The model after forward and backward selection, starting from `model`."""
        for _ in range(SELECTION.max_rounds):
            before = self.problem.n_modes(model)
            grown = self.forward(model)
            most = self.problem.n_modes(grown)
            self.full = most >= self.max_modes
            if grown is model:
                break
            model = self.backward(self.problem.settled(grown))
            left = self.problem.n_modes(model)
            # The forward search had a share of the time only; it goes on with what the backward search left.
            if self.cut_short and self.alone and not self.time_limit.is_past:
                continue
            # Without a memory of rejected candidates the next round would repeat this one.
            if left == most or (self.forgets and left <= before):
                break
        return model

    def forward(self, model: Model) -> Model:
        """The model with every candidate of significant gain."""
        weak = splits = 0
        own_limit = self.time_limit.share(SELECTION.forward_share)
        if self.cut_short:
            self.time_limit.unfinished.pop(FURTHER, None)
        self.cut_short = False
        if self.forgets:
            self.rejected.clear()
        while (
            self.problem.n_modes(model) < self.max_modes
            and weak < self.most_weak
            and (self.most_splits is None or splits < self.most_splits)
        ):
            # The first mode is searched whatever the time.
            if self.problem.n_modes(model) and own_limit.spent(FURTHER):
                self.cut_short = True
                break
            candidate = self.problem.strongest(model, self.rejected)
            if candidate is None:
                break
            pole = self.problem.pole_of(candidate)
            try:
                trial = self.problem.extended(model, candidate)
                gain = self.problem.gain(model, trial)
                is_weak = gain < self.problem.threshold(model, pole)
            except np.linalg.LinAlgError:
                gain, is_weak = 0.0, True
            if is_weak:
                weak += 1
            elif self.problem.splits(model, trial):
                weak, splits = (weak + 1, splits) if self.most_splits is None else (weak, splits + 1)
            else:
                model, weak = trial, 0
                if self.forgets:
                    self.rejected.clear()
                continue
            self.rejected.append((complex(pole), gain))
        return model

    def backward(self, model: Model) -> Model:
        """The model without modes of insignificant gain; the weakest goes first."""
        while self.problem.n_modes(model) and not self.time_limit.spent("check of each mode"):
            weakest: tuple[float, complex, Model] | None = None
            for pole, without, certainly in self.problem.suspects(model):
                if self.time_limit.spent("check of each mode"):
                    return model
                gain = self.problem.gain(without, model)
                out = certainly or gain < self.problem.threshold(model, pole)
                if out and (weakest is None or gain < weakest[0]):
                    weakest = gain, pole, without
            if weakest is None:
                return model
            self.rejected.append((complex(weakest[1]), weakest[0]))
            model = weakest[2]
        return model


def overdamped(poles: np.ndarray) -> np.ndarray:
    """Which poles are damped too much to oscillate."""
    return np.asarray(-poles.real > SELECTION.max_damping * np.abs(poles))


def spurious_modes(
    poles: np.ndarray,
    shapes: np.ndarray,
    strength: np.ndarray,
    bin_width: float,
    distinct: Callable[[int, int], bool] | None = None,
) -> np.ndarray:
    """Which poles are overdamped, or split off a stronger mode of the same shape in the same band, (n_modes,).

    Args:
        shapes: (n_signals, n_modes) amplitudes over the noise, complex.
        bin_width: rad/s, the frequency resolution of the record.
        distinct: test whether modes r and s are two modes, for a single signal, which shows no shape.
    """
    band = np.abs(poles.real)[:, None] + np.abs(poles.real) + bin_width
    near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < band
    damped = overdamped(poles)  # no mode splits off such a pole, whose band is wide enough for any
    # A single signal shows no shape, and a mode that depends on amplitude looks like two there.
    others = len(shapes) - 1
    least_mac = max(SELECTION.min_split_mac, 1.0 - BY_CHANCE ** (1.0 / others)) if others else SELECTION.min_split_mac
    split = near & (mac(shapes, shapes) > least_mac) & (strength[:, None] < strength) & ~damped
    if distinct is not None and others == 0:
        for r, s in np.argwhere(split):
            split[r, s] = not distinct(r, s)
    return np.asarray(split.any(axis=1) | damped)
