"""Levenberg-Marquardt on whatever gives normal equations, the one nonlinear least-squares engine, and its time.

Problems differ in what they linearise: squares with the linear unknowns projected out (variable projection, Golub &
Pereyra 1973), or a likelihood (Fisher scoring). All give, at a state, a matrix N and a right-hand side g, and share the
damped step (Marquardt 1963), which does not depend on the units of the unknowns:

    (D N D + μ I) D⁻¹ s = D g,     D = diag(N)^-½
"""

from collections.abc import Callable
from dataclasses import dataclass
from time import thread_time
from typing import Generic, Protocol, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve

State = TypeVar("State")
SECONDS = 30.0  # of processor time
# Share of the time in which modes are searched; the rest is for refinement, standard errors and remarks.
SEARCH = 0.6

# (the search under way, the share of the time that is spent)
Progress = Callable[[str, float], None]


class Budget:
    """Processor time left for an identification; searches that find it spent return the best they have.

    Not time by the clock: a machine that others load gives the same result.

    Attributes:
        seconds: of processor time of this thread allowed, from the construction on.
        progress: called as the searches go on.
        unfinished: the searches that were ended early, each once.
    """

    def __init__(self, seconds: float | None = None, progress: Progress | None = None) -> None:
        if seconds is not None and not seconds > 0:
            raise ValueError(f"identification needs time: seconds must be positive; got {seconds:g}")
        self.seconds, self.progress = seconds, progress
        self.unfinished: list[str] = []
        self._begun = thread_time()
        self._end = self._whole = float("inf") if seconds is None else self._begun + seconds

    def spent(self, search: str) -> bool:
        """Whether the time is up; the search that asks is then noted as unfinished."""
        now = thread_time()
        if self.progress is not None:
            self.progress(search, min((now - self._begun) / (self._whole - self._begun), 1.0))
        if now < self._end:
            return False
        if search not in self.unfinished:
            self.unfinished.append(search)
        return True

    def share(self, share: float) -> "Budget":
        """A share of the time left, in (0, 1]; what it leaves unfinished counts here."""
        part = Budget(None if self.seconds is None else share * max(self._end - thread_time(), 1e-3))
        part.unfinished, part.progress = self.unfinished, self.progress
        part._begun, part._whole = self._begun, self._whole
        return part

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was left undone, in one sentence; empty where all was finished."""
        if not self.unfinished:
            return ()
        what = ", ".join(self.unfinished)
        return (f"stopped after {self.seconds:g} s, unfinished: {what}; allow more time by `seconds`",)


@dataclass(frozen=True)
class Damping:
    """How the damping μ, a share of the diagonal of N, follows what the steps achieve.

    The result does not depend on these numbers, only the number of steps does; they are Marquardt's habit.

    Attributes:
        first: at the start.
        raised: factor after a step that raised the cost.
        lowered: factor after a step that lowered it.
        least: below which N is not regularised any further.
        most: from which on no step is tried: s has shrunk to a gradient step of 1e-8 standard errors.
        stuck: from which on the search ends after a step.
    """

    first: float = 1e-3
    raised: float = 8.0
    lowered: float = 0.1
    least: float = 1e-12
    most: float = 1e8
    stuck: float = 1e6


DAMPING = Damping()
# From here on, where N is not positive definite as it stands.
INDEFINITE = 1e-9


class Problem(Protocol[State]):
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
    problem: Problem[State],
    start: State,
    *,
    most_steps: int,
    round_off: float = 0.0,
    budget: Budget | None = None,
) -> Minimum[State]:
    """The local minimum of a problem next to `start`.

    Args:
        problem: see `Problem`.
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
                damping = max(DAMPING.raised * damping, INDEFINITE)
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
