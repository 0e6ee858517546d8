"""Does a design stay stable on every structure within the identification uncertainty, and when the structure drifts?"""

import numpy as np

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import displacement_filter
from workbench.design.estimation.observers import kalman_controller, luenberger_controller
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.loop.reidentify import open_loop, updated
from workbench.design.spillover.robustness import draw_modes, robustness
from workbench.design.spillover.spillover import distributed_cost, modal_cost
from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.identification.free_decay.ibrahim import stacked_delays
from workbench.identification.free_decay.refinement import refine
from workbench.identification.shapes.eigenfunctions import BoundaryConditions, eigenfunctions
from workbench.identification.signal.synthesis import free_decay, impulse_response_modes
from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam

LENGTH, N_MODES, CONTROLLED = 10.0, 9, 3
SENSORS = np.linspace(0.0, LENGTH, 13)[1:-1]
ACTUATORS = tuple(Actuator(f"F{i + 1}", x) for i, x in enumerate((2.5, 5.0, 7.5)))
SCALES = (1.0, 10.0, 30.0, 100.0)
DRAWS, FINAL_TIME, WEIGHT = 100, 60.0, 20.0
DRIFT = np.linspace(0.0, 0.1, 6)


def beam(stiffness=1.0):
    return Beam(
        length=LENGTH,
        mass_per_length=1.0,
        bending_stiffness=stiffness,
        left="hinged",
        right="hinged",
        damping=ModalDamping(0.002),
    ).modes(N_MODES)


def identified():
    """Modes and their errors from a ring-down with noise of 3 %."""
    decay = impulse_response_modes(beam(), at=7.3, positions=SENSORS)
    sampling = {"sample_time": 0.2, "n_samples": 1500, "quantity": "velocity"}
    noise = 0.03 * free_decay(decay, **sampling).outputs.std()
    record = free_decay(decay, **sampling, noise_std=noise, seed=3)
    found = refine(record, stacked_delays(record, n_modes=N_MODES))
    ends = BoundaryConditions.of("beam", length=LENGTH, left="hinged", right="hinged")
    modes = eigenfunctions(found.modes, length=LENGTH, mass_per_length=1.0, ends=ends, covariance=found.covariance)
    return modes, found


def designs(modes):
    own = modes.select(range(CONTROLLED))
    laws = {
        "IMSC": imsc(modes, CONTROLLED, ACTUATORS, weight=WEIGHT),
        "coupled LQR": coupled_lqr(modes, CONTROLLED, ACTUATORS, weight=WEIGHT / 2),
    }
    few = [Sensor(f"y{i + 1}", x) for i, x in enumerate((2.5, 5.0, 7.5))]
    more = [Sensor(f"y{i + 1}", x) for i, x in enumerate(LENGTH * np.arange(1, 7) / 7)]
    poles = (-0.3 + 1j) * modes.omega[:CONTROLLED]
    return {
        "IMSC, modal filter, 11 sensors": filtered(laws["IMSC"], displacement_filter(own, SENSORS, 1.0)),
        "coupled LQR, modal filter, 11 sensors": filtered(laws["coupled LQR"], displacement_filter(own, SENSORS, 1.0)),
        "coupled LQR, Luenberger, 3 sensors": luenberger_controller(modes, laws["coupled LQR"], few, poles=poles),
        "coupled LQR, Kalman, 6 sensors": kalman_controller(
            modes, laws["coupled LQR"], more, disturbance=1.0, noise=1e-2
        ),
    }


def robust(outcome):
    modes, found = identified()
    state = impulse_state(modes, 6.3)
    state[N_MODES + CONTROLLED :] = 0.0
    chosen = designs(modes)
    shares = {name: [] for name in chosen}
    spreads = {name: [] for name in chosen}
    for scale in outcome.track(SCALES, "draws"):
        possible = draw_modes(
            modes, DRAWS, seed=5, scale=scale, shape_covariance=found.shape_covariance, positions=SENSORS
        )
        for name, result in robustness(possible, chosen, state=state, final_time=FINAL_TIME).items():
            shares[name].append(result.share)
            spreads[name].append(result.spread())
    outcome.table("relative_omega_std", found.omega_std / found.modes.omega)
    outcome.table("scales", SCALES)
    outcome.table("shares", shares)
    outcome.table("W_R_5_50_95_percent", spreads)
    for name in chosen:
        low, middle, high = spreads[name][0]
        outcome.say(
            f"{name}: stable on {shares[name][0]:.0%} of {DRAWS} draws, W_R {middle:.3g} ({low:.3g} to {high:.3g});"
            f" with errors a hundred times larger {shares[name][-1]:.0%}"
        )
    outcome.check(
        "share of draws that stay stable with the errors identified, least of the designs through a filter",
        min(values[0] for name, values in shares.items() if "filter" in name),
        1.0,
        at_least=True,
    )
    outcome.figure(
        "draws",
        plot_robustness(SCALES, shares, spreads),
        "Share of perturbed models on which each design is stable.",
    )


