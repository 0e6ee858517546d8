"""Bounds of cells by duality: exact at a place, below every placement in a cell that keeps the limit."""

import numpy as np
import pytest

from workbench.design.placement.cell_bounds import SINGULAR, CellBounds, Intervals
from workbench.design.placement.certificate import certify
from workbench.design.placement.dual_bound import dual_bound
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import place_actuators, placement_task
from workbench.design.placement.task import batch_costs
from workbench.structure.member import Beam


@pytest.fixture(scope="module")
def task(hinged_modes):
    modes = hinged_modes(9)
    return placement_task(modes, 4, impulse_at=6.3, weight=20.0)


def bound_of(task, table, cell, half, effort):
    values, vectors = np.linalg.eigh(task.force_gramian)
    tables = (table.value, table.slope, table.curvature, table.most_curvature, table.most_rate)
    root = np.ascontiguousarray((vectors / np.sqrt(values)).T)
    # of the types that a search hands on, so that nothing is compiled twice
    transforms, square = np.array(task.roots, order="C"), np.array(task.force_gramian)
    return dual_bound(cell, half, tables, transforms, square, root, np.sqrt(effort), SINGULAR, np.empty(cell.size))


def hold(found, costs, effort, counts):
    """Hold that no placement that keeps the limit is below the bound of its cell, and count what was shown."""
    kept = costs.effort <= effort
    assert (np.sqrt(costs.work[kept]) >= found * (1 - 1e-9)).all()
    counts["informative"] += 0 < found < np.inf
    counts["refused"] += np.isinf(found)
    counts["kept"] += kept.any()


def drawn(rng, level):
    centres = np.sort(rng.uniform(0.3, 9.7, 4))
    return (centres / 10.0 * 2**level).astype(int) + 2**level - 1


def test_a_cell_of_no_width_is_bounded_by_its_own_work(task):
    table, rng = Intervals.of(task), np.random.default_rng(0)
    for _ in range(50):
        cell = drawn(rng, 8)
        at = batch_costs(task, task.shapes(table.centre[cell][None]))
        if np.isfinite(at.work[0]) and at.condition[0] < 1e4:
            found = bound_of(task, table, cell, np.zeros(4), 1.5 * at.effort[0])
            assert found == pytest.approx(np.sqrt(at.work[0]), rel=1e-6)
            assert np.isinf(bound_of(task, table, cell, np.zeros(4), 0.9 * at.effort[0]))


@pytest.mark.slow
def test_no_placement_that_keeps_the_limit_is_below_the_bound(task):
    table, rng = Intervals.of(task), np.random.default_rng(1)
    counts = {"informative": 0, "refused": 0, "kept": 0}
    for level in (4, 6, 7, 8):
        for _ in range(80):
            cell = drawn(rng, level)
            centre, half = table.centre[cell], table.half[cell]
            ends = np.array(np.meshgrid(*[(-1, 1)] * 4)).reshape(4, 16).T
            places = centre + half * np.vstack([ends, rng.uniform(-1.0, 1.0, (300, 4))])
            costs = batch_costs(task, task.shapes(places))
            # limits that some placements in the cell just keep, and some that none keeps
            effort = np.quantile(costs.effort, 0.05) if rng.random() < 0.7 else 0.3 * costs.effort.min()
            found = bound_of(task, table, cell, half, effort)
            hold(found, costs, effort, counts)
    assert counts["informative"] > 20 and counts["refused"] > 20 and counts["kept"] > 100


def test_a_cell_where_b_is_singular_to_round_off_is_refused(task):
    """Actuators beside a support, in intervals too short to halve: they need a thousand times the effort allowed."""
    table, level = Intervals.of(task), 12
    cell = (np.array([0.9376, 0.9581, 0.9786, 0.9991]) * 2**level).astype(int) + 2**level - 1
    at = batch_costs(task, task.shapes(table.centre[cell][None]))
    assert not at.effort[0] < 1000.0
    assert np.isinf(bound_of(task, table, cell, table.half[cell], 1.0))


def test_bounds_hold_where_two_rigid_modes_take_the_same_force():
    """The forces have two directions for three modes, so that S has no inverse."""
    free = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="free", right="free").modes(8)
    task, rng = placement_task(free, 3, impulse_at=6.3, weight=20.0), np.random.default_rng(0)
    assert np.linalg.eigvalsh(task.force_gramian)[0] < 1e-15 * np.trace(task.force_gramian)
    effort = 1.2 * task.placed([2.5, 5.0, 7.5], "").effort
    bounds, counts = CellBounds(task, Limits(effort=effort)), {"informative": 0, "refused": 0, "kept": 0}
    cells = np.sort(rng.integers(0, 64, (400, 3)), axis=1) + 63
    cells = cells[(np.diff(cells, axis=1) > 0).all(axis=1)]
    for cell, found in zip(cells, bounds(cells)[0], strict=True):
        places = bounds.intervals.centre[cell] + bounds.intervals.half[cell] * rng.uniform(-1.0, 1.0, (200, 3))
        costs = batch_costs(task, task.shapes(places))
        hold(found, costs, effort, counts)
    assert counts["informative"] > 50 and counts["refused"] > 50 and counts["kept"] > 20


@pytest.mark.slow
def test_a_proof_closes_where_actuators_may_stand_beside_a_support(hinged_modes):
    four = placement_task(hinged_modes(10), 4, impulse_at=4.1, weight=0.2)
    even = four.placed(10.0 * np.arange(1, 5) / 5, "")
    proof = certify(four, Limits(effort=even.effort, spacing=0.2), gap=0.05, max_cells=1_000_000, seconds=7200.0)
    assert proof.complete and proof.better is None


@pytest.mark.slow
def test_six_actuators_have_a_bound_above_zero(hinged_modes):
    """After two million cells; by Neumann's series alone six million leave it at zero."""
    modes = hinged_modes(10)
    six = placement_task(modes, 6, impulse_at=6.3, weight=20.0)
    even = six.placed(10.0 * np.arange(1, 7) / 7, "")
    limits = Limits(effort=1.5 * even.effort, spacing=0.5)
    bound = certify(six, limits, placement=place_actuators(six, limits), gap=0.10, max_cells=2_000_000, seconds=7200.0)
    assert bound.better is None and bound.lower_bound > 0.0
