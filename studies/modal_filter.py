"""How many sensors does a modal filter need? Table 5.1 of the dissertation."""

import numpy as np

from workbench.design.estimation.modal_filter import displacement_filter, hermite_filter
from workbench.draw.style import COLOURS, new_figure
from workbench.structure.member import Beam

PRINTED = {
    2: (0.40970, 0.09852, 0.01517, 0.01232, 0.00328),
    3: (0.26718, 0.08492, 0.04269, 0.01742, 0.00639),
    4: (0.25336, 0.06762, 0.03452, 0.01881, 0.01141),
    5: (0.25007, 0.06334, 0.02903, 0.01689, 0.01093),
    6: (0.25026, 0.06288, 0.02815, 0.01586, 0.01081),
    7: (0.25015, 0.06275, 0.02805, 0.01422, 0.00865),  # r = 2 is misprinted as 0.05274
    8: (0.25010, 0.06134, 0.02667, 0.01456, 0.00898),
    9: (0.24906, 0.06160, 0.02691, 0.01479, 0.00920),
    10: (0.25000, 0.06248, 0.02709, 0.01496, 0.00935),
    11: (0.25000, 0.06248, 0.02775, 0.01557, 0.00947),
}


def pattern(x, derivative=0):
    """F(x) of (5.54), or its slope."""
    i = np.arange(1, 16)
    waves = (
        np.sin(np.outer(x, i) * np.pi / 10) if derivative == 0 else np.cos(np.outer(x, i) * np.pi / 10) * i * np.pi / 10
    )
    return waves @ (1.0 / (2.0 * i) ** 2) / np.sqrt(5.0)


def plot_filter_errors(counts, errors):
    """Error of each modal coordinate against the number of sensors."""
    figure, ax = new_figure(1, 1, width=9, height=4)
    for r in range(errors.shape[1]):
        ax.semilogy(counts, np.maximum(errors[:, r], 1e-7), "o-", label=f"mode {r + 1}", color=COLOURS[r % 7])
    ax.set(
        xlabel="number of sensors (displacement and slope each)",
        ylabel="error of the modal coordinate, |q̂ - q| [m √kg]",
    )
    ax.set_title("error of modal filters against the number of sensors")
    ax.legend(ncols=2)
    return figure


def study(outcome, data=None):
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
    modes = beam.modes(5)
    exact = 1.0 / (2.0 * np.arange(1, 6)) ** 2

    table, alone = {}, {}
    for k in PRINTED:
        sensors = np.linspace(0.0, 10.0, k)
        table[k] = hermite_filter(modes, sensors, 1.0)(pattern(sensors), pattern(sensors, 1))
        alone[k] = displacement_filter(modes, sensors, 1.0)(pattern(sensors))
    outcome.table("exact", exact)
    outcome.table("table_5_1", table)
    outcome.table("displacement_only", alone)

    digits = max(np.abs(np.round(table[k], 5) - PRINTED[k]).max() for k in PRINTED)
    outcome.check(
        "Table 5.1: largest difference from the printed value, in its last digit", round(digits * 1e5, 3), 1.0
    )
    errors = np.array([np.abs(table[k] - exact) for k in PRINTED])
    outcome.say(f"11 sensors estimate the first five modal coordinates within {errors[-1].max():.1e}")
    outcome.figure(
        "errors", plot_filter_errors(list(PRINTED), errors), "Error of each modal coordinate against sensors."
    )
