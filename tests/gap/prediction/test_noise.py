"""What is noise, however loud, and how much of it there is at least."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from workbench.gap.diagnose import diagnose
from workbench.gap.prediction.noise import is_noise_alone, noise_found, noise_guessed
from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes


def resonance(noise):
    pole = 0.99 * np.exp(0.4j)
    return lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], noise)


@pytest.mark.parametrize("n", [1000, 8000])
def test_noise_has_no_peaks_and_does_not_go_with_the_level(n):
    rng = np.random.default_rng(n)

    def measured(level):
        return Record(0.01, level * rng.normal(size=(1, n)), (Channel("d", "displacement"),))

    records = [measured(1.0), measured(3.0)]
    for _ in range(20):
        white, moved = rng.normal(size=(2, 1, n)), resonance(rng.normal(size=n))
        assert is_noise_alone(white, records)
        assert not is_noise_alone(white, [records[0], records[0]]), "of one level it may be anything"
        assert not is_noise_alone([white[0], 3.0 * white[1]], records)
        assert not is_noise_alone(white + moved / moved.std(), records)


@pytest.mark.parametrize("n_records", [1, 2])
def test_a_residual_of_zero_has_no_noise(n_records):
    """As of records that the nominal rig itself has made."""
    noisy = np.random.default_rng(0).normal(size=(n_records, 1000))
    found = noise_found([np.array([np.zeros(1000), row]) for row in noisy])
    assert found[0] == 0.0 and found[1] == pytest.approx(1.0, abs=0.1)


def test_the_noise_of_records_without_any_is_to_be_stated(hinged_rig):
    rig = replace(hinged_rig(2), sensors=(Sensor("d", 0.7),))
    clean = simulate(rig, np.ones((1, 200)), sample_time=0.01)
    with pytest.raises(ValueError, match=r"the records show no noise of sensor d, .*: state its noise_std"):
        diagnose(rig, clean, workers=1)


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
def test_noise_is_guessed_under_the_peaks(noise):
    """Of a rig whose frequency is 2 % off: its gap is as large as its readings, 0.06 m."""
    rng = np.random.default_rng(1)

    def rig(omega):
        modes = Modes(omega=[omega], damping=[0.01], shapes=PointShapes([[1.0], [1.0]]), domain=NamedPoints(("F", "d")))
        return Rig(modes, (Actuator("F", "F"),), (Sensor("d", "d"),))

    record = simulate(rig(50.0), 50.0 * rng.normal(size=(1, 4000)), sample_time=0.01)
    record = replace(record, outputs=record.outputs + noise * rng.normal(size=(1, 4000)))
    assert noise_guessed(rig(51.0), [record])[0] == pytest.approx(noise, rel=0.3)
