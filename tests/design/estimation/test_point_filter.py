"""Modal filters at named points: against splines, least squares and sines, and sensors that cannot do it."""

import pickle

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import filter_on, point_filter
from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_loop, close_with
from workbench.design.spillover.performance import through_sensors
from workbench.rig.actuators import Actuator
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes

N = 11  # points of a simply supported beam of unit mass and length, at equal distances
ALONG = np.arange(1, N + 1) / (N + 1)
NAMES = [f"P{i + 1}" for i in range(N)]


def modes(n=6, points=ALONG):
    r, names = np.arange(1, n + 1), tuple(NAMES[: len(points)])
    shapes = np.sqrt(2.0) * np.sin(np.pi * np.outer(points, r))
    return Modes((np.pi * r) ** 2, np.full(n, 0.01), lambda index, _: shapes[index], NamedPoints(names))


def test_at_equal_distances_the_weights_are_the_shapes_themselves():
    # Σ_i sin(r π i/(N+1)) sin(s π i/(N+1)) = (N+1)/2 δ_rs
    found = point_filter(modes(8), NAMES, [0, 2])
    np.testing.assert_allclose(found.displacement, modes(8).phi(NAMES)[:, [0, 2]].T / (N + 1), atol=1e-14)
    assert found.places == NAMES


def test_more_sensors_than_modes_are_fitted_by_least_squares():
    rng = np.random.default_rng(5)
    own, at = modes(3), ["P2", "P9", "P4", "P5", "P10"]
    readings = rng.standard_normal((5, 20))
    best, *_ = np.linalg.lstsq(own.phi(at), readings)
    np.testing.assert_allclose(filter_on(None, own, range(3), at)(readings), best, rtol=1e-12)


def test_many_modes_make_it_the_spline_that_bends_least():
    # of a simply supported beam that is the cubic spline through the sensors and the supports, w'' = 0 there
    known, at = modes(400, points=np.array([0.15, 0.4, 0.65, 0.8])), ["P1", "P2", "P3", "P4"]
    readings, r = np.array([0.3, 1.0, -0.2, 0.5]), np.arange(1, 4)
    spline = CubicSpline([0.0, 0.15, 0.4, 0.65, 0.8, 1.0], np.r_[0.0, readings, 0.0], bc_type="natural")
    x = (np.arange(20000) + 0.5) / 20000
    expected = np.sqrt(2.0) * np.sin(np.pi * np.outer(r, x)) @ spline(x) / x.size
    np.testing.assert_allclose(point_filter(known, at, range(3))(readings), expected, rtol=1e-5)


def test_rigid_motions_are_seen_exactly():
    # a free bar of which four of its modes are known: it moves as one, turns, and bends in two shapes
    x = np.linspace(-1.0, 1.0, 5)
    shapes = np.column_stack([np.ones(5), x, x**2 - 0.5, x**4 - x**2])
    names = [f"P{i}" for i in range(5)]
    free = Modes([0.0, 0.0, 3.0, 9.0], np.zeros(4), lambda index, _: shapes[index], NamedPoints(tuple(names)))
    seen = point_filter(free, ["P0", "P2", "P3"], [0, 1, 2]).response_to(free)
    np.testing.assert_allclose(seen[:, :2], np.eye(3, 2), atol=1e-6)


def test_a_law_through_it_leaves_the_controlled_modes_as_they_were_designed():
    law = imsc(modes(), 2, [Actuator("F1", "P3"), Actuator("F2", "P7")], weight=1e-4)
    # as many sensors as modes see each of them without the others
    filter_ = point_filter(modes(), [f"P{i}" for i in (1, 3, 4, 6, 8, 11)], law.controlled)
    exact = close_loop(modes(), law)
    np.testing.assert_allclose(close_loop(modes(), law, filter_).matrix, exact.matrix, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(close_with(modes(), filtered(law, filter_)).matrix, exact.matrix, rtol=1e-9, atol=1e-7)


def test_its_design_can_be_repeated_for_other_modes():
    points = [f"P{i}" for i in (1, 3, 4, 6, 8, 11)]
    law = imsc(modes(), 2, [Actuator("F1", "P3"), Actuator("F2", "P7")], weight=1e-4)
    controller, other = filtered(law, point_filter(modes(), points, law.controlled)), modes(4)
    again = controller.designed_by(other, law, controller.sensors)
    np.testing.assert_array_equal(again.D, filtered(law, point_filter(other, points, law.controlled)).D)
    sent = pickle.loads(pickle.dumps(point_filter(modes(), points, law.controlled)))  # to another process
    np.testing.assert_array_equal(
        sent.designed_by(other, law.controlled).displacement, point_filter(other, points, law.controlled).displacement
    )


def test_a_filter_is_tried_where_only_points_are_known():
    law = imsc(modes(), 2, [Actuator("F1", "P3"), Actuator("F2", "P7")], weight=1e-4)
    tried = through_sensors(modes(), [law], ["P2", "P6", "P9"], None)
    names = [controller.name for controller, _, _ in tried]
    assert names == ["IMSC through a modal filter", "IMSC on a Luenberger observer"]


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (["P2", "P6"], "a filter of 3 modes at named points needs at least as many sensors; got 2: add sensors"),
        (["P2", "P6", "P2"], "two of the 3 sensors are at point P2; move one"),
        (["P4", "P8", "P12"], "no point 'P12'"),
    ],
)
def test_sensors_that_make_no_filter_are_refused(points, words):
    with pytest.raises(ValueError, match=words):
        point_filter(modes(3), points, range(3))
    with pytest.raises(ValueError, match=r"modes \[0, 5\] are not all among the 3 modes"):
        point_filter(modes(3), ["P2", "P4"], [0, 5])


def test_modes_that_sensors_cannot_tell_apart_are_named():
    # at quarters of the length sin 3 π x and sin 5 π x are alike but for their sign
    with pytest.raises(ValueError, match=r"P3, P6, P9 cannot distinguish filtered mode\(s\) 3, 5 from rest or"):
        point_filter(modes(5), ["P3", "P6", "P9"], [0, 2, 4])
    with pytest.raises(ValueError, match=r"filtered mode\(s\) 4 from rest"):
        point_filter(modes(5), ["P3", "P6", "P9"], [0, 3])
