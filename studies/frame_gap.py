"""Which joint is missing in the model of a frame? A brace between two storeys that slips, found from records alone.

A steel frame of three storeys is modelled by beam elements. On the real one a brace is bolted between the first and the
second floor, and its bolts slip. Two shakers drive the frame at two levels, and six accelerometers measure it. The
diagnosis knows the model and the records. It must say that something stands between two storeys, between which two, and
what its law is. The real frame is integrated here by the Runge-Kutta method, not by what simulates the model.
"""

from itertools import pairwise

import numpy as np

from workbench.draw.gap import plot_responses
from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.gap.diagnose import diagnose
from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.trials.plane_frame import Section, plane_frame

WIDTH, STOREY, STOREYS = 0.4, 0.3, 3  # m
COLUMN = Section(2.1e11 * 0.03 * 0.002, 2.1e11 * 0.03 * 0.002**3 / 12, 7850 * 0.03 * 0.002)  # a strip
FLOOR = Section(2.1e11 * 0.05 * 0.006, 2.1e11 * 0.05 * 0.006**3 / 12, 7850 * 0.05 * 0.006)
N_MODES, DAMPING = 8, 0.01
BETWEEN = ("L1.x", "R2.x")
STIFFNESS, YIELD = 900.0, 1.2e-4  # N/m, m: of the brace along x, until its bolts slip
SHAKERS, SENSORS = ("L3.x", "r1.x"), ("L1.x", "L2.x", "L3.x", "l1.x", "r2.x", "l3.x")
DT, SAMPLES, SUBSTEPS, BAND_HZ = 2e-3, 2000, 10, (1.0, 130.0)
LEVELS = {"low": (0.1, "fit"), "high": (0.8, "fit"), "check": (0.5, "validate")}  # N rms
SHOWN = 40  # samples before and after the largest stretch, in the figure
NOISE = 2e-3  # of the signal, in the high record


def frame():
    """The model: nodes L, C, R at each floor and l, r half way up each column, three degrees of freedom each."""
    at = {}
    for storey in range(1, STOREYS + 1):
        y = STOREY * storey
        at |= {f"L{storey}": (0.0, y), f"C{storey}": (WIDTH / 2, y), f"R{storey}": (WIDTH, y)}
        at |= {f"l{storey}": (0.0, y - STOREY / 2), f"r{storey}": (WIDTH, y - STOREY / 2)}
    ground = {"L0": (0.0, 0.0), "R0": (WIDTH, 0.0)}
    members = []
    for storey in range(1, STOREYS + 1):
        for side in "LR":
            chain = (f"{side}{storey - 1}", f"{side.lower()}{storey}", f"{side}{storey}")
            members += [(*ends, COLUMN) for ends in pairwise(chain)]
        members += [(*ends, FLOOR) for ends in pairwise((f"L{storey}", f"C{storey}", f"R{storey}"))]
    lines = [(one, other) for one, other, _ in members]
    return plane_frame(at | ground, members, fixed=tuple(ground), damping=ModalDamping(DAMPING)), lines, at


def measured(modes, name, level, seed):
    """Accelerations of the real frame under random forces held over each sample, and the force of the joint."""
    rng = np.random.default_rng(seed)
    lines = np.fft.rfftfreq(SAMPLES, DT)
    spectrum = np.where((lines > BAND_HZ[0]) & (lines < BAND_HZ[1]), 1.0, 0.0) * np.exp(
        2j * np.pi * rng.random((2, lines.size))
    )
    forces = np.fft.irfft(spectrum, SAMPLES)
    forces *= level / forces.std(axis=1, keepdims=True)
    push, here, across = modes.phi(list(SHAKERS)).T, modes.phi(list(SENSORS)), np.subtract(*modes.phi(list(BETWEEN)))
    n, omega, rates = modes.n_modes, modes.omega, np.diag(modes.damping)

    def motion(state, force):
        q, v, z = state[:n], state[n:-1], state[-1]
        speed = across @ v
        a = push @ force - omega**2 * q - rates * v - STIFFNESS * z * across
        return np.r_[v, a, speed - (abs(speed) * z + speed * abs(z)) / (2.0 * YIELD)]

    state, outputs, loop, h = np.zeros(2 * n + 1), [], [], DT / SUBSTEPS
    for force in forces.T:
        outputs.append(here @ motion(state, force)[n:-1])
        loop.append((across @ state[:n], STIFFNESS * state[-1]))
        for _ in range(SUBSTEPS):
            one = motion(state, force)
            two = motion(state + 0.5 * h * one, force)
            three = motion(state + 0.5 * h * two, force)
            four = motion(state + h * three, force)
            state = state + h / 6.0 * (one + 2.0 * two + 2.0 * three + four)
    return forces, np.array(outputs).T, np.array(loop)


