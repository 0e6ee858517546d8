"""The searches of an identification, whatever was measured: over parameters, over modes, and the time they take.

Nonlinear least squares, by Levenberg and Marquardt: problems differ in what they linearise, squares with the linear
unknowns projected out (variable projection, Golub & Pereyra 1973) or a likelihood (Fisher scoring). All give, at a
state, a matrix N and a right-hand side g, and share the damped step (Marquardt 1963), which does not depend on the
units of the unknowns:

    (D N D + μ I) D⁻¹ s = D g,     D = diag(N)^-½

Model order, by stepwise selection. Forward: the strongest candidate enters, all modes are fitted anew, and it stays if
twice the logarithm of the likelihood ratio is more than noise would give in one record of a thousand. Backward: each
mode that is weak, close to another or spurious is left out in turn, and goes for good if the likelihood does not miss
it. Both in turn until the modes stay the same.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import least_squares

from workbench.arrays import Floats
from workbench.deadline import Deadline
from workbench.structure.modes import mac

State = TypeVar("State")
SECONDS = 30.0  # of processor time
WHOLE = 0.995  # of the time: as good as all
FURTHER = "search for further modes"
STOPPED = "stopped after"  # as the remark of a search begins that the time was up for
# Chance that a record of nothing but noise yields a mode.
FALSE_ALARM = 1e-3


@dataclass(frozen=True)
class FitSettings:
    """Constants of every fit of modes."""

    most_steps: int = 60
    # of χ², each value: a step is negligible once it moves the estimate by less than a thousandth of its standard error
    negligible: float = 1e-6
    round_off: float = 1e-26  # of a sum of squares, relative to that of the measurement
    most_growth: float = 20.0  # nepers over a record: no pole is searched that grows faster
    fastest_decay: float = 1.0  # nepers within a sample: no pole is searched beyond
    # participation factor over that held at one: factors that run apart without end are no mode's, and overflow
    most_unlike: float = 1e20


@dataclass(frozen=True)
class SelectionSettings:
    """Constants of every selection of modes."""

    search_share: float = 0.5  # of the time, in which modes are searched; the rest is for refinement and errors
    growing: float = 0.6  # of the time left, that a round searches for further modes; unchecked ones may be artefacts
    most_damped: float = 0.3  # damping ratio above which a pole is no mode
    most_growth: float = 0.5  # nepers over a record above which a pole grows: it may be noise that is not white
    same_shape: float = 0.95  # MAC from which on two overlapping poles are one mode, split
    most_rounds: int = 4  # where noise is not white, or modes depend on amplitude, they may enter and leave for ever
    few_steps: int = 12  # of a fit that only decides whether a mode enters or leaves
    weak: float = 4.0  # times the limit, below which a mode may be noise and is tried again
    close: float = 2.0  # bandwidths to the next mode, likewise
    noise_bins: int = 50  # on either side, from which the noise about a pole is taken
    peaks_a_rate: int = 12  # candidates of each rate of decay, of records with known inputs


FIT = FitSettings()
SELECTION = SelectionSettings()
# Chance that shapes of three signals agree so far, (1 - MAC)^(n_signals - 1); fewer must agree better to say as much.
BY_CHANCE = (1.0 - SELECTION.same_shape) ** 2

# (the search under way, the share of the time that is spent)
Progress = Callable[[str, float], None]


class Budget(Deadline):
    """Processor time left for an identification, and which searches found it spent.

    Attributes:
        progress: called as the searches go on.
        unfinished: the searches that were ended early, each with the share of the whole time that had passed then.
    """

    def __init__(self, seconds: float | None = None, progress: Progress | None = None) -> None:
        super().__init__(seconds)
        self.progress, self._whole = progress, self._end
        self.unfinished: dict[str, float] = {}

    def spent(self, search: str) -> bool:
        """Whether the time is up; the search that asks is then noted as unfinished."""
        if self.progress is not None:
            self.progress(search, min((self._now - self._begun) / (self._whole - self._begun), 1.0))
        if not self.is_past:
            return False
        self.unfinished.setdefault(search, (self._end - self._begun) / (self._whole - self._begun))
        return True

    def share(self, share: float) -> "Budget":
        """A share of the time left, in (0, 1]; what it leaves unfinished counts here."""
        part = Budget(None if self.seconds is None else share * max(self._end - self._now, 1e-3), self.progress)
        part.unfinished, part._begun, part._whole = self.unfinished, self._begun, self._whole
        return part

    def aside(self, share: float) -> "Budget":
        """A share of the time left for a look on the side; what it leaves unfinished does not count here."""
        return Budget(self.share(share).seconds)

    def apart(self, share: float) -> "Budget":
        """A share of the time left for one of several tasks; what it leaves unfinished counts once it is `counted`."""
        part = self.share(share)
        part.unfinished = {}
        return part

    def counted(self, part: "Budget") -> None:
        """What a task left unfinished now counts here."""
        for search, share in part.unfinished.items():
            self.unfinished.setdefault(search, share)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was left undone, in one sentence; empty where all was finished."""
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
    """How the damping μ, a share of the diagonal of N, follows what the steps achieve.

    The result does not depend on these numbers, only the number of steps does; they are Marquardt's habit.

    Attributes:
        first: at the start.
        raised: factor after a step that raised the cost.
        lowered: factor after a step that lowered it.
        least: below which N is not regularised any further.
        most: from which on no step is tried: s has shrunk to a gradient step of 1e-8 standard errors.
        stuck: from which on the search ends after a step.
        indefinite: least, where N is not positive definite as it stands.
    """

    first: float = 1e-3
    raised: float = 8.0
    lowered: float = 0.1
    least: float = 1e-12
    most: float = 1e8
    stuck: float = 1e6
    indefinite: float = 1e-9


