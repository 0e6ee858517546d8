"""Identification within a time limit, and what it does not report as modes."""

from time import thread_time

import numpy as np
import pytest
from scipy.signal import lfilter

import workbench as wb
from workbench.identification.driven import _without_artefacts
from workbench.identification.input_output import modal_fit, selection
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.model_order import SelectedModes, SelectionOptions
from workbench.identification.signal.modal_estimates import IdentifiedModes, RefinedModes, credible
from workbench.identification.signal.searches import TimeLimit
from workbench.identification.signal.synthesis import free_decay
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes
from workbench.study.pages.identification_report import identification_report

MODES = SampledModes(
    np.array([20.0, 50.0]), np.array([0.01, 0.01]), np.array([[1.0, 0.4], [0.6, -1.0]]), np.array([0.5, 1.5])
)


def hardening(n=40_000, dt=5e-4):
    """A mode whose frequency falls as it decays, with a weak one beside it: linear models of it have no end."""
    t = dt * np.arange(n)
    envelope = np.exp(-1.5 * t)
    phase = 2.0 * np.pi * 145.0 * t + 30.0 * np.cumsum(envelope) * dt
    y = envelope * np.cos(phase) + 0.1 * np.exp(-4.0 * t) * np.cos(2.0 * np.pi * 400.0 * t)
    return Record(dt, y[None] + 1e-3 * np.random.default_rng(0).standard_normal(n), (Channel("v", "velocity"),))


def test_a_record_without_end_ends_and_says_so():
    began = thread_time()
    found = wb.identify(hardening(), seconds=0.5)
    assert thread_time() - began < 20.0  # the step that is under way is finished
    assert found.modes.n_modes >= 1 and "of the 0.5 s allowed" in found.remarks[0]
    assert found.remarks[0] in str(found)


def test_a_search_for_which_the_time_was_up_asks_for_time_and_not_for_other_modes():
    force, noise = np.random.default_rng(0).standard_normal((2, 400))
    t = 0.01 * np.arange(400)
    moves = np.convolve(force, np.exp(-t) * np.sin(60.0 * t))[:400] + 0.01 * noise
    driven = Record(0.01, moves[None], (Channel("v", "velocity"),), force[None], (Channel("f", "force"),))
    report = identification_report([driven], seconds=1e-3)
    assert any("of the 0.001 s allowed" in line for line in report.lines)
    assert not any("did not converge" in line for line in report.lines)


def test_time_that_suffices_changes_nothing():
    record = free_decay(MODES, sample_time=0.01, n_samples=600, noise_std=0.01)
    limited, unlimited = wb.identify(record), wb.identify(record, seconds=None)
    assert np.array_equal(limited.modes.omega, unlimited.modes.omega) and not limited.remarks


@pytest.mark.parametrize("seconds", [None, 5.0])
def test_progress_is_a_share_that_grows(seconds):
    """Without a limit there is no share: what is being searched is said all the same."""
    met = []
    wb.ring_down(
        free_decay(MODES, sample_time=0.01, n_samples=600, noise_std=0.01),
        seconds=seconds,
        progress=lambda what, share: met.append((what, share)),
    )
    shares = [share for _, share in met]
    assert shares == sorted(shares) and 0.0 <= shares[0] and shares[-1] <= 1.0
    assert (shares[-1] > 0.0) == (seconds is not None)
    assert {"search for further modes"} <= {what for what, _ in met}


@pytest.mark.parametrize("seconds", [0.0, -1.0])
def test_no_time_at_all_is_refused(seconds):
    with pytest.raises(ValueError, match="seconds must be positive"):
        wb.identify(free_decay(MODES, sample_time=0.01, n_samples=600), seconds=seconds)


def test_what_cannot_be_a_mode():
    """Damping at and beyond three standard errors below zero; a frequency no better known than itself; beyond
    Nyquist."""
    omega = np.array([1.0, 1.0, 1.0, 1.0, 9.0, 11.0])
    modes = SampledModes(omega, np.array([0.01, -0.02, -0.04, 0.01, 0.01, 0.01]), np.ones((1, 6)), np.array([0.0]))
    good = credible(modes, np.array([0.1, 0.1, 0.1, 1.5, 0.1, 0.1]), np.full(6, 0.01), nyquist=10.0)
    assert good.tolist() == [True, True, False, False, True, False]


