"""A nominal model whose modes are off one by one, and whose sensors stand and read a little otherwise than stated."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import CATALOGUE
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import NominalPrior, nominal_errors
from workbench.gap.effects.structural import LOCAL_STIFFNESS_LOSS, POINT_MASS
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE
from workbench.gap.search.search import Search, most_informative
from workbench.gap.search.stepwise import Stepwise
from workbench.rig.elements import CubicSpring
from workbench.rig.rig import Rig
from workbench.structure.modes import Modes

STIFFNESS, AT = 4000.0, 0.62


@pytest.fixture(scope="module")
def rig(hinged_rig):
    return hinged_rig(n_modes=3)


def off(rig: Rig, elements=(), gain=1.0) -> Rig:
    """Frequencies off by half a per cent to either side, damping by a third, sensors by 5 mm and 1 %; one by a gain."""
    modes = rig.modes
    real = Modes(
        omega=modes.omega * [1.005, 0.994, 1.004],
        damping=modes.zeta * [0.7, 1.3, 1.2],
        shapes=modes.shapes,
        domain=modes.domain,
    )
    errors = zip(rig.sensors, (0.006, -0.005, 0.004, -0.006), (1.01, 0.993 * gain, 1.006, 0.99), strict=True)
    sensors = tuple(replace(s, at=s.at + shift, gain=gain) for s, shift, gain in errors)
    return Rig(real, rig.actuators, sensors, elements=elements)


@pytest.fixture(scope="module")
def measured(rig, record_of):
    def make(*elements, nominal=rig, gain=1.0):
        rng, real = np.random.default_rng(6), off(nominal, elements, gain)
        levels = {"low": 0.3, "high": 1.0, "validate": 0.7}
        inputs = {name: level * np.repeat(rng.normal(size=300), 5)[None] for name, level in levels.items()}
        return [record_of(real, u, rng, name=name, substeps=8) for name, u in inputs.items()]

    return make


@pytest.mark.slow
def test_nothing_is_named_where_nothing_hides(rig, measured):
    *fitted, kept = measured()
    verdict = diagnose(rig, fitted, validation=[kept])
    assert verdict.outcome == "none" and verdict.sentence.startswith("There is no gap beyond small errors")


@pytest.mark.slow
def test_a_law_is_named_beside_them_and_its_interval_holds(rig, measured):
    *fitted, kept = measured(CubicSpring(AT, STIFFNESS))
    verdict = diagnose(rig, fitted, validation=[kept])
    (effect,) = (e for e in verdict.effects if not e.kind.applied_first)
    assert effect.kind.name == "cubic_spring" and effect.at == pytest.approx(AT, abs=0.03 * rig.modes.length)
    assert abs(effect.values["stiffness"] - STIFFNESS) < 2.5 * effect.std["stiffness"]


def beside_modes_of(rig, records, catalogue=CATALOGUE) -> Stepwise:
    data = FitData(tuple(records), np.array([s.noise_std for s in rig.sensors]))
    nominal = data.by_channel(data.residual(rig))
    quick, first = most_informative(data, nominal)
    return Stepwise(Search(rig, data, quick, first, catalogue, lambda *_: None, ALONE, nominal, by_mode=True))


def test_a_gain_far_from_the_others_is_an_effect(rig, measured):
    *fitted, _ = measured(gain=0.8)
    beside = beside_modes_of(rig, fitted)
    assert beside.is_noise_only and not beside.has_plausible_errors
    assert beside.calibrate()
    (effect,) = beside.last.effects
    assert (effect.kind.name, effect.target) == ("sensor_gain", rig.sensors[1].name)
    assert effect.values["gain"] < 0.9
    others = beside_modes_of(rig, fitted, tuple(kind for kind in CATALOGUE if kind is not effect.kind))
    assert not others.calibrate(), "a kind that is not to be tried is not named"


def test_a_record_that_reads_a_constant_is_compared_with_the_others(rig, measured):
    *fitted, _ = measured()
    still = replace(fitted[0], outputs=np.zeros_like(fitted[0].outputs), name="still")
    data = FitData((*fitted, still), np.array([s.noise_std for s in rig.sensors]))
    by_channel = data.by_channel(data.residual(rig))
    assert "still" in {record.name for record in most_informative(data, by_channel)[0].records}


@pytest.mark.slow
def test_a_gain_off_by_more_than_any_calibration_is_named(rig, measured):
    *fitted, kept = measured(gain=0.8)
    verdict = diagnose(rig, fitted, validation=[kept])
    (effect,) = (e for e in verdict.effects if not e.kind.applied_first)
    assert (effect.kind.name, effect.target) == ("sensor_gain", rig.sensors[1].name)
    assert effect.values["gain"] == pytest.approx(0.993 * 0.8, rel=0.02)


@pytest.mark.slow
def test_of_effects_that_errors_of_modes_close_the_one_with_the_smallest_errors_is_likeliest(rig, measured):
    mass = Effect(POINT_MASS, None, {"at": AT, "mass": 0.1})
    loss = Effect(LOCAL_STIFFNESS_LOSS, None, {"at": AT, "width": 0.2, "loss": 0.3})
    *fitted, _ = measured(nominal=apply_all(rig, [mass]))
    beside = beside_modes_of(rig, fitted)
    assert beside.is_noise_only and not beside.has_plausible_errors
    beside.singles = [(loss,), (mass,)]
    likeliest, _ = beside.fitted_singles
    assert likeliest.effects[0].kind is POINT_MASS and likeliest.is_plausible


def test_errors_of_a_frequency_stay_where_an_effect_solves_the_structure_anew(rig):
    prior = NominalPrior(frequency=0.005, damping=0.2)
    errors = nominal_errors(rig, prior, {"frequency_2": 0.01, "damping_1": 0.3})
    made = errors.apply(rig)
    again = made.structure.modes(3)
    np.testing.assert_allclose(again.omega / rig.modes.omega, [1.0, np.exp(0.01), 1.0], rtol=1e-9)
    np.testing.assert_allclose(made.modes.omega, again.omega, rtol=1e-9)
    np.testing.assert_allclose(again.zeta / rig.modes.zeta, [np.exp(0.3), 1.0, 1.0], rtol=1e-9)


def test_errors_of_places_move_actuators_and_sensors_and_leave_none_beside_the_structure(rig):
    free = replace(rig, sensors=(*rig.sensors, replace(rig.sensors[0], name="end", at=rig.modes.length)))
    first, length = rig.sensors[0], rig.modes.length
    off = {f"place_at_{first.name}_at": 0.004, f"place_of_{rig.actuators[0].name}_at": -0.002, "place_at_end_at": 0.01}
    made = nominal_errors(free, NominalPrior(place=0.002), off).apply(free)
    assert made.sensors[0].at == pytest.approx(first.at + 0.004 * length)
    assert made.actuators[0].at == pytest.approx(rig.actuators[0].at - 0.002 * length)
    assert made.sensors[-1].at == length and made.sensors[1].at == rig.sensors[1].at


def test_places_and_a_gain_are_told_apart(rig, measured):
    """Sensors that stand 3 to 6 mm off: as errors of every shape they took a part of the gain for their own."""
    *fitted, _ = measured(gain=0.85)
    beside = beside_modes_of(rig, fitted)
    assert beside.calibrate()
    (effect,) = beside.last.effects
    assert effect.values["gain"] == pytest.approx(0.993 * 0.85, abs=0.01)
    shifts = np.array([0.006, -0.005, 0.004, -0.006]) / rig.modes.length
    found = [beside.last.errors.values[f"place_at_{s.name}_at"] for s in rig.sensors]
    np.testing.assert_allclose(found, shifts, atol=0.0007)
