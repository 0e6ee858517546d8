"""One effect, where small errors of every mode could say the same with many numbers."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import CATALOGUE, kind_named
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import NOMINAL_ERRORS, NominalPrior, nominal_errors
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE
from workbench.gap.search import jointly
from workbench.gap.search.errors_as_effects import (
    NO_UNIFORM_ERROR,
    delay_effects,
    is_plausible_error,
    uniform_as_nominal_errors,
    with_common_delay,
)
from workbench.gap.search.fit import Fit, fit
from workbench.gap.search.intervals import with_intervals
from workbench.gap.search.jointly import fit_jointly, size_of, surely_late, with_all_errors
from workbench.gap.search.plain import (
    _at_transducers,
    few_with_uniform_errors,
    in_place_of_nominal_errors,
    other_delay_causes,
)
from workbench.gap.search.search import Search
from workbench.gap.search.settings import JOINT
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.plate import Plate
from workbench.trials.make import make_trial
from workbench.trials.scoring import score_imperfect

DAMPER = Effect(kind_named("point_damper"), None, {"at": 1.2, "coefficient": 0.06})
MODULUS = Effect(kind_named("modulus_error"), None, {"factor": 1.008})
DAMPING = Effect(kind_named("modal_damping"), None, {"factor": 1.12})
SENSORS_LATE = {"sensor_lag": "time_constant", "actuator_delay": "delay"}  # kinds, and the number that says by how much
VARIED = 5e-4  # relative, of two waves
TRIED = ("point_damper", "point_mass", "modulus_error", "modal_damping", "sensor_gain")


@pytest.fixture(scope="module")
def search(hinged_rig, record_of):
    rig = hinged_rig(n_modes=4)

    def make(effects, steps=100, level=1.0):
        rng = np.random.default_rng(0)
        inputs = level * np.repeat(rng.normal(size=steps), 5)[None]
        data = FitData((record_of(apply_all(rig, effects), inputs, rng),), np.full(4, 1e-5))
        quick, nominal = data.stepped(2), data.by_channel(data.residual(rig))
        catalogue = tuple(kind for kind in CATALOGUE if kind.name in TRIED)
        return Search(rig, data, quick, quick, catalogue, lambda text, share: None, ALONE, nominal)

    return make


def beside_errors(search, effects=()):
    return fit_jointly(search, effects, nominal_errors(search.rig, replace(search.prior, delay=0.0)))


def test_a_damper_stands_in_place_of_the_damping_of_every_mode(search):
    """Beside stiffness and damping that are a little off, which are told as errors of the model."""
    one = search((DAMPER, MODULUS, DAMPING))
    found = in_place_of_nominal_errors(one, beside_errors(one))
    damper, errors = uniform_as_nominal_errors(one, found).effects
    assert damper.kind is DAMPER.kind and errors.kind is NOMINAL_ERRORS
    assert damper.values["at"] == pytest.approx(1.2, abs=0.02)
    assert damper.values["coefficient"] == pytest.approx(0.06, rel=0.05)
    assert errors.values["stiffness_0"] == pytest.approx(np.log(1.008), rel=0.02)
    assert errors.values["damping_1"] == pytest.approx(np.log(1.12), rel=0.1)


def test_a_gain_beside_common_errors_is_known_no_better_than_calibrations(search):
    """Of a model that is a little off no transducer is calibrated exactly, be it an actuator or one of four sensors.

    Three ratios of these five gains are told to be 1, and make 1 % of each s² = (2 + 0 * 3) / (2 + 3) of its square.
    """
    gain = Effect(kind_named("actuator_gain"), "F", {"gain": 0.8})
    one = search((gain, MODULUS, DAMPING))
    found = uniform_as_nominal_errors(one, fit(one.rig, (gain, MODULUS, DAMPING), one.data))
    wide = with_all_errors(one, found)
    np.testing.assert_allclose(*(one.data.residual(apply_all(one.rig, f.effects)) for f in (found, wide)), atol=1e-6)
    told = with_intervals(one.rig, wide, one.data).effects[0]
    of_gains = 0.01 * np.sqrt(2.0 / 5.0) * np.sqrt(1.0 + 1.0 / 4.0)  # and the mass is not known exactly either
    assert of_gains < told.std["gain"] / 0.8 < 2.0 * of_gains


def test_what_is_common_to_all_modes_of_a_plate_is_an_error_of_each(search):
    """A plate has no profile to vary: each of its frequencies and damping ratios is off by as much."""
    plate = Plate(
        length=(0.6, 0.4),
        mass_per_area=8.0,
        bending_stiffness=160.0,
        poisson_ratio=0.3,
        edges="simply supported",
        damping=ModalDamping(0.01),
    )
    sensors = tuple(Sensor(f"w{i}", at, noise_std=1e-6) for i, at in enumerate(((0.1, 0.3), (0.45, 0.12))))
    rig = Rig(plate.modes(5), (Actuator("F", (0.2, 0.15)),), sensors, structure=plate)
    damper = Effect(DAMPER.kind, None, {"x": 0.4, "y": 0.3, "coefficient": 2.0})
    effects = (damper, MODULUS, DAMPING)
    found = Fit(effects, 1.0, np.ones((1, 2)), 5)
    rng = np.random.default_rng(0)
    record = simulate(apply_all(rig, effects), np.repeat(rng.normal(size=60), 5)[None], sample_time=1e-3)
    one = replace(search(()), rig=rig, data=FitData((record,), np.full(2, 1e-6)))
    again = uniform_as_nominal_errors(one, found)
    assert [effect.kind for effect in again.effects] == [DAMPER.kind, NOMINAL_ERRORS]
    assert size_of(again.effects[-1], "frequency") == pytest.approx(0.5 * np.log(1.008), rel=0.01)
    left = one.data.residual(apply_all(rig, again.effects))
    assert np.abs(left).max() < 1e-3 * np.abs(one.data.residual(rig)).max()


def test_a_damper_is_found_beside_sensors_that_stand_and_read_a_little_otherwise(search):
    """Which no damper does, so they stay; a damper and places alone say what damping of every mode would say."""
    off = {"place_at_d1_at": 0.002, "place_at_d2_at": -0.003, "place_of_F_at": 0.001, "gain_at_d3": 0.01}
    moved = nominal_errors(search(()).rig, NominalPrior(gain=0.01, place=0.002), off)
    one = search((moved, DAMPER))
    damper, errors = in_place_of_nominal_errors(one, beside_errors(one)).effects[-2:]
    damper, errors = (damper, errors) if damper.kind is DAMPER.kind else (errors, damper)
    assert errors.target.groups == ("gain", "place")
    assert damper.values["at"] == pytest.approx(1.2, abs=0.02)
    assert damper.values["coefficient"] == pytest.approx(0.06, rel=0.02)
    for name, value in off.items():
        assert errors.values[name] == pytest.approx(value, abs=0.003 if "gain" in name else 5e-4)


@pytest.mark.parametrize(
    ("effect", "may"),
    [
        (Effect(kind_named("sensor_gain"), "d1", {"gain": 1.03}), True),
        (Effect(kind_named("sensor_gain"), "d1", {"gain": -1.0}), True),
        (Effect(kind_named("sensor_gain"), "d1", {"gain": 1.3}), False),
        (Effect(kind_named("sensor_delay"), "d1", {"delay": 0.003}), True),
        (Effect(kind_named("sensor_delay"), "d1", {"delay": 0.02}), False),
        (Effect(kind_named("sensor_misplacement"), "d1", {"at": 0.31}), True),
        (Effect(kind_named("sensor_misplacement"), "d1", {"at": 0.4}), False),
        (DAMPER, False),
        (MODULUS, False),
    ],
)
def test_what_a_careful_model_may_be_off_by_at_a_transducer(search, effect, may):
    assert is_plausible_error(effect, search(())) == may


def test_stiffness_and_damping_that_are_a_little_off_are_no_effect(search):
    one = search((MODULUS, DAMPING))
    assert in_place_of_nominal_errors(one, beside_errors(one)) is None


def test_strong_effects_are_found_one_by_one_beside_common_errors(search):
    """Beside a sensor that reads half as much and a damper ten times as strong, stiffness and damping a little off."""
    strong = replace(DAMPER, values={"at": 1.2, "coefficient": 0.6})
    halved = Effect(kind_named("sensor_gain"), "d3", {"gain": 0.5})
    one = search((strong, halved, MODULUS, DAMPING))
    errors = beside_errors(one)
    assert not errors.is_plausible
    found = {effect.kind.name: effect for effect in few_with_uniform_errors(one, errors, 4).effects}
    assert found.keys() == {"point_damper", "sensor_gain", "modulus_error", "modal_damping"}
    assert found["point_damper"].at == pytest.approx(1.2, abs=0.01)
    assert found["point_damper"].values["coefficient"] == pytest.approx(0.6, rel=0.01)
    assert found["sensor_gain"].target == "d3" and found["sensor_gain"].values["gain"] == pytest.approx(0.5, rel=0.01)
    assert found["modulus_error"].values["factor"] == pytest.approx(1.008, abs=0.001)


def test_what_a_careful_model_may_have_at_a_transducer_is_not_taken_for_one_of_few(search):
    slight = Effect(kind_named("sensor_gain"), "d3", {"gain": 1.03})
    one = replace(search((slight,)), catalogue=(slight.kind,))
    assert few_with_uniform_errors(one, beside_errors(one), 4) is None


@pytest.mark.slow
def test_errors_that_are_surely_likelier_stay(search):
    """Smooth variations that alter what is left by little more than a hundredth of the noise, but surely."""
    waves = nominal_errors(search(()).rig, NominalPrior(stiffness=0.02, mass=0.02))
    varied = replace(waves, values={**waves.values, "stiffness_2": VARIED, "stiffness_4": -VARIED})
    one = replace(search((DAMPER, varied), steps=4000, level=0.01), catalogue=())
    plainly = fit(one.rig, (DAMPER, MODULUS), one.data)
    assert one.explains(plainly) and plainly.cost > 1.012
    assert in_place_of_nominal_errors(one, beside_errors(one, (DAMPER,))) is None


@pytest.mark.parametrize("common", [MODULUS, DAMPING])
def test_one_of_them_alone_is_an_effect(search, common):
    one = search((common,))
    found = in_place_of_nominal_errors(one, beside_errors(one))
    assert [effect.kind for effect in found.effects] == [common.kind]
    assert found.effects[0].values["factor"] == pytest.approx(common.values["factor"], rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "kinds", "imperfections", "size"),
    [
        (34017, ("sensor_bias", "sensor_drift", "support_rotation"), "triple", 1.0),
        (35026, ("one_sided_stop", "point_damper", "sensor_drift"), "triple", 2.0),
        (34029, ("point_damper",), "offset", 0.5),
        (37006, ("axial_load",), "late", 0.5),
        (35006, ("random_disturbance",), "late", 0.5),
    ],
)
def test_hidden_effects_that_errors_could_stand_in_for_are_named(seed, kinds, imperfections, size):
    """Plants by another numerical route: an effect that a support, a damper or a load hides among errors of modes."""
    case, label = make_trial(seed, kinds=kinds, imperfections=imperfections, size=size)
    verdict = diagnose(case.rig, case.fit, validation=case.validation, workers=1)
    assert score_imperfect(verdict.to_json(), label, domain=case.rig.modes.domain)["named"]


@pytest.mark.parametrize(
    ("late", "alone"),
    [({"d2": 0.5}, "d2"), ({"d2": 0.5, "d4": -0.004}, "d2"), ({"d2": 0.5, "d4": 0.2}, None), ({"d2": -0.5}, None)],
)
def test_one_sensor_late_alone_is_an_effect(hinged_rig, late, alone):
    prior = NominalPrior(delay=0.3, sample_time=0.01)
    errors = nominal_errors(hinged_rig(n_modes=4), prior, {f"delay_{name}": delay for name, delay in late.items()})
    found = delay_effects(hinged_rig(n_modes=4), errors)
    causes = [("sensor_delay", alone), ("sensor_lag", alone)] if alone else []
    assert [(effect.kind.name, effect.target) for effect in found] == causes
    assert all(list(effect.values.values()) == pytest.approx([0.005]) for effect in found)


def test_a_sensor_on_the_late_side_of_jumps_stays_there_by_a_trifle(hinged_rig):
    late = NominalPrior(delay=1e-6, gain=0.01, late=("d1",), sample_time=0.01)
    errors = nominal_errors(hinged_rig(n_modes=4), late, {"delay_d1": 1e-4})
    sides = [surely_late(kept).target for (kept,) in _at_transducers(errors)]
    assert sides and all(side.delay == late.delay and not side.late for side in sides)


@pytest.mark.parametrize(("deviation", "is_late"), [(0.02, True), (0.2, False)])
def test_a_sensor_is_late_where_it_is_surely_so(hinged_rig, deviation, is_late):
    errors = nominal_errors(hinged_rig(n_modes=4), NominalPrior(delay=0.3, sample_time=0.01), {"delay_d2": 0.5})
    errors = replace(errors, std={"delay_d2": deviation})
    assert bool(delay_effects(hinged_rig(n_modes=4), errors)) is is_late


@pytest.mark.parametrize(
    ("delays", "deviation", "has_one_cause"),
    [
        ((0.2, 0.21, 0.2, 0.2), 0.0, True),
        ((0.2, 0.3, 0.2, 0.25), 0.0, False),  # each by itself
        ((0.05, 0.06, 0.05, 0.055), 0.0, False),  # likewise: the less they are late, the less they are apart
        ((0.2, 0.2, 0.2, 0.2), 0.02, False),  # which may be so of them
        ((-0.2, -0.2, -0.2, -0.2), 0.0, False),  # nothing is ahead of its command
    ],
)
def test_sensors_that_are_all_late_alike_are_so_for_one_cause(hinged_rig, delays, deviation, has_one_cause):
    names = [f"delay_d{i + 1}" for i in range(4)]
    prior = NominalPrior(delay=0.3, sample_time=0.01)
    errors = nominal_errors(hinged_rig(n_modes=4), prior, dict(zip(names, delays, strict=True)))
    errors = replace(errors, std=dict.fromkeys(names, deviation))
    found = delay_effects(hinged_rig(n_modes=4), errors)
    causes = [("sensor_lag", "all"), ("actuator_lag", "F"), ("actuator_delay", "F")] if has_one_cause else []
    assert [(effect.kind.name, effect.target) for effect in found] == causes
    assert all(list(effect.values.values()) == pytest.approx([0.002], rel=0.02) for effect in found)


def test_a_delay_of_all_sensors_takes_what_their_own_have_in_common(search):
    """A force late by 2 ms that is read 0.8 or 1.2 ms early is late by 1 ms, and read 0.2 ms late or early."""
    one = search((MODULUS,))
    late = Effect(kind_named("actuator_delay"), "F", {"delay": 0.002})
    own = {"delay_d1": -0.12, "delay_d2": -0.08, "delay_d3": -0.12, "delay_d4": -0.08}  # in samples of 10 ms
    errors = nominal_errors(one.rig, replace(one.prior, interpolated=True), own)
    found = Fit((late, errors), 1.0, np.ones((1, 4)), 1)
    delay, rest = with_common_delay(found).effects
    assert delay.values["delay"] == pytest.approx(0.001)
    assert [rest.values[name] for name in own] == pytest.approx([-0.02, 0.02, -0.02, 0.02])
    assert with_common_delay(replace(found, effects=(DAMPER, errors))).effects[1] is errors


@pytest.mark.parametrize("kind", ["sensor_lag", "actuator_delay"])
def test_a_delay_of_all_sensors_is_the_effect_that_it_is(search, kind):
    """Straight lines between samples say as much of a lag; a trifle of noise tells it from a delay of the force."""
    late = Effect(kind_named(kind), "all" if kind == "sensor_lag" else "F", {SENSORS_LATE[kind]: 0.003})
    one = search((late, MODULUS, DAMPING))
    prior = replace(one.prior, interpolated=kind == "sensor_lag")
    step = fit_jointly(one, (), nominal_errors(one.rig, prior))
    found = in_place_of_nominal_errors(one, step)
    named = [effect for effect in found.effects if effect.kind.name == kind]
    assert len(named) == 1 and named[0].values[SENSORS_LATE[kind]] == pytest.approx(0.003, rel=0.02)
    assert all(p < 0.01 for _, p in other_delay_causes(one, found))


def test_sensitivities_on_some_records_are_not_kept_for_all_where_the_simulation_of_all_runs_away(search, monkeypatch):
    one = search((MODULUS,))
    (record,), level = one.data.records, jointly._residual_level
    both = replace(one, data=replace(one.data, records=(record, replace(record, name="again"))))
    far = iter([True])  # the first residual of both records
    monkeypatch.setattr(
        jointly,
        "_residual_level",
        lambda rig, effects, data: np.inf if len(data.records) == 2 and next(far, False) else level(rig, effects, data),
    )
    step = beside_errors(both)
    assert len(step.errors.values) >= JOINT.few_errors and step.fit.cost_by_channel.shape == (2, 4)


def test_an_effect_that_smooth_errors_could_mimic_stays_significant(search):
    """Errors of the stiffness along the beam could do all that this spring does, but were estimated as 0."""
    spring = Effect(kind_named("ground_spring"), None, {"at": 1.3, "stiffness": 0.1})
    one = search((spring,))
    found = uniform_as_nominal_errors(one, fit(one.rig, (spring, *NO_UNIFORM_ERROR), one.data))
    (told,) = (e for e in with_intervals(one.rig, with_all_errors(one, found), one.data).effects if e.at is not None)
    assert told.std["stiffness"] < 0.05  # 0.16 with errors that could do all of it
    assert told.values["stiffness"] == pytest.approx(0.1, abs=3.0 * told.std["stiffness"])
