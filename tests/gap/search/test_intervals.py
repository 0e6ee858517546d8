"""Deviations of fitted numbers, where what is left is not white."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect
from workbench.gap.prediction.residuals import FitData
from workbench.gap.search.fit import fit
from workbench.gap.search.intervals import BLOCKS, with_intervals
from workbench.rig.simulate import simulate


def test_a_deviation_is_that_of_fits_that_leave_out_a_block_each(hinged_rig):
    """A gain is a slope by least squares, y = g s + slow noise, and g_b that without block b: Σ (g_b - g)²."""
    rig = hinged_rig(n_modes=4)
    rig = replace(rig, sensors=rig.sensors[:1])
    rng = np.random.default_rng(0)
    clean = simulate(rig, np.repeat(rng.normal(size=240), 5)[None], sample_time=0.01)
    s = clean.outputs[0]
    slow = lfilter([0.02], [1.0, -0.98], rng.normal(size=s.size))
    y = 0.9 * s + 0.05 * s.std() * slow / slow.std()
    noise = np.array([0.05 * s.std()])
    data = FitData((replace(clean, outputs=y[None]),), noise)
    start = Effect(kind_named("sensor_gain"), rig.sensors[0].name, {"gain": 1.0})
    (found,) = with_intervals(rig, fit(rig, (start,), data, tolerance=1e-12), data).effects

    slope = s @ y / (s @ s)
    kept = [np.setdiff1d(np.arange(s.size), block) for block in np.array_split(np.arange(s.size), BLOCKS)]
    without = np.array([s[k] @ y[k] / (s[k] @ s[k]) for k in kept])
    expected = np.sqrt(((without - slope) ** 2).sum())
    assert found.values["gain"] == pytest.approx(slope, rel=1e-6)
    assert expected > 1.5 * noise[0] / np.sqrt(s @ s)  # white noise of that size would say less
    assert found.deviations["gain"] == pytest.approx(expected, rel=0.01)
