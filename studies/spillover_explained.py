"""A design stable on the reduced model fails on the full one: which mode, by which path, and what restores it?"""

import numpy as np

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import displacement_filter
from workbench.design.estimation.observers import kalman_controller, luenberger_controller
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.law import Law
from workbench.design.loop.closed_loop import close_loop, close_with
from workbench.design.spillover.explain import explain_spillover
from workbench.design.spillover.remedies import spillover_remedies, sufficient_sensors
from workbench.draw.design import plot_spillover_paths
from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam

# after Balas (1978): a hinged beam, three modes controlled by one actuator at a sixth and one sensor
CONTROLLED = 3
ACTUATORS = (Actuator("F1", 10.0 / 6.0), Actuator("F2", 10.0 / 2.3))
BESIDE, ACROSS = 10.0 / 6.0, 50.0 / 6.0


def decay_rate_of_filter(modes, way, actuators, count=24):
    places = modes.length * np.arange(1, count + 1) / (count + 1)
    return close_with(modes, way(actuators, places)).decay_rate


def plot_sensor_counts(decay_rates, counts):
    """Decay rate of the full plant against the number of sensors, one line an estimator."""
    figure, ax = new_figure(width=9, height=4.5)
    for (name, values), colour, mark in zip(decay_rates.items(), COLOURS, "osD", strict=False):
        numbers = np.arange(1, len(values) + 1)
        there = np.isfinite(values)
        count = counts[name]
        label = f"{name}: stable from {count} sensors on" if count else f"{name}: unstable up to {len(values)}"
        ax.plot(numbers[there], values[there], mark + "-", color=colour, label=label, markersize=4)
    ax.axhline(0.0, color=GREY, linewidth=1.0)
    largest = max(v[np.isfinite(v)].max() for v in decay_rates.values())
    ax.set_yscale("symlog", linthresh=max(largest, 1e-6))
    ax.set(xlabel="number of sensors, evenly spaced", ylabel="decay rate, −max Re λ [1/s]; below zero unstable")
    ax.set_title("observation spillover: decay rate of the full plant against the number of sensors")
    ax.legend()
    return figure


