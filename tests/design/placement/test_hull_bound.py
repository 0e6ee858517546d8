"""Cells that determinants at the hulls of the modal shapes exclude hold no better placement within the limits."""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from scipy.optimize import differential_evolution

from workbench.design.placement.cell_bounds import CellBounds, Intervals
from workbench.design.placement.certificate import certify
from workbench.design.placement.hull_bound import ROUND_OFF, SINGULAR, hull_tables, least_ratio
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import placement_task
from workbench.design.placement.task import batch_costs
from workbench.rig.actuators import piezo_patch
from workbench.structure.member import Bar, Beam
from workbench.structure.profile import Profile
from workbench.structure.supports import PointMass


def beam_modes(ends, n_modes):
    left, right = ends.split()
    return Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left=left, right=right).modes(n_modes)


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
        least, sign = least_ratio(b, w, b.shape[1], 1.0, -np.inf, SINGULAR * np.abs(b).max(), chosen)
        if np.isfinite(least):
            finite += 1
            assert least == pytest.approx(values[i], rel=ROUND_OFF)
            assert sign == found[i][1] and tuple(chosen) == choices[i]
    assert finite > 0 or apart < 1e-3


def test_ratios_are_exact_enough_where_several_pivots_are_small(hinged_modes):
    """Six actuators of which some all but meet: pivots shrink one after the other, and round-off grows with each."""
    n, rng, finite = 6, np.random.default_rng(0), 0
    task, effort = evenly(hinged_modes(10), n, 10.0)
    points = CellBounds(task, Limits(effort=effort))._hull[0]
    for cell in cells_that_meet(rng, n, [6, 9], 150):
        at = points[cell, rng.integers(0, 4, n)]
        b, w = at[:, :n].copy(), at[:, n:] @ rng.normal(size=(task.modes.n_modes - n, n))
        least, sign = least_ratio(
            b[:, None], w[:, None], 1, 1.0, -np.inf, SINGULAR * np.abs(b).max(), np.zeros(n, np.int64)
        )
        if np.isfinite(least):
            finite += 1
            exact, exact_sign = exact_ratio(b, w)
            assert sign == exact_sign and least == pytest.approx(sign * exact, rel=ROUND_OFF)
    assert finite > 30


def member_modes(name, n_modes):
    """Of a beam or a bar of 10 m, named by its ends, with a step of stiffness or a mass of 2 kg if the name says so."""
    kind, left, right, *more = name.split()
    step = Profile(lambda x: np.where(x < 4.1, 1.0, 2.0), breaks=(4.1,)) if "step" in more else 1.0
    mass = (PointMass(at=4.1, mass=2.0),) if "mass" in more else ()
    make = Beam if kind == "beam" else Bar
    stiffness = {"bending_stiffness" if kind == "beam" else "axial_stiffness": step}
    return make(length=10.0, mass_per_length=1.0, left=left, right=right, attachments=mass, **stiffness).modes(n_modes)


@pytest.mark.parametrize(
    ("member", "patched"),
    [
        ("beam hinged hinged", False),
        ("beam hinged hinged", True),
        ("beam clamped free step", False),
        ("beam clamped free step", True),
        ("bar fixed free step mass", False),
    ],
)
def test_shapes_stay_by_the_parabolas_and_the_cubics(member, patched):
    """Also where the slope jumps or φ'' does, as that of a bar about a mass, or of what a patch across a step takes."""
    actuator = piezo_patch("P", 5.0, length=1.0) if patched else None
    task = placement_task(member_modes(member, 9), 4, impulse_at=6.3, weight=20.0, actuator=actuator)
    table, rng = Intervals.of(task), np.random.default_rng(5)
    identity = np.eye(4)[None]
    measures = table.centre, table.half, table.most_fourth
    points, remainder = hull_tables(task, measures, identity, identity, np.ones(1), np.inf)[:2]
    breaks = (3.6, 4.6) if patched else (4.1,)
    near = [np.flatnonzero(np.abs(table.centre - x) < 2.0 * table.half) for x in breaks]
    nodes = np.concatenate([rng.choice(len(table.half), 200), *near])
    s = np.linspace(-1.0, 1.0, 41)[:, None, None]
    u, v = 0.5 * (1.0 - s), 0.5 * (1.0 + s)
    at, h = points[nodes], table.half[nodes, None]
    cubic = u**3 * at[:, 0] + v**3 * at[:, 1] + 3 * u**2 * v * at[:, 2] + 3 * u * v**2 * at[:, 3]
    shapes = task.shapes(table.centre[nodes] + s[:, :, 0] * h[:, 0])
    beyond = np.abs(shapes - cubic).max(axis=0)
    assert (beyond <= remainder[nodes] + 1e-12).all()
    bent = np.minimum(np.abs(table.curvature[nodes]) + h * table.most_rate[nodes], table.most_curvature[nodes])
    linear = table.value[nodes] + s * h * table.slope[nodes]
    assert (np.abs(shapes - linear).max(axis=0) <= 0.5 * h**2 * bent + 1e-12).all()
    if member == "beam hinged hinged" and not patched:
        wide = h[:, 0] > 0.05
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


