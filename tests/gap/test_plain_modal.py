"""A rig known by plain modal data alone: one degree of freedom whose spring hardens, integrated by scipy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import butter, lfilter

from workbench.cases.case import read_case
from workbench.cases.writing import write_case
from workbench.draw.gap import ALIKE, plot_unmodelled_force, plot_where
from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.nominal import NOMINAL_ERRORS
from workbench.gap.prediction.unmodelled_force import gauss_markov_force_filter, sampled_model
from workbench.records.record import Channel, Record
from workbench.records.units import Units
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes

MASS, DAMPING, STIFFNESS, CUBIC = 2.0, 1.6, 800.0, 4e5
DT, SAMPLES, NOISE = 0.005, 800, 2e-5
CASE = f"""
[structure]
kind = "modal"
mass = {MASS}
damping = {DAMPING}
stiffness = {STIFFNESS}
[[input]]
name = "F"
kind = "actuator"
[[output]]
name = "w"
quantity = "displacement"
noise_std = {NOISE}
"""
RECORD = '[[record]]\nname = "{0}"\nfile = "records/{0}.npz"\nsample_time = {1}\nuse = "{2}"\n'


def hardening(u):
    """Displacement of m w'' + c w' + k w + k3 w³ = u, u held over each sample."""
    state, found = np.zeros(2), np.zeros(u.size)
    for i in range(u.size - 1):

        def motion(_, x, force=u[i]):
            return [x[1], (force - DAMPING * x[1] - STIFFNESS * x[0] - CUBIC * x[0] ** 3) / MASS]

        state = solve_ivp(motion, (0.0, DT), state, method="DOP853", rtol=1e-9, atol=1e-13).y[:, -1]
        found[i + 1] = state[0]
    return found


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seat")
    (folder / "records").mkdir()
    rng, text = np.random.default_rng(3), CASE
    for name, level in (("low", 1.0), ("high", 8.0), ("validate", 5.0)):
        u = level * np.repeat(rng.normal(size=SAMPLES // 5), 5)
        w = hardening(u) + NOISE * rng.normal(size=SAMPLES)
        np.savez(folder / f"records/{name}.npz", t=DT * np.arange(SAMPLES), F=u, w=w)
        text += RECORD.format(name, DT, "validate" if name == "validate" else "fit")
    (folder / "case.toml").write_text(text)
    return read_case(folder)


@pytest.mark.slow
def test_noise_that_is_not_stated_is_taken_from_the_records(case, tmp_path):
    folder = tmp_path / "silent"
    write_case(case, folder)
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text("\n".join(line for line in text.splitlines() if "noise_std" not in line))
    silent = read_case(folder)
    assert silent.rig.sensors[0].noise_std == 0.0
    verdict = diagnose(silent.rig, silent.fit, validation=silent.validation)
    assert [effect.label for effect in verdict.effects] == ["cubic_spring"]
    assert verdict.budget.noise_found[0] == pytest.approx(NOISE, rel=0.2)
    assert any("noise_std of w is not stated" in note for note in verdict.notes)


def test_a_hardening_spring_is_named_at_the_input_where_it_stands(case):
    verdict = diagnose(case.rig, case.fit, validation=case.validation, name=case.name)
    assert [effect.label for effect in verdict.effects] == ["cubic_spring"]
    assert verdict.effects[0].values["stiffness"] == pytest.approx(CUBIC, rel=1e-3)
    assert verdict.shrinkage.overall > 0.99
    assert " at F " in verdict.sentence and "x =" not in verdict.sentence
    alone = plot_where(verdict).axes[5]  # one sensor places nothing
    assert not alone.axison and [text.get_text() for text in alone.texts] == ["no place of a force can be identified"]
    left, right = plot_unmodelled_force(verdict, length="V", force="V").axes
    assert "at F" in left.get_xlabel()
    assert left.get_xlabel() == "displacement at F [V]" and right.get_xlabel() == "velocity at F [V/s]"
    assert left.get_ylabel() == "unmodelled force [V]"


FREE_HZ = np.array([0.0, 0.0, 0.9, 1.7, 2.6, 4.1, 5.8])
FREE_SHAPES = np.array(  # at the hub, the tips and across the hub, of two rigid modes and five of the panels
    [
        [0.10, 0.00, 0.05, 0.02, -0.04, 0.03, 0.05],
        [0.10, -0.12, -0.25, 0.22, 0.20, -0.18, 0.15],
        [0.10, 0.12, -0.25, -0.22, 0.20, 0.18, 0.15],
        [0.10, 0.05, 0.04, 0.06, -0.03, 0.06, -0.04],
    ]
)


@pytest.fixture(scope="module")
def spacecraft():
    """A free structure by its modes, each off by itself, and records of what it does with a limit and gains."""
    names = ("hub", "left", "right", "across")
    rng = np.random.default_rng(12)
    damping = np.array([0.0, 0.0, 0.006, 0.005, 0.008, 0.005, 0.007])
    noise = (3e-3, 9e-3, 9e-3)
    sensors = tuple(
        Sensor(name, at, quantity, noise_std=std)
        for (name, at, quantity), std in zip(
            (("rate", "across", "velocity"), ("a1", "left", "acceleration"), ("a2", "right", "acceleration")),
            noise,
            strict=True,
        )
    )
    actuators = Actuator("T1", "hub"), Actuator("T2", "across")

    def rig(frequencies, damping, shapes, limit=np.inf, gain=1.0):
        modes = Modes(2.0 * np.pi * frequencies, damping, PointShapes(shapes), NamedPoints(names))
        pushing = (replace(actuators[0], limit=limit), actuators[1])
        return Rig(modes, pushing, (sensors[0], replace(sensors[1], gain=gain), sensors[2]))

    frequencies = FREE_HZ * np.exp(rng.choice([-1.0, 1.0], 7) * rng.uniform(0.003, 0.01, 7))
    shapes = FREE_SHAPES.copy()
    shapes[:, 2:] *= 1.0 + 0.02 * rng.standard_normal((4, 5))
    more = damping * np.exp(0.2 * rng.standard_normal(7))

    def records(**hidden):
        real, found, rng = rig(frequencies, more, shapes, **hidden), [], np.random.default_rng(13)
        for name, level in (("low", 8.0), ("mid", 16.0), ("high", 24.0), ("check", 20.0)):
            b, a = butter(4, 0.15)
            inputs = lfilter(b, a, rng.standard_normal((2, 1300)), axis=1)
            inputs *= level / inputs.std()
            clean = simulate(real, inputs, sample_time=0.0115).outputs
            outputs = clean + np.array(noise)[:, None] * rng.standard_normal(clean.shape)
            channels = tuple(Channel(s.name, s.quantity) for s in sensors), (Channel("T1"), Channel("T2"))
            found.append(Record(0.0115, outputs, channels[0], inputs, channels[1], name=name))
        return found

    return rig(FREE_HZ, damping, FREE_SHAPES), records


def test_shapes_that_are_off_by_themselves_are_no_effect(spacecraft):
    """Cross-talk and masses that stood for them, and noise of inputs that had none, were named beside other effects."""
    rig, records = spacecraft
    *fit, check = records()
    verdict = diagnose(rig, fit, validation=[check], workers=1)
    assert verdict.outcome == "none" and [effect.kind for effect in verdict.effects] == [NOMINAL_ERRORS]
    assert verdict.budget.errors["shapes_percent"] > 0.1


def test_a_limit_and_a_gain_are_found_beside_shapes_that_are_off(spacecraft):
    rig, records = spacecraft
    *fit, check = records(limit=25.0, gain=1.12)
    names = (
        "actuator_saturation",
        "sensor_gain",
        "sensor_crosstalk",
        "point_mass",
        "actuator_dead_zone",
        "modal_damping",
    )
    kinds = tuple(kind_named(name) for name in names)  # the right ones, and what was named for them
    verdict = diagnose(rig, fit, validation=[check], catalogue=kinds, workers=1)
    limit, gain, _ = verdict.effects
    assert (limit.label, gain.label) == ("actuator_saturation[T1]", "sensor_gain[a1]")
    assert limit.values["limit"] == pytest.approx(25.0, abs=3.0 * limit.std["limit"])
    assert gain.values["gain"] == pytest.approx(1.12, abs=0.03)  # the shapes at it are off by 1.4 % in the mean
    axes, place = plot_where(verdict).axes, verdict.where.place
    shares = [bar.get_height() for bar in axes[0].patches]
    assert shares[0] == pytest.approx(100.0 * verdict.where.band_shares[0], abs=1.0)  # below 0.34 Hz: what drifts
    assert axes[0].get_xticklabels()[0].get_text() == "rigid, 1 to 2" and sum(shares) == pytest.approx(100.0, abs=0.5)
    assert axes[1].get_xlabel() == "upper edge of the band [Hz]"
    told = plot_where(replace(verdict, units=Units("mm", "kg", "ms", "kN"))).axes
    assert told[1].get_xlabel() == "upper edge of the band [1/ms]"
    below, names = (
        [bar.get_x() + bar.get_width() for bar in axes[5].patches],
        [label.get_text() for label in axes[5].get_yticklabels()],
    )
    assert below == sorted(below) and below[0] == pytest.approx(ALIKE) and axes[5].texts[0].get_text() == "most likely"
    assert names[0] == rig.modes.domain.text(place.at) and len(names) == len(place.places)


@pytest.mark.parametrize("place", ["left", "across"])
def test_a_filter_settles_where_rigid_modes_are_read_by_their_rates_alone(spacecraft, place):
    rig, _ = spacecraft
    model = sampled_model(rig.modes, rig.sensors, np.array([s.noise_std for s in rig.sensors]), 0.0115)
    found = gauss_markov_force_filter(rig.modes, model, rig.modes.phi_at(place), 0.2, 11.5, 0.0115)
    variances = np.linalg.eigvalsh(found.covariance)
    assert variances[0] > -1e-9 * variances[-1]
    assert np.sqrt(variances[-1]) < 100.0  # of a force of 0.2 N
