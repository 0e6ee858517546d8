"""Effects beside modes that the model leaves out, on a beam of the test's own finite elements."""

import numpy as np
import pytest
from scipy.linalg import eigh, expm

from workbench.gap.diagnose import diagnose
from workbench.gap.effects.nominal import NOMINAL_ERRORS
from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam

LENGTH, MASS, STIFFNESS, ELEMENTS, ZETA = 1.2, 0.8, 9.0, 30, 0.006
NOISE, SAMPLE_TIME = 0.01, 4e-4


def elements():
    """Stiffness and mass of a cantilever by cubic elements, the clamped end left out; w at node i is 2 (i - 1)."""
    h, n = LENGTH / ELEMENTS, 2 * ELEMENTS + 2
    k = np.array([[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h]])
    k = STIFFNESS / h**3 * np.vstack([k, -k[0], [6 * h, 2 * h * h, -6 * h, 4 * h * h]])
    m = np.array([[156, 22 * h, 54, -13 * h], [22 * h, 4 * h * h, 13 * h, -3 * h * h]])
    m = MASS * h / 420 * np.vstack([m, [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h * h, -22 * h, 4 * h * h]])
    stiffness, mass = np.zeros((n, n)), np.zeros((n, n))
    for i in range(0, 2 * ELEMENTS, 2):
        stiffness[i : i + 4, i : i + 4] += k
        mass[i : i + 4, i : i + 4] += m
    return stiffness[2:, 2:], mass[2:, 2:]


def measured(name, rng, level, n_modes, *, spring, at):
    """A record of two accelerometers, the force held for four samples, by the exact transition of n_modes modes."""
    k, m = elements()
    dof = [2 * round(x / LENGTH * ELEMENTS) - 2 for x in (0.32, 0.6, 1.16, at)]
    k[dof[3], dof[3]] += spring
    squares, shapes = eigh(k, m, subset_by_index=[0, n_modes - 1])
    omega = np.sqrt(squares)
    a = np.block([[np.zeros((n_modes,) * 2), np.eye(n_modes)], [-np.diag(squares), -2 * ZETA * np.diag(omega)]])
    b, reads = np.r_[np.zeros(n_modes), shapes[dof[0]]], shapes[dof[1:3]]
    step = expm(np.block([[a, b[:, None]], [np.zeros((1, 2 * n_modes + 1))]]) * SAMPLE_TIME)
    force = level * np.repeat(rng.standard_normal(800), 4)
    x, y = np.zeros(2 * n_modes), np.empty((2, force.size))
    for i, f in enumerate(force):
        y[:, i] = reads @ (a[n_modes:] @ x + b[n_modes:] * f)
        x = step[:-1, :-1] @ x + step[:-1, -1] * f
    readings, names = y + NOISE * rng.standard_normal(y.shape), ("a1", "a2")
    return Record(SAMPLE_TIME, readings, tuple(map(Channel, names)), force[None], (Channel("F"),), name=name)


@pytest.mark.slow
def test_a_spring_is_found_beside_modes_that_are_missing():
    """In the model of six modes an added mass is as near as the spring."""
    rng, hidden = np.random.default_rng(8), {"spring": 150.0, "at": 0.88}
    ends = {"left": "clamped", "right": "free"}
    beam = Beam(length=LENGTH, mass_per_length=MASS, bending_stiffness=STIFFNESS, damping=ModalDamping(ZETA), **ends)
    sensors = tuple(Sensor(name, at, "acceleration", noise_std=NOISE) for name, at in (("a1", 0.6), ("a2", 1.16)))
    rig = Rig(beam.modes(6), (Actuator("F", 0.32),), sensors, structure=beam)
    fit = [measured(name, rng, level, 10, **hidden) for name, level in (("low", 0.3), ("high", 1.0))]
    verdict = diagnose(rig, fit, validation=[measured("validate", rng, 0.6, 10, **hidden)], seconds=None)
    modes, spring = (effect for effect in verdict.effects if effect.kind is not NOMINAL_ERRORS)
    assert modes.kind.name == "truncated_modes" and modes.target == 10
    assert spring.kind.name == "ground_spring" and abs(spring.at - hidden["at"]) < 0.03 * LENGTH
    assert abs(spring.values["stiffness"] - hidden["spring"]) < 3.0 * spring.std["stiffness"]
    assert verdict.attribution.fitted_with == "with the missing modes" and len(verdict.attribution.singles) > 3
