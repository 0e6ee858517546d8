"""Do two assumptions hold in a free decay: modes that do not depend on amplitude, and proportional damping?

Amplitude: segments double in length as the motion dies away. In each, the modes still there are refined by themselves;
in a linear structure all segments agree within their errors, Σ_w ((ω_w - ω̄) / s_w)² being chi-square. Damping: the
constants g1 and g2 of (3.32), and whether they explain what was measured.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from workbench.identification.free_decay.refinement import in_coloured_noise, refine
from workbench.identification.signal.data_quality import dropouts, steps
from workbench.identification.signal.modal_estimates import Refined
from workbench.identification.signal.searches import Budget
from workbench.records.record import Record, as_records
from workbench.renamed import Renamed
from workbench.structure.damping import ProportionalDamping
from workbench.structure.modes import frozen
from workbench.threads import one_blas_thread


@dataclass(frozen=True)
class AssumptionsSettings:
    """Constants of the test for dependence on amplitude."""

    segments: int = 4  # of a record, each twice as long as the one before
    least_statistic: float = 100.0  # χ² of a mode in a segment, for its frequency there to mean something
    least_cycles: float = 3.0  # likewise
    least_sure: float = 0.01  # relative standard error of a frequency up to which a segment counts
    rounded: float = 3.0  # steps of an output, that its rms in a segment has at least
    shown: tuple[float, float] = (1e-5, 1e-3)  # of a frequency, a damping ratio: less is not seen in their figures
    chance: float = 1e-3  # that a linear structure is said to depend on amplitude


ASSUMPTIONS = AssumptionsSettings()


@dataclass(frozen=True, eq=False)
class AmplitudeDependence:
    """Each mode by amplitude; nan where a segment does not determine it.

    Attributes:
        record: (n_stretches,) which record each is of, from 0.
        start: (n_stretches,) of each, s.
        amplitude: (n_stretches, n_modes) root mean square over a stretch of the mode's envelope, largest output.
        omega: (n_stretches, n_modes) rad/s.
        omega_std: (n_stretches, n_modes) standard errors.
        zeta: (n_stretches, n_modes) damping ratios.
        zeta_std: (n_stretches, n_modes) standard errors.
        probability: (2, n_modes) of frequencies, and damping ratios, that differ so in a linear structure; 1 where
            fewer than two segments determine it.
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
        """Modes (n_modes,) that depend on amplitude: chance under one in a thousand over all that was compared."""
        return np.asarray(np.any(self.probability < ASSUMPTIONS.chance / self.probability.size, axis=0))

    @property
    def remarks(self) -> tuple[str, ...]:
        """One on each mode that depends on amplitude, or on time, as a decay tells one from the other by nothing."""
        return tuple(
            f"mode {r + 1} depends on amplitude or time: {self.figures(r)}"
            for r in np.flatnonzero(self.depends).tolist()
        )

    def figures(self, r: int) -> str:
        """Frequency and damping of mode r by amplitude, in words."""
        seen = np.flatnonzero(np.isfinite(self.omega[:, r]))
        each = zip(self.omega[seen, r] / (2.0 * np.pi), self.zeta[seen, r], self.amplitude[seen, r], strict=True)
        return "; ".join(f"{f:.5g} Hz, {100 * zeta:.3g} % at {size:.3g}" for f, zeta, size in each)


@one_blas_thread
def amplitude_dependence(
    records: Record | Sequence[Record],
    refined: Refined,
    *,
    stretches: int = ASSUMPTIONS.segments,
    budget: Budget | None = None,
) -> AmplitudeDependence:
    """Frequency and damping of each mode of free decays, stretch by stretch.

    Args:
        records: the free decays that `refined` was found in.
        refined: their modes.
        stretches: how many of each record, each twice as long as the one before.
        budget: of time, after which no further stretch is looked at; none unless given.

    Raises:
        ValueError: fewer than two stretches.
    """
    if stretches < 2:
        raise ValueError(f"amplitudes are compared over two stretches or more; got {stretches}")
    records = as_records(records)
    each = zip(records, refined.amplitudes, refined.noise, strict=True)
    budget = Budget() if budget is None else budget
    values = [_segments(record, refined, np.abs(a), noise, stretches, budget) for record, a, noise in each]
    start = np.concatenate([each[0] for each in values])
    amplitude, omega, omega_std, zeta, zeta_std = (frozen(rows) for rows in np.hstack([each[1] for each in values]))
    alike = np.stack(
        [
            _alike(omega, np.hypot(omega_std, ASSUMPTIONS.shown[0] * omega)),
            _alike(zeta, np.hypot(zeta_std, ASSUMPTIONS.shown[1] * zeta)),
        ]
    )
    which = np.repeat(np.arange(len(records)), stretches)
    return AmplitudeDependence(
        frozen(which, int), frozen(start), amplitude, omega, omega_std, zeta, zeta_std, frozen(alike)
    )


