"""Poles to start a search from: subspace identification with known inputs (past outputs MOESP).

Of all that future outputs Y_f do, future inputs U_f explain part; of the rest, past inputs and outputs explain what
passes through the state. With L of the triangular factor of [U_f; past; Y_f], the columns of [0 L_32], weighted by the
inverse root of what future outputs do without U_f (canonical variates), span those of the extended observability
matrix, Γ = [C; C A; C A² ...], and Γ without its last block times A is Γ without its first (Verhaegen, Automatica 30,
1994; Van Overschee & De Moor, Subspace Identification for Linear Systems, 1996, chapters 4 and 12).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from workbench.identification.input_output.input_delays import n_moving
from workbench.records.record import Record


@dataclass(frozen=True)
class SubspaceSettings:
    """Constants of the subspace model that a search starts from."""

    horizon: int = 140  # samples of past and of future, at most
    rows_each: int = 5  # moving samples there must be for each row of the data matrix
    least: int = 6  # samples of past below which nothing is tried: blows excite too few directions of the space
    # rows and columns of the data matrix at most: more add time, and the poles are only a start
    most_rows: int = 20_000
    most_columns: int = 1_700
    regularised: float = 1e-12  # of each row's energy, lest rows that are sums of others be singular


SUBSPACE = SubspaceSettings()


def subspace_poles(records: Sequence[Record], delays: np.ndarray, order: int) -> np.ndarray:
    """Poles λ above the real axis of a model, (n_poles,) rad/s; none where inputs move but briefly.

    Args:
        records: of the same inputs and outputs at one rate.
        delays: (n_inputs,) whole samples by which inputs act late.
        order: number of states.
    """
    m, q = records[0].n_outputs, records[0].n_inputs
    each = 2 * (m + q)
    longest = max(record.n_samples for record in records) - int(delays.max(initial=0))
    horizon = min(
        SUBSPACE.horizon, SUBSPACE.most_columns // each, n_moving(records) // (SUBSPACE.rows_each * each), longest // 4
    )
    if horizon < SUBSPACE.least:
        return np.zeros(0, complex)
    gram = np.zeros((each * horizon, each * horizon))
    left = SUBSPACE.most_rows
    for record in records:
        data = _data_matrix(record, delays, horizon, left)
        gram += data @ data.T
        left -= data.shape[1]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    gram *= np.outer(scale, scale)
    gram[np.diag_indices_from(gram)] += SUBSPACE.regularised
    try:
        factor = np.linalg.cholesky(gram)
        known, future = q * horizon, (m + 2 * q) * horizon
        without_inputs = factor[future:, known:]
        root = np.linalg.cholesky(without_inputs @ without_inputs.T)
        of_past = solve_triangular(root, factor[future:, known:future], lower=True)
        directions = np.linalg.svd(of_past, full_matrices=False)[0]
    except np.linalg.LinAlgError:
        return np.zeros(0, complex)
    observability = (root @ directions[:, :order]) / scale[future:, None]
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
