"""Observers and filters in one loop: separation, peers, spillover explained to the path, remedies that hold."""

from dataclasses import replace

import control
import numpy as np
import pytest

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import displacement_filter, hermite_filter
from workbench.design.estimation.observers import kalman_controller, luenberger_controller, usual_poles
from workbench.design.laws.coupled import controlled_plant, coupled_lqr, coupled_poles
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError, Law
from workbench.design.loop.closed_loop import close_loop, close_with, impulse_state, initial_response
from workbench.design.spillover.explain import explain_spillover
from workbench.design.spillover.remedies import spillover_remedies, sufficient_sensors
from workbench.design.spillover.spillover import effort, energy_gained, finite_spillover
from workbench.rig.actuators import Actuator, piezo_patch
from workbench.rig.sensors import Sensor
from workbench.rig.statespace import state_space
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints
from workbench.structure.finite_elements import FiniteElements
from workbench.structure.member import Beam
from workbench.structure.plate import Plate

ACTUATORS = (Actuator("F1", 10 / 6),)


def beam(n=9, zeta=0.002):
    damping = ModalDamping(zeta)
    return Beam(
        length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged", damping=damping
    ).modes(n)


def observed(modes, at, share=1.0, actuators=ACTUATORS):
    law = coupled_lqr(modes, 3, actuators, weight=1.0)
    law = Law(share * law.gain, law.controlled, law.actuators, law.name)
    sensors = [Sensor(f"y{i + 1}", x) for i, x in enumerate(np.atleast_1d(at))]
    return luenberger_controller(modes, law, sensors, poles=(-0.3 + 1j) * modes.omega[:3])


def through_filter(modes, actuators, places, share=1.0):
    law = coupled_lqr(modes, 3, actuators, weight=1.0)
    law = Law(share * law.gain, law.controlled, law.actuators, law.name)
    return filtered(law, displacement_filter(modes.select(range(3)), places, 1.0))


def nearest(poles, wanted):
    return max(np.abs(poles - p).min() / abs(p) for p in wanted)


def test_without_residual_modes_law_and_observer_keep_their_poles():
    modes = beam(3)
    controller = observed(modes, 10 / 1.2)
    a, b = controlled_plant(modes, range(3), ACTUATORS)
    wanted = np.r_[np.linalg.eigvals(a - b @ controller.law.gain), (-0.3 + 1j) * modes.omega]
    assert nearest(close_with(modes, controller).poles, wanted) < 1e-9


def test_kalman_gain_is_that_of_the_dual_regulator():
    modes = beam(3)
    law = coupled_lqr(modes, 3, ACTUATORS, weight=1.0)
    sensors = [Sensor("y", 3.1), Sensor("v", 4.4, "velocity")]
    gain = kalman_controller(modes, law, sensors, disturbance=0.5, noise=[1e-2, 1e-3]).B
    a, _ = controlled_plant(modes, range(3), ACTUATORS)
    shapes = modes.phi([3.1, 4.4])
    c = np.block([[shapes[:1], np.zeros((1, 3))], [np.zeros((1, 3)), shapes[1:]]])
    peer = control.lqr(a.T, c.T, np.diag([0, 0, 0, 0.5, 0.5, 0.5]), np.diag([1e-2, 1e-3]))[0].T
    np.testing.assert_allclose(gain, peer, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("kind", [hermite_filter, displacement_filter])
def test_a_filter_closes_the_same_loop_either_way(kind):
    modes = beam()
    law = coupled_lqr(modes, 3, ACTUATORS, weight=1.0)
    filter_ = kind(modes.select(range(3)), np.linspace(0.0, 10.0, 6), 1.0)
    one, other = close_loop(modes, law, filter_), close_with(modes, filtered(law, filter_))
    np.testing.assert_allclose(one.matrix, other.matrix, atol=1e-13)
    np.testing.assert_allclose(one.feedback, other.feedback, atol=1e-13)


def test_an_observer_in_the_loop_against_python_control():
    modes, state, time = beam(), impulse_state(beam(), 6.3), np.linspace(0.0, 30.0, 61)
    controller = observed(modes, 3.1)
    n, m = 9, 3
    plant = control.ss(
        np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(modes.omega**2), -modes.damping]]),
        np.r_[np.zeros((n, 1)), modes.phi(10 / 6).T],
        np.c_[modes.phi(3.1), np.zeros((1, n))],
        0,
    )
    a, b = controlled_plant(modes, range(m), ACTUATORS)
    c = np.c_[modes.phi(3.1)[:, :m], np.zeros((1, m))]
    observer = control.ss(a - b @ controller.law.gain - controller.B @ c, controller.B, -controller.law.gain, 0)
    loop = control.feedback(plant, observer, sign=1)
    peer = control.initial_response(loop, time, np.r_[state, np.zeros(2 * m)]).states[: 2 * n]
    mine = initial_response(close_with(modes, controller), time, state)
    np.testing.assert_allclose(mine.modal, peer, atol=1e-9)
    # the work counts the same motion
    loss = np.diag(modes.damping)
    fine = initial_response(close_with(modes, controller), np.linspace(0.0, 30.0, 6001), state)
    gained = fine.energy[:, -1] - fine.energy[:, 0]
    work = finite_spillover(close_with(modes, controller), state, 30.0).work_by_mode
    np.testing.assert_allclose(work, gained + np.trapezoid(loss[:, None] * fine.modal[n:] ** 2, fine.time), atol=1e-6)


