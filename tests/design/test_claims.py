"""What Chapter 5 of the dissertation claims, and where each claim ends."""

from itertools import combinations

import numpy as np
import pytest

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import displacement_filter, hermite_filter
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.placement.sensor_placement import filter_error, place_sensors
from workbench.design.spillover.spillover import distributed_cost, effort, finite_spillover, modal_cost, spillover
from workbench.rig.actuators import Actuator
from workbench.structure.domain import NamedPoints
from workbench.structure.member import Beam
from workbench.structure.modes import Modes
from workbench.structure.plate import Plate

PLACES = (2.0, 4.0, 6.0, 8.0), (1.5, 3.5, 6.5, 8.5), (1.3, 2.6, 3.9, 5.2)


def modes(n=9):
    return Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(n)


def actuators(places):
    return [Actuator(f"F{i + 1}", x) for i, x in enumerate(places)]


def state(n=9, controlled=4):
    start = impulse_state(modes(n), 6.3)
    start[n + controlled :] = 0.0
    return start


def test_w_c_does_not_depend_on_the_places_with_imsc():
    """(5.27), at any time and not only in the limit."""
    works = [
        finite_spillover(close_loop(modes(), imsc(modes(), 4, actuators(p), weight=20.0)), state(), 7.0).work_by_mode[
            :4
        ]
        for p in PLACES
    ]
    np.testing.assert_allclose(works[1:], [works[0]] * 2, rtol=1e-10)


def test_but_it_does_with_coupled_control_and_the_forces_do_with_either():
    works = [
        finite_spillover(close_loop(modes(), coupled_lqr(modes(), 4, actuators(p), weight=10.0)), state(), 7.0)
        for p in PLACES
    ]
    assert np.ptp([w.controlled_work for w in works]) > 0.01 * abs(works[0].controlled_work)
    # W_C tells nothing of what the actuators must do: crowded on one side they spend hundreds of times the effort
    spent = [effort(modes(), imsc(modes(), 4, actuators(p), weight=20.0), state()) for p in PLACES]
    assert spent[1] < 1.2 * spent[0] and spent[2] > 200 * spent[0]


def test_little_difference_between_placements_holds_for_spread_ones_only():
    """Section 5.8: displacements differ little. Of the controlled modes they do not differ; of the residual, by 10²."""
    time = np.linspace(0.0, 60.0, 7)[1:]
    motions = [
        initial_response(close_loop(modes(), imsc(modes(), 4, actuators(p), weight=20.0)), time, state())
        for p in PLACES
    ]
    for motion in motions[1:]:
        np.testing.assert_allclose(motion.modal[:4], motions[0].modal[:4], atol=1e-12)
    spilled = [spillover(modes(), imsc(modes(), 4, actuators(p), weight=20.0), state()).residual_work for p in PLACES]
    assert spilled[1] < 1.3 * spilled[0] and spilled[2] > 100 * spilled[0]


def test_filters_cure_observation_spillover_at_the_fourth_power():
    """With nine sensors the filter's motion is that of exact coordinates to a few thousandths, not identical."""
    law, time = imsc(modes(), 4, actuators(PLACES[0]), weight=20.0), np.linspace(0.0, 60.0, 121)
    exact = initial_response(close_loop(modes(), law), time, state()).modal[:4]

    def error(count):
        filter_ = hermite_filter(modes(4), np.linspace(0.0, 10.0, count), 1.0)
        return np.abs(initial_response(close_loop(modes(), law, filter_), time, state()).modal[:4] - exact).max()

    errors = np.array([error(k) for k in (9, 17, 33)]) / np.abs(exact).max()
    assert errors[0] < 5e-3 and (np.log2(errors[:-1] / errors[1:]) > 3.5).all()
    # with as many sensors as controlled modes it is no cure
    assert error(4) > 0.05 * np.abs(exact).max()


