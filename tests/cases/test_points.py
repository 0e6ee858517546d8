"""Cases on plates and at named points: what is read is what stands there, and what is wrong is refused by name."""

import numpy as np
import pytest

from workbench.cases.case import read_case
from workbench.cases.points import read_points, write_points
from workbench.cases.tables import CaseError
from workbench.structure.domain import NamedPoints, Rectangle

PORTS = """
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
""" + PORTS.format("at = [0.3, 0.2]", "at = [0.5, 0.4]")
FRAME = """[structure]
kind = "modal"
natural_frequencies_hz = [3.0, 7.0]
damping_ratios = [0.01, 0.02]
points = "points.csv"
""" + PORTS.format('point = "a.x"', 'point = "b.y"')
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


def test_named_points_are_read_with_their_shapes(tmp_path):
    rig = read_case(written(tmp_path, FRAME)).rig
    np.testing.assert_array_equal(rig.modes.phi(rig.sensors[0].at), [[1.5, -1.0]])
    points = rig.modes.domain
    assert points.distance("a.x", "b.y") == 5.0 and points.translations("a.x") == ("a.x", "a.y")


def test_points_go_through_a_file_unchanged(tmp_path):
    rng = np.random.default_rng(5)
    points = NamedPoints(("p", "q"), rng.normal(size=(2, 3)), ("x", "rz"), ("n", "n"))
    values = rng.normal(size=(2, 3))
    write_points(tmp_path / "points.csv", points, values)
    back, shapes = read_points(tmp_path / "points.csv", 3)
    np.testing.assert_array_equal(shapes, values)
    np.testing.assert_array_equal(back.positions, points.positions)
    assert (back.names, back.directions, back.nodes) == (points.names, points.directions, points.nodes)
    with pytest.raises(ValueError, match="without positions"):
        write_points(tmp_path / "points.csv", NamedPoints(("p", "q")), values)


@pytest.mark.parametrize(
    ("case", "points", "words"),
    [
        (PLATE.replace("[0.5, 0.4]", "[0.5, 1.4]"), POINTS, r"\(0.5, 1.4\) lies outside the structure"),
        (PLATE.replace("[0.5, 0.4]", "0.5"), POINTS, "at must be a list of 2 numbers; got 0.5"),
        (PLATE.replace("bottom =", "botom ="), POINTS, "did you mean 'bottom'"),
        (PLATE.replace('left = "simply', 'left = "hardly'), POINTS, "hardly supported"),
        (FRAME.replace('"b.y"', '"c.y"'), POINTS, "there is no point 'c.y'; the points are a.x, a.y, b.y"),
        (FRAME.replace("points.csv", "../points.csv"), POINTS, "outside the case folder"),
        (FRAME.replace("points.csv", "others.csv"), POINTS, "there is no such file"),
        (FRAME, POINTS.replace("mode_2", "mode_3"), "column 'mode_2' is missing"),
        (FRAME, POINTS.replace("0.75", "wide"), "line 3, column 'mode_2': expected a finite number; got 'wide'"),
        (FRAME, POINTS.replace("b.y,2", "a.y,2"), "'a.y' twice"),
        (FRAME, POINTS.replace(",y,-0.5", ",north,-0.5"), "a direction is one of x, y, z"),
        (FRAME, POINTS.splitlines()[0] + "\n", "must list 1 to"),
    ],
)
def test_what_is_wrong_is_refused_by_name(tmp_path, case, points, words):
    with pytest.raises(CaseError, match=words):
        read_case(written(tmp_path, case, points))


def test_rigid_modes_have_damping_of_their_own(tmp_path):
    table = FRAME.replace("[3.0, 7.0]", "[0.0, 7.0]").replace("points =", "rigid_damping = [2.5]\npoints =")
    modes = read_case(written(tmp_path, table)).rig.modes
    np.testing.assert_allclose(modes.damping, np.diag([2.5, 2 * 0.02 * 2 * np.pi * 7.0]))
    with pytest.raises(CaseError, match="there are none"):
        read_case(written(tmp_path, FRAME.replace("points =", "rigid_damping = [2.5]\npoints =")))
