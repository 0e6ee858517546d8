"""What does independent modal-space control give away against coupled LQR, and what does it save?"""

import warnings
from dataclasses import asdict
from time import perf_counter

import control
import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import displacement_filter
from workbench.design.estimation.observers import kalman_controller, luenberger_controller
from workbench.design.laws.coupled import controlled_plant, coupled_lqr, coupled_poles
from workbench.design.laws.imsc import imsc, imsc_poles, riccati_gains, riccati_matrices
from workbench.design.laws.on_off import on_off
from workbench.design.loop.closed_loop import close_loop, close_with, impulse_state
from workbench.design.loop.on_off_response import respond_on_off
from workbench.design.spillover.performance import on_off_performance, performance
from workbench.design.spillover.robustness import perturbed_modes, stable_share
from workbench.design.spillover.spillover import (
    distributed_cost,
    effort,
    modal_cost,
    on_off_work,
    quadratic_cost,
    spillover,
)
from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam

MODAL_WEIGHT = 20.0
# at the nodes of mode 5, B Bᵀ = ½ I, so R f² on modal forces is R/2 F² on actuator forces: one and the same problem
FORCE_WEIGHT = 10.0
RELAY = {"force": 0.05, "dead_band": 0.01, "slope": 0.3}
LENGTH = 10.0
SENSORS = LENGTH * np.arange(1, 10) / 10
DAMPED, FINAL_TIME = 0.2, 200.0
# of frequencies, damping and shapes, to which every design is put
ERRORS, DRAWS = 0.05, 60
FIGURES = {
    "cost": "quadratic cost",
    "effort": "effort [N² s]",
    "spillover": "spillover W_R [J]",
    "stable_share": f"share of models stable,\nperturbed by {ERRORS:.0%}\n(more is better)",
    "design_time": "time to design / that of\nIMSC, Riccati on\nexact coordinates",
}


def riccati_errors() -> tuple[float, float]:
    """Largest relative Riccati residual over five decades of R and of frequency; gains against control.lqr."""
    residual = gains = 0.0
    for omega in np.geomspace(1e-2, 1e3, 11):
        for weight in np.geomspace(1e-3, 1e2, 11):
            p = riccati_matrices(np.array([omega]), weight)[0]
            a, b, q = np.array([[0, 1], [-(omega**2), 0]]), np.array([[0.0], [1.0]]), np.diag([omega**2, 1.0])
            terms = (a.T @ p, p @ a, -p @ b @ b.T @ p / weight, q)
            size = np.max([np.abs(t) for t in terms], axis=0)
            residual = max(residual, float((np.abs(sum(terms)) / np.maximum(size, 1e-300))[size > 0].max()))
            peer = control.lqr(a, b, q, [[weight]])[0][0]
            mine = np.ravel(riccati_gains(omega, weight))
            gains = max(gains, float((np.abs(mine - peer) / np.abs(peer).max()).max()))
    return residual, gains


def pole_gains(beam, outcome):
    """The same poles by the Sylvester equation and by control.place: gains, poles missed."""
    rows = []
    for n, places in ((4, (1.3, 2.6)), (10, (1.3, 4.1, 7.7)), (20, (0.9, 2.3, 4.1, 6.2, 8.7))):
        modes = beam.modes(n)
        actuators = [Actuator(f"F{i + 1}", x) for i, x in enumerate(places)]
        a, b = controlled_plant(modes, range(n), actuators)
        wanted = modes.omega * (-0.1 + 1j * np.sqrt(1 - 0.1**2))
        both = np.r_[wanted, wanted.conj()]

        def missed(gain, a=a, b=b, both=both):
            poles = np.linalg.eigvals(a - b @ gain)
            return max(np.abs(poles - p).min() / abs(p) for p in both)

        mine = coupled_poles(modes, n, actuators, poles=wanted).gain
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # place_poles often stops short of its own tolerance
            peer = np.asarray(control.place(a, b, both))
            rows.append(
                {
                    "modes": n,
                    "actuators": len(places),
                    "gain_norm": np.linalg.norm(mine),
                    "place_gain_norm": np.linalg.norm(peer),
                    "poles_missed": missed(mine),
                    "place_poles_missed": missed(peer),
                }
            )
        outcome.say(
            f"{n} modes, {len(places)} actuators, 10 % damping: |K| = {rows[-1]['gain_norm']:.4g} against"
            f" {rows[-1]['place_gain_norm']:.4g} of control.place"
        )
    return rows