def test_no_law_beats_distributed_control_on_modal_forces():
    bound = distributed_cost(modes(), 4, state(), 20.0)
    for places in PLACES:
        assert modal_cost(modes(), imsc(modes(), 4, actuators(places), weight=20.0), state(), 20.0) == pytest.approx(
            bound
        )
        assert modal_cost(modes(), coupled_lqr(modes(), 4, actuators(places), weight=10.0), state(), 20.0) >= bound * (
            1 - 1e-9
        )


def test_sensors_of_a_filter_placed():
    found = modes(12)
    squares = 1.0 / np.arange(1, 13) ** 4
    placed = place_sensors(found, 3, 4, 1.0, mean_squares=squares, starts=0)
    assert not placed.exhaustive and placed.error <= placed.evenly_spaced_error
    assert placed.error == pytest.approx(filter_error(found, range(3), placed.positions, 1.0, squares))
    few = np.linspace(1.0, 9.0, 7)
    best = place_sensors(found, 3, 3, 1.0, mean_squares=squares, candidates=few)
    every = [filter_error(found, range(3), [few[0], few[3], x], 1.0, squares) for x in few[4:]]
    assert best.exhaustive and best.error <= min(every)
    with pytest.raises(DesignError, match="8 sensors cannot be at 7"):
        place_sensors(found, 3, 8, 1.0, mean_squares=squares, candidates=few)
    with pytest.warns(DeprecationWarning, match="mass="):
        former = place_sensors(found, 3, 3, mass_per_length=1.0, mean_squares=squares, candidates=few)
    assert former.error == best.error


def test_the_one_sensor_of_the_first_mode_of_a_plate_stands_at_its_centre():
    # among these the centre alone is on the nodal lines of the second and the third mode, which move more
    plate = Plate(
        length=(0.9, 0.6), mass_per_area=8.0, bending_stiffness=60.0, poisson_ratio=0.3, edges="simply supported"
    )
    candidates = [(0.2, 0.1), (0.45, 0.15), (0.45, 0.3), (0.3, 0.3), (0.7, 0.5)]
    squares = [1.0, 100.0, 100.0]
    placed = place_sensors(plate.modes(3), 1, 1, 8.0, mean_squares=squares, candidates=candidates)
    assert placed.places == [(0.45, 0.3)] and placed.exhaustive
    with pytest.raises(DesignError, match=r"no choice of 2 candidate places makes a filter: .* needs the mass"):
        place_sensors(plate.modes(3), 1, 2, mean_squares=squares, candidates=candidates)


def test_sensors_at_named_points_leave_the_least_error_of_all_choices():
    rng = np.random.default_rng(5)
    omega, shapes = np.array([3.0, 8.0, 17.0, 30.0]), rng.standard_normal((7, 4))
    points = NamedPoints(tuple("abcdefg"))
    found = Modes(omega, np.full(4, 0.01), lambda index, _: shapes[index], points)
    squares = omega**-2.0

    def error(choice):  # of the motion of least strain energy through the readings, by Lagrange's multipliers
        seen = shapes[list(choice)]
        spread = seen.T / omega[:, None] ** 2
        off = (spread @ np.linalg.inv(seen @ spread) @ seen - np.eye(4))[:2]
        return np.sqrt((off**2 @ squares).sum() / squares[:2].sum())

    placed = place_sensors(found, 2, 3, mean_squares=squares)
    best = min(combinations(range(7), 3), key=error)
    assert placed.exhaustive and placed.places == ["abcdefg"[i] for i in best]
    assert placed.error == pytest.approx(error(best), rel=1e-9)


def test_a_filter_of_other_modes_than_the_law_controls_is_refused():
    law = imsc(modes(), 2, actuators(PLACES[0][:2]), weight=20.0)
    with pytest.raises(ValueError, match="gives 3 modal coordinates and the law controls 2"):
        filtered(law, displacement_filter(modes().select([0, 1, 2]), [2.0, 4.0, 6.0, 8.0], 1.0))
