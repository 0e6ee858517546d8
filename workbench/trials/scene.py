"""A scene: a bench with its nominal motion, by which hidden effects are drawn."""

from dataclasses import dataclass

import numpy as np

from workbench.structure.domain import Domain, NamedPoints, Place, Rectangle
from workbench.trials.benches import Bench
from workbench.trials.plant import ModalMotion, Plant, SolvedPlant

COARSE = 0.2  # radians of the highest mode in one step: enough to draw a strength by


class Unsuitable(ValueError):
    """A kind that a bench cannot show, or a draw that shows no gap."""


def extent(domain: Domain) -> float:
    """What errors of place are measured by, m; 1 where names have no positions."""
    return 1.0 if isinstance(domain, NamedPoints) and domain.positions is None else domain.size


@dataclass(frozen=True, eq=False)
class Scene:
    """A bench with the nominal motion at its middle level, by which strengths are drawn.

    Attributes:
        commands: (n_inputs, n_samples) of the middle level.
        moved: nominal modal displacement and velocity.
        outputs: (n_outputs, n_samples) nominal.
    """

    bench: Bench
    nominal: SolvedPlant
    commands: np.ndarray
    moved: ModalMotion
    outputs: np.ndarray

    @classmethod
    def of(cls, bench: Bench, commands: np.ndarray) -> "Scene":
        nominal = Plant.of(bench.rig).solved()
        moved, _ = nominal.move(commands, bench.sample_time, finest=COARSE)
        return cls(bench, nominal, commands, moved, nominal.readings(moved, bench.sample_time))

    @property
    def acting(self) -> list[str]:
        return [a.name for a in self.bench.rig.actuators if not a.direct]

    def motion_at(self, x: Place) -> tuple[np.ndarray, np.ndarray]:
        """Nominal displacement and velocity at a place, (n_samples,) each."""
        shape = self.bench.rig.modes.phi(x)[0]
        return self.moved[0] @ shape, self.moved[1] @ shape

    def place(self, rng: np.random.Generator) -> float | str:
        """A place that moves: at least a third of what the liveliest does."""
        domain = self.bench.rig.modes.domain
        if isinstance(domain, Rectangle):
            raise Unsuitable("trials are made on bars, beams and named points")
        if isinstance(domain, NamedPoints):
            grid = np.array(domain.names)
        else:
            grid = np.linspace(0.05, 1.0, 96) * domain.size
        rms = np.sqrt(np.mean((self.bench.rig.modes.phi(grid) @ self.moved[0].T) ** 2, axis=1))
        at = rng.choice(grid[rms > rms.max() / 3])
        return (
            str(at)
            if isinstance(domain, NamedPoints)
            else round(float(at) - float(rng.uniform(0.0, 0.01)) * domain.size, 4)
        )

    def gap(self, plant: Plant, rng: np.random.Generator, reference: Plant | None = None) -> float:
        """Noise-free gap between a plant and the nominal one, or another, at the middle level."""
        outputs = [self.outputs]
        for one in (plant, reference):
            if one is not None:
                solved = one.solved()
                own = np.random.default_rng(rng.integers(2**31))
                moved, _ = solved.move(self.commands, self.bench.sample_time, rng=own, finest=COARSE)
                outputs.append(solved.readings(moved, self.bench.sample_time))
        measured, predicted = outputs[1], outputs[2] if reference is not None else outputs[0]
        scale = measured.std(axis=1, keepdims=True)
        gap = float(np.sqrt(np.mean(((measured - predicted) / np.where(scale > 0, scale, 1.0)) ** 2)))
        if not np.isfinite(gap):
            raise Unsuitable("the altered structure runs away")
        return gap
