"""Draws of rigs from a diagnosis, against closed forms of what the records tell."""

import json
from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import IdentifiedPrior, NominalPrior, nominal_errors
from workbench.gap.prediction.residuals import FitData
from workbench.gap.search.fit import Fit
from workbench.gap.search.intervals import with_intervals
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.robust.posterior import UncertainRig
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes

GAINS = (
    Effect(kind_named("actuator_gain"), "F1", {"gain": 0.8}),
    Effect(kind_named("sensor_gain"), "d1", {"gain": 1.25}),
)
LEAST = (1e-4 * (1.0 - 1.0 / np.array([0.8, 1.25]))) ** 2  # variances of logarithms that no gain is told to better


@pytest.fixture(scope="module")
def told(rig):
    """Two gains in series, read by one good sensor behind both and one poor sensor behind the first alone."""
    rig = replace(rig, actuators=rig.actuators[:1], sensors=rig.sensors[:2])
    record = simulate(apply_all(rig, GAINS), np.random.default_rng(0).normal(size=(1, 600)), sample_time=0.01)
    noise = np.array([1e-3, 3e-2]) * record.outputs.std(axis=1)
    found = with_intervals(rig, Fit(GAINS, 1.0, np.ones((1, 2)), 2), FitData((record,), noise))
    return rig, record, noise, found


def test_the_joint_covariance_is_that_of_the_closed_form(told):
    """y1 = a g s1 and y2 = a s2, so var ln a = 1 / I2, var ln g = 1 / I1 + 1 / I2, and their covariance - 1 / I2.

    Beside that, no distance of a gain from 1 is told to better than a part in ten thousand.
    """
    _, record, noise, found = told
    one, two = (record.outputs**2).sum(axis=1) / noise**2
    expected = np.array([[1 / two, -1 / two], [-1 / two, 1 / one + 1 / two]])
    expected += np.diag(LEAST)
    slopes = np.array([p.slope(e.values["gain"]) / e.values["gain"] for e in GAINS for p in e.parameters(told[0])])
    assert found.covariance * np.outer(slopes, slopes) == pytest.approx(expected, rel=1e-4)


def test_draws_keep_what_the_records_tell_of_the_product_of_two_numbers(told):
    rig, record, noise, found = told
    rigs = UncertainRig(rig, found.effects, found.covariance).draws(4000, seed=1)
    gains = np.log([(r.actuators[0].gain, r.sensors[0].gain) for r in rigs])
    one, two = (record.outputs**2).sum(axis=1) / noise**2
    assert gains.mean(axis=0) == pytest.approx(np.log([0.8, 1.25]), abs=4 * two**-0.5 / 4000**0.5)
    assert gains[:, 0].std() == pytest.approx(two**-0.5, rel=0.05)
    assert gains.sum(axis=1).std() == pytest.approx((1 / one + LEAST.sum()) ** 0.5, rel=0.05)


def test_rivals_are_drawn_in_proportion_to_their_probability(told):
    rig, _, _, found = told
    rival = UncertainRig(rig, (Effect(kind_named("modal_damping"), None, {"factor": 2.0}),), np.zeros((1, 1)))
    uncertain = UncertainRig(rig, found.effects, found.covariance, alternatives=((rival, 0.25),))
    damped = [r.modes.zeta[0] > 1.5 * rig.modes.zeta[0] for r in uncertain.draws(2000, seed=2)]
    assert np.mean(damped) == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / 2000))


def test_a_number_that_the_records_hardly_tell_is_drawn_within_a_factor(told):
    rig = told[0]
    lag = Effect(kind_named("actuator_lag"), "all", {"time_constant": 0.02})
    drawn = UncertainRig(rig, (lag,), np.array([[400.0]])).draws(2000)
    spread = np.log([r.actuators[0].time_constant for r in drawn]).std()
    assert spread == pytest.approx(1.0, rel=0.1)


