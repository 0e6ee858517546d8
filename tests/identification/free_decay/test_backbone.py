"""One sensor and a beat: two linear modes, or one whose frequency and damping go with its amplitude."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from workbench.identification.free_decay import backbone
from workbench.identification.free_decay.backbone import (
    POWERS,
    _Backbone,
    _Band,
    _envelopes,
    _modes_misfit,
    are_two,
    backbone_misfit,
    common_backbone_misfit,
)
from workbench.identification.free_decay.order import identify
from workbench.identification.ring_down import ring_down
from workbench.records.record import Channel, Record

DT = 0.02
TIME = DT * np.arange(1600)


def noisy(y, level, seed):
    y = y + level * y.std() * np.random.default_rng(seed).standard_normal(y.size)
    return Record(DT, y[None], (Channel("y", "displacement"),))


def bent(omega=20.0, sigma=0.15, rise=0.5, time=TIME):
    """θ' = ω + rise r² with r = e^{-σt}: θ = ω t + rise (1 - r²) / 2σ."""
    return np.exp(-sigma * time) * np.cos(omega * time + 0.5 * rise * -np.expm1(-2.0 * sigma * time) / sigma + 0.7)


def beating(omega=20.0, sigma=(0.15, 0.2), apart=0.2, time=TIME):
    first, second = (
        np.exp(-s * time) * np.cos(w * time + p) for s, w, p in zip(sigma, (omega, omega + apart), (0.3, 2))
    )
    return first + 0.5 * second


@pytest.mark.slow
def test_a_mode_on_a_backbone_leaves_noise_and_no_more():
    beside = np.exp(-0.1 * TIME) * np.cos(50.0 * TIME)
    noise = 0.01 * bent().std()
    record = noisy(bent(), 0.01, 0)
    record = Record(DT, record.outputs + beside, record.output_channels)
    pair = np.array([-0.15 + 20.3j, -0.3 + 20.05j])
    band = _Band(record, pair, np.array([-0.1 + 50.0j]))
    assert backbone_misfit(band, pair) == pytest.approx(band.y.size * noise**2, rel=0.4)


@pytest.mark.parametrize("powers", POWERS)
def test_the_envelope_follows_its_differential_equation(powers):
    row, time = 0.1 * np.array([-0.5, -0.2, -0.1]), np.linspace(0.0, 4.0, 151)
    [u] = _envelopes(row[None], np.array(powers), time, 7.0, 60.0)[0].T

    def rate(_, u):
        return -np.sum(row * np.exp(-u * np.array(powers)), keepdims=True)

    exact = solve_ivp(rate, (0.0, 4.0), [0.0], t_eval=time, rtol=1e-10, atol=1e-12).y[0]
    np.testing.assert_allclose(u, exact, atol=1e-8)


def test_each_backbone_that_is_tried_is_followed_once(monkeypatch):
    asked, fitted = [], _Backbone.fitted

    def counted(self, unknowns):
        asked.append(unknowns.tobytes())
        return fitted(self, unknowns)

    monkeypatch.setattr(_Backbone, "fitted", counted)
    pair = np.array([-0.15 + 20.3j, -0.3 + 20.05j])
    backbone_misfit(_Band(noisy(bent(), 0.01, 0), pair, np.zeros(0, complex)), pair)
    assert asked and all(one != after for one, after in zip(asked, asked[1:]))


def test_two_modes_that_one_sensor_sees_are_two():
    found = identify(noisy(beating(), 0.01, 1))
    assert found.modes.n_modes == 2
    assert (np.abs(found.modes.poles.imag - [20.0, 20.2]) < 4.0 * found.refined.omega_std).all()


def test_one_mode_that_shifts_as_it_decays_is_one():
    """Two linear modes raise its likelihood over one as far as those of the other test do theirs."""
    found = identify(noisy(bent(), 0.01, 2))
    assert found.modes.n_modes == 1
    assert 20.0 < found.modes.omega[0] < 20.5


def random_beat(rng):
    omega = 2.0 * np.pi * rng.uniform(2.0, 8.0)
    sigma = omega * 10 ** rng.uniform(np.log10(0.003), np.log10(0.015), 2)
    poles = -sigma + 1j * (omega + np.r_[0.0, rng.uniform(0.2, 1.0) * sigma.sum()])
    amplitudes = np.r_[1.0, 10 ** rng.uniform(-0.7, 0.0)] * np.exp(2j * np.pi * rng.random(2))
    return (amplitudes @ np.exp(np.outer(poles, TIME))).real


def random_bent(rng, kind):
    """Springs that harden or soften, drag, friction; shifts of a third to five half-widths of the mode."""
    omega = 2.0 * np.pi * rng.uniform(2.0, 8.0)
    sigma = omega * 10 ** rng.uniform(np.log10(0.003), np.log10(0.012))
    shift = sigma * 10 ** rng.uniform(-0.5, 0.7)
    cubic = {"harder": 1.0, "softer": -1.0, "drag": 0.3, "friction": 0.3}[kind] * shift * omega * 8.0 / 3.0
    drag, friction = (
        (1.5 * shift / omega if kind == "drag" else 0.0),
        (0.05 * sigma * omega if kind == "friction" else 0.0),
    )

    def rates(_, state):
        x, v = state
        resisted = 2.0 * sigma * v + drag * abs(v) * v + friction * np.tanh(1e3 * v / omega)
        return [v, -(omega**2) * x - cubic * x**3 - resisted]

    return solve_ivp(rates, (0.0, TIME[-1]), [1.0, 0.0], "DOP853", TIME, rtol=1e-8, atol=1e-10).y[0]


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.01, 0.001])
def test_random_beats_and_backbones_are_told_apart(level):
    """Forty of each; modes at their third harmonics, which shift too, are told by their frequencies."""
    missed = false = 0
    for seed in range(40):
        rng = np.random.default_rng([seed, 1])
        missed += identify(noisy(random_beat(rng), level, seed)).modes.n_modes < 2
        one = random_bent(rng, ("harder", "softer", "drag", "friction")[seed % 4])
        omega = identify(noisy(one, level, seed)).modes.omega
        false += (omega < 1.5 * omega[0]).sum() > 1
    assert missed <= 1 and false <= 1


