"""Where should piezo pairs be on a beam under direct velocity feedback, and is a published optimum the best?"""

import numpy as np

from workbench.design.placement.velocity_feedback import FeedbackTask, place_pairs
from workbench.draw.style import COLOURS, new_figure
from workbench.rig.actuators import piezo_patch
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam

# V. K. Singla, project report of MAE 538, NC State University (2017): acrylic beam, PVDF patches, a genetic algorithm
LENGTH, WIDTH, THICKNESS, FILM, PATCH = 0.5, 0.01, 1.6e-3, 4e-5, 0.1
LEVER = 0.5 * (THICKNESS + FILM)
MOMENT_PER_VOLT = WIDTH * LEVER * 2.3e-11 * 2e9  # N m/V
VOLT_PER_SLOPE = FILM * 4.32e8 * LEVER / PATCH  # V
GAINS = {1: [[0.4]], 2: [[0.4, 0.4], [0.0, 0.4]], 3: [[0.4, 0.0, 0.0], [0.0, 0.4, 0.0342], [0.0, 0.0, 0.4]]}
PUBLISHED = {1: 0.1922, 2: 0.1659, 3: 0.1393}
PROVEN = {1: 0.01, 2: 0.01, 3: 0.02}


def task(gain):
    modes = Beam(
        length=LENGTH,
        mass_per_length=1190 * WIDTH * THICKNESS,
        bending_stiffness=3.1028e9 * WIDTH * THICKNESS**3 / 12,
        left="hinged",
        right="hinged",
        damping=ModalDamping(0.01),
    ).modes(4)
    # actuator and sensor see the same slopes: their constants are shared between B and Bᵀ
    pair = piezo_patch("patch", 0.5 * LENGTH, length=PATCH, gain=float(np.sqrt(MOMENT_PER_VOLT * VOLT_PER_SLOPE)))
    return FeedbackTask(modes, pair, np.array(gain), np.r_[np.zeros(4), 0.2, 0.4, 0.6, 0.8], PATCH)


def plot_feedback_index(places, index, found):
    """Energy integral of one collocated pair by the place of its middle, and the best places of several pairs."""
    figure, axes = new_figure(2, 1, width=9, height=5.5, sharex=True, height_ratios=[3, 1.3])
    axes[0].plot(places, index, color=COLOURS[0], label="one pair")
    axes[1].set(xlabel="middle of the patch, x [m]", ylabel="pairs", yticks=list(found), ylim=(0.4, max(found) + 0.6))
    for (count, best), colour in zip(found.items(), COLOURS[1:], strict=False):
        label = f"best of {count} pair{'s' * (count > 1)}: E = {best.index:.4f} J s"
        axes[0].axhline(best.index, color=colour, linestyle="--", label=label)
        axes[1].plot(best.positions, np.full(best.positions.size, count), "s", color=colour, markersize=9)
    axes[0].set(ylabel="energy integral E [J s]", title="collocated piezo pairs")
    axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    return figure


def study(outcome, data=None):
    found = {}
    for pairs in outcome.track(GAINS, "numbers of pairs"):
        found[pairs] = place_pairs(task(GAINS[pairs]), gap=PROVEN[pairs])
        best = found[pairs]
        outcome.check(
            f"{pairs} pair{'s' * (pairs > 1)}: E over the published optimum, to its last digit",
            round(best.index, 4) / PUBLISHED[pairs],
            1.0 + 1e-9,
        )
        outcome.check(
            f"{pairs} pair{'s' * (pairs > 1)}: certified optimality gap", best.gap, PROVEN[pairs] * (1 + 1e-9)
        )
        outcome.say(
            f"{pairs} pair{'s' * (pairs > 1)}: E = {best.index:.5f} (published {PUBLISHED[pairs]}), middles at"
            f" {', '.join(f'{1000 * x:.1f}' for x in best.positions)} mm; no placement of them is better by more than"
            f" {best.gap:.0%}, proven on {best.cells} cells"
        )
    own = place_pairs(task(0.4 * np.eye(2)))
    outcome.say(
        f"two pairs under decentralised rate feedback leave E = {own.index:.5f}; this loop is unconditionally stable"
    )
    outcome.check(
        "two pairs, decentralised gains: E over that with the published gains", own.index / found[2].index, 1.0
    )
    outcome.table(
        "pairs",
        [
            {
                "pairs": pairs,
                "E": best.index,
                "published": PUBLISHED[pairs],
                "positions": best.positions,
                "lower_bound": best.lower_bound,
                "cells": best.cells,
            }
            for pairs, best in found.items()
        ],
    )
    one = task(GAINS[1])
    at = np.linspace(*one.reach, 401)
    outcome.figure(
        "index",
        plot_feedback_index(at, one.index(at[:, None]), found),
        "Energy integral left by one pair by its place, and the best places of one, two and three pairs.",
    )