def designed(make):
    """A design, and the least time of several that it takes to make, s."""
    least = np.inf
    for _ in range(5):
        start = perf_counter()
        design = make()
        least = min(least, perf_counter() - start)
    return design, least


def every_design(places):
    """Each law on each way to know the state, on a lightly damped beam with residual modes: one row per design."""
    modes = Beam(
        length=LENGTH, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged",
        damping=ModalDamping(0.005),
    ).modes(9)  # fmt: skip
    own = modes.select(range(4))
    state = impulse_state(modes, 6.3)
    state[9 + 4 :] = 0.0
    actuators = [Actuator(f"F{i + 1}", x) for i, x in enumerate(places)]
    readings = [Sensor(f"y{i + 1}", x) for i, x in enumerate(SENSORS)]
    wanted = own.omega * (-DAMPED + 1j * np.sqrt(1 - DAMPED**2))
    ways = {
        "exact coordinates": lambda law: law,
        "modal filter": lambda law: filtered(law, displacement_filter(own, SENSORS, 1.0)),
        "Luenberger": lambda law: luenberger_controller(modes, law, readings, poles=(-0.3 + 1j) * own.omega),
        "Kalman": lambda law: kalman_controller(modes, law, readings, disturbance=1.0, noise=1e-2),
    }
    laws = {
        "IMSC, Riccati": lambda: imsc(modes, 4, actuators, weight=MODAL_WEIGHT),
        "IMSC, poles": lambda: imsc_poles(modes, 4, actuators, poles=wanted),
        "coupled LQR": lambda: coupled_lqr(modes, 4, actuators, weight=FORCE_WEIGHT),
        "coupled poles": lambda: coupled_poles(modes, 4, actuators, poles=wanted),
    }
    possible = perturbed_modes(modes, ERRORS, count=DRAWS)
    rows = []
    for law_name, make in laws.items():
        law, law_seconds = designed(make)
        for way_name, way in ways.items():
            design, seconds = designed(lambda way=way, law=law: way(law))
            measures = performance(close_with(modes, design), state, weight=FORCE_WEIGHT, final_time=FINAL_TIME)
            rows.append(
                {
                    "law": law_name,
                    "state": way_name,
                    **asdict(measures),
                    "stable_share": stable_share(possible, design),
                    "seconds": law_seconds + (0.0 if design is law else seconds),
                }
            )
    relay, seconds = designed(lambda: on_off(modes, 4, actuators, **RELAY))
    measures = on_off_performance(modes, relay, state, weight=FORCE_WEIGHT, final_time=FINAL_TIME)
    rows.append(
        {
            "law": "IMSC, on-off", "state": "exact coordinates", **asdict(measures), "decay_rate": None,
            "stable_share": None, "seconds": seconds,
        }
    )  # fmt: skip
    first = rows[0]["seconds"]
    return [{**row, "design_time": row.pop("seconds") / first} for row in rows]


