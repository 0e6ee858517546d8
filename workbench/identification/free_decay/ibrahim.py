"""Ibrahim's time domain method: frequencies, damping ratios and shapes from free decays (Ch. 3).

Every sensor measures the same decaying exponentials, u(t) = Σ b_r e^{λ_r t} (3.29). The columns of a matrix A are the
signals at a few delays, one column per instant; those of Â are the same one sample later. Then Â = G A, and G has the
eigenvalues e^{λ_r Δt} and eigenvectors whose first block is b_r. The normal matrix A A^T of (3.34) would square the
condition number; an orthogonal factorisation of A gives the same least squares solution without it.

Two forms: `two_delays` is that of 1981, with each signal and its copy one sample later, so that m sensors give exactly
m modes, spurious ones included. `stacked_delays` takes as many delays as the modes need and keeps only the dominant
directions of A: six sensors identify twenty modes, and most noise is rejected.

Stabilisation diagrams: a physical mode is stable over the model order. It appears at every order, with the same
frequency and a shape that is real up to a factor. Poles that fit noise, or small inconsistencies between points
measured one after the other, change with the order or have complex shapes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import lstsq, svd

from workbench.identification.signal.data_quality import of_same_sensors
from workbench.identification.signal.modal_estimates import normalised_shapes, time_derivatives
from workbench.identification.signal.searches import check_count
from workbench.records.record import Record
from workbench.renamed import former_arguments
from workbench.structure.modes import SampledModes, mac
from workbench.threads import one_blas_thread

LARGEST_MATRIX = 4_000_000  # entries


@dataclass(frozen=True)
class StabilitySettings:
    """Constants of the choice of modes that are stable over the orders of a diagram."""

    frequency_tolerance: float = 0.02  # largest relative difference between the poles of one mode
    min_mac: float = 0.8  # between them
    min_presence: float = 0.5  # share of the orders
    max_damping: float = 0.2  # ratio above which a pole is noise, as below zero


STABILITY = StabilitySettings()


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
        ValueError: a record too short for its sensors, instants before the record or at one sample.
    """
    if first < 0 or spacing < 1:
        raise ValueError(f"the first instant is sample 0 or later, the next 1 or more after it; got {first}, {spacing}")
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

    A is the block Hankel matrix of the record (those of several records side by side); its 2 n_modes leading left
    singular vectors U span the modes. G is the least squares solution of U without its last block, times G, equal to U
    without its first block. It has the eigenvalues e^{λ_r Δt}; the first block of U times its eigenvectors holds the
    shapes. Equal to `two_delays` for two delays without truncation.

    Args:
        records: free decay of the same sensors at one sample rate.
        n_modes: number of modes; a stabilisation diagram (`stabilise`, `stable_modes`) helps to choose it.
        delays: copies of each signal; by default a third of the record, up to 4,000,000 entries of A.
        branch: k of (3.23): frequencies lie between k and k + 1 times the Nyquist frequency.

    Returns:
        At most n_modes modes with 0 < ω < π/Δt (k = 0). Shapes are of displacement, largest entry 1.

    Raises:
        ValueError: less than one mode, too few samples, records that differ in sensors or rate.
    """
    check_count("n_modes", n_modes)
    records = of_same_sensors(records)
    return _modes_of(signal_subspace(records, 2 * n_modes, delays=delays), records[0], branch)


def signal_subspace(records: Sequence[Record], order: int, *, delays: int | None = None) -> np.ndarray:
    """Leading left singular vectors of the block Hankel matrix, (n_outputs * delays, order)."""
    m, shortest = records[0].n_outputs, min(records, key=lambda record: record.n_samples)
    if delays is None:
        # a third of the shortest record, fewer where the matrix would be too large
        fitting = LARGEST_MATRIX // (m * sum(r.n_samples for r in records))
        least = int(np.ceil(2 * order / m)) + 2
        delays = min(max(min(shortest.n_samples // 3, fitting), least), shortest.n_samples - 2)
    columns = sum(r.n_samples - delays + 1 for r in records)
    if m * (delays - 1) < order or columns < order or not 2 <= delays <= shortest.n_samples:
        least = int(np.ceil(order / m)) + 1
        raise ValueError(
            f"{order // 2} modes need at least {order} delayed signals and {order} instants: with {m} sensors {least}"
            f" delays and {order + least - 1} samples; record {shortest.name!r} has {shortest.n_samples} samples and"
            f" {delays} delays were taken. Measure longer or ask for fewer modes"
        )
    # delayed copies stacked, delay by delay
    windows = [sliding_window_view(r.outputs, r.n_samples - delays + 1, axis=1) for r in records]
    hankel = np.hstack([each.transpose(1, 0, 2).reshape(m * delays, -1) for each in windows])
    if min(hankel.shape) < 4 * order:
        return np.asarray(svd(hankel, full_matrices=False, lapack_driver="gesdd")[0][:, :order])
    # An orthogonal factorisation first makes the matrix square.
    if hankel.shape[1] > hankel.shape[0]:
        hankel = np.asarray(np.linalg.qr(hankel.T, mode="r")).T
    return np.asarray(svd(hankel, full_matrices=False)[0][:, :order])


def _modes_of(basis: np.ndarray, record: Record, branch: int = 0) -> SampledModes:
    """Modes from a signal subspace: its shift by one sample has their eigenvalues, its first block their shapes."""
    m = record.n_outputs
    mu, vectors = np.linalg.eig(lstsq(basis[:-m], basis[m:])[0])
    return as_modes(mu, basis[:m] @ vectors, record, branch)


def as_modes(mu: np.ndarray, vectors: np.ndarray, record: Record, branch: int = 0) -> SampledModes:
    """Modes from eigenvalues μ of one step in time, λ = (log μ + 2πi k)/Δt (3.23); real eigenvalues are left out."""
    mu, vectors = mu[mu.imag > 0], vectors[:, mu.imag > 0]
    if branch % 2:  # above Nyquist aliasing mirrors every second branch: the conjugate eigenvalue is observed
        mu, vectors = mu.conj(), vectors.conj()
    turns = (branch + 1) // 2
    poles = (np.log(mu) + 2j * np.pi * turns) / record.sample_time
    order = np.argsort(np.abs(poles))
    shapes = normalised_shapes(vectors / poles ** time_derivatives(record.output_channels)[:, None])
    return SampledModes.of_poles(poles[order], shapes[:, order], record.positions)


@dataclass(frozen=True, eq=False)
class Stabilisation:
    """The modes `found` at each of some numbers of modes, `orders`, from the lowest to the highest."""

    orders: tuple[int, ...]
    found: tuple[SampledModes, ...]


@dataclass(frozen=True, eq=False)
class StableModes:
    """The stable modes of a diagram, each from the order at which its phase collinearity is highest, and the share of
    the orders, (n_modes,), at which each was found."""

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
        ValueError: no order, one below 1, fewer samples than the highest order needs.
    """
    check_count("the lowest of orders", min(orders, default=0))
    records = of_same_sensors(records)
    basis = signal_subspace(records, 2 * max(orders), delays=delays)
    return Stabilisation(tuple(orders), tuple(_modes_of(basis[:, : 2 * n], records[0]) for n in orders))


