"""What a page moves: nets of plates and frames, whose spots move as the modes say."""

import numpy as np
import pytest

from workbench.design.loop.closed_loop import Response
from workbench.draw.motion import SWAY, frame_wireframe, mode_motion, response_motion
from workbench.rig.actuators import Actuator
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.member import Beam
from workbench.structure.modes import Modes, PointShapes, SampledModes
from workbench.structure.plate import Plate


def test_a_plate_is_a_net_that_moves_up_and_down_as_its_modes():
    plate = Plate(length=(2.0, 1.0), mass_per_area=1.0, bending_stiffness=1.0, poisson_ratio=0.3, edges="clamped")
    modes = plate.modes(2)
    shown = mode_motion({"nominal": modes}, actuators=[Actuator("F", (1.0, 0.0))])
    assert shown["unit"] == "Hz" and mode_motion({"nominal": modes}, frequency="1/ms")["unit"] == "1/ms"
    rest, moves = np.array(shown["net"]["rest"]), np.array(shown["tracks"][0]["moves"])
    assert moves.shape == (2, len(rest), 2) and (moves[..., 0] == 0).all()
    # what lies at the front is seen where it is, and the back rises to the right
    assert shown["actuators"] == [{"name": "F", "at": [1.0, 0.0]}]
    assert rest.min(axis=0) == pytest.approx([0.0, 0.0]) and rest.max(axis=0) == pytest.approx([2.4, 0.45])
    # the second mode of a long plate has a node half way along, and the larger sway of each is the same
    half = np.abs(rest[:, 0] - 0.4 * rest[:, 1] / 0.45 - 1.0) < 1e-6
    assert half.any() and np.abs(moves[1, half, 1]).max() < 1e-3 * np.abs(moves[1]).max()
    assert np.abs(moves).max(axis=(1, 2)) == pytest.approx([SWAY * 2.4] * 2, rel=1e-4)


def test_a_plate_moves_as_its_modal_coordinates_say_both_responses_in_one_scale():
    plate = Plate(length=(2.0, 1.0), mass_per_area=1.0, bending_stiffness=1.0, poisson_ratio=0.3, edges="clamped")
    modes, time = plate.modes(3), np.linspace(0.0, 1.0, 21)
    modal = np.random.default_rng(0).normal(size=(6, 21))
    both = {
        "present": Response(time, 2.0 * modal, np.zeros((1, 21)), modes),
        "new": Response(time, modal, np.zeros((1, 21)), modes),
    }
    shown = response_motion(both, actuators=[Actuator("F", (1.0, 0.0))])
    assert shown["unit"] == "s" and response_motion(both, time="ms")["unit"] == "ms"
    present, new = (np.einsum("rij,rt->tij", np.array(t["moves"]), np.array(t["modal"])) for t in shown["tracks"])
    assert np.abs(present).max() == pytest.approx(SWAY * 2.4, rel=1e-3)
    np.testing.assert_allclose(new, 0.5 * present, atol=1e-4)
    middle = int(np.argmin(np.hypot(*(np.array(shown["net"]["rest"]) - [1.2, 0.225]).T)))
    at = np.array(shown["net"]["rest"])[middle]
    place = (at[0] - 0.4 * at[1] / 0.45, at[1] / 0.45)
    up = modes.phi_at(place) @ modal[:3]
    np.testing.assert_allclose(new[:, middle, 1] / np.abs(new[:, middle, 1]).max(), up / np.abs(up).max(), atol=1e-3)


def test_an_actuator_between_two_places_of_a_beam_is_not_marked():
    modes = Beam(length=2.0, mass_per_length=1.0, bending_stiffness=4.0, left="hinged", right="hinged").modes(2)
    shown = mode_motion({"nominal": modes}, actuators=[Actuator("F", 0.3), Actuator("pair", Between(0.5, 1.5))])
    assert shown["actuators"] == [{"name": "F", "at": 0.3}]


def test_a_frame_moves_each_node_in_its_directions_and_closes_its_loop():
    # a square of four nodes, the last without a direction y
    corners = {"a": (0, 0, 0), "b": (1, 0, 0), "c": (1, 1, 0), "d": (0, 1, 0)}
    named = [(n, d) for n in "abc" for d in "xy"] + [("d", "x")]
    points = NamedPoints(
        tuple(f"{n}.{d}" for n, d in named),
        np.array([corners[n] for n, _ in named], float),
        tuple(d for _, d in named),
        tuple(n for n, _ in named),
    )
    shapes = np.array([[0, 0, 0, 0, 1.0, 0.5, 1.0]]).T
    modes = Modes([10.0], [0.01], PointShapes(shapes), points)
    opposite = Modes([11.0], [0.01], PointShapes(-shapes), points)
    shown = mode_motion({"nominal": modes, "corrected": opposite})
    assert sorted(shown["net"]["lines"]) == [[0, 1], [0, 3], [1, 2], [2, 3]]
    moves = np.array(shown["tracks"][0]["moves"])[0]
    np.testing.assert_allclose(moves, SWAY * np.array([[0, 0], [0, 0], [1, 0.5], [1, 0]]), atol=1e-6)
    # two sets of modes move together, whatever the sign of each
    np.testing.assert_allclose(np.array(shown["tracks"][1]["moves"])[0], moves)
    with pytest.raises(ValueError, match="cannot be drawn without positions"):
        mode_motion({"nominal": Modes([10.0], [0.01], PointShapes([[1.0], [2.0]]), NamedPoints(("p", "q")))})


def test_the_feet_of_a_portal_are_not_joined():
    at = np.array([(0, 0, 0), (0, 0, 1), (0, 0, 2), (1, 0, 2), (2, 0, 2), (2, 0, 1), (2, 0, 0)], float)
    portal = NamedPoints(tuple("abcdefg"), at, ("x",) * 7)
    assert sorted(frame_wireframe(portal).lines) == [[i, i + 1] for i in range(6)]


def test_sampled_modes_of_a_plate_move_over_it_each_sensor_with_its_phase():
    places = np.array([(0.2, 0.3), (0.7, 0.3), (0.2, 0.6), (0.7, 0.6), (0.45, 0.45)])
    shapes = np.sin(np.pi * places[:, :1] / 1.0) * np.sin(np.pi * places[:, 1:] / 0.8) * np.array([1.0, -2.0])
    shapes = shapes * np.exp(0.5j * np.pi * np.array([0, 0, 0, 0, 1]))[:, None]  # the last a quarter of a period ahead
    sampled = SampledModes(np.array([10.0, 20.0]), np.array([0.01, 0.02]), shapes, places)
    shown = mode_motion({"identified": sampled})
    rest = np.array(shown["net"]["rest"])
    np.testing.assert_allclose(rest, np.column_stack([places @ [1.0, 0.4], 0.45 * places[:, 1]]), rtol=1e-4)
    joined = {frozenset(ends) for ends in shown["net"]["lines"]}
    assert {frozenset((i, 4)) for i in range(4)} <= joined and frozenset((0, 3)) not in joined
    (track,) = shown["tracks"]
    for r in range(2):
        moved = np.array(track["moves"][r]) + 1j * np.array(track["imaginary"][r])
        assert not moved[:, 0].any()
        largest = np.abs(shapes[:, r]).max()
        np.testing.assert_allclose(moved[:, 1] * largest / (SWAY * np.ptp(rest, axis=0).max()), shapes[:, r], atol=1e-4)
