"""What a placement must keep to, and which limit is to blame where none can."""

from dataclasses import dataclass
from itertools import combinations
from types import SimpleNamespace

import numpy as np

from workbench.design.laws.law import DesignError
from workbench.design.placement.task import Placement, PlacementTask, batch_figures

KEPT = 2e-6
APART = 1e-6  # of the length: actuators closer than this stand at one place
DRAWS = 20_000


@dataclass(frozen=True)
class Limits:
    """What a placement must keep to.

    Attributes:
        effort: largest ∫ FᵀF dt.
        peak_force: largest force of any actuator.
        condition: of B, largest ‖B‖‖B⁻¹‖ in the Frobenius norm (n where B is orthogonal).
        spacing: least distance between neighbours, m.
        margin: least distance from the ends, m.
        forbidden: stretches (from, to) where no actuator can stand, m.
    """

    effort: float = np.inf
    peak_force: float = np.inf
    condition: float = np.inf
    spacing: float = 0.0
    margin: float = 0.0
    forbidden: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        for name in ("effort", "peak_force", "condition"):
            value = getattr(self, name)
            if not value > 0:
                raise DesignError(f"the limit of {name.replace('_', ' ')} must be positive; got {value:g}")
        if not (0 <= self.spacing < np.inf and 0 <= self.margin < np.inf):
            raise DesignError(f"spacing and margin must be 0 or more; got {self.spacing:g} and {self.margin:g}")
        for low, high in self.forbidden:
            if not low < high:
                raise DesignError(f"forbidden stretch ({low:g}, {high:g}) must run from less to more")

    def allowed(self, length: float) -> list[tuple[float, float]]:
        """Stretches where an actuator may stand, m.

        Raises:
            DesignError: none is left.
        """
        at, stretches = self.margin, []
        for low, high in sorted(self.forbidden):
            if low > at:
                stretches.append((at, min(low, length - self.margin)))
            at = max(at, high)
        stretches.append((at, length - self.margin))
        stretches = [(low, high) for low, high in stretches if low <= high]
        if not stretches:
            raise DesignError(f"margin {self.margin:g} and the forbidden stretches leave no place of {length:g} m")
        return stretches

    def room(self, n: int, length: float) -> list[tuple[float, float]]:
        """The same, where n actuators find room at all.

        Raises:
            DesignError: spacing and margin that n actuators cannot keep on this length.
        """
        needed = 2 * self.margin + (n - 1) * self.spacing
        if needed > length:
            raise DesignError(
                f"{n} actuators {self.spacing:g} apart and {self.margin:g} from the ends need {needed:g} m; the"
                f" structure has {length:g}: lower spacing or margin"
            )
        stretches = self.allowed(length)
        apart, at, fit = max(self.spacing, APART * length), -np.inf, 0
        for low, high in stretches:
            at = max(low, at + apart)
            while at <= high * (1 + APART) and fit < n:
                fit, at = fit + 1, at + apart
            at -= apart
        if fit < n:
            raise DesignError(
                f"{n} actuators {self.spacing:g} apart find room for {fit} on the stretches left,"
                f" {', '.join(f'{low:g} to {high:g}' for low, high in stretches)} m: forbid less or lower the spacing"
            )
        return stretches

    def broken(self, positions: np.ndarray, figures) -> dict[str, np.ndarray]:
        """By name of limit, by how much each of many placements (n_placements, n) breaks it, relative; <= 0 is kept."""
        gaps = np.diff(positions, axis=1).min(axis=1, initial=np.inf)
        return {
            "effort": _excess(figures.effort, self.effort),
            "peak force": _excess(figures.peak_force, self.peak_force),
            "condition": _excess(figures.condition, self.condition),
            "spacing": (self.spacing - gaps) / self.spacing if self.spacing > 0 else np.zeros(len(positions)),
        }

    def kept(self, placement: Placement) -> bool:
        """Whether a placement keeps all of them, its peak force that of all time; its places are taken as allowed."""
        figures = {name: np.array([getattr(placement, name)]) for name in ("effort", "peak_force", "condition")}
        broken = self.broken(placement.positions[None], SimpleNamespace(**figures))
        return all(excess[0] <= KEPT for excess in broken.values())


def _excess(values: np.ndarray, limit: float) -> np.ndarray:
    return values / limit - 1.0 if np.isfinite(limit) else np.full(values.shape, -1.0)


def conflict(task: PlacementTask, limits: Limits, grid: np.ndarray | None = None) -> str:
    """Which limit cannot be met, or which two not together, and what could be: the words of a refusal."""
    n, length = task.n_controlled, task.modes.length
    if grid is None:
        grid = np.concatenate([np.linspace(*stretch, 40) for stretch in limits.allowed(length)])
    rng = np.random.default_rng(0)
    draws = rng.random((DRAWS, grid.size)).argsort(axis=1)[:, :n]
    positions = np.sort(grid[draws], axis=1)
    figures = batch_figures(task, task.shapes(positions))
    broken = limits.broken(positions, figures)
    within = {name: excess <= KEPT for name, excess in broken.items()}
    measured = {"effort": figures.effort, "peak force": figures.peak_force, "condition": figures.condition}
    asked = {"effort": limits.effort, "peak force": limits.peak_force, "condition": limits.condition}
    head = f"no placement of {n} actuators meets the limits"
    spaced = within["spacing"]
    if not spaced.any():
        return f"{head}: spacing {limits.spacing:g} leaves no room; lower it"
    for name, values in measured.items():
        if not (within[name] & spaced).any():
            least = values[spaced].min()
            return (
                f"{head}: {name} limit {asked[name]:.4g} with spacing {limits.spacing:g}; the least met was"
                f" {least:.4g}: raise the limit or lower the spacing"
            )
    for one, other in combinations(measured, 2):
        if not (within[one] & within[other] & spaced).any():
            least = measured[other][within[one] & spaced].min()
            return (
                f"{head}: {one} {asked[one]:.4g} and {other} {asked[other]:.4g} conflict; with the first the least"
                f" {other} met was {least:.4g}: raise one of them"
            )
    return f"{head} together, though any two can be met; raise one of them"
