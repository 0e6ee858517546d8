"""Modes with something attached, from modes at hand, against a structure that is solved anew."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.structure.damping import ModalDamping, ProportionalDamping, ViscousDamping
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.finite_elements import FiniteElements
from workbench.structure.member import Beam
from workbench.structure.modification import attach, truncation_error
from workbench.structure.plate import Plate
from workbench.structure.supports import PointDamper, PointMass, PointSpring


def beam(*attachments):
    return Beam(
        length=2.0,
        mass_per_length=3.0,
        bending_stiffness=50.0,
        left="clamped",
        right="free",
        damping=ModalDamping(0.01),
        attachments=attachments,
    )


@pytest.mark.parametrize(
    "parts",
    [
        (PointSpring(1.3, 4000.0),),
        (PointMass(1.3, 0.5), PointSpring(0.7, 900.0)),
        (PointSpring(1.3, 300.0), PointSpring(1.3, 200.0)),
        (PointMass(2.0, 1.0), PointDamper(0.9, 2.0)),
    ],
)
def test_the_static_answer_of_modes_left_out_makes_the_few_that_are_kept_exact(parts):
    exact = beam(*parts).modes(5)
    many = beam().modes(60)
    with_rest, without = attach(many, parts, n_modes=5), attach(beam().modes(20), parts).select(slice(5))
    error, worse = np.abs(with_rest.omega / exact.omega - 1), np.abs(without.omega / exact.omega - 1)
    assert error.max() < 2e-5 and error.max() < 0.2 * worse.max()
    places = np.linspace(0.1, 2.0, 12)
    shapes, expected = with_rest.phi(places), exact.phi(places)
    signs = np.sign(np.sum(shapes * expected, axis=0))
    np.testing.assert_allclose(shapes * signs, expected, atol=2e-3 * np.abs(expected).max())
    np.testing.assert_allclose(np.diag(with_rest.damping), np.diag(exact.damping), rtol=2e-3)


def test_springs_and_inertias_of_rotation_act_on_the_few_modes_kept():
    """They were left out there."""
    many, parts = beam().modes(60), (PointSpring(1.3, 0.0, 300.0), PointMass(0.7, 0.5, 0.02))
    few = attach(many, parts, n_modes=5)
    np.testing.assert_allclose(few.omega, attach(many, parts).omega[:5], rtol=1e-6)
    assert abs(few.omega[0] / attach(many, (PointMass(0.7, 0.5),)).omega[0] - 1.0) > 0.1


@pytest.mark.parametrize(
    "damping", [ProportionalDamping(stiffness=1e-4, mass=0.3), ViscousDamping(lambda x: 6.0 * x**2)]
)
@pytest.mark.parametrize("parts", [(), (PointMass(1.3, 0.5),)])
def test_the_damping_of_rigid_modes_and_between_modes_stays_with_the_few_kept(parts, damping):
    """It was left out there: rigid modes had none, and of a coupled matrix the diagonal remained."""
    free = replace(beam(), left="free", damping=damping)
    few, all_of_them = attach(free.modes(60), parts, n_modes=5), attach(free.modes(60), parts)
    np.testing.assert_allclose(few.damping, all_of_them.damping[:5, :5], atol=1e-4 * np.abs(few.damping).max())
    assert few.damping[0, 0] > 0.1


@pytest.mark.slow
def test_the_cost_of_leaving_out_modes_of_a_plate_is_as_stated():
    plate = Plate(
        length=(1.2, 0.8), mass_per_area=8.0, bending_stiffness=175.0, poisson_ratio=0.3, edges="simply supported"
    )
    parts = (PointMass((0.43, 0.31), 0.2),)
    exact = replace(plate, attachments=parts).modes(8, tolerance=1e-7).omega
    for n in (40, 80, 160):
        told = truncation_error(plate.modes(n), parts)[:8]
        true = np.abs(attach(plate.modes(n), parts).omega[:8] / exact - 1.0)
        np.testing.assert_allclose(told, true, rtol=0.6)


def test_no_cost_is_stated_where_the_flexibility_at_a_point_has_no_end():
    """A net of springs and masses is a membrane, which a force at a point moves by the logarithm of its mesh."""
    n = 24
    line = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    stiffness = np.kron(line, np.eye(n)) + np.kron(np.eye(n), line)
    at = [(i, j, 0.0) for i in range(n) for j in range(n)]
    net = FiniteElements(np.eye(n * n), stiffness, nodes=at, directions=("z",))
    parts = (PointMass("300z", 3.0),)
    modes = net.modes(40)
    true = np.abs(attach(modes, parts).omega[:20] / net.attached(parts).modes(20).omega - 1.0)
    assert true.max() > 5e-4 and np.isinf(truncation_error(modes, parts)[:20][true > 1e-9]).all()


def test_a_mass_on_a_structure_with_dampers_is_one_in_its_matrices():
    rng = np.random.default_rng(5)
    mass, stiffness, damping = (a @ a.T + 3.0 * np.eye(5) for a in rng.normal(size=(3, 5, 5)))
    names = tuple("pqrst")

    def model(m):
        return FiniteElements(m, 400.0 * stiffness, nodes=NamedPoints(names), damping=0.05 * damping)

    heavier = mass.copy()
    heavier[2, 2] += 1.5
    poles = [
        np.sort_complex(np.linalg.eigvals(modes.state_matrix))
        for modes in (attach(model(mass).modes(5), (PointMass("r", 1.5),)), model(heavier).modes(5))
    ]
    np.testing.assert_allclose(*poles, rtol=1e-9)


def test_a_mass_between_two_points_is_refused():
    model = FiniteElements(np.eye(2), np.diag([1.0, 2.0]), nodes=NamedPoints(("p", "q")))
    with pytest.raises(ValueError, match="a mass is attached to one point; give it at each of the two"):
        attach(model.modes(2), (PointMass(Between("p", "q"), 0.1),))


def test_parts_that_no_structure_has_are_refused():
    for part, figure in ((PointMass, "mass"), (PointSpring, "stiffness"), (PointDamper, "coefficient")):
        with pytest.raises(ValueError, match=f"the {figure} of a {part.__name__} must be finite; got nan"):
            part(0.5, np.nan)
    for n in (0, 5):
        with pytest.raises(ValueError, match=f"4 modes give 1 to 4 with attachments; got n_modes={n}"):
            attach(beam().modes(4), (PointMass(1.3, 0.5),), n_modes=n)
    with pytest.raises(ValueError, match="damping ratios must be finite and not negative, one at least"):
        replace(beam(), damping=ModalDamping([])).modes(2)
    with pytest.raises(ValueError, match="a negative mass is too large"):
        attach(beam().modes(4), (PointMass(2.0, -50.0),))
