"""Which modes a measurement holds: stepwise selection by likelihood, whatever was measured.

Forward: the strongest candidate enters, all modes are fitted anew, and it stays if twice the logarithm of the
likelihood ratio is more than noise would give in one record of a thousand. Backward: each mode that is weak, close to
another or spurious is left out in turn, and goes for good if the likelihood does not miss it. Both in turn until the
modes stay the same.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import numpy as np

from workbench.identification.signal.least_squares import Budget
from workbench.structure.modes import mac

# Chance that a record of nothing but noise yields a mode.
FALSE_ALARM = 1e-3
# Damping ratio above which a pole is no mode.
MOST_DAMPED = 0.3
# MAC from which on two overlapping poles are one mode, split.
SAME_SHAPE = 0.95
# Chance that shapes of three signals agree so far, (1 - MAC)^(n_signals - 1); fewer must agree better to say as much.
BY_CHANCE = (1.0 - SAME_SHAPE) ** 2
# Where noise is not white, or modes depend on amplitude, modes may enter and leave for ever.
MOST_ROUNDS = 4

Model = TypeVar("Model")
Candidate = TypeVar("Candidate")


class Problem(Protocol[Model, Candidate]):
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
        problem: see `Problem`.
        most_modes: where to stop at the latest.
        most_weak: candidates below the threshold, one after the other, from which on only noise is left.
        most_splits: candidates that split a mode before the search ends; None where they count as weak ones.
        forgets: whether a rejected candidate may be tried again once another mode has entered.
        budget: of time.
        rejected: poles tried and rejected, with their gain.
        full: whether the search stopped at the most modes.
    """

    problem: Problem[Model, Candidate]
    most_modes: float
    most_weak: float
    most_splits: int | None
    forgets: bool
    budget: Budget = field(default_factory=Budget)
    rejected: list[tuple[complex, float]] = field(default_factory=list)
    full: bool = False

    def select(self, model: Model) -> Model:
        """The modes of a measurement, from those of a model on."""
        for _ in range(MOST_ROUNDS):
            before = self.problem.n_modes(model)
            grown = self.forward(model)
            most = self.problem.n_modes(grown)
            self.full = most >= self.most_modes
            if grown is model:
                break
            model = self.backward(self.problem.settled(grown))
            left = self.problem.n_modes(model)
            # With nothing remembered the next round would only repeat this one.
            if left == most or (self.forgets and left <= before):
                break
        return model

    def forward(self, model: Model) -> Model:
        """With every candidate that the likelihood asks for."""
        weak = splits = 0
        if self.forgets:
            self.rejected.clear()
        while (
            self.problem.n_modes(model) < self.most_modes
            and weak < self.most_weak
            and (self.most_splits is None or splits < self.most_splits)
            # The first mode is worth the wait.
            and not (self.problem.n_modes(model) and self.budget.spent("search for further modes"))
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

    def backward(self, model: Model) -> Model:
        """Without the modes that the likelihood does not miss."""
        while self.problem.n_modes(model) and not self.budget.spent("check of each mode"):
            weakest: tuple[float, complex, Model] | None = None
            for pole, without, certainly in self.problem.suspects(model):
                gain = self.problem.gain(without, model)
                out = certainly or gain < self.problem.threshold(model, pole)
                if out and (weakest is None or gain < weakest[0]):
                    weakest = gain, pole, without
            if weakest is None:
                return model
            self.rejected.append((complex(weakest[1]), weakest[0]))
            model = weakest[2]
        return model


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
    damped = -poles.real > MOST_DAMPED * np.abs(poles)
    # An overdamped one has every band; it is split itself.
    # One signal has no shape, and a mode that depends on amplitude looks like two there.
    others = len(shapes) - 1
    alike = max(SAME_SHAPE, 1.0 - BY_CHANCE ** (1.0 / others)) if others else SAME_SHAPE
    split = near & (mac(shapes, shapes) > alike) & (strength[:, None] < strength) & ~damped
    if distinct is not None and others == 0:
        for r, s in np.argwhere(split):
            split[r, s] = not distinct(r, s)
    return np.asarray(split.any(axis=1) | damped)
