"""Records of trial plants, another numerical route, whose stiffness or axial load differs from record to record."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import CATALOGUE
from workbench.gap.effects.effect import apply_all
from workbench.gap.effects.nominal import TENSION, NominalPrior, group_of, nominal_errors
from workbench.gap.effects.structural import buckling_load
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE
from workbench.gap.report.budget import RecordToRecord, with_held_out
from workbench.gap.search.other_errors import deviations
from workbench.gap.search.search import Search
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.rig.simulate import simulate
from workbench.trials.hidden import hide
from workbench.trials.plant import Plant

NOISE = 1e-5
LEVELS = {"low": 0.1, "mid": 0.5, "high": 1.0, "other": 0.7}
STIFFNESS = {"low": 0.004, "mid": -0.006, "high": 0.003, "other": -0.001}  # relative, of each record
FITTED = ("low", "mid", "high")


@pytest.fixture(scope="module")
def rig(hinged_rig):
    return hinged_rig(n_modes=4)


def measured(rig: Rig, plant: Plant, name: str) -> Record:
    rng = np.random.default_rng(list(LEVELS).index(name))
    inputs = LEVELS[name] * np.repeat(rng.normal(size=300), 5)[None]
    real = plant.solved()
    outputs = real.readings(real.move(inputs, 0.01)[0], 0.01, rng)
    return rig.record(inputs, outputs, sample_time=0.01, name=name)


def of_stiffness(rig: Rig, name: str, effects=()) -> Record:
    plant = Plant.of(rig)
    plant = replace(plant, altered=replace(plant.altered, stiffness_factor=1.0 + STIFFNESS[name]))
    return measured(rig, hide(plant, list(effects)), name)


def search_of(rig: Rig, records) -> Search:
    data = FitData(tuple(records), np.full(len(rig.sensors), NOISE))
    return Search(
        rig, data, data, data, CATALOGUE, lambda text, share: None, ALONE, data.by_channel(data.residual(rig))
    )


def about_their_mean(values) -> np.ndarray:
    found = np.array([*values])
    return found - found.mean()


def test_each_record_tells_its_own_stiffness(rig):
    search = search_of(rig, [of_stiffness(rig, name) for name in FITTED])
    found = deviations(search, (), "stiffness")
    expected = about_their_mean(STIFFNESS[name] for name in FITTED)
    np.testing.assert_allclose(found.values, expected, atol=3e-4)
    assert found.is_sure and found.left < 0.02 * found.in_common


def test_each_record_tells_its_own_axial_load(rig):
    """And all stiffness stands for it badly: tension raises low frequencies more than high ones."""
    share = {"low": 0.012, "mid": -0.008, "high": 0.0}
    records = []
    for name in FITTED:
        plant = Plant.of(rig)
        tension = share[name] * buckling_load(rig)
        records.append(measured(rig, replace(plant, altered=replace(plant.altered, tension=tension)), name))
    search = search_of(rig, records)
    found = deviations(search, (), "axial load")
    np.testing.assert_allclose(found.values, about_their_mean(share.values()), atol=8e-4)
    assert found.left < 0.1 * deviations(search, (), "stiffness").left


def test_a_beam_free_at_both_ends_bears_no_compression(rig):
    free = replace(rig.structure, left="free", right="free")
    loose = replace(rig, structure=free, modes=free.modes(4))
    search = search_of(loose, [measured(loose, Plant.of(loose), name) for name in FITTED])
    assert deviations(search, (), TENSION) is None


def test_records_alike_do_not_ask_for_a_stiffness_each(rig):
    plant = Plant.of(rig)
    plant = replace(plant, altered=replace(plant.altered, stiffness_factor=1.01))
    found = deviations(search_of(rig, [measured(rig, plant, name) for name in FITTED]), (), "stiffness")
    assert np.abs(found.values).max() < 3e-4
    assert found.in_common - found.left < 0.3 * found.in_common


def test_a_record_that_no_fit_has_seen_is_accounted_for_and_not_predicted(rig):
    prior = NominalPrior(record=0.005, records=FITTED)
    errors = nominal_errors(rig, prior, {f"record_{name}": STIFFNESS[name] for name in FITTED})
    (found,) = with_held_out(rig, (errors,), [of_stiffness(rig, name) for name in LEVELS])
    assert found.values["record_other"] == pytest.approx(STIFFNESS["other"], abs=5e-5)
    assert {name: found.values[name] for name in errors.values} == errors.values
    other = of_stiffness(rig, "other")
    assert errors.apply(rig).in_record(other.name).modes.omega == pytest.approx(rig.modes.omega)
    stiffer = found.apply(rig).in_record(other.name).modes.omega / rig.modes.omega
    assert stiffer == pytest.approx(np.sqrt(1.0 + STIFFNESS["other"]), abs=5e-5)


def test_words_say_by_how_much_records_differ_and_which_two_most():
    found = RecordToRecord("stiffness", {"low": 0.004, "mid": -0.006, "high": 0.002})
    assert found.spread == pytest.approx(np.std([0.004, -0.006, 0.002], ddof=1))
    assert found.words == "standard deviation 0.53 %: the structure is 1 % stiffer in record low than in record mid"
    loaded = RecordToRecord("axial load", {"low": 4.0, "mid": -6.0, "high": 2.0})
    assert loaded.words == "standard deviation 5.3 N: the axial load is 10 N higher in record low than in record mid"


@pytest.mark.slow
def test_shapes_that_are_off_by_themselves_do_not_hide_a_stiffness_that_differs(hinged_rig):
    """No profile has the shapes of such modes, and one that bends to them is off by more than any model."""
    nominal = hinged_rig(n_modes=3)
    rng, drawn = np.random.default_rng(2), np.random.default_rng(5)
    prior = NominalPrior(frequency=0.005, shape=0.02, damping=0.2, by_mode=True)
    none = nominal_errors(nominal, prior)
    off = {name: getattr(prior, group_of(name)) * drawn.standard_normal() for name in none.values}
    real = apply_all(nominal, (replace(none, values=off),))
    factors = {"low": 1.0, "mid": 0.985, "high": 0.965, "other": 0.975}

    def of(name):
        inputs = LEVELS[name] * np.repeat(rng.normal(size=200), 5)[None]
        stretched = replace(real, modes=replace(real.modes, omega=real.modes.omega * np.sqrt(factors[name])))
        outputs = simulate(stretched, inputs, sample_time=0.01).outputs
        noisy = outputs + NOISE * rng.normal(size=outputs.shape)
        return nominal.record(inputs, noisy, sample_time=0.01, name=name)

    records = [of(name) for name in factors]
    verdict = diagnose(nominal, records[:3], validation=records[3:], workers=1)
    found = verdict.record_to_record.values
    assert verdict.outcome == "none" and found["low"] - found["high"] == pytest.approx(0.035, abs=0.001)
    assert verdict.budget.effects["stiffness_record_to_record"] > 0.9 and "implausibly" not in verdict.sentence
    assert verdict.budget.errors["shapes_percent"] > 0.5
    assert any("record other was fitted to the record itself" in note for note in verdict.notes)


@pytest.mark.slow
@pytest.mark.parametrize("at", [None, 0.55])
def test_a_hidden_effect_is_named_beside_a_stiffness_that_differs(rig, at):
    """And none where none is hidden; the budget gives the difference between records a share of its own."""
    hidden = [] if at is None else [{"kind": "cubic_spring", "at": at, "stiffness": 300.0}]
    records = [of_stiffness(rig, name, hidden) for name in LEVELS]
    verdict = diagnose(rig, records[:3], validation=records[3:])
    assert [e["kind"] for e in verdict.to_json()["effects"]] == [e["kind"] for e in hidden]
    assert ("varies from record to record" if at is None else "stiffness between records") in verdict.sentence
    assert "the structure is 1 % stiffer in record low than in record mid" in verdict.sentence
    budget = verdict.budget
    assert sum(budget.effects.values()) + budget.nominal + budget.unexplained + budget.noise == pytest.approx(1.0)
    assert budget.unexplained < 0.01 and budget.effects["stiffness_record_to_record"] > 0.001
    found = verdict.record_to_record.values
    expected = about_their_mean(STIFFNESS[name] for name in FITTED)
    np.testing.assert_allclose(about_their_mean(found[name] for name in FITTED), expected, atol=2e-4)
    if at is not None:
        assert verdict.effects[0].at == pytest.approx(at, abs=0.03)
