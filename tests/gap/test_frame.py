"""A frame known at the heights of its storeys: what acts between two of them is looked for between every two."""

import numpy as np
from scipy.integrate import solve_ivp

import workbench as wb

STIFFNESS, MASS, SLIP, YIELD = 2e6, 1200.0, 1e6, 1e-3
STOREYS = tuple(f"S{i}" for i in range(1, 9))


def matrices():
    stiffness = STIFFNESS * (2.0 * np.eye(8) - np.eye(8, k=1) - np.eye(8, k=-1))
    stiffness[-1, -1] = STIFFNESS
    return np.diag([MASS] * 7 + [900.0]), stiffness


def measured(rig, level, seed, samples=300, step=0.02):
    """Displacements of storeys by Runge and Kutta; between 3 and 4 a spring in series with friction."""
    mass, stiffness = matrices()
    modes = rig.modes
    shapes = modes.phi(STOREYS)
    damping = mass @ shapes @ np.diag(2.0 * modes.zeta * modes.omega) @ shapes.T @ mass
    rng = np.random.default_rng(seed)
    forces = level * rng.standard_normal((2, samples))
    inverse, applied = 1.0 / np.diag(mass), np.zeros((8, 2))
    applied[[1, 5], [0, 1]] = 1.0

    def motion(t, state, force):
        x, v, z = state[:8], state[8:16], state[16]
        w, rate = x[3] - x[2], v[3] - v[2]
        slip = SLIP * (w - z)
        joint = np.zeros(8)
        joint[2], joint[3] = -slip, slip
        slides = rate - (abs(rate) * z + rate * abs(z)) / (2.0 * YIELD)
        return np.r_[v, inverse * (applied @ force + joint - stiffness @ x - damping @ v), slides]

    state, rows = np.zeros(17), []
    for k in range(samples):
        rows.append(state[[1, 2, 4, 7]])
        state = solve_ivp(motion, (0.0, step), state, args=(forces[:, k],), rtol=1e-7, atol=1e-10).y[:, -1]
    readings = np.array(rows).T
    return rig.record(forces, readings + 2e-5 * rng.standard_normal(readings.shape), sample_time=step, name=f"r{seed}")


def test_a_joint_that_slips_is_found_between_its_storeys():
    """At five samples a period of the fastest mode, eight pairs of storeys look likelier before a law is tried."""
    places = wb.NamedPoints(
        names=STOREYS, positions=np.array([[0.0, 0.0, 3.0 * i] for i in range(1, 9)]), directions=("x",) * 8
    )
    mass, stiffness = matrices()
    modes = wb.FiniteElements(mass, stiffness, nodes=places, damping=wb.ModalDamping(0.01)).modes(8)
    sensors = [wb.Sensor(f"d{i}", f"S{i}", "displacement", noise_std=2e-5) for i in (2, 3, 5, 8)]
    rig = wb.Rig(modes, [wb.Actuator("F", "S2"), wb.Actuator("G", "S6")], sensors)
    verdict = wb.diagnose(rig, [measured(rig, 2e3, 1), measured(rig, 8e3, 2)])
    (effect,) = verdict.effects
    assert effect.kind.name == "joint_slip" and effect.at == wb.Between("S3", "S4")
    np.testing.assert_allclose(
        [effect.values["stiffness"], effect.values["yield_displacement"]], [SLIP, YIELD], rtol=0.02
    )