def bench(modes):
    """The nominal rig, its records, and the true loop of the joint in the high one."""
    found = {name: measured(modes, name, level, 10 + i) for i, (name, (level, _)) in enumerate(LEVELS.items())}
    noise = NOISE * found["high"][1].std(axis=1)
    actuators = tuple(Actuator(f"shaker {name}", name) for name in SHAKERS)
    sensors = tuple(Sensor(name, name, "acceleration", noise_std=s) for name, s in zip(SENSORS, noise))
    into = tuple(Channel(a.name, "force", at=a.at) for a in actuators)
    out = tuple(Channel(s.name, s.quantity, at=s.at, noise_std=s.noise_std) for s in sensors)
    records = {}
    for i, (name, (forces, outputs, _)) in enumerate(found.items()):
        noisy = outputs + noise[:, None] * np.random.default_rng(20 + i).standard_normal(outputs.shape)
        records[name] = Record(DT, noisy, out, inputs=forces, input_channels=into, name=name)
    return Rig(modes, actuators, sensors), records, found["high"][2]


def study(outcome, data=None):
    model, lines, at = frame()
    modes = model.modes(N_MODES)
    rig, records, loop = bench(modes)
    fitted = [records[name] for name, (_, use) in LEVELS.items() if use == "fit"]
    verdict = diagnose(rig, fitted, validation=(records["check"],), name="frame")
    outcome.say(verdict.sentence)
    effect = verdict.effects[0]
    outcome.table("effect", {"kind": effect.kind.name, "between": list(effect.at), **effect.values})
    outcome.check(
        "one effect is named, a hysteretic spring",
        [e.kind.name for e in verdict.effects] == ["bouc_wen"],
        1,
        at_least=True,
    )
    # a floor hardly stretches: any point of it is the same place along x
    floors = {name[1] for name in effect.at if name[0] in "LCR" and name.endswith(".x")}
    outcome.check("it stands between the two floors of the brace", floors == {"1", "2"}, 1, at_least=True)
    outcome.check("stiffness of the brace: error, relative", abs(effect.values["stiffness"] / STIFFNESS - 1), 0.02)
    slip = effect.values["yield_displacement"]
    outcome.check("displacement where it slips: error, relative", abs(slip / YIELD - 1), 0.02)
    outcome.check("gap closed on the record kept out", verdict.shrinkage.overall, 0.99, at_least=True)
    outcome.figure(
        "joint",
        plot_joint(at, lines, effect, loop),
        "Left, the frame with its two shakers and six accelerometers, the real brace, and between which floors the"
        " diagnosis found it: along x all points of a floor move as one. Right, the force of the real joint over the"
        " relative displacement across it, where the high record has the largest, and the law that was found.",
    )
    outcome.figure(
        "responses",
        plot_responses({"model": rig, "with the joint": verdict.corrected}, [records["check"]]),
        "The record that no fit has seen, where the model was furthest off, and the model with the joint beside it.",
    )


