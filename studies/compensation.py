"""How much of what late, sticking or limited actuators cost does a redesigned controller recover on hidden plants?

Performance is the settling time of the controlled modes after an impulse: until their energy stays below a hundredth of
its peak. What an effect costs is that time under the present controller with the effect, over that without; a loop that
does not settle takes the whole test. How soon any controller could settle a limited plant is the optimum of a convex
program, for no more effort and no more vibration of residual modes than without the limit.
"""

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
from matplotlib.lines import Line2D
from scipy.linalg import block_diag, expm

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect
from workbench.robust.impulse import impulse_test
from workbench.robust.plain_law import plain_law
from workbench.robust.posterior import UncertainRig
from workbench.robust.redesign import redesign
from workbench.robust.verification import SETTLED
from workbench.trials.controlled import control_plant
from workbench.trials.make import find_trial_with_plant

PLANTS, SEED = 30, 20305
IMPERFECTIONS = ("clean", "offset")
LAWS = ("imsc", "coupled")
CONTROLLED, DAMPING = 2, 0.35
LATE, STICKS, LIMIT = 1.5, 0.3, 0.5  # samples; of the rms of the low level; of the peak force without a limit
EFFECTS = {
    "delay": ("actuator_delay", "delay", "delay"),
    "dead zone": ("actuator_dead_zone", "width", "dead_zone"),
    "saturation": ("actuator_saturation", "limit", "limit"),
}  # its kind, its parameter, and what it is of an actuator
LOST = 0.02  # of the settling time: a plant that loses less has nothing to win back
HALF, DEARER = 0.5, 1.05  # of what is lost; times the effort without the effect
NEARLY_ALL = 0.9  # of the plants


