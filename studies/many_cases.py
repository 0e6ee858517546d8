"""Does running many cases cost more than a plain loop, and do two cores halve it?

The cases are real: how much a beam's control spills for every weight and place of the actuators. Their speed is
measured on cases of 50 ms, cold each time, as ratios to a plain loop over the same function in the same minute.
"""

import time
from tempfile import TemporaryDirectory

import numpy as np
from joblib import Parallel, delayed

from workbench import study as many
from workbench.design.closed_loop import impulse_state
from workbench.design.imsc import imsc
from workbench.design.spillover import effort, spillover
from workbench.draw.many import plot_cases
from workbench.rig.actuators import Actuator
from workbench.structure.member import Beam

N_TIMED, PAUSE, ROUNDS = 100, 0.05, 3
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
    return {"W_R": spillover(modes, law, state).residual_total, "effort": effort(modes, law, state)}


def busy(number):
    """50 ms of one core: a fixed amount of time worked, however fast the core."""
    until = time.process_time() + PAUSE
    while time.process_time() < until:
        number = (number * 48271) % 2147483647
    return number


def timed() -> list[float]:
    """Times as shares of a plain loop's: one process, two, two bare loops side by side, and a second run."""
    cases = many.grid(number=range(1, N_TIMED + 1))
    with TemporaryDirectory() as folder:
        loop = seconds(lambda: [busy(**case) for case in cases])
        one = seconds(lambda: many.run(cases, busy, cache=f"{folder}/one", workers=1))
        two = seconds(lambda: many.run(cases, busy, cache=f"{folder}/two", workers=2))
        kept = seconds(lambda: many.run(cases, busy, cache=f"{folder}/two", workers=2))
    bare = seconds(lambda: Parallel(2)(delayed(half)(cases[i::2]) for i in (0, 1)))
    return [one / loop, two / loop, bare / loop, kept / loop]


def half(cases):
    return [busy(**case) for case in cases]


def seconds(call) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def study(outcome, data=None):
    cases = many.grid(weight=WEIGHTS, shift=SHIFTS)
    found = outcome.run(cases, spilled)
    again = outcome.run(cases, spilled, workers=1)
    plain = [spilled(**case) for case in cases]
    apart = max(abs(r[name] - p[name]) for r in (found, again) for r, p in zip(r, plain) for name in p)
    outcome.check("run, run again and a plain loop: largest difference of any result", apart, 0.0)
    outcome.check("cases that failed", len(found.failed), 0)

    shares = np.median([timed() for _ in outcome.track(range(ROUNDS), "rounds of timing")], axis=0)
    names = (
        "one process, every result kept",
        "two processes, every result kept",
        "two bare loops side by side",
        "again",
    )
    outcome.table("speed", [{"what": n, "share of a plain loop's time": round(s, 4)} for n, s in zip(names, shares)])
    one, two, bare, kept = shares
    outcome.say(
        f"{N_TIMED} cases of {1000 * PAUSE:g} ms: {100 * (one - 1):.1f} % over a plain loop, every result kept."
    )
    outcome.say(f"Two processes: {1 / two:.2f} times as fast; two bare loops side by side: {1 / bare:.2f} times.")
    outcome.say(f"A second run finds all that was kept in {100 * kept:.2g} % of the time.")
    outcome.figure(
        "spillover",
        plot_cases(found.rows(), x="shift", y="W_R", by="weight"),
        "Work spilled by every weight and shift of the two inner actuators of four on a hinged beam.",
    )
