"""Cases on plates and at named points: what is read is what stands there, and what is wrong is refused by name."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.cases.case import Case, read_case
from workbench.cases.points import read_points, write_points
from workbench.cases.tables import CaseError
from workbench.cases.writing import write_case
from workbench.rig.actuators import Actuator, piezo_patch
from workbench.rig.elements import LinearSpring
from workbench.rig.rig import Rig, shape_of
from workbench.rig.sensors import Sensor
from workbench.rig.statespace import input_matrix
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import Between, NamedPoints, Rectangle
from workbench.structure.member import Beam
from workbench.structure.modes import Modes, PointShapes
from workbench.structure.plate import Plate
from workbench.structure.supports import Edge

TRANSDUCERS = """
[[input]]
name = "F1"
kind = "actuator"
{0}

[[output]]
name = "a1"
quantity = "acceleration"
{1}
noise_std = 0.01

[[record]]
name = "one"
file = "one.npz"
sample_time = 0.01
use = "fit"
"""
PLATE = """[structure]
kind = "plate"
length = [1.2, 0.9]
mass_per_area = 8.0
bending_stiffness = 170.0
poisson_ratio = 0.3
edges = {left = "simply supported", right = "simply supported", bottom = "simply supported", top = "simply supported"}
damping_ratio = 0.01
modes = 4
""" + TRANSDUCERS.format("at = [0.3, 0.2]", "at = [0.5, 0.4]")
FRAME = """[structure]
kind = "modal"
natural_frequencies_hz = [3.0, 7.0]
damping_ratios = [0.01, 0.02]
points = "points.csv"
""" + TRANSDUCERS.format('point = "a.x"', 'point = "b.y"')
POINTS = """name,node,x,y,z,direction,mode_1,mode_2
a.x,1,0,0,0,x,0.5,0.25
a.y,1,0,0,0,y,-0.5,0.75
b.y,2,3,4,0,y,1.5,-1.0
"""


def written(folder, case, points=POINTS):
    (folder / "case.toml").write_text(case, encoding="utf-8")
    (folder / "points.csv").write_text(points, encoding="utf-8")
    t = 0.01 * np.arange(200)
    np.savez(folder / "one.npz", t=t, F1=np.sin(t), a1=np.cos(t))
    return folder


def test_a_plate_is_read_with_its_places(tmp_path):
    rig = read_case(written(tmp_path, PLATE)).rig
    numbers = [(1, 1), (2, 1), (1, 2), (3, 1)]
    exact = [((i / 1.2) ** 2 + (j / 0.9) ** 2) * np.pi**2 * np.sqrt(170.0 / 8.0) for i, j in numbers]
    np.testing.assert_allclose(rig.modes.omega, np.sort(exact), rtol=1e-12)
    assert rig.modes.domain == Rectangle((1.2, 0.9)) and rig.actuators[0].at == (0.3, 0.2)
    assert rig.structure is not None and rig.modes.zeta == pytest.approx([0.01] * 4)


def test_a_patch_is_read_with_its_sides_and_its_axis(tmp_path):
    rig = read_case(written(tmp_path, PLATE.replace("[0.3, 0.2]", '[0.3, 0.2]\npatch = [0.2, 0.1]\naxis = "y"'))).rig
    (patch,) = rig.actuators
    assert patch == piezo_patch("F1", (0.3, 0.2), length=(0.2, 0.1), direction="y")


def test_moments_and_slopes_of_a_plate_have_an_axis(tmp_path):
    table = PLATE.replace("[0.3, 0.2]", '[0.3, 0.2]\nquantity = "moment"\naxis = "y"')
    table = table.replace('"acceleration"', '"slope"').replace("[0.5, 0.4]", '[0.5, 0.4]\naxis = "x"')
    rig = read_case(written(tmp_path, table)).rig
    assert rig.actuators[0] == Actuator("F1", (0.3, 0.2), "moment", direction="y")
    assert rig.sensors[0].direction == "x"
    # the first mode is a multiple of sin(π x / 1.2) sin(π y / 0.9): -∂w/∂x about y, ∂w/∂y about x
    kx, ky = np.pi / 1.2, np.pi / 0.9
    first = rig.modes.phi((0.3, 0.2))[0, 0] / (np.sin(0.3 * kx) * np.sin(0.2 * ky))
    into, out = (shape_of(rig.modes, transducer)[0] for transducer in (*rig.actuators, *rig.sensors))
    assert into == pytest.approx(-first * kx * np.cos(0.3 * kx) * np.sin(0.2 * ky))
    assert out == pytest.approx(first * ky * np.sin(0.5 * kx) * np.cos(0.4 * ky))


def test_points_are_named_by_their_node_and_a_direction_or_an_axis(tmp_path):
    table = FRAME.replace('"a.x"', '"1"\ndirection = "y"').replace('"b.y"', '"a.x"\naxis = "z"')
    points = POINTS + "a.rz,1,0,0,0,rz,2.0,3.0\n"
    rig = read_case(written(tmp_path, table.replace('"acceleration"', '"angular velocity"'), points)).rig
    np.testing.assert_array_equal(shape_of(rig.modes, rig.actuators[0]), [-0.5, 0.75])
    np.testing.assert_array_equal(shape_of(rig.modes, rig.sensors[0]), [2.0, 3.0])
    turned = FRAME.replace('"a.x"', '"a.rz"\nquantity = "moment"')
    rig = read_case(written(tmp_path, turned, points)).rig
    np.testing.assert_array_equal(shape_of(rig.modes, rig.actuators[0]), [2.0, 3.0])


def test_moments_slopes_and_directions_are_written_as_they_were(tmp_path):
    plate = Plate(
        length=(0.6, 0.4),
        mass_per_area=8.1,
        bending_stiffness=170.0,
        poisson_ratio=0.31,
        edges="clamped",
        damping=ModalDamping(0.01),
    )
    rig = Rig(
        plate.modes(3),
        (Actuator("M", (0.2, 0.1), "moment", direction="x"), Actuator("F", (0.3, 0.1), direction="z")),
        (Sensor("s", (0.3, 0.2), "slope", noise_std=0.01, direction="y"),),
        structure=plate,
    )
    read = again(rig, tmp_path / "plate")
    np.testing.assert_allclose(input_matrix(read.modes, read.actuators), input_matrix(rig.modes, rig.actuators))
    assert read.sensors == rig.sensors and read.actuators[0] == rig.actuators[0]

    points = NamedPoints(("p", "q"), np.eye(3)[:2], ("x", "rz"), ("n", "n"))
    modes = Modes([20.0, 31.0], [0.01, 0.01], PointShapes([[1.0, 2.0], [3.0, 4.0]]), points)
    transducers = (Actuator("M", "p", "moment", direction="z"), Actuator("F", "q", direction="x"))
    frame = Rig(modes, transducers, (Sensor("s", "q", "slope", noise_std=0.01),))
    read = again(frame, tmp_path / "frame")
    assert read.actuators == frame.actuators and read.sensors == frame.sensors

    beam = Beam(
        length=2.0, mass_per_length=1.0, bending_stiffness=4.0, left="clamped", right="free",
        damping=ModalDamping(0.01),
    )  # fmt: skip
    bent = Rig(
        beam.modes(3), (Actuator("M", 1.2, "moment"),), (Sensor("s", 1.7, "slope", noise_std=0.01),), structure=beam
    )
    assert again(bent, tmp_path / "beam").actuators == bent.actuators


def test_named_points_are_read_with_their_shapes(tmp_path):
    rig = read_case(written(tmp_path, FRAME)).rig
    np.testing.assert_array_equal(rig.modes.phi(rig.sensors[0].at), [[1.5, -1.0]])
    points = rig.modes.domain
    assert np.ptp(points.positions, axis=0).tolist() == [3.0, 4.0, 0.0] and points.translations("a.x") == ("a.x", "a.y")


def again(rig, folder):
    """The rig after it was written and read: one record of noise beside it."""
    n = len(rig.sensors)
    noise = np.random.default_rng(2).standard_normal((n + len(rig.actuators), 400))
    record = rig.record(noise[n:], noise[:n], sample_time=0.01, name="r")
    return read_case(write_case(Case("c", rig, (record,), ()), folder).parent).rig


def test_a_written_plate_is_read_as_it_was(tmp_path):
    edges = {"left": "clamped", "right": "free", "bottom": "simply supported", "top": "guided"}
    plate = Plate(
        length=(0.6, 0.4),
        mass_per_area=8.1,
        bending_stiffness=170.0,
        poisson_ratio=0.31,
        edges=edges,
        damping=ModalDamping(0.01),
    )
    rig = Rig(
        plate.modes(3),
        (
            Actuator("F", (0.5, 0.1)),
            Actuator("tap", (0.2, 0.3), direct=True),
            piezo_patch("P", (0.3, 0.1), length=(0.2, 0.1)),
            piezo_patch("M", (0.4, 0.3), length=(0.1, 0.1), direction="x"),
        ),
        (Sensor("a", (0.3, 0.2), "acceleration", noise_std=0.01),),
        structure=plate,
    )
    read = again(rig, tmp_path)
    np.testing.assert_allclose(read.modes.omega, rig.modes.omega, rtol=1e-12)
    np.testing.assert_allclose(read.modes.damping, rig.modes.damping, rtol=1e-12)
    assert read.actuators == rig.actuators and read.sensors == rig.sensors
    assert read.structure.edges == plate.edges and read.structure.poisson_ratio == 0.31
    for change, words in (
        ({"bending_stiffness": lambda x, y: 170.0 + x}, "varies over the plate"),
        ({"tension": 5.0}, "no tension of a plate"),
        ({"edges": {**edges, "left": Edge(0.0, 5.0)}}, "no name for"),
    ):
        with pytest.raises(ValueError, match=words):
            again(replace(rig, structure=replace(plate, **change)), tmp_path / "no")


def test_a_written_beam_with_a_patch_is_read_as_it_was(tmp_path):
    beam = Beam(
        length=2.0, mass_per_length=1.0, bending_stiffness=4.0, left="clamped", right="free",
        damping=ModalDamping(0.01),
    )  # fmt: skip
    sensors = (Sensor("a", 1.7, "acceleration", noise_std=0.01),)
    rig = Rig(beam.modes(4), (piezo_patch("P", 0.3, length=0.2),), sensors, structure=beam)
    read = again(rig, tmp_path)
    np.testing.assert_allclose(input_matrix(read.modes, read.actuators), input_matrix(rig.modes, rig.actuators))
    assert read.actuators[0].quantity == "moment"


@pytest.mark.parametrize("known", [True, False], ids=["positions known", "not known"])
def test_a_written_frame_is_read_as_it_was(tmp_path, known):
    rng = np.random.default_rng(3)
    positions = rng.normal(size=(2, 3)) if known else None
    points = NamedPoints(("p", "q"), positions, ("x", "") if known else ())
    shapes = PointShapes(rng.normal(size=(2, 3)))
    modes = Modes([0.0, 20.0, 31.0], np.diag([0.3, 0.4, 0.5]), shapes, points)
    rig = Rig(modes, (Actuator("F", "p"),), (Sensor("v", "q", "velocity", noise_std=0.01),))
    read = again(rig, tmp_path)
    np.testing.assert_allclose(read.modes.omega, modes.omega, rtol=1e-14)
    np.testing.assert_allclose(read.modes.damping, modes.damping, rtol=1e-14)
    np.testing.assert_array_equal(read.modes.phi(read.sensors[0].at), modes.phi("q"))
    np.testing.assert_array_equal(read.modes.phi(read.actuators[0].at), modes.phi("p"))
    assert (read.sensors, read.actuators) == (rig.sensors, rig.actuators)
    assert read.modes.domain.names == ("p", "q") and read.modes.domain.directions == points.directions
    assert (read.modes.domain.positions is not None) is known


def test_what_a_case_of_points_cannot_say_is_refused(tmp_path):
    points = NamedPoints(("p", "q"))
    modes = Modes([20.0, 31.0], [0.01, 0.01], PointShapes([[1.0, 2.0], [3.0, 4.0]]), points)
    rig = Rig(modes, (Actuator("F", "p"),), (Sensor("v", "q", noise_std=0.01),))
    for wrong, words in (
        (replace(rig, modes=replace(modes, damping=[[1.0, 0.5], [0.5, 1.0]])), "couples modes"),
        (replace(rig, actuators=(Actuator("F", Between("p", "q")),)), "two places"),
        (replace(rig, actuators=(Actuator("F", "p", delay=0.1),)), "'F' has delay"),
        (replace(rig, elements=(LinearSpring("p", 1.0),)), "no elements"),
    ):
        with pytest.raises(ValueError, match=words):
            again(wrong, tmp_path)


def test_points_go_through_a_file_unchanged(tmp_path):
    rng = np.random.default_rng(5)
    points = NamedPoints(("p", "q"), rng.normal(size=(2, 3)), ("x", "rz"), ("n", "n"))
    values = rng.normal(size=(2, 3))
    write_points(tmp_path / "points.csv", points, values)
    back, shapes = read_points(tmp_path / "points.csv", 3)
    np.testing.assert_array_equal(shapes, values)
    np.testing.assert_array_equal(back.positions, points.positions)
    assert (back.names, back.directions, back.nodes) == (points.names, points.directions, points.nodes)
    write_points(tmp_path / "points.csv", NamedPoints(("p", "q")), values)
    assert read_points(tmp_path / "points.csv", 3)[0].positions is None


@pytest.mark.parametrize(
    ("case", "points", "words"),
    [
        (PLATE.replace("[0.5, 0.4]", "[0.5, 1.4]"), POINTS, r"'a1': .* \(0.5, 1.4\) lies outside the structure"),
        (PLATE.replace("simply supported", "pinned"), POINTS, "got 'pinned', which is 'simply supported' here$"),
        (PLATE.replace("simply supported", "fixed"), POINTS, "got 'fixed', which is 'clamped' here$"),
        (PLATE.replace("[0.5, 0.4]", "0.5"), POINTS, "at must be a list of 2 numbers; got 0.5"),
        (PLATE.replace("[0.3, 0.2]", "[0.3, 0.2]\npatch = 0.1"), POINTS, "'F1': patch must be a list of 2 numbers"),
        (PLATE.replace("[0.3, 0.2]", "[0.05, 0.2]\npatch = [0.2, 0.1]"), POINTS, "'F1': a patch of 0.2 m by 0.1 m at"),
        (PLATE.replace("[0.3, 0.2]", "[0.3, 0.2]\npatch = [0.2, 0.1]\naxis = 1"), POINTS, "axis is x or y"),
        (PLATE.replace("[0.3, 0.2]", '[0.3, 0.2]\naxis = "x"'), POINTS, "'F1': a force .* has no axis; give direction"),
        (PLATE.replace('"acceleration"', '"slope"'), POINTS, "'a1': a slope or moment on a plate is about an axis"),
        (PLATE.replace("[0.3, 0.2]", '[0.3, 0.2]\nquantity = "moment"\naxis = "z"'), POINTS, "direction 'x' or 'y'"),
        (PLATE.replace("[0.3, 0.2]", '[0.3, 0.2]\nquantity = "torque"'), POINTS, "quantity is force or moment"),
        (PLATE.replace("[0.3, 0.2]", '[0.3, 0.2]\ndirection = "z"'), POINTS, "no key 'direction'"),
        (PLATE.replace('"actuator"\nat', '"hammer"\nquantity = "moment"\nat'), POINTS, "hammer is a measured force"),
        (FRAME.replace('"a.x"', '"a.x"\ndirection = "z"'), POINTS, "point 'a.x' has no direction 'z'; it has x, y"),
        (FRAME.replace('"b.y"', '"b.y"\naxis = "z"'), POINTS, "'a1': a force or displacement.* has no axis"),
        (FRAME.replace('"acceleration"', '"slope"'), POINTS, "'b.y' is no rotation: give a point of direction rx"),
        (
            PLATE.replace('"actuator"\nat', '"hammer"\npatch = [0.2, 0.1]\nat'),
            POINTS,
            "a patch is actuator, not hammer",
        ),
        (FRAME.replace('"a.x"', '"a.x"\npatch = [0.2, 0.1]'), POINTS, "no key 'patch'"),
        (PLATE.replace("bottom =", "botom ="), POINTS, "did you mean 'bottom'"),
        (PLATE.replace('left = "simply', 'left = "hardly'), POINTS, "hardly supported"),
        (FRAME.replace('"b.y"', '"c.y"'), POINTS, "'a1': there is no point 'c.y'; the points are a.x, a.y, b.y"),
        (FRAME.replace("points.csv", "../points.csv"), POINTS, "outside the case folder"),
        (FRAME.replace("points.csv", "others.csv"), POINTS, "there is no such file"),
        (FRAME, POINTS.replace("mode_2", "mode_3"), "column 'mode_2' is missing"),
        (
            FRAME,
            POINTS.replace("a.x,1,0", "a.x,1,"),
            "line 2, column 'x': .*; got ''; give the position of the point, m",
        ),
        (FRAME, POINTS.replace("0.75", "wide"), "line 3, column 'mode_2': expected a finite number; got 'wide'"),
        (FRAME, POINTS.replace("b.y,2", "a.y,2"), "'a.y' twice"),
        (FRAME, POINTS.replace(",y,-0.5", ",north,-0.5"), "a direction is one of x, y, z"),
        (FRAME, POINTS.splitlines()[0] + "\n", "must list 1 to"),
    ],
)
def test_what_is_wrong_is_refused_by_name(tmp_path, case, points, words):
    with pytest.raises(CaseError, match=words):
        read_case(written(tmp_path, case, points))


def test_a_faulty_name_in_the_table_of_points_is_refused_with_its_place_once(tmp_path):
    with pytest.raises(CaseError, match=r"^(?!.*points\.csv.*points\.csv).*points\.csv, line 3: name must be"):
        read_case(written(tmp_path, FRAME, POINTS.replace("a.y,1", ",1")))


def test_rigid_modes_have_damping_of_their_own(tmp_path):
    table = FRAME.replace("[3.0, 7.0]", "[0.0, 7.0]").replace("points =", "rigid_damping = [2.5]\npoints =")
    modes = read_case(written(tmp_path, table)).rig.modes
    np.testing.assert_allclose(modes.damping, np.diag([2.5, 2 * 0.02 * 2 * np.pi * 7.0]))
    with pytest.raises(CaseError, match="there are none"):
        read_case(written(tmp_path, FRAME.replace("points =", "rigid_damping = [2.5]\npoints =")))