def test_a_residual_mode_is_named_that_stays_stable_and_destabilises_a_controlled_one():
    modes = beam(5, 0.01)
    controller = observed(modes, 3.3)
    told = explain_spillover(modes, controller)
    assert told.decay_rate < 0 and told.reduced_decay_rate > 0 and told.shifts[0].closed_pole.real < 0
    assert told.destabilising.mode == 3 and close_with(modes.select([0, 1, 2, 4]), controller).decay_rate > 0
    assert close_with(modes.select([0, 1, 2, 3]), controller).decay_rate < 0


def test_balas_one_sensor_stabilises_here_and_destabilises_there():
    modes = beam()
    good, bad = explain_spillover(modes, observed(modes, 10 / 6)), explain_spillover(modes, observed(modes, 50 / 6))
    assert good.decay_rate > 0 and good.destabilising is None
    assert bad.decay_rate < 0 and bad.destabilising.mode == 3
    assert bad.reduced_decay_rate == pytest.approx(
        close_with(modes.select(range(3)), observed(modes, 50 / 6)).decay_rate
    )
    # without either spillover the same mode would stay
    assert close_with(modes.select(range(3)), observed(modes, 50 / 6)).decay_rate > 0


@pytest.mark.parametrize(
    "controller", [lambda m: observed(m, [3.1, 7.7]), lambda m: through_filter(m, ACTUATORS, [2.0, 5.5])]
)
def test_paths_add_up_to_the_movement_of_the_pole(controller):
    modes = beam()
    explained = explain_spillover(modes, controller(modes))
    assert len(explained.shifts) == 6
    for moved in explained.shifts:
        assert sum(path.shift for path in moved.paths) == pytest.approx(moved.shift, abs=1e-9 * abs(moved.pole))
        assert np.abs(explained.poles - moved.closed_pole).min() == 0.0


def poles_by_python_control(modes, controller):
    plant = state_space(modes, controller.law.actuators, controller.sensors)
    own = controller.state_space()
    return control.feedback(plant, own, sign=1).poles()