def plot_comparison(rows, title):
    """Cost, effort and spillover of several designs as ratios to the first, on a logarithmic scale."""
    figure, ax = new_figure(1, 1, width=9, height=4)
    keys = ("cost", "effort", "W_R")
    width = 0.8 / len(rows)
    ratios = np.array([[row[key] / rows[0][key] for key in keys] for row in rows])
    least = 10.0 ** np.floor(np.log10(ratios.min()) - 0.3)
    for i, row in enumerate(rows):
        at = np.arange(len(keys)) + (i - 0.5 * (len(rows) - 1)) * width
        # bars stand on the bottom of the picture: on a logarithmic scale there is no zero to stand on
        bars = ax.bar(at, ratios[i] - least, width, bottom=least, label=row["law"])
        ax.bar_label(bars, [f"{ratio:.3g}" for ratio in ratios[i]], padding=2)
    ax.set(yscale="log", ylim=(least, 4.0 * ratios.max()), ylabel=f"ratio to {rows[0]['law']} (less is better)")
    ax.set_xticks(np.arange(len(keys)), ["quadratic cost", "actuator effort", "spillover W_R"])
    ax.axhline(1.0, color=GREY, linewidth=0.8)
    ax.set_title(title)
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def plot_designs(rows, figures, title):
    """Designs in rows, one panel a figure of merit, one mark an estimator; infinite values are at the edge.

    Args:
        rows: dicts with "law", "state" and every figure.
        figures: heading of each by its key; a key that ends in "share" is drawn from 0 to 1, the others on a log scale.
    """
    laws, states = (list(dict.fromkeys(row[key] for row in rows)) for key in ("law", "state"))
    figure, axes = new_figure(1, len(figures), width=12, height=1.4 + 0.75 * len(laws), sharey=True)
    for ax, (key, heading) in zip(axes, figures.items(), strict=True):
        most = max(row[key] for row in rows if row[key] is not None and np.isfinite(row[key]))
        for i, state in enumerate(states):
            own = [row for row in rows if row["state"] == state and row[key] is not None]
            at = np.array([laws.index(row["law"]) + 0.16 * (i - 0.5 * (len(states) - 1)) for row in own])
            values = np.array([row[key] for row in own], float)
            endless = np.isinf(values)
            values[endless] = 6.0 * most
            ax.plot(values, at, "o^sv"[i % 4], color=COLOURS[i], markersize=7, label=state)
            for x, y in zip(values[endless], at[endless]):
                ax.annotate("unstable  ", (x, y), ha="right", va="center", fontsize=8, color=COLOURS[i])
        if key.endswith("share"):
            ax.set(xlim=(-0.05, 1.05))
        else:
            ax.set(xscale="log")
            if np.ptp(np.log10(ax.get_xlim())) < 2.0:  # too few decades to number these alone
                ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
                ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            ax.xaxis.set_minor_formatter(NullFormatter())
        for law in set(laws) - {row["law"] for row in rows if row[key] is not None}:
            ax.text(
                0.5,
                laws.index(law),
                "not applicable",
                transform=ax.get_yaxis_transform(),
                ha="center",
                va="center",
                fontsize=8,
            )
        ax.set_xlabel(heading)
        for y in np.arange(len(laws) - 1) + 0.5:
            ax.axhline(y, color=GREY, linewidth=0.6)
    axes[0].set_yticks(range(len(laws)), laws)
    axes[0].set_ylim(len(laws) - 0.5, -0.5)
    axes[0].grid(axis="y", visible=False)
    figure.suptitle(title, x=0.01, ha="left", fontsize=12)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(states))
    return figure


def plot_switching(law, switched):
    """The first controlled mode under on-off control: its path in the phase plane, and the force over time."""
    relay, segments = law.relays[0], switched.segments[0]
    response, r = switched.response, law.controlled[0]
    q, v = response.modal[r], response.modal[response.modes.n_modes + r]
    figure, axes = new_figure(1, 2, width=11, height=4.5)
    axes[0].plot(q, v, color=COLOURS[0], linewidth=1.0, label="motion")
    for segment in segments:
        if segment.sliding:
            inside = (response.time >= segment.start) & (response.time <= segment.end)
            axes[0].plot(q[inside], v[inside], color=COLOURS[1], linewidth=3.5, label="sliding mode")
    reach = np.array([q.min(), q.max()])
    edges = [edge - relay.slope * reach for edge in (-relay.dead_band, relay.dead_band)]
    axes[0].fill_between(reach, *edges, color=GREY, alpha=0.25, label="dead band: no force")
    switches = np.array([(s.displacement, s.rate) for s in segments[1:]]).reshape(-1, 2)
    axes[0].plot(*switches.T, ".", color=COLOURS[6], markersize=5, label="switches")
    handles, labels = axes[0].get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    axes[0].legend(once.values(), once.keys(), loc="lower left")
    axes[0].set(xlabel=f"q{r + 1} [m √kg]", ylabel=f"dq{r + 1}/dt [m √kg/s]", title=f"mode {r + 1} in the phase plane")
    pushes = np.zeros(response.time.size)
    for s in segments:
        tau = response.time - s.start
        inside = (tau >= 0) & (response.time <= s.end)
        pushes[inside] = s.steady + s.ramp * tau[inside] + s.fading * np.exp(-relay.slope * tau[inside])
    axes[1].plot(response.time, pushes, color=COLOURS[0])
    axes[1].set(xlabel="time [s]", ylabel="modal force [N/√kg]", title="modal force (its mean in the sliding mode)")
    return figure


