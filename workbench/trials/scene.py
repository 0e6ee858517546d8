"""A scene: a bench with its nominal motion, from which the strengths of hidden effects are drawn."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from workbench.rig.rig import Rig
from workbench.structure.domain import NamedPoints, Rectangle, Where
from workbench.trials.benches import Bench
from workbench.trials.plant import ModalMotion, Plant

DISTINCT = 0.1  # least sine of the angle between the modal force vectors at two named points
COARSE = 0.2  # radians of the highest mode in one step: accurate enough to draw a strength


class Unsuitable(ValueError):
    """A kind that is impossible on a bench, or a draw without a detectable gap."""


def relative_gap(difference: np.ndarray, measured: np.ndarray) -> float:
    """The rms of a difference (n_outputs, n_samples or 1) over the standard deviation of each measured output."""
    scale = measured.std(axis=1, keepdims=True)
    return float(np.sqrt(np.mean((difference / np.where(scale > 0, scale, 1.0)) ** 2)))


@dataclass(frozen=True, eq=False)
class Scene:
    """A bench with the nominal motion at its middle level, from which strengths are drawn.

    Attributes:
        commands: (n_inputs, n_samples) of the middle level.
        moved: nominal modal motion.
        outputs: (n_outputs, n_samples) nominal readings.
    """

    bench: Bench
    commands: np.ndarray
    moved: ModalMotion
    outputs: np.ndarray

    @classmethod
    def of(cls, bench: Bench, commands: np.ndarray) -> "Scene":
        nominal = bench.plant().solved()
        moved, _ = nominal.move(commands, bench.sample_time, finest=COARSE)
        return cls(bench, commands, moved, nominal.readings(moved, bench.sample_time))

    @property
    def rig(self) -> Rig:
        """The nominal rig."""
        return self.bench.rig

    @property
    def acting(self) -> list[str]:
        """Names of the actuators that follow commands."""
        return [a.name for a in self.rig.actuators if not a.direct]

    def motion_at(self, where: Where) -> tuple[np.ndarray, np.ndarray]:
        """Nominal displacement and velocity at a place, or between two, (n_samples,) each."""
        shape = self.rig.modes.phi_at(where)
        return self.moved[0] @ shape, self.moved[1] @ shape

    def place(self, rng: np.random.Generator, *, between: bool = False) -> Where:
        """A random place whose rms motion is at least a third of the largest.

        Args:
            between: whether half of the draws at named points are a pair `Between` two points.
        """
        domain = self.rig.modes.domain
        if isinstance(domain, NamedPoints):
            if domain.positions is not None:
                return self._distinct(rng, between and rng.random() < 0.5)
            grid: Any = np.array(domain.names)
        else:
            grid = domain.grid(24) if isinstance(domain, Rectangle) else np.linspace(0.05, 1.0, 96) * domain.size
        rms = np.sqrt(np.mean((self.rig.modes.phi(grid) @ self.moved[0].T) ** 2, axis=1))
        at = rng.choice(np.asarray(grid)[rms > rms.max() / 3])
        if isinstance(domain, NamedPoints):
            return str(at)
        if isinstance(domain, Rectangle):
            moved = at + rng.uniform(-0.02, 0.02, 2) * domain.length
            x, y = np.clip(moved, 0.0, domain.length)
            return round(float(x), 4), round(float(y), 4)
        return round(float(at) - float(rng.uniform(0.0, 0.01)) * domain.size, 4)

    def _distinct(self, rng: np.random.Generator, between: bool) -> Where:
        """A random named point, or pair of points, whose modal force vector is not nearly parallel to another one.

        A force at a place with a parallel vector (weighted by the modal velocities) and another strength explains the
        records equally well, so that the place of an effect would not be identifiable.
        """
        modes = self.rig.modes
        points = modes.domain
        assert isinstance(points, NamedPoints)
        alone, pairs = list(points.grid()), list(points.pairs())
        index = {name: i for i, name in enumerate(alone)}
        at_points = modes.phi(alone) * np.sqrt(np.mean(self.moved[1] ** 2, axis=0))
        ends = np.array([[index[str(pair.first)], index[str(pair.second)]] for pair in pairs]).reshape(-1, 2)
        felt = np.vstack([at_points, at_points[ends[:, 0]] - at_points[ends[:, 1]]])
        size = np.linalg.norm(felt, axis=1)
        places: list[Where] = [*alone, *pairs]
        wanted = np.arange(size.size) >= len(alone) if between else np.arange(size.size) < len(alone)
        lively = np.flatnonzero(wanted & (size > size[wanted].max() / 3))
        unit = felt / np.maximum(size, 1e-300)[:, None]
        for i in map(int, rng.permutation(lively)):
            cosine = np.abs(unit @ unit[i])
            cosine[i] = 0.0
            if np.sqrt(np.maximum(1.0 - cosine.max() ** 2, 0.0)) > DISTINCT:
                return places[i]
        raise Unsuitable("no two places are distinguishable by their mode shapes")

    def gap(self, plant: Plant, rng: np.random.Generator, reference: Plant | None = None) -> float:
        """Noise-free gap between a plant and the nominal one (or the reference) at the middle level.

        Raises:
            Unsuitable: the response diverges.
        """
        measured = self._readings(plant, rng)
        predicted = self.outputs if reference is None else self._readings(reference, rng)
        gap = relative_gap(measured - predicted, measured)
        if not np.isfinite(gap):
            raise Unsuitable("the response diverges")
        return gap

    def _readings(self, plant: Plant, rng: np.random.Generator) -> np.ndarray:
        solved, own = plant.solved(), np.random.default_rng(rng.integers(2**31))
        moved, _ = solved.move(self.commands, self.bench.sample_time, rng=own, finest=COARSE)
        return solved.readings(moved, self.bench.sample_time)
