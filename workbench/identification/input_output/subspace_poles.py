"""Initial poles by subspace identification with known inputs (past outputs MOESP).

Of the future outputs Y_f, the future inputs U_f explain a part; of the remainder, past inputs and outputs explain what
passes through the state. With L of the triangular factor of [U_f; past; Y_f], the columns of [0 L_32], weighted by the
inverse root of the covariance of Y_f given U_f (canonical variates), span those of the extended observability matrix,
Γ = [C; C A; C A² ...], and Γ without its last block times A is Γ without its first (Verhaegen, Automatica 30, 1994;
Van Overschee & De Moor, Subspace Identification for Linear Systems, 1996, chapters 4 and 12).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from workbench.identification.input_output.excitation import n_moving
from workbench.records.record import Record


@dataclass(frozen=True)
class SubspaceSettings:
    """Constants of the initial subspace model."""

    max_horizon: int = 140  # samples of past and of future, at most
    samples_per_row: int = 5  # samples of nonzero input for each row of the data matrix, at least
    min_horizon: int = 6  # samples of past at least: with fewer, impacts excite too few directions of the state space
    # rows and columns of the data matrix at most: more add time, and the poles are only initial
    max_rows: int = 20_000
    max_columns: int = 1_700
    regularisation: float = 1e-12  # of each row's energy, against singularity by dependent rows


SUBSPACE = SubspaceSettings()


def subspace_poles(records: Sequence[Record], delays: np.ndarray, order: int) -> np.ndarray:
    """Poles λ of positive frequency of a subspace model, (n_poles,) rad/s; none where inputs act too briefly.

    From the delay of each input in whole samples, (n_inputs,), and the number of states.
    """
    m, q = records[0].n_outputs, records[0].n_inputs
    rows_per_lag = 2 * (m + q)
    longest = max(record.n_samples for record in records) - int(delays.max(initial=0))
    horizon = min(
        SUBSPACE.max_horizon,
        SUBSPACE.max_columns // rows_per_lag,
        n_moving(records) // (SUBSPACE.samples_per_row * rows_per_lag),
        longest // 4,
    )
    if horizon < SUBSPACE.min_horizon:
        return np.zeros(0, complex)
    gram = np.zeros((rows_per_lag * horizon, rows_per_lag * horizon))
    columns_left = SUBSPACE.max_rows
    for record in records:
        data = _data_matrix(record, delays, horizon, columns_left)
        gram += data @ data.T
        columns_left -= data.shape[1]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    gram *= np.outer(scale, scale)
    gram[np.diag_indices_from(gram)] += SUBSPACE.regularisation
    try:
        factor = np.linalg.cholesky(gram)
        n_future_inputs, n_known = q * horizon, (m + 2 * q) * horizon
        given_inputs = factor[n_known:, n_future_inputs:]
        root = np.linalg.cholesky(given_inputs @ given_inputs.T)
        predictable = solve_triangular(root, factor[n_known:, n_future_inputs:n_known], lower=True)
        directions = np.linalg.svd(predictable, full_matrices=False)[0]
    except np.linalg.LinAlgError:
        return np.zeros(0, complex)
    observability = (root @ directions[:, :order]) / scale[n_known:, None]
    a = np.linalg.lstsq(observability[:-m], observability[m:], rcond=None)[0]
    mu = np.linalg.eigvals(a)
    return np.asarray(np.log(mu[mu.imag > 0]) / records[0].sample_time)


def _data_matrix(record: Record, delays: np.ndarray, horizon: int, most: int) -> np.ndarray:
    """[U_f; U_p; Y_p; Y_f] of one record, (2 (n_outputs + n_inputs) horizon, n_columns)."""
    latest = int(delays.max(initial=0))
    n = record.n_samples - latest
    u = np.array([row[latest - d : latest - d + n] for row, d in zip(record.inputs, delays, strict=True)])
    y = record.outputs[:, latest:]
    y = y - y.mean(axis=1, keepdims=True)
    columns = min(n - 2 * horizon + 1, most)
    if columns <= 0:
        return np.zeros((2 * (len(u) + len(y)) * horizon, 0))
    past, future = range(horizon), range(horizon, 2 * horizon)
    return np.vstack([x[:, k : k + columns] for x, at in ((u, future), (u, past), (y, past), (y, future)) for k in at])
