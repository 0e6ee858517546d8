"""The predictor against python-control, scipy's adaptive integrators, and its own limits."""

import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from workbench.rig.actuators import Actuator
from workbench.rig.elements import (
    AirDrag,
    BoucWen,
    Clearance,
    CoulombFriction,
    CubicSpring,
    EvenSpring,
    LinearDamper,
    LinearSpring,
    MidplaneStretching,
    OneSidedStop,
    PeriodicForce,
    PowerDamper,
    PowerSpring,
    UserLaw,
)
from workbench.rig.readings import sensor_reading
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import move, prediction_errors, simulate
from workbench.rig.statespace import state_space
from workbench.rig.stepping import step_record
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam
from workbench.structure.supports import PointDamper

DT = 0.1


def beam(**options):
    return Beam(
        length=10.0,
        mass_per_length=1.0,
        bending_stiffness=1.0,
        left="hinged",
        right="hinged",
        damping=ModalDamping(0.01),
        **options,
    )


def rig(elements=(), modes=None, actuators=None, sensors=None, **options):
    actuators = actuators or (Actuator("F1", 2.0), Actuator("F2", 6.3))
    sensors = sensors or (Sensor("d", 3.1), Sensor("v", 4.4, "velocity"), Sensor("a", 7.0, "acceleration"))
    return Rig(modes or beam().modes(6), actuators, sensors, elements, **options)


def drive(n=300, size=1.0, seed=0):
    return size * np.random.default_rng(seed).standard_normal((2, n))


def continuous(r, inputs, extra=lambda t, q, v: 0.0, n_extra=0, extra_rate=None, scale=lambda t: 1.0):
    """Displacements at the sensor 'd' by an adaptive integrator, restarted at each sample."""
    modes, n = r.modes, r.modes.n_modes
    b = modes.phi([a.at for a in r.actuators]).T
    state, out = np.zeros(2 * n + n_extra), []
    for k in range(inputs.shape[1]):
        out.append(modes.phi(3.1)[0] @ state[:n])
        u = inputs[:, k]

        def rate(t, s, u=u):
            q, v = s[:n], s[n : 2 * n]
            acc = b @ u - scale(t) * modes.omega**2 * q - modes.damping @ v + extra(t, q, v if not n_extra else s)
            return np.r_[v, acc, extra_rate(q, v, s[2 * n :]) if n_extra else ()]

        state = solve_ivp(rate, (k * DT, (k + 1) * DT), state, method="DOP853", rtol=1e-10, atol=1e-13).y[:, -1]
    return np.array(out)


@pytest.mark.parametrize("damped", [False, True])
def test_linear_rig_against_python_control(damped):
    modes = (beam(attachments=(PointDamper(3.0, 0.2),)) if damped else beam()).modes(6)
    r = rig(modes=modes)
    inputs = drive()
    system = control.c2d(state_space(modes, r.actuators, r.sensors), DT)
    peer = control.forced_response(system, inputs=inputs, timepts=DT * np.arange(inputs.shape[1])).outputs
    mine = simulate(r, inputs, sample_time=DT).outputs
    assert np.abs(mine - peer).max() < 1e-9 * np.abs(peer).max()


def test_actuator_lag_and_fractional_delay():
    actuators = (Actuator("F1", 2.0, time_constant=0.23), Actuator("F2", 6.3, delay=0.137))
    r = rig(actuators=actuators)
    inputs = drive(200)
    fine = 1000
    held = np.repeat(inputs, fine, axis=1)
    h = DT / fine
    shifted = np.r_[np.zeros(round(0.137 / h)), held[1]][: held.shape[1]]
    lagged = simulate(rig(actuators=(actuators[0],)), held[:1], sample_time=h).outputs
    delayed = simulate(rig(actuators=(Actuator("F2", 6.3),)), shifted[None], sample_time=h).outputs
    peer = (lagged + delayed)[:, ::fine]
    mine = simulate(r, inputs, sample_time=DT).outputs
    assert np.abs(mine - peer).max() < 1e-8 * np.abs(peer).max()


