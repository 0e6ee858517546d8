"""What figures of plates and frames show, read back from the figures themselves."""

import numpy as np
import pytest

from workbench.design.loop.closed_loop import Response
from workbench.design.placement.limits import Limits
from workbench.design.placement.task import placement_task
from workbench.draw.interactive import described
from workbench.draw.placement import plot_surface_placement
from workbench.draw.plot import plot
from workbench.draw.surface import plot_point_modes, plot_surface_modes, plot_surface_motion
from workbench.records.units import Units
from workbench.rig.actuators import piezo_patch
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes
from workbench.structure.plate import Plate

A, B = 1.2, 0.8


def panel():
    plate = Plate(length=(A, B), mass_per_area=1.0, bending_stiffness=1.0, poisson_ratio=0.3, edges="simply supported")
    return plate.modes(4)


def points():
    """Two masses on one vertical line, moving along x together and apart."""
    shapes = np.array([[1.0, 1.0], [1.0, -1.0]])
    domain = NamedPoints(("1x", "2x"), np.array([[0, 1, 0], [0, 2, 0]]), ("x", "x"), ("1", "2"))
    return Modes([1.0, 3.0], np.zeros(2), lambda index, _: shapes[index], domain)


def test_the_nodal_line_stands_where_the_plate_does_not_move():
    axes = plot_surface_modes(panel()).axes[1]  # mode 2 is sin(2 π x / a) sin(π y / b)
    lines = np.vstack([path.vertices for path in axes.collections[-1].get_paths()])
    inside = lines[(np.abs(lines[:, 1] - B / 2) < 0.45 * B) & (np.abs(lines[:, 0] - A / 2) < 0.45 * A)]
    assert inside.shape[0] > 5
    np.testing.assert_allclose(inside[:, 0], A / 2, atol=1e-3 * A)


@pytest.mark.parametrize("size", [None, (0.2, 0.1)], ids=["forces", "patches"])
def test_a_placement_is_drawn_over_the_nodal_lines_of_the_next_mode(size):
    actuator = None if size is None else piezo_patch("P", (0.6, 0.4), length=size)
    task = placement_task(panel(), 2, impulse_at=(0.35, 0.3), weight=0.1, actuator=actuator)  # mode 3 is (1, 2)
    placed = {"here": task.placed([(0.3, 0.2), (0.8, 0.5)], ""), "there": task.placed([(0.3, 0.5), (0.9, 0.3)], "")}
    limits = Limits(effort=1.0, forbidden=(((0.5, 0.1), (0.7, 0.3)),))
    figure = plot_surface_placement(task, placed, limits=limits, impulse_at=(0.35, 0.3))
    figure.draw_without_rendering()
    title, beside = figure.axes[0]._left_title, figure.axes[1].yaxis
    assert not title.get_window_extent().overlaps(beside.get_tightbbox())
    assert title.get_window_extent().y1 <= figure.bbox.y1 and beside.get_label_text().endswith("[J]")
    left, right = figure.axes
    assert "nodal lines of mode 3" in left.get_title("left") and not left.lines[0].get_clip_on()
    assert "forbidden" in [text.get_text() for text in figure.legends[0].get_texts()]
    nodal = next(c for c in left.collections if c.get_linewidths()[0] == 1.4)
    line = np.vstack([path.vertices for path in nodal.get_paths()])
    np.testing.assert_allclose(line[:, 1], B / 2, atol=1e-3)
    assert np.ptp(line[:, 0]) > 0.95 * A
    for drawn, placement in zip(left.lines, placed.values()):
        np.testing.assert_allclose(drawn.get_xydata(), placement.positions)
    boxes = [np.ptp(polygon.get_xy(), axis=0) for polygon in left.patches]
    np.testing.assert_allclose(boxes, [(0.2, 0.2), *([size] * 4 if size else [])])
    heights = [[bar.get_height() for bar in bars] for bars in right.containers]
    np.testing.assert_allclose(heights, [placement.residual_work_by_mode for placement in placed.values()])


