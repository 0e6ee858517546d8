"""How long does a diagnosis take by the clock on two cores, and how do its simulations grow with modes and samples?"""

from dataclasses import replace
from time import perf_counter

import numpy as np

from workbench.draw.style import COLOURS, new_figure
from workbench.draw.trials import FAMILY
from workbench.gap.diagnose_case import diagnose_case
from workbench.gap.prediction.residuals import FitData
from workbench.rig.actuators import Actuator
from workbench.rig.elements import CubicSpring
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam
from workbench.trials.hold import COMMON_KINDS, draw_kinds
from workbench.trials.make import make_trial

SEED = 70000
FAMILIES = {"single": (1, 18, 10.0), "pair": (2, 9, 30.0)}  # effects that hide, cases, limit in s
WORKERS = 2
MODES, SAMPLES = (16, 32, 64, 128), (4000, 8000, 16000, 32000)
NOISE = 1e-4


def least(action, times: int = 7) -> float:
    """Seconds of the quickest of several runs, so that a busy machine counts less."""
    taken = []
    for _ in range(times):
        begun = perf_counter()
        action()
        taken.append(perf_counter() - begun)
    return min(taken)


def seconds_of(kinds, seed: int) -> float:
    """By the clock, for a case that hides these kinds, from the records in memory to the verdict."""
    case, _ = make_trial(seed, kinds=kinds)
    begun = perf_counter()
    diagnose_case(case, workers=WORKERS)
    return perf_counter() - begun


def simulations(n_modes: int, n_samples: int) -> dict[str, float]:
    """Seconds of one prediction of a record of a beam, alone and with a cubic spring."""
    loss = ModalDamping(0.01)
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged", damping=loss)
    sensors = [Sensor(f"y{i + 1}", 0.8 * (i + 1), noise_std=NOISE) for i in range(12)]
    rig = Rig(beam.modes(n_modes), [Actuator("F", 2.1)], sensors)
    command = np.random.default_rng(0).normal(size=(1, n_samples))
    whole = FitData((simulate(rig, command, sample_time=0.02),), np.full(12, NOISE))
    ahead = whole.one_step_ahead(rig)
    sprung = replace(rig, elements=(CubicSpring(3.3, 1.0),))
    return {
        f"{rig_name}, {data_name}": least(lambda rig=rig, data=data: replace(data).residual(rig))
        for rig_name, rig in (("linear", rig), ("with a cubic spring", sprung))
        for data_name, data in (("whole record", whole), ("one sample ahead", ahead))
    }


def growth(sizes, times: list[dict[str, float]]) -> dict[str, float]:
    """Exponent by which the time of each simulation grows with the size."""
    return {name: float(np.polyfit(np.log(sizes), np.log([each[name] for each in times]), 1)[0]) for name in times[0]}


def plot_times(seconds, limits):
    """How long each diagnosis took, a dot per case, and how long it may take, by family of cases."""
    figure, ax = new_figure(width=9, height=1.2 + 0.7 * len(seconds))
    for y, (family, times) in enumerate(seconds.items()):
        ax.plot(times, [y] * len(times), "o", color=COLOURS[0], alpha=0.6, label="a case" if y == 0 else None)
        ends, label = [y - 0.35, y + 0.35], "limit" if y == 0 else None
        ax.plot([limits[family]] * 2, ends, color=COLOURS[1], linewidth=2, label=label)
    ax.set_yticks(range(len(seconds)), [FAMILY[family].rstrip(":") for family in seconds])
    ax.set(xlim=(0, None), ylim=(len(seconds) - 0.5, -0.5), xlabel="wall-clock time on two cores [s]")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    return figure


def study(outcome, data=None) -> None:
    seconds_of(("cubic_spring",), SEED - 1)  # what is compiled once on a machine is not counted
    hidden = list(enumerate(draw_kinds(200, SEED)))
    taken: dict[str, list[float]] = {}
    over: dict[str, dict[str, float]] = {}
    for family, (n_effects, n_cases, limit) in FAMILIES.items():
        drawn = [
            (SEED + i, kinds) for i, kinds in hidden if len(kinds) == n_effects and set(kinds) <= set(COMMON_KINDS)
        ]
        chosen = outcome.track(drawn[:n_cases], f"{family} cases")
        taken[family] = sorted(seconds_of(kinds, seed) for seed, kinds in chosen)
        median, longest = float(np.median(taken[family])), taken[family][-1]
        over[family] = {"median": round(median / limit, 2), "longest": round(longest / limit, 2)}
        outcome.say(
            f"{family}, {n_cases} cases: {median:.1f} s in the median, {longest:.1f} s at most; limit {limit:g} s"
        )
    outcome.table("seconds", {family: [round(t, 1) for t in times] for family, times in taken.items()})
    outcome.table("over_the_limit", over)

    by_modes = growth(MODES, [simulations(n, SAMPLES[0]) for n in MODES])
    by_samples = growth(SAMPLES, [simulations(MODES[0], n) for n in SAMPLES])
    outcome.table("exponents_of_growth", {"modes": by_modes, "samples": by_samples})
    outcome.say(f"a simulation grows as the number of modes to the {max(by_modes.values()):.2f} at most")
    outcome.say(f"and as the number of samples to the {max(by_samples.values()):.2f}")
    limits = {family: limit for family, (*_, limit) in FAMILIES.items()}
    outcome.figure("times", plot_times(taken, limits), "Time of a diagnosis on two cores, each case a dot.")
