"""Coupled pole placement: the poles asked for, gains no larger than python-control's, and its refusals."""

import control
import numpy as np
import pytest

from workbench.design.laws.coupled import controlled_plant, coupled_lqr, coupled_poles
from workbench.design.laws.imsc import imsc_poles
from workbench.design.laws.law import DesignError
from workbench.design.loop.closed_loop import close_loop
from workbench.rig.actuators import Actuator
from workbench.structure.damping import ViscousDamping
from workbench.structure.member import Beam


def modes(n, **options):
    return Beam(
        length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged", **options
    ).modes(n)


def actuators(*places):
    return [Actuator(f"F{i + 1}", x) for i, x in enumerate(places)]


def wanted(omega, zeta=0.1):
    return -zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)


def missed(poles, asked):
    asked = np.r_[asked, asked.conj()]
    return max(np.abs(poles - p).min() / abs(p) for p in asked)


@pytest.mark.parametrize(
    ("n", "places"),
    [(4, (2.0, 4.0, 6.0, 8.0)), (4, (1.3, 2.6)), (6, (3.1,)), (10, (1.3, 4.1, 7.7))],
)
def test_poles_are_met_with_gains_no_larger_than_those_of_python_control(n, places):
    found, places = modes(n), actuators(*places)
    asked = wanted(found.omega)
    law = coupled_poles(found, n, places, poles=asked)
    assert missed(close_loop(found, law).poles, asked) < 1e-10
    peer = np.asarray(control.place(*controlled_plant(found, range(n), places), np.r_[asked, asked.conj()]))
    assert np.linalg.norm(law.gain) <= np.linalg.norm(peer) * (1 + 1e-9)
    if len(places) == 1:
        np.testing.assert_allclose(law.gain, peer, rtol=1e-8, atol=1e-8 * np.abs(peer).max())


def test_thirty_modes_from_five_actuators():
    found = modes(30)
    places = actuators(0.7, 2.9, 4.3, 6.1, 8.9)
    asked = wanted(found.omega, 0.05)
    assert missed(close_loop(found, coupled_poles(found, 30, places, poles=asked)).poles, asked) < 1e-9


def test_with_b_orthogonal_it_is_imsc():
    found, places = modes(4), actuators(2.0, 4.0, 6.0, 8.0)
    asked = wanted(found.omega)
    independent = imsc_poles(found, 4, places, poles=asked)
    np.testing.assert_allclose(coupled_poles(found, 4, places, poles=asked).gain, independent.gain, atol=1e-12)


def test_modes_that_damping_couples():
    found = modes(5, damping=ViscousDamping(lambda x: 0.02 * x))
    asked = wanted(found.omega, 0.2)
    law = coupled_poles(found, 5, actuators(1.3, 4.2), poles=asked)
    assert missed(close_loop(found, law).poles, asked) < 1e-10


def test_a_pole_that_stays_costs_nothing():
    found = modes(3)
    asked = wanted(found.omega)
    asked[1] = -1e-300 + 1j * found.omega[1]
    law = coupled_poles(found, 3, actuators(3.0), poles=asked)
    assert missed(close_loop(found, law).poles, asked) < 1e-10
    assert np.abs(law.gain[:, [1, 4]]).max() < 1e-14


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda m: coupled_poles(m, 2, actuators(5.0), poles=wanted(m.omega[:2])), "mode 2 is uncontrollable"),
        (lambda m: coupled_lqr(m, 2, actuators(5.0), weight=1.0), "mode 2 is uncontrollable"),
        (lambda m: coupled_poles(m, 2, [], poles=wanted(m.omega[:2])), "no actuators"),
        (lambda m: coupled_poles(m, 2, actuators(3.0), poles=[-1 + 1j]), "one pole per mode"),
        (lambda m: coupled_poles(m, 2, actuators(3.0), poles=[-1 + 1j, 1 + 1j]), "mode 2 is not stable"),
        (lambda m: coupled_poles(m, 2, actuators(3.0), poles=[-1, -1 + 1j]), "is real"),
        (lambda m: coupled_poles(m, 2, actuators(3.0), poles=[-1 + 1j, -1 + 1j]), "cannot assign 2 pairs"),
        (
            lambda m: coupled_poles(m, 2, actuators(3.0), poles=[-1e-300 + 1j * m.omega[1], -1 + 1j]),
            "of mode 1 is the open-loop pole of mode 2",
        ),
    ],
)
def test_poles_that_cannot_be_are_refused(act, words):
    with pytest.raises(DesignError, match=words):
        act(modes(2))
