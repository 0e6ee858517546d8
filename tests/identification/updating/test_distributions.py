import numpy as np
import pytest

from workbench.identification.shapes.eigenfunctions import BoundaryConditions, eigenfunctions
from workbench.identification.updating.distributions import Basis, choose_terms, mass_and_stiffness, self_check
from workbench.structure.member import Bar, Beam
from workbench.structure.modes import SampledModes
from workbench.structure.supports import PointMass

X = np.linspace(0.0, 2.0, 81)


def mass(x):
    return 1.0 + 0.3 * x


def stiffness(x):
    return 3.0 - 0.5 * x + 0.2 * x**2


@pytest.fixture(
    scope="module", params=[("beam", "free", "free", 2), ("beam", "clamped", "hinged", 0), ("bar", "fixed", "free", 0)]
)
def case(request):
    """Kind, ends, and six elastic modes of a structure with these distributions."""
    kind, left, right, first = request.param
    build = {"beam": Beam, "bar": Bar}[kind]
    name = {"beam": "bending_stiffness", "bar": "axial_stiffness"}[kind]
    structure = build(length=2.0, mass_per_length=mass, left=left, right=right, **{name: stiffness})
    ends = {"kind": kind, "left": left, "right": right, "first_mode": first}
    return ends, structure.modes(first + 6).select(slice(first, None))


@pytest.mark.parametrize("known", [[(1.0, 1.3)], [(0.0, 1.0), (2.0, 1.6)]])
def test_exact_modes_give_exact_distributions(case, known):
    ends, modes = case
    found = mass_and_stiffness(
        modes,
        kind=ends["kind"],
        mass_basis=Basis.polynomial(3),
        stiffness_basis=Basis.polynomial(4),
        known_mass=known,
    )
    assert np.allclose(found.mass.coefficients, [1, 0.3, 0], atol=1e-9)
    assert np.allclose(found.stiffness.coefficients, [3, -0.5, 0.2, 0], atol=1e-9)
    assert np.allclose(found.scales, 1.0, atol=1e-9)
    assert found.mass.misfit < 1e-10
    assert self_check(found, modes, **ends).worst < 1e-9


def test_scale_of_the_modes_does_not_matter(case):
    from dataclasses import replace

    ends, modes = case
    factors = np.array([3.0, -0.2, 1.0, 7.0, 0.5, -1.0])
    scaled = replace(modes, shapes=lambda x, derivative: modes.shapes(x, derivative) * factors)
    found = mass_and_stiffness(
        scaled,
        kind=ends["kind"],
        mass_basis=Basis.polynomial(2),
        stiffness_basis=Basis.polynomial(3),
        known_mass=[(1.0, 1.3)],
    )
    assert np.allclose(found.stiffness(X), stiffness(X), rtol=1e-9)
    assert np.allclose(found.scales, np.abs(factors), rtol=1e-9)


def test_prior_estimate_is_corrected(case):
    """A right prior needs no series; a wrong one is corrected by it (4.20-4.24)."""
    ends, modes = case
    options = {"kind": ends["kind"], "known_mass": [(1.0, 1.3)]}
    right = mass_and_stiffness(
        modes,
        mass_basis=Basis.polynomial(1),
        stiffness_basis=Basis.polynomial(1),
        prior_mass=mass,
        prior_stiffness=stiffness,
        **options,
    )
    assert np.abs(right.mass.coefficients).max() < 1e-9
    assert np.abs(right.stiffness.coefficients).max() < 1e-8
    corrected = mass_and_stiffness(
        modes,
        mass_basis=Basis.polynomial(2),
        stiffness_basis=Basis.polynomial(3),
        prior_mass=2.0,
        prior_stiffness=lambda x: 1.0 + x,
        **options,
    )
    assert np.allclose(corrected.mass(X), mass(X), rtol=1e-9)
    assert np.allclose(corrected.stiffness(X), stiffness(X), rtol=1e-9)


def test_local_functions(case):
    ends, modes = case
    splines = {"length": 2.0, "degree": 2}
    found = mass_and_stiffness(
        modes,
        kind=ends["kind"],
        mass_basis=Basis.splines(4, **splines),
        stiffness_basis=Basis.splines(5, **splines),
        known_mass=[(1.0, 1.3)],
    )
    assert np.allclose(found.mass(X), mass(X), rtol=1e-8)
    assert np.allclose(found.stiffness(X), stiffness(X), rtol=1e-8)


def test_terms_chosen_by_the_self_check(case):
    ends, modes = case
    identified = choose_terms(modes, known_mass=[(1.0, 1.3)], terms=range(1, 5), **ends)
    assert identified.n_terms == (2, 3)
    assert identified.check.worst < 1e-9
    assert identified.check.mac.min() > 1 - 1e-9


@pytest.mark.filterwarnings("ignore:two modes are orthogonal only to within")
def test_self_check_tells_a_wrong_answer(case):
    """Two terms cannot hold this stiffness; the identified structure then has other frequencies."""
    ends, modes = case
    found = mass_and_stiffness(
        modes,
        kind=ends["kind"],
        mass_basis=Basis.polynomial(1),
        stiffness_basis=Basis.polynomial(1),
        known_mass=[(1.0, 1.3)],
    )
    assert self_check(found, modes, **ends).worst > 1e-3
    with pytest.warns(UserWarning, match="the stiffness is uncertain by .* %, as single modes left out show"):
        nowhere = mass_and_stiffness(
            modes,
            kind=ends["kind"],
            mass_basis=Basis.polynomial(1),
            stiffness_basis=Basis.polynomial(2),
            known_mass=[(1.0, 1.3)],
            prior_stiffness=lambda x: -50.0 * np.cos(9 * x),
        )
    assert "must be positive" in self_check(nowhere, modes, **ends).refusal


