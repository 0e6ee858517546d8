"""The diagnosis on cases made by finite elements: named, quantified, honest; and an effect of the user's own."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from workbench.draw.gap import plot_single_effects
from workbench.gap.diagnose import _leaves_unexplained, _outcome, diagnose
from workbench.gap.effects.catalogue import CATALOGUE, kind_named
from workbench.gap.effects.effect import Effect, Kind, Parameter, apply_all, place_parameters
from workbench.gap.effects.nonlinear import with_element
from workbench.gap.prediction.residuals import FitData
from workbench.gap.report.budget import Budget, Shrinkage
from workbench.gap.report.notes import _of_residual
from workbench.gap.search.fit import fit
from workbench.gap.setup.record_checks import RecordsError
from workbench.rig.elements import OneSidedStop, UserLaw
from workbench.rig.rig import Rig
from workbench.trials.make import make_trial


def verdict_on(case, **options):
    return diagnose(case.rig, case.fit, validation=case.validation, name=case.name, **options)


@pytest.mark.slow
def test_the_verdict_does_not_depend_on_how_many_share_the_work(hinged_rig, record_of):
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    real = kind_named("cubic_spring").apply(rig, None, {"at": 0.62, "stiffness": 2000.0})
    commands = [level * np.repeat(rng.normal(size=40), 10)[None] for level in (0.3, 1.0)]
    records = [record_of(real, command, rng, name=f"r{i}") for i, command in enumerate(commands)]
    alone, shared = (diagnose(rig, records[:1], validation=records[1:], workers=n).to_json() for n in (1, 2))
    assert alone == shared and [e["kind"] for e in alone["effects"]] == ["cubic_spring"]


def test_a_hidden_contact_is_named_placed_and_closed():
    case, label = make_trial(3, kinds=("one_sided_stop",))
    levels = replace(case, fit=case.fit[:3])  # the hammer and the closed loop tell no more
    verdict, hidden = verdict_on(levels), label["effects"][0]
    shown = verdict.to_json()
    assert [e["kind"] for e in shown["effects"]] == ["one_sided_stop"] and verdict.outcome == "explained"
    told = shown["effects"][0]
    assert told["at"] == pytest.approx(hidden["at"], abs=0.02 * case.rig.modes.length)
    assert told["parameters"]["gap"] == pytest.approx(hidden["gap"], rel=0.05)
    assert verdict.shrinkage.overall > 0.95 and shown["where"]["path"] == "structure"
    assert verdict.shrinkage.ci95[0] <= verdict.shrinkage.overall <= verdict.shrinkage.ci95[1]
    assert shown["where"]["amplitude_dependent"]
    for shift, located in ((0.0, True), (0.1, False)):
        place = replace(verdict.where.place, at=told["at"] - shift * case.rig.modes.length)
        assert replace(verdict, where=replace(verdict.where, place=place)).is_located == located


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "kinds"),
    [
        (1365775580, ("bouc_wen", "cubic_spring")),  # motions that run apart
        (1419681537, ("ground_spring", "cubic_spring")),  # found as a hysteretic spring that never yields
        (540003792, ("one_sided_stop", "cubic_spring")),  # found beside the better half of a near miss
    ],
)
def test_hard_pairs_are_named_and_placed(seed, kinds):
    case, label = make_trial(seed, kinds=kinds)
    assert tuple(e["kind"] for e in label["effects"]) == kinds
    verdict = verdict_on(case)
    assert verdict.outcome == "explained"
    told = {e.kind.name: e.values["at"] for e in verdict.effects}
    assert told == {e["kind"]: pytest.approx(e["at"], abs=0.005 * case.rig.modes.length) for e in label["effects"]}


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "exponent"), [("quadratic_spring", 2.0), ("cubic_damper", 3.0)])
def test_a_law_beyond_the_catalogue_is_unknown_and_shown(kind, exponent):
    case, _ = make_trial(401, kinds=(kind,))
    verdict = verdict_on(case)
    (shown,) = verdict.to_json()["best_fit"]
    assert verdict.outcome == "unknown" and verdict.to_json()["effects"][0]["kind"] == "unknown"
    assert shown["parameters"]["exponent"] == pytest.approx(exponent, abs=0.05)
    assert "power-law" in verdict.sentence and verdict.shrinkage.overall > 0.95
    assert shown["at"] == pytest.approx(verdict.where.at, abs=0.05 * case.rig.modes.length)


@pytest.mark.slow
def test_a_weak_law_beyond_the_catalogue_does_not_pass_for_one_of_it():
    """A clearance leaves no more than the noise here; a power of the displacement is likelier by far."""
    case, _ = make_trial(441050, kinds=("quadratic_spring",))
    verdict = verdict_on(case)
    (shown,) = verdict.to_json()["best_fit"]
    assert verdict.outcome == "unknown" and shown["parameters"]["exponent"] == pytest.approx(2.0, abs=0.1)
    assert verdict.alternatives[0][0] == "clearance"


@pytest.fixture(scope="module")
def nothing_hidden():
    return make_trial(3)[0]


@pytest.fixture(scope="module")
def quiet_verdict(nothing_hidden):
    return verdict_on(nothing_hidden, seconds=None)


def test_a_search_whose_time_is_spent_ends_with_what_it_has(nothing_hidden):
    """A drive that is ten times too strong is no error of a model, and no time to find that is a reason to say so.

    A process that works alone has the time of two.
    """
    drive = nothing_hidden.rig.actuators[0].name
    rig = kind_named("actuator_gain").apply(nothing_hidden.rig, drive, {"gain": 0.1})
    verdict = diagnose(rig, nothing_hidden.fit[:2], workers=1, seconds=1e-3)
    assert verdict.outcome in ("part", "unknown") and any("`seconds` 0.001;" in note for note in verdict.notes)
    assert verdict.sentence.startswith("None of the effects tried before the time limit explains the gap")


def test_nothing_hidden_nothing_told(quiet_verdict):
    verdict = quiet_verdict
    assert verdict.outcome == "none" and verdict.to_json()["effects"] == []


def test_a_rival_of_the_users_own_is_told_by_its_phrase(quiet_verdict):
    verdict = quiet_verdict
    mine = replace(kind_named("cubic_spring"), name="own_law", phrase="a quadratic spring")
    rival = replace(verdict.attribution.best, effects=(Effect(mine, None, {"at": 0.3, "stiffness": 1.0}),))
    rivals = ((rival, 0.2),)
    told = replace(
        verdict,
        outcome="explained",
        alternatives=(("own_law", 0.2),),
        attribution=replace(verdict.attribution, alternatives=rivals),
    )
    assert "a quadratic spring cannot be excluded" in told.sentence
    (shown,) = told.to_json()["alternatives"]
    assert shown == {"kind": "own_law", "words": "a quadratic spring", "probability": 0.2}


def quadratic(w, v, p):
    return -p[0] * w * abs(w)


@pytest.mark.slow  # the example in README.md is another, shorter one
def test_an_effect_of_the_users_own_joins_the_catalogue():
    mine = Kind(
        name="quadratic_spring",
        path="structure",
        nonlinear=True,
        parameters=lambda rig, _: (
            *place_parameters(rig),
            Parameter("stiffness", "N/m^2", 1e-9, 1e9, logarithmic=True),
        ),
        apply=lambda rig, _, v: with_element(rig, UserLaw(v["at"], quadratic, (v["stiffness"],))),
        starts=lambda reconstruction, _: [
            {"at": p.at, "stiffness": k} for p in reconstruction.at_peaks for k in (0.01, 0.1, 1.0)
        ],
    )
    case, _ = make_trial(13)
    true = Effect(mine, None, {"at": 0.37 * case.rig.modes.length, "stiffness": 0.2})
    noise = np.array([s.noise_std for s in case.rig.sensors])
    plain = FitData(case.fit, noise, substeps=16)
    rng = np.random.default_rng(0)
    hidden = [
        replace(r, outputs=p + noise[:, None] * rng.standard_normal(p.shape))
        for r, p in zip(case.fit, plain.predictions(true.apply(case.rig)), strict=True)
    ]
    start = Effect(mine, None, {"at": 0.4 * case.rig.modes.length, "stiffness": 0.05})
    found = fit(case.rig, (start,), FitData(tuple(hidden), noise, substeps=8))
    assert found.cost < 1.02
    assert found.effects[0].values["stiffness"] == pytest.approx(0.2, rel=0.05)
    assert mine.name not in {kind.name for kind in CATALOGUE}


@pytest.mark.slow
def test_standard_deviations_are_true():
    """Fits of many noisy copies scatter as one fit says they do."""
    case, _ = make_trial(14)
    spring = kind_named("ground_spring")
    true = Effect(spring, None, {"at": 0.3 * case.rig.modes.length, "stiffness": 0.02 * case.rig.modes.omega[1] ** 2})
    noise = np.array([s.noise_std for s in case.rig.sensors])
    data = FitData(case.fit[:2], noise)
    clean = data.predictions(true.apply(case.rig))
    errors = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        noisy = [
            replace(r, outputs=p + noise[:, None] * rng.standard_normal(p.shape))
            for r, p in zip(data.records, clean, strict=True)
        ]
        found = fit(case.rig, (true,), FitData(tuple(noisy), noise)).effects[0]
        errors.append([(found.values[n] - true.values[n]) / found.std[n] for n in ("at", "stiffness")])
    spread = np.std(errors, axis=0)
    assert (spread > 0.6).all() and (spread < 1.5).all()


def pair_on(rig, record_of, levels=(0.3, 1.0)):
    """Records of a beam with a cubic spring and a delayed actuator."""
    rng = np.random.default_rng(5)
    real = kind_named("cubic_spring").apply(rig, None, {"at": 0.62, "stiffness": 2000.0})
    real = kind_named("actuator_delay").apply(real, "all", {"delay": 0.02})
    commands = [level * np.repeat(rng.normal(size=40), 10)[None] for level in levels]
    return [record_of(real, command, rng, name=f"r{i}") for i, command in enumerate(commands)]


def test_a_clean_pair_is_found_before_errors_of_the_model_are_asked_for(hinged_rig, record_of):
    rig, told = hinged_rig(3), []
    fitted, kept = pair_on(rig, record_of)
    catalogue = tuple(kind_named(n) for n in ("actuator_delay", "cubic_spring", "modal_damping", "point_mass"))
    report = lambda text, share: told.append(text)  # noqa: E731
    verdict = diagnose(rig, [fitted], validation=[kept], catalogue=catalogue, progress=report, workers=1)
    assert verdict.outcome == "explained"
    assert {effect.kind.name for effect in verdict.effects} == {"actuator_delay", "cubic_spring"}
    assert "all pairs at once" in told and not any("small errors" in text for text in told)


@pytest.mark.slow
def test_a_nearest_set_that_makes_the_gap_of_others_larger_corrects_nothing(hinged_rig, record_of):
    """A mass that is no part of it bends to what is there, and the record held out is of another beam."""
    rig, rng = hinged_rig(3), np.random.default_rng(3)
    fitted, _ = pair_on(rig, record_of)
    kept = record_of(rig, 0.5 * np.repeat(rng.normal(size=40), 10)[None], rng, name="kept")
    verdict = diagnose(rig, [fitted], validation=[kept], catalogue=(kind_named("point_mass"),), workers=1)
    assert verdict.outcome == "unknown"
    assert verdict.effects == () and verdict.corrected is verdict.nominal
    assert verdict.shrinkage.after == verdict.shrinkage.before


def test_validation_records_never_reach_the_search(hinged_rig, record_of):
    """Spoilt validation records change the shrinkage and nothing else."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    real = kind_named("actuator_gain").apply(rig, rig.actuators[0].name, {"gain": 1.2})
    commands = [level * np.repeat(rng.normal(size=40), 10)[None] for level in (0.3, 1.0)]
    fitted, kept = (record_of(real, command, rng, name=f"r{i}") for i, command in enumerate(commands))
    catalogue = tuple(kind_named(n) for n in ("actuator_gain", "modal_damping"))
    honest, other = (
        diagnose(rig, (fitted,), validation=(record,), catalogue=catalogue)
        for record in (kept, replace(kept, outputs=3.0 * kept.outputs))
    )
    assert honest.effects[0].values == other.effects[0].values
    assert honest.shrinkage.overall > other.shrinkage.overall