def test_both_lag_and_delay_in_one_actuator():
    both = rig(actuators=(Actuator("F1", 2.0, time_constant=0.2, delay=0.15),))
    inputs = drive(200)[:1]
    held = np.repeat(inputs, 200, axis=1)
    shifted = np.r_[np.zeros(300), held[0]][None, : held.shape[1]]
    peer = simulate(rig(actuators=(Actuator("F1", 2.0, time_constant=0.2),)), shifted, sample_time=DT / 200).outputs
    mine = simulate(both, inputs, sample_time=DT).outputs
    assert np.abs(mine - peer[:, ::200]).max() < 1e-8 * np.abs(peer).max()


@pytest.mark.parametrize("sample_time", [0.02, 0.1, 0.0625])
@pytest.mark.parametrize("elements", [(), (CubicSpring(4.0, 0.0),)], ids=["linear", "stepped"])
def test_a_delay_of_whole_samples_reads_accelerations_after_its_jumps(elements, sample_time):
    """Whatever round-off makes of it: 0.1 over 0.02 leaves 3e-18."""
    inputs = drive(100)
    for whole in (1, 3, 5, 7):
        actuators = tuple(Actuator(n, at, delay=whole * sample_time) for n, at in (("F1", 2.0), ("F2", 6.3)))
        late = simulate(rig(elements, actuators=actuators), inputs, sample_time=sample_time).outputs
        at_once = simulate(rig(elements), inputs, sample_time=sample_time).outputs
        np.testing.assert_allclose(late[:, whole:], at_once[:, :-whole], rtol=0, atol=1e-10 * np.abs(at_once).max())


@pytest.mark.parametrize(
    ("element", "force", "size"),
    [
        (CubicSpring(4.0, 0.3), lambda w, v: -0.3 * w**3, 0.3),
        (PowerSpring(4.0, 0.02, 0.2, 1.5), lambda w, v: -0.02 * np.sign(w) * abs(w / 0.2) ** 1.5, 0.3),
        (EvenSpring(4.0, 0.01, 0.2, 2.0), lambda w, v: -0.01 * abs(w / 0.2) ** 2.0, 0.3),
        (PowerDamper(4.0, 0.1, 0.5, 2.4), lambda w, v: -0.1 * np.sign(v) * abs(v / 0.5) ** 2.4, 0.3),
        (Clearance(4.0, 0.2, 0.03), lambda w, v: -0.2 * np.sign(w) * max(abs(w) - 0.03, 0.0), 0.3),
        (OneSidedStop(4.0, 0.2, 0.03), lambda w, v: -0.2 * max(w - 0.03, 0.0), 0.3),
        (CoulombFriction(4.0, 0.1, 0.05), lambda w, v: -0.1 * np.tanh(v / 0.05), 0.3),
        (UserLaw(4.0, lambda w, v, p: -p[0] * w * abs(w), (0.4,)), lambda w, v: -0.4 * w * abs(w), 0.3),
    ],
)
def test_point_laws_against_an_adaptive_integrator(element, force, size):
    r = rig((element,))
    shape = r.modes.phi(4.0)[0]
    inputs = drive(120, size)
    peer = continuous(r, inputs, lambda t, q, v: shape * force(shape @ q, shape @ v))
    linear = simulate(rig(), inputs, sample_time=DT).outputs[0]
    errors = [np.abs(simulate(r, inputs, sample_time=DT, substeps=k).outputs[0] - peer).max() for k in (8, 32)]
    assert np.abs(linear - peer).max() > 30 * errors[0]
    assert errors[1] < 1e-4 * np.abs(peer).max() and errors[1] < 0.25 * errors[0]


def test_friction_that_all_but_jumps_against_an_adaptive_integrator():
    """At four substeps a sample: even ones leave ten times as much where it turns."""
    r = rig((CoulombFriction(4.0, 0.1, 0.002),))
    shape, inputs = r.modes.phi(4.0)[0], drive(120, 0.3)
    peer = continuous(r, inputs, lambda t, q, v: shape * -0.1 * np.tanh(shape @ v / 0.002))
    error = simulate(r, inputs, sample_time=DT, substeps=4).outputs[0] - peer
    assert np.sqrt((error**2).mean()) < 1e-4 * np.abs(peer).max()


def test_bouc_wen_against_an_adaptive_integrator():
    k, limit = 0.5, 0.2
    r = rig((BoucWen(4.0, k, limit),))
    shape, n = r.modes.phi(4.0)[0], r.modes.n_modes

    def rate(q, v, z):
        speed = shape @ v
        return speed - (abs(speed) * z + speed * abs(z)) / (2 * limit)

    inputs = drive(120, 0.3)
    peer = continuous(r, inputs, lambda t, q, s: -k * s[2 * n] * shape, 1, rate)
    mine = simulate(r, inputs, sample_time=DT, substeps=32).outputs[0]
    assert np.abs(mine - peer).max() < 2e-4 * np.abs(peer).max()


