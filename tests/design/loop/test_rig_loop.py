"""A rig under a digital controller, against the open-loop simulation, the exact continuous loop and its own step."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.design.estimation.controller import Controller
from workbench.design.estimation.digital import DigitalController, FrictionFeedforward, sampled
from workbench.design.estimation.observers import kalman_controller
from workbench.design.export.sampled_loop import sampled_loop
from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_with, impulse_state, initial_response
from workbench.design.loop.rig_loop import LoopTest, run_loop
from workbench.design.spillover.spillover import finite_spillover
from workbench.rig.actuators import Actuator, without_crosstalk
from workbench.rig.elements import AirDrag, BoucWen, CoulombFriction, CubicSpring, MidplaneStretching, UserLaw
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate

DT = 0.005


@pytest.fixture(scope="module")
def rig(hinged_beam):
    sensors = [Sensor(f"{q[0]}{i}", x, q) for q in ("displacement", "velocity") for i, x in enumerate((0.3, 0.7, 1.6))]
    return Rig(hinged_beam.modes(5), (Actuator("F1", 0.45), Actuator("F2", 1.2)), tuple(sensors), structure=hinged_beam)


def restless(rig: Rig, gain: float = 2.0) -> DigitalController:
    """A velocity feedback that also shakes: its offset makes an oscillator of its own ring."""
    turn = np.array([[np.cos(0.07), np.sin(0.07)], [-np.sin(0.07), np.cos(0.07)]])
    names = tuple(s.name for s in rig.sensors)
    feedback = np.zeros((2, len(names)))
    feedback[:, 3:5] = -gain * np.eye(2)
    b = np.zeros((2, len(names)))
    b[:, 0] = 0.05
    offset = np.r_[-1.0, np.zeros(len(names) - 1)]
    actuators = tuple(a.name for a in rig.actuators)
    return DigitalController(DT, names, actuators, turn, b, 3.0 * np.eye(2), feedback, np.zeros((2, 2)), offset=offset)


DRIVES = {
    "plain": {},
    "dead zone, saturation": {"gain": 0.8, "dead_zone": 0.5, "limit": 2.0},
    "delay, lag": {"delay": 1.3 * DT, "time_constant": 0.02, "bias": 0.3},
    "rate limit, hysteresis": {"rate_limit": 40.0, "hysteresis_share": 0.4, "hysteresis_width": 1.0},
}
LAWS = {
    "none": (),
    "friction": (CoulombFriction(0.9, 0.4, 0.02),),
    "two": (CubicSpring(0.9, 300.0), BoucWen(1.5, 20.0, 0.02)),
    "of the user's own": (UserLaw(0.9, lambda w, v, p: -p[0] * w**3, (300.0,)), BoucWen(1.5, 20.0, 0.02)),
    "three, and all along": (
        CubicSpring(0.5, 300.0), BoucWen(1.5, 20.0, 0.02), CoulombFriction(1.1, 0.2, 0.05), AirDrag(0.1),
        MidplaneStretching(5.0),
    ),
}  # fmt: skip


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("laws", LAWS)
def test_the_motion_is_that_of_the_commands_that_were_sent(rig, drive, laws):
    actuators = tuple(replace(a, **DRIVES[drive]) for a in rig.actuators)
    real = replace(rig, actuators=actuators, elements=LAWS[laws])
    run = run_loop(real, restless(rig), LoopTest(400, DT), substeps=8)
    expected = simulate(real, run.commands, sample_time=DT, substeps=8).outputs[:3]
    assert run.bounded and np.abs(run.commands).max() > 1.0
    assert run.response.displacement([0.3, 0.7, 1.6]) == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())


def leaking(rig: Rig, **both) -> Rig:
    shares = ((("F2", 0.3),), (("F1", -0.2),))
    return replace(
        rig, actuators=tuple(replace(a, crosstalk=each, **both) for a, each in zip(rig.actuators, shares, strict=True))
    )


@pytest.mark.parametrize("drive", DRIVES)
def test_cross_talk_mixes_the_commands(rig, drive):
    """Against the open-loop simulation, and against a controller that mixes them by hand."""
    real, controller = leaking(rig, **DRIVES[drive]), restless(rig)
    run = run_loop(real, controller, LoopTest(400, DT), substeps=8)
    expected = simulate(real, run.commands, sample_time=DT, substeps=8).outputs[:3]
    assert run.response.displacement([0.3, 0.7, 1.6]) == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())
    mix = np.array([[1.0, 0.3], [-0.2, 1.0]])
    by_hand = replace(controller, C=mix @ controller.C, D=mix @ controller.D)
    plain = replace(rig, actuators=tuple(replace(a, **DRIVES[drive]) for a in rig.actuators))
    peer = run_loop(plain, by_hand, LoopTest(400, DT), substeps=8)
    np.testing.assert_allclose(run.response.modal, peer.response.modal, atol=1e-9 * np.abs(peer.response.modal).max())
    np.testing.assert_allclose(mix @ run.commands, peer.commands, atol=1e-9 * np.abs(peer.commands).max())


def test_cross_talk_in_a_loop_is_that_of_the_sampled_loop(rig):
    real, names = leaking(rig, gain=0.8, delay=1.25 * DT), ("d0", "v0", "v1")
    sensors = [s for s in rig.sensors if s.name in names]
    feedback = np.array([[-3.0, -2.0, 0.0], [0.0, 1.0, -3.0]])
    empty = np.zeros((0, 0)), np.zeros((0, 3)), np.zeros((2, 0))
    controller = DigitalController(DT, names, ("F1", "F2"), *empty, feedback, np.zeros((0, 2)))
    run = run_loop(real, controller, LoopTest(60, DT, impulse_at=0.8))
    state = np.zeros(sampled_loop(rig.modes, real.actuators, sensors, controller).shape[0])
    state[:10], expected = impulse_state(rig.modes, 0.8), []
    for _ in range(60):
        expected.append(state[:10])
        state = sampled_loop(rig.modes, real.actuators, sensors, controller) @ state
    found, expected = run.response.modal, np.array(expected).T
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
    without = run_loop(
        replace(rig, actuators=without_crosstalk(real.actuators)), controller, LoopTest(60, DT, impulse_at=0.8)
    )
    assert np.abs(found - without.response.modal).max() > 0.01 * np.abs(expected).max()


def test_cross_talk_into_an_actuator_that_is_not_driven_is_refused(rig):
    controller = restless(rig)
    one = replace(controller, actuators=("F1",), C=controller.C[:1], D=controller.D[:1], E=controller.E[:, :1])
    for name, there in (("limit", np.inf), ("rate", np.inf), ("dead_zone", 0.0), ("bias", 0.0)):
        one = replace(one, **{name: np.array([there])})
    with pytest.raises(ValueError, match="F2 takes a share of the command of F1, and the controller does not drive it"):
        run_loop(leaking(rig), one, LoopTest(20, DT))
    taking = replace(rig, actuators=(leaking(rig).actuators[0], rig.actuators[1]))  # from F2, which has no command
    found, expected = (run_loop(r, one, LoopTest(20, DT)).commands for r in (taking, rig))
    np.testing.assert_array_equal(found, expected)


def test_what_is_read_is_what_the_sensors_read(rig):
    """Sensors that are late, slow, scaled, offset, rounded and clipped, against the readings of `simulate`."""
    faults = [
        {"delay": 1.4 * DT}, {"time_constant": 0.03}, {"gain": 1.3, "bias": 0.02, "drift": 0.05},
        {"limit": 0.1}, {"step": 0.02}, {"crosstalk": (("d0", 0.2), ("v1", 0.1))},
    ]  # fmt: skip
    real = replace(rig, sensors=tuple(replace(s, **f) for s, f in zip(rig.sensors, faults, strict=True)))
    n = len(real.sensors)
    # a controller that only passes one reading on to an actuator that moves nothing
    names = tuple(s.name for s in real.sensors)
    mute = replace(real, actuators=(*real.actuators, *(Actuator(f"M{j}", 2.0 - 1e-12) for j in range(n))))
    shaken = restless(rig, 0.0)
    d = np.vstack([shaken.D, np.eye(n)])
    c = np.vstack([shaken.C, np.zeros((n, 2))])
    telling = DigitalController(
        DT, names, tuple(a.name for a in mute.actuators), shaken.A, shaken.B * 0.0, c, d, np.zeros((2, n + 2))
    )
    forces = np.random.default_rng(0).normal(size=(1, 300)).cumsum(axis=1)
    test = LoopTest(300, DT, forces=forces, exciters=rig.actuators[:1])
    told = run_loop(mute, telling, test, substeps=16).commands[2:]
    expected = simulate(replace(real, actuators=rig.actuators[:1]), forces, sample_time=DT).outputs
    for j in range(n):
        assert told[j] == pytest.approx(expected[j], abs=5e-3 * np.abs(expected[j]).max() + (0.02 if j == 4 else 0.0))


def test_a_sensor_without_gain_reads_zero(rig):
    dead = tuple(replace(s, gain=0.0) if s.name == "v0" else s for s in rig.sensors)
    controller, test = restless(rig), LoopTest(200, DT)
    deaf = replace(controller, D=np.where(np.array(controller.sensors) == "v0", 0.0, controller.D))
    found = run_loop(replace(rig, sensors=dead), controller, test).commands
    np.testing.assert_array_equal(found, run_loop(rig, deaf, test).commands)
    assert np.abs(found - run_loop(rig, controller, test).commands).max() > 0.1


def test_a_fast_loop_comes_to_the_exact_continuous_one(rig):
    law = imsc(rig.modes, 2, rig.actuators, weight=0.02)
    controller = kalman_controller(rig.modes, law, rig.sensors, disturbance=1.0, noise=1e-2)
    loop = close_with(rig.modes, controller)
    state = impulse_state(rig.modes, 0.8)
    errors = []
    for refined in (1, 2):
        dt = 0.002 / refined
        run = run_loop(rig, sampled(controller, dt), LoopTest(1000 * refined, dt, impulse_at=0.8))
        exact = initial_response(loop, run.response.time, state)
        work = finite_spillover(loop, state, run.response.time[-1]).work_by_mode
        motion = np.abs(run.response.modal[:5] - exact.modal[:5]).max() / np.abs(exact.modal[:5]).max()
        errors.append((motion, np.abs(run.work - work).max() / np.abs(work).max()))
    coarse, fine = np.array(errors)
    assert (coarse < 0.1).all() and (np.abs(fine / coarse - 0.5) < 0.1).all()  # of first order, as a hold is


def test_the_compiled_controller_is_its_own_step(rig):
    rng = np.random.default_rng(3)
    n = len(rig.sensors)
    friction = FrictionFeedforward(*(rng.normal(size=s) for s in ((2, 1), (1, 2), (1, n))), np.ones(1), np.full(1, 0.5))
    base = restless(rig, 3.0)
    one = replace(
        base, A=0.9 * base.A, E=rng.normal(size=(2, 2)), scale=1 + 0.1 * rng.normal(size=n), limit=np.full(2, 4.0),
        rate=np.full(2, 1.5), dead_zone=np.array([0.0, 0.4]), bias=np.full(2, 0.2), friction=friction,
    )  # fmt: skip
    run = run_loop(rig, one, LoopTest(200, DT))
    modal = run.response.modal
    shapes = rig.modes.phi([s.at for s in rig.sensors])
    z, v = np.zeros(2), np.zeros(2)
    for k in range(200):
        reading = np.r_[shapes[:3] @ modal[:5, k], shapes[3:] @ modal[5:, k]]
        command, v, z = one.step(z, v, reading)
        assert command == pytest.approx(run.commands[:, k], rel=1e-9, abs=1e-9)


def test_a_loop_that_runs_away_is_told(rig):
    run = run_loop(rig, restless(rig, -400.0), LoopTest(2000, DT))
    assert not run.bounded


def test_what_does_not_fit_is_named(rig):
    one = restless(rig)
    with pytest.raises(ValueError, match=r"sensor 'd0'.* it has v0, v1"):
        run_loop(replace(rig, sensors=rig.sensors[3:]), one, LoopTest(10, DT))
    with pytest.raises(ValueError, match="give both the same"):
        run_loop(rig, one, LoopTest(10, 2 * DT))
    with pytest.raises(ValueError, match="Is time last"):
        LoopTest(10, DT, forces=np.zeros((10, 1)), exciters=rig.actuators[:1])


def test_the_linear_part_is_pythons_control(rig):
    law = imsc(rig.modes, 2, rig.actuators, weight=0.02)
    controller = kalman_controller(rig.modes, law, rig.sensors, disturbance=1.0, noise=1e-4)
    import control

    continuous = controller.state_space()
    expected = control.c2d(continuous, DT)
    found = sampled(controller, DT).state_space()
    assert isinstance(controller, Controller) and found.dt == DT
    assert found.A == pytest.approx(expected.A, abs=1e-9) and found.B == pytest.approx(expected.B, abs=1e-9)


def test_a_test_and_its_run_cannot_be_written_to(rig):
    forces = np.zeros((1, 10))
    test = LoopTest(10, DT, forces=forces, exciters=(Actuator("h", 0.8, direct=True),))
    forces[:] = 9.0
    assert not test.forces.any()
    run = run_loop(rig, restless(rig), test)
    for array in (test.forces, run.commands, run.elements, run.participation):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 1.0
