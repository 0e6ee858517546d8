"""The experiment that is proposed next."""

import numpy as np
import pytest

from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE
from workbench.gap.report.experiment import next_experiment
from workbench.gap.search.fit import Fit


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
