"""The check of section 4.3: whether the identified structure has the modes from which it was identified."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from workbench.identification.updating.distributions import Basis, Distributions, distributions_of
from workbench.structure.member import Bar, Beam
from workbench.structure.modes import Modes, mac
from workbench.structure.printed import Printed, warns_of_remarks
from workbench.structure.profile import ProfileLike
from workbench.structure.supports import End
from workbench.threads import one_blas_thread

N_POINTS = 101


@dataclass(frozen=True, eq=False, repr=False)
class SelfCheck(Printed):
    """The eigensolution of an identified structure compared with the measurement.

    Attributes:
        frequency_errors: (n_modes,) relative, of the identified structure; infinite where it has no such mode.
        mac: (n_modes,) of each shape.
        refusal: why the identified distributions are no structure; empty if they are.
    """

    frequency_errors: np.ndarray
    mac: np.ndarray
    refusal: str = ""

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        each = enumerate(zip(self.frequency_errors, self.mac, strict=True))
        rows = [(str(r + 1), f"{100 * error:.3g}", f"{agreement:.4f}") for r, (error, agreement) in each]
        if self.refusal:
            return f"identified structure against measurement: {self.refusal}", (), (), ()
        line = f"identified structure against measurement: frequencies at most {100 * self.worst:.3g} % off"
        return line, ("mode", "frequency [%]", "MAC"), rows, ()

    @property
    def worst(self) -> float:
        """Largest relative frequency error, by which identifications are compared."""
        return float(np.abs(self.frequency_errors).max())


@dataclass(frozen=True, eq=False, repr=False)
class Identified(Printed):
    """A structure identified with the number of terms of the best self-check."""

    distributions: Distributions
    n_terms: tuple[int, int]
    check: SelfCheck
    tried: tuple[tuple[int, int, float], ...] = field(default=())

    def _printed(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
        line, headings, rows, remarks = self.distributions._printed()
        return line, headings, rows, [self.check._printed()[0], *remarks]

    @property
    def remarks(self) -> tuple[str, ...]:
        """The remarks of the distributions."""
        return self.distributions.remarks


def structure_of(found: Distributions, *, kind: str, length: float, left: str | End, right: str | End) -> Bar | Beam:
    """The `Bar` or `Beam` that identified distributions describe.

    Raises:
        ValueError: a distribution that is not positive everywhere.
    """
    common: dict[str, Any] = {
        "length": length,
        "left": left,
        "right": right,
        "mass_per_length": found.mass.profile,
    }
    if kind == "bar":
        return Bar(axial_stiffness=found.stiffness.profile, **common)
    return Beam(bending_stiffness=found.stiffness.profile, **common)


@one_blas_thread
def self_check(
    found: Distributions, measured: Modes, *, kind: str, left: str | End, right: str | End, first_mode: int = 0
) -> SelfCheck:
    """The eigensolution of an identified structure compared with the measurement.

    Args:
        found: mass and stiffness.
        measured: the modes they were identified from, consecutive.
        kind: "bar" or "beam".
        left, right: its ends.
        first_mode: index of the first measured mode among all modes of the structure; 2 leaves out the rigid-body
            modes of a free-free beam.
    """
    n = measured.n_modes
    try:
        structure = structure_of(found, kind=kind, length=measured.length, left=left, right=right)
        computed = structure.modes(first_mode + n, tolerance=1e-6).select(slice(first_mode, None))
    except ValueError as error:
        return SelfCheck(np.full(n, np.inf), np.zeros(n), str(error))
    x = np.linspace(0.0, measured.length, N_POINTS)
    agreement = np.diag(mac(computed.phi(x), measured.phi(x)))
    return SelfCheck(computed.omega / measured.omega - 1.0, agreement)


@warns_of_remarks
def choose_terms(
    measured: Modes,
    *,
    kind: str,
    left: str | End,
    right: str | End,
    known_mass: Sequence[tuple[float, float]],
    terms: Iterable[int] = range(1, 7),
    basis: Callable[[int], Basis] = Basis.polynomial,
    first_mode: int = 0,
    prior_mass: ProfileLike = 0.0,
    prior_stiffness: ProfileLike = 0.0,
) -> Identified:
    """The identified structure of the numbers of terms whose modes agree best with the measured ones.

    A pair of more terms must halve the largest frequency error to be preferred, and none is tried once this is below
    the standard error of the measured frequencies: further terms would over-fit.

    Args:
        measured: as `mass_and_stiffness`.
        kind, left, right, first_mode: as `self_check`.
        known_mass: ((x, kg/m), ...).
        terms: numbers of terms to try, for mass and stiffness alike.
        basis: number of terms -> `Basis`.
        prior_mass, prior_stiffness: as `mass_and_stiffness`.

    Raises:
        ValueError: no pair of numbers gives a structure; the last reason is given.
        UserWarning: as `mass_and_stiffness`.
    """
    ends: dict[str, Any] = {"kind": kind, "left": left, "right": right, "first_mode": first_mode}
    best, tried, reason = None, [], "no number of terms was given"
    measurement_error = _frequency_error(measured)
    pairs = sorted(((a, b) for a in terms for b in terms), key=lambda pair: (sum(pair), pair))
    for n_mass, n_stiffness in pairs:
        try:
            bases = basis(n_mass), basis(n_stiffness)
            distributions = distributions_of(measured, kind, bases, known_mass, (prior_mass, prior_stiffness))
        except ValueError as error:
            reason = str(error)
            continue
        check = self_check(distributions, measured, **ends)
        reason = check.refusal or reason
        tried.append((n_mass, n_stiffness, check.worst))
        if np.isfinite(check.worst) and (
            best is None or (measurement_error < best[1].worst and check.worst < 0.5 * best[1].worst)
        ):
            best = (distributions, check, (n_mass, n_stiffness))
    if best is None:
        raise ValueError(f"no number of terms gives a structure: {reason}")
    return Identified(best[0], best[2], best[1], tuple(tried))


def _frequency_error(measured: Modes) -> float:
    """Largest relative standard error of the measured frequencies; 1e-9 where they were computed."""
    if measured.covariance is None:
        return 1e-9
    return float((np.sqrt(np.diag(measured.covariance)[: measured.n_modes]) / measured.omega).max())