@pytest.mark.parametrize(
    ("ends", "zeta", "controlled"),
    [
        ("free", 0.01, (2, 3)),
        ("hinged", [0.01, 0.01, 1.5, 0.01], (0, 1)),
        ("hinged", [0.01, 0.01, 1.0, 0.01], (0, 1)),
    ],
)
def test_rigid_and_overdamped_residual_modes_have_their_poles_too(ends, zeta, controlled):
    modes = Beam(
        length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left=ends, right=ends, damping=ModalDamping(zeta)
    ).modes(6)
    law = imsc(modes, controlled, [Actuator("A", 0.2), Actuator("B", 0.45)], weight=0.1)
    sensors = [Sensor("y1", 0.15), Sensor("y2", 0.4)]
    told = explain_spillover(modes, luenberger_controller(modes, law, sensors, poles=usual_poles(modes, controlled)))
    peer = poles_by_python_control(
        modes, luenberger_controller(modes, law, sensors, poles=usual_poles(modes, controlled))
    )
    assert {moved.mode for moved in told.shifts} == set(range(6)) - set(controlled)
    assert told.decay_rate == pytest.approx(-peer.real.max(), rel=1e-6)
    for moved in told.shifts:
        assert np.abs(peer - moved.closed_pole).min() < 1e-5 * abs(modes.omega[-1])
        assert sum(path.shift for path in moved.paths) == pytest.approx(moved.shift, abs=1e-7 * modes.omega[-1])
    if ends == "free":  # what the sensors see of a rigid mode makes it grow; nothing else is at its pole
        assert told.destabilising is told.limiting is told.shifts[0] and told.shifts[0].mode in (0, 1)
    else:  # ζ of 1.5 and 1 in open loop: -ω (ζ - √(ζ² - 1))
        slow = {moved.mode: moved for moved in told.shifts}[2]
        assert slow.pole == pytest.approx(-modes.omega[2] * (zeta[2] - np.sqrt(zeta[2] ** 2 - 1)))
        assert told.limiting.mode == 3


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("quantities", [("velocity", "velocity"), ("velocity", "displacement")])
def test_the_rigid_displacement_that_no_sensor_reads_stays_where_it_is(quantities):
    free = Beam(
        length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left="free", right="free", damping=ModalDamping(0.01)
    ).modes(6)
    law = imsc(free, (2, 3), [Actuator("A", 0.2), Actuator("B", 0.45)], weight=0.1)
    sensors = [Sensor(f"y{at}", at, quantity) for at, quantity in zip((0.15, 0.4), quantities)]
    told = explain_spillover(free, luenberger_controller(free, law, sensors, poles=usual_poles(free, (2, 3))))
    rigid = [moved for moved in told.shifts if moved.mode in (0, 1)]
    still = [moved for moved in rigid if abs(moved.closed_pole) < 1e-9]
    assert len(still) == quantities.count("velocity") and all(path.shift == 0 for m in still for path in m.paths)


def test_no_residual_mode_is_blamed_for_what_a_controlled_one_does():
    modes = Beam(length=1.2, mass_per_length=0.62, bending_stiffness=13.0, left="hinged", right="hinged").modes(6)
    poles = modes.omega[:3] * (-0.2 + 1j * np.sqrt(0.96))
    law = coupled_poles(modes, 3, [Actuator("F1", 0.3), Actuator("F2", 0.7)], poles=poles)
    controller = filtered(law, displacement_filter(modes.select(range(3)), [0.35, 0.95], 0.62))
    told = explain_spillover(modes, controller)
    assert told.reduced_decay_rate < 0 and told.shifts[0].closed_pole.real > 0
    assert all(close_with(modes.select(np.delete(range(6), r)), controller).decay_rate < 0 for r in (3, 4, 5))
    assert told.destabilising is None and told.limiting is None


def test_a_law_alone_has_no_paths_and_says_so():
    with pytest.raises(DesignError, match="put it on an observer"):
        explain_spillover(beam(), coupled_lqr(beam(), 3, ACTUATORS, weight=1.0))


def test_rigid_modes_alone_set_no_speed_of_an_observer():
    free = Beam(length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left="free", right="free").modes(3)
    assert usual_poles(free, (0, 1, 2)) == pytest.approx((-0.3 + 1j) * free.omega[2] * np.array([1 / 3, 2 / 3, 1]))
    with pytest.raises(DesignError, match="rigid modes alone"):
        usual_poles(free.select([0, 1]), (0, 1))


