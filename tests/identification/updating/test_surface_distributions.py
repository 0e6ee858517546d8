"""Mass and stiffness over a plate from its modes: exact modes give exact fields, and the plate again has the modes."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from workbench.identification.shapes.surface_spline import surface_eigenfunctions, surface_errors
from workbench.identification.updating.surface_distributions import (
    SurfaceBasis,
    check_plate,
    plate_mass_and_stiffness,
)
from workbench.structure.modes import SampledModes
from workbench.structure.plate import Plate

A, B, NU = 1.2, 0.9, 0.3
CANTILEVER = {"left": "clamped", "right": "free", "bottom": "free", "top": "free"}
X, Y = np.meshgrid(np.linspace(0.0, A, 9), np.linspace(0.0, B, 7))


def mass(x, y):
    return 8.0 * (1.0 + 0.25 * x + 0.1 * x * y)


def stiffness(x, y):
    return 170.0 * (1.0 - 0.15 * x + 0.2 * y + 0.05 * x**2)


def basis(n_x, n_y):
    return SurfaceBasis.legendre(n_x, n_y, length=(A, B))


def measured(edges, first):
    plate = Plate(length=(A, B), mass_per_area=mass, bending_stiffness=stiffness, poisson_ratio=NU, edges=edges)
    return plate.modes(first + 6, tolerance=1e-7).select(slice(first, None))


@pytest.mark.parametrize(
    ("edges", "first", "tolerance"),
    [
        ("simply supported", 0, 1e-9),
        ("free", 3, 1e-8),
        pytest.param(CANTILEVER, 0, 2e-5, marks=pytest.mark.slow),  # corners where stresses are singular
    ],
)
def test_exact_modes_of_any_scale_give_exact_fields(edges, first, tolerance):
    modes = measured(edges, first)
    scale = np.array([2.0, -0.5, 3.0, 1.0, 0.1, 5.0])
    unscaled = replace(modes, shapes=lambda at, derivative: modes.shapes(at, derivative) * scale)
    found = plate_mass_and_stiffness(
        unscaled,
        poisson_ratio=NU,
        mass_basis=basis(2, 2),
        stiffness_basis=basis(3, 2),
        known_mass=[((0.3, 0.4), mass(0.3, 0.4))],
    )
    np.testing.assert_allclose(found.mass(X, Y), mass(X, Y), rtol=tolerance)
    np.testing.assert_allclose(found.stiffness(X, Y), stiffness(X, Y), rtol=tolerance)
    np.testing.assert_allclose(found.scales, np.abs(scale), rtol=tolerance)
    check = check_plate(found, unscaled, poisson_ratio=NU, edges=edges, first_mode=first)
    assert check.worst < 1e-4 and check.mac.min() > 1.0 - 1e-8


def test_the_self_check_shows_too_few_terms_and_no_plate_at_all():
    modes = measured("simply supported", 0)
    known = {"poisson_ratio": NU, "known_mass": [((0.6, 0.45), mass(0.6, 0.45))]}
    flat = plate_mass_and_stiffness(modes, mass_basis=basis(1, 1), stiffness_basis=basis(1, 1), **known)
    assert check_plate(flat, modes, poisson_ratio=NU, edges="simply supported").worst > 1e-3
    negative = replace(flat, stiffness=replace(flat.stiffness, coefficients=-flat.stiffness.coefficients))
    refused = check_plate(negative, modes, poisson_ratio=NU, edges="simply supported")
    assert "bending_stiffness must be positive" in refused.refusal and np.isinf(refused.worst)
    with pytest.raises(ValueError, match="edges are given for left, right, bottom, top"):  # no fault of what was found
        check_plate(flat, modes, poisson_ratio=NU, edges={"left": "clamped"})


def test_what_cannot_be_found_is_refused():
    modes = measured("simply supported", 0)
    few = {"poisson_ratio": NU, "mass_basis": basis(2, 1), "stiffness_basis": basis(2, 1)}
    with pytest.raises(ValueError, match="give the mass at one point"):
        plate_mass_and_stiffness(modes, known_mass=[], **few)
    with pytest.raises(ValueError, match="lies outside the structure"):
        plate_mass_and_stiffness(modes, known_mass=[((2.6, 0.4), 8.0)], **few)
    with pytest.raises(ValueError, match=r"a known mass must be positive and finite; got -8 at "):
        plate_mass_and_stiffness(modes, known_mass=[((0.6, 0.4), -8.0)], **few)
    with pytest.raises(ValueError, match=r"Poisson's ratio lies between -1 and 0\.5; got 7"):
        plate_mass_and_stiffness(modes, known_mass=[((0.6, 0.4), 8.0)], **few | {"poisson_ratio": 7})
    with pytest.raises(ValueError, match="one polynomial or more along each side; got 0 along x"):
        basis(0, 1)
    with pytest.raises(ValueError, match="20 terms of mass cannot be found from 16 relations of 6 modes"):
        plate_mass_and_stiffness(modes, known_mass=[((0.6, 0.4), 8.0)], **few | {"mass_basis": basis(5, 4)})
    with pytest.raises(ValueError, match="24 terms of stiffness cannot be found from 21"):
        plate_mass_and_stiffness(modes, known_mass=[((0.6, 0.4), 8.0)], **few | {"stiffness_basis": basis(6, 4)})


def drawn(seed, noise):
    """Five modes of a simply supported plate, in closed form (Navier), with noise at 35 sensors: m = 8, D = 170."""
    rng = np.random.default_rng(seed)
    waves = np.pi * np.array([(1, 1), (2, 1), (1, 2), (3, 1), (2, 2)]) / (A, B)
    omega = (waves**2).sum(axis=1) * np.sqrt(170.0 / 8.0)
    cells = np.array([(i, j) for i in range(1, 8) for j in range(1, 6)])
    places = (cells + np.random.default_rng(0).uniform(-0.2, 0.2, cells.shape)) / (8, 6) * (A, B)
    shapes = np.sin(places[:, :1] * waves[:, 0]) * np.sin(places[:, 1:] * waves[:, 1])
    shapes = shapes + noise * rng.standard_normal(shapes.shape)
    modes = SampledModes(omega * (1.0 + 1e-4 * rng.standard_normal(5)), np.zeros(5), shapes, places)
    variances = (noise / np.abs(shapes).max(axis=0)) ** 2
    where = {"length": (A, B), "edges": "simply supported"}
    covariance = np.diag(np.r_[(1e-4 * omega) ** 2, np.zeros(5)])
    found = SimpleNamespace(modes=modes, covariance=covariance, shape_covariance=variances[:, None, None] * np.eye(35))
    return surface_eigenfunctions(modes, **where), surface_errors(found, **where)


def fields_of(modes, errors):
    return plate_mass_and_stiffness(
        modes,
        poisson_ratio=NU,
        mass_basis=basis(2, 2),
        stiffness_basis=basis(2, 2),
        known_mass=[((0.6, 0.45), 8.0)],
        errors=errors,
    )


@pytest.mark.slow
@pytest.mark.parametrize("draws", [8, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("noise", [1e-3, pytest.param(3e-3, marks=pytest.mark.slow)])
def test_intervals_of_the_stiffness_hold(noise, draws):
    found = [fields_of(*drawn(seed, noise)) for seed in range(draws)]
    score = np.array([(f.stiffness(X, Y) - 170.0) / f.stiffness.std(X, Y) for f in found])
    assert (np.abs(score) < 1.96).mean(axis=0).min() >= 0.9  # at every place
    assert np.sqrt((score**2).mean()) > 0.5  # nor are they much too wide


@pytest.mark.slow
def test_standard_errors_by_noise_alone_are_the_scatter_of_draws():
    modes, errors = drawn(0, 3e-3)
    alone = fields_of(modes, replace(errors, roughness=np.zeros(5)))
    fields = [fields_of(drawn(seed, 3e-3)[0], None) for seed in range(16)]
    scatter = np.std([f.stiffness(X, Y) for f in fields], axis=0)
    assert np.linalg.norm(alone.stiffness.std(X, Y)) == pytest.approx(np.linalg.norm(scatter), rel=0.3)


def test_standard_errors_take_those_of_the_same_modes():
    modes, errors = drawn(0, 1e-3)
    with pytest.raises(ValueError, match=r"where plate_mass_and_stiffness\(errors=...\) is given; a mass has none"):
        fields_of(modes, None).stiffness.std(0.1, 0.1)
    with pytest.raises(ValueError, match="errors are of 4 modes, not of these 5; select the same"):
        fields_of(modes, errors.select(range(4)))