def in_records(make, level=0.01):
    """Three records of one sensor, each struck elsewhere and by another force."""
    return [noisy(make(k), level, k) for k in range(3)]


def test_one_mode_of_several_records_is_one_whatever_their_levels():
    """Records of different levels see different frequencies of one mode: these are no modes of their own."""
    found = ring_down(in_records(lambda k: (1.0, 0.6, 0.3)[k] * bent(rise=0.5 * (1.0, 0.6, 0.3)[k] ** 2)), start=0.0)
    assert found.modes.n_modes == 1
    assert 20.0 < found.modes.omega[0] < 20.5
    assert found.by_amplitude.depends.all()


def test_one_mode_that_differs_from_record_to_record_is_one():
    """Linear in each: clamped anew, or warmer."""
    found = ring_down(in_records(lambda k: bent(omega=20.0 + 0.12 * k, rise=0.0)), start=0.0)
    assert found.modes.n_modes == 1
    assert 20.0 < found.modes.omega[0] < 20.24
    assert found.by_amplitude.depends.all()


def beat(k):
    """In another proportion in each record, and a curve of its own would fit each as well."""
    poles = np.array([-0.15 + 20.0j, -0.2 + 20.2j])
    return ((1.0, (0.5, -1.2, 0.8j)[k]) @ np.exp(np.outer(poles, TIME))).real


def test_two_modes_of_several_records_are_two():
    found = identify(in_records(beat))
    assert found.modes.n_modes == 2
    assert (np.abs(found.modes.poles.imag - [20.0, 20.2]) < 4.0 * found.refined.omega_std).all()


def test_what_is_elsewhere_and_not_found_yet_does_not_make_two_modes_one():
    """It is six times as strong as the weaker of the two."""

    def beside(k):
        return beat(k) + 3.0 * (1j**k * np.exp((-0.3 + 60.0j) * TIME)).real

    records, poles = in_records(beside), np.array([-0.15 + 20.0j, -0.2 + 20.2j])
    assert are_two(records, poles, 1, 0, 30.0)


@pytest.mark.slow
def test_pairs_beside_each_other_are_found_while_either_hides_the_other():
    """Half of one is missing while the other is judged, and the other way round."""
    poles = np.array([-0.39 + 37.6j, -0.23 + 38.14j, -0.29 + 42.38j, -0.37 + 42.71j])

    def pairs(k):
        rng = np.random.default_rng([k, 5])
        return ((rng.standard_normal(4) + 1j * rng.standard_normal(4)) @ np.exp(np.outer(poles, TIME))).real

    found = identify(in_records(pairs, level=0.001))
    assert found.modes.n_modes == 4
    assert (np.abs(found.modes.poles - poles) < 0.02).all()


@pytest.mark.slow
def test_the_amplitude_of_each_record_is_found_on_the_common_backbone():
    """Least squares of three records by one law: noise and no more is left of each."""
    records = in_records(lambda k: (1.0, 0.6, 0.3)[k] * bent(rise=0.5 * (1.0, 0.6, 0.3)[k] ** 2))
    noise = 0.01 * np.array([record.outputs.std() for record in records])
    pair = np.array([-0.15 + 20.3j, -0.3 + 20.05j])
    bands = [_Band(record, pair, np.zeros(0, complex)) for record in records]
    left = common_backbone_misfit(bands, 1.0 / noise, pair)
    np.testing.assert_allclose(left / (bands[0].y.size * noise**2), 1.0, atol=0.4)


def test_a_long_record_is_compared_at_fewer_samples_with_the_same_result(monkeypatch):
    """In 96,000 samples the lines of a decay are Σ_t of a geometric series; at every 96th sample as at each."""
    time = 1e-4 * np.arange(96_000)
    pair = np.array([-1.08 + 719.4j, -1.5 + 721.3j])
    noise = 0.01 * np.random.default_rng(0).standard_normal(time.size)
    record = Record(1e-4, (np.exp(np.outer(time, pair)).sum(axis=1).real + noise)[None], (Channel("v", "velocity"),))
    few = _Band(record, pair, np.zeros(0, complex))
    monkeypatch.setattr(backbone, "BACKBONE", replace(backbone.BACKBONE, min_samples=time.size))
    each = _Band(record, pair, np.zeros(0, complex))
    assert few.time.size < each.time.size / 50
    z = np.exp(pair * 1e-4)
    turns = z / np.exp(2j * np.pi * np.outer(few.lines, [1.0, 1.0]) / time.size)
    exact = 0.5 * (1.0 - z**time.size) / (1.0 - turns) / np.sqrt(0.5 * time.size)
    found = few.lines_of(np.exp(np.outer(pair, few.time)))[0]
    wanted = few.without_others(np.vstack([exact.real, exact.imag]))
    np.testing.assert_allclose(few.without_others(found), wanted, atol=1e-7 * np.abs(wanted).max())
    one, other = (_modes_misfit([band], pair)[0] for band in (few, each))
    assert one == pytest.approx(other, rel=1e-5)
