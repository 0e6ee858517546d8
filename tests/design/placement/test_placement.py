"""Placement: exact derivatives, limits kept, global by a scan; and the trap that limits are for."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov
from scipy.optimize import linprog

from workbench.design.laws.law import DesignError
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.loop.peak import largest
from workbench.design.placement.cell_bounds import CellBounds
from workbench.design.placement.certificate import _Search, certify
from workbench.design.placement.limits import Limits
from workbench.design.placement.placement import nodes_of_mode, place_actuators, placement_task, scan, symbolic_work
from workbench.design.placement.task import batch_costs, batch_work
from workbench.design.spillover.spillover import effort, finite_spillover, spillover
from workbench.rig.actuators import Actuator, piezo_patch
from workbench.structure.domain import Between, NamedPoints, PlaceError
from workbench.structure.finite_elements import FiniteElements
from workbench.structure.member import Beam


@pytest.fixture(scope="module")
def frame_task():
    """Two modes of a chain of eight masses."""
    names = tuple(f"S{i}" for i in range(1, 9))
    positions = np.array([[0.0, 0.0, 3.0 * i] for i in range(8)])
    stiffness = 2e6 * (2 * np.eye(8) - np.eye(8, k=1) - np.eye(8, k=-1))
    points = NamedPoints(names=names, positions=positions, directions=("x",) * 8)
    modes = FiniteElements(1200.0 * np.eye(8), stiffness, nodes=points).modes(5)
    return placement_task(modes, 2, impulse_at="S5", weight=1e-6)


@pytest.fixture(scope="module")
def task(hinged_modes):
    modes = hinged_modes(9)
    return placement_task(modes, 4, impulse_at=6.3, weight=20.0)


def even(task):
    return task.placed([2.0, 4.0, 6.0, 8.0], "")


def test_the_task_agrees_with_the_law(task):
    places = (1.5, 3.5, 6.5, 8.5)
    law = task.law(places)
    state = impulse_state(task.modes, 6.3)
    state[13:] = 0.0
    at = task.placed(places, "")
    total, by_mode, spent = at.residual_work, at.residual_work_by_mode, at.effort
    np.testing.assert_allclose(by_mode, spillover(task.modes, law, state).residual_work_by_mode, rtol=1e-9)
    assert total == pytest.approx(by_mode.sum()) and spent == pytest.approx(effort(task.modes, law, state), rel=1e-9)


def test_casadi_agrees_in_value_and_derivative(task):
    import casadi as ca

    function = symbolic_work(task)
    x = np.array([1.7, 3.6, 6.4, 8.2])
    at = task.placed(x, "")
    total, spent = at.residual_work, at.effort
    assert float(function(x)[0]) == pytest.approx(total, rel=1e-9)
    assert float(function(x)[1]) == pytest.approx(spent, rel=1e-9)
    z = ca.MX.sym("z", 4)
    exact = ca.Function("g", [z], [ca.gradient(function(z)[0], z)])(x).full().ravel()

    def work(at):
        return task.placed(at, "").residual_work

    for i in range(4):
        step = np.eye(4)[i] * 1e-4
        slope = (work(x + step) - work(x - step)) / 2e-4
        assert exact[i] == pytest.approx(slope, rel=1e-5)


def test_nodes_of_mode_five(task):
    np.testing.assert_allclose(nodes_of_mode(task.modes, 4), [2, 4, 6, 8], atol=1e-9)


def test_the_optimum_keeps_its_limits_and_beats_a_full_grid(task):
    limit = 1.5 * even(task).effort
    best = place_actuators(task, Limits(effort=limit, spacing=0.5), starts=4)
    assert best.effort <= limit * (1 + 1e-6) and (np.diff(best.positions) >= 0.5 - 1e-6).all()
    on_grid, tried = scan(task, Limits(effort=limit, spacing=0.5), n_places=30)
    assert tried > 10000 and best.residual_work <= on_grid.residual_work
    assert best.residual_work < 0.5 * even(task).residual_work


def test_without_a_limit_the_outer_actuators_run_onto_the_supports(task):
    free = place_actuators(task, Limits(effort=1e9, spacing=0.1), starts=4)
    assert free.positions[0] < 0.1 and free.positions[-1] > 9.9
    assert free.residual_work == pytest.approx(5.3e-4, rel=0.1)
    assert free.effort > 10 * even(task).effort


def test_limits_that_conflict_are_named(task):
    with pytest.raises(DesignError, match="the structure has 10"):
        place_actuators(task, Limits(effort=1.0, spacing=4.0))
    with pytest.raises(DesignError, match=r"effort is 0[.]001 N² s with a spacing of 0[.]5 m, and"):
        place_actuators(task, Limits(effort=1e-3, spacing=0.5), starts=1)
    late = Actuator("F", 1.0, time_constant=0.004)
    with pytest.raises(DesignError, match=r"F has time_constant = 0[.]004, and placement is for"):
        placement_task(task.modes, 4, impulse_at=6.3, weight=20.0, actuator=late)
    with pytest.raises(DesignError, match="no residual mode"):
        placement_task(task.modes, 9, impulse_at=6.3, weight=20.0)


def test_a_heavy_structure_is_placed_like_a_light_one(task):
    """The test of a singular B once was not relative, so every placement on a heavy structure was thrown out."""
    heavy = Beam(length=10.0, mass_per_length=1e8, bending_stiffness=1e8, left="hinged", right="hinged").modes(9)
    twin = placement_task(heavy, 4, impulse_at=6.3, weight=20.0, impulse=1e8)
    limits = [1.5 * even(t).effort for t in (task, twin)]
    light, same = (scan(t, Limits(effort=e, spacing=0.5), n_places=16)[0] for t, e in zip((task, twin), limits))
    np.testing.assert_allclose(same.positions, light.positions, atol=1e-12)
    assert same.residual_work == pytest.approx(1e8 * light.residual_work, rel=1e-6)


def law_and_state(task, places, at=6.3):
    state = impulse_state(task.modes, at)
    state[task.modes.n_modes + task.n_controlled :] = 0.0
    return task.law(places), state


def test_finite_time_and_peak_force_are_those_of_the_motion(task):
    places = (1.5, 3.5, 6.5, 8.5)
    short = placement_task(task.modes, 4, impulse_at=6.3, weight=20.0, final_time=25.0)
    law, state = law_and_state(task, places)
    loop = close_loop(task.modes, law)
    found = short.placed(places, "")
    np.testing.assert_allclose(
        found.residual_work_by_mode, finite_spillover(loop, state, 25.0).residual_work_by_mode, rtol=1e-8
    )
    forces = initial_response(loop, np.linspace(0.0, 25.0, 20001), state).forces
    assert np.abs(forces).max() <= found.peak_force <= np.abs(forces).max() * (1 + 1e-5)
    assert found.effort == pytest.approx(np.trapezoid((forces**2).sum(axis=0), dx=25.0 / 20000), rel=1e-5)


def test_a_peak_between_samples_is_met():
    """1 - cos beats slowly: 2 at t = π/δ; and e^{-t} - e^{-2t}, which is largest, 1/4, at log 2."""
    beating = np.array([10j, -10j, 10.001j, -10.001j])
    assert largest(beating, np.array([[0.5, 0.5, -0.5, -0.5]]), 4000.0) == pytest.approx(2.0, rel=1e-6)
    assert largest(np.array([-1.0, -2.0]), np.array([[1.0, -1.0]]), np.inf) == pytest.approx(0.25, rel=2e-6)
    assert largest(np.array([-1.0, -2.0]), np.zeros((2, 2)), np.inf) == 0.0


def test_a_distribution_of_impulses_is_the_mean_over_them(task):
    impulses, probabilities = [2.2, 6.3, 9.1], [0.5, 0.3, 0.2]
    given, places = {"impulse_at": impulses, "weight": 20.0}, [2.1, 4, 6, 8.3]
    many = placement_task(task.modes, 4, **given, probabilities=probabilities).placed(places, "")
    each = [placement_task(task.modes, 4, impulse_at=x, weight=20.0).placed(places, "") for x in impulses]
    np.testing.assert_allclose(
        many.residual_work_by_mode,
        np.average([e.residual_work_by_mode for e in each], axis=0, weights=probabilities),
        rtol=1e-10,
    )
    assert many.effort == pytest.approx(np.average([e.effort for e in each], weights=probabilities), rel=1e-10)
    assert many.peak_force == pytest.approx(max(e.peak_force for e in each), rel=2e-6)
    with pytest.warns(DeprecationWarning, match="probabilities"):
        assert placement_task(task.modes, 4, **given, chances=probabilities).placed(places, "").effort == many.effort


def test_white_noise_pumps_energy_at_the_rate_of_unit_impulses(hinged_modes):
    """Covariance of the driven loop, mode 3 residual and lightly damped: ½ S_ff / c, against a Lyapunov equation."""
    from scipy.linalg import solve_continuous_lyapunov

    modes = hinged_modes(3)
    task = placement_task(modes, 2, impulse_at=6.3, weight=20.0)
    law = task.law([2.5, 6.0])
    a = np.array(close_loop(modes, law).matrix)
    c = 1e-5
    a[5, 5] -= c
    push = np.r_[np.zeros(3), modes.phi(6.3)[0, :2], 0.0]
    covariance = solve_continuous_lyapunov(a, -np.outer(push, push))
    # at rest, power in = power lost: W_3 = c E q3'²
    assert c * covariance[5, 5] == pytest.approx(task.placed([2.5, 6.0], "").residual_work_by_mode[0], rel=1e-3)


def test_the_tail_bound_holds_and_is_not_idle(task, hinged_modes):
    many = hinged_modes(60)
    places = [1.5, 3.5, 6.5, 8.5]
    all_ = placement_task(many, 4, impulse_at=6.3, weight=20.0).placed(places, "")
    left_out = all_.residual_work_by_mode[16:].sum()
    bound = placement_task(many.select(range(20)), 4, impulse_at=6.3, weight=20.0).tail_bound(places, growth=2.0)
    assert left_out < bound < 100 * left_out


@pytest.mark.parametrize("actuator", [Actuator("M", 3.0, quantity="moment"), piezo_patch("P", 4.0, length=0.5)])
def test_the_tail_bound_holds_for_what_acts_by_slopes(hinged_modes, actuator):
    """sup |φ_r'| = √(2/L) rπ/L grows with the mode; a short patch's part grows as its square at first."""
    many = hinged_modes(200)
    for x in (0.5, 3.7, 8.3):
        left_out = (
            placement_task(many, 1, impulse_at=3.7, weight=1.0, actuator=actuator)
            .placed([x], "")
            .residual_work_by_mode[3:]
        )
        few = placement_task(many.select(range(4)), 1, impulse_at=3.7, weight=1.0, actuator=actuator)
        assert left_out.sum() < few.tail_bound([x], growth=2.0)
    with pytest.raises(DesignError, match="and 3/2 for moments; got 1"):
        few.tail_bound([5.0], growth=1.0)


def test_the_tail_bound_is_along_an_interval(frame_task):
    with pytest.raises(DesignError, match="for an interval; these modes are of 8 named points"):
        frame_task.tail_bound(["S2", "S5"], growth=1.0)


def test_a_candidate_outside_is_told(task):
    with pytest.raises(PlaceError, match="x = 110 lies outside"):
        place_actuators(task, Limits(candidates=(1.5, 3.5, 6.5, 8.5, 110.0)))


def test_a_choice_among_named_points_is_certified_without_a_limit(frame_task):
    """There are finitely many: the certificate is that of all points as candidates."""
    best = certify(frame_task, Limits())
    assert best.complete and best.cells == 28 and best.gap == 0.0
    assert best.placement.residual_work == place_actuators(frame_task, Limits()).residual_work


def test_limits_on_peak_force_condition_and_intervals_are_kept(task):
    limits = Limits(effort=0.4, peak_force=0.34, condition=6.0, spacing=0.5, forbidden=((2.5, 3.4), (7.0, 9.0)))
    best = place_actuators(task, limits, starts=6)
    assert best.peak_force <= 0.34 * (1 + 1e-5) and best.condition <= 6.0 * (1 + 1e-5)
    assert not any(((low < best.positions) & (best.positions < high)).any() for low, high in limits.forbidden)
    on_grid, _ = scan(task, limits, n_places=28)
    assert best.residual_work <= on_grid.residual_work


def test_candidates_are_searched_whole(task):
    candidates = np.array([1.0, 2.2, 3.1, 4.4, 5.9, 7.3, 8.6])
    best, tried = scan(task, Limits(candidates=candidates))
    assert tried == 35 and set(best.positions) <= set(candidates)
    with pytest.raises(DesignError, match="4 actuators at 300 places make"):
        scan(task, Limits(candidates=np.linspace(0.1, 9.9, 300)))
    with pytest.raises(DesignError, match="allow 3"):
        scan(task, Limits(candidates=(1.0, 2.0, 3.0)))


def test_which_limits_conflict_is_said(task):
    with pytest.raises(DesignError, match=r"the limit of the condition number is 3[.]9, and the least"):
        place_actuators(task, Limits(condition=3.9), starts=1)
    with pytest.raises(DesignError, match=r"the limit of peak force is 0[.]01 N, and the least"):
        scan(task, Limits(peak_force=0.01), n_places=20)
    with pytest.raises(DesignError, match="leave no place"):
        place_actuators(task, Limits(forbidden=((-1.0, 11.0),)))
    with pytest.raises(DesignError, match="effort must be positive"):
        place_actuators(task, Limits(effort=-1.0))


def test_fast_figures_are_the_careful_ones(task):
    shapes = task.shapes(np.sort(np.random.default_rng(0).uniform(0.3, 9.7, (50, 4)), axis=1))
    careful = batch_costs(task, shapes)
    work, spent = batch_work(task, shapes)
    np.testing.assert_allclose(work, careful.work, rtol=1e-9)
    np.testing.assert_allclose(spent, careful.effort, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "limits",
    [
        Limits(effort=0.2352),
        Limits(peak_force=0.31),
        Limits(condition=5.5),
        Limits(effort=0.3, peak_force=0.4, condition=7),
    ],
)
def test_bounds_hold_on_every_cell(task, limits):
    """No placement in a cell does better than the cell's bound, nor keeps a limit that the cell cannot."""
    rng = np.random.default_rng(1)
    bounds = CellBounds(task, limits)
    informative = refused = 0
    optimum = np.array([0.8655, 2.883, 6.2842, 9.2303])
    for level in (3, 5, 7, 9):
        centres = np.sort(rng.uniform(0.5, 9.5, (200, 4)), axis=1)
        centres[:100] = optimum + rng.uniform(-0.3, 0.3, (100, 4))
        # each axis halved once more or less often, as in the search
        levels = level + rng.integers(-1, 2, (200, 4))
        cells = (centres / 10.0 * 2**levels).astype(int) + 2**levels - 1
        lower, _, _ = bounds(cells)
        centre, half = bounds.intervals.centre[cells], bounds.intervals.half[cells]
        possible = np.isfinite(lower)
        informative, refused = informative + (lower[possible] > 0).sum(), refused + (~possible).sum()
        inside = centre[:, None] + half[:, None] * rng.uniform(-1.0, 1.0, (200, 60, 4))
        inside[:, :16] = centre[:, None] + half[:, None] * np.array(np.meshgrid(*[(-1, 1)] * 4)).reshape(4, 16).T
        inside = inside.reshape(-1, 4)
        costs = batch_costs(task, task.shapes(inside))
        violations = limits.violations(inside, costs)
        kept = np.all([excess <= 0 for excess in violations.values()], axis=0).reshape(200, 60)
        assert (np.sqrt(costs.work.reshape(200, 60)) >= lower[:, None] * (1 - 1e-9))[kept].all()
        assert not kept[~possible].any()
    assert informative > 100 and refused > 50


