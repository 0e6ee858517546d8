"""A mode that depends on amplitude is one mode after a blow, with a remark, whichever verb is asked."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from workbench.identification.driven import identify_driven
from workbench.identification.free_decay.order import identify
from workbench.identification.ring_down import ring_down
from workbench.records.record import Channel, Record

RATE, FREQUENCIES, DAMPING = 100.0, np.array([5.0, 18.0]), 0.01
BLOW = 4  # samples from the beginning, of which two are driven


def struck(hardening, samples=3000, noise=1e-3):
    """Two modes in one output, struck once, by Runge and Kutta: the stiffness of the first rises as its square does.

    Args:
        hardening: of the force of the first spring at its largest displacement, relative to the linear one.
    """
    omega = 2.0 * np.pi * FREQUENCIES
    peak = 1.6 * 2.0 / (RATE * omega[0])  # of the first mode, linear, after this blow
    cubic = hardening * omega[0] ** 2 / peak**2

    def motion(t, state, force):
        q, v = state[:2], state[2:]
        return np.r_[v, force - 2.0 * DAMPING * omega * v - omega**2 * q - np.array([cubic * q[0] ** 3, 0.0])]

    force, state = np.zeros(samples), np.zeros(4)
    force[BLOW : BLOW + 2] = 1.0
    y = np.zeros(samples)
    for k in range(BLOW, BLOW + 2):
        state = solve_ivp(motion, (0.0, 1.0 / RATE), state, args=(1.0,), rtol=1e-9, atol=1e-12).y[:, -1]
        y[k + 1] = state[0] + state[1]
    behind = np.arange(samples - BLOW - 2) / RATE
    free = solve_ivp(motion, (0.0, behind[-1]), state, args=(0.0,), t_eval=behind, rtol=1e-9, atol=1e-12).y
    y[BLOW + 2 :] = free[0] + free[1]
    y += noise * np.abs(y).max() * np.random.default_rng(7).normal(size=samples)
    return Record(1.0 / RATE, y[None], [Channel("d", "displacement")], force[None], [Channel("F", "force")])


def test_a_hardening_mode_is_one_mode_after_a_blow():
    found = identify_driven(struck(0.3), at_rest=True)
    np.testing.assert_allclose(found.modes.frequencies_hz[:1], 5.0, rtol=0.08)
    assert ((found.modes.frequencies_hz < 8.0) == [True, *[False] * (found.modes.n_modes - 1)]).all()
    assert np.abs(found.modes.frequencies_hz / 18.0 - 1.0).min() < 1e-3
    (remark,) = [remark for remark in found.remarks if "change" in remark and "distortion" not in remark]
    assert remark.startswith("modes change within the record, as it decays: mode 1 from 5.")


def test_linear_modes_after_a_blow_have_no_such_remark():
    record = struck(0.0)
    found = identify_driven(record, at_rest=True)
    np.testing.assert_allclose(found.modes.frequencies_hz, FREQUENCIES, rtol=1e-3)
    assert not any("change" in remark for remark in found.remarks)


@pytest.mark.parametrize("verb", [pytest.param(identify, marks=pytest.mark.slow), ring_down])
def test_free_decays_say_what_depends_on_amplitude(verb):
    """The lowest amplitude is where the mode is linear."""
    record = struck(0.1)
    decay = Record(record.sample_time, record.outputs[:, BLOW + 3 :], record.output_channels)
    printed = str(verb(decay))
    (remark,) = [line for line in printed.splitlines() if "depends on amplitude" in line]
    figures = [float(part.split(" Hz")[0]) for part in remark.split(": ")[1].split("; ")]
    assert figures[0] > 5.03 and sorted(figures, reverse=True) == figures
    np.testing.assert_allclose(figures[-1], 5.0, rtol=2e-3)
    assert "mode 2 depends" not in printed
    still = struck(0.0)
    linear = str(verb(Record(still.sample_time, still.outputs[:, BLOW + 3 :], still.output_channels)))
    assert "depends on amplitude" not in linear