@pytest.mark.parametrize("basis", [Basis.polynomial(3), Basis.legendre(3, length=2.0), Basis.splines(3, length=2.0)])
def test_values_have_the_shape_of_the_places(case, basis):
    """A table of places was refused by polynomials, or multiplied wrongly."""
    ends, modes = case
    found = mass_and_stiffness(
        modes, kind=ends["kind"], mass_basis=basis, stiffness_basis=basis, known_mass=[(1.0, 1.3)]
    )
    np.testing.assert_allclose(found.mass(X.reshape(9, 9)), mass(X).reshape(9, 9), rtol=1e-8)
    assert found.mass(0.5).shape == () and found.stiffness.profile(X.reshape(9, 9)).shape == (9, 9)


CLAMPED = BoundaryConditions.of("beam", length=2.0, left="clamped", right="free")


def from_sensors(noise, seed, parts=()):
    """Distributions of a cantilever from five modes at 15 sensors, in error by this share of each shape's largest."""
    modes = Beam(
        length=2.0, mass_per_length=mass, bending_stiffness=stiffness, left="clamped", right="free", attachments=parts
    ).modes(5)
    x, rng = np.arange(1, 16) / 7.5, np.random.default_rng(seed)
    shapes = modes.phi(x)
    shapes = shapes + noise * np.abs(shapes).max(axis=0) * rng.standard_normal(shapes.shape)
    return eigenfunctions(
        SampledModes(modes.omega, np.full(5, 0.01), shapes.astype(complex), x), length=2.0, ends=CLAMPED
    )


TERMS = {"kind": "beam", "mass_basis": Basis.polynomial(2), "stiffness_basis": Basis.polynomial(2)}


@pytest.mark.filterwarnings("ignore:the stiffness is uncertain")
def test_standard_errors_are_as_large_as_the_errors():
    """Of noise in the shapes, over twelve measurements; two terms of stiffness are 2 % from the three true ones."""
    runs = [mass_and_stiffness(from_sensors(2e-3, seed), known_mass=[(1.0, 1.3)], **TERMS) for seed in range(12)]
    errors = np.array([run.stiffness(X) - stiffness(X) for run in runs])
    told = np.array([run.stiffness.std(X) for run in runs])
    assert 0.5 < np.sqrt((told**2).mean() / (errors**2).mean()) < 2.0


@pytest.mark.filterwarnings("ignore:the stiffness has no standard error")
def test_what_noisy_shapes_and_a_mass_at_a_point_leave_unknown_is_said():
    known = {"known_mass": [(1.0, 1.3)]}
    good = mass_and_stiffness(from_sensors(1e-5, 1), **known, **TERMS)
    assert "mass in 2 terms, stiffness in 2 terms from 5 modes, orthogonal to within 1.2e-05" in str(good)
    assert not good.remarks
    with pytest.warns(UserWarning, match="the stiffness is uncertain by .* choose_structure"):
        mass_and_stiffness(from_sensors(1e-2, 1), **known, **TERMS)
    heavy = from_sensors(1e-5, 1, (PointMass(2.0, 0.1),))
    with pytest.warns(UserWarning, match=r"two modes are orthogonal only to within 0.12, at most 0.1"):
        mass_and_stiffness(heavy, **known, **TERMS)
    with pytest.warns(UserWarning, match="two modes are orthogonal only to within"):
        chosen = choose_terms(heavy, kind="beam", left="clamped", right="free", terms=range(1, 3), **known)
    assert "identified structure against measurement" in str(chosen)
    with pytest.warns(UserWarning, match="the mass has no standard error, as no mode can be left out"):
        mass_and_stiffness(from_sensors(1e-5, 1).select([0, 1]), **known, **TERMS)


def test_refusals(case):
    with pytest.raises(ValueError, match="a series has 0 terms or more; got -1"):
        Basis.polynomial(-1)
    ends, modes = case
    kind = ends["kind"]
    one = {"mass_basis": Basis.polynomial(1), "stiffness_basis": Basis.polynomial(1)}
    with pytest.raises(ValueError, match="give the mass at one point"):
        mass_and_stiffness(modes, kind=kind, known_mass=[], **one)
    with pytest.raises(ValueError, match=r"a known mass must be positive and finite; got -1\.3 at x = 1"):
        mass_and_stiffness(modes, kind=kind, known_mass=[(1.0, -1.3)], **one)
    with pytest.raises(ValueError, match=r"x = 2\.5 lies outside the structure"):  # the series would be extrapolated
        mass_and_stiffness(modes, kind=kind, known_mass=[(2.5, 1.3)], **one)
    with pytest.raises(ValueError, match="use more terms or fewer known places"):
        mass_and_stiffness(modes, kind=kind, known_mass=[(0.0, 1.0), (2.0, 1.6)], **one)
    with pytest.raises(ValueError, match="use more modes or fewer terms"):
        mass_and_stiffness(
            modes.select([0]),
            kind=kind,
            mass_basis=Basis.polynomial(1),
            stiffness_basis=Basis.polynomial(2),
            known_mass=[(1.0, 1.3)],
        )