def test_the_certificate_proves_an_optimum_and_finds_out_a_pretender(hinged_modes):
    modes = hinged_modes(9)
    two = placement_task(modes, 2, impulse_at=6.3, weight=20.0)
    nodes = two.placed(nodes_of_mode(modes, 2), "nodes")
    limits = Limits(effort=1.5 * nodes.effort, spacing=0.5)
    proven = certify(two, limits, gap=0.01)
    assert proven.complete and proven.gap == pytest.approx(0.01) and proven.cell is None
    bound = f"W_R below {proven.lower_bound:.4g} J, 1 % under that of the one found"
    assert f"certified: no placement within the limits has {bound}" in str(proven)
    found_out = certify(two, limits, placement=nodes, gap=0.01)
    assert found_out.better is not None
    assert two.placed(found_out.better, "").residual_work < nodes.residual_work


def test_cells_are_dropped_that_have_no_room_for_all(task):
    """A linear programme has the last word: places in order in their intervals, each the spacing beyond the last."""
    limits = Limits(effort=0.3, spacing=0.5)
    optimum = task.placed(np.array([0.8655, 2.883, 6.2842, 9.2303]), "")
    search, rng = _Search(task, limits, optimum, 0.05), np.random.default_rng(2)
    cells = np.sort(rng.integers(0, 4, (60, 4)) + rng.integers(0, 13, (60, 1)), axis=1) + 15
    kept = {tuple(cell) for cell in search._feasible(cells)}
    order = np.eye(3, 4) - np.eye(3, 4, k=1)
    room = [
        linprog(
            np.zeros(4), order, -0.5 * np.ones(3), bounds=np.column_stack([search._tree.low[c], search._tree.high[c]])
        )
        for c in cells
    ]
    assert [tuple(cell) in kept for cell in cells] == [found.status == 0 for found in room]
    assert 10 < len(kept) < 50


