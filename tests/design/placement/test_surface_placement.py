"""Placement over a rectangle and among named points: the best that a finer search finds, proven where it is finite."""

from itertools import combinations

import numpy as np
import pytest

from workbench.design.laws.law import DesignError
from workbench.design.placement import certificate
from workbench.design.placement.certificate import certify
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import place_actuators, placement_task, symbolic_work
from workbench.design.placement.scan import best_of_candidates, scan
from workbench.rig.actuators import Actuator, piezo_patch
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.member import Beam
from workbench.structure.modes import Modes, PointShapes
from workbench.structure.plate import Plate

ZONE = ((0.4, 0.3), (0.8, 0.6))


@pytest.fixture(scope="module")
def task():
    plate = Plate(
        length=(1.2, 0.9), mass_per_area=8.0, bending_stiffness=170.0, poisson_ratio=0.3, edges="simply supported"
    )
    return placement_task(plate.modes(7), 2, impulse_at=(0.4, 0.35), weight=1000.0)


def on_beam(n_points):
    """The first modes of a hinged beam at equally spaced named points, and along its length."""
    modes = Beam(length=4.0, mass_per_length=1.5, bending_stiffness=20.0, left="hinged", right="hinged").modes(6)
    x = np.linspace(0.0, 4.0, n_points + 2)[1:-1]
    positions = np.column_stack([x, np.zeros((n_points, 2))])
    points = NamedPoints(tuple(f"{i}y" for i in range(n_points)), positions, ("y",) * n_points)
    return modes, Modes(modes.omega, modes.damping, PointShapes(modes.phi(x)), points), x


def test_casadi_takes_the_shapes_of_a_plate_and_their_derivatives(task):
    at = np.array([[0.31, 0.22], [0.85, 0.61]])
    function = symbolic_work(task)
    work, effort = (float(value) for value in function(at.ravel())[:2])
    exact = task.placed(at, "")
    assert work == pytest.approx(exact.residual_work, rel=1e-9) and effort == pytest.approx(exact.effort, rel=1e-9)
    slope = np.array(function.jacobian()(at.ravel(), *function(at.ravel()))[0]).ravel()
    for i in range(4):
        step = np.zeros(4)
        step[i] = 1e-5
        above, below = (task.placed((at.ravel() + s * step).reshape(2, 2), "").residual_work for s in (1, -1))
        assert slope[i] == pytest.approx((above - below) / 2e-5, rel=1e-5)


def test_a_plate_is_placed_as_well_as_by_a_fine_grid_and_outside_the_zone(task):
    limits = Limits(effort=0.021, spacing=0.1, edge_distance=0.05, forbidden=(ZONE,))
    best = place_actuators(task, limits, starts=3)
    on_grid, _ = scan(task, limits, n_places=12)
    assert best.residual_work <= on_grid.residual_work and best.effort <= 0.021 * (1 + 1e-5)
    low, high = np.array(ZONE)
    assert not ((best.positions > low + 1e-9) & (best.positions < high - 1e-9)).all(axis=1).any()
    assert (best.positions > 0.05 - 1e-9).all() and (best.positions < np.array([1.15, 0.85]) + 1e-9).all()
    assert best.spacing >= 0.1 - 1e-9

    assert [len(actuator.at) for actuator in best.law.actuators] == [2, 2]


def test_a_zone_up_to_an_edge_leaves_no_place_along_the_edge(task):
    corner = Limits(effort=0.021, forbidden=(((0.7, 0.5), (1.2, 0.9)),)).boxes(task)
    assert sorted(high.tolist() for _, high in corner) == [[0.7, 0.9], [1.2, 0.5]]
    with pytest.raises(DesignError, match="leave no place of"):
        Limits(effort=0.021, forbidden=(((0.0, 0.0), (1.2, 0.9)),)).boxes(task)
    with pytest.raises(DesignError, match=r"forbidden zone \[400.0, 300.0\] to .* lies outside the structure"):
        Limits(effort=0.021, forbidden=(((400.0, 300.0), (800.0, 600.0)),)).boxes(task)


def test_patches_are_placed_as_well_as_by_a_fine_grid_and_lie_on_the_plate(task):
    patch = piezo_patch("P", (0.6, 0.45), length=(0.2, 0.16))
    patches = placement_task(task.modes, 2, impulse_at=(0.4, 0.35), weight=1e4, actuator=patch)
    at = np.array([[0.31, 0.22], [0.85, 0.61]])
    work = float(symbolic_work(patches)(at.ravel())[0])
    assert work == pytest.approx(patches.placed(at, "").residual_work, rel=1e-6)
    limits = Limits(effort=2.0 * patches.placed(at, "").effort, spacing=0.2, forbidden=(ZONE,))
    best = place_actuators(patches, limits, starts=3)
    on_grid, _ = scan(patches, limits, n_places=12)
    assert best.residual_work <= on_grid.residual_work
    assert (best.positions >= (0.1, 0.08)).all() and (best.positions <= (1.1, 0.82)).all()
    clear = np.abs(best.positions - np.mean(ZONE, axis=0)) - 0.5 * np.diff(ZONE, axis=0)
    assert (clear >= np.array((0.1, 0.08)) - 1e-9).any(axis=1).all()  # no patch lies over the zone with any part
    assert {actuator.at[2:] for actuator in best.law.actuators} == {(0.2, 0.16)}


