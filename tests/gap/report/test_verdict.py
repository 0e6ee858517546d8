"""What a verdict says where nothing is named."""

import re
from dataclasses import replace

import numpy as np
import pytest

from workbench.draw.gap import plot_budget
from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import NominalPrior, nominal_errors
from workbench.gap.report.budget import budget_of, measure, sizes_of
from workbench.gap.report.verdict import proportional_points
from workbench.rig.actuators import Actuator
from workbench.rig.elements import CubicSpring
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes
from workbench.study.pages.verdict_page import verdict_tables


@pytest.mark.parametrize("gain", [1.0, 1.006])
def test_a_gap_below_the_tolerance_is_said(hinged_rig, record_of, gain):
    """A gain of 1.006 alone makes a gap of 0.006 / 1.006 of every reading."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    real = kind_named("actuator_gain").apply(rig, rig.actuators[0].name, {"gain": gain})
    record = record_of(real, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    verdict = diagnose(rig, (record,), catalogue=(kind_named("actuator_gain"),))
    assert verdict.outcome == "none" and not verdict.effects
    if gain == 1.0:
        assert verdict.sentence == "There is no gap beyond the noise of the sensors."
        return
    told = re.fullmatch(
        r"The gap beyond the noise is ([\d.]+) % of the signal, below the tolerance of 1 %\.", verdict.sentence
    )
    assert float(told[1]) == pytest.approx(100 * 0.006 / 1.006, abs=0.06)


def test_noise_a_little_louder_than_stated_is_no_gap(hinged_rig, record_of):
    """A quarter louder, beside noise of a tenth of the signal at the low level: 6 % of that is unstated noise."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    inputs = np.repeat(rng.normal(size=200), 10)[None]
    inputs *= 10.0 * rig.sensors[0].noise_std / record_of(rig, inputs, rng).outputs.std()
    records = [record_of(rig, level * inputs, rng, name=name) for name, level in (("low", 1.0), ("high", 4.0))]
    quieter = tuple(replace(sensor, noise_std=sensor.noise_std / 1.25) for sensor in rig.sensors)
    channels = tuple(replace(channel, noise_std=channel.noise_std / 1.25) for channel in records[0].output_channels)
    stated = [replace(record, output_channels=channels) for record in records]
    verdict = diagnose(replace(rig, sensors=quieter), stated, catalogue=(kind_named("actuator_gain"),))
    assert verdict.where.beyond_noise > 0.05
    assert verdict.sentence == "There is no gap beyond the noise of the sensors."


@pytest.mark.parametrize(("share", "words"), [(0.0, "less than 0.1 %"), (4e-4, "less than 0.1 %"), (0.006, "0.6 %")])
def test_what_is_told_to_cause_next_to_nothing_is_not_said_to_cause_nothing(hinged_rig, record_of, share, words):
    """A sensor seen to clip is told although noise makes nearly all of the gap."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    record = record_of(rig, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    found = diagnose(rig, (record,), catalogue=(kind_named("actuator_gain"),))
    clipping = Effect(kind_named("sensor_clipping"), "d1", {"limit": 0.01}, {"limit": 0.0})
    budget = replace(found.budget, effects={clipping.label: share}, noise=1.0 - share)
    shown = replace(found, outcome="explained", effects=(clipping,), budget=budget)
    assert f"causes {words} of the gap" in shown.sentence


@pytest.mark.parametrize(
    ("delays", "words"),
    [
        ((0.4, 0.5, 0.45, 0.42), "all sensors, or the actuators, late by 4.4 ms"),
        ((-0.2, -0.2, -0.2, -0.2), "all sensors, or the actuators, early by 2 ms"),
        ((0.3, -0.2, 0.1, 0.0), "timing of sensors 1.9 ms"),
    ],
)
def test_a_delay_of_all_sensors_may_be_one_of_the_actuators(hinged_rig, record_of, delays, words):
    """In open loop the records of both are the same."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    record = record_of(rig, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    prior = NominalPrior(delay=0.1, sample_time=0.01)
    late = {f"delay_{sensor.name}": delay for sensor, delay in zip(rig.sensors, delays, strict=True)}
    budget = budget_of(rig, (), nominal_errors(rig, prior, late), (record,), noise_found=np.full(4, 1e-5))
    found = diagnose(rig, (record,), catalogue=(kind_named("actuator_gain"),))
    shown = replace(found, budget=replace(budget, nominal=0.3), outcome="explained", effects=())
    assert words in shown.sentence


def test_delays_far_below_a_sample_are_not_reported(hinged_rig):
    rig, prior = hinged_rig(3), NominalPrior(delay=0.1, sample_time=0.01)
    names = [f"delay_{sensor.name}" for sensor in rig.sensors]
    assert sizes_of(nominal_errors(rig, prior, dict.fromkeys(names, 5e-4))) == {}
    late = sizes_of(nominal_errors(rig, prior, dict(zip(names, (2e-3, 0.0, 0.0, 0.0), strict=True))))
    assert late["delays_ms"] == pytest.approx(10.0 * 2e-3 / 2.0)