def test_a_search_cut_short_says_its_gap_and_the_cell_that_holds_it(task):
    limits = Limits(effort=1.5 * even(task).effort, spacing=0.5)
    met = []
    best = place_actuators(task, limits, starts=4)
    bound = certify(task, limits, placement=best, gap=0.05, max_cells=1_000, progress=lambda *at: met.append(at))
    assert not bound.complete and bound.lower_bound < 0.95 * best.residual_work
    assert bound.cell.shape == (4, 2) and (bound.cell[:, 0] < bound.cell[:, 1]).all()
    counts = [cells for _, _, cells in met]
    assert counts == sorted(counts) and "the lowest bound is that of actuators at" in str(bound)
    proven = certify(task, limits, placement=best, gap=0.05)
    assert proven.complete and proven.gap <= 0.05 + 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(("ends", "factor"), [("hinged hinged", 10.0), ("clamped free", 1.5), ("clamped clamped", 3.0)])
def test_four_actuators_and_ten_modes_are_proven_within_five_per_cent(ends, factor):
    left, right = ends.split()
    modes = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left=left, right=right).modes(10)
    four = placement_task(modes, 4, impulse_at=6.3, weight=20.0)
    limits = Limits(effort=factor * even(four).effort, spacing=0.5)
    proven = certify(four, limits, gap=0.05)
    assert proven.complete and proven.cells < 10_000_000


