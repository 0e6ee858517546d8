from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from workbench.identification.input_output import model_order
from workbench.identification.input_output.known_inputs import KnownInputs
from workbench.identification.input_output.modal_fit import columns, projected, search, settled
from workbench.identification.input_output.model_order import SelectionOptions, _Modes, select_modes
from workbench.identification.signal.searches import overdamped
from workbench.records.record import Channel, Record


def test_how_a_blow_runs_between_samples_is_no_mode():
    """Three modes ring after a blow of 1.6 samples, which is no force held from sample to sample."""
    dt, n, begins, lasts = 1e-3, 1000, 0.1006, 1.6e-3
    time = dt * np.arange(n)
    force = np.where(np.abs(time - begins - 0.5 * lasts) < 0.5 * lasts, np.sin(np.pi * (time - begins) / lasts) ** 2, 0)
    omega, zeta = 2.0 * np.pi * np.array([18.3, 60.0, 160.0]), np.array([0.006, 0.003, 0.003])
    after = np.maximum(time - begins - 0.5 * lasts, 0.0)[:, None]
    rings = (np.array([0.4, 1.0, 0.5]) * np.exp(-zeta * omega * after) * np.cos(omega * after - [0.0, 0.3, 0.6])).sum(
        axis=1
    )
    moves = np.where(after[:, 0] > 0.0, rings, 0.0) + 1e-3 * np.random.default_rng(0).standard_normal(n)
    record = Record(dt, moves[None], (Channel("v", "velocity"),), force[None], (Channel("f", "force"),))
    found = select_modes(KnownInputs([record], at_rest=True, hold="zero", feedthrough=True), SelectionOptions(6))
    np.testing.assert_allclose(found.fit.poles.imag, omega, rtol=1e-3)


def test_a_candidate_that_ceases_to_oscillate_is_fitted_no_further():
    rng, dt, n = np.random.default_rng(3), 1e-3, 2000
    u, omega = rng.standard_normal((1, n)), 200.0
    pole = omega * (-0.6 + 0.8j)  # far beyond the largest damping of a mode
    y = np.imag(lfilter([0.0, 1.0], [1.0, -np.exp(pole * dt)], u.astype(complex)))
    record = Record(dt, y + 0.01 * rng.standard_normal(y.shape), (Channel("y"),), u, (Channel("u"),))
    data = KnownInputs([record], at_rest=True, hold="zero", feedthrough=False)
    nothing = projected(data, np.zeros(0, complex), np.zeros((0, 1), complex))
    trial = _Modes(data, SelectionOptions(6)).extended(nothing, (omega * (-0.1 + 1j), np.ones(1, complex)))
    assert overdamped(trial.poles).all() and not trial.converged


def test_a_candidate_of_a_long_record_is_fitted_with_its_neighbours_before_all_modes(monkeypatch):
    """The steps of a coarse candidate beside a mode are taken with these two; all four modes are nearly there then."""
    rng, dt, n, hz = np.random.default_rng(5), 1e-3, 6000, np.array([21.0, 60.0, 130.0, 134.0])
    u, poles = rng.standard_normal((1, n)), 2.0 * np.pi * hz * (-0.01 + 1j)
    y = sum(np.imag(lfilter([0.0, 1.0], [1.0, -np.exp(pole * dt)], u.astype(complex))) for pole in poles)
    record = Record(dt, y + 0.05 * rng.standard_normal(y.shape), (Channel("y"),), u, (Channel("u"),))
    data = KnownInputs([record], at_rest=True, hold="zero", feedthrough=True)
    model = settled(data, projected(data, poles[:3], np.ones((3, 1), complex)))
    fits: list[tuple[int, int]] = []

    def counted(*arguments):
        fit = search(*arguments)
        fits.append((fit.poles.size, fit.steps))
        return fit

    monkeypatch.setattr(model_order, "search", counted)
    candidate = model.poles[2] + 2.0 * np.pi * 8.0j, np.ones(1, complex)
    trial = _Modes(data, SelectionOptions(6)).extended(model, candidate)
    np.testing.assert_allclose(trial.poles.imag, poles.imag, rtol=1e-3)
    (near, of_near), (every, of_all) = fits
    assert (near, every) == (2, 4) and of_all < of_near


def close_pair(n=6000, noise=0.03):
    """Two modes half a bandwidth apart, driven by white force, and the fit of both."""
    rng, dt, hz = np.random.default_rng(4), 1e-3, np.array([130.0, 130.8])
    u, poles = rng.standard_normal((1, n)), 2.0 * np.pi * hz * (-0.006 + 1j)
    y = sum(np.imag(lfilter([0.0, 1.0], [1.0, -np.exp(pole * dt)], u.astype(complex))) for pole in poles)
    record = Record(dt, y + noise * y.std() * rng.standard_normal(y.shape), (Channel("y"),), u, (Channel("u"),))
    data = KnownInputs([record], at_rest=True, hold="zero", feedthrough=True)
    return data, poles, settled(data, projected(data, poles, np.ones((2, 1), complex)))


def test_what_is_tested_is_not_tested_again(monkeypatch):
    data, poles, _ = close_pair()
    tested = []
    suspects = _Modes.suspects
    monkeypatch.setattr(_Modes, "suspects", lambda self, model: (tested.append(model), suspects(self, model))[1])
    found = select_modes(data, SelectionOptions(4))
    assert tested
    tested.clear()
    again = select_modes(data, SelectionOptions(8), found.fit, is_tested=True)
    assert not tested and (again.fit.poles == found.fit.poles).all() and found.fit.poles.size == poles.size


def test_inputs_are_transformed_once_for_all_searches_of_candidates(monkeypatch):
    data, _, fit = close_pair()
    transformed = []
    correlate = KnownInputs._autocorrelations
    monkeypatch.setattr(KnownInputs, "_autocorrelations", lambda self: (transformed.append(self), correlate(self))[1])
    first, second = data.candidates(data.values), data.candidates(data.values)
    assert len(transformed) == 1 and (first == second).all()
    assert not (data.candidates(fit.residual)[:1] == first[:1]).any() and len(transformed) == 1


@pytest.mark.parametrize("weighted", [False, True])
def test_the_basis_of_many_rows_is_that_of_its_columns(weighted):
    """By the products that the fit holds, as by reflections."""
    data, _, fit = close_pair()
    if weighted:
        std = 1.0 + 0.5 * np.sin(np.linspace(0.0, 9.0, len(data.values)))[:, None]
        data = replace(data, line_std=[std])
        fit = projected(data, fit.poles, fit.participation)
    (basis,) = model_order.bases_of(data, fit)
    phi = columns(data, fit.poles, fit.participation)[0] * (1.0 if data.weights is None else data.weights)
    exact = np.linalg.qr(phi)[0]
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-9)
    np.testing.assert_allclose(basis @ (basis.T @ exact), exact, atol=1e-9)
