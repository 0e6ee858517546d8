"""What sensors read at the lines of a spectrum, beside a motion made sample by sample and the equations of motion."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from workbench.gap.localisation.force_lines import (
    CoupledReceptances,
    UncoupledReceptances,
    lines_of,
    receptances_of,
    screened,
)
from workbench.gap.prediction.unmodelled_force import sampled_model
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.supports import PointDamper

DT, SAMPLES = 0.01, 600
NOISE = np.array([1e-5, 2e-4, 3e-3, 2e-5])
SENSORS = (
    Sensor("w1", 0.31),
    Sensor("v", 1.1, "velocity", gain=1.2),
    Sensor("a", 0.7, "acceleration"),
    Sensor("w2", 1.53, "slope"),
)
TAKEN = np.arange(1, 270, 7)


@pytest.fixture(params=[(), (PointDamper(0.6, 0.5),)], ids=["apart", "coupled"])
def rig(request, hinged_rig):
    rig = hinged_rig()
    structure = replace(rig.structure, attachments=request.param)
    return Rig(structure.modes(6), (), SENSORS, structure=structure)


@pytest.fixture
def receptances(rig):
    omega = 2.0 * np.pi * TAKEN / (SAMPLES * DT)
    found = receptances_of(rig, sampled_model(rig.modes, SENSORS, NOISE, DT), omega, SAMPLES, DT)
    assert isinstance(found, UncoupledReceptances if rig.modes.proportional else CoupledReceptances)
    return found


@pytest.fixture
def equations(rig):
    """A of x' = A x, and the readings of displacements, velocities and accelerations, in units of the noise."""
    modes, n = rig.modes, rig.modes.n_modes
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(modes.omega**2), -modes.damping]])
    w1, w2 = modes.phi(0.31)[0], modes.phi(1.53, 1)[0]
    v, acceleration = 1.2 * modes.phi(1.1)[0], modes.phi(0.7)[0]
    none = np.zeros(n)
    c = np.array([np.r_[w1, none], np.r_[none, v], acceleration @ a[n:], np.r_[w2, none]])
    through = np.array([none, none, acceleration, none])
    return a, c / NOISE[:, None], through / NOISE[:, None]


def test_the_spectrum_of_a_free_motion_is_that_of_its_ends(rig, receptances, equations):
    a, c, _ = equations
    n, step = rig.modes.n_modes, expm(a * DT)
    x = start = np.random.default_rng(0).normal(size=2 * n) * np.r_[np.ones(n), rig.modes.omega]
    readings = []
    for _ in range(SAMPLES):
        readings.append(c @ x)
        x = step @ x
    ends = (start - x) / np.r_[np.ones(n), np.maximum(rig.modes.omega, 0.1 * rig.modes.omega[-1])]
    spectrum = np.fft.fft(np.array(readings), axis=0)[TAKEN] / np.sqrt(SAMPLES)
    for j in range(len(SENSORS)):
        tail = receptances.along(np.tile(np.eye(len(SENSORS))[j], (TAKEN.size, 1))) @ ends
        assert np.abs(tail - spectrum[:, j]).max() < 1e-6 * np.abs(spectrum[:, j]).max()


def test_readings_of_a_force_obey_the_equations_of_motion(rig, receptances, equations):
    a, c, through = equations
    shape = rig.modes.phi(1.37)[0]
    read = receptances.to_force(shape)
    for line, taken in enumerate(TAKEN):
        rate = 2j * np.pi * taken / (SAMPLES * DT)
        state = np.linalg.solve(rate * np.eye(len(a)) - a, np.r_[np.zeros(shape.size), shape])
        expected = c @ state + through @ shape
        assert np.abs(read[line] - expected).max() < 1e-6 * np.abs(expected).max()


def test_products_are_those_of_what_is_read(receptances):
    rng = np.random.default_rng(1)
    left = rng.normal(size=(TAKEN.size, 4)) + 1j * rng.normal(size=(TAKEN.size, 4))
    weights = rng.uniform(0.1, 1.0, TAKEN.size)
    tail = np.array([receptances.along(np.tile(row, (TAKEN.size, 1))) for row in np.eye(4)])  # sensors first
    own, along = receptances.products(left, weights)
    assert np.allclose(own, 2.0 * np.einsum("slp,l,slq->pq", tail.conj(), weights, tail).real, rtol=1e-9)
    assert np.allclose(along, 2.0 * np.einsum("slp,l,ls->p", tail.conj(), weights, left).real, rtol=1e-9)
    kept = weights > 0.5
    own, along = receptances.on(kept).products(left[kept], weights[kept])
    assert np.allclose(along, 2.0 * np.einsum("slp,l,ls->p", tail[:, kept].conj(), weights[kept], left[kept]).real)


def test_a_force_is_found_whose_response_the_sampling_folds_down(hinged_rig):
    places = (0.31, 0.7, 1.1, 1.53, 1.83)
    sensors = tuple(Sensor(f"a{i}", x, "acceleration") for i, x in enumerate(places))
    rig = replace(hinged_rig(), sensors=sensors)
    rig = replace(rig, modes=rig.structure.modes(6))
    modes, n, finer = rig.modes, 6, 40
    dt = 2.0 * np.pi / (1.3 * modes.omega[4])  # the last modes lie above half the sample rate
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(modes.omega**2), -modes.damping]])
    shape, read = modes.phi(0.83)[0], modes.phi(places)
    b = np.r_[np.zeros(n), shape]
    held = expm(np.block([[a, b[:, None]], [np.zeros((1, 2 * n + 1))]]) * dt / finer)
    force = np.random.default_rng(4).normal(size=SAMPLES * finer // 8).repeat(8)  # jumps between the samples
    x, readings = np.zeros(2 * n), []
    for i, g in enumerate(force):
        if i % finer == 0:
            readings.append(read @ (a[n:] @ x + shape * g))
        x = held[:-1, :-1] @ x + held[:-1, -1] * g
    residual, noise = np.array(readings).T, np.full(5, 1e-3 * np.std(readings))
    (lines,) = lines_of(rig, sampled_model(modes, sensors, noise, dt), [residual], dt)
    assert lines.misfit(shape) < 0.02 * lines.power
    others = np.array([modes.phi(x)[0] for x in (0.2, 0.5, 0.7, 0.83, 0.95, 1.2, 1.6)])
    misfits = np.array([lines.misfit(other) for other in others])
    assert misfits.argmin() == 3 and np.sort(misfits)[1] > 5.0 * misfits[3]
    assert screened(lines, others).argmin() == 3
