"""Places along an interval, over a rectangle and at named points, and modes known there."""

import numpy as np
import pytest

from workbench.rig.actuators import Actuator
from workbench.rig.elements import LinearSpring
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.rig.statespace import input_matrix, output_matrix
from workbench.structure.domain import Between, Interval, NamedPoints, Rectangle
from workbench.structure.member import Beam
from workbench.structure.modes import Modes, PointShapes, SampledModes
from workbench.structure.modification import attach
from workbench.structure.supports import PointMass, PointSpring

A, B = 1.2, 0.9
NUMBERS = np.array([(1, 1), (2, 1), (1, 2), (2, 2)])


def plate():
    """A simply supported plate of unit mass per area and bending stiffness, in closed form."""
    kx, ky = NUMBERS[:, 0] * np.pi / A, NUMBERS[:, 1] * np.pi / B

    def shapes(xy, derivative):
        turns = (np.sin, np.cos, lambda a: -np.sin(a))
        along = [
            k**i * turns[i](np.outer(x, k))
            for x, k, i in ((xy[:, 0], kx, derivative[0]), (xy[:, 1], ky, derivative[1]))
        ]
        return 2.0 / np.sqrt(A * B) * along[0] * along[1]

    return Modes(omega=kx**2 + ky**2, damping=np.full(4, 0.01), shapes=shapes, domain=Rectangle((A, B)))


def frame(positions=True):
    """Two masses of 2 kg and 3 kg in a row, and the first one's own other direction; springs 5, 7 and 11 N/m."""
    root = np.diag([1 / 2, 1 / 3, 1 / 2]) ** 0.5
    values, vectors = np.linalg.eigh(root @ STIFFNESS @ root)
    shapes = root @ vectors
    points = NamedPoints(
        ("ax", "bx", "ay"),
        np.array([[0, 0, 0], [3, 0, 4], [0, 0, 0]]) if positions else None,
        ("x", "x", "y"),
        ("a", "b", "a"),
    )
    return Modes(np.sqrt(values), np.full(3, 0.01), lambda index, _: shapes[index], points)


def along():
    beam = Beam(length=2.0, mass_per_length=1.0, bending_stiffness=4.0, left="hinged", right="hinged")
    return beam.modes(2)


def of_rig(modes, actuator, sensor):
    rig = Rig(modes, (Actuator("F", actuator),), (Sensor("w", sensor),))
    return simulate(rig, np.ones((1, 20)), sample_time=0.1)


STIFFNESS = np.array([[12.0, -7.0, 0.0], [-7.0, 7.0, 0.0], [0.0, 0.0, 11.0]])


def test_a_slope_about_an_axis_of_a_plate_is_right_handed():
    modes, at = plate(), (0.37, 0.22)
    h = 1e-6
    by_y = (modes.phi((at[0], at[1] + h)) - modes.phi((at[0], at[1] - h))) / (2 * h)
    by_x = (modes.phi((at[0] + h, at[1])) - modes.phi((at[0] - h, at[1]))) / (2 * h)
    np.testing.assert_allclose(modes.phi(at, 1, direction="x"), by_y, rtol=1e-7)
    np.testing.assert_allclose(modes.phi(at, 1, direction="y"), -by_x, rtol=1e-7)
    moment = Actuator("M", at, quantity="moment", direction="y")
    np.testing.assert_allclose(input_matrix(modes, [moment])[:, 0], -by_x[0], rtol=1e-7)
    tilt = Sensor("tilt", at, "slope", direction="x")
    np.testing.assert_allclose(output_matrix(modes, [tilt])[0], by_y[0], rtol=1e-7)


def test_quadrature_over_a_rectangle_makes_the_modes_orthonormal():
    modes = plate()
    xy, weights = modes.domain.quadrature(30)
    shapes = modes.phi(xy)
    np.testing.assert_allclose(shapes.T @ (weights[:, None] * shapes), np.eye(4), atol=1e-12)


def test_masses_and_springs_at_named_points_change_the_modes_exactly():
    modes = frame()
    # a mass moves in both directions of its node; a spring between two points pulls them together
    changed = attach(modes, (PointMass("ay", 1.5), PointSpring(Between("ax", "bx"), 4.0)))
    mass = np.diag([3.5, 3.0, 3.5])
    stiffness = STIFFNESS + 4.0 * np.array([[1, -1, 0], [-1, 1, 0], [0, 0, 0]])
    exact = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real))
    np.testing.assert_allclose(changed.omega, exact, rtol=1e-12)
    assert changed.domain is modes.domain and changed.select([0, 2]).domain is modes.domain
    shapes = changed.phi(["ax", "bx", "ay"])
    np.testing.assert_allclose(shapes.T @ mass @ shapes, np.eye(3), atol=1e-12)


