"""A random disturbance is told from forces that the rig makes itself, and hides no effect beside it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import CATALOGUE, kind_named
from workbench.gap.effects.effect import Effect
from workbench.gap.effects.nominal import nominal_errors
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.prediction.innovations import Observer
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE
from workbench.gap.search.fit import Fit
from workbench.gap.search.jointly import evaluated
from workbench.gap.search.search import Search
from workbench.gap.search.with_random_force import looks_random, random_with_effects, random_with_nominal_errors
from workbench.records.resample import decimate
from workbench.rig.actuators import Actuator
from workbench.rig.elements import AirDrag, CoulombFriction, OneSidedStop
from workbench.rig.simulate import simulate

LEVELS = (0.1, 0.4, 1.6)


@pytest.fixture(scope="module")
def rig(hinged_rig):
    return hinged_rig(actuators=(Actuator("F", 0.45), Actuator("wind", 1.3)))


@pytest.fixture(scope="module")
def records(rig, record_of):
    """Records at three levels, with a random force at the second place that the rig is not told of."""

    def make(real, rms: float):
        rng, made = np.random.default_rng(5), []
        for level in LEVELS:
            command = level * np.repeat(rng.normal(size=150), 10)
            wind = lfilter([1.0], [1.0, -0.8], rng.normal(size=command.size))
            record = record_of(real, np.array([command, rms * wind / wind.std()]), rng, name=str(level), substeps=8)
            known = replace(record, inputs=record.inputs[:1], input_channels=record.input_channels[:1])
            made.append(known)
        return made

    return make


def reconstruction(rig, records):
    return ForceReconstruction.of(rig, FitData(tuple(records), np.array([s.noise_std for s in rig.sensors])))


def test_only_what_keeps_its_level_looks_random(rig, records):
    told = replace(rig, actuators=rig.actuators[:1])
    assert looks_random(reconstruction(told, records(rig, 0.05)))
    gripped = replace(rig, elements=(CoulombFriction(1.3, 0.05, 1e-3),))
    assert not looks_random(reconstruction(told, records(gripped, 0.0)))
    stiffer = kind_named("modulus_error").apply(rig, None, {"factor": 1.05})
    assert not looks_random(reconstruction(told, records(stiffer, 0.0)))


def test_no_random_force_is_sought_over_several_sample_rates(rig, records):
    told = replace(rig, actuators=rig.actuators[:1])
    *others, last = records(rig, 0.05)
    assert looks_random(reconstruction(told, others))
    assert not looks_random(reconstruction(told, [*others, decimate(last, 2)]))


def test_what_drifts_far_below_the_first_mode_is_not_the_forces_level(rig, records):
    # accelerometers hardly see it: what an estimate of the force does there is chance
    seen = reconstruction(replace(rig, actuators=rig.actuators[:1]), records(rig, 0.05))
    (place, *_), n = seen.at_peaks, seen.data.counted[0].n_samples
    slow = np.sin(2.0 * np.pi * np.arange(n) / n)
    drifting = replace(place, force=place.force + np.concatenate([0.0 * slow, 0.2 * slow, 0.1 * slow]))
    vars(seen)["at_peaks"] = (drifting,)
    assert looks_random(seen)


@pytest.mark.parametrize("law", [OneSidedStop(0.9, 80.0, 0.002), AirDrag(10.0), CoulombFriction(0.9, 0.05, 0.02)])
def test_what_a_right_law_leaves_beside_a_random_force_is_its_linear_answer(rig, records, law):
    told, real = (replace(r, elements=(law,)) for r in (replace(rig, actuators=rig.actuators[:1]), rig))
    noise = np.array([s.noise_std for s in rig.sensors])
    (weak, *_), (plain, *_) = records(real, 0.05), records(rig, 0.05)
    quiet = simulate(replace(rig, actuators=rig.actuators[:1]), plain.inputs, sample_time=0.01).outputs
    truth = plain.outputs - quiet  # the same wind on the structure without the law
    observer = Observer.of(told, noise, 0.1, [0.01], at=1.3, rms=0.05)
    left = observer.residual_on_measured_motion(told, weak, 8)
    whole = weak.outputs - simulate(told, weak.inputs, sample_time=0.01).outputs
    error = [np.sqrt(np.mean((r - truth) ** 2) / np.mean(truth**2)) for r in (left, whole)]
    assert error[0] < 0.02 < 0.1 < error[1]


@pytest.mark.slow
def test_it_is_found_beside_small_errors_of_the_model(rig, records):
    """A model 1 % off in stiffness and a sensor that is late leave far more than the noise."""
    late = (replace(rig.sensors[0], delay=0.003), *rig.sensors[1:])
    real = replace(kind_named("modulus_error").apply(rig, None, {"factor": 1.01}), sensors=late)
    told, made = replace(rig, actuators=rig.actuators[:1]), records(real, 0.05)
    data = FitData(tuple(made), np.array([s.noise_std for s in rig.sensors]))
    nominal = data.by_channel(data.residual(told))
    search = Search(told, data, data, data, CATALOGUE, lambda text, share: None, ALONE, nominal)
    step = evaluated(search, Fit((nominal_errors(told, search.prior),), 0.0, nominal, 0))
    assert not looks_random(reconstruction(told, made))
    assert random_with_nominal_errors(search, step) is None
    found = random_with_nominal_errors(search, step, surely=False)
    wind = found.best.effects[-1]
    assert wind.label == "random_disturbance"
    assert wind.values["at"] == pytest.approx(1.3, abs=3.0 * wind.std["at"])
    assert wind.values["rms"] == pytest.approx(0.05, abs=3.0 * wind.std["rms"])
    assert wind.std["rms"] < 0.005


@pytest.mark.slow
def test_a_weak_effect_beside_it_is_found(rig, records):
    told = replace(rig, actuators=rig.actuators[:1])
    alone = diagnose(told, records(rig, 0.05))
    assert [effect.label for effect in alone.effects] == ["random_disturbance"]
    (wind,) = alone.effects
    assert wind.values["at"] == pytest.approx(1.3, abs=0.01)
    assert wind.values["rms"] == pytest.approx(0.05, rel=0.05)
    stiffer = kind_named("modulus_error").apply(rig, None, {"factor": 1.002})
    both = diagnose(told, records(stiffer, 0.05))
    assert [effect.label for effect in both.effects] == ["random_disturbance", "nominal_errors"]  # no model is as good
    assert both.effects[1].values["stiffness_0"] == pytest.approx(np.log(1.002), abs=5e-4)


@pytest.mark.slow
def test_it_is_found_beside_a_stronger_law(rig, records):
    told, law = replace(rig, actuators=rig.actuators[:1]), OneSidedStop(0.9, 80.0, 0.002)
    catalogue = tuple(kind_named(name) for name in ("one_sided_stop", "coulomb_friction", "random_disturbance"))
    found = diagnose(told, records(replace(rig, elements=(law,)), 0.01), catalogue=catalogue)
    assert sorted(effect.label for effect in found.effects) == ["one_sided_stop", "random_disturbance"]
    stop, wind = sorted(found.effects, key=lambda effect: effect.label)
    assert stop.values["stiffness"] == pytest.approx(80.0, rel=0.01)
    assert stop.values["at"] == pytest.approx(0.9, abs=0.002)
    assert wind.values["rms"] == pytest.approx(0.01, rel=0.15)  # of its power a part is above what the beam answers to
    assert wind.values["at"] == pytest.approx(1.3, abs=0.01)


@pytest.mark.slow
def test_it_is_found_beside_two_effects(rig, records):
    """It hides the weaker one from a search for pairs."""
    told, law = replace(rig, actuators=rig.actuators[:1]), OneSidedStop(0.9, 80.0, 0.01)
    dead = kind_named("actuator_dead_zone").apply(replace(rig, elements=(law,)), "F", {"width": 0.03})
    names = ("actuator_dead_zone", "one_sided_stop", "coulomb_friction", "random_disturbance")
    found = diagnose(told, records(dead, 0.3), catalogue=tuple(map(kind_named, names)))
    each = {effect.kind.name: effect.values for effect in found.effects}
    assert sorted(each) == ["actuator_dead_zone", "one_sided_stop", "random_disturbance"]
    assert each["actuator_dead_zone"]["width"] == pytest.approx(0.03, rel=0.01)
    assert each["one_sided_stop"]["at"] == pytest.approx(0.9, abs=0.002)
    assert each["random_disturbance"]["at"] == pytest.approx(1.3, abs=0.01)


def test_an_effect_of_a_coarse_sensor_keeps_it(rig, records):
    """Sensors that round coarsely are left out for a random force, but not where two outputs are exchanged with one."""
    made = records(rig, 0.0)
    coarse = replace(rig.sensors[3], step=1e3 * rig.sensors[3].noise_std)
    rig = replace(rig, actuators=rig.actuators[:1], sensors=(*rig.sensors[:3], coarse))
    swapped = Effect(kind_named("swapped_outputs"), (rig.sensors[1].name, coarse.name), {})
    data = FitData(tuple(made), np.array([s.noise_std for s in rig.sensors]))
    left = data.by_channel(data.residual(rig))
    search = Search(rig, data, data, data, CATALOGUE, lambda text, share: None, ALONE, left)
    assert coarse not in search.without_clipped().rig.sensors
    assert random_with_effects(search, [Fit((swapped,), 1.0, left, 0)]) is None
