"""The truth of blind trials against closed forms, scipy's adaptive integrator, and the order of things in a sensor."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Bar, Beam
from workbench.trials.finite_elements import Alterations, element_modes
from workbench.trials.hidden import hide
from workbench.trials.laws import POINT_LAWS, law_force
from workbench.trials.plant import Plant


def _beam(left="hinged", right="hinged", **changes) -> Beam:
    return Beam(length=2.0, mass_per_length=3.0, bending_stiffness=5.0, left=left, right=right, **changes)


WAVE = np.sqrt(5.0 / 3.0) / 2.0**2  # sqrt(EI / m) / L²: omega = wave (beta L)²


# --- modes


def test_hinged_beam_has_sines():
    at = np.array([0.3, 1.1, 2.0])
    modes = element_modes(_beam(), at, 14)
    r = np.arange(1, 15)
    np.testing.assert_allclose(modes.omega, WAVE * (r * np.pi) ** 2, rtol=2e-6)
    exact = np.sqrt(2.0 / (3.0 * 2.0)) * np.sin(np.outer(at, r) * np.pi / 2.0)
    np.testing.assert_allclose(np.abs(modes.shapes), np.abs(exact), atol=1e-5)
    np.testing.assert_allclose(modes.gram, np.diag((r * np.pi / 2.0) ** 2 / 3.0), rtol=1e-5, atol=1e-4)


def test_thin_elements_do_not_round_off_the_lowest_modes():
    beside_nodes = (8.0 * np.arange(1, 30) + 0.31) / 240.0 * 2.0
    omega = element_modes(_beam(), beside_nodes, 3).omega
    np.testing.assert_allclose(omega, WAVE * (np.arange(1, 4) * np.pi) ** 2, rtol=1e-8)


@pytest.mark.parametrize("apart", [3e-3, 3e-4, 5e-5, 1e-5, 1e-7])
def test_places_close_together_do_not_spoil_the_modes(apart):
    at = np.array([0.7, 0.7 + 2.0 * apart])  # the matrix of an element is singular where it is a millionth long
    modes, r = element_modes(_beam(), at, 8), np.arange(1, 9)
    np.testing.assert_allclose(modes.omega, WAVE * (r * np.pi) ** 2, rtol=2e-7)
    exact = np.sqrt(2.0 / (3.0 * 2.0)) * np.sin(np.outer(at, r) * np.pi / 2.0)
    np.testing.assert_allclose(np.abs(modes.shapes), np.abs(exact), rtol=2e-6)


@pytest.mark.parametrize(
    ("left", "right", "secular", "brackets"),
    [
        ("clamped", "free", lambda b: np.cos(b) + 1.0 / np.cosh(b), [(1.5, 2.5), (4, 5.5), (7, 8.5)]),
        ("clamped", "clamped", lambda b: np.cos(b) - 1.0 / np.cosh(b), [(4, 5.5), (7, 8.5), (10, 11.9)]),
        ("clamped", "hinged", lambda b: np.tan(b) - np.tanh(b), [(3.5, 4.5), (6.6, 7.5), (9.7, 10.6)]),
    ],
)
def test_other_ends_have_their_characteristic_roots(left, right, secular, brackets):
    roots = np.array([brentq(secular, *bracket, xtol=1e-13) for bracket in brackets])
    np.testing.assert_allclose(element_modes(_beam(left, right), np.zeros(0), 3).omega, WAVE * roots**2, rtol=1e-6)


def test_rod_with_mass_at_its_tip():
    rod = Bar(length=2.0, mass_per_length=3.0, axial_stiffness=5.0, left="fixed", right="free")
    ratio = 0.7 / (3.0 * 2.0)
    roots = [brentq(lambda b: ratio * b * np.sin(b) - np.cos(b), k * np.pi + 1e-9, (k + 0.5) * np.pi) for k in range(5)]
    modes = element_modes(rod, np.zeros(0), 5, altered=Alterations(masses=((2.0, 0.7),)))
    np.testing.assert_allclose(modes.omega, np.sqrt(5.0 / 3.0) / 2.0 * np.array(roots), rtol=1e-7)


def test_tension_stiffness_factor_and_end_springs():
    r = np.arange(1, 6)
    tension = element_modes(_beam(), np.zeros(0), 5, altered=Alterations(tension=4.0, stiffness_factor=1.3)).omega
    slope = (r * np.pi / 2.0) ** 2
    np.testing.assert_allclose(tension, np.sqrt((1.3 * 5.0 * slope**2 + 4.0 * slope) / 3.0), rtol=1e-6)
    # hinged at the left with a rotational spring, hinged at the right: 2 b sin sinh + k L/EI (sinh cos - cosh sin) = 0
    k = 6.0 * 2.0 / 5.0
    root = brentq(lambda b: 2 * b * np.sin(b) * np.tanh(b) - k * (np.tanh(b) * np.cos(b) - np.sin(b)), 3.15, 3.92)
    end = element_modes(_beam(), np.zeros(0), 1, altered=Alterations(rotational_stiffness=(6.0, None))).omega[0]
    assert end == pytest.approx(WAVE * root**2, rel=1e-6)


def test_spring_to_ground_and_local_loss_follow_first_order_theory():
    at, base = np.array([0.7]), element_modes(_beam(), np.array([0.7]), 4)
    stiffer, softer = (element_modes(_beam(), at, 4, altered=Alterations(springs=((0.7, k),))) for k in (0.1, -0.1))
    rise = (stiffer.omega**2 - softer.omega**2) / 0.2
    np.testing.assert_allclose(rise, base.shapes[0] ** 2, rtol=1e-4, atol=1e-5)
    lost, gained = (element_modes(_beam(), at, 4, altered=Alterations(losses=((0.7, 0.2, s),))) for s in (1e-3, -1e-3))
    fall = (gained.omega**2 - lost.omega**2) / 2e-3
    x = np.linspace(0.6, 0.8, 2001)
    r = np.arange(1, 5)
    strain = 5.0 * 2.0 / 6.0 * (r * np.pi / 2.0) ** 4 * np.sin(np.outer(x, r) * np.pi / 2.0) ** 2
    np.testing.assert_allclose(fall, np.trapezoid(strain, x, axis=0), rtol=1e-4)


def test_buckling_is_refused():
    with pytest.raises(ValueError, match="buckles"):
        element_modes(_beam(), np.zeros(0), 3, altered=Alterations(tension=-1.1 * 5.0 * (np.pi / 2.0) ** 2))


# --- motion


@pytest.fixture(scope="module")
def rig() -> Rig:
    beam = _beam(damping=ModalDamping(0.02))
    actuators = (Actuator("F1", 0.5), Actuator("F2", 1.4), Actuator("tap", 1.1, direct=True))
    sensors = (
        Sensor("d", 0.3, noise_std=1e-3),
        Sensor("v", 0.9, "velocity", noise_std=1e-3),
        Sensor("a", 1.7, "acceleration", noise_std=1e-3),
    )
    return Rig(beam.modes(4), actuators, sensors, structure=beam)


DT, N = 0.08, 60


@pytest.fixture(scope="module")
def commands() -> np.ndarray:
    return np.random.default_rng(3).standard_normal((3, N))


LAWS = {
    "cubic_spring": lambda w, v, z: -4000.0 * w**3,
    "clearance": lambda w, v, z: -60.0 * (max(w - 0.04, 0.0) - max(-w - 0.04, 0.0)),
    "one_sided_stop": lambda w, v, z: -60.0 * max(w - 0.04, 0.0),
    "coulomb_friction": lambda w, v, z: -0.3 * np.tanh(v / 0.02),
    "bouc_wen": lambda w, v, z: -10.0 * z,
    "two_way_friction": lambda w, v, z: -0.2 * np.tanh(v / 0.02) - 0.1,
    "quadratic_damper": lambda w, v, z: -3.0 * v * abs(v),
    "point_damper": lambda w, v, z: -0.8 * v,
}
EFFECTS = {
    "cubic_spring": {"stiffness": 4000.0},
    "clearance": {"stiffness": 60.0, "gap": 0.04},
    "one_sided_stop": {"stiffness": 60.0, "gap": 0.04},
    "coulomb_friction": {"force": 0.3, "smoothing_speed": 0.02},
    "bouc_wen": {"stiffness": 10.0, "yield_displacement": 0.03},
    "two_way_friction": {"force_forward": 0.3, "force_backward": 0.1, "smoothing_speed": 0.02},
    "quadratic_damper": {"coefficient": 3.0},
    "point_damper": {"coefficient": 0.8},
}


def test_friction_of_two_directions_is_of_one_with_a_constant_force_beside_it():
    law, friction = POINT_LAWS["two_way_friction"], POINT_LAWS["coulomb_friction"]
    hidden = {"kind": "two_way_friction", "at": 0.8, **EFFECTS["two_way_friction"]}
    limit = law.limit(hidden)
    assert limit == {"kind": "coulomb_friction", "at": 0.8, "force": 0.2, "smoothing_speed": 0.02}
    for speed in (-0.3, -0.01, 0.0, 0.004, 0.5):
        both, mean = (
            law_force(one.code, np.array([e[name] for name in one.parameters]), 0.0, speed, 0.0)
            for one, e in ((law, hidden), (friction, limit))
        )
        assert both - mean == pytest.approx(-0.1, abs=1e-15)


def _reference(solved, forces, extra) -> np.ndarray:
    """Modal motion (3, N, n) by DOP853, started afresh at each sample, as the forces jump there."""
    n = solved.modes.omega.size
    omega, zeta = solved.modes.omega, 0.02
    y, out = np.zeros(2 * n + 1), np.zeros((3, N, n))
    for k in range(N):

        def rates(t, y, k=k):
            q, v, z = y[:n], y[n : 2 * n], y[-1]
            modal, dz = extra(t, q, v, z)
            a = -(omega**2) * q - 2 * zeta * omega * v + solved.at_actuators.T @ forces(t, k) + modal
            return np.r_[v, a, dz]

        out[0, k], out[1, k], out[2, k] = y[:n], y[n : 2 * n], rates(k * DT, y)[n : 2 * n]
        span, tight = (k * DT, (k + 1) * DT), {"rtol": 1e-10, "atol": 1e-12, "max_step": DT / 8}
        y = solve_ivp(rates, span, y, method="DOP853", **tight).y[:, -1]
    return out


QUICK = ("clearance", "coulomb_friction", "bouc_wen")


@pytest.mark.parametrize("kind", [k if k in QUICK else pytest.param(k, marks=pytest.mark.slow) for k in LAWS])
def test_laws_at_a_point_agree_with_an_adaptive_integrator(rig, commands, kind):
    solved = hide(Plant.of(rig), [{"kind": kind, "at": 0.8, **EFFECTS[kind]}]).solved()
    shape, law = solved.system.at_laws[0], LAWS[kind]

    def extra(t, q, v, z):
        w, speed = shape @ q, shape @ v
        return shape * law(w, speed, z), speed - (abs(speed) * z + speed * abs(z)) / (2 * 0.03)

    moved, _ = solved.move(commands, DT, finest=0.02)
    expected = _reference(solved, lambda t, k: commands[:, k], extra)
    plain, _ = Plant.of(rig).solved().move(commands, DT, finest=0.02)
    for got, want, without in zip(moved[:3], expected, plain[:3], strict=True):
        assert np.abs(want - without).max() > 0.02 * np.abs(want).max(), "the law must matter"
        np.testing.assert_allclose(got, want, atol=2e-5 * np.abs(want).max())


@pytest.mark.slow
def test_what_acts_all_along_agrees_with_an_adaptive_integrator(rig, commands):
    effects = [
        {"kind": "air_drag", "coefficient": 0.5},
        {"kind": "midplane_stretching", "coefficient": 3.0},
        {"kind": "stiffness_drift", "rate": 0.05},
        {"kind": "periodic_disturbance", "at": 0.4, "frequency": 0.7, "amplitude": 0.9, "phase": 0.4},
    ]
    solved = hide(Plant.of(rig), effects).solved()
    x = np.linspace(0.0, 2.0, 801)
    r = np.arange(1, 5)
    shapes = np.sqrt(1.0 / 3.0) * np.sin(np.outer(x, r) * np.pi / 2.0)
    signs = np.sign(solved.at_sensors[0] * shapes[120])  # at 0.3 m; the solver is free in them
    shapes *= signs
    at = np.sqrt(1.0 / 3.0) * np.sin(0.4 * r * np.pi / 2.0) * signs

    def extra(t, q, v, z):
        speed = shapes @ v
        drag = np.trapezoid(-0.5 * np.abs(speed) * speed * shapes.T, x)
        slope = (r * np.pi / 2.0) ** 2 / 3.0  # ∫ φ_r'² dx
        stretch = -3.0 * np.sum(slope * q**2) * slope * q
        drift = -0.05 * t * solved.modes.omega**2 * q
        return drag + stretch + drift + at * 0.9 * np.sin(2 * np.pi * 0.7 * t + 0.4), 0.0

    moved, _ = solved.move(commands, DT, finest=0.02)
    expected = _reference(solved, lambda t, k: commands[:, k], extra)
    for got, want in zip(moved[:3], expected, strict=True):
        np.testing.assert_allclose(got, want, atol=3e-5 * np.abs(want).max())


def test_actuators_lose_gain_dead_zone_limit_delay_and_lag_in_that_order(rig, commands):
    effects = [
        {"kind": "actuator_gain", "input": "F1", "gain": 1.7},
        {"kind": "actuator_dead_zone", "input": "all", "width": 0.3},
        {"kind": "actuator_saturation", "input": "all", "limit": 0.9},
        {"kind": "actuator_delay", "input": "all", "delay": 1.4 * DT},
        {"kind": "actuator_lag", "input": "all", "time_constant": 0.05},
    ]
    solved = hide(Plant.of(rig), effects).solved()
    aim = commands * np.array([[1.7], [1.0], [1.0]])
    aim[:2] = np.clip(np.sign(aim[:2]) * np.maximum(np.abs(aim[:2]) - 0.3, 0.0), -0.9, 0.9)
    # exact: piecewise-constant aims between the edges k DT and (k + 0.4) DT, state (q, v, F1, F2) by matrix exponential
    n, b = 4, solved.at_actuators
    system = np.zeros((2 * n + 5, 2 * n + 5))
    system[:n, n : 2 * n] = np.eye(n)
    system[n : 2 * n, :n] = -np.diag(solved.modes.omega**2)
    system[n : 2 * n, n : 2 * n] = -np.diag(0.04 * solved.modes.omega)
    system[n : 2 * n, 2 * n : 2 * n + 2] = b[:2].T
    system[2 * n : 2 * n + 2, 2 * n : 2 * n + 2] = -np.eye(2) / 0.05
    system[2 * n : 2 * n + 2, 2 * n + 2 : 2 * n + 4] = np.eye(2) / 0.05
    system[n : 2 * n, 2 * n + 4] = b[2]
    first, second = expm(0.4 * DT * system), expm(0.6 * DT * system)
    state, expected = np.zeros(2 * n + 5), []
    for k in range(N):
        expected.append(state[:n].copy())
        for back, step in ((2, first), (1, second)):
            state[2 * n + 2 : 2 * n + 4] = aim[:2, k - back] if k >= back else 0.0
            state[2 * n + 4] = commands[2, k]
            state = step @ state
    moved, _ = solved.move(commands, DT, finest=0.02)
    np.testing.assert_allclose(moved[0], expected, atol=1e-7 * np.abs(expected).max())


def test_the_controller_acts_on_what_really_happens(rig, commands):
    solved = Plant.of(rig).solved()
    moved, sent = solved.move(commands, DT, feedback=0.3)
    speeds = solved.at_actuators @ moved[1].T
    np.testing.assert_allclose(sent[:2], commands[:2] - 0.3 * speeds[:2], atol=1e-12)
    np.testing.assert_array_equal(sent[2], commands[2])
    replayed, _ = solved.move(sent, DT)
    np.testing.assert_allclose(replayed[0], moved[0], atol=1e-12)


def test_sensors_lose_lag_gain_bias_noise_limit_and_step_in_that_order(rig):
    sensors = tuple(
        replace(s, time_constant=0.1, gain=2.0, bias=0.3, drift=0.5, limit=1.2, step=0.05, noise_std=0.0)
        for s in rig.sensors
    )
    solved = replace(Plant.of(rig), sensors=sensors).solved()
    t = DT * np.arange(N)
    ramp = np.outer(t, np.ones(4))
    y = solved.readings((ramp, ramp, ramp), DT, np.random.default_rng(0))
    lagged = t - 0.1 * (1.0 - np.exp(-t / 0.1))  # of a ramp, exactly
    for row, shape in zip(y, solved.at_sensors, strict=True):
        exact = np.clip(2.0 * shape.sum() * lagged + 0.3 + 0.5 * t / t[-1], -1.2, 1.2)
        np.testing.assert_allclose(row, 0.05 * np.round(exact / 0.05), atol=1e-9)


def test_the_mean_of_rounded_readings_is_their_mean(rig):
    sensors = tuple(replace(s, step=0.05, noise_std=0.01) for s in rig.sensors)
    solved = replace(Plant.of(rig), sensors=sensors).solved()
    ramp = np.outer(np.linspace(0.0, 0.2, 40), np.ones(4))
    rng = np.random.default_rng(0)
    many = np.mean([solved.readings((ramp, ramp, ramp), DT, rng) for _ in range(4000)], axis=0)
    mean = solved.readings((ramp, ramp, ramp), DT)
    np.testing.assert_allclose(mean, many, atol=6.0 * 0.05 / np.sqrt(12.0 * 4000))
    assert np.abs(mean - solved.truth((ramp, ramp, ramp), DT)).max() > 0.005, "rounding must matter"


def test_modes_beyond_the_nominal_ones_take_its_damping(rig):
    truncated = {"kind": "truncated_modes", "kept": 4, "needed": 7}
    shown = hide(Plant.of(rig), [truncated, {"kind": "modal_damping", "factor": 2.0}])
    pulse = np.zeros((3, 40))
    pulse[2, 0] = 1.0
    moved, _ = shown.solved().move(pulse, 0.02)
    assert moved[0].shape == (40, 7)
    omega, zeta = WAVE * (7 * np.pi) ** 2, 0.04
    decay = np.hypot(moved[0][:, 6], (moved[1][:, 6] + zeta * omega * moved[0][:, 6]) / (omega * np.sqrt(1 - zeta**2)))
    np.testing.assert_allclose(decay[30] / decay[10], np.exp(-zeta * omega * 20 * 0.02), rtol=1e-4)