DAMPING = DampingSettings()


def check_count(name: str, number: int | None) -> None:
    """Refuse a number of modes below one.

    Raises:
        ValueError: naming it.
    """
    if number is not None and number < 1:
        raise ValueError(f"{name} is a number of modes, 1 or more; got {number}")


class LeastSquares(Protocol[State]):
    """What the engine asks of a problem."""

    def cost(self, state: State) -> float:
        """What is minimised; infinite where the state is not admissible."""
        ...

    def normal_equations(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """N (n_unknowns, n_unknowns), half the Hessian or near it, and g (n_unknowns,), half the negative gradient."""
        ...

    def moved(self, state: State, step: np.ndarray) -> tuple[State | None, np.ndarray]:
        """The state after a step, None where it is not admissible, and what of the step was taken."""
        ...

    def negligible(self, decrease: float, cost: float) -> bool:
        """Whether a step that promises such a decrease of the cost need not be followed by another."""
        ...


@dataclass(frozen=True, eq=False)
class Minimum(Generic[State]):
    """What a search ended with.

    Attributes:
        state: the best found.
        cost: there.
        converged: whether it ended because the step was negligible.
        steps: taken.
    """

    state: State
    cost: float
    converged: bool
    steps: int


def minimise(
    problem: LeastSquares[State], start: State, *, most_steps: int, round_off: float = 0.0, budget: Budget | None = None
) -> Minimum[State]:
    """The local minimum of a problem next to `start`.

    Args:
        problem: see `LeastSquares`.
        start: admissible.
        most_steps: at which to end at the latest.
        round_off: of the cost: a step that raises it by no more is as good as one that does not.
        budget: of time; none unless given.
    """
    state, cost, damping, small = start, problem.cost(start), DAMPING.first, False
    for taken in range(1, most_steps + 1):
        normal, right = problem.normal_equations(state)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        scaled, one = normal * np.outer(scale, scale), np.eye(right.size)
        while True:
            try:
                step = scale * cho_solve(cho_factor(scaled + damping * one), scale * right)
            except np.linalg.LinAlgError:
                damping = max(DAMPING.raised * damping, DAMPING.indefinite)
                continue
            trial, step = problem.moved(state, step)
            small = problem.negligible(float(step @ right), cost)
            cost_there = np.inf if trial is None else problem.cost(trial)
            accepted = trial is not None and cost_there <= cost + round_off
            if accepted or small or damping > DAMPING.most:
                break
            damping *= DAMPING.raised
        if accepted and trial is not None:
            state, cost = trial, cost_there
        damping = max(DAMPING.lowered * damping, DAMPING.least)
        if small or damping > DAMPING.stuck:
            return Minimum(state, cost, small, taken)
        if budget is not None and budget.spent("refinement"):
            return Minimum(state, cost, False, taken)
    return Minimum(state, cost, False, most_steps)


Model = TypeVar("Model")
Candidate = TypeVar("Candidate")


class Once:
    """What is left (n,) and its slopes (n, n_unknowns), kept for the slopes asked for where what is left was.

    For fits of a few unknowns, of which SciPy finds the least.
    """

    def __init__(self, fitted: Callable[[Floats], tuple[Floats, Floats]]) -> None:
        self.fitted, self.at, self.found = fitted, np.zeros(0), (np.zeros(0), np.zeros(0))

    def __call__(self, unknowns: Floats) -> tuple[Floats, Floats]:
        if not np.array_equal(self.at, unknowns):
            self.at, self.found = unknowns.copy(), self.fitted(unknowns)
        return self.found

    def least(self, start: Floats, most_tries: int, **how: float) -> Floats:
        """The unknowns of least squares, by at most so many evaluations; `how` as of `scipy.optimize.least_squares`."""
        left, slopes = (lambda x: self(x)[0]), (lambda x: self(x)[1])
        return np.asarray(least_squares(left, start, slopes, x_scale="jac", max_nfev=most_tries, **how).x)


class Selection(Protocol[Model, Candidate]):
    """What the selection asks of a measurement; a model is a fitted set of modes."""

    def n_modes(self, model: Model) -> int: ...

    def strongest(self, model: Model, rejected: list[tuple[complex, float]]) -> Candidate | None:
        """The candidate most likely to be a mode beside those of a model; None where only noise is left."""
        ...

    def pole_of(self, candidate: Candidate) -> complex: ...

    def extended(self, model: Model, candidate: Candidate) -> Model:
        """The model with one more mode, all fitted anew; LinAlgError where they cannot be distinguished."""
        ...

    def gain(self, smaller: Model, larger: Model) -> float:
        """Twice the logarithm of the likelihood ratio of two models."""
        ...

    def threshold(self, model: Model, pole: complex) -> float:
        """What noise about a pole gains by one more mode with the chance of a false alarm."""
        ...

    def splits(self, model: Model, trial: Model) -> bool:
        """Whether the mode that a trial adds splits one of the model, or is none."""
        ...

    def settled(self, model: Model) -> Model:
        """The model fitted to convergence."""
        ...

    def suspects(self, model: Model) -> Iterable[tuple[complex, Model, bool]]:
        """Modes that may be none: their pole, the model without each, and whether it is none for certain."""
        ...


@dataclass
class Stepwise(Generic[Model, Candidate]):
    """The selection.

    Attributes:
        problem: see `Selection`.
        max_modes: where to stop at the latest.
        most_weak: candidates below the threshold, one after the other, from which on only noise is left.
        most_splits: candidates that split a mode before the search ends; None where they count as weak ones.
        forgets: whether a rejected candidate may be tried again once another mode has entered.
        budget: of time.
        alone: whether all of that is for this search; other things follow unless given.
        rejected: poles tried and rejected, with their gain.
        full: whether the search stopped at the most modes.
        cut_short: whether the last search forward ended because its time was up.
    """

    problem: Selection[Model, Candidate]
    max_modes: float
    most_weak: float
    most_splits: int | None
    forgets: bool
    budget: Budget = field(default_factory=Budget)
    alone: bool = False
    rejected: list[tuple[complex, float]] = field(default_factory=list)
    full: bool = False
    cut_short: bool = False

    def select(self, model: Model) -> Model:
        """The modes of a measurement, from those of a model on."""
        for _ in range(SELECTION.most_rounds):
            before = self.problem.n_modes(model)
            grown = self.forward(model)
            most = self.problem.n_modes(grown)
            self.full = most >= self.max_modes
            if grown is model:
                break
            model = self.backward(self.problem.settled(grown))
            left = self.problem.n_modes(model)
            # What the check of each mode has left of the time is for the search that had a share of it.
            if self.cut_short and self.alone and not self.budget.is_past:
                continue
            # With nothing remembered the next round would only repeat this one.
            if left == most or (self.forgets and left <= before):
                break
        return model

    def forward(self, model: Model) -> Model:
        """With every candidate that the likelihood asks for."""
        weak = splits = 0
        growing = self.budget.share(SELECTION.growing)
        if self.cut_short:
            self.budget.unfinished.pop(FURTHER, None)
            self.cut_short = False
        if self.forgets:
            self.rejected.clear()
        while (
            self.problem.n_modes(model) < self.max_modes
            and weak < self.most_weak
            and (self.most_splits is None or splits < self.most_splits)
            # The first mode is worth the wait.
            and not (self.problem.n_modes(model) and self._ends(growing))
        ):
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

    def _ends(self, growing: Budget) -> bool:
        """Whether the time of the search for further modes is up; noted, as there may be more once it is not."""
        self.cut_short = growing.spent(FURTHER)
        return self.cut_short

    def backward(self, model: Model) -> Model:
        """Without the modes that the likelihood does not miss."""
        while self.problem.n_modes(model) and not self.budget.spent("check of each mode"):
            weakest: tuple[float, complex, Model] | None = None
            for pole, without, certainly in self.problem.suspects(model):
                if self.budget.spent("check of each mode"):
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
    """Which poles are damped too much to ring."""
    return np.asarray(-poles.real > SELECTION.most_damped * np.abs(poles))


def spurious_modes(
    poles: np.ndarray,
    shapes: np.ndarray,
    strength: np.ndarray,
    bin_width: float,
    distinct: Callable[[int, int], bool] | None = None,
) -> np.ndarray:
    """Which poles are damped too much to ring, or split a stronger mode that has their shape and their band.

    Args:
        poles: (n_modes,) rad/s.
        shapes: (n_signals, n_modes) amplitudes over the noise, complex.
        strength: (n_modes,) of two alike the weaker splits the other.
        bin_width: rad/s, the resolution of the record.
        distinct: whether modes r and s, which one signal cannot distinguish by shape, are two all the same.
    """
    band = np.abs(poles.real)[:, None] + np.abs(poles.real) + bin_width
    near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < band
    damped = overdamped(poles)
    # An overdamped one has every band; it is split itself.
    # One signal has no shape, and a mode that depends on amplitude looks like two there.
    others = len(shapes) - 1
    alike = max(SELECTION.same_shape, 1.0 - BY_CHANCE ** (1.0 / others)) if others else SELECTION.same_shape
    split = near & (mac(shapes, shapes) > alike) & (strength[:, None] < strength) & ~damped
    if distinct is not None and others == 0:
        for r, s in np.argwhere(split):
            split[r, s] = not distinct(r, s)
    return np.asarray(split.any(axis=1) | damped)
