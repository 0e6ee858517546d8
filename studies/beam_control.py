"""Does it matter where four actuators stand on a hinged beam? Section 5.8 of the dissertation."""

import numpy as np
from scipy.integrate import quad

from workbench.design.estimation.modal_filter import hermite_filter
from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.spillover.spillover import energy_gained, finite_spillover, spillover
from workbench.draw.design import plot_work
from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.rig.actuators import Actuator
from workbench.structure.member import Beam

PLACES = {"a": (2.0, 4.0, 6.0, 8.0), "b": (1.5, 3.5, 6.5, 8.5), "c": (1.3, 2.6, 3.9, 5.2)}
TIMES = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
CHECKED = {  # independent values, R = 20, impulse at 6.3
    "a": (0.0, 1.213865e-3, 5.203347e-5, 1.294254e-4, 1.037589e-4),
    "b": (1.294368e-3, 6.055015e-5, 4.532719e-4, 1.080782e-4, 1.335982e-5),
    "c": (8.418221e-3, 1.258416e-1, 4.698541e-2, 6.875917e-3, 3.450264e-2),
}


def quadrature_work(modes, law, state, r):
    """(5.43) by adaptive quadrature of the Fourier integral of the modal force, from the response itself."""
    n, c = modes.n_modes, law.n_controlled
    omega = modes.omega[:c]
    gains = modes.phi([a.at for a in law.actuators]).T[:c] @ law.gain
    g1, g2 = np.diag(gains[:, :c]), np.diag(gains[:, c:])
    decay, ring = 0.5 * g2, np.sqrt(omega**2 + g1 - 0.25 * g2**2)
    rate = state[n : n + c]
    spread = modes.phi([a.at for a in law.actuators])[:, r] @ np.linalg.inv(
        modes.phi([a.at for a in law.actuators]).T[:c]
    )

    def force(t):
        q = rate / ring * np.exp(-decay * t) * np.sin(ring * t)
        v = rate * np.exp(-decay * t) * (np.cos(ring * t) - decay / ring * np.sin(ring * t))
        return spread @ (-g1 * q - g2 * v)

    end = 45.0 / decay.min()
    edges = np.linspace(0.0, end, 400)
    parts = [
        sum(
            quad(lambda t, w=wave: force(t) * w(modes.omega[r] * t), a, b, epsabs=1e-14)[0]
            for a, b in zip(edges, edges[1:])
        )
        for wave in (np.cos, np.sin)
    ]
    return 0.5 * (parts[0] ** 2 + parts[1] ** 2)


def plot_displacements(responses, positions, times, x):
    """The structure's displacement at several times, one column per design, one row per time; actuators marked."""
    figure, axes = new_figure(
        len(times), len(responses), width=10, height=1.55 * len(times), sharex=True, sharey=True, squeeze=False
    )
    for column, (name, response) in enumerate(responses.items()):
        motion = response.displacement(x)
        for row, time in enumerate(times):
            ax = axes[row, column]
            k = int(np.argmin(np.abs(response.time - time)))
            ax.plot(x, motion[:, k], color=COLOURS[0])
            ax.axhline(0.0, color=GREY, linewidth=0.8)
            where = positions[name]
            ax.plot(where, np.zeros(len(where)), "x", color=COLOURS[1], markersize=7, mew=2, label="actuator")
            if column == 0:
                ax.set_ylabel(f"w [m] at\nt = {time:g} s")
        axes[0, column].set_title(f"actuators at {name} m")
        axes[-1, column].set_xlabel("x [m]")
    axes[0, 0].legend(loc="upper right", fontsize=8)
    return figure


def study(outcome, data=None):
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
    modes = beam.modes(9)
    struck = impulse_state(modes, 6.3)
    at_rest = struck.copy()
    at_rest[9 + 4 :] = 0.0  # residual modes at rest, as in the table of W_r
    sensors = np.linspace(0.0, 10.0, 9)
    filter_ = hermite_filter(modes.select(range(4)), sensors, 1.0)
    time = np.linspace(0.0, 60.0, 601)

    works, responses, difference, balance = {}, {}, 0.0, 0.0
    for name, places in outcome.track(list(PLACES.items()), "actuator sets"):
        actuators = [Actuator(f"F{i + 1}", x) for i, x in enumerate(places)]
        law = imsc(modes, 4, actuators, weight=20.0)
        works[name] = spillover(modes, law, at_rest)
        exact = close_loop(modes, law)
        responses[name] = initial_response(exact, time, struck)
        filtered = initial_response(close_loop(modes, law, filter_), time, struck)
        x = np.linspace(0.0, 10.0, 101)
        size = np.abs(responses[name].displacement(x)).max()
        difference = max(difference, np.abs(filtered.displacement(x) - responses[name].displacement(x)).max() / size)
        gained = energy_gained(exact, struck, 60.0)
        balance = max(
            balance, np.abs(finite_spillover(exact, struck, 60.0).work_by_mode - gained).max() / np.abs(gained).max()
        )
        by_quadrature = np.array([quadrature_work(modes, law, at_rest, r) for r in range(4, 9)])
        closed = works[name].residual_work_by_mode
        outcome.check(
            f"W_r, set {name}: closed form against quadrature of (5.43), relative to W_R",
            np.abs(by_quadrature - closed).max() / closed.sum(),
            1e-6,
        )
        outcome.check(
            f"W_r, set {name}: against independent values, relative",
            max(abs(v - c) / max(c, 1e-3 * max(CHECKED[name])) for v, c in zip(closed, CHECKED[name], strict=True)),
            1e-6,
        )

    outcome.table("W_r", {name: work.residual_work_by_mode for name, work in works.items()})
    outcome.table("W_R", {name: work.residual_work for name, work in works.items()})
    outcome.table(
        "displacement",
        {
            name: {f"{t:g}": r.displacement(np.linspace(0, 10, 21))[:, int(10 * t)] for t in TIMES}
            for name, r in responses.items()
        },
    )
    outcome.check(
        "energy of the controlled modes after the impulse, against 0.2484470",
        abs(-works["a"].controlled_work - 0.2484470),
        5e-8,
    )
    outcome.check("energy balance: work supplied against energy gained, relative", balance, 1e-9)
    outcome.check("nine sensors: filtered against exact feedback, share of the largest displacement", difference, 0.005)
    ratio = works["c"].residual_work / works["a"].residual_work
    outcome.say(f"actuators all on the left half (c): {ratio:.0f} times the spillover work of the nodes of mode 5 (a)")
    outcome.say(
        f"energy extracted from the controlled modes: {-works['a'].controlled_work:.7f}, wherever the actuators are"
    )
    labels = {name: ", ".join(f"{x:g}" for x in places) for name, places in PLACES.items()}
    outcome.figure(
        "response",
        plot_displacements(
            {labels[n]: r for n, r in responses.items()},
            {labels[n]: p for n, p in PLACES.items()},
            TIMES,
            np.linspace(0, 10, 201),
        ),
        "Displacement of the beam after an impulse at x = 6.3 m, for three sets of actuators (crosses). Figs. 5.1-5.6.",
    )
    outcome.figure(
        "work",
        plot_work({f"actuators at {labels[n]} m": w for n, w in works.items()}),
        "Spillover work in the five residual modes.",
    )
