"""Tests of two assumptions on a free decay: modes independent of amplitude, and proportional damping.

Amplitude: the record is divided into segments, each twice as long as the one before, and the modes that are still
significant are refined in each. In a linear structure all segments agree within their errors: Σ_w ((ω_w - ω̄) / s_w)²
is chi-square. Damping: the constants α and β of Rayleigh damping (3.32), and whether they explain the damping ratios.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import exprel
from scipy.stats import chi2

from workbench.identification.free_decay.refinement import in_coloured_noise, refine
from workbench.identification.signal.data_quality import dropouts, steps
from workbench.identification.signal.modal_estimates import RefinedModes
from workbench.identification.signal.searches import TimeLimit
from workbench.records.record import Record, as_records
from workbench.renamed import Renamed, former_arguments
from workbench.structure.damping import ProportionalDamping
from workbench.structure.modes import frozen
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class AssumptionsSettings:
    """Constants of the test for dependence on amplitude."""

    segments: int = 4  # of a record, each twice as long as the one before
    min_statistic: float = 100.0  # χ² of a mode in a segment that is compared
    min_cycles: float = 3.0  # of the mode there
    max_frequency_error: float = 0.01  # relative standard error of its frequency there
    min_rms_steps: float = 3.0  # rms of an output in a segment, in quantisation steps
    # relative changes of frequency and of damping ratio that are too small for the digits printed
    printed_resolution: tuple[float, float] = (1e-5, 1e-3)
    false_alarm: float = 1e-3  # probability that a linear structure seems to depend on amplitude


ASSUMPTIONS = AssumptionsSettings()


@dataclass(frozen=True, eq=False)
class AmplitudeDependence:
    """Frequency and damping of each mode by segment of the decays; nan where a segment does not determine them.

    Attributes:
        record: (n_segments,) index of the record of each segment, from 0.
        start: (n_segments,) start of each segment, s.
        amplitude: (n_segments, n_modes) root mean square of the mode's envelope in a segment, largest output.
        omega: (n_segments, n_modes) rad/s.
        omega_std: (n_segments, n_modes) standard errors.
        zeta: (n_segments, n_modes) damping ratios.
        zeta_std: (n_segments, n_modes) standard errors.
        probability: (2, n_modes) that frequencies, and damping ratios, of a linear structure differ so much; 1 where
            fewer than two segments determine them.
    """

    record: np.ndarray
    start: np.ndarray
    amplitude: np.ndarray
    omega: np.ndarray
    omega_std: np.ndarray
    zeta: np.ndarray
    zeta_std: np.ndarray
    probability: np.ndarray

    @property
    def depends(self) -> np.ndarray:
        """Whether each mode depends on amplitude, (n_modes,), at a significance of 0.001 over all comparisons."""
        return np.asarray(np.any(self.probability < ASSUMPTIONS.false_alarm / self.probability.size, axis=0))

    @property
    def remarks(self) -> tuple[str, ...]:
        """A remark on each mode that depends on amplitude or on time; a decay does not distinguish these."""
        return tuple(
            f"mode {r + 1} depends on amplitude or time: {self.as_text(r)}"
            for r in np.flatnonzero(self.depends).tolist()
        )

    def as_text(self, r: int) -> str:
        """Frequency, damping and amplitude of mode r in each segment, as text."""
        seen = np.flatnonzero(np.isfinite(self.omega[:, r]))
        each = zip(self.omega[seen, r] / (2.0 * np.pi), self.zeta[seen, r], self.amplitude[seen, r], strict=True)
        return "; ".join(f"{f:.5g} Hz, {100 * zeta:.3g} % at amplitude {size:.3g}" for f, zeta, size in each)


@former_arguments(stretches="segments")
@one_blas_thread
def amplitude_dependence(
    records: Record | Sequence[Record],
    refined: RefinedModes,
    *,
    segments: int = ASSUMPTIONS.segments,
    time_limit: TimeLimit | None = None,
) -> AmplitudeDependence:
    """Frequency and damping of each mode of free decays by amplitude, in segments of the records.

    Args:
        records: the free decays that `refined` was identified from.
        refined: their modes.
        segments: number of segments of each record, each twice as long as the one before.
        time_limit: of processor time, after which no further segment is analysed; none unless given.

    Raises:
        ValueError: fewer than two segments.
    """
    if segments < 2:
        raise ValueError(f"amplitudes are compared over two segments or more; got {segments}")
    records = as_records(records)
    each = zip(records, refined.amplitudes, refined.noise, strict=True)
    time_limit = TimeLimit() if time_limit is None else time_limit
    values = [_segments(record, refined, np.abs(a), noise, segments, time_limit) for record, a, noise in each]
    start = np.concatenate([each[0] for each in values])
    amplitude, omega, omega_std, zeta, zeta_std = (frozen(rows) for rows in np.hstack([each[1] for each in values]))
    both = zip((omega, zeta), (omega_std, zeta_std), ASSUMPTIONS.printed_resolution, strict=True)
    probability = np.stack([_equality(value, np.hypot(std, resolution * value)) for value, std, resolution in both])
    which = np.repeat(np.arange(len(records)), segments)
    return AmplitudeDependence(
        frozen(which, int), frozen(start), amplitude, omega, omega_std, zeta, zeta_std, frozen(probability)
    )


def _segments(
    record: Record, refined: RefinedModes, size: np.ndarray, noise: np.ndarray, segments: int, time_limit: TimeLimit
) -> tuple[np.ndarray, np.ndarray]:
    """Starts of the segments of a record, (n_segments,) s, and the modes in each, (5, n_segments, n_modes).

    These are amplitude, ω and its standard error, ζ and its standard error.
    """
    modes = refined.modes
    edges = np.round((2.0 ** np.arange(segments + 1) - 1) / (2.0**segments - 1) * record.n_samples).astype(int)
    values_by_segment = np.full((5, segments, modes.n_modes), np.nan)
    spacing = np.abs(np.subtract.outer(modes.omega, modes.omega))
    dropped = [(at, at + (count - 1) * record.sample_time) for _, at, count, _ in dropouts(record)]
    least_rms = ASSUMPTIONS.min_rms_steps * steps(record)
    beats = np.where(np.eye(modes.n_modes, dtype=bool), np.inf, spacing).min(axis=1)
    for w, (first, last) in enumerate(zip(edges, edges[1:], strict=False)):
        span, decay = (last - first) * record.sample_time, -modes.poles.real
        initial = size * np.exp(-decay * first * record.sample_time)
        # mean over the segment of the squared envelope
        mean_square = initial**2 * exprel(-2.0 * decay * span)
        statistic = (0.5 * (last - first) * mean_square / noise[:, None] ** 2).sum(axis=0)
        significant = np.flatnonzero(statistic > ASSUMPTIONS.min_statistic)
        begins, ends = record.start_time + record.sample_time * np.array([first, last - 1])
        if significant.size == 0 or last - first < 4 * (significant.size + 1):
            continue
        # A dropout would look like a change of the modes.
        if any(since <= ends and until >= begins for since, until in dropped):
            continue
        segment = record.between(begins, ends)
        if (segment.outputs.std(axis=1) < least_rms).any():  # quantisation distorts so small a motion
            continue
        if time_limit.spent("comparison of modes by amplitude"):
            break
        try:
            refitted = refine(segment, modes.select(list(significant)), offset=True, time_limit=time_limit)
            refitted = in_coloured_noise(refitted, segment)
        except np.linalg.LinAlgError:
            continue
        if not refitted.converged:
            continue
        # A pole may have drifted to another frequency, and another one taken its place in the order.
        distance = np.abs(np.subtract.outer(refitted.modes.poles, modes.poles[significant]))
        nearest = distance.argmin(axis=1)
        sure = distance.argmin(axis=0)[nearest] == np.arange(nearest.size)
        sure &= refitted.omega_std < ASSUMPTIONS.max_frequency_error * refitted.modes.omega
        sure &= refitted.modes.frequencies_hz * span > ASSUMPTIONS.min_cycles
        significant = significant[nearest]
        # Two modes whose beat is longer than the segment look like one that changes.
        sure &= beats[significant] * span > 2.0 * np.pi
        values = (refitted.modes.omega, refitted.omega_std, refitted.modes.zeta, refitted.zeta_std)
        values_by_segment[0, w, significant[sure]] = np.sqrt(mean_square[:, significant[sure]].max(axis=0))
        values_by_segment[1:, w, significant[sure]] = np.stack(values)[:, sure]
    return record.start_time + record.sample_time * edges[:-1], values_by_segment


def _equality(values: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Probability of a scatter of values as large as in each column, (n_modes,), if only their errors differ.

    Values and their standard errors are (n_segments, n_modes), nan where unknown.
    """
    weights = np.where(np.isfinite(values), 1.0 / std**2, 0.0)
    known = np.where(np.isfinite(values), values, 0.0)
    mean = (weights * known).sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-300)
    free = np.isfinite(values).sum(axis=0) - 1
    return np.where(free > 0, chi2.sf((weights * (known - mean) ** 2).sum(axis=0), np.maximum(free, 1)), 1.0)


