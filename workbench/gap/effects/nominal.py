"""Nominal figures that are merely a little off: frequencies, damping, modal mass; held near what was handed in."""

from dataclasses import replace

import numpy as np

from workbench.gap.effects.effect import Kind, Parameter
from workbench.gap.effects.structural import solved_once
from workbench.rig.rig import Rig

FREQUENCY_STD, DAMPING_STD, MASS_STD = 0.01, 0.25, 0.02


def _names(n_modes: int) -> list[tuple[str, float, float]]:
    """(name, standard deviation of its logarithm, largest factor) of every figure."""
    figures = [(f"frequency_{r + 1}", FREQUENCY_STD, 1.06) for r in range(n_modes)]
    figures += [(f"damping_{r + 1}", DAMPING_STD, 3.0) for r in range(n_modes)]
    return [*figures, ("modal_mass", MASS_STD, 1.2)]


def _adjusted(rig: Rig, _, values: dict[str, float]) -> Rig:
    modes = rig.modes
    n = min(modes.n_modes, len(values) // 2)
    frequency, damping = np.ones(modes.n_modes), np.ones(modes.n_modes)
    frequency[:n] = [values[f"frequency_{r + 1}"] for r in range(n)]
    damping[:n] = [values[f"damping_{r + 1}"] for r in range(n)]
    scale = np.sqrt(frequency * damping)
    shapes, root = modes.shapes, np.sqrt(values["modal_mass"])
    scaled = shapes if root == 1 else lambda located, derivative: shapes(located, derivative) / root
    changed = replace(
        modes, omega=modes.omega * frequency, damping=modes.damping * np.outer(scale, scale), shapes=scaled
    )
    return replace(rig, modes=changed)


NOMINAL_FIGURES = Kind(
    name="nominal_figures",
    path="structure",
    parameters=lambda rig, _: tuple(
        Parameter(name, "", 1.0 / most, most, logarithmic=True, prior_std=std)
        for name, std, most in _names(rig.modes.n_modes)
    ),
    apply=solved_once(_adjusted),
    starts=lambda evidence, _: [{name: 1.0 for name, _, _ in _names(evidence.rig.modes.n_modes)}],
    phrase="nominal frequencies and damping ratios that are a little off",
    last=True,
)
