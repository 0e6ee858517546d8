"""Fits of what a place and a strength make up for between them, on a beam with known truth."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from workbench.gap.diagnose import _leaves_far_more_than_noise, _over_fits
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect, apply_all, merged_sets, simpler_forms, with_two_as_one
from workbench.gap.effects.nominal import NominalPrior, nominal_errors
from workbench.gap.prediction.innovations import PROCESS_NOISE
from workbench.gap.prediction.random_force import tonal
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.unmodelled_force import force_filter, sampled_model, whiten
from workbench.gap.report.budget import Shrinkage
from workbench.gap.report.notes import _of_large_errors
from workbench.gap.search.fit import Chord, _Problem, cost_of, fit, slopes
from workbench.rig.elements import CubicSpring, PeriodicForce
from workbench.rig.simulate import simulate

NOISE, DT = 1e-5, 0.01
CUBIC, SPRING, LOSS = (kind_named(n) for n in ("cubic_spring", "ground_spring", "local_stiffness_loss"))


@pytest.fixture(scope="module")
def rig(hinged_rig):
    return hinged_rig()


@pytest.fixture(scope="module")
def measured(record_of):
    def make(real, level=1.0):
        rng = np.random.default_rng(3)
        command = level * np.repeat(rng.normal(size=100), 10)[None]
        return FitData((record_of(real, command, rng, substeps=8),), np.full(4, NOISE))

    return make


def test_an_effect_without_numbers_is_fitted_as_it_is(rig, measured):
    data, more = measured(rig), kind_named("truncated_modes")
    effects = (Effect(more, more.targets(rig)[0], {}),)
    assert slopes(rig, effects, data)[1].shape == (data.n_values, 0)
    found = fit(rig, effects, data)
    assert found.n_parameters == 0 and found.cost == cost_of(rig, effects, data)


def test_a_fit_follows_the_valley_along_which_a_place_makes_up_for_a_strength(rig, measured):
    real = replace(rig, elements=(CubicSpring(0.2, 400.0),))
    data = measured(real)
    nominal = cost_of(rig, (), data)
    # where the beam moves half as much a spring must be sixteen times as hard
    found = fit(rig, (Effect(CUBIC, None, {"at": 0.1, "stiffness": 16 * 400.0}),), data, iterations=20)
    values, spread = found.effects[0].values, found.effects[0].std
    assert nominal > 100 and found.cost < 1.02
    assert values["at"] == pytest.approx(0.2, abs=4 * spread["at"] + 1e-3)
    assert values["stiffness"] == pytest.approx(400.0, rel=0.05)


def test_predictions_ahead_err_by_the_innovations_of_the_filter_where_all_is_linear(rig, record_of):
    rng = np.random.default_rng(5)
    real = replace(rig, elements=(PeriodicForce(1.37, 3.0, 0.05, 0.3),))
    record = record_of(real, np.repeat(rng.normal(size=30), 10)[None], rng)
    data = FitData((record,), np.full(4, NOISE))
    places = (np.arange(50) + 0.5) / 25
    forces = PROCESS_NOISE * data.force_rms * np.sqrt(np.mean(rig.modes.phi(places) ** 2, axis=0))
    kalman = force_filter(sampled_model(rig.modes, rig.sensors, data.noise, DT), np.eye(6), forces**2)
    expected = whiten(kalman, data.residual(rig).reshape(4, -1) * NOISE)
    np.testing.assert_allclose(data.one_step_ahead(rig).residual(rig).reshape(4, -1), expected, atol=1e-6)
    assert np.std(expected) > 2.0  # so that more than noise was compared


def test_predictions_ahead_lead_to_a_spring_beside_which_motions_run_apart(rig, measured):
    data = measured(replace(rig, elements=(CubicSpring(0.62, 4e4),)), level=0.5)
    away = (Effect(CUBIC, None, {"at": 0.56, "stiffness": 2.8e4}),)
    lost = fit(rig, away, data, iterations=30)
    ahead = fit(rig, away, data.one_step_ahead(rig), iterations=15)
    found = fit(rig, ahead.effects, data.stepped(8), iterations=15)
    assert lost.cost > 1e4 and found.cost < 1.02
    assert found.effects[0].values["at"] == pytest.approx(0.62, abs=1e-4)
    assert found.effects[0].values["stiffness"] == pytest.approx(4e4, rel=1e-3)


def test_a_number_comes_back_from_its_bound(rig, measured):
    data = measured(LOSS.apply(rig, None, {"at": 1.2, "width": 0.33, "loss": 0.05}))
    # a fit from the narrow side overshoots to the widest loss there may be
    found = fit(rig, (Effect(LOSS, None, {"at": 1.3, "width": 0.4, "loss": 0.03}),), data, iterations=20)
    values, spread = found.effects[0].values, found.effects[0].std
    assert found.cost < 1.02
    assert values["at"] == pytest.approx(1.2, abs=4 * spread["at"] + 1e-4)
    assert values["width"] == pytest.approx(0.33, abs=4 * spread["width"])


def test_a_local_loss_stays_on_the_structure(rig):
    softened = LOSS.apply(rig, None, {"at": 0.11, "width": 0.2, "loss": 0.1})
    assert softened.modes.omega[0] < rig.modes.omega[0]
    with pytest.raises(ValueError, match="beyond the structure"):
        LOSS.apply(rig, None, {"at": 0.09, "width": 0.2, "loss": 0.1})


def test_a_spring_beside_a_hinge_is_a_hinge_that_resists_turning(rig):
    (left,) = simpler_forms(Effect(SPRING, None, {"at": 0.05, "stiffness": 400.0}), rig)
    (right,) = simpler_forms(Effect(SPRING, None, {"at": 1.95, "stiffness": 400.0}), rig)
    assert (left.target, right.target) == ("left", "right")
    assert left.values["rotational_stiffness"] == pytest.approx(400.0 * 0.05**2)
    spring = SPRING.apply(rig, None, {"at": 0.01, "stiffness": 1e4}).modes.omega
    turning = left.kind.apply(rig, "left", {"rotational_stiffness": 1.0}).modes.omega
    assert spring[:3] == pytest.approx(turning[:3], rel=2e-3) and turning[0] > 1.01 * rig.modes.omega[0]
    assert simpler_forms(Effect(SPRING, None, {"at": 1.0, "stiffness": 400.0}), rig) == ()


def test_two_effects_of_one_kind_may_be_one():
    first, second = (Effect(CUBIC, None, {"at": at, "stiffness": 1.0}) for at in (0.5, 0.9))
    other = Effect(SPRING, None, {"at": 1.2, "stiffness": 2.0})
    sets = list(with_two_as_one((first, other, second)))
    assert [s[0] for s in sets] == [other] * 3
    assert sorted(s[1].values["at"] for s in sets) == pytest.approx([0.5, 0.7, 0.9])
    assert not list(with_two_as_one((first, other)))


def test_friction_and_a_constant_force_are_friction_that_differs_between_the_directions(rig):
    """Motion for motion, where the actuator stands where the friction acts; number for number."""
    drive = rig.actuators[0]
    friction = Effect(kind_named("coulomb_friction"), None, {"at": drive.at, "force": 0.02, "smoothing_speed": 1e-3})
    bias = Effect(kind_named("actuator_bias"), drive.name, {"force": 0.006})
    other = Effect(SPRING, None, {"at": 1.2, "stiffness": 2.0})
    ((kept, merged),) = merged_sets((bias, friction, other))
    assert kept is other and merged.kind.name == "two_way_friction"
    commands = np.repeat(np.random.default_rng(2).normal(size=(len(rig.actuators), 60)), 5, axis=1)
    apart, one = (
        simulate(apply_all(rig, effects), commands, sample_time=DT, substeps=64).outputs
        for effects in ((friction, bias), (merged,))
    )
    assert one == pytest.approx(apart, abs=1e-3 * np.abs(apart).max())
    assert not list(merged_sets((friction, replace(bias, values={"force": 0.03}))))


def test_a_tone_is_no_random_force():
    time = DT * np.arange(2000)
    noise = np.random.default_rng(0).normal(size=2000)
    slow = np.convolve(noise, np.exp(-np.arange(400) / 80.0), "same")
    assert tonal(np.sin(2 * np.pi * 0.33 * time + 1.0) + 0.1 * noise, DT) > 0.95
    assert tonal(noise, DT) < 0.1 and tonal(slow, DT) < 0.6


class Found:
    noise_ratio = 1.0

    def __init__(self, *kinds):
        self.best = type("Fit", (), {"effects": tuple(Effect(kind_named(k), None, {}) for k in kinds)})


def test_a_set_must_hold_on_records_it_has_not_seen():
    def held_out(after, overall):
        return Shrinkage({"v": 0.5}, {"v": after}, {"v": 0.01}, {"v": overall}, overall, (overall, overall))

    assert _over_fits(Found("cubic_spring"), held_out(0.12, 0.77))
    assert not _over_fits(Found("cubic_spring"), held_out(0.02, 0.97))
    assert not _over_fits(Found("cubic_spring"), held_out(0.0102, 0.8)), "what is left is noise"
    assert not _over_fits(Found("random_disturbance"), held_out(0.3, 0.1)), "no prediction can hold it"
    assert not _over_fits(Found("cubic_spring"), None)
    assert not _over_fits(Found("cubic_spring"), held_out(0.12, 0.77), beyond=0.12**2), "noise of the inputs is"


@pytest.mark.parametrize(
    ("stiffness", "after", "beyond", "much"),
    [
        (0.01, 0.3, 0.0, False),
        (0.2, 0.3, 0.0, True),
        (0.2, 0.02, 0.0, False),
        (0.2, 0.3, 0.3**2, False),
    ],
)
def test_errors_that_no_model_has_explain_nothing_where_they_leave_far_more_than_noise(
    rig, stiffness, after, beyond, much
):
    errors = nominal_errors(rig, NominalPrior(stiffness=0.02), {"stiffness_0": stiffness})
    errors = replace(errors, values={"stiffness_0": stiffness})
    load = Effect(kind_named("axial_load"), None, {"tension": -1.0})
    found = SimpleNamespace(outcome="explained", best=SimpleNamespace(effects=(load, errors)))
    shrinkage = Shrinkage({"v": 1.7}, {"v": after}, {"v": 0.01}, {"v": 0.82}, 0.82, (0.8, 0.9))
    assert _leaves_far_more_than_noise(found, shrinkage, np.array([beyond])) == much


def test_a_note_says_which_errors_are_larger_than_those_of_a_careful_test(rig):
    prior = NominalPrior(damping=0.25, gain=0.02)
    small = nominal_errors(rig, prior, {"damping_1": 0.2, "gain_at_d1": 0.01})
    large = replace(small, values={name: 0.43 if "damping" in name else 0.01 for name in small.values})
    assert not [*_of_large_errors(small), *_of_large_errors(None)]
    (note,) = _of_large_errors(large)
    assert "in damping are larger than those of a careful test" in note and "a damper" in note


def _of(problem):
    """Slopes by this process alone."""
    return lambda moves: [problem.slope(move) for move in moves]


@pytest.mark.parametrize("swapped", [False, True])
def test_numbers_of_different_sensors_are_moved_at_once_where_each_alters_its_own_readings(rig, measured, swapped):
    """Slopes are those of one number at a time, but for the last digit of what is divided by a step."""
    data = measured(rig)
    prior = NominalPrior(frequency=0.005, delay=0.1, gain=0.01, shape=0.01, sample_time=DT)
    exchange = Effect(kind_named("swapped_outputs"), ("d1", "d3"), {})
    effects = (*([exchange] if swapped else []), nominal_errors(rig, prior))
    together = _Problem(rig, effects, data)
    alone = _Problem(rig, effects, data)
    alone._groups_of_sensors = lambda indices: []
    assert bool(together._groups_of_sensors(range(20))) != swapped
    start = together.residual(together.start)
    one, other = (each.jacobian(each.start, start, False, _of(each)) for each in (together, alone))
    np.testing.assert_allclose(one, other, atol=1e-12 / min(together.steps) * np.abs(start).max())


def test_slopes_along_believed_numbers_are_kept_and_others_taken_anew(rig, measured):
    data = measured(rig)
    effects = (Effect(CUBIC, None, {"at": 0.8, "stiffness": 400.0}), nominal_errors(rig, NominalPrior(gain=0.01)))
    chord = _Problem(rig, effects, data, chord=Chord())
    residual = chord.residual(chord.start)
    first = chord.jacobian(chord.start, residual, False, _of(chord)).copy()
    np.testing.assert_allclose(chord.normal(first), first.T @ first)
    moved = chord.start + 0.01 * (np.arange(chord.start.size) < 2)
    second = chord.jacobian(moved, chord.residual(moved), False, _of(chord))
    np.testing.assert_array_equal(second[:, chord.with_prior], first[:, chord.with_prior])
    assert np.abs(second[:, :2] - first[:, :2]).max() > 1e-6 * np.abs(first[:, :2]).max()
    np.testing.assert_allclose(chord.normal(second), second.T @ second, rtol=1e-9, atol=1e-6)


def test_a_fit_keeps_the_slopes_along_believed_numbers_of_the_one_before(rig, measured):
    """Of residuals that are weighed otherwise too; the next fit asks for fewer, and comes to the same."""
    data = measured(rig).tempered(4.0)
    effects = (Effect(CUBIC, None, {"at": 0.8, "stiffness": 400.0}), nominal_errors(rig, NominalPrior(gain=0.01)))
    chord = Chord()
    fit(rig, effects, data, iterations=1, chord=chord)
    _, along = slopes(rig, effects, data.tempered(1.0))
    np.testing.assert_allclose(chord.columns, along[:, 2:], atol=1e-4 * np.abs(along).max())
    problem = _Problem(rig, effects, data, chord=chord)
    residual, moves = problem.residual(problem.start), []
    share = _of(problem)
    kept = problem.jacobian(problem.start, residual, False, lambda each: moves.extend(each) or share(each)).copy()
    assert sorted(j for move in moves for j in move.indices) == [0, 1]
    fresh = _Problem(rig, effects, data)
    taken = fresh.jacobian(fresh.start, residual, False, _of(fresh))
    np.testing.assert_allclose(kept, taken, atol=1e-4 * np.abs(taken).max())
