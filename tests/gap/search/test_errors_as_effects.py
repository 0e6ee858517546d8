"""Where errors of a careful model end and effects begin."""

from dataclasses import replace

import numpy as np
import pytest

import workbench as wb
from workbench.gap.effects.catalogue import CATALOGUE, kind_named
from workbench.gap.effects.effect import Effect
from workbench.gap.effects.nominal import NominalPrior, nominal_errors
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE
from workbench.gap.search.errors_as_effects import _suspects, may_be_small_error
from workbench.gap.search.fit import Fit
from workbench.gap.search.jointly import JointFit
from workbench.gap.search.search import Search
from workbench.rig.simulate import simulate

SAMPLE_TIME, NOISE = 0.01, 1e-5


@pytest.fixture(scope="module")
def search(hinged_rig):
    rig = hinged_rig(4, (wb.Actuator("F1", 0.5), wb.Actuator("F2", 1.2)))
    forces = np.random.default_rng(1).normal(size=(2, 300))
    record = simulate(rig, forces, sample_time=SAMPLE_TIME, name="test")
    data = FitData((record,), np.full(4, NOISE))
    return Search(rig, data, data, data, CATALOGUE, lambda text, share: None, ALONE, np.ones((1, 4)))


def errors_of(search, **sizes):
    return nominal_errors(search.rig, NominalPrior(sample_time=SAMPLE_TIME, **sizes))


@pytest.mark.parametrize(
    ("kind", "target", "name", "value", "deviation", "may_be"),
    [
        ("sensor_gain", "d1", "gain", 0.94, 0.01, True),  # 0.96 is within calibration
        ("sensor_gain", "d1", "gain", 0.94, 0.003, False),
        ("sensor_gain", "d1", "gain", -1.0, 0.01, False),  # wired the wrong way round
        ("modulus_error", None, "factor", 1.026, 0.01, True),
        ("modulus_error", None, "factor", 1.026, 0.002, False),
        ("point_mass", None, "mass", 0.02, 0.015, True),  # not surely there at all
        ("point_mass", None, "mass", 0.02, 0.005, False),
        ("cubic_spring", None, "stiffness", 0.02, 0.015, False),  # errors of a linear model are none of a law
    ],
)
def test_an_effect_beside_errors_is_one_of_them_where_its_interval_reaches_theirs(
    search, kind, target, name, value, deviation, may_be
):
    place = {} if target or kind == "modulus_error" else {"at": 1.1}
    effect = Effect(kind_named(kind), target, {**place, name: value}, {name: deviation})
    assert may_be_small_error(effect, errors_of(search, gain=0.01), search) == may_be


@pytest.mark.parametrize(("others", "may_be"), [(0.3, True), (0.0, False)])
def test_a_late_sensor_is_an_effect_unless_others_are_late_too(search, others, may_be):
    """By six tenths of a sample, where a careful laboratory is late by five."""
    delays = {"delay_d2": others, "delay_d3": -others}
    errors = nominal_errors(search.rig, NominalPrior(sample_time=SAMPLE_TIME, delay=0.1), delays)
    late = Effect(kind_named("sensor_delay"), "d1", {"delay": 0.6 * SAMPLE_TIME}, {"delay": 1e-5})
    assert may_be_small_error(late, errors, search) == may_be


def test_the_transducer_that_errors_move_and_scale_is_suspected(search):
    """An actuator 4 cm off its place and a gain of 0.97; errors of 2 mm and 1 % belong to any test."""
    values = {"place_of_F2_at": 0.02, "place_of_F1_at": 0.001, "gain_at_d1": np.log(0.97), "gain_of_F1": 0.01}
    errors = nominal_errors(search.rig, NominalPrior(place=0.01, gain=0.01, sample_time=SAMPLE_TIME))
    assert set(values) <= set(errors.values)
    errors = replace(errors, values={**errors.values, **values})
    step = JointFit(Fit((errors,), 1.0, np.ones((1, 4)), 0), np.ones(4), 0.0, np.ones((1, 4)))
    found = {(s.effect.kind.name, s.effect.target): s.effect for s in _suspects(search, step)}
    assert set(found) == {("actuator_misplacement", "F2"), ("sensor_gain", "d1")}
    assert found["actuator_misplacement", "F2"].at == pytest.approx(1.24)
    assert found["sensor_gain", "d1"].values["gain"] == pytest.approx(0.97)
    named = replace(step, fit=replace(step.fit, effects=(found["actuator_misplacement", "F2"], errors)))
    assert [s.effect.kind.name for s in _suspects(search, named)] == ["sensor_gain"]


def test_a_looser_observer_shows_what_grows_slowly(search):
    """A frequency off by 0.1 % is next to nothing from sample to sample, and drifts out of phase over a record."""
    modes = replace(search.rig.modes, omega=1.001 * search.rig.modes.omega)
    off = replace(search, rig=replace(search.rig, modes=modes))
    costs = [replace(off, process_noise=process_noise).nominal_ahead for process_noise in (1e-2, 1e-3, 1e-4)]
    assert costs[0] < costs[1] < costs[2]
