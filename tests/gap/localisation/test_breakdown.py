"""Where a gap lies, on gaps put in by hand: a tone on a late stretch of one sensor, a force that nobody modelled."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.effects.catalogue import kind_named
from workbench.gap.localisation import force_lines
from workbench.gap.localisation.breakdown import break_down
from workbench.gap.localisation.force_lines import lines_of
from workbench.gap.localisation.force_location import locate_force
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.unmodelled_force import sampled_model
from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.elements import AirDrag, Clearance, CoulombFriction, CubicSpring, LinearDamper, PeriodicForce
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes

DT, SAMPLES, NOISE = 0.01, 2000, 1e-5


@pytest.fixture(scope="module")
def rig(hinged_rig):
    return hinged_rig()


@pytest.fixture(scope="module")
def measured(record_of):
    def make(real, name, level, seed):
        rng = np.random.default_rng(seed)
        return record_of(real, np.repeat(level * rng.normal(size=SAMPLES // 10), 10)[None], rng, name=name)

    return make


def reconstruction(rig, records):
    return ForceReconstruction.of(rig, FitData(tuple(records), np.full(len(rig.sensors), NOISE)))


def where(rig, records, faulty=()):
    found = reconstruction(rig, records)
    return break_down(found, (), locate_force(found.without(faulty)))


def placed_by(rig, records):
    return locate_force(reconstruction(rig, records))


def test_a_tone_on_one_sensor_late_in_one_record(rig, measured):
    quiet, loud = measured(rig, "quiet", 0.1, 0), measured(rig, "loud", 1.0, 1)
    tone = 0.05 * loud.outputs[2].std() * np.sin(2 * np.pi * 20.0 * loud.time) * (loud.time > 7 / 8 * loud.time[-1])
    loud = replace(loud, outputs=loud.outputs + np.array([[0.0], [0.0], [1.0], [0.0]]) * tone)
    found = where(rig, (quiet, loud))
    assert found.sensor_shares[2] > 0.99 and found.path == "sensor"
    inside = (found.band_edges_hz[:-1] <= 20.0) & (found.band_edges_hz[1:] > 20.0)
    assert inside.sum() == 1 and found.band_shares[inside][0] > 0.95
    assert found.band_shares.sum() == pytest.approx(1.0)
    assert found.mode_shares.sum() + found.share_above == pytest.approx(1.0)
    assert found.time_shares[1].argmax() == 7 and found.time_shares[1, 7] > 0.9
    assert found.linear_share < 0.2
    assert found.record_gaps[1] > 10 * NOISE / loud.outputs.std()


def test_a_record_at_rest_that_a_coarse_converter_reads_as_zero_has_no_gap_and_spoils_no_share(rig, measured):
    louder = replace(rig, actuators=tuple(replace(a, gain=1.3) for a in rig.actuators))
    gap = measured(louder, "gap", 0.3, 2)
    rest = replace(gap, name="rest", inputs=0.0 * gap.inputs, outputs=0.0 * gap.outputs)
    found, alone = where(rig, [gap, rest]), where(rig, [gap])
    assert found.record_gaps[1] == 0.0 and not found.time_shares[1].any()
    assert found.mode_shares == pytest.approx(alone.mode_shares) and found.beyond_noise == alone.beyond_noise
    nothing = where(rig, [rest])
    assert nothing.linear_share == 0.0 and np.isfinite(nothing.sensor_shares).all() and nothing.beyond_noise == 0.0


def test_a_force_that_nobody_modelled_is_placed_before_any_effect_is_guessed(rig, measured):
    frequency = 1.1 * rig.modes.frequencies_hz[1]
    real = replace(rig, elements=(PeriodicForce(1.37, frequency, 0.05, 0.3),))
    found = where(rig, [measured(real, str(seed), 0.3, seed) for seed in (2, 3)])
    assert abs(found.at - 1.37) < min(0.005 * rig.modes.length, 4.0 * found.at_std)
    assert found.at_std < 0.005 * rig.modes.length
    assert 2 in found.modes and found.place.is_single_force and found.place.share > 0.999
    assert found.path == "structure" and found.linear_share < 0.1


def at_rates(rig, real, sample_times, quantities):
    """One record a sample time, of 20 s, with forces held over 0.1 s."""
    for dt in sample_times:
        rng = np.random.default_rng(round(1 / dt))
        inputs = np.repeat(0.3 * rng.normal(size=200), round(0.1 / dt))[None]
        clean = simulate(real, inputs, sample_time=dt).outputs
        force, *read = (
            Channel(p.name, q, at=p.at) for p, q in zip((*rig.actuators, *rig.sensors), quantities, strict=True)
        )
        outputs = clean + NOISE * rng.normal(size=clean.shape)
        yield Record(dt, outputs, tuple(read), inputs=inputs, input_channels=(force,), name=f"{dt}")


@pytest.mark.parametrize("sample_times", [(0.01, 0.0025), (0.0025, 0.01)])
def test_records_of_different_sample_rates_place_a_force_together(rig, sample_times):
    quantities = ("force", *(sensor.quantity for sensor in rig.sensors))
    real = replace(rig, elements=(CubicSpring(1.37, 3000.0),))
    seen = reconstruction(rig, list(at_rates(rig, real, sample_times, quantities)))
    found, there = locate_force(seen), seen.place(1.37)
    assert abs(found.at - 1.37) < min(0.01 * rig.modes.length, 4.0 * found.at_std) and found.is_single_force
    assert there.strength_along(there.displacement**3) == pytest.approx(3000.0, rel=0.2)
    slower = replace(seen.data.records[0], sample_time=(1.0 + 1e-8) * sample_times[0])
    assert reconstruction(rig, [*seen.data.records, slower]).sample_times == (*sample_times, sample_times[0])
    shaken = replace(rig, elements=(PeriodicForce(1.37, 1.3, 0.05, 0.3),))
    start, *_ = kind_named("periodic_disturbance").starts(
        reconstruction(rig, list(at_rates(rig, shaken, sample_times, quantities))), None
    )
    assert start["frequency"] == pytest.approx(1.3, rel=0.01) and start["amplitude"] == pytest.approx(0.05, rel=0.2)


@pytest.mark.slow
def test_a_force_is_placed_without_the_sensor_that_is_at_fault(rig, measured):
    faulty = rig.sensors[1]
    sensors = tuple(replace(s, gain=-1.0) if s is faulty else s for s in rig.sensors)
    real = replace(rig, elements=(PeriodicForce(1.37, 1.1 * rig.modes.frequencies_hz[1], 0.05, 0.3),), sensors=sensors)
    records = [measured(real, str(seed), 0.3, seed) for seed in (2, 3)]
    misled, found = where(rig, records), where(rig, records, faulty=[faulty.name])
    assert abs(misled.at - 1.37) > 0.02 * rig.modes.length
    assert abs(found.at - 1.37) < min(0.005 * rig.modes.length, 4.0 * found.at_std)
    assert (
        found.place.is_single_force
        and not misled.place.is_single_force
        and found.sensor_shares[1] == misled.sensor_shares[1]
    )


@pytest.mark.slow  # that single places lie within four deviations is tried by others here
@pytest.mark.parametrize(
    "law",
    [
        CoulombFriction(1.37, 0.02, 0.005),
        CubicSpring(1.37, 300.0),
        Clearance(1.37, 1.0, 0.01),
        LinearDamper(1.37, 0.02),
    ],
    ids=lambda law: type(law).__name__,
)
def test_the_deviation_of_a_place_is_true(rig, measured, law):
    real = replace(rig, elements=(law,))
    places = [placed_by(rig, [measured(real, str(s), 0.3, s) for s in (seed, seed + 100)]) for seed in range(10)]
    z = np.array([(place.at - 1.37) / place.at_std for place in places])
    assert all(place.is_single_force for place in places)
    assert 0.4 < np.sqrt(np.mean(z**2)) < 2.0 and np.abs(z).max() < 4.0


@pytest.mark.parametrize("elsewhere", [CubicSpring(0.5, 300.0), AirDrag(1.0)], ids=lambda law: type(law).__name__)
def test_a_gap_that_is_not_of_one_force_is_not_placed(rig, measured, elsewhere):
    real = replace(rig, elements=(CubicSpring(1.37, 300.0), elsewhere))
    place = placed_by(rig, [measured(real, str(seed), 0.3, seed) for seed in (2, 3)])
    assert not place.is_single_force


@pytest.mark.slow
def test_a_long_record_is_placed_by_some_of_its_lines(rig, measured, monkeypatch):
    real = replace(rig, elements=(CubicSpring(1.37, 300.0),))
    records = [measured(real, str(seed), 0.3, seed) for seed in (2, 3)]
    every = placed_by(rig, records)
    monkeypatch.setattr(force_lines, "LINES", replace(force_lines.LINES, max_lines=300))
    fewer = placed_by(rig, records)
    assert fewer.is_single_force and every.at_std < fewer.at_std < 8.0 * every.at_std
    assert abs(fewer.at - 1.37) < 4.0 * fewer.at_std


def test_a_force_far_above_the_noise_has_all_of_its_lines(rig, measured):
    record = measured(replace(rig, elements=(CubicSpring(0.7, 1e5),)), "loud", 3.0, 0)
    found = reconstruction(rig, (record,))
    (lines,) = lines_of(rig, found.model, found.residuals, DT)
    share = replace(lines, left=1e9 * lines.left).force_share(rig.modes.phi_at(0.7))
    assert share.max() == pytest.approx(1.0) and (share >= 0).all()


def test_no_gap_tells_no_place(rig, measured):
    place = placed_by(rig, [measured(rig, str(seed), 0.3, seed) for seed in (2, 3)])
    assert place.is_single_force is None and place.share == 0.0


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 4, 6, 8))])
def test_short_records_of_one_force_are_of_one_force(rig, measured, seed):
    real = replace(rig, elements=(CubicSpring(1.37, 3000.0),))
    records = [measured(real, str(s), 1.0, s) for s in (seed, seed + 1)]
    assert placed_by(rig, [record.between(0.0, 4.0) for record in records]).is_single_force


def test_an_undamped_mode_on_a_line_is_no_obstacle(rig):
    still = replace(rig, modes=replace(rig.structure, damping=ModalDamping(0.0)).modes(6))
    dt = 2.0 * np.pi * 3.0 / (still.modes.omega[0] * 400)
    model = sampled_model(still.modes, still.sensors, np.full(4, NOISE), dt)
    (lines,) = lines_of(still, model, [np.full((4, 400), NOISE)], dt)
    assert np.isfinite(lines.misfit(still.modes.phi(1.37)[0]))


def test_a_sensor_that_lags_misleads_no_place(rig, measured):
    sensors = (replace(rig.sensors[0], time_constant=0.01), *rig.sensors[1:])
    known, real = replace(rig, sensors=sensors), replace(rig, sensors=sensors, elements=(CubicSpring(1.37, 3000.0),))
    place = placed_by(known, [measured(real, str(seed), 0.3, seed) for seed in (2, 3)])
    assert place.is_single_force and abs(place.at - 1.37) < 4.0 * place.at_std


def test_one_sensor_tells_no_place(rig, measured):
    real = replace(rig, elements=(CubicSpring(1.37, 300.0),))
    records = [measured(real, str(seed), 0.3, seed).select_outputs(("d2",)) for seed in (2, 3)]
    place = placed_by(replace(rig, sensors=rig.sensors[1:2]), records)
    assert place.is_single_force is None and place.at_std > 0.2 * rig.modes.length


def test_no_gap_has_no_path(rig, measured):
    found = where(rig, [measured(rig, "a", 0.3, 4)])
    assert found.path == "none"


@pytest.mark.parametrize(
    "changed, low, high",
    [
        ({"actuators": (Actuator("F", 0.45, gain=1.2),)}, 0.95, 1.0),
        ({"actuators": (Actuator("F", 0.52),)}, 0.95, 1.0),
        ({"elements": (CoulombFriction(0.9, 0.05, 0.005),)}, 0.0, 0.6),
    ],
)
def test_a_linear_gap_is_told_from_one_that_depends_on_level(rig, changed, low, high, measured):
    real = replace(rig, **changed)
    found = where(rig, [measured(real, f"{level}", level, seed) for seed, level in enumerate((0.1, 0.3, 1.0))])
    assert low <= found.linear_share <= high


@pytest.mark.filterwarnings("error")
def test_a_record_of_noise_alone_says_nothing_of_where_a_gap_is(rig, measured):
    """A gain of 1.1 of the third sensor; a quiet record, scaled by itself, would count by its noise."""
    real = kind_named("sensor_gain").apply(rig, "d3", {"gain": 1.1})
    driven, quiet = measured(real, "driven", 1.0, 0), measured(real, "quiet", 0.0, 1)
    alone, beside = where(rig, (driven,)), where(rig, (driven, quiet))
    assert beside.sensor_shares[2] > 0.99 and beside.modes == alone.modes
    np.testing.assert_array_equal(beside.band_shares, alone.band_shares)
    assert beside.linear_share == alone.linear_share > 0.9


@pytest.mark.filterwarnings("error")
def test_no_reply_is_learnt_where_no_other_record_has_inputs(rig, measured):
    driven, free = measured(rig, "driven", 1.0, 0), measured(rig, "free", 0.0, 1)
    disturbed = replace(free, outputs=1e-3 * np.sin(2 * np.pi * 3.0 * free.time) * np.ones((4, 1)) + free.outputs)
    biased = replace(driven, outputs=1.1 * driven.outputs)
    assert 0.0 <= where(rig, (biased, disturbed)).linear_share <= 1.0


def test_a_gap_above_the_last_mode_is_of_no_mode(hinged_rig, measured):
    """Modes 3 and 4 of the real beam are at 9 and 16 times the first, the model has two."""
    found = where(hinged_rig(2), [measured(hinged_rig(4), str(level), level, 3) for level in (0.1, 1.0)])
    assert found.share_above > 0.9
    assert found.mode_shares.sum() + found.share_above == pytest.approx(1.0)


def test_a_drift_of_a_free_structure_is_of_its_rigid_modes():
    """Of two rigid modes and one of 2 Hz: a force of 0.1 Hz that is a fifth larger moves the rigid ones alone."""
    shapes, omega = np.array([[1.0, -1.0, 0.2], [1.0, 0.3, -0.3], [1.0, 1.0, 0.2]]), 2.0 * np.pi * np.array([0, 0, 2.0])
    modes = Modes(omega, np.array([0.0, 0.0, 0.02]), PointShapes(shapes), NamedPoints(("a", "b", "c")))
    sensors = tuple(Sensor(f"d{at}", at, noise_std=NOISE) for at in "abc")
    rig = Rig(modes, (Actuator("F", "a"),), sensors)
    inputs = np.sin(2.0 * np.pi * 0.1 * DT * np.arange(SAMPLES))[None]
    outputs = simulate(replace(rig, actuators=(Actuator("F", "a", gain=1.2),)), inputs, sample_time=DT).outputs
    channels = tuple(Channel(s.name, s.quantity) for s in sensors)
    found = where(rig, [Record(DT, outputs, channels, inputs, (Channel("F"),), name="slow")])
    assert found.modes == (1, 2) and found.mode_shares[0] == found.mode_shares[1] > 0.49
    assert found.mode_shares.sum() + found.share_above == pytest.approx(1.0)


PERIOD, PERIODS = 1000, 5


@pytest.fixture(scope="module")
def repeated(record_of):
    """A record of a multisine on odd lines from 0.5 to 15 Hz, two in five of them left out."""

    def make(real, level, seed):
        rng = np.random.default_rng(seed)
        lines = np.arange(5, 150, 2)
        phases = np.where(rng.random(lines.size) < 0.6, rng.uniform(0.0, 2.0 * np.pi, lines.size), np.nan)
        time = DT * np.arange(PERIOD)
        each = np.cos(2.0 * np.pi * lines[:, None] * time / (DT * PERIOD) + phases[:, None])
        sent = np.tile(np.nansum(each, axis=0), PERIODS)[None]
        return record_of(real, level * sent / sent.std(), rng, name=f"{level:g}")

    return make


def damped(rig, ratio):
    structure = replace(rig.structure, damping=ModalDamping(ratio))
    return replace(rig, structure=structure, modes=structure.modes(rig.modes.n_modes))


def test_periodic_inputs_show_an_odd_law_at_levels_that_are_alike(hinged_rig, repeated):
    """A cubic spring answers odd lines on odd lines: the even ones hold noise."""
    rig = damped(hinged_rig(3), 0.05)
    real = replace(rig, elements=(CubicSpring(1.37, 3000.0),))
    found = where(rig, [repeated(real, 3.0, seed) for seed in (1, 2)])
    odd, even = found.distortions.max(axis=0)
    assert odd > 100.0 and even < 10.0 and found.is_distorted and found.amplitude_dependent is True


@pytest.mark.parametrize("damping", [0.01, 0.0005])
def test_periodic_inputs_show_no_law_where_a_linear_gap_has_not_settled(hinged_rig, repeated, damping):
    """The first mode loses 47 % in a period, or 3 %: what remains of the start stands on all lines."""
    rig = damped(hinged_rig(3), damping)
    real = kind_named("modulus_error").apply(rig, None, {"factor": 1.1})
    found = where(rig, [repeated(real, level, 3) for level in (0.1, 1.0)])
    assert not found.is_distorted and found.amplitude_dependent is not True
