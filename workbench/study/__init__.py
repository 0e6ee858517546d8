"""Many cases of a study: `study.run(study.grid(at=(1.0, 2.0)), function)`."""

from workbench.study.cases import grid, samples
from workbench.study.runner import run

__all__ = ["grid", "run", "samples"]