@pytest.mark.parametrize(
    "limits",
    [
        Limits(peak_force=0.35, spacing=0.5),
        Limits(condition=2.5, spacing=0.5, edge_distance=0.05),
        Limits(effort=0.2, forbidden=((4.9, 5.6), (7.0, 8.0))),
        Limits(peak_force=0.5, candidates=tuple(np.linspace(0.5, 9.5, 31))),
    ],
)
def test_every_limit_is_part_of_the_proof(limits, hinged_modes):
    modes = hinged_modes(9)
    two = placement_task(modes, 2, impulse_at=6.3, weight=20.0)
    best = place_actuators(two, limits, starts=8)
    proof = certify(two, limits, placement=best, gap=0.01)
    assert proof.better is None and proof.complete and proof.gap <= 0.01 + 1e-12
    # a grid by itself: no better
    anywhere = np.linspace(0.05, 9.95, 199) if limits.candidates is None else np.array(limits.candidates)
    fine = np.stack(np.meshgrid(*[anywhere] * 2, indexing="ij"), -1).reshape(-1, 2)
    fine = fine[fine[:, 0] < fine[:, 1]]
    costs = batch_costs(two, two.shapes(fine))
    kept = np.all([excess <= 0 for excess in limits.violations(fine, costs).values()], axis=0)
    for low, high in limits.forbidden:
        kept &= ~((fine > low) & (fine < high)).any(axis=1)
    kept &= ((fine >= limits.edge_distance) & (fine <= 10.0 - limits.edge_distance)).all(axis=1)
    # the best of the candidates is evaluated here among others: the last digit may differ
    assert kept.any() and costs.work[kept].min() >= proof.lower_bound * (1.0 - 1e-12)
    # and a worse one that keeps the limits is found out
    worse = two.placed(fine[kept][np.argsort(costs.work[kept])[kept.sum() // 2]], "")
    assert certify(two, limits, placement=worse, gap=0.01).better is not None


def test_the_peak_force_of_three_actuators_is_enough_of_a_limit(hinged_modes):
    three = placement_task(hinged_modes(9), 3, impulse_at=6.3, weight=20.0)
    limits = Limits(peak_force=0.33, spacing=0.5)
    proof = certify(three, limits, placement=place_actuators(three, limits, starts=4), gap=0.05, max_cells=50_000)
    assert proof.complete and proof.better is None


def test_a_proof_needs_a_limit(task):
    with pytest.raises(DesignError, match="singular"):
        certify(task, Limits(), placement=even(task))


def test_the_law_stands_with_its_places(task):
    best = place_actuators(task, Limits(effort=1.5 * even(task).effort, spacing=0.5), starts=2)
    assert [a.at for a in best.law.actuators] == list(best.positions)
    np.testing.assert_allclose(best.law.gain, task.law(best.positions).gain)


def test_limits_as_keywords_still_work_with_a_warning(task):
    limit = 1.5 * even(task).effort
    with pytest.warns(DeprecationWarning, match="takes \\(task, limits\\)"):
        former, _ = scan(task, effort_limit=limit, spacing=0.5, n_places=16)
    np.testing.assert_array_equal(former.positions, scan(task, Limits(limit, spacing=0.5), n_places=16)[0].positions)
    two = placement_task(task.modes, 2, impulse_at=6.3, weight=20.0)
    nodes = two.placed(nodes_of_mode(task.modes, 2), "nodes")
    with pytest.warns(DeprecationWarning, match="certify"):
        assert certify(two, nodes, effort_limit=1.5 * nodes.effort, spacing=0.5).better is not None


def test_all_of_a_patch_keeps_out_of_a_forbidden_stretch():
    limits = Limits(effort=1.0, forbidden=((2.0, 3.0), (9.5, 9.8)))
    assert limits.allowed(10.0) == [(0.0, 2.0), (3.0, 9.5), (9.8, 10.0)]
    assert limits.allowed(10.0, clear=0.25) == [(0.25, 1.75), (3.25, 9.25)]


def test_both_orders_of_a_pair_stay_on_the_beam(hinged_modes):
    for pair in (Between(5.5, 4.5), Between(4.5, 5.5)):
        actuator = Actuator("P", pair, quantity="moment")
        assert placement_task(hinged_modes(5), 2, impulse_at=6.3, weight=1.0, actuator=actuator).reach == (0.5, 9.5)


def test_a_zone_up_to_an_end_leaves_no_place_at_the_end():
    assert Limits(effort=1.0, forbidden=((7.0, 10.0),)).allowed(10.0) == [(0.0, 7.0)]
    with pytest.raises(DesignError, match="leave no place"):
        Limits(effort=1.0, forbidden=((0.0, 10.0),)).allowed(10.0)
    with pytest.raises(
        DesignError, match=r"forbidden zone \[300.0\] to \[400.0\] lies outside .* 0 to 10 m; give it in m"
    ):
        Limits(effort=1.0, forbidden=((300.0, 400.0),)).allowed(10.0)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"impulse_at": 0.0}, "an impulse at 0.0 excites no mode"),
        ({"impulse": np.nan}, "the impulse must be finite and not 0, N s; got nan"),
        ({"weight": [1.0, 2.0]}, "R is one number, or one per mode: 4 modes need as many; got 2"),
    ],
)
def test_a_task_that_is_none_is_refused(hinged_modes, change, message):
    with pytest.raises(DesignError, match=message):
        placement_task(hinged_modes(9), 4, **{"impulse_at": 6.3, "weight": 20.0, **change})


