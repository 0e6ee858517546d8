"""From a measured ring-down to a controlled beam: what is identified and designed, and which mode does it excite?

An impulse excites a hinged beam; eleven noisy sensors record it. Everything after the first function knows the
record, the length, the ends and the mass of the beam, never its modes. The law designed on the identified modes then
drives the true beam.
"""

import numpy as np

from workbench.design.estimation.modal_filter import displacement_filter
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import Law
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import place_actuators, placement_task
from workbench.design.spillover.spillover import effort, finite_spillover, quadratic_cost
from workbench.draw.design import plot_motion, plot_work_linear
from workbench.draw.motion import response_motion
from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.identification.free_decay.ibrahim import stacked_delays
from workbench.identification.free_decay.refinement import refine
from workbench.identification.shapes.eigenfunctions import BoundaryConditions, eigenfunctions
from workbench.identification.signal.synthesis import free_decay, impulse_response_modes
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.rig.statespace import state_space
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam
from workbench.structure.modes import mac

LENGTH, MASS = 10.0, 1.0
SENSORS = np.linspace(0.0, LENGTH, 13)[1:-1]
HAMMER_AT = 7.3  # well away from the nodes of all nine modes
DISTURBED_AT = 6.3  # as in section 5.8
N_MODES, N_CONTROLLED = 9, 4
MODAL_WEIGHT, FORCE_WEIGHT = 20.0, 10.0
FINAL_TIME = 60.0
EVEN = (2.0, 4.0, 6.0, 8.0)


def measured():
    """The beam's true modes, and its ring-down at eleven sensors with 1 % noise."""
    beam = Beam(
        length=LENGTH,
        mass_per_length=MASS,
        bending_stiffness=1.0,
        left="hinged",
        right="hinged",
        damping=ModalDamping(0.002),
    )
    modes = beam.modes(N_MODES)
    decay = impulse_response_modes(modes, at=HAMMER_AT, positions=SENSORS)
    sampling = {"sample_time": 0.2, "n_samples": 3000, "quantity": "velocity"}
    noise = 0.01 * free_decay(decay, **sampling).outputs.std()
    return modes, free_decay(decay, **sampling, noise_std=noise, seed=1)


def identified(record):
    """Mass-normalised modes with the uncertainty of each figure."""
    found = refine(record, stacked_delays(record, n_modes=N_MODES))
    ends = BoundaryConditions.of("beam", length=LENGTH, left="hinged", right="hinged")
    modes = eigenfunctions(found.modes, length=LENGTH, mass_per_length=MASS, ends=ends, covariance=found.covariance)
    return modes, found


def actuators_at(places) -> list[Actuator]:
    return [Actuator(f"F{i + 1}", float(x)) for i, x in enumerate(places)]


def designs(modes) -> dict[str, Law]:
    """Three laws for the lowest four of the identified modes."""
    even = actuators_at(EVEN)
    task = placement_task(modes, N_CONTROLLED, impulse_at=DISTURBED_AT, weight=MODAL_WEIGHT)
    limit = 1.5 * task.placed(EVEN, "even").effort
    best = place_actuators(task, Limits(effort=limit, spacing=0.5))
    return {
        "IMSC": imsc(modes, N_CONTROLLED, even, weight=MODAL_WEIGHT),
        "coupled LQR": coupled_lqr(modes, N_CONTROLLED, even, weight=FORCE_WEIGHT),
        "IMSC, placed": imsc(modes, N_CONTROLLED, actuators_at(best.positions), weight=MODAL_WEIGHT),
    }


def plot_ring_down(record, *, stretch):
    """Every output over time, one above the other, each at its place; the first `stretch` seconds."""
    shown = record.between(record.start_time, record.start_time + stretch)
    figure, ax = new_figure(width=9, height=4.5)
    size = 1.1 * np.abs(shown.outputs).max()
    for j, channel in enumerate(shown.output_channels):
        ax.axhline(j, color=GREY, linewidth=0.4)
        ax.plot(shown.time, j + 0.5 * shown.outputs[j] / size, color=COLOURS[0], linewidth=0.9)
        place = channel.name if channel.at is None else f"x = {channel.at:.3g} m"
        ax.text(shown.time[-1], j, f"  {place}", va="center")
    ax.set(xlabel="time [s]", yticks=[], xlim=(shown.time[0], shown.time[-1]))
    first = record.output_channels[0]
    ax.set_title(f"{first.quantity}, one line per sensor, {2.0 * size:.2g} {first.unit} apart".lstrip(", "))
    return figure


