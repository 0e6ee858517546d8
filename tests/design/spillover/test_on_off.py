"""On-off control against the phase plane, against a relay sampled ever faster, and against the energy it takes."""

import numpy as np
import pytest

from workbench.design.laws.law import DesignError
from workbench.design.laws.on_off import Relay, on_off
from workbench.design.loop.closed_loop import impulse_state
from workbench.design.loop.on_off_response import respond_on_off
from workbench.design.loop.switching import switch, travel
from workbench.design.spillover.spillover import on_off_work
from workbench.rig.actuators import Actuator
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam


def beam(n=9, **options):
    return Beam(
        length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged", **options
    ).modes(n)


def design(modes, **options):
    places = [Actuator(f"F{i}", x) for i, x in enumerate((2.0, 4.0, 6.0, 8.0))]
    return on_off(modes, 4, places, **{"force": 0.02, "dead_band": 0.01, **options})


def end_state(relay, segments):
    last = segments[-1]
    pattern = last.steady, last.ramp, last.fading, relay.slope
    return np.array(travel(relay.omega, relay.damping, last.end - last.start, last.displacement, last.rate, *pattern))


def sampled(relay, q, v, final, step):
    """A relay that looks only every `step`: it chatters where the exact one slides."""
    a = np.array([travel(relay.omega, relay.damping, step, *e, 0.0) for e in np.eye(2)]).T
    b = np.array(travel(relay.omega, relay.damping, step, 0.0, 0.0, 1.0))
    x = np.array([q, v], float)
    for _ in range(round(final / step)):
        s = x[1] + relay.slope * x[0]
        x = a @ x - b * relay.force * (np.sign(s) if abs(s) > relay.dead_band else 0.0)
    return x


def test_without_a_dead_band_each_half_swing_loses_two_k_over_omega_squared():
    """f = -k sgn(q') on an undamped mode is dry friction: the swing falls by 2k/ω² each half period, then sticks."""
    relay = Relay(omega=2.0, damping=0.0, force=0.4, dead_band=0.0)
    segments = switch(relay, 1.05, 0.0, 20.0)
    turning = np.array([s.displacement for s in segments])
    np.testing.assert_allclose(np.abs(turning), [1.05, 0.85, 0.65, 0.45, 0.25, 0.05], atol=1e-12)
    np.testing.assert_allclose([s.start for s in segments], np.arange(6) * np.pi / 2, rtol=1e-13)
    assert [s.sliding for s in segments] == [False] * 5 + [True]


def test_a_double_integrator_switches_where_the_parabola_says():
    relay = Relay(omega=0.0, damping=0.0, force=0.5, dead_band=0.1)
    on, off = switch(relay, 0.0, 1.1, 10.0)
    assert on.end == pytest.approx(2.0, rel=1e-14) and off.displacement == pytest.approx(1.2, rel=1e-14)
    np.testing.assert_allclose(end_state(relay, (on, off)), [2.0, 0.1], rtol=1e-13)


@pytest.mark.parametrize(
    ("relay", "start"),
    [
        (Relay(1.0, 0.0, 0.1, 0.05), (0.0, 1.0)),
        (Relay(1.0, 0.1, 0.3, 0.05, 0.5), (1.0, 0.0)),
        (Relay(1.0, 0.0, 0.3, 0.0, 0.5), (1.0, 0.0)),
        (Relay(0.0, 0.0, 0.3, 0.02, 0.5), (1.0, 1.0)),
        (Relay(0.0, 0.2, 0.3, 0.02, 0.5), (1.0, -1.0)),
        (Relay(1.0, 3.0, 0.3, 0.02, 0.5), (1.0, 2.0)),
        (Relay(1.0, 2.0, 0.3, 0.02, 0.5), (1.0, 2.0)),
        (Relay(6.0, 0.0, 0.5, 0.01, 3.0), (0.0, 1.0)),
        (Relay(1.0, 0.0, 2.0, 0.05), (-1.0, 0.5)),
    ],
)
def test_a_relay_sampled_ever_faster_tends_to_the_exact_motion(relay, start):
    exact = end_state(relay, switch(relay, *start, 12.0))
    errors = [np.abs(sampled(relay, *start, 12.0, h) - exact).max() for h in (16e-3, 5e-4)]
    assert errors[1] < 2 * relay.force * 12.0 * 5e-4 and errors[1] < max(0.2 * errors[0], 1e-6)


