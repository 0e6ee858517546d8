"""Cells that determinants at the hulls of the modal shapes exclude hold no better placement within the limits."""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from scipy.optimize import differential_evolution

from workbench.design.placement.cell_bounds import CellBounds, Intervals
from workbench.design.placement.certificate import certify
from workbench.design.placement.hull_bound import ROUND_OFF, SINGULAR, HullBound, least_ratio
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import placement_task
from workbench.design.placement.task import batch_costs
from workbench.structure.member import Beam
from workbench.structure.profile import Profile


def beam_modes(ends, n_modes, rigidity=1.0):
    left, right = ends.split()
    return Beam(length=10.0, mass_per_length=1.0, bending_stiffness=rigidity, left=left, right=right).modes(n_modes)


def evenly(modes, n, factor):
    """A task of n actuators and the effort of evenly spaced ones times a factor."""
    task = placement_task(modes, n, impulse_at=6.3, weight=20.0)
    return task, factor * task.placed(10.0 * np.arange(1, n + 1) / (n + 1), "").effort


def cells_of(rng, n, levels, count, apart=0.4):
    """Of random places in order, each in an interval of one of the levels."""
    centres = np.sort(rng.uniform(0.3, 9.7, (20 * count, n)), axis=1)
    centres = centres[np.diff(centres, axis=1).min(axis=1) > apart][:count]
    halvings = rng.choice(levels, centres.shape)
    return (centres / 10.0 * 2**halvings).astype(int) + 2**halvings - 1


def cells_that_meet(rng, n, levels, count):
    """Two actuators or more in intervals side by side: B is singular, or nearly so, in every cell."""
    halvings = rng.choice(levels, count)
    first = (rng.uniform(0.02, 0.9, count) * (2**halvings - n)).astype(int)
    steps = rng.integers(1, 4, (count, n - 1))
    steps[np.arange(count), rng.integers(0, n - 1, count)] = 1
    at = first[:, None] + np.concatenate([np.zeros((count, 1), int), np.cumsum(steps, axis=1)], axis=1)
    return np.minimum(at, 2 ** halvings[:, None] - 1) + 2 ** halvings[:, None] - 1


def exact_ratio(b, w):
    """tr B⁻¹W and the sign of det B, of columns (n, n) each, in fractions."""
    n = len(b)
    rows = [[Fraction(x) for x in (*b[:, i], *w[:, i])] for i in range(n)]
    sign = 1
    for k in range(n):
        p = next(i for i in range(k, n) if rows[i][k] != 0)
        rows[k], rows[p] = rows[p], rows[k]
        sign *= (1 if p == k else -1) * (1 if rows[k][k] > 0 else -1)
        rows[k] = [x / rows[k][k] for x in rows[k]]
        for i in range(n):
            if i != k:
                rows[i] = [x - rows[i][k] * y for x, y in zip(rows[i], rows[k])]
    return float(sum(rows[i][n + i] for i in range(n))), sign


@pytest.mark.parametrize("n", [2, 3, 4])
@pytest.mark.parametrize("apart", [1.0, 1e-3, 1e-6])
def test_ratios_of_all_choices_are_those_of_the_inverse(n, apart):
    """To the round-off that is allowed for, though the columns be all but parallel."""
    rng, finite = np.random.default_rng(n), 0
    for _ in range(8):
        b, w = rng.normal(size=(2, n, 2, n))
        b, w = (rng.normal(size=n) + apart * part for part in (b, w))
        choices = list(product(range(2), repeat=n))
        found = [exact_ratio(b[np.arange(n), choice], w[np.arange(n), choice]) for choice in choices]
        values = [ratio * sign for ratio, sign in found]
        i, chosen = int(np.argmin(values)), np.zeros(n, np.int64)
        least, sign = least_ratio(b, w, 1.0, -np.inf, SINGULAR * np.abs(b).max(), chosen)
        if np.isfinite(least):
            finite += 1
            assert least == pytest.approx(values[i], rel=ROUND_OFF)
            assert sign == found[i][1] and tuple(chosen) == choices[i]
    assert finite > 0 or apart < 1e-3