def test_first_order_is_the_derivative():
    """With the gain lowered the movement tends to its first order, quadratically."""
    modes = beam()
    errors = []
    for share in (1e-2, 1e-3):
        controller = through_filter(modes, ACTUATORS, [2.0, 5.5], share)
        moved = {m.mode: m for m in explain_spillover(modes, controller).shifts}[4]
        errors.append(abs(moved.shift - moved.first_order) / abs(moved.shift))
    assert errors[1] < 0.15 * errors[0] < 0.01


def test_every_remedy_stabilises_the_loop_and_less_does_not():
    modes = beam()

    def redesign(actuators, sensors, share):
        return observed(modes, sensors, share, actuators)

    found = {r.kind: r for r in spillover_remedies(modes, redesign, ACTUATORS, [50 / 6])}
    assert set(found) == {"gain", "actuator", "sensor", "sensors added"}
    assert all(
        explain_spillover(modes, r.controller).decay_rate == pytest.approx(r.decay_rate) and r.decay_rate > 0
        for r in found.values()
    )
    share = 1 - found["gain"].size
    assert explain_spillover(modes, redesign(ACTUATORS, [50 / 6], min(share * 1.01, 1.0))).decay_rate < 0
    assert found["sensors added"].size == 1


CHAIN = NamedPoints(
    names=tuple(f"S{i}" for i in range(1, 9)),
    positions=np.array([[0.0, 0.0, 3.0 * i] for i in range(8)]),
    directions=("x",) * 8,
)


def surroundings(kind):
    """A loop that spillover destabilises: modes, how many are controlled, actuators, places of sensors, R."""
    light = ModalDamping(0.0005)
    if kind == "frame":
        stiffness = 2e6 * (2 * np.eye(8) - np.eye(8, k=1) - np.eye(8, k=-1))
        stiffness[-1, -1] = 2e6
        modes = FiniteElements(np.diag([1200.0] * 7 + [900.0]), stiffness, nodes=CHAIN, damping=light).modes(5)
        return modes, 1, [Actuator("F", "S8")], ["S3"], 1e-9
    if kind == "plate":
        edges = dict.fromkeys(("left", "right", "bottom", "top"), "simply supported")
        sides = {"length": (0.9, 0.5), "mass_per_area": 8.0, "bending_stiffness": 40.0, "poisson_ratio": 0.3}
        modes = Plate(**sides, edges=edges, damping=ModalDamping(0.0001)).modes(6)
        return modes, 2, [Actuator("F1", (0.2, 0.2)), Actuator("F2", (0.6, 0.3))], [(0.3, 0.3), (0.7, 0.1)], 1e-4
    modes = Beam(
        length=1.2, mass_per_length=0.62, bending_stiffness=13.0, left="hinged", right="hinged", damping=light
    ).modes(6)
    return modes, 2, [piezo_patch("P1", 0.3, length=0.1), piezo_patch("P2", 0.7, length=0.1)], [0.35, 0.95], 1e-4


@pytest.mark.parametrize("kind", ["frame", "patches", pytest.param("plate", marks=pytest.mark.slow)])
def test_remedies_move_whatever_stands_anywhere(kind):
    modes, count, actuators, places, weight = surroundings(kind)

    def redesign(actuators, sensors, share):
        law = imsc(modes, count, actuators, weight=weight)
        sensors = [Sensor(f"y{i}", at) for i, at in enumerate(sensors)]
        return luenberger_controller(
            modes, replace(law, gain=share * law.gain), sensors, poles=usual_poles(modes, range(count))
        )

    assert close_with(modes, redesign(actuators, places, 1.0)).decay_rate < 0
    found = {r.kind: r for r in spillover_remedies(modes, redesign, actuators, places)}
    assert {"actuator", "sensors added"} <= set(found)
    assert all(-poles_by_python_control(modes, r.controller).real.max() > 0 for r in found.values())
    moved = found["actuator"].controller.law.actuators
    if kind == "patches":  # as long as they were
        assert [a.at.first - a.at.second for a in moved] == pytest.approx([0.1, 0.1])
    if kind == "frame":  # of the points nearer than the nearest that will do none does
        assert moved[0].at == "S3" and found["actuator"].size == pytest.approx(15.0)
        nearer = [redesign([replace(actuators[0], at=f"S{i}")], places, 1.0) for i in (4, 5, 6, 7)]
        assert all(close_with(modes, one).decay_rate <= 0 for one in nearer)
    cured = found["sensors added"].controller
    assert spillover_remedies(modes, redesign, actuators, cured.places) == ()