@pytest.mark.parametrize(
    ("errors", "small"),
    [
        ({"stiffness_percent": 4.0, "mass_percent": 4.0, "damping_percent": 60.0, "delays_ms": 3.0}, True),
        ({"stiffness_percent": 5.5, "mass_percent": 1.0}, False),
        ({"damping_percent": 97.0}, False),
        ({}, True),
    ],
)
def test_errors_that_no_careful_model_has_are_not_called_small(hinged_rig, record_of, errors, small):
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    real = kind_named("actuator_gain").apply(rig, rig.actuators[0].name, {"gain": 1.3})
    record = record_of(real, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    found = diagnose(rig, (record,), catalogue=(kind_named("actuator_gain"),))
    sentence = replace(found, budget=replace(found.budget, nominal=0.3, errors=errors)).sentence
    assert ("small errors of the model" in sentence) is small and (
        "implausibly large errors of the model" in sentence
    ) != small


@pytest.mark.parametrize(
    ("nominal", "rest"),
    [(0.93, "93 % is due to small errors of the model (damping 9 %), 7.0 % remains"), (0.0, "100 % remains")],
)
def test_what_errors_close_is_said_where_no_effect_is_near(hinged_rig, record_of, nominal, rest):
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    record = record_of(rig, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    found = diagnose(rig, (record,), catalogue=(kind_named("actuator_gain"),))
    shares = {"nominal": nominal, "unexplained": 1.0 - nominal, "noise": 0.0}
    budget = replace(found.budget, **shares, errors={"damping_percent": 9.0})
    sentence = replace(found, budget=budget, outcome="unknown", effects=()).sentence
    assert sentence == f"No effect of the catalogue, alone or with another, explains the gap; {rest} unexplained."


def test_effects_of_one_kind_have_shares_of_their_own(hinged_rig, record_of):
    """Two masses: what each takes away stands beside its place, and all shares sum to one."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    masses = [
        Effect(kind_named("point_mass"), None, {"at": at, "mass": mass}) for at, mass in ((0.4, 0.05), (1.5, 0.01))
    ]
    record = record_of(apply_all(rig, masses), np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    budget = budget_of(rig, masses, None, (record,), noise_found=np.full(4, 1e-5))
    assert list(budget.effects) == ["point_mass[x = 0.4]", "point_mass[x = 1.5]"]
    assert budget.effects["point_mass[x = 0.4]"] > 2.0 * budget.effects["point_mass[x = 1.5]"] > 0.0
    assert sum(budget.effects.values()) + budget.unexplained + budget.noise == pytest.approx(1.0)
    assert budget.to_json()["effects"] == {"point_mass": pytest.approx(sum(budget.effects.values()), abs=1e-5)}


def test_what_is_closed_of_one_record_is_its_share_however_it_falls_into_blocks(hinged_rig, record_of):
    """A last block of a few samples weighs no more than they are."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    gain = kind_named("actuator_gain")
    real, near = (gain.apply(rig, rig.actuators[0].name, {"gain": value}) for value in (1.3, 1.2))
    inputs = np.repeat(rng.normal(size=40), 10)[None]
    inputs[:, -30:] *= 20.0
    closed = measure(rig, near, [record_of(real, inputs[:, :-7], rng, name="held out")])
    assert closed.overall == pytest.approx(closed.share["held out"], rel=1e-12)


def test_noise_of_the_logged_inputs_is_told_apart(hinged_rig, record_of):
    """The inputs were logged with noise of 5 %, and the sensors' noise is a tenth of what that makes."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    sent = np.repeat(rng.normal(size=(1, 400)), 10, axis=1)
    records = []
    for name in ("fit", "held out"):
        clean = record_of(rig, sent, rng, name=name)
        records.append(replace(clean, inputs=sent + 0.05 * sent.std() * rng.normal(size=sent.shape)))
    found = diagnose(rig, records[:1], validation=records[1:], catalogue=(kind_named("actuator_gain"),), seconds=0.3)
    budget = budget_of(rig, (), None, records[1:], noise_found=np.full(4, 1e-5), logged=0.05)
    assert budget.nominal == pytest.approx(budget.input_noise["held out"]) and budget.nominal > 0.8
    labels = [text.get_text() for text in plot_budget(budget).axes[0].get_legend().get_texts()]
    assert "noise of the logged inputs" in labels and "errors of the nominal model" not in labels
    shown = replace(found, budget=budget, outcome="none", effects=())
    gap, (line,) = shown.to_json()["gap"], (line for line in str(shown).splitlines() if "'held out'" in line)
    assert gap["input_noise"]["held out"] ** 2 == pytest.approx(
        gap["before"]["held out"] ** 2 * budget.nominal, rel=1e-4
    )
    told = re.fullmatch(r"  record 'held out': rms error / rms signal ([\d.]+) %, noise floor ([\d.]+) %; (.*)", line)
    assert float(told[1]) == pytest.approx(100.0 * gap["before"]["held out"], rel=5e-3)
    assert told[3] == "the rest is noise of the logged inputs, which no model predicts"
    plain = replace(shown, budget=replace(budget, input_noise={}))
    assert "logged" not in str(plain) and "input_noise" not in plain.to_json()["gap"]


def test_a_verdict_prints_as_the_command_tells_it(hinged_rig, record_of):
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    real = kind_named("actuator_gain").apply(rig, rig.actuators[0].name, {"gain": 1.3})
    records = [record_of(real, np.repeat(rng.normal(size=40), 10)[None], rng, name=name) for name in ("fit", "check")]
    gain = (kind_named("actuator_gain"),)
    verdict = diagnose(rig, records[:1], validation=records[1:], catalogue=gain, workers=1)
    verdict = replace(verdict, notes=("A note.",))
    first, path, modes, *_, record, last = str(verdict).splitlines()
    assert first == verdict.sentence and last == "  A note."
    assert path.startswith("  subsystem  actuator") and modes.startswith("  modes      ")
    told = re.fullmatch(r"  record 'check': rms error / rms signal (.*) % → [\d.]+ %, noise floor [\d.]+ %", record)
    read = records[1].outputs
    expected = 0.3 / 1.3 * np.sqrt(np.mean((read / read.std(axis=1, keepdims=True)) ** 2))
    assert float(told[1]) == pytest.approx(100.0 * expected, rel=5e-3)
    assert repr(verdict) == f"<Verdict on case: {verdict.sentence}>"


def test_errors_beside_a_gap_that_is_still_there_have_no_sizes(hinged_rig, record_of):
    """The model lacks what is above its last mode, which no error of the two that it has takes away."""
    rig, rng = hinged_rig(2), np.random.default_rng(5)
    record = record_of(hinged_rig(4), np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    found = diagnose(rig, (record,), catalogue=(kind_named("actuator_gain"),), workers=1, seconds=2.0)
    assert any(re.search(r"of the gap lies above the last mode of the model \(3\.14\d? Hz\)", n) for n in found.notes)
    shares = {"nominal": 0.16, "unexplained": 0.84, "noise": 0.0}
    budget = replace(found.budget, **shares, errors={"damping_percent": 32.0})
    sentence = replace(found, budget=budget, outcome="unknown", effects=()).sentence
    assert sentence.endswith("explains the gap; 16 % may be due to errors of the model, 84 % remains unexplained.")


def test_noise_that_was_not_stated_is_not_said_to_be(hinged_rig, record_of):
    """And noise found at the bound of what any is taken for may be less."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    record = record_of(rig, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    silent = replace(rig, sensors=(*rig.sensors[:3], replace(rig.sensors[3], noise_std=0.0)))
    found = diagnose(silent, (record,), catalogue=(kind_named("actuator_gain"),), workers=1)
    stated = found.budget.noise_stated
    budget = replace(found.budget, noise_found=(stated[0], 3.0 * stated[1], 400.0 * stated[2], 1.2 * stated[3]))
    told = replace(found, budget=budget).to_json()["noise"]
    assert told["stated"] == [1e-5, 1e-5, 1e-5, None]
    assert told["found_at_most"] == [False, True, True, False]


def test_shares_of_a_set_that_enlarges_a_gap_are_drawn_beyond_the_whole(hinged_rig, record_of):
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    gain = kind_named("actuator_gain")
    real, wrong = (Effect(gain, rig.actuators[0].name, {"gain": value}) for value in (1.3, 0.7))
    record = record_of(real.apply(rig), np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    budget = budget_of(rig, (wrong,), None, (record,), noise_found=np.full(4, 1e-5))
    assert budget.by_record["high"].sum() == pytest.approx(4.0, rel=1e-3)  # twice the error
    assert plot_budget(budget).axes[0].get_xlim()[1] == pytest.approx(400.0, rel=1e-3)


@pytest.mark.parametrize(
    ("kind", "title"),
    [("point_mass", "Best-fitting effects: they do not explain the gap"), ("power_spring", "Effects")],
)
def test_a_nearest_set_is_headed_as_one_that_does_not_explain(kind, title):
    content = {"effects": [], "best_fit": [{"kind": kind, "parameters": {"mass": 1.0}}], "alternatives": []}
    gap = {"before": {}, "after": {}, "floor": {}}
    assert verdict_tables({**content, "gap": gap})[0][0] == title


def test_the_probability_of_the_set_named_and_of_its_alternatives_sum_to_one(hinged_rig, record_of):
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    found = diagnose(
        rig, (record_of(rig, np.repeat(rng.normal(size=40), 10)[None], rng, name="high"),),
        catalogue=(kind_named("actuator_gain"),),
    )  # fmt: skip
    search = replace(found.attribution, alternatives=((found.attribution.best, 0.4),))
    shown = replace(found, outcome="explained", alternatives=(("a", 0.4),), attribution=search)
    assert shown.probability == pytest.approx(0.6) and shown.to_json()["probability"] == 0.6
    assert found.to_json()["probability"] is None
    assert dict(verdict_tables(shown.to_json())[-1][2])["selected set"] == 0.6


def test_clipping_of_all_sensors_is_one_effect_only_where_their_limits_have_one_unit(hinged_rig, record_of):
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    record = record_of(rig, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    found = diagnose(rig, (record,), catalogue=(kind_named("actuator_gain"),))
    each = tuple(
        Effect(kind_named("sensor_clipping"), s.name, {"limit": 0.01 * (i + 1)}) for i, s in enumerate(rig.sensors)
    )
    shown = replace(found, outcome="part", effects=each)
    assert "clipping of a sensor (all: limit 0.025 m)" in shown.sentence
    mixed = (replace(rig.sensors[0], quantity="acceleration"), *rig.sensors[1:])
    named = replace(shown, nominal=replace(rig, sensors=mixed)).to_json()["best_fit"]
    assert [(e["output"], e["parameters"]["limit"]) for e in named] == [(f"d{i}", 0.01 * i) for i in (1, 2, 3, 4)]


def test_a_single_force_that_leaves_little_beyond_the_noise_is_not_said_to_explain_all(hinged_rig, record_of):
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    record = record_of(rig, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    found = diagnose(rig, (record,), catalogue=(kind_named("actuator_gain"),))
    told = (
        (0.99995, "the residual is 0.7 % of the gap's rms, more than noise"),
        (0.97, "the residual is 17 % of its rms"),
    )
    for share, words in told:  # the rms, as of what effects close in the sentence
        place = replace(found.where.place, share=share, is_single_force=False)
        assert replace(found, where=replace(found.where, place=place)).location_in_words.endswith(words)


def test_the_place_of_a_single_force_is_not_told_beside_another_place_that_explains_the_gap(hinged_rig, record_of):
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    record = record_of(rig, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    found = diagnose(rig, (record,), catalogue=(kind_named("actuator_gain"),))
    place = replace(found.where.place, share=0.995, is_single_force=False, at=0.9, at_std=0.01)
    found = replace(found, outcome="explained", where=replace(found.where, place=place))
    spring = kind_named("cubic_spring")
    for at, is_told in ((0.9, True), (0.4, False)):
        shown = replace(found, effects=(Effect(spring, None, {"at": at, "stiffness": 1.0}),))
        assert bool(shown.location_in_words) is is_told
    assert replace(shown, outcome="part").location_in_words, "the effects do not explain the gap"


@pytest.mark.parametrize(
    ("shapes", "alike"),
    [
        ([[1.0], [0.7], [-0.4]], ("P2", "P3")),
        ([[1.0], [1.0], [0.0]], ()),  # P2 moves as P1 does, and P3 not at all
        ([[1.0, 0.6], [0.5, 0.3], [0.4, 1.1]], ("P2",)),
        ([[1.0, 0.6], [0.7, -0.9], [0.4, 1.1]], ()),
    ],
)
def test_points_that_move_in_proportion_are_said_to_fit_as_well(shapes, alike):
    omega = np.array([50.0, 132.0])[: len(shapes[0])]
    points = NamedPoints(("P1", "P2", "P3"))
    modes = Modes(omega=omega, damping=np.diag(0.02 * omega), shapes=PointShapes(np.array(shapes)), domain=points)
    assert proportional_points("P1", modes) == alike
    rig = Rig(modes, (Actuator("F", "P1"),), (Sensor("w1", "P1", noise_std=1e-5),))
    real, rng = replace(rig, elements=(CubicSpring("P1", 1e8),)), np.random.default_rng(3)
    records = []
    for level in (1.0, 3.0):
        record = simulate(real, level * np.repeat(rng.normal(size=(1, 100)), 5, axis=1), sample_time=0.002)
        read = record.outputs + 1e-5 * rng.normal(size=record.outputs.shape)
        records.append(replace(record, outputs=read, name=f"{level:g} N"))
    verdict = diagnose(rig, records, catalogue=(kind_named("cubic_spring"),))
    (effect,) = verdict.to_json()["effects"]
    if effect["at"] == "P1":
        assert effect.get("or_at", []) == list(alike)
        assert ("at P1 (or in proportion at P2" in verdict.sentence) == bool(alike)
    else:
        assert "P1" in effect["or_at"]