@former_arguments(standing="min_phase_collinearity")
def stable_modes(diagram: Stabilisation, *, min_phase_collinearity: float = 0.8) -> StableModes:
    """The modes that are stable over the orders of a diagram.

    Args:
        diagram: from `stabilise`.
        min_phase_collinearity: of a shape, in 0 to 1.
    """
    groups: list[list[tuple[SampledModes, int]]] = []
    for modes in diagram.found:
        is_mode = (modes.zeta > 0) & (modes.zeta < STABILITY.max_damping)
        keep = is_mode & (modes.phase_collinearity >= min_phase_collinearity)
        taken = set()
        # The most collinear shapes are assigned first: a mode precedes poles that split off it.
        for r in sorted(np.flatnonzero(keep).tolist(), key=lambda r: -modes.phase_collinearity[r]):
            near = _nearest(groups, modes, r)
            if near is None:
                near = len(groups)
                groups.append([])
            if near not in taken:
                groups[near].append((modes, r))
                taken.add(near)
    stayed = [group for group in groups if len(group) >= STABILITY.min_presence * len(diagram.orders)]
    best = [max(group, key=lambda item: item[0].phase_collinearity[item[1]]) for group in stayed]
    n_outputs, positions = len(diagram.found[0].positions), diagram.found[0].positions
    omega, zeta = np.array([(modes.omega[r], modes.zeta[r]) for modes, r in best]).reshape(-1, 2).T
    shapes = np.array([modes.shapes[:, r] for modes, r in best]).reshape(-1, n_outputs).T
    share = np.array([len(group) for group in stayed]) / len(diagram.orders)
    order = np.argsort(omega)
    return StableModes(SampledModes(omega[order], zeta[order], shapes[:, order], positions), share[order])


def _nearest(groups: list[list[tuple[SampledModes, int]]], modes: SampledModes, r: int) -> int | None:
    """Index of the group whose last member agrees best with mode r in frequency and shape; None if none agrees."""
    nearest, distance = None, STABILITY.frequency_tolerance
    for i, group in enumerate(groups):
        last, k = group[-1]
        difference = abs(modes.omega[r] / last.omega[k] - 1.0)
        if difference <= distance and mac(modes.shapes[:, [r]], last.shapes[:, [k]])[0, 0] >= STABILITY.min_mac:
            nearest, distance = i, difference
    return nearest