def _segments(
    record: Record, refined: Refined, size: np.ndarray, noise: np.ndarray, stretches: int, budget: Budget
) -> tuple[np.ndarray, np.ndarray]:
    """Starts (n_stretches,), and (5, n_stretches, n_modes) of amplitude, ω and its error, ζ and its error."""
    modes = refined.modes
    edges = np.round((2.0 ** np.arange(stretches + 1) - 1) / (2.0**stretches - 1) * record.n_samples).astype(int)
    figures = np.full((5, stretches, modes.n_modes), np.nan)
    apart = np.abs(np.subtract.outer(modes.omega, modes.omega))
    lost = [(at, at + (count - 1) * record.sample_time) for _, at, count, _ in dropouts(record)]
    coarse = ASSUMPTIONS.rounded * steps(record)
    beats = np.where(np.eye(modes.n_modes, dtype=bool), np.inf, apart).min(axis=1)
    for w, (first, last) in enumerate(zip(edges, edges[1:], strict=False)):
        span, decay = (last - first) * record.sample_time, -modes.poles.real
        begun = size * np.exp(-decay * first * record.sample_time)
        # Mean over the stretch of the squared envelope.
        mean = begun**2 * _mean_of_decay(2.0 * decay * span)
        statistic = (0.5 * (last - first) * mean / noise[:, None] ** 2).sum(axis=0)
        there = np.flatnonzero(statistic > ASSUMPTIONS.least_statistic)
        begins, ends = record.start_time + record.sample_time * np.array([first, last - 1])
        if there.size == 0 or last - first < 4 * (there.size + 1):
            continue
        if any(since <= ends and until >= begins for since, until in lost):  # would look like a change of the modes
            continue
        stretch = record.between(begins, ends)
        if (stretch.outputs.std(axis=1) < coarse).any():  # what rounding leaves of so little is not the motion
            continue
        if budget.spent("comparison of modes by amplitude"):
            break
        try:
            found = in_coloured_noise(refine(stretch, modes.select(list(there)), offset=True, budget=budget), stretch)
        except np.linalg.LinAlgError:
            continue
        if not found.converged:
            continue
        # One pole may have wandered off, and another taken its place in the order.
        away = np.abs(np.subtract.outer(found.modes.poles, modes.poles[there]))
        own = away.argmin(axis=1)
        sure = away.argmin(axis=0)[own] == np.arange(own.size)
        sure &= found.omega_std < ASSUMPTIONS.least_sure * found.modes.omega
        sure &= found.modes.frequencies_hz * span > ASSUMPTIONS.least_cycles
        there = there[own]
        sure &= beats[there] * span > 2.0 * np.pi  # of two that beat more slowly, one looks like a mode that changes
        values = (found.modes.omega, found.omega_std, found.modes.zeta, found.zeta_std)
        figures[0, w, there[sure]] = np.sqrt(mean[:, there[sure]].max(axis=0))
        figures[1:, w, there[sure]] = np.stack(values)[:, sure]
    return record.start_time + record.sample_time * edges[:-1], figures


def _mean_of_decay(x: np.ndarray) -> np.ndarray:
    """(1 - e^-x) / x, 1 at 0."""
    near = np.abs(x) < 1e-9
    return np.where(near, 1.0, -np.expm1(-x) / np.where(near, 1.0, x))


def _alike(values: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Probability of values so far apart, (n_modes,), if each column is one number and its errors."""
    weights = np.where(np.isfinite(values), 1.0 / std**2, 0.0)
    known = np.where(np.isfinite(values), values, 0.0)
    mean = (weights * known).sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-300)
    free = np.isfinite(values).sum(axis=0) - 1
    return np.where(free > 0, chi2.sf((weights * (known - mean) ** 2).sum(axis=0), np.maximum(free, 1)), 1.0)


@dataclass(frozen=True, eq=False)
class ProportionalFit:
    """The best g1 and g2, and how well they do.

    Attributes:
        damping: g1 in s and g2 in 1/s.
        standard_errors: (2,) of g1 and g2.
        standardised_residuals: (n_modes,) ζ_r minus the fit, in standard errors of ζ_r.
        probability: of so bad a fit if the damping is proportional; below 0.01 it hardly is.
    """

    damping: ProportionalDamping
    standard_errors: np.ndarray
    standardised_residuals: np.ndarray
    probability: float

    left_over = Renamed("standardised_residuals")


def proportional_fit(refined: Refined, only: Sequence[int] | slice = slice(None)) -> ProportionalFit:
    """Weighted least squares of ζ_r = (g1 ω_r + g2 / ω_r) / 2 (3.32), weights from the covariance of ζ.

    Args:
        refined: modes with the errors of their damping.
        only: the modes to fit, from 0; all unless given.

    Raises:
        ValueError: fewer than two modes.
    """
    modes = refined.modes.select(only)
    n = modes.n_modes
    if n < 2:
        raise ValueError(f"g1 and g2 take at least two modes; there are {n}: identify more")
    columns = 0.5 * np.column_stack([modes.omega, 1.0 / modes.omega])
    which = refined.modes.n_modes + np.arange(refined.modes.n_modes)[only]
    covariance = refined.covariance[np.ix_(which, which)]
    root = np.linalg.cholesky(covariance)
    a, b = np.linalg.solve(root, columns), np.linalg.solve(root, modes.zeta)
    g = np.linalg.lstsq(a, b, rcond=None)[0]
    misfit = float(((b - a @ g) ** 2).sum())
    return ProportionalFit(
        damping=ProportionalDamping(float(g[0]), float(g[1])),
        standard_errors=frozen(np.sqrt(np.diag(np.linalg.inv(a.T @ a)))),
        standardised_residuals=frozen((modes.zeta - columns @ g) / np.sqrt(np.diag(covariance))),
        probability=float(chi2.sf(misfit, n - 2)) if n > 2 else 1.0,
    )