def random_task(rng):
    """A task of two to four actuators, or patches, on a beam or a bar, and a limit that even places keep, or nearly."""
    beams = [f"beam {ends}" for ends in ("hinged hinged", "clamped free", "clamped clamped", "hinged free")]
    member = rng.choice([*beams, "bar fixed free step mass"])
    n = int(rng.integers(2, 5))
    patch = piezo_patch("P", 5.0, length=0.5) if member == "beam clamped free" and rng.random() < 0.3 else None
    modes = member_modes(member, int(rng.integers(n + 1, 9)))
    task = placement_task(
        modes, n, impulse_at=rng.uniform(1.0, 9.0), weight=10.0 ** rng.uniform(-1.0, 2.0), actuator=patch
    )
    even = task.placed(np.linspace(*task.reach, n + 2)[1:-1], "")
    limited = str(rng.choice(["effort", "peak_force", "condition"]))
    limited = "condition" if member == "beam hinged free" else limited  # nothing else limits a rigid mode
    return task, Limits(**{limited: 10.0 ** rng.uniform(-0.2, 2.0) * getattr(even, limited)}), limited


def least_work(task, limits, limited, low, high, rng):
    """Least √W_R met in a cell from low to high (n_actuators,), m, within the limits; inf where none keeps them."""
    best, centre, reach = np.inf, 0.5 * (low + high), 0.5 * (high - low)
    for shrink in 0.4 ** np.arange(8):
        at = np.clip(centre + shrink * reach * rng.uniform(-1.2, 1.2, (150, len(low))), low, high)
        costs = batch_costs(task, task.shapes(at))
        work = np.where(getattr(costs, limited) <= getattr(limits, limited), costs.work, np.inf)
        if work.min() < best:
            best, centre = work.min(), at[np.argmin(work)]
    return np.sqrt(best)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 6))])
def test_no_bound_is_above_what_is_met_in_its_cell(seed):
    """Of random tasks and cells, wanted a little above the least that a search in the cell meets: all ask too much."""
    rng = np.random.default_rng(seed)
    task, limits, limited = random_task(rng)
    n, bounds = task.n_controlled, CellBounds(task, limits)
    table, levels = bounds.intervals, np.arange(3, 9)
    cells = [cells_of(rng, n, levels, 40, apart=0.0), cells_that_meet(rng, n, levels, 40)]
    raised = 0
    for cell in np.concatenate(cells):
        low, high = table.centre[cell] - table.half[cell], table.centre[cell] + table.half[cell]
        least = least_work(task, limits, limited, low, high, rng)
        known = bounds(cell[None])[0][0]
        for share in (1.0 + 1e-6, 0.7):
            bounds.wanted = share * least if np.isfinite(least) else 1.0
            lower = bounds(cell[None])[0][0]
            assert lower <= least * (1.0 + 1e-9)
            raised += lower > known
        bounds.wanted = 0.0
    assert raised > 0


@pytest.mark.parametrize(
    ("ends", "n", "factor", "spacing"),
    [
        ("hinged hinged", 1, 1.5, 0.0),
        ("hinged hinged", 2, 3.0, 0.0),
        ("clamped free", 3, 10.0, 0.1),
        pytest.param("clamped clamped", 4, 3.0, 0.5, marks=pytest.mark.slow),
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
    """Under ten times the effort of even places: on a cantilever 18.1 million cells, 210 s."""
    task, effort = evenly(beam_modes(ends, 10), 6, 10.0)
    proof = certify(task, Limits(effort=effort, spacing=0.5), gap=0.1, max_cells=30_000_000, seconds=7200.0)
    assert proof.complete and proof.better is None