@pytest.mark.parametrize(("element", "limit"), [(MidplaneStretching(0.4), 1e-5), (AirDrag(0.3), 1e-3)])
def test_stretching_and_drag_against_an_adaptive_integrator(element, limit):
    r = rig((element,))
    points, weights = np.polynomial.legendre.leggauss(200)
    x, w = 5 * (points + 1), 5 * weights
    slopes, shapes = r.modes.phi(x, 1), r.modes.phi(x)

    def extra(t, q, v):
        if isinstance(element, MidplaneStretching):
            slope = slopes @ q
            return -0.4 * (w @ slope**2) * (slopes.T @ (w * slope))
        speed = shapes @ v
        return -0.3 * shapes.T @ (w * np.abs(speed) * speed)

    inputs = drive(120, 3.0)
    peer = continuous(r, inputs, extra)
    linear = simulate(rig(), inputs, sample_time=DT).outputs[0]
    error = np.abs(simulate(r, inputs, sample_time=DT, substeps=32).outputs[0] - peer).max()
    assert error < limit * np.abs(peer).max() and np.abs(linear - peer).max() > 30 * error


def test_stiffness_drift_against_an_adaptive_integrator():
    r = rig(stiffness_rate=0.02)
    inputs = drive(120)
    peer = continuous(r, inputs, scale=lambda t: 1 + 0.02 * t)
    mine = simulate(r, inputs, sample_time=DT).outputs[0]
    assert np.abs(mine - peer).max() < 1e-4 * np.abs(peer).max()


@pytest.mark.parametrize("input_hold", ["zero", "first"])
@pytest.mark.parametrize("ends", ["hinged", "free"])
@pytest.mark.parametrize(
    "transducer",
    [
        {"delay": 0.137},
        {"delay": 0.2},
        {"delay": 0.45, "bias": 0.3},
        {"time_constant": 0.004},
        {"time_constant": 0.23, "gain": 0.8},
        {"delay": 0.137, "time_constant": 0.004},
        {"delay": 0.2, "time_constant": 0.02, "dead_zone": 0.1},
    ],
    ids=str,
)
def test_delays_and_lags_are_exact_beside_a_law_too(transducer, ends, input_hold):
    """One substep a sample, in which the highest mode goes through five cycles, on the stepped route and the linear."""
    both = {**vars(beam()), "left": ends, "right": ends, "damping": ModalDamping((1.5, *29 * (0.01,)))}
    modes = Beam(**both).modes(30 if ends == "hinged" else 20)
    actuators = (Actuator("F1", 2.0, **transducer), Actuator("F2", 6.3))
    exact, stepped = (rig(laws, modes, actuators) for laws in ((), (CubicSpring(4.0, 0.0),)))
    linear = simulate(exact, drive(100), sample_time=DT, input_hold=input_hold).outputs
    for substeps in (1, 3):
        mine = simulate(stepped, drive(100), sample_time=DT, substeps=substeps, input_hold=input_hold).outputs
        np.testing.assert_allclose(mine, linear, rtol=0, atol=1e-9 * np.abs(linear).max())


def test_periodic_force_exactly():
    r = rig((PeriodicForce(4.0, 0.13, 0.7, 0.4),))
    inputs = np.zeros((2, 150))
    shape = r.modes.phi(4.0)[0]
    peer = continuous(r, inputs, lambda t, q, v: shape * 0.7 * np.sin(2 * np.pi * 0.13 * t + 0.4))
    assert np.abs(simulate(r, inputs, sample_time=DT).outputs[0] - peer).max() < 1e-8 * np.abs(peer).max()


def test_two_point_elements_and_linear_ones_agree_with_the_structure():
    stepped = rig((LinearDamper(3.0, 0.2), LinearSpring(7.0, 0.0)))
    exact = rig(modes=beam(attachments=(PointDamper(3.0, 0.2),)).modes(6))
    inputs = drive()
    a = simulate(stepped, inputs, sample_time=DT, substeps=64).outputs
    b = simulate(exact, inputs, sample_time=DT).outputs
    assert np.abs(a - b).max() < 2e-4 * np.abs(b).max()


