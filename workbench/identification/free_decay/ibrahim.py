"""Ibrahim's time domain method: free decay in, frequencies, damping ratios and shapes out (Ch. 3).

Every sensor sees the same decaying exponentials, u(t) = Σ b_r e^{λ_r t} (3.29). Stack the signals at a few delays to
a column, put many instants beside one another to a matrix A, and the same one step later to Â. Then Â = G A, and G
has eigenvalues e^{λ_r Δt} and eigenvectors that begin with b_r. The normal matrix A A^T of (3.34) would square the
condition number; an orthogonal factorisation of A gives the same least squares solution without it.

Two forms are offered. `two_delays` is the one of 1981: each signal and its copy one step later, so m sensors give
exactly m modes, those that the structure does not have included. `stacked_delays` takes as many copies as the modes
need and keeps only the dominant directions of A: six sensors find twenty modes, and noise stays behind.

Stabilisation diagrams: a physical mode is stable over the model order. It appears at every order, with the same
frequency and a shape that is real but for its scale; poles that only fit the noise, or small inconsistencies between
points measured one after the other, change with the order or are complex.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lstsq, svd

from workbench.identification.signal.data_quality import of_same_sensors
from workbench.identification.signal.modal_estimates import normalised_shapes, time_derivatives
from workbench.records.record import Record
from workbench.structure.modes import SampledModes, mac
from workbench.threads import one_blas_thread

LARGEST_MATRIX = 4_000_000  # entries


def two_delays(record: Record, *, first: int = 0, spacing: int = 1, columns: int | None = None) -> SampledModes:
    """As many modes as sensors, by the least squares form of 1981: Â = G A with A of order 2m x columns (3.31).

    Args:
        record: free decay, m outputs; Δt of (3.31) is its sample time.
        first: sample of the first instant t_1.
        spacing: samples between instants t_j.
        columns: number of instants; 6m unless given, as in section 4.4.

    Returns:
        At most m modes; fewer where eigenvalues come out real. Shapes are of displacement, largest entry 1.

    Raises:
        ValueError: a record too short for its sensors.
    """
    m = record.n_outputs
    columns = 6 * m if columns is None else columns
    needed = first + (columns - 1) * spacing + 3
    if columns < 2 * m or record.n_samples < needed:
        raise ValueError(
            f"two delays of {m} sensors need at least {2 * m} instants and, for {columns} of them {spacing} apart from"
            f" sample {first} on, {needed} samples; record {record.name!r} has {record.n_samples}:"
            " measure longer, or use fewer sensors or columns"
        )
    instants = first + spacing * np.arange(columns)
    u = [record.outputs[:, instants + k] for k in range(3)]
    before, after = np.vstack(u[:2]), np.vstack(u[1:])
    transition = lstsq(before.T, after.T)[0].T
    mu, vectors = np.linalg.eig(transition)
    return as_modes(mu, vectors[:m], record)


@one_blas_thread
def stacked_delays(
    records: Record | Sequence[Record], *, n_modes: int, delays: int | None = None, branch: int = 0
) -> SampledModes:
    """The `n_modes` strongest modes, from many delayed copies of each signal and a truncated SVD.

    A is the block Hankel matrix of the record (those of several records stand side by side); its 2 n_modes leading
    left singular vectors U span the modes. U without its last block, times G, is U without its first: the least
    squares G has the eigenvalues e^{λ_r Δt} and the first block of U times its eigenvectors holds the shapes. Equal
    to `two_delays` where there are two delays and no truncation.

    Args:
        records: free decay of the same sensors at one sample rate.
        n_modes: how many; a stabilisation diagram (`stabilise`, `stable_modes`) helps to choose.
        delays: copies of each signal; by default a third of the record, within what a matrix can hold.
        branch: k of (3.23): frequencies lie between k and k + 1 times the Nyquist frequency.

    Returns:
        At most n_modes modes with 0 < ω < π/Δt (k = 0). Shapes are of displacement, largest entry 1.

    Raises:
        ValueError: too few samples, records that differ in sensors or rate.
    """
    records = of_same_sensors(records)
    basis = signal_subspace(records, 2 * n_modes, delays=delays)
    mu, vectors = shift_eigenpairs(basis, records[0].n_outputs)
    return as_modes(mu, vectors, records[0], branch)


def signal_subspace(records: Sequence[Record], order: int, *, delays: int | None = None) -> np.ndarray:
    """Leading left singular vectors of the block Hankel matrix, (n_outputs * delays, order).

    Raises:
        ValueError: fewer samples than the order needs.
    """
    m, shortest = records[0].n_outputs, min(r.n_samples for r in records)
    if delays is None:
        delays = min(_default_delays(m, [r.n_samples for r in records], order), shortest - 2)
    columns = sum(r.n_samples - delays + 1 for r in records)
    if m * (delays - 1) < order or columns < order or delays < 2:
        least = int(np.ceil(order / m)) + 1
        raise ValueError(
            f"{order // 2} modes need at least {order} delayed signals and {order} instants: with {m} sensors {least}"
            f" delays and {order + least - 1} samples; record {records[0].name!r} has {shortest} samples and"
            f" {delays} delays were taken. Measure longer or ask for fewer modes"
        )
    hankel = np.hstack([_hankel(r.outputs, delays) for r in records])
    if min(hankel.shape) < 4 * order:
        return np.asarray(svd(hankel, full_matrices=False, lapack_driver="gesdd")[0][:, :order])
    # an orthogonal factorisation of the longer side first
    if hankel.shape[1] > hankel.shape[0]:
        hankel = np.asarray(np.linalg.qr(hankel.T, mode="r")).T
    return np.asarray(svd(hankel, full_matrices=False)[0][:, :order])


def shift_eigenpairs(basis: np.ndarray, n_outputs: int) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (order,) of one step in time, and shapes (n_outputs, order), from a signal subspace."""
    transition = lstsq(basis[:-n_outputs], basis[n_outputs:])[0]
    mu, vectors = np.linalg.eig(transition)
    return mu, basis[:n_outputs] @ vectors


