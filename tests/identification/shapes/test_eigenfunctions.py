import numpy as np
import pytest

from workbench.identification.shapes.bands import peano_kernel
from workbench.identification.shapes.eigenfunctions import (
    BoundaryConditions,
    best_degrees,
    eigenfunctions,
    interpolating_spline,
)
from workbench.identification.signal.synthesis import impulse_response_modes
from workbench.structure.member import Bar, Beam
from workbench.structure.modes import SampledModes
from workbench.structure.supports import PointMass

X = np.linspace(0.0, 2.0, 101)


def structure(kind, left, right):
    if kind == "bar":
        return Bar(length=2.0, mass_per_length=1.0, axial_stiffness=3.0, left=left, right=right)
    return Beam(length=2.0, mass_per_length=1.0, bending_stiffness=3.0, left=left, right=right)


def elastic(kind, left, right, count):
    modes = structure(kind, left, right).modes(count + 2)
    return modes.select(np.flatnonzero(modes.omega > 0)[:count])


@pytest.mark.parametrize("degree", [1, 3, 5, 7])
def test_reproduces_polynomials_of_its_degree(degree):
    positions = np.array([0.1, 0.3, 0.4, 0.7, 1.1, 1.2, 1.5, 1.8, 1.9])
    spline = interpolating_spline(positions, length=2.0, degree=degree)
    polynomial = np.polynomial.Polynomial(np.arange(1.0, degree + 2))
    assert np.allclose(spline.matrix(X) @ polynomial(positions), polynomial(X), rtol=1e-9, atol=1e-9)
    assert np.allclose(spline.matrix(X, 1) @ polynomial(positions), polynomial.deriv()(X), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(
    ("kind", "left", "right"),
    [("beam", "free", "free"), ("beam", "clamped", "free"), ("beam", "hinged", "sliding"), ("bar", "fixed", "free")],
)
@pytest.mark.parametrize("degree", [3, 5, 7])
def test_honours_known_ends(kind, left, right, degree):
    ends = BoundaryConditions.of(kind, length=2.0, left=left, right=right)
    modes = elastic(kind, left, right, 2)
    positions = np.linspace(0.15, 1.85, 9)
    found = eigenfunctions(
        SampledModes(modes.omega, modes.zeta, modes.phi(positions), positions), length=2.0, ends=ends, degree=degree
    )
    for at, derivative in ends.zeros:
        if derivative <= (degree - 1) // 2:
            assert np.abs(found.phi(at, derivative)).max() < 1e-8 * np.abs(found.phi(X, derivative)).max()


@pytest.mark.parametrize(("degree", "order"), [(3, 4), (5, 6), (7, 8)])
def test_order_of_convergence(degree, order):
    """Errors fall as the distance of the sensors to the power degree + 1, at known ends too."""
    modes = elastic("beam", "clamped", "free", 3)
    ends = BoundaryConditions.of("beam", length=2.0, left="clamped", right="free")
    errors = []
    for n in (16, 32):
        positions = np.linspace(0.0, 2.0, n + 1)
        sampled = SampledModes(modes.omega, modes.zeta, modes.phi(positions), positions)
        found = eigenfunctions(sampled, length=2.0, mass_per_length=1.0, ends=ends, degree=degree)
        errors.append(np.abs(np.abs(found.phi(X)) - np.abs(modes.phi(X)))[:, 2].max())
    assert np.log2(errors[0] / errors[1]) > order - 1.0
    assert errors[1] < 1e-4


def test_scaled_by_an_impulse_without_knowing_the_mass():
    modes = elastic("beam", "clamped", "free", 4)
    positions = np.linspace(0.1, 2.0, 20)
    ends = BoundaryConditions.of("beam", length=2.0, left="clamped", right="free")
    found = eigenfunctions(
        impulse_response_modes(modes, at=1.63, positions=positions), length=2.0, driven_at=1.63, ends=ends
    )
    assert np.abs(np.abs(found.phi(X)) - np.abs(modes.phi(X))).max() < 1e-4
    assert found.essential == modes.essential


def test_scaled_by_a_mass_distribution_and_what_is_attached():
    """A third of the mass sits at the tip; without it the first shape is 30 % too large."""
    tip = PointMass(at=2.0, mass=0.5, rotary_inertia=0.01)
    modes = Beam(
        length=2.0, mass_per_length=1.0, bending_stiffness=3.0, left="clamped", right="free", attachments=[tip]
    ).modes(3)
    positions = np.linspace(0.1, 2.0, 20)
    sampled = SampledModes(modes.omega, modes.zeta, modes.phi(positions), positions)
    ends = BoundaryConditions.of("beam", length=2.0, left="clamped")
    found = eigenfunctions(sampled, length=2.0, mass_per_length=1.0, point_masses=[tip], ends=ends)
    assert np.abs(np.abs(found.phi(X)) - np.abs(modes.phi(X))).max() < 1e-4
    with pytest.raises(ValueError, match="beside a mass distribution"):
        eigenfunctions(sampled, length=2.0, point_masses=[tip], ends=ends)
    with pytest.raises(ValueError, match="lies outside the structure"):
        eigenfunctions(sampled, length=2.0, mass_per_length=1.0, point_masses=[PointMass(2.5, 0.5)], ends=ends)


@pytest.mark.parametrize("derivative", [0, 1])
@pytest.mark.parametrize("right", ["free", None])
def test_what_a_spline_misses_by_its_peano_kernel(derivative, right):
    """Of sin 2x, whose fourth derivative is known, what the ends hold taken into account."""
    positions, x = np.linspace(0.1, 1.8, 9), np.linspace(0.0, 2.0, 11)
    ends = BoundaryConditions.of("beam", length=2.0, left="clamped", right=right)
    spline = interpolating_spline(positions, length=2.0, ends=ends, degree=5)

    def sine(x, k):
        return 2.0**k * np.sin(2.0 * np.asarray(x) + k * np.pi / 2.0)

    held = np.array([float(sine(at, d)) for at, d in spline.conditions])
    drawn = spline.matrix(x, derivative) @ sine(positions, 0) + spline.of_held(x, derivative) @ held
    kernel = peano_kernel(spline, x, positions, 2.0, derivative)
    u = (np.arange(kernel.shape[1]) + 0.5) * 2.0 / kernel.shape[1]
    missed = kernel @ sine(u, 4) * np.sqrt(2.0 / u.size)
    assert np.abs(missed - (sine(x, derivative) - drawn)).max() < 0.02 * np.abs(missed).max()


@pytest.mark.parametrize("last", [0.08, 0.12, 0.18])
def test_the_scale_holds_where_sensors_stand_on_a_small_part_of_the_structure(last):
    """The curve beyond them is large in each sensor's value, and small in their sum: products of the former cancel."""
    at, dense = np.linspace(0.02, last, 14), np.linspace(0.0, 1.0, 20001)
    noise = 1e-9 * np.random.default_rng(3).standard_normal((14, 1))
    shape = np.sin(np.pi * at)[:, None] + noise
    drawn = eigenfunctions(SampledModes([1.0], [0.01], shape, at), length=1.0, degree=9)
    assert np.trapezoid(drawn.phi(dense)[:, 0] ** 2, dense) == pytest.approx(1.0, rel=1e-6)


def test_default_degree_follows_the_mode():
    """High degrees for slow shapes; not for those that motion too fast for their sensors."""
    modes = elastic("bar", "fixed", "free", 8)
    positions = np.arange(1, 13) / 6
    sampled = SampledModes(modes.omega, modes.zeta, modes.phi(positions), positions)
    degrees = best_degrees(sampled, length=2.0, ends=BoundaryConditions.of("bar", length=2.0, left="fixed"))
    assert degrees[0] == 9
    assert degrees[-1] < 9


def test_refusals():
    modes = SampledModes([1.0], [0.0], [[1.0], [0.5], [0.2]], [0.5, 1.0, 1.5])
    with pytest.raises(ValueError, match="odd degree"):
        eigenfunctions(modes, length=2.0, degree=4)
    with pytest.raises(ValueError, match="odd degree; got 0"):
        eigenfunctions(modes, length=2.0, degree=0)
    with pytest.raises(ValueError, match="add sensors or take degree 1"):
        eigenfunctions(modes, length=2.0, degree=3)
    with pytest.raises(ValueError, match="lies outside"):
        eigenfunctions(modes, length=1.2, degree=1)
    with pytest.raises(ValueError, match="x = nan lies outside"):
        interpolating_spline([0.5, np.nan, 1.5], length=2.0, degree=1)
    held = BoundaryConditions.of("beam", length=2.0, left="hinged", right="hinged")
    with pytest.raises(ValueError, match="condition holds at x = 2, which is no end of the structure, 0 to"):
        eigenfunctions(modes, length=1.6, ends=held)
    with pytest.raises(ValueError, match="all sensors are at ends that hold the value at zero; add one between"):
        eigenfunctions(SampledModes([1.0], [0.0], [[0.1], [0.5]], [0.0, 2.0]), length=2.0, ends=held)
    with pytest.raises(ValueError, match=r"mass_per_length is -1 at x = 1\.\d+; it must be 0 or more"):
        eigenfunctions(modes, length=2.0, degree=1, mass_per_length=lambda x: np.where(x < 1.0, 1.0, -1.0))
    with pytest.raises(ValueError, match="two sensors are at"):
        eigenfunctions(SampledModes([1.0], [0.0], [[1.0], [0.5]], [0.5, 0.5]), length=1.0, degree=1)
    with pytest.raises(ValueError, match="has no place"):
        eigenfunctions(SampledModes([1.0], [0.0], [[1.0], [0.5]], [0.5, np.nan]), length=1.0, degree=1)
    with pytest.raises(ValueError, match="shape of mode 2 is zero at all sensors: leave the mode out"):
        eigenfunctions(SampledModes([1.0, 2.0], [0.0, 0.0], [[1.0, 0], [0.5, 0]], [0.5, 0.8]), length=1.0, degree=1)
    with pytest.raises(ValueError, match=r"no boundary condition of a .* is called"):
        BoundaryConditions.of("bar", length=1.0, left="clamped")
    hinged = elastic("beam", "hinged", "hinged", 2)
    impulse_at_node = impulse_response_modes(hinged, at=1.0, positions=np.linspace(0.1, 1.9, 15))
    with pytest.raises(ValueError, match="hardly excites mode 2"):
        eigenfunctions(impulse_at_node, length=2.0, driven_at=1.0, degree=5)


def test_a_shape_that_is_no_number_is_refused_when_scaled_by_an_impulse_too():
    lost = SampledModes([1.0], [0.0], [[1j], [np.nan], [0.2j]], [0.5, 1.0, 1.5])
    with pytest.raises(ValueError, match="shapes must be finite; of mode 1 sensor 2"):
        eigenfunctions(lost, length=2.0, degree=1, driven_at=0.7)


def test_the_former_name_of_boundary_conditions_warns():
    with pytest.warns(DeprecationWarning, match="BoundaryConditions"):
        from workbench.identification.shapes.eigenfunctions import KnownEnds
    assert KnownEnds is BoundaryConditions
