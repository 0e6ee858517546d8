"""Blind trials: what is made is what the label says, the labels are out of reach, and scores count rightly."""

import json
import tempfile
from collections import Counter

import numpy as np
import pytest

from workbench.cases.case import Case, read_case
from workbench.gap.effects.catalogue import CATALOGUE
from workbench.gap.effects.effect import Effect, apply_all, place_values
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints
from workbench.structure.member import Bar
from workbench.structure.modes import Modes, PointShapes
from workbench.trials.hidden import place_of
from workbench.trials.hold import COMMON_KINDS, RARE_KINDS, draw_kinds, hold_trials, write_trials
from workbench.trials.make import KINDS, OUTSIDE_KINDS, make_trial
from workbench.trials.scoring import score, statistics

QUICK = (
    (6, ("clearance",)),  # on a beam
    (3, ("stiffness_drift", "sensor_gain")),  # on a rod, whose motion takes fewer steps
    (3, ()),
)
CHANNELS = ("kind", "input", "output", "with", "from")
BY_NAME = {kind.name: kind for kind in CATALOGUE}


def _effect(told: dict) -> Effect:
    """The catalogue's own effect with the numbers of a label."""
    values = {name: value for name, value in told.items() if name not in CHANNELS}
    target = told.get("input", told.get("output"))
    if "with" in told or "from" in told:
        target = (target, told.get("with", told.get("from")))
    if told["kind"] == "support_rotation":
        target = "left" if values.pop("at") == 0 else "right"
    if told["kind"] == "truncated_modes":
        target, values = values["needed"], {}
    return Effect(BY_NAME[told["kind"]], target, values)


def _check_against_predictor(kinds: tuple[str, ...], seed: int) -> None:
    """The predictor of the diagnosis, given what the label tells, leaves what the truth itself leaves: the noise."""
    case, label = make_trial(seed, kinds=kinds)
    told = [e for e in label["effects"] if e["kind"] != "none"]
    assert sorted(e["kind"] for e in told) == sorted(kinds)
    rig = apply_all(case.rig, [_effect(e) for e in told])
    for record in (*case.fit, *case.validation):
        figures = label["records"][record.name]
        for one, name in ((case.rig, "gap"), (rig, "true_model")):
            predicted = simulate(one, record.inputs, sample_time=record.sample_time, substeps=16).outputs
            spread = record.outputs.std(axis=1, keepdims=True)
            gap = np.sqrt(np.mean(((record.outputs - predicted) / spread) ** 2))
            assert gap == pytest.approx(figures[name], rel=0.03), (record.name, name)
        if "sensor_quantisation" not in kinds and "sensor_clipping" not in kinds:
            assert figures["true_model"] == pytest.approx(figures["noise_floor"], rel=0.05)
    if kinds and "sensor_quantisation" not in kinds:
        assert max(f["gap"] / f["noise_floor"] for f in label["records"].values()) > 2.0


@pytest.mark.parametrize(("seed", "kinds"), QUICK)
def test_two_numerical_routes_agree(seed, kinds):
    _check_against_predictor(kinds, seed)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "random_disturbance"])
@pytest.mark.parametrize("seed", [21, 22])
def test_two_numerical_routes_agree_of_every_kind(kind, seed):
    _check_against_predictor((kind,), seed)


@pytest.mark.slow
def test_a_random_disturbance_is_another_one_in_every_record():
    case, label = make_trial(5, kinds=("random_disturbance",))
    for figures in label["records"].values():
        assert figures["true_model"] == pytest.approx(figures["gap"], rel=1e-6)
    assert any(figures["gap"] > 2.0 * figures["noise_floor"] for figures in label["records"].values())
    left = [r.outputs[0] - simulate(case.rig, r.inputs, sample_time=r.sample_time).outputs[0] for r in case.fit[:3]]
    correlation = np.corrcoef(left)
    assert np.abs(correlation - np.eye(3)).max() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("kind", OUTSIDE_KINDS)
def test_what_is_outside_the_vocabulary_is_labelled_unknown(kind):
    _, label = make_trial(7, kinds=(kind,))
    assert label["effects"] == [{"kind": "unknown", "outside": kind}]
    assert max(f["gap"] / f["noise_floor"] for f in label["records"].values()) > 2.0