@pytest.mark.parametrize("profile", ["uniform", "stepped"])
def test_shapes_stay_by_the_cubics(profile, hinged_modes):
    """Also about a step of the stiffness, where φ'' jumps."""
    step = Profile(lambda x: np.where(x < 3.7, 1.0, 2.0), breaks=(3.7,))
    modes = hinged_modes(9) if profile == "uniform" else beam_modes("clamped free", 9, step)
    task = placement_task(modes, 4, impulse_at=6.3, weight=20.0)
    table, rng = Intervals.of(task), np.random.default_rng(5)
    identity = np.eye(4)[None]
    hull = HullBound(task, (table.centre, table.half, table.most_fourth), identity, identity, np.ones(1), np.inf)
    points, remainder = hull._arguments[:2]
    s = np.linspace(-1.0, 1.0, 41)[:, None, None]
    u, v = 0.5 * (1.0 - s), 0.5 * (1.0 + s)
    near = np.flatnonzero(np.abs(table.centre - 3.7) < 2.0 * table.half)
    nodes = np.concatenate([rng.choice(len(table.half), 200), near])
    at = points[nodes]
    cubic = u**3 * at[:, 0] + v**3 * at[:, 1] + 3 * u**2 * v * at[:, 2] + 3 * u * v**2 * at[:, 3]
    shapes = task.shapes(table.centre[nodes] + s[:, :, 0] * table.half[nodes])
    beyond = np.abs(shapes - cubic).max(axis=0)
    assert (beyond <= remainder[nodes] + 1e-12).all()
    if profile == "uniform":
        wide = table.half[nodes] > 0.05
        assert (beyond[wide] > 0.3 * remainder[nodes][wide]).mean() > 0.3


@pytest.mark.parametrize("meeting", [False, True])
@pytest.mark.parametrize("limited", ["effort", "condition"])
def test_no_placement_in_an_excluded_cell_is_better(limited, meeting, hinged_modes):
    task, effort = evenly(hinged_modes(9), 4, 1.5)
    if meeting:  # that actuators side by side may keep
        effort *= 50.0
    limits = Limits(**{limited: {"effort": effort, "condition": 100.0 if meeting else 8.0}[limited]})
    rng = np.random.default_rng(3)
    cells = cells_that_meet(rng, 4, [4, 5, 6, 7], 300) if meeting else cells_of(rng, 4, [4, 5, 6], 300)
    bounds = CellBounds(task, limits)
    known = bounds(cells)[0]
    signs = np.tile(np.array(list(product((-1.0, 1.0), repeat=4))), (len(cells), 1, 1))
    inside = np.concatenate([signs, rng.uniform(-1.0, 1.0, (len(cells), 184, 4))], axis=1)
    inside = bounds.intervals.centre[cells][:, None] + bounds.intervals.half[cells][:, None] * inside
    costs = batch_costs(task, task.shapes(inside.reshape(-1, 4)))
    kept = (getattr(costs, limited) <= getattr(limits, limited)).reshape(len(cells), 200)
    least = np.where(kept, np.sqrt(costs.work.reshape(len(cells), 200)), np.inf).min(axis=1)
    excluded = 0
    for wanted in (0.01, 0.03, 0.1):
        bounds.wanted = wanted
        lower = bounds(cells)[0]
        proven = lower >= wanted
        assert (least[proven] >= wanted * (1 - 1e-9)).all()
        excluded += (proven & (known < wanted)).sum()
    assert excluded > 20


@pytest.mark.parametrize(
    ("ends", "n", "factor", "spacing"),
    [
        ("hinged hinged", 1, 1.5, 0.0),
        ("hinged hinged", 2, 3.0, 0.0),
        ("clamped free", 3, 10.0, 0.1),
        ("clamped clamped", 4, 3.0, 0.5),
    ],
)
def test_no_proof_is_above_an_optimum_found_by_evolution(ends, n, factor, spacing):
    task, effort = evenly(beam_modes(ends, 10), n, factor)
    limits = Limits(effort=effort, spacing=spacing)

    def work(places):
        at = np.sort(places.T, axis=1)
        costs = batch_costs(task, task.shapes(at))
        kept = (costs.effort <= effort) & (np.diff(at, axis=1).min(axis=1, initial=np.inf) >= spacing)
        return np.where(kept, costs.work, 1e6 + np.minimum(costs.effort, 1e12))

    found = differential_evolution(
        work, [(0.01, 9.99)] * n, rng=1, vectorized=True, updating="deferred", popsize=60, maxiter=400, tol=1e-8
    )
    proof = certify(task, limits, gap=0.02)
    assert proof.complete and proof.lower_bound <= found.fun
    assert proof.placement.residual_work <= found.fun * (1.0 + 1e-6)


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
@pytest.mark.parametrize("ends", ["hinged hinged", "clamped free"])
def test_six_actuators_and_ten_modes_are_proven_within_ten_per_cent(ends):
    """Under ten times the effort of even places on a hinged beam, half as much again on a cantilever."""
    task, effort = evenly(beam_modes(ends, 10), 6, 10.0 if ends == "hinged hinged" else 1.5)
    proof = certify(task, Limits(effort=effort, spacing=0.5), gap=0.1, most_cells=2_000_000, seconds=7200.0)
    assert proof.complete and proof.better is None