def test_the_edge_is_slid_along_exactly_and_left_where_the_spring_no_longer_pushes():
    """With q < 0 and q' = d the spring drives the mode out and the force back in, until q = 0: q' = d all the while."""
    relay = Relay(1.0, 0.0, 2.0, 0.05)
    segments = switch(relay, -1.0, 0.5, 40.0)
    slide = next(s for s in segments if s.sliding)
    left = segments[segments.index(slide) + 1]
    assert left.displacement == pytest.approx(0.0, abs=1e-13) and left.rate == pytest.approx(0.05, rel=1e-13)
    assert left.start - slide.start == pytest.approx(-slide.displacement / 0.05, rel=1e-12)
    # then it swings inside the dead band, touching its edges for ever without a further switching
    assert left is segments[-1] and left.end == 40.0


def test_finer_instants_change_nothing():
    modes, state = beam(), impulse_state(beam(), 6.3)
    law = design(modes, slope=0.05)
    coarse = respond_on_off(modes, law, state, np.linspace(0.0, 60.0, 61)).response
    fine = respond_on_off(modes, law, state, np.linspace(0.0, 60.0, 3841)).response
    assert np.abs(coarse.modal - fine.modal[:, ::64]).max() < 1e-10
    assert np.abs(coarse.forces - fine.forces[:, ::64])[:, :-1].max() < 1e-10


def test_stopping_and_starting_again_changes_nothing():
    relay = Relay(3.0, 0.02, 0.2, 0.03, 0.4)
    whole = end_state(relay, switch(relay, 0.0, 1.0, 20.0))
    q, v = 0.0, 1.0
    for _ in range(40):
        q, v = end_state(relay, switch(relay, q, v, 0.5))
    np.testing.assert_allclose([q, v], whole, atol=1e-10)


@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_the_motion_obeys_its_equation_and_work_accounts_for_energy(damping):
    modes = beam(damping=ModalDamping(damping))
    state, law = impulse_state(modes, 6.3), design(modes, slope=0.05)
    time = np.linspace(0.0, 60.0, 60001)
    response = respond_on_off(modes, law, state, time).response
    b = modes.phi([2.0, 4.0, 6.0, 8.0]).T
    rate = response.modal[9:]
    power = b @ response.forces * rate
    lost = np.trapezoid(np.diag(modes.damping)[:, None] * rate**2, time)
    gained = response.energy[:, -1] - response.energy[:, 0]
    work = on_off_work(modes, law, state, 60.0)
    np.testing.assert_allclose(work.work_by_mode, np.trapezoid(power, time), atol=1e-5)
    np.testing.assert_allclose(work.work_by_mode - lost, gained, atol=1e-9 if damping == 0 else 1e-7)


@pytest.mark.parametrize(
    ("trait", "value"),
    [
        ("delay", 0.02),
        ("time_constant", 0.02),
        ("dead_zone", 0.01),
        ("limit", 0.001),
        ("rate_limit", 1.0),
        ("bias", 0.1),
    ],
)
def test_an_actuator_that_is_not_perfect_is_refused_not_left_out(trait, value):
    modes, state = beam(4), impulse_state(beam(4), 6.3)
    law = on_off(modes, 1, [Actuator("F", 2.0, **{trait: value})], force=0.02, dead_band=0.01)
    for told in (lambda: respond_on_off(modes, law, state, [1.0]), lambda: on_off_work(modes, law, state, 1.0)):
        with pytest.raises(DesignError, match=f"F has {trait} = {value:g}, which .* cannot include"):
            told()
    wide = on_off(modes, 1, [Actuator("F", 2.0, limit=1.0)], force=0.02, dead_band=0.01)
    assert on_off_work(modes, wide, state, 1.0).work_by_mode[0] < 0.0


def test_a_residual_mode_at_rest_can_only_gain():
    modes, state = beam(), impulse_state(beam(), 6.3)
    state[13:] = 0.0
    work = on_off_work(modes, design(modes), state, 60.0)
    assert (work.residual_work_by_mode >= -1e-15).all() and work.work_by_mode[4] == pytest.approx(0.0, abs=1e-15)
    assert work.residual_work > 1e-4


def test_the_dead_band_bounds_what_is_left():
    modes = beam()
    response = respond_on_off(modes, design(modes), impulse_state(modes, 6.3), np.linspace(0.0, 400.0, 41)).response
    assert (response.energy[:4, -1] <= 0.5 * 0.01**2 * (1 + 1e-9)).all()


def test_what_cannot_be_is_refused():
    modes = beam()
    with pytest.raises(DesignError, match="force must be positive"):
        design(modes, force=0.0)
    with pytest.raises(DesignError, match="dead_band must be 0 or more; got -1"):
        design(modes, dead_band=-1.0)