def test_records_that_cannot_be_of_the_rig_are_refused(nothing_hidden):
    case = nothing_hidden
    turned = [replace(r, outputs=r.outputs * np.r_[-1.0, np.ones(r.n_outputs - 1)][:, None]) for r in case.fit]
    with pytest.raises(RecordsError, match="wrong sign"):
        diagnose(case.rig, turned)
    millimetres = [replace(r, outputs=r.outputs * np.r_[1e3, np.ones(r.n_outputs - 1)][:, None]) for r in case.fit]
    with pytest.raises(RecordsError, match=r"about 1000 times what the model predicts in every record: is it in"):
        diagnose(case.rig, millimetres)
    with pytest.raises(RecordsError, match=r"outputs read about 0.001 times the prediction of the model"):
        diagnose(case.rig, [replace(r, inputs=r.inputs * 1e3) for r in case.fit])
    with pytest.raises(ValueError, match="in that order"):
        diagnose(Rig(case.rig.modes, case.rig.actuators, case.rig.sensors[1:]), case.fit)
    with pytest.raises(ValueError, match="at least one record"):
        diagnose(case.rig, ())


def test_no_gap_is_told_only_where_records_held_out_have_none_either(hinged_rig, record_of):
    """At a low level nothing touches a stop that a loud record reaches; two outputs of another one are exchanged."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    commands = np.repeat(rng.normal(size=40), 10)[None]
    low = record_of(rig, 0.3 * commands, rng, name="low")
    touched = replace(rig, elements=(OneSidedStop(0.7, 2000.0, 1.2 * float(np.abs(low.outputs).max())),))
    commands = np.repeat(rng.normal(size=40), 10)[None]
    is_settled, loud = (record_of(touched, level * commands, rng, name=f"at {level}") for level in (0.2, 2.0))
    crossed = replace(is_settled, outputs=is_settled.outputs[[2, 1, 0, 3]], name="crossed")
    gain = (kind_named("actuator_gain"),)
    for held, disagreeing in (((is_settled,), ()), ((is_settled, loud), ("at 2.0",)), ((crossed,), ("crossed",))):
        verdict = diagnose(rig, [low], validation=held, catalogue=gain, workers=1)
        assert verdict.disagreeing == disagreeing and verdict.outcome == ("unknown" if disagreeing else "none")
        assert verdict.effects == () and not verdict.shows_gap
        if disagreeing:
            share = f"{100 * verdict.shrinkage.after[disagreeing[0]]:.0f} %"
            assert verdict.sentence == (
                "In the records that were fitted, there is no gap beyond the noise of the sensors; but the residual of"
                f" validation record {disagreeing[0]} is {share} of its signal: include it in the fit."
            )
    assert verdict.notes == ("In validation record crossed, the outputs d1 and d3 are exchanged: swap them.",)


def test_a_fault_of_a_record_held_out_is_not_called_over_fitting(hinged_rig, record_of):
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    real = kind_named("actuator_gain").apply(rig, rig.actuators[0].name, {"gain": 1.2})
    commands = [np.repeat(rng.normal(size=40), 10)[None] for _ in range(2)]
    fitted, kept = (record_of(real, command, rng, name=f"r{i}") for i, command in enumerate(commands))
    crossed = replace(kept, outputs=kept.outputs[[2, 1, 0, 3]])
    verdict = diagnose(rig, [fitted], validation=[crossed], catalogue=(kind_named("actuator_gain"),), workers=1)
    assert verdict.outcome == "part" and "exchanged" in verdict.notes[0]
    assert not any("over-fitting" in note for note in verdict.notes)


def test_wires_that_are_surely_exchanged_are_put_right_before_the_search(hinged_rig, record_of):
    """An effect of a sensor is told of the sensor itself, not of the channel that it was read from."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    gain = Effect(kind_named("sensor_gain"), rig.sensors[0].name, {"gain": 1.3})
    exchange = Effect(kind_named("swapped_outputs"), (rig.sensors[0].name, rig.sensors[2].name), {})
    real = apply_all(rig, (gain, exchange))
    commands = [level * np.repeat(rng.normal(size=40), 10)[None] for level in (0.3, 1.0)]
    fitted, kept = (record_of(real, command, rng, name=f"r{i}") for i, command in enumerate(commands))
    both = (gain.kind, exchange.kind)
    verdict = diagnose(rig, fitted, validation=kept, catalogue=both, workers=1)
    assert verdict.outcome == "explained" and [e.label for e in verdict.effects] == [gain.label, exchange.label]
    assert verdict.effects[0].values["gain"] == pytest.approx(1.3, rel=1e-3)
    assert verdict.shrinkage.overall > 0.95 and sum(verdict.budget.effects.values()) > 0.95
    assert [f.effects[0].kind for f in verdict.attribution.tried] == [gain.kind]  # the exchange was not searched for
    assert [f.labels for f in verdict.attribution.singles] == [(exchange.label,), (gain.label, exchange.label)]
    assert plot_single_effects(verdict).axes[0].get_title("left") == "best fit of each effect with the exchange"
    one = diagnose(rig, fitted, validation=replace(kept, outputs=kept.outputs[[2, 1, 0, 3]]), catalogue=both, workers=1)
    assert exchange.kind in {f.effects[0].kind for f in one.attribution.tried}  # not in every record, so it is
    without = diagnose(rig, fitted, validation=kept, catalogue=(gain.kind,), workers=1)
    assert exchange.kind not in {e.kind for e in without.effects}