def plot_identified(found, truth, positions, *, count):
    """Identified eigenfunctions over the true ones, with their values at the sensors."""
    figure, axes = new_figure(-(-count // 3), 3, width=10, height=4.6, sharex=True, sharey=True, squeeze=False)
    x = np.linspace(0.0, truth.length, 301)
    for r, ax in zip(range(count), axes.flat, strict=False):
        sign = np.sign(found.phi(x)[:, r] @ truth.phi(x)[:, r])
        ax.plot(x, truth.phi(x)[:, r], color=GREY, linewidth=4, alpha=0.5, label="true")
        ax.plot(x, sign * found.phi(x)[:, r], color=COLOURS[0], label="identified")
        at_sensors = sign * found.phi(positions)[:, r]
        ax.plot(positions, at_sensors, "o", color=COLOURS[1], markersize=4, label="at the sensors")
        ax.set_title(f"mode {r + 1}: {found.frequencies_hz[r]:.4f} Hz, ζ = {100 * found.zeta[r]:.2f} %", fontsize=10)
    for ax in axes[-1]:
        ax.set_xlabel("x [m]")
    for ax in axes[:, 0]:
        ax.set_ylabel("φ(x) [1/√kg]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def study(outcome, data=None) -> None:
    stages = iter(outcome.track(range(4), "measure, identify, design, close the loop"))
    truth, record = measured()
    next(stages)

    modes, found = identified(record)
    next(stages)
    x = np.linspace(0.0, LENGTH, 201)
    report_modes(outcome, truth, modes, found, x)
    outcome.figure(
        "ring_down",
        plot_ring_down(record, stretch=120.0),
        "What was measured: velocity at eleven places after an impulse at x = 7.3 m. Noise is 1 % of the signal.",
    )
    outcome.figure(
        "modes",
        plot_identified(modes, truth, SENSORS, count=6),
        "What was found: eigenfunctions through the sensors (dots), over the true ones (grey).",
    )

    laws = designs(modes)
    next(stages)
    model = state_space(modes, laws["IMSC"].actuators, [Sensor(f"y{j + 1}", at) for j, at in enumerate(SENSORS)])
    outcome.say(f"The model: {model.nstates} states, {model.ninputs} actuators, {model.noutputs} sensors.")
    report_designs(outcome, truth, modes, laws)
    next(stages)

    report_motion(outcome, truth, modes, laws, x)


def report_modes(outcome, truth, modes, found, x) -> None:
    frequency = np.abs(modes.omega / truth.omega - 1)
    damping = np.abs(modes.zeta / truth.zeta - 1)
    same = np.diag(mac(modes.phi(x), truth.phi(x)))
    scale = np.abs((modes.phi(x) * truth.phi(x)).sum(0) / (truth.phi(x) ** 2).sum(0))
    outcome.table(
        "modes",
        [
            {
                "mode": r + 1,
                "frequency_hz": modes.frequencies_hz[r],
                "frequency_std_hz": found.omega_std[r] / (2 * np.pi),
                "damping": modes.zeta[r],
                "damping_std": found.zeta_std[r],
                "mac": same[r],
                "scale": scale[r],
            }
            for r in range(modes.n_modes)
        ],
    )
    off = np.abs(modes.omega - truth.omega) / found.omega_std
    outcome.say(f"All nine modes found: frequencies to {frequency.max():.1e}, damping to {100 * damping.max():.1f} %.")
    outcome.check("frequencies, worst relative error", frequency.max(), 1e-4)
    outcome.check("damping ratios, worst relative error", damping.max(), 0.05)
    outcome.check("frequencies, worst error in standard errors", off.max(), 4.0)
    outcome.check("shapes, least MAC of the first six", same[:6].min(), 0.999, at_least=True)
    outcome.check("shapes, worst error of scale of the first six", np.abs(scale[:6] - 1).max(), 0.02)


def report_designs(outcome, truth, modes, laws) -> None:
    """Cost, effort and spillover of each law, on the true beam."""
    state = impulse_state(truth, DISTURBED_AT)
    state[truth.n_modes + N_CONTROLLED :] = 0.0  # residual modes at rest, so that W_r is what control puts there
    rows = []
    for name, law in laws.items():
        work = finite_spillover(close_loop(truth, law), state, FINAL_TIME)
        expected = finite_spillover(close_loop(modes, law), state, FINAL_TIME)
        rows.append(
            {
                "law": name,
                "places": [a.at for a in law.actuators],
                "cost": quadratic_cost(truth, law, state, FORCE_WEIGHT),
                "effort": effort(truth, law, state),
                "W_C": work.controlled_work,
                "W_r": work.residual_work_by_mode,
                "W_R": work.residual_work,
                "W_R_expected": expected.residual_work,
            }
        )
    outcome.table("designs", rows)
    even, coupled, placed = rows
    outcome.say(
        f"IMSC at 2, 4, 6, 8: spillover work W_R = {even['W_R']:.2e} in the residual modes,"
        f" {100 * even['W_R'] / -even['W_C']:.1f} % of the energy extracted from the controlled ones; coupled LQR"
        f" {coupled['W_R']:.2e}: at the nodes of mode 5 the two are one law."
    )
    where = ", ".join(f"{at:.2f}" for at in placed["places"])
    outcome.say(f"Placed at {where}, the same law has W_R = {placed['W_R']:.2e} for at most 1.5 times the effort.")
    outcome.check("placed: W_R over that of evenly spaced positions", placed["W_R"] / even["W_R"], 1.0)
    outcome.check("placed: effort over that of evenly spaced positions", placed["effort"] / even["effort"], 1.505)
    outcome.figure(
        "work",
        plot_work_linear({row["law"]: row["W_r"] for row in rows}, first=N_CONTROLLED),
        "Spillover work of each law in the residual modes, on the true beam.",
    )


def report_motion(outcome, truth, modes, laws, x) -> None:
    """The true beam under the identified law, fed by eleven displacement sensors through modal filters."""
    state = impulse_state(truth, DISTURBED_AT)
    time = np.linspace(0.0, FINAL_TIME, 601)
    filter_ = displacement_filter(modes.select(slice(N_CONTROLLED)), SENSORS, MASS)
    idle = Law(np.zeros_like(laws["IMSC"].gain), laws["IMSC"].controlled, laws["IMSC"].actuators, "no control")
    loops = {
        "no control": close_loop(truth, idle),
        "through modal filters": close_loop(truth, laws["IMSC"], filter_),
        "exact modal coordinates": close_loop(truth, laws["IMSC"]),
    }
    responses = {name: initial_response(loop, time, state) for name, loop in loops.items()}
    energy = {name: r.energy[:N_CONTROLLED].sum(0) for name, r in responses.items()}
    left = energy["through modal filters"][-1] / energy["no control"][-1]
    apart = np.abs(
        responses["through modal filters"].displacement(x) - responses["exact modal coordinates"].displacement(x)
    ).max()
    apart /= np.abs(responses["exact modal coordinates"].displacement(x)).max()
    poles = np.linalg.eigvals(loops["through modal filters"].matrix)
    kept = f"{100 * left:.1e} %"
    outcome.say(f"After {FINAL_TIME:g} s the controlled modes keep {kept} of the energy they would have had.")
    outcome.check("closed loop on the true beam, largest real part of its poles", poles.real.max(), 0.0)
    outcome.check("energy left in the controlled modes, share of the uncontrolled", left, 0.02)
    outcome.check("filtered against exact feedback, share of the largest displacement", apart, 0.02)
    outcome.figure(
        "motion",
        plot_motion(responses, x),
        "The beam from end to end (upwards) over time (rightwards), without and with control.",
    )
    shown = {name: responses[name] for name in ("no control", "through modal filters")}
    sensors = [Sensor(f"y{i + 1}", at, "displacement") for i, at in enumerate(SENSORS)]
    outcome.motion(
        response_motion(shown, actuators=laws["IMSC"].actuators, sensors=sensors),
        "The same motion after an impulse at x = 6.3 m, uncontrolled and with four actuators (triangles).",
    )