@pytest.mark.slow
def test_a_proof_among_candidates_finds_what_a_search_of_all_finds(task, monkeypatch):
    along = np.linspace(0.1, 0.8, 6)
    candidates = tuple((float(x), float(y)) for x in 1.3 * along for y in along)
    limits = Limits(effort=0.03, spacing=0.2, candidates=candidates)
    best, tried = scan(task, limits)
    assert tried < 630
    monkeypatch.setattr(certificate, "MOST_TRIED", 0)
    proof = certify(task, limits, placement=best, gap=1e-6)
    assert proof.complete and proof.better is None and proof.gap <= 1e-6 + 1e-12
    # each that is worse and keeps the limits is found out
    kept = [task.placed(pair, "") for pair in combinations(candidates, 2)]
    kept = sorted((p for p in kept if limits.satisfied_by(p)), key=lambda p: p.residual_work)
    assert len(kept) > 10 and kept[0].residual_work == pytest.approx(best.residual_work)
    for other in kept[1::40]:
        found_out = certify(task, limits, placement=other, gap=1e-3)
        assert (found_out.better is None) == (other.residual_work < best.residual_work / (1.0 - 1e-3))


def test_named_points_of_a_beam_are_placed_as_along_its_length():
    modes, sampled, x = on_beam(39)
    along = placement_task(modes, 3, impulse_at=1.3, weight=5.0)
    named = placement_task(sampled, 3, impulse_at="12y", weight=5.0)
    assert x[12] == pytest.approx(1.3)
    limits = {"effort": 3.0 * along.placed([1.0, 2.0, 3.0], "").effort, "spacing": 0.3}
    best, _ = scan(along, Limits(candidates=tuple(x), **limits))
    found = place_actuators(named, Limits(**limits))
    assert [float(x[int(name[:-1])]) for name in found.positions] == pytest.approx(list(best.positions))
    assert found.residual_work == pytest.approx(best.residual_work, rel=1e-12)
    assert found.spacing == pytest.approx(best.spacing)
    # too many choices are exchanged one by one, and proven
    exchanged = best_of_candidates(named, Limits(**limits))
    proof = certify(named, Limits(**limits), placement=exchanged, gap=0.01)
    assert proof.complete and proof.better is None


def test_what_has_no_room_or_no_place_is_refused(task):
    with pytest.raises(DesignError, match=r"leave no place of 1\.2 m by 0\.9 m"):
        place_actuators(task, Limits(effort=1.0, forbidden=(((-1.0, -1.0), (2.0, 2.0)),)))
    with pytest.raises(DesignError, match="among candidate places"):
        certify(task, Limits(effort=1.0))
    with pytest.raises(DesignError, match=r"is \(\(x, y\), \(x, y\)\)"):
        place_actuators(task, Limits(forbidden=((0.1, 0.2),)))
    _, sampled, _ = on_beam(5)
    points = NamedPoints(sampled.domain.names)
    nowhere = Modes(sampled.omega, sampled.damping, sampled.shapes, points)
    with pytest.raises(DesignError, match="no spacing can be kept"):
        place_actuators(placement_task(nowhere, 2, impulse_at="1y", weight=1.0), Limits(spacing=0.1))
    with pytest.raises(DesignError, match="no zones or edges"):
        place_actuators(placement_task(sampled, 2, impulse_at="1y", weight=1.0), Limits(edge_distance=0.1))
    with pytest.raises(DesignError, match="acts between two places"):
        placement_task(sampled, 2, impulse_at="1y", weight=1.0, actuator=Actuator("P", Between("1y", "2y")))


def test_patches_that_lie_over_each_other_are_told():
    plate = Plate(
        length=(0.6, 0.4), mass_per_area=5.4, bending_stiffness=50.0, poisson_ratio=0.3, edges="simply supported"
    )
    patch = piezo_patch("P", (0.3, 0.2), length=(0.2, 0.15))
    task = placement_task(plate.modes(4), 2, impulse_at=(0.2, 0.3), weight=0.01, actuator=patch)
    over, beside, above = (
        task.placed(at, "")
        for at in ([(0.198, 0.205), (0.368, 0.075)], [(0.15, 0.2), (0.35, 0.22)], [(0.2, 0.1), (0.3, 0.26)])
    )
    assert over.overlapping and "patches overlap; a spacing of their length" in str(over)
    assert not beside.overlapping and not above.overlapping and "overlap" not in str(beside)