def study(outcome, data=None):
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
    modes = beam.modes(9)
    state = impulse_state(modes, 6.3)
    state[9 + 4 :] = 0.0
    unattainable = distributed_cost(modes, 4, state, MODAL_WEIGHT)

    def compared(places):
        actuators = [Actuator(f"F{i + 1}", x) for i, x in enumerate(places)]
        independent = imsc(modes, 4, actuators, weight=MODAL_WEIGHT)
        poles = close_loop(modes.select(range(4)), independent).poles
        poles = np.sort_complex(poles[poles.imag > 0])
        poles = poles[np.argsort(poles.imag)]
        laws = {
            "IMSC": independent,
            "coupled LQR": coupled_lqr(modes, 4, actuators, weight=FORCE_WEIGHT),
            "coupled, IMSC's poles, two actuators fewer": coupled_poles(modes, 4, actuators[1:3], poles=poles),
        }
        rows = [
            {
                "law": label,
                "cost": quadratic_cost(modes, law, state, FORCE_WEIGHT),
                "modal_cost": modal_cost(modes, law, state, MODAL_WEIGHT),
                "effort": effort(modes, law, state),
                "W_R": spillover(modes, law, state).residual_work,
            }
            for label, law in laws.items()
        ]
        relay = on_off(modes, 4, actuators, **RELAY)
        time = np.linspace(0.0, 120.0, 24001)
        forces = respond_on_off(modes, relay, state, time).response.forces
        rows.append(
            {
                "law": "IMSC on-off",
                "effort": np.trapezoid((forces**2).sum(axis=0), time),
                "W_R": on_off_work(modes, relay, state, 120.0).residual_work,
            }
        )
        a, b = controlled_plant(modes, range(4), actuators)
        p, _, _ = control.care(a, b, np.diag([*modes.omega[:4] ** 2, 1, 1, 1, 1]), FORCE_WEIGHT * np.eye(4))
        start = np.r_[state[:4], state[9:13]]
        return rows, float(start @ p @ start)

    (rows, least), (close, close_least) = compared((2.0, 4.0, 6.0, 8.0)), compared((1.3, 2.6, 3.9, 5.2))
    gains_by_poles = pole_gains(beam, outcome)
    outcome.table("nodes_of_mode_5", rows)
    outcome.table("close", close)
    outcome.table("distributed", {"modal_cost": unattainable, "W_R": 0.0})
    outcome.table("poles", gains_by_poles)

    spread, near = every_design((1.5, 3.5, 6.5, 8.5)), every_design((1.3, 2.6, 3.9, 5.2))
    for name, found, where in (("designs", near, "closely spaced"), ("designs_spread", spread, "spread")):
        outcome.table(name, found)
        title = f"control of four beam modes after an impulse, {where} actuators (less is better, unless said)"
        caption = f"Every law on every way to know the state, {where} actuators, nine sensors."
        outcome.figure(name, plot_designs(found, FIGURES, title), caption)

    def of(rows, law, state="exact coordinates"):
        [row] = [row for row in rows if (row["law"], row["state"]) == (law, state)]
        return row

    outcome.check(
        "closely spaced: decay rate of IMSC through the modal filter, 1/s",
        of(near, "IMSC, Riccati", "modal filter")["decay_rate"],
        0.0,
    )
    outcome.check(
        "spread: minimum decay rate of the sixteen designs, 1/s",
        min(r["decay_rate"] for r in spread[:-1]),
        0.0,
        at_least=True,
    )
    outcome.check(
        "coupled LQR costs least of all laws on exact coordinates, over the next, both places",
        max(
            of(rows, "coupled LQR")["cost"] / min(r["cost"] for r in rows if r["law"] != "coupled LQR")
            for rows in (near, spread)
        ),
        1.0,
    )
    least_sure = min(near[:-1], key=lambda row: row["stable_share"] if row["decay_rate"] > 0 else 1.0)
    outcome.say(
        f"close together: through nine sensors' modal filter IMSC is unstable; {least_sure['law']} on"
        f" {least_sure['state']} is stable on the model and on {least_sure['stable_share']:.0%} of those"
        f" {ERRORS:.0%} wrong, coupled LQR on"
        f" {min(r['stable_share'] for r in near if r['law'] == 'coupled LQR'):.0%} at the least"
    )
    residual, gains = riccati_errors()
    outcome.check("Riccati residual of the closed form over five decades, relative", residual, 1e-12)
    outcome.check("gains against control.lqr mode by mode, relative", gains, 1e-8)
    outcome.check(
        "nodes of mode 5: cost of coupled LQR against IMSC, relative difference",
        abs(rows[1]["cost"] / rows[0]["cost"] - 1.0),
        1e-9,
    )
    outcome.check(
        "cost of coupled LQR against x0ᵀ P x0 of control.care, relative, both places",
        max(abs(rows[1]["cost"] / least - 1.0), abs(close[1]["cost"] / close_least - 1.0)),
        1e-9,
    )
    outcome.check(
        "IMSC, modal forces weighted, against distributed control wherever the actuators stand, relative",
        max(abs(r[0]["modal_cost"] / unattainable - 1.0) for r in (rows, close)),
        1e-9,
    )
    outcome.check(
        "coupled LQR, modal forces weighted, over distributed control, actuators close together",
        close[1]["modal_cost"] / unattainable,
        1.0,
        at_least=True,
    )
    outcome.check(
        "actuators close together: cost of IMSC over coupled LQR",
        close[0]["cost"] / close[1]["cost"],
        90.0,
        at_least=True,
    )
    outcome.check("poles by Sylvester's equation, relative", max(r["poles_missed"] for r in gains_by_poles), 1e-9)
    outcome.check(
        "its gain norm over that of control.place",
        max(r["gain_norm"] / r["place_gain_norm"] for r in gains_by_poles),
        1.0,
    )
    outcome.say("actuators at the nodes of mode 5: IMSC and coupled LQR are the same law")
    outcome.say(
        f"actuators close together: coupled LQR costs {close[1]['cost'] / close[0]['cost']:.3f} of IMSC, with"
        f" {close[1]['effort'] / close[0]['effort']:.3f} of its effort and"
        f" {close[1]['W_R'] / close[0]['W_R']:.3f} of its spillover"
    )
    outcome.say(
        "with modal forces weighted IMSC costs what distributed control does, wherever its actuators stand; what the"
        " places decide is the effort and the spillover"
    )
    outcome.figure(
        "comparison",
        plot_comparison(close[:2], "the same modes with the same actuators, close together: at 1.3, 2.6, 3.9, 5.2 m"),
        "Actuators close together: coupled LQR beside IMSC.",
    )
    relay = on_off(modes, 4, [Actuator(f"F{i + 1}", x) for i, x in enumerate((2.0, 4.0, 6.0, 8.0))], **RELAY)
    coarse, fine = (respond_on_off(modes, relay, state, np.linspace(0.0, 120.0, n)) for n in (481, 15361))
    outcome.check(
        "on-off: motion at the same instants when these lie 32 times closer, largest difference",
        np.abs(coarse.response.modal - fine.response.modal[:, ::32]).max(),
        1e-10,
    )
    outcome.figure(
        "on_off", plot_switching(relay, fine), "On-off control of mode 1: switched, sliding, and left in its dead band."
    )
