"""Models from matrices against beams in closed form, elements of scikit-fem and plain linear algebra."""

import time

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.sparse import csc_array, diags_array, eye_array, kron
from scipy.sparse.linalg import eigsh

from workbench.design.laws.imsc import imsc
from workbench.design.spillover.spillover import spillover
from workbench.rig.actuators import Actuator
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.finite_elements import FiniteElements
from workbench.structure.member import Beam
from workbench.structure.modes import Modes
from workbench.structure.modification import attach, truncation_error
from workbench.structure.supports import PointDamper, PointMass, PointSpring

LENGTH = 10.0


def beam(*attachments, ends="hinged", damping=None):
    return Beam(
        length=LENGTH, mass_per_length=1.0, bending_stiffness=1.0, left=ends, right=ends, attachments=attachments,
        damping=damping or ModalDamping(),
    )  # fmt: skip


def test_elements_of_a_beam_have_the_modes_of_the_beam(beam_elements):
    found, exact = beam_elements(damping=ModalDamping(0.01)).modes(6), beam().modes(6)
    np.testing.assert_allclose(found.omega, exact.omega, rtol=1e-6)
    np.testing.assert_allclose(found.zeta, 0.01, rtol=1e-12)
    x = np.array([2.0, 5.5])
    np.testing.assert_allclose(np.abs(found.phi(["w40", "w110"])), np.abs(exact.phi(x)), rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(
        np.abs(found.phi(["w40"], 1, direction="z")), np.abs(exact.phi(2.0, 1)), rtol=1e-5, atol=1e-9
    )


def test_a_free_structure_has_its_rigid_modes_at_zero(beam_elements):
    found = beam_elements(hinged=False).modes(5)
    assert (found.omega[:2] == 0).all()
    np.testing.assert_allclose(found.omega[2:], beam(ends="free").modes(5).omega[2:], rtol=1e-6)


@pytest.mark.parametrize("n_modes", [1, 2])
def test_masses_without_any_stiffness_move_as_rigid_bodies(n_modes):
    modes = FiniteElements(np.diag([2.0, 3.0]), np.zeros((2, 2)), nodes=NamedPoints(("a", "b"))).modes(n_modes)
    assert (modes.omega == 0.0).all()
    shapes = modes.phi(["a", "b"])
    np.testing.assert_allclose(shapes.T @ np.diag([2.0, 3.0]) @ shapes, np.eye(n_modes), atol=1e-12)


def test_what_is_attached_stands_in_the_matrices(beam_elements):
    parts = [PointMass(3.0, 2.0, 0.4), PointSpring(7.0, 5.0), PointSpring(5.0, 1.0, 2.0)]
    named = [
        PointMass("w60", 2.0),
        PointMass("r60", 0.0, 0.4),
        PointSpring("w140", 5.0),
        PointSpring("w100", 1.0),
        PointSpring("r100", 2.0),
    ]
    found = beam_elements().attached(named).modes(5)
    np.testing.assert_allclose(found.omega, beam(*parts).modes(5).omega, rtol=1e-6)


def row_of_masses(damping=None):
    """Three unit masses, to ground and to one another by springs of 100, 1 and 30 N/m."""
    stiffness = np.array([[101.0, -1.0, 0.0], [-1.0, 31.0, -30.0], [0.0, -30.0, 30.0]])
    points = NamedPoints(("a", "b", "c"), np.eye(3), ("x", "x", "x"))
    return FiniteElements(np.eye(3), stiffness, nodes=points, damping=damping), stiffness


def test_springs_and_dampers_between_two_points_act_on_their_difference():
    model, stiffness = row_of_masses(damping=0.1 * np.eye(3))
    row = np.array([1.0, 0.0, -1.0])
    found = model.attached([PointSpring(Between("a", "c"), 7.0), PointDamper(Between("a", "c"), 0.2)]).modes(2)
    values, vectors = eigh(stiffness + 7.0 * np.outer(row, row))
    np.testing.assert_allclose(found.omega, np.sqrt(values[:2]), rtol=1e-12)
    damping = vectors.T @ (0.1 * np.eye(3) + 0.2 * np.outer(row, row)) @ vectors
    np.testing.assert_allclose(np.abs(found.damping), np.abs(damping[:2, :2]), rtol=1e-9)


def test_attaching_to_the_modes_says_what_it_costs(beam_elements):
    parts = (PointMass("w60", 3.0), PointSpring("w150", 4.0))
    model = beam_elements()
    exact = model.attached(parts).modes(10).omega
    modes = model.modes(20)
    told = truncation_error(modes, parts)[:10]
    true = np.abs(attach(modes, parts).omega[:10] / exact - 1.0)
    assert (true <= told).all() and (told[:5] < 5e-3).all() and (true > 0).all()
    assert np.isinf(truncation_error(modes, parts)[10:]).all()


def test_a_beam_is_the_same_along_an_interval_at_named_points_and_as_elements(beam_elements):
    """Gains exactly, W_R to the error of 200 elements, which is below 1e-6 of the residual frequencies."""
    n, places = 8, (2.0, 4.0, 6.0, 8.0)
    along = beam().modes(n)
    x = np.linspace(0.0, LENGTH, 201)
    table = along.phi(x)
    points = NamedPoints(tuple(f"w{i}" for i in range(201)), np.column_stack([x, 0 * x, 0 * x]), ("y",) * 201)
    named = Modes(along.omega, np.zeros(n), lambda index, _: table[index], points)
    elements = beam_elements().modes(n)
    works, gains = [], []
    for modes, wheres in ((along, places), (named, [f"w{20 * x:.0f}" for x in places]),
                          (elements, [f"w{20 * x:.0f}" for x in places])):  # fmt: skip
        struck = modes.phi(6.3 if modes is along else "w126")[0]
        law = imsc(modes, 4, [Actuator(f"F{i}", at) for i, at in enumerate(wheres)], weight=20.0)
        works.append(spillover(modes, law, np.r_[np.zeros(n), struck * (np.arange(n) < 4)]).residual_work)
        signs = np.sign(modes.phi([wheres[0]])[0][:4] / along.phi([places[0]])[0][:4])
        gains.append(law.gain * np.r_[signs, signs])
    np.testing.assert_allclose(works, works[0], rtol=1e-5)
    np.testing.assert_allclose(gains[1], gains[0], rtol=1e-12)
    np.testing.assert_allclose(gains[2], gains[0], rtol=1e-5, atol=1e-7 * np.abs(gains[0]).max())


@pytest.mark.slow
def test_thirty_thousand_degrees_of_freedom_take_no_longer_than_twice_arpack():
    def chain(n):
        return diags_array([2.0 * np.ones(n), -np.ones(n - 1), -np.ones(n - 1)], offsets=[0, 1, -1])

    nx, ny = 250, 120
    membrane = (kron(chain(nx), eye_array(ny)) + kron(eye_array(nx), chain(ny))).tocsc()
    stiffness, mass = csc_array(membrane @ membrane), csc_array(3.0 * eye_array(nx * ny))
    places = np.column_stack([np.repeat(np.arange(nx), ny), np.tile(np.arange(ny), nx), np.zeros(nx * ny)])
    started = time.perf_counter()
    found = FiniteElements(mass, stiffness, nodes=places, directions=("z",)).modes(100)
    ours = time.perf_counter() - started
    started = time.perf_counter()
    values = eigsh(stiffness, k=100, M=mass, sigma=0.0)[0]
    assert ours < 2.0 * (time.perf_counter() - started)
    np.testing.assert_allclose(found.omega, np.sqrt(np.sort(values)), rtol=1e-7)


@pytest.mark.parametrize(
    "mass, stiffness, message",
    [
        (np.eye(3), np.triu(np.ones((3, 3))) + 3 * np.eye(3), "not symmetric.*one triangle"),
        (np.diag([1.0, -1.0, 1.0]), np.eye(3), "'b' has -1 kg"),
        (np.array([[1, 2, 0], [2, 1, 0], [0, 0, 1.0]]), np.eye(3), "mass matrix is not positive semidefinite"),
        (np.eye(3), np.diag([1.0, -1.0, 1.0]), "stiffness matrix is not positive semidefinite"),
        (np.eye(2), np.eye(3), r"shape \(2, 2\)"),
        (np.eye(3), np.diag([1.0, np.nan, 1.0]), "not finite"),
        (np.diag([1.0, 0.0, 1.0]), np.diag([1.0, 0.0, 1.0]), "point 'b' has neither mass nor stiffness.*leave it out"),
        (np.diag([1.0, 0.0, 0.0]), np.kron([[1.0, 0], [0, 0]], np.eye(2))[:3, :3], "point 'c' has neither mass nor"),
        (np.eye(3), (1.0 + 0.02j) * np.eye(3), r"stiffness matrix is complex.*loss factor.*ModalDamping"),
    ],
)
def test_matrices_that_are_no_structure_are_refused(mass, stiffness, message):
    with pytest.raises(ValueError, match=message):
        FiniteElements(mass, stiffness, nodes=NamedPoints(("a", "b", "c"))).modes(1)


def test_what_cannot_be_attached_is_refused_with_the_remedy():
    model = row_of_masses()[0]
    for part, message in (
        (PointMass(Between("a", "b"), 1.0), "one point"),
        (PointSpring("a", 1.0, 2.0), "rx, ry or rz"),
        (PointDamper("a", 1.0), "attach the dampers to its modes"),
        (PointSpring("d", 1.0), "no point 'd'"),
    ):
        with pytest.raises(ValueError, match=message):
            model.attached([part])
    with pytest.raises(ValueError, match="have 1 to 3 modes; got 4"):
        model.modes(4)


def test_what_is_no_matrix_number_of_modes_or_coordinate_is_named():
    model = row_of_masses()[0]
    with pytest.raises(ValueError, match=r"damping matrix has shape \(\); .* given as ModalDamping\(ratio\)"):
        FiniteElements(model.mass, model.stiffness, nodes=model.nodes, damping=0.01)
    with pytest.raises(ValueError, match=r"nodes are coordinates .* or NamedPoints, .*; got an array \(3,\) of <U1"):
        FiniteElements(model.mass, model.stiffness, nodes=["a", "b", "c"])
    with pytest.raises(TypeError, match="as an integer"):
        model.modes(2.0)


def test_a_lumped_model_has_as_many_modes_as_it_has_masses():
    model, stiffness = row_of_masses()
    np.testing.assert_allclose(model.modes(3).omega, np.sqrt(eigh(stiffness, eigvals_only=True)), rtol=1e-12)
    free = FiniteElements(np.eye(2), [[1.0, -1.0], [-1.0, 1.0]], nodes=NamedPoints(("a", "b")))
    np.testing.assert_allclose(free.modes(2).omega, [0.0, np.sqrt(2.0)], atol=1e-9)
    light = FiniteElements(np.diag([1.0, 0.0]), [[2.0, -1.0], [-1.0, 1.0]], nodes=NamedPoints(("a", "b")))
    with pytest.raises(ValueError, match="some degrees of freedom have no mass"):
        light.modes(2)


def test_nodes_given_by_their_coordinates_have_points_in_every_direction():
    model = FiniteElements(np.eye(6), np.diag(np.arange(1.0, 7.0)), nodes=[(0, 0, 0), (1, 0, 0)])
    assert model.nodes.names == ("1x", "1y", "1z", "2x", "2y", "2z")
    assert model.nodes.of_node("2", "y") == "2y"


def test_a_few_degrees_of_freedom_may_have_no_mass():
    """Their motion is static: the modes are those of the stiffness condensed to the others (Guyan, exact here)."""
    n, light = 5, [2]
    heavy = [0, 1, 3, 4]
    k = np.diag(np.full(n, 2.0)) - np.eye(n, k=1) - np.eye(n, k=-1)
    m = np.diag([1.0, 1.0, 0.0, 2.0, 1.0])
    points = NamedPoints(tuple("abcde"))
    coupling = k[np.ix_(heavy, light)]
    condensed = k[np.ix_(heavy, heavy)] - coupling @ np.linalg.solve(k[np.ix_(light, light)], coupling.T)
    expected = np.sqrt(eigh(condensed, m[np.ix_(heavy, heavy)])[0])
    modes = FiniteElements(m, k, nodes=points).modes(4)
    np.testing.assert_allclose(modes.omega, expected, rtol=1e-12)
    np.testing.assert_allclose(modes.phi(list("abcde")).T @ m @ modes.phi(list("abcde")), np.eye(4), atol=1e-12)
    few = np.diag([1.0, 0.0, 0.0, 2.0, 0.0])
    with pytest.raises(ValueError, match=r"2 motions of 5 degrees of freedom have mass.*ask for at most 2"):
        FiniteElements(few, k, nodes=points).modes(3)
