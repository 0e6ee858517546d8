"""Pairing where a model has repeated modes: any basis of them is as good."""

import numpy as np
import pytest

from workbench.identification.shapes.mode_pairing import pair_modes, subspace_mac
from workbench.structure.domain import NamedPoints, place_array
from workbench.structure.finite_elements import FiniteElements
from workbench.structure.member import Beam
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
    measured = SampledModes(modes.omega * (1 + 1e-4 * np.arange(6)), np.zeros(6), turned(np.pi / 4), PLACES)
    pairing = pair_modes(measured, modes)
    assert sorted(pairing.model) == [0, 1, 2, 3, 4, 5] and pairing.others.size == 0
    np.testing.assert_allclose(pairing.mac, 1.0, rtol=1e-9)


def test_one_of_repeated_modes_is_paired_with_the_one_it_is():
    modes = square()
    some = [0, 2, 3, 5]
    measured = SampledModes(modes.omega[some], np.zeros(4), turned(0.1)[:, some], PLACES)
    assert pair_modes(measured, modes).model.tolist() == some
    lost = np.where(np.arange(14)[:, None] == 3, np.nan, measured.shapes)
    with pytest.raises(ValueError, match=r"shapes must be finite; of mode 1 sensor 4 has .*nan"):
        pair_modes(SampledModes(measured.omega, measured.zeta, lost, PLACES), modes)


def test_rigid_modes_on_a_suspension_are_paired_by_shape():
    """Their frequency in the model is zero, and no scale: it used to take the pairs of all other modes with it."""
    model = Beam(length=1.0, bending_stiffness=10.0, mass_per_length=1.0, left="free", right="free").modes(4)
    assert (model.omega[:2] == 0.0).all()
    at = np.linspace(0.0, 1.0, 6)
    omega = np.r_[3.0, 5.0, 1.02 * model.omega[2:]]
    for some in ([0, 1, 2], [0, 1, 2, 3]):
        measured = SampledModes(omega[some], np.zeros(len(some)), model.phi(at)[:, some], at)
        pairing = pair_modes(measured, model)
        assert pairing.matched.tolist() == pairing.model.tolist() == some
        np.testing.assert_allclose(pairing.scaled_hz, [0.0, 0.0, *measured.frequencies_hz[2:]], rtol=1e-9)
    above = SampledModes(np.r_[300.0, 500.0, omega[2:]], np.zeros(4), model.phi(at), at)
    assert pair_modes(above, model).model.tolist() == [2, 3]


def test_modes_with_all_sensors_at_their_nodes_are_not_paired():
    """Sensors along the middle of a plate see no mode of two half waves across: what rounding leaves of one is like
    the mode of one half wave across."""
    plate = Plate(length=(1, 0.6), mass_per_area=1, bending_stiffness=1, poisson_ratio=0.3, edges="simply supported")
    for model in (plate.modes(6), square()):
        along = np.column_stack([np.linspace(0.1, 0.9, 7), np.full(7, 0.5 * model.domain.length[1])])
        seen = np.flatnonzero(np.abs(model.phi(along)).max(axis=0) > 1e-3)
        assert seen.size < 6
        measured = SampledModes(model.omega[seen], np.zeros(seen.size), model.phi(along)[:, seen], along)
        pairing = pair_modes(measured, model)
        assert pairing.model.tolist() == seen.tolist() and pairing.others.size == 0


def test_of_repeated_modes_one_that_no_sensor_sees_adds_nothing_to_their_subspace():
    model, along = square(), np.column_stack([np.linspace(0.1, 0.9, 7), np.full(7, 0.5)])
    shapes, other = model.phi(along), np.random.default_rng(0).standard_normal((7, 1))
    seen = 1 + int(np.argmax(np.abs(shapes[:, 1:3]).max(axis=0)))
    np.testing.assert_allclose(subspace_mac(other, shapes, model.omega)[0, 1:3], mac(other, shapes[:, [seen]])[0, 0])


def test_modes_at_named_points_are_paired_with_those_of_a_model():
    names = ("S1", "S2", "S3")
    points = NamedPoints(names, np.array([[0, 0, 1], [0, 0, 2], [0, 0, 3]]), ("x",) * 3)
    stiffness = np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    model = FiniteElements(np.eye(3), stiffness, nodes=points).modes(3)
    shapes = model.phi(["S3", "S1", "S2"])[:, [2, 0, 1]]
    measured = SampledModes(1.1 * model.omega[[2, 0, 1]], np.zeros(3), shapes, place_array(["S3", "S1", "S2"]))
    pairing = pair_modes(measured, model)
    assert pairing.matched.tolist() == [1, 2, 0] and pairing.model.tolist() == [0, 1, 2]
    assert str(pairing).startswith("3 modes paired") and "none of the model" not in str(pairing)
    with pytest.raises(ValueError, match=r"sensor 2 has no place.*give its channel `at`"):
        pair_modes(SampledModes(model.omega, np.zeros(3), shapes, place_array(["S3", None, "S2"])), model)