@dataclass(frozen=True, eq=False)
class ProportionalFit:
    """The least squares α and β of proportional damping C = α M + β K, and their goodness of fit.

    Attributes:
        damping: β, its `stiffness`, in s and α, its `mass`, in 1/s.
        standard_errors: (2,) of β and α.
        standardised_residuals: (n_modes,) ζ_r minus the fit, in standard errors of ζ_r.
        probability: of so large a misfit if the damping is proportional; below 0.01 it hardly is.
    """

    damping: ProportionalDamping
    standard_errors: np.ndarray
    standardised_residuals: np.ndarray
    probability: float

    left_over = Renamed("standardised_residuals")


def proportional_fit(refined: RefinedModes, only: Sequence[int] | slice = slice(None)) -> ProportionalFit:
    """Weighted least squares of ζ_r = (β ω_r + α / ω_r) / 2 (3.32), weights from the covariance of ζ.

    Args:
        refined: modes with the errors of their damping.
        only: the modes to fit, from 0; all unless given.

    Raises:
        ValueError: fewer than two modes.
    """
    modes = refined.modes.select(only)
    n = modes.n_modes
    if n < 2:
        raise ValueError(f"α and β of Rayleigh damping take at least two modes; there are {n}: identify more")
    columns = 0.5 * np.column_stack([modes.omega, 1.0 / modes.omega])
    which = refined.modes.n_modes + np.arange(refined.modes.n_modes)[only]
    covariance = refined.covariance[np.ix_(which, which)]
    root = np.linalg.cholesky(covariance)
    a, b = np.linalg.solve(root, columns), np.linalg.solve(root, modes.zeta)
    g = np.linalg.lstsq(a, b, rcond=None)[0]
    misfit = float(((b - a @ g) ** 2).sum())
    return ProportionalFit(
        damping=ProportionalDamping(stiffness=float(g[0]), mass=float(g[1])),
        standard_errors=frozen(np.sqrt(np.diag(np.linalg.inv(a.T @ a)))),
        standardised_residuals=frozen((modes.zeta - columns @ g) / np.sqrt(np.diag(covariance))),
        probability=float(chi2.sf(misfit, n - 2)) if n > 2 else 1.0,
    )