def test_artefacts_join_the_noise():
    covariance = np.diag([1e-4, 900.0, 1e-6, 1e-6])
    refined = RefinedModes(
        MODES, covariance**2, (np.ones((2, 2)),), np.zeros((2, 2, 1)), np.zeros((2, 2)), np.ones((1, 2)), True, 3
    )
    none = SampledModes(np.zeros(0), np.zeros(0), np.zeros((2, 0)), MODES.positions)
    found = IdentifiedModes(refined, np.array([90.0, 40.0]), 30.0, none, np.zeros(0)).without_artefacts(300.0)
    assert found.modes.omega.tolist() == [20.0] and found.noise_modes.omega.tolist() == [50.0]
    assert found.statistic.tolist() == [90.0] and found.noise_statistic.tolist() == [40.0]
    assert found.covariance.shape == (2, 2) and found.refined.amplitudes[0].shape == (2, 1)


def test_results_print_as_the_table_of_modes():
    found = wb.identify(free_decay(MODES, sample_time=0.01, n_samples=600, noise_std=0.01))
    head, *rows = str(found).splitlines()
    assert head.split() == ["mode", "frequency", "[Hz]", "±", "damping", "[%]", "±", "phase", "collinearity"]
    assert [float(row.split()[1]) for row in rows] == pytest.approx(found.modes.frequencies_hz, rel=1e-3)
    assert repr(found) == "IdentifiedModes(2 modes: 3.183, 7.958 Hz)" and found._repr_html_().count("<tr>") == 3


def test_no_fit_of_known_inputs_begins_once_the_time_is_up(monkeypatch):
    """Of a long record each takes seconds: but for the first mode, which is worth the wait, none follows."""
    force, noise = np.random.default_rng(0).standard_normal((2, 400))
    t = 0.01 * np.arange(400)
    moves = np.convolve(force, np.exp(-t) * (np.sin(60.0 * t) + np.sin(110.0 * t)))[:400] + 0.01 * noise
    driven = Record(0.01, moves[None], (Channel("v", "velocity"),), force[None], (Channel("f", "force"),))
    searched = []
    search = modal_fit.search
    monkeypatch.setattr(modal_fit, "search", lambda *args, **how: searched.append(args) or search(*args, **how))
    found = wb.identify_driven(driven, seconds=1e-6)
    assert len(searched) <= 1 and "stopped after" in found.remarks[-1]
    np.testing.assert_allclose(found.modes.omega[:1], 60.0, rtol=0.01)


def test_what_is_damped_too_much_to_ring_is_no_driven_mode():
    """A pole of ζ = 0.45 beside a mode of 0.01, in the response to a force held from sample to sample."""
    rng, dt, n = np.random.default_rng(0), 0.01, 1500
    omega, zeta = np.array([50.0, 120.0]), np.array([0.01, 0.45])
    poles = omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
    force, noise = rng.standard_normal((2, n))
    moves = sum(lfilter([0.0, z.imag], [1.0, -2.0 * z.real, abs(z) ** 2], force) for z in np.exp(dt * poles))
    record = Record(
        dt, (moves + 0.01 * noise)[None], (Channel("v", "velocity"),), force[None], (Channel("f", "force"),)
    )
    data = KnownInputs([record], at_rest=True, hold="zero", feedthrough=False)
    fit = modal_fit.settled(data, modal_fit.projected(data, poles, np.ones((2, 1), complex)))
    found, (remark,) = _without_artefacts(data, SelectedModes(fit, np.ones(2), 1.0, False), TimeLimit())
    np.testing.assert_allclose(np.abs(fit.poles), omega, rtol=0.02)
    np.testing.assert_allclose(np.abs(found.fit.poles), omega[:1], rtol=1e-3)
    assert "damping ratio above 0.3" in remark and "frequency): 19" in remark


def test_the_strongest_modes_leave_time_for_the_check_of_those_that_change(monkeypatch):
    """Of a mode that drifts linear ones have no end: told as three, it was never compared with one that changes."""
    rng, dt, n = np.random.default_rng(0), 0.01, 600
    z, force = np.exp(dt * (-0.5 + 50.0j)), rng.standard_normal(n)
    moves = lfilter([0.0, z.imag], [1.0, -2.0 * z.real, abs(z) ** 2], force) + 0.01 * rng.standard_normal(n)
    record = Record(dt, moves[None], (Channel("v", "velocity"),), force[None], (Channel("f", "force"),))
    data, given = KnownInputs([record], at_rest=True, hold="zero", feedthrough=False), []
    strongest = selection.select_strongest
    monkeypatch.setattr(
        selection,
        "select_strongest",
        lambda data, how, start: given.append(how.time_limit.seconds) or strongest(data, how, start),
    )
    selection.select(data, SelectionOptions(4, time_limit=TimeLimit(20.0)))
    assert 5.0 < given[0] <= 10.0
