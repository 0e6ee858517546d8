"""The structure that a fit to measured modes ended with, and how far it is to be trusted."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from workbench.identification.updating.self_check import SelfCheck
from workbench.identification.updating.sensitivity import LocalLoss
from workbench.structure.member import Bar, Beam
from workbench.structure.profile import Profile

UNLIKELY = 0.01


@dataclass(frozen=True, eq=False)
class UncertainProfile:
    """A distribution along the structure and how far it is to be trusted.

    Attributes:
        profile: the most likely one.
        others: x (n_points,) -> (n_draws, n_points), as likely as the measurement leaves them.
    """

    profile: Profile
    others: Callable[[np.ndarray], np.ndarray] = field(repr=False)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Values at x, in the shape of x."""
        return self.profile(x)

    def std(self, x: np.ndarray) -> np.ndarray:
        """Standard error at each x (n_points,)."""
        return np.asarray(self.others(np.atleast_1d(np.asarray(x, float))).std(axis=0))

    def band(self, x: np.ndarray, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Limits at each x (n_points,), lower and upper, that hold the truth there with this probability."""
        tail = 0.5 * (1.0 - level)
        lower, upper = np.quantile(self.others(np.atleast_1d(np.asarray(x, float))), [tail, 1.0 - tail], axis=0)
        return lower, upper


@dataclass(frozen=True, eq=False)
class FittedStructure:
    """The structure whose own modes come nearest to the measured, in units of their standard errors.

    Attributes:
        structure: a `Bar` or `Beam`, with ends and attachments of the nominal one.
        mass: kg/m, with its band.
        stiffness: EA in N or EI in N m², with its band.
        n_terms: of mass, of stiffness.
        loss: of stiffness over a part of the structure, where one was fitted.
        chi2: squares of what its modes miss of the measured, in standard errors; those of the prior with them.
        freedom: data less parameters; `chi2` is about as large where the structure explains its modes.
        criterion: χ² + n_parameters ln n_data; the least among numbers of terms is the one to take.
        parameters: d, e and, with a loss, its share, centre and width.
        covariance: of the parameters, the Cramér-Rao bound at the estimate; larger by χ² / freedom where the structure
            does not explain its modes.
        numbers: (n_modes,) of the structure's elastic modes, from 1, that the measured ones are.
        check: frequencies and shapes of the structure beside the measured.
    """

    structure: Bar | Beam
    mass: UncertainProfile
    stiffness: UncertainProfile
    n_terms: tuple[int, int]
    loss: LocalLoss | None
    chi2: float
    freedom: int
    criterion: float
    parameters: np.ndarray
    covariance: np.ndarray = field(repr=False)
    numbers: np.ndarray
    check: SelfCheck

    @property
    def explains(self) -> bool:
        """Whether noise alone would miss the measured modes by as much, in one measurement of a hundred or more."""
        return bool(self.chi2 <= chi2_distribution.isf(UNLIKELY, self.freedom))
