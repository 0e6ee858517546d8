"""What a fit sees of records that differ in their sampling rates, and of a few samples."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.prediction.residuals import FitData
from workbench.gap.report.budget import power_of_inputs
from workbench.rig.simulate import simulate


@pytest.fixture(scope="module")
def at_two_rates(hinged_rig):
    """Ten seconds at 100 Hz and as long at 25 Hz, of a rig whose second sensor reads a tenth too much."""
    rig, rng = hinged_rig(3), np.random.default_rng(4)
    real = kind_named("sensor_gain").apply(rig, "d2", {"gain": 1.1})

    def record(name, sample_time):
        inputs = np.repeat(rng.normal(size=25), round(0.4 / sample_time))[None]
        clean = simulate(real, inputs, sample_time=sample_time, name=name)
        return replace(clean, outputs=clean.outputs + 1e-5 * rng.normal(size=clean.outputs.shape))

    return rig, (record("fast", 0.01), record("slow", 0.04))


def test_each_record_leaves_out_as_many_seconds(at_two_rates):
    rig, (fast, slow) = at_two_rates
    data = FitData((fast, slow), np.full(4, 1e-5), transient=2.0)
    assert [r.time[0] for r in data.counted] == pytest.approx([2.0, 2.0])
    assert data.residual(rig).size == data.n_values == 4 * (800 + 200)
    powers = power_of_inputs(rig, (fast, slow), 2.0)
    assert powers.shape == (2,) and (powers > 0).all()


def test_the_order_of_records_of_two_rates_changes_no_verdict(at_two_rates):
    rig, records = at_two_rates
    catalogue = tuple(kind_named(n) for n in ("sensor_gain", "modal_damping"))
    for order in (records, records[::-1]):
        verdict = diagnose(rig, order, catalogue=catalogue, transient=6.0, workers=1)
        assert verdict.outcome == "explained"
        assert verdict.effects[0].values["gain"] == pytest.approx(1.1, abs=1e-3)


def test_fewer_values_than_uncertain_numbers_give_way(at_two_rates):
    """min over δ of |r + S δ|² + |δ|², by least squares on r and δ together."""
    rng = np.random.default_rng(0)
    data = FitData(at_two_rates[1], np.full(4, 1e-5))
    sensitivity, residual = rng.normal(size=(5, 9)), rng.normal(size=5)
    stacked, target = np.vstack([sensitivity, np.eye(9)]), np.r_[-residual, np.zeros(9)]
    left = stacked @ np.linalg.lstsq(stacked, target)[0] - target
    data.with_nuisance(sensitivity).project_out(residual)
    assert residual @ residual == pytest.approx(left @ left)
