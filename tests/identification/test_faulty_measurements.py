"""What a laboratory adds to the response: drift, hum, filters; modes that beat."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, cont2discrete, dlsim, firwin, lfilter

from workbench.identification.ambient import identify_ambient
from workbench.identification.driven import identify_driven
from workbench.identification.frf import identify_frf
from workbench.identification.input_output.excitation import unexcited_remarks
from workbench.identification.input_output.fit_errors import statistic_of_each
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import projected
from workbench.identification.ring_down import ring_down
from workbench.identification.signal.harmonics import harmonic_remarks
from workbench.records.record import Channel, Record

HZ, DAMPING = np.array([18.0, 72.0, 75.0, 160.0]), np.array([0.01, 0.005, 0.008, 0.01])
SHAPES = np.sin(np.pi * np.outer([0.18, 0.37, 0.61, 0.83], np.arange(1, 5)))


def response(force, rate, hz=HZ, damping=DAMPING, shapes=SHAPES, at=0):
    """Accelerations of a structure at its sensors to a force held between samples, at one of them."""
    n, omega = len(hz), 2.0 * np.pi * np.asarray(hz)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(omega**2), -np.diag(2.0 * np.asarray(damping) * omega)]])
    b = np.r_[np.zeros(n), shapes[at]][:, None]
    c, d = shapes @ a[n:], shapes @ b[n:]
    held = cont2discrete((a, b, c, d), 1.0 / rate)
    return dlsim(held, force)[1].T


def record(force, outputs, rate, inputs=True):
    channels = [Channel(f"a{j + 1}", "acceleration") for j in range(len(outputs))]
    driven = (force[None], [Channel("F", "force")]) if inputs else ()
    return Record(1.0 / rate, outputs, channels, *driven)


def noisy(outputs, level, seed):
    noise = np.random.default_rng(seed).standard_normal(outputs.shape)
    return outputs + level * outputs.std(axis=1, keepdims=True) * noise


@pytest.fixture(scope="module")
def filtered():
    """A shaker test, force and outputs through the same anti-aliasing filter of 420 Hz, sampled at 1 kHz."""
    rate, over = 1000, 20
    force = np.repeat(np.random.default_rng(7).standard_normal(2 * rate), over)
    kernel = firwin(801, 0.42 * rate, fs=rate * over)
    outputs = lfilter(kernel, 1.0, response(force, rate * over), axis=1)[:, ::over]
    return lfilter(kernel, 1.0, force)[::over], outputs, rate


def test_filtered_alike_a_shaker_test_holds_its_modes(filtered):
    force, outputs, rate = filtered
    found = identify_driven(record(force, noisy(outputs, 1e-3, 8), rate))
    np.testing.assert_allclose(found.modes.frequencies_hz[:4], HZ, rtol=1e-4)
    np.testing.assert_allclose(found.modes.zeta[:4], DAMPING, rtol=2e-2)


def test_a_pole_at_nyquist_has_a_statistic(filtered):
    """Half a turn a sample has no imaginary part, so that its two columns are one; such tests led there."""
    force, outputs, rate = filtered
    data = KnownInputs([record(force, outputs, rate)], at_rest=True, hold="zero", feedthrough=True)
    fit = projected(data, 2.0 * np.pi * HZ[:1] * (-0.01 + 1j), np.ones((1, 1), complex))
    (part,) = fit.parts
    spread = part.spread.copy()
    spread[:2, :2] = spread[0, 0]
    (statistic,) = statistic_of_each(replace(fit, parts=(replace(part, spread=spread),)))
    assert 0.0 <= statistic < np.inf


def test_where_the_inputs_have_no_power_a_mode_is_remarked(filtered):
    force, outputs, rate = filtered
    poles = 2.0 * np.pi * np.append(HZ, [410.0, 480.0]) * (-0.003 + 1j)
    (remark,) = unexcited_remarks([record(force, outputs, rate)], poles)
    assert remark.startswith("the inputs hardly excite mode 6 (480 Hz, 0.")
    assert not unexcited_remarks([record(force, outputs, rate)], poles[:-1])


@pytest.mark.parametrize("drift", [0.1, 2.0])
def test_drifting_sensors_hide_no_slow_mode(drift):
    """A suspended body: its slowest mode has ten periods in the record."""
    rate, hz = 200, [1.2, 20.0, 55.0, 56.0]
    force = np.zeros(8 * rate)
    force[[40, 660]] = 1.0
    outputs = response(force, rate, hz, [0.05, 0.01, 0.01, 0.01])
    slow = drift * outputs.std() * np.linspace(0.0, 1.0, force.size) * np.arange(1, 5)[:, None]
    found = identify_driven(record(force, noisy(outputs, 2e-3, 11) + slow, rate))
    np.testing.assert_allclose(found.modes.frequencies_hz, hz, rtol=2e-3)
    np.testing.assert_allclose(found.modes.zeta[0], 0.05, rtol=0.05)
    (remark,) = [remark for remark in found.remarks if "drift" in remark]
    name, size = remark.removeprefix("outputs drift, ").split(":")[0].split(" by ")
    assert float(size) == pytest.approx(int(name[1]) * drift * outputs.std(), rel=0.02)


def test_a_rigid_body_that_is_pushed_away_does_not_drift():
    rate = 200
    force = np.random.default_rng(2).standard_normal(1200)
    bending = response(force, rate, [20.0], [0.01], SHAPES[:, :1])
    away = np.cumsum(np.cumsum(force)) / rate**2
    moved = np.cumsum(np.cumsum(bending, axis=1), axis=1) / rate**2 + away
    found = identify_driven(
        Record(1.0 / rate, noisy(moved, 1e-5, 3), [Channel(f"d{j}", "displacement") for j in range(4)], force[None],
               [Channel("F", "force")], input_hold="first")
    )  # fmt: skip
    assert not any("drift" in remark for remark in found.remarks)


def test_a_weak_sine_in_random_motion_is_remarked_though_a_broad_mode_is_found_there():
    """A line of two hundred times the power of those within ±2 |Re λ| of a pole at 8 Hz: what is there has no constant
    envelope, but no mode makes it either."""
    rate, n, rng = 40, 20_000, np.random.default_rng(3)
    motion, pole = rng.standard_normal((3, n)), np.array([-0.7 + 2j * np.pi * 8.0])
    sine = np.outer([0.2, 0.0, 0.0], np.sin(2.0 * np.pi * 8.002 / rate * np.arange(n)))
    channels = tuple(Channel(f"a{k}", "acceleration") for k in range(3))
    quiet, spoilt = (Record(1.0 / rate, y, channels) for y in (motion, motion + sine))
    assert harmonic_remarks([quiet], pole, [0]) == ()
    (remark,) = harmonic_remarks([spoilt], pole, [0])
    assert "one line far above those beside it" in remark


@pytest.mark.parametrize(("driven", "size"), [(True, 0.3), (True, 0.01), (False, 0.3)])
def test_hum_is_remarked_and_no_mode_is(driven, size):
    """Of a hundredth of the driven motion too, which the motion about it hides."""
    rate, hz = 200, [3.0, 11.0, 40.0]
    n = (20 if driven else 200) * rate
    forces = np.random.default_rng(12).standard_normal((2, n))
    outputs = response(forces[0], rate, hz, [0.01, 0.01, 0.005], SHAPES[:, :3])
    if not driven:
        outputs += response(forces[1], rate, hz, [0.01, 0.01, 0.005], SHAPES[:, :3], at=2)
    hum = size * outputs.std() * np.sin(2.0 * np.pi * 50.0 / rate * np.arange(n) + 0.3)
    spoilt = record(forces[0], noisy(outputs, 0.02, 4) + hum, rate, driven)
    found = identify_driven(spoilt) if driven else identify_ambient(spoilt)
    (remark,) = [remark for remark in found.remarks if "harmonic excitation?" in remark]
    (named,) = remark.split("about mode ")[1].split(" has a constant")[0].split(", ")
    assert named.endswith("(50 Hz)")


def test_modes_that_beat_do_not_depend_on_amplitude():
    rate = 500
    t = np.arange(1000) / rate
    poles = 2.0 * np.pi * np.array([37.0, 37.4]) * (-np.array([0.004, 0.006]) + 1j)
    decay = (np.exp(np.outer(t, poles)) @ [1.0, 0.7]).real[None]
    found = ring_down(Record(1.0 / rate, noisy(decay, 3e-3, 6), [Channel("a", "acceleration")]), start=0.0)
    np.testing.assert_allclose(found.modes.frequencies_hz, [37.0, 37.4], rtol=1e-3)
    assert not found.by_amplitude.depends.any()


@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_sensors_that_pass_no_constant_settle(offset):
    """Accelerometers with a high-pass of 2 Hz, first order, that begin at rest or at an offset."""
    rate, hz, damping = 500, np.array([12.0, 48.0, 110.0]), np.array([0.01, 0.02, 0.01])
    t, rng = np.arange(2000) / rate, np.random.default_rng(3)
    each = np.exp(
        np.outer(2.0 * np.pi * hz * (-damping + 1j * np.sqrt(1.0 - damping**2)), t)
        + 1j * np.array([[1.0], [2.0], [3.0]])
    )
    shapes = np.sin(np.pi * np.outer(np.arange(1, 7) / 7, np.arange(1, 4))) * [1.0, 0.5, 0.2]
    outputs = (shapes @ each).real + offset + 0.01 * rng.standard_normal((6, t.size))
    through = lfilter(*butter(1, 2.0, "high", fs=rate), outputs, axis=1)
    found = ring_down(Record(1.0 / rate, through, [Channel(f"a{j}", "acceleration") for j in range(6)]), start=0.0)
    assert (np.abs(found.modes.frequencies_hz - hz) < 4.0 * found.omega_std / (2.0 * np.pi)).all()
    assert (np.abs(found.modes.zeta - damping) < 4.0 * found.zeta_std).all()
    (note,) = [note for note in found.notes if note.startswith("settling (time constant ")]
    assert float(note.removeprefix("settling (time constant ").split(" s)")[0]) == pytest.approx(0.0796, rel=0.05)


def test_a_clipped_force_is_remarked():
    force = np.random.default_rng(1).standard_normal(600)
    spoilt = record(np.clip(force, -1.2, 1.2), noisy(response(force, 1000), 0.05, 1), 1000)
    assert any("input 'F' is clipped at 1.2 and -1.2" in remark for remark in identify_driven(spoilt).remarks)


@pytest.mark.parametrize("gusts", [True, False])
def test_gusts_are_remarked_and_steady_forces_are_not(gusts):
    rate, n = 50, 6000
    force = np.random.default_rng(5).standard_normal(n)
    if gusts:
        force *= np.where(np.abs(np.arange(n) - 3000) < 100, 20.0, 1.0)
    outputs = noisy(response(force, rate, [3.0, 8.0], [0.02, 0.02], SHAPES[:, :2]), 0.02, 6)
    found = identify_ambient(record(force, outputs, rate, inputs=False))
    assert any("in some parts of the record" in remark for remark in found.remarks) == gusts


def test_noise_free_modes_do_not_depend_on_amplitude():
    """What rounding leaves of their figures is no change."""
    t = np.arange(3000) / 200
    each = np.exp(np.outer(2.0 * np.pi * np.array([5.0, 12.0, 30.0]) * (-0.02 + 1j), t))
    outputs = (SHAPES[:, :3] @ each).real
    found = ring_down(Record(1.0 / 200, outputs, [Channel(f"a{j}", "acceleration") for j in range(4)]), start=0.0)
    np.testing.assert_allclose(found.modes.zeta, 0.02 / np.sqrt(1.0004), rtol=1e-6)
    assert not found.by_amplitude.depends.any()


def frfs(noise):
    lines = 0.5 * np.arange(1, 360)
    s, omega = 2j * np.pi * lines, 2.0 * np.pi * HZ
    each = np.array([s**2 / (w**2 + s**2 + 2.0 * z * w * s) for w, z in zip(omega, DAMPING, strict=True)])
    h = np.einsum("jr,r,rk->jk", SHAPES, SHAPES[0], each)
    rng = np.random.default_rng(1)
    h += noise * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape))
    return h, lines, {"channels": tuple(Channel(f"a{j}", "acceleration", at=j / 4) for j in range(4))}


@pytest.mark.parametrize("outputs", [slice(None), slice(3, 4)])
def test_frfs_of_the_other_sign_are_turned_with_a_remark(outputs):
    """Of one output alone, no mode rose above the noise."""
    h, lines, channels = frfs(0.01)
    h, channels = h[outputs], {"channels": channels["channels"][outputs]}
    found, turned = (identify_frf(values, lines, **channels) for values in (h, h.conj()))
    assert not found.remarks and "complex conjugates" in turned.remarks[0]
    np.testing.assert_allclose(turned.modes.frequencies_hz, found.modes.frequencies_hz, rtol=1e-12)
    np.testing.assert_allclose(found.modes.frequencies_hz, HZ, rtol=1e-3)
    np.testing.assert_allclose(turned.fitted, found.fitted.conj(), rtol=1e-12)


@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0])
def test_noise_stated_ten_times_off_is_remarked(factor):
    h, lines, channels = frfs(0.01)
    found = identify_frf(h, lines, noise_std=0.01 * factor, **channels)
    said = [float(remark.split()[3]) for remark in found.remarks if "times noise_std" in remark]
    assert said == ([] if factor == 1.0 else [pytest.approx(1.0 / factor, rel=0.15)])


def test_numbers_of_modes_below_one_are_refused():
    h, lines, channels = frfs(0.01)
    spoilt = record(np.ones(200), np.random.default_rng(0).standard_normal((2, 200)), 100)
    with pytest.raises(ValueError, match="max_modes is a number of modes, 1 or more; got 0"):
        identify_frf(h, lines, max_modes=0, **channels)
    with pytest.raises(ValueError, match="max_modes is"):
        identify_driven(spoilt, max_modes=0)
    with pytest.raises(ValueError, match="n_modes is a number of modes, 1 or more; got -1"):
        identify_ambient(spoilt, n_modes=-1)
    with pytest.raises(ValueError, match="noise_std must have the shape of frf"):
        identify_frf(h, lines, noise_std=np.ones(3), **channels)


def test_a_repeated_root_is_remarked():
    """Two references tell both modes of a square plate, and no more than the plane of their shapes."""
    lines = 0.5 * np.arange(1, 160)
    s, hz = 2j * np.pi * lines, np.array([21.0, 21.0, 55.0])
    shapes = np.array([[1.0, 0.2, 0.5], [0.3, 1.0, -0.7], [-0.6, 0.8, 0.9], [0.7, -0.4, 0.2]])
    each = np.array([1.0 / (w**2 + s**2 + 0.02 * w * s) for w in 2.0 * np.pi * hz])
    h = np.einsum("jr,ir,rk->jik", shapes, shapes[:2], each)
    rng = np.random.default_rng(3)
    h = h + 1e-3 * np.abs(h).max() * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape))
    found = identify_frf(h, lines, channels=tuple(Channel(f"p{j}", "displacement", at=j / 3) for j in range(4)))
    np.testing.assert_allclose(found.modes.frequencies_hz, hz, rtol=1e-3)
    (remark,) = found.remarks
    assert remark.startswith("modes 1 and 2 (21 Hz) may be one repeated root")


@pytest.fixture(scope="module")
def shaken():
    force, few = np.random.default_rng(11).standard_normal(2000), [0, 3]
    moves = response(force, 1000, HZ[few], DAMPING[few], SHAPES[:, few])
    return record(force, noisy(moves, 1e-2, 12), 1000)


def test_a_sound_record_has_no_burst(shaken):
    assert not identify_driven(shaken).remarks


def test_samples_that_all_channels_lost_are_remarked(shaken):
    kept = np.r_[0:1000, 1040:2000]
    seam = replace(shaken, outputs=shaken.outputs[:, kept], inputs=shaken.inputs[:, kept])
    (remark,) = (line for line in identify_driven(seam).remarks if "of the residual energy" in line)
    begins, ends = (float(word) for word in remark.split(" lies from ")[1].split(" s:")[0].split(" to "))
    assert begins <= 1.0 <= ends and ends - begins < 0.2


def test_outputs_that_stay_amid_forced_motion_are_named(shaken):
    outputs = shaken.outputs.copy()
    outputs[2, 1000:1060] = outputs[2, 999]
    found = identify_driven(replace(shaken, outputs=outputs))
    assert any("output 'a3' stays at one value for 61 samples from 0.999 s on" in line for line in found.remarks)


def test_an_output_that_never_moves_is_refused():
    rng = np.random.default_rng(0)
    channels = (Channel("a"), Channel("b"))
    record = Record(1e-3, np.vstack([rng.standard_normal(500), np.zeros(500)]), channels,
                    inputs=rng.standard_normal((1, 500)), input_channels=(Channel("F"),))  # fmt: skip
    for identify in (identify_driven, identify_ambient):
        with pytest.raises(ValueError, match="output 'b' stays at 0: the sensor is dead"):
            identify(record)
