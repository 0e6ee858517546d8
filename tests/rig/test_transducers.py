"""What actuators and sensors do to a signal, against finer simulation, scipy's integrator and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from workbench.rig.actuators import Actuator, piezo_patch
from workbench.rig.driving import actuator_force
from workbench.rig.elements import CoulombFriction, CubicSpring
from workbench.rig.readings import read
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import move, simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import Between, NamedPoints, PlaceError
from workbench.structure.member import Beam
from workbench.structure.modes import Modes, PointShapes
from workbench.structure.supports import PointDamper

DT = 0.1
SENSORS = (Sensor("d", 3.1), Sensor("v", 4.4, "velocity"), Sensor("a", 7.0, "acceleration"))


def modes_of(**options) -> Modes:
    beam = Beam(
        length=10.0,
        mass_per_length=1.0,
        bending_stiffness=1.0,
        left="hinged",
        right="hinged",
        damping=ModalDamping(0.01),
        **options,
    )
    return beam.modes(6)


def rig(*actuators: Actuator, **options) -> Rig:
    both = actuators or (Actuator("F1", 2.0), Actuator("F2", 6.3))
    return Rig(**{"modes": modes_of(), "actuators": both, "sensors": SENSORS, **options})


def drive(n: int = 300, n_inputs: int = 2) -> np.ndarray:
    return np.random.default_rng(0).standard_normal((n_inputs, n))


def late(r: Rig, delay: float) -> Rig:
    return replace(r, sensors=tuple(replace(s, delay=delay) for s in r.sensors))


@pytest.mark.parametrize("delay", [0.03, 0.1, 0.27])
@pytest.mark.parametrize("damped", [False, True])
def test_a_late_sensor_of_a_linear_rig_reads_what_was(delay, damped):
    modes = modes_of(attachments=(PointDamper(3.0, 0.2),)) if damped else modes_of()
    r, inputs, fine = rig(modes=modes), drive(120), 100
    shift = round(delay * fine / DT)
    peer = simulate(r, np.repeat(inputs, fine, axis=1), sample_time=DT / fine).outputs
    peer = np.c_[np.zeros((3, shift)), peer][:, : peer.shape[1]][:, ::fine]
    mine = simulate(late(r, delay), inputs, sample_time=DT).outputs
    limit = 5e-5 if damped else 1e-9  # what couples the modes is taken as linear over a sample
    assert np.abs(mine - peer).max() < limit * np.abs(peer).max()


@pytest.mark.parametrize(
    "options",
    [{"elements": (CubicSpring(4.0, 0.3),)}, {"stiffness_rate": 0.02}],
    ids=["cubic spring", "stiffness drift"],
)
def test_a_late_sensor_of_a_rig_without_closed_form_reads_what_was(options):
    r, inputs, fine = rig(**options), 0.3 * drive(150), 20
    peer = simulate(r, np.repeat(inputs, fine, axis=1), sample_time=DT / fine).outputs
    peer = np.c_[np.zeros((3, 6)), peer][:, : peer.shape[1]][:, ::fine]
    mine = simulate(late(r, 0.03), inputs, sample_time=DT, substeps=32).outputs
    at_once = simulate(r, inputs, sample_time=DT, substeps=32).outputs
    off, moved = np.abs(mine - peer).max(axis=1), np.abs(at_once - peer).max(axis=1)
    assert (off < 0.02 * moved).all(), off / moved


def test_a_late_sensor_of_a_record_cut_at_its_start_goes_on_from_there():
    r, inputs = late(rig(), 0.04), drive()
    whole = move(r, inputs, sample_time=DT)
    cut = read(r, whole.after(50))
    np.testing.assert_allclose(cut[:, 1:], read(r, whole)[:, 51:], atol=1e-12)
    first = read(r, whole)[0, 50]  # a velocity shows that the force before the cut was another one
    assert cut[0, 0] == pytest.approx(first, rel=0.01)


def test_a_bias_is_one_more_command_that_never_ends():
    inputs = drive()
    for extra in ({}, {"elements": (CubicSpring(4.0, 0.3),)}):
        biased = rig(Actuator("F1", 2.0, bias=0.4), Actuator("F2", 6.3), **extra)
        pushed = inputs + np.array([[0.4], [0.0]])
        mine, peer = (simulate(r, u, sample_time=DT).outputs for r, u in ((biased, inputs), (rig(**extra), pushed)))
        np.testing.assert_allclose(mine, peer, atol=1e-12 * np.abs(peer).max())
    lagging = rig(Actuator("F1", 2.0, bias=0.4, delay=0.07, time_constant=0.2), Actuator("F2", 6.3))
    still = simulate(lagging, 0.0 * inputs, sample_time=DT).outputs
    plain = simulate(rig(), 0.0 * inputs + np.array([[0.4], [0.0]]), sample_time=DT).outputs
    np.testing.assert_allclose(still, plain, atol=1e-12)


def test_a_rate_limit_lets_the_force_ramp():
    command = drive(150, 1)
    fine, rate = 400, 8.0
    force, now = np.zeros(150 * fine), 0.0
    for k in range(force.size):
        force[k] = now
        now += np.clip(command[0, k // fine] - now, -rate * DT / fine, rate * DT / fine)
    peer = simulate(rig(Actuator("F1", 2.0)), force[None], sample_time=DT / fine).outputs[:, ::fine]
    limited = rig(Actuator("F1", 2.0, rate_limit=rate))
    errors = [
        np.abs(simulate(limited, command, sample_time=DT, substeps=k).outputs - peer).max(axis=1) for k in (8, 32)
    ]
    unlimited = np.abs(simulate(rig(Actuator("F1", 2.0)), command, sample_time=DT).outputs - peer).max(axis=1)
    assert (errors[0] < 0.05 * unlimited).all() and (errors[1] < 0.02 * unlimited).all()
    never = replace(limited, actuators=(replace(limited.actuators[0], rate_limit=1e6),))
    np.testing.assert_allclose(
        simulate(never, command, sample_time=DT).outputs[:2],
        simulate(rig(Actuator("F1", 2.0)), command, sample_time=DT).outputs[:2],
        atol=1e-4 * np.abs(peer).max(),
    )


def test_few_substeps_follow_ramps_that_end_within_one():
    """Ramps of whole tenths of a sample are exact where forces run straight from tenth to tenth."""
    rng, fine = np.random.default_rng(4), 10
    command = np.round(rng.uniform(-2.0, 2.0, (1, 120)), 1)
    force, now = np.zeros(120 * fine + 1), 0.0
    for k in range(120 * fine):
        now += np.clip(command[0, k // fine] - now, -0.1, 0.1)
        force[k + 1] = now
    peer = simulate(rig(Actuator("F1", 2.0)), force[None], sample_time=DT / fine, input_hold="first").outputs
    peer = peer[:2, :-1:fine]  # an acceleration jumps with the command
    limited = rig(Actuator("F1", 2.0, rate_limit=1.0 / DT))
    for substeps, within in ((4, 2e-4), (8, 4e-5)):
        found = simulate(limited, command, sample_time=DT, substeps=substeps).outputs[:2]
        assert (np.abs(found - peer).max(axis=1) < within * np.abs(peer).max(axis=1)).all()


def test_a_command_passes_its_hysteresis_as_an_adaptive_integrator_has_it():
    command = np.cumsum(drive(60, 1)[0])
    z, before, expected = 0.0, 0.0, []
    for u in command:
        change = u - before
        if change:
            found = solve_ivp(
                lambda s, z, du=change: du - (abs(du) * z + du * abs(z)) / 1.4, (0, 1), [z], rtol=1e-10, atol=1e-12
            )
            z = found.y[0, -1]
        before = u
        expected.append(0.7 * u + 0.3 * z)
    hysteretic = Actuator("F1", 2.0, hysteresis_share=0.3, hysteresis_width=0.7)
    np.testing.assert_allclose(actuator_force(hysteretic, command), expected, atol=1e-8)
    np.testing.assert_array_equal(actuator_force(replace(hysteretic, hysteresis_share=0.0), command), command)


def test_friction_of_two_directions_is_friction_and_an_offset():
    """Forward -(F + F0), backward -(F - F0): the offset does what a constant force at that place does."""
    inputs = drive(150)
    offset = rig(elements=(CoulombFriction(6.3, 0.1, 0.05, 0.04),))
    pushed = rig(Actuator("F1", 2.0), Actuator("F2", 6.3, bias=-0.04), elements=(CoulombFriction(6.3, 0.1, 0.05),))
    mine, peer = (simulate(r, inputs, sample_time=DT, substeps=32).outputs for r in (offset, pushed))
    np.testing.assert_allclose(mine[:2], peer[:2], atol=2e-3 * np.abs(peer).max())


@pytest.mark.parametrize("field", ["rate_limit", "hysteresis_width", "limit"])
def test_limits_that_are_not_positive_are_refused(field):
    with pytest.raises(ValueError, match=field):
        Actuator("F1", 2.0, **{field: 0.0})


def test_a_late_or_biased_transducer_has_no_state_space():
    assert Actuator("F1", 2.0, crosstalk=(("F2", 0.1),)).has_state_space
    assert Actuator("F1", 2.0).has_state_space and Sensor("d", 1.0, crosstalk=(("v", 0.1),)).has_state_space
    assert not Actuator("F1", 2.0, bias=1.0).has_state_space
    assert not Actuator("F1", 2.0, rate_limit=1.0).has_state_space
    assert not Actuator("F1", 2.0, hysteresis_share=0.1).has_state_space
    assert not Sensor("d", 1.0, delay=0.1).has_state_space


def test_a_rig_is_refused_whose_actuator_or_sensor_stands_outside_the_structure(square_plate):
    modes = square_plate.modes(3)
    inside, outside = (0.3, 0.4), (0.3, 1.4)
    with pytest.raises(PlaceError, match=r"actuator F: \(x, y\) = \(0.3, 1.4\) lies outside the structure, 0 to 1"):
        Rig(modes, (Actuator("F", outside),), (Sensor("d", inside),))
    with pytest.raises(PlaceError, match=r"sensor d: .* give a place on it"):
        Rig(modes, (Actuator("F", inside),), (Sensor("d", outside),))
    with pytest.raises(PlaceError, match=r"sensor late: x = 10\.5 lies outside the structure, which runs from 0 to 10"):
        rig(sensors=(Sensor("late", 10.5),))


def test_a_rig_is_refused_whose_points_or_directions_are_not_there():
    """When it is made, not when it is simulated: with the names there are, and the one spelled most like it."""
    positions = np.array([[0, 0, 3], [0, 0, 6], [0, 0, 6], [0, 0, 6]])
    points = NamedPoints(("S1x", "S2x", "S2y", "S2rz"), positions, ("x", "x", "y", "rz"), ("S1", "S2", "S2", "S2"))
    modes = Modes([1.0], [0.0], PointShapes(np.ones((4, 1))), points)
    fine = Sensor("a", "S1x")
    for actuators, sensors, elements, words in (
        ([Actuator("F", "R1x")], [fine], [], "actuator F: there is no point 'R1x'; the points are S1x, S2x, S2y, S2rz: "
         "give one of these; did you mean 'S1x'?"),
        ([], [fine, Sensor("b", "S2z")], [], "sensor b: there is no point 'S2z'; node 'S2' has S2x, S2y, S2rz"),
        ([Actuator("F", Between("S1x", "s2x"))], [], [], "actuator F: there is no point 's2x'; .*did you mean 'S2x'"),
        ([], [Sensor("b", "S1", direction="y")], [], "sensor b: point 'S1' has no direction 'y'; it has x: give one"),
        ([], [Sensor("b", "S1x", "slope")], [], "sensor b: named points have no slopes; 'S1x' is no rotation: give a"),
        ([], [fine], [CubicSpring("T", 1.0)], "element CubicSpring: there is no point 'T'; the points are S1x, S2x"),
        ([], [Sensor("b", 0.3)], [], "sensor b: there is no point 0.3; the points are S1x"),
    ):  # fmt: skip
        with pytest.raises(PlaceError, match=words.replace("?", r"\?")):
            Rig(modes, tuple(actuators), tuple(sensors), tuple(elements))
    Rig(modes, (Actuator("F", "S2", direction="y"),), (Sensor("b", "S2", "slope", direction="z"),))


def test_a_rig_is_refused_whose_element_or_patch_reaches_outside(square_plate):
    modes, beam = square_plate.modes(3), rig().modes
    with pytest.raises(PlaceError, match=r"element CubicSpring: \(x, y\) = \(1.3, 0.4\) lies outside the structure"):
        Rig(modes, (), (), (CubicSpring((1.3, 0.4), 1.0),))
    with pytest.raises(PlaceError, match=r"actuator P: a patch of 0.1 m by 0.1 m .* does not lie on the structure"):
        Rig(modes, (piezo_patch("P", (0.97, 0.5), length=(0.1, 0.1)),), ())
    with pytest.raises(PlaceError, match=r"actuator P: x = 10.2 lies outside the structure"):
        Rig(beam, (piezo_patch("P", 9.9, length=0.6),), ())
    with pytest.raises(PlaceError, match=r"sensor s: a slope or moment on a plate is about an axis"):
        Rig(modes, (), (Sensor("s", (0.3, 0.4), "slope"),))


ACTING = {
    "ideal": ({}, {}),
    "late": ({"delay": 0.13, "time_constant": 0.05}, {"delay": 0.04, "bias": 0.1}),
    "nonlinear": ({"dead_zone": 0.2, "gain": 1.3, "limit": 1.0}, {"hysteresis_share": 0.4, "hysteresis_width": 0.5}),
    "slow": ({"rate_limit": 5.0}, {"rate_limit": 8.0, "delay": 0.02}),
}


@pytest.mark.parametrize("hold", ["zero", "first", "band-limited"])
@pytest.mark.parametrize("acting", ACTING)
@pytest.mark.parametrize("elements", [(), (CubicSpring(4.0, 0.3),)], ids=["linear", "stepped"])
def test_cross_talk_adds_a_share_of_another_command(elements, acting, hold):
    """Before all else that an actuator does to its command; exactly as if the commands were mixed by hand."""
    plain = rig(*(Actuator(f"F{i + 1}", x, **ACTING[acting][i]) for i, x in enumerate((2.0, 6.3))), elements=elements)
    leaking = replace(
        plain,
        actuators=tuple(
            replace(a, crosstalk=((other, share),))
            for a, other, share in zip(plain.actuators, ("F2", "F1"), (0.3, -0.2), strict=True)
        ),
    )
    inputs = drive(120)
    inputs.flags.writeable = False  # as of a record, whose drives are cached
    mixed = inputs + np.array([[0.3], [-0.2]]) * inputs[::-1]
    for _ in range(2):
        mine, peer, without = (
            simulate(r, u, sample_time=DT, input_hold=hold).outputs
            for r, u in ((leaking, inputs), (plain, mixed), (plain, inputs))
        )
        np.testing.assert_allclose(mine, peer, atol=1e-12 * np.abs(peer).max())
        assert np.abs(mine - without).max() > 0.01 * np.abs(peer).max()


def test_cross_talk_of_no_share_changes_nothing():
    plain = rig()
    none = replace(plain, actuators=(replace(plain.actuators[0], crosstalk=(("F2", 0.0),)), plain.actuators[1]))
    np.testing.assert_array_equal(*(simulate(r, drive(), sample_time=DT).outputs for r in (plain, none)))


def test_cross_talk_is_refused_where_there_is_no_command():
    def simulated(*actuators):
        return simulate(rig(*actuators), drive(20), sample_time=DT)

    leaking, tap = Actuator("F1", 2.0, crosstalk=(("tap", 0.1),)), Actuator("tap", 6.3, direct=True)
    with pytest.raises(ValueError, match="F1 takes a share of the command of 'tap', which is no actuator of the rig"):
        simulated(leaking, Actuator("F2", 6.3))
    with pytest.raises(ValueError, match="F1 takes a share of the command of 'tap', which is a measured force"):
        simulated(leaking, tap)
    with pytest.raises(ValueError, match="tap is a measured force, which takes no share of a command"):
        replace(tap, crosstalk=(("F1", 0.1),))
    with pytest.raises(ValueError, match="F1: the share of the command of F2 must be finite; got nan"):
        Actuator("F1", 2.0, crosstalk=(("F2", np.nan),))


@pytest.mark.parametrize("delays", [(0.13, 0.0, 0.0), (0.0, 0.04, 0.2), (0.27, 0.13, 0.05)])
@pytest.mark.parametrize("elements", [(), (CubicSpring(4.0, 0.3),)], ids=["linear", "stepped"])
def test_a_late_sensor_takes_its_share_of_another_as_late(elements, delays):
    """Cross-talk precedes the delay: the share is of what the other measured that long ago, not of its late reading."""
    shares = (("v", 0.4), ("a", 0.2))
    sensors = tuple(replace(s, delay=delay) for s, delay in zip(SENSORS, delays, strict=True))
    crossed = (replace(sensors[0], crosstalk=shares), *sensors[1:])
    found, *peers = (
        simulate(rig(sensors=each, elements=elements), drive(120), sample_time=DT).outputs
        for each in (crossed, sensors, tuple(replace(s, delay=delays[0]) for s in SENSORS))
    )
    peer = peers[0].copy()
    peer[0] += 0.4 * peers[1][1] + 0.2 * peers[1][2]
    np.testing.assert_allclose(found, peer, atol=1e-12 * np.abs(peer).max())
