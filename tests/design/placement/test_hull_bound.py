"""Cells that the corners of polygons about the modal shapes exclude hold no better placement within the limits."""

from itertools import product

import numpy as np
import pytest

from workbench.design.placement.cell_bounds import CellBounds
from workbench.design.placement.certificate import certify
from workbench.design.placement.hull_bound import least_ratio
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import placement_task
from workbench.design.placement.task import batch_costs


def evenly(modes, n, factor, **more):
    """A task of n actuators and the effort of evenly spaced ones times a factor."""
    task = placement_task(modes, n, impulse_at=6.3, weight=20.0)
    return task, factor * task.placed(10.0 * np.arange(1, n + 1) / (n + 1), "").effort


def cells_of(rng, n, levels, count):
    """Of random places in order, each in an interval of one of the levels."""
    centres = np.sort(rng.uniform(0.3, 9.7, (20 * count, n)), axis=1)
    centres = centres[np.diff(centres, axis=1).min(axis=1) > 0.4][:count]
    halvings = rng.choice(levels, centres.shape)
    return (centres / 10.0 * 2**halvings).astype(int) + 2**halvings - 1


@pytest.mark.parametrize("n", [2, 3, 4])
def test_ratios_of_all_choices_are_those_of_the_inverse(n):
    rng = np.random.default_rng(n)
    for _ in range(20):
        b, w = rng.normal(size=(2, n, 3, n))
        choices = list(product(range(3), repeat=n))
        values, signs = [], []
        for choice in choices:
            columns, others = (part[np.arange(n), choice].T for part in (b, w))
            signs.append(np.sign(np.linalg.det(columns)))
            values.append(signs[-1] * np.trace(np.linalg.inv(columns) @ others))
        i, chosen = int(np.argmin(values)), np.zeros(n, np.int64)
        least, sign = least_ratio(b, w, 1.0, -np.inf, 1e-13, chosen)
        assert least == pytest.approx(values[i]) and sign == signs[i] and tuple(chosen) == choices[i]


@pytest.mark.parametrize("limited", ["effort", "condition"])
def test_no_placement_in_an_excluded_cell_is_better(limited, hinged_modes):
    task, effort = evenly(hinged_modes(9), 4, 1.5)
    limits = Limits(**{limited: {"effort": effort, "condition": 8.0}[limited]})
    rng = np.random.default_rng(3)
    cells = cells_of(rng, 4, [4, 5, 6], 300)
    bounds = CellBounds(task, limits)
    known = bounds(cells)[0]
    inside = bounds.intervals.centre[cells][:, None] + bounds.intervals.half[cells][:, None] * np.concatenate(
        [np.tile(np.array(list(product((-1.0, 1.0), repeat=4))), (300, 1, 1)), rng.uniform(-1.0, 1.0, (300, 80, 4))],
        axis=1,
    )
    costs = batch_costs(task, task.shapes(inside.reshape(-1, 4)))
    kept = (getattr(costs, limited) <= getattr(limits, limited)).reshape(300, 96)
    least = np.where(kept, np.sqrt(costs.work.reshape(300, 96)), np.inf).min(axis=1)
    excluded = 0
    for wanted in (0.01, 0.03, 0.1):
        bounds.wanted = wanted
        lower = bounds(cells)[0]
        proven = lower >= wanted
        assert (least[proven] >= wanted * (1 - 1e-9)).all()
        excluded += (proven & (known < wanted)).sum()
    assert excluded > 20


def test_cells_of_six_actuators_are_excluded_that_no_other_bound_tells_from_zero(hinged_modes):
    """At 32 intervals a length: neither does Neumann's series converge nor duality see more than the limit."""
    task, effort = evenly(hinged_modes(10), 6, 10.0)
    cells = cells_of(np.random.default_rng(4), 6, [5], 200)
    wanted = 1e-3  # about that of the optimum
    bounds = CellBounds(task, Limits(effort=effort))
    known = bounds(cells)[0]
    bounds.wanted = wanted
    assert (known == 0.0).sum() > 50
    assert (bounds(cells)[0][known == 0.0] >= wanted).mean() > 0.7


@pytest.mark.slow
def test_six_actuators_and_ten_modes_are_proven_within_ten_per_cent_under_a_loose_limit(hinged_modes):
    """In less than a million cells; the other bounds need four."""
    task, effort = evenly(hinged_modes(10), 6, 3.0)
    proof = certify(task, Limits(effort=effort, spacing=0.5), gap=0.1, most_cells=1_000_000, seconds=7200.0)
    assert proof.complete and proof.better is None
