"""Innovations of a rig that every sample of a record corrects."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect
from workbench.gap.prediction.innovations import PROCESS_NOISE, Observer, _is_growing
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.unmodelled_force import sampled_model
from workbench.gap.search.fit import cost_of
from workbench.records.record import Channel, Record


def test_exchanged_sensors_do_not_make_the_correction_run_away(hinged_rig, record_of):
    """The observer corrects by each sensor where it takes it to stand; elsewhere that may be the wrong way."""
    rig, rng = hinged_rig(6), np.random.default_rng(1)
    noise = np.array([sensor.noise_std for sensor in rig.sensors])
    inputs = np.repeat(rng.normal(size=60), 10)[None]
    for kind, target, values in (
        ("swapped_outputs", ("d1", "d4"), {}),
        ("swapped_outputs", ("d2", "d4"), {}),
        ("sensor_misplacement", "d1", {"at": 1.7}),
    ):
        there = Effect(kind_named(kind), target, values)
        record = record_of(there.apply(rig), inputs, rng)
        data = FitData((record,), noise).one_step_ahead(rig)
        assert cost_of(rig, (), data) > 100.0
        assert cost_of(rig, (there,), data) < 1.5


@pytest.mark.parametrize("quantity", ["displacement", "acceleration"])
def test_errors_beside_the_forces_that_are_believed_are_white(hinged_rig, quantity):
    """An accelerometer reads the force of this interval, which the motion until the next sample then has in it."""
    rig, rng, dt, noise = hinged_rig(4), np.random.default_rng(1), 0.01, np.full(4, 1e-5)
    rig = replace(rig, sensors=tuple(replace(s, quantity=quantity) for s in rig.sensors))
    model, middle = sampled_model(rig.modes, rig.sensors, noise, dt), (np.arange(50) + 0.5) / 50 * rig.modes.length
    shares = np.sqrt(np.mean(rig.modes.phi(middle) ** 2, axis=0))
    forces = PROCESS_NOISE * shares[:, None] * rng.normal(size=(4, 20_000))
    state, outputs = np.zeros(8), np.empty((4, 20_000))
    for k in range(20_000):
        outputs[:, k] = model.output @ state + model.feedthrough @ forces[:, k]
        state = model.transition @ state + model.growth @ forces[:, k]
    outputs += noise[:, None] * rng.normal(size=outputs.shape)
    channels = tuple(Channel(s.name, s.quantity) for s in rig.sensors)
    record = Record(dt, outputs, channels, np.zeros((1, 20_000)), (Channel("F", "force"),))
    errors = Observer.of(rig, noise, 1.0, [4.0 * dt, dt]).innovations(rig, record, 1)[:, 1000:]
    np.testing.assert_allclose(np.cov(errors), np.eye(4), atol=0.05)
    for lag in (1, 2, 5):
        assert np.abs(errors[:, lag:] @ errors[:, :-lag].T / errors.shape[1]).max() < 0.04


def test_records_and_motions_are_let_go(hinged_rig, record_of):
    """Without waiting for the collector of cycles, which counts objects and not what they weigh."""
    rig, rng = hinged_rig(3), np.random.default_rng(1)
    noise = np.array([sensor.noise_std for sensor in rig.sensors])
    delayed = Effect(kind_named("actuator_delay"), "all", {"delay": 1e-3}).apply(rig)
    data = FitData((record_of(rig, rng.normal(size=(1, 300)), rng),), noise).one_step_ahead(rig)
    data.residual(delayed)
    data.differences(rig)
    gone = weakref.ref(data)
    gc.disable()
    try:
        del data
        assert gone() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("radius", [0.0, 0.5, 0.999, 0.99999, 1.00001, 1.001, 3.0, 1e30])
def test_a_motion_grows_where_an_eigenvalue_is_beyond_one(radius):
    rng = np.random.default_rng(3)
    for _ in range(20):
        step = rng.standard_normal((12, 12))
        step *= radius / np.abs(np.linalg.eigvals(step)).max()
        assert _is_growing(step) is (radius > 1.0)


@pytest.mark.parametrize("law", [(), (("cubic_spring", {"at": 0.7, "stiffness": 30.0}),)], ids=["linear", "stepped"])
def test_a_fault_of_a_sensor_on_a_motion_that_is_known_leaves_the_same_errors(hinged_rig, record_of, law):
    rig, rng = hinged_rig(4), np.random.default_rng(2)
    for kind, values in law:
        rig = Effect(kind_named(kind), None, values).apply(rig)
    late = Effect(kind_named("sensor_delay"), "all", {"delay": 2.3e-3}).apply(rig)
    wrong = Effect(kind_named("sensor_gain"), rig.sensors[0].name, {"gain": 1.2}).apply(late)
    records = tuple(replace(record_of(rig, rng.normal(size=(1, 300)), rng), name=name) for name in ("one", "other"))
    noise = np.array([sensor.noise_std for sensor in rig.sensors])
    for transient in (0.0, 0.4):
        ahead = FitData(records, noise, transient=transient).one_step_ahead(rig)
        known = [ahead.residual(each) for each in (late, wrong, late)]
        for each, residual in zip((late, wrong, late), known, strict=True):
            np.testing.assert_array_equal(residual, replace(ahead).residual(each))
        assert np.abs(known[0] - known[1]).max() > 1.0