def test_errors_of_the_nominal_model_and_places_go_through_json(told):
    rig = told[0]
    errors = nominal_errors(rig, NominalPrior(frequency=0.01, damping=0.1), {"frequency_2": 0.5})
    spring = Effect(kind_named("ground_spring"), None, {"at": 0.6, "stiffness": 3.0}, {"at": 0.01, "stiffness": 0.1})
    n = len(errors.values) + 2
    uncertain = UncertainRig(rig, (errors, spring), 1e-4 * np.eye(n), 0.02, "explained")
    again = UncertainRig.from_json(rig, json.loads(json.dumps(uncertain.to_json())))
    assert again.unexplained == 0.02 and again.outcome == "explained"
    for one, other in zip(uncertain.draws(3, seed=5), again.draws(3, seed=5), strict=True):
        assert np.array_equal(one.modes.omega, other.modes.omega)
    assert np.ptp([r.modes.omega[0] for r in again.draws(20)]) > 0


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        (lambda rig: {"sensors": [replace(s, quantity="velocity") for s in rig.sensors]}, "quantities of outputs"),
        (lambda rig: {"sensors": [replace(s, at=0.9 * s.at) for s in rig.sensors]}, "places of outputs"),
        (lambda rig: {"actuators": [replace(a, at=0.9 * a.at) for a in rig.actuators]}, "places of inputs"),
        (lambda rig: {"modes": replace(rig.modes, damping=2.0 * rig.modes.damping)}, "damping rates"),
    ],
)
def test_a_verdict_of_a_rig_that_has_changed_since_is_refused(told, changed, match):
    rig = told[0]
    written = json.loads(json.dumps(UncertainRig(rig, (), np.zeros((0, 0))).to_json()))
    other = replace(rig, **changed(rig))
    with pytest.raises(ValueError, match=f"of another rig: its {match} are .*; diagnose this case again"):
        UncertainRig.from_json(other, written)
    early = {key: written["nominal"][key] for key in ("inputs", "outputs", "frequencies_hz")}
    assert UncertainRig.from_json(other, {**written, "nominal": early}).rig is other


def identified_rig(covariance=None):
    """Two modes as they were identified at a driving point and another sensor."""
    points, shapes = NamedPoints(("F", "y")), PointShapes(np.array([[0.7, 0.5], [0.6, -0.4]]))
    shape_covariance = None if covariance is None else np.array([1e-4 * np.eye(2), 4e-4 * np.eye(2)])
    modes = Modes(
        omega=[10.0, 23.0],
        damping=[0.02, 0.01],
        shapes=shapes,
        domain=points,
        covariance=covariance,
        shape_covariance=shape_covariance,
    )
    return Rig(modes, (Actuator("F", "F"),), (Sensor("y", "y", noise_std=1e-4),))


def test_errors_of_an_identified_rig_go_through_json():
    rig = identified_rig(np.diag([1e-4, 4e-4, 1e-8, 1e-8]))
    errors = nominal_errors(rig, IdentifiedPrior.of_modes(rig), {"identified_1": 0.5, "identified_3": -1.0})
    spring = Effect(kind_named("cubic_spring"), None, {"at": "F", "stiffness": 3.0})
    n = len(errors.values) + 1
    uncertain = UncertainRig(rig, (spring, errors), 1e-2 * np.eye(n))
    again = UncertainRig.from_json(rig, json.loads(json.dumps(uncertain.to_json())))
    for one, other in zip(uncertain.draws(3, seed=5), again.draws(3, seed=5), strict=True):
        assert np.array_equal(one.modes.omega, other.modes.omega)
        assert np.array_equal(one.modes.phi("y"), other.modes.phi("y"))
    assert np.ptp([r.modes.omega[0] for r in again.draws(20)]) > 0
    with pytest.raises(ValueError, match="must have the covariance of its modes"):
        UncertainRig.from_json(identified_rig(), uncertain.to_json())


def test_what_cannot_be_is_named(told):
    rig = told[0]
    with pytest.raises(ValueError, match=r"one row per parameter of the effects, shape \(2, 2\)"):
        UncertainRig(rig, GAINS, np.eye(3))
    with pytest.raises(ValueError, match="no effect is called 'gremlin'"):
        UncertainRig.from_json(rig, {"effects": [{"kind": "gremlin"}], "covariance": [], "alternatives": []})
    buckled = Effect(kind_named("axial_load"), None, {"tension": -1e6})
    with pytest.raises(ValueError, match="measure more records"):
        UncertainRig(rig, (buckled,), np.array([[1e-6]])).draws(1)
