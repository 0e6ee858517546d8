"""Does a controller redesigned for the diagnosed structure hold on the hidden one, and how near is it to the best?"""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from workbench.draw.style import COLOURS, grouped_bars, new_figure
from workbench.gap.diagnose_case import diagnose_case
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import NominalPrior, nominal_errors
from workbench.gap.prediction.noise import noise_found
from workbench.gap.prediction.residuals import FitData
from workbench.gap.search.fit import fit
from workbench.gap.search.intervals import with_intervals
from workbench.rig.simulate import simulate_record
from workbench.robust.impulse import impulse_test
from workbench.robust.plain_law import plain_law
from workbench.robust.posterior import UncertainRig
from workbench.robust.prediction import predict_loop
from workbench.robust.redesign import force_weight, redesign
from workbench.trials.controlled import control_plant
from workbench.trials.make import find_trial_with_plant

PLANTS, SEED = 100, 20302
SEARCHED = 3  # of these by the whole search; the others get the kinds of the label, as the blind trials name nearly all
KINDS = (
    "actuator_delay", "actuator_lag", "actuator_dead_zone", "actuator_saturation", "actuator_gain", "sensor_gain",
    "modulus_error", "sensor_lag", "point_mass", "ground_spring", "cubic_spring", "coulomb_friction", "modal_damping",
    "actuator_misplacement", "sensor_bias",
)  # fmt: skip
IMPERFECTIONS = ("clean", "noise", "late", "clean", "offset")
LAWS = ("imsc", "coupled")
CONTROLLED, DAMPING, DRAWS, PREDICTED = 2, 0.35, 40, 80
OFF = (1.2, 1.02)  # factors by which the fit starts beside the truth; the better of both is kept
UNKNOWN = 0.2  # of the readings: what is left unexplained from which a fit is no explanation
MORE = 1.05  # times the noise: what is left, from which errors of the nominal model are fitted
WORSE = 0.02
WORK_MARGIN = 0.01  # increase over the nominal design's work that a redesign with limited work may have

CLASSES = (1.0, 10.0, 100.0)  # %, of the cost above that of the design on the true effects, in the figure
CONTROLLERS = (("nominal", "nominal design", COLOURS[1]), ("redesigned", "redesign", COLOURS[0]))


def plant(index, seed, searched=False):
    """One hidden plant: what the nominal design, the redesign and the design on the true effects do to it."""
    rng = np.random.default_rng([seed, index])
    kinds = [KINDS[index % len(KINDS)]]
    if index % 3 == 2:
        other = str(rng.choice([k for k in KINDS if k.split("_")[0] != kinds[0].split("_")[0]]))
        kinds.append(other)
    case, label, real = find_trial_with_plant(
        rng, kinds=kinds, imperfections=IMPERFECTIONS[index % len(IMPERFECTIONS)], size=0.5
    )
    true = tuple(_effect(labelled) for labelled in label["effects"])
    rig = case.rig
    level = np.max([np.abs(r.outputs).max(axis=1) for r in case.fit], axis=0)
    test = impulse_test(rig, range(CONTROLLED), case.fit[0].sample_time, level=level, seed=index)
    law = plain_law(
        LAWS[index % len(LAWS)],
        rig,
        CONTROLLED,
        damping=DAMPING,
        impulse_at=test.impulse_at,
        impulse=test.impulse,
    )
    if searched:
        verdict = diagnose_case(case, workers=1)
        uncertain, noise = UncertainRig.of(verdict), verdict.budget.noise_found
    else:
        uncertain, noise = _fitted(case, true)
    found = redesign(uncertain, law, test=test, draws=DRAWS, seed=index, placement=False)
    sure = UncertainRig(rig, true, np.zeros((_size(rig, true),) * 2))
    best = redesign(sure, law, test=test, draws=1, seed=index, placement=False)
    weight = force_weight(best.after, best.controlled)
    impulse_input = next(a for a in rig.actuators if a.direct or a.at == test.impulse_at).name
    bounded = replace(found, max_work_increase=WORK_MARGIN)
    used = {
        "nominal": found.present,
        "redesigned": found.controller,
        "true": best.controller,
        "work limited": bounded.controller,
    }
    given = {"n_samples": test.n_samples, "impulse_input": impulse_input, "impulse": test.impulse}
    runs, results = {}, {}  # equal controllers run once
    for name, controller in used.items():
        if controller not in runs:
            noise_drawn = np.random.default_rng([seed, index, 7])
            runs[controller] = control_plant(real, controller, **given, rng=noise_drawn)
        run = runs[controller]
        results[name] = {
            "stable": run.stable,
            "work": float(np.abs(run.work).sum()),
            "energy supplied": float(np.maximum(run.work, 0.0).sum()),
            "vibration": run.vibration,
            "effort": run.effort,
            "cost": 2.0 * run.vibration + weight * run.effort,
            "peak force": run.peak_force,
            "settling": run.settling(),
        }
    results["inside the bands"] = _inside(uncertain, noise, found.controller, test, runs[found.controller])
    return {
        "kinds": [e.kind.name for e in true],
        "imperfections": label["class"],
        "found": [e.kind.name for e in uncertain.effects],
        "unexplained": uncertain.unexplained,
        "stable draws": found.verification.share_stable,
        "safe": found.safe,
        "improves": found.improves,
        "improves, work limited": bounded.improves,
        "steps": [s.name for s in found.steps if s.kept] if found.improves else [],
        "sentence": found.sentence,
        **results,
    }


