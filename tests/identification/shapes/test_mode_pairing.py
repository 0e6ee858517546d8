"""Pairing where a model has repeated modes: any basis of them is as good."""

import numpy as np
import pytest

from workbench.identification.shapes.mode_pairing import pair_modes, subspace_mac
from workbench.structure.modes import SampledModes, mac
from workbench.structure.plate import Plate

PLACES = np.random.default_rng(0).uniform(0.05, 0.95, (14, 2))


def square():
    plate = Plate(length=(1, 1), mass_per_area=1, bending_stiffness=1, poisson_ratio=0.3, edges="simply supported")
    return plate.modes(6)  # modes 2 and 3, and 5 and 6, are repeated


def turned(angle):
    """Another basis of the repeated modes: each pair turned by an angle."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.eye(6)
    for i in (1, 4):
        turn[i : i + 2, i : i + 2] = [[c, -s], [s, c]]
    return square().phi(PLACES) @ turn


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 4, 1.3])
def test_repeated_modes_agree_as_a_subspace_whatever_their_basis(angle):
    modes = square()
    found = subspace_mac(turned(angle), modes.phi(PLACES), modes.omega)
    for first, second in ((0, 0), (1, 1), (1, 2), (2, 1), (2, 2), (3, 3), (4, 5), (5, 4)):
        assert found[first, second] == pytest.approx(1.0, abs=1e-12)
    plain = mac(turned(angle), modes.phi(PLACES))
    np.testing.assert_allclose(found[:, [0, 3]], plain[:, [0, 3]], rtol=1e-12)
    assert (plain[1, 1] < 0.7) == (angle > np.pi / 5)


def test_every_mode_of_a_turned_basis_is_paired():
    modes = square()
    measured = SampledModes(modes.omega * (1 + 1e-4 * np.arange(6)), np.zeros(6), turned(np.pi / 4), np.arange(14.0))
    lookup = Lookup(modes)
    pairing = pair_modes(measured, lookup)
    assert sorted(pairing.model) == [0, 1, 2, 3, 4, 5] and pairing.others.size == 0
    np.testing.assert_allclose(pairing.mac, 1.0, rtol=1e-9)


class Lookup:
    """Modes asked for by the number of a sensor, as `SampledModes` names its places by one coordinate."""

    def __init__(self, modes):
        self.omega, self.frequencies_hz = modes.omega, modes.frequencies_hz
        self.phi = lambda positions: modes.phi(PLACES[np.asarray(positions, int)])
