"""A rig held beside the records by every sample of them."""

import gc
import weakref

import numpy as np

from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect
from workbench.gap.prediction.residuals import FitData
from workbench.gap.search.fit import cost_of


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
        data = FitData((record,), noise).following(rig)
        assert cost_of(rig, (), data) > 100.0
        assert cost_of(rig, (there,), data) < 1.5


def test_records_and_motions_are_let_go(hinged_rig, record_of):
    """Without waiting for the collector of cycles, which counts objects and not what they weigh."""
    rig, rng = hinged_rig(3), np.random.default_rng(1)
    noise = np.array([sensor.noise_std for sensor in rig.sensors])
    delayed = Effect(kind_named("actuator_delay"), "all", {"delay": 1e-3}).apply(rig)
    data = FitData((record_of(rig, rng.normal(size=(1, 300)), rng),), noise).following(rig)
    data.residual(delayed)
    data.differences(rig)
    gone = weakref.ref(data)
    gc.disable()
    try:
        del data
        assert gone() is None
    finally:
        gc.enable()
