"""What does less spillover cost, is an optimum global, and how far from it are the nodes of mode n+1?"""

import numpy as np

from workbench.design.laws.coupled import coupled_lqr
from workbench.design.loop.closed_loop import impulse_state
from workbench.design.placement.certificate import certify
from workbench.design.placement.coupled_placement import place_coupled, scan_coupled
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import nodes_of_mode, place_actuators, placement_task
from workbench.design.spillover.spillover import quadratic_cost
from workbench.draw.style import COLOURS, new_figure
from workbench.rig.actuators import Actuator
from workbench.structure.member import Beam

SPACING = 0.5
FACTORS = (1.0001, 1.05, 1.1, 1.2, 1.5, 2.0, 3.0, 5.0)
# share of W_R to be proven by number of actuators: cells grow by about thirty with each
GAPS = {1: 0.01, 2: 0.01, 3: 0.01, 4: 0.05}
# of a rig: a stretch that is taken, an amplifier's force, a condition of B
TIGHT = {"forbidden": ((6.0, 6.6),), "peak_force": 0.32, "condition": 6.0}
# places of the grid on which coupled LQR is tried with each number of actuators
GRIDS = {2: 200, 3: 60, 4: 24}


def plot_placement_fronts(fronts, rule):
    """Least spillover against effort for each disturbance, the rule of the nodes beside it, and the places taken."""
    figure, axes = new_figure(2, len(fronts), width=11, height=7, sharex=True, sharey="row", squeeze=False)
    for (name, front), (above, below) in zip(fronts.items(), axes.T, strict=True):
        effort = [p.effort for p in front]
        above.plot(effort, [p.residual_work for p in front], "o-", color=COLOURS[0], label="optimum at each effort")
        above.plot(
            rule[name].effort,
            rule[name].residual_work,
            "s",
            color=COLOURS[1],
            markersize=9,
            label="nodes of the next mode",
        )
        below.plot(effort, np.array([p.positions for p in front]), "o-", color=COLOURS[0], markersize=4)
        below.plot(np.full(rule[name].positions.size, rule[name].effort), rule[name].positions, "s", color=COLOURS[1])
        alone = np.ptp(effort) < 1e-3 * effort[0]
        above.set_title(f"{name}: one placement is best at any effort" if alone else name)
        above.set_ylim(bottom=0.0)
        above.legend()
        below.set(xlabel="effort ∫ FᵀF dt [N² s]")
    axes[0, 0].set_ylabel("spillover work W_R [J]")
    axes[1, 0].set_ylabel("places of the actuators [m]")
    return figure