def test_an_element_between_two_points_acts_on_both_equal_and_opposite():
    modes = frame()
    inputs = np.zeros((1, 400))
    inputs[0, :5] = 1.0
    actuators, sensors = (Actuator("F", "bx"),), (Sensor("d1", "ax"), Sensor("d2", "bx"))
    with_element = Rig(modes, actuators, sensors, (LinearSpring(Between("ax", "bx"), 4.0),))
    plain = attach(modes, (PointSpring(Between("ax", "bx"), 4.0),))
    # damping stays with the elements' rig as it was, with the changed modes as their ratios are
    still = Rig(Modes(plain.omega, np.zeros(3), plain.shapes, plain.domain), actuators, sensors)
    free = Rig(Modes(modes.omega, np.zeros(3), modes.shapes, modes.domain), actuators, sensors, with_element.elements)
    exact = simulate(still, inputs, sample_time=0.05).outputs
    stepped = simulate(free, inputs, sample_time=0.05, substeps=32).outputs
    np.testing.assert_allclose(stepped, exact, atol=2e-5 * np.abs(exact).max())


def test_sizes_separations_and_texts():
    assert Rectangle((3.0, 4.0)).size == pytest.approx(5.0)
    points = frame().domain
    assert points.size == pytest.approx(5.0)
    assert points.separation(Between("ax", "bx"), Between("bx", "ax")) == 0.0
    assert list(points.pairs()) == [Between("ax", "bx")]
    assert points.of_node("bx", "x") == "bx" and points.of_node("a", "y") == "ay"
    assert Interval(2.0).text(0.5) == "x = 0.5" and Rectangle((3.0, 4.0)).text((1.0, 2.0)) == "(x, y) = (1, 2)"
    assert points.text(Between("ax", "bx")) == "between ax and bx"


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda: plate().phi((1.3, 0.2)), r"\(1.3, 0.2\) lies outside the structure, 0 to 1.2 by 0 to 0.9"),
        (lambda: plate().phi(0.3), "a pair"),
        (lambda: plate().phi((0.3, 0.2), 1), "about an axis"),
        (lambda: plate().phi((0.3, 0.2), direction="x"), "normal"),
        (lambda: frame().phi("cx"), "no point 'cx'; the points are ax, bx, ay"),
        (lambda: frame().phi("bz"), "no point 'bz'; node 'b' has bx: give one of these"),
        (lambda: frame().phi("bx", direction="y"), "no direction 'y'; it has x"),
        (lambda: frame().phi("bx", 1), "no slopes"),
        (lambda: frame(positions=False).domain.size, "positions of the named points are not known"),
        (lambda: NamedPoints(("a", "b", "a")), "'a' twice"),
        (lambda: Interval(0.0), "must be positive"),
        (lambda: Rectangle((1.0, -2.0)), "must be positive"),
        (lambda: plate().phi((0.1, 0.2), 2), "a derivative on a plate is 0, 1, or a pair of orders .*; got 2"),
        (lambda: input_matrix(plate(), [Actuator("F", (0.0, 0.3))]), "is on the support"),
        (lambda: of_rig(plate(), (1.3, 0.2), (0.3, 0.2)), r"actuator F: \(x, y\) = \(1.3, 0.2\) lies outside"),
        (
            lambda: of_rig(plate(), (0.3, 0.2), (0.3, 1.2)),
            r"sensor w: \(x, y\) = \(0.3, 1.2\) lies .* give a place on it",
        ),
        (lambda: of_rig(frame(), "cx", "ax"), "actuator F: there is no point 'cx'; .*: give one of these"),
        (
            lambda: of_rig(along(), (0.3, 0.2), 0.5),
            r"actuator F: a place along an interval is a position x in m; got \(0.3",
        ),
        (lambda: of_rig(along(), 0.3, (0.3, 0.2)), "sensor w: a place along an interval is a position x"),
        (lambda: along().phi_at((0.3, 0.2)), "a place along an interval is a position x"),
        (lambda: input_matrix(along(), [Actuator("F", (0.3, 0.2))]), "actuator F: a place along an interval"),
        (lambda: Actuator("F", object()), "a place is a position x, a pair"),
        (lambda: PointSpring([1, 2, 3], 4.0), "a place is a position x, a pair"),
    ],
)
def test_a_place_that_is_not_there_is_refused(ask, message):
    with pytest.raises(ValueError, match=message):
        ask()


def test_the_former_name_of_the_domain_is_still_understood():
    with pytest.warns(DeprecationWarning, match="domain"):
        modes = Modes(omega=[1.0], damping=[0.0], shapes=lambda x, _: np.ones((x.size, 1)), length=2.0)
    assert modes.domain == Interval(2.0) and modes.length == 2.0
    with pytest.raises(AttributeError, match="interval"):
        _ = plate().length


def test_modes_are_selected_by_a_mask():
    """It was taken for the indices 0 and 1."""
    kept = np.array([False, False, True])
    modes = Modes([1.0, 2.0, 3.0], [0.1, 0.2, 0.3], PointShapes(np.eye(3)), NamedPoints(("a", "b", "c")))
    sampled = SampledModes([1.0, 2.0, 3.0], [0.1, 0.2, 0.3], np.eye(3), np.arange(3.0))
    for some in (modes.select(kept), sampled.select(kept), sampled.select([False, False, True])):
        assert (some.omega.tolist(), some.zeta.tolist()) == ([3.0], pytest.approx([0.3]))