def plant(index, seed):
    """One hidden plant without any effect, and with each in turn under the present and the redesigned controller."""
    rng = np.random.default_rng([seed, index])
    case, _, real = find_trial_with_plant(
        rng, imperfections=IMPERFECTIONS[index // len(LAWS) % len(IMPERFECTIONS)], size=0.5
    )
    rig = case.rig
    level = np.max([np.abs(r.outputs).max(axis=1) for r in case.fit], axis=0)
    test = impulse_test(rig, range(CONTROLLED), case.fit[0].sample_time, level=level, seed=index)
    at = {"impulse_at": test.impulse_at, "impulse": test.impulse}
    law = plain_law(LAWS[index % len(LAWS)], rig, CONTROLLED, damping=DAMPING, **at)
    impulse_input = next(a for a in rig.actuators if a.direct or a.at == test.impulse_at).name

    def controlled(hidden, controller):
        noise = np.random.default_rng([seed, index, 7])
        given = {"n_samples": test.n_samples, "impulse_input": impulse_input, "impulse": test.impulse}
        return control_plant(hidden, controller, **given, rng=noise)

    def designed(*effects):
        uncertain = UncertainRig(rig, effects, np.zeros((len(effects),) * 2))
        return redesign(uncertain, law, test=test, draws=1, placement=False, max_cost_increase=np.inf)

    nominal = designed()
    free = controlled(real, nominal.present)
    told = {"test": float(test.time[-1]), "without": _figures(free)}
    for name, size in _sizes(case, free.peak_force).items():
        kind, parameter, _ = EFFECTS[name]
        found = designed(Effect(kind_named(kind), "all", {parameter: size}))
        hidden = _with_effect(real, name, size)
        told[name] = {
            "present": _figures(controlled(hidden, found.present)),
            "redesigned": _figures(controlled(hidden, found.redesigned)),
            "improves": found.improves,
            "steps": [s.name for s in found.steps if s.kept],
        }
    told["saturation"]["minimum"] = _minimum_settling(real, nominal.present, impulse_input, test, free)
    return told


def _sizes(case, peak):
    low = next(r for r in case.fit if r.name == "low")
    commanded = [i for i, a in enumerate(case.rig.actuators) if not a.direct]
    rms = float(np.sqrt((low.inputs[commanded] ** 2).mean()))
    return {"delay": LATE * low.sample_time, "dead zone": STICKS * rms, "saturation": LIMIT * peak}


def _minimum_settling(real, controller, impulse_input, test, free):
    """The least settling time of the controlled modes by any forces within the limit, s; see the top."""
    if free.settling(CONTROLLED) is None:
        return None
    first, last = 1, round(2.0 * free.settling(CONTROLLED) / test.sample_time)
    while last > first:
        middle = (first + last) // 2
        left = _least_energy(real, controller, impulse_input, test, free, middle)
        first, last = (first, middle) if left <= SETTLED else (middle + 1, last)
    return last * test.sample_time


def _least_energy(real, controller, impulse_input, test, free, n_samples):
    """The least energy of the controlled modes that any forces leave after some samples, over that of the impulse."""
    omega2, damping = real.system.omega2, real.system.damping
    omega, n = np.sqrt(omega2), omega2.size
    actuators = [a.name for a in real.plant.actuators]
    driven = [actuators.index(name) for name in controller.actuators]
    blocks = []  # of each mode: (ω q, q') over a sample, and the share of a modal force that is held over it
    for w, d in zip(omega, damping, strict=True):
        blocks.append(expm(test.sample_time * np.array([[0.0, w, 0.0], [-w, -d, 1.0], [0.0, 0.0, 0.0]])))
    step = block_diag(*(b[:2, :2] for b in blocks))
    gains = np.array([real.plant.actuators[j].gain for j in driven])
    into = np.vstack([np.outer(b[:2, 2], gains * real.at_actuators[driven, r]) for r, b in enumerate(blocks)])
    start = np.zeros(2 * n)
    start[1::2] = test.impulse * real.at_actuators[actuators.index(impulse_input)]
    size = np.linalg.norm(start[: 2 * CONTROLLED])

    program = ca.Opti()
    limit = LIMIT * free.peak_force
    forces = program.variable(len(driven), n_samples)  # over the limit
    states = program.variable(2 * n, n_samples + 1)  # over the first of the controlled modes
    moved = ca.sparsify(ca.DM(step)) @ states[:, :-1] + ca.DM(into * limit / size) @ forces
    program.subject_to(states[:, 0] == start / size)
    program.subject_to(states[:, 1:] == moved)
    program.subject_to(program.bounded(-1.0, ca.vec(forces), 1.0))
    program.subject_to(test.sample_time * limit**2 / free.effort * ca.sumsqr(forces) <= 1.0)
    residual, after = states[2 * CONTROLLED :, :], np.repeat(1.0 / damping[CONTROLLED:], 2)  # then they die out
    vibration = test.sample_time * ca.sumsqr(residual[:, :-1]) + ca.dot(after, residual[:, -1] ** 2)
    allowed = free.modal_energy[CONTROLLED:].sum() * test.sample_time
    program.subject_to(0.5 * size**2 / allowed * vibration <= 1.0)
    program.minimize(ca.sumsqr(states[: 2 * CONTROLLED, -1]))
    program.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    try:
        return float(program.solve().value(program.f))
    except RuntimeError:  # no forces keep within all bounds
        return np.inf


def _with_effect(real, name, size):
    """The plant whose driven actuators have the effect."""
    own = real.plant.actuators
    changed = tuple(a if a.direct else replace(a, **{EFFECTS[name][2]: size}) for a in own)
    return replace(real.plant, actuators=changed).solved()


def _figures(run):
    return {
        "stable": run.stable,
        "settling": run.settling(CONTROLLED),
        "vibration": run.vibration,
        "effort": run.effort,
        "peak force": run.peak_force,
    }


def study(outcome, data: Path | None = None) -> None:
    points = [{"index": i, "seed": SEED} for i in range(PLANTS)]
    results = outcome.run(points, plant)
    for result in results:
        if result.error is not None:
            outcome.say(f"plant {result['index']}: {result.error}")
    rows = [dict(r.values) for r in results if r.error is None]
    report(outcome, rows)
    outcome.check("plants that ended in an error", PLANTS - len(rows), 0)


def report(outcome, rows):
    """What each effect costs, and what is recovered of it."""
    rows = [row for row in rows if row["without"]["settling"] is not None]
    outcome.table("plants", rows)
    lost = {name: [row for row in rows if _over(row, name, "present") > 1.0 + LOST] for name in EFFECTS}
    table = {}
    for name, there in lost.items():
        won = np.array([_won(row, name) for row in there])
        effort = [row[name]["redesigned"]["effort"] / row["without"]["effort"] for row in there]
        table[name] = {
            "plants slowed": len(there),
            "unstable": sum(not row[name]["present"]["stable"] for row in there),
            "settling over that without, present": float(np.median([_over(row, name, "present") for row in there])),
            "redesigned": float(np.median([_over(row, name, "redesigned") for row in there])),
            "recovered share, median": float(np.median(won)),
            "half or more recovered on": int((won >= HALF).sum()),
            "effort over that without": float(np.median(effort)),
            "redesign improves, at any cost": sum(row[name]["improves"] for row in there),
        }
    minimum = [row["saturation"]["minimum"] / row["without"]["settling"] for row in lost["saturation"]]
    table["saturation"] |= {
        "minimum for any forces, median": float(np.median(minimum)),
        "minimum for any forces, largest": float(np.max(minimum)),
    }
    outcome.table("each effect", table)
    outcome.say(
        f"Of {len(rows)} hidden plants "
        + "; ".join(
            f"a {name} slows {t['plants slowed']} (median {t['settling over that without, present']:.2f} times the"
            f" settling time), redesigned {t['redesigned']:.2f} times: {100 * t['recovered share, median']:.0f} %"
            f" recovered, half or more on {t['half or more recovered on']}"
            for name, t in table.items()
        )
        + f". By no more effort and no more vibration of residual modes than without the limit, forces that know the"
        f" whole plant would settle it within {np.median(minimum):.2f} times that time, at most {np.max(minimum):.2f}."
    )
    for name, t in table.items():
        share, effort = t["recovered share, median"], t["effort over that without"]
        outcome.check(f"{name}: recovered share of the settling-time loss, median", share, HALF, at_least=True)
        outcome.check(f"{name}: effort of the redesign over that without it, median", effort, DEARER)
    share = sum(t["half or more recovered on"] for t in table.values()) / sum(map(len, lost.values()))
    outcome.check("share of all losses of which half or more is recovered", share, NEARLY_ALL, at_least=True)
    unstable = sum(not row[name]["redesigned"]["stable"] for row in rows for name in EFFECTS)
    outcome.check("loops that are unstable when redesigned", unstable, 0)
    caption = "Settling time of the controlled modes of each hidden plant with an effect, over that without it."
    outcome.figure("settling", _figure(lost), caption)


def _over(row, name, controller):
    """Settling time with an effect over that without; the whole test where it does not settle."""
    settling = row[name][controller]["settling"]
    return (row["test"] if settling is None else settling) / row["without"]["settling"]


def _won(row, name):
    """Share of the lost time that is recovered, at most all of it."""
    present, redesigned = _over(row, name, "present"), _over(row, name, "redesigned")
    return min((present - redesigned) / (present - 1.0), 1.0)


def _state(run):
    return "unstable" if not run["stable"] else "not within the test" if run["settling"] is None else "settles"


def _figure(lost):
    figure, axes = new_figure(1, len(lost), width=10, height=4.0, sharey=True)
    designs = (("present", COLOURS[1], -0.12), ("redesigned", COLOURS[0], 0.12))
    markers = {"settles": "o", "not within the test": "^", "unstable": "x"}
    for ax, (name, there) in zip(axes, lost.items(), strict=True):
        order = sorted(there, key=lambda row: _over(row, name, "present"))
        for i, row in enumerate(order):
            ends = [_over(row, name, who) for who, *_ in designs]
            ax.plot([i + shift for *_, shift in designs], ends, color=GREY, linewidth=0.8, zorder=0)
            for end, (who, colour, shift) in zip(ends, designs, strict=True):
                ax.plot(i + shift, end, markers[_state(row[name][who])], color=colour, markersize=4)
        ax.axhline(1.0, color=GREY, linewidth=0.8)
        ax.set(yscale="log", xlabel="simulated plants slowed by their effects", title=name)
        ax.set_xticks([])
    axes[0].set_ylabel("settling time / that\nwithout the effect [-]")
    handles = [Line2D([], [], marker="o", linewidth=0, color=colour, label=who) for who, colour, _ in designs]
    handles += [Line2D([], [], marker=m, linewidth=0, color="black", label=state) for state, m in markers.items()]
    axes[0].legend(handles=handles, fontsize=8)
    return figure
