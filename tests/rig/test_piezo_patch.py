"""Piezo patches: line moments along their edges, against closed forms, quadrature over their area, and a beam."""

import numpy as np
import pytest

from workbench.gap.effects.catalogue import kind_named
from workbench.rig.actuators import Actuator, piezo_patch
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.rig.statespace import input_matrix
from workbench.structure.domain import NamedPoints, Patch
from workbench.structure.member import Beam
from workbench.structure.modes import Modes, PointShapes
from workbench.structure.plate import Plate

A, B, MASS = 1.2, 0.8, 8.0
MIDDLE, SIDES = (0.43, 0.31), (0.2, 0.12)


def plate(edges="simply supported", **options):
    given = {"length": (A, B), "mass_per_area": MASS, "bending_stiffness": 175.0, "poisson_ratio": 0.3}
    return Plate(edges=edges, **(given | options))


def ends(across):
    return MIDDLE[across] - 0.5 * SIDES[across], MIDDLE[across] + 0.5 * SIDES[across]


def test_a_patch_on_a_simply_supported_plate_has_its_closed_form():
    """∫∫ ∇²φ dA of φ = 2 sin(γ x) sin(η y) / √(m a b): Dimitriadis, Fuller & Rogers (1991), equation 36."""
    numbers = [(i, j) for i in range(1, 15) for j in range(1, 15)]
    numbers.sort(key=lambda n: (n[0] / A) ** 2 + (n[1] / B) ** 2)
    gamma, eta = np.pi * np.array(numbers[:40]).T / np.array([[A], [B]])
    (x1, x2), (y1, y2) = ends(0), ends(1)
    both = (np.cos(gamma * x1) - np.cos(gamma * x2)) * (np.cos(eta * y1) - np.cos(eta * y2)) / (gamma * eta)
    along_x, along_y = (-2.0 / np.sqrt(MASS * A * B) * k**2 * both for k in (gamma, eta))
    modes = plate().modes(40)
    for direction, exact in ((None, along_x + along_y), ("y", along_x), ("x", along_y)):
        patch = piezo_patch("P", MIDDLE, length=SIDES, gain=0.3, direction=direction)
        np.testing.assert_allclose(input_matrix(modes, [patch])[:, 0], 0.3 * exact, atol=1e-12 * np.abs(exact).max())


def test_a_patch_on_a_clamped_plate_bends_it_as_its_area_does():
    modes = plate("clamped").modes(5)
    nodes, weights = np.polynomial.legendre.leggauss(24)
    x, y = (m + 0.5 * s * nodes for m, s in zip(MIDDLE, SIDES))
    at = np.column_stack([np.repeat(x, 24), np.tile(y, 24)])
    area = 0.25 * np.prod(SIDES) * np.outer(weights, weights).ravel()
    exact = area @ (modes.phi(at, (2, 0)) + modes.phi(at, (0, 2)))
    np.testing.assert_allclose(modes.edge_slopes([(*MIDDLE, *SIDES)])[0], exact, atol=1e-9 * np.abs(exact).max())


def test_a_patch_across_a_plate_that_bends_one_way_is_one_on_a_beam():
    edges = {"left": "simply supported", "right": "simply supported", "bottom": "guided", "top": "guided"}
    surface = plate(edges, poisson_ratio=0.0, length=(A, 0.1)).modes(3, tolerance=1e-8)
    beam = Beam(length=A, mass_per_length=0.1 * MASS, bending_stiffness=17.5, left="hinged", right="hinged").modes(3)
    across = piezo_patch("P", (0.37, 0.05), length=(0.3, 0.1))
    along = piezo_patch("P", 0.37, length=0.3, gain=0.1)  # its moment is that of 0.1 m of line
    ours, theirs = (np.abs(input_matrix(m, [p])) for m, p in ((surface, across), (beam, along)))
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)