def test_a_seed_makes_a_case():
    first, again, other = (make_trial(seed, kinds=("sensor_bias",)) for seed in (3, 3, 7))
    assert first[1] == again[1] != other[1]
    np.testing.assert_array_equal(first[0].fit[0].outputs, again[0].fit[0].outputs)


ON_MODAL_DATA = ("point_mass", "cubic_spring", "actuator_gain", "sensor_misplacement", "modulus_error")


@pytest.mark.parametrize("kind", ON_MODAL_DATA)
def test_trials_on_plain_modal_data_use_its_levels_and_places(kind):
    rng = np.random.default_rng(1)
    points, shapes = NamedPoints(("F1", "F2", "d1", "d2", "d3")), PointShapes(rng.standard_normal((5, 3)))
    modes = Modes(omega=np.array([3.0, 7.0, 16.0]), damping=np.full(3, 0.01), shapes=shapes, domain=points)
    sensors = tuple(Sensor(name, name, noise_std=2e-4) for name in ("d1", "d2", "d3"))
    rig = Rig(modes, (Actuator("F1", "F1"), Actuator("F2", "F2")), sensors)
    inputs = 0.3 * rng.standard_normal((2, 600))
    mine = Case("mine", rig, (simulate(rig, inputs, sample_time=0.05, name="high"),), ())
    case, label = make_trial(6, kinds=(kind,), like=mine)
    (told,) = label["effects"]
    assert told.get("at", "F1") in points.names
    high = next(r for r in case.fit if r.name == "high")
    np.testing.assert_allclose(np.sqrt(np.mean(high.inputs**2, axis=1)), np.sqrt(np.mean(inputs**2, axis=1)).max())
    assert high.sample_time == 0.05 and [s.noise_std for s in case.rig.sensors] == [2e-4] * 3
    rig = apply_all(case.rig, [_effect(told)])
    predicted = simulate(rig, high.inputs, sample_time=0.05, substeps=16).outputs
    assert np.sqrt(np.mean((high.outputs - predicted) ** 2)) == pytest.approx(2e-4, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("structure", "seed"), [("plates", 1), ("frames", 1)])
def test_friction_of_two_directions_shows_in_the_records_that_it_hides_in(structure, seed):
    case, label = make_trial(seed, kinds=("two_way_friction",), structure=structure)
    (told,) = label["effects"]
    place, speed = place_values(place_of(told)), told["smoothing_speed"]
    forces = told["force_forward"], told["force_backward"]
    kinds = BY_NAME["two_way_friction"], BY_NAME["coulomb_friction"]
    numbers = dict(zip(("force_forward", "force_backward"), forces, strict=True)), {"force": float(np.mean(forces))}
    both, mean = (
        apply_all(case.rig, [Effect(kind, None, {**place, **own, "smoothing_speed": speed})])
        for kind, own in zip(kinds, numbers, strict=True)
    )
    noise = np.array([[sensor.noise_std] for sensor in case.rig.sensors])
    squares = []
    for record in case.fit:
        y, without = (
            simulate(r, record.inputs, sample_time=record.sample_time, substeps=8).outputs for r in (both, mean)
        )
        squares.append(np.mean(((y - without) / noise) ** 2))
    assert np.sqrt(np.mean(squares)) > 0.095


def test_an_unknown_kind_is_refused():
    with pytest.raises(ValueError, match="gremlin"):
        make_trial(1, kinds=("gremlin",))


@pytest.mark.slow
def test_a_bench_that_cannot_show_a_kind_says_so():
    damping = ModalDamping(0.01)
    rod = Bar(length=1.0, mass_per_length=1.0, axial_stiffness=1.0, left="fixed", right="free", damping=damping)
    sensors = (Sensor("d1", 1.0, noise_std=1e-3),)
    rig = Rig(rod.modes(4), (Actuator("F1", 0.4), Actuator("F2", 0.9)), sensors, structure=rod)
    inputs = np.random.default_rng(0).standard_normal((2, 500))
    like = Case("rod", rig, (simulate(rig, inputs, sample_time=0.05, name="high"),), ())
    with pytest.raises(ValueError, match="axial_load could be generated on this bench"):
        make_trial(2, kinds=("axial_load",), like=like)