def plot_joint(at, lines, effect, loop):
    """The frame with the joint in it, and the force of the joint over the displacement across it, about the largest."""
    figure, (left, right) = new_figure(1, 2, width=9.5, height=5, gridspec_kw={"width_ratios": (4, 5)})
    _frame_with_joint(left, at | {"L0": (0.0, 0.0), "R0": (WIDTH, 0.0)}, lines, effect)
    values = effect.values
    force, found = 0.0, [0.0]
    for step in np.diff(loop[:, 0]):  # the law is odd: its sign does not matter
        for part in np.full(20, step / 20):
            force += part - (abs(part) * force + part * abs(force)) / (2.0 * values["yield_displacement"])
        found.append(values["stiffness"] * force)
    peak = int(np.clip(np.abs(loop[:, 0]).argmax(), SHOWN, len(loop) - SHOWN))
    shown = slice(peak - SHOWN, peak + SHOWN)  # a few loops: all of them hide one another
    stretch, real, law = 1e3 * loop[shown, 0], loop[shown, 1], np.array(found)[shown]
    right.plot(stretch, real, color=GREY, linewidth=6, alpha=0.4, label="real joint")
    right.plot(stretch, law, color=COLOURS[2], linewidth=1.8, linestyle="--", label="identified law")
    slip = values["stiffness"] * values["yield_displacement"]
    right.axhline(slip, color=COLOURS[6], linewidth=0.8, linestyle=":")
    label = f"identified: slips at {slip:.3g} N,\nstiffness {values['stiffness']:.4g} N/m"
    right.text(0.02, 0.98, label, transform=right.transAxes, va="top")
    low, high = 1.15 * min(real.min(), -slip), 1.5 * slip
    right.set(xlabel="relative displacement across the joint [mm]", ylabel="force of the joint [N]", ylim=(low, high))
    right.set_title(f"the law found is the real one: {2 * SHOWN * DT:g} s of the high record")
    right.legend(loc="lower right")
    return figure


def _frame_with_joint(ax, places, lines, effect):
    for one, other in lines:
        ax.plot(*np.array([places[one], places[other]]).T, color=GREY, linewidth=3)
    brace = np.array([places[name.split(".")[0]] for name in BETWEEN])
    ax.plot(*brace.T, color=COLOURS[6], linewidth=5, linestyle=":")
    ax.text(0.96 * WIDTH, brace[0, 1] + 0.05, "real brace,\nwhich slips", ha="right", va="bottom", fontsize=9)
    # along x a floor moves as one: what was found acts between two floors, whichever of their points it names
    low, high = sorted(places[name.split(".")[0]][1] for name in effect.at)
    for y in (low, high):
        ax.plot([0.0, WIDTH], [y, y], color=COLOURS[2], linewidth=7, alpha=0.6, zorder=2.5)
    ax.plot([1.12 * WIDTH] * 2, [low, high], "-_", color=COLOURS[2], linewidth=2.5, markersize=12)
    found = f"identified:\n{effect.kind.words},\nbetween these\ntwo floors, in x"
    ax.text(1.2 * WIDTH, (low + high) / 2, found, color=COLOURS[2], va="center")
    for names, colour, marker, words in (
        (SENSORS, COLOURS[0], "o", "accelerometer"),
        (SHAKERS, COLOURS[1], ">", "shaker"),
    ):
        spots = np.array([places[name.split(".")[0]] for name in names])
        ax.plot(*(spots - (0.03 * (marker == ">"), 0.0)).T, marker, color=colour, markersize=10, label=words, zorder=3)
    for storey in range(1, STOREYS + 1):
        ax.text(-0.08, STOREY * storey, f"floor {storey}", ha="right", va="center", fontsize=9)
    ax.plot([-0.05, WIDTH + 0.05], [0.0, 0.0], color=COLOURS[6], linewidth=2)
    ax.text(-0.08, 0.0, "ground", ha="right", va="center", fontsize=9)
    ax.plot([0.0, WIDTH], [-0.09, -0.09], "-|", color=COLOURS[6], linewidth=1.0, markersize=8)
    ax.text(WIDTH / 2, -0.1, f"{WIDTH:g} m", ha="center", va="top", fontsize=9)
    ax.set(aspect="equal", xlim=(-0.28, 1.95 * WIDTH), ylim=(-0.15, STOREY * STOREYS + 0.2))
    ax.set_title("where the joint is")
    ax.axis("off")
    ax.legend(loc="upper left", ncols=2)
