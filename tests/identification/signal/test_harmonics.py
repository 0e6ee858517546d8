"""Poles that distortion of a stronger mode makes, by closed forms and in the FRF of a cubic spring."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.identification.frf import identify_frf
from workbench.identification.signal.harmonics import overtone_remarks
from workbench.records.record import Channel
from workbench.rig.actuators import Actuator
from workbench.rig.elements import CubicSpring
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate

FIRST, SECOND = -0.3 + 35.0j, -1.4 + 140.0j
SIZE, SCATTER, EXACT = np.array([1e4, 1e3, 10.0]), np.array([0.05, 0.0, 0.0]), np.zeros(3, complex)


def said_of(pole, *, size=SIZE, scatter=SCATTER, deviation=EXACT):
    return overtone_remarks(np.array([FIRST, SECOND, pole]), size, scatter, deviation)


@pytest.mark.parametrize(
    ("pole", "words"),
    [
        (3 * FIRST, "3 × mode 1"),
        (2 * FIRST, "2 × mode 1"),
        (SECOND + 2 * FIRST, "mode 2 plus 2 × mode 1"),
        (SECOND + 2 * FIRST.conjugate(), "mode 2 less 2 × mode 1"),
        (SECOND + FIRST.conjugate(), "mode 2 less mode 1"),
    ],
)
def test_a_product_of_free_decays_decays_by_the_sum_of_their_poles(pole, words):
    (remark,) = said_of(pole)
    assert remark.startswith(f"mode 3 ({pole.imag / (2.0 * np.pi):.4g} Hz) lies at {words}, in frequency")


def test_a_mode_is_one_that_is_damped_otherwise_or_elsewhere_or_strong_or_beside_what_does_not_change():
    third = 3 * FIRST
    assert said_of(third + 0.5 * third.real) == ()
    assert said_of(third + 1.0j) == ()
    assert said_of(third, size=np.array([1e4, 1e3, 1e3])) == ()
    assert said_of(third, scatter=np.zeros(3)) == ()


def test_what_is_hardly_known_may_be_one():
    beside = 3 * FIRST + 0.5 * 3 * FIRST.real + 1.0j
    assert len(said_of(beside, deviation=np.array([0, 0, 0.2 + 0.4j]))) == 1


def test_the_frf_of_a_cubic_spring_has_the_third_harmonic_and_says_so(hinged_beam):
    """A blow, and a spring of a tenth of the first mode's restoring force at its largest."""
    rng = np.random.default_rng(0)
    drive, sensor = Actuator("F", 0.225 * hinged_beam.length), Sensor("d", 0.35 * hinged_beam.length)
    linear = Rig(hinged_beam.modes(6), (drive,), (sensor,), structure=hinged_beam)
    f1 = linear.modes.frequencies_hz[0]
    dt, n = 1.0 / (72.0 * f1), 4096
    blow = np.zeros((1, n))
    blow[0, 5:9] = 0.5, 1.0, 1.0, 0.5
    largest = np.abs(simulate(linear, blow, sample_time=dt).outputs).max()
    here, read_by = linear.modes.phi(0.45 * hinged_beam.length)[0, 0], linear.modes.phi(sensor.at)[0, 0]
    stiffness = 0.1 * linear.modes.omega[0] ** 2 * (read_by / largest) ** 2 / here**4
    spring = CubicSpring(0.45 * hinged_beam.length, stiffness)
    read = simulate(replace(linear, elements=(spring,)), blow, sample_time=dt, substeps=8).outputs
    read = read + 1e-4 * largest * rng.normal(size=read.shape)
    lines = np.fft.rfftfreq(n, dt)
    inside = (lines > 0.1 * f1) & (lines < 18.0 * f1)
    frf = np.fft.rfft(read)[:, inside] / np.fft.rfft(blow)[:, inside]
    found = identify_frf(frf, lines[inside], channels=(Channel("d", "displacement"),))
    third = np.argmin(np.abs(found.modes.frequencies_hz - 3.0 * found.modes.frequencies_hz[0]))
    assert found.modes.frequencies_hz[third] == pytest.approx(3.0 * found.modes.frequencies_hz[0], rel=0.02)
    assert "lies at 3 × mode 1" in " ".join(found.remarks)