def test_of_sixty_forty_hide_one_ten_a_pair_five_none_five_something_else():
    drawn = draw_kinds(120, 1)
    sizes = Counter("rare" if set(k) & set(RARE_KINDS) else len(k) for k in drawn)
    assert sizes == {1: 80, 2: 20, 0: 10, "rare": 10}
    assert {k for kinds in drawn if len(kinds) == 1 for k in kinds} >= set(COMMON_KINDS), "every kind stands alone once"
    assert {*COMMON_KINDS, *RARE_KINDS} == {*KINDS, *OUTSIDE_KINDS}


def test_a_seed_draws_what_it_drew():
    """Results of earlier seeds stay comparable when a kind enters the vocabulary."""
    drawn = draw_kinds(200, 845211)
    assert [i for i, kinds in enumerate(drawn) if kinds == ("actuator_crosstalk",)] == [95, 146]
    first = [
        (),
        ("periodic_disturbance", "random_disturbance"),
        ("actuator_bias", "sensor_bias"),
        ("periodic_disturbance",),
    ]
    assert drawn[:4] == first


def test_an_unknown_kind_is_not_replaced_by_another(tmp_path):
    with pytest.raises(ValueError, match="kind 'cross_talk' is neither in the vocabulary"):
        write_trials(tmp_path / "cases", tmp_path / "labels.json", 2, 1, kinds=[(), ("cross_talk",)])


@pytest.mark.slow
def test_labels_lie_outside_the_cases(tmp_path):
    with pytest.raises(ValueError, match="give another folder"):
        write_trials(tmp_path / "cases", tmp_path / "cases" / "labels.json", 1, 1)
    write_trials(tmp_path / "cases", tmp_path / "labels.json", 2, 7, kinds=[(), ("sensor_gain",)])
    labels = json.loads((tmp_path / "labels.json").read_text(encoding="utf-8"))
    assert [e["kind"] for e in labels["case-002"]["effects"]] == ["sensor_gain"]
    for folder in (tmp_path / "cases").iterdir():
        written = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
        assert written <= {"case.toml", *(f"records/{r}.npz" for r in labels[folder.name]["records"])}
        assert "sensor_gain" not in (folder / "case.toml").read_text(encoding="utf-8")
        case = read_case(folder)
        assert {r.name for r in (*case.fit, *case.validation)} == set(labels[folder.name]["records"])
        assert [r.name for r in case.validation] == ["validate"]


def test_the_labels_are_gone_from_the_disk_when_a_diagnosis_runs(tmp_path, monkeypatch):
    vault, seen = tmp_path, []
    monkeypatch.setattr(tempfile, "tempdir", str(vault))

    def guess(folder):
        seen.append(folder)
        assert all(p.suffix in (".toml", ".npz") for p in folder.parent.rglob("*") if p.is_file())
        assert not list(vault.rglob("labels.json")), "labels are in reach of the diagnosis"
        return {"effects": [{"kind": "sensor_gain", "output": "nobody", "parameters": {}}], "shrinkage": {}}

    held = hold_trials(2, 2, kinds=[("sensor_gain",), ()], diagnose_case=guess)
    assert len(seen) == 2
    assert held.statistics.shares == {"single": (1, 1), "none": (0, 1)}
    assert held.scores["case-001"]["kinds"] and not held.scores["case-001"]["channels"]


# --- scores


def test_scores_count_kinds_channels_and_places():
    label = {"effects": [{"kind": "point_mass", "at": 3.0}, {"kind": "sensor_gain", "output": 1, "gain": 2.0}]}
    verdict = {
        "effects": [{"kind": "sensor_gain", "output": "d2", "parameters": {}}, {"kind": "point_mass", "at": 3.15}],
        "shrinkage": {"validate": 0.99, "ci95": [0.9, 1.0]},
    }
    found = score(verdict, label, domain=10.0, outputs=("d1", "d2"))
    assert found["family"] == "pair" and found["kinds"] and found["channels"] and found["positions"]
    assert found["position_errors"] == [pytest.approx(0.015)] and found["shrinkage"] == {"validate": 0.99}
    assert not score(verdict, label, domain=10.0, outputs=("d2", "d1"))["channels"]
    assert not score(verdict, label, domain=5.0, outputs=("d1", "d2"))["positions"]
    wrong = score({"effects": verdict["effects"][:1]}, label, domain=10.0, outputs=("d1", "d2"))
    assert not wrong["kinds"] and wrong["channels"] is None and wrong["positions"] is None