def test_the_filter_cures_it_with_sensors_enough():
    modes = beam()

    def redesign(actuators, sensors, share):
        return through_filter(modes, actuators, sensors, share)

    count, rates = sufficient_sensors(modes, redesign, ACTUATORS)
    assert rates[0] < 0 and count is not None and (rates[count - 1 :] > 0).all() and rates[count - 2] <= 0


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda m: observed(m, 5.0), "mode 2 is unobservable"),
        (lambda m: observed(m, []), "needs a sensor"),
        (
            lambda m: kalman_controller(
                m, coupled_lqr(m, 3, ACTUATORS, weight=1.0), [Sensor("y", 3.0)], disturbance=1, noise=0
            ),
            "the noise intensity must be a positive number; got 0",
        ),
        (
            lambda m: kalman_controller(
                m, coupled_lqr(m, 3, ACTUATORS, weight=1.0), [Sensor("y", 3.0)], disturbance=[1.0, -1.0, 1.0], noise=1.0
            ),
            "the disturbance intensity must be a positive number, 3 positive numbers or a symmetric positive definite",
        ),
        (
            lambda m: luenberger_controller(
                m, coupled_lqr(m, 3, ACTUATORS, weight=1.0), [Sensor("y", 3.0)], poles=[1 + 1j] * 3
            ),
            "mode 1 of the observer is not stable",
        ),
    ],
)
def test_what_cannot_be_is_refused(act, words):
    with pytest.raises(DesignError, match=words):
        act(beam())


def chain(damper):
    """Six masses in a row, one with a damper of its own: modes that damping couples, and poles from M, K, C."""
    mass, k = np.diag([3.0, 2, 4, 1, 2, 1.5]), np.array([900.0, 700, 800, 600, 500, 400])
    stiffness = np.diag(k + np.r_[k[1:], 0.0]) - np.diag(k[1:], 1) - np.diag(k[1:], -1)
    damping = 5e-4 * stiffness
    damping[3, 3] += damper
    names = NamedPoints(names=tuple(f"n{i}" for i in range(6)))
    lower = [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)]
    poles = np.linalg.eigvals(np.block([[np.zeros((6, 6)), np.eye(6)], lower]))
    return FiniteElements(mass, stiffness, nodes=names, damping=damping).modes(6), poles


@pytest.mark.parametrize("damper", [25.0, 60.0])
def test_paths_add_up_where_damping_couples_the_modes(damper):
    modes, poles = chain(damper)
    law = imsc(modes, 2, [Actuator("a", "n2"), Actuator("b", "n5")], weight=0.05)
    found = explain_spillover(
        modes, luenberger_controller(modes, law, [Sensor("y1", "n0"), Sensor("y2", "n4")], poles=[-3 + 5j, -4 + 11j])
    )
    for shift in found.shifts:
        assert np.abs(poles - shift.pole).min() < 1e-9 * abs(shift.pole)
        assert sum(path.shift for path in shift.paths) == pytest.approx(shift.shift, abs=1e-9 * abs(shift.pole))


