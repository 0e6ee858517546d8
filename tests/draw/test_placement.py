"""Placed sensors are drawn where they stand, with the error that each mode adds."""

import numpy as np
import pytest

import workbench as wb
from workbench.design.placement.placement import placement_task
from workbench.draw.placement import plot_member_placement, plot_placement
from workbench.draw.plot import plot
from workbench.records.units import Units
from workbench.structure.member import Beam

A, B = 1.2, 0.8


def drawn_errors(figure):
    bars = [bar for bars in figure.axes[-1].containers for bar in bars]
    return {round(bar.get_x() + bar.get_width() / 2): bar.get_height() for bar in bars}


def test_along_a_beam_sensors_stand_under_the_shapes_of_the_controlled_modes():
    beam = wb.Beam(length=2.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(5)
    squares = beam.omega**-2.0
    placed = wb.place_sensors(beam, [0, 2], 3, 1.0, mean_squares=squares, candidates=np.linspace(0.2, 1.8, 9))
    left, _ = (figure := plot(placed)).axes
    for line, r in zip(left.lines, (1, 3)):
        x, shape = line.get_data()
        np.testing.assert_allclose(np.abs(shape), np.abs(np.sin(r * np.pi * x / 2.0)), atol=1e-4)
    np.testing.assert_allclose(left.lines[-1].get_xdata(), placed.positions)
    assert left.get_xlabel() == "x [m]" and "evenly spaced" in figure.get_suptitle()
    errors = drawn_errors(figure)  # add up to the error of all, as independent ones do
    assert np.linalg.norm(list(errors.values())) == pytest.approx(100 * placed.error) and list(errors) == [
        1,
        3,
        2,
        4,
        5,
    ]


def test_on_a_plate_they_stand_over_the_nodal_lines_of_the_first_mode_left_alone():
    plate = wb.Plate(
        length=(A, B), mass_per_area=1.0, bending_stiffness=1.0, poisson_ratio=0.3, edges="simply supported"
    ).modes(4)
    candidates = [(0.3, 0.2), (0.6, 0.4), (0.9, 0.3), (0.4, 0.6)]
    placed = wb.place_sensors(plate, 2, 2, 1.0, mean_squares=np.ones(4), candidates=candidates)
    left = plot(placed).axes[0]
    np.testing.assert_allclose(left.lines[-1].get_xydata(), placed.positions)
    nodal = next(c for c in left.collections if c.get_linewidths()[0] == 1.4)
    line = np.vstack([path.vertices for path in nodal.get_paths()])  # mode 3 is sin(π x / a) sin(2 π y / b)
    np.testing.assert_allclose(line[:, 1], B / 2, atol=1e-3)
    assert "mode 3" in left.get_title("left") and (left.get_xlabel(), left.get_ylabel()) == ("x [m]", "y [m]")


@pytest.mark.parametrize("positions", [None, [[0, 0, 1], [0, 0, 2], [0, 0, 3]]])
def test_at_named_points_their_names_are_written_where_positions_are_known(positions):
    points = wb.NamedPoints(("S1", "S2", "S3"), positions, ("x",) * 3)
    modes = wb.FiniteElements(np.eye(3), np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]]), nodes=points).modes(3)
    placed = wb.place_sensors(modes, 1, 1, mean_squares=modes.omega**-2.0)
    figure = plot(placed)
    figure.draw_without_rendering()
    assert [text.get_text() for text in figure.axes[0].texts] == ([] if positions is None else placed.places)
    phi = modes.phi(placed.places)[0]  # the shape of least strain energy through one reading, by hand
    read = phi / modes.omega**2 / (phi**2 / modes.omega**2).sum()
    missed = (read[0] * phi - np.eye(3)[0]) ** 2 * modes.omega**-2.0 * modes.omega[0] ** 2
    errors = drawn_errors(figure)
    np.testing.assert_allclose([errors[r] for r in (1, 2, 3)], 100 * np.sqrt(missed), rtol=1e-9)


@pytest.mark.parametrize("units", [Units(), Units("mm", "t", "s", "N")], ids=["SI", "mm"])
def test_numbers_of_a_placement_have_their_units(units):
    modes = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(4)
    task = placement_task(modes, 2, impulse_at=6.3, weight=20.0)
    placed = task.placed([3.0, 7.0], "")
    energy, m = units.named("J"), units.length
    title = plot_placement(placed, units=units).axes[0].get_title("left")
    assert title == f"actuators at 3; 7 {m}: W_R = {placed.residual_work:.3g} {energy}, effort {placed.effort:.3g} N² s"
    left = plot_member_placement(task, {"here": placed}, units=units).axes[0]
    assert f"here: W_R = {placed.residual_work:.2g} {energy}" in left.get_legend_handles_labels()[1]


def test_a_mode_that_no_actuator_drives_is_marked_on_the_logarithmic_axis():
    modes = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(5)
    task = placement_task(modes, 2, impulse_at=6.3, weight=20.0)
    nodes = task.placed([10.0 / 3.0, 20.0 / 3.0], "")  # of mode 3
    right = plot_member_placement(task, {"nodes": nodes}).axes[1]
    assert [(text.get_text(), text.get_position()[0]) for text in right.texts] == [("≈ 0", pytest.approx(3.0))]