def test_two_of_a_kind_are_matched_by_their_places():
    label = {"effects": [{"kind": "point_mass", "at": 2.0}, {"kind": "point_mass", "at": 8.0}]}
    verdict = {"effects": [{"kind": "point_mass", "at": 8.1}, {"kind": "point_mass", "at": 2.0}]}
    assert sorted(score(verdict, label, domain=10.0)["position_errors"]) == [0.0, pytest.approx(0.01)]


def test_two_of_a_kind_are_matched_by_their_channels():
    """They were paired in the order of the verdict, so that another order counted as wrong channels."""
    label = {"effects": [{"kind": "sensor_gain", "output": name} for name in ("d1", "d2")]}
    verdict = {"effects": [{"kind": "sensor_gain", "output": name, "parameters": {}} for name in ("d2", "d1")]}
    assert score(verdict, label, domain=10.0)["channels"] is True


def test_silence_is_right_only_where_nothing_hides():
    none, bias = {"effects": [{"kind": "none"}]}, {"effects": [{"kind": "sensor_bias", "output": "d1"}]}
    unknown = {"effects": [{"kind": "unknown", "outside": "magnet"}]}
    silent, baffled = {"effects": []}, {"effects": [{"kind": "unknown"}]}
    cases = [(silent, none), (silent, bias), (baffled, unknown), (baffled, bias), (silent, unknown)]
    scores = [score(verdict, label, domain=1.0) for verdict, label in cases]
    assert [s["kinds"] for s in scores] == [True, False, True, False, False]
    counted = statistics(scores)
    assert counted.shares == {"single": (0, 2), "none": (1, 1), "unknown": (1, 2)}
    assert counted.counts["sensor_bias", "none"] == 1 and counted.counts["none", "none"] == 1


def test_what_was_outside_the_catalogue_may_be_named_since():
    label = {"effects": [{"kind": "unknown", "outside": "cross_talk"}]}
    crosstalk, gain = (
        [{"kind": kind, "input": "F1", "parameters": {}}] for kind in ("actuator_crosstalk", "actuator_gain")
    )
    told = [[{"kind": "unknown"}], crosstalk, gain, [*crosstalk, *gain], []]
    scores = [score({"effects": effects}, label, domain=1.0) for effects in told]
    assert [s["kinds"] for s in scores] == [True, True, False, False, False]
    assert {s["family"] for s in scores} == {"unknown"}
    other = {"effects": [{"kind": "unknown", "outside": "hum"}]}
    assert not score({"effects": crosstalk}, other, domain=1.0)["kinds"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_cross_talk_between_actuators_is_named(seed):
    held = hold_trials(1, seed, kinds=[("actuator_crosstalk",)])
    (found,) = held.scores.values()
    assert found["kinds"] and found["channels"]


@pytest.mark.parametrize(
    "kinds",
    [
        pytest.param([("point_damper",), (), ("sensor_gain",)], marks=pytest.mark.slow),
        pytest.param(
            [("actuator_saturation",), ("ground_spring", "sensor_lag"), ("actuator_crosstalk",)], marks=pytest.mark.slow
        ),
    ],
    ids=["single and none", "saturation, pair and cross-talk"],
)
def test_a_small_blind_trial_is_passed(kinds):
    held = hold_trials(len(kinds), 314, kinds=kinds)
    assert all(s["kinds"] for s in held.scores.values()), held.statistics.counts
    assert held.statistics.misplaced == 0


def test_no_gain_of_a_sensor_looks_like_another_unit():
    kinds = ("one_sided_stop", "random_disturbance", "sensor_gain")
    _, truth = make_trial(20390403, kinds=kinds, imperfections="triple")  # was drawn as 130
    (gain,) = (effect["gain"] for effect in truth["effects"] if effect["kind"] == "sensor_gain")
    assert 1.0 / 30.0 <= gain <= 30.0