def test_a_damped_structure_is_placed_with_the_law_that_it_gets(hinged_modes):
    """∫ FᵀF dt by Lyapunov's equation, and W_R = ½ Σ |b_rᵀ F(iω_r)|², of the law that the placement has."""
    modes = replace(hinged_modes(6), damping=np.full(6, 0.02))
    placed = placement_task(modes, 2, impulse_at=6.3, weight=20.0).placed((3.0, 6.0), "")
    b, gain = modes.phi(placed.positions), placed.law.gain
    free = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.diag(modes.omega[:2] ** 2), -modes.damping[:2, :2]]])
    loop = free - np.vstack([np.zeros((2, 2)), b[:, :2].T]) @ gain
    start = np.r_[0.0, 0.0, modes.phi(6.3)[0, :2]]
    state = solve_continuous_lyapunov(loop, -np.outer(start, start))
    np.testing.assert_allclose(placed.effort, np.trace(gain @ state @ gain.T), rtol=1e-9)
    work = [
        0.5 * abs(b[:, r] @ gain @ np.linalg.solve(1j * modes.omega[r] * np.eye(4) - loop, start)) ** 2
        for r in range(2, 6)
    ]
    np.testing.assert_allclose(placed.residual_work_by_mode, work, rtol=1e-9)


def test_as_many_places_as_controlled_modes_are_placed(task):
    with pytest.raises(DesignError, match="4 controlled modes take as many actuators; got 2 places"):
        task.placed((3.0, 6.0), "")


def test_the_former_name_of_the_distance_from_the_edges_still_works():
    with pytest.warns(DeprecationWarning, match="edge_distance"):
        limits = Limits(margin=0.3, spacing=0.5)
    assert limits == Limits(edge_distance=0.3, spacing=0.5)
    with pytest.warns(DeprecationWarning, match="edge_distance"):
        assert limits.margin == 0.3