@pytest.mark.parametrize("transient", [-1.0, 1e6, np.nan])
def test_a_time_to_settle_that_no_record_has_is_refused(nothing_hidden, transient):
    with pytest.raises(ValueError, match="transient must be 0 or more and less than the shortest record"):
        diagnose(nothing_hidden.rig, nothing_hidden.fit, transient=transient, workers=1)


@pytest.mark.parametrize(
    ("unexplained", "noise", "power", "much"),
    [(0.35, 0.0, 1.0, True), (0.03, 0.0, 1.0, False), (0.07, 0.9, 1.0, False), (0.35, 0.0, 2e-4, False)],
)
def test_a_set_that_leaves_more_than_a_few_per_cent_explains_the_gap_in_part(unexplained, noise, power, much):
    """By chance a tenth of the noise may be left beside it, and what is below the tolerance is not searched for."""
    shares = {"effects": {}, "nominal": 1.0 - unexplained - noise, "unexplained": unexplained, "noise": noise}
    assert _leaves_unexplained(Budget(**shares, by_record={"r": np.array([])}), power, 0.01) is much


def test_a_rest_of_the_model_is_noted_with_its_size_and_not_called_noise():
    """100 times the power of the noise is 10 times its rms; of a gap as large as the signal, 1e-5 are 0.32 % of it."""
    noise = {"noise_stated": (1.0,), "noise_found": (1.8,)}
    rest = Budget({}, 1.0 - 1.01e-5, 1e-5, 1e-7, {}, **noise)
    assert [*_of_residual(rest, 1.0, 0.01)] == [
        "The residual above the noise is 0.32 % of the signal, 10 times the noise: below the tolerance of 1 %, so its"
        " cause was not searched for."
    ]
    assert [note.endswith("an effect is missing.") for note in _of_residual(rest, 1.0, 0.001)] == [True]
    assert rest.noise_remark.startswith("What looks like noise is 1.8 times the model's noise_std; part of it may be")
    assert not [*_of_residual(Budget({}, 0.9, 0.04, 0.06, {}, **noise), 1.0, 0.01)]


@pytest.mark.parametrize(
    ("is_named", "closed", "outcome"),
    [(False, 0.9, "unknown"), (True, 0.0, "unknown"), (True, 0.3, "part"), (True, None, "part")],
)
def test_a_gap_is_explained_in_part_only_by_a_set_that_closes_some_of_it(is_named, closed, outcome):
    """A search may have closed most of the fitted records' gap by a set that enlarges that of the record held out."""
    effects = (Effect(kind_named("modal_damping"), None, {"factor": 1.1}),) if is_named else ()
    found = SimpleNamespace(outcome="part", best=SimpleNamespace(effects=effects))
    shrinkage = None if closed is None else Shrinkage({}, {}, {}, {}, closed, (closed, closed))
    assert _outcome(found, shrinkage, np.zeros(1), ()) == outcome