def as_modes(mu: np.ndarray, vectors: np.ndarray, record: Record, branch: int = 0) -> SampledModes:
    """Modes from eigenvalues of one step, λ = (log μ + 2πi k)/Δt (3.23); real eigenvalues are no modes."""
    upper = (mu.imag > 0) & (np.abs(mu) > 0)
    # Above Nyquist every second branch folds the spectrum over: the conjugate is the one that is seen.
    seen = mu[upper] if branch % 2 == 0 else mu[upper].conj()
    vectors = vectors[:, upper] if branch % 2 == 0 else vectors[:, upper].conj()
    turns = (branch + 1) // 2
    poles = (np.log(seen) + 2j * np.pi * turns) / record.sample_time
    order = np.argsort(np.abs(poles))
    shapes = normalised_shapes(vectors / poles ** time_derivatives(record.output_channels)[:, None])
    return SampledModes.of_poles(poles[order], shapes[:, order], record.positions)


def _default_delays(m: int, lengths: Sequence[int], order: int) -> int:
    """A third of the shortest record, fewer where the matrix would grow beyond `LARGEST_MATRIX` entries."""
    third = min(lengths) // 3
    fits = LARGEST_MATRIX // (m * sum(lengths))
    least = int(np.ceil(2 * order / m)) + 2
    return max(min(third, fits), least, 2)


def _hankel(outputs: np.ndarray, delays: int) -> np.ndarray:
    """Delayed copies stacked, delay by delay: (n_outputs * delays, n_samples - delays + 1)."""
    columns = outputs.shape[1] - delays + 1
    return np.vstack([outputs[:, d : d + columns] for d in range(delays)])


@dataclass(frozen=True, eq=False)
class Stabilisation:
    """The modes identified at each order, from the lowest to the highest.

    Attributes:
        orders: numbers of modes asked for.
        found: the `SampledModes` of each.
    """

    orders: tuple[int, ...]
    found: tuple[SampledModes, ...]


@dataclass(frozen=True, eq=False)
class StableModes:
    """The stable modes of a diagram.

    Attributes:
        modes: each as identified at the order where its phase collinearity is highest.
        presence: (n_modes,) share of the orders at which it was found.
    """

    modes: SampledModes
    presence: np.ndarray


@one_blas_thread
def stabilise(records: Record | Sequence[Record], *, orders: Sequence[int], delays: int | None = None) -> Stabilisation:
    """Identify at several orders from one subspace.

    Args:
        records: free decay of the same sensors.
        orders: numbers of modes, increasing.
        delays: as in `stacked_delays`.

    Raises:
        ValueError: fewer samples than the highest order needs.
    """
    records = of_same_sensors(records)
    basis = signal_subspace(records, 2 * max(orders), delays=delays)
    found = []
    for n in orders:
        mu, shapes = shift_eigenpairs(basis[:, : 2 * n], records[0].n_outputs)
        found.append(as_modes(mu, shapes, records[0]))
    return Stabilisation(tuple(orders), tuple(found))


def stable_modes(
    diagram: Stabilisation,
    *,
    frequency: float = 0.02,
    shape: float = 0.8,
    standing: float = 0.8,
    presence: float = 0.5,
    largest_damping: float = 0.2,
) -> StableModes:
    """The modes that are stable over the orders of a diagram.

    Args:
        diagram: from `stabilise`.
        frequency: relative difference up to which two poles are one mode.
        shape: MAC from which on they are.
        standing: least phase collinearity of a shape.
        presence: least share of the orders.
        largest_damping: ratios above are noise, as are negative ones.
    """
    groups: list[list[tuple[SampledModes, int]]] = []
    for modes in diagram.found:
        keep = (modes.zeta > 0) & (modes.zeta < largest_damping) & (modes.phase_collinearity >= standing)
        taken = set()
        # The most collinear shapes choose first, so that a split of a mode does not take its place.
        for r in sorted(np.flatnonzero(keep), key=lambda r: -modes.phase_collinearity[r]):
            near = _nearest(groups, modes, int(r), frequency, shape)
            if near is None:
                groups.append([(modes, int(r))])
                taken.add(len(groups) - 1)
            elif near not in taken:
                groups[near].append((modes, int(r)))
                taken.add(near)
    stayed = [g for g in groups if len(g) >= presence * len(diagram.orders)]
    best = [max(g, key=lambda item: item[0].phase_collinearity[item[1]]) for g in stayed]
    order = np.argsort([modes.omega[r] for modes, r in best])
    best, stayed = [best[i] for i in order], [stayed[i] for i in order]
    positions = diagram.found[0].positions
    modes = SampledModes(
        np.array([m.omega[r] for m, r in best]),
        np.array([m.zeta[r] for m, r in best]),
        np.array([m.shapes[:, r] for m, r in best]).reshape(len(best), len(positions)).T,
        positions,
    )
    return StableModes(modes, np.array([len(g) for g in stayed]) / len(diagram.orders))


def _nearest(
    groups: list[list[tuple[SampledModes, int]]], modes: SampledModes, r: int, frequency: float, shape: float
) -> int | None:
    """The group whose last member is this mode, if any."""
    nearest, distance = None, frequency
    for i, group in enumerate(groups):
        last, k = group[-1]
        apart = abs(modes.omega[r] / last.omega[k] - 1.0)
        if apart <= distance and mac(modes.shapes[:, [r]], last.shapes[:, [k]])[0, 0] >= shape:
            nearest, distance = i, apart
    return nearest
