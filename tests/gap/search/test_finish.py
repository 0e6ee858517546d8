"""A set brought to its end: as the simplest that the records cannot tell from it, and no further than is of use."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from workbench.gap.effects.catalogue import CATALOGUE, kind_named
from workbench.gap.effects.effect import Effect, contained
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import Workers
from workbench.gap.search import finish, screening, stages
from workbench.gap.search.finish import finished, simplest, widened, with_equals
from workbench.gap.search.fit import fit
from workbench.gap.search.screening import on_whole_records
from workbench.gap.search.search import Search
from workbench.rig.actuators import Actuator
from workbench.rig.elements import BoucWen, CoulombFriction, CubicSpring

BOUC_WEN, SPRING, NOISE = kind_named("bouc_wen"), kind_named("ground_spring"), 1e-5
MODULUS = kind_named("modulus_error")


@pytest.fixture(scope="module")
def rig(hinged_rig):
    return hinged_rig()


@pytest.fixture(scope="module")
def search(rig, record_of):
    """A search in a record of what the rig really is."""

    def make(real, workers: int = 1, level: float = 1.0, steps: int = 100, of=rig) -> Search:
        rng = np.random.default_rng(0)
        command = level * np.repeat(rng.normal(size=steps), 10)[None]
        data = FitData((record_of(real, command, rng, substeps=8),), np.full(4, NOISE))
        quick, nominal = data.stepped(2), data.by_channel(data.residual(of))
        return Search(of, data, quick, quick, CATALOGUE, lambda text, share: None, Workers(workers), nominal)

    return make


@pytest.mark.parametrize("workers", [1, 2])
def test_a_hysteretic_spring_that_never_yields_is_a_plain_one(rig, search, workers):
    one = search(SPRING.apply(rig, None, {"at": 0.62, "stiffness": 3.0}), workers, 0.02)
    start = Effect(BOUC_WEN, None, {"at": 0.6, "stiffness": 2.5, "yield_displacement": 3.0})
    found = simplest(one, finished(one, fit(one.rig, (start,), one.data)))
    assert one.explains(found) and found.labels == ("ground_spring",)
    assert found.effects[0].values["at"] == pytest.approx(0.62, abs=0.01)


def test_a_hysteretic_spring_that_yields_is_no_plain_one(rig, search):
    one = search(replace(rig, elements=(BoucWen(0.62, 30.0, 0.02),)))
    start = Effect(BOUC_WEN, None, {"at": 0.6, "stiffness": 28.0, "yield_displacement": 0.025})
    found = finished(one, fit(one.rig, (start,), one.data))
    assert one.explains(found) and simplest(one, found) is found


@pytest.mark.parametrize(("better", "told"), [(0.004, "actuator_gain[F]"), (0.02, "actuator_hysteresis[F]")])
def test_a_wider_law_is_told_for_more_than_a_trifle(rig, search, better, told):
    """Of 20,000 values in coloured noise a width of next to nothing gains a likelihood ratio of e^40."""
    gain, hysteresis = kind_named("actuator_gain"), kind_named("actuator_hysteresis")
    one = search(gain.apply(rig, "F", {"gain": 0.93}), steps=500)
    wide = fit(one.rig, (Effect(hysteresis, "F", {"share": 0.07, "width": 1e-9}),), one.data)
    assert simplest(one, replace(wide, cost=wide.cost - better)).labels == (told,)


def test_a_fit_on_its_way_to_more_than_is_of_use_stays_where_it_is(rig, search, monkeypatch):
    one, ended = search(replace(rig, elements=(CubicSpring(0.62, 300.0),))), []

    def whole(search, effects, iterations):
        ended.append(iterations)
        return replace(fit(search.rig, effects, search.data, iterations=2), falling=0.003)

    monkeypatch.setattr(screening, "whole", whole)
    wrong = fit(one.rig, (Effect(SPRING, None, {"at": 0.6, "stiffness": 1.0}),), one.data, iterations=1)
    on_whole_records(one, [wrong], 1)
    assert ended == [5, 25]
    ended.clear()
    on_whole_records(one, [wrong], 1, to_cost=one.cost_limit)
    assert ended == [5]


def test_a_set_that_contains_one_that_leaves_only_noise_is_not_fitted_to_its_end(rig, search):
    one = search(SPRING.apply(rig, None, {"at": 0.62, "stiffness": 3.0}), level=0.02)
    spring = Effect(SPRING, None, {"at": 0.6, "stiffness": 2.5})
    hysteretic = Effect(BOUC_WEN, None, {"at": 0.6, "stiffness": 2.5, "yield_displacement": 3.0})
    ahead = [fit(one.rig, (effect,), one.data, iterations=1) for effect in (hysteretic, spring)]
    # whichever comes first, the simpler one is fitted beside it
    for both in (ahead, ahead[::-1]):
        close = [replace(f, cost=1.0 + 0.01 * i) for i, f in enumerate(both)]
        assert [f.labels for f in on_whole_records(one, close, 2)] == [("ground_spring",)]


def test_a_set_that_contains_one_that_leaves_more_is_fitted(rig, search):
    one = search(replace(rig, elements=(BoucWen(0.62, 30.0, 0.02),)))
    spring = Effect(SPRING, None, {"at": 0.6, "stiffness": 28.0})
    hysteretic = Effect(BOUC_WEN, None, {"at": 0.6, "stiffness": 28.0, "yield_displacement": 0.025})
    close = [replace(fit(one.rig, (effect,), one.data, iterations=1), cost=1.0) for effect in (spring, hysteretic)]
    found = on_whole_records(one, close, 2)
    assert found[0].labels == ("bouc_wen",) and one.explains(found[0])


def test_what_a_set_comes_to_at_bounds_is_told_to_the_last(rig):
    near_the_end = Effect(BOUC_WEN, None, {"at": 0.05, "stiffness": 1.0, "yield_displacement": 1.0})
    gain = Effect(kind_named("sensor_gain"), "d1", {"gain": 0.9})
    assert contained((near_the_end, gain), rig) == {
        ("ground_spring", "sensor_gain[d1]"),
        ("sensor_gain[d1]", "support_rotation[left]"),
        ("coulomb_friction", "sensor_gain[d1]"),  # of one that always slides
        ("point_damper", "sensor_gain[d1]"),
    }


def test_what_is_not_taken_to_its_end_is_still_there_and_all_are_there_once(rig, search, monkeypatch):
    one = search(SPRING.apply(rig, None, {"at": 0.62, "stiffness": 3.0}), level=0.02)
    ended = []
    monkeypatch.setattr(stages, "finished", lambda search, candidate: ended.append(candidate) or candidate)
    first = fit(rig, (Effect(SPRING, None, {"at": 0.62, "stiffness": 3.0}),), one.data)
    assert one.explains(first)
    linear = replace(first, effects=(Effect(MODULUS, None, {"factor": 1.01}),), cost=first.cost + 0.1, falling=0.0)
    yields = Effect(BOUC_WEN, None, {"at": 0.62, "stiffness": 3.0, "yield_displacement": 3.0})
    stepped = replace(linear, effects=(yields,), cost=first.cost + 0.2)
    found = stages._finished_best(one, [first, linear, stepped])
    assert ended == [first, stepped]
    assert sorted(found, key=lambda f: f.cost) == [first, linear, stepped]


@pytest.mark.parametrize(("offset", "kind"), [(0.0, "coulomb_friction"), (0.001, "two_way_friction")])
def test_friction_is_of_two_directions_where_the_records_surely_say_so(rig, search, offset, kind):
    one = search(replace(rig, elements=(CoulombFriction(0.62, 0.004, 1e-3, offset),)))
    start = Effect(kind_named("coulomb_friction"), None, {"at": 0.6, "force": 0.005, "smoothing_speed": 1e-3})
    found = widened(one, finished(one, fit(one.rig, (start,), one.data)))
    (effect,) = found.effects
    assert effect.kind.name == kind
    if offset:
        both = effect.values["force_forward"], effect.values["force_backward"]
        assert both == pytest.approx((0.005, 0.003), rel=0.02)


@pytest.mark.parametrize(
    ("offset", "kinds"), [(0.0, {"coulomb_friction", "actuator_bias"}), (0.001, {"two_way_friction"})]
)
def test_a_drive_beside_friction_stands_in_for_a_second_direction_for_no_trifle_alone(
    hinged_rig, search, offset, kinds
):
    rig = hinged_rig(actuators=(Actuator("F", 0.72),))
    friction, bias = CoulombFriction(0.62, 0.004, 1e-3, offset), kind_named("actuator_bias")
    real = replace(rig, elements=(friction,))
    one = search(real if offset else bias.apply(real, "F", {"force": -0.001}), steps=500, of=rig)
    start = (
        Effect(kind_named("coulomb_friction"), None, {"at": 0.6, "force": 0.005, "smoothing_speed": 1e-3}),
        Effect(bias, "F", {"force": -0.0005}),
    )
    found = widened(one, finished(one, fit(one.rig, start, one.data)))
    assert {effect.kind.name for effect in found.effects} == kinds


def test_any_number_of_sets_may_explain_the_records_as_well(rig, search, monkeypatch):
    """More than the six rivals that a ranking keeps: each has its share, and all shares are of one whole."""
    one = search(rig)
    gain = kind_named("actuator_gain")
    here = fit(one.rig, (Effect(gain, "F", {"gain": 1.0}),), one.data)
    others = [(Effect(kind_named("sensor_gain"), f"{k}", {"gain": 1.0}),) for k in range(8)]
    monkeypatch.setattr(finish, "_at_other_transducers", lambda *_: others)
    monkeypatch.setattr(finish, "fit", lambda _, effects, __: replace(here, effects=effects))
    found = with_equals(one, here, (), None, ())
    assert len(found) == 8
    assert [p for _, p in found] == pytest.approx([1.0 / 9.0] * 8)


def test_sets_at_other_transducers_come_in_the_order_of_their_likeness(rig, search):
    """In a set of names it was another in every run."""
    sensors = [sensor.name for sensor in reversed(rig.sensors)]
    best = SimpleNamespace(effects=(Effect(kind_named("actuator_gain"), "F", {"gain": 1.0}),))
    alike = [("actuator_gain[F]", f"sensor_gain[{name}]", 1.0) for name in sensors]
    found = finish._at_other_transducers(search(rig), best, None, alike)
    assert [effect.target for (effect,) in found] == sensors