def test_a_patch_drives_a_simulation_as_its_modal_forces_do():
    modes = plate().modes(6)
    patch, sensors = piezo_patch("P", MIDDLE, length=SIDES), (Sensor("w", (0.7, 0.5)),)
    command = np.random.default_rng(0).normal(size=(1, 300))
    found = simulate(Rig(modes, (patch,), sensors), command, sample_time=1e-3).outputs
    # forces at points that move the modes as much as the patch does
    places = np.random.default_rng(1).uniform((0.1, 0.1), (1.1, 0.7), (6, 2))
    forces = np.linalg.solve(modes.phi(places).T, input_matrix(modes, [patch])[:, 0])
    points = tuple(Actuator(f"F{i}", tuple(at), gain=force) for i, (at, force) in enumerate(zip(places, forces)))
    same = simulate(Rig(modes, points, sensors), np.repeat(command, 6, axis=0), sample_time=1e-3).outputs
    np.testing.assert_allclose(found, same, atol=1e-9 * np.abs(same).max())


@pytest.mark.parametrize("on_plate", [True, False])
def test_a_misplaced_patch_keeps_its_size_and_stays_on_the_structure(on_plate):
    if on_plate:
        rig = Rig(plate().modes(4), (piezo_patch("P", MIDDLE, length=SIDES),), (Sensor("w", (0.7, 0.5)),))
        moved, there = {"x": 0.6, "y": 0.5}, piezo_patch("P", (0.6, 0.5), length=SIDES)
        reach = {"x": (0.1, 1.1), "y": (0.06, 0.74)}
    else:
        beam = Beam(length=2.0, mass_per_length=1.0, bending_stiffness=4.0, left="hinged", right="hinged")
        rig = Rig(beam.modes(4), (piezo_patch("P", 0.7, length=0.2),), (Sensor("w", 0.5),))
        moved, there, reach = {"at": 1.2}, piezo_patch("P", 1.2, length=0.2), {"at": (0.1, 1.9)}
    kind = kind_named("actuator_misplacement")
    assert {p.name: (p.low, p.high) for p in kind.parameters(rig, "P")} == {
        k: pytest.approx(v) for k, v in reach.items()
    }
    found = input_matrix(rig.modes, kind.apply(rig, "P", moved).actuators)
    np.testing.assert_allclose(found, input_matrix(rig.modes, [there]), atol=1e-12)


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda: piezo_patch("P", MIDDLE, length=0.2), r"P: a patch on a plate has two, \(width, height\), m; got 0.2"),
        (lambda: piezo_patch("P", 0.4, length=(0.2, 0.1)), "P: a patch on a beam has one"),
        (lambda: piezo_patch("P", MIDDLE, length=(0.2, 0.0)), r"must be positive, m; got \(0.2, 0.0\)"),
        (lambda: piezo_patch("P", "N1", length=0.2), "its middle is x along a beam"),
        (lambda: Actuator("P", Patch(*MIDDLE, *SIDES)), "give quantity='moment'"),
        (
            lambda: of("P", (1.15, 0.3)),
            r"0.2 m by 0.12 m at \(x, y\) = \(1.15, 0.3\) does not lie on .* 0 to 1.2 by 0 to 0.8",
        ),
        # named the first patch, which is on the plate
        (lambda: plate().modes(2).edge_slopes([(*MIDDLE, *SIDES), (np.nan, 0.3, *SIDES)]), r"\(x, y\) = \(nan, 0.3\)"),
        (lambda: of("P", MIDDLE, direction="z"), "axis 'x' or 'y', or both"),
        (lambda: points().edge_slopes([(*MIDDLE, *SIDES)]), "a patch is placed on a plate"),
        (lambda: plate().modes(2).phi_at(Patch(*MIDDLE, *SIDES)), "not by a force or displacement"),
    ],
)
def test_what_is_no_patch_is_refused(ask, words):
    with pytest.raises(ValueError, match=words):
        ask()


def of(name, at, **options):
    return input_matrix(plate().modes(2), [piezo_patch(name, at, length=SIDES, **options)])


def points():
    return Modes([1.0], [0.0], PointShapes([[1.0]]), NamedPoints(("N1",)))
