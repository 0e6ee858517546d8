"""Does running many cases cost more than a plain loop, and do two cores halve it?

The cases are real: the spillover work on a beam for every weight and position of the actuators. Their speed is
measured on cases of 50 ms, cold each time, as ratios to a plain loop over the same function in the same minute.
"""

import time
from tempfile import TemporaryDirectory

import numpy as np
from joblib import Parallel, delayed
from matplotlib import colormaps

from workbench import study as many
from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import impulse_state
from workbench.design.spillover.spillover import effort, spillover
from workbench.draw.style import new_figure
from workbench.rig.actuators import Actuator
from workbench.structure.member import Beam
from workbench.study.runs.engines import packed, unpacked

N_TIMED, PAUSE, ROUNDS = 200, 0.05, 3
WEIGHTS = np.geomspace(1.0, 100.0, 9)
SHIFTS = np.linspace(-0.9, 0.9, 19)


def spilled(weight, shift):
    """Four actuators at 2, 4, 6, 8 of ten, the inner two moved by `shift` towards the right."""
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
    modes = beam.modes(9)
    places = (2.0, 4.0 + shift, 6.0 + shift, 8.0)
    law = imsc(modes, 4, [Actuator(f"F{i + 1}", x) for i, x in enumerate(places)], weight=weight)
    state = impulse_state(modes, 6.3)
    state[9 + 4 :] = 0.0
    return {"W_R": spillover(modes, law, state).residual_work, "effort": effort(modes, law, state)}


def busy(number):
    """50 ms of one core, however fast the core."""
    until = time.thread_time() + PAUSE  # of this thread: what shows progress beside it is no work of the case
    while time.thread_time() < until:
        number = (number * 48271) % 2147483647
    return number


def waiting(number):
    """50 ms that need no core: what is lost then is lost by the runner, whoever else works on the machine."""
    time.sleep(PAUSE)
    return number


def timed(function) -> list[float]:
    """Shares of a plain loop's time, before and after: one process, two, two bare loops side by side, a second run."""
    cases = many.grid(number=range(1, N_TIMED + 1))
    before = seconds(lambda: [function(**case) for case in cases])
    with TemporaryDirectory() as folder:
        one = seconds(lambda: many.run(cases, function, cache=f"{folder}/one", workers=1))
        two = seconds(lambda: many.run(cases, function, cache=f"{folder}/two", workers=2))
        kept = seconds(lambda: many.run(cases, function, cache=f"{folder}/two", workers=2))
    halves = packed(function)
    bare = seconds(lambda: Parallel(2)(delayed(half)(halves, cases[i::2]) for i in (0, 1)))
    loop = 0.5 * (before + seconds(lambda: [function(**case) for case in cases]))
    return [one / loop, two / loop, bare / loop, kept / loop]


def half(function, cases):
    return [unpacked(function)(**case) for case in cases]


def seconds(call) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def plot_cases(rows, *, x, y, by):
    """One quantity over another, a line for each value of a third; y is logarithmic where all of it is positive."""
    values = sorted({row[by] for row in rows})
    figure, ax = new_figure(width=9, height=4.5)
    for value, colour in zip(values, colormaps["viridis"](np.linspace(0.0, 0.9, len(values)))):
        line = sorted((row[x], row[y]) for row in rows if row[by] == value and row[y] is not None)
        ax.plot(*np.array(line).T, color=colour, label=f"{by} {value:.3g}")
    scale = "log" if all(row[y] is None or row[y] > 0 for row in rows) else "linear"
    ax.set(xlabel=x, ylabel=y, yscale=scale)
    ax.legend(ncols=1, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def study(outcome, data=None):
    cases = many.grid(weight=WEIGHTS, shift=SHIFTS)
    found = outcome.run(cases, spilled)
    again = outcome.run(cases, spilled, "again", workers=1)
    plain = [spilled(**case) for case in cases]
    apart = max(abs(r[name] - p[name]) for r in (found, again) for r, p in zip(r, plain) for name in p)
    outcome.check("run, run again and a plain loop: largest difference of any result", apart, 0.0)
    outcome.check("cases that failed", len(found.failed), 0)

    names = (
        "one process, every result kept",
        "two processes, every result kept",
        "two bare loops side by side",
        "again",
    )
    rows = [{"what": name} for name in names]
    for what, function in (("work", busy), ("wait", waiting)):
        rounds = outcome.track(range(ROUNDS), f"rounds of timing, cases that {what}")
        one, two, bare, kept = shares = np.median([timed(function) for _ in rounds], axis=0)
        for row, share in zip(rows, shares):
            row[f"share of a plain loop's time, cases that {what}"] = round(share, 4)
        outcome.say(
            f"{N_TIMED} cases that {what} {1000 * PAUSE:g} ms: {100 * (one - 1):.1f} % over a plain loop, all results"
            f" kept; two processes {1 / two:.2f} times as fast, two bare loops side by side {1 / bare:.2f} times;"
            f" a second run takes {100 * kept:.2g} %."
        )
    outcome.table("speed", rows)
    drawn = plot_cases(found.rows(), x="shift", y="W_R", by="weight")
    drawn.axes[0].set(xlabel="shift of the two inner actuators [m]", ylabel="spillover work W_R [J]")
    outcome.figure(
        "spillover",
        drawn,
        "Work spilled by every weight and shift of the two inner actuators of four on a hinged beam.",
    )
