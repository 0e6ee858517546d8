"""Columns of modes made orthonormal, and the powers that decaying modes are made of."""

import tracemalloc

import numpy as np
import pytest

from workbench.identification.input_output.known_inputs import powers
from workbench.identification.input_output.modal_fit import MANY_ROWS, _part, orthonormal


@pytest.mark.parametrize("apart", [1.0, 1e-3, 1e-6, 1e-10])
def test_columns_are_madeorthonormal_however_close_they_are(apart):
    rng = np.random.default_rng(1)
    columns = rng.normal(size=(500, 6))
    columns[:, 5] = columns[:, 0] + apart * rng.normal(size=500)
    columns /= np.linalg.norm(columns, axis=0)
    q, r = orthonormal(columns)
    assert np.abs(q.T @ q - np.eye(6)).max() < 1e-14
    assert np.abs(q @ r - columns).max() < 1e-14
    assert np.abs(np.tril(r, -1)).max() == 0.0


def test_no_column_has_none():
    q, r = orthonormal(np.zeros((500, 0)))
    assert q.shape == (500, 0) and r.shape == (0, 0)


@pytest.mark.parametrize("n", [1, 7, 100, 12_345])
def test_powers_are_exponentials(n):
    exponent = -1e-3 + 0.7j
    assert powers(exponent, n) == pytest.approx(np.exp(exponent * np.arange(n)), rel=1e-11)


@pytest.mark.parametrize("n", [500, MANY_ROWS])
def test_tangents_are_projected_whether_their_rows_are_few_or_many(n):
    rng = np.random.default_rng(0)
    phi, t, y = (rng.standard_normal((n, k)) for k in (4, 60, 2))
    tilt, c = (np.linalg.lstsq(phi, each, rcond=None)[0] for each in (t, y))
    rest, left = t - phi @ tilt, y - phi @ c
    tracemalloc.start()
    found = _part(phi, t, y)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    for name, exact in {"gram": rest.T @ rest, "slopes": rest.T @ left, "tilt": tilt, "residual": left}.items():
        np.testing.assert_allclose(getattr(found, name), exact, rtol=0, atol=1e-10 * np.abs(exact).max())
    assert n < MANY_ROWS or peak < t.nbytes  # no further table of their size
