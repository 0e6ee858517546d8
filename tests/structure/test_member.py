"""Modes against closed forms, transcendental equations, and an independent finite-element program."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import j0, j1, jn_zeros, y0, y1

from workbench.structure.damping import ProportionalDamping, ViscousDamping
from workbench.structure.member import Bar, Beam
from workbench.structure.modes import mac
from workbench.structure.modification import attach
from workbench.structure.polynomials import Segments
from workbench.structure.profile import Profile
from workbench.structure.supports import End, PointDamper, PointMass, PointSpring


def uniform(left, right, **options):
    return Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left=left, right=right, **options)


def test_hinged_beam_closed_form():
    modes = uniform("hinged", "hinged").modes(20)
    r = np.arange(1, 21)
    np.testing.assert_allclose(modes.omega, (r * np.pi / 10) ** 2, rtol=1e-9)
    x = np.linspace(0, 10, 101)
    exact = np.sqrt(0.2) * np.sin(np.outer(x, r * np.pi / 10))
    assert np.abs(modes.phi(x) - exact).max() < 1e-7
    slope = np.sqrt(0.2) * (r * np.pi / 10) * np.cos(np.outer(x, r * np.pi / 10))
    assert np.abs(modes.phi(x, 1) - slope).max() < 1e-7 * slope.max()


def test_the_stiffness_has_a_name_and_an_order_of_its_strain():
    bar = Bar(length=2.0, mass_per_length=1.0, axial_stiffness=3.0, left="fixed", right="free")
    beam = uniform("hinged", "hinged")
    assert (bar.stiffness_name, bar.strain_order, bar.stiffness) == ("axial_stiffness", 1, bar.axial_stiffness)
    assert (beam.stiffness_name, beam.strain_order, beam.stiffness) == ("bending_stiffness", 2, beam.bending_stiffness)


def test_tapered_bar_closed_form():
    bar = Bar(
        length=1.0,
        mass_per_length=lambda x: 2 * (1 - x),
        axial_stiffness=lambda x: 2 * (1 - x),
        left="fixed",
        right="free",
    )
    modes = bar.modes(20)
    zeros = jn_zeros(0, 20)
    np.testing.assert_allclose(modes.omega, zeros, rtol=1e-9)
    x = np.linspace(0, 1, 101)
    exact = j0(np.outer(1 - x, zeros)) / j1(zeros)
    exact *= np.sign(exact[1])
    assert np.abs(modes.phi(x) - exact).max() < 1e-7 * np.abs(exact).max()


@pytest.mark.parametrize(
    ("ends", "equation", "rigid"),
    [
        (("clamped", "free"), lambda b: np.cos(b) * np.cosh(b) + 1, 0),
        (("clamped", "clamped"), lambda b: np.cos(b) * np.cosh(b) - 1, 0),
        (("free", "free"), lambda b: np.cos(b) * np.cosh(b) - 1, 2),
        (("clamped", "hinged"), lambda b: np.tan(b) - np.tanh(b), 0),
        (("clamped", "sliding"), lambda b: np.tan(b) + np.tanh(b), 0),
        (("hinged", "free"), lambda b: np.tan(b) - np.tanh(b), 1),
        (("sliding", "sliding"), lambda b: np.sin(b), 1),
    ],
)
def test_ends_against_transcendental_equations(ends, equation, rigid):
    modes = uniform(*ends).modes(8)
    assert (modes.omega[:rigid] == 0).all() and (modes.omega[rigid:] > 0).all()
    for omega in modes.omega[rigid:]:
        b = 10 * np.sqrt(omega)
        step = 1e-6
        root = brentq(equation, b - step, b + step, xtol=1e-14)
        assert abs(root / b - 1) < 1e-9


def test_rigid_body_modes_are_a_translation_and_a_rotation():
    modes = uniform("free", "free").modes(3)
    x = np.array([0.0, 2.5, 10.0])
    np.testing.assert_allclose(modes.phi(x)[:, 0], np.sqrt(0.1), rtol=1e-9)
    np.testing.assert_allclose(modes.phi(x)[:, 1], (5 - x) / 5 * modes.phi(0.0)[0, 1], atol=1e-9)


def test_elastic_end_against_its_equation():
    k = 3.0
    modes = uniform("hinged", End(np.inf, k)).modes(6)

    def equation(b):
        return b / 10 * (2 * np.sin(b) * np.sinh(b)) + k * (np.sin(b) * np.cosh(b) - np.cos(b) * np.sinh(b))

    for omega in modes.omega:
        b = 10 * np.sqrt(omega)
        assert abs(brentq(equation, b - 1e-5, b + 1e-5, xtol=1e-14) / b - 1) < 1e-9


@pytest.mark.parametrize(
    ("left", "right", "load"),
    [
        ("hinged", "hinged", 1.0),
        ("clamped", "free", 0.25),
        ("clamped", "clamped", 4.0),
        ("hinged", "clamped", 2.0457),
        ("clamped", "sliding", 1.0),
        ("sliding", "hinged", 0.25),
        ("free", "free", 1.0),
        ("hinged", "free", 1.0),
        ("sliding", "sliding", 1.0),
    ],
)
def test_buckling_load_closed_form(left, right, load):
    """In units of pi² EI / L² (Timoshenko and Gere, Theory of Elastic Stability, 2.1); of a rod on a spring too."""
    beam = Beam(length=0.9, mass_per_length=0.55, bending_stiffness=6.0, left=left, right=right, tension=3.0)
    assert beam.buckling_load() == pytest.approx(load * 6.0 * (np.pi / 0.9) ** 2, rel=1e-4)


def test_a_rigid_column_on_a_spring_buckles_under_k_times_l():
    """A stiff rod, hinged below and held aside by a spring at its tip: P = k L."""
    tip = PointSpring(0.9, 2.0)
    beam = Beam(
        length=0.9, mass_per_length=0.55, bending_stiffness=1e2, left="hinged", right="free", attachments=(tip,)
    )
    assert beam.buckling_load() == pytest.approx(2.0 * 0.9, rel=1e-3)
    near = replace(beam, tension=-0.99 * 2.0 * 0.9)
    assert near.modes(1).omega[0] < 0.2 * beam.modes(1).omega[0]
    with pytest.raises(ValueError, match="buckling"):
        replace(beam, tension=-1.01 * 2.0 * 0.9).modes(1)


def test_axial_load_closed_form():
    modes = uniform("hinged", "hinged", tension=0.3).modes(10)
    k = np.arange(1, 11) * np.pi / 10
    np.testing.assert_allclose(modes.omega, np.sqrt(k**4 + 0.3 * k**2), rtol=1e-9)
    with pytest.raises(ValueError, match="buckling"):
        uniform("hinged", "hinged", tension=-0.11).modes(3)


def test_cantilever_with_a_tip_mass_and_rotary_inertia():
    mass, inertia = 2.0, 0.7
    modes = uniform("clamped", "free", attachments=(PointMass(10.0, mass, inertia),)).modes(5)
    mu, nu = mass / 10.0, inertia / 1000.0

    def equation(b):
        c, s, ch, sh = np.cos(b), np.sin(b), np.cosh(b), np.sinh(b)
        return (
            1
            + mu * nu * b**4
            + (1 - mu * nu * b**4) * c * ch
            + mu * b * (c * sh - s * ch)
            - nu * b**3 * (c * sh + s * ch)
        )

    for omega in modes.omega:
        b = 10 * np.sqrt(omega)
        assert abs(brentq(equation, b - 1e-5, b + 1e-5, xtol=1e-14) / b - 1) < 1e-9


def test_stepped_bar_matches_its_jump_condition():
    bar = Bar(
        length=2.0,
        mass_per_length=([0, 1, 1, 2], [1, 1, 3, 3]),
        axial_stiffness=([0, 1, 1, 2], [4, 4, 2, 2]),
        left="fixed",
        right="free",
    )

    def equation(w):
        a, b = w * np.sqrt(1 / 4), w * np.sqrt(3 / 2)
        return 4 * a * np.cos(a) * np.cos(b) - 2 * b * np.sin(a) * np.sin(b)

    for omega in bar.modes(12).omega:
        assert abs(brentq(equation, omega * (1 - 1e-6), omega * (1 + 1e-6), xtol=1e-14) / omega - 1) < 1e-9


def test_general_beam_against_scikit_fem():
    skfem = pytest.importorskip("skfem")
    from scipy.sparse.linalg import eigsh
    from skfem.helpers import dd, ddot

    beam = Beam(
        length=3.0,
        mass_per_length=lambda x: 1.5 - 0.2 * x,
        bending_stiffness=lambda x: 2.0 + np.sin(x),
        left="clamped",
        right="hinged",
        attachments=(PointMass(1.2, 0.4), PointSpring(2.1, 30.0)),
        tension=4.0,
    )
    mesh = skfem.MeshLine(np.linspace(0, 3, 301))
    basis = skfem.Basis(mesh, skfem.ElementLineHermite(), intorder=10)
    stiff = skfem.BilinearForm(
        lambda u, v, w: (2.0 + np.sin(w.x[0])) * ddot(dd(u), dd(v)) + 4.0 * u.grad[0] * v.grad[0]
    ).assemble(basis)
    mass = skfem.BilinearForm(lambda u, v, w: (1.5 - 0.2 * w.x[0]) * u * v).assemble(basis)
    stiff, mass = stiff.tolil(), mass.tolil()
    for at, matrix, value in ((1.2, mass, 0.4), (2.1, stiff, 30.0)):
        node = int(np.argmin(np.abs(mesh.p[0] - at)))
        dof = basis.nodal_dofs[0, node]
        matrix[dof, dof] += value
    held = [*basis.nodal_dofs[:, int(np.argmin(mesh.p[0]))], basis.nodal_dofs[0, int(np.argmax(mesh.p[0]))]]
    free = np.setdiff1d(np.arange(basis.N), held)
    values = eigsh(
        stiff.tocsc()[np.ix_(free, free)], 6, mass.tocsc()[np.ix_(free, free)], sigma=0, return_eigenvectors=False
    )
    np.testing.assert_allclose(beam.modes(6).omega, np.sqrt(np.sort(values)), rtol=2e-6)


@pytest.mark.parametrize("ends", [("hinged", "free"), ("clamped", End(2.0, 0.5))])
def test_modes_are_orthonormal(ends):
    m = Profile.points([0, 4, 4, 10], [1.0, 2.0, 0.5, 1.5])
    beam = Beam(
        length=10.0,
        mass_per_length=m,
        bending_stiffness=lambda x: 1 + 0.1 * x,
        left=ends[0],
        right=ends[1],
        attachments=(PointMass(7.0, 0.8, 0.2),),
    )
    modes = beam.modes(12)
    total = 0.8 * modes.phi(7.0).T @ modes.phi(7.0) + 0.2 * modes.phi(7.0, 1).T @ modes.phi(7.0, 1)
    g, w = np.polynomial.legendre.leggauss(60)
    for a, b in ((0, 4), (4, 7), (7, 10)):
        x = a + (b - a) * (g + 1) / 2
        total = total + modes.phi(x).T @ ((w * (b - a) / 2 * m(x))[:, None] * modes.phi(x))
    assert np.abs(total - np.eye(12)).max() < 1e-9


def test_damping_coefficients():
    modes = uniform("hinged", "hinged", damping=ProportionalDamping(stiffness=0.002, mass=0.1)).modes(5)
    np.testing.assert_allclose(2 * modes.zeta * modes.omega, 0.002 * modes.omega**2 + 0.1, rtol=1e-12)
    assert modes.proportional
    coupled = uniform("hinged", "hinged", attachments=(PointDamper(3.0, 0.4),)).modes(5)
    shape = coupled.phi(3.0)[0]
    np.testing.assert_allclose(coupled.damping, 0.4 * np.outer(shape, shape), atol=1e-12)
    spread = uniform("hinged", "hinged", damping=ViscousDamping(0.6)).modes(5)
    np.testing.assert_allclose(spread.damping, 0.6 * np.eye(5), atol=1e-9)


def test_attachments_on_modes_agree_with_the_structure_solved_anew():
    parts = (PointSpring(3.3, 0.02), PointDamper(6.1, 0.1))
    anew = uniform("hinged", "hinged", attachments=parts).modes(4)
    attached = attach(uniform("hinged", "hinged").modes(60), parts).select(range(4))
    np.testing.assert_allclose(attached.omega, anew.omega, rtol=1e-6)
    x = np.linspace(0, 10, 31)
    assert np.diag(mac(attached.phi(x), anew.phi(x))).min() > 1 - 1e-9


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mass_per_length": -1.0}, "mass_per_length must be positive"),
        ({"mass_per_length": ([0.0, 4.0], [1.0, 2.0])}, "given at points from x = 0 to 4, and not at .*both ends"),
        ({"bending_stiffness": ([0.5, 10.0], [1.0, 2.0])}, "given at points from x = 0.5 to 10, and not at"),
        ({"length": 0.0}, "length"),
        ({"left": "glued"}, "hinged, clamped, free, sliding"),
        ({"attachments": (PointMass(11.0, 1.0),)}, "outside"),
        ({"attachments": (PointMass(1.0, -1.0),)}, "a mass cannot be negative"),
    ],
)
def test_bad_structures_are_refused(change, words):
    arguments = dict(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged") | change
    with pytest.raises(ValueError, match=words):
        Beam(**arguments)


def test_more_segments_than_can_be_solved_are_refused():
    with pytest.raises(ValueError, match="at most 600"):
        uniform("hinged", "free", attachments=tuple(PointMass(x, 1e-3) for x in np.linspace(0, 10, 700))).modes(2)


def test_a_jump_in_a_function_warns_the_caller():
    """The warning named a line of the workbench, so that Python showed it once for all structures."""
    jump = Bar(
        length=1.0,
        mass_per_length=lambda x: np.where(x < 0.3, 1.0, 9.0),
        axial_stiffness=1.0,
        left="fixed",
        right="free",
    )
    with pytest.warns(UserWarning, match="did not converge") as said:
        jump.modes(2)
    assert said[0].filename == __file__


@pytest.mark.parametrize(("between", "doubled"), [((0.5, None), [False, True]), ((None, 0.5), [True, False])])
def test_a_profile_is_scaled_to_the_end_where_one_bound_is_given(between, doubled):
    """A bound alone was ignored."""
    scaled = Profile.points([0.0, 1.0], [1.0, 1.0]).scaled(2.0, *between)
    assert scaled([0.25, 0.75]).tolist() == [2.0 if each else 1.0 for each in doubled]
    assert scaled.breaks == (0.0, 0.5, 1.0)


def test_positions_outside_are_refused():
    with pytest.raises(ValueError, match="outside"):
        uniform("hinged", "hinged").modes(2).phi(10.5)


@pytest.mark.parametrize("softness", [1e-2, 1e-5, 1e-8, 1e-11])
def test_a_soft_spring_keeps_its_digits(softness):
    """A free bar on an end spring k: β tan β = k L / EA; ω² = k / m L where k is small."""
    bar = Bar(length=2.0, mass_per_length=3.0, axial_stiffness=5.0, left=End(softness * 5.0 / 2.0), right="free")
    beta = brentq(lambda b: b * np.tan(b) - softness, 0.5 * np.sqrt(softness), 1.5, xtol=1e-300, rtol=1e-15)
    assert bar.modes(2).omega[0] == pytest.approx(beta / 2.0 * np.sqrt(5.0 / 3.0), rel=1e-12)


def test_a_short_segment_leaves_a_rigid_body_rigid():
    """Between a break and a mass close by, the entries of the stiffness matrix are 10⁷ times its eigenvalues."""
    beam = Beam(
        length=1.0,
        mass_per_length=1.0,
        bending_stiffness=([0.0, 0.168, 1.0], [1.0, 1.1, 1.0]),
        left="free",
        right="hinged",
        attachments=(PointMass(0.5, 1.0), PointMass(0.172, 1.0)),
    )
    assert beam.modes(3).omega[0] == 0


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("left", ["clamped", "free"])
@pytest.mark.parametrize("distance", [8e-4, 1.5e-4, 5e-5])
def test_mass_just_short_of_the_tip(left, distance):
    """Rayleigh: moved by -d, a mass m changes ω by m φ(L) φ'(L) d of itself, φ the shapes with the mass at the tip."""
    mass = 0.3
    at_tip, beside = (
        Beam(
            length=1.0,
            mass_per_length=1.0,
            bending_stiffness=1.0,
            left=left,
            right="free",
            attachments=(PointMass(at, mass),),
        ).modes(8)
        for at in (1.0, 1.0 - distance)
    )
    shape, slope = (at_tip.shapes(np.array([1.0]), derivative)[0] for derivative in (0, 1))
    bending = at_tip.omega > 0
    found = beside.omega[bending] / at_tip.omega[bending] - 1.0
    np.testing.assert_allclose(found, (mass * shape * slope)[bending] * distance, rtol=2e-3)