@pytest.mark.parametrize(
    "late",
    [
        ({"time_constant": 0.09}, {}),
        ({}, {"time_constant": 0.09}),
        ({"delay": 0.4}, {}),
        ({"delay": 0.3, "time_constant": 0.05}, {"delay": 0.2}),
    ],
    ids=["slow actuator", "slow sensor", "late actuator", "all of it"],
)
def test_lags_and_delays_are_in_the_loop(late):
    """Against python-control, which takes a delay by its own Padé approximation; the paths count them too."""
    modes, (acts, reads) = beam(4, zeta=0.02), late
    law = coupled_lqr(modes, 1, [Actuator("F", 3.0, **acts)], weight=0.1)
    controller = kalman_controller(modes, law, [Sensor("y", 4.2, **reads)], disturbance=1.0, noise=1e-3)
    found = explain_spillover(modes, controller)
    prompt = [replace(part, delay=0.0) for part in (*law.actuators, *controller.sensors)]
    plant = state_space(modes, prompt[:1], prompt[1:])
    delay = acts.get("delay", 0.0) + reads.get("delay", 0.0)
    if delay:
        plant = plant * control.tf2ss(control.tf(*control.pade(delay, 8)))
    parts = (controller.A, controller.B, controller.C, controller.D)
    true = control.feedback(plant, control.ss(*parts), sign=1).poles()
    slow = true[np.abs(true) < 1.2 * modes.omega[-1]]
    assert all(np.abs(found.poles - pole).min() < 1e-6 * abs(pole) for pole in slow)
    assert found.decay_rate == pytest.approx(-true.real.max(), rel=1e-5)
    for shift in found.shifts:
        assert sum(path.shift for path in shift.paths) == pytest.approx(shift.shift, abs=1e-8 * abs(shift.pole))


def test_a_slow_actuator_counts_in_work_and_effort():
    """Work in all modes is what the energies lose beside friction: without friction all of it."""
    modes = beam(4, zeta=0.0)
    law = coupled_lqr(modes, 1, [Actuator("F", 3.0, time_constant=0.5)], weight=0.1)
    loop, state = close_loop(modes, law), impulse_state(modes, 6.3)
    np.testing.assert_allclose(
        finite_spillover(loop, state, 30.0).work_by_mode, energy_gained(loop, state, 30.0), atol=1e-9
    )
    time = np.linspace(0.0, 300.0, 60_001)
    squares = (initial_response(loop, time, state).forces ** 2).sum(axis=0)
    assert effort(modes, law, state) == pytest.approx(np.trapezoid(squares, time), rel=1e-4)


def test_a_marginally_stable_loop_needs_no_remedy():
    """Rigid modes whose displacement nothing holds stand on the axis whatever rounding makes of them."""
    modes = Beam(
        length=2.0, mass_per_length=1.0, bending_stiffness=10.0, left="free", right="free", damping=ModalDamping(0.01)
    ).modes(6)

    def redesign(actuators, sensors, share):
        law = coupled_lqr(modes, 3, actuators, weight=0.1)
        sensors = [Sensor(f"y{i}", x) for i, x in enumerate(sensors)]
        return luenberger_controller(
            modes, replace(law, gain=share * law.gain), sensors, poles=[-1 + 1j, -2 + 2j, -3 + 20j]
        )

    actuators = [Actuator("a", 0.1), Actuator("b", 1.3), Actuator("c", 1.9)]
    assert close_with(modes, redesign(actuators, [0.1, 1.3], 1.0)).stability == "marginally stable"
    assert spillover_remedies(modes, redesign, actuators, [0.1, 1.3]) == ()


def test_the_dominant_path_of_a_pole_that_moves_left_is_what_moves_it():
    modes = Beam(
        length=1.2,
        mass_per_length=0.62,
        bending_stiffness=14.0,
        left="clamped",
        right="free",
        damping=ModalDamping(0.004),
    ).modes(6)
    law = imsc(modes, 2, [Actuator("F1", 0.6575), Actuator("F2", 1.057)], weight=1.0)
    sensors = [Sensor("y", 0.75), Sensor("v", 1.2, "velocity")]
    controller = luenberger_controller(modes, law, sensors, poles=modes.omega[:2] * (-0.3 + 1j))
    third = next(shift for shift in explain_spillover(modes, controller).shifts if shift.mode == 2)
    assert third.shift.real < 0.0
    assert third.dominant.text == "v → F1" and third.dominant.shift.real < 0.7 * third.shift.real
