"""One actuator and one sensor: it is the same whether the one or the other is wrong, and records may be short."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

import workbench as wb

STEP, FINE = 5e-3, 10  # s; parts of a sample


@pytest.fixture(scope="module")
def rig():
    beam = wb.Beam(
        length=1.2, mass_per_length=0.62, bending_stiffness=14.0, left="clamped", right="free",
        damping=wb.ModalDamping(0.01),
    )  # fmt: skip
    return wb.Rig(beam.modes(6), [wb.Actuator("F", 0.4)], [wb.Sensor("w", 1.0, noise_std=1e-5)], structure=beam)


def measured(rig, seed, samples, gain=1.0, late=0):
    """Held forces on the modes, by their transition matrix in tenths of a sample; a reading that many of them late."""
    modes, rng = rig.modes, np.random.default_rng(seed)
    n, zero = modes.n_modes, np.zeros((modes.n_modes, modes.n_modes))
    a = np.block([[zero, np.eye(n)], [-np.diag(modes.omega**2), -np.diag(2.0 * modes.zeta * modes.omega)]])
    b = np.r_[np.zeros(n), modes.phi_at(0.4)][:, None]
    c = np.r_[modes.phi_at(1.0), np.zeros(n)][None]
    force = rng.standard_normal(samples)
    held = cont2discrete((a, b, c, np.zeros((1, 1))), STEP / FINE)
    y = dlsim(held, np.repeat(force, FINE))[1][:, 0]
    y = gain * np.r_[np.zeros(late), y][: y.size : FINE] + 1e-5 * rng.standard_normal(samples)
    return rig.record(force[None], y[None], sample_time=STEP, name="r")


def test_a_gain_may_be_the_actuators_or_the_sensors(rig):
    verdict = wb.diagnose(rig, [measured(rig, 1, 600, gain=1.2)])
    kinds = {effect.kind.name for effect in verdict.effects} | {
        label.split("[")[0] for label, _ in verdict.alternatives
    }
    assert verdict.outcome == "explained" and kinds == {"actuator_gain", "sensor_gain"}
    assert verdict.alternatives[0][1] == pytest.approx(0.5, abs=1e-3)
    assert "cannot be excluded" in verdict.sentence
    assert verdict.experiment.sentence.startswith("No experiment on this rig separates")


@pytest.mark.parametrize("seed", [12, 13])
def test_a_short_record_may_be_a_little_louder_than_its_noise(rig, seed):
    """Of 160 values of noise the mean square is off by a tenth."""
    verdict = wb.diagnose(rig, [measured(rig, seed, 160, late=17)])
    (effect,) = verdict.effects
    assert effect.kind.name in ("sensor_delay", "actuator_delay")
    assert abs(effect.values["delay"] - 1.7 * STEP) < 3.0 * effect.std["delay"] < 1e-4
    assert len(verdict.alternatives) == 1 and "_delay" in verdict.alternatives[0][0]


def test_no_word_on_noise_where_more_than_noise_is_left(rig):
    """Of a gap that a search had no time to explain, the level of the noise is not known."""
    loud = measured(rig, 3, 600)
    t = STEP * np.arange(600)
    strange = loud.outputs * (1.0 + 3.0 * np.sin(40.0 * t) * np.abs(np.sin(0.7 * t)))
    verdict = wb.diagnose(rig, [rig.record(loud.inputs, strange, sample_time=STEP, name="r")], seconds=3.0)
    assert verdict.outcome in ("part", "unknown")
    assert not any("noise of the sensors is" in note for note in verdict.notes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seconds": -5.0}, "seconds must be positive; got -5"),
        ({"tolerance": float("nan")}, "tolerance is a share of the signal's rms, from 0 to below 1; got nan"),
        ({"tolerance": 2.0}, "tolerance is a share"),
        ({"catalogue": ()}, "catalogue holds kinds of effects"),
        ({"catalogue": ("cubic_spring",)}, "such as kind_named"),
        ({"workers": 1.5}, "workers is a number of processes"),
    ],
)
def test_arguments_out_of_their_ranges_are_refused(rig, arguments, message):
    with pytest.raises(ValueError, match=message):
        wb.diagnose(rig, measured(rig, 1, 200), **arguments)


def test_one_record_or_any_iterable_of_them_will_do(rig):
    one = measured(rig, 1, 200)
    alone, of_generator = wb.diagnose(rig, one), wb.diagnose(rig, (record for record in [one]))
    assert alone.outcome == of_generator.outcome == "none"