@pytest.mark.parametrize("parts", [2, 3])
@pytest.mark.parametrize(
    "law",
    [
        lambda share: CubicSpring(4.7, 40.0 * share),
        lambda share: OneSidedStop(4.7, 30.0 * share, 0.2),
        lambda share: Clearance(4.7, 30.0 * share, 0.2),
        lambda share: CoulombFriction(4.7, 0.3 * share, 0.002),
        lambda share: BoucWen(4.7, 20.0 * share, 0.02),
    ],
)
def test_elements_at_one_place_do_what_one_of_their_strength_does(law, parts):
    u = drive()
    one = simulate(rig((law(1.0),)), u, sample_time=DT).outputs
    several = simulate(rig((law(1.0 / parts),) * parts), u, sample_time=DT).outputs
    np.testing.assert_allclose(several, one, atol=1e-8 * np.abs(one).max())


def test_laws_of_the_users_own_act_beside_each_other():
    known = (CubicSpring(4.0, 0.3), LinearDamper(2.7, 0.2))
    own = (UserLaw(4.0, lambda w, v, p: -p[0] * w**3, (0.3,)), UserLaw(2.7, lambda w, v, p: -p[0] * v, (0.2,)))
    one, other = (simulate(rig(elements), drive(), sample_time=DT).outputs for elements in (known, own))
    np.testing.assert_allclose(other, one, atol=1e-8 * np.abs(one).max())


def test_accelerations_where_damping_couples_the_modes_and_a_law_is_not_linear():
    damped = rig((CubicSpring(4.0, 50.0),), modes=beam(attachments=(PointDamper(3.0, 0.2),)).modes(6))
    beside = rig((CubicSpring(4.0, 50.0), LinearDamper(3.0, 0.2)))
    a, b = (move(r, drive(), sample_time=DT, substeps=32) for r in (damped, beside))
    assert np.abs(damped.modes.damping[0, 1]) > 0.01
    assert np.abs(a.acceleration - b.acceleration).max() < 1e-3 * np.abs(b.acceleration).max()


@pytest.mark.parametrize(
    "element",
    [
        CubicSpring(4.0, 0.0),
        Clearance(4.0, 0.0, 0.1),
        CoulombFriction(4.0, 0.0, 0.1),
        BoucWen(4.0, 0.0, 0.1),
        MidplaneStretching(0.0),
        AirDrag(0.0),
        PeriodicForce(4.0, 0.1, 0.0, 0.0),
    ],
)
def test_an_element_of_no_strength_changes_nothing(element):
    inputs = drive(100)
    a = simulate(rig((element,)), inputs, sample_time=DT, substeps=2).outputs
    b = simulate(rig(), inputs, sample_time=DT).outputs
    np.testing.assert_allclose(a, b, atol=1e-9 * np.abs(b).max())


def test_sensor_chain():
    inputs = drive(100)
    plain = simulate(rig(sensors=(Sensor("d", 3.1),)), inputs, sample_time=DT).outputs[0]
    top = np.abs(plain).max()
    changed = Sensor("d", 3.1, gain=1.5, bias=0.1 * top, drift=0.2 * top, limit=0.8 * top)
    mine = simulate(rig(sensors=(changed,)), inputs, sample_time=DT).outputs[0]
    expected = np.clip(1.5 * plain + 0.1 * top + 0.2 * top * np.linspace(0, 1, 100), -0.8 * top, 0.8 * top)
    np.testing.assert_allclose(mine, expected, atol=1e-12)


def test_sensor_lag_of_a_ramp_is_exact():
    t = np.arange(50) * DT
    lagged = sensor_reading(Sensor("d", 1.0, time_constant=0.3), 2.0 * t, DT)
    np.testing.assert_allclose(lagged, 2.0 * (t - 0.3 * (1 - np.exp(-t / 0.3))), atol=1e-12)


def test_mean_rounded_reading():
    sensor = Sensor("d", 1.0, step=1.0, noise_std=0.3)
    truth = np.linspace(-1, 1, 9)
    noise = 0.3 * np.random.default_rng(0).standard_normal((200000, 1))
    sampled = np.round(truth + noise).mean(axis=0)
    np.testing.assert_allclose(sensor_reading(sensor, truth, DT), sampled, atol=5e-3)


