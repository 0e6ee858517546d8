"""Plates and membranes against closed forms, published tables, beams, and finite elements of scikit-fem."""

import numpy as np
import pytest
from scipy.sparse.linalg import eigsh
from skfem import Basis, BilinearForm, ElementTriArgyris, ElementTriMorley, MeshTri
from skfem.helpers import dd, ddot, trace

from workbench.structure import surface_ritz
from workbench.structure.damping import ModalDamping, ViscousDamping
from workbench.structure.domain import Rectangle
from workbench.structure.member import Beam
from workbench.structure.plate import Membrane, Plate
from workbench.structure.profile import Field
from workbench.structure.supports import Edge, End, PointDamper, PointMass, PointSpring
from workbench.structure.surface_ritz import solve

CANTILEVER = {"left": "clamped", "right": "free", "bottom": "free", "top": "free"}


def square(edges="simply supported", **options):
    given = {"length": (1.0, 1.0), "mass_per_area": 1.0, "bending_stiffness": 1.0, "poisson_ratio": 0.3}
    return Plate(edges=edges, **(given | options))


def test_a_simply_supported_square_plate_has_its_closed_form():
    lowest = np.pi**2 * np.array([2.0, 5.0, 5.0, 8.0, 10.0])
    np.testing.assert_allclose(square().modes(5).omega, lowest, rtol=1e-12)


def test_the_numerical_method_agrees_with_the_closed_form():
    plate = square(length=(1.3, 0.8), mass_per_area=8.1, bending_stiffness=170.0, tension=(900.0, -300.0))
    exact, found = plate.modes(20), solve(plate.ritz_problem(), 20, tolerance=1e-9)
    np.testing.assert_allclose(found.omega, exact.omega, rtol=1e-9)
    places = np.random.default_rng(0).uniform((0.0, 0.0), (1.3, 0.8), (9, 2))
    for derivatives in ((0, 0), (1, 0), (0, 1), (1, 1)):
        there = exact.phi(places, derivatives)
        np.testing.assert_allclose(found.shapes(places, derivatives), there, atol=1e-5 * np.abs(there).max())


@pytest.mark.parametrize(
    "edges, published, unit",
    [  # ω a² √(m / D), ν = 0.3; Leissa (1973), J. Sound Vib. 31, 257-293, and Young (1950), one in the last place
        ("clamped", (35.985, 73.394, 73.394, 108.22, 131.58, 132.21), (1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2)),
        (CANTILEVER, (3.471, 8.507, 21.28, 27.20, 30.96, 54.19), (1e-3, 1e-3, 1e-2, 1e-2, 1e-2, 1e-2)),
        ("free", (0, 0, 0, 13.468, 19.596, 24.270, 34.801, 34.801), (1e-3,) * 8),
    ],
)
def test_a_square_plate_has_its_published_frequencies(edges, published, unit):
    omega = square(edges).modes(len(published)).omega
    assert (np.abs(omega - published) <= np.array(unit)).all(), omega


def element_modes(element, mesh, held, n_modes, *, mass=0.0, spring=0.0, nu=0.3):
    """ω of a plate by finite elements, D = m = 1; `held(basis)` gives the dofs; a mass and a spring at the origin."""

    @BilinearForm
    def bending(u, v, _):
        return (1.0 - nu) * ddot(dd(u), dd(v)) + nu * trace(dd(u)) * trace(dd(v))

    @BilinearForm
    def inertia(u, v, _):
        return u * v

    basis = Basis(mesh, element, intorder=10 if isinstance(element, ElementTriArgyris) else 4)
    matrices = []
    at = basis.nodal_dofs[0, np.argmin(np.hypot(*mesh.p))]
    free = np.setdiff1d(np.arange(basis.N), held(basis))
    for form, value in ((bending, spring), (inertia, mass)):
        matrix = form.assemble(basis).tolil()
        matrix[at, at] += value
        matrices.append(matrix.tocsc()[free][:, free])
    return np.sqrt(np.sort(eigsh(matrices[0], k=n_modes, M=matrices[1], sigma=0.0)[0]))