def closed_loop_record(truth, law, through, seed):
    """Modal coordinates that the sensors' filter reads in the loop of all modes, after an impulse, noise 1 %."""
    time = 0.1 * np.arange(400)
    motion = initial_response(close_loop(truth, law, through), time, impulse_state(truth, 6.3)).displacement(SENSORS)
    noise = 0.01 * motion.std(axis=1, keepdims=True)
    readings = through(motion + noise * np.random.default_rng(seed).standard_normal(motion.shape))
    channels = [Channel(f"q{r + 1}") for r in range(CONTROLLED)]
    return Record(sample_time=0.1, outputs=readings, output_channels=channels, name="closed loop")


def drift(outcome):
    nominal = beam()
    law = imsc(nominal, CONTROLLED, ACTUATORS, weight=WEIGHT)
    through = displacement_filter(nominal.select(range(CONTROLLED)), SENSORS, 1.0)
    rows = []
    for seed, softer in enumerate(DRIFT):
        truth = beam(1.0 + softer)
        record = closed_loop_record(truth, law, through, seed)
        found = refine(record, stacked_delays(record, n_modes=CONTROLLED))
        structure = open_loop(nominal, law, found.modes.poles, found.amplitudes[0])
        model = updated(nominal, range(CONTROLLED), structure)
        state = impulse_state(truth, 6.3)
        best = distributed_cost(truth, CONTROLLED, state, WEIGHT)
        anew = imsc(model, CONTROLLED, ACTUATORS, weight=WEIGHT)
        rows.append(
            {
                "stiffness": 1.0 + softer,
                "omega": truth.omega[:CONTROLLED],
                "found": structure.omega,
                "cost_of_the_old_law": modal_cost(truth, law, state, WEIGHT) / best - 1.0,
                "cost_of_the_new_law": modal_cost(truth, anew, state, WEIGHT) / best - 1.0,
            }
        )
    missed = max(float(np.abs(row["found"] / row["omega"] - 1).max()) for row in rows)
    last = rows[-1]
    outcome.table("drift", rows)
    outcome.check("frequencies re-identified in the loop, noise 1 %, worst relative error", missed, 0.01)
    outcome.check(
        "stiffness up 10 %: excess cost of the redesigned law over the kept one's",
        last["cost_of_the_new_law"] / last["cost_of_the_old_law"],
        0.25,
    )
    outcome.say(
        f"in the loop, frequencies are found again within {missed:.1e} while the stiffness drifts by 10 %; the law kept"
        f" costs {last['cost_of_the_old_law']:.2e} more than the best, the law designed anew"
        f" {last['cost_of_the_new_law']:.2e}"
    )
    outcome.figure("drift", plot_drift(rows), "Frequencies found in the running loop while the stiffness drifts.")


def plot_robustness(scales, shares, spreads):
    """Share of perturbed models that stay stable, and median W_R with its 90 % interval, by the size of the errors."""
    figure, axes = new_figure(2, 1, width=9, height=7, sharex=True)
    for (name, values), colour, mark in zip(shares.items(), COLOURS, "osD^", strict=False):
        axes[0].semilogx(scales, values, mark + "-", color=colour, label=name)
        low, middle, high = np.array(spreads[name]).T
        axes[1].loglog(scales, middle, mark + "-", color=colour)
        axes[1].fill_between(scales, low, high, color=colour, alpha=0.15)
    axes[0].set(ylabel="share of perturbed models that stay stable", ylim=(-0.03, 1.05))
    axes[0].set_title("robustness to the errors of identification, and to larger ones")
    axes[0].legend(loc="lower left")
    axes[1].set(
        xlabel="errors, as multiples of the identified standard errors", ylabel="W_R [J], median and 90 % interval"
    )
    return figure


def plot_drift(rows):
    """Frequencies identified in the loop over the nominal, and excess cost of the old law, as the stiffness drifts."""
    figure, axes = new_figure(1, 2, width=11, height=4.3)
    drift = [100 * (row["stiffness"] - 1) for row in rows]
    first = np.array(rows[0]["omega"])
    for r in range(first.size):
        axes[0].plot(drift, [row["omega"][r] / first[r] for row in rows], color=GREY, label="true" if r == 0 else None)
        found = [row["found"][r] / first[r] for row in rows]
        axes[0].plot(drift, found, "osD"[r % 3], color=COLOURS[r], label=f"mode {r + 1}, identified in the loop")
    axes[0].set(xlabel="drift of the stiffness [%]", ylabel="frequency / nominal frequency [-]")
    axes[0].legend()
    for key, label, mark in (
        ("cost_of_the_old_law", "nominal law", "o-"),
        ("cost_of_the_new_law", "redesigned law", "s-"),
    ):
        axes[1].plot(drift, [1e6 * row[key] for row in rows], mark, label=label)
    axes[1].set(xlabel="drift of the stiffness [%]", ylabel="cost above the least, parts per million")
    axes[1].legend()
    return figure


def study(outcome, data=None):
    robust(outcome)
    drift(outcome)