def _inside(uncertain, noise, controller, test, run):
    """Share of the readings of the hidden plant inside the bands that were predicted for them."""
    if not run.stable:
        return None
    predicted = predict_loop(uncertain, controller, test, noise_std=noise, draws=PREDICTED, seed=1)
    return float(predicted.coverage(run.outputs)[:, 0].mean())


def _effect(labelled):
    kind = kind_named(labelled["kind"])
    target = labelled.get("input", labelled.get("output"))
    return Effect(kind, target, {k: v for k, v in labelled.items() if k not in ("kind", "input", "output", "at_std")})


def _size(rig, effects):
    return sum(len(e.parameters(rig)) for e in effects)


def _fitted(case, true):
    """The named effects with their sizes fitted from beside the truth and what they leave, and the sensors' noise.

    Where they leave more than noise, small errors of the nominal model are fitted beside them, as a diagnosis does.
    """
    rig = case.rig
    data = FitData(case.fit, np.array([s.noise_std for s in rig.sensors]), substeps=8)
    fits = [fit(rig, [_beside(e, rig, off) for e in true], data, iterations=15) for off in OFF]
    found = min(fits, key=lambda one: one.cost)
    noise = noise_found(
        [record.outputs - simulate_record(apply_all(rig, found.effects), record) for record in case.fit]
    )
    if np.mean(found.cost_by_channel) > MORE * np.mean((noise / data.noise) ** 2):
        data = FitData(case.fit, noise, substeps=8)
        along = 0.02 if rig.structure is not None else 0.0
        prior = NominalPrior(along, 0.0, 0.0 if along else 0.005, 0.2, 0.1, case.fit[0].sample_time, waves=1)
        found = fit(rig, [nominal_errors(rig, prior), *found.effects], data, iterations=8)
    found = with_intervals(rig, found, data)
    excess = np.maximum(found.cost_by_channel - 1.0, 0.0)
    scales = np.array([record.outputs.std(axis=1) for record in data.counted])
    left = float(np.sqrt(np.mean(excess * (data.noise / scales) ** 2)))
    outcome = "explained" if left < UNKNOWN else "unknown"
    return UncertainRig(rig, found.effects, found.covariance, left, outcome), noise


def _beside(effect, rig, off):
    values = dict(effect.values)
    for p in effect.parameters(rig):
        factor = off if p.name not in ("at", "gap") else 1.0 + 0.1 * (off - 1.0)
        values[p.name] = float(np.clip(factor * values[p.name], p.low, p.high))
    return replace(effect, values=values)


def study(outcome, data: Path | None = None) -> None:
    points = [{"index": i, "seed": SEED, "searched": i >= PLANTS - SEARCHED} for i in range(PLANTS)]
    rows = [dict(r.values) for r in outcome.run(points, plant) if _has_ended(outcome, r)]
    outcome.table("plants", [{k: v for k, v in row.items() if k not in ("sentence", "found")} for row in rows])
    report(outcome, rows)


