"""Where should four actuators stand, and the sensors of a filter, and what does less spillover cost?"""

import numpy as np

from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import nodes_of_mode, place_actuators, placement_task, scan, symbolic_work
from workbench.design.placement.sensor_placement import place_sensors
from workbench.draw.style import COLOURS, new_figure
from workbench.structure.member import Beam

SPACING = 0.5


def plot_effort_front(placements, marked):
    """Spillover against effort along the front of placements, with named ones marked; the places below."""
    figure, axes = new_figure(2, 1, width=9, height=7, height_ratios=[3, 2])
    effort = [p.effort for p in placements]
    work = [p.residual_work for p in placements]
    axes[0].plot(effort, work, "o-", color=COLOURS[0], label="least W_R at each effort")
    for (name, p), colour in zip(marked.items(), COLOURS[1:], strict=False):
        axes[0].plot(p.effort, p.residual_work, "s", color=colour, markersize=9, label=name)
    axes[0].set(xscale="log", yscale="log", xlabel="effort ∫ FᵀF dt [N² s]", ylabel="spillover work W_R [J]")
    axes[0].set_title("spillover against effort")
    axes[0].legend()
    for p in placements:
        axes[1].plot(p.positions, np.full(p.positions.size, p.effort), "o", color=COLOURS[0], markersize=4)
    for (_, p), colour in zip(marked.items(), COLOURS[1:], strict=False):
        axes[1].plot(p.positions, np.full(p.positions.size, p.effort), "s", color=colour)
    axes[1].set(yscale="log", xlabel="places of the actuators, x [m]", ylabel="effort [N² s]")
    return figure


def study(outcome, data=None):
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
    modes = beam.modes(9)
    task = placement_task(modes, 4, impulse_at=6.3, weight=20.0)
    nodes = task.placed(nodes_of_mode(modes, 4), "nodes of mode 5")

    front = [
        place_actuators(task, Limits(effort=factor * nodes.effort, spacing=SPACING))
        for factor in outcome.track((1.0001, 1.02, 1.05, 1.1, 1.2, 1.5, 2.0, 3.0, 5.0), "effort limits")
    ]
    limits = Limits(effort=1.5 * nodes.effort, spacing=SPACING)
    best = place_actuators(task, limits)
    on_grid, tried = scan(task, limits, n_places=50)

    work, effort, *_ = symbolic_work(task)(best.positions)
    outcome.table(
        "front",
        [
            {"effort": p.effort, "W_R": p.residual_work, "positions": p.positions, "condition": p.condition}
            for p in front
        ],
    )
    outcome.table("nodes_of_mode_5", {"effort": nodes.effort, "W_R": nodes.residual_work, "positions": nodes.positions})
    outcome.table(
        "best", {"effort": best.effort, "W_R": best.residual_work, "positions": best.positions, "tried": tried}
    )
    outcome.check("CasADi's W_R against the closed form, relative", abs(float(work) / best.residual_work - 1.0), 1e-8)
    outcome.check("CasADi's effort against the closed form, relative", abs(float(effort) / best.effort - 1.0), 1e-8)
    outcome.check("W_R of the optimum over the best of a full grid", best.residual_work / on_grid.residual_work, 1.0)
    outcome.check("spillover into mode 5 of actuators at its nodes", nodes.residual_work_by_mode[0], 1e-20)
    outcome.say(
        f"at the nodes of mode 5 W_R = {nodes.residual_work:.3e}; with half as much effort again it is"
        f" {best.residual_work:.3e} at x = {', '.join(f'{x:.2f}' for x in best.positions)}"
    )
    outcome.say(f"none of {tried} placements on a grid does better under the same limits")
    squares = (modes.phi(6.3)[0] / modes.omega) ** 2
    sensors = {k: place_sensors(modes, 4, k, 1.0, mean_squares=squares, starts=1) for k in (4, 6)}
    outcome.table(
        "sensors",
        {k: {"positions": s.positions, "error": s.error, "even": s.evenly_spaced_error} for k, s in sensors.items()},
    )
    outcome.check(
        "error of a filter's coordinates, sensors placed over evenly spaced, worst of 4 and 6 sensors",
        max(s.error / s.evenly_spaced_error for s in sensors.values()),
        1.0,
    )
    outcome.say(
        "; ".join(
            f"{k} sensors of a filter: {s.evenly_spaced_error:.1%} of error evenly spaced, {s.error:.1%} placed"
            for k, s in sensors.items()
        )
    )
    outcome.figure(
        "front",
        plot_effort_front(front, {"nodes of mode 5": nodes, "optimum at 1.5 × their effort": best}),
        "Least spillover at each effort, and the actuator positions there.",
    )
    assert np.all(np.diff(best.positions) >= SPACING - 1e-6)
