"""Blind trials: cases with hidden effects and sealed labels, simulated independently of the diagnosis."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from workbench.arrays import Floats
from workbench.cases.case import Case
from workbench.cases.writing import write_case
from workbench.records.record import Record
from workbench.trials.benches import Bench, bench_of, draw_bench, experiments, tested
from workbench.trials.draws import draw_effect
from workbench.trials.hidden import HIDE, NONE, OUTSIDE, UNKNOWN, hide
from workbench.trials.imperfections import (
    CLEAN,
    IMPERFECTIONS,
    MIMICS,
    SIZES,
    TRIPLE,
    Imperfections,
    draw_imperfections,
)
from workbench.trials.laws import POINT_LAWS
from workbench.trials.plant import Plant, SolvedPlant
from workbench.trials.rigs import FRAMES, MEMBERS, PLATES
from workbench.trials.scene import Scene, Unsuitable, extent

KINDS = tuple(HIDE)
OUTSIDE_KINDS = tuple(OUTSIDE)
MOST_BENCHES, MOST_DRAWS, MOST_SEEDS = 40, 8, 100
VISIBLE = 0.02
SEEN = 0.03  # least relative change of the response by each of several effects
DISTINCT = 0.1  # least change of the readings between an effect and its limiting case, over the noise
STRONG = 0.7  # least gap of the effects, over the gap of the imperfections

# Kinds that are impossible on a structure.
OF_MEMBERS = frozenset({"local_stiffness_loss", "support_rotation", "axial_load", "air_drag", "midplane_stretching"})
NOT_ON = {MEMBERS: frozenset(), PLATES: OF_MEMBERS, FRAMES: OF_MEMBERS | {"truncated_modes"}}

# Pairs of kinds that the records of a case cannot distinguish.
TWINS = (
    {"actuator_lag", "actuator_delay"},
    {"sensor_lag", "actuator_lag"},
    {"sensor_lag", "actuator_delay"},
    {"modulus_error", "stiffness_drift"},
    {"sensor_lag", "sensor_delay"},
    {"sensor_delay", "actuator_lag"},
    {"sensor_delay", "actuator_delay"},
)


class ImperfectDraw(NamedTuple):
    """The draw of a trial with imperfections: their class and size, and the kinds of the hidden effects."""

    imperfections: str
    size: float
    kinds: tuple[str, ...]


def make_trial(seed: int, **how: Any) -> tuple[Case, dict[str, Any]]:
    """The case and the label of `make_trial_with_plant`, with the same arguments."""
    case, label, _ = make_trial_with_plant(seed, **how)
    return case, label


def make_trial_with_plant(
    seed: int,
    *,
    kinds: Sequence[str] = (),
    like: Case | None = None,
    structure: str = MEMBERS,
    name: str = "case",
    imperfections: str = CLEAN,
    size: float = 1.0,
) -> tuple[Case, dict[str, Any], SolvedPlant]:
    """A case with hidden effects of the given kinds, its label in the case format, and the real structure.

    Args:
        seed: the same seed makes the same case.
        kinds: of `KINDS` or `OUTSIDE_KINDS`; none for a real structure equal to the nominal one.
        like: a case whose nominal rig, levels, band, noise and records are taken; None draws a bench.
        structure: of a drawn bench: "members" (beams and rods), "plates" or "frames".
        name: of the case.
        imperfections: class of small additional errors, of `IMPERFECTIONS`.
        size: of these errors, 1 for those of a careful laboratory.

    Returns:
        The case; {"title", "snr_db", "effects", "class", "size", "length", "budget", "records": {name: {"gap",
        "noise_floor", "true_model"}}}, where `true_model` is the gap of the exact model with its small errors, and
        the budget is of the validation records, as in the case format; and the real structure.

    Raises:
        ValueError: an unknown kind or class, or kinds that are impossible on the bench.
    """
    if imperfections not in IMPERFECTIONS:
        raise ValueError(f"imperfections must be one of {', '.join(IMPERFECTIONS)}; got {imperfections!r}")
    unknown = [kind for kind in kinds if kind not in (*KINDS, *OUTSIDE_KINDS)]
    if unknown:
        raise ValueError(f"kind {unknown[0]!r} is neither in the vocabulary nor among {', '.join(OUTSIDE_KINDS)}")
    rng = np.random.default_rng(seed)
    reason = ""
    for _ in range(MOST_BENCHES if like is None else MOST_DRAWS):
        try:
            bench = draw_bench(rng, structure) if like is None else bench_of(like)
            tests = experiments(bench, rng)
            bench, effects = _draw_effects(bench, tests["mid"], kinds, rng)
            errors = (
                draw_imperfections(imperfections, size, bench, rng)
                if imperfections not in (CLEAN, TRIPLE)
                else Imperfections()
            )
            case, label, real = _case(bench, tests, effects, errors, rng, name)
            return case, {**label, "class": imperfections, "size": size}, real
        except Unsuitable as error:
            reason = str(error)
    raise ValueError(f"no case with {' and '.join(kinds)} could be generated on this bench; the last draw: {reason}")


def _draw_effects(
    bench: Bench, commands: np.ndarray, kinds: Sequence[str], rng: np.random.Generator
) -> tuple[Bench, list[dict[str, Any]]]:
    effects = []
    if "truncated_modes" in kinds:
        bench, effect = _truncate(bench, rng)
        effects.append(effect)
    others = [kind for kind in kinds if kind != "truncated_modes"]
    if others or effects:
        scene = Scene.of(bench, commands)
        effects += [draw_effect(kind, scene, rng) for kind in others]
        _check_each_seen(scene, effects, rng)
    return bench, effects


def _truncate(bench: Bench, rng: np.random.Generator) -> tuple[Bench, dict[str, Any]]:
    """The bench with a truncated nominal model, and the effect; the real structure keeps all modes."""
    modes = bench.rig.modes
    if bench.rig.structure is None or modes.n_modes < 6:
        raise Unsuitable("truncation needs a beam or a rod with six modes or more")
    kept = int(rng.integers(3, max(modes.n_modes - 4, 4)))
    rig = replace(bench.rig, modes=modes.select(slice(kept)))
    return replace(bench, rig=rig), {"kind": "truncated_modes", "kept": kept, "needed": modes.n_modes}


def _check_each_seen(scene: Scene, effects: list[dict[str, Any]], rng: np.random.Generator) -> None:
    nominal = scene.bench.plant()
    for one in effects:
        if one["kind"] == "sensor_quantisation":
            continue
        rest = [e for e in effects if e is not one]
        gap = scene.gap(hide(nominal, effects), rng, reference=hide(nominal, rest))
        if (len(effects) > 1 and gap < SEEN) or gap > 5.0:
            raise Unsuitable(f"{one['kind']}, added to the other effects, alters the response by {gap:.2g}")
        if one["kind"] == "truncated_modes" and gap < 0.01:
            raise Unsuitable(f"the truncated modes alter the response by {gap:.2g} only")


def _case(
    bench: Bench,
    tests: dict[str, np.ndarray],
    effects: list[dict[str, Any]],
    imperfections: Imperfections,
    rng: np.random.Generator,
    name: str,
) -> tuple[Case, dict[str, Any], SolvedPlant]:
    imperfect = imperfections.on(bench.plant(), bench.sample_time)
    nominal = bench.plant().solved()
    real = hide(imperfect, effects).solved()
    if imperfections != Imperfections() and effects:
        _check_strong(bench, tests, effects, nominal, imperfect.solved(), real, rng)
    _check_distinct(bench, tests, effects, imperfect, real)
    fit: list[Record] = []
    validation: list[Record] = []
    figures = {}
    for test, commands in tests.items():
        moved, sent = tested(real, bench, test, commands, rng)
        measured = real.readings(moved, bench.sample_time, rng)
        if not np.isfinite(measured).all() or (np.ptp(measured, axis=1) == 0).any():
            raise Unsuitable("the response diverges, or a sensor is dead")
        logged = _logged(sent, real.plant.logging_noise, rng)
        record = bench.rig.record(logged, measured, sample_time=bench.sample_time, name=test)
        (validation if test == "validate" else fit).append(record)
        figures[test] = {
            "gap": _gap(measured, _predicted(nominal, record.inputs, bench)),
            "noise_floor": _gap(np.array([[s.noise_std] for s in real.plant.sensors]), 0.0, measured),
            # without random forces the exact model predicts the motion itself
            "true_model": _gap(
                measured,
                _predicted(real, sent, bench) if real.plant.noises else real.readings(moved, bench.sample_time),
            ),
        }
    _check_visible(figures, effects)
    labelled = [{"kind": UNKNOWN, "outside": e["kind"]} if e["kind"] in OUTSIDE else e for e in effects]
    if any(e["kind"] == UNKNOWN for e in labelled):
        labelled = [e for e in labelled if e["kind"] == UNKNOWN]
    label = {
        "title": name,
        "snr_db": bench.snr_db,
        "effects": labelled or [{"kind": NONE}],
        "length": extent(bench.rig.modes.domain),
        "budget": _budget(figures["validate"]),
        "records": figures,
    }
    return Case(name, bench.rig, tuple(fit), tuple(validation)), label, real


def _check_strong(
    bench: Bench,
    tests: dict[str, np.ndarray],
    effects: list[dict[str, Any]],
    nominal: SolvedPlant,
    imperfect: SolvedPlant,
    real: SolvedPlant,
    rng: np.random.Generator,
) -> None:
    """Require a record to fit in which the effects are visible and at least `STRONG` times the imperfections.

    Weaker effects cannot be named: they alter the readings by less than a diagnosis explains.
    """
    rounded = any(e["kind"] == "sensor_quantisation" for e in effects)
    gaps, ratios = [], []
    for test, commands in tests.items():
        if test == "validate":
            continue
        y = []
        for plant in (nominal, imperfect, real):
            moved, _ = tested(plant, bench, test, commands, np.random.default_rng(rng.integers(2**31)))
            y.append(plant.readings(moved, bench.sample_time))
        if not np.isfinite(y).all():
            raise Unsuitable("the response diverges")
        gaps.append(_gap(y[2], y[1]))
        ratios.append(gaps[-1] / max(_gap(y[1], y[0]), 1e-12))
    if not rounded and max(gaps) < VISIBLE:
        raise Unsuitable(f"the effects alone alter the readings by {max(gaps):.2g}, at most")
    if max(ratios) < STRONG:
        raise Unsuitable(f"the effects make {max(ratios):.2g} times the gap that the imperfections make, at most")


def _check_distinct(
    bench: Bench, tests: dict[str, np.ndarray], effects: list[dict[str, Any]], imperfect: Plant, real: SolvedPlant
) -> None:
    """Require that the records to fit distinguish an effect from its limiting case, else the simpler one is right.

    Of the constant force in friction that differs between directions, accelerometers show only the initial transient.
    """
    for one in effects:
        law = POINT_LAWS.get(one["kind"])
        if law is None or law.limit is None:
            continue
        simpler = hide(imperfect, [law.limit(e) if e is one else e for e in effects]).solved()
        noise = np.array([[sensor.noise_std] for sensor in real.plant.sensors])
        squares = []
        for test in (name for name in tests if name != "validate"):
            # the same random forces on both
            moved = [tested(p, bench, test, tests[test], np.random.default_rng(0))[0] for p in (real, simpler)]
            y, without = (p.readings(m, bench.sample_time) for p, m in zip((real, simpler), moved, strict=True))
            squares.append(np.mean(((y - without) / noise) ** 2))
        difference = float(np.sqrt(np.mean(squares)))
        if not difference > DISTINCT:
            raise Unsuitable(f"{one['kind']} differs from its limiting case by {difference:.2g} of the noise only")


def _logged(sent: Floats, noise: float, rng: np.random.Generator) -> Floats:
    """The logged inputs, with noise of this share of their rms; an input at rest has none."""
    if noise == 0:
        return sent
    rms: Floats = np.sqrt(np.mean(sent**2, axis=1, keepdims=True))
    return sent + noise * rms * rng.standard_normal(sent.shape)


def _budget(figures: dict[str, float]) -> dict[str, float]:
    """Shares of the mean square of the nominal residual that the exact model explains and that noise makes.

    The residual of the exact model under random forces or input noise counts as explained: nothing is unexplained.
    """
    noise = min(figures["noise_floor"], figures["true_model"]) ** 2 / figures["gap"] ** 2
    return {"explained": 1.0 - noise, "unexplained": 0.0, "noise": noise}


def _check_visible(figures: dict[str, dict[str, Any]], effects: list[dict[str, Any]]) -> None:
    """Require a record to fit whose gap is well above its noise."""
    shown = [f["gap"] ** 2 - f["noise_floor"] ** 2 for test, f in figures.items() if test != "validate"]
    ratio = max(f["gap"] / f["noise_floor"] for test, f in figures.items() if test != "validate")
    rounded = any(e["kind"] == "sensor_quantisation" for e in effects)
    if effects and not rounded and (max(shown) < VISIBLE**2 or ratio < 2.0):
        raise Unsuitable(f"the largest gap of a record to fit is {np.sqrt(max(max(shown), 0.0)):.2g}")


def _predicted(plant: SolvedPlant, sent: np.ndarray, bench: Bench) -> np.ndarray:
    return plant.readings(plant.move(sent, bench.sample_time)[0], bench.sample_time)


def _gap(measured: np.ndarray, predicted: np.ndarray | float, scaled_by: np.ndarray | None = None) -> float:
    scale = (measured if scaled_by is None else scaled_by).std(axis=1, keepdims=True)
    return float(np.sqrt(np.mean(((measured - predicted) / scale) ** 2)))


def draw_kinds(n: int, seed: int, *, like: Case | None = None, structure: str = MEMBERS) -> list[tuple[str, ...]]:
    """Random kinds for n trials: of every 60, 40 of one effect, 10 pairs, 5 without and 5 outside the vocabulary."""
    rng = np.random.default_rng(seed)
    missing = NOT_ON[structure] if like is None else {"truncated_modes"}
    pool = [kind for kind in KINDS if kind not in missing]
    singles = [(str(kind),) for _ in range(n // len(pool) + 1) for kind in rng.permutation(pool)]
    drawn: list[tuple[str, ...]] = []
    for i in range(n):
        turn = (i * 7 + 3) % 60  # spreads the families over the list for any n
        if turn < 5:
            drawn.append(())
        elif turn < 10:
            drawn.append((str(rng.choice(OUTSIDE_KINDS)),))
        elif turn < 20:
            drawn.append(_draw_several(2, pool, rng))
        else:
            drawn.append(singles.pop(0))
    return drawn


def draw_imperfect_kinds(
    n: int, seed: int, *, imperfections: str = "all", size: float | None = None
) -> list[ImperfectDraw]:
    """Random imperfections and kinds for n trials; every third trial has no hidden effect.

    Args:
        imperfections: a class, or "all" for each in turn.
        size: of the imperfections; None for each of `SIZES` in turn.
    """
    rng = np.random.default_rng(seed)
    drawn: list[ImperfectDraw] = []
    for i in range(n):
        name = IMPERFECTIONS[i % len(IMPERFECTIONS)] if imperfections == "all" else imperfections
        turn = i // len(IMPERFECTIONS) if imperfections == "all" else i
        how_large = SIZES[turn % len(SIZES)] if size is None else size
        pool = [k for k in KINDS if k not in MIMICS[name]]
        if name == TRIPLE:
            kinds = tuple(sorted(_draw_several(3, pool, rng)))
        elif (turn // len(SIZES) + turn) % 3 == 2:
            kinds = ()
        else:
            kinds = (str(rng.choice(pool)),)
        drawn.append(ImperfectDraw(name, how_large, kinds))
    return drawn


def _draw_several(n: int, pool: list[str], rng: np.random.Generator) -> tuple[str, ...]:
    """n random kinds that records can distinguish."""
    while True:
        kinds = tuple(str(kind) for kind in rng.choice(pool, n, replace=False))
        if "truncated_modes" not in kinds and not any(twins <= set(kinds) for twins in TWINS):
            return kinds


def write_trials(
    folder: str | Path,
    labels: str | Path,
    n: int,
    seed: int,
    *,
    like: Case | None = None,
    structure: str = MEMBERS,
    kinds: Sequence[Sequence[str]] | None = None,
    imperfections: str | None = None,
    size: float | None = None,
    report: Callable[[str, float], None] = lambda text, share: None,
) -> None:
    """Write n cases as folders, and their labels as one JSON file elsewhere.

    Args:
        like: a case whose rig and kinds of record all cases have; None draws a bench for each case. Kinds that are
            impossible on a bench are replaced by others.
        structure: of drawn benches: "members" (beams and rods), "plates" or "frames".
        kinds: of the hidden effects of each case; None draws them, see `draw_kinds` and `draw_imperfect_kinds`.
        imperfections: class of small additional errors, of `IMPERFECTIONS`, or "all" in turn; None for none.
        size: of these errors; None for each of `SIZES` in turn.
        report: called with (name, share done).

    Raises:
        ValueError: the labels would be in the folder that the diagnosis reads.
    """
    folder, labels = Path(folder), Path(labels)
    if labels.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"labels {labels} would be in the folder of the cases, {folder}; give another folder")
    if imperfections is None:
        draws = [ImperfectDraw(CLEAN, 1.0, k) for k in draw_kinds(n, seed, like=like, structure=structure)]
    else:
        draws = draw_imperfect_kinds(n, seed, imperfections=imperfections, size=size)
    if kinds is not None:
        draws = [draw._replace(kinds=tuple(hidden)) for draw, hidden in zip(draws, kinds, strict=True)]
    labelled = {}
    for i, draw in enumerate(draws):
        name = f"case-{i + 1:03d}"
        pool = [k for k in KINDS if k not in MIMICS[draw.imperfections] | NOT_ON[structure] | {"truncated_modes"}]
        how = {
            "like": like,
            "structure": structure,
            "name": name,
            "imperfections": draw.imperfections,
            "size": draw.size,
        }
        case, labelled[name], _ = find_trial_with_plant(
            np.random.default_rng([seed, i]), kinds=draw.kinds, others=pool, tries=MOST_SEEDS, **how
        )
        write_case(case, folder / name)
        report(name, (i + 1) / n)
    labels.parent.mkdir(parents=True, exist_ok=True)
    labels.write_text(json.dumps(labelled, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def find_trial_with_plant(
    rng: np.random.Generator, *, kinds: Sequence[str] = (), others: Sequence[str] = (), tries: int = 20, **how: Any
) -> tuple[Case, dict[str, Any], SolvedPlant]:
    """A trial of the first random seed with which it is possible.

    Args:
        rng: generator of the seeds.
        kinds, how: arguments of `make_trial_with_plant`.
        others: kinds that replace `kinds` at random after a failure; none to keep them.
        tries: number of seeds.

    Raises:
        ValueError: none of these seeds makes a trial.
    """
    for _ in range(tries):
        case_seed = int(rng.integers(2**31))
        try:
            return make_trial_with_plant(case_seed, kinds=kinds, **how)
        except ValueError as error:
            reason = error  # `error` is deleted at the end of the `except` clause
        if others:
            kinds = tuple(str(k) for k in rng.choice(others, len(kinds), replace=False))
    raise ValueError(
        f"none of {tries} seeds gives a usable trial: {reason}; are the sensors and levels of the bench right?"
    )
