"""The experiment that is proposed next."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE
from workbench.gap.report.experiment import next_experiment
from workbench.gap.search.fit import Fit
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor


def test_an_experiment_is_long_enough_for_the_structure_to_answer(hinged_rig, record_of):
    """Rivals that differ by far more than noise in a sample: three periods of the first mode, pi / 4 Hz, remain."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    record = record_of(rig, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    spring, damper = (
        Fit((Effect(kind_named(name), 0.8, {"at": 0.8, **values}),), 1.0, np.ones((1, 4)), 2)
        for name, values in (("cubic_spring", {"stiffness": 1e3}), ("point_damper", {"coefficient": 0.2}))
    )
    data = FitData((record,), np.full(4, 1e-9))
    proposed = next_experiment(rig, spring, damper, data, ALONE)
    assert proposed.seconds == pytest.approx(3.0 / (np.pi / 4), rel=1e-3)
    assert proposed.sentence.endswith("for 3.82 s.")


@pytest.mark.parametrize(
    ("kind", "values"),
    [("point_mass", {"at": 2.0, "mass": 0.01}), ("local_stiffness_loss", {"at": 1.9, "width": 0.2, "loss": 0.3})],
)
def test_an_effect_at_the_end_of_a_structure_is_separated_from_others(hinged_beam, record_of, kind, values):
    """Its derivatives with respect to its place are taken towards the inside."""
    beam, rng = replace(hinged_beam, left="clamped", right="free"), np.random.default_rng(5)
    sensors = tuple(Sensor(f"d{x}", x, noise_std=1e-5) for x in (0.7, 1.6))
    rig = Rig(beam.modes(3), (Actuator("F", 0.45),), sensors, structure=beam)
    record = record_of(rig, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    damper = Effect(kind_named("point_damper"), None, {"at": 1.0, "coefficient": 0.02})
    fits = (Fit((each,), 1.0, np.ones((1, 2)), 2) for each in (Effect(kind_named(kind), None, values), damper))
    proposed = next_experiment(rig, *fits, FitData((record,), np.full(2, 1e-5)), ALONE)
    assert proposed.inputs == ("F",) and np.isfinite(proposed.seconds)
