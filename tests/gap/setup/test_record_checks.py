"""What records could tell before a fit: an actuator at rest hides its faults; nothing else on this rig is hidden."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.effects.catalogue import CATALOGUE, kind_named
from workbench.gap.effects.effect import Kind
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.prediction.residuals import FitData
from workbench.gap.report.experiment import detectability
from workbench.gap.setup.record_checks import RecordsError, check_modes, check_records
from workbench.rig.actuators import Actuator
from workbench.rig.elements import LinearSpring, PeriodicForce
from workbench.rig.rig import Rig
from workbench.structure.member import Beam
from workbench.structure.plate import Membrane, Plate
from workbench.structure.supports import PointMass

NOISE = 1e-5


@pytest.fixture(scope="module")
def rig(hinged_rig):
    return hinged_rig(actuators=(Actuator("F1", 0.45), Actuator("F2", 1.35)))


@pytest.fixture(scope="module")
def data(rig, record_of):
    rng = np.random.default_rng(5)
    commands = np.vstack([np.repeat(0.3 * rng.normal(size=100), 10), np.zeros(1000)])
    return FitData((record_of(rig, commands, rng),), np.full(4, NOISE))


def test_only_the_actuator_at_rest_hides_its_faults(rig, data):
    found = detectability(ForceReconstruction.of(rig, data))
    assert found.undetectable
    assert all(label.startswith("actuator_") and "[F2]" in label for label in found.undetectable)
    assert "actuator_gain[F2]" in found.undetectable and found.strengths["actuator_gain[F2]"] == 0.0
    assert found.strengths["actuator_gain[F1]"] > 5.0 and found.strengths["point_mass"] > 5.0


def test_a_weak_start_hides_nothing_and_what_does_nothing_stays_hidden(rig, data):
    modulus = vars(kind_named("modulus_error", CATALOGUE))
    weak = Kind(**{**modulus, "starts": lambda *_: [{"factor": 1.0 + 1e-12}, {"factor": 1.1}]})
    idle = Kind(**{**modulus, "name": "idle", "apply": lambda rig, *_: rig})
    assert detectability(ForceReconstruction.of(rig, data), catalogue=(weak, idle)).undetectable == ("idle",)


def test_a_force_that_noise_puts_by_a_support_hides_no_effect(rig, data):
    found = detectability(ForceReconstruction.of(rig, data).of_force_at(1e-4 * rig.modes.length))
    assert found.undetectable and all("[F2]" in label for label in found.undetectable)


def test_two_effects_that_do_the_same_are_told_to_be_alike(rig, data):
    gain = kind_named("actuator_gain", CATALOGUE)
    twin = Kind(**{**vars(gain), "name": "another_gain"})
    found = detectability(
        ForceReconstruction.of(rig, data), catalogue=(gain, twin, kind_named("modulus_error", CATALOGUE))
    )
    assert found.indistinguishable == (("actuator_gain[F1]", "another_gain[F1]", pytest.approx(1.0)),)


@pytest.mark.parametrize("kept", [(0, 1), (0, 1, 2, 3)])
def test_the_channel_in_other_units_is_named(rig, data, kept):
    names = [rig.sensors[j].name for j in kept]
    few = replace(rig, sensors=tuple(rig.sensors[j] for j in kept))
    (record,) = data.of_outputs(names).records
    check_records(few, [record])
    factors = np.ones((len(kept), 1))
    factors[1] = 1e-3
    with pytest.raises(RecordsError, match=rf"output '{names[1]}' reads about 0.001 times"):
        check_records(few, [replace(record, outputs=factors * record.outputs)])
    with pytest.raises(RecordsError, match="the outputs read about 1000 times"):
        check_records(few, [replace(record, outputs=1e3 * record.outputs)])


@pytest.mark.parametrize("stiffness", [5.0, 60.0])
def test_all_outputs_in_other_units_are_told_beside_a_strong_spring(rig, record_of, stiffness):
    """It leaves little likeness, of some outputs or of all."""
    rng = np.random.default_rng(7)
    commands = 0.3 * np.repeat(rng.normal(size=(2, 200)), 5, axis=1)
    record = record_of(replace(rig, elements=(LinearSpring(1.1, stiffness),)), commands, rng)
    check_records(rig, [record])
    with pytest.raises(RecordsError, match=r"the outputs read about 0.00\d+ times the prediction"):
        check_records(rig, [replace(record, inputs=1e3 * record.inputs)])


def test_faults_of_records_held_out_are_refused_like_those_of_records_to_be_fitted(rig, data):
    (record,) = data.records
    for factor, words in (
        (0.0, "validation record 'v': output 'd2' is flat"),
        (1e3, "output 'd2' reads about 1000 times what the model predicts in every validation record"),
    ):
        outputs = np.array([[1.0], [factor], [1.0], [1.0]]) * record.outputs
        with pytest.raises(RecordsError, match=words):
            check_records(rig, [record], [replace(record, outputs=outputs, name="v")])


def test_records_held_out_may_clip_more_than_those_to_be_fitted(rig, data):
    """Clipping is an effect of the catalogue; where fitted records show it, those held out may be louder."""
    (record, *_) = data.records
    top = 0.3 * np.abs(record.outputs).max(axis=1, keepdims=True)
    clipped = replace(record, outputs=np.clip(record.outputs, -top, top), name="louder")
    check_records(rig, data.records, [clipped])
    with pytest.raises(RecordsError, match="it is saturated"):
        check_records(rig, [clipped])


def test_a_rig_without_actuators_and_a_record_of_few_samples_are_refused(rig, data):
    (record,) = data.records
    free = replace(rig, actuators=())
    with pytest.raises(RecordsError, match="no actuators"):
        check_records(free, [free.record(np.zeros((0, 1000)), record.outputs, sample_time=0.01, name="free")])
    with pytest.raises(RecordsError, match="has 10 samples to compare after transients; at least 16 are needed"):
        check_records(rig, [record], transient=9.9)


def test_a_strong_force_that_nobody_modelled_is_no_wrong_unit(rig, record_of):
    rng = np.random.default_rng(6)
    commands = 0.003 * np.vstack([np.repeat(rng.normal(size=100), 10), np.zeros(1000)])
    check_records(rig, [record_of(replace(rig, elements=(PeriodicForce(1.37, 0.47, 1.0, 0.0),)), commands, rng)])


def test_modes_changed_behind_the_back_of_their_structure_are_refused(rig):
    check_modes(rig)
    modes = rig.modes
    sharper = replace(modes, omega=modes.omega * np.array([1.0, 1.01, *[1.0] * (modes.n_modes - 2)]))
    with pytest.raises(ValueError, match=r"mode 2 .* structure=None"):
        check_modes(replace(rig, modes=sharper))
    with pytest.raises(ValueError, match=r"mode 1 .* damped"):
        check_modes(replace(rig, modes=replace(modes, damping=1.5 * modes.damping)))
    louder = replace(modes, shapes=lambda x, derivative: modes.shapes(x, derivative) * np.r_[1.0, 3.0, np.ones(4)])
    with pytest.raises(
        ValueError, match=r"mode 2 of the rig is not mass-normalised: .* is 9, not 1; divide .* by 3; .*"
    ):
        check_modes(replace(rig, modes=louder))
    check_modes(replace(rig, modes=sharper, structure=None))
    check_modes(replace(rig, modes=modes.select(slice(3))))


@pytest.mark.slow
def test_modes_of_a_structure_with_masses_on_it_are_mass_normalised():
    beam = Beam(
        length=2.0, mass_per_length=([0, 0.7, 0.7, 2], [2, 2, 1, 1]), bending_stiffness=4.0, left="clamped",
        right="free", attachments=[PointMass(1.4, 0.5, 0.02)],
    )  # fmt: skip
    plate = Plate(
        length=(1.2, 0.8), mass_per_area=lambda x, y: 8.0 + 2.0 * x * y, bending_stiffness=175.0, poisson_ratio=0.3,
        edges={"left": "clamped", "right": "free", "bottom": "free", "top": "free"},
        attachments=[PointMass((0.9, 0.3), 1.0)],
    )  # fmt: skip
    for structure in (beam, plate, Membrane(length=(1.2, 0.8), mass_per_area=2.0, tension=90.0)):
        modes = structure.modes(4)
        check_modes(Rig(modes, (), (), structure=structure))
        heavy = replace(modes, shapes=lambda at, derivative, shapes=modes.shapes: 1.1 * shapes(at, derivative))
        with pytest.raises(ValueError, match=r"mode 1 .* is 1\.21, not 1; divide its shape by 1\.1;"):
            check_modes(Rig(heavy, (), (), structure=structure))


def test_a_sensor_that_is_dead_in_one_record_is_refused(rig, record_of):
    rng = np.random.default_rng(8)
    commands = 0.3 * np.repeat(rng.normal(size=(2, 100)), 10, axis=1)
    levels = {"low": 1.0, "high": 4.0, "check": 3.0}
    low, high, check = (record_of(rig, level * commands, rng, name=name) for name, level in levels.items())

    def dead(record):
        return replace(
            record, outputs=np.vstack([record.outputs[:1], NOISE * rng.normal(size=(1, 1000)), record.outputs[2:]])
        )

    check_records(rig, [low, high], [check])
    expected = high.outputs[1].std()
    for fit, held, what in (([low, dead(high)], [check], "record 'high'"), ([low, high], [dead(check)], "validation")):
        with pytest.raises(RecordsError, match=f"^{what}.*output 'd2' reads .*the sensor is dead in one record; leave"):
            check_records(rig, fit, held)
    with pytest.raises(RecordsError, match=f"predicts {expected:.3g}; in record 'low' it reads"):
        check_records(rig, [low, dead(high)])
    check_records(rig, [dead(low), high], [check])  # a dry friction may hold its place at the lowest level
    (alone,) = (replace(rig, sensors=rig.sensors[1:2]),)
    check_records(alone, [r.select_outputs(["d2"]) for r in (low, dead(high))])  # the drive may have been off


def test_a_sensor_at_a_node_and_a_record_that_excites_nothing_are_not_called_dead(hinged_rig, record_of):
    """In the middle the second mode, of π Hz, has its node; the true sensor is nearer to it than the model's."""
    rig, rng = hinged_rig(6), np.random.default_rng(9)
    near, true = (replace(rig, sensors=(*rig.sensors, replace(rig.sensors[0], name="m", at=x))) for x in (0.99, 1.0))
    noise = 0.3 * np.repeat(rng.normal(size=(1, 100)), 10, axis=1)
    tone = np.sin(2 * np.pi * np.pi * 0.01 * np.arange(1000))[None]
    records = [
        record_of(true, u, rng, name=name) for name, u in (("noise", noise), ("tone", tone), ("at rest", 1e-6 * noise))
    ]
    check_records(near, records)
