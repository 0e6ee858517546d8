"""What sets of effects can come to, screened by how predictions one sample ahead move with each."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from workbench.gap.effects.catalogue import CATALOGUE, kind_named
from workbench.gap.effects.effect import Effect, can_be, nearest_possible
from workbench.gap.effects.nominal import NominalPrior, nominal_errors
from workbench.gap.effects.structural import buckling_load
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.prediction.innovations import Observer
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE
from workbench.gap.report.budget import DIVERGED, residual_powers
from workbench.gap.search.fit import Fit, fit, slopes
from workbench.gap.search.jointly import fit_from_zero
from workbench.gap.search.pairs import Pairs, _reconstruction_with
from workbench.gap.search.screening import Screening, _starts, fitted_ahead, one_more
from workbench.gap.search.search import Search
from workbench.gap.search.settings import SELECTION
from workbench.gap.search.stepwise import Stepwise
from workbench.rig.elements import CubicSpring
from workbench.rig.simulate import prediction_errors
from workbench.structure.domain import Interval

NOISE, DT = 1e-5, 0.01
CLEARANCE, GAIN, SPRING = (kind_named(name) for name in ("clearance", "sensor_gain", "ground_spring"))


@pytest.fixture(scope="module")
def rig(hinged_rig):
    return hinged_rig()


@pytest.fixture(scope="module")
def search(rig, record_of):
    """Beside a stiff cubic spring and a sensor that reads too little, in two records."""
    real = replace(rig, elements=(CubicSpring(0.62, 3000.0),))
    real = GAIN.apply(real, "d3", {"gain": 0.8})
    records = []
    for seed, level in ((0, 0.2), (1, 1.0)):
        rng = np.random.default_rng(seed)
        command = level * np.repeat(rng.normal(size=100), 10)[None]
        records.append(record_of(real, command, rng, name=str(level), substeps=8))
    data = FitData(tuple(records), np.full(4, NOISE))
    quick = data.stepped(2)
    nominal = data.by_channel(data.residual(rig))
    return Search(rig, data, quick, quick.only(("1.0",)), CATALOGUE, lambda text, share: None, ALONE, nominal)


def test_a_load_that_only_a_stiffer_beam_bears_ends_no_search(rig, search):
    """Beside errors of the stiffness it was fitted; without them, or with weaker ones, the beam would buckle."""
    load = Effect(kind_named("axial_load"), None, {"tension": -1.05 * buckling_load(rig)})
    errors = nominal_errors(rig, NominalPrior(stiffness=0.02), {"stiffness_0": 0.1})
    assert can_be(rig, (load, errors)) and not can_be(rig, (load,))
    (weaker,) = nearest_possible(rig, (load,))
    assert can_be(rig, (weaker,)) and -1.0 < weaker.values["tension"] / buckling_load(rig) < -0.9
    assert nearest_possible(rig, (load,), (errors,))[0].values == load.values
    assert _starts(replace(search, held=(errors,)), (load,), ForceReconstruction.of(rig, search.data))
    assert list(residual_powers(rig, (load,), search.data.records[:1], 0.0)) == [DIVERGED]
    linear = replace(search, data=search.first.stepped(1), quick=search.first.stepped(1), by_mode=True)
    assert np.isfinite(fit_from_zero(Stepwise(linear).search, (load,)).fit.cost)


def screened(n_starts: int, seed: int) -> Screening:
    rng = np.random.default_rng(seed)
    starts = tuple(Effect(CLEARANCE, None, {"at": float(i)}) for i in range(n_starts))
    moves = rng.normal(size=(n_starts, 40))
    least = np.where(rng.random(n_starts) < 0.3, -30.0, 0.03)
    return Screening(starts, moves, 3.0 * rng.normal(size=40), least, np.full(n_starts, 30.0), domain=Interval(1.0))


def test_what_two_effects_come_to_is_least_squares_within_bounds():
    one = screened(12, 3)
    costs = one._pair_costs()
    for i in range(12):
        for j in range(i):
            ends = one.least[[i, j]], one.most[[i, j]]
            best = lsq_linear(one.moves[[i, j]].T, -one.left, ends)
            expected = 2.0 * best.cost - one.left @ one.left
            assert costs[i, j] == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_both_halves_of_a_pair_are_found_at_once(rig, search):
    reconstruction = ForceReconstruction.of(rig, search.data)
    best = fitted_ahead(search, Screening.of(search, (), reconstruction).likeliest_pairs(SELECTION.fits_to_one_record))[
        0
    ]
    named = {effect.label: effect.values for effect in best.effects}
    assert set(named) == {"cubic_spring", "sensor_gain[d3]"} and best.cost < 1.05
    assert named["cubic_spring"]["at"] == pytest.approx(0.62, abs=1e-3)
    assert named["sensor_gain[d3]"]["gain"] == pytest.approx(0.8, abs=1e-3)


@pytest.mark.slow
def test_what_the_numbers_of_a_given_effect_make_up_for_is_no_move(rig, search):
    given = (Effect(kind_named("cubic_spring"), None, {"at": 0.62, "stiffness": 2000.0}),)
    reconstruction = ForceReconstruction.of(given[0].apply(rig), search.data, 20)
    found = Screening.of(search, given, reconstruction)
    along = slopes(rig, given, search.first_ahead)[1]
    assert np.abs(found.left @ along).max() < 1e-6 * np.linalg.norm(found.left) * np.linalg.norm(along)
    assert found.likeliest()[0].label == "sensor_gain[d3]"
    best = one_more(search, given, reconstruction, found)[0]
    assert best.labels == ("cubic_spring", "sensor_gain[d3]") and best.cost < 1.05
    assert best.effects[0].values["stiffness"] == pytest.approx(3000.0, rel=1e-2)


def test_errors_ahead_of_a_linear_rig_are_those_of_steps_through_time(rig, record_of):
    """A linear rig is set right in closed form, by what its errors over the whole record leave of themselves."""
    rng = np.random.default_rng(2)
    record = record_of(rig, np.repeat(rng.normal(size=40), 10)[None], rng)
    observer = Observer.of(rig, np.full(4, NOISE), 1.0, [DT])
    softer = kind_named("modulus_error").apply(rig, None, {"factor": 0.9})
    for other in (softer, GAIN.apply(softer, "d2", {"gain": 1.3})):
        data = FitData((record,), np.full(4, NOISE))
        ahead = observer.innovations_of_linear(other, data.residual(other).reshape(4, -1) * NOISE, DT, 1)
        gain, inputs, outputs = observer.gains[DT], record.inputs, record.outputs
        stepped = prediction_errors(other, inputs, outputs, gain, sample_time=DT, substeps=1)
        np.testing.assert_allclose(ahead, observer.whitening[DT] @ stepped, atol=1e-6 * np.abs(ahead).max())


def test_two_of_a_kind_beside_one_another_explain_nothing(search):
    """A law that the catalogue does not hold is a polygon of contacts."""

    def fitted(*places: float) -> Fit:
        contacts = (Effect(CLEARANCE, None, {"at": at, "stiffness": 1.0, "gap": 1e-3}) for at in places)
        return Fit(tuple(contacts), 1.0, np.ones((2, 4)), 6)

    assert search.explains(fitted(0.4, 1.2))
    assert not search.explains(fitted(0.4, 0.5))


def test_a_sensor_that_rounds_coarsely_is_not_heard_beside_a_random_force(search):
    sensors = search.rig.sensors
    steps = (0.0, 10.0 * NOISE, 0.5 * NOISE, 0.0)
    rounded = tuple(replace(sensor, step=step) for sensor, step in zip(sensors, steps, strict=True))
    heard = replace(search, rig=replace(search.rig, sensors=rounded)).without_clipped()
    assert [sensor.name for sensor in heard.rig.sensors] == ["d1", "d3", "d4"]
    assert heard.data.records[0].output_names == ("d1", "d3", "d4")


def test_a_force_is_sought_beside_no_motion_that_runs_away(rig, search):
    """A spring that pushes away is told by predictions one sample ahead; whole records of it alone are none."""
    softening = Effect(kind_named("cubic_spring"), None, {"at": 0.62, "stiffness": -3e5})
    assert _reconstruction_with(search, softening).rig is rig
    hardening = replace(softening, values={"at": 0.62, "stiffness": 2000.0})
    assert _reconstruction_with(search, hardening).rig.elements


@pytest.mark.slow
def test_what_one_half_of_a_wrong_pair_leaves_tells_the_other(search):
    wrong = (
        Effect(SPRING, None, {"at": 0.6, "stiffness": 30.0}),
        Effect(GAIN, "d3", {"gain": 0.85}),
    )
    pairs = Pairs(search)
    pairs.ahead = [fit(search.rig, wrong, search.ahead, iterations=4)]
    assert pairs.ahead[0].cost > SELECTION.max_residual_ahead
    assert pairs.by_exchange()
    found = pairs.found[0]
    assert found.key == ("cubic_spring", "sensor_gain[d3]")
    cubic = next(effect for effect in found.effects if effect.kind.name == "cubic_spring")
    assert cubic.values["at"] == pytest.approx(0.62, abs=1e-3)
    assert cubic.values["stiffness"] == pytest.approx(3000.0, rel=0.01)
