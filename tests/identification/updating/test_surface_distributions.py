"""Mass and stiffness over a plate from its modes: exact modes give exact fields, and the plate again has the modes."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.identification.updating.surface_distributions import (
    SurfaceBasis,
    check_plate,
    plate_mass_and_stiffness,
)
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
    with pytest.raises(ValueError, match=r"a known mass must be positive and finite, kg/m²; got \[-8"):
        plate_mass_and_stiffness(modes, known_mass=[((0.6, 0.4), -8.0)], **few)
    with pytest.raises(ValueError, match=r"Poisson's ratio lies between -1 and 0\.5; got 7"):
        plate_mass_and_stiffness(modes, known_mass=[((0.6, 0.4), 8.0)], **few | {"poisson_ratio": 7})
    with pytest.raises(ValueError, match="one polynomial or more along each side; got 0 along x"):
        basis(0, 1)
    with pytest.raises(ValueError, match="20 terms of mass cannot be found from 16 relations of 6 modes"):
        plate_mass_and_stiffness(modes, known_mass=[((0.6, 0.4), 8.0)], **few | {"mass_basis": basis(5, 4)})
    with pytest.raises(ValueError, match="24 terms of stiffness cannot be found from 21"):
        plate_mass_and_stiffness(modes, known_mass=[((0.6, 0.4), 8.0)], **few | {"stiffness_basis": basis(6, 4)})
