"""A blind trial: a case with hidden effects and its label, simulated independently of the diagnosis."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from workbench.arrays import Floats
from workbench.cases.case import Case
from workbench.structure.domain import NamedPoints
from workbench.trials.benches import Bench, Unsuitable, bench_of, draw_bench, experiments, relative_gap, tested
from workbench.trials.draws import NominalMotion, draw_effect
from workbench.trials.hidden import HIDE, NONE, OUTSIDE, UNKNOWN, hide
from workbench.trials.imperfections import CLEAN, IMPERFECTIONS, with_imperfections
from workbench.trials.laws import POINT_LAWS
from workbench.trials.plant import Plant, SolvedPlant
from workbench.trials.rigs import MEMBERS

KINDS = tuple(HIDE)
OUTSIDE_KINDS = tuple(OUTSIDE)
MOST_BENCHES, MOST_DRAWS = 40, 8
VISIBLE = 0.02
SEEN = 0.03  # least relative change of the response by each of several effects
DISTINCT = 0.1  # least change of the readings between an effect and its limiting case, over the noise
STRONG = 0.7  # least gap of the effects, over the gap of the imperfections


def make_trial(seed: int, **how: Any) -> tuple[Case, dict[str, Any]]:
    """The case and the label of `make_trial_with_plant`, with the same arguments."""
    return make_trial_with_plant(seed, **how)[:2]


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
    check_kinds(kinds)
    rng = np.random.default_rng(seed)
    for _ in range(MOST_BENCHES if like is None else MOST_DRAWS):
        try:
            bench = draw_bench(rng, structure) if like is None else bench_of(like)
            tests = experiments(bench, rng)
            bench, effects = _draw_effects(bench, tests["mid"], kinds, rng)
            plain = bench.plant()
            imperfect = with_imperfections(plain, imperfections, size, bench, rng)
            case, label, real = _case(bench, tests, effects, (plain, imperfect), rng, name)
            return case, {**label, "class": imperfections, "size": size}, real
        except Unsuitable as error:
            reason = error
    raise ValueError(f"no case with {' and '.join(kinds)} could be generated on this bench; the last draw: {reason}")


def check_kinds(kinds: Iterable[str]) -> None:
    """Refuse a kind that no trial can hide."""
    unknown = [kind for kind in kinds if kind not in (*KINDS, *OUTSIDE_KINDS)]
    if unknown:
        raise ValueError(f"kind {unknown[0]!r} is neither in the vocabulary nor among {', '.join(OUTSIDE_KINDS)}")


def _draw_effects(
    bench: Bench, commands: np.ndarray, kinds: Sequence[str], rng: np.random.Generator
) -> tuple[Bench, list[dict[str, Any]]]:
    effects = []
    if "truncated_modes" in kinds:
        bench, effect = _truncate(bench, rng)
        effects.append(effect)
    if kinds:
        nominal = NominalMotion.of(bench, commands)
        effects += [draw_effect(kind, nominal, rng) for kind in kinds if kind != "truncated_modes"]
        _check_each_seen(nominal, effects, rng)
    return bench, effects


def _truncate(bench: Bench, rng: np.random.Generator) -> tuple[Bench, dict[str, Any]]:
    """The bench with a truncated nominal model, and the effect; the real structure keeps all modes."""
    modes = bench.rig.modes
    if bench.rig.structure is None or modes.n_modes < 6:
        raise Unsuitable("truncation needs a beam or a rod with six modes or more")
    kept = int(rng.integers(3, max(modes.n_modes - 4, 4)))
    rig = replace(bench.rig, modes=modes.select(slice(kept)))
    return replace(bench, rig=rig), {"kind": "truncated_modes", "kept": kept, "needed": modes.n_modes}


def _check_each_seen(nominal: NominalMotion, effects: list[dict[str, Any]], rng: np.random.Generator) -> None:
    plant = nominal.bench.plant()
    for one in effects:
        if one["kind"] == "sensor_quantisation":
            continue
        without = hide(plant, [e for e in effects if e is not one])
        gap = nominal.gap(hide(plant, effects), rng, reference=without)
        if (len(effects) > 1 and gap < SEEN) or gap > 5.0:
            raise Unsuitable(f"{one['kind']}, added to the other effects, alters the response by {gap:.2g}")
        if one["kind"] == "truncated_modes" and gap < 0.01:
            raise Unsuitable(f"the truncated modes alter the response by {gap:.2g} only")


def _case(
    bench: Bench,
    tests: dict[str, np.ndarray],
    effects: list[dict[str, Any]],
    plants: tuple[Plant, Plant],
    rng: np.random.Generator,
    name: str,
) -> tuple[Case, dict[str, Any], SolvedPlant]:
    """The case, its label and the real structure; `plants` are the nominal one, and the one with imperfections."""
    plain, imperfect = plants
    nominal = plain.solved()
    real = hide(imperfect, effects).solved()
    fitted = {test: commands for test, commands in tests.items() if test != "validate"}
    if imperfect is not plain and effects:
        _check_strong(bench, fitted, effects, (nominal, imperfect.solved(), real), rng)
    _check_distinct(bench, fitted, effects, imperfect, real)
    records, figures = {}, {}
    for test, commands in tests.items():
        moved, sent = tested(real, bench, test, commands, rng)
        measured = real.readings(moved, bench.sample_time, rng)
        if not np.isfinite(measured).all() or (np.ptp(measured, axis=1) == 0).any():
            raise Unsuitable("the response diverges, or a sensor is dead")
        logged = _logged(sent, real.plant.logging_noise, rng)
        records[test] = bench.rig.record(logged, measured, sample_time=bench.sample_time, name=test)
        # without random forces the exact model predicts the motion itself
        exact = _predicted(real, sent, bench) if real.plant.noises else real.readings(moved, bench.sample_time)
        noise = np.array([[s.noise_std] for s in real.plant.sensors])
        figures[test] = {
            "gap": relative_gap(measured - _predicted(nominal, logged, bench), measured),
            "noise_floor": relative_gap(noise, measured),
            "true_model": relative_gap(measured - exact, measured),
        }
    _check_visible([figures[test] for test in fitted], effects)
    outside = [{"kind": UNKNOWN, "outside": e["kind"]} for e in effects if e["kind"] in OUTSIDE]
    # share of the mean square of the nominal residual that noise makes; the residual of the exact model under random
    # forces or input noise counts as explained: nothing is unexplained
    of_validation = figures["validate"]
    noise_share = min(of_validation["noise_floor"], of_validation["true_model"]) ** 2 / of_validation["gap"] ** 2
    domain = bench.rig.modes.domain
    label = {
        "title": name,
        "snr_db": bench.snr_db,
        "effects": outside or effects or [{"kind": NONE}],
        "length": 1.0 if isinstance(domain, NamedPoints) and domain.positions is None else domain.size,
        "budget": {"explained": 1.0 - noise_share, "unexplained": 0.0, "noise": noise_share},
        "records": figures,
    }
    validation = (records.pop("validate"),)
    return Case(name, bench.rig, tuple(records.values()), validation), label, real


def _check_strong(
    bench: Bench,
    fitted: dict[str, Floats],
    effects: list[dict[str, Any]],
    plants: tuple[SolvedPlant, SolvedPlant, SolvedPlant],
    rng: np.random.Generator,
) -> None:
    """Require a record to fit in which the effects are visible and at least `STRONG` times the imperfections.

    Weaker effects cannot be named: they alter the readings by less than a diagnosis explains. The plants are the
    nominal one, the one with imperfections, and the one with effects too.
    """
    gaps, ratios = [], []
    for test in fitted.items():
        nominal, imperfect, real = (
            _noise_free(plant, bench, *test, np.random.default_rng(rng.integers(2**31))) for plant in plants
        )
        if not np.isfinite([nominal, imperfect, real]).all():
            raise Unsuitable("the response diverges")
        gaps.append(relative_gap(real - imperfect, real))
        ratios.append(gaps[-1] / max(relative_gap(imperfect - nominal, imperfect), 1e-12))
    if not _rounded(effects) and max(gaps) < VISIBLE:
        raise Unsuitable(f"the effects alone alter the readings by {max(gaps):.2g}, at most")
    if max(ratios) < STRONG:
        raise Unsuitable(f"the effects make {max(ratios):.2g} times the gap that the imperfections make, at most")


def _check_distinct(
    bench: Bench, fitted: dict[str, Floats], effects: list[dict[str, Any]], imperfect: Plant, real: SolvedPlant
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
        for test in fitted.items():
            # the same random forces on both
            y, without = (_noise_free(plant, bench, *test, np.random.default_rng(0)) for plant in (real, simpler))
            squares.append(np.mean(((y - without) / noise) ** 2))
        difference = float(np.sqrt(np.mean(squares)))
        if not difference > DISTINCT:
            raise Unsuitable(f"{one['kind']} differs from its limiting case by {difference:.2g} of the noise only")


def _noise_free(plant: SolvedPlant, bench: Bench, test: str, commands: Floats, rng: np.random.Generator) -> np.ndarray:
    """Readings in one of the experiments, under random forces but without the sensors' noise."""
    return plant.readings(tested(plant, bench, test, commands, rng)[0], bench.sample_time)


def _rounded(effects: list[dict[str, Any]]) -> bool:
    return any(e["kind"] == "sensor_quantisation" for e in effects)


def _logged(sent: Floats, noise: float, rng: np.random.Generator) -> Floats:
    """The logged inputs, with noise of this share of their rms; an input at rest has none."""
    rms: Floats = np.sqrt(np.mean(sent**2, axis=1, keepdims=True))
    return sent + noise * rms * rng.standard_normal(sent.shape) if noise else sent


def _check_visible(figures: Sequence[dict[str, float]], effects: list[dict[str, Any]]) -> None:
    """Require a record to fit whose gap is well above its noise."""
    largest = max(f["gap"] ** 2 - f["noise_floor"] ** 2 for f in figures)
    ratio = max(f["gap"] / f["noise_floor"] for f in figures)
    if effects and not _rounded(effects) and (largest < VISIBLE**2 or ratio < 2.0):
        raise Unsuitable(f"the largest gap of a record to fit is {np.sqrt(max(largest, 0.0)):.2g}")


def _predicted(plant: SolvedPlant, sent: Floats, bench: Bench) -> np.ndarray:
    return plant.readings(plant.move(sent, bench.sample_time)[0], bench.sample_time)


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
