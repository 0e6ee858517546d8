"""Figures of a redesign: what the present and the redesigned controller do on the same possible rigs."""

import numpy as np
from matplotlib.figure import Figure

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.robust.proof import interval
from workbench.robust.redesign import Redesign

OLD, NEW = COLOURS[1], COLOURS[0]


def plot_redesign(result: Redesign) -> Figure:
    """Energy of the structure under test with its 95 % band over the draws, and the damping of each controlled mode."""
    figure, (left, right) = new_figure(1, 2, width=10, height=4.2, width_ratios=(2, 1))
    time = result.test.time
    both = (("present", result.present_proof, OLD), ("redesigned", result.proof, NEW))
    top = max(float(p.energy[0].max()) for _, p, _ in both if np.isfinite(p.energy[0]).any())
    for name, proof, colour in both:
        middle, low, high = np.clip(proof.energy, 1e-9 * top, 1e3 * top)
        left.fill_between(time, low, high, color=colour, alpha=0.25, linewidth=0)
        left.semilogy(time, middle, color=colour, linewidth=1.2, label=f"{name}: stable on {proof.share_stable:.0%}")
    left.set(xlabel="time [s]", ylabel="energy of all modes", ylim=(1e-6 * top, 3.0 * top))
    left.set_title(f"after the test, {result.proof.n_draws} possible rigs (median, 95 %)")
    left.legend(fontsize=8)
    rows = np.arange(len(result.controlled))
    for shift, (name, proof, colour) in zip((-0.12, 0.12), both, strict=True):
        ratios = 100.0 * np.array([interval(proof.damping[:, r]) for r in result.controlled])
        right.plot(ratios[:, 0], rows + shift, "o", color=colour, label=name)
        for y, (_, low, high) in zip(rows + shift, ratios, strict=True):
            right.plot([low, high], [y, y], color=colour, linewidth=2)
    right.axvline(0.0, color=GREY, linewidth=0.8)
    right.set_yticks(rows, [f"mode {r + 1}" for r in result.controlled])
    right.set(xlabel="damping in the loop [%]", ylim=(len(rows) - 0.5, -0.5))
    right.set_title("damping (95 %)")
    right.legend(fontsize=8)
    return figure


def plot_steps(result: Redesign) -> Figure:
    """What each step leaves of the loss against perfect actuators and sensors."""
    figure, ax = new_figure(width=9, height=1.2 + 0.45 * len(result.steps))
    names = [step.name + ("" if step.kept else " (left out)") for step in result.steps]
    most = max((s.loss for s in result.steps if np.isfinite(s.loss)), default=1.0)
    losses = [100.0 * min(step.loss, 3.0 * max(most, 0.1)) for step in result.steps]
    colours = [OLD if step.name == "present" else NEW if step.kept else GREY for step in result.steps]
    ax.barh(range(len(names)), losses, color=colours)
    for i, step in enumerate(result.steps):
        ax.text(
            losses[i],
            i,
            f"  {100.0 * step.loss:.3g} %" if np.isfinite(step.loss) else "  runs away",
            va="center",
            fontsize=8,
        )
    ax.set_yticks(range(len(names)), names)
    ax.set(ylim=(len(names) - 0.5, -0.5), xlim=(0, 1.15 * max(*losses, 1e-6)))
    ax.set_xlabel("vibration and effort above those with perfect actuators and sensors [%]")
    return figure