def clamped_rim(corner):
    """Of Argyris elements on a unit square: what a clamped rim holds; the second derivative along a normal stays."""

    def held(basis):
        x, y = basis.mesh.p - np.array(corner)[:, None]
        upright, level = np.isclose(x * (1 - x), 0), np.isclose(y * (1 - y), 0)
        u, u_x, u_y, u_xx, u_xy, u_yy = basis.nodal_dofs
        both = [dofs[upright | level] for dofs in (u, u_x, u_y, u_xy)]
        return np.concatenate([*both, u_xx[level], u_yy[upright], basis.get_dofs().facet["u_n"]])

    return held


@pytest.mark.slow
@pytest.mark.parametrize("mass, spring", [(0.15, 0.0), (0.0, 700.0), (0.1, 300.0)])
def test_a_point_mass_and_spring_on_a_plate_agree_with_refined_elements(mass, spring):
    at = (0.375, 0.5)
    mesh = MeshTri.init_tensor(np.linspace(0, 1, 17), np.linspace(0, 1, 17))
    mesh = mesh.translated((-at[0], -at[1]))  # near the origin, elements however small keep their digits
    found = []
    for _ in range(8):  # towards the point, where the motion is r² ln r
        mesh = mesh.refined(np.flatnonzero((np.hypot(*mesh.p[:, mesh.t]) < 1e-12).any(axis=0)))
        found.append(mesh)
    corner = (-at[0], -at[1])
    before, by_elements = (
        element_modes(ElementTriArgyris(), each, clamped_rim(corner), 4, mass=mass, spring=spring)
        for each in (found[-3], found[-1])
    )
    np.testing.assert_allclose(before, by_elements, rtol=1e-7)  # it stands
    attached = [PointMass(at, mass), PointSpring(at, spring)]
    ours = square("clamped", attachments=attached).modes(4, tolerance=1e-7).omega
    np.testing.assert_allclose(ours, by_elements, rtol=1e-6)


def test_elements_that_converge_from_below_and_this_method_enclose_a_cantilever():
    def held(basis):
        rim = basis.get_dofs(lambda x: np.isclose(x[0], 0.0))
        return rim.all()

    ritz = square(CANTILEVER).modes(4).omega
    coarse, fine = (element_modes(ElementTriMorley(), MeshTri().refined(n), held, 4) for n in (4, 5))
    assert (coarse < fine).all() and (fine < ritz).all()
    np.testing.assert_allclose((4.0 * fine - coarse) / 3.0, ritz, rtol=2e-3)


@pytest.mark.slow
def test_three_points_at_once_have_the_frequencies_that_their_receptances_give():
    """det(I + (k - ω² m) H(ω)) = 0, with H a double series in closed form, its tail by an integral."""
    places = np.array([(0.31, 0.42), (0.66, 0.42), (0.52, 0.77)])
    masses, springs = np.array([0.1, 0.0, 0.05]), np.array([0.0, 40.0, 0.0])
    parts = [PointMass(places[0], 0.1), PointSpring(places[1], 40.0), PointMass(places[2], 0.05)]
    n = 1500
    numbers = np.arange(1, n + 1)
    values = (np.pi**2 * (numbers[:, None] ** 2 + numbers**2)) ** 2
    sines = np.sin(np.pi * numbers * places.T[:, :, None])
    tail = 2.0 * (np.pi / 8 + 0.25) / (2.0 * (n + 0.5) ** 2) / np.pi**4  # the mean of 4 sin² sin² is one

    def characteristic(omega):
        inverse = 4.0 / (values - omega**2)
        along = np.einsum("pi,qi,ij->pqj", sines[0], sines[0], inverse, optimize=True)
        receptance = np.einsum("pqj,pj,qj->pq", along, sines[1], sines[1]) + tail * np.eye(3)
        return np.linalg.det(np.eye(3) + (springs - masses * omega**2)[:, None] * receptance)

    for omega in square(attachments=parts).modes(4, tolerance=1e-6).omega[:3]:
        assert characteristic(omega * (1 - 1e-6)) * characteristic(omega * (1 + 1e-6)) < 0


def beam_like(**options):
    """A plate that bends along x only in some of its modes: guided along y, ν = 0."""
    left, right = options.pop("ends")
    edges = {"left": left, "right": right, "bottom": "guided", "top": "guided"}
    return Plate(length=(2.0, 0.3), poisson_ratio=0.0, edges=edges, **options)