def test_inputs_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="Is time last"):
        simulate(rig(), np.zeros((100, 2)), sample_time=DT)


@pytest.mark.parametrize("input_hold", ["zero", "first", "band-limited"])
def test_a_rig_without_actuators_is_moved_by_its_periodic_force_alone(input_hold):
    """Beside a law as without one; a law alone leaves it at rest."""
    periodic, nothing, no_inputs = PeriodicForce(4.0, 0.13, 0.7, 0.4), CubicSpring(4.0, 0.0), np.zeros((0, 100))
    sensors = (Sensor("d", 3.1), Sensor("a", 7.0, "acceleration"))
    given = {"sample_time": DT, "input_hold": input_hold}
    alone = [
        simulate(Rig(beam().modes(6), (), sensors, elements), no_inputs, **given).outputs
        for elements in ((periodic,), (periodic, nothing), (nothing,))
    ]
    np.testing.assert_allclose(alone[1], alone[0], rtol=0, atol=1e-9 * np.abs(alone[0]).max())
    assert not alone[2].any()


def test_state_space_names_and_lags():
    system = state_space(
        beam().modes(2), (Actuator("F1", 2.0, time_constant=0.1),), (Sensor("y", 3.0, time_constant=0.2),)
    )
    assert system.input_labels == ["F1"] and system.output_labels == ["y"]
    assert system.state_labels == ["q1", "q2", "dq1", "dq2", "F1_lag", "y_lag"]
    plain = state_space(beam().modes(2), (Actuator("F1", 2.0),), (Sensor("y", 3.0),))
    s = 0.7j
    np.testing.assert_allclose(system(s), plain(s) / (1 + 0.1 * s) / (1 + 0.2 * s), rtol=1e-12)


def test_an_actuator_on_a_support_is_refused():
    with pytest.raises(ValueError, match="is on the support"):
        state_space(beam().modes(2), (Actuator("F1", 0.0),), (Sensor("y", 3.0),))


def test_the_stepper_is_compiled_once():
    """For any rig: a sum of no coefficients, or forces in another order of memory, had it compiled four times over."""
    inputs = drive(20)
    one_driven = inputs * [[1.0], [0.0]]
    for elements in (
        (CubicSpring(4.0, 0.3),),
        (MidplaneStretching(0.2),),
        (AirDrag(0.1), PeriodicForce(4.0, 0.1, 1.0, 0.0)),
    ):
        for u in (inputs, one_driven):
            outputs = simulate(rig(elements), u, sample_time=DT).outputs
            prediction_errors(rig(elements), u, outputs, np.zeros((2, 6, 3)), sample_time=DT)
    assert len(step_record.signatures) == 1


@pytest.mark.parametrize("input_hold", ["zero", "first"])
@pytest.mark.parametrize("elements", [(), (CubicSpring(3.1, 5.0),)], ids=["linear", "stepped"])
def test_nothing_remembered_outlives_what_it_was_found_for(elements, input_hold):
    """Inputs that are written to, other inputs, other places and another structure: each as if asked for first."""
    first, u = rig(elements), drive()
    given = {"sample_time": DT, "input_hold": input_hold}
    once = simulate(first, u, **given).outputs
    np.testing.assert_array_equal(simulate(first, u, **given).outputs, once)
    u *= 2.0
    twice = simulate(first, u, **given).outputs
    np.testing.assert_array_equal(twice, simulate(first, 2.0 * drive(), **given).outputs)
    assert np.abs(twice - once).max() > 0.5 * np.abs(once).max()
    recorded = simulate(first, drive(seed=1), **given)  # nobody can write to the inputs of a record
    for others in (
        {"actuators": (Actuator("F1", 3.0), Actuator("F2", 6.3))},
        {"sensors": tuple(Sensor(n, at) for n, at in (("d", 3.5), ("v", 4.4), ("a", 7.0)))},
        {"modes": beam(attachments=(PointDamper(4.0, 0.3),)).modes(6)},
    ):
        again = [
            simulate(rig(elements, **others), inputs, **given).outputs for inputs in (recorded.inputs, drive(seed=1))
        ]
        np.testing.assert_array_equal(again[0], again[1])
        assert np.abs(again[0] - recorded.outputs).max() > 0.01 * np.abs(recorded.outputs).max()
