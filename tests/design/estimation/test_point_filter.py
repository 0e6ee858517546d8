"""Modal filters at named points: the discrete orthogonality of sines, least squares, and sensors that cannot do it."""

import numpy as np
import pytest

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import point_filter
from workbench.design.estimation.surface_filter import filter_on
from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_loop, close_with
from workbench.design.spillover.comparison import through_sensors
from workbench.rig.actuators import Actuator
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes

N = 11  # points of a simply supported beam of unit mass and length, at equal distances
NAMES = [f"P{i + 1}" for i in range(N)]


def modes(n=6):
    r, at = np.arange(1, n + 1), np.arange(1, N + 1) / (N + 1)
    shapes = np.sqrt(2.0) * np.sin(np.pi * np.outer(at, r))
    return Modes((np.pi * r) ** 2, np.full(n, 0.01), lambda index, _: shapes[index], NamedPoints(tuple(NAMES)))


def test_at_equal_distances_the_weights_are_the_shapes_themselves():
    # Σ_i sin(r π i/(N+1)) sin(s π i/(N+1)) = (N+1)/2 δ_rs
    found = point_filter(modes(4), NAMES)
    np.testing.assert_allclose(found.displacement, modes(4).phi(NAMES).T / (N + 1), atol=1e-14)
    assert found.places == NAMES


def test_it_is_the_least_squares_fit_of_noisy_readings():
    rng = np.random.default_rng(5)
    own, at = modes(3), ["P2", "P9", "P4", "P5", "P10"]
    readings = rng.standard_normal((5, 20))
    best, *_ = np.linalg.lstsq(own.phi(at), readings)
    np.testing.assert_allclose(filter_on(None, own, at)(readings), best, rtol=1e-12)


def test_a_law_through_it_leaves_the_controlled_modes_as_they_were_designed():
    law = imsc(modes(), 2, [Actuator("F1", "P3"), Actuator("F2", "P7")], weight=1e-4)
    own = modes().select(law.controlled)
    exact, through = close_loop(modes(2), law), close_loop(modes(2), law, point_filter(own, ["P2", "P6", "P9"]))
    np.testing.assert_allclose(through.matrix, exact.matrix, rtol=1e-11, atol=1e-9)
    whole = point_filter(own, ["P2", "P6", "P9"])  # the same law meets the residual modes too
    np.testing.assert_allclose(
        close_with(modes(), filtered(law, whole)).matrix, close_loop(modes(), law, whole).matrix, atol=1e-9
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
        (["P2", "P6", "P2"], "two of the 3 sensors stand at point P2; move one"),
        (["P4", "P8", "P12"], "no point 'P12'"),
    ],
)
def test_sensors_that_make_no_filter_are_refused(points, words):
    with pytest.raises(ValueError, match=words):
        point_filter(modes(3), points)


def test_modes_that_sensors_cannot_tell_apart_are_named():
    # at quarters of the length sin 3 π x and sin 5 π x are alike but for their sign
    with pytest.raises(ValueError, match=r"P3, P6, P9 cannot tell filtered mode\(s\) 2, 3 from rest or from each"):
        point_filter(modes(5).select([0, 2, 4]), ["P3", "P6", "P9"])
    with pytest.raises(ValueError, match=r"filtered mode\(s\) 2 from rest"):
        point_filter(modes(4).select([0, 3]), ["P3", "P6", "P9"])