def study(outcome, data=None):
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
    modes = beam.modes(9)
    places = np.linspace(0.5, 9.5, 19)
    disturbances = {"an impulse at x = 6.3 m": 6.3, "an impulse anywhere": places}

    fronts, nodes = {}, {}
    for name, at in disturbances.items():
        task = placement_task(modes, 4, impulse_at=at, weight=20.0)
        nodes[name] = task.placed(nodes_of_mode(modes, 4), "nodes of mode 5")
        fronts[name] = [
            place_actuators(task, Limits(effort=factor * nodes[name].effort, spacing=SPACING), starts=6)
            for factor in outcome.track(FACTORS, f"front for {name}")
        ]
        outcome.table(
            name.replace(" ", "_"),
            {
                "nodes": {"effort": nodes[name].effort, "W_R": nodes[name].residual_work},
                "front": [
                    {"effort": p.effort, "W_R": p.residual_work, "peak_force": p.peak_force, "positions": p.positions}
                    for p in fronts[name]
                ],
                "tail_bound_of_the_nodes": placement_task(beam.modes(40), 4, impulse_at=at, weight=20.0).tail_bound(
                    nodes[name].positions, growth=2.0
                ),
            },
        )
        outcome.say(
            f"{name}: at the effort of the nodes of mode 5 the optimum has a W_R of"
            f" {fronts[name][0].residual_work / nodes[name].residual_work:.0%} of theirs; with half as much again"
            f" {fronts[name][4].residual_work / nodes[name].residual_work:.0%}"
        )
        work = np.array([p.residual_work for p in fronts[name]])
        outcome.check(f"{name}: W_R does not rise along the front, largest step", float(np.diff(work).max()), 1e-12)
        outcome.check(
            f"{name}: W_R of the optimum over the nodes' at their effort",
            fronts[name][0].residual_work / nodes[name].residual_work,
            1.0,
        )

    proofs = []
    for n, gap, more in outcome.track(
        [*((n, gap, {}) for n, gap in GAPS.items()), (4, GAPS[4], TIGHT)], "certificates"
    ):
        task = placement_task(modes, n, impulse_at=6.3, weight=20.0)
        rule = task.placed(nodes_of_mode(modes, n), f"nodes of mode {n + 1}")
        limits = Limits(effort=1.5 * rule.effort, spacing=SPACING, **more)
        best = place_actuators(task, limits)
        proof = certify(task, limits, placement=best, gap=gap)
        proofs.append(
            {
                "actuators": n,
                "further_limits": more,
                "positions": best.positions,
                "W_R": best.residual_work,
                "lower_bound": proof.lower_bound,
                "gap": proof.gap,
                "cells": proof.cells,
                "nodes_W_R": rule.residual_work,
            }
        )
        under = ", under every limit" if more else ""
        outcome.check(f"{n} actuators{under}: certified optimality gap", proof.gap, gap * (1 + 1e-9))
        outcome.say(
            f"{n} actuator(s){under}: no placement has less than {1 - proof.gap:.0%} of the least W_R found, by"
            f" {proof.cells} cells of branch and bound; at the nodes of mode {n + 1} it is"
            f" {rule.residual_work / best.residual_work:.2f} times the optimum"
        )
    outcome.table("certificates", proofs)

    at_one_place = next(iter(disturbances))
    rule, best = nodes[at_one_place], fronts[at_one_place][4]
    limits = Limits(effort=1.5 * rule.effort, spacing=SPACING)
    together = place_coupled(modes, 4, 4, impulse_at=6.3, weight=10.0, limits=limits)
    scans = []
    for n, places in outcome.track(GRIDS.items(), "grids for coupled LQR"):
        own = together if n == 4 else place_coupled(modes, 4, n, impulse_at=6.3, weight=10.0, limits=limits)
        grid = scan_coupled(modes, 4, n, impulse_at=6.3, weight=10.0, limits=limits, n_places=places)
        scans.append(
            {
                "actuators": n,
                "tried": grid.tried,
                "W_R": own.residual_work,
                "positions": own.positions,
                "W_R_of_the_grid": grid.best.residual_work,
                "lower_bound_between_its_places": min(grid.lower_bound, own.residual_work),
            }
        )
        outcome.check(
            f"coupled LQR, {n} actuators: W_R of the optimum over the best of a grid",
            own.residual_work / grid.best.residual_work,
            1.0,
        )
        outcome.say(
            f"coupled LQR with {n} actuators for four modes: W_R = {own.residual_work:.2e}; none of {grid.tried}"
            f" placements on a grid has a lower one; between them, if all changes as it does from one to the next, it"
            f" could fall to {min(grid.lower_bound, own.residual_work) / own.residual_work:.0%} of that, not proven"
        )
    outcome.table("coupled_lqr_scans", scans)
    state = impulse_state(modes, 6.3)
    state[9 + 4 :] = 0.0
    regulators = {
        "IMSC": best.law,
        "coupled LQR": coupled_lqr(
            modes, 4, [Actuator(f"F{i + 1}", float(x)) for i, x in enumerate(together.positions)], weight=10.0
        ),
    }
    cost = {name: quadratic_cost(modes, law, state, 10.0) for name, law in regulators.items()}
    outcome.table(
        "coupled_lqr",
        {
            "positions": together.positions,
            "W_R": together.residual_work,
            "effort": together.effort,
            "cost": cost["coupled LQR"],
            "cost_of_imsc": cost["IMSC"],
        },
    )
    outcome.check(
        "coupled LQR, placed for its own W_R: W_R over that of IMSC's optimum",
        together.residual_work / best.residual_work,
        1.0,
    )
    outcome.say(
        f"coupled LQR placed for itself has {together.residual_work / best.residual_work:.2g} of the W_R of IMSC at its"
        f" optimum, for {together.effort / best.effort:.2f} of the effort and"
        f" {cost['coupled LQR'] / cost['IMSC']:.2f} of the cost: it need not act on every mode, nor use every actuator"
        f" (they are at {', '.join(f'{x:.2f}' for x in together.positions)})"
    )
    outcome.figure(
        "front", plot_placement_fronts(fronts, nodes), "Least spillover at each effort, beside the nodes of mode 5."
    )
