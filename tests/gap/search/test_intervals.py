"""Deviations of fitted numbers, where what is left is not white."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from workbench.gap.effects.catalogue import CATALOGUE, kind_named
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import NominalPrior, nominal_errors
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE
from workbench.gap.search.fit import fit
from workbench.gap.search.intervals import with_intervals
from workbench.gap.search.jointly import fit_jointly, with_all_errors
from workbench.gap.search.search import Search
from workbench.gap.search.settings import INTERVALS
from workbench.rig.actuators import Actuator
from workbench.rig.elements import CubicSpring
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.domain import NamedPoints
from workbench.structure.member import Bar
from workbench.structure.modes import Modes, PointShapes


def test_a_deviation_is_that_of_fits_that_leave_out_a_block_each(hinged_rig):
    """A gain is a slope by least squares, y = g s + slow noise, and g_b that without block b: Σ (g_b - g)²."""
    rig = hinged_rig(n_modes=4)
    rig = replace(rig, sensors=rig.sensors[:1])
    rng = np.random.default_rng(0)
    clean = simulate(rig, np.repeat(rng.normal(size=240), 5)[None], sample_time=0.01)
    s = clean.outputs[0]
    slow = lfilter([0.02], [1.0, -0.98], rng.normal(size=s.size))
    y = 0.9 * s + 0.05 * s.std() * slow / slow.std()
    noise = np.array([0.05 * s.std()])
    data = FitData((replace(clean, outputs=y[None]),), noise)
    start = Effect(kind_named("sensor_gain"), rig.sensors[0].name, {"gain": 1.0})
    (found,) = with_intervals(rig, fit(rig, (start,), data, tolerance=1e-12), data).effects

    slope = s @ y / (s @ s)
    kept = [np.setdiff1d(np.arange(s.size), block) for block in np.array_split(np.arange(s.size), INTERVALS.blocks)]
    without = np.array([s[k] @ y[k] / (s[k] @ s[k]) for k in kept])
    expected = np.sqrt(((without - slope) ** 2).sum())
    assert found.values["gain"] == pytest.approx(slope, rel=1e-6)
    assert expected > 1.5 * noise[0] / np.sqrt(s @ s)  # white noise of that size would say less
    assert found.std["gain"] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("learnt", [0.01, 2e-5])
@pytest.mark.parametrize("kind", ["actuator_gain", "sensor_gain"])
def test_a_gain_is_known_no_better_than_calibrations_and_is_relative_to_that_of_the_model(hinged_rig, kind, learnt):
    """Errors of calibration of 1 %, beside them a gain 1.8 times that of a model in newton per volt.

    The effect does what such errors would, so that they are learnt to be none is no reason to believe it.
    """
    rig = hinged_rig(n_modes=2)
    rig = replace(rig, actuators=(replace(rig.actuators[0], gain=2e-3),), sensors=rig.sensors[:1])
    transducer = rig.actuators[0] if kind == "actuator_gain" else rig.sensors[0]
    gain = Effect(kind_named(kind), transducer.name, {"gain": 1.8})
    real = apply_all(rig, (gain,))
    assert [p.gain for p in (*real.actuators, *real.sensors)] == pytest.approx(
        [3.6e-3, 1.0] if kind == "actuator_gain" else [2e-3, 1.8]
    )
    rng = np.random.default_rng(0)
    record = simulate(real, np.repeat(rng.normal(size=120), 5)[None], sample_time=0.01)
    data = FitData((record,), 1e-3 * record.outputs.std(axis=1))
    start = replace(gain, values={"gain": 1.5})
    found = fit(rig, (start, nominal_errors(rig, NominalPrior(gain=learnt))), data)
    told = with_intervals(rig, found, data).effects[0]
    assert told.values["gain"] == pytest.approx(1.8, rel=1e-3)
    assert told.std["gain"] == pytest.approx(1.8 * 0.01 * np.sqrt(2.0), rel=0.05)  # of both transducers


def test_a_law_is_known_no_better_than_the_scale_of_the_shapes_at_all_transducers(hinged_rig):
    """Errors of the shapes at all transducers, of standard deviation s: records show the product of input and output.

    Motion (1 + x) times as large, with an input 1 + x times as strong and readings 1 - x times, has the same readings
    if the stiffness of a cubic spring falls by 2 x; the priors of p transducers and m modes know x to s / √(p m).
    """
    rig, stiffness, size = hinged_rig(n_modes=2), 4000.0, 0.05
    law = Effect(kind_named("cubic_spring"), None, {"at": 0.62, "stiffness": stiffness})
    rng = np.random.default_rng(0)
    record = simulate(apply_all(rig, (law,)), np.repeat(rng.normal(size=120), 5)[None], sample_time=0.01)
    data = FitData((record,), 1e-5 * record.outputs.std(axis=1))
    found = fit(rig, (law, nominal_errors(rig, NominalPrior(shape=size))), data)
    told = with_intervals(rig, found, data).effects[0]
    transducers, modes = len(rig.actuators) + len(rig.sensors), rig.modes.n_modes
    assert told.std["stiffness"] == pytest.approx(2.0 * stiffness * size / np.sqrt(transducers * modes), rel=0.05)


@pytest.mark.slow
def test_noise_of_the_inputs_widens_the_interval_of_a_law_as_fits_to_other_draws_of_it_do(hinged_rig):
    """A strong cubic spring: the scatter of its stiffness over fits to records whose inputs were logged anew."""
    nominal = hinged_rig(n_modes=2)
    real = replace(nominal, elements=(CubicSpring(0.3 * nominal.modes.length, 2e5),))
    rng = np.random.default_rng(1)
    clean = simulate(real, np.repeat(rng.normal(size=150), 5)[None], sample_time=0.01, substeps=8)
    noise, share = 1e-4 * clean.outputs.std(axis=1), 0.02
    rms = np.sqrt((clean.inputs**2).mean())
    effect = Effect(kind_named("cubic_spring"), None, {"at": 0.3 * nominal.modes.length, "stiffness": 2e5})

    def fitted(seed):
        draw = np.random.default_rng(seed)
        inputs = clean.inputs + share * rms * draw.standard_normal(clean.inputs.shape)
        outputs = clean.outputs + noise[:, None] * draw.standard_normal(clean.outputs.shape)
        data = FitData((replace(clean, inputs=inputs, outputs=outputs),), noise, substeps=8)
        return fit(nominal, (effect,), data), data

    values = [fitted(seed)[0].effects[0].values["stiffness"] for seed in range(30)]
    found, data = fitted(0)
    told, without = (with_intervals(nominal, found, data, logged=logged) for logged in (share, 0.0))
    deviation = told.effects[0].std["stiffness"]
    assert deviation == pytest.approx(np.std(values), rel=0.5)
    assert deviation > 1.5 * without.effects[0].std["stiffness"]
    free = np.diag(told.covariance) / np.diag(without.covariance)
    assert (free > 1.0 - 1e-9).all() and free.max() > 1.5**2


def test_a_place_where_the_structure_moves_most_is_known_by_the_square_of_the_distance():
    """A mass at the free end of a bar, whose shapes are level there: one deviation inwards the records object by one.

    The tangent, which is none, would leave the place open over the whole bar.
    """
    bar = Bar(length=1.0, mass_per_length=1.0, axial_stiffness=100.0, left="fixed", right="free")
    sensors = (Sensor("d1", 0.4, noise_std=3e-3), Sensor("d2", 0.9, noise_std=3e-3))
    nominal = Rig(bar.modes(4), (Actuator("F", 0.6),), sensors, structure=bar)
    mass = Effect(kind_named("point_mass"), None, {"at": 1.0, "mass": 0.02})
    inputs = np.repeat(np.random.default_rng(0).normal(size=100), 5)[None]
    record = simulate(apply_all(nominal, (mass,)), inputs, sample_time=0.01)
    data = FitData((record,), np.full(2, 3e-3))
    (found,) = with_intervals(nominal, fit(nominal, (mass,), data), data).effects

    def objection(values):
        return np.sum(data.residual(apply_all(nominal, (replace(mass, values=values),))) ** 2)

    inwards = found.values["at"] - found.std["at"]
    best = minimize_scalar(lambda m: objection({"at": inwards, "mass": m}), bracket=(0.019, 0.021))
    assert found.values["at"] == pytest.approx(1.0, abs=1e-4)
    assert 0.01 < found.std["at"] < 0.2
    assert best.fun == pytest.approx(1.0, rel=0.5)


def test_a_spring_is_known_no_better_than_the_mode_shapes_where_it_stands():
    """Of k φ φᵀ no record shows the factor c of k / c² and c φ: of 1 % of two modes each, k has 2 % / √2 at least.

    It stands where there is no transducer. A careful model's shapes may be off by 2.5 %, where the records do not tell.
    """
    points, rng = NamedPoints(("a", "b", "c")), np.random.default_rng(3)
    nominal = np.array([[1.0, 0.8], [0.7, -0.9], [0.9, 0.6]])
    real = nominal * np.array([[1.01, 0.99], [0.99, 1.01], [1.012, 1.012]])

    def rig(shapes):
        modes = Modes(np.array([12.0, 31.0]), np.array([0.02, 0.02]), PointShapes(shapes), points)
        return Rig(modes, (Actuator("F", "a"),), (Sensor("y1", "a", noise_std=1e-5), Sensor("y2", "b", noise_std=1e-5)))

    spring = Effect(kind_named("ground_spring"), None, {"at": "c", "stiffness": 40.0})
    u = np.repeat(rng.normal(size=300), 4)[None]
    record = simulate(apply_all(rig(real), (spring,)), u, sample_time=0.02)
    record = replace(record, outputs=record.outputs + 1e-5 * rng.normal(size=record.outputs.shape))
    data = FitData((record,), np.full(2, 1e-5))
    search = Search(rig(nominal), data, data, data, CATALOGUE, lambda text, share: None, ALONE, np.ones((1, 2)))
    found = fit_jointly(search, (spring,), nominal_errors(search.rig, search.prior), until_convergence=True).fit
    wide, narrow = (with_intervals(search.rig, f, data).effects[0] for f in (with_all_errors(search, found), found))
    more = np.sqrt(wide.std["stiffness"] ** 2 - narrow.std["stiffness"] ** 2)
    assert 0.01 * np.sqrt(2.0) < more / 40.0 < 0.05
    assert abs(wide.values["stiffness"] - 40.0) < 2.0 * wide.std["stiffness"]
