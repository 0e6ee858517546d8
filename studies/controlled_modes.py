"""How many modes need control, and when does one more cause more spillover than it removes?"""

import numpy as np

from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_loop, impulse_state
from workbench.design.placement.controlled_modes import controlled_mode_count
from workbench.design.placement.placement import nodes_of_mode
from workbench.design.spillover.spillover import finite_spillover
from workbench.draw.design import plot_controlled_mode_count
from workbench.rig.actuators import Actuator
from workbench.structure.member import Beam

WEIGHT, SHARE, PUSH = 20.0, 0.05, 1.0


def after_half_sine(modes, at, seconds):
    """State after a half-sine force (N) of some seconds at a place, undamped modes from rest, from its end on."""
    w, turn = modes.omega, np.pi / seconds
    strength = PUSH * modes.phi(at)[0]
    s = 1j * w
    transform = turn * (1 + np.exp(-s * seconds)) / (turn**2 - w**2) * strength
    # q' + iω q at the end of the force is the force's transform turned on by e^{iωt}
    moving = transform * np.exp(s * seconds)
    return np.r_[moving.imag / w, moving.real]


def study(outcome, data=None):
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
    modes = beam.modes(24)
    impulse = impulse_state(modes, 6.3)
    force = after_half_sine(modes, 6.3, 4.0)
    found = {
        "an impulse, the same momentum for every mode": controlled_mode_count(
            modes, impulse, weight=WEIGHT, share=SHARE
        ),
        "a half-sine force of 4 s": controlled_mode_count(modes, force, weight=WEIGHT, share=SHARE),
    }
    for name, result in found.items():
        n = result.recommended
        outcome.say(
            f"{name}: control {n} modes, which leave {result.residual[n - 1] / result.energy.sum():.1%} of the energy"
            if n
            else f"{name}: no number up to {result.counts[-1]} leaves as little as {SHARE:.0%};"
            f" least is left with {result.least}"
        )
        outcome.table(
            name.split(",")[0].replace(" ", "_"),
            {
                "energy": result.energy,
                "uncontrolled": result.uncontrolled,
                "spillover": result.spillover,
                "effort": result.effort,
                "recommended": n,
                "least": result.least,
            },
        )
    gentle = found["a half-sine force of 4 s"]
    n = gentle.recommended
    law = imsc(modes, n, [Actuator(f"F{i}", x) for i, x in enumerate(nodes_of_mode(modes, n))], weight=WEIGHT)
    rest = force.copy()
    rest[n:24] = rest[24 + n :] = 0.0
    late = finite_spillover(close_loop(modes, law), rest, 2000.0)
    outcome.check(
        "spillover work of the recommended number, against the work up to 2000 s, relative",
        abs(late.residual_work / gentle.spillover[n - 1] - 1.0),
        1e-6,
    )
    outcome.check(
        "work of control on its modes (5.27) against the energy that the force gave them, relative",
        abs(-late.controlled_work / gentle.energy[:n].sum() - 1.0),
        1e-9,
    )
    outcome.check("modes recommended for a force of 4 s", n, 6)
    outcome.check(
        "energy left with one mode fewer, over the limit",
        gentle.residual[n - 2] / (SHARE * gentle.energy.sum()),
        1.0,
        at_least=True,
    )
    outcome.figure(
        "energy",
        plot_controlled_mode_count(found, SHARE),
        "Energy left when the lowest n modes are controlled, by what leaves it.",
    )
