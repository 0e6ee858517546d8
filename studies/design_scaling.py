"""How does the time to design grow with the number of modes, one by one and all together?"""

from dataclasses import replace
from time import perf_counter, process_time

import control
import numpy as np
from scipy.optimize import differential_evolution

from workbench.design.estimation.modal_filter import displacement_filter
from workbench.design.laws.coupled import controlled_plant
from workbench.design.laws.imsc import riccati_gains
from workbench.design.laws.pole_assignment import assign
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import nodes_of_mode, place_actuators
from workbench.design.placement.task import batch_work, placement_task
from workbench.draw.style import COLOURS, new_figure
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes

LENGTH = 10.0
ACTUATORS = 5
PATIENCE = 20.0  # s for one design; the size that takes longer is where coupled LQR stops
SPACING = 0.3


def hinged(n):
    """Modes of the uniform hinged beam in closed form (5.47), as many as are asked for."""
    r = np.arange(1, n + 1)
    k = r * np.pi / LENGTH

    def shapes(x, derivative):
        turns = (np.sin, np.cos, lambda a: -np.sin(a), lambda a: -np.cos(a))
        return turns[derivative % 4](np.outer(x, k)) * k**derivative / np.sqrt(LENGTH / 2)

    return Modes(k**2, np.zeros(n), shapes, LENGTH, ((0.0, 0), (LENGTH, 0)))


def seconds(action, least=0.05):
    """Least time of one run out of several, so that a busy machine counts less."""
    best, spent = np.inf, 0.0
    while spent < least or np.isinf(best):
        start = perf_counter()
        action()
        took = perf_counter() - start
        best, spent = min(best, took), spent + took
    return best


def slope(sizes, times):
    """Of log time on log size, over the three largest, where overhead no longer counts."""
    return float(np.polyfit(np.log(sizes[-3:]), np.log(times[-3:]), 1)[0])


def design_times(outcome):
    modal = {n: seconds(lambda n=n: riccati_gains(hinged_omega(n), 20.0)) for n in (10**k for k in range(1, 7))}
    coupled, places, mine = {}, {}, {}
    for n in outcome.track([5 * 2**k for k in range(10)], "sizes"):
        modes = hinged(n)
        x = LENGTH * (0.5 + np.arange(ACTUATORS)) / (ACTUATORS + 0.37)
        a, b = controlled_plant(modes, range(n), [Actuator(f"F{i}", at) for i, at in enumerate(x)])
        q = np.diag(np.r_[modes.omega**2, np.ones(n)])
        poles = modes.omega * (-0.02 + 1j)
        coupled[n] = seconds(lambda a=a, b=b, q=q: control.lqr(a, b, q, 20 * np.eye(ACTUATORS)))
        names = [f"mode {r + 1}" for r in range(n)]
        mine[n] = seconds(lambda a=a, b=b, p=poles, names=names, n=n: assign(a, b, p, b[n:].T.astype(complex), names))
        if n <= 20:
            places[n] = seconds(lambda a=a, b=b, p=poles: quiet_place(a, b, np.r_[p, p.conj()]))
        if coupled[n] > PATIENCE:
            break
    return {"IMSC": modal, "coupled LQR": coupled, "coupled poles": mine, "coupled poles, control.place": places}


def hinged_omega(n):
    return (np.arange(1, n + 1) * np.pi / LENGTH) ** 2


def quiet_place(a, b, poles):
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return control.place(a, b, poles)


def plot_scaling(times, slopes):
    """Time to design against the number of modes, one line per method, each with its slope on the log-log scale."""
    figure, ax = new_figure(width=9, height=5)
    for (name, series), colour, mark in zip(times.items(), COLOURS, "osD^v", strict=False):
        label = f"{name}: slope {slopes[name]:.1f}"
        ax.loglog(list(series), list(series.values()), mark + "-", color=colour, label=label)
    ax.set(xlabel="number of modes", ylabel="time to design [s]", title="time to design: independent modes and coupled")
    ax.legend()
    return figure


