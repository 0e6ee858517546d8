from dataclasses import replace

import numpy as np
import pytest

from workbench.identification.updating.distributions import Basis
from workbench.identification.updating.sensitivity import LocalLoss, SeriesStructure
from workbench.structure.member import Bar, Beam
from workbench.structure.profile import Profile
from workbench.structure.supports import End, PointMass, PointSpring

LENGTH, ELASTIC = 2.0, np.arange(4)
SENSORS = np.linspace(0.04, 1.95, 12)
D, E = np.array([0.1, 0.2]), np.array([0.1, 0.0, 0.2, -0.1])
LOSS = LocalLoss(share=0.2, centre=0.83, width=0.22)


def mass(x):
    return 1.0 + 0.2 * x


SHARED = {"length": LENGTH, "mass_per_length": mass, "attachments": (PointMass(1.3, 0.1), PointSpring(0.7, 3.0))}
NOMINAL = {
    "beam": Beam(bending_stiffness=3.0, left="clamped", right=End(2.0, 0.5), tension=0.4, **SHARED),
    "free beam": Beam(length=LENGTH, mass_per_length=mass, bending_stiffness=3.0, left="free", right="free"),
    "bar": Bar(axial_stiffness=3.0, left="fixed", right="free", **SHARED),
}


@pytest.fixture(params=NOMINAL)
def series(request):
    basis = Basis.polynomial(2), Basis.splines(4, length=LENGTH)
    return SeriesStructure(NOMINAL[request.param], *basis, SENSORS, 4)


def reference(series, d, e, loss):
    """Frequencies and shapes, their signs as they come, by the structure's own eigensolution."""
    m = Profile(lambda x: mass(x) * (1.0 + series.mass.functions(x) @ d))
    k = Profile(lambda x: 3.0 * (1.0 + series.stiffness.functions(x) @ e), series.stiffness.breaks)
    name = "axial_stiffness" if isinstance(series.nominal, Bar) else "bending_stiffness"
    rigid = 2 if series.nominal.right == End(0.0) and isinstance(series.nominal, Beam) else 0
    built = replace(series.nominal, mass_per_length=m, **{name: loss.of(k, LENGTH)})
    modes = built.modes(rigid + ELASTIC.size).select(slice(rigid, None))
    return modes.omega, modes.phi(SENSORS)


def test_modes_are_those_of_the_structure(series):
    found = series.solve(D, E, LOSS).sensitivity(ELASTIC)
    omega, shapes = reference(series, D, E, LOSS)
    np.testing.assert_allclose(found.omega, omega, rtol=1e-9)
    np.testing.assert_allclose(np.abs(found.shapes), np.abs(shapes), atol=1e-8)


@pytest.mark.parametrize("series", ["beam", "bar"], indirect=True)
def test_derivatives_by_differences_of_the_structure_own_eigensolution(series):
    found = series.solve(D, E, LOSS).sensitivity(ELASTIC)
    at = np.r_[D, E, LOSS.share, LOSS.centre, LOSS.width]
    for j in range(at.size):
        sides = []
        for step in (1e-4, -1e-4):
            p = at + step * (np.arange(at.size) == j)
            omega, shapes = reference(series, p[:2], p[2:6], LocalLoss(*p[6:]))
            sides.append((omega, shapes * np.sign((shapes * found.shapes).sum(axis=0))))
        by_omega, by_shapes = ((plus - minus) / 2e-4 for plus, minus in zip(*sides, strict=True))
        assert np.abs(found.omega_by[:, j] - by_omega).max() < 2e-6 * np.abs(by_omega).max()
        by, close = found.shapes_by[..., j], 1e-6 * np.abs(by_shapes).max()
        beside = (SENSORS > 0.7) & (SENSORS < 1.3) if j >= at.size - 2 else np.zeros(SENSORS.size, bool)
        assert np.abs(by - by_shapes)[~beside].max() < close
        # a kink that travels with an edge, between the nodes next to it, is only followed by the sum of smooth modes
        assert np.abs(by - by_shapes).max() < 0.25 * np.abs(by_shapes).max()


def test_a_stiffness_below_zero_is_no_structure(series):
    assert series.solve(D, E - 3.0) is None
