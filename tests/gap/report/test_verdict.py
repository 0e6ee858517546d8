"""What a verdict says where nothing is named."""

import re

import numpy as np
import pytest

from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import kind_named


@pytest.mark.parametrize("gain", [1.0, 1.006])
def test_a_gap_below_the_tolerance_is_said(hinged_rig, record_of, gain):
    """A gain of 1.006 alone makes a gap of 0.006 / 1.006 of every reading."""
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    real = kind_named("actuator_gain").apply(rig, rig.actuators[0].name, {"gain": gain})
    record = record_of(real, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    verdict = diagnose(rig, (record,), catalogue=(kind_named("actuator_gain"),))
    assert verdict.outcome == "none" and not verdict.effects
    if gain == 1.0:
        assert verdict.sentence == "There is no gap beyond the noise of the sensors."
        return
    told = re.fullmatch(
        r"The gap beyond the noise is ([\d.]+) % of the signal, below the tolerance of 1 %\.", verdict.sentence
    )
    assert float(told[1]) == pytest.approx(100 * 0.006 / 1.006, abs=0.06)