def study(outcome, data=None):
    beam = Beam(
        length=10.0,
        mass_per_length=1.0,
        bending_stiffness=1.0,
        left="hinged",
        right="hinged",
        damping=ModalDamping(0.002),
    )
    modes = beam.modes(12)

    def law(actuators, share=1.0):
        design = coupled_lqr(modes, CONTROLLED, actuators, weight=1.0)
        return Law(share * design.gain, design.controlled, design.actuators, design.name)

    def observed(actuators, sensors, share=1.0):
        sensors = [Sensor(f"y{i + 1}", x) for i, x in enumerate(sensors)]
        return luenberger_controller(
            modes, law(actuators, share), sensors, poles=(-0.3 + 1j) * modes.omega[:CONTROLLED]
        )

    def estimated(actuators, sensors, share=1.0):
        sensors = [Sensor(f"y{i + 1}", x) for i, x in enumerate(sensors)]
        return kalman_controller(modes, law(actuators, share), sensors, disturbance=1.0, noise=1e-2)

    def through_filter(actuators, sensors, share=1.0):
        return filtered(law(actuators, share), displacement_filter(modes.select(range(CONTROLLED)), sensors, 1.0))

    def reduced(controller):
        return close_with(modes.select(range(CONTROLLED)), controller).decay_rate

    one = ACTUATORS[:1]
    stable, unstable = (explain_spillover(modes, observed(one, [place])) for place in (BESIDE, ACROSS))
    outcome.check(
        "decay rate on the reduced model, sensor across, 1/s", reduced(observed(one, [ACROSS])), 0.01, at_least=True
    )
    outcome.check(
        "decay rate on the full model, sensor beside the actuator, 1/s", stable.decay_rate, 0.0, at_least=True
    )
    outcome.check("decay rate on the full model, sensor across, 1/s", unstable.decay_rate, 0.0)
    worst = unstable.destabilising
    outcome.say(
        f"one sensor at x = {BESIDE:.2f}, beside the actuator: stable, decay rate {stable.decay_rate:.2g} 1/s; at"
        f" {ACROSS:.2f}: mode {worst.mode + 1} grows at {worst.closed_pole.real:.2g} 1/s, though the reduced model"
        f" has a decay rate of {reduced(observed(one, [ACROSS])):.2g} 1/s"
    )

    # two actuators and two sensors: by which path?
    crossed = explain_spillover(modes, observed(ACTUATORS, [3.1, ACROSS]))
    worst = crossed.shifts[0]
    path = worst.paths[0]
    outcome.check(
        "paths add up to the exact shift of every residual pole, relative to its frequency",
        max(abs(sum(p.shift for p in m.paths) - m.shift) / abs(m.pole) for m in crossed.shifts),
        1e-9,
    )
    outcome.say(
        f"two actuators, two sensors: mode {worst.mode + 1} moves by {worst.shift.real:+.3g} 1/s,"
        f" {path.shift.real:+.3g} of it from the sensor at {path.sensor_at:.2f} to {path.actuator}; first order says"
        f" {worst.first_order.real:+.3g}"
    )

    found = spillover_remedies(modes, observed, one, [ACROSS])
    for remedy in found:
        outcome.say(f"stabilised by: {remedy.change}; decay rate then {remedy.decay_rate:.2g} 1/s")
    checked = [explain_spillover(modes, remedy.controller).decay_rate for remedy in found]
    outcome.check(
        "every remedy, recomputed on the full plant: minimum decay rate, 1/s", min(checked), 0.0, at_least=True
    )
    outcome.check("kinds of remedy found", len(found), 4, at_least=True)

    ways = {"Luenberger observer": observed, "Kalman filter": estimated, "modal filter": through_filter}
    counts, decay_rates = {}, {}
    for name, way in ways.items():
        counts[name], decay_rates[name] = sufficient_sensors(modes, way, one, max_sensors=24)
        outcome.say(f"{name}: {counts[name] or 'no number up to 24 of'} evenly spaced sensors suffice")
    outcome.say(
        "k evenly spaced sensors alias mode 2(k + 1) - r onto mode r, so the loop with a filter of displacements alone"
        " is stable only where the alias of its highest mode lies beyond the modes of the plant"
    )
    perfect = close_loop(modes, law(one)).decay_rate
    outcome.check("number of sensors that suffices for the modal filter", counts["modal filter"] or np.inf, 24)
    outcome.check(
        "its decay rate with 24 sensors over that with exact modal coordinates",
        decay_rate_of_filter(modes, through_filter, one) / perfect,
        0.99,
        at_least=True,
    )
    outcome.table(
        "balas",
        [
            {
                "sensor": place,
                "decay_rate": e.decay_rate,
                "mode": e.shifts[0].mode + 1,
                "shift": e.shifts[0].shift.real,
                "first_order": e.shifts[0].first_order.real,
            }
            for place, e in ((BESIDE, stable), (ACROSS, unstable))
        ],
    )
    outcome.table(
        "paths",
        [{"actuator": p.actuator, "sensor": p.sensor_at, "growth": p.shift.real} for p in worst.paths],
    )
    outcome.table(
        "remedies", [{"kind": r.kind, "change": r.change, "size": r.size, "decay_rate": r.decay_rate} for r in found]
    )
    outcome.table("sufficient_sensors", counts)
    outcome.figure(
        "paths",
        plot_spillover_paths(crossed),
        "How fast each residual mode grows or decays under control, and the paths that make it.",
    )
    outcome.figure(
        "cure", plot_sensor_counts(decay_rates, counts), "Decay rate of the full plant against the number of sensors."
    )