@pytest.mark.parametrize(
    "ends, beam_ends",
    [
        (("clamped", "free"), ("clamped", "free")),
        (("simply supported", "guided"), ("hinged", "sliding")),
        ((Edge(40.0, 3.0), Edge(15.0, 0.0)), (End(12.0, 0.9), End(4.5, 0.0))),
    ],
)
def test_a_plate_that_bends_one_way_is_a_beam(ends, beam_ends):
    width = 0.3

    def mass(x):
        return 1.0 + 0.4 * x

    def stiffness(x):
        return 2.0 * np.exp(-0.5 * x)

    plate = beam_like(
        ends=ends,
        mass_per_area=lambda x, y: mass(x),
        bending_stiffness=lambda x, y: stiffness(x),
        tension=(3.0, 0.0),
    )
    beam = Beam(
        length=2.0,
        mass_per_length=lambda x: width * mass(x),
        bending_stiffness=lambda x: width * stiffness(x),
        left=beam_ends[0],
        right=beam_ends[1],
        tension=3.0 * width,
    )
    ours, theirs = plate.modes(4, tolerance=1e-8), beam.modes(4)
    np.testing.assert_allclose(ours.omega, theirs.omega, rtol=1e-7)
    x = np.linspace(0.05, 1.95, 7)
    np.testing.assert_allclose(
        np.abs(ours.phi(np.column_stack([x, 0.1 + 0 * x]))), np.abs(theirs.phi(x)), rtol=1e-4, atol=1e-4
    )


def test_a_jump_of_thickness_is_that_of_a_stepped_beam():
    plate = beam_like(
        ends=("clamped", "clamped"),
        mass_per_area=Field(lambda x, y: np.where(x < 0.7, 2.0, 1.0), x_breaks=(0.7,)),
        bending_stiffness=Field(lambda x, y: np.where(x < 0.7, 8.0, 1.0), x_breaks=(0.7,)),
    )
    steps = {"mass_per_length": ([0, 0.7, 0.7, 2], [2, 2, 1, 1]), "bending_stiffness": ([0, 0.7, 0.7, 2], [8, 8, 1, 1])}
    beam = Beam(length=2.0, left="clamped", right="clamped", **steps)
    np.testing.assert_allclose(plate.modes(4).omega, beam.modes(4).omega, rtol=1e-7)


def test_mass_and_stiffness_follow_from_thickness_and_material():
    plate = Plate.of_thickness(
        length=(0.4, 0.3), thickness=2e-3, density=2700.0, youngs_modulus=7e10, poisson_ratio=0.33,
        edges="simply supported",
    )  # fmt: skip
    stiffness = 7e10 * 2e-3**3 / 12.0 / (1.0 - 0.33**2)
    expected = np.pi**2 * (1 / 0.4**2 + 1 / 0.3**2) * np.sqrt(stiffness / (2700.0 * 2e-3))
    np.testing.assert_allclose(plate.modes(1).omega, expected, rtol=1e-12)


def test_shear_tension_stiffens_one_diagonal_and_softens_the_other():
    bare = square("clamped").modes(4).omega
    sheared = [square("clamped", tension=(0.0, 0.0, n)).modes(4).omega for n in (-20.0, 20.0)]
    np.testing.assert_allclose(sheared[0], sheared[1], rtol=1e-8)  # a mirror image
    assert np.abs(sheared[0] / bare - 1.0).max() > 1e-3


@pytest.mark.slow
def test_modes_are_orthonormal_with_the_mass():
    plate = square(CANTILEVER, mass_per_area=lambda x, y: 1.0 + x * y, attachments=[PointMass((0.9, 0.3), 0.2)])
    modes = plate.modes(4)
    places, weights = Rectangle((1.0, 1.0)).quadrature(500)
    phi, tip = modes.phi(places), modes.phi((0.9, 0.3))
    mass = (weights * (1.0 + places.prod(axis=1))) @ (phi[:, :, None] * phi[:, None, :]).reshape(len(weights), -1)
    np.testing.assert_allclose(mass.reshape(4, 4) + 0.2 * tip.T @ tip, np.eye(4), atol=1e-5)


def test_repeated_modes_do_not_depend_on_the_route():
    modes = square("clamped").modes(3)
    pair = modes.phi([(0.3, 0.45), (0.45, 0.3)])[:, 1:]
    # the pair is told by its slopes along x; a turn of the square by a right angle takes one into the other
    np.testing.assert_allclose(np.abs(pair[0]), np.abs(pair[1][::-1]), rtol=1e-6)
    assert modes.phi((0.5, 0.2))[0, 2] == pytest.approx(0.0, abs=1e-9)