def report(outcome, rows):
    """The figures of all plants."""
    both = [row for row in rows if row["redesigned"]["stable"] and row["true"]["stable"]]
    ratios = {
        name: float(np.median([row["redesigned"][name] / row["true"][name] for row in both]))
        for name in ("work", "vibration", "effort", "cost", "peak force")
    }
    outcome.table("redesign over the design on the true effects, median", {**ratios, "plants": len(both)})
    before = [row for row in rows if row["nominal"]["stable"] and row["redesigned"]["stable"]]
    worse, harder = (
        np.array([row["redesigned"][name] / row["nominal"][name] for row in before]) for name in ("cost", "work")
    )
    within = [row for row in rows if row["nominal"]["stable"] and row["work limited"]["stable"]]
    asked = np.array([row["work limited"]["work"] / row["nominal"]["work"] for row in within])
    more = [_more_work(row) for row, over in zip(before, harder, strict=True) if over > 1 + WORSE]
    outcome.table(f"plants on which the redesign does over {100 * WORSE:g} % more work than the nominal design", more)
    unstable = [row for row in rows if not row["nominal"]["stable"]]
    lost = [row for row in rows if not row["redesigned"]["stable"]]
    inside = np.array([row["inside the bands"] for row in rows if row["inside the bands"] is not None])
    outcome.say(
        f"Of {len(rows)} hidden plants the nominal design is unstable on {len(unstable)}, the redesign on {len(lost)}."
        f" Where both are stable, it costs {np.median(worse):.3f} times the nominal design (median),"
        f" at most {worse.max():.3f} times, and {np.median(harder):.3f} times the work, {harder.max():.3f} at most."
        f" On {sum(not row['improves'] for row in rows)} the present controller is kept; with the work limited, on"
        f" {sum(not row['improves, work limited'] for row in rows)}, and the work is {asked.max():.3f} times at most."
        f" {100 * inside.mean():.1f} % of the readings lie inside the 95 % bands predicted for the redesigned loop"
        f" (median of the plants {100 * np.median(inside):.1f} %, worst {100 * inside.min():.1f} %)."
    )
    most = {"cost": worse.max(), "work": harder.max(), "work, where it is limited": asked.max()}
    outcome.table("over the nominal design, most", most)
    outcome.say(
        f"On {len(more)} the redesign does over {100 * WORSE:g} % more work than the nominal design;"
        f" on {sum(row['work'][1] > 1 + WORSE for row in more)} of them so does the design on the true effects. It"
        f" leaves {min((row['vibration'] for row in more), default=1.0):.3f} to"
        f" {max((row['vibration'] for row in more), default=1.0):.3f} times the vibration, for"
        f" {min((row['cost'] for row in more), default=1.0):.3f} to"
        f" {max((row['cost'] for row in more), default=1.0):.3f} times the cost."
    )
    outcome.check("plants that ended in an error", PLANTS - len(rows), 0)
    away = abs(ratios["work"] - 1.0)
    outcome.check("redesign over the design on the true effects, work: median away from one", away, 0.05)
    unsafe = [row for row in rows if not row["redesigned"]["stable"] and row["safe"]]
    outcome.check("plants on which a redesign reported as safe is unstable", len(unsafe), 0)
    for what, over in (("costs", worse), ("with its work limited does", asked)):
        words = f"{what} over {100 * WORSE:g} % more {'work ' * (over is asked)}than the nominal design"
        outcome.check(f"plants on which the redesign {words}", int((over > 1 + WORSE).sum()), 0)
    with_more_vibration = sum(row["vibration"] > 1.0 for row in more)
    outcome.check(
        f"plants on which the redesign does over {100 * WORSE:g} % more work and leaves more vibration",
        with_more_vibration,
        0,
    )
    destabilised = [row for row in lost if row["nominal"]["stable"]]
    outcome.check("plants that the nominal design keeps stable and the redesign does not", len(destabilised), 0)
    outcome.check("share of readings inside the 95 % bands", inside.mean(), 0.90, at_least=True)
    outcome.check("share of readings inside the 95 % bands, at most", inside.mean(), 0.99)
    outcome.figure(
        "cost",
        _figure(rows),
        "Hidden plants by how much each controller costs on them above the design on the true effects.",
    )


def _more_work(row):
    """Work, what of it goes into modes, vibration and cost over those of the nominal design; work of the truth too."""
    nominal, redesigned, best = (row[name] for name in ("nominal", "redesigned", "true"))
    return {
        "kinds": row["kinds"],
        "work": [one["work"] / nominal["work"] for one in (redesigned, best)],
        "energy extracted": (redesigned["work"] - redesigned["energy supplied"])
        / (nominal["work"] - nominal["energy supplied"]),
        "energy supplied": redesigned["energy supplied"] / max(nominal["energy supplied"], 1e-300),
        "vibration": redesigned["vibration"] / nominal["vibration"],
        "cost": redesigned["cost"] / nominal["cost"],
    }


def _has_ended(outcome, result) -> bool:
    if result.error is not None:
        outcome.say(f"plant {result['index']}: {result.error}")
    return result.error is None


def _figure(rows):
    """Number of plants by the cost of each controller above that of the design on the true effects."""
    figure, ax = new_figure(width=9, height=4.2)
    edges = np.array([*CLASSES, np.inf])
    names = [f"at most {CLASSES[0]:g} %", *(f"{low:g} to {high:g} %" for low, high in pairwise(CLASSES))]
    names += [f"over {CLASSES[-1]:g} %", "unstable"]
    shifts, width = grouped_bars(2)
    for (name, words, colour), shift in zip(CONTROLLERS, shifts, strict=True):
        stable = [row for row in rows if row[name]["stable"]]
        above = np.array([100.0 * (row[name]["cost"] / row["true"]["cost"] - 1.0) for row in stable])
        counts = [*np.bincount(np.searchsorted(edges, above), minlength=edges.size), len(rows) - len(stable)]
        ax.bar(np.arange(len(names)) + shift, counts, width, color=colour, label=words)
        for i, count in enumerate(counts):
            ax.annotate(str(count), (i + shift, count), (0, 3), textcoords="offset points", ha="center", color=colour)
        if name == "nominal" and above.max() > CLASSES[-1]:
            worst = f"≤ {1.0 + above.max() / 100.0:.3g} times"
            ax.annotate(worst, (len(names) - 2, counts[-2]), (0, 18), textcoords="offset points", ha="center")
    ax.set_xticks(range(len(names)), names)
    ax.set(
        xlabel="cost above that of the design on the true effects [%]",
        ylabel=f"plants, of {len(rows)} [-]",
        title="what each controller costs on the simulated plants",
    )
    ax.margins(y=0.12)
    ax.legend(loc="upper right")
    ax.grid(False, axis="x")
    return figure
