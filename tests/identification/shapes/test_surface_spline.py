"""Eigenfunctions over a rectangle from scattered sensors: exact where a spline is, and within their bands elsewhere."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from workbench.identification.driven import identify_driven
from workbench.identification.shapes.eigenfunctions import eigenfunctions
from workbench.identification.shapes.surface_spline import SurfaceSpline, surface_bands, surface_eigenfunctions
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import Rectangle, place_array
from workbench.structure.modes import SampledModes
from workbench.structure.plate import Plate

LENGTH = (1.2, 0.9)
NOISE = 1e-3
EDGES = dict.fromkeys(("left", "right", "bottom", "top"), "simply supported")
GRID = np.stack(np.meshgrid(np.linspace(0, 1.2, 9), np.linspace(0, 0.9, 8), indexing="ij"), -1).reshape(-1, 2)


def scattered(n):
    """Places (n, 2) of sensors, one in each of n cells of a 7 by 6 grid."""
    rng = np.random.default_rng(3)
    cells = rng.permutation([(i, j) for i in range(7) for j in range(6)])[:n]
    return (cells + 0.5 + 0.3 * rng.uniform(-1.0, 1.0, (n, 2))) / (7, 6) * LENGTH


def mass(x, y):
    return 8.0 * (1.0 + 0.3 * x)


@pytest.fixture(scope="module")
def plate():
    return Plate(length=LENGTH, mass_per_area=mass, bending_stiffness=170.0, poisson_ratio=0.3, edges=EDGES).modes(5)


def sampled(modes, places, rng):
    shapes = modes.phi(places)
    shapes = shapes / np.abs(shapes).max(axis=0) + NOISE * rng.standard_normal(shapes.shape)
    return SampledModes(modes.omega, modes.zeta, shapes, places)


def test_a_cubic_is_taken_exactly_with_its_derivatives():
    def cubic(x, y):
        return 1.0 - 2.0 * x + 0.5 * x * y**2 + y**3 - x**2

    places = scattered(20)
    spline = SurfaceSpline(Rectangle(LENGTH), places)
    x, y = GRID.T
    values = cubic(*places.T)
    np.testing.assert_allclose(spline.matrix(GRID) @ values, cubic(x, y), atol=1e-9)
    np.testing.assert_allclose(spline.matrix(GRID, (0, 2)) @ values, x + 6.0 * y, atol=1e-6)
    np.testing.assert_allclose(spline.matrix(GRID, (1, 1)) @ values, y, atol=1e-6)
    # at a sensor nothing is missed, and away from all of them something is
    np.testing.assert_allclose(np.diag(spline.error(places)), 0.0, atol=1e-9)
    assert spline.error(GRID).trace() > 0
    assert spline.roughness(values, 1e-6 * np.eye(20)) == 0.0


def test_derivatives_are_those_of_the_spline():
    spline = SurfaceSpline(Rectangle(LENGTH), scattered(24), {"left": "clamped"})
    values = np.random.default_rng(1).standard_normal(24)
    at, h = np.array([[0.41, 0.33], [0.87, 0.6]]), 1e-4

    def value(offset, derivative=(0, 0)):
        return spline.matrix(at + offset, derivative) @ values

    x, y = np.array([h, 0.0]), np.array([0.0, h])
    np.testing.assert_allclose(value(0 * x, (1, 0)), (value(x) - value(-x)) / (2 * h), rtol=1e-5)
    np.testing.assert_allclose(
        value(0 * x, (1, 1)), (value(y, (1, 0)) - value(-y, (1, 0))) / (2 * h), rtol=1e-5, atol=1e-5
    )
    np.testing.assert_allclose(value(0 * x, (2, 0)), (value(x, (1, 0)) - value(-x, (1, 0))) / (2 * h), rtol=1e-5)


def test_held_edges_are_held(plate):
    places = scattered(24)
    edges = {"left": "clamped", "top": "simply supported"}
    spline = SurfaceSpline(Rectangle(LENGTH), places, edges)
    values = plate.phi(places)
    along = np.column_stack([np.zeros(11), (np.arange(11) + 0.5) / 11 * 0.9])
    np.testing.assert_allclose(spline.matrix(along) @ values, 0.0, atol=1e-8)
    np.testing.assert_allclose(spline.matrix(along, (1, 0)) @ values, 0.0, atol=1e-7)


@pytest.mark.parametrize("edges", ["simply supported", "clamped"])
@pytest.mark.parametrize("at", [(0.0, 0.45), (1.2, 0.5), (0.6, 0.9), (0.0, 0.0)])
def test_a_sensor_on_an_edge_that_is_held_changes_nothing(edges, at):
    """Such as one in its middle, where a condition of the edge stands too: the same value twice."""
    places, values = scattered(24), np.random.default_rng(2).standard_normal(24)
    inside = SurfaceSpline(Rectangle(LENGTH), places, edges)
    spline = SurfaceSpline(Rectangle(LENGTH), np.vstack([places, at]), edges)
    with_noise = np.r_[values, 0.01]
    np.testing.assert_array_equal(spline.matrix(GRID) @ with_noise, inside.matrix(GRID) @ values)
    np.testing.assert_array_equal(spline.error(GRID), inside.error(GRID))
    assert spline.roughness(with_noise, 1e-6 * np.eye(25)) == inside.roughness(values, 1e-6 * np.eye(24))
    with pytest.raises(ValueError, match="5 sensors and the edges do not determine a cubic"):
        SurfaceSpline(Rectangle(LENGTH), np.vstack([places[:5], (0.0, 0.45)]), {"left": "simply supported"})


def test_bands_hold_the_true_shapes(plate):
    """By point and as a whole, nearly all of the true surface."""
    places, rng = scattered(30), np.random.default_rng(8)
    exact, covariance = plate.phi(GRID), np.broadcast_to(NOISE**2 * np.eye(30), (5, 30, 30))
    inside = whole = 0
    draws = 2
    where = {"length": LENGTH, "mass_per_area": mass, "edges": EDGES}
    for _ in range(draws):
        found = sampled(plate, places, rng)
        bands = surface_bands(SimpleNamespace(modes=found, shape_covariance=covariance), GRID, **where)
        shapes = surface_eigenfunctions(found, **where).phi(GRID)
        np.testing.assert_allclose(shapes, bands.phi, atol=1e-9)
        signed = exact * np.sign((exact * bands.phi).sum(axis=0))
        assert np.abs(bands.phi - signed).max() < 0.05 * np.abs(exact).max()
        low, high = bands.pointwise
        inside += ((signed >= low - 1e-9) & (signed <= high + 1e-9)).mean() / draws
        low, high = bands.whole
        whole += ((signed >= low - 1e-9) & (signed <= high + 1e-9)).all(axis=0).mean() / draws
    assert inside > 0.95 and whole > 0.85
    # and they are of use: narrower than a tenth of the shape
    assert (bands.std.max(axis=0) < 0.1 * np.abs(exact).max(axis=0)).all()


def test_what_cannot_be_drawn_is_refused(plate):
    with pytest.raises(ValueError, match="do not determine a cubic"):
        SurfaceSpline(Rectangle(LENGTH), scattered(8))
    with pytest.raises(ValueError, match="10 sensors determine a cubic over the rectangle and nothing beyond"):
        SurfaceSpline(Rectangle(LENGTH), scattered(10)).roughness(np.ones(10), np.eye(10))
    places = scattered(20)
    with pytest.raises(ValueError, match="sensors 1 and 20 are at one place"):
        SurfaceSpline(Rectangle(LENGTH), np.vstack([places[:19], places[:1]]))
    with pytest.raises(ValueError, match="got middle 'clamped'"):
        SurfaceSpline(Rectangle(LENGTH), places, {"middle": "clamped"})
    found = sampled(plate, places, np.random.default_rng(0))
    unknown = np.where(np.arange(20)[:, None] == 7, np.nan, places)
    for positions, words in (
        (unknown, "sensor 8 has no place; give its channel `at`"),
        (places[:, 0], r"take sensors with places \(x, y\)"),
        (place_array([f"P{i}" for i in range(20)]), r"take sensors with places \(x, y\)"),
    ):
        with pytest.raises(ValueError, match=words):
            surface_eigenfunctions(SampledModes(found.omega, found.zeta, found.shapes, positions), length=LENGTH)
    with pytest.raises(ValueError, match=r"mass_per_area is -2 at \(x, y\) = \(.*\); it must be 0 or more"):
        surface_eigenfunctions(found, length=LENGTH, mass_per_area=-2.0)
    lost = np.where(np.arange(20)[:, None] == 7, np.nan, found.shapes)
    with pytest.raises(ValueError, match=r"shapes must be finite; of mode 1 sensor 8 has .*nan.*: leave it out"):
        surface_eigenfunctions(SampledModes(found.omega, found.zeta, lost, places), length=LENGTH)
    with pytest.raises(ValueError, match="no places along a bar or beam; on a plate take `surface_eigenfunctions`"):
        eigenfunctions(found, length=1.2)


def test_modes_of_a_driven_record_keep_the_places_of_their_sensors_and_the_errors_of_their_shapes():
    """From a record, on, nothing is typed again: places, covariance, eigenfunctions and their bands."""
    panel = Plate(length=LENGTH, mass_per_area=8.0, bending_stiffness=170.0, poisson_ratio=0.3, edges="clamped",
                  damping=ModalDamping(0.01)).modes(2)  # fmt: skip
    rng, places = np.random.default_rng(4), scattered(24)
    sensors = [Sensor(f"a{i}", tuple(place), "velocity") for i, place in enumerate(places)]
    rig = Rig(panel, [Actuator("F", (0.5, 0.3))], sensors)
    record = simulate(rig, rng.standard_normal((1, 600)), sample_time=0.2 / panel.frequencies_hz[-1])
    noise = 0.02 * record.outputs.std() * rng.standard_normal(record.outputs.shape)
    found = identify_driven(replace(record, outputs=record.outputs + noise), at_rest=True)
    np.testing.assert_allclose(found.modes.positions, places)
    assert found.shape_covariance.shape == (2, 24, 24)
    bands = surface_bands(found, GRID, length=LENGTH, mass_per_area=8.0, edges="clamped")
    truth = panel.phi(GRID) * np.sign((panel.phi(GRID) * bands.phi).sum(axis=0))
    low, high = bands.pointwise
    assert ((truth >= low - 1e-9) & (truth <= high + 1e-9)).mean() > 0.9
    assert (bands.std.max(axis=0) < 0.1 * np.abs(truth).max(axis=0)).all()