def test_damping_is_uniform_where_its_coefficient_is_and_dampers_add_to_it():
    plate = square("clamped", mass_per_area=2.0, damping=ViscousDamping(0.6))
    np.testing.assert_allclose(plate.modes(3).damping, 0.3 * np.eye(3), atol=1e-9)
    damped = square(damping=ModalDamping(0.01), attachments=[PointDamper((0.3, 0.4), 0.7)]).modes(3)
    row = damped.phi((0.3, 0.4))[0]
    np.testing.assert_allclose(damped.damping, np.diag(0.02 * damped.omega) + 0.7 * np.outer(row, row), atol=1e-12)


def test_a_membrane_has_its_closed_form():
    membrane = Membrane(length=(1.0, 2.0), mass_per_area=0.5, tension=3.0)
    numbers = np.array([(i, j) for i in range(1, 9) for j in range(1, 17)])
    exact = np.sort(np.pi * np.sqrt(3.0 / 0.5) * np.hypot(numbers[:, 0], numbers[:, 1] / 2.0))
    np.testing.assert_allclose(membrane.modes(20).omega, exact[:20], rtol=1e-9)
    assert Membrane(length=(1.0, 1.0), mass_per_area=1.0, tension=1.0, edges="free").modes(2).omega[0] == 0.0


@pytest.mark.parametrize(
    "change, message",
    [
        ({"edges": "hinged"}, "simply supported"),
        ({"edges": {"left": "free"}}, "left, right, bottom, top"),
        ({"edges": {}}, "or one for all; got none"),
        ({"mass_per_area": lambda x, y: x - 0.5}, "must be positive and finite everywhere"),
        ({"mass_per_area": lambda x, y: x + np.inf}, "must be positive and finite everywhere; it is inf"),
        ({"poisson_ratio": 0.7}, "Poisson's ratio"),
        ({"attachments": [PointMass((1.2, 0.1), 1.0)]}, "outside"),
        ({"attachments": [PointSpring((0.2, 0.1), 1.0, 2.0)]}, "is infinite"),
        ({"length": (1.0, 0.0)}, "positive"),
        ({"tension": (1.0, 2.0, 3.0, 4.0)}, "tension is one number"),
    ],
)
def test_bad_input_is_named_with_its_remedy(change, message):
    with pytest.raises(ValueError, match=message):
        square(**change)


def test_compression_beyond_buckling_is_refused():
    with pytest.raises(ValueError, match="buckling"):
        square(tension=-2.1 * np.pi**2).modes(2)  # the first buckling load is -2 π² D / a² both ways
    with pytest.raises(ValueError, match="buckling"):
        square("clamped", tension=-60.0).modes(2)
    assert square(tension=-1.9 * np.pi**2).modes(2).omega[0] > 0
    with pytest.raises(ValueError, match="or a spring of negative stiffness is too strong"):
        square("free", attachments=(PointSpring((0.3, 0.3), -10.0),)).modes(5)


def test_a_tolerance_out_of_reach_is_refused_with_what_is_known(monkeypatch):
    monkeypatch.setattr(surface_ritz, "MOST_FUNCTIONS", 900)
    with pytest.raises(ValueError, match=r"known to .* give tolerance="):
        square(CANTILEVER).modes(3, tolerance=1e-9)


def test_many_modes_of_a_long_plate_are_the_lowest_ones():
    omega = square(length=(20.0, 1.0)).modes(50).omega
    numbers = np.array([(i, j) for i in range(1, 200) for j in range(1, 20)])
    exact = np.sort(np.pi**2 * ((numbers[:, 0] / 20.0) ** 2 + numbers[:, 1] ** 2))
    np.testing.assert_allclose(omega, exact[:50], rtol=1e-12)


def test_the_places_that_no_mode_moves_are_those_of_its_held_edges():
    edges = {"left": "clamped", "bottom": "simply supported", "right": "free", "top": "free"}
    modes = square(edges, length=(1.2, 0.8)).modes(4)
    rim = np.array([(0.0, 0.0), (0.0, 0.5), (0.7, 0.0), (1.2, 0.0), (1.2, 0.4), (0.7, 0.8), (0.6, 0.4)])
    still = modes.are_held(rim)
    assert still.tolist() == [True, True, True, True, False, False, False]
    assert still.tolist() == [modes.is_held(tuple(place)) for place in rim]