def test_a_placement_on_a_plate_is_drawn_in_the_units_of_the_case():
    task = placement_task(panel(), 2, impulse_at=(0.35, 0.3), weight=0.1)
    placed = {"here": task.placed([(0.3, 0.2), (0.8, 0.5)], "")}
    left, right = plot_surface_placement(task, placed, units=Units("mm", "t", "s", "N")).axes
    assert left.get_title("left").startswith("1.2 mm by 0.8 mm\n") and left.get_xlabel() == "x [mm]"
    assert right.get_ylabel() == "spillover work, W_r [N mm]"


def test_sensors_are_drawn_where_they_stand_and_coloured_as_they_read():
    modes, places = panel(), np.array([(0.3, 0.2), (0.9, 0.2)])
    dots = plot_surface_modes(modes, places=places, values=modes.phi(places)).axes[1].collections[-1]
    np.testing.assert_allclose(dots.get_offsets(), places)
    np.testing.assert_allclose(dots.get_array(), modes.phi(places)[:, 1])


def test_motion_has_a_row_a_response_and_a_panel_an_instant():
    modes, time = panel(), np.linspace(0.0, 1.0, 11)
    response = Response(time, np.ones((8, 11)), np.zeros((1, 11)), modes)
    figure = plot_surface_motion({"one": response, "two": response}, [0.0, 0.52, 1.0], impulse_at=(0.2, 0.2))
    titles = [ax.get_title("left") for ax in figure.axes]
    assert titles[:6] == ["0 s", "0.5 s", "1 s"] * 2 and figure.axes[3].get_ylabel() == "two"
    assert figure.axes[3].get_xlabel() == "x [m]" and figure.axes[-1].get_ylabel() == "displacement [m]"
    small = Response(0.01 * time, np.full((8, 11), 1e-6), np.zeros((1, 11)), modes)
    figure = plot_surface_motion({"one": small}, [0.0, 0.0052])
    assert [ax.get_title("left") for ax in figure.axes[:2]] == ["0 s", "5 ms"]
    assert figure.axes[-1].get_ylabel() == "displacement [µm]" and [
        text.get_text() for text in figure.axes[0].texts
    ] == ["y [m]"]


def test_named_points_are_drawn_moved_along_their_directions():
    axes = plot_point_modes(points()).axes[1]
    moved = axes.lines[-1].get_xydata()
    np.testing.assert_allclose(moved[:, 1], [1.0, 2.0])
    np.testing.assert_allclose(moved[0, 0], -moved[1, 0])
    assert abs(moved[0, 0]) > 0.1


def test_a_page_has_a_panel_for_each_mode_alone():
    names = ("a", "b", "c")
    domain = NamedPoints(names, np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1]]), ("x", "z", "x"))
    modes = Modes(np.arange(1.0, 6.0), np.zeros(5), lambda index, _: np.ones((3, 5))[index], domain)
    assert [panel["title"][:6] for panel in described(plot(modes))["panels"]] == [f"mode {r}" for r in range(1, 6)]


def test_points_that_move_up_from_a_plane_are_seen_to():
    """Three sensors on a plate, moving along z: drawn up, from above the front."""
    domain = NamedPoints(("a", "b", "c"), np.array([[0.1, 0.1, 0], [0.5, 0.1, 0], [0.3, 0.4, 0]]), ("z",) * 3)
    modes = Modes([1.0], [0.0], lambda index, _: np.array([[1.0], [0.5], [-1.0]])[index], domain)
    rest, moved = (line.get_xydata() for line in plot(modes).axes[0].lines if line.get_marker() == "o")
    np.testing.assert_allclose(rest, [(0.14, 0.045), (0.54, 0.045), (0.46, 0.18)])
    np.testing.assert_allclose(moved[:, 0], rest[:, 0])
    np.testing.assert_allclose((moved - rest)[:, 1] / (moved - rest)[0, 1], [1.0, 0.5, -1.0])


def test_plot_draws_modes_of_any_domain():
    assert len(plot(panel()).axes) == 4 and len(plot(points()).axes) == 2


def test_what_cannot_be_drawn_is_refused():
    modes = points()
    with pytest.raises(ValueError, match="rectangle"):
        plot_surface_modes(modes)
    bare = Modes([1.0], [0.0], lambda index, _: np.ones((len(index), 1)), NamedPoints(("a", "b")))
    with pytest.raises(ValueError, match="give positions"):
        plot_point_modes(bare)