def study(outcome, data=None):
    times = design_times(outcome)
    slopes = {name: slope(*map(np.array, zip(*series.items(), strict=True))) for name, series in times.items()}
    for name, value in slopes.items():
        outcome.say(f"{name}: time grows as the number of modes to the {value:.1f}")
    hundred_thousand = times["IMSC"][100_000]

    # placements: W_R and effort of many at once, on one core
    modes = hinged(64)
    task = placement_task(modes, 4, impulse_at=6.3, weight=20.0)
    grid = np.linspace(0.1, 9.9, 60)
    on_grid = task.shapes(grid)
    rng = np.random.default_rng(0)
    picks = np.sort(np.array([rng.choice(60, 4, replace=False) for _ in range(20_000)]), axis=1)
    rate = len(picks) / seconds(lambda: [batch_work(task, on_grid[p]) for p in np.array_split(picks, 20)], 1.0)

    # the closed loop of a thousand modes, four of them controlled
    thousand = hinged(1000)
    busy = process_time()
    loop_seconds = seconds(lambda: simulated(thousand, 100_000), 0.0)
    busy = process_time() - busy
    writing = seconds(lambda: np.empty((2000, 100_000)).fill(1.0), 0.0)

    # the same through the modal filters of sensors: every mode feeds every other, and nothing has a closed form
    start = perf_counter()
    simulated(replace(thousand, damping=np.full(1000, 0.005)), 100_000, sensors=LENGTH * np.arange(1, 12) / 12)
    dense_seconds = perf_counter() - start
    square = np.random.default_rng(0).standard_normal((2000, 2000))
    # x_{k+1} = Φ x_k of 2,000 states over 100,000 steps is 50 products of square matrices, whatever their order
    products = 50 * seconds(lambda: square @ square, 0.0)

    # eight actuators against a hundred residual modes
    many = hinged(108)
    task = placement_task(many, 8, impulse_at=6.3, weight=20.0)
    nodes = task.placed(nodes_of_mode(many, 8), "")
    start = perf_counter()
    best = place_actuators(task, Limits(effort=1.5 * nodes.effort, spacing=SPACING), starts=10)
    place_seconds = perf_counter() - start
    rivals = [evolved(task, 1.5 * nodes.effort, seed) for seed in outcome.track(range(4), "differential evolution")]

    shared = sorted(set(times["coupled LQR"]))
    one_by_one = {n: seconds(lambda n=n: riccati_gains(hinged_omega(n), 20.0)) for n in shared}
    outcome.table("seconds", times)
    outcome.table("slopes", slopes)
    outcome.table("coupled_lqr_over_imsc", {n: times["coupled LQR"][n] / one_by_one[n] for n in shared})
    outcome.table(
        "place_over_coupled_poles",
        {n: t / times["coupled poles"][n] for n, t in times["coupled poles, control.place"].items()},
    )
    outcome.table(
        "speeds",
        {
            "imsc_100000_modes_s": hundred_thousand,
            "placements_per_second": rate,
            "loop_1000_modes_100000_steps_s": loop_seconds,
            "the_same_in_processor_s": busy,
            "loop_over_writing_its_numbers": loop_seconds / writing,
            "loop_through_sensors_s": dense_seconds,
            "loop_through_sensors_over_its_products": dense_seconds / products,
            "place_8_against_100_s": place_seconds,
            "optima_met": len(best.local_optima),
            "W_R_over_that_by_differential_evolution": [best.residual_work / rival for rival in rivals],
        },
    )
    outcome.say(f"IMSC for 100,000 modes: {hundred_thousand:.2g} s")
    outcome.say(f"W_R of {rate:,.0f} placements a second (4 actuators, 60 residual modes, one core)")
    outcome.say(
        f"closed loop of 1,000 modes over 100,000 steps: {loop_seconds:.2g} s, {busy:.2g} s of processor time,"
        f" {loop_seconds / writing:.1f} times what it takes to fill the 1.6 GB of its numbers with ones"
    )
    outcome.say(
        f"the same through 11 sensors, which couple all modes: {dense_seconds:,.0f} s,"
        f" {dense_seconds / products:.1f} times the products of matrices alone that stepping 2,000 coupled states costs"
    )
    outcome.say(
        f"8 actuators against 100 residual modes from 12 starts: {place_seconds:.2g} s, W_R"
        f" {best.residual_work / nodes.residual_work:.2f} of the nodes'"
    )
    outcome.say(
        "the same by differential evolution, four seeds: W_R is"
        f" {', '.join(f'{rival / best.residual_work:.6f}' for rival in rivals)} of this"
    )
    largest = max(shared)
    outcome.say(
        f"coupled LQR stops at {largest} modes, where one design takes {times['coupled LQR'][largest]:.0f} s"
        f" (patience {PATIENCE:g} s); a hundred thousand would take"
        f" {times['coupled LQR'][largest] * (1e5 / largest) ** slopes['coupled LQR'] / 3.15e7:,.0f} years"
    )
    outcome.check(
        "placement of 8 actuators: W_R over the least that differential evolution finds",
        best.residual_work / min(rivals),
        1.0 + 1e-6,
    )
    outcome.check(
        "placement of 8 actuators: W_R over that of the nodes of mode 9", best.residual_work / nodes.residual_work, 1.0
    )
    outcome.figure("time", plot_scaling(times, slopes), "Time to design against the number of modes, log-log.")


def simulated(modes, steps, sensors=None):
    """The loop of all modes through four actuators, at even instants; the state as it is, or as sensors tell it."""
    law = placement_task(modes, 4, impulse_at=6.3, weight=20.0).law([2.0, 4.0, 6.0, 8.0])
    through = None if sensors is None else displacement_filter(modes.select(range(4)), sensors, 1.0)
    return initial_response(close_loop(modes, law, through), np.linspace(0.0, 1000.0, steps), impulse_state(modes, 6.3))


def evolved(task, effort_limit, seed):
    """W_R by a search that knows no derivative: differential evolution, a limit broken costs."""

    def cost(x):
        places = np.sort(x.T, axis=1)
        work, effort = batch_work(task, task.shapes(places))
        close = np.maximum(SPACING - np.diff(places, axis=1), 0.0).sum(axis=1) / SPACING
        with np.errstate(invalid="ignore"):
            value = np.log(work) + 10 * (np.maximum(effort / effort_limit - 1.0, 0.0) + close)
        return np.where(np.isfinite(value), value, 1e6)

    bounds = [(0.005 * LENGTH, 0.995 * LENGTH)] * task.n_controlled
    options = {"popsize": 12, "maxiter": 700, "tol": 1e-10, "polish": False}
    return float(
        np.exp(differential_evolution(cost, bounds, vectorized=True, updating="deferred", seed=seed, **options).fun)
    )
