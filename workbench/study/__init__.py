"""Many cases of a study: `study.run(study.grid(at=(1.0, 2.0)), function)`."""

from workbench.study.runs.cases import grid, samples
from workbench.study.runs.runner import run

__all__ = ["grid", "run", "samples"]