def pointed(*attachments):
    taper = {"mass_per_length": lambda x: 2 * (1 - x), "axial_stiffness": lambda x: 2 * (1 - x)}
    return Bar(length=1.0, left="fixed", right="free", attachments=attachments, **taper)


@pytest.mark.parametrize("distance", [0.1, 1e-3, 5e-5])
def test_a_spring_beside_a_tip_closed_form(distance):
    """J0 on the side of the tip, and J0 and Y0 on the other, meet at the spring."""
    stiffness = 2.0

    def unbalanced(omega):
        z = omega * distance
        other = j0(z) * y0(omega) - j0(omega) * y0(z)
        slope = -j1(z) * y0(omega) + j0(omega) * y1(z)
        return 2 * z * (j1(z) * other + slope * j0(z)) - stiffness * j0(z) * other

    omega = pointed(PointSpring(1.0 - distance, stiffness)).modes(6, tolerance=1e-8).omega
    exact = [brentq(unbalanced, w * (1 - 1e-3), w * (1 + 1e-3), xtol=1e-13) for w in omega]
    np.testing.assert_allclose(omega, exact, rtol=1e-8)


@pytest.mark.parametrize(
    ("part", "words"),
    [
        (PointMass(0.5, 0.1, 0.02), "a bar in axial vibration does not rotate; leave rotary_inertia out"),
        (PointSpring(0.5, 0.0, 3.0), "does not rotate; leave rotational_stiffness out"),
        (PointDamper(0.5, 1.0, 3.0), "does not rotate; leave rotational_coefficient out"),
    ],
)
def test_nothing_turns_on_a_bar(part, words):
    """It acted on the axial strain there, which jumps: no number of functions sufficed."""
    bar = {"length": 1.0, "mass_per_length": 1.0, "axial_stiffness": 1.0, "left": "fixed", "right": "free"}
    with pytest.raises(ValueError, match=words):
        Bar(**bar, attachments=(part,))


def test_nothing_stands_on_a_tip():
    with pytest.raises(ValueError, match="is on a tip"):
        pointed(PointSpring(1.0, 2.0))
    with pytest.raises(ValueError, match="is on a tip"):
        pointed(PointMass(1.0 - 1e-7, 0.1))
    assert pointed(PointDamper(1.0, 0.1)).modes(2).omega.size == 2


@pytest.mark.parametrize("n_modes", [3, 8, 14, 24])
@pytest.mark.parametrize("attachments", [(), (PointMass(0.7, 2.0),)])
def test_modes_settle_at_the_first_solution(monkeypatch, n_modes, attachments):
    left_open = []
    unresolved = Segments.unresolved
    monkeypatch.setattr(Segments, "unresolved", lambda *a: left_open.append(unresolved(*a)) or left_open[-1])
    uniform("clamped", "free", attachments=attachments).modes(n_modes)
    assert len(left_open) == 1
    assert left_open[0] > 1e-15  # a degree that carries no more than it must
